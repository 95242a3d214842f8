"""Sharpness of a camera as designed, from a few hundred rays, and the position of its best focal plane.

Wavefront errors follow ``optics.waves.imaging``: rms over the stop about the sphere centred on the chief ray's image,
piston and tilt removed, in waves of the camera's design wavelength. The best focal plane has the smallest mean square
error over the field.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from optics.geometry import zernike
from optics.numerics import quadrature
from optics.numerics.backend import Backend
from optics.numerics.quadrature import PupilNodes
from optics.raytrace.aim import AimError
from optics.raytrace.system import assemble
from optics.raytrace.trace import BeamMissedError, make_rays, require_rays, trace
from optics.waves.imaging import path_to_sphere
from scenes.models.camera_model import CameraModel, collimated, coloured, derive_camera, field_direction
from scenes.specs.camera import CameraSpec
from scenes.yaml.errors import InputError, Issue
from scenes.yaml.spec import Spec

BLURRED = 0.25
"""Wavefront error above which a camera is reported as blurred, waves rms. It is a Strehl ratio of 0.08, and for the
library's cameras nearly no contrast at the Nyquist frequency. Marechal's limit of a sharp camera is 1/14.
"""

FIELDS = tuple((x, y) for x in (-1.0, -0.5, 0.0, 0.5, 1.0) for y in (-1.0, 0.0, 1.0))
"""Fields at which a camera is assessed and its focus sought, as fractions of the half field along the line and along
the track.
"""

_RINGS = 3
"""Rings of the quadrature over the stop: exact for squares of wavefronts to fifth order."""

EVEN = 10_000
"""Number of rays, evenly distributed over the stop, in a beam that edges of surfaces vignette. The vignetted fraction
is then right to 0.1 % and the rms wavefront error of the rest to 0.2 % (Hyper Suprime-Cam at nine fields, compared
with a million rays). Gauss' rule on rings was wrong by up to a fifth, since an edge may run along a ring.
"""

_STEPS = 6
_DIFFERENCE = 1e-4
"""Step of the focal plane for derivatives, metres and radians: far above rounding, and the errors are linear over it.
"""

_FEW_FIELDS = tuple((x, y) for x in (0.0, 1.0) for y in (-1.0, 0.0, 1.0))
"""Fields of the quick check, as fractions of the half field along the line and along the track: one half of the field
suffices, since a camera of surfaces of revolution is symmetric about a plane.
"""


@dataclass(frozen=True)
class FocalPlane:
    """Position and tilt of a camera's image plane.

    Attributes
    ----------
    z : float
        Position at which it crosses the parent axis, in metres.
    tilt : float
        Rotation about the prescription's x at the parent axis, in radians; 0 is square to the axis.
    """

    z: float
    tilt: float = 0.0

    @classmethod
    def of(cls, camera: CameraSpec) -> FocalPlane:
        """Return the position and tilt of the image plane that a camera's file gives."""
        return cls(camera.image.z, camera.image.tilt or 0.0)


MIN_ILLUMINATED = 20
"""Smallest number of the ``EVEN`` rays that must pass a field's edges; with fewer, two in a thousand, no error is
computed.
"""

Vignetting = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function that returns which rays are blocked by bodies about a camera.

