"""What repeated measurements say: their mean or median, and how well it is known."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def mean_of(values: NDArray[Any]) -> tuple[float, float]:
    """Mean of (n,) independent measurements, n > 1, and its standard deviation from their scatter."""
    return float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))


def median_of(values: NDArray[Any]) -> tuple[float, float]:
    """Median of (n,) independent measurements, n > 1, and its standard deviation from their scatter, were it normal."""
    return float(np.median(values)), float(np.sqrt(0.5 * np.pi / len(values)) * np.std(values, ddof=1))
