"""Exit pupils of images as smooth functions: their edges, eikonals and amplitudes over direction cosines.

A traced field is a set of nodes that serves one quadrature. A transfer function needs the pupil between the nodes and
exactly up to its edge, so the field is fitted. In coordinates p, (u, v) = centre + axes @ p, the edge is the unit
circle apart from small harmonics (``optics.waves.pupil_terms``), shadows of bodies in the beam are polygons
(``optics.waves.pupil_shadow``), and eikonal and amplitude are polynomials in products of Chebyshev polynomials. Through
mirrors the eikonal in metres does not depend on the wavelength, so one fit serves a whole band.

There is one fit, and two ways to compute the integrals: here at once for thousands of perturbed states, each at two
frequencies and one focus, where code for one pupil would spend its time on calls and not on arithmetic; in
``optics.waves.optical_transfer`` for one pupil at any number of frequencies and focuses, with nodes for each.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import one_blas_thread
from optics.numerics.quadrature import PupilNodes, gauss, nodes_for
from optics.waves.diffraction import PupilField
from optics.waves.pupil_shadow import FEW_SIDES, RIM_SIDES, PupilShadow, in_rows
from optics.waves.pupil_terms import (
    DARK_WEIGHT,
    PupilEdge,
    orders,
    polynomials,
    products,
    slopes,
    smooth_terms,
    to_terms,
)

DEGREE = 8
"""Degree of the polynomials for eikonal and amplitude over a pupil without vignetting.

For the example camera gf7 the residual of the eikonal (optical path over the pupil) is 1e-8 wavelengths, nominal or
perturbed; with 5 nm of every Zernike term to seventh order on each mirror it is 2e-5.
"""

VIGNETTED_DEGREES = (DEGREE, 10, 12, 14, 16, 18, 20)
"""Degrees of the polynomials of a vignetted pupil; the first that fits is used, or the best if none does.

Light that edges let pass comes from near the rims of fast aspheres, where the polynomials of a round pupil are not
optimal.
"""

MORE_DEGREES = (24, 28)
"""Further polynomial degrees that are tried for a vignetted pupil from which no shadows are subtracted.

With shadows they are not used, as the polynomials' values in the dark, which are subtracted again, are too large.
"""

VIGNETTED_RINGS = 20
"""Number of rings of the quadrature of a vignetted pupil.

A thin ring or a crescent of light has to contain enough rays for the polynomials.
"""

VIGNETTED_RESIDUAL = 1e-4
"""Rms eikonal residual up to which a fit to a vignetted pupil is accepted at once, wavelengths.

The residual with the best of VIGNETTED_DEGREES may be larger. The errors of the polynomials are largest along the
edges, at which the overlap of a pupil with itself ends.
"""

WORST_RESIDUAL = 1e-3
"""Largest allowed rms eikonal residual of a fit, wavelengths.

It changes the transfer function by about (2 pi)^2 of its square, 4e-5, where the overlap averages over it.
"""

LEAST_ALONG = 6
"""Number of nodes along each chord of a pupil's overlap with its shifted copy, for a constant phase.

With it and ``LEAST_ACROSS`` the transfer function of a clear pupil is accurate to 2e-6.
"""
LEAST_ACROSS = 10
"""Number of chords across a pupil's overlap with its shifted copy, for a constant phase."""
LEAST_SHADOW = 2
"""Number of nodes on each side of a shadow's box, for a constant phase: transfer functions are accurate to 5e-5."""

MIN_ILLUMINATED = (DEGREE + 1) * (DEGREE + 2) // 2
"""Smallest number of illuminated nodes for a fit: the number of polynomials of the lowest degree."""

EVEN_WEIGHT = 1e-2
"""Weight of nodes in the dark relative to illuminated ones, in fits of direction cosines and amplitudes.

These vary so little over the pupil that no polynomials of higher degree are needed.
"""

_BLOCK = 2**14
"""Number of points of overlaps per block: some arrays of 1 MB that stay in the cache."""
_BLOCK_SHADOWS = 2**16
"""Number of nodes per block for shadows, where finding the points takes longer than the arithmetic."""


