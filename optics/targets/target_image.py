"""Exact images of vector targets through optics that are shift-invariant over the window.

The irradiance is the inverse Fourier transform of the target's spectrum T (closed form,
``optics.geometry.vector_shape``) times a transfer function H: optical transfer function, pixel aperture, smear, charge
diffusion, whatever is linear. H ends at a known cut-off, so no supersampling is needed: every pixel gets the exact
value at its centre, which with the pixel aperture in H is the mean over the pixel. Signs: I(x) = integral of T(f) H(f)
exp(+2 pi i f . x) df, so that a factor exp(-2 pi i f . s) in H moves the image by +s. Because I is real, H(-f) = conj
H(f), and only half of it is evaluated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import assert_never

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from optics.geometry.vector_shape import Disk, FiniteShape, HalfPlane, Polygon
from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import one_blas_thread
from optics.numerics.quadrature import gauss
from optics.targets.target_shapes import Target
from optics.waves.diffraction import Grid

Transfer = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function that returns the complex transfer function H at N frequencies fx, fy, (N,) each, cycles/m.

The value at a frequency must not depend on the others.
"""

_SAMPLES = 16
"""Knots of an edge profile per 1/cut-off: the quintic spline through them is accurate to 1e-9."""

_NODES = 16
"""Number of Gauss-Legendre nodes per interval, in which the phase of an edge profile's integrand changes by one cycle.

A transfer function may add two more cycles: the rule's error on three cycles is below 1e-12.
"""

_LEAST_PANELS = 32
"""Smallest number of intervals into which an edge profile's integral over frequency is divided.

A transfer function may be only piecewise smooth.
"""

LEAST_GUARD = 64.0
"""Default distance between the window and the periodic copies of the target, in units of 1/cut-off."""

_FACTORS = (1.0, 4.0, 16.0, 64.0)
"""Ratios of the periods of the Fourier series that are summed for successively lower frequencies."""

_WIDTH = 1.5
"""Width of a low pass in frequency, times the distance of the target's periodic copies.

The low pass's kernel has then fallen to 1e-9 of its peak at that distance.
"""

_WIDTHS = 7.0
"""Frequency, in widths of a low pass, at which it counts as 0: it is 5e-11."""

_BLOCK = 1 << 17
"""Number of frequencies processed in one block, to bound memory."""


@dataclass(frozen=True, eq=False)
class EdgeProfile:
    """Image of a half-plane as a function of the distance from its edge.

    Attributes
    ----------
    normal : (2,) ndarray
        Unit normal of the half-plane.
    extent : float
        Largest distance from the edge, metres.
    level : float
        Irradiance far inside the bright side: the transfer function at zero frequency.
    spline : BSpline
        Irradiance as a function of distance.
    """

    normal: np.ndarray
    extent: float
    level: float
    spline: BSpline

    @classmethod
    def build(cls, transfer: Transfer, normal: np.ndarray, cutoff: float, extent: float) -> EdgeProfile:
        """Compute the image of an edge by an integral of the transfer function along the edge's normal.

        With H the transfer function, n the normal, f the frequency along it and d the distance from the edge,

        E(d) = H(0)/2 + integral from -inf to inf of H(f n)/(2 pi i f) exp(2 pi i f d) df (principal value). For a real
        image the two halves of the axis make E(d) = H(0)/2 + integral from 0 to the cut-off of Im[H(f n) exp(2 pi i f
        d)]/(pi f) df, whose integrand is finite at f = 0: no singularity is left.

        Parameters
        ----------
        transfer : callable
            Transfer function H.
        normal : (2,) ndarray
            Normal toward the bright side.
        cutoff : float
            Frequency above which H is 0, cycles/m.
        extent : float
            Largest distance from the edge at which the profile is evaluated, metres.
        """
        _check_positive(cutoff=cutoff, extent=extent)
        normal = np.asarray(normal, float) / np.hypot(*normal)
        normal.setflags(write=False)
        sampling = _edge_sampling(cutoff, extent)
        f = sampling.frequency
        transfers = _evaluated(transfer, np.append(f, 0.0) * normal[0], np.append(f, 0.0) * normal[1])
        level = float(transfers[-1].real)
        with one_blas_thread():
            table = (sampling.coarse * (sampling.share * transfers[:-1])) @ sampling.fine
        distance = sampling.distance
        values = 0.5 * level + table.imag.ravel()[: len(distance)]
        return cls(normal, extent, level, make_interp_spline(distance, values, k=5))

    def __call__(self, distance: np.ndarray) -> np.ndarray:
        """Return the irradiance at distances from the edge, metres, positive on the bright side.

        It is 1 far inside where the transfer function is 1 at zero frequency.

        Raises
        ------
        ValueError
            A distance exceeds ``extent``.
        """
        distance = np.asarray(distance, float)
        if distance.size and np.max(np.abs(distance)) > self.extent * (1.0 + 1e-12):
            raise UnphysicalError(
                f"the edge profile extends to {self.extent:.3g} m, but {np.max(np.abs(distance)):.3g} m is requested"
            )
        return np.asarray(self.spline(distance))

    def image(self, edge: HalfPlane, x: Grid, y: Grid) -> np.ndarray:
        """Return the irradiance of an edge with the same normal at R rows and C columns of pixels, (R, C).

        Parameters
        ----------
        edge : HalfPlane
            Half-plane with the profile's normal.
        x : Grid
            Pixel centres of the columns, (C,), metres.
        y : Grid
            Pixel centres of the rows, (R,), metres.

        Raises
        ------
        ValueError
            The edge has another normal, or pixels lie beyond ``extent``.
        """
        if np.max(np.abs(edge.normal - self.normal)) > 1e-12:
            raise ValueError(f"the profile belongs to the normal {self.normal}, the edge has {edge.normal}")
        return self(edge.distance(x.points(), y.points()[:, None]))


