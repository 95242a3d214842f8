"""What is the same in all frames of a spot and is not the spot, and images in which it is repaired.

The repaired image is c = u d + (1 - u) m(q) - e(q), with the image d, the mask u of the pixels that are used, the
fitted model m and what of it is not the spot and its level, e. The parameters q are fitted to d themselves, so that a
change n of the image moves a centroid of influence g to first order by

    g u n + g ((1 - u) dm/dq - de/dq) Q n,     Q = (D' W D)^-1 D' W

with the design D and the weights W of the fit: the covariance holds what the repair costs.

Pixel coordinates: (row, column), the centre of the first pixel is (0, 0).

Everything is looked for in the residuals of the fitted shape. A pixel is bad when it differs from what the pixels about
it predict: light comes through the optics and has no detail of one pixel. Whether an uneven background or a reflection
is there is decided by what it explains of chi-square. Each test finds something in one of 1 / FALSE_ALARM clean images;
where something was found, pixels are then left out from `CLOSER` sigmas on.
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
from analysis.spots.spot_positions import SpotError, SpotPositions
from analysis.spots.spot_template import SpotTemplate
from analysis.statistics import robust_sigma


def repaired_centroid(
    screened: ScreenedFrames,
    fit: ScreenedFit,
    noise: NoiseModel,
    template: SpotTemplate,
    measure: Callable[[Array, NoiseModel], SpotPositions],
) -> tuple[SpotPositions, float]:
    """Measure the centre of a spot in the repaired image, and what the repair costs: sigma over what it would be if
    nothing had been repaired and all frames were used, minus 1. Less than 0 where what was put in has less noise than
    what was taken out, as at the edge of a window.

    Parameters
    ----------
    screened : ScreenedFrames
        Frames of one state.
    fit : ScreenedFit
        Of the spot in these.
    noise : NoiseModel
        Of the detector.
    template : SpotTemplate
        The spot's one shape.
    measure : Callable[[Array, NoiseModel], SpotPositions]
        a centroid with its maps, of images (1, H, W) and their noise.

    Raises
    ------
    SpotError
        Of ``measure``.
    """
    shape = screened.mean.shape
    design, extra, beside = model_parts(fit, template)
    level, used, counts = fit.level.ravel(), fit.used.ravel(), screened.counts.ravel()
    image = np.where(used, screened.mean.ravel(), level) - extra
    # what is saturated has been put in
    found = measure(image.reshape(1, *shape), replace(noise, saturation_dn=1e300))
    assert found.gain_maps is not None
    own = found.gain_maps.reshape(2, -1)
    temporal, fixed = noise.temporal_variance_dn2(level, 1), noise.fixed_variance_dn2(level)
    weighted = design * (used / (temporal / counts + fixed))
    influence = own * used + own @ (~used * design - beside).T @ fit.inverse @ weighted
    new = (influence * (temporal / counts)) @ influence.T + screened.jitter / float(np.median(counts))
    old = (influence * fixed) @ influence.T
    ideal = (own * (temporal / screened.recorded + fixed)) @ own.T
    positions = replace(
        found,
        temporal_covariance=new[None],
        fixed_covariance=old[None],
        gain_maps=influence.reshape(1, 2, *shape),
        light_dn=noise.light_signal_dn(level).reshape(1, *shape),
    )
    return positions, float(np.sqrt(np.trace(new + old) / np.trace(ideal)) - 1.0)


CLOSER = 4.5
"""Sigmas of a pixel from which it is left out of an image that is known to hold defects."""
MOST_OTHERS = 3
"""Reflections that are fitted."""
NEAREST_PX = 4.0
"""Nearer lights are not told from the spot."""
_REACH = 2
_MISFIT = 0.05
"""Share of the residual around a pixel by which its prediction may be wrong."""
_ROUGH_SIGMAS, _ROUGH_PX = 12.0, 6.0
_BESIDE = np.array([-1.0, 4.0, 0.0, 4.0, -1.0]) / 6.0
"""Weights by which a line is predicted from those beside it: a parabola through them."""
_NEAR_SPOT_PX = 15.0
"""Pixels of a line so near to the spot do not judge it."""
_LINE_SHARE = 0.4
"""Share of bad pixels of a column or row from which all its pixels count as bad."""
_ABOVE_RING = 6.0
"""Smallest height of a reflection over the other residuals at the same distance from the spot, in units of their
scatter.
"""
_EDGE_LIGHT_PX = 12.0
"""Radius of what is left out about a light that the shape cannot be fitted to."""
_LEAST_SHARE = 5.0
"""Sigmas of a further spot's light below which it is none."""
_ROUNDS = 8
_GROSS = 4.0
"""Times the limit for a pixel while smear is not fitted yet."""
_STEEP = 0.15
"""Share of the rise about a pixel by which it may be off where no shape is known."""


