"""How well a reading of a pass explains its ground points.

Every image point is followed down to the height of its ground point, and what is left between the two in plan is the
residual. It may come from the image point, from the ground point, and from camera and platform, which are wrong by
what is stated of them: a turn and a shift of the platform and a shift of the times that all points share, a shift and
a scale of each line. So the residuals have a covariance with large common parts; a convention whose mistake looks like
one of those cannot be told by them, and one that no such error can make is told at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from optics.geometry.pose import rotation_matrix
from optics.numerics.array_math import in_span
from scenes.yaml.errors import InputError, Problem
from twin.orbit.conventions.pass_readings import LineClock, PassConventions, PassReadings
from twin.orbit.flight.earth import Earth, east_north_up
from twin.orbit.flight.light_effects import LightEffects
from twin.orbit.flight.line_camera import LineCamera, LineTimes
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.flight.sensor import Sensor
from twin.orbit.measured.earth_orientation import constant_orientation
from twin.orbit.measured.pass_measurements import ImagePoints
from twin.orbit.measured.platform_files import Conventions, platform_table

if TYPE_CHECKING:
    from scenes.specs.orbit.measurements import UncertaintySpec

_TURN, _SHIFT, _DELAY, _RISE = 1e-5, 10.0, 1e-3, 10.0
"""Steps of the derivatives: radians, metres, seconds, metres."""
_LINES = 1000
"""The sensor's lines, which only cut its time."""


class ImpossibleError(ValueError):
    """A reading under which the points cannot have been imaged; the text says why."""


@dataclass(frozen=True, eq=False)
class _Turned:
    """A platform that is turned and shifted a little, for each of some times by itself."""

    path: TabulatedTrajectory
    turn: np.ndarray | None = None
    shift: np.ndarray | None = None

    def position(self, seconds: Any) -> np.ndarray:
        found = self.path.position(seconds)
        # the sensor also asks for its first and last line
        return found if self.shift is None or len(found) != len(self.shift) else found + self.shift

    def inertial_velocity(self, seconds: Any) -> np.ndarray:
        return self.path.inertial_velocity(seconds)

    def body_to_itrs(self, seconds: Any) -> np.ndarray:
        found = self.path.body_to_itrs(seconds)
        return found if self.turn is None else found @ self.turn


@dataclass(frozen=True, eq=False)
class Fit:
    """What a reading leaves of the points.

    Attributes:
        residual: (n, 2) east and north, metres.
        rms: of both together, root mean square, metres.
        rms_pixels: root mean square along the lines' own axes, pixels.
        left: (n, 2) of the residuals when the likeliest errors of camera and platform are taken out, metres.
        noise: (n, 2, 2) covariance of each point's residual without what it shares with others, m^2.
        chi_square: of the residuals by their covariance.
        cost: chi-square and the logarithm of the covariance's determinant: minus twice the log likelihood.
        freedom: number of residuals.
    """

    residual: np.ndarray
    rms: float
    rms_pixels: float
    left: np.ndarray
    noise: np.ndarray
    chi_square: float
    cost: float
    freedom: int


