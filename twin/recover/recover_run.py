"""Recovery from a monitor's measured frames: read, search for artefacts, locate the spots, estimate the changes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from analysis.arrays import shows
from analysis.monitor.disturbances import FALSE_ALARM, Consistency, Disturbances
from analysis.monitor.monitor_formulas import MonitorGeometry, coefficients
from analysis.monitor.parameters import CameraCalibration, MonitorCalibration
from analysis.monitor.recovery import MotionModel, Recovery, judged_spots, recover_monitor, recovery_of
from analysis.spots.noise import NoiseModel
from analysis.spots.screened_fit import single_template
from analysis.spots.spot_image import NoiseParts, SpotError, SpotPositions
from optics.numerics.backend import Backend, one_blas_thread
from scenes.models.camera_sharpness import blur_warnings
from scenes.specs.course import moment
from scenes.specs.instrument import SIDES
from scenes.specs.monitor_frames import MeasurementSetup
from scenes.yaml.errors import InputError, Issue
from twin.framework.frame_store import mean_of
from twin.framework.procedure import Advance, silent
from twin.main_job.monitor_reading import MonitorReading, contradicted, rounded
from twin.monitor.crosstalk import CameraCrosstalk, crosstalk
from twin.monitor.monitor_experiment import MonitorExperiment, pieces
from twin.monitor.time_series import CourseSmoother, SmoothedCourse
from twin.recover.channel_measurement import ChannelMeasurement, ChannelResult, SpotResult, remedy
from twin.recover.measured_frames import (
    ChannelFrames,
    StateFrames,
    cannot_measure,
    order_warnings,
    read_measurement,
    repeated_frames,
)
from twin.sensors.area_detector import EmvaDetector, coarse_step_warnings

_GEOMETRY_ALONE = (
    "σ does not hold: without a model of the instrument it contains the noise of the images only, and two spots of a"
    " camera have four coordinates for its four changes: motions of the monitor's own parts, such as its prisms, are"
    " read as changes of the cameras; `instrument` with `disturbances` includes them in σ"
)
"""Reason to doubt the sigmas of a measurement without a prior on the motions of the monitor's parts."""
CALIBRATE, READ, MEASURE = "calibrate", "read the frames", "search and measure the spots"


@shows()
@dataclass(frozen=True, eq=False)
class RecoverRun:
    """Result of a measurement.

    Attributes
    ----------
    setup : MeasurementSetup
        Measurement.
    readings : tuple of MonitorReading
        Estimated changes of the cameras in each state after, relative to the state before.
    channels : tuple of ChannelResult
        Results of the channels, in the order of the spots.
    pitch : float
        Pixel pitch of the CCDs, in metres.
    smoothed : SmoothedCourse or None
        Estimate of the changes over time from all times of a series together; None for a single state, and without a
        prior.
    warnings : tuple of str
        Warnings to the user.
    """

    setup: MeasurementSetup
    readings: tuple[MonitorReading, ...]
    channels: tuple[ChannelResult, ...]
    pitch: float
    smoothed: SmoothedCourse | None = None
    warnings: tuple[str, ...] = ()

    @property
    def times(self) -> tuple[float, ...] | None:
        """Times of the states after, in seconds; None for a single state."""
        return self.setup.test.times

    @property
    def last(self) -> MonitorReading:
        """Estimated changes of the latest state."""
        return self.readings[-1]

    @cached_property
    def worst(self) -> tuple[int, Consistency] | None:
        """Number (from 0) of the state whose spot shifts agree least with the prior, and its chi-square test.

        None without a prior.
        """
        recoveries = [reading.recovery for reading in self.readings]
        if len(recoveries) == 1:
            return None if self.last.consistency is None else (0, self.last.consistency)
        return self.last.worst_of(
            np.concatenate([recovery.shift for recovery in recoveries]),
            np.concatenate([recovery.shift_covariance for recovery in recoveries]),
        )

    @property
    def all_warnings(self) -> tuple[str, ...]:
        """Warnings of the measurement, and of spot shifts that are inconsistent with the prior."""
        worst, when, rate = self.worst, "", f"{FALSE_ALARM:g}"
        if worst is None:
            return self.warnings
        if self.times is not None and len(self.times) > 1:
            when = f" at {moment(self.times[worst[0]])}, the worst of {len(self.times)} times"
            rate += " for the series"
        warnings = (*self.warnings, *contradicted(self.last.disturbances, worst[1], when, rate))
        if self.smoothed is not None:
            warnings += self.smoothed.jump_texts()
        return (*warnings, *(() if self.smoothed is None else self.smoothed.contradiction))


