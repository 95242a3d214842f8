"""A camera out of tolerance in batoid: its errors, its focus and its wavefronts, one camera at a time.

Errors, aiming, wavefronts, the taking out of piston and tilt, and the search for the best focus are worked out here
anew. Of the twin it takes the prescription, the directions of the fields and the clear apertures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import batoid
import numpy as np
from scipy.spatial.transform import Rotation

from optics.geometry.aperture import Circle
from scenes.models.camera_model import CameraModel, field_direction
from tests.oracles.peers import batoid_rays

LAUNCH = 9.0
"""Distance of the launch planes from the vertex of M1, metres: before all mirrors."""
AIMED = 1e-10
"""Distance of a ray from its point of the stop, metres."""
FOCUS_STEP = 1e-4
"""Distance of the three planes through whose errors a parabola is laid, metres: 0.07 waves of defocus at F/9."""
Error = tuple[str, str, str]
"""Mirror, kind and axis or term: ``("M2", "shift", "z")``, ``("M1", "figure", "Z7")``, ``("M3", "radius", "")``."""


@dataclass(frozen=True, eq=False)
class Found:
    """A camera that was tried.

    Attributes:
        focus: move of the image plane against the prescription's z, metres.
        squares: mean squares of the wavefronts of all fields, waves^2, (F,).
    """

    focus: float
    squares: np.ndarray

    @property
    def worst(self) -> float:
        """Rms error of the worst field, waves."""
        return float(np.sqrt(self.squares.max()))


class StopNodes:
    """Gauss' quadrature over the unit disk, its arms not where the twin's are, and what takes piston and tilt out.

    Args:
        rings: of the quadrature, with five arms each.
    """

    def __init__(self, rings: int = 6) -> None:
        s, w = np.polynomial.legendre.leggauss(rings)
        arms = 5 * rings
        angle = 2.0 * np.pi * (np.arange(arms) + 0.2) / arms
        r = np.sqrt(0.5 * (1.0 + s))[:, None]
        inner = np.stack([(r * np.cos(angle)).ravel(), (r * np.sin(angle)).ravel()], axis=-1)
        self.points = np.concatenate([np.zeros((1, 2)), inner])
        """The middle, of the chief ray, and the nodes, (1 + N, 2)."""
        self.share = np.repeat(w / w.sum() / arms, arms)
        self._level = np.column_stack([np.ones(len(inner)), inner])
        weighted = self._level * self.share[:, None]
        self._fit = np.linalg.solve(self._level.T @ weighted, weighted.T)

    def squares(
        self, place: np.ndarray, heading: np.ndarray, path: np.ndarray, wavelength: float, pupil: float = np.inf
    ) -> np.ndarray:
        """Mean squares (F,), waves^2, of beams at the image.

        Args:
            place: (F, 1 + N, 3), in any unit of length; heading: likewise, unit vectors.
            path: optical paths to there, (F, 1 + N).
            wavelength: in that unit.
            pupil: distance of the exit pupil before the image, the radius of the spheres on which waves are compared.
        """
        offset = place - place[:, :1]
        back = np.sum(heading * offset, axis=-1)
        if np.isfinite(pupil):
            back = back + np.sqrt(pupil**2 + back**2 - np.sum(offset**2, axis=-1)) - pupil
        eikonal = path - back
        waves = (eikonal[:, 1:] - eikonal[:, :1]) / wavelength
        rest = waves - waves @ self._fit.T @ self._level.T
        return np.asarray(rest**2 @ self.share)


class BatoidCamera:
    """Mirrors, beams and stop of a camera of the library.

    Args:
        model: the camera, whose stop is one of its mirrors.
        fields: shares of the half field, (F, 2).
    """

    def __init__(self, model: CameraModel, fields: np.ndarray) -> None:
        self.model, self.spec, self.nodes = model, model.spec, StopNodes()
        count = len(self.nodes.points)
        stop = model.apertures[self.spec.stop]
        assert isinstance(stop, Circle)
        self._target = np.tile(stop.radius * self.nodes.points + np.array(stop.centre), (len(fields), 1))
        along = np.array([field_direction(self.spec, x * self.spec.field.x, y * self.spec.field.y) for x, y in fields])
        first = np.cross([0.0, 1.0, 0.0], along)
        first /= np.linalg.norm(first, axis=-1, keepdims=True)
        axes = np.stack([first, np.cross(along, first)], axis=1)
        self._along, self._axes = np.repeat(along, count, axis=0), np.repeat(axes, count, axis=0)
        designed = self._mirrors({})
        self._start, step = np.zeros((len(self._along), 2)), 1e-4
        for _ in range(20):
            here = self._at_stop(designed, self._start)
            ends = [self._at_stop(designed, self._start + step * one) for one in np.eye(2)]
            self._inverse = np.linalg.inv(np.stack([(end - here) / step for end in ends], axis=-1))
            miss = self._target - here
            if np.max(np.abs(miss)) < AIMED:
                break
            self._start = self._start + np.einsum("nij,nj->ni", self._inverse, miss)
        else:
            raise AssertionError("the designed camera's rays do not reach the stop")

    def _shape(self, name: str, errors: Mapping[Error, float]) -> batoid.Surface:
        surface, edge = self.model.surfaces[name], self.model.apertures[name]
        radius = (1.0 + errors.get((name, "radius", ""), 0.0)) / surface.curvature
        conic = surface.conic + errors.get((name, "conic", ""), 0.0)
        shape = batoid.Quadric(radius, conic)
        if surface.even:
            shape = batoid.Asphere(radius, conic, list(surface.even))
        figure = {int(term[1:]): a for (body, kind, term), a in errors.items() if (body, kind) == (name, "figure")}
        if figure:
            terms = [figure.get(j, 0.0) for j in range(max(figure) + 1)]
            size = edge.radius if isinstance(edge, Circle) else float(np.hypot(edge.half_x, edge.half_y))
            x, y = edge.centre
            shape = batoid.Sum([shape, batoid.Zernike(terms, R_outer=size, x_origin=x, y_origin=y)])
        return shape

    def _mirrors(self, errors: Mapping[Error, float]) -> dict[str, tuple[batoid.Surface, batoid.CoordSys]]:
        """Shapes and places of the mirrors with errors, SI."""
        out = {}
        for name in self.model.mirrors:
            stand = batoid.CoordSys(origin=self.model.vertex(name))
            # all axes that errors are along or about are those of the designed mirror
            nominal = batoid.CoordSys(origin=self.model.vertex(name))
            for (body, kind, axis), amount in errors.items():
                if body != name:
                    continue
                if kind == "shift":
                    stand = stand.shiftGlobal(amount * np.eye(3)["xyz".index(axis)])
                elif kind in ("rotate", "rotate about centre"):
                    turn = Rotation.from_rotvec(amount * np.eye(3)["xyz".index(axis)]).as_matrix()
                    about = self._centre(name) if kind.endswith("centre") else np.zeros(3)
                    stand = stand.rotateGlobal(turn, about, nominal)
            out[name] = (self._shape(name, errors), stand)
        return out

    def _centre(self, name: str) -> np.ndarray:
        """The middle of a mirror's aperture on its surface, in its own frame."""
        x, y = self.model.apertures[name].centre
        return np.array([x, y, float(self._shape(name, {}).sag(x, y))])

    def _traced(self, mirrors: dict, start: np.ndarray, last: str) -> batoid.RayVector:
        position = -LAUNCH * self._along + np.einsum("ni,nij->nj", start, self._axes)
        rays = batoid_rays(position, self._along, self.spec.wavelength)
        for name, (shape, stand) in mirrors.items():
            batoid.reflect(shape, rays, stand)
            if name == last:
                break
        assert not rays.failed.any()
        return rays

    def _at_stop(self, mirrors: dict, start: np.ndarray) -> np.ndarray:
        return np.array(self._traced(mirrors, start, self.spec.stop).r[:, :2])

    def _aimed(self, errors: Mapping[Error, float]) -> batoid.RayVector:
        """Rays through the nodes of the stop, behind the last mirror."""
        mirrors, start = self._mirrors(errors), self._start
        for _ in range(10):
            miss = self._target - self._at_stop(mirrors, start)
            if np.max(np.abs(miss)) < AIMED:
                break
            start = start + np.einsum("nij,nj->ni", self._inverse, miss)
        else:
            raise AssertionError("the rays do not reach the stop")
        return self._traced(mirrors, start, tuple(mirrors)[-1])

    def tried(self, errors: Mapping[Error, float]) -> Found:
        """A camera with errors, SI, in the focus at which the sum of all fields' mean squares is least."""
        left = self._aimed(errors)

        def squares(focus: float) -> np.ndarray:
            rays = left.copy()
            batoid.intersect(batoid.Plane(), rays, batoid.CoordSys(origin=[0.0, 0.0, self.spec.image.z - focus]))
            beams = (len(rays) // len(self.nodes.points), len(self.nodes.points))
            place, heading, path = rays.r.reshape(*beams, 3), rays.v.reshape(*beams, 3), rays.t.reshape(beams)
            return self.nodes.squares(place, heading, path, self.spec.wavelength)

        focus = 0.0
        for _ in range(2):  # the second from where the first arrived
            low, middle, high = (float(np.sum(squares(focus + k * FOCUS_STEP))) for k in (-1, 0, 1))
            focus += 0.5 * FOCUS_STEP * (low - high) / (low - 2.0 * middle + high)
        return Found(focus, squares(focus))

    def waves(self, errors: Mapping[Error, float]) -> np.ndarray:
        """Optical paths at the stop's nodes of the designed focus, less the chief rays', (F, N), metres."""
        rays = self._aimed(errors)
        batoid.intersect(batoid.Plane(), rays, batoid.CoordSys(origin=[0.0, 0.0, self.spec.image.z]))
        beams = (len(rays) // len(self.nodes.points), len(self.nodes.points))
        place, heading, path = rays.r.reshape(*beams, 3), rays.v.reshape(*beams, 3), rays.t.reshape(beams)
        eikonal = path - np.sum(heading * (place - place[:, :1]), axis=-1)
        return np.asarray(eikonal[:, 1:] - eikonal[:, :1])

    def tried_all(self, errors: Sequence[Error], amounts: np.ndarray) -> list[Found]:
        """Many cameras, of amounts (S, K) of the same errors, one after the other."""
        return [self.tried(dict(zip(errors, row.tolist(), strict=True))) for row in amounts]
