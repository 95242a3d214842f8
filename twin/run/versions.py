"""Which versions of what made a run, and which source files of the program itself."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
import re
from functools import cache
from pathlib import Path

PACKAGES = (
    "space-camera-twin",
    "drjit",
    "mitsuba",
    "numpy",
    "scipy",
    "opencv-python-headless",
    "pyerfa",
    "pyproj",
    "scikit-fem",
    "scikit-learn",
    "trimesh",
    "karellen-llvm-core",
)
"""Those whose numbers results depend on."""


def versions() -> dict[str, str]:
    """Python's and the packages' versions; ``not installed`` where there is none."""
    return {
        "python": platform.python_version(),
        **{package: _version(package) or "not installed" for package in PACKAGES},
    }


@cache
def other_packages() -> dict[str, str]:
    """Versions of the packages that the program asks for beside PACKAGES: they read, write and draw, and no number
    depends on them.
    """
    try:
        asked = importlib.metadata.requires(PACKAGES[0]) or []
    except importlib.metadata.PackageNotFoundError:
        return {}
    named = (_PACKAGE.match(line) for line in asked if "extra ==" not in line)
    names = sorted({found[0] for found in named if found is not None} - set(PACKAGES))
    return {name: version for name in names if (version := _version(name)) is not None}


_PACKAGE = re.compile(r"[A-Za-z0-9._-]+")


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


ROOT = Path(__file__).resolve().parents[2]
BEFORE = __name__.removesuffix("twin.run.versions")
"""What stands before the names of modules: nothing in a source tree, in a wheel the one package that holds all others
(docs/wheel).
"""
SOURCES = ("analysis", "optics", "scenes", "twin")
NOT_IN_RUNS = ("twin/validation/",)
"""No run of a study needs these."""


@cache
def sources() -> dict[str, str]:
    """Source files that compute, as this process found them first -> checksum; comments and docstrings count.

    To leave these out every file would have to be parsed, a second or two for every command, and nobody edits the
    program in the middle of a study just to rephrase it.
    """
    out = {}
    for package in SOURCES:
        for path in sorted((ROOT / package).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            if not name.startswith(NOT_IN_RUNS):
                out[name] = _checksum(path)[:16]
    return out


def _checksum(path: Path) -> str:
    """Of a file as the source tree has it."""
    text = path.read_bytes()
    return hashlib.sha256(text.replace(BEFORE.encode(), b"") if BEFORE and path.suffix == ".py" else text).hexdigest()


def source_digest() -> str:
    """One checksum for all of ``sources``."""
    return hashlib.sha256(json.dumps(sources(), sort_keys=True).encode()).hexdigest()


ENDINGS = (".css", ".csv", ".html", ".j2", ".js", ".py", ".svg", ".txt", ".yaml")
"""Of the packages' own files, as a wheel holds them."""


@cache
def program_digest() -> str:
    """One SHA-256 for every file of the program as this process found them first: code, library, templates; the same
    for a source tree and for what was installed from it.
    """
    every = {}
    for package in SOURCES:
        for path in sorted((ROOT / package).rglob("*")):
            if path.suffix in ENDINGS and path.is_file():
                every[path.relative_to(ROOT).as_posix()] = _checksum(path)
    return hashlib.sha256(json.dumps(every, sort_keys=True).encode()).hexdigest()
