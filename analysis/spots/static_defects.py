"""Detection of defects that are the same in all frames of a spot, and centroids of repaired images.

The repaired image is c = u d + (1 - u) m(q) - e(q), with the image d, the mask u of the pixels that are used, the
fitted model m and the part e of it that is neither the spot nor its level. The parameters q are fitted to d itself, so
that a change n of the image moves a centroid of influence g to first order by

    g u n + g ((1 - u) dm/dq - de/dq) Q n,     Q = (D' W D)^-1 D' W

with the derivatives D of the model with respect to q and the weights W of the fit: the covariance contains the cost of
the repair.

All defects are detected in the residuals of the fitted shape. A pixel is bad when it differs from the prediction of the
pixels about it: light that passes the optics has no detail of one pixel. An uneven background or a reflection is
accepted if it reduces chi-square significantly. Each test has the false-alarm probability FALSE_ALARM in a clean image;
where a defect was found, pixels are then excluded from `CLOSER` sigmas on.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal
from scipy.stats import chi2, norm

from analysis.arrays import Array, Mask
from analysis.spots import spot_image
from analysis.spots.frame_screening import FALSE_ALARM, Finding, ScreenedFrames
from analysis.spots.noise import NoiseModel
from analysis.spots.screened_fit import FitTerms, ScreenedFit, fit_screened, model_parts
from analysis.spots.spot_image import SpotError, SpotPositions
from analysis.spots.spot_template import SpotTemplate
from analysis.statistics import robust_sigma


def repaired_centroid(
    screened: ScreenedFrames,
    fit: ScreenedFit,
    noise: NoiseModel,
    template: SpotTemplate,
    measure: Callable[[Array, NoiseModel], SpotPositions],
) -> tuple[SpotPositions, float]:
    """Return the position of a spot in the repaired image, and the relative cost of the repair.

    The cost is the relative increase of sigma over that without repair and with all frames used. It is negative where
    the inserted values have less noise than those they replace, as at the edge of a window.

    Dimensions: H rows, W columns.

    Parameters
    ----------
    screened : ScreenedFrames
        Frames of one state.
    fit : ScreenedFit
        Fit of the spot in these.
    noise : NoiseModel
        Noise of the detector.
    template : SpotTemplate
        Template with the spot's one shape.
    measure : callable
        Centroid method with maps: function of images (1, H, W) and their noise model.

    Raises
    ------
    SpotError
        ``measure`` fails.
    """
    shape = screened.mean.shape
    design, extra, beside = model_parts(fit, template)
    level, used, counts = fit.level.ravel(), fit.used.ravel(), screened.counts.ravel()
    image = np.where(used, screened.mean.ravel(), level) - extra
    # saturated pixels have been replaced
    centroid = measure(image.reshape(1, *shape), replace(noise, saturation_dn=1e300))
    assert centroid.gain_maps is not None
    maps = centroid.gain_maps.reshape(2, -1)
    temporal, fixed = noise.temporal_variance_dn2(level, 1), noise.fixed_variance_dn2(level)
    weighted = design * (used / (temporal / counts + fixed))
    influence = maps * used + maps @ (~used * design - beside).T @ fit.inverse @ weighted
    temporal_part = (influence * (temporal / counts)) @ influence.T + screened.jitter / float(np.median(counts))
    fixed_part = (influence * fixed) @ influence.T
    ideal = (maps * (temporal / screened.recorded + fixed)) @ maps.T
    positions = replace(
        centroid,
        temporal_covariance=temporal_part[None],
        fixed_covariance=fixed_part[None],
        gain_maps=influence.reshape(1, 2, *shape),
        light_dn=noise.light_signal_dn(level).reshape(1, *shape),
    )
    return positions, float(np.sqrt(np.trace(temporal_part + fixed_part) / np.trace(ideal)) - 1.0)


CLOSER = 4.5
"""Residual, in sigmas of a pixel, above which it is excluded from an image that is known to contain defects."""
MOST_OTHERS = 3
"""Greatest number of further spots (reflections) that are fitted in one image."""
NEAREST_PX = 4.0
"""Distance, px, below which a second source of light is not distinguished from the spot."""
_NEAR = 2
_MISFIT = 0.05
"""Allowed error of the prediction of a residual from those around it, relative to the residual."""
_ROUGH_SIGMAS, _ROUGH_PX = 12.0, 6.0
_BESIDE = np.array([-1.0, 4.0, 0.0, 4.0, -1.0]) / 6.0
"""Weights by which a column or row is predicted from the two on either side: a parabola through them."""
_NEAR_SPOT_PX = 15.0
"""Distance from the spot, px, within which a line's pixels do not count for the test of the line."""
_LINE_SHARE = 0.4
"""Fraction of bad pixels of a column or row from which all its pixels count as bad."""
_ABOVE_RING = 6.0
"""Smallest height of a reflection over the other residuals at its distance from the spot, in units of their scatter."""
_EDGE_LIGHT_PX = 12.0
"""Radius, px, of the area that is excluded about a light to which the shape cannot be fitted."""
_LEAST_SHARE = 5.0
"""Significance, in sigmas, below which a further spot (reflection) is dropped from the fit."""
_ROUNDS = 8
_GROSS = 4.0
"""Factor by which a pixel's limit for exclusion is increased while smear is not fitted yet."""
_STEEP = 0.15
"""Fraction of the range of grey values about a pixel by which it may deviate where no shape is known."""


