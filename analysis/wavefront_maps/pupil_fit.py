"""Zernike terms of a map over any lit area of a pupil.

Terms are made orthonormal over the pixels that are lit, in Noll's order: over a ring these are Mahajan's annular terms
up to the pixels, over a cut pupil their like. Coefficients of the circle's terms follow from them; where light is
missing they share among them what looks alike there.

Which way round a measured wavefront is: flips, quarter turns and sign, and which of these the data allow.
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
from analysis.statistics import chance_beyond
from analysis.wavefront_maps.map_files import MapError, WavefrontMap
from analysis.wavefront_maps.zernike_table import circle_terms, noll_to_nm

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
_COSINE = (1, 0, -1, 0)
"""Of multiples of a quarter turn."""


@dataclass(frozen=True)
class Orientation:
    """What has to be done to a map so that it lies as its user's pupil does: a mirror, then turns, and a sign.

    Attributes
    ----------
    mirrored : bool
        Whether y is turned into -y first.
    quarter_turns : int
        By 90 degrees each, from x to y, 0 to 3.
    sign : int
        +1 or -1, by which the values are multiplied.
    """

    mirrored: bool = False
    quarter_turns: int = 0
    sign: int = 1

    def __post_init__(self) -> None:
        if self.quarter_turns not in range(4) or self.sign not in (1, -1):
            raise ValueError(f"quarter turns are 0 to 3 and signs +1 and -1, not {self.quarter_turns} and {self.sign}")

    @classmethod
    def named(cls, name: str, sign: int = 1) -> Orientation:
        """The orientation with a name.

        Parameters
        ----------
        name : str
            One of ``ORIENTATIONS``, such as ``turned 90``.
        sign : int
            +1 or -1.

        Raises
        ------
        MapError
            No such name.
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
        """Where a point (x, y) of the map comes to lie, (2, 2): a feature at p is at ``matrix @ p``."""
        c, s = _COSINE[self.quarter_turns], _COSINE[(self.quarter_turns + 3) % 4]
        return np.array([[c, -s], [s, c]]) @ np.diag([1, -1 if self.mirrored else 1])

    @property
    def inverse(self) -> Orientation:
        """What takes it back: a mirror is its own inverse."""
        turns = self.quarter_turns if self.mirrored else -self.quarter_turns % 4
        return Orientation(self.mirrored, turns, self.sign)

    def __str__(self) -> str:
        return self.name if self.sign > 0 else f"{self.name}, sign inverted"

    def values(self, values: Array) -> Array:
        """A map's values as they lie after it.

        Parameters
        ----------
        values : Array
            (rows, columns), y growing with the row.
        """
        flipped = values[::-1] if self.mirrored else values
        # rows grow upwards: what NumPy calls clockwise is from x to y
        return self.sign * np.rot90(flipped, -self.quarter_turns)

    def apply(self, measured: WavefrontMap) -> WavefrontMap:
        """A map as it lies after it.

        Parameters
        ----------
        measured : WavefrontMap
            As the file has it.
        """
        return replace(measured, values=self.values(measured.values))

    def of_terms(self, terms: Sequence[int]) -> Array:
        """What it makes of Zernike coefficients: (Z, Z) with entries 0, 1 and -1.

        Parameters
        ----------
        terms : Sequence[int]
            Indices of Noll, (Z,), with both the cosine and the sine term of every one that turns.

        Raises
        ------
        MapError
            a term without its partner, into which it turns.
        """
        place = {int(index): k for k, index in enumerate(terms)}
        orders = {noll_to_nm(index): k for index, k in place.items()}
        out = np.zeros((len(place), len(place)))
        for (n, m), k in orders.items():
            # the angle at which the old map is looked up is s (angle - turn)
            c, s = _COSINE[abs(m) * self.quarter_turns % 4], _COSINE[(abs(m) * self.quarter_turns + 3) % 4]
            kept, turned = (-c if self.mirrored and m < 0 else c), (-s if self.mirrored and m < 0 else s)
            out[k, k] = kept
            if turned:
                partner = orders.get((n, -m))
                if partner is None:
                    raise MapError(
                        f"Z{next(j for j, p in place.items() if p == k)} turns into a term that was not fitted: take"
                        " both the cosine and the sine term of every order"
                    )
                out[partner, k] = turned if m > 0 else -turned
        return self.sign * out

    def coefficients(self, coefficients: Array, terms: Sequence[int]) -> Array:
        """Zernike coefficients as they are after it, exactly.

        Parameters
        ----------
        coefficients : Array
            (..., Z).
        terms : Sequence[int]
            Indices of Noll, (Z,).
        """
        return np.asarray(coefficients) @ self.of_terms(terms).T


ORIENTATIONS = tuple(Orientation(*key) for key in _ORIENTATION_NAMES)
"""All eight, with the sign of the file."""
READINGS = tuple(Orientation(o.mirrored, o.quarter_turns, sign) for sign in (1, -1) for o in ORIENTATIONS)
"""All sixteen with their signs."""