def _prediction() -> Array:
    """(5, 5) weights by which a pixel is predicted from those about it, by a quadratic surface through them."""
    row, column = np.mgrid[-_REACH : _REACH + 1, -_REACH : _REACH + 1].reshape(2, -1).astype(np.float64)
    around = (row != 0) | (column != 0)
    design = np.stack([np.ones_like(row), row, column, row * row, row * column, column * column])[:, around]
    out = np.zeros(row.size)
    out[around] = np.linalg.pinv(design.T)[0]
    return out.reshape(2 * _REACH + 1, -1)


_PREDICTION = _prediction()
_ALONE = 0.4 * float(np.abs(_PREDICTION).sum())


@dataclass(frozen=True, eq=False)
class Examined:
    """A spot in one state.

    Attributes
    ----------
    screened : ScreenedFrames
        Its frames.
    good : Mask
        (H, W) pixels that are used.
    static : Mask
        (H, W) pixels that were found bad here, which are bad in all states.
    fit : ScreenedFit
        Of the spot.
    findings : tuple[Finding, ...]
        Of the frames and here.
    """

    screened: ScreenedFrames
    good: Mask
    static: Mask
    fit: ScreenedFit
    findings: tuple[Finding, ...]

    @property
    def clean(self) -> bool:
        """Whether the measurement is that of clean frames."""
        return not any(finding.corrects for finding in self.findings)


def examine(
    screened: ScreenedFrames,
    noise: NoiseModel,
    template: SpotTemplate,
    vibration: bool = False,
    own: bool = False,
    searched: bool = True,
    first: tuple[int, int] = (0, 0),
    learnt: bool = False,
) -> Examined:
    """Find what is in an image beside the spot.

    Parameters
    ----------
    screened : ScreenedFrames
        Frames of one state.
    noise : NoiseModel
        Of the detector.
    template : SpotTemplate
        The spot's one shape.
    vibration : bool
        Whether smear is fitted.
    own : bool
        Whether the shape was learnt from this very image, so that residuals of it say nothing.
    searched : bool
        Whether anything is looked for; else what is known already is left out and fitted.
    first : tuple[int, int]
        Row and column of the detector at which the image begins; findings tell places on the detector.
    learnt : bool
        Whether the shape was learnt from frames of this spot in another state: it may have been smeared more there, and
        have held a reflection, which then is missing here.

    Raises
    ------
    SpotError
        No spot, or it cannot be measured.
    """
    mean = screened.mean
    rough = _rough(mean, screened, noise) if searched else np.zeros_like(screened.good)
    good = screened.good & ~rough
    smeared = (vibration or bool(np.any(screened.jitter))) and not own
    terms = FitTerms(learnt=learnt)
    lines, edges = np.zeros_like(good), np.zeros_like(good)
    limit = float(norm.isf(FALSE_ALARM / (2.0 * mean.size)))
    dirty = not screened.clean
    fitted = _fit_of(screened, noise, template)
    fit = fitted(good, terms, None)
    # what is gross first, lest it is taken for smear or for another spot
    for gross in (True, False):
        if not gross and smeared:
            terms = replace(terms, smear=True)
            fit = fitted(good, terms, fit)
        for _ in range(_ROUNDS if searched else 0):
            before = good, terms
            least = (_GROSS if smeared else 1.0) * limit if gross else CLOSER if dirty else limit
            # found anew every time: an earlier fit may have been wrong, and so may the coarse look before there was one
            start = screened.good & ~(rough & (np.abs(mean - fit.level) > least * np.sqrt(fit.variance)))
            found = _off(mean - fit.level, fit.variance, start, least)
            place = float(fit.positions.row[0]), float(fit.positions.column[0])
            z = (mean - fit.level) / np.sqrt(fit.variance)
            lines = _lines(z, place, start & ~found, screened.good & (~start | found))
            good = start & ~found & ~lines & ~edges
            dirty = dirty or not np.array_equal(good | edges, screened.good)
            if not np.array_equal(good, before[0]):
                fit = fitted(good, terms, fit)
            if not own and not gross:
                terms, fit = _uneven(fitted, mean, good, terms, fit)
                terms, fit, edge = _others(fitted, mean, template, good, terms, fit)
                edges, good = edges | edge, good & ~edge
            dirty = dirty or terms.background > 0 or bool(terms.others) or bool(np.any(edges))
            if np.array_equal(good, before[0]) and terms == before[1]:
                break
    bad = screened.good & ~good & ~edges
    return Examined(screened, good, bad, fit, (*screened.findings, *_told(bad, edges, fit, first)))


