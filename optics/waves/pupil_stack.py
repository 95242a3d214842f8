"""The exit pupils of images as smooth functions: their edges, eikonals and amplitudes over direction cosines.

A traced field is a set of nodes that serves one quadrature. A transfer function needs the pupil between the nodes and
exactly up to its edge, so the field is fitted. In coordinates p, (u, v) = centre + axes @ p, the edge is the unit
circle but for small harmonics (``optics.waves.pupil_terms``), shadows of bodies that stand in the beam are polygons
(``optics.waves.pupil_shadow``), and eikonal and amplitude are polynomials in products of Chebyshev's. Through mirrors
the eikonal in metres does not depend on the wavelength, so one fit serves a whole band.

There is one fit. The integrals are worked out in two ways: here at once for thousands of perturbed states, each at two
frequencies and one focus, where code for one pupil spends its time on calls and not on numbers; in
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
from optics.waves.pupil_terms import FAINTLY, PupilEdge, orders, polynomials, products, slopes, smooth_terms, to_terms

DEGREE = 8
"""Degree of the polynomials. The library's gf7 leaves 1e-8 wavelengths of eikonal, nominal or perturbed; with 5 nm of
every Zernike term to seventh order on each mirror it leaves 2e-5."""

CUT_DEGREES = (DEGREE, 10, 12, 14, 16, 18, 20)
"""Degrees of the polynomials of a pupil with cut edges; the first that fits is used, or the best if none does. Light
that edges leave comes from near the rims of fast aspheres, where no polynomial of a round pupil is the best one."""

MORE_DEGREES = (24, 28)
"""Further ones of a pupil of which no shadows are taken off again: what they say of the dark is too large for that."""

CUT_RINGS = 20
"""Rings of the quadrature of a pupil with cut edges: a thin ring or a crescent of light has to hold rays enough for
polynomials."""

CUT_RESIDUAL = 1e-4
"""Rms eikonal that the polynomials of a pupil that edges cut should leave, wavelengths; the best of CUT_DEGREES may
leave more. Their errors are largest along the edges, at which the overlap of a pupil with itself ends.
"""

WORST_RESIDUAL = 1e-3
"""Rms eikonal that a fit may leave, wavelengths; it changes the transfer function by about (2 pi)^2 of its square,
4e-5, where the overlap averages over it."""

LEAST_ALONG = 6
LEAST_ACROSS = 10
LEAST_SHADOW = 2
"""Nodes on and across the chords of an overlap, and on each side of a shadow's box, for a constant phase. The transfer
function is then right to 2e-6, and to 5e-5 with shadows."""

FEWEST_LIT = (DEGREE + 1) * (DEGREE + 2) // 2
"""Nodes in the light from which polynomials are told: as many as those of the lowest degree."""

EVENLY = 1e-2
"""As ``FAINTLY``, of direction cosines and amplitudes, which vary so little that nothing has to be added to them."""

_AT_ONCE = 2**14
"""Points of overlaps worked on together: some arrays of 1 MB that stay in the cache."""
_SHADOWS_AT_ONCE = 2**16
"""Nodes at once for shadows, where the way to the points is longer than what is done there."""


@dataclass(frozen=True, eq=False)
class PupilStack:
    """B exit pupils, in normalised coordinates p as complex numbers x + iy.

    Attributes
    ----------
    centre : np.ndarray
        Direction cosines (u, v) of p = 0, (B, 2).
    axes : np.ndarray
        d(u, v)/dp, (B, 2, 2).
    harmonics : np.ndarray
        Of the edges in p, complex (2H + 1, B).
    eikonal_terms, amplitude_terms : np.ndarray
        Coefficients of T_i(x) T_j(y), (B, D + 1, D + 1); metres, and of the amplitude density (unit power: its square
        integrates to 1 over du dv).
    span : np.ndarray
        How far the eikonal runs over each pupil, a plane taken out, (B,), metres.
    residual : np.ndarray
        Rms eikonal that the fit leaves, (B,), metres.
    amplitude_residual : np.ndarray
        Rms of what it leaves of the amplitude, share of its mean, (B,).
    shadow : PupilShadow | None
        What bodies in the beams take, None if nothing stands there.
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
        lit: np.ndarray | None = None,
    ) -> PupilStack:
        """Fit pupils traced at nodes of the stop, all of which carry light.

        Parameters
        ----------
        u : np.ndarray
            Direction cosines along the detector's first axis, (B, N).
        v : np.ndarray
            Likewise along the second.
        eikonal : np.ndarray
            (B, N), metres.
        amplitude : np.ndarray
            Of the nodes as in ``optics.waves.diffraction.PupilField``, (B, N), positive.
        nodes : PupilNodes
            N nodes of a quadrature over the stop's unit disk.
        degree : int
            Of the polynomials.
        shadows : np.ndarray | None
            Polygons on the stop's unit disk that do not overlap, (B, K, V, 2); None for free beams.
        rim_sides : int
            Of the polygon that stands for the edge where a shadow reaches over it.
        lit : np.ndarray | None
            Which nodes lie outside of the shadows, (B, N); None for all. What the others hold, NaN too, is not looked
            at: what the polynomials say there is taken off again, see ``smooth_terms``.

        Raises
        ------
        ValueError
            Too few nodes for the degree.
        """
        root = np.sqrt(nodes.weight)
        i, j = orders(degree)
        cosines = np.stack([u, v], axis=1)
        if lit is None:
            terms = cosines @ to_terms(nodes, degree).T
        else:
            on_stop = products(nodes.x, nodes.y, degree)
            terms = smooth_terms(on_stop, nodes.weight, lit, np.swapaxes(cosines, 1, 2), EVENLY).swapaxes(1, 2)
            cosines = np.where(lit[:, None], cosines, terms @ on_stop.T)
        centre, axes, harmonics = _edges(terms, degree)
        (ux, vx), (uy, vy) = (np.moveaxis(terms @ slope.T, 1, 0) for slope in slopes(nodes, degree))
        density = amplitude / (nodes.weight * np.abs(ux * vy - uy * vx))
        place = np.linalg.solve(axes, cosines - centre[..., None])
        plain = products(place[:, 0], place[:, 1], degree)
        design = plain * root[:, None]
        both = np.stack([eikonal, density], axis=-1)
        if lit is None:
            turned, weight = np.swapaxes(design, 1, 2), np.sum(nodes.weight)
            solution = np.linalg.solve(turned @ design, turned @ (both * root[:, None]))
        else:
            parts = zip((both[..., :1], both[..., 1:]), (FAINTLY, EVENLY), strict=True)
            solution = np.concatenate([smooth_terms(plain, nodes.weight, lit, *part) for part in parts], axis=-1)
            both = np.where(lit[..., None], both, plain @ solution)
            weight = (lit @ nodes.weight)[:, None]
        both = both * root[:, None]
        rest = np.sqrt(np.sum((both - design @ solution) ** 2, axis=1) / weight)
        level = i + j < 2
        plane = (design[..., level] @ solution[:, level, :1])[..., 0]
        bent = (both[..., 0] - plane) / root
        table = np.zeros((2, len(u), degree + 1, degree + 1))
        table[:, :, i, j] = np.moveaxis(solution, -1, 0)
        mean = np.mean(density, axis=-1) if lit is None else np.mean(density, axis=-1, where=lit)
        shadow = None
        if shadows is not None and shadows.shape[1]:
            # where no rays are followed, polynomials of high degree run away beyond the rim, and p is nearly the stop's
            within = shadows if lit is None else shadows / np.maximum(np.hypot(*shadows.T).T, 1.0)[..., None]
            corner = products(within[..., 0], within[..., 1], degree).reshape(len(u), -1, len(i))
            place = np.linalg.solve(axes, terms @ corner.swapaxes(1, 2) - centre[..., None])
            place = place.swapaxes(1, 2).reshape(shadows.shape) + (shadows - within)
            shadow = PupilShadow.within(place, harmonics, rim_sides)
        span, amplitude_rest = np.ptp(bent, axis=-1), rest[:, 1] / mean
        return cls(centre, axes, harmonics, table[0], table[1], span, rest[:, 0], amplitude_rest, shadow)

    @classmethod
    def followed(
        cls,
        u: np.ndarray,
        v: np.ndarray,
        eikonal: np.ndarray,
        amplitude: np.ndarray,
        nodes: PupilNodes,
        wavelength: float,
        shadows: np.ndarray | None,
        lit: np.ndarray,
    ) -> PupilStack:
        """``fit`` to pupils that edges cut, by polynomials of the first degree that follows all of them, or of that
        which leaves the least.

        Parameters
        ----------
        u : np.ndarray
            As of ``fit``, and so are those below.
        v : np.ndarray
            As of ``fit``.
        eikonal : np.ndarray
            As of ``fit``.
        amplitude : np.ndarray
            As of ``fit``.
        nodes : PupilNodes
            As of ``fit``.
        wavelength : float
            Of the light, metres.
        shadows : np.ndarray | None
            As of ``fit``.
        lit : np.ndarray
            As of ``fit``.
        """
        best: PupilStack | None = None
        for degree in CUT_DEGREES + (() if shadows is not None and shadows.shape[1] else MORE_DEGREES):
            if (degree + 1) * (degree + 2) // 2 > nodes.count:
                break
            stack = cls.fit(u, v, eikonal, amplitude, nodes, degree, shadows, RIM_SIDES, lit)
            if best is None or np.max(stack.residual) < np.max(best.residual):
                best = stack
            if np.all(stack.residual <= CUT_RESIDUAL * wavelength):
                break
        assert best is not None
        return best

    @property
    def bend(self) -> np.ndarray:
        """How far each edge is from an ellipse, (B,); ``transfer`` needs at most
        ``optics.waves.pupil_terms.WORST_BEND``.
        """
        last = len(self.harmonics) // 2
        return np.asarray(np.arange(-last, last + 1) ** 2 @ np.abs(self.harmonics) - 1.0)

    def take(self, which: np.ndarray | slice) -> PupilStack:
        """The pupils of the given indices."""
        return PupilStack(
            self.centre[which],
            self.axes[which],
            self.harmonics[:, which],
            self.eikonal_terms[which],
            self.amplitude_terms[which],
            self.span[which],
            self.residual[which],
            self.amplitude_residual[which],
            None if self.shadow is None else self.shadow.take(which),
        )

    def functions(self) -> tuple[PupilFunction, ...]:
        """Each pupil by itself."""
        return tuple(
            PupilFunction(
                self.centre[i],
                self.axes[i],
                PupilEdge(self.harmonics[:, i]),
                self.eikonal_terms[i],
                self.amplitude_terms[i],
                float(self.residual[i]),
                float(self.amplitude_residual[i]),
                None if self.shadow is None else self.shadow.take(slice(i, i + 1)),
            )
            for i in range(len(self.centre))
        )

    def transfer(self, frequency: np.ndarray, wavelengths: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Polychromatic transfer functions in the plane of the traced detector.

        Parameters
        ----------
        frequency : np.ndarray
            (M, 2) along the detector's two axes, cycles/m.
        wavelengths : np.ndarray
            (K,), metres.
        weights : np.ndarray
            (K,) share of the signal at each; they need not sum to 1.

        Returns
        -------
        np.ndarray
            Complex (B, M), 0 beyond the cut-off.

        Raises
        ------
        ValueError
            An edge that is far from an ellipse.
        """
        total = self._clear(frequency, wavelengths, weights / np.sum(weights))
        if self.shadow is not None:
            total = total + self._shadowed(self.shadow, frequency, wavelengths, weights / np.sum(weights))
        return np.asarray(total / self.power[:, None])

    def _shifts(self, frequency: np.ndarray, wavelengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normalised shifts, complex (B, K * M), and the wave numbers of each, (K * M,)."""
        steps = (wavelengths[:, None, None] * frequency).reshape(-1, 2)
        moved = np.linalg.solve(self.axes, np.broadcast_to(steps.T, (len(self.axes), 2, len(steps))))
        return moved[:, 0] + 1j * moved[:, 1], np.repeat(2.0 * np.pi / wavelengths, len(frequency))

    def _clear(self, frequency: np.ndarray, wavelengths: np.ndarray, share: np.ndarray) -> np.ndarray:
        """The integral over the overlaps of the clear pupils, mean over the band, (B, M)."""
        shift, wave = self._shifts(frequency, wavelengths)
        steps = shift.shape[1]
        edges = PupilEdge(np.repeat(self.harmonics, steps, axis=1))
        right, left, inside = edges.corners(shift.ravel())
        values = np.zeros(shift.shape, complex)
        for which, across, along in self._pieces(float(np.max(wave)), steps, _AT_ONCE):
            flat = (which[:, None] * steps + np.arange(steps)).ravel()
            part = PupilEdge(edges.harmonics[:, flat])
            rules = (gauss(count) for count in (across, along))
            points, weight = part.overlap(shift.ravel()[flat], right[:, flat], left[:, flat], *rules)
            shape = (len(which), steps, -1)
            values[which] = self.take(which)._sums(points.reshape(shape), weight.reshape(shape), shift[which], wave)
        values *= inside.reshape(shift.shape)
        return np.asarray(np.einsum("k,bkm->bm", share, values.reshape(len(values), len(share), len(frequency))))

    def _shadowed(
        self, shadow: PupilShadow, frequency: np.ndarray, wavelengths: np.ndarray, share: np.ndarray
    ) -> np.ndarray:
        """What the shadows add to ``_clear``."""
        shift, wave = self._shifts(frequency, wavelengths)
        values = np.zeros(shift.shape, complex)
        for which, _, along in self._pieces(float(np.max(wave)), 1, _SHADOWS_AT_ONCE):
            some, moved = self.take(which), shift[which]
            parts = shadow.take(which).parts(moved, LEAST_SHADOW + along - LEAST_ALONG)
            # light of whole pieces once for all shifts, of others and in the other pupil for every region by itself
            pieces, count = parts.whole.shape[1], len(parts.piece)
            other = parts.points - (parts.sign * moved[parts.pupil, parts.step])[:, None]
            owner = np.concatenate([np.repeat(np.arange(len(which)), pieces), parts.pupil, parts.pupil[count:]])
            every = np.concatenate([parts.whole.reshape(-1, other.shape[1]), other, parts.points[count:]])
            path, light = some._values_at(owner, every)
            first, last = len(which) * pieces, len(which) * pieces + len(other)
            own = np.concatenate([parts.pupil[:count] * pieces + parts.piece, np.arange(last, len(owner))])
            phase = (parts.sign * wave[parts.step])[:, None] * (path[own] - path[first:last])
            light = light[own] * light[first:last] * parts.weights
            at = parts.pupil * shift.shape[1] + parts.step
            real, imaginary = (
                np.bincount(at, np.einsum("fq,fq->f", part(phase), light), moved.size) for part in (np.cos, np.sin)
            )
            values[which] = (real + 1j * imaginary).reshape(moved.shape)
        return np.asarray(np.einsum("k,bkm->bm", share, values.reshape(len(values), len(share), len(frequency))))

    def _pieces(self, wave: float, shifts: int, points: int) -> Iterator[tuple[np.ndarray, int, int]]:
        """Pupils that take the same numbers of nodes, in pieces of bounded size."""
        along = np.array([nodes_for(float(span), LEAST_ALONG) for span in wave * self.span])
        for count in np.unique(along):
            rows = int(count) + LEAST_ACROSS - LEAST_ALONG
            some = np.flatnonzero(along == count)
            room = max(1, points // (shifts * rows * int(count)))
            for start in range(0, len(some), room):
                yield some[start : start + room], rows, int(count)

    def _sums(self, points: np.ndarray, weight: np.ndarray, shift: np.ndarray, wave: np.ndarray) -> np.ndarray:
        """Integrals over overlaps with points c and weights (B, S, Q), of shifts (B, S) at wave numbers (S,)."""
        half = 0.5 * shift[..., None]
        (path, light), (path_behind, light_behind) = (self._values(c) for c in (points + half, points - half))
        phase = wave[:, None] * (path - path_behind)
        light = light * light_behind * weight
        real, imaginary = (np.einsum("bsq,bsq->bs", part(phase), light) for part in (np.cos, np.sin))
        return np.asarray(real + 1j * imaginary)

    def _values(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Eikonal and amplitude at p (B, S, Q), of its shape."""
        eikonal, amplitude = (
            part.reshape(p.shape)
            for part in polynomials((self.eikonal_terms, self.amplitude_terms), p.reshape(len(p), -1))
        )
        return eikonal, amplitude

    def _values_at(self, owner: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values at places p (F, Q) of pupils (F,)."""
        order, place, most = in_rows(owner, len(self.axes))
        points = np.zeros((len(self.axes), most, p.shape[1]), complex)
        points[owner[order], place] = p[order]
        back = np.empty_like(order)
        back[order] = place
        step = max(1, _AT_ONCE // (most * p.shape[1]))
        parts = [slice(k, k + step) for k in range(0, len(points), step)]
        path, light = (np.concatenate(a) for a in zip(*(self.take(s)._values(points[s]) for s in parts), strict=True))
        return path[owner, back], light[owner, back]

    @property
    def light(self) -> np.ndarray:
        """Share of the clear pupils' light that the shadows leave, (B,)."""
        return np.asarray(self.power / self._clear_power)

    @cached_property
    def power(self) -> np.ndarray:
        """Integral of the amplitude's square over each pupil in p, (B,)."""
        if self.shadow is None:
            return self._clear_power
        points, weight = (a.reshape(len(self.axes), -1) for a in self.shadow.whole(LEAST_SHADOW + 2))
        return np.asarray(self._clear_power - np.sum(self._values(points[:, None])[1][:, 0] ** 2 * weight, axis=-1))

    @cached_property
    def _clear_power(self) -> np.ndarray:
        return clear_power(self.harmonics, self.amplitude_terms)


def clear_power(harmonics: np.ndarray, amplitude_terms: np.ndarray) -> np.ndarray:
    """Integral of the amplitude's square over pupils in p, no shadows in them, (B,).

    Parameters
    ----------
    harmonics : np.ndarray
        Of their edges, complex (2H + 1, B).
    amplitude_terms : np.ndarray
        As in ``PupilStack``, (B, D + 1, D + 1).
    """
    edges, nothing = PupilEdge(harmonics), np.zeros(len(amplitude_terms), complex)
    right, left, _ = edges.corners(nothing)
    points, weight = edges.overlap(nothing, right, left, gauss(24), gauss(12))
    (amplitude,) = polynomials([amplitude_terms], points)
    return np.asarray(np.sum(amplitude**2 * weight, axis=-1))


def _edges(terms: np.ndarray, degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres (B, 2), axes (B, 2, 2) and harmonics (2H + 1, B) of the images of the unit circle by maps (B, 2, K)."""
    samples = 4 * degree
    angle = 2.0 * np.pi * np.arange(samples) / samples
    rim = terms @ products(np.cos(angle), np.sin(angle), degree).T
    harmonic = np.fft.fft(rim, axis=-1) / samples
    centre = harmonic[..., 0].real
    # u = centre + 2 Re(h e^{ia}): the ellipse of the first harmonic
    axes = 2.0 * np.stack([harmonic[..., 1].real, -harmonic[..., 1].imag], axis=-1)
    place = np.linalg.solve(axes, rim - centre[..., None])
    order = np.arange(-degree, degree + 1)
    harmonics = (np.fft.fft(place[:, 0] + 1j * place[:, 1], axis=-1) / samples)[:, order].T
    harmonics[np.abs(order) <= 1] = np.array([0.0, 0.0, 1.0])[:, None]
    return centre, axes, harmonics


SHADOW_NODES = 8
"""Along each side of a shadow's box, for the light that it takes: the amplitude is nearly even."""


@dataclass(frozen=True, eq=False)
class PupilFunction:
    """Exit pupil of one image, in normalised coordinates p as complex numbers x + iy.

    Attributes
    ----------
    centre : np.ndarray
        Direction cosines (u, v) of p = 0, (2,).
    axes : np.ndarray
        d(u, v)/dp, (2, 2).
    edge : PupilEdge
        Of the pupil in p.
    eikonal_terms : np.ndarray
        Coefficients of T_i(x) T_j(y), metres, (D + 1, D + 1).
    amplitude_terms : np.ndarray
        Likewise of the amplitude density (unit power: its square integrates to 1 over du dv).
    eikonal_residual : float
        Rms eikonal that the fit leaves, metres.
    amplitude_residual : float
        Rms of what the fit leaves of the amplitude, share of its mean.
    shadow : PupilShadow | None
        What bodies in the beam take of the pupil (one pupil's), None if nothing stands there.
    finer : int
        Further nodes along each direction that its transfer function takes.
    transfer_error : float
        Change of that from fewer nodes; NaN where nobody has looked.
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
        """Normalised shift, complex, of shifts (x, y) of the direction cosines, any equal shapes."""
        (a, b), (c, d) = np.linalg.inv(self.axes)
        return np.asarray((a * x + b * y) + 1j * (c * x + d * y))

    def cosines(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Direction cosines (u, v, w) at p, of p's shape; w > 0 along the detector's normal, downstream."""
        u = self.centre[0] + self.axes[0, 0] * p.real + self.axes[0, 1] * p.imag
        v = self.centre[1] + self.axes[1, 0] * p.real + self.axes[1, 1] * p.imag
        return u, v, np.sqrt(np.maximum(1.0 - u * u - v * v, 0.0))

    def values(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Eikonal (metres) and amplitude density at p, of p's shape."""
        eikonal, amplitude = (
            part.reshape(p.shape)
            for part in polynomials((self.eikonal_terms[None], self.amplitude_terms[None]), p.reshape(1, -1))
        )
        return eikonal, amplitude

    def cutoff(self, direction: np.ndarray, wavelength: float) -> np.ndarray:
        """Cut-off frequencies, cycles/m, (M,), along directions (M, 2) in detector x, y (need not be unit)."""
        unit = np.asarray(direction) / np.linalg.norm(direction, axis=-1, keepdims=True)
        way = self.normalised(unit[..., 0], unit[..., 1])
        return np.asarray(self.edge.reach(np.angle(way))[0] / (np.abs(way) * wavelength))

    @cached_property
    def power(self) -> float:
        """Integral of the amplitude's square over du dv: 1 but for the fit, and for what the shadow takes."""
        if self.shadow is None:
            return self.clear_power
        # as the transfer function has it at frequency zero
        points, weight = self.shadow.overlap(np.zeros((1, 1), complex), SHADOW_NODES)
        return self.clear_power + float(np.sum(self.values(points)[1] ** 2 * weight) * abs(np.linalg.det(self.axes)))

    @property
    def light(self) -> float:
        """Share of the clear pupil's light that the shadow leaves."""
        return self.power / self.clear_power

    @cached_property
    def clear_power(self) -> float:
        """``power`` of the pupil without its shadow."""
        (power,) = clear_power(self.edge.harmonics[:, None], self.amplitude_terms[None])
        return float(power * abs(np.linalg.det(self.axes)))


def fit_pupils(
    field: PupilField,
    nodes: PupilNodes,
    degree: int = DEGREE,
    shadows: np.ndarray | None = None,
    lit: np.ndarray | None = None,
) -> tuple[PupilFunction, ...]:
    """Smooth pupils of B images.

    Parameters
    ----------
    field : PupilField
        Traced at ``nodes`` of the stop.
    nodes : PupilNodes
        Quadrature over the stop's unit disk, without a hole.
    degree : int
        Of the polynomials for the map from the stop, the eikonal and the amplitude; with ``lit`` that of the first of
        ``CUT_DEGREES`` that follows the light is taken.
    shadows : np.ndarray | None
        Polygons on the stop's unit disk that do not overlap, (B, K, V, 2); None for a free beam.
    lit : np.ndarray | None
        Which nodes lie outside of the shadows of edges, (B, N), as of ``PupilStack.fit``.

    Returns
    -------
    tuple[PupilFunction, ...]
        B pupils.

    Raises
    ------
    ValueError
        a node carries no light (a beam cut by another aperture than the stop is not modelled), too few nodes for the
        degree, an edge far from an ellipse, or a wavefront that the polynomials do not follow.
    """
    stopped = ~(field.amplitude > 0.0) & (True if lit is None else lit)
    dark = np.any(stopped, axis=-1)
    if np.any(dark):
        which = int(np.argmax(dark))
        share = float(np.mean(stopped[which]))
        raise UnphysicalError(
            f"{share:.1%} of the pupil of image {which} carries no light: a beam that another aperture than the stop "
            "cuts has no smooth pupil; enlarge that aperture or move the field point inward"
        )
    if lit is not None and np.any(few := np.sum(lit, axis=-1) < FEWEST_LIT):
        which = int(np.argmax(few))
        raise UnphysicalError(
            f"edges leave light at {int(np.sum(lit[which]))} of {nodes.count} rays of image {which}: too few to follow"
        )
    with one_blas_thread():
        traced = field.u, field.v, field.eikonal, field.amplitude, nodes
        if lit is None:
            stack = PupilStack.fit(*traced, degree, shadows, RIM_SIDES)
        else:
            stack = PupilStack.followed(*traced, field.wavelength, shadows, lit)
    worst = int(np.argmax(stack.residual))
    if stack.residual[worst] > WORST_RESIDUAL * field.wavelength:
        used, left = stack.eikonal_terms.shape[-1] - 1, stack.residual[worst] / field.wavelength
        raise UnphysicalError(
            f"polynomials of degree {used} leave {left:.2g} wavelengths rms of "
            f"the wavefront of image {worst} (at most {WORST_RESIDUAL:g}): it is too rough for a pupil"
        )
    return stack.functions()


def circular_pupil(f_number: float, eikonal_terms: np.ndarray | None = None) -> PupilFunction:
    """Evenly lit circular pupil of a telecentric image: its edge is at sqrt(u^2 + v^2) = 1 / (2 f_number).

    Parameters
    ----------
    f_number : float
        Of the beam.
    eikonal_terms : np.ndarray | None
        Wavefront over the unit disk as in ``PupilFunction``, metres; default none.
    """
    aperture = 0.5 / f_number
    flat = np.zeros((1, 1)) if eikonal_terms is None else np.asarray(eikonal_terms, float)
    amplitude = np.zeros_like(flat)
    amplitude[0, 0] = 1.0 / (np.sqrt(np.pi) * aperture)
    return PupilFunction(
        np.zeros(2), aperture * np.eye(2), PupilEdge(np.array([0.0, 0.0, 1.0], complex)), flat, amplitude
    )
