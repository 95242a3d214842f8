"""Which versions of what made a run, and which source files of the program itself."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
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


def versions() -> dict[str, str]:
    """Python's and the packages' versions; ``not installed`` where there is none."""
    out = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            out[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            out[package] = "not installed"
    return out


ROOT = Path(__file__).resolve().parents[2]
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
                out[name] = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    return out


def source_digest() -> str:
    """One checksum for all of ``sources``."""
    return hashlib.sha256(json.dumps(sources(), sort_keys=True).encode()).hexdigest()
