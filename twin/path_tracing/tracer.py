"""Path tracer: prepares a scene and traces paths in launches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optics.numerics.backend import Backend
from scenes.models.scenery import Scenery
from twin.path_tracing.clear_ways import ClearSegments
from twin.path_tracing.importance_sampling import LearnedRoulette, PathHistory, learn_survival
from twin.path_tracing.kernel import Features, Launch, Limits, PreparedScene, follow
from twin.path_tracing.path_families import SurfaceEvent, signature, surface_events
from twin.path_tracing.path_result import NOMINAL, Accumulators, Collector, Key, PathResult, make_accumulators
from twin.path_tracing.sequential import Departures, Step, continue_paths, make_steps, trace_nominal
from twin.path_tracing.source import DiskSource, Source, pieces, start
from twin.path_tracing.tables import ROWS_PER_SURFACE, SurfaceForm, segment_table, upload

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
        stretch = trace_nominal(scene, features, limits, start, accumulators, along.steps)
        dr.eval(accumulators.arrays, stretch.arrays)
        left = Departures.of(along.steps, stretch, along.numbers, along.learned, features.log)
        steps = np.zeros(len(along.numbers))
        if len(left.chosen):
            taken = follow(scene, features, limits, continue_paths(backend, along.steps, stretch, left), accumulators)
            dr.eval(accumulators.arrays, taken)
            steps[left.chosen] = taken.numpy() - left.passed[left.chosen]
    return PathHistory(left.passed, left.turned, steps)


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
