"""Search for a monitor's layout: the run, its results, and the best trade-offs of accuracy, pupil and mass.

A layout's merit is its largest ratio of a standard deviation to its goal.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import sqrt
from pathlib import Path
from typing import Any

from analysis.arrays import ARCSEC
from optics.numerics.backend import Backend
from scenes.models import monitor_layout
from scenes.specs.detector import DetectorSpec
from scenes.specs.instrument import InstrumentSpec, channel_of, prism_of
from scenes.specs.job import JobSpec
from scenes.specs.resolved import ResolvedJob
from twin.design.layout_bench import LayoutBench, LayoutFacts
from twin.design.layout_search import SearchResult, merit, optima, search
from twin.framework.procedure import Advance, BenchError, silent
from twin.framework.record import Quantity, Record
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.path_tracing.stray_light import GHOSTS, Ghost, ghosts, stray_light

MOST_POINTS = 6
"""Largest number of Pareto-optimal layouts that are drawn and written as instruments."""
UNITS = {"angle": ("arcsec", ARCSEC), "d_f": ("um", 1e-6), "height": ("m", 1.0)}
"""Goal -> unit in which it is reported, and the size of that unit in SI."""
_ASIDE = "other tilts of the prisms in the instrument that it starts from, or other fields"
"""Advice in the error that the starting instrument has ghost images on a spot."""
GOAL_NAMES = {"angle": "intersection angle", "d_f": "principal distance", "height": "height on the ground"}
"""Goal -> its name in reports."""
REMARK = """Made by python -m twin.design monitor from {start}. Posterior standard deviations:
{sigmas}."""
"""Comment at the top of the file of an instrument that the search has found."""


@dataclass(frozen=True, eq=False)
class Point:
    """Layout on the Pareto front that is written as an instrument.

    Attributes
    ----------
    name : str
        Name of the instrument and of its file.
    facts : LayoutFacts
        Properties of the layout.
    text : str
        Text of the instrument's file.
    """

    name: str
    facts: LayoutFacts
    text: str


@dataclass(frozen=True, eq=False)
class MonitorDesignRun:
    """Search for a monitor's layout and its results.

    Attributes
    ----------
    setup : MonitorDesignSetup
        Specification of the search for a layout.
    bench : LayoutBench
        Evaluator of the layouts.
    results : Found
        Results of the search.
    points : tuple of Point
        Layouts on the Pareto front of merit, obstructed fraction of the pupil and mass, the best merit first.
    """

    setup: monitor_layout.MonitorDesignSetup
    bench: LayoutBench
    results: SearchResult
    points: tuple[Point, ...]

    def worst(self, facts: LayoutFacts, goal: str) -> float:
        """Return the largest sigma of a goal's quantity over cameras and disturbances, SI units."""
        return max(sigmas[key] for sigmas in facts.sigmas.values() for key in self.bench.goals_of(goal))

    def merit(self, facts: LayoutFacts) -> float:
        """Return a layout's merit: the largest ratio of a standard deviation to its goal (1 reaches all goals)."""
        return merit(facts.sigmas, self.bench)


def run_monitor_design(
    setup: monitor_layout.MonitorDesignSetup,
    backend: Backend,
    seed: int = 0,
    advance: Advance = silent,
    workers: int = 0,
    journal: Path | None = None,
) -> MonitorDesignRun:
    """Search for layouts of a monitor and return the best ones.

    Parameters
    ----------
    setup : MonitorDesignSetup
        Specification of the search for a layout.
    backend : Backend
        Array backend of the ray trace.
    seed : int
        Seed of all random numbers.
    advance : Advance
        Callback that reports progress.
    workers : int
        Number of further processes, 0 for this one alone; the result is the same.
    journal : Path, optional
        File that stores finished evaluations, from which a search can be resumed; None for none.

    Raises
    ------
    InputError
        The instrument from which it starts is not feasible, or throws ghosts on a spot that are not allowed.
    BenchError
        No beam or no layout is feasible.
    RunFolderError
        The journal belongs to a different search, or cannot be written.
    """
    bench = LayoutBench(setup, backend)
    _check_start(setup, backend, seed, advance)
    results = search(bench, workers, seed, journal, advance)
    if not results.layouts:
        most = max(results.refused.items(), key=lambda item: item[1], default=("", 0))
        text = f"none of {results.total('tried')} beams and {results.total('built')} layouts is feasible"
        raise BenchError(
            f"{text}; most frequent reason ({most[1]} times): {most[0]}",
            ("vary",),
            "other ranges, wider limits, or a longer search",
        )
    clean = [facts for facts in _front(results.layouts, bench) if not _ghosts(setup, facts, backend, seed, advance)]
    if not clean:
        raise BenchError("every layout on the front throws ghosts on its area CCDs", ("limits", "ghost_paths"), _ASIDE)
    points = []
    for k, facts in enumerate(clean):
        name = setup.test.name if k == 0 else f"{setup.test.name}_{chr(ord('a') + k)}"
        spec = monitor_layout.layout_spec(setup, facts.beams).model_copy(update={"name": name})
        lines = [f"{GOAL_NAMES[goal]} {text}" for goal, text in _texts(facts, bench).items()]
        remark = REMARK.format(start=setup.instrument.name, sigmas="; ".join(lines))
        points.append(Point(name, facts, spec.file_text(remark)))
    return MonitorDesignRun(setup, bench, results, tuple(points))


