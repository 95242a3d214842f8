"""Elementary motions of an instrument's bodies, and the families of them that the monitor is judged by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from analysis.arrays import ARCSEC
from optics.geometry.pose import triple
from optics.geometry.tree import ORIGIN, Motion, State
from scenes.models.instrument_model import Instrument
from scenes.specs.instrument import BASE, CENTRAL_PRISM

_UNITS = {"rotate": ("arcsec", ARCSEC), "shift": ("um", 1e-6), "scale": ("ppm", 1e-6), "figure": ("nm", 1e-9)}
_AXES = "XYZ"
FIGURE_TERMS = {4: "power", 5: "astigmatism", 6: "astigmatism", 7: "coma", 8: "coma"}
"""Figure terms in the tables, by Noll index."""


@dataclass(frozen=True)
class ElementaryMotion:
    """One component of the motion of one body.

    Attributes
    ----------
    body : str
        Its path.
    kind : str
        ``rotate``, ``shift``, ``scale`` or ``figure``.
    axis : int
        0, 1, 2 of the body's own frame (0 for a scale); the Noll index of a figure term.
    pivot : str
        Point that a rotation or a scale leaves in place.
    label : str
        Short name for tables.
    """

    body: str
    kind: str
    axis: int = 0
    pivot: str = ORIGIN
    label: str = ""

    @property
    def unit(self) -> str:
        """Name of the table unit: arcsec, um, ppm or nm."""
        return _UNITS[self.kind][0]

    @property
    def unit_size(self) -> float:
        """The table unit in SI."""
        return _UNITS[self.kind][1]

    @property
    def step(self) -> tuple[str, str, int]:
        """The derivative that ``Assembly.place`` takes."""
        return self.body, self.kind, self.axis

    def motion(self, amount: float) -> Motion:
        """The motion of this size, SI."""
        along = triple(amount if self.axis == a else 0.0 for a in range(3))
        match self.kind:
            case "rotate":
                return Motion(rotate=along, pivot=self.pivot)
            case "shift":
                return Motion(shift=along, pivot=self.pivot)
            case "scale":
                return Motion(scale=amount, pivot=self.pivot)
            case "figure":
                return Motion(figure={self.axis: amount}, pivot=self.pivot)
            case _:
                raise ValueError(f"a motion is a rotate, shift, scale or figure, not a {self.kind!r}")

    def state(self, amount: float) -> State:
        """The state in which only this motion of the given size, SI, is applied."""
        return {self.body: self.motion(amount)}


def line_family(camera: str) -> tuple[ElementaryMotion, ...]:
    """The four motions of paper 001's own derivation: the line CCD shifted along X and Y and turned about Z, the
    optics scaled.

    The scale grows mirrors and spacings together and keeps the focal plane at focus, with detectors of unchanged
    size: a change of the principal distance and of nothing else.
    """
    plane = f"{BASE}/{camera}/focal_plane"
    return (
        ElementaryMotion(plane, "shift", 0, label="line CCD along X"),
        ElementaryMotion(plane, "shift", 1, label="line CCD along Y"),
        ElementaryMotion(plane, "rotate", 2, label="line CCD about Z"),
        ElementaryMotion(f"{BASE}/{camera}", "scale", label="whole camera scaled"),
    )


def other_motions(instrument: Instrument, camera: str) -> tuple[ElementaryMotion, ...]:
    """All other motions that can reach this camera's spots: focal plane, each mirror and its low figure terms, the
    camera, the reference.
    """
    model = instrument.cameras[camera]
    root = f"{BASE}/{camera}"
    out = [
        ElementaryMotion(f"{root}/focal_plane", "shift", 2, label="focal plane along Z (piston)"),
        ElementaryMotion(f"{root}/focal_plane", "rotate", 0, label="focal plane about X (tilt)"),
        ElementaryMotion(f"{root}/focal_plane", "rotate", 1, label="focal plane about Y (tilt)"),
    ]
    for mirror in model.mirrors:
        out += _six(f"{root}/{mirror}", mirror, "centre")
        out += [
            ElementaryMotion(f"{root}/{mirror}", "figure", j, label=f"{mirror} figure Z{j} ({name})")
            for j, name in FIGURE_TERMS.items()
        ]
    out += _six(root, "camera", ORIGIN)
    out += _six(CENTRAL_PRISM, "central prism", ORIGIN)[3:]
    return tuple(out)


def _six(body: str, name: str, pivot: str) -> list[ElementaryMotion]:
    shifts = [ElementaryMotion(body, "shift", a, pivot, f"{name} along {_AXES[a]}") for a in range(3)]
    return shifts + [ElementaryMotion(body, "rotate", a, pivot, f"{name} about {_AXES[a]}") for a in range(3)]


def pivot_states(motions: Sequence[ElementaryMotion]) -> list[State]:
    """Unperturbed states that name each motion's pivot and figure term, for derivatives about it."""
    return [m.state(0.0) for m in motions]
