"""A course: the state at each time, what the monitor records and what the analysis makes of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from analysis.monitor.curvature import Curvature
from analysis.monitor.ground_error import AXES, GroundError
from analysis.monitor.intersection_angle import IntersectionAngleChange
from analysis.monitor.monitoring import PARAMETERS, PER_SI, CameraParameters
from analysis.monitor.recovery import Estimates, Recovery
from analysis.monitor.spot_evidence import SpotEvidence
from analysis.spots.spot_positions import SpotError
from analysis.units import ARCSEC
from optics.geometry.tree import Motion, State
from optics.thermal.heat import Temperature
from scenes.models.job_state import motions_of
from scenes.models.thermal_model import TemperatureError
from scenes.specs.course import CourseSpec, moment
from scenes.specs.job import JobSpec
from scenes.specs.resolved import ResolvedJob
from scenes.yaml.errors import InputError
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.monitor_memory import largest_piece
from twin.monitor.observation import LOST, Observing, observe, one_detector, why_lost
from twin.monitor.smoothed_course import CourseSmoother, SmoothedCourse
from twin.monitor.truth import Truth

LARGEST_SERIES = 200_000_000
"""Pixels of one image per time and channel, which are kept: about 1.2 GB."""


@dataclass(frozen=True, eq=False)
class TimeSeries:
    """What a course of T times gave.

    Attributes:
        times: (T,) seconds.
        temperatures: node path -> its change of temperature at each time, perturbation included.
        motions: node path -> its motion at each time, perturbation included; of the nodes that the course moves.
        shown: number of the time that the rest of the run shows in full.
        truth: camera -> (4, T) true d_alpha, d_beta, d_gamma (rad) and d_f (m).
        angle: of the nominal state, radians, NaN unless there are two cameras; angle_change: (T,), radians.
        parameters: camera -> estimator -> changes, arrays (T,), against one nominal measurement.
        recovered_angle: estimator -> change of the intersection angle, arrays (T,); empty unless there are two cameras.
        true_ground: (T, 3) errors along the track, across it and up of points located by the nominal cameras, metres;
            None unless the altitude of a pair is known.
        recovered_ground: estimator -> the same as they are read, arrays (T,); empty likewise.
        smoothed: all measurements together; None where nothing is stated to move.
        shift: (T, 2 C) of the spots, in their order, px; shift_covariance: (T, 2 C, 2 C), px^2.
        photons: expected photons per pixel and frame, float32 (T, C, rows, columns).
        shown_photons: those of the time that is shown, as they were exposed, (C, rows, columns).
        frames: the first frame of each time, uint16 (T, C, rows, columns).
        warnings: what the user should know.
        evidence: what the fits of all spots say.
        curvature: estimator -> whether its motions are small enough to be linear, at all times.
    """

    times: np.ndarray
    temperatures: Mapping[str, tuple[Temperature, ...]]
    motions: Mapping[str, tuple[Motion, ...]]
    shown: int
    truth: Mapping[str, np.ndarray]
    angle: float
    angle_change: np.ndarray
    parameters: Mapping[str, Mapping[str, CameraParameters]]
    recovered_angle: Mapping[str, IntersectionAngleChange]
    true_ground: np.ndarray | None
    recovered_ground: Mapping[str, GroundError]
    smoothed: SmoothedCourse | None
    shift: np.ndarray
    shift_covariance: np.ndarray
    photons: np.ndarray
    shown_photons: np.ndarray
    frames: np.ndarray
    warnings: tuple[str, ...]
    evidence: SpotEvidence
    curvature: Mapping[str, Curvature]

    @property
    def sigma_holds(self) -> np.ndarray:
        """(T,) whether spots and readings of each time are as their sigmas take them to be."""
        return np.all([self.evidence.holds, *(found.holds for found in self.curvature.values())], axis=0)

    def doubts(self, spots: Sequence[str]) -> tuple[str, ...]:
        """Where sigma does not hold, and which readings were worked out anew since they are not linear; sentences
        without their end.

        Args:
            spots: their names.
        """
        out = []
        told = self.evidence.course_doubt([moment(time) for time in self.times.tolist()], spots)
        if told is not None:
            out.append(f"course {told}")
        for name, found in self.curvature.items():
            lost = np.flatnonzero(~found.holds)
            again = np.flatnonzero(found.beyond & found.holds)
            if len(lost):
                out.append(
                    f"course: σ does not hold at {len(lost)} times, first at {moment(float(self.times[lost[0]]))}: the "
                    f"motions that the {name} reads are not small, and the states that it stands for cannot be traced"
                )
            if len(again):
                out.append(
                    f"course: at {len(again)} times, first at {moment(float(self.times[again[0]]))}, the motions that "
                    f"the {name} reads are not small, and its readings are those of Gauss and Newton's steps"
                )
        return tuple(out)

    def to_dict(self) -> dict[str, Any]:
        """Contents of course.json: as truth.json and recovered.json, with a list over the times for each number."""
        cameras: dict[str, Any] = {}
        changes = Estimates({name: {} for name in self.parameters}, {}, {})
        if self.smoothed is not None:
            changes = self.smoothed.changes
        for name, estimators in self.parameters.items():
            # adding 0.0 turns a negative zero into a plain one
            values = {
                k: (v + 0.0).tolist() for k, v in zip(PARAMETERS, self.truth[name] * PER_SI[:, None], strict=True)
            }
            every = {**estimators, **changes.parameters[name]}
            cameras[name] = {"true": values, **{e: p.to_dict() for e, p in every.items()}}
        out: dict[str, Any] = {
            "times_s": self.times.tolist(),
            "detail": self.shown,
            "temperatures": {
                path: {"change_K": [f.change for f in fields], "gradient_K_per_m": [list(f.gradient) for f in fields]}
                for path, fields in self.temperatures.items()
            },
            "cameras": cameras,
        }
        if self.motions:
            out["motions"] = {
                path: {
                    "pivot": moves[0].pivot,
                    "rotate_arcsec": [[angle / ARCSEC for angle in motion.rotate] for motion in moves],
                    "shift_um": [[1e6 * length for length in motion.shift] for motion in moves],
                    "scale_ppm": [1e6 * motion.scale for motion in moves],
                }
                for path, moves in self.motions.items()
            }
        if self.recovered_angle:
            out["intersection_angle"] = {
                "nominal_deg": float(np.degrees(self.angle)),
                "true": {"change_arcsec": (self.angle_change / ARCSEC + 0.0).tolist()},
                **{e: a.to_dict() for e, a in {**self.recovered_angle, **changes.angle}.items()},
            }
        if self.true_ground is not None:
            out["ground"] = {
                "true": {f"{axis}_m": (v + 0.0).tolist() for axis, v in zip(AXES, self.true_ground.T, strict=True)},
                **{e: g.to_dict() for e, g in {**self.recovered_ground, **changes.ground}.items()},
            }
        out["sigma_holds"] = self.sigma_holds.tolist()
        if self.smoothed is not None:
            out["disturbances"] = self.smoothed.to_dict()
            if len(self.smoothed.times):
                out["between"] = self.smoothed.between_dict()
        return out


def series_states(experiment: MonitorExperiment, job: JobSpec) -> list[State]:
    """The state at each time of a job's course.

    Args:
        experiment: the instrument.
        job: with a course, checked by ``scenes.specs.job.check_nodes``.

    Raises:
        InputError: a temperature at or below 0 K at some time, or one at which a glass's index is not known.
    """
    course = _course(job)
    out = []
    for k, time in enumerate(course.times):
        fields = experiment.fields(job, k)
        try:
            experiment.thermal.check(fields)
        except TemperatureError as error:
            text = f"{error} at {moment(time)}"
            if error.origin in course.temperature:
                raise course.error(text, course.key(error.origin, k), allowed=error.allowed) from error
            raise job.error(text, ("perturb", error.origin, "temperature"), allowed=error.allowed) from error
        out.append(experiment.thermal.state(fields, experiment.motions(job, k)))
    return out


def run_series(
    experiment: MonitorExperiment,
    resolved: ResolvedJob,
    states: Sequence[State],
    advance: Callable[[int], None] = lambda done: None,
) -> TimeSeries:
    """Trace, render, expose and recover all times of a course against one nominal measurement.

    Args:
        experiment: the instrument.
        resolved: a job with a course; its frames and seed are used.
        states: of ``series_states``.
        advance: called with the number of times that are done, first with 0.

    Raises:
        InputError: at some time light misses the mirrors or a spot cannot be measured, or there are too many pixels.
    """
    job, frames, seed = resolved.job, resolved.frames, resolved.job.render.seed
    course = _course(job)
    channels, shape = experiment.path.channels, experiment.path.shape
    each = len(channels) * shape[0] * shape[1]
    if len(states) * each > LARGEST_SERIES:
        raise course.error(
            "the images of all times do not fit into memory",
            ("times",),
            found=f"{len(states)} times",
            allowed=f"at most {LARGEST_SERIES // each} with area CCDs of {shape[0]} x {shape[1]} pixels",
        )
    advance(0)
    photons = np.empty((len(states), len(channels), *shape), np.float32)
    first = np.empty(photons.shape, np.uint16)
    saturated = np.zeros(photons.shape[:2], bool)
    share = np.empty(photons.shape[:2])
    shown_photons = np.empty(photons.shape[1:])
    truths: list[Truth] = []
    recoveries: list[Recovery] = []
    together = CourseSmoother(experiment.disturbances, experiment.cameras, experiment.ground, course.times)
    record, size, done = one_detector(experiment, frames, seed), largest_piece(each * frames), 0
    how = Observing(record, job.analysis.centroid, size, keep_parts=experiment.disturbances is not None)
    try:
        for found in observe(experiment, states, how):
            piece, expected = slice(done, done + len(found.numbers)), found.light.photons
            truths.append(found.truth)
            recoveries.append(together.add(found.recovery))
            photons[piece], first[piece] = expected, found.after[:, :, 0]
            if piece.start <= course.shown < piece.stop:
                shown_photons[:] = expected[course.shown - piece.start]
            saturated[piece] = experiment.detector.saturated(found.after).pixels > 0
            share[piece] = expected.sum(axis=(2, 3)) / experiment.nominal_photons.sum(axis=(1, 2))
            done = piece.stop
            advance(done)
    except LOST as error:
        for k in range(done, min(done + size, len(states))):
            if why := why_lost(experiment, states[k]):
                raise too_large(job, k, why) from error
        raise
    except SpotError as error:
        k, spot = divmod(error.indices[0], len(channels))
        reason = f"the spot {channels[spot].key} cannot be measured ({error.reasons[error.indices[0]]})"
        raise too_large(job, done + k, reason) from error
    names = list(experiment.instrument.cameras)
    moves = [motions_of(job, k) for k in range(len(states))]
    changes = {name: [t.cameras[name] for t in truths] for name in names}
    return TimeSeries(
        times=np.array(course.times),
        temperatures={path: tuple(job.fields(k)[path] for k in range(len(states))) for path in job.fields(0)},
        motions={path: tuple(every[path] for every in moves) for path in course.motion},
        shown=course.shown,
        truth={
            name: np.concatenate([np.stack([c.d_alpha, c.d_beta, c.d_gamma, c.d_f]) for c in every], axis=1)
            for name, every in changes.items()
        },
        angle=truths[0].angle,
        angle_change=np.concatenate([t.angle_change for t in truths]),
        parameters={
            name: {e: _joined([r.parameters[name][e] for r in recoveries]) for e in recoveries[0].parameters[name]}
            for name in names
        },
        recovered_angle={e: _joined_angle([r.angle[e] for r in recoveries]) for e in recoveries[0].angle},
        true_ground=None
        if experiment.ground is None
        else np.concatenate([t.ground_error(experiment.ground) for t in truths]),
        recovered_ground={e: _joined_ground([r.ground[e] for r in recoveries]) for e in recoveries[0].ground},
        smoothed=together.smoothed(),
        shift=np.concatenate([r.shift for r in recoveries]),
        shift_covariance=np.concatenate([r.shift_covariance for r in recoveries]),
        photons=photons,
        shown_photons=shown_photons,
        frames=first,
        warnings=_warnings(experiment, course, saturated, share),
        evidence=SpotEvidence.joined([r.evidence for r in recoveries if r.evidence is not None]),
        curvature={e: Curvature.joined([r.curvature[e] for r in recoveries]) for e in recoveries[0].curvature},
    )


def too_large(job: JobSpec, k: int, reason: str) -> InputError:
    """What to say when the state at time number ``k`` cannot be rendered."""
    course = _course(job)
    given = {"temperature": list(course.temperature), "motion": list(course.motion)}
    parts = {name: f"{name}s of {', '.join(nodes)}" for name, nodes in given.items() if nodes}
    return course.error(
        f"the instrument at {moment(course.times[k])} of the course cannot be rendered: {reason}",
        (next(iter(parts)),),
        found=" and ".join(parts.values()),
        allowed="temperatures and motions that keep the beams on the mirrors and the spots on their CCDs",
    )


def _course(job: JobSpec) -> CourseSpec:
    if job.course is None:
        raise ValueError("the job has no course")
    return job.course


def _joined(parts: Sequence[CameraParameters]) -> CameraParameters:
    total = [p.total for p in parts if p.total is not None]
    return CameraParameters.from_vector(
        np.concatenate([p.vector for p in parts]),
        np.concatenate([p.covariance for p in parts]),
        np.concatenate(total) if total else None,
    )


def _joined_angle(parts: Sequence[IntersectionAngleChange]) -> IntersectionAngleChange:
    return IntersectionAngleChange(
        np.concatenate([p.change_rad for p in parts]),
        np.concatenate([p.sigma_rad for p in parts]),
        np.concatenate([p.noise_rad for p in parts]),
    )


def _joined_ground(parts: Sequence[GroundError]) -> GroundError:
    return GroundError(*(np.concatenate([getattr(p, field.name) for p in parts]) for field in fields(GroundError)))


MIN_LIGHT = 0.5
"""Share of the nominal light on a CCD below which the user is warned."""


def _warnings(
    experiment: MonitorExperiment, course: CourseSpec, saturated: np.ndarray, share: np.ndarray
) -> tuple[str, ...]:
    out = []
    for i, channel in enumerate(experiment.path.channels):
        bad = np.flatnonzero(saturated[:, i])
        if len(bad):
            out.append(
                f"course: saturated pixels in the spot {channel.key} at {len(bad)} times, first at "
                f"{moment(course.times[bad[0]])}: centroids are biased; reduce the light"
            )
        worst = int(np.argmin(share[:, i]))
        if share[worst, i] < MIN_LIGHT:
            out.append(
                f"course: {channel.key} at {moment(course.times[worst])}: only {100 * share[worst, i]:.0f}% of the "
                "nominal light reaches the CCD"
            )
    return tuple(out)
