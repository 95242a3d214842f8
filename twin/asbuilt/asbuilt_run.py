"""Estimate of an instrument's as-built state: observable combinations, predicted merits, and the next move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.instrument_state.state_estimate import (
    FALSE_ALARM,
    Combination,
    ConsistencyTest,
    StateEstimate,
    combinations,
)
from optics.numerics.array_math import PhysicalError
from optics.numerics.backend import Backend
from scenes.specs.asbuilt import AsBuiltSetup
from scenes.specs.tolerance import MeritSpec, amount_text
from twin.asbuilt.asbuilt_bench import AsBuiltBench, nan_where_lost, selected_moves
from twin.asbuilt.next_step import Advice, advice
from twin.asbuilt.star_images import STAR, StarResidual
from twin.framework.memory import Lowered, require_memory
from twin.framework.procedure import Advance, silent, stream
from twin.framework.record import Quantity, Record
from twin.tolerance.monitor_merit import Merit, merit_unit, shown_merit

LEVELS = (0.025, 0.16, 0.5, 0.84, 0.975)
"""Probabilities of the quantiles that are reported: median, 68 % and 95 % intervals."""
WORST_FACTOR = 9.0
"""Chi-square per degree of freedom above which measurements are considered to contradict each other.

It corresponds to residuals of three sigma on average.
"""
_INSTRUMENT, _POSTERIOR, _PRIOR, _MOVE, _MADE = range(5)
"""Numbers of the random streams of a seed.

They are for the simulated instrument, the states of the posterior, those of the prior, the choice of the next move, and
the errors of making that move.
"""
ALONG = tuple((float(x), 0.0) for x in np.linspace(-1.0, 1.0, 11))
"""Fields (x, y), as fractions of the half field, at which the wavefront along the line is plotted."""
_LINEAR = 0.3
"""Effective share of the draws of the linear posterior below which a warning says that its sigmas are too small.

