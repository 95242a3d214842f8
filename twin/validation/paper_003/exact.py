"""Set-ups of paper 003's checks, and its model on exact points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from analysis.calibration.adjustment import Adjustment, adjust
from analysis.calibration.strip_adjustment import Stepwise, stepwise
from analysis.orbit.calibration_parameters import Combination, Gauge
from analysis.orbit.three_line_model import BIAS, INTERIOR, Rays, misclosure, partials
from optics.numerics.number_tree import FrozenMap
from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.angle import LINES, EffectsSpec
from scenes.specs.orbit.flight import ThermalDriftSpec
from scenes.specs.orbit.setup import CalibrationSetup, resolve_calibration
from twin.orbit.calibration.calibration_run import source_of
from twin.orbit.calibration.campaign import Campaign, FieldPass, line_model
from twin.orbit.calibration.campaign_adjustment import GAUGE, calibrated_alone
from twin.orbit.flight.light_effects import NO_EFFECTS, LightEffects
from twin.orbit.flight.line_camera import changed_payload, line_cameras
from twin.orbit.flight.sensor import Platform, Sensor
from twin.validation.checks.check import Chosen

FIELDS, IMAGES = "calibrate.yaml", "calibrate_images.yaml"
"""Files of scenes/orbit: seven fields of drawn points; fields of rendered images."""
_NO_LIGHT = EffectsSpec(light_time=False, aberration=False, refraction=False)

TOLERANCE = 1e-3
"""Largest last step of a round of the stepwise solution, in conditional sigmas."""
_STEP = {"f": 1e-5, "x": 1e-5, "y": 1e-5}
"""Metres: how far an element is changed to either side, 1.5 px; what is left of third order is 1e-9 of it."""
_TURN = 1.5e-5
"""Radians, likewise."""


def setup_of(file: str, fields: Sequence[str] = (), **changes: Any) -> CalibrationSetup:
    """A file of the library with some of its fields and with other values of its test's attributes."""
    setup = resolve_calibration(SCENES / ORBIT / file)
    if fields:
        chosen = FrozenMap({name: setup.test.fields[name] for name in fields})
        changes = {"fields": chosen, "schemes": (tuple(fields[:1]),), **changes}
    return changed(setup, **changes)


def changed(setup: CalibrationSetup, **changes: Any) -> CalibrationSetup:
    """A setup with other values of its test's attributes."""
    return setup.model_copy(update={"test": setup.test.model_copy(update=changes)})


def without_light(setup: CalibrationSetup) -> CalibrationSetup:
    """A setup without light time, aberration and refraction, which the paper does not mention. The adjustment removes
    them from image points to 0.004 px, and a flight without them takes half the time.
    """
    return changed(setup, effects=_NO_LIGHT)


def exact(setup: CalibrationSetup) -> CalibrationSetup:
    """A setup with exact image points, control and orbit, and an attitude with a constant bias only."""
    errors = setup.test.errors
    tracker = errors.star_tracker.model_copy(update={"thermal": ThermalDriftSpec()})
    update = {"switched_on": False, "season": (0.0, 0.0, 0.0), "star_tracker": tracker}
    return changed(setup, errors=errors.model_copy(update=update))


def all_errors(value: float) -> Chosen:
    """What is assumed of biases, orbit, attitude and points, to which the errors of a calibration are proportional."""
    return Chosen.power("biases and errors of scenes/orbit/calibrate.yaml, times", 1.0, "1", value)


def true_sensors(
    setup: CalibrationSetup, one: FieldPass, effects: LightEffects = NO_EFFECTS, trajectory: Platform | None = None
) -> dict[str, Sensor]:
    """Line -> the camera as it is after launch, on the true trajectory of a pass or on another one."""
    cameras = line_cameras(changed_payload(setup.test, setup.camera))
    path = one.trajectory if trajectory is None else trajectory
    known = one.data.sensors
    return {k: replace(known[k], camera=cameras[k], trajectory=path, effects=effects) for k in LINES}


