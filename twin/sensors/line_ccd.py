"""TDI line CCD: the effect of pixels, charge and clocking on the image, and the frames that it records.

The second part is the exact effect of image oscillations of any frequency during the collection of a TDI line.

The charge of a pixel is collected in M = stages x phases steps, one every D = line time / phases; light falls in during
a fraction o of each step. A displacement x(t), in pixels, of the image, relative to charge that follows the image's
mean motion, multiplies the image's spectrum at nu cycles per pixel by

    T(nu) = mean over the light of exp(-2 pi i nu x(t)).

For an oscillation of amplitude A (pixels), frequency f (hertz) and phase p (radians), x = A sin(2 pi f t + p), the
Jacobi-Anger expansion turns each term into an integral over the steps with a closed form,

    T(nu) = sum over n of J_n(2 pi nu A) exp(-i n p) W(n f),    W(f) = sinc(o D f) sin(pi M D f) / (M sin(pi D f)),

with t counted from the middle of the collection. Its limits, with the length T = M D of the collection:

- slow, f T << 1: the image moves by A cos(p) 2 pi f T while light is collected, and |T| is the sinc of a linear smear
  of that length. The displacement A sin(p) is in the phase of T and does not blur.
- fast, f T >> 1: only n = 0 remains, and T = J_0(2 pi nu A) for any phase.

The mean of |T|^2 over the phases needs no sum: between two instants of the collection with a lag s, the image moves by
2 A sin(pi f s) cos(q) with q as random as p, so that

    E |T|^2 = mean over pairs of instants of J_0(4 pi nu A |sin(pi f s)|) for each line,
              times exp(-4 pi^2 nu^2 (R(0) - R(s))) for noise of a band with the autocovariance R.

This holds for any number of independent lines and bands together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import j0, jv

from analysis.spots.noise import NoiseModel
from optics.numerics.quadrature import gauss_of
from twin.sensors.area_detector import EmvaDetector, FixedPattern

if TYPE_CHECKING:
    from scenes.specs.camera import BandSpec, TdiSpec
    from scenes.specs.detector import DetectorSpec

WIDEST_STEP = 100e-9
"""Largest mean spacing of the wavelengths by which a band is sampled, in metres.

Mean transfer functions are then accurate to 1e-4.
"""

_SIGMAS = 5.0


def band_wavelengths(band: BandSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss wavelengths (K,), in metres, and weights with sum 1, for means over the band's signal.

    Dimensions: K nodes.
    """
    first, last = band.spectrum.ends
    return band.spectrum.rule(2 + int(np.ceil((last - first) / WIDEST_STEP)))


