"""Rational polynomials corrected by control points: what is off in the image, with its covariance and residuals, and
polynomials of the same form with the correction inside.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from analysis.arrays import Array
from analysis.orbit.image_correction import ImageCorrection, Kind, image_correction
from twin.orbit.export.rational_polynomial import RationalPolynomial, axis_sigma
from twin.orbit.flight.earth import Earth, curvature_radii, east_north_up

_STEP = 10.0
"""Metres on the ground of a derivative: polynomials are straight to 1e-9 over it."""
_GRID = (21, 21, 7)
"""Lines, samples and heights through which corrected polynomials go."""
_GROUND_GRID = 5
_UNLIKELY = 0.05
"""Chance of a chi-square from which residuals scatter beyond their covariances."""


@dataclass(frozen=True, eq=False)
class ControlledPolynomial:
    """Polynomials, and how control points corrected them.

    Attributes:
        before: as they were.
        correction: in the image.
        after: with it, ERR_BIAS and ERR_RAND of what is uncertain of them.
    """

    before: RationalPolynomial
    correction: ImageCorrection
    after: RationalPolynomial


def polynomial_correction(
    polynomial: RationalPolynomial,
    itrs: Array,
    ground_covariance: Array,
    measured: Array,
    image_covariance: Array,
    kind: Kind,
    screened: bool = True,
) -> ImageCorrection:
    """By how much polynomials are off in the image.

    Args:
        polynomial: of the image.
        itrs: (N, 3) of the points, metres.
        ground_covariance: (N, 3, 3) in its axes, m^2.
        measured: (N, 2) line and sample, the centre of the first pixel being 0, 0.
        image_covariance: (N, 2, 2), pixels^2.
        kind: of the correction, shift or affine.
        screened: whether points far beyond their covariances are left out.

    Raises:
        ValueError: as `analysis.orbit.image_correction.image_correction`.
    """
    longitude, latitude, height = Earth().geodetic(itrs)
    slope = image_slope(polynomial, latitude, longitude, height) @ east_north_up(longitude, latitude)
    spread = image_covariance + slope @ ground_covariance @ np.swapaxes(slope, 1, 2)
    predicted = np.stack(polynomial.image(np.degrees(latitude), np.degrees(longitude), height), axis=-1)
    return image_correction(predicted, measured, spread, kind, screened)


def controlled(polynomial: RationalPolynomial, correction: ImageCorrection) -> ControlledPolynomial:
    """Polynomials with a correction inside.

    Args:
        polynomial: of the image.
        correction: that was found for it.

    Raises:
        ValueError: polynomials that do not lead back to the ground, ground at a pole or the 180th meridian.
    """
    return ControlledPolynomial(polynomial, correction, _corrected(polynomial, correction))


def image_slope(polynomial: RationalPolynomial, latitude: Array, longitude: Array, height: Array) -> Array:
    """Derivatives of line and sample by metres east, north and up, (N, 2, 3), at places (N,) in radians and metres."""
    meridian, normal = curvature_radii(latitude)
    moves = (
        (0.0, _STEP / ((normal + height) * np.cos(latitude)), 0.0),
        (_STEP / (meridian + height), 0.0, 0.0),
        (0.0, 0.0, _STEP),
    )
    columns = []
    for north, east, up in moves:
        ends = [
            np.stack(
                polynomial.image(
                    np.degrees(latitude + sign * north), np.degrees(longitude + sign * east), height + sign * up
                ),
                axis=-1,
            )
            for sign in (0.5, -0.5)
        ]
        columns.append((ends[0] - ends[1]) / _STEP)
    return np.stack(columns, axis=-1)


def _corrected(polynomial: RationalPolynomial, correction: ImageCorrection) -> RationalPolynomial:
    """Polynomials with the correction inside, and what is uncertain of them on the ground."""
    grids = []
    for at_ends in (True, False):
        counts = _GRID if at_ends else tuple(count - 1 for count in _GRID)
        axes = [
            polynomial.offset[k] - polynomial.scale[k] * np.cos(_angles(count, at_ends))
            for k, count in zip((0, 1, 4), counts, strict=True)
        ]
        line, sample, height = (v.ravel() for v in np.meshgrid(*axes, indexing="ij"))
        latitude, longitude = polynomial.ground(line, sample, height)
        seen = np.isfinite(latitude)
        moved = np.stack([line, sample], axis=-1) + correction.at(line, sample)
        grids.append(np.stack([*moved.T, latitude, longitude, height], axis=-1)[seen])
    if min(map(len, grids)) < np.prod(_GRID) // 2:
        raise ValueError("the polynomials do not lead back to the ground over the image that they state")
    bias, random = _on_the_ground(polynomial, correction)
    return replace(RationalPolynomial.through(*grids), bias_m=bias, random_m=random)


def _angles(count: int, at_ends: bool) -> Array:
    """Of Chebyshev's places."""
    return np.linspace(0.0, np.pi, count) if at_ends else (np.arange(count) + 0.5) * np.pi / count


def _on_the_ground(polynomial: RationalPolynomial, correction: ImageCorrection) -> tuple[float, float]:
    """Root mean square errors of a horizontal axis over the image, metres: of the correction, and of what scatters at
    the control points beyond their own covariances.
    """
    steps = np.linspace(-1.0, 1.0, _GROUND_GRID)
    line, sample = (
        v.ravel()
        for v in np.meshgrid(*(polynomial.offset[k] + polynomial.scale[k] * steps for k in (0, 1)), indexing="ij")
    )
    height = np.full_like(line, polynomial.offset[4])
    latitude, longitude = (np.radians(v) for v in polynomial.ground(line, sample, height))
    seen = np.isfinite(latitude)
    slope = image_slope(polynomial, latitude[seen], longitude[seen], height[seen])[:, :, :2]
    to_ground = np.linalg.inv(slope)
    used = correction.used
    own = np.einsum("nii->ni", correction.variance)[used]
    beyond = np.zeros(2)
    if correction.probability < _UNLIKELY:
        beyond = np.maximum(np.mean(correction.residual[used] ** 2 - own, axis=0), 0.0)
    known = correction.covariance_at(line[seen], sample[seen])
    found = []
    for variance in (known, np.broadcast_to(np.diag(beyond), known.shape)):
        found.append(axis_sigma(to_ground @ variance @ np.swapaxes(to_ground, 1, 2)))
    return found[0], found[1]


def residual_sigma(correction: ImageCorrection) -> Array:
    """(N, 2) standard deviations of the residuals of line and sample, pixels."""
    return np.sqrt(np.maximum(np.einsum("nii->ni", correction.variance), 0.0))
