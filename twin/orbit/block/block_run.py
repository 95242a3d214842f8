"""Adjust a block, and adjust it again without each of its sensors: ``python -m twin.orbit adjust``.

Worker processes of this machine or of a cluster that reduce the points of a block.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import chi2

from analysis.arrays import MeasurementError
from analysis.block.block import Block
from analysis.block.block_adjustment import BlockAdjustment, LawTest, adjust_block, kept_block, law_tests
from analysis.block.error_processes import BlockError
from analysis.block.network import DatumTest, Network, Open, datum_test, network_of, open_combinations
from analysis.block.point_reduction import Pool
from analysis.orbit.forward_intersection import Accuracy, level_axes, predicted, realised
from optics.numerics.backend import one_blas_thread
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.setup import AnyAdjust, MeasuredAdjustSetup
from twin.framework.cluster import ClusterError, Workers, chosen_workers
from twin.framework.memory import Lowered, require_memory
from twin.framework.procedure import Advance, BenchError, silent
from twin.orbit.block.drawn_block import DrawnBlock, draw_block
from twin.orbit.block.measured_block import MonitorSource, measured_block

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.adjust import OrbitAdjustSpec

_LEAST_CHECK = 2
_OBSERVED = 3e3
"""Bytes per image point of a block that is drawn and adjusted."""
Rejected = tuple[tuple[str, str], ...]
DATUM_ALARM = 1e-3
"""Chance below which a common shift of the control points is told."""
ALL = "all"
NOTHING = "ties alone"
"""Of the table of sensors: image points of unknown ground alone, beside what is stated of readings and cameras."""


@dataclass(frozen=True, eq=False)
class Worth:
    """The block with some of its sensors.

    Attributes
    ----------
    left_out : tuple[str, ...]
        Sensors that were not used.
    predicted : Accuracy
        Errors at check points by their covariances; at all tie points where there are no check points.
    found : Accuracy | None
        By their true or given places; None without check points.
    agreement : float | None
        Mean square of the errors over their sigmas, of the three coordinates: 1 where sigmas are right; None likewise.
    plan, height : float
        CE90 and LE90 by the covariances, over those with all sensors.
    """

    left_out: tuple[str, ...]
    predicted: Accuracy
    found: Accuracy | None
    agreement: float | None
    plan: float = 1.0
    height: float = 1.0


@dataclass(frozen=True, eq=False)
class CameraChange:
    """A camera in one scene: found, sigma, expected sigma without the block, truth, (4,) each, radians and metres.

    truth: None where nobody knows it.
    """

    found: np.ndarray
    sigma: np.ndarray
    before: np.ndarray
    truth: np.ndarray | None


@dataclass(frozen=True, eq=False)
class _Known:
    """What check points and cameras are compared with: places (m, 3) and their covariances (m, 3, 3), metres; scene ->
    true change of its camera, empty where nobody knows.
    """

    places: np.ndarray
    covariance: np.ndarray
    change: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class BlockRun:
    """Everything that was computed.

    Attributes
    ----------
    setup : AnyAdjust
        What the file says.
    seed : int
        Of all that was drawn.
    drawn : DrawnBlock | None
        The block and its truth; None for a measured block.
    adjustment : BlockAdjustment
        With all sensors that the file does not leave out.
    worth : Mapping[str, Worth]
        Case -> check points: all sensors, without each, and ties alone.
    network : Network
        How scenes hang together.
    open : tuple[Open, ...]
        What observations leave to the priors.
    laws : tuple[LawTest, ...]
        Tests of the laws in time.
    datum : DatumTest | None
        Of the control points against the rest; None without control points.
    cameras : Mapping[str, CameraChange]
        Scene -> its camera.
    check : tuple[np.ndarray, np.ndarray, np.ndarray]
        (k,) check points, (k, 3) errors east, north and up, metres, and (k, 3) their sigmas.
    rejected : Rejected
        Point and set of observations of every gross error that was left out.
    """

    setup: AnyAdjust
    seed: int
    drawn: DrawnBlock | None
    adjustment: BlockAdjustment
    worth: Mapping[str, Worth]
    network: Network
    open: tuple[Open, ...]
    laws: tuple[LawTest, ...]
    datum: DatumTest | None
    cameras: Mapping[str, CameraChange]
    check: tuple[np.ndarray, np.ndarray, np.ndarray]
    rejected: Rejected

    @property
    def used(self) -> tuple[str, ...]:
        """Sensors of the adjustment."""
        return self.adjustment.assembly.block.sensors

    @property
    def datum_chance(self) -> float:
        """Chance of such a shift of the control points where there is none; 1 without control points."""
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
    """Draw or read a block and adjust it. Nothing is traced: the backend is not used.

    Parameters
    ----------
    setup : AnyAdjust
        What the file says.
    backend : Backend | None
        Not used.
    seed : int
        Of all that is drawn.
    advance : Advance
        Told of the progress.
    pool : Pool | None
        Processes that reduce the points; None for this one alone.
    monitor : MonitorSource | None
        What a record says of the cameras, where the file names one.

    Raises
    ------
    InputError
        Tables that cannot be used.
    BenchError
        No such orbit, or a block that cannot be adjusted.
    """
    spec = setup.test
    advance("block", 0, 2)
    drawn = None
    if isinstance(setup, MeasuredAdjustSetup):
        block, places = measured_block(setup, advance, monitor)
        known = _Known(places, block.points.covariance, {})
    else:
        _require_memory(setup.test)
        drawn = draw_block(setup, np.random.SeedSequence(seed), monitor)
        block = drawn.block
        known = _Known(drawn.ground, np.zeros((len(drawn.ground), 3, 3)), drawn.change)
    for sensor in spec.without:
        block = block.without(sensor)
    advance("block", 1, 2)
    try:
        network = network_of(block)
        datum, block, rejected = _datum(block, spec.robust, pool)
        robust = spec.robust and rejected is None
        found = adjust_block(
            block, robust="reject" if robust else None, variance_components=spec.components or False, pool=pool
        )
        advance("block", 2, 2)
        worth = _worth(kept_block(found), found, known, advance, pool)
    except (MeasurementError, np.linalg.LinAlgError) as error:
        key = "data" if drawn is None else "points"
        raise BenchError(str(error), (key,), "more points, or scenes that see the same ground") from error
    where, wrong, spread = _check(found, known)
    level = level_axes(found.ground[where])
    sigma = np.sqrt(np.einsum("nij,njk,nik->ni", level, spread, level))
    errors = np.einsum("nij,nj->ni", level, wrong)
    return BlockRun(
        setup,
        seed,
        drawn,
        found,
        worth,
        network,
        open_combinations(found),
        law_tests(found),
        datum,
        _cameras(found, known),
        (where, errors, sigma),
        rejected or found.rejected(),
    )


def _require_memory(spec: OrbitAdjustSpec) -> None:
    """See whether a block, each of whose points all scenes may see, fits into the memory."""
    points = spec.points
    scenes, others = len(spec.passes) * len(spec.lines), points.control + points.check
    require_memory(
        Lowered(spec, ("points", "tie"), points.tie, "tie points", lambda ties: (ties + others) * scenes * _OBSERVED, 0)
    )


def _datum(block: Block, robust: bool, pool: Pool | None) -> tuple[DatumTest | None, Block, Rejected | None]:
    """A common shift of the control points, the block to be adjusted, and what was left out of it already.

    It is looked for first: control points of another datum would else all be taken for gross errors. Where there is
    one, gross errors are those that stand out beside it, and the control points stay as they are given.
    """
    if not np.any(block.points.role == "control"):
        return None, block, None
    shifted = adjust_block(block, robust="reject" if robust else None, datum=True, pool=pool)
    test = datum_test(shifted)
    assert test is not None
    if robust and chi2.sf(test.chi_square, 3) < DATUM_ALARM:
        return test, kept_block(shifted), shifted.rejected()
    return test, block, None


def _check(found: BlockAdjustment, known: _Known) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Check points (k,) that were adjusted, their errors (k, 3), ITRS, metres, and covariances (k, 3, 3) of these."""
    block = found.assembly.block
    where = np.flatnonzero((block.points.role == "check") & np.isfinite(found.ground).all(axis=1))
    spread = found.point_covariance(where) + known.covariance[where]
    return where, found.ground[where] - known.places[where], spread


