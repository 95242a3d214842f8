"""What an in-orbit geometric calibration has: fields of points, unknowns by name, and what is known of them before.

Names of the unknowns: "forward f", "forward x", "forward y" and so on for each line camera; "Beijing roll", "Beijing
pitch", "Beijing yaw" for each field, or "roll", "pitch", "yaw" where all fields share one bias; "Beijing offset along",
"... across", "... down" for a constant error of the orbit during one field, in the field's mean body axes; "Beijing
forward d_alpha", "... d_beta", "... d_gamma", "... d_f" for the drift of a camera during one field from its reference
state, which interior orientation and mounting describe; "roll rate", "pitch rate", "yaw rate" for a drift of the bias
during every field, or "Beijing roll rate" and so on during each, rad/s, zero at the mean time of the field's rays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from analysis.arrays import Array
from analysis.measurement_error import MeasurementError
from analysis.orbit.three_line_model import BIAS, DRIFT, INTERIOR, LineModel, Rays

OFFSET = ("along", "across", "down")
RATE = tuple(f"{n} rate" for n in BIAS)
_SEMI_AXES = np.array([6378137.0, 6378137.0, 6356752.314245])  # WGS84
_SHORTEST = 1e-3  # of f: half a line that is taken to be at least that long
_FARTHEST = 12e3  # metres: no land is higher, and geodetic coordinates or kilometres are far beyond


class CalibrationError(MeasurementError, ValueError):
    """Input of a calibration that cannot be used."""


@dataclass(frozen=True)
class NoiseTerm:
    """One source of noise of attitude or station.

    Attributes:
        group: variance group.
        kind: what it acts on.
        sigma: of a reading, about each body axis in radians or along each axis in metres; of a random walk what it
            gains in a second.
        interval: of the readings, seconds, that a cubic spline joins; None where each exposure has noise of its own.
        walks: whether it is a random walk, straight between its values at the interval.
    """

    group: str
    kind: Literal["attitude", "station"]
    sigma: float
    interval: float | None
    walks: bool = False


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the measurements.

    Attributes:
        image: of an image point in x and in y, metres; x is the image line times the pixel pitch. Independent. Where
            rays have a spread of their own it counts in units of this.
        attitude: of a reading of the attitude about each body axis, radians.
        station: of a reading of the station along each axis, metres.
        attitude_interval, station_interval: seconds between readings, at whole multiples of it. A cubic spline joins
            them, so that rays with known times share errors. None: each exposure has its own.
        slow_attitude: of slow errors of the attitude, a cubic spline through independent values every `slow_interval`
            seconds, radians.
        attitude_walk: of what a random walk of the attitude gains in a second, radians. Its level at the middle of a
            pass is the bias. It needs the times of the rays.
        walk_interval: between the values of it that are solved for, seconds.
    """

    image: float
    attitude: float = 0.0
    station: float = 0.0
    attitude_interval: float | None = None
    station_interval: float | None = None
    slow_attitude: float = 0.0
    slow_interval: float | None = None
    attitude_walk: float = 0.0
    walk_interval: float = 0.25

    @property
    def terms(self) -> tuple[NoiseTerm, ...]:
        """Terms of attitude and station that are not zero."""
        every = (
            NoiseTerm("attitude", "attitude", self.attitude, self.attitude_interval),
            NoiseTerm("slow attitude", "attitude", self.slow_attitude, self.slow_interval),
            NoiseTerm("station", "station", self.station, self.station_interval),
            NoiseTerm("attitude walk", "attitude", self.attitude_walk, self.walk_interval, True),
        )
        return tuple(t for t in every if t.sigma > 0)

    def check(self) -> None:
        """Raises CalibrationError for sigmas and intervals that cannot be used."""
        sigmas = (self.image, self.attitude, self.station, self.slow_attitude, self.attitude_walk)
        if not (np.isfinite(sigmas).all() and self.image > 0 and min(sigmas) >= 0):
            raise CalibrationError(
                f"calibration: sigmas must be finite, that of the image positive and no other negative, found {self}"
            )
        given = (self.attitude_interval, self.station_interval, self.slow_interval, self.walk_interval)
        intervals = [v for v in given if v is not None]
        if not all(np.isfinite(v) and v > 0 for v in intervals):
            raise CalibrationError(f"calibration: intervals must be finite and positive, found {self}")


