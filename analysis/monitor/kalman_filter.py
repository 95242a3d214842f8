"""Kalman filter and smoother of a series of readings, with sequential detection of jumps.

**Filter.** It works on the `state_space` of the prior, with the same effort for every reading. A second filter detects
jumps: for a step just before each of the last readings it keeps the effect of that step on its innovations (Willsky,
Jones, IEEE Trans. Automat. Contr. 21, 1976, 108). Outputs are all values that readings may contain. With X the response
of the estimated states to a step of one unit of each output, and H the observation matrix, the response of an
innovation nu of covariance S is E = (outputs in the reading) - H X. The score b and the information J of the step,

    b = sum E' S^-1 nu,   J = sum E' S^-1 E,

serve the test in `jump_detection.most_likely_jump`, without processing a reading twice. The false-alarm probability
counts every test of the whole life: readings, times of the step and candidates (Boole's inequality, a bound). A
detected jump changes the estimate as if it had been known all along: by (G - X) times its amounts, with G the effect of
steps on the states, averaged over the readings between which it can have occurred. Sigma is therefore wide where the
time is not known. All jumping motions of the body are then free to have jumped: information on the others cannot be
recovered later, since the step hypotheses are discarded.

A reading that is more likely bad than the first after a jump is set aside (`filter_state`). The next one decides: the
states with and without it are both continued until one of the two predicts that reading better. The estimate in the
meantime is their mixture.

Jumps too small to be detected are represented by a random walk of their mean square, as in
`jump_detection.with_subthreshold_jumps`, and the present and future estimates include those indicated by the last
readings with their probabilities (`filter_state`).

**Smoother.** It processes the same readings backwards (Bryson, Frazier; de Jong, J. Am. Stat. Assoc. 84, 1989, 1085):
it needs no inverse of a covariance, and of the filter only quantities of the size of a reading. It works in pieces, the
filter being run a second time in each, so that memory does not grow with states times readings. It also yields score
and information of a step before every reading, by all readings (de Jong, Penzer, J. Am. Stat. Assoc. 93, 1998, 796): a
first backward pass finds the undetected jumps that the readings indicate (`filter_state`), and the second one treats
these as steps with their probabilities and sizes.

**Detection limit.** The size of a jump that is detected is found for each body by simulation of the test. After many
readings at even intervals, the effect of a step on the next ones no longer depends on its time. With the information J
of n readings on a step of the outputs, the score of n readings after a step a is

    b(n) = b(n-1) + N((J(n) - J(n-1)) a, J(n) - J(n-1)),

so that the readings themselves need not be drawn. Directions of a are random as in the prior, and its size is the root
mean square of its motions over their prior standard deviations. The jump is detected with the first reading at which
any candidate passes the limit of the search, at the place before the first reading after it alone: neighbouring places
can only detect it earlier.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dpotrf, dtrtrs

from analysis.arrays import Array, UndeterminedError
from analysis.monitor.disturbances import Disturbances
from analysis.monitor.filter_state import (
    RECENT,
    BadReading,
    FilterState,
    Innovation,
    JumpingBody,
    Observed,
    PendingReading,
    Track,
    Whitened,
    bad_reading,
    jump_evidence,
    jump_probabilities,
    jumping_bodies,
    may_be_bad,
    probability_good,
    undetected,
    undetected_variance,
)
from analysis.monitor.jump_detection import (
    UNOBSERVABLE,
    Amounts,
    Bodies,
    Candidate,
    Jump,
    Step,
    Steps,
    candidates,
    jump_mixture,
    knots,
    mixture_moments,
    most_likely_jump,
    subthreshold_share,
)
from analysis.monitor.learned_terms import Terms
from analysis.monitor.state_space import HeatInputs, StateSpace
from analysis.statistics import limit_of
from optics.numerics.array_math import covariance_root

_NEARLY = 1e-11
"""Number added to the diagonal of an information matrix before inversion, relative to the sum of its eigenvalues."""


@dataclass(frozen=True, eq=False)
class _Evaluation:
    """Result of processing a reading of the spots, before it is decided whether the reading is bad.

    Attributes
    ----------
    before, after : FilterState
        State of the filter at the time of the reading, without it and with it.
    innovation : Innovation
        Difference of the reading from its prediction, with the decisions that followed.
    log_odds : float
        Logarithm of the odds that it is bad.
    likely : float
        Logarithm of the predicted probability density at the reading, whether it is good or bad, with a jump or without
        one.
    bad : BadReading or None
        Evidence that it is bad; None where that was not computed.
    """

    before: FilterState
    after: FilterState
    innovation: Innovation
    log_odds: float
    likely: float
    bad: BadReading | None = None


@dataclass(frozen=True, eq=False)
class SeriesFilter:
    """Kalman filter of the disturbances, with detection of jumps and of bad readings.

    Dimensions: D spot coordinates (row and column of every spot).

    Attributes
    ----------
    prior : Disturbances
        Prior of the motions with their laws in time.
    reference_noise : (D, D) ndarray or None
        Noise of the spots that shifts are counted from, px^2; None if there is none.
    heat : HeatInputs or None
        Temperatures that sensors read; None if there is none.
    life_s : float
        Time over which ``prior.jump_false_alarm`` counts, all tests together, s: each test gets its share by the ratio
        of the time between its two readings to the life, whatever the cadence of the readings.
    window : int
        Number of readings within which a jump is searched for.
    stepping : tuple of int
        Indices of motions that may step although they have another law.
    parameters_read : bool
        True if there are readings of parameters among those of spots.
    steps : tuple of Step
        Steps known in addition to the prior.
    include_undetected : bool
        True to include jumps too small to be detected, where their rate is known.
    before_s : float
        Time before the first reading of spots in which bodies may have jumped, s; 0 if there is none.
    leaving_out : bool
        True if a reading may be excluded as bad.
    terms : Terms or None
        Known functions of time with learned amounts, such as decays and commanded moves; None if there are none.
    candidates : tuple of Candidate
        Candidates for jumps, single motions and those of a body together.
    """

    prior: Disturbances
    reference_noise: Array | None = None
    heat: HeatInputs | None = None
    life_s: float = 10.0 * 365.25 * 86_400.0
    window: int = 60
    stepping: tuple[int, ...] = ()
    parameters_read: bool = False
    steps: tuple[Step, ...] = ()
    include_undetected: bool = True
    before_s: float = 0.0
    leaving_out: bool = True
    terms: Terms | None = None
    candidates: tuple[Candidate, ...] = field(init=False, default=())

    def __post_init__(self) -> None:
        object.__setattr__(self, "candidates", candidates(self._stacked) if self.window else ())

    @cached_property
    def space(self) -> StateSpace:
        """State space (states, their transitions and their effects) of the disturbances."""
        return StateSpace(self.prior, self.reference_noise, self.heat, self.stepping, self.terms)

    @cached_property
    def _step_levels(self) -> list[Array]:
        """Covariance that each known step adds to the states, one array (n, n) for each step.

        Dimensions: n states of the filter.
        """
        out = []
        for step in self.steps:
            if step.moment is not None:
                does = self.space.level_inverse
                out.append(_symmetric(does @ step.moment @ does.T))
                continue
            together = np.zeros((self.space.size, self.space.size))
            for motions, variance in step.parts:
                members = list(motions)
                level = self.space.level_of(members)
                together += variance * level @ self.prior.correlation[np.ix_(members, members)] @ level.T
            out.append(_symmetric(together))
        return out

    @cached_property
    def _step_ends(self) -> Array:
        """First and last possible time of each of the S known steps, (S, 2) s."""
        return np.array([(step.time_distribution[0][0], step.time_distribution[-1][0]) for step in self.steps]).reshape(
            -1, 2
        )

    def _with_steps(self, covariance: Array, then: float, now: float) -> Array:
        """Return a covariance of the states with the variance of all known steps between two times added."""
        if not self.steps:
            return covariance
        ends = self._step_ends
        for k in np.flatnonzero((ends[:, 1] > then) & (ends[:, 0] <= now)).tolist():
            step = self.steps[k]
            gained = step.step_probability(now) - (step.step_probability(then) if math.isfinite(then) else 0.0)
            if gained > 0.0:
                covariance = covariance + gained * self._step_levels[k]
        return covariance

    @cached_property
    def _stacked(self) -> Disturbances:
        """Prior whose spots are replaced by all outputs that readings may contain: spots, sensors and parameters."""
        if not self.parameters_read:
            return self.prior
        return replace(self.prior, spots=np.concatenate([self.prior.spots, self.prior.parameters]))

    @cached_property
    def walking(self) -> NDArray[np.int_]:
        """Indices of the motions that jump at a known rate, (m,).

        A random walk in the filter represents those of their jumps that are too small to be detected.

        Dimensions: m motions that jump at a known rate.
        """
        indices = [k for k, law in enumerate(self.prior.laws) if law.every_s is not None and self.include_undetected]
        return np.array(indices, int)

    @cached_property
    def _walk(self) -> Array:
        """Random walk of undetected jumps: its effect on the level states per root of time, (r, m).

        These are the states that steps change. Column by column it is the effect of a jump of one prior standard
        deviation of each motion with a known jump rate, times the root of that rate.

        Dimensions: r states that steps change, m motions that jump at a known rate.
        """
        rates = np.array([1.0 / float(self.prior.laws[k].every_s or 1.0) for k in self.walking])
        return self.space.level_of(self.walking.tolist())[self.space.level] * np.sqrt(rates)

    def looks(self, between: ArrayLike) -> Array:
        """Return the number of tests for a jump over the whole life, by which the false-alarm probability is divided.

        Parameters
        ----------
        between : array_like
            Time between the two readings of the test, s, of any shape.
        """
        share = np.asarray(between, np.float64) / self.life_s
        return np.asarray(self.window * len(self.candidates) / np.minimum(share, 1.0))

    def _limit(self, current: FilterState) -> float:
        """Return the smallest log likelihood ratio at which a jump can be detected, whatever its number of motions."""
        between = current.until - current.after
        return float(limit_of(self.prior.jump_false_alarm / self.looks(between.max()), 1))

    def start(self, time: float) -> FilterState:
        """Return the state of the filter before any reading, as the prior gives it.

        Parameters
        ----------
        time : float
            Time of that state, s, not later than the first reading.
        """
        mean, covariance = self.space.start(time)
        covariance = self._with_steps(covariance, -math.inf, time)
        size, q = self.space.size, self._stacked.spots.shape[0]
        track = Track(mean, covariance, np.zeros((0, size, q)), np.zeros((0, q)), np.zeros((0, q, q)))
        empty, left = np.zeros(0), np.ones(len(self.walking))
        return FilterState(time, math.nan, empty, empty, track, track if len(left) and self.candidates else None, left)

    def at(self, current: FilterState, time: float) -> FilterState:
        """Return the state predicted for a later time if there are no further readings.

        Parameters
        ----------
        current : FilterState
            State so far.
        time : float
            Time, s.
        """
        state = self._propagated(current.state, current.time, time, current.undetected)
        search = None if current.search is None else self._propagated(current.search, current.time, time, None)
        pending = current.pending and replace(current.pending, ingested=self.at(current.pending.ingested, time))
        return replace(current, time=max(time, current.time), state=state, search=search, pending=pending)

    def _propagated(self, track: Track, then: float, now: float, left: Array | None) -> Track:
        if now <= then:
            return track
        space = self.space
        covariance = self._with_steps(space.spread(track.covariance, then, now), then, now)
        if left is not None and len(left):
            covariance = self._with_random_walk(covariance, left, now - then)
        mean = space.moved(track.mean[:, None], then, now)[:, 0]
        response = space.moved(track.response, then, now) if len(track.response) else track.response
        return Track(mean, covariance, response, track.score, track.information)

    def _with_random_walk(self, covariance: Array, left: Array, over: float) -> Array:
        walk, level = self._walk * np.sqrt(left * over), self.space.level
        out = covariance.copy()
        out[level, level] += walk @ walk.T
        return out

    def with_random_walk(self, current: FilterState, left: Array, over: float) -> FilterState:
        """Return the filter's state with the variance of undetected jumps (a random walk) over a time added.

        Dimensions: m motions that jump at a known rate.

        Parameters
        ----------
        current : FilterState
            State without the undetected jumps.
        left : (m,) ndarray
            Share of the mean square of jumps that is not detected.
        over : float
            Length of the time, s.
        """
        covariance = self._with_random_walk(current.covariance, left, over)
        return replace(current, state=replace(current.state, covariance=covariance))

    def inflated(self, current: FilterState, observed: Observed, times: float) -> FilterState:
        """Return the state with the predicted uncertainty of one sensor's reading increased.

        The covariance of the states is increased in the direction of its reading, and unchanged in all others.

        Parameters
        ----------
        current : FilterState
            State at the time of the reading.
        observed : Observed
            One value of a sensor.
        times : float
            Factor of the standard deviation of its reading.
        """

        def loose(track: Track) -> Track:
            rows = self.read(track.mean, track.covariance, observed)[1]
            along = track.covariance @ rows[0]
            more = (times**2 - 1.0) / float(rows[0] @ along) * np.outer(along, along)
            return replace(track, covariance=track.covariance + more)

        put = current.pending and replace(
            current.pending, ingested=self.inflated(current.pending.ingested, observed, times)
        )
        search = None if current.search is None else loose(current.search)
        return replace(current, state=loose(current.state), search=search, pending=put)

    def update(self, current: FilterState, observed: Observed, sure: bool = False) -> tuple[FilterState, Innovation]:
        """Update the state by one reading; return it with the reading's difference from its prediction.

        Parameters
        ----------
        current : FilterState
            State so far.
        observed : Observed
            Reading, not before the time of ``current``.
        sure : bool
            True if the reading has been declared good, so that it is not tested.

        Raises
        ------
        UndeterminedError
            The reading has no noise and repeats what is known exactly.
        """
        if not observed.spots:
            deferred = current.pending and replace(
                current.pending, ingested=self.update(current.pending.ingested, observed)[0]
            )
            now = self.at(replace(current, pending=None), observed.time)
            state, innovation = self.ingested(now.state, observed)
            search = None if now.search is None else self.ingested(now.search, observed)[0]
            return replace(now, state=state, search=search, pending=deferred), innovation
        pending = current.pending
        trial = self._evaluate(replace(current, pending=None), observed, pending is not None)
        if pending is not None:
            other = self._evaluate(pending.ingested, observed, True)
            accepted = pending.log_odds + trial.likely < other.likely
            if accepted:
                trial = replace(other, innovation=replace(other.innovation, earlier=pending.innovation))
            trial = replace(trial, innovation=replace(trial.innovation, settled=True))
            recent = (*current.recent[:-1], not accepted)
            trial = replace(
                trial, before=replace(trial.before, recent=recent), after=replace(trial.after, recent=recent)
            )
        if not sure and may_be_bad(trial.bad, trial.log_odds, trial.before.recent):
            innovation = replace(trial.innovation, bad=trial.bad)
            deferred = PendingReading(self._with_detection(trial.after)[0], innovation, trial.log_odds)
            return replace(trial.before, recent=(*trial.before.recent, True)[-RECENT:], pending=deferred), innovation
        after = replace(trial.after, recent=(*trial.after.recent, False)[-RECENT:])
        now, jump = self._with_detection(after, True)
        return now, replace(trial.innovation, jump=jump)

    def _evaluate(self, current: FilterState, observed: Observed, weighed: bool) -> _Evaluation:
        """Return the filter's state without and with a reading of spots, and the evidence that the reading is bad.

        Parameters
        ----------
        current : FilterState
            State before, without a pending reading.
        observed : Observed
            Reading of spots.
        weighed : bool
            True to compute the density of the reading also where it is certainly good.
        """
        before = self.at(current, observed.time)
        now = before
        first = math.isnan(current.last) and self.before_s > 0.0
        if self.candidates and (first or observed.time > current.last):
            now = self._with_step(now, observed.time - self.before_s if first else current.last, observed.time)
        w = self.whitened(now.state, observed)
        state, innovation = self.ingested(now.state, observed, w)
        search, judged = None, innovation
        if now.search is not None:
            w = self.whitened(now.search, observed)
            search, judged = self.ingested(now.search, observed, w)
        after = replace(now, state=state, search=search, last=observed.time)
        bad = bad_reading(w.white, w.root, observed.noise) if self.leaving_out else None
        if bad is None and not weighed:
            return _Evaluation(before, after, innovation, -math.inf, judged.log_score)
        log_ratio = -math.inf if bad is None else bad.log_ratio
        gap = now.until - now.after
        jumping = [
            jump_evidence(each.jump_track, gap, self._jumping, self.life_s, observed.noise) for each in (now, after)
        ]
        good = jumping[1] - jumping[0]
        likely = judged.log_score + float(np.logaddexp(log_ratio, good))
        return _Evaluation(before, after, innovation, log_ratio - good, likely, bad)

    def _with_detection(self, current: FilterState, telling: bool = False) -> tuple[FilterState, Jump | None]:
        """Return the state after a test for jumps, and the jump that is detected, or None.

        The state contains the fraction of the mean square of jumps that is too small to be detected.
        """
        if not (self.candidates and len(current.until)):
            return current, None
        now = replace(current, undetected=self._undetectable_share(current))
        jump = self._detected(now) if telling else None
        return (now, None) if jump is None else self._with_jump(now, jump)

    def _with_step(self, current: FilterState, after: float, until: float) -> FilterState:
        """Return the state with a hypothesis of a step before a reading added; the oldest hypothesis is discarded."""
        start = max(0, len(current.until) + 1 - self.window)

        def more(track: Track) -> Track:
            q = track.score.shape[1]
            return replace(
                track,
                response=np.concatenate([track.response[start:], np.zeros((1, self.space.size, q))]),
                score=np.concatenate([track.score[start:], np.zeros((1, q))]),
                information=np.concatenate([track.information[start:], np.zeros((1, q, q))]),
            )

        return replace(
            current,
            after=np.append(current.after[start:], after),
            until=np.append(current.until[start:], until),
            state=more(current.state),
            search=None if current.search is None else more(current.search),
        )

    def read(self, mean: Array, covariance: Array, observed: Observed) -> tuple[Array, Array, Array, Array]:
        """Return the predicted reading, its derivatives and its covariance, for comparison with the actual reading.

        The result holds the prediction (d,), its derivatives with respect to the states (d, n), the covariance of noise
        and second-order terms (d, d), and the effect of unit outputs on the reading (d, q).

        Dimensions: d values of the reading, n states of the filter, q values that readings can contain (outputs).

        Parameters
        ----------
        mean : (n,) ndarray
            Mean of the states at its time.
        covariance : (n, n) ndarray
            Covariance of the states.
        observed : Observed
            Reading.
        """
        width, q = self.space.width, self._stacked.spots.shape[0]
        if observed.sensors:
            rows = self.space.sensor_rows(observed.sensors, observed.time)
            return rows @ mean, rows, observed.noise, np.zeros((len(rows), q))
        values, rows, left = self.space.outputs(mean, covariance, observed.time)
        if observed.parameters is None:
            return values[:width], rows[:width], observed.noise + left[:width, :width], np.eye(width, q)
        combinations = observed.parameters
        picked = np.concatenate([np.zeros((len(combinations), width)), combinations], axis=1)[:, :q]
        noise = observed.noise + combinations @ left[width:, width:] @ combinations.T
        return combinations @ values[width:], combinations @ rows[width:], noise, picked

    def whitened(self, track: Track, observed: Observed) -> Whitened:
        """Return a reading transformed to independent values of unit variance by the root of its predicted covariance.

        Parameters
        ----------
        track : Track
            Filter at its time.
        observed : Observed
            Reading.

        Raises
        ------
        UndeterminedError
            The reading has no noise and repeats what is known exactly.
        """
        expected, rows, noise, picked = self.read(track.mean, track.covariance, observed)
        across = track.covariance @ rows.T
        spread = rows @ across + noise
        # LAPACK directly: the overhead of NumPy and SciPy takes longer than matrices of this size
        root, failed = dpotrf(spread, lower=1, clean=1)
        if failed:
            raise UndeterminedError("filter: readings that repeat the same information need noise")
        both = np.concatenate([(observed.value - expected)[:, None], rows, across.T, picked], axis=1)
        both, _ = dtrtrs(root, both, lower=1)
        n = len(track.mean)
        return Whitened(root, both[:, 0], both[:, 1 : n + 1], both[:, n + 1 : 2 * n + 1], both[:, 2 * n + 1 :])

    def ingested(self, track: Track, observed: Observed, w: Whitened | None = None) -> tuple[Track, Innovation]:
        """Return a filter after one reading, and the difference of the reading from its prediction.

        Parameters
        ----------
        track : Track
            Filter propagated to the time of the reading.
        observed : Observed
            Reading.
        w : Whitened or None
            Whitened reading from `whitened`, if it has been computed already.
        """
        w = self.whitened(track, observed) if w is None else w
        covariance = track.covariance - w.gain.T @ w.gain  # symmetric to the bit, as the product is
        log_score = -0.5 * float(w.white @ w.white) - float(np.log(w.root.diagonal()).sum())
        log_score -= 0.5 * len(w.white) * math.log(2.0 * math.pi)
        response, score, information = track.response, track.score, track.information
        if len(score):
            seen = w.picked - w.rows @ response
            response = response + w.gain.T @ seen
            score = score + w.white @ seen
            information = information + seen.transpose(0, 2, 1) @ seen
        ingested = Track(track.mean + w.gain.T @ w.white, covariance, response, score, information)
        return ingested, Innovation(observed, w.white, log_score)

    def _undetectable_share(self, current: FilterState) -> Array:
        """Return the undetectable fraction of the mean square of jumps, (m,), from the oldest step hypothesis.

        Dimensions: m motions that jump at a known rate.
        """
        information, between = current.jump_track.information[0], current.until[0] - current.after[0]
        column = self._stacked.spots[:, self.walking]
        seen = np.sqrt(np.maximum(np.einsum("qm,qr,rm->m", column, information, column), 0.0))
        limit = math.sqrt(float(limit_of(self.prior.jump_false_alarm / self.looks(between), 1)))
        return subthreshold_share(limit, seen)

    def _detected(self, current: FilterState) -> Jump | None:
        """Return the most likely jump if it is significant at the false-alarm probability; None otherwise."""
        track = current.jump_track
        # no candidate explains more than arbitrary outputs would; the factor 1.01 covers rounding
        information = track.information + _NEARLY * np.trace(track.information, 0, 1, 2)[:, None, None] * np.eye(
            track.score.shape[1]
        )
        most = np.sum(track.score * np.linalg.solve(information, track.score[:, :, None])[:, :, 0], axis=1)
        if 1.01 * most.max() < self._limit(current):
            return None
        best = most_likely_jump(
            [Steps(current.after, current.until, track.score, track.information)], self.candidates, self._stacked
        )
        if best is None:
            return None
        # `most_likely_jump` counts its own tests of these readings
        alone = best.false_alarm / (len(self.candidates) * len(current.until))
        false_alarm = min(1.0, alone * float(self.looks(best.until - best.after)))
        if false_alarm > self.prior.jump_false_alarm:
            return None
        interval, seen = int(np.argmin(np.abs(current.until - best.until))), self.space.width
        rest = max(float(most[interval]) - 2.0 * best.log_ratio, 0.0), max(seen - len(best.motions), 1)
        return replace(best, false_alarm=false_alarm, rest=rest)

    def _with_jump(self, current: FilterState, jump: Jump) -> tuple[FilterState, Jump]:
        """Return the filter's state after it has included a detected jump, and the jump with its estimated sizes."""
        jump_track, info = ((track.score, track.information) for track in (current.jump_track, current.state))
        gap = current.until - current.after
        bodies = Bodies.of(self.candidates, jump, current.until, gap, jump_track, info)
        levels = [self.space.level_of(c.motions) @ c.root for c in bodies.candidates]
        state, search = current.state, current.search
        mean, covariance = bodies.known(state.mean, state.covariance, state.response, levels, bodies.amounts)
        state = replace(state.alone(), mean=mean, covariance=covariance)
        if search is not None:
            mean, covariance = bodies.known(search.mean, search.covariance, search.response, levels, bodies.judged)
            search = replace(search.alone(), mean=mean, covariance=covariance)
        # sizes are those of the motions that explain it best, if only these had jumped
        alone, weight = (next(c for c in self.candidates if c.motions == jump.motions), bodies.weight.sum(axis=0))
        named = Amounts.of(*info, alone.spots, jump.times)
        size, size_spread = mixture_moments(
            [named], [self.prior.sigmas[list(alone.motions), None] * alone.root], weight[None]
        )
        effects = [self.space.outputs_of(c.motions) @ c.root for c in bodies.candidates]
        change, spread = mixture_moments(bodies.amounts, effects, bodies.weight)
        empty = np.zeros(0)
        sized = replace(
            jump,
            sizes=tuple(size.tolist()),
            sigmas=tuple(np.sqrt(np.diag(size_spread)).tolist()),
            time_distribution=knots(current.after, current.until, weight),
            parts=bodies.parts,
            change=tuple(change.tolist()),
            spread=tuple(tuple(row) for row in spread.tolist()),
            width=self.space.width,
        )
        return replace(current, state=state, search=search, after=empty, until=empty), sized

    @cached_property
    def _jumping(self) -> tuple[JumpingBody, ...]:
        """All bodies that may jump; one without a known rate is assumed to jump once in the life of the filter."""
        return jumping_bodies(self.prior, self.candidates, self.life_s)

    @cached_property
    def jumping_bodies(self) -> tuple[JumpingBody, ...]:
        """Bodies whose jumps have a known rate (mean time between two jumps)."""
        return jumping_bodies(self.prior, self.candidates) if self.include_undetected else ()

    def mixture(self, current: FilterState) -> FilterState:
        """Return the filter's state including jumps not yet detected, each weighted by its probability.

        Later readings continue from the state that is passed in.

        Parameters
        ----------
        current : FilterState
            State so far.
        """
        if current.pending is not None:
            share = probability_good(current.pending.log_odds)
            bad, good = (self.mixture(state) for state in (replace(current, pending=None), current.pending.ingested))
            apart = good.mean - bad.mean
            covariance = (1.0 - share) * bad.covariance + share * good.covariance
            covariance = covariance + share * (1.0 - share) * np.outer(apart, apart)
            state = replace(bad.state.alone(), mean=bad.mean + share * apart, covariance=covariance)
            none = bad.until[:0]
            return replace(bad, after=none, until=none, state=state, search=None)
        if not self.jumping_bodies or not len(current.until):
            return current
        track, jump_track, hints, moved = current.state, current.jump_track, [], []
        for body in self.jumping_bodies:
            expected = (current.until - current.after) / body.every_s
            looked, evidence = ((t.score, t.information) for t in (jump_track, track))
            hints.append(undetected(looked, evidence, body.spots, expected))
            moved.append(self.space.level_of(body.motions) @ body.root - track.response @ body.spots)
        mean, covariance = jump_mixture(track.mean, track.covariance, jump_probabilities(hints), hints, moved)
        none = current.until[:0]
        return replace(
            current, after=none, until=none, state=replace(track.alone(), mean=mean, covariance=covariance), search=None
        )

    def parameters(self, current: FilterState, time: float) -> tuple[Array, Array]:
        """Return the changes of the camera parameters (P,), rad and m, and their covariance (P, P) at a time.

        Dimensions: P parameters.

        Parameters
        ----------
        current : FilterState
            State after the readings so far; the result of `mixture` includes undetected jumps.
        time : float
            Time not before that of the state, s.
        """
        state = self._propagated(current.state, current.time, time, current.undetected)
        return self.parameters_of(state.mean, state.covariance, time)

    def parameters_of(self, mean: Array, covariance: Array, time: float) -> tuple[Array, Array]:
        """Return the changes of the camera parameters (P,), rad and m, and their covariance (P, P) for given states.

        Dimensions: P parameters, n states of the filter.

        Parameters
        ----------
        mean : (n,) ndarray
            Mean of the states.
        covariance : (n, n) ndarray
            Covariance of the states.
        time : float
            Time of the states, s.
        """
        width = self.space.width
        values, rows, left = self.space.outputs(mean, covariance, time)
        parameter_rows = rows[width:]
        return values[width:], parameter_rows @ covariance @ parameter_rows.T + left[width:, width:]

    def motions_of(
        self, mean: Array, covariance: Array, time: float, since: float, acting: bool = False
    ) -> tuple[Array, Array]:
        """Return the estimated motions (M,) and their covariance (M, M), in prior standard deviations.

        Dimensions: M motions, n states of the filter.

        Parameters
        ----------
        mean : (n,) ndarray
            Mean of the states.
        covariance : (n, n) ndarray
            Covariance of the states.
        time : float
            Time of the states, s.
        since : float
            Time since which undetected jumps have accumulated, s.
        acting : bool
            True to multiply temperatures of bodies with sensors by the estimated factor of their effect on light, so
            that the motions computed from them are those that are estimated.
        """
        more = [(motions, variance * s.step_probability(time)) for s in self.steps for motions, variance in s.parts]
        for motion in self.walking.tolist():
            interval = float(self.prior.laws[motion].every_s or math.inf)
            more.append(((motion,), max(time - since, 0.0) / interval))
        rows, left = self.space.motion_gain(time, more)
        if not acting:
            return rows @ mean, rows @ covariance @ rows.T + left
        values, rows, beside = self.space.acting(rows, mean, covariance)
        return values, rows @ covariance @ rows.T + left + beside


