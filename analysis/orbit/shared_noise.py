"""Noise of measured attitude and station that image points share: cubic splines through readings at fixed intervals.

Attitude and station of an exposure are interpolated between readings, so that points exposed within a few readings have
errors in common. The correction at time t is a cubic B-spline sum

    sigma * sum over k of beta(t / h - k) z_k,    readings at whole multiples of h,

which is the cubic spline through its own values at the readings (z_{k-1} + 4 z_k + z_{k+1}) / 6. Readings independent
with unit variance make z a stationary second-order autoregression with the double root -rho, rho = 2 - sqrt 3; its
covariance is 3 (-rho)^n (n + (1 + rho^2) / (1 - rho^2)), and the precision of a stretch of it has five diagonals. So
the z are unknowns of an adjustment with a sparse prior, and the correlation of any two image points is exact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import toeplitz
from scipy.spatial.transform import Rotation

from analysis.orbit.calibration_parameters import CalibrationError, CalibrationField, Noise, NoiseTerm
from analysis.orbit.three_line_model import Partials, Rays

__all__ = ["Series", "SharedNoise", "ray_covariance", "reading_variance", "spline_blend", "spline_precision"]

Array = NDArray[np.float64]
_RHO = 2.0 - np.sqrt(3.0)
# Stretches of z this far apart correlate by 1e-9 and are kept apart.
_GAP = 18
# z that one moment needs: no stretch is shorter.
_NEEDED = 4


def reading_variance(time: Array, interval: float) -> Array:
    """(n,) variance of the spline at times (n,) for readings of unit variance: 1 at a reading, 0.76 halfway."""
    _, blend = spline_blend(time, interval)
    return np.asarray(np.einsum("ni,ij,nj->n", blend, _covariance(_NEEDED), blend))


def ray_covariance(noise: Noise, rays: Rays, by: Partials, *, shared: bool) -> Array:
    """(n, 2, 2) covariance of image points, metres^2.

    Args:
        noise: model of the errors.
        rays: n image points.
        by: derivatives of their misclosures.
        shared: with the noise that they share, as for one point alone; otherwise without what SharedNoise carries.
    """
    unit = np.eye(2) if rays.spread is None else rays.spread
    spread = np.broadcast_to(noise.image**2 * unit, (len(rays.point), 2, 2))
    for term in noise.terms:
        part = {"attitude": by.attitude, "station": by.ground}[term.kind]
        variance = np.full(len(rays.point), term.sigma**2)
        if term.walks:
            if rays.time is None:
                raise CalibrationError("calibration: a random walk of the attitude needs the times of all rays")
            since = np.abs(rays.time - np.mean(rays.time)) if len(rays.time) else rays.time
            variance = variance * since / (term.interval or 1.0) * shared
        elif term.interval is not None and rays.time is not None:
            variance = variance * (reading_variance(rays.time, term.interval) if shared else 0.0)
        spread = spread + variance[:, None, None] * (part @ np.swapaxes(part, 1, 2))
    return np.asarray(spread)


@dataclass(frozen=True, eq=False)
class Series:
    """One term of the noise during one field.

    Attributes:
        term: which.
        column: of its first unknown; the three axes of a z follow each other, then the next z.
        numbers: (k,) of the z, in readings from time zero, rising, in stretches.
        precision: (k, k) sparse, of the z of one axis.
        places: line -> (n,) which z is the first of the four at each ray; blends: line -> (n, 4) their weights.
    """

    term: NoiseTerm
    column: int
    numbers: NDArray[np.intp]
    precision: sparse.csr_matrix
    places: Mapping[str, NDArray[np.intp]]
    blends: Mapping[str, Array]

    @property
    def size(self) -> int:
        """Unknowns."""
        return 3 * len(self.numbers)

    def correction(self, line: str, shared: Array) -> Array:
        """(n, 3) at the rays of a line: radians about the body axes or metres in ITRS, to be added to what is given."""
        z = shared[self.column : self.column + self.size].reshape(-1, 3)
        return np.asarray(self.term.sigma * np.einsum("nk,nka->na", self.blends[line], z[self._four(line)]))

    def correction_at(self, time: Array, shared: Array) -> Array:
        """(n, 3) at other times, for rays that took no part; zero, the prior's mean, far from all that did."""
        first, blend = spline_blend(time, self.term.interval or 1.0)
        wanted = first[:, None] + np.arange(_NEEDED)
        where = np.minimum(np.searchsorted(self.numbers, wanted), len(self.numbers) - 1)
        z = shared[self.column : self.column + self.size].reshape(-1, 3)[where]
        there = (self.numbers[where] == wanted)[:, :, None]
        return np.asarray(self.term.sigma * np.einsum("nk,nka->na", blend, np.where(there, z, 0.0)))

    def columns(self, line: str) -> NDArray[np.intp]:
        """(n, 4, 3) unknowns that each ray meets."""
        return np.asarray(self.column + 3 * self._four(line)[:, :, None] + np.arange(3))

    def _four(self, line: str) -> NDArray[np.intp]:
        return np.asarray(self.places[line][:, None] + np.arange(_NEEDED))


