"""Path tracer: prepares a scene and traces paths in launches.

Light sources of the path tracer: uniform pinholes, collimated beams, and lists of rays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np

from optics.geometry.pose import Pose
from optics.numerics.backend import Backend
from optics.raytrace.aim import transverse_axes
from scenes.models.scenery import Scenery
from twin.path_tracing.clear_ways import ClearSegments, Patch
from twin.path_tracing.kernel import (
    Features,
    Launch,
    LearnedRoulette,
    Limits,
    PathHistory,
    PreparedScene,
    follow,
    learn_survival,
)
from twin.path_tracing.path_families import SurfaceEvent, signature, surface_events
from twin.path_tracing.path_result import NOMINAL, Accumulators, Collector, Key, PathResult, make_accumulators
from twin.path_tracing.sequential import Departures, Step, continue_paths, make_steps, trace_nominal
from twin.path_tracing.tables import ROWS_PER_SURFACE, SurfaceForm, segment_table, upload


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
        radius = room * float(np.max(np.linalg.norm(place - middle, axis=-1)))
        return replace(self, narrow=(float(middle[0]), float(middle[1]), radius), share=share)

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


def pieces(total: int, size: int, boundary: int = 0) -> Iterator[tuple[int, int]]:
    """Divide a run into launches of at most ``size`` paths; yield the number of the first path and of paths of each.

    A launch is a group of paths traced together. No launch extends across the path number ``boundary``.
    """
    for begin, end in ((0, boundary), (boundary, total)):
        for first in range(begin, end, size):
            yield first, min(size, end - first)


VARIANTS = {"llvm": "llvm_ad_mono", "cuda": "cuda_ad_mono"}
"""Backend -> Mitsuba's variant with the same arrays; triangles are float32 in all of them."""


class VariantUnavailable(RuntimeError):
    """Error that Mitsuba cannot run the variant that the backend needs."""


def load_mitsuba(backend: Backend) -> Any:
    """Import mitsuba and set exactly the backend's variant.

    Raises
    ------
    VariantUnavailable
        The variant could not be set (Mitsuba itself would silently take another one from a list).
    """
    import mitsuba as mi  # after optics, which sets the path of the LLVM library

    variant = VARIANTS[backend.name]
    if mi.variant() != variant:
        try:
            mi.set_variant(variant)
        except (ImportError, AttributeError) as error:
            raise VariantUnavailable(f"mitsuba {mi.__version__} cannot run its variant {variant}: {error}") from error
    if mi.variant() != variant:
        raise VariantUnavailable(f"mitsuba runs its variant {mi.variant()} where {variant} is needed")
    return mi


def build_scene(mi: Any, scenery: Scenery) -> Any:
    """Return a ``mi.Scene`` of the triangles; Mitsuba's index of a shape is the index of the surface.

    Parameters
    ----------
    mi : module
        Mitsuba with its variant set.
    scenery : Scenery
        Surfaces; their triangles are transformed to the world frame in float64 and rounded once.

    Raises
    ------
    AssertionError
        Mitsuba has put the shapes in another order.
    """
    names = [f"surface{i:05d}" for i in range(len(scenery.surfaces))]
    # robust: rays do not leak between two triangles
    description: dict[str, Any] = {"type": "scene", "embree_use_robust_intersections": True}
    for name, surface in zip(names, scenery.surfaces, strict=True):
        mesh = mi.Mesh(name, len(surface.vertices), len(surface.triangles))
        parameters = mi.traverse(mesh)
        world = surface.pose.apply(surface.vertices).astype(np.float32)
        parameters["vertex_positions"] = mi.Float(np.ascontiguousarray(world.ravel()))
        parameters["faces"] = mi.UInt32(np.ascontiguousarray(surface.triangles.astype(np.uint32).ravel()))
        parameters.update()
        description[name] = mesh
    # the parser's optimisations would merge meshes of the same material
    scene = mi.load_dict(description, optimize=False)
    if [shape.id() for shape in scene.shapes()] != names:
        raise AssertionError("mitsuba has put the shapes of a scene in another order")
    return scene


