"""Computation of a tolerance budget: sensitivities, inverse limits, yield and allocation.

The yield is the fraction of random cameras that meet all requirements; the inverse limit of a tolerance is the size at
which it alone causes a merit's allowed loss.

Warnings about the instrument of a tolerance budget that other commands give too.

They concern cameras that are not sharp, parts of the instrument in a beam that the file does not model as obstructions,
coarse grey values, and bodies that move into beams of the monitor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from analysis.statistics import proportion_interval
from optics.geometry.tree import State
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from scenes.models.camera_sharpness import blur_warnings
from scenes.models.obstruction import moved_into_beams
from scenes.specs.job import JobSpec
from scenes.specs.load import is_path
from scenes.specs.tolerance import AllocationSpec, ToleranceBudgetSpec, ToleranceSetup, amount_text
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml
from twin.camera.first_order_data import obscuration, unmodelled_obscuration
from twin.framework.memory import Lowered, require_memory
from twin.framework.procedure import Advance, silent
from twin.framework.record import Quantity, Record
from twin.sensors.area_detector import coarse_warnings
from twin.tolerance import merit_models
from twin.tolerance.allocation import Allocation, allocate
from twin.tolerance.monitor_merit import Merit, merit_unit, shown_merit
from twin.tolerance.samples import Samples, Workforce, draw_parameters, draw_samples
from twin.tolerance.tolerance_bench import SETTLED, ToleranceBench
from twin.tolerance.variations import states_of

FAR = 1e-3
"""Relative error of a monitor's sigma due to interpolated derivatives above which a warning is given."""


def instrument_warnings(setup: ToleranceSetup, bench: ToleranceBench) -> tuple[str, ...]:
    """Return the warnings about the nominal instrument, such as unsharp cameras or parts in a beam."""
    model = bench.optics.model
    shadow = unmodelled_obscuration(model, obscuration(model, bench.backend))
    return (
        *blur_warnings(setup.base, bench.backend),
        *((f"camera {model.spec.name}: {shadow}",) if shadow else ()),
        *(coarse_warnings(setup.base) if bench.experiment.monitored else ()),
    )


def beam_warnings(bench: ToleranceBench, states: Sequence[State]) -> tuple[str, ...]:
    """Return warnings about bodies that block monitor beams in some random cameras, once for each body and beam.

    Parameters
    ----------
    bench : ToleranceBench
        Camera of the budget with its varied parameters, compensators and merits.
    states : sequence of State
        States of the worst cameras.
    """
    texts_by_body: dict[str, list[str]] = {}
    for state in states:
        for text in moved_into_beams(bench.instrument, bench.backend, state):
            texts_by_body.setdefault(text.partition(" and would take")[0], []).append(text)
    return tuple(
        f"in {len(texts)} of the {len(states)} worst cameras, {texts[0]}" for _, texts in sorted(texts_by_body.items())
    )


def interpolation_warnings(errors: Mapping[str, float], cameras: int) -> tuple[str, ...]:
    """Return warnings about monitor merits for which interpolated derivatives are too inaccurate.

    Parameters
    ----------
    errors : dict
        Name of a merit -> relative difference of its sigma from that with traced derivatives.
    cameras : int
        Number of cameras in which the derivatives were traced.
    """
    return tuple(
        f"{name}: with derivatives traced in {cameras} cameras the sigma differs by up to {100.0 * error:.2g} % from "
        "that with interpolated ones; use smaller limits, or twin.uncertainty on a job of one camera"
        for name, error in errors.items()
        if error > FAR
    )


