"""The exit pupil of one image as a smooth function: its edge, its eikonal and its amplitude over direction cosines.

A traced ``PupilField`` is a set of nodes that serves one quadrature. A transfer function needs the pupil between the
nodes and exactly up to its edge, so the field is fitted. In coordinates p, (u, v) = centre + axes @ p, the edge (the
image of the stop's rim) is the unit circle but for small harmonics,

    B(a) = exp(ia) + sum_n c_n exp(ina)    (x + iy, a = angle on the stop's rim),

and eikonal and amplitude are polynomials of p in products of Chebyshev polynomials. Through mirrors the eikonal in
metres does not depend on the wavelength, so one fit serves a whole band.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev

from optics.diffraction import PupilField
from optics.quadrature import PupilNodes

DEGREE = 8
"""Degree of the polynomials. The library's cameras, perturbed and with figure errors to third order on their mirrors,
leave less than 1e-5 wavelengths of eikonal."""

WORST_RESIDUAL = 1e-3
"""Rms eikonal that a fit may leave, wavelengths of the field; it changes the transfer function by about 2 (2 pi)^2 of
its square, 1e-4 at most."""

WORST_EDGE = 0.3
"""Largest sum of n^2 |c_n|: the edge stays convex and the iterations for its chords converge."""

_EDGE_SAMPLES = 64
_ITERATIONS = 60
_CLOSE = 1e-14


@dataclass(frozen=True, eq=False)
class PupilFunction:
    """Exit pupil of one image, in normalised coordinates p as complex numbers x + iy.

    Attributes:
        centre: direction cosines (u, v) of p = 0, (2,).
        axes: d(u, v)/dp, (2, 2).
        edge: harmonics c_-H .. c_H of the edge, complex, (2H + 1,); c_1 = 1, c_0 = c_-1 = 0.
        eikonal_terms: coefficients of T_i(x) T_j(y), metres, (D + 1, D + 1).
        amplitude_terms: likewise of the amplitude density (unit power: its square integrates to 1 over du dv).
        eikonal_residual: rms eikonal that the fit leaves, metres.
        amplitude_residual: rms of what the fit leaves of the amplitude, share of its mean.
    """

    centre: np.ndarray
    axes: np.ndarray
    edge: np.ndarray
    eikonal_terms: np.ndarray
    amplitude_terms: np.ndarray
    eikonal_residual: float = 0.0
    amplitude_residual: float = 0.0

    def normalised(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Normalised shift, complex, of shifts (x, y) of the direction cosines, any equal shapes."""
        (a, b), (c, d) = np.linalg.inv(self.axes)
        return np.asarray((a * x + b * y) + 1j * (c * x + d * y))

    def cosines(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Direction cosines (u, v, w) at p, of p's shape; w > 0 along the detector's normal, downstream."""
        u = self.centre[0] + self.axes[0, 0] * p.real + self.axes[0, 1] * p.imag
        v = self.centre[1] + self.axes[1, 0] * p.real + self.axes[1, 1] * p.imag
        return u, v, np.sqrt(1.0 - u * u - v * v)

    def values(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Eikonal (metres) and amplitude density at p, of p's shape."""
        x, y = (_chebyshev(part.ravel(), len(self.eikonal_terms) - 1) for part in (p.real, p.imag))
        eikonal, amplitude = (
            np.einsum("in,in->n", terms @ y, x).reshape(p.shape) for terms in (self.eikonal_terms, self.amplitude_terms)
        )
        return eikonal, amplitude

    def boundary(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Edge points B and dB/da at angles a of the stop's rim, complex, of the angles' shape."""
        last = len(self.edge) // 2
        turn = np.exp(1j * angle)
        point, slope, power = self.edge[last] + 0.0 * turn, 0.0 * turn, turn
        for n in range(1, last + 1):
            plus, minus = self.edge[last + n] * power, self.edge[last - n] * np.conj(power)
            point += plus + minus
            slope += 1j * n * (plus - minus)
            power = power * turn
        return point, slope

    def reach(self, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Longest chord along directions (radians, normalised coordinates), and its half angle (see ``_chord``).

        A shift by a longer way leaves no overlap of the pupil with itself: this is the cut-off.
        """
        half = np.full(np.shape(direction), 0.5 * np.pi)
        mean = np.asarray(direction) + 0.5 * np.pi
        back = np.exp(-1j * np.asarray(direction))
        for _ in range(_ITERATIONS):
            mean, length = self._chord(direction, mean, half)
            right, left = (self.boundary(mean + side * half)[1] * back for side in (-1.0, 1.0))
            # d(length)/d(offset) of the chord; Newton's step with the circle's second derivative
            step = -0.5 * (right.real / right.imag - left.real / left.imag)
            half = half + step
            if np.all(np.abs(step) < 1e-9):  # the length is at its maximum: its own error is the square
                break
        return self._chord(direction, mean, half)[1], half

    def cutoff(self, direction: np.ndarray, wavelength: float) -> np.ndarray:
        """Cut-off frequencies, cycles/m, (M,), along directions (M, 2) in detector x, y (need not be unit)."""
        unit = np.asarray(direction) / np.linalg.norm(direction, axis=-1, keepdims=True)
        way = self.normalised(unit[..., 0], unit[..., 1])
        return np.asarray(self.reach(np.angle(way))[0] / (np.abs(way) * wavelength))

    def _chord(self, direction: np.ndarray, mean: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Chord along ``direction`` between the edge's angles mean - half and mean + half.

        B(m - d) - B(m + d) = 2 sin d exp(i direction) H, H = -i exp(-i direction) sum c_n exp(inm) sin(nd) / sin d. A
        given d in [0, pi] (from the tangent chord on one side to that on the other) has one m with real H; it is well
        conditioned also where the chord shrinks to a point.

        Args:
            direction: (S,).
            mean: start, (S,).
            half: (S,).

        Returns:
            Mean angle and length, negative for negative ``half``, (S,) each.
        """
        last = len(self.edge) // 2
        factor = -1j * np.exp(-1j * np.asarray(direction))
        cos = np.cos(half)
        for _ in range(_ITERATIONS):
            turn = np.exp(1j * mean)
            value, slope = np.zeros_like(turn), np.zeros_like(turn)
            power, ratio, before = turn, np.ones_like(cos), np.zeros_like(cos)
            for n in range(1, last + 1):
                plus, minus = self.edge[last + n] * power, self.edge[last - n] * np.conj(power)
                value += ratio * (plus - minus)
                slope += (1j * n) * ratio * (plus + minus)
                power = power * turn
                ratio, before = 2.0 * cos * ratio - before, ratio  # sin(nd)/sin d: Chebyshev's second kind
            value, slope = factor * value, factor * slope
            step = value.imag / slope.imag
            mean = mean - step
            if np.all(np.abs(step) < 1e-7):  # Newton: the next error is its square
                break
        return mean, 2.0 * np.sin(half) * (value.real - step * slope.real)

    def corners(self, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where the edges of two copies of the pupil, shifted by s, cross.

        Args:
            shift: normalised shifts s, complex, (S,).

        Returns:
            Angles a (2, S) and b (2, S) with B(a) - B(b) = s at both crossings, and whether there is an overlap, (S,).
        """
        direction, size = np.angle(shift), np.abs(shift)
        longest, middle = self.reach(direction)
        inside = size < longest
        want = np.arccos(np.minimum(size / longest, 1.0))
        out = []
        for sign in (-1.0, 1.0):
            way, mean = want.copy(), direction + 0.5 * np.pi
            for _ in range(_ITERATIONS):
                half = middle + sign * way
                mean, length = self._chord(direction, mean, half)
                if np.all((np.abs(length - size) < _CLOSE * 10) | ~inside):
                    break
                way = way + want - np.arccos(np.clip(length / longest, -1.0, 1.0))
            out.append((mean - half, mean + half))
        return np.stack([a for a, _ in out]), np.stack([b for _, b in out]), inside

    def overlap(
        self, shift: np.ndarray, right: np.ndarray, left: np.ndarray, across: tuple[np.ndarray, np.ndarray], along: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Quadrature over the overlap of the pupil shifted by -s/2 and by +s/2.

        The region lies between two arcs of the edge that meet in the corners. Straight lines between points of equal
        parameter t on the arcs sweep it smoothly, so that Gauss' rules in t and along the lines converge exponentially.

        Args:
            shift: (S,) normalised.
            right, left: angles a and b of ``corners``, (2, S).
            across: points and weights in t over [-1, 1], (I,) each.
            along: likewise on the lines, (J,) each.

        Returns:
            Points c, complex, (S, I * J), such that c - s/2 and c + s/2 are in the pupil, and area weights in p.
        """
        t = across[0]
        arcs = []
        for ends, side in ((right, -0.5), (left, 0.5)):
            speed = 0.5 * (ends[1] - ends[0])
            point, slope = self.boundary(0.5 * (ends[0] + ends[1])[:, None] + speed[:, None] * t)
            arcs.append((point + side * shift[:, None], slope * speed[:, None]))
        (a, da), (b, db) = arcs
        share = 0.5 * (1.0 + along[0])
        span = (a - b)[..., None]
        points = b[..., None] + span * share
        speed = db[..., None] + (da - db)[..., None] * share
        area = 0.5 * np.abs(speed.real * span.imag - speed.imag * span.real)
        weight = area * (across[1][:, None] * along[1])
        return points.reshape(len(shift), -1), weight.reshape(len(shift), -1)

    @cached_property
    def power(self) -> float:
        """Integral of the amplitude's square over du dv: 1 but for the fit."""
        rule = np.polynomial.legendre.leggauss(32)
        shift = np.zeros(1, complex)
        right, left, _ = self.corners(shift)
        points, weight = self.overlap(shift, right, left, rule, rule)
        return float(np.sum(self.values(points)[1] ** 2 * weight) * abs(np.linalg.det(self.axes)))


def fit_pupils(field: PupilField, nodes: PupilNodes, degree: int = DEGREE) -> tuple[PupilFunction, ...]:
    """Smooth pupils of B images.

    Args:
        field: traced at ``nodes`` of the stop.
        nodes: quadrature over the stop's unit disk, without a hole.
        degree: of the polynomials for the map from the stop, the eikonal and the amplitude.

    Returns:
        B pupils.

    Raises:
        ValueError: a node carries no light (a beam cut by another aperture than the stop is not modelled), too few
            nodes for the degree, an edge far from an ellipse, or a wavefront that the polynomials do not follow.
    """
    dark = np.any(field.amplitude == 0.0, axis=-1)
    if np.any(dark):
        which = int(np.argmax(dark))
        share = float(np.mean(field.amplitude[which] == 0.0))
        raise ValueError(
            f"{share:.1%} of the pupil of image {which} carries no light: a beam that another aperture than the stop "
            "cuts has no smooth pupil; enlarge that aperture or move the field point inward"
        )
    root = np.sqrt(nodes.weight)
    stop = _design(nodes.x, nodes.y, degree) * root[:, None]
    if nodes.count < stop.shape[1] or np.linalg.matrix_rank(stop) < stop.shape[1]:
        raise ValueError(f"{nodes.count} nodes do not determine polynomials of degree {degree}; trace more rings, arms")
    solve = np.linalg.pinv(stop)
    angle = 2.0 * np.pi * np.arange(_EDGE_SAMPLES) / _EDGE_SAMPLES
    rim = _design(np.cos(angle), np.sin(angle), degree)
    out = []
    for i in range(len(field.u)):
        maps = [_terms(solve @ (root * cosine[i]), degree) for cosine in (field.u, field.v)]
        centre, axes, edge = _edge(rim, maps, degree)
        jacobian = _jacobian(maps, nodes)
        density = field.amplitude[i] / (nodes.weight * np.abs(jacobian))
        x, y = np.linalg.solve(axes, np.stack([field.u[i] - centre[0], field.v[i] - centre[1]]))
        design = _design(x, y, degree) * root[:, None]
        both = np.stack([field.eikonal[i], density], axis=-1) * root[:, None]
        solution = np.linalg.lstsq(design, both, rcond=None)[0]
        rest = np.sqrt(np.sum((both - design @ solution) ** 2, axis=0) / np.sum(nodes.weight))
        if rest[0] > WORST_RESIDUAL * field.wavelength:
            raise ValueError(
                f"polynomials of degree {degree} leave {rest[0] / field.wavelength:.2g} wavelengths rms of the "
                f"wavefront of image {i} (at most {WORST_RESIDUAL:g}); raise the degree, with nodes enough for it"
            )
        terms = [_terms(column, degree) for column in solution.T]
        out.append(PupilFunction(centre, axes, edge, *terms, float(rest[0]), float(rest[1] / np.mean(density))))
    return tuple(out)


def circular_pupil(f_number: float, eikonal_terms: np.ndarray | None = None) -> PupilFunction:
    """Evenly lit circular pupil of a telecentric image: its edge is at sqrt(u^2 + v^2) = 1 / (2 f_number).

    Args:
        f_number: of the beam.
        eikonal_terms: wavefront over the unit disk as in ``PupilFunction``, metres; default none.
    """
    aperture = 0.5 / f_number
    flat = np.zeros((1, 1)) if eikonal_terms is None else np.asarray(eikonal_terms, float)
    amplitude = np.zeros_like(flat)
    amplitude[0, 0] = 1.0 / (np.sqrt(np.pi) * aperture)
    return PupilFunction(np.zeros(2), aperture * np.eye(2), np.array([0.0, 0.0, 1.0], complex), flat, amplitude)


def _edge(rim: np.ndarray, maps: list[np.ndarray], degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre, axes and harmonics of the image of the unit circle under a polynomial map."""
    u, v = (rim @ _column(terms, degree) for terms in maps)
    harmonic = np.fft.fft(np.stack([u, v]), axis=-1) / _EDGE_SAMPLES
    centre = harmonic[:, 0].real
    # u = centre + 2 Re(h e^{ia}): the ellipse of the first harmonic
    axes = 2.0 * np.stack([harmonic[:, 1].real, -harmonic[:, 1].imag], axis=-1)
    x, y = np.linalg.solve(axes, np.stack([u, v]) - centre[:, None])
    every = np.fft.fft(x + 1j * y) / _EDGE_SAMPLES
    order = np.arange(-degree, degree + 1)
    edge = every[order]
    edge[np.abs(order) <= 1] = [0.0, 0.0, 1.0]
    bend = float(np.sum(order**2 * np.abs(edge)) - 1.0)
    if bend > WORST_EDGE:
        raise ValueError(f"the pupil's edge is too far from an ellipse: sum n^2 |c_n| = {bend:.2g}, over {WORST_EDGE}")
    return centre, axes, edge


def _jacobian(maps: list[np.ndarray], nodes: PupilNodes) -> np.ndarray:
    """Determinant of d(u, v)/d(x, y) at the nodes."""
    (ux, uy), (vx, vy) = (
        [chebyshev.chebval2d(nodes.x, nodes.y, chebyshev.chebder(terms, axis=axis)) for axis in (0, 1)]
        for terms in maps
    )
    return np.asarray(ux * vy - uy * vx)


def _chebyshev(x: np.ndarray, degree: int) -> np.ndarray:
    """T_0 .. T_degree of x (N,), shape (degree + 1, N)."""
    out = np.empty((degree + 1, len(x)))
    out[0] = 1.0
    if degree:
        out[1] = x
    for n in range(2, degree + 1):
        np.multiply(x, out[n - 1], out=out[n])
        out[n] *= 2.0
        out[n] -= out[n - 2]
    return out


def _orders(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Orders (i, j) with i + j <= degree, (K,) each."""
    i, j = np.indices((degree + 1, degree + 1))
    keep = i + j <= degree
    return i[keep], j[keep]


def _design(x: np.ndarray, y: np.ndarray, degree: int) -> np.ndarray:
    """Products T_i(x) T_j(y) with i + j <= degree, (N, K)."""
    i, j = _orders(degree)
    return np.asarray((_chebyshev(x, degree)[i] * _chebyshev(y, degree)[j]).T)


def _terms(column: np.ndarray, degree: int) -> np.ndarray:
    """Coefficients as a square array by orders (i, j), zero beyond the degree."""
    out = np.zeros((degree + 1, degree + 1))
    out[_orders(degree)] = column
    return out


def _column(terms: np.ndarray, degree: int) -> np.ndarray:
    return np.asarray(terms[_orders(degree)])


