"""Learned terms of an estimate: plan and record converted to `analysis.monitor.learned_terms`, and their results.

A commanded move that the readings contradict is compared with other explanations: a wrong sign, no move, another day.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from analysis.arrays import Array
from analysis.monitor.disturbances import FALSE_ALARM, Disturbances
from analysis.monitor.filter_state import FilterState, Observed
from analysis.monitor.kalman_filter import SeriesFilter
from analysis.monitor.learned_terms import Decay, Input, Move, Slope, Term, Terms
from analysis.statistics import limit_of
from scenes.specs.operation import OperationSpec, TermSpec, motion_kind
from scenes.yaml.errors import Problem, names_text, nearest
from scenes.yaml.units import parse_quantity
from twin.framework.artefact import decimals_for, fixed
from twin.operate.record.entries import MICRO, micros, utc_text
from twin.operate.record.history import History, content_of

MOVE, INPUT = "move", "input"
"""Kinds of the record's entries that are commanded moves and samples of inputs."""
UNDETERMINED = 0.9
"""Ratio of sigma to that of the prior above which the readings do not determine a term."""
NEAR = 10
"""Number of readings before and after a move among which its true day is sought."""
_PREFERRED = 5.0
"""Gain in log likelihood by which another size must exceed a wrong sign, a wrong day or no move, to be named."""


def terms_of(plan: OperationSpec, prior: Disturbances, history: History, epoch: int, kind: str) -> Terms | None:
    """Return the terms of a plan and the moves of a record; None if there are none.

    Parameters
    ----------
    plan : OperationSpec
        Plan of operation.
    prior : Disturbances
        Motions of the plan's disturbances.
    history : History
        Record of the instrument in operation.
    epoch : int
        Origin of the filter's seconds, in microseconds of TAI since 2000.
    kind : str
        Kind of the readings that are filtered.

    Raises
    ------
    Problem
        The disturbances have no such motion, or the record has no such input.
    """
    inputs = {spec.input for spec in plan.terms.values() if spec.input is not None}
    samples: dict[str, list[tuple[float, float, float]]] = {}
    for sample in history.entries(INPUT) if inputs else ():
        if (subject := str(sample["subject"])) in inputs:
            content = content_of(sample)
            numbers = (sample["time_us"] - epoch) / MICRO, float(content["values"][0]), float(content["sigma"])
            samples.setdefault(subject, []).append(numbers)
    if absent := sorted(inputs - samples.keys()):
        known = names_text(history.subjects(INPUT)) or "none"
        allowed = f"a table of kind input with it; the record has {known}"
        raise Problem(f"the record has no readings of the input {absent[0]}", None, allowed)
    terms = [_term(name, spec, prior, epoch, samples) for name, spec in plan.terms.items()]
    for entry in moves_of(history):
        content, motion = content_of(entry), str(entry["subject"])
        k, size = _motion(motion, prior)
        amounts = float(content["values"][0]) / size, float(content["sigma"]) / size
        name = f"the move of {utc_text(entry['time_us'])}, {motion}"
        terms.append(Move(name, k, *amounts, (entry["time_us"] - epoch) / MICRO, float(content["time_sigma"])))
    if not terms:
        return None
    readings = [(entry["time_us"] - epoch) / MICRO for entry in history.entries(kind)] if inputs else []
    return Terms(tuple(terms), np.unique(readings))


def moves_of(history: History) -> list[dict[str, Any]]:
    """Return the entries of the commanded moves that were not excluded, in the order of time."""
    decisions = history.decisions()
    return [entry for entry in history.entries(MOVE) if decisions.get(entry["id"], (True, ""))[0]]


def excluded_moves(history: History) -> list[tuple[int, str, str, str]]:
    """Return time, kind, subject and reason of the commanded moves that a person excluded, in the order of time."""
    decisions = history.decisions()
    moves = ((entry, decisions.get(entry["id"], (True, ""))) for entry in history.entries(MOVE))
    return [
        (int(entry["time_us"]), MOVE, str(entry["subject"]), f"entry {entry['id']} was excluded: {why}")
        for entry, (included, why) in moves
        if not included
    ]


def _motion(name: str, prior: Disturbances) -> tuple[int, float]:
    """Return the index of a motion among the disturbances, and its standard deviation in SI units."""
    if name not in prior.labels:
        near = nearest(name, prior.labels)
        known = names_text(dict.fromkeys(prior.labels[:12]))
        raise Problem(f"the plan's disturbances have no motion {name}", None, f"a cause with it, as of {known}", near)
    k = prior.labels.index(name)
    return k, float(prior.sigmas[k]) * parse_quantity(f"1 {prior.units[k]}", motion_kind(name))