def _symmetric(square: Array) -> Array:
    """Return the mean of a square matrix and its transpose, a covariance that is symmetric to the last bit."""
    return np.asarray(0.5 * (square + square.T))


T = TypeVar("T")
_PIECE = 400
"""Number of readings whose covariances are held in memory at once by the smoother."""


def with_indicated_jumps(
    how: SeriesFilter, knowing: SeriesFilter, start: FilterState, observed: Sequence[Observed], left: Sequence[Array]
) -> tuple[FilterState, list[Array]]:
    """Return a smoother's start state and variances of undetected jumps, using what all readings indicate of them.

    The shares, N arrays (m,), are those of the mean square of jumps before each reading.

    Dimensions: m motions that jump at a known rate.

    Parameters
    ----------
    how : SeriesFilter
        Filter that searched for jumps.
    knowing : SeriesFilter
        Filter that does not search for jumps but knows the detected ones.
    start : FilterState
        State before the first reading.
    observed : sequence of Observed
        N readings in the order of time.
    left : sequence of (m,) ndarrays
        Fraction of the mean square of jumps that could not be detected, before each of the N readings.
    """
    if not how.jumping_bodies or not observed:
        return start, list(left)
    at = how.space.level
    levels = [how.space.level_of(body.motions)[at] @ body.root for body in how.jumping_bodies]
    score = [np.empty((len(observed), level.shape[1])) for level in levels]
    information = [np.empty((*array.shape, array.shape[1])) for array in score]
    scores = np.empty((_PIECE, at.stop - at.start))
    known_of = np.empty((*scores.shape, scores.shape[1]))

    def note(number: int, carried: Array, known: Array) -> None:
        row = number % _PIECE
        scores[row], known_of[row] = carried[at], known[at, at]
        if row == 0:  # readings come from the last to the first
            there = slice(number, min(number + _PIECE, len(observed)))
            count = there.stop - number
            for level, part, more in zip(levels, score, information, strict=True):
                part[there], more[there] = scores[:count] @ level, level.T @ (known_of[:count] @ level)

    plain = replace(knowing, include_undetected=False)
    none = np.zeros(0)
    smoothed(
        plain, replace(start, undetected=none), observed, none, [none] * len(observed), knowing.parameters_of, note
    )
    first = how.before_s if math.isnan(start.last) else 0.0
    gap = np.diff([reading.time for reading in observed], prepend=observed[0].time - first)
    row = {k: i for i, k in enumerate(how.walking.tolist())}
    out = np.array(left)
    for body, more in zip(
        how.jumping_bodies, undetected_variance(score, information, gap, how.jumping_bodies, how.window), strict=True
    ):
        out[:, [row[k] for k in body.motions]] += more
    return how.with_random_walk(start, out[0] - left[0], first), list(out)


