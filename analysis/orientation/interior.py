"""Interior orientation of a line camera from (angle, position) pairs, and whether its principal point is observable.

Over a narrow field tan^2 W is tiny: an error of 1 um at the edge of +-1.25 deg is 2 mm of p. Paper 004 solves for p all
the same (eq. 2) and remarks that p is about a pixel; this says with numbers when p = 0 (eq. 3) is the better choice.

`fit_interior_orientation` fits the model below (paper 004, eqs. 1-4, with a constant and
radial terms). Errors of a turntable are common to many points (eccentricity, graduation, the zero), so the noise is a
full covariance. The paper weights all points alike; its estimates stay unbiased under such noise, but sigmas from the
scatter of the residuals are wrong, for a common error hides in the parameters. Here every sigma comes from the given
covariance (sandwich). Generalised least squares, which has the smallest sigmas, serves for chi-square.

A point of the line at y looks, from the camera's Z, at

    tan theta = (y - y0) (1 + k1 (y - y0)^2) / f        (Brown, Photogramm. Eng. 37(8), 1971)

and a test reads W = axis + theta, where `axis` is the reading of the camera's Z, counted from the zero of the test. To
lowest order these are the terms below: k1 = -k3 / f^3 (the other sign: a pincushion, k3 > 0, images
farther out than f tan W, so that places have to be moved inward), y0 (1 + 3 k3 / f) = p (a shift of the distortion's
centre is a tan^2 term as well), axis = (y0 - c) / f. The f is that of the model with k3, the slope in the middle of the
field, and not the balanced one of paper 004's eq. (3), the slope that leaves the smallest distortion: over a field of
+- W they differ by about 0.6 k3 tan^2 W.

Angles in radians, lengths in metres, k1 in 1/m^2.

Interior orientation and distortion along a line CCD: the equations of paper 004 as printed, and the terms of the
model that goes beyond them.

A collimator stands still and the camera turns on a turntable. W (rad) is the angle of a direction from the one that
images to the centre O of the line, L (m) the place of its spot from O. Both count in the same sense, so that f > 0.
Paper 004 (Li et al., doi 10.3788/IRLA20200143) defines the distortion of a point

    D = L - f tan W + p tan^2 W    (1)

and chooses f and p such that sum D^2 over the points is least (2), f alone with p = 0 (3), or p alone (4).

What (1) means: a camera without distortion whose principal point lies p from O images to
L = f tan(W - w) + f tan w with tan w = p / f, which is f tan W - p tan^2 W up to terms of the order p^2 / f. There is
no constant term as long as W counts exactly from the direction that images to O. An error d of that zero of W adds
-f d (1 + tan^2 W): (3) leaves f d in the distortion of every point, and (2) puts f d (1 + 5 / (3 tan^2 W_edge)) into p,
which is 3500 f d for a field of +-1.25 deg. The model with a constant is free of this:

    L = c + f tan W - p tan^2 W + k3 tan^3 W

- `constant` c, `principal_distance` f, `principal_point` p: the interior orientation, metres. In one dimension a
  decentring distortion d2 tan^2 W is the same function as a principal point p = -d2, and so is, to first order, a
  radial distortion whose centre lies off the zero of W by w: -3 k3 w tan^2 W. No measurement along one line separates
  them;
- `radial3` k3, m: radial distortion. With r = f tan W it is K1 r^3, K1 = k3 / f^3 (1/m^2); positive is a pincushion.
  Software that *adds* a correction to the image has the other sign.

Angles in radians, lengths in metres. Leading axes of L and W are sets.

From the frames and readings of a distortion test to interior orientation and distortion (paper 004, section 3).

1. `locate_spots`: energy centroids on the line CCD, L = (column - middle of the line) * pitch.
2. `reduce_sets`: repeated sets to one (W, L) per point, gross errors out by Chauvenet's criterion.
3. `Distortion.measure`: f, p and D = L - c - f tan W + p tan^2 W with a constant c beside eq. (2), which takes up the
   error of the zero of W, and a smooth model of D. What the points scatter about that model beyond their noise is taken
   as one more noise, the same at all points and independent from point to point: the subdivision error of the table
   above all, whose period of arcseconds no calibration follows.

Metres and radians; N points, S sets.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats
from scipy.optimize import brentq

from analysis.arrays import Array, MeasurementError
from analysis.spots.centroid import energy_centroid, mean_frames
from analysis.spots.noise import NoiseModel
from analysis.statistics import gain
from analysis.turntable.dividing_error import CalibrationSeries

# power of tan W and sign of each term
_POWER = {"constant": (0, 1.0), "principal_distance": (1, 1.0), "principal_point": (2, -1.0), "radial3": (3, 1.0)}
TERMS = tuple(_POWER)
# Line cameras see a few degrees; beyond this an angle is rather in degrees than in radians.
_WIDEST = np.pi / 4
# Determinant of (2) relative to its first product; one part in 1e9 leaves six digits of the sums' rounding.
_SINGULAR = 1e-9


class OrientationError(MeasurementError, ValueError):
    """The readings do not determine what is asked for; the message says what to change."""


def readings(position: ArrayLike, angle: ArrayLike) -> tuple[Array, Array]:
    """L and W as float64 arrays of one shape (..., N), checked.

    Raises OrientationError for sizes that differ, no points, values that are not finite, angles beyond 45 deg.
    """
    where, turned = np.asarray(position, dtype=np.float64), np.asarray(angle, dtype=np.float64)
    if where.ndim == 0 or turned.ndim == 0 or where.shape[-1] != turned.shape[-1]:
        raise OrientationError(
            f"interior orientation: {where.shape} spot positions and {turned.shape} angles; give one angle per spot"
        )
    try:
        where, turned = np.broadcast_arrays(where, turned)
    except ValueError as error:
        raise OrientationError(
            f"interior orientation: sets of spot positions {where.shape} and angles {turned.shape} do not match"
        ) from error
    if where.size == 0:
        raise OrientationError("interior orientation: no points; give at least one angle with its spot position")
    for name, values in (("spot position", where), ("angle", turned)):
        bad = np.argwhere(~np.isfinite(values))
        if bad.size:
            place = ", ".join(str(k) for k in bad[0])
            raise OrientationError(
                f"interior orientation: {name} [{place}] is not finite ({len(bad)} in all); leave those points out"
            )
    widest = float(np.max(np.abs(turned)))
    if widest > _WIDEST:
        raise OrientationError(
            f"interior orientation: an angle of {np.rad2deg(widest):.6g} deg ({widest:.6g} rad) is beyond 45 deg;"
            " give radians, counted from the direction that images to the centre of the line"
        )
    return where, turned


def distortion(
    position: ArrayLike, angle: ArrayLike, principal_distance: ArrayLike, principal_point: ArrayLike = 0.0
) -> Array:
    """Distortion (..., N), m, of each point: paper 004, eq. (1).

    Raises OrientationError for bad readings.

    Parameters
    ----------
    position : ArrayLike
        (..., N), m.
    angle : ArrayLike
        (..., N), rad.
    principal_distance : ArrayLike
        (...) m, one per set.
    principal_point : ArrayLike
        likewise.
    """
    where, turned = readings(position, angle)
    t = np.tan(turned)
    f = np.asarray(principal_distance, dtype=np.float64)[..., None]
    p = np.asarray(principal_point, dtype=np.float64)[..., None]
    return np.asarray(where - f * t + p * t**2)


def principal_distance_and_point(position: ArrayLike, angle: ArrayLike) -> tuple[Array, Array]:
    """Principal distance f and point p, each (...), m: paper 004, eq. (2).

    position, angle: (..., N) m, rad, at least two different angles other than zero in each set.
    Raises OrientationError for bad or too few readings and for angles that count against the positions.
    """
    where, turned = readings(position, angle)
    if where.shape[-1] < 2:
        raise OrientationError("interior orientation: 1 angle for the 2 unknowns f and p; measure at more angles")
    t = np.tan(turned)
    t2, t3, t4 = np.sum(t**2, axis=-1), np.sum(t**3, axis=-1), np.sum(t**4, axis=-1)
    lt, lt2 = np.sum(where * t, axis=-1), np.sum(where * t**2, axis=-1)
    determinant = t3**2 - t2 * t4
    if np.any(np.abs(determinant) <= _SINGULAR * t2 * t4):
        raise OrientationError(
            "interior orientation: f and p cannot be separated, for the angles are (nearly) all the same or zero;"
            " turn the turntable between the readings"
        )
    f = (lt2 * t3 - lt * t4) / determinant
    p = (lt2 * t2 - lt * t3) / determinant
    _same_sense(f)
    return np.asarray(f), np.asarray(p)


def principal_distance(position: ArrayLike, angle: ArrayLike) -> Array:
    """Balanced principal distance f (...), m, which leaves the smallest distortion with p = 0: paper 004, eq. (3).

    position, angle: (..., N) m, rad. Raises OrientationError for bad readings, angles that are all zero, and angles
    that count against the positions.
    """
    where, turned = readings(position, angle)
    t = np.tan(turned)
    t2 = np.sum(t**2, axis=-1)
    if np.any(t2 == 0):
        raise OrientationError("interior orientation: all angles are zero and say nothing of f; turn the turntable")
    f = np.sum(where * t, axis=-1) / t2
    _same_sense(f)
    return np.asarray(f)


def principal_point(position: ArrayLike, angle: ArrayLike, principal_distance: ArrayLike) -> Array:
    """Principal point p (...), m, for a known f (...), m: paper 004, eq. (4).

    Raises OrientationError for bad readings and angles that are all zero.

    Parameters
    ----------
    position : ArrayLike
        (..., N), m.
    angle : ArrayLike
        (..., N), rad.
    principal_distance : ArrayLike
        (...), m, one per set.
    """
    where, turned = readings(position, angle)
    t = np.tan(turned)
    t4 = np.sum(t**4, axis=-1)
    if np.any(t4 == 0):
        raise OrientationError("interior orientation: all angles are zero and say nothing of p; turn the turntable")
    f = np.asarray(principal_distance, dtype=np.float64)
    return np.asarray((f * np.sum(t**3, axis=-1) - np.sum(where * t**2, axis=-1)) / t4)


def design(angle: ArrayLike, terms: Sequence[str]) -> Array:
    """dL/d(term) (..., P) at angles (...), rad. Raises OrientationError for unknown or repeated terms."""
    unknown = [term for term in terms if term not in _POWER]
    if unknown or len(set(terms)) != len(terms):
        raise OrientationError(f"interior orientation: terms must be different ones of {TERMS}, found {tuple(terms)}")
    t = np.tan(np.asarray(angle, dtype=np.float64))
    return np.stack([sign * t**power for power, sign in (_POWER[term] for term in terms)], axis=-1)


def slope(angle: ArrayLike, terms: Sequence[str], values: ArrayLike) -> Array:
    """dL/dW (...), m/rad, of the model with these terms and values (P,) at angles (...), rad.

    Parameters
    ----------
    angle : ArrayLike
        (...), rad.
    terms : Sequence[str]
        Names out of `TERMS`.
    values : ArrayLike
        Of the terms, (P,), m.
    """
    t = np.tan(np.asarray(angle, dtype=np.float64))
    powers = [_POWER[term] for term in terms]
    steps = np.stack([sign * power * t ** max(power - 1, 0) for power, sign in powers], axis=-1)
    return np.asarray((steps @ np.asarray(values, dtype=np.float64)) * (1.0 + t**2))


def _same_sense(f: Array) -> None:
    if np.any(f <= 0):
        raise OrientationError(
            f"interior orientation: the principal distance comes out as {float(np.min(f)):.6g} m; angles and spot"
            " positions count in opposite senses, change the sign of one of them"
        )


# With columns of length one, the worst combination of terms has this many times the sigma of the best. Five terms over
# half a field have 270; f and a constant reach 1000 when the angles lie within 1 % of each other.
_WORST_CONDITION = 1e3


def _check_separable(columns: Array, names: tuple[str, ...], angle: Array) -> None:
    """OrientationError, naming the terms that take part in the worst combination, where angles do not separate them.

    Parameters
    ----------
    columns : Array
        Of the design, (N, P).
    names : tuple[str, ...]
        Of the terms.
    angle : Array
        (N,), rad.
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

    Parameters
    ----------
    given : ArrayLike
        Covariance (N, N), or sigmas (N,) or ().
    count : int
        N.
    name : str
        Of what it is the noise, for messages.
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

    Attributes
    ----------
    observable : bool
        Whether the sigma of p, or of the p that could have been fitted beside the other terms, is no larger than
        `POINT_TOLERANCE`.
    statement : str
        This in a sentence, with numbers.
    """

    observable: bool
    statement: str


def _point_report(names: tuple[str, ...], values: Array, angle: Array, noise: Array) -> PointReport:
    """What a fit of these terms says of p, or would say with p beside them.

    Parameters
    ----------
    names : tuple[str, ...]
        Of P terms.
    values : Array
        Of the terms, (P,), m.
    angle : Array
        (N,) rad.
    noise : Array
        (N, N) m^2.
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

    terms: names as in `analysis.orientation.interior.TERMS`. values: (P,) m. covariance: (P, P) m^2.
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
    """Fit principal distance, principal point and distortion of a line camera to angles and image positions.

    The model is L = c + f tan W - p tan^2 W + k3 tan^3 W. The estimate is that of equal weights; its covariance follows
    from the given noise, which may be correlated between points.

    Parameters
    ----------
    position : (N,) array_like
        Image positions L along the line, in metres.
    angle : (N,) array_like
        Angles W of the directions, in radians, counted in the same sense.
    covariance : float, (N,) or (N, N) array_like
        Noise of the positions: standard deviations in metres, or their covariance in m^2.
    terms : sequence of str
        Terms to fit, of "constant", "principal_distance", "principal_point" and "radial3".
    angle_covariance : float, (N,) or (N, N) array_like, optional
        Noise of the angles, in radians or rad^2.

    Returns
    -------
    InteriorOrientation
        `value` and `sigma` of each term, `covariance`, residuals, chi-square, and `point`, which says whether the
        principal point can be observed.

    Raises
    ------
    ValueError
        Arrays of other shapes, values that are not finite, fewer angles than terms, angles that do not separate the
        terms, or angles that count against the positions.

    Notes
    -----
    Li et al., Infrared and Laser Engineering, doi 10.3788/IRLA20200143, equations 1 to 4, with a constant and a radial
    term. The errors of the angles act through dL/dW; their effect on tan W itself is of the order (sigma_W / W)^2.

    Examples
    --------
    A camera of f = 1.7 m with a principal point of 5 um and a pincushion distortion, at 41 angles of a turntable:

    >>> import numpy as np
    >>> import analysis
    >>> angle = np.radians(np.linspace(-1.25, 1.25, 41))
    >>> t = np.tan(angle)
    >>> position = 20e-6 + 1.7 * t - 5e-6 * t**2 + 0.05 * t**3
    >>> fit = analysis.fit_interior_orientation(position, angle, 0.3e-6)
    >>> round(fit.value("principal_distance"), 6), round(fit.value("radial3"), 6), round(fit.value("constant"), 9)
    (1.7, 0.05, 2e-05)

    The principal point cannot be observed over such a narrow field, and the fit says so:

    >>> round(fit.sigma("principal_point"), 6), fit.point.observable
    (0.000315, False)
    >>> terms = "constant", "principal_distance", "radial3"
    >>> fit = analysis.fit_interior_orientation(position, angle, 0.3e-6, terms)
    >>> round(fit.sigma("principal_distance"), 7), fit.degrees_of_freedom
    (9.1e-06, 38)
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

    Attributes
    ----------
    values : Array
        (4,), rad, m, m, 1/m^2.
    covariance : Array
        (4, 4) in these units.
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

    Parameters
    ----------
    fit : InteriorOrientation
        With constant, principal_distance, principal_point and radial3 and no other terms, which it starts from.

    Raises
    ------
    OrientationError
        Other terms, or no convergence.
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


CALIBRATED = ("constant", "principal_distance", "principal_point")
"""What distortion is counted from: eq. (2) with a constant."""
SMOOTH = (*CALIBRATED, "radial3")
"""The model whose residual tells how well the points fit a smooth curve."""


@dataclass(frozen=True, eq=False)
class Spots:
    """Spots on the line CCD.

    Attributes
    ----------
    position : Array
        L, (N, S), metres.
    temporal : Array
        Sigma by noise that is new in each frame, (N, S), metres.
    fixed : Array
        Sigma by differences of the line's columns, which stay while the spot does, (N, S), metres.
    row : Array
        Of the spot in its image, (N, S), pixels.
    """

    position: Array
    temporal: Array
    fixed: Array
    row: Array


def locate_spots(
    frames: NDArray[np.uint16],
    column: ArrayLike,
    middle: float,
    pitch: float,
    noise: NoiseModel,
    radius: float,
    offset: ArrayLike = 0.0,
) -> Spots:
    """Energy centroids.

    Parameters
    ----------
    frames : NDArray[np.uint16]
        (N, S, frames, H, W).
    column : ArrayLike
        Of the line, where each image begins, (N, S).
    middle : float
        Column of the line's middle, where L = 0.
    pitch : float
        metres.
    noise : NoiseModel
        Of one frame; its pattern is one of columns: every row of a TDI line is collected by the same pixels.
    radius : float
        Of the centroid's window, pixels.
    offset : ArrayLike
        Energy centroid minus chief ray by the camera's design, (N,), metres; taken off.

    Raises
    ------
    SpotError
        a spot is saturated, absent, or too near the edge of its image.
    """
    count, sets, number = frames.shape[:3]
    spots = energy_centroid(mean_frames(frames).reshape(count * sets, *frames.shape[3:]), number, noise, radius)
    assert spots.gain_maps is not None
    assert spots.light_dn is not None
    influence = spots.gain_maps[:, 1]
    gain = np.sum(np.sum(influence * spots.light_dn, axis=1) ** 2, axis=-1) * noise.prnu**2
    dark = np.sum(np.sum(influence, axis=1) ** 2, axis=-1) * noise.dsnu_variance_dn2
    shape = count, sets
    place = (np.asarray(column) + spots.column.reshape(shape) - middle) * pitch
    return Spots(
        position=place - np.broadcast_to(np.asarray(offset, np.float64), (count,))[:, None],
        temporal=pitch * np.sqrt(spots.temporal_covariance[:, 1, 1]).reshape(shape),
        fixed=pitch * np.sqrt(gain + dark).reshape(shape),
        row=spots.row.reshape(shape),
    )


@dataclass(frozen=True, eq=False)
class PointMeans:
    """Sets reduced to one measurement per point.

    Attributes
    ----------
    keep : NDArray[np.bool_]
        Exposures that Chauvenet's criterion keeps, (N, S).
    scatter : float
        Sigma of one exposure by the scatter between the sets, or as given if there is one set only, metres.
    sigma : Array
        Of the mean of each point, without what is common to all sets, (N,), metres.
    """

    keep: NDArray[np.bool_]
    scatter: float
    sigma: Array

    def mean(self, values: Array) -> Array:
        """Mean over the sets that are kept, (N, S) to (N,)."""
        return np.asarray(np.mean(values, axis=1, where=self.keep))


def reduce_sets(
    angle: Array, spots: Spots, principal_distance: float, single: float, present: NDArray[np.bool_] | None = None
) -> PointMeans:
    """Find gross errors among the sets and the noise of the means.

    In each set, L - f tan W of a point differs from its mean over the sets by the repeatability of the table and by
    noise, whose sizes the sets themselves tell.

    Parameters
    ----------
    angle : Array
        W, (N, S), radians, by the readings.
    spots : Spots
        As located.
    principal_distance : float
        About, metres.
    single : float
        Sigma of one exposure, metres, for a test of one set.
    present : NDArray[np.bool_] | None
        Which exposures there are, (N, S), where sets lack points; the others hold any finite numbers. None for all.
    """
    rest = spots.position - principal_distance * np.tan(angle)
    # what does not average out while the spot stays on its pixels
    fixed = np.sqrt(np.mean(spots.fixed**2, axis=1, where=True if present is None else present))
    count, sets = rest.shape
    if sets < 2:
        own = np.hypot(single, spots.temporal[:, 0])
        return PointMeans(np.ones(rest.shape, bool), float(np.sqrt(np.mean(own**2))), np.hypot(own, fixed))
    # the comparison of the table with the camera is a calibration series, if one forgets its units
    series = CalibrationSeries(np.arange(count, dtype=float), rest, present=present)
    return PointMeans(series.keep, series.repeatability, np.hypot(series.noise_sigma, fixed))


def _white(fitted: Callable[[float], InteriorOrientation]) -> float:
    """White noise beside the stated one that brings chi-square to its expectation, metres; zero if it is there already.

    The estimator of Paule and Mandel (J. Res. Natl. Bur. Stand. 87, 377 (1982)). Chi-square falls steadily with the
    noise.
    """
    bare = fitted(0.0)
    if bare.degrees_of_freedom == 0 or bare.chi_square <= bare.degrees_of_freedom:
        return 0.0

    def beyond(size: float) -> float:
        fit = fitted(size)
        return fit.chi_square - fit.degrees_of_freedom

    # white noise of sigma s alone leaves chi-square <= sum(residual^2) / s^2, which is N - P at the upper end
    most = float(np.sqrt(np.sum(bare.residual**2) / bare.degrees_of_freedom))
    return float(brentq(beyond, 0.0, most, xtol=1e-11))


@dataclass(frozen=True, eq=False)
class Distortion:
    """Distortion with one kind of angles (as read, or compensated).

    Attributes
    ----------
    angle : Array
        W of each exposure, (N, S), radians.
    position : Array
        L, (N, S), metres.
    means : PointMeans
        How sets were reduced.
    fit : InteriorOrientation
        Of the calibrated terms; its residual is the distortion D of the mean of the sets, (N,), metres.
    smooth : InteriorOrientation
        The same with radial distortion; its residual is what is not smooth.
    white : float
        Sigma of each point's position beyond the noise that was stated, metres; it is in the noise of both fits.
    """

    angle: Array
    position: Array
    means: PointMeans
    fit: InteriorOrientation
    smooth: InteriorOrientation
    white: float

    @classmethod
    def measure(
        cls, angle: Array, spots: Spots, means: PointMeans, angle_covariance: ArrayLike | None = None
    ) -> Distortion:
        """Fit.

        Parameters
        ----------
        angle : Array
            (N, S), radians.
        spots : Spots
            As located.
        means : PointMeans
            How sets are reduced.
        angle_covariance : ArrayLike | None
            Of the mean angles, (N, N), rad^2: what is common to all sets of a point, without what is independent from
            point to point.

        Raises
        ------
        OrientationError
            Fewer points than unknowns, or angles that do not determine them.
        """
        where, turned = means.mean(spots.position), means.mean(angle)

        def fitted(terms: tuple[str, ...], white: float) -> InteriorOrientation:
            sigma = np.hypot(means.sigma, white)
            return fit_interior_orientation(where, turned, sigma, terms, angle_covariance=angle_covariance)

        white = _white(lambda size: fitted(SMOOTH, size))
        fit, smooth = fitted(CALIBRATED, white), fitted(SMOOTH, white)
        return cls(angle, spots.position, means, fit, smooth, white)

    @property
    def distortion(self) -> Array:
        """D, (N,), metres."""
        return self.fit.residual

    @property
    def sigma(self) -> Array:
        """Standard deviation of D, (N,), metres."""
        return np.sqrt(np.maximum(np.diagonal(self.fit.residual_covariance), 0.0))

    @property
    def zero(self) -> float:
        """Angle at which the line's middle is imaged, by the constant, radians."""
        return -self.fit.value("constant") / self.fit.value("principal_distance")

    @property
    def rms_over_sets(self) -> Array:
        """RMS of each point's distortion over the sets that are kept, (N,), metres, every set fitted by itself: what
        Table 2 of paper 004 is called.
        """
        out = np.full(self.position.shape, np.nan)
        for s, keep in enumerate(self.means.keep.T):
            out[keep, s] = fit_interior_orientation(
                self.position[keep, s], self.angle[keep, s], self.means.scatter, CALIBRATED
            ).residual
        return np.asarray(np.sqrt(np.mean(out**2, axis=1, where=self.means.keep)))
