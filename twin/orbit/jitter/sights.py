"""From image points of a pass to observations of its attitude.

Each point is on the ground once, and lines see it one after the other. Its place there is not known, or not well: it is
taken out, with what is known of it beforehand as a covariance. What remains, the lines' disagreement, tells of the
attitude at the moments of their sights, whatever angle the lines look at: across the track always, along it as far as
the height is known better than the lines' angles tell it.

A pass without anything fast: the readings of orbit and attitude brought to polynomials.

Readings that are joined by a spline carry their noise into the attitude between them, with the period of the readings.
Image points that are compared with such an attitude show that period, whatever the satellite did. Against polynomials
there is nothing that has a period.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from scipy.spatial.transform import Rotation

from analysis.orbit.jitter import Observations
from analysis.statistics import robust_sigma
from optics.numerics.array_math import PhysicalError, in_span
from scenes.specs.orbit.jitter_search import AXES, JitterSearchSpec
from twin.orbit.flight.earth import Earth, east_north_up
from twin.orbit.flight.light_effects import LightEffects, earth_rotation_velocity
from twin.orbit.flight.line_camera import LineCamera, LineTimes
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.flight.sensor import OffsetPlatform, Sensor
from twin.orbit.flight.trajectory import Attitude
from twin.orbit.measured.pass_measurements import PassMeasurements

_ORBIT, _PER = 6, 60.0
"""Degree of a polynomial through an orbit, one more for each so many seconds: good to 0.1 mm."""
_ATTITUDE = 4
"""Degree of what a body does against the orbital frame: slow, and what this leaves of it each line's trend takes."""


@dataclass(frozen=True, eq=False)
class SteadyPlatform:
    """Position and attitude as polynomials of time, seconds; times have shape (...).

    Attributes
    ----------
    span : tuple[float, float]
        Of the readings that they go through.
    place : np.ndarray
        Chebyshev coefficients of the position, ITRS, (K, 3), metres.
    turn : np.ndarray
        Of rotation vectors from `middle`, (K, 3), radians.
    middle : np.ndarray
        Rotation of the body against the orbital frame, (3, 3).
    law : Attitude
        Orbital axes.
    """

    span: tuple[float, float]
    place: np.ndarray
    turn: np.ndarray
    middle: np.ndarray
    law: Attitude

    @classmethod
    def of(cls, path: TabulatedTrajectory, first: float, last: float) -> SteadyPlatform:
        """Through the readings between two times and, to each side, as long again where there are any.

        Raises
        ------
        ValueError
            The readings do not cover the times.
        """
        path.position(np.array([first, last]))
        duration = last - first
        begin, end = max(first - duration, path.first), min(last + duration, path.last)
        span = begin, end
        fixes, looks = (_inside(time, begin, end, path) for time in (path.table.orbit_time, path.table.attitude_time))
        degree = _ORBIT + int((end - begin) / _PER)
        place = _chebyshev_fit(fixes, path.position(fixes), span, degree)
        draft = cls(span, place, np.zeros((1, 3)), np.eye(3), path.law)
        against = Rotation.from_matrix(np.einsum("nji,njk->nik", draft._orbital(looks), path.body_to_itrs(looks)))
        middle = against.mean().as_matrix()
        rotation = (Rotation.from_matrix(middle).inv() * against).as_rotvec()
        return cls(span, place, _chebyshev_fit(looks, rotation, span, _ATTITUDE), middle, path.law)

    def position(self, seconds: Any) -> np.ndarray:
        """Position in the ITRS, metres; (...) -> (..., 3)."""
        return self._series(self.place, seconds)

    def velocity(self, seconds: Any) -> np.ndarray:
        """Velocity against the turning Earth in axes of the ITRS, m/s; (...) -> (..., 3)."""
        first, last = self.span
        return self._series(chebyshev.chebder(self.place) * (2.0 / (last - first)), seconds)

    def inertial_velocity(self, seconds: Any) -> np.ndarray:
        """Velocity against the stars in axes of the ITRS, m/s; (...) -> (..., 3)."""
        return np.asarray(self.velocity(seconds) + earth_rotation_velocity(self.position(seconds)))

    def body_to_itrs(self, seconds: Any) -> np.ndarray:
        """Axes of the body as columns, (...) -> (..., 3, 3): x_itrs = matrix @ x_body."""
        t = np.asarray(seconds, np.float64)
        rotation = Rotation.from_rotvec(self._series(self.turn, t).reshape(-1, 3)).as_matrix().reshape(*t.shape, 3, 3)
        return np.asarray(self._orbital(t) @ self.middle @ rotation)

    def _orbital(self, seconds: Any) -> np.ndarray:
        return self.law.orbital_to_itrs(self.position(seconds), self.velocity(seconds), self.inertial_velocity(seconds))

    def _series(self, coefficients: np.ndarray, seconds: Any) -> np.ndarray:
        first, last = self.span
        x = (2.0 * np.asarray(seconds, np.float64) - first - last) / (last - first)
        return np.asarray(np.moveaxis(chebyshev.chebval(x, coefficients), 0, -1))


