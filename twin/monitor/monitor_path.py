"""Optical path of the monitor: from each pinhole through the camera to the return face and back to the area CCD.

The matrix Fourier transform of a traced beam gives its image on the CCD's own pixels (``optics.waves.diffraction``);
the pinhole is an incoherent disk imaged at unit magnification. Every image uses as many rays as it needs and is
checked (``monitor_beams``).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from optics.geometry.tree import PlacedBodies, State
from optics.numerics.backend import Backend, one_blas_thread
from optics.numerics.quadrature import PupilNodes
from optics.raytrace.system import changed_bodies
from optics.waves.diffraction import PixelResponse, UnsampledImageError, image
from scenes.models.instrument_model import Instrument
from scenes.specs.instrument import BASE, Channel
from twin.monitor import monitor_beams

_MOST_RAYS = 400_000
"""Largest number of rays traced at once, to limit memory: blurred spots need many."""

WIDEST = 1.1
"""Largest ratio of a beam's aperture to that of a pixel filter for which the filter is accurate (3e-6 of the peak).

Filters are computed for apertures in this ratio to one another.
"""


class MonitorPath(monitor_beams.MonitorBeams):
    """Ray trace and images of the monitor channels of one instrument.

    A channel is the light of one pinhole: through the camera to the return face and back to an area CCD.

    Parameters
    ----------
    instrument
        Instrument.
    backend
        Backend of the ray trace.
    nodes
        Pupil quadrature for all states, used without a check of its accuracy. By default a quadrature that is accurate
        to 1e-6 of the peak for the unperturbed instrument's spots anywhere in the last of ``SPOT_RANGES`` of the CCD,
        out to the far corner; images take the nodes of ``class_beams``.
    cameras
        Cameras whose channels are traced; None for all cameras. Values of a channel do not depend on the others.

    Attributes
    ----------
    checked
        Checks of all images so far.
    """

    def __init__(
        self,
        instrument: Instrument,
        backend: Backend,
        nodes: PupilNodes | None = None,
        cameras: Collection[str] | None = None,
    ) -> None:
        super().__init__(instrument, backend, nodes, cameras)
        self._sized = nodes is None
        self.checked = monitor_beams.ImageChecks()
        self._class_beams: dict[int, monitor_beams.MonitorBeams] = {}
        self._second: dict[int, monitor_beams.MonitorBeams] = {}
        self._responses: dict[int, PixelResponse] = {}
        self._parts: dict[tuple[str, ...], MonitorPath] = {}
        self._rested: dict[bool, tuple[np.ndarray, int]] = {}

    @cached_property
    def node_classes(self) -> monitor_beams.NodeClasses:
        """Series of ever finer pupil quadratures (classes of nodes) that the images of this instrument use."""
        phase = 2.0 * np.pi * self.numerical_aperture * self.pitch / self.wavelength
        return monitor_beams.NodeClasses(phase, (0.5 * self.shape[0], 0.5 * self.shape[1]))

    @property
    def nodes(self) -> PupilNodes:
        """Pupil quadrature for the unperturbed instrument's spots, anywhere on their CCDs.

        Raises
        ------
        BeamMissedError, AimError
            A beam misses the mirrors or a spot its CCD.
        UncertainImageError
            No quadrature is sufficient.
        """
        if self._nodes is None:
            self._nodes = self.node_classes.nodes(self._image_class)
        return self._nodes

    @cached_property
    def _image_class(self) -> int:
        """Index of the class of pupil nodes (see ``NodeClasses``) that the unperturbed instrument needs."""
        coarse = self.coarse_trace([{}])
        far = np.broadcast_to(
            (1.0 - 1e-9) * monitor_beams.SPOT_RANGES[-1] * 0.5 * np.array(self.shape), coarse.centre.shape
        )
        number = int(self.node_classes.class_of(far, 0, coarse.blur, coarse.aperture / self.numerical_aperture)[0])
        return self._require_class(number, coarse, 0)

    def class_beams(self, number: int) -> monitor_beams.MonitorBeams:
        """Return the monitor's beams traced at the pupil nodes of the class with index ``number``."""
        if not self._sized or number == self._image_class:
            return self
        if number not in self._class_beams:
            self._class_beams[number] = self._with(self.node_classes.nodes(number))
        return self._class_beams[number]

    def class_of(self, coarse: monitor_beams.CoarseTrace, margin: int = 0) -> np.ndarray:
        """Return the class of nodes that suffices for all spots of each of S states, (S,), estimated from a few rays.

        A class is one of the pupil quadratures in ``NodeClasses``.

        Parameters
        ----------
        coarse : CoarseTrace
            Coarse trace of the states.
        margin : int
            Extra pixels rendered on every side of the CCD.
        """
        if not self._sized:
            return np.zeros(coarse.centre.shape[1], np.intp)
        widening = coarse.aperture / self.numerical_aperture
        # a lost beam has no position; its full trace reports where it is lost
        position = np.where(coarse.aperture[..., None] > 0.0, coarse.centre, 0.0)
        return self.node_classes.class_of(position, margin, coarse.blur, widening)

    def _require_class(self, number: int, coarse: monitor_beams.CoarseTrace, state: int) -> int:
        """Return the number of a class of pupil nodes (a pupil quadrature) if it exists.

        UncertainImageError is raised for a spot that is blurred too much for the finest class.
        """
        if number >= len(self.node_classes.reached):
            worst = int(np.argmax(coarse.blur[:, state]))
            raise monitor_beams.UncertainImageError(
                f"the spot {self.channels[worst].key} is too blurred for its image to be computed: its rays "
                f"spread over {2.0 * coarse.blur[worst, state]:.3g} px or "
                f"{2e3 * self.pitch * coarse.blur[worst, state]:.3g} mm; refocus the camera, or make its aberrations "
                "smaller"
            )
        return number

    @property
    def response(self) -> PixelResponse:
        """Combined response of a pixel and the pinhole's image, for the unperturbed instrument.

        A pinhole is assumed to expand with the CCD beside it.

        Raises
        ------
        UnsampledImageError
            The pixels are too coarse, or the pinhole is too wide for them.
        """
        return self._response(0)

    def _response(self, wider: int) -> PixelResponse:
        """Return the response of pixel and pinhole for a beam aperture wider by ``WIDEST`` to the power ``wider``."""
        if wider not in self._responses:
            pinhole = self.instrument.spec.autocollimator.reticle.pinhole
            cutoff = 2.0 * self.numerical_aperture * WIDEST**wider / self.wavelength
            self._responses[wider] = PixelResponse.fit(self.pitch, pinhole, cutoff)
        return self._responses[wider]

    def _response_of(self, coarse: monitor_beams.CoarseTrace) -> PixelResponse:
        """Return the response of pixel and pinhole for the images of some states.

        Raises
        ------
        UncertainImageError
            The images are too fine for the pixels.
        """
        widening = max(float(np.max(coarse.aperture)) / self.numerical_aperture, 1.0)
        try:
            return self._response(max(0, int(np.ceil(np.log(widening) / np.log(WIDEST))) - 1))
        except UnsampledImageError as error:
            problem = f"beams have {widening:.3g} times the designed aperture: {error}"
            raise monitor_beams.UncertainImageError(f"{problem}; allowed: {error.remedy}") from error

    def expected_photons(
        self, states: Sequence[State], margin: int = 0, chunk: int = 32, single: bool = True
    ) -> np.ndarray:
        """Return the expected photons per pixel and frame of all area CCDs in S states.

        Dimensions: C channels.

        Parameters
        ----------
        states : sequence of State
            S states.
        margin : int
            Extra pixels rendered on every side of the CCD.
        chunk : int
            Number of states rendered at once, to limit memory.
        single : bool
            True to compute the images in single precision.

        Returns
        -------
        (S, C, rows + 2 margin, columns + 2 margin) ndarray
            Expected photons.
        """
        out = np.empty((len(states), len(self.channels), self.shape[0] + 2 * margin, self.shape[1] + 2 * margin))
        for piece, photons in self.iterate_photons(states, margin, chunk, single):
            out[piece] = photons
        return out

    def iterate_photons(
        self, states: Sequence[State], margin: int = 0, chunk: int = 32, single: bool = True
    ) -> Iterator[tuple[slice, np.ndarray]]:
        """Yield (slice of the states, expected photons) for a few states at a time, as in ``expected_photons``."""
        for start in range(0, len(states), chunk):
            chunk_states = states[start : start + chunk]
            with one_blas_thread():
                photons, _ = self._render(chunk_states, margin, single)
            yield slice(start, start + len(chunk_states)), photons

    def photons_of(self, state: State, placed: PlacedBodies | None = None, single: bool = False) -> np.ndarray:
        """Return the expected photons per pixel and frame of one state, (C, rows, columns) for C channels.

        They equal those of ``expected_photons`` to the last bit; channels of cameras without moved bodies are rendered
        only once.

        Parameters
        ----------
        state : State
            State to render.
        placed : PlacedBodies | None
            Bodies of the state, if already placed.
        single : bool
            True to compute the images in single precision.

        Raises
        ------
        BeamMissedError, AimError
            A perturbation moves a beam off the mirrors or a spot off its CCD.
        """
        with one_blas_thread():
            placed = self.instrument.assembly.place([state]) if placed is None else placed
            moved = self.moved_cameras(state, placed)
            if not moved:
                return self._at_rest(single)[0].copy()
            if len(moved) < len(self.cameras):
                part = self._of_cameras(moved)
                coarse = part.coarse_trace([state], placed)
                photons, rest_class = self._at_rest(single)
                # spots that are far off or blurred need more nodes, which all channels then use
                if part.class_of(coarse)[0] <= rest_class:
                    part_photons, number = part._render([state], 0, single, coarse)
                    if number[0] == rest_class:
                        out = photons.copy()
                        out[[c.camera in moved for c in self.channels]] = part_photons[0]
                        return out
            return self._render([state], 0, single, self.coarse_trace([state], placed))[0][0]

    def moved_cameras(self, state: State, placed: PlacedBodies | None = None) -> tuple[str, ...]:
        """Return the cameras whose channels' light is affected by a moved or changed body.

        Parameters
        ----------
        state : State
            State of the instrument.
        placed : PlacedBodies | None
            Bodies of the state, if already placed.
        """
        assembly = self.instrument.assembly
        touched = changed_bodies(assembly, [state], assembly.place([state]) if placed is None else placed)
        return tuple(name for name in self.cameras if not touched.isdisjoint(self._bodies[name]))

    @cached_property
    def _bodies(self) -> dict[str, set[str]]:
        """Camera -> bodies that the light of its channels hits or passes."""
        assembly = self.instrument.assembly
        out: dict[str, set[str]] = {name: set() for name in self.cameras}
        for channel in self.channels:
            bodies = out[channel.camera]
            bodies |= {channel.reticle_body, f"{BASE}/{channel.camera}/focal_plane"}
            for sequence in ("outgoing", "monitor"):
                for element in assembly.sequence(f"{channel.key}/{sequence}"):
                    bodies.add(element.body)
                    if element.solid is not None:
                        bodies.add(element.solid)
        return out

    def _of_cameras(self, names: tuple[str, ...]) -> MonitorPath:
        """Return the optical path restricted to the channels of the named cameras."""
        if names not in self._parts:
            self._parts[names] = MonitorPath(self.instrument, self.backend, None if self._sized else self.nodes, names)
            self._parts[names].checked = self.checked
        return self._parts[names]

    def _at_rest(self, single: bool) -> tuple[np.ndarray, int]:
        """Return the unperturbed instrument's photons, (C, rows, columns) for C channels, and its class of nodes.

        The class is the index of the quadrature (``NodeClasses``) that the images need.
        """
        if single not in self._rested:
            photons, number = self._render([{}], 0, single)
            self._rested[single] = photons[0], int(number[0])
        return self._rested[single]

    def _render(
        self, states: Sequence[State], margin: int, single: bool, coarse: monitor_beams.CoarseTrace | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the expected photons of states, and the class of pupil nodes with which each was computed.

        Returns
        -------
        tuple of ndarray
            Photons (S, C, rows + 2 margin, columns + 2 margin) for S states and C channels, and classes (S,).

        Raises
        ------
        UncertainImageError
            An image cannot be computed accurately with any nodes.
        """
        coarse = self.coarse_trace(states) if coarse is None else coarse
        for channel, centre, aperture in zip(self.channels, coarse.centre, coarse.aperture, strict=True):
            self._require_on_ccd(channel, centre[aperture > 0.0])
        chosen = self.class_of(coarse, margin)
        out = np.empty((len(states), len(self.channels), *(n + 2 * margin for n in self.shape)))
        number, last = 0, len(self.node_classes.reached) - 1
        while number <= np.max(chosen):
            indices = np.flatnonzero(chosen == number)
            rays = self.class_beams(min(number, last)).nodes.count * len(self.channels)
            for piece in np.array_split(indices, -(-len(indices) * rays // _MOST_RAYS) or 1):
                if len(piece):
                    self._require_class(number, coarse, int(piece[0]))
                    part = coarse.take(piece, self.backend)
                    part_states = [states[s] for s in piece.tolist()]
                    # some states are repeated with more nodes
                    out[piece], chosen[piece] = self._images(part_states, part, number, margin, single)
            number += 1
        return out, chosen

    def _images(
        self, states: Sequence[State], coarse: monitor_beams.CoarseTrace, number: int, margin: int, single: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the photons of states, computed with nodes of one class, and the class that each state needs.

        States for which two quadratures over the pupil disagree need a larger class. A beam that is partly cut off
        (vignetted) gets the last class: each quadrature has its own error at the beam's edge, and two may agree by
        chance.

        Returns
        -------
        tuple of ndarray
            Photons (S, C, rows, columns) for S states and C channels, and classes (S,).

        Raises
        ------
        UncertainImageError
            An image is inaccurate even with the most nodes, or its light does not equal that of its rays.
        """
        beams, response = self.class_beams(number), self._response_of(coarse)
        y, x = (self.grid(axis, margin + response.half_width) for axis in (0, 1))
        rays = beams.rays(states, coarse)
        waves = image(beams.field_of(rays), x, y, single)
        wanted, last = np.full(len(states), number), len(self.node_classes.reached) - 1
        difference = np.zeros((len(self.channels), len(states)))
        if self._sized:
            if number not in self._second:
                self._second[number] = self._with(self.node_classes.second_nodes(number))
            second = self._second[number]
            difference = monitor_beams.quadrature_difference(waves, second.field_of(second.rays(states, coarse)), x, y)
            difference = difference.reshape(-1, len(states))
            if number + 2 <= last:
                wanted[np.any(difference > monitor_beams.GOOD, axis=0)] += 2
            wanted[~np.all(rays.valid.reshape(len(self.channels), len(states), -1), axis=(0, 2))] = last
            self._require_accurate(np.where(wanted == number, difference, 0.0), rays)
        photons = response.apply(waves)
        if self._sized:
            light = self._require_energy(photons, rays, beams.nodes.share, margin, wanted > number)
            self.checked.add(difference[:, wanted == number].ravel(), light)
        photons = photons.reshape(len(self.channels), len(states), *photons.shape[1:])
        photons *= self.light_per_pixel[:, None, None, None]
        return np.swapaxes(photons, 0, 1), wanted

    def _require_accurate(self, difference: np.ndarray, rays: monitor_beams.CcdRays) -> None:
        """Raise UncertainImageError if two quadratures over the pupil give images that differ too much.

        ``difference`` is relative to the images' peaks, (C, S).

        Dimensions: C channels, S states.
        """
        channel, state = np.unravel_index(np.argmax(difference), difference.shape)
        if difference[channel, state] > monitor_beams.WRONG:
            lost = 1.0 - float(np.mean(rays.valid[channel * difference.shape[1] + state]))
            why = (
                f"an aperture stops {100.0 * lost:.2g} % of its rays; widen it, or move the beam to its centre"
                if lost
                else "its wavefront is too rough for the nodes; make figures and deformations smoother, or motions "
                "smaller"
            )
            raise monitor_beams.UncertainImageError(
                f"the image of the spot {self.channels[channel].key} is uncertain by "
                f"{100.0 * difference[channel, state]:.2g} % of its peak: {why}"
            )

    def _require_energy(
        self, images: np.ndarray, rays: monitor_beams.CcdRays, share: np.ndarray, margin: int, known_bad: np.ndarray
    ) -> np.ndarray:
        """Raise UncertainImageError if the light of an image does not equal that of the rays that fall on it.

        Parameters
        ----------
        images : (C * S, R, K) ndarray
            Images of R rows and K columns for C channels x S states (all states of a channel together).
        rays : CcdRays
            Traced rays of these images.
        share : ndarray
            Fraction of the channel's light that each ray carries.
        margin : int
            Extra pixels rendered on every side of the CCD.
        known_bad : ndarray of bool
            True for images that are already known to be inaccurate; they are not checked.

        Returns
        -------
        (C * S,) ndarray
            Light beyond the allowed range, as a fraction of the channel's light.
        """
        half = 0.5 * np.array(self.shape) + margin
        wings = np.full(
            len(images), monitor_beams.WINGS * self.wavelength / (2.0 * np.pi * self.numerical_aperture * self.pitch)
        )
        light = np.sum(images, axis=(-2, -1)) * self.pitch**2
        excess = monitor_beams.energy_excess(
            light, rays.position[..., 1::-1] / self.pitch, share * rays.valid, half, wings
        )
        excess = np.where(np.tile(known_bad, len(self.channels)), 0.0, excess)
        worst = int(np.argmax(np.abs(excess)))
        if excess[worst]:
            channel = self.channels[worst // len(known_bad)]
            raise monitor_beams.UncertainImageError(
                f"the image of the spot {channel.key} has {100.0 * abs(excess[worst]):.2g} % of its light too "
                f"{'much' if excess[worst] > 0.0 else 'little'} for its rays, beyond the limit of diffraction; its "
                "beam is folded or distorted: refocus the camera, or make its aberrations smaller"
            )
        return excess

    @property
    def light_per_pixel(self) -> np.ndarray:
        """Factor from an image of unit power (1/m^2) to photons per pixel and frame, (C,) for C channels, in m^2.

        It is the channel's photons per frame times the pixel's area.
        """
        return np.array([channel.photons * self.pitch**2 for channel in self.channels])


class _OnSpots(monitor_beams.MonitorBeams):
    """Monitor beams whose positions on the CCD are measured from the centre of their own spot."""

    def _with(self, nodes: PupilNodes) -> monitor_beams.MonitorBeams:
        return _OnSpots(self.instrument, self.backend, nodes, self.cameras)

    def _require_on_ccd(self, channel: Channel, position: np.ndarray) -> None:
        """Do nothing, since every CCD is centred on its spot."""

    def rays(self, states: Sequence[State], coarse: monitor_beams.CoarseTrace | None = None) -> monitor_beams.CcdRays:
        rays = super().rays(states, coarse)
        share = self.nodes.share * rays.valid
        middle = np.einsum("bn,bnk->bk", share / np.sum(share, axis=1, keepdims=True), rays.position)
        return replace(rays, position=rays.position - middle[:, None] * [1.0, 1.0, 0.0])


class SpotPath(_OnSpots, MonitorPath):
    """Optical path of a monitor whose area CCDs were centred on their spots when the instrument was built.

    It is used for instruments that are not built as designed, whose spots are not at their nominal positions.
    """

    def class_of(self, coarse: monitor_beams.CoarseTrace, margin: int = 0) -> np.ndarray:
        """Return the class of pupil nodes that suffices for all spots of each of S states, (S,), with centred spots."""
        return super().class_of(replace(coarse, centre=np.zeros_like(coarse.centre)), margin)
