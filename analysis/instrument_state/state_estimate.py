"""State of an instrument by Bayesian least squares on an exact model, its observability, and the next move.

A state is an amount for each of M motions with a joint normal prior, x = m + G u with the prior mean m, a root G of the
prior covariance and independent u ~ N(0, I). Measurements are groups of numbers y = h(x) + B b + e: h is the traced
instrument, e ~ N(0, R), and b are biases of the measuring instrument, free or with a prior. B are the derivatives of
the numbers with respect to the biases. Each group is whitened and its free biases are projected out. The estimate is
the mode of the posterior distribution, found by Gauss-Newton steps on the exact h; its covariance is that of the
linearisation there (Tarantola, Inverse Problem Theory, 2005, sec. 3.4). With a linear h and one group of monitor spots
it is the best linear unbiased prediction of ``analysis.monitor.disturbances``.

Observability: few combinations of many small motions affect a wavefront (Schechter & Levinson, PASP 123, 812, 2011);
the others form the benign subspace of an instrument. In independent units of the prior, measurements with whitened
derivatives J determine the right singular vectors of J: the standard deviation along a vector falls from 1 to 1/sqrt(1
+ s^2), s its singular value.

Next move: a merit is the sum of squares of numbers that change linearly with small motions, r = r0 + D x + A a, of a
state x with a known posterior and moves a of the actuators. Its expectation is |E r|^2 + tr(D P D'), so that the best
move minimises |r0 + D E x + A a|^2. A move of relative error e adds e^2 |A_k a_k|^2. Moves by whole steps are found by
branch and bound (Land & Doig, Econometrica 28, 497, 1960). The reduction of the merit by one more measurement is
predicted before it is made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear
from scipy.sparse import diags_array

from analysis.arrays import Array, UndeterminedError, shows
from analysis.statistics import limit_of, p_value_of
from optics.numerics.array_math import covariance_root

Predict = Callable[[Array], Array]
"""Function that predicts the error-free measurements (S, D) of states (S, M), in SI units.

S is the number of states, D of measured numbers (all groups one after the other), M of motions. The result is NaN where
the light is lost.
"""
Slope = Callable[[Array], Array]
"""Function from one state (M,) to the derivatives (D, M) of the measurements with respect to its motions.

D is the number of measured numbers, M of motions; derivatives are in SI units.
"""

FALSE_ALARM = 1e-3
"""Probability that measurements with the specified errors are called a contradiction."""
STEP_TOLERANCE = 0.01
"""Largest change of the predicted measurements by the last step of a converged estimate, in their standard deviations.
"""
MOST_STEPS = 20
_SHORTEST = 2.0**-8
_MOST_EXCLUDED = 1.0 / 3.0
"""Largest fraction of the blocks of one measurement that may be excluded as gross errors.

