"""Spot positions with their covariance, and the table of centroid methods.

The table's methods import their code when they are called, so that input files that name a method can be checked
quickly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from optics.numerics.extension_table import ExtensionTable

if TYPE_CHECKING:
    from analysis.arrays import Array
    from analysis.spots.noise import NoiseModel
    from analysis.spots.spot_image import SpotPositions
    from analysis.spots.spot_template import SpotTemplate


@dataclass(frozen=True)
class Centroid:
    """Method that measures the positions of spots in mean frames.

    Dimensions: H rows, W columns.

    Attributes
    ----------
    title : str
        Name shown to readers.
    measure : callable
        Function of the mean frames of B spots ((B, H, W), DN), the number of frames averaged into each, the detector's
        noise model, the calibrated spot shapes and the number of threads, that returns the spots' positions with their
        `gain_maps` and `light_dn`.
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
"""Centroid methods by the name that a file writes under ``analysis: {centroid: ...}``. New methods are added here."""
