"""Fit of the calibrated shape to a mean image of which pixels may be missing, beside what else is in the light: an
uneven background, further spots (reflections), and smear by vibration.

Pixels that are not good have no weight; one that is the mean of fewer frames has more noise. The model is

    background + slopes + sum over spots of flux x (shape convolved with a normal distribution)

fitted by Fisher scoring as `likelihood` does, whose result it is for a clean image. All parameters are fitted together,
so that what is not known of the others stands in the covariance of the place. Reflections have the shape of the spot:
they are seen by the same optics; interference with it is not modelled.

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
from analysis.spots.spot_positions import SpotError, SpotPositions
from analysis.spots.spot_template import SmearedShape, SpotTemplate, TemplateRangeError

_REST_PX, _MOST_STEPS = 1e-6, 60
_REST_SIGMAS = 1e-4
"""Largest last step of other spots, in sigmas. They may be so faint that their positions are uncertain by part of a
pixel.
"""
_FLUX_SIGMAS = 5.0
_MOST_SMEAR = 25.0
"""Px^2; a spot that is smeared by more is another one."""
CORE_SHARE = 0.02
"""Share of the peak above which the shape of the spot is judged."""


@dataclass(frozen=True)
class FitTerms:
    """What is fitted beside place, flux and level.

    Attributes
    ----------
    background : int
        0 for an even background, 1 with slopes, 2 with curvature.
    others : tuple[tuple[float, float], ...]
        (row, column) where further spots are looked for, px.
    smear : bool
        Whether the shape is convolved with a normal distribution.
    learnt : bool
        Whether the shape was learnt from frames of the spot, and may have been smeared more itself: a smear that is
        negative makes the shape sharper. Else the shape is the sharpest, and what is negative is noise.
    """

    background: int = 0
    others: tuple[tuple[float, float], ...] = ()
    smear: bool = False
    learnt: bool = False


@dataclass(frozen=True, eq=False)
class ScreenedFit:
    """A spot and what was fitted beside it.

    Attributes
    ----------
    positions : SpotPositions
        Of the one spot.
    terms : FitTerms
        That were fitted.
    others : Array
        (G, 3) row, column (px) and flux over that of the spot.
    others_sigma : Array
        (G, 3) their standard deviations.
    smear : Array
        (2, 2) px^2, second moments of the smear; zeros where none was fitted.
    level : Array
        (H, W) DN, the fitted image.
    variance : Array
        (H, W) DN^2 of the mean, also where a pixel is not used.
    used : Mask
        (H, W) pixels.
    core : tuple[float, int]
        Reduced chi-square of the pixels in the spot's core, and their number.
    cost : float
        Sigma of the place over what it would be if nothing were missing, nothing else were fitted and the spot stood
        still, minus 1.
    missing : float
        The same without what movement between frames does.
    theta : Array
        (K,) all parameters: row, column, flux, level, then those of what else is fitted; px, DN, px^2.
    inverse : Array
        (K, K) inverse of their information.
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
        """(H, W) what the image has more than the model, in standard deviations; 0 where a pixel is not used.

        Parameters
        ----------
        mean : Array
            The image, (H, W) DN.
        """
        return np.asarray(np.where(self.used, (mean - self.level) / np.sqrt(self.variance), 0.0))

    def explains(self, mean: Array) -> float:
        """Chi-square of the image.

        Parameters
        ----------
        mean : Array
            The image, (H, W) DN.
        """
        return float(np.square(self.residual(mean)).sum())

    def core_fits(self, learnt_from: ScreenedFit | None = None, noisier: float = 1.0) -> bool:
        """Whether the core has the calibrated shape, at a false-alarm rate of 1e-6.

        Parameters
        ----------
        learnt_from : ScreenedFit | None
            The fit to the image that the shape was learnt from, whose noise is in the shape, too; None for a shape
            without noise.
        noisier : float
            By which factor the noise of the frames makes the variance in the core more than stated.
        """
        return self.core_widening(learnt_from, noisier) == 1.0

    def core_widening(self, learnt_from: ScreenedFit | None = None, noisier: float = 1.0) -> float:
        """Factor of sigma: 1 where the core has the calibrated shape, else the root of its reduced chi-square (as
        `analysis.spots.likelihood.FitStates.widening`).

        Parameters
        ----------
        learnt_from : ScreenedFit | None
            As of `core_fits`.
        noisier : float
            likewise.
        """
        value, count = self.core
        spread = 1.0
        if learnt_from is not None:
            # at the peak, where the noise is that of the light
            first, own = (float(one.variance.flat[int(np.argmax(one.level))]) for one in (learnt_from, self))
            spread += first / own * float(self.positions.flux[0] / learnt_from.positions.flux[0]) ** 2
        if value / (noisier * spread) * count <= chi2.isf(1e-6, max(count - 4, 1)):
            return 1.0
        return float(max(np.sqrt(value / (noisier * spread)), 1.0 + 1e-9))


