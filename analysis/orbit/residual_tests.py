"""What the residuals of an adjustment say: robust weights, variance components, and terms that the model leaves out.

A term g that moves the misclosures by G g and is not solved for leaves the estimates wrong by C N_xg g, with C their
covariance and N the normal matrix with g among the unknowns. What the residuals say of it is the gradient s at g = 0,
of covariance S = N_gg - N_gx C N_xg: the estimate is -S^-1 s, and s' S^-1 s is chi-square where there is no such term
and the sigmas are right (Lagrange multiplier test; Rao, Proc. Camb. Phil. Soc. 44 (1948) 50). S is the exact
covariance, so the test holds for six points as for six hundred.

Terms here: rates of the attitude during each field; slow courses along each line, cosines of the exposure time over the
time of the line, in x and in y, by which residuals of neighbouring exposures are alike; steps within a line.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from analysis.orbit.calibration_parameters import CalibrationField, Prior
from analysis.orbit.normal_equations import Equations, Weights
from analysis.orbit.three_line_model import Partials, Rays

Array = NDArray[np.float64]
Robust = Literal["huber", "igg"]
# Lengths of standardised residuals of image points, Rayleigh for good ones. Beyond HUBER lie 5 in 100 good points, they
# lose weight; beyond REJECT 1 in 10 000, they are left out (IGG III: Yang, Song and Xu, J. Geodesy 76 (2002) 353).
HUBER = float(np.sqrt(chi2.isf(0.05, 2)))
REJECT = float(np.sqrt(chi2.isf(1e-4, 2)))
# Fewer redundant observations give a variance to 45 per cent or worse (sqrt(2 / 10)): the group keeps its factor.
_LEAST_REDUNDANCY = 10.0
# A part of an image point that no other observation checks has no residual to standardise.
_UNCHECKED = 1e-6
_LARGEST_RATIO = 0.9
LARGEST_FACTOR = 1e2
"""Largest factor on a variance; the smallest is its inverse. Weights cannot correct sigmas that are wrong by more than
a factor of ten.
"""


def standardised(equations: Equations, cofactors: Array, weights: Weights) -> Array:
    """(M, 2) residuals of the image points over their own standard deviation.

    An observation of variance C that takes part with weight w, G that of the adjusted one: without it the others would
    predict it with H = G / (1 - w G / C), and the residual is (1 - w G / C) times observed minus predicted. Its
    variance is (1 - w G / C) (C + (1 - w) G): less than C with full weight, C + G without any. So the standardised
    residual does not depend on the observation's own weight, which could otherwise swing for ever where others hardly
    check it. It is exact where the weights of the others stand for their variances.

    Args:
        equations: of M image points.
        cofactors: of the adjusted image points, (M, 2, 2), metres^2.
        weights: of the observations.
    """
    return standardised_packets(equations.residuals.image, cofactors, weights.image, weights.factor["image"])


def standardised_packets(residual: Array, cofactors: Array, weight: Array, unit: float) -> Array:
    """(n, d) whitened residuals of n packets of d rows over their own standard deviation; see `standardised`.

    Args:
        residual: whitened, (n, d).
        cofactors: covariance of the adjusted packets, whitened, (n, d, d).
        weight: robust weights, (n,).
        unit: variance factor of their group.
    """
    values, axes = np.linalg.eigh(cofactors)
    along = np.einsum("nji,nj->ni", axes, residual)
    weight = weight[:, None]
    left = 1.0 - weight * values / unit
    checked = left > _UNCHECKED
    spread = np.where(checked, left, 1.0) * (unit + (1.0 - weight) * np.maximum(values, 0.0))
    along = np.where(checked, along / np.sqrt(spread), 0.0)
    return np.asarray(np.einsum("nij,nj->ni", axes, along))


def robust_weights(standard: Array, kind: Robust | Literal["accept"]) -> Array:
    """(n,) weights of packets from their standardised residuals (n, d), d = 2 for image points.

    Huber's, IGG III that ends in zero, or "accept": 1 up to that end and zero beyond.
    """
    size = np.linalg.norm(standard, axis=1)
    huber, reject = limits(standard.shape[1])
    if kind == "accept":
        return np.asarray(size <= reject, np.float64)
    weight = np.minimum(1.0, huber / np.maximum(size, 1e-300))
    if kind == "huber":
        return np.asarray(weight)
    if kind != "igg":
        raise ValueError(f"robust weights: kind must be huber, igg or accept, found {kind!r}")
    fall = np.clip((reject - size) / (reject - huber), 0.0, 1.0)
    return np.asarray(np.where(size <= huber, 1.0, weight * fall**2))


def limits(rows: int) -> tuple[float, float]:
    """Lengths of standardised residuals of so many rows from which on a packet loses weight, and is left out."""
    return float(np.sqrt(chi2.isf(0.05, rows))), float(np.sqrt(chi2.isf(1e-4, rows)))


def median_factor(standard: Array) -> float:
    """Square of the scale of standardised residuals (M, 2) by their median: half of them may be wrong."""
    # median of chi-square with two degrees of freedom is 2 ln 2
    return float(np.median(np.sum(standard**2, axis=1)) / (2.0 * np.log(2.0)))


def bounded(factor: float) -> float:
    """A variance factor within its bounds."""
    return float(np.clip(factor, 1.0 / LARGEST_FACTOR, LARGEST_FACTOR))


def variance_components(
    equations: Equations, covariance: Array, cofactors: Array, weights: Weights, priors: Sequence[Prior]
) -> tuple[dict[str, float], dict[str, float]]:
    """One step of Foerstner's estimate: group -> new factor on its variances, group -> redundancy.

    factor' = factor v'Pv / r with r the redundancy of the group, within 1 / `LARGEST_FACTOR` and `LARGEST_FACTOR`. It
    is unbiased for image points of weight 1 and 0; a weight that falls with the residual makes it too small.

    Args:
        equations: of M image points.
        covariance: of the P unknowns, (P, P), SI.
        cofactors: of the adjusted image points, (M, 2, 2), metres^2.
        weights: of the observations.
        priors: further observations of the unknowns.
    """
    residuals, factor = equations.residuals, weights.factor
    adjusted = np.trace(cofactors, axis1=1, axis2=2) / factor["image"]
    square = {"image": float(np.sum(weights.image * np.sum(residuals.image**2, axis=1)) / factor["image"])}
    redundancy = {"image": float(2.0 * np.sum(weights.image > 0) - np.sum(weights.image * adjusted))}
    points = equations.point_covariance(covariance)
    # control_weight is block diagonal: the sum of products is the trace with the points' own blocks
    coordinates = equations.control_weight.tocoo()
    same = coordinates.row // 3 == coordinates.col // 3
    row, column = coordinates.row[same], coordinates.col[same]
    taken = float(np.sum(coordinates.data[same] * points[row // 3, row % 3, column % 3]))
    square["control"] = float(np.sum(residuals.control**2) / factor["control"])
    redundancy["control"] = float(np.sum(equations.control_weight.diagonal() > 0)) - taken
    own = equations.prior_weight * np.einsum("kp,pq,kq->k", equations.design_prior, covariance, equations.design_prior)
    for group in dict.fromkeys(p.group for p in priors):
        member = np.array([p.group == group for p in priors])
        square[group] = float(np.sum((equations.prior_weight * residuals.prior**2)[member]))
        redundancy[group] = float(np.sum(1.0 - own[member]))
    square |= {g: v / factor[g] for g, v in residuals.shared.items()}
    redundancy |= equations.shared_redundancy(covariance)
    new = {
        g: bounded(factor[g] * square[g] / redundancy[g]) if redundancy[g] >= _LEAST_REDUNDANCY else float(factor[g])
        for g in square
    }
    return new, redundancy


def extrapolated(factors: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Where three rounds of variance factors lead to, by Aitken's rule in the logarithm.

    Factors of groups that check each other creep: rounds leave up to nine tenths of the way.
    """
    found = {}
    for group in factors[-1]:
        first, middle, last = (float(np.log(max(f[group], 1e-300))) for f in factors)
        ratio = (last - middle) / (middle - first) if middle != first else 0.0
        ratio = min(max(ratio, 0.0), _LARGEST_RATIO)
        found[group] = bounded(float(np.exp(last + (last - middle) * ratio / (1.0 - ratio))))
    return found


