"""Templates in the geometry of an image that is to be matched, from an orthophoto or from another image.

A template's samples are the pixels about the predicted place of its point, which is not a whole pixel. Each sample is
followed by the measured sensor to the reference heights: over so few pixels the way to the ground is affine in row and
column and linear in height, to a millimetre. What the measured sensor is wrong by moves the whole template and is left
to the search.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter

from analysis.matching.spline import resampled
from twin.orbit.ground.frame import GroundFrame
from twin.orbit.ground.orthophoto import Raster
from twin.orbit.images.patch import LineImage

SOFTENING = 0.4
"""Rms of the Gaussian low pass of an orthophoto over the distance of the image's pixels: what pixel, lens and motion of
the line add to an orthophoto that is sharp itself. What is left the matching solves for."""
_STEP = 50.0
"""Metres of height over which the way to the ground is taken as straight."""
_FOLLOWED = 8
"""Turns of looking up the height; each makes the error smaller by the terrain's slope times the look's, 0.2 or less."""


@dataclass(frozen=True, eq=False)
class ReferenceHeights:
    """Heights of a reference elevation model, a cubic spline through its posts.

    Attributes:
        raster: of the posts.
        coefficients: of the spline.
    """

    raster: Raster
    coefficients: np.ndarray

    @classmethod
    def of(cls, dem: Raster) -> ReferenceHeights:
        """Through a raster of heights, metres."""
        return cls(dem, spline_filter(dem.values.astype(np.float64), order=3, mode="mirror"))

    def __call__(self, east: np.ndarray, north: np.ndarray) -> np.ndarray:
        """Heights at places, metres; NaN beyond the posts."""
        place = np.stack(self.raster.row_column(east, north))
        found = map_coordinates(self.coefficients, place, order=3, mode="mirror", prefilter=False)
        last = np.array(self.coefficients.shape).reshape(2, *(1,) * (place.ndim - 1)) - 1
        return np.asarray(np.where(np.all((place >= 0.0) & (place <= last), axis=0), found, np.nan))


def predicted(image: LineImage, points: np.ndarray) -> np.ndarray:
    """Row and column (n, 2) of the frame at which the measured sensor has points (n, 3), ITRS; NaN beyond its image."""
    line, pixel = image.measured.image(points)
    return np.stack([line - image.window.first_line, pixel - image.window.first_pixel], axis=-1)


def fits(image: LineImage, place: np.ndarray, border: float) -> np.ndarray:
    """Which places (..., 2) lie in a frame, so far from its border; not a place that is NaN."""
    last = np.array(image.frame.shape) - 1.0 - border
    return np.asarray(np.all((place >= border) & (place <= last), axis=-1))


def ground_of_samples(
    image: LineImage, frame: GroundFrame, heights: ReferenceHeights, points: np.ndarray, place: np.ndarray, side: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """East, north and height (n, side, side) each, metres, of what the pixels about places see.

    Args:
        image: whose pixels; its measured sensor is used.
        frame: coordinates of the ground.
        heights: of the ground.
        points: (n, 3) ITRS, metres, that the measured sensor has at the places: their height is kept, and the
            reference heights count against theirs at the points.
        place: (n, 2) rows and columns of the frame.
        side: of a template, pixels.
    """
    east, north, height = (v[:, None, None] for v in frame.local(points))
    half = side // 2
    row, column = image.image_point(place[:, 0], place[:, 1])
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


def templates_of_map(photo: Raster, samples: tuple[np.ndarray, np.ndarray, np.ndarray], sample: float) -> np.ndarray:
    """Templates (n, k, k) from an orthophoto; sample: distance of the image's pixels on the ground, metres."""
    rows, columns = photo.row_column(samples[0], samples[1])
    return resampled(photo.values, rows, columns, smoothing=SOFTENING * sample / photo.spacing)


def templates_of_image(
    source: LineImage,
    frame: GroundFrame,
    samples: tuple[np.ndarray, np.ndarray, np.ndarray],
    points: np.ndarray,
    place: np.ndarray,
) -> np.ndarray:
    """Templates (n, k, k) from another image.

    Args:
        source: the other image.
        frame: coordinates of the ground.
        samples: of the ground, as `ground_of_samples` has them.
        points: (n, 3) ITRS, metres, of the templates' middles.
        place: (n, 2) where the source has them, row and column.
    """
    centre = np.stack(frame.local(points))
    base = predicted(source, points)
    at = np.broadcast_to(place.T[:, :, None, None], (2, *samples[0].shape))
    for k, sample in enumerate(samples):
        moved = centre.copy()
        moved[k] += _STEP
        slope = (predicted(source, frame.itrs(*moved)) - base) / _STEP
        at = at + slope.T[:, :, None, None] * (sample - centre[k][:, None, None])
    return resampled(source.frame, at[0], at[1])
