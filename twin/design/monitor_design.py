"""A monitor's layout found: the run, its numbers, the layouts on the front of sigma against pupil and mass."""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import degrees, sqrt
from pathlib import Path
from typing import Any

from analysis.units import ARCSEC
from optics.numerics.backend import Backend
from scenes.models.monitor_layout import (
    Beam,
    MonitorDesignSetup,
    layout_spec,
)
from scenes.specs.detector import DetectorSpec
from scenes.specs.instrument import InstrumentSpec, channel_of, prism_of
from scenes.specs.job import JobSpec
from scenes.specs.resolved import ResolvedJob
from twin.design.layout_bench import LayoutBench, LayoutFacts
from twin.design.layout_search import Found, Search, merit, optima
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.path_tracing.stray_light import GHOSTS, Ghost, ghosts, stray_light
from twin.run.procedure import Advance, BenchError, silent

MOST_POINTS = 6
"""Layouts that are drawn and written, at most."""
UNITS = {"angle": ("arcsec", ARCSEC), "d_f": ("um", 1e-6), "height": ("m", 1.0)}
"""Goal -> unit for people, and that unit in SI."""
_ASIDE = "other tilts of the prisms in the instrument that it starts from, or other fields"
GOAL_NAMES = {"angle": "intersection angle", "d_f": "principal distance", "height": "height on the ground"}
REMARK = """Made by python -m twin.design monitor from {start}. What its spots leave, one standard deviation:
{sigmas}."""


@dataclass(frozen=True, eq=False)
class Point:
    """A layout that is handed over.

    Attributes:
        name: of its instrument, and of its file.
        facts: of it.
        text: the instrument's file.
    """

    name: str
    facts: LayoutFacts
    text: str


@dataclass(frozen=True, eq=False)
class MonitorDesignRun:
    """A search and what came of it.

    Attributes:
        setup: the design.
        bench: on which layouts were tried.
        found: by the search.
        points: on the front of merit, pupil share and mass, the best first; empty where none is as good as the start.
    """

    setup: MonitorDesignSetup
    bench: LayoutBench
    found: Found
    points: tuple[Point, ...]

    def worst(self, facts: LayoutFacts, goal: str) -> float:
        """What a layout leaves of a goal's quantity, the worst over cameras and disturbances, SI."""
        return max(own[key] for own in facts.sigmas.values() for key in self.bench.goals_of(goal))

    def merit(self, facts: LayoutFacts) -> float:
        """Largest ratio of what is left to what is wanted."""
        return merit(facts.sigmas, self.bench)


def run_monitor_design(
    setup: MonitorDesignSetup,
    backend: Backend,
    seed: int = 0,
    advance: Advance = silent,
    workers: int = 0,
    journal: Path | None = None,
) -> MonitorDesignRun:
    """Search for layouts.

    Args:
        setup: the design.
        backend: where to trace.
        seed: of all that is drawn.
        advance: shows how far it is.
        workers: processes, 0 for none beside this one; the result is the same.
        journal: file that keeps what was tried, to go on with; None for none.

    Raises:
        InputError: the instrument that it starts from cannot stand, or throws ghosts on a spot that are not allowed.
        BenchError: no beam and no layout that was tried can stand.
        RunFolderError: the journal is another search's, or cannot be written.
    """
    bench = LayoutBench(setup, backend)
    _check_start(setup, backend, seed, advance)
    found = Search(bench, workers, seed, journal, advance).run()
    if not found.layouts:
        most = max(found.refused.items(), key=lambda item: item[1], default=("", 0))
        text = f"none of {found.beams} beams and {found.built} layouts that were tried can stand"
        raise BenchError(
            f"{text}; {most[1]} times since {most[0]}", ("vary",), "other ranges, wider limits, or a longer search"
        )
    clean = [facts for facts in _front(found.layouts, bench) if not _ghosts(setup, facts, backend, seed, advance)]
    if not clean:
        raise BenchError("every layout on the front throws ghosts on its area CCDs", ("limits", "ghost_paths"), _ASIDE)
    points = []
    for k, facts in enumerate(clean):
        name = setup.test.name if k == 0 else f"{setup.test.name}_{chr(ord('a') + k)}"
        spec = layout_spec(setup, facts.beams).model_copy(update={"name": name})
        lines = [f"{GOAL_NAMES[goal]} {text}" for goal, text in _texts(facts, bench).items()]
        remark = REMARK.format(start=setup.instrument.name, sigmas="; ".join(lines))
        points.append(Point(name, facts, spec.file_text(remark)))
    return MonitorDesignRun(setup, bench, found, tuple(points))


