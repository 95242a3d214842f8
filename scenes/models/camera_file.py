"""A camera's file with another image plane: all else in it, comments included, stays as it is."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from scenes.models.camera_design import camera_file
from scenes.models.camera_sharpness import FocalPlane
from scenes.specs.camera import CameraSpec, ImageSpec
from scenes.yaml.units import ANGLE, LENGTH, format_quantity


def with_plane(camera: CameraSpec, plane: FocalPlane) -> CameraSpec:
    """The camera with another image plane; it remembers where it was read."""
    image = ImageSpec.model_construct(z=plane.z, tilt=plane.tilt or None)
    moved = camera.model_copy(update={"image": image}).with_source(camera.source)
    assert isinstance(moved, CameraSpec)
    return moved


def file_with_plane(camera: CameraSpec, plane: FocalPlane, name: str) -> str:
    """Text of the camera's file with another image plane and name.

    Data sheets that it names by a path relative to itself are named by their whole path, for the new file may stand
    elsewhere. A camera that has no file of its own gets one without comments.

    Args:
        camera: as it was read.
        plane: where its image is to be.
        name: of the new camera.

    Raises:
        OSError: the camera's file is not there any more.
    """
    source = camera.source
    if source.prefix or not source.file:
        moved = with_plane(camera, plane).model_copy(update={"name": name})
        return camera_file(moved, f"The image plane of {camera.name} moved by python -m twin.camera --refocus.")
    yaml = YAML(typ="rt", pure=True)
    yaml.preserve_quotes = True
    yaml.width = 140
    text = Path(source.file).read_text("utf-8-sig")
    data: Any = yaml.load(text)
    data["name"] = name
    data["image"]["z"] = format_quantity(plane.z, LENGTH)
    if plane.tilt:
        data["image"]["tilt"] = format_quantity(plane.tilt, ANGLE)
    else:
        data["image"].pop("tilt", None)
    for band in (data.get("bands") or {}).values():
        sheet = str(band["detector"])
        if "/" in sheet or sheet.endswith((".yaml", ".yml")):
            band["detector"] = str((Path(source.file).parent / sheet).resolve())
    out = io.StringIO()
    yaml.dump(data, out)
    return out.getvalue()