@dataclass(frozen=True, eq=False)
class SharedNoise:
    """All series of all fields.

    Attributes:
        series: field -> its terms.
        spans: first and last + 1 unknown of each field.
        groups: variance group -> its unknowns.
        precision: (K, K) sparse, of all unknowns.
    """

    series: Mapping[str, tuple[Series, ...]]
    spans: tuple[tuple[int, int], ...]
    groups: Mapping[str, NDArray[np.intp]]
    precision: sparse.csr_matrix

    @classmethod
    def of(cls, fields: Sequence[CalibrationField], noise: Noise) -> SharedNoise:
        """What the rays with times share; no unknowns where there are no times or no intervals."""
        series: dict[str, tuple[Series, ...]] = {}
        spans, blocks, column = [], [], 0
        groups: dict[str, list[NDArray[np.intp]]] = {}
        for one in fields:
            begin, mine = column, []
            for term in noise.terms:
                made = _series(one, term, column)
                if made is None:
                    continue
                mine.append(made)
                blocks.append(sparse.kron(made.precision, sparse.eye(3)))
                groups.setdefault(term.group, []).append(np.arange(column, column + made.size))
                column += made.size
            series[one.name] = tuple(mine)
            spans.append((begin, column))
        precision = sparse.csr_matrix(sparse.block_diag(blocks)) if blocks else sparse.csr_matrix((0, 0))
        return cls(series, tuple(spans), {k: np.concatenate(v) for k, v in groups.items()}, precision)

    @property
    def size(self) -> int:
        """K, unknowns."""
        return self.precision.shape[0]

    def corrected(self, name: str, line: str, rays: Rays, shared: Array) -> Rays:
        """Rays of a line of a field with the corrections (K,) applied.

        Args:
            name: of the field.
            line: of the camera.
            rays: of that line.
            shared: corrections of the noise that points share, (K,).
        """
        mine = [s for s in self.series[name] if line in s.places]
        return _moved(rays, [(s.term.kind, s.correction(line, shared)) for s in mine])

    def corrected_at(self, name: str, rays: Rays, shared: Array) -> Rays:
        """Other rays of a field, with times.

        Args:
            name: of the field.
            rays: with times.
            shared: corrections of the noise that points share, (K,).
        """
        assert rays.time is not None
        return _moved(rays, [(s.term.kind, s.correction_at(rays.time, shared)) for s in self.series[name]])

    def rows(self, name: str, line: str, white: Array, by: Partials) -> sparse.csr_matrix:
        """(2n, K) derivatives of the misclosures of a line by the unknowns, whitened by white (n, 2, 2).

        Args:
            name: of the field.
            line: of the camera.
            white: whitens the misclosures, (n, 2, 2).
            by: derivatives of the misclosures.
        """
        count, data, columns = len(white), [], []
        for one in self.series[name]:
            if line not in one.places:
                continue
            part = white @ {"attitude": by.attitude, "station": -by.ground}[one.term.kind] * one.term.sigma
            data.append((part[:, :, None, :] * one.blends[line][:, None, :, None]).reshape(count, 2, 12))
            columns.append(np.repeat(one.columns(line).reshape(count, 1, 12), 2, axis=1))
        width = 12 * len(data)
        if not data:
            return sparse.csr_matrix((2 * count, self.size))
        indptr = width * np.arange(2 * count + 1)
        parts = np.concatenate(data, axis=2).ravel(), np.concatenate(columns, axis=2).ravel(), indptr
        return sparse.csr_matrix(parts, shape=(2 * count, self.size))


