"""Table 2 of paper 001 as printed (Wang et al., Acta Photonica Sinica 47(10) 1012001, 2018): step 0.02 deg, arcsec.

30 deg between the mirrors about X and Y, 60 deg about Z. The second column of each pair is mirror 2; about Y and Z it
is printed as 2/sqrt(3) times mirror 2.
"""

from __future__ import annotations

from collections.abc import Mapping

from optics.frozen_map import FrozenMap

ANGLES = (0.0, 72.0, 144.0, 216.0, 288.0, 360.0, 432.0, 504.0, 576.0, 648.0, 720.0)
"""Turn of the table."""

MIRROR_1: Mapping[str, tuple[float, ...]] = FrozenMap(
    {
        "X": (0.04, 70.98, 143.17, 215.27, 286.92, 358.72, 431.05, 503.28, 575.18, 647.18, 718.99),
        "Y": (0.15, 72.00, 144.22, 215.54, 288.33, 360.41, 432.54, 504.51, 577.13, 648.86, 721.08),
        "Z": (0.04, 62.31, 124.63, 187.00, 249.06, 311.89, 374.04, 436.31, 498.61, 560.97, 623.23),
    }
)
MIRROR_2: Mapping[str, tuple[float, ...]] = FrozenMap(
    {
        "X": (0.03, 71.16, 143.39, 215.64, 287.29, 359.14, 431.70, 503.93, 575.89, 647.94, 719.72),
        "Y": (
            *(0.046188, 71.822373, 144.002704, 216.183035, 288.536571, 360.786183),
            *(432.966514, 505.031374, 577.304081, 649.288113, 721.549272),
        ),
        "Z": (
            *(0.046188, 71.949391, 143.910328, 215.929001, 287.589716, 360.139551),
            *(431.904189, 503.807392, 575.745235, 647.752361, 719.644017),
        ),
    }
)
MEAN_DIFFERENCE: Mapping[str, float] = FrozenMap({"X": 0.460909, "Y": 0.340353, "Z": 0.177646})
"""The table's last line."""
