"""Maximum-likelihood fit of the calibrated spot shape, its Cramer-Rao bound, and tests of the fit.

Model of a pixel: background + flux * shape(row, column); normal likelihood with the variance temporal / frames + fixed
pattern at the model's grey value. Fisher scoring (Kay, Estimation Theory, 1993, sec. 7.7) is run from two starts. Pixel
coordinates: (row, column), the centre of the first pixel is (0, 0).

A fit is tested for convergence and for the spot having the fitted shape. Reduced chi-squares are tested twice: over the
whole image, where the noise of the frames dominates, and over the spot's core, where its shape dominates. Each limit is
exceeded with probability `FALSE_ALARM` by a spot of the calibrated shape in frames of the specified noise; both assume
pixels with normal noise plus the excess kurtosis of shot noise of few electrons (Satterthwaite, Biometrics Bulletin 2,
110 (1946)).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from analysis.arrays import Array, StateArrays
from analysis.spots import spot_image
from analysis.spots.centroid import energy_centroid, gaussian_fit
from analysis.spots.noise import NoiseModel
from analysis.spots.spot_image import SpotError, SpotPositions
from analysis.spots.spot_template import SpotTemplate, TemplateRangeError
from analysis.statistics import limit_of

_REST_PX = 1e-6
_FLUX_SIGMAS = 5.0
# Side of the part of the image that the start is sought in, and the number of steps there; they cost a ninth each.
_NEAR_PX = 32
_NEAR_STEPS = 2
_MOST_STEPS = 30
# A second start is needed where the image is as like the shape farther than this from where the first fit ended ...
_SAME_PX = 2
# ... by this share of its likeness in the best place ...
_LIKE = 0.95
# ... and has the same end if that is not farther than this.
_AGREE_PX = 1e-3
# Difference of minus twice the logarithms of two likelihoods by which one place is told from the other: a ratio of 2e4.
_DECISIVE = 20.0
_MOST_DAMPED = 100
# Median of the square of a standard normal number.
_MEDIAN_SQUARE = 0.4549364231195724
# Of so many pixels one is in that median, which then scatters by 5 %.
_STRIDE = 4
_HALVINGS = 6

EDGE_PX = 10.0
"""Smallest distance of a spot's centre from the outermost pixel centres, px."""
CORE_SHARE = 0.02
"""Fraction of a spot's peak above which a pixel belongs to its core."""


def maximum_likelihood_fit(
    mean: ArrayLike,
    frames: int,
    noise: NoiseModel,
    template: SpotTemplate,
    edge_px: float = EDGE_PX,
    keep_maps: bool = True,
    threads: int = 1,
    max_iterations: int = _MOST_STEPS,
) -> SpotPositions:
    """Fit row, column, flux and background of the calibrated shape by Fisher scoring.

    The variance of a pixel is temporal / frames + fixed pattern, at the model's grey value; the score is that of a
    normal likelihood with known variance, which for shot noise equals the Poisson score.

    Dimensions: B spots, H rows, W columns.

    Parameters
    ----------
    mean : (B, H, W) array_like
        Mean frames, DN (grey values).
    frames : int
        Number of frames averaged into each image.
    noise : NoiseModel
        Noise of the detector.
    template : SpotTemplate
        T shapes; the spot with index b has the shape with index b modulo T.
    edge_px : float
        Smallest distance of a centre from the image's outermost pixel centres; at most a quarter of a side in images of
        less than 24 px.
    keep_maps : bool
        True to keep the derivatives of the position with respect to every pixel, for covariances of differences.
    threads : int
        Number of threads. The batch is cut into small pieces that fit the cache; results do not depend on the number of
        threads.
    max_iterations : int
        Greatest number of scoring steps; a spot that needs more is marked as not converged.
    """
    image = spot_image.as_images(mean)
    count, height, width = image.shape
    if (height, width) != template.shape:
        raise ValueError(f"maximum likelihood: images are {height} x {width} px, the template is for {template.shape}")
    if threads < 1 or max_iterations < 1:
        raise ValueError(f"maximum likelihood: threads {threads} and max_iterations {max_iterations} must be >= 1")
    rule = _Rule(template, noise, frames)
    if min(height, width) < spot_image.SMALL:
        edge_px = min(edge_px, min(height, width) / 4.0)
    which = np.arange(count) % template.count

    def measure(part: slice) -> SpotPositions:
        try:
            return _score(rule, image[part], which[part], edge_px, keep_maps, max_iterations)
        except TemplateRangeError as error:
            reason = "the fit left the range of the template; calibrate it with a larger margin"
            raise SpotError(dict.fromkeys(error.indices, reason)) from error

    return spot_image.in_pieces(measure, count, threads)