def band_factors(band: BandSpec, fx: np.ndarray, fy: np.ndarray) -> dict[str, np.ndarray]:
    """Return name of each effect of a line CCD -> its transfer function at spatial frequencies.

    The frequencies fx are along the line and fy along the track, in cycles/m, of either sign.

    Returns
    -------
    dict of str to ndarray
        ``pixel``: square pixel area; ``diffusion``: charge diffusion to neighbours; ``tdi_step``: image motion while
        the charge waits for its next step; ``tdi_rate``: drift between image and charge over the stages.
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
    """Line CCD of one band. Images have columns along the line (+Y') and rows along the track (+X').

    Every row of an image is collected over all stages of a column's pixels, so that pixel differences are those of
    columns.

    Attributes
    ----------
    band : BandSpec
        Geometry and clocking.
    detector : EmvaDetector
        Detector model for the sum over all stages.
    """

    band: BandSpec
    detector: EmvaDetector

    @classmethod
    def from_specs(cls, band: BandSpec, sheet: DetectorSpec) -> LineCcd:
        """Return the line CCD of a band and a data sheet.

        Raises
        ------
        InputError
            The dark current alone saturates the pixels.
        """
        return cls(band, EmvaDetector.from_sheet(sheet, band.exposure))

    def factors(self, fx: np.ndarray, fy: np.ndarray) -> dict[str, np.ndarray]:
        """Return name of each effect of the line CCD -> its transfer function at spatial frequencies.

        The effects are pixel area, charge diffusion, and image motion during a step and over the stages; fx is along
        the line and fy along the track, in cycles/m.
        """
        return band_factors(self.band, fx, fy)

    def transfer(self, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        """Return the transfer function of the line CCD, the product of the factors of all effects.

        The frequencies fx are along the line and fy along the track, in cycles/m.
        """
        out: np.ndarray = np.ones(np.broadcast_shapes(np.shape(fx), np.shape(fy)))
        for factor in self.factors(fx, fy).values():
            out = out * factor
        return out

    def white_photons(self, share: float) -> float:
        """Return the photons per pixel, summed over all TDI stages, that fill the well to a fraction ``share``."""
        return share * self.detector.full_well_e / self.detector.quantum_efficiency

    @property
    def largest_white(self) -> float:
        """Largest signal of a uniform white area, as a fraction of the full well, at which no pixel saturates.

        It allows for five sigma of the pixels' response and of their noise.
        """
        sheet, noise = self.detector, self.noise
        level = (sheet.saturation_dn - sheet.offset_dn) / sheet.system_gain_dn_per_e - noise.dark_signal_e
        # electrons e with e (1 + 5 prnu) + 5 sqrt(e + dark + read noise^2) = level, by iteration from above
        electrons = level
        for _ in range(20):
            signal = max(electrons, 0.0) + noise.dark_signal_e
            further = sum(float(term.temporal_variance_e2(signal)) + term.fixed_variance_e2 for term in noise.further)
            spread = np.sqrt(signal + sheet.dark_noise_e**2 + further)
            electrons = (level - _SIGMAS * spread) / (1.0 + _SIGMAS * sheet.prnu)
        return float(electrons / sheet.full_well_e)

    @property
    def exposure(self) -> float:
        """Time over which dark current is collected, in seconds."""
        return self.band.exposure

    @property
    def noise(self) -> NoiseModel:
        """Noise model of one frame (sum over all TDI stages): variance as a function of signal, for the analysis."""
        return self.detector.noise_model(self.exposure)

    def pattern(self, seed: np.random.SeedSequence) -> FixedPattern:
        """Return relative response and offset of every column of the line, (1, pixels), drawn from a seed."""
        return self.detector.fixed_pattern((1, self.band.pixels), seed)

    def expose(
        self, photons: np.ndarray, column: int, pattern: FixedPattern, frames: int, seed: np.random.SeedSequence
    ) -> np.ndarray:
        """Return recorded frames, uint16 grey values (..., frames, H, W), of images (..., H, W) in photons per pixel.

        ``column`` is the number of the line's pixel that records the images' first column.

        Dimensions: H rows, W columns.

        Raises
        ------
        ValueError
            The image reaches beyond the ends of the line.
        """
        last = column + photons.shape[-1]
        if column < 0 or last > self.band.pixels:
            raise ValueError(f"columns {column} to {last - 1} reach beyond a line of {self.band.pixels} pixels")
        window = FixedPattern(pattern.gain[:, column:last], pattern.offset_e[:, column:last])
        return self.detector.expose(photons, window, frames, self.exposure, seed, threads=1)


_BEYOND = 30
"""Number of terms of the Jacobi-Anger expansion (sum of Bessel functions J_n(z)) that are computed beyond n = z.

