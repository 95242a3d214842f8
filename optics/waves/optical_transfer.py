"""Optical transfer function of a smooth pupil: its autocorrelation over the true region of overlap.

With the field U on the detector (``optics.waves.diffraction``) the irradiance I = |U|^2 has the transform, at a
frequency f in cycles/m,

    I~(f) = integral I(x) exp(-2 pi i f.x) dx = integral g(w) conj(g(w - lambda f)) dw, g(w) = a(w) exp(ik (L(w) + dz
    sqrt(1 - |w|^2))),    w = (u, v),

for a detector moved downstream by dz (Hopkins, Proc. R. Soc. A 231, 91 (1955), without his paraxial phase), with a the
amplitude, L the eikonal and (u, v) the direction cosines. The integral runs over the overlap of the pupil with itself
shifted by lambda f, whose edge is followed exactly, by Gauss' rules: no sampled pupil with a jagged edge, exactly zero
beyond the cut-off, and an error that falls exponentially with the number of nodes. The shadows of bodies in the overlap
(``optics.waves.pupil_shadow``) are integrated separately.

``VariedTransfer`` gives the MTF of thousands of wavefronts that vary a little about a known one. The nodes of the
overlap's quadrature and the known pupil's values there are computed once; a varied wavefront then costs a matrix
product and a sum of phasors. The edge and the amplitude are the known pupil's: small motions change them in second
order of their effect on the wavefront.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import map_coordinates, spline_filter

from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import cores, one_blas_thread
from optics.numerics.quadrature import gauss, nodes_for
from optics.waves.pupil_stack import PupilFunction
from optics.waves.pupil_terms import products

Part = Literal["all", "clear", "shadow"]

_BLOCK = 2**17
"""Number of phases (shifts x defocus x nodes) or frequencies per block: some arrays of 1 MB that stay in the cache."""

_BLOCK_NODES = 2**14
"""Number of nodes (over several shifts) per block in which polynomials are evaluated, to stay in the cache."""

_PROBE_ANGLE = np.linspace(0.0, np.pi, 7)
_PROBE = np.cos(_PROBE_ANGLE)
"""Positions at which the phase over the overlap is probed in both parameters.

They are evenly spaced in the angle ``_PROBE_ANGLE``, as Gauss nodes nearly are.
"""
_PROBED = _BLOCK_NODES // len(_PROBE) ** 2


def transfer(pupil: PupilFunction, frequency: np.ndarray, wavelength: float, defocus: np.ndarray) -> np.ndarray:
    """Return the optical transfer function at one wavelength, for M frequencies and Z positions of the detector.

    Parameters
    ----------
    pupil : PupilFunction
        Pupil of the image.
    frequency : (M, 2) ndarray
        Spatial frequencies along the detector's x and y, cycles/m.
    wavelength : float
        Wavelength, metres.
    defocus : (Z,) ndarray
        Shifts of the detector along its normal, metres, positive downstream.

    Returns
    -------
    (Z, M) ndarray
        Complex transform of the irradiance with kernel exp(-2 pi i f.x), 1 at f = 0, 0 beyond the cut-off. An image
        centred at x0 has the phase -2 pi f.x0.

    Raises
    ------
    ValueError
        Shapes other than these, or numbers that are not finite.
    """
    return polychromatic_transfer(pupil, frequency, np.array([wavelength]), np.ones(1), defocus)


def polychromatic_transfer(
    pupil: PupilFunction | Sequence[PupilFunction],
    frequency: np.ndarray,
    wavelengths: np.ndarray,
    weights: np.ndarray,
    defocus: np.ndarray,
) -> np.ndarray:
    """Return the optical transfer function of a band: the weighted mean of ``transfer`` over K wavelengths.

    Parameters
    ----------
    pupil : PupilFunction or sequence of PupilFunction
        Pupil of the image, the same at all wavelengths; or one for each of them, all about one point of the image, so
        that lateral colour blurs the image.
    frequency : (M, 2) ndarray
        M spatial frequencies along the detector's x and y, cycles/m.
    wavelengths : (K,) ndarray
        Wavelengths, metres.
    weights : (K,) ndarray
        Fraction of the signal (power x response) at each wavelength; they need not sum to 1.
    defocus : (Z,) ndarray
        Z shifts of the detector along its normal, metres, positive downstream.

    Returns
    -------
    (Z, M) ndarray
        Complex transfer function.

    Raises
    ------
    ValueError
        Other shapes, numbers that are not finite, weights that are negative or all zero, wavelengths that are not
        positive, or different numbers of pupils and wavelengths.
    UnphysicalError
        The image is so blurred that more than ``MOST_NODES`` would be needed.
    """
    frequency, defocus = np.asarray(frequency, float), np.asarray(defocus, float)
    if frequency.ndim != 2 or frequency.shape[1] != 2 or defocus.ndim != 1:
        raise ValueError(f"frequency (M, 2) and defocus (Z,) expected, got {frequency.shape} and {defocus.shape}")
    if not np.all(np.isfinite(frequency)) or not np.all(np.isfinite(defocus)):
        raise ValueError("frequency and defocus must be finite")
    wavelengths, share = _band(wavelengths, weights)
    if not isinstance(pupil, PupilFunction):
        transfers = [
            transfer(part, frequency, float(wavelength), defocus)
            for part, wavelength in zip(pupil, wavelengths, strict=True)
        ]
        return np.asarray(np.einsum("k,kzm->zm", share, transfers))
    shift = wavelengths[:, None] * pupil.normalised(frequency[:, 0], frequency[:, 1])
    repeated = np.repeat(wavelengths, len(frequency))
    parts = _correlate(pupil, shift.ravel(), repeated, defocus).reshape(*shift.shape, len(defocus))
    return np.asarray(np.einsum("k,kmz->zm", share, parts))


def _band(wavelengths: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the wavelengths (metres) after checks, and the weights divided by their sum."""
    wavelengths, weights = np.asarray(wavelengths, float), np.asarray(weights, float)
    if wavelengths.ndim != 1 or wavelengths.shape != weights.shape:
        raise ValueError(f"one weight for each wavelength expected, got {weights.shape} for {wavelengths.shape}")
    if not np.all(wavelengths > 0.0) or not np.all(weights >= 0.0) or not np.sum(weights) > 0.0:
        raise ValueError("wavelengths must be positive, weights not negative and not all zero")
    return wavelengths, weights / np.sum(weights)


