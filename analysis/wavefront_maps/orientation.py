"""Which way round a measured wavefront is: flips, quarter turns and sign, and which of these the data allow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array
from analysis.measurement_error import UndeterminedError
from analysis.statistics import chance_beyond
from analysis.wavefront_maps.wavefront_map import MapError, WavefrontMap
from analysis.wavefront_maps.zernike_table import noll_to_nm

_NAMES = {
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

    Attributes:
        mirrored: whether y is turned into -y first.
        quarter_turns: by 90 degrees each, from x to y, 0 to 3.
        sign: +1 or -1, by which the values are multiplied.
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

        Args:
            name: one of ``ORIENTATIONS``, such as ``turned 90``.
            sign: +1 or -1.

        Raises:
            MapError: no such name.
        """
        for key, known in _NAMES.items():
            if known == name.strip().lower():
                return cls(*key, sign)
        raise MapError(f"there is no orientation {name[:40]!r}; {', '.join(_NAMES.values())} are known")

    @property
    def name(self) -> str:
        """Name of the orientation, without its sign."""
        return _NAMES[self.mirrored, self.quarter_turns]

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

        Args:
            values: (rows, columns), y growing with the row.
        """
        flipped = values[::-1] if self.mirrored else values
        # rows grow upwards: what NumPy calls clockwise is from x to y
        return self.sign * np.rot90(flipped, -self.quarter_turns)

    def apply(self, measured: WavefrontMap) -> WavefrontMap:
        """A map as it lies after it.

        Args:
            measured: as the file has it.
        """
        return replace(measured, values=self.values(measured.values))

    def of_terms(self, terms: Sequence[int]) -> Array:
        """What it makes of Zernike coefficients: (Z, Z) with entries 0, 1 and -1.

        Args:
            terms: indices of Noll, (Z,), with both the cosine and the sine term of every one that turns.

        Raises:
            MapError: a term without its partner, into which it turns.
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

        Args:
            coefficients: (..., Z).
            terms: indices of Noll, (Z,).
        """
        return np.asarray(coefficients) @ self.of_terms(terms).T


ORIENTATIONS = tuple(Orientation(*key) for key in _NAMES)
"""All eight, with the sign of the file."""
READINGS = tuple(Orientation(o.mirrored, o.quarter_turns, sign) for sign in (1, -1) for o in ORIENTATIONS)
"""All sixteen with their signs."""


@dataclass(frozen=True, eq=False)
class ReadingEvidence:
    """What measured coefficients say of the ways in which they may be read.

    Attributes:
        readings: the best one first, (K,).
        chi_square: of each against the prediction, (K,).
        log_evidence: logarithm of the probability density of the measured coefficients under each, (K,).
        degrees: of freedom of each chi-square.
        chance: of a larger chi-square if the reading is right, (K,).
        allowed: those that the data do not reject at the false-alarm rate.
        together: those that cannot be told from the best one, which is among them.
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


def tellable(
    measured: Array,
    expected: Array,
    covariance: Array,
    terms: Sequence[int],
    *,
    false_alarm: float = 0.01,
    odds: float = 100.0,
    readings: Sequence[Orientation] = READINGS,
) -> ReadingEvidence:
    """Which readings of measured coefficients agree with a prediction.

    One reading holds for all fields. The covariance is that of prediction and noise together, for coefficients in the
    frame of the prediction; noise that is equal in both terms of each pair is the same in every reading.

    Args:
        measured: coefficients as the files have them, (F, Z), metres.
        expected: coefficients that are predicted, (F, Z), metres.
        covariance: of measured minus expected, (F*Z, F*Z), square metres, fields before terms.
        terms: indices of Noll, (Z,); leave out what the measurement leaves free, such as piston and tilt.
        false_alarm: probability with which the right reading may be rejected.
        odds: readings less than so many times as probable as the best one are not told from it: chi-squares that
            differ by less than twice the logarithm of the odds.
        readings: to choose from.

    Raises:
        UndeterminedError: a covariance that is none, or numbers that are not finite.
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
    rest = np.stack([(one.coefficients(measured, terms) - expected).ravel() for one in readings], axis=-1)
    chi_square = np.sum(np.linalg.solve(root, rest) ** 2, axis=0)
    constant = np.sum(np.log(np.diag(root))) + 0.5 * size * math.log(2.0 * math.pi)
    # a stable sort: of readings that are exactly alike the first in the list is named first
    ranks = np.argsort(chi_square, kind="stable")
    ranked = tuple(readings[k] for k in ranks)
    chi_square = chi_square[ranks]
    chance = np.asarray(chance_beyond(chi_square, size))
    limit = 2.0 * math.log(odds)
    return ReadingEvidence(
        readings=ranked,
        chi_square=chi_square,
        log_evidence=-0.5 * chi_square - constant,
        degrees=size,
        chance=chance,
        allowed=tuple(one for one, p in zip(ranked, chance, strict=True) if p >= false_alarm),
        together=tuple(one for one, c in zip(ranked, chi_square, strict=True) if c - chi_square[0] < limit),
    )
