"""What others get of an operation's estimate for the time of a scene: the camera models with which its images are
located, the state of the instrument as a job, and what is still uncertain of it as a prior.

Motions whose stated law in time is `white` are others in every image and every reading, such as what differs from one
orbit to the next. No reading tells them for an image that was not taken just then, and none is: an image takes seconds.
Camera models are not corrected by them, and their stated sizes make ERR_RAND, the error that images do not have in
common. All else is corrected as estimated, and what is uncertain of it makes ERR_BIAS.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from sqlalchemy import select

from analysis.arrays import Array
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.setup import AngleSetup
from scenes.yaml.errors import InputError, Problem
from twin.operate.estimate.operation_model import plan_digest
from twin.operate.estimated_motions import EstimatedMotions, LeftOut, Prior, prior_files, state_file
from twin.operate.record.entries import MICRO, digest_of_data, instrument_digest, micros, utc_text
from twin.operate.record.schema import ENTRY
from twin.operate.validity import Mark, Validity, validity
from twin.orbit.export.estimated_change import EstimatedChange
from twin.orbit.export.export_run import USUAL_HEIGHTS, Export, run_export
from twin.run.data_files import WRITER
from twin.run.procedure import BenchError

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.models.disturbances import Component
    from twin.operate.estimate.following import Course, Following
    from twin.operate.estimate.operation import Operation
    from twin.operate.record.history import History
    from twin.orbit.export.export_run import ExportSource

STATE, PRIOR = "state", "prior"
"""Names of the files."""
APART = 60 * MICRO
"""Microseconds: a scene that was taken further from the time of the estimate is worth a warning."""


@dataclass(frozen=True, eq=False)
class Products:
    """All products of one time.

    Attributes:
        history: the record.
        time: of the estimate, microseconds of TAI since 2000.
        scene_time: when the scene was taken, likewise; None without a scene.
        newest: time of the newest reading that the estimate rests on.
        readings: how many these are.
        version: SHA-256 of the last entry of the record, of the plan and of the program's version.
        course: the estimate at that time.
        validity: span in which it holds.
        changes: camera -> its estimated change.
        export: camera models of the scene; None without one.
        state: text of the job of the estimated state.
        state_left_out: what a job cannot say.
        prior: what is uncertain of the state.
        warnings: in words.
    """

    history: History
    time: int
    scene_time: int | None
    newest: int
    readings: int
    version: str
    course: Course
    validity: Validity
    changes: Mapping[str, EstimatedChange]
    export: Export | None
    state: str
    state_left_out: tuple[LeftOut, ...]
    prior: Prior
    warnings: tuple[str, ...]


def scene_time(scene: ExportSource) -> int:
    """When a scene was taken, microseconds of TAI since 2000.

    Args:
        scene: as `twin.orbit.export.export_run.read_source` reads it.

    Raises:
        Problem: it is not one moment.
    """
    setup = scene.setup
    if not isinstance(setup, AngleSetup):
        raise Problem("not a scene of an instrument", setup.test.name, "a test of intersection angles with its camera")
    return micros(str(setup.test.orbit.epoch), seconds=setup.test.time)


def made(operation: Operation, history: History, time: int, scene: ExportSource | None, backend: Backend) -> Products:
    """The products of a time.

    Args:
        operation: that follows the record.
        history: the record.
        time: microseconds of TAI since 2000.
        scene: whose camera models are wanted; None for none.
        backend: where the cameras' lines are traced.

    Raises:
        Problem: nothing is known of that time, or the scene is of another instrument.
        InputError: the scene cannot be flown or modelled.
    """
    at = None if scene is None else scene_time(scene)
    if scene is not None:
        _require_own(scene, history)
    following = operation.follow()
    ends = _ends(operation, history, following)
    if not ends[0].time <= time <= ends[1].time:
        early = time < ends[0].time
        text = "nothing is known of a time before the first reading" if early else "the forecast does not go so far"
        allowed = f"a time from {utc_text(ends[0].time)} to {utc_text(ends[1].time)}"
        remedy = "" if early else "; take newer readings, or a longer horizon in the plan"
        raise Problem(text, utc_text(time), allowed + remedy)
    newest = following.time
    # at the very moment of a reading white motions are known, and a microsecond later they are not
    both = operation.smoothed([time, min(time + 1, ends[1].time)])
    course, beside = _at(both, 0), _at(both, 1)
    far = round(operation.plan.operation.horizon * MICRO)
    limits = [Mark(time + sign * far, "longer than the plan's horizon nothing is looked at") for sign in (-1, 1)]
    held = validity(operation.smoothed, time, *ends, [*_marks(following), *limits], beside)
    motions = operation.motions(time, acting=True)
    disturbances = operation.model.how.stated
    found = EstimatedMotions.in_units(_components(operation), motions.mean, motions.covariance)
    version = _version(operation, history)
    changes = _changes(operation, course, found, _notes(time, held, following, version))
    remark = f"{history.name} as estimated for {utc_text(time)}, version {version}"
    about = f"posterior of {following.readings} readings up to {utc_text(newest)}, for {utc_text(time)}"
    plan, instrument = operation.plan.operation, operation.experiment.instrument
    state, left = state_file(found, operation.experiment.thermal, plan.instrument, plan.disturbances, remark)
    prior = prior_files(
        found, disturbances, instrument, PRIOR, about, f"{remark}\nWhat is uncertain of the state in {STATE}.yaml"
    )
    export = None if scene is None else _exported(scene, backend, changes)
    warnings = _warnings(following, time, at, export, left, prior)
    return Products(
        *(history, time, at, newest, following.readings, version, course, held, changes, export),
        *(state, left, prior, warnings),
    )


def _components(operation: Operation) -> list[Component]:
    """What is stated, in the order of the model: it may have been traced under the same plan in another order."""
    stated = operation.experiment.stated
    assert stated is not None, "a plan states what moves"
    own = {(one.cause, one.name): one for one in stated.components}
    of = operation.model.how.stated
    return [own[key] for key in zip(of.causes, of.labels, strict=True)]


def _cameras(operation: Operation) -> tuple[str, ...]:
    """Names in the order of the estimate's parameters."""
    return tuple(dict.fromkeys(camera for camera, _ in operation.model.spots))