@dataclass(frozen=True, eq=False)
class CalibrationField:
    """One pass over one field of points.

    Attributes:
        name: of the field.
        rays: line camera -> its image points.
        ground: (m, 3) coordinates of the control points, start values of the others, ITRS, metres.
        covariance: (m, 3, 3) of the control points; zero where they are exact, not used for others.
        control: (m,) which of the points are control; the others are tie points.
    """

    name: str
    rays: Mapping[str, Rays]
    ground: Array
    covariance: Array
    control: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        name: str,
        rays: Mapping[str, Rays],
        ground: ArrayLike,
        sigma: float | tuple[float, float] | Array,
        control: ArrayLike | None = None,
    ) -> CalibrationField:
        """The field, checked.

        Args:
            name: of the field.
            rays: line -> its image points.
            ground: of the points, ITRS, (P, 3), metres.
            sigma: of control points, one for all axes or (each axis in plan, height), metres, 0 for exact; or their
                covariance, (P, 3, 3), m^2, zero for exact ones.
            control: which points are control, (P,); all by default.

        Raises:
            CalibrationError: shapes, values that are not finite, points far from the ellipsoid, rays of points that do
                not exist, tie points that fewer than two lines see.
        """
        points = np.array(ground, np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or not np.all(np.isfinite(points)):
            raise CalibrationError(f"field {name!r}: ground must be (m, 3) and finite, found {points.shape}")
        spread = _control_covariance(name, points, sigma)
        is_control = np.ones(len(points), bool) if control is None else np.array(control, bool)
        if is_control.shape != (len(points),):
            raise CalibrationError(f"field {name!r}: control must be ({len(points)},), found {is_control.shape}")
        height = _rough_height(points)
        far = np.flatnonzero(np.abs(height) > _FARTHEST)
        if len(far):
            raise CalibrationError(
                f"field {name!r}: point {far[0]} lies {height[far[0]] / 1e3:.4g} km above the ellipsoid; are its"
                " coordinates geocentric (ITRS) and in metres?"
            )
        counts = np.zeros(len(points), int)
        for line, row in rays.items():
            if row.point.size and not (row.point.min() >= 0 and row.point.max() < len(points)):
                raise CalibrationError(f"field {name!r}: a ray of line {line!r} shows a point that does not exist")
            counts[row.point] += 1
        lonely = np.flatnonzero(~is_control & (counts < 2))
        if len(lonely):
            raise CalibrationError(
                f"field {name!r}: tie point {lonely[0]} is seen by {counts[lonely[0]]} lines, not two"
            )
        return cls(name, dict(rays), points, spread, is_control)

    @property
    def axes(self) -> Array:
        """(3, 3) mean body axes (along, across, down) as columns, ITRS: the rotation nearest to the mean attitude."""
        u, _, vt = np.linalg.svd(np.concatenate([r.attitude for r in self.rays.values()]).mean(axis=0))
        return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt)


def _control_covariance(name: str, points: Array, sigma: float | tuple[float, float] | Array) -> Array:
    """(m, 3, 3) of control points, m^2."""
    if isinstance(sigma, np.ndarray):
        exact = ~np.any(sigma, axis=(1, 2)) if sigma.shape == (len(points), 3, 3) else np.zeros(0, bool)
        if len(exact) != len(points) or not np.all(np.linalg.eigvalsh(sigma)[~exact] > 0.0):
            raise CalibrationError(f"field {name!r}: covariances must be ({len(points)}, 3, 3) and positive or zero")
        return sigma
    plan, tall = sigma if isinstance(sigma, tuple) else (sigma, sigma)
    if not (np.isfinite([plan, tall]).all() and min(plan, tall) >= 0 and (plan > 0) == (tall > 0)):
        raise CalibrationError(f"field {name!r}: sigma must be finite, and positive or zero for all axes")
    return level_covariance(points, plan, tall)


def level_covariance(points: Array, plan: ArrayLike, tall: ArrayLike) -> Array:
    """(m, 3, 3) covariance in ITRS axes, m^2, of points known alike in both axes in plan.

    Args:
        points: ITRS, (m, 3), metres.
        plan: standard deviation of each axis in plan, metres, or (m,).
        tall: of the height, likewise.
    """
    up = vertical(points)
    flat, high = (np.asarray(v, np.float64)[..., None, None] ** 2 for v in (plan, tall))
    return np.asarray(flat * np.eye(3) + (high - flat) * up[:, :, None] * up[:, None, :])


