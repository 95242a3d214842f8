"""Adjustment of a block: Gauss-Newton on all packets and priors, robust weights, variance components, covariances.

The weights and factors follow the rules of `reweighting`.

What is plainly wrong with a block before it is adjusted: points elsewhere than their images, points seen once.

Whether the readings' errors follow their stated laws: serial correlation of what should be independent.

With the right law the whitened unknowns e of a process are independent, of unit variance; those that are estimated have
the covariance S = I - C, with C that of the whitened errors after the adjustment. The sum q of the products of
neighbours in time then has the expectation tr(L S) and the variance 2 tr(L S L S), L the matrix of neighbours: exactly,
however little of the process the observations tell. White noise that is a walk in truth has neighbours that are alike,
a walk that is white noise in truth neighbours that are opposite. The size of the errors is what variances tell
(`GroupTest`), and q is compared at the variance that they have.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
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
from analysis.block.block import Block
from analysis.block.error_processes import BlockError
from analysis.block.point_reduction import Checked, Pool, Reduced, Reduction, SharedReduction, State
from analysis.block.reweighting import SETTLED, GroupTest, Rule, UnsettledError, settled

FAR = 0.02
"""Radians between where a point is said to be and where its image looks: 10 km below 500 km. Orbits and attitudes are
known a hundred times better."""
_NAMED = 8


def pruned(block: Block) -> Block:
    """The block without observations of points that they do not determine: fewer than three rows at a point.

    Raises
    ------
    BlockError
        Nothing is left.
    """
    rows = np.zeros(len(block.points.ids), np.intp)
    for scene in block.scenes:
        np.add.at(rows, scene.rays.point, 2)
    for one in block.footprints:
        np.add.at(rows, one.point, 3)
    if block.terrain is not None:
        np.add.at(rows, block.terrain.point, 1)
    rows[block.points.role == "control"] += 3
    good = rows >= 3
    if not np.any(good):
        raise BlockError("block: no point is seen by two scenes, and none is control")
    scenes = tuple(replace(s, rays=s.rays.taken(good[s.rays.point])) for s in block.scenes)
    terrain = block.terrain
    if terrain is not None:
        terrain = terrain.taken(good[terrain.point])
    return replace(block, scenes=scenes, terrain=terrain)


def check_places(block: Block) -> None:
    """Whether every point lies about where its images look.

    Raises
    ------
    BlockError
        Points that do not, by name.
    """
    wrong: list[str] = []
    control: list[bool] = []
    for scene in block.scenes:
        rays = scene.rays
        if not len(rays.point):
            continue
        arm = block.points.start[rays.point] - rays.station
        away = np.linalg.norm(arm, axis=1, keepdims=True)
        look = np.einsum("nij,nj->ni", rays.attitude, block.cameras[scene.camera].directions(rays.image))
        apart = np.linalg.norm(np.cross(look, arm / np.maximum(away, 1.0)), axis=1)
        bad = (apart > FAR) | (np.sum(look * arm, axis=1) <= 0)
        names = block.points.ids[rays.point[bad]].tolist()
        wrong += [f"{name} in {scene.name}" for name in names]
        control += (block.points.role[rays.point[bad]] == "control").tolist()
    if not wrong:
        return
    shown = ", ".join(wrong[:_NAMED]) + (f" and {len(wrong) - _NAMED} more" if len(wrong) > _NAMED else "")
    hint = "are their coordinates geocentric (ITRS), in metres and in the order x, y, z?" if all(control) else (
        "are their images those of the scenes named?"
    )  # fmt: skip
    raise BlockError(f"block: these points lie more than {FAR:g} rad from where their images look: {shown}; {hint}")


_STEPS = 20
"""Most Gauss-Newton steps of one round."""
_CONVERGED = 1e-6
"""Size of the last step, in sigmas of all unknowns together."""
_DENSE = 2500
"""Unknowns up to which a dense factor is faster than a sparse one."""
_MOST = 20_000
"""Unknowns whose covariance is kept whole: 3.2 GB."""
_COLUMNS = 256
_SINGULAR = "block: the equations are singular; a sigma is too large for what observes it"
_HUBER_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class BlockAdjustment:
    """Solution of a block.

    Attributes
    ----------
    assembly : Assembly
        The block in equations.
    x : Array
        (P,) unknowns in units of their priors' sigmas. covariance: (P, P) of them, with the factors.
    ground : Array
        (m, 3) points, ITRS, metres; NaN for those that nothing determines.
    spread : Array
        (m, 3, 3) their covariance at known x.
    weight : tuple[Array, ...]
        Set -> (n,) robust weights. standard: set -> (n, d) standardised residuals.
    groups : Mapping[str, GroupTest]
        Variance group -> test.
    chi_square, degrees_of_freedom : float
        Of all observations and priors.
    reduced : Reduced
        The equations at the solution.
    iterations : int
        Gauss-Newton steps in all.
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
        """Chance of such a chi-square or a larger one, if the sigmas and laws are right; without robust weights."""
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)

    @property
    def factors(self) -> dict[str, float]:
        """Group -> variance factor."""
        return {name: one.factor for name, one in self.groups.items()}

    @cached_property
    def _filled(self) -> Array:
        return np.where(np.isfinite(self.ground), self.ground, self.assembly.block.points.start)

    @property
    def state(self) -> State:
        """Where the adjustment ended."""
        return State(self.x, self._filled, self.weight, self.factors)

    def point_covariance(self, points: Indices) -> Array:
        """(k, 3, 3) covariance of any of the block's points, ITRS, m^2; NaN where nothing determines one."""
        reduction = self.assembly.reduction
        found = np.full((len(points), 3, 3), np.nan)
        for rows in reduction.restricted(points).rows(reduction.state_of(points, self.state)):
            where, columns = rows.bundle.points, rows.bundle.columns
            inner = self.spread[points[where]]
            moved = inner @ np.swapaxes(rows.by_point, 1, 2) @ rows.by_x
            found[where] = inner + moved @ self.covariance[np.ix_(columns, columns)] @ np.swapaxes(moved, 1, 2)
        found[~np.isfinite(self.ground[points]).all(axis=1)] = np.nan
        return found

    def change(self, scene: str) -> tuple[Array, Array]:
        """Camera of a scene: d_alpha, d_beta, d_gamma, d_f (4,), radians and metres, and their covariance (4, 4)."""
        columns, unit = self.assembly.changes[scene], self.assembly.units[scene]
        return unit * self.x[columns], unit[:, None] * self.covariance[np.ix_(columns, columns)] * unit

    def datum(self) -> tuple[Array, Array] | None:
        """Common shift of the control points (3,), ITRS, metres, and its covariance; None where not looked for."""
        where = self.assembly.datum
        return (self.x[where], self.covariance[np.ix_(where, where)]) if len(where) else None

    def rejected(self) -> tuple[tuple[str, str], ...]:
        """Point and set of every packet that robust weights gave up."""
        ids = self.assembly.block.points.ids
        return tuple(
            (str(ids[p]), one.name)
            for one, weight in zip(self.assembly.reduction.sets, self.weight, strict=True)
            for p in one.point[weight <= SETTLED].tolist()
        )