Edge pages of gf7 (docs/asbuilt.md) whose 95 % intervals hold have 0.6; those of which 75 to 83 % hold, 0.01 to 0.27.
"""
_DRAW = 7e4
"""Memory in bytes of three random states: one from the prior, one from the posterior and one after the next move."""


@dataclass(frozen=True, eq=False)
class MeritPrediction:
    """Predicted distribution of a merit of the instrument as built.

    Attributes
    ----------
    merit : Merit
        Merit whose distribution it is.
    designed : float
        Value of the nominal instrument, SI units.
    before : tuple of float
        Quantiles ``LEVELS`` under the prior alone, SI units.
    now : tuple of float
        Quantiles ``LEVELS`` under the posterior, SI units.
    meets : float
        Posterior probability that it meets the requirement.
    moved : tuple of float
        Quantiles ``LEVELS`` after the next move, SI units; empty without actuators.
    meets_moved : float
        Probability that it meets the requirement after the move; NaN without actuators.
    true : float
        True value of a simulated instrument, SI units; NaN for a real one.
    """

    merit: Merit
    designed: float
    before: tuple[float, ...]
    now: tuple[float, ...]
    meets: float
    moved: tuple[float, ...]
    meets_moved: float
    true: float


@dataclass(frozen=True, eq=False)
class AsBuiltRun:
    """Estimated as-built state of an instrument, its image quality and the recommended next move.

    Attributes
    ----------
    setup : AsBuiltSetup
        Test with the measurements.
    bench : AsBuiltBench
        Instrument that is evaluated.
    data : tuple of ndarray
        Readings of each measurement, SI units.
    estimate : StateEstimate
        Estimated state.
    known : tuple of Combination
        Independent combinations of motions, the best determined by the measurements first.
    standings : tuple of Standing
        Predicted distributions of the merits.
    along : tuple of ndarray
        Rms wavefront error at F fields along the line, waves: nominal (F,), and quantiles ``LEVELS`` under the prior,
        the posterior and, with actuators, after the next move, (2 or 3, 5, F).
    advice : Advice or None
        Recommended next move; None without actuators.
    true : ndarray or None
        Parameters of a simulated instrument; None for a real one.
    warnings : tuple of str
        Warnings for the user.
    modes : tuple of StateEstimate
        States that explain the measurements, the most probable first: one, except with images in a single focus.
    images : tuple of StarResidual
        Measured and predicted images of stars.
    """

    setup: AsBuiltSetup
    bench: AsBuiltBench
    data: tuple[np.ndarray, ...]
    estimate: StateEstimate
    known: tuple[Combination, ...]
    predictions: tuple[MeritPrediction, ...]
    along: tuple[np.ndarray, np.ndarray]
    advice: Advice | None
    true: np.ndarray | None
    warnings: tuple[str, ...]
    modes: tuple[StateEstimate, ...] = ()
    images: tuple[StarResidual, ...] = ()


def run_asbuilt(
    setup: AsBuiltSetup, backend: Backend, seed: int | None = None, advance: Advance = silent
) -> AsBuiltRun:
    """Estimate the as-built state of an instrument, predict its image quality, and recommend the next move.

    Parameters
    ----------
    setup : AsBuiltSetup
        Test with the measurements.
    backend : Backend
        Array backend of the ray trace.
    seed : int, optional
        Seed of the random numbers; the file's by default.
    advance : Advance
        Callback that reports progress.

    Raises
    ------
    InputError
        A name does not exist, a file holds no data, measurements contradict each other, or the memory does not suffice.
    """
    test = setup.test
    seed = test.seed if seed is None else seed
    advance("state", 0, 4)
    require_memory(Lowered(test, ("draws",), test.draws, "draws", lambda draws: draws * _DRAW, 20))
    bench = AsBuiltBench(setup, backend)
    true = None
    if test.simulate is None:
        data = bench.data()
    else:
        rng = _random(test.simulate.seed, _INSTRUMENT)
        true = bench.draw(rng, test.simulate.law)
        try:
            data = bench.measured(true, rng)
        except PhysicalError as error:
            allowed = "another seed, or smaller standard deviations"
            text = f"the randomly drawn as-built instrument lets no light through: {error}"
            raise test.error(text, ("simulate",), allowed=allowed) from error
    modes = bench.estimates(data)
    state = modes[0]
    require_consistency(bench, state)
    advance("state", 1, 4)
    draws = drawn_states(modes, _random(seed, _POSTERIOR), test.draws)
    images = bench.star_images(data, state)
    prior = bench.parameters.prior
    blind = prior.mean + _random(seed, _PRIOR).standard_normal((test.draws, prior.root.shape[1])) @ prior.root.T
    last = bench.last
    step = advice(bench, state, draws, _random(seed, _MOVE)) if bench.parameters.names else None
    advance("state", 2, 4)
    moved, executed = None, None
    if step is not None:
        errors = _random(seed, _MADE).standard_normal((len(draws), 2, len(step.move.amounts)))
        executed = bench.actuators.made(step.move.amounts, errors)
        moved = bench.merit_parts(draws, last, executed)
    parts = (bench.merit_parts(blind, last), bench.merit_parts(draws, last), moved)
    truth = None if true is None else bench.merit_parts(true[None], last)[0]
    nominal = bench.merit_parts(np.zeros((1, len(prior.mean))), None)[0]
    predictions = tuple(_prediction(merit, nominal, parts, truth) for merit in bench.merits.merits)
    advance("state", 3, 4)
    along = _along(bench, ((blind, None), (draws, None), *(() if executed is None else ((draws, executed),))))
    advance("state", 4, 4)
    return AsBuiltRun(
        setup,
        bench,
        data,
        state,
        combinations(state),
        predictions,
        along,
        step,
        true,
        (
            *_warnings(state, parts[1]),
            *_linearity_warnings(bench.linear_share(data, state)),
            *_mode_warnings(modes),
            *(text for image in images for text in image.warnings()),
        ),
        modes,
        images,
    )


def probabilities(modes: Sequence[StateEstimate]) -> np.ndarray:
    """Return the posterior probability of each of several states that explain the measurements, (modes,).

    The first is the most probable; errors are multiplied by its variance factor.
    """
    evidence = np.array([mode.log_evidence for mode in modes])
    share = np.exp((evidence - evidence[0]) / modes[0].variance_factor)
    return np.asarray(share / np.sum(share))


def drawn_states(modes: Sequence[StateEstimate], rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw random states from the posterior, (count, K), from each of its modes as often as it is probable."""
    if len(modes) == 1:
        return modes[0].draw(rng, count)
    counts = rng.multinomial(count, probabilities(modes))
    return np.concatenate([mode.draw(rng, int(number)) for mode, number in zip(modes, counts, strict=True)])


