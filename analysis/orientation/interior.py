"""Interior orientation and distortion of a line camera from angles and image positions (paper 004).

**Equations of paper 004** (Li et al., doi 10.3788/IRLA20200143). A collimator is fixed and the camera rotates on a
turntable. W (rad) is the angle of a direction from the one that images to the centre O of the line, L (m) the position
of its spot from O. Both count in the same sense, so that f > 0. The paper defines the distortion of a point

    D = L - f tan W + p tan^2 W    (1)

and chooses f and p such that sum D^2 over the points is least (2), f alone with p = 0 (3), or p alone (4).

Interpretation of (1): a camera without distortion whose principal point lies p from O images to L = f tan(W - w) + f
tan w with tan w = p / f, which is f tan W - p tan^2 W up to terms of the order p^2 / f. There is no constant term as
long as W counts exactly from the direction that images to O. An error d of that zero of W adds -f d (1 + tan^2 W): (3)
leaves f d in the distortion of every point, and (2) puts f d (1 + 5 / (3 tan^2 W_edge)) into p, which is 3500 f d for a
field of +-1.25 deg. The model with a constant avoids this:

    L = c + f tan W - p tan^2 W + k3 tan^3 W

- `constant` c, `principal_distance` f, `principal_point` p: the interior orientation, in metres. In one dimension a
  decentring distortion d2 tan^2 W is the same function as a principal point p = -d2, and so is, to first order, a
  radial distortion whose centre lies off the zero of W by w: -3 k3 w tan^2 W. No measurement along one line separates
  them.
- `radial3` k3, in metres: radial distortion. With r = f tan W it is K1 r^3, K1 = k3 / f^3 (1/m^2); positive is a
  pincushion. Software that *adds* a correction to the image has the other sign.

**Fit.** `fit_interior_orientation` fits this model. Errors of a turntable are common to many points (eccentricity,
graduation, the zero), so the noise has a full covariance. The paper weights all points equally; its estimates stay
unbiased under such noise, but sigmas from the scatter of the residuals are wrong, because a common error is absorbed by
the parameters. Here every sigma comes from the given covariance (sandwich). Generalised least squares, which has the
smallest sigmas, serves for chi-square.

**Observability of p.** Over a narrow field tan^2 W is tiny: an error of 1 um at the edge of +-1.25 deg is 2 mm of p.
The paper solves for p nevertheless (eq. 2) and remarks that p is about a pixel; `PointReport` states with numbers when
p = 0 (eq. 3) is the better choice.

**Line model.** A point of the line at y looks, from the camera's Z, at

    tan theta = (y - y0) (1 + k1 (y - y0)^2) / f        (Brown, Photogramm. Eng. 37(8), 1971)

and a test reads W = axis + theta, where `axis` is the reading of the camera's Z, counted from the zero of the test. To
lowest order these are the terms above: k1 = -k3 / f^3 (the other sign: a pincushion, k3 > 0, images farther out than f
tan W, so that positions have to be moved inward), y0 (1 + 3 k3 / f) = p (a shift of the distortion's centre is a tan^2
term as well), axis = (y0 - c) / f. The f is that of the model with k3, the slope in the middle of the field, and not
the balanced one of paper 004's eq. (3), the slope that leaves the smallest distortion: over a field of +- W they differ
by about 0.6 k3 tan^2 W.

**Reduction of a distortion test** (paper 004, section 3), with N points and S sets:

1. `locate_spots`: energy centroids on the line CCD, L = (column - middle of the line) * pitch.
2. `reduce_sets`: repeated sets to one (W, L) per point, gross errors rejected by Chauvenet's criterion.
3. `Distortion.measure`: f, p and D = L - c - f tan W + p tan^2 W with a constant c beside eq. (2), which absorbs the
   error of the zero of W, and a smooth model of D. The scatter of the points about that model beyond their noise is
   treated as an additional noise, the same at all points and independent from point to point: mainly the subdivision
   error of the table, whose period of arcseconds no calibration resolves.

Angles are in radians, lengths in metres, k1 in 1/m^2. Leading axes of L and W are sets.
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

_POWER = {"constant": (0, 1.0), "principal_distance": (1, 1.0), "principal_point": (2, -1.0), "radial3": (3, 1.0)}
"""Power of tan W, with W the angle from the line's centre, and sign, of each term of the image position."""
TERMS = tuple(_POWER)
"""Names of the terms of the model: constant, principal distance, principal point and radial distortion."""
_WIDEST = np.pi / 4
"""Largest plausible angle, in radians: line cameras see a few degrees, and larger values are probably in degrees."""
_SINGULAR = 1e-9
"""Smallest determinant of the normal equations of eq. (2) of paper 004 (Li et al. 2020), relative to the product of
their diagonal elements; a determinant of 1e-9 leaves six correct digits.
"""