def kept_block(found: BlockAdjustment) -> Block:
    """The block without the packets that robust weights gave up. Rejected control points become tie points."""
    block, sets = found.assembly.block, found.assembly.reduction.sets
    keep = {one.name: weight > SETTLED for one, weight in zip(sets, found.weight, strict=True)}
    scenes = tuple(
        replace(s, rays=s.rays.taken(keep[s.name])) if s.name in keep and not s.name.endswith(" laser") else s
        for s in block.scenes
    )
    footprints = tuple(f.taken(keep[f"{f.of} laser"]) for f in block.footprints)
    points = block.points
    role = points.role.copy()
    for one, weight in zip(sets, found.weight, strict=True):
        if one.group == "control":
            role[one.point[weight <= SETTLED]] = "tie"
    terrain = block.terrain
    if terrain is not None:
        terrain = terrain.taken(keep["terrain"])
    footprints = tuple(f for f in footprints if len(f.point))
    return replace(block, scenes=scenes, footprints=footprints, points=replace(points, role=role), terrain=terrain)


class _Factor:
    """A factor of a positive definite matrix, whose unknowns are brought to one size first."""

    def __init__(self, matrix: sparse.csc_matrix) -> None:
        # every unknown has a prior, so that none of these is zero
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
        """Solution for right sides (P,) or (P, k)."""
        size = self.size if right.ndim == 1 else self.size[:, None]
        return np.asarray(size * self._solve(size * right))

    def inverse(self) -> Array:
        """(P, P), whole: several times faster from a whole factor than column by column from a sparse one."""
        found, failed = dpotrf(self.scaled.toarray(order="F"), lower=1, clean=0, overwrite_a=1)
        if failed:
            raise BlockError(_SINGULAR)
        found, _ = dpotri(found, lower=1, overwrite_c=1)
        for a in range(0, self.count, _COLUMNS):
            b = min(a + _COLUMNS, self.count)
            own = np.tril(found[a:b, a:b])
            found[a:b, a:b] = own + np.tril(own, -1).T
            found[a:b, b:] = found[b:, a:b].T
        found *= self.size
        found *= self.size[:, None]
        return np.ascontiguousarray(found.T)


