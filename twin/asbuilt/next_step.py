"""The next move of an instrument and its worth: expected merits under the posterior, and simulated alignments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.instrument_state.next_move import NextMove, best_move, measurement_worth, truncated_move
from analysis.instrument_state.state_estimate import StateEstimate
from twin.asbuilt.asbuilt_bench import AsBuiltBench, of_some, where_lit

MOST_ROUNDS = 3
"""Times that a move is sought about the state that the last one leads to."""


@dataclass(frozen=True, eq=False)
class Advice:
    """What to do next.

    Attributes:
        move: of the actuators.
        before, after: expected merit without a move and after it: the mean over the posterior of the sum of squares of
            all merits in units of their requirements, by exact traces.
        ignorance: the part of it that is due to what is not known of the state and could be mended if it were.
        worth: name of a measurement that could be made -> by how much it is expected to lower the merit after the move
            that follows from it.
    """

    move: NextMove
    before: float
    after: float
    ignorance: float
    worth: dict[str, float]


def wanted_move(bench: AsBuiltBench, mean: np.ndarray, after: str | None) -> NextMove:
    """The move that makes the expected merit least, about where it leads to.

    Args:
        bench: with actuators.
        mean: parameters as estimated, (K,).
        after: name of the last move that was made.

    Raises:
        PhysicalError: the light of the estimated state is lost.
    """
    actuators = bench.actuators
    amounts = np.zeros(len(actuators.names))
    found = None
    for _ in range(MOST_ROUNDS):
        residual, slope = _about(bench, mean, after, amounts)
        # the merit at no move, as it looks from where the last search led to
        found = best_move(residual - slope @ amounts, slope, actuators)
        if np.array_equal(found.amounts, amounts):
            break
        amounts = found.amounts
    assert found is not None
    return found


def _about(
    bench: AsBuiltBench, mean: np.ndarray, after: str | None, amounts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the merit (R,) after a move, and their derivatives by the actuators (R, C)."""
    count = len(amounts)
    steps = np.diag(bench.actuator_steps)
    moves = np.concatenate([amounts[None], amounts + steps, amounts - steps])
    found = bench.merit_numbers(np.repeat(mean[None], len(moves), axis=0), after, moves)
    return found[0], ((found[1 : 1 + count] - found[1 + count :]) / (2.0 * bench.actuator_steps[:, None])).T


def advice(bench: AsBuiltBench, found: StateEstimate, draws: np.ndarray, rng: np.random.Generator) -> Advice:
    """The next move, its effect over the posterior, and what measurements would be worth before it.

    Args:
        bench: with actuators.
        found: the state.
        draws: states of the posterior, (S, K).
        rng: source of the errors of the move.

    Raises:
        PhysicalError: the light of the estimated state is lost.
    """
    after = bench.last
    move = wanted_move(bench, found.mean, after)
    made = bench.actuators.made(move.amounts, rng.standard_normal((len(draws), 2, len(move.amounts))))
    # states without light are told by themselves, and have no merit
    both = [float(np.nanmean(expected(bench, draws, after, own))) for own in (None, made)]
    _, by_actuators = _about(bench, found.mean, after, np.zeros(len(move.amounts)))
    unit_slope = bench.merit_slope(found.mean, after) @ found.prior.root
    candidates: dict[str, np.ndarray] = {}
    for kind in bench.candidates:
        rows = bench.slope(found.mean, [kind], [after])
        white = kind.group(np.zeros(len(kind.labels))).whitener()
        candidates[kind.name] = white @ rows @ found.prior.root
    everything: dict[str, np.ndarray] = {"": np.asarray(np.linalg.pinv(found.root) * 1e6)}
    worth = measurement_worth(found.root, unit_slope, bench.actuators, by_actuators, {**candidates, **everything})
    ignorance = worth.pop("")
    return Advice(move, both[0], both[1], ignorance, worth)


def expected(
    bench: AsBuiltBench, values: np.ndarray, after: str | None, further: np.ndarray | None = None
) -> np.ndarray:
    """Merits of states (S,), the sum of squares in units of the requirements; NaN where the light is lost."""
    return where_lit(
        lambda some: np.sum(bench.merit_numbers(values[some], after, of_some(further, some)) ** 2, axis=1),
        len(values),
        (),
    )


