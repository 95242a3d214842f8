"""Place of best focus from an MTF through focus: vertex of the main peak, with its sigma (paper 004, section 2).

The MTF at one frequency against defocus z is a main peak between dark zeros and lower peaks of reversed contrast
beyond them (spurious resolution; for a round pupil up to 13% of the main one). Near the peak it is a parabola, farther
out it is flatter. To fourth order every one of these curves has nearly the same form,

    v = p (1 - u + q u^2),    u = a (z - z0)^2,

with q = 0.30 for a slit pupil (a sinc), 1/3 for a round pupil at low frequencies (2 J1(x)/x), and 0.29 to 0.33 for
Hopkins' exact curves of an F/9.2 pupil at 650 nm, 71.4 and 17.9 cycles/mm (first zeros at 0.29 and 0.71 mm of defocus).
So q is a constant and not a fourth unknown: a free one would cost precision, and none at all (q = 0, the parabola)
leaves a bias where the points lie lopsided about the peak. Largest bias over the phases of the steps, in um, with
points down to half of the peak, and sigma for values good to 2% of the peak:

    scan                                              parabola    q = 0.3    sigma
    71.4 cycles/mm, steps of 50 um (75 um)            0.9 (2.4)   0.04 (0.4)   2.3
    17.9 cycles/mm, steps of 50 um (100 um)           1.3 (2.5)   0.04 (0.06)  3.7 (5.2)
    17.9 cycles/mm, +-0.3 mm, focus at +0.2 mm        14          0.15         14

With fewer points (0.7 of the peak) sigma is 1.3 to 1.5 times larger; with more (0.3) the neglected sixth order shows.
Coma leaves the curve even; 0.4 waves of spherical aberration make its maximum and this vertex differ by 1.2 um.

All positions in one unit of length (metres elsewhere in this program), values in any unit (MTF).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.focal_plane.focus_lobe import LEAST_POINTS, WIDEST_FRACTION, Lobe, main_peak

__all__ = ["FocusError", "FocusVertex", "FocusVertices", "focus_vertex", "focus_vertices"]

Array = NDArray[np.float64]
QUARTIC = 0.3
FRACTION = 0.5
# A curvature, a slope or a contrast is there above this many sigma. The highest of many places is looked at, so this
# is more than for a single one.
_SIGNIFICANT = 5.0
# A curvature of this many sigma is enough where the peak stands out from the rest of the scan as well.
_HINT = 3.0
# Near an end of the scan a chi-square this many times the degrees of freedom means a flank and not a peak.
_MISFIT = 10.0
_REMEDY = {
    "peak below": "the peak lies beyond the lower end of the scan, {low:.6g}, or too near to it; move the scan down",
    "peak above": "the peak lies beyond the upper end of the scan, {high:.6g}, or too near to it; move the scan up",
    "few points": "fewer than {least} positions near the peak (about {place:.6g}); take steps of at most {step:.2g}",
    "flat": "no curvature above the noise; scan a wider range or lower the noise (more frames or edge rows)",
    "spurious": "the highest peak, {peak:.3g} at {place:.6g}, is below {lowest:.3g} and is taken for spurious"
    " resolution; the main peak is not in the scan: widen it",
    "not finite": "a position or a value is not finite; leave the point out or give it an infinite sigma",
}


class FocusError(ValueError):
    """No vertex can be given.

    faults: index of the curve, an empty tuple for a single one -> reason: "peak below", "peak above", "few points",
    "flat", "spurious" or "not finite". The message says what to change.
    """

    def __init__(self, message: str, faults: dict[tuple[int, ...], str]) -> None:
        super().__init__(message)
        self.faults = faults

    @property
    def reason(self) -> str:
        """The first curve's reason."""
        return next(iter(self.faults.values()))


@dataclass(frozen=True, eq=False)
class FocusVertex:
    """Vertex of one through-focus curve.

    position, sigma: of the vertex, and its standard deviation from the sigmas given (not scaled by chi-square).
    peak, peak_sigma: value at the vertex. curvature: second derivative there, negative.
    chi_square, degrees_of_freedom: of the fit. used: (Z,) which points took part, in the order given.
    """

    position: float
    sigma: float
    peak: float
    peak_sigma: float
    curvature: float
    chi_square: float
    degrees_of_freedom: int
    used: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class FocusVertices:
    """Vertices of many curves: the fields of FocusVertex with the leading axes of the input, (...).

    used: (..., Z). fault: (...) empty text, or why there is no vertex; there the numbers are NaN.
    """

    position: Array
    sigma: Array
    peak: Array
    peak_sigma: Array
    curvature: Array
    chi_square: Array
    degrees_of_freedom: NDArray[np.int64]
    used: NDArray[np.bool_]
    fault: NDArray[np.str_]

    def at(self, *index: int) -> FocusVertex:
        """One of the vertices."""
        return FocusVertex(
            position=float(self.position[index]),
            sigma=float(self.sigma[index]),
            peak=float(self.peak[index]),
            peak_sigma=float(self.peak_sigma[index]),
            curvature=float(self.curvature[index]),
            chi_square=float(self.chi_square[index]),
            degrees_of_freedom=int(self.degrees_of_freedom[index]),
            used=self.used[index],
        )


