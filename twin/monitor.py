"""The monitor's light path: from every pinhole through the camera to the return face and back to the area CCD.

The beam is limited by the return face's aperture. Rays are aimed at quadrature nodes of that aperture in every state,
so that its edge is exact; at the CCD each ray is a plane wave, and the matrix Fourier transform gives the image on the
CCD's own pixels (``optics.diffraction``). The face is taken as evenly lit, the pinhole as an incoherent disk imaged
at unit scale.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optics import quadrature, zernike
from optics.aim import RayFan, aim, transverse_axes
from optics.aperture import Circle
from optics.backend import Backend
from optics.diffraction import Grid, PupilField, image
from optics.pixel_response import PixelResponse
from optics.quadrature import PupilNodes
from optics.system import assemble
from optics.trace import BeamMissedError, make_rays, require_some, trace
from optics.tree import COMPLEX_STEP, PlacedBodies, State
from optics.wavefront import eikonal
from scenes.instrument_model import BASE, Channel, Instrument
from twin.motions import ElementaryMotion, pivot_states

MAP_TERMS = 15
"""Zernike terms (to fourth order) of the map from the aperture to direction cosines; the rest is below 1e-7 of it."""

SPOT_RANGE = 0.8
"""Share of the CCD's half size up to which a spot may be off its middle; farther out the estimators refuse it."""

AIM_TOLERANCE = 1e-9
"""Where a ray meets the aperture node, metres: it shifts a quadrature node, not the ray's own path, by 4e-8 of the
radius."""


@dataclass(frozen=True, eq=False)
class Aimed:
    """Rays from the pinholes, aimed at the nodes, for C channels x S states (channel-major).

    Attributes:
        position, direction: world, (C*S, N, 3).
        axes: transverse axes of the aim parameters, (C*S, 1, 2, 3).
        parameters: aim parameters (C*S, N, 2); jacobian: d(node)/d(parameters), (C*S, N, 2, 2).
    """

    position: np.ndarray
    direction: np.ndarray
    axes: np.ndarray
    parameters: np.ndarray
    jacobian: np.ndarray


