"""Adjustment of a block: Gauss-Newton on all packets and priors, robust weights, variance components, covariances.

The weights and factors follow the rules of `reweighting`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotrf, dpotri
from scipy.sparse.linalg import splu
from scipy.stats import chi2

from analysis.block.assembly import Assembly, assembled, group_ranks
from analysis.block.block import Block
from analysis.block.plausible_block import check_places, pruned
from analysis.block.point_reduction import Reduced
from analysis.block.processes import BlockError
from analysis.block.reweighting import GroupTest, extrapolated, robust_weights, standardised_packets

__all__ = ["BlockAdjustment", "adjust_block", "kept_block"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
_CONVERGED = 1e-6
"""Size of the last step, in sigmas of all unknowns together."""
_DENSE = 2500
"""Unknowns up to which a dense factor is faster than a sparse one."""
_MOST = 20_000
"""Unknowns whose covariance is kept whole: 3.2 GB."""
_COLUMNS = 256
_SINGULAR = "block: the equations are singular; a sigma is too large for what observes it"
_ROUNDS = 40
_HUBER_ROUNDS = 4
_FREE_ROUNDS = 8
_SETTLED = 1e-3


@dataclass(frozen=True, eq=False)
class BlockAdjustment:
    """Solution of a block.

    Attributes:
        assembly: the block in equations.
        x: (P,) unknowns in units of their priors' sigmas. covariance: (P, P) of them, with the factors.
        ground: (m, 3) points, ITRS, metres; NaN for those that nothing determines.
        spread: (m, 3, 3) their covariance at known x.
        weight: set -> (n,) robust weights. standard: set -> (n, d) standardised residuals.
        groups: variance group -> test.
        chi_square, degrees_of_freedom: of all observations and priors.
        reduced: the equations at the solution.
        iterations: Gauss-Newton steps in all.
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
        return float(chi2.sf(self.chi_square, self.degrees_of_freedom))

    @property
    def factors(self) -> dict[str, float]:
        """Group -> variance factor."""
        return {name: one.factor for name, one in self.groups.items()}

    @cached_property
    def _filled(self) -> Array:
        return np.where(np.isfinite(self.ground), self.ground, self.assembly.block.points.start)

    def point_covariance(self, points: Indices) -> Array:
        """(k, 3, 3) covariance of any of the block's points, ITRS, m^2; NaN where nothing determines one."""
        found = np.full((len(self.ground), 3, 3), np.nan)
        wanted = np.zeros(len(self.ground), bool)
        wanted[points] = True
        for rows in self.assembly.reduction.rows(self.x, self._filled, self.weight, self.factors):
            where = rows.bundle.points
            use = wanted[where]
            if not np.any(use):
                continue
            inner = self.spread[where[use]]
            moved = inner @ np.swapaxes(rows.by_point[use], 1, 2) @ rows.by_x[use]
            columns = rows.bundle.columns
            found[where[use]] = inner + moved @ self.covariance[np.ix_(columns, columns)] @ np.swapaxes(moved, 1, 2)
        found[~np.isfinite(self.ground).all(axis=1)] = np.nan
        return np.asarray(found[points])

    def attitude_at(self, of: str, times: Array) -> tuple[Array, Array]:
        """Correction of the attitude of a pass about the body's axes, (n, 3), radians, with covariances (n, 3, 3)."""
        columns, factors = self.assembly.corrections(of, times).factors(True)
        value = np.sum(factors * self.x[columns], axis=1)
        spread = np.empty((len(times), 3, 3))
        for i in range(3):
            for j in range(3):
                some = self.covariance[columns[:, :, i][:, :, None], columns[:, :, j][:, None, :]]
                spread[:, i, j] = np.einsum("nk,nkl,nl->n", factors[:, :, i], some, factors[:, :, j])
        return value, spread

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
            for p in one.point[weight <= _SETTLED].tolist()
        )


def kept_block(found: BlockAdjustment) -> Block:
    """The block without the packets that robust weights gave up. Rejected control points become tie points."""
    block, sets = found.assembly.block, found.assembly.reduction.sets
    keep = {one.name: weight > _SETTLED for one, weight in zip(sets, found.weight, strict=True)}
    scenes = tuple(
        replace(s, rays=s.rays.taken(keep[s.name])) if s.name in keep and not s.name.endswith(" laser") else s
        for s in block.scenes
    )
    footprints = tuple(f.taken(keep[f"{f.of} laser"]) for f in block.footprints)
    points = block.points
    role = points.role.copy()
    for one, weight in zip(sets, found.weight, strict=True):
        if one.group == "control":
            role[one.point[weight <= _SETTLED]] = "tie"
    terrain = block.terrain
    if terrain is not None:
        terrain = terrain.taken(keep["terrain"])
    footprints = tuple(f for f in footprints if len(f.point))
    return replace(block, scenes=scenes, footprints=footprints, points=replace(points, role=role), terrain=terrain)