def _check_start(setup: monitor_layout.MonitorDesignSetup, backend: Backend, seed: int, advance: Advance) -> None:
    """Raise InputError if the file requests tracing ghosts and the starting instrument has one on a spot.

    All layouts have the prism tilts of the start.

    Raises
    ------
    InputError
        There is a ghost; the error is placed at the tilt of the prism that throws the strongest one.
    """
    spec = setup.instrument
    for ghost in _traced_ghosts(setup, spec, setup.detector, backend, seed, advance):
        prism, owner = prism_of(ghost.body or ""), channel_of(f"{ghost.body}/")
        key = ("monitor",) if prism is None or owner is None else spec.key_of(*owner, ("monitor", prism, "tilt"))
        problem = f"{ghost.body or ghost.source} throws a ghost on {ghost.channel.ccd_body}: {ghost.text}"
        raise spec.error(problem, key, allowed=f"ghosts of at most {GHOSTS:g} of a spot's light")


def _ghosts(
    setup: monitor_layout.MonitorDesignSetup, facts: LayoutFacts, backend: Backend, seed: int, advance: Advance
) -> tuple[Ghost, ...]:
    """Return the ghost images on a layout's spots; none unless the file requests tracing them."""
    detector = setup.detectors.get(facts.beams[0].area_ccd, setup.detector)
    return _traced_ghosts(setup, monitor_layout.layout_spec(setup, facts.beams), detector, backend, seed, advance)


def _traced_ghosts(
    setup: monitor_layout.MonitorDesignSetup,
    spec: InstrumentSpec,
    detector: DetectorSpec,
    backend: Backend,
    seed: int,
    advance: Advance,
) -> tuple[Ghost, ...]:
    paths = setup.test.limits.ghost_paths
    if paths is None:
        return ()
    advance("ghosts", 0, 1)
    job = ResolvedJob.model_construct(
        job=JobSpec(instrument=setup.test.instrument), instrument=spec, cameras=setup.cameras, detector=detector
    )
    experiment = MonitorExperiment(job, backend)
    return ghosts(experiment, stray_light(experiment, {}, paths, seed))


def _texts(facts: LayoutFacts, bench: LayoutBench) -> dict[str, str]:
    out = {}
    for goal in bench.setup.test.goal.wanted:
        unit, size = UNITS[goal]
        values = {name: max(sigmas[key] for key in bench.goals_of(goal)) for name, sigmas in facts.sigmas.items()}
        out[goal] = ", ".join(f"{value / size:.3g} {unit} ({name})" for name, value in values.items())
    return out


def _front(layouts: tuple[LayoutFacts, ...], bench: LayoutBench) -> list[LayoutFacts]:
    """Return the Pareto-optimal layouts in merit, obstructed fraction of the pupil and mass, the best merit first.

    There are at most ``MOST_POINTS``.
    """

    def cost(facts: LayoutFacts) -> tuple[float, float, float]:
        return merit(facts.sigmas, bench), facts.pupil_share, facts.mass

    front = []
    for layout in layouts:
        costs = cost(layout)
        others = [cost(other) for other in layouts if other is not layout]
        if not any(all(b <= a for a, b in zip(costs, other, strict=True)) and other != costs for other in others):
            front.append(layout)
    if len(front) <= MOST_POINTS:
        return front
    step = (len(front) - 1) / (MOST_POINTS - 1)
    return [front[round(k * step)] for k in range(MOST_POINTS)]


