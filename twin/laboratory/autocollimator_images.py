"""Images of autocollimators that look at mirrors: pinhole, lens, mirror, lens, a window of the area CCD.

As in ``twin.monitor.monitor_path``, rays from the pinhole are aimed at quadrature nodes of the smallest aperture, which
is the mirror, traced back to the CCD, and summed as plane waves on the CCD's own pixels. Only the window that is read
out is rendered. Its place is the whole pixel nearest to the mean of the traced rays; it stands for a read-out that
first finds the brightest pixel of the full frame. The analysis is told the window's corner, as a camera reports it, and
nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optics.geometry import zernike
from optics.geometry.tree import PlacedBodies, State
from optics.numerics import quadrature
from optics.numerics.backend import Backend
from optics.numerics.quadrature import PupilNodes
from optics.raytrace.aim import RayFan, aim, transverse_axes
from optics.raytrace.system import SystemBatch, assemble
from optics.raytrace.trace import BeamMissedError, Traced, make_rays, require_some, trace
from optics.waves.diffraction import Grid, PixelResponse, PupilField, UnsampledImageError, image
from optics.waves.imaging import eikonal
from scenes.models.autocollimator_model import UNITS, Bench, autocollimator_body, outgoing, pinhole_body, round_trip
from twin.sensors.area_detector import EmvaDetector, FixedPattern

AIM_TOLERANCE = 1e-9
MAP_TERMS = 15
FINE = 2
"""Samples per pixel side. The pixels sample the irradiance at 0.43 cycles each, too near to the limit of 0.5 for the
exact pixel filter; on half pixels it is exact, and four of their means are a pixel's mean."""
CHUNK = 24
"""States traced and rendered at once, to bound memory."""
TILE = 64
"""Side of the square tiles in which a CCD's fixed pattern is drawn, pixels."""


@dataclass(frozen=True, eq=False)
class SpotWindows:
    """What two autocollimators see in S states.

    Attributes:
        photons: expected photons per pixel and frame, (2, S, window, window).
        corner: (row, column) of each window's first pixel on the CCD, (2, S, 2).
    """

    photons: np.ndarray
    corner: np.ndarray