def _term(
    name: str,
    spec: TermSpec,
    prior: Disturbances,
    epoch: int,
    samples: Mapping[str, Sequence[tuple[float, float, float]]],
) -> Term:
    """Return one term of a plan, with the times [s], values and sigmas of the samples of its input."""
    k, size = _motion(spec.motion, prior)
    mean, sigma = spec.amount.si(spec.kind)
    arguments = name, k, mean / size, sigma / size
    since = 0.0 if spec.since is None else (micros(spec.since) - epoch) / MICRO
    if spec.per is not None:
        return Slope(*arguments, since, spec.per)
    if spec.decay is not None:
        return Decay(*arguments, since, spec.decay.value, spec.decay.sigma or None)
    if spec.input is None:
        return Term(*arguments)
    times, values, sigmas = np.array(samples[spec.input]).T
    lag, spread = (None, None) if spec.lag is None else (spec.lag.value, spec.lag.sigma or None)
    noise = float(np.median(sigmas))
    return Input(*arguments, times, values - spec.reference, noise, spec.window, spec.relative, lag, spread, spec.gap)


@dataclass(frozen=True)
class LearnedTerm:
    """Estimate of a term or of a commanded move from all readings.

    Attributes
    ----------
    name, motion, unit : str
        Name of the term, its motion, and the unit of its amounts.
    amount, sigma : float
        Amount and its standard deviation.
    prior, prior_sigma : float
        Those before any reading; for a move the commanded size.
    time_constant_h, time_constant_h_sigma : float or None
        Time constant in hours and its standard deviation; None if there is none or it is known.
    time_utc : str or None
        Time of a move; None for other terms.
    undetermined : bool
        True if the readings do not determine the amount or the time constant.
    note : str
        What the readings do not determine, and where its input was not measured; empty for nothing.
    warning : str
        Likely mistake in the entry of a move that the readings contradict; empty for none.
    """

    name: str
    motion: str
    unit: str
    amount: float
    sigma: float
    prior: float
    prior_sigma: float
    time_constant_h: float | None
    time_constant_h_sigma: float | None
    time_utc: str | None
    undetermined: bool
    note: str = ""
    warning: str = ""


def learned_terms(
    series_filter: SeriesFilter, state: FilterState, epoch: int, contradicted: Mapping[str, str]
) -> tuple[LearnedTerm, ...]:
    """Return the estimates of all terms and moves.

    Parameters
    ----------
    series_filter : SeriesFilter
        Filter with terms.
    state : FilterState
        State after all readings.
    epoch : int
        Origin of the filter's seconds, in microseconds of TAI since 2000.
    contradicted : Mapping[str, str]
        Name of a move -> warning that the readings contradict it.
    """
    terms, prior = series_filter.terms, series_filter.prior
    assert terms is not None
    at = series_filter.space.term_states
    mean, sigma = state.mean[at], np.sqrt(np.maximum(np.diag(state.covariance)[at], 0.0))
    out = []
    for k, term in enumerate(terms.terms):
        unit = float(prior.sigmas[term.motion])
        constant, constant_sigma, texts = None, None, []
        vague = not isinstance(term, Move) and sigma[k] > UNDETERMINED * term.sigma > 0.0
        if vague:
            texts.append(f"the readings do not determine the amount of {term.name}: it is the plan's")
        if k in terms.curved:
            x = len(terms.terms) + terms.curved.index(k)
            known = term.constant if isinstance(term, Decay) else getattr(term, "lag", 0.0)
            constant = known * math.exp(terms.logs[x - len(terms.terms)] + mean[x]) / 3600.0
            constant_sigma = constant * float(sigma[x])
            if sigma[x] > UNDETERMINED * terms.sigma[x]:
                vague = True
                texts.append(f"the readings do not determine the time constant of {term.name}: it is the plan's")
        if isinstance(term, Input):
            texts += _input_doubts(terms, term)
        when = utc_text(epoch + round(term.time * MICRO)) if isinstance(term, Move) else None
        amount, spread, before, before_sigma = unit * np.array([mean[k], sigma[k], term.mean, term.sigma])
        note, warning = "; ".join(texts), contradicted.get(term.name, "")
        what = prior.labels[term.motion], prior.units[term.motion]
        estimates = float(amount), float(spread), float(before), float(before_sigma)
        out.append(LearnedTerm(term.name, *what, *estimates, constant, constant_sigma, when, vague, note, warning))
    return tuple(out)


def _input_doubts(terms: Terms, term: Input) -> Iterator[str]:
    """Yield what is doubtful about the samples of an input."""
    if absent := terms.missing(term.name):
        yield f"the input of {term.name} was not measured at {absent} of {len(terms.readings)} readings"
    if term.window is not None and term.window > term.times[-1] - term.times[0]:
        yield f"the window of {term.name} is longer than the series of its input"


@dataclass(frozen=True, eq=False)
class _Mistake:
    """Possible mistake in the entry of a move.

    Attributes
    ----------
    move : int
        Index of the move among the terms.
    text : str
        Sentence on the mistake.
    readings : slice
        Readings that it changes.
    factor : float or None
        Change of these readings, in prior standard deviations of the motion; None if it is unknown.
    """

    move: int
    text: str
    readings: slice
    factor: float | None