def _rough_height(points: Array) -> Array:
    """(m,) distance above the ellipsoid along the radius, metres."""
    radius = np.linalg.norm(points, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(radius - radius / np.linalg.norm(points / _SEMI_AXES, axis=1))


def vertical(points: Array) -> Array:
    """Unit normals of the ellipsoid at points (m, 3), ITRS, m: good to h/a of the deflection, 1e-6 rad below 2 km."""
    normal = points / _SEMI_AXES**2
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


@dataclass(frozen=True)
class Unknowns:
    """What is solved for beside the interior orientation (f, x and y of every line camera) and an attitude bias of each
    field.

    Attributes:
        offset: whether the orbit has a constant error in each field.
        drift: whether every camera has changed during each field against its reference state. It is open against bias
            and interior unless priors, for example of an on-board monitor, tell it.
        rate: drift of the bias during the fields, the same in all or one in each, or none. It is weak against x and y
            of the outer lines, which see a field before and after the nadir line, unless priors tell it.
    """

    offset: bool = False
    drift: bool = False
    rate: Literal["common", "field", "none"] = "none"

    def __post_init__(self) -> None:
        """Refuse a word that means nothing: it would count as none."""
        if self.rate not in ("common", "field", "none"):
            raise CalibrationError(f"calibration: rate must be common, field or none, found {self.rate!r}")


@dataclass(frozen=True, eq=False)
class Prior:
    """Pseudo-observation of a linear combination of unknowns: sum of weight * unknown = value, with sigma.

    A laboratory's principal distance is `Prior({"nadir f": 1.0}, 0.65, 20e-6)`; an orbit known to 0.3 m is
    `Prior({"Beijing offset along": 1.0}, 0.0, 0.3)`. `group` names the variance component that it belongs to.
    """

    weights: Mapping[str, float]
    value: float
    sigma: float
    group: str = "prior"


def monitor_priors(field: str, line: str, reading: ArrayLike, sigma: ArrayLike) -> list[Prior]:
    """What an on-board monitor of one camera tells of its drift during one field.

    Args:
        field: its name.
        line: of the camera.
        reading: (4,) of d_alpha, d_beta, d_gamma (radians) and d_f (metres), against the reference state.
        sigma: of each, (4,); infinite where nothing is told.

    Raises:
        CalibrationError: other shapes.
    """
    values, sigmas = np.asarray(reading, np.float64), np.asarray(sigma, np.float64)
    if values.shape != (4,) or sigmas.shape != (4,):
        raise CalibrationError(f"monitor: reading and sigma must be (4,), {', '.join(DRIFT)}")
    readings = zip(DRIFT, values.tolist(), sigmas.tolist(), strict=True)
    return [Prior({f"{field} {line} {n}": 1.0}, v, s, "monitor") for n, v, s in readings if s != np.inf]


@dataclass(frozen=True, eq=False)
class Parameters:
    """The unknowns in order, with start values.

    Attributes:
        names: of the unknowns.
        start: (P,) start values, metres and radians.
        scale: (P,) the change of each that moves the image by about one metre: 1 for principal points, 1/f rad, range/f
            m; of f the change that moves the ends of the line by one metre.
        columns: (field, line) -> (indices of f, x, y), (of roll, pitch, yaw), (of along, across, down), (of d_alpha,
            d_beta, d_gamma, d_f), (of the rates of roll, pitch, yaw), -1 if fixed.
        middles: field -> mean time of its rays, seconds, where the bias drifts.
    """

    names: tuple[str, ...]
    start: Array
    scale: Array
    columns: Mapping[tuple[str, str], tuple[Array, Array, Array, Array, Array]] = field(repr=False)
    middles: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        fields: Sequence[CalibrationField],
        cameras: Mapping[str, LineModel],
        unknowns: Unknowns,
        start: Mapping[str, float] | None = None,
    ) -> Parameters:
        """start: by name, where not the cameras' interior and zero.

        Raises:
            CalibrationError: no fields, two of one name, a line without a camera, an unknown name in start, rates
                without the times of the rays.
        """
        if not fields:
            raise CalibrationError("calibration: no fields")
        if len({f.name for f in fields}) != len(fields):
            raise CalibrationError("calibration: two fields have one name")
        focal = float(np.mean([c.interior[0] for c in cameras.values()]))
        entries: dict[str, tuple[float, float]] = {}
        for line, camera in cameras.items():
            # f moves an image by the tangent of its place in the field
            units = (float(camera.interior[0]) / _edge(fields, line, camera), 1.0, 1.0)
            start_values = zip(INTERIOR, camera.interior, units, strict=True)
            entries |= {f"{line} {n}": (float(v), s) for n, v, s in start_values}
        for one in fields:
            reach = [np.linalg.norm(one.ground[r.point] - r.station, axis=1) for r in one.rays.values() if r.point.size]
            if not reach:
                raise CalibrationError(f"field {one.name!r}: no image points")
            entries |= {f"{one.name} {n}": (0.0, 1.0 / focal) for n in BIAS}
            if unknowns.offset:
                metres = float(np.mean(np.concatenate(reach))) / focal
                entries |= {f"{one.name} offset {n}": (0.0, metres) for n in OFFSET}
            if unknowns.drift:
                for line, rays in one.rays.items():
                    # d_gamma swings the ends of the line
                    ends = max(float(np.abs(rays.image[:, 1]).max(initial=0.0)), _SHORTEST * focal)
                    sizes = (1.0 / focal, 1.0 / focal, 1.0 / ends, 1.0)
                    entries |= {f"{one.name} {line} {n}": (0.0, s) for n, s in zip(DRIFT, sizes, strict=True)}
        middles = {} if unknowns.rate == "none" else {one.name: _middle(one) for one in fields}
        if middles:
            spans = [np.ptp(np.concatenate([r.time for r in f.rays.values() if r.time is not None])) for f in fields]
            swings = [2.0 / (focal * max(float(span), _SHORTEST)) for span in spans]
            if unknowns.rate == "common":
                entries |= dict.fromkeys(RATE, (0.0, min(swings)))
            else:
                entries |= {f"{f.name} {n}": (0.0, size) for f, size in zip(fields, swings, strict=True) for n in RATE}
        names = tuple(entries)
        where = {n: i for i, n in enumerate(names)}
        values = np.array([entries[n][0] for n in names])
        for n, v in (start or {}).items():
            values[index(names, n)] = v
        columns = {}
        for one in fields:
            for line in one.rays:
                if line not in cameras:
                    raise CalibrationError(f"field {one.name!r}: no camera is called {line!r}")
                groups = (
                    [f"{line} {n}" for n in INTERIOR],
                    [f"{one.name} {n}" for n in BIAS],
                    [f"{one.name} offset {n}" for n in OFFSET],
                    [f"{one.name} {line} {n}" for n in DRIFT],
                    [n if unknowns.rate == "common" else f"{one.name} {n}" for n in RATE],
                )
                inner, turn, shift, drift, rate = (np.array([where.get(n, -1) for n in g]) for g in groups)
                columns[one.name, line] = (inner, turn, shift, drift, rate)
        return cls(names, values, np.array([entries[n][1] for n in names]), columns, middles)

    def since_middle(self, name: str, rays: Rays) -> Array:
        """(n,) seconds from the middle of a field to its rays; zero where the bias does not drift."""
        if name not in self.middles or rays.time is None:
            return np.zeros(len(rays.point))
        return np.asarray(rays.time - self.middles[name])

    def turned(self, values: Array, name: str, line: str, rays: Rays) -> Rays:
        """Rays with the drift of the bias since the middle of the field taken into their attitude.

        Args:
            values: of all unknowns, (U,), SI.
            name: of the field.
            line: of the camera.
            rays: of that line.
        """
        columns = self.columns[name, line][4]
        if columns[0] < 0 or not len(rays.point):
            return rays
        turn = self.since_middle(name, rays)[:, None] * values[columns]
        return replace(rays, attitude=rays.attitude @ Rotation.from_rotvec(turn).as_matrix())

    def parts(self, values: Array, name: str, line: str, camera: LineModel) -> tuple[LineModel, Array, Array]:
        """Camera with interior and drift, bias (3,) and offset (3,) (field axes) of one line of one field.

        Args:
            values: of all unknowns, (U,), SI.
            name: of the field.
            line: of the camera.
            camera: as the laboratory knows it.
        """
        inner, turn, shift, drift, _ = self.columns[name, line]
        bias, offset = (values[c] if c[0] >= 0 else np.zeros(3) for c in (turn, shift))
        camera = camera.with_interior(values[inner]) if inner[0] >= 0 else camera
        return (camera.drifted(values[drift]) if drift[0] >= 0 else camera), bias, offset


def _edge(fields: Sequence[CalibrationField], line: str, camera: LineModel) -> float:
    """Distance of the ends of a line, or of the outermost of its image points, from its middle, metres."""
    places = [float(np.abs(f.rays[line].image[:, 1]).max(initial=0.0)) for f in fields if line in f.rays]
    return max(camera.half_length, *places, _SHORTEST * float(camera.interior[0]))


def _middle(one: CalibrationField) -> float:
    times = [r.time for r in one.rays.values() if r.point.size]
    if any(t is None for t in times):
        raise CalibrationError(f"field {one.name!r}: a drift of the bias needs the times of all rays")
    return float(np.mean(np.concatenate([t for t in times if t is not None])))


def index(names: Sequence[str], name: str) -> int:
    """Place of a name. Raises CalibrationError that lists the names."""
    if name not in names:
        raise CalibrationError(f"calibration: no unknown is called {name!r}; there are {', '.join(names)}")
    return list(names).index(name)
