"""Adjustment of a block, repeated without each of its sensors: ``python -m twin.orbit adjust``.

The points of a block can be reduced by worker processes of this machine or of a cluster (`PointWorkers`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import chi2

from analysis.arrays import MeasurementError
from analysis.block.block import Block
from analysis.block.block_adjustment import BlockAdjustment, LawTest, accepted_block, adjust_block, law_tests
from analysis.block.error_processes import BlockError
from analysis.block.network import DatumTest, Network, OpenCombination, datum_test, network_of, open_combinations
from analysis.block.point_reduction import Pool
from analysis.orbit.forward_intersection import Accuracy, level_axes, predicted, realised
from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import one_blas_thread
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.setup import AnyAdjust, MeasuredAdjustSetup, RationalAdjustSetup
from twin.framework.cluster import ClusterError, Workers, chosen_workers
from twin.framework.memory import Lowered, require_memory
from twin.framework.procedure import Advance, BenchError, silent
from twin.orbit.block.drawn_block import DrawnBlock, draw_block
from twin.orbit.block.measured_block import MonitorSource, measured_block
from twin.orbit.block.rational_block import AdjustedImage, adjusted_images, rational_block
from twin.orbit.measured.measurement_tables import LINES_SEE_POINTS

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.adjust import OrbitAdjustSpec

_LEAST_CHECK = 2
"""Smallest number of check points from which errors are computed."""
_OBSERVED = 3e3
"""Memory per image point for simulation and adjustment of a block, in bytes."""
Rejected = tuple[tuple[str, str], ...]
"""Point and scene of each image point that was rejected as a gross error."""
DATUM_ALARM = 1e-3
"""p-value below which a common shift of the control points is reported."""
ALL = "all"
"""Name, in the table of contributions of the sensors, of the adjustment with all sensors."""
TIES_ALONE = "ties alone"
"""Name, in the table of sensors, of the adjustment with tie points (image points of unknown ground points) only,
besides the priors of the orbit and attitude readings and of the cameras.
"""


@dataclass(frozen=True, eq=False)
class SensorContribution:
    """Errors of a block that is adjusted with some of its sensors, relative to those with all sensors.

    Attributes
    ----------
    excluded : tuple of str
        Sensors that were not used.
    predicted : Accuracy
        CE90 and LE90 (90 % errors in plan and in height) of the check points by their covariances; of all tie points
        where there are no check points.
    observed : Accuracy or None
        CE90 and LE90 of the errors at the check points; None without check points.
    normalised_squared_error : float or None
        Mean square of the errors of the three coordinates divided by their sigmas (chi-square per degree of freedom): 1
        where the sigmas are right; None without check points.
    plan, height : float
        Predicted CE90 and LE90, divided by those of the adjustment with all sensors.
    """

    excluded: tuple[str, ...]
    predicted: Accuracy
    observed: Accuracy | None
    normalised_squared_error: float | None
    plan: float = 1.0
    height: float = 1.0


@dataclass(frozen=True, eq=False)
class CameraChange:
    """Change of a camera in one scene since its calibration.

    Each attribute is a (4,) ndarray: rotations d_alpha, d_beta and d_gamma about the camera's Y, X and Z (line of
    sight), in radians, and change d_f of the principal distance, in metres.

    Attributes
    ----------
    value : ndarray
        Estimated change.
    sigma : ndarray
        Standard deviation of the estimate.
    before : ndarray
        Prior standard deviation, without the block.
    truth : ndarray or None
        True change; None for a measured block.
    """

    value: np.ndarray
    sigma: np.ndarray
    before: np.ndarray
    truth: np.ndarray | None


@dataclass(frozen=True, eq=False)
class _Reference:
    """Reference with which check points and cameras are compared.

    Attributes
    ----------
    ground : (m, 3) ndarray for m points
        Coordinates of the points, ITRS, in metres.
    covariance : (m, 3, 3) ndarray
        Covariances of these coordinates, in metres^2.
    change : Mapping[str, ndarray]
        Scene -> true change of its camera; empty for a measured block.
    """

    ground: np.ndarray
    covariance: np.ndarray
    change: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class BlockRun:
    """All results of a block adjustment.

    Attributes
    ----------
    setup : AnyAdjust
        Resolved test file and camera.
    seed : int
        Seed of all random numbers.
    drawn : DrawnBlock or None
        Simulated block with its truth; None for a measured block.
    adjustment : BlockAdjustment
        Adjustment with all sensors that the file does not exclude.
    contributions : Mapping[str, SensorContribution]
        Name of the adjustment -> errors at check points: with all sensors, without each, and with tie points alone.
    network : Network
        Connections between the scenes.
    open : tuple of OpenCombination
        Combinations of unknowns that the priors determine better than the observations.
    laws : tuple of LawTest
        Tests of the error laws (noise models in the file) whose errors vary with time.
    datum : DatumTest or None
        Test of a common shift of the control points; None without control points.
    cameras : Mapping[str, CameraChange]
        Scene -> change of its camera.
    images : Mapping[str, AdjustedImage]
        Scene with rational polynomials -> its correction.
    check : tuple of ndarray
        Indices (k,) of the k check points, their errors (k, 3) east, north and up, in metres, and the sigmas (k, 3).
    rejected : Rejected
        Point and scene of each gross error that was rejected.
    """

    setup: AnyAdjust
    seed: int
    drawn: DrawnBlock | None
    adjustment: BlockAdjustment
    contributions: Mapping[str, SensorContribution]
    network: Network
    open: tuple[OpenCombination, ...]
    laws: tuple[LawTest, ...]
    datum: DatumTest | None
    cameras: Mapping[str, CameraChange]
    images: Mapping[str, AdjustedImage]
    check: tuple[np.ndarray, np.ndarray, np.ndarray]
    rejected: Rejected

    @property
    def used(self) -> tuple[str, ...]:
        """Names of the sensors whose measurements the adjustment uses."""
        return self.adjustment.assembly.block.sensors

    @cached_property
    def relative_height_sigma(self) -> np.ndarray:
        """Sigmas of the heights of all adjusted points relative to their mean height, (k,), in metres."""
        where = np.flatnonzero(np.isfinite(self.adjustment.ground).all(axis=1))
        up = level_axes(self.adjustment.ground[where])[:, 2]
        return np.sqrt(self.adjustment.relative_variance(where, up))

    @property
    def datum_p_value(self) -> float:
        """p-value of the common shift of the control points; 1 without control points."""
        return 1.0 if self.datum is None else float(chi2.sf(self.datum.chi_square, 3))


@one_blas_thread()  # of small matrices: threads would only wait for each other
def run_adjustment(
    setup: AnyAdjust,
    backend: Backend | None,
    seed: int,
    advance: Advance = silent,
    pool: Pool | None = None,
    monitor: MonitorSource | None = None,
) -> BlockRun:
    """Simulate or read a block and adjust it. Nothing is ray-traced: the backend is not used.

    Parameters
    ----------
    setup : AnyAdjust
        Resolved test file and camera.
    backend : Backend or None
        Not used.
    seed : int
        Seed of all random numbers.
    advance : Advance
        Callback that reports the progress.
    pool : Pool, optional
        Processes that reduce the points; None for this process alone.
    monitor : MonitorSource, optional
        Source of the cameras' priors from a record of the monitor, where the file names one.

    Raises
    ------
    InputError
        Tables cannot be used.
    BenchError
        No such orbit exists, or the block cannot be adjusted.
    """
    spec = setup.test
    advance("block", 0, 2)
    drawn = None
    if isinstance(setup, MeasuredAdjustSetup | RationalAdjustSetup):
        if isinstance(setup, RationalAdjustSetup):
            block, places = rational_block(setup, advance)
        else:
            try:
                block, places = measured_block(setup, advance, monitor)
            except (MeasurementError, UnphysicalError) as error:
                raise BenchError(str(error), ("data",), LINES_SEE_POINTS) from error
        reference = _Reference(places, block.points.covariance, {})
    else:
        _require_memory(setup.test)
        drawn = draw_block(setup, np.random.SeedSequence(seed), monitor)
        block = drawn.block
        reference = _Reference(drawn.ground, np.zeros((len(drawn.ground), 3, 3)), drawn.change)
    for sensor in spec.without:
        block = block.without(sensor)
    advance("block", 1, 2)
    try:
        network = network_of(block)
        datum, block, rejected, start = _datum(block, spec.robust, pool)
        robust = spec.robust and rejected is None
        adjustment = adjust_block(
            block,
            robust="reject" if robust else None,
            variance_components=spec.components or False,
            pool=pool,
            start=start,
        )
        advance("block", 2, 2)
        contributions = _contributions(accepted_block(adjustment), adjustment, reference, advance, pool)
        images = adjusted_images(adjustment)
    except (MeasurementError, np.linalg.LinAlgError) as error:
        key = "points" if drawn else "image_points" if isinstance(setup, RationalAdjustSetup) else "data"
        remedy = LINES_SEE_POINTS if key == "data" else "more points, or scenes that see the same ground"
        raise BenchError(str(error), (key,), remedy) from error
    where, wrong, spread = _check(adjustment, reference)
    level = level_axes(adjustment.ground[where])
    sigma = np.sqrt(np.einsum("nij,njk,nik->ni", level, spread, level))
    errors = np.einsum("nij,nj->ni", level, wrong)
    return BlockRun(
        setup,
        seed,
        drawn,
        adjustment,
        contributions,
        network,
        open_combinations(adjustment),
        law_tests(adjustment),
        datum,
        _cameras(adjustment, reference),
        images,
        (where, errors, sigma),
        rejected or adjustment.rejected(),
    )


def _require_memory(spec: OrbitAdjustSpec) -> None:
    """Raise an error if a block does not fit into the memory, assuming that every scene sees every point."""
    points = spec.points
    scenes, others = len(spec.passes) * len(spec.lines), points.control + points.check
    require_memory(
        Lowered(spec, ("points", "tie"), points.tie, "tie points", lambda ties: (ties + others) * scenes * _OBSERVED, 0)
    )


def _datum(
    block: Block, robust: bool, pool: Pool | None
) -> tuple[DatumTest | None, Block, Rejected | None, BlockAdjustment | None]:
    """Test a common shift of the control points; return the test, the block to adjust, rejected points and the start.

    The shift is tested first because control points of another datum would otherwise all be rejected as gross errors.
    Where the shift is significant, gross errors are those in excess of it, and the control points keep the coordinates
    that the file gives.
    """
    if not np.any(block.points.role == "control"):
        return None, block, None, None
    shifted = adjust_block(block, robust="reject" if robust else None, datum=True, pool=pool)
    test = datum_test(shifted)
    assert test is not None
    if robust and chi2.sf(test.chi_square, 3) < DATUM_ALARM:
        return test, accepted_block(shifted), shifted.rejected(), None
    return test, block, None, shifted if robust else None


def _check(adjustment: BlockAdjustment, reference: _Reference) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return indices (k,), errors (k, 3), ITRS, metres, and covariances of the errors of k adjusted check points."""
    block = adjustment.assembly.block
    where = np.flatnonzero((block.points.role == "check") & np.isfinite(adjustment.ground).all(axis=1))
    spread = adjustment.point_covariance(where) + reference.covariance[where]
    return where, adjustment.ground[where] - reference.ground[where], spread


