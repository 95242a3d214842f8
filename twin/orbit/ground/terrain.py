"""Heights of the ground over the coordinates of a patch."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, assert_never

import numpy as np
from scipy.ndimage import spline_filter

from twin.orbit.flight.earth import curvature_radii
from twin.orbit.ground.grid import SplineGrid, fractal_field

if TYPE_CHECKING:
    from scenes.specs.orbit.scene import TerrainSpec

_MOST_POSTS = 4096
"""Posts along a side of a fractal; it repeats beyond."""


@dataclass(frozen=True, eq=False)
class Terrain:
    """Heights above the ellipsoid, the same function for the renderer, for true coordinates and for elevation models.

    Attributes:
        surface: cubic spline through the posts, defined everywhere, metres.
    """

    surface: SplineGrid

    @classmethod
    def from_spec(cls, spec: TerrainSpec, side: float, seed: np.random.SeedSequence) -> Terrain:
        """From what the file says.

        Args:
            spec: terrain.
            side: of the ground that is used, metres; a fractal repeats after half as much again, or later.
            seed: of a fractal.
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
        """Level ground."""
        return cls(SplineGrid(np.full((2, 2), float(height)), (1e3, 1e3), (0.0, 0.0), "mirror"))

    @classmethod
    def through(cls, posts: np.ndarray, spacing: tuple[float, float], first: tuple[float, float]) -> Terrain:
        """A spline through posts (rows to the north, columns to the east), mirrored beyond them; spacing and first
        place as in `SplineGrid`, metres.
        """
        posts = np.asarray(posts, dtype=np.float64)
        return cls(SplineGrid(spline_filter(posts, order=3, mode="mirror"), spacing, first, "mirror"))

    @classmethod
    def real(cls, spec: TerrainSpec) -> Terrain:
        """The model of the Jacksboro fault that matplotlib ships, moved so that its middle lies at minus the offset.

        Its heights, above the geoid there, are taken as heights about their mean; its posts, 3 arc seconds, keep their
        distance in metres.
        """
        posts, spacing = _jacksboro()
        about = posts - posts.mean()
        if spec.relief is not None:
            about = about * (spec.relief / np.std(about))
        first = [-0.5 * (n - 1) * d - o for n, d, o in zip(posts.shape[::-1], spacing, spec.offset, strict=True)]
        return cls.through(spec.height + about, spacing, (first[0], first[1]))

    @classmethod
    def fractal(cls, spec: TerrainSpec, side: float, seed: np.random.SeedSequence) -> Terrain:
        """Drawn with a power law as its spectrum."""
        count = 64
        while count * spec.post < 1.5 * side and count < _MOST_POSTS:
            count *= 2
        relative = fractal_field((count, count), spec.post, spec.exponent, spec.longest, seed).astype(np.float64)
        posts = spec.height + (spec.relief or 0.0) * relative
        corner = -0.5 * count * spec.post
        coefficients = spline_filter(posts, order=3, mode="grid-wrap")
        return cls(SplineGrid(coefficients, (spec.post, spec.post), (corner, corner), "grid-wrap"))

    def height(self, east: np.ndarray, north: np.ndarray) -> np.ndarray:
        """Heights at places, metres, of the places' shape."""
        return self.surface(east, north)

    def on_grid(self, east: np.ndarray, north: np.ndarray) -> np.ndarray:
        """Heights on a regular grid: (E,), (N,) -> (N, E), metres."""
        return self.surface.on_grid(east, north)

    def slopes(self, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Exact slopes toward east and toward north on a regular grid, (N, E) each."""
        return self.surface.on_grid(east, north, (1, 0)), self.surface.on_grid(east, north, (0, 1))

    @cached_property
    def limits(self) -> tuple[float, float]:
        """Heights between which it lies, metres."""
        # a B-spline lies between its coefficients
        return float(self.surface.coefficients.min()), float(self.surface.coefficients.max())


@cache
def _jacksboro() -> tuple[np.ndarray, tuple[float, float]]:
    """Heights (rows to the north), metres, and the posts' distance east and north, metres."""
    # found without importing matplotlib, which only draws
    found = find_spec("matplotlib")
    assert found is not None
    assert found.origin is not None
    with np.load(Path(found.origin).parent / "mpl-data" / "sample_data" / "jacksboro_fault_dem.npz") as data:
        posts = data["elevation"][::-1].astype(np.float64)
        step = np.radians([float(data["dx"]), float(data["dy"])])
        latitude = 0.5 * np.radians(float(data["ymin"]) + float(data["ymax"]))
    meridian, normal = curvature_radii(latitude)
    posts.setflags(write=False)
    return posts, (float(step[0] * normal * np.cos(latitude)), float(step[1] * meridian))
