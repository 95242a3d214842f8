"""Foreign prescriptions as their own programs and other people's read and trace them, for the oracle tests."""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from optics import Camera, OpticalSurface
from optics.geometry.pose import Pose
from optics.numerics.backend import Backend
from optics.raytrace.aim import AimError
from optics.raytrace.assembly import Interaction
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from optics.waves.imaging import aim_collimated
from scenes.lens.prescription import SEQUENCE, Prescription
from scenes.lens.statements import Glasses

sys.path.append(str(Path(sys.prefix, "peers")))  # ray-optics, which setup.sh --test keeps out of all else

Rays = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Positions (N, 3) and directions (N, 3) in the image's frame, metres, and optical paths (N,), metres."""
LEAST_BEAM = 1e-3
"""Radius of a beam at the stop where a file does not say it, metres."""


def beams(backend: Backend, lens: Prescription, share: float, rays: int = 60) -> list[tuple[np.ndarray, np.ndarray]]:
    """Collimated beams through the stop, one a field: launch points (N, 3), the chief ray first, and direction.

    Args:
        backend: where to trace.
        lens: the prescription.
        share: of the beam's radius at the stop, as far as the file says it; else metres.
        rays: in each beam.
    """
    bare = lens.assembly(apertures=False)
    names = [s.name for s in lens.surfaces]
    to_stop = assemble(bare, [names[: lens.stop + 1]])
    rng = np.random.default_rng(8)
    radius = share * {"diameter": 0.5, "stop": 1.0}.get(lens.pupil.kind, 0.0) * lens.pupil.value if lens.pupil else 0.0
    r, t = (radius or LEAST_BEAM) * np.sqrt(rng.uniform(size=rays)), rng.uniform(0.0, 2.0 * np.pi, rays)
    target = np.stack([r * np.cos(t), r * np.sin(t)], axis=-1)
    target[0] = 0.0
    out = []
    for x, y in dict.fromkeys(lens.fields or ((0.0, 0.0),)):
        direction = np.array([np.tan(x), np.tan(y), 1.0])
        direction /= np.linalg.norm(direction)
        try:
            launch = aim_collimated(backend, to_stop, direction, -0.01 * direction, target)[0][0]
        except AimError:  # a beam that is wider than the lens takes it
            continue
        valid = trace(backend, assemble(bare, [SEQUENCE]), make_rays(backend, launch, direction)).numpy()[3][0]
        if valid.all():
            out.append((launch, direction))
    return out


def ours(backend: Backend, lens: Prescription, launch: np.ndarray, direction: np.ndarray) -> Rays:
    """The twin's trace."""
    traced = trace(backend, assemble(lens.assembly(apertures=False), [SEQUENCE]), make_rays(backend, launch, direction))
    position, leaving, path, valid = (a[0] for a in traced.numpy())
    assert valid.all()
    return position, leaving, path


