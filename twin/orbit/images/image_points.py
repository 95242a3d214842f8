"""Measurement of control, check and tie points in images by matching.

Control and check points are distinct points of the orthophoto with the reference height; tie points are distinct points
of the nadir line's frame. Their templates are brought into each line's geometry and matched (`analysis.matching`), and
matches that do not follow one smooth displacement per patch and line are rejected. The input is frames with the
measured sensors, and a map with heights: a simulated patch, or a user's images with orthophoto and elevation model.

A template's samples are the pixels about the predicted position of its point, which is not a whole pixel. The sensor as
the user knows it projects each sample to the reference heights: over so few pixels the mapping to the ground is affine
in row and column and linear in height, to a millimetre. Errors of this sensor displace the whole template and are found
by the search.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates, spline_filter, zoom

from analysis.matching.correlation import MatchOptions, Reason, distinct_points, resampled
from analysis.matching.matches import DisplacementField, consensus, match_windows
from optics.numerics.array_math import PhysicalError
from optics.numerics.number_tree import FrozenMap
from twin.orbit.flight.sensor import Sensor
from twin.orbit.ground.grid import GroundFrame
from twin.orbit.ground.orthophoto import Map, Maps
from twin.orbit.images.pushbroom import Window
from twin.orbit.measured.pass_measurements import ImagePoints

if TYPE_CHECKING:
    from scenes.specs.orbit.scene import ImagePointsSpec

UNMODELLED_SIGMA = 0.1
"""Standard deviation, in pixels, added to that of a match for errors that its fit cannot show.

Such errors are due to illumination in another season (RMS error of matches 0.11 px where 0.06 px is predicted) and to
attitude changes between readings. A tie point has only this sigma in the frame in which it was chosen.
"""


@dataclass(frozen=True, eq=False)
class LineFrame:
    """Image of a line camera with its sensor model as the user knows it.

    Attributes
    ----------
    frame : (lines, pixels) ndarray
        Grey values, columns as pixels of the line.
    window : Window
        Position of the frame in the line's whole image.
    measured : Sensor
        The line as the user knows it, on the measured trajectory.
    sample : tuple of float
        Ground distance of neighbouring pixels, and of neighbouring lines, in the window's middle, metres.
    """

    frame: np.ndarray
    window: Window
    measured: Sensor
    sample: tuple[float, float]

    def image_point(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return line and pixel of real-valued positions (row, column) of the frame."""
        return self.window.first_line + np.asarray(row), self.window.first_pixel + np.asarray(column)


@dataclass(frozen=True, eq=False)
class ImagedGround:
    """Patch of ground with its images and control data.

    Attributes
    ----------
    frame : GroundFrame
        Plane coordinates of the ground, metres east and north of the patch's middle.
    images : mapping of str to LineFrame
        Image of each line.
    control : Maps
        Orthophoto and elevation model.
    """

    frame: GroundFrame
    images: Mapping[str, LineFrame]
    control: Maps[Map]


SOFTENING = 0.4
"""RMS radius of the Gaussian low-pass filter of an orthophoto, in units of the pixel distance of the image.

It models the blur of pixel, lens and motion of the line, which a sharp orthophoto does not have; the matching estimates
the remaining blur.
"""
_STEP = 50.0
"""Height interval over which the mapping from image to ground is treated as linear, in metres."""
_FOLLOWED = 8
"""Number of iterations that intersect a line of sight with the terrain.

Each multiplies the error by 0.2 or less, the terrain's slope times the tangent of the line of sight's angle from the
vertical.
"""


