"""Lens and CCD of the lines of a payload."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from scenes.three_line_camera import ThreeLineCameraSpec
from twin.orbit.images.line_optics import LineOptics

if TYPE_CHECKING:
    from scenes.detector import DetectorSpec


def optics_of(
    camera: ThreeLineCameraSpec, lines: tuple[str, ...], line_time: float, detectors: Mapping[str, DetectorSpec]
) -> dict[str, LineOptics]:
    """Lens and CCD of lines; lines that are made alike share them.

    Raises:
        ValueError: a line without an image section.
    """
    made: dict[tuple[object, ...], LineOptics] = {}
    out = {}
    for name in lines:
        image = camera.image_of(name)
        if image is None:
            raise ValueError(f"{camera.name} does not say how its line {name} forms an image")
        key = image.model_dump_json(), camera.pixels_of(name), camera.pitch_of(name)
        if key not in made:
            sheet = detectors[image.detector]
            made[key] = LineOptics.from_specs(image, camera.pixels_of(name), camera.pitch_of(name), line_time, sheet)
        out[name] = made[key]
    return out
