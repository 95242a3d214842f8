"""Which combinations of motions measurements know, and which they do not: the benign subspace of an instrument.

Few combinations of many small motions show in a wavefront (Schechter & Levinson, PASP 123, 812, 2011). In independent
units of the prior, measurements with whitened derivatives J know the right singular vectors of J: the standard
deviation along a vector falls from 1 to 1/sqrt(1 + s^2), s its singular value.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.instrument_state.state_estimate import StateEstimate

Array = NDArray[np.float64]
KNOWN = 0.5
"""Standard deviation of a combination after the measurements, of one before, below which it is called known."""
_NAMED = 0.25
"""Weight of a motion in a combination, relative to the largest, from which on its name stands in it."""
_MOST_NAMED = 4


@dataclass(frozen=True, eq=False)
class Combination:
    """One combination of motions.

    Attributes:
        name: its largest motions with their weights: ``0.71 M2 shift x + 0.52 M3 rotate y``, each motion in units of
            its prior standard deviation.
        weights: (M,) of the motions in their prior standard deviations.
        value: estimate, in standard deviations of the prior.
        sigma: standard deviation after the measurements; it was 1 before.
    """

    name: str
    weights: Array
    value: float
    sigma: float

    @property
    def known(self) -> bool:
        """Whether the measurements tell it."""
        return self.sigma < KNOWN

    def of(self, amounts: Array, prior_sigma: Array, mean: Array) -> Array:
        """Value of the combination in states (..., M), SI.

        Args:
            amounts: the states.
            prior_sigma: (M,) SI.
            mean: (M,) of the prior, SI.
        """
        safe = np.where(prior_sigma > 0.0, prior_sigma, np.inf)
        return np.asarray((amounts - mean) / safe @ self.weights)


def combinations(found: StateEstimate, most: int | None = None) -> tuple[Combination, ...]:
    """The combinations by what the measurements know of them, the best known first.

    Args:
        found: an estimate.
        most: how many; all by default.
    """
    _, values, rows = np.linalg.svd(found.slope, full_matrices=True)
    values = np.pad(values, (0, len(rows) - len(values)))
    back = np.linalg.pinv(found.prior.root, rcond=1e-12) * found.prior.sigma
    out = []
    for value, row in list(zip(values, rows, strict=True))[:most]:
        weights = row @ back
        if weights[np.argmax(np.abs(weights))] < 0.0:
            weights, row = -weights, -row
        sigma = float(1.0 / np.sqrt(1.0 + value**2))
        out.append(Combination(_name(found.prior.labels, weights), weights, float(row @ found.unit), sigma))
    return tuple(out)


def _name(labels: tuple[str, ...], weights: Array) -> str:
    order = np.argsort(-np.abs(weights))[:_MOST_NAMED]
    largest = abs(weights[order[0]])
    text = ""
    for k in order:
        if abs(weights[k]) < _NAMED * largest:
            break
        sign = (" \N{MINUS SIGN} " if weights[k] < 0 else " + ") if text else ""
        text += f"{sign}{abs(weights[k]):.2f} {labels[k]}"
    return text
