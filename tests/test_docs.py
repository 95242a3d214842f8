"""README and the pages in docs keep up with the code: links lead somewhere, YAML is what its schema takes, every
command line is one that the command's own parser takes, and those that do something do it.
"""

import ast
import contextlib
import importlib
import itertools
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from _pytest.mark.expression import Expression
from typer._click.exceptions import MissingParameter

import twin
from docs.site.command_pages import parser, programs
from docs.site.spec_examples import accepted, examples
from scenes.models.disturbances import motions_of_spec
from scenes.models.instrument_builder import build_instrument
from scenes.schema import MODELS
from scenes.specs.disturbances import DisturbancesSpec
from scenes.specs.instrument import InstrumentSpec
from scenes.specs.job import JobSpec, checked_nodes
from scenes.specs.load import load_camera
from scenes.specs.measured.monitor_frames import read_frame_table
from scenes.specs.resolved import resolve
from scenes.yaml.csv_table import read_table
from scenes.yaml.errors import InputError
from scenes.yaml.finish_files import COLUMNS as COATING_COLUMNS
from scenes.yaml.node_table import COLUMNS as NODE_COLUMNS
from scenes.yaml.node_table import HEAT_COLUMNS
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from twin.laboratory.measured_focus import IMAGE_COLUMNS, MTF_COLUMNS
from twin.laboratory.measured_readings import COMPARISON_COLUMNS, SPOT_COLUMNS
from twin.orbit.measured.measurement_tables import COLUMNS
from twin.run.console import PROGRAMS

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    *(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
_FENCE = re.compile(r"^```(\S*)[^\n]*\n(.*?)^```", re.M | re.S)


def named(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@dataclass(frozen=True)
class Piece:
    """A block, a line of one, or code within a sentence, with where it stands."""

    page: str
    text: str

    def __str__(self) -> str:
        return f"{self.page}: {self.text.splitlines()[0]}"


def blocks(*languages: str) -> list[Piece]:
    return [
        Piece(named(page), text)
        for page in PAGES
        for language, text in _FENCE.findall(page.read_text("utf-8"))
        if language in languages
    ]


def spans() -> list[Piece]:
    """Code within sentences; a cell of a table that offers words with a bar between them gives a piece for each."""
    out = []
    for page in PAGES:
        prose = _FENCE.sub("", page.read_text("utf-8"))
        for text in re.findall(r"`([^`\n]+(?:\n[^`\n]+)?)`", prose):
            text = " ".join(text.split())
            choice = re.search(r"\S+\\\|\S+", text)
            words = choice[0].split("\\|") if choice else [""]
            out += [Piece(named(page), text.replace(choice[0], word) if choice else text) for word in words]
    return list(dict.fromkeys(out))


# --- links -----------------------------------------------------------------------------------------------


def places(page: Path) -> set[str]:
    """Anchors of a page's headings, as forges and the built site name them."""
    heads = re.findall(r"^#+ (.*)$", _FENCE.sub("", page.read_text("utf-8")), re.M)
    words = (re.sub(r"[^\w\- ]", "", head.lower()).strip() for head in heads)
    return {word.replace(" ", "-") for word in words}


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)\s]+)", page.read_text("utf-8"))
    assert links
    for link in links:
        if link.startswith("https://"):
            continue
        path, _, place = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        if place:
            assert place in places(target), link


def test_what_the_drawing_of_the_conventions_imports_exists() -> None:
    tree = ast.parse((ROOT / "docs/draw_conventions.py").read_text("utf-8"))
    own = [
        n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and (n.module or "").startswith(("optics", "scenes"))
    ]
    assert own
    for node in own:
        module = importlib.import_module(node.module or "")
        assert all(hasattr(module, alias.name) for alias in node.names), node.module


# --- blocks of code --------------------------------------------------------------------------------------


