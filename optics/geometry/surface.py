"""Optical surfaces: ideal shape and figure error, as NumPy functions and as equation G = 0 in Dr.Jit kernels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from optics.geometry import zernike
from optics.geometry.aperture import Aperture
from optics.geometry.sag_terms import SagTerm, scaled_term
from optics.geometry.zernike import triangle_order, triangle_polynomial
from optics.numerics.number_tree import FrozenMap


@dataclass(frozen=True)
class ZernikeFigure:
    """Sag error in metres as a sum of Zernike polynomials, a_j Z_j((x - cx)/radius, (y - cy)/radius).

    j is the Noll index and a_j the rms over the disk of ``radius`` about (cx, cy), in metres. A state may change the
    terms (``Motion.figure``); the disk is fixed.
    """

    radius: float
    centre: tuple[float, float] = (0.0, 0.0)
    terms: Mapping[int, float] = field(default_factory=FrozenMap)

    def __post_init__(self) -> None:
        """Make the mapping of Zernike terms immutable."""
        if not self.radius > 0.0:
            raise ValueError(f"a figure needs a positive radius, found {self.radius}")
        object.__setattr__(self, "terms", FrozenMap({int(k): float(v) for k, v in self.terms.items()}))

    def numbers(self, order: int) -> FigureNumbers:
        """Return the figure as a polynomial in x and y of degree ``order``, at least the figure's own radial order."""
        return FigureNumbers(*self.centre, tuple(zernike.monomials(self.terms, order, self.radius)))

    @property
    def order(self) -> int:
        """Highest radial order of the Zernike terms; -1 without terms."""
        return zernike.order_of(self.terms)

    def sag(self, x: Any, y: Any) -> np.ndarray:
        """Return the sag error at x, y, in metres (NumPy arrays)."""
        u = (np.asarray(x) - self.centre[0]) / self.radius
        v = (np.asarray(y) - self.centre[1]) / self.radius
        return np.asarray(sum((a * zernike.zernike(j, u, v) for j, a in self.terms.items()), np.zeros_like(u)))


@dataclass(frozen=True, eq=False)
class GridFigure:
    """Sag error on a regular grid, interpolated by a cubic B-spline (twice continuously differentiable).

    Attributes
    ----------
    values : ndarray
        Sag error in metres, shape (rows along y, columns along x), at least 4 x 4.
    bounds : tuple of float
        (x_min, x_max, y_min, y_max) of the first and last samples, metres. The spline reaches its edges with zero slope
        (mirror condition) and is constant outside: use a grid that extends a few samples beyond the clear aperture.
    """

    values: np.ndarray
    bounds: tuple[float, float, float, float]

    def __post_init__(self) -> None:
        """Copy and freeze the values, and check their shape and bounds."""
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
        # imported late: scipy takes 0.25 s, and commands that only check files import this module
        from scipy.ndimage import spline_filter

        coefficients = spline_filter(self.values, order=3, mode="mirror")
        return np.pad(coefficients, 2, mode="reflect")

    @property
    def numbers(self) -> GridNumbers:
        """Position, spacing and size of the grid, for a kernel whose table begins with the coefficients ``spline``."""
        dx, dy = self.spacing
        rows, columns = self.values.shape
        return GridNumbers(self.bounds[0], self.bounds[2], 1.0 / dx, 1.0 / dy, float(columns), float(rows), 0.0)

    def plus(self, other: GridFigure) -> GridFigure:
        """Return the exact sum of two figures that are given at the same samples.

        Raises
        ------
        ValueError
            The two figures have different samples.
        """
        if self.bounds != other.bounds or self.values.shape != other.values.shape:
            raise ValueError(
                "two grid figures of one surface have different samples; resample one on the grid of the other"
            )
        return GridFigure(self.values + other.values, self.bounds)

    def sampled_as(self, other: GridFigure) -> GridFigure:
        """Return the figure interpolated at the samples of the grid ``other``."""
        x0, x1, y0, y1 = other.bounds
        rows, columns = other.values.shape
        x, y = np.meshgrid(np.linspace(x0, x1, columns), np.linspace(y0, y1, rows))
        return GridFigure(self.sag(x, y), other.bounds)

    @property
    def spacing(self) -> tuple[float, float]:
        """Sample distance along x and y, metres."""
        x0, x1, y0, y1 = self.bounds
        return (x1 - x0) / (self.values.shape[1] - 1), (y1 - y0) / (self.values.shape[0] - 1)

    def sag(self, x: Any, y: Any) -> np.ndarray:
        """Return the sag error at x, y, in metres (NumPy arrays)."""
        # imported late, as in ``spline``
        from scipy.ndimage import map_coordinates

        dx, dy = self.spacing
        column = (np.asarray(x) - self.bounds[0]) / dx
        row = (np.asarray(y) - self.bounds[2]) / dy
        rows, columns = self.values.shape
        coordinates = [np.clip(row, 0.0, rows - 1.0), np.clip(column, 0.0, columns - 1.0)]
        return np.asarray(map_coordinates(self.values, coordinates, order=3, mode="mirror"))


