"""Warnings about the instrument of a tolerance budget that other commands give too.

They concern cameras that are not sharp, parts of the instrument in a beam that the file does not model as obstructions,
coarse grey values, and bodies that move into beams of the monitor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from optics.geometry.tree import State
from scenes.models.camera_sharpness import blur_warnings
from scenes.models.obstruction import moved_into_beams
from scenes.specs.tolerance import ToleranceSetup
from twin.camera.first_order_data import obscuration, unmodelled_obscuration
from twin.sensors.area_detector import coarse_warnings
from twin.tolerance.tolerance_bench import ToleranceBench

FAR = 1e-3
"""Relative error of a monitor's sigma due to interpolated derivatives above which a warning is given."""


def instrument_warnings(setup: ToleranceSetup, bench: ToleranceBench) -> tuple[str, ...]:
    """Return the warnings about the nominal instrument, such as unsharp cameras or parts in a beam."""
    model = bench.optics.model
    shadow = unmodelled_obscuration(model, obscuration(model, bench.backend))
    return (
        *blur_warnings(setup.base, bench.backend),
        *((f"camera {model.spec.name}: {shadow}",) if shadow else ()),
        *(coarse_warnings(setup.base) if bench.experiment.monitored else ()),
    )


def beam_warnings(bench: ToleranceBench, states: Sequence[State]) -> tuple[str, ...]:
    """Return warnings about bodies that block monitor beams in some random cameras, once for each body and beam.

    Parameters
    ----------
    bench : ToleranceBench
        Camera of the budget with its varied parameters, compensators and merits.
    states : sequence of State
        States of the worst cameras.
    """
    texts_by_body: dict[str, list[str]] = {}
    for state in states:
        for text in moved_into_beams(bench.instrument, bench.backend, state):
            texts_by_body.setdefault(text.partition(" and would take")[0], []).append(text)
    return tuple(
        f"in {len(texts)} of the {len(states)} worst cameras, {texts[0]}" for _, texts in sorted(texts_by_body.items())
    )


def interpolation_warnings(errors: Mapping[str, float], cameras: int) -> tuple[str, ...]:
    """Return warnings about monitor merits for which interpolated derivatives are too inaccurate.

    Parameters
    ----------
    errors : dict
        Name of a merit -> relative difference of its sigma from that with traced derivatives.
    cameras : int
        Number of cameras in which the derivatives were traced.
    """
    return tuple(
        f"{name}: with derivatives traced in {cameras} cameras the sigma differs by up to {100.0 * error:.2g} % from "
        "that with interpolated ones; use smaller limits, or twin.uncertainty on a job of one camera"
        for name, error in errors.items()
        if error > FAR
    )
