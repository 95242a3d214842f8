"""Orientation of a measured wavefront, and Zernike fits of a map over an illuminated area of any shape.

**Fit.** Terms are made orthonormal over the illuminated pixels, in Noll's order: over a ring these are Mahajan's
annular terms up to the pixels, and the equivalent over a vignetted pupil. Coefficients of the circular terms follow
from them; where light is missing, terms that look alike there share the measured aberration.

**Orientation.** Flips, rotations by 90 degrees and the sign of a measured wavefront, and which of these agree with
predicted coefficients.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array, UndeterminedError
from analysis.statistics import p_value_of
from analysis.wavefront_maps.map_files import MapError, WavefrontMap
from analysis.wavefront_maps.zernike_table import circle_terms, noll_to_nm
from optics.numerics.arguments import check_fields

_ORIENTATION_NAMES = {
    (False, 0): "as it is",
    (False, 1): "turned 90",
    (False, 2): "turned 180",
    (False, 3): "turned 270",
    (True, 0): "mirrored y",
    (True, 1): "mirrored diagonal",
    (True, 2): "mirrored x",
    (True, 3): "mirrored antidiagonal",
}
"""Name of each orientation of a map, by (mirrored, number of rotations by 90 degrees)."""
_COSINE = (1, 0, -1, 0)
"""Cosine of 0, 90, 180 and 270 degrees, as exact integers."""


@dataclass(frozen=True)
class Orientation:
    """Operation that brings a map into the orientation of the user's pupil: a mirror, then rotations, and a sign.

    Attributes
    ----------
    mirrored : bool
        True if y is reversed first.
    quarter_turns : int
        Number of rotations by 90 degrees, from x to y, 0 to 3.
    sign : int
        Factor of the values, +1 or -1.
    """

    mirrored: bool = False
    quarter_turns: int = 0
    sign: int = 1

    def __post_init__(self) -> None:
        if self.quarter_turns not in range(4) or self.sign not in (1, -1):
            raise ValueError(f"quarter_turns must be 0 to 3, sign +1 or -1, got {self.quarter_turns} and {self.sign}")

    @classmethod
    def named(cls, name: str, sign: int = 1) -> Orientation:
        """Return the orientation with a given name and sign.

        Parameters
        ----------
        name : str
            Name of one of ``ORIENTATIONS``, such as ``turned 90``.
        sign : int
            +1 or -1.

        Raises
        ------
        MapError
            The name is unknown.
        """
        for key, known in _ORIENTATION_NAMES.items():
            if known == name.strip().lower():
                return cls(*key, sign)
        raise MapError(f"there is no orientation {name[:40]!r}; {', '.join(_ORIENTATION_NAMES.values())} are known")

    @property
    def name(self) -> str:
        """Name of the orientation, without its sign."""
        return _ORIENTATION_NAMES[self.mirrored, self.quarter_turns]

    @property
    def matrix(self) -> NDArray[np.int_]:
        """Matrix (2, 2) of the operation: a feature at the point p = (x, y) moves to ``matrix @ p``."""
        c, s = _COSINE[self.quarter_turns], _COSINE[(self.quarter_turns + 3) % 4]
        return np.array([[c, -s], [s, c]]) @ np.diag([1, -1 if self.mirrored else 1])

    @property
    def inverse(self) -> Orientation:
        """Inverse operation; a mirror is its own inverse."""
        quarters = self.quarter_turns if self.mirrored else -self.quarter_turns % 4
        return Orientation(self.mirrored, quarters, self.sign)

    def __str__(self) -> str:
        return self.name if self.sign > 0 else f"{self.name}, sign inverted"

    def values(self, values: Array) -> Array:
        """Return an array of map values after mirror, rotations and sign change.

        Parameters
        ----------
        values : (rows, columns) ndarray
            Values, y growing with the row.
        """
        flipped = values[::-1] if self.mirrored else values
        # rows grow upwards: what NumPy calls clockwise is from x to y
        return self.sign * np.rot90(flipped, -self.quarter_turns)

    def apply(self, measured: WavefrontMap) -> WavefrontMap:
        """Return a wavefront map after mirror, rotations and sign change.

        Parameters
        ----------
        measured : WavefrontMap
            Map with the orientation of the file.
        """
        return replace(measured, values=self.values(measured.values))

    def term_matrix(self, terms: Sequence[int]) -> Array:
        """Return the (Z, Z) matrix, with entries 0, 1 and -1, that transforms Zernike coefficients.

        Parameters
        ----------
        terms : sequence of int
            Noll's indices of the Z terms, with both the cosine and the sine term of every azimuthal order.

        Raises
        ------
        MapError
            A term lacks its partner, into which it rotates.
        """
        positions = {int(index): k for k, index in enumerate(terms)}
        orders = {noll_to_nm(index): k for index, k in positions.items()}
        matrix = np.zeros((len(positions), len(positions)))
        for (n, m), k in orders.items():
            # the original map is evaluated at the angle s (angle - rotation)
            c, s = _COSINE[abs(m) * self.quarter_turns % 4], _COSINE[(abs(m) * self.quarter_turns + 3) % 4]
            unchanged, rotated = (-c if self.mirrored and m < 0 else c), (-s if self.mirrored and m < 0 else s)
            matrix[k, k] = unchanged
            if rotated:
                partner = orders.get((n, -m))
                if partner is None:
                    raise MapError(
                        f"Z{next(j for j, p in positions.items() if p == k)} rotates into a term that was not fitted:"
                        " fit both the cosine and the sine term of every order"
                    )
                matrix[partner, k] = rotated if m > 0 else -rotated
        return self.sign * matrix

    def coefficients(self, coefficients: Array, terms: Sequence[int]) -> Array:
        """Return Zernike coefficients of the wavefront after mirror, rotations and sign change, computed exactly.

        Parameters
        ----------
        coefficients : (..., Z) ndarray
            Coefficients of Z terms before the operation.
        terms : sequence of int
            Noll's indices, (Z,).
        """
        return np.asarray(coefficients) @ self.term_matrix(terms).T


ORIENTATIONS = tuple(Orientation(*key) for key in _ORIENTATION_NAMES)
"""The eight orientations of a map (mirrored or not, four rotations), with the sign of the file."""
SIGNED_ORIENTATIONS = tuple(Orientation(o.mirrored, o.quarter_turns, sign) for sign in (1, -1) for o in ORIENTATIONS)
"""The sixteen orientations of a map: eight mirrors and rotations, each with either sign."""


@dataclass(frozen=True, eq=False)
class OrientationEvidence:
    """Agreement of measured coefficients with a prediction for each of K possible orientations.

    Attributes
    ----------
    readings : tuple of Orientation
        The K possible orientations, the best one first.
    chi_square : (K,) ndarray
        Chi-square of each against the prediction.
    log_evidence : (K,) ndarray
        Logarithm of the probability density of the measured coefficients under each.
    degrees : int
        Degrees of freedom of each chi-square.
    p_value : (K,) ndarray
        p-value of each chi-square.
    allowed : tuple of Orientation
        Orientations that the data do not reject at the false-alarm rate.
    indistinguishable : tuple of Orientation
        Orientations that the data do not distinguish from the best one, including it.
    """

    readings: tuple[Orientation, ...]
    chi_square: Array
    log_evidence: Array
    degrees: int
    p_value: Array
    allowed: tuple[Orientation, ...]
    indistinguishable: tuple[Orientation, ...]

    @property
    def determined(self) -> Orientation | None:
        """Best orientation if it agrees with the data and no other one fits nearly as well, otherwise None."""
        return self.readings[0] if len(self.indistinguishable) == 1 and self.readings[0] in self.allowed else None


_ODDS = 100.0
"""Ratio of the probability of the best orientation to that of another one above which the two count as distinguished.
"""


def orientation_evidence(
    measured: Array, expected: Array, covariance: Array, terms: Sequence[int], *, false_alarm: float = 0.01
) -> OrientationEvidence:
    """Test which orientations of measured coefficients agree with a prediction.

    The orientation is the same for all fields. The covariance is that of prediction and noise together, for
    coefficients in the frame of the prediction; noise that is equal in both terms of each pair is the same in every
    orientation.

    Parameters
    ----------
    measured : (F, Z) ndarray
        Measured coefficients of Z terms at F field points, in the orientation of the files, in metres.
    expected : (F, Z) ndarray
        Predicted coefficients, in metres.
    covariance : (F*Z, F*Z) ndarray
        Covariance of measured minus expected, in m^2, fields before terms.
    terms : sequence of int
        Noll's indices, (Z,), without those that the measurement does not determine, such as piston and tilt.
    false_alarm : float
        Probability of rejecting the right orientation.

    Raises
    ------
    UndeterminedError
        The covariance is not positive definite, or a number is not finite.
    """
    size = np.size(expected)
    if not (np.isfinite(measured).all() and np.isfinite(expected).all() and np.isfinite(covariance).all()):
        raise UndeterminedError("coefficients or their covariance are not finite numbers")
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError as error:
        raise UndeterminedError(
            "the covariance of measured minus predicted coefficients is not positive definite: add the noise of the"
            " measurement to it"
        ) from error
    residual = np.stack(
        [(orientation.coefficients(measured, terms) - expected).ravel() for orientation in SIGNED_ORIENTATIONS], axis=-1
    )
    chi_square = np.sum(np.linalg.solve(root, residual) ** 2, axis=0)
    constant = np.sum(np.log(np.diag(root))) + 0.5 * size * math.log(2.0 * math.pi)
    # stable sort: of orientations with equal chi-square the first in the list comes first
    ranks = np.argsort(chi_square, kind="stable")
    ranked = tuple(SIGNED_ORIENTATIONS[k] for k in ranks)
    chi_square = chi_square[ranks]
    p_value = np.asarray(p_value_of(chi_square, size))
    limit = 2.0 * math.log(_ODDS)
    return OrientationEvidence(
        readings=ranked,
        chi_square=chi_square,
        log_evidence=-0.5 * chi_square - constant,
        degrees=size,
        p_value=p_value,
        allowed=tuple(orientation for orientation, p in zip(ranked, p_value, strict=True) if p >= false_alarm),
        indistinguishable=tuple(
            orientation for orientation, c in zip(ranked, chi_square, strict=True) if c - chi_square[0] < limit
        ),
    )


LEAST_INDEPENDENCE = 1e-6
"""Smallest RMS, relative to the whole term's over the illuminated pixels, of the part of a term that the terms before
it cannot represent; below it these pixels do not separate the terms.
"""
_CHUNK = 50_000
"""Number of pixels processed at a time, which limits the memory for large maps."""
_TRIES, _NEAR, _STEP = 400, 1.5, 0.75
"""Constants of the search for a circular edge of a pupil.

