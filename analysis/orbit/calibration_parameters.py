"""What an in-orbit geometric calibration has: fields of points, unknowns by name, and what is known of them before.

Names of the unknowns: "forward f", "forward x", "forward y" and so on for each line camera; "Beijing roll", "Beijing
pitch", "Beijing yaw" for each field, or "roll", "pitch", "yaw" where all fields share one bias; "Beijing offset along",
"... across", "... down" for a constant error of the orbit during one field, in the field's mean body axes; "Beijing
forward d_alpha", "... d_beta", "... d_gamma", "... d_f" for the drift of a camera during one field from its reference
state, which interior orientation and mounting describe; "roll rate", "pitch rate", "yaw rate" for a drift of the bias
during every field, or "Beijing roll rate" and so on during each, rad/s, zero at the mean time of the field's rays.

Which combinations of calibration unknowns the points leave open, by name, and the gauge that closes them.

Unknowns are counted in sigmas of their start values: what a launch may change, or `WORST` metres of image motion
(`scale`; of a principal distance at the ends of the line, where it moves the image most). The normal matrix N carries
the a-priori sigmas of the measurements; in these units the eigenvectors of N are combinations that are uncorrelated,
each known to 1 / sqrt(eigenvalue). A combination is open when that is above 1: the data say less of it than the start
values do. The space of open combinations depends on neither units nor order nor on which combinations of the unknowns
are chosen as unknowns, and all that is square to it is known better than at the start. Misfit does not open anything:
estimated variance factors do not count here. Start values with sigmas then are observations of the open combinations,
and of nothing else; what the points tell is left to the points.

The strength of a combination compares the reduced system with the lengths its columns had before the ground points were
eliminated: at a strength s it is known 1/s times less well than its unknowns alone. What is solved for with a strength
below `WEAK` is reported. What opens in a three-line camera:

- x of all lines against pitch: exact for lines square to the track, whatever the terrain.
- Orbit offsets against bias and interior: broken by relief and by the curvature of the Earth, a thousandth.
- Roll against y of all lines, yaw against y of the outer ones: broken by the turn of the outer lines about their line
  of sight, so weak or correlated, not open.
- Drift of the cameras in each field, unless a monitor tells it: d_alpha, d_beta and d_f of one line in all fields
  against its x, y and f; d_alpha, d_beta and d_gamma of all lines in one field against the bias of that field.
- A drift of the bias during the fields against x and y of the outer lines, which see a field earlier and later: weak,
  for within a line a field of 50 km passes in 7 s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve, eigh, qr
from scipy.spatial.transform import Rotation

from analysis.arrays import ARCSEC, Array, MeasurementError
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

    Attributes
    ----------
    group : str
        Variance group.
    kind : Literal['attitude', 'station']
        What it acts on.
    sigma : float
        Of a reading, about each body axis in radians or along each axis in metres; of a random walk what it gains in a
        second.
    interval : float | None
        Of the readings, seconds, that a cubic spline joins; None where each exposure has noise of its own.
    walks : bool
        Whether it is a random walk, straight between its values at the interval.
    """

    group: str
    kind: Literal["attitude", "station"]
    sigma: float
    interval: float | None
    walks: bool = False


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the measurements.

    Attributes
    ----------
    image : float
        Of an image point in x and in y, metres; x is the image line times the pixel pitch. Independent. Where rays have
        a spread of their own it counts in units of this.
    attitude : float
        Of a reading of the attitude about each body axis, radians.
    station : float
        Of a reading of the station along each axis, metres.
    attitude_interval, station_interval : float | None
        Seconds between readings, at whole multiples of it. A cubic spline joins them, so that rays with known times
        share errors. None: each exposure has its own.
    slow_attitude : float
        Of slow errors of the attitude, a cubic spline through independent values every `slow_interval` seconds,
        radians.
    attitude_walk : float
        Of what a random walk of the attitude gains in a second, radians. Its level at the middle of a pass is the bias.
        It needs the times of the rays.
    walk_interval : float
        Between the values of it that are solved for, seconds.
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

    Attributes
    ----------
    name : str
        Of the field.
    rays : Mapping[str, Rays]
        Line camera -> its image points.
    ground : Array
        (m, 3) coordinates of the control points, start values of the others, ITRS, metres.
    covariance : Array
        (m, 3, 3) of the control points; zero where they are exact, not used for others.
    control : NDArray[np.bool_]
        (m,) which of the points are control; the others are tie points.
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

        Parameters
        ----------
        name : str
            Of the field.
        rays : Mapping[str, Rays]
            Line -> its image points.
        ground : ArrayLike
            Of the points, ITRS, (P, 3), metres.
        sigma : float | tuple[float, float] | Array
            Of control points, one for all axes or (each axis in plan, height), metres, 0 for exact; or their
            covariance, (P, 3, 3), m^2, zero for exact ones.
        control : ArrayLike | None
            Which points are control, (P,); all by default.

        Raises
        ------
        CalibrationError
            Shapes, values that are not finite, points far from the ellipsoid, rays of points that do not exist, tie
            points that fewer than two lines see.
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
        attitudes = np.concatenate([r.attitude for r in self.rays.values()])
        return np.asarray(Rotation.from_matrix(attitudes).mean().as_matrix())


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

    Parameters
    ----------
    points : Array
        ITRS, (m, 3), metres.
    plan : ArrayLike
        Standard deviation of each axis in plan, metres, or (m,).
    tall : ArrayLike
        Of the height, likewise.
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

    Attributes
    ----------
    offset : bool
        Whether the orbit has a constant error in each field.
    drift : bool
        Whether every camera has changed during each field against its reference state. It is open against bias and
        interior unless priors, for example of an on-board monitor, tell it.
    rate : Literal['common', 'field', 'none']
        Drift of the bias during the fields, the same in all or one in each, or none. It is weak against x and y of the
        outer lines, which see a field before and after the nadir line, unless priors tell it.
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

    Parameters
    ----------
    field : str
        Its name.
    line : str
        Of the camera.
    reading : ArrayLike
        (4,) of d_alpha, d_beta, d_gamma (radians) and d_f (metres), against the reference state.
    sigma : ArrayLike
        Of each, (4,); infinite where nothing is told.

    Raises
    ------
    CalibrationError
        Other shapes.
    """
    values, sigmas = np.asarray(reading, np.float64), np.asarray(sigma, np.float64)
    if values.shape != (4,) or sigmas.shape != (4,):
        raise CalibrationError(f"monitor: reading and sigma must be (4,), {', '.join(DRIFT)}")
    readings = zip(DRIFT, values.tolist(), sigmas.tolist(), strict=True)
    return [Prior({f"{field} {line} {n}": 1.0}, v, s, "monitor") for n, v, s in readings if s != np.inf]


@dataclass(frozen=True, eq=False)
class Parameters:
    """The unknowns in order, with start values.

    Attributes
    ----------
    names : tuple[str, ...]
        Of the unknowns.
    start : Array
        (P,) start values, metres and radians.
    scale : Array
        (P,) the change of each that moves the image by about one metre: 1 for principal points, 1/f rad, range/f m; of
        f the change that moves the ends of the line by one metre.
    columns : Mapping[tuple[str, str], tuple[Array, Array, Array, Array, Array]]
        (field, line) -> (indices of f, x, y), (of roll, pitch, yaw), (of along, across, down), (of d_alpha, d_beta,
        d_gamma, d_f), (of the rates of roll, pitch, yaw), -1 if fixed.
    middles : Mapping[str, float]
        Field -> mean time of its rays, seconds, where the bias drifts.
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

        Raises
        ------
        CalibrationError
            No fields, two of one name, a line without a camera, an unknown name in start, rates without the times of
            the rays.
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

        Parameters
        ----------
        values : Array
            Of all unknowns, (U,), SI.
        name : str
            Of the field.
        line : str
            Of the camera.
        rays : Rays
            Of that line.
        """
        columns = self.columns[name, line][4]
        if columns[0] < 0 or not len(rays.point):
            return rays
        turn = self.since_middle(name, rays)[:, None] * values[columns]
        return replace(rays, attitude=rays.attitude @ Rotation.from_rotvec(turn).as_matrix())

    def parts(self, values: Array, name: str, line: str, camera: LineModel) -> tuple[LineModel, Array, Array]:
        """Camera with interior and drift, bias (3,) and offset (3,) (field axes) of one line of one field.

        Parameters
        ----------
        values : Array
            Of all unknowns, (U,), SI.
        name : str
            Of the field.
        line : str
            Of the camera.
        camera : LineModel
            As the laboratory knows it.
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