class OrientationError(MeasurementError, ValueError):
    """Error raised for readings that do not determine the requested quantities; the message says what to change."""


def readings(position: ArrayLike, angle: ArrayLike) -> tuple[Array, Array]:
    """Return validated image positions (metres) and angles (radians) of N points as float64 arrays (..., N).

    Raises
    ------
    OrientationError
        Sizes differ, there are no points, values are not finite, or angles exceed 45 deg.
    """
    positions, angles = np.asarray(position, dtype=np.float64), np.asarray(angle, dtype=np.float64)
    if positions.ndim == 0 or angles.ndim == 0 or positions.shape[-1] != angles.shape[-1]:
        raise OrientationError(
            f"interior orientation: {positions.shape} spot positions and {angles.shape} angles; give one angle per spot"
        )
    try:
        positions, angles = np.broadcast_arrays(positions, angles)
    except ValueError as error:
        raise OrientationError(
            f"interior orientation: sets of spot positions {positions.shape} and angles {angles.shape} do not match"
        ) from error
    if positions.size == 0:
        raise OrientationError("interior orientation: no points; give at least one angle with its spot position")
    for name, values in (("spot position", positions), ("angle", angles)):
        bad = np.argwhere(~np.isfinite(values))
        if bad.size:
            index = ", ".join(str(k) for k in bad[0])
            raise OrientationError(
                f"interior orientation: {name} [{index}] is not finite ({len(bad)} in all); exclude those points"
            )
    widest = float(np.max(np.abs(angles)))
    if widest > _WIDEST:
        raise OrientationError(
            f"interior orientation: an angle of {np.rad2deg(widest):.6g} deg ({widest:.6g} rad) is beyond 45 deg;"
            " give radians, counted from the direction that images to the centre of the line"
        )
    return positions, angles


def distortion(
    position: ArrayLike, angle: ArrayLike, principal_distance: ArrayLike, principal_point: ArrayLike = 0.0
) -> Array:
    """Return the distortion of each of N points, in metres: D = L - f tan W + p tan^2 W.

    The equation is (1) of paper 004 (Li et al. 2020).

    Parameters
    ----------
    position : (..., N) array_like
        Image positions L of the N points, in metres.
    angle : (..., N) array_like
        Angles W of their directions, in radians.
    principal_distance : (...) array_like
        Principal distance f of each set of points, in metres.
    principal_point : (...) array_like
        Principal point p of each set of points, in metres.

    Raises
    ------
    OrientationError
        The readings are invalid.
    """
    positions, angles = readings(position, angle)
    t = np.tan(angles)
    f = np.asarray(principal_distance, dtype=np.float64)[..., None]
    p = np.asarray(principal_point, dtype=np.float64)[..., None]
    return np.asarray(positions - f * t + p * t**2)


def principal_distance_and_point(position: ArrayLike, angle: ArrayLike) -> tuple[Array, Array]:
    """Return the principal distance f and principal point p of smallest distortion, in metres.

    The equation is (2) of paper 004 (Li et al. 2020).

    Parameters
    ----------
    position : (..., N) array_like
        Image positions of N points, in metres; leading axes are sets of points.
    angle : (..., N) array_like
        Angles, in radians, at least two different ones other than zero in each set.

    Raises
    ------
    OrientationError
        The readings are invalid or too few, or angles and positions count in opposite senses.
    """
    positions, angles = readings(position, angle)
    if positions.shape[-1] < 2:
        raise OrientationError("interior orientation: 1 angle for the 2 unknowns f and p; measure at more angles")
    t = np.tan(angles)
    t2, t3, t4 = np.sum(t**2, axis=-1), np.sum(t**3, axis=-1), np.sum(t**4, axis=-1)
    lt, lt2 = np.sum(positions * t, axis=-1), np.sum(positions * t**2, axis=-1)
    determinant = t3**2 - t2 * t4
    if np.any(np.abs(determinant) <= _SINGULAR * t2 * t4):
        raise OrientationError(
            "interior orientation: f and p cannot be separated, because the angles are (nearly) all the same or zero;"
            " turn the turntable between the readings"
        )
    f = (lt2 * t3 - lt * t4) / determinant
    p = (lt2 * t2 - lt * t3) / determinant
    _same_sense(f)
    return np.asarray(f), np.asarray(p)


