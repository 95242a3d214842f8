"""Measured coatings: reflectance and transmittance over wavelength and angle of incidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

STEPS = 360
"""Intervals of the angle of incidence, from 0 to 90 degrees, in which a path looks a coating up."""


@dataclass(frozen=True, eq=False)
class CoatingTable:
    """A coating at one wavelength, for unpolarised light.

    Attributes:
        angles: of incidence on the side of air, ascending from 0, radians, (K,).
        reflectance: 0 to 1, (K,).
        transmittance: 0 to 1, (K,); None where it is not told.

    Linear between the angles; constant beyond the last one.

    Raises:
        ValueError: angles that do not ascend, shares that are impossible.
    """

    angles: np.ndarray
    reflectance: np.ndarray
    transmittance: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Copy, freeze and check."""
        names = ("angles", "reflectance", *(("transmittance",) if self.transmittance is not None else ()))
        for name in names:
            array = np.array(getattr(self, name), np.float64)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if not np.all(np.diff(self.angles) > 0.0) or self.angles[0] < 0.0 or self.angles[-1] > 0.5 * np.pi:
            raise ValueError("angles of incidence must ascend between 0 and 90 degrees")
        through = np.zeros_like(self.reflectance) if self.transmittance is None else self.transmittance
        if not self.reflectance.shape == through.shape == self.angles.shape:
            raise ValueError("one reflectance, and one transmittance, for each angle")
        if min(np.min(self.reflectance), np.min(through)) < 0.0 or np.max(self.reflectance + through) > 1.0 + 1e-9:
            raise ValueError("reflectance and transmittance lie between 0 and 1, also together")

    def at(self, angle: float, through: bool) -> tuple[float, float]:
        """Reflectance and transmittance at an angle of incidence in radians.

        Args:
            angle: radians.
            through: whether light goes through, where no transmittance is told all that is not reflected.
        """
        reflected = float(np.interp(angle, self.angles, self.reflectance))
        if not through:
            return reflected, 0.0
        if self.transmittance is None:
            return reflected, 1.0 - reflected
        return reflected, float(np.interp(angle, self.angles, self.transmittance))

    def drawn(self, through: bool) -> np.ndarray:
        """Reflectance and transmittance from 0 to 90 degrees, (STEPS + 1, 2); ``through`` as for ``at``."""
        return np.array([self.at(float(angle), through) for angle in np.linspace(0.0, 0.5 * np.pi, STEPS + 1)])