FALSE_ALARM = 5e-5
"""False-alarm rate of each of the two tests of a run, rates and courses, over all fields together: 1e-4 a run."""
_WAVES = 4
_POINTS_PER_WAVE = 4
_RANK = 1e-9
"""Smallest eigenvalue of S that counts, relative to the largest. No residual shows a term that the unknowns imitate."""


@dataclass(frozen=True, eq=False)
class Rates:
    """A drift of the attitude during each field, radians per second about the body's axes, zero at its mean time.

    middles: field -> mean time of its rays, seconds; fields without times are left out.
    """

    middles: Mapping[str, float]

    @classmethod
    def of(cls, fields: Sequence[CalibrationField]) -> Rates:
        """Rates of all fields whose rays have times."""
        times = {f.name: [r.time for r in f.rays.values() if r.time is not None and r.point.size] for f in fields}
        return cls({name: float(np.mean(np.concatenate(rows))) for name, rows in times.items() if rows})

    @property
    def size(self) -> int:
        """Number of terms."""
        return 3 * len(self.middles)

    def columns(self, field: CalibrationField, line: str, rays: Rays, by: Partials) -> Array:
        """(n, 2, size) derivatives of the misclosures.

        Args:
            field: the pass.
            line: of the camera.
            rays: n image points of it.
            by: derivatives of their misclosures.
        """
        found = np.zeros((len(rays.point), 2, self.size))
        if rays.time is not None and field.name in self.middles:
            first = 3 * list(self.middles).index(field.name)
            since = (rays.time - self.middles[field.name])[:, None, None]
            found[:, :, first : first + 3] = by.attitude * since
        return found


