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
from analysis.monitor.kalman_filter import SeriesFilter, smoothed
from analysis.monitor.learned_terms import Decay, Input, Move, Slope, Term, Terms
from analysis.statistics import limit_of
from scenes.specs.operation import OperationSpec, TermSpec, motion_kind
from scenes.yaml.errors import Problem, names_text, nearest
from scenes.yaml.units import parse_quantity
from twin.framework.artefact import decimals_for, fixed, plain
from twin.operate.record.entries import DECISION, MICRO, micros, utc_text
from twin.operate.record.history import History, content_of

MOVE, INPUT = "move", "input"
"""Kinds of the record's entries that are commanded moves and samples of inputs."""
UNDETERMINED = 0.9
"""Ratio of sigma to that of the prior above which the readings do not determine a term."""
NEAR = 10
"""Number of readings before and after a move among which its true day is sought."""
_DAY = 86_400.0


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
    terms = [_term(plan, name, spec, prior, history, epoch) for name, spec in plan.terms.items()]
    for entry in moves_of(history):
        content, motion = content_of(entry), str(entry["subject"])
        k, size = _motion(motion, prior)
        amounts = float(content["values"][0]) / size, float(content["sigma"]) / size
        name = f"the move of {utc_text(entry['time_us'])}, {motion}"
        terms.append(Move(name, k, *amounts, (entry["time_us"] - epoch) / MICRO, float(content["time_sigma"])))
    if not terms:
        return None
    readings = np.array([(entry["time_us"] - epoch) / MICRO for entry in history.entries(kind)])
    return Terms(tuple(terms), np.unique(readings))


def moves_of(history: History) -> list[dict[str, Any]]:
    """Return the entries of the commanded moves that were not excluded, in the order of time."""
    decisions = [content_of(entry) for entry in history.entries(DECISION)]
    excluded = {int(decision["entry"]): not decision["included"] for decision in decisions}
    return [entry for entry in history.entries(MOVE) if not excluded.get(entry["id"], False)]


def _motion(name: str, prior: Disturbances) -> tuple[int, float]:
    """Return the index of a motion among the disturbances, and its standard deviation in SI units."""
    if name not in prior.labels:
        near = nearest(name, prior.labels)
        known = names_text(dict.fromkeys(prior.labels[:12]))
        raise Problem(f"the plan's disturbances have no motion {name}", None, f"a cause with it, as of {known}", near)
    k = prior.labels.index(name)
    return k, float(prior.sigmas[k]) * parse_quantity(f"1 {prior.units[k]}", motion_kind(name))


def _term(
    plan: OperationSpec, name: str, spec: TermSpec, prior: Disturbances, history: History, epoch: int
) -> Term:
    """Return one term of a plan; raise Problem if its motion or its input does not exist."""
    k, size = _motion(spec.motion, prior)
    mean, sigma = spec.amount.si(spec.kind)
    given = name, k, mean / size, sigma / size
    since = 0.0 if spec.since is None else (micros(spec.since) - epoch) / MICRO
    if spec.per is not None:
        return Slope(*given, since, spec.per)
    if spec.decay is not None:
        return Decay(*given, since, spec.decay.value, spec.decay.sigma or None)
    if spec.input is None:
        return Term(*given)
    samples = [entry for entry in history.entries(INPUT) if entry["subject"] == spec.input]
    if not samples:
        known = history.subjects(INPUT)
        allowed = f"a table of kind input with it; the record has {names_text(known) if known else 'none'}"
        raise Problem(f"the record has no readings of the input {spec.input} of {name}", None, allowed)
    contents = [content_of(sample) for sample in samples]
    times = np.array([(sample["time_us"] - epoch) / MICRO for sample in samples])
    values = np.array([float(content["values"][0]) - spec.reference for content in contents])
    lag = (None, None) if spec.lag is None else (spec.lag.value, spec.lag.sigma or None)
    noise = float(np.median([float(content["sigma"]) for content in contents]))
    return Input(*given, times, values, noise, spec.window, spec.relative, *lag, spec.gap)


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
    warning : str
        What is doubtful about it; empty if nothing is.
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
    if terms is None:
        return ()
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
        values = (unit * float(v) for v in (mean[k], sigma[k], term.mean, term.sigma))
        warning = "; ".join([*texts, *([contradicted[term.name]] if term.name in contradicted else [])])
        what = prior.labels[term.motion], prior.units[term.motion]
        out.append(LearnedTerm(term.name, *what, *values, constant, constant_sigma, when, vague, warning))
    return tuple(out)


