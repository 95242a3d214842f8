"""Everything one render run finds, and its JSON forms (the contract of truth.json and recovered.json)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from analysis.monitor.disturbances import FALSE_ALARM, Consistency, Disturbances, consistency
from analysis.monitor.estimators import Estimator, applicable, judged
from analysis.monitor.ground_error import AXES
from analysis.monitor.monitoring import PARAMETERS, PER_SI
from analysis.monitor.recovery import Recovery
from analysis.units import ARCSEC
from optics.geometry.tree import State
from scenes.models.obstruction import Obstruction
from scenes.specs.resolved import ResolvedJob
from twin.monitor.crosstalk import CameraCrosstalk, estimator_gains
from twin.monitor.image_quality import ImageQuality
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.time_series import TimeSeries
from twin.monitor.truth import Truth
from twin.path_tracing.stray_light import StrayLight
from twin.targets.target_result import TargetRun
from twin.uncertainty.monitor_limits import MonitorLimits, expected_covariance, find_limits

PROGRAM = "twin.render"


@dataclass(frozen=True, eq=False)
class StrayPair:
    """Stray light of the nominal and of the perturbed instrument, and which prisms stand in whose beam."""

    before: StrayLight
    after: StrayLight
    obstructions: tuple[Obstruction, ...]

    def to_dict(self) -> dict[str, Any]:
        """Contents of stray.json."""
        taken = [{"body": o.body, "beam": o.beam, "share": o.share, "used": o.used} for o in self.obstructions]
        return {"before": self.before.to_dict(), "after": self.after.to_dict(), "obstructions": taken}


@dataclass(frozen=True, eq=False)
class RenderRun:
    """One job's outcome.

    Attributes:
        resolved: the job with everything it names.
        experiment: the instrument and its calibration.
        state: what was perturbed.
        frames, seed: of the exposures.
        truth: by exact tracing.
        photons_before, photons_after: expected photons per pixel and frame, (C, rows, columns), stray light included.
        before, after: grey values, uint16 (C, frames, rows, columns).
        recovery: what the images say (one state).
        crosstalk: camera -> response to elementary motions.
        warnings: what the user should know.
        series: all times of the job's course, None if it has none; the rest is then about the time it shows.
        stray: ghosts and stray light, None if not asked for.
        targets: test targets on the line CCDs, None if not asked for.
        quality: image quality of the nominal and of the perturbed state, None if not asked for.
    """

    resolved: ResolvedJob
    experiment: MonitorExperiment
    state: State
    frames: int
    seed: int
    truth: Truth
    photons_before: np.ndarray
    photons_after: np.ndarray
    before: np.ndarray
    after: np.ndarray
    recovery: Recovery
    crosstalk: Mapping[str, CameraCrosstalk]
    warnings: tuple[str, ...]
    series: TimeSeries | None = None
    stray: StrayPair | None = None
    targets: TargetRun | None = None
    quality: ImageQuality | None = None

    def true_parameters(self, camera: str) -> dict[str, float]:
        """True change of a camera in the units of the keys."""
        change = self.truth.cameras[camera]
        values = np.array([change.d_alpha[0], change.d_beta[0], change.d_gamma[0], change.d_f[0]]) * PER_SI
        # adding 0.0 turns a negative zero into a plain one
        return {key: float(value) + 0.0 for key, value in zip(PARAMETERS, values, strict=True)}

    def truth_dict(self) -> dict[str, Any]:
        """Contents of truth.json."""
        out: dict[str, Any] = {
            "cameras": {
                name: {
                    **self.true_parameters(name),
                    "principal_distance_mm": 1e3 * float(self.truth.principal_distance[name]),
                }
                for name in self.truth.cameras
            }
        }
        if len(self.truth.cameras) == 2:
            out["intersection_angle"] = {
                "nominal_deg": float(np.degrees(self.truth.angle)),
                "change_arcsec": float(self.truth.angle_change[0] / ARCSEC),
            }
        if self.experiment.ground is not None:
            error = self.truth.ground_error(self.experiment.ground)[0]
            out["ground"] = {f"{axis}_m": float(value) + 0.0 for axis, value in zip(AXES, error, strict=True)}
        return out

    @property
    def estimators(self) -> dict[str, Estimator]:
        """Those that stand in the results, by their names there: all but those that need what is not stated."""
        return applicable(self.experiment.cameras, self.experiment.disturbances)

    @property
    def judged(self) -> str:
        """The estimator that the verdict is about: `posterior` where disturbances are stated, else `model`."""
        return judged(self.estimators)

    @cached_property
    def gains(self) -> dict[str, np.ndarray]:
        """Estimator -> (4 x cameras, 2 x spots) parameters (rad, m) per pixel of shift, at this measurement."""
        return estimator_gains(self.experiment, self.recovery.shift_covariance[0])

    @cached_property
    def consistency(self) -> Consistency | None:
        """Do the shifts agree with the stated disturbances? None where none are stated, and where shifts have no noise:
        a body that is stated to stand still would then be a contradiction by rounding.
        """
        stated = self.experiment.disturbances
        if stated is None or not np.any(self.recovery.shift_covariance):
            return None
        return self.recovery.consistency(stated, others=self._any_motions(stated))

    @cached_property
    def worst_of_course(self) -> tuple[int, Consistency] | None:
        """Of the times of a course the one whose shifts agree least with the stated disturbances, and how they do: its
        limit is that of the largest of all times, at the same chance of a false alarm. None without course or
        statement.
        """
        stated, series = self.experiment.disturbances, self.series
        if stated is None or series is None:
            return None
        noise, false_alarm = series.shift_covariance, FALSE_ALARM / len(series.times)
        # suspects are looked for at one time only
        found = [consistency(s, r, stated, {}, 0.0).chi_square for s, r in zip(series.shift, noise, strict=True)]
        worst = int(np.argmax(found))
        return worst, consistency(
            series.shift[worst], noise[worst], stated, self._any_motions(stated), false_alarm=false_alarm
        )

    def _any_motions(self, stated: Disturbances) -> dict[str, np.ndarray]:
        """Body -> what its motions do to all spots, px per table unit, stated or not."""
        columns: dict[tuple[str, str, int], np.ndarray] = {}
        for name, table in self.crosstalk.items():
            own = self.experiment.instrument.coordinates_of(name)
            for motion, moved in zip(table.motions, table.spot_shift.T, strict=True):
                # what both cameras look at stands in both tables
                key = (motion.body, motion.kind, motion.axis)
                columns.setdefault(key, np.zeros(len(stated.spots)))[own] = moved
        bodies = dict.fromkeys(body for body, _, _ in columns)
        return {b: np.stack([c for (body, _, _), c in columns.items() if body == b], axis=1) for b in bodies}

    @cached_property
    def limits(self) -> MonitorLimits | None:
        """What limits the readings; None where nothing is stated to move. Of the instrument and its light, not of these
        images: the same for every seed.
        """
        if self.experiment.disturbances is None:
            return None
        return find_limits(self.experiment, expected_covariance(self.experiment, self.frames), self.frames)

    def recovered_dict(self) -> dict[str, Any]:
        """Contents of recovered.json."""
        cameras = {
            name: {estimator: _first(p.to_dict()) for estimator, p in estimators.items()}
            for name, estimators in self.recovery.parameters.items()
        }
        spots: dict[str, Any] = {}
        r = self.recovery
        for i, channel in enumerate(self.experiment.path.channels):
            spots.setdefault(channel.camera, {})[channel.side] = {
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
        out["centroid"] = self.resolved.job.analysis.centroid
        out["frames"] = self.frames
        return out

    def _stated(self, found: Consistency) -> dict[str, Any]:
        """What the total sigmas rest on, and whether the shifts agree with it."""
        assert self.experiment.disturbances is not None
        return {
            "name": self.experiment.disturbances.name,
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


def quality_dict(quality: ImageQuality) -> dict[str, Any]:
    """Contents of quality.json: ``cameras`` of the perturbed state, and ``before`` those of the nominal one."""
    before, after = quality.to_dicts()
    light = {
        name: {
            "nyquist_per_mm": 1e-3 * camera.nyquist,
            "spectrum_nm": [1e9 * wavelength for wavelength in camera.wavelengths],
        }
        for name, camera in quality.cameras.items()
    }
    about = {
        "obstruction": "traced" if quality.obstruction else "ignore",
        "wavelength_nm": 1e9 * quality.wavelength,
        "fields": list(quality.fields),
        "mtf": light,
    }
    return {**after, "before": before, **about}


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
