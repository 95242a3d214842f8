"""Pupils of an image in the light of a band: one that serves all wavelengths, or one of each where lenses are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from optics.numerics.invariants import UnphysicalError
from optics.waves.pupil_stack import PupilFunction
from optics.waves.transfer import TransferTable, polychromatic_transfer
from scenes.specs.camera import BandSpec
from scenes.specs.spectrum import SpectrumSpec
from twin.sensors.line_ccd import band_wavelengths

WORST_CHANGE = 5e-4
"""Largest change of an MTF by a rule of more wavelengths at which it is taken as it is."""

LARGEST_RULE = 65
"""Wavelengths of the last rule, beyond which there is no MTF over a light."""


@dataclass(frozen=True, eq=False)
class BandPupils:
    """Pupils of one image, all about one point of it, so that colours that stand apart blur it.

    Attributes:
        pupils: of every wavelength, (K,), or one alone, the same at all of them.
        wavelengths: (K,), metres.
        weights: share of the signal at each, (K,), which sum to 1.
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

    Args:
        spectrum: the light.
        first: count of the first rule.
        values: of the MTF by the rule of so many wavelengths, or of other numbers of this kind.
        largest: wavelengths of the last rule.

    Raises:
        UnphysicalError: it still changes by more than ``WORST_CHANGE`` at ``largest`` wavelengths.
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
