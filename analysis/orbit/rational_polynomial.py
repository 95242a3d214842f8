"""Rational polynomials of an image (RPC): line and sample as ratios of cubics in latitude, longitude and height.

The coefficients are in the order of RPC00B (NIMA STDI-0002), which all photogrammetric software reads. Coordinates are
scaled to -1 .. 1 over the ground that the fit covers; the polynomials must not be used beyond it. Image coordinates
count from the centre of the first pixel, and heights are above the ellipsoid (WGS84).

Reference: Tao and Hu, Photogramm. Eng. Remote Sens. 67, 1347 (2001).

Image-space correction of an image's sensor model from control points: a shift or an affine function.

Each point has a covariance in the image, from its measurement and from its ground coordinates. The estimate is the
generalised least-squares one; its covariance follows from those of the points alone, and chi-square of the residuals
tests these covariances. Points whose residuals exceed their covariances are excluded one after the other, the largest
first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis import statistics
from analysis.arrays import Array, UndeterminedError
from optics.numerics.backend import one_blas_thread

TERMS = 20
"""Number of coefficients of a cubic polynomial in three coordinates."""
_POWERS = np.array(
    [
        *((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2)),
        *((1, 1, 1), (3, 0, 0), (1, 2, 0), (1, 0, 2), (2, 1, 0), (0, 3, 0), (0, 1, 2), (2, 0, 1), (0, 2, 1), (0, 0, 3)),
    ]
)
"""Powers of longitude, latitude and height in the order of RPC00B."""
_AXES = (1, 0, 2)
"""Positions of longitude, latitude and height among scaled latitude, longitude and height."""
_ROUNDS = 6
"""Number of reweighted least-squares solutions; the weights are the inverse denominators."""
_RANK = 1e-11
"""Smallest singular value that is used, relative to the largest: an image determines fewer combinations than a cubic
ratio has coefficients, and the others stay small."""
_DAMPING = (0.0, 1e-8, 1e-6, 1e-4, 1e-2, 1.0)
"""Strengths of the regularisation of the denominators that are tried; with the largest, denominators are almost 1 and
the ratios almost polynomials.
"""
_EXACT_PX = 1e-7
"""Rms error at the check points, in pixels, of a fit that no other regularisation is compared with."""
_ARRIVED = 1e-9
"""Newton step of ground coordinates, relative to the half extent of the fitted area, below which the iteration has
converged.
"""
_MOST_STEPS = 30
"""Largest number of Newton steps from image to ground coordinates."""
_COEFFICIENTS = 50844
"""Code of the TIFF tag RPCCoefficientTag, which holds the rational polynomials."""
_UNSTATED = -1.0
"""Value of ERR_BIAS and ERR_RAND in RPCCoefficientTag that marks them as unknown."""
_WIDEST = 90.0
"""Extent in longitude from which the ground counts as lying on a pole or the 180th meridian, degrees."""


@dataclass(frozen=True, eq=False)
class RationalPolynomial:
    """Rational polynomials of an image and their accuracy.

    Attributes
    ----------
    offset : (5,) ndarray
        Offsets of line, sample, latitude, longitude (degrees) and height (metres).
    scale : (5,) ndarray
        Scales of line, sample, latitude, longitude (degrees) and height (metres).
    line_numerator, line_denominator, sample_numerator, sample_denominator : (20,) ndarray
        Coefficients in the order of RPC00B.
    error_px : tuple of float
        Largest error of line and sample at points that were not fitted, in pixels; NaN for polynomials read from a
        file.
    rms_px : tuple of float
        Rms error at these points, in pixels.
    bias_m : float or None
        ERR_BIAS, in metres: rms error of each horizontal axis on the ground that does not vary with time and is common
        to points and images (GDAL's RFC 22; 68 % in STDI-0002); None if unknown.
    random_m : float or None
        ERR_RAND, in metres: rms error of each horizontal axis that varies with time, independent between images or
        points; None if unknown.
    """

    offset: Array
    scale: Array
    line_numerator: Array
    line_denominator: Array
    sample_numerator: Array
    sample_denominator: Array
    error_px: tuple[float, float] = (np.nan, np.nan)
    rms_px: tuple[float, float] = (np.nan, np.nan)
    bias_m: float | None = None
    random_m: float | None = None

    def ground(self, line: ArrayLike, sample: ArrayLike, height: ArrayLike) -> tuple[Array, Array]:
        """Return latitude and longitude (degrees) that lines and samples see at heights above the ellipsoid (metres).

        Newton's method starts at the middle of the ground; NaN where it does not converge. The arguments are broadcast.
        """
        wanted = np.stack(np.broadcast_arrays(line, sample), axis=-1).astype(np.float64)
        at = np.broadcast_to(np.asarray(height, np.float64), wanted.shape[:-1])
        position = np.broadcast_to(self.offset[2:4], wanted.shape)
        for _ in range(_MOST_STEPS):
            here, slope = self.linearised(position[..., 0], position[..., 1], at)
            move = np.linalg.solve(slope[..., :2], (wanted - here)[..., None])[..., 0]
            # a larger step would leave the ground on which the polynomials are valid
            position = position + np.clip(move, -self.scale[2:4], self.scale[2:4])
            if np.all(np.abs(move) < _ARRIVED * self.scale[2:4]):
                break
        converged = np.all(np.abs(move) < _ARRIVED * self.scale[2:4], axis=-1)
        position = np.where(converged[..., None], position, np.nan)
        return position[..., 0], position[..., 1]

    def image(self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> tuple[Array, Array]:
        """Return line and sample, in pixels, of ground points: latitude and longitude in degrees, height in metres.

        The arguments are broadcast.
        """
        basis = _monomials(self._scaled(latitude, longitude, height))
        line = basis @ self.line_numerator / (basis @ self.line_denominator)
        sample = basis @ self.sample_numerator / (basis @ self.sample_denominator)
        return self.offset[0] + self.scale[0] * line, self.offset[1] + self.scale[1] * sample

    def linearised(self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> tuple[Array, Array]:
        """Return line and sample of ground points and their derivatives with respect to the ground coordinates.

        Parameters
        ----------
        latitude, longitude, height : array_like
            Ground coordinates (...) in degrees and metres; they are broadcast.

        Returns
        -------
        tuple of ndarray
            Line and sample (..., 2), in pixels, and their derivatives (..., 2, 3) with respect to latitude, longitude
            (pixels per degree) and height (pixels per metre).
        """
        unit = self._scaled(latitude, longitude, height)
        parts = (self.line_numerator, self.sample_numerator, self.line_denominator, self.sample_denominator)
        coefficients = np.stack(parts, axis=1)
        # (..., 4) and (..., 3, 4): numerators of line and sample, and their denominators
        values, slopes = _monomials(unit) @ coefficients, _monomial_slopes(unit) @ coefficients
        ratio, below = values[..., :2] / values[..., 2:], values[..., None, 2:]
        by_unit = (slopes[..., :2] - ratio[..., None, :] * slopes[..., 2:]) / below
        by_ground = np.swapaxes(by_unit, -1, -2) * self.scale[:2, None] / self.scale[2:]
        return self.offset[:2] + self.scale[:2] * ratio, by_ground

    def _scaled(self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> Array:
        """Return scaled latitude, longitude and height (..., 3); longitudes may differ by a whole circle."""
        position = np.stack(np.broadcast_arrays(latitude, longitude, height), axis=-1) - self.offset[2:]
        position[..., 1] = np.remainder(position[..., 1] + 180.0, 360.0) - 180.0
        return np.asarray(position / self.scale[2:])

    def text(self) -> str:
        """Return the polynomials as the text of a file NAME_RPC.TXT, which GDAL reads beside NAME.tif."""
        names = (("LINE", "pixels"), ("SAMP", "pixels"), ("LAT", "degrees"), ("LONG", "degrees"), ("HEIGHT", "meters"))
        errors = (("ERR_BIAS", self.bias_m), ("ERR_RAND", self.random_m))
        rows = [f"{name}: {value!r} meters" for name, value in errors if value is not None]
        rows += [
            f"{name}_{what}: {value!r} {unit}"
            for what, values in (("OFF", self.offset), ("SCALE", self.scale))
            for (name, unit), value in zip(names, values.tolist(), strict=True)
        ]
        parts = {
            "LINE_NUM": self.line_numerator,
            "LINE_DEN": self.line_denominator,
            "SAMP_NUM": self.sample_numerator,
            "SAMP_DEN": self.sample_denominator,
        }
        rows += [f"{name}_COEFF_{k + 1}: {v!r}" for name, part in parts.items() for k, v in enumerate(part.tolist())]
        return "\n".join(rows) + "\n"

    def tags(self) -> list[tuple[Any, ...]]:
        """Return the GeoTIFF tag RPCCoefficientTag, in the order of RPC00B.

        Its values are the errors (-1 if unknown), offsets, scales and coefficients.
        """
        parts = (self.line_numerator, self.line_denominator, self.sample_numerator, self.sample_denominator)
        errors = (_UNSTATED if error is None else error for error in (self.bias_m, self.random_m))
        values = (*errors, *self.offset.tolist(), *self.scale.tolist(), *np.concatenate(parts).tolist())
        return [(_COEFFICIENTS, "d", len(values), values, True)]


def fit_rpc(
    image: ArrayLike, ground: ArrayLike, *, check: tuple[ArrayLike, ArrayLike] | None = None
) -> RationalPolynomial:
    """Fit rational polynomials to image and ground coordinates of points.

    Denominators of line and sample are fitted separately. Of several strengths of regularisation, the one with the
    smallest error at the check points is chosen.

    Parameters
    ----------
    image : (N, 2) array_like
        Line and sample of N points, in pixels; the centre of the first pixel is (0, 0).
    ground : (N, 3) array_like
        Latitude and longitude (degrees) and height above the ellipsoid (metres). The points must cover several heights.
    check : tuple of (M, 2) and (M, 3) array_like, optional
        Image and ground coordinates of M check points between the others. By default every fourth point is a check
        point.

    Returns
    -------
    RationalPolynomial
        The polynomials, with the methods `image` and `ground`; `error_px` and `rms_px` are their errors at the check
        points.

    Raises
    ------
    ValueError
        Arrays of other shapes, values that are not finite, a coordinate that is constant, fewer than 39 points to fit,
        or ground on a pole or the 180th meridian.

    Notes
    -----
    Tao and Hu, Photogramm. Eng. Remote Sens. 67, 1347 (2001); the order of the coefficients is that of NIMA STDI-0002.

    Examples
    --------
    A frame camera above 48 deg north, 11 deg east, whose perspective images are ratios of polynomials:

    >>> import numpy as np
    >>> import analysis
    >>> rng = np.random.default_rng(8)
    >>> ground = rng.uniform([47.9, 10.9, 0.0], [48.1, 11.1, 2000.0], (400, 3))  # latitude, longitude, height
    >>> north, east = 111e3 * (ground[:, 0] - 48), 74e3 * (ground[:, 1] - 11)
    >>> image = 5000 + 5e5 * np.column_stack([-north, east]) / (600e3 - ground[:, 2])[:, None]
    >>> rpc = analysis.fit_rpc(image, ground)
    >>> max(rpc.error_px) < 1e-6
    True
    >>> line, sample = rpc.image(48.0, 11.0, 500.0)
    >>> round(float(line), 3), round(float(sample), 3)
    (5000.0, 5000.0)
    >>> latitude, longitude = rpc.ground(line, sample, 500.0)
    >>> round(float(latitude), 6), round(float(longitude), 6)
    (48.0, 11.0)
    >>> print(rpc.text()[:9])
    LINE_OFF:
    """
    points = _checked_points(image, ground)
    if check is None:
        checked = np.arange(len(points)) % 4 == 3
        points, others = points[~checked], points[checked]
    else:
        others = _checked_points(*check)
    ends = np.stack([np.min(points, axis=0), np.max(points, axis=0)])
    if ends[1, 3] - ends[0, 3] > _WIDEST:
        raise ValueError("the ground lies on the 180th meridian or a pole, where longitudes jump")
    offset, scale = np.mean(ends, axis=0), 0.5 * (ends[1] - ends[0])
    if len(points) < 2 * TERMS - 1 or not len(others):
        raise UndeterminedError(
            f"rational polynomials: {len(points)} points to fit and {len(others)} to check; need at least"
            f" {2 * TERMS - 1} and 1"
        )
    if not np.all(scale > 0.0):
        constant = ("line", "sample", "latitude", "longitude", "height")[int(np.argmin(scale))]
        raise UndeterminedError(
            f"rational polynomials: {constant} is constant; spread the points over every coordinate"
        )
    sides = [(_monomials((seen[:, 2:] - offset[2:]) / scale[2:]), seen) for seen in (points, others)]
    best = [_best(sides, k, offset[k], scale[k]) for k in range(2)]
    (line, line_most, line_rms), (sample, sample_most, sample_rms) = best
    return RationalPolynomial(offset, scale, *line, *sample, (line_most, sample_most), (line_rms, sample_rms))


def _checked_points(image: ArrayLike, ground: ArrayLike) -> Array:
    """Return image (line, sample) and ground coordinates of N points side by side, (N, 5).

    Raises
    ------
    ValueError
        Arrays of other shapes, or values that are not finite.
    """
    left, right = np.asarray(image, np.float64), np.asarray(ground, np.float64)
    if left.ndim != 2 or left.shape[1] != 2 or right.shape != (len(left), 3):
        raise ValueError(
            f"rational polynomials: need image (N, 2) and ground (N, 3), found {left.shape}, {right.shape}"
        )
    both = np.concatenate([left, right], axis=1)
    if not np.all(np.isfinite(both)):
        raise ValueError("rational polynomials: coordinates must be finite; exclude other points")
    return both


def _monomials(unit: Array) -> Array:
    """Return the 20 monomials (..., 20) of scaled latitude, longitude and height (..., 3)."""
    return _products(*(_powers(unit[..., k]) for k in _AXES))


def _monomial_slopes(unit: Array) -> Array:
    """Return the derivatives (..., 3, 20) of the monomials with respect to scaled latitude, longitude and height."""
    longitude, latitude, height = (_powers(unit[..., k]) for k in _AXES)
    by_longitude, by_latitude, by_height = (
        power[..., [0, 0, 1, 2]] * [0.0, 1.0, 2.0, 3.0] for power in (longitude, latitude, height)
    )
    slopes = np.empty((*unit.shape[:-1], 3, TERMS))
    slopes[..., 0, :] = _products(longitude, by_latitude, height)
    slopes[..., 1, :] = _products(by_longitude, latitude, height)
    slopes[..., 2, :] = _products(longitude, latitude, by_height)
    return slopes


def _powers(value: Array) -> Array:
    """Return the powers 0 to 3 of values (...), (..., 4)."""
    powers = np.ones((*np.shape(value), 4))
    for k in range(3):
        np.multiply(powers[..., k], value, out=powers[..., k + 1])
    return powers


def _products(longitude: Array, latitude: Array, height: Array) -> Array:
    """Return products (..., 20) of powers (..., 4) of the three coordinates, in the order of RPC00B."""
    return longitude[..., _POWERS[:, 0]] * latitude[..., _POWERS[:, 1]] * height[..., _POWERS[:, 2]]


def _best(
    sides: list[tuple[Array, Array]], k: int, offset: float, scale: float
) -> tuple[tuple[Array, Array], float, float]:
    """Return numerator and denominator of one image coordinate, and its largest and rms error at the check points.

    Attitude jitter is not described by cubics: coefficients that follow it at the fitted points are wrong between them.
    The strength of regularisation with the smallest rms error at the check points is therefore chosen.
    """
    (basis, fitted), (others, checked) = sides
    candidates: list[tuple[float, float, tuple[Array, Array]]] = []
    for damping in _DAMPING:
        ratio = _ratio(basis, (fitted[:, k] - offset) / scale, damping)
        below = others @ ratio[1]
        if not np.all(below > 0.0):  # a pole on the ground
            continue
        away = offset + scale * (others @ ratio[0]) / below - checked[:, k]
        candidates.append((float(np.sqrt(np.mean(away**2))), float(np.max(np.abs(away))), ratio))
        if candidates[-1][0] < _EXACT_PX:
            break
    if not candidates:
        raise UndeterminedError("rational polynomials: every fit has a pole on the ground; use more points")
    rms, most, ratio = min(candidates, key=lambda candidate: candidate[0])
    return ratio, most, rms


@one_blas_thread()
def _ratio(basis: Array, value: Array, damping: float) -> tuple[Array, Array]:
    """Return numerator (20,) and denominator (20,), whose first coefficient is 1, of the ratio that fits N values.

    The ratio is fitted by iterated linear least squares, weighted with the inverse of the previous denominator.
    `damping` regularises the coefficients of the denominator.
    """
    weight = np.ones(len(value))
    damped = np.concatenate([np.zeros(TERMS), np.full(TERMS - 1, damping * np.sqrt(len(value)))])
    solution = np.zeros(2 * TERMS - 1)
    for _ in range(_ROUNDS):
        rows = np.concatenate([basis, -value[:, None] * basis[:, 1:]], axis=1) * weight[:, None]
        rows, right = np.concatenate([rows, np.diag(damped)]), np.concatenate([value * weight, np.zeros(len(damped))])
        solution = np.linalg.lstsq(rows, right, rcond=_RANK)[0]
        weight = 1.0 / (1.0 + basis[:, 1:] @ solution[TERMS:])
        if not np.all(np.isfinite(weight) & (weight > 0.0)):
            break
    return solution[:TERMS], np.concatenate([[1.0], solution[TERMS:]])


Kind = Literal["shift", "affine"]

_FALSE_ALARM = 1e-3
"""Probability that any point is excluded from the control points of one file if none has a gross error."""
_LEAST_EXTENT = 1e-6
"""Smallest ratio of the minor to the major extent of points that do not lie on one line."""
LEAST_POINTS = {"shift": 1, "affine": 3}
"""Smallest number of points that determine each kind of correction."""


@dataclass(frozen=True, eq=False)
class ImageCorrection:
    """Correction of image coordinates, measured minus predicted, from N points.

    Attributes
    ----------
    kind : {'shift', 'affine'}
        Kind of the correction.
    middle, size : (2,) ndarray
        Centre and half extent of the points in line and sample, in pixels; the affine function counts from the centre
        in units of the half extent.
    coefficients : (2, K) ndarray
        Coefficients for line and sample, in pixels; K is 1 for a shift, and 3 (constant, line, sample) for an affine
        function.
    covariance : (2 K, 2 K) ndarray
        Covariance of the coefficients, those of the line first, in pixels^2.
    residual : (N, 2) ndarray
        Residuals of all points in line and sample, in pixels.
    variance : (N, 2, 2) ndarray
        Covariance of the residual of each used point, and of the prediction error at each excluded one, in pixels^2.
    used : (N,) ndarray of bool
        True for points that contributed to the estimate.
    chi_square : float
        Chi-square of the residuals of the used points under their covariances.
    freedom : int
        Degrees of freedom of the chi-square.
    """

    kind: Kind
    middle: Array
    size: Array
    coefficients: Array
    covariance: Array
    residual: Array
    variance: Array
    used: NDArray[np.bool_]
    chi_square: float
    freedom: int

    def at(self, line: ArrayLike, sample: ArrayLike) -> Array:
        """Return the correction of line and sample, in pixels, at N predicted image positions, as (N, 2)."""
        return np.asarray(self._basis(line, sample) @ self.coefficients.T)

    def covariance_at(self, line: ArrayLike, sample: ArrayLike) -> Array:
        """Return the covariance of the correction at N predicted positions, (N, 2, 2), in pixels^2."""
        rows = coefficient_rows(self._basis(line, sample))
        return np.asarray(rows @ self.covariance @ np.swapaxes(rows, 1, 2))

    @property
    def factor(self) -> float:
        """Variance factor, chi-square per degree of freedom; 1 without redundancy."""
        return self.chi_square / self.freedom if self.freedom else 1.0

    @property
    def probability(self) -> float:
        """p-value of the chi-square of the residuals; 1 without redundancy."""
        return statistics.p_value(self.chi_square, self.freedom)

    def _basis(self, line: ArrayLike, sample: ArrayLike) -> Array:
        return _basis(
            self.kind,
            self.middle,
            self.size,
            np.stack(np.broadcast_arrays(np.atleast_1d(line), np.atleast_1d(sample)), axis=-1),
        )


def _basis(kind: Kind, middle: Array, size: Array, position: Array) -> Array:
    """Return the K basis functions of a correction (constant, and scaled line and sample) at N positions, (N, K)."""
    constant = np.ones((len(position), 1))
    return constant if kind == "shift" else np.concatenate([constant, (position - middle) / size], axis=1)


def coefficient_rows(basis: Array) -> Array:
    """Return the derivatives of line and sample at N points with respect to the 2 K coefficients, (N, 2, 2 K)."""
    nothing = np.zeros_like(basis)
    return np.stack([np.concatenate([basis, nothing], 1), np.concatenate([nothing, basis], 1)], axis=1)


def image_correction(
    predicted: ArrayLike, measured: ArrayLike, covariance: ArrayLike, kind: Kind, screened: bool = True
) -> ImageCorrection:
    """Estimate the image-space correction of a sensor model from control points.

    Parameters
    ----------
    predicted : (N, 2) array_like
        Line and sample at which the model sees the N points, in pixels.
    measured : (N, 2) array_like
        Measured line and sample, in pixels.
    covariance : (N, 2, 2) array_like
        Covariance of measured minus predicted, in pixels^2.
    kind : {'shift', 'affine'}
        Shift, which needs one point, or affine function, which needs three.
    screened : bool
        True to exclude points whose residuals far exceed their covariances.

    Raises
    ------
    ValueError
        There are too few points, the points lie on one line, a value is not finite, or a covariance is not positive
        definite.
    """
    position, image = np.asarray(predicted, np.float64), np.asarray(measured, np.float64)
    spread = np.asarray(covariance, np.float64)
    count = len(position)
    if position.shape != (count, 2) or image.shape != position.shape or spread.shape != (count, 2, 2):
        raise ValueError("predicted and measured positions must be (N, 2), with covariances (N, 2, 2)")
    if count < LEAST_POINTS[kind]:
        raise ValueError(f"{count} points are too few: the correction {kind} needs {LEAST_POINTS[kind]} or more")
    if not (np.all(np.isfinite(position)) and np.all(np.isfinite(image)) and np.all(np.isfinite(spread))):
        raise ValueError("a position or a covariance is not finite")
    if np.any(np.linalg.eigvalsh(spread) <= 0.0):
        raise ValueError("a covariance is not positive definite")
    middle = np.mean(position, axis=0)
    size = np.maximum(np.max(np.abs(position - middle), axis=0), 1.0)
    rows = coefficient_rows(_basis(kind, middle, size, position))
    difference = image - position
    used = np.ones(count, dtype=bool)
    while True:
        _require_spread(kind, position[used], size)
        coefficients, cofactor = _solved(rows[used], difference[used], spread[used])
        residual = difference - rows @ coefficients
        share = rows @ cofactor @ np.swapaxes(rows, 1, 2)
        # the residual of a used point correlates with the estimate, that of an excluded point does not
        variance = np.where(used[:, None, None], spread - share, spread + share)
        if not screened or np.sum(used) <= LEAST_POINTS[kind] + 1:
            break
        squares = _squares(residual, variance)
        squares[~used] = 0.0
        farthest = int(np.argmax(squares))
        if squares[farthest] <= statistics.limit_of(_FALSE_ALARM / count, 2):
            break
        used[farthest] = False
    chi_square = float(np.sum(_squares(residual, spread)[used]))
    freedom = 2 * int(np.sum(used)) - rows.shape[2]
    return ImageCorrection(
        kind, middle, size, coefficients.reshape(2, -1), cofactor, residual, variance, used, chi_square, freedom
    )


def _require_spread(kind: Kind, position: Array, size: Array) -> None:
    """Raise ValueError if points on one line do not determine an affine function."""
    if kind == "affine":
        extent = np.linalg.svd((position - np.mean(position, axis=0)) / size, compute_uv=False)
        if extent[-1] < _LEAST_EXTENT * extent[0] or not extent[0] > 0.0:
            raise ValueError("the points lie on one straight line of the image and do not determine an affine function")


def _solved(rows: Array, difference: Array, spread: Array) -> tuple[Array, Array]:
    """Return the 2 K coefficients of a correction and their covariance, by generalised least squares.

    K is the number of coefficients of each of line and sample.
    """
    root = np.linalg.cholesky(spread)
    white = np.linalg.solve(root, rows).reshape(-1, rows.shape[2])
    right = np.linalg.solve(root, difference[..., None]).reshape(-1)
    inverse = statistics.gain(white)
    return np.asarray(inverse @ right), np.asarray(inverse @ inverse.T)


def _squares(residual: Array, variance: Array) -> Array:
    """Return the chi-square contribution of each of N points: its squared residual normalised by its covariance.

    The pseudo-inverse is used because a component that one point alone determines has no residual variance.
    """
    return np.asarray(
        np.einsum("ni,nij,nj->n", residual, np.linalg.pinv(variance, hermitian=True, rcond=1e-10), residual)
    )
