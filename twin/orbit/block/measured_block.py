"""Block of measured passes, read from the same tables as a calibration in orbit.

Functions here also build the priors of a block for the analysis: laws of errors, and changes of the cameras before and
after the monitor's readings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from analysis.block import block as model
from analysis.block.block import CameraPrior, JointCameraPrior, Term
from analysis.block.error_processes import Law
from analysis.orbit.calibration_parameters import CalibrationError, Noise
from analysis.orbit.forward_intersection import intersect
from analysis.orbit.three_line_model import LineModel, Rays
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.adjust import CameraChangeSpec, LawSpec
from scenes.specs.orbit.calibration import CameraDriftSpec, MonitorReadingSpec
from scenes.specs.orbit.setup import MeasuredAdjustSetup
from twin.framework.procedure import Advance, BenchError, silent
from twin.orbit.calibration.campaign import line_model, pass_data
from twin.orbit.flight.earth import Earth, tai_of
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.flight.sensor import NO_EFFECTS, LightEffects
from twin.orbit.measured.measurement_tables import read_measurements
from twin.orbit.measured.pass_measurements import PassMeasurements

MonitorSource = Callable[[Mapping[str, str], Sequence[str]], JointCameraPrior]
"""Function of the passes' epochs (UTC) and the lines that returns the joint prior of the lines' cameras from a record
of the monitor.
"""


def law_of(name: str, spec: LawSpec) -> Term:
    """Convert a noise model of the file's section of errors to a term of the analysis's noise model."""
    sigma: tuple[float, float, float] = spec.sigma  # type: ignore[attr-defined]
    return Term(Law(name, spec.law, sigma, spec.interval, spec.time or 0.0, spec.frequency or 0.0), spec.shared_by)


def camera_sigmas(spec: CameraDriftSpec | MonitorReadingSpec) -> np.ndarray:
    """Return the (4,) standard deviations of a camera's rotations (radians) and principal distance (metres).

    The order is d_alpha, d_beta and d_gamma, about the camera's Y, X and line of sight, and d_f.
    """
    return np.array([*spec.angles, spec.principal_distance])


def change_covariance(spec: CameraChangeSpec, days: np.ndarray) -> np.ndarray:
    """Return the (4 T, 4 T) prior covariance of a camera's four changes in T passes.

    Parameters
    ----------
    spec : CameraChangeSpec
        Standard deviations of the rotations d_alpha, d_beta, d_gamma (rad) and of the change d_f of the principal
        distance (m), and their correlation in time.
    days : (T,) ndarray
        Times of the passes after the first, in days.
    """
    lasting, each, walk = (np.diag(camera_sigmas(s) ** 2) for s in (spec.lasting, spec.each_pass, spec.walk))
    ones = np.ones((len(days), len(days)))
    earlier = np.minimum(days[:, None], days)
    return np.asarray(np.kron(ones, lasting) + np.kron(np.eye(len(days)), each) + np.kron(earlier, walk))


def monitored_camera(law: np.ndarray, reading: np.ndarray, sigma: np.ndarray) -> CameraPrior:
    """Return the prior of a camera's changes after the monitor's readings.

    Parameters
    ----------
    law : (4 T, 4 T) ndarray, for 4 changes in T passes
        Prior covariance before the readings.
    reading : (4 T,) ndarray
        Readings of the changes, in radians and metres.
    sigma : (4 T,) ndarray
        Standard deviations of the readings; infinite where there is none.
    """
    use = np.flatnonzero(np.isfinite(sigma))
    gain = law[:, use] @ np.linalg.inv(law[np.ix_(use, use)] + np.diag(sigma[use] ** 2))
    posterior = law - gain @ law[use]
    return CameraPrior((gain @ reading[use]).reshape(-1, 4), 0.5 * (posterior + posterior.T))


_DAY = 86400.0


def seconds_from_first(epochs: Mapping[str, str]) -> dict[str, float]:
    """Return the time of each epoch since the earliest, in seconds of TAI, rounded to a microsecond."""
    moments = {name: tai_of(epoch) for name, epoch in epochs.items()}
    zero = min(moments.values())
    return {
        name: float(round((day - zero[0]) * _DAY + (part - zero[1]) * _DAY, 6)) for name, (day, part) in moments.items()
    }


def measured_block(
    setup: MeasuredAdjustSetup, advance: Advance = silent, monitor: MonitorSource | None = None
) -> tuple[model.Block, np.ndarray]:
    """Return the block from the tables of all passes, and the given coordinates (m, 3) of its m points.

    The coordinates are in ITRS, in metres, and NaN for tie points.

    Raises
    ------
    InputError
        A table cannot be used.
    BenchError
        Points cannot be intersected, or the file does not give the prior changes of a line.
    """
    spec, payload = setup.test, setup.camera
    passes = read_measurements(setup.data, payload, advance, {})
    lines = tuple(dict.fromkeys(line for measured in passes for line in measured.images))
    for line in lines:
        if line not in spec.changes:
            raise BenchError(f"the prior changes of {line} are missing", ("changes",), f"`{line}:`")
    epochs = {measured.name: measured.platform.epoch for measured in passes}
    begin = seconds_from_first(epochs)
    points, number = _points(passes, spec.names == "shared")
    models = {line: line_model(payload, line) for line in lines}
    data = {}
    for measured in passes:
        known_ground = measured.ground.itrs[measured.ground.role != "tie"]
        mean = float(np.mean(Earth().geodetic(known_ground)[2])) if len(known_ground) else 0.0
        times = {line: measured.line_times[line] for line in measured.images}
        data[measured.name] = pass_data(
            measured.name, payload, TabulatedTrajectory(measured.platform), times, mean, 1.0
        )
    raw = {}
    for measured in passes:
        for line, rays in data[measured.name].rays(measured.images).items():
            raw[f"{measured.name}/{line}"] = rays
    coordinates = np.where((points.role == "tie")[:, None], np.nan, points.start)
    points = _first_coordinates(points, raw, models, number)
    earth = Earth()
    height = earth.geodetic(points.start)[2]
    removed = LightEffects.of(spec.effects) if spec.effects.corrected else NO_EFFECTS
    scenes = []
    for measured in passes:
        rays_of_pass = {line: raw[f"{measured.name}/{line}"] for line in measured.images}
        corrected = data[measured.name].corrected(rays_of_pass, measured.images, removed, height[number[measured.name]])
        for line, rays in corrected.items():
            assert rays.time is not None
            moved = replace(rays, point=number[measured.name][rays.point], time=rays.time + begin[measured.name])
            scenes.append(model.Scene(f"{measured.name}/{line}", measured.name, line, moved))
    days = np.array(list(begin.values())) / _DAY
    expected = {
        line: model.CameraPrior(np.zeros((len(days), 4)), change_covariance(spec.changes[line], days)) for line in lines
    }
    block = model.Block(
        passes=tuple(model.Pass(name, spec.trackers.get(name, "tracker"), _middle(scenes, name)) for name in begin),
        scenes=tuple(scenes),
        cameras=FrozenMap(models),
        known=expected,
        attitude=tuple(law_of(name, law) for name, law in spec.errors.attitude.items()),
        station=tuple(law_of(name, law) for name, law in spec.errors.orbit.items()),
        image=1.0,
        points=points,
        monitored=_monitored(setup, lines, expected, epochs, monitor),
    )
    return block, coordinates


def _middle(scenes: Sequence[model.Scene], name: str) -> float | None:
    times = [s.rays.time for s in scenes if s.of == name and s.rays.time is not None and len(s.rays.time)]
    return 0.5 * float(np.concatenate(times).min() + np.concatenate(times).max()) if times else None


def _points(passes: Sequence[PassMeasurements], shared: bool) -> tuple[model.Points, dict[str, np.ndarray]]:
    """Return the points of all passes, and the index among them of each point of a pass.

    Points of the same name in several passes are the same point where names are shared; the first pass with coordinates
    gives them.
    """
    ids: dict[str, int] = {}
    places: list[np.ndarray] = []
    covariances: list[np.ndarray] = []
    roles: list[str] = []
    number = {}
    for measured in passes:
        where = np.empty(len(measured.ground), np.intp)
        for k, name in enumerate(measured.ground.ids.tolist()):
            key = str(name) if shared else f"{measured.name} {name}"
            at = ids.setdefault(key, len(ids))
            where[k] = at
            if at == len(places):
                places.append(measured.ground.itrs[k])
                covariances.append(measured.ground.covariance[k])
                roles.append(measured.ground.role[k])
            elif roles[at] == "tie" and measured.ground.role[k] != "tie":
                places[at], covariances[at], roles[at] = (
                    measured.ground.itrs[k],
                    measured.ground.covariance[k],
                    measured.ground.role[k],
                )
        number[measured.name] = where
    role = np.array(roles, object)
    covariance = np.array(covariances)
    # exact control points are known to a millimetre: a covariance has to have an inverse
    exact = (role == "control") & ~np.any(covariance, axis=(1, 2))
    covariance[exact] = 1e-6 * np.eye(3)
    return model.Points(np.array(list(ids), object), np.array(places), role, covariance), number


def _first_coordinates(
    points: model.Points, raw: Mapping[str, Rays], models: Mapping[str, LineModel], number: Mapping[str, np.ndarray]
) -> model.Points:
    """Return the points with initial coordinates of tie and check points.

    These are the intersection of the rays where two scenes see a point, and otherwise the mean of all points.
    """
    rays = {
        scene: Rays(number[scene.rsplit("/", 1)[0]][r.point], r.image, r.station, r.attitude)
        for scene, r in raw.items()
    }
    cameras = {scene: models[scene.rsplit("/", 1)[1]] for scene in raw}
    try:
        intersection = intersect(rays, cameras, Noise(1e-5), count=len(points.ids)).ground
    except CalibrationError as error:
        raise BenchError(str(error), ("data",), "points that two scenes see") from error
    start = np.where((points.role == "control")[:, None], points.start, intersection)
    unknown = ~np.isfinite(start).all(axis=1)
    start[unknown] = np.nanmean(start, axis=0)
    return model.Points(points.ids, start, points.role, points.covariance)


def _monitored(
    setup: MeasuredAdjustSetup,
    lines: Sequence[str],
    expected: Mapping[str, model.CameraPrior],
    epochs: Mapping[str, str],
    source: MonitorSource | None,
) -> dict[str, model.CameraPrior] | model.JointCameraPrior | None:
    passes = tuple(epochs)
    if source is not None:
        return source(epochs, lines)
    monitor = setup.test.monitor
    if monitor is None:
        return None
    priors = {}
    for line in lines:
        reading, sigma = np.zeros((len(passes), 4)), np.full((len(passes), 4), np.inf)
        for k, name in enumerate(passes):
            camera_reading = monitor.readings.get(name, {}).get(line)
            if camera_reading is not None:
                reading[k], sigma[k] = (
                    (*camera_reading.angles, camera_reading.principal_distance),
                    camera_sigmas(monitor),
                )
        priors[line] = monitored_camera(expected[line].covariance, reading.ravel(), sigma.ravel())
    return priors