class AutocollimatorPath:
    """Traces and images both autocollimators of one bench.

    Args:
        bench: the bench.
        backend: where to trace.
        nodes: on the mirror; by default a quadrature that makes the images right to 1e-6 of their peak.

    Raises:
        InputError: area CCDs that do not sample the spots.
    """

    def __init__(self, bench: Bench, backend: Backend, nodes: PupilNodes | None = None) -> None:
        self.bench = bench
        self.backend = backend
        collimator = bench.spec.autocollimator
        self.pitch: float = collimator.area_ccd.pitch
        self.window: int = collimator.window
        self.shape = (collimator.area_ccd.rows, collimator.area_ccd.columns)
        # the farthest pixel from a spot that is up to a pixel off the window's middle, kernel included
        reach = (0.5 * self.window + 1.0 + self.response.reach / FINE) * np.sqrt(2.0) * self.pitch
        phase = 2.0 * np.pi * bench.numerical_aperture * reach / collimator.wavelength
        self.nodes = quadrature.disk_for(phase) if nodes is None else nodes

    @cached_property
    def response(self) -> PixelResponse:
        """What a 1/FINE part of a pixel and the pinhole do to the image.

        Raises:
            InputError: the pixels are too coarse for the image, or the pinhole is too wide for them.
        """
        collimator = self.bench.spec.autocollimator
        cutoff = 2.0 * self.bench.numerical_aperture / collimator.wavelength
        try:
            return PixelResponse.fit(self.pitch / FINE, collimator.reticle.pinhole, cutoff)
        except UnsampledImageError as error:
            key = ("reticle", "pinhole") if error.of_source else ("area_ccd", "pitch")
            problem = f"the area CCDs cannot follow the spots: of {FINE} samples to the pixel, {error}"
            raise self.bench.spec.error(problem, ("autocollimator", *key), allowed=error.remedy) from error

    @cached_property
    def _slopes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Operators on smooth functions: values on the nodes to Zernike terms (T, N), terms to d/dx, d/dy (N, T)."""
        x, y = self.nodes.x, self.nodes.y
        root = np.sqrt(self.nodes.weight)
        solve = np.linalg.pinv(zernike.basis(MAP_TERMS, x, y) * root[:, None]) * root
        dx, dy = (zernike.gradient_basis(MAP_TERMS, x, y, axis) for axis in (0, 1))
        return solve, dx, dy

    @cached_property
    def _start(self) -> tuple[np.ndarray, np.ndarray]:
        """Aim parameters (2, N, 2) and their Jacobian of the unperturbed bench."""
        placed = self.bench.assembly.place()
        fan, systems = self._fan(placed, [{}])
        middle, slope = aim(self.backend, systems, fan, np.zeros((1, 2)), tolerance=AIM_TOLERANCE)
        near = middle + np.einsum("bnij,pj->bpi", np.linalg.inv(slope), self._targets)
        return aim(self.backend, systems, fan, self._targets, near, slope, AIM_TOLERANCE)

    @property
    def _targets(self) -> np.ndarray:
        """Nodes on the mirror, (N, 2), metres."""
        return 0.5 * self.bench.spec.mirrors.aperture * np.stack([self.nodes.x, self.nodes.y], axis=-1)

    def _fan(self, placed: PlacedBodies, states: Sequence[State]) -> tuple[RayFan, SystemBatch]:
        """Rays that leave the pinholes toward the lens, unit by unit, and the systems up to the mirror."""
        origin = np.concatenate([placed.translation[:, placed.index[pinhole_body(u)]] for u in UNITS])[:, None]
        frames = np.concatenate([placed.rotation[:, placed.index[autocollimator_body(u)]] for u in UNITS])
        view, up = frames[:, None, :, 2], frames[:, None, :, 0]
        systems = assemble(self.bench.assembly, [outgoing(u) for u in UNITS], states, placed=placed)
        return RayFan(origin, view, transverse_axes(view, up)), systems

    def rays(self, states: Sequence[State]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Position, direction (2 S, N, 3), path, validity (2 S, N) at the CCDs in their frames, unit by unit.

        Raises:
            BeamMissedError, AimError: the light of a spot does not come back.
        """
        rays = self._traced(self.bench.assembly.place(states), states)[1].numpy()
        require_some(rays[3], "the autocollimators")
        return rays

    def _traced(
        self, placed: PlacedBodies, states: Sequence[State], keep: Sequence[int] = ()
    ) -> tuple[np.ndarray, Traced]:
        """Launch points (2 S, N, 3), world, and the rays at the CCDs."""
        fan, systems = self._fan(placed, states)
        start, slope = (np.repeat(a, len(states), axis=0) for a in self._start)
        q, _ = aim(self.backend, systems, fan, self._targets, start, slope, AIM_TOLERANCE)
        back = assemble(self.bench.assembly, [round_trip(u) for u in UNITS], states, placed=placed)
        position, direction = fan.at(q)
        return position, trace(self.backend, back, make_rays(self.backend, position, direction), keep)

    def polylines(self, state: State) -> np.ndarray:
        """Rays of both autocollimators as points in the bench, pinhole, surfaces, CCD, (2, N, 7, 3), metres."""
        placed = self.bench.assembly.place([state])
        chains = [self.bench.assembly.sequence(round_trip(u)) for u in UNITS]
        launch, traced = self._traced(placed, [state], range(len(chains[0])))
        points = [launch]
        for i in range(len(chains[0])):
            local = traced.hit(i)
            points.append(np.stack([placed.pose(c[i].body).apply(p) for c, p in zip(chains, local, strict=True)]))
        return np.stack(points, axis=2)

    def windows(self, states: Sequence[State]) -> SpotWindows:
        """Images of both autocollimators in every state.

        Raises:
            BeamMissedError: a spot is too near its CCD's edge for its window; AimError.
        """
        parts = list(self._pieces(states))
        return SpotWindows(*(np.concatenate([part[k] for part in parts], axis=1) for k in (0, 1)))

    def _pieces(self, states: Sequence[State]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        reach = self.response.reach
        count = FINE * self.window + 2 * reach
        grid = Grid(-0.5 * (count - 1) * self.pitch / FINE, self.pitch / FINE, count)
        light = self.bench.spec.autocollimator.reticle.photons_per_frame * self.pitch**2
        for first in range(0, len(states), CHUNK):
            some = states[first : first + CHUNK]
            position, direction, path, valid = self.rays(some)
            corner = self._corner(position, valid)
            middle = np.zeros((len(corner), 1, 3))
            centre = corner + 0.5 * (self.window - 1) - 0.5 * (np.array(self.shape) - 1)
            middle[:, 0, :2] = self.pitch * centre[:, ::-1]  # detector x counts columns, y rows
            field = self._field(position - middle, direction, path, valid)
            fine = self.response.apply(image(field, grid, grid, single=True))
            photons = light * fine.reshape(len(fine), self.window, FINE, self.window, FINE).mean(axis=(2, 4))
            # the kernel's lobes may leave -1e-9 of the peak where there is no light
            photons = np.maximum(photons, 0.0)
            yield photons.reshape(2, len(some), *photons.shape[1:]), corner.reshape(2, len(some), 2)

    def _field(self, position: np.ndarray, direction: np.ndarray, path: np.ndarray, valid: np.ndarray) -> PupilField:
        """Plane waves about the origin of ``position``; the mirror is evenly lit."""
        u, v = direction[..., 0], direction[..., 1]
        solve, dx, dy = self._slopes
        a, b = u @ solve.T, v @ solve.T
        ratio = (a @ dx.T) * (b @ dy.T) - (a @ dy.T) * (b @ dx.T)
        amplitude = np.sqrt(np.abs(ratio) / np.pi) * self.nodes.weight * valid
        phase = eikonal(position, direction, path, np.zeros(3))
        return PupilField(u, v, phase - phase[:, :1], amplitude, self.bench.spec.autocollimator.wavelength)

    def _corner(self, position: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """First pixels (B, 2) of the windows around the mean of rays (B, N, 3) on the CCDs."""
        share = self.nodes.share * valid
        mean = np.einsum("bn,bnk->bk", share, position[..., 1::-1]) / share.sum(axis=1, keepdims=True)
        place = mean / self.pitch + 0.5 * (np.array(self.shape) - 1)
        corner = np.rint(place - 0.5 * (self.window - 1)).astype(int)
        outside = np.any((corner < 0) | (corner + self.window > np.array(self.shape)), axis=1)
        if np.any(outside):
            row, column = place[np.argmax(outside)]
            raise BeamMissedError(
                f"the spot of an autocollimator falls on row {row:.0f}, column {column:.0f}: its window of "
                f"{self.window} pixels does not fit on the area CCD of {self.shape[0]} x {self.shape[1]} pixels; "
                "turn the table by less"
            )
        return corner


def window_pattern(
    detector: EmvaDetector, corner: np.ndarray, window: int, seed: int, key: tuple[int, ...]
) -> FixedPattern:
    """Fixed pattern of windows of one large CCD, (S, window, window): a pixel differs from its neighbours in the same
    way in whichever window it is read out.

    Args:
        detector: its data sheet.
        corner: first pixels of the windows, (S, 2).
        window: their side.
        seed: of the run.
        key: the CCD's number among the seed's streams.
    """
    tiles: dict[tuple[int, int], FixedPattern] = {}
    gain, offset = np.empty((len(corner), window, window)), np.empty((len(corner), window, window))
    for s, (row, column) in enumerate(corner.tolist()):
        rows, columns = (range(first // TILE, (first + window - 1) // TILE + 1) for first in (row, column))
        for place in ((r, c) for r in rows for c in columns):
            if place not in tiles:
                stream = np.random.SeedSequence(seed, spawn_key=(*key, *place))
                tiles[place] = detector.fixed_pattern((TILE, TILE), stream)
        top, left = row - rows[0] * TILE, column - columns[0] * TILE
        part = np.s_[top : top + window, left : left + window]
        gain[s] = np.block([[tiles[r, c].gain for c in columns] for r in rows])[part]
        offset[s] = np.block([[tiles[r, c].offset_e for c in columns] for r in rows])[part]
    return FixedPattern(gain, offset)
