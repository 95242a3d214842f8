"""Image formation of a line: transfer function of optics and detector, motion of the image, and jitter.

Frequencies are in cycles per pixel along the line and in cycles per line along the track. While the image of a point
crosses the line, it moves per line time by `advance` pixels across the line, less than one for an oblique line of
sight, and by `drift` pixels along the line. With the pixel pitch p and the focal plane's transfer function T(fx, fy)
(cycles/m along the line and along the track), an image sampled at lines and pixels thus has the transfer function H of
the frequencies `pixel` (cycles/pixel) and `line` (cycles/line)

    H(pixel, line) = T(pixel/p, -(line + drift pixel)/(advance p)) x smear(line).

The charge of a pixel follows the mean motion of the image (TDI). During the whole exposure, a pixel thus sees the
ground position of its line, displaced by the jitter of each moment. The mean position is that of the line's sensor with
the jitter averaged over the exposure; the image itself is the mean of images at the nodes of a Gaussian quadrature over
the exposure. Every line is thus displaced and blurred by its own jitter, from slow oscillations to those that are
faster than the exposure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial import chebyshev
from scipy import constants, fft

from optics.geometry.polygon import area
from optics.geometry.zernike import cartesian_terms
from optics.waves.optical_transfer import TransferTable
from optics.waves.pupil_shadow import PupilShadow, separate
from optics.waves.pupil_stack import PupilFunction, circular_pupil
from scenes.specs.camera import BandSpec
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.specs.spectrum import SpectrumSpec, black_body_photons
from twin.orbit.flight.sensor import Sensor
from twin.orbit.flight.trajectory import Jitter, Trajectory
from twin.sensors.line_ccd import Collection, LineCcd, band_wavelengths

if TYPE_CHECKING:
    from scenes.specs.detector import DetectorSpec
    from scenes.specs.orbit.scene import LineImageSpec


def optics_of(
    camera: ThreeLineCameraSpec, lines: tuple[str, ...], line_time: float, detectors: Mapping[str, DetectorSpec]
) -> dict[str, LineOptics]:
    """Return the lens and CCD of each line; lines of the same design share the same object.

    Raises
    ------
    ValueError
        A line has no image section.
    """
    made: dict[tuple[object, ...], LineOptics] = {}
    out = {}
    for name in lines:
        image = camera.image_of(name)
        if image is None:
            raise ValueError(f"{camera.name} has no image section for its line {name}")
        key = image.model_dump_json(), camera.pixels_of(name), camera.pitch_of(name)
        if key not in made:
            sheet = detectors[image.detector]
            made[key] = LineOptics.from_specs(image, camera.pixels_of(name), camera.pitch_of(name), line_time, sheet)
        out[name] = made[key]
    return out


SUN_TEMPERATURE = 5772.0
"""Nominal effective temperature of the Sun, in K (IAU 2015 Resolution B3)."""
SUN_RADIUS = 6.957e8
"""Nominal radius of the Sun, in metres (IAU 2015 Resolution B3)."""

_TAPER = 0.75
"""Fraction of the margin, from the centre, at which the point spread function starts to be tapered to zero."""


@dataclass(frozen=True)
class ImageMotion:
    """Motion of the ground's image over the line, per line time.

    Attributes
    ----------
    advance : float
        Motion across the line, pixels, positive.
    drift : float
        Motion along the line, pixels.
    """

    advance: float
    drift: float

    @classmethod
    def of(cls, sensor: Sensor, line: float, pixel: float, height: float) -> ImageMotion:
        """Return the image motion at a line and pixel of an image, for ground of a height in metres.

        It is computed from the directions of one ground point before and after the exposure of its line. Effects on the
        light (light time, aberration, refraction) shift both equally and change the motion by less than 1e-5 of it.
        """
        camera, step = sensor.camera, min(1.0, 0.5 * sensor.lines - 0.5)
        middle = float(np.clip(line, step - 0.5, sensor.lines - 0.5 - step))
        point = sensor.ground(np.array([middle]), np.array([pixel]), height)
        seconds = sensor.time(np.array([middle - step, middle + step]))
        to_itrs = sensor.trajectory.body_to_itrs(seconds)
        ray = point - sensor.trajectory.position(seconds)
        direction = np.einsum("nij,ni->nj", to_itrs, ray / np.linalg.norm(ray, axis=-1, keepdims=True))
        change = (direction[1] - direction[0]) / (2.0 * step)
        look, slope = (v[0] for v in camera.look_and_slope(np.array([pixel])))
        rate = float(np.linalg.norm(slope))
        across = np.cross(look, slope / rate)
        # At a field angle w a pixel subtends p cos^2 w / f along the line and p cos w / f across it.
        cosine = float(look @ camera.look(np.array([0.5 * (camera.pixels - 1)]))[0])
        return cls(abs(float(change @ across)) / rate * cosine, float(change @ slope) / rate**2)


@dataclass(frozen=True, eq=False)
class LineOptics:
    """Lens and CCD of a line.

    Attributes
    ----------
    ccd : LineCcd
        Line CCD.
    pupil : PupilFunction
        Pupil of the lens, the same for all pixels.
    f_number : float
        F-number of the lens.
    transmission : float
        Transmission of the lens.
    """

    ccd: LineCcd
    pupil: PupilFunction
    f_number: float
    transmission: float

    @classmethod
    def from_specs(
        cls, image: LineImageSpec, pixels: int, pitch: float, line_time: float, sheet: DetectorSpec
    ) -> LineOptics:
        """Make lens and CCD from the specifications of their files.

        Parameters
        ----------
        image : LineImageSpec
            Image side of the line.
        pixels : int
            Number of pixels of the line.
        pitch : float
            Pixel pitch, metres.
        line_time : float
            Time from one line to the next, seconds.
        sheet : DetectorSpec
            Data sheet of the CCD.
        """
        band = BandSpec.model_construct(
            offset=0.0,
            pixels=pixels,
            pitch=pitch,
            spectrum=SpectrumSpec.evenly(*image.spectrum),
            detector=image.detector,
            diffusion=image.diffusion,
            tdi=image.tdi.model_copy(update={"line_time": line_time}),
        )
        pupil = circular_pupil(image.f_number, _eikonal({int(k[1:]): v for k, v in image.wavefront.items()}))
        if image.obstruction:
            pupil = replace(pupil, shadow=_shadow(image.obstruction, pupil.edge.harmonics))
        return cls(LineCcd.from_specs(band, sheet), pupil, image.f_number, image.transmission)

    @property
    def photons_per_reflectance(self) -> float:
        """Number of photons on a pixel, summed over all TDI stages, from ground of apparent reflectance 1.

        The Sun is a black body at 1 au, the ground is Lambertian, and the pixel's irradiance is pi/(4 F^2) times the
        ground's radiance, with f-number F, reduced by the obstruction of the pupil.
        """
        first, last = self.ccd.band.spectrum.ends
        wavelength, weight = band_wavelengths(self.ccd.band)
        radiance = black_body_photons(wavelength, SUN_TEMPERATURE) * (SUN_RADIUS / constants.au) ** 2
        band = float(weight @ radiance) * (last - first)
        tdi, pitch = self.ccd.band.tdi, self.ccd.band.pitch
        seconds = tdi.stages * tdi.open_share * tdi.line_time
        solid_angle = np.pi / (4.0 * self.f_number**2) * self.pupil.light
        return band * solid_angle * self.transmission * pitch**2 * seconds

    def transfer(self, pixel: np.ndarray, line: np.ndarray, motion: ImageMotion) -> np.ndarray:
        """Return the optical transfer function at frequencies along the line and along the track.

        Parameters
        ----------
        pixel : ndarray
            Frequencies along the line, in cycles per pixel.
        line : ndarray
            Frequencies along the track, in cycles per line, broadcast with `pixel`.
        motion : ImageMotion
            Motion of the image over the line.

        Notes
        -----
        The function is real for an unobstructed pupil, because the pupil is even; it refers to the centroid of the
        image of a point.
        """
        start = np.ones(np.broadcast_shapes(np.shape(pixel), np.shape(line)))
        return np.asarray(math.prod(self.factors(pixel, line, motion).values(), start=start))

    def factors(self, pixel: np.ndarray, line: np.ndarray, motion: ImageMotion) -> dict[str, np.ndarray]:
        """Return the factors of the transfer function, by name, at frequencies in cycles per pixel and per line.

        They are ``lens``, ``pixel`` (aperture), ``diffusion`` (of charge), ``step`` (smear by the image motion between
        two transfers of the charge) and ``stages`` (smear by the mismatch of image and charge motion over the TDI
        stages, due to the error of the charge's rate and because the image does not advance by exactly a pixel per line
        time).
        """
        band = self.ccd.band
        fx = pixel / band.pitch
        fy = -(line + motion.drift * pixel) / (motion.advance * band.pitch)
        from_ccd = self.ccd.factors(fx, fy)
        tdi = band.tdi
        slip = (line + (1.0 + tdi.rate_error) * band.pitch * fy) / tdi.phases
        return {
            "lens": self._lens(fx, fy),
            "pixel": from_ccd["pixel"],
            "diffusion": from_ccd["diffusion"],
            "step": np.sinc(tdi.open_share / tdi.phases * line),
            "stages": _mean_of_steps(slip, tdi.stages * tdi.phases) if tdi.stages > 1 else np.ones_like(slip),
        }

    def kernel(self, oversampling: int, margin: int, motion: ImageMotion) -> np.ndarray:
        """Return the point spread function with `oversampling` samples per line and per pixel, of unit sum.

        It is tapered to zero at `margin` pixels and lines from its centre, so that an image does not depend on how its
        computation is divided into parts. The energy of the diffraction pattern farther out (0.3 % at F/6 and 24
        pixels) is neglected.

        Returns
        -------
        ndarray
            Square array whose middle sample is the pixel's centre.
        """
        half = margin * oversampling
        count = fft.next_fast_len(4 * half)
        frequency = fft.fftfreq(count, 1.0 / oversampling)
        values = fft.fftshift(fft.ifft2(self.transfer(frequency[None, :], frequency[:, None], motion)).real)
        middle = slice(count // 2 - half, count // 2 + half + 1)
        distance = np.abs(np.arange(-half, half + 1)) / half
        fade = 0.5 + 0.5 * np.cos(np.pi * np.clip((distance - _TAPER) / (1.0 - _TAPER), 0.0, 1.0))
        spread = values[middle, middle] * fade[:, None] * fade
        return np.asarray(spread / spread.sum())

    def _lens(self, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        """Return the lens's transfer function at frequencies fx, fy (cycles/m), about the centroid of its image."""
        values = self._table(fx, fy)
        if self.pupil.shadow is None:
            return np.asarray(values.real)
        x, y = self._table.centroid
        return np.asarray(values * np.exp(2j * np.pi * (fx * x + fy * y)))

    @cached_property
    def _table(self) -> TransferTable:
        """Polychromatic transfer function of the lens, weighted by photons of the Sun."""
        wavelength, weight = band_wavelengths(self.ccd.band)
        return TransferTable.build(self.pupil, wavelength, weight * black_body_photons(wavelength, SUN_TEMPERATURE))


