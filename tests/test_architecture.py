"""Imports go one way: optics <- scenes <- twin, and analysis stands alone. Any other arrow fails here."""

import ast
import sys
from pathlib import Path

import pytest

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
    "mtf/__main__.py": {"typer", "rich", "matplotlib"},
    "mtf/image_file.py": {"tifffile"},
}
LONGEST_FILE = 500


def source_files() -> list[Path]:
    return sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


def imported_modules(path: Path) -> set[str]:
    """Names of everything a file imports, at any depth, also by importlib with a literal name; of what is imported from
    a module, the module's and the one that it would have as a module of its own.
    """
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            # A relative import stays in its package.
            module = (node.module or "") if node.level == 0 else path.relative_to(ROOT).parts[0]
            names |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("importlib.import_module", "__import__"):
            first = node.args[0] if node.args else None
            if isinstance(first, ast.Constant) and isinstance(first.value, str):
                names.add(first.value)
    return names


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
        ("optics", "import scenes.load"),
        ("optics", "def f():\n    from twin import render"),
        ("optics", "import ruamel.yaml"),
        ("scenes", "from analysis.centroid import x"),
        ("analysis", "import drjit"),
        ("analysis", "import importlib\nimportlib.import_module('optics.trace')"),
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
    path.write_text("import numpy\nfrom analysis import centroid\nfrom scenes.load import load_job\nimport optics")
    assert forbidden(path) == set()