def _moved(rays: Rays, corrections: Sequence[tuple[str, Array]]) -> Rays:
    if not corrections or not len(rays.point):
        return rays
    turn, shift = (sum((c for k, c in corrections if k == kind), np.zeros(3)) for kind in ("attitude", "station"))
    turns = Rotation.from_rotvec(np.broadcast_to(turn, rays.station.shape).copy()).as_matrix()
    return replace(rays, attitude=rays.attitude @ turns, station=rays.station + shift)


def _series(one: CalibrationField, term: NoiseTerm, column: int) -> Series | None:
    if term.interval is None:
        return None
    timed = {line: r.time for line, r in one.rays.items() if r.time is not None and r.point.size}
    if not timed:
        return None
    found = {line: spline_blend(time, term.interval) for line, time in timed.items()}
    used = np.unique(np.concatenate([first[:, None] + np.arange(_NEEDED) for first, _ in found.values()]))
    if term.walks:
        places = {line: np.searchsorted(used, first) for line, (first, _) in found.items()}
        return Series(term, column, used, _walk_precision(used), places, {k: b for k, (_, b) in found.items()})
    steps = np.diff(used)
    filled = [np.arange(a, a + s) for a, s in zip(used[:-1], np.where(steps < _GAP, steps, 1), strict=True)]
    numbers = np.concatenate([*filled, used[-1:]])
    cuts = np.flatnonzero(np.diff(numbers) > 1) + 1
    precision = sparse.block_diag([spline_precision(len(p)) for p in np.split(numbers, cuts)])
    places = {line: np.searchsorted(numbers, first) for line, (first, _) in found.items()}
    blends = {line: blend for line, (_, blend) in found.items()}
    return Series(term, column, numbers, sparse.csr_matrix(precision), places, blends)


def _walk_precision(numbers: NDArray[np.intp]) -> sparse.csr_matrix:
    """Precision of a random walk at whole numbers (k,), rising, that gains a variance of 1 from one to the next; the
    middle one, whose level the bias has, is known to as much.
    """
    count = len(numbers)
    steps = sparse.diags([-1.0, 1.0], [0, 1], shape=(count - 1, count))
    precision = steps.T @ sparse.diags(1.0 / np.diff(numbers)) @ steps
    middle = int(np.argmin(np.abs(numbers - np.mean(numbers))))
    return sparse.csr_matrix(precision + sparse.csr_matrix(([1.0], ([middle], [middle])), shape=(count, count)))


def spline_blend(time: Array, interval: float) -> tuple[NDArray[np.intp], Array]:
    """Number (n,) of the first of four cubic B-splines at times, and their values (n, 4)."""
    place = np.asarray(time, np.float64) / interval
    reading = np.floor(place)
    u = place - reading
    values = np.stack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, 3 * u * (1 + u - u**2) + 1, u**3], axis=-1)
    return np.asarray(reading, np.intp) - 1, np.asarray(values / 6.0, np.float64)


def _covariance(count: int) -> Array:
    """(count, count) of neighbouring z, for readings of unit variance."""
    n = np.arange(count)
    return np.asarray(toeplitz(3.0 * (-_RHO) ** n * (n + (1 + _RHO**2) / (1 - _RHO**2))))


def spline_precision(count: int) -> sparse.csr_matrix:
    """Inverse of `_covariance`, for four or more: inside the square of (1 4 1) / 6, special in two rows at each end."""
    bands = [np.full(count - abs(k), v / 36.0) for k, v in ((0, 18.0), (1, 8.0), (2, 1.0))]
    matrix = sparse.diags([bands[2], bands[1], bands[0], bands[1], bands[2]], [-2, -1, 0, 1, 2]).tolil()
    corner = np.linalg.inv(_covariance(_NEEDED))
    matrix[:2, :2], matrix[-2:, -2:] = corner[:2, :2], corner[-2:, -2:]
    return sparse.csr_matrix(matrix)