def _worth(
    kept: Block, found: BlockAdjustment, known: _Known, advance: Advance, pool: Pool | None
) -> FrozenMap[str, Worth]:
    """Check points by all sensors, without each, and by none but ties."""
    sensors = [name for name in kept.sensors if name != "ties"]
    # without ties the check points are all that is left to judge by
    enough = int(np.sum(kept.points.role == "check")) >= _LEAST_CHECK
    cases: dict[str, tuple[str, ...]] = {ALL: ()}
    cases |= {f"without {name.replace('_', ' ')}": (name,) for name in kept.sensors if name != "ties" or enough}
    if len(sensors) > 1:
        cases[NOTHING] = tuple(sensors)
    rows: dict[str, Worth] = {}
    for k, (case, left_out) in enumerate(cases.items()):
        advance("sensors", k, len(cases))
        block = kept
        for name in left_out:
            block = block.without(name)
        one = found
        if left_out:
            one = adjust_block(block, pool=pool)
        worth = _accuracy(left_out, one, known)
        full = rows.get(ALL, worth).predicted
        plan, height = worth.predicted.ce90 / full.ce90, worth.predicted.le90 / full.le90
        rows[case] = replace(worth, plan=plan, height=height)
    advance("sensors", len(cases), len(cases))
    return FrozenMap(rows)