@dataclass(frozen=True, eq=False)
class _Calibrated:
    """Calibration of the instrument: cameras, spot shapes where they are modelled, and the prior on disturbances."""

    cameras: Mapping[str, CameraCalibration]
    noise: NoiseModel
    ccd: tuple[int, int] | None
    pitch: float
    calibration: MonitorCalibration | None = None
    disturbances: Disturbances | None = None
    experiment: MonitorExperiment | None = None
    warnings: tuple[str, ...] = field(default=())

    @property
    def motions(self) -> Mapping[str, MotionModel] | None:
        """Estimator -> motions of bodies that it estimates; None for an instrument without an optical model."""
        return None if self.experiment is None else self.experiment.motion_models

    def crosstalk(self, recovery: Recovery) -> Mapping[str, CameraCrosstalk]:
        if self.experiment is None or self.disturbances is None:
            return {}
        return crosstalk(self.experiment, recovery.shift_covariance[0])


def run_recover(
    setup: MeasurementSetup,
    backend: Backend,
    seed: int = 0,
    advance: Advance = silent,
    experiment: MonitorExperiment | None = None,
) -> RecoverRun:
    """Measure the spots and estimate the changes.

    Parameters
    ----------
    setup : MeasurementSetup
        Measurement.
    backend : Backend
        Backend that traces the instrument.
    seed : int
        Not used, since nothing is drawn at random.
    advance : Advance
        Called with the progress.
    experiment : MonitorExperiment or None
        Instrument if it has been built already; results are the same.

    Raises
    ------
    InputError
        Files cannot be read, or spots cannot be measured; each is named.
    """
    advance(CALIBRATE, 0, 1)
    bench = _modelled(setup, backend, experiment) if setup.model is not None else _formulas(setup)
    advance(CALIBRATE, 1, 1)
    count = len(setup.channels)
    channels = read_measurement(setup, bench.noise, bench.ccd, lambda done: advance(READ, done, count))
    if issues := repeated_frames(setup.test, channels):
        raise InputError(*issues)
    with one_blas_thread():
        results, recoveries, smoothed = _measured(setup, bench, channels, advance)
    names = tuple((camera, channel) for camera, channel in (name.split("/") for name in setup.channels))
    ground = None if bench.calibration is None else bench.calibration.ground
    centroid = setup.test.analysis.centroid
    times = setup.test.times
    source = f"the data sheet {setup.detector.name} gives"
    if setup.test.photon_transfer == "measured":
        source = "the dark and flat frames give"
    tables: Mapping[str, CameraCrosstalk] | None = None
    alone = (_GEOMETRY_ALONE,) if setup.model is None else ()
    readings: list[MonitorReading] = []
    for k, recovery in enumerate(recoveries):
        tables = bench.crosstalk(recovery) if tables is None else tables
        frames = min(len(result.channel.after[k].frames) for result in results)
        results_of_state = tuple(replace(result, after=result.after[k : k + 1]) for result in results)
        state_doubts = (
            *alone,
            *_shape_warnings(results_of_state, times, k),
            *_noise_warnings(results_of_state, times, source, k),
        )
        if smoothed is not None and recovery is recoveries[-1]:
            state_doubts += smoothed.contradiction  # recovered.json has the last state and its filtered changes
        arguments = bench.cameras, ground, bench.disturbances, recovery, tables, frames, centroid, state_doubts
        readings.append(MonitorReading(names, *arguments, together=len(recoveries)))
    frame_warnings = (*_shape_warnings(results, times), *_noise_warnings(results, times, source))
    input_warnings = (*alone, *bench.warnings, *order_warnings(channels, times), *_coarse_warnings(channels, setup))
    warnings = (*input_warnings, *frame_warnings, *_reading_warnings(readings, times), *readings[-1].unobserved)
    return RecoverRun(setup, tuple(readings), results, bench.pitch, smoothed, warnings)


def _modelled(setup: MeasurementSetup, backend: Backend, experiment: MonitorExperiment | None) -> _Calibrated:
    assert setup.model is not None
    experiment = MonitorExperiment(setup.model, backend) if experiment is None else experiment
    ccd = setup.model.instrument.autocollimator.area_ccd
    experiment.nominal_focus  # noqa: B018 - an instrument without spots raises its error first
    return _Calibrated(
        cameras=experiment.cameras,
        noise=experiment.detector.noise_model(experiment.exposure),
        ccd=(ccd.rows, ccd.columns),
        pitch=experiment.path.pitch,
        calibration=experiment.calibration,
        disturbances=experiment.disturbances,
        experiment=experiment,
        warnings=blur_warnings(setup.model, backend),
    )


