"""Prior of the disturbances for the analysis: effects of each motion on spots and cameras, and correlations.

Spot shifts s and changes p of the camera parameters are linear in the amounts x of the M motions, s = A x and p = B x
with x ~ N(0, C); a column of A and B is for one standard deviation, so that C is a correlation matrix. The prior of p
is B C B', that of s is A C A' + R, with the covariance R of the noise of the spot positions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from analysis.arrays import Array, shows
from analysis.statistics import density, limit_of, p_value_of
from optics.numerics.arguments import check_fields, checked
from optics.numerics.array_math import covariance_root

FALSE_ALARM = 1e-3
"""Probability that spot shifts that follow the prior are nevertheless called a contradiction to it."""
_INFLATIONS = np.logspace(0.0, 8.0, 161)
"""Factors by which the prior variance of a body's motions is increased to find which explains a contradiction best."""


@dataclass(frozen=True)
class TimeLaw:
    """Covariance in time of a disturbance, in units of the square of its prior standard deviation.

    The covariance of the values at the times t and t' is g(t) g(t') rho(t - t') C(t, t'): g is the known growth of a
    trend or relaxation, rho the correlation over the interval, and C the probability that a step has occurred by both
    times. Each factor is positive semidefinite, and so is their product.

    Attributes
    ----------
    white : bool
        True if values at different times are independent; all others are then None.
    drift_s : float or None
        Correlation time, s; None for a constant.
    period_s : float or None
        Period of an oscillation, s; None if there is none.
    trend_s : float or None
        Time of a linear growth to one standard deviation, g = (t - since) / trend_s, s; None if there is none.
    relaxation_s : float or None
        Time constant of a relaxation to a new value, g = 1 - exp(-(t - since) / relaxation_s) and 0 before, s; None for
        none.
    since_s : float
        Start of trend and relaxation, s.
    event : tuple of (float, float)
        Step: pairs (time, probability that it has occurred by then) in the order of time, linear between; one pair
        (time, 1) for a known time; a value above 1 is the mean number of many steps. C is the probability at the
        earlier of two times: at a time that may be before the step the motion is known less well. Empty for no step.
    jump : bool
        True for a step at an unknown time: it counts as absent until it is detected (`jump_detection`), and is then an
        event. All other attributes but ``every_s`` then have their defaults.
    every_s : float or None
        Mean time between two such steps, s; None if unknown, and steps too small to be detected then count as absent.

    Examples
    --------
    A drift that forgets its value in a day, and a trend that reaches one standard deviation after a year:

    >>> import analysis
    >>> day, year = 86400.0, 31557600.0
    >>> round(float(analysis.TimeLaw(drift_s=day).covariance(0.0, day)), 4)
    0.3679
    >>> float(analysis.TimeLaw(trend_s=year).covariance(0.5 * year, year))
    0.5
    """

    white: bool = False
    drift_s: float | None = None
    period_s: float | None = None
    trend_s: float | None = None
    relaxation_s: float | None = None
    since_s: float = 0.0
    event: tuple[tuple[float, float], ...] = ()
    jump: bool = False
    every_s: float | None = None

    def __post_init__(self) -> None:
        """Check that the times and their combination are possible; raise ValueError otherwise."""
        check_fields(self)
        for name in ("drift_s", "period_s", "trend_s", "relaxation_s", "every_s"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise ValueError(f"time law: {name} must be positive, found {value}")

    def covariance(self, time: ArrayLike, other_time: ArrayLike) -> Array:
        """Return the covariance between the disturbance's values at two times, in units of the prior variance.

        The arguments are times in seconds, of shapes that broadcast; the result has their common shape.
        """
        first, second = np.asarray(time, np.float64), np.asarray(other_time, np.float64)
        away = np.abs(first - second)
        if self.jump:
            return np.zeros_like(away)
        if self.white:
            return np.asarray(away == 0.0, np.float64)
        out = np.ones_like(away)
        if self.drift_s is not None:
            out = out * np.exp(-away / self.drift_s)
        if self.period_s is not None:
            out = out * np.cos(2.0 * math.pi * away / self.period_s)
        if self.trend_s is not None or self.relaxation_s is not None:
            out = out * (self.amplitude(first) * self.amplitude(second))
        if self.event:
            out = out * self.step_probability(np.minimum(first, second))
        return np.asarray(out)

    def step_probability(self, time: ArrayLike) -> Array:
        """Return the probability that the step of an event has occurred by a time in seconds (any shape)."""
        return step_probability(self.event, time)

    def two_time_moments(self, then: float, now: float) -> tuple[float, float, float]:
        """Return the variance at an earlier time, the covariance with a later time, and the variance at the later time.

        The three numbers are in units of the prior variance. A jump may have occurred between the times.

        Parameters
        ----------
        then : float
            Earlier time, s.
        now : float
            Later time, s.
        """
        if self.jump:
            return 0.0, 0.0, 1.0
        times = ((then, then), (then, now), (now, now))
        before, across, after = (float(self.covariance(*pair)) for pair in times)
        return before, across, after

    def amplitude(self, time: Array) -> Array:
        """Return the amplitude of trend and relaxation at times in seconds, relative to one prior standard deviation.

        It is 1 without trend and relaxation.
        """
        out, since = np.ones_like(time), time - self.since_s
        if self.trend_s is not None:
            out = out * since / self.trend_s
        if self.relaxation_s is not None:
            out = out * -np.expm1(-np.maximum(since, 0.0) / self.relaxation_s)
        return out


def step_probability(probabilities: Sequence[tuple[float, float]], time: ArrayLike) -> Array:
    """Return the probability that a step has occurred by a time in seconds (any shape).

    ``probabilities`` are pairs of a time and this probability, linear between; one pair for a step at a known time.
    """
    at, probability = np.array(probabilities).T
    when = np.asarray(time, np.float64)
    return np.asarray((when >= at[0]) * probability[0] if len(at) == 1 else np.interp(when, at, probability))


@shows("name", "labels", "spots [px]")
@dataclass(frozen=True, eq=False)
class Disturbances:
    """Prior of the motions of the bodies that carry K cameras, with their effect on D spot coordinates together.

    Attributes
    ----------
    name : str
        Name of the prior.
    labels : tuple of str
        Names of the M motions, such as ``base/forward/M2 shift z``: path of the body and kind of motion.
    bodies : tuple of str
        Body of each motion.
    causes : tuple of str
        Cause of the prior that each motion belongs to.
    sigmas : (M,) ndarray
        Standard deviations in the units of `units`.
    units : tuple of str
        Unit of each standard deviation, as shown in tables and reports.
    spots : (D, M) ndarray
        Spot shifts for one standard deviation, px, spots in the order of the calibration, each row then column.
    parameters : (4 K, M) ndarray
        Changes d_alpha, d_beta, d_gamma (rad), d_f (m) of one camera after the other for one standard deviation.
    correlation : (M, M) ndarray
        Correlation matrix, positive semidefinite.
    laws : tuple of TimeLaw
        Law in time of each motion.
    jump_false_alarm : float
        Probability that a jump is reported in a series without one, over all times and motions together.

    Examples
    --------
    A measured value moves by a drift of 2 units and white motions of 0.5 units; the drift alone is wanted:

    >>> import analysis
    >>> prior = analysis.Disturbances.of(
    ...     spots=[[2.0, 0.5]],
    ...     parameters=[[2.0, 0.0]],
    ...     laws=[analysis.TimeLaw(drift_s=10.0), analysis.TimeLaw(white=True)],
    ... )
    >>> prior.spot_covariance, prior.parameter_covariance
    (array([[4.25]]), array([[4.]]))
    """

    name: str
    labels: tuple[str, ...]
    bodies: tuple[str, ...]
    causes: tuple[str, ...]
    sigmas: Array
    units: tuple[str, ...]
    spots: Array
    parameters: Array
    correlation: Array
    laws: tuple[TimeLaw, ...]
    jump_false_alarm: float = FALSE_ALARM

    def __post_init__(self) -> None:
        """Raise ValueError if the shapes of the arrays do not match the number of motions."""
        count = len(self.labels)
        shapes = {
            "spots": (self.spots.shape[0], count),
            "parameters": (self.parameters.shape[0], count),
            "correlation": (count, count),
            "sigmas": (count,),
        }
        for name, shape in shapes.items():
            actual = getattr(self, name).shape
            if actual != shape:
                raise ValueError(f"disturbances: {name} must be {shape} for {count} motions, found {actual}")
        if not all(len(getattr(self, name)) == count for name in ("bodies", "causes", "units", "laws")):
            raise ValueError(f"disturbances: {count} motions need as many bodies, causes, units and laws")

    @classmethod
    @checked
    def of(
        cls,
        spots: ArrayLike,
        parameters: ArrayLike,
        laws: Sequence[TimeLaw],
        *,
        labels: Sequence[str] = (),
        correlation: ArrayLike | None = None,
        jump_false_alarm: float = FALSE_ALARM,
    ) -> Disturbances:
        """Return the prior of disturbances from plain arrays; each motion belongs to a separate body.

        Dimensions: D spot coordinates (row and column of every spot), M motions, P parameters.

        Parameters
        ----------
        spots : (D, M) array_like
            Change of each measured value for one standard deviation of each motion.
        parameters : (P, M) array_like
            Change of each wanted parameter for one standard deviation of each motion.
        laws : sequence of M TimeLaw
            Covariance of each motion in time.
        labels : sequence of M str, optional
            Names of the motions.
        correlation : (M, M) array_like, optional
            Correlation of the motions; by default they are independent.
        jump_false_alarm : float
            Probability of detecting a step in a series without one.

        Raises
        ------
        ValueError
            Arrays whose shapes do not match.
        """
        effect = np.array(spots, np.float64)
        count = len(laws)
        names = tuple(labels) or tuple(f"motion {k + 1}" for k in range(count))
        together = np.eye(count) if correlation is None else np.array(correlation, np.float64)
        rest = ("",) * count, effect, np.array(parameters, np.float64), together, tuple(laws), jump_false_alarm
        return cls("prior", names, names, names, np.ones(count), *rest)

    @cached_property
    def root(self) -> Array:
        """Matrix root of the correlation matrix, (M, M): root times its transpose is the correlation.

        Dimensions: M motions.
        """
        return covariance_root(self.correlation)

    @cached_property
    def spot_covariance(self) -> Array:
        """Prior covariance of the spot shifts without noise of the images, (D, D) px^2.

        Dimensions: D spot coordinates (row and column of every spot).
        """
        root = self.spots @ self.root
        return np.asarray(root @ root.T)

    @cached_property
    def parameter_covariance(self) -> Array:
        """Covariance of the parameters before any measurement, (4 K, 4 K) rad^2, rad m, m^2.

        Dimensions: K cameras.
        """
        root = self.parameters @ self.root
        return np.asarray(root @ root.T)

    def scaled(self, factors: Sequence[float] | Array) -> Disturbances:
        """Return the prior with the standard deviation of each motion multiplied by a factor.

        Dimensions: M motions.

        Parameters
        ----------
        factors : (M,) sequence of float
            Factor of each motion; 0 removes it.
        """
        f = np.asarray(factors, np.float64)
        return replace(self, sigmas=self.sigmas * f, spots=self.spots * f, parameters=self.parameters * f)

    def between(self, then: float, now: float) -> Disturbances:
        """Return the prior of the changes between two times, instead of the changes since the nominal instrument.

        Parameters
        ----------
        then : float
            Earlier time, s.
        now : float
            Later time, s.
        """
        moments = np.array([law.two_time_moments(then, now) for law in self.laws]).reshape(-1, 3)
        return self.scaled(np.sqrt(np.maximum(moments[:, 0] + moments[:, 2] - 2.0 * moments[:, 1], 0.0)))

    def with_copies(self, which: Sequence[int], times: float, law: TimeLaw | None = None) -> Disturbances:
        """Return the prior with independent copies of some motions added, which may have another law in time.

        The copies are correlated among each other as the originals are.

        Parameters
        ----------
        which : sequence of int
            Indices of the motions.
        times : float
            Ratio of the standard deviations of the copies to those of the motions.
        law : TimeLaw, optional
            Law in time of the copies; by default that of each original.
        """
        indices = list(which)
        count = len(self.labels)
        correlation = np.zeros((count + len(indices),) * 2)
        correlation[:count, :count] = self.correlation
        correlation[count:, count:] = self.correlation[np.ix_(indices, indices)]

        def more(values: tuple[str, ...]) -> tuple[str, ...]:
            return (*values, *(values[k] for k in indices))

        return Disturbances(
            self.name,
            more(self.labels),
            more(self.bodies),
            more(self.causes),
            np.append(self.sigmas, times * self.sigmas[indices]),
            more(self.units),
            np.concatenate([self.spots, times * self.spots[:, indices]], axis=1),
            np.concatenate([self.parameters, times * self.parameters[:, indices]], axis=1),
            correlation,
            (*self.laws, *(law or self.laws[k] for k in indices)),
            self.jump_false_alarm,
        )

    def best_gain(self, noise: Array) -> Array:
        """Return the gain of the best linear unbiased prediction of the parameters, (..., 4 K, D) rad and m per px.

        It is B C A' (A C A' + R)^-1, with the effects A (`spots`) and B (`parameters`) of the motions, their
        correlation C and the noise R.

        Dimensions: K cameras, D spot coordinates (row and column of every spot).

        Parameters
        ----------
        noise : (..., D, D) ndarray
            Covariance R of the shifts, px^2.
        """
        return self._best(self.parameters, noise)

    def best_amounts(self, noise: Array) -> Array:
        """Return the gain of the best linear prediction of the motions, (..., M, D) prior standard deviations per px.

        It is C A' (A C A' + R)^-1, with the effect A (`spots`) of the motions on the spots, their correlation C and the
        noise R.

        Dimensions: M motions, D spot coordinates (row and column of every spot).

        Parameters
        ----------
        noise : (..., D, D) ndarray
            Covariance R of the shifts, px^2.
        """
        return self._best(np.eye(len(self.labels)), noise)

    def _best(self, rows: Array, noise: Array) -> Array:
        across = rows @ self.correlation @ self.spots.T
        spread = self.spot_covariance + noise
        if np.any(noise):
            return np.asarray(np.swapaxes(np.linalg.solve(spread, across.T), -1, -2))
        # without noise, what moves no spot has no say; spots move by pixels for one standard deviation
        return np.asarray(across @ np.linalg.pinv(spread, rcond=1e-13, hermitian=True))

    def misfit(self, gain: Array) -> Array:
        """Return the covariance of an estimator's error that the motions cause without any noise, (..., 4 K, 4 K).

        Dimensions: K cameras, D spot coordinates (row and column of every spot).

        Parameters
        ----------
        gain : (..., 4 K, D) ndarray
            Gain of the estimator, parameters per px.
        """
        left = (gain @ self.spots - self.parameters) @ self.root
        return np.asarray(left @ np.swapaxes(left, -1, -2))


@dataclass(frozen=True)
class Suspect:
    """Body whose motion would explain shifts that contradict the prior.

    Attributes
    ----------
    body : str
        Path of the body.
    times : float
        Factor of its prior standard deviations that explains the shifts best.
    gain : float
        Increase of the log likelihood of the shifts if the prior is widened by that factor.
    """

    body: str
    times: float
    gain: float


@shows()
@dataclass(frozen=True)
class Consistency:
    """Test of the measured shifts against the prior and the noise (predictive chi-square).

    Attributes
    ----------
    chi_square : float
        Chi-square of the shifts s, s' (A C A' + R)^-1 s, with their covariance A C A' under the prior and R due to
        noise.
    degrees : int
        Degrees of freedom, the number of spot coordinates.
    limit : float
        Limit of ``chi_square``, exceeded with probability ``false_alarm`` by shifts in accordance with the prior.
    suspects : tuple of Suspect
        Bodies that would explain a contradiction, the best first; empty where there is none.
    false_alarm : float
        Probability for which ``limit`` holds.
    sigma_noise : float
        Standard deviation of ``chi_square`` due to the noise of the images, to first order.
    """

    chi_square: float
    degrees: int
    limit: float
    suspects: tuple[Suspect, ...] = ()
    false_alarm: float = FALSE_ALARM
    sigma_noise: float = 0.0

    @property
    def agrees(self) -> bool:
        """True if the shifts agree with the prior: chi-square does not exceed the limit."""
        return self.chi_square <= self.limit

    @property
    def p_value(self) -> float:
        """Probability of a chi-square at least this large if the prior is right (p-value)."""
        return float(p_value_of(self.chi_square, self.degrees))

    @property
    def p_value_sigma_noise(self) -> float:
        """Standard deviation of the p-value ``p_value`` due to the noise of the images, to first order."""
        return float(density(self.chi_square, self.degrees)) * self.sigma_noise

    @staticmethod
    def power(times: float, degrees: int) -> float:
        """Return the probability of detecting that the disturbances exceed the prior by a common factor.

        The noise is assumed to be small.

        Parameters
        ----------
        times : float
            Factor of the standard deviations.
        degrees : int
            Number of spot coordinates.
        """
        return float(p_value_of(limit_of(FALSE_ALARM, degrees) / times**2, degrees))


def chi_squares(shifts: Array, noise: Array, prior: Disturbances) -> Array:
    """Return the chi-square of each of T measurements against the prior, (T,), without a search for causes.

    Dimensions: D spot coordinates (row and column of every spot).

    Parameters
    ----------
    shifts : (T, D) ndarray
        Measured shifts, px.
    noise : (T, D, D) ndarray
        Covariance of the spot shifts due to noise, px^2.
    prior : Disturbances
        Prior of the disturbances (motions of bodies), with their effects on spots and parameters.
    """
    return np.array([consistency(s, r, prior, {}, 0.0).chi_square for s, r in zip(shifts, noise, strict=True)])


def consistency(
    shift: Array,
    noise: Array,
    prior: Disturbances,
    others: Mapping[str, Array] | None = None,
    false_alarm: float = FALSE_ALARM,
) -> Consistency:
    """Test one measurement against the prior by its predictive chi-square.

    Dimensions: D spot coordinates (row and column of every spot), k motions of the body.

    Parameters
    ----------
    shift : (D,) ndarray
        Measured shifts, px.
    noise : (D, D) ndarray
        Covariance of the spot shifts due to noise, px^2.
    prior : Disturbances
        Prior of the disturbances (motions of bodies), with their effects on spots and parameters.
    others : mapping of str to (D, k) ndarray, or None
        Further bodies that the prior does not contain, with the spot shifts of their motions, px, that are tested as
        suspects too.
    false_alarm : float
        Probability that shifts in accordance with the prior are called a contradiction; for one of T measurements that
        are tested together, a T-th of the common probability.
    """
    spread = prior.spot_covariance + noise
    root = np.linalg.cholesky(spread)
    white = np.linalg.solve(root, shift)
    square, count = float(white @ white), len(shift)
    limit = float(limit_of(false_alarm, count))
    slope = np.linalg.solve(root.T, white)
    moved = 2.0 * float(np.sqrt(slope @ noise @ slope))
    if square <= limit:
        return Consistency(square, count, limit, (), false_alarm, moved)
    candidates = {body: prior.spots[:, [b == body for b in prior.bodies]] for body in dict.fromkeys(prior.bodies)}
    candidates |= {body: np.asarray(table) for body, table in (others or {}).items() if body not in candidates}
    suspects = []
    for body, table in candidates.items():
        u, s, _ = np.linalg.svd(np.linalg.solve(root, table), full_matrices=False)
        # log likelihood of white under I + x U S^2 U' against that under I
        added = _INFLATIONS[:, None] * s**2
        gain = 0.5 * np.sum((u.T @ white) ** 2 * added / (1.0 + added) - np.log1p(added), axis=1)
        best = int(np.argmax(gain))
        suspects.append(Suspect(body, float(np.sqrt(1.0 + _INFLATIONS[best])), float(gain[best])))
    suspects.sort(key=lambda suspect: -suspect.gain)
    return Consistency(
        square, count, limit, tuple(suspect for suspect in suspects if suspect.gain > 0.0), false_alarm, moved
    )
