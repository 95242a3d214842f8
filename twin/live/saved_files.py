"""Files that the live page saves: a job of the shown state, a job with recorded states, and the camera as designed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from scenes.specs.course import DEFAULT_PIVOT, FEWEST, MOST, moment
from scenes.specs.job import JobSpec
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import YamlFile, dump_yaml
from twin.framework.provenance import Provenance, versions
from twin.live.camera_design import DESIGN, camera_text
from twin.live.knobs import AXES, Knob, perturbation
from twin.live.live_bench import LiveBench
from twin.live.messages import AskedState, BlindState

HEAD = "# Recorded with python -m twin.live; repeat it: python -m twin.render THIS_FILE\n"
"""Comment in the first line of a saved file."""


def _head() -> str:
    """Return the comment that states where a file was recorded."""
    made, by = Provenance.here(), versions()
    kernels = ", ".join(
        dict.fromkeys(f"{library.name} {library.version} for {library.kernels}" for library in made.blas)
    )
    return (
        f"{HEAD}# made by space-camera-twin {by['space-camera-twin']}, source {made.source}, Python {by['python']}, "
        f"numpy {by['numpy']}, Dr.Jit {by['drjit']}, on {made.processor}; {kernels}\n"
    )


GUESSED = (
    "# Saved while motions were hidden: this job holds the guess of the knobs alone, so that twin.render gives the\n"
    "# spots of the guess and not those that were shown.\n"
)
"""Comment at the top of a job file that was saved while motions were hidden, which it does not contain."""


def job_text(bench: LiveBench, asked: AskedState) -> str:
    """Return a self-contained job file of one state; for a job with a time series, that at the selected time.

    Parameters
    ----------
    bench : LiveBench
        Instrument that is evaluated.
    asked : AskedState
        State of the knobs to be saved.

    Raises
    ------
    InputError
        A job's file could not have a value.
    """
    resolved = bench.perturbed(asked).resolved.with_render(asked.frames, bench.seed_of(asked.seed))
    plain = resolved.plain()
    if asked.time is not None and resolved.job.course is not None:
        plain["job"]["course"]["detail"] = moment(resolved.job.course.times[asked.time])
    hidden = GUESSED if isinstance(asked, BlindState) else ""
    return _head() + hidden + dump_yaml(plain)


def camera_file(bench: LiveBench, asked: AskedState) -> str:
    """Return the file of the camera with the prescription of the knobs, which ``twin.camera`` reads.

    Raises
    ------
    InputError
        The camera cannot have such a prescription.
    ValueError
        The instrument is no single camera.
    """
    if bench.design is None:
        raise ValueError("only the design of a single camera without a monitor can be saved")
    made = bench.perturbed(asked).resolved
    knobs = ((bench.knobs[name], value) for name, value in asked.knobs.items())
    changes = [f"{knob.name} {value:g} {knob.unit}".strip() for knob, value in knobs if knob.kind == DESIGN]
    lines = [f"{bench.design.spec.name}, saved with python -m twin.live: {'; '.join(changes) or 'unchanged'}"]
    if made.job.perturb:
        lines.append("Motions and temperatures of bodies are not part of a camera's file.")
    return camera_text(made.cameras[bench.design.reference], bench.design.spec, "\n".join(lines))


def course_text(bench: LiveBench, kept: Sequence[tuple[float, AskedState]]) -> str:
    """Return a job file with the recorded states as a time series (``course``), timed to the millisecond.

    Parameters
    ----------
    bench : LiveBench
        Instrument that is evaluated.
    kept : Sequence[tuple[float, AskedState]]
        (seconds since the recording began, state) in the order in which they were shown.

    Raises
    ------
    ValueError
        There are too few states, or something changed that a job's time series cannot change.
    """
    steps = _limited_times(kept)
    if len(steps) < FEWEST:
        raise ValueError(f"a course has at least {FEWEST} different times; move a knob while recording")
    first = steps[0][1]
    if any(step.time is not None for _, step in steps):
        raise ValueError("a course of the job was shown; it is in the job's own file")
    if bench.design is not None and any(name in bench.design.knobs for _, step in steps for name in step.knobs):
        raise ValueError("a course holds motions and temperatures, not another design; save the camera instead")
    if any(step.pivots != first.pivots for _, step in steps):
        raise ValueError(
            "a course rotates each body about one pivot at all times; record again without changing pivots"
        )
    knobs = bench.knobs
    fixed, moving = _split([dict(step.knobs) for _, step in steps], knobs)
    resolved = bench.twin.resolved.with_render(first.frames, bench.seed_of(first.seed))
    plain = resolved.plain()
    job = plain["job"]
    job["perturb"] = perturbation(fixed, first.pivots, knobs, job.get("perturb", {}))
    job["course"] = {"times": [f"{time!r} s" for time, _ in steps], **_courses(moving, first.pivots, knobs, len(steps))}
    validate(JobSpec, YamlFile("", job, {}))
    return _head() + dump_yaml(plain)


def _limited_times(kept: Sequence[tuple[float, AskedState]]) -> list[tuple[float, AskedState]]:
    """Return states at ascending times in milliseconds, at most as many as a job's time series may have.

    The first and the last state are among them.
    """
    out: list[tuple[float, AskedState]] = []
    for seconds, state in kept:
        rounded = round(seconds, 3)
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
    """Separate knobs that change over the recorded states from constant ones.

    Returns
    -------
    tuple of dict
        Constant knob -> its value, and changing knob -> its values at each time.

    Raises
    ------
    ValueError
        The figure of a surface changes, which a job's time series cannot contain.
    """
    names = dict.fromkeys(name for state in states for name in state)
    moving = {}
    fixed = {}
    for name in names:
        values = [state.get(name, 0.0) for state in states]
        if all(a == b for a, b in pairwise(values)):
            fixed[name] = values[0]
        elif knobs[name].kind == "figure":
            raise ValueError(f"{name}: a course holds motions and temperatures, not figures; save the job instead")
        else:
            moving[name] = values
    if not moving:
        raise ValueError("nothing moved while recording; save the job instead")
    # a body's constant motion belongs to its course, too
    bodies = {(knobs[name].node, knobs[name].kind) for name in moving}
    for name in list(fixed):
        if (knobs[name].node, knobs[name].kind) in bodies:
            moving[name] = [fixed.pop(name)] * len(states)
    return fixed, moving


def _courses(
    moving: Mapping[str, Sequence[float]], pivots: Mapping[str, str], knobs: Mapping[str, Knob], count: int
) -> dict[str, Any]:
    """Return the entries ``temperature`` and ``motion`` of a job's time series (``course``) for changing knobs."""
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
