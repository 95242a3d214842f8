"""Heights of a grid on the ground from pairs of images with rational polynomials, by dense matching.

Both images of a pair are resampled to the ground at the middle height, in tiles whose rows run along the parallax: a
point at another height is then displaced along its row only, by base-height ratio times height. OpenCV's semi-global
matching (Hirschmueller, IEEE Trans. PAMI 30, 328 (2008)) finds these displacements within the range of heights, from
the first image to the second and back. What does not agree is excluded, and so are windows that reach beyond an image
or do not correlate. Displacements become heights through the polynomials of both images, and the pairs are fused by
inverse variance about their median.

The sigma of a displacement is the stated one and a quarter of the range of displacements around it, the standard
deviation of a step that may lie anywhere in the window. Beside pixels without a match, where one image is hidden or a
step is smeared, a larger window counts. The errors of pairs that share images are correlated: N images have N - 1
independent parallaxes, and the sigma of a fused height counts no more; it is larger where the pairs scatter more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.framework.memory import amount_text, free_memory, largest
from twin.framework.procedure import Advance, BenchError, silent
from twin.orbit.export.rational_polynomial import PolynomialImage

if TYPE_CHECKING:
    from scenes.specs.orbit.rational import SurfaceSpec

_TILE, _MEMORY = 800, 2e9
"""Largest side of a tile in cells of the grid, and memory of its matching in bytes, where a range of heights allows it.
"""
_MOST_CELLS = 1e8
"""Largest number of cells of a grid."""
_LEAST_PARALLAX = 0.02
"""Smallest base-height ratio of a pair that is matched."""
_GRID = (9, 9, 5)
"""Numbers of positions along and across the parallax, and of heights, where displacements become heights exactly."""
_BLOCK = 5
"""Side of the windows whose grey values are compared, pixels; OpenCV's documentation recommends 3 to 11."""
_STEPS = 16
"""Units of a displacement in OpenCV's result, per pixel."""
_AGREE = 1.0
"""Largest difference, in pixels, of the displacements from the first image to the second and back."""
_APART = 3.0
"""Difference from the median of the pairs, in sigmas of both, from which a pair's height is not used."""
_GRID_SPACING = 16
"""Spacing, in pixels, of the positions at which polynomials are evaluated; between them they are interpolated."""
_CORRELATED, _LEAST_CORRELATION = 7, 0.6
"""Side of the windows, pixels, that must lie within both images, and smallest correlation of their grey values: that of
tie points.
"""
_AROUND, _BESIDE_HOLES = 5, 15
"""Sides of the windows, pixels, over which displacements range: where the smaller has no pixel without a match, and
elsewhere.
"""
_OF_RANGE = 0.25
"""Standard deviation of a displacement in a window with a step, per range of its displacements."""
_SPECKLE = 50
"""Number of pixels of the smallest region of connected displacements."""
_Function = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Surface:
    """Grid of heights above the ellipsoid.

    Attributes
    ----------
    crs : str
        Coordinate reference system of the grid.
    west, north : float
        Outer corner of the grid's first cell, in metres.
    spacing : float
        Side of a cell, in metres.
    height, sigma : (rows, columns) ndarray
        Height of each cell and its standard deviation, in metres; NaN where no pair has one.
    pairs : Mapping[(str, str), ndarray]
        Names of two images -> heights (rows, columns) by them alone.
    sigmas : Mapping[(str, str), float]
        Names of two images -> standard deviation of a height by them, from that of a displacement, in metres.
    """

    crs: str
    west: float
    north: float
    spacing: float
    height: np.ndarray
    sigma: np.ndarray
    pairs: Mapping[tuple[str, str], np.ndarray]
    sigmas: Mapping[tuple[str, str], float]

    @property
    def share(self) -> float:
        """Fraction of the cells that have a height."""
        return float(np.mean(np.isfinite(self.height)))

    @cached_property
    def scatter(self) -> float | None:
        """Median ratio of the scatter of two pairs' heights to that predicted; None for a single pair."""
        ratios = []
        for a, b in combinations(self.pairs, 2):
            both = (self.pairs[a] - self.pairs[b])[np.isfinite(self.pairs[a] + self.pairs[b])]
            if len(both):
                spread = 1.4826 * float(np.median(np.abs(both - np.median(both))))
                ratios.append(spread / float(np.hypot(self.sigmas[a], self.sigmas[b])))
        return float(np.median(ratios)) if ratios else None

    def tiff(self) -> bytes:
        """Return the grid as a GeoTIFF with two bands, height and sigma."""
        import rasterio
        from rasterio.io import MemoryFile

        shape = dict(zip(("height", "width"), self.height.shape, strict=True))
        transform = rasterio.Affine(self.spacing, 0.0, self.west, 0.0, -self.spacing, self.north)
        facts = {"crs": self.crs, "transform": transform, "nodata": np.nan, "compress": "deflate", "predictor": 3}
        with MemoryFile() as memory:
            with memory.open(driver="GTiff", count=2, dtype="float32", **shape, **facts) as target:
                for k, (name, values) in enumerate((("height", self.height), ("sigma", self.sigma)), start=1):
                    target.write(values.astype(np.float32), k)
                    target.set_band_description(k, name)
                target.update_tags(AREA_OR_POINT="Area", HEIGHTS="metres above the WGS84 ellipsoid")
            return bytes(memory.read())


