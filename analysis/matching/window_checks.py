"""Checks of a matched window: do its halves agree, and what relief and correlated residuals add to the covariance.

A window over an edge of depth is fitted by the layer with more texture, and its covariance, which assumes one
displacement and stationary residuals, does not know. So each window is cut into halves in four ways, along rows,
columns and both diagonals; each half is fitted by itself in one linear step, and the places differ by

    place_A - place_B = J_A D_A r_A - J_B D_B r_B,   J = (D D')^-1,

with designs D (unknowns by pixel) and residuals r of the common fit. Halves share no pixel, so its covariance is
s^2 (J_A + J_B), and more by the relief that all windows have (`analysis.matching.window_checks`).

A window that is weak in one half passes whatever is there. Whether that matters says the set of points: the share that
fails is the chance of an edge before the test, and the power of the test, which the covariance gives, what is left of
it after. Where no window fails but by chance, weak ones are as good as their covariance.

The fit takes one affine displacement for the whole window. What the ground adds to it leaves a trace in the residuals:
slopes of the template times the local displacement. It is looked for as a random field d, of zero mean and covariance

    tau^2 (1 + a) exp(-a),   a = sqrt(3) distance / length    (Matern, 3/2),

on 5 x 5 blocks, with the side of the window for its length; both axes alike and independent. With Z (pixels by
block and axis) the template's slopes, M the projection that fits everything else out, residuals r = M (Z d + noise),
the score q = r'Z K Z'r has the expectation s^2 tr(K G) + tau^2 tr(K G K G), G = Z'M Z, and is the locally most powerful
test of tau = 0 (a score test of a variance component). Its moments give tau^2; the place sought is that of the window's
middle, d(0), and what the fit makes of d instead stands in the covariance.

What is wrong with an image's fine detail puts it elsewhere than coarse detail: noise of the template where slopes are
few, aliased edges, and patterns that are fixed to the pixels of one detector, which do not move with the scene. Each
window is fitted once more through a low pass, in one linear step; how far that lies away, beyond the noise of the
difference, all points share as a covariance; those that stand out are not known.

Few points say enough about tau alone. So they share one tau^2, the mean with the weights of its precision, taken as the
mean of what it may be without being negative; those that stand out have their own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import EllipsisType

import numpy as np
from numpy.typing import NDArray
from scipy.stats import ncx2, norm

from analysis.arrays import Array

# Ways to halve a window.
SPLITS = 4
# Of the test, a window.
FALSE_ALARM = 1e-3
# Largest chi-square of the splits, which have two degrees of freedom each.
_CRITICAL = 2.0 * math.log(SPLITS / FALSE_ALARM)
# Between the halves that a window must be able to show, px: what a search of whole pixels takes for another place.
STEP = 1.0


@dataclass(frozen=True, eq=False)
class WindowHalves:
    """How far apart halves of windows put the places of n fits, in four splits; NaN where there is no fit.

    Attributes
    ----------
    apart : Array
        (n, 4, 2) place of the one half minus that of the other, px.
    white : Array
        (n, 4, 2, 2) its covariance for white residuals of unit variance.
    effect : Array
        (n, 4, 2, 2) its covariance for relief of tau 1 px.
    """

    apart: Array
    white: Array
    effect: Array

    def judged(self, variance: Array, relief: float) -> tuple[Array, Array]:
        """Are the halves too far apart, and could the test tell?

        Parameters
        ----------
        variance : Array
            (n,) of the noise, DN^2, with its colour.
        relief : float
            Tau^2 of a window that is like most, px^2.

        Returns
        -------
        tuple[Array, Array]
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
        return chance, np.asarray(ncx2.sf(_CRITICAL, 2, STEP**2 / worst))


def risk(share: float, power: Array) -> Array:
    """(n,) chance that a window that passed holds a step, where a share of all windows is found to hold one (Bayes)."""
    return share * (1.0 - power) / (1.0 - share * power)