class _Factor:
    """A factor of a positive definite matrix, whose unknowns are brought to one size first."""

    def __init__(self, matrix: sparse.csc_matrix) -> None:
        diagonal = matrix.diagonal()
        if not np.all(diagonal > 0):
            raise BlockError("block: an unknown that nothing determines")
        self.size = 1.0 / np.sqrt(diagonal)
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
        if self.count > _MOST:
            raise BlockError(f"block: {self.count} unknowns beside the points; at most {_MOST} are adjusted at once")
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


@dataclass(frozen=True, eq=False)
class _At:
    """Where an iteration stands."""

    x: Array
    ground: Array
    weight: tuple[Array, ...]
    factor: Mapping[str, float]
    steps: int


def adjust_block(
    block: Block,
    *,
    robust: Literal["huber", "reject"] | None = None,
    variance_components: bool | Collection[str] = False,
    datum: bool = False,
    iterations: int = 20,
) -> BlockAdjustment:
    """Adjust a block.

    Args:
        block: what is observed, and what is known of it.
        robust: "huber" takes weight from packets with large residuals; "reject" leaves out those that stand out from
            the others so weighed, one good packet in 10 000, and with them points of which too little is left.
        variance_components: estimate a factor on the variances of every group, or of those named.
        datum: look for a shift that all control points have in common.
        iterations: most Gauss-Newton steps of one round.

    Raises:
        BlockError: input that cannot be used, points that are not what was photographed, no convergence.
    """
    block = pruned(block)
    check_places(block)
    assembly = assembled(block, datum)
    reduction = assembly.reduction
    groups = [*(one.group for one in reduction.sets), *(one.group for one in reduction.priors)]
    weight = tuple(np.ones(len(one.point)) for one in reduction.sets)
    at = _At(np.zeros(reduction.size), block.points.start.copy(), weight, dict.fromkeys(groups, 1.0), 0)
    estimated = set(groups) if variance_components is True else set(variance_components or ())
    factors: list[Mapping[str, float]] = []
    for turn in range(_ROUNDS):
        screening = robust is not None and turn < _HUBER_ROUNDS
        # weights that will change are not worth more than a step or two
        at, reduced, factor = _solved(assembly, at, iterations, 1e-2 if screening else _CONVERGED)
        covariance = factor.inverse()
        standard, taken = _checked(assembly, at, covariance, reduced)
        tests = _tests(assembly, at, covariance, reduced, taken)
        if robust is None and not estimated:
            return _result(assembly, at, covariance, standard, tests, reduced)
        new_weight, new_factor = at.weight, dict(at.factor)
        if robust is not None:
            kind: Literal["huber", "accept"] = "accept"
            if robust == "huber" or turn < _HUBER_ROUNDS:
                kind = "huber"
            new_weight = tuple(robust_weights(one, kind) for one in standard)
            if kind == "accept" and turn >= _FREE_ROUNDS:
                new_weight = tuple(np.minimum(a, b) for a, b in zip(new_weight, at.weight, strict=True))
            new_weight = _without_lost(assembly, new_weight)
        if estimated and not screening:
            for name in estimated & set(tests):
                new_factor[name] = tests[name].estimated
            factors.append(new_factor)
        change = max(
            max(
                (float(np.abs(a - b).max(initial=0.0)) for a, b in zip(new_weight, at.weight, strict=True)), default=0.0
            ),
            max(abs(new_factor[g] / at.factor[g] - 1.0) for g in new_factor),
        )
        if change < _SETTLED and not screening:
            return _result(assembly, at, covariance, standard, tests, reduced)
        if len(factors) == 3:
            new_factor, factors = extrapolated(factors), []
        at = replace(at, weight=new_weight, factor=new_factor)
    raise BlockError(f"block: weights do not settle in {_ROUNDS} rounds, the last change is {change:.2g}")


def _solved(assembly: Assembly, at: _At, iterations: int, tolerance: float) -> tuple[_At, Reduced, _Factor]:
    """Gauss-Newton with the weights as they stand, until a step is below so many sigmas."""
    reduction = assembly.reduction
    last = np.inf
    for _ in range(iterations):
        reduced = reduction.reduced(at.x, at.ground, at.weight, at.factor)
        total = reduced.data + reduced.prior
        factor = _Factor(total)
        step = -factor.solve(reduced.right)
        moved = reduction.point_steps(at.x, at.ground, at.weight, at.factor, reduced, step)
        size = float(np.sqrt(max(float(step @ (total @ step)), 0.0)))
        # points that stay too far from where x puts them count, too
        apart = float(np.sqrt(np.max(np.einsum("ni,nij,nj->n", moved, _inverses(reduced.spread), moved), initial=0.0)))
        at = replace(at, x=at.x + step, ground=at.ground + moved, steps=at.steps + 1)
        size = max(size, apart)
        if size < tolerance or (size < 1e3 * tolerance and size > 0.5 * last):
            return at, reduction.reduced(at.x, at.ground, at.weight, at.factor), factor
        if not np.isfinite(size):
            break
        last = size
    raise BlockError(f"block: no convergence in {iterations} steps, the last of {last:.3g} sigmas")