@dataclass(frozen=True, eq=False)
class ReferenceHeights:
    """Heights of a reference elevation model, a cubic spline through its grid points.

    Attributes
    ----------
    raster : Map
        Raster of the grid points' heights.
    coefficients : ndarray
        Coefficients of the spline.
    """

    raster: Map
    coefficients: np.ndarray

    @classmethod
    def of(cls, dem: Map) -> ReferenceHeights:
        """Interpolate a raster of heights, in metres; missing grid points are replaced by the nearest ones."""
        values = dem.values.astype(np.float64)
        if dem.valid is not None and not dem.valid.all():
            nearest = distance_transform_edt(~dem.valid, return_distances=False, return_indices=True)
            values = values[tuple(nearest)]
        return cls(dem, spline_filter(values, order=3, mode="mirror"))

    def __call__(self, east: np.ndarray, north: np.ndarray) -> np.ndarray:
        """Return heights at positions, in metres; NaN outside the grid or where one of four neighbours is missing."""
        pixels = np.stack(self.raster.row_column(east, north))
        height = map_coordinates(self.coefficients, pixels, order=3, mode="mirror", prefilter=False)
        last = np.array(self.coefficients.shape).reshape(2, *(1,) * (pixels.ndim - 1)) - 1
        known = np.all((pixels >= 0.0) & (pixels <= last), axis=0)
        valid = self.raster.valid
        if valid is not None:
            cell = np.clip(np.floor(np.nan_to_num(pixels)).astype(np.intp), 0, np.maximum(last - 1, 0))
            for down, across in ((0, 0), (0, 1), (1, 0), (1, 1)):
                known &= valid[np.minimum(cell[0] + down, last[0]), np.minimum(cell[1] + across, last[1])]
        return np.asarray(np.where(known, height, np.nan))

    @property
    def mean(self) -> float:
        """Mean height of all grid points, metres."""
        valid = self.raster.valid
        return float(np.mean(self.raster.values if valid is None else self.raster.values[valid]))


def predicted(image: LineFrame, points: np.ndarray) -> np.ndarray:
    """Return row and column in the frame, (n, 2), of n ITRS points according to the measured sensor; NaN outside."""
    line, pixel = image.measured.image(points)
    return np.stack([line - image.window.first_line, pixel - image.window.first_pixel], axis=-1)


def in_frame(image: LineFrame, position: np.ndarray, border: float) -> np.ndarray:
    """Return a mask of positions (..., 2) that lie at least `border` pixels inside a frame's edge; False for NaN."""
    last = np.array(image.frame.shape) - 1.0 - border
    return np.asarray(np.all((position >= border) & (position <= last), axis=-1))


Samples: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray]
"""East, north and height, in metres, of the ground under n templates' pixels, (n, side, side) each."""


def _ground_of_samples(
    image: LineFrame, frame: GroundFrame, heights: ReferenceHeights, points: np.ndarray, position: np.ndarray, side: int
) -> Samples:
    """Return east, north and height, in metres, of the ground under n templates' pixels, (n, side, side) each.

    Parameters
    ----------
    image : LineFrame
        Image of the templates; its measured sensor is used.
    frame : GroundFrame
        Coordinates of the ground.
    heights : ReferenceHeights
        Heights of the ground.
    points : (n, 3) ndarray
        Ground points of the templates' middles according to the measured sensor, ITRS, metres. Their height is used,
        and reference heights enter only as differences from those at the points.
    position : (n, 2) ndarray
        Rows and columns in the frame.
    side : int
        Side of a template, pixels.
    """
    east, north, height = (v[:, None, None] for v in frame.local(points))
    half = side // 2
    row, column = image.image_point(position[:, 0], position[:, 1])
    offsets = [(-half, 0, 0.0), (half, 0, 0.0), (0, -half, 0.0), (0, half, 0.0), (0, 0, _STEP)]
    known = image.measured
    ends = []
    for down, across, up in offsets:
        seen = known.ground(row + down, column + across, height[:, 0, 0] + up)
        ends.append(np.stack(frame.local(seen)[:2]))
    centre = np.stack([east, north])[:, :, 0, 0]
    by_row, by_column = ((ends[k + 1] - ends[k]) / (2.0 * half) for k in (0, 2))
    by_height = (ends[4] - centre) / _STEP
    grid = np.arange(-half, half + 1.0)
    level = centre[..., None, None] + by_row[..., None, None] * grid[:, None] + by_column[..., None, None] * grid
    above: np.ndarray = np.zeros(level.shape[1:])
    for _ in range(_FOLLOWED):
        e, n = level + by_height[..., None, None] * above
        above = heights(e, n) - height
    e, n = level + by_height[..., None, None] * above
    return e, n, height + above