def _prediction() -> Array:
    """Return the weights (5, 5) that predict a pixel from those about it by a quadratic surface."""
    row, column = np.mgrid[-_NEAR : _NEAR + 1, -_NEAR : _NEAR + 1].reshape(2, -1).astype(np.float64)
    around = (row != 0) | (column != 0)
    design = np.stack([np.ones_like(row), row, column, row * row, row * column, column * column])[:, around]
    out = np.zeros(row.size)
    out[around] = np.linalg.pinv(design.T)[0]
    return out.reshape(2 * _NEAR + 1, -1)


_PREDICTION = _prediction()
_ALONE = 0.4 * float(np.abs(_PREDICTION).sum())


@dataclass(frozen=True, eq=False)
class Examined:
    """Spot in one state, with its fit and its defects.

    Dimensions: H rows, W columns.

    Attributes
    ----------
    screened : ScreenedFrames
        Screened frames of the spot.
    good : (H, W) ndarray of bool
        Pixels that are used.
    static : (H, W) ndarray of bool
        Pixels found bad here, which are bad in all states.
    fit : ScreenedFit
        Fit of the spot.
    findings : tuple of Finding
        Defects of the frames and of the mean image.
    """

    screened: ScreenedFrames
    good: Mask
    static: Mask
    fit: ScreenedFit
    findings: tuple[Finding, ...]

    @property
    def clean(self) -> bool:
        """True if no defect changed the measurement."""
        return not any(finding.corrects for finding in self.findings)