def window_halves(design: Array, residual: Array, side: int) -> WindowHalves:
    """From designs (n, q, p), the first two columns by place, and residuals (n, p) of square windows; NaN: no fit.

    Parameters
    ----------
    design : Array
        Derivatives of the model, (n, q, p), the first two by place.
    residual : Array
        (n, p), grey values; NaN where there is no fit.
    side : int
        Of the windows, px, with p = side^2.
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


def _halves(side: int) -> list[NDArray[np.bool_]]:
    """(p,) one of the two halves each; the middle line is the other's."""
    row, column = (g.ravel() for g in np.mgrid[:side, :side] - side // 2)
    return [row > 0, column > 0, row + column > 0, row - column > 0]


# Farthest neighbour whose residual counts as correlated, px along rows and columns.
LAG = 3
# Half of the lags; the others follow by symmetry.
_LAGS = [(r, c) for r in range(LAG + 1) for c in range(-LAG, LAG + 1) if r > 0 or c > 0]
# Least variance against that for white residuals: sums of noisy correlations must not make a place better than so.
_LEAST = 0.5


@dataclass(frozen=True, eq=False)
class ResidualCorrelation:
    """Correlation of the residuals of n fits; lags are half of those within `LAG`.

    Attributes
    ----------
    variance : Array
        (n,) of the residuals, DN^2, by redundancy.
    white : Array
        (n, 2, 2) covariance of the place for residuals that are white with unit variance; NaN where most of what the
        fit knows is noise of the template.
    influence : Array
        (n, lags, 2, 2) by how much correlation 1 at a lag and at its opposite raises it.
    correlation : Array
        (n, lags) of the residuals, freed of what the fit takes out of white noise.
    pixels, unknowns : NDArray[np.intp]
        (n,) of the fits.
    """

    variance: Array
    white: Array
    influence: Array
    correlation: Array
    pixels: NDArray[np.intp]
    unknowns: NDArray[np.intp]

    @property
    def plain(self) -> Array:
        """(n, 2, 2) px^2, for white residuals."""
        return np.asarray(self.variance[:, None, None] * self.white)

    def covariance(self, good: NDArray[np.bool_]) -> Array:
        """(n, 2, 2) px^2, with the median correlation of points good (n,)."""
        chosen = self.correlation[good & np.isfinite(self.variance)]
        if not len(chosen):
            return self.plain
        matrix = self.white + np.einsum("l,nlij->nij", np.median(chosen, axis=0), self.influence)
        # in units of the white one, so that no direction falls below its share
        (a, b), (_, c) = np.moveaxis(self.white, 0, -1)
        # where there is no fit all is NaN, which compares false
        finite = a * c > b * b
        matrix[~finite] = np.nan
        root = np.linalg.cholesky(self.white[finite])
        back = np.linalg.inv(root)
        value, vector = np.linalg.eigh(back @ matrix[finite] @ np.swapaxes(back, 1, 2))
        turned = root @ vector
        matrix[finite] = (turned * np.maximum(value, _LEAST)[:, None, :]) @ np.swapaxes(turned, 1, 2)
        return np.asarray(self.variance[:, None, None] * matrix)


def residual_correlation(
    design: Array, residual: Array, side: int, inverse: Array | None = None
) -> ResidualCorrelation:
    """From designs (n, q, p), the first two columns by place, and residuals (n, p) of square windows; NaN: no fit.

    Parameters
    ----------
    design : Array
        Derivatives of the model, (n, q, p), the first two by place.
    residual : Array
        (n, p), grey values; NaN where there is no fit.
    side : int
        Of the windows, px, with p = side^2.
    inverse : Array | None
        (n, q, q) of the curvature, by which the unknowns answer to residuals (`analysis.matching.least_squares`); NaN
        where that is not known. None: of the normal matrix.
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
    # a pseudo-inverse, because some unknowns may be open where there is little texture
    normal = np.linalg.pinv(scaled @ np.swapaxes(scaled, 1, 2), rcond=1e-11, hermitian=True)
    hat = (normal @ scaled).reshape(len(used), unknowns, side, side)
    if inverse is None:
        place = hat[:, :2] / scale[used, :2, None, None]
    else:
        place = (inverse[used, :2] @ design[used]).reshape(len(used), 2, side, side)
    column = scaled.reshape(hat.shape)
    rest = residual[used].reshape(-1, side, side)
    square = np.maximum(np.einsum("nij,nij->n", rest, rest), 1e-300)
    variance[used] = square / (pixels - unknowns)
    white[used] = np.einsum("niab,njab->nij", place, place)
    influence[used] = _lagged(place)
    for k, (r, c) in enumerate(_LAGS):
        here, there = _overlap(side, r, c)
        pairs = (side - r) * (side - abs(c))
        # white noise loses this much covariance to the fit
        taken = np.einsum("nqab,nqab->n", hat[here], column[there])
        seen = np.einsum("nab,nab->n", rest[here], rest[there])
        correlation[used, k] = (seen / variance[used] + taken) / pairs
    return ResidualCorrelation(variance, white, influence, correlation, *size)


_Cut = tuple[EllipsisType, slice, slice]


def _overlap(side: int, row: int, column: int) -> tuple[_Cut, _Cut]:
    """Pixels of a window that have a neighbour in it at a lag, and these neighbours."""
    here: _Cut = (..., slice(0, side - row), slice(max(-column, 0), side - max(column, 0)))
    return here, (..., slice(row, side), slice(max(column, 0), side - max(-column, 0)))


def _lagged(place: Array) -> Array:
    """(n, lags, 2, 2) by how much correlation 1 at a lag and at its opposite raises the covariance of B r, with B
    (n, 2, side, side).
    """
    out = np.empty((len(place), len(_LAGS), 2, 2))
    for k, (r, c) in enumerate(_LAGS):
        here, there = _overlap(place.shape[-1], r, c)
        product = np.einsum("niab,njab->nij", place[here], place[there])
        out[:, k] = product + np.swapaxes(product, 1, 2)
    return out


# Rms of the Gaussian that parts coarse detail from fine, px: fine are noise, aliasing, patterns of a detector's pixels.
_COARSE = 2.0
# Square distance of coarse from fine that chance exceeds in 1e-3 (chi-square of two).
_DISCORDANT = 2.0 * math.log(1e3)
# Standard deviations of chance from which all share a distance.
_SIGNIFICANT = 2.0
# Medians of the distances to which one counts for all.
_CLIPPED = 3.0


@dataclass(frozen=True, eq=False)
class WindowScales:
    """How far coarse detail puts the places of n fits from where all detail does; NaN where there is no fit.

    Attributes
    ----------
    apart : Array
        (n, 2) px.
    spread : ResidualCorrelation
        What its covariance is made of.
    """

    apart: Array
    spread: ResidualCorrelation

    def excess(self, factor: Array, good: NDArray[np.bool_]) -> Array:
        """Return the (n, 2, 2) covariance, px^2, that distances beyond noise ask for; NaN for those that stand out.

        Parameters
        ----------
        factor : Array
            (n,) of the noise.
        good : NDArray[np.bool_]
            (n,) points that share what they have in common.
        """
        covariance = self.spread.covariance(good) * factor[:, None, None]
        known = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(self.apart).all(axis=1)
        common = known & good
        out = np.zeros_like(covariance)
        if not common.any():
            return out
        size = np.sqrt(_square(self.apart[common], covariance[common]))
        held = np.minimum(1.0, _CLIPPED * np.median(size) / np.maximum(size, 1e-300))[:, None] * self.apart[common]
        weight = 1.0 / np.trace(covariance[common], axis1=1, axis2=2) ** 2
        weight /= weight.sum()
        noise = np.einsum("n,nij->ij", weight, covariance[common])
        value, vector = np.linalg.eigh(np.einsum("n,ni,nj->ij", weight, held, held) - noise)
        chance = np.sqrt(2.0 * np.sum(weight**2)) * np.einsum("ik,ij,jk->k", vector, noise, vector)
        shared = (vector * np.where(value > _SIGNIFICANT * chance, value, 0.0)) @ vector.T
        out += shared
        alone = np.zeros(len(out), bool)
        alone[known] = _square(self.apart[known], covariance[known] + shared) > _DISCORDANT
        # two motions, or none that the model has
        out[alone] = np.nan
        return out


def window_scales(design: Array, residual: Array, side: int, spread: ResidualCorrelation) -> WindowScales:
    """From designs (n, q, p), the first two columns by place, and residuals (n, p) of square windows; NaN: no fit.

    A fit to the low-passed window differs by (D W D')^-1 D W r - (D D')^-1 D r, with W the low pass twice: where the
    model is right both see the same place, and the difference is noise (Hausman, Econometrica 46(6), 1978).

    Parameters
    ----------
    design : Array
        Derivatives of the model, (n, q, p), the first two by place.
    residual : Array
        (n, p), grey values; NaN where there is no fit.
    side : int
        Of the windows, px, with p = side^2.
    spread : ResidualCorrelation
        Of the residuals.
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
            np.linalg.pinv(one @ np.swapaxes(scaled, 1, 2), rcond=1e-9, hermitian=True)[:, :2] @ one
            for one in (coarse, scaled)
        ]
        place = (parts[0] - parts[1]) / scale[used, :2, None]
        apart[used] = np.einsum("nip,np->ni", place, residual[used])
        place = place.reshape(len(used), 2, side, side)
        white[used], influence[used] = np.einsum("niab,njab->nij", place, place), _lagged(place)
    return WindowScales(apart, replace(spread, white=white, influence=influence))


