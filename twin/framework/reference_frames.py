"""In which frames the numbers of a file are: stated in the file itself.

Every JSON file of a run begins with ``schema``, its kind and version, and ``reference_frames``, what its positions,
velocities, directions, angles and times refer to and, where a table or an image beside it cannot say so itself, what
those refer to. netCDF files have the latter among their attributes. Axes and signs are those of docs/conventions.md.

The statements stand in reference_frames.json: for every kind of file the version of its keys, which rises where keys
go, change their meaning or get another name, and quantity -> what it refers to. A word in braces is one of its phrases.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from optics.numerics.number_tree import FrozenMap
from scenes.specs.procedures import PROCEDURES

_FIRST = 2
"""Version of the keys of a test that states its frames itself."""
_READ = json.loads((files(__package__) / "reference_frames.json").read_text("utf-8"))
_VERSIONS: Mapping[str, int] = FrozenMap({kind: said["version"] for kind, said in _READ["files"].items()})
FRAMES: Mapping[str, Mapping[str, str]] = FrozenMap(
    {
        kind: {quantity: text.format_map(_READ["phrases"]) for quantity, text in said["frames"].items()}
        for kind, said in _READ["files"].items()
    }
)
"""Kind of file -> quantity -> what it refers to."""


def described(kind: str, data: Mapping[str, Any]) -> dict[str, Any]:
    """The data of a file with its schema and its frames before them.

    Parameters
    ----------
    kind : str
        Of the file.
    data : Mapping[str, Any]
        Its contents, plain data.

    Raises
    ------
    KeyError
        a kind without an entry in `FRAMES` or a test's `frames` of its own.
    """
    if (frames := FRAMES.get(kind)) is None:
        frames = {procedure.kind: procedure.frames for procedure in PROCEDURES.values()}[kind]
    return {"schema": f"{kind} {_VERSIONS.get(kind, _FIRST)}", "reference_frames": dict(frames), **data}


def frames_text(kind: str) -> str:
    """The statement in one line, for an attribute."""
    return "; ".join(f"{quantity}: {frame}" for quantity, frame in FRAMES[kind].items())
