"""Least squares matching of many points together (Gruen, South African Journal of Photogrammetry 14(3), 1985).

The image's pixels y in a window are explained by the template t,

    y(x) = offset + gain t(u) + sharp_r t_rr(u) + sharp_c t_cc(u),   u = A (x - place),

with u counted from the template's middle, A an affine matrix, and second derivatives that take up a difference in
sharpness. The template is interpolated and not the image, so that the image's noise enters as it is and does not pull
the fit towards places between pixels, where an interpolated image is smoother.

**Noise of the template.** Its slopes are steeper than those of what it shows, so that a fit of it as it is claims too
much and its place leans towards whole pixels: errors in variables. The best prediction of the image by such a template
is a low pass of it (Wiener), and what that leaves is uncorrelated with what it was made from. So each template is
smoothed by the strongest Gaussian of some whose residuals in the image are the least but for chance, and the second
derivatives fit the rest. Neither noise needs to be known, and a template without noise is hardly smoothed.

**Covariance.** Noise of the image, interpolated noise of the template and what the model leaves unexplained all stand
in the residuals. Assumed: over one window they are stationary, with a variance of its own (residual square sum over
redundancy) and with a correlation of neighbours up to three pixels that all points share. It is the median over
the points, freed of what a fit of so many unknowns takes out of white noise. With influence matrix B (place by pixel),
by the curvature that is left when the slopes of the template's noise are taken off
(`analysis.matching.least_squares`), the covariance is B C B', and more where smoothing leaves few residuals to tell it
by. To it comes what residuals tell of displacements that differ within the window (`analysis.matching.window_checks`)
and the error of interpolation; steps of them are tested for (`analysis.matching.window_checks`). Not in the covariance:
what pulls all points alike (an error of the reference's georeference) and aliasing of the image.

What noise of the template does to a fitted place: errors in variables, by the curvature that the fit really has.

The fit stops where F = D r = 0, with design D (unknowns by pixel) and residuals r of the model m. A place that noise
has moved by e answers to F with the curvature of the sum of squares,

    H = D D' - sum over pixels of r d2m,

and not with D D' alone. Without noise in the template residuals know nothing of d2m, and the two are the same. With it
they do: the noise's own slopes stand in D D' as if they were texture, and r, which holds the noise with the opposite
sign, takes them off. So the covariance is H^-1 (D C D') H^-1, with C of the residuals: the sandwich of M-estimators
(Huber, Proc. 5th Berkeley Symposium 1, 1967). It differs from the usual one where slopes are few: **along a straight
edge** there are none but the noise's. An isotropic low pass cannot take them away, since the edge is sharp across, and
a normal matrix that counts them claims a place that is not known. Where most of what the normal matrix knows of some
combination of unknowns is noise, the theory ends, which is of first order, and so does the covariance: it is NaN.

**Lean.** Noise of the template has least energy under strong smoothing, a small gain and half way between pixels, so
the fit leans there, and where unknowns are hard to tell apart the place leans with them:

    lean = H^-1 E F = -H^-1 s_t^2 / 2 d/d(unknowns) [noise energy of the low-passed, sharpened, interpolated template].

The template's noise against the residuals, s_t^2 / s^2 (both in the image), is one for all points. Each tells at least
how large it is: by how much the low pass that was chosen lowers the residuals against none, over what it takes of white
noise. Nine in ten are below what is taken. It is too low where all windows are so sharp that no low pass serves, but
there slopes are many and the lean is nothing. The place is not moved by it; its covariance gets lean lean'.

**Lock.** Where structure runs along one direction, the texture along it may be so weak that the noise's energy is most
of what holds the place: the fit then stands half way between pixels, where the lean is nothing. So the covariance also
gets what that energy's steepest slope does to the place against the curvature that is left without the energy's own,
2 pi^2 N s_t^2 times its mean and its wave. Template and image are taken to be as noisy as one another at least. It is
nothing beside texture of two directions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array
from analysis.matching import window_checks
from analysis.matching.correlation import MatchOptions, Reason, checked_image, checked_places, checked_templates, joined
from analysis.matching.spline import SplineStack, low_passed
from analysis.matching.window_checks import ResidualCorrelation, WindowHalves, WindowRelief, WindowScales

# Least curvature over the normal matrix, of any combination of unknowns: more than three fifths noise is not known.
_LEAST = 0.4
# Below it a combination of unknowns is open, relative to the best known.
_OPEN = 1e-11
# Of the points' shares.
_QUANTILE = 0.9
# Share of the curvature from which the noise's energy counts as what holds a place.
_HELD = 0.3
# Share of the best known direction's curvature below which structure runs along one direction: sharp across it, it
# keeps a low pass from being chosen, which otherwise leaves little of the noise's energy.
_ONE_WAY = 0.1
# Least share for that: template and image have the same noise, of which interpolation passes two thirds.
_EQUAL = 0.6
# Half width of the impulse's answer and phases of a pixel at which it is taken.
_REACH, _PHASES = 30, 64


@dataclass(frozen=True, eq=False)
class TemplateNoise:
    """Noise of the templates in n fits with q unknowns; NaN where there is no fit, or where it is mostly noise.

    Attributes
    ----------
    inverse : Array
        (n, q, q) H^-1.
    lean : Array
        (n, 2) px, row and column, for a share of 1.
    energy : Array
        (n,) curvature of the noise's energy along an axis where it is largest, for a share of 1.
    share : Array
        (n,) least s_t^2 / s^2 by the low pass.
    """

    inverse: Array
    lean: Array
    energy: Array
    share: Array

    def covariance(self, good: NDArray[np.bool_]) -> Array:
        """(n, 2, 2) px^2 of lean and lock, with the share that points good (n,) show."""
        shown = self.share[good & np.isfinite(self.share)]
        if not len(shown):
            return np.zeros_like(self.inverse[:, :2, :2])
        share = float(np.quantile(shown, _QUANTILE))
        lean, lock = share * self.lean, self._lock(max(share, _EQUAL))
        return np.asarray(lean[:, :, None] * lean[:, None] + lock @ np.swapaxes(lock, 1, 2))

    def _lock(self, share: float) -> Array:
        """(n, 2, 2) px, by which the noise's energy may displace row and column along each axis."""
        own = share * self.energy[:, None, None] * np.eye(2)
        known = np.isfinite(self.inverse[:, :2, :2]).all(axis=(1, 2)) & np.isfinite(self.energy)
        out = np.full_like(self.inverse[:, :2, :2], np.nan)
        # without the curvature of the noise's energy, which holds a place that is locked
        left = np.linalg.inv(self.inverse[known, :2, :2])
        least, most = np.linalg.eigvalsh(left).T
        left = left - own[known]
        left[least <= own[known, 0, 0]] = np.nan
        lock = np.linalg.inv(left) @ own[known] / (2.0 * np.pi)
        free = (own[known, 0, 0] < _HELD * least) | (least > _ONE_WAY * most)
        out[known] = np.where(free[:, None, None], 0.0, lock)
        return out


