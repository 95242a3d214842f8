"""Is the principal point observable? What a distortion test can say of p in L = c + f tan W - p tan^2 W + ...

Over a narrow field tan^2 W is tiny: an error of 1 um at the edge of +-1.25 deg is 2 mm of p. Paper 004 solves for p all
the same (eq. 2) and remarks that p is about a pixel; this says with numbers when p = 0 (eq. 3) is the better choice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.orientation.algebra import condition_number, gain, noise_root
from analysis.orientation.distortion_model import OrientationError, design

__all__ = ["PointReport", "point_report"]

Array = NDArray[np.float64]
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

    names, values: P terms and their values, m. angle: (N,) rad. noise: (N, N) m^2. weighted: generalised least squares.
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
        text = f"{size}: not observable over {field}; {effect}; take p = 0 (paper 004, eq. 3). {same}"
    return PointReport(value, sigma, fitted, observable, significant, edge, typical, text)