def _contributions(
    accepted: Block, adjustment: BlockAdjustment, reference: _Reference, advance: Advance, pool: Pool | None
) -> FrozenMap[str, SensorContribution]:
    """Return the errors at check points with all sensors, without each one in turn, and with tie points alone."""
    sensors = [name for name in accepted.sensors if name != "ties"]
    # without ties only check points show the errors
    enough = int(np.sum(accepted.points.role == "check")) >= _LEAST_CHECK
    cases: dict[str, tuple[str, ...]] = {ALL: ()}
    cases |= {f"without {name.replace('_', ' ')}": (name,) for name in accepted.sensors if name != "ties" or enough}
    if len(sensors) > 1:
        cases[TIES_ALONE] = tuple(sensors)
    rows: dict[str, SensorContribution] = {}
    for k, (case, excluded) in enumerate(cases.items()):
        advance("sensors", k, len(cases))
        block = accepted
        for name in excluded:
            block = block.without(name)
        reduced = adjustment
        if excluded:
            reduced = adjust_block(block, pool=pool)
        contributions = _accuracy(excluded, reduced, reference)
        full = rows.get(ALL, contributions).predicted
        plan, height = contributions.predicted.ce90 / full.ce90, contributions.predicted.le90 / full.le90
        rows[case] = replace(contributions, plan=plan, height=height)
    advance("sensors", len(cases), len(cases))
    return FrozenMap(rows)


