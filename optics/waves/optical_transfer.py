"""Optical transfer function of a smooth pupil: its autocorrelation over the true region of overlap.

With U of ``optics.waves.diffraction`` the irradiance |U|^2 has the transform

    I~(f) = integral I(x) exp(-2 pi i f.x) dx = integral g(w) conj(g(w - lambda f)) dw,
    g(w) = a(w) exp(ik (L(w) + dz sqrt(1 - |w|^2))),    w = (u, v),

for a detector moved downstream by dz (Hopkins, Proc. R. Soc. A 231, 91 (1955), without his paraxial phase). The
integral runs over the overlap of the pupil with itself shifted by lambda f, whose edge is followed exactly, by Gauss'
rules: no sampled pupil with a jagged edge, exactly zero beyond the cut-off, and an error that falls exponentially with
the number of nodes. What the shadows of bodies take of the overlap (``optics.waves.pupil_shadow``) is integrated by
itself.

MTF of a pupil whose wavefront varies a little about that of a known one, for thousands of wavefronts at once.

The nodes of the overlap's quadrature (``optics.waves.optical_transfer``) and what the known pupil has there are
worked out once; a varied wavefront then costs a matrix product and a sum of phasors. The edge and the amplitude are
the known pupil's: small motions change them in the second order of what they do to the wavefront.
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

_AT_ONCE = 2**17
"""Phases (shifts x defocus x nodes) or frequencies worked on together: some arrays of 1 MB that stay in the cache."""

_NODES_AT_ONCE = 2**14
"""Nodes (over several shifts) at which the polynomials are worked out together; for the same reason."""

_PROBE_ANGLE = np.linspace(0.0, np.pi, 7)
_PROBE = np.cos(_PROBE_ANGLE)
"""Where the overlap is probed for the phase in both parameters: Gauss' nodes lie evenly in this angle, too."""
_PROBED = _NODES_AT_ONCE // len(_PROBE) ** 2


def transfer(pupil: PupilFunction, frequency: np.ndarray, wavelength: float, defocus: np.ndarray) -> np.ndarray:
    """Optical transfer function of one wavelength.

    Parameters
    ----------
    pupil : PupilFunction
        Of the image.
    frequency : np.ndarray
        (M, 2) along the detector's x and y, cycles/m.
    wavelength : float
        metres.
    defocus : np.ndarray
        (Z,) shift of the detector along its normal, metres, positive downstream.

    Returns
    -------
    np.ndarray
        Complex (Z, M): transform of the irradiance with kernel exp(-2 pi i f.x), 1 at f = 0, 0 beyond the cut-off. An
        image centred at x0 has the phase -2 pi f.x0.

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
    """Optical transfer function of a band: mean over K wavelengths, as ``transfer``.

    Parameters
    ----------
    pupil : PupilFunction | Sequence[PupilFunction]
        Of the image, the same at all wavelengths; or one for each of them, all about one point of the image, so that
        the colours of an image that stand apart blur it.
    frequency : np.ndarray
        (M, 2), cycles/m.
    wavelengths : np.ndarray
        (K,), metres.
    weights : np.ndarray
        (K,) share of the signal (power x response) at each; they need not sum to 1.
    defocus : np.ndarray
        (Z,), metres.

    Returns
    -------
    np.ndarray
        Complex (Z, M).

    Raises
    ------
    ValueError
        Other shapes, numbers that are not finite, weights that are negative or all zero, wavelengths that are not
        positive, or other numbers of pupils and wavelengths.
    UnphysicalError
        An image so blurred that it takes more than ``MOST_NODES``.
    """
    frequency, defocus = np.asarray(frequency, float), np.asarray(defocus, float)
    if frequency.ndim != 2 or frequency.shape[1] != 2 or defocus.ndim != 1:
        raise ValueError(f"frequency (M, 2) and defocus (Z,) expected, got {frequency.shape} and {defocus.shape}")
    if not np.all(np.isfinite(frequency)) or not np.all(np.isfinite(defocus)):
        raise ValueError("frequency and defocus must be finite")
    wavelengths, share = _band(wavelengths, weights)
    if not isinstance(pupil, PupilFunction):
        each = [
            transfer(own, frequency, float(wavelength), defocus)
            for own, wavelength in zip(pupil, wavelengths, strict=True)
        ]
        return np.asarray(np.einsum("k,kzm->zm", share, each))
    shift = wavelengths[:, None] * pupil.normalised(frequency[:, 0], frequency[:, 1])
    every = np.repeat(wavelengths, len(frequency))
    parts = _correlate(pupil, shift.ravel(), every, defocus).reshape(*shift.shape, len(defocus))
    return np.asarray(np.einsum("k,kmz->zm", share, parts))


def _band(wavelengths: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Checked wavelengths and normalised weights."""
    wavelengths, weights = np.asarray(wavelengths, float), np.asarray(weights, float)
    if wavelengths.ndim != 1 or wavelengths.shape != weights.shape:
        raise ValueError(f"one weight for each wavelength expected, got {weights.shape} for {wavelengths.shape}")
    if not np.all(wavelengths > 0.0) or not np.all(weights >= 0.0) or not np.sum(weights) > 0.0:
        raise ValueError("wavelengths must be positive, weights not negative and not all zero")
    return wavelengths, weights / np.sum(weights)


