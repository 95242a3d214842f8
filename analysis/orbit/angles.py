"""Intersection angles of line cameras from the planes in which they photograph (paper 000, eqs. 6-7), and their errors.

alpha is the angle between the forward and the nadir plane, beta between the nadir and the backward plane; both acute
and positive. Any other pair of lines, such as the nadir and a high-resolution line, has an angle in the same way. The
paper's form is arccos |a . b|; its rounding error grows as 1/sin(angle) and swallows angles below
1e-8 rad, so the value used here is atan2(|a x b|, |a . b|), good to rounding at every angle.

The sigmas come from first-order propagation. All planes pass through one station, whose error they share, and alpha
and beta share the nadir plane, so their errors are correlated: the result is a joint covariance.

Three angles bear the name. The planes give the **dihedral** angle. The **look** angle lies between the lines of sight
of the lines' centres. They are equal when the CCD lines are parallel and start at the same place across the track; a
line turned by k about its own line of sight makes cos(dihedral) = cos(k) cos(look), a dihedral angle larger by
k^2 / (2 tan(look)). Both are unsigned, so that for nearly parallel lines k and the offset across the track decide what
they are, and noise folds them at zero. The **along-track** angle is the turn about the lines' direction that takes one
central ray to the other: signed, zero for lines that look the same way, and not folded. It is the part that makes
heights, and for lines far apart the look angle.

One thing at a time, the station or all points of one strip, is moved along one axis of the frame by 0-10 m. The change
of the angles comes by exact recomputation and by the linear derivative.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array
from analysis.measurement_error import MeasurementError
from analysis.orbit.planes import Method, PlaneFit, Station, Strip, fit_plane
from analysis.units import ARCSEC

# Below so many sigmas an angle, which cannot be negative, is no longer normally distributed.
_FOLDED = 3.0


class AngleError(MeasurementError, ValueError):
    """Planes or rays have no angle that could be told."""


@dataclass(frozen=True, eq=False)
class PlaneAngles:
    """Angles between pairs of planes.

    values: (m,) acute angles by atan2, radians. printed: (m,) the same by the paper's arccos.
    covariance: (m, m) rad^2, points and station.
    gradient: (m, k, 3) derivative of each angle with respect to the unit normals of the k planes.
    folded: (m,) the angle is below three sigmas; its sigma then says little, for it cannot be negative.
    """

    values: Array
    printed: Array
    covariance: Array
    gradient: Array
    folded: NDArray[np.bool_]

    @property
    def sigma(self) -> Array:
        """(m,) radians."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def angles_between(planes: Sequence[PlaneFit], pairs: Sequence[tuple[int, int]]) -> PlaneAngles:
    """Acute angles between pairs of planes through one station, with their joint covariance.

    pairs: indices into `planes`. Raises AngleError when planes belong to different stations or methods, or coincide.
    """
    for plane in planes[1:]:
        if plane.method != planes[0].method:
            raise AngleError(f"angles: a {planes[0].method} and a {plane.method} plane have no angle in common")
    station = _common_station(planes)
    normals = np.array([plane.normal for plane in planes])
    values, printed = np.empty(len(pairs)), np.empty(len(pairs))
    gradient = np.zeros((len(pairs), len(planes), 3))
    for row, (i, j) in enumerate(pairs):
        a, b = normals[i], normals[j]
        dot, sine = float(a @ b), float(np.linalg.norm(np.cross(a, b)))
        if sine < 1e-14:
            raise AngleError("angles: two planes coincide; their angle has no direction to change in")
        values[row] = np.arctan2(sine, abs(dot))
        printed[row] = np.arccos(min(abs(dot), 1.0))
        # a step of one normal toward the other closes the angle
        side = np.copysign(1.0, dot)
        gradient[row, i] = -(side * b - abs(dot) * a) / sine
        gradient[row, j] = -(side * a - abs(dot) * b) / sine
    covariance = _propagated(gradient, planes, station)
    folded = values < _FOLDED * np.sqrt(np.diag(covariance))
    return PlaneAngles(values, printed, covariance, gradient, folded)


def _common_station(planes: Sequence[PlaneFit]) -> Station:
    """Through which all planes were fitted. Raises AngleError for several."""
    first = planes[0].station
    for plane in planes[1:]:
        same = np.array_equal(plane.station.position, first.position)
        if not (same and np.array_equal(plane.station.covariance, first.covariance)):
            raise AngleError("angles: the planes must be fitted through one and the same station")
    return first


