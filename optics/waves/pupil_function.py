"""The exit pupil of one image as a smooth function: its edge, its eikonal and its amplitude over direction cosines.

A traced ``PupilField`` is a set of nodes that serves one quadrature. A transfer function needs the pupil between the
nodes and exactly up to its edge, so the field is fitted. In coordinates p, (u, v) = centre + axes @ p, the edge is the
unit circle but for small harmonics (``optics.waves.pupil_edge``), shadows of bodies that stand in the beam are polygons
(``optics.waves.pupil_shadow``), and eikonal and amplitude are polynomials in products of
Chebyshev's. Through mirrors the eikonal in metres does not depend on the wavelength, so one fit serves a whole band.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev

from optics.numerics.quadrature import PupilNodes, gauss
from optics.numerics.threads import one_blas_thread
from optics.waves.diffraction import PupilField
from optics.waves.pupil_edge import PupilEdge
from optics.waves.pupil_shadow import PupilShadow

DEGREE = 8
"""Degree of the polynomials. The library's gf7 leaves 1e-8 wavelengths of eikonal, nominal or perturbed; with 5 nm of
every Zernike term to seventh order on each mirror it leaves 2e-5."""

WORST_RESIDUAL = 1e-3
"""Rms eikonal that a fit may leave, wavelengths of the field; it changes the transfer function by about (2 pi)^2 of
its square, 4e-5, where the overlap averages over it."""

SHADOW_NODES = 8
"""Along each side of a shadow's box, for the light that it takes: the amplitude is nearly even."""

_EDGE_SAMPLES = 64


@dataclass(frozen=True, eq=False)
class PupilFunction:
    """Exit pupil of one image, in normalised coordinates p as complex numbers x + iy.

    Attributes:
        centre: direction cosines (u, v) of p = 0, (2,).
        axes: d(u, v)/dp, (2, 2).
        edge: of the pupil in p.
        eikonal_terms: coefficients of T_i(x) T_j(y), metres, (D + 1, D + 1).
        amplitude_terms: likewise of the amplitude density (unit power: its square integrates to 1 over du dv).
        eikonal_residual: rms eikonal that the fit leaves, metres.
        amplitude_residual: rms of what the fit leaves of the amplitude, share of its mean.
        shadow: what bodies in the beam take of the pupil (one pupil's), None if nothing stands there.
    """

    centre: np.ndarray
    axes: np.ndarray
    edge: PupilEdge
    eikonal_terms: np.ndarray
    amplitude_terms: np.ndarray
    eikonal_residual: float = 0.0
    amplitude_residual: float = 0.0
    shadow: PupilShadow | None = None

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
        rule = gauss(32)
        shift = np.zeros(1, complex)
        right, left, _ = self.edge.corners(shift)
        points, weight = self.edge.overlap(shift, right, left, rule, rule)
        return float(np.sum(self.values(points)[1] ** 2 * weight) * abs(np.linalg.det(self.axes)))


def fit_pupils(
    field: PupilField, nodes: PupilNodes, degree: int = DEGREE, shadows: np.ndarray | None = None
) -> tuple[PupilFunction, ...]:
    """Smooth pupils of B images.

    Args:
        field: traced at ``nodes`` of the stop.
        nodes: quadrature over the stop's unit disk, without a hole.
        degree: of the polynomials for the map from the stop, the eikonal and the amplitude.
        shadows: polygons on the stop's unit disk that do not overlap, (B, K, V, 2); None for a free beam.

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
    with one_blas_thread():
        return _fit(field, nodes, degree, shadows)


def _fit(field: PupilField, nodes: PupilNodes, degree: int, shadows: np.ndarray | None) -> tuple[PupilFunction, ...]:
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
        eikonal, amplitude = (_terms(column, degree) for column in solution.T)
        residuals = float(rest[0]), float(rest[1] / np.mean(density))
        shadow = None
        if shadows is not None and shadows.shape[1]:
            x, y = shadows[i].reshape(-1, 2).T
            u, v = (_design(x, y, degree) @ _column(terms, degree) for terms in maps)
            corners = np.linalg.solve(axes, np.stack([u, v]) - centre[:, None]).T.reshape(1, *shadows.shape[1:])
            shadow = PupilShadow.within(corners, edge.harmonics[:, None])
        out.append(PupilFunction(centre, axes, edge, eikonal, amplitude, *residuals, shadow))
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
    return PupilFunction(
        np.zeros(2), aperture * np.eye(2), PupilEdge(np.array([0.0, 0.0, 1.0], complex)), flat, amplitude
    )


def _edge(rim: np.ndarray, maps: list[np.ndarray], degree: int) -> tuple[np.ndarray, np.ndarray, PupilEdge]:
    """Centre, axes and edge of the image of the unit circle under a polynomial map."""
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
    return centre, axes, PupilEdge(edge)


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