CONFIDENCE = 0.95
"""Confidence level of the intervals in which the true yields lie."""
WORST = 10
"""Number of the worst random cameras that are written as job files."""
LEVELS = (0.5, 0.9, 0.95)
"""Fractions of cameras for which the quantiles of a merit are reported."""
_MORE = 7919
"""Number added to the seed for the independent cameras that validate an allocation."""
_MODEL = 104_729
"""Number added to the seed for the draws of the second-order model that give the shares of variance."""
_NOTHING = 1e-15
"""Amplitude of a motion, in metres or radians, below which it is rounding error."""
EXACT = 4
"""Number of cameras in which the monitor's derivatives are traced exactly, to check the interpolated ones."""
NEAR_MODEL = 0.05
"""Relative difference of a merit's quantile between model and traced cameras above which a warning is given."""
_PAIR, _DRAWN, _SHOWN, _MODELLED = 6.6e3, 32.0, 120.0, 40.0
"""Estimates of memory, in bytes.

They are for each pair of toleranced numbers in the second-order models; and, for each camera, for each toleranced
number, for each merit or compensator in the tables, and for each merit of the models.
"""


@dataclass(frozen=True)
class Yield:
    """Yield: fraction of cameras that pass, with its confidence interval.

    Attributes
    ----------
    passed : int
        Number of cameras that pass.
    of : int
        Number of all cameras.
    low, high : float
        Clopper-Pearson limits of the fraction, at ``CONFIDENCE``.
    """

    passed: int
    of: int
    low: float
    high: float

    @classmethod
    def count(cls, passing: np.ndarray) -> Yield:
        """Return the yield of S cameras; ``passing`` (S,) is True for each that passes."""
        passed, total = int(np.sum(passing)), len(passing)
        return cls(passed, total, *proportion_interval(passed, total, CONFIDENCE))

    @property
    def share(self) -> float:
        """Fraction of all cameras that pass."""
        return self.passed / self.of

    def judged(self, wanted: float) -> str:
        """Return ``met``, ``missed``, or ``open`` if the confidence interval contains the required yield ``wanted``."""
        return "met" if self.low >= wanted else "missed" if self.high < wanted else "open"


@dataclass(frozen=True, eq=False)
class MeritResult:
    """Distribution of a merit over all Monte Carlo cameras.

    Attributes
    ----------
    merit : Merit
        Merit whose distribution it is.
    nominal : float
        Value of the nominal camera, adjusted, SI units.
    mean, deviation : float
        Mean and standard deviation over the cameras, SI units.
    levels : tuple of float
        Values that the fractions ``LEVELS`` of the cameras do not exceed (for an MTF: exceed), SI units.
    linear, quadratic : tuple of float
        Quantiles at ``LEVELS`` by the first-order and by the second-order model, SI units.
    passing : Yield
        Fraction of cameras that meet the requirement.
    model_passing : tuple of float
        Fraction of cameras that meet the requirement, by the first-order and by the second-order model.
    shares, share_errors : dict
        Tolerance -> fraction of the merit's variance that vanishes without it, by many draws of the second-order model,
        and its standard error.
    """

    merit: Merit
    nominal: float
    mean: float
    deviation: float
    levels: tuple[float, ...]
    linear: tuple[float, ...]
    quadratic: tuple[float, ...]
    passing: Yield
    model_passing: tuple[float, float]
    shares: Mapping[str, float]
    share_errors: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class ToleranceRun:
    """Tolerance budget and its results.

    Attributes
    ----------
    setup : ToleranceSetup
        Tolerance budget.
    bench : ToleranceBench
        Camera of the budget with its varied parameters, compensators and merits.
    sensitivity : Sensitivities
        Sensitivities and the model of the merits.
    inverse : InverseLimits
        Size of each tolerance that alone causes each merit's allowed loss.
    samples : Samples
        Monte Carlo cameras.
    merits : tuple of MeritResult
        Distribution of each merit over these cameras.
    passing : Yield
        Fraction of cameras that meet all requirements.
    allocation : Allocation or None
        Allocated limits; None if no allocation is requested.
    judged : Yield or None
        Fraction of independent cameras with the allocated limits that meet all requirements; None without an
        allocation.
    jobs : dict
        Worst cameras as files of jobs, by name.
    warnings : tuple of str
        Warnings for the user.
    interpolation_errors : dict
        Merit of the monitor -> largest relative difference of its sigma from that with derivatives traced in the camera
        itself, in the first ``EXACT`` cameras.
    """

    setup: ToleranceSetup
    bench: ToleranceBench
    sensitivity: merit_models.Sensitivities
    inverse: merit_models.InverseLimits
    samples: Samples
    merits: tuple[MeritResult, ...]
    passing: Yield
    allocation: Allocation | None
    judged: Yield | None
    jobs: Mapping[str, str]
    warnings: tuple[str, ...]
    interpolation_errors: Mapping[str, float] = field(default_factory=FrozenMap)


