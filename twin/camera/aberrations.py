"""Classical data of a camera: Seidel sums by surface, ray fans, energy of its point images, and ghosts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.arrays import shows
from analysis.orientation.interior import principal_distance, principal_distance_and_point
from optics.camera.ghosts import DETECTOR, PUPIL, Ghost, trace_ghosts
from optics.camera.prescription import SeidelSums, seidel_sums
from optics.numerics.backend import Backend
from optics.raytrace.first_order import enclosed_area
from optics.raytrace.trace import BeamMissedError
from optics.waves.imaging import encircled_energy, ensquared_energy
from optics.waves.optical_transfer import polychromatic_transfer
from scenes.models.camera_model import IMAGE, CameraModel, field_direction
from scenes.models.camera_sharpness import FocalPlane
from twin.camera.camera_optics import CameraOptics, rim
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


LINE_POINTS = 41
"""Number of points along the line CCD at which distortion is computed, as in the results of the main job."""

GRID = (11, 5)
"""Number of fields along the line and along the track of distortion maps."""

FOCUS_STEPS = 41
"""Number of positions of the detector through focus, odd."""

FOCUS_DEPTHS = 3.0
"""Largest defocus, to either side, in units of the depth of focus 2 lambda F^2."""


@shows("distance [m]", "rms [um]", "largest [um]", "line_distance [m]", "line_largest [um]")
@dataclass(frozen=True, eq=False)
class Distortion:
    """Distortion of a camera relative to the best-fitting distortion-free camera.

    The distortion-free camera images a direction at c + f t, with t the tangents of its angles from the focal plane's
    normal, along the line and along the track: a perspective projection onto a plane parallel to the image.

    Attributes
    ----------
    fields : (A, B, 2) ndarray
        Grid of A fields along the line and B along the track, as fractions of the half field.
    positions : (A, B, 2) ndarray
        Chief rays on the focal plane, along the line and along the track, metres.
    ideal : (A, B, 2) ndarray
        Positions by the best distortion-free camera, metres.
    distance : float
        Principal distance f of that camera, metres.
    point : (2,) ndarray
        Principal point c of that camera, metres from the line's centre.
    angle : (M,) ndarray
        Field angles W of M points along the line, from the line of sight, radians.
    position : (M,) ndarray
        Positions L of these points, metres.
    line_distance : float
        Principal distance of the line, sum(L tan W) / sum(tan^2 W), metres.
    line_point : tuple of float
        Principal point of the line and principal distance, metres, when both are fitted to L(tan W).
    residual : (M,) ndarray
        Distortion L - f tan W with ``line_distance``, metres.
    residual_with_point : (M,) ndarray
        Distortion with principal point and distance fitted, metres.
    """

    fields: np.ndarray
    positions: np.ndarray
    ideal: np.ndarray
    distance: float
    point: np.ndarray
    angle: np.ndarray
    position: np.ndarray
    line_distance: float
    line_point: tuple[float, float]
    residual: np.ndarray
    residual_with_point: np.ndarray

    @property
    def rms(self) -> float:
        """Rms distance between chief rays and the distortion-free camera's image points over the field, metres."""
        return float(np.sqrt(np.mean(np.sum((self.positions - self.ideal) ** 2, axis=-1))))

    @property
    def largest(self) -> float:
        """Largest distance between a chief ray and the distortion-free camera's image point over the field, metres."""
        return float(np.max(np.linalg.norm(self.positions - self.ideal, axis=-1)))

    @property
    def line_rms(self) -> float:
        """Rms distortion along the line, metres."""
        return float(np.sqrt(np.mean(self.residual**2)))

    @property
    def line_largest(self) -> float:
        """Largest absolute distortion along the line, metres."""
        return float(np.max(np.abs(self.residual)))


def field_grid(count: tuple[int, int] = GRID) -> np.ndarray:
    """Return fields evenly spaced over the whole field, (A, B, 2): A along the line, B along the track."""
    along, across = (np.linspace(-1.0, 1.0, n) for n in count)
    return np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1)


