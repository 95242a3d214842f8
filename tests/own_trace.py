"""Cameras traced by NumPy alone: sequences of conics, even aspheres and planes, with what edges stop. Nothing of the
product's tracing is in it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scenes.specs.camera import CameraSpec, MirrorSpec

SELLMEIER = {
    "N-BK7": ((1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)),
    "fused silica": ((0.6961663, 0.4079426, 0.8974794), (0.0684043**2, 0.1162414**2, 9.896161**2)),
    "F2": ((1.34533359, 0.209073176, 0.937357162), (0.00997743871, 0.0470450767, 111.886764)),
}
"""B and C (um^2) as Schott prints them, and Malitson's (1965)."""

_STEPS = 20
_FAR = 5.0


def index_of(glass: str, wavelength: float) -> float:
    """Refractive index of a glass of SELLMEIER against air."""
    b, c = (np.array(a) for a in SELLMEIER[glass])
    square = (wavelength * 1e6) ** 2
    return float(np.sqrt(1.0 + np.sum(b * square / (square - c))))


@dataclass(frozen=True, eq=False)
class Traced:
    """Rays at the image plane, in its own frame.

    Attributes:
        place, way: (N, 3), metres and unit.
        path: optical path from the plane wavefront through ``start``, (N,), metres.
        lit: which rays come through the stop and all edges, (N,).
        known: which rays meet all surfaces, (N,).
        stop: where they meet the stop, in its own x and y, (N, 2), metres.
    """

    place: np.ndarray
    way: np.ndarray
    path: np.ndarray
    lit: np.ndarray
    known: np.ndarray
    stop: np.ndarray


