"""Matching of templates in an image: search, least squares, thresholds.

Rejection of wrong matches: the way from predicted to found places varies smoothly over an image.

Displacements are a polynomial of row and column, and optionally of height. Random minimal samples give candidates; the
one with the least median distance of all points starts (least median of squares, Rousseeuw 1984), then the scatter,
the points within its limit and their weighted fit are repeated until they stand. Right matches are lost at the false
alarm rate; a wrong one stays if it lies in the limit by chance.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array, Mask, UndeterminedError
from analysis.matching.correlation import MatchOptions, Reason, checked_image, checked_places, checked_templates, search
from analysis.matching.least_squares import least_squares
from analysis.matching.window_checks import FALSE_ALARM, risk

# Side of a block of a JPEG file, px, and lines of an image in which its blocks are looked for.
_BLOCK, _BLOCK_LINES = 8, 512
# Ratio of steps between blocks to those within from which places are those of the blocks. JPEG of quality 30 to 95: 1.0
# to 2.0 where the texture passes and sigmas hold, 2.3 to 4.3 where places lock to whole pixels.
_BLOCKY = 2.2


@dataclass(frozen=True, eq=False)
class Matches:
    """Matched points.

    Attributes
    ----------
    place : Array
        (n, 2) row and column of the templates' middles in the image; NaN where least squares matching gave none.
    covariance : Array
        (n, 2, 2) px^2, of noise and of displacements within the window; see `analysis.matching.least_squares`.
    correlation : Array
        (n,) of the image with the fitted template; of the search where there is no fit; NaN if neither.
    ratio : Array
        (n,) second best to best peak of the search.
    accepted : NDArray[np.bool_]
        (n,) bool.
    reason : NDArray[np.int8]
        (n,) codes of `Reason`.
    """

    place: Array
    covariance: Array
    correlation: Array
    ratio: Array
    accepted: NDArray[np.bool_]
    reason: NDArray[np.int8]

    @property
    def sigma(self) -> Array:
        """(n,) standard deviation along the worst direction, px; NaN without a fit."""
        return _worst(self.covariance)

    @property
    def texts(self) -> tuple[str, ...]:
        """(n,) reasons in words."""
        return tuple(Reason(int(code)).text for code in self.reason)

    @property
    def text(self) -> str:
        """How many were accepted, and why the others were not, the most frequent reason first."""
        count = Counter(text for text in self.texts if text != Reason.ACCEPTED.text)
        parts = [f"{int(self.accepted.sum())} of {len(self.accepted)} accepted"]
        return "; ".join(parts + [f"{number} x {text}" for text, number in count.most_common()])


def match_windows(
    image: ArrayLike, templates: ArrayLike, predicted: ArrayLike, *, reach: int, options: MatchOptions | None = None
) -> Matches:
    """Find templates in an image, each near its predicted place.

    Parameters
    ----------
    image : ArrayLike
        (H, W), any real type.
    templates : ArrayLike
        (n, k, k), k odd, resampled into the image's geometry (`resampled`); NaN makes a point unusable.
    predicted : ArrayLike
        (n, 2) row and column at which their middles are expected.
    reach : int
        How far the prediction may be off along rows and columns, px.
    options : MatchOptions | None
        Model and thresholds.

    Raises
    ------
    ValueError
        Wrong shapes, reach out of range, a template too small for its margin.

    Examples
    --------
    Two images of one texture, the second shifted by (0.3, -0.7) px:

    >>> import numpy as np
    >>> from scipy.ndimage import fourier_shift, gaussian_filter
    >>> import analysis
    >>> rng = np.random.default_rng(4)
    >>> first = 1000 + 800 * gaussian_filter(rng.standard_normal((200, 200)), 2.0, mode="wrap")
    >>> second = np.fft.ifft2(fourier_shift(np.fft.fft2(first), (0.3, -0.7))).real
    >>> first, second = (image + 2 * rng.standard_normal(image.shape) for image in (first, second))
    >>> points = np.rint(analysis.distinct_points(first, 9, spacing=30, border=30)).astype(int)
    >>> windows = np.stack([first[r - 15 : r + 16, c - 15 : c + 16] for r, c in points])
    >>> matches = analysis.match_windows(second, windows, points, reach=3)
    >>> print(matches.text)
    7 of 7 accepted
    >>> np.round(np.mean(matches.place - points, axis=0), 2)
    array([ 0.3, -0.7])
    >>> bool(matches.sigma.max() < 0.05)
    True
    """
    plane = checked_image(image, "match windows")
    patch = checked_templates(templates, "match windows")
    expected = checked_places(predicted, len(patch), "match windows")
    chosen = options or MatchOptions()
    peaks = search(plane, patch, expected, reach)
    fits = least_squares(plane, patch, peaks.place, chosen)
    # points without a peak have no start, which the fit calls a bad template
    reason = np.where(peaks.reason != 0, peaks.reason, fits.reason).astype(np.int8)
    weak = np.where(np.isfinite(fits.correlation), fits.correlation, peaks.value) < chosen.least_correlation
    reason[_open(reason) & weak] = Reason.WEAK
    reason[(reason == 0) & (peaks.ratio > chosen.largest_ratio)] = Reason.AMBIGUOUS
    good = reason == Reason.ACCEPTED
    noise, relief = fits.covariances(good)
    covariance = noise + relief
    # NaN compares false
    reason[(reason == 0) & ~(_worst(noise) <= chosen.largest_sigma)] = Reason.UNCERTAIN
    reason[(reason == 0) & ~(_worst(covariance) <= chosen.largest_sigma)] = Reason.RELIEF
    # windows that noise of the template makes unknown still tell whether windows here have steps
    silent = good & ~np.isfinite(_worst(noise))
    reason = _without_steps(reason, silent, *fits.steps(good), chosen)
    reason[_open(reason) & (reason != 0) & (fits.contrast < chosen.least_contrast)] = Reason.FLAT
    if _block_ratio(plane) > _BLOCKY:
        reason[_open(reason)] = Reason.BLOCKS
    return Matches(
        place=fits.place,
        covariance=covariance,
        correlation=np.where(np.isfinite(fits.correlation), fits.correlation, peaks.value),
        ratio=peaks.ratio,
        accepted=reason == Reason.ACCEPTED,
        reason=reason,
    )


def _block_ratio(plane: NDArray[np.generic]) -> float:
    """Return how much larger steps between neighbours are at one in eight of them, along rows and columns: about 1
    where no compression has cut the image into blocks.

    The median over all steps of a phase, of their mean sizes over up to 512 lines, so that stripes of the scene count
    little; the smaller ratio of the two directions.
    """
    ratios = []
    for lines in (plane, plane.T):
        size = np.abs(np.diff(lines[:: max(len(lines) // _BLOCK_LINES, 1)].astype(np.float64), axis=1))
        seen = np.isfinite(size)
        mean = np.where(seen, size, 0.0).sum(axis=0)[seen.any(axis=0)] / seen.sum(axis=0)[seen.any(axis=0)]
        if len(mean) < 5 * _BLOCK:
            return 1.0
        phases = np.array([np.median(mean[k::_BLOCK]) for k in range(_BLOCK)])
        ratios.append(float(phases.max() / max(float(np.median(phases)), 1e-300)))
    return min(ratios)


def _without_steps(
    reason: NDArray[np.int8], silent: NDArray[np.bool_], chance: Array, power: Array, options: MatchOptions
) -> NDArray[np.int8]:
    """Verdicts after the test for steps of the displacement within windows; the silent are only counted."""
    tested = reason == Reason.ACCEPTED
    # NaN compares false
    step = tested & ~(chance >= FALSE_ALARM)
    counted = tested | silent
    share = float(np.sum(step | (silent & (chance < FALSE_ALARM)))) / max(int(counted.sum()), 1)
    weak = tested & ~step & ~(risk(share, power) <= options.largest_risk)
    return np.where(step, Reason.RELIEF, np.where(weak, Reason.UNTESTED, reason)).astype(np.int8)


def _open(reason: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Verdicts that another one may explain better: fitted, or tried to."""
    return (reason == Reason.ACCEPTED) | (reason >= Reason.BORDER)


