"""Centres of spots with their covariance, and the methods that find them.

The methods are listed here and import what computes when they are called: files that name one are checked before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from optics.numerics.extension_table import ExtensionTable

if TYPE_CHECKING:
    from analysis.arrays import Array
    from analysis.spots.noise import NoiseModel
    from analysis.spots.spot_positions import SpotPositions
    from analysis.spots.spot_template import SpotTemplate


@dataclass(frozen=True)
class Centroid:
    """A method that finds the centres of spots.

    Attributes
    ----------
    title : str
        For readers.
    measure : Callable[[Array, int, NoiseModel, SpotTemplate, int], SpotPositions]
        Mean frames of B spots, (B, H, W), grey values; number of frames of each mean; the detector's noise; the
        calibrated shapes; number of threads -> their centres.
    """

    title: str
    measure: Callable[[Array, int, NoiseModel, SpotTemplate, int], SpotPositions]


def _likelihood(mean: Array, frames: int, noise: NoiseModel, template: SpotTemplate, threads: int) -> SpotPositions:
    from analysis.spots.likelihood import maximum_likelihood_fit

    return maximum_likelihood_fit(mean, frames, noise, template, threads=threads)


def _gaussian(mean: Array, frames: int, noise: NoiseModel, template: SpotTemplate, threads: int) -> SpotPositions:
    from analysis.spots.centroid import gaussian_fit

    return gaussian_fit(mean, frames, noise)


def _energy(mean: Array, frames: int, noise: NoiseModel, template: SpotTemplate, threads: int) -> SpotPositions:
    from analysis.spots.centroid import energy_centroid

    return energy_centroid(mean, frames, noise)


_CENTROIDS = {
    "ml": Centroid("maximum-likelihood fit of the calibrated spot shape", _likelihood),
    "gaussian": Centroid("fit of a Gaussian", _gaussian),
    "energy": Centroid("windowed energy centroid, as in the paper", _energy),
}
CENTROIDS = ExtensionTable("centroids", _CENTROIDS, Centroid)
"""Name that a file may write under ``analysis: {centroid: ...}`` -> method. A new one is added here."""