def contradicted_moves(
    how: SeriesFilter, start: FilterState, observed: Sequence[Observed], inflation: float, text: Callable[[float], str]
) -> dict[str, str]:
    """Return the moves that the readings contradict, with a warning that names the likely mistake.

    A mistake is a wrong sign, a move that did not happen, another day or another size. The gain in log likelihood is
    exact, since the whitened readings are linear in the readings. The largest gain comes first, and is removed from the
    readings before the next. The false-alarm probability of the program is that of all tests together.

    Parameters
    ----------
    how : SeriesFilter
        Filter that does not search for jumps; its steps are those that no move explains.
    start : FilterState
        State before the first of the readings.
    observed : sequence of Observed
        Readings from there on, in the order of time; only moves between them are tested.
    inflation : float
        Factor of all sigmas.
    text : callable
        Function that writes a time of the filter in seconds as a date.
    """
    times = np.array([reading.time for reading in observed])
    terms = () if how.terms is None else how.terms.terms
    cases = [case for k, term in enumerate(terms) if isinstance(term, Move) for case in _mistakes(k, term, times, text)]
    if not cases:
        return {}
    white, response = _whitened_response(how, start, observed, [(terms[c.move].motion, c.readings) for c in cases])
    information = np.sum(response**2, axis=0)
    limit = 0.5 * float(limit_of(FALSE_ALARM / len(cases), 1)) * inflation**2
    out: dict[str, str] = {}
    while cases:
        score = response.T @ white
        best = np.divide(score, information, out=np.zeros_like(score), where=information > 0.0)
        factors = np.array([b if c.factor is None else c.factor for b, c in zip(best.tolist(), cases, strict=True)])
        gains = factors * score - 0.5 * factors**2 * information
        k = cases[int(np.argmax(gains))].move
        mine = [i for i, case in enumerate(cases) if case.move == k]
        free = next(i for i in mine if cases[i].factor is None)
        if gains[mine].max() < limit:
            break
        # another size explains as much as a wrong sign, but is less likely
        chosen = max(mine, key=lambda i: gains[i] + (_PREFERRED if i != free else 0.0))
        term = terms[k]
        unit, name = float(how.prior.sigmas[term.motion]), how.prior.units[term.motion].replace("um", "µm")
        sigma = unit / math.sqrt(information[free])
        digits = decimals_for(sigma)
        seen = f"{fixed(unit * (term.mean + best[free]), digits, True)} ± {fixed(sigma, digits)} {name}"
        entered = f"{fixed(unit * term.mean, digits, True)} {name}"
        out[term.name] = (
            f"{term.name}, of {entered} contradicts the readings, in which it is {seen}: {cases[chosen].text}"
        )
        white = white - factors[chosen] * response[:, chosen]
        left = [i for i, case in enumerate(cases) if case.move != k]
        cases, response, information = [cases[i] for i in left], response[:, left], information[left]
    return out


def _mistakes(k: int, move: Move, times: Array, text: Callable[[float], str]) -> Iterator[_Mistake]:
    """Yield the possible mistakes in the entry of a move, of which the readings at given times can show something."""
    first, count = int(np.searchsorted(times, move.time)), len(times)
    if first in (0, count):  # a move before all readings is part of a constant
        return
    later = slice(first, count)
    yield _Mistake(k, "its size seems to be wrong", later, None)
    yield _Mistake(k, "its sign seems to be wrong", later, -2.0 * move.mean)
    yield _Mistake(k, "it seems not to have happened", later, -move.mean)
    for j in range(max(first - NEAR, 1), min(first + NEAR + 1, count)):
        day = f"its day seems to be wrong, rather between {text(float(times[j - 1]))} and {text(float(times[j]))}"
        if j < first:
            yield _Mistake(k, day, slice(j, first), move.mean)
        elif j > first:
            yield _Mistake(k, day, slice(first, j), -move.mean)


def _whitened_response(
    how: SeriesFilter, start: FilterState, observed: Sequence[Observed], changes: Sequence[tuple[int, slice]]
) -> tuple[Array, Array]:
    """Return the whitened readings, (N d,), and their response to changes of the readings, (N d, C).

    Parameters
    ----------
    how : SeriesFilter
        Filter that does not search for jumps.
    start : FilterState
        State before the first reading.
    observed : sequence of Observed
        N readings of d values in the order of time.
    changes : sequence of (int, slice)
        For each of C changes a motion, and the readings that see one standard deviation of it.
    """
    current, states = start, np.zeros((how.space.size, len(changes)))
    effects = how.prior.spots[:, [motion for motion, _ in changes]]
    inside = np.zeros((len(observed), len(changes)))
    for column, (_, readings) in enumerate(changes):
        inside[readings, column] = 1.0
    white, response = [], []
    for k, reading in enumerate(observed):
        states = how.space.moved(states, current.time, reading.time)
        there = how.at(current, reading.time)
        whitened = how.whitened(there.state, reading)
        seen = whitened.picked[:, : len(effects)] @ (effects * inside[k]) - whitened.rows @ states
        states = states + whitened.gain.T @ seen
        current = replace(there, state=how.ingested(there.state, reading, whitened)[0])
        white.append(whitened.white)
        response.append(seen)
    return np.concatenate(white), np.concatenate(response)
