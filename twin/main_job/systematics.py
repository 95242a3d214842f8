"""What the estimators must make of a run's motions by the crosstalk table; what its sigmas rest on, whether its shifts
agree with that, and which body limits what it reads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from analysis.monitor.disturbances import FALSE_ALARM, Disturbances
from analysis.monitor.limits import Split, quantities, split
from analysis.monitor.parameters import rows_of
from analysis.statistics import limit_of
from optics.geometry.tree import Motion
from scenes.models.job_state import motions_of
from scenes.specs.course import moment
from scenes.specs.instrument import BASE, CENTRAL_PRISM
from twin.framework.artefact import plain, shown_unit, significant
from twin.main_job.monitor_reading import MonitorReading, contradicted
from twin.main_job.render_results import RenderRun
from twin.monitor.crosstalk import CameraCrosstalk
from twin.monitor.monitor_derivative import LOST, traced_states
from twin.monitor.motions import ElementaryMotion
from twin.monitor.reading_table import Reading
from twin.monitor.time_series import SmoothedCourse
from twin.uncertainty.monitor_limits import short_text, unit_text

_FAMILY = 4
"""The first motions of a crosstalk table are the family that the estimators of paper 001 assume."""
SHOWN = 1e-3
"""Least amount of a motion, in its table unit, that is spoken of."""


HEAT = "temperatures (expansion, bending, change of index)"
"""How the effects of temperatures are called; a table of motions of single bodies holds only their carried motions."""


@dataclass(frozen=True, eq=False)
class Systematics:
    """What the crosstalk tables make of a run's motions, for one camera.

    Attributes
    ----------
    bias : dict[str, np.ndarray]
        Estimator -> (P,) reading minus truth, to first order, of every reading of the camera, in its unit.
    outside : tuple[str, ...]
        Motions of this camera outside the family, as text with amounts.
    parts : dict[str, np.ndarray]
        Motion, as text with its amount -> its share of the judged estimator's bias, (P,); also motions of other cameras
        where that estimator takes all spots together.
    uncovered : tuple[str, ...]
        What was moved but is in no row of the table.
    """

    bias: dict[str, np.ndarray]
    outside: tuple[str, ...]
    parts: dict[str, np.ndarray]
    uncovered: tuple[str, ...]


def systematics(run: RenderRun, camera: str) -> Systematics:
    """Sum the crosstalk tables over the motions of a run."""
    amounts = {
        name: np.array([_amount(run, motion) for motion in table.motions]) for name, table in run.crosstalk.items()
    }
    k = list(run.crosstalk).index(camera)
    rows = slice(4 * k, 4 * k + 4)
    moved = np.concatenate([table.spot_shift @ amounts[name] for name, table in run.crosstalk.items()])
    table = run.crosstalk[camera]
    true = table.true @ amounts[camera]
    unit = rows_of(run.reading.cameras[camera])
    bias = {e: unit @ (gain[rows] @ moved) - true for e, gain in run.gains.items()}
    others = [i for i in range(_FAMILY, len(table.motions)) if abs(amounts[camera][i]) > SHOWN]
    outside = tuple(_told(table.motions[i], amounts[camera][i]) for i in others)
    return Systematics(bias, outside, _parts(run, camera, amounts), _uncovered(run, camera, table))


def _parts(run: RenderRun, camera: str, amounts: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Error that each motion contributes, for motions that the judged estimator does not read as they are."""
    names = list(run.crosstalk)
    k = names.index(camera)
    gain = rows_of(run.reading.cameras[camera]) @ run.gains[run.judged][4 * k : 4 * k + 4]
    # what weighs all motions by what is stated takes none of them as it is
    known = 0 if run.estimators[run.judged].stated else _FAMILY
    out: dict[tuple[str, str, int], tuple[str, np.ndarray]] = {}
    own = {name: run.experiment.instrument.coordinates_of(name) for name in names}
    for name, table in run.crosstalk.items():
        for i, motion in enumerate(table.motions):
            if i < known or abs(amounts[name][i]) <= SHOWN:
                continue
            read = gain[:, own[name]] @ table.spot_shift[:, i]
            part = (read - (table.true[:, i] if name == camera else 0.0)) * amounts[name][i]
            if not np.any(part):
                continue
            # what both cameras look at stands in both tables
            key = (motion.body, motion.kind, motion.axis)
            told = _told(motion, amounts[name][i])
            told = told if name == camera or motion.body == CENTRAL_PRISM else f"{name}: {told}"
            before = out.get(key)
            out[key] = (told, part) if before is None else (before[0], before[1] + part)
    return dict(out.values())


def _told(motion: ElementaryMotion, amount: float) -> str:
    return f"{motion.label}, {plain(float(amount), 4)} {shown_unit(motion.unit)}"


def _amount(run: RenderRun, elementary: ElementaryMotion) -> float:
    """How much of an elementary motion the run's state holds, in its table unit; pivots converted to first order."""
    motion = run.state.get(elementary.body)
    if motion is None:
        return 0.0
    if elementary.kind == "shift":
        value = float(_shift_at(run, elementary.body, motion, elementary.pivot)[elementary.axis])
    else:
        value = motion.component(elementary.kind, elementary.axis)
    return value / elementary.unit_size


