"""Fit of the calibrated spot shape to an image with missing pixels, uneven background, more spots or smear.

Pixels that are not good have no weight; one that is the mean of fewer frames has more noise. The model is

    background + slopes + sum over spots of flux x (shape convolved with a normal distribution)

It is fitted by Fisher scoring as in `likelihood`, with the same result for a clean image. All parameters are fitted
together, so that the uncertainty of the others is contained in the covariance of the position. Reflections are assumed
to have the shape of the spot, since the same optics form them; their interference with it is not modelled.

Pixel coordinates: (row, column), the centre of the first pixel is (0, 0).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from analysis.arrays import Array, Mask
from analysis.spots import spot_image
from analysis.spots.likelihood import EDGE_PX
from analysis.spots.noise import NoiseModel
from analysis.spots.spot_image import SpotError, SpotPositions
from analysis.spots.spot_template import SmearedShape, SpotTemplate, TemplateRangeError

_REST_PX, _MOST_STEPS = 1e-6, 60
_REST_SIGMAS = 1e-4
"""Largest change of further spots by the last iteration step, in sigmas of their position.

It is relative to sigma because they may be so faint that their positions are uncertain by part of a pixel.
"""
_FLUX_SIGMAS = 5.0
_MOST_SMEAR = 25.0
"""Largest second moment of a smear, px^2; a spot that is smeared by more is rejected as another one."""
CORE_SHARE = 0.02
"""Fraction of the peak above which pixels belong to the core, where the shape of the spot is tested."""


@dataclass(frozen=True)
class FitTerms:
    """Terms that are fitted in addition to the spot's position, its flux and the level of the background.

    Attributes
    ----------
    background : int
        0 for an even background, 1 for slopes, 2 for slopes and curvature.
    others : tuple of (float, float)
        Row and column of the start positions of further spots, px.
    smear : bool
        True if the shape is convolved with a normal distribution.
    learnt : bool
        True if the shape was learnt from frames of the spot, which may have been smeared more: a negative smear makes
        the shape sharper. Otherwise the shape is the sharpest possible, and a negative smear is noise.
    """

    background: int = 0
    others: tuple[tuple[float, float], ...] = ()
    smear: bool = False
    learnt: bool = False


@dataclass(frozen=True, eq=False)
class ScreenedFit:
    """Spot fitted to an image with defects, with everything else that was fitted together with it.

    Dimensions: G further spots, H rows, W columns, K fitted parameters.

    Attributes
    ----------
    positions : SpotPositions
        Position of the one spot.
    terms : FitTerms
        Terms that were fitted.
    others : (G, 3) ndarray
        Row, column (px) and relative flux of the further spots.
    others_sigma : (G, 3) ndarray
        Standard deviations of the numbers in `others`.
    smear : (2, 2) ndarray
        Second moments of the smear, px^2; zeros where none was fitted.
    level : (H, W) ndarray
        Fitted image, DN.
    variance : (H, W) ndarray
        Variance of the mean, DN^2, also where a pixel is not used.
    used : (H, W) ndarray of bool
        Pixels used by the fit.
    core : tuple of (float, int)
        Reduced chi-square of the pixels in the spot's core, and their number.
    cost : float
        Relative increase of the position's sigma over that without missing pixels, further terms and movement.
    missing : float
        The same increase without the effect of movement between frames.
    theta : (K,) ndarray
        Parameters: row, column, flux, level, then those of the further terms; px, DN, px^2.
    inverse : (K, K) ndarray
        Inverse of their information matrix.
    """

    positions: SpotPositions
    terms: FitTerms
    others: Array
    others_sigma: Array
    smear: Array
    level: Array
    variance: Array
    used: Mask
    core: tuple[float, int]
    cost: float
    missing: float
    theta: Array
    inverse: Array

    def residual(self, mean: Array) -> Array:
        """Return the image minus the model in standard deviations, (H, W); 0 where a pixel is not used.

        Dimensions: H rows, W columns.

        Parameters
        ----------
        mean : (H, W) ndarray
            Image, DN.
        """
        return np.asarray(np.where(self.used, (mean - self.level) / np.sqrt(self.variance), 0.0))

    def image_chi_square(self, mean: Array) -> float:
        """Return the sum of squared residuals of the fit over their variance, over all used pixels.

        Dimensions: H rows, W columns.

        Parameters
        ----------
        mean : (H, W) ndarray
            Image, DN.
        """
        return float(np.square(self.residual(mean)).sum())

    def core_fits(self, learnt_from: ScreenedFit | None = None, noisier: float = 1.0) -> bool:
        """Return True if the core has the calibrated shape, at a false-alarm rate of 1e-6.

        Parameters
        ----------
        learnt_from : ScreenedFit or None
            Fit to the image that the shape was learnt from, whose noise is in the shape as well; None for a noise-free
            shape.
        noisier : float
            Ratio of the real variance of the noise in the core to the specified one.
        """
        return self.core_widening(learnt_from, noisier) == 1.0

    def core_widening(self, learnt_from: ScreenedFit | None = None, noisier: float = 1.0) -> float:
        """Return the factor by which sigma is increased: 1 if the core has the calibrated shape, else more.

        It is the root of the core's reduced chi-square (Birge ratio) where the core does not have the calibrated shape.

        Parameters
        ----------
        learnt_from : ScreenedFit or None
            Fit to the image that the shape was learnt from, whose noise is in the shape as well; None for a noise-free
            shape.
        noisier : float
            Ratio of the real variance of the noise in the core to the specified one.
        """
        value, count = self.core
        spread = 1.0
        if learnt_from is not None:
            # at the peak, where the noise is that of the light
            first, second = (float(fit.variance.flat[int(np.argmax(fit.level))]) for fit in (learnt_from, self))
            spread += first / second * float(self.positions.flux[0] / learnt_from.positions.flux[0]) ** 2
        if value / (noisier * spread) * count <= chi2.isf(1e-6, max(count - 4, 1)):
            return 1.0
        return float(max(np.sqrt(value / (noisier * spread)), 1.0 + 1e-9))


def single_template(template: SpotTemplate, index: int, shape: tuple[int, int]) -> SpotTemplate:
    """Return one of the shapes of a template, for images of another size.

    Parameters
    ----------
    template : SpotTemplate
        Template of T shapes.
    index : int
        Index of the shape.
    shape : tuple of int
        Rows and columns (H, W) of the images.
    """
    selected = slice(index, index + 1)
    rows, columns = template.row_factors[selected], template.column_factors[selected]
    return replace(template, row_factors=rows, column_factors=columns, centre=template.centre[selected], shape=shape)


@contextmanager
def _spot_errors() -> Iterator[None]:
    """Turn errors of the template and of the linear algebra into a SpotError with its reason."""
    try:
        yield
    except TemplateRangeError as error:
        raise SpotError({0: "the fit left the range of the template; calibrate it with a larger margin"}) from error
    except np.linalg.LinAlgError as error:
        raise SpotError({0: "too few good pixels are left to fit the spot"}) from error


@_spot_errors()
def fit_screened(
    mean: Array,
    counts: Array,
    good: Mask,
    noise: NoiseModel,
    template: SpotTemplate,
    terms: FitTerms | None = None,
    near: ScreenedFit | None = None,
    jitter: Array | None = None,
    recorded: int | None = None,
) -> ScreenedFit:
    """Fit one spot, with further terms, to a mean image with missing pixels.

    Dimensions: H rows, W columns.

    Parameters
    ----------
    mean : (H, W) ndarray
        Mean image, DN (grey values).
    counts : (H, W) ndarray
        Number of frames averaged in each pixel.
    good : (H, W) ndarray of bool
        Usable pixels.
    noise : NoiseModel
        Noise of the detector.
    template : SpotTemplate
        Template with the spot's one shape.
    terms : FitTerms or None
        Further terms of the fit; None if there is none.
    near : ScreenedFit or None
        Fit to start from; None to search for the brightest spot.
    jitter : (2, 2) ndarray or None
        Covariance of the position over the frames, px^2; its contribution to the mean is included in the covariance.
    recorded : int or None
        Number of recorded frames, the reference of `cost`; None for the largest number of frames in a pixel.

    Raises
    ------
    SpotError
        There is no spot, or it cannot be fitted.
    """
    terms = FitTerms() if terms is None else terms
    model = _Model(template, terms, mean.shape[0], mean.shape[1])
    theta = _start(mean, counts, good, noise, model) if near is None else model.started_from(near)
    spot_image.check_edge(theta[None, :2], *template.shape, EDGE_PX)
    flat, use, many = mean.ravel(), good.ravel(), counts.ravel()
    if near is not None and terms.learnt:
        theta = model.signed(theta, flat, use, len(near.others))
    for _ in range(_MOST_STEPS):
        design, level = model.design(theta)
        weight = use / _variance(level, many, noise)
        weighted = design * weight
        normal = weighted @ design.T
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        inverse = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
        step = inverse @ (weighted @ (flat - level))
        before, theta = theta, model.moved(theta, step)
        spot_image.check_edge(theta[None, :2], *template.shape, 2.0)
        rests = model.rests(theta - before, inverse)
        if rests:
            break
    design, level = model.design(theta)
    spot_image.check_edge(theta[None, :2], *template.shape, EDGE_PX)
    if not np.all(np.diag(inverse) > 0.0):
        raise np.linalg.LinAlgError("fewer pixels than unknowns")
    weak = theta[2] < _FLUX_SIGMAS * np.sqrt(inverse[2, 2])
    spot_image.reject(np.array([weak]), f"no spot: the flux is not significant (below {_FLUX_SIGMAS:g} sigma)")
    influence = inverse[:2] @ weighted
    temporal_variance = noise.temporal_variance_dn2(level, 1) / many
    temporal = (influence * temporal_variance) @ influence.T
    fixed = (influence * noise.fixed_variance_dn2(level)) @ influence.T
    moved = np.zeros((2, 2)) if jitter is None else jitter / float(np.median(many))
    frames = float(many.max()) if recorded is None else float(recorded)
    square = np.square(flat - level) * weight
    used = int(np.count_nonzero(use))
    shape = mean.shape
    core = use & (design[2] > CORE_SHARE * design[2].max())
    fits_of_others = [model.other(theta, inverse, k) for k in range(len(terms.others))]
    positions = SpotPositions(
        row=theta[0:1],
        column=theta[1:2],
        temporal_covariance=(temporal + moved)[None],
        fixed_covariance=fixed[None],
        flux=theta[2:3],
        background=theta[3:4],
        converged=np.array([rests]),
        iterations=0,
        reduced_chi_square=np.array([square.sum() / max(used - len(theta), 1)]),
        gain_maps=influence.reshape(1, 2, *shape),
        light_dn=noise.light_signal_dn(level).reshape(1, *shape),
    )
    return ScreenedFit(
        positions=positions,
        terms=terms,
        others=np.array([position for position, _ in fits_of_others]).reshape(-1, 3),
        others_sigma=np.array([sigma for _, sigma in fits_of_others]).reshape(-1, 3),
        smear=model.smear_of(theta),
        level=level.reshape(shape),
        variance=_variance(level, many, noise).reshape(shape),
        used=good,
        core=(float(square[core].mean()) if np.any(core) else 0.0, int(np.count_nonzero(core))),
        cost=_cost(design[:4], level, frames, noise, temporal + moved + fixed),
        missing=_cost(design[:4], level, frames, noise, temporal + fixed),
        theta=theta,
        inverse=inverse,
    )


def model_parts(fit: ScreenedFit, template: SpotTemplate) -> tuple[Array, Array, Array]:
    """Return the derivatives of a fitted image, its part that is not the spot, and the derivatives of that part.

    The arrays are the derivatives (K, P) of all pixels with respect to all parameters; the part (P,), DN, that is
    neither the spot nor the level of the background; and the derivatives (K, P) of that part.

    Dimensions: K fitted parameters, P pixels.

    Parameters
    ----------
    fit : ScreenedFit
        Fit of a spot.
    template : SpotTemplate
        Template with the spot's one shape.
    """
    model = _Model(template, fit.terms, *fit.level.shape)
    design, _ = model.design(fit.theta)
    alone = fit.theta.copy()
    alone[2:4] = 0.0
    beside, extra = model.design(alone)
    beside[:4] = 0.0
    return design, extra, beside


def _variance(level: Array, counts: Array, noise: NoiseModel) -> Array:
    return np.asarray(noise.temporal_variance_dn2(level, 1) / counts + noise.fixed_variance_dn2(level))


def _cost(design: Array, level: Array, frames: float, noise: NoiseModel, covariance: Array) -> float:
    """Return the relative increase of the position's sigma over that from an image without defects."""
    weighted = design / _variance(level, np.full_like(level, frames), noise)
    ideal = np.linalg.inv(weighted @ design.T)[:2, :2]
    return float(np.sqrt(np.trace(covariance) / np.trace(ideal)) - 1.0)


