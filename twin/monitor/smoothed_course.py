"""A course of a monitor, simulated or recorded, read as a whole: filter and smoother by the laws in time of what is
stated to move.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.monitor.calibration import CameraCalibration
from analysis.monitor.disturbances import FALSE_ALARM, Consistency, Disturbances
from analysis.monitor.ground_error import GroundGeometry
from analysis.monitor.recovery import Estimates, Recovery, estimates_of
from analysis.monitor.series_smoother import smooth, window_of
from analysis.spots.spot_positions import NoiseParts, SeriesNoise
from optics.numerics.threads import one_blas_thread

__all__ = ["CourseSmoother", "SmoothedCourse"]

MOST_BETWEEN, LARGEST_BETWEEN = 7, 400
"""Times between two of a course, and in all, at which it is smoothed, too."""


@dataclass(frozen=True, eq=False)
class SmoothedCourse:
    """What all measurements of a course say together, by the laws in time of what is stated to move.

    Attributes:
        name: of the stated disturbances.
        changes: at all times of the course, by the estimators `filtered`, from the measurements up to each time, and
            `smoothed`, from all.
        times: (F,) between those of the course, seconds; between: the changes there, likewise.
        innovations: (T,) chi-square of each measurement against what those before it say; each: its degrees of freedom.
        consistency: chi-square of the whole series.
    """

    name: str
    changes: Estimates
    times: np.ndarray
    between: Estimates
    innovations: np.ndarray
    each: int
    consistency: Consistency

    def at_dict(self) -> dict[str, Any]:
        """Filtered and smoothed changes at the times of the course, a list over the times for each number."""
        return _to_dict(self.changes)

    def between_dict(self) -> dict[str, Any]:
        """Filtered and smoothed changes between the times of the course, as course.json has those at its times."""
        return {"times_s": self.times.tolist(), **_to_dict(self.between)}

    def to_dict(self) -> dict[str, Any]:
        """Do the measurements agree with what is stated?"""
        found = self.consistency
        return {
            "name": self.name,
            "chi_square": found.chi_square,
            "degrees_of_freedom": found.degrees,
            "limit": found.limit,
            "false_alarm": FALSE_ALARM,
            "chance": found.chance,
            "agrees": found.agrees,
            "innovations": {"chi_square": self.innovations.tolist(), "degrees_of_freedom": self.each},
        }


def _to_dict(changes: Estimates) -> dict[str, Any]:
    out: dict[str, Any] = {
        "cameras": {name: {e: p.to_dict() for e, p in every.items()} for name, every in changes.parameters.items()},
    }
    if changes.angle:
        out["intersection_angle"] = {e: a.to_dict() for e, a in changes.angle.items()}
    if changes.ground:
        out["ground"] = {e: g.to_dict() for e, g in changes.ground.items()}
    return out


class CourseSmoother:
    """Collects shifts and noise of all measurements, then reads them together.

    Args:
        stated: what moves, and how it goes on in time; None for nothing, of which nothing is smoothed.
        cameras: what is calibrated of each.
        ground: of a pair whose altitude is known, else None.
        times: of the measurements, seconds, in order.
    """

    def __init__(
        self,
        stated: Disturbances | None,
        cameras: Mapping[str, CameraCalibration],
        ground: GroundGeometry | None,
        times: Sequence[float],
    ) -> None:
        self._stated, self._cameras, self._ground = stated, cameras, ground
        self._times = np.array(times)
        self._shifts: list[np.ndarray] = []
        self._noise: SeriesNoise | None = None

    def add(self, found: Recovery) -> Recovery:
        """Take what is needed of some states, and give them back without the maps.

        Args:
            found: the next states, with the parts of their noise.
        """
        if found.parts is None:
            return found
        self.take(found.shift, *found.parts)
        return found.at(slice(None))

    def take(self, shift: np.ndarray, before: NoiseParts, after: NoiseParts) -> None:
        """The same of states that were measured otherwise.

        Args:
            shift: (S, 2 C) after - before of the next states, px.
            before: noise of the C spots before, the same at every call.
            after: of the S C spots after, state by state.
        """
        if self._noise is None:
            self._noise = SeriesNoise(before, window_of(shift.shape[1]))
        self._noise.add(after)
        self._shifts.append(shift)

    def smoothed(self) -> SmoothedCourse | None:
        """Of all that was taken; None where nothing is stated to move, and of a single time."""
        stated, noise, times = self._stated, self._noise, self._times
        if stated is None or noise is None or len(times) < 2:
            return None
        steps = min(MOST_BETWEEN, LARGEST_BETWEEN // (len(times) - 1)) + 1
        shares = np.arange(1, steps) / steps
        between = (times[:-1, None] + shares * np.diff(times)[:, None]).ravel()
        with one_blas_thread():
            found = smooth(stated, times, np.concatenate(self._shifts), noise, np.append(times, between))

        def part(which: slice) -> Estimates:
            every = {"filtered": found.filtered, "smoothed": found.smoothed}
            own = {name: (one.values[which], one.noise[which], one.total[which]) for name, one in every.items()}
            return estimates_of(own, self._cameras, self._ground)

        count = len(times)
        each = found.consistency.degrees // count
        at, rest = part(slice(count)), part(slice(count, None))
        return SmoothedCourse(stated.name, at, between, rest, found.innovations, each, found.consistency)
