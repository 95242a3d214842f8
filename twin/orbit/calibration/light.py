"""What light time, aberration and refraction move image points by, so that a calibration can take it out of them.

The adjustment's rays are straight lines in Earth-fixed axes. A pixel's look is where the light seems to come from; the
straight line to the place on the ground that this look really sees, through the measured station, is where the place
is. The image point is moved from the one to the other. Camera and trajectory are those that the analysis has: the
laboratory's and the measured one. The camera's error of 100 m on the ground, 2e-4 rad, changes an aberration of 4
pixels by a thousandth of a pixel.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.orbit.three_line_model import LineModel
from twin.orbit.light_effects import NO_EFFECTS, LightEffects
from twin.orbit.sensor import Sensor

if TYPE_CHECKING:
    from scenes.orbit_angle import EffectsSpec

EFFECTS = ("light_time", "aberration", "refraction")
_DISTORTION_STEPS = 8
"""Fixed-point steps; each makes the error smaller by the distortion, 1e-3 of the image or less."""


def light_effects(spec: EffectsSpec) -> LightEffects:
    """Those that a file says."""
    return LightEffects(spec.light_time, spec.aberration, spec.refraction, spec.wavelength)


def any_effect(effects: LightEffects) -> bool:
    """Whether one of them is on."""
    return any(getattr(effects, name) for name in EFFECTS)


def light_shift(
    sensor: Sensor, model: LineModel, line: np.ndarray, pixel: np.ndarray, height: np.ndarray
) -> np.ndarray:
    """From image points as they are measured to where they would lie if nothing happened to the light.

    Args:
        sensor: the laboratory's line on the measured trajectory, with the effects that are to be taken out.
        model: the same line as the adjustment has it.
        line: of the image points, (n,).
        pixel: likewise.
        height: of the ground that they show, above the ellipsoid, metres, (n,).

    Returns:
        (n, 2) x and y in the focal plane, metres, to be added.

    Raises:
        ValueError: a point outside the image, or a look that misses the Earth.
    """
    if sensor.effects == NO_EFFECTS or not any_effect(sensor.effects):
        return np.zeros((len(line), 2))
    ground = sensor.ground(line, pixel, height)
    if not np.all(np.isfinite(ground)):
        raise ValueError("a look misses the Earth")
    seconds = sensor.time(line)
    arm = ground - sensor.trajectory.position(seconds)
    geometric = np.einsum("nji,nj->ni", sensor.trajectory.body_to_itrs(seconds), arm) - model.position
    return _place(geometric, model) - _place(sensor.camera.look(pixel), model)


def _place(direction: np.ndarray, model: LineModel) -> np.ndarray:
    """Image (n, 2) of directions (n, 3) in the body frame, from the principal point, metres."""
    a, b, c = (direction @ model.to_body).T
    ideal = -model.interior[0] * np.stack([a / c, b / c], axis=-1)
    found = ideal
    for _ in range(_DISTORTION_STEPS):
        square = np.sum(found**2, axis=1, keepdims=True)
        found = ideal / (1.0 + square * (model.k1 + model.k2 * square))
    return np.asarray(found)