def _start(mean: Array, counts: Array, good: Mask, noise: NoiseModel, model: _Model) -> Array:
    """Return start parameters: position of the brightest spot, then flux and level, in which the model is linear."""
    filled = spot_image.filled(mean, good)
    frames = max(int(np.median(counts)), 1)
    # saturated pixels have been excluded
    whole = replace(noise, saturation_dn=1e300)
    row, column, background, _, _ = spot_image.coarse(filled[None], frames, whole)
    flux = max(float((filled - background[0]).sum()), 1.0)
    return model.first((float(row[0]), float(column[0])), flux, float(background[0]))


@dataclass(frozen=True, eq=False)
class _Model:
    """Model of an image of a spot, further spots, smear and uneven background, as a function of its parameters.

    The parameters are row, column, flux, level; slopes and curvature of the background; row, column and flux of each
    further spot; second moments of the smear, px^2: along rows twice, along rows and columns, along columns twice.
    """

    template: SpotTemplate
    terms: FitTerms
    height: int
    width: int

    @property
    def _slopes(self) -> int:
        return (0, 2, 5)[self.terms.background]

    @property
    def _others(self) -> int:
        """Index, among all parameters, of the first parameter of the further spots."""
        return 4 + self._slopes

    @property
    def _smear(self) -> int:
        return self._others + 3 * len(self.terms.others)

    def first(self, position: tuple[float, float], flux: float, level: float) -> Array:
        theta = np.zeros(self._smear + 3 * self.terms.smear)
        theta[:4] = *position, flux, level
        for k, (row, column) in enumerate(self.terms.others):
            theta[self._others + 3 * k : self._others + 3 * k + 3] = row, column, 0.01 * flux
        return theta

    def started_from(self, near: ScreenedFit) -> Array:
        """Return start parameters from an earlier fit; terms that it lacks start at their default values."""
        p = near.positions
        theta = self.first((float(p.row[0]), float(p.column[0])), float(p.flux[0]), float(p.background[0]))
        for k, (row, column, share) in enumerate(near.others[: len(self.terms.others)]):
            theta[self._others + 3 * k : self._others + 3 * k + 3] = row, column, share * theta[2]
        if self.terms.smear:
            theta[self._smear :] = near.smear[0, 0], near.smear[0, 1], near.smear[1, 1]
        return theta

    def signed(self, theta: Array, flat: Array, use: Mask, known: int) -> Array:
        """Return the parameters with start values for the light of newly added further spots, positive or negative.

        All further spots but the first ``known`` are new.
        """
        for light in range(self._others + 3 * known + 2, self._smear, 3):
            theta[light] = 0.0
            design, level = self.design(theta)
            shape = design[light] * use
            theta[light] = shape @ (flat - level) / max(float(shape @ shape), 1e-300)
            if theta[light] == 0.0:
                theta[light] = 0.01 * theta[2]
        return theta

    def moved(self, theta: Array, step: Array) -> Array:
        """Return the next parameters: no position moves by more than a pixel, and the spot's flux stays positive."""
        length = max(float(np.abs(step[self._position_indices]).max()), 1e-300)
        short = min(1.0, 1.0 / length)
        if step[2] < -0.9 * theta[2]:
            short = min(short, -0.9 * theta[2] / step[2])
        out = theta + short * step
        if self.terms.smear:
            # not more than the shape itself in one step
            change = np.clip(step[self._smear :], -2.0, 2.0)
            out[self._smear :] = np.clip(theta[self._smear :] + short * change, -_MOST_SMEAR, _MOST_SMEAR)
        # further spots stay within the range of the template
        for k in range(len(self.terms.others)):
            for axis, (low, high) in enumerate(self.template.supported()):
                index = self._others + 3 * k + axis
                out[index] = min(max(out[index], low + 1.0), high - 1.0)
        return out

    @cached_property
    def _position_indices(self) -> list[int]:
        """Indices of the parameters that are positions: the spot's, then the further spots'."""
        return [0, 1, *(self._others + 3 * k + axis for k in range(len(self.terms.others)) for axis in (0, 1))]

    def rests(self, change: Array, inverse: Array) -> bool:
        """Return True if the last iteration step has changed all positions by less than their tolerance."""
        others = self._position_indices[2:]
        sigma = np.sqrt(np.maximum(np.diag(inverse)[others], 0.0))
        return bool(
            np.all(np.abs(change[:2]) < _REST_PX)
            and np.all(np.abs(change[others]) < np.maximum(_REST_SIGMAS * sigma, _REST_PX))
        )

    def _spread(self, theta: Array) -> Array:
        """Return the smear of the shape, (2, 2) px^2: its positive part, unless the shape may be sharpened."""
        rows, across, columns = theta[self._smear :]
        if self.terms.learnt:
            return np.array([[rows, across], [across, columns]])
        value, vector = np.linalg.eigh(np.array([[rows, across], [across, columns]]))
        return np.asarray((vector * np.maximum(value, 0.0)) @ vector.T)

    def _spots(self, theta: Array) -> list[tuple[int, int, int]]:
        """Return the indices of the parameters row, column and flux of every spot."""
        first = [0, *(self._others + 3 * k for k in range(len(self.terms.others)))]
        return [(k, k + 1, k + 2) for k in first]

    @cached_property
    def _bends(self) -> Array:
        """Slopes and curvature terms of the background at every pixel, (5, P).

        Dimensions: P pixels.
        """
        v, u = np.meshgrid(np.linspace(-1, 1, self.height), np.linspace(-1, 1, self.width), indexing="ij")
        return np.stack([v, u, v * v - 1.0 / 3.0, u * v, u * u - 1.0 / 3.0]).reshape(5, -1)

    @cached_property
    def _shape(self) -> SmearedShape:
        return SmearedShape(self.template)

    def design(self, theta: Array) -> tuple[Array, Array]:
        """Return the derivatives of the image with respect to the parameters, (K, P), and the image itself, (P,) DN.

        Dimensions: K fitted parameters, P pixels.
        """
        pixels = self.height * self.width
        design = np.zeros((len(theta), pixels))
        level = np.full(pixels, theta[3])
        design[3] = 1.0
        if self._slopes:
            bends = slice(4, 4 + self._slopes)
            design[bends] = self._bends[: self._slopes]
            level += theta[bends] @ design[bends]
        smears = self.terms.smear
        spread = self._spread(theta) if smears else None
        coefficients = None if spread is None else self._shape.smeared(spread)
        for row, column, flux in self._spots(theta):
            if coefficients is None:
                shape = np.stack(self.template.evaluate(theta[row], theta[column])).reshape(3, pixels)
            else:
                shape = self._shape.evaluate(coefficients, theta[row], theta[column]).reshape(6, pixels)
                # a smear changes a shape by half its second derivatives
                design[self._smear :] += theta[flux] * np.array([[0.5], [1.0], [0.5]]) * shape[3:]
            design[flux] = shape[0]
            design[row], design[column] = theta[flux] * shape[1], theta[flux] * shape[2]
            level += theta[flux] * shape[0]
        if spread is not None:
            # the negative part of the smear enters to first order: noise may make a moment negative
            rest = theta[self._smear :] - (spread[0, 0], spread[0, 1], spread[1, 1])
            level += rest @ design[self._smear :]
        return design, level

    def other(self, theta: Array, inverse: Array, k: int) -> tuple[Array, Array]:
        """Return row, column and relative light of a further spot, and their standard deviations."""
        indices = slice(self._others + 3 * k, self._others + 3 * k + 3)
        scale = np.array([1.0, 1.0, 1.0 / theta[2]])
        return theta[indices] * scale, np.sqrt(np.diag(inverse)[indices]) * scale

    def smear_of(self, theta: Array) -> Array:
        """Return the fitted second moments of the smear along rows and columns, (2, 2) px^2."""
        if not self.terms.smear:
            return np.zeros((2, 2))
        a = theta[self._smear :]
        return np.array([[a[0], a[1]], [a[1], a[2]]])
