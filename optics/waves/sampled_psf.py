"""Numbers of a sampled point spread function, and the diffraction limit of round pupils with a central obscuration."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from optics.numerics.arguments import finite


def _checked(psf: ArrayLike, step: float) -> np.ndarray:
    """Return the samples of an image as an array; raise ValueError unless their sum and the step are positive."""
    samples = np.asarray(psf, float)
    if samples.ndim != 2 or not np.all(np.isfinite(samples)) or not np.sum(samples) > 0.0:
        raise ValueError(f"psf must be finite, of shape (rows, columns) and of positive sum, got {samples.shape}")
    if not 0.0 < step < np.inf:
        raise ValueError(f"step must be positive, in metres, got {step}")
    return samples


def encircled_energy(
    psf: ArrayLike, step: float, radius: ArrayLike, centre: tuple[float, float] | None = None
) -> np.ndarray:
    """Compute the energy of an image within circles.

    Parameters
    ----------
    psf : (R, C) array_like
        Samples of the irradiance, 1/m^2: R rows along y, C columns along x. If it integrates to 1, as that of `psf`
        does over the whole plane, energies are shares of all light; else divide by the total.
    step : float
        Distance between samples, metres.
    radius : (M,) array_like
        Radii of M circles, metres.
    centre : (float, float), optional
        Centre x, y from the middle of the grid, metres; by default the centroid of the samples.

    Returns
    -------
    (M,) ndarray
        Energy within each circle.

    Raises
    ------
    ValueError
        The samples are not two-dimensional or finite, or a circle reaches beyond them.

    Notes
    -----
    The Fourier series of the samples is integrated over the disk exactly: a disk of radius r has the transform r J1(2
    pi f r) / f. No pixel is cut by the circle.

    Examples
    --------
    Of the Airy pattern 83.8 % falls within the first dark ring and 91.0 % within the second:

    >>> camera = Camera([OpticalSurface(-4.0, -2.0, -1.0, "mirror", diameter=0.2)], 500e-9)
    >>> unit = 500e-9 * camera.f_number
    >>> image = psf(camera, 0.25 * unit, 65)
    >>> encircled_energy(image, 0.25 * unit, [1.2197 * unit, 2.2331 * unit]).round(3)
    array([0.838, 0.91 ])
    """
    # an import of the library waits for no scipy
    from scipy.special import j1

    def disks(radii: np.ndarray, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        frequency = np.hypot(fx, fy)
        frequency[0, 0] = 1.0
        out = radii * j1(2.0 * np.pi * frequency * radii) / frequency
        out[:, 0, 0] = np.pi * radii[:, 0, 0] ** 2
        return np.asarray(out)

    return _energy(psf, step, radius, centre, "radii", disks)


def ensquared_energy(
    psf: ArrayLike, step: float, half_width: ArrayLike, centre: tuple[float, float] | None = None
) -> np.ndarray:
    """Compute the energy of an image within squares whose sides are along x and y.

    Parameters
    ----------
    psf : (R, C) array_like
        Samples of the irradiance, 1/m^2, as for `encircled_energy`.
    step : float
        Distance between samples, metres.
    half_width : (M,) array_like
        Half the sides of M squares, metres: half the pitch for the energy in a pixel.
    centre : (float, float), optional
        Centre x, y from the middle of the grid, metres; by default the centroid of the samples.

    Returns
    -------
    (M,) ndarray
        Energy within each square.

    Raises
    ------
    ValueError
        The samples are not two-dimensional or finite, or a square reaches beyond them.

    Notes
    -----
    The Fourier series of the samples is integrated over the square exactly.

    Examples
    --------
    >>> camera = Camera([OpticalSurface(-4.0, -2.0, -1.0, "mirror", diameter=0.2)], 500e-9)
    >>> unit = 500e-9 * camera.f_number
    >>> image = psf(camera, 0.25 * unit, 65)
    >>> ensquared_energy(image, 0.25 * unit, [0.5 * unit, 2.0 * unit]).round(3)
    array([0.528, 0.911])
    """

    def squares(half: np.ndarray, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        return np.asarray(4.0 * half**2 * np.sinc(2.0 * half * fx) * np.sinc(2.0 * half * fy))

    return _energy(psf, step, half_width, centre, "half widths", squares)


def _energy(
    psf: ArrayLike,
    step: float,
    size: ArrayLike,
    centre: tuple[float, float] | None,
    name: str,
    transform: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
) -> np.ndarray:
    """Integrate an image over areas of M sizes, whose Fourier transform at frequencies fx, fy a function returns."""
    samples, sizes = _checked(psf, step), np.atleast_1d(np.asarray(size, float))
    rows, columns = samples.shape
    x, y = (step * (np.arange(n) - 0.5 * (n - 1)) for n in (columns, rows))
    if centre is None:
        total = np.sum(samples)
        centre = (float(np.sum(samples * x) / total), float(np.sum(samples * y[:, None]) / total))
    room = min(0.5 * step * columns - abs(centre[0]), 0.5 * step * rows - abs(centre[1]))
    if sizes.ndim != 1 or not np.all((sizes >= 0.0) & (sizes <= room)):
        raise ValueError(f"{name} must be of shape (M,), not negative and at most {room:.4g} m, where the samples end")
    fx, fy = np.fft.fftfreq(columns, step), np.fft.fftfreq(rows, step)[:, None]
    spectrum = np.fft.fft2(samples) / samples.size
    spectrum *= np.exp(2j * np.pi * (fx * (centre[0] - x[0]) + fy * (centre[1] - y[0])))
    return np.asarray(np.sum(spectrum.real * transform(sizes[:, None, None], fx, fy), axis=(1, 2)))


def mtf_from_psf(psf: ArrayLike, step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the MTF along x and along y from samples of a point spread function.

    Parameters
    ----------
    psf : (R, C) array_like
        Irradiance: R rows along y, C columns along x.
    step : float
        Distance between samples, metres.

    Returns
    -------
    frequency : (M,) ndarray
        M frequencies from 0 to half the sampling frequency, cycles per metre.
    along_x, along_y : (M,) ndarray
        Modulation of patterns that vary along x and along y, 1 at zero frequency.

    Raises
    ------
    ValueError
        The samples are not two-dimensional or finite, or sum to 0.

    Notes
    -----
    Light beyond the samples is missing: where it is a share e of all, the MTF comes out too high by about that share.

    Examples
    --------
    A Gaussian image of standard deviation s has the MTF exp(-2 (pi f s)^2):

    >>> x = np.arange(-20, 21) * 1e-6
    >>> image = np.exp(-0.5 * (x**2 + x[:, None] ** 2) / 4e-6**2)
    >>> frequency, along_x, along_y = mtf_from_psf(image, 1e-6)
    >>> bool(np.max(np.abs(along_x - np.exp(-2 * (np.pi * frequency * 4e-6) ** 2))) < 1e-5)
    True
    """
    samples = _checked(psf, step)
    size = max(samples.shape)
    lines = (np.abs(np.fft.rfft(samples.sum(axis=axis), size)) for axis in (0, 1))
    along_x, along_y = (line / line[0] for line in lines)
    return np.fft.rfftfreq(size, step), along_x, along_y


