"""What of a camera changes over its field: distortion, focus, illumination, wavefront error, MTF through focus."""

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
"""Places along the line at which distortion is told: as many as the truth of the main job has."""

GRID = (11, 5)
"""Fields along the line and along the track of maps over the field."""

FOCUS_STEPS = 41
"""Steps through focus, odd."""

FOCUS_DEPTHS = 3.0
"""Reach through focus, in depths of focus lambda F^2 * 2."""


@shows("distance [m]", "rms [um]", "largest [um]", "line_distance [m]", "line_largest [um]")
@dataclass(frozen=True, eq=False)
class Distortion:
    """Where the camera images directions, against the nearest perfect camera.

    The perfect camera images a direction at c + f t, with t the tangents of its angles from the focal plane's normal,
    along the line and along the track: a plane parallel to the image, through which it is seen from one point.

    Attributes
    ----------
    fields : np.ndarray
        Shares of the half field, (A, B, 2), along the line and then along the track.
    places : np.ndarray
        Of chief rays on the focal plane, along the line and along the track, metres, (A, B, 2).
    ideal : np.ndarray
        Of the best perfect camera, metres, (A, B, 2).
    distance : float
        Its principal distance f, metres.
    point : np.ndarray
        Its principal point c, metres from the line's centre, (2,).
    angle : np.ndarray
        W of places along the line, from the line of sight, radians, (M,).
    position : np.ndarray
        L of these, metres, (M,).
    line_distance : float
        Principal distance of the line, sum(L tan W) / sum(tan^2 W), metres.
    line_point : tuple[float, float]
        Principal point of the line when it is fitted, metres, and the distance that goes with it.
    residual : np.ndarray
        L - f tan W with ``line_distance``, metres, (M,).
    residual_with_point : np.ndarray
        With both, metres, (M,).
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
        """Rms distance of the grid from the perfect camera's, metres."""
        return float(np.sqrt(np.mean(np.sum((self.places - self.ideal) ** 2, axis=-1))))

    @property
    def largest(self) -> float:
        """The largest of these distances, metres."""
        return float(np.max(np.linalg.norm(self.places - self.ideal, axis=-1)))

    @property
    def line_rms(self) -> float:
        """Rms of the distortion along the line, metres."""
        return float(np.sqrt(np.mean(self.residual**2)))

    @property
    def line_largest(self) -> float:
        """The largest distortion along the line, metres."""
        return float(np.max(np.abs(self.residual)))


def field_grid(count: tuple[int, int] = GRID) -> np.ndarray:
    """Fields (A, B, 2) evenly over the whole field."""
    along, across = (np.linspace(-1.0, 1.0, n) for n in count)
    return np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1)