def _shift_at(run: RenderRun, body: str, motion: Motion, pivot: str) -> np.ndarray:
    """The shift, metres, that makes the same rotation and scale about another pivot the same motion to first order."""
    pivots = next(b for b in run.experiment.instrument.assembly.tree.bodies if b.path == body).pivots
    arm = np.array(pivots[motion.pivot]) - np.array(pivots[pivot])
    return np.asarray(np.array(motion.shift) - np.cross(motion.rotate, arm) - motion.scale * arm)


def _uncovered(run: RenderRun, camera: str, table: CameraCrosstalk) -> tuple[str, ...]:
    """Bodies that moved, reach this camera and have no row in the table."""
    own = f"{BASE}/{camera}"
    bodies = {motion.body for motion in table.motions}
    out = []
    given = run.resolved.job.perturb
    for path, motion in run.state.items():
        if path not in (own, CENTRAL_PRISM) and not path.startswith((f"{own}/", f"{CENTRAL_PRISM}/{camera}_")):
            continue
        deformed = path in given and given[path].deformation is not None
        if (motion.expansion and not deformed) or motion.index or any(motion.index_gradient):
            out.append(HEAT)
        if path not in given:
            continue
        if path not in bodies and (any(motion.rotate) or any(motion.shift) or motion.scale):
            out.append(path)
        if given[path].heat.table is not None:
            continue
        covered = {m.axis for m in table.motions if m.body == path and m.kind == "figure"}
        missing = [f"Z{j}" for j, amplitude in motion.figure.items() if amplitude and j not in covered]
        if deformed:
            missing = ["of a table of nodes"]
        if missing:
            out.append(f"{path} (figure {', '.join(missing)})")
    return tuple(out)


def joined(names: Sequence[str]) -> str:
    """``a; b; c`` without repetitions."""
    return "; ".join(dict.fromkeys(names))


BLIND = 4.0
"""Sigmas by which a reading is wrong from which on it is told that no spot says so. Of what is drawn from the statement
itself a motion does as much in one of 20 000 runs."""


def perturbed_unseen(run: RenderRun) -> tuple[str, ...]:
    """A warning for each perturbed body by which readings are wrong while the spots do not show it: what the
    perturbation of that body alone does to spots and cameras, traced, against what would be read of it.

    Parameters
    ----------
    run : RenderRun
        Of a state, or of the time of a course that is shown.
    """
    job, noise = run.resolved.job, run.recovery.shift_covariance[0]
    shown = None if run.series is None else run.series.shown
    if not np.any(noise):
        return ()
    moved = {path: motion for path, motion in motions_of(job, shown).items() if motion != Motion(pivot=motion.pivot)}
    if not moved:
        return ()
    try:
        found = traced_states(run.experiment.path, run.experiment.sight, [{path: m} for path, m in moved.items()])
    except LOST:
        # together with others the body may keep its light; alone there is nothing to be said
        return ()
    reading, stated = run.reading, run.reading.disturbances
    gain = run.gains[run.judged]
    every = quantities(reading.cameras, reading.ground)
    rows = np.stack([quantity.row for quantity in every])
    sigma = _sigmas(rows, stated, noise, gain)
    spread = noise if stated is None else stated.spot_covariance + noise
    limit = float(limit_of(FALSE_ALARM, len(noise))) - len(noise)
    out = []
    for path, shift, true in zip(moved, found.spots, found.parameters, strict=True):
        wrong = rows @ (gain @ shift - true)
        far = np.abs(wrong) / np.where(sigma > 0.0, sigma, np.inf)
        worst = int(np.argmax(far))
        still = float(np.max(np.abs(shift) / np.sqrt(np.diag(noise))))
        told = float(shift @ np.linalg.solve(spread, shift))
        if far[worst] < BLIND or (still > BLIND if stated is None else told > limit):
            continue
        how = "moves no spot beyond its noise" if still < 1.0 else "moves the spots as likelier motions do"
        unit = unit_text(every[worst])
        is_, read = (significant(float(rows[worst] @ value), 3) for value in (true, gain @ shift))
        out.append(
            f"{path}: what is perturbed of it {how}; {short_text(every[worst])} changes by {is_} {unit} and {read} "
            f"{unit} are read, wrong by {far[worst]:.1f} σ; neither σ nor a test of the shifts can show it: of this "
            "body σ holds as far as its statement does"
        )
    return tuple(out)


