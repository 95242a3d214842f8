"""Numbers of paper 004 as printed (Li et al., Infrared and Laser Engineering, doi 10.3788/IRLA20200143).

Lengths in micrometres, angles in arcseconds, where a name says so.
"""

from __future__ import annotations

from collections.abc import Mapping

from optics.numerics.frozen_map import FrozenMap

MTF_NYQUIST: Mapping[str, float] = FrozenMap({"P": 0.2, "B1": 0.36, "B2": 0.36, "B3": 0.37, "B4": 0.36})
"""Table 1: average MTF of the backward camera in each band."""

CONFOCAL_UM = 40.0
"""All line CCDs lie within plus or minus this of one focus."""
LINE_LEVEL_ARCMIN = 1.0
"""The lines are level within plus or minus this."""

REGION_DEG = (92.0, 112.0)
"""Turntable angles over which the dividing error was calibrated."""
REGION_STEP_DEG = 0.5
REPEATS = 10
REPEAT_RMS_ARCSEC = 0.081
"""Largest rms over the ten repeats at any of the 41 angles."""
CHAUVENET_RMS_ARCSEC = 0.037
"""The same after Chauvenet's criterion, said of the averages."""
FIT_RMS_ARCSEC = 0.2
"""The fitted dividing error is said to be better than this."""

TEST_POINTS = 55
SETS = 10
DISTORTION_ACCURACY_UM = 2.3
"""Accuracy that the abstract claims for the distortion."""
REDUCTION = 0.35
"""By how much compensated angles are said to lower the rms of the distortion."""

DISTORTION_RAW_UM: tuple[float, ...] = (
    *(0.2, 1.8, 0.3, 1.7, 1.1, 0.5, 0.4, 0.0, 0.0, 1.2, 3.0),
    *(2.7, 1.6, 3.5, 3.3, 2.9, 2.1, 1.2, 0.0, 0.8, 0.9, 0.2),
    *(1.7, 0.0, 1.6, 1.2, 2.1, 0.0, 0.4, 0.0, 0.5, 1.8, 1.1),
    *(1.5, 0.3, 0.3, 1.1, 0.0, 0.0, 0.6, 0.1, 1.0, 1.6, 0.0),
    *(0.1, 0.5, 0.5, 0.4, 0.0, 0.2, 0.0, 0.3, 0.2, 0.5, 0.4),
)
"""Table 2, "RMS of distortion" of points 1 to 55. The table prints no unit; the text has micrometres."""
DISTORTION_COMPENSATED_UM: tuple[float, ...] = (
    *(0.2, 1.8, 0.3, 1.7, 1.1, 0.5, 0.0, 0.0, 0.0, 0.1, 1.8),
    *(1.4, 1.1, 1.9, 2.1, 2.2, 2.1, 1.2, 0.0, 0.8, 0.9, 0.0),
    *(1.2, 0.0, 0.0, 1.2, 2.0, 0.0, 0.0, 0.1, 0.5, 1.8, 1.1),
    *(1.5, 0.0, 0.0, 1.1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.6, 0.0),
    *(0.1, 0.5, 0.5, 0.4, 0.0, 0.2, 0.0, 0.3, 0.2, 0.5, 0.4),
)
"""Table 2, "RMS of distortion after compensation" of points 1 to 55."""
