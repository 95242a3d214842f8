"""Vector shapes in a plane, with the closed form of their Fourier transforms and their images under smooth maps.

The spectrum of a shape is S(fx, fy) = integral over it of exp(-2 pi i (fx x + fy y)) dx dy, frequencies in cycles/m.
For a polygon with k = 2 pi f, edge vectors d_j, edge midpoints m_j and outward normals n_j (of length |d_j|), Gauss'
theorem gives (e.g. Lee and Mittra, IEEE Trans. Antennas Propag. 31, 99 (1983))

    S = i/|k|^2 sum_j (k . n_j) exp(-i k . m_j) sinc(k . d_j / 2),    sinc(s) = sin(s)/s.

In this form a frequency along an edge is no special case. Only f -> 0 is: see ``Polygon.spectrum``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from optics.numerics.array_math import UnphysicalError

PointMap = Callable[[np.ndarray], np.ndarray]
"""Smooth map of N points (x, y) in a plane, (N, 2) -> (N, 2), metres."""

BEND_TOLERANCE = 1e-9
"""Largest distance between a mapped outline and the shape that represents it, metres: 1/7000 of a 7 um pixel."""

_MOST_PIECES = 4096
"""Largest number of straight parts into which one edge is divided; a map that needs more counts as not smooth."""

_BLOCK = 1 << 14
"""Number of frequencies processed in one block: their arrays stay in the processor's cache."""


