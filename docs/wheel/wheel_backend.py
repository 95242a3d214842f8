"""Build backend of the project (PEP 517).

In a wheel all packages are inside one, ``space_camera_twin``, because `optics` and `analysis` are names of other
packages on the index. The source tree keeps them at its top, and an editable installation uses that. Imports are
rewritten, and so are the command lines in help and messages; nothing else in the packages names a module of theirs. The
inserted text is always ``PREFIX`` and a dot, so that the program's digest (`twin.framework.provenance`) can exclude it.
"""

from __future__ import annotations

import ast
import contextlib
import re
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import (
    build_editable,
    build_sdist,
    get_requires_for_build_editable,
    get_requires_for_build_sdist,
    get_requires_for_build_wheel,
    prepare_metadata_for_build_editable,
)

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]

PREFIX = "space_camera_twin"
PACKAGES = ("analysis", "optics", "scenes", "twin")
DOCUMENTATION = '"""Digital twin of space mapping cameras; scripts say ``from space_camera_twin import twin``."""\n'
_COMMAND = re.compile(rf"\bpython -m (?=({'|'.join(PACKAGES)})\.|\{{)")


def rewritten(source: str) -> str:
    """Return a module's text as it is in a wheel.

    Raises
    ------
    ValueError
        The module has ``import optics`` and later uses ``optics.something``, a name that the prefix would change.
    """
    lines = source.splitlines(keepends=True)
    nodes = list(ast.walk(ast.parse(source)))
    used = {node.id for node in nodes if isinstance(node, ast.Name)}
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.level == 0 and _ours(node.module or ""):
            _insert(lines, node.lineno, f"from {node.module}", "from ")
        elif isinstance(node, ast.Import):
            for alias in filter(lambda alias: _ours(alias.name), node.names):
                if alias.asname is None and alias.name.partition(".")[0] in used:
                    raise ValueError(f"line {node.lineno}: import {alias.name} binds a name that wheels do not have")
                _insert(lines, alias.lineno, alias.name, "")
    return _COMMAND.sub(rf"\g<0>{PREFIX}.", "".join(lines))


def _ours(module: str) -> bool:
    """Return True if a module belongs to the project."""
    return module.partition(".")[0] in PACKAGES


def _insert(lines: list[str], number: int, found: str, before: str) -> None:
    """Insert the prefix into a line, before ``found`` and after ``before``."""
    at = lines[number - 1].index(found) + len(before)
    lines[number - 1] = f"{lines[number - 1][:at]}{PREFIX}.{lines[number - 1][at:]}"


def arrange(source: Path, place: Path) -> None:
    """Copy the project to a folder, arranged as in a wheel."""
    for package in PACKAGES:
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(source / package, place / PREFIX / package, ignore=ignored)
    for file in (place / PREFIX).rglob("*.py"):
        file.write_text(rewritten(file.read_text("utf-8")), "utf-8")
    # what keeps modules of the folder where a command starts from being run stands first in every package
    guard = (source / "scenes" / "__init__.py").read_text("utf-8").partition("\nimport os\n")
    (place / PREFIX / "__init__.py").write_text(f"{DOCUMENTATION}{''.join(guard[1:])}", "utf-8")
    (place / PREFIX / "py.typed").touch()
    for name in ("README.md", "LICENSE"):
        shutil.copy(source / name, place)
    project = (source / "pyproject.toml").read_text("utf-8")
    project = project.replace('"twin.', f'"{PREFIX}.twin.').replace('"twin/', f'"{PREFIX}/twin/')
    (place / "pyproject.toml").write_text(project, "utf-8")


@contextlib.contextmanager
def _arranged() -> Iterator[None]:
    """Arrange the project in a temporary folder and work there."""
    with tempfile.TemporaryDirectory(prefix="wheel-") as place:
        arrange(Path.cwd(), Path(place))
        with contextlib.chdir(place):
            yield


def build_wheel(
    wheel_directory: str, config_settings: dict[str, Any] | None = None, metadata_directory: str | None = None
) -> str:
    """Build the wheel into a folder and return its name (PEP 517)."""
    target = str(Path(wheel_directory).absolute())
    with _arranged():
        return build_meta.build_wheel(target, config_settings)


def prepare_metadata_for_build_wheel(metadata_directory: str, config_settings: dict[str, Any] | None = None) -> str:
    """Write the wheel's metadata into a folder and return its name (PEP 517)."""
    target = str(Path(metadata_directory).absolute())
    with _arranged():
        return build_meta.prepare_metadata_for_build_wheel(target, config_settings)