@dataclass(frozen=True, eq=False)
class _View:
    """Image with its polynomials in the plane coordinates of a grid.

    Attributes
    ----------
    values : (lines, samples) ndarray
        Cubic spline coefficients of the grey values.
    image : PolynomialImage
        Rational polynomials.
    crs : str
        Coordinate reference system of the grid.
    """

    values: np.ndarray
    image: PolynomialImage
    crs: str

    @cached_property
    def _to_map(self) -> Any:
        import pyproj

        return pyproj.Transformer.from_crs("EPSG:4326", self.crs, always_xy=True)

    def seen(self, place: np.ndarray, height: np.ndarray | float) -> np.ndarray:
        """Return line and sample (..., 2) of plane coordinates (..., 2), in metres, at heights."""
        longitude, latitude = self._to_map.transform(place[..., 0], place[..., 1], direction="INVERSE")
        return np.stack(self.image.polynomial.image(latitude, longitude, height), axis=-1)

    def ground(self, position: np.ndarray, height: np.ndarray | float) -> np.ndarray:
        """Return plane coordinates (..., 2), in metres, that lines and samples (..., 2) see at heights."""
        latitude, longitude = self.image.polynomial.ground(position[..., 0], position[..., 1], height)
        return np.stack(self._to_map.transform(longitude, latitude), axis=-1)

    def resampled(self, place: np.ndarray, height: float) -> np.ndarray:
        """Return grey values at plane coordinates (rows, columns, 2) on a level at a height; NaN outside the image."""
        from scipy.ndimage import map_coordinates

        rows, columns = place.shape[:2]
        coarse = self.seen(place[::_GRID_SPACING, ::_GRID_SPACING], height)
        line, sample = np.meshgrid(np.arange(rows) / _GRID_SPACING, np.arange(columns) / _GRID_SPACING, indexing="ij")
        at = [map_coordinates(coarse[..., k], [line, sample], order=1, mode="nearest") for k in (0, 1)]
        inside = (at[0] >= 0) & (at[1] >= 0) & (at[0] <= self.values.shape[0] - 1) & (at[1] <= self.values.shape[1] - 1)
        grey = map_coordinates(self.values, at, order=3, prefilter=False, mode="nearest")
        return np.where(inside, grey, np.nan)


