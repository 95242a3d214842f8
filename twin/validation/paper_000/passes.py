"""Passes over ground points as paper 000 measures them, by the tests of the library (scenes/orbit/angle*.yaml)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from analysis.arrays import ARCSEC
from analysis.orbit.planes import Method, PlaneFit, fit_plane
from analysis.orbit.resection import Resection
from optics.geometry.pose import rotation_matrix
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.angle import LINES
from scenes.specs.orbit.setup import AngleSetup, resolve_angle
from twin.orbit.angle.angle_flight import AngleCamera, AnglePass, Measurement, angle_camera, fly
from twin.orbit.angle.angle_run import resected
from twin.orbit.flight.light_effects import NO_EFFECTS
from twin.validation.checks.check import mean_of

TEST = "angle"
OFF_AXIS = "angle_off_axis"
TRACED = "angle_gf7"
PAIRS = (("forward", "nadir"), ("nadir", "backward"))
"""Pairs of lines that define alpha and beta."""


@dataclass(frozen=True, eq=False)
class Passes:
    """One pass and its repeated measurements.

    Attributes:
        flight: the truth.
        measured: with errors drawn anew each time; the light's effects are in the points and taken out again.
    """

    flight: AnglePass
    measured: tuple[Measurement, ...]

    @cached_property
    def points(self) -> Mapping[str, np.ndarray]:
        """Line -> true ground points on straight lines of sight, (n, 3)."""
        return self.flight.ground(NO_EFFECTS)

    @cached_property
    def sections(self) -> tuple[Resection, ...]:
        """Space resection of every measurement."""
        return tuple(resected(m) for m in self.measured)

    def normal(self, line: str) -> np.ndarray:
        """True unit normal of a line's plane, (3,), ITRS, its z component negative like the paper's (a0, a1, -1).

        From the exact directions of the camera's pixels at the points, not from the points.
        """
        looks = self.flight.cameras[line].look(self.flight.pixel[line])
        body = np.linalg.svd(looks)[2][2]
        axes = self.flight.trajectory.body_to_itrs(self.flight.spec.time)
        normal = axes @ body
        return np.asarray(-np.copysign(1.0, normal[2]) * normal)

    def ahead(self, line: str) -> np.ndarray:
        """The true line of sight of a line's centre made square to its true normal, (3,); along it the normal moves
        when the plane is pitched.
        """
        camera = self.flight.cameras[line]
        look = camera.look(np.array([0.5 * (camera.pixels - 1)]))[0]
        look = self.flight.trajectory.body_to_itrs(self.flight.spec.time) @ look
        normal = self.normal(line)
        look = look - (look @ normal) * normal
        return np.asarray(look / np.linalg.norm(look))

    def pitch_error(self, normals: Mapping[str, np.ndarray]) -> dict[str, tuple[float, float]]:
        """Line -> mean error of fitted unit normals (passes, 3) toward the line of sight, and its sigma, arcsec."""
        out = {}
        for line, found in normals.items():
            turns = (found - self.normal(line)) @ self.ahead(line) / ARCSEC
            out[line] = mean_of(turns)
        return out


def worst(errors: Mapping[str, tuple[float, float]]) -> tuple[float, float]:
    """The mean farthest from zero, with its sigma."""
    return max(errors.values(), key=lambda error: abs(error[0]))


def planes_of(measured: Measurement, method: Method, lines: Iterable[str] = LINES) -> list[PlaneFit]:
    """Planes of lines through the measured station."""
    return [fit_plane(measured.station, measured.strips[line], method) for line in lines]


def setup_of(name: str, **changes: object) -> AngleSetup:
    """A test of the library; changes: fields of its `errors`, or latitude, longitude and direction of its pass."""
    setup = resolve_angle(name)
    test = setup.test
    place: dict[str, object] = {
        key: changes.pop(key) for key in ("latitude", "longitude", "direction") if key in changes
    }
    if place:
        assert test.orbit.passing is not None
        passing = test.orbit.passing.model_copy(update=place)
        test = test.model_copy(update={"orbit": test.orbit.model_copy(update={"passing": passing})})
    if changes:
        test = test.model_copy(update={"errors": test.errors.model_copy(update=changes)})
    return setup.model_copy(update={"test": test})


def repeated(
    setup: AngleSetup,
    seed: np.random.SeedSequence,
    count: int,
    backend: Backend | None = None,
    turns: Mapping[str, tuple[float, float, float]] = FrozenMap(),
    corrected: bool = True,
) -> Passes:
    """Fly and measure `count` times.

    Args:
        setup: the test.
        seed: of terrain and errors.
        count: of measurements.
        backend: to trace an instrument's lines.
        turns: line -> further rotation vector in body axes since the laboratory, radians.
        corrected: whether the analysis takes the light's effects out of the points.
    """
    terrain, errors = seed.spawn(2)
    flight = fly(setup, _turned(angle_camera(setup, backend), turns), terrain)
    ground = flight.ground(flight.effects)
    removed = flight.effects if corrected else NO_EFFECTS
    return Passes(flight, tuple(flight.measure(ground, stream, removed) for stream in errors.spawn(count)))


def _turned(camera: AngleCamera, turns: Mapping[str, tuple[float, float, float]]) -> AngleCamera:
    lines = dict(camera.cameras)
    for name, turn in turns.items():
        lines[name] = replace(lines[name], directions=lines[name].directions @ rotation_matrix(np.array(turn)).T)
    return replace(camera, cameras=FrozenMap(lines))