The term n falls off faster than (e z / 2 n)^n.
"""
_PER_STEP = 8
"""Number of integration nodes per step of the charge, if light is collected during only a part of the step."""
_PER_CYCLE = 6
"""Number of Gauss nodes per cycle of an oscillating function that is averaged over the collection."""


@dataclass(frozen=True)
class Collection:
    """Times at which a TDI line CCD collects the charge of a pixel, counted from the middle of the collection.

    Attributes
    ----------
    steps : int
        Number of positions of the charge, stages x phases.
    step : float
        Time from one step to the next, in seconds.
    open_share : float
        Fraction of each step, centred in it, during which light falls in.
    """

    steps: int
    step: float
    open_share: float = 1.0

    def __post_init__(self) -> None:
        if self.steps < 1 or not self.step > 0.0 or not 0.0 < self.open_share <= 1.0:
            raise ValueError(
                "a collection needs one step or more, a positive step and an open fraction above 0, at most 1"
            )

    @classmethod
    def of(cls, tdi: TdiSpec, line_time: float | None = None) -> Collection:
        """Return the collection times of a line CCD; ``line_time``, in seconds, replaces that of the file."""
        time = tdi.line_time if line_time is None else line_time
        return cls(tdi.stages * tdi.phases, time / tdi.phases, tdi.open_share)

    @property
    def length(self) -> float:
        """Duration of the collection, in seconds."""
        return self.steps * self.step

    def mean(self, frequency: np.ndarray | float) -> np.ndarray:
        """Return the mean of exp(2 pi i f t) over the times t at which light is collected, for frequencies f in hertz.

        It is real, since the times are symmetric about the middle of the collection, and 1 at frequency 0.
        """
        cycles = self.step * np.asarray(frequency, np.float64)
        near = np.sinc(cycles)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.sinc(self.steps * cycles) / near
        # for a whole number of cycles per step, all steps have equal terms
        whole = np.round(cycles)
        aligned = np.where((self.steps - 1) * whole % 2 == 0, 1.0, -1.0)
        return np.asarray(np.sinc(self.open_share * cycles) * np.where(np.abs(near) < 1e-9, aligned, ratio))

    def gauss_rule(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return a Gauss rule for means over the times of collection: times (K,), in seconds, and weights with sum 1.

        Times are counted from the middle of the collection.

        Polynomials in time up to degree 2 K - 1 are averaged exactly; K is ``count``, or the number of nodes of the
        collection if that is smaller.

        Dimensions: K nodes.
        """
        if self.open_share == 1.0:
            x, w = np.polynomial.legendre.leggauss(count)
            return 0.5 * self.length * x, 0.5 * w
        within, weight = np.polynomial.legendre.leggauss(_PER_STEP)
        centres = np.arange(self.steps) - 0.5 * (self.steps - 1)
        nodes = self.length / self.steps * (centres[:, None] + 0.5 * self.open_share * within).ravel()
        mass = np.tile(0.5 * weight / self.steps, self.steps)
        return gauss_of(nodes, mass, count)

    def transfer(self, nu: np.ndarray | float, frequency: float, amplitude: float, phase: float) -> np.ndarray:
        """Return the complex transfer function by which one oscillation of the image multiplies its spectrum, (...).

        Parameters
        ----------
        nu : (...) ndarray | float
            Spatial frequency along the motion, in cycles per pixel.
        frequency : float
            Frequency of the oscillation, in hertz.
        amplitude : float
            Amplitude, in pixels.
        phase : float
            Phase at the middle of the collection, in radians.
        """
        z = 2.0 * np.pi * amplitude * np.asarray(nu, np.float64)
        most = int(np.ceil(np.max(np.abs(z), initial=0.0))) + _BEYOND
        order = np.arange(-most, most + 1)
        weight = np.exp(-1j * order * phase) * self.mean(order * frequency)
        return np.asarray(np.tensordot(jv(order, z[..., None]), weight, axes=(-1, 0)))

    def mean_square(self, nu: np.ndarray | float, motion: Motion) -> np.ndarray:
        """Return the mean square, over random phases, of the modulus of the transfer function of a motion, (...).

        ``nu`` is the spatial frequency along the motion, (...) cycles per pixel. The oscillations and bands of noise
        are independent.
        """
        frequency = np.asarray(nu, np.float64)
        lag, weight = self._lags(motion.highest + 2.0 * motion.speed * float(np.max(np.abs(frequency), initial=0.0)))
        return np.asarray(np.tensordot(motion.characteristic(frequency[..., None], lag), weight, axes=(-1, 0)))

    def mtf(self, nu: np.ndarray | float, motion: Motion) -> np.ndarray:
        """Return the root mean square of the MTF of a motion over random phases, (...).

        ``nu`` is the spatial frequency along the motion, (...) cycles per pixel.
        """
        return np.sqrt(np.maximum(self.mean_square(nu, motion), 0.0))

    def smear(self, motion: Motion) -> float:
        """Return the rms displacement of the image about its mean while light is collected, in pixels."""
        lag, weight = self._lags(motion.highest)
        # the variance about a mean is half of the mean square of all differences
        return float(np.sqrt(max(float(weight @ (motion.variance - motion.covariance(lag))), 0.0)))

    def _lags(self, highest: float) -> tuple[np.ndarray, np.ndarray]:
        """Return nodes and weights for the mean over the lag (s) between two random times of the collection.

        They are accurate for functions up to the frequency ``highest``, in hertz.
        """
        if self.open_share == 1.0:
            # the whole collection is one step: its density falls linearly
            points = 16 + int(np.ceil(_PER_CYCLE * highest * self.length))
            x, w = np.polynomial.legendre.leggauss(points)
            share = 0.5 * (x + 1.0)
            return self.length * share, w * (1.0 - share)
        points = 16 + int(np.ceil(_PER_CYCLE * highest * self.open_share * self.step))
        x, w = np.polynomial.legendre.leggauss(points)
        share = 0.5 * (x + 1.0)
        part = np.concatenate([-share[::-1], share]) * self.open_share * self.step
        within = 0.5 * np.concatenate([(w * (1.0 - share))[::-1], w * (1.0 - share)])
        steps_apart = np.arange(self.steps)
        count_share = np.where(steps_apart == 0, 1.0, 2.0) * (self.steps - steps_apart) / self.steps**2
        lag = self.step * steps_apart[:, None] + part
        return np.abs(lag).ravel(), (count_share[:, None] * within).ravel()


