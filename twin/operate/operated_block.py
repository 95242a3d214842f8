"""Block adjustment of scenes whose cameras are observed by a monitor in operation.

The record's estimate at several times, with the covariance between times, gives the prior of the cameras' parameters in
every pass over the scene. Between two readings, nearly all of an estimate's error is common to the times of a pass; the
remainder is due to motions in the meantime, according to the specified time laws. An adjustment of images that uses the
estimate as a prior of the cameras needs both parts. The code of the block adjustment itself does not depend on records.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import ARCSEC, Array
from analysis.block.block import JointCameraPrior
from analysis.monitor.limits import Quantity
from scenes.specs.orbit.adjust import MonitorRecordSpec
from scenes.specs.orbit.setup import AdjustSetup, AnyAdjust, MeasuredAdjustSetup, RationalAdjustSetup
from scenes.yaml.errors import InputError, Problem, unknown
from twin.framework.procedure import Advance, silent
from twin.operate.estimate.operation_filter import Operation
from twin.operate.estimate.operation_model import read_plan, stored_plan
from twin.operate.record import NotARecord, RecordFailed
from twin.operate.record.entries import micros, utc_text
from twin.operate.record.history import History
from twin.orbit.block.block_run import BlockRun, run_adjustment

if TYPE_CHECKING:
    from analysis.block.point_reduction import Pool
    from optics.numerics.backend import Backend


@dataclass(frozen=True, eq=False)
class Posterior:
    """Mean and covariance of Q quantities at T times.

    Attributes
    ----------
    times : (T,) ndarray of int64
        Microseconds of TAI since 2000.
    quantities : tuple[Quantity, ...]
        The Q quantities, each with its group (a camera, `intersection_angle` or `ground`), key and unit.
    mean : (T, Q) ndarray
        Changes since the calibration, in each quantity's unit, with the signs of docs/conventions.md.
    covariance : (T, Q, T, Q) ndarray
        Covariance of the errors, also between times, in these units.
    """

    times: NDArray[np.int64]
    quantities: tuple[Quantity, ...]
    mean: Array
    covariance: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Group and key of each quantity, such as ``forward d_alpha_arcsec``."""
        return tuple(quantity.name for quantity in self.quantities)

    def to_dict(self) -> dict[str, Any]:
        """Return times, names and numbers as plain data."""
        return {
            "times_utc": [utc_text(int(time)) for time in self.times],
            "quantities": list(self.names),
            "mean": self.mean.tolist(),
            "covariance": self.covariance.tolist(),
        }


def posterior(
    operation: Operation, times_us: Sequence[int] | NDArray[np.int64], names: Sequence[str] | None = None
) -> Posterior:
    """Return the joint posterior of quantities at several times, from all readings.

    The computing time is that of one smoothing run, plus a term proportional to T^2 times the square of the number of
    states: some hundred times take seconds.

    Array dimensions: T times.

    Parameters
    ----------
    operation : Operation
        Estimate of the record.
    times_us : (T,) sequence of int
        Microseconds of TAI since 2000, ascending and not before the first reading; `twin.operate.record.entries.micros`
        converts UTC. After the newest reading the result is the forecast.
    names : Sequence[str] | None
        Quantities by group and key, as a plan of operation names them: ``forward d_alpha_arcsec``. By default d_alpha,
        d_beta, d_gamma and d_f of all cameras.

    Raises
    ------
    Problem
        Times are not ascending or before all readings, or a quantity does not exist.
    """
    times = np.asarray(times_us, np.int64)
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        raise Problem("times out of order", utc_text(int(times[late[0] + 1])), "each time later than the one before")
    known = {quantity.name: quantity for quantity in operation.quantities}
    cameras = dict.fromkeys(camera for camera, _ in operation.model.spots)
    chosen = [name for name, item in known.items() if item.group in cameras] if names is None else list(names)
    for name in chosen:
        if name not in known:
            raise Problem("no such quantity", name, f"one of: {', '.join(known)}")
    quantities = tuple(known[name] for name in chosen)
    rows = np.array([quantity.row for quantity in quantities]).reshape(len(chosen), -1)
    values, covariance = operation.smooth_jointly(times)
    return Posterior(
        times, quantities, values @ rows.T, np.einsum("qi,tiuj,rj->tqur", rows, covariance, rows, optimize=True)
    )


KEYS = ("d_alpha_arcsec", "d_beta_arcsec", "d_gamma_arcsec", "d_f_um")
"""Keys of a camera's change, in the order of the block adjustment's parameters."""
UNITS = np.array([ARCSEC, ARCSEC, ARCSEC, 1e-6])
"""Size in rad or m of one unit of each key in ``KEYS``."""
_NEAR = 0.02
"""Largest accepted difference between a camera of the record and the line of the block with the same name.

It applies to the relative difference of focal lengths, and to the difference of look angles in radians.
"""