def _propagated(gradient: Array, planes: Sequence[PlaneFit], station: Station) -> Array:
    """(m, m) covariance of what depends on the planes' normals, by `gradient` (m, k, 3), and on their station."""
    points = np.array([plane.point_covariance for plane in planes])
    shared = np.einsum("mki,kij->mj", gradient, np.array([plane.station_gain for plane in planes]))
    own = np.einsum("mki,kij,lkj->ml", gradient, points, gradient)
    return np.asarray(own + shared @ station.covariance @ shared.T)


def intersection_angles(forward: PlaneFit, nadir: PlaneFit, backward: PlaneFit) -> PlaneAngles:
    """Angles alpha (forward, nadir) and beta (nadir, backward), eqs. 6 and 7, in this order. Raises AngleError."""
    return angles_between((forward, nadir, backward), ((0, 1), (1, 2)))


def off_axis_angle(line: PlaneFit, nadir: PlaneFit) -> PlaneAngles:
    """Off-axis angle of another line (high-resolution, multispectral) against the nadir line, (1,); unsigned.

    The paper's outlook. Both planes must belong to the same moment, hence the same station. Raises AngleError.
    """
    return angles_between((line, nadir), ((0, 1),))


def look_angle(ray_a: ArrayLike, ray_b: ArrayLike) -> Array:
    """Angle between two lines of sight (..., 3) of any length, radians, 0 to pi."""
    a, b = np.asarray(ray_a, np.float64), np.asarray(ray_b, np.float64)
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


@dataclass(frozen=True, eq=False)
class LineFrame:
    """Where one line looks; unit vectors (3,).

    central: along the line of sight of its centre. side: along the line, the way in which the tangents rise; square
        to `central`. plane: the fit. variance: of the central ray out of the plane, rad^2, beside the plane's own.
    """

    central: Array
    side: Array
    plane: PlaneFit
    variance: float

    @property
    def forward(self) -> Array:
        """Side x central, which looks ahead where the tangents rise to the right of the track."""
        return np.asarray(np.cross(self.side, self.central))


def line_frame(plane: PlaneFit, tangent: ArrayLike, bend: float = 0.0) -> LineFrame:
    """The line of sight of a CCD line's centre and the line's direction, from the plane and the interior orientation.

    Raises AngleError for bad tangents.

    Args:
        plane: fitted to the line.
        tangent: (n,) tangent of the angle of each point from the line of sight along the CCD line, from its pixel
            number and the interior orientation; either sense of counting.
        bend: how far the ends of a line that the laboratory knows as straight may have bent out of its plane since, one
            sigma, radians. The bend is estimated with this sigma as its prior, and the central ray follows it. 0: not.
    """
    if plane.method == "printed":
        raise AngleError("central ray: the printed plane does not contain its points")
    station: Station = plane.station
    strip: Strip = plane.strip
    w = np.asarray(tangent, np.float64)
    if w.shape != (len(strip.points),) or not np.all(np.isfinite(w)):
        raise AngleError(f"central ray: need {len(strip.points)} finite tangents, found {w.shape}")
    arm = strip.points - station.position
    middle = arm.mean(axis=0)
    middle = middle - (middle @ plane.normal) * plane.normal
    middle = middle / np.linalg.norm(middle)
    side = np.cross(plane.normal, middle)
    seen, interior = np.arctan2(arm @ side, arm @ middle), np.arctan(w)
    spread = interior - interior.mean()
    slope = float(spread @ (seen - seen.mean()) / (spread @ spread)) if np.any(spread) else 0.0
    if abs(abs(slope) - 1.0) > 0.1:
        raise AngleError(
            f"central ray: the points open {abs(slope):.3g} times the angle that their tangents say; wrong tangents?"
        )
    # a point's angle is good to its sigma over its distance
    weight = np.sum(arm**2, axis=1) / np.trace(strip.covariance, axis1=1, axis2=2)
    turn = float(np.sum(weight * (seen - np.copysign(1.0, slope) * interior)) / np.sum(weight))
    central = np.cos(turn) * middle + np.sin(turn) * side
    side = np.copysign(1.0, slope) * np.cross(plane.normal, central)
    if bend <= 0.0 or not np.any(spread):
        return LineFrame(central, side, plane, 0.0)
    off, variance = _off_plane(plane, arm, interior, bend)
    return LineFrame(np.cos(off) * central + np.sin(off) * plane.normal, side, plane, variance)