def focus_vertex(
    position: ArrayLike,
    value: ArrayLike,
    sigma: ArrayLike,
    *,
    fraction: float = FRACTION,
    quartic: float = QUARTIC,
    lowest_peak: float = 0.0,
) -> FocusVertex:
    """Vertex of one through-focus curve of Z points, in any order; see focus_vertices for the arguments.

    Raises FocusError when the curve has no peak to measure; ValueError for bad arguments.
    """
    if np.ndim(value) != 1:
        raise ValueError(f"through focus: one curve must be (Z,), found {np.shape(value)}")
    return focus_vertices(position, value, sigma, fraction=fraction, quartic=quartic, lowest_peak=lowest_peak).at()


def focus_vertices(
    position: ArrayLike,
    value: ArrayLike,
    sigma: ArrayLike,
    *,
    fraction: float = FRACTION,
    quartic: float = QUARTIC,
    lowest_peak: float = 0.0,
    strict: bool = True,
) -> FocusVertices:
    """Vertices of many through-focus curves at once.

    position: (..., Z) or (Z,), length. value: (..., Z), MTF. sigma: of the values, broadcast to them, positive;
        infinite for a point that was not measured.
    fraction: points count where the fitted curve is above this part of its peak, 0.25 to 0.95.
    quartic: q of the module's formula, 0 to 0.33; 0 is the plain parabola.
    lowest_peak: a peak below this is spurious resolution, and the scan has missed the main one. Within a scan the
        highest smoothed value decides, but only the user can know that the scan went past the main peak.
    strict: raise FocusError for the first faults found; else return them in `fault`.
    """
    where, data, spread = (np.asarray(item, dtype=np.float64) for item in (position, value, sigma))
    _check(where, data, spread, fraction, quartic)
    shape = data.shape
    size = shape[-1]
    z, v, s = (np.broadcast_to(item, shape).reshape(-1, size) for item in (where, data, spread))
    broken = ~np.isfinite(z) | ~np.isfinite(v)
    z, v = np.where(broken, 0.0, z), np.where(broken, 0.0, v)
    order = np.argsort(z, axis=1, kind="stable")
    z, v = np.take_along_axis(z, order, 1), np.take_along_axis(v, order, 1)
    weight = np.take_along_axis(np.where(broken, 0.0, s**-2.0), order, 1)

    start, mask = main_peak(z, v, weight, fraction)
    model = Lobe(z, v, weight, start, mask, quartic)
    mask = model.settle(fraction, mask)
    peak, place, bend, covariance = model.result(mask)

    fault = _faults(model, mask, peak, place, bend, covariance, lowest_peak)
    fault[broken.any(axis=1)] = "not finite"
    if strict:
        _raise(fault, shape, z, weight, peak, place, model.reach(WIDEST_FRACTION), lowest_peak)
    used = np.zeros(z.shape, dtype=bool)
    np.put_along_axis(used, order, mask, axis=1)
    used[fault != ""] = False
    failed = fault != ""
    lead = shape[:-1]

    def number(values: Array) -> Array:
        return np.where(failed, np.nan, values).reshape(lead)

    return FocusVertices(
        position=number(place),
        sigma=number(np.sqrt(covariance[:, 1, 1])),
        peak=number(peak),
        peak_sigma=number(np.sqrt(covariance[:, 0, 0])),
        curvature=number(bend),
        chi_square=number(model.chi_square(mask)),
        degrees_of_freedom=np.where(failed, 0, used.sum(axis=1) - 3).reshape(lead),
        used=used.reshape(shape),
        fault=fault.reshape(lead),
    )