@dataclass(frozen=True, eq=False)
class Turned:
    """A platform with its body turned, attitude -> attitude Rx(roll) Ry(pitch) Rz(yaw).

    Attributes:
        base: the platform.
        angles: (3,) roll, pitch, yaw, radians.
    """

    base: Platform
    angles: np.ndarray

    def position(self, seconds: np.ndarray) -> np.ndarray:
        """Position of the base."""
        return self.base.position(seconds)

    def inertial_velocity(self, seconds: np.ndarray) -> np.ndarray:
        """Inertial velocity of the base."""
        return self.base.inertial_velocity(seconds)

    def body_to_itrs(self, seconds: np.ndarray) -> np.ndarray:
        """Turned."""
        return np.asarray(self.base.body_to_itrs(seconds) @ Rotation.from_euler("XYZ", self.angles).as_matrix())


def rays_at(sensor: Sensor, attitude: Platform, pitch: float, line: np.ndarray, pixel: np.ndarray) -> Rays:
    """Rays of image points with the station and the given attitude of their exposure times."""
    seconds = sensor.time(line)
    y = pitch * (pixel - 0.5 * (sensor.camera.pixels - 1))
    image = np.column_stack([np.zeros_like(y), y])
    return Rays.of(
        np.arange(len(y)), image, sensor.trajectory.position(seconds), attitude.body_to_itrs(seconds), seconds
    )


def derivatives(setup: CalibrationSetup, one: FieldPass, bias: np.ndarray) -> tuple[str, str, float]:
    """Coefficients of the error equations against image points of the rigorous sensor: each unknown of the sensor is
    changed a little; what the unchanged model then misses is minus its coefficient.

    Args:
        setup: cameras.
        one: a pass; its check points are taken.
        bias: (3,) from the measured to the true attitude, radians.

    Returns:
        Line and unknown that are farthest off, and their largest difference over the largest coefficient.
    """
    payload = changed_payload(setup.test, setup.camera)
    ground, still = one.check_ground, np.zeros(3)
    found = []
    for line in LINES:
        model, pitch = line_model(payload, line), setup.camera.pitch_of(line)
        base = true_sensors(setup, one, trajectory=Turned(one.trajectory, bias))[line]
        seen = places_seen(setup, one, line, np.zeros(3), bias)
        by = partials(model, rays_at(base, one.trajectory, pitch, *seen), ground, bias, still)
        for k, name in enumerate((*INTERIOR, *BIAS)):
            step = _STEP.get(name, _TURN)
            sides = []
            for sign in (1.0, -1.0):
                change = np.zeros(6)
                change[k] = sign * step
                seen = places_seen(setup, one, line, change[:3], bias + change[3:])
                sides.append(misclosure(model, rays_at(base, one.trajectory, pitch, *seen), ground, bias, still))
            coefficient = -(sides[0] - sides[1]) / (2.0 * step)
            expected = by.interior[:, :, k] if k < 3 else by.bias[:, :, k - 3]
            found.append((line, name, float(np.abs(coefficient - expected).max() / np.abs(coefficient).max())))
    return max(found, key=lambda entry: entry[2])