# Image motion: 15 px of 6.5 um, 32 arcsec, 75 m on the ground, as without any calibration (paper 003: 100 m class). A
# camera that is mounted askew by one arc minute lets the pitch be seen, but to 400 px with sixty points of 0.3 px.
WORST = 1e-4
# Of the noise of a single image point: a combination that may move the image by so much without the points' noticing is
# none of theirs, whatever start values say of it. Six points over the width of a field leave 500 times or less.
LOST = 3e3
WEAK = 3e-2
_CLOSED = 10.0
_SHOWN = 1e-2
_ANGLES = (*BIAS, *DRIFT[:3], "rate")


@dataclass(frozen=True, eq=False)
class Combination:
    """A change of unknowns that (nearly) moves no image point.

    Attributes
    ----------
    names, change : tuple[str, ...]
        The unknowns that take part and their changes, metres and radians, for a largest image motion of any single one
        of 1 mm.
    strength : float
        How much less well it is known than its unknowns alone would be.
    sigma : float
        What one sigma of the data allows it, metres of image motion of the unknown that moves the image most.
    """

    names: tuple[str, ...]
    change: Array
    strength: float
    sigma: float

    def __str__(self) -> str:
        parts = [shown(n, c) for n, c in zip(self.names, self.change, strict=True)]
        return f"{', '.join(parts)} (strength {self.strength:.1e}, sigma {self.sigma * 1e3:.2g} mm)"