def _score(
    rule: _Rule, image: Array, which: NDArray[np.intp], edge_px: float, keep_maps: bool, max_iterations: int
) -> SpotPositions:
    """Fit a few images of a batch by Fisher scoring, from a second start as well where one is needed."""
    count, height, width = image.shape
    noise, frames = rule.noise, rule.frames
    row, column, background, _, _ = spot_image.coarse(image, frames, noise)
    # The first step finds flux and background exactly for a given place (the model is linear in them).
    flux = np.maximum(image.sum(axis=(1, 2)) - background * height * width, 1.0)
    theta = np.stack([row, column, flux, background], axis=1)
    spot_image.check_edge(theta[:, :2], height, width, edge_px)
    theta = _start(rule, image, theta, which)
    work = np.empty((2, count, 4, height * width))
    last = rule.scored(image, theta, which, max_iterations, work)
    better = _second_start(image, last, which, rule, edge_px, max_iterations)
    if better is not None:
        last = rule.scored(image, better, which, max_iterations, work)
    theta, level, weight, residual, design = last.theta, last.level, last.weight, last.residual, last.design
    # The last design is one step old, below 1e-3 px; a fresh one would cost half as much again.
    influence = last.inverse[:, :2] @ last.weighted
    temporal, fixed = spot_image.propagate(influence, level, noise, frames)
    square = residual * residual * weight
    pixels = residual.shape[1]
    chi = square.sum(axis=1) / (pixels - 4)
    core = design[:, 2] > CORE_SHARE * design[:, 2].max(axis=1, keepdims=True)
    many = np.maximum(core.sum(axis=1), 1)
    freedom = spot_image.excess(level, weight, noise, frames)
    degrees = np.stack([_degrees(np.ones_like(core), freedom) - 4.0, _degrees(core, freedom)], axis=1)
    spot_image.check_edge(theta[:, :2], height, width, edge_px)
    weak = theta[:, 2] < _FLUX_SIGMAS * np.sqrt(last.inverse[:, 2, 2])
    spot_image.reject(weak, f"no spot: the flux is not significant (below {_FLUX_SIGMAS:g} sigma)")
    return SpotPositions(
        row=theta[:, 0],
        column=theta[:, 1],
        temporal_covariance=temporal,
        fixed_covariance=fixed,
        flux=theta[:, 2],
        background=theta[:, 3],
        converged=last.steps <= max_iterations,
        iterations=last.iterations,
        reduced_chi_square=chi,
        gain_maps=influence.reshape(count, 2, height, width) if keep_maps else None,
        light_dn=noise.light_signal_dn(level).reshape(count, height, width) if keep_maps else None,
        core_chi_square=np.sum(square * core, axis=1) / many,
        degrees=degrees,
        median_square=np.median(square[:, ::_STRIDE], axis=1) / _MEDIAN_SQUARE,
    )


def _degrees(of: NDArray[np.bool_], excess: Array) -> Array:
    """Return the effective degrees of freedom, (B,), of the sum of squared residuals over some pixels (B, P).

    They are matched to the sum's variance. Each square has the variance 2 + excess; the chi-square distribution has the
    variance of their sum.

    Dimensions: B spots, P pixels.
    """
    count = of.sum(axis=1)
    return np.asarray(2.0 * count**2 / np.maximum(np.sum(of * (2.0 + excess), axis=1), 1e-300))


