"""What a run's sigmas rest on, whether its shifts agree with that, and which body limits what it reads."""

from __future__ import annotations

import math

import numpy as np

from analysis.monitor.disturbances import FALSE_ALARM
from analysis.monitor.limits import Split, quantities, split
from scenes.specs.course import moment
from scenes.specs.instrument import BASE
from twin.framework.artefact import plain, significant
from twin.main_job.monitor_reading import MonitorReading, contradicted
from twin.main_job.render_results import RenderRun
from twin.monitor.reading_table import Reading
from twin.monitor.time_series import SmoothedCourse

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

    Args:
        together: the course.
        times: of its measurements, seconds.
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

    Args:
        reading: of the instrument.
        group: whose change: a camera, or the group of what two read together.
        key: of the change.
    """
    found = quantities(reading.cameras, reading.ground)
    return next(quantity.row for quantity in found if (quantity.group, quantity.key) == (group, key))


def limits(reading: MonitorReading, one: Reading) -> tuple[str, float]:
    """What leaves most of the variance of a change's error, and its share: a body without the base, or NOISE.

    Args:
        reading: of the instrument, under stated disturbances.
        one: the change, as the judged estimator reads it.
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
