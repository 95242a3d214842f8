"""What is to be thought of fits of spots: did they come to rest, and has the spot the shape that was fitted?

Reduced chi-squares are judged twice: over the whole image, which the noise of the frames decides, and over the spot's
core, which its shape decides. Each limit is exceeded with a chance of `FALSE_ALARM` by a spot that has the calibrated
shape in frames of the stated noise; both stand for pixels whose noise is that of a normal distribution with the excess
that shot noise of few electrons has (Satterthwaite, Biometrics Bulletin 2, 110 (1946)).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.chi_square import limit_of
from analysis.spots.spot_positions import SpotError, SpotPositions
from analysis.states import OfStates

Array = NDArray[np.float64]
FALSE_ALARM = 1e-8
"""Chance that one of both limits of one fit is exceeded by a spot that is as calibrated: 2e-7 of a run with four spots
before and after, 1e-4 of a course of a thousand times."""
UNRESTED = "the fit does not come to rest from either of two starts; the spot has not the calibrated shape"
"""Why a spot is refused."""


@dataclass(frozen=True, eq=False)
class FitStates(OfStates):
    """Judgements of fits, arrays of one shape: (B,), or (S, C) as `reshaped` makes them.

    Attributes:
        whole, core: reduced chi-squares of all pixels and of the core's; NaN where no shape was fitted.
        whole_limit, core_limit: of these; infinite where no shape was fitted.
        whole_sigma, core_sigma: what the noise of the frames makes of them, one standard deviation.
        noise: the noise of the frames over the stated one, squared, by the median of all pixels.
    """

    whole: Array
    core: Array
    whole_limit: Array
    core_limit: Array
    whole_sigma: Array
    core_sigma: Array
    noise: Array

    @property
    def fits(self) -> NDArray[np.bool_]:
        """Whether the spot has the shape and the noise that were assumed; true where that cannot be told."""
        beyond = (self.whole > self.whole_limit) | (self.core > self.core_limit)
        return np.asarray(~beyond)

    @property
    def widening(self) -> Array:
        """Factor of sigma: 1 for a spot that fits; else the root of the larger reduced chi-square (Birge, Physical
        Review 40, 207 (1932)).
        """
        with np.errstate(invalid="ignore"):
            grown = np.sqrt(np.fmax(self.whole, self.core))
        return np.where(self.fits, 1.0, np.maximum(grown, 1.0))

    def reshaped(self, spots: int) -> FitStates:
        """(S, C) from S states of C spots each.

        Args:
            spots: C.
        """
        return FitStates(*(values.reshape(-1, spots) for values in vars(self).values()))


def fit_states(positions: SpotPositions) -> FitStates:
    """Judge B fits.

    Args:
        positions: as measured.
    """
    count = positions.row.size
    if positions.degrees is None or positions.core_chi_square is None:
        nothing, endless = np.full(count, np.nan), np.full(count, np.inf)
        return FitStates(nothing, nothing, endless, endless, nothing, nothing, nothing)
    limit = limit_of(0.5 * FALSE_ALARM, positions.degrees) / positions.degrees
    whole, core = positions.reduced_chi_square, positions.core_chi_square
    noise = np.full(count, np.nan) if positions.median_square is None else positions.median_square
    sigma = np.sqrt(2.0 / positions.degrees)
    return FitStates(whole, core, limit[:, 0], limit[:, 1], sigma[:, 0], sigma[:, 1], noise)


def widened(positions: SpotPositions, factor: Array) -> SpotPositions:
    """Positions whose sigmas hold what their fits say.

    Args:
        positions: B of them.
        factor: of the sigmas, (B,), as `FitStates.widening`.
    """
    if np.all(factor == 1.0):
        return positions
    square, gain = factor[:, None, None] ** 2, positions.gain_maps
    return replace(
        positions,
        temporal_covariance=positions.temporal_covariance * square,
        fixed_covariance=positions.fixed_covariance * square,
        gain_maps=None if gain is None else gain * factor[:, None, None, None],
    )


def require_rest(positions: SpotPositions) -> SpotPositions:
    """Return the positions; raise SpotError for spots whose fit has not come to rest.

    Args:
        positions: as measured.
    """
    if not np.all(positions.converged):
        raise SpotError({int(n): UNRESTED for n in np.flatnonzero(~positions.converged)})
    return positions