class MonitorPath:
    """Traces and images the monitor channels of one instrument.

    Args:
        instrument: the instrument.
        backend: where to trace.
        nodes: pupil quadrature; by default one that is right to 1e-6 of the peak for spots anywhere in the middle
            ``SPOT_RANGE`` of the CCD, out to the far corner.
    """

    def __init__(self, instrument: Instrument, backend: Backend, nodes: PupilNodes | None = None) -> None:
        self.instrument = instrument
        self.backend = backend
        self.channels: tuple[Channel, ...] = instrument.channels
        ccd = instrument.spec.monitor.area_ccd
        self.shape = (ccd.rows, ccd.columns)
        self.pitch: float = ccd.pitch
        self.wavelength: float = instrument.spec.monitor.wavelength
        face = instrument.assembly.elements[f"{self.channels[0].key}/return_face"].aperture
        assert isinstance(face, Circle)
        self.face_radius = face.radius
        self.nodes = quadrature.disk_for(self._largest_phase()) if nodes is None else nodes

    def _largest_phase(self) -> float:
        """Phase at the pupil's edge for the pixel that is farthest from a spot, radians."""
        reach = 0.5 * (1.0 + SPOT_RANGE) * self.pitch * float(np.hypot(*self.shape))
        return 2.0 * np.pi * self.numerical_aperture * reach / self.wavelength

    @property
    def numerical_aperture(self) -> float:
        """Of the returned beam at the CCD, the largest among the cameras."""
        scales = [np.linalg.svd(m.first_order.scale[0], compute_uv=False) for m in self.instrument.cameras.values()]
        return self.face_radius / float(np.min(scales))

    @cached_property
    def nominal(self) -> Aimed:
        """Aimed rays of the unperturbed instrument, the start for all other states."""
        return self._aim(self.instrument.assembly.place(), [{}], None)

    @cached_property
    def _map(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Operators that fit a smooth function on the nodes and give its value, d/dx and d/dy there, each (N, N)."""
        x, y = self.nodes.x, self.nodes.y
        basis = zernike.basis(MAP_TERMS, x, y)
        root = np.sqrt(self.nodes.weight)
        solve = np.linalg.pinv(basis * root[:, None]) * root
        return (
            basis @ solve,
            zernike.gradient_basis(MAP_TERMS, x, y, 0) @ solve,
            zernike.gradient_basis(MAP_TERMS, x, y, 1) @ solve,
        )

    def _aim(self, placed: PlacedBodies, states: Sequence[State], start: Aimed | None) -> Aimed:
        """Aim rays from each pinhole at the nodes of its return face."""
        count = len(states)
        position, direction = [], []
        for channel in self.channels:
            model = self.instrument.cameras[channel.camera]
            position.append(placed.translation[:, placed.index[channel.reticle_body]])
            local = model.focal_plane.rotation.T @ -model.image_direction
            direction.append(placed.rotation[:, placed.index[f"{BASE}/{channel.camera}/focal_plane"]] @ local)
        origin = np.concatenate(position)[:, None].real
        guess = np.concatenate(direction)[:, None].real
        axes = transverse_axes(guess, np.broadcast_to([0.0, 1.0, 0.0], guess.shape))
        fan = RayFan(origin, guess, axes)
        outgoing = assemble(
            self.instrument.assembly, [f"{c.key}/outgoing" for c in self.channels], states, placed=placed
        )
        target = self.face_radius * np.stack([self.nodes.x, self.nodes.y], axis=-1)
        if start is None:
            # first the middle of the face, then the nodes around it
            middle, slope = aim(self.backend, outgoing, fan, np.zeros((1, 2)), tolerance=AIM_TOLERANCE)
            near = middle + np.einsum("bnij,pj->bpi", np.linalg.inv(slope), target)
            q, slope = aim(self.backend, outgoing, fan, target, near, slope, AIM_TOLERANCE)
        else:
            q, slope = aim(
                self.backend,
                outgoing,
                fan,
                target,
                np.repeat(start.parameters, count, axis=0),
                np.repeat(start.jacobian, count, axis=0),
                AIM_TOLERANCE,
            )
        place, heading = fan.at(q)
        return Aimed(place, heading, axes, q, slope)

    def fields(self, states: Sequence[State]) -> PupilField:
        """Plane waves at the CCDs for C channels x S states, channel-major, in each CCD's x, y about its centre.

        Raises:
            BeamMissedError, AimError: a perturbation moves a beam off the mirrors, named in the message.
        """
        placed = self.instrument.assembly.place(states)
        aimed = self._aim(placed, states, self.nominal)
        systems = assemble(self.instrument.assembly, [f"{c.key}/monitor" for c in self.channels], states, placed=placed)
        traced = trace(self.backend, systems, make_rays(self.backend, aimed.position, aimed.direction))
        position, direction, path, valid = traced.numpy()
        for i, channel in enumerate(self.channels):
            own = slice(i * len(states), (i + 1) * len(states))
            require_some(valid[own], f"the monitor channel {channel.key}")
            self._require_on_ccd(channel, position[own])
        _, dx, dy = self._map
        u, v = direction[..., 0], direction[..., 1]
        determinant = np.abs((u @ dx.T) * (v @ dy.T) - (u @ dy.T) * (v @ dx.T))
        # sqrt(|d(u, v)/dA| / A) dA of the module docstring of optics.diffraction, with A the face's area
        amplitude = np.sqrt(determinant / np.pi) * self.nodes.weight * valid
        phase = eikonal(position, direction, path, np.zeros(3))
        phase = phase - phase[:, :1]
        return PupilField(u, v, phase, amplitude, self.wavelength)

    def _require_on_ccd(self, channel: Channel, position: np.ndarray) -> None:
        """Raise BeamMissedError when the middle of a spot (rays (S, N, 3) at the CCD) is outside its CCD."""
        share = self.nodes.weight / np.sum(self.nodes.weight)
        place = np.einsum("n,snk->sk", share, position[..., 1::-1]) / self.pitch + 0.5 * (np.array(self.shape) - 1)
        outside = np.any((place < 0.0) | (place > np.array(self.shape) - 1), axis=-1)
        if np.any(outside):
            row, column = place[np.argmax(outside)]
            raise BeamMissedError(
                f"the spot {channel.key} falls on row {row:.0f}, column {column:.0f}, outside its area CCD of "
                f"{self.shape[0]} x {self.shape[1]} pixels"
            )

    @cached_property
    def response(self) -> PixelResponse:
        """What pixel and pinhole do to the image."""
        pinhole = self.instrument.spec.monitor.reticle.pinhole
        return PixelResponse.fit(self.pitch, pinhole, cutoff=2.0 * self.numerical_aperture / self.wavelength)

    def expected_photons(self, states: Sequence[State], margin: int = 0, chunk: int = 32) -> np.ndarray:
        """Expected photons per pixel and frame.

        Args:
            states: S states.
            margin: extra pixels rendered on every side of the CCD.
            chunk: states done at once, to bound memory.

        Returns:
            (S, C, rows + 2 margin, columns + 2 margin).
        """
        out = np.empty((len(states), len(self.channels), self.shape[0] + 2 * margin, self.shape[1] + 2 * margin))
        for piece, photons in self.iterate_photons(states, margin, chunk):
            out[piece] = photons
        return out

    def iterate_photons(
        self, states: Sequence[State], margin: int = 0, chunk: int = 32
    ) -> Iterator[tuple[slice, np.ndarray]]:
        """Like ``expected_photons``, piece by piece: yields (slice of the states, photons)."""
        response = self.response
        border = margin + response.reach
        y, x = (self.grid(axis, border) for axis in (0, 1))
        light = self.instrument.spec.monitor.reticle.photons_per_frame * self.pitch**2
        for start in range(0, len(states), chunk):
            some = states[start : start + chunk]
            irradiance = image(self.fields(some), x, y, single=True)
            photons = light * response.apply(irradiance)
            yield (
                slice(start, start + len(some)),
                np.swapaxes(photons.reshape(len(self.channels), len(some), *photons.shape[1:]), 0, 1),
            )

    def grid(self, axis: int, margin: int = 0) -> Grid:
        """Pixel centres of the rows (0) or columns (1) in detector coordinates from the CCD's centre."""
        n = self.shape[axis]
        return Grid(-(0.5 * (n - 1) + margin) * self.pitch, self.pitch, n + 2 * margin)

    def axis(self, axis: int) -> np.ndarray:
        """Detector coordinate of the pixel centres of all rows (0) or columns (1), metres from the CCD's centre."""
        return self.grid(axis).points()

    def spot_jacobian(self, motions: Sequence[ElementaryMotion]) -> np.ndarray:
        """Derivative of every spot's position by elementary motions, by forward-mode AD through the whole path.

        The position is the mean of the rays over the aperture, which is the energy centroid of the diffraction image.

        Args:
            motions: M elementary motions.

        Returns:
            (C, 2, M): row and column, pixels per radian, metre or unit.
        """
        import drjit as dr

        states = pivot_states(motions)
        steps = [motion.step for motion in motions]
        placed = self.instrument.assembly.place(states, steps)
        step = np.concatenate([placed.translation[:, placed.index[c.reticle_body]].imag for c in self.channels])
        step = step[:, None] / COMPLEX_STEP
        nominal = self.nominal
        n, m, c = self.nodes.count, len(motions), len(self.channels)
        position = np.repeat(nominal.position, m, axis=0)
        direction = np.repeat(nominal.direction, m, axis=0)
        position = np.broadcast_to(position, direction.shape)

        def push(sequence: str, direction_step: np.ndarray) -> np.ndarray:
            """Derivative of the hit on the last element, (C*M, N, 2)."""
            systems = assemble(
                self.instrument.assembly, [f"{ch.key}/{sequence}" for ch in self.channels], states, steps, placed
            )
            rays = make_rays(self.backend, position, direction)
            dr.enable_grad(rays.position, rays.direction)
            dr.set_grad(rays.position, self.backend.vector(np.broadcast_to(step, direction.shape).reshape(-1, 3)))
            dr.set_grad(rays.direction, self.backend.vector(direction_step.reshape(-1, 3)))
            out = trace(self.backend, systems, rays, evaluate=False)
            dr.forward_to(out.local.position)
            gradient = dr.grad(out.local.position)
            return np.stack([gradient.x.numpy(), gradient.y.numpy()], axis=-1).reshape(c * m, n, 2)

        # rays stay on their aperture nodes: the launch direction follows the motion
        drift = push("outgoing", np.zeros_like(direction))
        q_step = -np.linalg.solve(np.repeat(nominal.jacobian, m, axis=0), drift[..., None])[..., 0]
        turn = np.einsum("bnk,bnkx->bnx", q_step, np.broadcast_to(np.repeat(nominal.axes, m, axis=0), (c * m, n, 2, 3)))
        turn = turn - direction * np.sum(turn * direction, axis=-1, keepdims=True)
        moved = push("monitor", turn)
        mean = np.einsum("n,bnk->bk", self.nodes.weight / np.sum(self.nodes.weight), moved)
        return np.asarray(mean.reshape(c, m, 2)[..., ::-1].swapaxes(1, 2)) / self.pitch