@dataclass(frozen=True, eq=False)
class _EdgeSampling:
    """Parts of an edge profile's integral that do not depend on the transfer function.

    Attributes
    ----------
    frequency, share : (N,) ndarray
        N Gauss nodes in frequency f, cycles/m, and their weights divided by pi f.
    distance : (D,) ndarray
        D distances d from the edge at which the profile is computed, metres.
    coarse, fine : (A, N) and (N, B) ndarray
        exp(2 pi i f d) of distances split into A coarse and B fine steps, A B >= D, so that the sum over frequencies
        becomes one matrix product.
    """

    frequency: np.ndarray
    share: np.ndarray
    distance: np.ndarray
    coarse: np.ndarray
    fine: np.ndarray


@lru_cache(maxsize=8)
def _edge_sampling(cutoff: float, extent: float) -> _EdgeSampling:
    """Return frequencies, weights and distances for an edge profile as far as ``extent`` metres from the edge."""
    panels = _LEAST_PANELS + int(np.ceil(cutoff * extent))
    node, weight = gauss(_NODES)
    f = (cutoff / panels * (np.arange(panels)[:, None] + 0.5 * (node + 1.0))).ravel()
    share = np.tile(0.5 * cutoff / panels * weight, panels) / (np.pi * f)
    count = int(np.ceil(2.0 * extent * cutoff * _SAMPLES)) + 7
    fine = int(np.ceil(np.sqrt(count)))
    step = 2.0 * extent / (count - 7)
    start = -extent - 3.0 * step
    coarse = np.exp(2j * np.pi * (start + step * fine * np.arange(-(-count // fine)))[:, None] * f)
    steps = np.exp(2j * np.pi * f[:, None] * (step * np.arange(fine)))
    return _EdgeSampling(f, share, start + step * np.arange(count), coarse, steps)


def target_image(
    target: Target, transfer: Transfer, cutoff: float, x: Grid, y: Grid, guard: float | None = None
) -> np.ndarray:
    """Return the irradiance of a target at pixel centres.

    Half-planes are integrated along their normals (``EdgeProfile``), with no other approximation than rounding and a
    spline (1e-8). Finite shapes become a Fourier series whose period is the window plus a guard, so that the copies of
    the target are the guard away. A copy's tail falls only with the third power of the distance, because a diffraction
    MTF has a cusp at f = 0. Successively lower frequencies, which carry the cusp, are therefore summed with
    successively longer periods (4, 16 and 64 times), through a smooth partition of H. For a clear circular pupil the
    default guard then leaves an error below 1e-6 of full brightness: 4e-7 for a disk as wide as a window of 64 pixels,
    where one period alone would leave 5e-4. The sum over frequencies runs separately along x and y straight to the
    pixels, where aliases coincide (as in ``optics.waves.diffraction``), so that coarse pixels need no fine grid. The
    cost is proportional to the square of period times cut-off, so keep shapes near the window.

    Parameters
    ----------
    target : Target
        Target in the image plane.
    transfer : callable
        Transfer function H; called with arrays (N,) of N frequencies inside the cut-off.
    cutoff : float
        Frequency above which H is 0, cycles/m.
    x : Grid
        Pixel centres of the C columns, metres.
    y : Grid
        Pixel centres of the R rows, metres.
    guard : float, optional
        Length added to the window's sides to make the period, metres; by default every copy of a shape is at least
        64/cutoff away from the window.

    Returns
    -------
    (R, C) ndarray
        Irradiance; where H(0) = 1, a wide bright area is 1.

    Raises
    ------
    ValueError
        A shape is nearer than half of the guard to the copies of the window, or an argument is invalid.
    """
    _check_positive(cutoff=cutoff, column_step=x.step, row_step=y.step)
    level = float(_evaluated(transfer, np.zeros(1), np.zeros(1))[0].real)
    out = np.full((y.count, x.count), target.background * level)
    finite: list[tuple[float, FiniteShape]] = []
    for share, shape in target.parts:
        match shape:
            case HalfPlane():
                extent = float(np.max(np.abs(shape.distance(x.points()[[0, -1]], y.points()[[0, -1], None]))))
                profile = EdgeProfile.build(transfer, shape.normal, cutoff, max(extent, 1.0 / cutoff))
                out += share * profile.image(shape, x, y)
            case Polygon() | Disk():
                finite.append((share, shape))
            case _:
                assert_never(shape)
    if finite:
        out += _finite_image(finite, transfer, cutoff, x, y, guard)
    return out


def _finite_image(
    parts: list[tuple[float, FiniteShape]], transfer: Transfer, cutoff: float, x: Grid, y: Grid, guard: float | None
) -> np.ndarray:
    """Return the irradiance of finite shapes at R rows and C columns of pixels, (R, C).

    It is a sum of Fourier series of increasing periods.
    """
    overhang = _overhang(parts, x, y)
    if guard is None:
        guard = overhang + max(LEAST_GUARD / cutoff, overhang)
    _check_positive(guard=guard)
    if overhang > 0.5 * guard:
        raise UnphysicalError(
            f"a shape extends {overhang:.3g} m beyond the window and does not fit into its period; with a guard of"
            f" {guard:.3g} m it may extend {0.5 * guard:.3g} m: enlarge the guard or the window"
        )
    window = np.array([x.step * (x.count - 1), y.step * (y.count - 1)])
    periods = [factor * (window + guard) for factor in _FACTORS]
    distances = [float(np.min(period - window)) - overhang for period in periods]
    # a low-pass kernel must have died out at the distance of the copies of the series that it is taken from
    widths = [np.inf, *(_WIDTH / distance for distance in distances[:-1]), 0.0]
    out = np.zeros((y.count, x.count))
    with one_blas_thread():
        for period, width, next_width in zip(periods, widths[:-1], widths[1:], strict=True):
            band = _Band(transfer, width, next_width)
            out += _series(parts, band, min(cutoff, _WIDTHS * width), x, y, period)
    return out


@dataclass(frozen=True)
class _Band:
    """Transfer function limited to a band of frequencies: multiplied by the difference of two smooth low passes."""

    transfer: Transfer
    width: float
    next_width: float

    def __call__(self, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        square = fx * fx + fy * fy
        return _evaluated(self.transfer, fx, fy) * (_low_pass(square, self.width) - _low_pass(square, self.next_width))


def _low_pass(square: np.ndarray, width: float) -> np.ndarray:
    """Return 1 - (1 - g)^2 with a Gaussian g of the frequency, of the given width (cycles/m).

    It departs from 1 with the fourth power of the frequency; ``square`` is the square of the frequency.
    """
    return np.asarray(1.0 - np.expm1(-0.5 * square / width**2) ** 2) if width > 0.0 else np.zeros_like(square)


def _series(
    parts: list[tuple[float, FiniteShape]], transfer: Transfer, cutoff: float, x: Grid, y: Grid, periods: np.ndarray
) -> np.ndarray:
    """Return the Fourier series of some shapes at the centres of R rows and C columns of pixels, (R, C).

    ``periods`` are its periods along x and y, metres; it has all terms inside the cut-off.
    """
    fx = np.arange(int(cutoff * periods[0]) + 1) / periods[0]
    last = int(cutoff * periods[1])
    fy = np.arange(-last, last + 1) / periods[1]
    columns = np.exp(2j * np.pi * fx[:, None] * x.points())
    columns[1:] *= 2.0  # terms of -fx are the conjugates of those of fx
    half = np.empty((len(fy), x.count), complex)
    rows = max(1, _BLOCK // len(fx))
    for begin in range(0, len(fy), rows):
        v = fy[begin : begin + rows, None]
        # the disk's chord at the row nearest to fy = 0
        u = fx[fx <= np.sqrt(max(cutoff**2 - float(np.min(np.abs(v))) ** 2, 0.0))]
        terms = np.zeros((len(v), len(u)), complex)
        for share, shape in parts:
            terms += share * shape.spectrum(u, v)
        inside = u * u + v * v <= cutoff**2
        index = np.nonzero(inside)
        terms[inside] *= transfer(u[index[1]], v[index[0], 0])
        terms[~inside] = 0.0
        half[begin : begin + rows] = terms @ columns[: len(u)]
    image = np.exp(2j * np.pi * y.points()[:, None] * fy) @ half
    return np.asarray(image.real) / float(np.prod(periods))


def _overhang(parts: list[tuple[float, FiniteShape]], x: Grid, y: Grid) -> float:
    """Return the largest distance of a shape's bounds beyond the window of pixel centres, metres.

    It is 0 if all lie inside.
    """
    x0, x1, y0, y1 = np.array([shape.bounds for _, shape in parts]).T
    (left, right), (low, high) = x.points()[[0, -1]], y.points()[[0, -1]]
    beyond = (left - np.min(x0), np.max(x1) - right, low - np.min(y0), np.max(y1) - high)
    return max(0.0, *(float(distance) for distance in beyond))


def _evaluated(transfer: Transfer, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
    """Return the transfer function at N frequencies (N,), after checking its shape and finiteness."""
    value = np.asarray(transfer(fx, fy))
    if value.shape != fx.shape or not np.all(np.isfinite(value)):
        raise ValueError(f"the transfer function must give one finite number per frequency, found shape {value.shape}")
    return value


def _check_positive(**values: float) -> None:
    """Raise ValueError if a named value is not positive and finite."""
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0.0):
            raise ValueError(f"the {name.replace('_', ' ')} must be positive, found {value}")
