"""Light scattered by surfaces: ABg and Harvey-Shack lobes, Lambertian diffusion, and measured tables.

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

A table gives f (1/sr, scattered radiance over incident irradiance) for angles of incidence t and directions that are
counted from the specular one: the radial angle r away from it, and the azimuth p about it, 0 where the direction leans
toward the surface's normal, counter-clockwise for who looks against the specular light. With n the normal, s the
specular direction, e = (n - cos t s) / sin t and h = s x e the direction is

    w = cos r s + sin r (cos p e + sin p h),        n . w = cos r cos t + sin r cos p sin t,

and the total integrated scatter TIS(t) is the integral of f (n . w) sin r dr dp over all w above the surface. f is
linear in t, p and r between the table's numbers, constant before its first and beyond its last angle of incidence, and
zero beyond its last radial angle.

Sampling. For angles of incidence one degree apart the scattered power is summed over cells that are finer than the
table's; a path takes one of the two angles beside its own, with the probability of the power that it has there, then a
ring of cells, a cell in it, and a place in the cell, even in solid angle. Between two such angles what falls below the
surface by the difference is turned up, so that all that TIS says is scattered.

What a surface does with light in the path tracer: Fresnel's laws, finishes and measured coatings.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import log as real_log
from typing import Any

import numpy as np

from optics.numerics.array_math import exp, log, select, sqrt

WIDEST = 2.0
"""Largest distance of two directions in the plane of direction cosines."""

_FLAT = 1e-9
"""Exponents closer to 2 than twice this take the logarithmic form."""


@dataclass(frozen=True)
class Lobe:
    """A lobe as the sampler uses it.

    Attributes
    ----------
    share : float
        Of the specular power for which a direction is drawn: the integral of the upper bound over d < 2.
    scale : float
        l, in direction cosines.
    exponent : float
        g.
    abg : bool
        Whether draws are thinned to ABg (else Harvey-Shack as drawn).
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

    Raises
    ------
    ValueError
        An impossible number, or more than all of the light would be scattered.
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

        Raises
        ------
        ValueError
            The upper bound holds more than all of the light.
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

    Raises
    ------
    ValueError
        An impossible number, or more than all of the light would be scattered.
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

    Parameters
    ----------
    u : Any
        Uniform in [0, 1), NumPy or Dr.Jit array, as the others.
    scale : Any
        l, in direction cosines.
    exponent : Any
        g.
    """
    q = 1.0 - 0.5 * exponent
    level = log(1.0 + (WIDEST / scale) * (WIDEST / scale))
    flat = abs(q) < _FLAT
    safe = select(flat, 0.0 * q + 1.0, q)
    power = exp(log(1.0 + u * (exp(safe * level) - 1.0)) / safe)
    square = select(flat, exp(u * level), power) - 1.0
    return scale * select(square > 0.0, square, 0.0 * square) ** 0.5


def lobe_area(scale: float, exponent: float) -> float:
    """Integral of (1 + (d/l)^2)^(-g/2) over d^2 < WIDEST^2; the function over it is the density of d^2 that
    ``sample_distance`` draws.

    Parameters
    ----------
    scale : float
        l, in direction cosines.
    exponent : float
        g.
    """
    return _harvey_integral(scale, exponent, WIDEST) / float(np.pi)


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


STEPS = 90
"""Intervals of the angle of incidence, from 0 to 90 degrees, for which directions are drawn."""
LEAST_RINGS, LEAST_SECTORS = 240, 36
MOST_CELLS = 120_000
"""Rings times sectors of a table at most."""
_CHECKED = np.arange(0.0, 91.0, 5.0)
"""Angles of incidence, degrees, at which a table is asked whether it scatters more than there is, beside its own."""
_GAUSS = (0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0))


@dataclass(frozen=True, eq=False)
class ScatterTable:
    """BSDF in specular-relative angles.

    Attributes
    ----------
    incidence : np.ndarray
        Ascending, radians, (I,).
    azimuth : np.ndarray
        Ascending, radians, (A,): a single one for a lobe that is round, 0 to pi for one that is the same on both sides
        of the plane of incidence, else 0 to 2 pi.
    radial : np.ndarray
        Ascending from 0, radians, (R,).
    values : np.ndarray
        1/sr, (I, A, R).

    Raises
    ------
    ValueError
        Angles that do not ascend or do not span what they must, negative values, or more than all of the light
        scattered.
    """

    incidence: np.ndarray
    azimuth: np.ndarray
    radial: np.ndarray
    values: np.ndarray

    def __post_init__(self) -> None:
        """Copy, freeze and check."""
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
            raise ValueError(f"it would scatter {largest:.4g} of the light; no surface scatters more than 1")

    @property
    def rings(self) -> int:
        """Cells along the radial angle: every interval of the table the same number of times."""
        intervals = len(self.radial) - 1
        return intervals * -(-LEAST_RINGS // intervals)

    @property
    def sectors(self) -> int:
        """Cells along the azimuth, over half a turn or the whole."""
        intervals = max(len(self.azimuth) - 1, 1)
        return intervals * -(-LEAST_SECTORS // intervals)

    @property
    def mirrored(self) -> bool:
        """Whether azimuths end at half a turn, and the other half is the same."""
        return len(self.azimuth) == 1 or self.azimuth[-1] < 1.5 * np.pi

    def bsdf(self, incidence: float, azimuth: np.ndarray, radial: np.ndarray) -> np.ndarray:
        """BSDF at one angle of incidence, 1/sr.

        Parameters
        ----------
        incidence : float
            radians.
        azimuth : np.ndarray
            Radians, any; shape S.
        radial : np.ndarray
            Radians, 0 to pi; shape S.
        """
        table = self._at(incidence)
        turn = np.mod(azimuth, 2.0 * np.pi)
        turn = np.minimum(turn, 2.0 * np.pi - turn) if self.mirrored else turn
        r = np.asarray(radial, np.float64)
        k = np.clip(np.searchsorted(self.radial, r, side="right") - 1, 0, len(self.radial) - 2)
        u = (r - self.radial[k]) / (self.radial[k + 1] - self.radial[k])
        if len(self.azimuth) == 1:
            low = high = np.zeros(r.shape, int)
            v = np.zeros(r.shape)
        else:
            low = np.clip(np.searchsorted(self.azimuth, turn, side="right") - 1, 0, len(self.azimuth) - 2)
            high = low + 1
            v = (turn - self.azimuth[low]) / (self.azimuth[high] - self.azimuth[low])
        f = (1.0 - v) * ((1.0 - u) * table[low, k] + u * table[low, k + 1])
        f += v * ((1.0 - u) * table[high, k] + u * table[high, k + 1])
        return np.where(r <= self.radial[-1] * (1.0 + 1e-12), f, 0.0)

    def _at(self, incidence: float) -> np.ndarray:
        """The table at one angle of incidence, (A, R)."""
        place = np.interp(incidence, self.incidence, np.arange(len(self.incidence)))
        k = min(int(place), max(len(self.incidence) - 2, 0))
        w = place - k
        return (1.0 - w) * self.values[k] + (w * self.values[k + 1] if w > 0.0 else 0.0)

    def total(self, incidence: float) -> float:
        """Total integrated scatter at an angle of incidence in radians, share of the incident power."""
        return float(np.sum(self._power(incidence)))

    @cached_property
    def _edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Radial and azimuthal edges of the cells, radians."""
        span = self.azimuth if len(self.azimuth) > 1 else np.array([0.0, np.pi])
        out = []
        for axis, count in ((self.radial, self.rings), (span, self.sectors)):
            place = np.linspace(0.0, len(axis) - 1, count + 1)
            out.append(np.interp(place, np.arange(len(axis)), axis))
        return out[0], out[1]

    def _power(self, incidence: float) -> np.ndarray:
        """Scattered share into each cell, (rings, sectors), both halves together where they are the same."""
        table, (radial, azimuth) = self._at(incidence), self._edges
        power = np.zeros((self.rings, self.sectors))
        dr, dp = np.diff(radial)[:, None], np.diff(azimuth)[None, :]
        for a in _GAUSS:
            along = _between(table, len(self.radial), self.rings, a)  # (A, rings)
            r = radial[:-1, None] + a * dr
            rise, lean = np.cos(r) * np.cos(incidence), np.sin(r) * np.sin(incidence)
            for b in _GAUSS:
                f = _between(along.T, len(self.azimuth), self.sectors, b)
                up = rise + lean * np.cos(azimuth[None, :-1] + b * dp)
                power += 0.25 * f * np.maximum(up, 0.0) * np.sin(r)
        return power * dr * dp * (2.0 if self.mirrored else 1.0)

    @cached_property
    def drawn(self) -> DrawnScatter:
        """Distributions from which directions are drawn."""
        radial, azimuth = self._edges
        share, rings, sectors = [], [], []
        for angle in np.linspace(0.0, 0.5 * np.pi, STEPS + 1):
            power = self._power(float(angle))
            share.append(np.sum(power))
            rings.append(_cumulative(np.sum(power, axis=1)[None])[0])
            sectors.append(_cumulative(power))
        return DrawnScatter(np.array(share), np.array(rings), np.array(sectors), np.cos(radial), azimuth, self.mirrored)

    def reciprocity(self) -> float:
        """Rms of the relative difference of f with its directions exchanged; 0 for a reciprocal surface.

        Of pairs of directions, even over the hemisphere and up to 80 degrees from the normal, for which the table knows
        both; not a number where it knows none.
        """
        rng = np.random.default_rng(1)
        low, high = self.incidence[0], max(self.incidence[-1], self.incidence[0])
        top = min(np.radians(80.0), high)
        if not top > low:
            return float("nan")
        one, two = (np.arccos(rng.uniform(np.cos(top), np.cos(low), 400)) for _ in range(2))
        turn = rng.uniform(0.0, np.pi, 400)
        differences = []
        for a, b, p in zip(one, two, turn, strict=True):
            there, back = self._between(a, b, p), self._between(b, a, p)
            if there is not None and back is not None and there + back > 0.0:
                differences.append((there - back) / (0.5 * (there + back)))
        # to 1e-9: below is the rounding of angles
        return round(float(np.sqrt(np.mean(np.square(differences)))), 9) if differences else float("nan")

    def _between(self, arriving: float, leaving: float, turn: float) -> float | None:
        """BSDF from one polar angle to another, ``turn`` from the plane of incidence on the far side of the normal."""
        specular = np.array([np.sin(arriving), 0.0, np.cos(arriving)])
        out = np.array([np.sin(leaving) * np.cos(turn), np.sin(leaving) * np.sin(turn), np.cos(leaving)])
        toward = np.array([-np.cos(arriving), 0.0, np.sin(arriving)])
        side = np.cross(specular, toward)
        radial = float(np.arccos(np.clip(specular @ out, -1.0, 1.0)))
        if radial > self.radial[-1]:
            return None
        azimuth = float(np.arctan2(out @ side, out @ toward))
        return float(self.bsdf(arriving, np.array([azimuth]), np.array([radial]))[0])


