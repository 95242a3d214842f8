"""MTF of a pupil whose wavefront varies a little about that of a known one, for thousands of wavefronts at once.

The nodes of the overlap's quadrature (``optics.waves.transfer``) and what the known pupil has there are worked out
once; a varied wavefront then costs a matrix product and a sum of phasors. The edge and the amplitude are the known
pupil's: small motions change them in the second order of what they do to the wavefront.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optics.numerics.quadrature import gauss
from optics.waves.pupil_stack import PupilFunction
from optics.waves.pupil_terms import products

ACROSS, ALONG, IN_SHADOW = 24, 18, 12
"""Nodes across and along the chords of an overlap, and along each side of a shadow's box: with a wave of error at the
edge of the pupil the MTF is right to 1e-6."""


@dataclass(frozen=True, eq=False)
class _Colour:
    """One wavelength of a varied transfer function.

    Attributes:
        phasors: of the known pupil at the nodes of the overlap with their weights, complex (Q,); their sum is its
            transfer function, times the wavelength's share.
        turns: from optical paths at the traced nodes of the stop to what they add to the phases at the nodes of the
            overlap, by polynomials over the pupil, (Q, N), radians per metre.
        own: which of the paths of all traced wavelengths are its own.
    """

    phasors: np.ndarray
    turns: np.ndarray
    own: slice


@dataclass(frozen=True, eq=False)
class VariedTransfer:
    """The optical transfer function of one image at one frequency, in light of one wavelength or several.

    Its paths are those of the traced wavelengths, one after the other, (..., K N), metres; of mirrors, which image all
    wavelengths alike, one is traced for all.

    Attributes:
        colours: its wavelengths below the cut-off.
    """

    colours: tuple[_Colour, ...]

    @classmethod
    def of(
        cls,
        pupils: Sequence[PupilFunction],
        frequency: np.ndarray,
        wavelengths: np.ndarray,
        shares: np.ndarray,
        cosines: np.ndarray,
        degree: int,
    ) -> VariedTransfer | None:
        """Work out what does not vary.

        Args:
            pupils: the known ones, all about one point of the image: of every wavelength, or one for all.
            frequency: along the detector's axes, (2,), cycles/m.
            wavelengths: metres, (C,).
            shares: of the wavelengths in the light, which sum to 1, (C,).
            cosines: direction cosines along these axes of the rays whose wavefront varies, (C, N, 2), or (1, N, 2).
            degree: of the polynomials of its variation.

        Returns:
            None beyond the cut-off of all wavelengths.
        """
        out, rays = [], cosines.shape[1]
        for k, (wavelength, share) in enumerate(zip(wavelengths, shares, strict=True)):
            pupil = pupils[k if len(pupils) > 1 else 0]
            start = k if len(cosines) > 1 else 0
            found = _fixed(pupil, frequency, float(wavelength), cosines[start], degree)
            if found is not None:
                out.append(_Colour(share * found[0], found[1], slice(start * rays, (start + 1) * rays)))
        return cls(tuple(out)) if out else None

    @property
    def known(self) -> float:
        """MTF of the known pupil."""
        return float(abs(sum(np.sum(one.phasors) for one in self.colours)))

    def modulation(self, paths: np.ndarray) -> np.ndarray:
        """MTF where the optical paths of the rays are longer than the known pupil's by ``paths`` (..., K N), metres."""
        whole: np.ndarray | int = 0
        for one in self.colours:
            phase = paths[..., one.own] @ one.turns.T
            whole = whole + (np.cos(phase) @ one.phasors + 1j * (np.sin(phase) @ one.phasors))
        return np.asarray(np.abs(whole))

    def curvature(self, slopes: np.ndarray) -> np.ndarray:
        """Second derivatives of the MTF by pairs of numbers, (L, L), at the known pupil.

        Args:
            slopes: of the rays' optical paths by the numbers, (L, K N), metres.
        """
        whole, first, second = 0j, 0j, 0j
        for one in self.colours:
            phases = slopes[:, one.own] @ one.turns.T
            whole = whole + np.sum(one.phasors)
            first = first + 1j * phases @ one.phasors
            second = second - (phases * one.phasors) @ phases.T
        size = abs(whole)
        along = np.real(np.conj(whole) * first) / size
        across = np.real(np.outer(np.conj(first), first) + np.conj(whole) * second)
        return np.asarray((across - np.outer(along, along)) / size)


def _fixed(
    pupil: PupilFunction, frequency: np.ndarray, wavelength: float, cosines: np.ndarray, degree: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Phasors and turns of one wavelength; arguments as of ``VariedTransfer.of``, cosines (N, 2)."""
    shift = np.atleast_1d(pupil.normalised(*(wavelength * np.asarray(frequency))))
    right, left, inside = pupil.edge.corners(shift)
    if not inside[0]:
        return None
    own = [pupil.edge.overlap(shift, right, left, gauss(ACROSS), gauss(ALONG))]
    if pupil.shadow is not None:
        taken, area = pupil.shadow.overlap(shift[None], IN_SHADOW)
        own.append((taken[0], area[0]))
    points, weight = (np.concatenate(arrays, axis=1)[0] for arrays in zip(*own, strict=True))
    ahead, behind = points + 0.5 * shift, points - 0.5 * shift
    (path, light), (path_behind, light_behind) = pupil.values(ahead), pupil.values(behind)
    wave = 2.0 * np.pi / wavelength
    scale = abs(np.linalg.det(pupil.axes)) / pupil.power
    phasors = scale * weight * light * light_behind * np.exp(1j * wave * (path - path_behind))
    place = np.linalg.solve(pupil.axes, (cosines - pupil.centre).T)
    steps = products(ahead.real, ahead.imag, degree) - products(behind.real, behind.imag, degree)
    return phasors, wave * steps @ np.linalg.pinv(products(place[0], place[1], degree))