def _accuracy(excluded: tuple[str, ...], adjustment: BlockAdjustment, reference: _Reference) -> SensorContribution:
    where, error, spread = _check(adjustment, reference)
    if len(where) < _LEAST_CHECK:
        role = adjustment.assembly.block.points.role
        ties = np.flatnonzero((role == "tie") & np.isfinite(adjustment.ground).all(axis=1))
        if not len(ties):
            raise BlockError("block: no check or tie points remain: give some points the role `check` or `tie`")
        return SensorContribution(
            excluded, predicted(adjustment.ground[ties], adjustment.point_covariance(ties)), None, None
        )
    square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(spread), error)
    places = adjustment.ground[where]
    covariance = adjustment.point_covariance(where)
    return SensorContribution(
        excluded, predicted(places, covariance), realised(places, error), float(np.mean(square)) / 3.0
    )


def _cameras(adjustment: BlockAdjustment, reference: _Reference) -> FrozenMap[str, CameraChange]:
    block = adjustment.assembly.block
    order = [block_pass.name for block_pass in block.passes]
    rows = {}
    for scene in block.line_scenes:
        if scene.name not in adjustment.assembly.changes:
            continue
        value, spread = adjustment.change(scene.name)
        law = block.known[scene.camera].covariance
        rows_of_pass = 4 * order.index(scene.of) + np.arange(4)
        before = np.sqrt(np.diag(law)[rows_of_pass])
        rows[scene.name] = CameraChange(value, np.sqrt(np.diag(spread)), before, reference.change.get(scene.name))
    return FrozenMap(rows)


