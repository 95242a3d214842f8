"""From image points of a pass to what a calibration takes, with the effects on the light taken out.

The adjustment's rays are straight lines in Earth-fixed axes. A pixel's look is where the light seems to come from; the
straight line to the place on the ground that this look really sees, through the measured station, is where the place
is. The image point is moved from the one to the other. Camera and trajectory are those that the analysis has: the
laboratory's and the measured one. The camera's error of 100 m on the ground, 2e-4 rad, changes an aberration of 4
pixels by a thousandth of a pixel.

Image points may be drawn, as `twin.orbit.calibration.campaign` does, or measured in images: nothing here knows which.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.orbit.calibration_parameters import CalibrationField, Noise
from analysis.orbit.forward_intersection import intersect
from analysis.orbit.three_line_model import LineModel, Rays
from optics.numerics.array_math import UnphysicalError
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.light_effects import NO_EFFECTS, LightEffects
from twin.orbit.flight.line_camera import pixel_places
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.flight.sensor import Sensor
from twin.orbit.measured.pass_measurements import ImagePoints

if TYPE_CHECKING:
    from scenes.specs.orbit.angle import EffectsSpec
    from scenes.specs.orbit.three_line_camera import LineCameraSpec


EFFECTS = ("light_time", "aberration", "refraction")
_DISTORTION_STEPS = 8
"""Fixed-point steps; each makes the error smaller by the distortion, 1e-3 of the image or less."""


def light_effects(spec: EffectsSpec) -> LightEffects:
    """Effects on the light that a file switches on."""
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
        raise UnphysicalError("a look misses the Earth")
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


_SAME_PHASE = 1e-6
"""Phase that counts as zero, as a share of the interval between readings: times of readings are rounded."""
_HEIGHTS = (-500.0, 9000.0)
"""Metres: of land. A control point outside of them is refused by the calibration, not here."""


@dataclass(frozen=True, eq=False)
class PassData:
    """What is known of a pass beside its image points; nothing of it is the truth.

    Attributes:
        name: of the field.
        sensors: line -> the laboratory's camera on the measured trajectory. Its effects do not matter.
        models: line -> the same camera as the adjustment has it.
        pitch: line -> of its pixels, metres.
        height: mean of the ground above the ellipsoid, metres.
        unit: metres in the focal plane; every ray carries the covariance of its own image point in units of it
            squared. None: rays carry none.
        lines: line -> what the payload's file says of it, for CCDs that do not lie in one line; None where they do.
    """

    name: str
    sensors: Mapping[str, Sensor]
    models: Mapping[str, LineModel]
    pitch: Mapping[str, float]
    height: float
    unit: float | None = None
    lines: Mapping[str, LineCameraSpec] | None = None

    def places(self, name: str, pixel: np.ndarray) -> np.ndarray:
        """Where pixels (n,) of a line lie in its focal plane, (n, 2), metres."""
        if self.lines is not None:
            return pixel_places(self.lines[name], pixel, self.sensors[name].camera.pixels, self.pitch[name])
        y = self.pitch[name] * (pixel - 0.5 * (self.sensors[name].camera.pixels - 1))
        return np.column_stack([np.zeros_like(y), y])

    @property
    def phase(self) -> float:
        """Time of a reading of the attitude from the next whole multiple of their interval, seconds.

        Readings of the orbit are as far from their multiples at most, half of their interval, which shared noise does
        not know: its variance then is that of another place between two readings.
        """
        path = next(iter(self.sensors.values())).trajectory
        if not isinstance(path, TabulatedTrajectory):
            return 0.0
        time, step = path.table.attitude_time, path.attitude_interval
        # a table may begin with an odd end
        reading = float(time[1 + int(np.argmin(np.abs(np.diff(time[1:]) - step)))]) if len(time) > 2 else float(time[0])
        phase = reading - step * round(reading / step)
        return phase if abs(phase) > _SAME_PHASE * step else 0.0

    @property
    def earth(self) -> Earth:
        """The ellipsoid."""
        return next(iter(self.sensors.values())).earth

    def pixels_per_line(self, name: str) -> float:
        """What one image line of the middle of a line's image is in x of the focal plane, pixels.

        It is where the ground that the next line sees, at the pass' mean height, lies in the focal plane at one moment.
        Where lines are spaced as pixels are, 1 at nadir and about cos^2 of the look angle in a line that looks ahead.
        """
        sensor, model = self.sensors[name], self.models[name]
        middle = np.full(2, 0.5 * (sensor.lines - 1))
        ground = sensor.ground(
            middle + np.array([-0.5, 0.5]), np.full(2, 0.5 * (sensor.camera.pixels - 1)), self.height
        )
        seconds = sensor.time(middle)
        to_body = np.swapaxes(sensor.trajectory.body_to_itrs(seconds), 1, 2)
        arm = np.einsum("nij,nj->ni", to_body, ground - sensor.trajectory.position(seconds))
        a, _, c = ((arm - model.position) @ model.to_body).T
        x = -float(model.interior[0]) * a / c
        return abs(float(x[1] - x[0])) / self.pitch[name]

    def rays(self, images: Mapping[str, ImagePoints]) -> dict[str, Rays]:
        """Rays of image points with what happened to the light left in.

        Raises:
            ValueError: a line outside the image.
        """
        found = {}
        for name, row in images.items():
            sensor = self.sensors[name]
            seconds = sensor.time(row.line)
            image = self.places(name, row.pixel)
            station, attitude = sensor.trajectory.position(seconds), sensor.trajectory.body_to_itrs(seconds)
            # the noise of readings is shared by its own clock, which ticks at the readings
            rays = Rays.of(row.point, image, station, attitude, seconds - self.phase)
            found[name] = rays if self.unit is None else replace(rays, spread=self._spread(name, row) / self.unit**2)
        return found

    def _spread(self, name: str, row: ImagePoints) -> np.ndarray:
        """(n, 2, 2) of image points in the focal plane, metres^2. A later line acts as a smaller x."""
        scale = self.pitch[name] * np.array([-self.pixels_per_line(name), 1.0])
        return row.covariance * scale[:, None] * scale

    def control_field(
        self,
        images: Mapping[str, ImagePoints],
        ground: np.ndarray,
        covariance: float | tuple[float, float] | np.ndarray,
        removed: LightEffects,
        control: np.ndarray | None = None,
    ) -> CalibrationField:
        """Control points for the calibration.

        Args:
            images: line -> their image points.
            ground: (m, 3) given coordinates, ITRS, metres.
            covariance: (m, 3, 3) of the coordinates, m^2, of ties not used; or a sigma of each coordinate, or of each
                axis in plan and of the height, metres.
            removed: effects on the light that are taken out.
            control: (m,) which of them are control, the others are ties; None for all.

        Raises:
            CalibrationError: coordinates that cannot be used, such as geodetic ones.
            ValueError: a point outside the image.
        """
        # the calibration's own check comes first: a place without a height has no refraction
        field = CalibrationField.of(self.name, self.rays(images), ground, covariance, control)
        return replace(field, rays=self.corrected(field.rays, images, removed, self._heights(ground)))

    def check_rays(self, images: Mapping[str, ImagePoints], removed: LightEffects, noise: Noise) -> dict[str, Rays]:
        """Rays of points without ground control.

        Refraction depends on the height of the ground, 8% of it on 700 m. It is taken from a first intersection by the
        laboratory's camera, 100 m wrong, of the rays as they are.

        Raises:
            CalibrationError: the rays cannot be intersected.
            ValueError: a point outside the image.
        """
        rays = self.rays(images)
        return self.corrected(rays, images, removed, self._heights(intersect(rays, self.models, noise).ground))

    def corrected(
        self, rays: Mapping[str, Rays], images: Mapping[str, ImagePoints], removed: LightEffects, height: np.ndarray
    ) -> dict[str, Rays]:
        """The rays without these effects.

        Args:
            rays: line -> rays of the image points.
            images: line -> the image points.
            removed: effects on the light that are taken out.
            height: of the ground points, (m,), NaN where not known, metres.

        Raises:
            ValueError: a point outside the image.
        """
        known = np.clip(np.where(np.isfinite(height), height, self.height), *_HEIGHTS)
        found = {}
        for name, row in images.items():
            sensor = replace(self.sensors[name], effects=removed)
            shift = light_shift(sensor, self.models[name], row.line, row.pixel, known[row.point])
            found[name] = replace(rays[name], image=rays[name].image + shift)
        return found

    def _heights(self, ground: np.ndarray) -> np.ndarray:
        found = np.full(len(ground), np.nan)
        good = np.all(np.isfinite(ground), axis=1)
        found[good] = self.earth.geodetic(ground[good])[2]
        return found


@dataclass(frozen=True, eq=False)
class FieldPoints:
    """What was measured of a field's points.

    Attributes:
        data: what is known of the pass beside them.
        control_images: line -> image points of the control points, and of the tie points after them.
        control_ground: (n, 3) given coordinates of control points, first guesses of ties, ITRS, metres.
        control: (n,) bool: which are control.
        sigma: of each given coordinate, or of each axis in plan and of the height, metres.
        check_images: line -> image points of the check points.
        check_ground: (m, 3) true coordinates of the check points, ITRS, metres.
    """

    data: PassData
    control_images: Mapping[str, ImagePoints]
    control_ground: np.ndarray
    control: np.ndarray
    sigma: float | tuple[float, float]
    check_images: Mapping[str, ImagePoints]
    check_ground: np.ndarray


def image_sigma(images: Mapping[str, ImagePoints], data: PassData) -> float:
    """One standard deviation of x and y in the focal plane for all image points, root mean square, metres."""
    squares = []
    for name, row in images.items():
        square = data.pitch[name] ** 2
        squares += [
            square * data.pixels_per_line(name) ** 2 * row.covariance[:, 0, 0],
            square * row.covariance[:, 1, 1],
        ]
    return float(np.sqrt(np.mean(np.concatenate(squares))))