@dataclass(frozen=True, eq=False)
class PupilStack:
    """B exit pupils, in normalised coordinates p (complex numbers x + iy, the edge near the unit circle).

    Attributes
    ----------
    centre : (B, 2) ndarray
        Direction cosines (u, v) of p = 0.
    axes : (B, 2, 2) ndarray
        Derivatives of (u, v) with respect to (x, y).
    harmonics : (2H + 1, B) ndarray
        Complex coefficients c_n, n = -H to H, of the edges' points p = sum c_n exp(i n a), with a the angle on the
        stop's rim.
    eikonal_terms, amplitude_terms : (B, D + 1, D + 1) ndarray
        Coefficients of the products T_i(x) T_j(y) of Chebyshev polynomials to degree D: of the eikonal, metres, and of
        the amplitude density (unit power: its square integrates to 1 over du dv).
    span : (B,) ndarray
        Peak-to-valley of the eikonal over each pupil after removal of a plane, metres.
    residual : (B,) ndarray
        Rms residual of the eikonal fit, metres.
    amplitude_residual : (B,) ndarray
        Rms residual of the amplitude fit, relative to the mean amplitude.
    shadow : PupilShadow, optional
        Shadows of bodies in the beams; None without any.
    """

    centre: np.ndarray
    axes: np.ndarray
    harmonics: np.ndarray
    eikonal_terms: np.ndarray
    amplitude_terms: np.ndarray
    span: np.ndarray
    residual: np.ndarray
    amplitude_residual: np.ndarray
    shadow: PupilShadow | None = None

    @classmethod
    def fit(
        cls,
        u: np.ndarray,
        v: np.ndarray,
        eikonal: np.ndarray,
        amplitude: np.ndarray,
        nodes: PupilNodes,
        degree: int = DEGREE,
        shadows: np.ndarray | None = None,
        rim_sides: int = FEW_SIDES,
        bright: np.ndarray | None = None,
    ) -> PupilStack:
        """Fit B pupils traced at N nodes of the stop, all of which carry light.

        Parameters
        ----------
        u, v : (B, N) ndarray
            Direction cosines along the detector's two axes.
        eikonal : (B, N) ndarray
            Eikonal (optical path of each ray's plane wave to the image point), metres.
        amplitude : (B, N) ndarray
            Amplitudes of the nodes times their areas in direction cosines, as in
            ``optics.waves.diffraction.PupilField``, positive.
        nodes : PupilNodes
            N nodes of a quadrature over the stop's unit disk.
        degree : int
            Degree of the polynomials.
        shadows : (B, K, V, 2) ndarray, optional
            K polygons of V corners on the stop's unit disk that do not overlap; None for free beams.
        rim_sides : int
            Number of sides of the polygon that represents the edge where a shadow extends over it.
        bright : (B, N) ndarray of bool, optional
            Mask of the nodes outside the shadows; None for all. The values of the others, NaN too, are ignored: the
            polynomials there are subtracted again, see ``smooth_terms``.

        Raises
        ------
        ValueError
            There are too few nodes for the degree.
        """
        root = np.sqrt(nodes.weight)
        i, j = orders(degree)
        cosines = np.stack([u, v], axis=1)
        if bright is None:
            terms = cosines @ to_terms(nodes, degree).T
        else:
            on_stop = products(nodes.x, nodes.y, degree)
            terms = smooth_terms(on_stop, nodes.weight, bright, np.swapaxes(cosines, 1, 2), EVEN_WEIGHT).swapaxes(1, 2)
            cosines = np.where(bright[:, None], cosines, terms @ on_stop.T)
        centre, axes, harmonics = _edges(terms, degree)
        (ux, vx), (uy, vy) = (np.moveaxis(terms @ slope.T, 1, 0) for slope in slopes(nodes, degree))
        density = amplitude / (nodes.weight * np.abs(ux * vy - uy * vx))
        position = np.linalg.solve(axes, cosines - centre[..., None])
        plain = products(position[:, 0], position[:, 1], degree)
        design = plain * root[:, None]
        values = np.stack([eikonal, density], axis=-1)
        if bright is None:
            transposed, weight = np.swapaxes(design, 1, 2), np.sum(nodes.weight)
            solution = np.linalg.solve(transposed @ design, transposed @ (values * root[:, None]))
        else:
            parts = zip((values[..., :1], values[..., 1:]), (DARK_WEIGHT, EVEN_WEIGHT), strict=True)
            solution = np.concatenate([smooth_terms(plain, nodes.weight, bright, *part) for part in parts], axis=-1)
            values = np.where(bright[..., None], values, plain @ solution)
            weight = (bright @ nodes.weight)[:, None]
        values = values * root[:, None]
        rest = np.sqrt(np.sum((values - design @ solution) ** 2, axis=1) / weight)
        level = i + j < 2
        plane = (design[..., level] @ solution[:, level, :1])[..., 0]
        bent = (values[..., 0] - plane) / root
        table = np.zeros((2, len(u), degree + 1, degree + 1))
        table[:, :, i, j] = np.moveaxis(solution, -1, 0)
        mean = np.mean(density, axis=-1) if bright is None else np.mean(density, axis=-1, where=bright)
        shadow = None
        if shadows is not None and shadows.shape[1]:
            # beyond the rim there are no rays and polynomials of high degree diverge; p is nearly the stop's coordinate
            within = shadows if bright is None else shadows / np.maximum(np.hypot(*shadows.T).T, 1.0)[..., None]
            corner = products(within[..., 0], within[..., 1], degree).reshape(len(u), -1, len(i))
            position = np.linalg.solve(axes, terms @ corner.swapaxes(1, 2) - centre[..., None])
            position = position.swapaxes(1, 2).reshape(shadows.shape) + (shadows - within)
            shadow = PupilShadow.within(position, harmonics, rim_sides)
        span, amplitude_rest = np.ptp(bent, axis=-1), rest[:, 1] / mean
        return cls(centre, axes, harmonics, table[0], table[1], span, rest[:, 0], amplitude_rest, shadow)

    @classmethod
    def fit_vignetted(
        cls,
        u: np.ndarray,
        v: np.ndarray,
        eikonal: np.ndarray,
        amplitude: np.ndarray,
        nodes: PupilNodes,
        wavelength: float,
        shadows: np.ndarray | None,
        bright: np.ndarray,
    ) -> PupilStack:
        """Fit B vignetted pupils by polynomials of the first degree that is accurate enough, or of the best degree.

        Parameters
        ----------
        u, v : (B, N) ndarray
            Direction cosines along the detector's two axes, at N nodes of the stop.
        eikonal : (B, N) ndarray
            Eikonal, metres.
        amplitude : (B, N) ndarray
            Amplitudes of the nodes times their areas in direction cosines, as in
            ``optics.waves.diffraction.PupilField``.
        nodes : PupilNodes
            Quadrature over the stop's unit disk.
        wavelength : float
            Wavelength, metres.
        shadows : (B, K, V, 2) ndarray, optional
            K polygons of V corners on the stop's unit disk that do not overlap; None without shadows.
        bright : (B, N) ndarray of bool
            Mask of the nodes outside the shadows; the values of the others are ignored.
        """
        best: PupilStack | None = None
        for degree in VIGNETTED_DEGREES + (() if shadows is not None and shadows.shape[1] else MORE_DEGREES):
            if (degree + 1) * (degree + 2) // 2 > nodes.count:
                break
            stack = cls.fit(u, v, eikonal, amplitude, nodes, degree, shadows, RIM_SIDES, bright)
            if best is None or np.max(stack.residual) < np.max(best.residual):
                best = stack
            if np.all(stack.residual <= VIGNETTED_RESIDUAL * wavelength):
                break
        assert best is not None
        return best

    @property
    def bend(self) -> np.ndarray:
        """Departure of each of B edges from an ellipse, (B,), in units of the pupil's radius.

        It is the sum of n^2 |c_n| over the edge's harmonics c_n, n their order. ``transfer`` allows at most
        ``optics.waves.pupil_terms.WORST_BEND``.
        """
        last = len(self.harmonics) // 2
        return np.asarray(np.arange(-last, last + 1) ** 2 @ np.abs(self.harmonics) - 1.0)

    def take(self, which: np.ndarray | slice) -> PupilStack:
        """Return some of the pupils, given by their indices."""
        shadow = None if self.shadow is None else self.shadow.take(which)
        terms = (self.eikonal_terms, self.amplitude_terms, self.span, self.residual, self.amplitude_residual)
        edge = (self.centre[which], self.axes[which], self.harmonics[:, which])
        eikonal, amplitude, span, residual, amplitude_residual = (part[which] for part in terms)
        return PupilStack(*edge, eikonal, amplitude, span, residual, amplitude_residual, shadow)

    def functions(self) -> tuple[PupilFunction, ...]:
        """Return each pupil as a ``PupilFunction``."""
        out = []
        for i, edge in enumerate(map(PupilEdge, np.moveaxis(self.harmonics, 1, 0))):
            shadow = None if self.shadow is None else self.shadow.take(slice(i, i + 1))
            terms = (self.eikonal_terms[i], self.amplitude_terms[i])
            rests = (float(self.residual[i]), float(self.amplitude_residual[i]))
            out.append(PupilFunction(self.centre[i], self.axes[i], edge, *terms, *rests, shadow))
        return tuple(out)

    def transfer(self, frequency: np.ndarray, wavelengths: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return polychromatic transfer functions in the plane of the traced detector, for M frequencies of B images.

        Parameters
        ----------
        frequency : (M, 2) ndarray
            Spatial frequencies along the detector's two axes, cycles/m.
        wavelengths : (K,) ndarray
            K wavelengths, metres.
        weights : (K,) ndarray
            Fraction of the signal at each wavelength; they need not sum to 1.

        Returns
        -------
        (B, M) ndarray
            Complex transfer functions, 0 beyond the cut-off.

        Raises
        ------
        ValueError
            An edge is far from an ellipse.
        """
        total = self._clear(frequency, wavelengths, weights / np.sum(weights))
        if self.shadow is not None:
            total = total + self._shadowed(self.shadow, frequency, wavelengths, weights / np.sum(weights))
        return np.asarray(total / self.power[:, None])

    def _shifts(self, frequency: np.ndarray, wavelengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the shifts of a pupil against itself for M frequencies at K wavelengths, and wave numbers, rad/m.

        Shifts are complex, in normalised pupil coordinates, (B, K * M) for B pupils; wave numbers have the shape (K *
        M,).
        """
        steps = (wavelengths[:, None, None] * frequency).reshape(-1, 2)
        moved = np.linalg.solve(self.axes, np.broadcast_to(steps.T, (len(self.axes), 2, len(steps))))
        return moved[:, 0] + 1j * moved[:, 1], np.repeat(2.0 * np.pi / wavelengths, len(frequency))

    def _clear(self, frequency: np.ndarray, wavelengths: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Return the transfer functions of B pupils without shadows at M frequencies, as means over the band, (B, M).

        They are integrals over the overlaps, not yet divided by the power.
        """
        shift, wave = self._shifts(frequency, wavelengths)
        steps = shift.shape[1]
        edges = PupilEdge(np.repeat(self.harmonics, steps, axis=1))
        right, left, inside = edges.corners(shift.ravel())
        values = np.zeros(shift.shape, complex)
        for rows, across, along in self._pieces(float(np.max(wave)), steps, _BLOCK):
            flat = (rows[:, None] * steps + np.arange(steps)).ravel()
            part = PupilEdge(edges.harmonics[:, flat])
            rules = (gauss(count) for count in (across, along))
            points, weight = part.overlap(shift.ravel()[flat], right[:, flat], left[:, flat], *rules)
            shape = (len(rows), steps, -1)
            values[rows] = self.take(rows)._sums(points.reshape(shape), weight.reshape(shape), shift[rows], wave)
        values *= inside.reshape(shift.shape)
        return np.asarray(np.einsum("k,bkm->bm", share, values.reshape(len(values), len(share), len(frequency))))

    def _shadowed(
        self, shadow: PupilShadow, frequency: np.ndarray, wavelengths: np.ndarray, share: np.ndarray
    ) -> np.ndarray:
        """Return the shadows' contribution to the integrals over the overlaps, to be added to that of clear pupils.

        It has the shape (B, M) for M frequencies of B pupils.
        """
        shift, wave = self._shifts(frequency, wavelengths)
        values = np.zeros(shift.shape, complex)
        for rows, _, along in self._pieces(float(np.max(wave)), 1, _BLOCK_SHADOWS):
            stack, moved = self.take(rows), shift[rows]
            parts = shadow.take(rows).parts(moved, LEAST_SHADOW + along - LEAST_ALONG)
            # whole pieces are evaluated once for all shifts, other regions and those in the other pupil one by one
            pieces, count = parts.whole.shape[1], len(parts.piece)
            other = parts.points - (parts.sign * moved[parts.pupil, parts.step])[:, None]
            owner = np.concatenate([np.repeat(np.arange(len(rows)), pieces), parts.pupil, parts.pupil[count:]])
            points = np.concatenate([parts.whole.reshape(-1, other.shape[1]), other, parts.points[count:]])
            path, light = stack._values_at(owner, points)
            first, last = len(rows) * pieces, len(rows) * pieces + len(other)
            indices = np.concatenate([parts.pupil[:count] * pieces + parts.piece, np.arange(last, len(owner))])
            phase = (parts.sign * wave[parts.step])[:, None] * (path[indices] - path[first:last])
            light = light[indices] * light[first:last] * parts.weights
            index = parts.pupil * shift.shape[1] + parts.step
            real, imaginary = (
                np.bincount(index, np.einsum("fq,fq->f", part(phase), light), moved.size) for part in (np.cos, np.sin)
            )
            values[rows] = (real + 1j * imaginary).reshape(moved.shape)
        return np.asarray(np.einsum("k,bkm->bm", share, values.reshape(len(values), len(share), len(frequency))))

    def _pieces(self, wave: float, shifts: int, points: int) -> Iterator[tuple[np.ndarray, int, int]]:
        """Yield groups of pupils that need the same numbers of nodes, and these numbers across and along chords.

        ``wave`` is the largest wave number, rad/m, ``shifts`` the number of shifts of each pupil, and ``points`` the
        largest number of points in a group.
        """
        along = np.array([nodes_for(float(span), LEAST_ALONG) for span in wave * self.span])
        for count in np.unique(along):
            rows = int(count) + LEAST_ACROSS - LEAST_ALONG
            pieces = np.flatnonzero(along == count)
            room = max(1, points // (shifts * rows * int(count)))
            for start in range(0, len(pieces), room):
                yield pieces[start : start + room], rows, int(count)

    def _sums(self, points: np.ndarray, weight: np.ndarray, shift: np.ndarray, wave: np.ndarray) -> np.ndarray:
        """Return integrals over the overlaps of B pupils with themselves at S shifts, (B, S).

        ``points`` and ``weight`` (B, S, Q) are Q complex nodes and area weights, ``shift`` (B, S) the complex shifts
        and ``wave`` (S,) the wave numbers, rad/m.
        """
        half = 0.5 * shift[..., None]
        (path, light), (path_behind, light_behind) = (self._values(c) for c in (points + half, points - half))
        phase = wave[:, None] * (path - path_behind)
        light = light * light_behind * weight
        real, imaginary = (np.einsum("bsq,bsq->bs", part(phase), light) for part in (np.cos, np.sin))
        return np.asarray(real + 1j * imaginary)

    def _values(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return eikonal (metres) and amplitude density at complex points of B pupils, each of the points' shape.

        ``p`` (B, S, Q) are Q points for each of S shifts.
        """
        eikonal, amplitude = (
            part.reshape(p.shape)
            for part in polynomials((self.eikonal_terms, self.amplitude_terms), p.reshape(len(p), -1))
        )
        return eikonal, amplitude

    def _values_at(self, owner: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return eikonal (metres) and amplitude density at Q points of each of F regions, (F, Q).

        ``owner`` (F,) is the pupil of each region, and ``p`` (F, Q) are complex points.
        """
        order, column, width = in_rows(owner, len(self.axes))
        points = np.zeros((len(self.axes), width, p.shape[1]), complex)
        points[owner[order], column] = p[order]
        columns = np.empty_like(order)
        columns[order] = column
        step = max(1, _BLOCK // (width * p.shape[1]))
        parts = [slice(k, k + step) for k in range(0, len(points), step)]
        path, light = (np.concatenate(a) for a in zip(*(self.take(s)._values(points[s]) for s in parts), strict=True))
        return path[owner, columns], light[owner, columns]

    @property
    def light(self) -> np.ndarray:
        """Fraction of the clear pupil's light that passes the shadows, for each of B pupils, (B,)."""
        return np.asarray(self.power / self._clear_power)

    @cached_property
    def power(self) -> np.ndarray:
        """Integral of the squared amplitude over each of B pupils less its shadows, in normalised coordinates, (B,)."""
        if self.shadow is None:
            return self._clear_power
        points, weight = (a.reshape(len(self.axes), -1) for a in self.shadow.whole(LEAST_SHADOW + 2))
        return np.asarray(self._clear_power - np.sum(self._values(points[:, None])[1][:, 0] ** 2 * weight, axis=-1))

    @cached_property
    def _clear_power(self) -> np.ndarray:
        """Integral of the squared amplitude over each of B pupils without shadows, in normalised coordinates, (B,)."""
        return clear_power(self.harmonics, self.amplitude_terms)


def clear_power(harmonics: np.ndarray, amplitude_terms: np.ndarray) -> np.ndarray:
    """Return the integral of the squared amplitude over B pupils without shadows, in normalised coordinates, (B,).

    Parameters
    ----------
    harmonics : (2H + 1, B) ndarray
        Complex coefficients c_n, n = -H to H, of the edges' points sum c_n exp(i n a), with a the angle on the stop's
        rim.
    amplitude_terms : (B, D + 1, D + 1) ndarray
        Coefficients of the products T_i(x) T_j(y) of Chebyshev polynomials to degree D, of the amplitude density.
    """
    edges, nothing = PupilEdge(harmonics), np.zeros(len(amplitude_terms), complex)
    right, left, _ = edges.corners(nothing)
    points, weight = edges.overlap(nothing, right, left, gauss(24), gauss(12))
    (amplitude,) = polynomials([amplitude_terms], points)
    return np.asarray(np.sum(amplitude**2 * weight, axis=-1))


def _edges(terms: np.ndarray, degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centres (B, 2), axes (B, 2, 2) and harmonics (2H + 1, B) of the edges of B pupils.

    The edges are the images of the unit circle under polynomial maps with K coefficients per coordinate, ``terms`` (B,
    2, K). Harmonics are the coefficients c_n, n = -H to H, of the edges' points sum c_n exp(i n a), with a the angle on
    the unit circle.
    """
    samples = 4 * degree
    angle = 2.0 * np.pi * np.arange(samples) / samples
    rim = terms @ products(np.cos(angle), np.sin(angle), degree).T
    harmonic = np.fft.fft(rim, axis=-1) / samples
    centre = harmonic[..., 0].real
    # u = centre + 2 Re(h e^{ia}): the ellipse of the first harmonic
    axes = 2.0 * np.stack([harmonic[..., 1].real, -harmonic[..., 1].imag], axis=-1)
    normalised = np.linalg.solve(axes, rim - centre[..., None])
    order = np.arange(-degree, degree + 1)
    harmonics = (np.fft.fft(normalised[:, 0] + 1j * normalised[:, 1], axis=-1) / samples)[:, order].T
    harmonics[np.abs(order) <= 1] = np.array([0.0, 0.0, 1.0])[:, None]
    return centre, axes, harmonics


SHADOW_NODES = 8
"""Number of nodes along each side of a shadow's box for the light that it blocks: the amplitude is nearly uniform."""


@dataclass(frozen=True, eq=False)
class PupilFunction:
    """Exit pupil of one image, in normalised coordinates p (complex numbers x + iy, the edge near the unit circle).

    Attributes
    ----------
    centre : (2,) ndarray
        Direction cosines (u, v) of p = 0.
    axes : (2, 2) ndarray
        Derivatives of (u, v) with respect to (x, y).
    edge : PupilEdge
        Edge of the pupil in p.
    eikonal_terms : (D + 1, D + 1) ndarray
        Coefficients of the products T_i(x) T_j(y) of Chebyshev polynomials to degree D of the eikonal, metres.
    amplitude_terms : (D + 1, D + 1) ndarray
        Coefficients of the amplitude density (unit power: its square integrates to 1 over du dv).
    eikonal_residual : float
        Rms residual of the eikonal fit, metres.
    amplitude_residual : float
        Rms residual of the amplitude fit, relative to the mean amplitude.
    shadow : PupilShadow, optional
        Shadow of bodies in the beam (of this one pupil); None without any.
    finer : int
        Number of additional nodes along each direction for its transfer function.
    transfer_error : float
        Change of the transfer function from fewer nodes; NaN where it was not determined.
    """

    centre: np.ndarray
    axes: np.ndarray
    edge: PupilEdge = field(repr=False)
    eikonal_terms: np.ndarray = field(repr=False)
    amplitude_terms: np.ndarray = field(repr=False)
    eikonal_residual: float = 0.0
    amplitude_residual: float = 0.0
    shadow: PupilShadow | None = field(default=None, repr=False)
    finer: int = 0
    transfer_error: float = np.nan

    def normalised(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return shifts (x, y) of the direction cosines as complex shifts in normalised pupil coordinates."""
        (a, b), (c, d) = np.linalg.inv(self.axes)
        return np.asarray((a * x + b * y) + 1j * (c * x + d * y))

    def cosines(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the direction cosines (u, v, w) at complex pupil points p, each of p's shape.

        w is along the detector's normal, positive downstream.
        """
        u = self.centre[0] + self.axes[0, 0] * p.real + self.axes[0, 1] * p.imag
        v = self.centre[1] + self.axes[1, 0] * p.real + self.axes[1, 1] * p.imag
        return u, v, np.sqrt(np.maximum(1.0 - u * u - v * v, 0.0))

    def values(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return eikonal (metres) and amplitude density at complex pupil points p, each of p's shape."""
        eikonal, amplitude = (
            part.reshape(p.shape)
            for part in polynomials((self.eikonal_terms[None], self.amplitude_terms[None]), p.reshape(1, -1))
        )
        return eikonal, amplitude

    def cutoff(self, direction: np.ndarray, wavelength: float) -> np.ndarray:
        """Return the cut-off frequencies along M directions, (M,), cycles/m.

        ``direction`` (M, 2) are vectors in detector x, y, of any length.
        """
        unit = np.asarray(direction) / np.linalg.norm(direction, axis=-1, keepdims=True)
        shift = self.normalised(unit[..., 0], unit[..., 1])
        return np.asarray(self.edge.extent(np.angle(shift))[0] / (np.abs(shift) * wavelength))

    @cached_property
    def power(self) -> float:
        """Integral of the squared amplitude over direction cosines.

        It is 1 apart from fit errors and the light that the shadow blocks.
        """
        if self.shadow is None:
            return self.clear_power
        # as in the transfer function at frequency zero
        points, weight = self.shadow.overlap(np.zeros((1, 1), complex), SHADOW_NODES)
        return self.clear_power + float(np.sum(self.values(points)[1] ** 2 * weight) * abs(np.linalg.det(self.axes)))

    @property
    def light(self) -> float:
        """Fraction of the clear pupil's light that passes the shadow."""
        return self.power / self.clear_power

    @cached_property
    def clear_power(self) -> float:
        """Integral of the squared amplitude over the direction cosines of the pupil without its shadow."""
        (power,) = clear_power(self.edge.harmonics[:, None], self.amplitude_terms[None])
        return float(power * abs(np.linalg.det(self.axes)))


def fit_pupils(
    field: PupilField,
    nodes: PupilNodes,
    degree: int = DEGREE,
    shadows: np.ndarray | None = None,
    bright: np.ndarray | None = None,
) -> tuple[PupilFunction, ...]:
    """Fit smooth pupils to the traced fields of B images.

    Parameters
    ----------
    field : PupilField
        Field traced at ``nodes`` of the stop.
    nodes : PupilNodes
        Quadrature of N nodes over the stop's unit disk, without a hole.
    degree : int
        Degree of the polynomials for the map from the stop, the eikonal and the amplitude; with ``bright`` the first of
        ``VIGNETTED_DEGREES`` that is accurate enough is used instead.
    shadows : (B, K, V, 2) ndarray, optional
        K polygons of V corners on the stop's unit disk that do not overlap; None for a free beam.
    bright : (B, N) ndarray of bool, optional
        Mask of the nodes outside the shadows of edges; the values of the others are ignored.

    Returns
    -------
    tuple of PupilFunction
        B pupils.

    Raises
    ------
    ValueError
        A node carries no light (a beam vignetted by another aperture than the stop is not modelled), there are too few
        nodes for the degree, an edge is far from an ellipse, or the polynomials do not follow the wavefront.
    """
    stopped = ~(field.amplitude > 0.0) & (True if bright is None else bright)
    dark = np.any(stopped, axis=-1)
    if np.any(dark):
        k = int(np.argmax(dark))
        share = float(np.mean(stopped[k]))
        raise UnphysicalError(
            f"{share:.1%} of the pupil of image {k} carries no light: a beam vignetted by another aperture than "
            "the stop has no smooth pupil; enlarge that aperture or move the field point inward"
        )
    if bright is not None and np.any(few := np.sum(bright, axis=-1) < MIN_ILLUMINATED):
        k = int(np.argmax(few))
        raise UnphysicalError(
            f"edges pass only {int(np.sum(bright[k]))} of {nodes.count} rays of image {k}: too few for a fit"
        )
    with one_blas_thread():
        traced = field.u, field.v, field.eikonal, field.amplitude, nodes
        if bright is None:
            stack = PupilStack.fit(*traced, degree, shadows, RIM_SIDES)
        else:
            stack = PupilStack.fit_vignetted(*traced, field.wavelength, shadows, bright)
    worst = int(np.argmax(stack.residual))
    if stack.residual[worst] > WORST_RESIDUAL * field.wavelength:
        used, left = stack.eikonal_terms.shape[-1] - 1, stack.residual[worst] / field.wavelength
        raise UnphysicalError(
            f"polynomials of degree {used} leave {left:.2g} wavelengths rms of "
            f"the wavefront of image {worst} (at most {WORST_RESIDUAL:g}): it is too rough for a pupil"
        )
    return stack.functions()


def circular_pupil(f_number: float, eikonal_terms: np.ndarray | None = None) -> PupilFunction:
    """Return a circular pupil of uniform amplitude for a telecentric image.

    Its edge is where the direction cosines (u, v) fulfil sqrt(u^2 + v^2) = 1 / (2 f_number).

    Parameters
    ----------
    f_number : float
        Focal ratio of the beam.
    eikonal_terms : ndarray, optional
        Coefficients of the products T_i(x) T_j(y) of Chebyshev polynomials of the eikonal over the unit disk, metres; a
        perfect wavefront by default.
    """
    aperture = 0.5 / f_number
    flat = np.zeros((1, 1)) if eikonal_terms is None else np.asarray(eikonal_terms, float)
    amplitude = np.zeros_like(flat)
    amplitude[0, 0] = 1.0 / (np.sqrt(np.pi) * aperture)
    return PupilFunction(
        np.zeros(2), aperture * np.eye(2), PupilEdge(np.array([0.0, 0.0, 1.0], complex)), flat, amplitude
    )
