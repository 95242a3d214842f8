"""Numbers of points measured in a user's images, as match.json has them, and the points as files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from twin.orbit.images.simulate_numbers import PointNumbers
from twin.orbit.matching.match_run import Match, UserImage
from twin.orbit.measured.map_part import MapPart
from twin.orbit.measured.measurement_tables import campaign_files
from twin.run.plain_data import plain_data


@dataclass(frozen=True)
class ImageNumbers:
    """A line's image: which part was matched, and its samples on the ground."""

    first_line: int
    first_pixel: int
    lines: int
    pixels: int
    sample_along_line_m: float
    sample_along_track_m: float

    @classmethod
    def of(cls, image: UserImage) -> Self:
        """Of one image."""
        window = image.window
        return cls(window.first_line, window.first_pixel, window.lines, window.pixels, *image.sample)


@dataclass(frozen=True)
class MapNumbers:
    """The part of a map that was used."""

    system: str
    first_row: int
    first_column: int
    rows: int
    columns: int
    spacing_m: float
    share_without_values: float

    @classmethod
    def of(cls, part: MapPart) -> Self:
        """Of one map."""
        missing = 0.0 if part.valid is None else 1.0 - float(np.mean(part.valid))
        rows, columns = part.values.shape
        return cls(part.raster.crs.name, *part.first, rows, columns, part.spacing, missing)


@dataclass(frozen=True)
class MatchNumbers:
    """match.json."""

    epoch_utc: str
    images: Mapping[str, ImageNumbers]
    orthophoto: MapNumbers
    dem: MapNumbers
    map_accuracy_m: float | None
    control_points: int
    check_points: int
    tie_points: int
    points: Mapping[str, PointNumbers] | None

    @classmethod
    def of(cls, run: Match) -> Self:
        """Of a run."""
        maps, role = run.ground.control, run.measurements.ground.role
        return cls(
            epoch_utc=run.measurements.platform.epoch,
            images={name: ImageNumbers.of(image) for name, image in run.ground.images.items()},
            orthophoto=MapNumbers.of(maps.orthophoto),
            dem=MapNumbers.of(maps.dem),
            map_accuracy_m=run.accuracy,
            control_points=int(np.sum(role == "control")),
            check_points=int(np.sum(role == "check")),
            tie_points=int(np.sum(role == "tie")),
            points=PointNumbers.by_sort(run.points),
        )


def match_numbers(run: Match) -> dict[str, Any]:
    """Contents of match.json without its frames."""
    return dict(plain_data(MatchNumbers.of(run)))


def exported(run: Match) -> dict[str, str]:
    """Path -> text of a folder of measurements."""
    return campaign_files([run.measurements], run.setup.camera.plain())
