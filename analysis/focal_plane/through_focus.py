"""Best focus from an MTF through focus: the main lobe, its vertex, and the sigma of its position.

The MTF at one frequency against defocus z has a main peak between zeros, with lower peaks of reversed contrast beyond
them (spurious resolution; for a round pupil up to 13 % of the main one). Near the peak it is a parabola, farther out it
is flatter. To fourth order all these curves have nearly the same form,

    v = p (1 - u + q u^2),    u = a (z - z0)^2,

of the value v (MTF), with the peak value p, the position z0 of the vertex, the width parameter a, and q = 0.30 for a
slit pupil (a sinc), 1/3 for a round pupil at low frequencies (2 J1(x)/x), and 0.29 to 0.33 for Hopkins' exact curves of
an F/9.2 pupil at 650 nm, 71.4 and 17.9 cycles/mm (first zeros at 0.29 and 0.71 mm of defocus). So q is a constant and
not a fourth unknown: a free q would cost precision, and q = 0 (the parabola) causes a bias where the points are
asymmetric about the peak. Largest bias over the phases of the steps, in um, with points down to half of the peak, and
sigma for values accurate to 2 % of the peak:

| scan | parabola | q = 0.3 | sigma |
|---|---|---|---|
| 71.4 cycles/mm, steps of 50 um (75 um) | 0.9 (2.4) | 0.04 (0.4) | 2.3 |
| 17.9 cycles/mm, steps of 50 um (100 um) | 1.3 (2.5) | 0.04 (0.06) | 3.7 (5.2) |
| 17.9 cycles/mm, +-0.3 mm, focus at +0.2 mm | 14 | 0.15 | 14 |

With fewer points (down to 0.7 of the peak) sigma is 1.3 to 1.5 times larger; with more (0.3) the neglected sixth order
appears. Coma leaves the curve even; with 0.4 waves of spherical aberration its maximum and this vertex differ by 1.2
um.

All positions are in one unit of length (metres elsewhere in this program), values in any unit (MTF).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array, MeasurementError
from analysis.statistics import p_value_of

QUARTIC = 0.3
"""Coefficient q of the fitted curve p (1 - u + q u^2), u = a (z - z0)^2: peak value p at defocus z0, width parameter a.
"""
FRACTION = 0.5
"""Fraction of the peak value above which points of a through-focus curve are used in the fit."""
LEAST_POINTS = 5
"""Smallest number of different focus positions to which a through-focus curve is fitted."""
WIDEST_FRACTION = 0.3
"""Smallest fraction of the peak value down to which points are used if there are too few above `FRACTION`."""
_ROUNDS, _NEWTON_STEPS = 12, 4
_AT_REST = 1e-6
"""Relative change in a step below which a curve has converged; further rounds would change it only by rounding."""


def _main_peak(z: Array, v: Array, weight: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the index of the largest smoothed value of each of B curves, and a mask of its high neighbours.

    The mask, (B, Z) for Z positions, holds neighbours above `FRACTION` of the peak.

    The smoothing is a binomial of a twelfth of the scan's points, at least 1-2-1, weighted by the inverse variances.

    Parameters
    ----------
    z : (B, Z) ndarray
        Positions in ascending order.
    v : (B, Z) ndarray
        Values at the positions.
    weight : (B, Z) ndarray
        Inverse variances.
    """
    count, size = z.shape
    top, bottom = v * weight, weight
    for _ in range(max(1, size // 12)):
        top, bottom = (
            0.5 * item + 0.25 * (np.pad(item, ((0, 0), (1, 0)))[:, :-1] + np.pad(item, ((0, 0), (0, 1)))[:, 1:])
            for item in (top, bottom)
        )
    # Use only points that were measured.
    smooth = np.where(weight > 0, top / np.where(bottom > 0, bottom, 1.0), -np.inf)
    start = np.argmax(smooth, axis=1)
    low = (smooth < FRACTION * smooth[np.arange(count), start][:, None]) & (weight > 0)
    index = np.arange(size)[None, :]
    # Keep at least two measured neighbours on each side, so that the first fit has a curvature.
    rank = np.cumsum(weight > 0, axis=1)
    near = np.abs(rank - rank[np.arange(count), start][:, None]) <= 2
    left = np.max(np.where(low & (index < start[:, None]), index, -1), axis=1)
    right = np.min(np.where(low & (index > start[:, None]), index, size), axis=1)
    inside = (index > left[:, None]) & (index < right[:, None])
    return start, (inside | near) & (weight > 0)


class _Lobe:
    """Fit of the main lobe of B through-focus curves: value v = p (1 - u + q u^2), u = a (x - x0)^2.

    p is the peak value, x0 the position of the vertex, a the width parameter and q = `QUARTIC`; x is the focus position
    about a centre, in units of a scale.
    """

    def __init__(self, z: Array, v: Array, weight: Array, start: NDArray[np.intp], mask: NDArray[np.bool_]) -> None:
        rows = np.arange(len(z))
        self.z, self.v, self.weight = z, v, weight
        self.centre = z[rows, start]
        half_range = np.max(np.where(mask, np.abs(z - self.centre[:, None]), 0.0), axis=1)
        self.scale = np.where(half_range > 0, half_range, 1.0)
        self.x = (z - self.centre[:, None]) / self.scale[:, None]
        measured = weight > 0
        self.ends = np.stack(
            [np.min(np.where(measured, self.x, np.inf), 1), np.max(np.where(measured, self.x, -np.inf), 1)]
        )
        # Count positions and not points, because repeats at one position do not make a curve.
        self.group = np.cumsum(np.diff(z, axis=1, prepend=z[:, :1]) > 0, axis=1)
        # Start with a parabola; where it opens upward, with a peak at the largest value that fills the window.
        design = np.stack([np.ones_like(self.x), self.x, self.x**2], axis=2)
        c0, c1, c2 = _solve(design, np.where(mask, weight, 0.0), v).T
        sound = (c2 < 0) & (c0 > 0)
        c2 = np.where(sound, c2, -1.0)
        x0 = np.where(sound, np.clip(-c1 / (2 * c2), -2.0, 2.0), 0.0)
        self.p = np.where(sound, c0 - c1**2 / (4 * c2), np.maximum(v[rows, start], 1e-300))
        self.a = np.where(sound, -c2 / self.p, 0.5)
        self.x0 = x0

    def settle(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Fit B curves and select the points near their vertices in turn until both converge; return the mask.

        A curve that does not converge gets all rounds, whether alone or among others.
        """
        for _ in range(_ROUNDS):
            change = self._newton(mask, _NEWTON_STEPS)
            selected, wider = self.window(FRACTION), self.window(WIDEST_FRACTION)
            selected = np.where((self.positions(selected) < LEAST_POINTS)[:, None], wider, selected)
            selected = np.where((self.positions(selected) < LEAST_POINTS)[:, None], mask, selected)
            if np.array_equal(selected, mask) and np.all(change < _AT_REST):
                break
            mask = selected
        self._newton(mask, 2 * _NEWTON_STEPS)
        return mask

    def window(self, fraction: float) -> NDArray[np.bool_]:
        """Return a mask of the points at which the fitted curve exceeds a fraction of its peak, (B, Z).

        B is the number of curves, Z that of focus positions.
        """
        distance = np.abs(self.x - self.x0[:, None]) * self.scale[:, None]
        return (distance <= self.half_width(fraction)[:, None]) & (self.weight > 0)

    def half_width(self, fraction: float) -> Array:
        """Return the distance from the vertex at which each of B fitted curves falls to a fraction of its peak."""
        u = (1.0 - np.sqrt(1.0 - 4 * QUARTIC * (1.0 - fraction))) / (2 * QUARTIC)
        return np.asarray(np.sqrt(u / self.a) * self.scale)

    def positions(self, mask: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Return the number of different focus positions among the selected points of each of B curves."""
        present = np.zeros(mask.shape, dtype=bool)
        rows = np.broadcast_to(np.arange(len(mask))[:, None], mask.shape)
        present[rows[mask], self.group[mask]] = True
        return np.asarray(present.sum(axis=1))

    def _values(self) -> tuple[Array, Array]:
        """Return the values of B fitted curves at their Z focus positions, (B, Z), and their derivatives, (B, Z, 3).

        The derivatives are with respect to the peak value p, the position x0 of the vertex and the width parameter a.
        """
        distance = self.x - self.x0[:, None]
        p, a = self.p[:, None], self.a[:, None]
        u = a * distance**2
        form, slope = 1.0 - u + QUARTIC * u**2, 2 * QUARTIC * u - 1.0
        return p * form, np.stack([form, -2 * a * distance * p * slope, p * slope * distance**2], axis=2)

    def _newton(self, mask: NDArray[np.bool_], steps: int) -> Array:
        """Improve the parameters of B curves by bounded Gauss-Newton steps with the points of the mask.

        Returns
        -------
        (B,) ndarray
            Largest relative change in the last step; that of x0 in widths of the lobe.
        """
        weight = np.where(mask, self.weight, 0.0)
        change = np.full(len(mask), np.inf)
        for _ in range(steps):
            p, x0, a = self.p, self.x0, self.a
            value, slope = self._values()
            step = _solve(slope, weight, self.v - value)
            width = 1.0 / np.sqrt(self.a)
            self.p = np.clip(self.p + step[:, 0], 0.5 * self.p, 2.0 * self.p)
            self.x0 = self.x0 + np.clip(step[:, 1], -0.5 * width, 0.5 * width)
            self.x0 = np.clip(self.x0, self.ends[0] - 2.0 * width, self.ends[1] + 2.0 * width)
            self.a = np.clip(self.a + step[:, 2], 0.5 * self.a, 2.0 * self.a)
            self.a = np.clip(self.a, 1e-6, 1e6)
            change = np.max(np.abs([self.p / p - 1.0, (self.x0 - x0) / width, self.a / a - 1.0]), axis=0)
        return change

    def result(self, mask: NDArray[np.bool_]) -> tuple[Array, Array, Array, Array]:
        """Return peak value, position and second derivative with respect to focus of B curves, and their covariance.

        The first three are (B,), the covariance (B, 3, 3).
        """
        covariance = _covariance(self._values()[1], np.where(mask, self.weight, 0.0))
        jacobian = np.zeros_like(covariance)
        jacobian[:, 0, 0], jacobian[:, 1, 1] = 1.0, self.scale
        jacobian[:, 2, 0], jacobian[:, 2, 2] = -2 * self.a / self.scale**2, -2 * self.p / self.scale**2
        covariance = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
        return self.p, self.centre + self.x0 * self.scale, -2 * self.p * self.a / self.scale**2, covariance

    def skew(self, mask: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return the shift of the vertex of B curves if an asymmetry is fitted as well, and the sigma of the shift.

        The skewed curve has different widths on both sides of its peak, u = a (z - z0)^2 (1 +- k), to first order of
        the asymmetry k.
        """
        value, slope = self._values()
        odd = slope[:, :, 2] * np.sign(self.x - self.x0[:, None])
        design, weight = np.concatenate([slope, odd[:, :, None]], axis=2), np.where(mask, self.weight, 0.0)
        more = _covariance(design, weight)[:, 1, 1] - _covariance(slope, weight)[:, 1, 1]
        return _solve(design, weight, self.v - value)[:, 1] * self.scale, np.sqrt(np.maximum(more, 0.0)) * self.scale

    def chi_square(self, mask: NDArray[np.bool_]) -> Array:
        """Return the chi-square of each of B curves over the selected points."""
        return np.asarray(np.sum(np.where(mask, self.weight, 0.0) * (self.v - self._values()[0]) ** 2, axis=1))


def _covariance(design: Array, weight: Array) -> Array:
    """Return the covariance of P parameters of B fits from derivatives (B, Z, P) and weights (B, Z) at Z points."""
    normal = np.einsum("bzi,bz,bzj->bij", design, weight, design)
    size = np.sqrt(np.einsum("bii->bi", normal))
    size = np.where(size > 0, size, 1.0)
    inverse = np.linalg.pinv(normal / (size[:, :, None] * size[:, None, :]), hermitian=True)
    return np.asarray(inverse / (size[:, :, None] * size[:, None, :]))


def _solve(design: Array, weight: Array, data: Array) -> Array:
    """Return the weighted least-squares solutions (B, P) of B curves; unobservable parameters stay zero.

    Inputs are the derivatives (B, Z, P) with respect to P parameters, weights (B, Z) and data (B, Z) at Z points.
    """
    normal = np.einsum("bzi,bz,bzj->bij", design, weight, design)
    right = np.einsum("bzi,bz->bi", design, weight * data)
    size = np.sqrt(np.einsum("bii->bi", normal))
    size = np.where(size > 0, size, 1.0)
    # The ridge is far below any noise and far above rounding: it keeps degenerate curves from stopping the others.
    scaled = normal / (size[:, :, None] * size[:, None, :]) + 1e-12 * np.eye(design.shape[2])
    return np.asarray(np.linalg.solve(scaled, (right / size)[:, :, None])[:, :, 0] / size)


_SIGNIFICANT = 5.0
"""Significance, in sigmas, from which a curvature, a slope or a contrast of a through-focus curve counts as real. It is
higher than for a single test because the highest of many positions is tested.
"""
_HINT = 3.0
"""Significance, in sigmas, from which a curvature counts as real if the peak also exceeds the rest of the scan."""
_MISFIT = 10.0
"""Chi-square per degree of freedom that, near an end of the scan, means a flank and not a peak."""
_FORM = 0.02
"""Largest deviation of real pupils' curves from the fitted form, as a fraction of the peak value: 1.8 % at half of the
peak.
"""
# A curve has at least _SOUND_TO_BAD points for each outlier; one with a p-value above _EXPLAINED has none. Pairs that
# mask each other are sought among at most _MOST_PAIRED points.
_SOUND_TO_BAD, _EXPLAINED, _MOST_PAIRED = 4, 0.01, 50
_REMEDY = {
    "peak below": "the peak lies beyond the lower end of the scan, {low:.6g}, or too near to it; move the scan down",
    "peak above": "the peak lies beyond the upper end of the scan, {high:.6g}, or too near to it; move the scan up",
    "few points": "fewer than {least} positions near the peak (about {vertex:.6g}); take steps of at most {step:.2g}",
    "flat": "no curvature above the noise; scan a wider range or lower the noise (more frames or edge rows)",
    "not finite": "a position or a value is not finite; exclude the point or set its sigma to infinity",
}
"""Error message, with a remedy, for each reason why a through-focus curve has no usable vertex."""


class FocusError(MeasurementError, ValueError):
    """Error raised for a through-focus curve without a usable vertex; the message says what to change.

    Attributes
    ----------
    faults : dict of tuple of int to str
        Reason for each faulty curve, by its index (an empty tuple for a single curve): "peak below", "peak above", "few
        points", "flat" or "not finite".
    """

    def __init__(self, message: str, faults: dict[tuple[int, ...], str]) -> None:
        super().__init__(message)
        self.faults = faults

    @property
    def reason(self) -> str:
        """Reason why the first faulty curve has no usable vertex, such as "flat"."""
        return next(iter(self.faults.values()))


@dataclass(frozen=True, eq=False)
class FocusVertex:
    """Vertex of one through-focus curve.

    Attributes
    ----------
    position : float
        Position of the vertex (best focus), in the unit of the positions.
    sigma : float
        Standard deviation of the position from the given sigmas, not scaled by chi-square.
    peak, peak_sigma : float
        Value at the vertex and its standard deviation.
    curvature : float
        Second derivative of the value with respect to the position at the vertex, negative.
    skew, skew_sigma : float
        Shift of the vertex if an asymmetry of the curve is fitted as well, and its standard deviation.
    chi_square : float
        Chi-square of the fit.
    degrees_of_freedom : int
        Degrees of freedom of the fit.
    used : (Z,) ndarray of bool
        True for the points, of Z in all, that were used, in the order of the input.
    """

    position: float
    sigma: float
    peak: float
    peak_sigma: float
    curvature: float
    skew: float
    skew_sigma: float
    chi_square: float
    degrees_of_freedom: int
    used: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class FocusVertices:
    """Vertices of many curves: the fields of `FocusVertex` with the leading axes (...) of the input.

    Attributes
    ----------
    used : (..., Z) ndarray of bool
        True for those of the Z focus positions of each curve that were used.
    fault : (...) ndarray of str
        Reason for a missing vertex, whose numbers are NaN; empty otherwise.
    covariance : (..., 3, 3) ndarray
        Covariance of peak, position and curvature.
    """

    position: Array
    sigma: Array
    peak: Array
    peak_sigma: Array
    curvature: Array
    skew: Array
    skew_sigma: Array
    chi_square: Array
    degrees_of_freedom: NDArray[np.int64]
    used: NDArray[np.bool_]
    fault: NDArray[np.str_]
    covariance: Array

    def at(self, *index: int) -> FocusVertex:
        """Return the vertex of one of the curves, given by its index along the leading axes."""
        values = {field.name: getattr(self, field.name)[index] for field in fields(FocusVertex)}
        return FocusVertex(**{name: value if value.ndim else value.item() for name, value in values.items()})


def focus_vertex(position: ArrayLike, value: ArrayLike, sigma: ArrayLike) -> FocusVertex:
    """Find the vertex of a through-focus curve, the best focus, with its standard deviation.

    Parameters
    ----------
    position : (Z,) array_like
        Z focus positions, in metres or any other unit, in any order.
    value : (Z,) array_like
        Quantity with a peak at best focus, such as the MTF at one spatial frequency.
    sigma : float or (Z,) array_like
        Standard deviations of the values; infinite to exclude a point.

    Returns
    -------
    FocusVertex
        `position` and `sigma` of the vertex, the `peak` value, the `skew` of the curve, and chi-square.

    Raises
    ------
    ValueError
        The peak lies beyond the scan, there are too few positions near it, the curve is flat, or a value is not finite.

    Notes
    -----
    Near focus all curves have nearly the form v = p (1 - u + 0.3 u^2) with u = a (z - z0)^2, which is fitted to the
    main lobe (after Hopkins, Proc. R. Soc. A 231, 91 (1955)). See `focus_vertices` for many curves at once.

    Examples
    --------
    The through-focus curve of a slit pupil, a sinc, with its peak at 12 um:

    >>> import numpy as np
    >>> import analysis
    >>> z = np.arange(-60e-6, 61e-6, 10e-6)
    >>> mtf = 0.35 * np.sinc((z - 12e-6) / 80e-6)
    >>> best = analysis.focus_vertex(z, mtf, 0.002)
    >>> round(best.position * 1e6, 1), round(best.sigma * 1e6, 1), round(best.peak, 3)
    (12.0, 0.2, 0.35)
    """
    if np.ndim(value) != 1:
        raise ValueError(f"through focus: one curve must be (Z,), found {np.shape(value)}")
    return focus_vertices(position, value, sigma).at()


def focus_vertices(position: ArrayLike, value: ArrayLike, sigma: ArrayLike, *, strict: bool = True) -> FocusVertices:
    """Find the vertices of many through-focus curves at once.

    The highest smoothed value of a scan decides which peak is the main one.

    Parameters
    ----------
    position : (Z,) or (..., Z) array_like
        Z focus positions, in any unit of length.
    value : (..., Z) array_like
        Values, such as the MTF.
    sigma : array_like
        Positive standard deviations, broadcast to the values; infinite for a point that was not measured.
    strict : bool
        True to raise FocusError for the first faulty curves; False to report them in `fault`.

    Raises
    ------
    FocusError
        A curve has no vertex.
    ValueError
        Shapes do not match, or a sigma is not positive.
    """
    where, data, spread = (np.asarray(item, dtype=np.float64) for item in (position, value, sigma))
    _check(where, data, spread)
    shape = data.shape
    size = shape[-1]
    z, v, s = (np.broadcast_to(item, shape).reshape(-1, size) for item in (where, data, spread))
    invalid = ~np.isfinite(z) | ~np.isfinite(v)
    z, v = np.where(invalid, 0.0, z), np.where(invalid, 0.0, v)
    order = np.argsort(z, axis=1, kind="stable")
    z, v = np.take_along_axis(z, order, 1), np.take_along_axis(v, order, 1)
    weight = np.take_along_axis(np.where(invalid, 0.0, s**-2.0), order, 1)

    start, mask = _main_peak(z, v, weight)
    model = _Lobe(z, v, weight, start, mask)
    mask = model.settle(mask)
    peak, vertex, second_derivative, covariance = model.result(mask)
    skew, skew_sigma = model.skew(mask)

    fault = _faults(model, mask, vertex, second_derivative, covariance)
    fault[invalid.any(axis=1)] = "not finite"
    if strict:
        _raise(fault, shape, z, weight, vertex, model.half_width(WIDEST_FRACTION))
    used = np.zeros(z.shape, dtype=bool)
    np.put_along_axis(used, order, mask, axis=1)
    used[fault != ""] = False
    failed = fault != ""
    lead = shape[:-1]

    def number(values: Array) -> Array:
        return np.where(failed, np.nan, values).reshape(lead)

    return FocusVertices(
        position=number(vertex),
        sigma=number(np.sqrt(covariance[:, 1, 1])),
        peak=number(peak),
        peak_sigma=number(np.sqrt(covariance[:, 0, 0])),
        curvature=number(second_derivative),
        skew=number(skew),
        skew_sigma=number(skew_sigma),
        chi_square=number(model.chi_square(mask)),
        degrees_of_freedom=np.where(failed, 0, used.sum(axis=1) - 3).reshape(lead),
        used=used.reshape(shape),
        fault=fault.reshape(lead),
        covariance=covariance.reshape(*lead, 3, 3),
    )


def outlying_points(position: ArrayLike, value: ArrayLike, sigma: ArrayLike, limit: float) -> Array:
    """Return the deviation of each outlier of a curve from the curve fitted to all other points; 0 for good points.

    A curve that its sigmas explain has no outliers. Otherwise, the point that deviates most from the fit without it is
    sought, or, if there is none, the two that do together and mask each other. Sigmas that are too small for the
    others' scatter are enlarged. A point below half of the peak is an outlier only if it is higher than that.

    Parameters
    ----------
    position : (Z,) array_like
        Z focus positions, in any unit of length.
    value : (Z,) array_like
        Values, such as the MTF.
    sigma : (Z,) array_like
        Standard deviations of the values; infinite for a point that was not measured.
    limit : float
        Deviation, in sigmas, from which a point is an outlier.
    """
    z, v, s = (np.array(item, np.float64) for item in (position, value, sigma))
    deviations = np.zeros(z.size)
    for _ in range(z.size // _SOUND_TO_BAD):
        remaining = np.flatnonzero(np.isfinite(s))
        if remaining.size <= LEAST_POINTS + 1:
            break
        fitted = focus_vertices(z, v, s, strict=False)
        if not fitted.fault and p_value_of(fitted.chi_square, max(fitted.degrees_of_freedom, 1)) > _EXPLAINED:
            break
        pairs = np.stack(np.triu_indices(remaining.size if remaining.size <= _MOST_PAIRED else 0, 1), axis=1)
        for groups in (remaining[:, None], remaining[pairs]):
            deviation, sigmas = _deviations(z, v, s, groups)
            worst = np.min(sigmas, axis=1, initial=np.inf)
            if worst.size and worst.max() > limit:
                best = int(np.argmax(worst))
                deviations[groups[best]], s[groups[best]] = deviation[best], np.inf
                break
        else:
            break
    return deviations


def _deviations(z: Array, v: Array, s: Array, groups: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return deviations of G groups of K points from curves fitted without them, as values and in sigmas.

    They are 0 where no curve can be fitted.
    """
    spread = np.tile(s, (len(groups), 1))
    np.put_along_axis(spread, groups, np.inf, axis=1)
    fits = focus_vertices(z, np.broadcast_to(v, spread.shape), spread, strict=False)
    peak, curvature = fits.peak[:, None], fits.curvature[:, None]
    distance = z[groups] - fits.position[:, None]
    u = -curvature * distance**2 / (2.0 * peak)
    inside = 1.0 - u + QUARTIC * u**2
    near = (inside > FRACTION) & (u < 0.5 / QUARTIC)
    deviation = np.where(near, v[groups] - peak * inside, np.maximum(v[groups] - FRACTION * peak, 0.0))
    fall = 2.0 * QUARTIC * u - 1.0
    slope = np.stack([1.0 - QUARTIC * u**2, fall * curvature * distance, -0.5 * fall * distance**2], axis=2)
    variance = np.where(near, np.einsum("gki,gij,gkj->gk", slope, fits.covariance, slope), 0.0) + s[groups] ** 2
    variance += (_FORM * peak) ** 2
    scale = np.maximum(fits.chi_square / np.maximum(fits.degrees_of_freedom, 1), 1.0)[:, None]
    return deviation, np.nan_to_num(np.abs(deviation) / np.sqrt(variance * scale))


def _faults(
    model: _Lobe, mask: NDArray[np.bool_], vertex: Array, second_derivative: Array, covariance: Array
) -> NDArray[np.str_]:
    """Return, for each of B curves, the reason why it has no vertex; empty if it has one."""
    fault = np.full(len(vertex), "", dtype="<U12")
    scarce = model.positions(model.window(WIDEST_FRACTION)) < LEAST_POINTS
    enough = model.positions(model.weight > 0) >= LEAST_POINTS
    fault[scarce] = "few points"
    curvature_sigmas = -second_derivative / np.sqrt(np.maximum(covariance[:, 2, 2], 1e-300))
    contrasted = _contrast(model, mask) > _SIGNIFICANT
    curved = (curvature_sigmas > _SIGNIFICANT) | ((curvature_sigmas > _HINT) & contrasted)
    fault[~curved & ~(scarce & contrasted)] = "flat"
    # Flank: the vertex lies beyond an end, or so near to it that too few points are left or that the lobe does not fit
    # them; or there is no curvature, and the values rise toward the end.
    misfit = model.chi_square(mask) > _MISFIT * np.maximum(mask.sum(axis=1) - 3, 1)
    vertex_sigma = np.sqrt(covariance[:, 1, 1]) / model.scale
    trend, half = _trend(model, mask), model.half_width(WIDEST_FRACTION) / model.scale
    for sign, name, room in ((-1, "peak below", model.x0 - model.ends[0]), (1, "peak above", model.ends[1] - model.x0)):
        rising = sign * trend > _SIGNIFICANT
        # A vertex within two sigma of the end is not significantly inside.
        fault[(room < 2 * vertex_sigma) & (curved | rising)] = name
        fault[(room < half) & ((scarce & enough & (curved | contrasted)) | misfit)] = name
        fault[~curved & rising] = name
    return fault


def _contrast(model: _Lobe, mask: NDArray[np.bool_]) -> Array:
    """Return the mean of the selected points of each of B curves minus that of its other points, (B,), in sigmas."""
    inside, outside = np.where(mask, model.weight, 0.0), np.where(mask, 0.0, model.weight)
    sums = [np.maximum(part.sum(axis=1), 1e-300) for part in (inside, outside)]
    means = [(part * model.v).sum(axis=1) / total for part, total in zip((inside, outside), sums, strict=True)]
    return np.asarray((means[0] - means[1]) / np.sqrt(1 / sums[0] + 1 / sums[1]))


def _trend(model: _Lobe, mask: NDArray[np.bool_]) -> Array:
    """Return the slope of the straight line through the selected points of each of B curves, in sigmas."""
    weight = np.where(mask, model.weight, 0.0)
    middle = (weight * model.x).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-300)
    offset = model.x - middle[:, None]
    moment = np.maximum((weight * offset**2).sum(axis=1), 1e-300)
    return np.asarray((weight * offset * model.v).sum(axis=1) / np.sqrt(moment))


def _raise(
    fault: NDArray[np.str_], shape: tuple[int, ...], z: Array, weight: Array, vertex: Array, half_width: Array
) -> None:
    """Raise FocusError for curves without a usable vertex; the message names the first few with their reasons."""
    bad = np.flatnonzero(fault != "")
    if not bad.size:
        return
    faults: dict[tuple[int, ...], str] = {}
    lines = []
    for b in bad:
        index = tuple(int(i) for i in np.unravel_index(b, shape[:-1])) if len(shape) > 1 else ()
        faults[index] = str(fault[b])
        measured = z[b][weight[b] > 0]
        values: dict[str, Any] = {
            "low": measured[0] if measured.size else np.nan,
            "high": measured[-1] if measured.size else np.nan,
            "least": LEAST_POINTS,
            "vertex": vertex[b],
            # LEAST_POINTS in the window for any phase of the steps; less a quarter, because too few points look wide.
            "step": 0.75 * 2 * half_width[b] / LEAST_POINTS,
        }
        text = _REMEDY[faults[index]].format(**values)
        lines.append(f"curve {', '.join(map(str, index))}: {text}" if index else text)
    more = f"; and {len(lines) - 3} more" if len(lines) > 3 else ""
    raise FocusError(f"through focus: {'; '.join(lines[:3])}{more}", faults)


def _check(where: Array, data: Array, spread: Array) -> None:
    """Raise ValueError if positions, values and sigmas have shapes that do not match, or a sigma is not positive."""
    if data.ndim < 1 or where.shape[-1:] != data.shape[-1:]:
        raise ValueError(f"through focus: position {where.shape} and value {data.shape} must end in the same Z points")
    try:
        np.broadcast_to(where, data.shape)
        np.broadcast_to(spread, data.shape)
    except ValueError as error:
        raise ValueError(
            f"through focus: position {where.shape} and sigma {spread.shape} do not match value {data.shape}"
        ) from error
    if not np.all(spread > 0):
        raise ValueError("through focus: every sigma must be positive")
