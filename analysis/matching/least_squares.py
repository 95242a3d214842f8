"""Least squares matching of many points together (Gruen, South African Journal of Photogrammetry 14(3), 1985).

The image's pixels y in a window are modelled by the template t,

    y(x) = offset + gain t(u) + sharp_r t_rr(u) + sharp_c t_cc(u),   u = A (x - position),

with u counted from the template's middle, A an affine matrix, and second derivatives that model a difference in
sharpness. The template is interpolated and not the image, so that the image's noise enters unfiltered and does not bias
the fit towards positions between pixels, where an interpolated image is smoother.

**Noise of the template.** Its slopes are steeper than those of the texture, so that a fit of the raw template is
overconfident and biased towards whole pixels: errors in variables. The best prediction of the image by such a template
is a low-pass of it (Wiener), and its residual is uncorrelated with the template. Each template is therefore smoothed by
the strongest Gaussian of several whose residuals in the image are the smallest within chance, and the second
derivatives fit the rest. Neither noise level needs to be known, and a template without noise is hardly smoothed.

**Covariance.** Noise of the image, interpolated noise of the template and unmodelled signal are all in the residuals.
They are assumed to be stationary over one window, with a variance of its own (sum of squares over redundancy) and with
a correlation of neighbours up to three pixels that all points share: the median over the points, corrected for what a
fit of that many unknowns takes out of white noise. With the influence matrix B (position by pixel), computed with the
curvature that remains without the slopes of the template's noise, the covariance is B C B', and more where smoothing
leaves few independent residuals. Added are the contribution of displacements that vary within the window, estimated
from the residuals (`analysis.matching.window_checks`), and the interpolation error; steps of displacement are tested
for (same module). Not in the covariance: errors that all points share (of the reference's georeference) and aliasing of
the image.

**Errors in variables: curvature.** The fit converges where F = D r = 0, with design D (unknowns by pixel) and residuals
r of the model m. A position that noise has moved by e responds to F with the curvature of the sum of squares,

    H = D D' - sum over pixels of r d2m,

and not with D D' alone. Without noise in the template, residuals are independent of d2m, and the two are equal. With
noise they are not: the slopes of the noise are in D D' as if they were texture, and r, which contains the noise with
the opposite sign, subtracts them. So the covariance is H^-1 (D C D') H^-1, with C of the residuals: the sandwich
covariance of M-estimators (Huber, Proc. 5th Berkeley Symposium 1, 1967). It differs from the usual one where slopes are
few: **along a straight edge** there are only those of the noise. An isotropic low-pass cannot remove them, since the
edge is sharp across, and a normal matrix that counts them gives a sigma to a coordinate that is undetermined. Where
most of the normal matrix along some combination of unknowns is noise, the first-order theory fails, and the covariance
is NaN.

**Bias (lean).** Noise of the template has least energy under strong smoothing, a small gain and half way between
pixels, so the fit is biased towards these, and where unknowns are poorly separated the position is biased with them:

    lean = H^-1 E F = -H^-1 s_t^2 / 2 d/d(unknowns) [noise energy of the low-passed, sharpened, interpolated template].

The ratio of the template's noise to the residuals, s_t^2 / s^2 (both in the image), is the same for all points. Each
point gives a lower bound: the decrease of the residuals by the chosen low-pass, over that of white noise. Nine in ten
are below the value used. It is too low if all windows are so sharp that no low-pass serves, but then slopes are many
and the bias is negligible. The position is not corrected for it; its covariance is increased by lean lean'.

**Locking.** Where structure runs along one direction, the texture along it may be so weak that the noise's energy
determines the position: the fit then lies half way between pixels, where the bias is zero. So the covariance is also
increased by the effect of that energy's steepest slope on the position, with the curvature that remains without the
energy's own, 2 pi^2 N s_t^2 times its mean and its oscillation. The template is assumed to be at least as noisy as the
image. The effect is negligible for texture in two directions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array
from analysis.matching import window_checks
from analysis.matching.correlation import (
    MatchOptions,
    Reason,
    SplineStack,
    checked_image,
    checked_positions,
    checked_templates,
    concatenated,
    low_passed,
)
from analysis.matching.window_checks import ResidualCorrelation, WindowHalves, WindowRelief, WindowScales

_LEAST = 0.4
"""Smallest curvature of the sum of squares along any combination of unknowns, relative to the normal matrix. Below it,
most of the normal matrix is noise, and the combination is undetermined.
"""
_OPEN = 1e-11
"""Eigenvalue, relative to the largest, below which a combination of unknowns is undetermined."""
_QUANTILE = 0.9
"""Quantile, over the points, of the ratio of template noise to residual variance; its value is used for all points."""
_HELD = 0.3
"""Fraction of the curvature of the sum of squares above which template noise, not texture, counts as determining a
position.
"""
_SINGLE_DIRECTION = 0.1
"""Curvature of the sum of squares along the worst direction, relative to that along the best, below which the texture
of a window counts as running along one direction. As it is sharp across, no low-pass can be chosen that would
otherwise remove the noise's energy.
"""
_EQUAL = 0.6
"""Smallest noise ratio for locking: template and image have the same noise, of which interpolation passes two thirds.
"""
# Half width of the impulse response, and number of sub-pixel phases at which it is computed.
_IMPULSE_RADIUS, _PHASES = 30, 64


@dataclass(frozen=True, eq=False)
class TemplateNoise:
    """Effect of template noise in n fits with q unknowns; NaN where there is no fit, or where it is mostly noise.

    Attributes
    ----------
    inverse : (n, q, q) ndarray
        Inverse of the curvature (second derivatives) of the sum of squares with respect to the unknowns.
    lean : (n, 2) ndarray
        Bias of the position in row and column for a ratio of template noise to residual variance of 1, in pixels.
    energy : (n,) ndarray
        Largest curvature, with respect to the position along an axis, of the energy of the interpolated template noise,
        for a noise ratio of 1.
    share : (n,) ndarray
        Lower bound of the ratio of template noise to residual variance (both in the image), from the effect of the
        low-pass.
    """

    inverse: Array
    lean: Array
    energy: Array
    share: Array

    def covariance(self, good: NDArray[np.bool_]) -> Array:
        """Return the part of the position covariances due to template noise (bias and locking), (n, 2, 2), in px^2.

        There are n points. The ratio of template noise to residuals is estimated from those selected by the mask `good`
        (n,).
        """
        noise_ratios = self.share[good & np.isfinite(self.share)]
        if not len(noise_ratios):
            return np.zeros_like(self.inverse[:, :2, :2])
        share = float(np.quantile(noise_ratios, _QUANTILE))
        lean, lock = share * self.lean, self._lock(max(share, _EQUAL))
        return np.asarray(lean[:, :, None] * lean[:, None] + lock @ np.swapaxes(lock, 1, 2))

    def _lock(self, share: float) -> Array:
        """Return the displacement of n positions due to template noise along each axis, (n, 2, 2), in pixels.

        `share` is the ratio of the variance of the template noise to that of the residuals.
        """
        energy = share * self.energy[:, None, None] * np.eye(2)
        determined = np.isfinite(self.inverse[:, :2, :2]).all(axis=(1, 2)) & np.isfinite(self.energy)
        out = np.full_like(self.inverse[:, :2, :2], np.nan)
        # curvature without that of the noise's energy, which determines a locked position
        curvature = np.linalg.inv(self.inverse[determined, :2, :2])
        least, most = np.linalg.eigvalsh(curvature).T
        curvature = curvature - energy[determined]
        curvature[least <= energy[determined, 0, 0]] = np.nan
        lock = np.linalg.inv(curvature) @ energy[determined] / (2.0 * np.pi)
        unaffected = (energy[determined, 0, 0] < _HELD * least) | (least > _SINGLE_DIRECTION * most)
        out[determined] = np.where(unaffected[:, None, None], 0.0, lock)
        return out


@dataclass(frozen=True, eq=False)
class FitState:
    """Images, templates and current unknowns of n fits; the arrays are updated in place.

    Attributes
    ----------
    stack : SplineStack
        Low-passed templates.
    window : tuple of (p,) ndarray
        Rows and columns of the pixels about the window's middle, in pixels.
    grey : (n, p) ndarray
        Grey values of the image, in DN.
    shift : (n, 2) ndarray
        Position against the window's middle.
    affine : (n, 2, 2) ndarray
        Affine matrices.
    linear : (n, 2) or (n, 4) ndarray
        Offset, gain and, optionally, sharpness along rows and columns.
    design : (n, q, p) ndarray
        Derivatives of the p grey values of the model with respect to the q unknowns: position, affine matrix
        (optional), and linear unknowns.
    residual : (n, p) ndarray
        Residuals, in DN; NaN where there is no fit.
    """

    stack: SplineStack
    window: tuple[Array, Array]
    grey: Array
    shift: Array
    affine: Array
    linear: Array
    design: Array
    residual: Array

    def offset(self, which: NDArray[np.intp]) -> Array:
        """Return the positions of the window's p pixels against the fitted positions of m fits, (m, 2, p)."""
        return np.stack([self.window[k] - self.shift[which, k, None] for k in range(2)], axis=1)