def _linearity_warnings(share: float) -> list[str]:
    if share > _LINEAR:
        return []
    return [
        "values of MTF are far from linear within the posterior (its draws represent the exact one with an effective "
        f"share of {100 * share:.2g} %): sigmas and merits rely on the linear model and may be several times too "
        "small. Another page at a lower frequency, or one on the other side of focus, decides"
    ]


def _mode_warnings(modes: Sequence[StateEstimate]) -> list[str]:
    if len(modes) == 1 or probabilities(modes)[1] < FALSE_ALARM:
        return []
    first, second = (mode.whole.chi_square for mode in modes[:2])
    return [
        "another state, such as one with the opposite sign of even aberrations or another focus, explains the "
        f"measurements as well (chi-square {second:.0f} instead of {first:.0f}, p = {probabilities(modes)[1]:.2g}). "
        "Merits include all such states; motions, move and files are those of the most probable one. Measurements in a "
        "second focus decide"
    ]


def _random(seed: int, number: int) -> np.random.Generator:
    return np.random.default_rng(stream(seed, number))


def require_consistency(bench: AsBuiltBench, state: StateEstimate) -> None:
    """Raise InputError if an estimate has not converged, or if measurements contradict each other.

    The error is placed at the measurement that agrees least with all others.
    """
    test = bench.test
    if not state.converged:
        problem = (
            f"the estimate has not converged after {state.steps} steps: one more changes the predicted readings by "
        )
        allowed = "a prior with smaller standard deviations, or a measurement of positions"
        raise test.error(f"{problem}{state.settled:.2g} of their errors", ("measurements",), allowed=allowed)
    if state.whole.chi_square <= WORST_FACTOR * max(1, state.whole.degrees):
        return
    worst = min(state.measurements, key=lambda c: (c.p_value, -c.chi_square / max(1, c.degrees)))
    key = next(kind.key for kind in bench.kinds if kind.name == worst.name)
    ratio = np.sqrt(state.whole.chi_square / state.whole.degrees)
    raise test.error(
        f"the measurements contradict each other: their residuals are {ratio:.0f} standard deviations on average, and "
        "this one fits worst",
        key,
        allowed="its true standard deviation, fields, sign and orientation (of wavefronts: `camtwin asbuilt check`)",
    )


def _quantiles(values: np.ndarray) -> tuple[float, ...]:
    known = values[np.isfinite(values)]
    return tuple(np.quantile(known, LEVELS).tolist()) if len(known) else (np.nan,) * len(LEVELS)


def _prediction(
    merit: Merit, nominal: np.ndarray, parts: Sequence[np.ndarray | None], truth: np.ndarray | None
) -> MeritPrediction:
    before, now, moved = (None if part is None else merit.values(part) for part in parts)
    assert before is not None
    assert now is not None
    return MeritPrediction(
        merit,
        float(merit.values(nominal)),
        _quantiles(before),
        _quantiles(now),
        float(np.mean(merit.passes(now))),
        () if moved is None else _quantiles(moved),
        np.nan if moved is None else float(np.mean(merit.passes(moved))),
        np.nan if truth is None else float(merit.values(truth)),
    )


