"""Interior orientation of a line camera from (angle, position) pairs, and whether its principal point is observable.

Over a narrow field tan^2 W is tiny: an error of 1 um at the edge of +-1.25 deg is 2 mm of p. Paper 004 solves for p all
the same (eq. 2) and remarks that p is about a pixel; this says with numbers when p = 0 (eq. 3) is the better choice.

`fit_interior_orientation` fits the model of `distortion_model` (paper 004, eqs. 1-4, with a constant and
radial terms). Errors of a turntable are common to many points (eccentricity, graduation, the zero), so the noise is a
full covariance. The paper weights all points alike; its estimates stay unbiased under such noise, but sigmas from the
scatter of the residuals are wrong, for a common error hides in the parameters. Here every sigma comes from the given
covariance (sandwich). Generalised least squares is the alternative with the smallest sigmas.

What counts as distortion depends on the f, p and c that it is counted from: `InteriorOrientation.printed` gives eq.
(1), `residual` what is left after the whole model, `curve` the smooth distortion from a calibration of choice.

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
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from analysis.orientation.distortion_model import InseparableTermsError, OrientationError, design, readings, slope

Array = NDArray[np.float64]
# With columns of length one, the worst combination of terms has this many times the sigma of the best. Five terms over
# half a field have 270; f and a constant reach 1000 when the angles lie within 1 % of each other.
_WORST_CONDITION = 1e3


def gain(columns: Array, root: Array | None = None) -> Array:
    """Least-squares inverse (P, N) of columns (N, P): all points alike, or generalised least squares.

    root: (N, N) from `noise_root`. Columns are scaled to length one, for powers of tan W differ by magnitudes.
    """
    white = columns if root is None else np.linalg.solve(root, columns)
    length = np.linalg.norm(white, axis=0)
    inverse = np.linalg.pinv(white / length) / length[:, None]
    return np.asarray(inverse if root is None else inverse @ np.linalg.inv(root), dtype=np.float64)


def condition_number(columns: Array, names: tuple[str, ...], angle: Array) -> float:
    """Condition number of columns (N, P) of these terms at angles (N,), rad, scaled to length one.

    Raises InseparableTermsError, naming the terms that take part in the worst combination, when it is too large.

    Args:
        columns: of the design, (N, P).
        names: of the terms.
        angle: (N,), rad.
    """
    length = np.linalg.norm(columns, axis=0)
    _, values, vt = np.linalg.svd(columns / np.where(length > 0, length, 1.0))
    condition = float(values[0] / max(values[-1], 1e-300))
    if condition <= _WORST_CONDITION:
        return condition
    part = np.abs(vt[-1]) / np.max(np.abs(vt[-1]))
    mixed = tuple(name for name, share in zip(names, part, strict=True) if share > 0.1)
    null = vt[-1:] / np.where(length > 0, length, 1.0)
    low, high = np.rad2deg(np.min(angle)), np.rad2deg(np.max(angle))
    side = ", all on one side of zero" if low * high > 0 else ""
    raise InseparableTermsError(
        f"interior orientation: angles from {low:.6g} to {high:.6g} deg{side}, cannot separate {', '.join(mixed)}"
        f" (condition number {condition:.2g}); measure at more angles over both halves of the"
        " field, or leave a term out",
        null / np.max(np.abs(null)),
        mixed,
    )


def noise_matrix(given: ArrayLike, count: int, name: str) -> Array:
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


def noise_root(noise: Array) -> Array:
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


@dataclass(frozen=True, eq=False)
class PointReport:
    """What the test can say of the principal point p.

    value: m; zero when p was not fitted. sigma: m, of p, or of the p that could have been fitted beside the other
    terms; infinite when it could not.
    fitted: whether p is one of the terms. observable: sigma is no larger than the tolerance that was asked for.
    significant: |value| exceeds 3 sigma. edge_effect: sigma tan^2 W at the widest angle, m. noise: median sigma of a
    point, m. statement: all this in a sentence.
    """

    value: float
    sigma: float
    fitted: bool
    observable: bool
    significant: bool
    edge_effect: float
    noise: float
    statement: str


def point_report(
    names: tuple[str, ...], values: Array, angle: Array, noise: Array, weighted: bool, tolerance: float
) -> PointReport:
    """What a fit of these terms says of p, or would say with p beside them.

    Args:
        names: of P terms.
        values: of the terms, (P,), m.
        angle: (N,) rad.
        noise: (N, N) m^2.
        weighted: generalised least squares.
        tolerance: m, largest sigma of an observable p.
    """
    fitted = "principal_point" in names
    asked = names if fitted or "decentring" in names else (*names, "principal_point")
    k = asked.index("principal_point" if "principal_point" in asked else "decentring")
    columns = design(angle, asked)
    try:
        if len(columns) < len(asked):
            raise OrientationError("interior orientation: no point is left for p")
        condition_number(columns, asked, angle)
        row = gain(columns, noise_root(noise) if weighted else None)[k]
        sigma = float(np.sqrt(row @ noise @ row))
    except OrientationError:
        sigma = np.inf
    value = float(values[k]) if fitted else 0.0
    widest = float(np.max(np.abs(angle)))
    edge = sigma * np.tan(widest) ** 2
    typical = float(np.median(np.sqrt(np.diagonal(noise))))
    observable, significant = sigma <= tolerance, abs(value) > _SIGNIFICANT * sigma
    low, high = np.rad2deg(np.min(angle)), np.rad2deg(np.max(angle))
    even = abs(low + high) < 0.01 * (high - low)
    field = f"+-{0.5 * (high - low):.4g} deg" if even else f"{low:.4g} to {high:.4g} deg"
    same = "A decentring distortion would be the same tan^2 term."
    size = f"p = {1e3 * value:.2g} +- {1e3 * sigma:.2g} mm"
    effect = (
        f"one sigma of it moves the edge of the field by {1e6 * edge:.2g} um against {1e6 * typical:.2g} um of noise"
    )
    if not fitted:
        if "decentring" in names:
            text = f"p is taken as zero: the tan^2 term was fitted as decentring, +- {1e3 * sigma:.2g} mm. {same}"
        elif np.isfinite(sigma):
            able = "observable" if observable else "not observable"
            text = f"p is taken as zero; fitted, it would be known to +- {1e3 * sigma:.2g} mm: {able} over {field}."
        else:
            text = f"p is taken as zero; the angles, {field}, could not separate it from the other terms."
    elif observable:
        text = f"{size}: observable over {field}" + (". " if significant else ", and not different from zero. ") + same
    elif significant:
        text = (
            f"{size}: a tan^2 term is there, but as a place of the principal point it is not observable over {field} to"
            f" {1e6 * tolerance:.3g} um. {same}"
        )
    else:
        text = f"{size}: not observable over {field}; {effect}; take p = 0 (eq. 3). {same}"
    return PointReport(value, sigma, fitted, observable, significant, edge, typical, text)


_CALIBRATION = ("constant", "principal_distance", "principal_point")
# A principal distance with a larger relative sigma is no result; the angles are then nearly constant.
_WORST_DISTANCE = 0.1


@dataclass(frozen=True, eq=False)
class PrintedDistortion:
    """Distortion by eq. (1), with f and p of eq. (2), or f of eq. (3) and p = 0.

    distortion: (N,) m; covariance: (N, N) m^2, of rank N - 2 or N - 1. principal_distance, principal_point: m.
    parameter_covariance: (2, 2) m^2 of f and p, zero for a p that was not fitted.
    """

    distortion: Array
    covariance: Array
    principal_distance: float
    principal_point: float
    parameter_covariance: Array

    @property
    def rms(self) -> float:
        """Rms over the points, m."""
        return float(np.sqrt(np.mean(self.distortion**2)))


@dataclass(frozen=True, eq=False)
class InteriorOrientation:
    """Result of a fit over N points with P terms.

    terms: names as in `analysis.orientation.distortion_model.TERMS`. values: (P,) m. covariance: (P, P) m^2.
    weighted: generalised least squares; else all points alike, with the sandwich covariance.
    angle, position: (N,) rad, m, as measured. noise: (N, N) m^2, of positions and angles together.
    residual: (N,) m, position - model. residual_covariance: (N, N) m^2, of rank N - P.
    chi_square: least sum of squares in the metric of the noise, whichever estimator was chosen; it has
    degrees_of_freedom = N - P when model and noise are right. condition: of the columns scaled to length one.
    point: about the principal point.
    """

    terms: tuple[str, ...]
    values: Array
    covariance: Array
    weighted: bool
    angle: Array
    position: Array
    noise: Array
    residual: Array
    residual_covariance: Array
    chi_square: float
    degrees_of_freedom: int
    condition: float
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
    def probability(self) -> float:
        """Chance of a chi-square at least this large if model and noise are right; nan without degrees of freedom."""
        return float(stats.chi2.sf(self.chi_square, self.degrees_of_freedom)) if self.degrees_of_freedom else np.nan

    def printed(self, fit_principal_point: bool) -> PrintedDistortion:
        """Eq. (1) with eq. (2), or with eq. (3) and p = 0, on the same readings and noise."""
        terms = ("principal_distance", "principal_point")[: 2 if fit_principal_point else 1]
        columns = design(self.angle, terms)
        solve = gain(columns)
        found = solve @ self.position
        left = np.eye(len(self.position)) - columns @ solve
        spread = np.zeros((2, 2))
        spread[: len(terms), : len(terms)] = solve @ self.noise @ solve.T
        return PrintedDistortion(
            distortion=np.asarray(self.position - columns @ found),
            covariance=np.asarray(left @ self.noise @ left.T),
            principal_distance=float(found[0]),
            principal_point=float(found[1]) if fit_principal_point else 0.0,
            parameter_covariance=spread,
        )

    def curve(self, angle: ArrayLike, reference: Sequence[str] | None = None) -> tuple[Array, Array]:
        """Smooth distortion and its sigma, each (...), m, at angles (...), rad: the model minus a calibration.

        reference: None takes out the fitted constant, f and p and leaves radial terms and decentring. Names of these
            three take out their best fit to the curve at the points of the test instead: ("principal_distance",) gives
            distortion as by eq. (3), with ("principal_distance", "principal_point") as by eq. (2).
        Errors are those of the fit; what the model does not hold shows in `residual`.
        """
        where = np.asarray(angle, dtype=np.float64)
        rows = design(where, self.terms)
        if reference is None:
            rows = rows * np.array([term not in _CALIBRATION for term in self.terms])
        else:
            wrong = [term for term in reference if term not in _CALIBRATION]
            if wrong or not reference:
                raise OrientationError(f"distortion curve: reference must be names out of {_CALIBRATION}, or None")
            taken = gain(design(self.angle, reference)) @ design(self.angle, self.terms)
            rows = rows - design(where, reference) @ taken
        variance = np.einsum("...i,ij,...j->...", rows, self.covariance, rows)
        return np.asarray(rows @ self.values), np.sqrt(np.maximum(variance, 0.0))

    def look_angle(self, position: ArrayLike) -> Array:
        """Angle W (...), rad, that images to positions (...), m: the model inverted by Newton steps."""
        target = np.asarray(position, dtype=np.float64)
        angle = np.arctan((target - self.value("constant")) / self.value("principal_distance"))
        for _ in range(20):
            step = (target - design(angle, self.terms) @ self.values) / slope(angle, self.terms, self.values)
            angle = angle + step
            if np.all(np.abs(step) < 1e-15):
                break
        if not np.all(np.abs(angle) <= 2 * np.max(np.abs(self.angle))):
            raise OrientationError(
                "interior orientation: positions lie far beyond the field of the test, where the distortion is unknown"
            )
        return angle

    def compensated(self, position: ArrayLike, reference: Sequence[str] | None = None) -> tuple[Array, Array]:
        """Image coordinates (...), m, freed from the distortion `curve`, and the sigma of the correction, (...), m."""
        removed, sigma = self.curve(self.look_angle(position), reference)
        return np.asarray(np.asarray(position, dtype=np.float64) - removed), sigma

    @property
    def statements(self) -> tuple[str, ...]:
        """Plain sentences for a report: fit, noise, principal point."""
        n, dof = len(self.position), self.degrees_of_freedom
        rms = 1e6 * float(np.sqrt(np.mean(self.residual**2)))
        f, sigma = self.value("principal_distance"), self.sigma("principal_distance")
        lines = [f"f = {1e3 * f:.4f} +- {1e3 * sigma:.2g} mm from {n} points; residual {rms:.3g} um rms."]
        if dof:
            text = f"Chi-square {self.chi_square:.4g} for {dof} degrees of freedom"
            if self.probability < 1e-3:
                text += ": the model lacks a term, or the noise is larger than stated"
            elif self.probability > 1 - 1e-3:
                text += ": the noise is smaller than stated"
            lines.append(text + ".")
        return (*lines, self.point.statement)


def fit_interior_orientation(
    position: ArrayLike,
    angle: ArrayLike,
    covariance: ArrayLike,
    terms: Sequence[str] = ("constant", "principal_distance", "principal_point", "radial3"),
    *,
    angle_covariance: ArrayLike | None = None,
    weighted: bool = False,
    point_tolerance: float = 10e-6,
) -> InteriorOrientation:
    """Least squares for the terms of the model, linear in all of them.

    Raises OrientationError for bad readings or noise, fewer angles than terms, nearly constant angles, angles that
    count against the positions; InseparableTermsError for terms that these angles cannot tell apart.

    Args:
        position: (N,), m.
        angle: (N,), rad.
        covariance: noise of the positions: (N, N) m^2, or sigmas (N,) or one sigma, m.
        terms: names out of `TERMS`, with principal_distance among them.
        angle_covariance: the same of the angles, rad^2 or rad; it acts through dL/dW. Its effect on tan W itself
            (attenuation) is of the order (sigma_W / W)^2, below 1e-8, and left out.
        weighted: generalised least squares instead of equal weights.
        point_tolerance: m, sigma up to which p counts as observable; about a pixel, the size that paper 004 expects of
            p.
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
    condition = condition_number(columns, names, turned)
    first = gain(columns) @ where
    noise = noise_matrix(covariance, len(where), "covariance")
    if angle_covariance is not None:
        rate = slope(turned, names, first)
        noise = noise + rate[:, None] * noise_matrix(angle_covariance, len(where), "angle_covariance") * rate
    root = noise_root(noise)
    best = gain(columns, root)
    solve = best if weighted else gain(columns)
    values = solve @ where
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
    left = np.eye(len(where)) - columns @ solve
    return InteriorOrientation(
        terms=names,
        values=values,
        covariance=spread,
        weighted=weighted,
        angle=turned,
        position=where,
        noise=noise,
        residual=where - columns @ values,
        residual_covariance=left @ noise @ left.T,
        chi_square=float(np.sum(np.linalg.solve(root, where - columns @ (best @ where)) ** 2)),
        degrees_of_freedom=len(where) - len(names),
        condition=condition,
        point=point_report(names, values, turned, noise, weighted, point_tolerance),
    )


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
