"""Area CCDs whose noise is less than their grey values' steps: what a user should know of them."""

from __future__ import annotations

import math

from analysis.spots.noise import NoiseModel
from analysis.spots.rounding import COARSE, FEW, WHOLE
from scenes.specs.detector import DetectorSpec
from scenes.specs.instrument import InstrumentSpec
from scenes.yaml.spec import Spec
from twin.sensors.area_detector import EmvaDetector

__all__ = ["coarse_warnings", "told_of_steps"]


def told_of_steps(noise: NoiseModel, whose: str) -> tuple[str, ...]:
    """A warning for a detector whose noise does not spread over the steps of its grey values where there are few DN of
    light; none for others. It depends on the detector's numbers alone, and nothing is drawn.

    Args:
        noise: of the detector.
        whose: how a reader knows it.
    """
    few = float(noise.frame_variance_dn2(noise.dark_level_dn + FEW)) - WHOLE
    if few >= COARSE**2:
        return ()
    return (
        f"{whose} has coarse grey values: noise of {math.sqrt(few):.2g} DN at {FEW:g} DN of light, less than "
        f"{COARSE:g}; there rounding is the same in every frame, does not average down and is alike in neighbouring "
        "pixels, while σ takes it for another one in each; a larger system_gain_dn_per_e, with the bit_depth for it, "
        "makes the steps finer",
    )


def coarse_warnings(setup: Spec) -> tuple[str, ...]:
    """The same for the area CCDs of an instrument among what a job or test refers to; none where it has no instrument.

    Args:
        setup: a job or test with all it refers to.

    Raises:
        InputError: as `EmvaDetector.from_sheet`.
    """
    instrument, sheet = getattr(setup, "instrument", None), getattr(setup, "detector", None)
    if not isinstance(instrument, InstrumentSpec) or not isinstance(sheet, DetectorSpec):
        return ()
    exposure = instrument.monitor.area_ccd.exposure
    chosen = {sheet.name: sheet, **{one.name: one for one in getattr(setup, "detectors", {}).values()}}
    out: list[str] = []
    for name, one in chosen.items():
        out += told_of_steps(EmvaDetector.from_sheet(one, exposure).noise_model(exposure), f"area CCD {name}")
    return tuple(out)
