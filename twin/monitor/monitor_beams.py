"""Beams of the monitor from every pinhole through the camera and back to the area CCD, and their rays.

A beam is limited by the aperture of the return face, the mirror surface that sends the light back. Rays are aimed at
quadrature nodes of that aperture in every state, so that its edge is exact; at the CCD each ray is a plane wave. The
face is assumed to be evenly illuminated.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optics.geometry import zernike
from optics.geometry.tree import PlacedBodies, State
from optics.numerics import quadrature
from optics.numerics.array_math import inverse, product
from optics.numerics.backend import Backend
from optics.numerics.quadrature import PupilNodes
from optics.raytrace.aim import RayFan, aim, surviving_rays, transverse_axes
from optics.raytrace.system import SystemBatch, UploadedSystems, assemble
from optics.raytrace.trace import BeamMissedError, make_rays, trace
from optics.waves.diffraction import Grid, PupilField, at_intersections
from optics.waves.imaging import eikonal
from scenes.models.instrument_model import Instrument
from scenes.specs.instrument import Channel
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


@dataclass(frozen=True, eq=False)
class AimedRays:
    """Rays from the pinholes, aimed at the aperture's nodes, for C channels x S states.

    All states of a channel follow one another along the first axis.

    Dimensions: N quadrature nodes of the return face's aperture.

    Attributes
    ----------
    position, direction : (C*S, N, 3) ndarray
        Launch points (metres) and unit directions in the world frame.
    axes : (C*S, 1, 2, 3) ndarray
        Two unit vectors perpendicular to each channel's beam.
    parameters : (C*S, N, 2) ndarray
        Aim parameters: components of a ray's direction along these two vectors.
    jacobian : (C*S, N, 2, 2) ndarray
        Derivatives of the point where each ray hits the return face with respect to its aim parameters, in metres.
    """

    position: np.ndarray
    direction: np.ndarray
    axes: np.ndarray
    parameters: np.ndarray
    jacobian: np.ndarray


@dataclass(frozen=True, eq=False)
class CoarseTrace:
    """Trace with a few rays that finds the spots of C channels in S states (all states of a channel together).

    Dimensions: C channels, S states, T Zernike terms.

    Attributes
    ----------
    fan : RayFan
        Rays from the pinholes.
    outgoing, back : SystemBatch
        Optical systems from the pinholes to the return face, and from there to the CCDs.
    uploaded : UploadedSystems
        Systems ``back`` on the computing device.
    aim_change : (2, C*S, T) ndarray
        Change of the two aim parameters (ray direction) relative to the nominal instrument, as coefficients of Zernike
        terms on the return face.
    centre : (C, S, 2) ndarray
        Centres of the spots, (row, column) in pixels from the CCD's centre.
    blur : (C, S) ndarray
        Distance of the farthest rays from the spot's centre, extrapolated to the aperture's edge, in pixels.
    aperture : (C, S) ndarray
        Numerical apertures of the beams (largest half width).
    """

    fan: RayFan
    outgoing: SystemBatch
    back: SystemBatch
    uploaded: UploadedSystems
    aim_change: np.ndarray
    centre: np.ndarray
    blur: np.ndarray
    aperture: np.ndarray

    def take(self, states: np.ndarray, backend: Backend) -> CoarseTrace:
        """Return the coarse trace of some of the states, selected by their indices."""
        channels, count = self.centre.shape[:2]
        if np.array_equal(states, np.arange(count)):
            return self
        rows = (np.arange(channels)[:, None] * count + states).ravel()
        fan = RayFan(self.fan.position[rows], self.fan.direction[rows], self.fan.axes[rows])
        outgoing, back = self.outgoing.take(rows), self.back.take(rows)
        spots = (spot[:, states] for spot in (self.centre, self.blur, self.aperture))
        return CoarseTrace(fan, outgoing, back, back.upload(backend), self.aim_change[:, rows], *spots)


@dataclass(frozen=True, eq=False)
class CcdRays:
    """Traced rays where they arrive at the area CCDs, in each CCD's own frame.

    Dimensions: B beams, N nodes of the aperture.

    Attributes
    ----------
    position : (B, N, 3) ndarray
        Positions on the chip, divided by ``size`` so that pixels have the nominal pitch, in metres.
    direction : (B, N, 3) ndarray
        Unit directions.
    path : (B, N) ndarray
        Optical path from the pinhole, in metres.
    valid : (B, N) ndarray of bool
        True for rays that arrive.
    size : (B,) ndarray
        Size of the CCD relative to nominal.
    """

    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray
    valid: np.ndarray
    size: np.ndarray


@dataclass(frozen=True, eq=False)
class SpotFocus:
    """Sharpness of the spots of the unperturbed instrument, channel by channel.

    Dimensions: C channels.

    Attributes
    ----------
    error : (C,) ndarray
        Rms wavefront error of the returned beam about its best plane tilt, in waves.
    defocus : (C,) ndarray
        Displacement of the focal plane along its Z that would give the sharpest spots, in metres.
    """

    error: np.ndarray
    defocus: np.ndarray


MAP_TERMS, ROUGH_TERMS = 15, 66
"""Numbers of Zernike terms (to orders 4 and 10) of the map from the aperture to direction cosines. The first number
leaves a residual below 1e-7 for smooth surfaces; figures of prisms and mirrors with fine structure need the second.
"""

SMOOTH = 1e-6
"""Largest residual of the map from aperture to ray direction that is neglected, relative to the beam's aperture.

