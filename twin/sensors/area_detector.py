"""Area detector described by its EMVA 1288 data sheet: expected photons in, recorded frames out.

The signal chain is the linear camera model of EMVA Standard 1288 (release 3.1, chapter 2, eq. 1-12):

- n_e = Poisson(QE * (1 + prnu) * photons + dark_current * exposure): electrons collected;
- n_e = min(n_e, full_well): the well fills before the read-out;
- y = K * (n_e + dsnu_offset + dark_noise * normal + further) + offset: grey value, not yet digitised;
- y_DN = clip(rint(y), 0, 2**bit_depth - 1): recorded grey value, uint16.

QE is the quantum efficiency, K the gain in grey values per electron, prnu and dsnu_offset the fixed differences of the
pixels' response and offset, and normal a standard normal number. PRNU scales the response to light only; DSNU is a
fixed additive pattern in electrons that adds no shot noise. "further" is the sum of noise terms that a data sheet lists
in addition to this model (``NOISE_TERMS``), in electrons. The Poisson numbers are exact at every mean
(``twin.sensors.poisson_numbers``); no normal approximation is used. Pixel coordinates are (row, column); arrays are
(..., H, W).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError

from analysis.spots.noise import COARSE, FEW, ROUNDING_VARIANCE, FurtherNoise, NoiseModel
from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import cores
from optics.numerics.extension_table import ExtensionTable
from scenes.specs.detector import DetectorSpec
from scenes.specs.instrument import InstrumentSpec
from scenes.yaml.errors import Problem, unknown
from scenes.yaml.spec import Spec
from twin.framework.frame_store import allocate_frames, largest_of, release_memory
from twin.framework.procedure import stream
from twin.sensors.poisson_numbers import DRAWING_BYTES, poisson_pieces


class NoiseTerm(FurtherNoise, Protocol):
    """Interface of noise added to the electrons of a pixel after clipping at the full well and before digitisation.

    It is independent from pixel to pixel and has mean zero; its variances are those of ``FurtherNoise``.
    """

    def fixed_e(self, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray | None:
        """Return the electrons of a noise that stays the same in all frames, (..., H, W); None without such noise.

        Dimensions: H rows, W columns.
        """
        ...

    def temporal_e(self, electrons: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
        """Return the electrons of a noise that is new in every frame, (frames, H, W); None without such noise.

        ``electrons`` (frames, H, W) are the collected electrons on which the noise may depend. Frames of one exposure
        may be passed in several calls, one after the other with the same ``rng``.

        Dimensions: H rows, W columns.
        """
        ...


@dataclass(frozen=True)
class ReadNoise:
    """Normal read noise of the electronics, new in every frame.

    Attributes
    ----------
    sigma_e : float
        Standard deviation, in electrons.
    """

    sigma_e: float

    @property
    def fixed_variance_e2(self) -> float:
        """Variance over pixels that is the same in every frame, in electrons squared: zero for read noise."""
        return 0.0

    def temporal_variance_e2(self, electrons: Any) -> float:
        """Return the variance of read noise from frame to frame, the same at every signal, in electrons squared."""
        return self.sigma_e**2

    def fixed_e(self, shape: tuple[int, ...], rng: np.random.Generator) -> None:
        """Return None, since this noise has no part that stays the same from frame to frame."""
        return

    def temporal_e(self, electrons: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
        """Return the random read noise of every pixel of every frame, in electrons; None for a sigma of zero."""
        if self.sigma_e <= 0:
            return None
        out = rng.standard_normal(electrons.shape)
        out *= self.sigma_e
        return out


@dataclass(frozen=True)
class FixedOffsets:
    """Normally distributed differences between the offsets (dark grey values) of pixels, the same in every frame.

    Attributes
    ----------
    sigma_e : float
        Standard deviation, in electrons.
    """

    sigma_e: float

    @property
    def fixed_variance_e2(self) -> float:
        """Variance of the fixed offsets over the pixels, in electrons squared."""
        return self.sigma_e**2

    def temporal_variance_e2(self, electrons: Any) -> float:
        """Return the variance from frame to frame, in electrons squared: zero for fixed offsets."""
        return 0.0

    def fixed_e(self, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
        """Return the random offset of every pixel, in electrons."""
        return self.sigma_e * rng.standard_normal(shape)

    def temporal_e(self, electrons: np.ndarray, rng: np.random.Generator) -> None:
        """Return None, since this noise has no part that changes from frame to frame."""
        return


NOISE_TERMS = ExtensionTable[Callable[[float], NoiseTerm]]("noise_terms", {"read": ReadNoise, "offset": FixedOffsets})
"""Name under ``noise`` of a data sheet -> function that makes the noise term from the number there.

