"""How finely the monitor's pupil has to be sampled for an image, and whether an image that was made can be right.

The field on a pixel is an integral over the aperture, whose phase runs the faster the farther the pixel lies from
where the rays land. So its nodes are chosen by the largest such distance among all pixels and traced rays: aperture,
reach and aberration count together. They stand in a ladder of classes, so that many states share one set of nodes.

What was chosen is checked in every image. A second rule, with other radii and other arms, has to give some pixels
alike; where the wavefront is too rough for the nodes, or an edge cuts the beam, it does not. And the light on the CCD
has to be that of the rays that fall on it, up to what diffraction may carry across the CCD's edge.
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
"""Shares of the CCD's half size up to which sharp spots may be off its middle, one class of pupil nodes for each: the
farther off a spot, the farther its farthest pixel, and the more nodes it needs. Beyond the last the estimators refuse
it."""

_BLUR_STEP = 1.25
"""From one class to the next beyond ``SPOT_RANGES``, those of blurred spots."""

MOST_PHASE = 400.0
"""Largest phase of the last class, radians from the middle to the edge of the pupil: 42 000 nodes. A spot that needs
more is spread over some hundred times the area of a CCD.
"""

BLUR_PHASE = 1.5
"""Phase that a blur is counted with, of that of a tilt as steep as its steepest ray's. A tilt turns along one
direction; astigmatism and trefoil turn two and three times around the pupil, and their harmonics die out as much
later (by comparison with 72 800 nodes: 3e-6 of the peak for trefoil, less for all other terms to Z37)."""

_SHARP_PHASE = 1.0
"""Phase of a blur that the margins of ``quadrature.disk_for`` hold anyway, radians."""

_WIDER_BEAM = 1.001
"""Growth of the beam's aperture that needs no more nodes."""

GOOD = 1e-4
"""Difference of the two rules beyond which an image is made again with more nodes, of its peak."""

WRONG = 1e-3
"""Difference beyond which no image is given: a shot-noise sigma of a pixel that holds a million electrons."""

WINGS = 12.0
"""How far diffraction may carry light across a CCD's edge, as a phase 2 pi NA r / wavelength; of an Airy pattern less
than ``LOST`` lies farther out than that (2 / (pi z))."""

LOST = 0.08
"""Share of a channel's light that the check of its energy leaves to diffraction."""


@dataclass(eq=False)
class ImageChecks:
    """What was found in all images that a path has given so far; an image beyond a limit is never given.

    Attributes
    ----------
    images : int
        Number of them.
    difference : float
        Of the two rules at most, of the peak; `WRONG` is the limit.
    light : float
        Too much or too little at most, share of a channel's light beyond what rays and diffraction allow; 0 is the
        limit.
    """

    images: int = 0
    difference: float = 0.0
    light: float = 0.0

    def add(self, difference: np.ndarray, light: np.ndarray) -> None:
        """Add the checks of further images.

        Parameters
        ----------
        difference : np.ndarray
            (B,) of the two rules.
        light : np.ndarray
            (B,) beyond what is allowed, either sign.
        """
        self.images += difference.size
        self.difference = max(self.difference, float(np.max(difference, initial=0.0)))
        self.light = max(self.light, float(np.max(np.abs(light), initial=0.0)))

    def told(self) -> tuple[SelfCheck, ...]:
        """For a manifest; nothing where no image was made."""
        if not self.images:
            return ()
        refused = f"{self.images} images; one beyond the limit is refused"
        wings = f"{self.images} images; beyond the wings that diffraction allows; one that has any is refused"
        return (
            SelfCheck("images by a second quadrature at 16 pixels", self.difference, WRONG, "of the peak", refused),
            SelfCheck("light on the CCDs against that of the rays", self.light, 0.0, "of a channel's light", wings),
        )


class UncertainImageError(BeamMissedError):
    """An image of the monitor cannot be worked out to ``WRONG`` of its peak."""


