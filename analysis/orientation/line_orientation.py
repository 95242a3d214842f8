"""Interior orientation in the terms in which three-line cameras are described: principal distance f, principal point y0
and radial distortion k1 that is added to measured places.

A point of the line at y looks, from the camera's Z, at

    tan theta = (y - y0) (1 + k1 (y - y0)^2) / f        (Brown, Photogramm. Eng. 37(8), 1971)

and a test reads W = axis + theta, where `axis` is the reading of the camera's Z, counted from the zero of the test. To
lowest order these are the terms of `distortion_model`: k1 = -k3 / f^3 (the other sign: a pincushion, k3 > 0, images
farther out than f tan W, so that places have to be moved inward), y0 (1 + 3 k3 / f) = p (a shift of the distortion's
centre is a tan^2 term as well), axis = (y0 - c) / f. The f is that of the model with k3, the slope in the middle of the
field, and not the balanced one of paper 004's eq. (3), the slope that leaves the smallest distortion: over a field of
+- W they differ by about 0.6 k3 tan^2 W.

Angles in radians, lengths in metres, k1 in 1/m^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.orientation.distortion_model import OrientationError
from analysis.orientation.interior import InteriorOrientation, gain

__all__ = ["LINE_TERMS", "LineOrientation", "line_orientation"]

Array = NDArray[np.float64]
LINE_TERMS = ("axis", "focal_length", "principal_point", "k1")
"""Names of the unknowns; the last three are keys of a payload's line."""
_STEPS = 20


@dataclass(frozen=True, eq=False)
class LineOrientation:
    """Fit of `LINE_TERMS`.

    values: (4,) rad, m, m, 1/m^2. covariance: (4, 4) in these units. residual: (N,) m, places minus model.
    """

    values: Array
    covariance: Array
    residual: Array

    def look_angle(self, position: ArrayLike) -> Array:
        """W (...), rad, that images to positions (...), m."""
        return _model(self.values, np.asarray(position, np.float64))[0]

    @property
    def sigma(self) -> Array:
        """Standard deviations of the values, (4,)."""
        return np.sqrt(np.diagonal(self.covariance))


def _model(values: Array, position: Array) -> tuple[Array, Array, Array]:
    """W (N,), its derivatives by the values (N, 4), and dL/dW (N,)."""
    axis, f, point, k1 = values
    u = position - point
    tangent = u * (1.0 + k1 * u**2) / f
    turn = 1.0 / (1.0 + tangent**2)
    steep = (1.0 + 3.0 * k1 * u**2) / f * turn
    columns = np.stack([np.ones_like(u), -tangent / f * turn, -steep, u**3 / f * turn], axis=-1)
    return np.asarray(axis + np.arctan(tangent)), columns, np.asarray(1.0 / steep)


def line_orientation(fit: InteriorOrientation) -> LineOrientation:
    """The same points and noise in these terms, by least squares in the image, all points alike.

    Args:
        fit: with constant, principal_distance, principal_point and radial3 and no other terms, which it starts from.

    Raises:
        OrientationError: other terms, or no convergence.
    """
    if set(fit.terms) != {"constant", "principal_distance", "principal_point", "radial3"}:
        raise OrientationError(f"interior orientation: no line's orientation follows from the terms {fit.terms}")
    c, f, p, k3 = (fit.value(name) for name in ("constant", "principal_distance", "principal_point", "radial3"))
    point = p / (1.0 + 3.0 * k3 / f)
    values = np.array([(point - c) / f, f, point, -k3 / f**3])
    for _ in range(_STEPS):
        angle, columns, rate = _model(values, fit.position)
        solve = gain(columns * rate[:, None])
        step = solve @ ((fit.angle - angle) * rate)
        values = values + step
        spread = solve @ fit.noise @ solve.T
        if np.all(np.abs(step) < 1e-6 * np.sqrt(np.diagonal(spread))):
            angle, _, rate = _model(values, fit.position)
            return LineOrientation(values, spread, -(fit.angle - angle) * rate)
    raise OrientationError("interior orientation: the line's principal point and distortion do not converge")
