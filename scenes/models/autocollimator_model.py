"""From the YAML of a test with two autocollimators to the optical assembly: autocollimators, turntable, mirrors.

Frames, all right-handed. System frame 1-XYZ (paper 001, section 3.1): X up, Y horizontal, Z = X x Y along the
view of autocollimator 1, from its lens to its mirror; the origin is where the turntable's three axes cross.
Frame 2-XYZ is frame 1 turned about X by b = 2 theta, so that

    Y1 = Y2 cos b - Z2 sin b,    Z1 = Y2 sin b + Z2 cos b.

A mirror's frame is that of its autocollimator turned by half a turn about Y: its +z is its normal, toward the lens. A
lens's frame is likewise turned, with +z toward the focal plane. Area CCD: columns along the autocollimator's +Y, rows
along its -X, facing the lens; a turn of the mirror by +X moves the spot to larger columns, by +Y to larger rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optics.geometry.aperture import Circle
from optics.geometry.pose import Pose, about_axis
from optics.geometry.surface import Surface, plane
from optics.geometry.tree import Body, RigidTree
from optics.materials.glass import glass
from optics.raytrace.assembly import Assembly, Element, Interaction
from scenes.specs.autocollimators import AutocollimatorTestSpec, LensSpec

BENCH = "bench"
AXES = ("X", "Y", "Z")
UNITS = (1, 2)
"""The two autocollimators, each with its mirror."""

_ABOUT_Y = np.diag([-1.0, 1.0, -1.0])  # half a turn
_DETECTOR = np.stack([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], axis=-1)


def autocollimator_body(unit: int) -> str:
    """Body path of autocollimator 1 or 2; all its parts ride on it."""
    return f"{BENCH}/autocollimator_{unit}"


def pinhole_body(unit: int) -> str:
    """Body path of its pinhole."""
    return f"{autocollimator_body(unit)}/focal_plane/pinhole"


def ccd_body(unit: int) -> str:
    """Body path of its area CCD."""
    return f"{autocollimator_body(unit)}/focal_plane/area_ccd"


def axis_body(axis: str) -> str:
    """Body path of the part of the turntable that turns about X, Y or Z; Z rides on Y, Y on X."""
    return "/".join([BENCH, "turntable", *AXES[: AXES.index(axis) + 1]])


def mirror_body(unit: int) -> str:
    """Body path of mirror 1 or 2, on the innermost part of the turntable."""
    return f"{axis_body('Z')}/mirror_{unit}"


def outgoing(unit: int) -> str:
    """Sequence from the pinhole to the mirror."""
    return f"outgoing_{unit}"


def round_trip(unit: int) -> str:
    """Sequence from the pinhole over the mirror to the area CCD."""
    return f"round_trip_{unit}"


@dataclass(frozen=True, eq=False)
class Bench:
    """The bench with its mirrors 2 theta apart.

    Attributes:
        spec: what the YAML says.
        half_angle: theta, radians.
        assembly: bodies, elements, sequences.
        focal_length: of the autocollimators, paraxial, metres.
    """

    spec: AutocollimatorTestSpec
    half_angle: float
    assembly: Assembly
    focal_length: float

    @property
    def between(self) -> float:
        """b, twice theta: the angle between the mirrors' normals, radians."""
        return 2.0 * self.half_angle

    @property
    def numerical_aperture(self) -> float:
        """Numerical aperture of the returned beam at the area CCD."""
        return 0.5 * self.spec.mirrors.aperture / self.focal_length

    def frame(self, unit: int) -> np.ndarray:
        """X, Y, Z of frame 1-XYZ or 2-XYZ in the bench as columns, (3, 3)."""
        return about_axis(0, self.between if unit == 2 else 0.0)


def paraxial_focus(lens: LensSpec, wavelength: float) -> tuple[float, float]:
    """Focal length, and distance of the focus from the back vertex, of the lens for a beam from infinity, metres."""
    n = glass(lens.glass).index(wavelength)
    angle = -(n - 1.0) / (n * lens.front_radius)
    height = 1.0 + angle * lens.thickness
    leaving = n * angle - height * (1.0 - n) / lens.back_radius
    return -1.0 / leaving, -height / leaving


def build_bench(spec: AutocollimatorTestSpec, half_angle: float) -> Bench:
    """Build the bench with the mirrors square to their autocollimators.

    Args:
        spec: the experiment.
        half_angle: theta, radians.
    """
    collimator = spec.autocollimator
    lens = collimator.lens
    n = glass(lens.glass).index(collimator.wavelength)
    bodies = [Body(BENCH)]
    elements: dict[str, Element] = {}
    sequences: dict[str, tuple[str, ...]] = {}
    for unit in UNITS:
        frame = about_axis(0, 2.0 * half_angle if unit == 2 else 0.0)
        bodies += _autocollimator_bodies(spec, unit, Pose(frame, -collimator.distance * frame[:, 2]))
    bodies.append(Body(f"{BENCH}/turntable"))
    bodies += [Body(axis_body(axis)) for axis in AXES]
    for unit in UNITS:
        frame = about_axis(0, 2.0 * half_angle if unit == 2 else 0.0)
        bodies.append(Body(mirror_body(unit), Pose(frame @ _ABOUT_Y, -spec.mirrors.radius * frame[:, 2])))
        root = f"{autocollimator_body(unit)}/lens"
        clear = Circle(0.5 * lens.diameter)
        front, back = Surface(1.0 / lens.front_radius, lens.front_conic), Surface(1.0 / lens.back_radius)
        mirror = Circle(0.5 * spec.mirrors.aperture)
        chain = (
            Element(f"{unit}/back_out", f"{root}/back", back, Interaction.REFRACT, clear, n),
            Element(f"{unit}/front_out", f"{root}/front", front, Interaction.REFRACT, clear),
            Element(f"{unit}/mirror", mirror_body(unit), plane(), Interaction.REFLECT, mirror),
            Element(f"{unit}/front_in", f"{root}/front", front, Interaction.REFRACT, clear, n),
            Element(f"{unit}/back_in", f"{root}/back", back, Interaction.REFRACT, clear),
            Element(f"{unit}/ccd", ccd_body(unit), plane(), Interaction.PASS),
        )
        elements.update({element.name: element for element in chain})
        names = tuple(element.name for element in chain)
        sequences[outgoing(unit)] = names[:3]
        sequences[round_trip(unit)] = names
    assembly = Assembly(RigidTree(tuple(bodies)), elements, sequences)
    return Bench(spec, half_angle, assembly, paraxial_focus(lens, collimator.wavelength)[0])


def _autocollimator_bodies(spec: AutocollimatorTestSpec, unit: int, pose: Pose) -> list[Body]:
    """An autocollimator, its origin at the front vertex of the lens. Scaling it changes its focal length; the interior
    of the focal plane keeps its size.
    """
    collimator = spec.autocollimator
    lens = collimator.lens
    root = autocollimator_body(unit)
    to_image = lens.thickness + lens.focal_distance
    along_y, along_x = collimator.area_ccd.offset
    half = 0.5 * np.array([along_x, along_y, 0.0])
    return [
        Body(root, pose),
        Body(f"{root}/lens", Pose(_ABOUT_Y)),
        Body(f"{root}/lens/front"),
        Body(f"{root}/lens/back", Pose(np.eye(3), np.array([0.0, 0.0, lens.thickness]))),
        Body(f"{root}/focal_plane", Pose(np.eye(3), np.array([0.0, 0.0, -to_image])), scales=False),
        Body(pinhole_body(unit), Pose(np.eye(3), -half)),
        Body(ccd_body(unit), Pose(_DETECTOR, half)),
    ]
