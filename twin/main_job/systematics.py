"""Systematic errors of the estimators, predicted from crosstalk tables; what sigmas include and what limits them."""

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
from twin.framework.artefact import plain, significant, unit_for_reports
from twin.main_job.monitor_reading import MonitorReading, contradicted
from twin.main_job.render_results import RenderRun
from twin.monitor.crosstalk import CameraCrosstalk
from twin.monitor.monitor_derivative import LOST, traced_states
from twin.monitor.reading_table import Reading
from twin.monitor.time_series import SmoothedCourse
from twin.monitor.truth import ElementaryMotion
from twin.uncertainty.monitor_limits import short_text, unit_text

_FAMILY = 4
"""Number of motions of a camera that the estimators of paper 001 (Wang et al. 2018) assume; they come first in a
crosstalk table."""
SHOWN = 1e-3
"""Smallest amount of a motion, in its table unit (arcsec, um, ppm or nm), that is reported."""


HEAT = "temperatures (expansion, bending, change of index)"
"""Text for the effects of temperatures, which have no motion of their own in a crosstalk table."""


@dataclass(frozen=True, eq=False)
class Systematics:
    """Systematic errors of one camera's estimates that the crosstalk tables predict from a run's motions.

    Attributes
    ----------
    bias : dict of str to (P,) ndarray
        Estimator -> estimate minus true change, to first order, of each of the camera's P changes, in its unit.
    outside : tuple of str
        Motions of this camera that the estimators of paper 001 (Wang et al. 2018) do not assume, as text with amounts.
    parts : dict of str to (P,) ndarray
        Motion, as text with its amount -> its contribution to the bias of the estimator that the verdict uses; motions
        of other cameras are included where that estimator uses all spots together.
    uncovered : tuple of str
        Bodies and effects that were perturbed but are not in the crosstalk table.
    """

    bias: dict[str, np.ndarray]
    outside: tuple[str, ...]
    parts: dict[str, np.ndarray]
    uncovered: tuple[str, ...]


def systematics(run: RenderRun, camera: str) -> Systematics:
    """Return the systematic errors of a camera's estimates: the crosstalk per unit times the motions of a run."""
    tables = run.crosstalk.items()
    amounts = {name: np.array([_amount(run, motion) for motion in table.motions]) for name, table in tables}
    k = list(run.crosstalk).index(camera)
    rows = slice(4 * k, 4 * k + 4)
    moved = np.concatenate([table.spot_shift @ amounts[name] for name, table in run.crosstalk.items()])
    table = run.crosstalk[camera]
    true = table.true @ amounts[camera]
    unit = rows_of(run.reading.cameras[camera])
    bias = {e: unit @ (gain[rows] @ moved) - true for e, gain in run.gains.items()}
    others = [i for i in range(_FAMILY, len(table.motions)) if abs(amounts[camera][i]) > SHOWN]
    outside = tuple(_motion_text(table.motions[i], amounts[camera][i]) for i in others)
    return Systematics(bias, outside, _parts(run, camera, amounts), _uncovered(run, camera, table))


