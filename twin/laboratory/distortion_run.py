"""Interior orientation and distortion by paper 004 (section 3), from the turntable's calibration to distortion.json.

The analysis gets frames, readings, the calibration of the table and what a laboratory knows beforehand: the pixels,
their noise, and by how much the energy centroid of a spot departs from its chief ray by the camera's design. The truth
comes from exact chief rays of the as-built camera at the true angles, and is put through the same definitions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from analysis.orientation.distortion_model import OrientationError, distortion, principal_distance, principal_point
from analysis.orientation.distortion_model import principal_distance_and_point as distance_and_point
from analysis.orientation.interior import InteriorOrientation, fit_interior_orientation
from analysis.orientation.measurement import (
    CALIBRATED,
    SMOOTH,
    Distortion,
    PointMeans,
    Spots,
    locate_spots,
    reduce_sets,
)
from analysis.spots.spot_positions import SpotError
from analysis.turntable.angle_fits import FITS
from analysis.turntable.dividing_error import CalibrationSeries, DividingCompensation, choose, compensate
from optics.numerics.backend import Backend
from scenes.specs.lab_setup import DistortionSetup
from twin.laboratory.distortion_bench import DistortionBench, DistortionRecord, DistortionTruth
from twin.laboratory.turntable_bench import TurntableModel
from twin.run.procedure import Advance, BenchError, silent

Array = NDArray[np.float64]
CLOSED_FORMS = tuple(name for name in FITS if name != "network")
"""Fits of the dividing error that compete for the compensation. The network takes minutes to train; the turntable test
ranks it.
"""
_EXACT = 1e-9
"""Metres: stands for the noise of the truth, whose estimates do not depend on it."""


@dataclass(frozen=True)
class Estimate:
    """One way to f, p and distortion.

    Attributes:
        f, p: as measured, metres; p is zero where it is not fitted.
        f_true, p_true: the same from the exact chief rays.
        f_sigma, p_sigma: metres, None where the equation gives none.
        rms: of the distortion, metres.
        error: RMS of measured minus true distortion by this estimate, metres.
    """

    f: float
    p: float
    f_true: float
    p_true: float
    f_sigma: float | None
    p_sigma: float | None
    rms: float
    error: float


@dataclass(frozen=True, eq=False)
class DistortionRun:
    """One test, measured.

    Attributes:
        bench: with all that was set up.
        seed: of what was drawn.
        record: what the analysis got.
        truth: what it did not get.
        table: the turntable; holds the truth of its dividing error.
        calibration: of the turntable.
        compensation: of its dividing error.
        spots: as located.
        means: how sets are reduced.
        raw, compensated: with angles as read, and freed from the dividing error.
    """

    bench: DistortionBench
    seed: int
    record: DistortionRecord
    truth: DistortionTruth
    table: TurntableModel
    calibration: CalibrationSeries
    compensation: DividingCompensation
    spots: Spots
    means: PointMeans
    raw: Distortion
    compensated: Distortion

    @property
    def setup(self) -> DistortionSetup:
        """The test with all it refers to."""
        return self.bench.setup

    def true_fit(self, terms: Sequence[str] = CALIBRATED) -> InteriorOrientation:
        """The same fit of the exact chief rays at the true angles, averaged over the same exposures."""
        where, turned = self.means.mean(self.truth.place[..., 0]), self.means.mean(self.truth.turn)
        return fit_interior_orientation(where, turned, _EXACT, terms)

    @cached_property
    def true_distortion(self) -> Array:
        """D of the chief rays, (N,), metres."""
        return self.true_fit().residual

    def error(self, measured: Distortion) -> Array:
        """Measured minus true distortion, (N,), metres."""
        return np.asarray(measured.distortion - self.true_distortion)

    @cached_property
    def estimates(self) -> Mapping[str, Estimate]:
        """The printed equations and the fits with a constant, all with compensated angles."""
        fit, smooth = self.compensated.fit, self.compensated.smooth
        where, turned = fit.position, fit.angle
        exact = self.true_fit()
        zeroed = turned - self.compensated.zero
        out = {
            "eq2": _printed(2, (where, turned), (exact.position, exact.angle)),
            "eq3": _printed(3, (where, turned), (exact.position, exact.angle)),
            "eq4": _printed(4, (where, turned), (exact.position, exact.angle)),
            "eq2_zero_from_constant": _printed(2, (where, zeroed), (exact.position, exact.angle)),
        }
        for name, own, terms in (("constant", fit, CALIBRATED), ("constant_radial3", smooth, SMOOTH)):
            true = self.true_fit(terms)
            # distortion is what is left after the calibrated terms of the model
            parts = [fit.position - fit_part(one) for one in (own, true)]
            parts[1] = true.position - fit_part(true)
            out[name] = Estimate(
                own.value("principal_distance"),
                own.value("principal_point"),
                true.value("principal_distance"),
                true.value("principal_point"),
                own.sigma("principal_distance"),
                own.sigma("principal_point"),
                rms(parts[0]),
                rms(parts[0] - parts[1]),
            )
        return out


def fit_part(fit: InteriorOrientation) -> Array:
    """What distortion is counted from: c + f tan W - p tan^2 W of a fit at its angles, (N,), metres."""
    tangent = np.tan(fit.angle)
    c, f, p = (fit.value(term) for term in CALIBRATED)
    return np.asarray(c + f * tangent - p * tangent**2)


def _printed(number: int, measured: tuple[Array, Array], true: tuple[Array, Array]) -> Estimate:
    """Equation (2), (3), or (4) with f of (3), on measured and on true (L, W)."""
    found = []
    for where, turned in (measured, true):
        if number == 2:
            f, p = (float(value) for value in distance_and_point(where, turned))
        else:
            f = float(principal_distance(where, turned))
            p = float(principal_point(where, turned, f)) if number == 4 else 0.0
        found.append((f, p, distortion(where, turned, f, p)))
    (f, p, own), (f_true, p_true, exact) = found
    return Estimate(f, p, f_true, p_true, None, None, rms(own), rms(own - exact))


def rms(values: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def measure(bench: DistortionBench, seed: int, advance: Advance = silent) -> DistortionRun:
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
    angle = setup.turntable.camera_angle
    raw = record.reading - angle
    # the line's middle was put on the pinhole at this reading
    corrected = compensation.correct(record.reading) - float(compensation.correct(angle))
    # the prescription's focal length serves to see scatter only
    about = bench.path.model.line_focal_length
    means = reduce_sets(corrected, spots, about, about * compensation.repeatability)
    # the white part is left to the test's own residuals, which see it at more angles than the calibration's did
    common = replace(compensation, white=0.0).covariance(means.mean(record.reading))
    try:
        measured = Distortion.measure(raw, spots, means), Distortion.measure(corrected, spots, means, common)
    except OrientationError as error:
        raise BenchError(str(error), ("points",), f"{len(SMOOTH) + 1} or more, over the whole field") from error
    return DistortionRun(bench, seed, record, truth, table, series, compensation, spots, means, *measured)


def _locate(bench: DistortionBench, record: DistortionRecord) -> Spots:
    try:
        return locate_spots(
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
        if "edge" in reason:
            raise BenchError(problem, ("window",), "a larger window") from error
        remedy = "less light: 30 to 80 percent is good" if "saturated" in reason else "more light or more frames"
        raise BenchError(problem, ("light",), remedy) from error


def run_distortion(setup: DistortionSetup, backend: Backend, seed: int, advance: Advance = silent) -> DistortionRun:
    """``python -m twin.lab distortion``.

    Raises:
        InputError: ``as_built`` names what the camera does not have.
        BenchError: the test cannot be carried out or measured as its file says.
    """
    return measure(DistortionBench.build(setup, backend, advance), seed, advance)
