"""Parameters of an in-orbit geometric calibration, their priors, their observability and the gauge.

**Names of the unknowns.** "forward f", "forward x", "forward y" and so on are the principal distance and the principal
point of each line camera. "Beijing roll", "Beijing pitch", "Beijing yaw" are the attitude bias of each field, or
"roll", "pitch", "yaw" where all fields share one bias. "Beijing offset along", "... across", "... down" are a constant
orbit error during one field, in the field's mean body axes. "Beijing forward d_alpha", "... d_beta", "... d_gamma",
"... d_f" are the drift of a camera during one field from its reference state, to which interior orientation and
mounting refer. "roll rate", "pitch rate", "yaw rate" are a drift of the bias during every field, or "Beijing roll rate"
and so on during one field, in rad/s, zero at the mean time of the field's rays.

**Observability.** `free_basis` lists the combinations of unknowns that the ground points leave undetermined, and
applies the gauge that fixes them. Unknowns are scaled by the sigmas of their start values: what a launch may change, or
`WORST` metres of image motion (`scale`; for a principal distance at the ends of the line, where it moves the image
most). The normal matrix N uses the a-priori sigmas of the measurements; in these units the eigenvectors of N are
uncorrelated combinations, each with the standard deviation 1 / sqrt(eigenvalue). A combination is called open when that
exceeds 1: the data then determine it less well than the start values do. The space of open combinations depends neither
on units nor on the order of the unknowns nor on their parametrisation, and everything orthogonal to it is known better
than at the start. Poorly fitting data do not open a combination, because estimated variance factors are not used here.
Start values with sigmas act as observations of the open combinations only; the rest is left to the points.

The strength of a combination compares the reduced system with the lengths that its columns had before the ground points
were eliminated: at strength s, its standard deviation is 1/s times that of its unknowns alone. Estimated combinations
with a strength below `WEAK` are reported. Open and weak combinations of a three-line camera:

- x of all lines against pitch: exact for lines perpendicular to the track, whatever the terrain.
- Orbit offsets against bias and interior orientation: separated, to a thousandth, by relief and Earth curvature.
- Roll against y of all lines, yaw against y of the outer ones: separated by the rotation of the outer lines about
  their line of sight, so weak or correlated, not open.
- Drift of the cameras in each field, unless a monitor measures it: d_alpha, d_beta and d_f of one line in all fields
  against its x, y and f; d_alpha, d_beta and d_gamma of all lines in one field against the bias of that field.
- A drift of the bias during the fields against x and y of the outer lines, which see a field earlier and later: weak,
  because a line passes a field of 50 km in 7 s.
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
_SEMI_AXES = np.array([6378137.0, 6378137.0, 6356752.314245])  # WGS84, metres
_SHORTEST = 1e-3
"""Smallest half length assumed for a line, as a fraction of the principal distance."""
_FARTHEST = 12e3
"""Largest plausible height above the ellipsoid, in metres. No land is higher, and coordinates that are geodetic or in
kilometres come out far beyond it.
"""


class CalibrationError(MeasurementError, ValueError):
    """Error raised for invalid input of an in-orbit calibration."""


@dataclass(frozen=True)
class NoiseTerm:
    """Noise source of the attitude or the station.

    Attributes
    ----------
    group : str
        Name of the variance group.
    kind : {'attitude', 'station'}
        Quantity that the noise acts on.
    sigma : float
        Standard deviation of one attitude or position measurement, about each body axis in radians or along each axis
        in metres; for a random walk, the standard deviation of its increment over one second.
    interval : float or None
        Interval between the readings, which a cubic spline interpolates, in seconds. None if every exposure has
        independent noise.
    walks : bool
        True for a random walk, estimated at nodes `interval` seconds apart and linear between them.
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
        Sigma of an image point in x and in y, independent, in metres; x is the image line times the pixel pitch. Where
        rays have a covariance of their own (`Rays.spread`), it is in units of this sigma squared.
    attitude : float
        Sigma of an attitude reading about each body axis, in radians.
    station : float
        Sigma of a station reading along each axis, in metres.
    attitude_interval, station_interval : float or None
        Interval between readings, which lie at its whole multiples, in seconds. A cubic spline interpolates them, so
        that rays with known times share errors. None: every exposure has independent noise.
    slow_attitude : float
        Sigma of slow attitude errors, a cubic spline through independent values every `slow_interval` seconds, in
        radians.
    slow_interval : float or None
        Interval between the nodes of the slow attitude errors, in seconds.
    attitude_walk : float
        Sigma of the increment of an attitude random walk over one second, in radians. Its value at the middle of a pass
        belongs to the bias. It requires the times of the rays.
    walk_interval : float
        Interval between the estimated nodes of the random walk, in seconds.
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
        """Noise terms of attitude and station that are not zero."""
        terms = (
            NoiseTerm("attitude", "attitude", self.attitude, self.attitude_interval),
            NoiseTerm("slow attitude", "attitude", self.slow_attitude, self.slow_interval),
            NoiseTerm("station", "station", self.station, self.station_interval),
            NoiseTerm("attitude walk", "attitude", self.attitude_walk, self.walk_interval, True),
        )
        return tuple(t for t in terms if t.sigma > 0)

    def check(self) -> None:
        """Raise CalibrationError if a standard deviation or an interval is negative, missing or not finite."""
        sigmas = (self.image, self.attitude, self.station, self.slow_attitude, self.attitude_walk)
        if not (np.isfinite(sigmas).all() and self.image > 0 and min(sigmas) >= 0):
            raise CalibrationError(
                f"calibration: sigmas must be finite, that of the image positive and no other negative, found {self}"
            )
        candidates = (self.attitude_interval, self.station_interval, self.slow_interval, self.walk_interval)
        intervals = [v for v in candidates if v is not None]
        if not all(np.isfinite(v) and v > 0 for v in intervals):
            raise CalibrationError(f"calibration: intervals must be finite and positive, found {self}")