def _formulas(setup: MeasurementSetup) -> _Calibrated:
    """Return the calibration of an instrument that is described by its geometry alone, without an optical model.

    The derivatives of the spots are those of closed formulas with corrections.
    """
    cameras = {}
    for name, spec in (setup.test.geometry or {}).items():
        geometry = MonitorGeometry(
            principal_distance_m=spec.principal_distance,
            separation_m=spec.separation,
            pitch_m=spec.pitch,
            field_beta_rad=abs(spec.field),
            principal_distance_across_m=spec.principal_distance_across,
        )
        by_pixel = coefficients("derived", geometry)
        labels = ("d_alpha", "d_beta", "d_gamma", "d_f")
        cameras[name] = CameraCalibration(
            geometry, spec.look, np.asarray(np.linalg.inv(by_pixel), np.float64), np.eye(4), labels, SIDES
        )
    exposure = setup.test.exposure or 0.0
    detector = EmvaDetector.from_sheet(setup.detector, exposure)
    pitches = {camera.geometry.pitch_m for camera in cameras.values()}
    return _Calibrated(cameras, detector.noise_model(exposure), None, max(pitches))


def _measured(
    setup: MeasurementSetup, bench: _Calibrated, channels: Sequence[ChannelFrames], advance: Advance
) -> tuple[tuple[ChannelResult, ...], list[Recovery], SmoothedCourse | None]:
    """Return the spots of all channels, the estimated changes of each state, and those over time of a series."""
    test = setup.test
    measurements: list[ChannelMeasurement] = []
    issues: list[Issue] = []
    for number, channel in enumerate(channels):
        advance(MEASURE, number, len(channels))
        shape = None
        if test.template == "twin":
            assert bench.calibration is not None
            shape = single_template(bench.calibration.template, number, channel.ccd)
        measurement = ChannelMeasurement(setup.test, channel, shape)
        issues += measurement.search()
        measurements.append(measurement)
    advance(MEASURE, len(channels), len(channels))
    if issues:
        raise InputError(*issues)
    if bench.calibration is not None and test.template == "twin" and all(item.plain for item in measurements):
        # clean frames of whole CCDs give exactly the numbers of the main job
        try:
            states, smoothed = _recover_clean(setup, bench, bench.calibration, channels)
        except SpotError as error:
            raise InputError(*_spot_issues(setup, channels, error)) from error
        return tuple(item.result() for item in measurements), states, smoothed
    for item in measurements:
        issues += item.measure()
    if issues:
        raise InputError(*issues)
    return tuple(item.result() for item in measurements), *_recover_corrected(setup, bench, measurements)


def _recover_clean(
    setup: MeasurementSetup, bench: _Calibrated, calibration: MonitorCalibration, channels: Sequence[ChannelFrames]
) -> tuple[list[Recovery], SmoothedCourse | None]:
    """Estimate the changes from frames without artefacts, computed in batches as in the main job."""
    states, count = len(channels[0].after), len(channels[0].after[0].frames)
    centroid = setup.test.analysis.centroid

    def means(frames: Sequence[StateFrames]) -> np.ndarray:
        return np.stack([mean_of(state_frames.frames) for state_frames in frames])

    before = judged_spots(
        means([channel.before for channel in channels]), len(channels[0].before.frames), calibration, centroid
    )
    smoother = _smoother(setup, bench)
    out: list[Recovery] = []
    for piece in pieces(states, sum(channel.after[0].frames.size for channel in channels)):
        after = np.stack([means([c.after[k] for c in channels]) for k in range(piece.start, piece.stop)])
        try:
            recovery = recover_monitor(
                before, after, calibration, centroid,
                disturbances=bench.disturbances, keep_parts=smoother is not None, motions=bench.motions, frames=count,
            )  # fmt: skip
        except SpotError as error:
            raise SpotError({piece.start * len(channels) + n: why for n, why in error.reasons.items()}) from error
        if smoother is not None:
            recovery = smoother.add(recovery)
        out += [recovery.at(slice(k, k + 1)) for k in range(piece.stop - piece.start)]
    return out, None if smoother is None else smoother.smoothed()


