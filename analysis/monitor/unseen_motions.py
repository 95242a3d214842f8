"""What of the stated motions no spot shows, whatever reads the spots and however long.

Spots see A x, quantities are B x. Of motions with one law in time, covariance C, the part that moves no spot has the
covariance

    C - C A' (A C A')^+ A C,

and what it does to the quantities is known by nobody who has the spots alone. Motions of different laws may be told
apart by how they go on in time; with each law's share of the spots known apart, the sum over laws of what is left is
the floor that every estimate from the spots has, of every time (`floor`). An eigenvector of the floor is a mode of
quantities, and the likeliest motions that make it are a combination that leaves the spots where they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.monitor.disturbances import Disturbances
from analysis.short_repr import shows

Array = NDArray[np.float64]
_NOTHING = 1e-12
"""Of the largest eigenvalue of what a law's motions do to the spots, below which there is rounding alone."""


@shows("sigma", "bodies")
@dataclass(frozen=True, eq=False)
class UnseenMode:
    """Motions that move quantities and no spot.

    Attributes:
        quantities: (Q,) what one standard deviation of the mode does, in their units.
        sigma: root of the sum of its squares over the quantities' scales.
        motions: (M,) of that standard deviation, in stated standard deviations: the likeliest that make it.
        bodies: body -> share of the mode's variance, the largest first; negative where motions go together.
        spots: largest of what the motions do to a spot, px: rounding.
    """

    quantities: Array
    sigma: float
    motions: Array
    bodies: Mapping[str, float]
    spots: float


def _hidden(stated: Disturbances) -> Array:
    """(M, M) covariance of the motions that is left where each law's share of the spots is known."""
    out = np.zeros_like(stated.correlation)
    for law in dict.fromkeys(stated.laws):
        own = np.flatnonzero([one == law for one in stated.laws])
        here = np.ix_(own, own)
        prior, spots = stated.correlation[here], stated.spots[:, own]
        scale = np.abs(spots).max(axis=1)
        seen = spots[scale > 0.0] / scale[scale > 0.0, None]
        across = prior @ seen.T
        inverse = np.linalg.pinv(seen @ across, rcond=_NOTHING, hermitian=True) if len(seen) else np.zeros((0, 0))
        out[here] = prior - across @ inverse @ across.T
    return out


def floor(stated: Disturbances, rows: Array) -> Array:
    """(Q, Q) covariance of quantities that no estimate from the spots can have less of.

    Args:
        stated: what moves.
        rows: (Q, P) of the quantities on the parameters.
    """
    effect = rows @ stated.parameters
    return np.asarray(effect @ _hidden(stated) @ effect.T)


def unseen_modes(stated: Disturbances, rows: Array, scale: Array, least: float = 1e-3) -> tuple[UnseenMode, ...]:
    """Modes of the floor, the largest first.

    Args:
        stated: what moves.
        rows: (Q, P) of the quantities on the parameters.
        scale: (Q,) of each quantity what counts as much as one of another.
        least: modes of less than this share of the first one's sigma are left out.
    """
    effect = rows @ stated.parameters
    hidden = _hidden(stated)
    values, vectors = np.linalg.eigh((effect / scale[:, None]) @ hidden @ (effect / scale[:, None]).T)
    out = []
    for k in np.argsort(-values):
        sigma = float(np.sqrt(max(values[k], 0.0)))
        if sigma <= least * np.sqrt(max(values.max(), 0.0)):
            break
        row = vectors[:, k] / scale @ effect
        motions = hidden @ row / sigma
        shares = row * motions / sigma
        bodies = {
            body: float(shares[[one == body for one in stated.bodies]].sum()) for body in dict.fromkeys(stated.bodies)
        }
        # an eigenvector has no sign of its own: its largest quantity counts positive
        doing = effect @ motions
        sign = float(np.sign(doing[np.argmax(np.abs(doing / scale))]))
        largest = float(np.abs(stated.spots @ motions).max(initial=0.0))
        ordered = dict(sorted(bodies.items(), key=lambda item: -item[1]))
        out.append(UnseenMode(sign * doing, sigma, sign * motions, ordered, largest))
    return tuple(out)