_LOST = "a worker was lost with its share of the points; adjust the block again"
"""Error message for a worker process that ended before it returned its share of the points."""


@dataclass(frozen=True, eq=False)
class PointWorkers:
    """Workers for `analysis.block.point_reduction`, each with one share of the points.

    There is one share for each worker present at the start.

    Attributes
    ----------
    workers : Workers
        Worker processes.
    count : int
        Number of workers.
    """

    workers: Workers
    count: int

    def hold(self, objects: Sequence[Any]) -> Sequence[Any]:
        """Distribute the objects over the workers in rotation, and return a future for each object."""
        client = self.workers.client
        addresses = sorted(client.scheduler_info(n_workers=-1)["workers"])
        return [
            client.scatter(item, workers=[addresses[k % len(addresses)]], hash=False) for k, item in enumerate(objects)
        ]

    def results(self, work: Callable[[tuple[Any, ...]], Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Return the results of `work` for each tuple of arguments, in their order.

        Raises
        ------
        MeasurementError
            A share of the points cannot be reduced.
        ClusterError
            A worker or the scheduler is lost.
        """
        futures = [self.workers.submit(_on_one_thread, (work, *future)) for future in arguments]

        def look() -> None:
            if any(future.status in ("lost", "cancelled") for future in futures):
                raise ClusterError(_LOST)

        for _ in futures:
            done = self.workers.next_finished(look)
            if done.status == "finished":
                continue
            error = done.exception()
            if isinstance(error, MeasurementError):
                raise error
            raise ClusterError(f"{_LOST} ({type(error).__name__}: {error})")
        return [future.result() for future in futures]


def _on_one_thread(call: tuple[Any, ...]) -> Any:
    work, *arguments = call
    with one_blas_thread():
        return work(tuple(arguments))


@contextmanager
def point_workers(
    count: int | None, scheduler: str | None, warn: Callable[[str], None]
) -> Iterator[PointWorkers | None]:
    """Provide workers inside a ``with`` block; None where neither a number nor a scheduler is given.

    Parameters
    ----------
    count : int, optional
        Number of processes on this machine.
    scheduler : str, optional
        Address of a running cluster.
    warn : Callable[[str], None]
        Callback for warnings to the user.

    Raises
    ------
    InputErrorText
        Both are given, or the cluster cannot be used.
    ClusterError
        The cluster has no workers.
    """
    if scheduler is None and (count is None or count < 2):
        yield None
        return
    with chosen_workers(count, scheduler, warn) as workers:
        yield PointWorkers(workers, workers.count)
