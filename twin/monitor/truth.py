"""The truth about a perturbed instrument, by exact chief rays in the base frame; no formula of the papers enters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from analysis.arrays import shows
from analysis.monitor.monitor_formulas import GroundGeometry
from optics.geometry.tree import PlacedBodies, State
from optics.numerics.backend import Backend
from optics.raytrace.assembly import points_to_world
from optics.raytrace.first_order import LineChange, aim_chief_rays, chief_rays, line_change
from optics.raytrace.system import SystemBatch, assemble
from scenes.models.camera_model import line_body
from scenes.models.instrument_model import Instrument
from scenes.specs.instrument import BASE
from twin.monitor.motions import ElementaryMotion

LINE_POINTS = 41
"""Points of the line CCD over which roll and principal distance are taken."""

ACROSS = np.array([0.0, 1.0, 0.0])
"""Near which, in the world, the first transverse axis of a chief ray is taken."""


@shows("cameras", "principal_distance", "angle [deg]", "angle_change [arcsec]", "lines")
@dataclass(frozen=True, eq=False)
class Truth:
    """True changes of every camera for S states.

    Attributes
    ----------
    cameras : dict[str, LineChange]
        Camera -> changes, arrays of shape (S,).
    principal_distance : dict[str, float]
        Camera -> nominal principal distance, metres.
    angle : float
        Angle between the two lines of sight in the nominal state, radians (NaN unless there are two cameras).
    angle_change : np.ndarray
        Its change, (S,), radians.
    lines : np.ndarray
        Lines of sight in the base frame, unit vectors (cameras, 1 + S, 3); entry 0 is the nominal one.
    """

    cameras: dict[str, LineChange]
    principal_distance: dict[str, float]
    angle: float
    angle_change: np.ndarray
    lines: np.ndarray

    def at(self, states: slice | np.ndarray) -> Truth:
        """The truth of some of the states.

        Parameters
        ----------
        states : slice | np.ndarray
            which.
        """
        each = [field.name for field in fields(LineChange) if field.name != "nominal_distance"]
        cameras = {
            name: replace(change, **{key: getattr(change, key)[states] for key in each})
            for name, change in self.cameras.items()
        }
        lines = np.concatenate([self.lines[:, :1], self.lines[:, 1:][:, states]], axis=1)
        return replace(self, cameras=cameras, angle_change=self.angle_change[states], lines=lines)

    def vector(self, camera: str) -> np.ndarray:
        """(S, 4) true d_alpha, d_beta, d_gamma (rad) and d_f (m) of a camera.

        Parameters
        ----------
        camera : str
            Its name.
        """
        return self.cameras[camera].vector

    def ground_error(self, geometry: GroundGeometry) -> np.ndarray:
        """Errors (S, 3) along the track, across it and up of points that are located by the nominal cameras, metres.

        Parameters
        ----------
        geometry : GroundGeometry
            Of the pair over the ground.
        """
        lines = np.moveaxis(self.lines, 0, 1)
        return geometry.found(lines[1:], lines[:1])


def half_fields(instrument: Instrument, distance: Mapping[str, float]) -> dict[str, float]:
    """Camera -> tangent of half the field along its line CCD.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    distance : Mapping[str, float]
        Camera -> principal distance, metres.
    """
    lines = {name: model.spec.line for name, model in instrument.cameras.items()}
    return {name: 0.5 * line.pixels * line.pitch / distance[name] for name, line in lines.items()}


def ground_geometry(instrument: Instrument, distance: Mapping[str, float]) -> GroundGeometry | None:
    """How a pair of known altitude sees the ground; None for other instruments.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    distance : Mapping[str, float]
        Camera -> principal distance, metres.

    Raises
    ------
    InputError
        The rays of the two do not meet on the ground.
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
    """Where along camera Y the points of the nominal line CCD lie, (LINE_POINTS,), metres."""
    line = instrument.cameras[camera].spec.line
    half = 0.5 * line.pixels * line.pitch
    return np.linspace(-half, half, LINE_POINTS)


def line_in_world(instrument: Instrument, camera: str, placed: PlacedBodies) -> np.ndarray:
    """The points of the line CCD in the world, (S, LINE_POINTS, 3), metres; complex where ``placed`` is."""
    position = line_points(instrument, camera)
    line = np.stack([np.zeros_like(position), position, np.zeros_like(position)], axis=-1)
    return points_to_world(placed, line_body(f"{BASE}/{camera}"), line)