Its arguments are F fields, (F, 2), as fractions of the half field, and N points of the stop, (N, 2), in units of its
radius; its result is a mask, (F, N).
"""


def stop_nodes(model: CameraModel, rings: int, vignetted: bool = False) -> PupilNodes:
    """Return the points of the stop, with quadrature weights, at which a camera's light is evaluated.

    Where nothing but the stop limits a beam, these are Gauss' rule with ``rings`` rings, exact for smooth wavefronts.
    Where edges vignette it they are ``EVEN`` points regardless of the rings, so that all results of such a beam use the
    same rays.

    Parameters
    ----------
    model : CameraModel
        The camera.
    rings : int
        Number of rings of Gauss' rule.
    vignetted : bool
        Whether bodies about the camera vignette the beam, too.
    """
    return quadrature.even_disk(EVEN) if model.edges or vignetted else quadrature.disk(rings)


@dataclass(frozen=True, eq=False)
class FieldBeams:
    """Beams of F fields near the image, in the prescription frame: the chief ray of each, then N rays of a quadrature.

    Attributes
    ----------
    camera : CameraSpec
        The camera.
    fields : (F, 2) ndarray
        Fields as fractions of the half field.
    nodes : PupilNodes
        The N nodes of the stop.
    position, direction : (F, 1 + N, 3) ndarray
        Points on the rays, in metres, and unit vectors.
    path : (F, 1 + N) ndarray
        Optical path from the incoming wavefront, in metres.
    exit_pupil : float
        Distance from the specified image plane upstream to the exit pupil, in metres.
    room : (F,) ndarray
        Distance from the last mirror along the chief ray to the specified image plane, in metres.
    illuminated : (F, N) ndarray of bool or None
        Rays that are not vignetted; None if none is.
    """

    camera: CameraSpec
    fields: np.ndarray
    nodes: PupilNodes
    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray
    exit_pupil: float
    room: np.ndarray
    illuminated: np.ndarray | None = None

    @classmethod
    def trace(
        cls,
        model: CameraModel,
        backend: Backend,
        fields: tuple[tuple[float, float], ...],
        rings: int,
        vignetting: Vignetting | None = None,
        wavelength: float | None = None,
    ) -> FieldBeams:
        """Trace the beams through the camera as designed, limited by the stop, surface edges and ``vignetting``.

        ``wavelength`` is that of the light, in metres, by default the design wavelength. Errors stay in waves of the
        design wavelength.

        Raises
        ------
        AimError, BeamMissedError
            Light of a field does not come through.
        InputError
            Edges block all of it.
        ValueError
            The index of a glass is not known at the wavelength.
        """
        spec, nodes = model.spec, stop_nodes(model, rings, vignetting is not None)
        bare = model.bare_assembly(apertures=False)
        states = [coloured(spec, "", {}, spec.wavelength if wavelength is None else wavelength)]
        to_stop = assemble(bare, [model.mirrors[: model.mirrors.index(spec.stop) + 1]], states)
        directions = np.array([field_direction(spec, x * spec.field.x, y * spec.field.y) for x, y in fields])
        radius = float(model.apertures[spec.stop].bounds[1])
        points = radius * np.concatenate([np.zeros((1, 2)), np.stack([nodes.x, nodes.y], axis=-1)])
        launch = collimated(backend, to_stop, directions, points)
        heading = np.broadcast_to(directions[:, None], launch.shape)
        rays = make_rays(backend, launch.reshape(-1, 3), heading.reshape(-1, 3))
        last = len(model.mirrors) - 1
        stored = {model.mirrors.index(name) for name in model.edges} | {last}
        traced = trace(backend, assemble(bare, ["imaging"], states), rays, keep=stored, world=True)
        assert traced.world is not None
        position, direction, path, valid = traced.numpy(traced.world)
        shape = launch.shape[:2]
        illuminated = None
        if model.edges:
            valid = valid[0] & model.unvignetted(lambda name: traced.hit(model.mirrors.index(name))[0])
            illuminated = valid.reshape(shape)[:, 1:]
            empty = np.flatnonzero(np.sum(illuminated, axis=-1) < MIN_ILLUMINATED)
            if empty.size:
                value = f"field {field_text(spec, fields[empty[0]])}, {empty.size} of {len(fields)} fields tested"
                key = ("mirrors", next(iter(model.edges)), "edges")
                raise spec.error(
                    "edges block practically all light", key, value=value, allowed="a smaller field, or wider edges"
                )
        if vignetting is not None:
            free = ~vignetting(np.array(fields), points[1:] / radius)
            illuminated = free if illuminated is None else illuminated & free
        require_rays(valid.reshape(shape), f"camera {spec.name}")
        position, direction = position.reshape(*shape, 3), direction.reshape(*shape, 3)
        step = position[:, 0] - model.mirror_pose(model.mirrors[last]).apply(traced.hit(last).reshape(*shape, 3)[:, 0])
        pupil, along = float(model.first_order.exit_pupil_distance[0]), np.sum(step * direction[:, 0], axis=-1)
        ends = (position, direction, path.reshape(shape))
        return cls(spec, np.array(fields), nodes, *ends, pupil, along, illuminated)

    @property
    def share(self) -> np.ndarray:
        """Fraction of the transmitted light that each of N rays carries, (N,), or (F, N) if F fields are vignetted."""
        if self.illuminated is None:
            return self.nodes.share
        share = self.nodes.share * self.illuminated
        return np.asarray(share / np.sum(share, axis=-1, keepdims=True))

    def _away(self, plane: FocalPlane) -> np.ndarray:
        """Return the distances along the rays from the image plane of the camera's file to another plane.

        Returns
        -------
        (F, 1 + N) ndarray
            Distances in metres, for F fields: the chief ray, then N rays.
        """
        point = np.array([0.0, 0.0, plane.z])
        normal = np.array([0.0, -np.sin(plane.tilt), np.cos(plane.tilt)])
        return np.asarray(((point - self.position) @ normal) / (self.direction @ normal))

    def reaches(self, plane: FocalPlane) -> bool:
        """Return True if the light meets the plane after its last mirror."""
        return bool(np.all(self.room + self._away(plane)[:, 0] > 0.0))

    def wavefronts(self, plane: FocalPlane) -> np.ndarray:
        """Return the wavefront errors on a focal plane, without piston and tilt.

        Returns
        -------
        (F, N) ndarray
            Errors of N rays of F fields, in waves; 0 for vignetted rays.
        """
        away = self._away(plane)
        position, path = self.position + away[..., None] * self.direction, self.path + away
        to_sphere = path_to_sphere(position, self.direction, path, position[:, :1], self.exit_pupil)
        basis = zernike.basis(3, self.nodes.x, self.nodes.y)
        error = (to_sphere[:, :1] - to_sphere)[:, 1:] / self.camera.wavelength
        if self.illuminated is not None:
            return np.stack(
                [_levelled(field_error, basis, share) for field_error, share in zip(error, self.share, strict=True)]
            )
        # The first three terms are orthonormal over the disk, and the rule is exact for their products.
        return np.asarray(error - (error * self.nodes.share) @ basis @ basis.T)

    def errors(self, plane: FocalPlane) -> np.ndarray:
        """Return the rms wavefront error of each of F fields on a focal plane, (F,), in waves."""
        squares = self.wavefronts(plane) ** 2
        if self.illuminated is not None:
            return np.asarray(np.sqrt(np.sum(squares * self.share, axis=-1)))
        return np.asarray(np.sqrt(squares @ self.nodes.share))

    def best_plane(self, tilt: bool = False) -> FocalPlane:
        """Return the plane (shifted, and tilted about x if ``tilt`` is set) with the smallest mean square error."""
        start, root = FocalPlane.of(self.camera), np.sqrt(self.share / len(self.fields))
        middle = float(np.mean(self.position[:, 0, 1]))

        def moved(step: np.ndarray) -> FocalPlane:
            """Return the plane shifted by ``step[0]`` and rotated by ``step[1]`` at the middle of the fields."""
            tilt_angle = start.tilt + (float(step[1]) if tilt else 0.0)
            there = start.z + middle * np.tan(start.tilt) + float(step[0])
            return FocalPlane(float(there - middle * np.tan(tilt_angle)), tilt_angle)

        def residuals(step: np.ndarray) -> np.ndarray:
            return np.asarray((self.wavefronts(moved(step)) * root).ravel())

        # Errors are nearly linear in a shift of the plane, so that Gauss-Newton steps converge at once.
        step = np.zeros(2 if tilt else 1)
        for _ in range(_STEPS):
            sides = [(residuals(step + h), residuals(step - h)) for h in _DIFFERENCE * np.eye(len(step))]
            slope = np.stack([(ahead - behind) / (2.0 * _DIFFERENCE) for ahead, behind in sides], axis=-1)
            step = step - np.linalg.lstsq(slope, residuals(step), rcond=None)[0]
        return moved(step)


def _levelled(error: np.ndarray, basis: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return errors of N rays without their best fit by piston and tilts.

    Parameters
    ----------
    error : (N,) ndarray
        Optical path differences.
    basis : (N, 3) ndarray
        Piston and the two tilts at the rays.
    share : (N,) ndarray
        Weights of the rays; the result is 0 where the weight is 0.
    """
    illuminated = share > 0.0
    root = np.sqrt(share[illuminated])
    terms, *_ = np.linalg.lstsq(basis[illuminated] * root[:, None], error[illuminated] * root, rcond=None)
    out = np.zeros(len(error))
    out[illuminated] = error[illuminated] - basis[illuminated] @ terms
    return out