def smoothed(
    how: SeriesFilter,
    start: FilterState,
    observed: Sequence[Observed],
    wanted: ArrayLike,
    left: Sequence[Array],
    each: Callable[[Array, Array, float], T],
    note: Callable[[int, Array, Array], None] = lambda number, score, information: None,
) -> list[T]:
    """Return results at given times from all readings, by a forward and then a backward pass over the readings.

    The backward pass works on sections of the series, to limit memory.

    Dimensions: T times, m motions that jump at a known rate, n states of the filter.

    Parameters
    ----------
    how : SeriesFilter
        Filter that does not search for jumps, since it knows them.
    start : FilterState
        State before the first reading.
    observed : sequence of Observed
        N readings in the order of time.
    wanted : (T,) array_like
        Times, s, in any order, none before ``start``.
    left : sequence of (m,) ndarrays
        Share of the mean square of jumps that could not be detected, as in the filter before each of the N readings:
        the process is then the filter's, and a part of a series gives the same as the whole.
    each : callable
        Function of the mean (n,) and covariance (n, n) of the states at a time, and the time, that returns the result.
    note : callable
        Function called with the index of each reading, and score (n,) and information (n, n) of a change of the states
        just before it by the readings from it on.
    """
    times = np.asarray(wanted, np.float64)
    order = np.argsort(times, kind="stable")
    piece_starts, current = [start], start
    for k, reading in enumerate(observed):
        if k and k % _PIECE == 0:
            piece_starts.append(current)
        there = how.at(replace(current, undetected=left[k]), reading.time)
        current = replace(there, state=how.ingested(there.state, reading)[0])
    out: dict[int, T] = {}
    size, moved = how.space.size, how.space.moved
    gradient, precision = np.zeros(size), np.zeros((size, size))
    # index of the first reading after each time: the time is processed in the piece of that reading
    behind = np.searchsorted(np.array([reading.time for reading in observed]), times[order], side="right")
    for k in order[behind == len(observed)]:  # after the last reading the filter is final
        there = how.at(current, times[k])
        out[int(k)] = each(there.mean, there.covariance, float(times[k]))
    for piece in reversed(range(len(piece_starts))):
        first, last = piece * _PIECE, min((piece + 1) * _PIECE, len(observed))
        steps = list(_filtered(how, piece_starts[piece], observed[first:last], left[first:last]))
        for number in reversed(range(first, last)):
            before, whitened = steps[number - first]
            now = observed[number].time
            # across the reading: (1 - KH)' N (1 - KH) + H' S^-1 H, in the form that stays symmetric to the last bit;
            # other forms of the same cost lose N to rounding
            away = whitened.gain @ precision
            half = away - 0.5 * (np.eye(len(away)) + away @ whitened.gain.T) @ whitened.rows
            change = whitened.rows.T @ half
            precision = precision - (change + change.T)
            gradient = gradient + whitened.rows.T @ (whitened.white - whitened.gain @ gradient)
            note(number, gradient, precision)
            for k in order[behind == number]:
                there = how.at(before, times[k])
                back = moved(gradient[:, None], times[k], now, back=True)[:, 0]
                both = how.space.moved_both(precision, times[k], now, back=True)
                gained = there.covariance @ both @ there.covariance
                out[int(k)] = each(there.mean + there.covariance @ back, there.covariance - gained, float(times[k]))
            gradient = moved(gradient[:, None], before.time, now, back=True)[:, 0]
            precision = how.space.moved_both(precision, before.time, now, back=True)
    return [out[k] for k in range(len(times))]