def _faults(
    model: Lobe,
    mask: NDArray[np.bool_],
    peak: Array,
    place: Array,
    bend: Array,
    covariance: Array,
    lowest_peak: float,
) -> NDArray[np.str_]:
    """(B,) empty, or why a curve has no vertex."""
    fault = np.full(len(place), "", dtype="<U12")
    scarce = model.positions(model.window(WIDEST_FRACTION)) < LEAST_POINTS
    enough = model.positions(model.weight > 0) >= LEAST_POINTS
    fault[peak < lowest_peak] = "spurious"
    fault[scarce] = "few points"
    bent = -bend / np.sqrt(np.maximum(covariance[:, 2, 2], 1e-300))
    standing = _contrast(model, mask) > _SIGNIFICANT
    curved = (bent > _SIGNIFICANT) | ((bent > _HINT) & standing)
    fault[~curved & ~(scarce & standing)] = "flat"
    # A flank: the vertex beyond an end, or so near to it that too few points are left or that the lobe does not fit
    # them, or no curvature but values that rise toward the end.
    misfit = model.chi_square(mask) > _MISFIT * np.maximum(mask.sum(axis=1) - 3, 1)
    place_sigma = np.sqrt(covariance[:, 1, 1]) / model.scale
    trend, half = _trend(model, mask), model.reach(WIDEST_FRACTION) / model.scale
    for sign, name, room in (
        (-1, "peak below", model.x0 - model.ends[0]),
        (1, "peak above", model.ends[1] - model.x0),
    ):
        rising = sign * trend > _SIGNIFICANT
        # Within two sigma of the end it is not seen to be inside.
        fault[(room < 2 * place_sigma) & (curved | rising)] = name
        fault[(room < half) & ((scarce & enough & (curved | standing)) | misfit)] = name
        fault[~curved & rising] = name
    return fault


def _contrast(model: Lobe, mask: NDArray[np.bool_]) -> Array:
    """By how many sigma the mean of the chosen points is above the mean of all others, (B,)."""
    inside, outside = np.where(mask, model.weight, 0.0), np.where(mask, 0.0, model.weight)
    sums = [np.maximum(part.sum(axis=1), 1e-300) for part in (inside, outside)]
    means = [(part * model.v).sum(axis=1) / total for part, total in zip((inside, outside), sums, strict=True)]
    return np.asarray((means[0] - means[1]) / np.sqrt(1 / sums[0] + 1 / sums[1]))


def _trend(model: Lobe, mask: NDArray[np.bool_]) -> Array:
    """Slope of the straight line through the chosen points in units of its sigma, (B,)."""
    weight = np.where(mask, model.weight, 0.0)
    middle = (weight * model.x).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-300)
    arm = model.x - middle[:, None]
    moment = np.maximum((weight * arm**2).sum(axis=1), 1e-300)
    return np.asarray((weight * arm * model.v).sum(axis=1) / np.sqrt(moment))


def _raise(
    fault: NDArray[np.str_],
    shape: tuple[int, ...],
    z: Array,
    weight: Array,
    peak: Array,
    place: Array,
    reach: Array,
    lowest_peak: float,
) -> None:
    """FocusError when a curve has a fault; the message names the first few."""
    bad = np.flatnonzero(fault != "")
    if not bad.size:
        return
    faults: dict[tuple[int, ...], str] = {}
    lines = []
    for b in bad:
        index = tuple(int(i) for i in np.unravel_index(b, shape[:-1])) if len(shape) > 1 else ()
        faults[index] = str(fault[b])
        seen = z[b][weight[b] > 0]
        values: dict[str, Any] = {
            "low": seen[0] if seen.size else np.nan,
            "high": seen[-1] if seen.size else np.nan,
            "least": LEAST_POINTS,
            "place": place[b],
            # LEAST_POINTS in the window wherever the steps fall; less a quarter, for too few points look too wide.
            "step": 0.75 * 2 * reach[b] / LEAST_POINTS,
            "peak": peak[b],
            "lowest": lowest_peak,
        }
        text = _REMEDY[faults[index]].format(**values)
        lines.append(f"curve {', '.join(map(str, index))}: {text}" if index else text)
    more = f"; and {len(lines) - 3} more" if len(lines) > 3 else ""
    raise FocusError(f"through focus: {'; '.join(lines[:3])}{more}", faults)


def _check(where: Array, data: Array, spread: Array, fraction: float, quartic: float) -> None:
    """ValueError for arguments that cannot be meant."""
    if data.ndim < 1 or where.shape[-1:] != data.shape[-1:]:
        raise ValueError(f"through focus: position {where.shape} and value {data.shape} must end in the same Z points")
    try:
        np.broadcast_to(where, data.shape)
        np.broadcast_to(spread, data.shape)
    except ValueError as error:
        raise ValueError(
            f"through focus: position {where.shape} and sigma {spread.shape} do not fit value {data.shape}"
        ) from error
    if not np.all(spread > 0):
        raise ValueError("through focus: every sigma must be positive")
    if not 0.25 <= fraction <= 0.95:
        raise ValueError(f"through focus: fraction must be within 0.25 to 0.95, found {fraction}")
    if not 0.0 <= quartic <= 0.33:
        raise ValueError(f"through focus: quartic must be within 0 to 0.33, found {quartic}")
