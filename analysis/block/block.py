"""What a block adjustment is given: scenes, passes, cameras, points and what else observes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array, Indices
from analysis.block.error_processes import BlockError, Law
from analysis.orbit.three_line_model import LineModel, Rays

Scope = Literal["pass", "tracker", "block"]
SENSORS = ("ties", "control", "monitor", "laser", "terrain", "tracker_angles")
"""What can be left out of a block by name."""


@dataclass(frozen=True)
class Term:
    """A law of errors, and what shares one draw of it: a pass, all passes of one star tracker, or the block."""

    law: Law
    scope: Scope = "pass"


@dataclass(frozen=True)
class Pass:
    """A pass of the satellite.

    Attributes
    ----------
    name : str
        Of the pass.
    tracker : str
        Star tracker that gave its attitude.
    middle : float | None
        When rates and walks of its own are zero, seconds; None for the middle of its observations.
    """

    name: str
    tracker: str = "tracker"
    middle: float | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """The image of one line camera in one pass.

    Attributes
    ----------
    name : str
        Of the scene.
    of : str
        Name of its pass.
    camera : str
        Of the block's cameras.
    rays : Rays
        Image points with times; `point` counts the block's points.
    """

    name: str
    of: str
    camera: str
    rays: Rays


@dataclass(frozen=True, eq=False)
class CameraKnowledge:
    """What is known of a camera's d_alpha, d_beta, d_gamma (radians) and d_f (metres) in all passes of the block.

    Attributes
    ----------
    mean : Array
        (T, 4), in the order of the block's passes.
    covariance : Array
        (4 T, 4 T), pass by pass.
    """

    mean: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class CamerasKnowledge:
    """The same of all cameras together, of which one body may have moved several.

    Attributes
    ----------
    cameras : tuple[str, ...]
        C names.
    mean : Array
        (C, T, 4).
    covariance : Array
        (4 T C, 4 T C), camera by camera and in each pass by pass.
    """

    cameras: tuple[str, ...]
    mean: Array
    covariance: Array

    def of(self, camera: str) -> CameraKnowledge:
        """One camera by itself."""
        k, size = self.cameras.index(camera), 4 * self.mean.shape[1]
        own = slice(k * size, (k + 1) * size)
        return CameraKnowledge(self.mean[k], self.covariance[own, own])


@dataclass(frozen=True, eq=False)
class Points:
    """Ground points.

    Attributes
    ----------
    ids : NDArray[np.object_]
        (m,) names.
    start : Array
        (m, 3) given coordinates of control points, first guesses of the others, ITRS, metres.
    role : NDArray[np.object_]
        (m,) "control", "tie" or "check". Check points are tie points that are compared afterwards.
    covariance : Array
        (m, 3, 3) of control points, m^2.
    """

    ids: NDArray[np.object_]
    start: Array
    role: NDArray[np.object_]
    covariance: Array


@dataclass(frozen=True, eq=False)
class Footprints:
    """Laser footprints of one pass.

    Attributes
    ----------
    of : str
        Name of the pass.
    point : Indices
        (n,) of the block's points that they hit.
    time : Array
        (n,) seconds. station: (n, 3) readings, ITRS, metres. attitude: (n, 3, 3) body to ITRS.
    aim : Array
        (n, 3) unit vectors of the beam in the body frame.
    distance : Array
        (n,) metres.
    sigma : tuple[float, float]
        Of the range, metres, and of the pointing with the beam's width about each of two axes, radians.
    """

    of: str
    point: Indices
    time: Array
    station: Array
    attitude: Array
    aim: Array
    distance: Array
    sigma: tuple[float, float]

    def taken(self, keep: NDArray[np.bool_]) -> Footprints:
        """Some of them, by mask (n,)."""
        rows = (self.time, self.station, self.attitude, self.aim, self.distance)
        time, station, attitude, aim, distance = (row[keep] for row in rows)
        return Footprints(self.of, self.point[keep], time, station, attitude, aim, distance, self.sigma)


@dataclass(frozen=True, eq=False)
class Terrain:
    """A terrain model as weak control of heights.

    Attributes
    ----------
    point : Indices
        (n,) of the block's points.
    place : Array
        (n, 3) on the model's surface, ITRS, metres.
    normal : Array
        (n, 3) unit normals of the surface there.
    sigma : Array
        (n,) of a height, independent, metres.
    common : float
        Standard deviation of an error that all heights have in common, metres.
    """

    point: Indices
    place: Array
    normal: Array
    sigma: Array
    common: float

    def taken(self, keep: NDArray[np.bool_]) -> Terrain:
        """The model at some of the points, by mask (n,)."""
        return Terrain(self.point[keep], self.place[keep], self.normal[keep], self.sigma[keep], self.common)


@dataclass(frozen=True)
class TrackerAngle:
    """Measured difference of two star trackers' constant errors about the body's axes, (3,) radians, with sigmas."""

    between: tuple[str, str]
    value: tuple[float, float, float]
    sigma: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Block:
    """A block of scenes.

    Attributes
    ----------
    passes : tuple[Pass, ...]
        In order of the cameras' knowledge.
    scenes : tuple[Scene, ...]
        Of these passes.
    cameras : Mapping[str, LineModel]
        Name -> camera as calibrated, without a change.
    known : Mapping[str, CameraKnowledge]
        Name -> what is expected of its changes, without a monitor.
    monitored : Mapping[str, CameraKnowledge] | CamerasKnowledge | None
        Name -> the same after the monitor's readings, or of all cameras together; None for no monitor.
    attitude : tuple[Term, ...]
        Laws of its readings' errors. station: likewise along the axes of the pass.
    image : float
        Unit of the rays' spread, metres.
    points : Points
        On the ground.
    footprints : tuple[Footprints, ...]
        Of a laser altimeter.
    terrain : Terrain | None
        Heights; None for none.
    angles : tuple[TrackerAngle, ...]
        Between star trackers.
    """

    passes: tuple[Pass, ...]
    scenes: tuple[Scene, ...]
    cameras: Mapping[str, LineModel]
    known: Mapping[str, CameraKnowledge]
    attitude: tuple[Term, ...]
    station: tuple[Term, ...]
    image: float
    points: Points
    monitored: Mapping[str, CameraKnowledge] | CamerasKnowledge | None = None
    footprints: tuple[Footprints, ...] = ()
    terrain: Terrain | None = None
    angles: tuple[TrackerAngle, ...] = field(default=())

    @property
    def sensors(self) -> tuple[str, ...]:
        """Those of `SENSORS` that the block has."""
        has = {
            "ties": bool(np.any(self.points.role == "tie")),
            "control": bool(np.any(self.points.role == "control")),
            "monitor": self.monitored is not None,
            "laser": bool(self.footprints),
            "terrain": self.terrain is not None,
            "tracker_angles": bool(self.angles),
        }
        return tuple(name for name in SENSORS if has[name])

    def without(self, sensor: str) -> Block:
        """The block without one of its sensors. Control points become check points, whose images stay.

        Raises
        ------
        BlockError
            No such sensor.
        """
        if sensor not in SENSORS:
            raise BlockError(f"block: no sensor is called {sensor!r}; there are {', '.join(SENSORS)}")
        points = self.points
        if sensor == "control":
            role = np.where(points.role == "control", "tie", points.role).astype(object)
            return replace(self, points=replace(points, role=role))
        if sensor == "ties":
            kept = points.role != "tie"
            for one in self.footprints:  # the images see them as part of the laser
                kept[one.point] = True
            scenes = tuple(replace(s, rays=s.rays.taken(kept[s.rays.point])) for s in self.scenes)
            terrain = self.terrain
            if terrain is not None:
                use = kept[terrain.point]
                terrain = terrain.taken(use) if np.any(use) else None
            return replace(self, scenes=scenes, terrain=terrain)
        if sensor == "monitor":
            return replace(self, monitored=None)
        if sensor == "laser":
            return replace(self, footprints=())
        if sensor == "terrain":
            return replace(self, terrain=None)
        return replace(self, angles=())

    def check(self) -> None:
        """Raises BlockError for what cannot be used: names that do not match, scenes without points, bad numbers."""
        names = [one.name for one in self.passes]
        if len(set(names)) != len(names) or len({s.name for s in self.scenes}) != len(self.scenes):
            raise BlockError("block: two passes or two scenes have one name")
        for scene in self.scenes:
            if scene.of not in names:
                raise BlockError(f"block: scene {scene.name!r}: no pass is called {scene.of!r}")
            if scene.camera not in self.cameras or scene.camera not in self.known:
                raise BlockError(f"block: scene {scene.name!r}: nothing is known of camera {scene.camera!r}")
            if scene.rays.time is None:
                raise BlockError(f"block: scene {scene.name!r}: its image points have no times")
        if not (np.isfinite(self.image) and self.image > 0):
            raise BlockError(f"block: the sigma of image points must be positive, found {self.image}")
        points = self.points
        if not np.all(np.isfinite(points.start)):
            first = points.ids[np.flatnonzero(~np.isfinite(points.start).all(axis=1))[0]]
            raise BlockError(f"block: point {first!r}: a coordinate is not finite")
        control = points.role == "control"
        if np.any(control) and not np.all(np.linalg.eigvalsh(points.covariance[control]) > 0):
            raise BlockError("block: covariances of control points must be positive definite")
        for name in self.cameras:
            watched = self.monitored or {}
            if isinstance(watched, CamerasKnowledge):
                if name not in watched.cameras:
                    raise BlockError(f"block: the monitor says nothing of camera {name!r}")
                watched = {name: watched.of(name)}
            for known in (self.known, watched):
                one = known.get(name)
                if one is not None and one.covariance.shape != (4 * len(names), 4 * len(names)):
                    shape = one.covariance.shape
                    raise BlockError(f"block: camera {name!r}: covariance {shape} of {len(names)} passes")


def make_block(
    images: Mapping[tuple[str, str], Rays],
    cameras: Mapping[str, LineModel],
    points: ArrayLike,
    *,
    control_sigma: ArrayLike | None = None,
    image_sigma: float,
    attitude_sigma: float,
    station_sigma: float,
    camera_sigma: ArrayLike,
) -> Block:
    """Return a block of line-camera images whose attitude and station errors are constant in each pass.

    Other laws of errors, laser footprints, terrain models and monitors are fields of `Block`.

    Parameters
    ----------
    images : mapping of (pass, camera) to Rays
        Image points of each image, with times; `Rays.point` counts the rows of `points`.
    cameras : mapping of str to LineModel
        Calibrated cameras.
    points : (m, 3) array_like
        Given coordinates of control points and first guesses of tie points, ITRS, in metres.
    control_sigma : (m,) array_like, optional
        Standard deviation of each given coordinate, in metres; inf for tie points. By default all are tie points.
    image_sigma : float
        Standard deviation of each image coordinate, in metres.
    attitude_sigma : float
        Standard deviation of the attitude about each axis, in radians; one error for each pass.
    station_sigma : float
        Standard deviation of each coordinate of the station, in metres; one error for each pass.
    camera_sigma : (4,) array_like
        Standard deviations of each camera's d_alpha, d_beta, d_gamma (radians) and d_f (metres), the same change in all
        passes.

    Returns
    -------
    Block
        The block, for `adjust_block`.

    Raises
    ------
    ValueError
        Arrays of other shapes, or sigmas that are not positive.
    """
    start, spread = np.array(points, np.float64), np.asarray(camera_sigma, np.float64)
    if start.ndim != 2 or start.shape[1] != 3 or spread.shape != (4,):
        raise BlockError(f"block: need points (m, 3) and camera_sigma (4,), found {start.shape} and {spread.shape}")
    given = np.full(len(start), np.inf) if control_sigma is None else np.asarray(control_sigma, np.float64)
    if given.shape != (len(start),) or not np.all(given > 0):
        raise BlockError(f"block: control_sigma must be {len(start)} positive sigmas, inf for tie points")
    role = np.where(np.isfinite(given), "control", "tie").astype(object)
    covariance = np.where(np.isfinite(given), given, 1.0)[:, None, None] ** 2 * np.eye(3)
    passes = tuple(dict.fromkeys(name for name, _ in images))
    same = np.asarray(np.kron(np.ones((len(passes),) * 2), np.diag(spread**2)), np.float64)
    known = CameraKnowledge(np.zeros((len(passes), 4)), same)
    ids = np.array([str(k) for k in range(len(start))], object)
    return Block(
        passes=tuple(Pass(name) for name in passes),
        scenes=tuple(Scene(f"{of} {camera}", of, camera, rays) for (of, camera), rays in images.items()),
        cameras=cameras,
        known=dict.fromkeys(cameras, known),
        attitude=(Term(Law("attitude", "constant", (attitude_sigma,) * 3)),),
        station=(Term(Law("station", "constant", (station_sigma,) * 3)),),
        image=image_sigma,
        points=Points(ids, start, role, covariance),
    )