def _sigmas(rows: np.ndarray, stated: Disturbances | None, noise: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """(Q,) of the readings by an estimator."""
    if stated is not None:
        return split(rows, stated, noise, gain).sigma
    return np.sqrt(np.einsum("qd,de,qe->q", rows @ gain, noise, rows @ gain))


_NOISE_ALONE = "No disturbances are stated: σ is that of the noise of the images alone"
"""Without a sentence's end."""
NOISE = "the noise of the images"
"""How the part of the variance is called that more frames lower."""


def assumed(reading: MonitorReading) -> str:
    """What the sigmas assume, and whether the measured shifts agree with it; a sentence without its end."""
    stated, found = reading.disturbances, reading.consistency
    if stated is None or found is None:
        return _NOISE_ALONE
    agree = "agree with it" if found.agrees else "contradict it"
    return (
        f"σ: noise and the prior {stated.name}; the shifts {agree} (chi-square "
        f"{significant(found.chi_square)} of {found.degrees} coordinates, limit {found.limit:.1f}, false-alarm rate "
        f"{found.false_alarm:g}){_from_statement(reading)}"
    )


def _from_statement(reading: MonitorReading) -> str:
    """How much of the sigmas is from the statement: the least and the largest share of the posterior's variances."""
    shares = [share for own in reading.from_statement.values() for share in own.values() if share is not None]
    if not shares:
        return ""
    ends = list(dict.fromkeys(plain(math.floor(1e3 * end) / 10.0, 4) for end in (min(shares), max(shares))))
    return f"; {' to '.join(ends)} % of the variances come from the prior, not from the spots"


def contradiction(run: RenderRun) -> tuple[str, ...]:
    """A warning where the shifts of a course contradict the prior at the worst of its times. That of a single state is
    one of the doubts of its reading.
    """
    if run.worst_of_course is None or run.series is None:
        return ()
    k, found = run.worst_of_course
    when = f" at {moment(float(run.series.times[k]))}, the worst of {len(run.series.times)} times"
    return contradicted(run.experiment.disturbances, found, when, f"{FALSE_ALARM:g} for the course")


def doubted(run: RenderRun) -> tuple[str, ...]:
    """Warnings where spots are not as calibrated, and of readings that are not linear; of a course at the worst of its
    times.
    """
    if run.series is None:
        return (*run.reading.doubts, *run.reading.notes)
    return run.series.doubts(["/".join(channel) for channel in run.reading.channels])


def course_agrees(together: SmoothedCourse, times: np.ndarray) -> str:
    """Whether all measurements of a course agree with what is stated to move, and how it goes on in time; sentences.

    Parameters
    ----------
    together : SmoothedCourse
        The course.
    times : np.ndarray
        Of its measurements, seconds.
    """
    return " ".join((_series_agrees(together, times), *_jumps_told(together)))


def _jumps_told(together: SmoothedCourse) -> tuple[str, ...]:
    """What jumped, or that nothing did, where something may; sentences."""
    if together.jumps is None:
        return ()
    if not together.jumps:
        return (f"No jump was found (a false one with a chance of at most {together.jump_false_alarm:g}).",)
    return tuple(f"The series says that {text}." for text in together.jump_texts())


def _series_agrees(together: SmoothedCourse, times: np.ndarray) -> str:
    found = together.consistency
    what = f"Chi-square of all {len(times)} measurements is {found.chi_square:.4g}"
    if found.chance > 1.0 - FALSE_ALARM:
        return (
            f"{what} where {found.degrees} are expected: the motions are smaller than the "
            "prior, and the sigmas are too large."
        )
    if found.agrees:
        expected = f"{found.degrees} are expected, {found.limit:.4g} are the limit (chance {FALSE_ALARM:g})"
        return f"{what}, in agreement with the prior: {expected}."
    worst = int(np.argmax(together.innovations))
    return (
        f"{what} where {found.degrees} are expected and {found.limit:.4g} are the limit (chance {FALSE_ALARM:g}): "
        "the measurements contradict the prior, and the sigmas are not reliable. Look first at the measurement at "
        f"{moment(float(times[worst]))}, which contributes {together.innovations[worst]:.3g} given those before it."
    )


def combination(reading: MonitorReading, group: str, key: str) -> np.ndarray:
    """(4 x cameras,) what a change is made of: its unit per SI of all cameras' parameters, to first order.

    Parameters
    ----------
    reading : MonitorReading
        Of the instrument.
    group : str
        Whose change: a camera, or the group of what two read together.
    key : str
        Of the change.
    """
    found = quantities(reading.cameras, reading.ground)
    return next(quantity.row for quantity in found if (quantity.group, quantity.key) == (group, key))


def limits(reading: MonitorReading, one: Reading) -> tuple[str, float]:
    """What leaves most of the variance of a change's error, and its share: a body without the base, or NOISE.

    Parameters
    ----------
    reading : MonitorReading
        Of the instrument, under stated disturbances.
    one : Reading
        The change, as the judged estimator reads it.
    """
    stated = reading.disturbances
    assert stated is not None
    row, noise = combination(reading, one.group, one.parameter.key)[None], reading.recovery.shift_covariance[0]
    found = split(row, stated, noise, reading.gains[reading.judged])
    variances = {NOISE: found.noise, **Split.by(found.after, stated.bodies)}
    shares = {body: float(variance[0]) for body, variance in variances.items()}
    worst = max(shares, key=lambda body: shares[body])
    total = sum(shares.values())
    return worst.removeprefix(f"{BASE}/"), shares[worst] / total if total > 0.0 else 0.0


def share_text(share: float) -> str:
    """A share in per cent, for sentences."""
    return f"{plain(round(100.0 * share), 3)} %"