def principal_distance(position: ArrayLike, angle: ArrayLike) -> Array:
    """Return the balanced principal distance f (...), in metres: paper 004 (Li et al. 2020), eq. (3).

    It leaves the smallest distortion with p = 0.

    Parameters
    ----------
    position : (..., N) array_like
        Image positions of N points, in metres; leading axes are sets of points.
    angle : (..., N) array_like
        Angles, in radians.

    Raises
    ------
    OrientationError
        The readings are invalid, all angles are zero, or angles and positions count in opposite senses.
    """
    positions, angles = readings(position, angle)
    t = np.tan(angles)
    t2 = np.sum(t**2, axis=-1)
    if np.any(t2 == 0):
        raise OrientationError("interior orientation: all angles are zero and do not determine f; turn the turntable")
    f = np.sum(positions * t, axis=-1) / t2
    _same_sense(f)
    return np.asarray(f)


def principal_point(position: ArrayLike, angle: ArrayLike, principal_distance: ArrayLike) -> Array:
    """Return the principal point p (...), in metres, for a known principal distance f (...), in metres.

    The equation is (4) of paper 004 (Li et al. 2020).

    Parameters
    ----------
    position : (..., N) array_like
        Image positions of N points, in metres; leading axes are sets of points.
    angle : (..., N) array_like
        Angles, in radians.
    principal_distance : (...) array_like
        Principal distance of each set, in metres.

    Raises
    ------
    OrientationError
        The readings are invalid, or all angles are zero.
    """
    positions, angles = readings(position, angle)
    t = np.tan(angles)
    t4 = np.sum(t**4, axis=-1)
    if np.any(t4 == 0):
        raise OrientationError("interior orientation: all angles are zero and do not determine p; turn the turntable")
    f = np.asarray(principal_distance, dtype=np.float64)
    return np.asarray((f * np.sum(t**3, axis=-1) - np.sum(positions * t**2, axis=-1)) / t4)


def design(angle: ArrayLike, terms: Sequence[str]) -> Array:
    """Return the derivatives of the image position with respect to P terms of the model, at angles in radians.

    Positions and terms are in metres; the result has shape (..., P) for angles (...).

    Raises
    ------
    OrientationError
        A term is unknown or repeated.
    """
    unknown = [term for term in terms if term not in _POWER]
    if unknown or len(set(terms)) != len(terms):
        raise OrientationError(f"interior orientation: terms must be distinct and out of {TERMS}, found {tuple(terms)}")
    t = np.tan(np.asarray(angle, dtype=np.float64))
    return np.stack([sign * t**power for power, sign in (_POWER[term] for term in terms)], axis=-1)


def slope(angle: ArrayLike, terms: Sequence[str], values: ArrayLike) -> Array:
    """Return the derivative of the image position with respect to the angle, in m/rad, of a fitted model.

    Parameters
    ----------
    angle : (...) array_like
        Angles, in radians.
    terms : sequence of str
        Names out of `TERMS`.
    values : (P,) array_like
        Values of the P terms, in metres.
    """
    t = np.tan(np.asarray(angle, dtype=np.float64))
    powers = [_POWER[term] for term in terms]
    steps = np.stack([sign * power * t ** max(power - 1, 0) for power, sign in powers], axis=-1)
    return np.asarray((steps @ np.asarray(values, dtype=np.float64)) * (1.0 + t**2))


def _same_sense(f: Array) -> None:
    """Raise OrientationError for a negative principal distance: angles and positions count in opposite senses."""
    if np.any(f <= 0):
        raise OrientationError(
            f"interior orientation: the principal distance comes out as {float(np.min(f)):.6g} m; angles and spot"
            " positions count in opposite senses, change the sign of one of them"
        )


