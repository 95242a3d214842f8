"""Products of an operation's estimate for the time of a scene.

They are camera models for georeferencing its images, the state of the instrument as a job, and its uncertainty as a
prior.

Motions whose specified time law is `white` differ in every image and every reading, such as the differences between
orbits. No reading determines them for an image taken at a different moment. Camera models are therefore not corrected
for them, and their specified sigmas give ERR_RAND, the error that images do not share. All other motions are corrected
as estimated, and their uncertainty gives ERR_BIAS.

The products have a period of validity. The estimate p(t) of a quantity at a time t, used at a different time t', has
the error p(t) - P(t'), where P is the true value. p(t') is the mean of P(t') given the same readings, with the standard
deviation sigma(t'). Because p(t) depends only on these readings, the mean square error is exactly

    sigma(t')^2 + (p(t') - p(t))^2.

The estimate is valid as long as the root of this is at most (1 + `SHARE`) sigma(t) for every quantity, within the times
of readings and forecast, and not across a known change of the instrument.
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
from twin.framework.record import Quantity, Record, described
from twin.operate.estimate.operation_model import plan_digest
from twin.operate.estimate.reported_estimate import percent
from twin.operate.estimated_motions import EstimatedMotions, OmittedComponent, Prior, prior_files, state_file
from twin.operate.overview import day_text, minute_text
from twin.operate.record.entries import MICRO, digest_of_data, instrument_digest, micros, utc_text
from twin.operate.record.schema import ENTRY
from twin.orbit.export.export_report import LINE, export_files
from twin.orbit.export.export_run import USUAL_HEIGHTS, Export, ExportSource, run_export
from twin.orbit.export.ground_accuracy import EstimatedChange

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.models.disturbances import Component
    from twin.operate.estimate.operation_filter import Operation
    from twin.operate.estimate.reported_estimate import Course, FilterResult
    from twin.operate.record.history import History

SHARE = 0.2
"""Relative increase of the root mean square error of an estimate, used at another time, that ends its validity."""
_FIRST = MICRO
"""Shortest distance from the time of the estimate at which its validity is examined, in microseconds."""
_STEPS = 48
"""Number of times examined on either side of the estimate, in geometric progression.

As many evenly spaced times are then examined between the last valid one and the first invalid one.
"""


@dataclass(frozen=True)
class ValidityLimit:
    """Time that limits the validity of an estimate.

    Attributes
    ----------
    time : int
        Microseconds of TAI since 2000.
    reason : str
        Reason as text, such as an event.
    """

    time: int
    reason: str


@dataclass(frozen=True)
class Validity:
    """Period of validity of an estimate.

    Attributes
    ----------
    since, until : int
        Beginning and end of the period, in microseconds of TAI since 2000.
    since_reason, until_reason : str
        Reasons why the estimate is not valid before and after the period.
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
    limits: Sequence[ValidityLimit] = (),
    beside: Course | None = None,
) -> Validity:
    """Return the period of validity of an estimate.

    Parameters
    ----------
    estimates : Callable[[Sequence[int]], Course]
        Function that returns the estimate at ascending times.
    time : int
        Time of the estimate.
    first : ValidityLimit
        Earliest time with an estimate.
    last : ValidityLimit
        Latest time with an estimate.
    limits : Sequence[ValidityLimit]
        Limits between `first` and `last`, such as events; one at `time` itself counts as before it.
    beside : Course | None
        Estimate just after the time, used instead of that at the time.
    """
    low = max((limit for limit in (first, *limits) if limit.time <= time), key=lambda limit: limit.time)
    high = min((limit for limit in (last, *limits) if limit.time > time), key=lambda limit: limit.time, default=last)
    estimate = beside or estimates([time])
    ends = {-1: time - low.time, 1: high.time - time}
    limits_by_sign = _limits_of_validity(
        estimates, estimate, time, {sign: (0, _distances(0, span)) for sign, span in ends.items()}
    )
    again = {sign: (good, _distances(good, bad, evenly=True)) for sign, (good, bad, _) in limits_by_sign.items()}
    limits_by_sign |= _limits_of_validity(estimates, estimate, time, again)
    since, until = (
        ValidityLimit(time + sign * limits_by_sign[sign][0], limits_by_sign[sign][2])
        if sign in limits_by_sign
        else mark
        for sign, mark in ((-1, low), (1, high))
    )
    return Validity(since.time, until.time, since.reason, until.reason)