@dataclass(frozen=True, eq=False)
class CalibrationField:
    """Image points and ground points of one pass over a test field.

    Attributes
    ----------
    name : str
        Name of the field.
    rays : mapping of str to Rays
        Image points of each line camera, by its name.
    ground : (m, 3) ndarray
        Coordinates of the control points and start values of the tie points, m in all, ITRS, in metres.
    covariance : (m, 3, 3) ndarray
        Covariance of the control points, in m^2; zero where they are error-free, ignored for tie points.
    control : (m,) ndarray of bool
        True for control points, False for tie points.
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
        """Return a calibration field after checking its image and ground points.

        Parameters
        ----------
        name : str
            Name of the field.
        rays : mapping of str to Rays
            Image points of each line camera, by its name.
        ground : (m, 3) array_like
            Coordinates of the m points, ITRS, in metres.
        sigma : float or (float, float) or (m, 3, 3) ndarray
            Standard deviation of the control points in metres, one for all axes or (each horizontal axis, height), 0
            for error-free points; or their covariance in m^2, zero for error-free points.
        control : (m,) array_like of bool, optional
            True for control points; all points by default.

        Raises
        ------
        CalibrationError
            Shapes do not match, values are not finite, a point is far from the ellipsoid, a ray refers to a ground
            point that does not exist, or fewer than two lines see a tie point.
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
        """Mean body axes (along, across, down) as columns, ITRS, (3, 3): the rotation nearest to the mean attitude."""
        attitudes = np.concatenate([r.attitude for r in self.rays.values()])
        return np.asarray(Rotation.from_matrix(attitudes).mean().as_matrix())


def _control_covariance(name: str, points: Array, sigma: float | tuple[float, float] | Array) -> Array:
    """Return the covariances of m control points, (m, 3, 3), in m^2."""
    if isinstance(sigma, np.ndarray):
        exact = ~np.any(sigma, axis=(1, 2)) if sigma.shape == (len(points), 3, 3) else np.zeros(0, bool)
        if len(exact) != len(points) or not np.all(np.linalg.eigvalsh(sigma)[~exact] > 0.0):
            raise CalibrationError(f"field {name!r}: covariances must be ({len(points)}, 3, 3) and positive or zero")
        return sigma
    plan, height = sigma if isinstance(sigma, tuple) else (sigma, sigma)
    if not (np.isfinite([plan, height]).all() and min(plan, height) >= 0 and (plan > 0) == (height > 0)):
        raise CalibrationError(f"field {name!r}: sigma must be finite, and positive or zero for all axes")
    return level_covariance(points, plan, height)


