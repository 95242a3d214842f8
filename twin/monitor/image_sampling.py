"""Sampling of the monitor's pupil for an image, and checks of the computed images.

The field on a pixel is an integral over the aperture; its phase varies the faster, the farther the pixel is from the
point where the rays arrive. The quadrature nodes are therefore chosen by the largest such distance among all pixels and
traced rays, which includes aperture, extent of the image and aberration. There is a series of ever finer quadratures
(classes of nodes), so that many states share one set of nodes.

Every image is checked. A second quadrature, with other radii and angles, has to give the same values at some pixels; it
does not if the wavefront is too rough for the nodes, or if an edge cuts the beam. The light on the CCD has to equal
that of the rays that fall on it, within what diffraction may carry across the CCD's edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optics.numerics import quadrature
from optics.numerics.quadrature import PupilNodes
from optics.raytrace.trace import BeamMissedError
from optics.waves.diffraction import Grid, PupilField, at_intersections
from twin.framework.provenance import SelfCheck

SPOT_RANGES = (0.25, 0.5, 0.8)
"""Largest distances of sharp spots from the CCD's centre, as fractions of its half size, one per class of nodes.

A class is a set of quadrature nodes over the pupil. The farther a spot is off centre, the farther its farthest pixel,
and the more nodes it needs. The estimators refuse spots beyond the last fraction.
"""

_BLUR_STEP = 1.25
"""Ratio of the largest ray distance of one class of pupil nodes to that of the class before it, for blurred spots."""

MOST_PHASE = 400.0
"""Largest phase from the centre to the edge of the pupil, in radians, that the finest class of nodes allows.

It needs 42 000 nodes. A spot that needs more is spread over some hundred times the area of a CCD.
"""

BLUR_PHASE = 1.5
"""Factor by which the phase of an aberration counts more than that of a tilt with the same steepest ray.

It determines how many pupil nodes a blurred spot needs. A tilt varies along one direction; astigmatism and trefoil vary
two and three times around the pupil, and the harmonics that a quadrature must integrate decay correspondingly later
(error of this factor, compared with 72 800 nodes: 3e-6 of the peak for trefoil, less for all other terms to Z37).
"""

_SHARP_PHASE = 1.0
"""Phase due to blur, in radians, that the number of nodes from ``quadrature.disk_for`` already allows for."""

_WIDER_BEAM = 1.001
"""Largest ratio of a beam's aperture to the nominal one that needs no additional nodes."""

GOOD = 1e-4
"""Difference of an image between two quadratures, relative to its peak, above which more nodes are used."""

WRONG = 1e-3
"""Difference of an image between two quadratures, relative to its peak, above which the image is refused.

It is the shot-noise sigma of a pixel with a million electrons.
"""

WINGS = 12.0
"""Distance over which diffraction may carry light across a CCD's edge, as a phase 2 pi NA r / wavelength.

NA is the numerical aperture and r the distance; less than ``LOST`` of an Airy pattern's light lies farther out.
"""

LOST = 0.08
"""Fraction of a channel's light that the energy check attributes to diffraction."""


@dataclass(eq=False)
class ImageChecks:
    """Largest deviations in the checks of all images so far; an image beyond a limit is refused.

    Attributes
    ----------
    images : int
        Number of images.
    difference : float
        Largest difference between two quadratures over the pupil, relative to the peak; the limit is `WRONG`.
    light : float
        Largest excess or deficit of light, as a fraction of a channel's light beyond what rays and diffraction allow;
        the limit is 0.
    """

    images: int = 0
    difference: float = 0.0
    light: float = 0.0

    def add(self, difference: np.ndarray, light: np.ndarray) -> None:
        """Add the checks of B further images.

        Parameters
        ----------
        difference : (B,) ndarray
            Difference of each image between two quadratures, relative to its peak.
        light : (B,) ndarray
            Light beyond the allowed range, as a fraction of the channel's light: positive for an excess, negative for a
            deficit.
        """
        self.images += difference.size
        self.difference = max(self.difference, float(np.max(difference, initial=0.0)))
        self.light = max(self.light, float(np.max(np.abs(light), initial=0.0)))

    def self_checks(self) -> tuple[SelfCheck, ...]:
        """Return the checks in the form of a run's manifest; an empty tuple if no image was made."""
        if not self.images:
            return ()
        refused = f"{self.images} images; images beyond the limit are refused"
        wings = f"{self.images} images; light beyond the wings of diffraction; images with any are refused"
        return (
            SelfCheck("images by a second quadrature at 16 pixels", self.difference, WRONG, "of the peak", refused),
            SelfCheck("light on the CCDs against that of the rays", self.light, 0.0, "of a channel's light", wings),
        )


class UncertainImageError(BeamMissedError):
    """Error that an image of the monitor cannot be computed to within ``WRONG`` of its peak."""