@dataclass(eq=False)
class PassBench:
    """Tries readings on a pass.

    Attributes:
        readings: of its files.
        cameras: line -> what its pixels look along.
        uncertainty: of camera and platform.
        effects: on the light.
        epoch: from which times count.
    """

    readings: PassReadings
    cameras: Mapping[str, LineCamera]
    uncertainty: UncertaintySpec
    effects: LightEffects
    epoch: str
    _paths: dict[Conventions, TabulatedTrajectory | ImpossibleError] = field(default_factory=dict)

    def without(self, wrong: Mapping[str, np.ndarray]) -> PassBench:
        """The bench without image points that are wrong: line -> mask (n,)."""
        images = {name: raw.taken(~wrong[name]) for name, raw in self.readings.images.items()}
        kept = {name: raw for name, raw in images.items() if len(raw.line)}
        return replace(self, readings=replace(self.readings, images=kept), _paths=self._paths)

    def path(self, meant: Conventions) -> TabulatedTrajectory:
        """The trajectory in one reading. Raises ImpossibleError."""
        if meant not in self._paths:
            self._paths[meant] = self._made(meant)
        found = self._paths[meant]
        if isinstance(found, ImpossibleError):
            raise found
        return found

    def _made(self, meant: Conventions) -> TabulatedTrajectory | ImpossibleError:
        platform = self.readings.platform
        if platform.earth is None:
            # UT1 - UTC is below a second, some hundred metres; no reading of an inertial frame is as near
            platform = replace(platform, earth=constant_orientation(self.epoch, 0.0, (0.0, 0.0)))
        try:
            return TabulatedTrajectory(platform_table(platform, meant, self.epoch), meant.law)
        except InputError as error:
            return ImpossibleError(error.issues[0].problem)

    def places(self, meant: PassConventions, most: int | None = None) -> dict[str, np.ndarray]:
        """Line -> where image points lie on the ground, ITRS, (n, 3), metres.

        Args:
            meant: the reading.
            most: points of each line, spread over them; None for all.

        Raises:
            ImpossibleError: they cannot lie anywhere.
        """
        found = {}
        for name, raw in self.readings.images.items():
            part = raw if most is None else raw.taken(spread(len(raw.line), most))
            found[name] = self._ground(name, meant, part, _Turned(self.path(meant.platform)))[0]
        return found

    def residuals(self, meant: PassConventions, most: int | None = None) -> np.ndarray:
        """(n, 2) of all lines, east and north, metres; arguments and errors as `places`."""
        known, found = self.readings.ground.points.itrs, []
        for name, at in self.places(meant, most).items():
            point = self.readings.images[name].point
            found.append(_plan(known[point[spread(len(point), most or len(point))]], at))
        return np.concatenate(found)

    def fit(self, meant: PassConventions) -> Fit:
        """How well a reading explains the points. Raises ImpossibleError."""
        path, rows, common, noise, sizes = self.path(meant.platform), [], [], [], []
        size = self.uncertainty
        own: list[np.ndarray] = []
        for name, raw in self.readings.images.items():
            steps, pixel_step, line_time = self._steps(name, meant, raw, path)
            known = self.readings.ground.points
            itrs = known.itrs[raw.point]
            base = steps[0]
            here = _plan(itrs, base)
            slope = [(_plan(itrs, one) - here) for one in steps[1:]]
            turn = np.stack(slope[:3], axis=-1) / _TURN * size.attitude
            shift = np.stack(slope[3:6], axis=-1) / _SHIFT * size.position
            delay = slope[6] / _DELAY
            line, pixel, rise = delay * line_time[:, None], slope[7] / pixel_step[:, None], slope[8] / _RISE
            rows.append(here)
            common.append(np.concatenate([turn, shift, delay[..., None] * size.time], axis=-1))
            camera = self.cameras[name]
            from_middle = pixel_of(meant, raw, camera.pixels) - 0.5 * (camera.pixels - 1)
            scale = size.scale * from_middle[:, None]
            own.append(np.stack([line * size.interior, pixel * size.interior, pixel * scale], axis=-1))
            image = np.stack([line, pixel], axis=-1)
            noise.append(image @ raw.covariance @ np.swapaxes(image, 1, 2) + _ground_noise(known, raw.point, rise))
            sizes.append(np.sqrt(0.5 * np.sum(line**2 + pixel**2, axis=1)))
        residual = np.concatenate(rows)
        covariance, shared = _covariance(noise, common, own)
        r = residual.ravel()
        factor = cho_factor(covariance, lower=True)
        weighted = cho_solve(factor, r)
        chi_square = float(r @ weighted)
        left = r - shared @ weighted
        logarithm = 2.0 * float(np.sum(np.log(np.diag(factor[0]))))
        square = np.sum(residual**2, axis=1)
        pixels = float(np.sqrt(np.mean(square / np.concatenate(sizes) ** 2)))
        rms = float(np.sqrt(np.mean(square)))
        cost = chi_square + logarithm
        return Fit(residual, rms, pixels, left.reshape(-1, 2), np.concatenate(noise), chi_square, cost, len(r))

    def _steps(
        self, name: str, meant: PassConventions, raw: ImagePoints, path: TabulatedTrajectory
    ) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
        """Places as read, with turns, shifts, a delay, the next pixel and a height; pixels' steps and line times."""
        n, pixels = len(raw.line), self.cameras[name].pixels
        turn, shift = np.broadcast_to(np.eye(3), (10, n, 3, 3)).copy(), np.zeros((10, n, 3))
        turn[1:4] = rotation_matrix(_TURN * np.eye(3))[:, None]
        shift[4:7] = _SHIFT * np.eye(3)[:, None]
        delay, step, rise = np.zeros((10, n)), np.zeros((10, n)), np.zeros((10, n))
        one = np.where(pixel_of(meant, raw, pixels) + 1.0 <= pixels - 0.5, 1.0, -1.0)
        delay[7], step[8], rise[9] = _DELAY, one, _RISE
        moved = _Turned(path, turn.reshape(-1, 3, 3), shift.reshape(-1, 3))
        every = raw.taken(np.tile(np.arange(n), 10))
        found, line_time = self._ground(name, meant, every, moved, delay.ravel(), step.ravel(), rise.ravel())
        return list(found.reshape(10, n, 3)), one, line_time[:n]

    def _ground(
        self,
        name: str,
        meant: PassConventions,
        raw: ImagePoints,
        platform: _Turned,
        delay: np.ndarray | float = 0.0,
        step: np.ndarray | float = 0.0,
        rise: np.ndarray | float = 0.0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Places (n, 3) at the heights of the ground points, ITRS, metres, and the line time at each, seconds."""
        clock = self.readings.lines[name]
        number = line_of(meant, raw, clock)
        beyond = ~in_span(number, clock.line[0] - 1.0, clock.line[-1] + 1.0)
        if np.any(beyond):
            worst = float(number[int(np.argmax(beyond))])
            told = f"{clock.line[0]:.10g} to {clock.line[-1]:.10g}"
            raise ImpossibleError(f"line {worst:.10g} of {name} has no time in the table, which tells those of {told}")
        times, line_time = line_times(clock, meant, self.epoch, number)
        path, camera = platform.path, self.cameras[name]
        pixel = pixel_of(meant, raw, camera.pixels) + step
        outside = ~in_span(pixel, -0.5, camera.pixels - 0.5)
        if np.any(outside):
            worst = float(pixel[int(np.argmax(outside))])
            raise ImpossibleError(f"pixel {worst:.6g} of {name} does not exist, which has {camera.pixels}")
        first, last = path.first, path.last
        if not np.all(in_span(times, first, last)):
            raise ImpossibleError(f"{name} was exposed outside of orbit and attitude")
        height = Earth().geodetic(self.readings.ground.points.itrs[raw.point])[2] + rise
        tick = (last - first) / _LINES
        try:
            sensor = Sensor(camera, platform, Earth(), tick, first + 0.5 * tick, _LINES, self.effects)
            line = np.clip((times + delay - first) / tick - 0.5, -0.5, _LINES - 0.5)
            found = sensor.ground(line, pixel, height)
        except ValueError as error:
            raise ImpossibleError(str(error)) from None
        if not np.all(np.isfinite(found)):
            raise ImpossibleError(f"looks of {name} miss the Earth")
        return found, line_time


def line_times(clock: LineClock, meant: PassConventions, epoch: str, line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middles of the exposures of lines and time from one line to the next, seconds, (n,) each.

    Args:
        clock: readings at lines.
        meant: the reading.
        epoch: from which times count.
        line: (n,) as the table of times numbers them.

    Raises:
        ImpossibleError: the clock cannot show what it shows.
    """
    try:
        seconds = clock.clock.instants(meant.line_scale).since(epoch) + meant.line_offset
    except Problem as problem:
        raise ImpossibleError(problem.problem) from None
    table = LineTimes.of(clock.line, seconds)
    each = np.interp(line, clock.line, np.gradient(seconds, clock.line))
    half = {"start": 0.5, "middle": 0.0, "end": -0.5}[meant.moment]
    return table.at(line) + half * each, each


def spread(count: int, most: int) -> np.ndarray:
    """Indices of so many of `count`, evenly."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))


def line_of(meant: PassConventions, raw: ImagePoints, clock: LineClock) -> np.ndarray:
    """Lines of image points (n,) in the numbering of the table of times."""
    number = raw.line - meant.line_origin
    return clock.line[0] + clock.line[-1] - number if meant.backward else number


def pixel_of(meant: PassConventions, raw: ImagePoints, pixels: int) -> np.ndarray:
    """Pixels of image points (n,), the middle of the one that looks farthest to the right of the track being 0."""
    number = raw.pixel - meant.pixel_origin
    return number if meant.sees == "right" else pixels - 1.0 - number


def _plan(known: np.ndarray, found: np.ndarray) -> np.ndarray:
    """East and north (n, 2) from known places to found ones, metres."""
    lon, lat, _ = Earth().geodetic(known)
    axes = east_north_up(lon, lat)[:, :2]
    return np.asarray(np.einsum("nij,nj->ni", axes, found - known))


def _ground_noise(known: Any, point: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """(n, 2, 2) of residuals from ground points' covariances; rise: (n, 2) by which a metre of height moves them."""
    lon, lat, _ = Earth().geodetic(known.itrs[point])
    axes = east_north_up(lon, lat)
    level = axes @ known.covariance[point] @ np.swapaxes(axes, 1, 2)
    way = np.concatenate([np.broadcast_to(-np.eye(2), (len(point), 2, 2)), rise[:, :, None]], axis=-1)
    return np.asarray(way @ level @ np.swapaxes(way, 1, 2))


def _covariance(
    noise: list[np.ndarray], common: list[np.ndarray], own: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of all residuals, and the part of it that they share, (2n, 2n) each, m^2."""
    every = np.concatenate(common).reshape(-1, common[0].shape[-1])
    shared = every @ every.T
    start = 0
    for one in own:
        flat = one.reshape(-1, one.shape[-1])
        part = slice(start, start + len(flat))
        shared[part, part] += flat @ flat.T
        start += len(flat)
    whole = shared.copy()
    for k, block in enumerate(np.concatenate(noise)):
        whole[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += block
    return whole, shared
