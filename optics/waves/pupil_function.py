"""The exit pupil of one image: one of a stack (``optics.waves.pupil_stack``), by itself."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optics.numerics.physical_error import PhysicalError, UnphysicalError
from optics.numerics.quadrature import PupilNodes
from optics.numerics.threads import one_blas_thread
from optics.waves.diffraction import PupilField
from optics.waves.pupil_edge import PupilEdge
from optics.waves.pupil_shadow import RIM_SIDES, PupilShadow
from optics.waves.pupil_stack import DEGREE, WORST_RESIDUAL, PupilStack, clear_power, polynomials

SHADOW_NODES = 8
"""Along each side of a shadow's box, for the light that it takes: the amplitude is nearly even."""


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


class RoughWavefrontError(PhysicalError, ValueError):
    """A wavefront that the polynomials of a pupil do not follow."""


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
        raise UnphysicalError(
            f"{share:.1%} of the pupil of image {which} carries no light: a beam that another aperture than the stop "
            "cuts has no smooth pupil; enlarge that aperture or move the field point inward"
        )
    with one_blas_thread():
        stack = PupilStack.fit(
            field.u, field.v, field.eikonal, field.amplitude, nodes, degree, shadows, rim_sides=RIM_SIDES
        )
    worst = int(np.argmax(stack.residual))
    if stack.residual[worst] > WORST_RESIDUAL * field.wavelength:
        raise RoughWavefrontError(
            f"polynomials of degree {degree} leave {stack.residual[worst] / field.wavelength:.2g} wavelengths rms of "
            f"the wavefront of image {worst} (at most {WORST_RESIDUAL:g}); raise the degree, with nodes enough for it"
        )
    return tuple(
        PupilFunction(
            stack.centre[i],
            stack.axes[i],
            PupilEdge(stack.harmonics[:, i]),
            stack.eikonal_terms[i],
            stack.amplitude_terms[i],
            float(stack.residual[i]),
            float(stack.amplitude_residual[i]),
            None if stack.shadow is None else stack.shadow.take(slice(i, i + 1)),
        )
        for i in range(len(field.u))
    )


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
