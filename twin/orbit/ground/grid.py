"""Plane ground coordinates, random fields and cubic splines on a grid, and the terrain of a patch.

East and north are longitude and latitude times constant lengths, those of the ellipsoid at the patch's middle. The
conversion to longitude, latitude and height and back is thus exact everywhere; only lengths have a small scale error
away from the middle (1.3e-4 for east-west lengths 1 km to the north, at 40 degrees of latitude). Heights are above the
ellipsoid.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, assert_never

import numpy as np
from scipy import fft
from scipy.ndimage import map_coordinates, spline_filter
from scipy.sparse import csr_array

from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import cores
from twin.orbit.flight.earth import Earth, curvature_radii

if TYPE_CHECKING:
    from scenes.specs.orbit.scene import TerrainSpec

_EARTH = Earth()
"""Earth model, of which only the ellipsoid is used."""


@dataclass(frozen=True)
class GroundFrame:
    """Plane coordinates east and north about a point of the ellipsoid.

    Attributes
    ----------
    longitude, latitude : float
        Geodetic coordinates of the point, radians.
    """

    longitude: float
    latitude: float

    @property
    def scale(self) -> tuple[float, float]:
        """Metres east per radian of longitude, and metres north per radian of latitude."""
        meridian, normal = curvature_radii(self.latitude)
        return float(normal * np.cos(self.latitude)), float(meridian)

    def itrs(self, east: Any, north: Any, height: Any) -> np.ndarray:
        """Convert east, north and height (...), in metres, to points (..., 3) in the ITRS, in metres."""
        return _EARTH.ecef(*self.geographic(east, north), height)

    def local(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Convert points (..., 3) in the ITRS to east, north and height (...), all in metres; NaN stays NaN."""
        longitude, latitude, height = _EARTH.geodetic(points)
        return *self.plane(longitude, latitude), height

    def geographic(self, east: Any, north: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return longitude and latitude (...), in radians, of east and north (...), in metres."""
        per_longitude, per_latitude = self.scale
        longitude = self.longitude + np.asarray(east, dtype=np.float64) / per_longitude
        return longitude, self.latitude + np.asarray(north, dtype=np.float64) / per_latitude

    def plane(self, longitude: np.ndarray, latitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return east and north (...), in metres, of longitude (in any range) and latitude (...), in radians."""
        per_longitude, per_latitude = self.scale
        difference = (longitude - self.longitude + np.pi) % (2.0 * np.pi) - np.pi
        return difference * per_longitude, (latitude - self.latitude) * per_latitude


_CORRELATION_MARGIN = 4.0
"""Margin added to the grid of a correlated random field, in correlation lengths, so that opposite edges are
independent.
"""


def fractal_field(
    shape: tuple[int, int], spacing: float, exponent: float, longest: float, seed: np.random.SeedSequence
) -> np.ndarray:
    """Draw a random field of zero mean and unit RMS whose amplitude spectrum falls as frequency^-exponent.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns.
    spacing : float
        Grid spacing, metres.
    exponent : float
        Exponent of the amplitude spectrum: 4 - D for a surface of fractal dimension D, between 1 and 2; mountains have
        about 2.
    longest : float
        Wavelength above which the spectrum is constant, metres.
    seed : SeedSequence
        Seed of the noise.

    Returns
    -------
    ndarray of float32
        Random field of this shape.
    """
    spectrum = _white_spectrum(shape, seed)
    along = fft.rfftfreq(shape[1], spacing) ** 2 + longest**-2.0
    for row, across in enumerate(fft.fftfreq(shape[0], spacing)):
        spectrum[row] *= ((along + across**2) ** (-0.5 * exponent)).astype(np.float32)
    field = np.asarray(fft.irfft2(spectrum, s=shape, workers=cores(), overwrite_x=True))
    field -= field.mean()
    field /= np.sqrt(np.mean(np.square(field), dtype=np.float64))
    return field


def correlated_field(shape: tuple[int, int], spacing: float, length: float, seed: np.random.SeedSequence) -> np.ndarray:
    """Draw a random field with zero mean, unit standard deviation and correlation exp(-(distance/length)^2/2).

    Parameters
    ----------
    shape : tuple of int
        Rows and columns.
    spacing : float
        Grid spacing, metres.
    length : float
        Correlation length, metres.
    seed : SeedSequence
        Seed of the noise.

    Returns
    -------
    ndarray of float32
        Random field of this shape.
    """
    spare = int(np.ceil(_CORRELATION_MARGIN * length / spacing))
    larger = (fft.next_fast_len(shape[0] + spare, True), fft.next_fast_len(shape[1] + spare, True))
    rows, columns = (_root_of_covariance(count, spacing / length) for count in larger)
    spectrum = _white_spectrum(larger, seed)
    spectrum *= rows[:, None]
    spectrum *= columns[: spectrum.shape[1]]
    return np.asarray(fft.irfft2(spectrum, s=larger, workers=cores(), overwrite_x=True))[: shape[0], : shape[1]]


def _root_of_covariance(count: int, step: float) -> np.ndarray:
    """Return the square root of the spectrum of the covariance along one periodic axis, (count,)."""
    distance = step * np.minimum(np.arange(count), count - np.arange(count))
    # The covariance of a periodic axis is not quite positive: values below zero are rounding.
    return np.sqrt(np.maximum(fft.fft(np.exp(-0.5 * distance**2)).real, 0.0)).astype(np.float32)


def _white_spectrum(shape: tuple[int, int], seed: np.random.SeedSequence) -> np.ndarray:
    """Return the Fourier transform of white noise of unit variance on a grid."""
    noise = np.random.Generator(np.random.SFC64(seed)).standard_normal(shape, dtype=np.float32)
    return np.asarray(fft.rfft2(noise, workers=cores()))


Beyond = Literal["mirror", "grid-wrap", "nothing"]
"""Continuation of a spline outside its grid: mirrored, repeated periodically, or not defined."""


@dataclass(frozen=True, eq=False)
class SplineGrid:
    """Cubic B-spline over a regular grid of plane ground coordinates.

    Attributes
    ----------
    coefficients : (rows, columns) ndarray
        Weights of the B-splines; rows go north, columns east.
    spacing : tuple of float
        Grid spacing east and north, metres.
    first : tuple of float
        East and north of the first row's first column, metres.
    beyond : Beyond
        Continuation outside: mirrored about the outer rows and columns, repeated, or not defined there.
    """

    coefficients: np.ndarray
    spacing: tuple[float, float]
    first: tuple[float, float]
    beyond: Beyond = "nothing"

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounds west, east, south and north, in metres, within which a spline without continuation is defined."""
        (rows, columns), (east, north) = self.coefficients.shape, self.first
        # A position needs one B-spline before its cell and two after.
        return (
            east + self.spacing[0],
            east + (columns - 2) * self.spacing[0],
            north + self.spacing[1],
            north + (rows - 2) * self.spacing[1],
        )

    def __call__(self, east: np.ndarray, north: np.ndarray) -> np.ndarray:
        """Return values at positions, in metres, of any equal shapes.

        Raises
        ------
        ValueError
            A position lies outside a grid without continuation.
        """
        if self.beyond == "nothing":
            self._require_inside(east, north)
        row = (north - self.first[1]) / self.spacing[1]
        column = (east - self.first[0]) / self.spacing[0]
        mode = {"nothing": "nearest", "mirror": "mirror", "grid-wrap": "grid-wrap"}[self.beyond]
        return np.asarray(
            map_coordinates(self.coefficients, [row, column], order=3, prefilter=False, mode=mode, output=np.float64)
        )

    def on_grid(self, east: np.ndarray, north: np.ndarray, derivative: tuple[int, int] = (0, 0)) -> np.ndarray:
        """Return values, or first derivatives, on a regular grid of N rows and E columns, (N, E).

        Parameters
        ----------
        east : (E,) ndarray
            East of the columns, metres.
        north : (N,) ndarray
            North of the rows, metres.
        derivative : tuple of int
            Order of the derivative with respect to east and to north, 0 or 1.

        Raises
        ------
        ValueError
            A position lies outside a grid without continuation.
        """
        if self.beyond == "nothing":
            self._require_inside(east, north)
        rows, columns = self.coefficients.shape
        sides = ((east, columns, derivative[0]), (north, rows, derivative[1]))
        along, across = (
            self._weights((coordinate - first) / step, count, order) / step**order
            for (coordinate, count, order), first, step in zip(sides, self.first, self.spacing, strict=True)
        )
        return np.asarray((along @ (across @ self.coefficients).T).T)

    def _weights(self, position: np.ndarray, count: int, derivative: int) -> csr_array:
        """Return the sparse matrix (positions, count) from B-spline coefficients along one axis to values at positions.

        Positions are in grid cells; `derivative` is the order of the derivative, 0 or 1.
        """
        cell = np.floor(position).astype(np.intp)
        t = (position - cell)[:, None]
        if derivative:
            weight = np.hstack([-0.5 * (1.0 - t) ** 2, 1.5 * t**2 - 2.0 * t, 0.5 + t - 1.5 * t**2, 0.5 * t**2])
        else:
            s = 1.0 - t
            parts = [s**3 / 6.0, 2.0 / 3.0 - t**2 + 0.5 * t**3, 2.0 / 3.0 - s**2 + 0.5 * s**3, t**3 / 6.0]
            weight = np.hstack(parts)
        column = cell[:, None] + np.arange(-1, 3)
        match self.beyond:
            case "grid-wrap":
                column %= count
            case "mirror" | "nothing":
                column %= 2 * (count - 1)
                column = np.minimum(column, 2 * (count - 1) - column)
            case _:
                assert_never(self.beyond)
        row = np.repeat(np.arange(len(position)), 4)
        return csr_array((weight.ravel(), (row, column.ravel())), shape=(len(position), count))

    def _require_inside(self, east: np.ndarray, north: np.ndarray) -> None:
        """Raise UnphysicalError if positions lie outside the grid of a spline without continuation."""
        west_end, east_end, south_end, north_end = self.extent
        low, high = (np.min(east), np.min(north)), (np.max(east), np.max(north))
        if not (low[0] >= west_end and high[0] <= east_end and low[1] >= south_end and high[1] <= north_end):
            raise UnphysicalError(
                f"position outside the grid of the ground: east {np.min(east):.0f} to {np.max(east):.0f} m, north "
                f"{np.min(north):.0f} to {np.max(north):.0f} m; the grid covers {west_end:.0f} to {east_end:.0f} m and "
                f"from {south_end:.0f} to {north_end:.0f} m"
            )


_MOST_POSTS = 4096
"""Largest number of grid points along a side of a fractal terrain, which is repeated periodically beyond."""


@dataclass(frozen=True, eq=False)
class Terrain:
    """Terrain heights above the ellipsoid, a function used by renderer, true coordinates and elevation models alike.

    Attributes
    ----------
    surface : SplineGrid
        Cubic spline through the grid points, defined everywhere, metres.
    """

    surface: SplineGrid

    @classmethod
    def from_spec(cls, spec: TerrainSpec, side: float, seed: np.random.SeedSequence) -> Terrain:
        """Make the terrain of an input file.

        Parameters
        ----------
        spec : TerrainSpec
            Terrain of the input file.
        side : float
            Side of the ground that is used, metres; a fractal repeats after one and a half times this, or later.
        seed : SeedSequence
            Seed of a fractal.
        """
        match spec.kind:
            case "real":
                return cls.real(spec)
            case "fractal":
                return cls.fractal(spec, side, seed)
            case _:
                assert_never(spec.kind)

    @classmethod
    def flat(cls, height: float) -> Terrain:
        """Return level ground of one height above the ellipsoid, in metres."""
        return cls(SplineGrid(np.full((2, 2), float(height)), (1e3, 1e3), (0.0, 0.0), "mirror"))

    @classmethod
    def through(cls, posts: np.ndarray, spacing: tuple[float, float], first: tuple[float, float]) -> Terrain:
        """Return a spline through a grid of heights (rows to the north, columns to the east), mirrored beyond it.

        Heights, spacing (east, north) and position of the first grid point (east, north) are in metres.
        """
        posts = np.asarray(posts, dtype=np.float64)
        return cls(SplineGrid(spline_filter(posts, order=3, mode="mirror"), spacing, first, "mirror"))

    @classmethod
    def real(cls, spec: TerrainSpec) -> Terrain:
        """Return the elevation model of the Jacksboro fault that matplotlib ships, shifted by the offset.

        The offset is subtracted from the model's plane coordinates. Its heights, which refer to the geoid, are used
        relative to their mean; its grid points, 3 arc seconds apart, keep their distances in metres.
        """
        posts, spacing = _jacksboro()
        about = posts - posts.mean()
        if spec.relief is not None:
            about = about * (spec.relief / np.std(about))
        first = [-0.5 * (n - 1) * d - o for n, d, o in zip(posts.shape[::-1], spacing, spec.offset, strict=True)]
        return cls.through(spec.height + about, spacing, (first[0], first[1]))

    @classmethod
    def fractal(cls, spec: TerrainSpec, side: float, seed: np.random.SeedSequence) -> Terrain:
        """Draw a fractal terrain, whose amplitude spectrum is a power law."""
        count = 64
        while count * spec.post < 1.5 * side and count < _MOST_POSTS:
            count *= 2
        relative = fractal_field((count, count), spec.post, spec.exponent, spec.longest, seed).astype(np.float64)
        posts = spec.height + (spec.relief or 0.0) * relative
        corner = -0.5 * count * spec.post
        coefficients = spline_filter(posts, order=3, mode="grid-wrap")
        return cls(SplineGrid(coefficients, (spec.post, spec.post), (corner, corner), "grid-wrap"))

    def height(self, east: np.ndarray, north: np.ndarray) -> np.ndarray:
        """Return heights at positions, in metres, of the positions' shape."""
        return self.surface(east, north)

    def on_grid(self, east: np.ndarray, north: np.ndarray) -> np.ndarray:
        """Return heights on a regular grid of N rows (north) and E columns (east), (N, E), in metres."""
        return self.surface.on_grid(east, north)

    def slopes(self, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return exact slopes toward east and north on a grid of N rows and E columns, (N, E) each, in m/m."""
        return self.surface.on_grid(east, north, (1, 0)), self.surface.on_grid(east, north, (0, 1))

    @cached_property
    def limits(self) -> tuple[float, float]:
        """Lower and upper bound of the terrain's heights, in metres."""
        # A B-spline lies between its coefficients.
        return float(self.surface.coefficients.min()), float(self.surface.coefficients.max())


@cache
def _jacksboro() -> tuple[np.ndarray, tuple[float, float]]:
    """Return the Jacksboro elevation model: heights (rows to the north) and grid spacing (east, north), in metres."""
    # Locate the data without importing matplotlib, which is only needed for figures.
    package = find_spec("matplotlib")
    assert package is not None
    assert package.origin is not None
    with np.load(Path(package.origin).parent / "mpl-data" / "sample_data" / "jacksboro_fault_dem.npz") as data:
        posts = data["elevation"][::-1].astype(np.float64)
        step = np.radians([float(data["dx"]), float(data["dy"])])
        latitude = 0.5 * np.radians(float(data["ymin"]) + float(data["ymax"]))
    meridian, normal = curvature_radii(latitude)
    posts.setflags(write=False)
    return posts, (float(step[0] * normal * np.cos(latitude)), float(step[1] * meridian))
