"""Results of one run of the main job, and their JSON forms (the contents of truth.json and recovered.json)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from analysis.arrays import ARCSEC, shows
from analysis.monitor import parameters
from analysis.monitor.disturbances import Consistency
from analysis.monitor.estimators import Estimator
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP, Parameter
from analysis.monitor.recovery import Recovery
from optics.geometry.tree import State
from optics.thermal.nodal_deformation import NodalDeformation
from scenes.models.job_state import HeatedBody
from scenes.models.obstruction import Obstruction
from scenes.models.scenery import MeasuredFinishes
from scenes.specs.resolved import ResolvedJob
from twin.framework.provenance import SelfCheck
from twin.main_job.monitor_reading import MonitorReading, prior_check
from twin.monitor.crosstalk import CameraCrosstalk
from twin.monitor.image_quality import ImageQuality
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.time_series import TimeSeries
from twin.monitor.truth import Truth
from twin.path_tracing.stray_light import StrayLight
from twin.targets.target_measurement import TargetRun
from twin.uncertainty.monitor_limits import MonitorLimits, expected_covariance, find_limits

PROGRAM = "twin.render"


@dataclass(frozen=True, eq=False)
class StrayPair:
    """Stray light of the nominal and the perturbed instrument, obstruction by prisms, and measured surface finishes."""

    before: StrayLight
    after: StrayLight
    obstructions: tuple[Obstruction, ...]
    measured: MeasuredFinishes | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of stray.json: stray light before and after the perturbation."""
        taken = [{"body": o.body, "beam": o.beam, "share": o.share, "used": o.used} for o in self.obstructions]
        out = {"before": self.before.to_dict(), "after": self.after.to_dict(), "obstructions": taken}
        return out if self.measured is None else {**out, "finishes": self.measured.to_dict()}


@dataclass(frozen=True, eq=False, kw_only=True)
class JobRun:
    """Result of a job, of an instrument with or without a monitor.

    Attributes
    ----------
    resolved : ResolvedJob
        Job with the contents of all files that it names.
    experiment : MonitorExperiment
        Instrument, with the calibration of its monitor if it has one.
    state : State
        Perturbed state.
    frames, seed : int
        Number of frames of each state, and seed of their noise.
    truth : Truth
        True changes, by exact tracing.
    warnings : tuple of str
        Warnings to the user.
    targets : TargetRun or None
        Test targets on the line CCDs, None if not requested.
    quality : ImageQuality or None
        Image quality of the nominal and the perturbed state, None if not requested.
    """

    resolved: ResolvedJob
    experiment: MonitorExperiment
    state: State
    frames: int
    seed: int
    truth: Truth
    warnings: tuple[str, ...]
    targets: TargetRun | None = None
    quality: ImageQuality | None = None

    def truth_dict(self) -> dict[str, Any]:
        """Return the contents of truth.json: the true changes of the cameras, with nominal values."""
        out: dict[str, Any] = {"cameras": {}}
        for group, parameter, value in self.true_changes():
            target = out if group in (ANGLE_GROUP, GROUND_GROUP) else out["cameras"]
            target.setdefault(group, {})[parameter.key] = value
        return self._with_nominal(out)

    def true_changes(self) -> list[tuple[str, Parameter, float]]:
        """Return (camera or group of two cameras, parameter, true change in the parameter's unit) of each parameter."""
        truth = self.truth
        out = [
            (name, parameter, parameter.per_si * float(value) + 0.0)
            for name in truth.cameras
            for parameter, value in zip(parameters.ESTIMATED, truth.vector(name)[0], strict=True)
        ]
        if len(truth.cameras) == 2:
            out.append((ANGLE_GROUP, parameters.ANGLE, float(truth.angle_change[0]) / ARCSEC + 0.0))
        if (ground := self.experiment.ground) is not None:
            errors = zip(parameters.GROUND, truth.ground_error(ground)[0], strict=True)
            out += [(GROUND_GROUP, parameter, float(value) + 0.0) for parameter, value in errors]
        return out

    def _with_nominal(self, out: dict[str, Any]) -> dict[str, Any]:
        """Return true changes as plain data, with the nominal principal distances and angle added."""
        for name, group in out["cameras"].items():
            group["principal_distance_mm"] = 1e3 * float(self.truth.principal_distance[name])
        if ANGLE_GROUP in out:
            out[ANGLE_GROUP] = {"nominal_deg": float(np.degrees(self.truth.angle))} | out[ANGLE_GROUP]
        return out

    @property
    def deformed(self) -> Mapping[str, NodalDeformation]:
        """Body -> its deformation by a table of displaced nodes; empty without such tables."""
        return self.experiment.deformed(self.resolved.job)

    @property
    def heated(self) -> Mapping[str, HeatedBody]:
        """Body -> its temperature field by a table of nodes; empty without such tables."""
        return self.experiment.heated(self.resolved.job)

    @property
    def checks(self) -> tuple[SelfCheck, ...]:
        """Checks of the computation that were made during the run, for its manifest."""
        return ()


