"""Adjustment of the measured attitude and station within one pass, without ground control (paper 003's check flow).

Points that several lines see (tie points, with the check points among them) tie the attitudes of different exposures
together: rays that do not meet show errors of the attitude. Unknowns are the errors of the readings, with their given
sigmas as priors, and the points; cameras and attitude bias come from a calibration.

What no tie point can tell is the datum. With lines that look forward and backward by a, which see a place T seconds
before and after the nadir line, all rays still meet when

- the whole pass rolls: the scene shifts with it;
- it rolls at a constant rate and is yawed by rate * T / tan a: the scene turns with it;
- roll repeats itself with the period T: all three lines see a place with one roll.

Pitch shifts nadir rays by tan^2 a (0.22 at 25 deg) less than outer ones, so it is told that weakly. What all rays of a
place have in common thus keeps its prior error: the priors alone close it, and `StripAdjustment.datum` says how much
the ties added. It also bounds the gain. Forward intersection takes the mean over three exposures anyway, and noise that
is independent from one reading to the next has its largest part in this mean: ties hardly reduce it. Errors that last
for many readings and change within the pass are reduced a lot.

Stepwise solution of a three-line calibration, as paper 003 does it: attitude bias with the interior fixed, then the
interior with the bias fixed, iterated.

It walks down the same sum of squares as the simultaneous adjustment, one block of unknowns at a time, and each round
leaves the fraction rho^2 of the error, with rho the largest correlation between a combination of one block and a
combination of the other (block Gauss-Seidel). It needs no gauge, because each block alone is determined; a combination
of both that the points leave open then keeps whatever the start values and the order of the steps made of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.linalg import splu

from analysis import statistics
from analysis.arrays import Array
from analysis.block.error_processes import Corrections
from analysis.calibration.normal_equations import Equations, SharedNoise, State, Weights, assemble
from analysis.orbit.calibration_parameters import (
    CalibrationError,
    CalibrationField,
    Noise,
    Parameters,
    Prior,
    Unknowns,
    free_basis,
    solved,
)
from analysis.orbit.forward_intersection import intersect
from analysis.orbit.three_line_model import BIAS, LineModel, Rays, bias_rotation

_NAME = "strip"
_STEPS = 10
_CONVERGED = 1e-6  # metres, as in forward intersection


@dataclass(frozen=True)
class Datum:
    """Sigma of a turn that the whole pass has in common, before and after the adjustment.

    name: "roll", "pitch", "yaw" (radians, at the middle of the pass) or "roll rate" and so on (rad/s).
    """

    name: str
    before: float
    after: float


@dataclass(frozen=True, eq=False)
class StripAdjustment:
    """Solution of a pass.

    Attributes
    ----------
    ground : Array
        (m, 3) points, ITRS, metres; NaN where fewer than two rays see one.
    covariance : Array
        (m, 3, 3), with the errors of attitude and station that are left.
    datum : tuple[Datum, ...]
        Common turns and their rates, from all rays.
    chi_square, degrees_of_freedom : float
        Of the rays that meet others, and of the readings' corrections.
    """

    ground: Array
    covariance: Array
    datum: tuple[Datum, ...]
    chi_square: float
    degrees_of_freedom: int
    _shared: SharedNoise = field(repr=False)
    _values: Array = field(repr=False)
    _turn: Array = field(repr=False)

    @property
    def p_value(self) -> float:
        """Chance of such a chi-square or a larger one, if the sigmas are right."""
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)

    def corrected(self, rays: Rays) -> Rays:
        """Any rays of the pass, with times, with corrected attitude and station.

        Raises
        ------
        CalibrationError
            No times.
        """
        if rays.time is None:
            raise CalibrationError("strip adjustment: these rays have no times")
        found = self._shared.corrected_at(_NAME, replace(rays, attitude=rays.attitude @ self._turn), self._values)
        return replace(found, attitude=found.attitude @ self._turn.T)


def adjust_strip(
    rays: Mapping[str, Rays], cameras: Mapping[str, LineModel], noise: Noise, *, bias: ArrayLike = (0.0, 0.0, 0.0)
) -> StripAdjustment:
    """Adjust one pass on its tie points.

    Time goes with the number of points, memory with the square of that of readings near rays: 800 readings of the
    attitude take 50 MB.

    Parameters
    ----------
    rays : Mapping[str, Rays]
        Line -> its image points, with times.
    cameras : Mapping[str, LineModel]
        Line -> calibrated camera, in its state during this pass.
    noise : Noise
        Of image, attitude and station, with at least one interval.
    bias : ArrayLike
        (3,) calibrated roll, pitch, yaw, radians.

    Raises
    ------
    CalibrationError
        Rays without times or a noise without intervals, no point with two rays, no convergence.
    """
    noise.check()
    if any(r.time is None for r in rays.values()) or all(t.interval is None for t in noise.terms):
        raise CalibrationError("strip adjustment: needs the times of all rays and the intervals of the readings")
    first = intersect(rays, cameras, noise, bias=bias)
    good = np.flatnonzero(first.rays >= 2)
    place = np.full(len(first.rays), -1)
    place[good] = np.arange(len(good))
    turn, kept = bias_rotation(bias), {}
    for line, row in rays.items():
        some = row.taken(place[row.point] >= 0)
        if some.point.size:
            kept[line] = replace(some, point=place[some.point], attitude=some.attitude @ turn)
    size = len(good)
    one = CalibrationField(_NAME, kept, first.ground[good], np.zeros((size, 3, 3)), np.zeros(size, bool))
    shared = SharedNoise.of([one], noise)
    state, equations = _solved(one, cameras, noise, shared)
    ground, covariance = np.full((len(place), 3), np.nan), np.full((len(place), 3, 3), np.nan)
    ground[good], covariance[good] = state.grounds[0], equations.point_covariance(np.zeros((0, 0)))
    left = equations.residuals
    return StripAdjustment(
        ground=ground,
        covariance=covariance,
        datum=_datum(kept, shared, equations.shared_inverse[0]),
        chi_square=float(np.sum(left.image**2)) + sum(left.shared.values()),
        degrees_of_freedom=left.image.size - 3 * size,
        _shared=shared,
        _values=state.shared,
        _turn=turn,
    )


def _solved(
    one: CalibrationField, cameras: Mapping[str, LineModel], noise: Noise, shared: SharedNoise
) -> tuple[State, Equations]:
    """Readings and points."""
    held = (np.array([-1]),) * 5
    parameters = Parameters((), np.zeros(0), np.zeros(0), {(_NAME, k): held for k in one.rays})
    state = State(np.zeros(0), (one.ground,), np.zeros(shared.size))
    factor = dict.fromkeys(("image", "control", *shared.groups), 1.0)
    weights = Weights(np.ones(sum(len(r.point) for r in one.rays.values())), factor)
    equations = assemble([one], cameras, parameters, state, noise, (), weights, shared)
    for _ in range(_STEPS):
        before, state = state, state.moved(equations, np.zeros(0))
        equations = assemble([one], cameras, parameters, state, noise, (), weights, shared)
        step = float(np.abs(state.grounds[0] - before.grounds[0]).max())
        if step < _CONVERGED:
            return state, equations
    raise CalibrationError(f"strip adjustment: no convergence, the last step is {step:.3g} m")


def _datum(rays: Mapping[str, Rays], shared: SharedNoise, inverse: Array) -> tuple[Datum, ...]:
    """Constant and slope of the attitude's errors over all rays, by least squares."""
    if not any(part.turns for part in shared.parts[_NAME]):
        return ()
    time = np.concatenate([r.time for r in rays.values() if r.time is not None])
    fit = np.linalg.pinv(np.column_stack([np.ones_like(time), time - time.mean()]))
    columns, factors = Corrections(shared.parts[_NAME], np.eye(3), time).factors(True)
    form = np.zeros((6, shared.size))
    for k in range(6):  # roll, pitch, yaw, then their rates
        np.add.at(form[k], columns[:, :, k % 3], fit[k // 3][:, None] * factors[:, :, k % 3])
    before = np.einsum("ks,sk->k", form, splu(shared.precision.tocsc()).solve(form.T))
    after = np.einsum("ks,st,kt->k", form, inverse, form, optimize=True)
    names = (*BIAS, *(f"{n} rate" for n in BIAS))
    return tuple(Datum(n, float(b), float(a)) for n, b, a in zip(names, np.sqrt(before), np.sqrt(after), strict=True))


# A combination of both blocks that keeps more than this of its error in a round is open: it needs a million rounds.
_OPEN = 1.0 - 1e-6
_RELINEARISED = 3


@dataclass(frozen=True, eq=False)
class Stepwise:
    """Solution of the stepwise iteration.

    Attributes
    ----------
    names : tuple[str, ...]
        Of the unknowns. values: (P,) at the end.
    converged : bool
        Whether the steps fell below the tolerance. steps: (rounds,) largest change of any unknown in each round, in
        conditional sigmas.
    rate : float
        Fraction of the slowest error that a round leaves by theory, open combinations apart.
    """

    names: tuple[str, ...]
    values: Array
    converged: bool
    steps: Array
    rate: float

    @property
    def rounds(self) -> int:
        """Number of rounds."""
        return len(self.steps)


def stepwise(
    fields: Sequence[CalibrationField],
    cameras: Mapping[str, LineModel],
    noise: Noise,
    *,
    unknowns: Unknowns | None = None,
    start: Mapping[str, float] | None = None,
    priors: Sequence[Prior] = (),
    held: Sequence[str] = (),
    tolerance: float = 1e-3,
    rounds: int = 100_000,
) -> Stepwise:
    """Alternate until both steps are below `tolerance` of their conditional sigmas.

    held: unknowns that keep their start values. rounds: at most. The error that is left is about the last step times
    rate / (1 - rate). The first rounds are linearised anew, later ones only after all steps have become small.

    Raises
    ------
    RankError
        a block that is open on its own.
    CalibrationError
        Only one block is to be solved for; other bad input.
    """
    parameters = Parameters.of(fields, cameras, unknowns or Unknowns(), start)
    names, scale = parameters.names, parameters.scale
    inside = {n for f in fields for line in f.rays for n in np.array(names)[_used(parameters, f.name, line)]}
    free = np.array([n not in held for n in names])
    blocks = [np.flatnonzero(free & np.array([(n in inside) == which for n in names])) for which in (False, True)]
    if not all(len(b) for b in blocks):
        raise CalibrationError("stepwise calibration: needs unknowns of the attitude and of the interior")
    weights = Weights(np.ones(sum(len(r.point) for f in fields for r in f.rays.values())), {"image": 1.0})
    noise.check()
    common = SharedNoise.of(fields, noise)
    state = State(parameters.start, tuple(f.ground for f in fields), np.zeros(common.size))
    equations = assemble(fields, cameras, parameters, state, noise, priors, weights, common)
    sigma = np.zeros(len(names))
    for b in blocks:
        normal = equations.reduced[np.ix_(b, b)]
        free_basis(normal, equations.length[b], scale[b], [names[i] for i in b.tolist()], None)
        sigma[b] = np.sqrt(np.diag(solved(normal, np.eye(len(b)))))
    sizes: list[float] = []
    converged = False
    while not converged and len(sizes) < rounds:
        most = 1 if len(sizes) < _RELINEARISED else rounds - len(sizes)
        step, taken = _alternate(equations.reduced, equations.right, blocks, sigma, tolerance, most)
        sizes += taken
        state = state.moved(equations, step)
        equations = assemble(fields, cameras, parameters, state, noise, priors, weights, common)
        converged = len(taken) == 1 and taken[0] < tolerance
    shared = _canonical_squares(equations.reduced, *blocks)
    return Stepwise(
        names=names,
        values=state.values,
        converged=converged,
        steps=np.array(sizes),
        rate=float(np.max(shared[shared < _OPEN], initial=0.0)),
    )


def _used(parameters: Parameters, name: str, line: str) -> Array:
    inner = parameters.columns[name, line][0]
    return inner[inner >= 0]


def _alternate(
    normal: Array, right: Array, blocks: Sequence[NDArray[np.intp]], sigma: Array, tolerance: float, most: int
) -> tuple[Array, list[float]]:
    """Rounds on linear equations until one is below the tolerance: total step (P,), largest step of each round."""
    inverses = [solved(normal[np.ix_(b, b)], np.eye(len(b))) for b in blocks]
    total, gradient = np.zeros(len(normal)), right.copy()
    sizes: list[float] = []
    while len(sizes) < most:
        size = 0.0
        for block, inverse in zip(blocks, inverses, strict=True):
            step = -inverse @ gradient[block]
            gradient += normal[:, block] @ step
            total[block] += step
            size = max(size, float(np.max(np.abs(step) / sigma[block])))
        sizes.append(size)
        if size < tolerance:
            break
    return total, sizes


def _canonical_squares(normal: Array, first: NDArray[np.intp], second: NDArray[np.intp]) -> Array:
    """Squares of the canonical correlations of two blocks of a normal matrix."""
    roots = [np.linalg.cholesky(normal[np.ix_(b, b)]) for b in (first, second)]
    mixed = np.linalg.solve(roots[0], np.linalg.solve(roots[1], normal[np.ix_(second, first)]).T)
    return np.asarray(np.linalg.svd(mixed, compute_uv=False) ** 2)
