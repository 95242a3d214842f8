"""Calibrated shape of a spot, evaluated at any sub-pixel position with its analytic gradient.

The shape is given as an image (noise-free, or of high signal-to-noise ratio) on a grid of the detector's pixel pitch,
or of that pitch divided by an integer; each sample is the flux in one *whole pixel* centred there, so pixel integration
is already included and interpolation only has to shift. A diffraction-limited spot is band-limited, and the
interpolation is a quintic B-spline (Unser, Aldroubi, Eden, IEEE Trans. Signal Process. 41, 821 (1993)): fifth order in
(frequency * sample).

For speed the spline coefficients are factored once by a singular value decomposition, C = sum_k u_k v_k^T. The spline
is separable, so a shifted spot is sum_k (shifted u_k) (shifted v_k)^T, and a round spot needs only some ten to thirty
terms: the two-dimensional interpolation becomes a small matrix product.

Pixel coordinates: (row, column), the centre of the first pixel is (0, 0).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft, ndimage
from scipy.interpolate import BSpline

from analysis.arrays import Array, MeasurementError, UndeterminedError
from optics.numerics.arguments import checked

_DEGREE = 5
_TAPS = _DEGREE + 1
SHARPEST = 4.0
"""Largest factor by which a spatial frequency is amplified where a shape is made sharper."""


class TemplateRangeError(MeasurementError, ValueError):
    """Error raised for a spot position at which the detector extends beyond the template's grid.

    Attributes
    ----------
    indices : list of int
        Indices of these spots.
    """

    def __init__(self, message: str, indices: list[int]) -> None:
        super().__init__(message)
        self.indices = indices


def _tap_polynomials() -> Array:
    """Return the six B-spline weights around a position as polynomials of the fraction of a sample, (power, weight)."""
    nodes = np.linspace(0.0, 1.0, _TAPS)
    basis = BSpline.basis_element(np.arange(_TAPS + 1) - _TAPS / 2.0)
    taps = np.arange(_TAPS) - (_TAPS // 2 - 1)
    values = np.nan_to_num(basis(np.clip(nodes[:, None] - taps[None, :], -3.0, 3.0)))
    return np.linalg.solve(np.vander(nodes, _TAPS, increasing=True), values)


_VALUE = _tap_polynomials()


@dataclass(frozen=True, eq=False)
class SpotTemplate:
    """Calibrated shapes of T spots, of unit flux.

    `from_image` makes the template of one spot, and `stack` joins several.

    Dimensions: M rows of template samples, R terms of the factorisation, N columns of template samples.

    Attributes
    ----------
    row_factors, column_factors : (T, M, R) and (T, N, R) ndarray
        Factors of the quintic spline coefficients.
    centre : (T, 2) ndarray
        Centre (row, column) of the spot in template samples.
    shape : tuple of int
        Rows and columns (H, W) of the detector images that the template is compared with.
    oversampling : int
        Template samples per detector pixel, >= 1.
    truncation : float
        Bound on the truncation error of the factorisation, relative to the peak.

    Examples
    --------
    Calibrate the shape of an Airy pattern, and find a spot of this shape that is shifted by (0.25, -0.4) px:

    >>> import numpy as np
    >>> from scipy.special import j1
    >>> import analysis
    >>> def airy(row, column, size):
    ...     y, x = np.mgrid[:size, :size] - np.array([row, column])[:, None, None]
    ...     r = np.pi * np.hypot(y, x) / 4.0 + 1e-9
    ...     return (2.0 * j1(r) / r) ** 2
    >>> template = analysis.SpotTemplate.from_image(airy(32, 32, 65), row=32, column=32, shape=(33, 33))
    >>> template.count, template.shape
    (1, (33, 33))
    >>> image = 100 + 5000 * airy(16.25, 15.6, 33)
    >>> fit = analysis.fit_spot(image, analysis.NoiseModel(), method="ml", template=template)
    >>> round(fit.row, 3), round(fit.column, 3)
    (16.25, 15.6)
    """

    row_factors: Array
    column_factors: Array
    centre: Array
    shape: tuple[int, int]
    oversampling: int
    truncation: float

    @classmethod
    @checked
    def from_image(
        cls,
        image: ArrayLike,
        row: float,
        column: float,
        shape: tuple[int, int],
        oversampling: int = 1,
        background: float = 0.0,
        tolerance: float = 1e-8,
    ) -> SpotTemplate:
        """Make the template of a spot's shape from one image of the spot.

        Dimensions: M rows of template samples, N columns of template samples.

        Parameters
        ----------
        image : (M, N) array_like
            Samples at the detector's pitch / oversampling, larger than the detector by a margin on every side that
            covers the shifts to be measured (16 to 32 px).
        row : float
            Row of the spot's centre in samples of `image`, as the user defines "centre"; shifts do not depend on it.
        column : float
            Column of the centre in samples of `image`.
        shape : tuple of int
            Rows and columns (H, W) of the detector.
        oversampling : int
            Samples of `image` per pixel of the detector.
        background : float
            Constant level to be subtracted from the image.
        tolerance : float
            Allowed truncation error of the factorisation, relative to the peak. For a measured image choose its
            relative noise.

        Raises
        ------
        ValueError
            The image is not finite, not larger than the detector, or has no flux.
        """
        data = np.asarray(image, dtype=np.float64)
        if data.ndim != 2 or not np.all(np.isfinite(data)):
            raise ValueError(f"spot template: image must be a finite (M, N) array, found shape {data.shape}")
        if oversampling < 1:
            raise ValueError(f"spot template: oversampling must be an integer >= 1, found {oversampling!r}")
        height, width = (int(n) for n in shape)
        need = ((height - 1) * oversampling + _TAPS, (width - 1) * oversampling + _TAPS)
        if height < 1 or width < 1 or data.shape[0] < need[0] or data.shape[1] < need[1]:
            raise ValueError(
                f"spot template: image {data.shape} must be at least {need} samples for a detector of"
                f" {tuple(shape)} pixels at oversampling {oversampling};"
                " give it a margin of 16 to 32 pixels on every side"
            )
        if not (0 <= row <= data.shape[0] - 1 and 0 <= column <= data.shape[1] - 1):
            raise ValueError(f"spot template: centre ({row}, {column}) lies outside the image {data.shape}")
        if not 0 <= tolerance < 0.1:
            raise ValueError(f"spot template: tolerance must be in [0, 0.1), found {tolerance!r}")
        data = data - background
        flux = float(data.sum()) / oversampling**2
        if not flux > 0:
            raise UndeterminedError(
                f"spot template: image contains no flux after background {background} is taken off (sum {flux:g})"
            )
        coefficients = ndimage.spline_filter(data / flux, order=_DEGREE, mode="mirror", output=np.float64)
        u, s, vt = np.linalg.svd(coefficients, full_matrices=False)
        # sum of the dropped terms, each at most |s_k| max|u_k| max|v_k|: a bound on the error at any pixel, as the
        # spline weights are positive and sum to one.
        bound = s * np.abs(u).max(axis=0) * np.abs(vt).max(axis=1)
        tail = np.append(np.cumsum(bound[::-1])[::-1], 0.0)
        peak = float(np.abs(data).max()) / flux
        rank = max(1, int(np.argmax(tail <= tolerance * peak)))
        root = np.sqrt(s[:rank])
        return cls(
            row_factors=np.ascontiguousarray(u[:, :rank] * root)[None],
            column_factors=np.ascontiguousarray(vt[:rank].T * root)[None],
            centre=np.array([[row, column]], dtype=np.float64),
            shape=(height, width),
            oversampling=int(oversampling),
            truncation=float(tail[rank] / peak),
        )

    @classmethod
    def stack(cls, templates: Sequence[SpotTemplate]) -> SpotTemplate:
        """Join templates of one detector shape, grid and oversampling into one that holds them all, in order."""
        if not templates:
            raise ValueError("spot template: nothing to stack")
        first = templates[0]
        for number, other in enumerate(templates):
            same = other.shape == first.shape and other.oversampling == first.oversampling
            if not same or other.grid != first.grid:
                raise ValueError(
                    f"spot template: template {number} has another shape, grid or oversampling than the first"
                )
        rank = max(t.row_factors.shape[2] for t in templates)

        def pad(factors: Array) -> Array:
            return np.pad(factors, ((0, 0), (0, 0), (0, rank - factors.shape[2])))

        return cls(
            row_factors=np.concatenate([pad(t.row_factors) for t in templates]),
            column_factors=np.concatenate([pad(t.column_factors) for t in templates]),
            centre=np.concatenate([t.centre for t in templates]),
            shape=first.shape,
            oversampling=first.oversampling,
            truncation=max(t.truncation for t in templates),
        )

    @property
    def count(self) -> int:
        """Number T of spot shapes in the template."""
        return int(self.centre.shape[0])

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns (M, N) of the calibrated image, in samples.

        Dimensions: M rows of template samples, N columns of template samples.
        """
        return int(self.row_factors.shape[1]), int(self.column_factors.shape[1])

    def supported(self, index: int = 0) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the range of positions, in detector pixels, at which a shape covers the whole detector.

        The result is ((row low, row high), (column low, column high)).
        """
        margin = _TAPS // 2 - 1
        limits = []
        for size, pixels, centre in zip(self.grid, self.shape, self.centre[index], strict=True):
            high = (centre - margin) / self.oversampling
            low = (centre + margin + 1 - (size - 1)) / self.oversampling + pixels - 1
            limits.append((float(low), float(high)))
        return limits[0], limits[1]

    def evaluate(
        self,
        row: ArrayLike,
        column: ArrayLike,
        index: NDArray[np.intp] | None = None,
        part: tuple[NDArray[np.intp], tuple[int, int]] | None = None,
    ) -> tuple[Array, Array, Array]:
        """Return the spot at a position and its derivatives with respect to row and column.

        The three arrays are value, d value / d row and d value / d column, each (B, H, W) or (B, h, w); value is the
        fraction of the flux per pixel.

        Dimensions: B spots, H rows, W columns.

        Parameters
        ----------
        row : (B,) array_like
            Row of the spots' centres, detector pixels.
        column : (B,) array_like
            Column of the spots' centres, detector pixels.
        index : (B,) ndarray of int or None
            Index of each spot's shape; default: spot b has shape b modulo T.
        part : tuple or None
            First pixels (B, 2), one for each spot, and number of rows h and columns w of the part of the detector to
            evaluate; default: all of it.

        Raises
        ------
        TemplateRangeError
            A position is outside `supported`; the error names the spots.
        """
        rows = np.atleast_1d(np.asarray(row, dtype=np.float64))
        columns = np.atleast_1d(np.asarray(column, dtype=np.float64))
        which = np.arange(rows.size) % self.count if index is None else np.asarray(index)
        if not rows.shape == columns.shape == which.shape or rows.ndim != 1:
            raise ValueError(
                f"spot template: row {rows.shape}, column {columns.shape}, index {which.shape} must all be (B,)"
            )
        self.check_range(rows, columns, which)
        corner, shape = (np.zeros((rows.size, 2), np.intp), self.shape) if part is None else part
        out = np.empty((3, rows.size, *shape))
        self._fill(out[1:], out[0], rows - corner[:, 0], columns - corner[:, 1], which, np.ones(rows.size))
        return out[0], out[1], out[2]

    def fill_design(
        self,
        out: Array,
        theta: Array,
        index: NDArray[np.intp],
        part: tuple[NDArray[np.intp], tuple[int, int]] | None = None,
    ) -> None:
        """Fill ``out`` with the derivatives of a spot's image with respect to row, column, flux and background.

        Dimensions: B spots, H rows, W columns.

        Parameters
        ----------
        out : (B, 4, H, W) ndarray
            Array to fill, or (B, 4, h, w) for a part; derivatives with respect to the position are in DN/px, those with
            respect to flux and background have no unit.
        theta : (B, 4) ndarray
            Row, column (px), flux and background (DN, grey values).
        index : (B,) ndarray of int
            Index of each spot's shape in the template.
        part : tuple or None
            First pixels (B, 2), one for each spot, and number of rows h and columns w of the part of the detector to
            compute; None for all of it.

        Raises
        ------
        TemplateRangeError
            A position is outside `supported`.
        """
        self.check_range(theta[:, 0], theta[:, 1], index)
        position = theta[:, :2] - (0 if part is None else part[0])
        self._fill(out[:, :2].swapaxes(0, 1), out[:, 2], position[:, 0], position[:, 1], index, theta[:, 2])
        out[:, 3] = 1.0

    def _fill(
        self, slopes: Array, value: Array, rows: Array, columns: Array, index: NDArray[np.intp], flux: Array
    ) -> None:
        """Write values (B, H, W) and derivatives with respect to row and column (2, B, H, W) times flux (B,).

        The positions have been checked already.

        Dimensions: B spots, H rows, W columns.
        """
        height, width = value.shape[1:]
        a = self._shift(self._polynomials[0], self.centre[index, 0], rows, index, height, flux)
        b = self._shift(self._polynomials[1], self.centre[index, 1], columns, index, width, flux).swapaxes(2, 3)
        np.matmul(a[:, 0], b[:, 0], out=value)
        np.matmul(a[:, 1], b[:, 0], out=slopes[0])
        np.matmul(a[:, 0], b[:, 1], out=slopes[1])

    @cached_property
    def _polynomials(self) -> tuple[Array, Array]:
        """Spline factors of rows and columns as polynomials of the fraction of a sample, (T, power, sample, R).

        Dimensions: T spot shapes, R terms of the factorisation.
        """
        out = []
        for factors in (self.row_factors, self.column_factors):
            intervals = factors.shape[1] - _TAPS + 1
            taps = np.stack([factors[:, tap : tap + intervals] for tap in range(_TAPS)], axis=1)
            out.append(np.ascontiguousarray(np.einsum("pk,tkmr->tpmr", _VALUE, taps)))
        return out[0], out[1]

    def _shift(
        self, polynomials: Array, centre: Array, position: Array, index: NDArray[np.intp], pixels: int, flux: Array
    ) -> Array:
        """Evaluate the spline along one axis at shifted positions, (B, 2, pixels, R).

        The second axis holds the values at the detector's pixels, and the derivatives with respect to the position
        times flux (B,).

        Dimensions: B spots, R terms of the factorisation.
        """
        step = self.oversampling
        start = centre - step * position
        base = np.floor(start).astype(np.intp)
        power = np.arange(_TAPS)
        powers = (start - base)[:, None] ** power
        slopes = np.zeros_like(powers)
        slopes[:, 1:] = (-step * flux)[:, None] * power[1:] * powers[:, :-1]
        weights = np.stack([powers, slopes], axis=1)
        rank = polynomials.shape[-1]
        out = np.empty((position.size, 2, pixels * rank))
        first = base - (_TAPS // 2 - 1)
        for spot in range(position.size):
            span = slice(first[spot], first[spot] + step * (pixels - 1) + 1, step)
            np.matmul(weights[spot], polynomials[index[spot], :, span].reshape(_TAPS, -1), out=out[spot])
        return out.reshape(position.size, 2, pixels, rank)

    def check_range(self, rows: Array, columns: Array, index: NDArray[np.intp]) -> None:
        """Raise TemplateRangeError for positions outside `supported`.

        Dimensions: B spots.

        Parameters
        ----------
        rows : (B,) ndarray
            Row of the spots' centres, detector pixels.
        columns : (B,) ndarray
            Column of the spots' centres, detector pixels.
        index : (B,) ndarray of int
            Index of each spot's shape.
        """
        limits = np.array([self.supported(t) for t in range(self.count)])[index]
        position = np.stack([rows, columns], axis=1)
        # written so that NaN is outside
        inside = np.all((position >= limits[:, :, 0]) & (position <= limits[:, :, 1]), axis=1)
        if np.all(inside):
            return
        bad = np.flatnonzero(~inside)
        first = int(bad[0])
        raise TemplateRangeError(
            f"spot template: spot {first} at ({position[first, 0]:.3f}, {position[first, 1]:.3f}) px is outside the"
            f" supported rows {limits[first, 0, 0]:.2f} to {limits[first, 0, 1]:.2f} and columns"
            f" {limits[first, 1, 0]:.2f} to {limits[first, 1, 1]:.2f} ({bad.size} such spots);"
            " calibrate with a larger margin",
            [int(n) for n in bad],
        )


class SmearedShape:
    """Shape of a template convolved with a normal distribution, with its first and second derivatives.

    The convolution multiplies the spectrum of the spline's coefficients, which is exact for a band-limited shape; the
    template's grid counts as one period, which its dark margins allow.

    Parameters
    ----------
    template : SpotTemplate
        Template whose first shape is smeared.
    """

    def __init__(self, template: SpotTemplate) -> None:
        self._template = template
        coefficients = template.row_factors[0] @ template.column_factors[0].T
        self._spectrum = fft.rfft2(coefficients)
        angular = 2.0 * np.pi * template.oversampling
        self._rows = angular * np.fft.fftfreq(template.grid[0])[:, None]
        self._columns = angular * np.fft.rfftfreq(template.grid[1])[None, :]

    def smeared(self, covariance: Array) -> Array:
        """Return the spline coefficients (M, N) of the smeared shape, for `evaluate`.

        Dimensions: M rows of template samples, N columns of template samples.

        Parameters
        ----------
        covariance : (2, 2) ndarray
            Covariance of the normal distribution, (row, column), px^2. Where it is negative the shape is made sharper,
            by less than `SHARPEST` at any frequency.
        """
        return np.asarray(fft.irfft2(self._spectrum * self._kernel(covariance), self._template.grid))

    def _kernel(self, covariance: Array) -> Array:
        (a, b), (_, c) = covariance
        power = a * self._rows**2 + 2.0 * b * self._rows * self._columns + c * self._columns**2
        return np.asarray(np.exp(np.minimum(-0.5 * power, math.log(SHARPEST))))

    def evaluate(self, coefficients: Array, row: float, column: float) -> Array:
        """Return the smeared shape at one position with its first and second derivatives, (6, H, W).

        The order is value; derivatives with respect to row and to column (1/px); second derivatives with respect to row
        twice, row and column, column twice (1/px^2).

        Dimensions: H rows, W columns, M rows of template samples, N columns of template samples.

        Parameters
        ----------
        coefficients : (M, N) ndarray
            Spline coefficients from `smeared`.
        row : float
            Row of the centre, detector pixels.
        column : float
            Column of the centre, detector pixels.

        Raises
        ------
        TemplateRangeError
            The position is outside `supported`.
        """
        template = self._template
        template.check_range(np.array([row]), np.array([column]), np.zeros(1, np.intp))
        centre, (height, width) = template.centre[0], template.shape
        by_row, rows = self._splines(centre[0], row, height)
        by_column, columns = self._splines(centre[1], column, width)
        part = coefficients[rows, columns]
        out = np.empty((6, height, width))
        lines = [order @ part for order in by_row]
        for k, (i, j) in enumerate(((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))):
            np.matmul(lines[i], by_column[j].T, out=out[k])
        return out

    def returned(self, maps: Array, row: float, column: float, covariance: Array) -> Array:
        """Return derivatives with respect to the samples of the shape's image, (n, M, N), from those of its pixels.

        This is the transpose of smearing, interpolating and evaluating at one position.

        Dimensions: M rows of template samples, N columns of template samples, H rows, W columns.

        Parameters
        ----------
        maps : (n, H, W) ndarray
            Derivatives of n quantities with respect to the pixels.
        row : float
            Row of the centre, detector pixels.
        column : float
            Column of the centre, detector pixels.
        covariance : (2, 2) ndarray
            Covariance of the normal distribution that smears the shape, (row, column), px^2.
        """
        centre, (height, width) = self._template.centre[0], self._template.shape
        by_row, rows = self._splines(centre[0], row, height)
        by_column, columns = self._splines(centre[1], column, width)
        out = np.zeros((len(maps), *self._template.grid))
        out[:, rows, columns] = by_row[0].T @ maps @ by_column[0]
        if np.any(covariance):
            # the kernel is even, and so its own transpose
            out = fft.irfft2(fft.rfft2(out) * self._kernel(covariance), self._template.grid)
        along = [ndimage.spline_filter1d(np.eye(size), _DEGREE, mode="mirror", axis=0) for size in out.shape[1:]]
        return np.asarray(along[0].T @ out @ along[1])

    def _splines(self, centre: float, position: float, pixels: int) -> tuple[Array, slice]:
        """Return the weight of each sample in every pixel with its two derivatives, and the range of samples used."""
        step = self._template.oversampling
        start = centre - step * position
        base = int(np.floor(start))
        power, pixel = np.arange(_TAPS), np.arange(pixels)
        powers = np.zeros((3, _TAPS))
        powers[0] = (start - base) ** power
        powers[1, 1:] = -step * power[1:] * powers[0, :-1]
        powers[2, 2:] = step**2 * power[2:] * power[1:-1] * powers[0, :-2]
        out = np.zeros((3, pixels, step * (pixels - 1) + _TAPS))
        out[:, pixel[:, None], step * pixel[:, None] + power] = (powers @ _VALUE)[:, None]
        first = base - (_TAPS // 2 - 1)
        return out, slice(first, first + out.shape[2])
