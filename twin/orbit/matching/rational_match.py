"""Tie points between images that come with rational polynomials (RPC), guided by these and a range of heights.

Distinct points of each image are searched in every other one along their epipolar line: at heights in steps of the
search radius (vertical line locus), by correlation with the template in the other image's geometry. The best height
starts the least squares match (`analysis.matching`). Positions across the epipolar line differ from the prediction by
the errors of the polynomials alone, which are smooth: matches that contradict their neighbours there are rejected.
Along the line the ground is free within the range of heights.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from analysis.matching.correlation import MatchOptions, Reason, distinct_points, resampled, search
from analysis.matching.matches import DisplacementField, Matches, consensus, match_windows
from optics.numerics.number_tree import FrozenMap
from twin.framework.procedure import Advance, BenchError, silent
from twin.framework.record import Quantity, Record
from twin.orbit.block.rational_block import read_image
from twin.orbit.export.rational_polynomial import PolynomialImage
from twin.orbit.flight.earth import Earth
from twin.orbit.images.image_points import CONSENSUS, MatchedLine, MatchedPoints
from twin.orbit.images.simulate_run import POINTS
from twin.orbit.matching.pixels import read_pixels
from twin.orbit.matching.surface import Surface, surface
from twin.orbit.measured.measurement_tables import csv_text

if TYPE_CHECKING:
    from scenes.specs.orbit.rational import RationalPointsSpec, SurfaceSpec
    from scenes.specs.orbit.setup import RationalMatchSetup

_ITERATIONS = 3
"""Number of iterations in which the height of a match is brought to the middle of its epipolar line; one suffices for
lines that are straight over the search radius."""
_APART = 3.0
"""Distance, in pixels along the epipolar line, from which two peaks of the search count as different."""
_LEAST_RISE = 1e-6
"""Parallax, in pixels per metre of height, below which two images see the ground from one direction."""
_NO_FIELD = DisplacementField(np.zeros((1, 2)), np.zeros(2), 1.0, 0, None)
"""Displacement of images with too few matches."""
_LEAST = 12
"""Smallest number of matches of two images: four times the three terms of a linear displacement."""


@dataclass(frozen=True, eq=False)
class Frame:
    """Image with its rational polynomials.

    Attributes
    ----------
    values : (lines, samples) ndarray
        Grey values.
    image : PolynomialImage
        Rational polynomials.
    """

    values: np.ndarray
    image: PolynomialImage


@dataclass(frozen=True, eq=False)
class RationalMatch:
    """Tie points between images with rational polynomials.

    Attributes
    ----------
    setup : RationalMatchSetup
        Test file.
    points : Mapping[str, MatchedPoints]
        Image in which points were chosen -> the points with their matches in every other image that shows them.
    surface : Surface or None
        Grid of heights, if the file asks for it.
    """

    setup: RationalMatchSetup
    points: FrozenMap[str, MatchedPoints]
    surface: Surface | None = None

    @cached_property
    def table(self) -> dict[str, list[Any]]:
        """Columns of the table of image points: all points that two images or more see."""
        heads = ("point", "image", "line", "sample", "line_sigma", "sample_sigma", "correlation")
        columns: dict[str, list[Any]] = {head: [] for head in heads}
        for source, points in self.points.items():
            seen = np.sum([line.accepted for line in points.lines.values()], axis=0) >= 2
            for name, line in points.lines.items():
                which = np.flatnonzero(line.accepted & seen)
                measured = line.measured(which, which)
                sigma = np.sqrt(np.diagonal(measured.covariance, axis1=1, axis2=2))
                columns["point"] += [f"{source}-{k}" for k in which.tolist()]
                columns["image"] += [name] * len(which)
                like = measured.covariance[:, 0, 1] / sigma[:, 0] / sigma[:, 1]
                values = (measured.line, measured.pixel, sigma[:, 0], sigma[:, 1], like)
                for head, column in zip(heads[2:], values, strict=True):
                    columns[head] += column.tolist()
        return columns


def run_rational_match(setup: RationalMatchSetup, advance: Advance = silent) -> RationalMatch:
    """Match tie points between images with rational polynomials; nothing is drawn at random.

    Raises
    ------
    InputError
        A file cannot be read.
    BenchError
        No two images have common points.
    """
    spec = setup.test
    if spec.surface is not None and spec.surface.crs is not None:
        _require_metres(spec.surface)
    frames = {}
    for name, image in spec.images.items():
        frames[name] = Frame(read_pixels(image, None, len(spec.images)), read_image(image))
    points: dict[str, MatchedPoints] = {}
    for k, source in enumerate(frames):
        advance("points", k, len(frames))
        points[source] = _points_of(source, frames, spec.heights, spec.points)
    advance("points", len(frames), len(frames))
    if not any(line.accepted.any() for group in points.values() for line in group.searched_lines.values()):
        low, high = spec.heights
        problem = f"no two images have common points at heights of {low:g} to {high:g} m above the ellipsoid"
        remedy = (
            "heights of the ground that they show (this range probably does not contain it), images of the same ground"
        )
        raise BenchError(problem, ("heights",), f"{remedy}, or a larger points.search_radius")
    grid = None
    if spec.surface is not None:
        images = {name: (frame.values, frame.image) for name, frame in frames.items()}
        grid = surface(images, spec.heights, spec.surface, advance)
    return RationalMatch(setup, FrozenMap(points), grid)


def _require_metres(spec: SurfaceSpec) -> None:
    """Raise InputError if the system of a grid is unknown, or its coordinates are not metres in a plane."""
    try:
        crs = CRS(spec.crs)
    except CRSError as error:
        raise spec.error("not a coordinate reference system", ("crs",), value=spec.crs) from error
    if not crs.is_projected or any(axis.unit_conversion_factor != 1.0 for axis in crs.axis_info[:2]):
        allowed = "a projected coordinate reference system in metres, such as EPSG:32631"
        raise spec.error("coordinates that are not metres", ("crs",), value=spec.crs, allowed=allowed)


def _points_of(
    source: str, frames: dict[str, Frame], heights: tuple[float, float], spec: RationalPointsSpec
) -> MatchedPoints:
    """Return distinct points of an image, matched in every other image that shows enough of them."""
    frame = frames[source]
    border = spec.template // 2 + spec.search_radius
    if min(frame.values.shape) <= 2 * border + 1:
        shape = " x ".join(str(n) for n in frame.values.shape)
        problem = f"{source}: {shape} pixels have no room for a template of {spec.template} pixels and its search"
        raise BenchError(problem, ("points",), "a larger image, or a smaller reach or template")
    place = distinct_points(frame.values, spec.tie, spacing=max(0.5 * spec.template, 1.0), border=border)
    count = len(place)
    lines, levels = {source: MatchedLine.chosen(place)}, np.full((len(frames), count), np.nan)
    for k, (name, other) in enumerate(frames.items()):
        if name != source and count:
            lines[name], levels[k] = _searched(frame, other, place, heights, spec)
    known = np.isfinite(levels).any(axis=0)
    height = np.full(count, 0.5 * sum(heights))
    height[known] = np.nanmean(levels[:, known], axis=0)
    ground = frame.image.ground(place, height)
    none = np.zeros(count)
    return MatchedPoints("tie", none, none, height, ground, none.astype(bool), FrozenMap(lines))


def _searched(
    frame: Frame, other: Frame, place: np.ndarray, heights: tuple[float, float], spec: RationalPointsSpec
) -> tuple[MatchedLine, np.ndarray]:
    """Return n points of one image matched in another one, and their heights (n,), NaN where they were not accepted."""
    options = MatchOptions(least_correlation=spec.least_correlation, largest_sigma=spec.largest_sigma)
    middle = np.full(len(place), 0.5 * sum(heights))
    _, rise = _seen(frame, other, place, middle)
    length = np.nanmax(np.linalg.norm(rise, axis=1), initial=0.0)
    steps = int(np.ceil((heights[1] - heights[0]) * length / spec.search_radius)) + 1
    templates = _templates(frame, other, place, middle, spec.template)
    levels = np.linspace(*heights, steps) if steps > 1 else middle[:1]
    positions, values = np.full((len(levels), len(place), 2), np.nan), np.full((len(levels), len(place)), -1.0)
    for k, level in enumerate(levels.tolist()):
        expected, _ = other.image.seen(frame.image.ground(place, level))
        peaks = search(other.values, templates, expected, spec.search_radius)
        accepted = peaks.reason == Reason.ACCEPTED
        positions[k], values[k] = peaks.position, np.where(accepted, peaks.value, -1.0)
    best = np.argmax(values, axis=0)
    which = np.arange(len(place))
    peak, value = positions[best, which], values[best, which]
    # another peak along the epipolar line, as in regular patterns
    apart = np.linalg.norm(positions - peak, axis=2) > _APART
    rival = np.max(np.where(apart, values, -1.0), axis=0)
    height = levels[best]
    for _ in range(_ITERATIONS):
        at, rise = _seen(frame, other, place, height)
        square = np.sum(rise**2, axis=1)
        along = np.sum((peak - at) * rise, axis=1) / np.maximum(square, _LEAST_RISE**2)
        height = np.clip(height + np.where(square > _LEAST_RISE**2, along, 0.0), heights[0], heights[1])
    lost = ~(value > 0.0)
    height = np.where(lost, middle, height)
    templates = _templates(frame, other, place, height, spec.template)
    templates[lost] = np.nan
    start = np.where(lost[:, None], 0.0, peak)
    match = match_windows(other.values, templates, start, search_radius=2, options=options)
    status = match.reason.astype(np.int64)
    status[lost] = Reason.OUTSIDE
    status[(status == 0) & (rival > options.largest_ratio * value)] = Reason.AMBIGUOUS
    return _agreed(frame, other, place, height, heights, match, status, spec)


def _agreed(
    frame: Frame,
    other: Frame,
    place: np.ndarray,
    height: np.ndarray,
    heights: tuple[float, float],
    match: Matches,
    status: np.ndarray,
    spec: RationalPointsSpec,
) -> tuple[MatchedLine, np.ndarray]:
    """Return the matches without those that contradict their neighbours across the epipolar line, and their heights."""
    good = status == 0
    at, rise = _seen(frame, other, place, height)
    unit = rise / np.maximum(np.linalg.norm(rise, axis=1, keepdims=True), _LEAST_RISE)
    across = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    miss = np.where(good[:, None], match.position - at, np.nan)
    sideways = np.sum(miss * across, axis=1)
    variance = np.einsum("ni,nij,nj->n", across, match.covariance, across) + spec.roughness**2
    field, scatter, text = _NO_FIELD, 0.0, f"{int(good.sum())} matches are too few for a consensus"
    if good.sum() >= _LEAST:
        agreed = consensus(
            at,
            at + sideways[:, None] * across,
            covariance=variance[:, None, None] * np.eye(2),
            degree=1,
            false_alarm=spec.false_alarm,
        )
        status[good & ~agreed.accepted] = CONSENSUS
        field, scatter, text = agreed.field, agreed.scatter, agreed.text
    else:
        status[good] = CONSENSUS
    along = np.sum(miss * unit, axis=1) / np.maximum(np.linalg.norm(rise, axis=1), _LEAST_RISE)
    level = np.where(status == 0, height + along, np.nan)
    outside = (level < heights[0]) | (level > heights[1])
    status[outside] = Reason.OUTSIDE
    line = MatchedLine(at, match.position, match.covariance, match.correlation, status, (0, 0), scatter, text, field)
    return line, np.where(outside, np.nan, level)


def _seen(frame: Frame, other: Frame, place: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (n, 2) in another image of points of one image at heights, and pixels per metre of height."""
    ground = frame.image.ground(place, height)
    position, slope = other.image.seen(ground)
    # the point moves along the line of sight of the first image
    step = frame.image.ground(place, height + 1.0) - ground
    return position, np.einsum("nij,nj->ni", slope, step)