def _templates_of_image(
    source: LineFrame, frame: GroundFrame, samples: Samples, points: np.ndarray, position: np.ndarray
) -> np.ndarray:
    """Return n templates of k x k pixels, (n, k, k), sampled from another line's image.

    Parameters
    ----------
    source : LineFrame
        Image from which the templates are sampled.
    frame : GroundFrame
        Coordinates of the ground.
    samples : tuple of ndarray
        East, north and height of the ground under the templates' pixels, from `_ground_of_samples`.
    points : (n, 3) ndarray
        Ground points of the templates' middles, ITRS, metres.
    position : (n, 2) ndarray
        Row and column of the points in the other image.
    """
    centre = np.stack(frame.local(points))
    base = predicted(source, points)
    at = np.broadcast_to(position.T[:, :, None, None], (2, *samples[0].shape))
    for k, sample in enumerate(samples):
        shifted = centre.copy()
        shifted[k] += _STEP
        slope = (predicted(source, frame.itrs(*shifted)) - base) / _STEP
        at = at + slope.T[:, :, None, None] * (sample - centre[k][:, None, None])
    return resampled(source.frame, at[0], at[1])


CONSENSUS = 100
"""Status of a match whose displacement contradicts those of its neighbours; other codes are those of
`analysis.matching.correlation.Reason`.
"""
SOURCE = 101
"""Status of a tie point in the frame in which it was chosen, where its position is exact by definition."""
_MASK = 16
"""Step, in pixels of the orthophoto, of the grid on which it is tested whether every line sees the ground."""
_GROUND_ITERATIONS = 12
"""Number of iterations that intersect a line of sight with the ground."""
_RISE = 10.0
"""Height difference over which the image displacement due to height is treated as linear, in metres."""
Kind = Literal["map", "tie"]


POINTS_REMEDY = "a larger patch, a smaller search_radius or template, or more points"
"""Advice to the user at the end of messages of a PointsError."""


class PointsError(PhysicalError, ValueError):
    """Error raised when the points of a patch cannot be measured in its images."""


@dataclass(frozen=True, eq=False)
class MatchedLine:
    """Points matched in one line's frame.

    Attributes
    ----------
    predicted : (n, 2) ndarray for n points
        Row and column of the points in the frame, predicted by the measured sensor.
    position : (n, 2) ndarray
        Measured row and column; NaN where matching failed.
    covariance : (n, 2, 2) ndarray
        Covariance of the measured positions, px^2.
    correlation : (n,) ndarray
        Correlation coefficient of image and fitted template.
    status : (n,) ndarray of int
        0 for an accepted match, `CONSENSUS`, `SOURCE`, or the reason of a failed match.
    first : tuple of int
        Line and pixel of the frame's first pixel in the whole image.
    scatter : float
        Scatter of the displacements about the smooth displacement field in excess of their covariances, px.
    text : str
        Result of the comparison of matches with their neighbours, in words.
    displacement_field : DisplacementField or None
        Smooth displacement from predicted to measured; None in the frame in which tie points were chosen.
    """

    predicted: np.ndarray
    position: np.ndarray
    covariance: np.ndarray
    correlation: np.ndarray
    status: np.ndarray
    first: tuple[int, int]
    scatter: float
    text: str
    displacement_field: DisplacementField | None = None

    @classmethod
    def chosen(cls, position: np.ndarray, first: tuple[int, int] = (0, 0)) -> MatchedLine:
        """Return n points at the positions (n, 2) in the frame in which they were chosen, which are exact.

        The frame's first pixel is at `first`, line and pixel in the whole image.
        """
        count = len(position)
        covariance, correlation = np.zeros((count, 2, 2)), np.ones(count)
        status = np.full(count, SOURCE)
        return cls(position, position, covariance, correlation, status, first, 0.0, f"{count} points chosen")

    @property
    def accepted(self) -> np.ndarray:
        """Mask (n,) of the n points that are matched and consistent with neighbours, or chosen in this frame."""
        return np.asarray((self.status == 0) | (self.status == SOURCE))

    @property
    def matched(self) -> np.ndarray:
        """Mask of the n points that matching accepted, before the comparison with neighbours, (n,) bool."""
        return np.asarray((self.status == 0) | (self.status == CONSENSUS))

    @property
    def image(self) -> np.ndarray:
        """Measured line and pixel of n points in the whole image, (n, 2)."""
        return self.position + np.array(self.first)

    @property
    def median_shift(self) -> np.ndarray:
        """Median displacement of the accepted points from predicted to measured, in lines and pixels, (2,)."""
        return np.asarray(np.median((self.position - self.predicted)[self.accepted], axis=0))

    @property
    def median_sigma(self) -> np.ndarray:
        """Median standard deviation of the accepted positions, in lines and pixels, (2,)."""
        return np.asarray(np.median(np.sqrt(np.diagonal(self.covariance[self.accepted], axis1=1, axis2=2)), axis=0))

    def measured(self, rows: np.ndarray, point: np.ndarray) -> ImagePoints:
        """Return selected image points, with `UNMODELLED_SIGMA` included in their covariances.

        Parameters
        ----------
        rows : ndarray
            Mask or index of the points.
        point : ndarray of int
            Index of the ground point of each selected point.
        """
        image, spread = self.image[rows], self.covariance[rows] + UNMODELLED_SIGMA**2 * np.eye(2)
        return ImagePoints.of(point, image[:, 0], image[:, 1], spread)

    @property
    def rejections(self) -> Mapping[str, int]:
        """Number of points that were not accepted for each reason, the most frequent reason first."""
        count = Counter(int(code) for code in self.status[~self.accepted])
        return {status_text(code): number for code, number in count.most_common()}

    def displacement(self, position: np.ndarray, height: np.ndarray) -> np.ndarray:
        """Return the smooth displacement from predicted to measured at n positions (n, 2) and heights (n,), (n, 2)."""
        if self.displacement_field is None:
            return np.zeros_like(position)
        return self.displacement_field(position, None if self.displacement_field.heights is None else height)