def adjust_block(
    block: Block,
    *,
    robust: Literal["huber", "reject"] | None = None,
    variance_components: bool | Collection[str] = False,
    datum: bool = False,
    pool: Pool | None = None,
) -> BlockAdjustment:
    """Adjust a block.

    Parameters
    ----------
    block : Block
        What is observed, and what is known of it.
    robust : Literal['huber', 'reject'] | None
        "huber" takes weight from packets with large residuals; "reject" leaves out those that stand out from the others
        so weighed, one good packet in 10 000, and with them points of which too little is left.
    variance_components : bool | Collection[str]
        Estimate a factor on the variances of every group, or of those named.
    datum : bool
        Look for a shift that all control points have in common.
    pool : Pool | None
        Processes that reduce the points; None for this one alone.

    Raises
    ------
    BlockError
        Input that cannot be used, points that are not what was photographed, no convergence.
    """
    block.check()
    block = pruned(block)
    check_places(block)
    assembly = assembled(block, datum)
    reduction = assembly.reduction
    if reduction.size > _MOST:
        raise BlockError(f"block: {reduction.size} unknowns beside the points; at most {_MOST} are adjusted at once")
    points: Reduction | SharedReduction = reduction if pool is None else SharedReduction.of(reduction, pool)
    groups = [*(one.group for one in reduction.sets), *(one.group for one in reduction.priors)]
    weight = tuple(np.ones(len(one.point)) for one in reduction.sets)
    at = _At(np.zeros(reduction.size), block.points.start.copy(), weight, dict.fromkeys(groups, 1.0))
    rule = Rule(
        "accept" if robust == "reject" else robust,
        "components" if variance_components else None,
        None if isinstance(variance_components, bool) else variance_components,
        _HUBER_ROUNDS if robust else 0,
    )
    try:
        at, found = settled(_Problem(assembly, points), at, rule)
    except UnsettledError as error:
        raise BlockError(f"block: {error}") from error
    return _result(assembly, at, found)


@dataclass(frozen=True, eq=False)
class _At(State):
    """Where an adjustment stands, with the Gauss-Newton steps so far."""

    steps: int = 0


@dataclass(frozen=True, eq=False)
class _Solution:
    """Equations at a solution, covariance (P, P) of the unknowns, the packets beside what all others say, groups."""

    reduced: Reduced
    covariance: Array
    checked: Checked
    tests: Mapping[str, GroupTest]


