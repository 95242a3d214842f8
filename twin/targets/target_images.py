"""Images of test targets at infinity on the cameras' line CCDs, and of slanted edges at any defocus.

The image of a straight edge depends only on the optical transfer function along the edge's normal. It is computed once
for every position in the field and every edge, over frequency and defocus, and interpolated. A displacement of the
detector along its normal by micrometres, or of the collimator's target through focus, has no other significant effect
on the function (a tilt of the detector by arcminutes scales the direction cosines by 1e-6).

A target is fixed in the direction in object space that a position on the line CCD sees in the nominal state.
Coordinates in an image are (along, across) = (Y', X') of the focal plane: columns run along the line, rows along the
track. The recorded window follows the image by whole pixels, so that the image lies on the pixels as it does in the
camera.

The pupils of an image in the light of a band are one for all wavelengths, or, with lenses, one for each wavelength.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from optics.geometry.tree import State
from optics.geometry.vector_shape import HalfPlane
from optics.numerics.array_math import PhysicalError, UnphysicalError
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from optics.targets.target_image import EdgeProfile, target_image
from optics.targets.target_shapes import Target, bar_group, slanted_edge
from optics.waves.diffraction import Grid
from optics.waves.optical_transfer import TransferTable, polychromatic_transfer
from optics.waves.pupil_stack import PupilFunction
from scenes.models.camera_model import lenses
from scenes.specs.camera import BandSpec
from scenes.specs.spectrum import SpectrumSpec
from twin.sensors.line_ccd import LineCcd, band_wavelengths
from twin.targets.target_path import LocalMap, TargetPath

WORST_CHANGE = 5e-4
"""Largest accepted change of an MTF when more wavelengths are used in the quadrature over the band."""

LARGEST_RULE = 65
"""Number of wavelengths of the finest quadrature over a band; an MTF that still changes there raises an error."""


@dataclass(frozen=True, eq=False)
class BandPupils:
    """Pupil functions of one image at the wavelengths of a band.

    All refer to the same image point, so that lateral colour blurs the image.

    Attributes
    ----------
    pupils : tuple of PupilFunction
        Pupils of the K wavelengths, or a single one for all of them.
    wavelengths : (K,) ndarray
        Wavelengths, in metres.
    weights : (K,) ndarray
        Fraction of the signal at each wavelength, with sum 1.
    """

    pupils: tuple[PupilFunction, ...]
    wavelengths: np.ndarray
    weights: np.ndarray

    @classmethod
    def achromatic(cls, pupil: PupilFunction, band: BandSpec) -> BandPupils:
        """Return the pupils of a mirror system, the same at all wavelengths of a band."""
        return cls((pupil,), *band_wavelengths(band))

    @property
    def shortest(self) -> PupilFunction:
        """Pupil of the shortest wavelength, which has the finest image."""
        return self.pupils[0 if len(self.pupils) == 1 else int(np.argmin(self.wavelengths))]

    @property
    def light(self) -> float:
        """Fraction of the pupil's light that is not blocked, mean over the band, 0 to 1."""
        if len(self.pupils) == 1:
            return self.pupils[0].light
        return float(np.dot(self.weights, [pupil.light for pupil in self.pupils]) / np.sum(self.weights))

    def transfer(self, frequency: np.ndarray, defocus: np.ndarray) -> np.ndarray:
        """Return the optical transfer function over the band at M frequencies and Z defocus values, complex (Z, M)."""
        pupil = self.pupils if len(self.pupils) > 1 else self.pupils[0]
        return polychromatic_transfer(pupil, frequency, self.wavelengths, self.weights, defocus)

    def table(self) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """Return a function that interpolates the in-focus transfer function at arrays of spatial frequencies.

        The function takes fx, fy (cycles/m) of one shape and returns complex values of that shape.
        """
        if len(self.pupils) == 1:
            return TransferTable.build(self.pupils[0], self.wavelengths, self.weights)
        shares = self.weights / np.sum(self.weights)
        tables = [
            TransferTable.build(pupil, self.wavelengths[k : k + 1], np.ones(1)) for k, pupil in enumerate(self.pupils)
        ]

        def over_light(fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
            return np.asarray(sum(share * table(fx, fy) for share, table in zip(shares, tables, strict=True)))

        return over_light


def wavelengths_enough(
    spectrum: SpectrumSpec, first: int, values: Callable[[int], np.ndarray], largest: int = LARGEST_RULE
) -> int:
    """Return the number of wavelengths needed for an MTF over a spectrum.

    Parameters
    ----------
    spectrum : SpectrumSpec
        Spectrum of the light.
    first : int
        Number of wavelengths to start with.
    values : callable
        Function of the number of wavelengths that returns MTF values, which are compared from one number to the next.
    largest : int
        Largest number of wavelengths that is tried.

    Raises
    ------
    UnphysicalError
        The values still change by more than ``WORST_CHANGE`` at ``largest`` wavelengths.
    """
    if spectrum.lines or spectrum.ends[0] == spectrum.ends[1]:
        return first
    count, before, change = first, values(first), np.inf
    while count < largest:
        count = 2 * count - 1
        after = values(count)
        change = float(np.max(np.abs(after - before)))
        if change <= WORST_CHANGE:
            return count
        before = after
    raise UnphysicalError(
        f"the MTF over {1e9 * spectrum.ends[0]:.6g} to {1e9 * spectrum.ends[1]:.6g} nm still changes by {change:.2g} "
        f"with {count} wavelengths (at most {WORST_CHANGE:g}): the lateral colour is too large"
    )


ALONG, TRACK = "along", "track"
DIRECTIONS = (ALONG, TRACK)
"""Directions in which the MTF is measured: along the line, and along the track."""

DIRECTION_NAMES: Mapping[str, str] = {ALONG: "along the line", TRACK: "along the track"}
"""Names of the directions in reports."""

EDGE_RUNS: Mapping[str, Literal["x", "y"]] = {ALONG: "y", TRACK: "x"}
"""Direction in which the MTF is measured -> axis of the image (x or y) along which the measured knife edge runs."""

FREQUENCIES = 97
"""Number of frequencies, from 0 to the cut-off, at which the transfer function along an edge's normal is sampled."""

DEFOCUS_STEP = 25e-6
"""Step in defocus of the table of transfer functions, in metres.

The phase of the transfer function of an F/9 beam changes by one cycle in 250 µm or more, and quintic splines through
ten samples per cycle are accurate to 2e-4.
"""

TABLE_EXTENT = 0.6e-3
"""Largest absolute defocus of the table of transfer functions, in metres; beyond it they are computed one by one."""


def knife_edge(direction: str, angle: float) -> HalfPlane:
    """Return the knife edge, in target coordinates, by which the MTF in a direction is measured.

    ``direction`` is ``ALONG`` (the line) or ``TRACK`` (along the track); ``angle`` is the rotation of the edge from its
    axis, in radians.
    """
    shape = slanted_edge(angle, EDGE_RUNS[direction]).parts[0][1]
    assert isinstance(shape, HalfPlane)
    return shape


@dataclass(frozen=True, eq=False)
class EdgeOptics:
    """Optical transfer function along one direction at one field position, as a function of defocus.

    Attributes
    ----------
    light : BandPupils
        Pupils of the field position at the band's wavelengths.
    band : BandSpec
        Band of the light.
    normal : (2,) ndarray
        Direction of the frequencies in the image, unit vector.
    cutoff : float
        Cut-off frequency of the shortest wavelength, in cycles/m.
    table : BSpline
        Spline over defocus of the transfer function at ``frequencies``, as real and imaginary parts.
    """

    light: BandPupils
    band: BandSpec
    normal: np.ndarray
    cutoff: float
    table: BSpline

    @classmethod
    def build(
        cls, light: PupilFunction | BandPupils, band: BandSpec, normal: np.ndarray, extent: float = TABLE_EXTENT
    ) -> EdgeOptics:
        """Compute the transfer functions for defocus up to +-``extent``, in metres.

        A single pupil serves all wavelengths of the band.
        """
        light = BandPupils.achromatic(light, band) if isinstance(light, PupilFunction) else light
        cutoff = float(light.shortest.cutoff(normal[None], band.spectrum.ends[0])[0])
        steps = max(int(np.ceil(extent / DEFOCUS_STEP)), 3)
        defocus = np.linspace(-extent, extent, 2 * steps + 1)
        samples = _samples(light, normal, cutoff, defocus)
        return cls(light, band, normal, cutoff, make_interp_spline(defocus, samples, k=5))

    @property
    def pupil(self) -> PupilFunction:
        """Pupil of the field position; with one pupil per wavelength, that of the shortest."""
        return self.light.shortest

    @property
    def frequencies(self) -> np.ndarray:
        """Non-negative frequencies along the edge's normal at which the transfer function is sampled, in cycles/m."""
        return np.linspace(0.0, self.cutoff, FREQUENCIES)

    def at(self, defocus: float, frequency: np.ndarray) -> np.ndarray:
        """Return the complex transfer function at a defocus, in m, and frequencies along the normal, in cycles/m.

        Frequencies are not negative.
        """
        if abs(defocus) <= self.table.t[-1]:
            samples = self.table(defocus)
        else:
            samples = _samples(self.light, self.normal, self.cutoff, np.array([defocus]))[0]
        parts = make_interp_spline(self.frequencies, samples, k=5)(np.minimum(frequency, self.cutoff))
        return np.where(frequency < self.cutoff, parts[..., 0] + 1j * parts[..., 1], 0.0)


def _samples(light: BandPupils, normal: np.ndarray, cutoff: float, defocus: np.ndarray) -> np.ndarray:
    """Return the transfer function at Z defocus values and evenly spaced frequencies, (Z, FREQUENCIES, 2).

    The last axis holds the real and the imaginary part.
    """
    frequency = np.linspace(0.0, cutoff, FREQUENCIES)[:, None] * normal
    values = light.transfer(frequency, defocus)
    return np.stack([values.real, values.imag], axis=-1)


_ROUND_CUTOFF = 10e3
"""Step, in cycles/m, to which cut-off frequencies are rounded up.

All positions in a band's field then share one sampling of the edge profile.
"""
_EXTENT_STEP = 4.0
"""Step, in pixels, to which the extents of edge profiles are rounded up.

All positions in a band's field then share one sampling of the edge profile.
"""


@dataclass(frozen=True, eq=False)
class EdgeImager:
    """Imager of one knife edge at one field position, as a line CCD records it.

    Attributes
    ----------
    optics : EdgeOptics
        Transfer function along the edge's normal.
    ccd : LineCcd
        Line CCD.
    region : int
        Side of the square image, in pixels.
    """

    optics: EdgeOptics
    ccd: LineCcd
    region: int

    def transfer(self, defocus: float, frequency: np.ndarray) -> np.ndarray:
        """Return the complex transfer function of optics, pixel, charge diffusion and TDI along the edge's normal.

        ``defocus`` is in metres and ``frequency`` in cycles/m.
        """
        x, y = self.optics.normal
        return self.optics.at(defocus, frequency) * self.ccd.transfer(frequency * x, frequency * y)

    def mtf(self, defocus: float, frequency: float) -> float:
        """Return the MTF of optics and detector at a defocus, in metres, and one frequency, in cycles/m.

        It is the true value for comparison with a measurement.
        """
        return float(np.abs(self.transfer(defocus, np.array([frequency])))[0])

    def image(self, defocus: float, offset: float) -> np.ndarray:
        """Return the recorded image of the edge, as fractions of the signal of a white area, (region, region).

        Parameters
        ----------
        defocus : float
            Defocus of the detector, in metres, positive downstream.
        offset : float
            Distance of the edge from the centre of the image along its normal, in metres.
        """
        pitch, normal = self.ccd.band.pitch, self.optics.normal
        grid = Grid(-0.5 * (self.region - 1) * pitch, pitch, self.region)

        def transfer(fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
            return self.transfer(defocus, np.hypot(fx, fy))

        # rounded, so that all sites of a band share one sampling of the profile
        extent = (0.5 * self.region * float(np.sum(np.abs(normal))) + abs(offset) / pitch) // _EXTENT_STEP + 1.0
        cutoff = _ROUND_CUTOFF * (self.optics.cutoff // _ROUND_CUTOFF + 1.0)
        profile = EdgeProfile.build(transfer, normal, cutoff, _EXTENT_STEP * extent * pitch)
        return np.maximum(profile.image(HalfPlane(offset * profile.normal, profile.normal), grid, grid), 0.0)


POSITIONS = {"left": 1.0, "centre": 0.0, "right": -1.0}
"""Positions on the line as fractions of its usable half; left is the +Y' end."""

MARGIN = 0.02
"""Part of the line's pixels at each end in which no window lies nominally, as a fraction, so that images can move."""

BAR_TILT = float(np.radians(7.0))
"""Tilt of the bars' normal from the axis, in radians.

With it, every phase of the bars relative to the pixels occurs four times in the bar group, even in a window of 112
pixels.
"""

BAR_SHARE = 0.45
"""Side of the bar group's image relative to the side of the window."""

CLEARANCE = 6.0
"""Margin between the border of the bar group and the part of it that is measured, in pixels."""

_FOCUS = 1e-6
"""Range of defocus, in metres, of the tables of transfer functions for targets; only their value at 0 is used."""


class TargetLostError(PhysicalError):
    """Error for a target that cannot be imaged in a state of the camera; the message says where and why."""


@dataclass(frozen=True, eq=False)
class View:
    """Image of a target at one position on a camera's line CCD, in one state of the camera.

    Attributes
    ----------
    ccd : LineCcd
        Line CCD.
    light : BandPupils
        Pupils of the image in the band's light.
    local : LocalMap
        Mapping from target coordinates (metres on the nominal image scale) to the image, about the chief ray.
    shift : (2,) ndarray
        Displacement of the chief ray on the focal plane from the nominal state, (along, across), in metres.
    column : int
        First column of the window on the line.
    offset : (2,) ndarray
        Distance of the chief ray from the centre of the window, (along, across), in metres.
    region : int
        Side of the window, in pixels.
    """

    ccd: LineCcd
    light: BandPupils
    local: LocalMap
    shift: np.ndarray
    column: int
    offset: np.ndarray
    region: int

    @property
    def band(self) -> BandSpec:
        """Band of the line CCD."""
        return self.ccd.band

    @property
    def pupil(self) -> PupilFunction:
        """Pupil of the image; with one pupil per wavelength, that of the shortest."""
        return self.light.shortest

    def transfer(self, frequency: np.ndarray) -> np.ndarray:
        """Return the complex transfer function of optics and detector at M frequencies (along, across), in cycles/m."""
        optics = self.light.transfer(frequency, np.zeros(1))[0]
        return np.asarray(optics * self.ccd.transfer(frequency[:, 0], frequency[:, 1]))

    def edge(self, direction: str, angle: float) -> EdgeImager:
        """Return the imager of the knife edge that measures the MTF in a direction, rotated by ``angle``, radians."""
        normal = knife_edge(direction, angle).mapped(self.local).normal
        optics = EdgeOptics.build(self.light, self.band, normal, _FOCUS)
        return EdgeImager(optics, self.ccd, self.region)

    def edge_image(self, imager: EdgeImager) -> np.ndarray:
        """Return the recorded image of a knife edge, as fractions of a white area's signal, (region, region)."""
        return imager.image(0.0, float(self.offset @ imager.optics.normal))

    def image(self, target: Target) -> np.ndarray:
        """Return the image of a target of finite shapes, as fractions of a white area's signal, (region, region)."""
        half = 0.5 * (self.region - 1) * self.band.pitch
        x, y = (Grid(float(-half - shift), self.band.pitch, self.region) for shift in self.offset)
        # rounding and the guard band of the series give values down to -1e-6
        return np.maximum(target_image(target.mapped(self.local), self._transfer, self._cutoff, x, y), 0.0)

    def _transfer(self, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        """Return the complex transfer function of optics and detector at frequencies fx, fy, in cycles/m."""
        return np.asarray(self._table(fx, fy) * self.ccd.transfer(fx, fy))

    @cached_property
    def _table(self) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """Function that interpolates the optics' transfer function at frequencies fx, fy, in cycles/m."""
        return self.light.table()

    @cached_property
    def _cutoff(self) -> float:
        """Largest cut-off frequency over all directions, in cycles/m."""
        angle = np.linspace(0.0, np.pi, 64, endpoint=False)
        directions = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        # between these directions the cut-off of a smooth pupil exceeds them by less than 1e-3
        return 1.001 * float(np.max(self.pupil.cutoff(directions, self.band.spectrum.ends[0])))


@dataclass(frozen=True, eq=False)
class BarDesign:
    """Bar target whose nominal image has the pixels' Nyquist frequency, and the region of the image that is measured.

    Attributes
    ----------
    target : Target
        Bars.
    frequency : (2,) ndarray
        Frequency vector (along, across) of the bars on the target, in cycles/m.
    nominal : (2,) ndarray
        Frequency vector (along, across) of the bars in the nominal image, in cycles/m.
    group : tuple of slice
        Rows and columns of the window in which the image shows bars only, at a distance from the group's border.
    """

    target: Target
    frequency: np.ndarray
    nominal: np.ndarray
    group: tuple[slice, slice]

    @classmethod
    def build(cls, view: View, direction: str) -> BarDesign:
        """Return the bar target whose image in the nominal view of a position has the Nyquist frequency.

        ``direction`` is that in which the MTF is measured: along the line or along the track.
        """
        pitch, jacobian = view.band.pitch, view.local.jacobian
        rotation = BAR_TILT if direction == ALONG else BAR_TILT + 0.5 * np.pi
        nominal = view.band.nyquist * np.array([np.cos(rotation), np.sin(rotation)])
        # phases agree on target and image: f_target . q = f_image . (J q)
        frequency = jacobian.T @ nominal
        size, angle = float(np.hypot(*frequency)), float(np.arctan2(frequency[1], frequency[0]))
        bars = round(BAR_SHARE * view.region * pitch * view.band.nyquist)
        # the bars are as long on the image as the group is wide
        scale = float(np.hypot(*(jacobian @ np.array([-np.sin(angle), np.cos(angle)]))))
        target = bar_group(size, bars, bars / (view.band.nyquist * scale), angle)
        # upright square inside a tilted one; the image is up to half a pixel off centre
        inside = bars - CLEARANCE - 0.5
        half = int(inside / (np.cos(BAR_TILT) + np.sin(BAR_TILT)))
        sides = slice(view.region // 2 - half, view.region - view.region // 2 + half)
        return cls(target, frequency, nominal, (sides, sides))

    def seen(self, view: View) -> np.ndarray:
        """Return the frequency vector (along, across) that the bars have in the image of a view, in cycles/m."""
        return np.asarray(np.linalg.solve(view.local.jacobian.T, self.frequency))

    @property
    def per_pixel(self) -> tuple[float, float]:
        """Nominal frequency vector of the bars, of magnitude 0.5 cycles/pixel: (down the column, along the row)."""
        along, across = 0.5 * self.nominal / float(np.hypot(*self.nominal))
        return float(across), float(along)


def usable_pixels(pixels: int, region: int) -> float:
    """Return the length of the line over which centres of windows may lie, in pixels; not positive if none fits."""
    return (1.0 - 2.0 * MARGIN) * pixels - region


class TargetCamera:
    """Camera that images targets at infinity.

    Parameters
    ----------
    path
        Optical path of the camera.
    ccd
        Line CCD.
    region
        Side of the windows, in pixels.

    Raises
    ------
    UnphysicalError
        The line is too short for the windows.
    """

    def __init__(self, path: TargetPath, ccd: LineCcd, region: int) -> None:
        band = ccd.band
        usable = usable_pixels(band.pixels, region)
        if usable <= 0.0:
            raise UnphysicalError(f"windows of {region} pixels do not fit a line of {band.pixels} pixels")
        self.path = path
        self.ccd = ccd
        self.region = region
        along = 0.5 * usable * band.pitch * np.array(list(POSITIONS.values()))
        self.positions = np.stack([along, np.full(len(along), band.offset)], axis=-1)
        """Nominal positions (along the line, across it) on the detector of the targets of PLACES, metres."""
        self.directions = path.directions(self.positions)

    def views(self, state: State) -> dict[str, View]:
        """Return the view of each position on the line (left, centre, right), by its name, in a state of the camera.

        Raises
        ------
        TargetLostError
            Light is lost, or an image moves off the line.
        """
        try:
            hits = self.path.positions(state, self.directions)
            lights = self._lights(state, hits)
            extent = self.region * self.ccd.band.pitch
            maps = [self.path.local_map(state, direction, extent) for direction in self.directions]
        except (AimError, BeamMissedError, ValueError) as error:
            raise TargetLostError(f"the line CCD of camera {self.path.name}: {error}") from error
        return {
            name: self._view(name, hits[i], self.positions[i], lights[i], maps[i]) for i, name in enumerate(POSITIONS)
        }

    def _lights(self, state: State, hits: np.ndarray, count: int | None = None) -> list[BandPupils]:
        """Return the pupil functions of every position on the line at the wavelengths of the camera's band.

        With lenses there is one pupil for each of ``count`` wavelengths, or of as many as the MTF needs.
        """
        band = self.ccd.band
        if not lenses(self.path.model.spec):
            return [BandPupils.achromatic(pupil, band) for pupil in self.path.pupils(state, self.directions, hits)]
        wavelengths, weights = band.spectrum.rule(self._wavelengths if count is None else count)
        by_wavelength = [
            self.path.pupils(state, self.directions, hits, wavelength=float(colour)) for colour in wavelengths
        ]
        return [BandPupils(pupils, wavelengths, weights) for pupils in zip(*by_wavelength, strict=True)]

    @cached_property
    def _wavelengths(self) -> int:
        """Number of wavelengths for the MTF of the camera as designed; it is used for perturbed states as well."""
        hits = self.path.positions({}, self.directions)

        def at_nyquist(count: int) -> np.ndarray:
            frequency = self.ccd.band.nyquist * np.eye(2)
            lights = self._lights({}, hits, count)
            return np.abs([light.transfer(frequency, np.zeros(1))[0] for light in lights])

        return wavelengths_enough(self.ccd.band.spectrum, len(band_wavelengths(self.ccd.band)[0]), at_nyquist)

    def _view(self, name: str, hit: np.ndarray, nominal: np.ndarray, light: BandPupils, local: LocalMap) -> View:
        """Return the view of one position from its traced chief ray, pupils and local mapping."""
        band, shift = self.ccd.band, hit - nominal
        half = 0.5 * (self.region - 1)
        middle = hit[0] / band.pitch + 0.5 * (band.pixels - 1)
        column = round(float(middle) - half)
        if column < 0 or column + self.region > band.pixels:
            raise TargetLostError(
                f"the target image at the {name} of camera {self.path.name} moves by {1e3 * shift[0]:.3g} mm along the "
                "line, beyond its end"
            )
        # rows are counted from the nominal image, columns from the line's first pixel
        rows = round(float(shift[1]) / band.pitch)
        offset = np.array([(middle - column - half) * band.pitch, shift[1] - rows * band.pitch])
        return View(self.ccd, light, local, shift, column, offset, self.region)