def _shadow(outlines: tuple[tuple[tuple[float, float], ...], ...], harmonics: np.ndarray) -> PupilShadow:
    """Return the obstruction of a pupil by outlines, given as polygons in units of the pupil's radius."""
    shapes = [np.array(outline, float)[None] for outline in outlines]
    pieces, _ = separate([s if area(s)[0] > 0.0 else s[:, ::-1] for s in shapes])
    return PupilShadow.within(pieces, harmonics[:, None])


def _eikonal(terms: dict[int, float]) -> np.ndarray | None:
    """Return a wavefront, given by Zernike terms, as coefficients of products of Chebyshev polynomials."""
    if not terms:
        return None
    monomials = [(a, b, size * c) for index, size in terms.items() for a, b, c in cartesian_terms(index)]
    degree = max(a + b for a, b, _ in monomials)
    power = np.zeros((degree + 1, degree + 1))
    for a, b, c in monomials:
        power[a, b] += c
    to_chebyshev = np.zeros((degree + 1, degree + 1))
    for k in range(degree + 1):
        to_chebyshev[: k + 1, k] = chebyshev.poly2cheb([0.0] * k + [1.0])
    return np.asarray(to_chebyshev @ power @ to_chebyshev.T)


def _mean_of_steps(cycles: np.ndarray, count: int) -> np.ndarray:
    """Return the mean of exp(2 pi i k cycles) over `count` values of k in unit steps, centred on 0."""
    near = np.sinc(cycles)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(np.abs(near) < 1e-9, 1.0, np.sinc(count * cycles) / near)


