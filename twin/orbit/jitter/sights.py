"""Observations of the attitude of a pass from its image points, and a model of the pass without fast motions.

Lines see the same ground point one after the other. Its unknown position is eliminated, with its prior covariance. The
remaining disagreement of the lines observes the differences of the attitude between the moments at which they see the
point, whatever the angles between the lines: across the track always, along it only as far as the height is known
better than the parallax of the lines determines it.

`SteadyPlatform` describes a pass without fast motions, by polynomials through the readings of orbit and attitude. A
spline through the readings has errors with the period of the readings, and image points that are compared with such an
attitude would show that period even without jitter. Polynomials have no period.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from scipy.spatial.transform import Rotation

from analysis.orbit.jitter import Observations
from analysis.statistics import robust_sigma
from optics.numerics.array_math import PhysicalError, in_span
from scenes.specs.orbit.jitter_search import AXES, JitterSearchSpec
from twin.orbit.flight.earth import Earth, east_north_up
from twin.orbit.flight.line_camera import LineCamera, LineTimes
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.flight.sensor import LightEffects, OffsetPlatform, Sensor, earth_rotation_velocity
from twin.orbit.flight.trajectory import Attitude
from twin.orbit.measured.pass_measurements import PassMeasurements

_ORBIT, _PER = 6, 60.0
"""Smallest degree of the polynomial of the orbit, and time span in seconds for which one more degree is added: the
polynomial is accurate to 0.1 mm.
"""
_ATTITUDE = 4
"""Degree of the polynomial of the body's attitude relative to the orbital frame: without jitter the attitude changes
slowly, and the trend that is fitted to each line absorbs the remainder.
"""


@dataclass(frozen=True, eq=False)
class SteadyPlatform:
    """Position and attitude without fast motions, as polynomials of time; times (...) are in seconds.

    Attributes
    ----------
    span : tuple of float
        First and last time of the readings used.
    position_series : (K, 3) ndarray
        K Chebyshev coefficients of the position, ITRS, in metres.
    rotation_series : (K, 3) ndarray
        K Chebyshev coefficients of rotation vectors of the body relative to `middle`, in radians.
    middle : (3, 3) ndarray
        Mean rotation matrix of the body relative to the orbital frame.
    law : Attitude
        Definition of the orbital axes.
    """

    span: tuple[float, float]
    position_series: np.ndarray
    rotation_series: np.ndarray
    middle: np.ndarray
    law: Attitude

    @classmethod
    def of(cls, path: TabulatedTrajectory, first: float, last: float) -> SteadyPlatform:
        """Fit polynomials to the readings between two times, in seconds, and in an equally long span on each side.

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
        position = _chebyshev_fit(fixes, path.position(fixes), span, degree)
        draft = cls(span, position, np.zeros((1, 3)), np.eye(3), path.law)
        against = Rotation.from_matrix(np.einsum("nji,njk->nik", draft._orbital(looks), path.body_to_itrs(looks)))
        middle = against.mean().as_matrix()
        rotation = (Rotation.from_matrix(middle).inv() * against).as_rotvec()
        return cls(span, position, _chebyshev_fit(looks, rotation, span, _ATTITUDE), middle, path.law)

    def position(self, seconds: Any) -> np.ndarray:
        """Return the position in the ITRS, in metres; (..., 3) for times (...)."""
        return self._series(self.position_series, seconds)

    def velocity(self, seconds: Any) -> np.ndarray:
        """Return the velocity relative to the rotating Earth in axes of the ITRS at times (...), (..., 3), in m/s."""
        first, last = self.span
        return self._series(chebyshev.chebder(self.position_series) * (2.0 / (last - first)), seconds)

    def inertial_velocity(self, seconds: Any) -> np.ndarray:
        """Return the inertial velocity in axes of the ITRS, in m/s; (..., 3) for times (...)."""
        return np.asarray(self.velocity(seconds) + earth_rotation_velocity(self.position(seconds)))

    def body_to_itrs(self, seconds: Any) -> np.ndarray:
        """Return the axes of the body as columns at times (...), (..., 3, 3): x_itrs = matrix @ x_body."""
        t = np.asarray(seconds, np.float64)
        vectors = self._series(self.rotation_series, t).reshape(-1, 3)
        rotation = Rotation.from_rotvec(vectors).as_matrix().reshape(*t.shape, 3, 3)
        return np.asarray(self._orbital(t) @ self.middle @ rotation)

    def _orbital(self, seconds: Any) -> np.ndarray:
        return self.law.orbital_to_itrs(self.position(seconds), self.velocity(seconds), self.inertial_velocity(seconds))

    def _series(self, coefficients: np.ndarray, seconds: Any) -> np.ndarray:
        first, last = self.span
        x = (2.0 * np.asarray(seconds, np.float64) - first - last) / (last - first)
        return np.asarray(np.moveaxis(chebyshev.chebval(x, coefficients), 0, -1))