def surface(
    frames: Mapping[str, tuple[np.ndarray, PolynomialImage]],
    heights: tuple[float, float],
    spec: SurfaceSpec,
    advance: Advance = silent,
) -> Surface:
    """Return the heights of the ground that two images or more see.

    Parameters
    ----------
    frames : mapping of str to (ndarray, PolynomialImage)
        Name -> grey values (lines, samples) and rational polynomials of an image.
    heights : tuple of float
        Lowest and highest ground above the ellipsoid, metres.
    spec : SurfaceSpec
        Grid and accuracy of the matching.
    advance : Advance
        Callback that reports the progress.

    Raises
    ------
    BenchError
        No two images see the same ground from different directions, or the grid is too large.
    """
    from scipy.ndimage import spline_filter

    middle = 0.5 * (heights[0] + heights[1])
    crs = spec.crs or _utm(next(iter(frames.values()))[1], middle)
    views = {
        name: _View(spline_filter(values.astype(np.float64), 3), image, crs) for name, (values, image) in frames.items()
    }
    corners = {name: view.ground(_border(view.values.shape), middle) for name, view in views.items()}
    pairs = {}
    for a, b in combinations(views, 2):
        low = np.maximum(corners[a].min(axis=0), corners[b].min(axis=0))
        high = np.minimum(corners[a].max(axis=0), corners[b].max(axis=0))
        if (
            np.all(low < high)
            and np.hypot(*_parallax(views[a], views[b], 0.5 * (low + high), middle)) > _LEAST_PARALLAX
        ):
            pairs[a, b] = low, high
    if not pairs:
        raise BenchError("no two images see the same ground from different directions", ("images",), "stereo images")
    west, south = np.floor(np.min([low for low, _ in pairs.values()], axis=0) / spec.spacing) * spec.spacing
    east, north = np.ceil(np.max([high for _, high in pairs.values()], axis=0) / spec.spacing) * spec.spacing
    shape = round((north - south) / spec.spacing), round((east - west) / spec.spacing)
    if shape[0] * shape[1] > _MOST_CELLS:
        problem = f"a grid of {shape[0]} x {shape[1]} cells is too large"
        raise BenchError(problem, ("surface", "spacing"), f"at most {_MOST_CELLS:.0e} cells: a larger spacing")
    sides = {(a, b): _side(views[a], views[b], np.array(ends), heights, spec) for (a, b), ends in pairs.items()}
    grids, sigmas, steps = {}, {}, {}
    for k, (a, b) in enumerate(pairs):
        advance("surface", k, len(pairs))
        grid, step, variance, count = np.full(shape, np.nan), np.full(shape, np.nan), 0.0, 0
        for rows, columns in _tiles(shape, sides[a, b]):
            box = np.array(
                [
                    [west + columns.start * spec.spacing, north - rows.stop * spec.spacing],
                    [west + columns.stop * spec.spacing, north - rows.start * spec.spacing],
                ]
            )
            tile = _tile(views[a], views[b], box, heights, spec)
            if tile is not None:
                grid[rows, columns], step[rows, columns] = tile[:2]
                variance, count = variance + tile[2] ** 2, count + 1
        if np.any(np.isfinite(grid)):
            grids[a, b], steps[a, b], sigmas[a, b] = grid, step, float(np.sqrt(variance / count))
    advance("surface", len(pairs), len(pairs))
    if not grids:
        low, high = heights
        problem = f"no displacement was found at heights of {low:g} to {high:g} m above the ellipsoid"
        raise BenchError(problem, ("heights",), "heights of the ground that the images show")
    height, sigma = _fused(grids, sigmas, steps)
    return Surface(crs, float(west), float(north), spec.spacing, height, sigma, grids, sigmas)


def _utm(image: PolynomialImage, height: float) -> str:
    """Return the zone of Universal Transverse Mercator, WGS84, that contains the middle of an image."""
    latitude, longitude = image.polynomial.ground(image.middle[0], image.middle[1], height)
    return f"EPSG:{(32600 if latitude >= 0.0 else 32700) + int((float(longitude) + 180.0) // 6.0) % 60 + 1}"


def _border(shape: tuple[int, ...]) -> np.ndarray:
    """Return the corners (4, 2) of an image in lines and samples."""
    lines, samples = (np.array([0.0, n - 1.0]) for n in shape)
    return np.stack(np.meshgrid(lines, samples, indexing="ij"), axis=-1).reshape(-1, 2)


def _tiles(shape: tuple[int, int], side: int) -> Iterator[tuple[slice, slice]]:
    """Yield rows and columns of the tiles of a grid."""
    for row in range(0, shape[0], side):
        for column in range(0, shape[1], side):
            yield slice(row, min(row + side, shape[0])), slice(column, min(column + side, shape[1]))


def _side(first: _View, second: _View, box: np.ndarray, heights: tuple[float, float], spec: SurfaceSpec) -> int:
    """Return the side of a pair's tiles, in cells; raise BenchError where the memory does not suffice for its heights.

    The matcher has two tables of 16 bits with all displacements of each pixel, and of columns as wide as these.
    """

    def memory(cells: int) -> float:
        frame = _frame(first, second, box.mean(axis=0), np.full(2, cells * spec.spacing), heights)
        assert frame is not None
        span = _span(frame.most)
        return 4.0 * frame.rows * (frame.columns + span) * span

    # wide ranges of heights need much for tiles of any size
    allowed = max(_MEMORY, 1.5 * memory(0))
    side = largest(lambda cells: memory(cells) <= allowed, _TILE + 1, 1)
    if memory(side) > free_memory():
        problem = f"matching between {heights[0]:g} and {heights[1]:g} m needs {amount_text(memory(side))} of memory"
        raise BenchError(problem, ("heights",), f"{amount_text(free_memory())} are free: a narrower range of heights")
    return side


