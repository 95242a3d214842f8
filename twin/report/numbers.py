"""Numbers as text: decimals from the uncertainty, typographic minus, no noise digits."""

from __future__ import annotations

import math

MINUS = "\N{MINUS SIGN}"
SAME = 1e-6
"""Below this a number per unit motion (arcsec, um) is rounding and is shown as 0."""
FAR = 3.0
"""Residuals beyond this many sigma are marked."""


def _typeset(text: str) -> str:
    return text.replace("-", MINUS)


def fixed(value: float, decimals: int, sign: bool = False) -> str:
    """A fixed-point number; what rounds to zero has no sign."""
    if not math.isfinite(value):
        return "\N{EM DASH}"
    rounded = round(value, decimals) + 0.0
    return _typeset(f"{rounded:+.{decimals}f}" if sign and rounded else f"{rounded:.{decimals}f}")


def decimals_for(sigma: float, digits: int = 2, most: int = 7, default: int = 4) -> int:
    """Decimals that show ``sigma`` with that many digits."""
    if not (math.isfinite(sigma) and sigma > 0):
        return default
    return min(max(digits - 1 - math.floor(math.log10(sigma)), 0), most)


def significant(value: float, digits: int = 3, floor: float = SAME, sign: bool = False) -> str:
    """A number with some significant digits, one less where a power of ten is written; below ``floor`` it is 0."""
    if not math.isfinite(value):
        return "\N{EM DASH}"
    if value == 0.0 or abs(value) < floor:
        return "0"
    value = float(f"{value:.{digits - 1}e}")
    size = math.floor(math.log10(abs(value)))
    if size < -3 or size > 6:
        mantissa, _, exponent = f"{value:{'+' if sign else ''}.{max(digits - 2, 0)}e}".partition("e")
        return _typeset(f"{mantissa}e{int(exponent)}")
    text = f"{value:{'+' if sign else ''}.{max(digits - 1 - size, 0)}f}"
    return _typeset(text)


def plain(value: float, digits: int = 5) -> str:
    """A number that was given, without trailing zeros."""
    return _typeset(f"{value:.{digits}g}")


def residual(value: float, sigma: float) -> float | None:
    """The ratio value / sigma, or None without noise."""
    return value / sigma if sigma > 0 else None


def tick_text(value: float) -> str:
    """A whole number with its sign, for axes."""
    return _typeset(f"{value:+,.0f}").replace(",", "\N{NARROW NO-BREAK SPACE}") if value else "0"


def residual_text(ratio: float | None) -> str:
    """A residual in sigma."""
    if ratio is None:
        return "\N{EM DASH}"
    if abs(ratio) < 10:
        return fixed(ratio, 1, sign=True)
    return _typeset(f"{ratio:+,.0f}").replace(",", "\N{NARROW NO-BREAK SPACE}")
