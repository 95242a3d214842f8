"""Area detector described by its EMVA 1288 data-sheet numbers: expected photons in, recorded frames out.

The signal chain is the linear camera model of EMVA Standard 1288 (release 3.1, chapter 2, eq. 1-12):

    n_e  = Poisson( QE * (1 + prnu) * photons + dark_current * exposure )         electrons, exact Poisson
    n_e  = min(n_e, full_well)                                                    the well fills before the read-out
    y    = K * (n_e + dsnu_offset + dark_noise * normal + further) + offset       grey value, not yet digitised
    y_DN = clip(rint(y), 0, 2**bit_depth - 1)                                     uint16

PRNU scales the response to light only; DSNU is a fixed additive pattern in electrons that adds no shot noise. Further
noise is what a data sheet lists beyond the model, term by term (``NOISE_TERMS``). The Poisson numbers are exact at
every mean (``twin.sensors.poisson_numbers``); no normal approximation is made anywhere. Pixel coordinates are
(row, column); arrays are (..., H, W).
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
from twin.framework.random_streams import stream
from twin.sensors.exposure_kernel import FEWEST, Reading, exposing_bytes, kernels_there
from twin.sensors.poisson_numbers import poisson_pieces


class NoiseTerm(FurtherNoise, Protocol):
    """What a term adds to the electrons of a pixel, after the well is clipped and before the grey value is made.

    It is independent from pixel to pixel and of mean zero, and its variances are those that ``FurtherNoise`` tells.
    """

    def fixed_e(self, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray | None:
        """Electrons (..., H, W) that stay from frame to frame, for detectors of that shape; None for nothing."""
        ...

    def temporal_e(self, electrons: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
        """New in every frame: electrons of the shape of those collected, (frames, H, W); None for nothing.

        Many frames come in pieces, one after the other with the same ``rng``.
        """
        ...


@dataclass(frozen=True)
class ReadNoise:
    """Normal noise of the electronics, new in every frame.

    Attributes
    ----------
    sigma_e : float
        Electrons rms.
    """

    sigma_e: float

    @property
    def fixed_variance_e2(self) -> float:
        """Read noise adds nothing that stays from frame to frame, electrons squared."""
        return 0.0

    def temporal_variance_e2(self, electrons: Any) -> float:
        """Variance within a pixel, the same at every signal, electrons squared."""
        return self.sigma_e**2

    def fixed_e(self, shape: tuple[int, ...], rng: np.random.Generator) -> None:
        """Nothing is drawn for what stays."""
        return

    def temporal_e(self, electrons: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
        """Electrons drawn for every pixel of every frame; no number is drawn for a sigma of zero."""
        if self.sigma_e <= 0:
            return None
        out = rng.standard_normal(electrons.shape)
        out *= self.sigma_e
        return out


@dataclass(frozen=True)
class FixedOffsets:
    """Normal differences of the pixels' offsets.

    Attributes
    ----------
    sigma_e : float
        Electrons rms.
    """

    sigma_e: float

    @property
    def fixed_variance_e2(self) -> float:
        """Variance over the pixels, electrons squared."""
        return self.sigma_e**2

    def temporal_variance_e2(self, electrons: Any) -> float:
        """Offsets do not change from frame to frame, electrons squared."""
        return 0.0

    def fixed_e(self, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
        """Electrons drawn for every pixel."""
        return self.sigma_e * rng.standard_normal(shape)

    def temporal_e(self, electrons: np.ndarray, rng: np.random.Generator) -> None:
        """Nothing is drawn anew."""
        return


NOISE_TERMS = ExtensionTable[Callable[[float], NoiseTerm]]("noise_terms", {"read": ReadNoise, "offset": FixedOffsets})
"""Name that a data sheet may write under ``noise`` -> the term of the number that stands there, electrons rms where the
term does not say otherwise. A new one is added here.
"""


Seed = int | np.random.SeedSequence

# Beyond this the input is certainly in the wrong unit; NumPy's generator, which draws the largest, works up to 9e18.
_MAX_PHOTONS = 1e12
# Numbers of read noise that are drawn at once: 9 frames of a CCD of 682 x 682 pixels, 455 of one of 96 x 96. Every
# thread has room for those of further noise, which are fewer.
_FRAMES_PIXELS, _FURTHER_PIXELS = 1 << 22, 1 << 20
# A pixel counts as saturated from this many read-noise sigmas below the clipped level, because read noise is added
# after the well is clipped: half of all full wells would otherwise read below "full".
_SATURATION_SIGMAS = 4.0


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """The pixel-to-pixel differences of one detector, the same in every frame it records.

    gain: (..., H, W) relative response to light, 1 + prnu * normal, dimensionless, >= 0.
    offset_e: (..., H, W) additive offset in electrons, dsnu_e * normal and what further terms add.
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
    """Which images hold saturated pixels.

    level_dn: grey value from which a pixel counts as saturated.
    pixels: (...,) number of pixels per image that reach the level in at least one of its frames.
    """

    level_dn: float
    pixels: NDArray[np.int64]

    @property
    def any(self) -> bool:
        """True when at least one pixel of one image is saturated."""
        return bool(np.any(self.pixels > 0))