def run_tolerance(
    setup: ToleranceSetup,
    backend: Backend,
    seed: int | None = None,
    advance: Advance = silent,
    force: Workforce | None = None,
) -> ToleranceRun:
    """Compute a tolerance budget: sensitivities, inverse limits, Monte Carlo cameras, yield and allocation.

    Parameters
    ----------
    setup : ToleranceSetup
        Tolerance budget.
    backend : Backend
        Array backend of the ray trace.
    seed : int, optional
        Seed of the random numbers; the budget's by default.
    advance : Advance
        Callback that reports progress.
    force : Workforce, optional
        Processes that trace the cameras; this process alone by default.

    Raises
    ------
    InputError
        A name does not exist, the nominal camera has no light at a field, or the memory does not suffice.
    RunFolderError, Incomplete
        The folder of finished work belongs to a different run or cannot be written, or the workers could not finish all
        runs.
    """
    test, force = setup.test, force or Workforce()
    # each message once, although the cameras and those that judge an allocation both give it
    engine_warnings: dict[str, None] = {}

    def warn(text: str, further: Callable[[str], None] = force.warn) -> None:
        engine_warnings[text] = None
        further(text)

    force = replace(force, warn=warn)
    seed = test.seed if seed is None else seed
    _require_memory(test)
    bench = ToleranceBench(setup, backend)
    input_warnings = instrument_warnings(setup, bench)
    sensitivity = merit_models.sensitivities(bench, advance)
    _require_light(setup, sensitivity)
    inverse = merit_models.inverse_limits(bench, sensitivity, advance)
    samples = draw_samples(setup, bench, backend, test.samples, seed, force, "cameras", advance)
    passing = bench.passing(samples.values)
    orders = (sensitivity.model.linear, sensitivity.model.quadratic)
    models = [bench.values(order(samples.x)) for order in orders]
    many = draw_parameters(setup, bench, merit_models.model_draws(bench, sensitivity.model), seed + _MODEL)
    shares = merit_models.VarianceShares.of(bench, sensitivity.model, many)
    merits = tuple(
        _merit_result(bench, sensitivity, samples, models, shares, m, passing[:, m]) for m in range(len(bench.merits))
    )
    allocation, judged = None, None
    if test.allocation is not None:
        allocation = allocate(setup, bench, sensitivity.model, samples, test.allocation, advance)
        judged = _validated_yield(setup, backend, allocation, seed, force, advance)
    missed = _interpolation_errors(bench, samples)
    warnings = (
        *input_warnings,
        *engine_warnings,
        *beam_warnings(bench, _states(bench, samples, worst_cameras(bench, samples))),
        *_warnings(bench, sensitivity, samples, merits, allocation, judged, test.allocation),
        *interpolation_warnings(missed, EXACT),
    )
    computed = (sensitivity, inverse, samples, merits, Yield.count(np.all(passing, axis=-1)), allocation, judged)
    jobs = FrozenMap(worst_jobs(setup, bench, samples))
    return ToleranceRun(setup, bench, *computed, jobs, warnings, FrozenMap(missed))


def _amounts(bench: ToleranceBench, samples: Samples, rows: np.ndarray) -> np.ndarray:
    """Return the amounts of the K parameters and compensators of W selected cameras, (W, K), SI units.

    ``rows`` selects the cameras.
    """
    return np.concatenate([samples.x[rows] * bench.sizes, np.nan_to_num(samples.moves[rows])], axis=1)