@dataclass(frozen=True, eq=False)
class SummedFigure:
    """Figure error of a deformed mirror: the sum of Zernike terms and a sampled grid."""

    terms: ZernikeFigure
    grid: GridFigure

    def sag(self, x: Any, y: Any) -> np.ndarray:
        """Return the sag error at x, y, in metres (NumPy arrays)."""
        return self.terms.sag(x, y) + self.grid.sag(x, y)


Figure = ZernikeFigure | GridFigure | SummedFigure


@dataclass(frozen=True, eq=False)
class FigureNumbers:
    """Figure as a polynomial: sum of c_ab x^a y^b about a centre, with lengths in metres.

    The coefficients c_ab are ordered by ``zernike.triangle_index``.
    """

    x: Any
    y: Any
    coefficients: tuple[Any, ...]

    @property
    def order(self) -> int:
        """Highest degree a + b of the terms x^a y^b."""
        return triangle_order(len(self.coefficients))


@dataclass(frozen=True, eq=False)
class GridNumbers:
    """Sampling of a ``GridFigure`` in a kernel.

    Attributes
    ----------
    x, y : float or array
        Position of the first samples, metres.
    per_x, per_y : float or array
        Samples per metre.
    columns, rows : float or array
        Number of samples along x and y.
    first : float or array
        Index of the first coefficient in the table.
    """

    x: Any
    y: Any
    per_x: Any
    per_y: Any
    columns: Any
    rows: Any
    first: Any


@dataclass(frozen=True, eq=False)
class SurfaceNumbers:
    """Numbers of a surface in kernels, or arrays of them for many surfaces of the same form.

    A field that is None or empty adds no code to the kernel that ``level`` makes.

    Attributes
    ----------
    curvature, conic : float or array, optional
        Curvature c, 1/m, and conic constant k; None for a plane.
    even : tuple
        A4, A6, ..., in m^-3, m^-5, ...
    terms : tuple of SagTerm
        Further terms of the sag, at most one of each kind.
    figure, grid : FigureNumbers and GridNumbers, optional
        Figure error as a polynomial and on a grid.
    """

    curvature: Any = None
    conic: Any = None
    even: tuple[Any, ...] = ()
    terms: tuple[SagTerm, ...] = ()
    figure: FigureNumbers | None = None
    grid: GridNumbers | None = None

    @property
    def is_conic(self) -> bool:
        """True for a pure conic or plane, whose intersection with a ray has a closed form."""
        return not self.even and not self.terms and self.figure is None and self.grid is None


