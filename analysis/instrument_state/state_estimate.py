"""The state of an instrument from everything that was measured on it: Bayesian least squares on an exact model.

A state is an amount for each of M motions with a joint normal prior, x = m + G u with u ~ N(0, I). Measurements are
groups of numbers y = h(x) + B b + e: h is the traced instrument, e ~ N(0, R), and b are biases of the instrument of
measurement, free or with a prior of their own. Each group is whitened and its free biases are projected out. The
estimate is the mode of the posterior distribution, found by Gauss-Newton steps on the exact h; its covariance is that
of the linearisation there (Tarantola, Inverse Problem Theory, 2005, sec. 3.4). With a linear h and one group of monitor
spots it is the best linear unbiased prediction of ``analysis.monitor.disturbances``.

Which combinations of motions measurements know, and which they do not: the benign subspace of an instrument.

Few combinations of many small motions show in a wavefront (Schechter & Levinson, PASP 123, 812, 2011). In independent
units of the prior, measurements with whitened derivatives J know the right singular vectors of J: the standard
deviation along a vector falls from 1 to 1/sqrt(1 + s^2), s its singular value.

The next move of an instrument's actuators, and what one more measurement would be worth before it is made.

A merit is the sum of squares of numbers that change linearly with small motions: r = r0 + D x + A a, of a state x of
which a posterior is known and moves a. Its expectation is |E r|^2 + tr(D P D'), so that of all moves the one that makes
|r0 + D E x + A a|^2 least is best. A move of relative error e adds e^2 |A_k a_k|^2. Moves by whole steps are found by
branch and bound (Land & Doig, Econometrica 28, 497, 1960).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.optimize import lsq_linear

from analysis.arrays import Array, UndeterminedError, shows
from analysis.statistics import chance_beyond, limit_of
from optics.numerics.array_math import covariance_root

Predict = Callable[[Array], Array]
"""States (S, M), SI -> what the measurements would read without errors, (S, D), group after group; NaN where the light
is lost."""
Slope = Callable[[Array], Array]
"""One state (M,) -> derivatives (D, M) of what the measurements read."""

FALSE_ALARM = 1e-3
"""Chance that measurements which are as stated are called a contradiction."""
SETTLED = 0.01
"""Change of the predicted measurements by the last step, in standard deviations of each."""
MOST_STEPS = 20
_SHORTEST = 2.0**-8
_MOST_LEFT_OUT = 1.0 / 3.0
"""Share of a group's blocks that are left out at most: of more the measurement itself is in doubt."""
_NO_RANK = 1e-9


@dataclass(frozen=True, eq=False)
class StatePrior:
    """What is known of a state before anything is measured.

    Attributes
    ----------
    labels : tuple[str, ...]
        (M,) names of the motions.
    mean : Array
        (M,) SI.
    root : Array
        G, (M, U), SI; the covariance is G G'.
    """

    labels: tuple[str, ...]
    mean: Array
    root: Array

    @classmethod
    def of(cls, labels: Sequence[str], covariance: Array, mean: Array | None = None) -> StatePrior:
        """Prior of a covariance.

        Parameters
        ----------
        labels : Sequence[str]
            Names of the motions, (M,).
        covariance : Array
            (M, M), SI, positive semidefinite.
        mean : Array | None
            (M,), SI; zero by default.
        """
        mean = np.zeros(len(covariance)) if mean is None else np.asarray(mean, np.float64)
        return cls(tuple(labels), mean, covariance_root(covariance))

    @cached_property
    def sigma(self) -> Array:
        """(M,) standard deviations, SI."""
        return np.asarray(np.sqrt(np.sum(self.root**2, axis=1)))

    @property
    def covariance(self) -> Array:
        """(M, M) SI."""
        return np.asarray(self.root @ self.root.T)


