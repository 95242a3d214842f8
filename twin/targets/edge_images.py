"""Images of slanted edges at places of a focal plane, at any defocus: exact, and fast enough for thousands.

The image of a straight edge depends on the optical transfer function along the edge's normal alone. So for every site
and edge it is worked out once, over frequency and defocus, and interpolated: a move of the detector along its normal
by micrometres, or of the collimator's target through focus, changes nothing else that matters (a tilt of the detector
by arcminutes scales the direction cosines by 1e-6).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from optics.geometry.vector_shape import HalfPlane
from optics.targets.target_image import EdgeProfile
from optics.targets.target_shapes import slanted_edge
from optics.waves.diffraction import Grid
from optics.waves.pupil_stack import PupilFunction
from optics.waves.transfer import polychromatic_transfer
from scenes.specs.camera import BandSpec
from twin.sensors.line_ccd import LineCcd, band_wavelengths

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

    Attributes:
        pupil: of the site.
        band: whose light it is.
        normal: direction of the frequencies in the image, unit, (2,).
        cutoff: cycles/m, of the shortest wavelength.
        table: spline over defocus of the samples at ``frequencies``, complex as (real, imaginary).
    """

    pupil: PupilFunction
    band: BandSpec
    normal: np.ndarray
    cutoff: float
    table: BSpline

    @classmethod
    def build(cls, pupil: PupilFunction, band: BandSpec, normal: np.ndarray, reach: float = TABLE_REACH) -> EdgeOptics:
        """Work the table out for defocus up to +-reach, metres."""
        cutoff = float(pupil.cutoff(normal[None], band.spectrum[0])[0])
        steps = max(int(np.ceil(reach / DEFOCUS_STEP)), 3)
        defocus = np.linspace(-reach, reach, 2 * steps + 1)
        samples = _samples(pupil, band, normal, cutoff, defocus)
        return cls(pupil, band, normal, cutoff, make_interp_spline(defocus, samples, k=5))

    @property
    def frequencies(self) -> np.ndarray:
        """Samples along the normal, cycles/m."""
        return np.linspace(0.0, self.cutoff, FREQUENCIES)

    def at(self, defocus: float, frequency: np.ndarray) -> np.ndarray:
        """Complex transfer function at frequencies along the normal, cycles/m, not negative."""
        if abs(defocus) <= self.table.t[-1]:
            samples = self.table(defocus)
        else:
            samples = _samples(self.pupil, self.band, self.normal, self.cutoff, np.array([defocus]))[0]
        parts = make_interp_spline(self.frequencies, samples, k=5)(np.minimum(frequency, self.cutoff))
        return np.where(frequency < self.cutoff, parts[..., 0] + 1j * parts[..., 1], 0.0)


def _samples(
    pupil: PupilFunction, band: BandSpec, normal: np.ndarray, cutoff: float, defocus: np.ndarray
) -> np.ndarray:
    """Real and imaginary part at evenly spaced frequencies, (Z, FREQUENCIES, 2)."""
    frequency = np.linspace(0.0, cutoff, FREQUENCIES)[:, None] * normal
    values = polychromatic_transfer(pupil, frequency, *band_wavelengths(band), defocus)
    return np.stack([values.real, values.imag], axis=-1)


_ROUND_CUTOFF = 10e3
"""Cut-offs are rounded up to multiples of this, cycles/m,"""
_ROUND_REACH = 4.0
"""and reaches to multiples of this, pixels."""


@dataclass(frozen=True, eq=False)
class EdgeImager:
    """Images of one edge at one site as a line CCD takes them.

    Attributes:
        optics: transfer function along the edge's normal.
        ccd: the line CCD.
        region: side of the square image, pixels.
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

        Args:
            defocus: of the detector, metres, positive downstream.
            offset: of the edge from the middle of the image along its normal, metres.
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