@dataclass(frozen=True)
class Gauge:
    """Rule that closes open combinations.

    Attributes
    ----------
    held : tuple[str, ...]
        Unknowns that keep their start values, for example ("nadir x",).
    start : Mapping[str, float] | float | None
        Sigmas of the start values, which observe open combinations and nothing else: by name, metres or radians, or one
        for all, metres of image motion. None: nothing closes what the points leave open.
    """

    held: tuple[str, ...] = ()
    start: Mapping[str, float] | float | None = None

    def __str__(self) -> str:
        held = f"held at the start values: {', '.join(self.held)}" if self.held else ""
        sure = "to what is stated of them"
        if isinstance(self.start, float):
            sure = f"to {self.start:g} m of image motion"
        start = "" if self.start is None else f"open combinations keep their start values, {sure}"
        return "; ".join(t for t in (held, start) if t) or "none"

    def sigmas(self, names: Sequence[str], scale: Array) -> tuple[Array, NDArray[np.bool_]]:
        """(P,) sigmas of the start values, SI, `WORST` of image motion where none is stated; (P,) whether it is.

        Raises CalibrationError for one that is not positive.
        """
        if self.start is None:
            return WORST * scale, np.zeros(len(names), bool)
        if isinstance(self.start, Mapping):
            given = np.array([self.start.get(n, np.nan) for n in names])
        else:
            given = self.start * scale
        stated = ~np.isnan(given)
        if not np.all(np.isfinite(given[stated]) & (given[stated] > 0)):
            raise CalibrationError(f"calibration: sigmas of start values must be positive, found {self.start}")
        return np.where(stated, given, WORST * scale), stated


class RankError(CalibrationError):
    """The points leave combinations of unknowns open and no gauge closes them.

    open: the combinations. They are also in the message, by name.
    """

    def __init__(self, message: str, open_combinations: Sequence[Combination]) -> None:
        super().__init__(message)
        self.open = tuple(open_combinations)