def _templates(frame: Frame, other: Frame, place: np.ndarray, height: np.ndarray, side: int) -> np.ndarray:
    """Return n templates of one image, (n, side, side), in the geometry of the other image at heights of the ground."""
    ground = frame.image.ground(place, height)
    longitude, latitude, _ = Earth().geodetic(ground)
    level = np.stack([-np.sin(longitude), np.cos(longitude), np.zeros_like(longitude)], axis=1)
    up = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=1
    )
    axes = np.stack([level, np.cross(up, level)], axis=2)
    here, there = (view.image.seen(ground)[1] @ axes for view in (frame, other))
    defined = np.isfinite(here).all(axis=(1, 2)) & np.isfinite(there).all(axis=(1, 2))
    affine = np.full_like(here, np.nan)
    affine[defined] = here[defined] @ np.linalg.inv(there[defined])
    grid = np.arange(side) - side // 2
    down, right = np.meshgrid(grid, grid, indexing="ij")
    offset = np.einsum("nij,jkl->nikl", affine, np.stack([down, right]))
    at = place[:, :, None, None] + offset
    return resampled(frame.values, at[:, 0], at[:, 1])


def tie_points(run: RationalMatch) -> int:
    """Return the number of points that two images or more see."""
    return len(set(run.table["point"]))