def _distances(good: int, end: int, evenly: bool = False) -> NDArray[np.int64]:
    """Return increasing distances in time, in microseconds, from one at which an estimate is valid to an end."""
    if end <= good:
        return np.empty(0, np.int64)
    if evenly:
        away = np.linspace(good, end, _STEPS + 1)[1:]
    else:
        away = np.geomspace(min(_FIRST, end), end, _STEPS)
    return np.unique(np.round(away).astype(np.int64))


def _limits_of_validity(
    estimates: Callable[[Sequence[int]], Course],
    estimate: Course,
    time: int,
    sides: Mapping[int, tuple[int, NDArray[np.int64]]],
) -> dict[int, tuple[int, int, str]]:
    """Return the limits of validity before (key -1) and after (key +1) an estimate; missing where there is none.

    Each is the last valid distance and the first invalid one, in microseconds, and the reason.

    Array dimensions: T times.

    Parameters
    ----------
    estimates : Callable[[Sequence[int]], Course]
        Function that returns the estimate at ascending times; called once for all sides.
    estimate : Course
        The estimate.
    time : int
        Time of the estimate.
    sides : Mapping[int, tuple[int, ndarray]]
        Sign -> a valid distance, and the increasing distances (T,) to examine.
    """
    times = np.unique(
        np.concatenate([np.empty(0, np.int64), *(time + sign * distances for sign, (_, distances) in sides.items())])
    )
    if not len(times):
        return {}
    course = estimates(times.tolist())
    sigma = np.where(estimate.sigmas[0] > 0.0, estimate.sigmas[0], np.inf)
    error = np.hypot(course.sigmas, course.values - estimate.values[0]) / sigma
    out = {}
    for sign, (good, distances) in sides.items():
        at = np.searchsorted(times, time + sign * distances)
        over = np.flatnonzero(np.max(error[at], axis=1, initial=0.0) > 1.0 + SHARE)
        if not over.size:
            continue
        k = int(over[0])
        q = int(np.argmax(error[at[k]]))
        quantity = estimate.quantities[q]
        moved = abs(course.values[at[k], q] - estimate.values[0, q]) > course.sigmas[at[k], q] - estimate.sigmas[0, q]
        what = "its estimate changes" if moved else "its sigma grows"
        reason = f"the error of {quantity.name} would grow by more than {100.0 * SHARE:g} %: {what}"
        out[sign] = int(distances[k - 1]) if k else good, int(distances[k]), reason
    return out


STATE, PRIOR = "state", "prior"
"""Names, without ending, of the files of the instrument's estimated state and of its prior."""
APART = 60 * MICRO
"""Difference between the times of the scene and of the estimate that gives a warning, in microseconds."""