def verdict(run: MonitorDesignRun) -> tuple[str, ...]:
    """Return the sentences of the verdict: goal reached or not, cost of the best layout, and what limits it."""
    best, start, test = run.points[0].facts, run.results.start, run.setup.test
    parts = []
    for goal, wanted in test.goal.wanted.items():
        unit, size = UNITS[goal]
        now, before = run.worst(best, goal), run.worst(start, goal)
        met = "" if now <= wanted else f", goal {wanted / size:.3g}"
        less = f"{before / now:.3g} times less than {run.setup.instrument.name}"
        parts.append(f"{GOAL_NAMES[goal]} {now / size:.3g} {unit} ({less}{met})")
    head = "reaches its goal" if run.merit(best) <= 1.0 else "does not reach its goal"
    count = f"{len(best.beams)} beam{'s' if len(best.beams) > 1 else ''} at each end of a line"
    cost = f"{100.0 * best.pupil_share:.3g} % of the pupil ({100.0 * start.pupil_share:.3g} %)"
    mass = f"{best.mass:.3g} kg of prisms ({start.mass:.3g} kg)"
    cause, share = _limiting(run, best)
    return (
        f"the layout {test.name} {head} with {count}: {', '.join(parts)}",
        f"it costs {cost} and {mass}",
        f"{cause.replace('_', ' ')} causes {100.0 * share:.0f} % of the remaining variance: see the causes and "
        "the front",
    )


def _limiting(run: MonitorDesignRun, facts: LayoutFacts) -> tuple[str, float]:
    """Return the largest cause of variance for the goal that is farthest from being reached, and its fraction.

    The fraction is that of the variance of the goal's quantity.
    """
    wanted = run.setup.test.goal.wanted
    cases = [
        (sigmas[key] / wanted[goal], name, key)
        for name, sigmas in facts.sigmas.items()
        for goal in wanted
        for key in run.bench.goals_of(goal)
    ]
    _, name, key = max(cases)
    shares = facts.shares[name][key]
    cause = max(shares, key=lambda candidate: shares[candidate])
    return cause, shares[cause] / sum(shares.values())


def _unit(key: str) -> tuple[str, float]:
    return UNITS.get(key.rpartition("/")[2], UNITS["angle"])


def _by_quantity(values: Mapping[str, Mapping[str, Any]], of: Callable[[Any, float], Any]) -> dict[str, Any]:
    """Return nested values with each quantity's unit as a suffix of its key.

    ``of`` converts a value, given the size of the unit in SI.
    """
    return {
        name: {
            f"{key.replace('/', '_')}_{_unit(key)[0]}": of(value, _unit(key)[1]) for key, value in quantities.items()
        }
        for name, quantities in values.items()
    }


