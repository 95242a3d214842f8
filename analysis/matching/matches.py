"""Matching of templates in an image: search, least squares, thresholds, and rejection of mismatches.

**Consensus.** Displacements from predicted to measured positions vary smoothly over an image: they are a polynomial of
row and column, and optionally of height. Random minimal samples give candidates; the one with the smallest median
distance of all points starts (least median of squares, Rousseeuw 1984), then the scatter, the points within its limit
and their weighted fit are iterated until they do not change. Correct matches are lost at the false-alarm rate; a
mismatch remains if it lies within the limit by chance.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array, Mask, UndeterminedError
from analysis.matching.correlation import (
    MatchOptions,
    Reason,
    checked_image,
    checked_positions,
    checked_templates,
    search,
)
from analysis.matching.least_squares import least_squares
from analysis.matching.window_checks import FALSE_ALARM, risk

# Side of a JPEG block in pixels, and number of image lines in which blocks are sought.
_BLOCK, _BLOCK_LINES = 8, 512
_BLOCKY = 2.2
"""Ratio of grey-value steps at the borders of 8 x 8 compression blocks to those within blocks, above which matched
positions follow the blocks and not the scene. JPEG of quality 30 to 95 gives 1.0 to 2.0 if the texture passes and
sigmas are right, 2.3 to 4.3 if positions lock to whole pixels.
"""

EXPLAINED = 1e-9
"""Scatter of a consensus, in pixels, whose matches scatter as their covariances predict or less."""


@dataclass(frozen=True, eq=False)
class Matches:
    """Positions of n matched windows, with covariances and verdicts.

    Attributes
    ----------
    position : (n, 2) ndarray
        Row and column of the templates' middles in the image; NaN without a least squares fit.
    covariance : (n, 2, 2) ndarray
        Covariance from noise and displacements within the window, in px^2; see `analysis.matching.least_squares`.
    correlation : (n,) ndarray
        Correlation of the image with the fitted template, or of the search without a fit; NaN without either.
    ratio : (n,) ndarray
        Ratio of the second best to the best peak of the search.
    accepted : (n,) ndarray of bool
        True for accepted matches.
    reason : (n,) ndarray of int8
        Codes of `Reason`.
    """

    position: Array
    covariance: Array
    correlation: Array
    ratio: Array
    accepted: NDArray[np.bool_]
    reason: NDArray[np.int8]

    @property
    def sigma(self) -> Array:
        """Standard deviation of each of n positions along its worst direction, (n,), in pixels; NaN without a fit."""
        return _worst(self.covariance)

    @property
    def texts(self) -> tuple[str, ...]:
        """Descriptions of the verdicts on the n matches."""
        return tuple(Reason(int(code)).text for code in self.reason)

    @property
    def text(self) -> str:
        """Number of accepted matches and the reasons of the others, the most frequent first."""
        count = Counter(text for text in self.texts if text != Reason.ACCEPTED.text)
        parts = [f"{int(self.accepted.sum())} of {len(self.accepted)} accepted"]
        return "; ".join(parts + [f"{number} x {text}" for text, number in count.most_common()])


def match_windows(
    image: ArrayLike,
    templates: ArrayLike,
    predicted: ArrayLike,
    *,
    search_radius: int,
    options: MatchOptions | None = None,
) -> Matches:
    """Match windows of one image in another by cross-correlation and least squares, near predicted positions.

    Parameters
    ----------
    image : (H, W) array_like
        Image of H rows and W columns that is searched, of any real type.
    templates : (n, k, k) array_like
        Windows of the other image, n of them with k x k pixels, k odd, resampled to the geometry of `image`. NaN makes
        a point unusable.
    predicted : (n, 2) array_like
        Predicted row and column of the centre of each window in `image`, in pixels.
    search_radius : int
        Largest error of the prediction along rows and columns, in pixels.
    options : MatchOptions, optional
        Model and thresholds.

    Returns
    -------
    Matches
        Positions `position` (n, 2), their `covariance` (n, 2, 2), `accepted` (n,) and the reasons in `texts`.

    Raises
    ------
    ValueError
        Arrays of other shapes, a search radius out of range, or windows that are too small for their margin.

    Notes
    -----
    Gruen, S. Afr. J. Photogramm. 14, 175 (1985): an affine transformation of the window, offset and gain are unknown.
    The covariance includes the noise of both images and displacements that vary within the window.

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
    >>> matches = analysis.match_windows(second, windows, points, search_radius=3)
    >>> print(matches.text)
    7 of 7 accepted
    >>> np.round(np.mean(matches.position - points, axis=0), 2)
    array([ 0.3, -0.7])
    >>> bool(matches.sigma.max() < 0.05)
    True
    """
    plane = checked_image(image, "match windows")
    windows = checked_templates(templates, "match windows")
    expected = checked_positions(predicted, len(windows), "match windows")
    limits = options or MatchOptions()
    peaks = search(plane, windows, expected, search_radius)
    fits = least_squares(plane, windows, peaks.position, limits)
    # points without a peak have no start position, which the fit reports as a bad template
    reason = np.where(peaks.reason != 0, peaks.reason, fits.reason).astype(np.int8)
    weak = np.where(np.isfinite(fits.correlation), fits.correlation, peaks.value) < limits.least_correlation
    reason[_open(reason) & weak] = Reason.WEAK
    reason[(reason == 0) & (peaks.ratio > limits.largest_ratio)] = Reason.AMBIGUOUS
    good = reason == Reason.ACCEPTED
    noise, relief = fits.covariances(good)
    covariance = noise + relief
    # NaN compares false
    reason[(reason == 0) & ~(_worst(noise) <= limits.largest_sigma)] = Reason.UNCERTAIN
    reason[(reason == 0) & ~(_worst(covariance) <= limits.largest_sigma)] = Reason.RELIEF
    # windows that template noise makes undetermined still count in the share of windows with steps
    silent = good & ~np.isfinite(_worst(noise))
    reason = _without_steps(reason, silent, *fits.steps(good), limits)
    reason[_open(reason) & (reason != 0) & (fits.contrast < limits.least_contrast)] = Reason.FLAT
    if _block_ratio(plane) > _BLOCKY:
        reason[_open(reason)] = Reason.BLOCKS
    return Matches(
        position=fits.position,
        covariance=covariance,
        correlation=np.where(np.isfinite(fits.correlation), fits.correlation, peaks.value),
        ratio=peaks.ratio,
        accepted=reason == Reason.ACCEPTED,
        reason=reason,
    )


def _block_ratio(plane: NDArray[np.generic]) -> float:
    """Return the ratio of grey-value steps at the borders of 8 x 8 pixel compression blocks to those within blocks.

    The ratio is about 1 if no compression has cut the image into blocks. It uses, for each of the eight positions
    within a block, the median over all such steps of their mean sizes over up to 512 lines, so that stripes of the
    scene count little, and is the smaller of both directions.
    """
    ratios = []
    for lines in (plane, plane.T):
        size = np.abs(np.diff(lines[:: max(len(lines) // _BLOCK_LINES, 1)].astype(np.float64), axis=1))
        finite = np.isfinite(size)
        mean = np.where(finite, size, 0.0).sum(axis=0)[finite.any(axis=0)] / finite.sum(axis=0)[finite.any(axis=0)]
        if len(mean) < 5 * _BLOCK:
            return 1.0
        phases = np.array([np.median(mean[k::_BLOCK]) for k in range(_BLOCK)])
        ratios.append(float(phases.max() / max(float(np.median(phases)), 1e-300)))
    return min(ratios)


def _without_steps(
    reason: NDArray[np.int8], silent: NDArray[np.bool_], p_value: Array, power: Array, options: MatchOptions
) -> NDArray[np.int8]:
    """Return the verdicts after the test for displacement steps within windows.

    Verdicts of the windows in the mask `silent`, whose covariance is unknown, stay unchanged; they only count in the
    fraction of windows that fail the test.
    """
    tested = reason == Reason.ACCEPTED
    # NaN compares false
    step = tested & ~(p_value >= FALSE_ALARM)
    counted = tested | silent
    share = float(np.sum(step | (silent & (p_value < FALSE_ALARM)))) / max(int(counted.sum()), 1)
    weak = tested & ~step & ~(risk(share, power) <= options.largest_risk)
    return np.where(step, Reason.RELIEF, np.where(weak, Reason.UNTESTED, reason)).astype(np.int8)


def _open(reason: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Return a mask of the windows for which a fit was tried, whose verdicts a later test may replace."""
    return (reason == Reason.ACCEPTED) | (reason >= Reason.BORDER)