def examine(
    screened: ScreenedFrames,
    noise: NoiseModel,
    template: SpotTemplate,
    vibration: bool = False,
    same_image: bool = False,
    searched: bool = True,
    first: tuple[int, int] = (0, 0),
    learnt: bool = False,
) -> Examined:
    """Detect defects in a mean image: bad pixels and lines, uneven background, further spots and smear.

    Parameters
    ----------
    screened : ScreenedFrames
        Frames of one state.
    noise : NoiseModel
        Noise of the detector.
    template : SpotTemplate
        Template with the spot's one shape.
    vibration : bool
        True to fit smear.
    same_image : bool
        True if the shape was learnt from this very image, so that its residuals show nothing.
    searched : bool
        True to search for defects; otherwise only known ones are excluded or fitted.
    first : tuple of int
        Row and column of the detector at which the image begins; findings give positions on the detector.
    learnt : bool
        True if the shape was learnt from frames of this spot in another state, where it may have been smeared more and
        have had a reflection that is missing here.

    Raises
    ------
    SpotError
        There is no spot, or it cannot be measured.
    """
    mean = screened.mean
    rough = _rough(mean, screened, noise) if searched else np.zeros_like(screened.good)
    good = screened.good & ~rough
    smeared = (vibration or bool(np.any(screened.jitter))) and not same_image
    terms = FitTerms(learnt=learnt)
    lines, edges = np.zeros_like(good), np.zeros_like(good)
    limit = float(norm.isf(FALSE_ALARM / (2.0 * mean.size)))
    dirty = not screened.clean
    fitted = _fit_of(screened, noise, template)
    fit = fitted(good, terms, None)
    # gross defects first, so that they are not taken for smear or for a further spot
    for gross in (True, False):
        if not gross and smeared:
            terms = replace(terms, smear=True)
            fit = fitted(good, terms, fit)
        for _ in range(_ROUNDS if searched else 0):
            before = good, terms
            least = (_GROSS if smeared else 1.0) * limit if gross else CLOSER if dirty else limit
            # search anew every time: an earlier fit, or the coarse search before the first fit, may have been wrong
            start = screened.good & ~(rough & (np.abs(mean - fit.level) > least * np.sqrt(fit.variance)))
            bad_pixels = _off(mean - fit.level, fit.variance, start, least)
            position = float(fit.positions.row[0]), float(fit.positions.column[0])
            z = (mean - fit.level) / np.sqrt(fit.variance)
            lines = _lines(z, position, start & ~bad_pixels, screened.good & (~start | bad_pixels))
            good = start & ~bad_pixels & ~lines & ~edges
            dirty = dirty or not np.array_equal(good | edges, screened.good)
            if not np.array_equal(good, before[0]):
                fit = fitted(good, terms, fit)
            if not same_image and not gross:
                terms, fit = _uneven(fitted, mean, good, terms, fit)
                terms, fit, edge = _others(fitted, mean, template, good, terms, fit)
                edges, good = edges | edge, good & ~edge
            dirty = dirty or terms.background > 0 or bool(terms.others) or bool(np.any(edges))
            if np.array_equal(good, before[0]) and terms == before[1]:
                break
    bad = screened.good & ~good & ~edges
    return Examined(screened, good, bad, fit, (*screened.findings, *_static_findings(bad, edges, fit, first)))


def outlier_pixels(screened: ScreenedFrames, noise: NoiseModel) -> Mask:
    """Return the pixels (H, W) that deviate from their surroundings, for spots without a known shape.

    Dimensions: H rows, W columns.

    Parameters
    ----------
    screened : ScreenedFrames
        Frames of one state.
    noise : NoiseModel
        Noise of the detector.
    """
    mean, good = screened.mean, screened.good & ~_rough(screened.mean, screened, noise)
    smooth = ndimage.median_filter(spot_image.filled(mean, good), 5)
    steep = ndimage.maximum_filter(smooth, 5) - ndimage.minimum_filter(smooth, 5)
    variance = noise.temporal_variance_dn2(smooth, 1) / screened.counts + noise.fixed_variance_dn2(smooth)
    limit = float(norm.isf(FALSE_ALARM / (2.0 * mean.size)))
    bad = _off(mean, variance + (_STEEP * steep / limit) ** 2, good, limit)
    top = np.unravel_index(int(np.argmax(ndimage.uniform_filter(smooth, 5))), smooth.shape)
    residual = (mean - smooth) / np.sqrt(variance + (_STEEP * steep) ** 2)
    lines = _lines(residual, (float(top[0]), float(top[1])), good & ~bad, screened.good & (~good | bad))
    return np.asarray(screened.good & (~good | bad | lines))


def refit(
    examined: Examined, static: Mask, noise: NoiseModel, template: SpotTemplate, findings: tuple[Finding, ...] = ()
) -> Examined:
    """Fit a spot again with further pixels excluded that are bad in another state.

    Dimensions: H rows, W columns.

    Parameters
    ----------
    examined : Examined
        Spot with its fit.
    static : (H, W) ndarray of bool
        Pixels that are bad.
    noise : NoiseModel
        Noise of the detector.
    template : SpotTemplate
        Template with the spot's one shape.
    findings : tuple of Finding
        Findings to add.

    Raises
    ------
    SpotError
        Too few pixels are left.
    """
    good = examined.good & ~static
    terms = replace(examined.fit.terms, others=tuple((float(r), float(c)) for r, c, _ in examined.fit.others))
    fit = _fit_of(examined.screened, noise, template)(good, terms, examined.fit)
    return Examined(examined.screened, good, examined.static | static, fit, (*examined.findings, *findings))


_Fit = Callable[[Mask, FitTerms, ScreenedFit | None], ScreenedFit]
"""Function that fits terms to the good pixels of one image, starting from an earlier fit."""


