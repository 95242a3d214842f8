"""The calibration's files as paper 003's checks take them: fewer fields, other errors, no effects on the light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from optics.frozen_map import FrozenMap
from scenes.load import LIBRARY, ORBIT
from scenes.orbit_angle import LINES, EffectsSpec
from scenes.orbit_setup import CalibrationSetup, resolve_calibration
from scenes.orbit_spec import ThermalDriftSpec
from twin.orbit.calibration.campaign import FieldPass
from twin.orbit.light_effects import NO_EFFECTS, LightEffects
from twin.orbit.line_camera import changed_payload, line_cameras
from twin.orbit.sensor import Platform, Sensor
from twin.validation.chosen import Chosen

FIELDS, IMAGES, STRIP = "calibrate.yaml", "calibrate_images.yaml", "calibrate_strip.yaml"
"""Files of scenes/orbit: seven fields of drawn points; fields of rendered images; passes with tie points."""
_NO_LIGHT = EffectsSpec(light_time=False, aberration=False, refraction=False)


def setup_of(file: str, fields: Sequence[str] = (), **changes: Any) -> CalibrationSetup:
    """A file of the library with some of its fields and with other values of its test's attributes."""
    setup = resolve_calibration(LIBRARY / ORBIT / file)
    if fields:
        chosen = FrozenMap({name: setup.test.fields[name] for name in fields})
        changes = {"fields": chosen, "schemes": (tuple(fields[:1]),), **changes}
    return changed(setup, **changes)


def changed(setup: CalibrationSetup, **changes: Any) -> CalibrationSetup:
    """The same with other values of its test's attributes."""
    return setup.model_copy(update={"test": setup.test.model_copy(update=changes)})


def without_light(setup: CalibrationSetup) -> CalibrationSetup:
    """The same without light time, aberration and refraction, which the paper does not mention: they are taken out of
    image points to 0.004 px, and flying without them takes half of the time.
    """
    return changed(setup, effects=_NO_LIGHT)


def exact(setup: CalibrationSetup) -> CalibrationSetup:
    """The same with exact image points, control and orbit, and an attitude with a constant bias only."""
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
        """As the base."""
        return self.base.position(seconds)

    def inertial_velocity(self, seconds: np.ndarray) -> np.ndarray:
        """As the base."""
        return self.base.inertial_velocity(seconds)

    def body_to_itrs(self, seconds: np.ndarray) -> np.ndarray:
        """Turned."""
        return np.asarray(self.base.body_to_itrs(seconds) @ Rotation.from_euler("XYZ", self.angles).as_matrix())
