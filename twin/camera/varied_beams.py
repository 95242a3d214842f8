"""Beams of a camera at fixed fields in many states: wavefronts by exact traces, in batches.

All beams are those that the designed camera images at its fields, traced through the same points of the stop. What
bodies and edges take of a beam is that of the designed camera at its design wavelength: small motions change it in
second order.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from optics.geometry import zernike
from optics.geometry.polygon import area
from optics.geometry.tree import PlacedBodies, State
from optics.numerics import quadrature
from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import one_blas_thread
from optics.raytrace.aim import RayFan, aim, transverse_axes
from optics.raytrace.system import assemble
from optics.raytrace.trace import BeamMissedError, make_rays, trace
from optics.waves.edge_shadow import IlluminatedStop
from optics.waves.imaging import path_to_sphere
from optics.waves.pupil_shadow import SMALLEST
from optics.waves.pupil_terms import products, to_terms
from scenes.models.camera_model import LAUNCH_DISTANCE, glass_steps, in_glass
from twin.camera.camera_optics import CameraOptics

AT_ONCE = 200
"""States traced in one launch, to bound memory."""
AIM_TOLERANCE = 1e-8
"""Distance of a ray from its point of the stop, metres: a wavefront error of ten waves changes by 1e-6 of one there."""
GRIDS = ((5, 8), (7, 10), (10, 14))
"""Rings of the stop's quadrature and degree of the polynomials for the wavefront, the coarsest first."""
RESIDUAL = 1e-3
"""Rms of a wavefront that its polynomials may leave, waves."""


class CutError(UnphysicalError):
    """Beams are cut by what is not the stop and has no edges of its own."""

    allowed = "fields whose light comes through whole"


class RoughError(UnphysicalError):
    """Polynomials do not follow the wavefronts."""

    allowed = "a sharper camera, or fields where it is"


class BeamLight(NamedTuple):
    """Light of states at the line CCD.

    Attributes
    ----------
    paths : np.ndarray
        Optical paths of the beams' rays less those of the chief rays, of all K traced wavelengths, (S, F, K N), metres.
    eikonals : np.ndarray
        Likewise to planes, as transfer functions take them, (S, F, K N); the paths where they are not asked.
    chiefs : np.ndarray
        Directions of chief rays, (S, F, 3).
    aimed : np.ndarray
        Where rays start, (S, K, F, 1 + N, 3), world, metres.
    """

    paths: np.ndarray
    eikonals: np.ndarray
    chiefs: np.ndarray
    aimed: np.ndarray