def _states(bench: ToleranceBench, samples: Samples, rows: np.ndarray) -> list[State]:
    """Return the states of selected cameras, with their tolerances' motions and their adjustments."""
    return states_of((*bench.numbers, *bench.compensators), _amounts(bench, samples, rows))


def worst_cameras(bench: ToleranceBench, samples: Samples) -> np.ndarray:
    """Return the indices of the cameras with the largest excess over a requirement, the worst first."""
    return np.argsort(-bench.worst_margins(samples.values), kind="stable")[:WORST]


def _interpolation_errors(bench: ToleranceBench, samples: Samples) -> dict[str, float]:
    """Return the largest relative error of each merit's sigma due to interpolated derivatives, in the first cameras."""
    known = np.flatnonzero(np.all(np.isfinite(samples.values), axis=1))[:EXACT]
    if bench.monitor is None or not known.size:
        return {}
    return bench.monitor.interpolation_errors(_amounts(bench, samples, known), _states(bench, samples, known))


def _require_memory(test: ToleranceBudgetSpec) -> None:
    numbers = sum(max(1, len(tolerance.spectrum)) for tolerance in test.tolerances.values())
    merits = len(test.merits)
    camera = numbers * _DRAWN + (merits + len(test.compensators)) * _SHOWN + merits * _MODELLED
    pairs = numbers**2 * _PAIR
    require_memory(Lowered(test, ("samples",), test.samples, "samples", lambda count: pairs + count * camera, 20))


def _require_light(setup: ToleranceSetup, sensitivity: merit_models.Sensitivities) -> None:
    if not np.all(np.isfinite(sensitivity.nominal)):
        raise setup.test.error("the designed camera has no light at these fields", ("merits",))


def with_limits(setup: ToleranceSetup, limits: Mapping[str, str | float]) -> ToleranceSetup:
    """Return a budget with new tolerance limits, given by name, instead of its own."""
    entries = {
        name: tolerance.model_copy(update={"limit": limits.get(name, tolerance.limit)})
        for name, tolerance in setup.test.tolerances.items()
    }
    return setup.model_copy(update={"test": setup.test.model_copy(update={"tolerances": FrozenMap(entries)})})


def _validated_yield(
    setup: ToleranceSetup, backend: Backend, allocation: Allocation, seed: int, force: Workforce, advance: Advance
) -> Yield:
    """Return the yield of the allocated limits over new random cameras, independent of those of the allocation."""
    other = with_limits(setup, allocation.limits)
    bench = ToleranceBench(other, backend)
    drawn = draw_samples(other, bench, backend, setup.test.samples, seed + _MORE, force, "allocated", advance)
    return Yield.count(np.all(bench.passing(drawn.values), axis=-1))


def _merit_result(
    bench: ToleranceBench,
    sensitivity: merit_models.Sensitivities,
    samples: Samples,
    models: Sequence[np.ndarray],
    shares: merit_models.VarianceShares,
    m: int,
    passing: np.ndarray,
) -> MeritResult:
    merit = bench.merits[m]
    values = samples.values[:, m]
    good = values[np.isfinite(values)]
    sign = -1.0 if merit.spec.more_is_better else 1.0

    def levels(column: np.ndarray) -> tuple[float, ...]:
        known = sign * column[np.isfinite(column)]
        return tuple(float(sign * np.quantile(known, share)) for share in LEVELS) if len(known) else (np.nan,) * 3

    by_model = [values_by_model[:, m] for values_by_model in models]
    return MeritResult(
        merit,
        float(sensitivity.nominal[m]),
        float(np.mean(good)) if len(good) else np.nan,
        float(np.std(good)) if len(good) else np.nan,
        levels(values),
        levels(by_model[0]),
        levels(by_model[1]),
        Yield.count(passing),
        (float(np.mean(merit.passes(by_model[0]))), float(np.mean(merit.passes(by_model[1])))),
        FrozenMap(zip(bench.entries, shares.values[:, m].tolist(), strict=True)),
        FrozenMap(zip(bench.entries, shares.errors[:, m].tolist(), strict=True)),
    )