def _along(bench: AsBuiltBench, cases: Sequence[tuple[np.ndarray, np.ndarray | None]]) -> tuple[np.ndarray, np.ndarray]:
    """Return the rms wavefront error along the line: nominal, and its quantiles over several sets of states.

    ``cases`` holds for each set the parameters of its states, and the amounts of a further move or None.
    """
    field = bench.bench({"along": MeritSpec(kind="wavefront", fields=ALONG, at_most=1.0)})

    def rms(values: np.ndarray, further: np.ndarray | None) -> np.ndarray:
        def work(rows: slice) -> np.ndarray:
            states = bench.parameters.states(values[rows], bench.last, selected_moves(further, rows))
            return np.asarray(np.sqrt(np.maximum(field.parts_of(states), 0.0)))

        return nan_where_lost(work, len(values), (len(ALONG),))

    designed = np.sqrt(np.maximum(field.parts_of([{}])[0], 0.0))
    return designed, np.stack([np.nanquantile(rms(*case), LEVELS, axis=0) for case in cases])


def _warnings(state: StateEstimate, now: np.ndarray) -> list[str]:
    out = []
    for name, block, consistency in state.excluded:
        out.append(
            f"{name}: {block} contradicts all other measurements (chi-square {consistency.chi_square:.0f} for "
            f"{consistency.degrees} degrees of freedom) and is excluded"
        )
    if not state.whole.passes():
        factor = np.sqrt(state.variance_factor)
        out.append(
            "the measurements do not agree with the prior and their specified errors (chi-square "
            f"{state.whole.chi_square:.0f} for {state.whole.degrees} degrees of freedom); all sigmas are "
            f"multiplied by {factor:.2g}"
        )
    for test in state.measurements:
        if not test.passes(len(state.measurements)):
            out.append(
                f"{test.name} does not agree with the prediction from all others: chi-square {test.chi_square:.0f} for "
                f"{test.degrees} degrees of freedom"
            )
    dark = int(np.sum(~np.all(np.isfinite(now), axis=1)))
    if dark:
        out.append(f"{dark} of {len(now)} states of the posterior have no light; they count as failed")
    return out


# numbers


def _row(values: Sequence[float], merit: Merit) -> dict[str, float | None] | None:
    if not len(values):
        return None
    return {f"p{100 * level:g}": shown_merit(value, merit) for level, value in zip(LEVELS, values, strict=True)}


def _prediction_plain(prediction: MeritPrediction) -> dict[str, Any]:
    merit = prediction.merit
    out = {
        "kind": merit.spec.kind,
        "unit": merit_unit(merit)[0],
        "requirement": shown_merit(merit.spec.requirement, merit),
        "designed": shown_merit(prediction.designed, merit),
        "prior": _row(prediction.before, merit),
        "as_built": _row(prediction.now, merit),
        "meets": prediction.meets,
        "after_move": _row(prediction.moved, merit),
        "meets_after_move": None if np.isnan(prediction.meets_moved) else prediction.meets_moved,
    }
    return out if np.isnan(prediction.true) else {**out, "true": shown_merit(prediction.true, merit)}


def _consistency_plain(test: ConsistencyTest) -> dict[str, Any]:
    return {"chi_square": test.chi_square, "degrees": test.degrees, "p_value": test.p_value}


def _measured_plain(run: AsBuiltRun) -> dict[str, Any]:
    out = {}
    count = len(run.estimate.measurements)
    for kind, test in zip(run.bench.kinds, run.estimate.measurements, strict=True):
        out[test.name] = {
            "kind": kind.kind,
            "numbers": len(kind.labels),
            **_consistency_plain(test),
            "agrees": test.passes(count),
            "excluded": [block for name, block, _ in run.estimate.excluded if name == test.name],
        }
    return out


def motions(run: AsBuiltRun) -> list[dict[str, Any]]:
    """Return the motions of the prior with their estimates and sigmas, in reporting units, as plain data."""
    out = []
    factor = np.sqrt(run.estimate.variance_factor)
    for k, component in enumerate(run.bench.parameters.components):
        size = component.unit_size
        row = {
            "motion": run.bench.parameters.words[k],
            "unit": component.unit,
            "prior_sigma": component.sigma / size,
            "value": float(run.estimate.mean[k]) / size,
            "sigma": float(run.estimate.sigma[k]) * factor / size,
        }
        out.append(row if run.true is None else {**row, "true": float(run.true[k]) / size})
    return out


