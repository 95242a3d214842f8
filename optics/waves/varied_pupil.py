"""MTF of a pupil whose wavefront varies a little about that of a known one, for thousands of wavefronts at once.

The nodes of the overlap's quadrature (``optics.waves.transfer``) and what the known pupil has there are worked out
once; a varied wavefront then costs a matrix product and a sum of phasors. The edge and the amplitude are the known
pupil's: small motions change them in the second order of what they do to the wavefront.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optics.numerics.quadrature import gauss
from optics.waves.pupil_stack import PupilFunction
from optics.waves.pupil_terms import products

ACROSS, ALONG, IN_SHADOW = 24, 18, 12
"""Nodes across and along the chords of an overlap, and along each side of a shadow's box: with a wave of error at the
edge of the pupil the MTF is right to 1e-6."""


@dataclass(frozen=True, eq=False)
class VariedTransfer:
    """The optical transfer function of one pupil at one frequency.

    Attributes:
        phasors: of the known pupil at the nodes of the overlap with their weights, complex (Q,); their sum is its
            transfer function.
        turns: from optical paths at the traced nodes of the stop to what they add to the phases at the nodes of the
            overlap, by polynomials over the pupil, (Q, N), radians per metre.
    """

    phasors: np.ndarray
    turns: np.ndarray

    @classmethod
    def of(
        cls,
        pupil: PupilFunction,
        frequency: np.ndarray,
        wavelength: float,
        cosines: np.ndarray,
        degree: int,
    ) -> VariedTransfer | None:
        """Work out what does not vary.

        Args:
            pupil: the known one.
            frequency: along the detector's axes, (2,), cycles/m.
            wavelength: metres.
            cosines: direction cosines along these axes of the rays whose wavefront varies, (N, 2).
            degree: of the polynomials of its variation.

        Returns:
            None beyond the cut-off.
        """
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
        return cls(phasors, wave * steps @ np.linalg.pinv(products(place[0], place[1], degree)))

    def modulation(self, paths: np.ndarray) -> np.ndarray:
        """MTF where the optical paths of the rays are longer by ``paths`` (..., N), metres, than the known pupil's."""
        phase = paths @ self.turns.T
        return np.asarray(np.abs(np.cos(phase) @ self.phasors + 1j * (np.sin(phase) @ self.phasors)))

    def curvature(self, slopes: np.ndarray) -> np.ndarray:
        """Second derivatives of the MTF by pairs of numbers, (K, K), at the known pupil.

        Args:
            slopes: of the rays' optical paths by the numbers, (K, N), metres.
        """
        phases = slopes @ self.turns.T
        whole = np.sum(self.phasors)
        first = 1j * phases @ self.phasors
        second = -(phases * self.phasors) @ phases.T
        size = abs(whole)
        along = np.real(np.conj(whole) * first) / size
        across = np.real(np.outer(np.conj(first), first) + np.conj(whole) * second)
        return np.asarray((across - np.outer(along, along)) / size)