@dataclass(frozen=True)
class EmvaDetector:
    """A detector by the numbers of its EMVA 1288 data sheet. Raises ValueError, naming the field, for values outside
    the limits of `scenes.specs.detector`.

    quantum_efficiency: electrons per photon.
    system_gain_dn_per_e: K, grey values per electron.
    dark_noise_e: temporal read noise, electrons rms.
    dark_current_e_per_s: electrons per pixel and second.
    full_well_e: electrons at which the pixel saturates.
    prnu: photo-response non-uniformity (PRNU_1288), rms fraction.
    dsnu_e: dark-signal non-uniformity (DSNU_1288), electrons rms.
    bit_depth: of the converter.
    offset_dn: black level, grey values.
    noise: further terms.
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
            found = ", ".join(f"{name} {self._numbers()[str(name)]!r}" for name in where)
            raise ValueError(f"detector: {found}: {first['msg']}") from None

    @classmethod
    def from_sheet(cls, sheet: DetectorSpec, exposure: float) -> EmvaDetector:
        """The detector of a data sheet's file, for frames of that exposure, seconds.

        Raises
        ------
        InputError
            The dark current alone saturates the pixels, or the sheet names a noise that is not known.
        """
        sheet.check_exposure(exposure)
        for name in sheet.noise or {}:
            if name not in NOISE_TERMS:
                raise sheet.error(unknown("no such noise", name, NOISE_TERMS, ("noise", name)))
        terms = tuple(NOISE_TERMS[name](value) for name, value in (sheet.noise or {}).items())
        return cls(**{name: getattr(sheet, name) for name in cls._sheet_names()}, noise=terms)

    @classmethod
    def _sheet_names(cls) -> list[str]:
        """Names of the numbers, as a data sheet has them."""
        return [field.name for field in fields(cls) if field.name != "noise"]

    @cached_property
    def _sheet(self) -> DetectorSpec:
        """These numbers as a data sheet, which knows their limits and what follows from them."""
        return DetectorSpec.model_validate({"name": "detector", **self._numbers()})

    def _numbers(self) -> dict[str, Any]:
        """The detector's numbers as Python's own, not numpy's."""
        values = {name: getattr(self, name) for name in self._sheet_names()}
        return {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}

    @property
    def max_dn(self) -> int:
        """Largest grey value of the converter."""
        return self._sheet.max_dn

    @property
    def saturation_dn(self) -> float:
        """Grey value where the response stops being linear, as the data sheet has it."""
        return self._sheet.saturation_dn

    def noise_model(self, exposure_s: float) -> NoiseModel:
        """The noise description that the analysis needs, for frames of exposure_s seconds."""
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
        """Draw the fixed pattern of detectors of `shape` (..., H, W); the same seed and shape give the same bits."""
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
        """Noise-free, unrounded grey values (..., H, W) for `photons` per pixel and frame, clipped at the well and
        converter.

        Without `pattern` the detector is taken as perfectly uniform. Close to saturation this is the clipped mean and
        not the mean of clipped values.
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
        """Record `frames` frames of each image.

        photons: (..., H, W) expected photons per pixel and frame, >= 0.
        pattern: fixed pattern whose shape broadcasts to that of photons, e.g. (4, H, W) for photons (states, 4, H, W).
        frames: number of frames, >= 1.
        exposure_s: exposure of one frame, s (it sets the dark signal; photons are given per frame).
        seed: integer or SeedSequence. Each image draws from its own stream, numbered by its place in the flattened
            leading axes, so the result does not depend on `threads`, and image i does not depend on how many follow
            it. Several seeds, one for each entry of the first axis, expose these as calls of their own would.
        threads: worker threads (numpy's generators release the GIL); default: the cores this process may use, at most
            8.
        Returns uint16 (..., frames, H, W) grey values. Raises ValueError for bad input.
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
        scale = self.system_gain_dn_per_e

        def expected(index: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
            mean_e = light[index] * gain[index]
            mean_e *= self.quantum_efficiency
            mean_e += dark_e
            shift = offset_e[index] * scale
            shift += self.offset_dn
            return mean_e, shift

        if not self.noise and out.size >= FEWEST and kernels_there():
            images = out.reshape(len(indices), int(frames), -1)
            self._reading.frames(lambda number: expected(indices[number]), streams, images, together, threads)
            return out

        def image(index: tuple[int, ...], own: np.random.SeedSequence) -> None:
            rng = np.random.Generator(np.random.SFC64(own))
            # numbers of one term do not depend on how many another one draws, nor on what is drawn together
            others = [np.random.Generator(np.random.SFC64(stream(own, k))) for k in range(len(self.noise))]
            mean_e, shift = expected(index)
            start = 0
            for collected in poisson_pieces(mean_e, int(frames), rng, together):
                out[index][start : start + together] = self._read_out(collected, shift, (rng, *others))
                release_memory(out)
                start += together

        if threads == 1 or len(indices) == 1:
            for index, own in zip(indices, streams, strict=True):
                image(index, own)
            return out
        with ThreadPoolExecutor(max_workers=threads) as pool:
            list(pool.map(image, indices, streams))
        return out

    def frames_at_once(self, frames: int, pixels: int) -> int:
        """Frames of an image whose numbers are drawn at once: so many that memory stays bounded; the frames do not
        depend on it.

        Parameters
        ----------
        frames : int
            Of the image.
        pixels : int
            Of a frame.
        """
        return min(frames, max(1, (_FURTHER_PIXELS if self.noise else _FRAMES_PIXELS) // pixels))

    def exposing_bytes(self, frames: int, pixels: int, threads: int) -> int:
        """Memory that the exposure of images takes for a while, beside the frames that it gives, bytes.

        Parameters
        ----------
        frames : int
            Of an image.
        pixels : int
            Of a frame.
        threads : int
            That expose.
        """
        together = self.frames_at_once(frames, pixels)
        # electrons, read noise, and electrons as they were collected for noise that depends on them
        return threads * pixels * together * 24 if self.noise else exposing_bytes(together, pixels)

    @property
    def _reading(self) -> Reading:
        return Reading(self.dark_noise_e, self.system_gain_dn_per_e, self.full_well_e, self.max_dn)

    def _read_out(self, level: np.ndarray, shift: np.ndarray, each: Sequence[np.random.Generator]) -> np.ndarray:
        """Grey values of frames (N, H, W) from electrons, whose array they take over; of each term its own numbers."""
        np.minimum(level, self.full_well_e, out=level)
        before = level.copy() if self.noise else level
        terms = ReadNoise(self.dark_noise_e), *self.noise
        added = [term.temporal_e(before, rng) for term, rng in zip(terms, each, strict=True)]
        return self._reading.read_out(level, [one for one in added if one is not None], shift)

    def saturated(self, frames: NDArray[np.uint16]) -> SaturationReport:
        """Count saturated pixels in recorded frames (..., frames, H, W); counts have shape (...,).

        A pixel is saturated when it comes within 4 sigmas of the full well, of the read noise and of further temporal
        noise at a full well, or reaches the converter's end.
        """
        if frames.ndim < 3:
            raise ValueError(f"detector: frames must be (..., frames, H, W), found shape {frames.shape}")
        well = self.offset_dn + self.system_gain_dn_per_e * (self.full_well_e - _SATURATION_SIGMAS * self._read_sigma_e)
        level = float(min(self.max_dn, well))
        return SaturationReport(level_dn=level, pixels=np.sum(largest_of(frames) >= level, axis=(-2, -1)))

    @property
    def _read_sigma_e(self) -> float:
        """Temporal noise without shot noise at a full well, electrons rms."""
        if not self.noise:
            return self.dark_noise_e
        further = sum(float(term.temporal_variance_e2(self.full_well_e)) for term in self.noise)
        return math.sqrt(self.dark_noise_e**2 + further)


def _streams(seed: Seed | Sequence[Seed], lead: tuple[int, ...]) -> list[np.random.SeedSequence]:
    """Stream of each image of some leading axes."""
    if not isinstance(seed, Sequence):
        root = _sequence(seed)
        return [stream(root, number) for number in range(math.prod(lead))]
    if len(seed) != lead[0]:
        raise ValueError(f"detector: {len(seed)} seeds for {lead[0]} exposures")
    return [own for one in seed for own in _streams(one, lead[1:])]


def _sequence(seed: Seed) -> np.random.SeedSequence:
    if isinstance(seed, np.random.SeedSequence):
        return seed
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"detector: seed must be an integer >= 0 or a SeedSequence, found {seed!r}")
    return np.random.SeedSequence(int(seed))


def _exposure(exposure_s: float) -> float:
    if not (math.isfinite(exposure_s) and 0 <= exposure_s <= 1e6):
        raise ValueError(f"detector: exposure_s must be in [0, 1e6] s, found {exposure_s!r}")
    return float(exposure_s)


def _photons(photons: ArrayLike) -> NDArray[np.float64]:
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


def told_of_steps(noise: NoiseModel, whose: str) -> tuple[str, ...]:
    """A warning for a detector whose noise does not spread over the steps of its grey values where there are few DN of
    light; none for others. It depends on the detector's numbers alone, and nothing is drawn.

    Parameters
    ----------
    noise : NoiseModel
        Of the detector.
    whose : str
        How a reader knows it.
    """
    few = float(noise.frame_variance_dn2(noise.dark_level_dn + FEW)) - ROUNDING_VARIANCE
    if few >= COARSE**2:
        return ()
    return (
        f"{whose} has coarse grey values: noise of {math.sqrt(few):.2g} DN at {FEW:g} DN of light, less than "
        f"{COARSE:g}; there rounding is the same in every frame, does not average down and is alike in neighbouring "
        "pixels, while σ takes it for another one in each; a larger system_gain_dn_per_e, with the bit_depth for it, "
        "makes the steps finer",
    )


def coarse_warnings(setup: Spec) -> tuple[str, ...]:
    """Warnings as of `told_of_steps` for the area CCDs of an instrument that a job or test refers to; none without one.

    Parameters
    ----------
    setup : Spec
        a job or test with all it refers to.

    Raises
    ------
    InputError
        As `EmvaDetector.from_sheet`.
    """
    instrument, sheet = getattr(setup, "instrument", None), getattr(setup, "detector", None)
    if not isinstance(instrument, InstrumentSpec) or not isinstance(sheet, DetectorSpec):
        return ()
    exposure = instrument.autocollimator.area_ccd.exposure
    chosen = {sheet.name: sheet, **{one.name: one for one in getattr(setup, "detectors", {}).values()}}
    out: list[str] = []
    for name, one in chosen.items():
        out += told_of_steps(EmvaDetector.from_sheet(one, exposure).noise_model(exposure), f"area CCD {name}")
    return tuple(out)