@dataclass(frozen=True, eq=False)
class Freedom:
    """What a gauge lets an adjustment solve for.

    Attributes
    ----------
    kept : NDArray[np.intp]
        (R,) unknowns that are solved for.
    rows : Array
        (k, P) what the start values observe: rows @ (unknowns - start) is zero to a standard deviation of 1.
    opened : tuple[Combination, ...]
        The open combinations before the gauge.
    """

    kept: NDArray[np.intp]
    rows: Array
    opened: tuple[Combination, ...]


def null_vectors(reduced: Array, sigma: Array) -> Array:
    """(P, k) orthonormal basis of what is open, in units of `sigma`.

    Parameters
    ----------
    reduced : Array
        (P, P) normal matrix, of the a-priori sigmas.
    sigma : Array
        (P,) of the start values.
    """
    values, vectors = eigh(sigma[:, None] * reduced * sigma)
    # an eigenvalue below the rounding of the largest one is no information
    rounding = len(values) * np.finfo(np.float64).eps * max(float(values[-1]), 0.0)
    return np.asarray(vectors[:, values < max(1.0, rounding)])


def weak_vectors(reduced: Array, length: Array, scale: Array, basis: Array) -> Array:
    """(P, k) combinations within `basis` whose strength is below `WEAK`, in units of `scale`.

    Parameters
    ----------
    reduced : Array
        Normal matrix without the ground points, (P, P).
    length : Array
        (P,) of the columns of the normal matrix before the ground points were eliminated.
    scale : Array
        a-priori sigmas of the unknowns, (P,), SI.
    basis : Array
        Of what may be solved for, (P, r), in units of `scale`.
    """
    unit = scale * np.where(length > 0, length, 1.0)
    squares = basis.T @ (unit[:, None] ** 2 * basis)
    values, vectors = eigh(basis.T @ (scale[:, None] * reduced * scale) @ basis, squares)
    return np.asarray(basis @ vectors[:, values < WEAK**2])


def combinations(
    names: Sequence[str], scale: Array, vectors: Array, reduced: Array, length: Array
) -> tuple[Combination, ...]:
    """The space of vectors (P, k), in units of `scale`, by name: what takes part with a hundredth of the largest motion
    or more. Each combination has an unknown that is in no other one.

    Parameters
    ----------
    names : Sequence[str]
        Of the P unknowns.
    scale : Array
        Their units, (P,), SI.
    vectors : Array
        (P, k), in units of `scale`.
    reduced : Array
        Normal matrix without the ground points, (P, P).
    length : Array
        Of the columns before the ground points were eliminated, (P,).
    """
    found = []
    for vector in echelon(vectors).T:
        change = scale * vector / np.abs(vector).max()
        form = float(np.sqrt(max(float(change @ reduced @ change), 0.0)))
        taking = np.flatnonzero(np.abs(vector) >= _SHOWN * np.abs(vector).max())
        found.append(
            Combination(
                tuple(names[i] for i in taking.tolist()),
                1e-3 * change[taking],
                form / max(float(np.linalg.norm(change * length)), 1e-300),
                1.0 / max(form, 1e-300),
            )
        )
    return tuple(found)


