"""What a turntable test gives: turntable.json, the main table, the report."""

from __future__ import annotations

from typing import TYPE_CHECKING

from optics.backend import Backend
from scenes.units import ANGLE, format_quantity
from twin.artefact import Table
from twin.laboratory.printed_004 import CHAUVENET_RMS_ARCSEC, FIT_RMS_ARCSEC, REPEAT_RMS_ARCSEC
from twin.laboratory.turntable import TurntableRun, run_turntable
from twin.laboratory.turntable_figure import FIT_NAMES
from twin.laboratory.turntable_sections import sections
from twin.trial.result import Advance, LabResult

if TYPE_CHECKING:
    from scenes.lab_setup import TurntableSetup


def run_turntable_test(setup: TurntableSetup, backend: Backend, seed: int, advance: Advance) -> LabResult:
    """Calibrate a drawn turntable and put the result together; nothing is traced, so that the backend is not used."""
    return turntable_result(run_turntable(setup.test, seed, lambda part: advance(part, 0, 1)))


def turntable_result(run: TurntableRun) -> LabResult:
    """Numbers, table and report of a turntable test."""
    data = run.to_dict()
    plan = run.spec.calibration
    chosen = data["chosen"]
    held = data["fits"][chosen]["heldout_rms_arcsec"]
    best = data["ranking"][0]
    also = "" if best == chosen else f" There the {FIT_NAMES[best]} is the best of the five."
    lead = (
        f"Repeats scatter by {data['repeat_rms_arcsec']:.3f}″ RMS at worst, {data['chauvenet_rms_arcsec']:.3f}″ after "
        f"Chauvenet's criterion. Cross-validation chooses the {FIT_NAMES[chosen]}, which misses held-out angles by "
        f"{held:.3f}″ RMS.{also}",
    )
    rows = [
        ("repeats, largest RMS of an angle", _text(data["repeat_rms_arcsec"]), _text(REPEAT_RMS_ARCSEC)),
        ("the same after Chauvenet's criterion", _text(data["chauvenet_rms_arcsec"]), _text(CHAUVENET_RMS_ARCSEC)),
        ("what averaging alone gives", _text(data["averaging_alone_rms_arcsec"]), ""),
    ]
    rows += [
        (
            f"{FIT_NAMES[name]} on held-out angles{', chosen' if name == chosen else ''}",
            _text(data["fits"][name]["heldout_rms_arcsec"]),
            f"below {FIT_RMS_ARCSEC:g}" if name == "network" else "",
        )
        for name in data["ranking"]
    ]
    return LabResult(
        "turntable",
        "Dividing error of the turntable",
        lead,
        (
            (
                "Calibration",
                f"{format_quantity(plan.first, ANGLE)} to {format_quantity(plan.last, ANGLE)} every "
                f"{format_quantity(plan.step, ANGLE)}, {plan.repeats} repeats",
            ),
            ("Description", run.spec.description),
        ),
        data,
        Table(
            "dividing-error",
            "Result",
            "Fits in the order of their RMS on held-out angles.",
            ("RMS", "here, arcsec", "paper 004, arcsec"),
            rows,
        ),
        sections(run),
    )


def _text(arcsec: float) -> str:
    return f"{arcsec:.3f}"