def test_every_block_is_of_a_sort_that_is_tested() -> None:
    """YAML, tables and scripts below; blocks without a language are command lines, but for one drawing."""
    languages = {language for page in PAGES for language, _ in _FENCE.findall(page.read_text("utf-8"))}
    assert languages <= {"", "csv", "yaml", "python"}
    drawings = [block for block in blocks("") if not list(command_lines_of(block)) and block not in tables()]
    assert [block.page for block in drawings] == ["docs/architecture.md"]


def tables() -> list[Piece]:
    """Contents of CSV files."""
    return blocks("csv")


MEASURED = {
    "docs/measured_laboratory.md": (COMPARISON_COLUMNS, SPOT_COLUMNS, MTF_COLUMNS, IMAGE_COLUMNS),
    "docs/measured_orbit.md": tuple(COLUMNS.values()),
    "docs/finite_elements.md": (NODE_COLUMNS, HEAT_COLUMNS),
    "docs/stray_light.md": (COATING_COLUMNS,),
}
"""Page whose tables are measurements, or nodes, and no courses -> columns of the sorts of table that it shows."""
FRAMES = "docs/measured_frames.md"
"""Page whose tables list files of frames."""
ORBIT_FILES = "docs/orbit_files.md"
"""Its blocks are read by tests/twin/test_orbit_file_examples.py."""
NO_COURSES = (*MEASURED, FRAMES, ORBIT_FILES)


def models_of(text: str) -> list[type[Any]]:
    found = []
    for model in MODELS.values():
        try:
            validate(model, parse_yaml(text))
        except InputError:
            continue
        found.append(model)
    return found


@pytest.mark.parametrize("block", blocks("yaml"), ids=str)
def test_yaml_is_a_file_that_can_be_read(block: Piece, instrument, backend) -> None:
    models = models_of(block.text)
    assert models, "no sort of file"
    if models[0] is JobSpec:
        job = validate(JobSpec, parse_yaml(block.text))
        checked_nodes(job, instrument(job.instrument).nodes)
    if models[0] is DisturbancesSpec:
        motions_of_spec(validate(DisturbancesSpec, parse_yaml(block.text)), instrument("gf7_pair"))
    if models[0] is InstrumentSpec:
        spec = validate(InstrumentSpec, parse_yaml(block.text))
        build_instrument(spec, {site.camera: load_camera(site.camera) for site in spec.cameras.values()}, backend)


@pytest.mark.parametrize("block", [block for block in tables() if block.page in MEASURED], ids=str)
def test_a_table_of_measurements_can_be_read(block: Piece, tmp_path: Path) -> None:
    file = tmp_path / "table.csv"
    file.write_text(block.text, "utf-8")
    found = []
    for columns in MEASURED[block.page]:
        with contextlib.suppress(InputError):
            found.append(read_table(file, columns))
    assert len(found) == 1
    assert len(found[0]) == len(block.text.splitlines()) - 1


@pytest.mark.parametrize("block", [block for block in tables() if block.page == FRAMES], ids=str)
def test_a_table_of_frames_can_be_read(block: Piece, tmp_path: Path) -> None:
    heads, *rows = (line.split(",") for line in block.text.splitlines())
    for row in rows:
        (tmp_path / row[heads.index("file")]).touch()
    (tmp_path / "table.csv").write_text(block.text, "utf-8")
    channels = tuple(dict.fromkeys(row[heads.index("channel")] for row in rows))
    frames, times = read_frame_table(tmp_path / "table.csv", channels)
    assert sum(len(one.before) + sum(map(len, one.after)) for one in frames.values()) == len(rows)
    assert times