@dataclass(frozen=True, eq=False)
class _Scored:
    """Result of Fisher scoring: the fitted parameters and the quantities of its last step.

    The fields are the parameters theta (B, 4) (row, column, flux, background), the step at which each spot converged
    (B,) (one more than allowed if it did not), and of the last step level, weight and residual (B, P), design and
    design times weight (B, 4, P) and the inverse information (B, 4, 4).

    Dimensions: B spots, P pixels.
    """

    theta: Array
    steps: NDArray[np.intp]
    iterations: int
    level: Array
    weight: Array
    residual: Array
    design: Array
    weighted: Array
    inverse: Array


@dataclass(frozen=True, eq=False)
class _Rule:
    """Fisher scoring of spots with one template, noise model and number of frames."""

    template: SpotTemplate
    noise: NoiseModel
    frames: int

    def scored(
        self, image: Array, theta: Array, which: NDArray[np.intp], most: int, work: Array, damped: bool = False
    ) -> _Scored:
        """Run Fisher scoring of spots (B, H, W) from given parameters; `work` (2, B, 4, P) is storage for the designs.

        If `damped`, a step is halved until the weighted sum of squares decreases.

        Dimensions: B spots, H rows, W columns, P pixels.
        """
        flat = image.reshape(len(image), -1)
        steps = np.full(len(image), most + 1)
        before = np.full(len(image), _REST_PX)
        design, weighted = work
        for iteration in range(1, most + 1):
            _, level = spot_image.template_model(theta, which, self.template, out=design)
            weight = 1.0 / spot_image.variance(level, self.noise, self.frames)
            residual = flat - level
            start = theta
            theta, length, inverse, weighted = _step(theta, design, weight, residual, weighted)
            if damped:
                theta = self._descended(flat, start, theta, which, weight, residual)
            # Steps shrink at least as fast as the last one did, so that the one after this is known to be negligible.
            still = length * np.minimum(length / before, 1.0) < _REST_PX
            before = length
            steps = np.where(still, np.minimum(steps, iteration), most + 1)
            if np.all(still):
                break
        return _Scored(theta, steps, iteration, level, weight, residual, design, weighted, inverse)

    def _descended(
        self, flat: Array, start: Array, end: Array, which: NDArray[np.intp], weight: Array, residual: Array
    ) -> Array:
        """Return the end of an iteration step (B, 4), moved towards its start where the sum of squares would grow.

        Dimensions: B spots.
        """
        square = np.sum(residual * residual * weight, axis=1)
        for _ in range(_HALVINGS):
            _, level = spot_image.template_model(end, which, self.template)
            worse = np.sum((flat - level) ** 2 * weight, axis=1) > square * (1.0 + 1e-12)
            if not np.any(worse):
                break
            end = np.where(worse[:, None], 0.5 * (start + end), end)
        return end

    def deviance(self, fit: _Scored) -> Array:
        """Return minus twice the log-likelihood of each spot at the last step, (B,).

        Dimensions: B spots.
        """
        return np.asarray(np.sum(fit.residual**2 * fit.weight - np.log(fit.weight), axis=1))


