"""Check that readings are linear within the posterior of a state, on which the covariance of its estimate relies."""

from __future__ import annotations

import numpy as np

from analysis.instrument_state.state_estimate import Predict, StateEstimate

_DETERMINED = 0.1
"""Smallest derivative of a whitened reading along a direction that counts as determined, per prior sigma.

The measurements reduce the prior's sigma by less than half a percent along the others.
"""


def effective_share(state: StateEstimate, predict: Predict, count: int = 200, seed: int = 0) -> float:
    """Return how well draws from the posterior of the linear model represent the exact one, from 0 to 1.

    Each draw is weighted by its exact posterior density over that of the linear model; the share is the effective
    number of draws (Kong, Liu & Wong, J. Am. Stat. Assoc. 89, 278, 1994) over their number. It is 1 for linear
    readings. Directions that the measurements leave to the prior are drawn from it and have no weight.

    Parameters
    ----------
    state : StateEstimate
        Estimate, with the covariance of the linear model.
    predict : callable
        Function from states (S, M) to error-free measurements (S, D), SI units; NaN without light.
    count : int
        Number of draws.
    seed : int
        Seed of the draws.
    """
    rng = np.random.default_rng(seed)
    _, size, rows = np.linalg.svd(state.slope, full_matrices=False)
    rows, size = rows[size > _DETERMINED], size[size > _DETERMINED]
    along, others = rng.standard_normal((count, len(size))), rng.standard_normal((count, len(state.unit)))
    drawn = rows @ state.unit + along / np.sqrt(1.0 + size**2)
    predicted = predict(state.prior.mean + (others - others @ rows.T @ rows + drawn @ rows) @ state.prior.root.T)
    logarithm = 0.5 * np.sum(along**2, axis=1) - 0.5 * np.sum(drawn**2, axis=1)
    first = 0
    for group in state.groups:
        white = group.whitener([block for name, block, _ in state.excluded if name == group.name])
        rest = group.values - predicted[:, first : (first := first + len(group.values))]
        logarithm -= 0.5 * np.sum((white @ rest.T) ** 2, axis=0) / state.variance_factor
    logarithm[~np.isfinite(logarithm)] = -np.inf
    if np.all(np.isinf(logarithm)):
        return 0.0
    weights = np.exp(logarithm - np.max(logarithm))
    return float(np.sum(weights) ** 2 / np.sum(weights**2) / count)