def level_covariance(points: Array, plan: ArrayLike, height: ArrayLike) -> Array:
    """Return the ITRS covariances (m, 3, 3) of m points with equal sigmas along both horizontal axes, in m^2.

    Parameters
    ----------
    points : (m, 3) ndarray
        Coordinates of the points, ITRS, in metres.
    plan : float or (m,) array_like
        Standard deviation along each horizontal axis, in metres.
    height : float or (m,) array_like
        Standard deviation of the height, in metres.
    """
    up = vertical(points)
    plan_variance, height_variance = (np.asarray(v, np.float64)[..., None, None] ** 2 for v in (plan, height))
    return np.asarray(plan_variance * np.eye(3) + (height_variance - plan_variance) * up[:, :, None] * up[:, None, :])


def _rough_height(points: Array) -> Array:
    """Return the distances of m points from the ellipsoid along their radius, (m,), in metres."""
    radius = np.linalg.norm(points, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(radius - radius / np.linalg.norm(points / _SEMI_AXES, axis=1))


def vertical(points: Array) -> Array:
    """Return the unit normals of the ellipsoid at m points, both (m, 3), ITRS; the points are in metres.

    The normal is computed as if the point lay on the ellipsoid. For a point at height h above a semi-major axis a, the
    error is h / a times the angle between normal and radius: 1e-6 rad for heights below 2 km.
    """
    normal = points / _SEMI_AXES**2
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


@dataclass(frozen=True)
class Unknowns:
    """Choice of unknowns beside the interior orientation and the attitude bias of each field.

    Interior orientation means f, x and y of every line camera.

    Attributes
    ----------
    offset : bool
        True to estimate a constant orbit error in each field.
    drift : bool
        True to estimate the change of every camera during each field against its reference state. It cannot be
        separated from bias and interior orientation unless priors, for example from an on-board monitor, determine
        it.
    rate : {'common', 'field', 'none'}
        Drift of the bias during the fields: one for all, one for each field, or none. It is only weakly separated
        from x and y of the outer lines, which see a field before and after the nadir line, unless priors determine
        it.
    """

    offset: bool = False
    drift: bool = False
    rate: Literal["common", "field", "none"] = "none"

    def __post_init__(self) -> None:
        """Raise CalibrationError for an unknown `rate`, which would otherwise act like 'none'."""
        if self.rate not in ("common", "field", "none"):
            raise CalibrationError(f"calibration: rate must be common, field or none, found {self.rate!r}")


@dataclass(frozen=True, eq=False)
class Prior:
    """Pseudo-observation of a linear combination of unknowns.

    The sum of weight * unknown equals `value`, with the standard deviation `sigma`.

    A laboratory's principal distance is `Prior({"nadir f": 1.0}, 0.65, 20e-6)`; an orbit known to 0.3 m is
    `Prior({"Beijing offset along": 1.0}, 0.0, 0.3)`.

    Attributes
    ----------
    weights : mapping of str to float
        Weight of each unknown, by its name.
    value : float
        Value of the combination, in metres or radians.
    sigma : float
        Standard deviation of the value.
    group : str
        Variance component that the prior belongs to.
    """

    weights: Mapping[str, float]
    value: float
    sigma: float
    group: str = "prior"


def monitor_priors(field: str, line: str, reading: ArrayLike, sigma: ArrayLike) -> list[Prior]:
    """Return the priors on a camera's drift during one field that follow from a reading of its on-board monitor.

    Parameters
    ----------
    field : str
        Name of the field.
    line : str
        Name of the line camera.
    reading : (4,) array_like
        Measured drift since the reference state: rotations d_alpha, d_beta, d_gamma of the camera about its Y, X and Z
        axes (radians), and change d_f of its principal distance (metres).
    sigma : (4,) array_like
        Standard deviation of each; infinite for a component that the monitor does not measure.

    Raises
    ------
    CalibrationError
        Reading or sigma is not of shape (4,).
    """
    values, sigmas = np.asarray(reading, np.float64), np.asarray(sigma, np.float64)
    if values.shape != (4,) or sigmas.shape != (4,):
        raise CalibrationError(f"monitor: reading and sigma must be (4,), {', '.join(DRIFT)}")
    readings = zip(DRIFT, values.tolist(), sigmas.tolist(), strict=True)
    return [Prior({f"{field} {line} {n}": 1.0}, v, s, "monitor") for n, v, s in readings if s != np.inf]


@dataclass(frozen=True, eq=False)
class Parameters:
    """Ordered unknowns with their start values.

    Attributes
    ----------
    names : tuple of str
        Names of the P unknowns.
    start : (P,) ndarray
        Start values, in metres and radians.
    scale : (P,) ndarray
        Change of each unknown that moves the image by about one metre: 1 m for principal points x and y, 1/f rad for
        angles and (distance to the ground)/f m for orbit offsets, with f the principal distance in metres; for f
        itself, the change that moves the ends of the line by one metre.
    columns : mapping of (str, str) to tuple of ndarray
        For each (field, line), the indices of the unknowns: interior orientation (f, x, y), attitude bias (roll, pitch,
        yaw), orbit offset (along, across, down), camera drift (d_alpha, d_beta, d_gamma, d_f) and bias rates (roll,
        pitch, yaw); -1 for a fixed parameter.
    middles : mapping of str to float
        Mean time of the rays of each field, in seconds, where the bias drifts.
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
        """Return the parameters of an adjustment, validated.

        Parameters
        ----------
        fields : sequence of CalibrationField
            Passes that are adjusted together.
        cameras : mapping of str to LineModel
            Line cameras, by name.
        unknowns : Unknowns
            Choice of unknowns.
        start : mapping of str to float, optional
            Start values by the names of the unknowns; otherwise the cameras' interior orientation, and zero for the
            rest.

        Raises
        ------
        CalibrationError
            There are no fields, two fields have the same name, a line has no camera, `start` names an unknown
            parameter, or rates are to be estimated without the times of the rays.
        """
        if not fields:
            raise CalibrationError("calibration: no fields")
        if len({f.name for f in fields}) != len(fields):
            raise CalibrationError("calibration: two fields have the same name")
        focal = float(np.mean([c.interior[0] for c in cameras.values()]))
        entries: dict[str, tuple[float, float]] = {}
        for line, camera in cameras.items():
            # a change of f moves an image point in proportion to the tangent of its field angle
            units = (float(camera.interior[0]) / _edge(fields, line, camera), 1.0, 1.0)
            start_values = zip(INTERIOR, camera.interior, units, strict=True)
            entries |= {f"{line} {n}": (float(v), s) for n, v, s in start_values}
        for site in fields:
            ranges = [
                np.linalg.norm(site.ground[r.point] - r.station, axis=1) for r in site.rays.values() if r.point.size
            ]
            if not ranges:
                raise CalibrationError(f"field {site.name!r}: no image points")
            entries |= {f"{site.name} {n}": (0.0, 1.0 / focal) for n in BIAS}
            if unknowns.offset:
                metres = float(np.mean(np.concatenate(ranges))) / focal
                entries |= {f"{site.name} offset {n}": (0.0, metres) for n in OFFSET}
            if unknowns.drift:
                for line, rays in site.rays.items():
                    # d_gamma moves the ends of the line most
                    ends = max(float(np.abs(rays.image[:, 1]).max(initial=0.0)), _SHORTEST * focal)
                    sizes = (1.0 / focal, 1.0 / focal, 1.0 / ends, 1.0)
                    entries |= {f"{site.name} {line} {n}": (0.0, s) for n, s in zip(DRIFT, sizes, strict=True)}
        middles = {} if unknowns.rate == "none" else {site.name: _middle(site) for site in fields}
        if middles:
            spans = [np.ptp(np.concatenate([r.time for r in f.rays.values() if r.time is not None])) for f in fields]
            swings = [2.0 / (focal * max(float(span), _SHORTEST)) for span in spans]
            if unknowns.rate == "common":
                entries |= dict.fromkeys(RATE, (0.0, min(swings)))
            else:
                entries |= {f"{f.name} {n}": (0.0, size) for f, size in zip(fields, swings, strict=True) for n in RATE}
        names = tuple(entries)
        position = {n: i for i, n in enumerate(names)}
        values = np.array([entries[n][0] for n in names])
        for n, v in (start or {}).items():
            values[index(names, n)] = v
        columns = {}
        for site in fields:
            for line in site.rays:
                if line not in cameras:
                    raise CalibrationError(f"field {site.name!r}: no camera is called {line!r}")
                groups = (
                    [f"{line} {n}" for n in INTERIOR],
                    [f"{site.name} {n}" for n in BIAS],
                    [f"{site.name} offset {n}" for n in OFFSET],
                    [f"{site.name} {line} {n}" for n in DRIFT],
                    [n if unknowns.rate == "common" else f"{site.name} {n}" for n in RATE],
                )
                interior, bias, offset, drift, rate = (np.array([position.get(n, -1) for n in g]) for g in groups)
                columns[site.name, line] = (interior, bias, offset, drift, rate)
        return cls(names, values, np.array([entries[n][1] for n in names]), columns, middles)

    def since_middle(self, name: str, rays: Rays) -> Array:
        """Return the times of n rays since the field's mean time, (n,) s; zero where the bias does not drift."""
        if name not in self.middles or rays.time is None:
            return np.zeros(len(rays.point))
        return np.asarray(rays.time - self.middles[name])

    def rotated(self, values: Array, name: str, line: str, rays: Rays) -> Rays:
        """Return rays whose attitude includes the drift of the bias since the middle of the field.

        Parameters
        ----------
        values : (P,) ndarray
            Values of all P unknowns, SI units.
        name : str
            Name of the field.
        line : str
            Name of the line camera.
        rays : Rays
            Rays of that line.
        """
        columns = self.columns[name, line][4]
        if columns[0] < 0 or not len(rays.point):
            return rays
        rotation = self.since_middle(name, rays)[:, None] * values[columns]
        return replace(rays, attitude=rays.attitude @ Rotation.from_rotvec(rotation).as_matrix())

    def parts(self, values: Array, name: str, line: str, camera: LineModel) -> tuple[LineModel, Array, Array]:
        """Return the camera, the bias (3,) and the offset (3,) in field axes for one line of one field.

        Parameters
        ----------
        values : (P,) ndarray
            Values of all P unknowns, SI units.
        name : str
            Name of the field.
        line : str
            Name of the line camera.
        camera : LineModel
            Camera before calibration; its mounting is kept.

        Returns
        -------
        tuple of (LineModel, ndarray, ndarray)
            Camera with the estimated interior orientation and drift, bias in radians, offset in metres.
        """
        interior, bias_columns, offset_columns, drift, _ = self.columns[name, line]
        bias, offset = (values[c] if c[0] >= 0 else np.zeros(3) for c in (bias_columns, offset_columns))
        camera = camera.with_interior(values[interior]) if interior[0] >= 0 else camera
        return (camera.drifted(values[drift]) if drift[0] >= 0 else camera), bias, offset


def _edge(fields: Sequence[CalibrationField], line: str, camera: LineModel) -> float:
    """Return the distance from the middle of a line to its ends or its outermost image point, in metres."""
    extents = [float(np.abs(f.rays[line].image[:, 1]).max(initial=0.0)) for f in fields if line in f.rays]
    return max(camera.half_length, *extents, _SHORTEST * float(camera.interior[0]))


def _middle(site: CalibrationField) -> float:
    """Return the mean time of a field's rays, in seconds."""
    times = [r.time for r in site.rays.values() if r.point.size]
    if any(t is None for t in times):
        raise CalibrationError(f"field {site.name!r}: a drift of the bias needs the times of all rays")
    return float(np.mean(np.concatenate([t for t in times if t is not None])))


def index(names: Sequence[str], name: str) -> int:
    """Return the index of a name; raise CalibrationError, listing the names, if it is not among them."""
    if name not in names:
        raise CalibrationError(f"calibration: no unknown is called {name!r}; there are {', '.join(names)}")
    return list(names).index(name)


WORST = 1e-4
"""Image motion of a start value of unknown accuracy, in metres: 15 px of 6.5 um, 32 arcsec, 75 m on the ground, as
without any calibration (paper 003, Mo et al. 2015: 100 m class). With a camera mounted askew by one arc minute the
pitch becomes observable, but only to 400 px with sixty points of 0.3 px.
"""
LOST = 3e3
"""Largest ratio of a combination's standard deviation, as image motion, to the noise of a single image point. Above it
the combination counts as not determined by the points, whatever the sigmas of the start values. Six points over the
width of a field give 500 or less.
"""
WEAK = 3e-2
"""Strength (`Combination.strength`, 0 to 1) below which an estimated combination of unknowns is reported as weak."""
_CLOSED = 10.0
"""Factor on the sigma of an unknown's prior, within which the prior is taken to fix the combinations that contain this
unknown.
"""
_SHOWN = 1e-2
"""Smallest image motion due to an unknown that is listed in a linear combination, relative to the largest one in it."""
_ANGLES = (*BIAS, *DRIFT[:3], "rate")


@dataclass(frozen=True, eq=False)
class Combination:
    """Linear combination of unknowns that can change together while (nearly) no image point moves.

    Attributes
    ----------
    names : tuple of str
        Unknowns that take part.
    change : (k,) ndarray
        Change of each of the k unknowns in `names`, in metres and radians, scaled so that the largest image motion
        caused by any single one is 1 mm.
    strength : float
        Standard deviation of the combination if each unknown is determined separately, with all others and the ground
        points known, divided by its standard deviation in the adjustment; 0 for an undetermined combination.
    sigma : float
        Standard deviation of the combination from the data, as the image motion of the unknown that moves the image
        most, in metres.
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
    """Rule that fixes combinations of unknowns that the ground points leave undetermined.

    Attributes
    ----------
    held : tuple of str
        Unknowns that are fixed at their start values, for example ("nadir x",).
    start : mapping of str to float, float or None
        Sigmas of the start values, which act as observations of these undetermined combinations only: by name in metres
        or radians, or one for all in metres of image motion. None: nothing fixes what the points leave open.
    """

    held: tuple[str, ...] = ()
    start: Mapping[str, float] | float | None = None

    def __str__(self) -> str:
        held = f"held at the start values: {', '.join(self.held)}" if self.held else ""
        accuracy = "with the specified sigmas"
        if isinstance(self.start, float):
            accuracy = f"with {self.start:g} m of image motion (1 sigma)"
        start = "" if self.start is None else f"open combinations are constrained to their start values, {accuracy}"
        return "; ".join(t for t in (held, start) if t) or "none"

    def sigmas(self, names: Sequence[str], scale: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return the sigmas of the P start values, in SI units, and a (P,) mask of those that were specified.

        Start values without a specified sigma have `WORST` metres of image motion.

        Raises
        ------
        CalibrationError
            A sigma is not positive.
        """
        if self.start is None:
            return WORST * scale, np.zeros(len(names), bool)
        if isinstance(self.start, Mapping):
            values = np.array([self.start.get(n, np.nan) for n in names])
        else:
            values = self.start * scale
        specified = ~np.isnan(values)
        if not np.all(np.isfinite(values[specified]) & (values[specified] > 0)):
            raise CalibrationError(f"calibration: sigmas of start values must be positive, found {self.start}")
        return np.where(specified, values, WORST * scale), specified


class RankError(CalibrationError):
    """Error raised if ground points leave combinations of unknowns undetermined and no gauge fixes them.

    Attributes
    ----------
    open : tuple of Combination
        The undetermined combinations, which the message lists, too.
    """

    def __init__(self, message: str, open_combinations: Sequence[Combination]) -> None:
        super().__init__(message)
        self.open = tuple(open_combinations)


@dataclass(frozen=True, eq=False)
class Freedom:
    """Estimable part of the unknowns under a gauge.

    Attributes
    ----------
    kept : (R,) ndarray of int
        Indices of the R unknowns that are estimated, of P in all.
    rows : (k, P) ndarray
        Coefficients of k pseudo-observations that tie combinations to the start values: rows @ (unknowns - start) is
        zero with unit standard deviation.
    opened : tuple of Combination
        Combinations that the ground points leave undetermined, before the gauge is applied.
    """

    kept: NDArray[np.intp]
    rows: Array
    opened: tuple[Combination, ...]


def null_vectors(reduced: Array, sigma: Array) -> Array:
    """Return an orthonormal basis of the combinations that the data leave undetermined, in units of `sigma`.

    The basis has shape (P, k), for P unknowns and k undetermined combinations.

    Parameters
    ----------
    reduced : (P, P) ndarray
        Normal matrix after elimination of the ground points, weighted with the a-priori sigmas of the measurements.
    sigma : (P,) ndarray
        Sigmas of the start values.
    """
    values, vectors = eigh(sigma[:, None] * reduced * sigma)
    # an eigenvalue below the rounding of the largest one is no information
    rounding = len(values) * np.finfo(np.float64).eps * max(float(values[-1]), 0.0)
    return np.asarray(vectors[:, values < max(1.0, rounding)])


def weak_vectors(reduced: Array, length: Array, scale: Array, basis: Array) -> Array:
    """Return the combinations of unknowns within `basis` whose strength is below `WEAK`, in units of `scale`.

    The result is (P, k) for k combinations of P unknowns.

    The strength is the ratio of a combination's standard deviation with everything else known to that in the
    adjustment.

    Parameters
    ----------
    reduced : (P, P) ndarray
        Normal matrix after elimination of the ground points.
    length : (P,) ndarray
        Lengths of the columns of the design before the ground points were eliminated.
    scale : (P,) ndarray
        Units of the unknowns, SI.
    basis : (P, r) ndarray
        Basis of the r estimable combinations, in units of `scale`.
    """
    unit = scale * np.where(length > 0, length, 1.0)
    squares = basis.T @ (unit[:, None] ** 2 * basis)
    values, vectors = eigh(basis.T @ (scale[:, None] * reduced * scale) @ basis, squares)
    return np.asarray(basis @ vectors[:, values < WEAK**2])


def combinations(
    names: Sequence[str], scale: Array, vectors: Array, reduced: Array, length: Array
) -> tuple[Combination, ...]:
    """Return k linear combinations of named unknowns, as sparse as possible, that span a given space.

    A combination lists the unknowns that take part with at least a hundredth of the largest motion. Each combination
    has an unknown that is in no other one.

    Parameters
    ----------
    names : sequence of str
        Names of the P unknowns.
    scale : (P,) ndarray
        Units of the unknowns, SI.
    vectors : (P, k) ndarray
        Basis of the space, in units of `scale`.
    reduced : (P, P) ndarray
        Normal matrix after elimination of the ground points.
    length : (P,) ndarray
        Lengths of the columns before the ground points were eliminated.
    """
    result = []
    for vector in echelon(vectors).T:
        change = scale * vector / np.abs(vector).max()
        form = float(np.sqrt(max(float(change @ reduced @ change), 0.0)))
        members = np.flatnonzero(np.abs(vector) >= _SHOWN * np.abs(vector).max())
        result.append(
            Combination(
                tuple(names[i] for i in members.tolist()),
                1e-3 * change[members],
                form / max(float(np.linalg.norm(change * length)), 1e-300),
                1.0 / max(form, 1e-300),
            )
        )
    return tuple(result)


def free_basis(
    reduced: Array,
    length: Array,
    scale: Array,
    names: Sequence[str],
    gauge: Gauge | None,
    ray: float = np.inf,
    prior_sigmas: Mapping[str, float] | None = None,
) -> Freedom:
    """Return the estimable part of the unknowns under a gauge.

    Parameters
    ----------
    reduced : (P, P) ndarray
        Normal matrix after elimination of the ground points, with the a-priori sigmas of the measurements.
    length : (P,) ndarray
        Lengths of the columns before the ground points were eliminated.
    scale : (P,) ndarray
        Units of the unknowns, SI.
    names : sequence of str
        Names of the P unknowns.
    gauge : Gauge or None
        Rule that fixes open combinations; None for no rule.
    ray : float
        Standard deviation of a single image point, in metres, to which `LOST` refers.
    prior_sigmas : mapping of str to float, optional
        Sigmas of the priors of unknowns whose start values have no specified sigma.

    Raises
    ------
    RankError
        The gauge leaves combinations open, a combination may move the image by `LOST` times the noise of a single image
        point, or the points determine nothing at all.
    CalibrationError
        A fixed unknown does not exist, or the sigma of a start value is not positive.
    """
    gauge = gauge or Gauge()
    sigma, specified = gauge.sigmas(names, scale)
    if np.any(specified):
        # scaled so that their priors, which are in `reduced`, close them
        prior_sigma = np.array([_CLOSED * (prior_sigmas or {}).get(n, np.nan) for n in names])
        sigma = np.where(specified | np.isnan(prior_sigma), sigma, prior_sigma)
    opened = combinations(names, scale, _in_scale(null_vectors(reduced, sigma), sigma, scale), reduced, length)
    estimated = np.setdiff1d(np.arange(len(names)), [index(names, n) for n in gauge.held])
    within, estimated_sigma = reduced[np.ix_(estimated, estimated)], sigma[estimated]
    inside = null_vectors(within, estimated_sigma)
    # a start value of unknown accuracy is no observation
    rows = np.where(specified[estimated], inside.T / estimated_sigma, 0.0)
    # combinations that start values close then have an eigenvalue of 1 or more
    checks = [(within + rows.T @ rows, np.where(specified[estimated], np.sqrt(2.0), 1.0) * estimated_sigma)]
    if np.any(specified) and np.isfinite(ray):
        checks.append((within, LOST * ray * scale[estimated]))
    for matrix, units in checks:
        vectors = null_vectors(matrix, units)
        if vectors.shape[1]:
            if matrix is within:
                vectors, units = inside, estimated_sigma  # list all open combinations, of which some are lost
            scaled_vectors = _in_scale(vectors, units, scale[estimated])
            unresolved = combinations(
                [names[i] for i in estimated.tolist()], scale[estimated], scaled_vectors, within, length[estimated]
            )
            text = "; ".join(str(c) for c in unresolved)
            raise RankError(
                f"calibration: the points do not determine: {text}. Gauge: {gauge}. Hold or weight some of these",
                unresolved,
            )
    if inside.shape[1] == len(estimated):
        raise RankError("calibration: the points determine none of the unknowns", opened)
    padded = np.zeros((len(rows), len(names)))
    padded[:, estimated] = rows
    return Freedom(estimated, padded, opened)


def _in_scale(vectors: Array, sigma: Array, scale: Array) -> Array:
    """Convert k combinations of P unknowns, (P, k), from units of `sigma` (P,) to units of `scale` (P,)."""
    return np.asarray(vectors * (sigma / scale)[:, None])


def solved(normal: Array, right: Array) -> Array:
    """Solve the positive definite linear system `normal` x = `right`, scaled to unit diagonal for accuracy."""
    size = 1.0 / np.sqrt(np.diag(normal))
    factor = cho_factor(size[:, None] * normal * size)
    wide = right.reshape(len(size), -1)
    return np.asarray(size[:, None] * cho_solve(factor, size[:, None] * wide)).reshape(right.shape)


def echelon(vectors: Array) -> Array:
    """Return a basis, in reduced echelon form, of the space that k vectors of P unknowns span, largest entries 1.

    Input and result have shape (P, k). Each vector of the basis has a pivot unknown whose entry is zero in all others.
    The pivots are the unknowns with the largest part in the space, which does not depend on the vectors that span it.
    """
    if not vectors.shape[1]:
        return vectors
    basis = np.linalg.qr(vectors)[0]
    pivots = qr(basis.T, mode="r", pivoting=True)[1][: basis.shape[1]]
    reduced = np.linalg.solve(basis[pivots].T, basis.T).T
    largest = np.abs(reduced).argmax(axis=0)
    return np.asarray(reduced / reduced[largest, np.arange(reduced.shape[1])])


def shown(name: str, change: float) -> str:
    """Return a change of an unknown, given in metres, radians or pixels, as text with its unit."""
    if " shift of " in name:
        return f"{name} {change:+.4g} px"
    if "offset" in name or "height" in name:
        return f"{name} {change:+.4g} m"
    if name.split()[-1] in _ANGLES:
        per = "/s" if name.endswith("rate") else ""
        return f"{name} {change / ARCSEC:+.4g} arcsec{per}"
    return f"{name} {change * 1e3:+.4g} mm"