_WORST_CONDITION = 1e3
"""Largest condition number of columns of unit length: the ratio of the sigmas of the worst and the best combination of
terms. Five terms over half a field have 270; f and a constant reach 1000 when the angles lie within 1 % of each other.
"""


def _check_separable(columns: Array, names: tuple[str, ...], angle: Array) -> None:
    """Raise OrientationError, naming the terms of the worst combination, if the angles do not separate the terms.

    Parameters
    ----------
    columns : (N, P) ndarray
        Derivatives of the positions of N points with respect to P terms.
    names : tuple of str
        Names of the terms.
    angle : (N,) ndarray
        Angles, in radians.
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
        f"interior orientation: angles from {low:.6g} to {high:.6g} deg{side}, cannot separate {', '.join(mixed)} "
        f"(condition number {condition:.2g}); measure at more angles over both halves of the field, or omit a term"
    )


def _noise_matrix(values: ArrayLike, count: int, name: str) -> Array:
    """Return the covariance (N, N) of N values from their covariance, their sigmas (N,) or one common sigma.

    Parameters
    ----------
    values : array_like
        Covariance (N, N), or sigmas (N,) or ().
    count : int
        Number of points, N.
    name : str
        Name of the noisy quantity, for messages.

    Raises
    ------
    OrientationError
        The shape is wrong, a value is not finite, or a sigma is negative.
    """
    noise = np.asarray(values, dtype=np.float64)
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
    """Return the lower Cholesky factor of the covariance of N values, (N, N), with which errors are whitened.

    Raises
    ------
    OrientationError
        The covariance is not positive definite.
    """
    sigma = np.sqrt(np.maximum(np.diagonal(noise), 0.0))
    least = np.min(np.linalg.eigvalsh(noise / np.outer(sigma, sigma))) if np.all(sigma > 0) else 0.0
    # eigenvalues below the rounding error of the matrix are not significantly positive
    if least <= 1e-14 * len(noise):
        raise OrientationError(
            "interior orientation: the noise is zero or fully common in some combination of points (its covariance is"
            " not positive definite); add the sigmas of the single spots"
        )
    return np.asarray(np.linalg.cholesky(noise))


_SIGNIFICANT = 3.0
"""Ratio to its sigma above which a principal point counts as different from zero: false-alarm rate 0.3 %."""
POINT_TOLERANCE = 10e-6
"""Largest sigma, in metres, of an observable principal point: about a pixel, the size that paper 004 (Li et al. 2020)
expects of it."""


@dataclass(frozen=True, eq=False)
class PointReport:
    """Observability of the principal point p in a test.

    Attributes
    ----------
    observable : bool
        True if the sigma of p, or of a p fitted in addition to the other terms, is at most `POINT_TOLERANCE`.
    sentence : str
        Sentence that reports the result with its sigma.
    """

    observable: bool
    sentence: str


def _point_report(names: tuple[str, ...], values: Array, angle: Array, noise: Array) -> PointReport:
    """Return the observability of the principal point from a fit of given terms, or of a fit with it added.

    Parameters
    ----------
    names : tuple of str
        Names of P terms.
    values : (P,) ndarray
        Values of the terms, in metres.
    angle : (N,) ndarray
        Angles of N points, in radians.
    noise : (N, N) ndarray
        Covariance of the positions, in m^2.
    """
    fitted = "principal_point" in names
    names_with_point = names if fitted else (*names, "principal_point")
    k = names_with_point.index("principal_point")
    columns = design(angle, names_with_point)
    try:
        if len(columns) < len(names_with_point):
            raise OrientationError("interior orientation: no point is left for p")
        _check_separable(columns, names_with_point, angle)
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
    symmetric = abs(low + high) < 0.01 * (high - low)
    field = f"+-{0.5 * (high - low):.4g} deg" if symmetric else f"{low:.4g} to {high:.4g} deg"
    caveat = "A decentring distortion would give the same tan^2 term."
    size = f"p = {1e3 * value:.2g} +- {1e3 * sigma:.2g} mm"
    effect = (
        f"one sigma moves the edge of the field by {1e6 * edge:.2g} um, compared with {1e6 * typical:.2g} um of noise"
    )
    if not fitted:
        if np.isfinite(sigma):
            verdict = "observable" if observable else "not observable"
            text = f"p is fixed at zero; if fitted, its sigma would be {1e3 * sigma:.2g} mm: {verdict} over {field}."
        else:
            text = f"p is fixed at zero; the angles, {field}, do not separate it from the other terms."
    elif observable:
        text = (
            f"{size}: observable over {field}"
            + (". " if significant else ", and not significantly different from zero. ")
            + caveat
        )
    elif significant:
        text = (
            f"{size}: the tan^2 term is significant, but as a principal point it is not observable over {field} to"
            f" {1e6 * POINT_TOLERANCE:.3g} um. {caveat}"
        )
    else:
        text = f"{size}: not observable over {field}; {effect}; take p = 0 (eq. 3). {caveat}"
    return PointReport(observable, text)


_WORST_DISTANCE = 0.1
"""Largest relative sigma of a principal distance; with a larger one the angles are nearly constant."""


@dataclass(frozen=True, eq=False)
class InteriorOrientation:
    """Interior orientation of a line camera: P terms fitted to N points.

    Attributes
    ----------
    terms : (P,) tuple of str
        Names of the terms, out of `TERMS`.
    values : (P,) ndarray
        Values of the terms, in metres.
    covariance : (P, P) ndarray
        Covariance of the values, in m^2.
    angle : (N,) ndarray
        Measured angles, in radians.
    position : (N,) ndarray
        Measured image positions, in metres.
    noise : (N, N) ndarray
        Covariance of positions and angles together, as positions, in m^2.
    residual : (N,) ndarray
        Position minus model, in metres.
    chi_square : float
        Smallest sum of squared residuals weighted by the inverse covariance of the noise.
    degrees_of_freedom : int
        Degrees of freedom of the chi-square, N - P.
    point : PointReport
        Observability of the principal point.
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
        """Return the value of a term, in metres; zero for a term that was not fitted."""
        k = self._column(term)
        return 0.0 if k is None else float(self.values[k])

    def sigma(self, term: str) -> float:
        """Return the standard deviation of a term, in metres; zero for a term that was not fitted."""
        k = self._column(term)
        return 0.0 if k is None else float(np.sqrt(self.covariance[k, k]))

    def _column(self, term: str) -> int | None:
        """Return the column of a term; None for one that was not fitted, ValueError for one that does not exist."""
        if term not in TERMS:
            raise ValueError(f"unknown term {term!r}; the terms are {', '.join(TERMS)}")
        return self.terms.index(term) if term in self.terms else None

    @property
    def correlation(self) -> Array:
        """Correlation matrix of the P fitted terms, (P, P), in the order of `terms`."""
        sigma = np.sqrt(np.diagonal(self.covariance))
        return np.asarray(self.covariance / np.outer(sigma, sigma))

    @property
    def residual_covariance(self) -> Array:
        """Covariance of the residuals of N points, (N, N), in m^2; its rank is N - P for P fitted terms."""
        columns = design(self.angle, self.terms)
        left = np.eye(len(self.angle)) - columns @ gain(columns)
        return np.asarray(left @ self.noise @ left.T)

    @property
    def probability(self) -> float:
        """p-value of the chi-square; NaN without degrees of freedom."""
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
        Image positions L of N points along the line, in metres.
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
    positions, angles = readings(position, angle)
    names = tuple(terms)
    if positions.ndim != 1:
        raise OrientationError(f"interior orientation: readings must be (N,), found {positions.shape}; fit set by set")
    if "principal_distance" not in names:
        raise OrientationError("interior orientation: principal_distance must be among the terms")
    columns = design(angles, names)
    distinct = len(np.unique(angles))
    if distinct == 1:
        raise OrientationError("interior orientation: all angles are the same; turn the turntable between the readings")
    if distinct < len(names):
        raise OrientationError(
            f"interior orientation: {distinct} different angles for {len(names)} unknowns ({', '.join(names)}); measure"
            " at more angles or fit fewer terms"
        )
    _check_separable(columns, names, angles)
    solve = gain(columns)
    values = solve @ positions
    noise = _noise_matrix(covariance, len(positions), "covariance")
    if angle_covariance is not None:
        rate = slope(angles, names, values)
        noise = noise + rate[:, None] * _noise_matrix(angle_covariance, len(positions), "angle_covariance") * rate
    root = _noise_root(noise)
    best = gain(columns, root)
    spread = solve @ noise @ solve.T
    k = names.index("principal_distance")
    f, sigma = float(values[k]), float(np.sqrt(spread[k, k]))
    if sigma > _WORST_DISTANCE * abs(f):
        raise OrientationError(
            f"interior orientation: f = {f:.3g} +- {sigma:.2g} m; the angles span only {np.ptp(angles):.3g} rad, too"
            " little for their noise; turn the turntable over the whole field"
        )
    _same_sense(values[k])
    return InteriorOrientation(
        terms=names,
        values=values,
        covariance=spread,
        angle=angles,
        position=positions,
        noise=noise,
        residual=positions - columns @ values,
        chi_square=float(np.sum(np.linalg.solve(root, positions - columns @ (best @ positions)) ** 2)),
        degrees_of_freedom=len(positions) - len(names),
        point=_point_report(names, values, angles, noise),
    )