@dataclass(frozen=True)
class NodeClasses:
    """Series of ever finer pupil quadratures (classes of nodes), from sharp centred spots to the most blurred ones.

    Attributes
    ----------
    phase_per_pixel : float
        Phase difference between the centre and the edge of the nominal pupil for a point one pixel off the spot, in
        radians per pixel.
    half : tuple of float
        Half size of the CCD (rows, columns), in pixels.
    """

    phase_per_pixel: float
    half: tuple[float, float]

    @property
    def reached(self) -> np.ndarray:
        """Largest distance of a pixel from a ray's arrival point for each class, in half diagonals of the CCD."""
        most = MOST_PHASE / (self.phase_per_pixel * float(np.hypot(*self.half)))
        steps = 1.0 + SPOT_RANGES[-1]
        out = [1.0 + share for share in SPOT_RANGES]
        while steps * _BLUR_STEP <= most:
            steps *= _BLUR_STEP
            out.append(steps)
        return np.array(out)

    def phase(self, number: int) -> float:
        """Return the largest phase from the centre to the edge of the pupil that a class allows, in radians."""
        return float(self.phase_per_pixel * np.hypot(*self.half) * self.reached[number])

    @property
    def sharp_count(self) -> int:
        """Number of pupil nodes for a sharp spot as far off the CCD's centre as the last of ``SPOT_RANGES`` allows."""
        rings, arms = quadrature.disk_size(self.phase(len(SPOT_RANGES) - 1))
        return rings * arms

    def nodes(self, number: int) -> PupilNodes:
        """Return the quadrature nodes over the pupil of the class with index ``number``."""
        return quadrature.disk_for(self.phase(number))

    def second_nodes(self, number: int) -> PupilNodes:
        """Return the nodes of a second quadrature over the pupil, used to check the images of a class."""
        return quadrature.second_disk_for(self.phase(number))

    def class_of(
        self, position: np.ndarray, margin: int = 0, blur: np.ndarray | float = 0.0, widening: np.ndarray | float = 1.0
    ) -> np.ndarray:
        """Return the first class of nodes that suffices for all spots of each state.

        If none suffices, the result is the number of classes.

        Dimensions: C channels (one spot each), S states.

        Parameters
        ----------
        position : (C, S, 2) ndarray
            Centres of the spots, in pixels from the CCD's centre.
        margin : int
            Extra pixels rendered on every side of the CCD.
        blur : (C, S) ndarray | float
            Distance of the farthest rays from the spot's centre, in pixels.
        widening : (C, S) ndarray | float
            Apertures of the beams, relative to the nominal one.

        Returns
        -------
        (S,) ndarray of int
            Index of each state's class.
        """
        half = np.array(self.half)
        wide = np.where(np.asarray(widening) > _WIDER_BEAM, widening, 1.0)
        more = np.maximum(BLUR_PHASE * (wide * blur - _SHARP_PHASE / self.phase_per_pixel), 0.0)
        farthest = np.max(wide * np.linalg.norm(np.abs(position) + half + margin, axis=-1) + more, axis=0)
        return np.searchsorted(self.reached, farthest / np.linalg.norm(half))


def quadrature_difference(images: np.ndarray, second: PupilField, x: Grid, y: Grid) -> np.ndarray:
    """Return the largest difference of each image from a second pupil quadrature, relative to its peak, (B,).

    The images are compared at their corners, at their peak and beside it.

    Dimensions: B images, R rows, C columns.

    Parameters
    ----------
    images : (B, R, C) ndarray
        Images from ``optics.waves.diffraction.image`` on the grid of columns x and rows y.
    second : PupilField
        Pupils of the same beams at the nodes of the second rule.
    x : Grid
        Columns of the images.
    y : Grid
        Rows of the images.
    """
    count, rows, columns = images.shape
    top = np.argmax(images.reshape(count, -1), axis=-1)
    row, column = top // columns, top % columns
    # halfway from the peak to the nearer edge: on its flank or in its rings
    along = [
        np.stack([np.zeros_like(at), at, (at + np.where(2 * at < n, n - 1, 0)) // 2, np.full_like(at, n - 1)], axis=-1)
        for at, n in ((row, rows), (column, columns))
    ]
    values = images[np.arange(count)[:, None, None], along[0][:, :, None], along[1][:, None, :]]
    expected = at_intersections(second, x.start + x.step * along[1], y.start + y.step * along[0])
    peak = np.maximum(images.reshape(count, -1).max(axis=-1), expected.reshape(count, -1).max(axis=-1))
    return np.asarray(np.max(np.abs(values - expected), axis=(-2, -1)) / peak)


def energy_excess(
    light: np.ndarray, position: np.ndarray, share: np.ndarray, half: np.ndarray, wings: np.ndarray
) -> np.ndarray:
    """Return the fraction of each image's light outside the range that the traced rays allow, (B,).

    It is positive for an excess and negative for a deficit.

    Parameters
    ----------
    light : (B,) ndarray
        Light on each of B images, as a fraction of the channel's light.
    position : (B, N, 2) ndarray
        Positions of N rays from the centre of the image, (row, column) in pixels.
    share : (B, N) ndarray
        Fraction of the channel's light that each ray carries, 0 for a lost ray.
    half : (2,) ndarray
        Half size of the image (rows, columns), in pixels.
    wings : (B,) ndarray
        Distance over which diffraction may carry light across the edge, in pixels.
    """
    outside = np.max(np.abs(position) - half, axis=-1)
    most = np.sum(share * (outside < wings[:, None]), axis=-1) + LOST
    least = np.sum(share * (outside < -wings[:, None]), axis=-1) - LOST
    return np.asarray(np.maximum(light - most, 0.0) - np.maximum(least - light, 0.0))