def lone_pixels(screened: ScreenedFrames, noise: NoiseModel) -> Mask:
    """Pixels (H, W) that are not as those about them say, where no shape is known that they could be held against.

    Parameters
    ----------
    screened : ScreenedFrames
        Frames of one state.
    noise : NoiseModel
        Of the detector.
    """
    mean, good = screened.mean, screened.good & ~_rough(screened.mean, screened, noise)
    smooth = ndimage.median_filter(spot_image.filled(mean, good), 5)
    steep = ndimage.maximum_filter(smooth, 5) - ndimage.minimum_filter(smooth, 5)
    variance = noise.temporal_variance_dn2(smooth, 1) / screened.counts + noise.fixed_variance_dn2(smooth)
    limit = float(norm.isf(FALSE_ALARM / (2.0 * mean.size)))
    found = _off(mean, variance + (_STEEP * steep / limit) ** 2, good, limit)
    top = np.unravel_index(int(np.argmax(ndimage.uniform_filter(smooth, 5))), smooth.shape)
    residual = (mean - smooth) / np.sqrt(variance + (_STEEP * steep) ** 2)
    lines = _lines(residual, (float(top[0]), float(top[1])), good & ~found, screened.good & (~good | found))
    return np.asarray(screened.good & (~good | found | lines))


def refit(
    examined: Examined, static: Mask, noise: NoiseModel, template: SpotTemplate, told: tuple[Finding, ...] = ()
) -> Examined:
    """The fit with further pixels left out, which are bad in another state.

    Parameters
    ----------
    examined : Examined
        a spot.
    static : Mask
        (H, W) pixels that are bad.
    noise : NoiseModel
        Of the detector.
    template : SpotTemplate
        The spot's one shape.
    told : tuple[Finding, ...]
        What is to be said of it.

    Raises
    ------
    SpotError
        Too few pixels are left.
    """
    good = examined.good & ~static
    terms = replace(examined.fit.terms, others=tuple((float(r), float(c)) for r, c, _ in examined.fit.others))
    fit = _fit_of(examined.screened, noise, template)(good, terms, examined.fit)
    return Examined(examined.screened, good, examined.static | static, fit, (*examined.findings, *told))


_Fit = Callable[[Mask, FitTerms, ScreenedFit | None], ScreenedFit]
"""Fits terms to the good pixels of one image, from an earlier fit on."""


def _fit_of(screened: ScreenedFrames, noise: NoiseModel, template: SpotTemplate) -> _Fit:
    def fitted(good: Mask, terms: FitTerms, near: ScreenedFit | None) -> ScreenedFit:
        left, recorded = screened.jitter, screened.recorded
        mean, counts = screened.mean, screened.counts
        return fit_screened(mean, counts, good, noise, template, terms, near=near, jitter=left, recorded=recorded)

    return fitted


def _rough(mean: Array, screened: ScreenedFrames, noise: NoiseModel) -> Mask:
    """Gross defects away from the spot, which would draw the first fit."""
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
    """Pixels that are off by more than ``limit`` sigmas, the worst of each neighbourhood first."""
    use = good.copy()
    found = np.zeros_like(good)
    for _ in range(50):
        image = spot_image.filled(residual, use)
        around = ndimage.convolve(image, _PREDICTION, mode="nearest")
        spread = variance + ndimage.convolve(np.where(use, variance, 0.0), _PREDICTION**2, mode="nearest")
        spread += (_MISFIT * around) ** 2
        z = np.where(use, np.abs(image - around) / np.sqrt(np.maximum(spread, 1e-300)), 0.0)
        # where most neighbours are missing themselves they predict nothing
        alone = ndimage.convolve((~use).astype(np.float64), np.abs(_PREDICTION), mode="nearest") > _ALONE
        z[alone] = 0.0
        new = (z > limit) & (z >= ndimage.maximum_filter(z, 2 * _REACH + 1))
        if not np.any(new):
            break
        found |= new
        use &= ~new
    return found


