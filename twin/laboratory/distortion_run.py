"""Interior orientation and distortion by paper 004 (section 3), from the turntable's calibration to distortion.json.

The analysis gets frames, readings, the calibration of the table and what a laboratory knows beforehand: the pixels,
their noise, and by how much the energy centroid of a spot departs from its chief ray by the camera's design; or spots
and readings from files of measurements. The truth of a simulated bench comes from exact chief rays of the as-built
camera at the true angles, and is put through the same definitions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array
from analysis.orientation import interior
from analysis.orientation.interior import OrientationError, distortion, principal_distance, principal_point
from analysis.orientation.interior import principal_distance_and_point as distance_and_point
from analysis.spots.spot_positions import SpotError
from analysis.turntable.dividing_error import FITS, CalibrationSeries, DividingCompensation, choose, compensate, covered
from optics.numerics.backend import Backend
from scenes.specs.camera_tests import DistortionFiles, DistortionTestSpec, MeasuredDistortionSpec
from scenes.specs.resolved import DistortionSetup, ExperimentSetup, MeasuredDistortionSetup
from scenes.yaml.errors import InputError, Issue
from twin.framework.memory import Lowered, require_memory
from twin.framework.procedure import Advance, BenchError, silent
from twin.laboratory.distortion_bench import DistortionBench, DistortionRecord, DistortionTruth
from twin.laboratory.measured_readings import (
    Comparisons,
    SpotReadings,
    calibrated_text,
    read_spots,
    read_turntable,
    unwrapped,
)
from twin.laboratory.turntable_run import TurntableModel, usable_fits

CLOSED_FORMS = tuple(name for name in FITS if name != "network")
"""Fits of the dividing error that compete for the compensation. The network takes minutes to train; the turntable test
ranks it.
"""
WIDEST = np.radians(40.0)
"""Angle from the middle of the line beyond which a reading is a mistake; the model's tangents end at 45 deg."""
_EXACT = 1e-9
"""Metres: stands for the noise of the truth, whose estimates do not depend on it."""
_GREY, _SPOT_PIXEL = 2.0, 33.0
"""Bytes per pixel of a frame, and of the mean image of a spot."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """One way to f, p and distortion.

    Attributes:
        f, p: metres; p is zero where it is not fitted.
        distortion: of the points, (N,), metres.
        f_sigma, p_sigma: metres, None where an equation gives none.
    """

    f: float
    p: float
    distortion: Array
    f_sigma: float | None = None
    p_sigma: float | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class DistortionRun:
    """One test, on a simulated bench or on measured angles and spots.

    Attributes:
        test: what its file says.
        seed: of what was drawn.
        about: principal distance, about, metres; it serves to see the scatter between sets.
        reading: of the turntable, (N, S), radians.
        present: which exposures there are, (N, S).
        calibration: of the turntable; None if angles count as read.
        compensation: of its dividing error; None likewise.
        spots: as located.
        means: how sets are reduced.
        raw, compensated: with angles as read, and freed from the dividing error; without a calibration the same.
        stated: the smooth model's fit with nothing but the stated noise, for its chi-square.
        readings: the table of spots as read from files; None for a simulated bench.
        tables: of the turntable's calibration, as read from files.
    """

    test: DistortionTestSpec | MeasuredDistortionSpec
    seed: int
    about: float
    reading: Array
    present: NDArray[np.bool_]
    calibration: CalibrationSeries | None
    compensation: DividingCompensation | None
    spots: interior.Spots
    means: interior.PointMeans
    raw: interior.Distortion
    compensated: interior.Distortion
    stated: interior.InteriorOrientation
    readings: SpotReadings | None = None
    tables: tuple[Comparisons, ...] = ()

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """Exposures that Chauvenet's criterion takes out, (N, S)."""
        return self.present & ~self.means.keep

    @cached_property
    def line(self) -> interior.LineOrientation:
        """The joint model with compensated angles in the terms of a payload's line."""
        return interior.line_orientation(self.compensated.smooth)

    @cached_property
    def estimates(self) -> Mapping[str, Estimate]:
        """The printed equations and the fits with a constant, all with compensated angles."""
        return _estimates(self.compensated.fit, self.compensated.smooth, self.compensated.zero)


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedDistortion(DistortionRun):
    """A test on the simulated bench, which also knows the truth.

    Attributes:
        bench: with all that was set up.
        record: what the analysis got.
        truth: what it did not get.
        table: the turntable; holds the truth of its dividing error.
        calibration, compensation: there are always.
    """

    calibration: CalibrationSeries
    compensation: DividingCompensation
    bench: DistortionBench
    record: DistortionRecord
    truth: DistortionTruth
    table: TurntableModel

    @property
    def setup(self) -> DistortionSetup:
        """The test with all it refers to."""
        return self.bench.setup

    def true_fit(self, terms: Sequence[str] = interior.CALIBRATED) -> interior.InteriorOrientation:
        """Fit of the exact chief rays at the true angles, with the terms and exposures of the measurement."""
        where, turned = self.means.mean(self.truth.place[..., 0]), self.means.mean(self.truth.turn)
        return interior.fit_interior_orientation(where, turned, _EXACT, terms)

    @cached_property
    def true_distortion(self) -> Array:
        """D of the chief rays, (N,), metres."""
        return self.true_fit().residual

    def error(self, measured: interior.Distortion) -> Array:
        """Measured minus true distortion, (N,), metres."""
        return np.asarray(measured.distortion - self.true_distortion)

    @cached_property
    def true_estimates(self) -> Mapping[str, Estimate]:
        """Values of `estimates` from exact chief rays at the true angles."""
        return _estimates(self.true_fit(), self.true_fit(interior.SMOOTH), 0.0)


