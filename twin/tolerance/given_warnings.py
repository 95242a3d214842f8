"""What the user should know of the instrument that a tolerance budget is given, as other commands tell it: cameras that
are not sharp, own parts in a beam of which the file does not say so, coarse grey values, and bodies that motions bring
into beams of the monitor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from optics.geometry.tree import State
from scenes.models.camera_sharpness import blur_warnings
from scenes.models.obstruction import moved_into_beams
from scenes.specs.tolerance import ToleranceSetup
from twin.camera.first_order_data import obscuration, unstated_shadows
from twin.sensors.area_detector import coarse_warnings
from twin.tolerance.tolerance_bench import ToleranceBench

FAR = 1e-3
"""Relative difference of a monitor's sigma that is warned of."""


def given_warnings(setup: ToleranceSetup, bench: ToleranceBench) -> tuple[str, ...]:
    """Of the instrument as designed.

    Parameters
    ----------
    setup : ToleranceSetup
        The budget.
    bench : ToleranceBench
        Of it.
    """
    model = bench.optics.model
    shadow = unstated_shadows(model, obscuration(model, bench.backend))
    return (
        *blur_warnings(setup.base, bench.backend),
        *((f"camera {model.spec.name}: {shadow}",) if shadow else ()),
        *(coarse_warnings(setup.base) if bench.experiment.monitored else ()),
    )


def beam_warnings(bench: ToleranceBench, states: Sequence[State]) -> tuple[str, ...]:
    """Of bodies that stand in beams of the monitor in some states, each body and beam once.

    Parameters
    ----------
    bench : ToleranceBench
        Of the budget.
    states : Sequence[State]
        The worst cameras.
    """
    found: dict[str, list[str]] = {}
    for state in states:
        for text in moved_into_beams(bench.instrument, bench.backend, state):
            found.setdefault(text.partition(" and would take")[0], []).append(text)
    return tuple(
        f"in {len(texts)} of the {len(states)} worst cameras, {texts[0]}" for _, texts in sorted(found.items())
    )


def missed_warnings(missed: Mapping[str, float], cameras: int) -> tuple[str, ...]:
    """Of monitor merits whose interpolated derivatives are too coarse.

    Parameters
    ----------
    missed : Mapping[str, float]
        Name of a merit -> relative difference of its sigmas from those with traced derivatives.
    cameras : int
        In which they were traced.
    """
    return tuple(
        f"{name}: with derivatives traced in {cameras} cameras the sigma differs by up to {100.0 * off:.2g} % from "
        "that with interpolated ones; use smaller limits, or twin.uncertainty on a job of one camera"
        for name, off in missed.items()
        if off > FAR
    )