def template_noise(
    state: FitState, which: NDArray[np.intp], smoothing: Array, lowered: tuple[Array, Array]
) -> TemplateNoise:
    """Compute the effect of template noise on converged fits.

    Parameters
    ----------
    state : FitState
        The n fits.
    which : (n,) ndarray of int
        Template of each fit.
    smoothing : (n,) ndarray
        RMS radius of the low-pass of each of the n templates, in pixels.
    lowered : tuple of (n,) ndarray
        Decrease of the sum of squared residuals by the low-pass, and decrease of the energy of white noise of unit
        variance in a pixel, against no low-pass.
    """
    affine, linear, design, residual = state.affine, state.linear, state.design, state.residual
    count, unknowns, pixels = design.shape
    inverse, lean = np.full((count, unknowns, unknowns), np.nan), np.full((count, 2), np.nan)
    curvature = np.full(count, np.nan)
    share = np.full(count, np.nan)
    used = np.flatnonzero(np.isfinite(residual).all(axis=1) & np.all((design**2).sum(axis=2) > 0, axis=1))
    if not used.size:
        return TemplateNoise(inverse, lean, curvature, share)
    offset = state.offset(used)
    position = affine[used] @ offset + state.stack.size // 2
    # derivatives with respect to the geometric unknowns: position and, optionally, matrix
    by_geometry = np.zeros((used.size, 2, unknowns - linear.shape[1], pixels))
    by_geometry[:, :, :2] = -affine[used][..., None]
    if by_geometry.shape[2] > 2:
        for axis in range(2):
            by_geometry[:, axis, 2 + 2 * axis : 4 + 2 * axis] = offset
    second_derivatives = _bend(state.stack, which[used], position, linear[used], by_geometry, residual[used])
    square = design[used] @ np.swapaxes(design[used], 1, 2)
    inverse[used] = _inverse(square, square - second_derivatives)
    variance = np.einsum("np,np->n", residual[used], residual[used]) / (pixels - unknowns)
    bias_force = variance[:, None] * _force(position, linear[used], smoothing[used], by_geometry)
    lean[used] = np.einsum("nij,nj->ni", inverse[used, :2], bias_force)
    mean, wave = np.moveaxis(np.array([_noise_gain(float(radius)) for radius in smoothing[used]])[:, :, 0], 1, 0)
    curvature[used] = 2.0 * np.pi**2 * pixels * variance * mean * wave
    square_sum, energy = lowered[0][used], lowered[1][used]
    with np.errstate(divide="ignore", invalid="ignore"):
        share[used] = np.where(energy > 0, np.clip(square_sum / (pixels * energy * variance), 0.0, 1.0), 0.0)
    return TemplateNoise(inverse, lean, curvature, share)