def _second_start(
    image: Array, first: _Scored, which: NDArray[np.intp], rule: _Rule, edge_px: float, most: int
) -> Array | None:
    """Return the fitted parameters (B, 4) after a second start from another position; None if no spot needs one.

    The correlation of image and shape is greatest where the sum of squares is smallest, among all positions. If it has
    no other maximum as high as at the end of the first fit, which holds for every sharp spot, both starts have the same
    end.

    Dimensions: B spots.

    Raises
    ------
    SpotError
        Two positions fit the image equally well.
    """
    _, height, width = image.shape
    shape = first.design[:, 2].reshape(image.shape)
    light = image - first.theta[:, 3, None, None]
    # single precision finds the pixel
    spectra = (fft.rfft2(image.astype(np.float32)) for image in (light, shape))
    surface = fft.irfft2(next(spectra) * np.conj(next(spectra)), (height, width))
    size, resting = np.array([height, width]), np.asarray(first.steps <= most)
    lag = np.stack([_best_elsewhere(correlation) for correlation in surface])
    again = np.flatnonzero(~resting | np.any(lag != 0, axis=1))
    if not len(again):
        return None
    out, deviance = first.theta.copy(), rule.deviance(first)
    chi = np.mean(first.residual**2 * first.weight, axis=1)
    unclear: dict[int, str] = {}
    for k in again.tolist():
        spot = slice(k, k + 1)
        theta = first.theta[spot].copy()
        theta[:, :2] = np.clip(theta[:, :2] + lag[k], edge_px, size - 1 - edge_px)
        try:
            work = np.empty((2, 1, 4, height * width))
            second = rule.scored(image[spot], theta, which[spot], _MOST_DAMPED, work, damped=True)
        except (TemplateRangeError, np.linalg.LinAlgError):
            continue
        if second.steps[0] > _MOST_DAMPED:
            continue
        apart = float(np.max(np.abs(second.theta[0, :2] - first.theta[k, :2])))
        gain = float(deviance[k] - rule.deviance(second)[0])
        least = min(float(chi[k]), float(np.mean(second.residual**2 * second.weight)))
        if not resting[k] or gain > 0.0:
            out[k] = second.theta[0]
        if resting[k] and apart > _AGREE_PX and abs(gain) < _DECISIVE * max(1.0, least):
            positions = ", ".join(
                f"({row:.2f}, {column:.2f})" for row, column in (first.theta[k, :2], second.theta[0, :2])
            )
            unclear[k] = f"its shape fits equally well at two positions, {positions} px, so that neither is reliable"
    if unclear:
        raise SpotError(unclear)
    return out


def _start(rule: _Rule, image: Array, theta: Array, which: NDArray[np.intp]) -> Array:
    """Return improved start parameters (B, 4) from the few pixels about each spot.

    Dimensions: B spots.
    """
    height, width = image.shape[1:]
    size = (min(_NEAR_PX, height), min(_NEAR_PX, width))
    corner = np.rint(theta[:, :2] - 0.5 * (np.array(size) - 1)).astype(np.intp)
    corner = np.clip(corner, 0, np.array([height, width]) - size)
    near = np.stack([mean[r : r + size[0], c : c + size[1]] for mean, (r, c) in zip(image, corner, strict=True)])
    flat = near.reshape(len(image), -1)
    for _ in range(_NEAR_STEPS):
        design, level = spot_image.template_model(theta, which, rule.template, (corner, size))
        weight = 1.0 / rule.noise.temporal_variance_dn2(level, rule.frames)
        theta = _step(theta, design, weight, flat - level)[0]
    return theta


