"""Images of test targets at infinity on the cameras' line CCDs, and of slanted edges at any defocus.

The image of a straight edge depends on the optical transfer function along the edge's normal alone. So for every site
and edge it is worked out once, over frequency and defocus, and interpolated: a move of the detector along its normal
by micrometres, or of the collimator's target through focus, changes nothing else that matters (a tilt of the detector
by arcminutes scales the direction cosines by 1e-6).

A target stands still in the direction that a place on the line sees in the nominal state. Coordinates in an image are
(along, across) = (Y', X') of the focal plane: columns run along the line, rows along the track. The window that is
recorded follows the image by whole pixels, so that the image lies on the pixels as it does in the camera.

Pupils of an image in the light of a band: one that serves all wavelengths, or one of each where lenses are.
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
"""Largest change of an MTF by a rule of more wavelengths at which it is taken as it is."""

LARGEST_RULE = 65
"""Wavelengths of the last rule, beyond which there is no MTF over a light."""


@dataclass(frozen=True, eq=False)
class BandPupils:
    """Pupils of one image, all about one point of it, so that colours that stand apart blur it.

    Attributes
    ----------
    pupils : tuple[PupilFunction, ...]
        Of every wavelength, (K,), or one alone, the same at all of them.
    wavelengths : np.ndarray
        (K,), metres.
    weights : np.ndarray
        Share of the signal at each, (K,), which sum to 1.
    """

    pupils: tuple[PupilFunction, ...]
    wavelengths: np.ndarray
    weights: np.ndarray

    @classmethod
    def alike(cls, pupil: PupilFunction, band: BandSpec) -> BandPupils:
        """The pupil of mirrors, in a band's light."""
        return cls((pupil,), *band_wavelengths(band))

    @property
    def shortest(self) -> PupilFunction:
        """Of the shortest wavelength, which has the finest image."""
        return self.pupils[0 if len(self.pupils) == 1 else int(np.argmin(self.wavelengths))]

    @property
    def light(self) -> float:
        """Share of the light that nothing stops."""
        if len(self.pupils) == 1:
            return self.pupils[0].light
        return float(np.dot(self.weights, [pupil.light for pupil in self.pupils]) / np.sum(self.weights))

    def transfer(self, frequency: np.ndarray, defocus: np.ndarray) -> np.ndarray:
        """Optical transfer function, complex (Z, M); arguments as of ``polychromatic_transfer``."""
        pupil = self.pupils if len(self.pupils) > 1 else self.pupils[0]
        return polychromatic_transfer(pupil, frequency, self.wavelengths, self.weights, defocus)

    def table(self) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """The same at focus for many frequencies, interpolated: fx, fy (cycles/m) of one shape -> complex of it."""
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
    """How many wavelengths an MTF over a spectrum takes.

    Parameters
    ----------
    spectrum : SpectrumSpec
        The light.
    first : int
        Count of the first rule.
    values : Callable[[int], np.ndarray]
        Of the MTF by the rule of so many wavelengths, or of other numbers of this kind.
    largest : int
        Wavelengths of the last rule.

    Raises
    ------
    UnphysicalError
        It still changes by more than ``WORST_CHANGE`` at ``largest`` wavelengths.
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
        f"with {count} wavelengths (at most {WORST_CHANGE:g}): colours stand too far apart"
    )


ALONG, TRACK = "along", "track"
DIRECTIONS = (ALONG, TRACK)
"""In which the MTF is measured: along the line, and along the track."""

DIRECTION_NAMES: Mapping[str, str] = {ALONG: "along the line", TRACK: "along the track"}
"""Directions for readers."""

EDGE_RUNS: Mapping[str, Literal["x", "y"]] = {ALONG: "y", TRACK: "x"}
"""Direction -> axis of the image along which its edge runs."""

FREQUENCIES = 97
"""Samples of a transfer function from 0 to the cut-off."""

DEFOCUS_STEP = 25e-6
"""Step of the table over defocus, metres. The transfer function of an F/9 beam turns by one cycle in 250 um or
more, and quintic splines through ten samples per cycle are right to 2e-4."""

TABLE_REACH = 0.6e-3
"""Defocus up to which the table goes, metres; a few images farther out are worked out one by one."""


def knife_edge(direction: str, angle: float) -> HalfPlane:
    """The knife edge, on the target, that measures in a direction and is turned by ``angle``, radians."""
    shape = slanted_edge(angle, EDGE_RUNS[direction]).parts[0][1]
    assert isinstance(shape, HalfPlane)
    return shape


@dataclass(frozen=True, eq=False)
class EdgeOptics:
    """Optical transfer function along one direction at one site, over defocus.

    Attributes
    ----------
    light : BandPupils
        Pupils of the site in the band's light.
    band : BandSpec
        Whose light it is.
    normal : np.ndarray
        Direction of the frequencies in the image, unit, (2,).
    cutoff : float
        cycles/m, of the shortest wavelength.
    table : BSpline
        Spline over defocus of the samples at ``frequencies``, complex as (real, imaginary).
    """

    light: BandPupils
    band: BandSpec
    normal: np.ndarray
    cutoff: float
    table: BSpline

    @classmethod
    def build(
        cls, light: PupilFunction | BandPupils, band: BandSpec, normal: np.ndarray, reach: float = TABLE_REACH
    ) -> EdgeOptics:
        """Work the table out for defocus up to +-reach, metres. One pupil alone serves all of the band's light."""
        light = BandPupils.alike(light, band) if isinstance(light, PupilFunction) else light
        cutoff = float(light.shortest.cutoff(normal[None], band.spectrum.ends[0])[0])
        steps = max(int(np.ceil(reach / DEFOCUS_STEP)), 3)
        defocus = np.linspace(-reach, reach, 2 * steps + 1)
        samples = _samples(light, normal, cutoff, defocus)
        return cls(light, band, normal, cutoff, make_interp_spline(defocus, samples, k=5))

    @property
    def pupil(self) -> PupilFunction:
        """Of the site; of the shortest wavelength where each has its own."""
        return self.light.shortest

    @property
    def frequencies(self) -> np.ndarray:
        """Samples along the normal, cycles/m."""
        return np.linspace(0.0, self.cutoff, FREQUENCIES)

    def at(self, defocus: float, frequency: np.ndarray) -> np.ndarray:
        """Complex transfer function at frequencies along the normal, cycles/m, not negative."""
        if abs(defocus) <= self.table.t[-1]:
            samples = self.table(defocus)
        else:
            samples = _samples(self.light, self.normal, self.cutoff, np.array([defocus]))[0]
        parts = make_interp_spline(self.frequencies, samples, k=5)(np.minimum(frequency, self.cutoff))
        return np.where(frequency < self.cutoff, parts[..., 0] + 1j * parts[..., 1], 0.0)