def level(
    x: Any, y: Any, z: Any, surface: SurfaceNumbers, table: Any = None, active: Any = True
) -> tuple[Any, Any, Any, Any]:
    """Return the function G(x, y, z) that is zero on a surface, and its gradient, on Dr.Jit arrays.

    With c the curvature and k the conic constant of the surface, h the sum of all terms beyond the conic and of the
    figure, and w = z - h(x, y), the surface is where

        G = w - c/2 (x^2 + y^2 + (1 + k) w^2) = 0,

    the equation of the conic in w, without square root or division. G > 0 on the +z side; dG/dw = 1 - (1 + k) c w is
    positive on the sheet of the vertex.

    Parameters
    ----------
    x, y, z : Dr.Jit float
        Points in the surface's frame, metres.
    surface : SurfaceNumbers
        Numbers of the surface.
    table : Dr.Jit float, optional
        Spline coefficients of grid figures.
    active : Dr.Jit bool
        Mask of the points that matter; the table is not read elsewhere.

    Returns
    -------
    tuple
        G, metres, and its derivatives with respect to x, y and z.
    """
    import drjit as dr

    height: Any = None
    sx: Any = None
    sy: Any = None
    r2 = dr.fma(x, x, y * y)
    if surface.even:
        # h and dh/d(r^2) of sum A_n r^(2n+4) by Horner, from the highest term down
        last = len(surface.even) - 1
        polynomial: Any = surface.even[last]
        slope: Any = float(last + 2) * surface.even[last]
        for n in range(last - 1, -1, -1):
            polynomial = dr.fma(polynomial, r2, surface.even[n])
            slope = dr.fma(slope, r2, float(n + 2) * surface.even[n])
        radial = 2.0 * slope * r2
        height, sx, sy = polynomial * r2 * r2, radial * x, radial * y
    for term in surface.terms:
        added = term.height(x, y)
        height, sx, sy = added if height is None else (height + added[0], sx + added[1], sy + added[2])
    if surface.figure is not None:
        figure = surface.figure
        added = triangle_polynomial(x - figure.x, y - figure.y, figure.coefficients, figure.order)
        height, sx, sy = added if height is None else (height + added[0], sx + added[1], sy + added[2])
    if surface.grid is not None:
        added = grid_figure(x, y, surface.grid, table, active)
        height, sx, sy = added if height is None else (height + added[0], sx + added[1], sy + added[2])
    w = z if height is None else z - height
    if surface.curvature is None:
        return w, (0.0 * x if sx is None else -sx), (0.0 * x if sy is None else -sy), 1.0 + 0.0 * x
    c = surface.curvature
    qw = (1.0 + surface.conic) * w
    value = dr.fma(-0.5 * c, dr.fma(qw, w, r2), w)
    nz = dr.fma(-c, qw, 1.0)
    nx, ny = -c * x, -c * y
    if sx is not None:
        nx, ny = dr.fma(-nz, sx, nx), dr.fma(-nz, sy, ny)
    return value, nx, ny, nz


def newton_step(p: Any, d: Any, t: Any, surface: SurfaceNumbers, table: Any = None, active: Any = True) -> Any:
    """Return the distances from points along rays to a surface, improved by one Newton step.

    Parameters
    ----------
    p, d : Dr.Jit vector
        Points in the surface's frame, metres, and unit directions.
    t : Dr.Jit float
        Distances so far, metres.
    surface : SurfaceNumbers
        Numbers of the surface.
    table : Dr.Jit float, optional
        Spline coefficients of grid figures.
    active : Dr.Jit bool
        Mask of the rays that matter; the table is not read elsewhere.
    """
    import drjit as dr

    value, nx, ny, nz = level(*along(p, d, t), surface, table, active)
    return t - value / dr.fma(nx, d.x, dr.fma(ny, d.y, nz * d.z))


def along(p: Any, d: Any, t: Any) -> tuple[Any, Any, Any]:
    """Return the coordinates x, y, z of the point at distance t from p in direction d: p + t d."""
    import drjit as dr

    return dr.fma(t, d.x, p.x), dr.fma(t, d.y, p.y), dr.fma(t, d.z, p.z)


def grid_figure(x: Any, y: Any, grid: GridNumbers, table: Any, active: Any = True) -> tuple[Any, Any, Any]:
    """Return the cubic B-spline of a ``GridFigure`` at points x, y (metres), and its derivatives along x and y.

    ``table`` holds the coefficients of the padded grid, row by row.
    """
    import drjit as dr

    float_type = type(x)
    index_type = dr.uint32_array_t(float_type)
    columns, rows = grid.columns, grid.rows
    u = dr.clip((x - grid.x) * grid.per_x, 0.0, columns - 1.0)
    v = dr.clip((y - grid.y) * grid.per_y, 0.0, rows - 1.0)
    iu = dr.minimum(dr.floor(u), columns - 2.0)
    iv = dr.minimum(dr.floor(v), rows - 2.0)
    wu, du = _weights(u - iu)
    wv, dv = _weights(v - iv)
    width = index_type(columns + 4.0)
    # the table has a margin of two samples on every side, so that sample -1 of the stencil has index 1
    start = (index_type(iv) + 1) * width + index_type(iu) + 1 + index_type(grid.first)
    height: Any = 0.0 * x
    slope_x: Any = 0.0 * x
    slope_y: Any = 0.0 * x
    for j in range(4):
        row: Any = 0.0 * x
        row_slope: Any = 0.0 * x
        for i in range(4):
            c = dr.gather(float_type, table, start + j * width + i, active)
            row = row + wu[i] * c
            row_slope = row_slope + du[i] * c
        height = height + wv[j] * row
        slope_x = slope_x + wv[j] * row_slope
        slope_y = slope_y + dv[j] * row
    return height, slope_x * grid.per_x, slope_y * grid.per_y