def smooth_jointly(
    how: SeriesFilter, start: FilterState, observed: Sequence[Observed], wanted: ArrayLike, left: Sequence[Array]
) -> tuple[Array, Array]:
    """Return smoothed parameters at several times, (T, P), and their joint covariance, (T, P, T, P).

    The states at these times are carried along with the filter as constant copies, up to the last of them; the readings
    after that enter by the smoother.

    Dimensions: T times, P parameters, m motions that jump at a known rate.

    Parameters
    ----------
    how : SeriesFilter
        Filter that does not search for jumps, since it knows them.
    start : FilterState
        State before the first reading.
    observed : sequence of Observed
        N readings in the order of time.
    wanted : (T,) array_like
        Times, s, in order, none before ``start``.
    left : sequence of (m,) ndarrays
        Fraction of the mean square of jumps that could not be detected, before each of the N readings.
    """
    times, space = np.asarray(wanted, np.float64), how.space
    size, ahead = space.size, 0
    behind = np.searchsorted(np.array([reading.time for reading in observed]), times, side="right")
    last = int(behind[-1]) if len(times) else 0
    means, joint = np.empty((0, size)), np.empty((0, size, 0, size))
    across, current = np.empty((0, size, size)), start  # of each copy, the states now with it
    for k in range(last + 1):
        if k < len(observed):
            current = replace(current, undetected=left[k])
        while ahead < len(times) and behind[ahead] == k:
            across = space.moved(across, current.time, times[ahead])
            current = how.at(current, times[ahead])
            joint = np.concatenate([joint, across.transpose(0, 2, 1)[:, :, None]], axis=2)
            row = np.concatenate([across.transpose(1, 0, 2), current.covariance[:, None]], axis=1)
            joint, across = np.concatenate([joint, row[None]]), np.concatenate([across, current.covariance[None]])
            means = np.concatenate([means, current.mean[None]])
            ahead += 1
        if k == last:
            break
        across = space.moved(across, current.time, observed[k].time)
        there = how.at(current, observed[k].time)
        whitened = how.whitened(there.state, observed[k])
        gain = whitened.rows @ across
        means = means + np.einsum("kdn,d->kn", gain, whitened.white)
        joint = joint - np.einsum("kdn,ldm->knlm", gain, gain)
        across = across - whitened.gain.T @ gain
        current = replace(there, state=how.ingested(there.state, observed[k], whitened)[0])
    after: list[tuple[Array, Array]] = []

    def note(number: int, carried: Array, known: Array) -> None:
        if number == 0:
            after.append((carried, known))

    smoothed(how, current, observed[last:], np.zeros(0), left[last:], how.parameters_of, note)
    for carried, known in after:
        until = observed[last].time
        back = space.moved(carried[:, None], current.time, until, back=True)[:, 0]
        both = space.moved_both(known, current.time, until, back=True)
        means = means + np.einsum("kmn,m->kn", across, back)
        joint = joint - np.einsum("kmn,mo,lop->knlp", across, both, across, optimize=True)
    values, covariance = space.outputs_jointly(means, joint, times)
    width = space.width
    return values[:, width:], covariance[:, width:, :, width:]