@dataclass(frozen=True)
class Sharpness:
    """Result of the quick check of a camera as designed.

    Attributes
    ----------
    worst : float
        Largest wavefront error over the field, in waves rms.
    field : tuple[float, float]
        Field of that error, as fractions of the half field along the line and along the track.
    plane : FocalPlane or None
        The best focal plane; None for a sharp camera, and where light has no focus after its last mirror.
    refocused : float
        Largest error over the field on that plane, in waves rms.
    """

    worst: float
    field: tuple[float, float]
    plane: FocalPlane | None = None
    refocused: float = np.nan


@lru_cache(maxsize=64)
def sharpness(camera: CameraSpec, backend: Backend) -> Sharpness:
    """Return the wavefront errors of a camera as designed, and its best focal plane, from 222 rays.

    Repeated calls return the stored result.

    Raises
    ------
    InputError
        The prescription does not bring the light of its field through the stop to the image.
    AimError, BeamMissedError
        Some of the light does not come through.
    """
    beams = FieldBeams.trace(derive_camera(camera, backend), backend, _FEW_FIELDS, _RINGS)
    plane = FocalPlane.of(camera)
    errors = beams.errors(plane)
    worst = int(np.argmax(errors))
    result = Sharpness(float(errors[worst]), (float(beams.fields[worst, 0]), float(beams.fields[worst, 1])))
    if result.worst <= BLURRED:
        return result
    best = beams.best_plane()
    if not beams.reaches(best):
        return result
    return replace(result, plane=best, refocused=float(np.max(beams.errors(best))))