@dataclass(frozen=True, eq=False)
class MeasuredGroup:
    """Numbers of one measurement.

    Attributes
    ----------
    name : str
        Of the measurement.
    kind : str
        What was measured: ``wavefronts``, ``focus`` ...
    labels : tuple[str, ...]
        (D,) of the numbers.
    values : Array
        (D,) SI.
    covariance : Array
        (D, D) of their errors, SI.
    biases : Array
        (D, B) what one unit of each bias does to the numbers.
    bias_sigmas : Array
        (B,) standard deviations of the biases; infinite for a free one.
    blocks : tuple[str, ...]
        (D,) name of what one gross error would spoil together, such as a field.
    """

    name: str
    kind: str
    labels: tuple[str, ...]
    values: Array
    covariance: Array
    biases: Array
    bias_sigmas: Array
    blocks: tuple[str, ...]

    def __post_init__(self) -> None:
        """Check shapes. Raises ValueError."""
        count = len(self.values)
        if self.covariance.shape != (count, count) or self.biases.shape != (count, len(self.bias_sigmas)):
            raise ValueError(f"measurement {self.name}: covariance or biases are not those of {count} numbers")
        if len(self.labels) != count or len(self.blocks) != count:
            raise ValueError(f"measurement {self.name}: {count} numbers need as many labels and blocks")

    def with_values(self, values: Array) -> MeasuredGroup:
        """The same measurement with other numbers (D,)."""
        return MeasuredGroup(
            self.name, self.kind, self.labels, values, self.covariance, self.biases, self.bias_sigmas, self.blocks
        )

    def whitener(self, without: Sequence[str] = ()) -> Array:
        """W (R, D) by which errors become independent with unit variance and free biases vanish.

        Parameters
        ----------
        without : Sequence[str]
            Blocks that are left out.

        Raises
        ------
        UndeterminedError
            The covariance is not positive definite.
        """
        kept = np.array([block not in without for block in self.blocks])
        out = np.zeros((0, len(self.values)))
        if not kept.any():
            return out
        own, free = self.biases[kept], np.isinf(self.bias_sigmas)
        known = own[:, ~free] * self.bias_sigmas[~free]
        spread = self.covariance[np.ix_(kept, kept)] + known @ known.T
        scale = np.sqrt(np.diagonal(spread))
        if not np.all(scale > 0.0):
            raise UndeterminedError(f"measurement {self.name}: an error of zero")
        try:
            root = scale[:, None] * np.linalg.cholesky(spread / scale / scale[:, None])
        except np.linalg.LinAlgError as error:
            raise UndeterminedError(f"measurement {self.name}: its covariance is not positive definite") from error
        white = np.linalg.inv(root)
        if free.any():
            u, s, _ = np.linalg.svd(white @ own[:, free])
            rank = int(np.sum(s > _NO_RANK * s[0])) if s.size and s[0] > 0.0 else 0
            white = u[:, rank:].T @ white
        out = np.zeros((len(white), len(self.values)))
        out[:, kept] = white
        return out


@dataclass(frozen=True)
class Agreement:
    """Do some numbers agree with what all others, the prior and the instrument predict of them?

    Attributes
    ----------
    name : str
        Of a measurement, or of one of its blocks.
    chi_square : float
        Of the numbers about their prediction from all others.
    degrees : int
        Of freedom.
    chance : float
        Probability of so large a chi-square if everything is as stated.
    """

    name: str
    chi_square: float
    degrees: int
    chance: float

    @classmethod
    def of(cls, name: str, chi_square: float, degrees: int) -> Agreement:
        """Chance of a chi-square; of no degrees of freedom nothing is told."""
        chance = float(chance_beyond(chi_square, degrees)) if degrees else 1.0
        return cls(name, float(chi_square), degrees, chance)

    def holds(self, looks: int = 1, false_alarm: float = FALSE_ALARM) -> bool:
        """Whether it agrees, as one of so many that are tested together."""
        return not self.degrees or self.chi_square <= float(limit_of(false_alarm / max(1, looks), self.degrees))