def _estimates(
    fit: interior.InteriorOrientation, smooth: interior.InteriorOrientation, zero: float
) -> dict[str, Estimate]:
    """Equations (2), (3) and (4), and the fits; of (4) with f of (3), and of (2) once more with angles from `zero`."""
    where, turned = fit.position, fit.angle

    def printed(f: Array | float, p: Array | float, angle: Array) -> Estimate:
        return Estimate(float(f), float(p), distortion(where, angle, f, p))

    alone = principal_distance(where, turned)
    out = {
        "eq2": printed(*distance_and_point(where, turned), turned),
        "eq3": printed(alone, 0.0, turned),
        "eq4": printed(alone, principal_point(where, turned, alone), turned),
        "eq2_zero_from_constant": printed(*distance_and_point(where, turned - zero), turned - zero),
    }
    f, p = "principal_distance", "principal_point"
    for name, own in (("constant", fit), ("constant_radial3", smooth)):
        left = own.position - _calibrated(own)
        out[name] = Estimate(own.value(f), own.value(p), left, own.sigma(f), own.sigma(p))
    return out


def _calibrated(fit: interior.InteriorOrientation) -> Array:
    """What distortion is counted from: c + f tan W - p tan^2 W of a fit at its angles, (N,), metres."""
    tangent = np.tan(fit.angle)
    c, f, p = (fit.value(term) for term in interior.CALIBRATED)
    return np.asarray(c + f * tangent - p * tangent**2)


def measure(bench: DistortionBench, seed: int, advance: Advance = silent) -> SimulatedDistortion:
    """Calibrate the table, carry out the test and measure it.

    Raises:
        BenchError: what was recorded cannot be measured.
    """
    setup = bench.setup
    table = TurntableModel(setup.turntable, seed)
    series, held_out = table.calibrate(), table.held_out()
    plan = setup.turntable.calibration
    try:
        compensation = compensate(series, choose(series, seed, CLOSED_FORMS, plan.folds), held_out)
    except ValueError as error:
        raise BenchError(str(error), ("turntable",), "a turntable file with a finer or longer calibration") from error
    record, truth = bench.record(table, seed, advance)
    spots = _locate(bench, record)
    # the line's middle was put on the pinhole at the camera's angle; the prescription's focal length serves to see
    # scatter only
    args = record.reading, spots, setup.turntable.camera_angle, bench.path.model.line_principal_distance
    try:
        return SimulatedDistortion(
            test=setup.test,
            seed=seed,
            calibration=series,
            compensation=compensation,
            bench=bench,
            record=record,
            truth=truth,
            table=table,
            **reduce(*args, compensation),
        )
    except OrientationError as error:
        raise BenchError(
            str(error), ("points",), f"{len(interior.SMOOTH) + 1} or more, over the whole field"
        ) from error


def reduce(
    reading: Array,
    spots: interior.Spots,
    zero: float,
    about: float,
    compensation: DividingCompensation | None,
    angle_sigma: float = 0.0,
    reverse: bool = False,
    present: NDArray[np.bool_] | None = None,
) -> dict[str, Any]:
    """Readings and spots to interior orientation and distortion, whichever bench they come from.

    Args:
        reading: of the turntable, (N, S), radians.
        spots: on the line.
        zero: reading at which the middle of the line is imaged, radians.
        about: principal distance, about, metres; it serves to see scatter only.
        compensation: of the turntable; None for angles as read.
        angle_sigma: of the angles as read without a compensation, radians.
        reverse: readings rise where places on the line fall.
        present: which exposures there are, (N, S); None for all.

    Returns:
        The attributes of a `DistortionRun` that follow from readings and spots.

    Raises:
        OrientationError: fewer points than unknowns, or angles that do not determine them.
    """
    sense = -1.0 if reverse else 1.0
    read = sense * (reading - zero)
    if compensation is None:
        means = interior.reduce_sets(read, spots, about, 0.0, present)
        common = angle_sigma**2 * np.eye(len(reading))
        raw = compensated = interior.Distortion.measure(read, spots, means, common)
    else:
        corrected = sense * (compensation.correct(reading) - float(compensation.correct(zero)))
        means = interior.reduce_sets(corrected, spots, about, about * compensation.repeatability, present)
        # the white part is left to the test's own residuals, which see it at more angles than the calibration's did
        common = replace(compensation, white=0.0).covariance(means.mean(reading))
        raw, compensated = (
            interior.Distortion.measure(read, spots, means),
            interior.Distortion.measure(corrected, spots, means, common),
        )
    fit = compensated.fit
    return {
        "reading": reading,
        "spots": spots,
        "about": about,
        "present": np.ones(reading.shape, bool) if present is None else present,
        "means": means,
        "raw": raw,
        "compensated": compensated,
        "stated": interior.fit_interior_orientation(
            fit.position, fit.angle, means.sigma, interior.SMOOTH, angle_covariance=common
        ),
    }


