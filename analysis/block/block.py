"""Input of a block adjustment: scenes, passes, cameras, points and further observations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array, Indices
from analysis.block.error_processes import BlockError, Law
from analysis.orbit.three_line_model import LineModel, Rays

Scope = Literal["pass", "tracker", "block"]
SENSORS = ("ties", "control", "monitor", "laser", "terrain", "tracker_angles")
"""Names of the kinds of observations that can be excluded from a block."""


@dataclass(frozen=True)
class Term:
    """Error model of the readings and its scope: which observations share one realisation of the error.

    The scope is a pass, all passes of one star tracker, or the whole block.
    """

    law: Law
    scope: Scope = "pass"


@dataclass(frozen=True)
class Pass:
    """Pass of the satellite over the block, during which attitude and orbit errors are correlated.

    Attributes
    ----------
    name : str
        Name of the pass.
    tracker : str
        Star tracker that measured the attitude.
    middle : float or None
        Time at which the pass's rates and random walks are zero, in seconds; None for the middle of its observations.
    """

    name: str
    tracker: str = "tracker"
    middle: float | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """Image of one line camera in one pass.

    Attributes
    ----------
    name : str
        Name of the scene.
    of : str
        Name of the pass.
    camera : str
        Name of the camera.
    rays : Rays
        Image points with times; `point` is an index into the block's points.
    """

    name: str
    of: str
    camera: str
    rays: Rays

    def taken(self, keep: NDArray[np.bool_]) -> Scene:
        """Return the scene with the image points that a boolean mask selects."""
        return replace(self, rays=self.rays.taken(keep))


class GroundToImage(Protocol):
    """Interface of an image whose positions are a function of the ground, such as rational polynomials."""

    @property
    def middle(self) -> Array:
        """Line and sample (2,) at which corrections that grow with the position are zero, in pixels."""

    @property
    def size(self) -> Array:
        """Distances (2,) from the middle, in lines and samples, at which these corrections have their full value."""

    def seen(self, ground: Array) -> tuple[Array, Array]:
        """Return line and sample (n, 2) of n ground points (n, 3), and the derivatives (n, 2, 3).

        Ground points are in the ITRS, in metres; line and sample are in pixels.
        """


CORRECTIONS = ("shift", "drift", "affine")
"""Terms of the correction of line and sample of an image: constant, growing with the line, growing with the sample."""


@dataclass(frozen=True, eq=False)
class ImagePlaces:
    """Image points of an image that is a function of the ground, n of them.

    Attributes
    ----------
    point : (n,) ndarray of int
        Index of the ground point that each image point shows.
    image : (n, 2) ndarray
        Line and sample, in pixels.
    spread : (n, 2, 2) ndarray
        Covariance of line and sample, in pixels^2.
    """

    point: Indices
    image: Array
    spread: Array

    def taken(self, which: NDArray[np.bool_] | Indices) -> ImagePlaces:
        """Return the image points that a boolean mask or an array of indices selects."""
        return ImagePlaces(self.point[which], self.image[which], self.spread[which])


@dataclass(frozen=True, eq=False)
class ModelScene:
    """Image that is a function of the ground, with an unknown correction of line and sample.

    The corrected position of a ground point is p + c(p), with p the position by the model. For each of line and sample,
    c is a constant (`shift`), plus a term in proportion to line - middle (`drift`), plus a term in proportion to
    sample - middle (`affine`); the coefficients are the values at the distance `size` from the middle.

    Attributes
    ----------
    name : str
        Name of the scene.
    model : GroundToImage
        Position in the image as a function of the ground.
    sigma : mapping of str to (float, float)
        Term of the correction, from `CORRECTIONS` -> prior standard deviations of its coefficients for line and sample,
        in pixels.
    rays : ImagePlaces
        Image points; `point` is an index into the block's points.
    """

    name: str
    model: GroundToImage
    sigma: Mapping[str, tuple[float, float]]
    rays: ImagePlaces

    def taken(self, keep: NDArray[np.bool_]) -> ModelScene:
        """Return the scene with the image points that a boolean mask selects."""
        return replace(self, rays=self.rays.taken(keep))

    def basis(self, position: Array) -> Array:
        """Return the K terms of the correction, in the order of `sigma`, at n model positions (n, 2), as (n, K)."""
        scaled = (position - self.model.middle) / self.model.size
        columns = {"shift": np.ones(len(position)), "drift": scaled[:, 0], "affine": scaled[:, 1]}
        return np.stack([columns[term] for term in self.sigma], axis=1)

    def jacobian(self, coefficients: Array) -> Array:
        """Return the derivatives (2, 2) of the correction (2,) of line and sample with respect to line and sample.

        Parameters
        ----------
        coefficients : (2, K) ndarray
            Coefficients of the K terms for line and sample, in pixels.
        """
        directions = {"shift": (0.0, 0.0), "drift": (1.0, 0.0), "affine": (0.0, 1.0)}
        return np.asarray(coefficients @ np.array([directions[term] for term in self.sigma]) / self.model.size)


@dataclass(frozen=True, eq=False)
class SharedCorrection:
    """Error that images of one pass have in common, beside each one's own correction.

    Attributes
    ----------
    scenes : tuple of str
        Names of the images, which are functions of the ground.
    sigma : mapping of str to (float, float)
        Term of the correction -> standard deviations of the common coefficients for line and sample, in pixels.
    """

    scenes: tuple[str, ...]
    sigma: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class CameraPrior:
    """Prior distribution of the changes of one camera in the T passes of a block.

    The changes are d_alpha, d_beta, d_gamma (rotations about the camera's Y, X and Z axes, in radians) and d_f (change
    of the principal distance, in metres).

    Attributes
    ----------
    mean : (T, 4) ndarray
        Expected changes d_alpha, d_beta, d_gamma, d_f, in the order of the block's passes.
    covariance : (4 T, 4 T) ndarray
        Covariance of the changes, pass by pass.
    """

    mean: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class JointCameraPrior:
    """Joint prior of the changes of C cameras in T passes, correlated by motions of a common structure.

    Attributes
    ----------
    cameras : tuple of str
        Names of the cameras.
    mean : (C, T, 4) ndarray
        Expected changes d_alpha, d_beta, d_gamma (rotations about the camera's Y, X and Z axes, in radians) and d_f
        (principal distance, in metres).
    covariance : (4 T C, 4 T C) ndarray
        Covariance of the changes, camera by camera and within each pass by pass.
    """

    cameras: tuple[str, ...]
    mean: Array
    covariance: Array

    def of(self, camera: str) -> CameraPrior:
        """Return the marginal prior of one camera's changes in all passes."""
        k, size = self.cameras.index(camera), 4 * self.mean.shape[1]
        rows = slice(k * size, (k + 1) * size)
        return CameraPrior(self.mean[k], self.covariance[rows, rows])


@dataclass(frozen=True, eq=False)
class Points:
    """Ground points of a block: control, tie and check points.

    Attributes
    ----------
    ids : (m,) ndarray of str
        Names of the m points.
    start : (m, 3) ndarray
        Surveyed coordinates of control points, approximate ones of the others, ITRS, in metres.
    role : (m,) ndarray of str
        "control", "tie" or "check". Check points are adjusted as tie points and compared afterwards.
    covariance : (m, 3, 3) ndarray
        Covariance of control points, in m^2.
    approximate : (m, 3) ndarray, optional
        Coordinates at which the adjustment starts, ITRS, in metres; `start` by default.
    """

    ids: NDArray[np.object_]
    start: Array
    role: NDArray[np.object_]
    covariance: Array
    approximate: Array | None = None

    @property
    def first(self) -> Array:
        """Coordinates (m, 3) at which the adjustment starts, ITRS, in metres."""
        return self.start if self.approximate is None else self.approximate


@dataclass(frozen=True, eq=False)
class Footprints:
    """Laser altimeter footprints, n of them, of one pass.

    Attributes
    ----------
    of : str
        Name of the pass.
    point : (n,) ndarray of int
        Indices, among the block's points, of the points that the beam hits.
    time : (n,) ndarray
        Times, in seconds.
    station : (n, 3) ndarray
        Measured positions, ITRS, in metres.
    attitude : (n, 3, 3) ndarray
        Measured rotations from the body to ITRS.
    aim : (n, 3) ndarray
        Unit vectors of the beam in the body frame.
    distance : (n,) ndarray
        Measured ranges, in metres.
    sigma : tuple of float
        Sigma of the range, in metres, and of the pointing including the beam's width about each of two axes, in
        radians.
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
        """Return the footprints that a boolean mask, with one element for each footprint, selects."""
        rows = (self.time, self.station, self.attitude, self.aim, self.distance)
        time, station, attitude, aim, distance = (row[keep] for row in rows)
        return Footprints(self.of, self.point[keep], time, station, attitude, aim, distance, self.sigma)


@dataclass(frozen=True, eq=False)
class Terrain:
    """Terrain model that serves as weak height control of n points.

    Attributes
    ----------
    point : (n,) ndarray of int
        Indices, among the block's points, of the points on the terrain model.
    place : (n, 3) ndarray
        Positions on the model's surface, ITRS, in metres.
    normal : (n, 3) ndarray
        Unit normals of the surface at these positions.
    sigma : (n,) ndarray
        Sigma of the independent height errors, in metres.
    common : float
        Sigma of a height error that all points share, in metres.
    """

    point: Indices
    place: Array
    normal: Array
    sigma: Array
    common: float

    def taken(self, keep: NDArray[np.bool_]) -> Terrain:
        """Return the terrain model at the points that a boolean mask, with one element for each point, selects."""
        return Terrain(self.point[keep], self.place[keep], self.normal[keep], self.sigma[keep], self.common)


@dataclass(frozen=True)
class TrackerAngle:
    """Measured difference of two star trackers' constant errors about the body's axes, with sigmas.

    Attributes
    ----------
    between : tuple of str
        Names of the two star trackers.
    value : (3,) tuple of float
        First minus second, about the body's axes, in radians.
    sigma : (3,) tuple of float
        Standard deviations, in radians.
    """

    between: tuple[str, str]
    value: tuple[float, float, float]
    sigma: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Block:
    """Block of line-camera images with all measurements, priors and error models that are adjusted together.

    Attributes
    ----------
    passes : tuple of Pass
        Passes, in the order of the cameras' priors.
    scenes : tuple of Scene or ModelScene
        Images of line cameras in these passes, and images that are functions of the ground.
    cameras : mapping of str to LineModel
        Calibrated cameras without changes, by name.
    known : mapping of str to CameraPrior
        Prior of each camera's changes without a monitor.
    monitored : mapping of str to CameraPrior, JointCameraPrior or None
        Distribution of each camera's changes, or of all together, given the monitor's readings; None for no monitor.
    attitude : tuple of Term
        Error models of the attitude readings.
    station : tuple of Term
        Error models of the station readings, along the axes of the pass.
    image : float
        Sigma of an image coordinate, in metres; the rays' covariances (`Rays.spread`) are in units of its square.
    points : Points
        Ground points.
    footprints : tuple of Footprints
        Footprints of a laser altimeter.
    terrain : Terrain or None
        Terrain model that gives heights of points; None without one.
    angles : tuple of TrackerAngle
        Measured angles between star trackers.
    shared : tuple of SharedCorrection
        Errors that images which are functions of the ground have in common; an image has at most one.
    """

    passes: tuple[Pass, ...]
    scenes: tuple[Scene | ModelScene, ...]
    cameras: Mapping[str, LineModel]
    known: Mapping[str, CameraPrior]
    attitude: tuple[Term, ...]
    station: tuple[Term, ...]
    image: float
    points: Points
    monitored: Mapping[str, CameraPrior] | JointCameraPrior | None = None
    footprints: tuple[Footprints, ...] = ()
    terrain: Terrain | None = None
    angles: tuple[TrackerAngle, ...] = field(default=())
    shared: tuple[SharedCorrection, ...] = ()

    @property
    def line_scenes(self) -> tuple[Scene, ...]:
        """Images of line cameras."""
        return tuple(scene for scene in self.scenes if isinstance(scene, Scene))

    @property
    def model_scenes(self) -> tuple[ModelScene, ...]:
        """Images that are functions of the ground."""
        return tuple(scene for scene in self.scenes if isinstance(scene, ModelScene))

    def correction_sigma(self, scene: ModelScene) -> Array:
        """Return the prior standard deviations (2, K) of an image's correction, with the errors that it shares."""
        sigma = np.array(list(scene.sigma.values())).T
        shared = [errors.sigma for errors in self.shared if scene.name in errors.scenes]
        common = np.array([shared[0].get(term, (0.0, 0.0)) for term in scene.sigma]).T if shared else 0.0
        return np.hypot(sigma, common)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of those kinds of observations, out of `SENSORS`, that the block contains."""
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
        """Return the block without one of its sensors.

        Without control, control points become tie points, and their image observations stay.

        Raises
        ------
        BlockError
            There is no such sensor.
        """
        if sensor not in SENSORS:
            raise BlockError(f"block: no sensor is called {sensor!r}; there are {', '.join(SENSORS)}")
        points = self.points
        if sensor == "control":
            role = np.where(points.role == "control", "tie", points.role).astype(object)
            return replace(self, points=replace(points, role=role))
        if sensor == "ties":
            mask = points.role != "tie"
            for footprints in self.footprints:  # footprints stay in the images as laser observations
                mask[footprints.point] = True
            scenes = tuple(s.taken(mask[s.rays.point]) for s in self.scenes)
            terrain = self.terrain
            if terrain is not None:
                use = mask[terrain.point]
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
        """Raise BlockError for mismatched names, image points without times and invalid numbers."""
        names = [prior.name for prior in self.passes]
        if len(set(names)) != len(names) or len({s.name for s in self.scenes}) != len(self.scenes):
            raise BlockError("block: two passes or two scenes have the same name")
        for image in self.model_scenes:
            if not image.sigma or not all(sigma > 0.0 for pair in image.sigma.values() for sigma in pair):
                raise BlockError(f"block: scene {image.name!r}: its correction needs sigmas above zero")
        terms = {image.name: set(image.sigma) for image in self.model_scenes}
        members = [name for shared in self.shared for name in shared.scenes]
        if len(set(members)) != len(members) or not all(
            set(shared.sigma) <= terms.get(name, set()) for shared in self.shared for name in shared.scenes
        ):
            raise BlockError("block: images share errors of terms that they have, each with one pass")
        for scene in self.line_scenes:
            if scene.of not in names:
                raise BlockError(f"block: scene {scene.name!r}: no pass is called {scene.of!r}")
            if scene.camera not in self.cameras or scene.camera not in self.known:
                raise BlockError(f"block: scene {scene.name!r}: camera {scene.camera!r} has no model or no prior")
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
            monitored = self.monitored or {}
            if isinstance(monitored, JointCameraPrior):
                if name not in monitored.cameras:
                    raise BlockError(f"block: the monitor has no reading of camera {name!r}")
                monitored = {name: monitored.of(name)}
            for priors in (self.known, monitored):
                prior = priors.get(name)
                if prior is not None and prior.covariance.shape != (4 * len(names), 4 * len(names)):
                    shape = prior.covariance.shape
                    raise BlockError(f"block: camera {name!r}: covariance {shape} does not match {len(names)} passes")


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

    Other error models, laser footprints, terrain models and monitors are added by setting the attributes of `Block`.

    Parameters
    ----------
    images : mapping of (pass, camera) to Rays
        Image points of each image, with times; `Rays.point` counts the rows of `points`.
    cameras : mapping of str to LineModel
        Calibrated cameras.
    points : (m, 3) array_like
        Given coordinates of control points and first guesses of tie points, m in all, ITRS, in metres.
    control_sigma : (m,) array_like, optional
        Standard deviation of each given coordinate, in metres; inf for tie points. By default all are tie points.
    image_sigma : float
        Standard deviation of each image coordinate, in metres.
    attitude_sigma : float
        Standard deviation of the attitude about each axis, in radians; one error for each pass.
    station_sigma : float
        Standard deviation of each coordinate of the station, in metres; one error for each pass.
    camera_sigma : (4,) array_like
        Standard deviations of the changes of each camera, which are the same in all passes: rotations d_alpha, d_beta,
        d_gamma about its Y, X and Z axes (radians) and change d_f of its principal distance (metres).

    Returns
    -------
    Block
        The block, for `adjust_block`.

    Raises
    ------
    ValueError
        Arrays of other shapes, or sigmas that are not positive.

    Examples
    --------
    One ray of one camera; see `adjust_block` for a block that can be solved:

    >>> import numpy as np
    >>> import analysis
    >>> camera = analysis.LineModel.of(np.eye(3), [1.7, 0.0, 0.0])
    >>> down = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    >>> rays = analysis.Rays.of([0], [[0.0, 0.0]], [[6.878e6, 0.0, 0.0]], [down], time=[0.0])
    >>> block = analysis.make_block({("pass 1", "nadir"): rays}, {"nadir": camera}, [[6.378e6, 0.0, 0.0]],
    ...     control_sigma=[0.1], image_sigma=2e-6, attitude_sigma=1e-5, station_sigma=0.5,
    ...     camera_sigma=[5e-6, 5e-6, 5e-6, 2e-5])
    >>> block.sensors, block.points.role.tolist()
    (('control',), ['control'])
    """
    start, spread = np.array(points, np.float64), np.asarray(camera_sigma, np.float64)
    if start.ndim != 2 or start.shape[1] != 3 or spread.shape != (4,):
        raise BlockError(f"block: need points (m, 3) and camera_sigma (4,), found {start.shape} and {spread.shape}")
    sigma = np.full(len(start), np.inf) if control_sigma is None else np.asarray(control_sigma, np.float64)
    if sigma.shape != (len(start),) or not np.all(sigma > 0):
        raise BlockError(f"block: control_sigma must be {len(start)} positive sigmas, inf for tie points")
    role = np.where(np.isfinite(sigma), "control", "tie").astype(object)
    covariance = np.where(np.isfinite(sigma), sigma, 1.0)[:, None, None] ** 2 * np.eye(3)
    passes = tuple(dict.fromkeys(name for name, _ in images))
    same = np.asarray(np.kron(np.ones((len(passes),) * 2), np.diag(spread**2)), np.float64)
    known = CameraPrior(np.zeros((len(passes), 4)), same)
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