@dataclass(frozen=True, eq=False)
class Products:
    """Products of the estimate for one time.

    Attributes
    ----------
    history : History
        Record of the instrument in operation.
    time : int
        Time of the estimate, in microseconds of TAI since 2000.
    scene_time : int | None
        Time of the scene; None without a scene.
    filter_result : FilterResult
        Result of filtering all readings.
    version : str
        SHA-256 of the record's last entry, of the plan and of the program's version.
    course : Course
        Estimate of all quantities at that time.
    validity : Validity
        Period of validity.
    changes : Mapping[str, EstimatedChange]
        Camera -> its estimated change.
    export : Export | None
        Camera models of the scene; None without a scene.
    state : str
        Text of the job of the estimated state.
    omitted_from_state : tuple[OmittedComponent, ...]
        Components that a job cannot express.
    prior : Prior
        Uncertainty of the state.
    warnings : tuple[str, ...]
        Warnings in words.
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
    """Return the time of a scene, in microseconds of TAI since 2000.

    Parameters
    ----------
    scene : ExportSource
        Scene read by `twin.orbit.export.export_run.read_source`.

    Raises
    ------
    Problem
        The source does not have a single time.
    """
    setup = scene.setup
    if not isinstance(setup, AngleSetup):
        raise Problem("not a scene of an instrument", setup.test.name, "a test of intersection angles with its camera")
    return micros(str(setup.test.orbit.epoch), seconds=setup.test.time)


def make_products(
    operation: Operation, history: History, time: int, scene: ExportSource | None, backend: Backend
) -> Products:
    """Return the camera models, instrument state and uncertainty estimated for one time, and their validity.

    Parameters
    ----------
    operation : Operation
        Estimate of the record.
    history : History
        Record of the instrument in operation.
    time : int
        Microseconds of TAI since 2000.
    scene : ExportSource | None
        Scene for whose images camera models are made; None to make none.
    backend : Backend
        Backend that traces the cameras' lines.

    Raises
    ------
    Problem
        There is no estimate for that time, or the scene is of a different instrument.
    InputError
        The scene cannot be simulated or modelled.
    """
    at = None if scene is None else scene_time(scene)
    if scene is not None:
        _require_same_instrument(scene, history)
    if operation.plan.operation.focus is not None:
        raise Problem("products need the motions that a monitor shows", None, "a plan without `focus`")
    result = operation.filter_readings()
    ends = _ends(operation, history, result)
    if not ends[0].time <= time <= ends[1].time:
        early = time < ends[0].time
        text = "the time is before the first reading" if early else "the time is beyond the forecast"
        allowed = f"a time from {utc_text(ends[0].time)} to {utc_text(ends[1].time)}"
        remedy = "" if early else "; ingest newer readings, or lengthen the plan's horizon"
        raise Problem(text, utc_text(time), allowed + remedy)
    # white motions are known at the time of a reading, but not a microsecond later
    both = operation.smoothed([time, min(time + 1, ends[1].time)])
    course, beside = _at(both, 0), _at(both, 1)
    far = round(operation.plan.operation.horizon * MICRO)
    limits = [ValidityLimit(time + sign * far, "the plan's horizon") for sign in (-1, 1)]
    held = validity(operation.smoothed, time, *ends, [*_validity_limits(result), *limits], beside)
    motions = operation.motions(time, acting=True)
    disturbances = operation.model.series_filter.prior
    estimated = EstimatedMotions.in_units(_components(operation), motions.mean, motions.covariance)
    version = _version(operation, history)
    changes = _changes(operation, course, estimated, _notes(time, held, result, version))
    remark = f"{history.name} as estimated for {utc_text(time)}, version {version}"
    about = f"posterior of {result.readings} readings up to {utc_text(result.time)}, for {utc_text(time)}"
    plan, instrument = operation.plan.operation, operation.experiment.instrument
    state, left = state_file(estimated, operation.experiment.thermal, plan.instrument, plan.disturbances, remark)
    prior = prior_files(
        estimated, disturbances, instrument, PRIOR, about, f"{remark}\nUncertainty of the state in {STATE}.yaml"
    )
    export = None if scene is None else _exported(scene, backend, changes)
    warnings = _warnings(result, time, at, export, left, prior)
    return Products(history, time, at, result, version, course, held, changes, export, state, left, prior, warnings)


def _components(operation: Operation) -> list[Component]:
    """Return the specified components in the order of the model, which may have been traced in a different order."""
    prior = operation.experiment.prior
    assert prior is not None, "a plan states what moves"
    by_key = {(component.cause, component.name): component for component in prior.components}
    disturbances = operation.model.series_filter.prior
    return [by_key[key] for key in zip(disturbances.causes, disturbances.labels, strict=True)]


def _require_same_instrument(scene: ExportSource, history: History) -> None:
    """Raise Problem if a scene's instrument is not that of the record."""
    plain = scene.setup.plain()
    allowed = f"a scene of {history.name} ({history.sha256[:12]}), which the record is of: camera: {history.name}"
    if not isinstance(plain.get("instrument"), Mapping):
        raise Problem("the scene is of a payload, not of the record's instrument", plain["camera"]["name"], allowed)
    digest = instrument_digest(plain["instrument"], plain["cameras"])
    if digest != history.sha256:
        name = plain["instrument"].get("name", "without a name")
        raise Problem("the scene is of another instrument", f"{name} ({digest[:12]})", allowed)