def distortion(optics: CameraOptics) -> Distortion:
    """Trace chief rays over the field and along the line."""
    fields = field_grid()
    light = optics.directions(fields.reshape(-1, 2))
    places = optics.path.places(optics.state, light)
    plane = optics.assembly.nominal_pose(f"{optics.path.root}/focal_plane").rotation
    local = light @ plane
    # the light comes along +-Z of the focal plane; its image of a direction lies the way that the light goes
    tangent = local[:, 1::-1] / np.abs(local[:, 2:])
    count = len(places)
    design = np.zeros((2 * count, 3))
    design[:, 0] = tangent.T.ravel()
    design[:count, 1] = 1.0
    design[count:, 2] = 1.0
    found, *_ = np.linalg.lstsq(design, places.T.ravel(), rcond=None)
    ideal = (design @ found).reshape(2, count).T
    spec = optics.model.spec
    half = 0.5 * spec.line.pixels * spec.line.pitch
    position = np.linspace(-half, half, LINE_POINTS)
    sight = optics.path.directions(np.stack([position, np.zeros(LINE_POINTS)], axis=-1), optics.state)
    axes = optics.assembly.nominal_pose(optics.path.root).rotation
    own = sight @ axes
    # from the line of sight, which is the middle one; the image of light that goes toward +Y lies at +Y'
    angle = np.arctan2(own[:, 1], -own[:, 2]) - np.arctan2(own[LINE_POINTS // 2, 1], -own[LINE_POINTS // 2, 2])
    alone = float(principal_distance(position, angle))
    both, point = (float(value) for value in principal_distance_and_point(position, angle))
    t = np.tan(angle)
    return Distortion(
        fields=fields,
        places=places.reshape(fields.shape),
        ideal=ideal.reshape(fields.shape),
        distance=float(found[0]),
        point=found[1:],
        angle=angle,
        position=position,
        line_distance=alone,
        line_point=(point, both),
        residual=position - alone * t,
        residual_with_point=position - both * t + point * t**2,
    )


@shows("share", "focus [um]", "illumination", "vignetted", "mtf")
@dataclass(frozen=True, eq=False)
class FieldCurves:
    """Along the line, at the middle of the field along the track.

    Attributes
    ----------
    share : np.ndarray
        Of half the field along the line, (M,).
    focus_line, focus_track : np.ndarray
        Best focus of the fans of rays along the line and along the track, from the focal plane, positive downstream,
        metres, (M,).
    focus : np.ndarray
        Of the whole beam: least rms wavefront error, metres, (M,).
    error : np.ndarray
        Rms wavefront error there, waves, (M,).
    illumination : np.ndarray
        Solid angle of the beam as the focal plane sees it, over that of the middle, (M,).
    vignetted : np.ndarray
        Share of the beam that other apertures than the stop take, (M,).
    mtf : np.ndarray
        At Nyquist, of the optics, along the line and along the track, (M, 2); NaN where there is none.
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
    """Trace ``count`` fields along the line; without MTF for a camera that is not ``sharp``."""
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
    made = np.stack([(a + b) / (8.0 * np.sqrt(3.0)), (a - b) / (4.0 * np.sqrt(6.0))], axis=-1)
    whole = -np.sum(terms[:, [3, 5]] * made, axis=-1) / np.sum(made**2, axis=-1)
    mtf = np.full((count, 2), np.nan)
    if sharp:
        mtf = np.array([one.values[:, 1] for one in optics.mtfs(fields, np.array([0.0, optics.nyquist]))])
    return FieldCurves(
        share=share,
        focus_line=focus[:, 0],
        focus_track=focus[:, 1],
        focus=whole,
        error=np.array([wave.rms for wave in waves]),
        illumination=area / area[count // 2],
        vignetted=np.array([wave.vignetted for wave in waves]),
        mtf=mtf,
    )


@shows("fields", "defocus [um]", "best [um]", "error [waves]")
@dataclass(frozen=True, eq=False)
class ThroughFocus:
    """At fields, along the light.

    Attributes
    ----------
    fields : tuple[Field, ...]
        F.
    defocus : np.ndarray
        Of the detector, positive downstream, metres, (Z,).
    error : np.ndarray
        Rms wavefront error, waves, (F, Z).
    mtf : np.ndarray
        At Nyquist, along the line and along the track, (F, 2, Z); NaN where there is none.
    best : float
        With the least mean square error over the fields, metres; NaN where the light has no focus.
    """

    fields: tuple[Field, ...]
    defocus: np.ndarray
    error: np.ndarray
    mtf: np.ndarray
    best: float


def through_focus(optics: CameraOptics, fields: tuple[Field, ...], sharp: bool) -> ThroughFocus:
    """Move the detector through focus."""
    spec = optics.model.spec
    f_number = optics.spot().airy / (1.22 * spec.wavelength)
    beams = optics.beams(fields, 6)
    own, best = FocalPlane.of(spec), beams.best_plane()
    downstream = float(np.sign(np.mean(beams.direction[..., 2])))
    away = downstream * (best.z - own.z)
    # the focal plane and the best focus are both in it, for a camera near its focus evenly about the focal plane
    depth = 2.0 * spec.wavelength * f_number**2
    reach = max(FOCUS_DEPTHS * depth, 1.3 * abs(away)) if beams.reaches(best) else FOCUS_DEPTHS * depth
    defocus = np.linspace(-reach, reach, FOCUS_STEPS)
    error = np.stack([beams.errors(FocalPlane(own.z + downstream * dz, own.tilt)) for dz in defocus], axis=-1)
    mtf = _mtf_through_focus(optics, fields, defocus, sharp)
    return ThroughFocus(fields, defocus, error, mtf, away if beams.reaches(best) else np.nan)


def _mtf_through_focus(optics: CameraOptics, fields: tuple[Field, ...], defocus: np.ndarray, sharp: bool) -> np.ndarray:
    """MTF at Nyquist, (F, 2, Z); NaN for a camera that is not sharp."""
    mtf = np.full((len(fields), 2, len(defocus)), np.nan)
    if sharp:
        wavelength = np.array([optics.model.spec.wavelength])
        for k, pupil in enumerate(optics.pupils(fields)):
            values = polychromatic_transfer(pupil, optics.nyquist * np.eye(2), wavelength, np.ones(1), defocus)
            mtf[k] = np.abs(values).T
    return mtf
