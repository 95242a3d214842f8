"""Elementary motions of an instrument's bodies, and the families of motions used to evaluate the monitor."""

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
"""Noll index -> name, for each Zernike term of a mirror's figure that the tables contain."""


@dataclass(frozen=True)
class ElementaryMotion:
    """One component of the motion of one body: a rotation, a shift, a change of size or a figure term.

    Attributes
    ----------
    body : str
        Path of the body.
    kind : str
        ``rotate``, ``shift``, ``scale`` or ``figure``.
    axis : int
        Axis 0, 1, 2 of the body's own frame (0 for a scale); the Noll index of a figure term.
    pivot : str
        Fixed point of a rotation or a scale.
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
        """Unit of the motion in tables: arcsec, um, ppm or nm."""
        return _UNITS[self.kind][0]

    @property
    def unit_size(self) -> float:
        """Size of the unit used in tables, in SI units (1e-6 for um)."""
        return _UNITS[self.kind][1]

    @property
    def step(self) -> tuple[str, str, int]:
        """Body, kind and axis of the motion, as ``Assembly.place`` needs them for the derivative."""
        return self.body, self.kind, self.axis

    def motion(self, amount: float) -> Motion:
        """Return the motion of the body by an amount in SI units."""
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
        """Return the state of the instrument with only this motion, of the given amount in SI units."""
        return {self.body: self.motion(amount)}


def line_family(camera: str) -> tuple[ElementaryMotion, ...]:
    """Return the four motions for which paper 001 (Wang et al. 2018) derives its formulas.

    They are the line CCD shifted along X and Y and rotated about Z, and the optics scaled. The scale enlarges mirrors
    and spacings together and keeps the focal plane in focus, with detectors of unchanged size: it changes the principal
    distance and nothing else.
    """
    plane = f"{BASE}/{camera}/focal_plane"
    return (
        ElementaryMotion(plane, "shift", 0, label="line CCD along X"),
        ElementaryMotion(plane, "shift", 1, label="line CCD along Y"),
        ElementaryMotion(plane, "rotate", 2, label="line CCD about Z"),
        ElementaryMotion(f"{BASE}/{camera}", "scale", label="whole camera scaled"),
    )


def other_motions(instrument: Instrument, camera: str) -> tuple[ElementaryMotion, ...]:
    """Return all other motions that can affect this camera's spots.

    They are motions of the focal plane, of each mirror with its low-order figure terms, of the camera, and of the
    reference.
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
    """Return the three shifts and three rotations of a body as elementary motions."""
    shifts = [ElementaryMotion(body, "shift", a, pivot, f"{name} along {_AXES[a]}") for a in range(3)]
    return shifts + [ElementaryMotion(body, "rotate", a, pivot, f"{name} about {_AXES[a]}") for a in range(3)]


def pivot_states(motions: Sequence[ElementaryMotion]) -> list[State]:
    """Return for each motion the unperturbed state, with the motion's pivot and (at zero amplitude) its figure term.

    Derivatives with respect to the motions are taken about these states.
    """
    return [m.state(0.0) for m in motions]
