"""The jobs that a study can vary, by name."""

from __future__ import annotations

from collections.abc import Callable

from scenes.yaml.errors import InputError, Issue
from twin.study.runs.base_job import BaseJob, ProcedureBase


def base_job(command: str) -> BaseJob:
    """The job of that name.

    Raises:
        InputError: this version of the twin does not have it.
    """
    try:
        return JOBS[command]()
    except (ImportError, KeyError) as error:
        issue = Issue(f"this version of the twin cannot run {command!r} in a study", allowed=", ".join(JOBS))
        raise InputError(issue) from error


# A study imports only what its own base needs: a worker then starts in half the time.
def _render() -> BaseJob:
    from twin.study.runs.render_base import RenderBase

    return RenderBase()


def _focus() -> BaseJob:
    from twin.laboratory.focus_numbers import FOCUS

    return ProcedureBase(FOCUS)


def _distortion() -> BaseJob:
    from twin.laboratory.distortion_numbers import DISTORTION

    return ProcedureBase(DISTORTION)


def _turntable() -> BaseJob:
    from twin.laboratory.turntable_numbers import TURNTABLE

    return ProcedureBase(TURNTABLE)


def _angle() -> BaseJob:
    from twin.orbit.angle.angle_numbers import ANGLE

    return ProcedureBase(ANGLE)


def _calibrate() -> BaseJob:
    from twin.orbit.calibration.calibration_numbers import CALIBRATION

    return ProcedureBase(CALIBRATION)


def _monitor() -> BaseJob:
    from twin.orbit.monitoring.monitoring_numbers import MONITOR

    return ProcedureBase(MONITOR)


JOBS: dict[str, Callable[[], BaseJob]] = {
    "render": _render,
    "lab focus": _focus,
    "lab distortion": _distortion,
    "lab turntable": _turntable,
    "orbit angle": _angle,
    "orbit calibrate": _calibrate,
    "orbit monitor": _monitor,
}
"""As scenes.specs.study.BaseCommand names them -> the job. A test needs no more than its
`twin.run.procedure.Procedure`.
"""