LINE_TERMS = ("axis", "principal_distance", "principal_point", "k1")
"""Names of the unknowns of the line model: reading of the camera's Z axis, principal distance, principal point, radial
distortion. The last three are keys of a line in a payload file.
"""
_STEPS = 20
"""Largest number of Gauss-Newton steps of the fit of the line model."""


@dataclass(frozen=True, eq=False)
class LineOrientation:
    """Parameters of the line model of a camera (`LINE_TERMS`) with their covariance.

    Attributes
    ----------
    values : (4,) ndarray
        Reading of the camera's Z axis (rad), principal distance f (m), principal point y0 (m) and radial distortion k1
        (1/m^2).
    covariance : (4, 4) ndarray
        Covariance of the values, in these units.
    """

    values: Array
    covariance: Array

    @property
    def sigma(self) -> Array:
        """Standard deviations of axis reading (rad), principal distance (m), principal point (m) and k1 (1/m^2)."""
        return np.sqrt(np.diagonal(self.covariance))


def _model(values: Array, position: Array) -> tuple[Array, Array, Array]:
    """Return the angle of each of N image positions, and its derivatives, by the line model.

    Returned are angles W (N,) in radians, their derivatives with respect to the four values (N, 4), and the derivatives
    of position with respect to angle (N,), in m/rad.
    """
    axis, f, point, k1 = values
    u = position - point
    tangent = u * (1.0 + k1 * u**2) / f
    derivative = 1.0 / (1.0 + tangent**2)
    slope_of_angle = (1.0 + 3.0 * k1 * u**2) / f * derivative
    columns = np.stack([np.ones_like(u), -tangent / f * derivative, -slope_of_angle, u**3 / f * derivative], axis=-1)
    return np.asarray(axis + np.arctan(tangent)), columns, np.asarray(1.0 / slope_of_angle)


