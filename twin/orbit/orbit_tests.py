"""The tests in orbit by name, for the command and for scripts."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from twin.run.procedure import Test

if TYPE_CHECKING:
    from twin.run.report import Report


def _angle() -> Test[Any]:
    from twin.orbit.angle.angle_numbers import ANGLE
    from twin.orbit.angle.angle_report import angle_report
    from twin.orbit.angle.measured_angle import MeasuredAngleRun
    from twin.orbit.angle.measured_angle_report import measured_angle_report

    def report(run: Any) -> Report:
        return measured_angle_report(run) if isinstance(run, MeasuredAngleRun) else angle_report(run)

    return ANGLE, report


def _calibrate() -> Test[Any]:
    from twin.orbit.calibration.calibration_numbers import CALIBRATION
    from twin.orbit.calibration.calibration_report import calibration_report

    return CALIBRATION, calibration_report


def _check() -> Test[Any]:
    from twin.orbit.conventions.check_numbers import CHECK
    from twin.orbit.conventions.check_report import check_report

    return CHECK, check_report


def _match() -> Test[Any]:
    from twin.orbit.matching.match_numbers import MATCH
    from twin.orbit.matching.match_report import match_report

    return MATCH, match_report


def _monitor() -> Test[Any]:
    from twin.orbit.monitoring.monitoring_numbers import MONITOR
    from twin.orbit.monitoring.monitoring_report import monitor_report

    return MONITOR, monitor_report


def _simulate() -> Test[Any]:
    from twin.orbit.images.simulate_numbers import SIMULATE
    from twin.orbit.images.simulate_report import simulation_report

    return SIMULATE, simulation_report


ORBIT_TESTS: dict[str, Callable[[], Test[Any]]] = {
    "angle": _angle,
    "calibrate": _calibrate,
    "check": _check,
    "match": _match,
    "monitor": _monitor,
    "simulate": _simulate,
}
"""Subcommand -> imports what runs the test and what shows it; only the test that is asked for is imported."""