The number is in electrons rms unless the term defines it otherwise. New terms are added here.
"""


Seed = int | np.random.SeedSequence

# Above this the input must be in a wrong unit; NumPy's generator, which draws the largest means, works up to 9e18.
_MAX_PHOTONS = 1e12
# Pixels that a thread exposes at once: 2 frames of a CCD of 682 x 682 pixels, 113 of one of 96 x 96.
_PIXELS_AT_ONCE = 1 << 20
# A pixel counts as saturated from this many read-noise sigmas below the clipped level, because read noise is added
# after the well is clipped: half of all full wells would otherwise read below "full".
_SATURATION_SIGMAS = 4.0


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """Pixel-to-pixel differences of one detector, the same in every frame.

    Dimensions: H rows, W columns.

    Attributes
    ----------
    gain : (..., H, W) ndarray
        Relative response to light, 1 + prnu * normal, dimensionless, >= 0.
    offset_e : (..., H, W) ndarray
        Additive offset in electrons, dsnu_e * normal plus further fixed terms.
    """

    gain: NDArray[np.float64]
    offset_e: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.gain.shape != self.offset_e.shape or self.gain.ndim < 2:
            raise ValueError(
                f"fixed pattern: gain {self.gain.shape} and offset_e {self.offset_e.shape}"
                " must have one shape (..., H, W)"
            )
        if not (np.all(np.isfinite(self.gain)) and np.all(np.isfinite(self.offset_e)) and np.all(self.gain >= 0)):
            raise ValueError("fixed pattern: gain must be finite and >= 0, offset_e finite")


@dataclass(frozen=True, eq=False)
class SaturationReport:
    """Count of saturated pixels in images.

    Attributes
    ----------
    level_dn : float
        Grey value from which a pixel counts as saturated.
    pixels : (...,) ndarray of int
        Number of pixels per image that reach the level in at least one of its frames.
    """

    level_dn: float
    pixels: NDArray[np.int64]

    @property
    def any(self) -> bool:
        """True if at least one pixel of one image is saturated."""
        return bool(np.any(self.pixels > 0))


@dataclass(frozen=True)
class EmvaDetector:
    """Detector described by the numbers of its EMVA 1288 data sheet.

    Raises ValueError, naming the field, for values outside the limits of `scenes.specs.detector`.

    Attributes
    ----------
    quantum_efficiency : float
        Electrons per photon.
    system_gain_dn_per_e : float
        System gain K, in grey values per electron.
    dark_noise_e : float
        Temporal read noise, in electrons rms.
    dark_current_e_per_s : float
        Dark current, in electrons per pixel and second.
    full_well_e : float
        Electrons at which the pixel saturates.
    prnu : float
        Photo-response non-uniformity (PRNU_1288), rms fraction.
    dsnu_e : float
        Dark-signal non-uniformity (DSNU_1288), in electrons rms.
    bit_depth : int
        Bits of the converter.
    offset_dn : float
        Black level, in grey values.
    noise : tuple of NoiseTerm
        Further noise terms.
    """

    quantum_efficiency: float
    system_gain_dn_per_e: float
    dark_noise_e: float
    dark_current_e_per_s: float
    full_well_e: float
    prnu: float
    dsnu_e: float
    bit_depth: int
    offset_dn: float
    noise: tuple[NoiseTerm, ...] = ()

    def __post_init__(self) -> None:
        try:
            _ = self._sheet
        except ValidationError as error:
            first = error.errors()[0]
            problem = first.get("ctx", {}).get("error")
            where = problem.within if isinstance(problem, Problem) else first["loc"]
            wrong = ", ".join(f"{name} {self._numbers()[str(name)]!r}" for name in where)
            raise ValueError(f"detector: {wrong}: {first['msg']}") from None

    @classmethod
    def from_sheet(cls, sheet: DetectorSpec, exposure: float) -> EmvaDetector:
        """Return the detector of a data sheet's file, for frames with an exposure time in seconds.

        Raises
        ------
        InputError
            The dark current alone saturates the pixels, or the sheet names an unknown noise term.
        """
        sheet.check_exposure(exposure)
        for name in sheet.noise or {}:
            if name not in NOISE_TERMS:
                raise sheet.error(unknown("no such noise", name, NOISE_TERMS, ("noise", name)))
        terms = tuple(NOISE_TERMS[name](value) for name, value in (sheet.noise or {}).items())
        return cls(**{name: getattr(sheet, name) for name in cls._sheet_names()}, noise=terms)

    @classmethod
    def _sheet_names(cls) -> list[str]:
        """Return the names of those attributes that are numbers of a data sheet."""
        return [field.name for field in fields(cls) if field.name != "noise"]

    @cached_property
    def _sheet(self) -> DetectorSpec:
        """Data sheet with this detector's numbers, which checks their limits and derives others from them."""
        return DetectorSpec.model_validate({"name": "detector", **self._numbers()})

    def _numbers(self) -> dict[str, Any]:
        """Return the detector's numbers as Python's own types, not NumPy's."""
        values = {name: getattr(self, name) for name in self._sheet_names()}
        return {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}

    @property
    def max_dn(self) -> int:
        """Largest grey value that the converter can output, 2**bit_depth - 1."""
        return self._sheet.max_dn

    @property
    def saturation_dn(self) -> float:
        """Grey value above which the response is no longer linear, as in the data sheet."""
        return self._sheet.saturation_dn

    def noise_model(self, exposure_s: float) -> NoiseModel:
        """Return the model of noise as a function of signal, for the analysis of frames of ``exposure_s`` seconds."""
        return NoiseModel(
            gain_dn_per_e=self.system_gain_dn_per_e,
            dark_noise_e=self.dark_noise_e,
            dark_signal_e=self.dark_current_e_per_s * _exposure(exposure_s),
            offset_dn=self.offset_dn,
            prnu=self.prnu,
            dsnu_e=self.dsnu_e,
            saturation_dn=self.saturation_dn,
            further=self.noise,
        )

    def fixed_pattern(self, shape: tuple[int, ...], seed: Seed) -> FixedPattern:
        """Draw the fixed pattern of detectors of `shape` (..., H, W); the same seed and shape give the same bits.

        Dimensions: H rows, W columns.
        """
        if len(shape) < 2 or any(int(n) != n or n < 1 for n in shape):
            raise ValueError(f"fixed pattern: shape must be (..., H, W) of positive integers, found {shape!r}")
        rng = np.random.Generator(np.random.SFC64(_sequence(seed)))
        gain = np.maximum(1.0 + self.prnu * rng.standard_normal(shape), 0.0)
        offset_e = FixedOffsets(self.dsnu_e).fixed_e(shape, rng)
        for term in self.noise:
            added = term.fixed_e(shape, rng)
            if added is not None:
                offset_e += added
        return FixedPattern(gain=gain, offset_e=offset_e)

    def expected_dn(
        self, photons: ArrayLike, exposure_s: float, pattern: FixedPattern | None = None
    ) -> NDArray[np.float64]:
        """Return noise-free, unrounded grey values (..., H, W), clipped at the well and the converter.

        Near saturation this is the clipped mean and not the mean of clipped values.

        Dimensions: H rows, W columns.

        Parameters
        ----------
        photons : (..., H, W) array_like
            Expected photons per pixel and frame.
        exposure_s : float
            Exposure time of one frame, in seconds.
        pattern : FixedPattern | None
            Fixed pattern; None for a perfectly uniform detector.
        """
        light = _photons(photons)
        gain: Any = 1.0 if pattern is None else pattern.gain
        offset_e: Any = 0.0 if pattern is None else pattern.offset_e
        electrons = self.quantum_efficiency * light * gain + self.dark_current_e_per_s * _exposure(exposure_s)
        level = self.offset_dn + self.system_gain_dn_per_e * (np.minimum(electrons, self.full_well_e) + offset_e)
        return np.asarray(np.clip(level, 0, self.max_dn), dtype=np.float64)

    def expose(
        self,
        photons: ArrayLike,
        pattern: FixedPattern,
        frames: int,
        exposure_s: float,
        seed: Seed | Sequence[Seed],
        threads: int | None = None,
    ) -> NDArray[np.uint16]:
        """Record frames of images.

        Dimensions: H rows, W columns.

        Parameters
        ----------
        photons : (..., H, W) array_like
            Expected photons per pixel and frame, >= 0.
        pattern : FixedPattern
            Fixed pattern whose shape broadcasts to that of photons, e.g. (4, H, W) for photons (states, 4, H, W).
        frames : int
            Number of frames of each image, >= 1.
        exposure_s : float
            Exposure time of one frame, in seconds (it sets the dark signal; photons are given per frame).
        seed : int | SeedSequence | sequence of these
            Seed. Each image draws from its own stream, numbered by its position in the flattened leading axes, so the
            result does not depend on `threads`, and image i does not depend on how many follow it. Several seeds, one
            for each entry of the first axis, expose these entries as separate calls would.
        threads : int | None
            Worker threads (NumPy's generators release the GIL); None for the available cores, at most 8.

        Returns
        -------
        (..., frames, H, W) ndarray of uint16
            Grey values.

        Raises
        ------
        ValueError
            An argument is invalid.
        """
        light = _photons(photons)
        if isinstance(frames, bool) or int(frames) != frames or frames < 1:
            raise ValueError(f"detector: frames must be an integer >= 1, found {frames!r}")
        dark_e = self.dark_current_e_per_s * _exposure(exposure_s)
        lead, (height, width) = light.shape[:-2], light.shape[-2:]
        try:
            gain = np.broadcast_to(pattern.gain, light.shape)
            offset_e = np.broadcast_to(pattern.offset_e, light.shape)
        except ValueError as error:
            raise ValueError(
                f"detector: fixed pattern {pattern.gain.shape} does not fit photons {light.shape}"
            ) from error
        out = allocate_frames((*lead, int(frames), height, width))
        indices = list(np.ndindex(*lead))
        streams = _streams(seed, lead)
        together = self.frames_at_once(int(frames), height * width)
        threads = min(cores(), 8) if threads is None else threads
        if threads < 1:
            raise ValueError(f"detector: threads must be >= 1, found {threads!r}")

        def image(index: tuple[int, ...], image_seed: np.random.SeedSequence) -> None:
            rng = np.random.Generator(np.random.SFC64(image_seed))
            # each term has its own stream, so that its numbers do not depend on other terms or on the pieces
            others = [np.random.Generator(np.random.SFC64(stream(image_seed, k))) for k in range(len(self.noise))]
            mean_e = light[index] * gain[index]
            mean_e *= self.quantum_efficiency
            mean_e += dark_e
            shift = offset_e[index] * self.system_gain_dn_per_e
            shift += self.offset_dn
            start = 0
            for collected in poisson_pieces(mean_e, int(frames), rng, together):
                out[index][start : start + together] = self._read_out(collected, shift, (rng, *others))
                release_memory(out)
                start += together

        if threads == 1 or len(indices) == 1:
            for index, image_seed in zip(indices, streams, strict=True):
                image(index, image_seed)
            return out
        with ThreadPoolExecutor(max_workers=threads) as pool:
            list(pool.map(image, indices, streams))
        return out

    def frames_at_once(self, frames: int, pixels: int) -> int:
        """Return the number of frames of an image drawn at once, which limits memory; the frames do not depend on it.

        Parameters
        ----------
        frames : int
            Number of frames of the image.
        pixels : int
            Number of pixels of a frame.
        """
        return min(frames, max(1, _PIXELS_AT_ONCE // pixels))

    def exposing_bytes(self, frames: int, pixels: int, threads: int) -> int:
        """Return the temporary memory of an exposure, in addition to the resulting frames, in bytes.

        Parameters
        ----------
        frames : int
            Number of frames of an image.
        pixels : int
            Number of pixels of a frame.
        threads : int
            Number of threads that expose.
        """
        # electrons, read noise, and electrons as they were collected for noise that depends on them
        return threads * (pixels * self.frames_at_once(frames, pixels) * 24 + DRAWING_BYTES)

    def _read_out(self, level: np.ndarray, shift: np.ndarray, each: Sequence[np.random.Generator]) -> np.ndarray:
        """Return grey values of frames (N, H, W) from their electrons ``level``; the array is overwritten.

        ``shift`` is the black level with the pixels' offsets, in grey values; ``each`` has one generator per noise
        term.

        Dimensions: N frames, H rows, W columns.
        """
        np.minimum(level, self.full_well_e, out=level)
        before = level.copy() if self.noise else level
        terms = ReadNoise(self.dark_noise_e), *self.noise
        added = [term.temporal_e(before, rng) for term, rng in zip(terms, each, strict=True)]
        for noise in added:
            if noise is not None:
                level += noise
        level *= self.system_gain_dn_per_e
        level += shift
        np.rint(level, out=level)
        return np.clip(level, 0, self.max_dn, out=level)

    def saturated(self, frames: NDArray[np.uint16]) -> SaturationReport:
        """Count saturated pixels in recorded frames (..., frames, H, W); counts have shape (...,).

        A pixel is saturated if it comes within 4 sigmas of the full well (of the read noise and further temporal noise
        at a full well), or reaches the converter's largest value.

        Dimensions: H rows, W columns.
        """
        if frames.ndim < 3:
            raise ValueError(f"detector: frames must be (..., frames, H, W), found shape {frames.shape}")
        well = self.offset_dn + self.system_gain_dn_per_e * (self.full_well_e - _SATURATION_SIGMAS * self._read_sigma_e)
        level = float(min(self.max_dn, well))
        return SaturationReport(level_dn=level, pixels=np.sum(largest_of(frames) >= level, axis=(-2, -1)))

    @property
    def _read_sigma_e(self) -> float:
        """Temporal noise at a full well without its shot noise, in electrons rms."""
        if not self.noise:
            return self.dark_noise_e
        further = sum(float(term.temporal_variance_e2(self.full_well_e)) for term in self.noise)
        return math.sqrt(self.dark_noise_e**2 + further)


def _streams(seed: Seed | Sequence[Seed], lead: tuple[int, ...]) -> list[np.random.SeedSequence]:
    """Return the random stream of each image in an array of images with the shape ``lead``."""
    if not isinstance(seed, Sequence):
        root = _sequence(seed)
        return [stream(root, number) for number in range(math.prod(lead))]
    if len(seed) != lead[0]:
        raise ValueError(f"detector: {len(seed)} seeds for {lead[0]} exposures")
    return [child for entry in seed for child in _streams(entry, lead[1:])]


def _sequence(seed: Seed) -> np.random.SeedSequence:
    """Return a seed as NumPy's SeedSequence; raise ValueError if it is not a seed."""
    if isinstance(seed, np.random.SeedSequence):
        return seed
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"detector: seed must be an integer >= 0 or a SeedSequence, found {seed!r}")
    return np.random.SeedSequence(int(seed))


def _exposure(exposure_s: float) -> float:
    """Return an exposure time in seconds; raise ValueError if it is outside 0 to 1e6 s."""
    if not (math.isfinite(exposure_s) and 0 <= exposure_s <= 1e6):
        raise ValueError(f"detector: exposure_s must be in [0, 1e6] s, found {exposure_s!r}")
    return float(exposure_s)


def _photons(photons: ArrayLike) -> NDArray[np.float64]:
    """Return expected photons as float64; raise an error if they are negative, not finite or too many.

    The error is UnphysicalError for too many photons, else ValueError.
    """
    light = np.asarray(photons, dtype=np.float64)
    if light.ndim < 2 or light.size == 0:
        raise ValueError(f"detector: photons must be (..., H, W), found shape {light.shape}")
    low, high = float(light.min()), float(light.max())
    if not (low >= 0 and high <= _MAX_PHOTONS):  # also catches NaN and infinity
        too_bright = low >= 0 and np.isfinite(high)
        raise (UnphysicalError if too_bright else ValueError)(
            f"detector: photons must be finite, >= 0 and <= {_MAX_PHOTONS:g} per pixel and frame, found {low} to {high}"
        )
    return light


def coarse_step_warnings(noise: NoiseModel, detector_name: str) -> tuple[str, ...]:
    """Return a warning if a grey value's step is large compared with the noise at low signal; otherwise none.

    Rounding errors are then equal in all frames and do not average out. The warning depends on the detector's numbers
    alone.

    Parameters
    ----------
    noise : NoiseModel
        Noise model of the detector.
    detector_name : str
        Name of the detector for the reader.
    """
    few = float(noise.frame_variance_dn2(noise.dark_level_dn + FEW)) - ROUNDING_VARIANCE
    if few >= COARSE**2:
        return ()
    return (
        f"{detector_name} has coarse grey values: its noise is {math.sqrt(few):.2g} DN at {FEW:g} DN of light, less "
        f"than {COARSE:g}; rounding errors are then equal in all frames, do not average out and are correlated between "
        "neighbouring pixels, while σ assumes independent ones; increase system_gain_dn_per_e, with a sufficient "
        "bit_depth",
    )


def coarse_warnings(setup: Spec) -> tuple[str, ...]:
    """Return warnings for area CCDs of a job or test whose grey-value steps are large compared with their noise.

    Parameters
    ----------
    setup : Spec
        Job or test with everything it refers to.

    Raises
    ------
    InputError
        The dark current alone saturates the pixels, or a sheet names an unknown noise term.
    """
    instrument, sheet = getattr(setup, "instrument", None), getattr(setup, "detector", None)
    if not isinstance(instrument, InstrumentSpec) or not isinstance(sheet, DetectorSpec):
        return ()
    exposure = instrument.autocollimator.area_ccd.exposure
    chosen = {
        sheet.name: sheet,
        **{data_sheet.name: data_sheet for data_sheet in getattr(setup, "detectors", {}).values()},
    }
    out: list[str] = []
    for name, data_sheet in chosen.items():
        out += coarse_step_warnings(
            EmvaDetector.from_sheet(data_sheet, exposure).noise_model(exposure), f"area CCD {name}"
        )
    return tuple(out)
