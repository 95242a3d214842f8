"""What the tests of the laboratory take of memory and time, from what their files say."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from analysis.turntable.angle_network import RESTARTS
from optics.numerics.threads import cores
from scenes.specs.resolved import DistortionSetup, FocusSetup, TurntableSetup
from twin.run.cost import Cost, Lowered

if TYPE_CHECKING:
    from scenes.specs.resolved import ExperimentSetup

GREY = 2.0
"""Bytes per pixel of a recorded frame."""
FOCUS_STARTED, FOCUS_SECONDS = 370e6, 5.0
"""Of an alignment with few sites and frames: kernels, and what draws the report; bytes and seconds."""
SITE_SECONDS, EXPOSURE_SECONDS, EXPOSED_SECONDS = 0.88, 0.0186, 1e-7
"""Seconds of a place and band for the tables of its optics, of the image of an edge with its measurement, and per pixel
of its frames.
"""
EDGE_PIXEL = 57.0
"""Bytes per pixel of the frames of an edge while they are exposed and measured, in each thread."""
_DIRECTIONS = 2


def focus_cost(setup: ExperimentSetup[Any]) -> Cost:
    """What `run_focus` and its report take; of measured series the least.

    Args:
        setup: the test.
    """
    if not isinstance(setup, FocusSetup):
        return Cost(FOCUS_STARTED, FOCUS_SECONDS)
    test, camera = setup.test, setup.camera
    sites = len(camera.bands) * len(test.fields)
    region = test.edge.region**2
    exposures = _DIRECTIONS * sites * (test.scan.points * (test.rounds + 1) + test.rounds)
    for band in camera.bands.values():
        # as `focus_scan` looks for the peak
        zero = 1.22 * camera.focal_length / camera.entrance_pupil * 2.0 * band.pitch
        exposures += len(test.fields) * (2 * math.ceil(test.scan.reach / max(test.scan.step, 0.5 * zero)) + 1)

    def needed(frames: int) -> float:
        kept = _DIRECTIONS * sites * test.rounds * GREY
        return FOCUS_STARTED + frames * region * (kept + cores() * EDGE_PIXEL)

    seconds = sites * SITE_SECONDS + exposures * (EXPOSURE_SECONDS + test.frames * region * EXPOSED_SECONDS)
    lower = Lowered(test, ("frames",), test.frames, "frames", needed)
    return Cost(needed(test.frames), FOCUS_SECONDS + seconds, lower)


DISTORTION_STARTED, DISTORTION_SECONDS = 245e6, 4.7
"""Of a test of few points and sets; bytes and seconds."""
SPOT_PIXEL, SPOT_SECONDS = 33.0, 1.1e-3
"""Bytes per pixel of the mean image of a spot, and seconds of a spot beside its frames."""


def distortion_cost(setup: ExperimentSetup[Any]) -> Cost:
    """What `run_distortion` and its report take; of measured spots the least.

    Args:
        setup: the test.
    """
    if not isinstance(setup, DistortionSetup):
        return Cost(DISTORTION_STARTED, DISTORTION_SECONDS)
    test = setup.test
    window = test.window**2

    def needed(sets: int) -> float:
        return DISTORTION_STARTED + test.points * sets * window * (test.frames * GREY + SPOT_PIXEL)

    spots = test.points * test.sets
    seconds = spots * (SPOT_SECONDS + test.frames * window * EXPOSED_SECONDS)
    lower = Lowered(test, ("sets",), test.sets, "sets", needed)
    return Cost(needed(test.sets), DISTORTION_SECONDS + seconds, lower)


TURNTABLE_STARTED, TURNTABLE_SECONDS = 290e6, 5.0
"""Of a calibration without its network; bytes and seconds."""
TRAINING_SECONDS = 1.6
"""Seconds of one training of the network, which takes nearly all of the time. It goes on until it has come to a
minimum, so that it took 0.6 to 2.2 s.
"""


def turntable_cost(setup: ExperimentSetup[Any]) -> Cost:
    """What `run_turntable_test` and its report take; of measured comparisons the least. The network is trained for
    every fold of the cross-validation, and for all angles.

    Args:
        setup: the test.
    """
    if not isinstance(setup, TurntableSetup):
        return Cost(TURNTABLE_STARTED, TURNTABLE_SECONDS)
    trainings = RESTARTS * (setup.test.calibration.folds + 1)
    return Cost(TURNTABLE_STARTED, TURNTABLE_SECONDS + trainings * TRAINING_SECONDS)
