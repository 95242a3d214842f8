"""Several starts of a design: what least squares reach from one start is a local optimum, and another may be better.

The first start is the prescription itself with the envelope shortened in steps, the second the same with it shortened
at once; others are drawn at random about it, in turn in steps and at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optics.design.design_rays import Beams
from optics.design.design_variables import BIAS, Prescription, Variable
from optics.design.merit_function import MeritFunction, Operands
from optics.design.optimiser import ITERATIONS, Advance, Design, DesignError, descend, judged, rms_error
from optics.numerics.backend import Backend
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError

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

    Attributes:
        drawn: whether the start was drawn at random; else it is the prescription itself.
        steps: of the envelope.
        design: None where the constraints could not be held.
        problem: why not; empty where they are held.
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

    Attributes:
        attempts: one for each start, in their order.
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

    Args:
        backend: where to trace.
        start: the first start; beams keep to the sides of surfaces on which they pass there.
        variables: what may vary, and within which bounds.
        beams: fields and pupil.
        operands: merit and constraints.
        steps: of the envelope from the start's to the goal's, for every other start.
        starts: how many.
        seed: of those that are drawn at random; the n-th is the same however many there are.
        iterations: of least squares, at most, at the last step of each start.
        advance: told (done, total) after each step.

    Raises:
        DesignError: the start passes no light or breaks a bound, or from no start the constraints can be held together.
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

    Args:
        merit: whose beams have to come through.
        nominal: what to draw about.
        variables: what is drawn; their bounds are kept.
        rng: normal numbers.
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
