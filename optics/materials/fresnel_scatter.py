"""Reflection, transmission and scattering of surfaces: Fresnel formulas, finishes, coatings, BSDF lobes and tables.

Lobes. The ABg and Harvey-Shack lobes depend only on d = |beta - beta0|, the distance of the scattered from the specular
direction in the plane of direction cosines (components of the unit vectors along the surface; Harvey 1976; Pfisterer,
"Approximated scatter models for stray light analysis", OPN 2011). The BSDF f is relative to *the power of the specular
beam*, from which the scattered light is taken, so that f(d) d^2(beta) is the scattered fraction into d^2(beta) =
cos(theta) d(Omega), and the total integrated scatter

    TIS(beta0) = integral of f(|beta - beta0|) over |beta| < 1

is the fraction that leaves the specular beam. Inside glass the components are those of n times the unit vector.

Sampling of lobes. d is drawn in closed form from the Harvey-Shack function h(x) = (1 + x^2)^(-g/2), x = d / l. An ABg
lobe has l = B^(1/g) and f = A/B / (1 + x^g) = A/B h(x) rho(x), where rho = (1 + x^2)^(g/2) / (1 + x^g) lies between 1
and 2^(g/2 - 1). So a random d is drawn for the power of the upper bound, and accepted with the probability rho /
max(rho). Rejected directions, and those outside the unit circle (no such direction exists), stay in the specular beam:
energy is conserved for every angle of incidence without any table.

Tables. A table gives f (1/sr, scattered radiance over incident irradiance) for angles of incidence t and directions
relative to the specular one: the radial angle r away from it, and the azimuth p about it, 0 where the direction leans
toward the surface's normal, counterclockwise as seen against the specular light. With n the normal, s the specular
direction, e = (n - cos t s) / sin t and h = s x e the direction is

    w = cos r s + sin r (cos p e + sin p h),        n . w = cos r cos t + sin r cos p sin t,

and the total integrated scatter TIS(t) is the integral of f (n . w) sin r dr dp over all w above the surface. f is
linear in t, p and r between the table's numbers, constant before its first and beyond its last angle of incidence, and
zero beyond its last radial angle.

Sampling of tables. For angles of incidence one degree apart the scattered power is summed over cells that are finer
than the table's. A path takes one of the two angles next to its own, with probability proportional to its part of the
interpolated power, then a ring of cells, a cell in it, and a position in the cell, uniform in solid angle. Directions
that fall below the surface because of the difference from the path's own angle are reflected upward, so that all of TIS
is scattered.

Finishes. A ``Finish`` describes one side of a surface in the path tracer: Fresnel reflection, constant shares, measured
coatings and scattering.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import log as real_log
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optics.numerics.array_math import exp, log, select, sqrt

MAX_DISTANCE = 2.0
"""Largest possible distance of two directions in the plane of direction cosines."""

_FLAT = 1e-9
"""Tolerance of |1 - g/2| below which the integral of (1 + (d/l)^2)^(-g/2) over a disk is taken as a logarithm (g = 2).
"""


@dataclass(frozen=True)
class Lobe:
    """Parameters of a scatter lobe from which directions are drawn; d is the distance from the specular direction.

    Attributes
    ----------
    share : float
        Fraction of the specular power for which a direction is drawn: the integral of the lobe's upper bound over d <
        2.
    scale : float
        Width l of the lobe, in direction cosines.
    exponent : float
        Exponent g of (1 + (d/l)^2)^(-g/2).
    abg : bool
        True when directions are accepted with the probability of an ABg lobe; False for Harvey-Shack, where all are
        accepted.
    """

    share: float
    scale: float
    exponent: float
    abg: bool

    @property
    def numbers(self) -> tuple[float, float, float, float]:
        """Numbers of the lobe for the path tracer: share, scale, exponent, and 1 for ABg or 0 for Harvey-Shack."""
        return self.share, self.scale, self.exponent, float(self.abg)


@dataclass(frozen=True)
class ABg:
    """ABg lobe: BSDF f(d) = A / (B + d^g), with d the distance from the specular direction in direction cosines.

    Raises
    ------
    ValueError
        A parameter is impossible, or the lobe would scatter more than all of the light.
    """

    a: float
    b: float
    g: float

    def __post_init__(self) -> None:
        """Check that the parameters are possible and that the lobe scatters no more than all of the light."""
        if not (self.a > 0.0 and self.b > 0.0 and self.g >= 0.0):
            raise ValueError(f"an ABg lobe needs A > 0, B > 0 and g >= 0, found {self.a}, {self.b}, {self.g}")
        _check_total(self, self._upper(1.0))

    def bsdf(self, distance: Any) -> Any:
        """Return the BSDF, 1/sr, at distances from the specular direction, in direction cosines (NumPy arrays)."""
        return self.a / (self.b + np.asarray(distance, np.float64) ** self.g)

    @property
    def lobe(self) -> Lobe:
        """Parameters from which scattered directions are drawn.

        Raises
        ------
        ValueError
            The upper bound integrates to more than all of the light.
        """
        return _require_samplable(Lobe(self._upper(MAX_DISTANCE), self._scale, self.g, self.g > 0.0))

    @property
    def _scale(self) -> float:
        """Width l = B^(1/g) of the lobe, in direction cosines."""
        return self.b ** (1.0 / self.g) if self.g > 0.0 else 1.0

    def _upper(self, radius: float) -> float:
        """Return the integral of the lobe's upper bound over distances below ``radius``, per specular power.

        ``radius`` is in direction cosines.
        """
        bound = self.a / self.b * _largest_ratio(self.g) if self.g > 0.0 else self.a / (1.0 + self.b)
        return bound * _harvey_integral(self._scale, self.g, radius)


@dataclass(frozen=True)
class HarveyShack:
    """Harvey-Shack lobe: BSDF f(d) = b0 (1 + (d / l)^2)^(s/2) with s < 0, d the distance from the specular direction.

    d and the width l are in direction cosines.

    Raises
    ------
    ValueError
        A parameter is impossible, or the lobe would scatter more than all of the light.
    """

    b0: float
    l: float  # noqa: E741 - the symbol of the literature
    s: float

    def __post_init__(self) -> None:
        """Check that the parameters are possible and that the lobe scatters no more than all of the light."""
        if not (self.b0 > 0.0 and self.l > 0.0 and self.s <= 0.0):
            raise ValueError(f"a Harvey-Shack lobe needs b0 > 0, l > 0 and s <= 0, found {self.b0}, {self.l}, {self.s}")
        _check_total(self, self._upper(1.0))

    def bsdf(self, distance: Any) -> Any:
        """Return the BSDF, 1/sr, at distances from the specular direction, in direction cosines (NumPy arrays)."""
        return self.b0 * (1.0 + (np.asarray(distance, np.float64) / self.l) ** 2) ** (0.5 * self.s)

    @property
    def lobe(self) -> Lobe:
        """Parameters from which scattered directions are drawn."""
        return _require_samplable(Lobe(self._upper(MAX_DISTANCE), self.l, -self.s, False))

    def _upper(self, radius: float) -> float:
        """Return the integral of the lobe over distances below ``radius``, as a fraction of the specular power.

        ``radius`` is in direction cosines; the lobe is its own upper bound.
        """
        return self.b0 * _harvey_integral(self.l, -self.s, radius)


Scatter = ABg | HarveyShack


def total_scatter(scatter: Scatter, sine: float = 0.0) -> float:
    """Return the total integrated scatter of a lobe, as a fraction of the specular power, by quadrature.

    ``sine`` (0 to 1) is the sine of the angle of incidence.
    """
    # imported late: scipy takes 0.25 s, and every command imports this module
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
    """Return a random distance d from the specular direction, for uniform random numbers.

    d is below 2, and its density per area in the plane of direction cosines is proportional to (1 + (d/l)^2)^(-g/2).

    Parameters
    ----------
    u : array
        Uniform random number in [0, 1), a NumPy or Dr.Jit array as the other arguments.
    scale : array
        Width l, in direction cosines.
    exponent : array
        Exponent g.
    """
    q = 1.0 - 0.5 * exponent
    level = log(1.0 + (MAX_DISTANCE / scale) * (MAX_DISTANCE / scale))
    flat = abs(q) < _FLAT
    safe = select(flat, 0.0 * q + 1.0, q)
    power = exp(log(1.0 + u * (exp(safe * level) - 1.0)) / safe)
    square = select(flat, exp(u * level), power) - 1.0
    return scale * select(square > 0.0, square, 0.0 * square) ** 0.5


def lobe_area(scale: float, exponent: float) -> float:
    """Return the integral of (1 + (d/l)^2)^(-g/2) over the disk of distances d up to ``MAX_DISTANCE``.

    The function divided by it is the density of d^2 that ``sample_distance`` draws.

    Parameters
    ----------
    scale : float
        Width l, in direction cosines.
    exponent : float
        Exponent g.
    """
    return _harvey_integral(scale, exponent, MAX_DISTANCE) / float(np.pi)


def acceptance(distance: Any, scale: Any, exponent: Any, abg: Any) -> Any:
    """Return the probability of accepting a random distance, so that accepted ones are distributed like an ABg lobe.

    It is 1 for a Harvey-Shack lobe (``abg`` < 0.5), and 0.5 or more for usual exponents.

    Parameters
    ----------
    distance : array
        Distance from the specular direction, in direction cosines.
    scale : array
        Width of the lobe, in direction cosines.
    exponent : array
        Exponent of the lobe.
    abg : array
        1 for an ABg lobe, 0 for a Harvey-Shack lobe.
    """
    x = distance / scale
    half = 0.5 * exponent
    above = log(1.0 + x * x)
    power = exp(exponent * log(select(x > 1e-100, x, 0.0 * x + 1e-100)))
    rho = exp(half * above) / (1.0 + power)
    largest = exp(select(half > 1.0, half - 1.0, 0.0 * half) * real_log(2.0))
    return select(abg > 0.5, rho / largest, 0.0 * rho + 1.0)


def _largest_ratio(g: float) -> float:
    """Return the largest ratio, over all distances, of an ABg lobe of exponent ``g`` to the shape of its upper bound.

    The ratio is rho = (1 + x^2)^(g/2) / (1 + x^g), with x the distance over the width of the lobe.
    """
    return float(2.0 ** max(0.5 * g - 1.0, 0.0))


def _harvey_integral(scale: float, g: float, radius: float) -> float:
    """Return the integral of (1 + (d/l)^2)^(-g/2) over the disk of distances d below ``radius``; l is ``scale``."""
    q, level = 1.0 - 0.5 * g, float(np.log1p((radius / scale) ** 2))
    return float(np.pi * scale**2 * (level if abs(q) < _FLAT else np.expm1(q * level) / q))


def _require_samplable(lobe: Lobe) -> Lobe:
    """Return the lobe; raise ValueError if its upper bound, used for sampling, exceeds all of the light."""
    if lobe.share > 1.0:
        raise ValueError(
            f"the scatter lobe is too strong to be sampled: its upper bound is {lobe.share:.4g} of the light (> 1)"
        )
    return lobe


def _check_total(scatter: Scatter, upper: float) -> None:
    """Raise ValueError if a lobe scatters more than all of the light.

    ``upper`` is the integral of its upper bound; only if that exceeds 1 is the exact integral computed.
    """
    if upper <= 1.0:  # an upper bound below 1 settles it without quadrature
        return
    total = total_scatter(scatter)  # such lobes scatter most at normal incidence
    if total > 1.0:
        raise ValueError(f"{scatter} would scatter {total:.4g} of the light; no surface scatters more than 1")


STEPS = 90
"""Number of intervals of the angle of incidence, from 0 to 90 degrees, for which a scatter table's sampling is
computed.
"""
LEAST_RINGS, LEAST_SECTORS = 240, 36
MOST_CELLS = 120_000
"""Largest number of cells (rings of the radial angle times sectors of the azimuth) of a scatter table's sampling."""
_CHECKED = np.arange(0.0, 91.0, 5.0)
"""Angles of incidence, degrees, at which a table's total scatter is checked in addition to the table's own angles."""
_GAUSS = (0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0))


