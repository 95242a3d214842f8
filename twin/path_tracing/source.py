"""Light sources of the path tracer: uniform pinholes, collimated beams, and lists of rays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np

from optics.geometry.pose import Pose
from optics.numerics.backend import Backend
from optics.raytrace.aim import transverse_axes
from twin.path_tracing.clear_ways import Patch
from twin.path_tracing.kernel import Launch


@dataclass(frozen=True, eq=False)
class DiskSource:
    """Rays from a uniform disk of positions into a uniform disk of direction cosines about an axis.

    Its radiance is constant, so that power is proportional to the solid angle times the cosine with the axis (Lambert).
    Where much of the cone is of little interest, part of the paths can be aimed into a narrower cone inside it; every
    path then carries the weight (density of the wide cone) / (density it was drawn with), so that the expected power of
    every direction stays the same. All weights add up to 1 on average.

    Attributes
    ----------
    centre : (3,) ndarray
        Centre of the disk of positions, world frame, metres.
    axis : (3,) ndarray
        Axis of the cone, unit vector.
    across : (2, 3) ndarray
        Two unit vectors perpendicular to the axis; the disk of positions lies in their plane.
    radius : float
        Radius of the disk of positions, metres.
    cone : float
        Sine of the cone's half-angle; 0 is a collimated beam.
    narrow : tuple of (float, float, float) or None
        Centre, in the plane of ``across``, and radius of the narrow cone, direction cosines; inside the wide cone.
    share : float
        Share of the paths that are aimed into the narrow cone.
    """

    centre: np.ndarray
    axis: np.ndarray
    across: np.ndarray
    radius: float
    cone: float = 0.0
    narrow: tuple[float, float, float] | None = None
    share: float = 0.5

    def __post_init__(self) -> None:
        """Raise ValueError if the narrow cone is not inside the wide one or a size is not possible."""
        if self.radius < 0.0 or not 0.0 <= self.cone < 1.0:
            raise ValueError(
                f"a source needs a radius of 0 or more and a cone in [0, 1), found {self.radius}, {self.cone}"
            )
        if self.narrow is not None:
            x, y, r = self.narrow
            if not (0.0 < r and float(np.hypot(x, y)) + r <= self.cone):
                raise ValueError(f"the narrow cone {self.narrow} does not lie in the cone of sine {self.cone}")

    @classmethod
    def along(cls, centre: np.ndarray, axis: np.ndarray, radius: float, cone: float = 0.0) -> DiskSource:
        """Make a source from its axis; the pair of transverse axes is arbitrary."""
        axis = np.asarray(axis, np.float64) / np.linalg.norm(axis)
        helper = np.eye(3)[np.argmin(np.abs(axis))]
        return cls(np.asarray(centre, np.float64), axis, transverse_axes(axis, helper), radius, cone)

    def aimed_at(self, directions: np.ndarray, room: float = 1.05, share: float = 0.5) -> DiskSource:
        """Return the source with a narrow cone around N given directions, (N, 3).

        Parameters
        ----------
        directions : (N, 3) ndarray
            The N directions, unit vectors.
        room : float
            Radius of the narrow cone relative to the smallest one about their middle.
        share : float
            Share of the paths aimed into it.
        """
        place = np.asarray(directions) @ self.across.T
        middle = 0.5 * (place.min(axis=0) + place.max(axis=0))
        reach = room * float(np.max(np.linalg.norm(place - middle, axis=-1)))
        return replace(self, narrow=(float(middle[0]), float(middle[1]), reach), share=share)

    @property
    def patch(self) -> Patch:
        """Disk that emits the light, as the start of a clear segment (a stretch of path with nothing in between)."""
        pose = Pose(np.column_stack([*self.across, self.axis]), self.centre)
        r = self.radius
        return Patch.flat(-1, 0, pose, (-r, r, -r, r))

    @property
    def numbers(self) -> np.ndarray:
        """Numbers of the source that the kernel reads, (20,)."""
        x, y, r = self.narrow or (0.0, 0.0, self.cone)
        share = self.share if self.narrow else 0.0
        gain = (self.cone / r) ** 2 if r > 0.0 else 1.0
        rest = (self.radius, self.cone, x, y, r, share, gain, 0.0)
        return np.concatenate([self.centre, self.axis, *self.across, rest])


@dataclass(frozen=True, eq=False)
class RaySource:
    """List of N rays: world positions (N, 3), metres, unit directions (N, 3), and weights (N,)."""

    position: np.ndarray
    direction: np.ndarray
    weight: np.ndarray

    @classmethod
    def even(cls, position: np.ndarray, direction: np.ndarray) -> RaySource:
        """Make rays of equal weight 1/N; positions and directions are broadcast to each other."""
        position, direction = np.broadcast_arrays(np.asarray(position, np.float64), np.asarray(direction, np.float64))
        return cls(position, direction, np.full(len(position), 1.0 / len(position)))


Source = DiskSource | RaySource

BLOCK = 32
"""Number of neighbouring paths that start alike, in the same small part of the same cone.