def _warnings(
    bench: ToleranceBench,
    sensitivity: merit_models.Sensitivities,
    samples: Samples,
    merits: tuple[MeritResult, ...],
    allocation: Allocation | None,
    judged: Yield | None,
    spec: AllocationSpec | None,
) -> list[str]:
    out = []
    reasons = [problem for problem in samples.problems if problem]
    if reasons:
        out.append(f"{len(reasons)} of {len(samples.problems)} cameras have no light and count as failed: {reasons[0]}")
    for name, problem in zip(bench.entries, sensitivity.problems, strict=True):
        if problem:
            out.append(f"tolerance {name}: no light at its limit ({problem}), so the models do not include it")
    unsettled = int(np.sum(samples.settled > SETTLED))
    if unsettled:
        out.append(
            f"the adjustments of {unsettled} cameras have not converged: their merits may be better than reported"
        )
    if not sensitivity.model.paired and len(bench.numbers) > 1:  # one has no mixed terms
        out.append(f"{len(bench.numbers)} parameters vary: the second order omits their mixed terms")
    for result in merits:
        level = result.levels[1]
        for order, modelled in (("first", result.linear[1]), ("second", result.quadratic[1])):
            difference = abs(modelled - level) / max(abs(level), 1e-30)
            if difference > NEAR_MODEL:
                kind = "linear" if order == "first" else "quadratic"
                out.append(
                    f"{result.merit.name}: the {100 * LEVELS[1]:.0f} % quantile of the {kind} model differs by "
                    f"{100 * difference:.0f} % from that of the exact traces; do not use {order}-order derivatives for "
                    "it"
                )
    stuck = bench.ranges > 0.0
    at_end = np.abs(samples.moves) >= 0.999 * bench.ranges
    for c in np.flatnonzero(stuck & np.any(at_end, axis=0)):
        share = float(np.mean(at_end[:, c]))
        out.append(
            f"compensator {bench.compensators[c].name} is at the end of its range in {100 * share:.1f} % of the cameras"
        )
    if allocation is not None and judged is not None and spec is not None:
        out += _allocation_warnings(allocation, judged, spec)
    return out


def _allocation_warnings(allocation: Allocation, judged: Yield, spec: AllocationSpec) -> list[str]:
    """Return warnings about limits that miss the required yield, or a model that disagrees with exact traces."""
    out = []
    if not allocation.reached and allocation.unrounded:
        out.append(
            f"the limits rounded to the grades do not reach a yield of {100 * spec.target:.0f} % (by the model "
            f"{100 * allocation.predicted[1]:.1f} %), but those before rounding do: use more grades"
        )
    elif not allocation.reached:
        out.append(
            f"no limits up to {spec.tightest:g} times tighter reach a yield of "
            f"{100 * spec.target:.0f} %: those of the table have {100 * allocation.predicted[1]:.1f} % by the model"
        )
    if not judged.low <= allocation.predicted[1] <= judged.high:
        out.append(
            f"with the allocated limits {100 * judged.share:.1f} % of independent cameras pass, against "
            f"{100 * allocation.predicted[1]:.1f} % by the model: trust the exact traces"
        )
    return out


