"""Light of a black body."""

from __future__ import annotations

import numpy as np


def black_body_photons(wavelength: np.ndarray, temperature: float) -> np.ndarray:
    """Spectral radiance of a black body as photons, by Planck's law.

    Args:
        wavelength: metres, of any shape.
        temperature: kelvin.

    Returns:
        Photons/(s m^2 sr m), of the wavelength's shape.
    """
    # messages about files wait for this module, and scipy's table of constants is long
    from scipy import constants

    x = constants.h * constants.c / (wavelength * constants.k * temperature)
    return np.asarray(2.0 * constants.c / wavelength**4 / np.expm1(x))