def _off_plane(plane: PlaneFit, arm: Array, interior: Array, bend: float) -> tuple[float, float]:
    """Angle of the central ray out of the plane when the line may be bent, and what its variance grows by."""
    distance = np.linalg.norm(arm, axis=1)
    spread = np.sqrt(np.einsum("i,nij,j->n", plane.normal, plane.strip.covariance, plane.normal)) / distance
    columns = np.column_stack([np.cos(interior), np.sin(interior), (interior / np.abs(interior).max()) ** 2])
    design = columns / spread[:, None]
    square = design.T @ design
    rigid = np.linalg.inv(square[:2, :2])[0, 0]
    square[2, 2] += bend**-2
    inverse = np.linalg.inv(square)
    off = inverse @ design.T @ (plane.residual / distance / spread)
    return float(off[0]), float(inverse[0, 0] - rigid)


@dataclass(frozen=True, eq=False)
class AlongTrackAngles:
    """Signed angles along the track between pairs of lines. values: (m,) radians. covariance: (m, m) rad^2."""

    values: Array
    covariance: Array

    @property
    def sigma(self) -> Array:
        """(m,) radians."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def along_track_angle(central_a: ArrayLike, side_a: ArrayLike, central_b: ArrayLike, side_b: ArrayLike) -> float:
    """Turn about the mean direction of two lines that takes the second's central ray to the first's, radians.

    Unit vectors (3,). Positive where the first looks ahead of the second, sides pointing to the right of the track.
    Raises AngleError for lines that run in opposite directions.

    Args:
        central_a: central ray of the first line, unit, (3,).
        side_a: direction of the first line, unit, (3,).
        central_b: of the second line, likewise.
        side_b: likewise.
    """
    first, second = np.asarray(central_a, np.float64), np.asarray(central_b, np.float64)
    axis = np.asarray(side_a, np.float64) + np.asarray(side_b, np.float64)
    length = float(np.linalg.norm(axis))
    if length < 1.0:
        raise AngleError("along-track angle: the lines run in opposite directions; are pixels counted alike?")
    axis = axis / length
    return float(np.arctan2(axis @ np.cross(second, first), first @ second - (first @ axis) * (second @ axis)))


def along_track_angles(lines: Sequence[LineFrame], pairs: Sequence[tuple[int, int]]) -> AlongTrackAngles:
    """Signed angles between pairs of lines seen from one station, with their joint covariance.

    A plane that turns about its line's direction moves its central ray by as much; turns within a plane count only by
    the angle between the two lines, and are left out of the covariance. pairs: indices into `lines`. Raises AngleError,
    for several stations, too.
    """
    planes = [line.plane for line in lines]
    station = _common_station(planes)
    gradient = np.zeros((len(pairs), len(lines), 3))
    values, sign = np.empty(len(pairs)), np.zeros((len(pairs), len(lines)))
    for row, (i, j) in enumerate(pairs):
        a, b = lines[i], lines[j]
        values[row] = along_track_angle(a.central, a.side, b.central, b.side)
        for k, way in ((i, 1.0), (j, -1.0)):
            line = lines[k]
            # the normal that looks ahead turns away from the central ray when the plane turns ahead
            gradient[row, k] = -way * line.central * np.copysign(1.0, line.plane.normal @ line.forward)
            sign[row, k] = way
    own = np.array([line.variance for line in lines])
    covariance = _propagated(gradient, planes, station) + (sign * own) @ sign.T
    return AlongTrackAngles(values, covariance)


def height_error(
    angle_error: ArrayLike, slant_range: ArrayLike, convergence: ArrayLike, zenith: ArrayLike = 0.0
) -> Array:
    """Error of intersected heights when a look angle is taken wrong by `angle_error`, metres, to first order.

    The wrong ray passes the ground point at slant_range * angle_error and so meets the other ray, at the angle
    `convergence` on the ground, farther along by that over sin(convergence); `zenith`: zenith angle of the other ray.
    For a camera at height H over flat ground, against nadir: H * angle_error / (sin a cos a). Radians, metres.

    Args:
        angle_error: of the look angle, radians, any shape.
        slant_range: to the ground point, metres.
        convergence: angle between the rays on the ground, radians.
        zenith: zenith angle of the other ray, radians.
    """
    along = np.asarray(slant_range) * np.asarray(angle_error) / np.sin(np.asarray(convergence, np.float64))
    return np.asarray(along * np.cos(np.asarray(zenith, np.float64)))


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
