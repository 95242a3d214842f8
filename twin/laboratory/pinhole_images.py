"""Images of a pinhole on a line CCD, anywhere over the field and at any place between the pixels, without noise.

The transfer function of an image about its chief ray changes slowly over the field. So its product with the pinhole's
spectrum and the line CCD's transfer is worked out at a few Chebyshev nodes and interpolated by the polynomial through
them. An image is then a Fourier sum at the pixel centres, shifted exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from optics.pupil_function import PupilFunction
from optics.targets import Target
from optics.threads import one_blas_thread
from optics.transfer import TransferTable, transfer
from optics.tree import State
from optics.vector_shape import Disk, Polygon
from twin.line_ccd import LineCcd, band_wavelengths
from twin.target_path import TargetPath

NODES = 10
"""Chebyshev nodes over the field: images of gf7 between them are right to 1e-5 of their peak, their centres to 1 nm."""

GUARD = 160.0
"""Distance between the window and the copies of the spot in the Fourier sum, in units of 1/cut-off. The irradiance of a
clear pupil falls as 1/distance^3: over the pan line's window a copy is below 1e-6 of the peak, and nearly even.
"""

_RIM = np.pi * np.arange(16) / 16


@dataclass(frozen=True, eq=False)
class PinholeImages:
    """Spots of a pinhole over the field.

    Attributes:
        reach: largest turn of the camera either way, radians.
        fx, fy: frequencies along the line (half of them, from zero) and along the track, (U,), (V,), cycles/m.
        spectra: at the nodes over the field, complex (nodes, V, U); a wide bright area would have level 1.
        pitch: of the pixels, metres.
        window: pixels of an image either way.
        diameter: of the pinhole's geometric image along the line in the middle of the field, metres.
    """

    reach: float
    fx: np.ndarray
    fy: np.ndarray
    spectra: np.ndarray
    pitch: float
    window: int
    diameter: float

    @classmethod
    def build(
        cls,
        path: TargetPath,
        state: State,
        directions: Callable[[np.ndarray], np.ndarray],
        reach: float,
        target: Target,
        ccd: LineCcd,
        window: int,
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> PinholeImages:
        """Work out the spectra.

        Args:
            path: from the target to the line CCD's plane.
            state: of the camera.
            directions: turns of the camera (M,) to directions of the light (M, 3), world.
            reach: of the turns, radians.
            target: the pinhole, one disk.
            ccd: the line CCD.
            window: pixels.
            progress: told (done, total).

        Raises:
            BeamMissedError, AimError, ValueError: the beam does not get through, or its wavefront is too bad for a fit.
        """
        light = directions(reach * _nodes())
        pupils = path.pupils(state, light, path.places(state, light))
        wavelengths, weights = band_wavelengths(ccd.band)
        rim = np.stack([np.cos(_RIM), np.sin(_RIM)], axis=-1)
        cutoff = max(float(np.max(pupil.cutoff(rim, wavelengths[0]))) for pupil in pupils)
        pitch = ccd.band.pitch
        period = window * pitch + GUARD / cutoff
        most = int(cutoff * period)
        fx, fy = np.arange(most + 1) / period, np.arange(-most, most + 1) / period
        grid = fx, fy[:, None]
        # frequencies below zero are the conjugates of those above
        common = ccd.transfer(*grid) * np.where(fx > 0.0, 2.0, 1.0) / period**2
        ((_, hole),) = target.parts
        assert isinstance(hole, Disk)
        spectra, middle = np.empty((NODES, len(fy), len(fx)), complex), 0.0
        for n, (pupil, one) in enumerate(zip(pupils, light, strict=True)):
            image = hole.mapped(path.local_map(state, one, 1.5 * hole.radius))
            table = TransferTable.build(pupil, wavelengths, weights)
            spectra[n] = image.spectrum(*grid) * table(*grid) * common
            middle = _width(image) if n == NODES // 2 else middle
            progress(n + 1, NODES)
        return cls(reach, fx, fy, spectra, pitch, window, middle)

    def __call__(self, turn: float, place: np.ndarray) -> np.ndarray:
        """Images at one place of the field.

        Args:
            turn: of the camera, radians.
            place: of the chief rays from the centre of the window's first pixel, (S, 2) (along, across), metres.

        Returns:
            (S, window, window), rows along the track.
        """
        spectrum = np.tensordot(_share(turn / self.reach), self.spectra, 1)
        pixel = self.pitch * np.arange(self.window)
        along = np.exp(2j * np.pi * self.fx[:, None, None] * (pixel - place[:, :1]))
        across = np.exp(2j * np.pi * (pixel - place[:, 1:])[..., None] * self.fy)
        with one_blas_thread():
            half = (spectrum @ along.reshape(len(self.fx), -1)).reshape(len(self.fy), len(place), self.window)
            return np.asarray((across @ half.swapaxes(0, 1)).real)

    @property
    def width(self) -> float:
        """Diameter of the pinhole's geometric image along the line, pixels."""
        return self.diameter / self.pitch


def centroid_offset(path: TargetPath, state: State, directions: np.ndarray) -> np.ndarray:
    """Energy centroid of the image of a point minus its chief ray along the line, (F,), metres: the mean slope of the
    wavefront over the pupil, which is the same for all wavelengths.

    From the phase of the transfer function at a ten-thousandth of the cut-off.
    """
    pupils: tuple[PupilFunction, ...] = path.pupils(state, directions, path.places(state, directions))
    wavelength, along = path.model.spec.wavelength, np.array([[1.0, 0.0]])
    out = []
    for pupil in pupils:
        frequency = 1e-4 * float(pupil.cutoff(along, wavelength)[0])
        phase = np.angle(transfer(pupil, frequency * along, wavelength, np.zeros(1))[0, 0])
        out.append(-phase / (2.0 * np.pi * frequency))
    return np.array(out)


def at_nodes(reach: float) -> np.ndarray:
    """Turns (NODES,) at which something smooth over the field is worked out for ``between``, radians."""
    return np.asarray(reach * _nodes())


def between(values: np.ndarray, reach: float, turn: np.ndarray) -> np.ndarray:
    """Values (M,) at turns (M,) of the polynomial through values (NODES,) at the nodes."""
    return np.array([_share(one / reach) @ values for one in turn])


def _nodes() -> np.ndarray:
    """Chebyshev nodes on -1 ... 1, from the left."""
    return np.asarray(-np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES))


def _share(place: float) -> np.ndarray:
    """What each node gives to the polynomial at a place on -1 ... 1, (NODES,)."""
    order = np.polynomial.chebyshev.chebvander(_nodes(), NODES - 1)
    return np.linalg.solve(order.T, np.polynomial.chebyshev.chebvander(np.array([place]), NODES - 1)[0])


def _width(image: Disk | Polygon) -> float:
    """Size of a shape along x, metres."""
    low, high, _, _ = image.bounds
    return high - low
