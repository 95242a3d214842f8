"""How sharp a camera is as designed, from a few hundred rays, and where its focal plane would be best.

Errors are as ``optics.waves.imaging`` has them: rms over the stop about the sphere that stands around the chief
ray's image, piston and tilt taken out, in waves of the camera's own wavelength. The best focal plane has the least
mean square of them over the field.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
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
"""Wavefront error beyond which a camera is told to be blurred, waves rms: a Strehl ratio of 0.08, and for the library's
cameras next to no contrast at the Nyquist frequency. Marechal's limit of a sharp one is 1/14."""

FIELDS = tuple((x, y) for x in (-1.0, -0.5, 0.0, 0.5, 1.0) for y in (-1.0, 0.0, 1.0))
"""Shares of the half field along the line and along the track, at which a camera is judged and its focus sought."""

_RINGS = 3
"""Rings of the quadrature over the stop: exact for squares of wavefronts to fifth order."""

EVEN = 10_000
"""Rays of a beam that edges of surfaces cut, evenly over the stop. What they take is right to 0.1 %, and rms wavefront
errors of what they leave to 0.2 %: of HSC at nine fields against a million rays. Rings of Gauss' rule, along which an
edge may go, were wrong by up to a fifth.
"""

_STEPS = 6
_DIFFERENCE = 1e-4
"""By which the focal plane is moved and turned for derivatives, metres and radians: far more than rounding, and the
errors are linear over it."""

_MOST_RAYS = 500_000
"""Traced together."""

_FEW_FIELDS = tuple((x, y) for x in (0.0, 1.0) for y in (-1.0, 0.0, 1.0))
"""For a quick judgement: a camera of surfaces of revolution is the same on both sides of its plane of symmetry."""


@dataclass(frozen=True)
class FocalPlane:
    """Where a camera's image plane stands.

    Attributes
    ----------
    z : float
        Where it crosses the parent axis, metres.
    tilt : float
        About the prescription's x, at the parent axis, radians; 0 stands square to the axis.
    """

    z: float
    tilt: float = 0.0

    @classmethod
    def of(cls, camera: CameraSpec) -> FocalPlane:
        """A camera's own."""
        return cls(camera.image.z, camera.image.tilt or 0.0)


MIN_ILLUMINATED = 20
"""Of ``EVEN`` rays those that have to come through a field's edges: of fewer, two in a thousand, nothing is told."""

