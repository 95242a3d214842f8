"""Do the two halves of a window put the point at the same place? A test of the model: one displacement field.

A window over an edge of depth is fitted by the layer with more texture, and its covariance, which assumes one
displacement and stationary residuals, does not know. So each window is cut into halves in four ways, along rows,
columns and both diagonals; each half is fitted by itself in one linear step, and the places differ by

    place_A - place_B = J_A D_A r_A - J_B D_B r_B,   J = (D D')^-1,

with designs D (unknowns by pixel) and residuals r of the common fit. Halves share no pixel, so its covariance is
s^2 (J_A + J_B), and more by the relief that all windows have (`analysis.matching.window_relief`).

A window that is weak in one half passes whatever is there. Whether that matters says the set of points: the share that
fails is the chance of an edge before the test, and the power of the test, which the covariance gives, what is left of
it after. Where no window fails but by chance, weak ones are as good as their covariance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import ncx2

from analysis.matching.window_relief import relief_field

__all__ = ["FALSE_ALARM", "STEP", "WindowHalves", "risk", "window_halves"]

Array = NDArray[np.float64]
# Ways to halve a window.
SPLITS = 4
# Of the test, a window.
FALSE_ALARM = 1e-3
# Between the halves that a window must be able to show, px: what a search of whole pixels takes for another place.
STEP = 1.0


@dataclass(frozen=True, eq=False)
class WindowHalves:
    """Of n fits and four splits; NaN where there is none.

    Attributes:
        apart: (n, 4, 2) place of the one half minus that of the other, px.
        white: (n, 4, 2, 2) its covariance for white residuals of unit variance.
        effect: (n, 4, 2, 2) its covariance for relief of tau 1 px.
    """

    apart: Array
    white: Array
    effect: Array

    def judged(self, variance: Array, relief: float) -> tuple[Array, Array]:
        """Are the halves too far apart, and could the test tell?

        Args:
            variance: (n,) of the noise, DN^2, with its colour.
            relief: tau^2 of a window that is like most, px^2.

        Returns:
            (n,) chance that halves of one displacement field are so far apart; (n,) power: chance that the split with
            the least power notices a step of `STEP` in its worst direction. NaN where there is no fit.
        """
        matrix = variance[:, None, None, None] * self.white + relief * self.effect
        a, b, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
        x, y = np.moveaxis(self.apart, -1, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            square = ((d * x**2 - 2.0 * b * x * y + a * y**2) / (a * d - b**2)).max(axis=1)
            worst = (0.5 * (a + d) + np.hypot(0.5 * (a - d), b)).max(axis=1)
        # chi-square of two; the largest of the splits
        chance = np.minimum(SPLITS * np.exp(-0.5 * square), 1.0)
        return chance, np.asarray(ncx2.sf(_critical(), 2, STEP**2 / worst))


def risk(share: float, power: Array) -> Array:
    """(n,) chance that a window that passed holds a step, where a share of all windows is found to hold one (Bayes)."""
    return share * (1.0 - power) / (1.0 - share * power)


def window_halves(design: Array, residual: Array, side: int) -> WindowHalves:
    """From designs (n, q, p), the first two columns by place, and residuals (n, p) of square windows; NaN: no fit.

    Args:
        design: derivatives of the model, (n, q, p), the first two by place.
        residual: (n, p), grey values; NaN where there is no fit.
        side: of the windows, px, with p = side^2.
    """
    count = len(design)
    apart = np.full((count, SPLITS, 2), np.nan)
    white, effect = np.full((2, count, SPLITS, 2, 2), np.nan)
    scale = np.sqrt(np.einsum("nqp,nqp->nq", design, design))
    used = np.flatnonzero(np.isfinite(residual).all(axis=1) & np.all(scale > 0, axis=1))
    if not used.size:
        return WindowHalves(apart, white, effect)
    share, field, _middle = relief_field(side)
    both = np.kron(np.eye(2), field)
    scaled = design[used] / scale[used, :, None]
    first = scale[used, :2]
    slope = design[used, :2]
    for k, one in enumerate(_halves(side)):
        found, noise, taken = np.zeros((len(used), 2)), np.zeros((len(used), 2, 2)), np.zeros((len(used), 2, len(both)))
        for sign, half in ((1.0, one), (-1.0, ~one)):
            part = scaled[:, :, half]
            # the place alone; a pseudo-inverse, because some unknowns may be open where there is little texture
            inverse = np.linalg.pinv(part @ np.swapaxes(part, 1, 2), rcond=1e-11, hermitian=True)
            place = (inverse[:, :2] @ part) / first[:, :, None]
            found += sign * np.einsum("nip,np->ni", place, residual[used][:, half])
            noise += inverse[:, :2, :2] / (first[:, :, None] * first[:, None])
            parts = [(place * slope[:, a][:, None, half]) @ share[half] for a in range(2)]
            taken += sign * np.concatenate(parts, axis=2)
        apart[used, k], white[used, k] = found, noise
        effect[used, k] = taken @ both @ np.swapaxes(taken, 1, 2)
    return WindowHalves(apart, white, effect)


def _critical() -> float:
    """Of the largest chi-square of the splits, two degrees of freedom each."""
    return 2.0 * math.log(SPLITS / FALSE_ALARM)


def _halves(side: int) -> list[NDArray[np.bool_]]:
    """(p,) one of the two halves each; the middle line is the other's."""
    row, column = (g.ravel() for g in np.mgrid[:side, :side] - side // 2)
    return [row > 0, column > 0, row + column > 0, row - column > 0]
