"""Measured points as plain data: a listing of them, numbers of each line, numbers that only the truth knows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from twin.artefact import Data
from twin.data_file import csv_table
from twin.orbit.images.patch import Patch
from twin.orbit.images.point_judgement import LineJudgement, judged, true_ground
from twin.orbit.images.points import CONSENSUS, MatchedLine, MatchedPoints, PatchPoints, status_text

HEADS = (
    "sort",
    "point",
    "line_name",
    "longitude_deg",
    "latitude_deg",
    "height_m",
    "x_itrs_m",
    "y_itrs_m",
    "z_itrs_m",
    "predicted_line",
    "predicted_pixel",
    "line",
    "pixel",
    "sigma_line_px",
    "sigma_pixel_px",
    "correlation_of_sigmas",
    "template_correlation",
    "accepted",
    "status",
)


@dataclass(frozen=True, eq=False)
class PointListing(Data):
    """Rows under `HEADS`, kept as CSV and named in the report."""

    @property
    def kind(self) -> str:
        """Ending of the file."""
        return "csv"

    def content(self) -> bytes:
        """The rows with all their digits; what there is not is empty."""
        return csv_table([HEADS, *self.data])


def listing(patch: Patch, points: PatchPoints) -> list[list[Any]]:
    """A row for each point and line."""
    rows: list[list[Any]] = []
    for sort, one in points.sorts.items():
        degrees = _degrees(patch, one)
        for name, line in one.lines.items():
            image, expected = line.image, line.predicted + np.array(line.first)
            sigma = np.sqrt(np.diagonal(line.covariance, axis1=1, axis2=2))
            with np.errstate(invalid="ignore", divide="ignore"):
                together = line.covariance[:, 0, 1] / np.prod(sigma, axis=1)
            for k in range(len(one.ground)):
                kind = "check" if one.check[k] else sort
                numbers = (*expected[k], *image[k], *sigma[k], together[k], line.correlation[k])
                shown = [float(v) if np.isfinite(v) else None for v in numbers]
                code = int(line.status[k])
                ground = [*map(float, degrees[k]), *map(float, one.ground[k])]
                rows.append([kind, k, name, *ground, *shown, int(line.accepted[k]), status_text(code)])
    return rows


def points_data(points: PatchPoints) -> dict[str, Any]:
    """What the user knows, by sort and line."""
    out: dict[str, Any] = {}
    for sort, one in points.sorts.items():
        lines = {name: _line(line) for name, line in one.lines.items() if name != one.source}
        out[sort] = {"sought": len(one.ground), "in_all_lines": int(one.in_all.sum()), "lines": lines}
    return out


def points_truth(patch: Patch, points: PatchPoints) -> dict[str, Any]:
    """What only the truth knows, by sort and line."""
    out: dict[str, Any] = {}
    for sort, one in points.sorts.items():
        lines = {name: _judged(line) for name, line in judged(patch, one).items()}
        out[sort] = {"itrs_m": true_ground(patch, one).tolist(), "lines": lines}
    return out


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


def _line(line: MatchedLine) -> dict[str, Any]:
    way, sigma = median_way(line), median_sigma(line)
    return {
        "found": int(np.isfinite(line.place[:, 0]).sum()),
        "matched": int(line.matched.sum()),
        "accepted": int(line.accepted.sum()),
        "rejected_by_consensus": int((line.status == CONSENSUS).sum()),
        "not_accepted": dict(reasons(line)),
        "displacement_lines_px": float(way[0]),
        "displacement_pixels_px": float(way[1]),
        "sigma_lines_px": float(sigma[0]),
        "sigma_pixels_px": float(sigma[1]),
        "consensus_scatter_px": line.scatter,
    }


def _judged(one: LineJudgement) -> dict[str, Any]:
    error = [[float(v) if np.isfinite(v) else None for v in row] for row in one.error]
    return {
        "found": one.found,
        "matched": one.matched,
        "accepted": one.accepted,
        "wrong_found": one.wrong_found,
        "wrong_matched": one.wrong_matched,
        "wrong_accepted": one.wrong_accepted,
        "right_rejected_by_consensus": one.good_lost,
        "rms_lines_px": float(one.rms[0]),
        "rms_pixels_px": float(one.rms[1]),
        "mean_lines_px": float(one.mean[0]),
        "mean_pixels_px": float(one.mean[1]),
        "chi_square": one.chi_square,
        "degrees_of_freedom": one.degrees_of_freedom,
        "error_px": error,
    }


def _degrees(patch: Patch, points: MatchedPoints) -> np.ndarray:
    """Longitude and latitude, degrees, and height, metres, (n, 3)."""
    per_longitude, per_latitude = patch.frame.scale
    longitude = np.degrees(patch.frame.longitude + points.east / per_longitude)
    latitude = np.degrees(patch.frame.latitude + points.north / per_latitude)
    return np.column_stack([longitude, latitude, points.height])
