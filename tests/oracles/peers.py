"""The reference cameras in other people's ray tracers, for the oracle tests and the benchmark."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from optics.geometry.aperture import Circle
from scenes.models.camera_model import IMAGE, CameraModel
from tests.own_trace import OwnCamera


def batoid_camera(model: CameraModel, apertures: bool = False) -> Any:
    """Return the camera as a ``batoid.CompoundOptic`` in the prescription frame; surfaces keep their names.

    Glasses of lenses are Sellmeier's (formula 2, or of the catalogue) in air.
    """
    import batoid

    from optics.materials.glass import glass

    air = batoid.ConstMedium(1.0)
    items, inside = [], air
    for name, surface in model.surfaces.items():
        shape: Any = batoid.Plane()
        if surface.curvature:
            radius = 1.0 / surface.curvature
            shape = batoid.Quadric(radius, surface.conic)
            if surface.even:
                shape = batoid.Asphere(radius, surface.conic, list(surface.even))
        stand, face = batoid.CoordSys(origin=model.vertex(name)), model.spec.mirrors[name]
        if face.light is None:
            blocked = None
            if apertures:
                edge = model.apertures[name]
                clear: Any = batoid.ObscCircle(edge.radius, *edge.centre) if isinstance(edge, Circle) else None
                clear = clear or batoid.ObscRectangle(2.0 * edge.half_x, 2.0 * edge.half_y, *edge.centre)
                blocked = batoid.ObscNegation(clear)
            items.append(batoid.Mirror(shape, name=name, coordSys=stand, obscuration=blocked))
            continue
        behind = air
        if face.glass is not None:
            b_and_c = face.glass.coefficients
            own = None if b_and_c else glass(face.glass.name)
            b, c = (b_and_c[0::2], b_and_c[1::2]) if own is None else (own.b, own.c)
            behind = batoid.SellmeierMedium(*b, *c)
        items.append(batoid.RefractiveInterface(shape, name=name, coordSys=stand, inMedium=inside, outMedium=behind))
        inside = behind
    stand = batoid.CoordSys(origin=[0.0, 0.0, model.spec.image.z])
    items.append(batoid.Detector(batoid.Plane(), name=IMAGE, coordSys=stand))
    return batoid.CompoundOptic(items, name=model.spec.name)


def batoid_rays(position: np.ndarray, direction: np.ndarray, wavelength: float = 650e-9) -> Any:
    """A ``batoid.RayVector`` from arrays (N, 3); its time counts metres of optical path."""
    import batoid

    n = len(position)
    both = (position, np.broadcast_to(direction, position.shape))
    columns = [np.ascontiguousarray(a[:, i]) for a in both for i in range(3)]
    return batoid.RayVector(*columns, np.zeros(n), np.full(n, wavelength))


@dataclass(frozen=True, eq=False)
class PeerRays:
    """Rays at the image in the prescription frame: places r and directions v, (N, 3), metres, and paths t, (N,)."""

    r: np.ndarray
    v: np.ndarray
    t: np.ndarray


Tracer = Callable[[np.ndarray, np.ndarray, float], PeerRays]
"""From points (N, 3) of a plane wavefront along a direction (3,) at a wavelength, metres."""


def _by_batoid(model: CameraModel) -> Tracer:
    peer = batoid_camera(model)

    def trace(start: np.ndarray, direction: np.ndarray, wavelength: float) -> PeerRays:
        rays = batoid_rays(start, direction, wavelength)
        peer.trace(rays)
        assert not np.any(rays.vignetted | rays.failed)
        rays.toCoordSys(type(peer.items[-1].coordSys)())
        return PeerRays(rays.r, rays.v, rays.t)

    return trace


def _by_optiland(model: CameraModel) -> Tracer:
    """With optiland's own glasses, by name."""
    optic = optiland_camera(model)
    for surface in optic.surfaces:
        if hasattr(surface.geometry, "tol"):
            surface.geometry.tol = 1e-14

    def trace(start: np.ndarray, direction: np.ndarray, wavelength: float) -> PeerRays:
        rays = optiland_rays(start, direction, 1e6 * wavelength)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numba's remarks on optiland's code
            optic.surfaces.trace(rays, record=False)
        place, way = np.stack([rays.x, rays.y, rays.z], axis=-1), np.stack([rays.L, rays.M, rays.N], axis=-1)
        return PeerRays(place, way, np.asarray(rays.opd))

    return trace


def _by_numpy(model: CameraModel) -> Tracer:
    """With the glasses of ``tests.own_trace``."""
    own = OwnCamera(model.spec)

    def trace(start: np.ndarray, direction: np.ndarray, wavelength: float) -> PeerRays:
        rays = own.trace(start, direction, wavelength)
        assert np.all(rays.known)
        return PeerRays(rays.place + np.array([0.0, 0.0, model.spec.image.z]), rays.way, rays.path)

    return trace


LENSES: dict[str, Callable[[CameraModel], Tracer]] = {
    "batoid": _by_batoid,
    "optiland": _by_optiland,
    "numpy": _by_numpy,
}
"""Programs that trace cameras with lenses at any wavelength, by name."""


GLASSES = {"N-BK7": ("N-BK7", "schott"), "F2": ("F2", "schott"), "fused silica": ("SiO2", "Malitson")}
"""Names here -> optiland's material and its source."""


def optiland_camera(model: CameraModel, apertures: bool = False, unit: float = 1.0) -> Any:
    """Return the camera as an ``optiland.optic.Optic`` in the prescription frame, in metres, or in a unit of as many
    metres; what optiland tells in waves is meant for millimetres.
    """
    from optiland.materials import Material
    from optiland.optic import Optic
    from optiland.physical_apertures import RadialAperture, RectangularAperture

    optic, spec = Optic(), model.spec
    optic.surfaces.add(index=0, z=-np.inf)
    for i, (name, surface) in enumerate(model.surfaces.items(), start=1):
        face, clear = spec.mirrors[name], None
        if apertures:
            edge = model.apertures[name]
            bounds = [side / unit for side in edge.bounds]
            clear = RadialAperture(edge.radius / unit) if isinstance(edge, Circle) else RectangularAperture(*bounds)
        shape: dict[str, Any] = {"surface_type": "standard"}
        if surface.even:
            terms = [0.0, *(a * unit ** (2 * n + 3) for n, a in enumerate(surface.even))]
            shape = {"surface_type": "even_asphere", "coefficients": terms}
        material: Any = "mirror" if face.light is None else "air"
        if face.glass is not None:
            material = Material(*GLASSES[face.glass.name])
        radius = 1.0 / surface.curvature / unit if surface.curvature else np.inf
        shape |= {"radius": radius, "conic": surface.conic, "material": material, "aperture": clear}
        optic.surfaces.add(index=i, z=float(model.vertex(name)[2]) / unit, is_stop=name == spec.stop, **shape)
    optic.surfaces.add(index=len(model.surfaces) + 1, z=spec.image.z / unit)
    optic.wavelengths.add(1e6 * spec.wavelength, is_primary=True)
    return optic


def optiland_rays(position: np.ndarray, direction: np.ndarray, micrometres: float = 0.65) -> Any:
    """Return ``optiland`` rays from arrays (N, 3)."""
    from optiland.rays import RealRays

    n = len(position)
    both = (position, np.broadcast_to(direction, position.shape))
    columns = [np.array(a[:, i]) for a in both for i in range(3)]
    return RealRays(*columns, np.ones(n), np.full(n, micrometres))
