"""How the intersection angles answer to errors of the station and of the ground points (paper 000, Figs. 3-5).

One thing at a time, the station or all points of one strip, is moved along one axis of the frame by 0-10 m. The change
of the angles comes by exact recomputation and by the linear derivative. `STATEMENTS` holds what the paper's text
says of its figures, as data; `judge` holds a statement against a table. The paper's words have no numbers: "far more"
is taken as at least twice, "nearly the same" as within a quarter, "little" as at most a quarter of the largest.
The figures' ordinate is resection minus planes, which falls where the angle rises; the text speaks of the angle itself,
and so do the statements here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, assert_never

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.orbit.angles import angles_between
from analysis.orbit.planes import Method, PlaneFit, Station, Strip, fit_plane
from analysis.units import ARCSEC

__all__ = ["STATEMENTS", "Judgement", "Sensitivity", "Statement", "judge", "sensitivity"]

Array = NDArray[np.float64]
Kind = Literal["increases", "decreases", "largest", "far_larger", "close", "little", "steepens", "opposite"]
AXES = ("x", "y", "z")
_FAR, _CLOSE, _LITTLE = 2.0, 1.25, 0.25


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Answer of m dihedral angles to a move of one thing along one axis.

    angles: their names. what: "station", or the line whose points move. axis: "x", "y" or "z". amount: (k,) metres.
    change: (m, k) by recomputation, radians. slope: (m,) linear derivatives at zero, rad/m.
    curvature: (m,) relative change of the slope from 0 to the largest amount, signed; NaN where the slope is zero.
    """

    angles: tuple[str, ...]
    what: str
    axis: str
    amount: Array
    change: Array
    slope: Array
    curvature: Array

    def to_dict(self) -> dict[str, Any]:
        """what, axis, and the linear answer to 10 m in arcseconds."""
        answers = {
            f"{name}_arcsec_per_10m": float(s) * 10.0 / ARCSEC + 0.0
            for name, s in zip(self.angles, self.slope, strict=True)
        }
        return {"what": self.what, "axis": self.axis, **answers}

    def slope_of(self, angle: str) -> float:
        """Linear derivative of one angle, rad/m. ValueError if it is none of `angles`."""
        return float(self.slope[self.angles.index(angle)])


@dataclass(frozen=True)
class Statement:
    """What the paper says of one figure: `angle` under moves of `what` along `axes` (the rest in `others`)."""

    figure: str
    text: str
    kind: Kind
    what: str
    angle: Literal["alpha", "beta"]
    axes: tuple[str, ...]
    others: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Judgement:
    """A statement held against a table. numbers: axis -> arcsec per 10 m, or relative change of slope (steepens).

    ratio: what the kind compares: smallest of `axes` over largest of `others` (largest, far_larger), largest over
        smallest (close), largest of `axes` over largest of `others` (little), least of `numbers` (steepens); else NaN.
    """

    statement: Statement
    holds: bool
    numbers: dict[str, float]
    ratio: float