def run_operated_block(
    setup: AnyAdjust, backend: Backend | None, seed: int, advance: Advance = silent, pool: Pool | None = None
) -> BlockRun:
    """Simulate or read a block and adjust it, with the camera prior from a record if the file names one.

    Parameters
    ----------
    setup : AnyAdjust
        Setup read from the file.
    backend : Backend | None
        Not used; the block is adjusted without tracing rays.
    seed : int
        Seed of all random numbers.
    advance : Advance
        Callback that receives the progress.
    pool : Pool | None
        Processes that reduce the points; None for this process alone.

    Raises
    ------
    InputError
        A table of measurements or the record cannot be used.
    BenchError
        The orbit does not exist, or the block cannot be adjusted.
    """
    if isinstance(setup, RationalAdjustSetup) or (spec := setup.test.monitor_record) is None:
        return run_adjustment(setup, backend, seed, advance, pool)

    def monitor(epochs: Mapping[str, str], lines: Sequence[str]) -> JointCameraPrior:
        try:
            return _prior_of_record(setup, spec, epochs, lines, advance)
        except Problem as problem:
            raise setup.test.error(problem, ("monitor_record",)) from None
        except (RecordFailed, NotARecord) as error:
            wrong = Problem(str(error), spec.record, "a record that python -m twin.operate init made")
            raise setup.test.error(wrong, ("monitor_record", "record")) from None

    return run_adjustment(setup, backend, seed, advance, pool, monitor)


def _prior_of_record(
    setup: AdjustSetup | MeasuredAdjustSetup,
    spec: MonitorRecordSpec,
    epochs: Mapping[str, str],
    lines: Sequence[str],
    advance: Advance,
) -> JointCameraPrior:
    """Return the prior of the cameras in every pass from the record's estimate."""
    with History(spec.record) as history:
        try:
            plan = stored_plan(history) if spec.plan is None else read_plan(Path(spec.plan), history)
        except InputError as error:
            raise Problem(str(error), spec.plan, "a plan of the record's instrument", within=("plan",)) from None
        if plan is None:
            raise Problem("the record has no plan of operation", None, "`plan: FILE`", within=("plan",))
        mounted = plan.model.instrument.cameras
        for line in lines:
            if line not in mounted:
                text = f"the record is of {history.name}, which has no camera of this name"
                raise unknown(text, line, tuple(mounted), ("record",))
            look = setup.camera.lines[line].look
            if abs(mounted[line].look - look) > _NEAR:
                text = f"the record is of {history.name}, whose {line} camera has another look angle than this block's"
                value = f"{np.degrees(mounted[line].look):.4g} deg, not {np.degrees(look):.4g} deg"
                raise Problem(text, value, "the record of the instrument that took the images", within=("record",))
        operation = Operation(history, plan, lambda done, of: advance("follow the record", done, of))
        operation.filter_readings()
        for line in lines:
            length = plan.model.cameras[mounted[line].camera].focal_length
            specified = setup.camera.lines[line].principal_distance
            if abs(length / specified - 1.0) > _NEAR:
                text = f"the record is of {history.name}, whose {line} camera has another principal distance"
                value = f"{1e3 * length:.5g} mm, not {1e3 * specified:.5g} mm"
                raise Problem(text, value, "the record of the instrument that took the images", within=("record",))
        times = {name: micros(epoch) for name, epoch in epochs.items()}
        order = sorted(set(times.values()))
        names = [f"{line} {key}" for line in lines for key in KEYS]
        estimate = posterior(operation, order, names)
        return camera_prior(estimate, lines, [order.index(time) for time in times.values()])


def camera_prior(estimate: Posterior, cameras: Sequence[str], passes: Sequence[int]) -> JointCameraPrior:
    """Convert estimated changes of cameras to their joint prior in a block adjustment.

    Array dimensions: P passes.

    Parameters
    ----------
    estimate : Posterior
        Estimated changes: rotations d_alpha, d_beta, d_gamma and principal distance d_f of one camera after the other.
    cameras : Sequence[str]
        Names of the cameras.
    passes : (P,) sequence of int
        Index of the time of each pass.
    """
    scale = np.tile(UNITS, len(cameras))
    pass_times = np.array(passes)
    mean = (estimate.mean * scale)[pass_times].reshape(len(pass_times), len(cameras), 4).swapaxes(0, 1)
    covariance = estimate.covariance * scale[:, None, None] * scale
    covariance = covariance[pass_times][:, :, pass_times]
    shape = (len(pass_times), len(cameras), 4)
    covariance = covariance.reshape(*shape, *shape).transpose(1, 0, 2, 4, 3, 5)
    size = int(np.prod(shape))
    return JointCameraPrior(tuple(cameras), mean, covariance.reshape(size, size))
