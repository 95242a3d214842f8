"""Interior orientation of a line camera from (angle, position) pairs, and whether its principal point is observable.

Over a narrow field tan^2 W is tiny: an error of 1 um at the edge of +-1.25 deg is 2 mm of p. Paper 004 solves for p all
the same (eq. 2) and remarks that p is about a pixel; this says with numbers when p = 0 (eq. 3) is the better choice.

`fit_interior_orientation` fits the model of `distortion_model` (paper 004, eqs. 1-4, with a constant and
radial terms). Errors of a turntable are common to many points (eccentricity, graduation, the zero), so the noise is a
full covariance. The paper weights all points alike; its estimates stay unbiased under such noise, but sigmas from the
scatter of the residuals are wrong, for a common error hides in the parameters. Here every sigma comes from the given
covariance (sandwich). Generalised least squares, which has the smallest sigmas, serves for chi-square.

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

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from analysis.arrays import Array
from analysis.orientation.distortion_model import OrientationError, design, readings, slope

# With columns of length one, the worst combination of terms has this many times the sigma of the best. Five terms over
# half a field have 270; f and a constant reach 1000 when the angles lie within 1 % of each other.
_WORST_CONDITION = 1e3


def gain(columns: Array, root: Array | None = None) -> Array:
    """Least-squares inverse (P, N) of columns (N, P): all points alike, or generalised least squares.

    root: (N, N) from `_noise_root`. Columns are scaled to length one, for powers of tan W differ by magnitudes.
    """
    white = columns if root is None else np.linalg.solve(root, columns)
    length = np.linalg.norm(white, axis=0)
    inverse = np.linalg.pinv(white / length) / length[:, None]
    return np.asarray(inverse if root is None else inverse @ np.linalg.inv(root), dtype=np.float64)


def _check_separable(columns: Array, names: tuple[str, ...], angle: Array) -> None:
    """OrientationError, naming the terms that take part in the worst combination, where angles do not separate them.

    Args:
        columns: of the design, (N, P).
        names: of the terms.
        angle: (N,), rad.
    """
    length = np.linalg.norm(columns, axis=0)
    _, values, vt = np.linalg.svd(columns / np.where(length > 0, length, 1.0))
    condition = float(values[0] / max(values[-1], 1e-300))
    if condition <= _WORST_CONDITION:
        return
    part = np.abs(vt[-1]) / np.max(np.abs(vt[-1]))
    mixed = [name for name, share in zip(names, part, strict=True) if share > 0.1]
    low, high = np.rad2deg(np.min(angle)), np.rad2deg(np.max(angle))
    side = ", all on one side of zero" if low * high > 0 else ""
    raise OrientationError(
        f"interior orientation: angles from {low:.6g} to {high:.6g} deg{side}, cannot separate {', '.join(mixed)}"
        f" (condition number {condition:.2g}); measure at more angles over both halves of the"
        " field, or leave a term out"
    )


def _noise_matrix(given: ArrayLike, count: int, name: str) -> Array:
    """Covariance (N, N) from a covariance (N, N) or sigmas (N,) or ().

    Raises OrientationError, with the given name, for another shape, values that are not finite, negative sigmas.

    Args:
        given: covariance (N, N), or sigmas (N,) or ().
        count: N.
        name: of what it is the noise, for messages.
    """
    noise = np.asarray(given, dtype=np.float64)
    if not np.all(np.isfinite(noise)):
        raise OrientationError(f"interior orientation: {name} is not finite")
    if noise.shape in ((), (count,)):
        if np.any(noise < 0):
            raise OrientationError(f"interior orientation: {name} holds negative sigmas")
        return np.diag(np.broadcast_to(noise, (count,)) ** 2)
    if noise.shape != (count, count):
        raise OrientationError(
            f"interior orientation: {name} is {noise.shape}; {count} points need ({count}, {count}), or {count} sigmas"
        )
    if np.max(np.abs(noise - noise.T)) > 1e-9 * np.max(np.abs(noise)):
        raise OrientationError(f"interior orientation: {name} is not symmetric")
    return 0.5 * (noise + noise.T)


def _noise_root(noise: Array) -> Array:
    """Cholesky factor of a covariance (N, N): solve(root, x) has unit covariance.

    Raises OrientationError when the covariance is not positive definite.
    """
    sigma = np.sqrt(np.maximum(np.diagonal(noise), 0.0))
    least = np.min(np.linalg.eigvalsh(noise / np.outer(sigma, sigma))) if np.all(sigma > 0) else 0.0
    # eigenvalues below the rounding of a matrix of this size are not known to be positive
    if least <= 1e-14 * len(noise):
        raise OrientationError(
            "interior orientation: the noise is zero or fully common in some combination of points (its covariance is"
            " not positive definite); add the sigmas of the single spots"
        )
    return np.asarray(np.linalg.cholesky(noise))


# Significance in sigmas: false alarm 0.3 %.
_SIGNIFICANT = 3.0
POINT_TOLERANCE = 10e-6
"""Sigma up to which the principal point counts as observable, metres: about a pixel, the size that paper 004 expects of
it.
"""


@dataclass(frozen=True, eq=False)
class PointReport:
    """What the test can say of the principal point p.

    Attributes:
        observable: whether the sigma of p, or of the p that could have been fitted beside the other terms, is no larger
            than `POINT_TOLERANCE`.
        statement: this in a sentence, with numbers.
    """

    observable: bool
    statement: str


def _point_report(names: tuple[str, ...], values: Array, angle: Array, noise: Array) -> PointReport:
    """What a fit of these terms says of p, or would say with p beside them.

    Args:
        names: of P terms.
        values: of the terms, (P,), m.
        angle: (N,) rad.
        noise: (N, N) m^2.
    """
    fitted = "principal_point" in names
    asked = names if fitted else (*names, "principal_point")
    k = asked.index("principal_point")
    columns = design(angle, asked)
    try:
        if len(columns) < len(asked):
            raise OrientationError("interior orientation: no point is left for p")
        _check_separable(columns, asked, angle)
        row = gain(columns)[k]
        sigma = float(np.sqrt(row @ noise @ row))
    except OrientationError:
        sigma = np.inf
    value = float(values[k]) if fitted else 0.0
    widest = float(np.max(np.abs(angle)))
    edge = sigma * np.tan(widest) ** 2
    typical = float(np.median(np.sqrt(np.diagonal(noise))))
    observable, significant = sigma <= POINT_TOLERANCE, abs(value) > _SIGNIFICANT * sigma
    low, high = np.rad2deg(np.min(angle)), np.rad2deg(np.max(angle))
    even = abs(low + high) < 0.01 * (high - low)
    field = f"+-{0.5 * (high - low):.4g} deg" if even else f"{low:.4g} to {high:.4g} deg"
    same = "A decentring distortion would be the same tan^2 term."
    size = f"p = {1e3 * value:.2g} +- {1e3 * sigma:.2g} mm"
    effect = (
        f"one sigma of it moves the edge of the field by {1e6 * edge:.2g} um against {1e6 * typical:.2g} um of noise"
    )
    if not fitted:
        if np.isfinite(sigma):
            able = "observable" if observable else "not observable"
            text = f"p is taken as zero; fitted, it would be known to +- {1e3 * sigma:.2g} mm: {able} over {field}."
        else:
            text = f"p is taken as zero; the angles, {field}, could not separate it from the other terms."
    elif observable:
        text = f"{size}: observable over {field}" + (". " if significant else ", and not different from zero. ") + same
    elif significant:
        text = (
            f"{size}: a tan^2 term is there, but as a place of the principal point it is not observable over {field} to"
            f" {1e6 * POINT_TOLERANCE:.3g} um. {same}"
        )
    else:
        text = f"{size}: not observable over {field}; {effect}; take p = 0 (eq. 3). {same}"
    return PointReport(observable, text)


# A principal distance with a larger relative sigma is no result; the angles are then nearly constant.
_WORST_DISTANCE = 0.1


@dataclass(frozen=True, eq=False)
class InteriorOrientation:
    """Result of a fit over N points with P terms.

    terms: names as in `analysis.orientation.distortion_model.TERMS`. values: (P,) m. covariance: (P, P) m^2.
    angle, position: (N,) rad, m, as measured. noise: (N, N) m^2, of positions and angles together.
    residual: (N,) m, position - model.
    chi_square: least sum of squares in the metric of the noise; it has degrees_of_freedom = N - P when model and noise
    are right.
    point: about the principal point.
    """

    terms: tuple[str, ...]
    values: Array
    covariance: Array
    angle: Array
    position: Array
    noise: Array
    residual: Array
    chi_square: float
    degrees_of_freedom: int
    point: PointReport

    def value(self, term: str) -> float:
        """Metres; zero for a term that was not fitted."""
        return float(self.values[self.terms.index(term)]) if term in self.terms else 0.0

    def sigma(self, term: str) -> float:
        """Metres; zero for a term that was not fitted."""
        k = self.terms.index(term) if term in self.terms else None
        return 0.0 if k is None else float(np.sqrt(self.covariance[k, k]))

    @property
    def correlation(self) -> Array:
        """(P, P), in the order of the terms."""
        sigma = np.sqrt(np.diagonal(self.covariance))
        return np.asarray(self.covariance / np.outer(sigma, sigma))

    @property
    def residual_covariance(self) -> Array:
        """(N, N), m^2, of rank N - P."""
        columns = design(self.angle, self.terms)
        left = np.eye(len(self.angle)) - columns @ gain(columns)
        return np.asarray(left @ self.noise @ left.T)

    @property
    def probability(self) -> float:
        """Chance of a chi-square at least this large if model and noise are right; nan without degrees of freedom."""
        return float(stats.chi2.sf(self.chi_square, self.degrees_of_freedom)) if self.degrees_of_freedom else np.nan


def fit_interior_orientation(
    position: ArrayLike,
    angle: ArrayLike,
    covariance: ArrayLike,
    terms: Sequence[str] = ("constant", "principal_distance", "principal_point", "radial3"),
    *,
    angle_covariance: ArrayLike | None = None,
) -> InteriorOrientation:
    """Least squares for the terms of the model, linear in all of them, all points alike.

    Args:
        position: (N,), m.
        angle: (N,), rad.
        covariance: noise of the positions: (N, N) m^2, or sigmas (N,) or one sigma, m.
        terms: names out of `TERMS`, with principal_distance among them.
        angle_covariance: the same of the angles, rad^2 or rad; it acts through dL/dW. Its effect on tan W itself
            (attenuation) is of the order (sigma_W / W)^2, below 1e-8, and left out.

    Raises:
        OrientationError: bad readings or noise, fewer angles than terms, nearly constant angles, angles that count
            against the positions, terms that these angles do not separate.
    """
    where, turned = readings(position, angle)
    names = tuple(terms)
    if where.ndim != 1:
        raise OrientationError(f"interior orientation: readings must be (N,), found {where.shape}; fit set by set")
    if "principal_distance" not in names:
        raise OrientationError("interior orientation: principal_distance must be among the terms")
    columns = design(turned, names)
    distinct = len(np.unique(turned))
    if distinct == 1:
        raise OrientationError("interior orientation: all angles are the same; turn the turntable between the readings")
    if distinct < len(names):
        raise OrientationError(
            f"interior orientation: {distinct} different angles for {len(names)} unknowns ({', '.join(names)}); measure"
            " at more angles or fit fewer terms"
        )
    _check_separable(columns, names, turned)
    solve = gain(columns)
    values = solve @ where
    noise = _noise_matrix(covariance, len(where), "covariance")
    if angle_covariance is not None:
        rate = slope(turned, names, values)
        noise = noise + rate[:, None] * _noise_matrix(angle_covariance, len(where), "angle_covariance") * rate
    root = _noise_root(noise)
    best = gain(columns, root)
    spread = solve @ noise @ solve.T
    k = names.index("principal_distance")
    f, sigma = float(values[k]), float(np.sqrt(spread[k, k]))
    if sigma > _WORST_DISTANCE * abs(f):
        raise OrientationError(
            f"interior orientation: f = {f:.3g} +- {sigma:.2g} m; the angles span only {np.ptp(turned):.3g} rad, too"
            " little for their noise; turn the turntable over the whole field"
        )
    if f < 0:
        raise OrientationError(
            f"interior orientation: the principal distance comes out as {f:.6g} m; angles and spot positions count in"
            " opposite senses, change the sign of one of them"
        )
    return InteriorOrientation(
        terms=names,
        values=values,
        covariance=spread,
        angle=turned,
        position=where,
        noise=noise,
        residual=where - columns @ values,
        chi_square=float(np.sum(np.linalg.solve(root, where - columns @ (best @ where)) ** 2)),
        degrees_of_freedom=len(where) - len(names),
        point=_point_report(names, values, turned, noise),
    )


LINE_TERMS = ("axis", "principal_distance", "principal_point", "k1")
"""Names of the unknowns; the last three are keys of a payload's line."""
_STEPS = 20


@dataclass(frozen=True, eq=False)
class LineOrientation:
    """Fit of `LINE_TERMS`.

    Attributes:
        values: (4,), rad, m, m, 1/m^2.
        covariance: (4, 4) in these units.
    """

    values: Array
    covariance: Array

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
    """Convert an interior orientation to principal distance, principal point and k1 of a line, by least squares in the
    image at the same points with equal weights.

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
        with np.errstate(all="ignore"):  # steps of a camera that is none may end anywhere
            angle, columns, rate = _model(values, fit.position)
            weighted = columns * rate[:, None]
        if not np.all(np.isfinite(weighted)):
            break
        solve = gain(weighted)
        step = solve @ ((fit.angle - angle) * rate)
        values = values + step
        spread = solve @ fit.noise @ solve.T
        if np.all(np.abs(step) < 1e-6 * np.sqrt(np.diagonal(spread))):
            return LineOrientation(values, spread)
    raise OrientationError("interior orientation: the line's principal point and distortion do not converge")
