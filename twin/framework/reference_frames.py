"""Reference frames of the numbers in a run's files, stated in each file.

Every JSON file of a run begins with ``schema`` (its kind and version) and ``reference_frames``, the reference of its
positions, velocities, directions, angles and times, and of tables or images beside it that cannot state their own.
netCDF files have the latter among their attributes. Axes and signs are those of docs/conventions.md.

The file reference_frames.json has, for every kind of file, the version of its keys (increased when keys are removed,
renamed or change their meaning), and quantity -> reference. A word in braces stands for one of the file's phrases.
"""

import json
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from optics.numerics.number_tree import FrozenMap
from scenes.specs.procedures import PROCEDURES

_FIRST = 2
"""Version of the keys of a test that defines its reference frames itself (not in reference_frames.json)."""
_READ = json.loads((files(__package__) / "reference_frames.json").read_text("utf-8"))
_VERSIONS: Mapping[str, int] = FrozenMap({kind: content["version"] for kind, content in _READ["files"].items()})
FRAMES: Mapping[str, Mapping[str, str]] = FrozenMap(
    {
        kind: {quantity: text.format_map(_READ["phrases"]) for quantity, text in content["frames"].items()}
        for kind, content in _READ["files"].items()
    }
)
"""Description of the reference frame of each quantity, by kind of file and quantity."""


def described(kind: str, data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the data of a file preceded by its schema and reference frames.

    Parameters
    ----------
    kind : str
        Kind of the file.
    data : mapping
        Content of the file, plain data.

    Raises
    ------
    KeyError
        The kind has no entry in `FRAMES` and is no test with its own `frames`.
    """
    if (frames := FRAMES.get(kind)) is None:
        frames = {procedure.kind: procedure.frames for procedure in PROCEDURES.values()}[kind]
    return {"schema": f"{kind} {_VERSIONS.get(kind, _FIRST)}", "reference_frames": dict(frames), **data}


def frames_text(kind: str) -> str:
    """Return the reference frames of a kind of file in one line, for an attribute."""
    return "; ".join(f"{quantity}: {frame}" for quantity, frame in FRAMES[kind].items())