def _ends(operation: Operation, history: History, result: FilterResult) -> tuple[ValidityLimit, ValidityLimit]:
    """Return the first reading and the end of the forecast. Raise Problem if there are no readings."""
    first = history.first("monitor")
    if first is None or not result.readings:
        raise Problem("the record has no reading of the monitor", None, "python -m twin.operate ingest RECORD RUN")
    end = result.time + round(operation.plan.operation.horizon * MICRO)
    return ValidityLimit(int(first["time_us"]), "the first reading of the monitor"), ValidityLimit(
        end, "the horizon of the forecast"
    )


def _at(course: Course, k: int) -> Course:
    """Return the estimate at the time of index ``k`` only."""
    names = ("times", "values", "sigmas", "changes", "covariance")
    return replace(course, **{name: getattr(course, name)[k : k + 1] for name in names})


def _validity_limits(result: FilterResult) -> list[ValidityLimit]:
    """Return the events, jumps and violations that limit the validity of an estimate."""
    marks = [
        ValidityLimit(moment, f"the event {name}, which steps {', '.join(causes)}")
        for moment, name, causes in result.events
        if causes
    ]
    for jump in result.jumps:
        marks += [
            ValidityLimit(moment, f"a jump of {jump.body} was detected") for moment in (jump.after_us, jump.until_us)
        ]
    for requirement in result.requirements:
        if requirement.breaks_us is not None:
            text = f"{requirement.quantity} violates its requirement"
            if requirement.holds_now:
                allowed, day = percent(1.0 - requirement.probability), day_text(requirement.breaks_us)
                text = f"{requirement.quantity} may violate its requirement (probability above {allowed}) from {day} on"
            marks.append(ValidityLimit(requirement.breaks_us, text))
    return marks


def _version(operation: Operation, history: History) -> str:
    """Return the version of the products: a digest of the record's last entry, the plan and the program."""
    query = select(ENTRY.c.sha256).order_by(ENTRY.c.id.desc()).limit(1)
    with history.reading() as connection:
        last = connection.execute(query).scalar()
    program = f"{WRITER} {importlib.metadata.version(WRITER)}"
    return digest_of_data([last, plan_digest(operation.plan), operation.plan.operation.horizon, program])


def _changes(
    operation: Operation, course: Course, motions: EstimatedMotions, notes: tuple[str, ...]
) -> dict[str, EstimatedChange]:
    """Return the estimated change of each camera, without motions that differ in every image (white time law)."""
    disturbances = operation.model.series_filter.prior
    white = np.array([law.white for law in disturbances.laws])
    size = np.array([component.unit_size for component in motions.components]) * disturbances.sigmas
    rows = disturbances.parameters / np.where(size > 0.0, size, np.inf)  # (4 K, M) per SI unit of each motion
    other_rows, white_rows = rows * ~white, rows * white
    # p = p_other + p_white: remove the white part with its covariance to the others
    across = white_rows @ motions.covariance @ other_rows.T
    constant = course.covariance[0] - white_rows @ motions.covariance @ white_rows.T - across - across.T
    # ERR_RAND consists of the stated sizes of motions that are white in time
    prior = disturbances.parameters * white
    random = prior @ disturbances.correlation @ prior.T
    values = course.changes[0] - white_rows @ motions.mean
    out = {}
    for k, name in enumerate(dict.fromkeys(camera for camera, _ in operation.model.spots)):
        four = slice(4 * k, 4 * k + 4)
        out[name] = EstimatedChange(values[four], constant[four, four], random[four, four], notes)
    return out


def _notes(time: int, valid: Validity, result: FilterResult, version: str) -> tuple[str, ...]:
    """Return notes on readings, validity and version for the camera models."""
    return (
        f"The camera is as estimated for {utc_text(time)} from {result.readings} readings up to "
        f"{utc_text(result.time)}; the estimate holds from {utc_text(valid.since)} ({valid.since_reason}) to "
        f"{utc_text(valid.until)} ({valid.until_reason}).",
        f"Version {version}.",
    )