def _best_elsewhere(surface: Array) -> NDArray[np.intp]:
    """Return the distance (row, column) in px from the fit to the best other match of image and shape; 0 if none."""
    size = np.array(surface.shape)
    # few places are as high, and only these need to be looked at for tops
    high = np.argwhere(surface > _LIKE * surface.max())
    rows, columns = ((high[:, axis, None] + np.arange(-2, 3)) % size[axis] for axis in (0, 1))
    around = surface[rows[:, :, None], columns[:, None, :]]
    tops = high[surface[high[:, 0], high[:, 1]] == around.max(axis=(1, 2))]
    lags = np.where(tops > size // 2, tops - size, tops)
    away = np.any(np.abs(lags) > _SAME_PX, axis=1)
    if not np.any(away):
        return np.zeros(2, np.intp)
    best = int(np.argmax(surface[tops[away, 0], tops[away, 1]]))
    return np.asarray(lags[away][best])


def _step(
    theta: Array, design: Array, weight: Array, residual: Array, out: Array | None = None
) -> tuple[Array, Array, Array, Array]:
    """Take one step of Fisher scoring.

    Returns the parameters (B, 4), the length of the step (B,) in px, the inverse information (B, 4, 4) and the design
    times weight (B, 4, P), which is stored in `out` if that is given.

    Dimensions: B spots, P pixels.
    """
    weighted = np.multiply(design, weight[:, None], out=out)
    inverse: Array = np.asarray(np.linalg.inv(weighted @ design.transpose(0, 2, 1)), dtype=np.float64)
    step: Array = np.asarray(inverse @ (weighted @ residual[:, :, None]), dtype=np.float64)[:, :, 0]
    # At most one pixel at once, and flux stays positive: a first guess may be wrong by more than the linear range.
    length = np.maximum(np.abs(step[:, :2]).max(axis=1), 1e-300)
    short = np.minimum(1.0, 1.0 / length)
    short = np.where(step[:, 2] < -0.9 * theta[:, 2], np.minimum(short, -0.9 * theta[:, 2] / step[:, 2]), short)
    return theta + step * short[:, None], length, inverse, weighted


def image_bound(light: ArrayLike, background: float, noise: NoiseModel, frames: int) -> Array:
    """Return the Cramer-Rao bound of the positions of spots that noise-free images show, (B, 2, 2) px^2.

    Dimensions: B spots, H rows, W columns.

    Parameters
    ----------
    light : (B, H + 4, W + 4) array_like
        Light of the spots without background, DN, with two pixels more on every side than the detector for the slopes
        (differences of fourth order: the sigmas of a spot whose first dark ring is at 7 px come out 2e-3 too low, of
        wider ones less).
    background : float
        Background with black level, DN.
    noise : NoiseModel
        Noise of the detector. The fixed pattern counts: the bound is for one image by itself.
    frames : int
        Number of frames averaged into an image.
    """
    image = np.asarray(light, np.float64)
    count, inner = len(image), image[:, 2:-2, 2:-2]

    def slope(axis: int) -> Array:
        near, far = (np.roll(image, -k, axis) - np.roll(image, k, axis) for k in (1, 2))
        return -np.asarray((8.0 * near - far) / 12.0)[:, 2:-2, 2:-2]

    columns = (slope(1), slope(2), inner / inner.sum(axis=(1, 2), keepdims=True), np.ones_like(inner))
    design = np.stack([column.reshape(count, -1) for column in columns], axis=1)
    return _bound(design, inner.reshape(count, -1) + background, noise, frames)


def _bound(design: Array, level: Array, noise: NoiseModel, frames: int) -> Array:
    """Return the Cramer-Rao bound of row and column, (B, 2, 2) px^2, from the derivatives and levels of all pixels.

    Dimensions: B spots.
    """
    design = design / np.sqrt(spot_image.variance(level, noise, frames))[:, None]
    information = design @ design.transpose(0, 2, 1)
    return np.asarray(np.linalg.inv(information)[:, :2, :2], dtype=np.float64)


FALSE_ALARM = 1e-8
"""Probability that a spot of the calibrated shape exceeds one of the two limits of a fit.

It gives 2e-7 for a run with four spots before and after, and 1e-4 for a series of a thousand times.
"""
NOT_CONVERGED = "the fit does not converge from either of two starts; the spot does not have the calibrated shape"
"""Reason given for refusing a spot whose fit does not converge."""


@dataclass(frozen=True, eq=False)
class FitStates(StateArrays):
    """Goodness of fit of spots: arrays (B,) for B spots, or (S, C) for S states of C spots.

    Attributes
    ----------
    whole, core : ndarray
        Reduced chi-squares of all pixels and of the core's; NaN where no shape was fitted.
    whole_limit, core_limit : ndarray
        Limits of these chi-squares; infinite where no shape was fitted.
    whole_sigma, core_sigma : ndarray
        Standard deviations of these chi-squares due to the noise of the frames.
    noise : ndarray
        Squared ratio of the frames' noise to the specified one, from the median of all pixels.
    """

    whole: Array
    core: Array
    whole_limit: Array
    core_limit: Array
    whole_sigma: Array
    core_sigma: Array
    noise: Array

    @property
    def fits(self) -> NDArray[np.bool_]:
        """True where the spot has the assumed shape and noise, and where that cannot be tested."""
        beyond = (self.whole > self.whole_limit) | (self.core > self.core_limit)
        return np.asarray(~beyond)

    @property
    def widening(self) -> Array:
        """Factor by which sigma is increased: 1 for a spot that fits, else the root of the larger reduced chi-square.

        It is the Birge ratio: Birge, Physical Review 40, 207 (1932).
        """
        with np.errstate(invalid="ignore"):
            grown = np.sqrt(np.fmax(self.whole, self.core))
        return np.where(self.fits, 1.0, np.maximum(grown, 1.0))

    def reshaped(self, spots: int) -> FitStates:
        """Return the arrays with shape (S, C), for S states of C spots each.

        Parameters
        ----------
        spots : int
            Number of spots C.
        """
        return FitStates(*(values.reshape(-1, spots) for values in vars(self).values()))


def fit_states(positions: SpotPositions) -> FitStates:
    """Return the chi-squares of the fits of B spots, with the limits that decide whether they fit.

    Parameters
    ----------
    positions : SpotPositions
        Positions of B spots, with the chi-squares of their fits.
    """
    count = positions.row.size
    if positions.degrees is None or positions.core_chi_square is None:
        nothing, endless = np.full(count, np.nan), np.full(count, np.inf)
        return FitStates(nothing, nothing, endless, endless, nothing, nothing, nothing)
    limit = limit_of(0.5 * FALSE_ALARM, positions.degrees) / positions.degrees
    whole, core = positions.reduced_chi_square, positions.core_chi_square
    noise = np.full(count, np.nan) if positions.median_square is None else positions.median_square
    sigma = np.sqrt(2.0 / positions.degrees)
    return FitStates(whole, core, limit[:, 0], limit[:, 1], sigma[:, 0], sigma[:, 1], noise)


def widened(positions: SpotPositions, factor: Array) -> SpotPositions:
    """Return the positions with their standard deviations multiplied by the given factors.

    Parameters
    ----------
    positions : SpotPositions
        B positions.
    factor : (B,) ndarray
        Factor of each spot's standard deviations, such as the root of its reduced chi-square.
    """
    if np.all(factor == 1.0):
        return positions
    square, gain = factor[:, None, None] ** 2, positions.gain_maps
    return replace(
        positions,
        temporal_covariance=positions.temporal_covariance * square,
        fixed_covariance=positions.fixed_covariance * square,
        gain_maps=None if gain is None else gain * factor[:, None, None, None],
    )


def require_convergence(positions: SpotPositions) -> SpotPositions:
    """Return the positions unchanged, or raise SpotError for spots whose fit has not converged.

    Parameters
    ----------
    positions : SpotPositions
        Measured positions.
    """
    if not np.all(positions.converged):
        raise SpotError({int(n): NOT_CONVERGED for n in np.flatnonzero(~positions.converged)})
    return positions


METHODS = ("gaussian", "energy", "ml")
"""Names of the centroid methods that `fit_spot` offers, out of `analysis.spots.CENTROIDS`."""


@dataclass(frozen=True, eq=False)
class SpotFit:
    """Centres of spots with their covariance: numbers for one image, arrays of shape (B,) for B images.

    Attributes
    ----------
    row, column : float or (B,) ndarray
        Centre, in pixels; the centre of the first pixel is (0, 0).
    covariance : (2, 2) or (B, 2, 2) ndarray
        Covariance of row and column, in square pixels, from noise and from the detector's fixed pattern.
    flux : float or (B,) ndarray
        Grey values summed over the spot.
    background : float or (B,) ndarray
        Grey value below the spot, with the black level.
    reduced_chi_square : float or (B,) ndarray
        Chi-square of the residuals per degree of freedom; near 1 if the spot has the fitted shape. NaN for "energy".
    """

    row: Any
    column: Any
    covariance: Array
    flux: Any
    background: Any
    reduced_chi_square: Any

    @property
    def sigma(self) -> Array:
        """Standard deviations of row and column, in pixels, shape (2,) or (B, 2).

        Dimensions: B spots.
        """
        return np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))


