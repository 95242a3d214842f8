"""A block of measured passes, from the tables that a calibration reads.

What is known of the passes of a block, as the analysis has it: laws, cameras before and after their readings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from analysis.block import block as known
from analysis.block.block import CameraKnowledge, CamerasKnowledge, Term
from analysis.block.error_processes import Law
from analysis.orbit.calibration_parameters import CalibrationError, Noise
from analysis.orbit.forward_intersection import intersect
from analysis.orbit.three_line_model import LineModel, Rays
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.adjust import CameraChangeSpec, LawSpec
from scenes.specs.orbit.calibration import CameraDriftSpec, MonitorReadingSpec
from scenes.specs.orbit.setup import MeasuredAdjustSetup
from twin.framework.procedure import Advance, BenchError, silent
from twin.orbit.calibration.campaign import light_effects, line_model, pass_data
from twin.orbit.flight.earth import Earth, tai_of
from twin.orbit.flight.light_effects import NO_EFFECTS
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.measured.measurement_tables import read_measurements
from twin.orbit.measured.pass_measurements import PassMeasurements

MonitorSource = Callable[[Mapping[str, str], Sequence[str]], CamerasKnowledge]
"""Epochs of passes, UTC, and lines -> what a record of the monitor says of the lines' cameras in these passes."""


def law_of(name: str, spec: LawSpec) -> Term:
    """A stated law as the analysis has it."""
    sigma: tuple[float, float, float] = spec.sigma  # type: ignore[attr-defined]
    return Term(Law(name, spec.law, sigma, spec.interval, spec.time or 0.0, spec.frequency or 0.0), spec.shared_by)


def camera_sigmas(spec: CameraDriftSpec | MonitorReadingSpec) -> np.ndarray:
    """(4,) of d_alpha, d_beta, d_gamma, radians, and d_f, metres."""
    return np.array([*spec.angles, spec.principal_distance])


def change_covariance(spec: CameraChangeSpec, days: np.ndarray) -> np.ndarray:
    """(4 T, 4 T) of a camera's changes in passes at so many days (T,) from the first."""
    lasting, each, walk = (np.diag(camera_sigmas(s) ** 2) for s in (spec.lasting, spec.each_pass, spec.walk))
    one = np.ones((len(days), len(days)))
    earlier = np.minimum(days[:, None], days)
    return np.asarray(np.kron(one, lasting) + np.kron(np.eye(len(days)), each) + np.kron(earlier, walk))


def monitored_camera(law: np.ndarray, reading: np.ndarray, sigma: np.ndarray) -> CameraKnowledge:
    """A camera's changes after the monitor's readings.

    Parameters
    ----------
    law : np.ndarray
        Covariance before them, (4 T, 4 T).
    reading : np.ndarray
        Of the changes, (4 T,), radians and metres.
    sigma : np.ndarray
        Of the readings, (4 T,); infinite where there is none.
    """
    use = np.flatnonzero(np.isfinite(sigma))
    gain = law[:, use] @ np.linalg.inv(law[np.ix_(use, use)] + np.diag(sigma[use] ** 2))
    rest = law - gain @ law[use]
    return CameraKnowledge((gain @ reading[use]).reshape(-1, 4), 0.5 * (rest + rest.T))


_DAY = 86400.0


def seconds_after_the_first(epochs: Mapping[str, str]) -> dict[str, float]:
    """Return the time of each epoch since the earliest, seconds of TAI, to a microsecond."""
    moments = {name: tai_of(epoch) for name, epoch in epochs.items()}
    zero = min(moments.values())
    return {
        name: float(round((day - zero[0]) * _DAY + (part - zero[1]) * _DAY, 6)) for name, (day, part) in moments.items()
    }


