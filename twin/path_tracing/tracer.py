"""A scene made ready for path tracing, and run piece by piece."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optics.numerics.backend import Backend
from scenes.models.scenery import Scenery
from twin.path_tracing.clear_ways import ClearWays
from twin.path_tracing.importance_sampling import Followed, Thinning, learn
from twin.path_tracing.kernel import Features, Launch, Limits, PreparedScene, follow
from twin.path_tracing.path_families import Touch, signature, touches
from twin.path_tracing.path_result import NOMINAL, Collector, Key, PathResult, Sinks, make_sinks
from twin.path_tracing.sequential import Left, Step, go_on, pass_along, steps_of
from twin.path_tracing.source import DiskSource, Source, pieces, start
from twin.path_tracing.tables import ROWS_PER_SURFACE, SurfaceForm, upload, way_table

VARIANTS = {"llvm": "llvm_ad_mono", "cuda": "cuda_ad_mono"}
"""Mitsuba's variant whose arrays are those of the backend; triangles are float32 in all of them."""


class VariantUnavailable(RuntimeError):
    """Mitsuba cannot run the variant that the backend needs."""


def load_mitsuba(backend: Backend) -> Any:
    """The mitsuba module with exactly the backend's variant set.

    Raises
    ------
    VariantUnavailable
        It could not be set (Mitsuba itself would take another one silently from a list).
    """
    import mitsuba as mi  # after optics, which has named the LLVM library

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
    """A ``mi.Scene`` of the triangles; Mitsuba's index of a shape is the number of the surface.

    Parameters
    ----------
    mi : Any
        Mitsuba with its variant set.
    scenery : Scenery
        The surfaces; their triangles are moved to the world in float64 and rounded once.

    Raises
    ------
    AssertionError
        Mitsuba has put the shapes in another order.
    """
    names = [f"surface{i:05d}" for i in range(len(scenery.surfaces))]
    # robust: rays do not slip through between two triangles
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
    """How paths are drawn.

    Attributes
    ----------
    steps : int
        At which a path ends, whatever it carries.
    floor : float
        Smallest probability of each way that a path can go at a surface. 0: as the power goes, and the balance of the
        power is exact in every run. Above 0 weak ways are drawn more often and carry less each, which finds faint
        ghosts; the balance then holds on average.
    second : float | None
        The floor of paths that have gone one way that a floor made more likely, and ``further`` of those that have gone
        more of them or have been scattered; None for ``floor``. A ghost comes of two weak reflections: after the first
        the second is worth drawing, and after the second nothing is.
    scatter_floor : float
        The floor of scattering out of the specular direction; where ``second`` is given it ends with the first weak
        way.
    near : float
        Share of scattered directions whose distance from the specular one is drawn even in its logarithm: a small
        detector in the specular light's focus sees the innermost part of a lobe alone.
    roulette : float
        Relative to a path's mean weight at the start: below it a path is ended at random, and those that go on carry
        more; 0: never.
    first : float
        Share of the paths from which a run learns where it is worth following paths that turn away from nominal light
        (``thinning``); 0: all are followed.
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
        """Check the numbers."""
        shares = (*self.floors, self.scatter_floor, self.near, self.first)
        if self.steps < 1 or not all(0.0 <= share < 1.0 for share in shares) or self.roulette < 0.0:
            raise ValueError(f"impossible sampling: {self}")

    @property
    def floors(self) -> tuple[float, float, float]:
        """Floors after none, one, and more weak ways."""
        return (
            self.floor,
            self.floor if self.second is None else self.second,
            self.floor if self.further is None else self.further,
        )

    @property
    def scatter_floors(self) -> tuple[float, float, float]:
        """Likewise of scattering."""
        later = self.scatter_floor if self.second is None else 0.0
        return self.scatter_floor, later, later


BALANCED = Sampling()
"""Every way is drawn as the power goes."""

FAINT = Sampling(floor=0.1, second=0.5, further=0.0, scatter_floor=0.02, near=0.5, roulette=1e-6, first=1 / 16)
"""Weak ways are drawn more often: for ghosts and stray light."""


@dataclass(frozen=True, eq=False)
class Along:
    """How the paths of a launch take the nominal way.

    Attributes
    ----------
    steps : Sequence[Step]
        Its surfaces.
    numbers : np.ndarray
        Of the paths in the run, (N,).
    thinning : Thinning | None
        Of the paths that leave it, None for none.
    """

    steps: Sequence[Step]
    numbers: np.ndarray
    thinning: Thinning | None = None


def launch(
    scene: PreparedScene,
    sampling: Sampling,
    features: Features,
    start: Launch,
    mean_weight: float,
    sinks: Sinks,
    along: Along | None = None,
) -> Followed | None:
    """Trace paths in float64 to their end and write what they meet to the sinks.

    Returns
    -------
    Followed | None
        What the paths have done along the nominal way and after it, None without one.
    """
    import drjit as dr

    backend = scene.backend
    limits = Limits(
        dr.opaque(backend.UInt, sampling.steps),
        dr.opaque(backend.UInt, sinks.room),
        [backend.opaque(floor) for floor in sampling.floors],
        [backend.opaque(floor) for floor in sampling.scatter_floors],
        backend.opaque(sampling.near),
        backend.opaque(sampling.roulette * mean_weight),
    )
    with dr.suspend_grad():
        dr.scatter_add(sinks.left, start.weight, backend.UInt(2))
        if along is None:
            follow(scene, features, limits, start, sinks)
            dr.eval(sinks.arrays)
            return None
        stretch = pass_along(scene, features, limits, start, sinks, along.steps)
        dr.eval(sinks.arrays, stretch.arrays)
        left = Left.of(along.steps, stretch, along.numbers, along.thinning, features.log)
        steps = np.zeros(len(along.numbers))
        if len(left.chosen):
            taken = follow(scene, features, limits, go_on(backend, along.steps, stretch, left), sinks)
            dr.eval(sinks.arrays, taken)
            steps[left.chosen] = taken.numpy() - left.passed[left.chosen]
    return Followed(left.passed, left.turned, steps)


CHUNK = 1 << 19
"""Paths of one launch: about 200 MB at work."""

LEAST_ROOM = 1 << 14
LEAST_ALONG = 1 << 16
"""Paths of a run from which on they take the nominal way surface by surface: so many win the time that its kernel takes
to be recorded, as measured. Fewer go through the loop alone; the paths are the same."""
MOST_FAMILIES = 200
"""Families whose ways are looked up, the strongest first."""

Progress = Callable[[int, int], None]
"""Called with the number of paths done and the number of all."""


class PathTracer:
    """A scene made ready for tracing.

    Parameters
    ----------
    backend
        Where to trace.
    scenery
        The surfaces.
    nominal
        Detector -> codes of the events of its nominal family.
    sampling
        How paths are drawn.
    ways
        Paths take clear ways; without, every flight is a search. The paths are the same.

    Raises
    ------
    ValueError
        a nominal family of a detector that the scenery does not have.
    """

    def __init__(
        self,
        backend: Backend,
        scenery: Scenery,
        nominal: Mapping[str, tuple[int, ...]] | None = None,
        sampling: Sampling = BALANCED,
        ways: bool = True,
    ) -> None:
        self.backend = backend
        self.scenery = scenery
        self.nominal = dict(nominal or {})
        known = [d.name for d in scenery.detectors]
        if unknown := sorted(set(self.nominal) - set(known)):
            there = ", ".join(known)
            raise ValueError(f"families of unknown detectors: {', '.join(unknown)}; detectors of the scene: {there}")
        self.sampling = sampling
        mi = load_mitsuba(backend)
        signatures = {name: signature(codes) for name, codes in self.nominal.items()}
        self._clear = ClearWays(scenery, self.nominal if ways else {})
        tables = upload(backend, scenery, signatures, self._clear.ways)
        self.prepared = PreparedScene(backend, mi, build_scene(mi, scenery), tables)
        self._signatures = [signatures.get(name, 0) for name in known]

    def features(self, keep_nominal: bool = False, log: bool = False) -> Features:
        """What the kernel must be able to do for this scene."""
        surfaces = self.scenery.surfaces
        finishes = [f for s in surfaces for f in (s.front, s.back, s.outside)]
        return Features(
            form=SurfaceForm.of(surfaces),
            glass=any(s.solid is not None for s in surfaces),
            ways=bool(self._clear.ways),
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
            Where they start.
        paths : int | None
            How many; all rays of a ``RaySource``.
        seed : int
            Of the random numbers; the same seed gives the same paths, whatever the chunk.
        keep : bool
            Keep the single detections (memory grows with the number of paths).
        chunk : int
            Paths of one launch; bounds the memory.
        progress : Progress | None
            Told after each launch.
        toward : str | None
            Detector whose nominal family the source's light mostly belongs to, which saves time; by default the first
            one.
        """
        total = self._total(source, paths)
        features = self.features(keep)
        collector = Collector(self.scenery, self._signatures, keep)
        prepared, way = self._on_its_way(source, toward)
        steps = self.nominal_steps(source, toward, total)
        room = max(LEAST_ROOM, min(chunk, total) // (1 if keep else 2))
        learning = round(total * self.sampling.first) if steps else 0
        thinning: Thinning | None = None
        seen: list[tuple[Followed, np.ndarray, np.ndarray]] = []
        for first, count in pieces(total, chunk, learning):
            while True:
                sinks = self._sinks(room)
                numbers = np.arange(first, first + count)
                light = replace(start(self.backend, source, numbers, total, seed), way=way)
                along = Along(steps, numbers, thinning) if steps else None
                done = launch(prepared, self.sampling, features, light, 1.0 / total, sinks, along)
                wanted = int(sinks.counter.numpy()[0])
                if wanted <= sinks.room:
                    break
                room = 2 * wanted  # the launch is the same when it is done again
            brought = collector.add(sinks, float(sinks.left.numpy()[2]), count)
            if done is not None and first < learning:
                seen.append((done, *brought))
                if first + count == learning:
                    thinning = learn(seen, seed)
            if progress is not None:
                progress(first + count, total)
        return collector.result(self._ways(source, collector, total, seed, toward, thinning))

    def nominal_steps(self, source: Source, toward: str | None, paths: int) -> tuple[Step, ...]:
        """Surfaces that nominal light of a source meets and that the paths of a run take in this order.

        Parameters
        ----------
        source : Source
            Where they start.
        toward : str | None
            As of ``run``.
        paths : int
            Of the run.
        """
        line = self._clear.line(toward) if paths >= LEAST_ALONG else []
        if not line or not isinstance(source, DiskSource):
            return ()
        way = self._clear.from_source(source.patch, toward)
        numbers = [0 if way is None else 1, *(number + 2 if number >= 0 else 0 for number, _ in line[1:])]
        known = list(zip(numbers, (patch for _, patch in line), strict=True))
        codes = self.nominal[toward or next(iter(self.nominal))]
        # the last step belongs to the loop, which ends paths there
        return steps_of(self.scenery, known, codes, source.centre)[: self.sampling.steps - 1]

    def _on_its_way(self, source: Source, toward: str | None) -> tuple[PreparedScene, Any]:
        """The scene with the way that a source's light takes first, and its number for all paths, 0 for none."""
        import drjit as dr

        way = self._clear.from_source(source.patch, toward) if isinstance(source, DiskSource) else None
        tables = replace(self.prepared.tables, ways=self.backend.opaque(way_table(self._clear.ways, way)))
        return replace(self.prepared, tables=tables), dr.opaque(self.backend.UInt, 0 if way is None else 1)

    def _total(self, source: Source, paths: int | None) -> int:
        if isinstance(source, DiskSource):
            if paths is None or paths < 1:
                raise ValueError(f"say how many paths to trace, at least 1; found {paths}")
            return paths
        if paths not in (None, len(source.position)):
            raise ValueError("a list of rays is traced as a whole")
        return len(source.position)

    def _sinks(self, room: int, log: int = 0) -> Sinks:
        detectors = self.scenery.detectors
        pixels = sum(d.columns * d.rows for d in detectors)
        return make_sinks(
            self.backend, ROWS_PER_SURFACE * len(self.scenery.surfaces), len(detectors), pixels, room, log
        )

    def _ways(
        self, source: Source, collector: Collector, total: int, seed: int, toward: str | None, thinning: Thinning | None
    ) -> dict[Key, tuple[Touch, ...]]:
        """Events of the families: of the nominal ones as given, of the others by tracing one path of each again."""
        names = [d.name for d in self.scenery.detectors]
        ways = {
            key: touches(self.scenery, self.nominal[names[key.detector]])
            for key in collector.sums
            if key.kind == NOMINAL
        }
        keys = collector.strongest(MOST_FAMILIES)
        if not keys:
            return ways
        examples = np.array([collector.examples[k] for k in keys], np.uint32)
        for key, codes in zip(keys, self.events(source, examples, total, seed, toward, thinning), strict=True):
            # the path may have gone on from the detector: the family is what came before
            for n in range(len(codes) + 1):
                if signature(codes[:n]) == key.signature:
                    ways[key] = touches(self.scenery, codes[:n])
                    break
        return ways

    def events(
        self,
        source: Source,
        numbers: np.ndarray,
        total: int,
        seed: int,
        toward: str | None = None,
        thinning: Thinning | None = None,
    ) -> list[tuple[int, ...]]:
        """Codes of all events of the paths of the given numbers of a run; the other arguments are the run's."""
        import drjit as dr

        count, most = len(numbers), self.sampling.steps
        prepared, way = self._on_its_way(source, toward)
        steps = self.nominal_steps(source, toward, total)
        # each path has its own part of the log, whatever its number in the run
        own = dr.arange(self.backend.UInt, count)
        light = replace(start(self.backend, source, numbers, total, seed), path=own, way=way)
        sinks = self._sinks(LEAST_ROOM, count * most)
        along = Along(steps, numbers, thinning) if steps else None
        done = launch(prepared, self.sampling, self.features(log=True), light, 1.0 / total, sinks, along)
        # steps that passed over something are left out
        logged = [tuple(int(c) for c in row if c) for row in sinks.log.numpy().reshape(count, -1)]
        if done is None:
            return logged
        codes = tuple(step.code for step in steps)
        return [codes[:passed] + after for passed, after in zip(done.passed, logged, strict=True)]
