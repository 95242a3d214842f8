"""A block adjusted once more: one dense normal matrix of all unknowns, in a parametrisation of its own.

Unknowns are the readings themselves (radians, metres) with dense covariances, the values of walks and slow processes,
and points east, north and up. Each kind of observation is a function of a few quantities (turn, shift, change of the
camera, point) that are linear in the unknowns; its derivatives are central differences.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tests.analysis.drawn_blocks import EAST, LOOKS, NORTH, UP, basis, project

FRAME = np.stack([EAST, NORTH, UP])
TURN, METRES, CHANGE = [1e-6] * 3, [1.0] * 3, [1e-6, 1e-6, 1e-6, 1e-5]
"""Steps of the differences: radians, metres, and of a camera's change."""


class DenseBlock:
    """Adjusted block: `ground` (m, 3), `ground_covariance` (m, 3, 3), `changes`, `turns` at the times of scenes."""

    def __init__(self, block, steps=3):
        self.block = block
        self.size = 0
        self.priors = []  # columns, weight matrix, mean
        self.turn_of, self.shift_of = {}, {}
        self._processes()
        self.change = {}
        for name in block.cameras:
            known = (block.monitored or block.known)[name]
            columns = self._new(known.covariance, known.mean.ravel())
            self.change |= {(one.name, name): columns[4 * k : 4 * k + 4] for k, one in enumerate(block.passes)}
        common = [] if block.terrain is None else self._new(np.array([[block.terrain.common**2]]))
        self.points = np.unique(np.concatenate([s.rays.point for s in block.scenes]))
        self.total = self.size + 3 * len(self.points)
        self.packets = list(self._packets(common))
        u = np.zeros(self.total)
        for _ in range(steps):
            normal, right, self.chi_square = self._equations(u)
            u = u - np.linalg.solve(normal, right)
        normal, _, self.chi_square = self._equations(u)
        scale = 1 / np.sqrt(np.diag(normal))
        self.covariance = scale[:, None] * np.linalg.inv(scale[:, None] * normal * scale) * scale
        self.u = u
        self.ground = block.points.start[self.points] + u[self.size :].reshape(-1, 3) @ FRAME
        blocks = self.size + np.arange(3 * len(self.points)).reshape(-1, 3)
        self.ground_covariance = np.array([FRAME.T @ self.covariance[np.ix_(b, b)] @ FRAME for b in blocks])

    def _new(self, covariance, mean=0.0):
        columns = self.size + np.arange(len(covariance))
        self.size += len(covariance)
        self.priors.append((columns, np.linalg.inv(covariance), mean))
        return columns

    def _processes(self):
        block = self.block
        self.constants = {}

        def moments_of(name):
            rows = [s.rays.time for s in block.scenes if s.of == name]
            return np.concatenate(rows + [f.time for f in block.footprints if f.of == name])

        for terms, kept in ((block.attitude, self.turn_of), (block.station, self.shift_of)):
            for term in terms:
                scopes = {}
                for one in block.passes:
                    scope = {"pass": one.name, "tracker": one.tracker, "block": ""}[term.scope]
                    scopes.setdefault(scope, []).append(one.name)
                for scope, names in scopes.items():
                    moments = np.concatenate([moments_of(n) for n in names])
                    _, spread = basis(term.law, moments[:1], moments)
                    columns = [self._new(s**2 * spread) for s in term.law.sigma]
                    if term.scope == "tracker" and term.law.kind == "constant":
                        self.constants[scope] = np.array([c[0] for c in columns])
                    for name in names:
                        kept.setdefault(name, []).append((term.law, moments, columns))

    def _matrix(self, parts, times):
        """(n, 3, total) of the process values by the unknowns."""
        found = np.zeros((len(times), 3, self.total))
        for law, moments, columns in parts:
            for axis, where in enumerate(columns):
                found[:, axis, where] += basis(law, times, moments)[0]
        return found

    def turns(self, name, times):
        """(n, 3) turns and covariances (n, 3, 3)."""
        matrix = self._matrix(self.turn_of[name], times)
        return matrix @ self.u, matrix @ self.covariance @ np.swapaxes(matrix, 1, 2)

    def _packets(self, common):
        """Yield matrices (n, k, total) of the quantities, whitened misclosures (n, d) by them, steps (k,)."""
        block, unit, points = self.block, np.eye(self.total), self.block.points
        place = np.zeros(len(points.ids), int)
        place[self.points] = np.arange(len(self.points))

        def at(point):
            return unit[self.size + 3 * place[point][:, None] + np.arange(3)]

        def arms(one, point, q):
            """From the corrected station to points, in corrected body axes."""
            axes = next(s.rays.attitude[0] for s in block.scenes if s.of == one.of)
            ray = getattr(one, "rays", one)
            body = ray.attitude @ Rotation.from_rotvec(q[:, :3]).as_matrix()
            there = points.start[point] + q[:, -3:] @ FRAME
            return np.einsum("nji,nj->ni", body, there - ray.station - q[:, 3:6] @ axes.T)

        for scene in block.scenes:
            rays = scene.rays
            change = np.tile(unit[self.change[scene.of, scene.camera]], (len(rays.point), 1, 1))
            turn, shift = (self._matrix(of[scene.of], rays.time) for of in (self.turn_of, self.shift_of))

            def seen(q, scene=scene, rays=rays):
                arm = arms(scene, rays.point, q)
                return (project(LOOKS[scene.camera], q[0, 6:10], arm) - rays.image) / block.image

            matrix = np.concatenate([turn, shift, change, at(rays.point)], axis=1)
            yield matrix, seen, [*TURN, *METRES, *CHANGE, *METRES]
        for one in block.footprints:
            turn, shift = (self._matrix(of[one.of], one.time) for of in (self.turn_of, self.shift_of))

            def hit(q, one=one):
                arm = arms(one, one.point, q)
                far = np.linalg.norm(arm, axis=1)
                # the beam looks down: angles about body X and Y
                off = np.cross(one.aim, arm / far[:, None])[:, :2]
                return np.column_stack([(far - one.distance) / one.sigma[0], off / one.sigma[1]])

            yield np.concatenate([turn, shift, at(one.point)], axis=1), hit, [*TURN, *METRES, *METRES]
        control = np.flatnonzero(points.role == "control")
        for k in control:
            root = np.linalg.cholesky(np.linalg.inv(FRAME @ points.covariance[k] @ FRAME.T))
            yield at(np.array([k])), lambda q, root=root: q @ root, METRES
        t = block.terrain
        if t is not None:
            matrix = np.concatenate([np.tile(unit[common], (len(t.point), 1, 1)), at(t.point)], axis=1)

            def above(q):
                height = (points.start[t.point] - t.place + q[:, 1:] @ FRAME) @ UP - q[:, 0]
                return (height / t.sigma)[:, None]

            yield matrix, above, [1.0, *METRES]
        for angle in block.angles:
            a, b = (self.constants[name] for name in angle.between)
            yield (unit[a] - unit[b])[None], lambda q, angle=angle: (q - angle.value) / angle.sigma, TURN

    def _equations(self, u):
        normal, right, square = np.zeros((self.total, self.total)), np.zeros(self.total), 0.0
        for matrix, misclosure, step in self.packets:
            q = matrix @ u
            moves = np.diag(step)
            slopes = [(misclosure(q + move) - misclosure(q - move)) / (2 * move.max()) for move in moves]
            design, miss = (np.stack(slopes, axis=-1) @ matrix).reshape(-1, self.total), misclosure(q).ravel()
            normal, right, square = normal + design.T @ design, right + design.T @ miss, square + miss @ miss
        for columns, weight, mean in self.priors:
            off = u[columns] - mean
            normal[np.ix_(columns, columns)] += weight
            right[columns] += weight @ off
            square += off @ weight @ off
        return normal, right, square
