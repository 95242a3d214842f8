"""A block adjusted once more: one dense normal matrix of all unknowns, in a parametrisation of its own.

Unknowns are the readings themselves (radians, metres) with dense covariances, the values of walks and slow processes,
and points east, north and up. Derivatives are central differences through the test's own projection.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tests.analysis.drawn_blocks import EAST, LOOKS, NORTH, UP, basis, project

FRAME = np.stack([EAST, NORTH, UP])
ZERO = np.zeros(3)


class DenseBlock:
    """Adjusted block: `ground` (m, 3), `ground_covariance` (m, 3, 3), `changes`, `turns` at the times of scenes."""

    def __init__(self, block, steps=5):
        self.block = block
        self.size = 0
        self.priors = []  # columns, covariance, mean
        self.turn_of, self.shift_of = {}, {}
        self._processes()
        self._cameras()
        self.common = None
        if block.terrain is not None:
            self.common = self._new(np.array([[block.terrain.common**2]]))
        used = np.zeros(len(block.points.ids), bool)
        for s in block.scenes:
            used[s.rays.point] = True
        self.points = np.flatnonzero(used)
        self.place = np.full(len(used), -1)
        self.place[self.points] = np.arange(len(self.points))
        self.first_point = self.size
        total = self.size + 3 * len(self.points)
        u = np.zeros(total)
        self.origin = block.points.start[self.points]
        for _ in range(steps):
            normal, right, self.chi_square = self._equations(u)
            step = np.linalg.solve(normal, right)
            u = u - step
        normal, _, self.chi_square = self._equations(u)
        scale = 1 / np.sqrt(np.diag(normal))
        self.covariance = scale[:, None] * np.linalg.inv(scale[:, None] * normal * scale) * scale
        self.u = u
        local = u[self.first_point :].reshape(-1, 3)
        self.ground = self.origin + local @ FRAME
        blocks = [self.first_point + 3 * k + np.arange(3) for k in range(len(self.points))]
        self.ground_covariance = np.array([FRAME.T @ self.covariance[np.ix_(b, b)] @ FRAME for b in blocks])

    def _new(self, covariance, mean=None):
        columns = self.size + np.arange(len(covariance))
        self.size += len(covariance)
        self.priors.append((columns, np.linalg.inv(covariance), np.zeros(len(covariance)) if mean is None else mean))
        return columns

    def _moments(self, name):
        rows = [s.rays.time for s in self.block.scenes if s.of == name]
        return np.concatenate(rows + [f.time for f in self.block.footprints if f.of == name])

    def _processes(self):
        block = self.block
        self.constants = {}
        for terms, kept in ((block.attitude, self.turn_of), (block.station, self.shift_of)):
            for one in block.passes:
                kept[one.name] = []
            for term in terms:
                scopes = {}
                for one in block.passes:
                    scope = {"pass": one.name, "tracker": one.tracker, "block": ""}[term.scope]
                    scopes.setdefault(scope, []).append(one.name)
                for scope, names in scopes.items():
                    moments = np.concatenate([self._moments(n) for n in names])
                    _, spread = basis(term.law, moments[:1], moments)
                    columns = [self._new(s**2 * spread) if s > 0 else None for s in term.law.sigma]
                    if term.scope == "tracker" and term.law.kind == "constant":
                        self.constants[scope] = np.array([c[0] for c in columns])
                    for name in names:
                        kept[name].append((term.law, moments, columns))

    def _cameras(self):
        block = self.block
        self.change = {}
        for name in block.cameras:
            known = (block.monitored or block.known)[name]
            columns = self._new(known.covariance, known.mean.ravel())
            for k, one in enumerate(block.passes):
                self.change[one.name, name] = columns[4 * k : 4 * k + 4]

    def _matrix(self, parts, times):
        """(n, 3, size) of the process values by the unknowns."""
        found = np.zeros((len(times), 3, self.size))
        for law, moments, columns in parts:
            own, _ = basis(law, times, moments)
            for axis, where in enumerate(columns):
                if where is not None:
                    found[:, axis, where] += own
        return found

    def turns(self, name, times):
        """(n, 3) turns and covariances (n, 3, 3)."""
        matrix = self._matrix(self.turn_of[name], times)
        spread = self.covariance[: self.size, : self.size]
        return matrix @ self.u[: self.size], matrix @ spread @ np.swapaxes(matrix, 1, 2)

    def _axes(self, name):
        return next(s.rays.attitude[0] for s in self.block.scenes if s.of == name)

    def _equations(self, u):
        total = self.size + 3 * len(self.points)
        x, ground = u[: self.size], self.origin + u[self.size :].reshape(-1, 3) @ FRAME
        rows, misses = [], []

        def add(seen, miss, by_point, parts, white):
            """Rows of packets (n, d): whiten, spread over the columns."""
            design = np.zeros((*miss.shape, total))
            for matrix, by in parts:
                design[:, :, : self.size] += by @ matrix
            where = self.size + 3 * self.place[seen][:, None] + np.arange(3)
            for k in range(len(seen)):
                design[k][:, where[k]] += by_point[k]
            rows.append((white @ design).reshape(-1, total))
            misses.append(np.einsum("nij,nj->ni", white, miss).ravel())

        def slopes(function, count, step):
            found = []
            for k in range(count):
                d = np.zeros(count)
                d[k] = step
                found.append((function(d) - function(-d)) / (2 * step))
            return np.stack(found, axis=-1)

        for scene in self.block.scenes:
            rays, axes = scene.rays, self._axes(scene.of)
            turn_matrix = self._matrix(self.turn_of[scene.of], rays.time)
            shift_matrix = self._matrix(self.shift_of[scene.of], rays.time)
            turn, shift = turn_matrix @ x, shift_matrix @ x
            change = x[self.change[scene.of, scene.camera]]
            at = ground[self.place[rays.point]]

            def seen(dt=0, ds=0, dc=0, dp=ZERO, kept=(rays, axes, turn, shift, change, at, LOOKS[scene.camera])):
                rays, axes, turn, shift, change, at, look = kept
                body = rays.attitude @ Rotation.from_rotvec(turn + dt).as_matrix()
                arm = np.einsum("nji,nj->ni", body, at + dp @ FRAME - rays.station - (shift + ds) @ axes.T)
                return project(look, change + dc, arm) - rays.image

            change_matrix = np.zeros((len(rays.point), 4, self.size))
            change_matrix[:, np.arange(4), self.change[scene.of, scene.camera]] = 1.0
            unit = np.array([1e-6, 1e-6, 1e-6, 1e-5])
            by_change = slopes(lambda d, seen=seen, unit=unit: seen(dc=d * unit), 4, 1.0) / unit
            parts = [
                (turn_matrix, slopes(lambda d, seen=seen: seen(dt=d), 3, 1e-6)),
                (shift_matrix, slopes(lambda d, seen=seen: seen(ds=d), 3, 1.0)),
                (change_matrix, by_change),
            ]
            white = np.broadcast_to(np.eye(2) / self.block.image, (len(rays.point), 2, 2))
            add(rays.point, seen(), slopes(lambda d, seen=seen: seen(dp=d), 3, 1.0), parts, white)
        for one in self.block.footprints:
            axes = self._axes(one.of)
            turn_matrix = self._matrix(self.turn_of[one.of], one.time)
            shift_matrix = self._matrix(self.shift_of[one.of], one.time)
            turn, shift = turn_matrix @ x, shift_matrix @ x
            at = ground[self.place[one.point]]

            def hit(dt=0, ds=0, dp=ZERO, one=one, axes=axes, turn=turn, shift=shift, at=at):
                body = one.attitude @ Rotation.from_rotvec(turn + dt).as_matrix()
                arm = np.einsum("nji,nj->ni", body, at + dp @ FRAME - one.station - (shift + ds) @ axes.T)
                far = np.linalg.norm(arm, axis=1)
                # the beam looks down: angles about body X and Y
                off = np.cross(one.aim, arm / far[:, None])[:, :2]
                return np.concatenate([(far - one.distance)[:, None], off], axis=1)

            parts = [
                (turn_matrix, slopes(lambda d, hit=hit: hit(dt=d), 3, 1e-6)),
                (shift_matrix, slopes(lambda d, hit=hit: hit(ds=d), 3, 1.0)),
            ]
            white = np.broadcast_to(np.diag(1 / np.array([one.sigma[0], *[one.sigma[1]] * 2])), (len(one.point), 3, 3))
            add(one.point, hit(), slopes(lambda d, hit=hit: hit(dp=d), 3, 1.0), parts, white)
        points = self.block.points
        control = np.flatnonzero(points.role == "control")
        if len(control):
            local = (ground[self.place[control]] - points.start[control]) @ FRAME.T
            weight = np.linalg.inv(FRAME @ points.covariance[control[0]] @ FRAME.T)
            white = np.broadcast_to(np.linalg.cholesky(weight).T, (len(control), 3, 3))
            add(control, local, np.broadcast_to(np.eye(3), (len(control), 3, 3)), [], white)
        t = self.block.terrain
        if t is not None:
            above = ((ground[self.place[t.point]] - t.place) @ UP - x[self.common[0]])[:, None]
            matrix = np.zeros((len(t.point), 1, self.size))
            matrix[:, 0, self.common[0]] = 1.0
            by_point = np.broadcast_to(np.array([[0.0, 0.0, 1.0]]), (len(t.point), 1, 3))
            white = (1 / t.sigma)[:, None, None]
            add(t.point, above, by_point, [(matrix, np.full((len(t.point), 1, 1), -1.0))], white)
        design, miss = np.concatenate(rows), np.concatenate(misses)
        normal, right = design.T @ design, design.T @ miss
        square = float(miss @ miss)
        for columns, weight, mean in self.priors:
            off = x[columns] - mean
            normal[np.ix_(columns, columns)] += weight
            right[columns] += weight @ off
            square += float(off @ weight @ off)
        for angle in self.block.angles:
            a, b = (self.constants[name] for name in angle.between)
            for axis in range(3):
                row = np.zeros(total)
                row[a[axis]], row[b[axis]] = 1.0, -1.0
                off = (row @ u - angle.value[axis]) / angle.sigma[axis]
                normal += np.outer(row, row) / angle.sigma[axis] ** 2
                right += row * off / angle.sigma[axis]
                square += off**2
        return normal, right, square
