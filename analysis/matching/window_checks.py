"""Checks of a matched window: consistency of halves and scales, effect of relief and correlated residuals.

**Steps.** A window over a depth edge is fitted by the layer with more texture, and its covariance, which assumes one
displacement and stationary residuals, does not include this. So each window is cut into halves in four ways, along
rows, columns and both diagonals; each half is fitted by itself in one linear step, and the positions differ by

    position_A - position_B = J_A D_A r_A - J_B D_B r_B,   J = (D D')^-1,

with designs D (unknowns by pixel) and residuals r of the common fit. Halves share no pixel, so the covariance of the
difference is s^2 (J_A + J_B), plus the relief that all windows have.

A window that is weak in one half always passes. Whether that matters depends on the set of points: the share that fails
is the prior probability of an edge, and the power of the test, from the covariance, gives the posterior probability.
Where no window fails except by chance, weak ones are as good as their covariance.

**Relief.** The fit has one affine displacement for the whole window. Deviations of the ground from it leave a trace in
the residuals: slopes of the template times the local displacement. It is modelled as a random field d, of zero mean and
covariance

    tau^2 (1 + a) exp(-a),   a = sqrt(3) distance / length    (Matern, 3/2),

on 5 x 5 blocks, with the side of the window as its length; the two axes are alike and independent. With Z (pixels by
block and axis) the template's slopes, M the projection orthogonal to all other unknowns, residuals r = M (Z d + noise),
the score q = r'Z K Z'r has the expectation s^2 tr(K G) + tau^2 tr(K G K G), G = Z'M Z, and is the locally most powerful
test of tau = 0 (a score test of a variance component). Its moments give tau^2. The required position is that of the
window's middle, d(0); the difference from what the fit makes of d enters the covariance. Few points determine tau well
alone. So they share one tau^2, the mean weighted by precision, taken as the mean of its non-negative distribution;
points that deviate significantly have their own.

**Scales.** Errors of an image's fine detail displace it against coarse detail: noise of the template where slopes are
few, aliased edges, and patterns fixed to the pixels of one detector, which do not move with the scene. Each window is
fitted once more through a low-pass, in one linear step; the difference, beyond its noise, is shared by all points as a
covariance; points that deviate significantly are undetermined.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import EllipsisType

import numpy as np
from numpy.typing import NDArray
from scipy.stats import ncx2, norm

from analysis.arrays import Array

SPLITS = 4
"""Number of ways to halve a window: along rows, columns and both diagonals."""
FALSE_ALARM = 1e-3
"""False-alarm probability of the test for steps, per window."""
_CRITICAL = 2.0 * math.log(SPLITS / FALSE_ALARM)
"""Largest accepted chi-square, with two degrees of freedom, of the difference between the positions of two halves."""
STEP = 1.0
"""Step between the halves for which the power is computed, in pixels: what a search of whole pixels takes for another
position.
"""


@dataclass(frozen=True, eq=False)
class WindowHalves:
    """Differences between the positions of the halves of n fitted windows, in four splits; NaN without a fit.

    Attributes
    ----------
    apart : (n, 4, 2) ndarray
        Position of one half minus that of the other, in pixels.
    white : (n, 4, 2, 2) ndarray
        Covariance of the difference for white residuals of unit variance.
    effect : (n, 4, 2, 2) ndarray
        Covariance of the difference due to relief, that is displacements within the window, of 1 px standard deviation.
    """

    apart: Array
    white: Array
    effect: Array

    def judged(self, variance: Array, relief: float) -> tuple[Array, Array]:
        """Test whether the halves differ significantly, and compute the power of the test.

        Parameters
        ----------
        variance : (n,) ndarray
            Variance of the noise in each of n windows, including its correlation, in DN^2.
        relief : float
            Variance of the relief, the displacements of parts of a typical window from the common fit, in px^2.

        Returns
        -------
        tuple of (n,) ndarray
            p-value of the difference for one displacement field, and power: probability that the split with the least
            power detects a step of `STEP` in its worst direction. NaN where there is no fit.
        """
        matrix = variance[:, None, None, None] * self.white + relief * self.effect
        a, b, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
        x, y = np.moveaxis(self.apart, -1, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            square = ((d * x**2 - 2.0 * b * x * y + a * y**2) / (a * d - b**2)).max(axis=1)
            worst = (0.5 * (a + d) + np.hypot(0.5 * (a - d), b)).max(axis=1)
        # chi-square of two; the largest of the splits
        p_value = np.minimum(SPLITS * np.exp(-0.5 * square), 1.0)
        return p_value, np.asarray(ncx2.sf(_CRITICAL, 2, STEP**2 / worst))


def risk(share: float, power: Array) -> Array:
    """Return the probability that a window that passed the test still has a displacement step, by Bayes' rule.

    The prior probability is the fraction `share` of all windows that fail; `power` is the power of the test for each
    window. The result has the shape of `power`.
    """
    return share * (1.0 - power) / (1.0 - share * power)


def window_halves(design: Array, residual: Array, side: int) -> WindowHalves:
    """Compute the differences between the halves of square windows.

    Parameters
    ----------
    design : (n, q, p) ndarray
        Derivatives of the p grey values of the model with respect to the q unknowns of n fits, the first two those of
        position.
    residual : (n, p) ndarray
        Residuals, grey values; NaN where there is no fit.
    side : int
        Side of the windows, in pixels, with p = side^2.
    """
    count = len(design)
    apart = np.full((count, SPLITS, 2), np.nan)
    white, effect = np.full((2, count, SPLITS, 2, 2), np.nan)
    scale = np.sqrt(np.einsum("nqp,nqp->nq", design, design))
    used = np.flatnonzero(np.isfinite(residual).all(axis=1) & np.all(scale > 0, axis=1))
    if not used.size:
        return WindowHalves(apart, white, effect)
    share, field, _middle = relief_field(side)
    field_of_axes = np.kron(np.eye(2), field)
    scaled = design[used] / scale[used, :, None]
    first = scale[used, :2]
    slope = design[used, :2]
    for k, mask in enumerate(_halves(side)):
        difference, noise, relief_response = (
            np.zeros((len(used), 2)),
            np.zeros((len(used), 2, 2)),
            np.zeros((len(used), 2, len(field_of_axes))),
        )
        for sign, half in ((1.0, mask), (-1.0, ~mask)):
            part = scaled[:, :, half]
            # position only; pseudo-inverse, because little texture may leave unknowns undetermined
            inverse = np.linalg.pinv(part @ np.swapaxes(part, 1, 2), rcond=1e-11, hermitian=True)
            influence = (inverse[:, :2] @ part) / first[:, :, None]
            difference += sign * np.einsum("nip,np->ni", influence, residual[used][:, half])
            noise += inverse[:, :2, :2] / (first[:, :, None] * first[:, None])
            axis_responses = [(influence * slope[:, a][:, None, half]) @ share[half] for a in range(2)]
            relief_response += sign * np.concatenate(axis_responses, axis=2)
        apart[used, k], white[used, k] = difference, noise
        effect[used, k] = relief_response @ field_of_axes @ np.swapaxes(relief_response, 1, 2)
    return WindowHalves(apart, white, effect)


def _halves(side: int) -> list[NDArray[np.bool_]]:
    """Return, for each split, the mask of one half of a window's p pixels; the middle line is in the other half."""
    row, column = (g.ravel() for g in np.mgrid[:side, :side] - side // 2)
    return [row > 0, column > 0, row + column > 0, row - column > 0]


LAG = 3
"""Largest lag of correlated residuals, in pixels along rows and columns."""
_LAGS = [(r, c) for r in range(LAG + 1) for c in range(-LAG, LAG + 1) if r > 0 or c > 0]
"""Lags (rows, columns) of the correlation of residuals, in pixels: one of each pair of opposite lags."""
_LEAST = 0.5
"""Smallest variance relative to that for white residuals: noisy estimates of the correlation must not reduce the
variance of a position below it.
"""


@dataclass(frozen=True, eq=False)
class ResidualCorrelation:
    """Correlation of the residuals of n fits between neighbouring pixels, at half of the lags up to `LAG` pixels.

    Attributes
    ----------
    variance : (n,) ndarray
        Variance of the residuals from the redundancy, in DN^2.
    white : (n, 2, 2) ndarray
        Covariance of the position for white residuals of unit variance; NaN where most of the information is noise of
        the template.
    influence : (n, lags, 2, 2) ndarray
        Increase of that covariance due to a correlation of 1 at a lag and at its opposite.
    correlation : (n, lags) ndarray
        Correlation of the residuals, corrected for the effect of the fit on white noise.
    pixels, unknowns : (n,) ndarray of int
        Number of pixels and unknowns of the fits.
    """

    variance: Array
    white: Array
    influence: Array
    correlation: Array
    pixels: NDArray[np.intp]
    unknowns: NDArray[np.intp]

    @property
    def plain(self) -> Array:
        """Covariances of the n positions if residuals of different pixels are uncorrelated, (n, 2, 2), in px^2."""
        return np.asarray(self.variance[:, None, None] * self.white)

    def covariance(self, good: NDArray[np.bool_]) -> Array:
        """Return the covariance of the n positions, in px^2, allowing for correlated residuals.

        The correlation is the median over the points selected by the mask `good` (n,).
        """
        correlations = self.correlation[good & np.isfinite(self.variance)]
        if not len(correlations):
            return self.plain
        matrix = self.white + np.einsum("l,nlij->nij", np.median(correlations, axis=0), self.influence)
        # relative to the white covariance, so that the lower bound holds in every direction
        (a, b), (_, c) = np.moveaxis(self.white, 0, -1)
        # NaN, where there is no fit, compares false
        finite = a * c > b * b
        matrix[~finite] = np.nan
        root = np.linalg.cholesky(self.white[finite])
        inverse_root = np.linalg.inv(root)
        value, vector = np.linalg.eigh(inverse_root @ matrix[finite] @ np.swapaxes(inverse_root, 1, 2))
        axes = root @ vector
        matrix[finite] = (axes * np.maximum(value, _LEAST)[:, None, :]) @ np.swapaxes(axes, 1, 2)
        return np.asarray(self.variance[:, None, None] * matrix)


def residual_correlation(
    design: Array, residual: Array, side: int, inverse: Array | None = None
) -> ResidualCorrelation:
    """Compute the correlation of the residuals of square windows.

    Parameters
    ----------
    design : (n, q, p) ndarray
        Derivatives of the p grey values of the model with respect to the q unknowns of n fits, the first two those of
        position.
    residual : (n, p) ndarray
        Residuals, grey values; NaN where there is no fit.
    side : int
        Side of the windows, in pixels, with p = side^2.
    inverse : (n, q, q) ndarray, optional
        Inverse curvature by which the unknowns respond to residuals (`analysis.matching.least_squares`); NaN where it
        is unknown. The inverse normal matrix by default.
    """
    count, unknowns, pixels = design.shape
    variance = np.full(count, np.nan)
    white = np.full((count, 2, 2), np.nan)
    influence = np.full((count, len(_LAGS), 2, 2), np.nan)
    correlation = np.full((count, len(_LAGS)), np.nan)
    size = np.full(count, pixels), np.full(count, unknowns)
    scale = np.sqrt(np.einsum("nqp,nqp->nq", design, design))
    used = np.flatnonzero(np.isfinite(residual).all(axis=1) & np.all(scale > 0, axis=1))
    if not used.size:
        return ResidualCorrelation(variance, white, influence, correlation, *size)
    scaled = design[used] / scale[used, :, None]
    # pseudo-inverse, because little texture may leave unknowns undetermined
    normal = np.linalg.pinv(scaled @ np.swapaxes(scaled, 1, 2), rcond=1e-11, hermitian=True)
    hat = (normal @ scaled).reshape(len(used), unknowns, side, side)
    if inverse is None:
        influence_of_position = hat[:, :2] / scale[used, :2, None, None]
    else:
        influence_of_position = (inverse[used, :2] @ design[used]).reshape(len(used), 2, side, side)
    column = scaled.reshape(hat.shape)
    residuals = residual[used].reshape(-1, side, side)
    square = np.maximum(np.einsum("nij,nij->n", residuals, residuals), 1e-300)
    variance[used] = square / (pixels - unknowns)
    white[used] = np.einsum("niab,njab->nij", influence_of_position, influence_of_position)
    influence[used] = _lagged(influence_of_position)
    for k, (r, c) in enumerate(_LAGS):
        here, there = _overlap(side, r, c)
        pairs = (side - r) * (side - abs(c))
        # the fit takes this covariance out of white noise
        loss = np.einsum("nqab,nqab->n", hat[here], column[there])
        product = np.einsum("nab,nab->n", residuals[here], residuals[there])
        correlation[used, k] = (product / variance[used] + loss) / pairs
    return ResidualCorrelation(variance, white, influence, correlation, *size)


_Window = tuple[EllipsisType, slice, slice]


def _overlap(side: int, row: int, column: int) -> tuple[_Window, _Window]:
    """Return slices of the pixels of a window that have a neighbour at a lag, and of these neighbours."""
    here: _Window = (..., slice(0, side - row), slice(max(-column, 0), side - max(column, 0)))
    return here, (..., slice(row, side), slice(max(column, 0), side - max(-column, 0)))


def _lagged(influence: Array) -> Array:
    """Return the increase of the covariances of n positions due to residuals correlated at a lag, (n, lags, 2, 2).

    The correlation is 1 at the lag and its opposite. `influence`, (n, 2, side, side), is the derivative of row and
    column with respect to the grey values of the window.
    """
    out = np.empty((len(influence), len(_LAGS), 2, 2))
    for k, (r, c) in enumerate(_LAGS):
        here, there = _overlap(influence.shape[-1], r, c)
        product = np.einsum("niab,njab->nij", influence[here], influence[there])
        out[:, k] = product + np.swapaxes(product, 1, 2)
    return out


_COARSE = 2.0
"""RMS radius of the Gaussian that separates coarse from fine detail, in pixels: noise, aliasing and patterns of a
detector's pixels are fine.
"""
_DISCORDANT = 2.0 * math.log(1e3)
"""Squared, normalised difference between the positions of coarse and of all detail that chance exceeds with a
probability of 1e-3 (chi-square with two degrees of freedom).
"""
_SIGNIFICANT = 2.0
"""Significance, in standard deviations, above which the excess variance of the differences between coarse and all
detail is added to the covariance of all points.
"""
_CLIPPED = 3.0
"""Largest normalised distance with which a point enters the common estimate, in units of the median distance."""


@dataclass(frozen=True, eq=False)
class WindowScales:
    """Differences between the positions of coarse detail and of all detail in n fits; NaN where there is no fit.

    Attributes
    ----------
    apart : (n, 2) ndarray
        Position from coarse detail minus that from all detail, in row and column, in pixels.
    spread : ResidualCorrelation
        Correlation of the residuals, which gives the covariance of the differences.
    """

    apart: Array
    spread: ResidualCorrelation

    def excess(self, factor: Array, good: NDArray[np.bool_]) -> Array:
        """Return the covariance of differences between coarse and all detail beyond their noise, (n, 2, 2), in px^2.

        It is NaN for points that deviate significantly from the others.

        Parameters
        ----------
        factor : (n,) ndarray
            Factor on the variance of the noise at each of n points.
        good : (n,) ndarray of bool
            Points from which the common excess is estimated.
        """
        covariance = self.spread.covariance(good) * factor[:, None, None]
        determined = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(self.apart).all(axis=1)
        common = determined & good
        out = np.zeros_like(covariance)
        if not common.any():
            return out
        size = np.sqrt(_square(self.apart[common], covariance[common]))
        clipped = np.minimum(1.0, _CLIPPED * np.median(size) / np.maximum(size, 1e-300))[:, None] * self.apart[common]
        weight = 1.0 / np.trace(covariance[common], axis1=1, axis2=2) ** 2
        weight /= weight.sum()
        noise = np.einsum("n,nij->ij", weight, covariance[common])
        value, vector = np.linalg.eigh(np.einsum("n,ni,nj->ij", weight, clipped, clipped) - noise)
        noise_level = np.sqrt(2.0 * np.sum(weight**2)) * np.einsum("ik,ij,jk->k", vector, noise, vector)
        shared = (vector * np.where(value > _SIGNIFICANT * noise_level, value, 0.0)) @ vector.T
        out += shared
        discordant = np.zeros(len(out), bool)
        discordant[determined] = _square(self.apart[determined], covariance[determined] + shared) > _DISCORDANT
        # two motions, or one outside the model
        out[discordant] = np.nan
        return out


def window_scales(design: Array, residual: Array, side: int, spread: ResidualCorrelation) -> WindowScales:
    """Compute the differences between coarse and all detail of square windows.

    With the derivatives D (unknowns by pixel) and the residuals r, a fit to the low-passed window differs by (D W
    D')^-1 D W r - (D D')^-1 D r, with W the low-pass applied twice: if the model is right both see the same position,
    and the difference is noise (Hausman, Econometrica 46(6), 1978).

    Parameters
    ----------
    design : (n, q, p) ndarray
        Derivatives of the p grey values of the model with respect to the q unknowns of n fits, the first two those of
        position.
    residual : (n, p) ndarray
        Residuals, grey values; NaN where there is no fit.
    side : int
        Side of the windows, in pixels, with p = side^2.
    spread : ResidualCorrelation
        Correlation of the residuals.
    """
    apart = np.full((len(design), 2), np.nan)
    white, influence = np.full_like(spread.white, np.nan), np.full_like(spread.influence, np.nan)
    scale = np.sqrt(np.einsum("nqp,nqp->nq", design, design))
    used = np.flatnonzero(np.isfinite(residual).all(axis=1) & np.all(scale > 0, axis=1))
    if used.size:
        line = np.arange(side)
        low = np.exp(-0.5 * ((line[:, None] - line) / _COARSE) ** 2)
        low /= low.sum(axis=1, keepdims=True)
        scaled = design[used] / scale[used, :, None]
        twice = low.T @ low
        coarse = (twice @ scaled.reshape(*scaled.shape[:2], side, side) @ twice).reshape(scaled.shape)
        parts = [
            np.linalg.pinv(low_passed_design @ np.swapaxes(scaled, 1, 2), rcond=1e-9, hermitian=True)[:, :2]
            @ low_passed_design
            for low_passed_design in (coarse, scaled)
        ]
        influence_of_position = (parts[0] - parts[1]) / scale[used, :2, None]
        apart[used] = np.einsum("nip,np->ni", influence_of_position, residual[used])
        influence_of_position = influence_of_position.reshape(len(used), 2, side, side)
        white[used], influence[used] = (
            np.einsum("niab,njab->nij", influence_of_position, influence_of_position),
            _lagged(influence_of_position),
        )
    return WindowScales(apart, replace(spread, white=white, influence=influence))


def _square(apart: Array, covariance: Array) -> Array:
    """Return the squared differences of n positions, (n, 2), normalised by their covariances (n, 2, 2)."""
    return np.asarray(np.einsum("ni,ni->n", apart, np.linalg.solve(covariance, apart[..., None])[..., 0]))


_BLOCKS = 5
"""Number of blocks of constant relief along each side of a window."""
_LENGTH = 1.0
"""Correlation length of the relief over the window's side: a shorter one would act as noise on the affine change, a
longer one follows it.
"""
_SIGNIFICANT_SIGMAS = 4.0
"""Relief variance tau^2 of a point, in units of its standard deviation without relief, above which the point uses its
own value and not the common one; chance exceeds it with a probability of about 1e-3.
"""
_HELD = 2.5
"""Largest relief variance tau^2 of a point that enters the common mean, in its standard deviations without relief;
larger ones are limited to it.
"""


@dataclass(frozen=True, eq=False)
class WindowRelief:
    """Evidence of relief within windows from the residuals of n fits; NaN where there is no fit.

    Attributes
    ----------
    score : (n,) ndarray
        Score q, a quadratic form of the residuals that grows with relief, in DN^2.
    first : (n,) ndarray
        Expectation of the score for white residuals of unit variance (tr(K G) in the module's description).
    second : (n,) ndarray
        Expectation of the score for relief of 1 px standard deviation and no noise (tr(K G K G) in the module's
        description), in DN^2 px^-2.
    redundancy : (n,) ndarray
        Redundancy of the fit.
    effect : (n, 2, 2) ndarray
        Covariance of the position due to relief of 1 px standard deviation.
    """

    score: Array
    first: Array
    second: Array
    redundancy: Array
    effect: Array

    def square(self, variance: Array, coloured: Array, good: NDArray[np.bool_]) -> tuple[Array, float]:
        """Return the variance of the displacements within the window, tau^2, for each of n points and a typical one.

        Parameters
        ----------
        variance : (n,) ndarray
            Variance of the residuals from the redundancy, in DN^2.
        coloured : (n,) ndarray
            Factor by which the correlation of residuals raises the covariance of the position.
        good : (n,) ndarray of bool
            Points from which the common tau^2 is estimated.

        Returns
        -------
        tuple of ((n,) ndarray, float)
            tau^2 of each point and of a typical point, in px^2.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            # relief also raises the residuals' variance, from which the noise part of the score is computed
            rise = self.second - coloured * self.first**2 / self.redundancy
            estimate = (self.score - variance * coloured * self.first) / rise
            error = variance * coloured * np.sqrt(2.0 * self.second) / rise
        determined = np.isfinite(estimate) & (rise > 0) & (error > 0)
        significant = np.zeros(len(estimate), bool)
        significant[determined] = estimate[determined] > _SIGNIFICANT_SIGMAS * error[determined]
        common = determined & good
        weight = 1.0 / error[common] ** 2
        # limit outliers instead of excluding them, which would make the common relief too small
        limited = np.minimum(estimate, _HELD * error)[common]
        total = float(weight.sum())
        shared = _not_negative(float(weight @ limited) / total, total**-0.5) if common.any() else 0.0
        tau = np.where(significant, np.maximum(np.where(determined, estimate, 0.0), shared), shared)
        # at low noise, windows differ by their random fields, and the limited mean is below the typical value
        return tau, max(shared, float(np.median(estimate[common]))) if common.any() else shared


def _not_negative(value: float, error: float) -> float:
    """Return the mean of a normal distribution truncated to positive values.

    It is small but positive for weak data.
    """
    at = value / error
    return value + error * float(np.exp(norm.logpdf(at) - norm.logcdf(at)))


def window_relief(design: Array, residual: Array, side: int) -> WindowRelief:
    """Compute the evidence of relief within square windows.

    Parameters
    ----------
    design : (n, q, p) ndarray
        Derivatives of the p grey values of the model with respect to the q unknowns of n fits, the first two those of
        position.
    residual : (n, p) ndarray
        Residuals, grey values; NaN where there is no fit.
    side : int
        Side of the windows, in pixels, with p = side^2.
    """
    count, unknowns, pixels = design.shape
    score, first, second, redundancy = np.full((4, count), np.nan)
    effect = np.full((count, 2, 2), np.nan)
    scale = np.sqrt(np.einsum("nqp,nqp->nq", design, design))
    used = np.flatnonzero(np.isfinite(residual).all(axis=1) & np.all(scale > 0, axis=1))
    if not used.size:
        return WindowRelief(score, first, second, redundancy, effect)
    share, field, middle = relief_field(side)
    scaled = design[used] / scale[used, :, None]
    inverse = np.linalg.pinv(scaled @ np.swapaxes(scaled, 1, 2), rcond=1e-11, hermitian=True)
    slope = design[used, :2]
    # derivatives by the blocks' displacement along each axis, (n, 2, ..., blocks), joined to (n, ..., 2 blocks)
    by_block = np.einsum("nap,pb->nab", slope * residual[used, None], share).reshape(len(used), -1)
    shared = np.stack([(scaled * slope[:, a, None]) @ share for a in range(2)], axis=2)
    shared = shared.reshape(len(used), unknowns, -1)
    square = np.zeros((len(used), 2, len(field), 2, len(field)))
    diagonal = np.arange(len(field))
    for a in range(2):
        for b in range(2):
            square[:, a, diagonal, b, diagonal] = (slope[:, a] * slope[:, b]) @ share
    free = square.reshape(len(used), 2 * len(field), 2 * len(field))
    free = free - np.swapaxes(shared, 1, 2) @ inverse @ shared
    field_of_axes, at_middle = np.kron(np.eye(2), field), np.kron(np.eye(2), middle)
    product = field_of_axes @ free
    score[used] = np.einsum("ni,ij,nj->n", by_block, field_of_axes, by_block)
    first[used] = np.trace(product, axis1=1, axis2=2)
    second[used] = np.einsum("nij,nji->n", product, product)
    redundancy[used] = pixels - unknowns
    response = (inverse[:, :2] @ shared) / scale[used, :2, None]
    cross = at_middle @ np.swapaxes(response, 1, 2)
    effect[used] = np.eye(2) - cross - np.swapaxes(cross, 1, 2) + response @ field_of_axes @ np.swapaxes(response, 1, 2)
    return WindowRelief(score, first, second, redundancy, effect)


def relief_field(side: int) -> tuple[Array, Array, Array]:
    """Return the blocks of a window's pixels, and the correlations of relief between blocks and with the middle.

    For p pixels and b blocks, the assignment of pixels to blocks is (p, b), the correlation between blocks (b, b), and
    that of the window's middle with the blocks (1, b).
    """
    line = np.arange(side) - side // 2
    block_of_line = np.arange(side) * _BLOCKS // side
    block = (_BLOCKS * block_of_line[:, None] + block_of_line).ravel()
    share = (block[:, None] == np.arange(_BLOCKS**2)).astype(np.float64)
    positions = np.stack([g.ravel() for g in np.meshgrid(line, line, indexing="ij")], axis=1).astype(np.float64)
    centre = (share.T @ positions) / share.sum(axis=0)[:, None]
    distances = np.linalg.norm(centre[:, None] - centre, axis=2), np.linalg.norm(centre, axis=1)[None]
    steps = (np.sqrt(3.0) * d / (_LENGTH * side) for d in distances)
    field, middle = ((1.0 + a) * np.exp(-a) for a in steps)
    return share, field, middle