def one_shape(template: SpotTemplate, index: int, shape: tuple[int, int]) -> SpotTemplate:
    """One of the shapes of a template, for images of another size.

    Parameters
    ----------
    template : SpotTemplate
        T shapes.
    index : int
        which.
    shape : tuple[int, int]
        (H, W) of the images.
    """
    own = slice(index, index + 1)
    rows, columns = template.row_factors[own], template.column_factors[own]
    return replace(template, row_factors=rows, column_factors=columns, centre=template.centre[own], shape=shape)


@contextmanager
def _errors_of_the_spot() -> Iterator[None]:
    """Say of the spot why it cannot be fitted."""
    try:
        yield
    except TemplateRangeError as error:
        raise SpotError({0: "the fit left the range of the template; calibrate it with a larger margin"}) from error
    except np.linalg.LinAlgError as error:
        raise SpotError({0: "too few good pixels are left to fit the spot"}) from error


@_errors_of_the_spot()
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
    """Fit one spot.

    Parameters
    ----------
    mean : Array
        (H, W) DN.
    counts : Array
        (H, W) frames that each pixel is the mean of.
    good : Mask
        (H, W) pixels that are used.
    noise : NoiseModel
        Of the detector.
    template : SpotTemplate
        The spot's one shape.
    terms : FitTerms | None
        What else is fitted; None for nothing.
    near : ScreenedFit | None
        a fit to begin at; None to look for the brightest spot.
    jitter : Array | None
        (2, 2) px^2, covariance of the place over the frames; its share in the mean is added to sigma.
    recorded : int | None
        Frames that there are, against which the cost is counted; None for the most that a pixel has.

    Raises
    ------
    SpotError
        No spot, or it cannot be fitted.
    """
    terms = FitTerms() if terms is None else terms
    model = _Model(template, terms, mean.shape[0], mean.shape[1])
    theta = _start(mean, counts, good, noise, model) if near is None else model.begun(near)
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
    places = [model.other(theta, inverse, k) for k in range(len(terms.others))]
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
        others=np.array([place for place, _ in places]).reshape(-1, 3),
        others_sigma=np.array([sigma for _, sigma in places]).reshape(-1, 3),
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
    """Parts of the fitted image: its derivatives (K, P) by all parameters; the part (P,), DN, that is neither the spot
    nor its level; and the derivatives (K, P) of that part.

    Parameters
    ----------
    fit : ScreenedFit
        Of a spot.
    template : SpotTemplate
        The spot's one shape.
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
    """Sigma of the place over that of an image with nothing missing and nothing else in it, minus 1."""
    weighted = design / _variance(level, np.full_like(level, frames), noise)
    ideal = np.linalg.inv(weighted @ design.T)[:2, :2]
    return float(np.sqrt(np.trace(covariance) / np.trace(ideal)) - 1.0)


def _start(mean: Array, counts: Array, good: Mask, noise: NoiseModel, model: _Model) -> Array:
    """Place of the brightest spot, then flux and level, in which the model is linear."""
    filled = spot_image.filled(mean, good)
    frames = max(int(np.median(counts)), 1)
    # what is saturated has been left out
    whole = replace(noise, saturation_dn=1e300)
    row, column, background, _, _ = spot_image.coarse(filled[None], frames, whole)
    flux = max(float((filled - background[0]).sum()), 1.0)
    return model.first((float(row[0]), float(column[0])), flux, float(background[0]))


@dataclass(frozen=True, eq=False)
class _Model:
    """Parameters: row, column, flux, level; slopes and curvature of the background; row, column and flux of each other
    spot; second moments of the smear (rows, across, columns).
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
        """Where the other spots begin."""
        return 4 + self._slopes

    @property
    def _smear(self) -> int:
        return self._others + 3 * len(self.terms.others)

    def first(self, place: tuple[float, float], flux: float, level: float) -> Array:
        theta = np.zeros(self._smear + 3 * self.terms.smear)
        theta[:4] = *place, flux, level
        for k, (row, column) in enumerate(self.terms.others):
            theta[self._others + 3 * k : self._others + 3 * k + 3] = row, column, 0.01 * flux
        return theta

    def begun(self, near: ScreenedFit) -> Array:
        """Where another fit has ended; what it had not is begun anew."""
        p = near.positions
        theta = self.first((float(p.row[0]), float(p.column[0])), float(p.flux[0]), float(p.background[0]))
        for k, (row, column, share) in enumerate(near.others[: len(self.terms.others)]):
            theta[self._others + 3 * k : self._others + 3 * k + 3] = row, column, share * theta[2]
        if self.terms.smear:
            theta[self._smear :] = near.smear[0, 0], near.smear[0, 1], near.smear[1, 1]
        return theta

    def signed(self, theta: Array, flat: Array, use: Mask, known: int) -> Array:
        """With the light of other spots after the first ``known`` as it is in the image, where it may be missing."""
        for light in range(self._others + 3 * known + 2, self._smear, 3):
            theta[light] = 0.0
            design, level = self.design(theta)
            shape = design[light] * use
            theta[light] = shape @ (flat - level) / max(float(shape @ shape), 1e-300)
            if theta[light] == 0.0:
                theta[light] = 0.01 * theta[2]
        return theta

    def moved(self, theta: Array, step: Array) -> Array:
        """The next parameters: no place by more than a pixel, and the spot's flux stays positive."""
        length = max(float(np.abs(step[self._places]).max()), 1e-300)
        short = min(1.0, 1.0 / length)
        if step[2] < -0.9 * theta[2]:
            short = min(short, -0.9 * theta[2] / step[2])
        out = theta + short * step
        if self.terms.smear:
            # not more than the shape itself in one step
            change = np.clip(step[self._smear :], -2.0, 2.0)
            out[self._smear :] = np.clip(theta[self._smear :] + short * change, -_MOST_SMEAR, _MOST_SMEAR)
        # another spot stays where the shape is known
        for k in range(len(self.terms.others)):
            for axis, (low, high) in enumerate(self.template.supported()):
                at = self._others + 3 * k + axis
                out[at] = min(max(out[at], low + 1.0), high - 1.0)
        return out

    @cached_property
    def _places(self) -> list[int]:
        """Numbers of the parameters that are places: the spot's, then the others'."""
        return [0, 1, *(self._others + 3 * k + axis for k in range(len(self.terms.others)) for axis in (0, 1))]

    def rests(self, change: Array, inverse: Array) -> bool:
        """Whether places have changed by nothing that matters."""
        others = self._places[2:]
        sigma = np.sqrt(np.maximum(np.diag(inverse)[others], 0.0))
        return bool(
            np.all(np.abs(change[:2]) < _REST_PX)
            and np.all(np.abs(change[others]) < np.maximum(_REST_SIGMAS * sigma, _REST_PX))
        )

    def _spread(self, theta: Array) -> Array:
        """Smear that the shape is convolved with, (2, 2) px^2: the positive part, unless the shape may be sharper."""
        rows, across, columns = theta[self._smear :]
        if self.terms.learnt:
            return np.array([[rows, across], [across, columns]])
        value, vector = np.linalg.eigh(np.array([[rows, across], [across, columns]]))
        return np.asarray((vector * np.maximum(value, 0.0)) @ vector.T)

    def _spots(self, theta: Array) -> list[tuple[int, int, int]]:
        """Numbers of the parameters row, column and flux of every spot."""
        first = [0, *(self._others + 3 * k for k in range(len(self.terms.others)))]
        return [(k, k + 1, k + 2) for k in first]

    @cached_property
    def _bends(self) -> Array:
        """(5, P) slopes and curvature of the background."""
        v, u = np.meshgrid(np.linspace(-1, 1, self.height), np.linspace(-1, 1, self.width), indexing="ij")
        return np.stack([v, u, v * v - 1.0 / 3.0, u * v, u * u - 1.0 / 3.0]).reshape(5, -1)

    @cached_property
    def _shape(self) -> SmearedShape:
        return SmearedShape(self.template)

    def design(self, theta: Array) -> tuple[Array, Array]:
        """Derivatives (K, P) and level (P,)."""
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
            # the part that is no smear, by its first order: noise may make a moment negative
            rest = theta[self._smear :] - (spread[0, 0], spread[0, 1], spread[1, 1])
            level += rest @ design[self._smear :]
        return design, level

    def other(self, theta: Array, inverse: Array, k: int) -> tuple[Array, Array]:
        """Row, column and share of another spot's light, and their standard deviations."""
        own = slice(self._others + 3 * k, self._others + 3 * k + 3)
        scale = np.array([1.0, 1.0, 1.0 / theta[2]])
        return theta[own] * scale, np.sqrt(np.diag(inverse)[own]) * scale

    def smear_of(self, theta: Array) -> Array:
        """Second moments, (2, 2), px^2."""
        if not self.terms.smear:
            return np.zeros((2, 2))
        a = theta[self._smear :]
        return np.array([[a[0], a[1]], [a[1], a[2]]])
