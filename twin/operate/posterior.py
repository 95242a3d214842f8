"""What an operation's estimate says of several times together, such as of one pass: with how the errors of one time go
together with those of another.

Between two readings nearly all of an error is common to the times of a pass; what is not is what moves meanwhile by the
stated laws in time. An adjustment of images that takes the estimate as readings of the cameras needs both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.monitor.limits import Quantity
from scenes.yaml.errors import Problem
from twin.operate.estimate.operation import Operation
from twin.operate.record.entries import utc_text

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Posterior:
    """Mean and covariance of Q quantities at T times.

    Attributes:
        times: (T,) microseconds of TAI since 2000.
        quantities: Q, each with its group (a camera, `intersection_angle` or `ground`), key and unit.
        mean: (T, Q) changes since the calibration, in each one's unit, with the signs of docs/conventions.md.
        covariance: (T, Q, T, Q) of their errors, those of one time with those of another, in these units.
    """

    times: NDArray[np.int64]
    quantities: tuple[Quantity, ...]
    mean: Array
    covariance: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Group and key of each: ``forward d_alpha_arcsec``."""
        return tuple(f"{one.group} {one.key}" for one in self.quantities)

    def to_dict(self) -> dict[str, Any]:
        """Plain data: times, names and numbers."""
        return {
            "times_utc": [utc_text(int(time)) for time in self.times],
            "quantities": list(self.names),
            "mean": self.mean.tolist(),
            "covariance": self.covariance.tolist(),
        }


def posterior(
    operation: Operation, times_us: Sequence[int] | NDArray[np.int64], names: Sequence[str] | None = None
) -> Posterior:
    """What all readings say of quantities at several times together.

    The work is that of one look at the past, and T^2 times the square of the states beside it: some hundred times of a
    pass are a matter of seconds.

    Args:
        operation: that follows the record.
        times_us: (T,) microseconds of TAI since 2000, each later than the one before and none before the first reading;
            `twin.operate.record.entries.micros` makes them of UTC. Of times after the newest reading it is the
            forecast.
        names: quantities by group and key, as a plan of operation names them: ``forward d_alpha_arcsec``. By default
            d_alpha, d_beta, d_gamma and d_f of all cameras.

    Raises:
        Problem: times out of order or before all readings, or a quantity that is not read.
    """
    times = np.asarray(times_us, np.int64)
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        raise Problem("times out of order", utc_text(int(times[late[0] + 1])), "each time later than the one before")
    known = {f"{one.group} {one.key}": one for one in operation.quantities}
    cameras = dict.fromkeys(camera for camera, _ in operation.model.spots)
    wanted = [name for name, one in known.items() if one.group in cameras] if names is None else list(names)
    for name in wanted:
        if name not in known:
            raise Problem("no such quantity", name, f"one of: {', '.join(known)}")
    quantities = tuple(known[name] for name in wanted)
    rows = np.array([one.row for one in quantities]).reshape(len(wanted), -1)
    values, covariance = operation.jointly(times)
    return Posterior(
        times, quantities, values @ rows.T, np.einsum("qi,tiuj,rj->tqur", rows, covariance, rows, optimize=True)
    )
