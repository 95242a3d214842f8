"""What a run's sigmas rest on, whether its shifts agree with that, and which body limits what it reads."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.monitor.disturbances import FALSE_ALARM, Consistency
from analysis.monitor.ground_error import AXES
from analysis.monitor.monitoring import PARAMETERS as KEYS
from analysis.monitor.monitoring import PER_SI
from scenes.specs.channel import BASE
from scenes.specs.course import moment
from twin.main_job.render_results import RenderRun
from twin.main_job.report_labels import ANGLE, GROUND, Parameter
from twin.run.artefact import plain, significant

__all__ = ["NOISE", "NOISE_ALONE", "assumed", "combination", "contradiction", "limits", "share_text", "shares_by_body"]

NOISE_ALONE = "No disturbances are stated: σ is that of the noise of the images alone"
"""Without a sentence's end."""
NOISE = "the noise of the images"
"""How the part of the variance is called that more frames lower."""


def assumed(run: RenderRun) -> str:
    """What the sigmas assume, and whether the measured shifts agree with it; a sentence without its end."""
    stated, found = run.experiment.disturbances, run.consistency
    if stated is None or found is None:
        return NOISE_ALONE
    agree = "agree with them" if found.agrees else "contradict them"
    return (
        f"σ: noise and the stated disturbances {stated.name}; the shifts {agree} (chi-square "
        f"{significant(found.chi_square)} of {found.degrees} coordinates, limit {found.limit:.1f}, false-alarm rate "
        f"{found.false_alarm:g})"
    )


def contradiction(run: RenderRun) -> tuple[str, ...]:
    """A warning where the measured shifts contradict what is stated to move; of a course at the worst of its times."""
    stated, found, when = run.experiment.disturbances, run.consistency, ""
    if run.worst_of_course is not None and run.series is not None:
        k, found = run.worst_of_course
        when = f" at {moment(float(run.series.times[k]))}, the worst of {len(run.series.times)} times"
    if stated is None or found is None or found.agrees:
        return ()
    rate = f"{FALSE_ALARM:g}" if run.series is None else f"{FALSE_ALARM:g} for the course"
    return (
        f"the shifts of the spots contradict the stated disturbances {stated.name}{when}: chi-square "
        f"{significant(found.chi_square)} of {found.degrees} coordinates where {found.limit:.1f} is exceeded with a "
        f"chance of {rate}{_suspected(found, stated.bodies)}; σ does not hold for this measurement",
    )


def _suspected(found: Consistency, stated: Sequence[str]) -> str:
    if not found.suspects:
        return ""
    first = found.suspects[0]
    times = significant(first.times, 2)
    if first.body in stated:
        return (
            f"; motions of {first.body} would explain them best, if the standard deviations stated for it were "
            f"{times} times as large"
        )
    return (
        f"; motions of {first.body}, of which nothing is stated, would explain them best, with standard deviations of "
        f"some {times} µm, arcsec, ppm and nm"
    )


def combination(run: RenderRun, camera: str, parameter: Parameter) -> np.ndarray:
    """(4 x cameras,) what a change is made of: its unit per SI of all cameras' parameters, to first order.

    Args:
        run: the run.
        camera: whose change; empty for the angle and the ground.
        parameter: which.
    """
    names = list(run.experiment.instrument.cameras)
    out = np.zeros(4 * len(names))
    if camera:
        k = KEYS.index(parameter.key)
        out[4 * names.index(camera) + k] = PER_SI[k]
    elif parameter == ANGLE:
        ahead, behind = sorted(names, key=lambda name: -run.experiment.cameras[name].look_rad)
        out[4 * names.index(ahead)], out[4 * names.index(behind)] = PER_SI[0], -PER_SI[0]
    else:
        ground = run.experiment.ground
        assert ground is not None
        first, second = (run.experiment.cameras[name].geometry.focal_length_m for name in names)
        rows = ground.rows((first, second))
        out[:] = rows[len(rows) // 2, AXES.index(GROUND[GROUND.index(parameter)].symbol)]
    return out


def limits(run: RenderRun, camera: str, parameter: Parameter) -> tuple[str, float]:
    """What the judged estimator leaves most of the variance of a change's error to, and its share: a body without the
    base, or NOISE. Arguments as of `combination`.
    """
    row = combination(run, camera, parameter)
    gain = run.gains[run.judged]
    seen = row @ gain
    shares = {NOISE: float(seen @ run.recovery.shift_covariance[0] @ seen)}
    stated = run.experiment.disturbances
    if stated is not None:
        shares |= shares_by_body(row @ stated.error_root(gain), stated.bodies)
    worst = max(shares, key=lambda body: shares[body])
    total = sum(shares.values())
    return worst.removeprefix(f"{BASE}/"), shares[worst] / total if total > 0.0 else 0.0


def shares_by_body(left: np.ndarray, bodies: Sequence[str]) -> dict[str, float]:
    """Body -> variance that its motions leave in an estimate, the square of the unit of ``left``.

    Args:
        left: (M,) errors by one standard deviation of each motion, independent of each other: a row of
            `Disturbances.error_root`.
        bodies: (M,) whose motions they are.
    """
    out: dict[str, float] = {}
    for body, error in zip(bodies, left, strict=True):
        out[body] = out.get(body, 0.0) + float(error) ** 2
    return out


def share_text(share: float) -> str:
    """As sentences say it."""
    return f"{plain(round(100.0 * share), 3)} %"