LEAST_ALONG = 8
"""Nodes on the chords for a constant phase: the amplitude is nearly even."""

MOST_NODES = 2**20
"""Nodes for one frequency, beyond which an image is so far from sharp that no MTF is asked for: its phase runs over
hundreds of waves, and a merit of a few such frequencies would take a quarter of an hour."""

LEAST_ACROSS = 13
"""Nodes across the chords for a constant phase: their length goes through half a period of a sine."""


def _correlate(
    pupil: PupilFunction, shift: np.ndarray, wavelength: np.ndarray, defocus: np.ndarray, part: Part = "all"
) -> np.ndarray:
    """Transfer function at normalised shifts (S,), wavelengths (S,) and defocus (Z,): (S, Z).

    Its ``part`` may be "clear", that of the clear pupil, or "shadow", what the shadow adds, both normalised as a whole.
    """
    if part not in get_args(Part):
        raise ValueError(f"a transfer function has no part {part!r}; there are {', '.join(get_args(Part))}")
    out = np.zeros((len(shift), len(defocus)), complex)
    if not len(shift) or not len(defocus):
        return out
    wave = 2.0 * np.pi / wavelength
    scale = abs(np.linalg.det(pupil.axes)) / pupil.power

    def piece(which: np.ndarray, across: int, along: int) -> None:
        s, k = shift[which], wave[which]
        own = []
        if part != "shadow":
            rules = gauss(across + 3 * pupil.finer // 2), gauss(along + pupil.finer)
            own.append(pupil.edge.overlap(s, right[:, which], left[:, which], *rules))
        if pupil.shadow is not None and part != "clear":
            nodes = pupil.shadow.least_nodes + max(across - LEAST_ACROSS, along - LEAST_ALONG) + pupil.finer // 8
            taken, area = pupil.shadow.overlap(s[None], nodes)
            own.append((taken[0], area[0]))
        points, weight = (np.concatenate(arrays, axis=1) for arrays in zip(*own, strict=True))
        light, path, focus = _products(pupil, points, s)
        light *= weight
        phase = k[:, None, None] * (path[:, None] + defocus[:, None] * focus[:, None])
        real, imaginary = (np.einsum("szn,sn->sz", part(phase), light) for part in (np.cos, np.sin))
        out[which] = scale * (real + 1j * imaginary)

    with one_blas_thread(), ThreadPoolExecutor(cores()) as pool:
        right, left, inside = pupil.edge.corners(shift)
        used = np.flatnonzero(inside)
        few = [used[i : i + _PROBED] for i in range(0, len(used), _PROBED)]
        parts = pool.map(lambda w: _spans(pupil, shift[w], right[:, w], left[:, w], wave[w], defocus), few)
        spans = np.concatenate([np.zeros((2, 0)), *parts], axis=1)
        list(pool.map(lambda args: piece(*args), _pieces(used, spans[0], spans[1], len(defocus))))
    return out


def _products(pupil: PupilFunction, points: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Product of the amplitudes at c + s/2 and c - s/2, difference of the eikonals and of the normal cosines."""
    ahead, behind = points + 0.5 * shift[:, None], points - 0.5 * shift[:, None]
    (path, light), (path_behind, light_behind) = pupil.values(ahead), pupil.values(behind)
    return light * light_behind, path - path_behind, pupil.cosines(ahead)[2] - pupil.cosines(behind)[2]


def _spans(
    pupil: PupilFunction, shift: np.ndarray, right: np.ndarray, left: np.ndarray, wave: np.ndarray, defocus: np.ndarray
) -> np.ndarray:
    """How fast the phase runs across and along the chords for the worst defocus, (2, S), radians per radian of the
    angle in which Gauss' nodes lie evenly: half its range where it is linear.
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


def _pieces(
    used: np.ndarray, across: np.ndarray, along: np.ndarray, layers: int
) -> Iterator[tuple[np.ndarray, int, int]]:
    """Shifts of like spans, with their numbers of nodes, in pieces of bounded size."""
    order = np.argsort(along)[::-1]
    start = 0
    while start < len(order):
        # the first of a piece has the longest span along; across, the worst of what may be in it
        count = nodes_for(float(along[order[start]]), LEAST_ALONG)
        room = min(_NODES_AT_ONCE, _AT_ONCE // layers) // count
        most = order[start : start + max(1, room // LEAST_ACROSS)]
        rows = nodes_for(float(np.max(across[most])), LEAST_ACROSS)
        if rows * count > MOST_NODES:
            raise UnphysicalError(
                f"a transfer function takes {rows * count:.2g} nodes at a frequency (at most {MOST_NODES:.2g}): the "
                "image is blurred by hundreds of waves"
            )
        some = most[: max(1, room // rows)]
        yield used[some], rows, count
        start += len(some)


FINER = (4, 8, 16, 32, 64)
"""Further nodes that are tried."""

SETTLED = 2e-4
"""Change of a transfer function by further nodes below which there are enough."""

WORST_TRANSFER = 1e-3
"""Change of that kind beyond which no transfer function is told."""

_TRIED = np.array([[x, 0.0] for x in (0.12, 0.3, 0.55, 0.8)] + [[0.0, y] for y in (0.2, 0.4, 0.6, 0.9)])
"""Frequencies at which nodes are compared, of the cut-off along both axes."""


def with_nodes_enough(pupil: PupilFunction, wavelength: float) -> PupilFunction:
    """A pupil with a shadow, and the further nodes that its transfer function asks for.

    What edges leave of a wavefront may be smooth where its continuation into the dark is not, and the clear pupil is
    integrated over both. Nodes are added until that changes nothing.

    Parameters
    ----------
    pupil : PupilFunction
        Of an image.
    wavelength : float
        metres.

    Returns
    -------
    PupilFunction
        The pupil with ``finer`` and ``transfer_error``, the change from fewer nodes.

    Raises
    ------
    UnphysicalError
        The most nodes are too few.
    """
    if pupil.shadow is None:
        return pupil
    frequency = _TRIED * pupil.cutoff(np.eye(2), wavelength)
    shift = wavelength * pupil.normalised(frequency[:, 0], frequency[:, 1])

    def values(one: PupilFunction, shift: np.ndarray, part: Part) -> np.ndarray:
        return _correlate(one, shift, np.full(len(shift), wavelength), np.zeros(1), part)

    before, error = values(pupil, shift, "clear"), np.inf
    for finer in FINER:
        one = replace(pupil, finer=finer)
        now = values(one, shift, "clear")
        error, before = float(np.max(np.abs(now - before))), now
        if error < SETTLED:
            # of shadows, which are small and many, at fewer frequencies
            few = shift[1::4]
            change = values(replace(one, finer=2 * finer), few, "shadow") - values(one, few, "shadow")
            error += float(np.max(np.abs(change)))
            break
    if not error < WORST_TRANSFER:
        raise UnphysicalError(
            f"the transfer function of a pupil that edges cut still changes by {error:.2g} with further nodes (at most "
            f"{WORST_TRANSFER:g}): its wavefront is too steep in what is dark"
        )
    return replace(one, transfer_error=error)


TABLE_TAIL = 1e-6
"""Largest coefficient in the last quarter of a table's series, of 1 at zero frequency."""

_DENSE = (1536, 512)
"""Cells of a table's spline from zero to the cut-off, and around the circle."""

_PAD = 12
"""Cells beyond the edges of the spline: a cubic spline forgets an edge by 0.27 per cell."""

_MOST_NODES = 400
"""Radial nodes at which a table gives up."""

_SHADOW_GRID = (48, 64)
"""Steps from zero to the cut-off, and over half the circle, of what a shadow adds. Corners of one shadow that meet the
sides of another leave kinks, which no series follows well: cubic splines do to 1e-4."""


@dataclass(frozen=True, eq=False)
class TransferTable:
    """Polychromatic transfer function at one focus, interpolated: for images with 1e5 frequencies and more.

    The transfer function is worked out on a polar grid of shifts in the normalised pupil, for each wavelength: equal
    angles, and Chebyshev nodes in the arc cosine of shift / cut-off. In this angle it is smooth up to the cut-off,
    where it ends like the power 3/2 of the distance. The phase of the image's centroid is kept apart. The band's mean
    is then a cubic spline, fine enough for the cut-offs of the single wavelengths inside: right to 1e-5.

    Attributes
    ----------
    centroid : np.ndarray
        (x, y) of the image from its origin, metres, (2,); its phase multiplies the spline.
    to_shift : np.ndarray
        (2, 2), from cycles/m to normalised shifts at the shortest wavelength.
    reach : np.ndarray
        Fourier terms of the longest normalised shift over exp(2 i direction), complex.
    spline : np.ndarray
        Coefficients over shift / longest shift and direction, complex.
    """

    centroid: np.ndarray
    to_shift: np.ndarray
    reach: np.ndarray
    spline: np.ndarray

    @classmethod
    def build(
        cls, pupil: PupilFunction, wavelengths: np.ndarray, weights: np.ndarray, defocus: float = 0.0
    ) -> TransferTable:
        """Table of one image; arguments as ``polychromatic_transfer``, with one defocus (metres).

        Parameters
        ----------
        pupil : PupilFunction
            Of the image.
        wavelengths : np.ndarray
            (K,), metres.
        weights : np.ndarray
            (K,) share of the signal at each.
        defocus : float
            Of the detector along its normal, metres, positive downstream.

        Raises
        ------
        ValueError
            As there, or a wavefront of so many waves that the table would grow out of hand.
        """
        wavelengths, share = _band(wavelengths, weights)
        wavelengths, share = wavelengths[share > 0.0], share[share > 0.0]
        centroid = _centroid(pupil, float(np.mean(wavelengths)), defocus)
        rings, arms = 24, 16
        while True:
            # the shortest wavelength has the largest phases
            own = np.abs(_polar_terms(pupil, np.min(wavelengths, keepdims=True), defocus, centroid, rings, arms)[0])
            radial = np.max(own[3 * rings // 4 :])
            around = np.max(own[:, np.abs(np.fft.fftfreq(2 * arms)) > 3 / 8])
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
        kept = np.abs(order) < min(arms, directions // 2)
        for wavelength, part, own in zip(wavelengths, share, terms, strict=True):
            ratio = radius * (wavelength / np.min(wavelengths))
            rows = ratio < 1.0
            place = np.arccos(ratio[rows]) * (4.0 / np.pi) - 1.0
            values = np.polynomial.chebyshev.chebvander(place, rings - 1) @ own[:, kept]
            around_dense[np.ix_(rows, order[kept] % directions)] += part * values
        dense = np.fft.ifft(around_dense, axis=-1) * directions
        if pupil.shadow is not None:
            dense += _shadow_table(pupil, wavelengths, share, defocus, centroid, radius, directions)
        padded = np.pad(dense, ((0, 0), (_PAD, _PAD)), mode="wrap")
        coefficients = spline_filter(padded.real) + 1j * spline_filter(padded.imag)
        direction = np.pi * np.arange(64) / 64
        reach = np.fft.fft(pupil.edge.reach(direction)[0])[:9] / 64
        reach[1:] *= 2.0
        return cls(centroid, np.min(wavelengths) * np.linalg.inv(pupil.axes), reach, coefficients)

    def __call__(self, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        """Transfer function at frequencies (cycles/m) of any shapes that broadcast; complex, of that shape."""
        fx, fy = np.broadcast_arrays(np.asarray(fx, float), np.asarray(fy, float))
        out = np.empty(fx.size, complex)

        def piece(part: slice) -> None:
            out[part] = self._values(fx.ravel()[part], fy.ravel()[part])

        with ThreadPoolExecutor(cores()) as pool:
            list(pool.map(piece, (slice(i, i + _AT_ONCE) for i in range(0, out.size, _AT_ONCE))))
        return out.reshape(fx.shape)

    def _values(self, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        (a, b), (c, d) = self.to_shift
        x, y = a * fx + b * fy, c * fx + d * fy
        size = np.hypot(x, y)
        twice = (x + 1j * y) ** 2 / np.where(size == 0.0, 1.0, size) ** 2
        radius = size / np.polynomial.polynomial.polyval(twice, self.reach).real
        out = np.zeros(len(fx), complex)
        some = np.flatnonzero(radius < 1.0)
        angle = np.arctan2(y[some], x[some]) % (2.0 * np.pi)
        where = np.stack([radius[some] * _DENSE[0], angle * (_DENSE[1] / (2.0 * np.pi))]) + _PAD
        real, imaginary = (
            map_coordinates(part, where, order=3, prefilter=False) for part in (self.spline.real, self.spline.imag)
        )
        turn = np.exp(-2j * np.pi * (fx[some] * self.centroid[0] + fy[some] * self.centroid[1]))
        out[some] = (real + 1j * imaginary) * turn
        return out


def _centroid(pupil: PupilFunction, wavelength: float, defocus: float) -> np.ndarray:
    """Centroid (x, y) of the image from the phase at a ten-thousandth of the cut-off, metres."""
    axes = np.eye(2)
    frequency = 1e-4 * pupil.cutoff(axes, wavelength)
    phase = np.angle(transfer(pupil, frequency[:, None] * axes, wavelength, np.array([defocus]))[0])
    return np.asarray(-phase / (2.0 * np.pi * frequency))


def _polar_terms(
    pupil: PupilFunction, wavelengths: np.ndarray, defocus: float, centroid: np.ndarray, rings: int, arms: int
) -> np.ndarray:
    """Chebyshev (of the arc cosine of shift / cut-off) and Fourier (of the direction) coefficients of the transfer
    function about its centroid, complex (K, rings, 2 arms), the Fourier ones in the order of ``np.fft.fft``.
    """
    node = np.cos(np.pi * (np.arange(rings) + 0.5) / rings)
    direction = np.pi * np.arange(arms) / arms
    ratio = np.cos(0.25 * np.pi * (node + 1.0))
    shift = ratio[:, None] * pupil.edge.reach(direction)[0] * np.exp(1j * direction)
    values = _about(pupil, shift, wavelengths, defocus, centroid, "clear")
    circle = np.concatenate([values, np.conj(values)], axis=-1)
    transform = np.polynomial.chebyshev.chebvander(node, rings - 1).T * (2.0 / rings)
    transform[0] *= 0.5
    return np.asarray(transform @ np.fft.fft(circle, axis=-1)) / (2 * arms)


def _about(
    pupil: PupilFunction, shift: np.ndarray, wavelengths: np.ndarray, defocus: float, centroid: np.ndarray, part: Part
) -> np.ndarray:
    """``part`` of the transfer function about ``centroid`` at normalised shifts of any shape, (K, *shape)."""
    every = np.repeat(wavelengths, shift.size)
    values = _correlate(pupil, np.tile(shift.ravel(), len(wavelengths)), every, np.array([defocus]), part)
    away = (pupil.axes.T @ centroid) @ np.stack([shift.real, shift.imag]).reshape(2, -1)
    values = values.reshape(len(wavelengths), -1) * np.exp(2j * np.pi * away / wavelengths[:, None])
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
    """What the shadow adds to a table, on its grid of ``radius`` and directions, complex."""
    rings, arms = _SHADOW_GRID
    direction = np.pi * np.arange(arms) / arms
    ratio = np.arange(rings) / rings
    shift = ratio[:, None] * pupil.edge.reach(direction)[0] * np.exp(1j * direction)
    half = _about(pupil, shift, wavelengths, defocus, centroid, "shadow")
    circle = np.concatenate([half, np.conj(half)], axis=-1)
    # beyond the cut-off there is nothing; at zero is a cusp, which the spline goes on from as the series do
    around = np.pad(np.pad(circle, ((0, 0), (0, _PAD), (0, 0))), ((0, 0), (0, 0), (_PAD, _PAD)), mode="wrap")
    angle = np.pi * np.arange(-_PAD, 2 * arms + _PAD) / arms
    wanted = 2.0 * np.pi * np.arange(directions) / directions
    knots = np.arange(rings + _PAD) / rings
    out = np.zeros((len(radius), directions), complex)
    for wavelength, part, own in zip(wavelengths, share, around, strict=True):
        at = radius * (wavelength / np.min(wavelengths))
        rows = at < 1.0
        out[rows] += part * make_interp_spline(knots, make_interp_spline(angle, own, axis=1)(wanted))(at[rows])
    return out


ACROSS, ALONG, IN_SHADOW = 24, 18, 12
"""Nodes across and along the chords of an overlap, and along each side of a shadow's box: with a wave of error at the
edge of the pupil the MTF is right to 1e-6."""


@dataclass(frozen=True, eq=False)
class _Colour:
    """One wavelength of a varied transfer function.

    Attributes
    ----------
    phasors : np.ndarray
        Of the known pupil at the nodes of the overlap with their weights, complex (Q,); their sum is its transfer
        function, times the wavelength's share.
    turns : np.ndarray
        From optical paths at the traced nodes of the stop to what they add to the phases at the nodes of the overlap,
        by polynomials over the pupil, (Q, N), radians per metre.
    own : slice
        Which of the paths of all traced wavelengths are its own.
    """

    phasors: np.ndarray
    turns: np.ndarray
    own: slice


@dataclass(frozen=True, eq=False)
class VariedTransfer:
    """The optical transfer function of one image at one frequency, in light of one wavelength or several.

    Its paths are those of the traced wavelengths, one after the other, (..., K N), metres; of mirrors, which image all
    wavelengths alike, one is traced for all.

    Attributes
    ----------
    colours : tuple[_Colour, ...]
        Its wavelengths below the cut-off.
    """

    colours: tuple[_Colour, ...]

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
        """Work out what does not vary.

        Parameters
        ----------
        pupils : Sequence[PupilFunction]
            The known ones, all about one point of the image: of every wavelength, or one for all.
        frequency : np.ndarray
            Along the detector's axes, (2,), cycles/m.
        wavelengths : np.ndarray
            Metres, (C,).
        shares : np.ndarray
            Of the wavelengths in the light, which sum to 1, (C,).
        cosines : np.ndarray
            Direction cosines along these axes of the rays whose wavefront varies, (C, N, 2), or (1, N, 2).
        degree : int
            Of the polynomials of its variation.

        Returns
        -------
        VariedTransfer | None
            None beyond the cut-off of all wavelengths.
        """
        out, rays = [], cosines.shape[1]
        for k, (wavelength, share) in enumerate(zip(wavelengths, shares, strict=True)):
            pupil = pupils[k if len(pupils) > 1 else 0]
            start = k if len(cosines) > 1 else 0
            found = _fixed(pupil, frequency, float(wavelength), cosines[start], degree)
            if found is not None:
                out.append(_Colour(share * found[0], found[1], slice(start * rays, (start + 1) * rays)))
        return cls(tuple(out)) if out else None

    @property
    def known(self) -> float:
        """MTF of the known pupil."""
        return float(abs(sum(np.sum(one.phasors) for one in self.colours)))

    def modulation(self, paths: np.ndarray) -> np.ndarray:
        """MTF where the optical paths of the rays are longer than the known pupil's by ``paths`` (..., K N), metres."""
        whole: np.ndarray | int = 0
        for one in self.colours:
            phase = paths[..., one.own] @ one.turns.T
            whole = whole + (np.cos(phase) @ one.phasors + 1j * (np.sin(phase) @ one.phasors))
        return np.asarray(np.abs(whole))

    def curvature(self, slopes: np.ndarray) -> np.ndarray:
        """Second derivatives of the MTF by pairs of numbers, (L, L), at the known pupil.

        Parameters
        ----------
        slopes : np.ndarray
            Of the rays' optical paths by the numbers, (L, K N), metres.
        """
        whole, first, second = 0j, 0j, 0j
        for one in self.colours:
            phases = slopes[:, one.own] @ one.turns.T
            whole = whole + np.sum(one.phasors)
            first = first + 1j * phases @ one.phasors
            second = second - (phases * one.phasors) @ phases.T
        size = abs(whole)
        along = np.real(np.conj(whole) * first) / size
        across = np.real(np.outer(np.conj(first), first) + np.conj(whole) * second)
        return np.asarray((across - np.outer(along, along)) / size)


def _fixed(
    pupil: PupilFunction, frequency: np.ndarray, wavelength: float, cosines: np.ndarray, degree: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Phasors and turns of one wavelength; arguments as of ``VariedTransfer.of``, cosines (N, 2)."""
    shift = np.atleast_1d(pupil.normalised(*(wavelength * np.asarray(frequency))))
    right, left, inside = pupil.edge.corners(shift)
    if not inside[0]:
        return None
    own = [pupil.edge.overlap(shift, right, left, gauss(ACROSS), gauss(ALONG))]
    if pupil.shadow is not None:
        taken, area = pupil.shadow.overlap(shift[None], IN_SHADOW)
        own.append((taken[0], area[0]))
    points, weight = (np.concatenate(arrays, axis=1)[0] for arrays in zip(*own, strict=True))
    ahead, behind = points + 0.5 * shift, points - 0.5 * shift
    (path, light), (path_behind, light_behind) = pupil.values(ahead), pupil.values(behind)
    wave = 2.0 * np.pi / wavelength
    scale = abs(np.linalg.det(pupil.axes)) / pupil.power
    phasors = scale * weight * light * light_behind * np.exp(1j * wave * (path - path_behind))
    place = np.linalg.solve(pupil.axes, (cosines - pupil.centre).T)
    steps = products(ahead.real, ahead.imag, degree) - products(behind.real, behind.imag, degree)
    return phasors, wave * steps @ np.linalg.pinv(products(place[0], place[1], degree))
