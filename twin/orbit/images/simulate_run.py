"""A pass over a patch of ground from what its file says: orbit, the camera as it is and as it was known, images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.scene import OrbitSimulateSpec
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.yaml.errors import KeyPath
from twin.framework.procedure import Advance, BenchError, silent
from twin.framework.random_streams import stream
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.light_effects import LightEffects
from twin.orbit.flight.line_camera import LineCamera, changed_payload, line_cameras
from twin.orbit.flight.orbit import propagate
from twin.orbit.flight.sensor import Sensor
from twin.orbit.flight.trajectory import Trajectory
from twin.orbit.images.image_points import POINTS_REMEDY, PatchPoints, PointsError, measure_points
from twin.orbit.images.line_optics import optics_of
from twin.orbit.images.patch import ImagedLine, Patch, PatchError, fly_patch, imaged_lines

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.setup import SimulateSetup

_REMEDIES: Mapping[str, tuple[KeyPath, str]] = FrozenMap(
    {
        "span": (("orbit",), "an orbit that is followed longer before and after, or another patch.time"),
        "place": (("patch", "pixel"), "a patch inside the swath of every line"),
        "size": (("patch",), "a smaller patch, or one farther from the ends of the lines"),
        "terrain": (("ground", "terrain"), "less relief, a larger exponent or larger posts"),
    }
)


@dataclass(frozen=True, eq=False)
class SimulatedFlight:
    """A pass without its images.

    Attributes:
        earth: below it.
        truth: the camera as it is.
        trajectory: the true one.
        measured: what the satellite says of it.
        sensors: line -> as it is, over the whole orbit.
        users: line -> as the user knows it: the laboratory's camera on the measured trajectory.
    """

    earth: Earth
    truth: ThreeLineCameraSpec
    trajectory: Trajectory
    measured: Trajectory
    sensors: Mapping[str, Sensor]
    users: Mapping[str, Sensor]


@dataclass(frozen=True, eq=False, kw_only=True)
class Simulation(SimulatedFlight):
    """A pass and what it gave.

    Attributes:
        setup: what its file says.
        seed: of all random numbers.
        lines: those that are rendered, by name.
        place: longitude and latitude of the patch's middle, radians.
        patch: images and control.
        points: measured in the images; None where none were asked for.
    """

    setup: SimulateSetup
    seed: int
    lines: Mapping[str, ImagedLine]
    place: tuple[float, float]
    patch: Patch
    points: PatchPoints | None

    @property
    def spec(self) -> OrbitSimulateSpec:
        """The test."""
        return self.setup.test

    @property
    def laboratory(self) -> ThreeLineCameraSpec:
        """The camera as it was measured before launch."""
        return self.setup.camera


def fly_simulation(setup: SimulateSetup, seed: int) -> SimulatedFlight:
    """Orbit and cameras of a pass; the same for the same seed as those of `run_simulation`.

    Raises:
        BenchError: no such orbit.
    """
    spec, root = setup.test, np.random.SeedSequence(seed)
    earth = Earth.from_spec(spec.earth)
    try:
        trajectory = Trajectory.flown(propagate(spec.orbit, earth), spec.attitude, root)
    except ValueError as error:
        raise BenchError(str(error), ("orbit",), "an orbit that the satellite can fly") from error
    measured = trajectory.with_errors(spec.errors, int(np.random.default_rng(stream(root, 0)).integers(2**31)))
    truth = changed_payload(spec, setup.camera)
    true, known = line_cameras(truth), line_cameras(setup.camera)
    sensors = {name: _sensor(true[name], trajectory, earth, spec) for name in spec.lines}
    users = {name: _sensor(known[name], measured, earth, spec) for name in spec.lines}
    return SimulatedFlight(earth, truth, trajectory, measured, FrozenMap(sensors), FrozenMap(users))


def run_simulation(setup: SimulateSetup, backend: Backend | None, seed: int, advance: Advance = silent) -> Simulation:
    """Fly the pass: ``python -m twin.orbit simulate``; nothing is traced, so that the backend is not used.

    Raises:
        BenchError: no such orbit, a patch that a line cannot image, points that cannot be measured.
    """
    spec, root = setup.test, np.random.SeedSequence(seed)
    flight = fly_simulation(setup, seed)
    optics = optics_of(setup.camera, spec.lines, spec.line_time, setup.detectors)
    lines = imaged_lines(flight.sensors, flight.users, optics, stream(root, 1))
    looking = _sensor(line_cameras(flight.truth)[spec.patch.line], flight.trajectory, flight.earth, spec)
    place = _place(looking, spec)
    size, parts = (spec.patch.lines, spec.patch.pixels), len(lines) + 1

    def imaged(count: int) -> None:
        advance("images", count, parts)

    imaged(0)
    try:
        done = fly_patch(
            lines, place, size, spec.ground, spec.control, stream(root, 2), spec.oversampling, advance=imaged
        )
    except PatchError as error:
        key, remedy = _REMEDIES[error.part]
        raise BenchError(str(error), key, remedy) from error
    points = _points(done, spec)
    imaged(parts)
    return Simulation(
        **vars(flight), setup=setup, seed=seed, lines=FrozenMap(lines), place=place, patch=done, points=points
    )


def _points(patch: Patch, spec: OrbitSimulateSpec) -> PatchPoints | None:
    if spec.points is None:
        return None
    try:
        return measure_points(patch, spec.points)
    except PointsError as error:
        raise BenchError(str(error), ("points",), POINTS_REMEDY) from error


def _sensor(camera: LineCamera, trajectory: Trajectory, earth: Earth, spec: OrbitSimulateSpec) -> Sensor:
    """A line's image over the whole orbit."""
    lines = max(int((trajectory.last - trajectory.first) / spec.line_time) - 1, 1)
    effects = LightEffects.of(spec.effects)
    return Sensor(camera, trajectory, earth, spec.line_time, trajectory.first + 0.5 * spec.line_time, lines, effects)


def _place(sensor: Sensor, spec: OrbitSimulateSpec) -> tuple[float, float]:
    line = (spec.patch.time - sensor.first_line_time) / sensor.line_time
    line = float(np.clip(line, -0.5, sensor.lines - 0.5))
    point = sensor.ground(np.array([line]), np.array([spec.patch.pixel]), spec.ground.terrain.height)
    longitude, latitude, _ = sensor.earth.geodetic(point[0])
    return float(longitude), float(latitude)