def fit_spot(
    image: ArrayLike,
    noise: NoiseModel,
    *,
    frames: int = 1,
    method: str = "gaussian",
    radius: float | None = None,
    template: SpotTemplate | None = None,
) -> SpotFit:
    """Fit the centre of the brightest spot of an image, with its covariance.

    The weights follow from the noise model and the fitted spot, not from the noisy pixels, which would bias the flux. A
    spot of another shape than the fitted one has a covariance that accounts for it (sandwich estimator).

    Dimensions: H rows, W columns, B spots.

    Parameters
    ----------
    image : (H, W) or (B, H, W) array_like
        Grey values as recorded, one spot in each image of at least 6 x 6 px. In images of less than 24 px
        one hot pixel can be taken for a spot; `fit_window_series` measures spots that such windows undersample.
    noise : NoiseModel
        Noise of the detector.
    frames : int
        Number of frames of which each image is the mean.
    method : {"gaussian", "energy", "ml"}
        Weighted least squares of a Gaussian, first moment in a window that follows the centre, or maximum-likelihood
        fit of a calibrated spot shape.
    radius : float, optional
        Radius of the window of "gaussian" or "energy", in pixels. The default is an eighth, at least 2, ("gaussian") or
        a quarter ("energy") of the smaller side of the image.
    template : SpotTemplate, optional
        Calibrated shape, for "ml" only.

    Returns
    -------
    SpotFit
        Centre, covariance, flux, background and goodness of fit.

    Raises
    ------
    ValueError
        Images that are too small, not real or not finite; a spot that is saturated, missing or too close to the edge; a
        fit that does not converge; or another method.

    Notes
    -----
    The covariance of a Gaussian fit to another shape follows White, Econometrica 50, 1 (1982); the weights follow
    Humphrey, Liu and Buote, Astrophys. J. 693, 822 (2009). For a Gaussian spot of standard deviation s that is limited
    by shot noise, the smallest possible sigma of each coordinate is s / sqrt(number of electrons).

    Examples
    --------
    A Gaussian spot of 2 px and 20 000 electrons. Its smallest possible sigma is 2 / sqrt(20000) = 0.0141 px:

    >>> import numpy as np
    >>> import analysis
    >>> row, column = np.mgrid[:31, :31]
    >>> shape = np.exp(-0.5 * ((row - 15.3) ** 2 + (column - 13.75) ** 2) / 2.0**2) / (2 * np.pi * 2.0**2)
    >>> image = 10 + 20000 * shape
    >>> fit = analysis.fit_spot(image, analysis.NoiseModel(), radius=10)
    >>> round(fit.row, 4), round(fit.column, 4), round(fit.flux)
    (15.3, 13.75, 20000)
    >>> np.round(fit.sigma, 4)
    array([0.0153, 0.0153])

    The scatter of noisy images agrees with the covariance:

    >>> rng = np.random.default_rng(1)
    >>> fits = analysis.fit_spot(rng.poisson(image, (60, 31, 31)), analysis.NoiseModel(), radius=10)
    >>> bool(abs(np.std(fits.row) / np.mean(fits.sigma[:, 0]) - 1) < 0.2)
    True

    The energy centroid gives the same place:

    >>> centroid = analysis.fit_spot(image, analysis.NoiseModel(), method="energy", radius=10)
    >>> round(centroid.row, 3), round(centroid.column, 3)
    (15.3, 13.75)
    >>> analysis.fit_spot(image, analysis.NoiseModel(), method="ml")
    Traceback (most recent call last):
        ...
    ValueError: fit_spot: method must be gaussian, energy, ml (needs template=), found 'ml'
    """
    pixels = np.asarray(image)
    if pixels.ndim not in (2, 3):
        raise ValueError(f"fit_spot: image must be (H, W) or (B, H, W), found shape {pixels.shape}")
    stack = pixels if pixels.ndim == 3 else pixels[None]
    if method == "gaussian":
        positions = gaussian_fit(stack, frames, noise, radius)
    elif method == "energy":
        positions = energy_centroid(stack, frames, noise, radius)
    elif method == "ml" and template is not None:
        positions = maximum_likelihood_fit(stack, frames, noise, template)
    else:
        raise ValueError(f"fit_spot: method must be {', '.join(METHODS)} (needs template=), found {method!r}")
    require_convergence(positions)
    values = positions.row, positions.column, positions.flux, positions.background, positions.reduced_chi_square
    row, column, flux, background, chi = values if pixels.ndim == 3 else (float(value[0]) for value in values)
    covariance = positions.covariance if pixels.ndim == 3 else positions.covariance[0]
    return SpotFit(row, column, covariance, flux, background, chi)