They are the number of circles through three random points of the edge that are tried, and the distance from a circle,
in pixels, within which a point lies on it: first, and when the circle is refined. The steps of a digital edge lie
within half a pixel of it.
"""
_SPECK = 0.02
"""Smallest area of a connected illuminated region, relative to the largest; smaller regions are ignored as specks."""
_ROUND_SHARE = 0.5
"""Smallest fraction of 360 degrees over which the edge of a pupil must be visible."""


@dataclass(frozen=True)
class Pupil:
    """Centre and radius of the circular pupil in a wavefront map.

    Attributes
    ----------
    x : float
        Column of the centre, in pixels; the first column is 0.
    y : float
        Row of the centre, in pixels.
    radius : float
        Radius, in pixels.

    Examples
    --------
    The centre and the edge of a pupil on the unit disk:

    >>> import numpy as np
    >>> import analysis
    >>> pupil = analysis.Pupil(x=57.0, y=60.0, radius=48.0)
    >>> pupil.unit(np.array([57.0, 105.0]), np.array([60.0, 60.0]))
    (array([0., 1.]), array([0., 0.]))
    """

    x: float
    y: float
    radius: float

    def __post_init__(self) -> None:
        check_fields(self)
        if not (math.isfinite(self.x) and math.isfinite(self.y) and 0.0 < self.radius < math.inf):
            raise MapError(f"a pupil at {self.x:g}, {self.y:g} with radius {self.radius:g} pixels: radii are positive")

    def unit(self, columns: Array, rows: Array) -> tuple[Array, Array]:
        """Return pixel positions as coordinates x, y relative to the pupil's centre, in units of its radius.

        Parameters
        ----------
        columns : ndarray
            Columns of points, any shape.
        rows : ndarray
            Rows of points, the same shape.
        """
        return (columns - self.x) / self.radius, (rows - self.y) / self.radius


@dataclass(frozen=True, eq=False)
class MapFit:
    """Coefficients of Zernike terms fitted to a map.

    Attributes
    ----------
    coefficients : (Z,) ndarray
        Coefficients of the Z Zernike terms, in metres RMS over the full disk.
    parts : (Z,) ndarray
        Coefficients of terms that are orthonormal over the illuminated pixels, in metres RMS over these.
    """

    coefficients: Array
    parts: Array


def find_pupil(values: ArrayLike) -> Pupil:
    """Find centre and radius of the pupil in a map from the edge of its measured area.

    Specks, holes, spiders and cut-off edges do not change the circle.

    Parameters
    ----------
    values : (rows, columns) array_like
        Map with NaN where nothing was measured.

    Returns
    -------
    Pupil
        Centre and radius, in pixels.

    Raises
    ------
    ValueError
        No measured pixel, or an edge that is round in less than half of the full angle.

    Examples
    --------
    A pupil at row 60, column 57 with a radius of 48 px:

    >>> import numpy as np
    >>> import analysis
    >>> row, column = np.mgrid[:120, :120]
    >>> lit = np.hypot(row - 60, column - 57) <= 48
    >>> pupil = analysis.find_pupil(np.where(lit, 0.0, np.nan))
    >>> round(pupil.x, 1), round(pupil.y, 1), round(pupil.radius, 1)
    (57.0, 60.0, 47.9)
    """
    measured = np.isfinite(_checked_map(values))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(measured.astype(np.uint8), connectivity=8)
    if count < 2:
        raise UndeterminedError("the map has no measured pixel")
    area = stats[:, cv2.CC_STAT_AREA]
    # spiders divide the pupil into several regions; small specks do not belong to it
    kept_labels = np.flatnonzero((area >= _SPECK * area[1:].max()) & (np.arange(count) > 0))
    pupil_mask = np.isin(labels, kept_labels)
    # edges between unmeasured and measured pixels; the border of the map is not an edge of the pupil
    points = np.concatenate([_ends(pupil_mask), _ends(pupil_mask.T)[:, ::-1]])
    rng = np.random.default_rng(0)
    best, best_count = (0.0, 0.0, 0.0), -1
    for _ in range(_TRIES if len(points) >= 8 else 0):
        circle = _circle(points[rng.choice(len(points), 3, replace=False)])
        count_on_circle = (
            int(np.count_nonzero(_off(points, circle) < _NEAR)) if circle[2] < 4.0 * max(pupil_mask.shape) else -1
        )
        if count_on_circle > best_count:
            best, best_count = circle, count_on_circle
    for tolerance in (_NEAR, _NEAR, _STEP, _STEP, _STEP) if best_count >= 8 else ():
        edge_points = points[_off(points, best) < tolerance]
        best = _circle(edge_points if len(edge_points) >= 8 else points[_off(points, best) < _NEAR])
    edge_points = points[_off(points, best) < _NEAR]
    angles = np.arctan2(edge_points[:, 1] - best[1], edge_points[:, 0] - best[0])
    visible_share = len(np.unique(np.floor(angles / (2.0 * np.pi) * 36.0))) / 36.0
    if best_count < 8 or visible_share < _ROUND_SHARE:
        raise UndeterminedError(
            "the measured area has no round edge that determines centre and radius of the pupil: specify them in pixels"
        )
    return Pupil(float(best[0]), float(best[1]), float(best[2]))


def _ends(illuminated: NDArray[np.bool_]) -> Array:
    """Return the first and last edge of the illuminated pixels in each row of a mask, as points (column, row)."""
    rows = np.flatnonzero(illuminated.any(axis=1))
    first, last = illuminated[rows].argmax(axis=1), illuminated.shape[1] - 1 - illuminated[rows, ::-1].argmax(axis=1)
    left, right = np.stack([first - 0.5, rows], axis=1), np.stack([last + 0.5, rows], axis=1)
    return np.concatenate([left[first > 0], right[last < illuminated.shape[1] - 1]])


def _circle(points: Array) -> tuple[float, float, float]:
    """Return column and row of the centre, and radius, of the least-squares circle through N points, in pixels."""
    middle = points.mean(axis=0)
    offset = points - middle
    solution, *_ = np.linalg.lstsq(
        np.column_stack([2.0 * offset, np.ones(len(offset))]), np.sum(offset**2, axis=1), rcond=None
    )
    square = solution[2] + solution[0] ** 2 + solution[1] ** 2
    return float(solution[0] + middle[0]), float(solution[1] + middle[1]), math.sqrt(max(square, 1e-12))


def _off(points: Array, circle: tuple[float, float, float]) -> Array:
    """Return the distances of N points from a circle, in pixels."""
    return np.abs(np.hypot(points[:, 0] - circle[0], points[:, 1] - circle[1]) - circle[2])


def fit_wavefront_map(values: ArrayLike, terms: Sequence[int], pupil: Pupil | None = None) -> MapFit:
    """Fit Zernike terms to the measured pixels of a wavefront map, over a pupil of any shape.

    Parameters
    ----------
    values : (rows, columns) array_like
        Optical path difference or height, in metres or any other unit, NaN where nothing was measured.
    terms : sequence of int
        Noll's indices in ascending order. Piston and tilt, 1 to 3, belong to them unless the map has none.
    pupil : Pupil, optional
        Centre and radius of the unit disk; by default `find_pupil` finds them.

    Returns
    -------
    MapFit
        `coefficients` of the circular terms, rms over the full disk, and `parts`, the coefficients of terms that are
        orthonormal over the measured pixels.

    Raises
    ------
    ValueError
        A map that is not a plane, terms that are not ascending, no measured pixels in the pupil, or terms that the
        measured pixels do not separate.

    Notes
    -----
    Over a ring the orthonormal terms are Mahajan's annular polynomials, J. Opt. Soc. Am. 71, 75 (1981), up to the
    pixels.

    Examples
    --------
    Defocus and coma over a ring, whose Zernike terms are not orthogonal:

    >>> import numpy as np
    >>> import analysis
    >>> y, x = (np.mgrid[:101, :101] - 50) / 45
    >>> r2 = x**2 + y**2
    >>> opd = 50e-9 * np.sqrt(3) * (2 * r2 - 1) + 20e-9 * np.sqrt(8) * (3 * r2 - 2) * y
    >>> opd[(r2 > 1) | (r2 < 0.09)] = np.nan
    >>> fit = analysis.fit_wavefront_map(opd, range(1, 12), analysis.Pupil(50, 50, 45))
    >>> np.round(fit.coefficients * 1e9, 6).tolist()
    [0.0, 0.0, 0.0, 50.0, -0.0, -0.0, 20.0, -0.0, 0.0, -0.0, 0.0]
    """
    terms = tuple(int(index) for index in terms)
    if not terms or any(b <= a for a, b in itertools.pairwise(terms)):
        raise MapError(f"terms are to be Noll's indices in ascending order, not {terms[:12]}")
    measured = _checked_map(values)
    pupil = find_pupil(measured) if pupil is None else pupil
    rows, columns = np.nonzero(np.isfinite(measured))
    x, y = pupil.unit(columns.astype(float), rows.astype(float))
    inside = x**2 + y**2 <= 1.0 + 1e-9
    rows, columns, x, y = rows[inside], columns[inside], x[inside], y[inside]
    count, size = len(rows), len(terms)
    if count <= size:
        raise UndeterminedError(
            f"{count} measured pixels lie within the pupil at column {pupil.x:.1f}, row {pupil.y:.1f} of radius"
            f" {pupil.radius:.1f}; {size} terms need more: specify the pupil, or fit fewer terms"
        )
    pupil_values = measured[rows, columns]
    # QR by chunks, each stacked below the triangle of those before; the last column holds the orthonormal coefficients
    triangle = np.zeros((0, size + 1))
    for part in _chunks(count):
        basis = circle_terms(terms, x[part], y[part])
        both = np.column_stack([basis, pupil_values[part]]) / math.sqrt(count)
        triangle = np.asarray(np.linalg.qr(np.concatenate([triangle, both]), mode="r"))
    sign = np.where(np.diag(triangle)[:size] < 0.0, -1.0, 1.0)
    factor, parts = triangle[:size, :size] * sign[:, None], triangle[:size, size] * sign
    independent = np.diag(factor) / np.maximum(np.linalg.norm(factor, axis=0), LEAST_INDEPENDENCE)
    if (independent < LEAST_INDEPENDENCE).any():
        raise UndeterminedError(
            f"over the measured part of the pupil, Z{terms[int(np.argmax(independent < LEAST_INDEPENDENCE))]} cannot be"
            " separated from the terms before it: fit fewer terms, or specify the pupil"
        )
    return MapFit(np.asarray(np.linalg.solve(factor, parts), dtype=np.float64), parts)


def _checked_map(values: ArrayLike) -> Array:
    """Return a map as a float64 array; raise MapError if it is not a two-dimensional array of real numbers."""
    plane = np.asarray(values)
    if plane.ndim != 2 or plane.dtype.kind not in "iuf":
        raise MapError(
            f"a map is (rows, columns) of real numbers, NaN where there is no light, found {plane.dtype} {plane.shape}"
        )
    return plane.astype(np.float64)


def _chunks(count: int) -> Iterator[slice]:
    """Yield slices of at most `_CHUNK` elements that together cover a given number of pixels."""
    return (slice(k, k + _CHUNK) for k in range(0, count, _CHUNK))