@dataclass(frozen=True, eq=False)
class Courses:
    """Slow courses of x and y along the time of each line of each field, metres in the image: cosines of up to four
    half periods, the constant apart.

    waves: (field, line) -> (begin, duration, number of the first term, how many of each of x and y).
    """

    waves: Mapping[tuple[str, str], tuple[float, float, int, int]]

    @classmethod
    def of(cls, fields: Sequence[CalibrationField]) -> Courses:
        """Courses of all lines with times and enough points."""
        found: dict[tuple[str, str], tuple[float, float, int, int]] = {}
        first = 0
        for one in fields:
            for line, rays in one.rays.items():
                if rays.time is None or not rays.point.size or not np.ptp(rays.time):
                    continue
                count = min(_WAVES, len(rays.point) // _POINTS_PER_WAVE)
                if count:
                    found[one.name, line] = (float(rays.time.min()), float(np.ptp(rays.time)), first, count)
                    first += 2 * count
        return cls(found)

    @property
    def size(self) -> int:
        """Number of terms."""
        return sum(2 * count for *_, count in self.waves.values())

    def columns(self, field: CalibrationField, line: str, rays: Rays, by: Partials) -> Array:
        """(n, 2, size) derivatives of the misclosures.

        Args:
            field: the pass.
            line: of the camera.
            rays: n image points of it.
            by: derivatives of their misclosures.
        """
        found = np.zeros((len(rays.point), 2, self.size))
        if (field.name, line) in self.waves and rays.time is not None:
            begin, span, first, count = self.waves[field.name, line]
            wave = np.cos(np.pi * np.arange(1, count + 1) * (rays.time[:, None] - begin) / span)
            found[:, 0, first : first + count] = wave
            found[:, 1, first + count : first + 2 * count] = wave
        return found


@dataclass(frozen=True, eq=False)
class Steps:
    """A step of x and of y within a line, metres: all image points beyond a place of the line are displaced.

    places: (line, y of the place in metres).
    """

    places: tuple[tuple[str, float], ...]

    @property
    def size(self) -> int:
        """Number of terms."""
        return 2 * len(self.places)

    def columns(self, field: CalibrationField, line: str, rays: Rays, by: Partials) -> Array:
        """(n, 2, size) derivatives of the misclosures: an image point displaced by 1 m has one that is 1 m larger.

        Args:
            field: the pass.
            line: of the camera.
            rays: n image points of it.
            by: derivatives of their misclosures.
        """
        found = np.zeros((len(rays.point), 2, self.size))
        for k, (name, place) in enumerate(self.places):
            if name == line:
                beyond = rays.image[:, 1] > place
                found[beyond, 0, 2 * k] = found[beyond, 1, 2 * k + 1] = -1.0
        return found


HiddenTerms = Rates | Courses | Steps


@dataclass(frozen=True, eq=False)
class Unseen:
    """What the residuals say of terms that are left out.

    Attributes:
        terms: which, G of them.
        score: (G,) gradient. cofactor: (G, G) its covariance, S.
        moved: (P, G) by how much the estimates are wrong for a term of one unit.
    """

    terms: HiddenTerms
    score: Array
    cofactor: Array
    moved: Array

    @classmethod
    def of(cls, terms: HiddenTerms, wide: Equations, covariance: Array) -> Unseen:
        """Read equations that contain the terms, at a solution.

        Args:
            terms: G of them.
            wide: equations of P unknowns and the G terms, which are zero.
            covariance: of the P unknowns, (P, P), SI.
        """
        count = len(covariance)
        moved = covariance @ wide.reduced[:count, count:]
        cofactor = wide.reduced[count:, count:] - wide.reduced[count:, :count] @ moved
        return cls(terms, wide.right[count:], 0.5 * (cofactor + cofactor.T), moved)

    @property
    def estimate(self) -> Array:
        """(G,) all terms together; a term that nothing tells is zero."""
        return np.asarray(-self._inverse @ self.score)

    @property
    def sigma(self) -> Array:
        """(G,) of `estimate`; infinite where nothing tells a term."""
        spread = np.diag(self._inverse)
        return np.sqrt(np.where(np.diag(self.cofactor) > _RANK * self._largest, spread, np.inf))

    @property
    def sigma_alone(self) -> Array:
        """(G,) of each term where there is no other."""
        own = np.diag(self.cofactor)
        seen = own > _RANK * self._largest
        return np.asarray(np.where(seen, 1.0 / np.sqrt(np.where(seen, own, 1.0)), np.inf))

    @property
    def degrees_of_freedom(self) -> int:
        """Number of combinations of the terms that the residuals can show."""
        return int(np.linalg.matrix_rank(self._unit, tol=1e-6, hermitian=True)) if len(self.score) else 0

    @property
    def chi_square(self) -> float:
        """Chi-square of all terms together."""
        return float(self.score @ self._inverse @ self.score) if len(self.score) else 0.0

    @property
    def p_value(self) -> float:
        """Chance of such a chi-square where none of these terms is there; 1 where residuals show none."""
        return float(chi2.sf(self.chi_square, self.degrees_of_freedom)) if self.degrees_of_freedom else 1.0

    @property
    def _largest(self) -> float:
        return float(np.diag(self.cofactor).max(initial=0.0))

    @property
    def _size(self) -> Array:
        return np.asarray(np.sqrt(np.maximum(np.diag(self.cofactor), 1e-300)))

    @property
    def _unit(self) -> Array:
        return np.asarray(self.cofactor / self._size / self._size[:, None])

    @property
    def _inverse(self) -> Array:
        inner = np.linalg.pinv(self._unit, rcond=1e-6, hermitian=True)
        return np.asarray(inner / self._size / self._size[:, None])
