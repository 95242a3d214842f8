"""Everything one render run finds, and its JSON forms (the contract of truth.json and recovered.json)."""

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
from twin.main_job.monitor_reading import MonitorReading, stated_check
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
    """Stray light of the nominal and the perturbed instrument, which prisms stand in whose beam, measured finishes."""

    before: StrayLight
    after: StrayLight
    obstructions: tuple[Obstruction, ...]
    measured: MeasuredFinishes | None = None

    def to_dict(self) -> dict[str, Any]:
        """Contents of stray.json."""
        taken = [{"body": o.body, "beam": o.beam, "share": o.share, "used": o.used} for o in self.obstructions]
        out = {"before": self.before.to_dict(), "after": self.after.to_dict(), "obstructions": taken}
        return out if self.measured is None else {**out, "finishes": self.measured.to_dict()}


@dataclass(frozen=True, eq=False, kw_only=True)
class JobRun:
    """What a job does to an instrument, whether it has a monitor or not.

    Attributes
    ----------
    resolved : ResolvedJob
        The job with everything it names.
    experiment : MonitorExperiment
        The instrument, with the calibration of its monitor if it has one.
    state : State
        What was perturbed.
    frames, seed : int
        Of the exposures.
    truth : Truth
        By exact tracing.
    warnings : tuple[str, ...]
        What the user should know.
    targets : TargetRun | None
        Test targets on the line CCDs, None if not asked for.
    quality : ImageQuality | None
        Image quality of the nominal and of the perturbed state, None if not asked for.
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
        """Contents of truth.json."""
        out: dict[str, Any] = {"cameras": {}}
        for group, one, value in self.true_changes():
            held = out if group in (ANGLE_GROUP, GROUND_GROUP) else out["cameras"]
            held.setdefault(group, {})[one.key] = value
        return self._with_nominal(out)

    def true_changes(self) -> list[tuple[str, Parameter, float]]:
        """Camera or group of two cameras, parameter, and how it truly changed, in the parameter's unit."""
        truth = self.truth
        out = [
            (name, one, one.per_si * float(value) + 0.0)
            for name in truth.cameras
            for one, value in zip(parameters.ESTIMATED, truth.vector(name)[0], strict=True)
        ]
        if len(truth.cameras) == 2:
            out.append((ANGLE_GROUP, parameters.ANGLE, float(truth.angle_change[0]) / ARCSEC + 0.0))
        if (ground := self.experiment.ground) is not None:
            errors = zip(parameters.GROUND, truth.ground_error(ground)[0], strict=True)
            out += [(GROUND_GROUP, one, float(value) + 0.0) for one, value in errors]
        return out

    def _with_nominal(self, out: dict[str, Any]) -> dict[str, Any]:
        """True changes with the nominal principal distances and angle beside them."""
        for name, group in out["cameras"].items():
            group["principal_distance_mm"] = 1e3 * float(self.truth.principal_distance[name])
        if ANGLE_GROUP in out:
            out[ANGLE_GROUP] = {"nominal_deg": float(np.degrees(self.truth.angle))} | out[ANGLE_GROUP]
        return out

    @property
    def deformed(self) -> Mapping[str, NodalDeformation]:
        """Body -> what the table of displaced nodes is that deforms it."""
        return self.experiment.deformed(self.resolved.job)

    @property
    def heated(self) -> Mapping[str, HeatedBody]:
        """Body -> what the table of temperatures is that warms it."""
        return self.experiment.heated(self.resolved.job)

    @property
    def checks(self) -> tuple[SelfCheck, ...]:
        """What was checked on the way."""
        return ()


@shows("experiment", "seed", "before [DN]", "after [DN]")
@dataclass(frozen=True, eq=False, kw_only=True)
class RenderRun(JobRun):
    """One job's outcome, of an instrument with a monitor: also what its spots say.

    Attributes
    ----------
    photons_before, photons_after : np.ndarray
        Expected photons per pixel and frame, (C, rows, columns), stray light included.
    before, after : np.ndarray
        Grey values, uint16 (C, frames, rows, columns).
    recovery : Recovery
        What the images say (one state).
    crosstalk : Mapping[str, CameraCrosstalk]
        Camera -> response to elementary motions.
    series : TimeSeries | None
        All times of the job's course, None if it has none; the rest is then about the time it shows.
    stray : StrayPair | None
        Ghosts and stray light, None if not asked for.
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
        """Contents of truth.json."""
        return self._with_nominal(self.reading.table.true())

    @cached_property
    def reading(self) -> MonitorReading:
        """What the images say, beside the truth."""
        experiment = self.experiment
        together = None if self.series is None else self.series.smoothed
        return MonitorReading(
            channels=tuple((channel.camera, channel.name) for channel in experiment.path.channels),
            cameras=experiment.cameras,
            ground=experiment.ground,
            disturbances=experiment.disturbances,
            recovery=self.recovery,
            crosstalk=self.crosstalk,
            frames=self.frames,
            centroid=self.resolved.job.analysis.centroid,
            found_wrong=together.contradiction if together is not None else (),
            truth=self.truth,
            together=1 if self.series is None else len(self.series.times),
        )

    @property
    def estimators(self) -> dict[str, Estimator]:
        """Estimators of the reading."""
        return self.reading.estimators

    @property
    def judged(self) -> str:
        """Name of the estimator that the report judges."""
        return self.reading.judged

    @property
    def gains(self) -> dict[str, np.ndarray]:
        """Gain of each estimator of the reading."""
        return self.reading.gains

    @property
    def sigma_holds(self) -> bool:
        """Whether nothing that was measured contradicts the sigmas; of a course at none of its times."""
        return self.reading.sigma_holds if self.series is None else bool(np.all(self.series.sigma_holds))

    @cached_property
    def worst_of_course(self) -> tuple[int, Consistency] | None:
        """The time of a course whose shifts agree least with the prior, and its consistency (see
        `MonitorReading.worst_of`). None without a course or a prior.
        """
        series = self.series
        return None if series is None else self.reading.worst_of(series.shift, series.shift_covariance)

    @cached_property
    def limits(self) -> MonitorLimits | None:
        """What limits the readings; None where nothing is stated to move. Of the instrument and its light, not of these
        images: the same for every seed.
        """
        if self.experiment.disturbances is None:
            return None
        return find_limits(self.experiment, expected_covariance(self.experiment, self.frames), self.frames)

    @property
    def checks(self) -> tuple[SelfCheck, ...]:
        """What was checked of images and readings, and of the balance of stray light."""
        out = [*self.experiment.path.checked.told(), *self.reading.checks]
        if self.worst_of_course is not None:
            out.append(stated_check("worst time of the course against the statement", self.worst_of_course[1]))
        if self.stray is not None:
            for when, light in (("before", self.stray.before), ("after", self.stray.after)):
                error = max((abs(path.balance.error) for path in light.traced.runs.values()), default=0.0)
                says = "emitted light less what was absorbed, detected, escaped and given up"
                out.append(SelfCheck(f"balance of stray light {when}", error, None, "of the light", says))
        return tuple(out)

    def recovered_dict(self) -> dict[str, Any]:
        """Contents of recovered.json."""
        return self.reading.recovered_dict()