@dataclass(frozen=True, eq=False)
class Motion:
    """Random motion of the image in one direction: independent oscillations of random phase and bands of noise.

    Dimensions: K nodes, B bands.

    Attributes
    ----------
    frequency, amplitude : (K,) ndarray
        Frequency, in hertz, and amplitude, in pixels, of the oscillations.
    first, last, level : (B,) ndarray
        Edges of the bands, in hertz, and one-sided spectral density, in pixels^2/Hz.
    """

    frequency: np.ndarray
    amplitude: np.ndarray
    first: np.ndarray
    last: np.ndarray
    level: np.ndarray

    @classmethod
    def of(cls, lines: Sequence[tuple[float, float]] = (), bands: Sequence[tuple[float, float, float]] = ()) -> Motion:
        """Return the motion of oscillations (frequency, amplitude) and of bands of noise (first, last, level).

        Frequencies, also those of the bands' edges, are in hertz, amplitudes in pixels, levels in pixels^2/Hz.

        Raises
        ------
        ValueError
            A frequency is not above zero, an amplitude or level is below zero, or a band is empty.
        """
        line, band = np.array(lines, np.float64).reshape(-1, 2), np.array(bands, np.float64).reshape(-1, 3)
        if not (np.all(line[:, 0] > 0.0) and np.all(line[:, 1] >= 0.0)):
            raise ValueError("oscillations have frequencies above zero and amplitudes of zero or more")
        if not (np.all(band[:, 0] >= 0.0) and np.all(band[:, 1] > band[:, 0]) and np.all(band[:, 2] >= 0.0)):
            raise ValueError("bands extend from a frequency to a higher one, with a level of zero or more")
        return cls(*line.T, *band.T)

    @property
    def highest(self) -> float:
        """Highest frequency of the motion, in hertz; 0 without any motion."""
        return float(np.max(np.concatenate([self.frequency, self.last]), initial=0.0))

    @property
    def speed(self) -> float:
        """Upper estimate of the image's speed, in pixels per second, which the motion rarely exceeds."""
        square = self.level @ (self.last**3 - self.first**3) / 3.0
        return float(2.0 * np.pi * (self.frequency @ self.amplitude + 4.0 * np.sqrt(square)))

    @property
    def variance(self) -> float:
        """Variance of the image's displacement, in pixels^2."""
        return float(0.5 * self.amplitude @ self.amplitude + self.level @ (self.last - self.first))

    def covariance(self, lag: np.ndarray) -> np.ndarray:
        """Return the autocovariance of the motion, (...) pixels^2, at time lags (...) in seconds."""
        s = np.asarray(lag, np.float64)[..., None]
        lines = np.cos(2.0 * np.pi * self.frequency * s) @ (0.5 * self.amplitude**2)
        return np.asarray(lines + self._of_bands(s))

    def _of_bands(self, s: np.ndarray) -> np.ndarray:
        """Return the autocovariance of the bands of noise, (...) pixels^2, at time lags (..., 1) in seconds.

        It is the integral of level cos(2 pi f s) over the frequency f, s being the lag.
        """
        ends = self.last * np.sinc(2.0 * self.last * s) - self.first * np.sinc(2.0 * self.first * s)
        return np.asarray(ends @ self.level)

    def characteristic(self, nu: np.ndarray, lag: np.ndarray) -> np.ndarray:
        """Return the mean of exp(-2 pi i nu (x(t) - x(t + lag))) over all phases and realisations of the motion x.

        ``nu`` is a spatial frequency in cycles per pixel, ``lag`` a time in seconds; their shapes broadcast.
        """
        nu, lag = np.broadcast_arrays(np.asarray(nu, np.float64), np.asarray(lag, np.float64))
        out: np.ndarray = np.ones(nu.shape)
        for frequency, amplitude in zip(self.frequency, self.amplitude, strict=True):
            out = out * j0(4.0 * np.pi * nu * amplitude * np.sin(np.pi * frequency * lag))
        if len(self.level):
            still = float(self.level @ (self.last - self.first))
            out = out * np.exp(-4.0 * np.pi**2 * nu**2 * (still - self._of_bands(lag[..., None])))
        return out