def _require_own(scene: ExportSource, history: History) -> None:
    """Refuse a scene of another instrument. Raises Problem."""
    plain = scene.setup.plain()
    allowed = f"a scene of {history.name} ({history.sha256[:12]}), which the record is of: camera: {history.name}"
    if not isinstance(plain.get("instrument"), Mapping):
        raise Problem("the scene is of a payload, not of the record's instrument", plain["camera"]["name"], allowed)
    found = instrument_digest(plain["instrument"], plain["cameras"])
    if found != history.sha256:
        name = plain["instrument"].get("name", "without a name")
        raise Problem("the scene is of another instrument", f"{name} ({found[:12]})", allowed)


def _ends(operation: Operation, history: History, following: Following) -> tuple[Mark, Mark]:
    """The first reading, and the end of the forecast. Raises Problem: there are no readings."""
    first = history.first("monitor")
    if first is None or not following.readings:
        raise Problem("the record has no reading of the monitor", None, "python -m twin.operate ingest RECORD RUN")
    end = following.time + round(operation.plan.operation.horizon * MICRO)
    return Mark(int(first["time_us"]), "the first reading of the monitor"), Mark(end, "the horizon of the forecast")


def _at(course: Course, k: int) -> Course:
    """The estimate at one of its times."""
    names = ("times", "values", "sigmas", "changes", "covariance")
    return replace(course, **{name: getattr(course, name)[k : k + 1] for name in names})


def _marks(following: Following) -> list[Mark]:
    """What an estimate does not hold across."""
    marks = [
        Mark(moment, f"the event {name}, with which {', '.join(causes)} step")
        for moment, name, causes in following.events
        if causes
    ]
    for jump in following.jumps:
        marks += [Mark(moment, f"a jump of {jump.body} was found") for moment in (jump.after_us, jump.until_us)]
    for one in following.breaks:
        if one.breaks_us is not None:
            marks.append(Mark(one.breaks_us, f"{one.quantity} no longer keeps its requirement"))
    return marks