SURFACE: Record[Surface] = Record(
    "Grid of heights above the ellipsoid.",
    Quantity("crs", lambda grid: grid.crs, "coordinate reference system"),
    Quantity("spacing_m", lambda grid: grid.spacing, "side of a cell", decimals=3),
    Quantity("cells", lambda grid: grid.height.size, "cells of the grid"),
    Quantity("share", lambda grid: grid.share, "fraction of the cells that have a height", decimals=3),
    Quantity("sigma_m", lambda grid: float(np.nanmedian(grid.sigma)), "sigma of a height, median", "sigma", 3),
    Quantity(
        "pairs_sigma_m",
        lambda grid: {f"{a} {b}": sigma for (a, b), sigma in grid.sigmas.items()},
        "two images -> sigma of a height by them",
    ),
    Quantity(
        "pairs_scatter",
        lambda grid: grid.scatter,
        "scatter of the heights of two pairs over that predicted; null for a single pair",
    ),
)
RATIONAL: Record[RationalMatch] = Record(
    "match.json of images with rational polynomials.",
    Quantity("tie_points", tie_points, "points that two images or more see"),
    Quantity("image_points", lambda run: len(run.table["point"]), "image points of these"),
    Quantity("points", lambda run: run.points, "image in which points were chosen -> matches", record=POINTS),
    Quantity("surface", lambda run: run.surface, "grid of heights, where the file asks for it", record=SURFACE),
)


def rational_files(run: RationalMatch) -> dict[str, str | bytes]:
    """Return the table of image points for ``python -m twin.orbit adjust`` and the grid of heights, path -> content."""
    files: dict[str, str | bytes] = {"image_points.csv": csv_text(run.table)}
    return files if run.surface is None else files | {"surface.tif": run.surface.tiff()}