def _bend(
    stack: SplineStack, which: NDArray[np.intp], position: Array, linear: Array, by_geometry: Array, residual: Array
) -> Array:
    """Return the sum over pixels of residuals times second derivatives of the model, (n, q, q).

    There are n fits, and the derivatives are with respect to their q unknowns.

    Second derivatives of the position in the template with respect to the unknowns multiply sums of residuals times
    slopes, which are 0.
    """
    geometry, unknowns = by_geometry.shape[2], by_geometry.shape[2] + linear.shape[1]
    sharp = linear.shape[1] > 2
    value = stack(position[:, 0], position[:, 1], which, order=4 if sharp else 2)
    second = linear[:, 1, None] * value[3:6]
    if sharp:
        second = second + linear[:, 2, None] * value[10:13] + linear[:, 3, None] * value[12:15]
    row, cross, column = residual * second
    out = np.zeros((len(which), unknowns, unknowns))
    along_rows = row[:, None] * by_geometry[:, 0] + cross[:, None] * by_geometry[:, 1]
    along_columns = cross[:, None] * by_geometry[:, 0] + column[:, None] * by_geometry[:, 1]
    out[:, :geometry, :geometry] = along_rows @ np.swapaxes(by_geometry[:, 0], 1, 2) + along_columns @ np.swapaxes(
        by_geometry[:, 1], 1, 2
    )
    # the columns of gain and sharpness depend on the position
    for k, slopes in enumerate(((1, 2), (6, 7), (8, 9))[: linear.shape[1] - 1]):
        along = sum(np.einsum("nip,np->ni", by_geometry[:, axis], residual * value[slopes[axis]]) for axis in range(2))
        out[:, :geometry, geometry + 1 + k] = out[:, geometry + 1 + k, :geometry] = along
    return out