def _lines(residual: Array, place: tuple[float, float], good: Mask, bad: Mask) -> Mask:
    """Columns and rows of which all pixels are off together, or so many bad that none can be trusted, by residuals in
    standard deviations.

    A line is held against its neighbours, in the median of its pixels away from the spot.
    """
    out = np.zeros_like(good)
    for axis in (0, 1):
        size, lines = good.shape[axis], good.shape[1 - axis]
        far = np.abs(np.arange(size) - place[axis]) > _NEAR_SPOT_PX
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
    """Median of the used values of every column; 0 where there are none."""
    ordered = np.sort(np.where(used, values, np.inf), axis=0)
    low, high = (np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(values) - 1))
    column = np.arange(values.shape[1])
    middle = np.zeros(values.shape[1])
    some = count > 0
    middle[some] = 0.5 * (ordered[low, column] + ordered[high, column])[some]
    return middle


def _uneven(fitted: _Fit, mean: Array, good: Mask, terms: FitTerms, fit: ScreenedFit) -> tuple[FitTerms, ScreenedFit]:
    """Slopes and curvature of the background, where they explain more than chance does."""
    for order, more in ((1, 2), (2, 3)):
        if terms.background >= order:
            continue
        wider = replace(terms, background=order)
        tried = fitted(good, wider, fit)
        gain = (fit.explains(mean) - tried.explains(mean)) / _spread(terms)
        if gain <= chi2.isf(FALSE_ALARM, more):
            # a bend without a slope is tried as well
            if order == 1:
                continue
            break
        if order == 1 or terms.background == 1 or gain > chi2.isf(FALSE_ALARM, 5):
            terms, fit = wider, tried
    return terms, fit


def _spread(terms: FitTerms) -> float:
    """Variance of what a smooth term explains, over that by the noise of the image: a shape that was learnt has the
    noise of an image of its own.
    """
    return 2.0 if terms.learnt else 1.0


def _others(
    fitted: _Fit, mean: Array, template: SpotTemplate, good: Mask, terms: FitTerms, fit: ScreenedFit
) -> tuple[FitTerms, ScreenedFit, Mask]:
    """Further spots, the brightest first, where they explain more than chance does; those at the edge are left out."""
    edges = np.zeros_like(good)
    terms, fit = _kept(fitted, good, terms, fit)
    while len(terms.others) < MOST_OTHERS:
        place = _second_light(mean, fit, good & ~edges, template, terms.learnt)
        if place is None:
            break
        if any(not low + 1.0 < at < high - 1.0 for at, (low, high) in zip(place, template.supported(), strict=True)):
            row, column = np.indices(good.shape)
            edges = edges | (good & (np.hypot(row - place[0], column - place[1]) <= _EDGE_LIGHT_PX))
            fit = fitted(good & ~edges, terms, fit)
            continue
        wider = replace(terms, others=(*((float(r), float(c)) for r, c, _ in fit.others), place))
        try:
            tried = fitted(good & ~edges, wider, fit)
        except SpotError:
            break
        row, column, share = tried.others[-1]
        away = math.hypot(row - tried.positions.row[0], column - tried.positions.column[0])
        gain = (fit.explains(mean) - tried.explains(mean)) / _spread(terms)
        if (share <= 0.0 and not terms.learnt) or away < NEAREST_PX or gain <= chi2.isf(FALSE_ALARM / good.size, 3):
            break
        terms = replace(terms, others=tuple((float(r), float(c)) for r, c, _ in tried.others))
        fit = tried
    return terms, fit, edges


def _kept(fitted: _Fit, good: Mask, terms: FitTerms, fit: ScreenedFit) -> tuple[FitTerms, ScreenedFit]:
    """Leave out further spots that are no longer needed."""
    share = np.abs(fit.others[:, 2]) if terms.learnt else fit.others[:, 2]
    bright = share > _LEAST_SHARE * fit.others_sigma[:, 2]
    if np.all(bright):
        return terms, fit
    terms = replace(terms, others=tuple((float(r), float(c)) for r, c, _ in fit.others[bright]))
    fit = replace(fit, others=fit.others[bright], others_sigma=fit.others_sigma[bright])
    return terms, fitted(good, terms, fit)


