"""The merit function of a design in batoid, with penalties, for scipy's least squares: other software on one problem.

Rays, wavefronts and constraints are worked out here anew from batoid's traces; of the twin it takes the numbers of a
prescription, the fields, the quadrature of the pupil and which beams pass which surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass

import batoid
import numpy as np

from optics.design.design_variables import Prescription
from optics.design.merit_function import MeritFunction
from tests.oracles.peers import batoid_rays

LAUNCH = 9.0


@dataclass(frozen=True, eq=False)
class Judged:
    """Residuals in waves (P,), rms error of every field (F,), violations in metres (C,), the first of an equation."""

    residuals: np.ndarray
    errors: np.ndarray
    violations: np.ndarray
    envelope: float


def _stations(prescription: Prescription, position: np.ndarray, direction: np.ndarray, last: str):
    """Points on every surface up to ``last`` in the prescription frame, and the rays there in its own frame."""
    rays, out = batoid_rays(position, direction), [position]
    for name, surface in prescription.surfaces.items():
        stand = prescription.stands[name]
        system = batoid.CoordSys(origin=[0.0, stand.y, stand.z], rot=batoid.RotX(stand.tilt))
        if surface.curvature == 0.0:
            shape = batoid.Plane()
        elif surface.even:
            shape = batoid.Asphere(1.0 / surface.curvature, surface.conic, list(surface.even))
        else:
            shape = batoid.Quadric(1.0 / surface.curvature, surface.conic)
        if name == prescription.names[-1]:
            batoid.intersect(shape, rays, system)
        else:
            batoid.reflect(shape, rays, system)
        out.append(batoid.CoordTransform(rays.coordSys, batoid.globalCoordSys).applyForwardArray(*rays.r.T).T)
        if name == last:
            break
    return out, rays


def judge(merit: MeritFunction, prescription: Prescription) -> Judged | None:
    """The prescription by batoid's rays; None where light is lost."""
    beams, operands = merit.beams, merit.operands
    x, y = beams.fields.T
    slope = np.stack([np.tan(x), np.tan(y + prescription.field_bias), np.ones_like(x)], axis=-1)
    along = slope / np.linalg.norm(slope, axis=-1, keepdims=True)
    first = np.eye(3)[0] - along * along[:, :1]
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = np.cross(along, first)

    # chief rays: Newton's method with differences
    q = np.zeros((len(x), 2))

    def miss(q: np.ndarray) -> np.ndarray:
        start = -LAUNCH * along + q[:, :1] * first + q[:, 1:] * second
        return _stations(prescription, start, along, prescription.stop)[1].r[:, :2]

    for _ in range(15):
        here = miss(q)
        if not np.all(np.isfinite(here)):
            return None
        if np.abs(here).max() < 1e-10:
            break
        slopes = np.stack([(miss(q + 1e-6 * np.eye(2)[k]) - here) / 1e-6 for k in range(2)], axis=-1)
        if not np.all(np.isfinite(slopes)) or np.any(np.linalg.det(slopes) == 0.0):
            return None
        q = q - np.linalg.solve(slopes, here[..., None])[..., 0]
    else:
        return None
    chief = -LAUNCH * along + q[:, :1] * first + q[:, 1:] * second
    pupil = 0.5 * beams.diameter * beams.pupil
    launch = chief[:, None] + pupil[:, :1] * first[:, None] + pupil[:, 1:] * second[:, None]
    fields, count = launch.shape[:2]
    flat = launch.reshape(-1, 3)
    points, rays = _stations(prescription, flat, np.repeat(along, count, axis=0), prescription.names[-1])
    if np.any(rays.failed) or not np.all(np.isfinite(rays.r)):
        return None
    place, heading = rays.r.reshape(fields, count, 3), rays.v.reshape(fields, count, 3)
    path = rays.t.reshape(fields, count) + np.einsum("fnx,fx->fn", launch, along)

    own = slice(1, 1 + beams.nodes.count)
    eikonal = path[:, own] - path[:, :1] - np.sum(heading[:, own] * (place[:, own] - place[:, :1]), axis=-1)
    root = np.sqrt(beams.nodes.share)
    basis = np.stack([np.ones(len(root)), beams.nodes.x, beams.nodes.y], axis=-1) * root[:, None]
    value = eikonal * root
    rest = (value - (basis @ np.linalg.lstsq(basis, value.T, rcond=None)[0]).T) / operands.wavelength

    line = (y == 0.0) & (x != 0.0)
    tangent = np.tan(x[line])
    distance = abs(place[line, 0, 0] @ tangent) / (tangent @ tangent) / np.cos(prescription.field_bias)
    violated = [distance - operands.principal_distance]
    heights = [p[:, 2] for p in points[1:]]
    envelope = max(h.max() for h in heights) - min(h.min() for h in heights)
    violated += [max(a.max() - b.min() - operands.envelope, 0.0) for a in heights for b in heights if a is not b]
    for passage in merit.passages:
        edge = points[passage.surface][np.argmax(passage.side * points[passage.surface][:, 1])]
        a, b = points[passage.stretch], points[passage.stretch + 1]
        share = np.clip((edge[2] - a[:, 2]) / (b[:, 2] - a[:, 2]), 0.0, 1.0)
        room = passage.side * (a[:, 1] + share * (b[:, 1] - a[:, 1]) - edge[1]) - operands.edge_margin
        violated.append(max(operands.clearance - room.min(), 0.0))
    errors = np.linalg.norm(rest, axis=1)
    return Judged(rest.ravel() / np.sqrt(fields), errors, np.array(violated), float(envelope))
