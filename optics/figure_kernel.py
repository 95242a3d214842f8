"""Value and slopes of surface figures inside the trace kernel (Dr.Jit arrays)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from optics.zernike import triangle_index


def polynomial_figure(x: Any, y: Any, coefficients: Sequence[Any], order: int) -> tuple[Any, Any, Any]:
    """Sum of c_ab x^a y^b with a + b <= order, and its two slopes, by nested Horner schemes.

    ``coefficients`` is ordered by ``zernike.triangle_index``.
    """
    height: Any = 0.0 * x
    slope_x: Any = 0.0 * x
    slope_y: Any = 0.0 * x
    for a in range(order, -1, -1):
        row: Any = 0.0 * x
        row_slope: Any = 0.0 * x
        for b in range(order - a, -1, -1):
            row_slope = row_slope * y + row
            row = row * y + coefficients[triangle_index(a, b)]
        slope_x = slope_x * x + height
        height = height * x + row
        slope_y = slope_y * x + row_slope
    return height, slope_x, slope_y


def grid_figure(x: Any, y: Any, g: Mapping[str, Any], table: Any) -> tuple[Any, Any, Any]:
    """Cubic B-spline of a ``GridFigure`` and its slopes; ``table`` holds its padded coefficients, row by row."""
    import drjit as dr

    float_type = type(x)
    index_type = dr.uint32_array_t(float_type)
    columns, rows = g["gnx"], g["gny"]
    u = dr.clip((x - g["gx0"]) * g["gix"], 0.0, columns - 1.0)
    v = dr.clip((y - g["gy0"]) * g["giy"], 0.0, rows - 1.0)
    iu = dr.minimum(dr.floor(u), columns - 2.0)
    iv = dr.minimum(dr.floor(v), rows - 2.0)
    wu, du = _weights(u - iu)
    wv, dv = _weights(v - iv)
    width = index_type(columns + 4.0)
    # the table has two extra samples on every side, so that sample -1 of the stencil is at +1
    start = (index_type(iv) + 1) * width + index_type(iu) + 1
    height: Any = 0.0 * x
    slope_x: Any = 0.0 * x
    slope_y: Any = 0.0 * x
    for j in range(4):
        row: Any = 0.0 * x
        row_slope: Any = 0.0 * x
        for i in range(4):
            c = dr.gather(float_type, table, start + j * width + i)
            row = row + wu[i] * c
            row_slope = row_slope + du[i] * c
        height = height + wv[j] * row
        slope_x = slope_x + wv[j] * row_slope
        slope_y = slope_y + dv[j] * row
    return height, slope_x * g["gix"], slope_y * g["giy"]


def _weights(f: Any) -> tuple[list[Any], list[Any]]:
    """Cubic B-spline weights of samples -1, 0, 1, 2 at fraction f, and their derivatives."""
    e = 1.0 - f
    values = [
        e * e * e / 6.0,
        2.0 / 3.0 - f * f * (2.0 - f) / 2.0,
        2.0 / 3.0 - e * e * (2.0 - e) / 2.0,
        f * f * f / 6.0,
    ]
    slopes = [-0.5 * e * e, f * (1.5 * f - 2.0), -e * (1.5 * e - 2.0), 0.5 * f * f]
    return values, slopes