@shows("prior.labels", "measurements", "whole")
@dataclass(frozen=True, eq=False)
class StateEstimate:
    """The state after the measurements.

    Attributes
    ----------
    prior : StatePrior
        Before them.
    groups : tuple[MeasuredGroup, ...]
        The measurements.
    unit : Array
        u, (U,), the estimate in the prior's independent units.
    root : Array
        Posterior covariance of u is root root', (U, U).
    slope : Array
        Whitened derivatives of all measurements by u at the estimate, (R, U).
    residual : Array
        Whitened, (R,).
    whole : Agreement
        Chi-square of everything together.
    measurements : tuple[Agreement, ...]
        Of each measurement, as all others predict it.
    blocks : dict[str, tuple[Agreement, ...]]
        Of each block of each measurement, likewise: name of the measurement -> agreements.
    left_out : tuple[tuple[str, str, Agreement], ...]
        Blocks that were left out since they contradict all else: (measurement, block, agreement then).
    steps : int
        Gauss-Newton steps that were taken.
    settled : float
        Change of the predicted measurements by the last step, in standard deviations.
    """

    prior: StatePrior
    groups: tuple[MeasuredGroup, ...]
    unit: Array
    root: Array
    slope: Array
    residual: Array
    whole: Agreement
    measurements: tuple[Agreement, ...]
    blocks: dict[str, tuple[Agreement, ...]] = field(default_factory=dict)
    left_out: tuple[tuple[str, str, Agreement], ...] = ()
    steps: int = 0
    settled: float = 0.0

    @property
    def converged(self) -> bool:
        """Whether the last step changed the predicted measurements by less than ``SETTLED``."""
        return self.settled < SETTLED

    @cached_property
    def mean(self) -> Array:
        """(M,) SI."""
        return np.asarray(self.prior.mean + self.prior.root @ self.unit)

    @cached_property
    def spread(self) -> Array:
        """(M, U): the posterior covariance is spread spread', SI."""
        return np.asarray(self.prior.root @ self.root)

    @property
    def covariance(self) -> Array:
        """(M, M) SI."""
        return np.asarray(self.spread @ self.spread.T)

    @property
    def sigma(self) -> Array:
        """(M,) SI."""
        return np.asarray(np.sqrt(np.sum(self.spread**2, axis=1)))

    @property
    def variance_factor(self) -> float:
        """Chi-square over its degrees of freedom where everything together contradicts what is stated, else 1."""
        return 1.0 if self.whole.holds() else self.whole.chi_square / self.whole.degrees

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Random states of the posterior, (count, M), SI; wider where the measurements contradict what is stated.

        Parameters
        ----------
        rng : np.random.Generator
            Their source.
        count : int
            How many.
        """
        unit = rng.standard_normal((count, self.root.shape[1])) * np.sqrt(self.variance_factor)
        return np.asarray(self.mean + unit @ self.spread.T)


def estimate_state(
    prior: StatePrior, groups: Sequence[MeasuredGroup], predict: Predict, slope: Slope, start: Array | None = None
) -> StateEstimate:
    """Estimate a state.

    A block of numbers that contradicts everything else at the chance of a false alarm, shared among all blocks, is left
    out and the estimate is made again (data snooping: Baarda, A testing procedure for use in geodetic networks, 1968).

    Parameters
    ----------
    prior : StatePrior
        What is known before.
    groups : Sequence[MeasuredGroup]
        Measurements, in the order of the predictions.
    predict : Predict
        States -> what the measurements would read.
    slope : Slope
        One state -> derivatives of that.
    start : Array | None
        State from which the steps go, (M,), SI; the prior's mean by default.

    Raises
    ------
    UndeterminedError
        No number, a covariance that is none, or no light at the prior's mean.
    """
    if not groups:
        raise UndeterminedError("nothing was measured")
    unit: Array = np.zeros(prior.root.shape[1])
    if start is not None:
        unit = np.asarray(np.linalg.lstsq(prior.root, start - prior.mean, rcond=None)[0], np.float64)
    out: dict[str, list[str]] = {}
    left_out: list[tuple[str, str, Agreement]] = []
    count = len({(g.name, b) for g in groups for b in g.blocks})
    while True:
        found = _settle(prior, groups, predict, slope, unit, out)
        unit = found.unit
        worst = min(
            ((one.chance, group.name, one) for group in groups for one in found.blocks[group.name]),
            key=lambda entry: (entry[0], -entry[2].chi_square),
            default=None,
        )
        if worst is None or worst[2].holds(count):
            break
        _, name, agreement = worst
        own = next(group for group in groups if group.name == name)
        blocks = len(set(own.blocks))
        if len(out.get(name, ())) + 1 > _MOST_LEFT_OUT * blocks:
            break
        out.setdefault(name, []).append(agreement.name)
        left_out.append((name, agreement.name, agreement))
    fields = {key: getattr(found, key) for key in found.__dataclass_fields__}
    return StateEstimate(**fields | {"left_out": tuple(left_out)})


def _settle(
    prior: StatePrior,
    groups: Sequence[MeasuredGroup],
    predict: Predict,
    slope: Slope,
    unit: Array,
    out: dict[str, list[str]],
) -> StateEstimate:
    """Gauss-Newton steps from one estimate to the next, without what is left out."""
    whiteners = [group.whitener(out.get(group.name, ())) for group in groups]
    values = np.concatenate([group.values for group in groups])

    def whitened(rows: Array) -> Array:
        """Of numbers (D, ...) the whitened ones (R, ...)."""
        ends = np.cumsum([0, *(len(group.values) for group in groups)])
        return np.concatenate([w @ rows[a:b] for w, a, b in zip(whiteners, ends[:-1], ends[1:], strict=True)])

    def residual_at(u: Array) -> Array:
        return whitened(values - predict((prior.mean + prior.root @ u)[None])[0])

    residual = residual_at(unit)
    if not np.all(np.isfinite(residual)) and np.any(unit):
        unit = np.zeros_like(unit)
        residual = residual_at(unit)
    if not np.all(np.isfinite(residual)):
        raise UndeterminedError("the instrument has no light where the prior expects it")
    moved, steps = np.inf, 0
    while True:
        table = whitened(slope(prior.mean + prior.root @ unit) @ prior.root)
        normal = np.eye(len(unit)) + table.T @ table
        if moved < SETTLED or steps >= MOST_STEPS:
            break
        step = np.linalg.solve(normal, table.T @ residual - unit)
        cost = residual @ residual + unit @ unit
        share = 1.0
        while True:
            trial = unit + share * step
            ahead = residual_at(trial)
            good = bool(np.all(np.isfinite(ahead))) and ahead @ ahead + trial @ trial <= cost * (1.0 + 1e-12)
            if good or share < _SHORTEST:
                break
            share *= 0.5
        steps += 1
        moved = float(np.max(np.abs(table @ step), initial=0.0))
        if not good:
            # no way down along the step: the estimate stands, and what is left of the step says how well
            moved = moved if moved < SETTLED else max(moved, SETTLED)
            break
        unit, residual = np.asarray(trial), ahead
        moved = max(moved * share, 0.0) if share == 1.0 else np.inf
    return _judged(prior, groups, whiteners, unit, table, residual, steps, moved)


def _judged(
    prior: StatePrior,
    groups: Sequence[MeasuredGroup],
    whiteners: Sequence[Array],
    unit: Array,
    table: Array,
    residual: Array,
    steps: int,
    moved: float,
) -> StateEstimate:
    """Posterior covariance and all tests at an estimate."""
    values, vectors = np.linalg.eigh(table.T @ table)
    # the symmetric root, since states are drawn with it: eigenvectors of equal eigenvalues depend on rounding
    root = (vectors / np.sqrt(1.0 + np.clip(values, 0.0, None))) @ vectors.T
    left = table @ root
    # to the first order this is the residual's inverse marginal covariance, times the residual about the prior's mean
    total = float(residual @ residual + unit @ unit)
    measurements, blocks = [], {}
    start = 0
    for group, white in zip(groups, whiteners, strict=True):
        rows = slice(start, start + len(white))
        start += len(white)
        own, spread = residual[rows], np.eye(len(white)) - left[rows] @ left[rows].T
        measurements.append(_agreement(group.name, own, spread, np.eye(len(white))))
        each = []
        for block in dict.fromkeys(group.blocks):
            which = white[:, [name == block for name in group.blocks]]
            if np.any(which):
                each.append(_agreement(block, own, spread, which))
        blocks[group.name] = tuple(each)
    whole = Agreement.of("all", total, len(residual))
    return StateEstimate(
        prior, tuple(groups), unit, root, table, residual, whole, tuple(measurements), blocks, (), steps, moved
    )


def _agreement(name: str, residual: Array, spread: Array, rows: Array) -> Agreement:
    """Chi-square of what a mean shift of some numbers, rows (R, K), would take off the whole.

    The same as the chi-square of these numbers about their prediction from all others.
    """
    scale = np.linalg.norm(rows, axis=0)
    rows = rows[:, scale > 0.0] / scale[scale > 0.0]
    if not rows.size:
        return Agreement.of(name, 0.0, 0)
    pull, stiff = rows.T @ residual, rows.T @ spread @ rows
    values, vectors = np.linalg.eigh(stiff)
    held = values > _NO_RANK * max(1.0, float(values[-1]))
    parts = (vectors.T @ pull)[held]
    return Agreement.of(name, float(np.sum(parts**2 / values[held])), int(np.sum(held)))


KNOWN = 0.5
"""Standard deviation of a combination after the measurements, of one before, below which it is called known."""
_NAMED = 0.25
"""Weight of a motion in a combination, relative to the largest, from which on its name stands in it."""
_MOST_NAMED = 4


@dataclass(frozen=True, eq=False)
class Combination:
    """One combination of motions.

    Attributes
    ----------
    name : str
        Its largest motions with their weights: ``0.71 M2 shift x + 0.52 M3 rotate y``, each motion in units of its
        prior standard deviation.
    weights : Array
        (M,) of the motions in their prior standard deviations.
    value : float
        Estimate, in standard deviations of the prior.
    sigma : float
        Standard deviation after the measurements; it was 1 before.
    """

    name: str
    weights: Array
    value: float
    sigma: float

    @property
    def known(self) -> bool:
        """Whether the measurements tell it."""
        return self.sigma < KNOWN

    def of(self, amounts: Array, prior_sigma: Array, mean: Array) -> Array:
        """Value of the combination in states (..., M), SI.

        Parameters
        ----------
        amounts : Array
            The states.
        prior_sigma : Array
            (M,) SI.
        mean : Array
            (M,) of the prior, SI.
        """
        safe = np.where(prior_sigma > 0.0, prior_sigma, np.inf)
        return np.asarray((amounts - mean) / safe @ self.weights)


def combinations(found: StateEstimate, most: int | None = None) -> tuple[Combination, ...]:
    """The combinations by what the measurements know of them, the best known first.

    Parameters
    ----------
    found : StateEstimate
        An estimate.
    most : int | None
        How many; all by default.
    """
    _, values, rows = np.linalg.svd(found.slope, full_matrices=True)
    values = np.pad(values, (0, len(rows) - len(values)))
    back = np.linalg.pinv(found.prior.root, rcond=1e-12) * found.prior.sigma
    out = []
    for value, row in list(zip(values, rows, strict=True))[:most]:
        weights = row @ back
        if weights[np.argmax(np.abs(weights))] < 0.0:
            weights, row = -weights, -row
        sigma = float(1.0 / np.sqrt(1.0 + value**2))
        out.append(Combination(_name(found.prior.labels, weights), weights, float(row @ found.unit), sigma))
    return tuple(out)


def _name(labels: tuple[str, ...], weights: Array) -> str:
    order = np.argsort(-np.abs(weights))[:_MOST_NAMED]
    largest = abs(weights[order[0]])
    text = ""
    for k in order:
        if abs(weights[k]) < _NAMED * largest:
            break
        sign = (" \N{MINUS SIGN} " if weights[k] < 0 else " + ") if text else ""
        text += f"{sign}{abs(weights[k]):.2f} {labels[k]}"
    return text


_MOST_NODES = 600
"""Nodes of the search; the best move found by then is told, and that it may not be the best of all."""
_CLOSE = 1e-3
"""Share of the merit by which another move would have to be better."""
_TINY = 1e-6


@dataclass(frozen=True, eq=False)
class Actuators:
    """What can be moved.

    Attributes
    ----------
    names : tuple[str, ...]
        (C,).
    low, high : Array
        (C,) limits of the next move, SI.
    steps : Array
        (C,) of which moves are whole numbers, SI; 0 for any amount.
    relative : Array
        (C,) standard deviation of a move as a share of it.
    absolute : Array
        (C,) standard deviation of any move, SI.
    """

    names: tuple[str, ...]
    low: Array
    high: Array
    steps: Array
    relative: Array
    absolute: Array

    def made(self, wanted: Array, errors: Array) -> Array:
        """What moves (..., C) come to with random errors; an actuator that is not moved makes none.

        Parameters
        ----------
        wanted : Array
            The moves.
        errors : Array
            Standard normal, (..., 2, C): of the share and of the amount.
        """
        moved = wanted != 0.0
        share, amount = errors[..., 0, :], errors[..., 1, :]
        return np.asarray(wanted * (1.0 + self.relative * share) + moved * self.absolute * amount)


@dataclass(frozen=True, eq=False)
class NextMove:
    """A move.

    Attributes
    ----------
    amounts : Array
        (C,) SI.
    expected : float
        Merit after it, by the linear model and with the errors of the move; the part due to what is not known of the
        state is not in it.
    searched : bool
        Whether all whole steps were enumerated.
    """

    amounts: Array
    expected: float
    searched: bool


def best_move(residual: Array, slope: Array, actuators: Actuators) -> NextMove:
    """The move that makes the expected merit least.

    Parameters
    ----------
    residual : Array
        r0 + D E x, (R,).
    slope : Array
        A, (R, C), per SI unit of each actuator.
    actuators : Actuators
        Limits, steps and errors.
    """
    count = slope.shape[1]
    length = np.linalg.norm(slope, axis=0)
    whole_slope = np.concatenate([slope, np.diag(actuators.relative * length)])
    whole = np.concatenate([residual, np.zeros(count)])
    low, high = np.minimum(actuators.low, 0.0), np.maximum(actuators.high, 0.0)

    def cost(amounts: Array) -> float:
        left = whole + whole_slope @ amounts
        return float(left @ left + np.sum((amounts != 0.0) * (actuators.absolute * length) ** 2))

    best, searched = _whole_steps(whole_slope, whole, low, high, actuators.steps)
    still = np.zeros(count)
    if cost(still) <= cost(best):
        best = still
    return NextMove(best, cost(best), searched)


def measurement_worth(
    spread: Array, slope: Array, actuators: Actuators, response: Array, candidates: Mapping[str, Array]
) -> dict[str, float]:
    """By how much one more measurement is expected to lower the merit after the move that follows from it.

    What is not known of the state costs only where actuators could have mended it: tr(H D P D' H) with H the projection
    on what they reach.

    Parameters
    ----------
    spread : Array
        P = spread spread', (U, U) in independent units of the prior.
    slope : Array
        D, derivatives of the merit's numbers by these units, (R, U).
    actuators : Actuators
        As of ``best_move``; steps and limits do not count here.
    response : Array
        A, (R, C).
    candidates : Mapping[str, Array]
        Name -> whitened derivatives of its numbers by the units, (N, U).
    """
    length = np.linalg.norm(response, axis=0)
    used = (length > 0.0) & (actuators.high > actuators.low)
    reach = np.concatenate([response[:, used], np.diag((actuators.relative * length)[used])])
    q, _ = np.linalg.qr(reach)
    padded = np.concatenate([slope, np.zeros((int(np.sum(used)), slope.shape[1]))])
    mendable = q.T @ padded @ spread
    before = float(np.sum(mendable**2))
    out = {}
    for name, rows in candidates.items():
        table = rows @ spread
        root = np.linalg.inv(np.linalg.cholesky(np.eye(spread.shape[1]) + table.T @ table)).T
        out[name] = before - float(np.sum((mendable @ root) ** 2))
    return out


def _bounded(slope: Array, residual: Array, low: Array, high: Array) -> Array:
    """Amounts within limits that make |residual + slope amounts| least; those whose limits are equal stand there."""
    out = np.clip(np.zeros(slope.shape[1]), low, high)
    length = np.linalg.norm(slope, axis=0)
    used = (length > 0.0) & (high > low)
    if not used.any():
        return out
    size = 1.0 / length[used]
    rest = residual + slope[:, ~used] @ out[~used]
    found = lsq_linear(slope[:, used] * size, -rest, (low[used] / size, high[used] / size), "bvls", tol=1e-12)
    out[used] = np.clip(found.x * size, low[used], high[used])
    return out


def _whole_steps(slope: Array, residual: Array, low: Array, high: Array, steps: Array) -> tuple[Array, bool]:
    """Amounts within limits, by whole steps where there are such, that make |residual + slope amounts| least; and
    whether no better ones exist.

    Branch and bound: amounts between steps bound from below what whole steps can reach, and the actuator whose rounding
    costs most is branched upon first.
    """
    length = np.linalg.norm(slope, axis=0)
    best, least = np.zeros(slope.shape[1]), np.inf
    first_low = np.where(steps > 0.0, np.ceil(low / np.where(steps > 0.0, steps, 1.0) - _TINY) * steps, low)
    first_high = np.where(steps > 0.0, np.floor(high / np.where(steps > 0.0, steps, 1.0) + _TINY) * steps, high)
    boxes = [(first_low, first_high)]
    for node in range(_MOST_NODES):
        if not boxes:
            return best, True
        lows, highs = boxes.pop()
        amounts = _bounded(slope, residual, lows, highs)
        left = residual + slope @ amounts
        if left @ left >= least * (1.0 - _CLOSE):
            continue
        parts = np.where(steps > 0.0, amounts / np.where(steps > 0.0, steps, 1.0), 0.0)
        away = np.abs(parts - np.round(parts))
        if node == 0 or node % 8 == 0:
            whole = _rounded(slope, residual, amounts, lows, highs, steps)
            rest = residual + slope @ whole
            if rest @ rest < least:
                best, least = whole, float(rest @ rest)
        if np.max(away) < _TINY:
            if left @ left < least:
                best, least = np.where(steps > 0.0, np.round(parts) * steps, amounts), float(left @ left)
            continue
        k = int(np.argmax(away * steps * length))
        below, above = highs.copy(), lows.copy()
        below[k], above[k] = np.floor(parts[k]) * steps[k], np.ceil(parts[k]) * steps[k]
        halves = [(lows, below), (above, highs)]
        # the nearer half is looked into first
        boxes += halves[::-1] if parts[k] - np.floor(parts[k]) < 0.5 else halves
    return best, False


def _rounded(slope: Array, residual: Array, amounts: Array, low: Array, high: Array, steps: Array) -> Array:
    """Whole steps one actuator after the other, the strongest first; the others follow what it has become."""
    lows, highs, out = low.copy(), high.copy(), amounts
    for k in np.argsort(-np.linalg.norm(slope, axis=0) * steps):
        if steps[k] > 0.0:
            lows[k] = highs[k] = np.clip(np.round(out[k] / steps[k]) * steps[k], low[k], high[k])
            out = _bounded(slope, residual, lows, highs)
    return out