class LineSight:
    """Traces what the points of the line CCDs see; of the unperturbed instrument once.

    Parameters
    ----------
    instrument
        The instrument.
    backend
        Where to trace.
    """

    def __init__(self, instrument: Instrument, backend: Backend) -> None:
        self.instrument = instrument
        self.backend = backend

    def trace(self, states: Sequence[State], placed: PlacedBodies | None = None) -> np.ndarray:
        """Object-space directions of the line CCDs' points toward the scene, world, (cameras, S, LINE_POINTS, 3).

        Parameters
        ----------
        states : Sequence[State]
            S states.
        placed : PlacedBodies | None
            Their bodies, when already placed.

        Raises
        ------
        AimError, BeamMissedError
            a perturbation moves the image off the mirrors.
        """
        instrument, names = self.instrument, list(self.instrument.cameras)
        placed = instrument.assembly.place(states) if placed is None else placed
        to_stop, points, guess = self._from_the_image(states, placed)
        to_object = assemble(instrument.assembly, [f"{n}/image_to_object" for n in names], states, placed=placed)
        start = [np.repeat(a, len(states), axis=0) for a in self._aimed]
        _, sight = chief_rays(self.backend, to_stop, to_object, points, guess, ACROSS, (start[0], start[1]))
        return sight.reshape(len(names), len(states), LINE_POINTS, 3)

    def truth(self, states: Sequence[State], placed: PlacedBodies | None = None) -> Truth:
        """What states do to all cameras.

        Parameters
        ----------
        states : Sequence[State]
            S states.
        placed : PlacedBodies | None
            Their bodies, when already placed.

        Raises
        ------
        AimError, BeamMissedError
            As `trace`.
        """
        return self.told_by(self.trace(states, placed) if states else self.nominal[:, :0])

    def told_by(self, sight: np.ndarray) -> Truth:
        """What directions of sight (cameras, S, LINE_POINTS, 3) say of S states."""
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
        """`trace` of the unperturbed instrument, (cameras, 1, LINE_POINTS, 3)."""
        return self.trace([{}])

    @cached_property
    def _aimed(self) -> tuple[np.ndarray, np.ndarray]:
        """Parameters and Jacobian of the unperturbed instrument's chief rays, from which all others are aimed."""
        to_stop, points, guess = self._from_the_image([{}], self.instrument.assembly.place())
        return aim_chief_rays(self.backend, to_stop, points, guess, ACROSS)[1:]

    @cached_property
    def axes(self) -> dict[str, np.ndarray]:
        """Camera -> nominal X, Y, Z about which its changes count, in the base frame as columns, (3, 3); Z is its
        nominal line of sight. That of an instrument as built is not the drawn one, and Y is then square to it, as near
        to the camera's as can be.
        """
        own = {name: self.instrument.camera_axes(name) for name in self.instrument.cameras}
        if not self.instrument.as_built:
            return own
        sights = self.nominal[:, 0, LINE_POINTS // 2]
        return {name: _about(sight, own[name][:, 1]) for name, sight in zip(own, sights, strict=True)}

    def _from_the_image(
        self, states: Sequence[State], placed: PlacedBodies
    ) -> tuple[SystemBatch, np.ndarray, np.ndarray]:
        """Systems to the stops, points of the line CCDs (B, LINE_POINTS, 3), directions from them (B, 1, 3)."""
        instrument, names = self.instrument, list(self.instrument.cameras)
        to_stop = assemble(instrument.assembly, [f"{n}/image_to_stop" for n in names], states, placed=placed)
        points = np.concatenate([line_in_world(instrument, name, placed) for name in names])
        guess = np.concatenate([instrument.toward_optics(placed, name) for name in names])[:, None]
        return to_stop, points, guess


def _about(sight: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Axes X, Y, Z as columns, of which Z is a line of sight, and Y as near to ``across`` as can be."""
    x = np.cross(across, sight)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(sight, x), sight], axis=-1)


def trace_truth(instrument: Instrument, backend: Backend, states: Sequence[State]) -> Truth:
    """`LineSight.truth`, for one call."""
    return LineSight(instrument, backend).truth(states)


_DIFFERENCE = 1e-6
"""Half step of the central differences (rad, m or relative): truncation and rounding are both below 1e-8 of the
result."""


def truth_jacobian(
    instrument: Instrument, backend: Backend, motions: Sequence[ElementaryMotion]
) -> dict[str, np.ndarray]:
    """Derivative of the true parameters of every camera by elementary motions, by central differences of the exact
    trace.

    Returns
    -------
    dict[str, np.ndarray]
        Camera -> (4, M): d_alpha, d_beta, d_gamma (rad) and d_f (m) per radian, metre or unit of scale.
    """
    states = [m.state(_DIFFERENCE) for m in motions] + [m.state(-_DIFFERENCE) for m in motions]
    truth = trace_truth(instrument, backend, states)
    out = {}
    for name in truth.cameras:
        rows = truth.vector(name).T
        out[name] = (rows[:, : len(motions)] - rows[:, len(motions) :]) / (2.0 * _DIFFERENCE)
    return out