def _version(operation: Operation, history: History) -> str:
    query = select(ENTRY.c.sha256).order_by(ENTRY.c.id.desc()).limit(1)
    with history.reading() as connection:
        last = connection.execute(query).scalar()
    program = f"{WRITER} {importlib.metadata.version(WRITER)}"
    return digest_of_data([last, plan_digest(operation.plan), operation.plan.operation.horizon, program])


def _changes(
    operation: Operation, course: Course, found: EstimatedMotions, notes: tuple[str, ...]
) -> dict[str, EstimatedChange]:
    """Camera -> its change at the course's one time, without white motions."""
    stated = operation.model.how.stated
    white = np.array([law.white for law in stated.laws])
    rows = _by_motions(operation, found)
    other, own = rows * ~white, rows * white
    # p = p_other + p_white: their covariance goes out with that of the white part
    across = own @ found.covariance @ other.T
    constant = course.covariance[0] - own @ found.covariance @ own.T - across - across.T
    # ERR_RAND comes from here alone: the stated sizes of motions that are white in time
    prior = stated.parameters * white
    random = prior @ stated.correlation @ prior.T
    values = course.changes[0] - own @ found.mean
    out = {}
    for k, name in enumerate(_cameras(operation)):
        four = slice(4 * k, 4 * k + 4)
        out[name] = EstimatedChange(values[four], constant[four, four], random[four, four], notes)
    return out


def _notes(time: int, held: Validity, following: Following, version: str) -> tuple[str, ...]:
    return (
        f"The camera is as estimated for {utc_text(time)} from {following.readings} readings up to "
        f"{utc_text(following.time)}; the estimate holds from {utc_text(held.since)} ({held.since_reason}) to "
        f"{utc_text(held.until)} ({held.until_reason}).",
        f"Version {version}.",
    )


def _exported(scene: ExportSource, backend: Backend, changes: Mapping[str, EstimatedChange]) -> Export:
    """Camera models of a scene. Raises InputError."""
    test = scene.setup.test
    # what a test perturbs is what it pretends to be the truth; here the record says what the cameras are
    setup = scene.setup.model_copy(update={"test": test.model_copy(update={"perturb": FrozenMap()})})
    try:
        return run_export(replace(scene, setup=setup), backend, _heights(scene), changes=changes)
    except BenchError as error:
        raise InputError(*test.error(str(error), error.key, allowed=error.remedy).issues) from error


def _by_motions(operation: Operation, found: EstimatedMotions) -> Array:
    """(4 K, M) parameters per SI unit of each motion."""
    stated = operation.model.how.stated
    size = np.array([one.unit_size for one in found.components]) * stated.sigmas
    return np.asarray(stated.parameters / np.where(size > 0.0, size, np.inf))


def _heights(scene: ExportSource) -> tuple[float, float] | None:
    """Lowest and highest ground that models are fitted to, metres: the usual heights, and a scene's terrain beyond."""
    if not isinstance(scene.setup, AngleSetup):
        return None
    terrain = scene.setup.test.terrain
    room = _RELIEFS * terrain.relief
    return min(USUAL_HEIGHTS[0], terrain.height - room), max(USUAL_HEIGHTS[1], terrain.height + room)


_RELIEFS = 4.0
"""Standard deviations of a terrain that its models reach over."""


def _warnings(
    following: Following, time: int, scene: int | None, export: Export | None, left: Sequence[LeftOut], prior: Prior
) -> tuple[str, ...]:
    out = list(following.warnings)
    if scene is not None and abs(scene - time) > APART:
        out.append(f"the scene was taken at {utc_text(scene)}, and the estimate is for {utc_text(time)}")
    for one in following.breaks:
        if not one.holds_now:
            out.append(f"{one.quantity} does not keep its requirement")
    for name, line in (export.lines if export is not None else {}).items():
        if line.polynomial is None:
            out.append(f"{name} has no rational polynomials: {line.refused}")
    if left:
        out.append(f"{STATE}.yaml does not have {len(left)} motions that a job cannot say")
    if prior.left_out:
        most = max(one.share or 0.0 for one in prior.left_out)
        text = f"{PRIOR}.yaml does not have the {len(prior.left_out)} components that matter least"
        out.append(f"{text}; none makes more than {100.0 * most:.2g} percent of the variance of a spot or a parameter")
    return tuple(out)