def _inside(time: np.ndarray, first: float, last: float, path: TabulatedTrajectory) -> np.ndarray:
    """Readings between two times; where there are few, moments that are joined from them."""
    moments = time[in_span(time, first, last)]
    if len(moments) < 2 * _ORBIT:
        moments = np.linspace(first, last, 4 * _ORBIT)
    return np.asarray(moments[path.covers(moments)])


def _chebyshev_fit(time: np.ndarray, values: np.ndarray, span: tuple[float, float], degree: int) -> np.ndarray:
    x = (2.0 * time - span[0] - span[1]) / (span[1] - span[0])
    return np.asarray(chebyshev.chebfit(x, values, min(degree, len(time) - 1)))


_SPARE = 200
"""Lines about the points' that are looked through for them."""
_TURN = 1e-5
"""Radians: of the difference quotients."""
_STEP = 10.0
"""Metres: likewise."""
_EXACT = 1e-3
"""Metres: of points that are said to be exact."""
_LEAST_POINTS = 15
_NOISE, _ROUNDS = 4.0, 4
"""Sigmas of a measured line within which it may be noise, and rounds that leave out the others."""
_FAR = 200.0
"""Pixels between lines and what is known of camera and platform."""


class SightsError(PhysicalError, ValueError):
    """Points that tell nothing of the attitude."""


