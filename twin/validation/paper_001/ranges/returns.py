"""Kinds of return: by how much a spot moves when the line CCD does, and what the formulas then read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optics.backend import Backend
from scenes.resolved import ResolvedJob
from twin.validation.paper_001.ranges.bench import CORRECTED, Bench
from twin.validation.paper_001.ranges.defocus import gains, piston
from twin.validation.paper_001.ranges.variants import RETURNS, variant, with_return

SHIFT = 60e-6
"""Of the line CCD, metres."""


@dataclass(frozen=True, eq=False)
class Response:
    """What a kind of return does.

    Attributes:
        kind: of variants.RETURNS.
        across, along: (2,) motion of the spots (left, right) over the motion of the line CCD across and along the line.
        gain: (4,) corrected reading over truth, single changes.
        note: how pinhole and area CCD had to stand.
    """

    kind: str
    across: np.ndarray
    along: np.ndarray
    gain: np.ndarray
    note: str


_OFFSETS: dict[str, tuple[float, float] | None] = {
    "plane": None,
    "roof": None,
    "roof along": (0.0, 3e-3),
    "corner": (0.0, 0.0),
}
_NOTES = {
    "plane": "as built",
    "roof": "as built; the ridge lies across the line",
    "roof along": "the ridge lies along the line; the area CCD stands beside its pinhole along the line",
    "corner": "the spot falls on its own pinhole: the area CCD must see it through a beam splitter",
}


def responses(resolved: ResolvedJob, backend: Backend, like: Bench) -> list[Response]:
    """All kinds of return, by rendered images."""
    camera, pitch = like.cameras[0], resolved.instrument.monitor.area_ccd.pitch
    out = []
    for kind in RETURNS:
        built = with_return(variant(resolved, backend, camera, ccd_offset=_OFFSETS[kind]), kind)
        bench = Bench(built, like)
        states = [{}, piston(camera, 0.0, along=(SHIFT, 0.0)), piston(camera, 0.0, along=(0.0, SHIFT))]
        place = bench.positions(states)
        moved = (place[1:] - place[0]) * pitch / SHIFT
        # columns run along -X, rows along +Y
        out.append(Response(kind, -moved[0, :, 1], moved[1, :, 0], gains(bench)[CORRECTED], _NOTES[kind]))
    return out
