"""The monitor's light path: from every pinhole through the camera to the return face and back to the area CCD.

The beam is limited by the return face's aperture. Rays are aimed at quadrature nodes of that aperture in every state,
so that its edge is exact; at the CCD each ray is a plane wave, and the matrix Fourier transform gives the image on the
CCD's own pixels (``optics.waves.diffraction``). The face is taken as evenly lit, the pinhole as an incoherent disk
imaged at unit scale.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from functools import cached_property

import numpy as np

from optics.geometry import zernike
from optics.geometry.tree import PlacedBodies, State
from optics.numerics import quadrature
from optics.numerics.array_math import inverse, product
from optics.numerics.backend import Backend
from optics.numerics.quadrature import PupilNodes
from optics.numerics.threads import one_blas_thread
from optics.raytrace.aim import RayFan, aim, alive_along, transverse_axes
from optics.raytrace.element_numbers import touched_bodies
from optics.raytrace.system import SystemBatch, assemble
from optics.raytrace.trace import BeamMissedError, make_rays, trace
from optics.waves.diffraction import Grid, PupilField, image
from optics.waves.pixel_response import PixelResponse
from optics.waves.wavefront import eikonal
from scenes.models.instrument_model import Instrument
from scenes.specs.channel import BASE, Channel
from twin.monitor.monitor_rays import Aimed, CcdRays, CoarseTrace, SpotFocus

MAP_TERMS = 15
"""Zernike terms (to fourth order) of the map from the aperture to direction cosines; the rest is below 1e-7 of it."""

SPOT_RANGES = (0.25, 0.5, 0.8)
"""Shares of the CCD's half size up to which spots may be off its middle, one class of pupil nodes for each: the farther
off a spot, the farther its farthest pixel, and the more nodes it needs. Beyond the last the estimators refuse it."""

COARSE_RINGS = 6
"""Rings of the quadrature for means: exact for polynomials to degree 23."""

SCOUT_RINGS = 4
"""Rings of the rays that are aimed in every state to find out how far the others have to be turned."""

AIM_TOLERANCE = 1e-9
"""Where a ray meets the aperture node, metres: it shifts a quadrature node, not the ray's own path, by 4e-8 of the
radius."""

CLOSE_TOLERANCE = 0.01 * AIM_TOLERANCE
"""Likewise of the rays from which those of other states are predicted."""


class MonitorPath:
    """Traces and images the monitor channels of one instrument.

    Args:
        instrument: the instrument.
        backend: where to trace.
        nodes: pupil quadrature; by default one that is right to 1e-6 of the peak for spots anywhere in the last of
            ``SPOT_RANGES`` of the CCD, out to the far corner, and for images those of ``classes``.
        cameras: whose channels; None for all. Numbers of a channel do not depend on which others there are.
    """

    def __init__(
        self,
        instrument: Instrument,
        backend: Backend,
        nodes: PupilNodes | None = None,
        cameras: Collection[str] | None = None,
    ) -> None:
        self.instrument = instrument
        self.backend = backend
        self.cameras = tuple(name for name in instrument.cameras if cameras is None or name in cameras)
        self.channels: tuple[Channel, ...] = tuple(c for c in instrument.channels if c.camera in self.cameras)
        ccd = instrument.spec.monitor.area_ccd
        self.shape = (ccd.rows, ccd.columns)
        self.pitch: float = ccd.pitch
        self.wavelength: float = instrument.spec.monitor.wavelength
        self.face_radius = np.array([0.5 * channel.aperture for channel in self.channels])
        self._sized = nodes is None
        self.nodes = self._nodes_for(SPOT_RANGES[-1]) if nodes is None else nodes

    def _nodes_for(self, spot_range: float) -> PupilNodes:
        """Nodes for spots in a share of the CCD, by the phase at the pupil's edge for the farthest pixel."""
        reach = 0.5 * (1.0 + spot_range) * self.pitch * float(np.hypot(*self.shape))
        return quadrature.disk_for(2.0 * np.pi * self.numerical_aperture * reach / self.wavelength)

    @cached_property
    def classes(self) -> tuple[MonitorPath, ...]:
        """Paths with as many nodes as the spots in each of ``SPOT_RANGES`` need; the last one is this path."""
        if not self._sized:
            return (self,)
        return (*(self._with(self._nodes_for(share)) for share in SPOT_RANGES[:-1]), self)

    def _with(self, nodes: PupilNodes) -> MonitorPath:
        return MonitorPath(self.instrument, self.backend, nodes, self.cameras)

    def class_of(self, place: np.ndarray, margin: int = 0) -> np.ndarray:
        """Number of the first of ``classes`` that is right for all spots of each state, (S,).

        Args:
            place: middle of the spots (C, S, 2), pixels from the CCD's middle.
            margin: extra pixels rendered on every side of the CCD.
        """
        half = 0.5 * np.array(self.shape)
        farthest = np.max(np.linalg.norm(np.abs(place) + half + margin, axis=-1), axis=0)
        reached = (1.0 + np.array(SPOT_RANGES[: len(self.classes) - 1])) * np.linalg.norm(half)
        return np.searchsorted(reached, farthest)

    @property
    def numerical_aperture(self) -> float:
        """Of the returned beam at the CCD, the largest among the cameras."""
        scales = [np.linalg.svd(m.first_order.scale[0], compute_uv=False) for m in self.instrument.cameras.values()]
        widest = max(channel.aperture for channel in self.instrument.channels)
        return 0.5 * widest / float(np.min(scales))

    @cached_property
    def coarse(self) -> MonitorPath:
        """The same with few nodes: enough for means over the aperture, which is a smooth function's integral."""
        return self._with(quadrature.disk(COARSE_RINGS))

    @cached_property
    def scout(self) -> MonitorPath:
        """The same with the fewest nodes: enough for the change of a smooth function over the aperture."""
        return self._with(quadrature.disk(SCOUT_RINGS))

    @cached_property
    def nominal(self) -> Aimed:
        """Aimed rays of the unperturbed instrument, the start for all other states."""
        return self._aim_nominal()

    @cached_property
    def _smooth(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of smooth functions: Zernike terms from values on the nodes (T, N); values, d/dx, d/dy from terms (N, T)."""
        x, y = self.nodes.x, self.nodes.y
        basis = zernike.basis(MAP_TERMS, x, y)
        # the terms are orthonormal over the disk, and the quadrature is exact for their products
        solve = (basis * self.nodes.share[:, None]).T
        dx, dy = (zernike.gradient_basis(MAP_TERMS, x, y, axis) for axis in (0, 1))
        return solve, basis, dx, dy

    def area_ratio(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Determinant d(u, v)/d(x, y) of maps from the unit disk, given on the nodes, (..., N)."""
        solve, _, dx, dy = self._smooth
        a, b = product(u, solve.T), product(v, solve.T)
        return product(a, dx.T) * product(b, dy.T) - product(a, dy.T) * product(b, dx.T)

    def _outgoing(self, placed: PlacedBodies, states: Sequence[State]) -> tuple[RayFan, SystemBatch]:
        """Rays from each pinhole toward the optics, and the systems up to the return face."""
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
        """Nodes on the return faces, (C, N, 2), metres of their nominal sizes."""
        return self.face_radius[:, None, None] * np.stack([self.nodes.x, self.nodes.y], axis=-1)

    def targets(self, states: int) -> np.ndarray:
        """The same for as many states, channel-major, (C*S, N, 2)."""
        return np.repeat(self.target, states, axis=0)

    def _aim_nominal(self) -> Aimed:
        """Aim rays of the unperturbed instrument: at the middle of the face, then at the nodes around it."""
        fan, outgoing = self._outgoing(self.instrument.assembly.place(), [{}])
        middle, slope = aim(self.backend, outgoing, fan, np.zeros((1, 2)), tolerance=CLOSE_TOLERANCE)
        near = middle + np.einsum("bnij,bpj->bpi", inverse(slope), self.target)
        q, slope = aim(self.backend, outgoing, fan, self.target, near, slope, CLOSE_TOLERANCE)
        place, heading = fan.at(q)
        return Aimed(place, heading, fan.axes, q, slope)

    def coarse_trace(self, states: Sequence[State], placed: PlacedBodies | None = None) -> CoarseTrace:
        """Where the spots of S states fall, and how rays have to be turned to meet the face where they did.

        Args:
            states: S states.
            placed: their bodies, when already placed.

        Raises:
            BeamMissedError, AimError: as ``rays``.
        """
        scout, count = self.scout, len(states)
        placed = self.instrument.assembly.place(states) if placed is None else placed
        fan, outgoing = self._outgoing(placed, states)
        names = [f"{c.key}/monitor" for c in self.channels]
        back = assemble(self.instrument.assembly, names, states, placed=placed)
        nominal = scout.nominal
        start, slope = (np.repeat(a, count, axis=0) for a in (nominal.parameters, nominal.jacobian))
        q, _ = aim(self.backend, outgoing, fan, scout.targets(count), start, slope, CLOSE_TOLERANCE)
        turn = product(np.moveaxis(q - start, -1, 0), scout._smooth[0].T)
        uploaded = back.upload(self.backend)
        traced = trace(self.backend, uploaded, make_rays(self.backend, *fan.at(q)))
        pitch = self.pitch * back.size[:, None]
        place = np.einsum("n,bnk->bk", scout.nodes.share, traced.place())[:, ::-1] / pitch
        return CoarseTrace(fan, outgoing, back, uploaded, turn, place.reshape(len(self.channels), count, 2))

    def rays(self, states: Sequence[State], coarse: CoarseTrace | None = None) -> CcdRays:
        """Rays at the CCDs for C channels x S states, channel-major.

        Args:
            states: S states.
            coarse: what ``coarse_trace`` says of them, if it is known.

        Raises:
            BeamMissedError, AimError: a perturbation moves a beam off the mirrors or a spot off its CCD, named in the
                message.
        """
        known = self.coarse_trace(states) if coarse is None else coarse
        start, slope = (np.repeat(a, len(states), axis=0) for a in (self.nominal.parameters, self.nominal.jacobian))
        q = start + np.moveaxis(product(known.turn, self._smooth[1].T), 0, -1)
        launch = known.fan.at(q)
        face = len(known.outgoing.structure) - 1
        traced = trace(self.backend, known.uploaded, make_rays(self.backend, *launch), keep=(face,))
        goal = self.targets(len(states))
        if not np.max(np.abs(traced.place(face) - known.outgoing.size[:, None, None] * goal)) <= AIM_TOLERANCE:
            # a change that is not smooth enough for its few terms
            q, _ = aim(self.backend, known.outgoing, known.fan, goal, q, slope, AIM_TOLERANCE)
            launch = known.fan.at(q)
            traced = trace(self.backend, known.uploaded, make_rays(self.backend, *launch), keep=(face,))
        position, direction, length, valid = traced.numpy()
        rays = CcdRays(position / known.back.size[:, None, None], direction, length, valid, known.back.size)
        for i, channel in enumerate(self.channels):
            own = slice(i * len(states), (i + 1) * len(states))
            if not np.all(np.any(rays.valid[own], axis=1)):
                lost = int(np.argmin(np.any(rays.valid[own], axis=1)))
                first = own.start + lost
                where = self._where_lost(channel, states[lost], launch[0][first], launch[1][first])
                raise BeamMissedError(f"the whole beam of the monitor channel {channel.key} misses {where}")
            self._require_on_ccd(channel, rays.position[own])
        return rays

    def _where_lost(self, channel: Channel, state: State, position: np.ndarray, direction: np.ndarray) -> str:
        """The element, and its body, at which the last of a channel's rays (N, 3) are lost."""
        names = self.instrument.assembly.sequences[f"{channel.key}/monitor"]
        steps = alive_along(self.backend, self.instrument.assembly, names, position, direction, state)
        count, element = next((i, element) for i, (element, alive) in enumerate(steps, 1) if not alive.any())
        return f"{element.name} on {element.body}, at surface {count} of {len(names)} of its way"

    def fields(self, states: Sequence[State]) -> PupilField:
        """Plane waves at the CCDs for C channels x S states, channel-major, in each chip's own x, y about its centre.

        Raises:
            BeamMissedError, AimError: as ``rays``.
        """
        return self.field_of(self.rays(states))

    def field_of(self, rays: CcdRays) -> PupilField:
        """Plane waves of traced rays."""
        direction = rays.direction
        u, v = direction[..., 0], direction[..., 1]
        # sqrt(|d(u, v)/dA| / A) dA of the module docstring of optics.waves.diffraction, with A the face's area
        amplitude = np.sqrt(np.abs(self.area_ratio(u, v)) / np.pi) * self.nodes.weight * rays.valid
        phase = eikonal(rays.size[:, None, None] * rays.position, direction, rays.path, np.zeros(3))
        phase = phase - phase[:, :1]
        return PupilField(u, v, phase, amplitude, self.wavelength).in_lengths_of(rays.size)

    def _require_on_ccd(self, channel: Channel, position: np.ndarray) -> None:
        """Raise BeamMissedError when the middle of a spot (rays (S, N, 3) on the chip) is outside its CCD."""
        half = 0.5 * (np.array(self.shape) - 1)
        place = np.einsum("n,snk->sk", self.nodes.share, position[..., 1::-1]) / self.pitch
        beyond = np.linalg.norm(np.maximum(np.abs(place) - half, 0.0), axis=-1)
        if np.any(beyond > 0.0):
            worst = int(np.argmax(beyond))
            row, column = place[worst] + half
            raise BeamMissedError(
                f"the spot {channel.key} falls on row {row:.0f}, column {column:.0f}, outside its area CCD of "
                f"{self.shape[0]} x {self.shape[1]} pixels: {beyond[worst]:.3g} px or "
                f"{1e3 * self.pitch * beyond[worst]:.3g} mm beyond its edge"
            )

    @cached_property
    def response(self) -> PixelResponse:
        """What pixel and pinhole do to the image; a pinhole is taken to grow with the CCD beside it."""
        pinhole = self.instrument.spec.monitor.reticle.pinhole
        return PixelResponse.fit(self.pitch, pinhole, cutoff=2.0 * self.numerical_aperture / self.wavelength)

    @cached_property
    def focus(self) -> SpotFocus:
        """How sharp the unperturbed instrument's spots are.

        Raises:
            BeamMissedError, AimError: as ``rays``.
        """
        rays, weight = self.coarse.rays([{}]), self.coarse.nodes.weight
        paths = eikonal(rays.position, rays.direction, rays.path, np.zeros(3))
        error, defocus = np.empty(len(paths)), np.empty(len(paths))
        for i, (direction, path) in enumerate(zip(rays.direction, paths, strict=True)):
            root = np.sqrt(weight * rays.valid[i])
            # light to a point (x, y, z) of the CCD's frame has there an eikonal of -(u x + v y + w z) and a constant
            basis = np.column_stack([np.ones_like(path), direction - direction[0]]) * root[:, None]
            scale = np.linalg.norm(basis, axis=0)
            flat, point = (
                np.linalg.lstsq(basis[:, :n] / scale[:n], path * root, rcond=None)[0] / scale[:n] for n in (3, 4)
            )
            error[i] = np.linalg.norm(path * root - basis[:, :3] @ flat) / np.linalg.norm(root)
            # the CCD's z is the plane's -Z; the pinhole moves with the CCD, its image the other way
            defocus[i] = 0.5 * point[3]
        return SpotFocus(error / self.wavelength, defocus)

    def expected_photons(
        self, states: Sequence[State], margin: int = 0, chunk: int = 32, single: bool = True
    ) -> np.ndarray:
        """Expected photons per pixel and frame.

        Args:
            states: S states.
            margin: extra pixels rendered on every side of the CCD.
            chunk: states done at once, to bound memory.
            single: in single precision, see ``optics.waves.diffraction.image``.

        Returns:
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
                photons = self._render(some, margin, single)
            yield slice(start, start + len(some)), photons

    def photons_of(self, state: State, placed: PlacedBodies | None = None, single: bool = False) -> np.ndarray:
        """Expected photons per pixel and frame of one state, (C, rows, columns).

        The same as ``expected_photons``, to the bit; channels of cameras whose bodies all stay are rendered once.

        Args:
            state: the state.
            placed: its bodies, when already placed.
            single: in single precision, see ``optics.waves.diffraction.image``.

        Raises:
            BeamMissedError, AimError: as ``rays``.
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
                # spots far off need more nodes, and then all channels get them
                if part.class_of(coarse.place)[0] == usual:
                    out = photons.copy()
                    out[[c.camera in moved for c in self.channels]] = part._render([state], 0, single, coarse)[0]
                    return out
            return np.asarray(self._render([state], 0, single, self.coarse_trace([state], placed))[0])

    def moved_cameras(self, state: State, placed: PlacedBodies | None = None) -> tuple[str, ...]:
        """Cameras of whose channels' light some body is moved or otherwise changed.

        Args:
            state: the state.
            placed: its bodies, when already placed.
        """
        assembly = self.instrument.assembly
        touched = touched_bodies(assembly, [state], assembly.place([state]) if placed is None else placed)
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
            nodes = None if self._sized else self.nodes
            self._parts[names] = MonitorPath(self.instrument, self.backend, nodes, names)
        return self._parts[names]

    @cached_property
    def _parts(self) -> dict[tuple[str, ...], MonitorPath]:
        return {}

    def _at_rest(self, single: bool) -> tuple[np.ndarray, int]:
        """Photons of the unperturbed instrument (C, rows, columns), and the number of their class."""
        if single not in self._rested:
            coarse = self.coarse_trace([{}])
            self._rested[single] = self._render([{}], 0, single, coarse)[0], int(self.class_of(coarse.place)[0])
        return self._rested[single]

    @cached_property
    def _rested(self) -> dict[bool, tuple[np.ndarray, int]]:
        return {}

    def _render(
        self, states: Sequence[State], margin: int, single: bool, coarse: CoarseTrace | None = None
    ) -> np.ndarray:
        """Expected photons (S, C, rows + 2 margin, columns + 2 margin), each state with the nodes of its class."""
        channels, response = len(self.channels), self.response
        y, x = (self.grid(axis, margin + response.reach) for axis in (0, 1))
        coarse = self.coarse_trace(states) if coarse is None else coarse
        chosen = self.class_of(coarse.place, margin)
        out = np.empty((len(states), channels, *(n + 2 * margin for n in self.shape)))
        for number in np.unique(chosen):
            own = np.flatnonzero(chosen == number)
            path, known = self.classes[number], coarse.take(own, self.backend)
            field = path.field_of(path.rays([states[s] for s in own.tolist()], known))
            photons = response.apply(image(field, x, y, single))
            photons = photons.reshape(channels, len(own), *photons.shape[1:])
            photons *= self.light_per_pixel[:, None, None, None]
            out[own] = np.swapaxes(photons, 0, 1)
        return out

    @property
    def light_per_pixel(self) -> np.ndarray:
        """Photons per frame times the pixel's area, m^2, (C,): what turns an image of unit power into photons per
        pixel.
        """
        return np.array([channel.photons * self.pitch**2 for channel in self.channels])

    def grid(self, axis: int, margin: int = 0) -> Grid:
        """Pixel centres of the rows (0) or columns (1) on the chip, from the CCD's centre, in nominal metres."""
        n = self.shape[axis]
        return Grid(-(0.5 * (n - 1) + margin) * self.pitch, self.pitch, n + 2 * margin)

    def axis(self, axis: int) -> np.ndarray:
        """Detector coordinate of the pixel centres of all rows (0) or columns (1), metres from the CCD's centre."""
        return self.grid(axis).points()
