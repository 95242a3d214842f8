"""Block adjustment: Gauss-Newton on observations and priors, robust weights, variance components.

Weights and variance factors follow the rules of `reweighting`. Before the adjustment, gross faults of a block are
detected: points far from the rays of their image points, and points seen only once.

**Test of the error models** of the readings by serial correlation. With the right model the whitened unknowns e of a
process are independent, of unit variance; the estimated ones have the covariance S = I - C, with C the covariance of
the whitened errors after the adjustment. The sum q of the products of neighbours in time then has the expectation tr(L
S) and the variance 2 tr(L S L S), with L the neighbour matrix. This is exact, however weakly the observations determine
the process. White noise that is really a random walk gives positively correlated neighbours, a random walk that is
really white noise gives negatively correlated ones. The size of the errors is tested by the variance components
(`GroupTest`), and q is compared at their estimated variance.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotrf, dpotri
from scipy.sparse.linalg import splu
from scipy.stats import norm

from analysis import statistics
from analysis.arrays import Array, Indices
from analysis.block.assembly import Assembly, Process, assembled, group_ranks
from analysis.block.block import Block, ModelScene, Scene
from analysis.block.error_processes import BlockError
from analysis.block.point_reduction import Checked, Pool, Reduced, Reduction, SharedReduction, State
from analysis.block.reweighting import SETTLED, GroupTest, Rule, UnsettledError, settled
from analysis.block.robust_start import consistent, contradicted, equations_left, intersection, screened

FAR = 0.02
"""Largest angle, in radians, between the coordinates of a point and the direction of its image: 10 km at 500 km. Orbits
and attitudes are known a hundred times better.
"""
_NAMED = 8
"""Largest number of faulty points that an error message lists by name."""


def pruned(block: Block) -> Block:
    """Return the block without observations of undetermined points, those with fewer than three equations.

    Raises
    ------
    BlockError
        No point remains.
    """
    rows = np.zeros(len(block.points.ids), np.intp)
    for scene in block.scenes:
        np.add.at(rows, scene.rays.point, 2)
    for footprints in block.footprints:
        np.add.at(rows, footprints.point, 3)
    if block.terrain is not None:
        np.add.at(rows, block.terrain.point, 1)
    rows[block.points.role == "control"] += 3
    determined = rows >= 3
    if not np.any(determined):
        raise BlockError("block: no point is seen by two scenes, and none is control")
    scenes = tuple(s.taken(determined[s.rays.point]) for s in block.scenes)
    terrain = block.terrain
    if terrain is not None:
        terrain = terrain.taken(determined[terrain.point])
    return replace(block, scenes=scenes, terrain=terrain)


def intersected(block: Block) -> Array:
    """Return the coordinates (m, 3), ITRS, in metres, of a block's m points for scenes and readings without errors.

    Each point has the least sum of its squared standardised residuals, with Huber's weights where these contradict each
    other; points without observations keep their start.

    Raises
    ------
    BlockError
        The block cannot be adjusted.
    """
    reduction = assembled(pruned(block)).reduction
    weight = tuple(np.ones(len(s.point)) for s in reduction.sets)
    return intersection(reduction.sets, State(np.zeros(reduction.size), block.points.first, weight, {})).ground


def check_places(block: Block, robust: bool = False) -> None:
    """Raise BlockError, listing the points, if the direction to a point differs from that of its image.

    Parameters
    ----------
    block : Block
        Block that is adjusted.
    robust : bool
        True to tolerate gross errors: up to half of a scene's control points, and of its other points.

    Raises
    ------
    BlockError
        The direction of an image and that to its point differ by more than `FAR`, or the position of a point in an
        image that is a function of the ground by more than half the image.
    """
    wrong: list[str] = []
    control: list[bool] = []

    def collect(scene: Scene | ModelScene, bad: NDArray[np.bool_]) -> None:
        known = block.points.role[scene.rays.point] == "control"
        for same in (known, ~known):
            where = np.flatnonzero(bad & same)
            if len(where) > (0.5 * np.sum(same) if robust else 0):
                wrong.extend(f"{name} in {scene.name}" for name in block.points.ids[scene.rays.point[where]].tolist())
                control.extend(known[where].tolist())

    for scene in block.line_scenes:
        rays = scene.rays
        if not len(rays.point):
            continue
        line_of_sight = block.points.start[rays.point] - rays.station
        distance = np.linalg.norm(line_of_sight, axis=1, keepdims=True)
        look = np.einsum("nij,nj->ni", rays.attitude, block.cameras[scene.camera].directions(rays.image))
        angle = np.linalg.norm(np.cross(look, line_of_sight / np.maximum(distance, 1.0)), axis=1)
        collect(scene, (angle > FAR) | (np.sum(look * line_of_sight, axis=1) <= 0))
    for image in block.model_scenes:
        position, _ = image.model.seen(block.points.start[image.rays.point])
        collect(image, ~np.all(np.abs(position - image.rays.image) < image.model.size, axis=1))
    if not wrong:
        return
    listed = ", ".join(wrong[:_NAMED]) + (f" and {len(wrong) - _NAMED} more" if len(wrong) > _NAMED else "")
    hint = "are their coordinates geocentric (ITRS), in metres and in the order x, y, z?" if all(control) else (
        "do their images belong to these scenes?"
    )  # fmt: skip
    raise BlockError(
        f"block: these points lie more than {FAR:g} rad, or half an image, from the directions of their images:"
        f" {listed}; {hint}"
    )


_STEPS = 20
"""Largest number of Gauss-Newton steps of one round."""
_CONVERGED = 1e-6
"""Norm of the last step of a converged iteration, in sigmas of all unknowns together."""
_ROUGH = 1e-2
"""Norm of the last step of an iteration whose weights will change."""
_FREE_ROUNDS = 4
"""Number of rounds after the robust start in which rejected measurements may be accepted again."""
_DENSE = 2500
"""Number of unknowns up to which a dense factorisation is faster than a sparse one."""
_MOST = 20_000
"""Largest number of unknowns whose full covariance is kept in memory: 3.2 GB."""
_COLUMNS = 256
"""Number of columns of a symmetric inverse that are copied from its lower to its upper triangle at a time."""
_SINGULAR = "block: the equations are singular; a sigma is too large for what observes it"


@dataclass(frozen=True, eq=False)
class BlockAdjustment:
    """Solution of a block adjustment: points, unknowns, covariances and tests.

    Attributes
    ----------
    assembly : Assembly
        Equations of the block.
    x : (P,) ndarray
        Unknowns, in units of their a-priori sigmas.
    covariance : (P, P) ndarray
        Covariance of the P unknowns, including the estimated variance factors.
    ground : (m, 3) ndarray
        Adjusted coordinates of the m points, ITRS, in metres; NaN for undetermined points.
    spread : (m, 3, 3) ndarray
        Covariance of the points for known x, in m^2.
    weight : tuple of (n,) ndarray
        Robust weights of the n measurements of each set of observations.
    standard : tuple of (n, d) ndarray
        Standardised residuals of the n measurements, d equations each, of each set of observations.
    groups : mapping of str to GroupTest
        Test of each variance group.
    chi_square : float
        Chi-square of all observations and priors.
    degrees_of_freedom : int
        Degrees of freedom of the chi-square.
    reduced : Reduced
        Reduced equations at the solution.
    iterations : int
        Total number of Gauss-Newton steps.
    """

    assembly: Assembly
    x: Array
    covariance: Array
    ground: Array
    spread: Array
    weight: tuple[Array, ...]
    standard: tuple[Array, ...]
    groups: Mapping[str, GroupTest]
    chi_square: float
    degrees_of_freedom: int
    reduced: Reduced
    iterations: int

    @property
    def p_value(self) -> float:
        """p-value of the chi-square for correct sigmas and error models; valid without robust weights."""
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)

    @property
    def factors(self) -> dict[str, float]:
        """Estimated factor on the a-priori variance of each group of observations or priors, by its name."""
        return {name: test.factor for name, test in self.groups.items()}

    @cached_property
    def _filled(self) -> Array:
        """Adjusted coordinates of the points, or start values where they are undetermined, ITRS, in metres."""
        return np.where(np.isfinite(self.ground), self.ground, self.assembly.block.points.start)

    @property
    def state(self) -> State:
        """Unknowns, points, weights and variance factors at the end of the adjustment."""
        return State(self.x, self._filled, self.weight, self.factors)

    def point_covariance(self, points: Indices) -> Array:
        """Return the covariances of k selected points, (k, 3, 3), ITRS, in m^2; NaN for undetermined points."""
        covariance = np.full((len(points), 3, 3), np.nan)
        for numbers, columns, coupling in self._couplings(points):
            covariance[numbers] = self.spread[points[numbers]] + coupling @ self.covariance[
                np.ix_(columns, columns)
            ] @ np.swapaxes(coupling, 1, 2)
        covariance[~np.isfinite(self.ground[points]).all(axis=1)] = np.nan
        return covariance

    def _couplings(self, points: Indices) -> Iterator[tuple[Indices, Indices, Array]]:
        """Yield numbers of n of the selected points, W unknowns, and minus the points' derivatives by them (n, 3, W).

        The derivatives are those of the adjusted coordinates, in metres for one sigma of the unknowns.
        """
        reduction = self.assembly.reduction
        for rows in reduction.restricted(points).rows(reduction.state_of(points, self.state)):
            inner = self.spread[points[rows.bundle.points]]
            coupling = inner @ np.swapaxes(rows.by_point, 1, 2) @ rows.by_x
            yield rows.bundle.points, rows.bundle.columns, coupling

    def relative_variance(self, points: Indices, direction: Array) -> Array:
        """Return the variances (k,) of coordinates of k determined points relative to their mean, in m^2.

        Errors that all points share, as of images that may be shifted alike, do not count.

        Parameters
        ----------
        points : (k,) ndarray of int
            Indices of the points.
        direction : (k, 3) ndarray
            Unit vector of each point's coordinate, ITRS; for heights that of the vertical.
        """
        mean = np.zeros(len(self.x))
        for numbers, columns, coupling in self._couplings(points):
            np.add.at(mean, columns, np.einsum("ni,niw->w", direction[numbers], coupling) / len(points))
        of_mean = self.covariance @ mean
        alone = np.einsum("ni,nij,nj->n", direction, self.spread[points], direction)
        variance = alone * (1.0 - 2.0 / len(points)) + alone.sum() / len(points) ** 2 + mean @ of_mean
        # a second pass, since the derivatives of all points at once would exceed the memory of a large block
        for numbers, columns, coupling in self._couplings(points):
            slope = np.einsum("ni,niw->nw", direction[numbers], coupling)
            known = self.covariance[np.ix_(columns, columns)]
            variance[numbers] += np.einsum("nv,vw,nw->n", slope, known, slope) - 2.0 * slope @ of_mean[columns]
        return np.maximum(variance, 0.0)

    def change(self, *scenes: str) -> tuple[Array, Array]:
        """Return the changes of the cameras of scenes, one after the other, and their joint covariance.

        The change in a scene is d_alpha, d_beta, d_gamma (rotations about the camera's Y, X and Z axes) and d_f
        (principal distance), in radians and metres. For a scene that is a function of the ground it is the correction
        of the image: its coefficients for the line, then for the sample, in pixels.
        """
        columns = np.concatenate([self.assembly.changes[scene] for scene in scenes])
        unit = np.concatenate([self.assembly.units[scene] for scene in scenes])
        return unit * self.x[columns], unit[:, None] * self.covariance[np.ix_(columns, columns)] * unit

    def datum(self) -> tuple[Array, Array] | None:
        """Return the common shift (3,) of the control points, ITRS, in metres, and its covariance.

        None if the adjustment did not estimate it.
        """
        where = self.assembly.datum
        return (self.x[where], self.covariance[np.ix_(where, where)]) if len(where) else None

    def rejected(self) -> tuple[tuple[str, str], ...]:
        """Return the names of the point and of the observation set (scene) of every rejected measurement."""
        ids = self.assembly.block.points.ids
        return tuple(
            (str(ids[p]), packets.name)
            for packets, weight in zip(self.assembly.reduction.sets, self.weight, strict=True)
            for p in packets.point[weight <= SETTLED].tolist()
        )


def accepted_block(adjustment: BlockAdjustment) -> Block:
    """Return the block without rejected measurements, from the adjusted points; rejected control points become ties."""
    block, sets = adjustment.assembly.block, adjustment.assembly.reduction.sets
    keep = {packets.name: weight > SETTLED for packets, weight in zip(sets, adjustment.weight, strict=True)}
    scenes = tuple(
        s.taken(keep[s.name]) if s.name in keep and not s.name.endswith(" laser") else s for s in block.scenes
    )
    footprints = tuple(f.taken(keep[f"{f.of} laser"]) for f in block.footprints)
    points = block.points
    role = points.role.copy()
    for packets, weight in zip(sets, adjustment.weight, strict=True):
        if packets.group == "control":
            role[packets.point[weight <= SETTLED]] = "tie"
    terrain = block.terrain
    if terrain is not None:
        terrain = terrain.taken(keep["terrain"])
    footprints = tuple(f for f in footprints if len(f.point))
    # the first position of a point with a gross error may be far from its images
    ground = adjustment._filled
    start = np.where((role == "control")[:, None], points.start, ground)
    points = replace(points, role=role, start=start, approximate=ground)
    return replace(block, scenes=scenes, footprints=footprints, points=points, terrain=terrain)


class _Factor:
    """Factorisation of a positive definite matrix after scaling to unit diagonal."""

    def __init__(self, matrix: sparse.csc_matrix) -> None:
        # every unknown has a prior, so that no diagonal element is zero
        self.size = 1.0 / np.sqrt(matrix.diagonal())
        self.scaled = (sparse.diags(self.size) @ matrix @ sparse.diags(self.size)).tocsc()
        self.count = matrix.shape[0]
        try:
            if self.count <= _DENSE:
                factor = cho_factor(self.scaled.toarray())
                self._solve = lambda right: cho_solve(factor, right)
            else:
                options = {"SymmetricMode": True}
                lu = splu(self.scaled, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
                self._solve = lu.solve
        except (np.linalg.LinAlgError, RuntimeError) as error:
            raise BlockError(_SINGULAR) from error

    def solve(self, right: Array) -> Array:
        """Solve the linear system of P equations for one right-hand side (P,), or for k of them together (P, k)."""
        size = self.size if right.ndim == 1 else self.size[:, None]
        return np.asarray(size * self._solve(size * right))

    def inverse(self) -> Array:
        """Return the full inverse of the matrix, dense.

        It is several times faster from a dense factorisation than column by column from a sparse one.
        """
        inverse, failed = dpotrf(self.scaled.toarray(order="F"), lower=1, clean=0, overwrite_a=1)
        if failed:
            raise BlockError(_SINGULAR)
        inverse, _ = dpotri(inverse, lower=1, overwrite_c=1)
        for a in range(0, self.count, _COLUMNS):
            b = min(a + _COLUMNS, self.count)
            corner = np.tril(inverse[a:b, a:b])
            inverse[a:b, a:b] = corner + np.tril(corner, -1).T
            inverse[a:b, b:] = inverse[b:, a:b].T
        inverse *= self.size
        inverse *= self.size[:, None]
        return np.ascontiguousarray(inverse.T)


def adjust_block(
    block: Block,
    *,
    robust: Literal["huber", "reject"] | None = None,
    variance_components: bool | Collection[str] = False,
    datum: bool = False,
    pool: Pool | None = None,
    start: BlockAdjustment | None = None,
) -> BlockAdjustment:
    """Adjust points, attitude, station and cameras of a block of line-camera images by least squares.

    Parameters
    ----------
    block : Block
        Images, points, cameras and prior knowledge; see `make_block`.
    robust : {"huber", "reject"}, optional
        "huber" reduces the weight of large residuals. "reject" also excludes outliers (and, by chance, one good
        observation in 10 000) and points with too few remaining observations.
    variance_components : bool or collection of str
        True to estimate a factor on the variances of every group of observations, or the names of the groups.
    datum : bool
        True to estimate a shift that all control points share.
    pool : Pool, optional
        Worker processes that eliminate the points; None for this process alone.
    start : BlockAdjustment, optional
        Adjustment of the same block, with or without `datum`, where this one starts.

    Returns
    -------
    BlockAdjustment
        Coordinates `ground` of the m points, (m, 3), in metres, `point_covariance`, `change` of the camera of each
        image, residuals and tests of the variance groups, chi-square and `p_value`.

    Raises
    ------
    ValueError
        Input that cannot be used, points that lie elsewhere than their images, or no convergence.

    Examples
    --------
    Two cameras, 25 deg forward and 25 deg backward, image 40 points from 500 km. Four of them are control points:

    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> import analysis
    >>> rng = np.random.default_rng(10)
    >>> down = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # X along the track, Z down
    >>> ground = np.column_stack([6.378e6 + rng.uniform(0, 500, 40), rng.uniform(-2e4, 2e4, (40, 2))])
    >>> cameras, images = {}, {}
    >>> for name, look in (("forward", 25.0), ("backward", -25.0)):
    ...     mount = Rotation.from_euler("Y", look, degrees=True).as_matrix()
    ...     cameras[name] = analysis.LineModel.of(mount, [1.7, 0.0, 0.0])
    ...     drop = 6.878e6 - ground[:, 0]
    ...     ahead = drop * np.tan(np.radians(look))
    ...     station = np.column_stack([np.full(40, 6.878e6), ground[:, 1] - ahead, np.zeros(40)])
    ...     y = 1.7 * ground[:, 2] / np.hypot(drop, ahead)
    ...     image = np.column_stack([np.zeros(40), y]) + 2e-6 * rng.standard_normal((40, 2))
    ...     time = station[:, 1] / 7000.0
    ...     wrong = station + [0.3, -0.2, 0.4]  # the error of the orbit in this pass
    ...     images["pass 1", name] = analysis.Rays.of(np.arange(40), image, wrong, np.tile(down, (40, 1, 1)), time)
    >>> block = analysis.make_block(images, cameras, ground, control_sigma=np.where(np.arange(40) < 4, 0.1, np.inf),
    ...     image_sigma=2e-6, attitude_sigma=1e-6, station_sigma=0.5, camera_sigma=[1e-6, 1e-6, 1e-6, 1e-6])
    >>> solution = analysis.adjust_block(block)
    >>> sigma = np.sqrt(np.einsum("nii->ni", solution.point_covariance(np.arange(40))))
    >>> np.round(np.median(sigma[4:], axis=0), 2)
    array([1.19, 0.56, 0.51])
    >>> error = (solution.ground - ground)[4:] / sigma[4:]
    >>> bool(np.sqrt(np.mean(error**2)) < 1.5), bool(solution.p_value > 0.01)
    (True, True)
    """
    block.check()
    block = pruned(block)
    check_places(block, robust is not None)
    assembly = assembled(block, datum)
    reduction = assembly.reduction
    if reduction.size > _MOST:
        raise BlockError(f"block: {reduction.size} unknowns beside the points; at most {_MOST} are adjusted at once")
    points: Reduction | SharedReduction = reduction if pool is None else SharedReduction.of(reduction, pool)
    groups = [*(member.group for member in reduction.sets), *(member.group for member in reduction.priors)]
    weight = tuple(np.ones(len(member.point)) for member in reduction.sets)
    state = _AdjustmentState(np.zeros(reduction.size), block.points.first.copy(), weight, dict.fromkeys(groups, 1.0))
    if start is not None:
        state = replace(state, x=start.x[: reduction.size], ground=start._filled, weight=start.weight)
    elif robust:
        state = screened(reduction.sets, intersection(reduction.sets, state), lambda at: _step(reduction, points, at))
    if robust == "reject" and start is None:
        state = replace(state, weight=consistent(reduction.sets, state))
    problem = _Problem(assembly, points)
    rule = Rule(
        problem.accepted if robust == "reject" else robust,
        "components" if variance_components else None,
        None if isinstance(variance_components, bool) else variance_components,
        free=_FREE_ROUNDS,
    )
    try:
        if robust == "reject" and not variance_components:
            # few measurements change: the covariance of the first solution serves until the last
            first, solution = problem.solve(state)
            state, _ = settled(replace(problem, covariance=solution.covariance), first, rule)
            if all(np.array_equal(a, b) for a, b in zip(first.weight, state.weight, strict=True)):
                return _result(assembly, first, solution)
        state, solution = settled(problem, state, rule)
    except UnsettledError as error:
        raise BlockError(f"block: {error}") from error
    return _result(assembly, state, solution)


@dataclass(frozen=True, eq=False)
class _AdjustmentState(State):
    """Unknowns, points, weights and variance factors of an adjustment, with the number of Gauss-Newton steps so far."""

    steps: int = 0


@dataclass(frozen=True, eq=False)
class _Solution:
    """Reduced equations, covariance of the P unknowns, standardised residuals and variance tests of a solution."""

    reduced: Reduced
    covariance: Array
    checked: Checked
    tests: Mapping[str, GroupTest]


@dataclass(frozen=True, eq=False)
class _Problem:
    """Constant input of an adjustment during reweighting, with the methods that `reweighting.settled` calls.

    A `covariance` (P, P) of the unknowns replaces that of each solution.
    """

    assembly: Assembly
    points: Reduction | SharedReduction
    covariance: Array | None = None

    def solve(self, state: _AdjustmentState, screening: bool = False) -> tuple[_AdjustmentState, _Solution]:
        """Iterate the adjustment at fixed weights and return the converged state and its solution."""
        reduction = self.assembly.reduction
        tolerance = _CONVERGED if self.covariance is None else _ROUGH
        state, reduced, factor = _solved(reduction, self.points, state, tolerance)
        covariance = factor.inverse() if self.covariance is None else self.covariance
        checked = self.points.checked(state, reduced.spread, _part_of(covariance))
        tests = _tests(reduction, state, covariance, reduced, checked.taken)
        return state, _Solution(reduced, covariance, checked, tests)

    def judged(self, state: _AdjustmentState, solution: _Solution) -> tuple[Array, ...]:
        """Return the standardised residuals of every set of observations, (n, d) for n measurements of d equations."""
        return solution.checked.standard

    def tests(self, state: _AdjustmentState, solution: _Solution) -> Mapping[str, GroupTest]:
        """Return the chi-square test of the residuals of each variance group, by the name of the group."""
        return solution.tests

    def accepted(self, standard: tuple[Array, ...], weight: tuple[Array, ...]) -> tuple[Array, ...]:
        """Return weights 0 of the measurements that the others of their point contradict, and 1 of all others."""
        square = [np.sum(rows**2, axis=1) for rows in standard]
        return tuple(np.where(bad, 0.0, 1.0) for bad in contradicted(self.assembly.reduction.sets, square, weight))

    def weighed(
        self, state: _AdjustmentState, weight: tuple[Array, ...], factor: Mapping[str, float]
    ) -> _AdjustmentState:
        """Return the state with new weights, zero at points that fewer than three equations would determine."""
        sets = self.assembly.reduction.sets
        # the residuals of a point without weights show nothing
        lost = (_rows_left(self.assembly, weight) < 3) | (_rows_left(self.assembly, state.weight) < 3)
        weights = tuple(np.where(lost[packets.point], 0.0, w) for packets, w in zip(sets, weight, strict=True))
        return replace(state, weight=weights, factor=factor)


def _solved(
    reduction: Reduction, points: Reduction | SharedReduction, state: _AdjustmentState, tolerance: float
) -> tuple[_AdjustmentState, Reduced, _Factor]:
    """Iterate Gauss-Newton steps at fixed weights until a step is below `tolerance` sigmas."""
    last = np.inf
    for _ in range(_STEPS):
        reduced = reduction.with_priors(points.eliminated(state), state)
        total = reduced.data + reduced.prior
        factor = _Factor(total)
        step = -factor.solve(reduced.right)
        size = float(np.sqrt(max(float(step @ (total @ step)), 0.0)))
        # points that are still far from their position for the present x count, too
        if size + _largest(reduced.start, reduced.spread) < _CONVERGED:
            # the effect of the step of x on the points is smaller than the step
            state = replace(state, x=state.x + step, ground=state.ground + reduced.start, steps=state.steps + 1)
            return state, reduced, factor
        point_steps = points.point_steps(state, reduced, step)
        state = replace(state, x=state.x + step, ground=state.ground + point_steps, steps=state.steps + 1)
        size = max(size, _largest(point_steps, reduced.spread))
        if size < tolerance or (size < 1e3 * tolerance and size > 0.5 * last):
            if tolerance == _CONVERGED:  # a rough solution is not the last one
                reduced = reduction.with_priors(points.eliminated(state), state)
            return state, reduced, factor
        if not np.isfinite(size):
            break
        last = size
    raise BlockError(f"block: no convergence in {_STEPS} steps, the last of {last:.3g} sigmas")


def _step(reduction: Reduction, points: Reduction | SharedReduction, state: _AdjustmentState) -> _AdjustmentState:
    """Return the state after one Gauss-Newton step at fixed weights."""
    reduced = reduction.with_priors(points.eliminated(state), state)
    step = -_Factor(reduced.data + reduced.prior).solve(reduced.right)
    ground = state.ground + points.point_steps(state, reduced, step)
    return replace(state, x=state.x + step, ground=ground, steps=state.steps + 1)


def _part_of(covariance: Array) -> Callable[[Indices], Array]:
    """Return a function that takes the indices of k unknowns and returns their covariance (k, k)."""
    return lambda columns: np.asarray(covariance[np.ix_(columns, columns)])


def _largest(steps: Array, spread: Array) -> float:
    """Return the largest coordinate step of m points, relative to their standard deviations.

    Steps are (m, 3), covariances (m, 3, 3); points without a covariance are ignored.
    """
    used = spread[:, 0, 0] > 0
    weighted_steps = np.linalg.solve(spread[used], steps[used][:, :, None])[:, :, 0]
    return float(np.sqrt(np.max(np.sum(steps[used] * weighted_steps, axis=1), initial=0.0)))


def _rows_left(assembly: Assembly, weight: Sequence[Array]) -> NDArray[np.intp]:
    """Return the number of observation equations with nonzero weight at each of the m points."""
    return equations_left(assembly.reduction.sets, weight, assembly.reduction.count, SETTLED)


def _tests(
    reduction: Reduction, state: State, covariance: Array, reduced: Reduced, absorbed: Mapping[str, float]
) -> dict[str, GroupTest]:
    """Return the chi-square tests of all variance groups, both of observations and of priors."""
    counts: dict[str, int] = {}
    for packets, weight in zip(reduction.sets, state.weight, strict=True):
        counts[packets.group] = counts.get(packets.group, 0) + packets.rows * int(np.sum(weight > SETTLED))
    tests = {
        name: GroupTest(counts[name], counts[name] - absorbed[name], reduced.square[name], state.factor[name])
        for name in absorbed
    }
    absorbed_by_priors: dict[str, float] = {}
    for prior in reduction.priors:
        posterior = covariance[np.ix_(prior.columns, prior.columns)]
        part = float(prior.precision.multiply(posterior).sum()) / state.factor[prior.group]
        absorbed_by_priors[prior.group] = absorbed_by_priors.get(prior.group, 0.0) + part
    square, ranks = reduction.prior_square(state.x, state.factor), group_ranks(reduction.priors)
    for name, value in absorbed_by_priors.items():
        tests[name] = GroupTest(ranks[name], ranks[name] - value, square[name], state.factor[name])
    return tests


def _result(assembly: Assembly, state: _AdjustmentState, solution: _Solution) -> BlockAdjustment:
    """Return the result of an adjustment from its final state and solution."""
    rows = _rows_left(assembly, state.weight)
    determined = rows >= 3
    ranks = group_ranks(assembly.reduction.priors)
    freedom = int(rows.sum()) - 3 * int(determined.sum()) + sum(ranks.values()) - assembly.reduction.size
    return BlockAdjustment(
        assembly=assembly,
        x=state.x,
        covariance=solution.covariance,
        ground=np.where(determined[:, None], state.ground, np.nan),
        spread=solution.reduced.spread,
        weight=state.weight,
        standard=solution.checked.standard,
        groups=solution.tests,
        chi_square=sum(test.square for test in solution.tests.values()),
        degrees_of_freedom=freedom,
        reduced=solution.reduced,
        iterations=state.steps,
    )


_KINDS = ("white", "walk", "slow")
"""Kinds of error models that are tested for serial correlation."""
_LARGEST = 4000
"""Largest number of unknowns of a process that is tested, because its matrices are dense."""
_LEAST = 2.0
"""Smallest redundancy of an error model for which its serial correlation is tested."""


@dataclass(frozen=True)
class LawTest:
    """Serial correlation test of one error model, over all its scopes.

    Attributes
    ----------
    group : str
        Variance group of the error model.
    kind : str
        Specified kind of process.
    excess : float
        Sum of the products of whitened unknowns that are neighbours in time, minus its expectation, in standard
        deviations; positive if they are positively correlated.
    """

    group: str
    kind: str
    excess: float

    @property
    def p_value(self) -> float:
        """Two-sided p-value of `excess` under the hypothesis that the error model is right."""
        return float(2.0 * norm.sf(abs(self.excess)))

    def __str__(self) -> str:
        sign = "positively" if self.excess > 0 else "negatively"
        return (
            f"{self.group}: errors that should be independent in a {self.kind} process are {sign} correlated"
            f" ({self.excess:+.1f} sigma, p = {self.p_value:.1g}): the specified error model does not fit the readings"
        )


def law_tests(adjustment: BlockAdjustment) -> tuple[LawTest, ...]:
    """Test error models for serial correlation, where the observations determine them sufficiently."""
    sums: dict[str, list[float]] = {}
    kinds: dict[str, str] = {}
    for process in adjustment.assembly.all_processes:
        law = process.support.law
        if law.kind not in _KINDS or process.support.size > _LARGEST or len(process.support.numbers) < 3:
            continue
        value, mean, variance, redundancy = _neighbours(adjustment, process)
        kinds[law.group] = law.kind
        total = sums.setdefault(law.group, [0.0, 0.0, 0.0, 0.0])
        for k, part in enumerate((value, mean, variance, redundancy)):
            total[k] += part
    tests = []
    for group, (value, mean, variance, redundancy) in sums.items():
        if redundancy >= _LEAST and variance > 0.0:
            tests.append(LawTest(group, kinds[group], (value - mean) / float(np.sqrt(variance))))
    return tuple(tests)


def _neighbours(adjustment: BlockAdjustment, process: Process) -> tuple[float, float, float, float]:
    """Return the statistic of the serial correlation test of a process, and the redundancy of the process.

    The statistic is the sum of the products of whitened unknowns that are neighbours in time; its expectation and its
    variance follow it.
    """
    root = np.kron(process.support.whitened(), np.eye(3))
    whitened = root.T @ adjustment.x[process.columns]
    covariance = adjustment.covariance[np.ix_(process.columns, process.columns)]
    factor = adjustment.factors[process.support.law.group]
    spread = factor * np.eye(len(whitened)) - root.T @ covariance @ root
    redundancy = float(np.trace(spread)) / factor
    size = float(whitened @ whitened) / max(float(np.trace(spread)), 1e-12)
    neighbours = np.zeros_like(spread)
    rows = np.arange(len(whitened) - 3)
    neighbours[rows, rows + 3] = neighbours[rows + 3, rows] = 0.5
    product = neighbours @ spread
    # at the estimated variance: a wrong sigma alone does not make the error model wrong
    scale = max(size, 1.0) if redundancy > _LEAST else 1.0
    mean, variance = float(np.trace(product)), 2.0 * float(np.sum(product * product.T))
    return float(whitened @ neighbours @ whitened) / scale, mean, variance, redundancy
