"""Stepwise solution of a three-line calibration, as paper 003 does it: attitude bias with the interior fixed, then the
interior with the bias fixed, iterated.

It walks down the same sum of squares as the simultaneous adjustment, one block of unknowns at a time, and each round
leaves the fraction rho^2 of the error, with rho the largest correlation between a combination of one block and a
combination of the other (block Gauss-Seidel). It needs no gauge, because each block alone is determined; a combination
of both that the points leave open then keeps whatever the start values and the order of the steps made of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array
from analysis.calibration.normal_equations import SharedNoise, State, Weights, assemble
from analysis.orbit.calibration_parameters import CalibrationError, CalibrationField, Noise, Parameters, Prior, Unknowns
from analysis.orbit.null_space import free_basis, solved
from analysis.orbit.three_line_model import LineModel

# A combination of both blocks that keeps more than this of its error in a round is open: it needs a million rounds.
_OPEN = 1.0 - 1e-6
_RELINEARISED = 3


@dataclass(frozen=True, eq=False)
class Stepwise:
    """Solution of the stepwise iteration.

    Attributes:
        names: of the unknowns. values: (P,) at the end.
        converged: whether the steps fell below the tolerance. steps: (rounds,) largest change of any unknown in each
            round, in conditional sigmas.
        rate: fraction of the slowest error that a round leaves by theory, open combinations apart.
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

    Raises:
        RankError: a block that is open on its own.
        CalibrationError: only one block is to be solved for; other bad input.
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