def _input_doubts(terms: Terms, term: Input) -> Iterator[str]:
    """Yield what is doubtful about the samples of an input."""
    if absent := terms.missing(term.name):
        yield f"the input of {term.name} was not measured at {absent} of {len(terms.readings)} readings"
    if term.window is not None and term.window > term.times[-1] - term.times[0]:
        yield f"the window of {term.name} is longer than the series of its input"


def contradicted_moves(
    how: SeriesFilter, start: FilterState, observed: Sequence[Observed], inflation: float, text: Callable[[float], str]
) -> dict[str, str]:
    """Return the moves that the readings contradict, with a warning that names the likely mistake.

    The test is on the score and the information (inverse variance) of a different size, from all readings, at the
    false-alarm probability of the program for all moves together.

    Parameters
    ----------
    how : SeriesFilter
        Filter that does not search for jumps; its steps are those that no move explains.
    start : FilterState
        State before the first reading.
    observed : sequence of Observed
        All readings in the order of time.
    inflation : float
        Factor of all sigmas.
    text : callable
        Function that writes a time of the filter in seconds as a date.
    """
    terms = how.terms
    moves = [] if terms is None else [k for k, term in enumerate(terms.terms) if isinstance(term, Move)]
    if terms is None or not moves or not observed:
        return {}
    at, found = how.space.term_states, []

    def note(number: int, score: Array, information: Array) -> None:
        if number == 0:
            found.append((score[at], np.diag(information)[at]))

    nothing = [np.zeros(len(how.walking))] * len(observed)
    smoothed(how, start, observed, np.zeros(0), nothing, how.parameters_of, note)
    score, information = found[0]
    limit = float(limit_of(FALSE_ALARM / len(moves), 1)) * inflation**2
    wrong = [k for k in moves if score[k] ** 2 > limit * information[k] > 0.0]
    out = {}
    for k in sorted(wrong, key=lambda k: -(score[k] ** 2) / information[k]):
        term = terms.terms[k]
        unit, name = float(how.prior.sigmas[term.motion]), how.prior.units[term.motion].replace("um", "µm")
        shown, sigma = unit * (term.mean + score[k] / information[k]), unit / math.sqrt(information[k])
        digits = decimals_for(sigma)
        seen = f"{fixed(shown, digits, True)} ± {fixed(sigma, digits)} {name}, not {plain(unit * term.mean)} {name}"
        cause = _likely_mistake(how, start, observed, k, text)
        out[term.name] = f"{term.name}, contradicts the readings, which show {seen}: {cause}"
    return out


def _likely_mistake(
    how: SeriesFilter, start: FilterState, observed: Sequence[Observed], k: int, text: Callable[[float], str]
) -> str:
    """Return which change of a move explains the readings best: another sign, no move, another day or another size."""
    assert how.terms is not None
    move = how.terms.terms[k]
    assert isinstance(move, Move)
    times = np.array([reading.time for reading in observed])
    first = int(np.searchsorted(times, move.time))
    near = [(times[i - 1], times[i]) for i in range(max(first - NEAR, 1), min(first + NEAR + 1, len(times))) if i != first]
    cases: list[tuple[str, Move]] = [
        ("its sign seems to be wrong", replace(move, mean=-move.mean)),
        ("it seems not to have happened", replace(move, mean=0.0)),
        ("its size seems to be wrong", replace(move, sigma=move.sigma + 2.0 * abs(move.mean))),
    ]
    cases += [
        (f"its day seems to be wrong, rather between {text(a)} and {text(b)}", replace(move, time=0.5 * (a + b), time_sigma=0.0))
        for a, b in near
    ]
    scores = [_log_score(_with_term(how, k, other), start, observed) for _, other in cases]
    return cases[int(np.argmax(scores))][0]


def _with_term(how: SeriesFilter, k: int, term: Term) -> SeriesFilter:
    """Return a filter with one term replaced."""
    assert how.terms is not None
    terms = (*how.terms.terms[:k], term, *how.terms.terms[k + 1 :])
    return replace(how, terms=replace(how.terms, terms=terms))


def _log_score(how: SeriesFilter, start: FilterState, observed: Sequence[Observed]) -> float:
    """Return the logarithm of the predicted density of all readings."""
    current, total = replace(how.start(start.time), search=None), 0.0
    for reading in observed:
        there = how.at(current, reading.time)
        track, innovation = how.ingested(there.state, reading)
        current, total = replace(there, state=track), total + innovation.log_score
    return total