Cut = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""What bodies about a camera take of beams of fields (F, 2) at points (N, 2) of the stop, in units of its radius: True
where they stop the light, (F, N).
"""


def stop_nodes(model: CameraModel, rings: int, cut: bool = False) -> PupilNodes:
    """Nodes of the stop at which every judgement of a camera's light is made.

    Where nothing but the stop limits a beam, Gauss' rule of ``rings``, exact for smooth wavefronts; where edges cut it,
    ``EVEN`` points whatever the rings, so that all that is told of such a beam is of the same rays.

    Parameters
    ----------
    model : CameraModel
        Of the camera.
    rings : int
        Of Gauss' rule.
    cut : bool
        Whether bodies about the camera cut the beam, too.
    """
    return quadrature.even_disk(EVEN) if model.edges or cut else quadrature.disk(rings)


@dataclass(frozen=True, eq=False)
class FieldBeams:
    """Beams of F fields near the image, in the prescription frame; of each the chief ray, then N of a quadrature.

    Attributes
    ----------
    camera : CameraSpec
        whose.
    fields : np.ndarray
        Shares of the half field, (F, 2).
    nodes : PupilNodes
        Of the stop, N.
    position, direction : np.ndarray
        (F, 1 + N, 3), metres and unit.
    path : np.ndarray
        Optical path from the incoming wavefront, (F, 1 + N), metres.
    exit_pupil : float
        From the camera's own image to its exit pupil, upstream, metres.
    room : np.ndarray
        From the last mirror along the chief ray to the camera's own image, (F,), metres.
    lit : np.ndarray | None
        Which of the N rays edges of surfaces let through, (F, N); None for all.
    """

    camera: CameraSpec
    fields: np.ndarray
    nodes: PupilNodes
    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray
    exit_pupil: float
    room: np.ndarray
    lit: np.ndarray | None = None

    @classmethod
    def trace(
        cls,
        model: CameraModel,
        backend: Backend,
        fields: tuple[tuple[float, float], ...],
        rings: int,
        cut: Cut | None = None,
        wavelength: float | None = None,
    ) -> FieldBeams:
        """Trace them through the camera as designed; nothing but the stop, edges of surfaces and ``cut`` limits them.

        ``wavelength`` is that of the light, metres; the design wavelength by default. Errors stay in waves of that.

        Raises
        ------
        AimError, BeamMissedError
            Light of a field does not come through.
        InputError
            Edges stop all of it.
        ValueError
            a glass is not known at the wavelength.
        """
        spec, nodes = model.spec, stop_nodes(model, rings, cut is not None)
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
        kept = {model.mirrors.index(name) for name in model.edges} | {last}
        traced = trace(backend, assemble(bare, ["imaging"], states), rays, keep=kept, world=True)
        assert traced.world is not None
        position, direction, path, valid = traced.numpy(traced.world)
        shape = launch.shape[:2]
        lit = None
        if model.edges:
            valid = valid[0] & model.uncut(lambda name: traced.hit(model.mirrors.index(name))[0])
            lit = valid.reshape(shape)[:, 1:]
            dark = np.flatnonzero(np.sum(lit, axis=-1) < MIN_ILLUMINATED)
            if dark.size:
                found = (
                    f"field {field_text(spec, fields[dark[0]])}, {dark.size} of {len(fields)} fields that were tried"
                )
                key = ("mirrors", next(iter(model.edges)), "edges")
                raise spec.error(
                    "edges leave no light to speak of", key, found=found, allowed="a smaller field, or wider edges"
                )
        if cut is not None:
            free = ~cut(np.array(fields), points[1:] / radius)
            lit = free if lit is None else lit & free
        require_rays(valid.reshape(shape), f"camera {spec.name}")
        position, direction = position.reshape(*shape, 3), direction.reshape(*shape, 3)
        way = position[:, 0] - model.mirror_pose(model.mirrors[last]).apply(traced.hit(last).reshape(*shape, 3)[:, 0])
        return cls(
            spec,
            np.array(fields),
            nodes,
            position,
            direction,
            path.reshape(shape),
            float(model.first_order.exit_pupil_distance[0]),
            np.sum(way * direction[:, 0], axis=-1),
            lit,
        )

    @classmethod
    def field_errors(
        cls,
        model: CameraModel,
        backend: Backend,
        fields: Sequence[tuple[float, float]],
        rings: int,
        cut: Cut | None = None,
    ) -> np.ndarray:
        """Rms wavefront errors at many fields (F, 2) on the own focal plane, (F,), waves. Raises as ``trace``."""
        # as many at once as the memory takes: some 100 MB
        step = max(1, _MOST_RAYS // stop_nodes(model, rings, cut is not None).count)
        parts = [tuple(fields[k : k + step]) for k in range(0, len(fields), step)]
        plane = FocalPlane.of(model.spec)
        return np.concatenate([cls.trace(model, backend, part, rings, cut).errors(plane) for part in parts])

    @property
    def share(self) -> np.ndarray:
        """Share of each ray in the light that comes through, (N,), or (F, N) where edges stop some."""
        if self.lit is None:
            return self.nodes.share
        share = self.nodes.share * self.lit
        return np.asarray(share / np.sum(share, axis=-1, keepdims=True))

    def _away(self, plane: FocalPlane) -> np.ndarray:
        """From the camera's own image along each ray to a plane, (F, 1 + N), metres."""
        point = np.array([0.0, 0.0, plane.z])
        normal = np.array([0.0, -np.sin(plane.tilt), np.cos(plane.tilt)])
        return np.asarray(((point - self.position) @ normal) / (self.direction @ normal))

    def reaches(self, plane: FocalPlane) -> bool:
        """Whether the light meets the plane after its last mirror."""
        return bool(np.all(self.room + self._away(plane)[:, 0] > 0.0))

    def wavefronts(self, plane: FocalPlane) -> np.ndarray:
        """Wavefront errors about the images on a plane, piston and tilt out, (F, N), waves; 0 where no light comes."""
        away = self._away(plane)
        position, path = self.position + away[..., None] * self.direction, self.path + away
        to_sphere = path_to_sphere(position, self.direction, path, position[:, :1], self.exit_pupil)
        basis = zernike.basis(3, self.nodes.x, self.nodes.y)
        error = (to_sphere[:, :1] - to_sphere)[:, 1:] / self.camera.wavelength
        if self.lit is not None:
            return np.stack([_levelled(one, basis, share) for one, share in zip(error, self.share, strict=True)])
        # the first three terms are orthonormal over the disk, and the rule is exact for their products
        return np.asarray(error - (error * self.nodes.share) @ basis @ basis.T)

    def errors(self, plane: FocalPlane) -> np.ndarray:
        """Rms wavefront error at each field, (F,), waves."""
        squares = self.wavefronts(plane) ** 2
        if self.lit is not None:
            return np.asarray(np.sqrt(np.sum(squares * self.share, axis=-1)))
        return np.asarray(np.sqrt(squares @ self.nodes.share))

    def best_plane(self, tilt: bool = False) -> FocalPlane:
        """The plane with the least mean square error over the fields; turned about x as well, if asked for."""
        start, root = FocalPlane.of(self.camera), np.sqrt(self.share / len(self.fields))
        middle = float(np.mean(self.position[:, 0, 1]))

        def moved(step: np.ndarray) -> FocalPlane:
            """The plane ``step[0]`` farther at the middle of the fields and turned by ``step[1]`` about there."""
            turn = start.tilt + (float(step[1]) if tilt else 0.0)
            there = start.z + middle * np.tan(start.tilt) + float(step[0])
            return FocalPlane(float(there - middle * np.tan(turn)), turn)

        def residuals(step: np.ndarray) -> np.ndarray:
            return np.asarray((self.wavefronts(moved(step)) * root).ravel())

        # errors are linear in a move of the plane but for where chief rays meet it: Gauss' steps find it at once
        step = np.zeros(2 if tilt else 1)
        for _ in range(_STEPS):
            sides = [(residuals(step + h), residuals(step - h)) for h in _DIFFERENCE * np.eye(len(step))]
            slope = np.stack([(ahead - behind) / (2.0 * _DIFFERENCE) for ahead, behind in sides], axis=-1)
            step = step - np.linalg.lstsq(slope, residuals(step), rcond=None)[0]
        return moved(step)