def _check_start(setup: MonitorDesignSetup, backend: Backend, seed: int, advance: Advance) -> None:
    """Refuse a start with ghosts, where they are to be traced: every layout has its prisms' tilts.

    Raises:
        InputError: at the tilt of the prism that throws the strongest one.
    """
    spec = setup.instrument
    for ghost in _traced_ghosts(setup, spec, setup.detector, backend, seed, advance):
        prism, owner = prism_of(ghost.body or ""), channel_of(f"{ghost.body}/")
        key = ("monitor",) if prism is None or owner is None else spec.key_of(*owner, ("monitor", prism, "tilt"))
        problem = f"{ghost.body or ghost.source} throws a ghost on {ghost.channel.ccd_body}: {ghost.text}"
        raise spec.error(problem, key, allowed=f"ghosts of at most {GHOSTS:g} of a spot's light")


def _ghosts(
    setup: MonitorDesignSetup, facts: LayoutFacts, backend: Backend, seed: int, advance: Advance
) -> tuple[Ghost, ...]:
    """A layout's ghosts; none where they are not to be traced."""
    detector = setup.detectors.get(facts.beams[0].area_ccd, setup.detector)
    return _traced_ghosts(setup, layout_spec(setup, facts.beams), detector, backend, seed, advance)


def _traced_ghosts(
    setup: MonitorDesignSetup,
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
        each = {name: max(own[key] for key in bench.goals_of(goal)) for name, own in facts.sigmas.items()}
        out[goal] = ", ".join(f"{value / size:.3g} {unit} ({name})" for name, value in each.items())
    return out


def _front(layouts: tuple[LayoutFacts, ...], bench: LayoutBench) -> list[LayoutFacts]:
    """Layouts than which none is better in merit, pupil share and mass at once; the best and some evenly chosen."""

    def cost(facts: LayoutFacts) -> tuple[float, float, float]:
        return merit(facts.sigmas, bench), facts.pupil_share, facts.mass

    front = []
    for one in layouts:
        mine = cost(one)
        others = [cost(other) for other in layouts if other is not one]
        if not any(all(b <= a for a, b in zip(mine, other, strict=True)) and other != mine for other in others):
            front.append(one)
    if len(front) <= MOST_POINTS:
        return front
    step = (len(front) - 1) / (MOST_POINTS - 1)
    return [front[round(k * step)] for k in range(MOST_POINTS)]


def verdict(run: MonitorDesignRun) -> str:
    """Whether the best layout reaches what is wanted, at what cost, and what limits it; one sentence."""
    best, start, test = run.points[0].facts, run.found.start, run.setup.test
    parts = []
    for goal, wanted in test.goal.wanted.items():
        unit, size = UNITS[goal]
        now, before = run.worst(best, goal), run.worst(start, goal)
        met = "" if now <= wanted else f", {wanted / size:.3g} wanted"
        less = f"{before / now:.3g} times less than {run.setup.instrument.name}"
        parts.append(f"{GOAL_NAMES[goal]} {now / size:.3g} {unit} ({less}{met})")
    head = "reaches its goal" if run.merit(best) <= 1.0 else "does not reach its goal"
    count = f"{len(best.beams)} beam{'s' if len(best.beams) > 1 else ''} at each end of a line"
    cost = f"{100.0 * best.pupil_share:.3g} % of the pupil ({100.0 * start.pupil_share:.3g} %)"
    mass = f"{best.mass:.3g} kg of prisms ({start.mass:.3g} kg)"
    cause, share = limiting(run, best)
    return (
        f"{test.name} {head} with {count}: {', '.join(parts)}, for {cost} and {mass}, and what is left is for "
        f"{100.0 * share:.0f} % {cause.replace('_', ' ')}: see the causes and the front."
    )


def limiting(run: MonitorDesignRun, facts: LayoutFacts) -> tuple[str, float]:
    """The cause that is most of the variance of the goal that is farthest from being reached, and its share."""
    wanted = run.setup.test.goal.wanted
    cases = [
        (own[key] / wanted[goal], name, key)
        for name, own in facts.sigmas.items()
        for goal in wanted
        for key in run.bench.goals_of(goal)
    ]
    _, name, key = max(cases)
    shares = facts.shares[name][key]
    cause = max(shares, key=lambda one: shares[one])
    return cause, shares[cause] / sum(shares.values())


def beam_numbers(beam: Beam) -> dict[str, Any]:
    """A beam as plain data with units in the keys."""
    out: dict[str, Any] = {}
    for item in fields(beam):
        value = getattr(beam, item.name)
        if item.name in ("prisms", "area_ccd"):
            out[item.name] = value
        elif item.name == "field":
            out["field_deg"] = degrees(value)
        elif item.name == "photons":
            out["photons"] = value
        else:
            out[f"{item.name}_mm"] = 1e3 * value
    return out


def layout_numbers(run: MonitorDesignRun, facts: LayoutFacts) -> dict[str, Any]:
    """A layout as plain data with units in the keys."""

    def told(values: Any) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for name, own in values.items():
            out[name] = {}
            for key, value in own.items():
                unit, size = _unit(key)
                out[name][f"{key.replace('/', '_')}_{unit}"] = value / size
        return out

    def split(values: Any) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for name, own in values.items():
            out[name] = {}
            for key, causes in own.items():
                unit, size = _unit(key)
                rms = {cause: sqrt(max(share, 0.0)) / size for cause, share in causes.items()}
                out[name][f"{key.replace('/', '_')}_{unit}"] = rms
        return out

    return {
        "beams": [beam_numbers(beam) for beam in facts.beams],
        "merit": run.merit(facts),
        "sigma": told(facts.sigmas),
        "sigma_unmeasured": told(facts.before),
        "by_cause": split(facts.shares),
        "by_cause_unmeasured": split(facts.shares_before),
        "pupil_share": facts.pupil_share,
        "mass_kg": facts.mass,
        "glass_path_mm": 1e3 * facts.glass_path,
        "spot_sigma_px": facts.spot_sigma,
    }


def _unit(key: str) -> tuple[str, float]:
    name = key.rpartition("/")[2]
    return UNITS.get(name, UNITS["angle"])


def monitor_design_numbers(run: MonitorDesignRun) -> dict[str, Any]:
    """Contents of layouts.json without its frames."""
    found, test = run.found, run.setup.test
    goals = {f"{goal}_{UNITS[goal][0]}": value / UNITS[goal][1] for goal, value in test.goal.wanted.items()}
    return {
        "instrument": run.setup.instrument.name,
        "goal": goals,
        "start": layout_numbers(run, found.start),
        "layouts": {point.name: layout_numbers(run, point.facts) for point in run.points},
        "search": {
            "beams_tried": found.beams,
            "beams_standing": found.standing,
            "layouts_compared": found.compared,
            "layouts_built": found.built,
            "layouts_standing": len(found.layouts),
            "refused": dict(found.refused),
        },
        "ends": {
            end.name: {
                "merit_by_round": list(end.progress),
                "merit_by_refinement": list(end.refined),
                "best": layout_numbers(run, end.layouts[0]) if end.layouts else None,
            }
            for end in found.ends
        },
        "optima": [[end.name for end in group] for group in optima(found, run.bench)],
    }


__all__ = ["MonitorDesignRun", "monitor_design_numbers", "run_monitor_design", "verdict"]