@dataclass(frozen=True, eq=False)
class DrawnScatter:
    """What directions are drawn from, for angles of incidence from 0 to 90 degrees in ``STEPS`` intervals.

    Attributes
    ----------
    share : np.ndarray
        TIS, (STEPS + 1,).
    rings : np.ndarray
        Cumulative shares of the rings, from 0 to 1, (STEPS + 1, rings + 1).
    sectors : np.ndarray
        In each ring those of its sectors, (STEPS + 1, rings, sectors + 1).
    cosines : np.ndarray
        Of the rings' edges, descending, (rings + 1,).
    azimuths : np.ndarray
        The sectors' edges, radians, (sectors + 1,).
    mirrored : bool
        Whether half of the draws go to the other side of the plane of incidence.
    """

    share: np.ndarray
    rings: np.ndarray
    sectors: np.ndarray
    cosines: np.ndarray
    azimuths: np.ndarray
    mirrored: bool


def _between(table: np.ndarray, knots: int, cells: int, place: float) -> np.ndarray:
    """Values (N, knots), linear between knots, at a place of each of the cells that divide them, (N, cells)."""
    if knots == 1:
        return np.broadcast_to(table, (len(table), cells))
    at = (np.arange(cells) + place) * (knots - 1) / cells
    k = np.minimum(at.astype(int), knots - 2)
    u = at - k
    return np.asarray((1.0 - u) * table[:, k] + u * table[:, k + 1])


