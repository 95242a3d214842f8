"""Diffraction images: the matrix Fourier transform of a traced pupil onto a detector's own grid.

Convention: time factor exp(-i w t), a wave of phase exp(+i k L) with L its optical path and k = 2 pi / wavelength.

Near the image point P0 every traced ray j is a local plane wave of amplitude a_j, of direction cosines (u, v) along the
detector's x and y, and of eikonal L (the optical path to the wave's plane through P0). The field on the detector is the
sum of these waves,

    U(x, y) = 1/lambda * sum_j w_j a_j exp(i k (L_j + u_j x + v_j y)),

with w_j the pupil element. Because exp(ik(ux + vy)) factors, U of N rays on a grid of R x C pixels is the product of an
(R x N) and an (N x C) matrix: no FFT grid, no padding, pixels wherever the detector has them (Soummer et al., Opt.
Express 15, 15935 (2007), here with arbitrary pupil nodes). Plancherel: with sum w_j |a_j|^2 = P over du dv the image
integrates to P.

Sampling of the field. Along one detector axis the field of a beam is a sum of exp(i q x) with |q| no more than the half
width of the beam's directions. On a whole interval such a function is determined by little more samples than its
Nyquist number, if they extend somewhat beyond the ends of the interval (Slepian and Pollak, Bell Syst. Tech. J. 40, 43,
1961; here by least squares over all q of the band). A spot that is well sampled by its pixels needs half or a third as
many columns and rows as there are pixels.

Pixel response. ``PixelResponse`` is a short exact filter for the pixel area and an extended incoherent source, applied
to a well-sampled image.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from optics.numerics.arguments import finite
from optics.numerics.array_math import PhysicalError
from optics.numerics.backend import cores, one_blas_thread

MAX_POINTS = 256
"""Largest number of grid points whose field is interpolated from one set of samples; longer grids are divided.

The work of computing the samples grows with the cube of the number of points.
"""

_BEYOND, _BEYOND_IF_LOOSE = 4.0, 3.0
"""Distances by which samples extend beyond each end of the grid, in multiples of the Nyquist distance.

They give interpolation errors of at most `_TIGHT` and of `_LOOSE`.
"""

_TIGHT, _LOOSE = 2e-12, 1e-8
"""Largest errors at the grid points of a unit wave interpolated from its samples: normal and loose accuracy."""

_OVER = 1.35
"""Factor of the Nyquist number in the number of samples that is tried first."""
_MORE, _MORE_IF_LOOSE = 22, 14
"""Numbers of samples added to ``_OVER`` times the Nyquist number, which gives the first number that is tried.

They are for interpolation errors of at most `_TIGHT` and of `_LOOSE`.
"""

_BAND_RATIO = 1.1
"""Ratio of one bandwidth to the next in the geometric series of bandwidths for which sets of samples are computed."""

_MAX_RATIO = 0.8
"""Ratio of samples to grid points above which the field is computed at all points instead."""

_MAX_BAND = 2.5
"""Largest phase of the field's waves, radians from one grid point to the next, for which samples are used.