@dataclass(frozen=True, eq=False)
class Sights:
    """What lines saw of the same points.

    Attributes
    ----------
    observations : Observations
        Of the attitude about the axes that are sought, whitened.
    lines : tuple[str, ...]
        That are used, in the order in which they see a place.
    gaps : Mapping[tuple[str, str], tuple[float, float, float]]
        (first line, second line) -> seconds between their sights of the same points: the median, and before and after
        it the ends of nine tenths of them.
    pixel : float
        Angle of a pixel along the line, radians.
    points : int
        How many are seen by two lines or more.
    pairs : Mapping[tuple[str, str], tuple[np.ndarray, np.ndarray]]
        (first line, second line) -> moments (n,) of the first sight, and what the second line sees the points by
        farther across (pixels to the right) and along (lines later) than the first, as far as neither ground nor
        interior orientation explain it, (n, 2): to look at.
    """

    observations: Observations
    lines: tuple[str, ...]
    gaps: Mapping[tuple[str, str], tuple[float, float, float]]
    pixel: float
    points: int
    pairs: Mapping[tuple[str, str], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class _Line:
    """One line's part: of which points, when, and how they move."""

    sensor: Sensor
    point: np.ndarray
    place: np.ndarray
    covariance: np.ndarray
    seconds: np.ndarray
    axes: tuple[Sensor, ...]


def sights_of(
    measurements: PassMeasurements,
    cameras: Mapping[str, LineCamera],
    used: tuple[str, ...] | None,
    search: JitterSearchSpec,
    effects: LightEffects,
) -> Sights:
    """Of a pass.

    Parameters
    ----------
    one : PassMeasurements
        What was measured.
    cameras : Mapping[str, LineCamera]
        As the laboratory knows them.
    chosen : tuple[str, ...] | None
        Lines that are used; None for all that have points.
    search : JitterSearchSpec
        Axes, trends and what is known of heights.
    effects : LightEffects
        On the light, that are in the image points.

    Raises
    ------
    SightsError
        Lines without points, or fewer than two lines that see the same ones.
    ValueError
        Readings that do not cover the points' moments.
    """
    names = [name for name in cameras if name in measurements.images and name in (used or cameras)]
    if missing := [name for name in used or () if name not in measurements.images]:
        raise SightsError(f"no image points of {', '.join(missing)}")
    count = np.zeros(len(measurements.ground), int)
    for name in names:
        count[measurements.images[name].point] += 1
    shared = np.flatnonzero(count >= 2)
    if len(names) < 2 or len(shared) < _LEAST_POINTS:
        raise SightsError(f"{len(shared)} points are seen by two lines or more, {_LEAST_POINTS} at least are needed")
    lines = _lines(measurements, cameras, names, shared, search, effects)
    order = sorted(names, key=lambda name: _moment(lines[name], lines))
    prior = _prior_of(measurements, lines, shared, search)
    place = _improved_positions(lines, shared, prior)
    observations, residual = _whitened_observations(lines, order, shared, place, prior, search)
    pixel = float(np.median([_pixel(cameras[name]) for name in order]))
    gaps, pairs = _pairs(lines, order, len(measurements.ground), residual)
    return Sights(observations, tuple(order), gaps, pixel, len(shared), pairs)


def _lines(
    measurements: PassMeasurements,
    cameras: Mapping[str, LineCamera],
    names: list[str],
    shared: np.ndarray,
    search: JitterSearchSpec,
    effects: LightEffects,
) -> dict[str, _Line]:
    rows = {name: measurements.images[name].taken(np.isin(measurements.images[name].point, shared)) for name in names}
    times, first = {}, {}
    for name, row in rows.items():
        first[name], times[name] = _trimmed_times(measurements.line_times[name], row.line)
    ends = [at.at(np.array([-0.5, at.line[-1] + 0.5])) for at in times.values()]
    begin, end = float(np.min(ends)), float(np.max(ends))
    path = TabulatedTrajectory(measurements.platform)
    without_jitter = SteadyPlatform.of(path, max(begin, path.first), min(end, path.last))
    rotated = [OffsetPlatform(without_jitter, np.zeros(3), _TURN * np.eye(3)[AXES.index(axis)]) for axis in search.axes]
    lines = {}
    for name, row in rows.items():
        sensor = Sensor.of_lines(cameras[name], without_jitter, Earth(), times[name], effects)
        place = np.stack([row.line - first[name], row.pixel], axis=-1)
        about = tuple(replace(sensor, trajectory=platform) for platform in rotated)
        lines[name] = _Line(sensor, row.point, place, row.covariance, times[name].at(place[:, 0]), about)
    return lines


def _trimmed_times(times: LineTimes, line: np.ndarray) -> tuple[float, LineTimes]:
    """The times of the lines about some, counted from the first of them, and that one's number."""
    first = max(float(np.floor(line.min())) - _SPARE, float(times.line[0]))
    last = min(float(np.ceil(line.max())) + _SPARE, float(times.line[-1]))
    inner = times.line[(times.line > first) & (times.line < last)]
    at = np.concatenate([[first], inner, [last]])
    return first, LineTimes.of(at - first, times.at(at))


def _moment(line: _Line, lines: Mapping[str, _Line]) -> float:
    """Mean of a line's sights less those of all lines of the same points, seconds."""
    difference = []
    for other in lines.values():
        _, mine, theirs = np.intersect1d(line.point, other.point, return_indices=True)
        difference.append(float(np.mean(line.seconds[mine] - other.seconds[theirs])) if len(mine) else 0.0)
    return float(np.mean(difference))


@dataclass(frozen=True, eq=False)
class _Prior:
    """What is known of places before they are seen.

    Attributes
    ----------
    tie : np.ndarray
        (n,) whether only the height is known.
    place : np.ndarray
        (n, 3), ITRS, metres.
    root : np.ndarray
        (n, 3, 3) by which differences in place become white; of ties the first row alone, for the height.
    """

    tie: np.ndarray
    place: np.ndarray
    root: np.ndarray

    @property
    def normal(self) -> np.ndarray:
        """(n, 3, 3) inverse covariances, of ties singular."""
        return np.asarray(self.root.swapaxes(1, 2) @ self.root)

    def of(self, rows: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """For some, all ties or none: rows (n, k, 3) by which a step from places (n, 3) is observed, and how far (n, k)
        the prior's place lies.
        """
        root = self.root[rows][:, :1] if self.tie[rows[0]] else self.root[rows]
        return root, (root @ (self.place[rows] - place)[..., None])[..., 0]


def _prior_of(measurements: PassMeasurements, lines: Mapping[str, _Line], shared: np.ndarray, search: JitterSearchSpec) -> _Prior:
    place = np.full((len(measurements.ground), 3), np.nan)
    for line in lines.values():
        ground = line.sensor.ground(line.place[:, 0], line.place[:, 1], search.height)
        empty = np.isnan(place[line.point, 0])
        place[line.point[empty]] = ground[empty]
    tie = measurements.ground.role == "tie"
    place[~tie] = measurements.ground.itrs[~tie]
    place, tie = place[shared], tie[shared]
    if not np.all(np.isfinite(place)):
        raise SightsError("lines look past the Earth")
    root = np.zeros((len(place), 3, 3))
    longitude, latitude, _ = Earth().geodetic(place[tie])
    root[tie, 0] = east_north_up(longitude, latitude)[:, 2] / search.height_sigma
    spread = measurements.ground.covariance[shared[~tie]] + _EXACT**2 * np.eye(3)
    root[~tie] = np.linalg.inv(np.linalg.cholesky(spread))
    return _Prior(tie, place, root)


def _improved_positions(lines: Mapping[str, _Line], shared: np.ndarray, prior: _Prior) -> np.ndarray:
    """Places at which the derivatives are taken: near enough for them to hold."""
    normal, right = prior.normal, np.zeros((len(shared), 3))
    for line in lines.values():
        which = np.searchsorted(shared, line.point)
        residual, slope = _residual_and_slope(line, prior.place[which])
        weight = np.linalg.inv(line.covariance)
        good = np.all(np.isfinite(residual), axis=1) & np.all(np.isfinite(slope), axis=(1, 2))
        np.add.at(normal, which[good], np.einsum("nki,nkl,nlj->nij", slope, weight, slope)[good])
        np.add.at(right, which[good], np.einsum("nki,nkl,nl->ni", slope, weight, np.nan_to_num(residual))[good])
    alone = np.linalg.cond(normal) > 1e14
    normal[alone] = np.eye(3)
    step = np.linalg.solve(normal, right[..., None])[..., 0]
    return np.asarray(prior.place + np.where(alone[:, None], 0.0, step))


def _residual_and_slope(line: _Line, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Measured less expected line and pixel (n, 2), and their derivatives by the place (n, 2, 3), per metre."""
    expected = np.stack(line.sensor.image(place), axis=-1)
    by = [(np.stack(line.sensor.image(place + _STEP * axis), axis=-1) - expected) / _STEP for axis in np.eye(3)]
    return line.place - expected, np.stack(by, axis=-1)


def _whitened_observations(
    lines: Mapping[str, _Line],
    order: list[str],
    shared: np.ndarray,
    place: np.ndarray,
    prior: _Prior,
    search: JitterSearchSpec,
) -> tuple[Observations, dict[str, np.ndarray]]:
    """Observations, and line -> measured less expected at the places (n, 2), pixels."""
    axes, count = len(search.axes), len(order)
    size, width = len(shared), (search.interior + 1) + search.trend
    value, by = np.zeros((size, count, 2)), np.zeros((size, count, 2, 3))
    rotation, time = np.zeros((size, count, 2, axes)), np.zeros((size, count))
    spread = np.zeros((size, count, 2, count, 2))
    basis = _basis(lines, shared, search)
    seen = np.zeros((size, count), bool)
    residual = {}
    for k, name in enumerate(order):
        line = lines[name]
        which = np.searchsorted(shared, line.point)
        positions = place[which]
        difference, slope = _residual_and_slope(line, positions)
        expected = line.place - difference
        rotations = [(np.stack(s.image(positions), axis=-1) - expected) / _TURN for s in line.axes]
        good = np.all(np.isfinite(difference), axis=1) & (np.max(np.abs(np.nan_to_num(difference, nan=np.inf)), axis=1) < _FAR)
        for derivative in (slope, *rotations):
            good &= np.all(np.isfinite(derivative.reshape(len(derivative), -1)), axis=1)
        rows = which[good]
        seen[rows, k] = True
        moments = _moments(line, difference[:, 0], basis[which])
        value[rows, k], by[rows, k], time[rows, k] = difference[good], slope[good], moments[good]
        rotation[rows, k] = np.stack(rotations, axis=-1)[good]
        spread[rows, k, :, k] = line.covariance[good]
        residual[name] = difference
    values: list[np.ndarray] = []
    times: list[np.ndarray] = []
    weights, columns, groups, mixes = [], [], [], []
    for used, rows in _visibility_groups(seen, prior.tie):
        m, n = len(used), len(rows)
        root = np.linalg.inv(np.linalg.cholesky(spread[rows][:, used][:, :, :, used].reshape(n, 2 * m, 2 * m)))
        seen_by = root @ by[rows][:, used].reshape(n, 2 * m, 3)
        before, difference = prior.of(rows, place[rows])
        # combinations of observations that no place on the ground explains
        free = np.linalg.svd(np.concatenate([seen_by, before], axis=1))[0][:, :, 3:].swapaxes(1, 2)
        measured = np.concatenate([(root @ value[rows][:, used].reshape(n, 2 * m, 1))[..., 0], difference], axis=1)
        values.append((free @ measured[..., None]).ravel())
        root = free[:, :, : 2 * m] @ root
        free_count = root.shape[1]
        weight = np.zeros((n, free_count, count, axes))
        column = np.zeros((n, free_count, count, 2, width))
        mix = np.zeros((n, free_count, count + 1, 3))
        mix[:, :, count, : before.shape[1]] = free[:, :, 2 * m :]
        for j, k in enumerate(used):
            part = root[:, :, 2 * j : 2 * j + 2]
            weight[:, :, k] = part @ rotation[rows, k]
            column[:, :, k] = part[..., None] * basis[rows][:, None, None, :]
            mix[:, :, k, :2] = free[:, :, 2 * j : 2 * j + 2]
        weights.append(weight.reshape(-1, count, axes))
        columns.append(column.reshape(n * free_count, -1))
        mixes.append(mix.reshape(n * free_count, count + 1, 3))
        groups.append(np.repeat(np.arange(n), free_count) + sum(len(part) for part in times))
        times.append(time[rows])
    if not values:
        raise SightsError("no point is seen by two lines where camera and platform expect it, to 200 pixels")
    parts = (values, groups, times, weights, columns, mixes)
    value, group, time, weight, nuisance, mix = (np.concatenate(part) for part in parts)
    return Observations.of(value, group, time, weight, nuisance, mix=mix), residual


def _moments(line: _Line, off: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Return the times (n,) at which points cross a line, seconds, without the noise of the measured lines.

    A measured line is wrong by the same noise as what is observed, so that a time that follows from it goes with the
    observation; where points lie on rows, all of the scatter of their times is this noise.

    Parameters
    ----------
    line : _Line
        With the measured places.
    off : np.ndarray
        Measured less expected lines (n,), of which noise is what is smooth no more, as far as its sigma allows.
    basis : np.ndarray
        (n, width) smooth functions of the points.
    """
    sigma = np.sqrt(line.covariance[:, 0, 0])
    accepted = np.isfinite(off)
    for _ in range(_ROUNDS):
        if accepted.sum() < 2 * basis.shape[1]:
            return line.seconds
        remainder = off - basis @ np.linalg.lstsq(basis[accepted], off[accepted], rcond=None)[0]
        accepted = np.abs(remainder) <= _NOISE * np.maximum(sigma, robust_sigma(remainder[accepted]))
    noise = np.clip(np.nan_to_num(remainder), -_NOISE * sigma, _NOISE * sigma)
    return np.asarray(line.sensor.time(line.place[:, 0] - noise))


def _visibility_groups(seen: np.ndarray, tie: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Lines (m,) and points (n,) of each set of points that the same two lines or more see, of one sort."""
    groups = []
    for sort in (True, False):
        for pattern in np.unique(seen, axis=0):
            alike = np.all(seen == pattern, axis=1)
            rows = np.flatnonzero(alike & (tie if sort else ~tie))
            if pattern.sum() >= 2 and len(rows):
                groups.append((np.flatnonzero(pattern), rows))
    return groups


def _basis(lines: Mapping[str, _Line], shared: np.ndarray, search: JitterSearchSpec) -> np.ndarray:
    """(n, width) powers of each point's place across the strip and of its time, the same for all lines: what they have
    in common then moves the ground alone, and drops out, with the noise of the places.
    """
    total, seen = np.zeros((len(shared), 2)), np.zeros(len(shared))
    for line in lines.values():
        which = np.searchsorted(shared, line.point)
        np.add.at(total, which, np.stack([line.place[:, 1] / line.sensor.camera.pixels, line.seconds], axis=-1))
        np.add.at(seen, which, 1.0)
    at = total / seen[:, None]
    low, high = at.min(axis=0), at.max(axis=0)
    x, u = ((2.0 * at - low - high) / np.maximum(high - low, 1e-9)).T
    legendre = np.polynomial.legendre.legvander
    return np.concatenate([legendre(x, search.interior), legendre(u, search.trend)[:, 1:]], axis=1)


def _pixel(camera: LineCamera) -> float:
    return float(np.linalg.norm(camera.look_and_slope(np.array([0.5 * (camera.pixels - 1)]))[1]))


def _pairs(
    lines: Mapping[str, _Line], order: list[str], count: int, residual: Mapping[str, np.ndarray]
) -> tuple[dict[tuple[str, str], tuple[float, float, float]], dict[tuple[str, str], tuple[np.ndarray, np.ndarray]]]:
    """Gaps, and disparities without what is smooth along and across the strip."""
    gaps, pairs = {}, {}
    for a, b in combinations(order, 2):
        _, mine, theirs = np.intersect1d(lines[a].point, lines[b].point, return_indices=True)
        if not len(mine):
            continue
        seconds = lines[b].seconds[theirs] - lines[a].seconds[mine]
        low, middle, high = np.quantile(seconds, (0.05, 0.5, 0.95))
        gaps[a, b] = float(low), float(middle), float(high)
        if order.index(b) != order.index(a) + 1:
            continue
        moved = (residual[b][theirs] - residual[a][mine])[:, ::-1]
        at = lines[a].seconds[mine]
        x = lines[a].place[mine, 1]
        scaled = [(2.0 * v - v.min() - v.max()) / max(float(np.ptp(v)), 1e-9) for v in (x, at)]
        smooth = np.stack([scaled[0] ** i * scaled[1] ** j for i in range(4) for j in range(3 - min(i, 2))], axis=-1)
        good = np.all(np.isfinite(moved), axis=1)
        fit = np.linalg.lstsq(smooth[good], moved[good], rcond=None)[0]
        rows = np.argsort(at[good])
        pairs[a, b] = at[good][rows], (moved[good] - smooth[good] @ fit)[rows]
    return gaps, pairs