@shows("experiment", "seed", "before [DN]", "after [DN]")
@dataclass(frozen=True, eq=False, kw_only=True)
class RenderRun(JobRun):
    """Result of a job of an instrument with a monitor, with the monitor's frames and estimated changes.

    Attributes
    ----------
    photons_before, photons_after : (C, rows, columns) ndarray
        Expected photons per pixel and frame on the CCDs of C channels, stray light included.
    before, after : (C, frames, rows, columns) ndarray of uint16
        Grey values, DN.
    recovery : Recovery
        Spot positions and estimates from the images (one state).
    crosstalk : Mapping[str, CameraCrosstalk]
        Camera -> response to elementary motions.
    series : TimeSeries or None
        All times of the job's time series, None if it has none; the other attributes then describe the time that it
        shows.
    stray : StrayPair or None
        Ghosts and stray light, None if not requested.
    """

    photons_before: np.ndarray
    photons_after: np.ndarray
    before: np.ndarray
    after: np.ndarray
    recovery: Recovery
    crosstalk: Mapping[str, CameraCrosstalk]
    series: TimeSeries | None = None
    stray: StrayPair | None = None

    def truth_dict(self) -> dict[str, Any]:
        """Return the contents of truth.json: the true changes of the cameras, with nominal values."""
        return self._with_nominal(self.reading.table.true())

    @cached_property
    def reading(self) -> MonitorReading:
        """Changes estimated from the monitor's images, beside the true changes."""
        experiment = self.experiment
        smoothed = None if self.series is None else self.series.smoothed
        return MonitorReading(
            channels=tuple((channel.camera, channel.name) for channel in experiment.path.channels),
            cameras=experiment.cameras,
            ground=experiment.ground,
            disturbances=experiment.disturbances,
            recovery=self.recovery,
            crosstalk=self.crosstalk,
            frames=self.frames,
            centroid=self.resolved.job.analysis.centroid,
            earlier_doubts=smoothed.contradiction if smoothed is not None else (),
            truth=self.truth,
            together=1 if self.series is None else len(self.series.times),
        )

    @property
    def estimators(self) -> dict[str, Estimator]:
        """Name -> estimator, for all estimators in the results."""
        return self.reading.estimators

    @property
    def judged(self) -> str:
        """Name of the estimator that the verdict of the report uses."""
        return self.reading.judged

    @property
    def gains(self) -> dict[str, np.ndarray]:
        """Estimator -> its linear map from spot shifts (px) to camera parameters (rad or m).

        Each is a (4 x cameras, 2 x spots) array.
        """
        return self.reading.gains

    @property
    def sigma_holds(self) -> bool:
        """True if no measurement contradicts the assumptions of the sigmas, at any time of a time series."""
        return self.reading.sigma_holds if self.series is None else bool(np.all(self.series.sigma_holds))

    @cached_property
    def worst_of_course(self) -> tuple[int, Consistency] | None:
        """Index of the time of a series at which the spot shifts agree least with the prior, and its chi-square test.

        It is None without a time series or a prior. The limit of the test is that of the largest value of all times.
        """
        series = self.series
        return None if series is None else self.reading.worst_of(series.shift, series.shift_covariance)

    @cached_property
    def limits(self) -> MonitorLimits | None:
        """Analysis of what limits the accuracy of the estimated changes; None without a prior.

        It depends on the instrument and its light, not on these images, and is the same for every seed.
        """
        if self.experiment.disturbances is None:
            return None
        return find_limits(self.experiment, expected_covariance(self.experiment, self.frames), self.frames)

    @property
    def checks(self) -> tuple[SelfCheck, ...]:
        """Checks of images and estimated changes, and of the energy balance of stray light."""
        out = [*self.experiment.path.checked.self_checks(), *self.reading.checks]
        if self.worst_of_course is not None:
            what = "worst time of the course against the prior on disturbances"
            out.append(prior_check(what, self.worst_of_course[1]))
        if self.stray is not None:
            for when, light in (("before", self.stray.before), ("after", self.stray.after)):
                error = max((abs(path.balance.error) for path in light.traced.runs.values()), default=0.0)
                meaning = "emitted light minus absorbed, detected, escaped and truncated light"
                out.append(SelfCheck(f"balance of stray light {when}", error, None, "of the light", meaning))
        return tuple(out)

    def recovered_dict(self) -> dict[str, Any]:
        """Return the contents of recovered.json: estimated changes, sigmas, spots and tests."""
        return self.reading.recovered_dict()