def _worst(covariance: Array) -> Array:
    """Return the standard deviations along the worst direction, (n,), of n covariances (n, 2, 2)."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    return np.asarray(np.sqrt(0.5 * (a + c) + np.hypot(0.5 * (a - c), b)))


# Probability of drawing no sample free of mismatches, for the share of mismatches _WRONG.
_MISSED, _WRONG = 1e-6, 0.45
_MOST_SAMPLES = 8000
"""Largest number of random minimal samples of points in the search for a consensus."""
_VALUES = 2_000_000
"""Number of distances of points from candidate displacement fields that are held in memory at once."""
_MEDIAN = 2.0 * math.log(2.0)
"""Median of the chi-square distribution with two degrees of freedom."""
_ROUNDS = 50
"""Largest number of iterations of selecting and fitting the points of a consensus."""


@dataclass(frozen=True, eq=False)
class DisplacementField:
    """Displacement in an image as a polynomial of row and column and, optionally, a linear function of height.

    Attributes
    ----------
    coefficients : (terms, 2) ndarray
        Coefficients for rows and columns, in pixels: monomials of the scaled position by rising degree, then height.
    middle : (2,) ndarray
        Position of the scaled origin, in pixels.
    scale : float
        Position difference of scaled length 1, in pixels.
    degree : int
        Degree of the polynomial of row and column.
    heights : tuple of float or None
        Mean and scale of the heights; None without a height term.
    """

    coefficients: Array
    middle: Array
    scale: float
    degree: int
    heights: tuple[float, float] | None

    def __call__(self, position: ArrayLike, height: ArrayLike | None = None) -> Array:
        """Return the displacements at n positions (n, 2) and heights (n,), as (n, 2), in pixels.

        Raises
        ------
        ValueError
            Heights are present although the fit had none, or missing although it had some.
        """
        positions = checked_positions(position, None, "displacement field")
        if (height is None) != (self.heights is None):
            raise ValueError("displacement field: give heights if, and only if, the fit had them")
        return _terms(positions, height, self) @ self.coefficients


@dataclass(frozen=True, eq=False)
class Consensus:
    """Selection of those of n matches that agree with one displacement field.

    Attributes
    ----------
    accepted : (n,) ndarray of bool
        True for matches that agree; all False without a consensus.
    field : DisplacementField
        Displacement fitted to the accepted matches, or the best candidate.
    distance : (n,) ndarray
        Distance of each match from the field, relative to its standard deviation; NaN where the match is not finite.
    scatter : float
        Scatter along each axis beyond the given covariances, in pixels; the total scatter without covariances.
    limit : float
        Largest accepted `distance`, in standard deviations.
    text : str
        Description of the outcome.
    """

    accepted: Mask
    field: DisplacementField
    distance: Array
    scatter: float
    limit: float
    text: str


def consensus(
    predicted: ArrayLike,
    matched: ArrayLike,
    *,
    covariance: ArrayLike | None = None,
    height: ArrayLike | None = None,
    degree: int = 2,
    false_alarm: float = 1e-3,
    largest_scatter: float = 2.0,
) -> Consensus:
    """Reject wrong matches: those that do not follow one displacement field that is smooth over the image.

    The displacement is a polynomial of row and column, found by least median of squares.

    Parameters
    ----------
    predicted : (n, 2) array_like
        Predicted rows and columns of n points, in pixels.
    matched : (n, 2) array_like
        Matched rows and columns, in pixels; rows with NaN are ignored.
    covariance : (n, 2, 2) array_like, optional
        Covariances of the matched positions, px^2. The resulting `scatter` is then that in addition to these
        covariances.
    height : (n,) array_like, optional
        Heights of the points, in any unit. They add a term for the parallax that an unknown tilt leaves.
    degree : int
        Degree of the polynomial in row and column together, 0 to 3.
    false_alarm : float
        Fraction of correct matches that is rejected by chance, for normal errors.
    largest_scatter : float
        Largest scatter of a consensus, in pixels. Unrelated matches over a search window scatter by a third of its
        radius.

    Returns
    -------
    Consensus
        `accepted` (n,), the displacement `field`, the `distance` of each match from it, and the `scatter`.

    Raises
    ------
    ValueError
        Arrays of other shapes, too few points (two for each term, at least five), or a degree or rate out of range.

    Notes
    -----
    Rousseeuw, J. Am. Stat. Assoc. 79, 871 (1984).

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
    start = checked_positions(predicted, None, "consensus")
    to = checked_positions(matched, len(start), "consensus")
    if not (0 <= degree <= 3 and 0 < false_alarm < 0.5 and largest_scatter > 0):
        raise ValueError(
            f"consensus: need a degree of 0 to 3, a false alarm rate below 0.5 and a positive largest scatter; found "
            f"{degree}, {false_alarm}, {largest_scatter}"
        )
    spread = np.zeros((len(start), 2, 2)) if covariance is None else np.asarray(covariance, np.float64)
    heights = None if height is None else np.asarray(height, np.float64)
    if spread.shape != (len(start), 2, 2) or (heights is not None and heights.shape != (len(start),)):
        raise ValueError(
            f"consensus: {len(start)} points need covariances ({len(start)}, 2, 2) and heights ({len(start)},), found "
            f"{spread.shape} and {None if heights is None else heights.shape}"
        )
    usable = np.isfinite(start).all(axis=1) & np.isfinite(to).all(axis=1) & np.isfinite(spread).all(axis=(1, 2))
    usable &= True if heights is None else np.isfinite(heights)
    terms = (degree + 1) * (degree + 2) // 2 + (heights is not None)
    if usable.sum() < max(2 * terms, 5):
        raise UndeterminedError(
            f"consensus: {int(usable.sum())} usable matches are too few for {terms} terms; need {max(2 * terms, 5)}: "
            "match more points or lower the degree"
        )
    used_heights = heights[usable] if heights is not None else None
    empty = _unfitted_field(start[usable], used_heights, degree, terms)
    design, displacement, noise = _terms(start[usable], used_heights, empty), (to - start)[usable], spread[usable]
    limit = math.sqrt(-2.0 * math.log(false_alarm))
    coefficients = _best_candidate(design, displacement, np.random.default_rng(0))
    inside, coefficients, scatter, distance = _converged(design, displacement, noise, coefficients, limit)
    accepted, apart = np.zeros(len(start), bool), np.full(len(start), np.nan)
    accepted[usable], apart[usable] = inside, distance
    beyond = f"scatter {scatter:.3g} px" if scatter > EXPLAINED else "no scatter beyond their covariances"
    share = f"{int(inside.sum())} of {int(usable.sum())} matches agree within {limit:.1f} sigma ({beyond})"
    if scatter > largest_scatter or inside.sum() < max(2 * terms, 5):
        accepted[:] = False
        share = f"no consensus: {share}, at most {largest_scatter:g} px allowed; improve prediction or matches"
    field = DisplacementField(coefficients, empty.middle, empty.scale, degree, empty.heights)
    return Consensus(accepted, field, apart, scatter, limit, share)