def _weights(f: Any) -> tuple[list[Any], list[Any]]:
    """Return the cubic B-spline weights of the four samples -1, 0, 1, 2 at a position f, and their derivatives.

    f lies between 0 and 1.
    """
    e = 1.0 - f
    values = [
        e * e * e / 6.0,
        2.0 / 3.0 - f * f * (2.0 - f) / 2.0,
        2.0 / 3.0 - e * e * (2.0 - e) / 2.0,
        f * f * f / 6.0,
    ]
    slopes = [-0.5 * e * e, f * (1.5 * f - 2.0), -e * (1.5 * e - 2.0), 0.5 * f * f]
    return values, slopes


@dataclass(frozen=True)
class Surface:
    """Surface z = c r^2 / (1 + sqrt(1 - (1+k) c^2 r^2)) + A4 r^4 + A6 r^6 + ... + further terms + figure.

    Attributes
    ----------
    curvature : float
        Vertex curvature c = 1/R, 1/m; 0 is a plane. Positive: centre of curvature on the +z side.
    conic : float
        Conic constant k (0 sphere, -1 paraboloid).
    even : tuple of float
        Even aspheric coefficients (A4, A6, A8, ...), in m^-3, m^-5, m^-7, ...
    figure : ZernikeFigure, GridFigure or SummedFigure, optional
        Departure from that shape.
    terms : tuple of SagTerm
        Further terms of the sag (``optics.geometry.sag_terms``), at most one of each kind; without them the ideal shape
        is rotationally symmetric.
    """

    curvature: float = 0.0
    conic: float = 0.0
    even: tuple[float, ...] = ()
    figure: Figure | None = None
    terms: tuple[SagTerm, ...] = ()

    def __post_init__(self) -> None:
        """Check that there is at most one term of each kind."""
        if len({type(term) for term in self.terms}) < len(self.terms):
            raise ValueError("a surface has two sag terms of the same kind; add their coefficients")

    @property
    def is_plane(self) -> bool:
        """True when the ideal shape, without its figure error, is flat."""
        return self.curvature == 0.0 and not any(self.even) and not self.terms

    @property
    def zernike_figure(self) -> ZernikeFigure | None:
        """Zernike part of the figure error, or None without one."""
        if isinstance(self.figure, SummedFigure):
            return self.figure.terms
        return self.figure if isinstance(self.figure, ZernikeFigure) else None

    @property
    def grid_figure(self) -> GridFigure | None:
        """Part of the figure error that is given on a grid, or None without one."""
        if isinstance(self.figure, SummedFigure):
            return self.figure.grid
        return self.figure if isinstance(self.figure, GridFigure) else None

    def with_figure(self, figure: Figure | None) -> Surface:
        """Return a surface of the same ideal shape with ``figure`` instead of its own figure; None removes it."""
        return replace(self, figure=figure)

    def scaled(self, scale: float) -> Surface:
        """Return the surface with all lengths multiplied by ``scale``, but the same figure error."""
        even = tuple(a / scale ** (2 * n + 3) for n, a in enumerate(self.even))
        terms = tuple(scaled_term(term, scale) for term in self.terms)
        return replace(self, curvature=self.curvature / scale, even=even, terms=terms)

    def figure_disk(self, aperture: Aperture | None) -> ZernikeFigure:
        """Return the Zernike figure whose disk a state's Zernike terms refer to.

        It is the surface's own, or one without terms over the smallest circle that encloses the aperture.

        Raises
        ------
        ValueError
            There is neither a Zernike figure nor an aperture to define the disk.
        """
        if self.zernike_figure is not None:
            return self.zernike_figure
        if aperture is None:
            raise ValueError("a surface without an aperture has no disk for a figure")
        disk = aperture.enclosing
        return ZernikeFigure(disk.radius, disk.centre)

    def sag(self, x: Any, y: Any) -> np.ndarray:
        """Return the height z at x, y (metres, any shape); NaN outside the conic's domain."""
        x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        r2 = x * x + y * y
        with np.errstate(invalid="ignore"):
            z = self.curvature * r2 / (1.0 + np.sqrt(1.0 - (1.0 + self.conic) * self.curvature**2 * r2))
        for i, a in enumerate(self.even):
            z = z + a * r2 ** (i + 2)
        for term in self.terms:
            z = z + term.sag(x, y)
        if self.figure is not None:
            z = z + self.figure.sag(x, y)
        return np.asarray(z)


def plane() -> Surface:
    """Return a flat surface."""
    return Surface()
