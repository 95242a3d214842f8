"""Positions of a spot in a series of small windows, with a shape that is learnt from the series itself.

A star tracker or a metrology camera transmits windows of six or eight pixels about a spot that its pixels undersample.
The shape between the pixels is then not known from any calibration, and a single frame does not show it. The model of
pixel p in frame k at distance u from the spot is

    y = b_k + f_k (1 + s_p) [G(u) + g(u)] + d_p + n,

with a round Gaussian G averaged over the pixel, and normal priors for what differs from it: the shape g is a Gaussian
process (Matern 5/2) with an amplitude that falls with the distance, s_p and d_p are the detector's fixed pattern, and n
is its temporal noise at the level of the model. Amplitudes and lengths of the priors, and the read noise if it is not
specified, maximise the restricted likelihood of the pixels (Rasmussen and Williams, Gaussian Processes for Machine
Learning, 2006, sec. 5.4; Patterson and Thompson, Biometrika 58, 545 (1971)).

Positions, fluxes and backgrounds of all frames follow by generalised least squares, linearised about the shape of the
last iteration. This is the joint maximum of positions and shape, so that the covariance contains what the unknown
shape adds: little for the difference of two frames in which the spot has the same phase on the pixels. The mean
position is by definition that of the Gaussian that fits all frames best; the covariance is that of positions relative
to it.

Pixel coordinates: (row, column), the centre of the first pixel is (0, 0).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, optimize
from scipy.special import erf

from analysis.arrays import Array
from analysis.spots.noise import NoiseModel
from analysis.spots.spot_image import SpotError
from optics.numerics.number_tree import FrozenMap

LEAST_FRAMES, LEAST_SIDE = 3, 5
"""Smallest number of frames and smallest side of a window, px, from which positions and a shape can be learnt."""
MOST_PIXELS = 4000
"""Largest number of pixels of all frames: the matrices of the fit have its square of elements."""
_SETTLED = 0.01
"""Largest move in the last round, in standard deviations of the best position."""
_MOST_ROUNDS = 60
"""Largest number of rounds of the iteration over positions and shape."""
_DAMPING = 0.7
"""Fraction of a step that is taken: positions and shape answer each other, and full steps overshoot."""
_RELEARN = (3, 6)
"""Rounds of the iteration in which the priors are learnt anew."""
_LEARNT_FRAMES = 6
"""Number of frames, evenly spaced, from which the priors are learnt: time grows with its cube."""
_STEP = 1e-4
"""Relative step of the numerical derivatives of the likelihood by the lengths of the prior."""
_MOST_STEPS = 40
"""Largest number of iterations in which the likelihood of the priors is maximised."""
CAUSES = ("temporal noise", "shape", "response pattern", "dark pattern")
"""Causes of the covariance, keys of `WindowSeries.parts`."""


@dataclass(frozen=True)
class SeriesPrior:
    """Standard deviations and lengths of what a spot's pixels may add to a Gaussian.

    Attributes
    ----------
    shape : float
        Standard deviation of the shape about the Gaussian at the centre, as a fraction of its peak.
    length : float
        Correlation length of the shape, px.
    extent : float
        Distance by which the standard deviation falls to exp(-1/2) of it, px.
    prnu : float
        Fixed pattern of the response, rms fraction.
    dark_dn : float
        Fixed pattern of the dark level, rms, DN.
    gain_dn_per_e : float
        Grey values per electron: variance of the shot noise divided by the level.
    read_dn : float
        Temporal noise that does not depend on the light, rms, DN; it contains rounding to coarse steps.
    """

    shape: float = 0.05
    length: float = 1.0
    extent: float = 2.0
    prnu: float = 0.01
    dark_dn: float = 1.0
    gain_dn_per_e: float = 1.0
    read_dn: float = 1.0


_LIMITS = SeriesPrior(1e-4, 0.3, 0.7, 1e-4, 1e-2, 1e-4, 1e-2), SeriesPrior(10.0, 10.0, 20.0, 0.2, 1e3, 1e4, 1e4)
"""Smallest and largest value of each number of a learnt prior."""


@dataclass(frozen=True, eq=False)
class WindowSeries:
    """Positions of one spot in a series of frames, with their joint covariance.

    Dimensions: N frames, H rows, W columns.

    Attributes
    ----------
    position : (N, 2) ndarray
        Row and column in detector pixels.
    covariance : (2 N, 2 N) ndarray
        Joint covariance, in the order row, column of frame 0, row, column of frame 1, ..., px^2.
    parts : mapping of str to (2 N, 2 N) ndarray
        Joint covariance by cause: temporal noise, shape, response pattern, dark pattern.
    flux, background : (N,) ndarray
        Light of the spot and level below it, DN.
    residual : (N, H, W) ndarray
        Residuals after fit of shape and pattern, in standard deviations of the temporal noise; NaN in unused pixels.
    reduced_chi_square : float
        Squared residuals over the temporal noise, per degree of freedom that shape, pattern and positions leave.
    prior : SeriesPrior
        Learnt or specified standard deviations and lengths.
    width : float
        Standard deviation of the Gaussian, px.
    """

    position: Array
    covariance: Array
    parts: Mapping[str, Array]
    flux: Array
    background: Array
    residual: Array
    reduced_chi_square: float
    prior: SeriesPrior
    width: float

    @property
    def sigma(self) -> Array:
        """Standard deviations of row and column in each frame, (N, 2) px."""
        return np.sqrt(np.diagonal(self.covariance)).reshape(-1, 2)

    def scatter(self, design: ArrayLike, cause: str | None = None) -> tuple[float, int, Array]:
        """Return chi-square and degrees of freedom of the positions about a motion, and their residuals.

        Parameters
        ----------
        design : (N, P) array_like
            Motion as functions of time, the same for rows and columns: ones and times for a uniform motion.
        cause : str or None
            Cause whose covariance alone is expected; None for all.

        Returns
        -------
        chi_square : float
            Weighted sum of squared residuals.
        degrees : int
            Its degrees of freedom.
        residual : (N, 2) ndarray
            Positions minus fitted motion, px.
        """
        basis = np.kron(np.asarray(design, np.float64), np.eye(2))
        covariance = self.covariance if cause is None else self.parts[cause]
        # the mean position has no part in it: a motion contains a constant
        chi, degrees, residual = chi_square_about(basis, self.position.ravel(), covariance)
        return chi, degrees, residual.reshape(-1, 2)


def chi_square_about(design: ArrayLike, values: Array, covariance: Array) -> tuple[float, int, Array]:
    """Return chi-square, degrees of freedom and residuals (n,) of values about a linear model with P free unknowns.

    The unknowns are eliminated by a projection onto the null space of the design; the covariance must be regular only
    there. The residuals are those of equal weights.

    Parameters
    ----------
    design : (n, P) array_like
        Derivatives of the values with respect to the unknowns.
    values : (n,) ndarray
        Measured values.
    covariance : (n, n) ndarray
        Their covariance.
    """
    null = linalg.null_space(np.asarray(design).T)
    contrast = null.T @ values
    chi = float(contrast @ np.linalg.solve(null.T @ covariance @ null, contrast))
    return chi, null.shape[1], null @ contrast


@dataclass(frozen=True, eq=False)
class _Pixels:
    """Used pixels of all frames in one list, with the black level ``offset``.

    ``value`` and ``level`` (P,) are measured and modelled grey values, ``frame`` (P,) is the index of the frame,
    ``coordinates`` (P, 2) are row and column on the detector, and ``same`` (P, P) is 1 for the same detector pixel.
    """

    value: Array
    level: Array
    frame: NDArray[np.intp]
    coordinates: Array
    same: Array
    offset: float

    @classmethod
    def of(cls, images: Array, used: NDArray[np.bool_], corners: NDArray[np.intp], offset: float) -> _Pixels:
        frame, row, column = np.nonzero(used)
        coordinates = np.stack([row, column], axis=1) + corners[frame]
        same = np.all(coordinates[:, None] == coordinates[None], axis=2).astype(np.float64)
        return cls(images[used], images[used], frame, coordinates.astype(np.float64), same, offset)


@dataclass(frozen=True, eq=False)
class _State:
    """Linearisation point: positions (N, 2), fluxes and backgrounds (N,), and the width of the Gaussian."""

    position: Array
    flux: Array
    background: Array
    width: float

    def away(self, pixels: _Pixels) -> Array:
        return pixels.coordinates - self.position[pixels.frame]

    def gaussian(self, pixels: _Pixels) -> tuple[Array, Array]:
        """Return the Gaussian averaged over each pixel (P,) and its derivatives by the position of the spot (P, 2)."""
        away, root = self.away(pixels), np.sqrt(2.0) * self.width
        share = 0.5 * (erf((away + 0.5) / root) - erf((away - 0.5) / root))
        bell = [np.exp(-(((away + half) / root) ** 2)) / (np.sqrt(np.pi) * root) for half in (0.5, -0.5)]
        slope = (bell[1] - bell[0]) * share[:, ::-1]
        return share[:, 0] * share[:, 1], slope


def _shape_covariance(state: _State, pixels: _Pixels, prior: SeriesPrior) -> tuple[Array, Array]:
    """Return the prior covariance of the shape between pixels (P, P), and of its slopes with it (2, P, P)."""
    away = state.away(pixels)
    peak = 1.0 / (2.0 * np.pi * state.width**2)
    envelope = np.exp(-0.5 * np.sum(away**2, axis=1) / prior.extent**2) * prior.shape * peak
    apart = away[:, None] - away[None]
    t = np.sqrt(5.0) * np.linalg.norm(apart, axis=2) / prior.length
    decay = np.exp(-t) * envelope[:, None] * envelope[None]
    matern = (1.0 + t + t**2 / 3.0) * decay
    # derivative of the shape by the position of the spot, minus the one by the distance
    core = (1.0 + t) * decay * (5.0 / 3.0 / prior.length**2)
    slopes = np.stack([core * apart[..., k] + matern * (away[:, None, k] / prior.extent**2) for k in (0, 1)])
    return matern, slopes


def _terms(state: _State, pixels: _Pixels, prior: SeriesPrior) -> dict[str, Array]:
    """Return the covariances of the pixels (P, P) by cause; that of temporal noise is diagonal."""
    flux = state.flux[pixels.frame]
    light = np.maximum(pixels.level - state.background[pixels.frame], 0.0)
    shape = _shape_covariance(state, pixels, prior)[0] * flux[:, None] * flux[None]
    noise = np.diag(prior.gain_dn_per_e * np.maximum(pixels.level - pixels.offset, 0.0) + prior.read_dn**2)
    return dict(
        zip(
            CAUSES,
            (noise, shape, prior.prnu**2 * light[:, None] * light[None] * pixels.same, prior.dark_dn**2 * pixels.same),
            strict=True,
        )
    )


def fit_window_series(
    images: ArrayLike,
    noise: NoiseModel | None = None,
    *,
    corners: ArrayLike | None = None,
    used: ArrayLike | None = None,
    prior: SeriesPrior | None = None,
) -> WindowSeries:
    """Fit the positions of one spot in a series of small windows, with a shape learnt from all of them.

    Dimensions: N frames, H rows, W columns.

    Parameters
    ----------
    images : (N, H, W) array_like
        Grey values as recorded, at least 3 frames of 5 x 5 px, 4000 pixels in all.
    noise : NoiseModel, optional
        Gain, read noise and black level of the detector; gain and read noise are learnt by default. The fixed pattern
        is always learnt.
    corners : (N, 2) array_like of int, optional
        Row and column of each window's first pixel on the detector; the default is (0, 0).
    used : (H, W) or (N, H, W) array_like of bool, optional
        Pixels that carry data; the default is all.
    prior : SeriesPrior, optional
        Amplitudes and lengths of shape, pattern and noise, if they are known; they are learnt by default.

    Returns
    -------
    WindowSeries
        Positions with joint covariance, by cause, residuals, and the learnt prior.

    Raises
    ------
    ValueError
        Arrays of other shapes or values that are not finite, or too few or too many pixels.
    SpotError
        There is no spot, it is saturated, or the fit does not converge.

    Notes
    -----
    The mean position is that of a Gaussian and depends on the shape; the covariance is that of the differences of
    frames, which `WindowSeries.scatter` tests.

    Examples
    --------
    A spot of 0.6 px drifts by 0.04 px from frame to frame:

    >>> import numpy as np
    >>> import analysis
    >>> from scipy.special import erf
    >>> rng, row = np.random.default_rng(1), np.arange(8)[:, None] - np.arange(10) * 0.04 - 3.4
    >>> share = 0.5 * (erf((row + 0.5) / 0.6 / 2**0.5) - erf((row - 0.5) / 0.6 / 2**0.5)).T
    >>> images = rng.poisson(50.0 + 1e5 * share[:, :, None] * share[:, None, :])
    >>> fit = analysis.fit_window_series(images, analysis.NoiseModel())
    >>> drift = np.polyfit(np.arange(10), fit.position, 1)[0]
    >>> [round(float(value), 2) for value in drift]
    [0.04, 0.04]
    """
    pixels, state = _start(images, noise or NoiseModel(), corners, used)
    starts = _starts(pixels, state, noise)
    learnt = prior if prior is not None else starts[0]
    g, slopes = np.zeros(len(pixels.value)), np.zeros((2, len(pixels.value)))
    for iteration in range(_MOST_ROUNDS):
        design, residuals = _linearised(state, pixels, g, slopes)
        if prior is None and iteration in _RELEARN:
            few, few_pixels, use = _learning_frames(state, pixels)
            linearised = _linearised(few, few_pixels, g[use], slopes[:, use])
            learnt = _learn(few, few_pixels, *linearised, starts, noise is None)
            starts = (learnt,)
        terms = _terms(state, pixels, learnt)
        solver = _Solver(np.sum(list(terms.values()), axis=0), design)
        step = solver.estimator @ residuals
        weighted_residuals = solver.projector @ residuals
        g, slopes = _shape_of(state, pixels, learnt, weighted_residuals)
        state, moved = _moved(state, _contrasts(len(state.flux)) @ step)
        sigma = np.sqrt(np.diagonal(solver.covariance)[: 2 * len(state.flux) - 2].min())
        if moved < _SETTLED * sigma and (prior is not None or iteration > max(_RELEARN)):
            return _result(np.asarray(images, np.float64), pixels, state, learnt, terms, solver, weighted_residuals)
        pixels = replace(pixels, level=pixels.value - np.diagonal(terms[CAUSES[0]]) * weighted_residuals)
    raise SpotError(
        {0: "positions and shape do not converge; is there one spot in all windows, away from their edges?"}
    )


class _Solver:
    """Generalised least squares with one covariance: its inverse, the estimator, and the parameters' covariance."""

    def __init__(self, covariance: Array, design: Array) -> None:
        factor = linalg.cho_factor(covariance, lower=True)
        self.log_determinant = 2.0 * float(np.sum(np.log(np.diagonal(factor[0]))))
        self.inverse = linalg.cho_solve(factor, np.eye(len(covariance)))
        weighted = self.inverse @ design
        self.information = design.T @ weighted
        self.covariance = np.linalg.inv(self.information)
        self.estimator = self.covariance @ weighted.T
        self.projector = self.inverse - weighted @ self.estimator


