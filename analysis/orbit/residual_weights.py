"""Standardised residuals of an adjustment, and the weights they ask for: robust weights, variance components."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from analysis.orbit.calibration_parameters import Prior
from analysis.orbit.normal_equations import Equations, Weights

__all__ = [
    "HUBER",
    "LARGEST_FACTOR",
    "REJECT",
    "Robust",
    "bounded",
    "extrapolated",
    "median_factor",
    "robust_weights",
    "standardised",
    "variance_components",
]

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
"""Of a variance; its inverse is the smallest. Sigmas that are ten times wrong are no matter of weights any more."""


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
    values, axes = np.linalg.eigh(cofactors)
    along = np.einsum("nji,nj->ni", axes, equations.residuals.image)
    weight, unit = weights.image[:, None], weights.factor["image"]
    left = 1.0 - weight * values / unit
    checked = left > _UNCHECKED
    spread = np.where(checked, left, 1.0) * (unit + (1.0 - weight) * np.maximum(values, 0.0))
    along = np.where(checked, along / np.sqrt(spread), 0.0)
    return np.einsum("nij,nj->ni", axes, along)


def robust_weights(standard: Array, kind: Robust | Literal["accept"]) -> Array:
    """(M,) weights of image points from their standardised residuals (M, 2).

    Huber's, IGG III that ends in zero, or "accept": 1 up to that end and zero beyond.
    """
    size = np.linalg.norm(standard, axis=1)
    if kind == "accept":
        return np.asarray(size <= REJECT, np.float64)
    weight = np.minimum(1.0, HUBER / np.maximum(size, 1e-300))
    if kind == "huber":
        return np.asarray(weight)
    if kind != "igg":
        raise ValueError(f"robust weights: kind must be huber, igg or accept, found {kind!r}")
    fall = np.clip((REJECT - size) / (REJECT - HUBER), 0.0, 1.0)
    return np.asarray(np.where(size <= HUBER, 1.0, weight * fall**2))


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
