"""Imports go one way: optics <- scenes <- twin, and analysis stands alone. Any other arrow fails here."""

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from scenes.specs.procedures import PROCEDURES

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("optics", "scenes", "twin", "analysis")
MAY_IMPORT = {
    "optics": {"optics"},
    "scenes": {"optics", "scenes"},
    "twin": {"optics", "scenes", "twin", "analysis"},
    "analysis": {"analysis"},
}
# optics knows nothing of YAML, commands or Mitsuba scenes.
NOT_IN_OPTICS = {"ruamel", "yaml", "pydantic", "pint", "typer", "rich", "mitsuba", "matplotlib"}
# analysis must be usable on real images, without the twin's renderers.
ONLY_IN_ANALYSIS = {"analysis", "numpy", "scipy", "cv2"} | sys.stdlib_module_names
# Modules of analysis that may use more: commands that draw, and fits that need a library. Name each module here.
ANALYSIS_MAY: dict[str, set[str]] = {
    "turntable/angle_network.py": {"sklearn"},
    "mtf/__main__.py": {"typer"},
    "mtf/mtf_command.py": {"typer", "rich", "matplotlib"},
    "images/tiff_image.py": {"tifffile"},
    "images/fits_image.py": {"astropy"},
    "wavefront_maps/zygo_files.py": {"h5py"},
}
LONGEST_FILE = 600
MOST_FILES = 28
# what draws and what fills templates
SHOWS = {"matplotlib", "jinja2"}
COMPUTE = (
    "optics",
    "scenes",
    "analysis",
    "twin/sensors",
    "twin/monitor",
    "twin/targets",
    "twin/path_tracing",
    "twin/orbit/flight",
    "twin/orbit/ground",
    "twin/study/runs",
)
"""Folders in which nothing draws, with all below them; beside them the modules of tests that compute, and RUNS."""
RUNS = {
    "twin.main_job.render_job",
    "twin.main_job.render_files",
    "twin.study.gradient.study_gradient",
    "twin.study.study_files",
    "twin.uncertainty.uncertainty_numbers",
}
"""What computes where no procedure is made of it, and writes what was computed."""
COMMANDS = {"analysis.mtf.__main__", "analysis.mtf.mtf_command"}
INSIDE = re.compile(
    r"twin\.(camera|compare|design|export|live|main_job|recover|study|uncertainty|verify)(\..*)?"
    r"|twin\..*_(report|numbers|plots?|sections?|tables|content|export|command)"
    r"|twin\.run\.(cli|command|console|page|report|run_folder)"
    r"|twin\.orbit\.calibration\.(field_images|observations|flown_campaign|influences|screening)"
)
"""What the validation does not import: commands, what shows and writes results, and the steps of `source_of`."""
LIBRARY = re.compile(r"twin|twin\.scripting\..*|twin\.study\.scripted")
"""What other people's programs import."""
TERMINALS = {"typer", "rich"}
"""What options, exit codes and progress are made of: the layer of the commands, ``twin.run.cli`` and
``twin.run.command``, begins there.
"""
ROOMS = [
    *re.findall(
        r"^\| `((?:optics|scenes|analysis|twin)[a-z_/]*)` \|", (ROOT / "docs/architecture.md").read_text("utf-8"), re.M
    ),
    *(name for name in PACKAGES if name != "analysis"),
]
"""As the page lists them, which is the order in which they may know each other; the packages' own files come last."""


def source_files() -> list[Path]:
    return sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


BY_NAME = "import_module", "__import__"


@dataclass(frozen=True)
class Content:
    """What is asked of a file of the source, which no test changes.

    Attributes:
        imports: names of everything it imports, at any depth, also by importlib with a literal name; of what is
            imported from a module, the module's and the one that it would have as a module of its own.
        texts: line and content of every text that a program can show: docstrings are none.
    """

    imports: frozenset[str]
    texts: tuple[tuple[int, str], ...]


@cache
def content(path: Path) -> Content:
    """Of one reading and one walk: trees of all files are too many to keep."""
    names: set[str] = set()
    shown: dict[ast.Constant, tuple[int, str]] = {}
    silent: set[ast.expr] = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Constant):
            if isinstance(node.value, str):
                shown[node] = (node.lineno, node.value)
        elif isinstance(node, ast.Expr):
            silent.add(node.value)
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            # A relative import stays in its package.
            module = (node.module or "") if node.level == 0 else path.relative_to(ROOT).parts[0]
            names |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in BY_NAME:
            first = node.args[0] if node.args else None
            if isinstance(first, ast.Constant) and isinstance(first.value, str):
                names.add(first.value)
    return Content(frozenset(names), tuple(text for one, text in shown.items() if one not in silent))


def imported_modules(path: Path) -> frozenset[str]:
    return content(path).imports


