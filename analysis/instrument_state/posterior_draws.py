"""Draws from the exact posterior of a state, where readings are not linear within it or several states explain them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq

from analysis.arrays import Array
from analysis.instrument_state.state_estimate import StatePrior

_STAGE = 0.5
"""Effective share of the draws that each raise of the likelihood's exponent leaves (Kong, Liu & Wong, J. Am. Stat.
Assoc. 89, 278, 1994)."""
_MOVES, _LAST = 6, 18
"""Numbers of moves of every draw after a raise of the exponent, and after the last one."""
_ACCEPTED = 0.3
"""Share of accepted moves for which the length of the moves is adapted."""
_DETERMINED = 0.5
"""Ratio of a direction's variance to the smallest one of as many draws from the prior below which it is determined."""


def posterior_draws(
    prior: StatePrior, chi_square: Callable[[Array], Array], count: int = 500, seed: int = 0
) -> tuple[Array, Array]:
    """Return random states from the posterior of a normal prior and readings with normal errors.

    Sequential Monte Carlo: draws from the prior are weighted and resampled by the likelihood to an exponent that rises
    from 0 to 1 (Del Moral, Doucet & Jasra, J. R. Stat. Soc. B 68, 411, 2006), and moved at each exponent by
    Crank-Nicolson steps about the normal distribution of the draws (Cotter et al., Stat. Sci. 28, 424, 2013). States
    far apart that explain the readings equally well get equal numbers of draws.

    Parameters
    ----------
    prior : StatePrior
        Prior of the M motions.
    chi_square : callable
        Function from states (S, M), SI units, to the chi-square of the readings in each, (S,); NaN without light.
    count : int
        Number N of draws.
    seed : int
        Seed of the random numbers.

    Returns
    -------
    unit : (N, U) ndarray
        Draws in the independent units of the prior; the states are ``prior.mean + unit @ prior.root.T``.
    chi_square : (N,) ndarray
        Chi-square of each.
    """
    rng = np.random.default_rng(seed)
    size = prior.root.shape[1]

    def cost_of(unit: Array) -> Array:
        value = chi_square(prior.mean + unit @ prior.root.T)
        return np.where(np.isfinite(value), value, np.finfo(float).max / 4.0)

    unit = rng.standard_normal((count, size))
    cost, exponent, length = cost_of(unit), 0.0, 0.5
    while exponent < 1.0:
        step = 1.0 - exponent
        if _excess(step, cost) < 0.0:
            step = float(brentq(_excess, 0.0, step, (cost,), xtol=1e-12))
        places = (np.arange(count) + rng.random()) / count
        chosen = np.minimum(np.searchsorted(np.cumsum(_weights(step, cost)), places), count - 1)
        unit, cost, exponent = unit[chosen], cost[chosen], min(exponent + step, 1.0)
        variance, axes = np.linalg.eigh(np.cov(unit.T).reshape(size, size))
        least = _DETERMINED * max(1.0 - np.sqrt(size / count), 0.1) ** 2
        # the other directions have the prior's distribution
        centre = (axes * (variance < least)) @ (axes.T @ unit.mean(axis=0))
        scale = np.sqrt(np.where(variance < least, np.maximum(variance, 1e-24), 1.0))
        for _ in range(_MOVES if exponent < 1.0 else _LAST):
            here = (unit - centre) @ axes / scale
            there = np.sqrt(1.0 - length**2) * here + length * rng.standard_normal((count, size))
            moved = centre + (there * scale) @ axes.T
            moved_cost = cost_of(moved)
            log_ratio = exponent * (cost - moved_cost) + np.sum(unit**2 - moved**2 + there**2 - here**2, axis=1)
            accepted = np.log(rng.random(count)) < 0.5 * log_ratio
            unit[accepted], cost[accepted] = moved[accepted], moved_cost[accepted]
            length = float(np.clip(length * np.exp(0.7 * (accepted.mean() - _ACCEPTED)), 0.02, 1.0))
    return unit, cost


def _weights(step: float, chi_square: Array) -> Array:
    """Return the weights of draws when the exponent of their likelihood rises by a step."""
    weight = np.exp(-0.5 * step * (chi_square - chi_square.min()))
    return np.asarray(weight / weight.sum())


def _excess(step: float, chi_square: Array) -> float:
    """Return the effective share of the draws after such a step, less the share that is to be left."""
    return float(1.0 / np.sum(_weights(step, chi_square) ** 2) / len(chi_square) - _STAGE)