@dataclass(frozen=True, eq=False)
class Polygon:
    """Simple polygon (no self-intersection; not checked), of either orientation.

    Attributes
    ----------
    vertices : (V, 2) ndarray
        V vertices in order, metres.

    Raises
    ------
    ValueError
        There are fewer than three vertices, vertices that are not finite, or no area.
    """

    vertices: np.ndarray

    def __post_init__(self) -> None:
        """Check and freeze the vertices."""
        vertices = _frozen(self.vertices)
        if vertices.ndim != 2 or vertices.shape[1] != 2 or len(vertices) < 3:
            raise ValueError(f"a polygon needs vertices of shape (3 or more, 2), found {vertices.shape}")
        if not np.all(np.isfinite(vertices)):
            raise ValueError("a polygon needs finite vertices")
        object.__setattr__(self, "vertices", vertices)
        if not self.area > 1e-14 * float(np.max(np.ptp(vertices, axis=0))) ** 2:
            raise ValueError("a polygon needs an area; its vertices lie on one line")

    @property
    def area(self) -> float:
        """Area, m^2, positive whatever the orientation."""
        return abs(self._signed_area)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Bounding box (x_min, x_max, y_min, y_max), in metres."""
        (x0, y0), (x1, y1) = self.vertices.min(axis=0), self.vertices.max(axis=0)
        return float(x0), float(x1), float(y0), float(y1)

    def spectrum(self, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        """Return the Fourier transform of the polygon, in m^2.

        The sum over the edges loses eps * perimeter / (|k| area) of the area to rounding, with k = 2 pi times the
        frequency and eps the relative rounding error. Because the normals of a closed outline sum to 0, 1 may be
        subtracted from every exp * sinc; where |k| times the polygon's radius is below 1 this is done (with all
        differences in closed form), and the loss stays at eps * perimeter * radius / area down to f = 0.

        Parameters
        ----------
        fx : ndarray
            Frequencies along x, cycles/m, of at most two axes.
        fy : ndarray
            Frequencies along y, cycles/m; they broadcast with ``fx``. A product grid of C by R frequencies, fx (C,) and
            fy (R, 1), is fast: its complex exponentials are computed per axis.

        Returns
        -------
        ndarray
            Complex spectrum of the broadcast shape.
        """
        kx, ky, shape = _wave_numbers(fx, fy)
        (x0, x1, y0, y1) = self.bounds
        middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
        start = self.vertices - middle
        edges = _Edges.of(start, np.sign(self._signed_area))
        radius = float(np.max(np.hypot(start[:, 0], start[:, 1])))
        out: np.ndarray = np.empty(np.broadcast_shapes(kx.shape, ky.shape), complex)
        rows = max(1, _BLOCK // out.shape[1])
        for begin in range(0, len(out), rows):
            block = slice(begin, begin + rows)
            bx, by = (k if len(k) == 1 else k[block] for k in (kx, ky))
            square = bx * bx + by * by
            low = square * radius**2 < 1.0
            square[low] = 1.0
            part = edges.sum(bx, by)
            part *= 1j / square
            if np.any(low):
                lx, ly = (np.broadcast_to(k, low.shape)[low] for k in (bx, by))
                part[low] = edges.sum_near_zero(lx, ly, self.area)
            part *= _phasor(bx, middle[0])
            part *= _phasor(by, middle[1])
            out[block] = part
        return out.reshape(shape)

    def mapped(self, point_map: PointMap, tolerance: float = BEND_TOLERANCE) -> Polygon:
        """Return the polygon under a smooth map; edges are divided only where the map bends them beyond the tolerance.

        Parameters
        ----------
        point_map : callable
            Map of N points (N, 2) -> (N, 2), metres.
        tolerance : float
            Largest distance of the new edges from the mapped ones, metres.

        Raises
        ------
        ValueError
            The map is not finite on the outline, or too rough for the tolerance.
        """
        edge = np.roll(self.vertices, -1, axis=0) - self.vertices

        def outline(t: np.ndarray) -> np.ndarray:
            number = np.floor(t).astype(int)
            return self.vertices[number] + (t - number)[:, None] * edge[number]

        return Polygon(_polyline(outline, len(edge), point_map, tolerance))

    @property
    def _signed_area(self) -> float:
        x, y = (self.vertices - self.vertices[0]).T
        return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


@dataclass(frozen=True, eq=False)
class Disk:
    """Disk or ellipse: the points centre + radius * linear_map @ p, with p all points of the unit disk.

    Attributes
    ----------
    centre : (2,) ndarray
        Centre, metres.
    radius : float
        Radius before the linear map ``linear_map``, metres.
    linear_map : (2, 2) ndarray
        Linear map of the disk; the unit matrix for a circle.

    Raises
    ------
    ValueError
        The radius is not positive, or the linear map has no inverse.
    """

    centre: np.ndarray
    radius: float
    linear_map: np.ndarray = field(default_factory=lambda: np.eye(2))

    def __post_init__(self) -> None:
        """Freeze the arrays, and check that the radius is positive and the linear map has an inverse."""
        object.__setattr__(self, "centre", _vector(self.centre, "the centre of a disk"))
        object.__setattr__(self, "linear_map", _frozen(self.linear_map))
        if not (np.isfinite(self.radius) and self.radius > 0.0):
            raise ValueError(f"a disk needs a positive radius, found {self.radius}")
        if self.linear_map.shape != (2, 2) or not self.area > 0.0:
            raise ValueError("a disk needs a linear map of shape (2, 2) that has an inverse")

    @property
    def area(self) -> float:
        """Area of the disk or ellipse, m^2."""
        return float(np.pi * self.radius**2 * abs(np.linalg.det(self.linear_map)))

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Bounding box (x_min, x_max, y_min, y_max), in metres."""
        (x, y), (hx, hy) = self.centre, self.radius * np.hypot(self.linear_map[:, 0], self.linear_map[:, 1])
        return float(x - hx), float(x + hx), float(y - hy), float(y + hy)

    def spectrum(self, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        """Return the Fourier transform of the disk or ellipse, in m^2.

        It is area * 2 J1(q)/q with q = |radius linear_map^T k|, where k is 2 pi times the frequency and J1 a Bessel
        function.

        Parameters
        ----------
        fx : ndarray
            Frequencies along x, cycles/m, of at most two axes.
        fy : ndarray
            Frequencies along y, cycles/m; they broadcast with ``fx``.
        """
        # imported late: scipy takes 0.1 s, and commands that only check files import this module
        from scipy.special import j1

        kx, ky, shape = _wave_numbers(fx, fy)
        (a, b), (c, d) = self.radius * self.linear_map
        # the offset matters at q = 0 only, where 2 J1(q)/q becomes 1
        q = np.hypot(a * kx + c * ky, b * kx + d * ky) + 1e-300
        out = (2.0 * self.area * j1(q) / q) * _phasor(kx, self.centre[0])
        out *= _phasor(ky, self.centre[1])
        return np.asarray(out).reshape(shape)

    def mapped(self, point_map: PointMap, tolerance: float = BEND_TOLERANCE) -> Disk | Polygon:
        """Return the ellipse nearest to the disk's rim under a smooth map, or a polygon if no ellipse is close enough.

        Parameters
        ----------
        point_map : callable
            Map of N points (N, 2) -> (N, 2), metres.
        tolerance : float
            Largest distance of the new rim from the mapped one, metres.

        Raises
        ------
        ValueError
            The map is not finite on the rim, or too rough for the tolerance.
        """

        def rim(t: np.ndarray) -> np.ndarray:
            angle = 2.0 * np.pi / _RIM_POINTS * t
            return self.centre + self.radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ self.linear_map.T

        t = np.arange(float(_RIM_POINTS))
        wave = 2.0 * np.pi / _RIM_POINTS * t
        harmonics = np.stack([np.ones_like(t), np.cos(wave), np.sin(wave)])
        mapped_rim = _apply(point_map, rim(t))
        centre, cosine, sine = harmonics @ mapped_rim / np.sum(harmonics**2, axis=1)[:, None]
        residual = mapped_rim - harmonics.T @ np.stack([centre, cosine, sine])
        if np.max(np.hypot(residual[:, 0], residual[:, 1])) <= tolerance:
            return Disk(centre, self.radius, np.stack([cosine, sine], axis=-1) / self.radius)
        return Polygon(_polyline(rim, _RIM_POINTS, point_map, tolerance))


_RIM_POINTS = 32
"""Number of rim points of a disk at which a map is tested for departure from an ellipse."""


@dataclass(frozen=True, eq=False)
class HalfPlane:
    """Half-plane: all points x with normal . (x - point) > 0.

    Attributes
    ----------
    point : (2,) ndarray
        Point on the edge, metres, at which the edge keeps position and direction under a map.
    normal : (2,) ndarray
        Normal toward the inside; normalised to a unit vector.

    Raises
    ------
    ValueError
        The normal is zero.
    """

    point: np.ndarray
    normal: np.ndarray

    def __post_init__(self) -> None:
        """Freeze the arrays, check that the normal is not zero, and scale it to unit length."""
        object.__setattr__(self, "point", _vector(self.point, "the point of a half plane"))
        normal = _vector(self.normal, "the normal of a half plane")
        length = float(np.hypot(*normal))
        if not length > 0.0:
            raise ValueError("a half plane needs a normal that is not 0")
        object.__setattr__(self, "normal", _frozen(normal / length))

    def distance(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the distance of points from the edge, metres, positive inside; x and y broadcast."""
        return np.asarray(self.normal[0] * (x - self.point[0]) + self.normal[1] * (y - self.point[1]))

    def mapped(self, point_map: PointMap, step: float = 1e-5) -> HalfPlane:
        """Return the half-plane whose edge is tangent to the mapped edge at the mapped point.

        Parameters
        ----------
        point_map : callable
            Map of N points (N, 2) -> (N, 2), metres.
        step : float
            Step along the edge and its normal over which the map is differentiated (central differences), metres.

        Raises
        ------
        ValueError
            The map is not finite or not invertible at the point.
        """
        along = np.array([-self.normal[1], self.normal[0]])
        steps = step * np.array([np.zeros(2), along, -along, self.normal, -self.normal])
        point, ahead, behind, inside, outside = _apply(point_map, self.point + steps)
        tangent, inward = ahead - behind, inside - outside
        normal = np.array([tangent[1], -tangent[0]])
        orientation = float(normal @ inward)
        if orientation == 0.0:
            raise UnphysicalError("the map has no inverse at the half plane's point")
        return HalfPlane(point, np.sign(orientation) * normal)


FiniteShape = Polygon | Disk
Shape = Polygon | Disk | HalfPlane


@dataclass(frozen=True, eq=False)
class _Edges:
    """V edges of a polygon: midpoints, edge vectors, and outward normals as long as the edges, (V, 2) each, metres."""

    middle: np.ndarray
    vector: np.ndarray
    normal: np.ndarray

    @classmethod
    def of(cls, start: np.ndarray, orientation: float) -> _Edges:
        """Return the edges of a closed outline from its V corners (V, 2).

        ``orientation`` is +1 for counterclockwise corners, -1 for clockwise ones.
        """
        vector = np.roll(start, -1, axis=0) - start
        return cls(start + 0.5 * vector, vector, orientation * np.stack([vector[:, 1], -vector[:, 0]], axis=-1))

    def sum(self, kx: np.ndarray, ky: np.ndarray) -> np.ndarray:
        """Return the sum over the edges of (k . n) exp(-i k . m) sinc(k . d/2), for each wave vector k, in rad/m.

        n is the outward normal of an edge, m its midpoint and d its vector, in metres; ``kx`` and ``ky`` are the
        components of k: (1, C) and (R, 1) for a grid of C columns and R rows, or both of one shape.
        """
        total = np.zeros(np.broadcast_shapes(kx.shape, ky.shape), complex)
        for m, d, n in zip(self.middle, self.vector, self.normal, strict=True):
            half = 0.5 * d[0] * kx + 0.5 * d[1] * ky
            half += 1e-300  # matters at 0 only, where sin(s)/s becomes 1
            share = np.sin(half)
            share /= half
            share *= n[0] * kx + n[1] * ky
            wave = _phasor(kx, m[0]) * _phasor(ky, m[1])
            wave *= share
            total += wave
        return total

    def sum_near_zero(self, kx: np.ndarray, ky: np.ndarray, area: float) -> np.ndarray:
        """Return the spectrum of the outline for M wave vectors k near zero, without loss of digits, m^2.

        It is i/|k|^2 times the sum over the edges of (k . n) (exp(-i k . m) sinc(k . d/2) - 1), with n the outward
        normal of an edge, m its midpoint and d its vector; ``kx`` and ``ky`` (M,) are in rad/m.
        """
        size = np.hypot(kx, ky)
        safe = np.where(size == 0.0, 1.0, size)
        ux, uy = kx / safe, ky / safe
        total = np.zeros(kx.shape, complex)
        for m, d, n in zip(self.middle, self.vector, self.normal, strict=True):
            phase = kx * m[0] + ky * m[1]
            less = _sinc_less_one(0.5 * (kx * d[0] + ky * d[1]))
            wave = -2.0 * np.sin(0.5 * phase) ** 2 - 1j * np.sin(phase)
            total += (ux * n[0] + uy * n[1]) * (wave * (1.0 + less) + less)
        return np.asarray(np.where(size == 0.0, area, 1j * total / safe))


def _sinc_less_one(s: np.ndarray) -> np.ndarray:
    """Return sin(s)/s - 1 for |s| <= 1, by its power series to s^18, which avoids cancellation."""
    square = s * s
    total = np.ones_like(s)
    for n in range(18, 3, -2):
        total = 1.0 - square / (n * (n + 1)) * total
    return np.asarray(-square / 6.0 * total)


def _phasor(k: np.ndarray, position: float) -> np.ndarray:
    """Return exp(-i k x) for wave numbers k, rad/m, at x = ``position``, metres."""
    phase = k * -position
    out = np.empty(phase.shape, complex)
    np.cos(phase, out=out.real)
    np.sin(phase, out=out.imag)
    return out


def _wave_numbers(fx: np.ndarray, fy: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
    """Return wave numbers 2 pi fx and 2 pi fy, rad/m, as arrays of two axes, and the shape of the result."""
    fx, fy = np.asarray(fx, float), np.asarray(fy, float)
    shape = np.broadcast_shapes(fx.shape, fy.shape)
    if len(shape) > 2:
        raise ValueError(f"frequencies have at most two axes, found {len(shape)}")
    return 2.0 * np.pi * np.atleast_2d(fx), 2.0 * np.pi * np.atleast_2d(fy), shape


def _polyline(
    curve: Callable[[np.ndarray], np.ndarray], spans: int, point_map: PointMap, tolerance: float
) -> np.ndarray:
    """Return N points (N, 2) on the image of a closed curve, close enough for chords within the tolerance (metres).

    ``curve`` maps the parameter 0 <= t < ``spans`` to points and is smooth between integer t. Each span is divided
    evenly into as few parts as its curvature requires; a chord's distance from the curve falls with the square of their
    number. It is measured at three points, because a curve with an inflection crosses its chord in the middle.
    """
    if not tolerance > 0.0:
        raise ValueError(f"the tolerance must be positive, found {tolerance}")
    pieces = np.ones(spans, int)
    probes = np.array([0.0, 0.25, 0.5, 0.75])
    while True:
        first = np.concatenate([[0], np.cumsum(pieces)[:-1]])
        number = np.repeat(np.arange(spans), pieces)
        step = np.arange(len(number)) - first[number]
        t = number[:, None] + (step[:, None] + probes) / pieces[number, None]
        mapped = _apply(point_map, curve(t.ravel())).reshape(len(number), len(probes), 2)
        corners = mapped[:, 0]
        chord = np.roll(corners, -1, axis=0) - corners
        offset = mapped[:, 1:] - corners[:, None]
        length = np.hypot(chord[:, 0], chord[:, 1])[:, None]
        across = np.abs(chord[:, None, 0] * offset[..., 1] - chord[:, None, 1] * offset[..., 0])
        deviation = np.where(
            length > 0.0, across / np.where(length > 0.0, length, 1.0), np.hypot(offset[..., 0], offset[..., 1])
        )
        bend = np.maximum.reduceat(np.max(deviation, axis=1), first)
        if np.all(bend <= tolerance):
            return corners
        refined = np.maximum(pieces + 1, np.ceil(pieces * np.sqrt(bend / tolerance)))
        if np.max(refined[bend > tolerance]) > _MOST_PIECES:
            raise UnphysicalError(f"the map bends an edge too much for a tolerance of {tolerance:.3g} m")
        pieces = np.where(bend > tolerance, refined, pieces).astype(int)


def _apply(point_map: PointMap, points: np.ndarray) -> np.ndarray:
    """Return the images (N, 2) of N points under a map, after checks that they have this shape and are finite."""
    mapped = np.asarray(point_map(points), float)
    if mapped.shape != points.shape:
        raise ValueError(f"the map must take (N, 2) to (N, 2), but took {points.shape} to {mapped.shape}")
    if not np.all(np.isfinite(mapped)):
        raise UnphysicalError("the map gives points that are not finite; the target may extend beyond the field")
    return mapped


def _vector(value: np.ndarray, name: str) -> np.ndarray:
    """Return a read-only vector (2,), after checking shape and finiteness."""
    out = _frozen(value)
    if out.shape != (2,) or not np.all(np.isfinite(out)):
        raise ValueError(f"{name} needs two finite numbers, found {value}")
    return out


def _frozen(value: np.ndarray) -> np.ndarray:
    """Return a read-only float copy."""
    out = np.array(value, float)
    out.setflags(write=False)
    return out
