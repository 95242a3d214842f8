"""The jobs that a study can vary, by name."""

from __future__ import annotations

from collections.abc import Callable

from scenes.yaml.errors import InputError, Issue
from twin.study.runs.base_job import BaseJob
from twin.study.runs.base_job import BenchBase


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
    from scenes.specs.lab_setup import FocusSetup, resolve_focus
    from twin.laboratory.focus_report import run_focus

    return BenchBase(FocusSetup, resolve_focus, run_focus)


def _distortion() -> BaseJob:
    from scenes.specs.lab_setup import DistortionSetup, resolve_distortion
    from twin.laboratory.distortion_report import run_distortion

    return BenchBase(DistortionSetup, resolve_distortion, run_distortion)


def _turntable() -> BaseJob:
    from scenes.specs.lab_setup import TurntableSetup, resolve_turntable
    from twin.laboratory.turntable_report import run_turntable_test

    return BenchBase(TurntableSetup, resolve_turntable, run_turntable_test)


def _angle() -> BaseJob:
    from scenes.specs.orbit_setup import AngleSetup, resolve_angle
    from twin.orbit.angle.angle_report import run_angle

    return BenchBase(AngleSetup, resolve_angle, run_angle)


def _calibrate() -> BaseJob:
    from scenes.specs.orbit_setup import CalibrationSetup, resolve_calibration
    from twin.orbit.calibration.calibration_report import run_calibration

    return BenchBase(CalibrationSetup, resolve_calibration, run_calibration)


def _monitor() -> BaseJob:
    from scenes.specs.orbit_setup import MonitorSetup, resolve_monitor
    from twin.orbit.monitoring.monitoring_report import run_monitor

    return BenchBase(MonitorSetup, resolve_monitor, run_monitor)


JOBS: dict[str, Callable[[], BaseJob]] = {
    "render": _render,
    "lab focus": _focus,
    "lab distortion": _distortion,
    "lab turntable": _turntable,
    "orbit angle": _angle,
    "orbit calibrate": _calibrate,
    "orbit monitor": _monitor,
}
"""As scenes.specs.study.BaseCommand names them -> the job. A test that ``twin.run.command.run_test`` runs needs no more
than its set-up, its ``resolve`` and its ``run``.
"""
