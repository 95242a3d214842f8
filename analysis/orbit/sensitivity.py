"""How the intersection angles answer to errors of the station and of the ground points (paper 000, Figs. 3-5).

One thing at a time, the station or all points of one strip, is moved along one axis of the frame by 0-10 m. The change
of the angles comes by exact recomputation and by the linear derivative.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.orbit.angles import angles_between
from analysis.orbit.planes import Method, PlaneFit, Station, Strip, fit_plane
from analysis.units import ARCSEC

__all__ = ["AXES", "Sensitivity", "sensitivity"]

Array = NDArray[np.float64]
AXES = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Answer of m dihedral angles to a move of one thing along one axis.

    angles: their names. what: "station", or the line whose points move. axis: "x", "y" or "z". amount: (k,) metres.
    change: (m, k) by recomputation, radians. slope: (m,) linear derivatives at zero, rad/m.
    """

    angles: tuple[str, ...]
    what: str
    axis: str
    amount: Array
    change: Array
    slope: Array

    def to_dict(self) -> dict[str, Any]:
        """what, axis, and the linear answer to 10 m in arcseconds."""
        answers = {
            f"{name}_arcsec_per_10m": float(s) * 10.0 / ARCSEC + 0.0
            for name, s in zip(self.angles, self.slope, strict=True)
        }
        return {"what": self.what, "axis": self.axis, **answers}


def sensitivity(
    station: Station,
    strips: Mapping[str, Strip],
    pairs: Mapping[str, tuple[str, str]],
    *,
    method: Method = "tls",
    amounts: ArrayLike | None = None,
) -> tuple[Sensitivity, ...]:
    """Rows for the station and the points of each strip, each along x, y, z of the coordinates' frame.

    Raises PlaneError and AngleError.

    Args:
        station: from which the strips are seen.
        strips: line -> its points.
        pairs: angle -> the two lines that it lies between.
        method: of the planes' fit.
        amounts: (k,) metres, first 0; 0 to 10 m in steps of 1 m by default.
    """
    steps = np.linspace(0.0, 10.0, 11) if amounts is None else np.asarray(amounts, np.float64)
    if steps.ndim != 1 or len(steps) < 3 or steps[0] != 0 or not np.all(np.diff(steps) > 0):
        raise ValueError("sensitivity: amounts must be three or more rising numbers, the first of them 0")
    order = list(strips)
    index = [(order.index(a), order.index(b)) for a, b in pairs.values()]
    fits = [fit_plane(station, strip, method) for strip in strips.values()]
    start = angles_between(fits, index)
    rows = []
    for what in ("station", *strips):
        moved = list(range(len(order))) if what == "station" else [order.index(what)]
        sign = 1.0 if what == "station" else -1.0
        derivative = sign * np.einsum("mki,kij->mj", start.gradient[:, moved], _station_gains(fits, moved))
        for k, axis in enumerate(AXES):
            shifts = steps[:, None] * np.eye(3)[k]
            values = [angles_between(_moved(station, strips, fits, what, s, method), index).values for s in shifts]
            change = np.array(values).T - start.values[:, None]
            rows.append(Sensitivity(tuple(pairs), what, axis, steps, change, derivative[:, k]))
    return tuple(rows)


def _station_gains(fits: list[PlaneFit], which: list[int]) -> Array:
    return np.array([fits[k].station_gain for k in which])


def _moved(
    station: Station, strips: Mapping[str, Strip], fits: list[PlaneFit], what: str, shift: Array, method: Method
) -> list[PlaneFit]:
    """The planes after a move; only what moved is fitted anew."""
    if what == "station":
        place = Station(station.position + shift, station.covariance)
        return [fit_plane(place, strip, method) for strip in strips.values()]
    return [
        fit_plane(station, strip.shifted(shift), method) if name == what else fit
        for (name, strip), fit in zip(strips.items(), fits, strict=True)
    ]
