"""Beams of a camera at fixed fields in many states: wavefronts by exact traces, in batches.

All beams are those that the designed camera images at its fields, traced through the same points of the stop. What
bodies and edges take of a beam is that of the designed camera: small motions change it in second order.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from optics.geometry import zernike
from optics.geometry.polygon import area
from optics.geometry.tree import State
from optics.numerics import quadrature
from optics.numerics.physical_error import UnphysicalError
from optics.numerics.threads import one_blas_thread
from optics.raytrace.aim import RayFan, aim, transverse_axes
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from optics.waves.lit_stop import LitStop
from optics.waves.pupil_shadow import SMALLEST
from optics.waves.pupil_terms import products, to_terms
from optics.waves.wavefront import path_to_sphere
from scenes.models.camera_model import LAUNCH_DISTANCE
from twin.camera.camera_optics import CameraOptics

AT_ONCE = 200
"""States traced in one launch, to bound memory."""
AIM_TOLERANCE = 1e-8
"""Distance of a ray from its point of the stop, metres: a wavefront error of ten waves changes by 1e-6 of one there."""
GRIDS = ((5, 8), (7, 10), (10, 14))
"""Rings of the stop's quadrature and degree of the polynomials for the wavefront, the coarsest first."""
RESIDUAL = 1e-3
"""Rms of a wavefront that its polynomials may leave, waves."""