def _filtered(
    how: SeriesFilter, current: FilterState, observed: Sequence[Observed], left: Sequence[Array]
) -> Iterator[tuple[FilterState, Whitened]]:
    """Yield the state before each reading of one section of a series, and the whitened reading."""
    for reading, share in zip(observed, left, strict=True):
        before = replace(current, undetected=share)
        there = how.at(before, reading.time)
        whitened = how.whitened(there.state, reading)
        yield before, whitened
        current = replace(there, state=how.ingested(there.state, reading, whitened)[0])


READINGS, SHARES = (1, 3, 10), (0.5, 0.95)
"""Conditions of a table of detectable jumps.

The first are the numbers of readings after a jump within which it is to be detected, the second the fractions of jumps
that are to be detected.
"""
_SIZES = np.geomspace(0.03, 100.0, 71)
"""Simulated sizes of a jump relative to its prior standard deviations, 12 percent apart."""
_DRAWS, _BEFORE = 400, 20
"""Number of simulated jumps of each size, and of readings before them, which bring the filter to steady state.

With this number of jumps, a fraction of 95 % of detected ones is known to 1.1 %.
"""


@dataclass(frozen=True, eq=False)
class DetectionPower:
    """Smallest detectable jumps of a body.

    Attributes
    ----------
    body : str
        Body that jumps.
    sizes : (readings, shares) ndarray
        Smallest size of which this share is detected within this number of readings: root mean square of the motions
        over their prior standard deviations; NaN where the largest simulated size is not.
    """

    body: str
    sizes: Array

    @property
    def plain(self) -> dict[str, float | None]:
        """Smallest detectable sizes as plain data, by share of detected jumps and readings; None if unknown."""
        keys = [f"{round(100 * share)}_percent_within_{n}" for n in READINGS for share in SHARES]
        return {
            key: size if size == size else None for key, size in zip(keys, self.sizes.ravel().tolist(), strict=True)
        }