def template_noise(
    stack: SplineStack,
    which: NDArray[np.intp],
    window: tuple[Array, Array],
    shift: Array,
    affine: Array,
    linear: Array,
    smoothing: Array,
    design: Array,
    residual: Array,
    lowered: tuple[Array, Array],
) -> TemplateNoise:
    """From converged fits.

    Parameters
    ----------
    stack : SplineStack
        Low-passed templates.
    which : NDArray[np.intp]
        (n,) of them.
    window : tuple[Array, Array]
        Rows and columns (p,) of the pixels, px about the window's middle.
    shift : Array
        (n, 2) fitted place against the window's middle.
    affine : Array
        (n, 2, 2).
    linear : Array
        (n, 2 or 4) offset, gain and perhaps sharpness along rows and columns.
    smoothing : Array
        (n,) rms of the low pass, px.
    design : Array
        (n, q, p): by place, perhaps by the affine matrix, by the linear unknowns.
    residual : Array
        (n, p), DN; NaN where there is no fit.
    lowered : tuple[Array, Array]
        (n,) and (n,), by how much the low pass lowers the square sum of residuals and the energy of white noise of unit
        variance in a pixel, against none.
    """
    count, unknowns, pixels = design.shape
    inverse, lean = np.full((count, unknowns, unknowns), np.nan), np.full((count, 2), np.nan)
    curvature = np.full(count, np.nan)
    share = np.full(count, np.nan)
    used = np.flatnonzero(np.isfinite(residual).all(axis=1) & np.all((design**2).sum(axis=2) > 0, axis=1))
    if not used.size:
        return TemplateNoise(inverse, lean, curvature, share)
    apart = np.stack([window[0] - shift[used, :1], window[1] - shift[used, 1:]], axis=1)
    place = affine[used] @ apart + stack.size // 2
    # by the unknowns of the geometry: place and perhaps matrix
    moved = np.zeros((used.size, 2, unknowns - linear.shape[1], pixels))
    moved[:, :, :2] = -affine[used][..., None]
    if moved.shape[2] > 2:
        for axis in range(2):
            moved[:, axis, 2 + 2 * axis : 4 + 2 * axis] = apart
    bent = _bend(stack, which[used], place, linear[used], moved, residual[used])
    square = design[used] @ np.swapaxes(design[used], 1, 2)
    inverse[used] = _inverse(square, square - bent)
    variance = np.einsum("np,np->n", residual[used], residual[used]) / (pixels - unknowns)
    force = variance[:, None] * _force(place, linear[used], smoothing[used], moved)
    lean[used] = np.einsum("nij,nj->ni", inverse[used, :2], force)
    mean, wave = np.moveaxis(np.array([_noise_gain(float(one)) for one in smoothing[used]])[:, :, 0], 1, 0)
    curvature[used] = 2.0 * np.pi**2 * pixels * variance * mean * wave
    square_sum, energy = lowered[0][used], lowered[1][used]
    with np.errstate(divide="ignore", invalid="ignore"):
        share[used] = np.where(energy > 0, np.clip(square_sum / (pixels * energy * variance), 0.0, 1.0), 0.0)
    return TemplateNoise(inverse, lean, curvature, share)