def _worst(covariance: Array) -> Array:
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    return np.asarray(np.sqrt(0.5 * (a + c) + np.hypot(0.5 * (a - c), b)))


# Of missing every all-right sample while this share is wrong.
_MISSED, _WRONG = 1e-6, 0.45
_MOST_SAMPLES = 8000
# Values of candidates' distances that are held at once.
_VALUES = 2_000_000
# Median of chi-square with two degrees of freedom.
_MEDIAN = 2.0 * math.log(2.0)
_ROUNDS = 50


@dataclass(frozen=True, eq=False)
class DisplacementField:
    """Polynomial displacement.

    Attributes
    ----------
    coefficients : Array
        (terms, 2) of rows and columns, px: monomials of the scaled place by rising degree, then height.
    middle : Array
        (2,) place that is 0, px.
    scale : float
        Place difference that is 1, px.
    degree : int
        Of the polynomial of row and column.
    heights : tuple[float, float] | None
        Mean and scale of height, or None without it.
    """

    coefficients: Array
    middle: Array
    scale: float
    degree: int
    heights: tuple[float, float] | None

    def __call__(self, place: ArrayLike, height: ArrayLike | None = None) -> Array:
        """Displacement (n, 2), px, at places (n, 2) and heights (n,).

        Raises
        ------
        ValueError
            Heights given or missing against the fit.
        """
        at = checked_places(place, None, "displacement field")
        if (height is None) != (self.heights is None):
            raise ValueError("displacement field: give heights exactly if the fit had them")
        return _terms(at, height, self) @ self.coefficients


