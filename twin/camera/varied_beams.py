"""Wavefronts of a camera's beams at fixed fields in many states, by exact traces in batches.

All beams are those that the nominal camera images at its fields, traced through the same points of the stop. Vignetting
of a beam is that of the nominal camera at its design wavelength: small motions change it in second order.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from optics.geometry import zernike
from optics.geometry.polygon import area
from optics.geometry.tree import WAVEFRONT, PlacedBodies, State
from optics.numerics import quadrature
from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import one_blas_thread
from optics.raytrace.aim import RayFan, aim, transverse_axes
from optics.raytrace.system import assemble
from optics.raytrace.trace import BeamMissedError, make_rays, trace
from optics.waves.edge_shadow import IlluminatedStop
from optics.waves.imaging import orthonormal_rows, path_to_sphere
from optics.waves.pupil_shadow import SMALLEST
from optics.waves.pupil_terms import products, to_terms
from scenes.models.camera_model import LAUNCH_DISTANCE, glass_steps, in_glass
from twin.camera.camera_optics import CameraOptics

AT_ONCE = 200
"""Number of states traced in one launch, to limit memory."""
AIM_TOLERANCE = 1e-8
"""Largest distance of a ray from its point of the stop, metres; it changes a wavefront error of ten waves by 1e-6
waves.
"""
GRIDS = ((5, 8), (7, 10), (10, 14))
"""Pairs of the number of quadrature rings of the stop and the degree of the wavefront's polynomials, the coarsest
first.
"""
RESIDUAL = 1e-3
"""Largest accepted rms of a wavefront minus the polynomials fitted to it, waves."""


class VignettedBeamError(UnphysicalError):
    """Error: a beam is vignetted by a surface that is neither the stop nor has edges in its file."""

    allowed = "fields whose light is not vignetted"


class RoughWavefrontError(UnphysicalError):
    """Error: wavefronts are too irregular to be represented by polynomials over the pupil."""

    allowed = "a sharper camera, or fields where it is sharp"


class BeamLight(NamedTuple):
    """Light of F fields and K wavelengths at the line CCD in S states, by N rays per beam.

    Attributes
    ----------
    paths : (S, F, K N) ndarray
        Optical paths of the beams' rays to the reference spheres minus those of the chief rays, of all K traced
        wavelengths, metres.
    eikonals : (S, F, K N) ndarray
        Optical paths to planes minus those of the chief rays, for transfer functions; equal to ``paths`` where they are
        not requested.
    chiefs : (S, F, 3) ndarray
        Directions of the chief rays.
    aimed : (S, K, F, 1 + N, 3) ndarray
        Starting points of the rays in the world frame, metres.
    directions : (S, F, K N, 3) ndarray
        Directions of the rays.
    """

    paths: np.ndarray
    eikonals: np.ndarray
    chiefs: np.ndarray
    aimed: np.ndarray
    directions: np.ndarray


class VariedBeams:
    """Beams of F fields through N points of the stop, in light of K wavelengths.

    Parameters
    ----------
    optics : CameraOptics
        Camera in its nominal state.
    fields : (F, 2) ndarray
        Positions in the field, as fractions of the half fields along the line and along the track.
    colours : (K,) ndarray, optional
        Wavelengths that are traced, metres; by default that of the design.
    shares : (K,) ndarray, optional
        Weights of the wavelengths, which sum to 1; by default equal.
    planes : bool
        True to compute optical paths to plane waves (eikonals) as well, for transfer functions.

    Attributes
    ----------
    directions : (F, 3) ndarray
        Directions of the light in the world frame.
    start : (F, 3) ndarray
        Starting points of the nominal camera's chief rays in the world frame, metres.
    nodes : PupilNodes
        Quadrature nodes of the stop.
    degree : int
        Degree of the polynomials over the pupil that represent wavefronts.
    solve : (T, N) ndarray
        Matrix from values at the N nodes to T polynomial coefficients.
    designed : BeamLight
        Light of the nominal camera, as of one state.
    cosines : (K, F, N, 2) ndarray
        Direction cosines (along rows, along columns) of the nominal camera's rays at the line CCD.
    residual : float
        Rms of the nominal wavefronts minus the polynomials fitted to them, waves.
    pieces : (F, P, V, 2) ndarray
        Parts of the stop's unit disk that are shadowed in the nominal beams: P polygons of V corners per field.

    Raises
    ------
    VignettedBeamError
        A surface that is neither the stop nor has edges vignettes a beam.
    RoughWavefrontError
        Polynomials cannot represent the wavefronts.
    AimError, BeamMissedError
        The light of a field does not pass.
    """

    def __init__(
        self,
        optics: CameraOptics,
        fields: np.ndarray,
        colours: np.ndarray | None = None,
        shares: np.ndarray | None = None,
        planes: bool = False,
    ) -> None:
        self.optics, self.backend = optics, optics.path.backend
        self.fields = np.asarray(fields, dtype=np.float64)
        self.wavelength = float(optics.model.spec.wavelength)
        traced = np.array([self.wavelength]) if colours is None else colours
        self.shares = np.full(len(traced), 1.0 / len(traced)) if shares is None else shares
        self._glass = [glass_steps(optics.model.spec, optics.path.root, float(colour)) for colour in traced]
        self.radius = float(optics.model.first_order.exit_pupil_distance[0])
        self._values: dict[int, np.ndarray] = {}
        self._planes = planes and bool(np.isfinite(self.radius))
        self._prepare()

    @one_blas_thread()
    def _prepare(self) -> None:
        """Trace the nominal camera with the coarsest of ``GRIDS`` whose polynomials represent its wavefronts."""
        self.directions = self.optics.directions(self.fields)
        for rings, degree in GRIDS:
            self.nodes, self.degree = quadrature.disk(rings), degree
            self.points = np.concatenate([np.zeros((1, 2)), np.stack([self.nodes.x, self.nodes.y], axis=-1)])
            self._aim_nominal()
            traced, aimed = self._rays([{}])
            if not traced[3].all():
                raise VignettedBeamError(
                    "the beams of the fields are vignetted by a surface that is neither the stop nor has edges"
                )
            self.designed = self._light(traced, aimed)
            self.cosines = traced[1][0, :, :, 1:, 1::-1]
            self.solve = to_terms(self.nodes, degree)
            nominal_paths = self.designed.paths[0].reshape(len(self.fields), len(self.shares), -1)
            rest = nominal_paths - nominal_paths @ self.solve.T @ products(self.nodes.x, self.nodes.y, degree).T
            self.residual = float(np.sqrt(np.max(rest**2 @ self.nodes.share))) / self.wavelength
            if self.residual <= RESIDUAL:
                break
        else:
            raise RoughWavefrontError(
                f"polynomials do not represent the wavefronts: they leave {self.residual:.2g} waves"
            )
        self.pieces = self.optics.path.shadows_on_stop({}, self.directions)[0]

    def _aim_nominal(self) -> None:
        """Aim the rays of the nominal camera at the points of the stop; rays of other states start from these."""
        path = self.optics.path
        self.start = np.asarray(
            path.assembly.nominal_pose(f"{path.root}/{path.model.mirrors[0]}").translation
            - LAUNCH_DISTANCE * self.directions
        )
        least = np.eye(3)[np.argmin(np.abs(self.directions), axis=-1)]
        axes = transverse_axes(self.directions, least)
        self._fan = RayFan(self.start[:, None], self.directions[:, None], axes[:, None], moves_position=True)
        self._target = path.stop.radius * self.points + np.array(path.stop.centre)
        systems = assemble(path.assembly, [f"{path.name}/to_stop"], self._coloured([{}])).take(self._owners(1))
        middle, slope = aim(self.backend, systems, self._fan_for(1), np.zeros((1, 2)))
        near = middle + np.einsum("fnij,nj->fni", np.linalg.inv(slope), self._target)
        slopes = np.broadcast_to(slope, (*near.shape, 2))
        self._aimed = aim(self.backend, systems, self._fan_for(1), self._target, near, slopes, AIM_TOLERANCE)

    def _aimed_at_stop(self, states: Sequence[State], placed: PlacedBodies) -> np.ndarray:
        """Return starting points of rays that meet their points of the stop, (S * K * F, 1 + N, 3), metres.

        There are S states, K wavelengths and F fields, with a chief ray and N rays in each beam.

        Raises
        ------
        AimError
            The light of a state does not reach the stop.
        """
        path, count = self.optics.path, len(states) // len(self._glass)
        to_stop = assemble(path.assembly, [f"{path.name}/to_stop"], states, placed=placed)
        near, slope = (np.tile(array, (count, *[1] * (array.ndim - 1))) for array in self._aimed)
        systems, fan = to_stop.take(self._owners(count)), self._fan_for(count)
        return fan.at(aim(self.backend, systems, fan, self._target, near, slope, AIM_TOLERANCE)[0])[0]

    def _rays(
        self, states: Sequence[State], aimed: np.ndarray | None = None
    ) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
        """Trace the beams of S states, K wavelengths and F fields to the line CCD.

        Returns
        -------
        tuple of tuple and ndarray
            Position and direction (S, K, F, 1 + N, 3), path and validity (S, K, F, 1 + N), chief rays first; and the
            starting points, (S, K, F, 1 + N, 3), which are aimed if they are not given.

        Raises
        ------
        AimError
            The light of a state does not reach the stop.
        """
        path, count = self.optics.path, len(states)
        coloured = self._coloured(states)
        placed = path.assembly.place(coloured)
        aimed = self._aimed_at_stop(coloured, placed) if aimed is None else aimed
        imaging = assemble(path.assembly, [f"{path.name}/imaging"], coloured, placed=placed).take(self._owners(count))
        along = np.tile(self.directions[:, None], (count * len(self._glass), 1, 1))
        rays = make_rays(self.backend, aimed.reshape(len(along), -1, 3), along)
        traced = trace(self.backend, imaging, rays).numpy()
        shape = (count, len(self._glass), len(self.fields), len(self.points))
        reshaped = tuple(array.reshape(*shape, *array.shape[2:]) for array in traced)
        return reshaped, aimed.reshape(*shape, 3)  # type: ignore[return-value]

    def _coloured(self, states: Sequence[State]) -> list[State]:
        """Return the S states with the glasses' indices at each of K wavelengths, S * K in all, state by state."""
        return [in_glass(state, steps) for state in states for steps in self._glass]

    def _owners(self, count: int) -> np.ndarray:
        """Return the index of the state and wavelength of each beam, (S * K * F,).

        There are S = ``count`` states, K wavelengths and F fields.
        """
        return np.repeat(np.arange(count * len(self._glass)), len(self.fields))

    def _fan_for(self, count: int) -> RayFan:
        """Return the rays of all beams of ``count`` states with the two parameters by which each can be aimed."""
        times = count * len(self._glass)

        def tiled(array: np.ndarray) -> np.ndarray:
            return np.tile(array, (times, *[1] * (array.ndim - 1)))

        return RayFan(tiled(self._fan.position), tiled(self._fan.direction), tiled(self._fan.axes), True)

    def _to_sphere(self, position: np.ndarray, direction: np.ndarray, paths: np.ndarray, radius: float) -> np.ndarray:
        """Return optical paths to spheres about the chief rays' images, minus those of the chief rays, metres.

        The array is (S, F, K N) for S states, F fields, K wavelengths and N rays.

        The spheres of all wavelengths are about the weighted mean of their images.
        """
        middle = np.einsum("k,skfx->sfx", self.shares, position[:, :, :, 0])
        to_sphere = path_to_sphere(position, direction, paths, middle[:, None, :, None], radius)
        longer = to_sphere[..., 1:] - to_sphere[..., :1]
        return np.asarray(np.moveaxis(longer, 1, 2).reshape(len(paths), len(self.fields), -1))

    def _light(self, traced: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], aimed: np.ndarray) -> BeamLight:
        """Return the light at the line CCD (optical paths, chief rays) from traced rays, as ``BeamLight``."""
        position, direction, path, _ = traced
        paths = self._to_sphere(position, direction, path, self.radius)
        eikonals = self._to_sphere(position, direction, path, np.inf) if self._planes else paths
        chiefs = np.einsum("k,skfx->sfx", self.shares, direction[:, :, :, 0])
        rays = np.moveaxis(direction[:, :, :, 1:], 1, 2).reshape(len(direction), len(self.fields), -1, 3)
        return BeamLight(paths, eikonals, np.asarray(chiefs), aimed, rays)

    @one_blas_thread()
    def light(self, states: Sequence[State], aimed: np.ndarray | None = None) -> BeamLight:
        """Trace the light of states to the line CCD.

        Parameters
        ----------
        states : sequence of State
            S states.
        aimed : ndarray, optional
            Starting points of the rays, as in ``BeamLight``; by default they are aimed.

        Raises
        ------
        PhysicalError
            The light of a state is lost.
        """
        parts, step = [], max(1, AT_ONCE // len(self._glass))
        for start in range(0, len(states), step):
            batch = slice(start, start + step)
            traced, starts = self._rays(states[batch], None if aimed is None else aimed[batch])
            if not traced[3].all():
                raise BeamMissedError("the edge of a surface blocks light of a field")
            parts.append(self._light(traced, starts))
        light = BeamLight(*(np.concatenate(starts) for starts in zip(*parts, strict=True)))
        added = self._added(states)
        return light if added is None else light._replace(paths=light.paths + added, eikonals=light.eikonals + added)

    def _added(self, states: Sequence[State]) -> np.ndarray | None:
        """Return the optical paths of the Zernike terms in states, (S, F, K N), metres; None without such terms."""
        entries = [
            (s, k, j - 1, amount)
            for s, state in enumerate(states)
            for k, key in enumerate(WAVEFRONT)
            if key in state
            for j, amount in state[key].figure.items()
        ]
        if not entries:
            return None
        *indices, values = map(np.array, zip(*entries, strict=True))
        amounts = np.zeros((len(states), len(WAVEFRONT), 1 + max(indices[2])))
        amounts[tuple(indices)] = values
        share = np.concatenate([np.ones((len(self.fields), 1)), self.fields], axis=1)
        paths = -np.einsum("fk,skj,fjn->sfn", share, amounts, self._zernike_values(amounts.shape[2]))
        return np.tile(paths, len(self._glass))

    def _zernike_values(self, last: int) -> np.ndarray:
        """Return the values of the orthonormal terms of ``zernike_rows`` at the N nodes, (F, last, N)."""
        if last not in self._values:
            basis = zernike.basis(last, self.nodes.x, self.nodes.y).T
            roots = [orthonormal_rows(*light, last)[1] for light in self.illuminated_nodes()]
            self._values[last] = np.stack([np.linalg.solve(root, basis) for root in roots])
        return self._values[last]

    @property
    def free(self) -> bool:
        """True if nothing but the stop limits the beams."""
        return not self.pieces.shape[1] or not bool(np.any(area(self.pieces) > SMALLEST))

    def illuminated_nodes(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Return nodes x, y and weights of a quadrature over the light of every field; weights sum to 1.

        The arrays of a field have one entry per node; x and y are in units of the stop's radius.
        """
        if self.free:
            nodes = quadrature.disk(self.degree)
            return [(nodes.x, nodes.y, nodes.share)] * len(self.fields)
        out = []
        for field_pieces in self.pieces:
            stop = IlluminatedStop.of(field_pieces[None], self.degree, max(6, self.degree // 2 + 2))
            out.append((stop.x[0], stop.y[0], stop.weight[0] / np.sum(stop.weight)))
        return out

    @one_blas_thread()
    def zernike_rows(self, last: int) -> np.ndarray:
        """Return the matrix from optical paths at N nodes to Zernike terms 1 to ``last`` for F fields, (F, last, N).

        The terms are in metres rms, Noll's order, positive where the wavefront is ahead, with the axes of the stop. For
        a vignetted pupil they are made orthonormal over its light one after the other: annular terms for a ring.

        Parameters
        ----------
        last : int
            Highest Noll index.
        """
        out = []
        for x, y, share in self.illuminated_nodes():
            table = products(x, y, self.degree) @ self.solve
            out.append(-orthonormal_rows(x, y, share, last)[0] @ table)
        return np.stack(out)

    @cached_property
    def defocus(self) -> np.ndarray:
        """Change of the optical paths at N nodes of F fields, (F, N), per metre of shift of the image point.

        The image point moves downstream along the chief ray.
        """
        direction = self._rays([{}])[0][1][0, 0]
        return np.asarray(np.einsum("fni,fi->fn", direction[:, 1:], direction[:, 0]) - 1.0)

    @one_blas_thread()
    def focus_rows(self) -> np.ndarray:
        """Return the matrix from optical paths at N nodes to the focus of smallest rms error for F fields, (F, N).

        The focus is along the chief ray of the nominal camera, metres downstream of the line CCD.
        """
        out = []
        for (x, y, share), longer in zip(self.illuminated_nodes(), self.defocus, strict=True):
            table = products(x, y, self.degree)
            phase = _without_tilt(x, y, share, table @ self.solve @ longer)
            wavefront_rows = _without_tilt(x, y, share, table @ self.solve)
            out.append(-((share * phase) @ wavefront_rows) / float(share @ phase**2))
        return np.stack(out)


def _without_tilt(x: np.ndarray, y: np.ndarray, share: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values at N nodes, (N, ...), without piston and tilt, which are fitted with the weights of the light."""
    level = np.stack([np.ones_like(x), x, y], axis=-1)
    weighted = level * share[:, None]
    return np.asarray(values - level @ np.linalg.solve(level.T @ weighted, weighted.T @ values))
