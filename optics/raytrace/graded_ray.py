"""Curved rays where the refractive index has a gradient.

With d tau = ds / n the ray equation d/ds (n dr/ds) = grad n becomes r'' = n grad n. For n = n0 + g . (r - r0) the index
along the ray obeys n'' = |g|^2 n, so that

    n(tau) = n0 cosh x + a/|g| sinh x,    x = |g| tau,  a = g . T0,  T0 = n0 d0,
    r(tau) = r0 + T0 tau + g [n0 (cosh x - 1) / |g|^2 + a (sinh x / |g| - tau) / |g|^2],
    optical path = integral of n^2 d tau.

The hyperbolic functions are taken as their power series, which have no 0/0 at g = 0. (Born and Wolf,
Principles of Optics, section 3.2, for the ray equation.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from optics.geometry.surface import SurfaceNumbers, level
from optics.numerics.number_tree import map_leaves


@dataclass(frozen=True, eq=False)
class GradedRay:
    """A curved ray, as Dr.Jit arrays in the frame of the element that it goes to.

    Attributes:
        origin: r0, metres.
        tangent: T0 = n0 d0, d0 a unit vector.
        index: n0 at the origin.
        gradient: components of g, 1/m.
        along: a = g . T0.
        square: |g|^2.
    """

    origin: Any
    tangent: Any
    index: Any
    gradient: tuple[Any, Any, Any]
    along: Any
    square: Any

    @classmethod
    def start(cls, p: Any, d: Any, index_at_zero: Any, gradient: tuple[Any, Any, Any]) -> GradedRay:
        """The ray from p along the unit vector d, where the index is index_at_zero + gradient . p."""
        gx, gy, gz = gradient
        index = index_at_zero + gx * p.x + gy * p.y + gz * p.z
        tangent = index * d
        along = gx * tangent.x + gy * tangent.y + gz * tangent.z
        return cls(p, tangent, index, gradient, along, gx * gx + gy * gy + gz * gz)

    def detached(self) -> GradedRay:
        """Return the rays without derivatives."""
        import drjit as dr

        return GradedRay(
            dr.detach(self.origin),
            dr.detach(self.tangent),
            dr.detach(self.index),
            tuple(dr.detach(g) for g in self.gradient),
            dr.detach(self.along),
            dr.detach(self.square),
        )

    def position(self, tau: Any) -> Any:
        """r(tau), metres."""
        x2 = self.square * tau * tau
        even = 0.5 * tau * tau * (1.0 + x2 / 12.0 * (1.0 + x2 / 30.0))
        odd = tau * tau * tau / 6.0 * (1.0 + x2 / 20.0 * (1.0 + x2 / 42.0))
        return self._add(self.origin + self.tangent * tau, self.index * even + self.along * odd)

    def slope(self, tau: Any) -> Any:
        """dr/dtau = n times the unit direction."""
        x2 = self.square * tau * tau
        odd = tau * (1.0 + x2 / 6.0 * (1.0 + x2 / 20.0))
        even = 0.5 * tau * tau * (1.0 + x2 / 12.0 * (1.0 + x2 / 30.0))
        return self._add(self.tangent, self.index * odd + self.along * even)

    def direction(self, tau: Any) -> Any:
        """Unit direction at r(tau)."""
        import drjit as dr

        return dr.normalize(self.slope(tau))

    def optical_path(self, tau: Any) -> Any:
        """Integral of n ds from the origin, metres."""
        y = 4.0 * self.square * tau * tau
        first = tau * (1.0 + y / 12.0 * (1.0 + y / 20.0 * (1.0 + y / 42.0)))
        second = tau * tau * (1.0 + y / 12.0 * (1.0 + y / 30.0))
        third = tau * tau * tau / 3.0 * (1.0 + y / 20.0 * (1.0 + y / 42.0))
        n, a = self.index, self.along
        return n * n * first + a * n * second + a * a * third

    def _add(self, vector: Any, amount: Any) -> Any:
        gx, gy, gz = self.gradient
        return type(vector)(vector.x + amount * gx, vector.y + amount * gy, vector.z + amount * gz)


def meeting(curve: GradedRay, tau: Any, surface: SurfaceNumbers, table: Any, attached: bool, steps: int) -> Any:
    """Parameter at which a curved ray meets the surface, by Newton's method from the straight ray's."""
    import drjit as dr

    def step(ray: GradedRay, tau: Any, numbers: SurfaceNumbers) -> Any:
        p, slope = ray.position(tau), ray.slope(tau)
        value, nx, ny, nz = level(p.x, p.y, p.z, numbers, table)
        return tau - value / dr.fma(nx, slope.x, dr.fma(ny, slope.y, nz * slope.z))

    numbers, ray = surface, curve
    if attached:
        numbers = map_leaves(dr.detach, surface)
        ray, tau = curve.detached(), dr.detach(tau)
    for _ in range(steps):
        tau = step(ray, tau, numbers)
    return step(curve, tau, surface) if attached else tau
