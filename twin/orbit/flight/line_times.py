"""When the lines of an image were exposed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LineTimes:
    """Times at lines of an image, linear between them and as far as half a line beyond the first and the last.

    Attributes:
        line: (K,) image coordinates, increasing; the middle of the first line is 0.
        time: (K,) middle of the exposure, seconds of the trajectory, increasing.
    """

    line: Array
    time: Array

    @classmethod
    def of(cls, line: ArrayLike, time: ArrayLike) -> LineTimes:
        """The table, checked.

        Args:
            line: (K,), at least two.
            time: (K,), seconds.

        Raises:
            ValueError: shapes that do not match, fewer than two rows, values that are not finite or do not increase.
        """
        at, moment = np.array(line, np.float64), np.array(time, np.float64)
        if at.ndim != 1 or at.shape != moment.shape or len(at) < 2:
            raise ValueError("line times: two lines or more, with a time for each")
        if not (np.all(np.isfinite(at)) and np.all(np.isfinite(moment))):
            raise ValueError("line times: a value is not finite")
        if not (np.all(np.diff(at) > 0.0) and np.all(np.diff(moment) > 0.0)):
            raise ValueError("line times: lines and times must increase")
        return cls(at, moment)

    @classmethod
    def even(cls, first_time: float, line_time: float, lines: int) -> LineTimes:
        """Of lines that follow one another evenly, from line 0 on; times in seconds."""
        last = float(max(lines - 1, 1))
        return cls.of([0.0, last], [first_time, first_time + last * line_time])

    @property
    def line_time(self) -> float:
        """Mean time from one line to the next, seconds."""
        return float((self.time[-1] - self.time[0]) / (self.line[-1] - self.line[0]))

    def at(self, line: ArrayLike) -> np.ndarray:
        """Times of lines (...), seconds; beyond the ends by the slope there."""
        x = np.asarray(line, dtype=np.float64)
        k = np.clip(np.searchsorted(self.line, x, side="right") - 1, 0, len(self.line) - 2)
        slope = (self.time[k + 1] - self.time[k]) / (self.line[k + 1] - self.line[k])
        return np.asarray(self.time[k] + (x - self.line[k]) * slope)
