"""The main peak of an MTF through focus, and the fit of a lobe to it, for many curves at once.

The formula and why it is used: analysis.focal_plane.through_focus.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["LEAST_POINTS", "WIDEST_FRACTION", "Lobe", "main_peak"]

Array = NDArray[np.float64]
LEAST_POINTS = 5
# Where the window holds too few points it may reach down to this part of the peak.
WIDEST_FRACTION = 0.3
_ROUNDS, _NEWTON_STEPS = 12, 4
# Relative change in a step below which a curve rests: a round more would change it by rounding.
_AT_REST = 1e-6


def main_peak(z: Array, v: Array, weight: Array, fraction: float) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Where the smoothed curve is largest, (B,), and the points from there on that stay above the fraction, (B, Z).

    The smoothing is a binomial of a twelfth of the scan's points, at least 1-2-1, weighted by the inverse variances.
    """
    count, size = z.shape
    top, bottom = v * weight, weight
    for _ in range(max(1, size // 12)):
        top, bottom = (
            0.5 * item + 0.25 * (np.pad(item, ((0, 0), (1, 0)))[:, :-1] + np.pad(item, ((0, 0), (0, 1)))[:, 1:])
            for item in (top, bottom)
        )
    # Only at points that were measured themselves.
    smooth = np.where(weight > 0, top / np.where(bottom > 0, bottom, 1.0), -np.inf)
    start = np.argmax(smooth, axis=1)
    low = (smooth < fraction * smooth[np.arange(count), start][:, None]) & (weight > 0)
    index = np.arange(size)[None, :]
    # At least two measured neighbours either way, so that the first fit has a curvature.
    rank = np.cumsum(weight > 0, axis=1)
    near = np.abs(rank - rank[np.arange(count), start][:, None]) <= 2
    left = np.max(np.where(low & (index < start[:, None]), index, -1), axis=1)
    right = np.min(np.where(low & (index > start[:, None]), index, size), axis=1)
    inside = (index > left[:, None]) & (index < right[:, None])
    return start, (inside | near) & (weight > 0)


class Lobe:
    """The fit v = p (1 - u + q u^2), u = a (x - x0)^2, of B curves; x is z about a centre in units of a scale."""

    def __init__(
        self, z: Array, v: Array, weight: Array, start: NDArray[np.intp], mask: NDArray[np.bool_], quartic: float
    ) -> None:
        rows = np.arange(len(z))
        self.z, self.v, self.weight, self.quartic = z, v, weight, quartic
        self.centre = z[rows, start]
        reach = np.max(np.where(mask, np.abs(z - self.centre[:, None]), 0.0), axis=1)
        self.scale = np.where(reach > 0, reach, 1.0)
        self.x = (z - self.centre[:, None]) / self.scale[:, None]
        measured = weight > 0
        self.ends = np.stack(
            [np.min(np.where(measured, self.x, np.inf), 1), np.max(np.where(measured, self.x, -np.inf), 1)]
        )
        # Counts positions and not points: repeats at one place do not make a curve.
        self.group = np.cumsum(np.diff(z, axis=1, prepend=z[:, :1]) > 0, axis=1)
        # A parabola to begin with; where it opens upward, a peak at the largest value that fills the window.
        design = np.stack([np.ones_like(self.x), self.x, self.x**2], axis=2)
        c0, c1, c2 = _solve(design, np.where(mask, weight, 0.0), v).T
        sound = (c2 < 0) & (c0 > 0)
        c2 = np.where(sound, c2, -1.0)
        x0 = np.where(sound, np.clip(-c1 / (2 * c2), -2.0, 2.0), 0.0)
        self.p = np.where(sound, c0 - c1**2 / (4 * c2), np.maximum(v[rows, start], 1e-300))
        self.a = np.where(sound, -c2 / self.p, 0.5)
        self.x0 = x0

    def settle(self, fraction: float, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Fit, choose the points within reach of the fitted vertex, and again, until both rest: (B, Z).

        A curve that does not come to rest gets all rounds, alone as in company.
        """
        for _ in range(_ROUNDS):
            moved = self._newton(mask, _NEWTON_STEPS)
            chosen, wider = self.window(fraction), self.window(min(fraction, WIDEST_FRACTION))
            chosen = np.where((self.positions(chosen) < LEAST_POINTS)[:, None], wider, chosen)
            chosen = np.where((self.positions(chosen) < LEAST_POINTS)[:, None], mask, chosen)
            if np.array_equal(chosen, mask) and np.all(moved < _AT_REST):
                break
            mask = chosen
        self._newton(mask, 2 * _NEWTON_STEPS)
        return mask

    def window(self, fraction: float) -> NDArray[np.bool_]:
        """Measured points where the fitted curve is above a fraction of its peak, (B, Z)."""
        away = np.abs(self.x - self.x0[:, None]) * self.scale[:, None]
        return (away <= self.reach(fraction)[:, None]) & (self.weight > 0)

    def reach(self, fraction: float) -> Array:
        """Distance from the vertex, (B,), at which the fitted curve has fallen to a fraction of its peak."""
        drop = 1.0 - fraction
        u = drop if self.quartic == 0 else (1.0 - np.sqrt(1.0 - 4 * self.quartic * drop)) / (2 * self.quartic)
        return np.asarray(np.sqrt(u / self.a) * self.scale)

    def positions(self, mask: NDArray[np.bool_]) -> NDArray[np.intp]:
        """How many different positions a choice of points has, (B,)."""
        present = np.zeros(mask.shape, dtype=bool)
        rows = np.broadcast_to(np.arange(len(mask))[:, None], mask.shape)
        present[rows[mask], self.group[mask]] = True
        return np.asarray(present.sum(axis=1))

    def _values(self) -> tuple[Array, Array]:
        """The curve (B, Z) and its derivatives with respect to p, x0 and a, (B, Z, 3)."""
        away = self.x - self.x0[:, None]
        p, a = self.p[:, None], self.a[:, None]
        u = a * away**2
        form, slope = 1.0 - u + self.quartic * u**2, 2 * self.quartic * u - 1.0
        return p * form, np.stack([form, -2 * a * away * p * slope, p * slope * away**2], axis=2)

    def _newton(self, mask: NDArray[np.bool_], steps: int) -> Array:
        """Gauss-Newton steps with the points of the mask; bounded, so that a bad curve cannot run away.

        Returns the last one's largest relative change, (B,), of x0 in widths of the lobe.
        """
        weight = np.where(mask, self.weight, 0.0)
        moved = np.full(len(mask), np.inf)
        for _ in range(steps):
            p, x0, a = self.p, self.x0, self.a
            value, slope = self._values()
            step = _solve(slope, weight, self.v - value)
            width = 1.0 / np.sqrt(self.a)
            self.p = np.clip(self.p + step[:, 0], 0.5 * self.p, 2.0 * self.p)
            self.x0 = self.x0 + np.clip(step[:, 1], -0.5 * width, 0.5 * width)
            self.x0 = np.clip(self.x0, self.ends[0] - 2.0 * width, self.ends[1] + 2.0 * width)
            self.a = np.clip(self.a + step[:, 2], 0.5 * self.a, 2.0 * self.a)
            self.a = np.clip(self.a, 1e-6, 1e6)
            moved = np.max(np.abs([self.p / p - 1.0, (self.x0 - x0) / width, self.a / a - 1.0]), axis=0)
        return moved

    def result(self, mask: NDArray[np.bool_]) -> tuple[Array, Array, Array, Array]:
        """Peak, position, second derivative, each (B,), and their covariance (B, 3, 3)."""
        _, slope = self._values()
        normal = np.einsum("bzi,bz,bzj->bij", slope, np.where(mask, self.weight, 0.0), slope)
        size = np.sqrt(np.einsum("bii->bi", normal))
        size = np.where(size > 0, size, 1.0)
        inverse = np.linalg.pinv(normal / (size[:, :, None] * size[:, None, :]), hermitian=True)
        covariance = inverse / (size[:, :, None] * size[:, None, :])
        turn = np.zeros_like(covariance)
        turn[:, 0, 0], turn[:, 1, 1] = 1.0, self.scale
        turn[:, 2, 0], turn[:, 2, 2] = -2 * self.a / self.scale**2, -2 * self.p / self.scale**2
        covariance = turn @ covariance @ np.swapaxes(turn, 1, 2)
        return self.p, self.centre + self.x0 * self.scale, -2 * self.p * self.a / self.scale**2, covariance

    def chi_square(self, mask: NDArray[np.bool_]) -> Array:
        """Weighted sum of squared residuals, (B,)."""
        return np.asarray(np.sum(np.where(mask, self.weight, 0.0) * (self.v - self._values()[0]) ** 2, axis=1))


def _solve(design: Array, weight: Array, data: Array) -> Array:
    """Weighted least squares of B curves, (B, P), from (B, Z, P), (B, Z), (B, Z); what is not observable stays zero."""
    normal = np.einsum("bzi,bz,bzj->bij", design, weight, design)
    right = np.einsum("bzi,bz->bi", design, weight * data)
    size = np.sqrt(np.einsum("bii->bi", normal))
    size = np.where(size > 0, size, 1.0)
    # The ridge is far below any noise and far above rounding: it keeps dead curves from stopping the others.
    scaled = normal / (size[:, :, None] * size[:, None, :]) + 1e-12 * np.eye(design.shape[2])
    return np.asarray(np.linalg.solve(scaled, (right / size)[:, :, None])[:, :, 0] / size)
