"""What is stated to move between two measurements, as the analysis needs it: what one standard deviation of each motion
does to the spots and to the cameras, and how motions go together.

Spots and parameters are linear in the M motions, s = A x and p = B x with x ~ N(0, C); a column of A and B is of one
standard deviation, so that C is a correlation matrix. The prior of p is B C B', that of s is A C A' + R, R the noise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from analysis.arrays import Array, shows
from analysis.statistics import chance_beyond, density, limit_of
from optics.numerics.array_math import covariance_root

FALSE_ALARM = 1e-3
"""Chance that shifts within what is stated are called a contradiction."""
_INFLATIONS = np.logspace(0.0, 8.0, 161)
"""By how much the variance of a body is tried to be larger than stated."""


@dataclass(frozen=True)
class TimeLaw:
    """Covariance of a disturbance at two times, where 1 is the square of its stated standard deviation.

    The law is g(t) g(t') rho(t - t') C(t, t'): an amplitude that is known but for its size, a correlation over the gap,
    and the chance that a step has come by both times. Each factor is positive semidefinite, and so is their product.

    Attributes
    ----------
    white : bool
        Independent at different times; all others are then None.
    drift_s : float | None
        Time in which it forgets where it was, seconds, None for never.
    period_s : float | None
        It comes back with, seconds, None for none.
    trend_s : float | None
        It grows linearly, g = (t - since) / trend_s; seconds, None for no growth.
    relaxation_s : float | None
        It goes to a new value, g = 1 - exp(-(t - since) / relaxation_s) and 0 before; None for none.
    since_s : float
        Where trend and relaxation start, seconds.
    event : tuple[tuple[float, float], ...]
        a step, (time, chance that it has come by then) in the order of time, linear between; one entry (time, 1) for a
        known moment; above 1 it is the mean number of steps of many. C is the chance at the earlier of two times: at a
        time that is not sure to be after the step the motion is known the less. Empty for no step.
    jump : bool
        a step whose time nobody knows: it counts as not there until it is found (`jump_detection`), and is then an
        event. All others but ``every_s`` are then as by default.
    every_s : float | None
        Mean time between two such steps, seconds; None where nothing is stated, and what is too small to be found then
        counts as not there.

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

    def covariance(self, one: ArrayLike, two: ArrayLike) -> Array:
        """Between times, seconds, of shapes that broadcast; of the shape that both have together."""
        first, second = np.asarray(one, np.float64), np.asarray(two, np.float64)
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
            out = out * self.come(np.minimum(first, second))
        return np.asarray(out)

    def come(self, time: ArrayLike) -> Array:
        """Chance that the step of an event has come by times, seconds, of any shape."""
        at, chance = np.array(self.event).T
        when = np.asarray(time, np.float64)
        if len(at) == 1:
            return np.asarray((when >= at[0]) * chance[0])
        return np.asarray(np.interp(when, at, chance))

    def over(self, then: float, now: float) -> tuple[float, float, float]:
        """Variance at one time, covariance with a later one and variance there; a jump may have come between them.

        Parameters
        ----------
        then : float
            The earlier time, seconds.
        now : float
            The later one.
        """
        if self.jump:
            return 0.0, 0.0, 1.0
        times = ((then, then), (then, now), (now, now))
        before, across, after = (float(self.covariance(*pair)) for pair in times)
        return before, across, after

    def amplitude(self, time: Array) -> Array:
        """g(t) of a trend and of a relaxation; 1 without them."""
        out, since = np.ones_like(time), time - self.since_s
        if self.trend_s is not None:
            out = out * since / self.trend_s
        if self.relaxation_s is not None:
            out = out * -np.expm1(-np.maximum(since, 0.0) / self.relaxation_s)
        return out


@shows("name", "labels", "spots [px]")
@dataclass(frozen=True, eq=False)
class Disturbances:
    """Stated disturbances of K cameras with D spot coordinates together.

    Attributes
    ----------
    name : str
        Of the statement.
    labels : tuple[str, ...]
        (M,) names of the motions: ``base/forward/M2 shift z``.
    bodies : tuple[str, ...]
        (M,) whose they are.
    causes : tuple[str, ...]
        (M,) to which of the stated causes they belong.
    sigmas : Array
        (M,) standard deviations in units for people; units: (M,) these units.
    spots : Array
        (D, M) px for one standard deviation, spots in the order of the calibration, each row then column.
    parameters : Array
        (4 K, M) d_alpha, d_beta, d_gamma (rad), d_f (m) of one camera after the other, likewise.
    correlation : Array
        (M, M), positive semidefinite.
    laws : tuple[TimeLaw, ...]
        (M,) in time.
    jump_false_alarm : float
        Chance that a series without a jump has one reported, over all times and motions together.

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
        """Check shapes. Raises ValueError."""
        count = len(self.labels)
        shapes = {
            "spots": (self.spots.shape[0], count),
            "parameters": (self.parameters.shape[0], count),
            "correlation": (count, count),
            "sigmas": (count,),
        }
        for name, shape in shapes.items():
            found = getattr(self, name).shape
            if found != shape:
                raise ValueError(f"disturbances: {name} must be {shape} for {count} motions, found {found}")
        if not all(len(getattr(self, name)) == count for name in ("bodies", "causes", "units", "laws")):
            raise ValueError(f"disturbances: {count} motions need as many bodies, causes, units and laws")

    @classmethod
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
        """Return disturbances from plain arrays, each motion of a body of its own.

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
        """(M, M) with root root' = correlation: what independent numbers of unit variance make of the motions."""
        return covariance_root(self.correlation)

    @cached_property
    def spot_covariance(self) -> Array:
        """(D, D) px^2 of the shifts without noise."""
        root = self.spots @ self.root
        return np.asarray(root @ root.T)

    @cached_property
    def parameter_covariance(self) -> Array:
        """(4 K, 4 K) rad^2, rad m, m^2, before any measurement."""
        root = self.parameters @ self.root
        return np.asarray(root @ root.T)

    def scaled(self, factors: Sequence[float] | Array) -> Disturbances:
        """Disturbances whose motions have their standard deviations times factors (M,).

        Parameters
        ----------
        factors : Sequence[float] | Array
            One for each motion; 0 takes it out.
        """
        f = np.asarray(factors, np.float64)
        return replace(self, sigmas=self.sigmas * f, spots=self.spots * f, parameters=self.parameters * f)

    def between(self, then: float, now: float) -> Disturbances:
        """Disturbances from one time to another, in place of those from what the instrument is meant to be.

        Parameters
        ----------
        then : float
            The earlier time, seconds.
        now : float
            The later one.
        """
        over = np.array([law.over(then, now) for law in self.laws]).reshape(-1, 3)
        return self.scaled(np.sqrt(np.maximum(over[:, 0] + over[:, 2] - 2.0 * over[:, 1], 0.0)))

    def with_copies(self, which: Sequence[int], times: float, law: TimeLaw) -> Disturbances:
        """Disturbances with copies of some motions beside them, which go together as those do and are independent of
        them.

        Parameters
        ----------
        which : Sequence[int]
            Numbers of the motions.
        times : float
            Standard deviations of the copies over those of the motions.
        law : TimeLaw
            Of the copies in time.
        """
        own = list(which)
        count = len(self.labels)
        correlation = np.zeros((count + len(own),) * 2)
        correlation[:count, :count] = self.correlation
        correlation[count:, count:] = self.correlation[np.ix_(own, own)]

        def more(values: tuple[str, ...]) -> tuple[str, ...]:
            return (*values, *(values[k] for k in own))

        return Disturbances(
            self.name,
            more(self.labels),
            more(self.bodies),
            more(self.causes),
            np.append(self.sigmas, times * self.sigmas[own]),
            more(self.units),
            np.concatenate([self.spots, times * self.spots[:, own]], axis=1),
            np.concatenate([self.parameters, times * self.parameters[:, own]], axis=1),
            correlation,
            (*self.laws, *(law,) * len(own)),
            self.jump_false_alarm,
        )

    def best_gain(self, noise: Array) -> Array:
        """Parameters per pixel of the best linear unbiased prediction, B C A' (A C A' + R)^-1, (..., 4 K, D).

        Parameters
        ----------
        noise : Array
            R, (..., D, D) of the shifts, px^2.
        """
        return self._best(self.parameters, noise)

    def best_amounts(self, noise: Array) -> Array:
        """Motions of the best prediction in standard deviations per pixel, C A' (A C A' + R)^-1, (..., M, D).

        Parameters
        ----------
        noise : Array
            R, (..., D, D) of the shifts, px^2.
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
        """(..., 4 K, 4 K) covariance of what an estimator makes wrong of the motions themselves.

        Parameters
        ----------
        gain : Array
            Parameters per pixel of an estimator, (..., 4 K, D).
        """
        left = (gain @ self.spots - self.parameters) @ self.root
        return np.asarray(left @ np.swapaxes(left, -1, -2))


@dataclass(frozen=True)
class Suspect:
    """A body whose motion would explain shifts that contradict the statement.

    Attributes
    ----------
    body : str
        Its path.
    times : float
        How many times its stated standard deviations would have to be larger.
    gain : float
        Of the log likelihood by that.
    """

    body: str
    times: float
    gain: float


@shows()
@dataclass(frozen=True)
class Consistency:
    """Do the measured shifts agree with disturbances and noise?

    Attributes
    ----------
    chi_square : float
        s' (A C A' + R)^-1 s.
    degrees : int
        Of freedom, the number of spot coordinates.
    limit : float
        Of ``chi_square``, exceeded with a chance of ``false_alarm`` by shifts that are as stated.
    suspects : tuple[Suspect, ...]
        Bodies that would explain a contradiction, the best first; empty where there is none.
    false_alarm : float
        The chance that ``limit`` is for.
    sigma_noise : float
        By how much the noise of the images moves ``chi_square``, one standard deviation, to first order.
    """

    chi_square: float
    degrees: int
    limit: float
    suspects: tuple[Suspect, ...] = ()
    false_alarm: float = FALSE_ALARM
    sigma_noise: float = 0.0

    @property
    def agrees(self) -> bool:
        """Below the limit."""
        return self.chi_square <= self.limit

    @property
    def chance(self) -> float:
        """Probability of so large a chi-square by shifts that are as stated."""
        return float(chance_beyond(self.chi_square, self.degrees))

    @property
    def chance_sigma_noise(self) -> float:
        """Standard deviation of ``chance`` by the noise of the images, to first order."""
        return float(density(self.chi_square, self.degrees)) * self.sigma_noise

    @staticmethod
    def power(times: float, degrees: int) -> float:
        """Chance to find disturbances that are all so many times larger than stated, where noise is small.

        Parameters
        ----------
        times : float
            Larger standard deviations.
        degrees : int
            Number of spot coordinates.
        """
        return float(chance_beyond(limit_of(FALSE_ALARM, degrees) / times**2, degrees))


def chi_squares(shifts: Array, noise: Array, stated: Disturbances) -> Array:
    """Return (T,) the predictive chi-square of each of T measurements by itself; no suspects are looked for.

    Parameters
    ----------
    shifts : Array
        (T, D) measured, px.
    noise : Array
        (T, D, D) their covariance, px^2.
    stated : Disturbances
        What was to be expected.
    """
    return np.array([consistency(s, r, stated, {}, 0.0).chi_square for s, r in zip(shifts, noise, strict=True)])


def consistency(
    shift: Array,
    noise: Array,
    stated: Disturbances,
    others: Mapping[str, Array] | None = None,
    false_alarm: float = FALSE_ALARM,
) -> Consistency:
    """Predictive chi-square of one measurement.

    Parameters
    ----------
    shift : Array
        (D,) measured, px.
    noise : Array
        (D, D) its covariance, px^2.
    stated : Disturbances
        What was to be expected.
    others : Mapping[str, Array] | None
        Bodies of which nothing is stated -> what motions of theirs do to the spots, (D, k) px, to be suspected too.
    false_alarm : float
        Chance that shifts as stated are called a contradiction; of one of T measurements that are tested together a
        T-th of what all may have.
    """
    spread = stated.spot_covariance + noise
    root = np.linalg.cholesky(spread)
    white = np.linalg.solve(root, shift)
    square, count = float(white @ white), len(shift)
    limit = float(limit_of(false_alarm, count))
    slope = np.linalg.solve(root.T, white)
    moved = 2.0 * float(np.sqrt(slope @ noise @ slope))
    if square <= limit:
        return Consistency(square, count, limit, (), false_alarm, moved)
    candidates = {body: stated.spots[:, [b == body for b in stated.bodies]] for body in dict.fromkeys(stated.bodies)}
    candidates |= {body: np.asarray(table) for body, table in (others or {}).items() if body not in candidates}
    found = []
    for body, table in candidates.items():
        u, s, _ = np.linalg.svd(np.linalg.solve(root, table), full_matrices=False)
        # log likelihood of white under I + x U S^2 U' against that under I
        added = _INFLATIONS[:, None] * s**2
        gain = 0.5 * np.sum((u.T @ white) ** 2 * added / (1.0 + added) - np.log1p(added), axis=1)
        best = int(np.argmax(gain))
        found.append(Suspect(body, float(np.sqrt(1.0 + _INFLATIONS[best])), float(gain[best])))
    found.sort(key=lambda one: -one.gain)
    return Consistency(square, count, limit, tuple(one for one in found if one.gain > 0.0), false_alarm, moved)
