"""Units of angles in measured data and results."""

from __future__ import annotations

import math

ARCSEC = math.pi / 180 / 3600
"""One second of arc, rad."""

ARCMIN = 60.0 * ARCSEC
"""One minute of arc, rad."""
