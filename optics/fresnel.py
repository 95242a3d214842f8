"""Fresnel's formulas for a bare dielectric surface and unpolarised light (Born and Wolf, Principles of Optics, section
1.5.2, eq. 21a and 1.5.3).
"""

from __future__ import annotations

from typing import Any

from optics.array_math import select, sqrt

GRAZING = 1e-12
"""Smallest cosine of incidence that is told from zero; below it the formulas are 0/0."""


def cosine_after(cosine: Any, before: Any, after: Any) -> Any:
    """Cosine of the angle of refraction by Snell's law, 0 where the light is totally reflected.

    Args:
        cosine: of the angle of incidence, 0 to 1; float, NumPy or Dr.Jit array, as the others.
        before: refractive index on the side of the incident light.
        after: on the side of the refracted light.
    """
    ratio = before / after
    square = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
    return sqrt(select(square > 0.0, square, 0.0 * square))


def reflectance(cosine: Any, before: Any, after: Any) -> Any:
    """Share of unpolarised power that is reflected, 0 to 1; exactly 1 beyond the critical angle.

    Arguments as ``cosine_after``. What is not reflected is transmitted.
    """
    cosine = select(cosine > GRAZING, cosine, 0.0 * cosine + GRAZING)
    bent = cosine_after(cosine, before, after)
    s = (before * cosine - after * bent) / (before * cosine + after * bent)
    p = (after * cosine - before * bent) / (after * cosine + before * bent)
    return 0.5 * (s * s + p * p)