@dataclass(frozen=True, eq=False)
class Consensus:
    """Which matches agree.

    Attributes
    ----------
    accepted : Mask
        (n,) bool; none if there is no consensus.
    field : DisplacementField
        The fitted displacement of the accepted, or the best candidate.
    distance : Array
        (n,) residual over its standard deviation; NaN where the match is not finite.
    scatter : float
        Px along each axis, of the field beyond the covariances given; in all without them.
    limit : float
        Of distance.
    text : str
        The outcome in words.
    """

    accepted: Mask
    field: DisplacementField
    distance: Array
    scatter: float
    limit: float
    text: str


def consensus(
    predicted: ArrayLike,
    found: ArrayLike,
    *,
    covariance: ArrayLike | None = None,
    height: ArrayLike | None = None,
    degree: int = 2,
    false_alarm: float = 1e-3,
    largest_scatter: float = 2.0,
) -> Consensus:
    """Matches that follow one smooth displacement.

    Parameters
    ----------
    predicted : ArrayLike
        (n, 2) row and column; and found: (n, 2), NaN rows take no part.
    found : ArrayLike
        (n, 2).
    covariance : ArrayLike | None
        (n, 2, 2) px^2 of found; the scatter is then what the field needs beyond them.
    height : ArrayLike | None
        (n,) of points, any unit; adds a term for what parallax an unknown tilt leaves.
    degree : int
        0 to 3 of the polynomial in row and column together.
    false_alarm : float
        Share of right matches that may be lost (normal errors).
    largest_scatter : float
        Px; above it there is no consensus: unrelated matches over a search window scatter by a third of its reach.

    Raises
    ------
    ValueError
        Shapes, too few points (two a term, five at least), degree or rates out of range.

    Examples
    --------
    Forty matches with a scale error of 1 %, of which four are wrong by up to 20 px:

    >>> import numpy as np
    >>> import analysis
    >>> rng = np.random.default_rng(5)
    >>> predicted = rng.uniform(0, 1000, (40, 2))
    >>> found = 1.01 * predicted + 0.1 * rng.standard_normal((40, 2))
    >>> found[:4] += [[20, 0], [-15, 5], [8, 8], [0, -12]]
    >>> agreed = analysis.consensus(predicted, found, degree=1)
    >>> np.flatnonzero(~agreed.accepted)
    array([0, 1, 2, 3])
    >>> round(agreed.scatter, 2)
    0.09
    """
    place = checked_places(predicted, None, "consensus")
    to = checked_places(found, len(place), "consensus")
    if not (0 <= degree <= 3 and 0 < false_alarm < 0.5 and largest_scatter > 0):
        raise ValueError(
            f"consensus: need a degree of 0 to 3, a false alarm rate below 0.5 and a positive largest scatter; found "
            f"{degree}, {false_alarm}, {largest_scatter}"
        )
    spread = np.zeros((len(place), 2, 2)) if covariance is None else np.asarray(covariance, np.float64)
    heights = None if height is None else np.asarray(height, np.float64)
    if spread.shape != (len(place), 2, 2) or (heights is not None and heights.shape != (len(place),)):
        raise ValueError(
            f"consensus: {len(place)} points need covariances ({len(place)}, 2, 2) and heights ({len(place)},), found "
            f"{spread.shape} and {None if heights is None else heights.shape}"
        )
    usable = np.isfinite(place).all(axis=1) & np.isfinite(to).all(axis=1) & np.isfinite(spread).all(axis=(1, 2))
    usable &= True if heights is None else np.isfinite(heights)
    terms = (degree + 1) * (degree + 2) // 2 + (heights is not None)
    if usable.sum() < max(2 * terms, 5):
        raise UndeterminedError(
            f"consensus: {int(usable.sum())} usable matches do not carry {terms} terms; need {max(2 * terms, 5)}: "
            "match more points or lower the degree"
        )
    given = heights[usable] if heights is not None else None
    empty = _empty(place[usable], given, degree, terms)
    design, way, noise = _terms(place[usable], given, empty), (to - place)[usable], spread[usable]
    limit = math.sqrt(-2.0 * math.log(false_alarm))
    coefficients = _best_candidate(design, way, np.random.default_rng(0))
    inside, coefficients, scatter, distance = _settled(design, way, noise, coefficients, limit)
    accepted, apart = np.zeros(len(place), bool), np.full(len(place), np.nan)
    accepted[usable], apart[usable] = inside, distance
    share = f"{int(inside.sum())} of {int(usable.sum())} matches agree within {limit:.1f} sigma of {scatter:.3g} px"
    if scatter > largest_scatter or inside.sum() < max(2 * terms, 5):
        accepted[:] = False
        share = f"no consensus: {share}, at most {largest_scatter:g} px allowed; improve prediction or matches"
    field = DisplacementField(coefficients, empty.middle, empty.scale, degree, empty.heights)
    return Consensus(accepted, field, apart, scatter, limit, share)