With more, the measurement itself is in doubt. A block is the numbers that one gross error would affect together.
"""
_NO_RANK = 1e-9


@dataclass(frozen=True, eq=False)
class StatePrior:
    """Prior distribution of a state, before any measurement.

    Dimensions: U independent units of the prior.

    Attributes
    ----------
    labels : tuple of str
        Names of the M motions.
    mean : (M,) ndarray
        Mean amount of each motion, SI units.
    root : (M, U) ndarray
        Matrix root G of the covariance G G', SI units.
    """

    labels: tuple[str, ...]
    mean: Array
    root: Array

    @classmethod
    def of(cls, labels: Sequence[str], covariance: Array, mean: Array | None = None) -> StatePrior:
        """Return the normal prior of a state from its covariance and mean.

        Parameters
        ----------
        labels : sequence of str
            Names of the M motions.
        covariance : (M, M) ndarray
            Covariance, SI units, positive semidefinite.
        mean : (M,) ndarray or None
            Mean, SI units; zero by default.
        """
        mean = np.zeros(len(covariance)) if mean is None else np.asarray(mean, np.float64)
        return cls(tuple(labels), mean, covariance_root(covariance))

    @cached_property
    def sigma(self) -> Array:
        """Prior standard deviations of the motions, (M,), SI units.

        Dimensions: M motions.
        """
        return np.asarray(np.sqrt(np.sum(self.root**2, axis=1)))

    @property
    def covariance(self) -> Array:
        """Prior covariance of the motions, (M, M), SI units.

        Dimensions: M motions.
        """
        return np.asarray(self.root @ self.root.T)


@dataclass(frozen=True, eq=False)
class MeasuredGroup:
    """Measured numbers of one measurement with the covariance of their errors and possible biases.

    Dimensions: D measured numbers, B biases.

    Attributes
    ----------
    name : str
        Name of the measurement.
    kind : str
        Kind of measurement: ``wavefronts``, ``focus`` ...
    labels : tuple of str
        Names of the D numbers.
    values : (D,) ndarray
        Measured values, SI units.
    covariance : (D, D) or (D,) ndarray
        Covariance of their errors, SI units; or their variances if they are independent and have no biases, as for
        pixels of images. A number of infinite variance is not used.
    biases : (D, B) ndarray
        Derivatives of the numbers with respect to each bias.
    bias_sigmas : (B,) ndarray
        Standard deviations of the biases; infinite for a free one.
    blocks : tuple of str
        For each number, the name of its block: the numbers that one gross error would affect together, such as a field.
    fitted : int
        Number of quantities of each block alone that the prediction fits to its numbers in every state, such as the
        flux of a star (variable projection: Golub & Pereyra, SIAM J. Numer. Anal. 10, 413, 1973).
    """

    name: str
    kind: str
    labels: tuple[str, ...]
    values: Array
    covariance: Array
    biases: Array
    bias_sigmas: Array
    blocks: tuple[str, ...]
    fitted: int = 0

    def __post_init__(self) -> None:
        """Raise ValueError if the lengths of values, covariance, biases and labels do not match."""
        count = len(self.values)
        shapes = ((count, count),) if len(self.bias_sigmas) else ((count, count), (count,))
        if self.covariance.shape not in shapes or self.biases.shape != (count, len(self.bias_sigmas)):
            raise ValueError(f"measurement {self.name}: covariance or biases do not have the shape for {count} numbers")
        if len(self.labels) != count or len(self.blocks) != count:
            raise ValueError(f"measurement {self.name}: {count} numbers need as many labels and blocks")

    def with_values(self, values: Array) -> MeasuredGroup:
        """Return the same measurement with other values (D,).

        Dimensions: D measured numbers.
        """
        return replace(self, values=values)

    def whitener(self, without: Sequence[str] = ()) -> Any:
        """Return the matrix (R, D) that makes the errors independent with unit variance and eliminates free biases.

        It is a sparse array for independent errors.

        Dimensions: R whitened measured numbers, D measured numbers.

        Parameters
        ----------
        without : sequence of str
            Blocks to exclude.

        Raises
        ------
        UndeterminedError
            The covariance is not positive definite.
        """
        included = np.array([block not in without for block in self.blocks])
        if self.covariance.ndim == 1:
            included &= np.isfinite(self.covariance)
            if not np.all(self.covariance > 0.0):
                raise UndeterminedError(f"measurement {self.name}: the standard deviation of a number is zero")
            return diags_array(1.0 / np.sqrt(self.covariance), format="csr")[included]
        out = np.zeros((0, len(self.values)))
        if not included.any():
            return out
        biases, free = self.biases[included], np.isinf(self.bias_sigmas)
        bias_root = biases[:, ~free] * self.bias_sigmas[~free]
        spread = self.covariance[np.ix_(included, included)] + bias_root @ bias_root.T
        scale = np.sqrt(np.diagonal(spread))
        if not np.all(scale > 0.0):
            raise UndeterminedError(f"measurement {self.name}: the standard deviation of a number is zero")
        try:
            root = scale[:, None] * np.linalg.cholesky(spread / scale / scale[:, None])
        except np.linalg.LinAlgError as error:
            raise UndeterminedError(f"measurement {self.name}: its covariance is not positive definite") from error
        white = np.linalg.inv(root)
        if free.any():
            u, s, _ = np.linalg.svd(white @ biases[:, free])
            rank = int(np.sum(s > _NO_RANK * s[0])) if s.size and s[0] > 0.0 else 0
            white = u[:, rank:].T @ white
        out = np.zeros((len(white), len(self.values)))
        out[:, included] = white
        return out


@dataclass(frozen=True)
class ConsistencyTest:
    """Chi-square test of a set of measured numbers against their prediction by all others, the prior and the model.

    Attributes
    ----------
    name : str
        Name of a measurement, or of one of its blocks.
    chi_square : float
        Chi-square of the numbers about their prediction from all others.
    degrees : int
        Degrees of freedom.
    p_value : float
        Probability of so large a chi-square if prior and errors are as specified.
    """

    name: str
    chi_square: float
    degrees: int
    p_value: float

    @classmethod
    def of(cls, name: str, chi_square: float, degrees: int) -> ConsistencyTest:
        """Return the test of a chi-square, with its p-value; without degrees of freedom the p-value is 1."""
        p_value = float(p_value_of(chi_square, degrees)) if degrees else 1.0
        return cls(name, float(chi_square), degrees, p_value)

    def passes(self, looks: int = 1, false_alarm: float = FALSE_ALARM) -> bool:
        """Return True if the measured numbers are consistent with their prediction.

        The false-alarm probability ``false_alarm`` is divided by the number ``looks`` of groups that are tested
        together.
        """
        return not self.degrees or self.chi_square <= float(limit_of(false_alarm / max(1, looks), self.degrees))


@shows("prior.labels", "measurements", "whole")
@dataclass(frozen=True, eq=False)
class StateEstimate:
    """Posterior state after the measurements, with its tests.

    Dimensions: U independent units of the prior, R whitened measured numbers.

    Attributes
    ----------
    prior : StatePrior
        Prior of the state.
    groups : tuple of MeasuredGroup
        Measurements.
    unit : (U,) ndarray
        Estimated state in the independent units u of the prior, whose prior variance is 1.
    root : (U, U) ndarray
        Matrix root of the posterior covariance of u, which is root root'.
    slope : (R, U) ndarray
        Whitened derivatives of all measurements with respect to u at the estimate.
    residual : (R,) ndarray
        Whitened residuals.
    whole : ConsistencyTest
        Chi-square test of all measurements together.
    measurements : tuple of ConsistencyTest
        Test of each measurement against its prediction by all others.
    blocks : dict of str to tuple of ConsistencyTest
        Tests of each block, by the name of its measurement.
    excluded : tuple of (str, str, ConsistencyTest)
        Blocks that were excluded because they contradict all other measurements: measurement, block, and the test that
        failed.
    steps : int
        Number of Gauss-Newton steps.
    settled : float
        Change of the predicted measurements by the last step, in standard deviations.
    """

    prior: StatePrior
    groups: tuple[MeasuredGroup, ...]
    unit: Array
    root: Array
    slope: Array
    residual: Array
    whole: ConsistencyTest
    measurements: tuple[ConsistencyTest, ...]
    blocks: dict[str, tuple[ConsistencyTest, ...]] = field(default_factory=dict)
    excluded: tuple[tuple[str, str, ConsistencyTest], ...] = ()
    steps: int = 0
    settled: float = 0.0

    @property
    def converged(self) -> bool:
        """True if the last step changed the predicted measurements by less than ``STEP_TOLERANCE``."""
        return self.settled < STEP_TOLERANCE

    @cached_property
    def mean(self) -> Array:
        """Estimated amounts of the motions, (M,), SI units.

        Dimensions: M motions.
        """
        return np.asarray(self.prior.mean + self.prior.root @ self.unit)

    @cached_property
    def spread(self) -> Array:
        """Matrix root of the posterior covariance of the motions, (M, U), SI units: the covariance is spread spread'.

        Dimensions: M motions, U independent units of the prior.
        """
        return np.asarray(self.prior.root @ self.root)

    @property
    def covariance(self) -> Array:
        """Posterior covariance of the motions, (M, M), SI units.

        Dimensions: M motions.
        """
        return np.asarray(self.spread @ self.spread.T)

    @property
    def sigma(self) -> Array:
        """Posterior standard deviations of the motions, (M,), SI units.

        Dimensions: M motions.
        """
        return np.asarray(np.sqrt(np.sum(self.spread**2, axis=1)))

    @property
    def variance_factor(self) -> float:
        """Chi-square per degree of freedom of all measurements together if their test fails, else 1."""
        return 1.0 if self.whole.passes() else self.whole.chi_square / self.whole.degrees

    @property
    def log_evidence(self) -> float:
        """Logarithm of the probability of the measurements near this state, up to a constant (Laplace's method)."""
        return float(np.linalg.slogdet(self.root)[1] - 0.5 * self.whole.chi_square)

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Draw random states from the posterior distribution, (count, M), SI units.

        The posterior covariance is multiplied by the variance factor.

        Dimensions: M motions.

        Parameters
        ----------
        rng : Generator
            Random number generator.
        count : int
            Number of states.
        """
        unit = rng.standard_normal((count, self.root.shape[1])) * np.sqrt(self.variance_factor)
        return np.asarray(self.mean + unit @ self.spread.T)


def estimate_state(
    prior: StatePrior, groups: Sequence[MeasuredGroup], predict: Predict, slope: Slope, start: Array | None = None
) -> StateEstimate:
    """Estimate a state from measurements.

    A block of numbers that contradicts everything else, at the false-alarm probability shared among all blocks, is
    excluded and the estimate is repeated (data snooping: Baarda, A testing procedure for use in geodetic networks,
    1968).

    Dimensions: M motions.

    Parameters
    ----------
    prior : StatePrior
        Prior of the state.
    groups : sequence of MeasuredGroup
        Measurements, in the order of the predictions.
    predict : callable
        Function from states to error-free measurements.
    slope : callable
        Function from one state to the derivatives of the measurements.
    start : (M,) ndarray or None
        State at which the iteration starts, SI units; the prior's mean by default.

    Raises
    ------
    UndeterminedError
        There are no measurements, a covariance is not positive definite, or there is no light at the prior's mean.
    """
    if not groups:
        raise UndeterminedError("nothing was measured")
    unit: Array = np.zeros(prior.root.shape[1])
    if start is not None:
        unit = np.asarray(np.linalg.lstsq(prior.root, start - prior.mean, rcond=None)[0], np.float64)
    out: dict[str, list[str]] = {}
    excluded: list[tuple[str, str, ConsistencyTest]] = []
    count = len({(g.name, b) for g in groups for b in g.blocks})
    while True:
        estimate = _gauss_newton(prior, groups, predict, slope, unit, out)
        unit = estimate.unit
        worst = min(
            ((test.p_value, group.name, test) for group in groups for test in estimate.blocks[group.name]),
            key=lambda entry: (entry[0], -entry[2].chi_square),
            default=None,
        )
        if worst is None or worst[2].passes(count):
            break
        _, name, contradiction = worst
        contradicted = next(group for group in groups if group.name == name)
        blocks = len(set(contradicted.blocks))
        if len(out.get(name, ())) + 1 > _MOST_EXCLUDED * blocks:
            break
        out.setdefault(name, []).append(contradiction.name)
        excluded.append((name, contradiction.name, contradiction))
    fields = {key: getattr(estimate, key) for key in estimate.__dataclass_fields__}
    return StateEstimate(**fields | {"excluded": tuple(excluded)})


def _gauss_newton(
    prior: StatePrior,
    groups: Sequence[MeasuredGroup],
    predict: Predict,
    slope: Slope,
    unit: Array,
    out: dict[str, list[str]],
) -> StateEstimate:
    """Return the estimate of the state by Gauss-Newton steps, without the excluded blocks of measured numbers."""
    whiteners = [group.whitener(out.get(group.name, ())) for group in groups]
    values = np.concatenate([group.values for group in groups])

    def whitened(rows: Array) -> Array:
        """Return measured numbers (D, ...) of all groups transformed to independent numbers of unit variance, (R, ...).

        Dimensions: D measured numbers, R whitened measured numbers.
        """
        ends = np.cumsum([0, *(len(group.values) for group in groups)])
        return np.concatenate([w @ rows[a:b] for w, a, b in zip(whiteners, ends[:-1], ends[1:], strict=True)])

    def residual_at(u: Array) -> Array:
        return whitened(values - predict((prior.mean + prior.root @ u)[None])[0])

    residual = residual_at(unit)
    if not np.all(np.isfinite(residual)) and np.any(unit):
        unit = np.zeros_like(unit)
        residual = residual_at(unit)
    if not np.all(np.isfinite(residual)):
        raise UndeterminedError("the instrument has no light at the prior's mean")
    moved, steps = np.inf, 0
    while True:
        table = whitened(slope(prior.mean + prior.root @ unit) @ prior.root)
        if not np.all(np.isfinite(table)):
            raise UndeterminedError("the estimate ended where small motions of the instrument lose its light")
        normal = np.eye(len(unit)) + table.T @ table
        if moved < STEP_TOLERANCE or steps >= MOST_STEPS:
            break
        step = np.linalg.solve(normal, table.T @ residual - unit)
        cost = residual @ residual + unit @ unit
        share = 1.0
        while True:
            trial = unit + share * step
            trial_residual = residual_at(trial)
            good = bool(
                np.all(np.isfinite(trial_residual))
            ) and trial_residual @ trial_residual + trial @ trial <= cost * (1.0 + 1e-12)
            if good or share < _SHORTEST:
                break
            share *= 0.5
        steps += 1
        moved = float(np.max(np.abs(table @ step), initial=0.0))
        if not good:
            # no descent along the step: the estimate is kept, and the size of the step tells its accuracy
            moved = moved if moved < STEP_TOLERANCE else max(moved, STEP_TOLERANCE)
            break
        unit, residual = np.asarray(trial), trial_residual
        moved = max(moved * share, 0.0) if share == 1.0 else np.inf
    return _tested(prior, groups, whiteners, unit, table, residual, steps, moved)


def _tested(
    prior: StatePrior,
    groups: Sequence[MeasuredGroup],
    whiteners: Sequence[Any],
    unit: Array,
    table: Array,
    residual: Array,
    steps: int,
    moved: float,
) -> StateEstimate:
    """Return the estimate with its posterior covariance and the consistency tests of all groups and blocks."""
    values, vectors = np.linalg.eigh(table.T @ table)
    # the symmetric root, since states are drawn with it: eigenvectors of equal eigenvalues depend on rounding
    root = (vectors / np.sqrt(1.0 + np.clip(values, 0.0, None))) @ vectors.T
    left = table @ root
    # to the first order this is the residual's inverse marginal covariance, times the residual about the prior's mean
    total = float(residual @ residual + unit @ unit)
    measurements: list[ConsistencyTest] = []
    fitted = 0
    blocks: dict[str, tuple[ConsistencyTest, ...]] = {}
    start = 0
    for group, white in zip(groups, whiteners, strict=True):
        rows = slice(start, start + white.shape[0])
        start += white.shape[0]
        part = residual[rows]
        if group.covariance.ndim == 1:
            # a row of the whitener of independent numbers has one of them
            owners = np.array(group.blocks)[white.indices]
            names = tuple(dict.fromkeys(owners.tolist()))
            fitted += group.fitted * len(names)
            measurements.append(_consistency_of_many(group.name, part, left[rows], group.fitted * len(names)))
            blocks[group.name] = tuple(
                _consistency_of_many(name, part[owners == name], left[rows][owners == name], group.fitted)
                for name in names
            )
            continue
        spread = np.eye(len(white)) - left[rows] @ left[rows].T
        measurements.append(_consistency(group.name, part, spread, np.eye(len(white))))
        tests = []
        for block in dict.fromkeys(group.blocks):
            columns = white[:, [name == block for name in group.blocks]]
            if np.any(columns):
                tests.append(_consistency(block, part, spread, columns))
        blocks[group.name] = tuple(tests)
    whole = ConsistencyTest.of("all", total, len(residual) - fitted)
    return StateEstimate(
        prior, tuple(groups), unit, root, table, residual, whole, tuple(measurements), blocks, (), steps, moved
    )


def _consistency(name: str, residual: Array, spread: Array, rows: Array) -> ConsistencyTest:
    """Return the chi-square test of a set of whitened measured numbers against their prediction from all others.

    The chi-square is the reduction of the total chi-square if these numbers may have an arbitrary shift (mean-shift
    outlier model). ``rows``, (R, K), has a column for each of the K tested numbers with its effect on all whitened
    ones.

    Dimensions: R whitened measured numbers, K numbers tested.
    """
    scale = np.linalg.norm(rows, axis=0)
    rows = rows[:, scale > 0.0] / scale[scale > 0.0]
    if not rows.size:
        return ConsistencyTest.of(name, 0.0, 0)
    pull, stiff = rows.T @ residual, rows.T @ spread @ rows
    values, vectors = np.linalg.eigh(stiff)
    determined = values > _NO_RANK * max(1.0, float(values[-1]))
    parts = (vectors.T @ pull)[determined]
    return ConsistencyTest.of(name, float(np.sum(parts**2 / values[determined])), int(np.sum(determined)))


def _consistency_of_many(name: str, residual: Array, left: Array, fitted: int) -> ConsistencyTest:
    """Return the chi-square test of R whitened numbers with independent errors against their prediction from others.

    The result is that of ``_consistency`` for all of them together, without a matrix of R by R (Woodbury's formula).

    Dimensions: R whitened measured numbers, U independent units of the prior.

    Parameters
    ----------
    name : str
        Name of the measurement.
    residual : (R,) ndarray
        Whitened residuals.
    left : (R, U) ndarray
        Whitened derivatives times the root of the posterior covariance.
    fitted : int
        Number of quantities that were fitted to these numbers alone.
    """
    pull = left.T @ residual
    inner = np.linalg.solve(np.eye(len(pull)) - left.T @ left, pull)
    return ConsistencyTest.of(name, float(residual @ residual + pull @ inner), max(0, len(residual) - fitted))


DETERMINED = 0.5
"""Ratio of posterior to prior standard deviation below which a combination counts as determined."""
_NAMED = 0.25
"""Smallest weight of a motion in a combination, relative to the largest, for it to be named."""
_MOST_NAMED = 4


@dataclass(frozen=True, eq=False)
class Combination:
    """Linear combination of motions that the measurements determine better or worse than others.

    Dimensions: M motions.

    Attributes
    ----------
    name : str
        Largest motions with their weights: ``0.71 M2 shift x + 0.52 M3 rotate y``, each motion in units of its prior
        standard deviation.
    weights : (M,) ndarray
        Weights of the motions in their prior standard deviations.
    value : float
        Estimate, in standard deviations of the prior.
    sigma : float
        Posterior standard deviation; the prior one is 1.
    """

    name: str
    weights: Array
    value: float
    sigma: float

    @property
    def known(self) -> bool:
        """True if the measurements determine the combination: its sigma has fallen below DETERMINED."""
        return self.sigma < DETERMINED

    def of(self, amounts: Array, prior_sigma: Array, mean: Array) -> Array:
        """Return the value of the combination in states (..., M), SI.

        Dimensions: M motions.

        Parameters
        ----------
        amounts : (..., M) ndarray
            States, SI units.
        prior_sigma : (M,) ndarray
            Standard deviations of the prior, SI units.
        mean : (M,) ndarray
            Mean of the prior, SI units.
        """
        safe = np.where(prior_sigma > 0.0, prior_sigma, np.inf)
        return np.asarray((amounts - mean) / safe @ self.weights)


def combinations(estimate: StateEstimate, most: int | None = None) -> tuple[Combination, ...]:
    """Return the combinations of motions in the order of their observability, the best determined first.

    Parameters
    ----------
    estimate : StateEstimate
        Estimate of the state.
    most : int or None
        Number of combinations; all by default.
    """
    slope = estimate.slope
    # the triangle of a tall matrix has its singular values and right vectors, without a square matrix of its rows
    slope = np.asarray(np.linalg.qr(slope, mode="r")) if len(slope) > 4 * slope.shape[1] else slope
    _, values, rows = np.linalg.svd(slope, full_matrices=True)
    values = np.pad(values, (0, len(rows) - len(values)))
    back = np.linalg.pinv(estimate.prior.root, rcond=1e-12) * estimate.prior.sigma
    out = []
    for value, row in list(zip(values, rows, strict=True))[:most]:
        weights = row @ back
        if weights[np.argmax(np.abs(weights))] < 0.0:
            weights, row = -weights, -row
        sigma = float(1.0 / np.sqrt(1.0 + value**2))
        out.append(Combination(_name(estimate.prior.labels, weights), weights, float(row @ estimate.unit), sigma))
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
"""Largest number of nodes of the branch-and-bound search; if it is reached, the result may not be the optimum."""
_CLOSE = 1e-3
"""Improvement of the merit, relative to it, below which no better move is sought."""
_TINY = 1e-6


@dataclass(frozen=True, eq=False)
class Actuators:
    """Limits, step sizes and errors of the actuators of an instrument.

    Attributes
    ----------
    names : tuple of str
        Names of the C actuators.
    low, high : (C,) ndarray
        Limits of the next move, SI units.
    steps : (C,) ndarray
        Step of which moves are whole multiples, SI units; 0 for continuous moves.
    relative : (C,) ndarray
        Relative standard deviation of a move.
    absolute : (C,) ndarray
        Standard deviation of any move, SI units.
    """

    names: tuple[str, ...]
    low: Array
    high: Array
    steps: Array
    relative: Array
    absolute: Array

    def made(self, wanted: Array, errors: Array) -> Array:
        """Return the executed moves (..., C) with random errors; an actuator that is not moved has no error.

        Dimensions: C actuators.

        Parameters
        ----------
        wanted : (..., C) ndarray
            Commanded moves, SI units.
        errors : (..., 2, C) ndarray
            Standard normal numbers, for the relative and for the absolute error.
        """
        moved = wanted != 0.0
        share, amount = errors[..., 0, :], errors[..., 1, :]
        return np.asarray(wanted * (1.0 + self.relative * share) + moved * self.absolute * amount)


@dataclass(frozen=True, eq=False)
class NextMove:
    """Best next move of the actuators, with the merit that it is expected to leave.

    Dimensions: C actuators.

    Attributes
    ----------
    amounts : (C,) ndarray
        Amount of each actuator's move, SI units.
    expected : float
        Expected merit after the move, by the linear model and with the errors of the move, without the part due to the
        uncertainty of the state.
    searched : bool
        True if the search over whole steps was completed.
    """

    amounts: Array
    expected: float
    searched: bool


def best_move(residual: Array, slope: Array, actuators: Actuators) -> NextMove:
    """Return the move of the actuators that minimises the expected merit, a sum of squares.

    Dimensions: R numbers of the merit, C actuators.

    Parameters
    ----------
    residual : (R,) ndarray
        Expected values before the move of the numbers whose squares are summed.
    slope : (R, C) ndarray
        Derivatives of these numbers with respect to the move of each actuator, per SI unit.
    actuators : Actuators
        Limits, steps and errors of the actuators.
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


def merit_reduction(
    spread: Array, slope: Array, actuators: Actuators, response: Array, candidates: Mapping[str, Array]
) -> dict[str, float]:
    """Return the expected reduction of the merit after the next move by one more measurement of each kind.

    The uncertainty of the state matters only where actuators could correct it: the expected merit has the part tr(H D P
    D' H), with the covariance P of the state, the derivatives D of the merit's numbers, and the projection H on the
    range of the actuators' effects A.

    Dimensions: U independent units of the prior, R numbers of the merit, C actuators, N numbers.

    Parameters
    ----------
    spread : (U, U) ndarray
        Root of the covariance P = spread spread' in independent units of the prior.
    slope : (R, U) ndarray
        Derivatives D of the merit's numbers with respect to these units.
    actuators : Actuators
        Actuators of the instrument; their steps are ignored, their limits only exclude those that cannot move.
    response : (R, C) ndarray
        Derivatives A of the merit's numbers with respect to the actuators.
    candidates : dict of str to (N, U) ndarray
        Whitened derivatives of each candidate measurement with respect to the units, by name.
    """
    length = np.linalg.norm(response, axis=0)
    used = (length > 0.0) & (actuators.high > actuators.low)
    range_columns = np.concatenate([response[:, used], np.diag((actuators.relative * length)[used])])
    q, _ = np.linalg.qr(range_columns)
    padded = np.concatenate([slope, np.zeros((int(np.sum(used)), slope.shape[1]))])
    correctable = q.T @ padded @ spread
    before = float(np.sum(correctable**2))
    out = {}
    for name, rows in candidates.items():
        table = rows @ spread
        root = np.linalg.inv(np.linalg.cholesky(np.eye(spread.shape[1]) + table.T @ table)).T
        out[name] = before - float(np.sum((correctable @ root) ** 2))
    return out


def _bounded(slope: Array, residual: Array, low: Array, high: Array) -> Array:
    """Return the moves within limits that minimise |residual + slope amounts|, a linear least-squares problem.

    A move is fixed where both of its limits are equal.
    """
    out = np.clip(np.zeros(slope.shape[1]), low, high)
    length = np.linalg.norm(slope, axis=0)
    used = (length > 0.0) & (high > low)
    if not used.any():
        return out
    size = 1.0 / length[used]
    rest = residual + slope[:, ~used] @ out[~used]
    solution = lsq_linear(slope[:, used] * size, -rest, (low[used] / size, high[used] / size), "bvls", tol=1e-12)
    out[used] = np.clip(solution.x * size, low[used], high[used])
    return out


def _whole_steps(slope: Array, residual: Array, low: Array, high: Array, steps: Array) -> tuple[Array, bool]:
    """Return the moves that minimise |residual + slope amounts| within limits, in whole steps where required.

    The second result is True if the search was completed. Branch and bound: continuous amounts are a lower bound of
    what whole steps can reach, and the actuator whose rounding costs most is branched upon first.
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
        # the nearer half is searched first
        boxes += halves[::-1] if parts[k] - np.floor(parts[k]) < 0.5 else halves
    return best, False


def _rounded(slope: Array, residual: Array, amounts: Array, low: Array, high: Array, steps: Array) -> Array:
    """Return the moves with one actuator after the other rounded to whole steps and the others optimised again.

    The actuator with the strongest effect is rounded first.
    """
    lows, highs, out = low.copy(), high.copy(), amounts
    for k in np.argsort(-np.linalg.norm(slope, axis=0) * steps):
        if steps[k] > 0.0:
            lows[k] = highs[k] = np.clip(np.round(out[k] / steps[k]) * steps[k], low[k], high[k])
            out = _bounded(slope, residual, lows, highs)
    return out