def _square(apart: Array, covariance: Array) -> Array:
    """(n,) square distances (n, 2) in units of covariances (n, 2, 2)."""
    return np.asarray(np.einsum("ni,ni->n", apart, np.linalg.solve(covariance, apart[..., None])[..., 0]))


_BLOCKS = 5
# Of the field over the window's side: shorter ones would be noise to the affine change, longer ones follow it.
_LENGTH = 1.0
# Standard deviations of tau^2 under no relief from which a point has its own; chance alone exceeds it in some 1e-3.
_OWN = 4.0
# To which it counts for all.
_HELD = 2.5


@dataclass(frozen=True, eq=False)
class WindowRelief:
    """What residuals of n fits show of relief within their windows; NaN where there is no fit.

    Attributes
    ----------
    score : Array
        (n,) q, DN^2.
    first : Array
        (n,) tr(K G): the score's expectation for white residuals of unit variance.
    second : Array
        (n,) tr(K G K G), DN^2 px^-2: its expectation for tau of 1 px.
    redundancy : Array
        (n,) of the fit.
    effect : Array
        (n, 2, 2) covariance of the place for tau of 1 px.
    """

    score: Array
    first: Array
    second: Array
    redundancy: Array
    effect: Array

    def square(self, variance: Array, coloured: Array, good: NDArray[np.bool_]) -> tuple[Array, float]:
        """tau^2 of each point, and of one that is like most.

        Parameters
        ----------
        variance : Array
            (n,) of the residuals, DN^2, by redundancy.
        coloured : Array
            (n,) how much larger the correlation of residuals makes the covariance of the place than white residuals
            would.
        good : NDArray[np.bool_]
            (n,) points that share what they have in common.

        Returns
        -------
        tuple[Array, float]
            (n,) px^2, and px^2.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            # relief is in the residuals' variance, too, which sets the noise that is taken off the score
            rise = self.second - coloured * self.first**2 / self.redundancy
            found = (self.score - variance * coloured * self.first) / rise
            error = variance * coloured * np.sqrt(2.0 * self.second) / rise
        known = np.isfinite(found) & (rise > 0) & (error > 0)
        apart = np.zeros(len(found), bool)
        apart[known] = found[known] > _OWN * error[known]
        common = known & good
        weight = 1.0 / error[common] ** 2
        # what stands out counts a little: left out, it would make the others' relief too small
        held = np.minimum(found, _HELD * error)[common]
        total = float(weight.sum())
        shared = _not_negative(float(weight @ held) / total, total**-0.5) if common.any() else 0.0
        tau = np.where(apart, np.maximum(np.where(known, found, 0.0), shared), shared)
        # where noise is low, windows differ by the chance of their fields, and what is held is less than what most have
        return tau, max(shared, float(np.median(found[common]))) if common.any() else shared


def _not_negative(value: float, error: float) -> float:
    """Mean of a normal distribution's part above 0: a little more than nothing where value says nothing."""
    at = value / error
    return value + error * float(np.exp(norm.logpdf(at) - norm.logcdf(at)))