@cache
def modules() -> dict[str, Path]:
    """Every module of the project by its dotted name -> its file, from the root."""
    files = [path.relative_to(ROOT) for path in source_files()]
    return {".".join(path.with_suffix("").parts).removesuffix(".__init__"): path for path in files}


@cache
def project_imports() -> tuple[tuple[str, str], ...]:
    """(importer, imported) for modules of the project, wherever in the file the import stands."""
    return tuple(
        (importer, name)
        for importer, path in modules().items()
        for name in _finest(imported_modules(ROOT / path))
        if name != importer
    )


def _finest(names: Set[str]) -> Iterator[str]:
    """The modules among names; a package counts only where nothing below it was meant, and one at the top never: every
    import of what is in it runs it.
    """
    known = {name for name in names if name in modules() and name not in PACKAGES}
    for name in known:
        is_package = modules()[name].name == "__init__.py"
        if not (is_package and any(other.startswith(name + ".") for other in known)):
            yield name


def procedures() -> set[str]:
    """Modules that run a test or make its numbers, as the list of tests names them."""
    return {function.path.partition(":")[0] for one in PROCEDURES.values() for function in (one.run, one.numbers)}


def computing() -> list[str]:
    """Modules that compute: those in `COMPUTE` and `RUNS`, and every one that runs a test or makes its numbers."""
    return [
        module
        for module, path in modules().items()
        if module not in COMMANDS
        and (
            module in RUNS
            or any(folder in COMPUTE for folder in map(Path.as_posix, path.parents))
            or module in procedures()
        )
    ]


def way_to(names: set[str], module: str, imports: Mapping[str, Set[str]]) -> list[str]:
    """Module -> ... -> what it imports of ``names``, the shortest way; empty for none."""
    ways, seen = [[module]], {module}
    for way in ways:
        for name in sorted(imports.get(way[-1], ())):
            if name.split(".")[0] in names:
                return [*way, name]
            if name in modules() and name not in seen:
                seen.add(name)
                ways.append([*way, name])
    return []


@cache
def every_import() -> dict[str, frozenset[str]]:
    """Module -> all that it imports, of the project and of others."""
    return {module: imported_modules(ROOT / path) for module, path in modules().items()}


def room_of(module: str) -> str:
    """The room that a module stands in: the longest folder in the list that holds it."""
    folder = modules()[module].parent
    return next(place.as_posix() for place in (folder, *folder.parents) if place.as_posix() in ROOMS)


def imported(path: Path) -> set[str]:
    """Top-level names of everything a file imports."""
    return {name.split(".")[0] for name in imported_modules(path)}


def forbidden(path: Path) -> set[str]:
    package = path.relative_to(ROOT).parts[0]
    names = imported(path)
    wrong = {name for name in names if name in PACKAGES} - MAY_IMPORT[package]
    if package == "optics":
        wrong |= names & NOT_IN_OPTICS
    if package == "analysis":
        wrong |= names - ONLY_IN_ANALYSIS - ANALYSIS_MAY.get(path.relative_to(ROOT / "analysis").as_posix(), set())
    return wrong


def test_enough_files_are_checked() -> None:
    files = source_files()
    assert len(files) > 10
    assert {path.relative_to(ROOT).parts[0] for path in files} >= {"optics", "scenes", "twin"}