@dataclass(frozen=True)
class Sampling:
    """Probabilities with which paths choose their directions and are ended.

    Attributes
    ----------
    steps : int
        Number of steps after which every path ends.
    floor : float
        Smallest probability of each possible direction at a surface. 0: proportional to power, and the energy balance
        is exact in every run. Above 0, weak directions are drawn more often and carry less weight each, which finds
        faint ghosts; the balance then holds on average.
    second : float or None
        Smallest probability for paths that have taken one direction which ``floor`` made more likely; None uses
        ``floor``. A ghost comes from two weak reflections: after the first the second is worth drawing, and after the
        second none is.
    further : float or None
        Smallest probability for paths that have taken more such directions or have been scattered; None uses ``floor``.
    scatter_floor : float
        Smallest probability of scattering out of the specular direction; where ``second`` is given it ends with the
        first weak direction.
    near : float
        Share of scattered directions whose distance from the specular one is drawn log-uniformly: a small detector in
        the focus of specular light receives only the innermost part of a lobe.
    roulette : float
        Weight, relative to the mean weight at the start, below which a path is ended at random while survivors carry
        more; 0: never.
    first : float
        Share of the paths from which a run learns the survival probabilities of paths that leave nominal light
        (``importance_sampling``); 0: all are followed.
    """

    steps: int = 96
    floor: float = 0.0
    second: float | None = None
    further: float | None = None
    scatter_floor: float = 0.0
    near: float = 0.0
    roulette: float = 0.0
    first: float = 0.0

    def __post_init__(self) -> None:
        """Raise ValueError if a number is outside its range."""
        shares = (*self.floors, self.scatter_floor, self.near, self.first)
        if self.steps < 1 or not all(0.0 <= share < 1.0 for share in shares) or self.roulette < 0.0:
            raise ValueError(f"invalid sampling (shares in [0, 1), at least one step): {self}")

    @property
    def floors(self) -> tuple[float, float, float]:
        """Smallest probabilities of a direction for paths that have taken no, one, and more weak directions before."""
        return (
            self.floor,
            self.floor if self.second is None else self.second,
            self.floor if self.further is None else self.further,
        )

    @property
    def scatter_floors(self) -> tuple[float, float, float]:
        """Smallest probabilities of scattering for paths that have taken no, one, and more weak directions before."""
        later = self.scatter_floor if self.second is None else 0.0
        return self.scatter_floor, later, later


BALANCED = Sampling()
"""Sampling with every direction drawn in proportion to its power."""

FAINT = Sampling(floor=0.1, second=0.5, further=0.0, scatter_floor=0.02, near=0.5, roulette=1e-6, first=1 / 16)
"""Sampling with weak directions drawn more often, for ghosts and stray light."""


@dataclass(frozen=True, eq=False)
class NominalPath:
    """Data by which N paths of a launch are traced along the nominal path.

    Attributes
    ----------
    steps : Sequence[Step]
        Surfaces of the nominal path.
    numbers : (N,) ndarray
        Numbers of the paths in the run.
    learned : LearnedRoulette or None
        Russian roulette of the paths that leave it; None follows all of them.
    """

    steps: Sequence[Step]
    numbers: np.ndarray
    learned: LearnedRoulette | None = None


def launch(
    scene: PreparedScene,
    sampling: Sampling,
    features: Features,
    start: Launch,
    mean_weight: float,
    accumulators: Accumulators,
    along: NominalPath | None = None,
) -> PathHistory | None:
    """Trace paths in float64 to their end and add the results to the accumulators.

    Returns
    -------
    PathHistory or None
        History of the paths along the nominal path and after it, None without one.
    """
    import drjit as dr

    backend = scene.backend
    limits = Limits(
        dr.opaque(backend.UInt, sampling.steps),
        dr.opaque(backend.UInt, accumulators.capacity),
        [backend.opaque(floor) for floor in sampling.floors],
        [backend.opaque(floor) for floor in sampling.scatter_floors],
        backend.opaque(sampling.near),
        backend.opaque(sampling.roulette * mean_weight),
    )
    with dr.suspend_grad():
        dr.scatter_add(accumulators.left, start.weight, backend.UInt(2))
        if along is None:
            follow(scene, features, limits, start, accumulators)
            dr.eval(accumulators.arrays)
            return None
        nominal = trace_nominal(scene, features, limits, start, accumulators, along.steps)
        dr.eval(accumulators.arrays, nominal.arrays)
        left = Departures.of(along.steps, nominal, along.numbers, along.learned, features.log)
        steps = np.zeros(len(along.numbers))
        if len(left.chosen):
            taken = follow(scene, features, limits, continue_paths(backend, along.steps, nominal, left), accumulators)
            dr.eval(accumulators.arrays, taken)
            steps[left.chosen] = taken.numpy() - left.passed[left.chosen]
    return PathHistory(left.passed, left.redirected, steps)


CHUNK = 1 << 19
"""Number of paths of one launch: about 200 MB of memory."""

LEAST_CAPACITY = 1 << 14
LEAST_NOMINAL = 1 << 16
"""Smallest number of paths of a run that are traced surface by surface along the nominal path.

So many save the time that recording its kernel takes, as measured. Fewer are traced by the loop alone; the paths are
the same.
"""
MOST_FAMILIES = 200
"""Largest number of path families (paths with the same events) whose events are determined, the strongest first."""

