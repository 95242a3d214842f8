"""What others get of an operation's estimate for the time of a scene: the camera models with which its images are
located, the state of the instrument as a job, and what is still uncertain of it as a prior.

Motions whose stated law in time is `white` are others in every image and every reading, such as what differs from one
orbit to the next. No reading tells them for an image that was not taken just then, and none is: an image takes seconds.
Camera models are not corrected by them, and their stated sizes make ERR_RAND, the error that images do not have in
common. All else is corrected as estimated, and what is uncertain of it makes ERR_BIAS.

They hold from one time to another. Used at another time t', the estimate p(t) of a time t is wrong by p(t) - P(t'),
P the truth. p(t') is the mean of P(t') given the same readings and p(t) follows from these readings, so that the mean
square of the error is exactly

    sigma(t')^2 + (p(t') - p(t))^2.

The estimate holds as long as the root of this is at most 1 + `SHARE` times sigma(t) for every quantity, within the
readings and the forecast, and not across what is known to have changed the instrument.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select

from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.setup import AngleSetup
from scenes.yaml.errors import InputError, Problem
from twin.framework.data_files import WRITER
from twin.framework.procedure import BenchError
from twin.framework.record import Quantity, Record
from twin.framework.reference_frames import described
from twin.operate.estimate.operation_model import plan_digest
from twin.operate.estimated_motions import EstimatedMotions, OmittedComponent, Prior, prior_files, state_file
from twin.operate.record.entries import MICRO, digest_of_data, instrument_digest, micros, utc_text
from twin.operate.record.schema import ENTRY
from twin.orbit.export.export_report import LINE, export_files
from twin.orbit.export.export_run import USUAL_HEIGHTS, Export, run_export
from twin.orbit.export.ground_accuracy import EstimatedChange

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.models.disturbances import Component
    from twin.operate.estimate.operation_filter import Operation
    from twin.operate.estimate.reported_estimate import Course, FilterResult
    from twin.operate.record.history import History
    from twin.orbit.export.export_run import ExportSource

SHARE = 0.2
"""By which an error may be larger than at the time of the estimate."""
_FIRST = MICRO
"""Microseconds: the shortest time that is looked at."""
_STEPS = 48
"""Times on either side, one after the other by equal factors; then as often between the last that holds and the first
that does not."""


@dataclass(frozen=True)
class ValidityLimit:
    """What an estimate does not hold across.

    Attributes
    ----------
    time : int
        Microseconds of TAI since 2000.
    reason : str
        In words.
    """

    time: int
    reason: str


@dataclass(frozen=True)
class Validity:
    """Span in which an estimate holds.

    Attributes
    ----------
    since, until : int
        Microseconds of TAI since 2000.
    since_reason, until_reason : str
        Why it does not hold before and after.
    """

    since: int
    until: int
    since_reason: str
    until_reason: str


def validity(
    estimates: Callable[[Sequence[int]], Course],
    time: int,
    first: ValidityLimit,
    last: ValidityLimit,
    marks: Sequence[ValidityLimit] = (),
    beside: Course | None = None,
) -> Validity:
    """The span in which the estimate of a time holds.

    Parameters
    ----------
    estimates : Callable[[Sequence[int]], Course]
        At times in ascending order.
    time : int
        Of the estimate.
    first : Mark
        From when on there are estimates.
    last : Mark
        Until when.
    marks : Sequence[Mark]
        What lies between; one at the time itself counts as before it.
    beside : Course | None
        The estimate just beside the time, in place of that at it.
    """
    low = max((one for one in (first, *marks) if one.time <= time), key=lambda one: one.time)
    high = min((one for one in (last, *marks) if one.time > time), key=lambda one: one.time, default=last)
    here = beside or estimates([time])
    ends = {-1: time - low.time, 1: high.time - time}
    found = _limits_of_validity(estimates, here, time, {sign: (0, _distances(0, span)) for sign, span in ends.items()})
    again = {sign: (good, _distances(good, bad, evenly=True)) for sign, (good, bad, _) in found.items()}
    found |= _limits_of_validity(estimates, here, time, again)
    since, until = (
        ValidityLimit(time + sign * found[sign][0], found[sign][2]) if sign in found else mark
        for sign, mark in ((-1, low), (1, high))
    )
    return Validity(since.time, until.time, since.reason, until.reason)


def _distances(good: int, end: int, evenly: bool = False) -> NDArray[np.int64]:
    """Distances beyond one at which an estimate holds, up to an end, microseconds, increasing."""
    if end <= good:
        return np.empty(0, np.int64)
    if evenly:
        away = np.linspace(good, end, _STEPS + 1)[1:]
    else:
        away = np.geomspace(min(_FIRST, end), end, _STEPS)
    return np.unique(np.round(away).astype(np.int64))


def _limits_of_validity(
    estimates: Callable[[Sequence[int]], Course],
    here: Course,
    time: int,
    sides: Mapping[int, tuple[int, NDArray[np.int64]]],
) -> dict[int, tuple[int, int, str]]:
    """Where the estimate ceases to hold, by the sign of the side: the last distance at which it holds and the first at
    which it does not, microseconds, and why; sides on which it holds are missing.

    Parameters
    ----------
    estimates : Callable[[Sequence[int]], Course]
        Asked once for the times of all sides.
    here : Course
        The estimate.
    time : int
        Of it.
    sides : Mapping[int, tuple[int, NDArray[np.int64]]]
        Sign -> a distance at which it holds, and those to look at, (T,), increasing.
    """
    times = np.unique(np.concatenate([np.empty(0, np.int64), *(time + sign * own for sign, (_, own) in sides.items())]))
    if not len(times):
        return {}
    course = estimates(times.tolist())
    sigma = np.where(here.sigmas[0] > 0.0, here.sigmas[0], np.inf)
    error = np.hypot(course.sigmas, course.values - here.values[0]) / sigma
    out = {}
    for sign, (good, own) in sides.items():
        at = np.searchsorted(times, time + sign * own)
        over = np.flatnonzero(np.max(error[at], axis=1, initial=0.0) > 1.0 + SHARE)
        if not over.size:
            continue
        k = int(over[0])
        q = int(np.argmax(error[at[k]]))
        one = here.quantities[q]
        moved = abs(course.values[at[k], q] - here.values[0, q]) > course.sigmas[at[k], q] - here.sigmas[0, q]
        what = "its estimate goes on" if moved else "its sigma grows"
        reason = f"{one.name} would be wrong by {100.0 * SHARE:g} percent more: {what}"
        out[sign] = int(own[k - 1]) if k else good, int(own[k]), reason
    return out


STATE, PRIOR = "state", "prior"
"""Names of the files."""
APART = 60 * MICRO
"""Microseconds: a scene that was taken further from the time of the estimate is worth a warning."""


@dataclass(frozen=True, eq=False)
class Products:
    """All products of one time.

    Attributes
    ----------
    history : History
        The record.
    time : int
        Of the estimate, microseconds of TAI since 2000.
    scene_time : int | None
        When the scene was taken, likewise; None without a scene.
    following : Following
        What the estimate says now, with the readings that it rests on.
    version : str
        SHA-256 of the last entry of the record, of the plan and of the program's version.
    course : Course
        The estimate at that time.
    validity : Validity
        Span in which it holds.
    changes : Mapping[str, EstimatedChange]
        Camera -> its estimated change.
    export : Export | None
        Camera models of the scene; None without one.
    state : str
        Text of the job of the estimated state.
    state_left_out : tuple[LeftOut, ...]
        What a job cannot say.
    prior : Prior
        What is uncertain of the state.
    warnings : tuple[str, ...]
        In words.
    """

    history: History
    time: int
    scene_time: int | None
    filter_result: FilterResult
    version: str
    course: Course
    validity: Validity
    changes: Mapping[str, EstimatedChange]
    export: Export | None
    state: str
    omitted_from_state: tuple[OmittedComponent, ...]
    prior: Prior
    warnings: tuple[str, ...]


def scene_time(scene: ExportSource) -> int:
    """When a scene was taken, microseconds of TAI since 2000.

    Parameters
    ----------
    scene : ExportSource
        As `twin.orbit.export.export_run.read_source` reads it.

    Raises
    ------
    Problem
        It is not one moment.
    """
    setup = scene.setup
    if not isinstance(setup, AngleSetup):
        raise Problem("not a scene of an instrument", setup.test.name, "a test of intersection angles with its camera")
    return micros(str(setup.test.orbit.epoch), seconds=setup.test.time)


def make_products(
    operation: Operation, history: History, time: int, scene: ExportSource | None, backend: Backend
) -> Products:
    """The products of a time.

    Parameters
    ----------
    operation : Operation
        That follows the record.
    history : History
        The record.
    time : int
        Microseconds of TAI since 2000.
    scene : ExportSource | None
        Whose camera models are wanted; None for none.
    backend : Backend
        Where the cameras' lines are traced.

    Raises
    ------
    Problem
        Nothing is known of that time, or the scene is of another instrument.
    InputError
        The scene cannot be flown or modelled.
    """
    at = None if scene is None else scene_time(scene)
    if scene is not None:
        _require_same_instrument(scene, history)
    result = operation.filter_readings()
    ends = _ends(operation, history, result)
    if not ends[0].time <= time <= ends[1].time:
        early = time < ends[0].time
        text = "nothing is known of a time before the first reading" if early else "the forecast does not go so far"
        allowed = f"a time from {utc_text(ends[0].time)} to {utc_text(ends[1].time)}"
        remedy = "" if early else "; take newer readings, or a longer horizon in the plan"
        raise Problem(text, utc_text(time), allowed + remedy)
    # at the very moment of a reading white motions are known, and a microsecond later they are not
    both = operation.smoothed([time, min(time + 1, ends[1].time)])
    course, beside = _at(both, 0), _at(both, 1)
    far = round(operation.plan.operation.horizon * MICRO)
    limits = [
        ValidityLimit(time + sign * far, "longer than the plan's horizon nothing is looked at") for sign in (-1, 1)
    ]
    held = validity(operation.smoothed, time, *ends, [*_validity_limits(result), *limits], beside)
    motions = operation.motions(time, acting=True)
    disturbances = operation.model.series_filter.stated
    found = EstimatedMotions.in_units(_components(operation), motions.mean, motions.covariance)
    version = _version(operation, history)
    changes = _changes(operation, course, found, _notes(time, held, result, version))
    remark = f"{history.name} as estimated for {utc_text(time)}, version {version}"
    about = f"posterior of {result.readings} readings up to {utc_text(result.time)}, for {utc_text(time)}"
    plan, instrument = operation.plan.operation, operation.experiment.instrument
    state, left = state_file(found, operation.experiment.thermal, plan.instrument, plan.disturbances, remark)
    prior = prior_files(
        found, disturbances, instrument, PRIOR, about, f"{remark}\nWhat is uncertain of the state in {STATE}.yaml"
    )
    export = None if scene is None else _exported(scene, backend, changes)
    warnings = _warnings(result, time, at, export, left, prior)
    return Products(history, time, at, result, version, course, held, changes, export, state, left, prior, warnings)


def _components(operation: Operation) -> list[Component]:
    """What is stated, in the order of the model: it may have been traced under the same plan in another order."""
    stated = operation.experiment.stated
    assert stated is not None, "a plan states what moves"
    own = {(component.cause, component.name): component for component in stated.components}
    of = operation.model.series_filter.stated
    return [own[key] for key in zip(of.causes, of.labels, strict=True)]


def _require_same_instrument(scene: ExportSource, history: History) -> None:
    """Refuse a scene of another instrument. Raises Problem."""
    plain = scene.setup.plain()
    allowed = f"a scene of {history.name} ({history.sha256[:12]}), which the record is of: camera: {history.name}"
    if not isinstance(plain.get("instrument"), Mapping):
        raise Problem("the scene is of a payload, not of the record's instrument", plain["camera"]["name"], allowed)
    found = instrument_digest(plain["instrument"], plain["cameras"])
    if found != history.sha256:
        name = plain["instrument"].get("name", "without a name")
        raise Problem("the scene is of another instrument", f"{name} ({found[:12]})", allowed)


def _ends(operation: Operation, history: History, result: FilterResult) -> tuple[ValidityLimit, ValidityLimit]:
    """The first reading, and the end of the forecast. Raises Problem: there are no readings."""
    first = history.first("monitor")
    if first is None or not result.readings:
        raise Problem("the record has no reading of the monitor", None, "python -m twin.operate ingest RECORD RUN")
    end = result.time + round(operation.plan.operation.horizon * MICRO)
    return ValidityLimit(int(first["time_us"]), "the first reading of the monitor"), ValidityLimit(
        end, "the horizon of the forecast"
    )


def _at(course: Course, k: int) -> Course:
    """The estimate at one of its times."""
    names = ("times", "values", "sigmas", "changes", "covariance")
    return replace(course, **{name: getattr(course, name)[k : k + 1] for name in names})


def _validity_limits(result: FilterResult) -> list[ValidityLimit]:
    """What an estimate does not hold across."""
    marks = [
        ValidityLimit(moment, f"the event {name}, with which {', '.join(causes)} step")
        for moment, name, causes in result.events
        if causes
    ]
    for jump in result.jumps:
        marks += [
            ValidityLimit(moment, f"a jump of {jump.body} was found") for moment in (jump.after_us, jump.until_us)
        ]
    for requirement in result.requirements:
        if requirement.breaks_us is not None:
            marks.append(
                ValidityLimit(requirement.breaks_us, f"{requirement.quantity} no longer keeps its requirement")
            )
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
    stated = operation.model.series_filter.stated
    white = np.array([law.white for law in stated.laws])
    size = np.array([component.unit_size for component in found.components]) * stated.sigmas
    rows = stated.parameters / np.where(size > 0.0, size, np.inf)  # (4 K, M) per SI unit of each motion
    other, own = rows * ~white, rows * white
    # p = p_other + p_white: their covariance goes out with that of the white part
    across = own @ found.covariance @ other.T
    constant = course.covariance[0] - own @ found.covariance @ own.T - across - across.T
    # ERR_RAND comes from here alone: the stated sizes of motions that are white in time
    prior = stated.parameters * white
    random = prior @ stated.correlation @ prior.T
    values = course.changes[0] - own @ found.mean
    out = {}
    for k, name in enumerate(dict.fromkeys(camera for camera, _ in operation.model.spots)):
        four = slice(4 * k, 4 * k + 4)
        out[name] = EstimatedChange(values[four], constant[four, four], random[four, four], notes)
    return out


def _notes(time: int, held: Validity, result: FilterResult, version: str) -> tuple[str, ...]:
    return (
        f"The camera is as estimated for {utc_text(time)} from {result.readings} readings up to "
        f"{utc_text(result.time)}; the estimate holds from {utc_text(held.since)} ({held.since_reason}) to "
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
    result: FilterResult,
    time: int,
    scene: int | None,
    export: Export | None,
    left: Sequence[OmittedComponent],
    prior: Prior,
) -> tuple[str, ...]:
    out = list(result.warnings)
    if scene is not None and abs(scene - time) > APART:
        out.append(f"the scene was taken at {utc_text(scene)}, and the estimate is for {utc_text(time)}")
    for requirement in result.requirements:
        if not requirement.holds_now:
            out.append(f"{requirement.quantity} does not keep its requirement")
    for name, line in (export.lines if export is not None else {}).items():
        if line.polynomial is None:
            out.append(f"{name} has no rational polynomials: {line.refused}")
    if left:
        out.append(f"{STATE}.yaml does not have {len(left)} motions that a job cannot say")
    if prior.omitted:
        most = max(one.share or 0.0 for one in prior.omitted)
        text = f"{PRIOR}.yaml does not have the {len(prior.omitted)} components that matter least"
        out.append(f"{text}; none makes more than {100.0 * most:.2g} percent of the variance of a spot or a parameter")
    return tuple(out)


NUMBERS = "products.json"


def _cameras(one: Products) -> dict[str, dict[str, float]]:
    """Group -> its quantities with their sigmas, in the units that their keys end in."""
    out: dict[str, dict[str, float]] = {}
    for k, quantity in enumerate(one.course.quantities):
        group = out.setdefault(quantity.group, {})
        group[quantity.key] = float(one.course.values[0, k])
        group[f"{quantity.key}_sigma"] = float(one.course.sigmas[0, k])
    return out


OMITTED: Record[OmittedComponent] = Record(
    "A component that a file does not have.",
    Quantity("component", lambda one: one.name, "body, kind and axis"),
    Quantity("amount", lambda one: one.amount / one.unit_size, "estimated amount, of a prior its standard deviation"),
    Quantity("unit", lambda one: one.unit, "of the amount"),
    Quantity(
        "share", lambda one: one.share, "largest of the variance of a spot or a parameter, of a prior", where_known=True
    ),
)
STATE_FILE: Record[Products] = Record(
    "The job of the estimated state.",
    Quantity("file", lambda one: f"{STATE}.yaml", "for python -m twin.render"),
    Quantity("omitted", lambda one: list(one.omitted_from_state), "motions that a job cannot express", record=OMITTED),
)
PRIOR_FILE: Record[Products] = Record(
    "What is uncertain of that state.",
    Quantity("file", lambda one: f"{PRIOR}.yaml", "for disturbances of a job or of python -m twin.asbuilt"),
    Quantity("components", lambda one: len(one.prior.components), "that it has"),
    Quantity("omitted", lambda one: list(one.prior.omitted), "components that it omits", record=OMITTED),
)
PRODUCTS: Record[Products] = Record(
    "products.json. What an operation's estimate says for one time.",
    Quantity("record", lambda one: one.history.url, "of the instrument"),
    Quantity("instrument", lambda one: one.history.name, "of the record"),
    Quantity("instrument_sha256", lambda one: one.history.sha256, "by which it is recognised"),
    Quantity("time_utc", lambda one: utc_text(one.time), "of the estimate"),
    Quantity(
        "scene_utc",
        lambda one: None if one.scene_time is None else utc_text(one.scene_time),
        "when the scene was taken, where there is one",
        where_known=True,
    ),
    Quantity("valid_from_utc", lambda one: utc_text(one.validity.since), "from when on it holds"),
    Quantity("valid_until_utc", lambda one: utc_text(one.validity.until), "until when it holds"),
    Quantity("valid_from_reason", lambda one: one.validity.since_reason, "why not before"),
    Quantity("valid_until_reason", lambda one: one.validity.until_reason, "why not after"),
    Quantity("valid_within_percent", lambda one: SHARE, "by which errors may be larger than at the time itself"),
    Quantity("version", lambda one: one.version, "SHA-256 of the record's last entry, the plan and the program"),
    Quantity("program", lambda one: f"{WRITER} {importlib.metadata.version(WRITER)}", "that wrote it"),
    Quantity("readings", lambda one: one.filter_result.readings, "of the monitor that the estimate rests on"),
    Quantity("newest_utc", lambda one: utc_text(one.filter_result.time), "time of the newest of them"),
    Quantity("estimate", _cameras, "every quantity of every camera and of both together, with its sigma"),
    Quantity(
        "changes",
        lambda one: {name: np.asarray(change.values) for name, change in one.changes.items()},
        "camera -> d_alpha, d_beta, d_gamma in rad and d_f in m that its models have been corrected by",
        converted=False,
    ),
    Quantity("cameras", lambda one: list(one.changes), "in the order of the covariance"),
    Quantity(
        "covariance",
        lambda one: one.course.covariance[0],
        "of the changes of one camera after the other, rad and m",
        converted=False,
    ),
    Quantity(
        "models",
        lambda one: None if one.export is None else one.export.lines,
        "camera -> its models of the scene",
        record=LINE,
        where_known=True,
    ),
    Quantity("state", STATE_FILE, "the estimated state as a job"),
    Quantity("prior", PRIOR_FILE, "what is uncertain of it"),
    Quantity("warnings", lambda one: list(one.warnings), "in words"),
)


def product_files(one: Products) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Path in the folder -> contents, and the numbers of `NUMBERS`, which tells the checksums of all others.

    Parameters
    ----------
    one : Products
        All products of a time.
    """
    files: dict[str, bytes] = {} if one.export is None else export_files(one.export)
    files[f"{STATE}.yaml"] = one.state.encode()
    files |= {name: text.encode() for name, text in one.prior.files.items()}
    digests: Mapping[str, str] = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    numbers = {**described("products", PRODUCTS(one)), "sha256": dict(digests)}
    files[NUMBERS] = (json.dumps(numbers, indent=1, allow_nan=False) + "\n").encode()
    return files, numbers


def summary(one: Products) -> str:
    """What there is, for the terminal."""
    lines = [
        f"{one.history.name} at {utc_text(one.time)}, from {one.filter_result.readings} readings up to "
        f"{utc_text(one.filter_result.time)}",
        f"holds from {utc_text(one.validity.since)}: {one.validity.since_reason}",
        f"holds until {utc_text(one.validity.until)}: {one.validity.until_reason}",
    ]
    for name, line in (one.export.lines if one.export is not None else {}).items():
        if line.ground is not None:
            text = f"{name}: wrong on the ground by {line.ground.bias_m:.2f} m (ERR_BIAS)"
            lines.append(
                f"{text} and by {line.ground.random_m:.2f} m otherwise in every image (ERR_RAND), without the orbit"
            )
    return "\n".join([*lines, *(f"warning: {text}" for text in one.warnings)])