@pytest.mark.parametrize("path", source_files(), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_one_way(path: Path) -> None:
    assert forbidden(path) == set()


@pytest.mark.parametrize("path", source_files(), ids=lambda path: str(path.relative_to(ROOT)))
def test_files_can_be_read_in_one_sitting(path: Path) -> None:
    assert len(path.read_text("utf-8").splitlines()) <= LONGEST_FILE


@pytest.mark.parametrize(
    ("package", "line"),
    [
        ("optics", "import scenes.specs.load"),
        ("optics", "def f():\n    from twin import render"),
        ("optics", "import ruamel.yaml"),
        ("scenes", "from analysis.spots.centroid import x"),
        ("analysis", "import drjit"),
        ("analysis", "import importlib\nimportlib.import_module('optics.raytrace.trace')"),
    ],
)
def test_a_wrong_arrow_is_found(package: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    path = tmp_path / package / "module.py"
    path.parent.mkdir()
    path.write_text(line)
    assert forbidden(path)


def test_a_right_arrow_is_not_complained_about(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    path = tmp_path / "twin" / "module.py"
    path.parent.mkdir()
    path.write_text(
        "import numpy\nfrom analysis import centroid\nfrom scenes.specs.load import load_job\nimport optics"
    )
    assert forbidden(path) == set()


def test_what_computes_neither_draws_nor_fills_templates() -> None:
    """Nor does anything that it imports: a study needs no figures, and a run can be shown in any way."""
    assert len({one.numbers.path.partition(":")[0] for one in PROCEDURES.values()}) == len(PROCEDURES)
    assert set(computing()) >= {*RUNS, *procedures(), "twin.design.design_run"}
    ways = {module: way_to(SHOWS, module, every_import()) for module in computing()}
    assert [" imports ".join(way) for way in ways.values() if way] == []


def test_the_library_knows_no_commands() -> None:
    """Nor does anything that it imports: a test's type, its run and its report lie below what a terminal shows."""
    library = [name for name in modules() if LIBRARY.fullmatch(name)]
    assert set(library) >= {"twin", "twin.scripting.procedures", "twin.scripting.results", "twin.study.scripted"}
    assert [" imports ".join(way) for name in library if (way := way_to(TERMINALS, name, every_import()))] == []
    assert way_to(TERMINALS, "twin.run.command", every_import())


def test_the_way_to_what_draws_is_found() -> None:
    imports = {"twin.lab": {"numpy", "twin.run.page", "twin.run.report"}, "twin.run.page": {"jinja2.sandbox"}}
    assert way_to(SHOWS, "twin.lab", imports) == ["twin.lab", "twin.run.page", "jinja2.sandbox"]
    assert way_to(SHOWS, "twin.run.report", imports) == []
    # reports do draw
    assert way_to(SHOWS, "twin.laboratory.focus_report", every_import())[-1].startswith("matplotlib")


@pytest.mark.parametrize("once", [r"write_json\(MANIFEST\b", r"\bEnvironment\("], ids=["manifest", "templates"])
def test_one_place_writes_manifests_and_one_finds_templates(once: str) -> None:
    found = [path.relative_to(ROOT).as_posix() for path in source_files() if re.search(once, path.read_text("utf-8"))]
    assert len(found) == 1, found


@pytest.mark.slow
def test_nothing_that_computes_loads_matplotlib() -> None:
    """Not through other people's packages either. (Those of a cluster load jinja2 for pages of their own.)"""
    names = [name for name in computing() if not name.startswith("scenes.library")]
    code = f"import sys, importlib\nfor n in {names}: importlib.import_module(n)\nprint('matplotlib' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"


def test_source_knows_rooms_that_stand_above_its_own() -> None:
    """docs/architecture.md lists the rooms; an import goes to a room further up, or stays in its own."""
    wrong = []
    for importer, module in project_imports():
        here, there = room_of(importer), room_of(module)
        if here != there and ROOMS.index(there) > ROOMS.index(here):
            wrong.append(f"{importer} ({here}) imports {module} ({there})")
    assert wrong == []


def inside(importer: str, source: str) -> list[str]:
    """What a module of the validation takes from the inside of the twin: names with an underscore, what shows or writes
    results, and what other modules do for every caller (`INSIDE`).
    """
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and not (node.module or "").startswith("twin.validation"):
            names = [alias.name for alias in node.names]
            found += [f"{node.module}.{name}" for name in names if name.startswith("_")]
            found += [m for m in (node.module, *(f"{node.module}.{n}" for n in names)) if m and INSIDE.fullmatch(m)]
        elif isinstance(node, ast.Attribute) and re.match("_[a-z]", node.attr):
            if ast.unparse(node.value) not in ("self", "cls"):
                found.append(ast.unparse(node))
    return [f"{importer}: {name}" for name in dict.fromkeys(found)]


@pytest.mark.parametrize("path", sorted((ROOT / "twin/validation").rglob("*.py")), ids=lambda path: path.stem)
def test_the_validation_is_a_user(path: Path) -> None:
    """It takes what a user may call; its report alone writes a run folder, as a command does."""
    if path.stem != "validation_report":
        assert inside(path.stem, path.read_text("utf-8")) == []


@pytest.mark.parametrize(
    "line",
    [
        "from twin.laboratory.distortion_run import _locate",
        "from twin.laboratory import focus_report",
        "from twin.orbit.calibration.flown_campaign import fly_fields",
        "def f(bench): return bench._cache",
    ],
)
def test_what_the_validation_takes_from_the_inside_is_found(line: str) -> None:
    assert len(inside("module", line)) == 1


def test_every_folder_of_the_source_is_in_a_room() -> None:
    assert {room_of(module) for module in modules()} | {"scenes/library"} == set(ROOMS)


def test_no_module_imports_itself_by_way_of_others() -> None:
    """Also not inside a function or for type checkers alone."""
    graph: dict[str, set[str]] = {module: set() for module in modules()}
    for importer, module in project_imports():
        graph[importer].add(module)
    TopologicalSorter(graph).prepare()


def test_no_folder_imports_itself_by_way_of_others() -> None:
    graph: dict[str, set[str]] = {}
    for importer, module in project_imports():
        here, there = (modules()[name].parent.as_posix() for name in (importer, module))
        if here != there:
            graph.setdefault(here, set()).add(there)
    TopologicalSorter(graph).prepare()


def test_a_cycle_would_be_found() -> None:
    with pytest.raises(CycleError):
        TopologicalSorter({"a": {"b"}, "b": {"a"}}).prepare()


OF_PAPERS = re.compile(r"\bpapers?\b|\bTable \d|\bFig\. \d", re.I)
"""A command's help cites where its method is from, in a text that ends with it; results never speak of papers."""


@pytest.mark.parametrize("room", ["analysis", "twin/laboratory", "twin/orbit"])
def test_general_commands_know_no_paper(room: str) -> None:
    """What papers print, and whether it holds, is said by the validation; docstrings cite them."""
    files = sorted((ROOT / room).rglob("*.py"))
    assert len(files) > 10
    told = [
        f"{path.relative_to(ROOT)}:{line}: {text[:60]!r}"
        for path in files
        if path.name != "__main__.py"
        for line, text in content(path).texts
        if OF_PAPERS.search(text)
    ]
    assert not told, "\n".join(told)


OTHER_SIGNS = {"\N{GREEK SMALL LETTER MU}m": "µm", "\N{DOUBLE PRIME}": "arcsec", "\N{ANGSTROM SIGN}": "nm"}
"""How lengths and angles are not written, and how they are: µ is the micro sign."""
UNIT_AFTER_COMMA = re.compile(r"[^,;:.]{2,}, (µm|um|mm|m|km|arcsec|arcmin|px|deg|DN|min)")
"""Of a table's head or a figure's axis; units stand in brackets there."""


@pytest.mark.parametrize("room", ["twin", "analysis"])
def test_one_notation_for_units(room: str) -> None:
    """In everything that a command can show; the checks quote papers, and their pages put that into the same units."""
    found = []
    for path in sorted((ROOT / room).rglob("*.py")):
        place = path.relative_to(ROOT).as_posix()
        if place.startswith("twin/validation/") or place == "analysis/mtf/mtf_command.py":
            # the latter reads what users write, in whichever letter
            continue
        for line, text in content(path).texts:
            if any(sign in text for sign in OTHER_SIGNS) or (room == "twin" and UNIT_AFTER_COMMA.fullmatch(text)):
                found.append(f"{place}:{line}: {text[:60]!r}")
    assert not found, "\n".join(found)


def test_folders_are_small_enough_to_look_through() -> None:
    count = Counter(path.parent.as_posix() for path in modules().values())
    assert {folder: number for folder, number in count.items() if number > MOST_FILES} == {}


ARRAYS = re.compile(r"\b(ndarray|NDArray|ArrayLike|Array)\b")


def arguments_not_described(source: str) -> list[str]:
    """``function: argument`` of what public functions and methods with three arguments and more, that take or give
    arrays, leave out under ``Args:``.
    """
    found = []
    bodies = [body for body in ast.parse(source).body if not getattr(body, "name", "_").startswith("_")]
    for node in (n for body in bodies for n in (body.body if isinstance(body, ast.ClassDef) else [body])):
        if not isinstance(node, ast.FunctionDef) or node.name.startswith("_"):
            continue
        arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        given = [a for a in arguments if a.arg not in ("self", "cls")]
        types = [ast.unparse(t) for t in (*(a.annotation for a in given), node.returns) if t is not None]
        if len(given) > 2 and any(ARRAYS.search(t) for t in types):
            listed = (ast.get_docstring(node) or "").partition("Args:\n")[2].partition("\n\n")[0]
            known = set(re.findall(r"^    (\w+): \S", listed, re.M))
            found += [f"{node.name}: {a.arg}" for a in given if a.arg not in known]
    return found


@pytest.mark.parametrize("path", [p for p in source_files() if p.relative_to(ROOT).parts[0] in ("optics", "analysis")])
def test_arrays_of_public_functions_are_described(path: Path) -> None:
    """Shapes, units and signs stand with the arguments."""
    assert arguments_not_described(path.read_text("utf-8")) == []


def test_an_argument_that_is_not_described_would_be_found() -> None:
    source = '''
def f(a: Array, b: int, c: int) -> int:
    """Text that names a, b and c.

    Args:
        a: (N,), metres.
        c: of it.

    Returns:
        b: something.
    """
'''
    assert arguments_not_described(source) == ["f: b"]
    assert arguments_not_described(source.replace("a: Array", "a: int")) == []
    assert arguments_not_described(source.replace("def f", "def _f")) == []


def test_no_folder_of_the_source_is_ignored_by_git() -> None:
    """What .gitignore hides, ruff does not check, and a new file in it is never committed."""
    ignored = {line.strip("/") for line in (ROOT / ".gitignore").read_text("utf-8").split() if not line.startswith("/")}
    folders = {part for path in modules().values() for part in path.parent.parts}
    assert folders & ignored == set()