def _recover_corrected(
    setup: MeasurementSetup, bench: _Calibrated, measurements: Sequence[ChannelMeasurement]
) -> tuple[list[Recovery], SmoothedCourse | None]:
    """Estimate the changes of states whose spots were measured channel by channel because of artefacts."""
    calibration = bench.calibration
    if calibration is None:
        template = measurements[0].shape
        assert template is not None
        calibration = MonitorCalibration(bench.cameras, template, bench.noise)
    smoother = _smoother(setup, bench)
    first = _joint_positions([measurement.positions[0] for measurement in measurements])
    out: list[Recovery] = []
    for k in range(1, len(measurements[0].positions)):
        second = _joint_positions([measurement.positions[k] for measurement in measurements])
        covariances = [measurement.shift_covariance(k) for measurement in measurements]
        noise, disturbances = np.concatenate(covariances), bench.disturbances
        out.append(recovery_of(first, second, noise, calibration, disturbances, motions=bench.motions))
        if smoother is not None:
            before, after = zip(*(measurement.noise_parts(k) for measurement in measurements), strict=True)
            smoother.take(out[-1].shift, _joint_noise(before), _joint_noise(after))
    return out, None if smoother is None else smoother.smoothed()


def _smoother(setup: MeasurementSetup, bench: _Calibrated) -> CourseSmoother | None:
    """Return the estimator of changes over time for a series whose prior has time laws of the disturbances.

    It is None for a single state or without a prior.
    """
    times = setup.test.times
    if times is None or bench.disturbances is None:
        return None
    ground = None if bench.calibration is None else bench.calibration.ground
    return CourseSmoother(bench.disturbances, bench.cameras, ground, times)


def _joint_noise(parts_of_spots: Sequence[NoiseParts]) -> NoiseParts:
    """Return the noise contributions of spots on different CCDs, which are independent, as one object."""
    return NoiseParts(
        np.concatenate([parts.temporal for parts in parts_of_spots]),
        np.concatenate([parts.pattern for parts in parts_of_spots]),
    )


def _joint_positions(positions: Sequence[SpotPositions]) -> SpotPositions:
    """Return the positions of all spots in one object, without the maps of their images, which may differ in size."""
    names = ["row", "column", "temporal_covariance", "fixed_covariance", "flux", "background", "converged"]
    names.append("reduced_chi_square")
    values: dict[str, Any] = {
        name: np.concatenate([getattr(spot_positions, name) for spot_positions in positions]) for name in names
    }
    return SpotPositions(**values, iterations=max(spot_positions.iterations for spot_positions in positions))