@dataclass(frozen=True, eq=False)
class MatchedPoints:
    """Points of one kind with their matches in every line.

    Attributes
    ----------
    kind : Kind
        "map" for points of the orthophoto, "tie" for tie points.
    east, north, height : (n,) ndarray
        Coordinates in the map, metres; for tie points, the intersection of the nadir line's measured line of sight with
        the reference heights.
    ground : (n, 3) ndarray for n points
        The same points in the ITRS, metres.
    check : (n,) ndarray of bool
        Mask of check points.
    lines : mapping of str to MatchedLine
        Matches by name of the line.
    """

    kind: Kind
    east: np.ndarray
    north: np.ndarray
    height: np.ndarray
    ground: np.ndarray
    check: np.ndarray
    lines: Mapping[str, MatchedLine]

    @property
    def source(self) -> str | None:
        """Name of the line in whose frame tie points were chosen; None for points of the map."""
        return next((name for name, line in self.lines.items() if line.displacement_field is None), None)

    @property
    def searched_lines(self) -> Mapping[str, MatchedLine]:
        """Lines in which the points were searched: all but the line in which tie points were chosen."""
        return {name: line for name, line in self.lines.items() if name != self.source}

    @property
    def in_all(self) -> np.ndarray:
        """Mask of those of n points that are accepted in every line, (n,) bool."""
        return np.all([line.accepted for line in self.lines.values()], axis=0)


@dataclass(frozen=True, eq=False)
class PatchPoints:
    """Control, check and tie points measured in a patch; None for kinds that were not requested."""

    control: MatchedPoints | None
    ties: MatchedPoints | None

    @property
    def sorts(self) -> Mapping[str, MatchedPoints]:
        """Measured points by kind, ``control`` (which includes the check points) and ``tie``, as far as present."""
        both = {"control": self.control, "tie": self.ties}
        return {name: points for name, points in both.items() if points is not None}


def measure_points(patch: ImagedGround, spec: ImagePointsSpec) -> PatchPoints:
    """Measure control, check and tie points in the images of a patch.

    Raises
    ------
    PointsError
        The images are too small or have no distinct points, or there are too few matches.
    """
    if spec.tie and len(patch.images) < 2:
        raise PointsError("tie points need two lines")
    control = map_points(patch, spec) if spec.control + spec.check else None
    source = "nadir" if "nadir" in patch.images else next(iter(patch.images))
    return PatchPoints(control, tie_points(patch, spec, control, source) if spec.tie else None)


def status_text(code: int) -> str:
    """Return the status of a match in words."""
    extra = {CONSENSUS: "contradicted by its neighbours", SOURCE: "chosen in this image"}
    return extra.get(code) or Reason(code).text


