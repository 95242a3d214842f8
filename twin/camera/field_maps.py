"""Camera properties that vary over the field: distortion, focus, illumination, wavefront error, MTF through focus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from analysis.arrays import shows
from analysis.orientation.interior import principal_distance, principal_distance_and_point
from optics.raytrace.first_order import enclosed_area
from optics.waves.optical_transfer import polychromatic_transfer
from scenes.models.camera_sharpness import FocalPlane
from twin.camera.camera_optics import CameraOptics, rim
from twin.camera.camera_results import Field

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
    places : (A, B, 2) ndarray
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
    places: np.ndarray
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
        return float(np.sqrt(np.mean(np.sum((self.places - self.ideal) ** 2, axis=-1))))

    @property
    def largest(self) -> float:
        """Largest distance between a chief ray and the distortion-free camera's image point over the field, metres."""
        return float(np.max(np.linalg.norm(self.places - self.ideal, axis=-1)))

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
    places = optics.path.places(optics.state, light)
    plane = optics.assembly.nominal_pose(f"{optics.path.root}/focal_plane").rotation
    local = light @ plane
    # the light comes along +-Z of the focal plane; its image of a direction lies the way that the light goes
    tangent = local[:, 1::-1] / np.abs(local[:, 2:])
    # an intermediate image turns the image over
    upright = float(np.sign(np.sum((tangent - tangent.mean(axis=0)) * (places - places.mean(axis=0)))))
    tangent = upright * tangent
    count = len(places)
    design = np.zeros((2 * count, 3))
    design[:, 0] = tangent.T.ravel()
    design[:count, 1] = 1.0
    design[count:, 2] = 1.0
    solution, *_ = np.linalg.lstsq(design, places.T.ravel(), rcond=None)
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
        places=places.reshape(fields.shape),
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