def _spot_issues(setup: MeasurementSetup, channels: Sequence[ChannelFrames], error: SpotError) -> list[Issue]:
    """Return the issues of spots that cannot be measured, from the error's spot numbers, which count state by state."""
    issues = []
    for number, reason in error.reasons.items():
        channel = channels[number % len(channels)]
        # the nominal state is measured first, and the error does not say in which of both states the spot is
        states = channel.states
        state = states[min(number // len(channels) + 1, len(states) - 1)]
        issues.append(cannot_measure(setup.test, state, channel.name, reason, remedy(reason)))
    return issues


def state_name(times: Sequence[float] | None, number: int) -> str:
    """Return the name of a state as shown to the user; in a series it has the time.

    Parameters
    ----------
    times : Sequence[float] or None
        Times of a series, in seconds; None for a single state after.
    number : int
        0 for the nominal state, from 1 for those after it.
    """
    if number == 0:
        return "before"
    return "after" if times is None else f"at {moment(times[number - 1])}"


def _worst(
    results: Sequence[ChannelResult],
    times: Sequence[float] | None,
    suspect: Callable[[SpotResult], tuple[float, ...] | None],
    first: int = 0,
) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Yield, for each channel with suspect spots, the name of its worst state and the numbers that make it suspect.

    ``suspect`` is a function that returns these numbers for a spot, the largest for the worst, or None if it is not
    suspect; ``first`` is added to the index of a state after to obtain its number in the series.
    """
    for result in results:
        judged = (
            (suspect(spot), state_name(times, k + first * (k > 0))) for k, (_, spot) in enumerate(result.states())
        )
        suspects = [(numbers, state) for numbers, state in judged if numbers is not None]
        if suspects:
            numbers, state = max(suspects)
            others = f", the worst of {len(suspects)} states" if len(suspects) > 1 else ""
            yield f"{result.channel.name} {state}{others}", numbers


def _reading_warnings(readings: Sequence[MonitorReading], times: Sequence[float] | None) -> tuple[str, ...]:
    """Return warnings of the estimates that were not yet given for the frames; for a series the first of each kind.

    A warning that several states have is given once, with the number of states.
    """
    texts: dict[str, list[str]] = {}
    for k, reading in enumerate(readings):
        for text in (*reading.doubts, *reading.notes):
            # the worst contradiction of a series has another limit and is reported separately
            if text not in reading.earlier_doubts and text not in reading.contradiction:
                # texts that differ in numbers only are one warning
                texts.setdefault(text.partition(":")[0], []).append(f"{state_name(times, k + 1)}: {text}")
    return tuple(
        repeated[0] if len(repeated) == 1 else f"{repeated[0]} (first of {len(repeated)} states)"
        for repeated in texts.values()
    )


def _shape_warnings(results: Sequence[ChannelResult], times: Sequence[float] | None, first: int = 0) -> tuple[str, ...]:
    """Return warnings of spots whose core does not have the calibrated shape, for a series the worst of each channel.

    ``first`` is added to the index of a state after to obtain its number in the series.
    """
    return tuple(
        f"{where}: the spot does not have the calibrated shape, reduced chi-square of its"
        f" core {chi:.2f} over {pixels} pixels; possible causes are defocus, a reflection too close to be separated, "
        "and vibration (`vibration: fitted` allows for it); sigma does not cover the effect on the position"
        for where, (chi, pixels) in _worst(results, times, lambda spot: None if spot.fits else spot.core, first)
    )


def _coarse_warnings(channels: Sequence[ChannelFrames], setup: MeasurementSetup) -> tuple[str, ...]:
    """Return warnings of CCDs whose noise, specified or measured, is too small for the steps of their grey values.

    Rounding errors are then equal in all frames and do not average out.
    """
    if setup.test.photon_transfer == "stated":
        return coarse_step_warnings(channels[0].raw_noise, f"area CCD {setup.detector.name}")
    whose = f"area CCD {setup.detector.name}, as measured,"
    return tuple(
        text for channel in channels for text in coarse_step_warnings(channel.raw_noise, f"{channel.name}: {whose}")
    )


def _noise_causes(ratio: float) -> str:
    """Return, as text, possible causes and the consequences of noise that is ``ratio`` times the specified noise."""
    if ratio > 1.0:
        return (
            "another gain or read-out, or interference; the noise σ and the search for artefacts treat the excess as"
            " read noise, and use the specified gain"
        )
    return (
        "another gain or read-out, or frames that were averaged, smoothed or compressed; the noise σ and the search for"
        " artefacts use the specified noise"
    )


def _noise_warnings(
    results: Sequence[ChannelResult], times: Sequence[float] | None, source: str, first: int = 0
) -> tuple[str, ...]:
    """Return warnings of frames whose noise differs from that specified, for a series the worst of each channel.

    ``source`` names where the noise is specified; ``first`` is added to the index of a state after to obtain its number
    in the series.
    """

    def apart(spot: SpotResult) -> tuple[float, ...] | None:
        return None if spot.noise_ratio is None else (abs(math.log(spot.noise_ratio)), spot.noise_ratio)

    return tuple(
        f"{where}: beside the spot the frames are {ratio:.2f} times as noisy as {source}: {_noise_causes(ratio)}: name "
        "the correct `detector`, or measure it with dark and flat frames and `photon_transfer: measured`"
        for where, (_, ratio) in _worst(results, times, apart, first)
    )


def recover_numbers(run: RecoverRun) -> dict[str, Any]:
    """Return the contents of recovered.json: the main job's keys for the last state, artefacts, and all states."""
    out: dict[str, Any] = {**rounded(run.last.recovered_dict())}
    out["warnings"] = list(run.all_warnings)
    out["channels"] = {
        result.channel.name: {name.replace(" ", "_"): _spot_numbers(spot) for name, spot in result.states()}
        for result in run.channels
    }
    transfers = {r.channel.name: r.channel.transfer for r in run.channels if r.channel.transfer is not None}
    if transfers:
        out["photon_transfer"] = {name: vars(transfer) for name, transfer in transfers.items()}
    if run.times is not None:
        out["times_s"] = list(run.times)
        out["series"] = [rounded(reading.recovered_dict()) for reading in run.readings]
    if run.smoothed is not None:
        between = run.smoothed.between_dict()
        out["smoothed"] = {**run.smoothed.changes.groups(), "disturbances": run.smoothed.to_dict(), "between": between}
    return out


def _spot_numbers(spot: SpotResult) -> dict[str, Any]:
    return {
        "frames": len(spot.frames.frames),
        "first_pixel": list(spot.frames.offset),
        "excluded_pixels": int(np.count_nonzero(~spot.used)),
        "defects": [
            {"kind": finding.kind, "text": finding.text, "corrected": finding.corrects} for finding in spot.findings
        ],
        "sigma_cost": round(spot.cost, 6),
    }