def map_points(patch: ImagedGround, spec: ImagePointsSpec) -> MatchedPoints:
    """Measure control and check points, distinct points of the orthophoto, in the images of a patch.

    Raises
    ------
    PointsError
        A frame is too small for template and search range, there are no distinct points that every line sees, or there
        are too few matches.
    """
    border = spec.template // 2 + spec.search_radius
    _require_room(patch, spec)
    heights = ReferenceHeights.of(patch.control.dem)
    wanted = spec.control + spec.check
    east, north = _distinct_map(patch, heights, wanted, border, spec)
    height, photo = heights(east, north), patch.control.orthophoto
    ground = patch.frame.itrs(east, north, height)
    lines = {}
    for name, image in patch.images.items():
        at = predicted(image, ground)
        samples = _ground_of_samples(image, patch.frame, heights, ground, at, spec.template)
        smoothing = SOFTENING * float(np.mean(image.sample)) / photo.spacing
        patterns = resampled(photo.values, *photo.row_column(*samples[:2]), smoothing=smoothing)
        lines[name] = _matched(name, image, patterns, at, _rise(patch, image, ground, at), height, spec)
    which = np.arange(len(east))
    share = spec.check / max(wanted, 1)
    # Check points are spread evenly over the strength of the points.
    check = np.floor((which + 1) * share + 1e-9) > np.floor(which * share + 1e-9)
    return MatchedPoints("map", east, north, height, ground, check, FrozenMap(lines))


def tie_points(
    patch: ImagedGround, spec: ImagePointsSpec, control: MatchedPoints | None = None, source: str = "nadir"
) -> MatchedPoints:
    """Measure tie points, distinct points of one line's image, in the images of the other lines.

    Parameters
    ----------
    patch : ImagedGround
        Images and control of the ground.
    spec : ImagePointsSpec
        Number of points and options of the matching.
    control : MatchedPoints or None
        Control points of the patch, whose displacements correct the prediction. Without them, the reference heights are
        taken at the ground position according to the measured sensor, which is some 100 m wrong.
    source : str
        Name of the line in which the points are chosen.

    Raises
    ------
    PointsError
        A frame is too small for template and search range, there are no distinct points that every line sees, or there
        are too few matches.
    """
    border = spec.template // 2 + spec.search_radius
    _require_room(patch, spec)
    heights = ReferenceHeights.of(patch.control.dem)
    image = patch.images[source]
    position = distinct_points(image.frame, spec.tie, spacing=max(0.5 * spec.template, 1.0), border=border)
    ground = _ground_of_looks(patch, image, heights, position, control.lines[source] if control else None)
    seen = [in_frame(other, predicted(other, ground), border) for other in patch.images.values() if other is not image]
    good = np.all([np.isfinite(ground).all(axis=1), *seen], axis=0)
    position, ground = position[good], ground[good]
    if not len(position):
        raise PointsError(f"{source}: no distinct point is seen by every line {border} pixels from the frames' borders")
    east, north, height = patch.frame.local(ground)
    lines = {source: MatchedLine.chosen(position, (image.window.first_line, image.window.first_pixel))}
    for name, other in patch.images.items():
        if name == source:
            continue
        at = predicted(other, ground)
        samples = _ground_of_samples(other, patch.frame, heights, ground, at, spec.template)
        patterns = _templates_of_image(image, patch.frame, samples, ground, position)
        rise = _rise(patch, other, ground, at)
        if control:
            at = at + control.lines[name].displacement(at, height)
        lines[name] = _matched(name, other, patterns, at, rise, height, spec)
    ordered = {name: lines[name] for name in patch.images}
    return MatchedPoints("tie", east, north, height, ground, np.zeros(len(position), bool), FrozenMap(ordered))


