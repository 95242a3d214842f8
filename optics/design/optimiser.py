"""Optimises a mirror prescription by least squares with exact Jacobians, under constraints.

Constraints are linearised at every step and held exactly (``optics.numerics.constrained_least_squares``), so that no
penalty stands between the image errors and the constraints. A much shorter envelope is reached in steps, each from the
one before. What comes out is a local optimum: ``optics.design.optimiser`` tries several.

Several starts of a design: what least squares reach from one start is a local optimum, and another may be better.

The first start is the prescription itself with the envelope shortened in steps, the second the same with it shortened
at once; others are drawn at random about it, in turn in steps and at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import nnls

from optics.design.design_variables import BIAS, Prescription, Variable
from optics.design.merit_function import Beams, Evaluation, MeritFunction, Operands
from optics.numerics.array_math import PhysicalError
from optics.numerics.backend import Backend
from optics.numerics.constrained_least_squares import Sample, constrained_least_squares
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError

ON_THE_WAY = 4
"""Iterations at each step of the envelope before the last: enough to stay near the best of that length."""
ITERATIONS = 400
"""At most, at the last step."""
SETTLED = 1e-6
"""Share of the mean square error that an iteration has to be worth."""
HELD = 2e-6
"""Violation, metres, below which a constraint counts as held."""
LEAST_GAIN = 1e-3
"""Share by which the rms error has to fall for a prescription to count as improved: where least squares ends."""

Advance = Callable[[int, int], None]


class DesignError(PhysicalError, ValueError):
    """The constraints cannot be held together, or the start does not pass light.

    Attributes
    ----------
    violated
        Kinds of the constraints that are not held; the one that is broken by the largest share of what it asks for
        first.
    """

    def __init__(self, problem: str, violated: tuple[str, ...] = ()) -> None:
        super().__init__(problem)
        self.violated = violated


@dataclass(frozen=True)
class Held:
    """A constraint at which an optimised prescription stands.

    Attributes
    ----------
    name : str
        What it is about.
    limit : float
        What it asks for, metres; of the anamorphism, a share of f.
    start : float
        By how much the start broke it, metres; negative for room that the start had.
    worth : float
        By how much the rms error over the fields would fall per metre that the limit is eased, waves/m, from the
        constraint's Lagrange multiplier.
    """

    name: str
    limit: float
    start: float
    worth: float


@dataclass(frozen=True, eq=False)
class Design:
    """An optimised prescription.

    Attributes
    ----------
    begun : Prescription
        What it is compared with.
    prescription : Prescription
        What came out.
    before, after : Evaluation
        Judgements of both.
    variables : tuple[Variable, ...]
        What was varied.
    merit : MeritFunction
        Evaluated both; it names the passages.
    evaluations : int
        Traces with derivatives that it took.
    converged : bool
        Whether the search ended because nothing near is better.
    held : tuple[Held, ...]
        The constraints that keep it from being better, the dearest first.
    """

    begun: Prescription
    prescription: Prescription
    before: Evaluation
    after: Evaluation
    variables: tuple[Variable, ...]
    merit: MeritFunction
    evaluations: int
    converged: bool = True
    held: tuple[Held, ...] = ()

    @property
    def improved(self) -> bool:
        """Whether the rms error over the fields has fallen, by a thousandth at least."""
        return rms_error(self.after) < (1.0 - LEAST_GAIN) * rms_error(self.before)


def _violations(
    operands: Operands, along: Any, across: Any, extents: np.ndarray, clearances: np.ndarray, share: float = 1.0
) -> np.ndarray:
    """Violations (C,), metres, positive when violated (the first, of the principal distance, in both directions).

    Parameters
    ----------
    operands : Operands
        What is asked for.
    along : Any
        Principal distance, metres.
    across : Any
        The same across the line, metres.
    extents : np.ndarray
        (E,), metres.
    clearances : np.ndarray
        (P,), metres.
    share : float
        Of the limits. With 0 and derivatives in place of the numbers, variables last, it gives those of the violations,
        (C, V).
    """
    out: list[Any] = []
    if operands.principal_distance is not None:
        out.append(along - share * operands.principal_distance)
    if operands.anamorphism is not None:
        out += [along - (1.0 + operands.anamorphism) * across, (1.0 - operands.anamorphism) * across - along]
    if operands.envelope is not None:
        # one constraint for each pair of surfaces: their largest alone would have a kink wherever two pairs are equal
        out += list(extents - share * operands.envelope)
    if operands.clearance is not None:
        out += list(share * operands.clearance - clearances)
    return np.array(out)


def _values(evaluation: Evaluation, operands: Operands) -> np.ndarray:
    """Violations of an evaluation, (C,)."""
    e = evaluation
    return _violations(operands, e.principal_distance, e.distance_across, e.extents, e.clearances)


def _slopes(evaluation: Evaluation, operands: Operands) -> np.ndarray:
    """Derivatives of the violations, (V, C)."""
    e = evaluation
    assert e.d_residuals is not None
    assert e.d_extents is not None
    assert e.d_clearances is not None
    found = _violations(operands, e.d_principal_distance, e.d_distance_across, e.d_extents.T, e.d_clearances.T, 0.0)
    return np.ascontiguousarray(found.reshape(-1, len(e.d_residuals)).T)


def _asked(evaluation: Evaluation, operands: Operands) -> list[tuple[str, float]]:
    """What each constraint is about, and what it asks for: metres, of the anamorphism a share of f."""
    asked = (
        ("principal distance", operands.principal_distance, 1),
        ("anamorphism", operands.anamorphism, 2),
        ("envelope", operands.envelope, len(evaluation.extents)),
        ("clearance", operands.clearance, len(evaluation.clearances)),
    )
    return [(kind, limit) for kind, limit, count in asked if limit is not None for _ in range(count)]


def _equations(operands: Operands, count: int) -> np.ndarray:
    """Which of C constraints are equations, (C,)."""
    return (operands.principal_distance is not None) & (np.arange(count) == 0)


def judged(
    backend: Backend, start: Prescription, variables: Sequence[Variable], beams: Beams, operands: Operands
) -> tuple[MeritFunction, Evaluation]:
    """The merit function of a design that begins at a prescription, and that prescription's evaluation.

    Raises
    ------
    DesignError
        The start passes no light or breaks a bound.
    """
    for variable, value in zip(variables, start.values(variables), strict=True):
        if not variable.low <= value <= variable.high:
            raise DesignError(f"{variable.name} starts at {value:.6g}, outside its bounds")
    try:
        merit = MeritFunction.of(backend, start, beams, operands)
        return merit, merit.evaluate(start)
    except (AimError, BeamMissedError) as error:
        raise DesignError(f"the prescription that the design starts from passes no light: {error}") from error


def descend(
    merit: MeritFunction,
    begun: Prescription,
    before: Evaluation,
    start: Prescription,
    variables: Sequence[Variable],
    steps: int = 1,
    iterations: int = ITERATIONS,
    advance: Advance | None = None,
) -> Design:
    """The local optimum that is reached from a start, which need not be what ``merit`` took the passages from.

    Parameters
    ----------
    merit : MeritFunction
        With the constraints.
    begun : Prescription
        What the result is compared with.
    before : Evaluation
        Its evaluation.
    start : Prescription
        Where to begin; it passes all light and keeps the bounds.
    variables : Sequence[Variable]
        What may vary.
    steps : int
        Of the envelope from the start's to the goal's.
    iterations : int
        Of least squares, at most, at the last step.
    advance : Advance | None
        Told (done, total) after each step.

    Raises
    ------
    DesignError
        Constraints cannot be held together.
    """
    variables, operands = tuple(variables), merit.operands
    current, evaluations, converged = start, 0, False
    first = merit.evaluate(start).envelope
    for step in range(1, steps + 1):
        eased = operands
        if operands.envelope is not None:
            eased = replace(operands, envelope=first + step / steps * (operands.envelope - first))
        most = iterations if step == steps else min(ON_THE_WAY, iterations)
        current, spent, converged = _step(replace(merit, operands=eased), current, variables, most)
        evaluations += spent
        if advance is not None:
            advance(step, steps)
    after = merit.evaluate(current)
    _require_held(merit, after)
    held = held_by(merit, current, variables, before)
    return Design(begun, current, before, after, variables, merit, evaluations, converged, held)


def _step(
    merit: MeritFunction, start: Prescription, variables: tuple[Variable, ...], iterations: int
) -> tuple[Prescription, int, bool]:
    """One constrained least squares solution, how many Jacobians it took, and whether it converged."""
    size = _sizes(start, variables)

    def evaluate(x: np.ndarray, differentiate: bool) -> Sample | None:
        try:
            found = merit.evaluate(start.with_values(variables, x * size), variables if differentiate else None)
        except (AimError, BeamMissedError):
            return None
        g = _values(found, merit.operands)
        if found.d_residuals is None:
            return Sample(found.residuals, g)
        slopes = _slopes(found, merit.operands) * size[:, None]
        return Sample(found.residuals, g, found.d_residuals.T * size, slopes.T)

    x0 = start.values(variables) / size
    equal = _equations(merit.operands, len(_values(merit.evaluate(start), merit.operands)))
    low, high = np.array([v.low for v in variables]) / size, np.array([v.high for v in variables]) / size
    found = constrained_least_squares(evaluate, x0, equal, low, high, iterations, SETTLED, 0.1 * HELD)
    return start.with_values(variables, found.x * size), found.jacobians, found.converged


def rms_error(evaluation: Evaluation) -> float:
    """Rms error over the fields, waves."""
    return float(np.sqrt(np.mean(evaluation.errors**2)))


def held_by(
    merit: MeritFunction, prescription: Prescription, variables: tuple[Variable, ...], before: Evaluation
) -> tuple[Held, ...]:
    """Constraints that hold an optimum, by their Lagrange multipliers.

    At an optimum the slope of the mean square error is a sum of the slopes of the constraints at their limits, with
    weights that are not negative; each weight is what the error falls by when its limit is eased.

    Parameters
    ----------
    merit : MeritFunction
        With the constraints.
    prescription : Prescription
        optimised.
    variables : tuple[Variable, ...]
        What was varied.
    before : Evaluation
        The start.
    """
    there = merit.evaluate(prescription, variables)
    g, asked = _values(there, merit.operands), _asked(there, merit.operands)
    if not asked:
        return ()
    assert there.d_residuals is not None
    size = _sizes(prescription, variables)
    fall = -2.0 * (there.d_residuals @ there.residuals) * size
    slopes = _slopes(there, merit.operands) * size[:, None]
    equal = _equations(merit.operands, len(g))
    at_limit = np.flatnonzero((g > -_AT_LIMIT) | equal)
    columns = [slopes[:, k] for k in at_limit]
    owners = [int(k) for k in at_limit]
    if equal.any():  # held in both directions
        columns.append(-slopes[:, 0])
        owners.append(0)
    weights, _ = nnls(np.stack(columns, axis=1), fall)
    start = _values(before, merit.operands)
    worth: dict[int, float] = {}
    for owner, weight in zip(owners, weights, strict=True):
        worth[owner] = worth.get(owner, 0.0) + float(weight) / (2.0 * rms_error(there))
    told = _constraint_names(merit, prescription, [kind for kind, _ in asked])
    found = [Held(told[k], asked[k][1], float(start[k]), gain) for k, gain in worth.items() if gain > 0.0]
    return tuple(sorted(found, key=lambda held: -held.worth))


def _constraint_names(merit: MeritFunction, prescription: Prescription, names: Sequence[str]) -> list[str]:
    """Names that tell the constraints of one kind apart."""
    surfaces = ("scene", *prescription.names)
    passages = iter(merit.passages)
    sides = iter(("long", "short"))
    count = len(prescription.names)
    pairs = iter([(i, j) for i in range(count) for j in range(count) if i != j])
    out = []
    for name in names:
        if name == "clearance":
            p = next(passages)
            way = f"{surfaces[p.stretch]} to {surfaces[p.stretch + 1]}"
            out.append(f"clearance of the beams from {way} beside {surfaces[p.surface]}")
        elif name == "envelope":
            i, j = next(pairs)
            out.append(f"envelope, from {prescription.names[j]} to {prescription.names[i]}")
        elif name == "anamorphism":
            out.append(f"anamorphism, f along the line too {next(sides)} for f across")
        else:
            out.append(name)
    return out


_AT_LIMIT = 20e-6
"""Room, metres, below which a constraint is at its limit."""


def _sizes(prescription: Prescription, variables: Sequence[Variable]) -> np.ndarray:
    """By which variables are made dimensionless."""
    least = [_SMALLEST[v.quantity] for v in variables]
    return np.asarray(np.maximum(np.abs(prescription.values(variables)), least))


_SMALLEST = {
    "curvature": 1e-2,
    "conic": 1.0,
    "A4": 1e-3,
    "A6": 1e-3,
    "A8": 1e-3,
    "z": 0.1,
    "y": 0.01,
    "tilt": 0.01,
    "field_bias": 0.01,
}
"""Least sizes by which variables are made dimensionless."""


def _require_held(merit: MeritFunction, after: Evaluation) -> None:
    """Raise DesignError that names the constraints which are not held, the worst first."""
    g, asked = _values(after, merit.operands), _asked(after, merit.operands)
    names = [kind for kind, _ in asked]
    violated = np.where(_equations(merit.operands, len(g)), np.abs(g), g)
    kinds = tuple(dict.fromkeys(name for value, name in zip(violated, names, strict=True) if not value < 50.0 * HELD))
    if not kinds:
        return
    worst = {kind: max((k for k, name in enumerate(names) if name == kind), key=violated.__getitem__) for kind in kinds}
    limits = np.abs([limit for _, limit in asked])
    limits = np.where(np.array(names) == "anamorphism", limits * after.distance_across, limits)
    kinds = tuple(sorted(kinds, key=lambda kind: -violated[worst[kind]] / max(limits[worst[kind]], HELD)))
    off = {
        kind: f"{100.0 * g[k] / after.distance_across:.3g} %" if kind == "anamorphism" else f"{1e3 * g[k]:.3g} mm"
        for kind, k in worst.items()
    }
    parts = [f"{kind} (off by {off[kind]})" for kind in kinds]
    raise DesignError(
        f"no prescription near the start holds all constraints: {', '.join(parts)}; allow a longer envelope, less "
        "clearance, a larger field bias, or more variables",
        kinds,
    )


SAME = 0.01
"""Share of the rms error within which two starts count as having reached equally good prescriptions."""
TURNS = 8
"""Draws at one spread before it is halved, where none passes light."""
_SHARE = {"curvature": 0.01, "A4": 0.3, "A6": 0.3, "A8": 0.3}
"""Spread (one sigma) of a drawn start as a share of the number; of the largest of its kind for aspheric terms."""
_SPREAD = {"conic": 0.3, "y": 1e-3, "tilt": 1e-3, BIAS: 1e-3}
"""Spread of others, SI."""
_PLACE = 0.01
"""Spread of places along z as a share of the envelope."""


@dataclass(frozen=True, eq=False)
class Attempt:
    """What came of one start.

    Attributes
    ----------
    drawn : bool
        Whether the start was drawn at random; else it is the prescription itself.
    steps : int
        Of the envelope.
    design : Design | None
        None where the constraints could not be held.
    problem : str
        Why not; empty where they are held.
    """

    drawn: bool
    steps: int
    design: Design | None
    problem: str = ""

    @property
    def error(self) -> float:
        """Rms error over the fields that it reached, waves; infinite where the constraints are not held."""
        return np.inf if self.design is None else rms_error(self.design.after)


@dataclass(frozen=True, eq=False)
class Search:
    """The best of several starts.

    Attributes
    ----------
    attempts : tuple[Attempt, ...]
        One for each start, in their order.
    """

    attempts: tuple[Attempt, ...]

    @property
    def best(self) -> Design:
        """The design with the least rms error over the fields; the first of equals."""
        design = min(self.attempts, key=lambda attempt: attempt.error).design
        assert design is not None
        return design

    @property
    def agreeing(self) -> int:
        """How many starts ended within ``SAME`` of the best, itself among them."""
        least = rms_error(self.best.after)
        return sum(attempt.error <= (1.0 + SAME) * least for attempt in self.attempts)

    @property
    def local(self) -> bool:
        """Whether nothing but a local optimum is known: there was one start, or starts ended at different ones."""
        return len(self.attempts) == 1 or self.agreeing < len(self.attempts)


def search(
    backend: Backend,
    start: Prescription,
    variables: Sequence[Variable],
    beams: Beams,
    operands: Operands,
    steps: int = 1,
    starts: int = 1,
    seed: int = 0,
    iterations: int = ITERATIONS,
    advance: Advance | None = None,
) -> Search:
    """Optimise a prescription from several starts.

    Parameters
    ----------
    backend : Backend
        Where to trace.
    start : Prescription
        The first start; beams keep to the sides of surfaces on which they pass there.
    variables : Sequence[Variable]
        What may vary, and within which bounds.
    beams : Beams
        Fields and pupil.
    operands : Operands
        Merit and constraints.
    steps : int
        Of the envelope from the start's to the goal's, for every other start.
    starts : int
        How many.
    seed : int
        Of those that are drawn at random; the n-th is the same however many there are.
    iterations : int
        Of least squares, at most, at the last step of each start.
    advance : Advance | None
        Told (done, total) after each step.

    Raises
    ------
    DesignError
        The start passes no light or breaks a bound, or from no start the constraints can be held together.
    """
    variables = tuple(variables)
    merit, before = judged(backend, start, variables, beams, operands)
    if operands.envelope is None:
        steps = 1
    plan = [(number, steps if number % 2 == 0 else 1) for number in range(starts)]
    total, done = sum(own for _, own in plan), 0
    attempts, first = [], None
    for number, own in plan:
        drawn = number > int(steps > 1)
        begin = drawn_start(merit, start, variables, np.random.default_rng([seed, number])) if drawn else start

        def tell(step: int, _: int, done: int = done) -> None:
            if advance is not None:
                advance(done + step, total)

        try:
            design, problem = descend(merit, start, before, begin, variables, own, iterations, tell), ""
        except DesignError as error:
            design, problem, first = None, str(error), first or error
        attempts.append(Attempt(drawn, own, design, problem))
        done += own
    if first is not None and all(attempt.design is None for attempt in attempts):
        raise first
    return Search(tuple(attempts))


def drawn_start(
    merit: MeritFunction, nominal: Prescription, variables: Sequence[Variable], rng: np.random.Generator
) -> Prescription:
    """A prescription that is drawn at random about another and passes light.

    Its spread is halved whenever ``TURNS`` draws in a row pass none.

    Parameters
    ----------
    merit : MeritFunction
        Whose beams have to come through.
    nominal : Prescription
        What to draw about.
    variables : Sequence[Variable]
        What is drawn; their bounds are kept.
    rng : np.random.Generator
        Normal numbers.
    """
    values = nominal.values(variables)
    envelope = merit.evaluate(nominal).envelope
    kinds = {v.quantity for v in variables}
    largest = {k: max(abs(x) for v, x in zip(variables, values, strict=True) if v.quantity == k) for k in kinds}
    spread = np.empty(len(values))
    for n, (variable, value) in enumerate(zip(variables, values, strict=True)):
        kind = variable.quantity
        if kind == "z":
            spread[n] = _PLACE * envelope
        elif kind in _SHARE:
            spread[n] = _SHARE[kind] * (abs(value) if kind == "curvature" else largest[kind])
        else:
            spread[n] = _SPREAD[kind]
    low, high = np.array([v.low for v in variables]), np.array([v.high for v in variables])
    while True:
        for _ in range(TURNS):
            drawn = np.clip(values + spread * rng.standard_normal(len(values)), low, high)
            found = nominal.with_values(variables, drawn)
            try:
                merit.evaluate(found)
            except (AimError, BeamMissedError):
                continue
            return found
        spread = 0.5 * spread