class Rayoptics:
    """ray-optics' own reading of a .zmx or .seq file."""

    def __init__(self, path: Path) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            logging.disable(logging.CRITICAL)
            try:
                if path.suffix.lower() == ".zmx":
                    from rayoptics.zemax.zmxread import read_lens_file
                else:
                    from rayoptics.codev.cmdproc import read_lens as read_lens_file
                self.model = read_lens_file(path)[0]
            finally:
                logging.disable(logging.NOTSET)
        self.sequence = self.model["seq_model"]
        self.sequence.gaps[0].thi = 0.0  # rays then start in the frame of the first surface, not 1e10 mm away
        self.sequence.update_model()
        self.scale = {"mm": 1e-3, "inches": 25.4e-3, "cm": 1e-2}[self.model["system_spec"].dimensions]
        self.wave = float(self.model["optical_spec"]["wvls"].central_wvl)

    def third_order(self) -> tuple[np.ndarray, float, float]:
        """Its Seidel sums by surface (K, 5), radius of the paraxial beam at the stop, and edge of the field."""
        from rayoptics.parax.thirdorder import compute_third_order

        self.sequence.gaps[0].thi = 1e10
        self.model.update_model()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            table = compute_third_order(self.model)
        marginal, chief, _ = self.model["analysis_results"]["parax_data"]
        # the part of an asphere has a row of its own, 3.asp
        rows = table.drop(index="sum")
        sums = rows.groupby(lambda label: int(str(label).partition(".")[0]), sort=True).sum().to_numpy(float)
        return (
            self.scale * sums,
            self.scale * abs(marginal[self.sequence.stop_surface][0]),
            float(np.arctan(chief[0][1])),
        )

    def fan(self) -> tuple[tuple[float, float], np.ndarray, np.ndarray, np.ndarray, float]:
        """Field, radians, and its fan along y at the end of the field.

        Where the rays cross the stop, positions relative to the chief ray and optical path differences, metres, (N,),
        and the radius of its reference sphere, metres.
        """
        from rayoptics.raytr.analyses import RayFan

        self.sequence.gaps[0].thi = 1e10
        self.model.update_model()
        fields = self.model["optical_spec"]["fov"].fields
        fan = RayFan(self.model, f=len(fields) - 1, num_rays=21, xyfan="y")
        dx, dy, waves = np.array([values for _, values in fan.fan], float).T
        assert not dx.any()
        heading = np.asarray(fields[-1].chief_ray[0][0][0][1])
        x, y = heading[:2] / heading[2]
        stop = self.scale * np.array([ray[2][0][self.sequence.stop_surface][0][1] for ray in fan.fan_pkg[0]])
        radius = self.scale * float(fields[-1].ref_sphere[2])
        return (float(np.arctan(x)), float(np.arctan(y))), stop, self.scale * dy, 1e-9 * self.wave * waves, radius

    def glasses(self) -> list[tuple[str, float]]:
        """Names and indices of its glasses, in the order of the light."""
        surfaces = self.sequence.ifcs[: len(self.sequence.gaps)]
        # behind a mirror stands what stood before it
        entered = [g.medium for s, g in zip(surfaces, self.sequence.gaps, strict=True) if s.interact_mode != "reflect"]
        indices = [(medium.name(), float(medium.rindex(self.wave))) for medium in entered]
        return [(name, index) for name, index in indices if abs(index - 1.0) > 1e-3]

    def trace(self, launch: np.ndarray, direction: np.ndarray, image: Pose) -> Rays:
        """Through all surfaces, and on to an image plane in the frame of the first surface."""
        from rayoptics.raytr.raytrace import trace_raw

        first, last = (
            Pose(turn, np.asarray(shift) * self.scale) for turn, shift in (self.sequence.gbl_tfrms[k] for k in (0, -1))
        )
        own = image.inverse() @ last
        place, heading, length = [], [], []
        for point in launch:
            start = first.inverse().apply(point) / self.scale
            path = list(self.sequence.path(self.wave))
            ray, path_length, _ = trace_raw(
                iter(path), start, first.rotation.T @ direction, self.wave, intersect_obj=False
            )
            p, d = own.apply(np.asarray(ray[-1][0]) * self.scale), own.rotation @ np.asarray(ray[-1][1])
            # its image stands without the defocus that the file gives it
            step = -p[2] / d[2]
            place.append(p + step * d)
            heading.append(d)
            length.append(path_length * self.scale + step)
        return np.array(place), np.array(heading), np.array(length)


class Optiland:
    """optiland's own reading of a .zmx or .seq file."""

    def __init__(self, path: Path) -> None:
        from optiland.fileio import load_codev_file, load_zemax_file

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self.optic = (load_zemax_file if path.suffix.lower() == ".zmx" else load_codev_file)(str(path))
            self.wave = float(self.optic.primary_wavelength)
        for surface in self.optic.surfaces:
            if hasattr(surface.geometry, "tol"):
                surface.geometry.tol = 1e-14
            surface.aperture = None

    def glasses(self) -> list[tuple[str, float]]:
        """Names and indices of its glasses, in the order of the light."""
        out = []
        for surface in self.optic.surfaces:
            index = float(np.ravel(surface.material_post.n(self.wave))[0])
            if abs(index - 1.0) > 1e-3 and not surface.interaction_model.is_reflective:
                out.append((str(getattr(surface.material_post, "name", "")), index))
        return out

    def trace(self, launch: np.ndarray, direction: np.ndarray, image: Pose) -> Rays:
        """Through all surfaces to its own image, in that image's frame."""
        from optiland.rays import RealRays

        n = len(launch)
        columns = [np.array(1e3 * launch[:, i]) for i in range(3)] + [np.full(n, direction[i]) for i in range(3)]
        rays = RealRays(*columns, np.ones(n), np.full(n, self.wave))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self.optic.surfaces.trace(rays, record=False)
            frame = self.optic.surfaces[-1].geometry.cs
            turn, shift = frame.get_rotation_matrix(), frame.position_in_gcs
        own = Pose(np.asarray(turn), np.array([float(np.ravel(c)[0]) for c in shift]) * 1e-3).inverse()
        place = own.apply(1e-3 * np.stack([rays.x, rays.y, rays.z], axis=-1))
        heading = np.stack([rays.L, rays.M, rays.N], axis=-1) @ own.rotation.T
        return place, heading, 1e-3 * np.asarray(rays.opd)