def _start(
    images: ArrayLike, noise: NoiseModel, corners: ArrayLike | None, used: ArrayLike | None
) -> tuple[_Pixels, _State]:
    """Return the used pixels and a first state by moments of what exceeds the border.

    Raises
    ------
    ValueError
        The arguments do not fit each other.
    SpotError
        There is no spot, or it is saturated.
    """
    stack = np.asarray(images, np.float64)
    if stack.ndim != 3 or len(stack) < LEAST_FRAMES or min(stack.shape[1:]) < LEAST_SIDE:
        allowed = f"(N, H, W) of at least {LEAST_FRAMES} frames of {LEAST_SIDE} x {LEAST_SIDE} px"
        raise ValueError(f"window series: images must be {allowed}, found shape {stack.shape}")
    count, height, width = stack.shape
    mask = np.broadcast_to(np.ones((height, width), bool) if used is None else np.asarray(used, bool), stack.shape)
    corner = np.zeros((count, 2), np.intp) if corners is None else np.asarray(corners, np.intp)
    if corner.shape != (count, 2):
        raise ValueError(f"window series: corners must be ({count}, 2) row and column, found shape {corner.shape}")
    if not np.all(np.isfinite(stack[mask])) or not 0 < np.count_nonzero(mask) <= MOST_PIXELS:
        raise ValueError(f"window series: used pixels must be finite and at most {MOST_PIXELS} in all")
    if np.any(stack[mask] >= noise.saturation_dn):
        raise SpotError({0: f"saturated: pixels of {noise.saturation_dn:.0f} DN and more"})
    pixels = _Pixels.of(stack, mask, corner, noise.dark_level_dn)
    background = np.array([np.percentile(image[use], 20) for image, use in zip(stack, mask, strict=True)])
    light = np.where(mask, np.maximum(stack - background[:, None, None], 0.0), 0.0)
    light = np.where(light > 0.2 * light.max(axis=(1, 2), keepdims=True), light, 0.0)
    flux = light.sum(axis=(1, 2))
    spread = np.sqrt(noise.frame_variance_dn2(noise.dark_level_dn + light.max(axis=(1, 2))))
    if np.any(light.max(axis=(1, 2)) < 5.0 * spread):
        raise SpotError({0: "no spot: nothing exceeds five standard deviations of the noise in every frame"})
    rows, columns = np.arange(height), np.arange(width)
    position = np.stack([light.sum(axis=2) @ rows, light.sum(axis=1) @ columns], axis=1) / flux[:, None] + corner
    away = pixels.coordinates - position[pixels.frame]
    weight = light[mask]
    extent = float(np.sqrt(np.sum(weight * np.sum(away**2, axis=1)) / (2.0 * np.sum(weight))))
    first = _gaussian_start(pixels, _State(position, flux, background, max(extent, 0.3)))
    return replace(
        pixels, level=(first.flux[pixels.frame] * first.gaussian(pixels)[0] + first.background[pixels.frame])
    ), first