def sensitivity(
    station: Station,
    strips: Mapping[str, Strip],
    pairs: Mapping[str, tuple[str, str]],
    *,
    method: Method = "tls",
    amounts: ArrayLike | None = None,
) -> tuple[Sensitivity, ...]:
    """Rows for the station and the points of each strip, each along x, y, z of the coordinates' frame.

    strips: line -> its points. pairs: angle -> the two lines that it lies between.
    amounts: (k,) metres, first 0; 0 to 10 m in steps of 1 m by default. Raises PlaneError and AngleError.
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
            rows.append(
                Sensitivity(tuple(pairs), what, axis, steps, change, derivative[:, k], _curvature(steps, change))
            )
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


def _curvature(steps: Array, change: Array) -> Array:
    """(m,) second-order part of a parabola through the change: how much its slope grows over the range, relative."""
    unit = steps / steps[-1]
    design = np.column_stack([unit, unit**2])
    first, second = np.linalg.lstsq(design, change.T, rcond=None)[0]
    return np.asarray(np.where(first != 0, 2.0 * second / np.where(first != 0, first, 1.0), np.nan))


def judge(statement: Statement, table: Sequence[Sensitivity]) -> Judgement:
    """Whether a statement of the paper holds in a table with alpha and beta of forward, nadir and aft."""
    rows = {row.axis: row for row in table if row.what == statement.what}
    slope = {axis: rows[axis].slope_of(statement.angle) * 10.0 / ARCSEC for axis in AXES}
    chosen = [slope[axis] for axis in statement.axes]
    size = [abs(v) for v in chosen]
    rest = max((abs(slope[axis]) for axis in statement.others), default=float("nan"))
    ratio, numbers = float("nan"), slope
    if statement.kind == "increases":
        holds = all(v > 0 for v in chosen)
    elif statement.kind == "decreases":
        holds = all(v < 0 for v in chosen)
    elif statement.kind == "largest" or statement.kind == "far_larger":
        ratio = min(size) / rest
        holds = ratio > (1.0 if statement.kind == "largest" else _FAR)
    elif statement.kind == "close":
        ratio = max(size) / min(size)
        holds = ratio <= _CLOSE and min(chosen) * max(chosen) > 0
    elif statement.kind == "little":
        ratio = max(size) / rest
        holds = ratio <= _LITTLE
    elif statement.kind == "steepens":
        at = rows["x"].angles.index(statement.angle)
        numbers = {axis: float(rows[axis].curvature[at]) for axis in statement.axes}
        ratio = min(numbers.values())
        holds = ratio > 0
    elif statement.kind == "opposite":
        holds = all(rows[a].slope_of("alpha") * rows[a].slope_of("beta") < 0 for a in statement.axes)
    else:
        assert_never(statement.kind)
    return Judgement(statement, holds, numbers, ratio)


def _signs(figure: str, what: str, angle: Literal["alpha", "beta"], up: str, down: str) -> tuple[Statement, ...]:
    kinds: tuple[tuple[Kind, str], ...] = (("increases", up), ("decreases", down))
    return tuple(
        Statement(figure, f"{angle} {kind} with {' and '.join(axes)} of the {what}", kind, what, angle, tuple(axes))
        for kind, axes in kinds
        if axes
    )


# Paper 000, section 2.3.1 on Fig. 3 and section 2.3.2 on Figs. 4 and 5, in the paper's order.
STATEMENTS: tuple[Statement, ...] = (
    *_signs("3 (1)", "station", "alpha", "x", "yz"),
    *_signs("3 (1)", "station", "beta", "x", "yz"),
    Statement("3 (2)", "z of the station moves alpha most", "largest", "station", "alpha", ("z",), ("x", "y")),
    Statement("3 (3)", "y of the station moves beta most", "largest", "station", "beta", ("y",), ("x", "z")),
    Statement("3 (4)", "the slopes of alpha grow with the station's error", "steepens", "station", "alpha", AXES),
    Statement("3 (4)", "the slopes of beta grow with the station's error", "steepens", "station", "beta", AXES),
    Statement("4 (1)", "x and z of the forward points move alpha alike", "close", "forward", "alpha", ("x", "z")),
    *_signs("4 (1)", "forward", "alpha", "y", "xz"),
    Statement(
        "4 (1)", "y of the forward points moves alpha far more", "far_larger", "forward", "alpha", ("y",), ("x", "z")
    ),
    *_signs("4 (2)", "nadir", "alpha", "xz", "y"),
    Statement("4 (2)", "y and z of the nadir points move alpha more", "largest", "nadir", "alpha", ("y", "z"), ("x",)),
    *_signs("5 (1)", "nadir", "beta", "y", "xz"),
    Statement(
        "5 (1)", "y and z of the nadir points move beta far more", "far_larger", "nadir", "beta", ("y", "z"), ("x",)
    ),
    *_signs("5 (2)", "aft", "beta", "z", "y"),
    Statement("5 (2)", "x of the aft points moves beta little", "little", "aft", "beta", ("x",), ("y", "z")),
    Statement("5 (2)", "z of the aft points moves beta most", "largest", "aft", "beta", ("z",), ("x", "y")),
    Statement("5 (3)", "the nadir points move alpha and beta oppositely", "opposite", "nadir", "alpha", AXES),
)