def _levelled(error: np.ndarray, basis: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Errors (N,) without the part of the basis (N, 3) by weighted least squares; 0 where the weight is."""
    lit = share > 0.0
    root = np.sqrt(share[lit])
    terms, *_ = np.linalg.lstsq(basis[lit] * root[:, None], error[lit] * root, rcond=None)
    out = np.zeros(len(error))
    out[lit] = error[lit] - basis[lit] @ terms
    return out


@dataclass(frozen=True)
class Sharpness:
    """A quick judgement of a camera as designed.

    Attributes
    ----------
    worst : float
        Largest wavefront error over the field, waves rms.
    field : tuple[float, float]
        Where, shares of the half field along the line and along the track.
    plane : FocalPlane | None
        The best focal plane; None for a sharp camera, and where light has no focus after its last mirror.
    refocused : float
        The largest error on that plane, waves rms.
    """

    worst: float
    field: tuple[float, float]
    plane: FocalPlane | None = None
    refocused: float = np.nan


@lru_cache(maxsize=64)
def sharpness(camera: CameraSpec, backend: Backend) -> Sharpness:
    """Judge a camera from 222 rays, once.

    Raises
    ------
    InputError
        The prescription does not bring the light of its field through the stop to the image.
    AimError, BeamMissedError
        The same of some of it.
    """
    beams = FieldBeams.trace(derive_camera(camera, backend), backend, _FEW_FIELDS, _RINGS)
    own = FocalPlane.of(camera)
    errors = beams.errors(own)
    worst = int(np.argmax(errors))
    found = Sharpness(float(errors[worst]), (float(beams.fields[worst, 0]), float(beams.fields[worst, 1])))
    if found.worst <= BLURRED:
        return found
    best = beams.best_plane()
    if not beams.reaches(best):
        return found
    return replace(found, plane=best, refocused=float(np.max(beams.errors(best))))


def cameras_of(setup: Spec) -> Mapping[str, CameraSpec]:
    """Cameras among what a job or test refers to, by the file or name that it gives; empty where it has none."""
    many, one = getattr(setup, "cameras", None), getattr(setup, "camera", None)
    if isinstance(one, CameraSpec):
        return {one.name: one}
    return {name: camera for name, camera in (many or {}).items() if isinstance(camera, CameraSpec)}


def blur_warnings(setup: Spec, backend: Backend) -> tuple[str, ...]:
    """One warning for each camera of a job or test that is not sharp as designed.

    A camera whose light does not come through at all has none: it is an error wherever it is traced.
    """
    out = []
    for camera in cameras_of(setup).values():
        try:
            found = sharpness(camera, backend)
        except (InputError, AimError, BeamMissedError):
            continue
        if found.worst > BLURRED:
            out.append(_blurred(camera, found))
    return tuple(dict.fromkeys(out))


NO_CAMERA = 10.0
"""Wavefront error at the best focus beyond which a prescription is none of a camera, waves rms: its rays spread over
some hundred Airy disks, and beams miss what stands behind it because of that."""


def no_cameras(cameras: Iterable[CameraSpec], backend: Backend) -> tuple[Issue, ...]:
    """One issue for each prescription that makes no image, wherever its image plane stands: the first cause of whatever
    its light then misses.

    Parameters
    ----------
    cameras : Iterable[CameraSpec]
        Prescriptions whose light comes through.
    backend : Backend
        Where to trace.
    """
    out = []
    for camera in cameras:
        try:
            found = sharpness(camera, backend)
        except (InputError, AimError, BeamMissedError):
            continue
        best = found.worst if np.isnan(found.refocused) else min(found.worst, found.refocused)
        if best > NO_CAMERA:
            problem = (
                f"these surfaces make no image: {found.worst:.3g} waves rms of wavefront error at field "
                f"{field_text(camera, found.field)}, {best:.3g} at the best focus"
            )
            allowed = "radii, conics, terms and places that belong together; python -m twin.camera shows the beams"
            out.append(camera.issue(problem, ("mirrors",), allowed=allowed))
    return tuple(dict.fromkeys(out))


def _blurred(camera: CameraSpec, found: Sharpness) -> str:
    file, inside = camera.source.file, camera.source.prefix
    # in a run's config.yaml a camera stands among others
    chosen = f" --camera {inside[-1]}" if len(inside) > 1 else ""
    what = (
        f"camera {camera.name}{f' ({file})' if file else ''} is blurred as designed: {found.worst:.3g} waves rms of "
        f"wavefront error at field {field_text(camera, found.field)}, more than {BLURRED:g}"
    )
    if found.plane is None:
        return f"{what}; refocusing cannot help: its light has no focus after the last mirror"
    shift = 1e3 * (found.plane.z - camera.image.z)
    left = f"{found.refocused:.2g} waves"
    remedy = f"python -m twin.camera {file or camera.name}{chosen} --refocus moves image.z by {shift:+.4g} mm"
    if found.refocused <= BLURRED:
        return f"{what}; {remedy} and leaves {left}"
    return f"{what}; {remedy}, but leaves {left}: it is not a matter of focus alone"


def field_text(camera: CameraSpec, field: tuple[float, float]) -> str:
    """A field in degrees: along the line and along the track."""
    halves = (camera.field.x, camera.field.y)
    along, across = (np.degrees(share * half) for share, half in zip(field, halves, strict=True))
    return f"({along:.4g}, {across:.4g}) deg"