def _unfitted_field(positions: Array, height: Array | None, degree: int, terms: int) -> DisplacementField:
    """Return a displacement field with zero coefficients, scaled to the points."""
    middle = 0.5 * (positions.min(axis=0) + positions.max(axis=0))
    scale = max(float(np.abs(positions - middle).max()), 1.0)
    heights = None if height is None else (float(height.mean()), max(float(height.std()), 1e-9))
    return DisplacementField(np.zeros((terms, 2)), middle, scale, degree, heights)


def _terms(positions: Array, height: ArrayLike | None, field: DisplacementField) -> Array:
    """Return the polynomial terms of a displacement field at n points, (n, terms)."""
    row, column = ((positions - field.middle) / field.scale).T
    powers = [row ** (total - k) * column**k for total in range(field.degree + 1) for k in range(total + 1)]
    if field.heights is not None:
        powers.append((np.asarray(height, np.float64) - field.heights[0]) / field.heights[1])
    return np.stack(powers, axis=1)


def _best_candidate(design: Array, displacement: Array, rng: np.random.Generator) -> Array:
    """Return the coefficients fitted to the random minimal sample with the smallest median distance of all points."""
    count, terms = design.shape
    samples = min(_MOST_SAMPLES, math.ceil(math.log(_MISSED) / math.log1p(-((1.0 - _WRONG) ** terms))))
    best, least = np.zeros((terms, 2)), np.inf
    batch = max(1, _VALUES // (2 * count))
    for first in range(0, samples, batch):
        which = rng.random((min(batch, samples - first), count)).argpartition(terms - 1, axis=1)[:, :terms]
        matrix = design[which]
        # points on a line leave some terms undetermined; the ridge sets them nearly to zero
        square = np.swapaxes(matrix, 1, 2) @ matrix + 1e-10 * np.eye(terms)
        candidate = np.linalg.solve(square, np.swapaxes(matrix, 1, 2) @ displacement[which])
        residual = displacement - design @ candidate
        medians = np.median(np.einsum("snk,snk->sn", residual, residual), axis=1)
        k = int(np.argmin(medians))
        if medians[k] < least:
            best, least = candidate[k], float(medians[k])
    return best


def _converged(
    design: Array, displacement: Array, noise: Array, coefficients: Array, limit: float
) -> tuple[Mask, Array, float, Array]:
    """Iterate selection and weighted fit until the accepted points stay the same, and return the result.

    Returned are the accepted points, coefficients, scatter beyond the noise in pixels, and normalised distances.
    """
    inside = np.ones(len(displacement), bool)
    for round_number in range(_ROUNDS):
        residual = displacement - design @ coefficients
        scatter = _scatter(residual[inside], noise[inside])
        distance = np.sqrt(_square(residual, noise, scatter))
        before, inside = inside, distance < limit
        # the first round only selects the points near the candidate
        if inside.sum() < design.shape[1] or (round_number and np.array_equal(before, inside)):
            break
        weight = 1.0 / np.sqrt(0.5 * np.trace(noise, axis1=1, axis2=2) + scatter**2)[inside, None]
        coefficients = np.linalg.lstsq(weight * design[inside], weight * displacement[inside], rcond=None)[0]
    return inside, coefficients, scatter, distance


def _square(residual: Array, noise: Array, scatter: float) -> Array:
    """Return the squared residuals of n points, normalised by the sum of noise covariance and scatter."""
    total = noise + scatter**2 * np.eye(2)
    a, b, c = total[:, 0, 0], total[:, 0, 1], total[:, 1, 1]
    row, column = residual.T
    return np.asarray((c * row**2 - 2.0 * b * row * column + a * column**2) / np.maximum(a * c - b * b, 1e-300))


def _scatter(residual: Array, noise: Array) -> float:
    """Return the isotropic scatter, in pixels, beyond the noise covariances, from the median squared residual.

    It brings the median normalised square to that of a chi-square with two degrees of freedom.
    """
    high = math.sqrt(max(float(np.median(np.sum(residual**2, axis=1))) / _MEDIAN, 1e-18))
    if np.median(_square(residual, noise, EXPLAINED)) <= _MEDIAN:
        return EXPLAINED
    low = 0.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.median(_square(residual, noise, middle)) > _MEDIAN else (low, middle)
    return high
