"""Centre of a spot in plain arrays: `fit_spot` calls the centroids of `analysis.spots.CENTROIDS` by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from analysis.arrays import Array
from analysis.spots.centroid import energy_centroid, gaussian_fit
from analysis.spots.likelihood import maximum_likelihood_fit, require_convergence
from analysis.spots.noise import NoiseModel
from analysis.spots.spot_template import SpotTemplate

METHODS = ("gaussian", "energy", "ml")
"""Names of the centroid methods that `fit_spot` offers, out of `analysis.spots.CENTROIDS`."""


@dataclass(frozen=True, eq=False)
class SpotFit:
    """Centres of spots with their covariance: numbers for one image, arrays of shape (B,) for B images.

    Attributes
    ----------
    row, column : float or (B,) ndarray
        Centre, in pixels; the centre of the first pixel is (0, 0).
    covariance : (2, 2) or (B, 2, 2) ndarray
        Covariance of row and column, in square pixels, from noise and from the detector's fixed pattern.
    flux : float or (B,) ndarray
        Grey values summed over the spot.
    background : float or (B,) ndarray
        Grey value below the spot, with the black level.
    reduced_chi_square : float or (B,) ndarray
        Chi-square of the residuals per degree of freedom; near 1 if the spot has the fitted shape. NaN for "energy".
    """

    row: Any
    column: Any
    covariance: Array
    flux: Any
    background: Any
    reduced_chi_square: Any

    @property
    def sigma(self) -> Array:
        """Standard deviations of row and column, in pixels, shape (2,) or (B, 2).

        Dimensions: B spots.
        """
        return np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))


def fit_spot(
    image: ArrayLike,
    noise: NoiseModel,
    *,
    frames: int = 1,
    method: str = "gaussian",
    radius: float | None = None,
    template: SpotTemplate | None = None,
) -> SpotFit:
    """Fit the centre of the brightest spot of an image, with its covariance.

    The weights follow from the noise model and the fitted spot, not from the noisy pixels, which would bias the flux. A
    spot of another shape than the fitted one has a covariance that accounts for it (sandwich estimator).

    Dimensions: H rows, W columns, B spots.

    Parameters
    ----------
    image : (H, W) or (B, H, W) array_like
        Grey values as recorded, one spot in each image of at least 6 x 6 px. In images of less than 24 px
        one hot pixel can be taken for a spot; `fit_window_series` measures spots that such windows undersample.
    noise : NoiseModel
        Noise of the detector.
    frames : int
        Number of frames of which each image is the mean.
    method : {"gaussian", "energy", "ml"}
        Weighted least squares of a Gaussian, first moment in a window that follows the centre, or maximum-likelihood
        fit of a calibrated spot shape.
    radius : float, optional
        Radius of the window of "gaussian" or "energy", in pixels. The default is an eighth, at least 2, ("gaussian") or
        a quarter ("energy") of the smaller side of the image.
    template : SpotTemplate, optional
        Calibrated shape, for "ml" only.

    Returns
    -------
    SpotFit
        Centre, covariance, flux, background and goodness of fit.

    Raises
    ------
    ValueError
        Images that are too small, not real or not finite; a spot that is saturated, missing or too close to the edge; a
        fit that does not converge; or another method.

    Notes
    -----
    The covariance of a Gaussian fit to another shape follows White, Econometrica 50, 1 (1982); the weights follow
    Humphrey, Liu and Buote, Astrophys. J. 693, 822 (2009). For a Gaussian spot of standard deviation s that is limited
    by shot noise, the smallest possible sigma of each coordinate is s / sqrt(number of electrons).

    Examples
    --------
    A Gaussian spot of 2 px and 20 000 electrons. Its smallest possible sigma is 2 / sqrt(20000) = 0.0141 px:

    >>> import numpy as np
    >>> import analysis
    >>> row, column = np.mgrid[:31, :31]
    >>> shape = np.exp(-0.5 * ((row - 15.3) ** 2 + (column - 13.75) ** 2) / 2.0**2) / (2 * np.pi * 2.0**2)
    >>> image = 10 + 20000 * shape
    >>> fit = analysis.fit_spot(image, analysis.NoiseModel(), radius=10)
    >>> round(fit.row, 4), round(fit.column, 4), round(fit.flux)
    (15.3, 13.75, 20000)
    >>> np.round(fit.sigma, 4)
    array([0.0153, 0.0153])

    The scatter of noisy images agrees with the covariance:

    >>> rng = np.random.default_rng(1)
    >>> fits = analysis.fit_spot(rng.poisson(image, (60, 31, 31)), analysis.NoiseModel(), radius=10)
    >>> bool(abs(np.std(fits.row) / np.mean(fits.sigma[:, 0]) - 1) < 0.2)
    True

    The energy centroid gives the same place:

    >>> centroid = analysis.fit_spot(image, analysis.NoiseModel(), method="energy", radius=10)
    >>> round(centroid.row, 3), round(centroid.column, 3)
    (15.3, 13.75)
    >>> analysis.fit_spot(image, analysis.NoiseModel(), method="ml")
    Traceback (most recent call last):
        ...
    ValueError: fit_spot: method must be gaussian, energy, ml (needs template=), found 'ml'
    """
    pixels = np.asarray(image)
    if pixels.ndim not in (2, 3):
        raise ValueError(f"fit_spot: image must be (H, W) or (B, H, W), found shape {pixels.shape}")
    stack = pixels if pixels.ndim == 3 else pixels[None]
    if method == "gaussian":
        positions = gaussian_fit(stack, frames, noise, radius)
    elif method == "energy":
        positions = energy_centroid(stack, frames, noise, radius)
    elif method == "ml" and template is not None:
        positions = maximum_likelihood_fit(stack, frames, noise, template)
    else:
        raise ValueError(f"fit_spot: method must be {', '.join(METHODS)} (needs template=), found {method!r}")
    require_convergence(positions)
    values = positions.row, positions.column, positions.flux, positions.background, positions.reduced_chi_square
    row, column, flux, background, chi = values if pixels.ndim == 3 else (float(value[0]) for value in values)
    covariance = positions.covariance if pixels.ndim == 3 else positions.covariance[0]
    return SpotFit(row, column, covariance, flux, background, chi)