@dataclass(frozen=True, eq=False)
class Alignment:
    """A drawn instrument that was measured and moved several times.

    Attributes:
        merits: true merit before the first move and after each, (J + 1,).
        perfect: true merit that perfect knowledge of the state before each move reaches in as many moves, with the
            same ranges, steps and errors.
        classic: true merit after each move by the truncated pseudo-inverse on the same instrument, (J + 1,).
        estimates: the states as estimated before each move.
    """

    merits: np.ndarray
    perfect: float
    classic: np.ndarray
    estimates: tuple[StateEstimate, ...]


def align(
    bench: AsBuiltBench,
    true: np.ndarray,
    moves: int,
    rng: np.random.Generator,
    again: Sequence[str],
    kept: int | None = None,
) -> Alignment:
    """Measure, estimate and move a drawn instrument.

    Args:
        bench: before the first move.
        true: parameters of the instrument, (K,).
        moves: how often it is moved.
        rng: source of all errors.
        again: measurements that are made again after each move.
        kept: singular values of the classic move beside it; None for none.

    Raises:
        PhysicalError: the light is lost.
    """
    errors = rng.standard_normal((moves, 2, len(bench.actuators.names)))
    own, state = bench, true
    data = list(bench.measured(true, rng))
    merits = [float(expected(bench, true[None], None)[0])]
    estimates = []
    start = None
    for number in range(moves):
        found = own.estimate(data, start)
        estimates.append(found)
        move = wanted_move(own, found.mean, own.last)
        own, state = _made(own, state, move, f"move{number + 1}", errors[number], again)
        start = np.concatenate([found.mean, np.zeros(len(state) - len(found.mean))])
        merits.append(float(expected(own, state[None], own.last)[0]))
        view = own.view(state[None], own.last)
        data += [kind.drawn(kind.predict(view)[0], rng) for kind in own.kinds[len(data) :]]
    knowing, known = bench, true
    for number in range(moves):
        move = wanted_move(knowing, known, knowing.last)
        knowing, known = _made(knowing, known, move, f"move{number + 1}", errors[number], ())
    perfect = float(expected(knowing, known[None], knowing.last)[0])
    classic = np.array([]) if kept is None else _classic(bench, true, errors, rng, kept)
    return Alignment(np.array(merits), perfect, classic, tuple(estimates))


def _made(
    bench: AsBuiltBench, state: np.ndarray, move: NextMove, name: str, errors: np.ndarray, again: Sequence[str]
) -> tuple[AsBuiltBench, np.ndarray]:
    """The bench after a move, and the parameters of the instrument with the errors that were made."""
    made = bench.actuators.made(move.amounts, errors)
    moved = move.amounts != 0.0
    return bench.after_move(name, move.amounts, again), np.concatenate([state, (made - move.amounts)[moved]])


def _classic(
    bench: AsBuiltBench, true: np.ndarray, errors: np.ndarray, rng: np.random.Generator, kept: int
) -> np.ndarray:
    """True merits of an instrument moved by the truncated pseudo-inverse of its measured numbers."""
    total = np.zeros(len(bench.actuators.names))
    merits = [float(expected(bench, true[None], None)[0])]
    steps = np.diag(bench.actuator_steps)
    nominal = np.repeat(np.zeros_like(true)[None], 2 * len(steps), axis=0)
    view = bench.view(nominal, None, np.concatenate([steps, -steps]))
    whiteners = [kind.group(np.zeros(len(kind.labels))).whitener() for kind in bench.kinds]
    moved = np.concatenate(
        [kind.predict(view) @ white.T for kind, white in zip(bench.kinds, whiteners, strict=True)], axis=1
    )
    count = len(steps)
    slope = ((moved[:count] - moved[count:]) / (2.0 * bench.actuator_steps[:, None])).T
    zero = bench.view(np.zeros_like(true)[None], None)
    for own in errors:
        now = bench.view(true[None], None, total)
        off = np.concatenate(
            [
                white @ (kind.drawn(kind.predict(now)[0], rng) - kind.predict(zero)[0])
                for kind, white in zip(bench.kinds, whiteners, strict=True)
            ]
        )
        left = replace(
            bench.actuators, low=bench.actuators.low - total, high=np.maximum(bench.actuators.high - total, 0.0)
        )
        wanted = truncated_move(off, slope, left, kept)
        total = total + bench.actuators.made(wanted, own)
        merits.append(float(expected(bench, true[None], None, total)[0]))
    return np.array(merits)