def _samples(light: BandPupils, normal: np.ndarray, cutoff: float, defocus: np.ndarray) -> np.ndarray:
    """Real and imaginary part at evenly spaced frequencies, (Z, FREQUENCIES, 2)."""
    frequency = np.linspace(0.0, cutoff, FREQUENCIES)[:, None] * normal
    values = light.transfer(frequency, defocus)
    return np.stack([values.real, values.imag], axis=-1)


_ROUND_CUTOFF = 10e3
"""Cut-offs are rounded up to multiples of this, cycles/m,"""
_ROUND_REACH = 4.0
"""and reaches to multiples of this, pixels."""


@dataclass(frozen=True, eq=False)
class EdgeImager:
    """Images of one edge at one site as a line CCD takes them.

    Attributes
    ----------
    optics : EdgeOptics
        Transfer function along the edge's normal.
    ccd : LineCcd
        The line CCD.
    region : int
        Side of the square image, pixels.
    """

    optics: EdgeOptics
    ccd: LineCcd
    region: int

    def transfer(self, defocus: float, frequency: np.ndarray) -> np.ndarray:
        """Optics, pixel, diffusion and TDI together along the normal, complex."""
        x, y = self.optics.normal
        return self.optics.at(defocus, frequency) * self.ccd.transfer(frequency * x, frequency * y)

    def mtf(self, defocus: float, frequency: float) -> float:
        """Modulus of ``transfer`` at one frequency, cycles/m: the truth that a measurement is compared with."""
        return float(np.abs(self.transfer(defocus, np.array([frequency])))[0])

    def image(self, defocus: float, offset: float) -> np.ndarray:
        """Share of the white signal in every pixel, (region, region).

        Parameters
        ----------
        defocus : float
            Of the detector, metres, positive downstream.
        offset : float
            Of the edge from the middle of the image along its normal, metres.
        """
        pitch, normal = self.ccd.band.pitch, self.optics.normal
        grid = Grid(-0.5 * (self.region - 1) * pitch, pitch, self.region)

        def transfer(fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
            return self.transfer(defocus, np.hypot(fx, fy))

        # the same rounded numbers for all sites of a band, so that the profile's sampling is worked out once
        reach = (0.5 * self.region * float(np.sum(np.abs(normal))) + abs(offset) / pitch) // _ROUND_REACH + 1.0
        cutoff = _ROUND_CUTOFF * (self.optics.cutoff // _ROUND_CUTOFF + 1.0)
        profile = EdgeProfile.build(transfer, normal, cutoff, _ROUND_REACH * reach * pitch)
        return np.maximum(profile.image(HalfPlane(offset * profile.normal, profile.normal), grid, grid), 0.0)


PLACES = {"left": 1.0, "centre": 0.0, "right": -1.0}
"""Places on the line by their share of its usable half; left is the +Y' end."""

MARGIN = 0.02
"""Share of the line's pixels kept between each end and the nominal windows, so that an image may move."""

BAR_TILT = float(np.radians(7.0))
"""Tilt of the bars' normal from the axis, radians: within the group every sampling phase occurs four times, even in 112
pixels."""

BAR_SHARE = 0.45
"""Side of the bar group, as a share of the region's."""

CLEARANCE = 6.0
"""Pixels of the group about the part that is measured."""

_FOCUS = 1e-6
"""Defocus to which the tables of the edges reach, metres; they are used at 0 only."""


class TargetLostError(PhysicalError):
    """A target cannot be imaged in this state; the message says where and why."""


@dataclass(frozen=True, eq=False)
class View:
    """One place of a camera's line in one state.

    Attributes
    ----------
    ccd : LineCcd
        The line CCD.
    light : BandPupils
        Pupils of the image in the band's light.
    local : LocalMap
        Mapping from target coordinates (metres on the nominal image scale) to the image, about the chief ray.
    shift : np.ndarray
        Of the chief ray's place on the focal plane against the nominal state, (along, across), metres.
    column : int
        First column of the window on the line.
    offset : np.ndarray
        Of the chief ray from the middle of the window, (along, across), metres.
    region : int
        Side of the window, pixels.
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
        """Of the image; of the shortest wavelength where each has its own."""
        return self.light.shortest

    def transfer(self, frequency: np.ndarray) -> np.ndarray:
        """Transfer function of the traced pupil and the detector at frequencies (M, 2), cycles/m, complex (M,)."""
        optics = self.light.transfer(frequency, np.zeros(1))[0]
        return np.asarray(optics * self.ccd.transfer(frequency[:, 0], frequency[:, 1]))

    def edge(self, direction: str, angle: float) -> EdgeImager:
        """Images of the knife edge that measures in a direction and is turned by ``angle``, radians."""
        normal = knife_edge(direction, angle).mapped(self.local).normal
        optics = EdgeOptics.build(self.light, self.band, normal, _FOCUS)
        return EdgeImager(optics, self.ccd, self.region)

    def edge_image(self, imager: EdgeImager) -> np.ndarray:
        """Share of the white signal in every pixel, (region, region)."""
        return imager.image(0.0, float(self.offset @ imager.optics.normal))

    def image(self, target: Target) -> np.ndarray:
        """Share of the white signal in every pixel of a target of finite shapes, (region, region)."""
        half = 0.5 * (self.region - 1) * self.band.pitch
        x, y = (Grid(float(-half - shift), self.band.pitch, self.region) for shift in self.offset)
        # rounding and the series' guard leave up to 1e-6 below zero
        return np.maximum(target_image(target.mapped(self.local), self._transfer, self._cutoff, x, y), 0.0)

    def _transfer(self, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        return np.asarray(self._table(fx, fy) * self.ccd.transfer(fx, fy))

    @cached_property
    def _table(self) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        return self.light.table()

    @cached_property
    def _cutoff(self) -> float:
        angle = np.linspace(0.0, np.pi, 64, endpoint=False)
        ways = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        # between the directions the cut-off of a smooth pupil is higher by less than 1e-3
        return 1.001 * float(np.max(self.pupil.cutoff(ways, self.band.spectrum.ends[0])))


@dataclass(frozen=True, eq=False)
class BarDesign:
    """Bars in a window's middle that have the Nyquist frequency on the nominal image, and what is measured of them.

    Attributes
    ----------
    target : Target
        The bars.
    frequency : np.ndarray
        On the target, (2,), cycles/m.
    nominal : np.ndarray
        On the nominal image, (2,), cycles/m.
    group : tuple[slice, slice]
        (rows, columns) of the window that lie well inside the group.
    """

    target: Target
    frequency: np.ndarray
    nominal: np.ndarray
    group: tuple[slice, slice]

    @classmethod
    def build(cls, view: View, direction: str) -> BarDesign:
        """For the nominal view of a place."""
        pitch, jacobian = view.band.pitch, view.local.jacobian
        turn = BAR_TILT if direction == ALONG else BAR_TILT + 0.5 * np.pi
        nominal = view.band.nyquist * np.array([np.cos(turn), np.sin(turn)])
        # phases agree on target and image: f_target . q = f_image . (J q)
        frequency = jacobian.T @ nominal
        size, angle = float(np.hypot(*frequency)), float(np.arctan2(frequency[1], frequency[0]))
        bars = round(BAR_SHARE * view.region * pitch * view.band.nyquist)
        # as long on the image as the group is wide there
        stretch = float(np.hypot(*(jacobian @ np.array([-np.sin(angle), np.cos(angle)]))))
        target = bar_group(size, bars, bars / (view.band.nyquist * stretch), angle)
        # the upright square in a tilted one; the image lies up to half a pixel beside the middle
        inside = bars - CLEARANCE - 0.5
        half = int(inside / (np.cos(BAR_TILT) + np.sin(BAR_TILT)))
        sides = slice(view.region // 2 - half, view.region - view.region // 2 + half)
        return cls(target, frequency, nominal, (sides, sides))

    def seen(self, view: View) -> np.ndarray:
        """Frequency on the image of a view, (2,), cycles/m."""
        return np.asarray(np.linalg.solve(view.local.jacobian.T, self.frequency))

    @property
    def per_pixel(self) -> tuple[float, float]:
        """Nominal frequency over the Nyquist frequency's 0.5 cycles/pixel: (down the column, along the row)."""
        along, across = 0.5 * self.nominal / float(np.hypot(*self.nominal))
        return float(across), float(along)


def usable_pixels(pixels: int, region: int) -> float:
    """How far the windows' middles may spread on a line, pixels; not positive where they do not fit."""
    return (1.0 - 2.0 * MARGIN) * pixels - region


class TargetCamera:
    """A camera before targets at infinity.

    Parameters
    ----------
    path
        Of its light.
    ccd
        The line CCD.
    region
        Side of the windows, pixels.

    Raises
    ------
    ValueError
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
        along = 0.5 * usable * band.pitch * np.array(list(PLACES.values()))
        self.places = np.stack([along, np.full(len(along), band.offset)], axis=-1)
        """Nominal (along, across) of PLACES, metres."""
        self.directions = path.directions(self.places)

    def views(self, state: State) -> dict[str, View]:
        """Every place in a state.

        Raises
        ------
        TargetLostError
            Light is lost, or an image moves off the line.
        """
        try:
            hits = self.path.places(state, self.directions)
            lights = self._lights(state, hits)
            reach = self.region * self.ccd.band.pitch
            maps = [self.path.local_map(state, direction, reach) for direction in self.directions]
        except (AimError, BeamMissedError, ValueError) as error:
            raise TargetLostError(f"the line CCD of camera {self.path.name}: {error}") from error
        return {name: self._view(name, hits[i], self.places[i], lights[i], maps[i]) for i, name in enumerate(PLACES)}

    def _lights(self, state: State, hits: np.ndarray, count: int | None = None) -> list[BandPupils]:
        """Pupils of every place in the band's light; of lenses at each wavelength of the rule of ``count``, or of as
        many as the MTF takes.
        """
        band = self.ccd.band
        if not lenses(self.path.model.spec):
            return [BandPupils.alike(one, band) for one in self.path.pupils(state, self.directions, hits)]
        wavelengths, weights = band.spectrum.rule(self._wavelengths if count is None else count)
        every = [self.path.pupils(state, self.directions, hits, wavelength=float(colour)) for colour in wavelengths]
        return [BandPupils(own, wavelengths, weights) for own in zip(*every, strict=True)]

    @cached_property
    def _wavelengths(self) -> int:
        """How many the MTF of the camera as designed takes; of a moved one they serve as well."""
        hits = self.path.places({}, self.directions)

        def at_nyquist(count: int) -> np.ndarray:
            frequency = self.ccd.band.nyquist * np.eye(2)
            lights = self._lights({}, hits, count)
            return np.abs([light.transfer(frequency, np.zeros(1))[0] for light in lights])

        return wavelengths_enough(self.ccd.band.spectrum, len(band_wavelengths(self.ccd.band)[0]), at_nyquist)

    def _view(self, name: str, hit: np.ndarray, nominal: np.ndarray, light: BandPupils, local: LocalMap) -> View:
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
