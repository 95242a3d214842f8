"""Prescription of a camera's file as an `optics.Camera`, for the functions of the library `optics`."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from optics.camera.prescription import MIRROR, Camera, OpticalSurface
from optics.geometry.aperture import Circle, Ray
from optics.materials.glass import refractive_index
from scenes.models.camera_model import CameraModel
from scenes.specs.camera import CameraSpec
from scenes.yaml.errors import KeyPath

_EDGES = "one clear circle, one blocking circle and vanes about one centre, at the stop about its middle"


def optics_camera(model: CameraModel, wavelength: float) -> Camera:
    """Return the nominal camera as an `optics.Camera`, whose frame is that of the file moved to the first vertex.

    Parameters
    ----------
    model : CameraModel
        The camera.
    wavelength : float
        Wavelength of the light, metres.

    Raises
    ------
    InputError
        `optics.Camera` cannot describe the camera: a surface has terms of ``sag`` or other edges than circles and vanes
        about one centre, or vertices in another order than that of the light.
    """
    spec = model.spec
    heights = [*(mirror.z for mirror in spec.mirrors.values()), spec.image.z]
    surfaces: list[OpticalSurface] = []
    medium: str | float = 1.0
    for (name, mirror), thickness in zip(spec.mirrors.items(), np.diff(heights), strict=True):
        if mirror.sag:
            problem = f"optics.Camera has conics and even aspheric terms only, and {name} has further terms of its sag"
            raise spec.error(problem, ("mirrors", name, "sag"), allowed="radius, conic and aspheric")
        shape, light = model.surfaces[name], mirror.light
        if light == "refracts":
            medium = _material(spec, name, wavelength)
        x, y = mirror.decentre or (0.0, 0.0)
        outer, inner, vanes, centre = _edges(model, name)
        surface = OpticalSurface(
            radius=mirror.radius,
            thickness=float(thickness),
            conic=shape.conic,
            material=MIRROR if light is None else medium,
            diameter=2.0 * outer,
            inner_diameter=2.0 * inner,
            vanes=vanes,
            offset=centre,
            asphere=shape.even,
            decenter=(x, y),
            tilt=mirror.rotate or (0.0, 0.0, 0.0),
        )
        surfaces.append(surface)
    try:
        tilt = (spec.image.tilt or 0.0, 0.0, 0.0)
        return Camera(surfaces, wavelength, model.mirrors.index(spec.stop), tilt, spec.medium or "vacuum")
    except ValueError as error:  # a thickness against the light
        problem = f"optics.Camera cannot describe this camera: {error}"
        raise spec.error(problem, ("mirrors",), allowed="vertices in the order of the light") from error


def _material(spec: CameraSpec, name: str, wavelength: float) -> str | float:
    """Return the glass behind a lens face by name where the catalogue has it, else its refractive index."""
    index, glass = spec.index_behind(name, wavelength), spec.mirrors[name].glass
    with suppress(ValueError):  # the catalogue does not have the glass, or not at this wavelength
        if glass is not None and refractive_index(glass.name, wavelength, spec.medium or "vacuum") == index:
            return glass.name
    return index


def _edges(model: CameraModel, name: str) -> tuple[float, float, tuple[tuple[float, float], ...], tuple[float, float]]:
    """Return the edges of a surface: radii of its rim and of its hole, vanes, and their common centre, metres.

    Raises
    ------
    InputError
        `OpticalSurface` cannot describe these edges.
    """
    key: KeyPath = ("mirrors", name, "edges")
    rims: list[float] = []
    holes: list[float] = []
    vanes: list[tuple[float, float]] = []
    centres: list[tuple[float, float]] = []
    if name == model.spec.stop:
        x_min, x_max, y_min, y_max = model.apertures[name].bounds
        rims.append(0.5 * (x_max - x_min))
        centres.append((0.5 * (x_min + x_max), 0.5 * (y_min + y_max)))
    other = False
    for edge in model.edges.get(name, ()):
        shape = edge.shape
        if isinstance(shape, Circle):
            (holes if edge.blocks else rims).append(shape.radius)
            holes += [shape.inner] if shape.inner and not edge.blocks else []
            other = other or bool(edge.blocks and shape.inner)
        elif isinstance(shape, Ray) and edge.blocks:
            vanes.append((shape.width, edge.rotation))
        else:
            other = True
        centres.append(shape.centre)
    if other or len(rims) > 1 or len(holes) > 1 or len(set(centres)) > 1:
        raise model.spec.error(f"optics.Camera cannot describe the edges of {name}", key, allowed=_EDGES)
    rim, hole, centre = (*rims, np.inf)[0], (*holes, 0.0)[0], (*centres, (0.0, 0.0))[0]
    return float(rim), hole, tuple(vanes), centre
