"""Which versions of what made a run."""

from __future__ import annotations

import importlib.metadata
import platform

PACKAGES = (
    "space-camera-twin",
    "drjit",
    "mitsuba",
    "numpy",
    "scipy",
    "opencv-python-headless",
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