def _bend(
    stack: SplineStack, which: NDArray[np.intp], place: Array, linear: Array, moved: Array, residual: Array
) -> Array:
    """(n, q, q) sum of residuals times second derivatives of the model.

    Second derivatives of the place in the template by the unknowns meet sums of residuals times slopes, which are 0.
    """
    geometry, unknowns = moved.shape[2], moved.shape[2] + linear.shape[1]
    sharp = linear.shape[1] > 2
    value = stack(place[:, 0], place[:, 1], which, order=4 if sharp else 2)
    second = linear[:, 1, None] * value[3:6]
    if sharp:
        second = second + linear[:, 2, None] * value[10:13] + linear[:, 3, None] * value[12:15]
    row, cross, column = residual * second
    out = np.zeros((len(which), unknowns, unknowns))
    one = row[:, None] * moved[:, 0] + cross[:, None] * moved[:, 1]
    other = cross[:, None] * moved[:, 0] + column[:, None] * moved[:, 1]
    out[:, :geometry, :geometry] = one @ np.swapaxes(moved[:, 0], 1, 2) + other @ np.swapaxes(moved[:, 1], 1, 2)
    # the gain's and the sharpnesses' columns move with the place
    for k, slopes in enumerate(((1, 2), (6, 7), (8, 9))[: linear.shape[1] - 1]):
        along = sum(np.einsum("nip,np->ni", moved[:, axis], residual * value[slopes[axis]]) for axis in range(2))
        out[:, :geometry, geometry + 1 + k] = out[:, geometry + 1 + k, :geometry] = along
    return out


def _inverse(square: Array, curvature: Array) -> Array:
    """(n, q, q) of the curvature on what the normal matrix knows; NaN where too little of that is left."""
    scale = 1.0 / np.sqrt(np.einsum("nqq->nq", square))
    both = scale[:, :, None] * scale[:, None]
    value, vector = np.linalg.eigh(square * both)
    with np.errstate(divide="ignore", invalid="ignore"):
        known = np.where(value > _OPEN * value[:, -1:], 1.0 / np.sqrt(value), 0.0)
    root = vector * known[:, None, :]
    left = np.swapaxes(root, 1, 2) @ (curvature * both) @ root
    # what is open stays 0 in the root, whatever its share
    left = left + np.where(known == 0.0, 1.0, 0.0)[:, :, None] * np.eye(left.shape[1])
    share, turn = np.linalg.eigh(0.5 * (left + np.swapaxes(left, 1, 2)))
    share = np.where(share.min(axis=1, keepdims=True) > _LEAST, share, np.nan)
    turned = root @ turn
    return np.asarray((turned / share[:, None, :]) @ np.swapaxes(turned, 1, 2) * both)