def annular_mtf(frequency: ArrayLike, wavelength: float, f_number: float, obscuration: float = 0.0) -> np.ndarray:
    """Compute the MTF of a perfect round pupil with a central obscuration.

    Parameters
    ----------
    frequency : array_like
        Spatial frequencies, cycles per metre, any shape; their sign has no meaning.
    wavelength : float
        Wavelength of the light, metres.
    f_number : float
        Focal length over the diameter of the pupil.
    obscuration : float
        Diameter of the obscuration over that of the pupil, 0 to less than 1.

    Returns
    -------
    ndarray
        Modulation, of the shape of ``frequency``.

    Raises
    ------
    ValueError
        A number is out of its range.

    Notes
    -----
    The overlap of the ring with itself, in areas common to two circles (O'Neill, J. Opt. Soc. Am. 46, 285, 1956).

    Examples
    --------
    A central obscuration costs contrast at low frequencies:

    >>> cutoff = 1 / (500e-9 * 8)
    >>> annular_mtf([0, 0.25 * cutoff, 0.5 * cutoff, cutoff], 500e-9, 8).round(3)
    array([1.   , 0.685, 0.391, 0.   ])
    >>> annular_mtf([0.25 * cutoff, 0.5 * cutoff], 500e-9, 8, obscuration=0.5).round(3)
    array([0.377, 0.224])
    """
    if not (wavelength > 0.0 and f_number > 0.0 and 0.0 <= obscuration < 1.0):
        raise ValueError(
            f"wavelength and f_number must be positive and 0 <= obscuration < 1, got {wavelength}, {f_number} and "
            f"{obscuration}"
        )
    shift = 2.0 * wavelength * f_number * np.abs(finite("frequency", frequency, "in cycles per metre"))

    def common(first: float, second: float) -> np.ndarray:
        """Area common to circles of two radii about centres ``shift`` apart."""
        apart = np.clip(shift, abs(first - second), first + second)
        apart = np.where(apart == 0.0, 1e-300, apart)
        parts = []
        for radius, other in ((first, second), (second, first)):
            near = (apart**2 + radius**2 - other**2) / (2.0 * apart)
            angle = np.arccos(np.clip(near / radius, -1.0, 1.0))
            parts.append(radius**2 * (angle - 0.5 * np.sin(2.0 * angle)))
        return np.asarray(parts[0] + parts[1])

    overlap = common(1.0, 1.0)
    if obscuration:
        overlap = overlap - 2.0 * common(1.0, obscuration) + common(obscuration, obscuration)
    return np.asarray(overlap / (np.pi * (1.0 - obscuration**2)))