def _gaussian_start(pixels: _Pixels, state: _State) -> _State:
    """Return the state whose common centre and width, and fluxes and backgrounds, fit the pixels best."""
    count = len(state.flux)
    frame = np.eye(count)[pixels.frame]

    def tried(common: Array) -> tuple[_State, Array]:
        moved = replace(state, position=state.position + common[:2], width=float(np.exp(common[2])))
        bell = moved.gaussian(pixels)[0]
        design = np.concatenate([frame * bell[:, None], frame], axis=1)
        best = np.linalg.lstsq(design, pixels.value, rcond=None)[0]
        return replace(moved, flux=best[:count], background=best[count:]), pixels.value - design @ best

    start = np.array([0.0, 0.0, np.log(state.width)])
    bounds = start - np.array([1.5, 1.5, 2.0]), start + np.array([1.5, 1.5, 1.0])
    fit = optimize.least_squares(lambda common: tried(common)[1], start, bounds=bounds)
    best = tried(fit.x)[0]
    if np.any(best.flux <= 0.0):
        raise SpotError({0: "no spot: a frame has no light above its background"})
    return best


def _starts(pixels: _Pixels, state: _State, noise: NoiseModel | None) -> tuple[SeriesPrior, ...]:
    """Return the priors from which their learning starts: with much and with little pattern."""
    if noise is None:
        gain, read = _noise_of_differences(pixels)
    else:
        gain, read = noise.gain_dn_per_e, float(np.sqrt(noise.temporal_variance_dn2(noise.dark_level_dn, 1)))
    much = SeriesPrior(0.1, 1.0, 2.0 * state.width, 0.01, 10.0 * read, gain, read)
    return much, replace(much, shape=0.3, length=2.0, prnu=0.001, dark_dn=read)