def cameras_of(setup: Spec) -> Mapping[str, CameraSpec]:
    """Return the cameras of a job or test, by the file or name in it; empty if it has none."""
    many, single = getattr(setup, "cameras", None), getattr(setup, "camera", None)
    if isinstance(single, CameraSpec):
        return {single.name: single}
    return {name: camera for name, camera in (many or {}).items() if isinstance(camera, CameraSpec)}


def blur_warnings(setup: Spec, backend: Backend) -> tuple[str, ...]:
    """Return a warning for each camera of a job or test that is not sharp as designed.

    A camera whose light does not come through at all gets none: it raises an error wherever it is traced.
    """
    out = []
    for camera in cameras_of(setup).values():
        try:
            result = sharpness(camera, backend)
        except (InputError, AimError, BeamMissedError):
            continue
        if result.worst > BLURRED:
            out.append(_blurred(camera, result))
    return tuple(dict.fromkeys(out))


NO_CAMERA = 10.0
"""Wavefront error at the best focus, in waves rms, above which a prescription is reported as not forming an image.

Its rays spread over some hundred Airy disks, and beams miss the parts behind it because of that.
"""


def no_cameras(cameras: Iterable[CameraSpec], backend: Backend) -> tuple[Issue, ...]:
    """Return an issue for each prescription that forms no image at any position of its image plane.

    It is the root cause of whatever its light misses afterwards.

    Parameters
    ----------
    cameras : iterable of CameraSpec
        Prescriptions whose light comes through.
    backend : Backend
        Backend that traces the rays.
    """
    out = []
    for camera in cameras:
        try:
            result = sharpness(camera, backend)
        except (InputError, AimError, BeamMissedError):
            continue
        best = result.worst if np.isnan(result.refocused) else min(result.worst, result.refocused)
        if best > NO_CAMERA:
            problem = (
                f"these surfaces form no image: the wavefront error is {result.worst:.3g} waves rms at field "
                f"{field_text(camera, result.field)}, {best:.3g} at the best focus"
            )
            allowed = "consistent radii, conics, terms and positions; python -m twin.camera shows the beams"
            out.append(camera.issue(problem, ("mirrors",), allowed=allowed))
    return tuple(dict.fromkeys(out))


def _blurred(camera: CameraSpec, result: Sharpness) -> str:
    """Return the warning for a blurred camera, with the command that refocuses it."""
    file, inside = camera.source.file, camera.source.prefix
    # A run's config.yaml holds several cameras.
    chosen = f" --camera {inside[-1]}" if len(inside) > 1 else ""
    problem = (
        f"camera {camera.name}{f' ({file})' if file else ''} is blurred as designed: its wavefront error is "
        f"{result.worst:.3g} waves rms at field {field_text(camera, result.field)}, more than {BLURRED:g}"
    )
    if result.plane is None:
        return f"{problem}; refocusing does not help: its light has no focus after the last mirror"
    shift = 1e3 * (result.plane.z - camera.image.z)
    left = f"{result.refocused:.2g} waves"
    remedy = f"python -m twin.camera {file or camera.name}{chosen} --refocus moves image.z by {shift:+.4g} mm"
    if result.refocused <= BLURRED:
        return f"{problem}; {remedy} and leaves {left}"
    return f"{problem}; {remedy}, but leaves {left}: defocus is not the only error"


def field_text(camera: CameraSpec, field: tuple[float, float]) -> str:
    """Return a field in degrees as text, along the line and along the track."""
    halves = (camera.field.x, camera.field.y)
    along, across = (np.degrees(share * half) for share, half in zip(field, halves, strict=True))
    return f"({along:.4g}, {across:.4g}) deg"