def _exported(scene: ExportSource, backend: Backend, changes: Mapping[str, EstimatedChange]) -> Export:
    """Return the camera models of a scene. Raise InputError if they cannot be made."""
    test = scene.setup.test
    # the test's perturbation is its simulated truth; here the record determines the cameras
    setup = scene.setup.model_copy(update={"test": test.model_copy(update={"perturb": FrozenMap()})})
    try:
        return run_export(replace(scene, setup=setup), backend, _heights(scene), changes=changes)
    except BenchError as error:
        raise InputError(*test.error(str(error), error.key, allowed=error.remedy).issues) from error


def _heights(scene: ExportSource) -> tuple[float, float] | None:
    """Return the lowest and the highest ground for fitting the models, in metres.

    They are the default range of heights, extended to include the scene's terrain.
    """
    if not isinstance(scene.setup, AngleSetup):
        return None
    terrain = scene.setup.test.terrain
    room = _RELIEFS * terrain.relief
    return min(USUAL_HEIGHTS[0], terrain.height - room), max(USUAL_HEIGHTS[1], terrain.height + room)


_RELIEFS = 4.0
"""Number of standard deviations of a random terrain's heights that the fitted height range covers on each side."""


def _warnings(
    result: FilterResult,
    time: int,
    scene: int | None,
    export: Export | None,
    omitted: Sequence[OmittedComponent],
    prior: Prior,
) -> tuple[str, ...]:
    """Return warnings about the estimate, its distance in time from the scene, and omitted components."""
    out = list(result.warnings)
    if scene is not None and abs(scene - time) > APART:
        out.append(f"the scene was taken at {utc_text(scene)}, and the estimate is for {utc_text(time)}")
    for requirement in result.requirements:
        if not requirement.holds_now:
            out.append(f"{requirement.quantity} violates its requirement")
    for name, model in (export.lines if export is not None else {}).items():
        if model.polynomial is None:
            out.append(f"{name} has no rational polynomials: {model.refused}")
    if omitted:
        out.append(f"{STATE}.yaml omits {len(omitted)} motions that a job cannot express")
    if prior.omitted:
        most = max(term.share or 0.0 for term in prior.omitted)
        text = f"{PRIOR}.yaml omits the {len(prior.omitted)} least important components"
        out.append(f"{text}; none contributes more than {100.0 * most:.2g} % to the variance of a spot or a parameter")
    return tuple(out)


NUMBERS = "products.json"


def _cameras(products: Products) -> dict[str, dict[str, float]]:
    """Return the quantities with sigmas by camera (or other group), in the units named by their keys."""
    out: dict[str, dict[str, float]] = {}
    for k, quantity in enumerate(products.course.quantities):
        group = out.setdefault(quantity.group, {})
        group[quantity.key] = float(products.course.values[0, k])
        group[f"{quantity.key}_sigma"] = float(products.course.sigmas[0, k])
    return out


