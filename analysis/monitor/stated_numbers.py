"""What the sigmas owe to each stated number, and what would be left if the statement had heavy tails.

A number of the statement is one standard deviation that a cause gives to motions of several bodies: ``figure Z7: 2 nm``
of all mirrors. Of an estimate with the error (g A - r B) x + g noise, e = g A - r B, motions i and j make the part
e_i C_ij e_j of the variance V, which goes with the square of the numbers, so that sigma follows a number s with

    d ln sigma / d ln s = sum of e_i (C e)_i / V over the number's motions,

its elasticity: a number of elasticity 0.4 that is 10 % larger makes sigma 4 % larger. For the best estimator this holds
whether it is told of the change or not, since its gain is where the variance is least (the envelope theorem); how large
sigma becomes if the number is twice as large is worked out for both.

A statement that is a guess has heavier tails than a normal one. With each number multiplied by 1 / sqrt(w), w from a
gamma distribution of shape nu / 2 and mean 1, motions have Student's distribution with nu degrees of freedom (Lange,
Little and Taylor, Journal of the American Statistical Association 84, 881 (1989)): rare states are far out, and a
number is then wrong for all bodies at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, ndtr

from analysis.monitor.disturbances import Disturbances
from analysis.monitor.limits import posterior_sigma, split

__all__ = ["DEGREES", "Elasticity", "HeavyTail", "elasticities", "heavy_tails", "stated_numbers", "unseen"]

Array = NDArray[np.float64]
UNSEEN = 0.1
"""Of the noise of a shift: a standard deviation of a motion that moves spots by less has next to no derivative."""
SHARE = 0.01
"""Of the variance of a quantity, from which an unseen body is told of."""
DEGREES = 4.0
"""Degrees of freedom of Student's distribution, for numbers that nobody measured."""
_DRAWS = 8_000
_HALVINGS = 40
_LEVELS = (0.6826894921370859, 0.9544997361036416, 0.9973002039367398)
"""Of 1, 2 and 3 standard deviations of a normal error."""


@dataclass(frozen=True, eq=False)
class Elasticity:
    """How Q quantities follow one stated number.

    Attributes:
        number: its cause and motion: ``mirror_figure figure Z7``.
        size, unit: as stated.
        bodies: that have it.
        elasticity: (Q,) relative change of sigma per relative change of the number.
        doubled: (Q,) sigma of the error if it is twice as large and nobody says so.
        told: (Q,) sigma if it is twice as large and stated so.
    """

    number: str
    size: float
    unit: str
    bodies: tuple[str, ...]
    elasticity: Array
    doubled: Array
    told: Array


@dataclass(frozen=True, eq=False)
class HeavyTail:
    """What a statement with heavy tails would leave of Q quantities, read by the same estimator.

    Attributes:
        degrees: of freedom.
        rms: (Q,) root of the mean square error.
        held: (3, Q) half widths that hold as many errors as 1, 2 and 3 sigma of a normal statement do.
        beyond: (Q,) chance of an error beyond 3 of the stated sigmas, 0.0027 of a normal statement.
    """

    degrees: float
    rms: Array
    held: Array
    beyond: Array


def stated_numbers(stated: Disturbances) -> dict[str, list[int]]:
    """Number -> its motions. Axes that a cause gives the same standard deviation are one number.

    Args:
        stated: what moves.
    """
    sizes: dict[tuple[str, str], set[float]] = {}
    whats = [label.removeprefix(f"{body} ") for label, body in zip(stated.labels, stated.bodies, strict=True)]
    for cause, what, sigma in zip(stated.causes, whats, stated.sigmas.tolist(), strict=True):
        sizes.setdefault((cause, what.split()[0]), set()).add(sigma)
    out: dict[str, list[int]] = {}
    for k, (cause, what) in enumerate(zip(stated.causes, whats, strict=True)):
        kind = what.split()[0]
        alike = kind != "figure" and len(sizes[cause, kind]) == 1
        out.setdefault(f"{cause} {kind if alike else what}", []).append(k)
    return out


def elasticities(rows: Array, stated: Disturbances, noise: Array, gain: Array) -> tuple[Elasticity, ...]:
    """Of all stated numbers, the one first that makes most of the first quantity's variance.

    Args:
        rows: (Q, 4 K) of the quantities.
        stated: what moves.
        noise: (D, D) of the shifts, px^2.
        gain: (4 K, D) of the estimator.
    """
    reading = rows @ gain
    error = reading @ stated.spots - rows @ stated.parameters
    shares = error * (error @ stated.correlation)
    total = shares.sum(axis=1) + np.einsum("qd,de,qe->q", reading, noise, reading)
    safe = np.where(total > 0.0, total, np.inf)
    out = []
    for number, own in stated_numbers(stated).items():
        factors = np.ones(len(stated.labels))
        factors[own] = 2.0
        wider = error * factors
        doubled = total - shares.sum(axis=1) + np.sum(wider * (wider @ stated.correlation), axis=1)
        out.append(
            Elasticity(
                number=number,
                size=float(stated.sigmas[own[0]]),
                unit=stated.units[own[0]],
                bodies=tuple(dict.fromkeys(stated.bodies[k] for k in own)),
                elasticity=shares[:, own].sum(axis=1) / safe,
                doubled=np.sqrt(np.maximum(doubled, 0.0)),
                told=posterior_sigma(rows, stated.scaled(factors), noise),
            )
        )
    return tuple(sorted(out, key=lambda one: -float(one.elasticity[0])))