def line_orientation(fit: InteriorOrientation) -> LineOrientation:
    """Convert an interior orientation to principal distance, principal point and k1 of a line.

    It is a least-squares fit in the image at the same points with equal weights.

    Parameters
    ----------
    fit : InteriorOrientation
        Fit of constant, principal_distance, principal_point and radial3 and no other terms, which serve as start
        values.

    Raises
    ------
    OrientationError
        The fit has other terms, or the iteration does not converge.
    """
    if set(fit.terms) != {"constant", "principal_distance", "principal_point", "radial3"}:
        raise OrientationError(f"interior orientation: the terms {fit.terms} do not determine the line model")
    c, f, p, k3 = (fit.value(name) for name in ("constant", "principal_distance", "principal_point", "radial3"))
    point = p / (1.0 + 3.0 * k3 / f)
    values = np.array([(point - c) / f, f, point, -k3 / f**3])
    for _ in range(_STEPS):
        with np.errstate(all="ignore"):  # steps from degenerate values may overflow
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
"""Names of the terms that are subtracted to obtain the distortion: those of eq. (2) of paper 004 (Li et al. 2020), with
a constant."""
SMOOTH = (*CALIBRATED, "radial3")
"""Names of the terms of the smooth model (with radial distortion), whose residuals measure the scatter of the points.
"""