def _inverses(spread: Array) -> Array:
    """(m, 3, 3) inverses; zero where there is none."""
    used = spread[:, 0, 0] > 0
    found = np.zeros_like(spread)
    found[used] = np.linalg.inv(spread[used])
    return found


def _without_lost(assembly: Assembly, weight: Sequence[Array]) -> tuple[Array, ...]:
    """Weights with none left at points that fewer than three rows determine."""
    rows = _rows_left(assembly, weight)
    lost = rows < 3
    return tuple(np.where(lost[one.point], 0.0, w) for one, w in zip(assembly.reduction.sets, weight, strict=True))


def _rows_left(assembly: Assembly, weight: Sequence[Array]) -> NDArray[np.intp]:
    """(m,) rows with any weight at each point."""
    rows = np.zeros(assembly.reduction.count, np.intp)
    for one, w in zip(assembly.reduction.sets, weight, strict=True):
        np.add.at(rows, one.point, one.rows * (w > _SETTLED))
    return rows


def _checked(
    assembly: Assembly, at: _At, covariance: Array, reduced: Reduced
) -> tuple[tuple[Array, ...], dict[str, float]]:
    """Standardised residuals of all sets, and group -> what the adjustment took of its observations (count less
    redundancy).
    """
    sets = assembly.reduction.sets
    standard = [np.zeros((len(one.point), one.rows)) for one in sets]
    taken = dict.fromkeys((one.group for one in sets), 0.0)
    for rows in assembly.reduction.rows(at.x, at.ground, at.weight, at.factor, weighted=False):
        columns, where = rows.bundle.columns, rows.bundle.points
        weights = np.concatenate(
            [
                np.repeat((at.weight[k][w] / at.factor[sets[k].group])[:, None], sets[k].rows, axis=1)
                for k, w in rows.bundle.members
            ],
            axis=1,
        )
        inner = reduced.spread[where]
        moved = inner @ np.swapaxes(rows.by_point * weights[:, :, None], 1, 2) @ rows.by_x
        through = rows.by_x - rows.by_point @ moved
        shared = covariance[np.ix_(columns, columns)]
        d = 0
        for k, which in rows.bundle.members:
            depth = sets[k].rows
            part, by_point = through[:, d : d + depth], rows.by_point[:, d : d + depth]
            cofactor = part @ shared @ np.swapaxes(part, 1, 2) + by_point @ inner @ np.swapaxes(by_point, 1, 2)
            weight, unit = at.weight[k][which], at.factor[sets[k].group]
            standard[k][which] = standardised_packets(rows.miss[:, d : d + depth], cofactor, weight, unit)
            taken[sets[k].group] += float(np.sum(weight * np.trace(cofactor, axis1=1, axis2=2)) / unit)
            d += depth
    return tuple(standard), taken


def _tests(
    assembly: Assembly, at: _At, covariance: Array, reduced: Reduced, taken: Mapping[str, float]
) -> dict[str, GroupTest]:
    reduction = assembly.reduction
    counts: dict[str, int] = {}
    for one, weight in zip(reduction.sets, at.weight, strict=True):
        counts[one.group] = counts.get(one.group, 0) + one.rows * int(np.sum(weight > _SETTLED))
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


def _result(
    assembly: Assembly,
    at: _At,
    covariance: Array,
    standard: tuple[Array, ...],
    tests: Mapping[str, GroupTest],
    reduced: Reduced,
) -> BlockAdjustment:
    rows = _rows_left(assembly, at.weight)
    known = rows >= 3
    ranks = group_ranks(assembly.reduction.priors)
    freedom = int(rows.sum()) - 3 * int(known.sum()) + sum(ranks.values()) - assembly.reduction.size
    return BlockAdjustment(
        assembly=assembly,
        x=at.x,
        covariance=covariance,
        ground=np.where(known[:, None], at.ground, np.nan),
        spread=reduced.spread,
        weight=at.weight,
        standard=standard,
        groups=tests,
        chi_square=sum(one.square for one in tests.values()),
        degrees_of_freedom=freedom,
        reduced=reduced,
        iterations=at.steps,
    )
