"""Numbers of a simulated pass, as simulate.json has them: what the user of the images may know."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from twin.orbit.ground.orthophoto import Raster
from twin.orbit.images.image_points import CONSENSUS, MatchedLine, MatchedPoints, PatchPoints, status_text
from twin.orbit.images.patch import LineImage
from twin.orbit.images.simulate_run import Simulation
from twin.run.plain_data import plain_data


@dataclass(frozen=True)
class LineNumbers:
    """One line's image: its window, times of its first and last line, grey values, samples and motion."""

    first_line: int
    first_pixel: int
    lines: int
    pixels: int
    first_line_time_s: float
    last_line_time_s: float
    line_time_s: float
    mean_dn: float
    smallest_dn: int
    largest_dn: int
    rms_contrast: float
    saturated_pixels: int
    sample_along_line_m: float
    sample_along_track_m: float
    mtf_nyquist_along_line: float
    mtf_nyquist_along_track: float
    advance_px_per_line: float
    drift_px_per_line: float
    geometry_error_px: float

    @classmethod
    def of(cls, image: LineImage) -> Self:
        """Of one line."""
        window, sensor, frame = image.window, image.measured, image.frame
        first = sensor.time(np.array([window.first_line, window.first_line + window.lines - 1]))
        return cls(
            first_line=window.first_line,
            first_pixel=window.first_pixel,
            lines=window.lines,
            pixels=window.pixels,
            first_line_time_s=float(first[0]),
            last_line_time_s=float(first[1]),
            line_time_s=sensor.line_time,
            mean_dn=float(frame.mean()),
            smallest_dn=int(frame.min()),
            largest_dn=int(frame.max()),
            rms_contrast=float(frame.std() / frame.mean()),
            saturated_pixels=image.saturated,
            sample_along_line_m=image.sample[0],
            sample_along_track_m=image.sample[1],
            mtf_nyquist_along_line=image.nyquist[0],
            mtf_nyquist_along_track=image.nyquist[1],
            advance_px_per_line=image.motion.advance,
            drift_px_per_line=image.motion.drift,
            geometry_error_px=image.error,
        )


@dataclass(frozen=True)
class Georeference:
    """Where a raster's pixels lie, exactly: longitude and latitude are linear in column and row."""

    rows: int
    columns: int
    spacing_m: float
    first_longitude_deg: float
    first_latitude_deg: float
    longitude_per_column_deg: float
    latitude_per_row_deg: float

    @classmethod
    def of(cls, raster: Raster) -> Self:
        """Of one raster."""
        frame = raster.frame
        per_longitude, per_latitude = frame.scale
        return cls(
            rows=raster.values.shape[0],
            columns=raster.values.shape[1],
            spacing_m=raster.spacing,
            first_longitude_deg=float(np.degrees(frame.longitude + raster.west / per_longitude)),
            first_latitude_deg=float(np.degrees(frame.latitude + raster.north / per_latitude)),
            longitude_per_column_deg=float(np.degrees(raster.spacing / per_longitude)),
            latitude_per_row_deg=float(-np.degrees(raster.spacing / per_latitude)),
        )


def reasons(line: MatchedLine) -> Mapping[str, int]:
    """Why points were not accepted, the most frequent first."""
    count = Counter(int(code) for code in line.status[~line.accepted])
    return {status_text(code): number for code, number in count.most_common()}


def median_way(line: MatchedLine) -> np.ndarray:
    """(2,) from predicted to found, median of the accepted, lines and pixels."""
    return np.asarray(np.median((line.place - line.predicted)[line.accepted], axis=0))


def median_sigma(line: MatchedLine) -> np.ndarray:
    """(2,) of lines and pixels, median of the accepted."""
    return np.asarray(np.median(np.sqrt(np.diagonal(line.covariance[line.accepted], axis1=1, axis2=2)), axis=0))


@dataclass(frozen=True)
class MatchedNumbers:
    """Points of one sort in one line: how many, medians of displacement and sigma of those accepted."""

    found: int
    matched: int
    accepted: int
    rejected_by_consensus: int
    not_accepted: Mapping[str, int]
    displacement_lines_px: float
    displacement_pixels_px: float
    sigma_lines_px: float
    sigma_pixels_px: float
    consensus_scatter_px: float

    @classmethod
    def of(cls, line: MatchedLine) -> Self:
        """Of one line."""
        way, sigma = median_way(line), median_sigma(line)
        return cls(
            found=int(np.isfinite(line.place[:, 0]).sum()),
            matched=int(line.matched.sum()),
            accepted=int(line.accepted.sum()),
            rejected_by_consensus=int((line.status == CONSENSUS).sum()),
            not_accepted=reasons(line),
            displacement_lines_px=float(way[0]),
            displacement_pixels_px=float(way[1]),
            sigma_lines_px=float(sigma[0]),
            sigma_pixels_px=float(sigma[1]),
            consensus_scatter_px=line.scatter,
        )


@dataclass(frozen=True)
class PointNumbers:
    """Points of one sort; ties are chosen in a line that is left out."""

    sought: int
    in_all_lines: int
    lines: Mapping[str, MatchedNumbers]

    @classmethod
    def of(cls, points: MatchedPoints) -> Self:
        """Of one sort."""
        lines = {name: MatchedNumbers.of(line) for name, line in points.lines.items() if name != points.source}
        return cls(len(points.ground), int(points.in_all.sum()), lines)

    @classmethod
    def by_sort(cls, points: PatchPoints | None) -> dict[str, Self] | None:
        """Sort -> numbers; None where none were measured."""
        return None if points is None else {sort: cls.of(one) for sort, one in points.sorts.items()}


@dataclass(frozen=True)
class SimulateNumbers:
    """simulate.json."""

    seed: int
    epoch_utc: str
    longitude_deg: float
    latitude_deg: float
    lines: Mapping[str, LineNumbers]
    orthophoto: Georeference
    dem: Georeference
    points: Mapping[str, PointNumbers] | None

    @classmethod
    def of(cls, run: Simulation) -> Self:
        """Of a pass."""
        (longitude, latitude), control = run.place, run.patch.control
        return cls(
            seed=run.seed,
            epoch_utc=str(run.spec.orbit.epoch),
            longitude_deg=float(np.degrees(longitude)),
            latitude_deg=float(np.degrees(latitude)),
            lines={name: LineNumbers.of(image) for name, image in run.patch.images.items()},
            orthophoto=Georeference.of(control.orthophoto),
            dem=Georeference.of(control.dem),
            points=PointNumbers.by_sort(run.points),
        )


def simulate_numbers(run: Simulation) -> dict[str, Any]:
    """Contents of simulate.json without its frames."""
    return dict(plain_data(SimulateNumbers.of(run)))