Beyond it, the points undersample the field.
"""


@dataclass(frozen=True, eq=False)
class FieldSamples:
    """Samples of a field along one axis, evenly spaced and symmetric about the middle of the points.

    Attributes
    ----------
    step : float
        Distance between two samples, in steps of the points.
    weights : (N, M) ndarray
        Weights of the M samples (an even number) in each of the N points.
    """

    step: float
    weights: np.ndarray

    @property
    def count(self) -> int:
        """Number M of samples."""
        return self.weights.shape[1]

    @classmethod
    def of(cls, points: int, band: float, loose: bool) -> FieldSamples | None:
        """Return samples for a grid of points, or None where they would not be fewer than the points.

        Parameters
        ----------
        points : int
            Number N of grid points, at most ``MAX_POINTS``.
        band : float
            Largest spatial frequency of the field, as phase in radians from one point to the next.
        loose : bool
            True for an accuracy of 1e-8 of the sum of all waves' amplitudes; False for 2e-12.
        """
        if not 0.0 < band < _MAX_BAND:
            return None
        rung = int(np.ceil(np.log(band) / np.log(_BAND_RATIO)))
        return _samples(points, rung, loose)


@lru_cache(maxsize=64)
def _samples(points: int, rung: int, loose: bool) -> FieldSamples | None:
    """Return samples for a field whose phase changes by up to ``_BAND_RATIO**rung`` radians from point to point."""
    band = _BAND_RATIO**rung
    nyquist, beyond = np.pi / band, _BEYOND_IF_LOOSE if loose else _BEYOND
    first = _OVER * points / nyquist + (_MORE_IF_LOOSE if loose else _MORE)
    extent = 0.5 * (points - 1) + beyond * min(nyquist, 0.25 * points)
    for count in range(2 * int(np.ceil(0.5 * first)), int(_MAX_RATIO * points) + 1, 2):
        step = 2.0 * extent / (count - 1)
        # even and odd functions of the band, dense at its ends
        nodes = (np.arange(2 * count) + 0.5) / (4 * count)
        known, wanted = _plane_waves(points, count, step, band * np.cos(np.pi * nodes))
        weights = np.linalg.lstsq(known, wanted, rcond=1e-15)[0]
        between = band * np.cos(np.pi * (np.arange(2 * count) / (4 * count)))
        sampled, true = _plane_waves(points, count, step, between)
        if np.max(np.abs(sampled @ weights - true)) <= (_LOOSE if loose else _TIGHT):
            weights = np.ascontiguousarray(weights.T)
            weights.setflags(write=False)
            return FieldSamples(step, weights)
    return None


def _plane_waves(points: int, count: int, step: float, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return cosines and sines of waves of frequencies q (radians per step of the points), at samples and at points."""
    even = step * (np.arange(count) - 0.5 * (count - 1)), np.arange(points) - 0.5 * (points - 1)
    first, then = (np.concatenate([np.cos(q[:, None] * x), np.sin(q[:, None] * x)]) for x in even)
    return first, then


@dataclass(frozen=True, eq=False)
class PupilField:
    """Plane waves that form B images, N nodes of the pupil each.

    Attributes
    ----------
    u, v : (B, N) ndarray
        Direction cosines along the detector's x and y.
    eikonal : (B, N) ndarray
        Optical path to the plane wave through the image's origin, metres, common piston removed.
    amplitude : (B, N) ndarray
        Amplitude of the wave times the area of the node in direction cosines, such that the module's formula holds with
        unit total power; 0 = blocked.
    wavelength : float
        Wavelength, metres.
    """

    u: np.ndarray
    v: np.ndarray
    eikonal: np.ndarray
    amplitude: np.ndarray
    wavelength: float

    def __getitem__(self, piece: slice) -> PupilField:
        """Return the field of some of the images, selected by a slice."""
        return PupilField(self.u[piece], self.v[piece], self.eikonal[piece], self.amplitude[piece], self.wavelength)

    def scaled_by(self, size: np.ndarray) -> PupilField:
        """Return the field in coordinates x / size, y / size: those of pixels scaled by ``size``, (B,), in B images.

        Phases u x + v y and the power are unchanged, so that an image gives photons per area of the nominal pixels.
        """
        size = np.asarray(size)[:, None]
        return PupilField(self.u * size, self.v * size, self.eikonal, self.amplitude * size, self.wavelength)


@dataclass(frozen=True)
class Grid:
    """Evenly spaced samples along one detector axis: start, start + step, ... (metres from the image's origin)."""

    start: float
    step: float
    count: int

    def points(self) -> np.ndarray:
        """Return all samples, (count,)."""
        return self.start + self.step * np.arange(self.count)


