"""The monitor's light: from every pinhole through the camera to the return face and back onto the pixels of the area
CCD.

The matrix Fourier transform of a traced beam gives its image on the CCD's own pixels (``optics.waves.diffraction``);
the pinhole is an incoherent disk imaged at unit scale. Every image is made with as many rays as it needs, and checked
(``image_sampling``).
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
from twin.monitor.image_sampling import (
    GOOD,
    SPOT_RANGES,
    WINGS,
    WRONG,
    ImageChecks,
    NodeClasses,
    UncertainImageError,
    disagreement,
    lost_or_gained,
)
from twin.monitor.monitor_beams import CcdRays, CoarseTrace, MonitorBeams

_MOST_RAYS = 400_000
"""Traced at once, to bound memory: blurred spots need many."""

WIDEST = 1.1
"""Growth of the beams' aperture that the filter of the pixels still follows (to 3e-6 of the peak), and step to the next
one."""


class MonitorPath(MonitorBeams):
    """Traces and images the monitor channels of one instrument.

    Parameters
    ----------
    instrument
        The instrument.
    backend
        Where to trace.
    nodes
        Pupil quadrature, then used for all states and not checked; by default one that is right to 1e-6 of the peak for
        the unperturbed instrument's spots anywhere in the last of ``SPOT_RANGES`` of the CCD, out to the far corner,
        and for images those of ``class_beams``.
    cameras
        Whose channels; None for all. Numbers of a channel do not depend on which others there are.

    Attributes
    ----------
    checked
        What the checks of all images found that it has given.
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
        self.checked = ImageChecks()
        self._class_beams: dict[int, MonitorBeams] = {}
        self._second: dict[int, MonitorBeams] = {}
        self._responses: dict[int, PixelResponse] = {}
        self._parts: dict[tuple[str, ...], MonitorPath] = {}
        self._rested: dict[bool, tuple[np.ndarray, int]] = {}

    @cached_property
    def node_classes(self) -> NodeClasses:
        """Classes of pupil nodes for this instrument's images."""
        phase = 2.0 * np.pi * self.numerical_aperture * self.pitch / self.wavelength
        return NodeClasses(phase, (0.5 * self.shape[0], 0.5 * self.shape[1]))

    @property
    def nodes(self) -> PupilNodes:
        """Pupil quadrature of the unperturbed instrument's spots, wherever on their CCDs.

        Raises
        ------
        BeamMissedError, AimError
            As ``rays``; UncertainImageError: no quadrature would do.
        """
        if self._nodes is None:
            self._nodes = self.node_classes.nodes(self._own_class)
        return self._nodes

    @cached_property
    def _own_class(self) -> int:
        known = self.coarse_trace([{}])
        far = np.broadcast_to((1.0 - 1e-9) * SPOT_RANGES[-1] * 0.5 * np.array(self.shape), known.place.shape)
        number = int(self.node_classes.class_of(far, 0, known.blur, known.aperture / self.numerical_aperture)[0])
        return self._require_class(number, known, 0)

    def class_beams(self, number: int) -> MonitorBeams:
        """Beams with as many nodes as a class of spots needs."""
        if not self._sized or number == self._own_class:
            return self
        if number not in self._class_beams:
            self._class_beams[number] = self._with(self.node_classes.nodes(number))
        return self._class_beams[number]

    def class_of(self, known: CoarseTrace, margin: int = 0) -> np.ndarray:
        """Number of the class of nodes that is right for all spots of each state, (S,), as far as a few rays can tell.

        Parameters
        ----------
        known : CoarseTrace
            Of the states.
        margin : int
            Extra pixels rendered on every side of the CCD.
        """
        if not self._sized:
            return np.zeros(known.place.shape[1], np.intp)
        widening = known.aperture / self.numerical_aperture
        # a beam that is lost stands nowhere; its full trace says where it is lost
        place = np.where(known.aperture[..., None] > 0.0, known.place, 0.0)
        return self.node_classes.class_of(place, margin, known.blur, widening)

    def _require_class(self, number: int, known: CoarseTrace, state: int) -> int:
        """The number of a class, if there is one. Raises UncertainImageError for a spot that is blurred too much."""
        if number >= len(self.node_classes.reached):
            worst = int(np.argmax(known.blur[:, state]))
            raise UncertainImageError(
                f"the spot {self.channels[worst].key} is blurred so much that its image is not worked out: its rays "
                f"spread over {2.0 * known.blur[worst, state]:.3g} px or "
                f"{2e3 * self.pitch * known.blur[worst, state]:.3g} mm; refocus the camera, or make its aberrations "
                "smaller"
            )
        return number

    @property
    def response(self) -> PixelResponse:
        """What pixel and pinhole do to the unperturbed instrument's images; a pinhole is taken to grow with the CCD
        beside it.

        Raises
        ------
        UnsampledImageError
            The pixels are too coarse or the pinhole is too wide for them.
        """
        return self._response(0)

    def _response(self, wider: int) -> PixelResponse:
        """Likewise for beams wider by some steps of ``WIDEST``."""
        if wider not in self._responses:
            pinhole = self.instrument.spec.autocollimator.reticle.pinhole
            cutoff = 2.0 * self.numerical_aperture * WIDEST**wider / self.wavelength
            self._responses[wider] = PixelResponse.fit(self.pitch, pinhole, cutoff)
        return self._responses[wider]

    def _response_of(self, known: CoarseTrace) -> PixelResponse:
        """What pixel and pinhole do to the images of some states.

        Raises
        ------
        UncertainImageError
            They are too fine for the pixels.
        """
        widening = max(float(np.max(known.aperture)) / self.numerical_aperture, 1.0)
        try:
            return self._response(max(0, int(np.ceil(np.log(widening) / np.log(WIDEST))) - 1))
        except UnsampledImageError as error:
            problem = f"beams have {widening:.3g} times the aperture as designed: {error}"
            raise UncertainImageError(f"{problem}; {error.remedy} would do") from error

    def expected_photons(
        self, states: Sequence[State], margin: int = 0, chunk: int = 32, single: bool = True
    ) -> np.ndarray:
        """Expected photons per pixel and frame.

        Parameters
        ----------
        states : Sequence[State]
            S states.
        margin : int
            Extra pixels rendered on every side of the CCD.
        chunk : int
            States done at once, to bound memory.
        single : bool
            In single precision, see ``optics.waves.diffraction.image``.

        Returns
        -------
        np.ndarray
            (S, C, rows + 2 margin, columns + 2 margin).
        """
        out = np.empty((len(states), len(self.channels), self.shape[0] + 2 * margin, self.shape[1] + 2 * margin))
        for piece, photons in self.iterate_photons(states, margin, chunk, single):
            out[piece] = photons
        return out

    def iterate_photons(
        self, states: Sequence[State], margin: int = 0, chunk: int = 32, single: bool = True
    ) -> Iterator[tuple[slice, np.ndarray]]:
        """Like ``expected_photons``, piece by piece: yields (slice of the states, photons)."""
        for start in range(0, len(states), chunk):
            some = states[start : start + chunk]
            with one_blas_thread():
                photons, _ = self._render(some, margin, single)
            yield slice(start, start + len(some)), photons

    def photons_of(self, state: State, placed: PlacedBodies | None = None, single: bool = False) -> np.ndarray:
        """Expected photons per pixel and frame of one state, (C, rows, columns).

        The same as ``expected_photons``, to the bit; channels of cameras whose bodies all stay are rendered once.

        Parameters
        ----------
        state : State
            The state.
        placed : PlacedBodies | None
            Its bodies, when already placed.
        single : bool
            In single precision, see ``optics.waves.diffraction.image``.

        Raises
        ------
        BeamMissedError, AimError
            As ``rays``.
        """
        with one_blas_thread():
            placed = self.instrument.assembly.place([state]) if placed is None else placed
            moved = self.moved_cameras(state, placed)
            if not moved:
                return self._at_rest(single)[0].copy()
            if len(moved) < len(self.cameras):
                part = self._of_cameras(moved)
                coarse = part.coarse_trace([state], placed)
                photons, usual = self._at_rest(single)
                # spots far off or blurred need more nodes, and then all channels get them
                if part.class_of(coarse)[0] <= usual:
                    own, number = part._render([state], 0, single, coarse)
                    if number[0] == usual:
                        out = photons.copy()
                        out[[c.camera in moved for c in self.channels]] = own[0]
                        return out
            return self._render([state], 0, single, self.coarse_trace([state], placed))[0][0]

    def moved_cameras(self, state: State, placed: PlacedBodies | None = None) -> tuple[str, ...]:
        """Cameras of whose channels' light some body is moved or otherwise changed.

        Parameters
        ----------
        state : State
            The state.
        placed : PlacedBodies | None
            Its bodies, when already placed.
        """
        assembly = self.instrument.assembly
        touched = changed_bodies(assembly, [state], assembly.place([state]) if placed is None else placed)
        return tuple(name for name in self.cameras if not touched.isdisjoint(self._bodies[name]))

    @cached_property
    def _bodies(self) -> dict[str, set[str]]:
        """Camera -> bodies that the light of its channels meets or passes."""
        assembly = self.instrument.assembly
        out: dict[str, set[str]] = {name: set() for name in self.cameras}
        for channel in self.channels:
            own = out[channel.camera]
            own |= {channel.reticle_body, f"{BASE}/{channel.camera}/focal_plane"}
            for way in ("outgoing", "monitor"):
                for element in assembly.sequence(f"{channel.key}/{way}"):
                    own.add(element.body)
                    if element.solid is not None:
                        own.add(element.solid)
        return out

    def _of_cameras(self, names: tuple[str, ...]) -> MonitorPath:
        """The path of these cameras alone."""
        if names not in self._parts:
            self._parts[names] = MonitorPath(self.instrument, self.backend, None if self._sized else self.nodes, names)
            self._parts[names].checked = self.checked
        return self._parts[names]

    def _at_rest(self, single: bool) -> tuple[np.ndarray, int]:
        """Photons of the unperturbed instrument (C, rows, columns), and the number of their class."""
        if single not in self._rested:
            photons, number = self._render([{}], 0, single)
            self._rested[single] = photons[0], int(number[0])
        return self._rested[single]

    def _render(
        self, states: Sequence[State], margin: int, single: bool, coarse: CoarseTrace | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Expected photons (S, C, rows + 2 margin, columns + 2 margin), each state with the nodes of its class, and
        these classes, (S,).

        Raises
        ------
        UncertainImageError
            An image is not right whatever the nodes.
        """
        coarse = self.coarse_trace(states) if coarse is None else coarse
        for channel, place, aperture in zip(self.channels, coarse.place, coarse.aperture, strict=True):
            self._require_on_ccd(channel, place[aperture > 0.0])
        chosen = self.class_of(coarse, margin)
        out = np.empty((len(states), len(self.channels), *(n + 2 * margin for n in self.shape)))
        number, last = 0, len(self.node_classes.reached) - 1
        while number <= np.max(chosen):
            own = np.flatnonzero(chosen == number)
            rays = self.class_beams(min(number, last)).nodes.count * len(self.channels)
            for piece in np.array_split(own, -(-len(own) * rays // _MOST_RAYS) or 1):
                if len(piece):
                    self._require_class(number, coarse, int(piece[0]))
                    known = coarse.take(piece, self.backend)
                    some = [states[s] for s in piece.tolist()]
                    # some are made again with more nodes
                    out[piece], chosen[piece] = self._images(some, known, number, margin, single)
            number += 1
        return out, chosen

    def _images(
        self, states: Sequence[State], known: CoarseTrace, number: int, margin: int, single: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Expected photons of states with the nodes of a class, (S, C, ...), and the class that each asks for, (S,).

        A larger class where two rules disagree. The last one for a beam that is cut: at its edge each rule has an
        error of its own, and two may agree by chance.

        Raises
        ------
        UncertainImageError
            An image is not right with the most nodes, or its light is not that of its rays.
        """
        beams, response = self.class_beams(number), self._response_of(known)
        y, x = (self.grid(axis, margin + response.reach) for axis in (0, 1))
        rays = beams.rays(states, known)
        waves = image(beams.field_of(rays), x, y, single)
        wanted, last = np.full(len(states), number), len(self.node_classes.reached) - 1
        difference = np.zeros((len(self.channels), len(states)))
        if self._sized:
            if number not in self._second:
                self._second[number] = self._with(self.node_classes.second_nodes(number))
            second = self._second[number]
            difference = disagreement(waves, second.field_of(second.rays(states, known)), x, y)
            difference = difference.reshape(-1, len(states))
            if number + 2 <= last:
                wanted[np.any(difference > GOOD, axis=0)] += 2
            wanted[~np.all(rays.valid.reshape(len(self.channels), len(states), -1), axis=(0, 2))] = last
            self._require_alike(np.where(wanted == number, difference, 0.0), rays)
        photons = response.apply(waves)
        if self._sized:
            light = self._require_energy(photons, rays, beams.nodes.share, margin, wanted > number)
            self.checked.add(difference[:, wanted == number].ravel(), light)
        photons = photons.reshape(len(self.channels), len(states), *photons.shape[1:])
        photons *= self.light_per_pixel[:, None, None, None]
        return np.swapaxes(photons, 0, 1), wanted

    def _require_alike(self, difference: np.ndarray, rays: CcdRays) -> None:
        """Raise UncertainImageError where two rules differ too much (C, S), of the peaks."""
        channel, state = np.unravel_index(np.argmax(difference), difference.shape)
        if difference[channel, state] > WRONG:
            lost = 1.0 - float(np.mean(rays.valid[channel * difference.shape[1] + state]))
            why = (
                f"an aperture stops {100.0 * lost:.2g} % of its rays; widen it, or move the beam to its middle"
                if lost
                else "its wavefront is too rough for smooth nodes; make figures and deformations smoother, or motions "
                "smaller"
            )
            raise UncertainImageError(
                f"the image of the spot {self.channels[channel].key} is uncertain by "
                f"{100.0 * difference[channel, state]:.2g} % of its peak: {why}"
            )

    def _require_energy(
        self, images: np.ndarray, rays: CcdRays, share: np.ndarray, margin: int, known_bad: np.ndarray
    ) -> np.ndarray:
        """Raise UncertainImageError where the light of images (C*S, R, C) is not that of their rays; by how much it is
        beyond what is allowed, (C*S,).
        """
        half = 0.5 * np.array(self.shape) + margin
        wings = np.full(len(images), WINGS * self.wavelength / (2.0 * np.pi * self.numerical_aperture * self.pitch))
        light = np.sum(images, axis=(-2, -1)) * self.pitch**2
        off = lost_or_gained(light, rays.position[..., 1::-1] / self.pitch, share * rays.valid, half, wings)
        off = np.where(np.tile(known_bad, len(self.channels)), 0.0, off)
        worst = int(np.argmax(np.abs(off)))
        if off[worst]:
            channel = self.channels[worst // len(known_bad)]
            raise UncertainImageError(
                f"the image of the spot {channel.key} has {100.0 * abs(off[worst]):.2g} % of its light too "
                f"{'much' if off[worst] > 0.0 else 'little'} against its rays, beyond what diffraction can do; its "
                "beam is folded or distorted: refocus the camera, or make its aberrations smaller"
            )
        return off

    @property
    def light_per_pixel(self) -> np.ndarray:
        """Photons per frame times the pixel's area, m^2, (C,): what turns an image of unit power into photons per
        pixel.
        """
        return np.array([channel.photons * self.pitch**2 for channel in self.channels])


class _OnSpots(MonitorBeams):
    """Beams whose positions count from the middle of their own spot, wherever it stands."""

    def _with(self, nodes: PupilNodes) -> MonitorBeams:
        return _OnSpots(self.instrument, self.backend, nodes, self.cameras)

    def _require_on_ccd(self, channel: Channel, place: np.ndarray) -> None:
        """A CCD that is set to its spot has it."""

    def rays(self, states: Sequence[State], coarse: CoarseTrace | None = None) -> CcdRays:
        rays = super().rays(states, coarse)
        share = self.nodes.share * rays.valid
        middle = np.einsum("bn,bnk->bk", share / np.sum(share, axis=1, keepdims=True), rays.position)
        return replace(rays, position=rays.position - middle[:, None] * [1.0, 1.0, 0.0])


class SpotPath(_OnSpots, MonitorPath):
    """Images of a monitor whose area CCDs have been set, when the instrument was built, so that every spot stands in
    the middle of its own: for spots of instruments that are not built as designed.
    """

    def class_of(self, known: CoarseTrace, margin: int = 0) -> np.ndarray:
        """Number of the class of nodes that is right for all spots of each state, in the middle, (S,)."""
        return super().class_of(replace(known, place=np.zeros_like(known.place)), margin)