@dataclass(frozen=True, eq=False)
class OwnCamera:
    """A camera of a file.

    Attributes:
        spec: the file.
        stop_radius: of the round stop, metres.
    """

    spec: CameraSpec
    stop_radius: float = np.inf

    def heading(self, x: float, y: float) -> np.ndarray:
        """Direction of the light of angles (x, y) from the middle of the field, radians."""
        way = np.array([np.tan(x), np.tan(self.spec.field_bias + y), 1.0])
        return np.asarray(way / np.linalg.norm(way))

    def launch(self, heading: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Start of the chief ray, (3,), and two axes of the wavefront there, the first near x, (2, 3)."""
        first = np.array([1.0, 0.0, 0.0]) - heading[0] * heading
        first = first / np.linalg.norm(first)
        axes = np.stack([first, np.cross(heading, first)])
        vertex = next(iter(self.spec.mirrors.values())).z
        start = np.array([0.0, 0.0, vertex]) - _FAR * heading
        step = 1e-6
        for _ in range(30):
            tries = start + step * np.concatenate([np.zeros((1, 3)), axes])
            met = self.trace(tries, heading).stop
            slope = (met[1:] - met[0]).T / step
            move = np.linalg.solve(slope, -met[0])
            start = start + move @ axes
            if np.max(np.abs(move)) < 1e-12:
                break
        return start, axes

    def trace(self, start: np.ndarray, heading: np.ndarray, wavelength: float | None = None) -> Traced:
        """Rays from points (N, 3) of a plane wavefront in one direction."""
        colour = self.spec.wavelength if wavelength is None else wavelength
        place, way = start.copy(), np.broadcast_to(heading, start.shape).copy()
        path, index = (start - start[0]) @ heading, 1.0
        lit, known, stop = np.ones(len(start), bool), np.ones(len(start), bool), np.zeros((len(start), 2))
        for name, mirror in self.spec.mirrors.items():
            turn, origin = _frame(mirror)
            p, d = (place - origin) @ turn, way @ turn
            length, found = _meet(mirror, p, d)
            p = p + length[:, None] * d
            path = path + index * length
            known &= found
            if name == self.spec.stop:
                stop = p[:, :2]
                lit &= np.hypot(*p[:, :2].T) <= self.stop_radius
            for edge in mirror.edges or ():
                lit &= _passes(edge, p[:, 0], p[:, 1])
            if mirror.light != "passes":
                normal = _normal(mirror, p)
                if mirror.light is None:
                    d = d - 2.0 * np.sum(d * normal, axis=-1, keepdims=True) * normal
                else:
                    behind = mirror.index if mirror.glass is None else index_of(mirror.glass.name, colour)
                    d, through = _bent(d, normal, index / behind)
                    known &= through
                    index = behind
            place, way = p @ turn.T + origin, d @ turn.T
        tilt = self.spec.image.tilt or 0.0
        c, s = np.cos(tilt), np.sin(tilt)
        turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        p, d = (place - np.array([0.0, 0.0, self.spec.image.z])) @ turn, way @ turn
        length = -p[:, 2] / d[:, 2]
        return Traced(p + length[:, None] * d, d, path + index * length, lit & known, known, stop)

    def beam(self, x: float, y: float, reach: float) -> Callable[[np.ndarray], tuple[np.ndarray, ...]]:
        """What ``tests.oracles.pupil_raster.raster_of`` asks of rays from points (N, 2) of the wavefront of a field, in
        units of ``reach`` about the chief ray.
        """
        heading = self.heading(x, y)
        start, axes = self.launch(heading)

        def traced(points: np.ndarray) -> tuple[np.ndarray, ...]:
            rays = self.trace(np.concatenate([start[None], start + reach * points @ axes]), heading)
            path = rays.path[1:] - rays.path[0]
            return rays.place[1:], rays.way[1:], path, rays.lit[1:], rays.known[1:]

        return traced


def _frame(mirror: MirrorSpec) -> tuple[np.ndarray, np.ndarray]:
    """Axes (columns) and vertex of a surface."""
    origin = np.array([*(mirror.decentre or (0.0, 0.0)), mirror.z])
    vector = np.array(mirror.rotate or (0.0, 0.0, 0.0))
    angle = float(np.linalg.norm(vector))
    if not angle:
        return np.eye(3), origin
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross, origin


def _sag(mirror: MirrorSpec, r2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sag and its derivative by r^2."""
    c = 0.0 if np.isinf(mirror.radius) else 1.0 / mirror.radius
    with np.errstate(invalid="ignore"):
        root = np.sqrt(1.0 - (1.0 + mirror.conic) * c * c * r2)
    sag, slope = c * r2 / (1.0 + root), 0.5 * c / root
    for key, value in mirror.aspheric.items():
        power = int(key[1:]) // 2
        sag, slope = sag + value * r2**power, slope + power * value * r2 ** (power - 1)
    return sag, slope


def _meet(mirror: MirrorSpec, p: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far rays go to a surface, (N,), and which meet it."""
    length = -p[:, 2] / d[:, 2]
    if np.isinf(mirror.radius) and not mirror.aspheric:
        return length, np.ones(len(p), bool)
    miss = np.full(len(p), np.inf)
    for _ in range(_STEPS):
        at = p + length[:, None] * d
        sag, slope = _sag(mirror, at[:, 0] ** 2 + at[:, 1] ** 2)
        miss = at[:, 2] - sag
        rise = d[:, 2] - 2.0 * slope * (at[:, 0] * d[:, 0] + at[:, 1] * d[:, 1])
        length = length - miss / rise
        if np.nanmax(np.abs(miss), initial=0.0) < 1e-15:
            break
    found = np.abs(miss) < 1e-12
    return np.where(found, length, 0.0), found


def _normal(mirror: MirrorSpec, p: np.ndarray) -> np.ndarray:
    _, slope = _sag(mirror, p[:, 0] ** 2 + p[:, 1] ** 2)
    normal = np.stack([-2.0 * slope * p[:, 0], -2.0 * slope * p[:, 1], np.ones(len(p))], axis=-1)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def _bent(d: np.ndarray, normal: np.ndarray, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Snell's law, and where light comes through."""
    cosine = np.sum(d * normal, axis=-1, keepdims=True)
    square = 1.0 - ratio**2 * (1.0 - cosine**2)
    through = square[:, 0] > 0.0
    root = np.sign(cosine) * np.sqrt(np.maximum(square, 0.0))
    return ratio * d + (root - ratio * cosine) * normal, through


def _passes(edge: object, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Which rays at places (x, y) an edge of a file lets through."""
    e = edge
    middle = getattr(e, "centre", None) or (0.0, 0.0)
    turn = getattr(e, "rotation", None) or 0.0
    c, s = np.cos(turn), np.sin(turn)
    dx, dy = x - middle[0], y - middle[1]
    a, b = c * dx + s * dy, -s * dx + c * dy
    kind = e.clear or e.blocks  # type: ignore[attr-defined]
    if kind == "circle":
        inside = (np.hypot(a, b) <= e.radius) & (np.hypot(a, b) >= (e.inner or 0.0))  # type: ignore[attr-defined]
    elif kind == "ray":
        inside = (a >= 0.0) & (np.abs(b) <= 0.5 * e.width)  # type: ignore[attr-defined]
    elif kind in ("rectangle", "ellipse"):
        half = e.half  # type: ignore[attr-defined]
        u, v = np.abs(a) / half[0], np.abs(b) / half[1]
        inside = np.maximum(u, v) <= 1.0 if kind == "rectangle" else np.hypot(u, v) <= 1.0
    else:
        raise ValueError(f"no edge {kind}")
    return np.asarray(inside if e.clear else ~inside)  # type: ignore[attr-defined]