JITTER_TOLERANCE = 1e-3
"""Tolerance of the position and smear of an image that is averaged over moments of the jitter, in pixels."""


def _jitter(sensor: Sensor) -> Jitter | None:
    """Return the jitter of the attitude of a sensor's trajectory; None where it has none."""
    jitter = sensor.trajectory.jitter if isinstance(sensor.trajectory, Trajectory) else None
    return jitter if isinstance(jitter, Jitter) else None


def _with(sensor: Sensor, jitter: Jitter | None) -> Sensor:
    """Return the sensor with the given jitter of its trajectory instead of its own."""
    assert isinstance(sensor.trajectory, Trajectory)
    return replace(sensor, trajectory=replace(sensor.trajectory, jitter=jitter))


def _collection(sensor: Sensor, optics: LineOptics) -> Collection:
    """Return the light collection of a TDI line: times and durations for which its stages collect light."""
    return Collection.of(optics.ccd.band.tdi, sensor.line_time)


def with_mean_jitter(sensor: Sensor, optics: LineOptics) -> Sensor:
    """Return the sensor with its jitter averaged over the exposure, which gives the mean positions of an image."""
    jitter = _jitter(sensor)
    return sensor if jitter is None else _with(sensor, jitter.over(_collection(sensor, optics)))


def without_jitter(sensor: Sensor) -> Sensor:
    """Return the sensor without its jitter."""
    return sensor if _jitter(sensor) is None else _with(sensor, None)


def exposures(sensor: Sensor, optics: LineOptics) -> list[tuple[float, Sensor]]:
    """Return the moments of a pixel's exposure: the share of the light (sum 1) and the sensor at each.

    Raises
    ------
    ValueError
        The jitter is so fast and large that too many moments would be necessary.
    """
    jitter = _jitter(sensor)
    if jitter is None:
        return [(1.0, sensor)]
    slope = sensor.camera.look_and_slope(np.array([0.5 * (sensor.camera.pixels - 1)]))[1]
    moments = jitter.exposures(_collection(sensor, optics), float(np.linalg.norm(slope)), JITTER_TOLERANCE)
    return [(share, _with(sensor, moment_jitter)) for share, moment_jitter in moments]
