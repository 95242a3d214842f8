"""The tests of the laboratory by name, for the command and for scripts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from twin.run.procedure import Test


def _focus() -> Test[Any]:
    from twin.laboratory.focus_measured_report import measured_focus_report
    from twin.laboratory.focus_numbers import FOCUS
    from twin.laboratory.focus_report import focus_report
    from twin.laboratory.measured_focus import MeasuredAlignment

    return FOCUS, lambda run: measured_focus_report(run) if isinstance(run, MeasuredAlignment) else focus_report(run)


def _distortion() -> Test[Any]:
    from twin.laboratory.distortion_measured_report import measured_distortion_report
    from twin.laboratory.distortion_numbers import DISTORTION
    from twin.laboratory.distortion_report import distortion_report
    from twin.laboratory.distortion_run import MeasuredDistortion

    return (
        DISTORTION,
        lambda run: measured_distortion_report(run) if isinstance(run, MeasuredDistortion) else distortion_report(run),
    )


def _turntable() -> Test[Any]:
    from twin.laboratory.turntable_measured_report import measured_turntable_report
    from twin.laboratory.turntable_numbers import TURNTABLE
    from twin.laboratory.turntable_report import turntable_report
    from twin.laboratory.turntable_run import MeasuredTurntable

    return (
        TURNTABLE,
        lambda run: measured_turntable_report(run) if isinstance(run, MeasuredTurntable) else turntable_report(run),
    )


LABORATORY_TESTS: dict[str, Callable[[], Test[Any]]] = {
    "focus": _focus,
    "distortion": _distortion,
    "turntable": _turntable,
}
"""Subcommand -> imports what runs the test and what shows it; only the test that is asked for is imported."""


def export_focus(run: Any) -> Mapping[str, str | bytes]:
    """Files with what the simulated bench of an alignment measured."""
    from twin.laboratory import export

    return export.export_focus(run)


def export_distortion(run: Any) -> Mapping[str, str | bytes]:
    """Files with what the simulated bench of a distortion test measured."""
    from twin.laboratory import export

    return export.export_distortion(run)


def export_turntable(run: Any) -> Mapping[str, str | bytes]:
    """Files with what the simulated bench of a turntable test measured."""
    from twin.laboratory import export

    return export.export_turntable(run)