def detection_power(how: SeriesFilter, interval: float, noise: Array) -> tuple[DetectionPower, ...]:
    """Return the smallest jump of each body that is detected in 50 % and 95 % of cases within 1, 3 and 10 readings.

    Dimensions: D spot coordinates (row and column of every spot).

    Parameters
    ----------
    how : SeriesFilter
        Filter that detects jumps.
    interval : float
        Time between two readings of the spots, s.
    noise : (D, D) ndarray
        Covariance of a reading, px^2.
    """
    informations, may = _step_informations(how, interval, noise), how.candidates
    if not may:
        return ()
    looks = float(how.looks(interval))
    tests = [[_test(c.spots, j, how.prior.jump_false_alarm / looks) for c in may] for j in informations]
    out: list[DetectionPower] = []
    for body in dict.fromkeys(c.body for c in may):
        whole = max((c for c in may if c.body == body), key=lambda c: len(c.motions))
        rates = _detection_rates(whole.spots, informations, tests, np.random.default_rng([0, len(out)]))
        out.append(
            DetectionPower(
                body, np.array([[_smallest_size(rates[n - 1], share) for share in SHARES] for n in READINGS])
            )
        )
    return tuple(out)


def _step_informations(how: SeriesFilter, interval: float, noise: Array) -> Array:
    """Return the information (inverse covariance) on a step from 1 to N readings after it, (N, q, q).

    Dimensions: q values that readings can contain (outputs).
    """
    current, nothing = how.start(0.0), np.zeros(len(noise))
    out: list[Array] = []
    for k in range(_BEFORE + READINGS[-1]):
        current, _ = how.update(current, Observed(k * interval, nothing, noise))
        if k >= _BEFORE and len(current.until):
            out.append(current.jump_track.information[-1 - (k - _BEFORE)])
    return np.array(out)