def _known_plain(run: AsBuiltRun) -> list[dict[str, Any]]:
    factor = np.sqrt(run.estimate.variance_factor)
    return [
        {"combination": c.name, "value": c.value, "sigma": min(1.0, c.sigma * factor), "known": c.known}
        for c in run.known
    ]


def moves_plain(run: AsBuiltRun, amounts: np.ndarray) -> dict[str, Any]:
    """Return actuator name -> amount of its move as a quantity with unit, in the notation of a file.

    ``amounts`` holds the amounts of C actuators, (C,), SI units.
    """
    kinds = [number.kind for number in run.bench.parameters.actuators]
    names = run.bench.parameters.names
    return {name: amount_text(float(a), kind) for name, a, kind in zip(names, amounts, kinds, strict=True)}


def _advice_plain(run: AsBuiltRun) -> dict[str, Any] | None:
    step = run.advice
    if step is None:
        return None
    return {
        "move": moves_plain(run, step.move.amounts),
        "searched": step.move.searched,
        "merit_before": step.before,
        "merit_after": step.after,
        "merit_of_uncertainty": step.uncertainty,
        "merit_reductions": dict(step.merit_reductions),
    }


def responses(run: AsBuiltRun) -> dict[str, Any] | None:
    """Return the ratio of each uncertain actuator's estimated travel to the commanded one, with its sigma.

    The result is None if no actuator has an uncertain response.
    """
    start = len(run.bench.parameters.components)
    names = [run.bench.parameters.names[k] for k in run.bench.parameters.gains]
    if not names:
        return None
    rows = slice(start, start + len(names))
    mean, sigma = run.estimate.mean[rows], run.estimate.sigma[rows] * np.sqrt(run.estimate.variance_factor)
    return {
        name: {"response": 1.0 + float(m), "sigma": float(s)} for name, m, s in zip(names, mean, sigma, strict=True)
    }


def _modes_plain(run: AsBuiltRun) -> list[dict[str, Any]] | None:
    if len(run.modes) < 2:
        return None
    pairs = zip(run.modes, probabilities(run.modes), strict=True)
    return [{"probability": float(share), "chi_square": mode.whole.chi_square} for mode, share in pairs]


ASBUILT: Record[AsBuiltRun] = Record(
    "asbuilt.json: as-built state of one instrument.",
    Quantity("instrument", lambda run: run.setup.test.instrument),
    Quantity("camera", lambda run: run.bench.camera, "camera that is evaluated"),
    Quantity(
        "whole",
        lambda run: {**_consistency_plain(run.estimate.whole), "agrees": run.estimate.whole.passes()},
        "chi-square of all measurements together",
    ),
    Quantity("false_alarm", lambda run: FALSE_ALARM, "probability of a false contradiction"),
    Quantity("measurements", _measured_plain, "each compared with the prediction from all others"),
    Quantity("motions", motions, "each motion of the prior: its estimate and standard deviations"),
    Quantity("combinations", _known_plain, "in standard deviations of the prior, the best known first"),
    Quantity(
        "merits",
        lambda run: {prediction.merit.name: _prediction_plain(prediction) for prediction in run.predictions},
        "each in its unit, with quantiles in percent",
    ),
    Quantity("next_move", _advice_plain, "recommended move of the actuators", where_known=True),
    Quantity("responses", responses, "of the actuators, relative to the traced ones", where_known=True),
    Quantity("images", lambda run: run.images or None, "of stars", record=STAR, where_known=True),
    Quantity("modes", _modes_plain, "states that explain the measurements, the most probable first", where_known=True),
    Quantity("steps", lambda run: run.estimate.steps, "Gauss-Newton steps"),
    Quantity("settled", lambda run: run.estimate.settled, "change of the readings by the last step, in sigmas"),
)
