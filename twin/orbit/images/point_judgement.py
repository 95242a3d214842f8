"""Measured points against the truth; nothing of it goes back into an analysis."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields

import numpy as np
from scipy.stats import chi2

from optics.numerics.number_tree import FrozenMap
from twin.orbit.images.image_points import MatchedPoints
from twin.orbit.images.patch import Patch

WRONG_PIXELS, WRONG_SIGMAS, WRONG_FLOOR = 3.0, 5.0, 1.0
"""A match is wrong that lies more than 3 pixels off, or more than 5 of its sigmas and 1 pixel."""
WRONG = f"more than {WRONG_PIXELS:g} px off, or more than {WRONG_SIGMAS:g} sigmas and {WRONG_FLOOR:g} px"
"""When a match is wrong, for readers."""


@dataclass(frozen=True, eq=False)
class MatchCounts:
    """Places by what let them pass.

    Attributes:
        found, matched, accepted: how many places there are, before any is rejected, how many matching and how many
            consensus let pass.
        wrong_found, wrong_matched, wrong_accepted: how many of these are wrong.
        right_rejected_by_consensus: right matches that consensus has rejected.
    """

    found: int
    matched: int
    accepted: int
    wrong_found: int
    wrong_matched: int
    wrong_accepted: int
    right_rejected_by_consensus: int

    @property
    def wrong_shares(self) -> tuple[str, str, str]:
        """For readers: wrong of all that were found, that matching let pass, that consensus let pass."""
        pairs = (
            (self.wrong_found, self.found),
            (self.wrong_matched, self.matched),
            (self.wrong_accepted, self.accepted),
        )
        first, second, third = (f"{wrong} of {every}" for wrong, every in pairs)
        return first, second, third


def counts_of(parts: Iterable[MatchCounts]) -> dict[str, int]:
    """Field of ``MatchCounts`` -> its sum over the parts."""
    parts = tuple(parts)
    return {field.name: sum(getattr(one, field.name) for one in parts) for field in fields(MatchCounts)}


@dataclass(frozen=True, eq=False)
class LineJudgement(MatchCounts):
    """One line's places against the truth.

    Attributes:
        error: (n, 2) found minus true, lines and pixels; NaN without a place.
        wrong: (n,) bool, of those with a place.
        rms: (2,) of accepted places that are not wrong, lines and pixels.
        mean: (2,) of them.
        chi_square: of them over their covariance.
        degrees_of_freedom: two for each.
    """

    error: np.ndarray
    wrong: np.ndarray
    rms: np.ndarray
    mean: np.ndarray
    chi_square: float
    degrees_of_freedom: int

    @property
    def p_value(self) -> float:
        """Chance of a chi-square as large or larger."""
        return float(chi2.sf(self.chi_square, self.degrees_of_freedom))


def true_ground(patch: Patch, points: MatchedPoints) -> np.ndarray:
    """(n, 3) ITRS, metres: the true place of what the points show. A map shows at a place what lies at that place minus
    its error; a tie is what its source's pixel truly sees.
    """
    if points.kind == "map":
        east, north = patch.control.error(points.east, points.north)
        east, north = points.east - east, points.north - north
        return patch.frame.itrs(east, north, patch.terrain.height(east, north))
    if points.kind != "tie":
        raise ValueError(f"points are of kind map or tie, not {points.kind!r}")
    source = points.source
    assert source is not None
    place = points.lines[source].place
    return patch.true_point(source, place[:, 0], place[:, 1])


def judged(patch: Patch, points: MatchedPoints) -> Mapping[str, LineJudgement]:
    """Line -> judgement; the frame that ties were chosen in is left out."""
    truth = true_ground(patch, points)
    found = {}
    for name, line in points.sought_in.items():
        true = np.stack(patch.images[name].sensor.image(truth), axis=-1)
        error = line.image - true
        size = np.linalg.norm(error, axis=1)
        worst = np.sqrt(np.linalg.eigvalsh(np.nan_to_num(line.covariance))[:, 1])
        # NaN compares false
        wrong = (size > WRONG_PIXELS) | (size > WRONG_SIGMAS * worst + WRONG_FLOOR)
        right = line.accepted & ~wrong
        good = error[right]
        square = float(np.einsum("ni,nij,nj->", good, np.linalg.inv(line.covariance[right]), good))
        found[name] = LineJudgement(
            found=int(np.isfinite(size).sum()),
            matched=int(line.matched.sum()),
            accepted=int(line.accepted.sum()),
            wrong_found=int(wrong.sum()),
            wrong_matched=int((wrong & line.matched).sum()),
            wrong_accepted=int((wrong & line.accepted).sum()),
            right_rejected_by_consensus=int((line.matched & ~line.accepted & ~wrong).sum()),
            error=error,
            wrong=wrong,
            rms=np.sqrt(np.mean(good**2, axis=0)) if len(good) else np.full(2, np.nan),
            mean=good.mean(axis=0) if len(good) else np.full(2, np.nan),
            chi_square=square,
            degrees_of_freedom=2 * len(good),
        )
    return FrozenMap(found)
