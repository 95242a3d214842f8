"""Light of a black body."""

from __future__ import annotations

import numpy as np
from scipy import constants


def black_body_photons(wavelength: np.ndarray, temperature: float) -> np.ndarray:
    """Spectral radiance of a black body as photons, by Planck's law.

    Args:
        wavelength: metres, of any shape.
        temperature: kelvin.

    Returns:
        Photons/(s m^2 sr m), of the wavelength's shape.
    """
    x = constants.h * constants.c / (wavelength * constants.k * temperature)
    return np.asarray(2.0 * constants.c / wavelength**4 / np.expm1(x))