def image(field: PupilField, x: Grid, y: Grid, single: bool = False) -> np.ndarray:
    """Return the irradiance on the grid of columns x and rows y by the matrix Fourier transform.

    Where the pixels sample the field well, it is summed at fewer points and interpolated (``FieldSamples``).

    Parameters
    ----------
    field : PupilField
        Plane waves of B images.
    x : Grid
        Detector x of the C columns.
    y : Grid
        Detector y of the R rows.
    single : bool
        True for an accuracy of some 1e-7 of the peak, as in single precision, in less time; False for 1e-12.

    Returns
    -------
    (B, R, C) ndarray
        Irradiance, 1/m^2 for unit power through the pupil.
    """
    k = 2.0 * np.pi / field.wavelength
    count = len(field.u)
    out = np.empty((count, y.count, x.count))
    centred, bands = _centred(field, k)
    parts = []
    for columns, column_slice in _pieces(x):
        for rows, row_slice in _pieces(y):
            samples = [
                FieldSamples.of(grid.count, band * abs(grid.step), single)
                for grid, band in zip((columns, rows), bands, strict=True)
            ]
            parts.append((columns, rows, samples, out[:, row_slice, column_slice]))

    # small blocks, so that a few images use all cores
    block_size = max(1, min(_BLOCK_IMAGES, count // cores()))

    def piece(start: int) -> None:
        block = slice(start, start + block_size)
        for columns, rows, (across, down), part in parts:
            if across is None or down is None:
                _irradiance(field[block], k, columns, rows, np.complex64 if single else np.complex128, part[block])
            else:
                _from_samples(centred[block], k, (columns, across), (rows, down), part[block])

    with one_blas_thread(), ThreadPoolExecutor(cores()) as pool:
        list(pool.map(piece, range(0, count, block_size)))
    return out


def _pieces(grid: Grid) -> list[tuple[Grid, slice]]:
    """Return a grid divided into intervals of at most ``MAX_POINTS`` points, of nearly equal length."""
    count = -(-grid.count // MAX_POINTS)
    ends = [grid.count * n // count for n in range(count + 1)]
    return [
        (Grid(grid.start + grid.step * first, grid.step, last - first), slice(first, last))
        for first, last in pairwise(ends)
    ]


def _centred(field: PupilField, k: float) -> tuple[PupilField, tuple[float, float]]:
    """Return the field without its common tilt, and the half-widths of its directions along x and y, radians per metre.

    ``k`` is the wave number, 1/m. The common tilt does not affect the irradiance.
    """
    centred, bands = [], []
    for cosine in (field.u, field.v):
        low, high = cosine.min(axis=1, keepdims=True), cosine.max(axis=1, keepdims=True)
        centred.append(cosine - 0.5 * (low + high))
        bands.append(0.5 * k * float(np.max(high - low)))
    return replace(field, u=centred[0], v=centred[1]), (bands[0], bands[1])


def _from_samples(
    field: PupilField, k: float, across: tuple[Grid, FieldSamples], down: tuple[Grid, FieldSamples], out: np.ndarray
) -> None:
    """Fill ``out`` (B, R, C) with the irradiance of B images at R rows and C columns, from samples of the field.

    ``k`` is the wave number, 1/m; rows of samples at equal distances on both sides of the middle share their waves.
    """
    (x, columns), (y, rows) = across, down
    count, nodes = field.u.shape
    half = rows.count // 2
    step, middle = (
        [s.step * grid.step for grid, s in (across, down)],
        [g.start + 0.5 * (g.count - 1) * g.step for g in (x, y)],
    )
    start = middle[0] - 0.5 * (columns.count - 1) * step[0]
    product: np.ndarray = np.zeros((count, 2 * half, 2 * columns.count))
    for begin in range(0, nodes, _NODES):
        block = slice(begin, begin + _NODES)
        u, v = field.u[:, block], field.v[:, block]
        factor = _phasor(k * (field.eikonal[:, block] + start * u + middle[1] * v))
        factor *= field.amplitude[:, block]
        first = _phasor(0.5 * k * step[1] * v)
        left = _real_rows(first, first * first, half)
        product += left @ np.swapaxes(_real_rows(factor, _phasor(k * step[0] * u), columns.count), 1, 2)
    # cosines, then sines, of the rows; real, then imaginary parts, of the columns
    terms = np.moveaxis(product.reshape(count, 2, half, 2, -1), 3, -1)
    even, odd = (np.ascontiguousarray(terms[:, n]).view(np.complex128)[..., 0] for n in (0, 1))
    odd = 1j * odd
    wave = np.concatenate([(even - odd)[:, ::-1], even + odd], axis=1)
    wave = (rows.weights @ wave.view(np.float64)).view(np.complex128)
    parts = [np.ascontiguousarray(part) @ columns.weights.T for part in (wave.real, wave.imag)]
    np.multiply(parts[0] ** 2 + parts[1] ** 2, 1.0 / field.wavelength**2, out=out)


def _real_rows(first: np.ndarray, factor: np.ndarray, count: int) -> np.ndarray:
    """Return the real, then the imaginary parts of ``first`` times the powers 0 .. ``count`` - 1 of ``factor``.

    Both are complex, (B, N) for N nodes in B images; the result has the shape (B, 2 count, N). The powers are built by
    doubling: the powers m, m + 1, ..., 2 m - 1 are the first m powers times ``factor``^m.
    """
    table = np.empty((len(first), count, first.shape[1]), np.complex128)
    table[:, 0] = first
    done = 1
    while done < count:
        added = min(done, count - done)
        np.multiply(table[:, :added], factor[:, None], out=table[:, done : done + added])
        factor = factor * factor
        done += added
    return np.concatenate([table.real, table.imag], axis=1)


def _phasor(phase: np.ndarray) -> np.ndarray:
    """Return the complex number exp(i phase) for phases in radians."""
    out = np.empty(phase.shape, np.complex128)
    np.cos(phase, out=out.real)
    np.sin(phase, out=out.imag)
    return out


def _irradiance(field: PupilField, k: float, x: Grid, y: Grid, kind: type, out: np.ndarray) -> None:
    """Fill ``out`` (B, R, C) with the irradiance of B images at R rows and C columns.

    Rows at equal distances d on both sides of the grid's middle share their waves: with f_j the complex amplitude of
    node j and q_j its frequency along y (rad/m), sum_j f_j exp(+-i q_j d) is P +- i Q with P the sum of f_j cos(q_j d)
    and Q that of f_j sin(q_j d). So real tables of half of the rows suffice, and a real matrix product of half of the
    work.
    """
    count, nodes = field.u.shape
    half = (y.count + 1) // 2
    first = 0.0 if y.count % 2 else 0.5 * y.step
    middle = y.start + 0.5 * (y.count - 1) * y.step
    factor = field.amplitude * np.exp(1j * k * (field.eikonal + middle * field.v))
    real = np.float32 if kind is np.complex64 else np.float64
    product: np.ndarray = np.zeros((count, 2 * half, 2 * x.count), real)
    tables = max(1, _TABLES // (count * _BLOCK_SUM * (half + x.count))) * _BLOCK_SUM
    for begin in range(0, nodes, tables):
        block = slice(begin, begin + tables)
        rows = _waves(k * field.v[:, block], Grid(first, y.step, half), 1.0, kind)
        columns = _waves(k * field.u[:, block], x, factor[:, block], kind)
        # a complex number is two real ones: (B, N, 2 half), its cosines and sines by turns, and (B, N, 2 C)
        left, right = np.swapaxes(rows.view(real), 1, 2), columns.view(real)
        for start in range(0, left.shape[-1], _BLOCK_SUM):
            product += left[..., start : start + _BLOCK_SUM] @ right[:, start : start + _BLOCK_SUM]
    terms: np.ndarray = product.view(kind).reshape(count, half, 2, x.count)
    even, odd = terms[:, :, 0], terms[:, :, 1]
    scale = 1.0 / field.wavelength**2
    for sign, part in ((1.0, out[:, y.count - half :]), (-1.0, out[:, half - 1 :: -1])):
        real_part, imaginary_part = even.real - sign * odd.imag, even.imag + sign * odd.real
        np.multiply(real_part * real_part + imaginary_part * imaginary_part, scale, out=part)


def at_intersections(field: PupilField, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the irradiance at the intersections of C columns and R rows of each of B images, (B, R, C), in 1/m^2.

    It is the sum of ``image``, term by term. Phases are computed in double, waves in single precision: accurate to some
    1e-6 of the peak.

    Parameters
    ----------
    field : PupilField
        Plane waves of B images.
    x : (B, C) ndarray
        Positions of the columns, metres.
    y : (B, R) ndarray
        Positions of the rows, metres.
    """
    wave_number = 1.0 / field.wavelength

    def waves(cycles: np.ndarray) -> np.ndarray:
        phase = (2.0 * np.pi * (cycles - np.rint(cycles))).astype(np.float32)
        return np.asarray(np.cos(phase) + 1j * np.sin(phase))

    rows = waves(wave_number * (field.eikonal[:, None] + y[..., None] * field.v[:, None]))
    rows *= field.amplitude[:, None].astype(np.float32)
    columns = waves(wave_number * x[..., None] * field.u[:, None])
    wave = rows @ np.swapaxes(columns, 1, 2)
    return np.asarray((wave.real.astype(np.float64) ** 2 + wave.imag.astype(np.float64) ** 2) / field.wavelength**2)


_BLOCK_IMAGES = 2
"""Number of images whose wave tables are processed together: the tables should stay in the processor's cache."""

_TABLES = 1 << 21
"""Size, in numbers, of the tables of waves of a block of nodes, so that memory does not grow with the number of nodes.

The order of the sums does not depend on it.
"""

_NODES = 4096
"""Number of nodes of the pupil that are processed in one block where the field is computed at samples."""

_BLOCK_SUM = 160
"""Number of nodes that are added up in one partial sum; the partial sums are then added.

Sums of sums have less rounding error than one long sum, above all in single precision.
"""


def _waves(frequency: np.ndarray, grid: Grid, factor: np.ndarray | float, kind: type) -> np.ndarray:
    """Return factor * exp(i frequency * point) for N frequencies (..., N), rad/m, on a grid: (..., N, count).

    Built by doubling: the wave at a point m steps from the first is the wave at the first times exp(i frequency m
    step), with m = 1, 2, 4, ... from one phasor that is squared in double precision. Each sample is a product of at
    most log2(count) + 1 phasors.
    """
    out = np.empty((*frequency.shape, grid.count), kind)
    out[..., 0] = factor * np.exp(1j * frequency * grid.start)
    phasor = np.exp(1j * frequency * grid.step)
    done = 1
    while done < grid.count:
        added = min(done, grid.count - done)
        np.multiply(out[..., :added], phasor.astype(kind)[..., None], out=out[..., done : done + added])
        phasor = phasor * phasor
        done += added
    return out


def airy(radius: ArrayLike, wavelength: float, f_number: float, obscuration: float = 0.0) -> np.ndarray:
    """Compute the image of a point by a perfect round pupil, relative to its centre.

    Parameters
    ----------
    radius : array_like
        Distance from the centre of the image, metres, any shape; its sign has no meaning.
    wavelength : float
        Wavelength of the light, metres.
    f_number : float
        Focal length over the diameter of the pupil.
    obscuration : float
        Diameter of a central obscuration over that of the pupil, 0 to less than 1.

    Returns
    -------
    ndarray
        Irradiance over that of the centre, of the shape of ``radius``.

    Raises
    ------
    ValueError
        A number is out of its range.

    Examples
    --------
    The first dark ring of a clear pupil is at 1.22 lambda N, and the ring after it has 1.75 % of the peak. A central
    obscuration moves light into that ring, and the ring inward:

    >>> unit = 500e-9 * 8
    >>> airy(np.array([0.0, 1.2197, 1.635]) * unit, 500e-9, 8).round(4)
    array([1.    , 0.    , 0.0175])
    >>> float(airy(1.48 * unit, 500e-9, 8, obscuration=0.3).round(3))
    0.041
    """
    if not (wavelength > 0.0 and f_number > 0.0 and 0.0 <= obscuration < 1.0):
        raise ValueError(
            f"wavelength and f_number must be positive and 0 <= obscuration < 1, got {wavelength}, {f_number} and "
            f"{obscuration}"
        )
    z, hole = np.pi * finite("radius", radius, "in metres") / (wavelength * f_number), obscuration**2
    return np.asarray(((_jinc(z) - hole * _jinc(obscuration * z)) / (1.0 - hole)) ** 2)


FIT_ERROR = 1e-6
"""Largest accepted error of the kernel's transfer function; the kernel is enlarged until it is below."""

MAX_HALF_WIDTH = 10
"""Largest half-width of the pixel filter's kernel, in pixels.

It suffices for images with frequencies up to three quarters of what the pixels can sample.
"""


class UnsampledImageError(PhysicalError, ValueError):
    """Image that is too fine for its pixels, or whose source is too large for the pixel filter.

    Attributes
    ----------
    remedy : str
        What to change.
    of_source : bool
        True when the remedy is a smaller source.
    """

    def __init__(self, text: str, remedy: str, of_source: bool) -> None:
        self.remedy = remedy
        self.of_source = of_source
        super().__init__(text)


@dataclass(frozen=True, eq=False)
class PixelResponse:
    """Filter that turns irradiance at pixel centres into the mean over the pixel, convolved with a disk source.

    A diffraction image contains no frequency above its optical cut-off. Below it, the transfer function of pixel and
    disk is matched by a small symmetric kernel, so that no oversampling is needed. Above half the sampling frequency
    this is impossible, and the fit raises an error.

    Attributes
    ----------
    kernel : (2 half_width + 1, 2 half_width + 1) ndarray
        Filter kernel.
    """

    kernel: np.ndarray

    @property
    def half_width(self) -> int:
        """Number of pixels by which the filter shrinks an image on every side."""
        return self.kernel.shape[0] // 2

    @classmethod
    def fit(cls, pitch: float, disk: float, cutoff: float) -> PixelResponse:
        """Fit the kernel to a pixel and a source.

        Parameters
        ----------
        pitch : float
            Pixel pitch, metres (the whole pixel is sensitive).
        disk : float
            Diameter of the source's image, metres; 0 for a point.
        cutoff : float
            Highest spatial frequency of the irradiance, cycles/m.

        Raises
        ------
        UnsampledImageError
            The pixels do not sample the image well enough.
        """
        limit = cutoff * pitch  # cycles per pixel
        if limit > 0.45:
            raise UnsampledImageError(
                f"the image has up to {limit:.2f} cycles per pixel, but its pixels can sample only 0.45",
                "smaller pixels, a longer focal length, a longer wavelength or a narrower beam",
                of_source=False,
            )
        f = np.linspace(-limit, limit, 41)
        fx, fy = (a.ravel() for a in np.meshgrid(f, f))
        inside = np.hypot(fx, fy) <= limit
        fx, fy = fx[inside], fy[inside]
        wanted = np.sinc(fx) * np.sinc(fy) * _jinc(np.pi * np.hypot(fx, fy) * disk / pitch)
        for half_width in range(1, MAX_HALF_WIDTH + 1):
            kernel, error = _symmetric_kernel(fx, fy, wanted, half_width)
            if error <= FIT_ERROR:
                kernel.setflags(write=False)
                return cls(kernel)
        raise UnsampledImageError(
            f"the response of pixels and a source of {disk / pitch:.3g} pixels is accurate only to {error:.1g} of the "
            f"peak in an image of up to {limit:.2f} cycles per pixel",
            "a smaller source or smaller pixels",
            of_source=disk > pitch,
        )

    def apply(self, images: np.ndarray) -> np.ndarray:
        """Return the filtered images, smaller by ``half_width`` pixels on every side.

        ``images`` (B, R, C) are B images of R rows and C columns; the result is (B, R - 2 h, C - 2 h), half width h.
        """
        # imported late, since commands that only check files import this module
        import cv2

        r = self.half_width
        out = np.empty((len(images), images.shape[1] - 2 * r, images.shape[2] - 2 * r))

        def work(number: int) -> None:
            out[number] = cv2.filter2D(images[number], cv2.CV_64F, self.kernel)[r:-r, r:-r]

        with ThreadPoolExecutor(cores()) as pool:
            list(pool.map(work, range(len(images))))
        return out


def _symmetric_kernel(fx: np.ndarray, fy: np.ndarray, wanted: np.ndarray, half_width: int) -> tuple[np.ndarray, float]:
    """Return the kernel of eightfold symmetry whose transfer function is nearest to ``wanted``, and the largest error.

    It is a least-squares fit at the frequencies ``fx``, ``fy``, in cycles per pixel.
    """
    orbits = []
    for i in range(half_width + 1):
        for j in range(i + 1):
            orbits.append(sorted({(a * p, b * q) for p, q in ((i, j), (j, i)) for a in (1, -1) for b in (1, -1)}))
    columns = [sum(np.cos(2.0 * np.pi * (fx * a + fy * b)) for a, b in orbit) for orbit in orbits]
    matrix = np.stack(columns, axis=-1)
    solution, *_ = np.linalg.lstsq(matrix, wanted, rcond=1e-13)
    kernel = np.zeros((2 * half_width + 1, 2 * half_width + 1))
    for orbit, value in zip(orbits, solution, strict=True):
        for a, b in orbit:
            kernel[half_width + a, half_width + b] = value
    return kernel, float(np.max(np.abs(matrix @ solution - wanted)))


def _jinc(z: np.ndarray) -> np.ndarray:
    """Return 2 J1(z)/z with the Bessel function J1, and 1 at z = 0: the transform of a disk relative to its area."""
    # imported late, since commands that only check files import this module
    from scipy.special import j1

    safe = np.where(z == 0.0, 1.0, z)
    return np.where(z == 0.0, 1.0, 2.0 * j1(safe) / safe)
