"""Noise of a detector beyond the linear model of EMVA 1288, term by term: what it adds to frames, and the variance that
the analysis is told of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from analysis.spots.noise import FurtherNoise

__all__ = ["NOISE_TERMS", "FixedOffsets", "NoiseTerm", "ReadNoise"]


class NoiseTerm(FurtherNoise, Protocol):
    """What a term adds to the electrons of a pixel, after the well is clipped and before the grey value is made.

    It is independent from pixel to pixel and of mean zero, and its variances are those that ``FurtherNoise`` tells.
    """

    def fixed_e(self, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray | None:
        """The same in every frame: (..., H, W) electrons for detectors of that shape; None for nothing."""
        ...

    def temporal_e(self, electrons: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
        """New in every frame: electrons of the shape of those collected, (frames, H, W); None for nothing."""
        ...


@dataclass(frozen=True)
class ReadNoise:
    """Normal noise of the electronics, new in every frame.

    Attributes:
        sigma_e: electrons rms.
    """

    sigma_e: float

    @property
    def fixed_variance_e2(self) -> float:
        """None."""
        return 0.0

    def temporal_variance_e2(self, electrons: Any) -> float:
        """The same at every signal."""
        return self.sigma_e**2

    def fixed_e(self, shape: tuple[int, ...], rng: np.random.Generator) -> None:
        """Nothing."""
        return

    def temporal_e(self, electrons: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
        """Drawn for every pixel of every frame; no number is drawn for a sigma of zero."""
        if self.sigma_e <= 0:
            return None
        out = rng.standard_normal(electrons.shape)
        out *= self.sigma_e
        return out


@dataclass(frozen=True)
class FixedOffsets:
    """Normal differences of the pixels' offsets.

    Attributes:
        sigma_e: electrons rms.
    """

    sigma_e: float

    @property
    def fixed_variance_e2(self) -> float:
        """Over pixels."""
        return self.sigma_e**2

    def temporal_variance_e2(self, electrons: Any) -> float:
        """None."""
        return 0.0

    def fixed_e(self, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
        """Drawn for every pixel."""
        return self.sigma_e * rng.standard_normal(shape)

    def temporal_e(self, electrons: np.ndarray, rng: np.random.Generator) -> None:
        """Nothing."""
        return


NOISE_TERMS: dict[str, Callable[[float], NoiseTerm]] = {"read": ReadNoise, "offset": FixedOffsets}
"""Name that a data sheet may write under ``noise`` -> the term of the number that stands there, electrons rms where the
term does not say otherwise. A new one is added here.
"""