@pytest.mark.parametrize("block", [block for block in tables() if block.page not in NO_COURSES], ids=str)
def test_a_table_is_a_course_that_can_be_read(block: Piece, instrument, tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text(block.text, "utf-8")
    (tmp_path / "job.yaml").write_text("instrument: gf7_pair\ncourse: {table: table.csv}\n", "utf-8")
    job = resolve(tmp_path / "job.yaml").job
    checked_nodes(job, instrument("gf7_pair").nodes)
    assert job.course is not None
    assert len(job.course.times) == len(block.text.splitlines()) - 1


def test_yaml_blocks_that_are_wrong_are_found() -> None:
    assert blocks("yaml")
    assert models_of("instrument: gf7_pair\nrender: {frames: 9}\n") == [JobSpec]
    assert models_of("instrument: gf7_pair\nrender: {frame: 9}\n") == []
    assert models_of("instrument: gf7_pair\nperturb: {base/forward: {shift: [1, 2, 3]}}\n") == []


def yaml_spans() -> list[Piece]:
    """`render: {stray: true}`, but for those that stand for something, `{images: [...]}`, and those of a key alone."""
    return [p for p in spans() if re.match(r"[a-z_]+: [^.]", p.text) and "..." not in p.text]


@cache
def known_mappings() -> tuple[tuple[type[Any], dict[str, Any]], ...]:
    return tuple((model, example.mapping) for kind in MODELS for (model, _), example in examples(kind).items())


def fits_somewhere(text: str) -> bool:
    """Whether a model takes these keys in place of those of one of its examples."""
    data = parse_yaml(text).data
    return any(set(data) <= set(model.model_fields) and accepted(model, {**mapping, **data})
               for model, mapping in known_mappings())  # fmt: skip


@pytest.mark.parametrize("span", yaml_spans(), ids=str)
def test_yaml_within_a_sentence_fits_into_a_file(span: Piece) -> None:
    assert fits_somewhere(span.text)


def test_yaml_within_a_sentence_that_fits_nowhere_is_found() -> None:
    assert len(yaml_spans()) >= 4
    assert not fits_somewhere("render: {obstruct: ignore}")
    assert not fits_somewhere("quality: 3")


# --- command lines ---------------------------------------------------------------------------------------

LINE = re.compile(r"(?:bash|dask|export|python|\.venv/bin/python) ")


def command_lines_of(block: Piece) -> Iterator[Piece]:
    """Lines of a block that are typed: without what explains them, one for each command."""
    for line in block.text.splitlines():
        if LINE.match(line):
            # two blanks and more, or a hash, begin an explanation
            typed = re.split(r"\s+#|\s{2,}", line)[0]
            yield from (Piece(block.page, one.strip()) for one in typed.split("&&"))


def command_lines() -> list[Piece]:
    """All of README and docs: of the blocks, and within sentences; `twin.render JOB.yaml` in a table is one, too."""
    found = [line for block in blocks("") for line in command_lines_of(block)]
    modules = tuple(programs())
    for span in spans():
        first = span.text.split()[0]
        if LINE.match(span.text):
            found.append(span)
        elif first in modules and len(span.text.split()) > 1:
            found.append(Piece(span.page, f"python -m {span.text}"))
    return list(dict.fromkeys(found))


def check_line(line: str) -> None:
    """Let the parser of what a command line calls read it, without running anything.

    Raises:
        Exception: it would be refused, names a file that is not there, or calls nothing that is known here.
    """
    words = shlex.split(line)
    for word in words:
        if re.fullmatch(r"(scenes|docs|tests|twin)/\S+", word):
            assert (ROOT / word).exists(), word
    if words[0] == "export":
        check_variables(words[1:])
    elif words[0] == "dask":
        check_dask(words[1:])
    elif words[0] == "bash":
        assert words[1] == "setup.sh"
        options = set(re.findall(r"^  (--\w+)", (ROOT / "setup.sh").read_text("utf-8"), re.M))
        assert set(words[2:]) <= options
    else:
        assert words[0] in ("python", ".venv/bin/python")
        if words[1] != "-m":
            assert words[1].endswith(".py")
            assert len(words) == 2
            return
        check_module(words[2], words[3:])


def check_module(module: str, arguments: list[str]) -> None:
    if module == "NAME":
        return
    if module == "pytest":
        marks = [arguments[k + 1] for k, word in enumerate(arguments) if word == "-m"]
        known = re.findall(r'^    "(\w+): ', (ROOT / "pyproject.toml").read_text("utf-8"), re.M)
        for mark in filter(None, marks):
            Expression.compile(mark)
            assert set(re.findall(r"\w+", mark)) <= {*known, "not", "and", "or"}
        assert len(arguments) == 2 * len(marks)
        return
    command = parser(module)
    if arguments and arguments != ["--help"]:
        below = getattr(command, "commands", {})
        if below:
            # of twin.design the file says which subcommand it is
            arguments = getattr(command, "whole", list)(arguments)
            command, arguments = below[arguments[0]], arguments[1:]
        if arguments:
            try:
                command.make_context(module, arguments)
            except MissingParameter as missing:
                # a form that names the file alone, in a table of what there is, leaves options to --help
                if not (missing.param.opts[0].startswith("-") and all(word.isupper() for word in arguments)):
                    raise


def check_dask(words: list[str]) -> None:
    """By the parser of dask's own command, which wants certificates to exist."""
    module = importlib.import_module(f"distributed.cli.dask_{words[0]}")
    with tempfile.TemporaryDirectory() as place, contextlib.chdir(place):
        for word in words:
            if word.endswith(".pem"):
                Path(word).touch()
        module.main.make_context(words[0], words[1:])


def check_variables(words: list[str]) -> None:
    """DASK_A__B__C sets a.b.c, which must be a setting that the package knows; it writes hyphens for underscores."""
    dask_config = importlib.import_module("dask.config")
    importlib.import_module("distributed")
    for word in words:
        name, _, _ = word.partition("=")
        assert name.startswith("DASK_")
        key = name.removeprefix("DASK_").lower().replace("__", ".")
        here = dask_config.config
        for part in key.split("."):
            here = here[dask_config.canonical_name(part, here)]


@pytest.mark.parametrize("line", command_lines(), ids=str)
def test_a_command_line_is_one_that_its_parser_takes(line: Piece) -> None:
    check_line(line.text)


@pytest.mark.parametrize(
    "line",
    [
        "python -m twin.render scenes/examples/no_such.yaml",
        ".venv/bin/python -m twin.lab focus scenes/lab/focus.yaml --loud",
        "python -m twin.orbit watch FILE",
        "python -m twin.validate --fast yes no",
        "python -m pytest -m quick",
        "bash setup.sh --fast",
        "dask scheduler --no-such-option",
        "export DASK_DISTRIBUTED__COMM__TLS__NONSENSE=1",
        "curl something",
    ],
)
def test_a_wrong_command_line_is_found(line: str) -> None:
    with pytest.raises(BaseException):  # noqa: B017, PT011 (parsers of three libraries refuse, each in its way)
        check_line(line)


NOT_RUN = {
    "python -m twin.camera my_camera.yaml": "a file of the reader's; tests/twin/test_camera_command.py refocuses one",
    "python -m twin.camera camera.yaml": "a file that the lines before it make; tests/scenes/lens makes some",
    "python -m twin.camera runs/": "a run folder of the reader's own; tests/twin/test_camera_instrument.py opens one",
    "python -m twin.live gf7_pair": "serves until its last page is closed; tests/twin/test_live_process.py opens one",
    "python -m twin.compare RUN1": "run folders of the reader's own; tests/twin/test_compare.py compares some",
    "python -m twin.export": "run folders of the reader's own; tests/twin/test_run_export.py exports some",
    "python -m twin.operate": "a record of the reader's own; tests/twin/test_operate.py and those beside it make some",
    "python -m twin.render products/": "what the line before it makes; tests/twin/test_operate_products.py renders one",
    "python -m tests.mutation": "hours, a campaign of its own",
    "python -m tests.golden": "a test of its own runs it (tests/golden/test_golden.py)",
    "python -m tests.benchmarks": "a test of its own runs it (tests/benchmarks/test_limits.py)",
    "python -m pytest": "this is it",
    "python -m docs.figures": "overwrites figures and pages; tests/test_figures.py holds them together",
    "python -m twin.validate --fast": ".ci/run has it",
    "python -m docs.site": "a test of its own runs it (tests/test_site.py)",
    "python docs/draw_conventions.py": "overwrites a picture of the docs; a test of its own looks at what it imports",
    "python -m twin.validate --out": "the full run makes docs/validation; .ci/run has the fast one",
    "python -m twin.validate --seed": "the same",
    "bash setup.sh": "installs; .ci/run begins with it",
    "python -m docs.supply": "needs the package index; tests/test_supply.py holds what can be held without",
    "dask ": "needs machines and certificates of the user's",
    "export ": "is for such a cluster",
    "python -m NAME": "stands for all of them",
}
"""Beginning of a command line -> why no test here runs it, beside parsing it."""


def reason_not_run(line: str) -> str:
    bare = line.replace(".venv/bin/", "")
    for start, reason in NOT_RUN.items():
        if bare.startswith(start):
            return reason
    if "--help" in bare.split():
        return ""
    if "--scheduler" in bare.split():
        return "needs a cluster of the user's"
    # what stands in capitals is for the reader to fill in; without anything there is nothing to do
    words = [word for before, word in itertools.pairwise(bare.split()) if before != "--out"]
    if any(re.fullmatch(r"[A-Z][A-Z,]+(\.\w+)?", word) for word in words) or len(words) == 2:
        return "a form, or a name"
    return ""


def test_every_command_line_is_run_or_has_a_reason_not_to_be() -> None:
    lines = [line.text for line in command_lines()]
    run = [line for line in lines if not reason_not_run(line)]
    assert len(run) >= 10
    used = [start for start in NOT_RUN if any(line.replace(".venv/bin/", "").startswith(start) for line in lines)]
    assert set(NOT_RUN) - set(used) <= {"python -m docs.site"}


@pytest.mark.slow
@pytest.mark.parametrize("line", [line for line in command_lines() if not reason_not_run(line.text)], ids=str)
def test_a_command_line_does_what_it_says(line: Piece, tmp_path: Path) -> None:
    """As it stands, but into a folder of the test's."""
    words = [sys.executable, *shlex.split(line.text)[1:]]
    out = tmp_path / "run"
    if "--out" in words:
        # a file keeps its ending, by which a command knows its kind
        place = words.index("--out") + 1
        out = out.with_suffix(Path(words[place]).suffix)
        words[place] = str(out)
    elif "--help" not in words:
        words += ["--out", str(out)]
    done = subprocess.run(
        words, cwd=ROOT, env=os.environ | {"COLUMNS": "120"}, capture_output=True, text=True, timeout=3600, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "--help" in words or out.is_file() or any(out.iterdir())


@pytest.mark.parametrize("block", blocks("python"), ids=str)
def test_a_script_is_python(block: Piece) -> None:
    ast.parse(block.text)


@pytest.mark.slow
@pytest.mark.parametrize("block", blocks("python"), ids=str)
def test_a_script_runs(block: Piece, tmp_path: Path) -> None:
    file = tmp_path / "script.py"
    file.write_text(block.text, "utf-8")
    environment = os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    done = subprocess.run(
        [sys.executable, str(file)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]


def test_the_page_on_stability_names_what_there_is() -> None:
    page = (ROOT / "docs/stability.md").read_text("utf-8")
    commands, python = (re.findall(rf"\*\*{head}\*\*.*?(?=\n- )", page, re.S)[0] for head in ("Commands", "Python"))
    named_there = re.findall(r"`(?:camtwin )?(\w+)`", commands)
    assert sorted(named_there) == sorted(PROGRAMS)
    assert set(twin.__all__) <= set(re.findall(r"`(\w+)`", python))