def _noise_of_differences(pixels: _Pixels) -> tuple[float, float]:
    """Return gain, DN per electron, and read noise, DN, from second differences of each pixel over the frames.

    A motion of the spot enters them as well, so that they are upper limits.
    """
    level, square = [], []
    for frame in range(1, int(pixels.frame.max())):
        near = [dict(zip(map(tuple, pixels.coordinates[at]), pixels.value[at], strict=True))
                for at in (pixels.frame == frame + k for k in (-1, 0, 1))]  # fmt: skip
        for pixel in near[0].keys() & near[1].keys() & near[2].keys():
            a, b, c = (values[pixel] for values in near)
            level.append((a + b + c) / 3.0)
            square.append((a - 2.0 * b + c) ** 2 / 6.0)
    x, y = np.maximum(np.array(level) - pixels.offset, 0.0), np.array(square)
    bright = x > np.percentile(x, 50)
    read = max(float(np.mean(y[~bright])), 1e-2)
    return max(float((np.mean(y[bright]) - read) / np.mean(x[bright])), 1e-3), float(np.sqrt(read))


def _linearised(state: _State, pixels: _Pixels, shape: Array, slopes: Array) -> tuple[Array, Array]:
    """Return the derivatives of all pixels by positions, fluxes and backgrounds (P, 4 N - 3), and the residuals (P,).

    Mean position and mean flux are part of the definition of the Gaussian and are fixed: the shape is free to take
    whatever they would.
    """
    gaussian, bell = state.gaussian(pixels)
    flux, count, row = state.flux[pixels.frame], len(state.flux), np.arange(len(pixels.value))
    design = np.zeros((len(row), 4 * count))
    for k in (0, 1):
        design[row, 2 * pixels.frame + k] = flux * (bell[:, k] + slopes[k])
    design[row, 2 * count + pixels.frame] = gaussian + shape
    design[row, 3 * count + pixels.frame] = 1.0
    return design @ _contrasts(count), pixels.value - state.background[pixels.frame] - flux * gaussian


