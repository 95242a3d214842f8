"""Imports go one way: optics <- scenes <- twin; analysis knows only the numerics of optics. Any other fails here."""

import ast
import re
import sys
from collections.abc import Iterator, Mapping, Set
from functools import cache
from graphlib import TopologicalSorter
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
    "turntable/dividing_error.py": {"sklearn"},
    "mtf/__main__.py": {"typer"},
    "mtf/mtf_command.py": {"typer", "rich", "matplotlib"},
    "images/image_file.py": {"tifffile", "astropy"},
    "wavefront_maps/map_files.py": {"h5py"},
}
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
LIBRARY = re.compile(r"twin|twin\.scripting\..*|twin\.study\.scripted")
"""What other people's programs import."""
TERMINALS = {"typer", "rich"}
"""What options, exit codes and progress are made of: the layer of the commands, ``twin.framework.cli`` and
``twin.framework.command``, begins there.
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


STATEMENT = re.compile(r"^ *((?:from [\w.]+ )?import (?:\([^)]*\)|[\w., ]+))(?= *(?:#.*)?$)", re.M)
"""An import, one on a line as ruff has them: to parse these alone takes a tenth of the time."""
BY_NAME = re.compile(r"(?:import_module|__import__)\(\s*[\"']([\w.]+)")


@cache
def imported_modules(path: Path) -> frozenset[str]:
    """Names of everything that a file imports, at any depth, also by importlib with a literal name; of what is imported
    from a module, the module's and the one that it would have as a module of its own.
    """
    source = path.read_text("utf-8")
    names = set(BY_NAME.findall(source))
    for node in ast.parse("\n".join(STATEMENT.findall(source))).body:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            # A relative import stays in its package.
            module = (node.module or "") if node.level == 0 else path.relative_to(ROOT).parts[0]
            names |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
    return frozenset(names)


@cache
def modules() -> dict[str, Path]:
    """Every module of the project by its dotted name -> its file, from the root."""
    files = [path.relative_to(ROOT) for path in source_files()]
    return {".".join(path.with_suffix("").parts).removesuffix(".__init__"): path for path in files}


@cache
def project_imports() -> tuple[tuple[str, str], ...]:
    """(importer, imported) for modules of the project, wherever in the file the import stands; but for the packages
    themselves, whose public names are imported from all their rooms when they are used.
    """
    return tuple(
        (importer, name)
        for importer, path in modules().items()
        for name in _finest(imported_modules(ROOT / path))
        if name != importer and importer not in PACKAGES
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


def forbidden(path: Path) -> set[str]:
    package = path.relative_to(ROOT).parts[0]
    shared = "optics.numerics" if package == "analysis" else " "
    names = {name.split(".")[0] for name in imported_modules(path) if not name.startswith(shared)}
    wrong = {name for name in names if name in PACKAGES} - MAY_IMPORT[package]
    if package == "optics":
        wrong |= names & NOT_IN_OPTICS
    if package == "analysis":
        wrong |= names - ONLY_IN_ANALYSIS - ANALYSIS_MAY.get(path.relative_to(ROOT / "analysis").as_posix(), set())
    return wrong


def test_imports_go_one_way() -> None:
    assert {path.relative_to(ROOT).parts[0] for path in source_files()} == set(PACKAGES)
    assert {str(path): forbidden(path) for path in source_files() if forbidden(path)} == {}


def test_a_wrong_arrow_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    for package, line, wrong in (
        ("optics", "def f():\n    from twin import render", {"twin"}),
        ("optics", "import ruamel.yaml", {"ruamel"}),
        ("analysis", "import importlib\nimportlib.import_module('optics.raytrace.trace')", {"optics"}),
        ("twin", "import numpy\nfrom analysis import centroid", set()),
    ):
        path = tmp_path / package / f"{len(line)}.py"
        path.parent.mkdir(exist_ok=True)
        path.write_text(line)
        assert forbidden(path) == wrong


def test_what_computes_neither_draws_nor_fills_templates() -> None:
    """Nor does anything that it imports: a study needs no figures, and a run can be shown in any way."""
    assert len({one.numbers.path.partition(":")[0] for one in PROCEDURES.values()}) == len(PROCEDURES)
    assert set(computing()) >= {*RUNS, *procedures(), "twin.design.design_run"}
    ways = {module: way_to(SHOWS, module, every_import()) for module in computing()}
    assert [" imports ".join(way) for way in ways.values() if way] == []


def test_the_library_knows_no_commands() -> None:
    """Nor does anything that it imports: a test's type, its run and its report lie below what a terminal shows."""
    library = [name for name in modules() if LIBRARY.fullmatch(name)]
    assert set(library) >= {"twin", "twin.scripting.results", "twin.study.scripted"}
    assert [" imports ".join(way) for name in library if (way := way_to(TERMINALS, name, every_import()))] == []
    assert way_to(TERMINALS, "twin.framework.command", every_import())


def test_source_knows_rooms_that_stand_above_its_own() -> None:
    """docs/architecture.md lists the rooms; an import goes to a room further up, or stays in its own."""
    wrong = []
    for importer, module in project_imports():
        here, there = room_of(importer), room_of(module)
        if here != there and ROOMS.index(there) > ROOMS.index(here):
            wrong.append(f"{importer} ({here}) imports {module} ({there})")
    assert wrong == []


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
