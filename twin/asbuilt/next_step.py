"""Next actuator move of an instrument: expected merits under the posterior, and the benefit of more measurements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from analysis.instrument_state.state_estimate import NextMove, StateEstimate, best_move, merit_reduction
from twin.asbuilt.asbuilt_bench import AsBuiltBench, nan_where_lost, selected_moves

MOST_ROUNDS = 3
"""Largest number of iterations of the optimum move, each linearised about the state that the last one leads to."""


@dataclass(frozen=True, eq=False)
class Advice:
    """Recommended next move of the actuators and its expected benefit.

    Attributes
    ----------
    move : NextMove
        Move of the actuators.
    before, after : float
        Expected merit without and with the move: the posterior mean of the sum of squares of all merits in units of
        their requirements, by exact traces.
    ignorance : float
        Part of the expected merit that is due to the uncertain state and that a move could correct if the state were
        known.
    worth : dict
        Name of a possible measurement -> expected reduction of the merit after the move, if the measurement is made
        before it.
    """

    move: NextMove
    before: float
    after: float
    uncertainty: float
    merit_reductions: dict[str, float]


def optimal_move(bench: AsBuiltBench, mean: np.ndarray, after: str | None) -> NextMove:
    """Return the actuator move with the smallest expected merit, linearised about the state to which it leads.

    The merit is the sum of squares of all merits in units of their requirements.

    Parameters
    ----------
    bench : AsBuiltBench
        Instrument under estimation, with its actuators and merits.
    mean : (K,) ndarray
        K estimated parameters.
    after : str, optional
        Name of the last move that was made.

    Raises
    ------
    PhysicalError
        The light of the estimated state is lost.
    """
    actuators = bench.actuators
    amounts = np.zeros(len(actuators.names))
    move = None
    for _ in range(MOST_ROUNDS):
        residual, slope = _about(bench, mean, after, amounts)
        # the merit without a move, extrapolated linearly from the state after the last one
        move = best_move(residual - slope @ amounts, slope, actuators)
        if np.array_equal(move.amounts, amounts):
            break
        amounts = move.amounts
    assert move is not None
    return move


def _about(
    bench: AsBuiltBench, mean: np.ndarray, after: str | None, amounts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the merits' residuals after a move, (R,), and their derivatives with respect to C actuators, (R, C).

    The squares of the R residuals sum to the merits in units of their requirements; the derivatives are per SI unit of
    travel.
    """
    count = len(amounts)
    steps = np.diag(bench.actuator_steps)
    moves = np.concatenate([amounts[None], amounts + steps, amounts - steps])
    residuals = bench.merit_residuals(np.repeat(mean[None], len(moves), axis=0), after, moves)
    return residuals[0], ((residuals[1 : 1 + count] - residuals[1 + count :]) / (2.0 * bench.actuator_steps[:, None])).T


def advice(bench: AsBuiltBench, estimate: StateEstimate, draws: np.ndarray, rng: np.random.Generator) -> Advice:
    """Return the next move, its effect over the posterior, and the expected benefit of measurements before it.

    Parameters
    ----------
    bench : AsBuiltBench
        Instrument under estimation, with its actuators and merits.
    estimate : StateEstimate
        Estimated state.
    draws : (S, K) ndarray
        K parameters of S random states drawn from the posterior.
    rng : Generator
        Random generator of the errors of the move.

    Raises
    ------
    PhysicalError
        The light of the estimated state is lost.
    """
    after = bench.last
    move = optimal_move(bench, estimate.mean, after)
    executed = bench.actuators.made(move.amounts, rng.standard_normal((len(draws), 2, len(move.amounts))))
    # states without light are reported in a warning and have no merit
    merits = [float(np.nanmean(expected(bench, draws, after, further))) for further in (None, executed)]
    _, by_actuators = _about(bench, estimate.mean, after, np.zeros(len(move.amounts)))
    unit_slope = bench.merit_slope(estimate.mean, after) @ estimate.prior.root
    candidates: dict[str, np.ndarray] = {}
    for kind in bench.candidates:
        rows = bench.slope(estimate.mean, [kind], [after])
        white = kind.group(np.zeros(len(kind.labels))).whitener()
        candidates[kind.name] = white @ rows @ estimate.prior.root
    everything: dict[str, np.ndarray] = {"": np.asarray(np.linalg.pinv(estimate.root) * 1e6)}
    reductions = merit_reduction(estimate.root, unit_slope, bench.actuators, by_actuators, {**candidates, **everything})
    uncertainty = reductions.pop("")
    return Advice(move, merits[0], merits[1], uncertainty, reductions)


def expected(
    bench: AsBuiltBench, values: np.ndarray, after: str | None, further: np.ndarray | None = None
) -> np.ndarray:
    """Return the total merit of each of S states, (S,).

    It is the sum of squares of all merits in units of their requirements.

    It is NaN where the light is lost.
    """
    return nan_where_lost(
        lambda rows: np.sum(bench.merit_residuals(values[rows], after, selected_moves(further, rows)) ** 2, axis=1),
        len(values),
        (),
    )
