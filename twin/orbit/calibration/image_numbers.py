"""Numbers of points measured in a campaign's images, as calibration.json has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from twin.orbit.calibration.field_images import FieldImages, PatchRecord
from twin.orbit.images.point_judgement import LineJudgement, MatchCounts, counts_of


@dataclass(frozen=True)
class ImageTotals(MatchCounts):
    """Points in images, over all fields and lines; wrong by truth."""

    entered: int
    left: int
    wrong_entered: int
    wrong_left: int
    check_entered: int
    check_left: int
    wrong_check_left: int
    right_rejected_by_adjustment: int

    @classmethod
    def of(cls, images: Sequence[FieldImages]) -> ImageTotals:
        """Of all fields."""
        every = [j for one in images for patch in one.patches for j in judgements(patch).values()]
        screenings = [one.screening for one in images if one.screening is not None]
        screened = {name: sum(getattr(s, name) for s in screenings) for name in _SCREENED}
        return cls(
            **counts_of(every),
            **screened,
            right_rejected_by_adjustment=sum(s.right_lost for s in screenings),
        )


_SCREENED = ("entered", "left", "wrong_entered", "wrong_left", "check_entered", "check_left", "wrong_check_left")


@dataclass(frozen=True)
class MatchingNumbers(MatchCounts):
    """Points of one sort in the images of one line, over a field's patches; RMS of those that are not wrong."""

    rms_lines_px: float
    rms_pixels_px: float
    chi_square_ratio: float

    @classmethod
    def of(cls, parts: Sequence[LineJudgement]) -> MatchingNumbers:
        """Of some patches."""
        degrees = np.array([j.degrees_of_freedom for j in parts])
        square = np.sum([np.nan_to_num(j.rms) ** 2 * n for j, n in zip(parts, degrees, strict=True)], axis=0)
        rms = np.sqrt(square / max(degrees.sum(), 1))
        return cls(
            **counts_of(parts),
            rms_lines_px=float(rms[0]),
            rms_pixels_px=float(rms[1]),
            chi_square_ratio=float(sum(j.chi_square for j in parts) / max(degrees.sum(), 1)),
        )

    @classmethod
    def by_line(cls, one: FieldImages) -> dict[str, dict[str, MatchingNumbers]]:
        """Sort of points -> line -> numbers of a field."""
        parts: dict[str, dict[str, list[LineJudgement]]] = {}
        for patch in one.patches:
            for (sort, line), j in judgements(patch).items():
                parts.setdefault(sort, {}).setdefault(line, []).append(j)
        return {sort: {line: cls.of(some) for line, some in lines.items()} for sort, lines in parts.items()}


def judgements(patch: PatchRecord) -> dict[tuple[str, str], LineJudgement]:
    """(sort of points, line) -> judgement."""
    return {(sort, line): j for sort, lines in patch.judgements.items() for line, j in lines.items()}


@dataclass(frozen=True)
class ImageNumbers:
    """Points in images; fields: field -> sort of points -> line."""

    total: ImageTotals
    fields: Mapping[str, Mapping[str, Mapping[str, MatchingNumbers]]]

    @classmethod
    def of(cls, images: Sequence[FieldImages]) -> ImageNumbers:
        """Of all fields."""
        return cls(ImageTotals.of(images), {one.name: MatchingNumbers.by_line(one) for one in images})