def _inverse(square: Array, curvature: Array) -> Array:
    """Return the inverse curvature of the sum of squares of n fits in q unknowns, (n, q, q).

    It is NaN where there is too little curvature.

    It is inverted within the range of the normal matrix.
    """
    scale = 1.0 / np.sqrt(np.einsum("nqq->nq", square))
    scales = scale[:, :, None] * scale[:, None]
    value, vector = np.linalg.eigh(square * scales)
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = np.where(value > _OPEN * value[:, -1:], 1.0 / np.sqrt(value), 0.0)
    root = vector * roots[:, None, :]
    relative = np.swapaxes(root, 1, 2) @ (curvature * scales) @ root
    # undetermined combinations stay 0 in the root
    relative = relative + np.where(roots == 0.0, 1.0, 0.0)[:, :, None] * np.eye(relative.shape[1])
    share, axes = np.linalg.eigh(0.5 * (relative + np.swapaxes(relative, 1, 2)))
    share = np.where(share.min(axis=1, keepdims=True) > _LEAST, share, np.nan)
    rotated_root = root @ axes
    return np.asarray((rotated_root / share[:, None, :]) @ np.swapaxes(rotated_root, 1, 2) * scales)


def _force(position: Array, linear: Array, smoothing: Array, by_geometry: Array) -> Array:
    """Return the expected gradient of the sum of squares due to white template noise of unit variance, (n, q).

    The gradient is with respect to the q unknowns of n fits. The variance is that in the image, after the gain.
    """
    mean, wave = np.moveaxis(np.array([_noise_gain(float(radius)) for radius in smoothing]), 1, 0)
    phase = 2.0 * np.pi * position
    # (3, n, 2, p): energy of the value, of value by second derivative, of the second derivative, along rows and columns
    energy = mean.T[:, :, None, None] + wave.T[:, :, None, None] * np.cos(phase)
    slope = -2.0 * np.pi * wave.T[:, :, None, None] * np.sin(phase)
    factors = linear[:, 1:]
    matrix = _products(energy[:, :, 0], energy[:, :, 1])[:, : factors.shape[1], : factors.shape[1]]
    of_position = np.zeros((len(linear), by_geometry.shape[2]))
    for axis, pair in enumerate(((slope[:, :, 0], energy[:, :, 1]), (energy[:, :, 0], slope[:, :, 1]))):
        change = _products(*pair)[:, : factors.shape[1], : factors.shape[1]]
        along = np.einsum("ni,nijp,nj->np", factors, change, factors)
        of_position -= 0.5 * np.einsum("nip,np->ni", by_geometry[:, axis], along)
    of_linear = -np.einsum("nijp,nj->ni", matrix, factors)
    force = np.concatenate([of_position, np.zeros((len(linear), 1)), of_linear], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(force / linear[:, 1, None] ** 2)


def _products(row: Array, column: Array) -> Array:
    """Return expected products of interpolated noise between its value and its two second derivatives, (n, 3, 3, p).

    The inputs are the products along rows and along columns, each (3, n, p), for n fits of p pixels.
    """
    value, across, second_row = (row[k] * column[0] for k in range(3))
    second_column, both, second_both = row[0] * column[1], row[1] * column[1], row[0] * column[2]
    lines = [[value, across, second_column], [across, second_row, both], [second_column, both, second_both]]
    return np.stack([np.stack(line, axis=1) for line in lines], axis=1)


def noise_energy(factors: Array, smoothing: float) -> Array:
    """Return the variance of a pixel of the model due to white template noise, mean over all sub-pixel phases, (n,).

    The noise has unit variance after the gain.

    Parameters
    ----------
    factors : (n, 1) or (n, 3) ndarray
        Gain and, optionally, sharpness along rows and columns, of n fits.
    smoothing : float
        RMS radius of the low-pass, in pixels.
    """
    mean = _noise_gain(smoothing)[0][:, None, None]
    size = factors.shape[1]
    energy = np.einsum("ni,ij,nj->n", factors, _products(mean, mean)[0, :size, :size, 0], factors)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(energy / factors[:, 0] ** 2)


@lru_cache(maxsize=32)
def _noise_gain(smoothing: float) -> Array:
    """Return the fraction of white noise's energy that low-pass and interpolation leave along one axis, (2, 3).

    The noise has unit variance before.

    The columns are those of the value, of value times second derivative (px^-2) and of the second derivative (px^-4);
    the rows are the mean over the phase of a pixel and the amplitude of its cosine, which is largest on whole pixels.
    """
    size = 2 * _IMPULSE_RADIUS + 1
    impulse = np.zeros((1, size, size))
    impulse[0, _IMPULSE_RADIUS] = 1.0
    stack = SplineStack(low_passed(impulse, smoothing))
    rows = np.arange(10, size - 11) + np.arange(_PHASES)[:, None] / _PHASES
    value = stack(rows, np.full(rows.shape, float(_IMPULSE_RADIUS)), np.zeros(_PHASES, np.intp), order=2)
    energy = np.stack([(value[0] ** 2).sum(axis=1), (value[0] * value[3]).sum(axis=1), (value[3] ** 2).sum(axis=1)])
    series = np.fft.rfft(energy, axis=1) / _PHASES
    out = np.stack([series[:, 0].real, 2.0 * series[:, 1].real])
    out.setflags(write=False)
    return out


Index = NDArray[np.intp]
_CHUNK = 32
"""Number of points that are fitted together, so that the intermediate arrays stay in the processor's cache."""
_REST = 2e-4
"""Step of the position, and of the affine change at the window's side, at convergence, in pixels. The next step would
be an order of magnitude smaller.
"""
_LONGEST_STEP = 0.7
"""Longest Gauss-Newton step of the position, in pixels."""
_RIDGE = 1e-11
"""Number added to the diagonal of scaled normal matrices to keep singular ones solvable, relative to the diagonal."""
_SMOOTHINGS = (0.0, 0.35, 0.7, 1.1, 1.7, 2.6)
"""RMS radii of the Gaussians that may smooth a template, in pixels; those up to a ninth of the window's side are used.
"""
_ACCEPTED_INCREASE = 4.0
"""Increase of chi-square, with one degree of freedom, that chance exceeds in 5 % of cases; a low-pass that increases
the residuals by less is accepted.
"""
_INTERPOLATION = 0.004
"""Standard deviation of a position from interpolating noise-free detail up to 0.45 cycles per pixel, in pixels."""


@dataclass(frozen=True, eq=False)
class Fits:
    """Least-squares matches of n points; values are NaN where the window could not be fitted at all.

    Attributes
    ----------
    position : (n, 2) ndarray
        Row and column of the templates' middles in the image.
    affine : (n, 2, 2) ndarray
        Affine matrix A, which maps displacements in image pixels to template pixels.
    gain : (n,) ndarray
        Gain of the image against the template.
    correlation : (n,) ndarray
        Correlation of the image with the fitted template.
    sigma : (n,) ndarray
        Standard deviation of the residuals from the redundancy, in DN of the image.
    contrast : (n,) ndarray
        Ratio of the image's standard deviation in the window to the noise of one pixel, the latter from differences of
        2 x 2 pixels.
    smoothing : (n,) ndarray
        RMS radius of the Gaussian that smoothed the template, in pixels.
    iterations : (n,) ndarray of int
        Number of Gauss-Newton steps.
    reason : (n,) ndarray of int8
        Codes of `Reason`: ACCEPTED, TEMPLATE, OUTSIDE, IMAGE, SATURATED, FLAT, DIVERGED, MOVED, DISTORTED.
    spread : ResidualCorrelation
        Correlation of the residuals, which gives the covariance of the noise.
    template : TemplateNoise
        Effect of template noise on the positions.
    relief : WindowRelief
        Displacements within the windows, estimated from the residuals.
    halves : WindowHalves
        Differences between the positions of the windows' halves.
    scales : WindowScales
        Differences between the positions of coarse detail and of all detail.
    """

    position: Array
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
        """Return the covariance of row and column of each of n positions, (n, 2, 2), in px^2.

        Parameters
        ----------
        good : (n,) ndarray of bool, optional
            Points from which common quantities are estimated; the converged ones by default.
        """
        noise, relief = self.covariances(good)
        return noise + relief

    def covariances(self, good: NDArray[np.bool_] | None = None) -> tuple[Array, Array]:
        """Return two parts of the covariance of n positions, each (n, 2, 2), in px^2: due to noise and due to relief.

        The first includes the interpolation error. Relief means displacements that vary within the window.
        """
        noise, inflation, tau, _usual = self._parts(good)
        relief = tau[:, None, None] * self.relief.effect
        common = self.reason == Reason.ACCEPTED if good is None else good
        lean = self.template.covariance(common) + self.scales.excess(inflation, common)
        return noise * inflation[:, None, None] + lean + _INTERPOLATION**2 * np.eye(2), relief

    def steps(self, good: NDArray[np.bool_] | None = None) -> tuple[Array, Array]:
        """Return p-value and power of the test for a displacement step between halves of each of n windows, each (n,).

        NaN where there is no fit.
        """
        noise, inflation, _tau, typical = self._parts(good)
        # points without a covariance, because of template noise, use the median factor
        coloured = self._coloured(noise)
        shared = float(np.nanmedian(coloured)) if np.isfinite(coloured).any() else 1.0
        coloured = np.where(np.isfinite(coloured), coloured, shared)
        return self.halves.judged(self.spread.variance * coloured * inflation, typical)

    def _parts(self, good: NDArray[np.bool_] | None) -> tuple[Array, Array, Array, float]:
        """Return covariance due to residual noise, factor for noise hidden by smoothing, and variances of relief.

        The variances of relief, in px^2, are that of each point and that of a typical point.
        """
        common = self.reason == Reason.ACCEPTED if good is None else good
        noise = self.spread.covariance(common)
        return noise, self._noise_inflation(), *self.relief.square(self.spread.variance, self._coloured(noise), common)

    def _coloured(self, noise: Array) -> Array:
        """Return the factor by which correlation of residuals raises the variance of each of n positions."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.trace(noise, axis1=1, axis2=2) / np.trace(self.spread.plain, axis1=1, axis2=2))

    def _noise_inflation(self) -> Array:
        """Return the factor by which the noise at slopes of the grey values exceeds that in the residuals, (n,).

        It is NaN where unknown. A smoothed template hides part of its noise from the residuals.

        A smoothed template has one independent value per 4 pi rms^2 pixels. Its noise is in these alone and loses one
        to each unknown, while that of the image is white. With equal noise in both, and where half of the amplitude
        passes the smoothing, as slopes do, the template has a third of it.
        """
        unknowns = self.spread.unknowns
        with np.errstate(invalid="ignore", divide="ignore"):
            values_left = self.spread.pixels / (4.0 * np.pi * self.smoothing**2) - unknowns
            return np.where(
                self.smoothing > 0, np.where(values_left > 0, 1.0 + unknowns / (3.0 * values_left), np.nan), 1.0
            )


def least_squares(
    image: ArrayLike, templates: ArrayLike, start: ArrayLike, options: MatchOptions | None = None
) -> Fits:
    """Fit the positions of templates near start positions.

    Parameters
    ----------
    image : (H, W) array_like
        Image of H rows and W columns, of any real type.
    templates : (n, k, k) array_like
        Templates of k x k pixels, n of them; k odd.
    start : (n, 2) array_like
        Start row and column, accurate to a pixel.
    options : MatchOptions, optional
        Model and limits; the thresholds on correlation, ratio and sigma are not applied here.

    Raises
    ------
    ValueError
        A shape is wrong, or a template is too small for its margin.
    """
    plane = checked_image(image, "least squares matching")
    patch = checked_templates(templates, "least squares matching")
    first = checked_positions(start, len(patch), "least squares matching")
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
    return concatenated(parts)


def _fit(image: NDArray[np.generic], templates: Array, start: Array, options: MatchOptions) -> Fits:
    """Fit the positions of a group of points at once; the arguments are those of `least_squares`."""
    count, half = len(templates), templates.shape[1] // 2
    half_width = half - options.margin
    row, column = (
        g.ravel().astype(np.float64) for g in np.mgrid[-half_width : half_width + 1, -half_width : half_width + 1]
    )
    grey, anchor, reason = _windows(image, templates, start, half_width, options)
    linear = np.zeros((count, options.parameters - 6))
    linear[:, 0] = grey.mean(axis=1)
    iterations = np.zeros(count, np.intp)
    finite_templates = np.where((reason == 0)[:, None, None], templates, 0.0)
    radii = [smoothing for smoothing in _SMOOTHINGS if smoothing <= math.sqrt(row.size) / 9.0]
    # template i smoothed by the k-th radius has the number k count + i
    stack = SplineStack(np.concatenate([low_passed(finite_templates, smoothing) for smoothing in radii]))
    affine, design = np.tile(np.eye(2), (count, 1, 1)), np.zeros((count, options.parameters, row.size))
    residual = np.full((count, row.size), np.nan)
    state = FitState(stack, (row, column), grey, start - anchor, affine, linear, design, residual)
    level = np.zeros(count, np.intp)
    # repeat, because a template that is not yet in position seems to need more smoothing
    for pass_number in range(2):
        active = np.flatnonzero(reason == 0)
        candidates_count = int(level.max(initial=0)) + 1 if pass_number else len(radii)
        chosen, lowered = _best_smoothing(state, radii[:candidates_count], active, options.sharpness)
        active = active[(chosen != level)[active] | (pass_number == 0)]
        level = chosen
        for iteration in range(options.iterations + 1):
            if not active.size:
                break
            number, known = level[active] * count + active, linear[active, 1:]
            step, design[active], residual[active] = _step(state, active, number, known, iteration, options.sharpness)
            size = np.abs(step[:, :2]).max(axis=1)
            affine_step = step[:, 2:6].reshape(-1, 2, 2)
            converged = np.maximum(size, half_width * np.abs(affine_step).max(axis=(1, 2))) < _REST
            moved = iteration > 0
            damping = np.minimum(1.0, _LONGEST_STEP / np.maximum(size, 1e-300))[:, None]
            if moved:
                state.shift[active] += damping * step[:, :2]
                affine[active] += damping[:, :, None] * affine_step
            linear[active] = step[:, 6:]
            iterations[active] += moved
            moved_too_far = (
                np.abs(state.shift[active] + anchor[active] - start[active]).max(axis=1) > options.largest_move
            )
            distorted = np.abs(affine[active] - np.eye(2)).max(axis=(1, 2)) > options.largest_distortion
            reason[active[distorted]] = Reason.DISTORTED
            reason[active[moved_too_far]] = Reason.MOVED
            active = active[~((converged & moved) | moved_too_far | distorted)]
        reason[active] = Reason.DIVERGED
    smoothing = np.array(radii)[level]
    noise_of_template = template_noise(state, level * count + np.arange(count), smoothing, lowered)
    return _summary(state, anchor, smoothing, iterations, reason, noise_of_template)


def _windows(
    image: NDArray[np.generic], templates: Array, start: Array, half_width: int, options: MatchOptions
) -> tuple[Array, Array, NDArray[np.int8]]:
    """Return the p grey values of n windows (n, p), their middles (n, 2), and why a window is unusable."""
    reason = np.zeros(len(templates), np.int8)
    anchor = np.rint(start)
    fits = np.all((anchor >= half_width) & (anchor <= np.array(image.shape) - 1 - half_width), axis=1)
    reason[~fits] = Reason.OUTSIDE
    reason[~(np.isfinite(templates).all(axis=(1, 2)) & np.isfinite(start).all(axis=1))] = Reason.TEMPLATE
    offset = np.arange(-half_width, half_width + 1)
    usable = np.flatnonzero(reason == 0)
    rows, columns = (anchor[usable, k, None].astype(np.intp) + offset for k in range(2))
    grey = np.zeros((len(templates), (2 * half_width + 1) ** 2))
    grey[usable] = image[rows[:, :, None], columns[:, None, :]].reshape(usable.size, grey.shape[1])
    finite = np.isfinite(grey).all(axis=1)
    reason[~finite] = Reason.IMAGE
    grey[~finite] = 0.0
    saturation_level = options.saturation
    if saturation_level is None and image.dtype.kind in "ui":
        saturation_level = float(np.iinfo(image.dtype).max)  # type: ignore[type-var]
    if saturation_level is not None:
        reason[(reason == 0) & (grey.max(axis=1, initial=-np.inf) >= saturation_level)] = Reason.SATURATED
    uniform = (np.ptp(grey, axis=1) == 0) | (np.ptp(templates, axis=(1, 2)) == 0)
    reason[(reason == 0) & uniform] = Reason.FLAT
    return grey, np.where(reason[:, None] == Reason.TEMPLATE, 0.0, anchor), reason


def _best_smoothing(
    state: FitState, radii: list[float], selected: Index, sharpness: bool
) -> tuple[Index, tuple[Array, Array]]:
    """Return the index of the strongest acceptable low-pass of each of n points, and the decreases that it causes.

    A low-pass is acceptable if, after one linear step, the template predicts the image as well as with the best
    low-pass. The decreases, relative to the first low-pass, are those of the residuals and of the noise's energy for
    `template_noise`. Points not selected get 0.
    """
    count, pixels = state.grey.shape
    best, lowered = np.zeros(count, np.intp), (np.zeros(count), np.zeros(count))
    if not selected.size:
        return best, lowered
    # the gain of the first guess only scales columns, which does not change residuals
    linear = np.zeros((selected.size, state.linear.shape[1] - 1))
    linear[:, :1] = 1.0
    radius_count = len(radii)
    square, energy = np.zeros((2, radius_count, selected.size))
    for k, smoothing in enumerate(radii):
        step, _, residual = _step(state, selected, k * count + selected, linear, 1, sharpness)
        square[k] = np.einsum("np,np->n", residual, residual)
        energy[k] = noise_energy(step[:, 7:], smoothing)
    # take the strongest: too little smoothing is overconfident, too much loses little accuracy
    acceptable = square <= square.min(axis=0) * (1.0 + _ACCEPTED_INCREASE / pixels)
    best[selected] = radius_count - 1 - np.argmax(acceptable[::-1], axis=0)
    chosen = best[selected], np.arange(selected.size)
    for decrease, values in zip(lowered, (square, energy), strict=True):
        decrease[selected] = values[0] - values[chosen]
    return best, lowered


def _step(
    state: FitState, active: Index, which: Index, linear: Array, iteration: int, sharpness: bool
) -> tuple[Array, Array, Array]:
    """Return a Gauss-Newton step, new linear unknowns, derivatives (m, q, p) and residuals (m, p) of m fits.

    q is the number of unknowns, p that of pixels; linear unknowns are offset, gain and sharpness.
    """
    stack, grey, affine, offset = state.stack, state.grey[active], state.affine[active], state.offset(active)
    u = affine @ offset + stack.size // 2
    # third derivatives are needed only with sharpness terms
    third_order = sharpness and bool(linear[:, 1:].any())
    value = stack(u[:, 0], u[:, 1], which, order=2 + third_order if sharpness else 1)
    # the first pass estimates the linear unknowns at the start position
    known = linear.T[:, :, None] if iteration else np.zeros((linear.shape[1], len(grey), 1))
    by_row, by_column = known[0] * value[1], known[0] * value[2]
    if third_order:
        by_row = by_row + known[1] * value[6] + known[2] * value[8]
        by_column = by_column + known[1] * value[7] + known[2] * value[9]
    slope = np.stack([by_row, by_column], axis=1)
    columns = [
        -np.swapaxes(affine, 1, 2) @ slope,
        (slope[:, :, None] * offset[:, None]).reshape(len(grey), 4, -1),
        np.stack([np.ones_like(value[0]), value[0] - value[0].mean(axis=1, keepdims=True)], axis=1),
    ]
    columns.extend([np.stack([value[3], value[5]], axis=1)] if sharpness else [])
    design = np.concatenate(columns, axis=1)
    step = _solve(design, grey)
    return step, design, grey - np.einsum("mqp,mq->mp", design, step)


def _solve(design: Array, grey: Array) -> Array:
    """Solve the scaled normal equations of linear least-squares fits, with a small ridge against singularity."""
    scale = 1.0 / np.maximum(np.sqrt(np.einsum("mqp,mqp->mq", design, design)), 1e-300)
    scaled = design * scale[:, :, None]
    normal = scaled @ np.swapaxes(scaled, 1, 2) + _RIDGE * np.eye(design.shape[1])
    return scale * np.linalg.solve(normal, scaled @ grey[:, :, None])[:, :, 0]


def _summary(
    state: FitState, anchor: Array, smoothing: Array, iterations: Index, reason: NDArray[np.int8], noise: TemplateNoise
) -> Fits:
    """Return the converged fits with their statistics and the checks of their windows."""
    unfitted = np.isin(reason, (Reason.TEMPLATE, Reason.OUTSIDE, Reason.IMAGE, Reason.FLAT, Reason.SATURATED))
    grey, design, residual = state.grey, state.design, state.residual
    square = np.einsum("np,np->n", residual, residual)
    centred = grey - grey.mean(axis=1, keepdims=True)
    total = np.einsum("np,np->n", centred, centred)
    redundancy = grey.shape[1] - design.shape[1]
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = np.sqrt(np.maximum(1.0 - square / total, 0.0)) * np.sign(state.linear[:, 1])
        side = math.isqrt(grey.shape[1])
        plane = grey.reshape(-1, side, side)
        checker = plane[:, 1:, 1:] - plane[:, 1:, :-1] - plane[:, :-1, 1:] + plane[:, :-1, :-1]
        contrast = np.sqrt(total / grey.shape[1]) / (
            0.7413 * np.median(np.abs(checker).reshape(len(grey), (side - 1) ** 2), axis=1)
        )
    fitted = np.where(unfitted[:, None, None], np.nan, design), np.where(unfitted[:, None], np.nan, residual)
    mask = np.where(unfitted, np.nan, 1.0)
    spread = window_checks.residual_correlation(*fitted, side, noise.inverse)
    return Fits(
        (anchor + state.shift) * mask[:, None],
        state.affine * mask[:, None, None],
        state.linear[:, 1] * mask,
        correlation * mask,
        np.sqrt(square / redundancy) * mask,
        contrast,
        smoothing * mask,
        iterations,
        reason,
        spread,
        noise,
        window_checks.window_relief(*fitted, side),
        window_checks.window_halves(*fitted, side),
        window_checks.window_scales(*fitted, side, spread),
    )
