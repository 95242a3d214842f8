"""Conversion between a camera's file, the prescription that an optimisation varies, and the file of its result."""

import io
from pathlib import Path
from typing import Any, Self

import numpy as np
from ruamel.yaml import YAML

from optics.design.merit_function import Beams, Operands, Prescription, Variable, VertexPose
from optics.geometry.surface import plane
from optics.numerics import quadrature
from scenes.models.camera_model import IMAGE, surface_of
from scenes.models.camera_sharpness import FocalPlane
from scenes.specs.camera import CameraDesignSpec, CameraSpec
from scenes.specs.load import load_camera
from scenes.specs.resolved import ExperimentSetup
from scenes.yaml.errors import unknown
from scenes.yaml.units import ANGLE, LENGTH, format_quantity

_RINGS = 5
_ACROSS, _ALONG = (0.0, 0.5, 1.0), (-1.0, 0.0, 1.0)
"""Coordinates x and y of a design's field points, as fractions of the half angles; the others follow by symmetry."""


class CameraDesignSetup(ExperimentSetup[CameraDesignSpec]):
    """Optimisation task of a file, with the camera from which it starts."""

    camera: CameraSpec

    @classmethod
    def parts(cls, test: CameraDesignSpec) -> dict[str, Any]:
        """Read the start camera that the file names; return field name -> content."""
        return {"camera": load_camera(test.camera, test, ("camera",))}

    def checked(self) -> Self:
        """Check that the camera can be optimised and has the surfaces that ``vary`` names; return the set-up."""
        self.camera.require_mirrors("a camera that is optimised", on_axis=True)
        known = (*self.camera.mirrors, IMAGE)
        for name in self.test.vary:
            if name not in known:
                raise self.test.error(unknown("no such mirror", name, known), ("vary", name))
        return self


def prescription_of(camera: CameraSpec) -> Prescription:
    """Return the optical prescription of a camera's file."""
    surfaces = {name: surface_of(mirror) for name, mirror in camera.mirrors.items()}
    image = VertexPose(camera.image.z, tilt=camera.image.tilt or 0.0)
    vertices = {n: VertexPose(m.z) for n, m in camera.mirrors.items()}
    return Prescription({**surfaces, IMAGE: plane()}, {**vertices, IMAGE: image}, camera.stop, camera.field_bias)


def beams_of(camera: CameraSpec) -> Beams:
    """Return the beams of nine field points in one half of the camera's field; the other half follows by symmetry."""
    fields = [(x * camera.field.x, y * camera.field.y) for x in _ACROSS for y in _ALONG]
    return Beams(np.array(fields), camera.entrance_pupil, quadrature.disk(_RINGS))


def operands_of(setup: CameraDesignSetup, principal_distance: float, envelope: float) -> Operands:
    """Return the operands (targets and constraints) of the optimisation's merit function.

    Parameters
    ----------
    setup : CameraDesignSetup
        The optimisation task.
    principal_distance : float
        Principal distance of the start camera along the line, in metres, to be kept.
    envelope : float
        Extent of the start camera along the parent axis, in metres.
    """
    test, camera = setup.test, setup.camera
    largest = None if test.envelope is None else test.envelope * envelope
    asked = camera.wavelength, principal_distance, largest, test.clearance, camera.edge_margin
    return Operands(*asked, anamorphism=test.anamorphism)


def variables_of(spec: CameraDesignSpec) -> tuple[Variable, ...]:
    """Return the numbers that the optimisation varies; radii of curvature vary as curvatures, in 1/m."""
    return tuple(
        Variable(name, "curvature" if quantity == "radius" else quantity)
        for name, quantities in spec.vary.items()
        for quantity in quantities
    )


def camera_of(start: CameraSpec, prescription: Prescription, name: str, description: str) -> CameraSpec:
    """Return the camera with an optimised prescription; everything but its optics is that of the start camera.

    Raises
    ------
    ValueError
        Mirrors are tilted or surfaces decentred, which a camera's file cannot hold.
    """
    image = prescription.poses[IMAGE]
    if image.y or any(pose.y or pose.tilt for n, pose in prescription.poses.items() if n != IMAGE):
        raise ValueError("a camera's file has no place for tilted or decentred surfaces")
    mirrors = {}
    for mirror in start.mirrors:
        surface = prescription.surfaces[mirror]
        terms = {f"A{2 * n + 4}": a for n, a in enumerate(surface.even)}
        numbers = {"z": prescription.poses[mirror].z, "radius": 1.0 / surface.curvature, "conic": surface.conic}
        mirrors[mirror] = start.mirrors[mirror].model_copy(update={**numbers, "aspheric": terms})
    update = {
        "name": name,
        "description": description or start.description,
        "mirrors": mirrors,
        "image": start.image.model_copy(update={"z": image.z, "tilt": image.tilt or None}),
        "field_bias": prescription.field_bias,
    }
    return start.model_copy(update=update)


def with_plane(camera: CameraSpec, plane: FocalPlane) -> CameraSpec:
    """Return the camera with another image plane, keeping the location from which it was read."""
    image = camera.image.model_copy(update={"z": plane.z, "tilt": plane.tilt or None})
    return camera.model_copy(update={"image": image}).with_source(camera.source)


def file_with_plane(camera: CameraSpec, plane: FocalPlane, name: str) -> str:
    """Return the text of the camera's file with another image plane and name.

    Data sheets that it names by a path relative to itself get their absolute path, since the new file may be stored
    elsewhere. A camera without a file of its own gets one without comments.

    Parameters
    ----------
    camera : CameraSpec
        The camera as it was read.
    plane : FocalPlane
        New image plane.
    name : str
        Name of the new camera.

    Raises
    ------
    OSError
        The camera's file no longer exists.
    """
    source = camera.source
    if source.prefix or not source.file:
        moved = with_plane(camera, plane).model_copy(update={"name": name})
        return moved.file_text(f"The image plane of {camera.name} moved by python -m twin.camera --refocus.")
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
    sheets_by_path(data.get("bands") or {}, Path(source.file).parent)
    out = io.StringIO()
    yaml.dump(data, out)
    return out.getvalue()


def sheets_by_path(bands: Any, folder: Path) -> Any:
    """Return the bands of a camera's file, changed in place: data sheets beside it have their absolute path."""
    for band in bands.values():
        sheet = str(band["detector"])
        if "/" in sheet or sheet.endswith((".yaml", ".yml")):
            band["detector"] = str((folder / sheet).resolve())
    return bands