def _empty(place: Array, height: Array | None, degree: int, terms: int) -> DisplacementField:
    middle = 0.5 * (place.min(axis=0) + place.max(axis=0))
    scale = max(float(np.abs(place - middle).max()), 1.0)
    heights = None if height is None else (float(height.mean()), max(float(height.std()), 1e-9))
    return DisplacementField(np.zeros((terms, 2)), middle, scale, degree, heights)


def _terms(place: Array, height: ArrayLike | None, field: DisplacementField) -> Array:
    row, column = ((place - field.middle) / field.scale).T
    powers = [row ** (total - k) * column**k for total in range(field.degree + 1) for k in range(total + 1)]
    if field.heights is not None:
        powers.append((np.asarray(height, np.float64) - field.heights[0]) / field.heights[1])
    return np.stack(powers, axis=1)


def _best_candidate(design: Array, way: Array, rng: np.random.Generator) -> Array:
    """Through the minimal sample with the least median distance of all points."""
    count, terms = design.shape
    samples = min(_MOST_SAMPLES, math.ceil(math.log(_MISSED) / math.log1p(-((1.0 - _WRONG) ** terms))))
    best, least = np.zeros((terms, 2)), np.inf
    batch = max(1, _VALUES // (2 * count))
    for first in range(0, samples, batch):
        which = rng.random((min(batch, samples - first), count)).argpartition(terms - 1, axis=1)[:, :terms]
        matrix = design[which]
        # lstsq-like: points on a line leave some terms open, which a ridge sets to next to nothing
        square = np.swapaxes(matrix, 1, 2) @ matrix + 1e-10 * np.eye(terms)
        candidate = np.linalg.solve(square, np.swapaxes(matrix, 1, 2) @ way[which])
        rest = way - design @ candidate
        middle = np.median(np.einsum("snk,snk->sn", rest, rest), axis=1)
        k = int(np.argmin(middle))
        if middle[k] < least:
            best, least = candidate[k], float(middle[k])
    return best


def _settled(
    design: Array, way: Array, noise: Array, coefficients: Array, limit: float
) -> tuple[Mask, Array, float, Array]:
    """Accepted points, their fit, the scatter beyond noise and distances, once they do not change any more."""
    inside = np.ones(len(way), bool)
    for turn in range(_ROUNDS):
        rest = way - design @ coefficients
        scatter = _scatter(rest[inside], noise[inside])
        distance = np.sqrt(_square(rest, noise, scatter))
        before, inside = inside, distance < limit
        # the first round only replaces all points by those near the candidate
        if inside.sum() < design.shape[1] or (turn and np.array_equal(before, inside)):
            break
        weight = 1.0 / np.sqrt(0.5 * np.trace(noise, axis1=1, axis2=2) + scatter**2)[inside, None]
        coefficients = np.linalg.lstsq(weight * design[inside], weight * way[inside], rcond=None)[0]
    return inside, coefficients, scatter, distance


def _square(rest: Array, noise: Array, scatter: float) -> Array:
    whole = noise + scatter**2 * np.eye(2)
    a, b, c = whole[:, 0, 0], whole[:, 0, 1], whole[:, 1, 1]
    row, column = rest.T
    return np.asarray((c * row**2 - 2.0 * b * row * column + a * column**2) / np.maximum(a * c - b * b, 1e-300))


def _scatter(rest: Array, noise: Array) -> float:
    """Isotropic standard deviation beyond noise that brings the median square distance to that of chi-square."""
    high = math.sqrt(max(float(np.median(np.sum(rest**2, axis=1))) / _MEDIAN, 1e-18))
    if np.median(_square(rest, noise, 1e-9)) <= _MEDIAN:
        return 1e-9
    low = 0.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.median(_square(rest, noise, middle)) > _MEDIAN else (low, middle)
    return high