def _parts(run: RenderRun, camera: str, amounts: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return motion -> error that it causes, for motions that the verdict's estimator does not model.

    ``amounts`` holds the amounts of the motions in the run's state.
    """
    names = list(run.crosstalk)
    k = names.index(camera)
    gain = rows_of(run.reading.cameras[camera]) @ run.gains[run.judged][4 * k : 4 * k + 4]
    # an estimator with a prior weighs all motions and reads none of them exactly
    modelled = 0 if run.estimators[run.judged].needs_prior else _FAMILY
    out: dict[tuple[str, str, int], tuple[str, np.ndarray]] = {}
    coordinates = {name: run.experiment.instrument.coordinates_of(name) for name in names}
    for name, table in run.crosstalk.items():
        for i, motion in enumerate(table.motions):
            if i < modelled or abs(amounts[name][i]) <= SHOWN:
                continue
            read = gain[:, coordinates[name]] @ table.spot_shift[:, i]
            part = (read - (table.true[:, i] if name == camera else 0.0)) * amounts[name][i]
            if not np.any(part):
                continue
            # a body that both cameras see is in both tables
            key = (motion.body, motion.kind, motion.axis)
            text = _motion_text(motion, amounts[name][i])
            text = text if name == camera or motion.body == CENTRAL_PRISM else f"{name}: {text}"
            before = out.get(key)
            out[key] = (text, part) if before is None else (before[0], before[1] + part)
    return dict(out.values())


def _motion_text(motion: ElementaryMotion, amount: float) -> str:
    return f"{motion.label}, {plain(float(amount), 4)} {unit_for_reports(motion.unit)}"


def _amount(run: RenderRun, elementary: ElementaryMotion) -> float:
    """Return the amount of an elementary motion in the run's state, in its table unit (arcsec, um, ppm or nm).

    Different pivots of rotation are accounted for to first order.
    """
    motion = run.state.get(elementary.body)
    if motion is None:
        return 0.0
    if elementary.kind == "shift":
        value = float(_shift_at(run, elementary.body, motion, elementary.pivot)[elementary.axis])
    else:
        value = motion.component(elementary.kind, elementary.axis)
    return value / elementary.unit_size


def _shift_at(run: RenderRun, body: str, motion: Motion, pivot: str) -> np.ndarray:
    """Return the shift, in metres, with which a body's rotation about another pivot is the same motion.

    It is computed to first order.
    """
    pivots = next(b for b in run.experiment.instrument.assembly.tree.bodies if b.path == body).pivots
    arm = np.array(pivots[motion.pivot]) - np.array(pivots[pivot])
    return np.asarray(np.array(motion.shift) - np.cross(motion.rotate, arm) - motion.scale * arm)


def _uncovered(run: RenderRun, camera: str, table: CameraCrosstalk) -> tuple[str, ...]:
    """Return the bodies that moved and affect this camera, but whose motions are not in the crosstalk table."""
    camera_body = f"{BASE}/{camera}"
    bodies = {motion.body for motion in table.motions}
    uncovered = []
    perturbations = run.resolved.job.perturb
    for path, motion in run.state.items():
        parts = f"{camera_body}/", f"{CENTRAL_PRISM}/{camera}_"
        if path not in (camera_body, CENTRAL_PRISM) and not path.startswith(parts):
            continue
        deformed = path in perturbations and perturbations[path].deformation is not None
        if (motion.expansion and not deformed) or motion.index or any(motion.index_gradient):
            uncovered.append(HEAT)
        if path not in perturbations:
            continue
        if path not in bodies and (any(motion.rotate) or any(motion.shift) or motion.scale):
            uncovered.append(path)
        if perturbations[path].heat.table is not None:
            continue
        covered = {m.axis for m in table.motions if m.body == path and m.kind == "figure"}
        missing = [f"Z{j}" for j, amplitude in motion.figure.items() if amplitude and j not in covered]
        if deformed:
            missing = ["of a table of nodes"]
        if missing:
            uncovered.append(f"{path} (figure {', '.join(missing)})")
    return tuple(uncovered)


def joined(names: Sequence[str]) -> str:
    """Return names as ``a; b; c``, each only once."""
    return "; ".join(dict.fromkeys(names))


UNNOTICED_SIGMAS = 4.0
"""Smallest error of an estimate, in sigmas, for which a warning says that the spots do not show it.

A random motion from the prior itself causes as much in one of 20 000 runs.
"""


def unobserved_perturbations(run: RenderRun) -> tuple[str, ...]:
    """Return a warning for each perturbed body that falsifies estimates without moving the spots noticeably.

    The effect of that body's perturbation alone on spots and cameras is traced; the change of the camera is compared
    with the estimate from these spots.

    Parameters
    ----------
    run : RenderRun
        Run of a state, or of a time series, whose shown time is used.
    """
    job, noise = run.resolved.job, run.recovery.shift_covariance[0]
    shown = None if run.series is None else run.series.shown
    if not np.any(noise):
        return ()
    moved = {path: motion for path, motion in motions_of(job, shown).items() if motion != Motion(pivot=motion.pivot)}
    if not moved:
        return ()
    try:
        traced = traced_states(run.experiment.path, run.experiment.sight, [{path: m} for path, m in moved.items()])
    except LOST:
        # the body may keep its light together with others; moved alone, no statement is possible
        return ()
    reading, prior = run.reading, run.reading.disturbances
    gain = run.gains[run.judged]
    all_quantities = quantities(reading.cameras, reading.ground)
    rows = np.stack([quantity.row for quantity in all_quantities])
    sigma = _sigmas(rows, prior, noise, gain)
    covariance = noise if prior is None else prior.spot_covariance + noise
    limit = float(limit_of(FALSE_ALARM, len(noise))) - len(noise)
    warnings = []
    for path, shift, true in zip(moved, traced.spots, traced.parameters, strict=True):
        errors = rows @ (gain @ shift - true)
        sigmas_off = np.abs(errors) / np.where(sigma > 0.0, sigma, np.inf)
        worst = int(np.argmax(sigmas_off))
        largest_shift = float(np.max(np.abs(shift) / np.sqrt(np.diag(noise))))
        chi_square = float(shift @ np.linalg.solve(covariance, shift))
        if sigmas_off[worst] < UNNOTICED_SIGMAS or (
            largest_shift > UNNOTICED_SIGMAS if prior is None else chi_square > limit
        ):
            continue
        how = "moves no spot beyond its noise" if largest_shift < 1.0 else "moves the spots as more probable motions do"
        unit = unit_text(all_quantities[worst])
        is_, read = (significant(float(rows[worst] @ value), 3) for value in (true, gain @ shift))
        warnings.append(
            f"{path}: its perturbation {how}; {short_text(all_quantities[worst])} changes by {is_} {unit} but is read "
            f"as {read} {unit}, an error of {sigmas_off[worst]:.1f} σ; neither σ nor the test of the shifts can show "
            "this: for this body σ depends on the prior alone"
        )
    return tuple(warnings)


def _sigmas(rows: np.ndarray, prior: Disturbances | None, noise: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Return the standard deviations of the estimates of Q quantities, (Q,), due to noise and the prior.

    Parameters
    ----------
    rows : ndarray
        Coefficients of the Q quantities on the parameters of all cameras.
    prior : Disturbances or None
        Prior; None if there is none.
    noise : ndarray
        Covariance of the spot shifts, px^2.
    gain : ndarray
        Linear map of the estimator from spot shifts to camera parameters.
    """
    if prior is not None:
        return split(rows, prior, noise, gain).sigma
    return np.sqrt(np.einsum("qd,de,qe->q", rows @ gain, noise, rows @ gain))


_NOISE_ALONE = "There is no prior on disturbances: σ contains the noise of the images only"
"""Sentence, without a full stop, which says for runs without a prior that sigma contains only the noise."""
NOISE = "the noise of the images"
"""Name, among the contributions to the variance, of the noise of the images, which more frames reduce."""


def assumed(reading: MonitorReading) -> str:
    """Return what the sigmas include and whether the spot shifts agree with it, as a sentence without a full stop."""
    prior, test = reading.disturbances, reading.consistency
    if prior is None or test is None:
        return _NOISE_ALONE
    agree = "agree with it" if test.agrees else "contradict it"
    return (
        f"σ: noise and the prior {prior.name}; the shifts {agree} (chi-square "
        f"{significant(test.chi_square)} for {test.degrees} degrees of freedom, limit {test.limit:.1f} at a "
        f"false-alarm rate of {test.false_alarm:g}){_prior_share_text(reading)}"
    )


def _prior_share_text(reading: MonitorReading) -> str:
    """Return the shares of the posterior's variances that are due to the prior, and what they mean, as text."""
    shares = [share for group in reading.from_statement.values() for share in group.values() if share is not None]
    if not shares:
        return ""
    ends = list(dict.fromkeys(plain(math.floor(1e3 * end) / 10.0, 4) for end in (min(shares), max(shares))))
    text = (
        f"; {' to '.join(ends)} % of the posterior variances comes from motions that the spots cannot separate: these "
        "sigmas are only as good as the prior, and more frames do not reduce them"
    )
    if reading.repeats_prior:
        text += f"; the spots do not measure {', '.join(reading.repeats_prior)}: these numbers repeat the prior"
    return text


def contradiction(run: RenderRun) -> tuple[str, ...]:
    """Return a warning where the spot shifts of a time series contradict the prior at the worst of its times.

    For a single state this is among the doubts of its `MonitorReading`.
    """
    if run.worst_of_course is None or run.series is None:
        return ()
    k, test = run.worst_of_course
    when = f" at {moment(float(run.series.times[k]))}, the worst of {len(run.series.times)} times"
    return contradicted(run.experiment.disturbances, test, when, f"{FALSE_ALARM:g} for the course")


def doubted(run: RenderRun) -> tuple[str, ...]:
    """Return warnings about spots unlike their calibration and about nonlinear estimates.

    For a time series they are those of its worst time.
    """
    if run.series is None:
        return (*run.reading.doubts, *run.reading.notes)
    return run.series.doubts(["/".join(channel) for channel in run.reading.channels])


def course_agrees(together: SmoothedCourse, times: np.ndarray) -> str:
    """Return sentences on the agreement of all measurements of a time series with the prior and its time laws.

    Parameters
    ----------
    together : SmoothedCourse
        Smoothed time series.
    times : (T,) ndarray
        The T times of its measurements, in seconds.
    """
    return " ".join((_series_agrees(together, times), *_jump_sentences(together)))


def _jump_sentences(together: SmoothedCourse) -> tuple[str, ...]:
    """Return sentences on detected jumps, or that there are none; empty where the prior has no jumps."""
    if together.jumps is None:
        return ()
    if not together.jumps:
        return (f"No jump was detected (false-alarm probability at most {together.jump_false_alarm:g}).",)
    return tuple(f"The series shows that {text}." for text in together.jump_texts())


def _series_agrees(together: SmoothedCourse, times: np.ndarray) -> str:
    test = together.consistency
    what = f"Chi-square of all {len(times)} measurements is {test.chi_square:.4g}"
    if test.p_value > 1.0 - FALSE_ALARM:
        return (
            f"{what} for {test.degrees} degrees of freedom: the motions are smaller than the prior expects, and the "
            "sigmas are too large."
        )
    if test.agrees:
        limit = f"limit {test.limit:.4g} at a false-alarm rate of {FALSE_ALARM:g}"
        return f"{what} for {test.degrees} degrees of freedom, in agreement with the prior ({limit})."
    worst = int(np.argmax(together.innovations))
    return (
        f"{what} for {test.degrees} degrees of freedom (limit {test.limit:.4g} at a false-alarm rate of "
        f"{FALSE_ALARM:g}): the measurements contradict the prior, and the sigmas are not reliable. Look first at the "
        f"measurement at {moment(float(times[worst]))}, which contributes {together.innovations[worst]:.3g} given "
        "those before it."
    )


def combination(reading: MonitorReading, group: str, key: str) -> np.ndarray:
    """Return the coefficients of a change on the parameters of all cameras, (4 x cameras,), and its unit in SI.

    The change is a linear combination of the parameters, to first order.

    Parameters
    ----------
    reading : MonitorReading
        Estimated changes of the instrument.
    group : str
        Camera of the change, or the group of a quantity of two cameras.
    key : str
        Key of the change.
    """
    all_quantities = quantities(reading.cameras, reading.ground)
    return next(quantity.row for quantity in all_quantities if (quantity.group, quantity.key) == (group, key))


def limits(reading: MonitorReading, change: Reading) -> tuple[str, float]:
    """Return the largest source of a change's error variance (a body, or NOISE) and its fraction of the variance.

    Parameters
    ----------
    reading : MonitorReading
        Estimated changes of the instrument, with a prior.
    change : Reading
        The change, as estimated by the estimator that the verdict uses.
    """
    prior = reading.disturbances
    assert prior is not None
    row, noise = combination(reading, change.group, change.parameter.key)[None], reading.recovery.shift_covariance[0]
    variance_split = split(row, prior, noise, reading.gains[reading.judged])
    variances = {NOISE: variance_split.noise, **Split.by(variance_split.after, prior.bodies)}
    shares = {body: float(variance[0]) for body, variance in variances.items()}
    worst = max(shares, key=lambda body: shares[body])
    total = sum(shares.values())
    return worst.removeprefix(f"{BASE}/"), shares[worst] / total if total > 0.0 else 0.0


def share_text(share: float) -> str:
    """Return a fraction as text in per cent, for sentences."""
    return f"{plain(round(100.0 * share), 3)} %"