@cache
def _contrasts(count: int) -> Array:
    """Return parameters of N frames, (4 N, 4 N - 3), from those that leave mean position and mean flux as they are."""
    basis = linalg.null_space(np.ones((1, count)))
    return linalg.block_diag(np.kron(basis, np.eye(2)), basis, np.eye(count))


def _shape_of(state: _State, pixels: _Pixels, prior: SeriesPrior, weight: Array) -> tuple[Array, Array]:
    """Return the expected shape beyond the Gaussian in every pixel (P,) and its slopes by the position (2, P)."""
    value, slopes = _shape_covariance(state, pixels, prior)
    weighted = state.flux[pixels.frame] * weight
    return value @ weighted, slopes @ weighted


def _moved(state: _State, step: Array) -> tuple[_State, float]:
    """Return the state after a step, positions by at most half a pixel, and the largest move of a position, px."""
    count = len(state.flux)
    shift = step[: 2 * count].reshape(-1, 2)
    moved = float(np.max(np.abs(shift)))
    short = min(_DAMPING, 0.5 / max(moved, 1e-300))
    flux = np.maximum(state.flux + short * step[2 * count : 3 * count], 0.1 * state.flux)
    background = state.background + short * step[3 * count :]
    return _State(state.position + short * shift, flux, background, state.width), moved