def free_basis(
    reduced: Array,
    length: Array,
    scale: Array,
    names: Sequence[str],
    gauge: Gauge | None,
    ray: float = np.inf,
    told: Mapping[str, float] | None = None,
) -> Freedom:
    """What may be solved for. `reduced` (P, P) is of the a-priori sigmas.

    Parameters
    ----------
    reduced : Array
        Normal matrix without the ground points, (P, P), of the a-priori sigmas.
    length : Array
        Of the columns before they were eliminated, (P,).
    scale : Array
        Units of the unknowns, (P,), SI.
    names : Sequence[str]
        Of the P unknowns.
    gauge : Gauge | None
        What closes open combinations, None for nothing.
    ray : float
        Standard deviation of a single image point, metres, for `LOST`.
    told : Mapping[str, float] | None
        Unknowns without a stated start value that have priors of their own, with the sigmas of these.

    Raises
    ------
    RankError
        Open combinations that the gauge does not close, or that may move the image by `LOST` times the noise of a
        single image point; points that tell nothing at all.
    CalibrationError
        a held unknown that does not exist, a start value whose sigma is not positive.
    """
    gauge = gauge or Gauge()
    sigma, stated = gauge.sigmas(names, scale)
    if np.any(stated):
        # counted so that their own priors in `reduced` close them
        own_prior = np.array([_CLOSED * (told or {}).get(n, np.nan) for n in names])
        sigma = np.where(stated | np.isnan(own_prior), sigma, own_prior)
    opened = combinations(names, scale, _in_scale(null_vectors(reduced, sigma), sigma, scale), reduced, length)
    kept = np.setdiff1d(np.arange(len(names)), [index(names, n) for n in gauge.held])
    within, own = reduced[np.ix_(kept, kept)], sigma[kept]
    inside = null_vectors(within, own)
    # a row says nothing of unknowns whose start values nobody knows
    rows = np.where(stated[kept], inside.T / own, 0.0)
    # what start values close has an eigenvalue of 1 or more then
    checks = [(within + rows.T @ rows, np.where(stated[kept], np.sqrt(2.0), 1.0) * own)]
    if np.any(stated) and np.isfinite(ray):
        checks.append((within, LOST * ray * scale[kept]))
    for matrix, units in checks:
        vectors = null_vectors(matrix, units)
        if vectors.shape[1]:
            if matrix is within:
                vectors, units = inside, own  # all that is open, of which some is lost
            shown = _in_scale(vectors, units, scale[kept])
            found = combinations([names[i] for i in kept.tolist()], scale[kept], shown, within, length[kept])
            text = "; ".join(str(c) for c in found)
            raise RankError(
                f"calibration: the points cannot tell: {text}. Gauge: {gauge}. Hold or weight some of these", found
            )
    if inside.shape[1] == len(kept):
        raise RankError("calibration: the points determine none of the unknowns", opened)
    padded = np.zeros((len(rows), len(names)))
    padded[:, kept] = rows
    return Freedom(kept, padded, opened)


def _in_scale(vectors: Array, sigma: Array, scale: Array) -> Array:
    """(P, k) combinations in units of `sigma` (P,) as vectors in units of `scale` (P,)."""
    return np.asarray(vectors * (sigma / scale)[:, None])


def solved(normal: Array, right: Array) -> Array:
    """Solution of a positive definite system, its unknowns brought to one size first."""
    size = 1.0 / np.sqrt(np.diag(normal))
    factor = cho_factor(size[:, None] * normal * size)
    wide = right.reshape(len(size), -1)
    return np.asarray(size[:, None] * cho_solve(factor, size[:, None] * wide)).reshape(right.shape)


def echelon(vectors: Array) -> Array:
    """(P, k) of the same space as independent vectors (P, k), each with an unknown of its own and a largest entry of 1.

    The own unknowns are those that have most part in the space, which does not depend on the vectors that span it.
    """
    if not vectors.shape[1]:
        return vectors
    basis = np.linalg.qr(vectors)[0]
    own = qr(basis.T, mode="r", pivoting=True)[1][: basis.shape[1]]
    found = np.linalg.solve(basis[own].T, basis.T).T
    largest = np.abs(found).argmax(axis=0)
    return np.asarray(found / found[largest, np.arange(found.shape[1])])


def shown(name: str, change: float) -> str:
    """A change of an unknown, metres or radians, in words."""
    if "offset" in name or "height" in name:
        return f"{name} {change:+.4g} m"
    if name.split()[-1] in _ANGLES:
        per = "/s" if name.endswith("rate") else ""
        return f"{name} {change / ARCSEC:+.4g} arcsec{per}"
    return f"{name} {change * 1e3:+.4g} mm"