def places_seen(
    setup: CalibrationSetup, one: FieldPass, line: str, interior: np.ndarray, bias: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Lines and pixels of the check points in a line that is changed as `_moved` says, by the rigorous sensor."""
    return _moved(setup, one, line, interior, bias).image(one.check_ground)


def _moved(setup: CalibrationSetup, one: FieldPass, line: str, interior: np.ndarray, bias: np.ndarray) -> Sensor:
    """The true sensor of a line with a changed f, x, y (3,) and turned by a bias (3,)."""
    payload = changed_payload(setup.test, setup.camera)
    spec = payload.lines[line]
    f, x, y = (float(v) for v in interior)
    point = spec.principal_point[0] + x, spec.principal_point[1] + y
    lines = {
        **payload.lines,
        line: spec.model_copy(update={"principal_distance": spec.principal_distance + f, "principal_point": point}),
    }
    camera = line_cameras(payload.model_copy(update={"lines": FrozenMap(lines)}))[line]
    path = Turned(one.trajectory, bias)
    return replace(one.data.sensors[line], camera=camera, trajectory=path, effects=NO_EFFECTS)


def exact_campaign(setup: CalibrationSetup, seed: np.random.SeedSequence) -> Campaign:
    """Image points of the rigorous sensor without noise."""
    return source_of(setup, seed).independent


def recovered(campaign: Campaign, pitch: float) -> tuple[float, str]:
    """Largest error of a calibration of exact points, pixels of image motion, and which unknown has it."""
    one = campaign.passes[0]
    found = calibrated_alone(campaign, one)
    worst, which = 0.0, ""
    for name, error in errors_of(campaign, one, found).items():
        pixels = abs(error) * (found.cameras["nadir"].interior[0] if name in BIAS else 1.0) / pitch
        if pixels >= worst:
            worst, which = float(pixels), name
    return worst, which


def errors_of(campaign: Campaign, one: FieldPass, found: Adjustment | Stepwise) -> dict[str, float]:
    """Unknown, without a field -> estimated minus true, metres and radians."""
    value = dict(zip(found.names, found.values, strict=True))
    out = {
        f"{line} {name}": float(value[f"{line} {name}"] - true)
        for line in LINES
        for name, true in zip(INTERIOR, campaign.truth[line].interior, strict=True)
    }
    return out | {n: float(value[f"{one.name} {n}"] - t) for n, t in zip(BIAS, one.bias, strict=True)}


@dataclass(frozen=True, eq=False)
class Rank:
    """What the twelve unknowns of a field leave open.

    Attributes:
        unknowns: how many. open: combinations. weak_sigma: of nadir y, metres, with nadir x held.
        moved: RMS that the rigorous sensor's image points move by when the open combination is carried out, x of every
            line 0.1 mm. alone: when only the x are. Pixels.
    """

    unknowns: int
    open: tuple[Combination, ...]
    weak_sigma: float
    moved: float
    alone: float

    @property
    def rank(self) -> int:
        """Unknowns less open combinations."""
        return self.unknowns - len(self.open)


def rank_of(setup: CalibrationSetup, campaign: Campaign) -> Rank:
    """The null vectors of one field by itself, and the first of them carried out by the sensor."""
    one = campaign.passes[0]
    own = campaign.independent
    found = adjust([one.control], own.laboratory, own.noise, gauge=GAUGE)
    loose = adjust([one.control], own.laboratory, own.noise, gauge=Gauge(held=("nadir x",)))
    first = dict(zip(found.open[0].names, found.open[0].change, strict=True)) if found.open else {}
    size = 1e-4 / max(abs(first.get("nadir x", 1.0)), 1e-12)
    turn = np.array([first.get(f"{one.name} {n}", 0.0) for n in BIAS]) * size
    moved, alone = [], []
    for line in LINES:
        inner = np.array([first.get(f"{line} {n}", 0.0) for n in INTERIOR]) * size
        start, both, inside = (
            np.stack(_moved(setup, one, line, a, b).image(one.check_ground))
            for a, b in ((np.zeros(3), np.zeros(3)), (inner, turn), (inner, np.zeros(3)))
        )
        moved.append(both - start)
        alone.append(inside - start)
    rms = [float(np.sqrt(np.mean(np.sum(np.concatenate(v, axis=1) ** 2, axis=0)))) for v in (moved, alone)]
    return Rank(len(found.names), found.open, loose.sigma["nadir y"], rms[0], rms[1])


@dataclass(frozen=True, eq=False)
class Walk:
    """The stepwise solution of a field against the simultaneous one.

    Attributes:
        found: stepwise. together: simultaneous. distance: largest difference, sigmas.
        after: rounds -> largest difference after so many, sigmas.
    """

    found: Stepwise
    together: Adjustment
    distance: float
    after: Mapping[int, float]


def walked(campaign: Campaign, one: FieldPass, rounds: tuple[int, ...] = (1, 10, 100)) -> Walk:
    """Both solutions of one field, and how far the stepwise one is after some rounds."""
    given = [one.control], campaign.laboratory, campaign.noise
    together = adjust(*given, gauge=GAUGE)
    free = np.array([name not in GAUGE.held for name in together.names])
    sigma = np.sqrt(np.diag(together.covariance))[free]

    def distance(found: Stepwise) -> np.ndarray:
        return np.asarray(np.abs(found.values - together.values)[free] / sigma)

    found = stepwise(*given, held=GAUGE.held, tolerance=TOLERANCE)
    after = {n: float(distance(stepwise(*given, held=GAUGE.held, rounds=n)).max()) for n in rounds}
    return Walk(found, together, float(distance(found).max()), FrozenMap(after))