@dataclass(frozen=True, eq=False)
class _Problem:
    """What does not change while weights come to rest."""

    assembly: Assembly
    points: Reduction | SharedReduction

    def solve(self, at: _At, screening: bool) -> tuple[_At, _Solution]:
        """See `Reweighted`."""
        reduction = self.assembly.reduction
        # weights that will change are not worth more than a step or two
        tolerance = 1e-2 if screening else _CONVERGED
        at, reduced, factor = _solved(reduction, self.points, at, tolerance)
        covariance = factor.inverse()
        checked = self.points.checked(at, reduced.spread, _part_of(covariance))
        tests = _tests(reduction, at, covariance, reduced, checked.taken)
        return at, _Solution(reduced, covariance, checked, tests)

    def judged(self, at: _At, found: _Solution) -> tuple[Array, ...]:
        """See `Reweighted`."""
        return found.checked.standard

    def tests(self, at: _At, found: _Solution) -> Mapping[str, GroupTest]:
        """See `Reweighted`."""
        return found.tests

    def weighed(self, at: _At, weight: tuple[Array, ...], factor: Mapping[str, float]) -> _At:
        """The state without weights at points that fewer than three rows determine."""
        lost = _rows_left(self.assembly, weight) < 3
        sets = self.assembly.reduction.sets
        kept = tuple(np.where(lost[one.point], 0.0, w) for one, w in zip(sets, weight, strict=True))
        return replace(at, weight=kept, factor=factor)


def _solved(
    reduction: Reduction, points: Reduction | SharedReduction, at: _At, tolerance: float
) -> tuple[_At, Reduced, _Factor]:
    """Gauss-Newton with the weights as they stand, until a step is below so many sigmas."""
    last = np.inf
    for _ in range(_STEPS):
        reduced = reduction.with_priors(points.eliminated(at), at)
        total = reduced.data + reduced.prior
        factor = _Factor(total)
        step = -factor.solve(reduced.right)
        size = float(np.sqrt(max(float(step @ (total @ step)), 0.0)))
        # points that stay too far from where x puts them count, too
        if size + _largest(reduced.start, reduced.spread) < _CONVERGED:
            # what x moves them by is less than its own step
            at = replace(at, x=at.x + step, ground=at.ground + reduced.start, steps=at.steps + 1)
            return at, reduced, factor
        moved = points.point_steps(at, reduced, step)
        at = replace(at, x=at.x + step, ground=at.ground + moved, steps=at.steps + 1)
        size = max(size, _largest(moved, reduced.spread))
        if size < tolerance or (size < 1e3 * tolerance and size > 0.5 * last):
            return at, reduction.with_priors(points.eliminated(at), at), factor
        if not np.isfinite(size):
            break
        last = size
    raise BlockError(f"block: no convergence in {_STEPS} steps, the last of {last:.3g} sigmas")


def _part_of(covariance: Array) -> Callable[[Indices], Array]:
    return lambda some: np.asarray(covariance[np.ix_(some, some)])


def _largest(moved: Array, spread: Array) -> float:
    """Largest of steps (m, 3) of points with covariances (m, 3, 3), in sigmas; points without one do not count."""
    used = spread[:, 0, 0] > 0
    solved = np.linalg.solve(spread[used], moved[used][:, :, None])[:, :, 0]
    return float(np.sqrt(np.max(np.sum(moved[used] * solved, axis=1), initial=0.0)))


def _rows_left(assembly: Assembly, weight: Sequence[Array]) -> NDArray[np.intp]:
    """(m,) rows with any weight at each point."""
    rows = np.zeros(assembly.reduction.count, np.intp)
    for one, w in zip(assembly.reduction.sets, weight, strict=True):
        np.add.at(rows, one.point, one.rows * (w > SETTLED))
    return rows


def _tests(
    reduction: Reduction, at: State, covariance: Array, reduced: Reduced, taken: Mapping[str, float]
) -> dict[str, GroupTest]:
    counts: dict[str, int] = {}
    for one, weight in zip(reduction.sets, at.weight, strict=True):
        counts[one.group] = counts.get(one.group, 0) + one.rows * int(np.sum(weight > SETTLED))
    found = {
        name: GroupTest(counts[name], counts[name] - taken[name], reduced.square[name], at.factor[name])
        for name in taken
    }
    used: dict[str, float] = {}
    for prior in reduction.priors:
        own = covariance[np.ix_(prior.columns, prior.columns)]
        part = float(prior.precision.multiply(own).sum()) / at.factor[prior.group]
        used[prior.group] = used.get(prior.group, 0.0) + part
    square, ranks = reduction.prior_square(at.x, at.factor), group_ranks(reduction.priors)
    for name, value in used.items():
        found[name] = GroupTest(ranks[name], ranks[name] - value, square[name], at.factor[name])
    return found


