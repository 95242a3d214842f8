"""A measurement of a monitor: read, searched for defects, measured, and read by the estimators of the main job."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from analysis.monitor.calibration import CameraCalibration, MonitorCalibration
from analysis.monitor.disturbances import Disturbances
from analysis.monitor.monitoring import MonitorGeometry, coefficients
from analysis.monitor.recovery import Recovery, recover, recovery_of
from analysis.spots.noise import NoiseModel
from analysis.spots.screened_fit import one_shape
from analysis.spots.spot_positions import SpotError, SpotPositions, difference_covariance
from optics.numerics.backend import Backend
from optics.numerics.threads import one_blas_thread
from scenes.models.camera_sharpness import blur_warnings
from scenes.specs.channel import SIDES
from scenes.specs.measured.monitor_frames_setup import MeasurementSetup
from scenes.yaml.errors import InputError, Issue
from twin.main_job.monitor_reading import MonitorReading
from twin.monitor.crosstalk import CameraCrosstalk, crosstalk
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.recover.channel_measurement import ChannelMeasurement, ChannelResult, remedy
from twin.recover.measured_frames import ChannelFrames, cannot_measure, read_measurement
from twin.run.procedure import Advance, silent
from twin.sensors.area_detector import EmvaDetector

__all__ = ["RecoverRun", "run_recover"]

CALIBRATE, READ, MEASURE = "calibrate", "read the frames", "search and measure the spots"


@dataclass(frozen=True, eq=False)
class RecoverRun:
    """What a measurement gave.

    Attributes:
        setup: the measurement.
        readings: of each state after.
        channels: in the order of the spots.
        pitch: of the CCDs' pixels, metres.
        warnings: what the user should know.
    """

    setup: MeasurementSetup
    readings: tuple[MonitorReading, ...]
    channels: tuple[ChannelResult, ...]
    pitch: float
    warnings: tuple[str, ...] = ()

    @property
    def times(self) -> tuple[float, ...] | None:
        """Of the states after, seconds; None for a single one."""
        return self.setup.test.times

    @property
    def last(self) -> MonitorReading:
        """The latest state's."""
        return self.readings[-1]


@dataclass(frozen=True, eq=False)
class _Bench:
    """What is known of the instrument: calibrated cameras, shapes of the spots where they are modelled, what moves."""

    cameras: Mapping[str, CameraCalibration]
    noise: NoiseModel
    ccd: tuple[int, int] | None
    pitch: float
    calibration: MonitorCalibration | None = None
    disturbances: Disturbances | None = None
    experiment: MonitorExperiment | None = None
    warnings: tuple[str, ...] = field(default=())

    def crosstalk(self, recovery: Recovery) -> Mapping[str, CameraCrosstalk]:
        if self.experiment is None or self.disturbances is None:
            return {}
        spread, instrument = recovery.shift_covariance[0], self.experiment.instrument
        own = {name: instrument.coordinates_of(name) for name in self.cameras}
        return crosstalk(self.experiment, {name: spread[np.ix_(k, k)] for name, k in own.items()})


def run_recover(
    setup: MeasurementSetup, backend: Backend, advance: Advance = silent, experiment: MonitorExperiment | None = None
) -> RecoverRun:
    """Measure the spots and read what they say.

    Args:
        setup: the measurement.
        backend: where the instrument is traced.
        advance: told what is being done.
        experiment: the instrument where it has been built already; results are the same.

    Raises:
        InputError: files that cannot be read, or spots that cannot be measured, by name.
    """
    advance(CALIBRATE, 0, 1)
    bench = _modelled(setup, backend, experiment) if setup.model is not None else _formulas(setup)
    advance(CALIBRATE, 1, 1)
    count = len(setup.channels)
    channels = read_measurement(setup, bench.noise, bench.ccd, lambda done: advance(READ, done, count))
    with one_blas_thread():
        results, recovery = _measured(setup, bench, channels, advance)
    names = tuple((camera, side) for camera, side in (name.split("/") for name in setup.channels))
    ground = None if bench.calibration is None else bench.calibration.ground
    centroid = setup.test.analysis.centroid
    tables: Mapping[str, CameraCrosstalk] | None = None
    readings = []
    for k in range(len(channels[0].after)):
        one = recovery.at(slice(k, k + 1))
        tables = bench.crosstalk(one) if tables is None else tables
        frames = min(len(result.channel.after[k].frames) for result in results)
        readings.append(MonitorReading(names, bench.cameras, ground, bench.disturbances, one, tables, frames, centroid))
    return RecoverRun(setup, tuple(readings), results, bench.pitch, (*bench.warnings, *_unlike(results)))


def _modelled(setup: MeasurementSetup, backend: Backend, experiment: MonitorExperiment | None) -> _Bench:
    assert setup.model is not None
    experiment = MonitorExperiment(setup.model, backend) if experiment is None else experiment
    ccd = setup.model.instrument.monitor.area_ccd
    experiment.nominal_focus  # noqa: B018 - an instrument without spots is told first
    return _Bench(
        cameras=experiment.cameras,
        noise=experiment.detector.noise_model(experiment.exposure),
        ccd=(ccd.rows, ccd.columns),
        pitch=experiment.path.pitch,
        calibration=experiment.calibration,
        disturbances=experiment.disturbances,
        experiment=experiment,
        warnings=blur_warnings(setup.model, backend),
    )


