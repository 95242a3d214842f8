"""True changes of a perturbed instrument, by exact chief rays in the base frame, without any formula."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from analysis.arrays import ARCSEC, shows
from analysis.monitor.monitor_formulas import GroundGeometry
from optics.geometry.pose import triple
from optics.geometry.tree import ORIGIN, Motion, PlacedBodies, State
from optics.numerics.backend import Backend
from optics.raytrace.assembly import points_to_world
from optics.raytrace.first_order import LineChange, aim_chief_rays, chief_rays, line_change
from optics.raytrace.system import SystemBatch, assemble
from scenes.models.camera_model import line_body
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


LINE_POINTS = 41
"""Number of points along the line CCD from which its roll and the principal distance are determined."""

ACROSS = np.array([0.0, 1.0, 0.0])
"""Direction in the world frame; the first transverse axis of each chief ray is chosen as near to it as possible."""


@shows("cameras", "principal_distance", "angle [deg]", "angle_change [arcsec]", "lines")
@dataclass(frozen=True, eq=False)
class Truth:
    """True changes of every camera for S states.

    Attributes
    ----------
    cameras : dict of str to LineChange
        Camera -> changes, arrays of shape (S,).
    principal_distance : dict of str to float
        Camera -> nominal principal distance, in metres.
    angle : float
        Angle between the two lines of sight in the nominal state, in radians (NaN unless there are two cameras).
    angle_change : (S,) ndarray
        Change of this angle, in radians.
    lines : (cameras, 1 + S, 3) ndarray
        Lines of sight in the base frame, unit vectors; entry 0 is the nominal one.
    """

    cameras: dict[str, LineChange]
    principal_distance: dict[str, float]
    angle: float
    angle_change: np.ndarray
    lines: np.ndarray

    def at(self, states: slice | np.ndarray) -> Truth:
        """Return the true changes of some of the states.

        Parameters
        ----------
        states : slice | ndarray
            Indices of the states.
        """
        each = [field.name for field in fields(LineChange) if field.name != "nominal_distance"]
        cameras = {
            name: replace(change, **{key: getattr(change, key)[states] for key in each})
            for name, change in self.cameras.items()
        }
        lines = np.concatenate([self.lines[:, :1], self.lines[:, 1:][:, states]], axis=1)
        return replace(self, cameras=cameras, angle_change=self.angle_change[states], lines=lines)

    def vector(self, camera: str) -> np.ndarray:
        """Return the true d_alpha, d_beta, d_gamma (rad) and d_f (m) of a camera, (S, 4) for S states.

        They are the rotations of the line of sight about the nominal camera's Y, X and Z, and the change of the
        principal distance.

        Parameters
        ----------
        camera : str
            Name of the camera.
        """
        return self.cameras[camera].vector

    def ground_error(self, geometry: GroundGeometry) -> np.ndarray:
        """Return the errors of ground points located with the nominal cameras, (S, 3) for S states, in metres.

        The components are along track, across track and up.

        Parameters
        ----------
        geometry : GroundGeometry
            Geometry of the stereo pair over the ground.
        """
        lines = np.moveaxis(self.lines, 0, 1)
        return geometry.fitted_to_ground(lines[1:], lines[:1])


def half_fields(instrument: Instrument, distance: Mapping[str, float]) -> dict[str, float]:
    """Return the tangent of half of each camera's field along its line CCD.

    Parameters
    ----------
    instrument : Instrument
        Instrument.
    distance : mapping of str to float
        Camera -> principal distance, in metres.
    """
    lines = {name: model.spec.line for name, model in instrument.cameras.items()}
    return {name: 0.5 * line.pixels * line.pitch / distance[name] for name, line in lines.items()}


def ground_geometry(instrument: Instrument, distance: Mapping[str, float]) -> GroundGeometry | None:
    """Return the ground geometry of a stereo pair of known altitude; None for other instruments.

    Parameters
    ----------
    instrument : Instrument
        Instrument.
    distance : mapping of str to float
        Camera -> principal distance, in metres.

    Raises
    ------
    InputError
        The rays of the pair do not intersect on the ground.
    """
    spec, names = instrument.spec, list(instrument.cameras)
    if spec.altitude is None or len(names) != 2:
        return None
    first, second = names
    fields = half_fields(instrument, distance)
    looks = spec.cameras[first].look, spec.cameras[second].look
    try:
        return GroundGeometry(spec.altitude, (first, second), looks, (fields[first], fields[second]))
    except ValueError as error:
        text = f"points on the ground cannot be located by these cameras ({error})"
        raise spec.error(text, ("altitude",), allowed="cameras that look at the Earth from two sides") from error


def line_points(instrument: Instrument, camera: str) -> np.ndarray:
    """Return the positions along camera Y of the points of the nominal line CCD, (LINE_POINTS,), in metres."""
    line = instrument.cameras[camera].spec.line
    half = 0.5 * line.pixels * line.pitch
    return np.linspace(-half, half, LINE_POINTS)


def line_in_world(instrument: Instrument, camera: str, placed: PlacedBodies) -> np.ndarray:
    """Return the points of the line CCD in the world frame for S states, (S, LINE_POINTS, 3), in metres.

    The array is complex if ``placed`` is, for derivatives by the complex step.
    """
    position = line_points(instrument, camera)
    line = np.stack([np.zeros_like(position), position, np.zeros_like(position)], axis=-1)
    return points_to_world(placed, line_body(f"{BASE}/{camera}"), line)


class LineSight:
    """Ray trace of the lines of sight: directions from points of the line CCDs toward the scene.

    Parameters
    ----------
    instrument
        Instrument; its unperturbed state is traced once.
    backend
        Backend of the ray trace.
    """

    def __init__(self, instrument: Instrument, backend: Backend) -> None:
        self.instrument = instrument
        self.backend = backend

    def trace(self, states: Sequence[State], placed: PlacedBodies | None = None) -> np.ndarray:
        """Trace directions from the line CCDs' points toward the scene, in the world, (cameras, S, LINE_POINTS, 3).

        Parameters
        ----------
        states : sequence of State
            S states.
        placed : PlacedBodies | None
            Bodies of the states, if already placed.

        Raises
        ------
        AimError, BeamMissedError
            A perturbation moves the image off the mirrors.
        """
        instrument, names = self.instrument, list(self.instrument.cameras)
        placed = instrument.assembly.place(states) if placed is None else placed
        to_stop, points, guess = self._from_the_image(states, placed)
        to_object = assemble(instrument.assembly, [f"{n}/image_to_object" for n in names], states, placed=placed)
        start = [np.repeat(a, len(states), axis=0) for a in self._aimed]
        _, sight = chief_rays(self.backend, to_stop, to_object, points, guess, ACROSS, (start[0], start[1]))
        return sight.reshape(len(names), len(states), LINE_POINTS, 3)

    def truth(self, states: Sequence[State], placed: PlacedBodies | None = None) -> Truth:
        """Return the true changes of all cameras in some states.

        Parameters
        ----------
        states : sequence of State
            S states.
        placed : PlacedBodies | None
            Bodies of the states, if already placed.

        Raises
        ------
        AimError, BeamMissedError
            A perturbation moves the image off the mirrors.
        """
        return self.truth_of(self.trace(states, placed) if states else self.nominal[:, :0])

    def truth_of(self, sight: np.ndarray) -> Truth:
        """Return the true changes of the cameras in S states, from traced lines of sight.

        ``sight`` holds the directions of the lines of sight in the world frame, (cameras, S, LINE_POINTS, 3).
        """
        sight = np.concatenate([self.nominal, sight], axis=1)
        cameras: dict[str, LineChange] = {}
        principal: dict[str, float] = {}
        for i, name in enumerate(self.instrument.cameras):
            change = line_change(sight[i], line_points(self.instrument, name), self.axes[name])
            cameras[name] = change
            principal[name] = change.nominal_distance
        lines = sight[:, :, LINE_POINTS // 2]
        if len(lines) == 2:
            sine = np.linalg.norm(np.cross(lines[0], lines[1]), axis=-1)
            angle = np.arctan2(sine, np.sum(lines[0] * lines[1], axis=-1))
        else:
            angle = np.full(sight.shape[1], np.nan)
        return Truth(cameras, principal, float(angle[0]), angle[1:] - angle[0], lines)

    @cached_property
    def nominal(self) -> np.ndarray:
        """Unperturbed directions in the world from points of the line CCDs, (cameras, 1, LINE_POINTS, 3)."""
        return self.trace([{}])

    @cached_property
    def _aimed(self) -> tuple[np.ndarray, np.ndarray]:
        """Aim parameters of the unperturbed chief rays, and the Jacobian of their hit points with respect to these.

        The chief rays of all other states are aimed starting from these.
        """
        to_stop, points, guess = self._from_the_image([{}], self.instrument.assembly.place())
        return aim_chief_rays(self.backend, to_stop, points, guess, ACROSS)[1:]

    @cached_property
    def axes(self) -> dict[str, np.ndarray]:
        """Camera -> axes X, Y, Z about which its changes are measured, as columns (3, 3) in the base frame.

        Z is the nominal line of sight. Where the instrument as built has another line of sight than its design, Y is
        perpendicular to it and as near as possible to the camera's Y.
        """
        axes = {name: self.instrument.camera_axes(name) for name in self.instrument.cameras}
        if not self.instrument.as_built:
            return axes
        sights = self.nominal[:, 0, LINE_POINTS // 2]
        return {name: _about(sight, axes[name][:, 1]) for name, sight in zip(axes, sights, strict=True)}

    def _from_the_image(
        self, states: Sequence[State], placed: PlacedBodies
    ) -> tuple[SystemBatch, np.ndarray, np.ndarray]:
        """Return the optical systems from line CCD to stop, the points of the line CCDs, and the launch directions.

        For B systems the points have the shape (B, LINE_POINTS, 3), the directions (B, 1, 3).
        """
        instrument, names = self.instrument, list(self.instrument.cameras)
        to_stop = assemble(instrument.assembly, [f"{n}/image_to_stop" for n in names], states, placed=placed)
        points = np.concatenate([line_in_world(instrument, name, placed) for name in names])
        guess = np.concatenate([instrument.toward_optics(placed, name) for name in names])[:, None]
        return to_stop, points, guess


def _about(sight: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Return axes X, Y, Z as columns of a matrix: Z is a line of sight, Y as near as possible to ``across``."""
    x = np.cross(across, sight)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(sight, x), sight], axis=-1)