def _sigmas(values: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    return _by_quantity(values, lambda value, size: value / size)


def _causes(values: Mapping[str, Mapping[str, Mapping[str, float]]]) -> dict[str, Any]:
    def rms(causes: Mapping[str, float], size: float) -> dict[str, float]:
        return {cause: sqrt(max(share, 0.0)) / size for cause, share in causes.items()}

    return _by_quantity(values, rms)


BEAM: Record[monitor_layout.Beam] = Record(
    "One beam of a layout, at both ends of both cameras' lines.",
    Quantity("pupil_x_mm", lambda beam: beam.pupil_x, "middle in the entrance pupil, toward the central prism"),
    Quantity("pupil_y_mm", lambda beam: beam.pupil_y, "and toward the beam's own end of the line"),
    Quantity("width_mm", lambda beam: beam.width, "diameter of its return face"),
    Quantity("field_deg", lambda beam: beam.field, "angle of its area CCD from the visual axis"),
    Quantity("prism_180_distance_mm", lambda beam: beam.prism_180_distance, "from the camera's origin"),
    Quantity("prism_0_distance_mm", lambda beam: beam.prism_0_distance, "from the return face of the 180 deg prism"),
    Quantity("shift_mm", lambda beam: beam.shift, "of its rhomboid"),
    Quantity("spread_x_mm", lambda beam: beam.spread_x, "of its facet from the apex, along the base's X"),
    Quantity("spread_y_mm", lambda beam: beam.spread_y, "and along its Y"),
    Quantity("prisms", lambda beam: beam.prisms, "their name in the design"),
    Quantity("photons", lambda beam: beam.photons, "of its spot, per frame; None for the monitor's"),
    Quantity("area_ccd", lambda beam: beam.area_ccd, "its name in the design"),
)


@dataclass(frozen=True, eq=False)
class _Part:
    """Layout, or result of one search, together with the run that holds the goals."""

    run: MonitorDesignRun
    of: Any


LAYOUT: Record[_Part] = Record(
    "Posterior standard deviations of a layout, and its costs.",
    Quantity("beams", lambda part: part.of.beams, "beams at every end of a line", record=BEAM),
    Quantity("merit", lambda part: part.run.merit(part.of), "largest ratio of a standard deviation to its goal"),
    Quantity("sigma", lambda part: _sigmas(part.of.sigmas), "by disturbances and quantity"),
    Quantity("sigma_unmeasured", lambda part: _sigmas(part.of.before), "without any measurement"),
    Quantity("by_cause", lambda part: _causes(part.of.shares), "standard deviations by cause; their squares add up"),
    Quantity("by_cause_unmeasured", lambda part: _causes(part.of.shares_before), "without any measurement"),
    Quantity("pupil_share", lambda part: part.of.pupil_share, "share of the imaging pupil that the prisms block"),
    Quantity("mass_kg", lambda part: part.of.mass, "of the prisms"),
    Quantity("glass_path_mm", lambda part: part.of.glass_path, "longest path of a beam in glass, one way"),
    Quantity("spot_px_sigma", lambda part: part.of.spot_sigma, "largest prior standard deviation of a spot position"),
)
SEARCH: Record[SearchResult] = Record(
    "Extent of the search.",
    Quantity("beams_tried", lambda search: search.total("tried"), "beams that were evaluated alone"),
    Quantity("beams_feasible", lambda search: search.total("feasible"), "feasible ones of these"),
    Quantity("layouts_compared", lambda search: search.total("compared"), "combinations whose merit was computed"),
    Quantity("layouts_built", lambda search: search.total("built"), "those of these that were built as a whole"),
    Quantity("layouts_feasible", lambda search: len(search.layouts), "feasible ones of these"),
    Quantity("refused", lambda search: search.refused, "reasons why others are not feasible, with their numbers"),
)


def _best(end: _Part) -> _Part | None:
    return _Part(end.run, end.of.layouts[0]) if end.of.layouts else None


END: Record[_Part] = Record(
    "Result of one search.",
    Quantity("merit_by_round", lambda end: end.of.progress, "best merit after the first draw and after each round"),
    Quantity("merit_by_refinement", lambda end: end.of.refined, "merits during the refinement by gradients"),
    Quantity("best", _best, "its best layout, None if it found no feasible one", record=LAYOUT),
)


def _goals(run: MonitorDesignRun) -> dict[str, float]:
    return {f"{goal}_{UNITS[goal][0]}": value / UNITS[goal][1] for goal, value in run.setup.test.goal.wanted.items()}


LAYOUTS: Record[MonitorDesignRun] = Record(
    "layouts.json: a search for the layout of a monitor.",
    Quantity("instrument", lambda run: run.setup.instrument.name, "instrument from which the search starts"),
    Quantity("goal", _goals, "goals, standard deviations"),
    Quantity("start", lambda run: _Part(run, run.results.start), "the layout of that instrument", record=LAYOUT),
    Quantity("layouts", lambda run: {p.name: _Part(run, p.facts) for p in run.points}, "on the front", record=LAYOUT),
    Quantity("search", lambda run: run.results, "extent of the search", record=SEARCH),
    Quantity(
        "ends", lambda run: {e.name: _Part(run, e) for e in run.results.ends}, "results of all searches", record=END
    ),
    Quantity(
        "optima",
        lambda run: [[end.name for end in group] for group in optima(run.results, run.bench)],
        "searches that end with the same merit, within 2 %, the best group first",
    ),
)