It corresponds to an error of 5e-5 in the density of rays.
"""

TOO_ROUGH = 2e-5
"""Residual of the map from aperture to ray direction, relative to the beam's aperture, above which an image is refused.

It is the residual after a fit of all Zernike terms, and corresponds to an error of 1e-3 in the density of rays.
"""

_COARSE_RINGS = 6
"""Number of rings of the quadrature over the aperture for means, exact for polynomials up to degree 23."""

_SCOUT_RINGS = 4
"""Number of rings of the few rays that are aimed first in each state, to predict the launch directions of all others.
"""

AIM_TOLERANCE = 1e-9
"""Largest distance of a ray from the aperture node that it is aimed at, in metres.

It displaces the node by 4e-8 of the aperture's radius, but does not falsify the ray's own path.
"""

_CLOSE_TOLERANCE = 0.01 * AIM_TOLERANCE
"""Aim tolerance, in metres, for the nominal rays, from which the rays of other states are predicted."""


class MonitorBeams:
    """Ray trace of the monitor channels of one instrument.

    A channel is the light of one pinhole: through the camera to the return face and back to an area CCD.

    Parameters
    ----------
    instrument
        Instrument.
    backend
        Backend of the ray trace.
    nodes
        Quadrature over the return face's aperture, the same for all states.
    cameras
        Cameras whose channels are traced; None for all cameras. Values of a channel do not depend on the others.
    """

    def __init__(
        self, instrument: Instrument, backend: Backend, nodes: PupilNodes | None, cameras: Collection[str] | None = None
    ) -> None:
        self.instrument = instrument
        self.backend = backend
        self.cameras = tuple(name for name in instrument.cameras if cameras is None or name in cameras)
        self.channels: tuple[Channel, ...] = tuple(c for c in instrument.channels if c.camera in self.cameras)
        ccd = instrument.spec.autocollimator.area_ccd
        self.shape = (ccd.rows, ccd.columns)
        self.pitch: float = ccd.pitch
        self.wavelength: float = instrument.spec.autocollimator.wavelength
        self.face_radius = np.array([0.5 * channel.aperture for channel in self.channels])
        self._nodes: PupilNodes | None = nodes

    @property
    def nodes(self) -> PupilNodes:
        """Nodes and weights of the quadrature over the return face's aperture."""
        assert self._nodes is not None
        return self._nodes

    @cached_property
    def numerical_aperture(self) -> float:
        """Numerical aperture of the returned beam at the CCD, the largest among the cameras."""
        scales = [np.linalg.svd(m.first_order.scale[0], compute_uv=False) for m in self.instrument.cameras.values()]
        widest = max(channel.aperture for channel in self.instrument.channels)
        return 0.5 * widest / float(np.min(scales))

    def _with(self, nodes: PupilNodes) -> MonitorBeams:
        """Return the beams of the same instrument with other nodes over the aperture."""
        return MonitorBeams(self.instrument, self.backend, nodes, self.cameras)

    @cached_property
    def coarse(self) -> MonitorBeams:
        """Beams of the same instrument with few nodes: enough for means over the aperture of smooth functions."""
        return self._with(quadrature.disk(_COARSE_RINGS))

    @cached_property
    def scout(self) -> MonitorBeams:
        """Beams of the same instrument with the fewest nodes, for the change of a smooth function over the aperture."""
        return self._with(quadrature.disk(_SCOUT_RINGS))

    @cached_property
    def _smooth(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Matrices of a Zernike series at the nodes, for functions over the aperture that are smooth.

        The first gives the coefficients of T Zernike terms from the values at N nodes, (T, N); the others give the
        values and their derivatives with respect to x and y from the coefficients, (N, T) each.
        """
        return self._series(MAP_TERMS)

    @cached_property
    def _rough(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Matrices of a Zernike series at the nodes, for functions over the aperture with fine structure.

        They give, in this order, the Zernike coefficients from the values, and the values, x derivatives and y
        derivatives from the coefficients.
        """
        return self._series(ROUGH_TERMS)

    def _series(self, terms: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the matrices of a Zernike series with a given number of terms.

        The first gives the coefficients from values at the nodes; the others give the values and their derivatives with
        respect to x and y from the coefficients.
        """
        x, y = self.nodes.x, self.nodes.y
        basis = zernike.basis(terms, x, y)
        # the terms are orthonormal over the disk, and the quadrature is exact for their products
        solve = (basis * self.nodes.share[:, None]).T
        dx, dy = (zernike.gradient_basis(terms, x, y, axis) for axis in (0, 1))
        return solve, basis, dx, dy

    def area_ratio(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the local ratio of areas of maps (x, y) -> (u, v) of the unit disk, at N nodes, (..., N).

        It is the determinant of the derivatives of u and v (such as direction cosines) with respect to x and y.

        Raises
        ------
        UncertainImageError
            A map is too rough for the Zernike terms.
        """
        out, residual = _area_ratio(u, v, self._smooth)
        rough = residual > SMOOTH
        if np.any(rough):
            out[rough], residual = _area_ratio(u[rough], v[rough], self._rough)
            largest = float(np.max(residual))
            if largest > TOO_ROUGH:
                raise UncertainImageError(
                    f"figures of mirrors or prisms are too rough for an image: {ROUGH_TERMS} Zernike terms leave "
                    f"{largest:.2g} of the aperture in the ray directions; use smaller figures, or lower orders"
                )
        return out

    def _outgoing(self, placed: PlacedBodies, states: Sequence[State]) -> tuple[RayFan, SystemBatch]:
        """Return the rays launched from each pinhole, and the optical systems from there to the return face."""
        position, direction = [], []
        for channel in self.channels:
            position.append(placed.translation[:, placed.index[channel.reticle_body]])
            direction.append(self.instrument.toward_optics(placed, channel.camera))
        guess = np.concatenate(direction)[:, None]
        axes = transverse_axes(guess, np.broadcast_to([0.0, 1.0, 0.0], guess.shape))
        names = [f"{c.key}/outgoing" for c in self.channels]
        systems = assemble(self.instrument.assembly, names, states, placed=placed)
        return RayFan(np.concatenate(position)[:, None].real, guess, axes), systems

    @cached_property
    def target(self) -> np.ndarray:
        """Points on the return faces that the rays are aimed at, (C, N, 2), in metres of the nominal (unexpanded) face.

        Dimensions: C channels, N nodes of the aperture.
        """
        return self.face_radius[:, None, None] * np.stack([self.nodes.x, self.nodes.y], axis=-1)

    def targets(self, states: int) -> np.ndarray:
        """Return the points that the rays are aimed at, repeated for each state, (C*S, N, 2), channel by channel.

        Dimensions: C channels, S states, N nodes of the aperture.
        """
        return np.repeat(self.target, states, axis=0)

    @cached_property
    def nominal(self) -> AimedRays:
        """Rays of the unperturbed instrument aimed at the nodes, from which all other states start.

        They are aimed first at the centre of the face, then at the nodes around it.
        """
        fan, outgoing = self._outgoing(self.instrument.assembly.place(), [{}])
        middle, slope = aim(self.backend, outgoing, fan, np.zeros((1, 2)), tolerance=_CLOSE_TOLERANCE)
        start = middle + np.einsum("bnij,bpj->bpi", inverse(slope), self.target)
        q, slope = aim(self.backend, outgoing, fan, self.target, start, slope, _CLOSE_TOLERANCE)
        launch, heading = fan.at(q)
        return AimedRays(launch, heading, fan.axes, q, slope)

    def coarse_trace(self, states: Sequence[State], placed: PlacedBodies | None = None) -> CoarseTrace:
        """Trace a few rays to find the spots of S states, and the launch directions that hit the nodes of the face.

        Parameters
        ----------
        states : sequence of State
            S states.
        placed : PlacedBodies | None
            Bodies of the states, if already placed.

        Raises
        ------
        BeamMissedError, AimError
            A perturbation moves a beam off the mirrors or a spot off its CCD; the message names it.
        """
        scout, count = self.scout, len(states)
        placed = self.instrument.assembly.place(states) if placed is None else placed
        fan, outgoing = self._outgoing(placed, states)
        names = [f"{c.key}/monitor" for c in self.channels]
        back = assemble(self.instrument.assembly, names, states, placed=placed)
        nominal = scout.nominal
        start, slope = (np.repeat(a, count, axis=0) for a in (nominal.parameters, nominal.jacobian))
        q, _ = aim(self.backend, outgoing, fan, scout.targets(count), start, slope, _CLOSE_TOLERANCE)
        aim_change = product(np.moveaxis(q - start, -1, 0), scout._smooth[0].T)
        uploaded = back.upload(self.backend)
        traced = trace(self.backend, uploaded, make_rays(self.backend, *fan.at(q)))
        pitch = self.pitch * back.size[:, None]
        position, direction, _, valid = traced.numpy()
        centre = np.einsum("n,bnk->bk", scout.nodes.share, position[..., :2])[:, ::-1] / pitch
        # an aberration of some order grows at least like its third power toward the edge
        rim = np.max(np.hypot(scout.nodes.x, scout.nodes.y)) ** 3
        distance = np.linalg.norm(position[..., 1::-1] / pitch[..., None] - centre[:, None], axis=-1)
        blur = np.max(np.where(valid, distance, 0.0), axis=-1) / rim
        mean_direction = np.einsum("n,bnk->bk", scout.nodes.share, direction[..., :2])
        slope_from_mean = np.linalg.norm(direction[..., :2] - mean_direction[:, None], axis=-1)
        aperture = np.max(np.where(valid, slope_from_mean, 0.0) / np.hypot(scout.nodes.x, scout.nodes.y), axis=-1)
        by_state = (len(self.channels), count)
        spots = centre.reshape(*by_state, 2), blur.reshape(by_state), aperture.reshape(by_state)
        return CoarseTrace(fan, outgoing, back, uploaded, aim_change, *spots)

    @cached_property
    def centre_at_rest(self) -> np.ndarray:
        """Spot centres of the unperturbed instrument from ``coarse_trace``, (C, 1, 2), in pixels.

        Dimensions: C channels.
        """
        return self.coarse_trace([{}]).centre

    def mean_spots(self, states: Sequence[State]) -> np.ndarray:
        """Return the mean position of each spot's rays, (S, C, 2), row and column in px from the first pixel's centre.

        They are the energy centroids of the images. BeamMissedError or AimError is raised if light is lost.

        Dimensions: S states, C channels.
        """
        mean = np.einsum("n,bnk->bk", self.nodes.share, self.rays(states).position[..., 1::-1]) / self.pitch
        middle = 0.5 * (np.array(self.shape) - 1.0)
        return np.asarray(np.swapaxes(mean.reshape(len(self.channels), len(states), 2), 0, 1) + middle)

    def rays(self, states: Sequence[State], coarse: CoarseTrace | None = None) -> CcdRays:
        """Trace rays from the pinholes to the CCDs for C channels in S states, all states of a channel together.

        Parameters
        ----------
        states : sequence of State
            S states.
        coarse : CoarseTrace | None
            Result of ``coarse_trace`` for these states, if known.

        Raises
        ------
        BeamMissedError, AimError
            A perturbation moves a beam off the mirrors or a spot off its CCD; the message names it.
        """
        coarse_result = self.coarse_trace(states) if coarse is None else coarse
        start, slope = (np.repeat(a, len(states), axis=0) for a in (self.nominal.parameters, self.nominal.jacobian))
        q = start + np.moveaxis(product(coarse_result.aim_change, self._smooth[1].T), 0, -1)
        launch = coarse_result.fan.at(q)
        face = len(coarse_result.outgoing.structure) - 1
        traced = trace(self.backend, coarse_result.uploaded, make_rays(self.backend, *launch), keep=(face,))
        goal = self.targets(len(states))
        if not np.max(np.abs(traced.xy(face) - coarse_result.outgoing.size[:, None, None] * goal)) <= AIM_TOLERANCE:
            # the change is not smooth enough for its few terms
            q, _ = aim(self.backend, coarse_result.outgoing, coarse_result.fan, goal, q, slope, AIM_TOLERANCE)
            launch = coarse_result.fan.at(q)
            traced = trace(self.backend, coarse_result.uploaded, make_rays(self.backend, *launch), keep=(face,))
        position, direction, length, valid = traced.numpy()
        rays = CcdRays(
            position / coarse_result.back.size[:, None, None], direction, length, valid, coarse_result.back.size
        )
        for i, channel in enumerate(self.channels):
            rows = slice(i * len(states), (i + 1) * len(states))
            if not np.all(np.any(rays.valid[rows], axis=1)):
                first_lost = int(np.argmin(np.any(rays.valid[rows], axis=1)))
                first = rows.start + first_lost
                where = self._where_lost(channel, states[first_lost], launch[0][first], launch[1][first])
                raise BeamMissedError(f"the whole beam of the monitor channel {channel.key} misses {where}")
            middle = np.einsum("n,snk->sk", self.nodes.share, rays.position[rows, :, 1::-1])
            self._require_on_ccd(channel, middle / self.pitch)
        return rays

    def _where_lost(self, channel: Channel, state: State, position: np.ndarray, direction: np.ndarray) -> str:
        """Return the names of the element and of the body at which the last of a channel's N rays are lost.

        ``position`` and ``direction`` are the launch points and directions of the rays, (N, 3).
        """
        names = self.instrument.assembly.sequences[f"{channel.key}/monitor"]
        steps = surviving_rays(self.backend, self.instrument.assembly, names, position, direction, state)
        count, element = next((i, element) for i, (element, alive) in enumerate(steps, 1) if not alive.any())
        return f"{element.name} on {element.body}, at surface {count} of {len(names)} of its path"

    def fields(self, states: Sequence[State]) -> PupilField:
        """Return the light at the CCDs as one plane wave for each ray, for C channels in S states.

        BeamMissedError or AimError is raised if light is lost.
        """
        return self.field_of(self.rays(states))

    def field_of(self, rays: CcdRays) -> PupilField:
        """Return the light of traced rays at the CCDs as one plane wave for each ray.

        Beams are ordered channel by channel; x and y count from the centre of each CCD.
        """
        direction = rays.direction
        u, v = direction[..., 0], direction[..., 1]
        # sqrt(|d(u, v)/dA| / A) dA of the module docstring of optics.waves.diffraction, with A the face's area
        amplitude = np.sqrt(np.abs(self.area_ratio(u, v)) / np.pi) * self.nodes.weight * rays.valid
        phase = eikonal(rays.size[:, None, None] * rays.position, direction, rays.path, np.zeros(3))
        phase = phase - phase[:, :1]
        return PupilField(u, v, phase, amplitude, self.wavelength).scaled_by(rays.size)

    def _require_on_ccd(self, channel: Channel, position: np.ndarray) -> None:
        """Raise BeamMissedError if the centre of a spot (S, 2), in pixels from the CCD's centre, is outside its CCD.

        Dimensions: S states.
        """
        half = 0.5 * (np.array(self.shape) - 1)
        beyond = np.linalg.norm(np.maximum(np.abs(position) - half, 0.0), axis=-1)
        if np.any(beyond > 0.0):
            worst = int(np.argmax(beyond))
            row, column = position[worst] + half
            raise BeamMissedError(
                f"the spot {channel.key} falls on row {row:.0f}, column {column:.0f}, outside its area CCD of "
                f"{self.shape[0]} x {self.shape[1]} pixels: {beyond[worst]:.3g} px or "
                f"{1e3 * self.pitch * beyond[worst]:.3g} mm beyond its edge"
            )

    @cached_property
    def focus(self) -> SpotFocus:
        """Sharpness of the unperturbed instrument's spots: wavefront error and defocus of each channel.

        Raises
        ------
        BeamMissedError, AimError
            A beam misses the mirrors or a spot its CCD.
        """
        rays, weight = self.coarse.rays([{}]), self.coarse.nodes.weight
        paths = eikonal(rays.position, rays.direction, rays.path, np.zeros(3))
        error, defocus = np.empty(len(paths)), np.empty(len(paths))
        for i, (direction, path) in enumerate(zip(rays.direction, paths, strict=True)):
            root = np.sqrt(weight * rays.valid[i])
            # light to a point (x, y, z) of the CCD's frame has an eikonal of -(u x + v y + w z) plus a constant
            basis = np.column_stack([np.ones_like(path), direction - direction[0]]) * root[:, None]
            scale = np.linalg.norm(basis, axis=0)
            flat, point = (
                np.linalg.lstsq(basis[:, :n] / scale[:n], path * root, rcond=None)[0] / scale[:n] for n in (3, 4)
            )
            error[i] = np.linalg.norm(path * root - basis[:, :3] @ flat) / np.linalg.norm(root)
            # the CCD's z is the plane's -Z; the pinhole moves with the CCD, its image in the opposite direction
            defocus[i] = 0.5 * point[3]
        return SpotFocus(error / self.wavelength, defocus)

    def grid(self, axis: int, margin: int = 0) -> Grid:
        """Return the pixel centres of the rows (axis 0) or columns (axis 1), in nominal metres from the CCD's centre.

        ``margin`` adds that many pixels on both sides.
        """
        n = self.shape[axis]
        return Grid(-(0.5 * (n - 1) + margin) * self.pitch, self.pitch, n + 2 * margin)

    def axis(self, axis: int) -> np.ndarray:
        """Return the coordinates of all rows (axis 0) or columns (axis 1), in metres from the CCD's centre."""
        return self.grid(axis).points()


def _area_ratio(
    u: np.ndarray, v: np.ndarray, series: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the local area ratio of maps (x, y) -> (u, v), (..., N), and the fits' relative residual, (...).

    The ratio is the determinant of the derivatives of u and v with respect to x and y, from a Zernike series fitted to
    the values at N nodes of the aperture.
    """
    solve, basis, dx, dy = series
    a, b = product(u, solve.T), product(v, solve.T)
    ratio = product(a, dx.T) * product(b, dy.T) - product(a, dy.T) * product(b, dx.T)
    residual = np.maximum(np.abs(u - product(a, basis.T)), np.abs(v - product(b, basis.T))).max(axis=-1)
    return ratio, residual / np.hypot(u - a[..., :1], v - b[..., :1]).max(axis=-1)