def measure_files(spec: MeasuredDistortionSpec, seed: int) -> DistortionRun:
    """Read the angles and spots, and do the same with them.

    Raises:
        InputError: a table cannot be used, or does not determine what is asked for.
    """
    files = spec.measured
    found = read_spots(files)
    compensation, series, zero = None, None, files.zero
    tables: tuple[Comparisons, ...] = ()
    if files.turntable is not None:
        tables = read_turntable(files.turntable)
        cal, *held = tables
        series = cal.series
        # whole turns between the calibration's readings and those of the test
        turns = unwrapped(np.array([files.zero]), 0.5 * float(series.angle[0] + series.angle[-1]))[0] - files.zero
        zero, found = files.zero + turns, replace(found, reading=found.reading + turns)
        _check_region(files, found, series, zero)
        names, _ = usable_fits(files.turntable, cal, CLOSED_FORMS)
        choice = choose(series, seed, names, files.turntable.folds)
        compensation = compensate(series, choice, held[0].series if held else None)
    _check_angles(files, found, zero)
    scatter = files.angle_sigma or 0.0, files.reversed, found.present
    try:
        reduced = reduce(found.reading, found.spots, zero, spec.principal_distance, compensation, *scatter)
    except OrientationError as error:
        text = str(error).removeprefix("interior orientation: ")
        allowed = "reversed: true, where readings rise as places fall" if "opposite senses" in text else None
        raise files.error(text, ("spots",), allowed=allowed) from error
    return DistortionRun(
        test=spec, seed=seed, calibration=series, compensation=compensation, readings=found, tables=tables, **reduced
    )


def _check_region(files: DistortionFiles, found: SpotReadings, series: CalibrationSeries, zero: float) -> None:
    """InputError unless the turntable is calibrated wherever it was read."""
    allowed = f"{calibrated_text(series.angle)}, where the turntable is calibrated"
    if not covered(series.angle, zero):
        shown = f"{np.degrees(files.zero):.9g} deg"
        raise files.error("outside of the calibrated readings", ("zero",), found=shown, allowed=allowed)
    beyond = ~covered(series.angle, found.reading) & (found.lines > 0)
    if np.any(beyond):
        place = np.argwhere(beyond)[0]
        shown = f"{np.degrees(found.reading[tuple(place)]):.9g} deg"
        line = int(found.lines[tuple(place)])
        text = "outside of the calibrated readings"
        raise InputError(Issue(text, found.file.file, line, (found.head,), shown, allowed))


def _check_angles(files: DistortionFiles, found: SpotReadings, zero: float) -> None:
    """InputError for readings that are far from the zero, which is a mistaken zero or unit."""
    off = np.abs(found.reading - zero) * (found.lines > 0)
    if np.max(off) > WIDEST:
        place = np.unravel_index(int(np.argmax(off)), off.shape)
        shown = f"{np.degrees(found.reading[place]):.9g} deg, {np.degrees(off[place]):.4g} deg from the zero"
        allowed = f"within {np.degrees(WIDEST):.0f} deg of `zero`, the reading at which the line's middle is imaged"
        line = int(found.lines[place])
        raise InputError(Issue("an angle beyond any field", found.file.file, line, (found.head,), shown, allowed))


def _locate(bench: DistortionBench, record: DistortionRecord) -> interior.Spots:
    try:
        return interior.locate_spots(
            record.frames,
            record.column,
            bench.middle_column,
            bench.ccd.band.pitch,
            bench.noise,
            bench.radius,
            bench.design_offset,
        )
    except SpotError as error:
        reason = next(iter(error.reasons.values()))
        problem = f"{len(error.reasons)} of {record.column.size} spots cannot be measured; the first: {reason}"
        remedy = "less light: 30 to 80 percent is good" if "saturated" in reason else "more light or more frames"
        raise BenchError(problem, ("light",), remedy) from error


def run_distortion(
    setup: ExperimentSetup[Any], backend: Backend, seed: int, advance: Advance = silent
) -> DistortionRun:
    """``python -m twin.lab distortion``.

    Raises:
        InputError: ``as_built`` names what the camera does not have; a table of measurements cannot be used.
        BenchError: the test cannot be carried out or measured as its file says.
    """
    if isinstance(setup, MeasuredDistortionSetup):
        advance("read and fit", 0, 1)
        return measure_files(setup.test, seed)
    assert isinstance(setup, DistortionSetup)
    test = setup.test
    each = test.points * test.window**2 * (test.frames * _GREY + _SPOT_PIXEL)
    require_memory(Lowered(test, ("sets",), test.sets, "sets", lambda sets: sets * each))
    return measure(DistortionBench.build(setup, backend, advance), seed, advance)