def _fit_of(screened: ScreenedFrames, noise: NoiseModel, template: SpotTemplate) -> _Fit:
    def fitted(good: Mask, terms: FitTerms, near: ScreenedFit | None) -> ScreenedFit:
        left, recorded = screened.jitter, screened.recorded
        mean, counts = screened.mean, screened.counts
        return fit_screened(mean, counts, good, noise, template, terms, near=near, jitter=left, recorded=recorded)

    return fitted


def _rough(mean: Array, screened: ScreenedFrames, noise: NoiseModel) -> Mask:
    """Return the pixels (H, W) of gross defects away from the spot, which would bias the first fit.

    Dimensions: H rows, W columns.
    """
    filled = spot_image.filled(mean, screened.good)
    smooth = ndimage.median_filter(filled, 5)
    sigma = np.sqrt(noise.temporal_variance_dn2(smooth, 1) / screened.counts + noise.fixed_variance_dn2(smooth))
    # wide enough to reach from a dark ring into the bright ones beside it
    steep = ndimage.maximum_filter(smooth, 7) - ndimage.minimum_filter(smooth, 7)
    out = np.abs(mean - smooth) > _ROUGH_SIGMAS * sigma + steep
    top = np.unravel_index(int(np.argmax(ndimage.uniform_filter(smooth, 5))), smooth.shape)
    row, column = np.indices(mean.shape)
    return np.asarray(out & screened.good & (np.hypot(row - top[0], column - top[1]) > _ROUGH_PX))


def _off(residual: Array, variance: Array, good: Mask, limit: float) -> Mask:
    """Return the pixels whose residual exceeds ``limit`` sigmas, found in the order of their deviation."""
    use = good.copy()
    bad = np.zeros_like(good)
    for _ in range(50):
        image = spot_image.filled(residual, use)
        around = ndimage.convolve(image, _PREDICTION, mode="nearest")
        spread = variance + ndimage.convolve(np.where(use, variance, 0.0), _PREDICTION**2, mode="nearest")
        spread += (_MISFIT * around) ** 2
        z = np.where(use, np.abs(image - around) / np.sqrt(np.maximum(spread, 1e-300)), 0.0)
        # where most neighbours are missing there is no prediction
        alone = ndimage.convolve((~use).astype(np.float64), np.abs(_PREDICTION), mode="nearest") > _ALONE
        z[alone] = 0.0
        new = (z > limit) & (z >= ndimage.maximum_filter(z, 2 * _NEAR + 1))
        if not np.any(new):
            break
        bad |= new
        use &= ~new
    return bad


def _lines(residual: Array, position: tuple[float, float], good: Mask, bad: Mask) -> Mask:
    """Return the pixels of columns and rows that deviate as a whole or contain too many bad pixels.

    ``residual`` is in standard deviations. A line is compared with its neighbours by the median of its pixels away from
    the spot.
    """
    out = np.zeros_like(good)
    for axis in (0, 1):
        size, lines = good.shape[axis], good.shape[1 - axis]
        far = np.abs(np.arange(size) - position[axis]) > _NEAR_SPOT_PX
        z = np.moveaxis(residual, axis, 0)[far]
        used = np.moveaxis(good, axis, 0)[far]
        count = np.count_nonzero(used, axis=0)
        middle = _medians(z, used, count)
        spread = np.sqrt(math.pi / 2.0 / np.maximum(count, 1))
        limit = float(norm.isf(FALSE_ALARM / (2.0 * lines)))
        use = count > 0.25 * len(z)
        off = np.count_nonzero(bad, axis=axis) > _LINE_SHARE * size
        for _ in range(lines // 10):
            known = use & ~off
            if np.count_nonzero(known) < 5:
                break
            filled = np.interp(np.arange(lines), np.flatnonzero(known), middle[known])
            around = ndimage.convolve1d(filled, _BESIDE, mode="nearest")
            noise = np.hypot(spread, np.sqrt(ndimage.convolve1d(spread**2, _BESIDE**2, mode="nearest")))
            score = np.where(known, np.abs(middle - around) / np.hypot(noise, _MISFIT * around), 0.0)
            worst = int(np.argmax(score))
            if score[worst] <= limit:
                break
            off[worst] = True
        out |= np.expand_dims(off, axis)
    return np.asarray(out & good)


def _medians(values: Array, used: Mask, count: NDArray[np.intp]) -> Array:
    """Return the median of the used values of every column; 0 where there are none."""
    ordered = np.sort(np.where(used, values, np.inf), axis=0)
    low, high = (np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(values) - 1))
    column = np.arange(values.shape[1])
    middle = np.zeros(values.shape[1])
    present = count > 0
    middle[present] = 0.5 * (ordered[low, column] + ordered[high, column])[present]
    return middle


