"""Rays of the monitor's light path, and what is known of them: from the pinholes, and at the area CCDs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optics.numerics.backend import Backend
from optics.raytrace.aim import RayFan
from optics.raytrace.system import SystemBatch, UploadedSystems


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
class CoarseTrace:
    """What a few rays say of C channels x S states (channel-major).

    Attributes:
        fan: of the rays from the pinholes.
        outgoing, back: systems from the pinholes to the return face, and on to the CCDs.
        uploaded: the latter where they are traced.
        turn: change of the aim parameters against the nominal instrument, Zernike terms on the face, (2, C*S, T).
        place: middle of the spots, (row, column) in pixels from the CCD's middle, (C, S, 2).
        blur: distance of the farthest rays from there, estimated at the aperture's edge, pixels, (C, S).
        aperture: numerical apertures of the beams, the largest half width, (C, S).
    """

    fan: RayFan
    outgoing: SystemBatch
    back: SystemBatch
    uploaded: UploadedSystems
    turn: np.ndarray
    place: np.ndarray
    blur: np.ndarray
    aperture: np.ndarray

    def take(self, states: np.ndarray, backend: Backend) -> CoarseTrace:
        """The states of the given indices."""
        channels, count = self.place.shape[:2]
        if np.array_equal(states, np.arange(count)):
            return self
        own = (np.arange(channels)[:, None] * count + states).ravel()
        fan = RayFan(self.fan.position[own], self.fan.direction[own], self.fan.axes[own])
        outgoing, back = self.outgoing.take(own), self.back.take(own)
        spots = (spot[:, states] for spot in (self.place, self.blur, self.aperture))
        return CoarseTrace(fan, outgoing, back, back.upload(backend), self.turn[:, own], *spots)


@dataclass(frozen=True, eq=False)
class CcdRays:
    """Rays at the CCDs in each CCD's frame.

    Attributes:
        position: on the chip, whose pixels grow with it: metres over ``size``, so that pixels have the nominal pitch,
            (B, N, 3).
        direction: unit, (B, N, 3).
        path: optical path, metres, (B, N).
        valid: (B, N).
        size: of the CCD relative to nominal, (B,).
    """

    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray
    valid: np.ndarray
    size: np.ndarray


@dataclass(frozen=True, eq=False)
class SpotFocus:
    """Sharpness of the unperturbed instrument's spots, channel by channel.

    Attributes:
        error: rms wavefront error of the returned beam about its best plane tilt, waves, (C,).
        defocus: how far the focal plane would have to move along its Z for the sharpest spots, metres, (C,).
    """

    error: np.ndarray
    defocus: np.ndarray
