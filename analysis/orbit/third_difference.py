"""Quality of an orbit or attitude series by its third differences (paper 003, Table 2).

A third difference x[k+3] - 3 x[k+2] + 3 x[k+1] - x[k] removes a smooth motion, up to its third derivative times dt^3,
and leaves noise: of white noise with standard deviation s it has the RMS s sqrt(1 + 9 + 9 + 1) = s sqrt(20), and
neighbours correlate by -15/20. It says nothing of a bias, of a drift or of noise that is slower than a few samples, and
data that were smoothed before look better than they are. The smooth part is not always small: along a circular orbit at
500 km the third derivative is 8.4e-3 m/s^3, so 8 mm at 1 s but 8 m at 10 s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
WHITE_GAIN = float(np.sqrt(20.0))
# Steps of time that differ by more are gaps: third differences over them mean something else.
_UNEVEN = 1e-3


@dataclass(frozen=True, eq=False)
class ThirdDifference:
    """Quality of one series.

    Attributes:
        rms: (k,) of the third differences of each column, as in Table 2.
        white_sigma: (k,) rms / sqrt(20), standard deviation of one sample if the noise is white.
    """

    rms: Array
    white_sigma: Array


def third_difference(time: ArrayLike, series: ArrayLike) -> ThirdDifference:
    """Third differences of an evenly sampled series.

    Args:
        time: (n,) seconds.
        series: (n,) or (n, k), metres or radians.

    Raises:
        ValueError: fewer than five samples, values that are not finite, gaps.
    """
    t, x = np.asarray(time, np.float64), np.asarray(series, np.float64)
    x = x[:, None] if x.ndim == 1 else x
    if t.ndim != 1 or x.ndim != 2 or len(t) != len(x) or len(t) < 5:
        raise ValueError(f"third differences: need five samples or more, found times {t.shape} and series {x.shape}")
    if not (np.all(np.isfinite(t)) and np.all(np.isfinite(x))):
        raise ValueError("third differences: times and values must be finite")
    steps = np.diff(t)
    typical = float(np.median(steps))
    bad = np.flatnonzero(np.abs(steps - typical) > _UNEVEN * abs(typical))
    if typical <= 0 or len(bad):
        where = f"; the step after sample {bad[0]} is {steps[bad[0]]:.6g} s" if len(bad) else ""
        raise ValueError(f"third differences: times must rise evenly, by {typical:.6g} s{where}")
    change = np.diff(x, n=3, axis=0)
    rms = np.sqrt(np.mean(change**2, axis=0))
    return ThirdDifference(rms, rms / WHITE_GAIN)