class _Frame(NamedTuple):
    """Plane coordinates of a tile: axes (2, 2) along and across the parallax, and numbers of their pixels.

    `ratio` is that of parallax and height, `pixel` in metres, and `most` the largest displacement in pixels.
    """

    axes: np.ndarray
    ratio: float
    pixel: float
    columns: int
    rows: int
    most: int


def _frame(
    first: _View, second: _View, centre: np.ndarray, size: np.ndarray, heights: tuple[float, float]
) -> _Frame | None:
    """Return the frame of a tile about a point, of a size east and north (2,), in metres; None without parallax."""
    middle, half = 0.5 * (heights[0] + heights[1]), 0.5 * (heights[1] - heights[0])
    slope = _parallax(first, second, centre, middle)
    ratio = float(np.hypot(*slope))
    if not ratio > _LEAST_PARALLAX:
        return None
    along = slope / ratio
    axes = np.stack([along, [-along[1], along[0]]])
    pixel = _pixel(first, centre, middle)
    # the images see ground at the ends of the range of heights this far from where it lies
    lean = half * max(float(np.hypot(*_lean(view, centre, middle))) for view in (first, second))
    columns, rows = np.ceil((np.abs(axes) @ size + 2.0 * lean + 2.0 * _BLOCK * pixel) / pixel).astype(int).tolist()
    return _Frame(axes, ratio, pixel, columns, rows, int(np.ceil(ratio * half / pixel)) + 1)


def _parallax(first: _View, second: _View, place: np.ndarray, height: float) -> np.ndarray:
    """Return the displacement (2,) of the second image against the first on a level, in metres per metre of height."""
    steps = [
        view.ground(view.seen(place, height), height + 1.0) - view.ground(view.seen(place, height), height)
        for view in (first, second)
    ]
    return np.asarray(steps[1] - steps[0])


