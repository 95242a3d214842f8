"""A TDI line CCD: what its pixels, its charge and its clocking do to the image, and the frames it records."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.spots.noise import NoiseModel
from twin.sensors.area_detector import EmvaDetector, FixedPattern

if TYPE_CHECKING:
    from scenes.specs.camera import BandSpec
    from scenes.specs.detector import DetectorSpec


WIDEST_STEP = 100e-9
"""Mean distance of the wavelengths of a band, metres: mean transfer functions are then right to 1e-4."""

_SIGMAS = 5.0


def band_wavelengths(band: BandSpec) -> tuple[np.ndarray, np.ndarray]:
    """Gauss' wavelengths (K,), metres, and their weights, which sum to 1, for means over the band's signal."""
    first, last = band.spectrum.ends
    return band.spectrum.rule(2 + int(np.ceil((last - first) / WIDEST_STEP)))


def band_factors(band: BandSpec, fx: np.ndarray, fy: np.ndarray) -> dict[str, np.ndarray]:
    """What a line CCD does to an image, at frequencies along the line (fx) and along the track (fy), cycles/m.

    Returns:
        ``pixel``: its square area; ``diffusion``: charge that spreads to neighbours; ``tdi_step``: the image moves on
        while the charge waits for its next step; ``tdi_rate``: image and charge drift apart over the stages.
    """
    p, tdi = band.pitch, band.tdi
    return {
        "pixel": np.sinc(p * fx) * np.sinc(p * fy),
        "diffusion": np.exp(-2.0 * np.pi**2 * band.diffusion**2 * (fx**2 + fy**2)),
        "tdi_step": np.sinc(tdi.open_share * p / tdi.phases * fy),
        "tdi_rate": np.sinc(tdi.stages * p * tdi.rate_error * fy),
    }


@dataclass(frozen=True)
class LineCcd:
    """One band's line CCD. Images have columns along the line (+Y') and rows along the track (+X').

    Every row of an image is collected over all stages of a column's pixels, so that pixel differences are those of
    columns.

    Attributes:
        band: geometry and clocking.
        detector: of the sum over all stages.
    """

    band: BandSpec
    detector: EmvaDetector

    @classmethod
    def from_specs(cls, band: BandSpec, sheet: DetectorSpec) -> LineCcd:
        """From what the files say.

        Raises:
            InputError: the dark current alone saturates the pixels.
        """
        return cls(band, EmvaDetector.from_sheet(sheet, band.exposure))

    def factors(self, fx: np.ndarray, fy: np.ndarray) -> dict[str, np.ndarray]:
        """Each effect's transfer, see ``band_factors``."""
        return band_factors(self.band, fx, fy)

    def transfer(self, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        """Product of all factors."""
        out: np.ndarray = np.ones(np.broadcast_shapes(np.shape(fx), np.shape(fy)))
        for factor in self.factors(fx, fy).values():
            out = out * factor
        return out

    def white_photons(self, share: float) -> float:
        """Photons per pixel over all stages that fill the well to that share."""
        return share * self.detector.full_well_e / self.detector.quantum_efficiency

    @property
    def largest_white(self) -> float:
        """Share of the full well up to which no pixel of an even field saturates, at five sigma of a pixel's response
        and of its noise.
        """
        sheet, noise = self.detector, self.noise
        level = (sheet.saturation_dn - sheet.offset_dn) / sheet.system_gain_dn_per_e - noise.dark_signal_e
        # electrons e with e (1 + 5 prnu) + 5 sqrt(e + dark + read noise^2) = level, by iteration from above
        electrons = level
        for _ in range(20):
            own = max(electrons, 0.0) + noise.dark_signal_e
            further = sum(float(term.temporal_variance_e2(own)) + term.fixed_variance_e2 for term in noise.further)
            spread = np.sqrt(own + sheet.dark_noise_e**2 + further)
            electrons = (level - _SIGMAS * spread) / (1.0 + _SIGMAS * sheet.prnu)
        return float(electrons / sheet.full_well_e)

    @property
    def exposure(self) -> float:
        """Time over which dark current is collected, seconds."""
        return self.band.exposure

    @property
    def noise(self) -> NoiseModel:
        """What the analysis may know of the noise of one frame."""
        return self.detector.noise_model(self.exposure)

    def pattern(self, seed: np.random.SeedSequence) -> FixedPattern:
        """Gain and offset of every column of the line, (1, pixels)."""
        return self.detector.fixed_pattern((1, self.band.pixels), seed)

    def expose(
        self, photons: np.ndarray, column: int, pattern: FixedPattern, frames: int, seed: np.random.SeedSequence
    ) -> np.ndarray:
        """Frames of images (..., H, W) whose first column is the line's pixel ``column``, uint16 (..., frames, H, W).

        Raises:
            ValueError: the image reaches beyond the ends of the line.
        """
        last = column + photons.shape[-1]
        if column < 0 or last > self.band.pixels:
            raise ValueError(f"columns {column} to {last - 1} are not all on a line of {self.band.pixels} pixels")
        own = FixedPattern(pattern.gain[:, column:last], pattern.offset_e[:, column:last])
        return self.detector.expose(photons, own, frames, self.exposure, seed, threads=1)
