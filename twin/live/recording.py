"""What was done at the knobs, as files that `python -m twin.render` repeats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from scenes.specs.course import DEFAULT_PIVOT, FEWEST, MOST, moment
from scenes.specs.job import JobSpec
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import YamlFile, dump_yaml
from twin.framework.provenance import Provenance, versions
from twin.live.knobs import AXES, Knob, perturbation
from twin.live.live_bench import LiveBench
from twin.live.messages import AskedState, BlindState

HEAD = "# Recorded with python -m twin.live; repeat it: python -m twin.render THIS_FILE\n"


def _head() -> str:
    """What a recording says of where it was made, as a comment."""
    made, by = Provenance.here(), versions()
    kernels = ", ".join(dict.fromkeys(f"{one.name} {one.version} for {one.kernels}" for one in made.blas))
    return (
        f"{HEAD}# made by space-camera-twin {by['space-camera-twin']}, source {made.source}, Python {by['python']}, "
        f"numpy {by['numpy']}, Dr.Jit {by['drjit']}, on {made.processor}; {kernels}\n"
    )


BLIND = (
    "# Saved while motions were hidden: this job holds the guess of the knobs alone, so that twin.render gives the\n"
    "# spots of the guess and not those that were shown.\n"
)


def job_text(bench: LiveBench, asked: AskedState) -> str:
    """A job file of one state, which needs no other file. Of a course it shows the time that was looked at.

    Args:
        bench: the instrument.
        asked: the state.

    Raises:
        InputError: a value that a job's file could not have.
    """
    resolved = bench.perturbed(asked).resolved.with_render(asked.frames, bench.seed_of(asked.seed))
    plain = resolved.plain()
    if asked.time is not None and resolved.job.course is not None:
        plain["job"]["course"]["detail"] = moment(resolved.job.course.times[asked.time])
    hidden = BLIND if isinstance(asked, BlindState) else ""
    return _head() + hidden + dump_yaml(plain)


def course_text(bench: LiveBench, kept: Sequence[tuple[float, AskedState]]) -> str:
    """A job file with a course: every recorded state at its time, to the millisecond.

    Args:
        bench: the instrument.
        kept: (seconds since the recording began, state), in the order in which they were shown.

    Raises:
        ValueError: too few states, or something changed that a course cannot change.
    """
    steps = _thinned(kept)
    if len(steps) < FEWEST:
        raise ValueError(f"a course has at least {FEWEST} different times; move a knob while recording")
    first = steps[0][1]
    if any(step.time is not None for _, step in steps):
        raise ValueError("a course of the job was shown; it is in the job's own file")
    if any(step.pivots != first.pivots for _, step in steps):
        raise ValueError("a course turns each body about one pivot at all times; record again without changing pivots")
    knobs = bench.knobs
    fixed, moving = _split([dict(step.knobs) for _, step in steps], knobs)
    resolved = bench.twin.resolved.with_render(first.frames, bench.seed_of(first.seed))
    plain = resolved.plain()
    job = plain["job"]
    job["perturb"] = perturbation(fixed, first.pivots, knobs, job.get("perturb", {}))
    job["course"] = {"times": [f"{time!r} s" for time, _ in steps], **_courses(moving, first.pivots, knobs, len(steps))}
    validate(JobSpec, YamlFile("", job, {}))
    return _head() + dump_yaml(plain)


def _thinned(kept: Sequence[tuple[float, AskedState]]) -> list[tuple[float, AskedState]]:
    """Times that ascend in milliseconds, no more than a course may have, the first and the last among them."""
    out: list[tuple[float, AskedState]] = []
    for time, state in kept:
        rounded = round(time, 3)
        if out and rounded <= out[-1][0]:
            out[-1] = (out[-1][0], state)
        else:
            out.append((rounded, state))
    if len(out) <= MOST:
        return out
    chosen = sorted({round(k * (len(out) - 1) / (MOST - 1)) for k in range(MOST)})
    return [out[k] for k in chosen]


def _split(
    states: Sequence[Mapping[str, float]], knobs: Mapping[str, Knob]
) -> tuple[dict[str, float], dict[str, list[float]]]:
    """Knobs that stand still, and those that move with their value at each time.

    Raises:
        ValueError: a figure moves.
    """
    names = dict.fromkeys(name for state in states for name in state)
    moving = {}
    fixed = {}
    for name in names:
        values = [state.get(name, 0.0) for state in states]
        if all(a == b for a, b in pairwise(values)):
            fixed[name] = values[0]
        elif knobs[name].kind == "figure":
            raise ValueError(f"{name}: a course holds motions and temperatures, no figure; save the job instead")
        else:
            moving[name] = values
    if not moving:
        raise ValueError("nothing moved while recording; save the job instead")
    # what a course adds to a body's motion stands in one place with it
    bodies = {(knobs[name].node, knobs[name].kind) for name in moving}
    for name in list(fixed):
        if (knobs[name].node, knobs[name].kind) in bodies:
            moving[name] = [fixed.pop(name)] * len(states)
    return fixed, moving


def _courses(
    moving: Mapping[str, Sequence[float]], pivots: Mapping[str, str], knobs: Mapping[str, Knob], count: int
) -> dict[str, Any]:
    """``temperature`` and ``motion`` of a course."""
    out: dict[str, dict[str, dict[str, Any]]] = {}
    for name in moving:
        knob = knobs[name]
        heat = knob.kind in ("temperature", "gradient")
        key = {"temperature": "change"}.get(knob.kind, knob.kind)
        body = out.setdefault("temperature" if heat else "motion", {}).setdefault(knob.node, {})
        if key in body:
            continue
        axes = AXES if knob.kind in ("rotate", "shift", "gradient") else ("",)
        columns = [moving.get(f"{knob.node} {knob.kind} {axis}".strip(), [0.0] * count) for axis in axes]
        rows = [[f"{value!r} {knob.unit}" for value in row] for row in zip(*columns, strict=True)]
        body[key] = rows if len(axes) > 1 else [row[0] for row in rows]
        if not heat and pivots.get(knob.node, DEFAULT_PIVOT) != DEFAULT_PIVOT:
            body["pivot"] = pivots[knob.node]
    return out