def _learning_frames(state: _State, pixels: _Pixels) -> tuple[_State, _Pixels, NDArray[np.bool_]]:
    """Return state and pixels of the frames from which the priors are learnt, and a mask of these among all pixels."""
    count = len(state.flux)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _LEARNT_FRAMES)).round().astype(np.intp))
    use = np.isin(pixels.frame, chosen)
    frame, same = np.searchsorted(chosen, pixels.frame[use]), pixels.same[np.ix_(use, use)]
    part = replace(
        pixels,
        value=pixels.value[use],
        level=pixels.level[use],
        frame=frame,
        coordinates=pixels.coordinates[use],
        same=same,
    )
    few = _State(state.position[chosen], state.flux[chosen], state.background[chosen], state.width)
    return few, part, use


def _learn(
    state: _State, pixels: _Pixels, design: Array, residuals: Array, starts: Sequence[SeriesPrior], noisy: bool
) -> SeriesPrior:
    """Return the prior that maximises the restricted likelihood of the pixels about a state."""

    def priors(logs: Array) -> SeriesPrior:
        return SeriesPrior(*(float(v) for v in np.exp(logs)))

    def target(logs: Array) -> tuple[float, Array]:
        now = priors(logs)
        terms = _terms(state, pixels, now)
        solver = _Solver(np.sum(list(terms.values()), axis=0), design)
        weighted_residuals = solver.projector @ residuals
        value = (
            solver.log_determinant
            + float(np.linalg.slogdet(solver.information)[1])
            + float(residuals @ weighted_residuals)
        )
        changes = [2.0 * terms["shape"]]
        for name in ("length", "extent"):
            other = replace(now, **{name: getattr(now, name) * (1.0 + _STEP)})
            changes.append((_terms(state, pixels, other)["shape"] - terms["shape"]) / _STEP)
        changes += [2.0 * terms[cause] for cause in ("response pattern", "dark pattern")]
        read = 2.0 * now.read_dn**2 * np.eye(len(residuals))
        changes += [terms["temporal noise"] - 0.5 * read, read]
        gradient = [
            np.sum(solver.projector * change) - weighted_residuals @ change @ weighted_residuals for change in changes
        ]
        return 0.5 * value, 0.5 * np.array(gradient)

    low, high = (np.log(list(vars(limit).values())) for limit in _LIMITS)
    bounds, best = list(zip(low, high, strict=True)), None
    for start in starts:
        at = np.clip(np.log(list(vars(start).values())), low, high)
        ends = bounds if noisy else [*bounds[:5], *((v, v) for v in at[5:])]
        fit = optimize.minimize(target, at, jac=True, method="L-BFGS-B", bounds=ends, options={"maxiter": _MOST_STEPS})
        best = fit if best is None or fit.fun < best.fun else best
    assert best is not None
    return priors(best.x)