@dataclass(frozen=True, eq=False)
class Spots:
    """Located spots of N points in S repeated sets on the line CCD.

    Attributes
    ----------
    position : (N, S) ndarray
        Positions L, in metres.
    temporal : (N, S) ndarray
        Sigma from noise that is independent in each frame, in metres.
    fixed : (N, S) ndarray
        Sigma from differences of the line's columns, constant while the spot does not move, in metres.
    row : (N, S) ndarray
        Row of the spot in its image, in pixels.
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
    """Locate spots on the line by energy centroids.

    Parameters
    ----------
    frames : (N, S, frames, H, W) ndarray of uint16
        Frames, H rows by W columns, of N points in S sets.
    column : (N, S) array_like
        Column of the line at which each image begins.
    middle : float
        Column of the line's middle, where L = 0.
    pitch : float
        Pixel pitch, in metres.
    noise : NoiseModel
        Noise of one frame; its fixed pattern is constant along columns, because every row of a TDI line is collected by
        the same pixels.
    radius : float
        Radius of the centroid's window, in pixels.
    offset : float or (N,) array_like
        Energy centroid minus chief ray by the camera's design, in metres, which is subtracted.

    Raises
    ------
    SpotError
        A spot is saturated, absent, or too near the edge of its image.
    """
    count, sets, number = frames.shape[:3]
    spots = energy_centroid(mean_frames(frames).reshape(count * sets, *frames.shape[3:]), number, noise, radius)
    assert spots.gain_maps is not None
    assert spots.light_dn is not None
    influence = spots.gain_maps[:, 1]
    gain = np.sum(np.sum(influence * spots.light_dn, axis=1) ** 2, axis=-1) * noise.prnu**2
    dark = np.sum(np.sum(influence, axis=1) ** 2, axis=-1) * noise.dsnu_variance_dn2
    shape = count, sets
    line_position = (np.asarray(column) + spots.column.reshape(shape) - middle) * pitch
    return Spots(
        position=line_position - np.broadcast_to(np.asarray(offset, np.float64), (count,))[:, None],
        temporal=pitch * np.sqrt(spots.temporal_covariance[:, 1, 1]).reshape(shape),
        fixed=pitch * np.sqrt(gain + dark).reshape(shape),
        row=spots.row.reshape(shape),
    )


@dataclass(frozen=True, eq=False)
class PointMeans:
    """Repeated measurements of N points in S sets, reduced to one per point.

    Attributes
    ----------
    keep : (N, S) ndarray of bool
        Exposures that Chauvenet's criterion keeps.
    scatter : float
        Sigma of one exposure from the scatter between the sets, in metres, or as specified if there is only one set.
    sigma : (N,) ndarray
        Sigma of the mean of each point, without errors common to all sets, in metres.
    """

    keep: NDArray[np.bool_]
    scatter: float
    sigma: Array

    def mean(self, values: Array) -> Array:
        """Return the mean of values (N, S) over those of S sets that are kept at each of N points, (N,)."""
        return np.asarray(np.mean(values, axis=1, where=self.keep))


def reduce_sets(
    angle: Array, spots: Spots, principal_distance: float, single: float, present: NDArray[np.bool_] | None = None
) -> PointMeans:
    """Detect gross errors among the sets and estimate the noise of the means.

    In each set, L - f tan W of a point differs from its mean over the sets by the repeatability of the table and by
    noise, both estimated from the sets themselves.

    Parameters
    ----------
    angle : (N, S) ndarray
        Angles W of N points in S sets, from the readings of the turntable, in radians.
    spots : Spots
        Located spots.
    principal_distance : float
        Approximate principal distance, in metres.
    single : float
        Sigma of one exposure, in metres, for a test with one set.
    present : (N, S) ndarray of bool, optional
        True for exposures that exist, if sets lack points; the others may hold any finite numbers. All by default.
    """
    deviation = spots.position - principal_distance * np.tan(angle)
    # errors that do not average out while the spot stays on the same pixels
    fixed = np.sqrt(np.mean(spots.fixed**2, axis=1, where=True if present is None else present))
    count, sets = deviation.shape
    if sets < 2:
        single_sigma = np.hypot(single, spots.temporal[:, 0])
        return PointMeans(
            np.ones(deviation.shape, bool), float(np.sqrt(np.mean(single_sigma**2))), np.hypot(single_sigma, fixed)
        )
    # the comparison of the table with the camera has the form of a calibration series, in other units
    series = CalibrationSeries(np.arange(count, dtype=float), deviation, present=present)
    return PointMeans(series.keep, series.repeatability, np.hypot(series.noise_sigma, fixed))


def _white(fitted: Callable[[float], InteriorOrientation]) -> float:
    """Return the additional white noise, in metres, that brings chi-square to its expectation.

    The result is zero if chi-square does not exceed its expectation.

    It is the estimator of Paule and Mandel (J. Res. Natl. Bur. Stand. 87, 377 (1982)). Chi-square decreases steadily
    with the noise.
    """
    unscaled = fitted(0.0)
    if unscaled.degrees_of_freedom == 0 or unscaled.chi_square <= unscaled.degrees_of_freedom:
        return 0.0

    def beyond(size: float) -> float:
        fit = fitted(size)
        return fit.chi_square - fit.degrees_of_freedom

    # white noise of sigma s alone leaves chi-square <= sum(residual^2) / s^2, which is N - P at the upper end
    upper = float(np.sqrt(np.sum(unscaled.residual**2) / unscaled.degrees_of_freedom))
    return float(brentq(beyond, 0.0, upper, xtol=1e-11))


@dataclass(frozen=True, eq=False)
class Distortion:
    """Distortion of a line camera, measured with one kind of turntable angles (as read, or compensated).

    Attributes
    ----------
    angle : (N, S) ndarray
        Angle W of each exposure of N points in S sets, in radians.
    position : (N, S) ndarray
        Image position L of each exposure, in metres.
    means : PointMeans
        Reduction of the sets.
    fit : InteriorOrientation
        Fit of the calibrated terms; its residual is the distortion D of the mean of the sets, (N,), in metres.
    smooth : InteriorOrientation
        The fit with radial distortion added; its residual is the part that is not smooth.
    white : float
        Additional sigma of each point's position, in metres, which the noise of both fits includes.
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
        """Fit interior orientation and distortion of a line camera to located spots.

        Parameters
        ----------
        angle : (N, S) ndarray
            Angles W of N points in S sets, in radians.
        spots : Spots
            Located spots.
        means : PointMeans
            Reduction of the sets.
        angle_covariance : (N, N) array_like, optional
            Covariance of the mean angles, in rad^2: errors common to all sets of a point, without those that are
            independent from point to point.

        Raises
        ------
        OrientationError
            There are fewer points than unknowns, or the angles do not determine them.
        """
        positions, angles = means.mean(spots.position), means.mean(angle)

        def fitted(terms: tuple[str, ...], white: float) -> InteriorOrientation:
            sigma = np.hypot(means.sigma, white)
            return fit_interior_orientation(positions, angles, sigma, terms, angle_covariance=angle_covariance)

        white = _white(lambda size: fitted(SMOOTH, size))
        fit, smooth = fitted(CALIBRATED, white), fitted(SMOOTH, white)
        return cls(angle, spots.position, means, fit, smooth, white)

    @property
    def distortion(self) -> Array:
        """Distortion of each of N points: measured image position minus the calibrated model, in metres."""
        return self.fit.residual

    @property
    def sigma(self) -> Array:
        """Standard deviation of the distortion of each of N points, (N,), in metres."""
        return np.sqrt(np.maximum(np.diagonal(self.fit.residual_covariance), 0.0))

    @property
    def zero(self) -> float:
        """Angle of the direction that images to the middle of the line, from the fitted constant, in radians."""
        return -self.fit.value("constant") / self.fit.value("principal_distance")

    @property
    def rms_over_sets(self) -> Array:
        """RMS of each of N points' distortion over the kept sets, each set fitted separately, in metres.

        The values are named after Table 2 of paper 004 (Li et al. 2020).
        """
        out = np.full(self.position.shape, np.nan)
        for s, keep in enumerate(self.means.keep.T):
            out[keep, s] = fit_interior_orientation(
                self.position[keep, s], self.angle[keep, s], self.means.scatter, CALIBRATED
            ).residual
        return np.asarray(np.sqrt(np.mean(out**2, axis=1, where=self.means.keep)))
