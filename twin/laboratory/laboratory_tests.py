"""The tests of the laboratory by name, for the command and for scripts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twin.run.command import Export, Test


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


def _export_focus() -> Export[Any]:
    from twin.laboratory.export import export_focus

    return export_focus


def _export_distortion() -> Export[Any]:
    from twin.laboratory.export import export_distortion

    return export_distortion


def _export_turntable() -> Export[Any]:
    from twin.laboratory.export import export_turntable

    return export_turntable


LABORATORY_EXPORTS: dict[str, Callable[[], Export[Any]]] = {
    "focus": _export_focus,
    "distortion": _export_distortion,
    "turntable": _export_turntable,
}
"""Subcommand -> imports what writes its simulated measurements as files."""