class VariedBeams:
    """Beams of F fields through N points of the stop.

    Args:
        optics: the camera as designed.
        fields: shares of the half field, (F, 2).

    Attributes:
        directions: of the light, world, (F, 3).
        nodes: of the stop.
        degree: of the polynomials in the pupil by which wavefronts are told.
        solve: from values at the nodes to their coefficients, (K, N).
        designed: optical paths of the designed camera, (F, N), metres, as of ``paths``.
        chief: chief rays' directions at the line CCD there, (F, 3).
        residual: rms that the polynomials leave of it, waves.

    Raises:
        UnphysicalError: beams that are cut by what has no edges of its own, or wavefronts that polynomials do not
            follow.
        AimError, BeamMissedError: the light of a field does not come through.
    """

    def __init__(self, optics: CameraOptics, fields: np.ndarray) -> None:
        self.optics, self.backend = optics, optics.path.backend
        self.fields = np.asarray(fields, dtype=np.float64)
        self.wavelength = float(optics.model.spec.wavelength)
        self._prepare()

    @one_blas_thread()
    def _prepare(self) -> None:
        self.directions = self.optics.directions(self.fields)
        for rings, degree in GRIDS:
            self.nodes, self.degree = quadrature.disk(rings), degree
            self.points = np.concatenate([np.zeros((1, 2)), np.stack([self.nodes.x, self.nodes.y], axis=-1)])
            self._aim_nominal()
            self.radius = float(self.optics.model.first_order.exit_pupil_distance[0])
            position, direction, paths, valid = self.rays([{}])
            if not valid.all():
                raise UnphysicalError("the beams of the fields are cut by what is not the stop and has no edges")
            self.designed = self._to_sphere(position, direction, paths)[0]
            self.chief = direction[0, :, 0]
            self.solve = to_terms(self.nodes, degree)
            rest = self.designed - self.designed @ self.solve.T @ products(self.nodes.x, self.nodes.y, degree).T
            self.residual = float(np.sqrt(np.max(rest**2 @ self.nodes.share))) / self.wavelength
            if self.residual <= RESIDUAL:
                break
        else:
            raise UnphysicalError(f"wavefronts that polynomials do not follow: they leave {self.residual:.2g} waves")
        self.pieces = self.optics.path.shadows_on_stop({}, self.directions)[0]

    def _aim_nominal(self) -> None:
        """Launch points and aiming of the designed camera's rays, from which all others are aimed."""
        path = self.optics.path
        start = np.asarray(
            path.assembly.nominal_pose(f"{path.root}/{path.model.mirrors[0]}").translation
            - LAUNCH_DISTANCE * self.directions
        )
        least = np.eye(3)[np.argmin(np.abs(self.directions), axis=-1)]
        axes = transverse_axes(self.directions, least)
        self._fan = RayFan(start[:, None], self.directions[:, None], axes[:, None], moves_position=True)
        self._target = path.stop.radius * self.points + np.array(path.stop.centre)
        systems = assemble(path.assembly, [f"{path.name}/to_stop"]).take(np.zeros(len(start), dtype=int))
        middle, slope = aim(self.backend, systems, self._fan, np.zeros((1, 2)))
        near = middle + np.einsum("fnij,nj->fni", np.linalg.inv(slope), self._target)
        slopes = np.broadcast_to(slope, (*near.shape, 2))
        self._aimed = aim(self.backend, systems, self._fan, self._target, near, slopes, AIM_TOLERANCE)

    def rays(self, states: Sequence[State]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Position and direction (S, F, 1 + N, 3), path and validity (S, F, 1 + N) at the line CCD; chief rays first.

        Raises:
            AimError: the light of some state does not reach the stop.
        """
        path, count, fields = self.optics.path, len(states), len(self.fields)
        placed = path.assembly.place(states)
        every = np.repeat(np.arange(count), fields)
        imaging, to_stop = (
            assemble(path.assembly, [f"{path.name}/{way}"], states, placed=placed).take(every)
            for way in ("imaging", "to_stop")
        )

        def all_of(array: np.ndarray) -> np.ndarray:
            return np.tile(array, (count, *[1] * (array.ndim - 1)))

        fan = RayFan(all_of(self._fan.position), all_of(self._fan.direction), all_of(self._fan.axes), True)
        near, slope = (all_of(one) for one in self._aimed)
        q, _ = aim(self.backend, to_stop, fan, self._target, near, slope, AIM_TOLERANCE)
        traced = trace(self.backend, imaging, make_rays(self.backend, *fan.at(q))).numpy()
        shape = (count, fields, len(self.points))
        return tuple(one.reshape(*shape, *one.shape[2:]) for one in traced)  # type: ignore[return-value]

    def _to_sphere(self, position: np.ndarray, direction: np.ndarray, paths: np.ndarray) -> np.ndarray:
        """Optical paths (S, F, N) to the spheres about the chief rays' images, less those of the chief rays."""
        to_sphere = path_to_sphere(position, direction, paths, position[..., :1, :], self.radius)
        return np.asarray(to_sphere[..., 1:] - to_sphere[..., :1])

    @one_blas_thread()
    def paths(self, states: Sequence[State]) -> tuple[np.ndarray, np.ndarray]:
        """Optical paths (S, F, N), metres, and chief rays' directions (S, F, 3) at the line CCD.

        Raises:
            PhysicalError: the light of some state is lost.
        """
        paths, chiefs = [], []
        for start in range(0, len(states), AT_ONCE):
            position, direction, path, valid = self.rays(states[start : start + AT_ONCE])
            if not valid.all():
                raise UnphysicalError("a surface's edge stops light of a field")
            paths.append(self._to_sphere(position, direction, path))
            chiefs.append(direction[:, :, 0])
        return np.concatenate(paths), np.concatenate(chiefs)

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
            lit = LitStop.of(own[None], self.degree, max(6, self.degree // 2 + 2))
            out.append((lit.x[0], lit.y[0], lit.weight[0] / np.sum(lit.weight)))
        return out

    @one_blas_thread()
    def zernike_rows(self, last: int, orthonormal: bool = True) -> np.ndarray:
        """From optical paths at the nodes (N,) to Zernike terms Z1 to Z``last`` of the wavefront error, (F, last, N).

        Metres rms, Noll's order, positive where the wavefront is ahead; axes of the stop.

        Args:
            last: highest Noll index.
            orthonormal: of a cut pupil, terms made orthonormal over its light one after the other (annular ones of a
                ring), else circle terms fitted to it; the same where nothing cuts.
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
            parts = np.linalg.solve(root, basis.T @ (share[:, None] * table))
            out.append(-(parts if orthonormal else np.linalg.solve(root.T, parts)))
        return np.stack(out)

    @cached_property
    def defocus(self) -> np.ndarray:
        """What the optical paths grow by as the image point moves downstream along the chief ray, (F, N), per metre."""
        direction = self.rays([{}])[1][0]
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