def _formulas(setup: MeasurementSetup) -> _Bench:
    """By the geometry alone: Jacobians are those of the corrected formulas."""
    cameras = {}
    for name, given in (setup.test.geometry or {}).items():
        geometry = MonitorGeometry(
            focal_length_m=given.focal_length,
            separation_m=given.separation,
            pixel_m=given.pixel,
            field_beta_rad=abs(given.field),
            focal_length_x_m=given.focal_length_across,
        )
        by_pixel = coefficients("derived", geometry)
        labels = ("d_alpha", "d_beta", "d_gamma", "d_f")
        cameras[name] = CameraCalibration(
            geometry, given.look, np.asarray(np.linalg.inv(by_pixel), np.float64), np.eye(4), labels, SIDES
        )
    exposure = setup.test.exposure or 0.0
    detector = EmvaDetector.from_sheet(setup.detector, exposure)
    pitches = {camera.geometry.pixel_m for camera in cameras.values()}
    return _Bench(cameras, detector.noise_model(exposure), None, max(pitches))


def _measured(
    setup: MeasurementSetup, bench: _Bench, channels: Sequence[ChannelFrames], advance: Advance
) -> tuple[tuple[ChannelResult, ...], Recovery]:
    """All spots, and what they say of all states."""
    test = setup.test
    found: list[ChannelMeasurement] = []
    issues: list[Issue] = []
    for number, channel in enumerate(channels):
        advance(MEASURE, number, len(channels))
        shape = None
        if test.template == "twin":
            assert bench.calibration is not None
            shape = one_shape(bench.calibration.template, number, channel.ccd)
        worker = ChannelMeasurement(setup.test, channel, shape)
        issues += worker.search()
        found.append(worker)
    advance(MEASURE, len(channels), len(channels))
    if issues:
        raise InputError(*issues)
    if bench.calibration is not None and test.template == "twin" and all(one.plain for one in found):
        # clean frames of whole CCDs: to the bit what the main job makes of them
        before = np.stack([channel.before.frames for channel in channels])
        after = np.stack(
            [np.stack([channel.after[k].frames for channel in channels]) for k in range(len(channels[0].after))]
        )
        try:
            recovery = recover(
                before, after, bench.calibration, test.analysis.centroid, disturbances=bench.disturbances
            )
        except SpotError as error:
            raise InputError(*_spot_issues(setup, channels, error)) from error
        return tuple(one.result() for one in found), recovery
    for one in found:
        issues += one.measure()
    if issues:
        raise InputError(*issues)
    calibration = bench.calibration
    if calibration is None:
        template = found[0].shape
        assert template is not None
        calibration = MonitorCalibration(bench.cameras, template, bench.noise)
    states = len(channels[0].after)
    first = _joined([one.positions[0] for one in found])
    second = _joined([one.positions[1 + k] for k in range(states) for one in found])
    spread = [
        difference_covariance(one.positions[0], one.positions[1 + k], one.channel.noise)
        for k in range(states)
        for one in found
    ]
    recovery = recovery_of(first, second, np.concatenate(spread), calibration, bench.disturbances)
    return tuple(one.result() for one in found), recovery


def _joined(positions: Sequence[SpotPositions]) -> SpotPositions:
    """Spots together, without their maps, which may be of different size."""
    names = ["row", "column", "temporal_covariance", "fixed_covariance", "flux", "background", "converged"]
    names.append("reduced_chi_square")
    values: dict[str, Any] = {name: np.concatenate([getattr(one, name) for one in positions]) for name in names}
    return SpotPositions(**values, iterations=max(one.iterations for one in positions))


def _spot_issues(setup: MeasurementSetup, channels: Sequence[ChannelFrames], error: SpotError) -> list[Issue]:
    """Of spots that are numbered state by state."""
    out = []
    for number, reason in error.reasons.items():
        channel = channels[number % len(channels)]
        # the nominal state is measured first, and of it nothing says which of both it was
        states = channel.states
        state = states[min(number // len(channels) + 1, len(states) - 1)]
        out.append(cannot_measure(setup.test, state, channel.name, reason, remedy(reason)))
    return out


def _unlike(results: Sequence[ChannelResult]) -> tuple[str, ...]:
    """Spots whose core is not as calibrated."""
    out = []
    for result in results:
        for name, spot in result.states():
            if not spot.fits and spot.core is not None:
                out.append(
                    f"{result.channel.name} {name}: the spot has not the calibrated shape, reduced chi-square of its"
                    f" core {spot.core[0]:.2f} over {spot.core[1]} pixels: defocus, a reflection too near to be told"
                    " apart, or vibration, which `vibration: fitted` allows for; sigma does not hold what it does to"
                    " the place"
                )
    return tuple(out)