def _result(assembly: Assembly, at: _At, found: _Solution) -> BlockAdjustment:
    rows = _rows_left(assembly, at.weight)
    known = rows >= 3
    ranks = group_ranks(assembly.reduction.priors)
    freedom = int(rows.sum()) - 3 * int(known.sum()) + sum(ranks.values()) - assembly.reduction.size
    return BlockAdjustment(
        assembly=assembly,
        x=at.x,
        covariance=found.covariance,
        ground=np.where(known[:, None], at.ground, np.nan),
        spread=found.reduced.spread,
        weight=at.weight,
        standard=found.checked.standard,
        groups=found.tests,
        chi_square=sum(one.square for one in found.tests.values()),
        degrees_of_freedom=freedom,
        reduced=found.reduced,
        iterations=at.steps,
    )


_KINDS = ("white", "walk", "slow")
_LARGEST = 4000
"""Unknowns of one process above which it is not tested; its matrices are dense."""
_LEAST = 2.0
"""Redundancy of a law below which nothing can be said of neighbours."""


@dataclass(frozen=True)
class LawTest:
    """Neighbours in time of one law's errors, in all its scopes.

    Attributes
    ----------
    group : str
        Of the law. kind: as stated.
    excess : float
        Sum of products of neighbours beyond its expectation, in standard deviations; positive where they are alike.
    """

    group: str
    kind: str
    excess: float

    @property
    def p_value(self) -> float:
        """Two-sided chance of such an excess."""
        return float(2.0 * norm.sf(abs(self.excess)))

    def __str__(self) -> str:
        alike = "alike" if self.excess > 0 else "opposite"
        return (
            f"{self.group}: errors that should be independent in a {self.kind} process are {alike} in neighbours"
            f" ({self.excess:+.1f} sigma, chance {self.p_value:.1g}): the stated law is not that of the readings"
        )


def law_tests(found: BlockAdjustment) -> tuple[LawTest, ...]:
    """A test of each law with a course in time that the observations tell something of."""
    sums: dict[str, list[float]] = {}
    kinds: dict[str, str] = {}
    for one in found.assembly.every:
        law = one.support.law
        if law.kind not in _KINDS or one.support.size > _LARGEST or len(one.support.numbers) < 3:
            continue
        value, mean, variance, told = _neighbours(found, one)
        kinds[law.group] = law.kind
        total = sums.setdefault(law.group, [0.0, 0.0, 0.0, 0.0])
        for k, part in enumerate((value, mean, variance, told)):
            total[k] += part
    tests = []
    for group, (value, mean, variance, told) in sums.items():
        if told >= _LEAST and variance > 0.0:
            tests.append(LawTest(group, kinds[group], (value - mean) / float(np.sqrt(variance))))
    return tuple(tests)


def _neighbours(found: BlockAdjustment, one: Process) -> tuple[float, float, float, float]:
    """Sum of products of neighbours, its expectation and variance, and the redundancy of the process."""
    root = np.kron(one.support.whitened(), np.eye(3))
    whitened = root.T @ found.x[one.columns]
    own = found.covariance[np.ix_(one.columns, one.columns)]
    factor = found.factors[one.support.law.group]
    spread = factor * np.eye(len(whitened)) - root.T @ own @ root
    told = float(np.trace(spread)) / factor
    size = float(whitened @ whitened) / max(float(np.trace(spread)), 1e-12)
    near = np.zeros_like(spread)
    rows = np.arange(len(whitened) - 3)
    near[rows, rows + 3] = near[rows + 3, rows] = 0.5
    product = near @ spread
    # at the variance that the errors have: a wrong size alone is no wrong law
    scale = max(size, 1.0) if told > _LEAST else 1.0
    mean, variance = float(np.trace(product)), 2.0 * float(np.sum(product * product.T))
    return float(whitened @ near @ whitened) / scale, mean, variance, told
