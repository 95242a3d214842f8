"""Measured points against the truth; nothing of it goes back into an analysis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from optics.numerics.frozen_map import FrozenMap
from twin.orbit.images.image_points import MatchedPoints
from twin.orbit.images.patch import Patch

WRONG_PIXELS, WRONG_SIGMAS, WRONG_FLOOR = 3.0, 5.0, 1.0
"""A match is wrong that lies more than 3 pixels off, or more than 5 of its sigmas and 1 pixel."""


@dataclass(frozen=True, eq=False)
class LineJudgement:
    """One line's places against the truth.

    Attributes:
        error: (n, 2) found minus true, lines and pixels; NaN without a place.
        wrong: (n,) bool, of those with a place.
        found, matched, accepted: how many places there are, before any is rejected, how many matching and how many
            consensus let pass.
        wrong_found, wrong_matched, wrong_accepted: how many of these are wrong.
        good_lost: right matches that consensus has rejected.
        rms: (2,) of accepted places that are not wrong, lines and pixels.
        mean: (2,) of them.
        chi_square: of them over their covariance.
        degrees_of_freedom: two for each.
    """

    error: np.ndarray
    wrong: np.ndarray
    found: int
    matched: int
    accepted: int
    wrong_found: int
    wrong_matched: int
    wrong_accepted: int
    good_lost: int
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
    for name, line in points.lines.items():
        if name == points.source:
            continue
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
            error,
            wrong,
            int(np.isfinite(size).sum()),
            int(line.matched.sum()),
            int(line.accepted.sum()),
            int(wrong.sum()),
            int((wrong & line.matched).sum()),
            int((wrong & line.accepted).sum()),
            int((line.matched & ~line.accepted & ~wrong).sum()),
            np.sqrt(np.mean(good**2, axis=0)) if len(good) else np.full(2, np.nan),
            good.mean(axis=0) if len(good) else np.full(2, np.nan),
            square,
            2 * len(good),
        )
    return FrozenMap(found)