Progress = Callable[[int, int], None]
"""Function called with the number of paths done and the number of all."""


class PathTracer:
    """Scene prepared for path tracing.

    Parameters
    ----------
    backend : Backend
        Backend that traces the paths.
    scenery : Scenery
        Surfaces.
    nominal : Mapping[str, tuple of int] or None
        Detector -> events of its nominal light, as the numbers of ``path_families.code``.
    sampling : Sampling
        Sampling of the paths.
    segments : bool
        Use clear segments; otherwise every surface is searched for. The paths are the same.

    Raises
    ------
    ValueError
        Nominal events are given for a detector that the scenery does not have.
    """

    def __init__(
        self,
        backend: Backend,
        scenery: Scenery,
        nominal: Mapping[str, tuple[int, ...]] | None = None,
        sampling: Sampling = BALANCED,
        segments: bool = True,
    ) -> None:
        self.backend = backend
        self.scenery = scenery
        self.nominal = dict(nominal or {})
        names = [d.name for d in scenery.detectors]
        if unknown := sorted(set(self.nominal) - set(names)):
            detector_names = ", ".join(names)
            raise ValueError(
                f"families of unknown detectors: {', '.join(unknown)}; detectors of the scene: {detector_names}"
            )
        self.sampling = sampling
        mi = load_mitsuba(backend)
        signatures = {name: signature(codes) for name, codes in self.nominal.items()}
        self._clear = ClearSegments(scenery, self.nominal if segments else {})
        tables = upload(backend, scenery, signatures, self._clear.segments)
        self.prepared = PreparedScene(backend, mi, build_scene(mi, scenery), tables)
        self._signatures = [signatures.get(name, 0) for name in names]

    def features(self, keep_nominal: bool = False, log: bool = False) -> Features:
        """Return the features of the kernel for this scene."""
        surfaces = self.scenery.surfaces
        finishes = [f for s in surfaces for f in (s.front, s.back, s.outside)]
        return Features(
            form=SurfaceForm.of(surfaces),
            glass=any(s.solid is not None for s in surfaces),
            segments=bool(self._clear.segments),
            branching=any(f.bare or f.transmission or f.diffuse or f.scatter or f.table for f in finishes),
            bare=any(f.bare for f in finishes),
            measured=any(f.coating or f.table for f in finishes),
            roulette=self.sampling.roulette > 0.0,
            near=self.sampling.near > 0.0,
            keep_nominal=keep_nominal,
            log=log,
        )

    def run(
        self,
        source: Source,
        paths: int | None = None,
        seed: int = 0,
        keep: bool = False,
        chunk: int = CHUNK,
        progress: Progress | None = None,
        toward: str | None = None,
    ) -> PathResult:
        """Trace paths from a source.

        Parameters
        ----------
        source : Source
            Source of the paths.
        paths : int or None
            Number of paths; None for all rays of a ``RaySource``.
        seed : int
            Seed of the random numbers; the same seed gives the same paths, whatever the chunk.
        keep : bool
            Keep the single detections (memory grows with the number of paths).
        chunk : int
            Number of paths of one launch, which limits the memory.
        progress : Progress or None
            Called after each launch.
        toward : str or None
            Detector whose nominal family most of the source's light follows, which saves time; the first one by
            default.
        """
        total = self._total(source, paths)
        features = self.features(keep)
        collector = Collector(self.scenery, self._signatures, keep)
        prepared, segment = self._with_first_segment(source, toward)
        steps = self.nominal_steps(source, toward, total)
        capacity = max(LEAST_CAPACITY, min(chunk, total) // (1 if keep else 2))
        learning = round(total * self.sampling.first) if steps else 0
        learned: LearnedRoulette | None = None
        learning_launches: list[tuple[PathHistory, np.ndarray, np.ndarray]] = []
        for first, count in pieces(total, chunk, learning):
            while True:
                accumulators = self._accumulators(capacity)
                numbers = np.arange(first, first + count)
                light = replace(start(self.backend, source, numbers, total, seed), segment=segment)
                along = NominalPath(steps, numbers, learned) if steps else None
                history = launch(prepared, self.sampling, features, light, 1.0 / total, accumulators, along)
                wanted = int(accumulators.counter.numpy()[0])
                if wanted <= accumulators.capacity:
                    break
                capacity = 2 * wanted  # the repeated launch gives the same paths
            brought = collector.add(accumulators, float(accumulators.left.numpy()[2]), count)
            if history is not None and first < learning:
                learning_launches.append((history, *brought))
                if first + count == learning:
                    learned = learn_survival(learning_launches, seed)
            if progress is not None:
                progress(first + count, total)
        return collector.result(self._family_events(source, collector, total, seed, toward, learned))

    def nominal_steps(self, source: Source, toward: str | None, paths: int) -> tuple[Step, ...]:
        """Return the surfaces that nominal light of a source meets and that the paths of a run pass in this order.

        Parameters
        ----------
        source : Source
            Source of the paths.
        toward : str or None
            Name of the detector whose nominal light the source emits; None for the first one.
        paths : int
            Number of paths of the run.
        """
        line = self._clear.apertures(toward) if paths >= LEAST_NOMINAL else []
        if not line or not isinstance(source, DiskSource):
            return ()
        segment = self._clear.from_source(source.patch, toward)
        numbers = [0 if segment is None else 1, *(number + 2 if number >= 0 else 0 for number, _ in line[1:])]
        known = list(zip(numbers, (patch for _, patch in line), strict=True))
        codes = self.nominal[toward or next(iter(self.nominal))]
        # the loop does the last step, at which it ends paths
        return make_steps(self.scenery, known, codes, source.centre)[: self.sampling.steps - 1]

    def _with_first_segment(self, source: Source, toward: str | None) -> tuple[PreparedScene, Any]:
        """Return the scene with the clear segment from a source to its first surface, and its index; 0 for none."""
        import drjit as dr

        segment = self._clear.from_source(source.patch, toward) if isinstance(source, DiskSource) else None
        tables = replace(
            self.prepared.tables, segments=self.backend.opaque(segment_table(self._clear.segments, segment))
        )
        return replace(self.prepared, tables=tables), dr.opaque(self.backend.UInt, 0 if segment is None else 1)

    def _total(self, source: Source, paths: int | None) -> int:
        if isinstance(source, DiskSource):
            if paths is None or paths < 1:
                raise ValueError(f"the number of paths must be at least 1; found {paths}")
            return paths
        if paths not in (None, len(source.position)):
            raise ValueError("a list of rays is traced as a whole: `paths` must be None or their number")
        return len(source.position)

    def _accumulators(self, capacity: int, log: int = 0) -> Accumulators:
        detectors = self.scenery.detectors
        pixels = sum(d.columns * d.rows for d in detectors)
        return make_accumulators(
            self.backend, ROWS_PER_SURFACE * len(self.scenery.surfaces), len(detectors), pixels, capacity, log
        )

    def _family_events(
        self,
        source: Source,
        collector: Collector,
        total: int,
        seed: int,
        toward: str | None,
        learned: LearnedRoulette | None,
    ) -> dict[Key, tuple[SurfaceEvent, ...]]:
        """Return the events of path families: nominal ones as given, others by tracing one path of each again."""
        names = [d.name for d in self.scenery.detectors]
        events = {
            key: surface_events(self.scenery, self.nominal[names[key.detector]])
            for key in collector.sums
            if key.kind == NOMINAL
        }
        keys = collector.strongest(MOST_FAMILIES)
        if not keys:
            return events
        examples = np.array([collector.examples[k] for k in keys], np.uint32)
        for key, codes in zip(keys, self.events(source, examples, total, seed, toward, learned), strict=True):
            # the path may have continued from the detector: the family is the part before
            for n in range(len(codes) + 1):
                if signature(codes[:n]) == key.signature:
                    events[key] = surface_events(self.scenery, codes[:n])
                    break
        return events

    def events(
        self,
        source: Source,
        numbers: np.ndarray,
        total: int,
        seed: int,
        toward: str | None = None,
        learned: LearnedRoulette | None = None,
    ) -> list[tuple[int, ...]]:
        """Return the numbers (``path_families.code``) of all events of selected paths of a run, which are traced again.

        ``numbers`` are the paths' numbers in the run; the other arguments are those of the run.
        """
        import drjit as dr

        count, steps_limit = len(numbers), self.sampling.steps
        prepared, segment = self._with_first_segment(source, toward)
        steps = self.nominal_steps(source, toward, total)
        # each path has its own part of the log, independent of its number in the run
        indices = dr.arange(self.backend.UInt, count)
        light = replace(start(self.backend, source, numbers, total, seed), path=indices, segment=segment)
        accumulators = self._accumulators(LEAST_CAPACITY, count * steps_limit)
        along = NominalPath(steps, numbers, learned) if steps else None
        history = launch(prepared, self.sampling, self.features(log=True), light, 1.0 / total, accumulators, along)
        # steps that skipped a surface have code 0
        logged = [tuple(int(c) for c in row if c) for row in accumulators.log.numpy().reshape(count, -1)]
        if history is None:
            return logged
        codes = tuple(step.code for step in steps)
        return [codes[:passed] + after for passed, after in zip(history.passed, logged, strict=True)]