class AnyGlass(dict):  # type: ignore[type-arg]
    """Glasses of any name, each with an index of its own."""

    def get(self, key: str, default: Any = None) -> Callable[[float], float]:
        """Some index."""
        index = self.setdefault(key, 1.5 + 0.01 * len(self))
        return lambda wavelength: index


def read_alike(read: Callable[[Path, Glasses], Prescription], path: Path, peer: Any) -> Prescription:
    """Our reading with the other program's indices, for a comparison of geometry and not of catalogues."""
    lens = read(path, AnyGlass())
    indices, surfaces, index = [n for _, n in peer.glasses()], [], 1.0
    for surface in lens.surfaces:
        if surface.interaction is Interaction.REFRACT:
            index = indices.pop(0) if surface.glass else 1.0
        surfaces.append(replace(surface, index=index))
    assert not indices, "other glasses"
    return replace(lens, surfaces=tuple(surfaces))


def typed(lens: Prescription, diameter: float) -> Camera:
    """The centred surfaces as a user types them, the stop of a diameter in metres."""
    places = [s.pose.translation[2] for s in lens.surfaces] + [lens.image.pose.translation[2]]
    rows, index = [], 1.0
    for s, step in zip(lens.surfaces, np.diff(places), strict=True):
        mirror = s.interaction is Interaction.REFLECT
        index = s.index if s.interaction is Interaction.REFRACT else index
        radius = 1.0 / s.surface.curvature if s.surface.curvature else np.inf
        rows.append(
            OpticalSurface(radius, step, s.surface.conic, "mirror" if mirror else index, asphere=s.surface.even)
        )
    rows[lens.stop] = replace(rows[lens.stop], diameter=diameter)
    return Camera(rows, lens.wavelength, stop=lens.stop)


def differences(first: Rays, second: Rays) -> dict[str, float]:
    """Largest differences of positions (m), directions and optical paths less the chief ray's (m), and of spots (m)."""

    def spot(place: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.sum((place[:, :2] - place[:, :2].mean(axis=0)) ** 2, axis=-1))))

    def wave(rays: Rays) -> np.ndarray:
        return np.asarray(rays[2] - rays[2][0])

    return {
        "position": float(np.max(np.abs(first[0] - second[0]))),
        "direction": float(np.max(np.abs(first[1] - second[1]))),
        "spot": abs(spot(first[0]) - spot(second[0])),
        "path": float(np.max(np.abs(wave(first) - wave(second)))),
    }


OVER = np.diag([1.0, -1.0, -1.0])
"""batoid's light comes down from +z, the twin's enters toward +z: half a turn about x."""


def batoid_beam(
    telescope: Any, wavelength: float, x: float = 0.0, y: float = 0.0
) -> tuple[np.ndarray, np.ndarray, Rays, np.ndarray]:
    """Trace a beam over the entrance pupil of a telescope of batoid, told in the twin's axes.

    Args:
        telescope: a ``batoid.Optic``.
        wavelength: metres.
        x: field angle, radians.
        y: likewise.

    Returns:
        Launch points (N, 3), directions (N, 3), what batoid makes of them at its detector, and which rays failed.
    """
    import batoid

    index = float(telescope.inMedium.getN(wavelength))
    beam = batoid.RayVector.asPolar(optic=telescope, wavelength=wavelength, theta_x=x, theta_y=y, nrad=8, naz=40)
    start, heading, begun = beam.r @ OVER, index * beam.v @ OVER, np.array(beam.t)
    out = telescope.trace(beam.copy())
    out.toCoordSys(telescope.itemDict[list(telescope.itemDict)[-1]].coordSys)
    return start, heading, (out.r @ OVER, index * out.v @ OVER, out.t - begun), np.array(out.failed)