def _inside(time: np.ndarray, first: float, last: float, path: TabulatedTrajectory) -> np.ndarray:
    """Return the times of readings between two times or, where there are few, evenly spaced times."""
    moments = time[in_span(time, first, last)]
    if len(moments) < 2 * _ORBIT:
        moments = np.linspace(first, last, 4 * _ORBIT)
    return np.asarray(moments[path.covers(moments)])


def _chebyshev_fit(time: np.ndarray, values: np.ndarray, span: tuple[float, float], degree: int) -> np.ndarray:
    x = (2.0 * time - span[0] - span[1]) / (span[1] - span[0])
    return np.asarray(chebyshev.chebfit(x, values, min(degree, len(time) - 1)))


_SPARE = 200
"""Number of image lines before and after the measured ones within which expected positions are searched."""
_ROTATION = 1e-5
"""Step of the difference quotients with respect to rotation, in radians."""
_STEP = 10.0
"""Step of the difference quotients with respect to position, in metres."""
_EXACT = 1e-3
"""Standard deviation, in metres, added to that of ground points, because some are given as error-free."""
_LEAST_POINTS = 15
"""Smallest number of points that must be seen by at least two lines."""
_NOISE, _ROUNDS = 4.0, 4
"""Limit, in sigmas, up to which the residual of a measured line number counts as noise, and number of rounds of
rejecting larger ones.
"""
_FAR = 200.0
"""Largest difference between measured and expected image positions, in pixels."""


class SightsError(PhysicalError, ValueError):
    """Error raised when the points of a pass do not observe its attitude."""