def _uneven(fitted: _Fit, mean: Array, good: Mask, terms: FitTerms, fit: ScreenedFit) -> tuple[FitTerms, ScreenedFit]:
    """Fit slopes and curvature of the background where they are significant."""
    for order, more in ((1, 2), (2, 3)):
        if terms.background >= order:
            continue
        wider = replace(terms, background=order)
        tried = fitted(good, wider, fit)
        gain = (fit.image_chi_square(mean) - tried.image_chi_square(mean)) / _spread(terms)
        if gain <= chi2.isf(FALSE_ALARM, more):
            # curvature without slopes is tried as well
            if order == 1:
                continue
            break
        if order == 1 or terms.background == 1 or gain > chi2.isf(FALSE_ALARM, 5):
            terms, fit = wider, tried
    return terms, fit


def _spread(terms: FitTerms) -> float:
    """Return the factor on the variance that noise gives a fitted smooth background term.

    It is 1 for a noise-free shape and 2 for a learnt one, which contains the noise of another image.
    """
    return 2.0 if terms.learnt else 1.0


def _others(
    fitted: _Fit, mean: Array, template: SpotTemplate, good: Mask, terms: FitTerms, fit: ScreenedFit
) -> tuple[FitTerms, ScreenedFit, Mask]:
    """Fit significant further spots, the brightest first; those at the edge are excluded."""
    edges = np.zeros_like(good)
    terms, fit = _needed_spots(fitted, good, terms, fit)
    while len(terms.others) < MOST_OTHERS:
        start = _second_light(mean, fit, good & ~edges, template, terms.learnt)
        if start is None:
            break
        if any(not low + 1.0 < at < high - 1.0 for at, (low, high) in zip(start, template.supported(), strict=True)):
            row, column = np.indices(good.shape)
            edges = edges | (good & (np.hypot(row - start[0], column - start[1]) <= _EDGE_LIGHT_PX))
            fit = fitted(good & ~edges, terms, fit)
            continue
        wider = replace(terms, others=(*((float(r), float(c)) for r, c, _ in fit.others), start))
        try:
            tried = fitted(good & ~edges, wider, fit)
        except SpotError:
            break
        row, column, share = tried.others[-1]
        away = math.hypot(row - tried.positions.row[0], column - tried.positions.column[0])
        gain = (fit.image_chi_square(mean) - tried.image_chi_square(mean)) / _spread(terms)
        if (share <= 0.0 and not terms.learnt) or away < NEAREST_PX or gain <= chi2.isf(FALSE_ALARM / good.size, 3):
            break
        terms = replace(terms, others=tuple((float(r), float(c)) for r, c, _ in tried.others))
        fit = tried
    return terms, fit, edges


def _needed_spots(fitted: _Fit, good: Mask, terms: FitTerms, fit: ScreenedFit) -> tuple[FitTerms, ScreenedFit]:
    """Fit again without those further spots (reflections) that are no longer significant."""
    share = np.abs(fit.others[:, 2]) if terms.learnt else fit.others[:, 2]
    bright = share > _LEAST_SHARE * fit.others_sigma[:, 2]
    if np.all(bright):
        return terms, fit
    terms = replace(terms, others=tuple((float(r), float(c)) for r, c, _ in fit.others[bright]))
    fit = replace(fit, others=fit.others[bright], others_sigma=fit.others_sigma[bright])
    return terms, fitted(good, terms, fit)


