"""Image of a star in the pixels of a detector and its derivatives, for a pupil of any outline.

The field of a star is a sum of plane waves, as in ``optics.waves.diffraction``. Here the waves lie on a square grid of
direction cosines, so that the sum is a product of three small matrices. The grid is no raster of the pupil: quadrature
nodes over the exact light are spread over the grid points around them with the weights of polynomial interpolation, so
that a sum over the grid is the integral of a function that the grid samples well, up to the error of interpolating it.

Irradiance is sampled at its Nyquist rate. The mean over a pixel, a Gaussian blur and the position of the star act on
its Fourier series, along rows and columns separately, with exact derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array, diags_array

from optics.numerics.array_math import UnphysicalError
from optics.numerics.quadrature import PupilNodes
from optics.waves.pupil_terms import orders, products, slopes

_POINTS = 8
"""Number of grid points along each axis over which a node of the pupil is spread."""
_PHASE = 2.0
"""Largest phase of the waves from one grid point to the next, radians, which keeps images within 1e-4 of their peak."""
MOST_CELLS = 1200
"""Largest number of grid points along each axis of the pupil."""
_NYQUIST = 0.97
"""Distance of two samples of the irradiance, relative to the largest that samples it completely."""
_MARGIN = 3.0
"""Distance by which the samples extend beyond the pixels and the blur, pixels."""


class CoarsePupilError(UnphysicalError):
    """Error: a star image is so large that the grid over the pupil would not sample its waves."""

    allowed = "smaller images, or less defocus"


@dataclass(frozen=True, eq=False)
class StarPupil:
    """Light of a star behind a pupil: Q plane waves whose weights are integrals over the pupil.

    Attributes
    ----------
    u, v : (Q,) ndarray
        Direction cosines along the columns' and the rows' axis of the detector, relative to the chief ray.
    weight : (Q,) ndarray
        Amplitude times the element of area in direction cosines; negative where a shadow is subtracted. Unit power.
    wavelength : float
        Wavelength, metres.
    """

    u: np.ndarray
    v: np.ndarray
    weight: np.ndarray
    wavelength: float

    @cached_property
    def middle(self) -> np.ndarray:
        """Middle of the pupil in direction cosines, (2,)."""
        return np.array([0.5 * (np.min(cosine) + np.max(cosine)) for cosine in (self.u, self.v)])

    @cached_property
    def half(self) -> float:
        """Half width of the pupil in direction cosines: its numerical aperture."""
        return 0.5 * float(max(np.ptp(self.u), np.ptp(self.v)))

    def normalised(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return direction cosines as coordinates from -1 to 1 over the pupil, each of its shape."""
        return (u - self.middle[0]) / self.half, (v - self.middle[1]) / self.half

    def terms(self, u: np.ndarray, v: np.ndarray, weight: np.ndarray, degree: int) -> np.ndarray:
        """Return the matrix from values at N directions to T coefficients of ``products`` over the pupil, (T, N).

        Parameters
        ----------
        u, v : (N,) ndarray
            Direction cosines.
        weight : (N,) ndarray
            Weights of the least-squares fit.
        degree : int
            Degree of the polynomials.
        """
        root = np.sqrt(weight)
        return np.asarray(np.linalg.pinv(products(*self.normalised(u, v), degree) * root[:, None]) * root)

    def terms_of_slopes(self, u: np.ndarray, v: np.ndarray, weight: np.ndarray, degree: int) -> np.ndarray:
        """Return the matrix from derivatives with respect to u and v at N directions to T coefficients, (T, 2 N).

        Parameters are those of ``terms``; the two derivatives of a direction follow each other.
        """
        across, down = slopes(PupilNodes(*self.normalised(u, v), weight), degree)
        table = np.stack([across, down], axis=1).reshape(-1, across.shape[1]) / self.half
        root = np.repeat(np.sqrt(weight), 2)
        return np.asarray(np.linalg.pinv(table * root[:, None]) * root)


def _spread(x: np.ndarray, axis: np.ndarray) -> csr_array:
    """Return the sparse matrix (Q, n) of the interpolation from n evenly spaced points of an axis to Q positions."""
    position = (x - axis[0]) / (axis[1] - axis[0])
    first = np.floor(position).astype(int) - _POINTS // 2 + 1
    offset, numbers = (position - first)[:, None], np.arange(_POINTS)
    weights = np.ones((len(x), _POINTS))
    for k in numbers:
        for j in numbers[numbers != k]:
            weights[:, k] *= (offset[:, 0] - j) / (k - j)
    rows = np.repeat(np.arange(len(x)), _POINTS)
    return csr_array((weights.ravel(), (rows, (first[:, None] + numbers).ravel())), shape=(len(x), len(axis)))