class VariedBeams:
    """Beams of F fields through N points of the stop, in light of K wavelengths.

    Parameters
    ----------
    optics
        The camera as designed.
    fields
        Shares of the half field, (F, 2).
    colours
        Wavelengths that are traced, metres, (K,); that of the design by default.
    shares
        Of them, which sum to 1, (K,); all alike by default.
    planes
        Whether eikonals are wanted.

    Attributes
    ----------
    directions
        Of the light, world, (F, 3).
    start
        Where the designed camera's chief rays start, world, metres, (F, 3).
    nodes
        Of the stop.
    degree
        Of the polynomials in the pupil by which wavefronts are told.
    solve
        From values at the nodes to their coefficients, (T, N).
    designed
        Light of the designed camera, of one state.
    cosines
        Direction cosines (row, column) of its rays at the line CCD, (K, F, N, 2).
    residual
        Rms that the polynomials leave of its wavefronts, waves.
    pieces
        Polygons on the stop's unit disk that its beams lack, (F, P, V, 2).

    Raises
    ------
    CutError, RoughError
        Beams of which nothing can be told so.
    AimError, BeamMissedError
        The light of a field does not come through.
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
        self._planes = planes and bool(np.isfinite(self.radius))
        self._prepare()

    @one_blas_thread()
    def _prepare(self) -> None:
        self.directions = self.optics.directions(self.fields)
        for rings, degree in GRIDS:
            self.nodes, self.degree = quadrature.disk(rings), degree
            self.points = np.concatenate([np.zeros((1, 2)), np.stack([self.nodes.x, self.nodes.y], axis=-1)])
            self._aim_nominal()
            traced, aimed = self._rays([{}])
            if not traced[3].all():
                raise CutError("the beams of the fields are cut by what is not the stop and has no edges of its own")
            self.designed = self._light(traced, aimed)
            self.cosines = traced[1][0, :, :, 1:, 1::-1]
            self.solve = to_terms(self.nodes, degree)
            own = self.designed.paths[0].reshape(len(self.fields), len(self.shares), -1)
            rest = own - own @ self.solve.T @ products(self.nodes.x, self.nodes.y, degree).T
            self.residual = float(np.sqrt(np.max(rest**2 @ self.nodes.share))) / self.wavelength
            if self.residual <= RESIDUAL:
                break
        else:
            raise RoughError(f"wavefronts that polynomials do not follow: they leave {self.residual:.2g} waves")
        self.pieces = self.optics.path.shadows_on_stop({}, self.directions)[0]

    def _aim_nominal(self) -> None:
        """Launch points and aiming of the designed camera's rays, from which all others are aimed."""
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
        """Where rays start that meet their points of the stop in coloured states, (S * K * F, 1 + N, 3).

        Raises
        ------
        AimError
            The light of some state does not reach the stop.
        """
        path, count = self.optics.path, len(states) // len(self._glass)
        to_stop = assemble(path.assembly, [f"{path.name}/to_stop"], states, placed=placed)
        near, slope = (np.tile(one, (count, *[1] * (one.ndim - 1))) for one in self._aimed)
        systems, fan = to_stop.take(self._owners(count)), self._fan_for(count)
        return fan.at(aim(self.backend, systems, fan, self._target, near, slope, AIM_TOLERANCE)[0])[0]

    def _rays(
        self, states: Sequence[State], aimed: np.ndarray | None = None
    ) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
        """Position and direction (S, K, F, 1 + N, 3), path and validity (S, K, F, 1 + N) of the beams at the line CCD,
        chief rays first, and where their rays start, (S, K, F, 1 + N, 3), which is found where it is not given.

        Raises
        ------
        AimError
            The light of some state does not reach the stop.
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
        told = tuple(one.reshape(*shape, *one.shape[2:]) for one in traced)
        return told, aimed.reshape(*shape, 3)  # type: ignore[return-value]

    def _coloured(self, states: Sequence[State]) -> list[State]:
        """The states as each traced wavelength meets them, state by state, S * K."""
        return [in_glass(state, steps) for state in states for steps in self._glass]

    def _owners(self, count: int) -> np.ndarray:
        """Number of the coloured state of each beam of so many states, (S * K * F,)."""
        return np.repeat(np.arange(count * len(self._glass)), len(self.fields))

    def _fan_for(self, count: int) -> RayFan:
        """The fan of all beams of so many states."""
        times = count * len(self._glass)

        def every(array: np.ndarray) -> np.ndarray:
            return np.tile(array, (times, *[1] * (array.ndim - 1)))

        return RayFan(every(self._fan.position), every(self._fan.direction), every(self._fan.axes), True)

    def _to_sphere(self, position: np.ndarray, direction: np.ndarray, paths: np.ndarray, radius: float) -> np.ndarray:
        """Optical paths to the spheres of a radius about the images of the chief rays, of all wavelengths about the
        mean of these, less those of the chief rays, (S, F, K N).
        """
        middle = np.einsum("k,skfx->sfx", self.shares, position[:, :, :, 0])
        to_sphere = path_to_sphere(position, direction, paths, middle[:, None, :, None], radius)
        longer = to_sphere[..., 1:] - to_sphere[..., :1]
        return np.asarray(np.moveaxis(longer, 1, 2).reshape(len(paths), len(self.fields), -1))

    def _light(self, traced: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], aimed: np.ndarray) -> BeamLight:
        position, direction, path, _ = traced
        paths = self._to_sphere(position, direction, path, self.radius)
        eikonals = self._to_sphere(position, direction, path, np.inf) if self._planes else paths
        chiefs = np.einsum("k,skfx->sfx", self.shares, direction[:, :, :, 0])
        return BeamLight(paths, eikonals, np.asarray(chiefs), aimed)

    @one_blas_thread()
    def light(self, states: Sequence[State], aimed: np.ndarray | None = None) -> BeamLight:
        """What the light of states comes to at the line CCD.

        Parameters
        ----------
        states : Sequence[State]
            S of them.
        aimed : np.ndarray | None
            Where their rays start, as of ``BeamLight``; None to aim them.

        Raises
        ------
        PhysicalError
            The light of some state is lost.
        """
        found, step = [], max(1, AT_ONCE // len(self._glass))
        for start in range(0, len(states), step):
            some = slice(start, start + step)
            traced, own = self._rays(states[some], None if aimed is None else aimed[some])
            if not traced[3].all():
                raise BeamMissedError("a surface's edge stops light of a field")
            found.append(self._light(traced, own))
        return BeamLight(*(np.concatenate(own) for own in zip(*found, strict=True)))

    @property
    def free(self) -> bool:
        """Whether nothing but the stop limits the beams."""
        return not self.pieces.shape[1] or not bool(np.any(area(self.pieces) > SMALLEST))

    def lit(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Of every field nodes x, y and shares of a quadrature over the light, (N',) each; shares sum to one."""
        if self.free:
            nodes = quadrature.disk(self.degree)
            return [(nodes.x, nodes.y, nodes.share)] * len(self.fields)
        out = []
        for own in self.pieces:
            lit = IlluminatedStop.of(own[None], self.degree, max(6, self.degree // 2 + 2))
            out.append((lit.x[0], lit.y[0], lit.weight[0] / np.sum(lit.weight)))
        return out

    @one_blas_thread()
    def zernike_rows(self, last: int) -> np.ndarray:
        """From optical paths at the nodes (N,) to Zernike terms Z1 to Z``last`` of the wavefront error, (F, last, N).

        Metres rms, Noll's order, positive where the wavefront is ahead; axes of the stop. Of a cut pupil the terms are
        made orthonormal over its light one after the other: annular ones of a ring.

        Parameters
        ----------
        last : int
            Highest Noll index.
        """
        out = []
        for x, y, share in self.lit():
            table = products(x, y, self.degree) @ self.solve
            basis = zernike.basis(last, x, y)
            gram = basis.T @ (share[:, None] * basis)
            try:
                root = np.linalg.cholesky(gram)
            except np.linalg.LinAlgError as error:
                raise UnphysicalError(
                    f"{last} Zernike terms are not independent over the light that comes through"
                ) from error
            out.append(-np.linalg.solve(root, basis.T @ (share[:, None] * table)))
        return np.stack(out)

    @cached_property
    def defocus(self) -> np.ndarray:
        """What the optical paths grow by as the image point moves downstream along the chief ray, (F, N), per metre."""
        direction = self._rays([{}])[0][1][0, 0]
        return np.asarray(np.einsum("fni,fi->fn", direction[:, 1:], direction[:, 0]) - 1.0)

    @one_blas_thread()
    def focus_rows(self) -> np.ndarray:
        """From optical paths at the nodes (N,) to where the rms error is least, along the chief ray of the designed
        camera, metres downstream of the line CCD, (F, N).
        """
        out = []
        for (x, y, share), longer in zip(self.lit(), self.defocus, strict=True):
            table = products(x, y, self.degree)
            phase = _without_tilt(x, y, share, table @ self.solve @ longer)
            own = _without_tilt(x, y, share, table @ self.solve)
            out.append(-((share * phase) @ own) / float(share @ phase**2))
        return np.stack(out)


def _without_tilt(x: np.ndarray, y: np.ndarray, share: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (N, ...) at nodes without piston and tilt over the light."""
    level = np.stack([np.ones_like(x), x, y], axis=-1)
    weighted = level * share[:, None]
    return np.asarray(values - level @ np.linalg.solve(level.T @ weighted, weighted.T @ values))