def measured_block(
    setup: MeasuredAdjustSetup, advance: Advance = silent, monitor: MonitorSource | None = None
) -> tuple[known.Block, np.ndarray]:
    """The block of the tables of all passes, and the given coordinates of its points (m, 3), ITRS, metres, NaN of ties.

    Raises
    ------
    InputError
        a table that cannot be used.
    BenchError
        Points that cannot be intersected, or a line of which it is not said how it may change.
    """
    spec, payload = setup.test, setup.camera
    passes = read_measurements(setup.data, payload, advance, {})
    lines = tuple(dict.fromkeys(line for one in passes for line in one.images))
    for line in lines:
        if line not in spec.changes:
            raise BenchError(f"it is not said how {line} may have changed", ("changes",), f"`{line}:`")
    epochs = {one.name: one.platform.epoch for one in passes}
    begin = seconds_after_the_first(epochs)
    points, number = _points(passes, spec.names == "shared")
    models = {line: line_model(payload, line) for line in lines}
    data = {}
    for one in passes:
        known_places = one.ground.itrs[one.ground.role != "tie"]
        mean = float(np.mean(Earth().geodetic(known_places)[2])) if len(known_places) else 0.0
        times = {line: one.line_times[line] for line in one.images}
        data[one.name] = pass_data(one.name, payload, TabulatedTrajectory(one.platform), times, mean, 1.0)
    raw = {}
    for one in passes:
        for line, rays in data[one.name].rays(one.images).items():
            raw[f"{one.name}/{line}"] = rays
    given = np.where((points.role == "tie")[:, None], np.nan, points.start)
    points = _started(points, raw, models, number)
    earth = Earth()
    height = earth.geodetic(points.start)[2]
    removed = light_effects(spec.effects) if spec.effects.corrected else NO_EFFECTS
    scenes = []
    for one in passes:
        mine = {line: raw[f"{one.name}/{line}"] for line in one.images}
        corrected = data[one.name].corrected(mine, one.images, removed, height[number[one.name]])
        for line, rays in corrected.items():
            assert rays.time is not None
            moved = replace(rays, point=number[one.name][rays.point], time=rays.time + begin[one.name])
            scenes.append(known.Scene(f"{one.name}/{line}", one.name, line, moved))
    days = np.array(list(begin.values())) / _DAY
    expected = {
        line: known.CameraKnowledge(np.zeros((len(days), 4)), change_covariance(spec.changes[line], days))
        for line in lines
    }
    block = known.Block(
        passes=tuple(known.Pass(name, spec.trackers.get(name, "tracker"), _middle(scenes, name)) for name in begin),
        scenes=tuple(scenes),
        cameras=FrozenMap(models),
        known=expected,
        attitude=tuple(law_of(name, law) for name, law in spec.errors.attitude.items()),
        station=tuple(law_of(name, law) for name, law in spec.errors.orbit.items()),
        image=1.0,
        points=points,
        monitored=_monitored(setup, lines, expected, epochs, monitor),
    )
    return block, given


def _middle(scenes: Sequence[known.Scene], name: str) -> float | None:
    times = [s.rays.time for s in scenes if s.of == name and s.rays.time is not None and len(s.rays.time)]
    return 0.5 * float(np.concatenate(times).min() + np.concatenate(times).max()) if times else None


def _points(passes: Sequence[PassMeasurements], shared: bool) -> tuple[known.Points, dict[str, np.ndarray]]:
    """Points of all passes, and pass -> number of each of its points among them. Points of one name are one where names
    are shared; the first pass that has coordinates gives them.
    """
    ids: dict[str, int] = {}
    places: list[np.ndarray] = []
    covariances: list[np.ndarray] = []
    roles: list[str] = []
    number = {}
    for one in passes:
        where = np.empty(len(one.ground), np.intp)
        for k, name in enumerate(one.ground.ids.tolist()):
            key = str(name) if shared else f"{one.name} {name}"
            at = ids.setdefault(key, len(ids))
            where[k] = at
            if at == len(places):
                places.append(one.ground.itrs[k])
                covariances.append(one.ground.covariance[k])
                roles.append(one.ground.role[k])
            elif roles[at] == "tie" and one.ground.role[k] != "tie":
                places[at], covariances[at], roles[at] = (
                    one.ground.itrs[k],
                    one.ground.covariance[k],
                    one.ground.role[k],
                )
        number[one.name] = where
    role = np.array(roles, object)
    covariance = np.array(covariances)
    # exact control points are known to a millimetre: a covariance has to have an inverse
    exact = (role == "control") & ~np.any(covariance, axis=(1, 2))
    covariance[exact] = 1e-6 * np.eye(3)
    return known.Points(np.array(list(ids), object), np.array(places), role, covariance), number


def _started(
    points: known.Points, raw: Mapping[str, Rays], models: Mapping[str, LineModel], number: Mapping[str, np.ndarray]
) -> known.Points:
    """First places of tie and check points where two scenes see them; of the others the mean of all places."""
    rays = {
        scene: Rays(number[scene.rsplit("/", 1)[0]][r.point], r.image, r.station, r.attitude)
        for scene, r in raw.items()
    }
    cameras = {scene: models[scene.rsplit("/", 1)[1]] for scene in raw}
    try:
        found = intersect(rays, cameras, Noise(1e-5), count=len(points.ids)).ground
    except CalibrationError as error:
        raise BenchError(str(error), ("data",), "points that two scenes see") from error
    start = np.where((points.role == "control")[:, None], points.start, found)
    unknown = ~np.isfinite(start).all(axis=1)
    start[unknown] = np.nanmean(start, axis=0)
    return known.Points(points.ids, start, points.role, points.covariance)


def _monitored(
    setup: MeasuredAdjustSetup,
    lines: Sequence[str],
    expected: Mapping[str, known.CameraKnowledge],
    epochs: Mapping[str, str],
    source: MonitorSource | None,
) -> dict[str, known.CameraKnowledge] | known.CamerasKnowledge | None:
    passes = tuple(epochs)
    if source is not None:
        return source(epochs, lines)
    monitor = setup.test.monitor
    if monitor is None:
        return None
    found = {}
    for line in lines:
        reading, sigma = np.zeros((len(passes), 4)), np.full((len(passes), 4), np.inf)
        for k, name in enumerate(passes):
            one = monitor.readings.get(name, {}).get(line)
            if one is not None:
                reading[k], sigma[k] = (*one.angles, one.principal_distance), camera_sigmas(monitor)
        found[line] = monitored_camera(expected[line].covariance, reading.ravel(), sigma.ravel())
    return found
