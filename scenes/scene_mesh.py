"""Triangles of surfaces, which only decide what a path hits; where exactly, the surface itself says."""

from __future__ import annotations

import numpy as np

from optics.aperture import Aperture, Circle
from optics.surface import Surface

CELLS = 10
"""Cells across a curved surface: few, because Mitsuba's search costs most. The triangles of a metre-sized mirror are
then up to a millimetre off; the refinement does not mind."""

MARGIN = 0.01
LEAST_MARGIN = 2e-4
"""How far the triangles reach beyond the clear aperture: share of its half-size, and at least so much, metres. The
chords of the outline and of the surface must not cut a ray off that meets the surface inside its edge."""


def sheet_mesh(surface: Surface, aperture: Aperture) -> tuple[np.ndarray, np.ndarray, float]:
    """Triangles over a clear aperture and a little more.

    Args:
        surface: shape, metres.
        aperture: clear aperture; a hole in it is covered, too.

    Returns:
        Vertices (V, 3) in the surface's frame, metres; triangles (T, 3); largest distance between the triangles and the
        surface, metres.
    """
    cells = 2 if surface.is_plane and not isinstance(aperture, Circle) else CELLS
    x0, x1, y0, y1 = aperture.bounds
    half_x, half_y = 0.5 * (x1 - x0), 0.5 * (y1 - y0)
    half_x, half_y = (max((1.0 + MARGIN) * h, h + LEAST_MARGIN) for h in (half_x, half_y))
    s = np.linspace(-1.0, 1.0, cells + 1)
    u, v = np.meshgrid(s, s)
    if isinstance(aperture, Circle):  # square onto disk, ring by ring
        ring, angle = np.maximum(np.abs(u), np.abs(v)), np.arctan2(v, u)
        u, v = ring * np.cos(angle), ring * np.sin(angle)
    x, y = 0.5 * (x0 + x1) + half_x * u, 0.5 * (y0 + y1) + half_y * v
    z = surface.sag(x, y)
    if not np.all(np.isfinite(z)):
        raise ValueError("a surface ends before its clear aperture does")
    n = cells + 1
    i = (np.arange(cells)[:, None] * n + np.arange(cells)).ravel()
    triangles = np.concatenate([np.stack([i, i + 1, i + n + 1], 1), np.stack([i, i + n + 1, i + n], 1)])
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    middles = 0.5 * (vertices[triangles] + vertices[np.roll(triangles, 1, axis=1)])
    apart = np.abs(surface.sag(middles[..., 0], middles[..., 1]) - middles[..., 2])
    return vertices, triangles, 2.0 * float(np.max(apart))


def polygon_mesh(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A convex polygon (K, 3) as a fan: vertices and triangles."""
    k = np.arange(1, len(corners) - 1)
    return np.asarray(corners), np.stack([np.zeros_like(k), k, k + 1], axis=1)