def trace_truth(instrument: Instrument, backend: Backend, states: Sequence[State]) -> Truth:
    """Return the true changes of all cameras in some states, for a single call.

    For several calls make a `LineSight`, which traces the unperturbed instrument only once.
    """
    return LineSight(instrument, backend).truth(states)


_DIFFERENCE = 1e-6
"""Half step of the central differences (rad, m or relative): truncation and rounding errors are both below 1e-8 of the
result.
"""


def truth_jacobian(
    instrument: Instrument, backend: Backend, motions: Sequence[ElementaryMotion]
) -> dict[str, np.ndarray]:
    """Return the derivatives of the true parameters of every camera with respect to M elementary motions.

    They are central differences of the exact trace.

    Returns
    -------
    dict of str to (4, M) ndarray
        Camera -> d_alpha, d_beta, d_gamma (rad) and d_f (m) per radian, metre or unit of scale.
    """
    states = [m.state(_DIFFERENCE) for m in motions] + [m.state(-_DIFFERENCE) for m in motions]
    truth = trace_truth(instrument, backend, states)
    out = {}
    for name in truth.cameras:
        rows = truth.vector(name).T
        out[name] = (rows[:, : len(motions)] - rows[:, len(motions) :]) / (2.0 * _DIFFERENCE)
    return out
