"""Classical data of a camera: Seidel sums by surface, ray fans, energy of its point images, and ghosts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.arrays import shows
from optics.camera.ghosts import DETECTOR, PUPIL, Ghost, trace_ghosts
from optics.camera.seidel import SeidelSums, seidel_sums
from optics.numerics.backend import Backend
from optics.raytrace.trace import BeamMissedError
from optics.waves.sampled_psf import encircled_energy, ensquared_energy
from scenes.models.camera_model import IMAGE, CameraModel, field_direction
from twin.camera.camera_optics import CameraOptics
from twin.camera.camera_results import Field
from twin.camera.colour import Psf, spectral_psfs
from twin.camera.first_order_data import ray_paths
from twin.framework.record import Quantity, Record

FAN_POINTS = 41
"""Rays of a fan, from rim to rim of the stop: a curve of six turns has some seven points a turn."""

ENERGY_POINTS = 121
"""Radii, and half widths, of the curves of energy."""

COEFFICIENTS = ("W040", "W131", "W222", "W220", "W311", "C1", "C2")
"""Names of the third-order wavefront coefficients and of the chromatic sums."""


@shows("sums.names", "waves", "sums.petzval [1/m]")
@dataclass(frozen=True, eq=False)
class ThirdOrder:
    """Third-order aberrations of a camera by surface.

    Attributes
    ----------
    sums : SeidelSums
        Seidel and chromatic sums of the K surfaces.
    wavelength : float
        Wavelength of the design, metres.
    """

    sums: SeidelSums
    wavelength: float

    @property
    def waves(self) -> np.ndarray:
        """Coefficients W040 to W311 and, with a spectrum, chromatic sums of the K surfaces, waves, (K, 5 or 7)."""
        colour = [] if self.sums.colour is None else [self.sums.colour]
        return np.hstack([self.sums.wavefront, *colour]) / self.wavelength


def third_order(model: CameraModel) -> ThirdOrder | None:
    """Return the third-order aberrations of a nominal camera, at the corner of its field farthest from the axis.

    None for a camera whose surfaces or stop are off one axis. Chromatic sums are those of the ends of the light's
    spectrum, where the glasses are known.
    """
    spec = model.spec
    corners = [field_direction(spec, x * spec.field.x, y * spec.field.y) for x in (-1.0, 1.0) for y in (-1.0, 1.0)]
    field = float(np.max([np.arctan2(np.hypot(d[0], d[1]), d[2]) for d in corners]))
    ends = spec.light.ends if spec.light is not None and spec.light.ends[0] < spec.light.ends[1] else ()
    try:
        indices = [_indices(model, wavelength) for wavelength in (spec.wavelength, *ends)]
    except ValueError:  # a bare index has no dispersion
        indices = [_indices(model, spec.wavelength)]
    assembly, stop = model.bare_assembly(apertures=False), model.mirrors.index(spec.stop)
    try:
        radius = float(model.apertures[spec.stop].bounds[1])
        return ThirdOrder(seidel_sums(assembly, model.mirrors, stop, radius, field, indices), spec.wavelength)
    except ValueError:  # off the axis
        return None


def _indices(model: CameraModel, wavelength: float) -> np.ndarray:
    """Return the refractive indices before the first and after each of K surfaces, (K + 1,)."""
    out = [1.0]
    for name, surface in model.spec.mirrors.items():
        out.append(model.spec.index_behind(name, wavelength) if surface.light == "refracts" else out[-1])
    return np.array(out)


THIRD_ORDER: Record[ThirdOrder] = Record(
    "Third-order aberrations of the nominal camera at the rim of the stop and the corner of the field, by surface.",
    Quantity(
        "surfaces_waves",
        lambda t: {n: dict(zip(COEFFICIENTS, row, strict=False)) for n, row in zip(t.sums.names, t.waves, strict=True)},
        "surface -> wavefront coefficients W and, with a spectrum, chromatic sums C1 (axial) and C2 (lateral)",
    ),
    Quantity(
        "sum_waves", lambda t: dict(zip(COEFFICIENTS, t.waves.sum(axis=0), strict=False)), "sums over the surfaces"
    ),
    Quantity(
        "petzval_curvature_per_m",
        lambda t: t.sums.petzval,
        "curvature of the Petzval surface, positive where its centre lies toward +z",
        converted=False,
    ),
)


@shows("fields", "transverse [um]", "path [waves]")
@dataclass(frozen=True, eq=False)
class RayFans:
    """Fans of rays through a diameter of the stop, one along the line and one along the track, at F fields.

    Attributes
    ----------
    fields : tuple of Field
        The F fields.
    pupil : (N,) ndarray
        Stop coordinate of the N rays of a fan, in units of its radius.
    transverse : (F, 2, 2, N) ndarray
        Intersection with the focal plane minus that of the chief ray, metres: field, fan (along the line, along the
        track), direction (along the line, along the track), ray. nan where no light passes; a fan that edges block
        entirely, such as one along a vane, is traced without edges.
    path : (F, 2, N) ndarray
        Wavefront error against the chief ray, waves, positive where the wavefront is ahead; nan without light.
    """

    fields: tuple[Field, ...]
    pupil: np.ndarray
    transverse: np.ndarray
    path: np.ndarray


def ray_fans(optics: CameraOptics, fields: Sequence[Field]) -> RayFans:
    """Trace the two fans of F fields, (F, 2).

    Raises
    ------
    AimError, BeamMissedError
        In this state the light misses the stop or the plane of the line CCD.
    """
    pupil = np.linspace(-1.0, 1.0, FAN_POINTS)
    transverse, path = np.empty((len(fields), 2, 2, FAN_POINTS)), np.empty((len(fields), 2, FAN_POINTS))
    for fan, axis in enumerate(np.eye(2)):
        stop = np.concatenate([[0.0], pupil * (1.0 - 1e-9)])[:, None] * axis
        try:
            rays = optics.rays(fields, stop)
        except BeamMissedError:
            rays = optics.rays(fields, stop, edges=False)
        place, lost = rays.position[..., 1::-1] / rays.size, ~rays.valid[:, 1:]
        step = np.where(lost[..., None], np.nan, place[:, 1:] - place[:, :1])
        transverse[:, fan] = np.moveaxis(step, -1, 1)
        path[:, fan] = np.where(lost, np.nan, -optics.path_error(rays)[:, 1:] / optics.wavelength)
    return RayFans(tuple(fields), pupil, transverse, path)


@shows("psfs", "radius [um]")
@dataclass(frozen=True, eq=False)
class PointImages:
    """Point images at F fields and the energy within circles and squares about their centroids.

    Attributes
    ----------
    psfs : tuple of Psf
        Images of the F fields, at one wavelength.
    radius : (R,) ndarray
        Radii of the circles and half widths of the squares, metres.
    encircled, ensquared : (F, R) ndarray
        Shares of the light.
    limit : (R,) ndarray
        Encircled energy of the middle of the field without wavefront error.
    pixel : (F,) ndarray
        Share of the light in a square of the line's pixel pitch about the centroid.
    """

    psfs: tuple[Psf, ...]
    radius: np.ndarray
    encircled: np.ndarray
    ensquared: np.ndarray
    limit: np.ndarray
    pixel: np.ndarray

    def radius_of(self, share: float) -> list[float | None]:
        """Return the radii of the F circles that contain a share of the light, metres; None beyond the samples."""
        return [float(np.interp(share, row, self.radius)) if row[-1] >= share else None for row in self.encircled]


IMAGE_FIELDS: tuple[Field, ...] = ((0.0, 0.0), (1.0, 0.0))
"""Fields of the point images: the middle of the field and the left end of the line."""


def point_images(optics: CameraOptics) -> PointImages:
    """Compute point images at ``IMAGE_FIELDS``, at the wavelength of the light, and their energies.

    Raises
    ------
    AimError, BeamMissedError, ValueError
        The light is lost, edges cut a pupil into too many pieces, or a wavefront is too irregular.
    """
    images = spectral_psfs(optics, IMAGE_FIELDS, np.array([optics.wavelength]), np.ones(1), perfect=True)
    centres = [_centroid(psf) for psf in images]
    # circles about every centroid within all samples
    room = min(float(psf.position[-1]) - max(map(abs, centre)) for psf, centre in zip(images, centres, strict=True))
    radius = np.linspace(0.0, 0.98 * room, ENERGY_POINTS)
    step = [float(psf.position[1] - psf.position[0]) for psf in images]
    encircled = [encircled_energy(psf.values, d, radius, at) for psf, d, at in zip(images, step, centres, strict=True)]
    widths = [*radius, 0.5 * optics.model.spec.line.pitch]
    squares = np.array(
        [ensquared_energy(psf.values, d, widths, at) for psf, d, at in zip(images[:-1], step, centres, strict=False)]
    )
    return PointImages(images[:-1], radius, np.array(encircled[:-1]), squares[:, :-1], encircled[-1], squares[:, -1])


def _centroid(psf: Psf) -> tuple[float, float]:
    """Return the centroid of a point image, along the line and along the track, from the middle of its grid, metres."""
    along, across = (float(np.average(psf.position, weights=psf.values.sum(axis=axis))) for axis in (0, 1))
    return along, across


ENERGY: Record[PointImages] = Record(
    "Energy of point images of the optics alone in the middle and at the left end of the line, about their centroids.",
    Quantity("field", lambda p: [psf.field for psf in p.psfs], "shares of the half field"),
    Quantity("ee50_um", lambda p: p.radius_of(0.5), "radius of the circle with half of the light"),
    Quantity("ee80_um", lambda p: p.radius_of(0.8), "radius of the circle with 80 % of the light; null if it is larger "
             "than the computed image"),
    Quantity("ensquared_in_pixel", lambda p: p.pixel, "share of the light in a square of the pixel pitch"),
)  # fmt: skip


def camera_ghosts(model: CameraModel, backend: Backend, field: Field = (0.0, 0.0)) -> tuple[Ghost, ...]:
    """Trace the ghosts of a nominal camera at a field, the largest irradiance first; none without refracting surfaces.

    Coated faces and the detector have the reflectances of the camera's file.
    """
    spec = model.spec
    if all(face.light != "refracts" for face in spec.mirrors.values()):
        return ()
    coatings = {name: face.reflectance for name, face in spec.mirrors.items() if face.reflectance is not None}
    detector = DETECTOR if spec.image.reflectance is None else spec.image.reflectance
    bare = model.bare_assembly()
    for name, edges in model.edges.items():
        bare = bare.with_element(replace(bare.elements[name], edges=edges))
    launch = ray_paths(model, backend, [field], PUPIL).points[0, 0]
    direction = field_direction(spec, field[0] * spec.field.x, field[1] * spec.field.y)
    names, indices = (*model.mirrors, IMAGE), _indices(model, spec.wavelength)
    shares = {**coatings, IMAGE: detector}
    return trace_ghosts(backend, bare, names, indices, launch, direction, spec.wavelength, shares)


GHOST: Record[Ghost] = Record(
    "Ghost of the nominal camera in the middle of the field, by two reflections at faces of lenses or the detector.",
    Quantity("back", lambda g: g.back, "surface, or image for the detector, that reflects the light back"),
    Quantity("forward", lambda g: g.forward, "surface before it that reflects the light forward again"),
    Quantity(
        "focus_mm",
        lambda g: g.focus if np.isfinite(g.focus) else None,
        "paraxial focus from the image plane, positive along the light; null for a parallel beam",
    ),
    Quantity("spot_mm", lambda g: g.diameter, "diameter of the traced light in the image plane"),
    Quantity("energy", lambda g: g.energy, "light relative to that of the image"),
    Quantity("irradiance", lambda g: g.irradiance, "mean irradiance relative to that of the image's spot or Airy disk"),
)