def _require_room(patch: ImagedGround, spec: ImagePointsSpec) -> None:
    """Raise PointsError if an image is too small for template and search range."""
    least = 2 * (spec.template // 2 + spec.search_radius) + 1
    for name, image in patch.images.items():
        if min(image.frame.shape) <= least:
            size = " x ".join(str(n) for n in image.frame.shape)
            raise PointsError(
                f"the image of {name}, {size} pixels, has no room for a template of {spec.template} pixels that is "
                f"searched {spec.search_radius} pixels to each side; more than {least} pixels are needed"
            )


def _distinct_map(
    patch: ImagedGround, heights: ReferenceHeights, count: int, border: int, spec: ImagePointsSpec
) -> tuple[np.ndarray, np.ndarray]:
    """Return east and north, in metres, of distinct points of the orthophoto that lie inside every line's image."""
    photo = patch.control.orthophoto
    sides = [np.arange(0, n, _MASK) for n in photo.values.shape]
    row, column = np.meshgrid(*sides, indexing="ij")
    east, north = photo.east_north(row.ravel(), column.ravel())
    ground = patch.frame.itrs(east, north, heights(east, north))
    seen = np.all([in_frame(im, predicted(im, ground), border) for im in patch.images.values()], axis=0)
    seen = seen.reshape(row.shape)
    if not seen.any():
        raise PointsError(f"no point of the orthophoto is seen by every line {border} pixels from the frames' borders")
    scale = float(np.mean([np.mean(im.sample) for im in patch.images.values()])) / photo.spacing
    (top, bottom), (left, right) = ((int(v.min()), int(v.max())) for v in np.nonzero(seen))
    inside = seen[top : bottom + 1, left : right + 1]
    window = tuple(slice(a * _MASK, b * _MASK + 1) for a, b in ((top, bottom), (left, right)))
    grey = gaussian_filter(photo.values[window].astype(np.float32), SOFTENING * scale)
    shape = [s / t for s, t in zip(grey.shape, inside.shape, strict=True)]
    mask = zoom(inside, shape, order=0, grid_mode=True, mode="nearest")
    grey[~mask] = np.nan
    share = max(float(mask.mean()), 0.05)
    position = distinct_points(
        grey, int(np.ceil(count / share)), spacing=max(0.5 * spec.template * scale, 1.0), border=0
    )
    if not len(position):
        raise PointsError("the orthophoto has no distinct points that every line sees")
    distinct_east, distinct_north = photo.east_north(position[:, 0] + top * _MASK, position[:, 1] + left * _MASK)
    ground = patch.frame.itrs(distinct_east, distinct_north, heights(distinct_east, distinct_north))
    good = np.all([in_frame(im, predicted(im, ground), border) for im in patch.images.values()], axis=0)
    return distinct_east[good][:count], distinct_north[good][:count]


def _ground_of_looks(
    patch: ImagedGround, image: LineFrame, heights: ReferenceHeights, position: np.ndarray, known: MatchedLine | None
) -> np.ndarray:
    """Intersect the measured sensor's lines of sight of n points with the reference heights, (n, 3), ITRS, in m.

    Points outside the reference elevation model are NaN. `known` are matches whose displacements correct the measured
    sensor; None for no correction.
    """
    height = np.full(len(position), heights.mean)
    at = position
    for _ in range(_GROUND_ITERATIONS):
        if known is not None:
            at = position - known.displacement(at, height)
        points = image.measured.ground(*image.image_point(at[:, 0], at[:, 1]), height)
        ground_height = heights(*patch.frame.local(points)[:2])
        height = np.where(np.isfinite(ground_height), ground_height, height)
    points[~np.isfinite(ground_height)] = np.nan
    return np.asarray(points)


def _rise(patch: ImagedGround, image: LineFrame, ground: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the image displacement of n points per metre of height, (n, 2), in lines/m and pixels/m."""
    east, north, height = patch.frame.local(ground)
    return (predicted(image, patch.frame.itrs(east, north, height + _RISE)) - at) / _RISE


def _matched(
    name: str,
    image: LineFrame,
    patterns: np.ndarray,
    at: np.ndarray,
    rise: np.ndarray,
    height: np.ndarray,
    spec: ImagePointsSpec,
) -> MatchedLine:
    """Match templates in one line's frame, and reject matches that contradict their neighbours."""
    options = MatchOptions(least_correlation=spec.least_correlation, largest_sigma=spec.largest_sigma)
    match = match_windows(image.frame, patterns, at, search_radius=spec.search_radius, options=options)
    status = match.reason.astype(np.int64)
    good = match.accepted
    # the smooth displacement field has at least four matches per term
    degree = next((degree for degree, terms in ((2, 7), (1, 4), (0, 2)) if good.sum() >= 4 * terms), None)
    if degree is None:
        raise PointsError(f"{name}: too few matches for a consensus: {match.text}")
    position = np.where(good[:, None], match.position, np.nan)
    agreed = consensus(
        at,
        position,
        # Errors of reference heights and a swinging attitude do not make a match wrong.
        covariance=match.covariance
        + spec.height_sigma**2 * rise[:, :, None] * rise[:, None, :]
        + spec.roughness**2 * np.eye(2),
        height=height if np.ptp(height[good]) > 1.0 else None,
        degree=degree,
        false_alarm=spec.false_alarm,
    )
    if not agreed.accepted.any():
        raise PointsError(f"{name}: {agreed.text}; {match.text}")
    status[good & ~agreed.accepted] = CONSENSUS
    first, shared = (image.window.first_line, image.window.first_pixel), (agreed.scatter, agreed.text, agreed.field)
    return MatchedLine(at, match.position, match.covariance, match.correlation, status, first, *shared)