def _test(spots: Array, information: Array, probability: float) -> tuple[Array, float]:
    """Return the test for jumps of one candidate: the matrix that whitens its score, and the limit of the chi-square.

    A candidate is a set of motions of one body that may jump. Its score is the sum of the prediction errors after the
    jump, weighted by their inverse covariance.

    Parameters
    ----------
    spots : (q, m) ndarray
        Derivatives of the q components of the readings with respect to the m motions of the candidate.
    information : (q, q) ndarray
        Information (inverse covariance) of the readings on a step of these components.
    probability : float
        False-alarm probability of the test.

    Returns
    -------
    tuple of (r, q) ndarray and float
        Matrix that turns the q weighted prediction errors into r <= m independent numbers of unit variance, and the
        limit of their sum of squares, above which a jump is detected.
    """
    values, vectors = np.linalg.eigh(spots.T @ information @ spots)
    seen = values > UNOBSERVABLE * values.max()
    return (vectors[:, seen] / np.sqrt(values[seen])).T @ spots.T, float(limit_of(probability, int(np.sum(seen))))


def _detection_rates(
    spots: Array, informations: Array, tests: Sequence[Sequence[tuple[Array, float]]], rng: np.random.Generator
) -> Array:
    """Return the fraction of simulated jumps of each of S sizes that is detected within 1 to N readings, (N, S)."""
    amounts = rng.standard_normal((_DRAWS, spots.shape[1]))
    amounts *= np.sqrt(spots.shape[1]) / np.linalg.norm(amounts, axis=1, keepdims=True)
    step, noise, before = amounts @ spots.T, np.zeros((_DRAWS, len(spots))), np.zeros_like(informations[0])
    detected, out = np.zeros((len(_SIZES), _DRAWS), bool), []
    for information, those in zip(informations, tests, strict=True):
        drawn = rng.standard_normal(noise.shape) @ covariance_root(information - before).T
        noise, before = noise + drawn, information
        score = _SIZES[:, None, None] * (step @ information) + noise
        for away, limit in those:
            detected |= np.sum((score @ away.T) ** 2, axis=2) > limit
        out.append(detected.mean(axis=1))
    return np.array(out)


def _smallest_size(power: Array, share: float) -> float:
    """Return the smallest jump size from which on a given fraction of jumps is detected; NaN if no size reaches it."""
    less = np.flatnonzero(power < share)
    first = less[-1] + 1 if len(less) else 0
    if first == len(_SIZES):
        return float("nan")
    if first == 0:
        return float(_SIZES[0])
    part = (share - power[first - 1]) / (power[first] - power[first - 1])
    return float(_SIZES[first - 1] * (_SIZES[first] / _SIZES[first - 1]) ** part)
