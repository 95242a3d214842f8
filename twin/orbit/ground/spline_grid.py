"""A function of east and north on a regular grid, as the cubic B-spline of the grid's numbers: one definite function,
twice continuously differentiable, for everyone who asks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.sparse import csr_array

Beyond = Literal["mirror", "grid-wrap", "nothing"]


@dataclass(frozen=True, eq=False)
class SplineGrid:
    """A cubic B-spline over a grid.

    Attributes:
        coefficients: weights of the B-splines, (rows, columns); rows go north, columns east.
        spacing: of the grid east and north, metres.
        first: east and north of the first row's first column, metres.
        beyond: how it goes on outside: mirrored about the outer rows and columns, repeated, or not at all.
    """

    coefficients: np.ndarray
    spacing: tuple[float, float]
    first: tuple[float, float]
    beyond: Beyond = "nothing"

    @property
    def reach(self) -> tuple[float, float, float, float]:
        """West, east, south and north end of where it is known, metres, if nothing is beyond."""
        (rows, columns), (east, north) = self.coefficients.shape, self.first
        # a place needs one B-spline before its cell and two after
        return (
            east + self.spacing[0],
            east + (columns - 2) * self.spacing[0],
            north + self.spacing[1],
            north + (rows - 2) * self.spacing[1],
        )

    def __call__(self, east: np.ndarray, north: np.ndarray) -> np.ndarray:
        """Values at places, metres, any equal shapes.

        Raises:
            ValueError: a place outside, where nothing is.
        """
        if self.beyond == "nothing":
            self._require_inside(east, north)
        row = (north - self.first[1]) / self.spacing[1]
        column = (east - self.first[0]) / self.spacing[0]
        mode = "nearest" if self.beyond == "nothing" else self.beyond
        return np.asarray(
            map_coordinates(self.coefficients, [row, column], order=3, prefilter=False, mode=mode, output=np.float64)
        )

    def on_grid(self, east: np.ndarray, north: np.ndarray, derivative: tuple[int, int] = (0, 0)) -> np.ndarray:
        """Values, or first derivatives, on a regular grid: east (E,) and north (N,), metres -> (N, E).

        Args:
            east: of the columns.
            north: of the rows.
            derivative: how often by east and by north, 0 or 1.

        Raises:
            ValueError: a place outside, where nothing is.
        """
        if self.beyond == "nothing":
            self._require_inside(east, north)
        rows, columns = self.coefficients.shape
        along = (
            self._weights((east - self.first[0]) / self.spacing[0], columns, derivative[0])
            / self.spacing[0] ** derivative[0]
        )
        across = (
            self._weights((north - self.first[1]) / self.spacing[1], rows, derivative[1])
            / self.spacing[1] ** derivative[1]
        )
        return np.asarray((along @ (across @ self.coefficients).T).T)

    def _weights(self, place: np.ndarray, count: int, derivative: int) -> csr_array:
        """Matrix from the coefficients along one axis to values at places in cells, (places, count)."""
        cell = np.floor(place).astype(np.intp)
        t = (place - cell)[:, None]
        if derivative:
            weight = np.hstack([-0.5 * (1.0 - t) ** 2, 1.5 * t**2 - 2.0 * t, 0.5 + t - 1.5 * t**2, 0.5 * t**2])
        else:
            s = 1.0 - t
            parts = [s**3 / 6.0, 2.0 / 3.0 - t**2 + 0.5 * t**3, 2.0 / 3.0 - s**2 + 0.5 * s**3, t**3 / 6.0]
            weight = np.hstack(parts)
        column = cell[:, None] + np.arange(-1, 3)
        if self.beyond == "grid-wrap":
            column %= count
        else:
            column %= 2 * (count - 1)
            column = np.minimum(column, 2 * (count - 1) - column)
        row = np.repeat(np.arange(len(place)), 4)
        return csr_array((weight.ravel(), (row, column.ravel())), shape=(len(place), count))

    def _require_inside(self, east: np.ndarray, north: np.ndarray) -> None:
        west_end, east_end, south_end, north_end = self.reach
        if not (
            np.min(east) >= west_end
            and np.max(east) <= east_end
            and np.min(north) >= south_end
            and np.max(north) <= north_end
        ):
            raise ValueError(
                f"ground beyond what is known: east {np.min(east):.0f} to {np.max(east):.0f} m, north "
                f"{np.min(north):.0f} to {np.max(north):.0f} m; it reaches from {west_end:.0f} to {east_end:.0f} m and "
                f"from {south_end:.0f} to {north_end:.0f} m"
            )