def _tile(
    first: _View, second: _View, box: np.ndarray, heights: tuple[float, float], spec: SurfaceSpec
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Return heights (rows, columns) of a tile by two images; None where both do not see it.

    Standard deviations by steps of the ground (rows, columns) and that of the matching follow.

    Parameters
    ----------
    first, second : _View
        Images.
    box : (2, 2) ndarray
        West and south, east and north end of the tile, in metres.
    heights : tuple of float
        Lowest and highest ground, metres.
    spec : SurfaceSpec
        Grid and accuracy of the matching.
    """
    middle, centre = 0.5 * (heights[0] + heights[1]), box.mean(axis=0)
    frame = _frame(first, second, centre, box[1] - box[0], heights)
    if frame is None:
        return None
    axes, ratio, pixel, columns, rows, most = frame
    x, y = (pixel * (np.arange(n) - 0.5 * (n - 1)) for n in (columns, rows))
    place = centre + np.stack(np.meshgrid(x, y), axis=-1) @ axes
    left, right = (view.resampled(place, middle) for view in (first, second))
    if not (np.isfinite(left).any() and np.isfinite(right).any()):
        return None
    displacement = _displacements(left, right, most)
    to_height, to_place = _geometry(first, second, centre, axes, x, y, heights)
    where = np.argwhere(np.isfinite(displacement))
    if not len(where):
        return None
    local = np.stack([x[where[:, 1]], y[where[:, 0]]], axis=1)
    level = to_height(local, pixel * displacement[where[:, 0], where[:, 1]])
    step = _OF_RANGE * _ranges(displacement)[where[:, 0], where[:, 1]] * pixel / ratio
    kept = (level >= heights[0]) & (level <= heights[1])
    ground = centre + to_place(local[kept], level[kept]) @ axes
    shape = round((box[1, 1] - box[0, 1]) / spec.spacing), round((box[1, 0] - box[0, 0]) / spec.spacing)
    cells = _rasterised(ground - box[0], level[kept], step[kept], shape, spec.spacing, pixel)
    return *cells, spec.sigma * pixel / ratio


def _pixel(view: _View, place: np.ndarray, height: float) -> float:
    """Return the side of a square on the ground with the area of a pixel, in metres."""
    position = view.seen(place, height)
    steps = view.ground(position + np.eye(2), height) - place
    return float(np.sqrt(abs(np.linalg.det(steps))))


def _lean(view: _View, place: np.ndarray, height: float) -> np.ndarray:
    """Return the tangents (2,) of an image's line of sight to the plumb line."""
    return np.asarray(view.ground(view.seen(place, height), height + 1.0) - place)


def _displacements(first: np.ndarray, second: np.ndarray, most: int) -> np.ndarray:
    """Return the displacements of the first image's pixels along the rows to the second, in pixels; NaN for none.

    A displacement is the column in the first image less that in the second, at most `most` to either side.
    """
    import cv2
    from scipy.ndimage import minimum_filter

    seen = [_eight_bits(image) for image in (first, second)]
    span = _span(most)
    displacements = []
    for left, right in (seen, [image[:, ::-1] for image in seen[::-1]]):
        # columns beyond the image, so that its border has all displacements
        left, right = (cv2.copyMakeBorder(image, 0, 0, span, span, cv2.BORDER_REPLICATE) for image in (left, right))
        matcher = cv2.StereoSGBM_create(
            minDisparity=-most,
            numDisparities=span,
            blockSize=_BLOCK,
            P1=8 * _BLOCK**2,
            P2=32 * _BLOCK**2,
            uniquenessRatio=5,
            speckleWindowSize=_SPECKLE,
            speckleRange=1,
            mode=cv2.STEREO_SGBM_MODE_HH,
        )
        value = matcher.compute(left, right)[:, span:-span].astype(np.float64) / _STEPS
        displacements.append(np.where(value < -most, np.nan, value))
    there, back = displacements[0], displacements[1][:, ::-1]
    rows, columns = np.indices(there.shape)
    partner = np.where(np.isfinite(there), columns - there, -1.0)
    at = np.clip(np.rint(partner).astype(int), 0, there.shape[1] - 1)
    agrees = (np.abs(back[rows, at] - there) <= _AGREE) & (partner >= 0.0) & (partner <= there.shape[1] - 1.0)
    whole, whole_second = (minimum_filter(np.isfinite(v), _CORRELATED, mode="constant") for v in (first, second))
    alike = _correlation(first, second[rows, at]) >= _LEAST_CORRELATION
    return np.where(agrees & whole & whole_second[rows, at] & alike, there, np.nan)


def _span(most: int) -> int:
    """Return the number of displacements that OpenCV tries: a multiple of 16."""
    return 16 * int(np.ceil((2 * most + 1) / 16))


def _correlation(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the correlation of two images' grey values in a window about each pixel."""
    from scipy.ndimage import uniform_filter

    a, b = (np.nan_to_num(image - np.nanmean(image)) for image in (first, second))
    means = [uniform_filter(image, _CORRELATED) for image in (a, b, a * a, b * b, a * b)]
    variance = (means[2] - means[0] ** 2) * (means[3] - means[1] ** 2)
    return np.asarray((means[4] - means[0] * means[1]) / np.sqrt(np.maximum(variance, 1e-12)))


def _ranges(displacement: np.ndarray) -> np.ndarray:
    """Return the range of displacements around each pixel, over a larger window beside pixels without a match."""
    from scipy.ndimage import maximum_filter, minimum_filter

    known = np.isfinite(displacement)
    high, low = np.where(known, displacement, -np.inf), np.where(known, displacement, np.inf)
    small, large = (maximum_filter(high, n) - minimum_filter(low, n) for n in (_AROUND, _BESIDE_HOLES))
    return np.where(minimum_filter(known, _AROUND), small, large)


def _eight_bits(values: np.ndarray) -> NDArray[np.uint8]:
    """Return grey values of eight bits, between the percentiles 0.5 and 99.5; 0 outside of the image."""
    low, high = np.nanpercentile(values, [0.5, 99.5])
    scaled = 255.0 * (values - low) / max(high - low, 1e-9)
    return np.asarray(np.clip(np.nan_to_num(scaled), 0.0, 255.0), np.uint8)


def _geometry(
    first: _View,
    second: _View,
    centre: np.ndarray,
    axes: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    heights: tuple[float, float],
) -> tuple[_Function, _Function]:
    """Return two functions: heights of positions and displacements, and positions on the ground of these heights.

    Positions (n, 2) are metres along and across the parallax on the middle level; displacements are in metres. The
    functions are polynomials of second order through the polynomials of both images, over a tile.
    """
    middle = 0.5 * (heights[0] + heights[1])
    at = np.stack(np.meshgrid(*(np.linspace(v[0], v[-1], n) for v, n in zip((x, y), _GRID, strict=False))), axis=-1)
    level = np.broadcast_to(np.linspace(*heights, _GRID[2])[:, None, None], (_GRID[2], *at.shape[:2]))
    at = np.broadcast_to(at, (*level.shape, 2))
    ground = first.ground(first.seen(centre + at @ axes, middle), level)
    partner = (second.ground(second.seen(ground, level), middle) - centre) @ axes.T
    local, shift = at.reshape(-1, 2), (at - partner)[..., 0].ravel()
    scale = np.array([max(abs(x[0]), 1.0), max(abs(y[0]), 1.0), 1.0])

    def terms(place: np.ndarray, third: np.ndarray, size: float) -> np.ndarray:
        u, v, w = place[:, 0] / scale[0], place[:, 1] / scale[1], third / size
        return np.stack([np.ones_like(u), u, v, w, u * u, u * v, v * v, u * w, v * w, w * w], axis=1)

    widest = float(np.abs(shift).max())
    of_height = np.linalg.lstsq(terms(local, shift, widest), level.ravel() - middle, rcond=None)[0]
    high = 0.5 * (heights[1] - heights[0])
    on_ground = ((ground - centre) @ axes.T).reshape(-1, 2)
    of_place = np.linalg.lstsq(terms(local, level.ravel() - middle, high), on_ground, rcond=None)[0]
    return (
        lambda place, moved: middle + terms(place, moved, widest) @ of_height,
        lambda place, height: terms(place, height - middle, high) @ of_place,
    )


def _rasterised(
    ground: np.ndarray, level: np.ndarray, step: np.ndarray, shape: tuple[int, int], spacing: float, pixel: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean height of each cell (rows, columns) of points (n, 2) with heights, and its sigma; NaN for none.

    A point counts in all cells that a square of its pixel's size reaches with a quarter of it. The sigma is that by
    steps: the points' `step` and the scatter of their heights in the cell.
    """
    total, square, variance, count = np.zeros((4, *shape))
    middle = float(np.median(level)) if len(level) else 0.0
    for corner in np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * 0.25 * pixel:
        column, row = np.floor((ground + corner) / spacing).astype(int).T
        row = shape[0] - 1 - row
        inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
        above = level[inside] - middle
        for sums, values in ((total, above), (square, above**2), (variance, step[inside] ** 2), (count, 1.0)):
            np.add.at(sums, (row[inside], column[inside]), values)
    with np.errstate(invalid="ignore"):
        mean, square, variance = (np.where(count > 0, sums / count, np.nan) for sums in (total, square, variance))
    return middle + mean, np.sqrt(variance + np.maximum(square - mean**2, 0.0))


def _fused(
    grids: Mapping[tuple[str, str], np.ndarray],
    sigmas: Mapping[tuple[str, str], float],
    steps: Mapping[tuple[str, str], np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the heights of all pairs together and their sigmas, (rows, columns); NaN where no pair has a height.

    A step of the ground is smeared alike in all pairs, so that the part of sigma by `steps` does not fall with their
    number.
    """
    stack = np.stack(list(grids.values()))
    known = np.isfinite(stack)
    matched = np.array([sigmas[pair] for pair in grids])[:, None, None]
    step = np.where(known, np.stack([steps[pair] for pair in grids]), 0.0)
    sigma = np.where(known, np.hypot(matched, step), np.inf)
    with np.errstate(invalid="ignore"):
        middle = np.nanmedian(np.where(known.any(axis=0), stack, 0.0), axis=0)
        used = known & ~(np.abs(stack - middle) > _APART * np.hypot(sigma, sigma.min(axis=0)))
    # two pairs that contradict each other have no height
    used &= (known.sum(axis=0) < 2) | (used.sum(axis=0) >= 2)
    weight = used / sigma**2
    total = weight.sum(axis=0)
    count = used.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        height = np.sum(np.where(used, stack, 0.0) * weight, axis=0) / total
        chi_square = np.sum(weight * (np.where(used, stack, 0.0) - height) ** 2, axis=0) / np.maximum(count - 1, 1)
        images = len({name for pair in grids for name in pair})
        shared = np.maximum(count / np.minimum(count, images - 1), 1.0)
        alone = shared * np.sum((weight * matched) ** 2, axis=0) / total**2
        spread = np.sqrt(np.maximum(chi_square, 1.0) * (alone + np.sum(weight * step**2, axis=0) / total))
    return np.where(count > 0, height, np.nan), np.where(count > 0, spread, np.nan)
