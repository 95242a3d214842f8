"""Light scattered by surfaces: ABg and Harvey-Shack lobes and Lambertian diffusion.

Both lobes depend only on d = |beta - beta0|, the distance of the scattered from the specular direction in the plane of
direction cosines (components of the unit vectors along the surface; Harvey 1976; Pfisterer, "Approximated scatter
models for stray light analysis", OPN 2011). The BSDF f is taken *per power of the specular beam that it leaves*, so
that f(d) d^2(beta) is the scattered share into d^2(beta) = cos(theta) d(Omega), and the total integrated scatter

    TIS(beta0) = integral of f(|beta - beta0|) over |beta| < 1

is the share that leaves the specular beam. Inside glass the components are those of n times the unit vector.

Sampling. d is drawn in closed form from the Harvey-Shack function h(x) = (1 + x^2)^(-g/2), x = d / l. A lobe of ABg has
l = B^(1/g) and f = A/B / (1 + x^g) = A/B h(x) rho(x), where rho = (1 + x^2)^(g/2) / (1 + x^g) lies between 1 and
2^(g/2 - 1). So d is drawn with the share of the upper bound, and a draw is kept with the probability rho / max(rho).
What is not kept, and what falls outside the unit circle (no such direction exists), stays in the specular beam:
energy is conserved for every angle of incidence without any table.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import log as real_log
from typing import Any

import numpy as np

from optics.numerics.array_math import exp, log, select

WIDEST = 2.0
"""Largest distance of two directions in the plane of direction cosines."""

_FLAT = 1e-9
"""Exponents closer to 2 than twice this take the logarithmic form."""


@dataclass(frozen=True)
class Lobe:
    """A lobe as the sampler uses it.

    Attributes:
        share: of the specular power for which a direction is drawn: the integral of the upper bound over d < 2.
        scale: l, in direction cosines.
        exponent: g.
        abg: whether draws are thinned to ABg (else Harvey-Shack as drawn).
    """

    share: float
    scale: float
    exponent: float
    abg: bool

    @property
    def numbers(self) -> tuple[float, float, float, float]:
        """share, scale, exponent, 1 for ABg and 0 for Harvey-Shack."""
        return self.share, self.scale, self.exponent, float(self.abg)


@dataclass(frozen=True)
class ABg:
    """f(d) = A / (B + d^g).

    Raises:
        ValueError: an impossible number, or more than all of the light would be scattered.
    """

    a: float
    b: float
    g: float

    def __post_init__(self) -> None:
        """Check the numbers and the total."""
        if not (self.a > 0.0 and self.b > 0.0 and self.g >= 0.0):
            raise ValueError(f"an ABg lobe needs A > 0, B > 0 and g >= 0, found {self.a}, {self.b}, {self.g}")
        _check_total(self, self._upper(1.0))

    def bsdf(self, distance: Any) -> Any:
        """BSDF f at distances d (NumPy arrays), per steradian."""
        return self.a / (self.b + np.asarray(distance, np.float64) ** self.g)

    @property
    def lobe(self) -> Lobe:
        """What the sampler uses.

        Raises:
            ValueError: the upper bound holds more than all of the light.
        """
        return _checked(Lobe(self._upper(WIDEST), self._scale, self.g, self.g > 0.0))

    @property
    def _scale(self) -> float:
        return self.b ** (1.0 / self.g) if self.g > 0.0 else 1.0

    def _upper(self, reach: float) -> float:
        """Integral of the upper bound over d < ``reach``."""
        bound = self.a / self.b * _largest_ratio(self.g) if self.g > 0.0 else self.a / (1.0 + self.b)
        return bound * _harvey_integral(self._scale, self.g, reach)


@dataclass(frozen=True)
class HarveyShack:
    """f(d) = b0 (1 + (d / l)^2)^(s/2), s < 0.

    Raises:
        ValueError: an impossible number, or more than all of the light would be scattered.
    """

    b0: float
    l: float  # noqa: E741 - the symbol of the literature
    s: float

    def __post_init__(self) -> None:
        """Check the numbers and the total."""
        if not (self.b0 > 0.0 and self.l > 0.0 and self.s <= 0.0):
            raise ValueError(f"a Harvey-Shack lobe needs b0 > 0, l > 0 and s <= 0, found {self.b0}, {self.l}, {self.s}")
        _check_total(self, self._upper(1.0))

    def bsdf(self, distance: Any) -> Any:
        """BSDF f at distances d (NumPy arrays), per steradian."""
        return self.b0 * (1.0 + (np.asarray(distance, np.float64) / self.l) ** 2) ** (0.5 * self.s)

    @property
    def lobe(self) -> Lobe:
        """What the sampler uses."""
        return _checked(Lobe(self._upper(WIDEST), self.l, -self.s, False))

    def _upper(self, reach: float) -> float:
        """Integral over d < ``reach``; the function is its own upper bound."""
        return self.b0 * _harvey_integral(self.l, -self.s, reach)


Scatter = ABg | HarveyShack


def total_scatter(scatter: Scatter, sine: float = 0.0) -> float:
    """Total integrated scatter by quadrature, for light that arrives with |beta0| = ``sine`` (0 to 1)."""
    # takes a quarter of a second, and every command reads the names of finishes
    from scipy.integrate import quad

    def ring(log_distance: float) -> float:
        d = float(np.exp(log_distance))
        if d <= 1.0 - sine:
            arc = 2.0 * np.pi
        else:
            arc = 2.0 * float(np.arccos(np.clip((d * d + sine * sine - 1.0) / (2.0 * d * sine), -1.0, 1.0)))
        return float(scatter.bsdf(d)) * d * d * arc

    # d = exp(t): a lobe as narrow as a microradian is smooth in t; below the smallest d the share is negligible
    edges = [np.log(1e-12), *np.log([1e-8, 1e-6, 1e-4, 1e-2]), np.log(max(1.0 - sine, 2e-2)), np.log(1.0 + sine)]
    pieces = [quad(ring, a, b, epsabs=1e-14, epsrel=1e-11, limit=400)[0] for a, b in pairwise(edges)]
    return float(sum(pieces))


def sample_distance(u: Any, scale: Any, exponent: Any) -> Any:
    """Distance d < 2 whose density in the plane is proportional to (1 + (d/l)^2)^(-g/2).

    Args:
        u: uniform in [0, 1), NumPy or Dr.Jit array, as the others.
        scale: l, in direction cosines.
        exponent: g.
    """
    q = 1.0 - 0.5 * exponent
    level = log(1.0 + (WIDEST / scale) * (WIDEST / scale))
    flat = abs(q) < _FLAT
    safe = select(flat, 0.0 * q + 1.0, q)
    power = exp(log(1.0 + u * (exp(safe * level) - 1.0)) / safe)
    square = select(flat, exp(u * level), power) - 1.0
    return scale * select(square > 0.0, square, 0.0 * square) ** 0.5


def acceptance(distance: Any, scale: Any, exponent: Any, abg: Any) -> Any:
    """Probability of keeping a drawn distance, 0.5 or more for usual g; 1 for Harvey-Shack (``abg`` < 0.5)."""
    x = distance / scale
    half = 0.5 * exponent
    above = log(1.0 + x * x)
    power = exp(exponent * log(select(x > 1e-100, x, 0.0 * x + 1e-100)))
    rho = exp(half * above) / (1.0 + power)
    largest = exp(select(half > 1.0, half - 1.0, 0.0 * half) * real_log(2.0))
    return select(abg > 0.5, rho / largest, 0.0 * rho + 1.0)


def _largest_ratio(g: float) -> float:
    return float(2.0 ** max(0.5 * g - 1.0, 0.0))


def _harvey_integral(scale: float, g: float, reach: float) -> float:
    """Integral of (1 + (d/l)^2)^(-g/2) over the disk d < reach."""
    q, level = 1.0 - 0.5 * g, float(np.log1p((reach / scale) ** 2))
    return float(np.pi * scale**2 * (level if abs(q) < _FLAT else np.expm1(q * level) / q))


def _checked(lobe: Lobe) -> Lobe:
    if lobe.share > 1.0:
        raise ValueError(
            f"the scatter lobe is too strong to be sampled: its upper bound holds {lobe.share:.4g} of the light"
        )
    return lobe


def _check_total(scatter: Scatter, upper: float) -> None:
    if upper <= 1.0:  # the bound, which is not below the total, is enough for all but the strongest
        return
    total = total_scatter(scatter)  # a lobe that falls off scatters most at normal incidence
    if total > 1.0:
        raise ValueError(f"{scatter} would scatter {total:.4g} of the light; no surface scatters more than 1")