def _second_light(
    mean: Array, fit: ScreenedFit, good: Mask, template: SpotTemplate, missing: bool
) -> tuple[float, float] | None:
    """Where the residuals look most like another spot, or like one that is missing; None where they do not."""
    height, width = mean.shape
    middle = (height // 2, width // 2)
    stamp = template.evaluate(float(middle[0]), float(middle[1]))[0][0]
    reach = min(20, *middle)
    stamp = stamp[middle[0] - reach : middle[0] + reach + 1, middle[1] - reach : middle[1] + reach + 1]
    weight = np.where(fit.used, 1.0 / fit.variance, 0.0)
    turned = stamp[::-1, ::-1]
    amplitude = signal.fftconvolve((mean - fit.level) * weight, turned, mode="same")
    power = np.maximum(signal.fftconvolve(weight, turned**2, mode="same"), 1e-300)
    score = np.where(power > 0.3 * np.median(power), amplitude / np.sqrt(power), 0.0)
    row, column = np.indices(mean.shape)
    away = np.hypot(row - fit.positions.row[0], column - fit.positions.column[0])
    score = np.where(good & (away > NEAREST_PX), np.abs(score) if missing else score, 0.0)
    limit = float(norm.isf(FALSE_ALARM / mean.size))
    for _ in range(5):
        top = np.unravel_index(int(np.argmax(score)), score.shape)
        if score[top] <= limit:
            return None
        # what a spot of another shape leaves over lies all around it
        ring = (np.abs(away - away[top]) < 3.0) & (np.hypot(row - top[0], column - top[1]) > 8.0)
        rest = robust_sigma(score[ring]) if np.count_nonzero(ring) > 20 else 1.0
        if score[top] > _ABOVE_RING * max(rest, 1.0):
            return float(top[0]), float(top[1])
        score = np.where(np.hypot(row - top[0], column - top[1]) > 4.0, score, 0.0)
    return None


def _told(bad: Mask, edges: Mask, fit: ScreenedFit, first: tuple[int, int]) -> list[Finding]:
    """What was found, in words; places count on the detector."""
    out = []
    full = [np.flatnonzero(bad.sum(axis=axis) > 0.5 * bad.shape[axis]) for axis in (0, 1)]
    along = np.zeros_like(bad)
    along[:, full[0]] = along[full[1]] = True
    single = int(np.count_nonzero(bad & ~along))
    if single:
        where = np.argwhere(bad & ~along)[:3] + first
        shown = ", ".join(f"({r}, {c})" for r, c in where)
        more = ", ..." if single > 3 else ""
        out.append(Finding("bad pixels", f"{single} hot, dead or otherwise off are left out: {shown}{more}"))
    for numbers, begin, name in zip(full, first[::-1], ("columns", "rows"), strict=True):
        if numbers.size:
            shown = ", ".join(map(str, numbers[:5] + begin))
            out.append(Finding(f"bad {name}", f"{shown}{', ...' * (numbers.size > 5)} are left out"))
    if fit.terms.background:
        what = "slopes" if fit.terms.background == 1 else "slopes and curvature"
        rise = float(np.ptp(fit.level[[0, 0, -1, -1], [0, -1, 0, -1]]))
        out.append(Finding("uneven background", f"its {what} are fitted, {rise:.2g} DN between the corners"))
    for (row, column, share), (_, _, sigma) in zip(fit.others, fit.others_sigma, strict=True):
        place = f"at row {row + first[0]:.1f}, column {column + first[1]:.1f}"
        light = f"{100.0 * abs(share):.2g} ± {100.0 * sigma:.1g} % of the light"
        what = "; it is fitted" if share > 0.0 else " is in the frames before and not here; it is fitted"
        out.append(Finding("second light", f"{place} with {light}{what}"))
    if np.any(edges):
        out.append(Finding("second light", "near the edge of the frames; what surrounds it is left out"))
    if fit.terms.smear:
        kept = not fit.terms.learnt
        rows, columns = (max(moment, 0.0) if kept else moment for moment in np.diagonal(fit.smear))
        text = f"{_rms(rows)} px in row and {_rms(columns)} px in column, rms, is fitted"
        out.append(Finding("smear", text if kept else f"{text}, against that before"))
    return out


def _rms(moment: float) -> str:
    """RMS width of a smear from its second moment, px^2; negative for a smear that is smaller than another."""
    return f"{math.copysign(math.sqrt(abs(moment)), moment):.2f}"