@dataclass(frozen=True, eq=False)
class ScatterTable:
    """Tabulated BSDF in angles relative to the specular direction.

    Attributes
    ----------
    incidence : (I,) ndarray
        I angles of incidence, ascending, radians.
    azimuth : (A,) ndarray
        A azimuths about the specular direction, ascending, radians: a single one for a rotationally symmetric lobe, 0
        to pi for one symmetric about the plane of incidence, else 0 to 2 pi.
    radial : (R,) ndarray
        R angles away from the specular direction, ascending from 0, radians.
    values : (I, A, R) ndarray
        BSDF, 1/sr.

    Raises
    ------
    ValueError
        Angles do not ascend or do not span the required range, values are negative, or more than all of the light would
        be scattered.
    """

    incidence: np.ndarray
    azimuth: np.ndarray
    radial: np.ndarray
    values: np.ndarray

    def __post_init__(self) -> None:
        """Copy and freeze the arrays, and check them."""
        for name in ("incidence", "azimuth", "radial", "values"):
            array = np.array(getattr(self, name), np.float64)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        shape = (len(self.incidence), len(self.azimuth), len(self.radial))
        if self.values.shape != shape or min(shape) < 1 or shape[2] < 2:
            raise ValueError(f"values must be {shape} with two radial angles or more, found {self.values.shape}")
        for axis in (self.incidence, self.azimuth, self.radial):
            if not np.all(np.diff(axis) > 0.0):
                raise ValueError("angles must ascend")
        if not (self.incidence[0] >= 0.0 and self.incidence[-1] < 0.5 * np.pi):
            raise ValueError("angles of incidence lie between 0 and less than 90 degrees")
        if self.radial[0] != 0.0 or self.radial[-1] > np.pi * (1.0 + 1e-12):
            raise ValueError("radial angles go from 0 to 180 degrees at most")
        ends = (np.pi, 2.0 * np.pi)
        if shape[1] > 1 and not (
            self.azimuth[0] == 0.0 and np.min(np.abs(np.subtract(self.azimuth[-1], ends))) < 1e-9 * np.pi
        ):
            raise ValueError("azimuths go from 0 to 180 or to 360 degrees")
        if not (np.all(np.isfinite(self.values)) and np.min(self.values) >= 0.0):
            raise ValueError("a BSDF is finite and not negative")
        if self.rings * self.sectors > MOST_CELLS:
            raise ValueError(f"{self.rings} x {self.sectors} cells are more than {MOST_CELLS}")
        largest = max(self.total(float(angle)) for angle in (*self.incidence, *np.radians(_CHECKED)))
        if largest > 1.0:
            raise ValueError(f"the table would scatter {largest:.4g} of the light; no surface scatters more than 1")

    @property
    def rings(self) -> int:
        """Number of sampling cells along the radial angle; all intervals of the table have equally many."""
        intervals = len(self.radial) - 1
        return intervals * -(-LEAST_RINGS // intervals)

    @property
    def sectors(self) -> int:
        """Number of sampling cells along the azimuth, over 180 or 360 degrees."""
        intervals = max(len(self.azimuth) - 1, 1)
        return intervals * -(-LEAST_SECTORS // intervals)

    @property
    def mirrored(self) -> bool:
        """True when azimuths end at 180 degrees, and the other half is the mirror image."""
        return len(self.azimuth) == 1 or self.azimuth[-1] < 1.5 * np.pi

    def bsdf(self, incidence: float, azimuth: np.ndarray, radial: np.ndarray) -> np.ndarray:
        """Return the BSDF at one angle of incidence, 1/sr.

        Parameters
        ----------
        incidence : float
            Angle of incidence, radians.
        azimuth : ndarray
            Azimuths, radians, of any size.
        radial : ndarray
            Radial angles, radians, 0 to pi; of the shape of ``azimuth``.
        """
        table = self._at(incidence)
        angle = np.mod(azimuth, 2.0 * np.pi)
        angle = np.minimum(angle, 2.0 * np.pi - angle) if self.mirrored else angle
        r = np.asarray(radial, np.float64)
        k = np.clip(np.searchsorted(self.radial, r, side="right") - 1, 0, len(self.radial) - 2)
        u = (r - self.radial[k]) / (self.radial[k + 1] - self.radial[k])
        if len(self.azimuth) == 1:
            low = high = np.zeros(r.shape, int)
            v = np.zeros(r.shape)
        else:
            low = np.clip(np.searchsorted(self.azimuth, angle, side="right") - 1, 0, len(self.azimuth) - 2)
            high = low + 1
            v = (angle - self.azimuth[low]) / (self.azimuth[high] - self.azimuth[low])
        f = (1.0 - v) * ((1.0 - u) * table[low, k] + u * table[low, k + 1])
        f += v * ((1.0 - u) * table[high, k] + u * table[high, k + 1])
        return np.where(r <= self.radial[-1] * (1.0 + 1e-12), f, 0.0)

    def _at(self, incidence: float) -> np.ndarray:
        """Return the BSDF at one angle of incidence (radians) for A azimuths and R radial angles, (A, R), 1/sr."""
        position = np.interp(incidence, self.incidence, np.arange(len(self.incidence)))
        k = min(int(position), max(len(self.incidence) - 2, 0))
        w = position - k
        return (1.0 - w) * self.values[k] + (w * self.values[k + 1] if w > 0.0 else 0.0)

    def total(self, incidence: float) -> float:
        """Return the total integrated scatter as a fraction of the incident power.

        Parameters
        ----------
        incidence : float
            Angle of incidence, radians.
        """
        return float(np.sum(self._power(incidence)))

    @cached_property
    def _edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges of the sampling cells along the radial angle and along the azimuth, radians."""
        span = self.azimuth if len(self.azimuth) > 1 else np.array([0.0, np.pi])
        out = []
        for axis, count in ((self.radial, self.rings), (span, self.sectors)):
            position = np.linspace(0.0, len(axis) - 1, count + 1)
            out.append(np.interp(position, np.arange(len(axis)), axis))
        return out[0], out[1]

    def _power(self, incidence: float) -> np.ndarray:
        """Return the fraction of the incident power that is scattered into each sampling cell, (rings, sectors).

        ``incidence`` is the angle of incidence in radians; where only half of the azimuths is tabulated, a cell
        includes its mirror image.
        """
        table, (radial, azimuth) = self._at(incidence), self._edges
        power = np.zeros((self.rings, self.sectors))
        dr, dp = np.diff(radial)[:, None], np.diff(azimuth)[None, :]
        for a in _GAUSS:
            along = _interpolated(table, len(self.radial), self.rings, a)  # (A, rings)
            r = radial[:-1, None] + a * dr
            along_normal, tilt = np.cos(r) * np.cos(incidence), np.sin(r) * np.sin(incidence)
            for b in _GAUSS:
                f = _interpolated(along.T, len(self.azimuth), self.sectors, b)
                cosine = along_normal + tilt * np.cos(azimuth[None, :-1] + b * dp)
                power += 0.25 * f * np.maximum(cosine, 0.0) * np.sin(r)
        return power * dr * dp * (2.0 if self.mirrored else 1.0)

    @cached_property
    def sampling(self) -> ScatterSampling:
        """Cumulative distributions of the scattered power, from which scattered directions are drawn."""
        radial, azimuth = self._edges
        share, rings, sectors = [], [], []
        for angle in np.linspace(0.0, 0.5 * np.pi, STEPS + 1):
            power = self._power(float(angle))
            share.append(np.sum(power))
            rings.append(_cumulative(np.sum(power, axis=1)[None])[0])
            sectors.append(_cumulative(power))
        return ScatterSampling(
            np.array(share), np.array(rings), np.array(sectors), np.cos(radial), azimuth, self.mirrored
        )

    def reciprocity(self) -> float:
        """Return the rms relative change of the BSDF when incident and scattered direction are exchanged.

        It is 0 for a reciprocal surface, and taken over pairs of directions, distributed evenly over the hemisphere up
        to 80 degrees from the normal, for which the table covers both; NaN where it covers none.
        """
        rng = np.random.default_rng(1)
        low, high = self.incidence[0], max(self.incidence[-1], self.incidence[0])
        top = min(np.radians(80.0), high)
        if not top > low:
            return float("nan")
        theta_1, theta_2 = (np.arccos(rng.uniform(np.cos(top), np.cos(low), 400)) for _ in range(2))
        azimuth = rng.uniform(0.0, np.pi, 400)
        differences = []
        for a, b, p in zip(theta_1, theta_2, azimuth, strict=True):
            forward, reverse = self._bsdf_between(a, b, p), self._bsdf_between(b, a, p)
            if forward is not None and reverse is not None and forward + reverse > 0.0:
                differences.append((forward - reverse) / (0.5 * (forward + reverse)))
        # rounded to 1e-9, below which it is rounding of angles
        return round(float(np.sqrt(np.mean(np.square(differences)))), 9) if differences else float("nan")

    def _bsdf_between(self, arriving: float, leaving: float, relative: float) -> float | None:
        """Return the BSDF, 1/sr, for given angles of arriving and leaving light; None outside the table.

        Parameters
        ----------
        arriving, leaving : float
            Angles of the arriving and of the leaving light from the surface's normal, radians.
        relative : float
            Angle of the leaving light from the plane of incidence on the far side of the normal, radians.
        """
        specular = np.array([np.sin(arriving), 0.0, np.cos(arriving)])
        out = np.array([np.sin(leaving) * np.cos(relative), np.sin(leaving) * np.sin(relative), np.cos(leaving)])
        toward = np.array([-np.cos(arriving), 0.0, np.sin(arriving)])
        side = np.cross(specular, toward)
        radial = float(np.arccos(np.clip(specular @ out, -1.0, 1.0)))
        if radial > self.radial[-1]:
            return None
        azimuth = float(np.arctan2(out @ side, out @ toward))
        return float(self.bsdf(arriving, np.array([azimuth]), np.array([radial]))[0])


@dataclass(frozen=True, eq=False)
class ScatterSampling:
    """Distributions of a table's scattered light, for angles of incidence from 0 to 90 degrees in ``STEPS`` intervals.

    Attributes
    ----------
    share : (STEPS + 1,) ndarray
        Total integrated scatter, as a fraction of the incident power.
    rings : (STEPS + 1, rings + 1) ndarray
        Cumulative fractions of the scattered power by ring (interval of the radial angle), from 0 to 1.
    sectors : (STEPS + 1, rings, sectors + 1) ndarray
        Cumulative fractions by sector (interval of the azimuth) in each ring, from 0 to 1.
    cosines : (rings + 1,) ndarray
        Cosines of the rings' edges, descending.
    azimuths : (sectors + 1,) ndarray
        Azimuths of the sectors' edges, radians.
    mirrored : bool
        True when half of the directions go to the other side of the plane of incidence.
    """

    share: np.ndarray
    rings: np.ndarray
    sectors: np.ndarray
    cosines: np.ndarray
    azimuths: np.ndarray
    mirrored: bool


def _interpolated(table: np.ndarray, knots: int, cells: int, fraction: float) -> np.ndarray:
    """Return values of N functions, linear between knots, at the same relative position in every cell, (N, cells).

    ``table`` (N, knots) holds the values at the knots, and ``fraction`` is the position in a cell, 0 to 1.
    """
    if knots == 1:
        return np.broadcast_to(table, (len(table), cells))
    position = (np.arange(cells) + fraction) * (knots - 1) / cells
    k = np.minimum(position.astype(int), knots - 2)
    u = position - k
    return np.asarray((1.0 - u) * table[:, k] + u * table[:, k + 1])


def _cumulative(power: np.ndarray) -> np.ndarray:
    """Return the cumulative fractions of N distributions of K powers, (N, K + 1), from 0 to exactly 1.

    They are uniform where there is no power.
    """
    total = np.sum(power, axis=-1, keepdims=True)
    even = np.where(total > 0.0, power, 1.0)
    sums = np.cumsum(even, axis=-1)
    out = np.concatenate([np.zeros_like(sums[:, :1]), sums / sums[:, -1:]], axis=-1)
    out[:, -1] = 1.0
    return out


GRAZING = 1e-12
"""Smallest cosine of incidence that is distinguished from zero; below it the formulas are 0/0."""


def cosine_after(cosine: Any, before: Any, after: Any) -> Any:
    """Return the cosine of the angle of refraction by Snell's law; 0 where the light is totally reflected.

    Parameters
    ----------
    cosine : float or array
        Cosine of the angle of incidence, 0 to 1; float, NumPy or Dr.Jit array, as the other arguments.
    before : float or array
        Refractive index on the side of the incident light.
    after : float or array
        Refractive index on the side of the refracted light.
    """
    ratio = before / after
    cosine2 = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
    return sqrt(select(cosine2 > 0.0, cosine2, 0.0 * cosine2))


def reflectance(cosine: Any, before: Any, after: Any) -> Any:
    """Return the Fresnel reflectance for unpolarised light, 0 to 1; exactly 1 beyond the critical angle.

    The rest of the light is transmitted.

    Parameters
    ----------
    cosine : float or array
        Cosine of the angle of incidence, 0 to 1; float, NumPy or Dr.Jit array, as the other arguments.
    before : float or array
        Refractive index on the side of the incident light.
    after : float or array
        Refractive index on the side of the refracted light.
    """
    s, p = _polarised(cosine, before, after)
    return 0.5 * (s + p)


def _polarised(cosine: Any, before: Any, after: Any) -> tuple[Any, Any]:
    """Return the Fresnel reflectances of light polarised perpendicular (s) and parallel (p) to the plane of incidence.

    Parameters
    ----------
    cosine : float or array
        Cosine of the angle of incidence, 0 to 1.
    before, after : float or array
        Refractive indices on the side of the incident and of the refracted light.
    """
    cosine = select(cosine > GRAZING, cosine, 0.0 * cosine + GRAZING)
    bent = cosine_after(cosine, before, after)
    s = (before * cosine - after * bent) / (before * cosine + after * bent)
    p = (after * cosine - before * bent) / (after * cosine + before * bent)
    return s * s, p * p


def fresnel(angle: ArrayLike, before: float, after: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute the Fresnel reflectances of an uncoated surface for both polarisations.

    Parameters
    ----------
    angle : array_like
        Angles of incidence, radians, 0 to pi/2, any shape.
    before, after : float
        Refractive indices on the side of the incident and of the refracted light, at least 1.

    Returns
    -------
    s, p : ndarray
        Fractions of the power that are reflected, polarised perpendicular (s) and parallel (p) to the plane of
        incidence, of the shape of ``angle``; exactly 1 beyond the critical angle. The rest is transmitted.

    Raises
    ------
    ValueError
        An angle or an index is out of its range.

    Examples
    --------
    Glass of index 1.5 reflects 4 % at normal incidence, and at Brewster's angle no p polarised light:

    >>> s, p = fresnel([0.0, np.arctan(1.5)], 1.0, 1.5)
    >>> s.round(4), p.round(4)
    (array([0.04  , 0.1479]), array([0.04, 0.  ]))

    Beyond the critical angle of 41.8 degrees inside the glass the reflection is total:

    >>> fresnel(np.radians([41.0, 42.0]), 1.5, 1.0)[0].round(2)
    array([0.53, 1.  ])
    """
    angles = np.asarray(angle, float)
    if not np.all((angles >= 0.0) & (angles <= 0.5 * np.pi)):
        raise ValueError("angles of incidence must be between 0 and pi/2 radians")
    if not (1.0 <= before < np.inf and 1.0 <= after < np.inf):
        raise ValueError(f"refractive indices must be at least 1, got {before} and {after}")
    s, p = _polarised(np.cos(angles), before, after)
    return np.asarray(s), np.asarray(p)


@dataclass(frozen=True)
class Finish:
    """Optical properties of one side of a surface: the fractions of light that it reflects, transmits and scatters.

    Attributes
    ----------
    reflectance : float
        Fraction that is reflected, in the specular direction or into the scatter lobe about it.
    transmission : float
        Fraction that is transmitted (refracted); beyond the critical angle all of it is reflected instead.
    diffuse : float
        Fraction scattered by Lambert's law to the side that the light came from.
    scatter : ABg or HarveyShack, optional
        Lobe about the specular and the refracted direction; its light is taken from these two.
    bare : bool
        True for bare glass: reflectance and transmission follow Fresnel's formulas and must be given as 0.
    records : bool
        True when the absorbed light counts as detected.
    coating : CoatingTable, optional
        Measured coating, instead of reflectance and transmission; light is transmitted where transmission is not 0.
    table : ScatterTable, optional
        Measured scattering about the specular direction, instead of ``scatter``; its light is taken from the reflected
        fraction.
    scattered_only : bool
        True when only the table's scattered light is reflected; reflectance is then given as 0.

    Raises
    ------
    ValueError
        A fraction is negative, or they add up to more than 1.
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
        """Check that the fractions are possible together."""
        self._check_table()
        shares = (self.reflectance, self.transmission, self.diffuse)
        if min(shares) < 0.0 or sum(shares) > 1.0 + 1e-12:
            raise ValueError(
                f"reflected, transmitted and diffused shares must be 0 or more and at most 1, found {shares}"
            )
        if self.bare and any(shares):
            raise ValueError("a bare glass surface takes its shares from Fresnel's formulas; leave them 0")

    def _check_table(self) -> None:
        """Check that the table scatters no more than is reflected."""
        if self.bare and (self.coating is not None or self.table is not None):
            raise ValueError("bare glass can have neither a coating nor a scatter table")
        if self.scattered_only and (self.table is None or self.reflectance > 0.0):
            raise ValueError("a finish that reflects only scattered light needs a scatter table and a reflectance of 0")
        if self.table is None:
            return
        if self.scatter is not None or self.transmission > 0.0:
            raise ValueError("a scatter table replaces the lobe, on a surface that transmits no light")
        for k in range(STEPS if not self.scattered_only else 0):
            angle = 0.5 * np.pi * k / STEPS
            reflected = self.reflectance if self.coating is None else self.coating.at(angle, False)[0]
            if self.table.sampling.share[k] > reflected:
                raise ValueError(
                    f"at {np.degrees(angle):.0f} deg the table scatters {self.table.sampling.share[k]:.4g} of the "
                    f"light, but only {reflected:.4g} is reflected"
                )
        if self.scattered_only and float(np.max(self.table.sampling.share)) + self.diffuse > 1.0:
            raise ValueError("the scattered and diffused light together exceed the incident light")

    @property
    def numbers(self) -> tuple[float, ...]:
        """Numbers for the path tracer.

        They are reflectance, transmission, 1 for bare glass (else 0), diffuse fraction, and the four numbers of the
        scatter lobe (``Lobe.numbers``).
        """
        lobe = (0.0, 1.0, 2.0, 0.0) if self.scatter is None else self.scatter.lobe.numbers
        return (self.reflectance, self.transmission, float(self.bare), self.diffuse, *lobe)


POLISH = ABg(2.0e-6, 1.0e-6, 2.0)
"""Scatter of a polished mirror of about 1 nm rms roughness: total integrated scatter 9e-5.

The formula (4 pi roughness / wavelength) squared would give 3.7e-4 at 650 nm over all spatial periods; about a quarter
of it falls into the angles that the lobe covers.
"""

PAINT = ABg(5.0e-3, 0.1, 2.0)
"""Scatter lobe of black paint about the specular direction, around its weak gloss."""

MIRROR = Finish(reflectance=0.98, scatter=POLISH)
"""Metal mirror with a protected coating."""

COATED = Finish(reflectance=0.0025, transmission=0.9975)
"""Glass with an anti-reflection coating: a residual reflectance of 0.25 %."""

BARE = Finish(bare=True)
"""Polished bare glass."""

GROUND = Finish(diffuse=0.04)
"""Ground and blackened surface of glass: 4 % of the light is scattered by Lambert's law, on either side."""

BLACK = Finish(reflectance=0.005, diffuse=0.035, scatter=PAINT)
"""Diffuse black paint: 4 % of the light comes back, most of it by Lambert's law."""

SILICON = Finish(reflectance=0.3, records=True)
"""Bare silicon detector, which records all the light it does not reflect."""

ABSORBER = Finish()
"""Perfectly black surface, which absorbs all light."""

COATING_STEPS = 360
"""Number of intervals of the angle of incidence, from 0 to 90 degrees, of a coating's lookup table."""


@dataclass(frozen=True, eq=False)
class CoatingTable:
    """Measured coating at one wavelength, for unpolarised light.

    Values are linear between the angles and constant beyond the last one.

    Attributes
    ----------
    angles : (K,) ndarray
        K angles of incidence on the side of air, ascending from 0, radians.
    reflectance : (K,) ndarray
        Reflectance, 0 to 1.
    transmittance : (K,) ndarray, optional
        Transmittance, 0 to 1; None where it is not known.

    Raises
    ------
    ValueError
        Angles do not ascend, or reflectance and transmittance are impossible.
    """

    angles: np.ndarray
    reflectance: np.ndarray
    transmittance: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Copy and freeze the arrays, and check them."""
        names = ("angles", "reflectance", *(("transmittance",) if self.transmittance is not None else ()))
        for name in names:
            array = np.array(getattr(self, name), np.float64)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if not np.all(np.diff(self.angles) > 0.0) or self.angles[0] < 0.0 or self.angles[-1] > 0.5 * np.pi:
            raise ValueError("angles of incidence must ascend between 0 and 90 degrees")
        through = np.zeros_like(self.reflectance) if self.transmittance is None else self.transmittance
        if not self.reflectance.shape == through.shape == self.angles.shape:
            raise ValueError("a coating needs one reflectance, and one transmittance, for each angle")
        if min(np.min(self.reflectance), np.min(through)) < 0.0 or np.max(self.reflectance + through) > 1.0 + 1e-9:
            raise ValueError("reflectance and transmittance lie between 0 and 1, also together")

    def at(self, angle: float, through: bool) -> tuple[float, float]:
        """Return reflectance and transmittance at an angle of incidence.

        Parameters
        ----------
        angle : float
            Angle of incidence, radians.
        through : bool
            True when light is transmitted; if the transmittance is not known, all light that is not reflected is.
        """
        reflected = float(np.interp(angle, self.angles, self.reflectance))
        if not through:
            return reflected, 0.0
        if self.transmittance is None:
            return reflected, 1.0 - reflected
        return reflected, float(np.interp(angle, self.angles, self.transmittance))

    def sampled(self, through: bool) -> np.ndarray:
        """Return reflectance and transmittance at even steps from 0 to 90 degrees, (COATING_STEPS + 1, 2).

        ``through`` is True when light is transmitted.
        """
        return np.array([self.at(float(angle), through) for angle in np.linspace(0.0, 0.5 * np.pi, COATING_STEPS + 1)])
