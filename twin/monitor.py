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
from optics.aim import RayFan, aim, alive_along, transverse_axes
from optics.aperture import Circle
from optics.backend import Backend
from optics.diffraction import Grid, PupilField, image
from optics.pixel_response import PixelResponse
from optics.quadrature import PupilNodes
from optics.system import assemble
from optics.trace import BeamMissedError, make_rays, trace
from optics.tree import PlacedBodies, State
from optics.wavefront import eikonal
from scenes.channel import Channel
from scenes.instrument_model import Instrument

MAP_TERMS = 15
"""Zernike terms (to fourth order) of the map from the aperture to direction cosines; the rest is below 1e-7 of it."""

SPOT_RANGE = 0.8
"""Share of the CCD's half size up to which a spot may be off its middle; farther out the estimators refuse it."""

COARSE_RINGS = 6
"""Rings of the quadrature for means: exact for polynomials to degree 23."""

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


@dataclass(frozen=True, eq=False)
class CcdRays:
    """Rays at the CCDs in each CCD's frame: position and direction (B, N, 3), optical path and validity (B, N)."""

    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray
    valid: np.ndarray


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
    def coarse(self) -> MonitorPath:
        """The same with few nodes: enough for means over the aperture, which is a smooth function's integral."""
        return MonitorPath(self.instrument, self.backend, quadrature.disk(COARSE_RINGS))

    @cached_property
    def nominal(self) -> Aimed:
        """Aimed rays of the unperturbed instrument, the start for all other states."""
        return self._aim(self.instrument.assembly.place(), [{}], None)

    @cached_property
    def _slopes(self) -> tuple[np.ndarray, np.ndarray]:
        """Operators from values of a smooth function on the nodes to its d/dx and d/dy there, each (N, N)."""
        x, y = self.nodes.x, self.nodes.y
        root = np.sqrt(self.nodes.weight)
        solve = np.linalg.pinv(zernike.basis(MAP_TERMS, x, y) * root[:, None]) * root
        dx, dy = (zernike.gradient_basis(MAP_TERMS, x, y, axis) for axis in (0, 1))
        return dx @ solve, dy @ solve

    def area_ratio(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Determinant d(u, v)/d(x, y) of maps from the unit disk, given on the nodes, (..., N)."""
        dx, dy = self._slopes
        return np.asarray((u @ dx.T) * (v @ dy.T) - (u @ dy.T) * (v @ dx.T))

    def _aim(self, placed: PlacedBodies, states: Sequence[State], start: Aimed | None) -> Aimed:
        """Aim rays from each pinhole at the nodes of its return face."""
        count = len(states)
        position, direction = [], []
        for channel in self.channels:
            position.append(placed.translation[:, placed.index[channel.reticle_body]])
            direction.append(self.instrument.toward_optics(placed, channel.camera))
        origin = np.concatenate(position)[:, None].real
        guess = np.concatenate(direction)[:, None]
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

    def rays(self, states: Sequence[State]) -> CcdRays:
        """Rays at the CCDs for C channels x S states, channel-major.

        Raises:
            BeamMissedError, AimError: a perturbation moves a beam off the mirrors or a spot off its CCD, named in the
                message.
        """
        placed = self.instrument.assembly.place(states)
        aimed = self._aim(placed, states, self.nominal)
        systems = assemble(self.instrument.assembly, [f"{c.key}/monitor" for c in self.channels], states, placed=placed)
        traced = trace(self.backend, systems, make_rays(self.backend, aimed.position, aimed.direction))
        rays = CcdRays(*traced.numpy())
        for i, channel in enumerate(self.channels):
            own = slice(i * len(states), (i + 1) * len(states))
            if not np.all(np.any(rays.valid[own], axis=1)):
                lost = int(np.argmin(np.any(rays.valid[own], axis=1)))
                first = own.start + lost
                where = self._where_lost(channel, states[lost], aimed.position[first], aimed.direction[first])
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
        """Plane waves at the CCDs for C channels x S states, channel-major, in each CCD's x, y about its centre.

        Raises:
            BeamMissedError, AimError: as ``rays``.
        """
        return self.field_of(self.rays(states))

    def field_of(self, rays: CcdRays) -> PupilField:
        """Plane waves of traced rays."""
        direction = rays.direction
        u, v = direction[..., 0], direction[..., 1]
        # sqrt(|d(u, v)/dA| / A) dA of the module docstring of optics.diffraction, with A the face's area
        amplitude = np.sqrt(np.abs(self.area_ratio(u, v)) / np.pi) * self.nodes.weight * rays.valid
        phase = eikonal(rays.position, direction, rays.path, np.zeros(3))
        phase = phase - phase[:, :1]
        return PupilField(u, v, phase, amplitude, self.wavelength)

    def _require_on_ccd(self, channel: Channel, position: np.ndarray) -> None:
        """Raise BeamMissedError when the middle of a spot (rays (S, N, 3) at the CCD) is outside its CCD."""
        place = np.einsum("n,snk->sk", self.nodes.share, position[..., 1::-1]) / self.pitch + 0.5 * (
            np.array(self.shape) - 1
        )
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
        for start in range(0, len(states), chunk):
            some = states[start : start + chunk]
            irradiance = image(self.fields(some), x, y, single=True)
            photons = self.light_per_pixel * response.apply(irradiance)
            yield (
                slice(start, start + len(some)),
                np.swapaxes(photons.reshape(len(self.channels), len(some), *photons.shape[1:]), 0, 1),
            )

    @property
    def light_per_pixel(self) -> float:
        """Photons per frame times the pixel's area, m^2: what turns an image of unit power into photons per pixel."""
        return float(self.instrument.spec.monitor.reticle.photons_per_frame * self.pitch**2)

    def grid(self, axis: int, margin: int = 0) -> Grid:
        """Pixel centres of the rows (0) or columns (1) in detector coordinates from the CCD's centre."""
        n = self.shape[axis]
        return Grid(-(0.5 * (n - 1) + margin) * self.pitch, self.pitch, n + 2 * margin)

    def axis(self, axis: int) -> np.ndarray:
        """Detector coordinate of the pixel centres of all rows (0) or columns (1), metres from the CCD's centre."""
        return self.grid(axis).points()