They are traced together, and mostly meet the same surfaces and end together. The blocks fill the cones evenly, from a
random start, so that each path has any direction with its density in the cone.
"""

_STEPS = (0.7548776662466927, 0.5698402909980532)
"""Steps from a block of paths to the next, of the radius squared and of the angle in the cone, as fractions.

They are those of Roberts's sequence of the plastic number, "The unreasonable effectiveness of quasirandom sequences"
(2018), which fills the unit square evenly at any length.
"""

_CELL = (1.0 / 16.0, 1.0 / 64.0)
"""Range of the radius squared and of the angle that a block of paths covers in the cone, as fractions."""


def random_streams(backend: Backend, numbers: Any, seed: int) -> Any:
    """Return a random generator with one stream per path, set by the seed and the path's number alone."""
    import drjit as dr

    module = import_module(f"drjit.{backend.name}.ad")
    UInt64 = dr.uint64_array_t(backend.Float)
    mix = dr.opaque(UInt64, (seed * 0x9E3779B97F4A7C15 + 0x632BE59BD9B4E019) & 0xFFFFFFFFFFFFFFFF)
    # splitmix64 of Steele, Lea and Flood (2014)
    z = mix + UInt64(numbers) * UInt64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> 30)) * UInt64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> 27)) * UInt64(0x94D049BB133111EB)
    rng = module.PCG32()
    rng.seed(z ^ (z >> 31), UInt64(numbers))
    return rng


def start(backend: Backend, source: Source, chosen: np.ndarray, total: int, seed: int) -> Launch:
    """Return the light at the start of some paths of a run.

    Parameters
    ----------
    backend : Backend
        Backend that traces the paths.
    source : Source
        Source of the paths.
    chosen : (N,) ndarray
        Numbers of the N paths in the run.
    total : int
        Number of paths of the run.
    seed : int
        Seed of the random numbers.
    """
    numbers = backend.opaque(chosen, backend.UInt)
    if isinstance(source, DiskSource):
        return _drawn(backend, source, numbers, total, seed)
    return Launch(
        backend.vector(source.position[chosen]),
        backend.vector(source.direction[chosen]),
        backend.opaque(source.weight[chosen]),
        numbers,
        random_streams(backend, numbers, seed),
    )


def _drawn(backend: Backend, source: DiskSource, numbers: Any, total: int, seed: int) -> Launch:
    """Draw the paths of given numbers (``UInt``) of a run of ``total`` paths."""
    import drjit as dr

    rng = random_streams(backend, numbers, seed)
    s = [dr.gather(backend.Float, backend.opaque(source.numbers), k) for k in range(19)]
    vectors = [backend.Vector3(s[3 * k], s[3 * k + 1], s[3 * k + 2]) for k in range(4)]
    centre, axis, first, second = vectors
    radius, cone, x, y, narrow, share, gain = s[12:19]
    block = backend.Float(numbers // BLOCK)
    shift = [dr.opaque(backend.Float, float(u)) for u in np.random.default_rng(seed).random(3)]

    def fraction(value: Any) -> Any:
        return value - dr.floor(value)

    def independent() -> tuple[Any, Any]:
        return rng.next_float64(), rng.next_float64()

    def stratified() -> tuple[Any, Any]:
        return tuple(fraction(dr.fma(block, _STEPS[k], shift[k]) + _CELL[k] * rng.next_float64()) for k in range(2))

    # neighbours have similar directions; in a collimated beam, similar positions
    first_two, last_two = (independent(), stratified()) if source.cone > 0.0 else (stratified(), independent())
    r, angle = radius * dr.sqrt(first_two[0]), 2.0 * dr.pi * first_two[1]
    sine, cosine = dr.sincos(angle)
    position = centre + (r * cosine) * first + (r * sine) * second
    aimed = fraction(dr.fma(block, share, shift[2])) < share
    r, angle = dr.sqrt(last_two[0]), 2.0 * dr.pi * last_two[1]
    sine, cosine = dr.sincos(angle)
    r = r * dr.select(aimed, narrow, cone)
    u, v = r * cosine + dr.select(aimed, x, 0.0), r * sine + dr.select(aimed, y, 0.0)
    direction = u * first + v * second + dr.sqrt(1.0 - u * u - v * v) * axis
    inside = (u - x) * (u - x) + (v - y) * (v - y) <= narrow * narrow * (1.0 + 1e-12)
    density = dr.select(inside & (share > 0.0), 1.0 - share + share * gain, 1.0 - share)
    weight = dr.opaque(backend.Float, 1.0 / total) / density
    return Launch(position, direction, weight, numbers, rng)


def pieces(total: int, size: int, cut: int = 0) -> Iterator[tuple[int, int]]:
    """Divide a run into launches of at most ``size`` paths; yield the number of the first path and of paths of each.

    A launch is a group of paths traced together. No launch extends across the path number ``cut``.
    """
    for begin, end in ((0, cut), (cut, total)):
        for first in range(begin, end, size):
            yield first, min(size, end - first)
