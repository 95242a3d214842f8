"""Units of measured data and results; inside, everything is in radians and metres.

An angle in seconds of arc is ``angle / ARCSEC``, a length in micrometres ``length * UM_PER_M``: the factors are those
of which one rounding is left.
"""

from __future__ import annotations

import math

ARCSEC = math.pi / 180 / 3600
"""One second of arc, rad."""

ARCMIN = 60.0 * ARCSEC
"""One minute of arc, rad."""

UM_PER_M, MM_PER_M = 1e6, 1e3
"""Micrometres and millimetres in a metre."""