def _cumulative(power: np.ndarray) -> np.ndarray:
    """Cumulative shares along the last axis, from 0 to exactly 1, (N, K + 1); even where there is no power."""
    total = np.sum(power, axis=-1, keepdims=True)
    even = np.where(total > 0.0, power, 1.0)
    sums = np.cumsum(even, axis=-1)
    out = np.concatenate([np.zeros_like(sums[:, :1]), sums / sums[:, -1:]], axis=-1)
    out[:, -1] = 1.0
    return out


GRAZING = 1e-12
"""Smallest cosine of incidence that is told from zero; below it the formulas are 0/0."""


def cosine_after(cosine: Any, before: Any, after: Any) -> Any:
    """Cosine of the angle of refraction by Snell's law, 0 where the light is totally reflected.

    Parameters
    ----------
    cosine : Any
        Of the angle of incidence, 0 to 1; float, NumPy or Dr.Jit array, as the others.
    before : Any
        Refractive index on the side of the incident light.
    after : Any
        On the side of the refracted light.
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

    Attributes
    ----------
    reflectance : float
        Share reflected, specular or into the scatter lobe around the specular direction.
    transmission : float
        Share that goes through (refracted); beyond the critical angle all of it is reflected instead.
    diffuse : float
        Share diffused by Lambert's law to the side the light came from.
    scatter : Scatter | None
        Lobe around the specular and the refracted direction, which takes its share out of them.
    bare : bool
        Bare glass: reflectance and transmission are Fresnel's and must be given as 0.
    records : bool
        Whether the light that is absorbed counts as detected.
    coating : CoatingTable | None
        Measured, in place of reflectance and transmission; light goes through where transmission is not 0.
    table : ScatterTable | None
        Measured scattering about the specular direction, in place of ``scatter``: what it scatters comes out of what is
        reflected.
    scattered_only : bool
        Whether nothing is reflected but what the table scatters; reflectance is then given as 0.

    Raises
    ------
    ValueError
        The shares are impossible.
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
        for k in range(STEPS if not self.scattered_only else 0):
            angle = 0.5 * np.pi * k / STEPS
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

COATING_STEPS = 360
"""Intervals of the angle of incidence, from 0 to 90 degrees, in which a path looks a coating up."""


@dataclass(frozen=True, eq=False)
class CoatingTable:
    """A coating at one wavelength, for unpolarised light.

    Attributes
    ----------
    angles : np.ndarray
        Of incidence on the side of air, ascending from 0, radians, (K,).
    reflectance : np.ndarray
        0 to 1, (K,).
    transmittance : np.ndarray | None
        0 to 1, (K,); None where it is not told.

    Linear between the angles; constant beyond the last one.

    Raises
    ------
    ValueError
        Angles that do not ascend, shares that are impossible.
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

        Parameters
        ----------
        angle : float
            radians.
        through : bool
            Whether light goes through, where no transmittance is told all that is not reflected.
        """
        reflected = float(np.interp(angle, self.angles, self.reflectance))
        if not through:
            return reflected, 0.0
        if self.transmittance is None:
            return reflected, 1.0 - reflected
        return reflected, float(np.interp(angle, self.angles, self.transmittance))

    def drawn(self, through: bool) -> np.ndarray:
        """Reflectance and transmittance from 0 to 90 degrees, (COATING_STEPS + 1, 2); ``through`` as for ``at``."""
        return np.array([self.at(float(angle), through) for angle in np.linspace(0.0, 0.5 * np.pi, COATING_STEPS + 1)])
