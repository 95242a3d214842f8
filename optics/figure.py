"""Surface figure: a departure from the ideal surface, measured along the surface's z (metres of sag)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter

from optics import zernike
from optics.frozen_map import FrozenMap


@dataclass(frozen=True)
class ZernikeFigure:
    """Sag error sum a_j Z_j((x - cx)/radius, (y - cy)/radius), Noll order, a_j = rms over the disk in metres.

    Terms may be perturbed per state (``Motion.figure``); the disk stays.
    """

    radius: float
    centre: tuple[float, float] = (0.0, 0.0)
    terms: Mapping[int, float] = field(default_factory=FrozenMap)

    def __post_init__(self) -> None:
        """Freeze the terms."""
        if not self.radius > 0.0:
            raise ValueError(f"a figure needs a positive radius, found {self.radius}")
        object.__setattr__(self, "terms", FrozenMap({int(k): float(v) for k, v in self.terms.items()}))

    def sag(self, x: Any, y: Any) -> np.ndarray:
        """Sag error at x, y (metres), NumPy."""
        u = (np.asarray(x) - self.centre[0]) / self.radius
        v = (np.asarray(y) - self.centre[1]) / self.radius
        return np.asarray(sum((a * zernike.zernike(j, u, v) for j, a in self.terms.items()), np.zeros_like(u)))


@dataclass(frozen=True, eq=False)
class GridFigure:
    """Sag error on a regular grid, interpolated by a cubic B-spline (twice continuously differentiable).

    Attributes:
        values: sag error in metres, shape (rows along y, columns along x), at least 4 x 4.
        bounds: x_min, x_max, y_min, y_max of the first and last samples, metres. The spline arrives at its edges with
            zero slope (mirror condition) and stays at the edge's value outside: give a grid that reaches a few samples
            beyond the clear aperture.
    """

    values: np.ndarray
    bounds: tuple[float, float, float, float]

    def __post_init__(self) -> None:
        """Copy, freeze and check."""
        values = np.array(self.values, dtype=np.float64)
        if values.ndim != 2 or min(values.shape) < 4 or not np.all(np.isfinite(values)):
            raise ValueError("a grid figure needs a finite array of at least 4 x 4 values")
        x0, x1, y0, y1 = self.bounds
        if not (x1 > x0 and y1 > y0):
            raise ValueError(f"a grid figure needs x_min < x_max and y_min < y_max, found {self.bounds}")
        values.setflags(write=False)
        object.__setattr__(self, "values", values)

    @cached_property
    def spline(self) -> np.ndarray:
        """B-spline coefficients with a mirrored margin of two samples on every side, shape (rows + 4, columns + 4)."""
        coefficients = spline_filter(self.values, order=3, mode="mirror")
        return np.pad(coefficients, 2, mode="reflect")

    @property
    def spacing(self) -> tuple[float, float]:
        """Sample distance along x and y, metres."""
        x0, x1, y0, y1 = self.bounds
        return (x1 - x0) / (self.values.shape[1] - 1), (y1 - y0) / (self.values.shape[0] - 1)

    def sag(self, x: Any, y: Any) -> np.ndarray:
        """Sag error at x, y (metres), NumPy."""
        dx, dy = self.spacing
        column = (np.asarray(x) - self.bounds[0]) / dx
        row = (np.asarray(y) - self.bounds[2]) / dy
        rows, columns = self.values.shape
        place = [np.clip(row, 0.0, rows - 1.0), np.clip(column, 0.0, columns - 1.0)]
        return np.asarray(map_coordinates(self.values, place, order=3, mode="mirror"))


Figure = ZernikeFigure | GridFigure
