"""What the images of a monitor say, wherever they come from, and its JSON form (the contract of recovered.json)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from analysis.monitor.calibration import CameraCalibration
from analysis.monitor.disturbances import FALSE_ALARM, Consistency, Disturbances, consistency
from analysis.monitor.estimators import Estimator, applicable, judged
from analysis.monitor.ground_error import GroundGeometry
from analysis.monitor.recovery import Recovery
from twin.monitor.crosstalk import CameraCrosstalk, estimator_gains

__all__ = ["STATED", "STATED_SIGMA", "MonitorReading", "stated"]


@dataclass(frozen=True, eq=False)
class MonitorReading:
    """One state's reading.

    Attributes:
        channels: camera and side of every spot, in the order of the spots.
        cameras: what is calibrated of each.
        ground: how a pair of known altitude sees the ground, else None.
        disturbances: what is stated to move, None for nothing.
        recovery: what the images say (one state).
        crosstalk: camera -> response to elementary motions, by which a contradiction is explained; empty where no
            instrument is modelled.
        frames: of each spot after.
        centroid: by which method the spots were found.
    """

    channels: tuple[tuple[str, str], ...]
    cameras: Mapping[str, CameraCalibration]
    ground: GroundGeometry | None
    disturbances: Disturbances | None
    recovery: Recovery
    crosstalk: Mapping[str, CameraCrosstalk]
    frames: int
    centroid: str

    @property
    def estimators(self) -> dict[str, Estimator]:
        """Those that stand in the results, by their names there: all but those that need what is not stated."""
        return applicable(self.cameras, self.disturbances)

    @property
    def judged(self) -> str:
        """The estimator that the verdict is about: `posterior` where disturbances are stated, else `model`."""
        return judged(self.estimators)

    @cached_property
    def gains(self) -> dict[str, np.ndarray]:
        """Estimator -> (4 x cameras, 2 x spots) parameters (rad, m) per pixel of shift, at this measurement."""
        return estimator_gains(self.cameras, self.disturbances, self.recovery.shift_covariance[0])

    @cached_property
    def consistency(self) -> Consistency | None:
        """Do the shifts agree with the stated disturbances? None where none are stated, and where shifts have no noise:
        a body that is stated to stand still would then be a contradiction by rounding.
        """
        if self.disturbances is None or not np.any(self.recovery.shift_covariance):
            return None
        return self.recovery.consistency(self.disturbances, others=self.any_motions(self.disturbances))

    def any_motions(self, stated: Disturbances) -> dict[str, np.ndarray]:
        """Body -> what its motions do to all spots, px per table unit, stated or not.

        Args:
            stated: for how many spots.
        """
        columns: dict[tuple[str, str, int], np.ndarray] = {}
        for name, table in self.crosstalk.items():
            own = [2 * i + axis for i, (camera, _) in enumerate(self.channels) if camera == name for axis in (0, 1)]
            for motion, moved in zip(table.motions, table.spot_shift.T, strict=True):
                # what both cameras look at stands in both tables
                key = (motion.body, motion.kind, motion.axis)
                columns.setdefault(key, np.zeros(len(stated.spots)))[own] = moved
        bodies = dict.fromkeys(body for body, _, _ in columns)
        return {b: np.stack([c for (body, _, _), c in columns.items() if body == b], axis=1) for b in bodies}

    def worst_of(self, shifts: np.ndarray, covariance: np.ndarray) -> tuple[int, Consistency] | None:
        """Of the times of a series the one whose shifts agree least with the stated disturbances, and how they do: its
        limit is that of the largest of all times, at the same chance of a false alarm. None without a statement.

        Args:
            shifts: (T, 2 C) px.
            covariance: (T, 2 C, 2 C) px^2 of these.
        """
        stated, false_alarm = self.disturbances, FALSE_ALARM / len(shifts)
        if stated is None:
            return None
        # suspects are looked for at one time only
        found = [consistency(s, r, stated, {}, 0.0).chi_square for s, r in zip(shifts, covariance, strict=True)]
        worst = int(np.argmax(found))
        others = self.any_motions(stated)
        return worst, consistency(shifts[worst], covariance[worst], stated, others, false_alarm=false_alarm)

    def recovered_dict(self) -> dict[str, Any]:
        """Contents of recovered.json."""
        cameras = {
            name: {estimator: _first(p.to_dict()) for estimator, p in estimators.items()}
            for name, estimators in self.recovery.parameters.items()
        }
        spots: dict[str, Any] = {}
        r = self.recovery
        for i, (camera, side) in enumerate(self.channels):
            spots.setdefault(camera, {})[side] = {
                "before": _spot(r.before[0, i], r.sigma_before[0, i]),
                "after": _spot(r.after[0, i], r.sigma_after[0, i]),
            }
        out: dict[str, Any] = {"cameras": cameras, "spots": spots}
        if r.angle:
            out["intersection_angle"] = {e: _first(a.to_dict()) for e, a in r.angle.items()}
        if r.ground:
            out["ground"] = {e: _first(g.to_dict()) for e, g in r.ground.items()}
        if self.consistency is not None:
            out["disturbances"] = self._stated(self.consistency)
        out["centroid"] = self.centroid
        out["frames"] = self.frames
        return out

    def _stated(self, found: Consistency) -> dict[str, Any]:
        """What the total sigmas rest on, and whether the shifts agree with it."""
        assert self.disturbances is not None
        return {
            "name": self.disturbances.name,
            "chi_square": _to_digits(found.chi_square),
            "chi_square_sigma_noise": found.sigma_noise,
            "degrees_of_freedom": found.degrees,
            "limit": _to_digits(found.limit),
            "false_alarm": found.false_alarm,
            "chance": _to_digits(found.chance),
            "chance_sigma_noise": found.chance_sigma_noise,
            "agrees": found.agrees,
            "suspects": [
                {
                    "body": one.body,
                    "times_stated": _to_digits(one.times),
                    "log_likelihood_gain": _to_digits(one.gain),
                }
                for one in found.suspects
            ],
        }


STATED = 6
"""Decimals of a reading's sigma to which files state the reading."""
STATED_SIGMA = 8
"""Significant digits of a sigma, and of a chi-square."""
_SIGMAS = ("_sigma", "_sigma_noise", "_rms_m")
"""Endings of the keys of sigmas."""