def distortion(optics: CameraOptics) -> Distortion:
    """Compute the distortion from chief rays over the field and along the line."""
    fields = field_grid()
    light = optics.directions(fields.reshape(-1, 2))
    positions = optics.path.positions(optics.state, light)
    plane = optics.assembly.nominal_pose(f"{optics.path.root}/focal_plane").rotation
    local = light @ plane
    # the light comes along +-Z of the focal plane; its image of a direction lies the way that the light goes
    tangent = local[:, 1::-1] / np.abs(local[:, 2:])
    # an intermediate image turns the image over
    upright = float(np.sign(np.sum((tangent - tangent.mean(axis=0)) * (positions - positions.mean(axis=0)))))
    tangent = upright * tangent
    count = len(positions)
    design = np.zeros((2 * count, 3))
    design[:, 0] = tangent.T.ravel()
    design[:count, 1] = 1.0
    design[count:, 2] = 1.0
    solution, *_ = np.linalg.lstsq(design, positions.T.ravel(), rcond=None)
    ideal = (design @ solution).reshape(2, count).T
    spec = optics.model.spec
    half = 0.5 * spec.line.pixels * spec.line.pitch
    position = np.linspace(-half, half, LINE_POINTS)
    sight = optics.path.directions(np.stack([position, np.zeros(LINE_POINTS)], axis=-1), optics.state)
    axes = optics.assembly.nominal_pose(optics.path.root).rotation
    camera_sight = sight @ axes
    # from the line of sight, which is the middle one; the image of light that goes toward +Y lies at +Y'
    angle = np.arctan2(camera_sight[:, 1], -camera_sight[:, 2]) - np.arctan2(
        camera_sight[LINE_POINTS // 2, 1], -camera_sight[LINE_POINTS // 2, 2]
    )
    angle = upright * angle
    balanced = float(principal_distance(position, angle))
    both, point = (float(value) for value in principal_distance_and_point(position, angle))
    t = np.tan(angle)
    return Distortion(
        fields=fields,
        positions=positions.reshape(fields.shape),
        ideal=ideal.reshape(fields.shape),
        distance=float(solution[0]),
        point=solution[1:],
        angle=angle,
        position=position,
        line_distance=balanced,
        line_point=(point, both),
        residual=position - balanced * t,
        residual_with_point=position - both * t + point * t**2,
    )


@shows("share", "focus [um]", "illumination", "vignetted", "mtf")
@dataclass(frozen=True, eq=False)
class FieldCurves:
    """Focus, wavefront error, illumination and MTF at M fields along the line.

    Along the track, the fields are in the middle.

    Attributes
    ----------
    share : (M,) ndarray
        Fraction of half the field along the line.
    focus_line, focus_track : (M,) ndarray
        Best focus of the ray fans along the line and along the track, from the focal plane, positive downstream,
        metres.
    focus : (M,) ndarray
        Focus of the whole beam with the smallest rms wavefront error, metres.
    error : (M,) ndarray
        Rms wavefront error on the focal plane, waves.
    illumination : (M,) ndarray
        Solid angle of the beam seen from the focal plane, relative to the middle of the field.
    vignetted : (M,) ndarray
        Fraction of the beam that apertures other than the stop block.
    mtf : (M, 2) ndarray
        MTF of the optics at Nyquist, along the line and along the track; NaN where there is none.
    """

    share: np.ndarray
    focus_line: np.ndarray
    focus_track: np.ndarray
    focus: np.ndarray
    error: np.ndarray
    illumination: np.ndarray
    vignetted: np.ndarray
    mtf: np.ndarray


def field_curves(optics: CameraOptics, sharp: bool, count: int = 21) -> FieldCurves:
    """Compute focus, error, illumination and MTF at ``count`` fields along the line.

    ``sharp`` is False for a camera with wavefront errors so large that the MTF is not computed.
    """
    share = np.linspace(-1.0, 1.0, count)
    fields = np.stack([share, np.zeros(count)], axis=-1)
    waves = optics.wavefronts(fields, points=3, terms=28)
    leaving = optics.rays(fields, rim(48)).direction[..., 1::-1]
    area = np.array([enclosed_area(beam) for beam in leaving])
    wavelength = optics.model.spec.wavelength
    terms = np.array([wave.coefficients for wave in waves]) * wavelength
    aperture = 0.5 * np.ptp(leaving, axis=1)
    # in metres of path the parts that go with x^2 and y^2 are 2 sqrt3 Z4 +- sqrt6 Z6, and a shift dz makes dz NA^2 / 2;
    # positive errors are of light that comes to its focus before the plane
    both = 2.0 * np.sqrt(3.0) * terms[:, 3:4] + np.sqrt(6.0) * terms[:, 5:6] * np.array([1.0, -1.0])
    focus = -both * 2.0 / aperture**2
    # of the whole beam the shift makes both terms of an elliptic pupil; what is best takes most of both away
    a, b = (aperture**2).T
    defocus_terms = np.stack([(a + b) / (8.0 * np.sqrt(3.0)), (a - b) / (4.0 * np.sqrt(6.0))], axis=-1)
    beam_focus = -np.sum(terms[:, [3, 5]] * defocus_terms, axis=-1) / np.sum(defocus_terms**2, axis=-1)
    mtf = np.full((count, 2), np.nan)
    if sharp:
        mtf = np.array([at_nyquist.values[:, 1] for at_nyquist in optics.mtfs(fields, np.array([0.0, optics.nyquist]))])
    return FieldCurves(
        share=share,
        focus_line=focus[:, 0],
        focus_track=focus[:, 1],
        focus=beam_focus,
        error=np.array([wave.rms for wave in waves]),
        illumination=area / area[count // 2],
        vignetted=np.array([wave.vignetted for wave in waves]),
        mtf=mtf,
    )


@shows("fields", "defocus [um]", "best [um]", "error [waves]")
@dataclass(frozen=True, eq=False)
class ThroughFocus:
    """Image quality through focus at F fields, with Z positions of the detector.

    Attributes
    ----------
    fields : tuple of Field
        Fields.
    defocus : (Z,) ndarray
        Defocus of the detector, positive downstream, metres.
    error : (F, Z) ndarray
        Rms wavefront error, waves.
    mtf : (F, 2, Z) ndarray
        MTF at Nyquist, along the line and along the track; NaN where there is none.
    best : float
        Defocus with the smallest mean square error over the fields, metres; NaN where the light has no focus.
    """

    fields: tuple[Field, ...]
    defocus: np.ndarray
    error: np.ndarray
    mtf: np.ndarray
    best: float


def through_focus(optics: CameraOptics, fields: tuple[Field, ...], sharp: bool) -> ThroughFocus:
    """Compute the image quality at F fields while the detector moves through focus.

    ``sharp`` is False for a camera with wavefront errors so large that the MTF is not computed.
    """
    spec = optics.model.spec
    f_number = optics.spot().airy / (1.22 * spec.wavelength)
    beams = optics.beams(fields, 6)
    nominal, best = FocalPlane.of(spec), beams.best_plane()
    downstream = float(np.sign(np.mean(beams.direction[..., 2])))
    shift = downstream * (best.z - nominal.z)
    # the focal plane and the best focus are both in it, for a camera near its focus evenly about the focal plane
    depth = 2.0 * spec.wavelength * f_number**2
    half_range = max(FOCUS_DEPTHS * depth, 1.3 * abs(shift)) if beams.reaches(best) else FOCUS_DEPTHS * depth
    defocus = np.linspace(-half_range, half_range, FOCUS_STEPS)
    error = np.stack([beams.errors(FocalPlane(nominal.z + downstream * dz, nominal.tilt)) for dz in defocus], axis=-1)
    mtf = _mtf_through_focus(optics, fields, defocus, sharp)
    return ThroughFocus(fields, defocus, error, mtf, shift if beams.reaches(best) else np.nan)


def _mtf_through_focus(optics: CameraOptics, fields: tuple[Field, ...], defocus: np.ndarray, sharp: bool) -> np.ndarray:
    """Return the MTF at the Nyquist frequency through focus, (F, 2, Z).

    It is for F fields, the directions along line and track, and Z positions of the detector; NaN if not ``sharp``
    (wavefront errors too large for an MTF).
    """
    mtf = np.full((len(fields), 2, len(defocus)), np.nan)
    if sharp:
        wavelength = np.array([optics.model.spec.wavelength])
        for k, pupil in enumerate(optics.pupils(fields)):
            values = polychromatic_transfer(pupil, optics.nyquist * np.eye(2), wavelength, np.ones(1), defocus)
            mtf[k] = np.abs(values).T
    return mtf