def _force(place: Array, linear: Array, smoothing: Array, moved: Array) -> Array:
    """(n, q) expectation of F by white noise in the template that has unit variance after the gain."""
    mean, wave = np.moveaxis(np.array([_noise_gain(float(one)) for one in smoothing]), 1, 0)
    phase = 2.0 * np.pi * place
    # (3, n, 2, p): energy of the value, of value by second derivative, of the second derivative, along rows and columns
    energy = mean.T[:, :, None, None] + wave.T[:, :, None, None] * np.cos(phase)
    slope = -2.0 * np.pi * wave.T[:, :, None, None] * np.sin(phase)
    factors = linear[:, 1:]
    matrix = _products(energy[:, :, 0], energy[:, :, 1])[:, : factors.shape[1], : factors.shape[1]]
    of_place = np.zeros((len(linear), moved.shape[2]))
    for axis, pair in enumerate(((slope[:, :, 0], energy[:, :, 1]), (energy[:, :, 0], slope[:, :, 1]))):
        change = _products(*pair)[:, : factors.shape[1], : factors.shape[1]]
        along = np.einsum("ni,nijp,nj->np", factors, change, factors)
        of_place -= 0.5 * np.einsum("nip,np->ni", moved[:, axis], along)
    of_linear = -np.einsum("nijp,nj->ni", matrix, factors)
    force = np.concatenate([of_place, np.zeros((len(linear), 1)), of_linear], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(force / linear[:, 1, None] ** 2)


def _products(row: Array, column: Array) -> Array:
    """(n, 3, 3, p) expected products of noise in value, second derivative along rows and along columns, from those
    along either axis (3, n, p).
    """
    value, across, bend = (row[k] * column[0] for k in range(3))
    other, both, last = row[0] * column[1], row[1] * column[1], row[0] * column[2]
    lines = [[value, across, other], [across, bend, both], [other, both, last]]
    return np.stack([np.stack(line, axis=1) for line in lines], axis=1)


def noise_energy(factors: Array, smoothing: float) -> Array:
    """(n,) variance of a pixel of the model for white noise in the template, over all phases; it is 1 after the gain.

    Parameters
    ----------
    factors : Array
        (n, 1 or 3) gain and perhaps sharpness along rows and columns.
    smoothing : float
        Rms of the low pass, px.
    """
    mean = _noise_gain(smoothing)[0][:, None, None]
    size = factors.shape[1]
    energy = np.einsum("ni,ij,nj->n", factors, _products(mean, mean)[0, :size, :size, 0], factors)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(energy / factors[:, 0] ** 2)


@lru_cache(maxsize=32)
def _noise_gain(smoothing: float) -> Array:
    """(2, 3) energy that white noise of unit variance keeps along one axis, after low pass and interpolation.

    Of the value, of value by second derivative (px^-2) and of the second derivative (px^-4); first the mean over the
    phase of a pixel, then the amplitude of its cosine, which is largest on whole pixels.
    """
    size = 2 * _REACH + 1
    impulse = np.zeros((1, size, size))
    impulse[0, _REACH] = 1.0
    stack = SplineStack(low_passed(impulse, smoothing))
    rows = np.arange(10, size - 11) + np.arange(_PHASES)[:, None] / _PHASES
    value = stack(rows, np.full(rows.shape, float(_REACH)), np.zeros(_PHASES, np.intp), order=2)
    energy = np.stack([(value[0] ** 2).sum(axis=1), (value[0] * value[3]).sum(axis=1), (value[3] ** 2).sum(axis=1)])
    series = np.fft.rfft(energy, axis=1) / _PHASES
    out = np.stack([series[:, 0].real, 2.0 * series[:, 1].real])
    out.setflags(write=False)
    return out


Index = NDArray[np.intp]
# Points that are fitted together: so few that what is computed of them stays in a processor's cache.
_CHUNK = 32
# Last step of the place, px, and of the affine change at the window's side, px. The next is an order smaller.
_REST = 2e-4
_LONGEST_STEP = 0.7
# Steps are found to this relative accuracy where the normal matrix is singular.
_RIDGE = 1e-11
# Rms of the Gaussians a template may be smoothed by, px; those of a ninth of the window at most.
_SMOOTHINGS = (0.0, 0.35, 0.7, 1.1, 1.7, 2.6)
# Chi-square of one unknown, exceeded by chance in 5 per cent.
_CHANCE = 4.0
# Standard deviation of a place by interpolation of detail up to 0.45 cycles a pixel without noise, px.
_INTERPOLATION = 0.004


@dataclass(frozen=True, eq=False)
class Fits:
    """Fitted points; numbers are NaN where the window could not be fitted at all.

    Attributes
    ----------
    place : Array
        (n, 2) row and column of the templates' middles in the image.
    affine : Array
        (n, 2, 2) A: template pixels by image pixels.
    gain : Array
        (n,) of the image against the template.
    correlation : Array
        (n,) of the image with the fitted template.
    sigma : Array
        (n,) residual standard deviation, DN of the image, by redundancy.
    contrast : Array
        (n,) standard deviation of the image in the window over that of one pixel's noise, the latter from differences
        of 2 x 2 pixels.
    smoothing : Array
        (n,) rms of the Gaussian that the template was smoothed by, px.
    iterations : Index
        (n,) steps.
    reason : NDArray[np.int8]
        (n,) codes of `Reason`: ACCEPTED, TEMPLATE, OUTSIDE, IMAGE, SATURATED, FLAT, DIVERGED, MOVED, DISTORTED.
    spread : ResidualCorrelation
        What the covariance of the noise is made of.
    template : TemplateNoise
        What noise of the templates does to the places.
    relief : WindowRelief
        What is seen of displacements within the windows.
    halves : WindowHalves
        How far apart halves of the windows put the places.
    scales : WindowScales
        How far coarse detail puts the places from where all detail does.
    """

    place: Array
    affine: Array
    gain: Array
    correlation: Array
    sigma: Array
    contrast: Array
    smoothing: Array
    iterations: Index
    reason: NDArray[np.int8]
    spread: ResidualCorrelation
    template: TemplateNoise
    relief: WindowRelief
    halves: WindowHalves
    scales: WindowScales

    def covariance(self, good: NDArray[np.bool_] | None = None) -> Array:
        """(n, 2, 2) px^2 of places, with what points good (n,) have in common; None: the converged."""
        noise, relief = self.covariances(good)
        return noise + relief

    def covariances(self, good: NDArray[np.bool_] | None = None) -> tuple[Array, Array]:
        """The two parts of `covariance`: of noise and interpolation, and of displacements within the window."""
        noise, hidden, tau, _usual = self._parts(good)
        relief = tau[:, None, None] * self.relief.effect
        common = self.reason == Reason.ACCEPTED if good is None else good
        lean = self.template.covariance(common) + self.scales.excess(hidden, common)
        return noise * hidden[:, None, None] + lean + _INTERPOLATION**2 * np.eye(2), relief

    def steps(self, good: NDArray[np.bool_] | None = None) -> tuple[Array, Array]:
        """(n,) chance that halves of windows without a step of the displacement are so far apart, and the power of that
        test; see `WindowHalves.judged`.
        """
        noise, hidden, _tau, usual = self._parts(good)
        # where noise of the template leaves no covariance the others' colour will do
        coloured = self._coloured(noise)
        shared = float(np.nanmedian(coloured)) if np.isfinite(coloured).any() else 1.0
        coloured = np.where(np.isfinite(coloured), coloured, shared)
        return self.halves.judged(self.spread.variance * coloured * hidden, usual)

    def _parts(self, good: NDArray[np.bool_] | None) -> tuple[Array, Array, Array, float]:
        """Covariance of visible noise, factor of the hidden, tau^2 of each point and of one that is like most."""
        common = self.reason == Reason.ACCEPTED if good is None else good
        noise = self.spread.covariance(common)
        return noise, self._hidden(), *self.relief.square(self.spread.variance, self._coloured(noise), common)

    def _coloured(self, noise: Array) -> Array:
        """(n,) by how much the correlation of residuals raises the variance of the place."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.trace(noise, axis1=1, axis2=2) / np.trace(self.spread.plain, axis1=1, axis2=2))

    def _hidden(self) -> Array:
        """(n,) by how much more noise there is where the slopes are than the residuals show; NaN if they show none.

        A smoothed template has one independent value to 4 pi rms^2 pixels. Its noise is in these alone and loses one to
        each unknown, while that of the image is white. With equal noise in both, and where half of the amplitude passes
        the smoothing, as slopes do, the template has a third of it.
        """
        unknowns = self.spread.unknowns
        with np.errstate(invalid="ignore", divide="ignore"):
            left = self.spread.pixels / (4.0 * np.pi * self.smoothing**2) - unknowns
            return np.where(self.smoothing > 0, np.where(left > 0, 1.0 + unknowns / (3.0 * left), np.nan), 1.0)


def least_squares(
    image: ArrayLike, templates: ArrayLike, start: ArrayLike, options: MatchOptions | None = None
) -> Fits:
    """Places of templates near start.

    Parameters
    ----------
    image : ArrayLike
        (H, W), any real type.
    templates : ArrayLike
        (n, k, k), k odd.
    start : ArrayLike
        (n, 2) row and column, good to a pixel.
    options : MatchOptions | None
        Model and limits; the thresholds on correlation, ratio and sigma are not applied here.

    Raises
    ------
    ValueError
        Wrong shapes, a template too small for its margin.
    """
    plane = checked_image(image, "least squares matching")
    patch = checked_templates(templates, "least squares matching")
    first = checked_places(start, len(patch), "least squares matching")
    chosen = options or MatchOptions()
    width = patch.shape[1] - 2 * chosen.margin
    if width < 7:
        raise ValueError(
            f"least squares matching: templates of {patch.shape[1]} px leave a window of {width} px after a margin of "
            f"{chosen.margin} px at each side; take {2 * chosen.margin + 7} px or more"
        )
    parts = [
        _fit(plane, patch[k : k + _CHUNK], first[k : k + _CHUNK], chosen) for k in range(0, max(len(patch), 1), _CHUNK)
    ]
    return joined(parts)


def _fit(image: NDArray[np.generic], templates: Array, start: Array, options: MatchOptions) -> Fits:
    """Some points together."""
    count, half = len(templates), templates.shape[1] // 2
    reach = half - options.margin
    row, column = (g.ravel().astype(np.float64) for g in np.mgrid[-reach : reach + 1, -reach : reach + 1])
    grey, anchor, reason = _windows(image, templates, start, reach, options)
    shift = start - anchor
    affine = np.tile(np.eye(2), (count, 1, 1))
    linear = np.full((count, options.parameters - 6), np.nan)
    linear[:, 0], linear[:, 1:] = grey.mean(axis=1), 0.0
    iterations = np.zeros(count, np.intp)
    design = np.zeros((count, options.parameters, row.size))
    residual = np.full((count, row.size), np.nan)
    patch = np.where((reason == 0)[:, None, None], templates, 0.0)
    some = [smoothing for smoothing in _SMOOTHINGS if smoothing <= math.sqrt(row.size) / 9.0]
    # template i, smoothed by the k-th, is number k count + i
    stack = SplineStack(np.concatenate([low_passed(patch, smoothing) for smoothing in some]))
    level = np.zeros(count, np.intp)
    # at the start a template that is not yet in place seems to need more smoothing than at the end
    for turn in range(2):
        going = np.flatnonzero(reason == 0)
        most = int(level.max(initial=0)) + 1 if turn else len(some)
        chosen, lowered = _best_smoothing(stack, some[:most], going, grey, (row, column), shift, affine, options)
        going = going[(chosen != level)[going] | (turn == 0)]
        level = chosen
        for iteration in range(options.iterations + 1):
            if not going.size:
                break
            step, design[going], residual[going] = _step(
                stack,
                level[going] * count + going,
                grey[going],
                (row, column),
                shift[going],
                affine[going],
                linear[going, 1:],
                iteration,
                options,
            )
            size = np.abs(step[:, :2]).max(axis=1)
            bend = step[:, 2:6].reshape(-1, 2, 2)
            rest = np.maximum(size, reach * np.abs(bend).max(axis=(1, 2))) < _REST
            moved = iteration > 0
            short = np.minimum(1.0, _LONGEST_STEP / np.maximum(size, 1e-300))[:, None]
            if moved:
                shift[going] += short * step[:, :2]
                affine[going] += short[:, :, None] * bend
            linear[going] = step[:, 6:]
            iterations[going] += moved
            far = np.abs(shift[going] + anchor[going] - start[going]).max(axis=1) > options.largest_move
            bent = np.abs(affine[going] - np.eye(2)).max(axis=(1, 2)) > options.largest_distortion
            reason[going[bent]] = Reason.DISTORTED
            reason[going[far]] = Reason.MOVED
            going = going[~((rest & moved) | far | bent)]
        reason[going] = Reason.DIVERGED
    smoothing = np.array(some)[level]
    of_template = template_noise(
        stack,
        level * count + np.arange(count),
        (row, column),
        shift,
        affine,
        linear,
        smoothing,
        design,
        residual,
        lowered,
    )
    return _summary(
        grey, anchor + shift, affine, linear, design, residual, smoothing, iterations, reason, reach, of_template
    )


def _windows(
    image: NDArray[np.generic], templates: Array, start: Array, reach: int, options: MatchOptions
) -> tuple[Array, Array, NDArray[np.int8]]:
    """Grey values (n, p), middles of the windows (n, 2) and what is wrong with them."""
    reason = np.zeros(len(templates), np.int8)
    anchor = np.rint(start)
    fits = np.all((anchor >= reach) & (anchor <= np.array(image.shape) - 1 - reach), axis=1)
    reason[~fits] = Reason.OUTSIDE
    reason[~(np.isfinite(templates).all(axis=(1, 2)) & np.isfinite(start).all(axis=1))] = Reason.TEMPLATE
    offset = np.arange(-reach, reach + 1)
    usable = np.flatnonzero(reason == 0)
    rows, columns = (anchor[usable, k, None].astype(np.intp) + offset for k in range(2))
    grey = np.zeros((len(templates), (2 * reach + 1) ** 2))
    grey[usable] = image[rows[:, :, None], columns[:, None, :]].reshape(usable.size, grey.shape[1])
    finite = np.isfinite(grey).all(axis=1)
    reason[~finite] = Reason.IMAGE
    grey[~finite] = 0.0
    top = options.saturation
    if top is None and image.dtype.kind in "ui":
        top = float(np.iinfo(image.dtype).max)  # type: ignore[type-var]
    if top is not None:
        reason[(reason == 0) & (grey.max(axis=1, initial=-np.inf) >= top)] = Reason.SATURATED
    even = (np.ptp(grey, axis=1) == 0) | (np.ptp(templates, axis=(1, 2)) == 0)
    reason[(reason == 0) & even] = Reason.FLAT
    return grey, np.where(reason[:, None] == Reason.TEMPLATE, 0.0, anchor), reason


def _best_smoothing(
    stack: SplineStack,
    some: list[float],
    which: Index,
    grey: Array,
    window: tuple[Array, Array],
    shift: Array,
    affine: Array,
    options: MatchOptions,
) -> tuple[Index, tuple[Array, Array]]:
    """(n,) number of the strongest of some low passes with which templates predict the image as well as with the best,
    after one linear step, and by how much it lowers residuals and noise against the first (`template_noise`). 0 for
    those that are not which.
    """
    best, lowered = np.zeros(len(grey), np.intp), (np.zeros(len(grey)), np.zeros(len(grey)))
    if not which.size:
        return best, lowered
    # the gain of the first guess only scales columns, which residuals do not feel
    linear = np.zeros((which.size, options.parameters - 7))
    linear[:, :1] = 1.0
    most = len(some)
    square, energy = np.zeros((2, most, which.size))
    for k, smoothing in enumerate(some):
        number = k * len(grey) + which
        step, _, residual = _step(stack, number, grey[which], window, shift[which], affine[which], linear, 1, options)
        square[k] = np.einsum("np,np->n", residual, residual)
        energy[k] = noise_energy(step[:, 7:], smoothing)
    # too little smoothing claims too much, too much loses a little
    alike = square <= square.min(axis=0) * (1.0 + _CHANCE / grey.shape[1])
    best[which] = most - 1 - np.argmax(alike[::-1], axis=0)
    at = best[which], np.arange(which.size)
    for one, values in zip(lowered, (square, energy), strict=True):
        one[which] = values[0] - values[at]
    return best, lowered


def _step(
    stack: SplineStack,
    which: Index,
    grey: Array,
    window: tuple[Array, Array],
    shift: Array,
    affine: Array,
    linear: Array,
    iteration: int,
    options: MatchOptions,
) -> tuple[Array, Array, Array]:
    """Gauss-Newton step of place and matrix with the new linear unknowns, design (m, q, p) and residuals (m, p)."""
    apart = np.stack([window[0] - shift[:, :1], window[1] - shift[:, 1:]], axis=1)
    u = affine @ apart + stack.size // 2
    # third derivatives only count where the second have a share
    bent = options.sharpness and bool(linear[:, 1:].any())
    value = stack(u[:, 0], u[:, 1], which, order=2 + bent if options.sharpness else 1)
    # the linear unknowns are not known before the first pass, which finds them for the place at the start
    known = linear.T[:, :, None] if iteration else np.zeros((linear.shape[1], len(grey), 1))
    by_row, by_column = known[0] * value[1], known[0] * value[2]
    if bent:
        by_row = by_row + known[1] * value[6] + known[2] * value[8]
        by_column = by_column + known[1] * value[7] + known[2] * value[9]
    slope = np.stack([by_row, by_column], axis=1)
    columns = [
        -np.swapaxes(affine, 1, 2) @ slope,
        (slope[:, :, None] * apart[:, None]).reshape(len(grey), 4, -1),
        np.stack([np.ones_like(value[0]), value[0] - value[0].mean(axis=1, keepdims=True)], axis=1),
    ]
    columns.extend([np.stack([value[3], value[5]], axis=1)] if options.sharpness else [])
    design = np.concatenate(columns, axis=1)
    step = _solve(design, grey)
    return step, design, grey - np.einsum("mqp,mq->mp", design, step)


def _solve(design: Array, grey: Array) -> Array:
    scale = 1.0 / np.maximum(np.sqrt(np.einsum("mqp,mqp->mq", design, design)), 1e-300)
    scaled = design * scale[:, :, None]
    normal = scaled @ np.swapaxes(scaled, 1, 2) + _RIDGE * np.eye(design.shape[1])
    return scale * np.linalg.solve(normal, scaled @ grey[:, :, None])[:, :, 0]


def _summary(
    grey: Array,
    place: Array,
    affine: Array,
    linear: Array,
    design: Array,
    residual: Array,
    smoothing: Array,
    iterations: Index,
    reason: NDArray[np.int8],
    reach: int,
    of_template: TemplateNoise,
) -> Fits:
    none = np.isin(reason, (Reason.TEMPLATE, Reason.OUTSIDE, Reason.IMAGE, Reason.FLAT, Reason.SATURATED))
    square = np.einsum("np,np->n", residual, residual)
    about = grey - grey.mean(axis=1, keepdims=True)
    total = np.einsum("np,np->n", about, about)
    redundancy = grey.shape[1] - design.shape[1]
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = np.sqrt(np.maximum(1.0 - square / total, 0.0)) * np.sign(linear[:, 1])
        side = 2 * reach + 1
        plane = grey.reshape(-1, side, side)
        checker = plane[:, 1:, 1:] - plane[:, 1:, :-1] - plane[:, :-1, 1:] + plane[:, :-1, :-1]
        contrast = np.sqrt(total / grey.shape[1]) / (
            0.7413 * np.median(np.abs(checker).reshape(len(grey), (side - 1) ** 2), axis=1)
        )
    fitted = np.where(none[:, None, None], np.nan, design), np.where(none[:, None], np.nan, residual)
    hidden = np.where(none, np.nan, 1.0)
    spread = window_checks.residual_correlation(*fitted, side, of_template.inverse)
    return Fits(
        place * hidden[:, None],
        affine * hidden[:, None, None],
        linear[:, 1] * hidden,
        correlation * hidden,
        np.sqrt(square / redundancy) * hidden,
        contrast,
        smoothing * hidden,
        iterations,
        reason,
        spread,
        of_template,
        window_checks.window_relief(*fitted, side),
        window_checks.window_halves(*fitted, side),
        window_checks.window_scales(*fitted, side, spread),
    )