def _result(
    images: Array,
    pixels: _Pixels,
    state: _State,
    prior: SeriesPrior,
    terms: dict[str, Array],
    solver: _Solver,
    weighted_residuals: Array,
) -> WindowSeries:
    count = len(state.flux)
    influence = (_contrasts(count) @ solver.estimator)[: 2 * count]
    parts = {cause: influence @ term @ influence.T for cause, term in terms.items()}
    residual = np.full(images.shape, np.nan)
    noise = np.diagonal(terms["temporal noise"])
    inside = tuple(pixels.coordinates.astype(np.intp).T)
    corner = np.array([pixels.coordinates[pixels.frame == k].min(axis=0) for k in range(count)]).astype(np.intp)
    residual[pixels.frame, inside[0] - corner[pixels.frame, 0], inside[1] - corner[pixels.frame, 1]] = (
        np.sqrt(noise) * weighted_residuals
    )
    # E[r' P D P r] = trace(P D): what the pattern and the shape take from the noise does not count
    chi = float(np.sum(noise * weighted_residuals**2) / np.sum(noise * np.diagonal(solver.projector)))
    return WindowSeries(
        state.position, sum(parts.values()), FrozenMap(parts), state.flux, state.background, residual, chi, prior,
        state.width,
    )  # fmt: skip