def _second_light(
    mean: Array, fit: ScreenedFit, good: Mask, template: SpotTemplate, either_sign: bool
) -> tuple[float, float] | None:
    """Return the position (row, column) where the residuals match a further spot best; None if not significant.

    With ``either_sign`` the spot may also be a missing one, with negative light.
    """
    height, width = mean.shape
    middle = (height // 2, width // 2)
    stamp = template.evaluate(float(middle[0]), float(middle[1]))[0][0]
    half = min(20, *middle)
    stamp = stamp[middle[0] - half : middle[0] + half + 1, middle[1] - half : middle[1] + half + 1]
    weight = np.where(fit.used, 1.0 / fit.variance, 0.0)
    flipped = stamp[::-1, ::-1]
    amplitude = signal.fftconvolve((mean - fit.level) * weight, flipped, mode="same")
    power = np.maximum(signal.fftconvolve(weight, flipped**2, mode="same"), 1e-300)
    score = np.where(power > 0.3 * np.median(power), amplitude / np.sqrt(power), 0.0)
    row, column = np.indices(mean.shape)
    away = np.hypot(row - fit.positions.row[0], column - fit.positions.column[0])
    score = np.where(good & (away > NEAREST_PX), np.abs(score) if either_sign else score, 0.0)
    limit = float(norm.isf(FALSE_ALARM / mean.size))
    for _ in range(5):
        top = np.unravel_index(int(np.argmax(score)), score.shape)
        if score[top] <= limit:
            return None
        # residuals of a spot of another shape lie all around it
        ring = (np.abs(away - away[top]) < 3.0) & (np.hypot(row - top[0], column - top[1]) > 8.0)
        rest = robust_sigma(score[ring]) if np.count_nonzero(ring) > 20 else 1.0
        if score[top] > _ABOVE_RING * max(rest, 1.0):
            return float(top[0]), float(top[1])
        score = np.where(np.hypot(row - top[0], column - top[1]) > 4.0, score, 0.0)
    return None


def _static_findings(bad: Mask, edges: Mask, fit: ScreenedFit, first: tuple[int, int]) -> list[Finding]:
    """Return descriptions of the defects found in a mean image, with their positions on the detector."""
    out = []
    full = [np.flatnonzero(bad.sum(axis=axis) > 0.5 * bad.shape[axis]) for axis in (0, 1)]
    along = np.zeros_like(bad)
    along[:, full[0]] = along[full[1]] = True
    single = int(np.count_nonzero(bad & ~along))
    if single:
        where = np.argwhere(bad & ~along)[:3] + first
        shown = ", ".join(f"({r}, {c})" for r, c in where)
        more = ", ..." if single > 3 else ""
        out.append(Finding("bad pixels", f"{single} hot, dead or otherwise deviating are excluded: {shown}{more}"))
    for numbers, begin, name in zip(full, first[::-1], ("columns", "rows"), strict=True):
        if numbers.size:
            shown = ", ".join(map(str, numbers[:5] + begin))
            out.append(Finding(f"bad {name}", f"{shown}{', ...' * (numbers.size > 5)} are excluded"))
    if fit.terms.background:
        description = "slopes" if fit.terms.background == 1 else "slopes and curvature"
        rise = float(np.ptp(fit.level[[0, 0, -1, -1], [0, -1, 0, -1]]))
        out.append(Finding("uneven background", f"{description} fitted, {rise:.2g} DN between the corners"))
    for (row, column, share), (_, _, sigma) in zip(fit.others, fit.others_sigma, strict=True):
        location = f"at row {row + first[0]:.1f}, column {column + first[1]:.1f}"
        light = f"{100.0 * abs(share):.2g} ± {100.0 * sigma:.1g} % of the light"
        description = "; fitted" if share > 0.0 else ", in the frames before but not here; fitted"
        out.append(Finding("second spot", f"{location} with {light}{description}"))
    if np.any(edges):
        out.append(Finding("second spot", "near the edge of the frames; its surroundings are excluded"))
    if fit.terms.smear:
        absolute = not fit.terms.learnt
        rows, columns = (max(moment, 0.0) if absolute else moment for moment in np.diagonal(fit.smear))
        text = f"{_rms(rows)} px rms in row and {_rms(columns)} px rms in column, fitted"
        out.append(Finding("smear", text if absolute else f"{text}, relative to the frames before"))
    return out


def _rms(moment: float) -> str:
    """Return the rms width of a smear from its second moment, px^2, as text; negative for a negative moment."""
    return f"{math.copysign(math.sqrt(abs(moment)), moment):.2f}"
