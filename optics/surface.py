"""Surface shapes: plane, conic and even asphere, with an optional figure."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optics.figure import Figure


@dataclass(frozen=True)
class Surface:
    """Rotationally symmetric surface z = c r^2 / (1 + sqrt(1 - (1+k) c^2 r^2)) + A4 r^4 + A6 r^6 + ... + figure.

    Attributes:
        curvature: c = 1/R in 1/m; 0 is a plane. Positive: centre of curvature on the +z side.
        conic: k, Schwarzschild's constant (0 sphere, -1 paraboloid).
        even: (A4, A6, A8, ...) in m^-3, m^-5, m^-7, ...
        figure: departure from that shape.
    """

    curvature: float = 0.0
    conic: float = 0.0
    even: tuple[float, ...] = ()
    figure: Figure | None = None

    @property
    def is_plane(self) -> bool:
        """True when the ideal shape is flat."""
        return self.curvature == 0.0 and not any(self.even)

    def with_figure(self, figure: Figure | None) -> Surface:
        """The same shape with another figure."""
        return replace(self, figure=figure)

    def sag(self, x: Any, y: Any) -> np.ndarray:
        """Height z at x, y (metres, any shape); NaN outside the conic's domain."""
        x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        r2 = x * x + y * y
        with np.errstate(invalid="ignore"):
            z = self.curvature * r2 / (1.0 + np.sqrt(1.0 - (1.0 + self.conic) * self.curvature**2 * r2))
        for i, a in enumerate(self.even):
            z = z + a * r2 ** (i + 2)
        if self.figure is not None:
            z = z + self.figure.sag(x, y)
        return np.asarray(z)


def plane() -> Surface:
    """A flat surface."""
    return Surface()