def _accuracy(left_out: tuple[str, ...], one: BlockAdjustment, known: _Known) -> Worth:
    where, error, spread = _check(one, known)
    if len(where) < _LEAST_CHECK:
        role = one.assembly.block.points.role
        ties = np.flatnonzero((role == "tie") & np.isfinite(one.ground).all(axis=1))
        if not len(ties):
            raise BlockError("block: neither check points nor tie points are left")
        return Worth(left_out, predicted(one.ground[ties], one.point_covariance(ties)), None, None)
    square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(spread), error)
    places = one.ground[where]
    own = one.point_covariance(where)
    return Worth(left_out, predicted(places, own), realised(places, error), float(np.mean(square)) / 3.0)


def _cameras(found: BlockAdjustment, known: _Known) -> FrozenMap[str, CameraChange]:
    block = found.assembly.block
    order = [one.name for one in block.passes]
    rows = {}
    for scene in block.scenes:
        if scene.name not in found.assembly.changes:
            continue
        value, spread = found.change(scene.name)
        law = block.known[scene.camera].covariance
        own = 4 * order.index(scene.of) + np.arange(4)
        before = np.sqrt(np.diag(law)[own])
        rows[scene.name] = CameraChange(value, np.sqrt(np.diag(spread)), before, known.change.get(scene.name))
    return FrozenMap(rows)


_LOST = "a worker was lost with its share of the points; adjust the block again"


@dataclass(frozen=True, eq=False)
class PointWorkers:
    """Workers as `analysis.block.point_reduction` uses them: one share for each of those that there are at the start.

    Attributes
    ----------
    workers : Workers
        The processes.
    count : int
        Of them.
    """

    workers: Workers
    count: int

    def hold(self, things: Sequence[Any]) -> Sequence[Any]:
        """Give each thing to a worker, in turn."""
        client = self.workers.client
        addresses = sorted(client.scheduler_info(n_workers=-1)["workers"])
        return [
            client.scatter(one, workers=[addresses[k % len(addresses)]], hash=False) for k, one in enumerate(things)
        ]

    def results(self, work: Callable[[tuple[Any, ...]], Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Work done with each of the arguments, in their order.

        Raises
        ------
        MeasurementError
            a share that cannot be reduced.
        ClusterError
            a worker or the scheduler is gone.
        """
        futures = [self.workers.submit(_on_one_thread, (work, *one)) for one in arguments]

        def look() -> None:
            if any(one.status in ("lost", "cancelled") for one in futures):
                raise ClusterError(_LOST)

        for _ in futures:
            done = self.workers.next_finished(look)
            if done.status == "finished":
                continue
            error = done.exception()
            if isinstance(error, MeasurementError):
                raise error
            raise ClusterError(f"{_LOST} ({type(error).__name__}: {error})")
        return [one.result() for one in futures]


def _on_one_thread(given: tuple[Any, ...]) -> Any:
    work, *rest = given
    with one_blas_thread():
        return work(tuple(rest))


@contextmanager
def point_workers(
    count: int | None, scheduler: str | None, warn: Callable[[str], None]
) -> Iterator[PointWorkers | None]:
    """Workers inside the block; none where neither a number nor a scheduler is given.

    Parameters
    ----------
    count : int | None
        Of processes of this machine.
    scheduler : str | None
        Address of a running cluster.
    warn : Callable[[str], None]
        Told what the user should know.

    Raises
    ------
    InputErrorText
        Both are given, or a cluster that cannot be used.
    ClusterError
        a cluster without workers.
    """
    if scheduler is None and (count is None or count < 2):
        yield None
        return
    with chosen_workers(count, scheduler, warn) as workers:
        yield PointWorkers(workers, workers.count)