def worst_jobs(setup: ToleranceSetup, bench: ToleranceBench, samples: Samples) -> dict[str, str]:
    """Return the worst cameras as jobs for ``python -m twin.render`` and ``twin.camera``, the worst first."""
    worst = worst_cameras(bench, samples)
    out = {}
    for rank, (s, state) in enumerate(zip(worst, _states(bench, samples, worst), strict=True)):
        perturb = {path: _perturb(motion) for path, motion in state.items()}
        data: dict[str, Any] = {
            "instrument": _reference(setup),
            "perturb": {path: perturbation for path, perturbation in perturb.items() if perturbation},
        }
        data |= {key: _short(value) for key, value in setup.test.plain().items() if key == "disturbances"}
        number = f"worst_{rank + 1:02d}"
        out[number] = _job_text(data, int(s), setup)
    return out


def _short(disturbances: dict[str, Any]) -> Any:
    """Return disturbances in the notation of a file: only the name of a library file if its content is unchanged."""
    changed = {key: value for key, value in disturbances.items() if value}
    return changed["file"] if changed.keys() == {"file"} else changed


def _reference(setup: ToleranceSetup) -> str:
    """Return the text by which a job in a different folder refers to the instrument: its name or absolute path."""
    named = setup.test.instrument
    path = (Path(setup.test.source.file).parent / named).resolve()
    return str(path) if is_path(named) and path.is_file() else named


def _perturb(motion: Any) -> dict[str, Any]:
    """Return a motion of a body as an entry of the section ``perturb`` of a job's file."""
    out: dict[str, Any] = {}
    for kind in ("rotate", "shift"):
        values = [value if abs(value) > _NOTHING else 0.0 for value in getattr(motion, kind)]
        if any(values):
            out[kind] = [amount_text(value, kind) for value in values]
    if any(motion.figure.values()):
        out["figure"] = {f"Z{j}": amount_text(value, "figure") for j, value in motion.figure.items() if value}
    for kind in ("radius", "conic", "index", "abbe"):
        if getattr(motion, kind):
            out[kind] = amount_text(getattr(motion, kind), kind)
    return out


def _job_text(data: dict[str, Any], number: int, setup: ToleranceSetup) -> str:
    try:
        JobSpec.model_validate(data)
    except (InputError, ValueError) as error:  # a motion larger than a job may say
        reason = " ".join(str(error).split())[:200]
        return f"# Camera {number} of the tolerance budget cannot be written as a job: {reason}\n"
    head = f"# Camera {number} of the tolerance budget of {setup.test.instrument}, with its adjustments\n"
    return head + dump_yaml(data)


def _yield_plain(passing: Yield) -> dict[str, Any]:
    return {"share": passing.share, "passed": passing.passed, "of": passing.of, "interval": [passing.low, passing.high]}


def _merit_plain(result: MeritResult, missed: float | None = None) -> dict[str, Any]:
    merit = result.merit

    def row(values: tuple[float, ...]) -> dict[str, float | None]:
        return {f"p{100 * share:.0f}": shown_merit(value, merit) for share, value in zip(LEVELS, values, strict=True)}

    return {
        "kind": merit.spec.kind,
        "unit": merit_unit(merit)[0],
        "requirement": shown_merit(merit.spec.requirement, merit),
        "probability": merit.spec.probability,
        "nominal": shown_merit(result.nominal, merit),
        "mean": shown_merit(result.mean, merit),
        "std": shown_merit(result.deviation, merit),
        "monte_carlo": row(result.levels),
        "linear": row(result.linear),
        "quadratic": row(result.quadratic),
        "yield": _yield_plain(result.passing),
        "yield_linear": result.model_passing[0],
        "yield_quadratic": result.model_passing[1],
        "judged": result.passing.judged(merit.spec.probability),
        "variance_shares": dict(result.shares),
        "variance_shares_error": dict(result.share_errors),
        **({} if missed is None else {"interpolation_error": missed}),
    }