@dataclass(frozen=True, eq=False)
class ReadingEvidence:
    """What measured coefficients say of the ways in which they may be read.

    Attributes
    ----------
    readings : tuple[Orientation, ...]
        The best one first, (K,).
    chi_square : Array
        Of each against the prediction, (K,).
    log_evidence : Array
        Logarithm of the probability density of the measured coefficients under each, (K,).
    degrees : int
        Of freedom of each chi-square.
    chance : Array
        Of a larger chi-square if the reading is right, (K,).
    allowed : tuple[Orientation, ...]
        Those that the data do not reject at the false-alarm rate.
    together : tuple[Orientation, ...]
        Those that cannot be told from the best one, which is among them.
    """

    readings: tuple[Orientation, ...]
    chi_square: Array
    log_evidence: Array
    degrees: int
    chance: Array
    allowed: tuple[Orientation, ...]
    together: tuple[Orientation, ...]

    @property
    def found(self) -> Orientation | None:
        """The reading, where the data allow it and tell it from all others; None otherwise."""
        return self.readings[0] if len(self.together) == 1 and self.readings[0] in self.allowed else None


_ODDS = 100.0
"""Readings less than so many times as probable as the best one are not told from it."""


def tellable(
    measured: Array, expected: Array, covariance: Array, terms: Sequence[int], *, false_alarm: float = 0.01
) -> ReadingEvidence:
    """Which readings of measured coefficients agree with a prediction.

    One reading holds for all fields. The covariance is that of prediction and noise together, for coefficients in the
    frame of the prediction; noise that is equal in both terms of each pair is the same in every reading.

    Parameters
    ----------
    measured : Array
        Coefficients as the files have them, (F, Z), metres.
    expected : Array
        Coefficients that are predicted, (F, Z), metres.
    covariance : Array
        Of measured minus expected, (F*Z, F*Z), square metres, fields before terms.
    terms : Sequence[int]
        Indices of Noll, (Z,); leave out what the measurement leaves free, such as piston and tilt.
    false_alarm : float
        Probability with which the right reading may be rejected.

    Raises
    ------
    UndeterminedError
        a covariance that is none, or numbers that are not finite.
    """
    size = np.size(expected)
    if not (np.isfinite(measured).all() and np.isfinite(expected).all() and np.isfinite(covariance).all()):
        raise UndeterminedError("coefficients or their covariance are not finite numbers")
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError as error:
        raise UndeterminedError(
            "the covariance of measured minus predicted coefficients has no positive determinant: add the noise of the"
            " measurement to it"
        ) from error
    rest = np.stack([(one.coefficients(measured, terms) - expected).ravel() for one in READINGS], axis=-1)
    chi_square = np.sum(np.linalg.solve(root, rest) ** 2, axis=0)
    constant = np.sum(np.log(np.diag(root))) + 0.5 * size * math.log(2.0 * math.pi)
    # a stable sort: of readings that are exactly alike the first in the list is named first
    ranks = np.argsort(chi_square, kind="stable")
    ranked = tuple(READINGS[k] for k in ranks)
    chi_square = chi_square[ranks]
    chance = np.asarray(chance_beyond(chi_square, size))
    limit = 2.0 * math.log(_ODDS)
    return ReadingEvidence(
        readings=ranked,
        chi_square=chi_square,
        log_evidence=-0.5 * chi_square - constant,
        degrees=size,
        chance=chance,
        allowed=tuple(one for one, p in zip(ranked, chance, strict=True) if p >= false_alarm),
        together=tuple(one for one, c in zip(ranked, chi_square, strict=True) if c - chi_square[0] < limit),
    )


HELD = 1e-6
"""Share of a term that has to be left beside those before it; below it the light does not tell them apart."""
_CHUNK = 50_000
"""Pixels at a time, so that large maps take little memory."""
_TRIES, _NEAR, _STEP = 400, 1.5, 0.75
"""Circles through three points of the edge that are tried; pixels from one of them within which a point is on it, at
first and when it is refined: a step lies within half a pixel of the edge.
"""
_SPECK = 0.02
"""Of the largest connected lit area; smaller ones lie outside the pupil, or do not matter."""
_ROUND_SHARE = 0.5
"""Of the full angle in which the edge of a pupil has to be seen."""


