"""README and the pages in docs keep up with the code: links lead somewhere, YAML is what its schema takes, every
command line is one that the command's own parser takes, and those that do something do it.
"""

import ast
import contextlib
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from _pytest.mark.expression import Expression
from typer._click.exceptions import MissingParameter

from docs.site.command_pages import parser, programs
from scenes.models.disturbances import prior_of_spec
from scenes.models.instrument_builder import build_instrument
from scenes.schema import MODELS
from scenes.specs.disturbances import DisturbancesSpec
from scenes.specs.instrument import InstrumentSpec
from scenes.specs.job import JobSpec, checked_nodes
from scenes.specs.load import load_camera
from scenes.specs.monitor_frames import read_frame_table
from scenes.specs.resolved import resolve
from scenes.yaml.csv_table import read_table
from scenes.yaml.errors import InputError
from scenes.yaml.finish_files import COLUMNS as COATING_COLUMNS
from scenes.yaml.node_table import COLUMNS as NODE_COLUMNS
from scenes.yaml.node_table import HEAT_COLUMNS
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from tests.twin.commands import replaced
from twin.laboratory.measured_focus import IMAGE_COLUMNS, MTF_COLUMNS
from twin.laboratory.measured_readings import COMPARISON_COLUMNS, SPOT_COLUMNS
from twin.orbit.measured.measurement_tables import COLUMNS

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    *(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")),
    *sorted(page for page in (ROOT / "docs").rglob("*.md") if ROOT / "docs/site" not in page.parents),
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


def test_links_lead_somewhere() -> None:
    for page in PAGES:
        links = re.findall(r"\]\(([^)\s]+)", page.read_text("utf-8"))
        assert links, page
        for link in links:
            if link.startswith("https://"):
                continue
            path, _, place = link.partition("#")
            target = page.parent / path if path else page
            assert target.exists(), (page, link)
            assert not place or place in places(target), (page, link)


# --- blocks of code --------------------------------------------------------------------------------------


SORTS = (COMPARISON_COLUMNS, SPOT_COLUMNS, MTF_COLUMNS, IMAGE_COLUMNS, *COLUMNS.values(), NODE_COLUMNS, HEAT_COLUMNS)
SORTS = (*SORTS, COATING_COLUMNS)
"""Columns of the sorts of tables of measurements and nodes."""
ORBIT_FILES = "docs/orbit_files.md"
"""Its blocks are read by tests/twin/test_orbit_refusals.py."""


def models_of(text: str) -> list[type[Any]]:
    found = []
    for model in MODELS.values():
        try:
            validate(model, parse_yaml(text))
        except InputError:
            continue
        found.append(model)
    return found


@pytest.mark.second
def test_yaml_is_a_file_that_can_be_read(instrument, backend) -> None:
    for block in blocks("yaml"):
        models = models_of(block.text)
        assert models, f"no sort of file: {block}"
        spec = validate(models[0], parse_yaml(block.text))
        if models[0] is JobSpec:
            checked_nodes(spec, instrument(spec.instrument).nodes)
        if models[0] is DisturbancesSpec:
            prior_of_spec(spec, instrument("gf7_pair"))
        if models[0] is InstrumentSpec:
            build_instrument(spec, {site.camera: load_camera(site.camera) for site in spec.cameras.values()}, backend)


@pytest.mark.second
def test_a_table_is_one_that_can_be_read(instrument, tmp_path: Path) -> None:
    """As measurements or nodes, as files of frames, or as a course; every row of it."""
    for number, block in enumerate(block for block in blocks("csv") if block.page != ORBIT_FILES):
        file, rows = tmp_path / f"{number}.csv", len(block.text.splitlines()) - 1
        file.write_text(block.text, "utf-8")
        found = []
        for columns in SORTS:
            with contextlib.suppress(InputError):
                found.append(len(read_table(file, columns)))
        if "file" in (heads := block.text.splitlines()[0].split(",")) and not found:
            cells = [line.split(",") for line in block.text.splitlines()[1:]]
            for row in cells:
                (tmp_path / row[heads.index("file")]).touch()
            channels = tuple(dict.fromkeys(row[heads.index("channel")] for row in cells))
            frames, _ = read_frame_table(file, channels)
            found.append(sum(len(one.before) + sum(map(len, one.after)) for one in frames.values()))
        elif not found:
            (tmp_path / "job.yaml").write_text(f"instrument: gf7_pair\ncourse: {{table: {number}.csv}}\n", "utf-8")
            job = checked_nodes(resolve(tmp_path / "job.yaml").job, instrument("gf7_pair").nodes)
            assert job.course is not None
            found.append(len(job.course.times))
        assert found == [rows], block
    assert number > 5


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
    if words[0] in ("export", "dask"):
        return  # a cluster of the reader's
    if words[0] == "bash":
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
        assert set(arguments) - set(marks) <= {"-m", "--random-order", "SEED"}
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


@pytest.mark.second
def test_a_command_line_is_one_that_its_parser_takes() -> None:
    lines = command_lines()
    assert len(lines) > 200
    for line in lines:
        try:
            check_line(line.text)
        except BaseException as error:
            raise AssertionError(f"{line}: {error!r}") from error


def test_a_wrong_command_line_is_found() -> None:
    for line in ("python -m twin.render scenes/none.yaml", "python -m twin.orbit watch FILE", "bash setup.sh --fast"):
        with pytest.raises(BaseException):  # noqa: B017, PT011 (parsers of three libraries refuse, each in its way)
            check_line(line)


@pytest.mark.second
def test_scripts_run(tmp_path: Path) -> None:
    """Those that need nothing but the library: the README's, and that of the page on cameras."""
    scripts = {block.page: block.text for block in blocks("python")}
    text = "\n".join(scripts.pop(page) for page in ("README.md", "docs/camera.md"))
    text = replaced(text, ("n=100)", "n=26)"))  # two blocks
    for other in scripts.values():
        ast.parse(other)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    command = [sys.executable, "-c", text]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    assert re.search(r"d_f_um +-1\.210", done.stdout)
