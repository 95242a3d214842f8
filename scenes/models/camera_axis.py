"""The axis of a camera: the ray that its paraxial data are about, the beam along it that the entrance pupil states, and
what has no focus at all.

Shared by the derivation of a camera and by whoever judges one in a state, where the same ray of the scene is traced
through the bodies as they stand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optics.geometry.pose import Pose
from optics.numerics.array_math import PhysicalError
from optics.numerics.backend import Backend
from optics.raytrace.aim import AimError, transverse_axes
from optics.raytrace.first_order import Paraxial, equal_area_radius, paraxial, ray_matrix
from optics.raytrace.system import SystemBatch
from optics.raytrace.trace import BeamMissedError, make_rays, trace
from optics.waves.imaging import aim_collimated
from scenes.specs.camera import CameraSpec

PARENT_AXIS, LINE_AXIS = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
LAUNCH_DISTANCE = 3.0
"""How far before the prescription's origin beams from the scene are launched, metres."""
AFOCAL = 1000.0
"""Focal length, over the distance that light goes from the first surface to the image, from which on a system has no
focus: the longest telescopes have some 20, and an afocal one whose spacing is rounded to 10 um some 10 000."""
_RIM = 48


class AfocalError(PhysicalError, ValueError):
    """Parallel light leaves a system parallel: it has no focal length and makes no image."""


@dataclass(frozen=True, eq=False)
class CameraAxis:
    """The light along the axis of a camera, in the prescription frame.

    Attributes:
        direction: in which it travels, unit, (3,): along the parent axis, or along the light of the field's middle
            where none comes through along that axis.
        base: launch point of the ray that paraxial data are about, (3,), metres: on the parent axis where all mirrors
            and lenses are about it, else that of the ray through the middle of the stop.
        centre: launch point of the ray through the middle of the stop, (3,), metres.
        on_axis: whether it travels along the parent axis.
    """

    direction: np.ndarray
    base: np.ndarray
    centre: np.ndarray
    on_axis: bool

    def moved(self, pose: Pose) -> CameraAxis:
        """Return the axis of a camera whose prescription frame has a pose in the world."""
        turned = pose.rotation @ self.direction
        return CameraAxis(turned, pose.apply(self.base), pose.apply(self.centre), self.on_axis)


def find_axis(
    spec: CameraSpec, backend: Backend, to_stop: SystemBatch, imaging: SystemBatch, middle: np.ndarray
) -> tuple[CameraAxis, float]:
    """Return the axis of a camera and the radius of its stop, metres.

    The stop is as large as the file states, or as the beam along the axis makes it that has the diameter of the
    entrance pupil before the first surface: its rays are traced to the stop, and the area that they enclose there is
    the stop's.

    Args:
        spec: the camera.
        backend: where to trace.
        to_stop: one system, from the scene to the stop.
        imaging: one system, from the scene to the image.
        middle: direction of the light of the field's middle, prescription frame, (3,).

    Raises:
        AimError, BeamMissedError: no light comes through, neither along the parent axis nor along the field's middle.
    """
    try:
        return _along(spec, backend, to_stop, imaging, PARENT_AXIS)
    except (AimError, BeamMissedError):
        return _along(spec, backend, to_stop, imaging, middle)


def _along(
    spec: CameraSpec, backend: Backend, to_stop: SystemBatch, imaging: SystemBatch, direction: np.ndarray
) -> tuple[CameraAxis, float]:
    """``find_axis`` along one direction. Raises AimError, BeamMissedError."""
    start, on_axis = -LAUNCH_DISTANCE * direction, np.array_equal(direction, PARENT_AXIS)
    centre = aim_collimated(backend, to_stop, direction[None], start[None], np.zeros((1, 2)))[0][0, 0]
    optics = [mirror for mirror in spec.mirrors.values() if mirror.light != "passes"]
    centred = on_axis and not any(one.decentre or one.rotate or one.sag for one in optics)
    axis = CameraAxis(direction, start if centred else centre, centre, on_axis)
    _require_light(backend, imaging, axis.base[None], direction)
    if spec.stop_diameter is not None:
        return axis, 0.5 * spec.stop_diameter
    ring = centre + 0.5 * spec.entrance_pupil * _ring() @ transverse_axes(direction, LINE_AXIS)
    return axis, equal_area_radius(_require_light(backend, to_stop, ring, direction))


def _ring() -> np.ndarray:
    turn = 2.0 * np.pi * np.arange(_RIM) / _RIM
    return np.stack([np.cos(turn), np.sin(turn)], axis=-1)


def _require_light(backend: Backend, systems: SystemBatch, launch: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return where rays from launch points (N, 3) end on the last surface, (N, 2). Raises BeamMissedError."""
    place, _, _, valid = trace(backend, systems, make_rays(backend, launch, direction)).numpy()
    if not np.all(valid):
        raise BeamMissedError("the beam along the axis misses a surface")
    return np.asarray(place[0, :, :2])


def pupil_diameter(backend: Backend, to_stop: SystemBatch, axis: CameraAxis, radius: float) -> float:
    """Return the diameter of the entrance pupil: that of the round beam along the axis with the area of the light,
    before the first surface, that fills the stop, metres.

    Args:
        backend: where to trace.
        to_stop: one system, from the scene to the stop.
        axis: in the same frame as the system.
        radius: of the stop, metres.

    Raises:
        AimError: the beam does not reach the stop.
    """
    rays, axes = aim_collimated(backend, to_stop, axis.direction[None], axis.centre[None], radius * _ring())
    return 2.0 * equal_area_radius(rays[0] @ axes[0].T)


def axis_data(
    backend: Backend, imaging: SystemBatch, spec: CameraSpec, axis: CameraAxis, first: np.ndarray
) -> Paraxial:
    """Return the paraxial data about the axis of a camera.

    Args:
        backend: where to trace.
        imaging: one system, from the scene to the image.
        spec: the camera.
        axis: in the same frame as the system.
        first: near this direction of that frame lies the first axis of the launch plane, (3,).

    Raises:
        AfocalError: parallel light leaves the system parallel.
    """
    count, launch, direction = len(imaging.structure), axis.base[None], axis.direction[None]
    traced = trace(backend, imaging, make_rays(backend, launch, axis.direction), keep=range(count))
    hits = np.stack([traced.hit(k)[0, 0] for k in range(count)])
    world = np.einsum("kij,kj->ki", imaging.world.rotation[0], hits) + imaging.world.translation[0]
    steps = np.linalg.norm(np.diff(np.concatenate([launch, world]), axis=0), axis=-1)
    used = [k for k, mirror in enumerate(spec.mirrors.values()) if mirror.light != "passes"]
    behind = float(np.sum(steps[used[-1] + 1 :])) if used else 0.0
    before = float(np.sum(steps[: used[0] + 1])) if used else 0.0
    stop = list(spec.mirrors).index(spec.stop)
    matrix = ray_matrix(backend, imaging, stop, launch, direction, transverse_axes(direction, first[None]))
    data = paraxial(matrix, before, behind)
    # what is no number is afocal as well
    if not data.focal_length < AFOCAL * (np.sum(steps) - before):
        raise AfocalError(
            f"the system is afocal, with an angular magnification of {data.angular_magnification:.5g}: parallel light "
            "leaves it parallel, so that it has no focal length and makes no image"
        )
    return data
