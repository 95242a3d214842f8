"""First-order data of a camera, and how its pixels sample the image: what stands in the first table of a design."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from optics.numerics.frozen_map import FrozenMap
from optics.raytrace.system import assemble
from scenes.models.camera_model import CameraModel, collimated, field_direction
from twin.camera.camera_optics import CameraOptics
from twin.camera.ray_paths import obscuration

_SMALL = 1e-5
"""Field angle by which the entrance pupil is found, radians: chief rays cross to its square."""

_RIM = 48
"""Rays on the edge of the stop."""


@dataclass(frozen=True, eq=False)
class FirstOrderData:
    """Of the middle of the field unless it says otherwise; lengths in metres, angles in radians.

    Attributes:
        focal_length_line, focal_length_track: change of the image's place per angle, along the line and the track.
        focal_length: their geometric mean.
        entrance_pupil: diameter.
        entrance_pupil_distance: of the entrance pupil from the first mirror, positive toward the scene.
        exit_pupil: diameter; infinite where the image space is telecentric.
        exit_pupil_distance: from the image upstream; negative where it lies behind the image.
        f_number: focal length over entrance pupil.
        working_f_number: of the round beam with the same solid angle at the image.
        working_f_number_line, working_f_number_track: 1 / (2 NA) in both directions.
        field_line, field_track: full angles of the field of view.
        image_line, image_track: length and width of the image of the field.
        plate_scale: angle per length on the image along the line, rad/m.
        pixel_angle: that a pixel of the line sees along the line.
        chief_ray_angle: of chief rays against the image's normal: in the middle, and the largest over the field.
        length: from the farthest mirror to the farthest mirror or the image along the parent axis.
        pitch: of the pixels.
        nyquist, cutoff: cycles/m; the cut-off of diffraction at the design wavelength along the line.
        sampling: lambda F / pitch along the line; 2 is Nyquist's sampling of the diffraction limit.
        airy: radius of the Airy disk.
        wavelength: of design.
        obscuration: body of the camera -> share of the beam that it takes, largest over the field; empty for none.
    """

    focal_length_line: float
    focal_length_track: float
    focal_length: float
    entrance_pupil: float
    entrance_pupil_distance: float
    exit_pupil: float
    exit_pupil_distance: float
    f_number: float
    working_f_number: float
    working_f_number_line: float
    working_f_number_track: float
    field_line: float
    field_track: float
    image_line: float
    image_track: float
    plate_scale: float
    pixel_angle: float
    chief_ray_angle: tuple[float, float]
    length: float
    pitch: float
    nyquist: float
    cutoff: float
    sampling: float
    airy: float
    wavelength: float
    obscuration: Mapping[str, float]


def first_order_data(optics: CameraOptics) -> FirstOrderData:
    """Work them out by tracing the camera as designed. Raises AimError, BeamMissedError."""
    model, backend = optics.model, optics.path.backend
    spec, first = model.spec, model.first_order
    scale = np.abs(first.scale[0])
    along, across = float(scale[0, 0]), float(scale[1, 1])
    corners = [(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)]
    turn = 2.0 * np.pi * np.arange(_RIM) / _RIM
    rim = (1.0 - 1e-9) * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    rays = optics.rays(corners, np.concatenate([np.zeros((1, 2)), rim]))
    middle = corners.index((0.0, 0.0))
    cosines = rays.direction[middle, 1:, 1::-1]  # along the line, along the track
    slant = np.arccos(np.clip(np.abs(rays.direction[:, 0, 2]), 0.0, 1.0))
    na_line, na_track = 0.5 * np.ptp(cosines, axis=0)
    round_beam = float(np.sqrt(solid_angle(cosines) / np.pi))
    places = rays.position[:, 0, 1::-1]
    z = [m.z for m in spec.mirrors.values()] + [spec.image.z]
    distance = float(first.exit_pupil_distance[0])
    working_line = 0.5 / float(na_line)
    return FirstOrderData(
        focal_length_line=along,
        focal_length_track=across,
        focal_length=float(first.focal_length[0]),
        entrance_pupil=spec.entrance_pupil,
        entrance_pupil_distance=_entrance_pupil(model, optics),
        exit_pupil=2.0 * abs(distance) * round_beam,
        exit_pupil_distance=distance,
        f_number=float(first.focal_length[0]) / spec.entrance_pupil,
        working_f_number=0.5 / round_beam,
        working_f_number_line=working_line,
        working_f_number_track=0.5 / float(na_track),
        field_line=2.0 * spec.field.x,
        field_track=2.0 * spec.field.y,
        image_line=float(np.ptp(places[:, 0])),
        image_track=float(np.ptp(places[:, 1])),
        plate_scale=1.0 / along,
        pixel_angle=spec.line.pitch / along,
        chief_ray_angle=(float(slant[middle]), float(np.max(slant))),
        length=float(max(z) - min(z)),
        pitch=spec.line.pitch,
        nyquist=optics.nyquist,
        cutoff=1.0 / (spec.wavelength * working_line),
        sampling=spec.wavelength * working_line / spec.line.pitch,
        airy=1.22 * spec.wavelength * 0.5 / round_beam,
        wavelength=spec.wavelength,
        obscuration=FrozenMap(obscuration(model, backend)),
    )


def solid_angle(cosines: np.ndarray) -> float:
    """Area in direction cosines, (N, 2), of a beam whose edge goes through evenly spread rays: that of the smooth curve
    through the polygon's corners, which is larger by what a circle is larger than its own.
    """
    u, v = cosines.T
    polygon = 0.5 * abs(float(np.sum(u * np.roll(v, -1) - v * np.roll(u, -1))))
    step = 2.0 * np.pi / len(u)
    return polygon * step / np.sin(step)


def _entrance_pupil(model: CameraModel, optics: CameraOptics) -> float:
    """Where chief rays of neighbouring fields cross before the camera: along its line of sight from the first mirror,
    positive toward the scene.
    """
    spec, backend = model.spec, optics.path.backend
    bare = model.bare_assembly(apertures=False)
    to_stop = assemble(bare, [model.mirrors[: model.mirrors.index(spec.stop) + 1]])
    steps = np.array([(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
    light = np.array([field_direction(spec, *(_SMALL * step)) for step in steps])
    start = collimated(backend, to_stop, light, np.zeros((1, 2)))[:, 0]
    # rays x(t) = start + t light: how far each has to go to meet the middle one's plane there, by least squares
    apart, turned = start[1:] - start[0], light[1:] - light[0]
    way = -float(np.sum(apart * turned) / np.sum(turned * turned))
    crossing = model.camera_frame.inverse().apply(start[0] + way * light[0])
    return float(crossing[2])