LEAST_ALONG = 8
"""Number of nodes along a chord of the overlap for a constant phase; it is small, as the amplitude is even."""

MOST_NODES = 2**20
"""Largest number of nodes for one frequency.

An image that needs more is so blurred that its MTF is of no interest: its phase changes by hundreds of waves, and a
merit of a few such frequencies would take a quarter of an hour.
"""

LEAST_ACROSS = 13
"""Number of nodes across the chords of the overlap for a constant phase.

The chords' length varies across them like half a period of a sine.
"""


def _correlate(
    pupil: PupilFunction, shift: np.ndarray, wavelength: np.ndarray, defocus: np.ndarray, part: Part = "all"
) -> np.ndarray:
    """Return the transfer function at S normalised shifts for Z positions of the detector, (S, Z).

    ``shift`` and ``wavelength`` (metres) have the shape (S,), ``defocus`` (metres) has (Z,). ``part`` may be "clear"
    for the transfer function of the clear pupil, or "shadow" for the shadow's contribution; both are normalised to the
    whole.
    """
    if part not in get_args(Part):
        raise ValueError(f"a transfer function has no part {part!r}; there are {', '.join(get_args(Part))}")
    out = np.zeros((len(shift), len(defocus)), complex)
    if not len(shift) or not len(defocus):
        return out
    wave = 2.0 * np.pi / wavelength
    scale = abs(np.linalg.det(pupil.axes)) / pupil.power

    def piece(rows: np.ndarray, across: int, along: int) -> None:
        s, k = shift[rows], wave[rows]
        quadratures = []
        if part != "shadow":
            rules = gauss(across + 3 * pupil.finer // 2), gauss(along + pupil.finer)
            quadratures.append(pupil.edge.overlap(s, right[:, rows], left[:, rows], *rules))
        if pupil.shadow is not None and part != "clear":
            nodes = pupil.shadow.least_nodes + max(across - LEAST_ACROSS, along - LEAST_ALONG) + pupil.finer // 8
            taken, area = pupil.shadow.overlap(s[None], nodes)
            quadratures.append((taken[0], area[0]))
        points, weight = (np.concatenate(arrays, axis=1) for arrays in zip(*quadratures, strict=True))
        light, path, focus = _products(pupil, points, s)
        light *= weight
        phase = k[:, None, None] * (path[:, None] + defocus[:, None] * focus[:, None])
        real, imaginary = (np.einsum("szn,sn->sz", part(phase), light) for part in (np.cos, np.sin))
        out[rows] = scale * (real + 1j * imaginary)

    with one_blas_thread(), ThreadPoolExecutor(cores()) as pool:
        right, left, inside = pupil.edge.corners(shift)
        used = np.flatnonzero(inside)
        blocks = [used[i : i + _PROBED] for i in range(0, len(used), _PROBED)]
        parts = pool.map(lambda w: _spans(pupil, shift[w], right[:, w], left[:, w], wave[w], defocus), blocks)
        spans = np.concatenate([np.zeros((2, 0)), *parts], axis=1)
        list(pool.map(lambda args: piece(*args), _blocks(used, spans[0], spans[1], len(defocus))))
    return out


def _products(pupil: PupilFunction, points: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return products of amplitude, and differences of eikonal and normal cosine, of two shifted copies of a pupil.

    A point c of their overlap is, in the pupil's own coordinates, c + s/2 in one copy and c - s/2 in the other, with s
    its shift. ``points`` (S, Q) are Q complex points c for each of S complex shifts ``shift`` (S,); each result is (S,
    Q), the eikonal in metres, the normal cosine dimensionless.
    """
    ahead, behind = points + 0.5 * shift[:, None], points - 0.5 * shift[:, None]
    (path, light), (path_behind, light_behind) = pupil.values(ahead), pupil.values(behind)
    return light * light_behind, path - path_behind, pupil.cosines(ahead)[2] - pupil.cosines(behind)[2]


def _spans(
    pupil: PupilFunction, shift: np.ndarray, right: np.ndarray, left: np.ndarray, wave: np.ndarray, defocus: np.ndarray
) -> np.ndarray:
    """Return how fast the integrand's phase changes across and along the chords of S overlaps, (2, S).

    It is the largest change for any defocus, in radians of phase per radian of the angle a in which Gauss nodes cos(a)
    are evenly spaced. For a phase that is linear along a chord, it is half of the phase's range.

    Parameters
    ----------
    pupil : PupilFunction
        Pupil of the image.
    shift : (S,) ndarray
        Complex shifts of the pupil against itself, in its normalised coordinates.
    right, left : (2, S) ndarray
        Angles of the overlap's corners on the edges of the two copies, from ``PupilEdge.corners``.
    wave : (S,) ndarray
        Wave numbers, rad/m.
    defocus : ndarray
        Shifts of the detector, metres.
    """
    probe = (_PROBE, np.ones_like(_PROBE))
    points, _ = pupil.edge.overlap(shift, right, left, probe, probe)
    _, path, focus = _products(pupil, points, shift)
    out = np.zeros((2, len(shift)))
    for dz in (np.min(defocus), np.max(defocus)):
        phase = (wave[:, None] * (path + dz * focus)).reshape(-1, len(_PROBE), len(_PROBE))
        for axis, span in enumerate(out, 1):
            steps = np.max(np.abs(np.diff(phase, axis=axis)), axis=(1, 2))
            np.maximum(span, steps / _PROBE_ANGLE[1], out=span)
    return out


def _blocks(
    used: np.ndarray, across: np.ndarray, along: np.ndarray, layers: int
) -> Iterator[tuple[np.ndarray, int, int]]:
    """Yield groups of shifts that need similar numbers of quadrature nodes, and these numbers across and along chords.

    A group is limited by memory. ``used`` are the indices of the shifts, ``across`` and ``along`` the changes of phase
    of each (``_spans``), and ``layers`` is the number of positions of the detector.
    """
    order = np.argsort(along)[::-1]
    start = 0
    while start < len(order):
        # the first of a block has the longest span along the chords; across them, the longest of the block counts
        count = nodes_for(float(along[order[start]]), LEAST_ALONG)
        room = min(_BLOCK_NODES, _BLOCK // layers) // count
        candidates = order[start : start + max(1, room // LEAST_ACROSS)]
        rows = nodes_for(float(np.max(across[candidates])), LEAST_ACROSS)
        if rows * count > MOST_NODES:
            raise UnphysicalError(
                f"a transfer function needs {rows * count:.2g} nodes at a frequency (at most {MOST_NODES:.2g}): the "
                "image is blurred by hundreds of waves"
            )
        chosen = candidates[: max(1, room // rows)]
        yield used[chosen], rows, count
        start += len(chosen)


FINER = (4, 8, 16, 32, 64)
"""Numbers of additional nodes along each direction that are tried in turn until a transfer function converges."""

CONVERGED = 2e-4
"""Largest change of a transfer function due to additional nodes with which there are enough nodes."""

WORST_TRANSFER = 1e-3
"""Largest allowed change of a transfer function due to additional nodes; beyond it an error is raised."""

_TEST_FREQUENCIES = np.array([[x, 0.0] for x in (0.12, 0.3, 0.55, 0.8)] + [[0.0, y] for y in (0.2, 0.4, 0.6, 0.9)])
"""Frequencies at which results with different numbers of nodes are compared, relative to the cut-off along each axis.
"""


def with_enough_nodes(pupil: PupilFunction, wavelength: float) -> PupilFunction:
    """Return a pupil with a shadow, with the number of additional nodes that its transfer function needs.

    The illuminated part of a wavefront may be smooth where its continuation into the dark is not, and the clear pupil
    is integrated over both. Nodes are added until that changes nothing.

    Parameters
    ----------
    pupil : PupilFunction
        Pupil of an image.
    wavelength : float
        Wavelength, metres.

    Returns
    -------
    PupilFunction
        The pupil with ``finer`` and ``transfer_error``, the change from fewer nodes.

    Raises
    ------
    UnphysicalError
        The largest number of nodes is too small.
    """
    if pupil.shadow is None:
        return pupil
    frequency = _TEST_FREQUENCIES * pupil.cutoff(np.eye(2), wavelength)
    shift = wavelength * pupil.normalised(frequency[:, 0], frequency[:, 1])

    def values(candidate: PupilFunction, shift: np.ndarray, part: Part) -> np.ndarray:
        return _correlate(candidate, shift, np.full(len(shift), wavelength), np.zeros(1), part)

    before, error = values(pupil, shift, "clear"), np.inf
    for finer in FINER:
        candidate = replace(pupil, finer=finer)
        values_now = values(candidate, shift, "clear")
        error, before = float(np.max(np.abs(values_now - before))), values_now
        if error < CONVERGED:
            # shadows are small and many: fewer frequencies suffice
            few = shift[1::4]
            change = values(replace(candidate, finer=2 * finer), few, "shadow") - values(candidate, few, "shadow")
            error += float(np.max(np.abs(change)))
            break
    if not error < WORST_TRANSFER:
        raise UnphysicalError(
            f"the transfer function of a vignetted pupil still changes by {error:.2g} with more nodes (at most "
            f"{WORST_TRANSFER:g}): its wavefront is too steep where it is extrapolated into the dark"
        )
    return replace(candidate, transfer_error=error)


TABLE_TAIL = 1e-6
"""Largest accepted coefficient in the last quarter of the series of a tabulated transfer function.

The transfer function is 1 at zero frequency.
"""

_DENSE = (1536, 512)
"""Number of cells of the spline of a tabulated transfer function from zero to the cut-off, and around the circle."""

_PAD = 12
"""Number of cells by which the spline is extended beyond its edges.

The effect of an edge on a cubic spline falls by a factor of 0.27 per cell.
"""

_MOST_NODES = 400
"""Largest number of frequencies along the radius at which a tabulated transfer function is computed."""

_SHADOW_GRID = (48, 64)
"""Number of steps from zero to the cut-off, and over half the circle, for a shadow's contribution to a table.

Corners of one shadow that meet the sides of another cause kinks, which no series follows well; cubic splines are
accurate to 1e-4.
"""


@dataclass(frozen=True, eq=False)
class TransferTable:
    """Polychromatic transfer function at one focus, interpolated: for images with 1e5 frequencies and more.

    The transfer function is computed on a polar grid of shifts in the normalised pupil, for each wavelength: equal
    angles, and Chebyshev nodes in the arc cosine of shift / cut-off. In this angle it is smooth up to the cut-off,
    where it ends like the power 3/2 of the distance. The phase of the image's centroid is kept separate. The mean over
    the band is then a cubic spline, fine enough for the cut-offs of the single wavelengths inside: accurate to 1e-5.

    Attributes
    ----------
    centroid : (2,) ndarray
        Centroid (x, y) of the image from its origin, metres; its phase multiplies the spline.
    to_shift : (2, 2) ndarray
        Matrix from cycles/m to normalised shifts at the shortest wavelength.
    extent : ndarray
        Complex coefficients of a polynomial in exp(2 i direction), whose real part is the longest shift with an overlap
        (the cut-off) in that direction, in normalised pupil coordinates.
    spline : ndarray
        Spline coefficients over shift / longest shift and direction, complex.
    """

    centroid: np.ndarray
    to_shift: np.ndarray
    extent: np.ndarray
    spline: np.ndarray

    @classmethod
    def build(
        cls, pupil: PupilFunction, wavelengths: np.ndarray, weights: np.ndarray, defocus: float = 0.0
    ) -> TransferTable:
        """Build the table of the polychromatic transfer function of one image at one focus.

        Parameters
        ----------
        pupil : PupilFunction
            Pupil of the image.
        wavelengths : (K,) ndarray
            K wavelengths, metres.
        weights : (K,) ndarray
            Fraction of the signal at each wavelength.
        defocus : float
            Shift of the detector along its normal, metres, positive downstream.

        Raises
        ------
        ValueError
            A number is not finite or not positive, weights are negative or all zero, or the wavefront has so many waves
            that the table would become too large.
        """
        wavelengths, share = _band(wavelengths, weights)
        wavelengths, share = wavelengths[share > 0.0], share[share > 0.0]
        centroid = _centroid(pupil, float(np.mean(wavelengths)), defocus)
        rings, arms = 24, 16
        while True:
            # the shortest wavelength has the largest phases
            series = np.abs(_polar_terms(pupil, np.min(wavelengths, keepdims=True), defocus, centroid, rings, arms)[0])
            radial = np.max(series[3 * rings // 4 :])
            around = np.max(series[:, np.abs(np.fft.fftfreq(2 * arms)) > 3 / 8])
            if radial < TABLE_TAIL and around < TABLE_TAIL:
                break
            rings = rings if radial < TABLE_TAIL else 4 * rings // 3
            arms = arms if around < TABLE_TAIL else 4 * arms // 3
            if max(rings, arms) > _MOST_NODES:
                raise UnphysicalError("the wavefront has too many waves for a table of its transfer function")
        terms = _polar_terms(pupil, wavelengths, defocus, centroid, rings, arms)
        cells, directions = _DENSE
        radius = np.arange(-_PAD, cells + _PAD) / cells
        around_dense = np.zeros((len(radius), directions), complex)
        order = np.rint(np.fft.fftfreq(2 * arms) * 2 * arms).astype(int)
        used = np.abs(order) < min(arms, directions // 2)
        for wavelength, part, series in zip(wavelengths, share, terms, strict=True):
            ratio = radius * (wavelength / np.min(wavelengths))
            rows = ratio < 1.0
            node = np.arccos(ratio[rows]) * (4.0 / np.pi) - 1.0
            values = np.polynomial.chebyshev.chebvander(node, rings - 1) @ series[:, used]
            around_dense[np.ix_(rows, order[used] % directions)] += part * values
        dense = np.fft.ifft(around_dense, axis=-1) * directions
        if pupil.shadow is not None:
            dense += _shadow_table(pupil, wavelengths, share, defocus, centroid, radius, directions)
        padded = np.pad(dense, ((0, 0), (_PAD, _PAD)), mode="wrap")
        coefficients = spline_filter(padded.real) + 1j * spline_filter(padded.imag)
        direction = np.pi * np.arange(64) / 64
        extent = np.fft.fft(pupil.edge.extent(direction)[0])[:9] / 64
        extent[1:] *= 2.0
        return cls(centroid, np.min(wavelengths) * np.linalg.inv(pupil.axes), extent, coefficients)

    def __call__(self, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        """Return the complex transfer function at frequencies (cycles/m) of any shapes that broadcast."""
        fx, fy = np.broadcast_arrays(np.asarray(fx, float), np.asarray(fy, float))
        out = np.empty(fx.size, complex)

        def piece(part: slice) -> None:
            out[part] = self._values(fx.ravel()[part], fy.ravel()[part])

        with ThreadPoolExecutor(cores()) as pool:
            list(pool.map(piece, (slice(i, i + _BLOCK) for i in range(0, out.size, _BLOCK))))
        return out.reshape(fx.shape)

    def _values(self, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        """Return the complex transfer function at N frequencies (N,), cycles/m."""
        (a, b), (c, d) = self.to_shift
        x, y = a * fx + b * fy, c * fx + d * fy
        size = np.hypot(x, y)
        twice = (x + 1j * y) ** 2 / np.where(size == 0.0, 1.0, size) ** 2
        radius = size / np.polynomial.polynomial.polyval(twice, self.extent).real
        out = np.zeros(len(fx), complex)
        inside = np.flatnonzero(radius < 1.0)
        angle = np.arctan2(y[inside], x[inside]) % (2.0 * np.pi)
        coordinates = np.stack([radius[inside] * _DENSE[0], angle * (_DENSE[1] / (2.0 * np.pi))]) + _PAD
        real, imaginary = (
            map_coordinates(part, coordinates, order=3, prefilter=False)
            for part in (self.spline.real, self.spline.imag)
        )
        phasor = np.exp(-2j * np.pi * (fx[inside] * self.centroid[0] + fy[inside] * self.centroid[1]))
        out[inside] = (real + 1j * imaginary) * phasor
        return out


def _centroid(pupil: PupilFunction, wavelength: float, defocus: float) -> np.ndarray:
    """Return the centroid (x, y) of the image from the phase at 1e-4 of the cut-off, in metres."""
    axes = np.eye(2)
    frequency = 1e-4 * pupil.cutoff(axes, wavelength)
    phase = np.angle(transfer(pupil, frequency[:, None] * axes, wavelength, np.array([defocus]))[0])
    return np.asarray(-phase / (2.0 * np.pi * frequency))


def _polar_terms(
    pupil: PupilFunction, wavelengths: np.ndarray, defocus: float, centroid: np.ndarray, rings: int, arms: int
) -> np.ndarray:
    """Return Chebyshev and Fourier coefficients of the transfer function at K wavelengths, about the image's centroid.

    The result is complex, (K, rings, 2 arms). Chebyshev polynomials are of the arc cosine of (frequency / cut-off),
    Fourier terms of the frequency's direction, in the order of ``np.fft.fft``. ``rings`` and ``arms`` are the numbers
    of frequencies along the radius and of directions over half the circle, ``centroid`` (2,) is in metres, and
    ``defocus`` is a shift of the detector, metres.
    """
    node = np.cos(np.pi * (np.arange(rings) + 0.5) / rings)
    direction = np.pi * np.arange(arms) / arms
    ratio = np.cos(0.25 * np.pi * (node + 1.0))
    shift = ratio[:, None] * pupil.edge.extent(direction)[0] * np.exp(1j * direction)
    values = _about(pupil, shift, wavelengths, defocus, centroid, "clear")
    circle = np.concatenate([values, np.conj(values)], axis=-1)
    transform = np.polynomial.chebyshev.chebvander(node, rings - 1).T * (2.0 / rings)
    transform[0] *= 0.5
    return np.asarray(transform @ np.fft.fft(circle, axis=-1)) / (2 * arms)


def _about(
    pupil: PupilFunction, shift: np.ndarray, wavelengths: np.ndarray, defocus: float, centroid: np.ndarray, part: Part
) -> np.ndarray:
    """Return the transfer function at K wavelengths and normalised shifts of any shape, (K, *shape).

    The phase due to the position of the image's centroid is removed; ``part`` selects the clear pupil or the shadow.
    """
    repeated = np.repeat(wavelengths, shift.size)
    values = _correlate(pupil, np.tile(shift.ravel(), len(wavelengths)), repeated, np.array([defocus]), part)
    phase_path = (pupil.axes.T @ centroid) @ np.stack([shift.real, shift.imag]).reshape(2, -1)
    values = values.reshape(len(wavelengths), -1) * np.exp(2j * np.pi * phase_path / wavelengths[:, None])
    return values.reshape(len(wavelengths), *shift.shape)


def _shadow_table(
    pupil: PupilFunction,
    wavelengths: np.ndarray,
    share: np.ndarray,
    defocus: float,
    centroid: np.ndarray,
    radius: np.ndarray,
    directions: int,
) -> np.ndarray:
    """Return the shadow's contribution to the band's transfer function on a polar grid, complex, (R, directions).

    Parameters
    ----------
    pupil : PupilFunction
        Pupil with a shadow.
    wavelengths : (K,) ndarray
        K wavelengths, metres.
    share : (K,) ndarray
        Weights of the wavelengths, with sum 1.
    defocus : float
        Shift of the detector, metres.
    centroid : (2,) ndarray
        Centroid of the image, metres, whose phase is removed.
    radius : (R,) ndarray
        R frequencies, relative to the cut-off of the shortest wavelength in the same direction.
    directions : int
        Number of directions, evenly spaced over the circle.
    """
    rings, arms = _SHADOW_GRID
    direction = np.pi * np.arange(arms) / arms
    ratio = np.arange(rings) / rings
    shift = ratio[:, None] * pupil.edge.extent(direction)[0] * np.exp(1j * direction)
    half = _about(pupil, shift, wavelengths, defocus, centroid, "shadow")
    circle = np.concatenate([half, np.conj(half)], axis=-1)
    # zero beyond the cut-off; at zero frequency is a cusp, at which the spline starts as the series do
    around = np.pad(np.pad(circle, ((0, 0), (0, _PAD), (0, 0))), ((0, 0), (0, 0), (_PAD, _PAD)), mode="wrap")
    angle = np.pi * np.arange(-_PAD, 2 * arms + _PAD) / arms
    wanted = 2.0 * np.pi * np.arange(directions) / directions
    knots = np.arange(rings + _PAD) / rings
    out = np.zeros((len(radius), directions), complex)
    for wavelength, part, values in zip(wavelengths, share, around, strict=True):
        scaled_ratio = radius * (wavelength / np.min(wavelengths))
        rows = scaled_ratio < 1.0
        out[rows] += part * make_interp_spline(knots, make_interp_spline(angle, values, axis=1)(wanted))(
            scaled_ratio[rows]
        )
    return out


ACROSS, ALONG, IN_SHADOW = 24, 18, 12
"""Numbers of nodes of ``VariedTransfer`` across and along the chords of an overlap, and on each side of a shadow's box.

With one wave of wavefront error at the edge of the pupil the MTF is then accurate to 1e-6.
"""


@dataclass(frozen=True, eq=False)
class _WavelengthTerms:
    """Quantities at one wavelength from which a varied transfer function is computed.

    Attributes
    ----------
    phasors : (Q,) ndarray
        Complex phasors of the known pupil at the Q nodes of the overlap, times their weights; their sum is its transfer
        function times the fraction of the light at this wavelength.
    phase_matrix : (Q, N) ndarray
        Matrix from optical paths at the N traced nodes of the stop to phase changes at the nodes of the overlap, by
        polynomials over the pupil, radians per metre.
    paths : slice
        Paths of this wavelength among those of all traced wavelengths.
    """

    phasors: np.ndarray
    phase_matrix: np.ndarray
    paths: slice


@dataclass(frozen=True, eq=False)
class VariedTransfer:
    """Optical transfer function of one image at one frequency, at one wavelength or several, for varying wavefronts.

    The optical paths are those of N rays at K traced wavelengths, one wavelength after the other, (..., K N), metres;
    mirrors image all wavelengths alike, so that one is traced for all.

    Attributes
    ----------
    colours : tuple of _WavelengthTerms
        Wavelengths below the cut-off.
    """

    colours: tuple[_WavelengthTerms, ...]

    @classmethod
    def of(
        cls,
        pupils: Sequence[PupilFunction],
        frequency: np.ndarray,
        wavelengths: np.ndarray,
        shares: np.ndarray,
        cosines: np.ndarray,
        degree: int,
    ) -> VariedTransfer | None:
        """Compute the parts of the transfer function that are the same for all varied wavefronts.

        Parameters
        ----------
        pupils : sequence of PupilFunction
            Known pupils, all about one point of the image: one for every wavelength, or one for all.
        frequency : (2,) ndarray
            Spatial frequency along the detector's axes, cycles/m.
        wavelengths : (C,) ndarray
            C wavelengths, metres.
        shares : (C,) ndarray
            Fractions of the light at these wavelengths, which sum to 1.
        cosines : (C, N, 2) or (1, N, 2) ndarray
            Direction cosines along these axes of the N rays whose wavefront varies.
        degree : int
            Degree of the polynomials of its variation.

        Returns
        -------
        VariedTransfer or None
            None beyond the cut-off of all wavelengths.
        """
        out, rays = [], cosines.shape[1]
        for k, (wavelength, share) in enumerate(zip(wavelengths, shares, strict=True)):
            pupil = pupils[k if len(pupils) > 1 else 0]
            start = k if len(cosines) > 1 else 0
            terms = _wavelength_terms(pupil, frequency, float(wavelength), cosines[start], degree)
            if terms is not None:
                out.append(_WavelengthTerms(share * terms[0], terms[1], slice(start * rays, (start + 1) * rays)))
        return cls(tuple(out)) if out else None

    @property
    def known(self) -> float:
        """MTF (0 to 1) of the pupil before its wavefront is varied: the one from which the object was computed."""
        return float(abs(sum(np.sum(terms.phasors) for terms in self.colours)))

    def modulation(self, paths: np.ndarray) -> np.ndarray:
        """Return the MTF (0 to 1) at the one frequency of this object for varied optical paths, (...).

        Parameters
        ----------
        paths : (..., K N) ndarray
            Optical paths of N rays at each of K traced wavelengths minus those of the known pupil, metres.
        """
        whole: np.ndarray | int = 0
        for terms in self.colours:
            phase = paths[..., terms.paths] @ terms.phase_matrix.T
            whole = whole + (np.cos(phase) @ terms.phasors + 1j * (np.sin(phase) @ terms.phasors))
        return np.asarray(np.abs(whole))

    def curvature(self, slopes: np.ndarray) -> np.ndarray:
        """Return the second derivatives of the MTF with respect to pairs of L parameters, (L, L), at the known pupil.

        Parameters
        ----------
        slopes : (L, K N) ndarray
            Derivatives of the optical paths of N rays at K wavelengths with respect to the parameters, metres per unit.
        """
        whole, first, second = 0j, 0j, 0j
        for terms in self.colours:
            phases = slopes[:, terms.paths] @ terms.phase_matrix.T
            whole = whole + np.sum(terms.phasors)
            first = first + 1j * phases @ terms.phasors
            second = second - (phases * terms.phasors) @ phases.T
        size = abs(whole)
        along = np.real(np.conj(whole) * first) / size
        across = np.real(np.outer(np.conj(first), first) + np.conj(whole) * second)
        return np.asarray((across - np.outer(along, along)) / size)


def _wavelength_terms(
    pupil: PupilFunction, frequency: np.ndarray, wavelength: float, cosines: np.ndarray, degree: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the known pupil's phasors and the phase matrix of one wavelength, or None beyond its cut-off.

    The phasors are at the nodes of the overlap of the pupil with its copy shifted by the frequency, times quadrature
    weights; the matrix maps optical paths at the N rays to phase changes at these nodes (see ``_WavelengthTerms``).

    Parameters
    ----------
    pupil : PupilFunction
        Known pupil.
    frequency : (2,) ndarray
        Spatial frequency along the detector's axes, cycles/m.
    wavelength : float
        Wavelength, metres.
    cosines : (N, 2) ndarray
        Direction cosines of the N rays whose wavefront varies.
    degree : int
        Degree of the polynomials of its variation.
    """
    shift = np.atleast_1d(pupil.normalised(*(wavelength * np.asarray(frequency))))
    right, left, inside = pupil.edge.corners(shift)
    if not inside[0]:
        return None
    quadratures = [pupil.edge.overlap(shift, right, left, gauss(ACROSS), gauss(ALONG))]
    if pupil.shadow is not None:
        taken, area = pupil.shadow.overlap(shift[None], IN_SHADOW)
        quadratures.append((taken[0], area[0]))
    points, weight = (np.concatenate(arrays, axis=1)[0] for arrays in zip(*quadratures, strict=True))
    ahead, behind = points + 0.5 * shift, points - 0.5 * shift
    (path, light), (path_behind, light_behind) = pupil.values(ahead), pupil.values(behind)
    wave = 2.0 * np.pi / wavelength
    scale = abs(np.linalg.det(pupil.axes)) / pupil.power
    phasors = scale * weight * light * light_behind * np.exp(1j * wave * (path - path_behind))
    nodes = np.linalg.solve(pupil.axes, (cosines - pupil.centre).T)
    steps = products(ahead.real, ahead.imag, degree) - products(behind.real, behind.imag, degree)
    return phasors, wave * steps @ np.linalg.pinv(products(nodes[0], nodes[1], degree))
