"""The few functions that the same formula needs on NumPy arrays and on Dr.Jit arrays."""

from __future__ import annotations

from typing import Any

import numpy as np


def _is_numpy(x: Any) -> bool:
    return isinstance(x, int | float | np.ndarray | np.generic)


def sqrt(x: Any) -> Any:
    """Square root."""
    if _is_numpy(x):
        return np.sqrt(x)
    import drjit as dr

    return dr.sqrt(x)


def exp(x: Any) -> Any:
    """Exponential."""
    if _is_numpy(x):
        return np.exp(x)
    import drjit as dr

    return dr.exp(x)


def log(x: Any) -> Any:
    """Natural logarithm."""
    if _is_numpy(x):
        return np.log(x)
    import drjit as dr

    return dr.log(x)


def select(mask: Any, a: Any, b: Any) -> Any:
    """``a`` where the mask is true, ``b`` elsewhere."""
    if isinstance(mask, bool | np.ndarray | np.generic):
        return np.where(mask, a, b)
    import drjit as dr

    return dr.select(mask, a, b)