@dataclass(frozen=True, eq=False)
class Sights:
    """Observations of the same ground points by several lines, which see them one after the other.

    Attributes
    ----------
    observations : Observations
        Whitened observations of the attitude about the axes that are searched.
    lines : tuple of str
        Lines that are used, in the order in which they see a point.
    gaps : Mapping[tuple[str, str], tuple[float, float, float]]
        (first line, second line) -> time between their observations of the same points, in seconds: 5 % quantile,
        median, 95 % quantile.
    pixel : float
        Angle that a pixel subtends along the line, in radians.
    points : int
        Number of points that at least two lines see.
    pairs : Mapping[tuple[str, str], tuple[ndarray, ndarray]]
        (first line, second line) -> times (n,), in seconds, at which the first line sees n points, and disparities (n,
        2) of the second line relative to the first, across (pixels to the right) and along the track (lines later),
        after removal of the smooth part that ground and interior orientation explain; for figures.
    """

    observations: Observations
    lines: tuple[str, ...]
    gaps: Mapping[tuple[str, str], tuple[float, float, float]]
    pixel: float
    points: int
    pairs: Mapping[tuple[str, str], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class _Line:
    """Observations by one line: points, image positions, covariances, times, and sensors rotated about each axis."""

    sensor: Sensor
    point: np.ndarray
    image: np.ndarray
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
    """Return the observations of the attitude of a pass from its image points.

    Parameters
    ----------
    measurements : PassMeasurements
        Measurements of the pass.
    cameras : Mapping[str, LineCamera]
        Cameras as the laboratory measured them.
    used : tuple of str, optional
        Lines that are used; None for all that have points.
    search : JitterSearchSpec
        Axes, trends and prior of the heights.
    effects : LightEffects
        Effects on the light that are contained in the image points.

    Raises
    ------
    SightsError
        Lines have no points, or fewer than two lines see the same ones.
    ValueError
        The readings do not cover the times of the points.
    """
    names = [name for name in cameras if name in measurements.images and name in (used or cameras)]
    if missing := [name for name in used or () if name not in measurements.images]:
        raise SightsError(f"no image points of {', '.join(missing)}")
    count = np.zeros(len(measurements.ground), int)
    for name in names:
        count[measurements.images[name].point] += 1
    shared = np.flatnonzero(count >= 2)
    if len(names) < 2 or len(shared) < _LEAST_POINTS:
        raise SightsError(f"{len(shared)} points are seen by two lines or more; at least {_LEAST_POINTS} are needed")
    lines = _lines(measurements, cameras, names, shared, search, effects)
    prior = _prior_of(measurements, lines, shared, search)
    ground = _improved_positions(lines, shared, prior)
    ordered = {name: lines[name] for name in sorted(names, key=lambda name: _moment(lines[name], lines))}
    observations, residual = _whitened_observations(ordered, shared, ground, prior, search)
    middles = [cameras[name].look_and_slope(np.array([0.5 * (cameras[name].pixels - 1)]))[1][0] for name in ordered]
    pixel = float(np.median(np.linalg.norm(middles, axis=1)))
    gaps, pairs = _pairs(ordered, residual)
    return Sights(observations, tuple(ordered), gaps, pixel, len(shared), pairs)


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
    steady = SteadyPlatform.of(path, max(begin, path.first), min(end, path.last))
    rotated = [OffsetPlatform(steady, np.zeros(3), _ROTATION * np.eye(3)[AXES.index(axis)]) for axis in search.axes]
    lines = {}
    for name, row in rows.items():
        sensor = Sensor.of_lines(cameras[name], steady, Earth(), times[name], effects)
        position = np.stack([row.line - first[name], row.pixel], axis=-1)
        about = tuple(replace(sensor, trajectory=platform) for platform in rotated)
        lines[name] = _Line(sensor, row.point, position, row.covariance, times[name].at(position[:, 0]), about)
    return lines


def _trimmed_times(times: LineTimes, line: np.ndarray) -> tuple[float, LineTimes]:
    """Cut a table of line times to the lines near the points; return the first line's number and the table."""
    first = max(float(np.floor(line.min())) - _SPARE, float(times.line[0]))
    last = min(float(np.ceil(line.max())) + _SPARE, float(times.line[-1]))
    inner = times.line[(times.line > first) & (times.line < last)]
    at = np.concatenate([[first], inner, [last]])
    return first, LineTimes.of(at - first, times.at(at))


def _moment(line: _Line, lines: Mapping[str, _Line]) -> float:
    """Return the mean time at which a line sees its points, relative to the mean over all lines, in seconds."""
    difference = []
    for other in lines.values():
        _, mine, theirs = np.intersect1d(line.point, other.point, return_indices=True)
        difference.append(float(np.mean(line.seconds[mine] - other.seconds[theirs])) if len(mine) else 0.0)
    return float(np.mean(difference))


@dataclass(frozen=True, eq=False)
class _Prior:
    """Prior of the ground points.

    Attributes
    ----------
    tie : (n,) ndarray of bool for n points
        True where only the height has a prior.
    ground : (n, 3) ndarray
        Prior positions, ITRS, in metres.
    root : (n, 3, 3) ndarray
        Whitening matrices of differences in position (inverse roots of covariances); for tie points only the first row
        is not zero, for the height.
    """

    tie: np.ndarray
    ground: np.ndarray
    root: np.ndarray

    @property
    def normal(self) -> np.ndarray:
        """Inverse covariances of n points, (n, 3, 3), in 1/m^2, singular for tie points."""
        return np.asarray(self.root.swapaxes(1, 2) @ self.root)

    def of(self, rows: np.ndarray, ground: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the priors of some points as whitened observations; all or none of them must be tie points.

        These are the derivatives (n, k, 3) of k whitened residuals of n points with respect to displacements from the
        positions `ground` (n, 3), in 1/m, and the residuals (n, k) of the prior positions.
        """
        root = self.root[rows][:, :1] if self.tie[rows[0]] else self.root[rows]
        return root, (root @ (self.ground[rows] - ground)[..., None])[..., 0]


def _prior_of(
    measurements: PassMeasurements, lines: Mapping[str, _Line], shared: np.ndarray, search: JitterSearchSpec
) -> _Prior:
    position = np.full((len(measurements.ground), 3), np.nan)
    for line in lines.values():
        ground = line.sensor.ground(line.image[:, 0], line.image[:, 1], search.height)
        empty = np.isnan(position[line.point, 0])
        position[line.point[empty]] = ground[empty]
    tie = measurements.ground.role == "tie"
    position[~tie] = measurements.ground.itrs[~tie]
    position, tie = position[shared], tie[shared]
    if not np.all(np.isfinite(position)):
        raise SightsError("lines of sight miss the Earth")
    root = np.zeros((len(position), 3, 3))
    longitude, latitude, _ = Earth().geodetic(position[tie])
    root[tie, 0] = east_north_up(longitude, latitude)[:, 2] / search.height_sigma
    spread = measurements.ground.covariance[shared[~tie]] + _EXACT**2 * np.eye(3)
    root[~tie] = np.linalg.inv(np.linalg.cholesky(spread))
    return _Prior(tie, position, root)


def _improved_positions(lines: Mapping[str, _Line], shared: np.ndarray, prior: _Prior) -> np.ndarray:
    """Return ground positions (n, 3) of n points that are accurate enough for linearisation, ITRS, in metres."""
    normal, right = prior.normal, np.zeros((len(shared), 3))
    for line in lines.values():
        which = np.searchsorted(shared, line.point)
        residual, slope = _residual_and_slope(line, prior.ground[which])
        weight = np.linalg.inv(line.covariance)
        good = np.all(np.isfinite(residual), axis=1) & np.all(np.isfinite(slope), axis=(1, 2))
        np.add.at(normal, which[good], np.einsum("nki,nkl,nlj->nij", slope, weight, slope)[good])
        np.add.at(right, which[good], np.einsum("nki,nkl,nl->ni", slope, weight, np.nan_to_num(residual))[good])
    alone = np.linalg.cond(normal) > 1e14
    normal[alone] = np.eye(3)
    step = np.linalg.solve(normal, right[..., None])[..., 0]
    return np.asarray(prior.ground + np.where(alone[:, None], 0.0, step))


def _residual_and_slope(line: _Line, ground: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return measured minus expected line and pixel, and derivatives with respect to the ground position.

    For n points these are (n, 2), in lines and pixels, and (n, 2, 3), in lines/m and pixels/m.
    """
    expected = np.stack(line.sensor.image(ground), axis=-1)
    by = [(np.stack(line.sensor.image(ground + _STEP * axis), axis=-1) - expected) / _STEP for axis in np.eye(3)]
    return line.image - expected, np.stack(by, axis=-1)


def _whitened_observations(
    lines: Mapping[str, _Line], shared: np.ndarray, ground: np.ndarray, prior: _Prior, search: JitterSearchSpec
) -> tuple[Observations, dict[str, np.ndarray]]:
    """Return whitened observations of the attitude, and measured minus expected positions by line, in pixels.

    Positions are (n, 2), line and pixel, for n points.
    """
    axes, count = len(search.axes), len(lines)
    size, width = len(shared), (search.interior + 1) + search.trend
    value, by = np.zeros((size, count, 2)), np.zeros((size, count, 2, 3))
    rotation, time = np.zeros((size, count, 2, axes)), np.zeros((size, count))
    spread = np.zeros((size, count, 2, count, 2))
    basis = _basis(lines, shared, search)
    seen = np.zeros((size, count), bool)
    residual = {}
    for k, (name, line) in enumerate(lines.items()):
        which = np.searchsorted(shared, line.point)
        positions = ground[which]
        difference, slope = _residual_and_slope(line, positions)
        expected = line.image - difference
        rotations = [(np.stack(s.image(positions), axis=-1) - expected) / _ROTATION for s in line.axes]
        good = np.max(np.abs(np.nan_to_num(difference, nan=np.inf)), axis=1) < _FAR
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
        before, difference = prior.of(rows, ground[rows])
        # combinations of observations that do not depend on the ground position
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
        raise SightsError("no point is seen by two lines within 200 pixels of its expected positions")
    parts = (values, groups, times, weights, columns, mixes)
    value, group, time, weight, nuisance, mix = (np.concatenate(part) for part in parts)
    return Observations.of(value, group, time, weight, nuisance, mix=mix), residual


def _moments(line: _Line, off: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Return the times at which n points cross a line, (n,), in seconds, without the noise of measured line numbers.

    A measured line number contains the same noise as the observation, so that a time that follows from it is correlated
    with the observation; where points lie on straight rows, the whole scatter of their times is this noise.

    Parameters
    ----------
    line : _Line
        Sightings with the measured positions.
    off : (n,) ndarray
        Measured minus expected line numbers; the part that is not smooth is treated as noise, within limits given by
        its sigma.
    basis : (n, width) ndarray
        Values of `width` smooth functions at the points.
    """
    sigma = np.sqrt(line.covariance[:, 0, 0])
    accepted = np.isfinite(off)
    for _ in range(_ROUNDS):
        if accepted.sum() < 2 * basis.shape[1]:
            return line.seconds
        remainder = off - basis @ np.linalg.lstsq(basis[accepted], off[accepted], rcond=None)[0]
        accepted = np.abs(remainder) <= _NOISE * np.maximum(sigma, robust_sigma(remainder[accepted]))
    noise = np.clip(np.nan_to_num(remainder), -_NOISE * sigma, _NOISE * sigma)
    return np.asarray(line.sensor.time(line.image[:, 0] - noise))


def _visibility_groups(seen: np.ndarray, tie: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Group the points by the set of lines that see them, separately for tie points and others.

    Each group is given by the indices (m,) of its m lines, at least two, and those (n,) of its n points.
    """
    groups = []
    for sort in (True, False):
        for pattern in np.unique(seen, axis=0):
            alike = np.all(seen == pattern, axis=1)
            rows = np.flatnonzero(alike & (tie if sort else ~tie))
            if pattern.sum() >= 2 and len(rows):
                groups.append((np.flatnonzero(pattern), rows))
    return groups


def _basis(lines: Mapping[str, _Line], shared: np.ndarray, search: JitterSearchSpec) -> np.ndarray:
    """Return `width` Legendre polynomials in position across the strip and in time, at n points, (n, width).

    They are the same for all lines: the part that is common to all lines only displaces the ground point and is
    eliminated with it.
    """
    total, seen = np.zeros((len(shared), 2)), np.zeros(len(shared))
    for line in lines.values():
        which = np.searchsorted(shared, line.point)
        np.add.at(total, which, np.stack([line.image[:, 1] / line.sensor.camera.pixels, line.seconds], axis=-1))
        np.add.at(seen, which, 1.0)
    at = total / seen[:, None]
    low, high = at.min(axis=0), at.max(axis=0)
    x, u = ((2.0 * at - low - high) / np.maximum(high - low, 1e-9)).T
    legendre = np.polynomial.legendre.legvander
    return np.concatenate([legendre(x, search.interior), legendre(u, search.trend)[:, 1:]], axis=1)


def _pairs(
    lines: Mapping[str, _Line], residual: Mapping[str, np.ndarray]
) -> tuple[dict[tuple[str, str], tuple[float, float, float]], dict[tuple[str, str], tuple[np.ndarray, np.ndarray]]]:
    """Return time gaps of all pairs of lines, and disparities of neighbouring lines without their smooth parts."""
    gaps, pairs = {}, {}
    for a, b in combinations(lines, 2):
        _, mine, theirs = np.intersect1d(lines[a].point, lines[b].point, return_indices=True)
        if not len(mine):
            continue
        seconds = lines[b].seconds[theirs] - lines[a].seconds[mine]
        low, middle, high = np.quantile(seconds, (0.05, 0.5, 0.95))
        gaps[a, b] = float(low), float(middle), float(high)
        if (a, b) not in pairwise(lines):
            continue
        moved = (residual[b][theirs] - residual[a][mine])[:, ::-1]
        at = lines[a].seconds[mine]
        scaled = [(2.0 * v - v.min() - v.max()) / max(float(np.ptp(v)), 1e-9) for v in (lines[a].image[mine, 1], at)]
        smooth = np.stack([scaled[0] ** i * scaled[1] ** j for i in range(4) for j in range(3 - min(i, 2))], axis=-1)
        good = np.all(np.isfinite(moved), axis=1)
        fit = np.linalg.lstsq(smooth[good], moved[good], rcond=None)[0]
        rows = np.argsort(at[good])
        pairs[a, b] = at[good][rows], (moved[good] - smooth[good] @ fit)[rows]
    return gaps, pairs
