"""Collimator as the camera sees it: a plane wave with wavefront error, curved when the target is out of focus."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from optics.geometry import zernike
from optics.numerics.array_math import PhysicalError
from optics.numerics.number_tree import FrozenMap


class TooNarrowError(PhysicalError, ValueError):
    """Error: the collimator's aperture is smaller than the camera's beam."""


@dataclass(frozen=True)
class Collimator:
    """Collimator with a target at its focus.

    Attributes
    ----------
    focal_length : float
        Focal length, metres.
    radius : float
        Radius of the aperture, metres.
    wavefront : mapping of int to float
        Noll index -> wavefront error over the aperture, metres rms, positive where the wave is ahead.
    """

    focal_length: float
    radius: float
    wavefront: Mapping[int, float] = field(default_factory=FrozenMap)

    def __post_init__(self) -> None:
        """Make the mapping of wavefront terms immutable."""
        object.__setattr__(self, "wavefront", FrozenMap(self.wavefront))

    def path(self, point: np.ndarray, target_shift: float = 0.0) -> np.ndarray:
        """Return the optical path of the incoming beam, beyond that of a plane wave.

        Parameters
        ----------
        point : (..., 2) ndarray
            Transverse coordinates from the collimator's axis, metres.
        target_shift : float
            Displacement of the target from the focus, along the direction of the light (toward the collimator's optics,
            so that the beam diverges), metres. The image in a camera of focal length f then moves along the direction
            of the light by ``target_shift * (f / focal_length)**2`` (Newton's equation).

        Returns
        -------
        (...) ndarray
            Optical path, metres.

        Raises
        ------
        TooNarrowError
            A point lies outside the aperture.
        """
        square = np.sum(point**2, axis=-1)
        if np.max(square) > self.radius**2:
            width = 2e3 * float(np.sqrt(np.max(square)))
            raise TooNarrowError(
                f"the camera's beam is {width:.0f} mm wide about the collimator's axis, but the collimator's "
                f"aperture is only {2e3 * self.radius:.0f} mm"
            )
        out = 0.5 * target_shift / self.focal_length**2 * square
        if self.wavefront:
            terms = np.zeros(max(self.wavefront))
            for number, size in self.wavefront.items():
                terms[number - 1] = size
            out = out - zernike.basis(len(terms), point[..., 0] / self.radius, point[..., 1] / self.radius) @ terms
        return np.asarray(out)