def unseen(rows: Array, stated: Disturbances, noise: Array, gain: Array) -> dict[str, Array]:
    """Body -> (Q,) shares of the variances that are made by stated motions of it which have next to no derivative in
    the spots; of bodies for which a share is more than `SHARE`.

    Args:
        rows: (Q, 4 K) of the quantities.
        stated: what moves.
        noise: (D, D) of the shifts, px^2.
        gain: (4 K, D) of the estimator.
    """
    still = np.all(np.abs(stated.spots) < UNSEEN * np.sqrt(np.diag(noise))[:, None], axis=0)
    found = split(rows, stated, noise, gain)
    shares = found.after / np.where(found.sigma > 0.0, found.sigma**2, np.inf)[:, None]
    by_body: dict[str, Array] = {}
    for k in np.flatnonzero(still).tolist():
        by_body[stated.bodies[k]] = by_body.get(stated.bodies[k], np.zeros(len(rows))) + shares[:, k]
    return {body: own for body, own in by_body.items() if np.max(own) > SHARE}


def heavy_tails(
    rows: Array, stated: Disturbances, noise: Array, gain: Array, degrees: float = DEGREES, seed: int = 1
) -> HeavyTail:
    """Errors of an estimator whose statement has Student's distribution, each number in place of its standard deviation
    with one scale for all its motions.

    Args:
        rows: (Q, 4 K) of the quantities.
        stated: what moves; its standard deviations are the scales.
        noise: (D, D) of the shifts, px^2.
        gain: (4 K, D) of the estimator.
        degrees: of freedom, above 2.
        seed: of the draws of the scales.
    """
    if degrees <= 2.0:
        raise ValueError(f"heavy tails: Student's distribution has a variance above 2 degrees, found {degrees}")
    reading = rows @ gain
    error = reading @ stated.spots - rows @ stated.parameters
    groups = list(stated_numbers(stated).values())
    parts = np.stack([_of(error, own) for own in groups], axis=1)
    # (Q, G, G) what numbers g and h together make of the variance
    pairs = np.einsum("qgm,mn,qhn->qgh", parts, stated.correlation, parts)
    by_noise = np.einsum("qd,de,qe->q", reading, noise, reading)
    scales = np.random.default_rng(seed).gamma(0.5 * degrees, 2.0 / degrees, (_DRAWS, len(groups))) ** -0.5
    variance = np.stack([np.einsum("ng,gh,nh->n", scales, pair, scales) for pair in pairs], axis=1) + by_noise
    sigma = np.sqrt(np.maximum(variance, 0.0))
    normal = np.sqrt(np.maximum(pairs.sum(axis=(1, 2)) + by_noise, 0.0))
    mean = degrees / (degrees - 2.0)
    own = np.einsum("qgg->qg", pairs)
    root = float(np.exp(0.5 * np.log(0.5 * degrees)) * _root_mean(degrees))
    across = pairs.sum(axis=(1, 2)) - own.sum(axis=1)
    return HeavyTail(
        degrees=degrees,
        rms=np.sqrt(np.maximum(mean * own.sum(axis=1) + root**2 * across + by_noise, 0.0)),
        held=np.stack([_half_widths(sigma, level) for level in _LEVELS]),
        beyond=np.mean(2.0 * ndtr(-3.0 * normal / np.where(sigma > 0.0, sigma, np.inf)), axis=0),
    )


def _root_mean(degrees: float) -> float:
    """Gamma((nu - 1) / 2) / Gamma(nu / 2), which makes the mean of 1 / sqrt(w)."""
    return float(np.exp(gammaln(0.5 * (degrees - 1.0)) - gammaln(0.5 * degrees)))


def _of(error: Array, own: Sequence[int]) -> Array:
    """(Q, M) the part of some motions alone."""
    out = np.zeros_like(error)
    out[:, own] = error[:, own]
    return out


def _half_widths(sigma: Array, level: float) -> Array:
    """(Q,) half widths that hold a share of normal errors of these standard deviations (N, Q), by bisection."""
    low, high = np.zeros(sigma.shape[1]), 10.0 * np.max(sigma, axis=0)
    safe = np.where(sigma > 0.0, sigma, 1e-300)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        held = np.mean(1.0 - 2.0 * ndtr(-middle / safe), axis=0)
        low, high = np.where(held < level, middle, low), np.where(held < level, high, middle)
    return np.asarray(0.5 * (low + high))