@dataclass(frozen=True)
class Pupil:
    """Circle of a pupil in a map.

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
        if not (math.isfinite(self.x) and math.isfinite(self.y) and 0.0 < self.radius < math.inf):
            raise MapError(f"a pupil at {self.x:g}, {self.y:g} with radius {self.radius:g} pixels: radii are positive")

    def unit(self, columns: Array, rows: Array) -> tuple[Array, Array]:
        """Coordinates on the unit disk.

        Parameters
        ----------
        columns : Array
            Of points, any shape.
        rows : Array
            likewise.
        """
        return (columns - self.x) / self.radius, (rows - self.y) / self.radius


@dataclass(frozen=True, eq=False)
class MapFit:
    """Zernike terms of a map.

    Attributes
    ----------
    coefficients : Array
        Of the circle's terms, metres rms over the full disk each, (Z,).
    parts : Array
        Of the terms that are orthonormal over the light, metres rms over it each, (Z,).
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
    light = np.isfinite(_checked_map(values))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(light.astype(np.uint8), connectivity=8)
    if count < 2:
        raise UndeterminedError("the map has no lit pixel")
    area = stats[:, cv2.CC_STAT_AREA]
    # spiders part the light of a pupil; specks of it are none
    kept_labels = np.flatnonzero((area >= _SPECK * area[1:].max()) & (np.arange(count) > 0))
    lit = np.isin(labels, kept_labels)
    # steps from dark to lit between two pixels; a map that ends in the light shows no edge there
    points = np.concatenate([_ends(lit), _ends(lit.T)[:, ::-1]])
    rng = np.random.default_rng(0)
    best, most = (0.0, 0.0, 0.0), -1
    for _ in range(_TRIES if len(points) >= 8 else 0):
        circle = _circle(points[rng.choice(len(points), 3, replace=False)])
        near = int(np.count_nonzero(_off(points, circle) < _NEAR)) if circle[2] < 4.0 * max(lit.shape) else -1
        if near > most:
            best, most = circle, near
    for near_by in (_NEAR, _NEAR, _STEP, _STEP, _STEP) if most >= 8 else ():
        kept = points[_off(points, best) < near_by]
        best = _circle(kept if len(kept) >= 8 else points[_off(points, best) < _NEAR])
    kept = points[_off(points, best) < _NEAR]
    angles = np.arctan2(kept[:, 1] - best[1], kept[:, 0] - best[0])
    seen = len(np.unique(np.floor(angles / (2.0 * np.pi) * 36.0))) / 36.0
    if most < 8 or seen < _ROUND_SHARE:
        raise UndeterminedError(
            "the lit area has no round edge from which centre and radius of the pupil follow: state them in pixels"
        )
    return Pupil(float(best[0]), float(best[1]), float(best[2]))


def _ends(lit: NDArray[np.bool_]) -> Array:
    """First and last steps of each row of a mask, (column, row), where they lie inside the map."""
    rows = np.flatnonzero(lit.any(axis=1))
    first, last = lit[rows].argmax(axis=1), lit.shape[1] - 1 - lit[rows, ::-1].argmax(axis=1)
    left, right = np.stack([first - 0.5, rows], axis=1), np.stack([last + 0.5, rows], axis=1)
    return np.concatenate([left[first > 0], right[last < lit.shape[1] - 1]])


def _circle(points: Array) -> tuple[float, float, float]:
    """Column and row of the centre and radius of the circle nearest to points (N, 2)."""
    middle = points.mean(axis=0)
    moved = points - middle
    found, *_ = np.linalg.lstsq(
        np.column_stack([2.0 * moved, np.ones(len(moved))]), np.sum(moved**2, axis=1), rcond=None
    )
    square = found[2] + found[0] ** 2 + found[1] ** 2
    return float(found[0] + middle[0]), float(found[1] + middle[1]), math.sqrt(max(square, 1e-12))


def _off(points: Array, circle: tuple[float, float, float]) -> Array:
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
            f"{count} lit pixels lie within the pupil at column {pupil.x:.1f}, row {pupil.y:.1f} of radius"
            f" {pupil.radius:.1f}; {size} terms need more: state where the pupil lies, or take fewer terms"
        )
    lit_values = measured[rows, columns]
    # by chunks, each with the triangle of those before it: the triangle of all, with the parts as its last column
    triangle = np.zeros((0, size + 1))
    for part in _chunks(count):
        basis = circle_terms(terms, x[part], y[part])
        both = np.column_stack([basis, lit_values[part]]) / math.sqrt(count)
        triangle = np.asarray(np.linalg.qr(np.concatenate([triangle, both]), mode="r"))
    sign = np.where(np.diag(triangle)[:size] < 0.0, -1.0, 1.0)
    factor, parts = triangle[:size, :size] * sign[:, None], triangle[:size, size] * sign
    left = np.diag(factor) / np.maximum(np.linalg.norm(factor, axis=0), HELD)
    if (left < HELD).any():
        raise UndeterminedError(
            f"over the lit part of the pupil, Z{terms[int(np.argmax(left < HELD))]} cannot be told from the terms"
            " before it: take fewer terms, or state where the pupil lies"
        )
    return MapFit(np.asarray(np.linalg.solve(factor, parts), dtype=np.float64), parts)


def _checked_map(values: ArrayLike) -> Array:
    """Return a map as float64. Raise MapError if it is not a plane of real numbers."""
    plane = np.asarray(values)
    if plane.ndim != 2 or plane.dtype.kind not in "iuf":
        raise MapError(
            f"a map is (rows, columns) of real numbers, NaN where there is no light, found {plane.dtype} {plane.shape}"
        )
    return plane.astype(np.float64)


def _chunks(count: int) -> Iterator[slice]:
    return (slice(k, k + _CHUNK) for k in range(0, count, _CHUNK))