def _to_digits(value: float) -> float:
    return float(f"{value:.{STATED_SIGMA - 1}e}")


def stated(readings: Mapping[str, Any]) -> dict[str, Any]:
    """Readings with as many digits as files state: each to a millionth of its sigma, the sigmas to eight digits.

    What comes after says nothing, and it depends on the processor: on the order in which its linear algebra sums.

    Args:
        readings: nested; the sigma of ``x`` is ``x_sigma_noise``, ``x_sigma`` or ``sigma_x`` beside it, the first that
            is there. Other numbers stay as they are.
    """
    out: dict[str, Any] = {}
    for key, value in readings.items():
        names = (f"{key}_sigma_noise", f"{key}_sigma", f"sigma_{key}")
        sigma = next((readings[name] for name in names if name in readings), None)
        if isinstance(value, Mapping):
            out[key] = stated(value)
        elif isinstance(value, float) and (key.endswith(_SIGMAS) or key.startswith("sigma_")):
            out[key] = _to_digits(value)
        elif isinstance(value, float) and isinstance(sigma, float) and 0.0 < sigma < math.inf:
            # adding 0.0 turns a negative zero into a plain one
            out[key] = round(value, STATED - math.floor(math.log10(sigma))) + 0.0
        else:
            out[key] = value
    return out


def _first(arrays: Mapping[str, Any]) -> dict[str, float]:
    """The only state's values."""
    return {key: float(np.ravel(value)[0]) for key, value in arrays.items()}


def _spot(position: np.ndarray, sigma: np.ndarray) -> dict[str, float]:
    return {
        "row": float(position[0]),
        "column": float(position[1]),
        "sigma_row": float(sigma[0]),
        "sigma_column": float(sigma[1]),
    }