def window_relief(design: Array, residual: Array, side: int) -> WindowRelief:
    """From designs (n, q, p), the first two columns by place, and residuals (n, p) of square windows; NaN: no fit.

    Parameters
    ----------
    design : Array
        Derivatives of the model, (n, q, p), the first two by place.
    residual : Array
        (n, p), grey values; NaN where there is no fit.
    side : int
        Of the windows, px, with p = side^2.
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
    # (n, 2, ..., blocks): by the block's displacement along an axis; together (n, ..., 2 blocks)
    seen = np.einsum("nap,pb->nab", slope * residual[used, None], share).reshape(len(used), -1)
    shared = np.stack([(scaled * slope[:, a, None]) @ share for a in range(2)], axis=2)
    shared = shared.reshape(len(used), unknowns, -1)
    square = np.zeros((len(used), 2, len(field), 2, len(field)))
    diagonal = np.arange(len(field))
    for a in range(2):
        for b in range(2):
            square[:, a, diagonal, b, diagonal] = (slope[:, a] * slope[:, b]) @ share
    free = square.reshape(len(used), 2 * len(field), 2 * len(field))
    free = free - np.swapaxes(shared, 1, 2) @ inverse @ shared
    both, at_middle = np.kron(np.eye(2), field), np.kron(np.eye(2), middle)
    product = both @ free
    score[used] = np.einsum("ni,ij,nj->n", seen, both, seen)
    first[used] = np.trace(product, axis1=1, axis2=2)
    second[used] = np.einsum("nij,nji->n", product, product)
    redundancy[used] = pixels - unknowns
    taken = (inverse[:, :2] @ shared) / scale[used, :2, None]
    cross = at_middle @ np.swapaxes(taken, 1, 2)
    effect[used] = np.eye(2) - cross - np.swapaxes(cross, 1, 2) + taken @ both @ np.swapaxes(taken, 1, 2)
    return WindowRelief(score, first, second, redundancy, effect)


def relief_field(side: int) -> tuple[Array, Array, Array]:
    """Blocks of the pixels (p, b), correlation of the blocks (b, b) and of the window's middle with them (1, b)."""
    line = np.arange(side) - side // 2
    part = np.arange(side) * _BLOCKS // side
    block = (_BLOCKS * part[:, None] + part).ravel()
    share = (block[:, None] == np.arange(_BLOCKS**2)).astype(np.float64)
    places = np.stack([g.ravel() for g in np.meshgrid(line, line, indexing="ij")], axis=1).astype(np.float64)
    centre = (share.T @ places) / share.sum(axis=0)[:, None]
    apart = np.linalg.norm(centre[:, None] - centre, axis=2), np.linalg.norm(centre, axis=1)[None]
    steps = (np.sqrt(3.0) * d / (_LENGTH * side) for d in apart)
    field, middle = ((1.0 + a) * np.exp(-a) for a in steps)
    return share, field, middle