OMITTED: Record[OmittedComponent] = Record(
    "Component that a file omits.",
    Quantity("component", lambda component: component.name, "body, kind and axis"),
    Quantity(
        "amount",
        lambda component: component.amount / component.unit_size,
        "estimated amount; for a prior its standard deviation",
    ),
    Quantity("unit", lambda component: component.unit, "unit of the amount"),
    Quantity(
        "share",
        lambda component: component.share,
        "for a prior, its largest share of the variance of a spot or a parameter",
        where_known=True,
    ),
)
STATE_FILE: Record[Products] = Record(
    "Job of the estimated state.",
    Quantity("file", lambda p: f"{STATE}.yaml", "file for python -m twin.render"),
    Quantity("omitted", lambda p: list(p.omitted_from_state), "motions that a job cannot express", record=OMITTED),
)
PRIOR_FILE: Record[Products] = Record(
    "Uncertainty of that state.",
    Quantity("file", lambda p: f"{PRIOR}.yaml", "file for disturbances of a job or of python -m twin.asbuilt"),
    Quantity("components", lambda p: len(p.prior.components), "number of its components"),
    Quantity("omitted", lambda p: list(p.prior.omitted), "components that it omits", record=OMITTED),
)
PRODUCTS: Record[Products] = Record(
    "products.json. Estimate of an operation for one time.",
    Quantity("record", lambda p: p.history.url, "address of the record"),
    Quantity("instrument", lambda p: p.history.name, "instrument of the record"),
    Quantity("instrument_sha256", lambda p: p.history.sha256, "SHA-256 that identifies the instrument"),
    Quantity("time_utc", lambda p: utc_text(p.time), "time of the estimate"),
    Quantity(
        "scene_utc",
        lambda p: None if p.scene_time is None else utc_text(p.scene_time),
        "time of the scene, if there is one",
        where_known=True,
    ),
    Quantity("valid_from_utc", lambda p: utc_text(p.validity.since), "beginning of its validity"),
    Quantity("valid_until_utc", lambda p: utc_text(p.validity.until), "end of its validity"),
    Quantity("valid_from_reason", lambda p: p.validity.since_reason, "why it is not valid before"),
    Quantity("valid_until_reason", lambda p: p.validity.until_reason, "why it is not valid after"),
    Quantity(
        "valid_within_percent", lambda p: SHARE, "growth of errors, relative to the time itself, that ends the validity"
    ),
    Quantity("version", lambda p: p.version, "SHA-256 of the record's last entry, the plan and the program"),
    Quantity("program", lambda p: f"{WRITER} {importlib.metadata.version(WRITER)}", "program that wrote it"),
    Quantity("readings", lambda p: p.filter_result.readings, "number of readings of the monitor in the estimate"),
    Quantity("newest_utc", lambda p: utc_text(p.filter_result.time), "time of the newest of them"),
    Quantity("estimate", _cameras, "every quantity of every camera and of the pair, with its sigma"),
    Quantity(
        "changes",
        lambda p: {name: np.asarray(change.values) for name, change in p.changes.items()},
        "camera -> corrections d_alpha, d_beta, d_gamma in rad and d_f in m of its models",
        converted=False,
    ),
    Quantity("cameras", lambda p: list(p.changes), "cameras in the order of the covariance"),
    Quantity(
        "covariance",
        lambda p: p.course.covariance[0],
        "covariance of the changes of one camera after the other, in rad and m",
        converted=False,
    ),
    Quantity(
        "models",
        lambda p: None if p.export is None else p.export.lines,
        "camera -> its models of the scene",
        record=LINE,
        where_known=True,
    ),
    Quantity("state", STATE_FILE, "the estimated state as a job"),
    Quantity("prior", PRIOR_FILE, "uncertainty of that state as a prior"),
    Quantity("warnings", lambda p: list(p.warnings), "warnings"),
)


def product_files(products: Products) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Return the files of the products by path, and the numbers of products.json.

    products.json contains the checksums of the other files.

    Parameters
    ----------
    products : Products
        Products for one time.
    """
    files: dict[str, bytes] = {} if products.export is None else export_files(products.export)
    files[f"{STATE}.yaml"] = products.state.encode()
    files |= {name: text.encode() for name, text in products.prior.files.items()}
    digests: Mapping[str, str] = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    numbers = {**described("products", PRODUCTS(products)), "sha256": dict(digests)}
    files[NUMBERS] = (json.dumps(numbers, indent=1, allow_nan=False) + "\n").encode()
    return files, numbers


def summary(products: Products) -> str:
    """Return a summary of the products in words, for the terminal."""
    lines = [
        f"{products.history.name} at {utc_text(products.time)}, from {products.filter_result.readings_text} up to "
        f"{utc_text(products.filter_result.time)}",
        f"valid from {minute_text(products.validity.since)} UTC: {products.validity.since_reason}",
        f"valid until {minute_text(products.validity.until)} UTC: {products.validity.until_reason}",
    ]
    for name, model in (products.export.lines if products.export is not None else {}).items():
        if model.ground is not None:
            text = f"{name}: ground error {model.ground.bias_m:.2f} m common to all images (ERR_BIAS)"
            lines.append(f"{text} and {model.ground.random_m:.2f} m random per image (ERR_RAND), without the orbit")
    return "\n".join([*lines, *(f"warning: {text}" for text in products.warnings)])
