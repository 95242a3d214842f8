"""What a surface does with light in the path tracer: Fresnel's laws, finishes and measured coatings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from optics.materials import scatter
from optics.materials.scatter import ABg, Scatter, ScatterTable
from optics.numerics.array_math import select, sqrt

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


@dataclass(frozen=True)
class Finish:
    """Optical finish of one side of a surface.

    Attributes:
        reflectance: share reflected, specular or into the scatter lobe around the specular direction.
        transmission: share that goes through (refracted); beyond the critical angle all of it is reflected instead.
        diffuse: share diffused by Lambert's law to the side the light came from.
        scatter: lobe around the specular and the refracted direction, which takes its share out of them.
        bare: bare glass: reflectance and transmission are Fresnel's and must be given as 0.
        records: whether the light that is absorbed counts as detected.
        coating: measured, in place of reflectance and transmission; light goes through where transmission is not 0.
        table: measured scattering about the specular direction, in place of ``scatter``: what it scatters comes out of
            what is reflected.
        scattered_only: whether nothing is reflected but what the table scatters; reflectance is then given as 0.

    Raises:
        ValueError: the shares are impossible.
    """

    reflectance: float = 0.0
    transmission: float = 0.0
    diffuse: float = 0.0
    scatter: Scatter | None = None
    bare: bool = False
    records: bool = False
    coating: CoatingTable | None = None
    table: ScatterTable | None = None
    scattered_only: bool = False

    def __post_init__(self) -> None:
        """Check the shares."""
        self._check_table()
        shares = (self.reflectance, self.transmission, self.diffuse)
        if min(shares) < 0.0 or sum(shares) > 1.0 + 1e-12:
            raise ValueError(
                f"reflected, transmitted and diffused shares must be 0 or more and at most 1, found {shares}"
            )
        if self.bare and any(shares):
            raise ValueError("a bare glass surface takes its shares from Fresnel's formulas; give none")

    def _check_table(self) -> None:
        """Check what a table scatters against what is reflected."""
        if self.bare and (self.coating is not None or self.table is not None):
            raise ValueError("bare glass has neither a coating nor a table of its scattering")
        if self.scattered_only and (self.table is None or self.reflectance > 0.0):
            raise ValueError("only what a table scatters is reflected: give a table and no reflectance")
        if self.table is None:
            return
        if self.scatter is not None or self.transmission > 0.0:
            raise ValueError("a table of scattering stands in place of a lobe, on what light does not go through")
        for k in range(scatter.STEPS if not self.scattered_only else 0):
            angle = 0.5 * np.pi * k / scatter.STEPS
            reflected = self.reflectance if self.coating is None else self.coating.at(angle, False)[0]
            if self.table.drawn.share[k] > reflected:
                raise ValueError(
                    f"at {np.degrees(angle):.0f} deg the table scatters {self.table.drawn.share[k]:.4g} of the light, "
                    f"and only {reflected:.4g} are reflected"
                )
        if self.scattered_only and float(np.max(self.table.drawn.share)) + self.diffuse > 1.0:
            raise ValueError("more than all of the light would come back")

    @property
    def numbers(self) -> tuple[float, ...]:
        """reflectance, transmission, bare, diffuse, and the lobe's share, scale, exponent, kind."""
        lobe = (0.0, 1.0, 2.0, 0.0) if self.scatter is None else self.scatter.lobe.numbers
        return (self.reflectance, self.transmission, float(self.bare), self.diffuse, *lobe)


POLISH = ABg(2.0e-6, 1.0e-6, 2.0)
"""A polished mirror of about 1 nm rms roughness: total integrated scatter 9e-5 (4 pi sigma / lambda squared would be
3.7e-4 at 650 nm over all spatial periods; about a quarter of it falls into the angles the lobe covers)."""

PAINT = ABg(5.0e-3, 0.1, 2.0)
"""The forward lobe of black paint around its weak gloss."""

MIRROR = Finish(reflectance=0.98, scatter=POLISH)
"""A metal mirror with a protected coating."""

COATED = Finish(reflectance=0.0025, transmission=0.9975)
"""Glass with an anti-reflection coating: a residual reflectance of a quarter of a percent."""

BARE = Finish(bare=True)
"""Polished bare glass."""

GROUND = Finish(diffuse=0.04)
"""Glass ground and blackened, seen from either side."""

BLACK = Finish(reflectance=0.005, diffuse=0.035, scatter=PAINT)
"""Diffuse black paint: 4 % of the light comes back, most of it by Lambert's law."""

SILICON = Finish(reflectance=0.3, records=True)
"""A bare silicon detector: what it does not reflect it records."""

ABSORBER = Finish()
"""Perfectly black."""

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