@dataclass(frozen=True)
class NodeClasses:
    """Sizes of pupil quadrature, from that of sharp spots near the middle of a CCD to the last that is tried.

    Attributes
    ----------
    phase_per_pixel : float
        From the middle to the edge of the nominal pupil, radians for one pixel.
    half : tuple[float, float]
        Of the CCD (rows, columns), pixels.
    """

    phase_per_pixel: float
    half: tuple[float, float]

    @property
    def reached(self) -> np.ndarray:
        """Distances from the rays' middle, in half diagonals of the CCD, up to which each class is right."""
        most = MOST_PHASE / (self.phase_per_pixel * float(np.hypot(*self.half)))
        steps = 1.0 + SPOT_RANGES[-1]
        out = [1.0 + share for share in SPOT_RANGES]
        while steps * _BLUR_STEP <= most:
            steps *= _BLUR_STEP
            out.append(steps)
        return np.array(out)

    def phase(self, number: int) -> float:
        """Largest phase of a class, radians."""
        return float(self.phase_per_pixel * np.hypot(*self.half) * self.reached[number])

    @property
    def sharp_count(self) -> int:
        """Nodes of sharp spots anywhere in the last of ``SPOT_RANGES``, which every instrument takes."""
        rings, arms = quadrature.disk_size(self.phase(len(SPOT_RANGES) - 1))
        return rings * arms

    def nodes(self, number: int) -> PupilNodes:
        """Pupil nodes of a class."""
        return quadrature.disk_for(self.phase(number))

    def second_nodes(self, number: int) -> PupilNodes:
        """Pupil nodes of the second quadrature, which checks a class."""
        return quadrature.second_disk_for(self.phase(number))

    def class_of(
        self, place: np.ndarray, margin: int = 0, blur: np.ndarray | float = 0.0, widening: np.ndarray | float = 1.0
    ) -> np.ndarray:
        """Number of the first class that is right for all spots of each state, (S,); the number of classes for none.

        Parameters
        ----------
        place : np.ndarray
            Middle of the spots (C, S, 2), pixels from the CCD's middle.
        margin : int
            Extra pixels rendered on every side of the CCD.
        blur : np.ndarray | float
            Of the farthest rays from there, (C, S), pixels.
        widening : np.ndarray | float
            Of the beams' apertures against the nominal one, (C, S).
        """
        half = np.array(self.half)
        wide = np.where(np.asarray(widening) > _WIDER_BEAM, widening, 1.0)
        more = np.maximum(BLUR_PHASE * (wide * blur - _SHARP_PHASE / self.phase_per_pixel), 0.0)
        farthest = np.max(wide * np.linalg.norm(np.abs(place) + half + margin, axis=-1) + more, axis=0)
        return np.searchsorted(self.reached, farthest / np.linalg.norm(half))


def disagreement(images: np.ndarray, second: PupilField, x: Grid, y: Grid) -> np.ndarray:
    """Largest difference of images from those of a second rule at their corners, on their peak and beside it, (B,), of
    the peak.

    Parameters
    ----------
    images : np.ndarray
        As of ``optics.waves.diffraction.image`` on the grid of columns x and rows y, (B, R, C).
    second : PupilField
        Pupils of the same beams at the nodes of the second rule.
    x : Grid
        Of the images.
    y : Grid
        likewise.
    """
    count, rows, columns = images.shape
    top = np.argmax(images.reshape(count, -1), axis=-1)
    row, column = top // columns, top % columns
    # halfway from the peak to the nearer edge: some place on its flank or in its rings
    along = [
        np.stack([np.zeros_like(at), at, (at + np.where(2 * at < n, n - 1, 0)) // 2, np.full_like(at, n - 1)], axis=-1)
        for at, n in ((row, rows), (column, columns))
    ]
    seen = images[np.arange(count)[:, None, None], along[0][:, :, None], along[1][:, None, :]]
    want = at_intersections(second, x.start + x.step * along[1], y.start + y.step * along[0])
    peak = np.maximum(images.reshape(count, -1).max(axis=-1), want.reshape(count, -1).max(axis=-1))
    return np.asarray(np.max(np.abs(seen - want), axis=(-2, -1)) / peak)


def lost_or_gained(
    light: np.ndarray, place: np.ndarray, share: np.ndarray, half: np.ndarray, wings: np.ndarray
) -> np.ndarray:
    """How far the light of images lies outside what the traced rays allow, (B,): shares of the channel's light,
    negative for too little.

    Parameters
    ----------
    light : np.ndarray
        On the image, share of a channel's, (B,).
    place : np.ndarray
        Of rays from the middle of the image, (B, N, 2), (row, column) in pixels.
    share : np.ndarray
        Light of each, 0 for one that is lost, (B, N).
    half : np.ndarray
        Half sizes of the image (rows, columns), pixels.
    wings : np.ndarray
        How far diffraction reaches, pixels, (B,).
    """
    outside = np.max(np.abs(place) - half, axis=-1)
    most = np.sum(share * (outside < wings[:, None]), axis=-1) + LOST
    least = np.sum(share * (outside < -wings[:, None]), axis=-1) - LOST
    return np.asarray(np.maximum(light - most, 0.0) - np.maximum(least - light, 0.0))