@dataclass(frozen=True, eq=False)
class StarImage:
    """Image of a star in a window of R x C pixels, as a function of T coefficients of its wavefront.

    Coefficients are those of ``pupil_terms.products`` for the eikonal, metres, over the normalised direction cosines.

    Attributes
    ----------
    pupil : StarPupil
        Light of the star.
    degree : int
        Degree of the polynomials of the eikonal.
    shape : (int, int)
        Rows and columns of the window.
    pitch : float
        Pitch of the pixels, metres.
    middle : (float, float)
        Row and column near which the star lies, pixels from the middle of the window.
    blur : float
        Largest standard deviation of the blur, metres.
    """

    pupil: StarPupil
    degree: int
    shape: tuple[int, int]
    pitch: float
    middle: tuple[float, float] = (0.0, 0.0)
    blur: float = 0.0

    @cached_property
    def _extent(self) -> float:
        """Half width of the samples about the star, metres."""
        edge = max(0.5 * size + abs(offset) for size, offset in zip(self.shape, self.middle, strict=True))
        return float(self.pitch * (edge + _MARGIN) + 3.0 * self.blur)

    @cached_property
    def samples(self) -> np.ndarray:
        """Coordinates of the M samples of the irradiance along each axis, from the chief ray, (M,), metres."""
        step = _NYQUIST * self.pupil.wavelength / (4.0 * self.pupil.half)
        count = 2 * int(np.ceil(self._extent / step)) + 1
        return step * (np.arange(count) - 0.5 * (count - 1))

    @cached_property
    def _axis(self) -> np.ndarray:
        """Grid over the pupil, (n,), normalised; it extends beyond the light by half the points of a node.

        The phase changes most where a ray from one edge of the window's light meets a pixel at the other edge.
        """
        wave_number = 2.0 * np.pi / self.pupil.wavelength
        step = _PHASE / (2.0 * wave_number * self.pupil.half * self._extent)
        count = 2 * int(np.ceil(1.0 / step)) + _POINTS + 1
        if count > MOST_CELLS:
            limit = self.pitch * (MOST_CELLS / count)
            text = (
                f"the pupil of a star image of {max(self.shape)} pixels needs {count} points along an axis, more than "
                f"{MOST_CELLS}: use cut-outs of at most {int(self._extent * limit / self.pitch**2)} pixels"
            )
            raise CoarsePupilError(text)
        return step * (np.arange(count) - 0.5 * (count - 1))

    @cached_property
    def _weight(self) -> np.ndarray:
        """Weights of the waves on the grid, (n, n), rows along v."""
        x, y = self.pupil.normalised(self.pupil.u, self.pupil.v)
        across, down = _spread(x, self._axis), _spread(y, self._axis)
        return (down.T @ diags_array(self.pupil.weight) @ across).toarray() / self.pupil.wavelength

    @cached_property
    def _waves(self) -> np.ndarray:
        """Phasors of the plane waves at the samples, (M, n)."""
        scale = 2.0 * np.pi / self.pupil.wavelength * self.pupil.half
        return np.asarray(np.exp(1j * scale * np.outer(self.samples, self._axis)))

    @cached_property
    def _polynomials(self) -> np.ndarray:
        """Chebyshev polynomials at the grid, (n, degree + 1); beyond the light they keep their value at the edge."""
        return np.polynomial.chebyshev.chebvander(self._axis, self.degree)

    def _over_pupil(self, terms: np.ndarray) -> np.ndarray:
        """Return polynomials of T coefficients on the grid, (..., n, n) for coefficients (..., T)."""
        i, j = orders(self.degree)
        table = np.zeros((*terms.shape[:-1], self.degree + 1, self.degree + 1))
        table[..., j, i] = terms
        return np.asarray(self._polynomials @ table @ self._polynomials.T)

    def _fields(self, terms: np.ndarray) -> np.ndarray:
        """Return the waves' amplitudes on the grid of the pupil, (n, n), complex."""
        phase = (2.0 * np.pi / self.pupil.wavelength) * self._over_pupil(terms)
        return np.asarray(self._weight * np.exp(1j * phase))

    def irradiance(self, terms: np.ndarray) -> np.ndarray:
        """Return the irradiance of unit power at the samples, (M, M), 1/m^2, for T coefficients of the eikonal."""
        return np.asarray(np.abs(self._waves @ self._fields(terms) @ self._waves.T) ** 2)

    def irradiance_slopes(self, terms: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the irradiance, (M, M), and its derivatives along K directions of the coefficients, (K, M, M).

        Parameters
        ----------
        terms : (T,) ndarray
            Coefficients of the eikonal, metres.
        directions : (K, T) ndarray
            Changes of the coefficients, metres per unit.
        """
        fields = self._fields(terms)
        wave = self._waves @ fields @ self._waves.T
        factor = 2.0 * np.pi / self.pupil.wavelength
        slopes = np.empty((len(directions), *wave.shape))
        for k, direction in enumerate(directions):
            moved = self._waves @ (fields * self._over_pupil(direction)) @ self._waves.T
            # 2 Re(conj(U) i k dU)
            slopes[k] = -2.0 * factor * (wave.real * moved.imag - wave.imag * moved.real)
        return np.abs(wave) ** 2, slopes

    @cached_property
    def _series(self) -> tuple[np.ndarray, np.ndarray]:
        """Frequencies of the Fourier series of the samples, (F,), cycles/m, and the transform's matrix, (M, F)."""
        size = len(self.samples)
        cycles = np.fft.rfftfreq(size, self.samples[1] - self.samples[0])
        share = np.where(cycles == 0.0, 1.0, 2.0) / size
        return cycles, np.asarray(share * np.exp(-2j * np.pi * np.outer(self.samples, cycles)))

    def _responses(self, count: int, position: float, blur: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the matrix from M samples to the means over pixels of one axis, (count, M).

        With it come its derivatives with respect to position, per pixel, and to the standard deviation of the blur.
        """
        cycles, right = self._series
        response = np.sinc(cycles * self.pitch) * np.exp(-2.0 * (np.pi * cycles * blur) ** 2)
        pixels = self.pitch * (np.arange(count) - 0.5 * (count - 1) - position)
        left = np.exp(2j * np.pi * np.outer(pixels, cycles)) * response
        factors = (1.0, -2j * np.pi * cycles * self.pitch, -4.0 * np.pi**2 * cycles**2 * blur)
        table = np.concatenate([left * factor for factor in factors])
        out = table.real @ right.real.T - table.imag @ right.imag.T
        return out[:count], out[count : 2 * count], out[2 * count :]

    def pixels(self, irradiance: np.ndarray, position: np.ndarray, blur: float = 0.0) -> np.ndarray:
        """Return the shares of a star's light in all pixels, (..., R, C), for irradiance at the samples, (..., M, M).

        Parameters
        ----------
        irradiance : (..., M, M) ndarray
            Irradiance, 1/m^2, or its derivatives.
        position : (2,) ndarray
            Row and column of the star's chief ray, pixels from the middle of the window.
        blur : float
            Standard deviation of a Gaussian blur, metres.
        """
        down, across = (self._responses(n, p, blur)[0] for n, p in zip(self.shape, position, strict=True))
        return np.asarray(self.pitch**2 * (down @ irradiance @ across.T))

    def pixel_slopes(self, irradiance: np.ndarray, position: np.ndarray, blur: float) -> np.ndarray:
        """Return the shares of light in all pixels and their derivatives, (4, R, C).

        The derivatives are those with respect to row and column of the star, per pixel, and blur, per metre.

        Parameters
        ----------
        irradiance : (M, M) ndarray
            Irradiance at the samples, 1/m^2.
        position : (2,) ndarray
            Row and column of the star, pixels from the middle of the window.
        blur : float
            Standard deviation of the blur, metres.
        """
        down, across = (self._responses(n, p, blur) for n, p in zip(self.shape, position, strict=True))
        parts = (
            down[0] @ irradiance @ across[0].T,
            down[1] @ irradiance @ across[0].T,
            down[0] @ irradiance @ across[1].T,
            down[2] @ irradiance @ across[0].T + down[0] @ irradiance @ across[2].T,
        )
        return np.asarray(self.pitch**2 * np.stack(parts))