def _tolerance_plain(run: ToleranceRun) -> dict[str, Any]:
    out = {}
    bench = run.bench
    for e, (name, tolerance) in enumerate(run.setup.test.tolerances.items()):
        below, above = (
            {m.name: shown_merit(float(run.sensitivity.values[e, end, k]), m) for k, m in enumerate(bench.merits)}
            for end in (0, 1)
        )
        share = run.inverse.shares[e]
        out[name] = {
            "motion": tolerance.words,
            "limit": tolerance.limit,
            "at_minus": below,
            "at_plus": above,
            "moves_at_minus": _moves_at(run, e, 0),
            "moves_at_plus": _moves_at(run, e, 1),
            "share_for_loss": {
                m.name: (float(share[k]) if np.isfinite(share[k]) else None) for k, m in enumerate(bench.merits)
            },
        }
        if run.allocation is not None:
            out[name]["allocated"] = run.allocation.limits[name]
    return out


def _moves_at(run: ToleranceRun, entry: int, end: int) -> dict[str, str | float | None]:
    """Return the move of each compensator (quantity with unit) with a tolerance at its lower or upper limit.

    The moves are None for a figure error.
    """
    moves = run.sensitivity.moves[entry, end].tolist()
    return {
        compensator.name: amount_text(move, compensator.kind) if np.isfinite(move) else None
        for compensator, move in zip(run.bench.compensators, moves, strict=True)
    }


def _allocation_plain(run: ToleranceRun) -> dict[str, Any] | None:
    allocation = run.allocation
    if allocation is None or run.judged is None:
        return None
    return {
        "reached": allocation.reached,
        "reached_unrounded": allocation.unrounded,
        "cost_before": allocation.cost[0],
        "cost_after": allocation.cost[1],
        "yield_predicted_before": allocation.predicted[0],
        "yield_predicted": allocation.predicted[1],
        "yield": _yield_plain(run.judged),
        "limits": dict(allocation.limits),
    }


def _moves_plain(run: ToleranceRun) -> dict[str, Any]:
    out = {}
    for c, number in enumerate(run.bench.compensators):
        moves = run.samples.moves[:, c]
        moves = moves[np.isfinite(moves)]
        spread = float(np.std(moves)) if len(moves) else 0.0
        largest = float(np.max(np.abs(moves))) if len(moves) else 0.0
        out[number.name] = {
            "motion": run.setup.test.compensators[number.name].motion,
            "std": amount_text(spread, number.kind),
            "largest": amount_text(largest, number.kind),
        }
    return out


TOLERANCE: Record[ToleranceRun] = Record(
    "tolerance.json: a tolerance budget.",
    Quantity("instrument", lambda run: run.setup.test.instrument),
    Quantity("camera", lambda run: run.bench.camera, "camera that is evaluated"),
    Quantity("wavelengths_nm", lambda run: run.bench.colours, "wavelengths of wavefronts and MTFs"),
    Quantity("weights", lambda run: run.bench.shares, "weight of each of these wavelengths"),
    Quantity("samples", lambda run: len(run.samples.problems), "number of Monte Carlo cameras"),
    Quantity("lost", lambda run: sum(map(bool, run.samples.problems)), "cameras without light, which count as failed"),
    Quantity("yield", lambda run: _yield_plain(run.passing), "share of cameras that meet all requirements"),
    Quantity(
        "merits",
        lambda run: {
            result.merit.name: _merit_plain(result, run.interpolation_errors.get(result.merit.name))
            for result in run.merits
        },
        "each in its unit; p90 is the value that 90 % of the cameras keep",
    ),
    Quantity(
        "tolerances",
        _tolerance_plain,
        "merits with each at its limits, and the ratio to its limit that causes the loss",
    ),
    Quantity("compensators", _moves_plain, "standard deviation and largest of their moves"),
    Quantity(
        "losses",
        lambda run: {m.name: shown_merit(float(run.inverse.losses[k]), m) for k, m in enumerate(run.bench.merits)},
        "loss of each merit for the inverse limits",
    ),
    Quantity("allocation", _allocation_plain, "allocated limits", where_known=True),
    Quantity(
        "unsettled_waves",
        lambda run: float(np.nanmax(run.samples.settled)),
        "largest change of the rms wavefront error by a further step of the adjustments",
    ),
)
