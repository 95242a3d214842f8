"""Readings followed one by one: the state now, what comes next, and jumps, with the same work for every reading.

A Kalman filter on the `state_space` of what is stated to move. Beside it stands one that looks for jumps: for a step
just before each of the last readings it keeps what that step would do to its innovations (Willsky, Jones, IEEE Trans.
Automat. Contr. 21, 1976, 108). With the response X of its own estimate to a step of unit outputs, E = (picked outputs)
- H X is that of an innovation nu of covariance S, and

    b = sum E' S^-1 nu,   J = sum E' S^-1 E

are what `jump_detection.likeliest` needs, without going through a reading twice. The chance of a false alarm counts
every look of the whole life: readings, places of the step and candidates (Boole's inequality, a bound). A jump that is
told changes the estimate as if it had been known all along, (G - X) times its amounts, G what steps do to the states,
as a mixture over the readings between which it can have come; so sigma is wide where that is not known. All motions of
the body that may jump are then free to have done so: what the readings did not tell yet of the others cannot be found
later, since the places of the jump are given up.

A reading that is more likely bad than the first after a jump is set aside (`filter_state`). The next one decides: what
is known without it goes on beside what is known with it, until one of the two foretells that reading better. What is
known meanwhile is the mixture of both.

Jumps too small to be told are taken for a walk of their mean square, as in `jump_detection.with_unfound`, and what is
known now and of the future counts those that the last readings hint at by their chances (`filter_state`).

A whole series of readings: forward one by one, as they came, then backward for what all of them say of times past.

The smoother goes backwards over the same readings (Bryson, Frazier; de Jong, J. Am. Stat. Assoc. 84, 1989, 1085): it
needs no inverse of a covariance, and of the filter only what is of the size of a reading. It is worked in pieces, the
filter being run a second time in each, so that memory does not grow with states times readings.

On its way it has score and information of a step before every reading, by all readings (de Jong, Penzer, J. Am. Stat.
Assoc. 93, 1998, 796): a first way back finds what jumps the readings hint at that were not told (`filter_state`), and
the second takes these for steps of their chances and sizes.

How large a jump has to be to be found: of each body, by simulation of the test that finds it.

After many readings at even intervals, what a step does to the next ones no longer depends on when it comes. With the
information J of n readings on a step of the outputs (`kalman_filter`), the score of n readings after a step a is

    b(n) = b(n-1) + N((J(n) - J(n-1)) a, J(n) - J(n-1)),

so that the readings themselves need not be drawn. Directions of a are random as the prior states them, and its size is
the root mean square of its motions over their stated standard deviations. The jump is found with the first reading at
which any candidate passes the limit of the search, that of the place before the first reading after it alone: places
beside it can only find it earlier.
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
    Aside,
    BadReading,
    Belief,
    Hint,
    Innovation,
    Jumper,
    Observed,
    Track,
    Whitened,
    added,
    bad_reading,
    blended,
    chance_good,
    jump_evidence,
    jumpers,
    may_be_bad,
)
from analysis.monitor.jump_detection import (
    UNSEEN,
    Amounts,
    Bodies,
    Candidate,
    Jump,
    Step,
    Steps,
    candidates,
    knots,
    likeliest,
    mixed,
    untold_share,
)
from analysis.monitor.state_space import HeatInputs, StateSpace
from analysis.statistics import limit_of
from optics.numerics.array_math import covariance_root

_NEARLY = 1e-11
"""Of the sum of its eigenvalues, by which information is made regular."""


@dataclass(frozen=True, eq=False)
class _Look:
    """A reading of spots, looked at.

    Attributes
    ----------
    before : Belief
        What is known at its time without it; after: with it.
    innovation : Innovation
        Of it.
    log_odds : float
        Logarithm of the odds that it is bad.
    likely : float
        Logarithm of the density of the reading, good or bad, with a jump or without one.
    bad : BadReading | None
        What speaks for it being bad; None where that was not worked out.
    """

    before: Belief
    after: Belief
    innovation: Innovation
    log_odds: float
    likely: float
    bad: BadReading | None = None


@dataclass(frozen=True, eq=False)
class SeriesFilter:
    """Filter of what is stated to move.

    Attributes
    ----------
    stated : Disturbances
        What moves, and how it goes on in time.
    reference_noise : Array | None
        (D, D) px^2 of the spots that shifts are counted from; None for none.
    heat : HeatInputs | None
        Temperatures that sensors read; None for none.
    life_s : float
        Seconds over which ``stated.jump_false_alarm`` counts, all looks together: each gets the share of it that the
        time between its two readings is of the life, whatever the cadence of the readings.
    window : int
        Readings for which a jump is looked for.
    stepping : tuple[int, ...]
        Numbers of motions that may step although their own law is another one.
    parameters_read : bool
        Whether there are readings of parameters among those of spots.
    steps : tuple[Step, ...]
        That are known of beside what is stated.
    unfound : bool
        Whether jumps too small to be told count, where it is stated how often a motion jumps.
    before_s : float
        Seconds before the first reading of spots in which bodies may have jumped, too; 0 for none.
    leaving_out : bool
        Whether a reading may be bad.
    candidates : tuple[Candidate, ...]
        What may jump, motions alone and those of a body together.
    """

    stated: Disturbances
    reference_noise: Array | None = None
    heat: HeatInputs | None = None
    life_s: float = 10.0 * 365.25 * 86_400.0
    window: int = 60
    stepping: tuple[int, ...] = ()
    parameters_read: bool = False
    steps: tuple[Step, ...] = ()
    unfound: bool = True
    before_s: float = 0.0
    leaving_out: bool = True
    candidates: tuple[Candidate, ...] = field(init=False, default=())

    def __post_init__(self) -> None:
        object.__setattr__(self, "candidates", candidates(self._stacked) if self.window else ())

    @cached_property
    def space(self) -> StateSpace:
        """The states."""
        return StateSpace(self.stated, self.reference_noise, self.heat, self.stepping)

    @cached_property
    def _step_levels(self) -> list[Array]:
        """(n, n) covariance of the states by each step."""
        out = []
        for one in self.steps:
            if one.moment is not None:
                does = self.space.level_doing
                out.append(_even(does @ one.moment @ does.T))
                continue
            together = np.zeros((self.space.size, self.space.size))
            for motions, variance in one.parts:
                own = list(motions)
                level = self.space.level_of(own)
                together += variance * level @ self.stated.correlation[np.ix_(own, own)] @ level.T
            out.append(_even(together))
        return out

    @cached_property
    def _step_ends(self) -> Array:
        """(S, 2) seconds between which each comes."""
        return np.array([(one.chances[0][0], one.chances[-1][0]) for one in self.steps]).reshape(-1, 2)

    def _stepped(self, covariance: Array, then: float, now: float) -> Array:
        """With the steps that come after one time and not after another."""
        if not self.steps:
            return covariance
        ends = self._step_ends
        for k in np.flatnonzero((ends[:, 1] > then) & (ends[:, 0] <= now)).tolist():
            one = self.steps[k]
            come = one.come(now) - (one.come(then) if math.isfinite(then) else 0.0)
            if come > 0.0:
                covariance = covariance + come * self._step_levels[k]
        return covariance

    @cached_property
    def _stacked(self) -> Disturbances:
        """What moves, all q outputs that readings may be of in place of the spots."""
        if not self.parameters_read:
            return self.stated
        return replace(self.stated, spots=np.concatenate([self.stated.spots, self.stated.parameters]))

    @cached_property
    def walking(self) -> NDArray[np.int_]:
        """(m,) numbers of motions that jump at a stated rate."""
        own = [k for k, law in enumerate(self.stated.laws) if law.every_s is not None and self.unfound]
        return np.array(own, int)

    @cached_property
    def _walk(self) -> Array:
        """(r, m) what one of these does to the states of the level, over the root of its rate."""
        rates = np.array([1.0 / float(self.stated.laws[k].every_s or 1.0) for k in self.walking])
        return self.space.level_of(self.walking.tolist())[self.space.level] * np.sqrt(rates)

    def looks(self, between: ArrayLike) -> Array:
        """By how much the chance of one look for a jump is to be multiplied for that of all in the whole life.

        Parameters
        ----------
        between : ArrayLike
            Seconds between the two readings of the look, of any shape.
        """
        share = np.asarray(between, np.float64) / self.life_s
        return np.asarray(self.window * len(self.candidates) / np.minimum(share, 1.0))

    def _limit(self, belief: Belief) -> float:
        """Ratio below which no candidate can be told, whatever its number of motions."""
        between = belief.until - belief.after
        return float(limit_of(self.stated.jump_false_alarm / self.looks(between.max()), 1))

    def start(self, time: float) -> Belief:
        """What is known before any reading.

        Parameters
        ----------
        time : float
            Not after the first reading, seconds.
        """
        mean, covariance = self.space.start(time)
        covariance = self._stepped(covariance, -math.inf, time)
        size, q = self.space.size, self._stacked.spots.shape[0]
        track = Track(mean, covariance, np.zeros((0, size, q)), np.zeros((0, q)), np.zeros((0, q, q)))
        empty, left = np.zeros(0), np.ones(len(self.walking))
        return Belief(time, math.nan, empty, empty, track, track if len(left) and self.candidates else None, left)

    def at(self, belief: Belief, time: float) -> Belief:
        """What will be known at a later time, if no reading comes until then.

        Parameters
        ----------
        belief : Belief
            So far.
        time : float
            seconds.
        """
        state = self._moved(belief.state, belief.time, time, belief.left)
        search = None if belief.search is None else self._moved(belief.search, belief.time, time, None)
        aside = belief.aside and replace(belief.aside, taken=self.at(belief.aside.taken, time))
        return replace(belief, time=max(time, belief.time), state=state, search=search, aside=aside)

    def _moved(self, track: Track, then: float, now: float, left: Array | None) -> Track:
        if now <= then:
            return track
        space = self.space
        covariance = self._stepped(space.spread(track.covariance, then, now), then, now)
        if left is not None and len(left):
            covariance = self._with_walk(covariance, left, now - then)
        mean = space.moved(track.mean[:, None], then, now)[:, 0]
        response = space.moved(track.response, then, now) if len(track.response) else track.response
        return Track(mean, covariance, response, track.score, track.information)

    def _with_walk(self, covariance: Array, left: Array, over: float) -> Array:
        walk, level = self._walk * np.sqrt(left * over), self.space.level
        out = covariance.copy()
        out[level, level] += walk @ walk.T
        return out

    def with_walk(self, belief: Belief, left: Array, over: float) -> Belief:
        """What is known where jumps have come meanwhile that are not told.

        Parameters
        ----------
        belief : Belief
            Without them.
        left : Array
            (m,) share of the mean square of jumps at their rate that they have.
        over : float
            seconds.
        """
        covariance = self._with_walk(belief.covariance, left, over)
        return replace(belief, state=replace(belief.state, covariance=covariance))

    def loosened(self, belief: Belief, observed: Observed, times: float) -> Belief:
        """What is known where a sensor reads more than stated: the states are less well known in the direction in which
        its reading moves them, and as well as before in all others.

        Parameters
        ----------
        belief : Belief
            At the time of the reading.
        observed : Observed
            One number of a sensor.
        times : float
            By which the standard deviation of what it reads is larger.
        """

        def loose(track: Track) -> Track:
            rows = self.read(track.mean, track.covariance, observed)[1]
            along = track.covariance @ rows[0]
            more = (times**2 - 1.0) / float(rows[0] @ along) * np.outer(along, along)
            return replace(track, covariance=track.covariance + more)

        put = belief.aside and replace(belief.aside, taken=self.loosened(belief.aside.taken, observed, times))
        search = None if belief.search is None else loose(belief.search)
        return replace(belief, state=loose(belief.state), search=search, aside=put)

    def update(self, belief: Belief, observed: Observed, sure: bool = False) -> tuple[Belief, Innovation]:
        """Take one reading.

        Parameters
        ----------
        belief : Belief
            So far.
        observed : Observed
            The reading, not before the time of ``belief``.
        sure : bool
            Whether somebody has decided that it is good.

        Raises
        ------
        UndeterminedError
            The reading has no noise and says what is known already.
        """
        if not observed.spots:
            put = belief.aside and replace(belief.aside, taken=self.update(belief.aside.taken, observed)[0])
            now = self.at(replace(belief, aside=None), observed.time)
            state, found = self.taken(now.state, observed)
            search = None if now.search is None else self.taken(now.search, observed)[0]
            return replace(now, state=state, search=search, aside=put), found
        aside = belief.aside
        own = self._look(replace(belief, aside=None), observed, aside is not None)
        if aside is not None:
            other = self._look(aside.taken, observed, True)
            kept = aside.log_odds + own.likely < other.likely
            if kept:
                own = replace(other, innovation=replace(other.innovation, earlier=aside.innovation))
            own = replace(own, innovation=replace(own.innovation, settled=True))
            recent = (*belief.recent[:-1], not kept)
            own = replace(own, before=replace(own.before, recent=recent), after=replace(own.after, recent=recent))
        if not sure and may_be_bad(own.bad, own.log_odds, own.before.recent):
            found = replace(own.innovation, bad=own.bad)
            put = Aside(self._whole(own.after)[0], found, own.log_odds)
            return replace(own.before, recent=(*own.before.recent, True)[-RECENT:], aside=put), found
        after = replace(own.after, recent=(*own.after.recent, False)[-RECENT:])
        now, jump = self._whole(after, True)
        return now, replace(own.innovation, jump=jump)

    def _look(self, belief: Belief, observed: Observed, weighed: bool) -> _Look:
        """Return the estimate of the spots before a reading and with it, and the evidence that it is bad.

        Parameters
        ----------
        belief : Belief
            Before, nothing set aside.
        observed : Observed
            The reading.
        weighed : bool
            Whether to work out how likely it is also where it is surely good.
        """
        before = self.at(belief, observed.time)
        now = before
        first = math.isnan(belief.last) and self.before_s > 0.0
        if self.candidates and (first or observed.time > belief.last):
            now = self._with_step(now, observed.time - self.before_s if first else belief.last, observed.time)
        w = self.whitened(now.state, observed)
        state, found = self.taken(now.state, observed, w)
        search, judged = None, found
        if now.search is not None:
            w = self.whitened(now.search, observed)
            search, judged = self.taken(now.search, observed, w)
        after = replace(now, state=state, search=search, last=observed.time)
        bad = bad_reading(w.white, w.root, observed.noise) if self.leaving_out else None
        if bad is None and not weighed:
            return _Look(before, after, found, -math.inf, judged.log_score)
        log_ratio = -math.inf if bad is None else bad.log_ratio
        gap = now.until - now.after
        jumping = [jump_evidence(one.looking, gap, self._jumping, self.life_s, observed.noise) for one in (now, after)]
        good = jumping[1] - jumping[0]
        likely = judged.log_score + float(np.logaddexp(log_ratio, good))
        return _Look(before, after, found, log_ratio - good, likely, bad)

    def _whole(self, belief: Belief, telling: bool = False) -> tuple[Belief, Jump | None]:
        """With what share of jumps cannot be told after a reading, and with the jump that is told."""
        if not (self.candidates and len(belief.until)):
            return belief, None
        now = replace(belief, left=self._unseen(belief))
        jump = self._told(now) if telling else None
        return (now, None) if jump is None else self._jumped(now, jump)

    def _with_step(self, belief: Belief, after: float, until: float) -> Belief:
        """With a step that is looked for just before a reading; the oldest is given up."""
        start = max(0, len(belief.until) + 1 - self.window)

        def more(track: Track) -> Track:
            q = track.score.shape[1]
            return replace(
                track,
                response=np.concatenate([track.response[start:], np.zeros((1, self.space.size, q))]),
                score=np.concatenate([track.score[start:], np.zeros((1, q))]),
                information=np.concatenate([track.information[start:], np.zeros((1, q, q))]),
            )

        return replace(
            belief,
            after=np.append(belief.after[start:], after),
            until=np.append(belief.until[start:], until),
            state=more(belief.state),
            search=None if belief.search is None else more(belief.search),
        )

    def read(self, mean: Array, covariance: Array, observed: Observed) -> tuple[Array, Array, Array, Array]:
        """What a reading is expected to be: its mean (d,), rows on the states (d, n), covariance (d, d) of what these
        leave, noise included, and what unit outputs do to it, (d, q).

        Parameters
        ----------
        mean : Array
            (n,) of the states at its time.
        covariance : Array
            (n, n) of them.
        observed : Observed
            The reading.
        """
        width, q = self.space.width, self._stacked.spots.shape[0]
        if observed.sensors:
            rows = self.space.sensor_rows(observed.sensors, observed.time)
            return rows @ mean, rows, observed.noise, np.zeros((len(rows), q))
        values, rows, left = self.space.outputs(mean, covariance, observed.time)
        if observed.parameters is None:
            return values[:width], rows[:width], observed.noise + left[:width, :width], np.eye(width, q)
        own = observed.parameters
        picked = np.concatenate([np.zeros((len(own), width)), own], axis=1)[:, :q]
        noise = observed.noise + own @ left[width:, width:] @ own.T
        return own @ values[width:], own @ rows[width:], noise, picked

    def whitened(self, track: Track, observed: Observed) -> Whitened:
        """A reading divided by the root of its covariance.

        Parameters
        ----------
        track : Track
            The states at its time.
        observed : Observed
            The reading.

        Raises
        ------
        UndeterminedError
            It has no noise and says what is known already.
        """
        expected, rows, noise, picked = self.read(track.mean, track.covariance, observed)
        across = track.covariance @ rows.T
        spread = rows @ across + noise
        # LAPACK itself: what NumPy and SciPy do about it takes longer than matrices of this size
        root, failed = dpotrf(spread, lower=1, clean=1)
        if failed:
            raise UndeterminedError("filter: readings that say the same twice need noise")
        both = np.concatenate([(observed.value - expected)[:, None], rows, across.T, picked], axis=1)
        both, _ = dtrtrs(root, both, lower=1)
        n = len(track.mean)
        return Whitened(root, both[:, 0], both[:, 1 : n + 1], both[:, n + 1 : 2 * n + 1], both[:, 2 * n + 1 :])

    def taken(self, track: Track, observed: Observed, w: Whitened | None = None) -> tuple[Track, Innovation]:
        """Take one reading into a filter.

        Parameters
        ----------
        track : Track
            At its time.
        observed : Observed
            The reading.
        w : Whitened | None
            As `whitened` has it, if that is known.
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
        taken = Track(track.mean + w.gain.T @ w.white, covariance, response, score, information)
        return taken, Innovation(observed, w.white, log_score)

    def _unseen(self, belief: Belief) -> Array:
        """(m,) what share of the mean square of jumps is of those that cannot be told, by what is known of the oldest
        step that is looked for.
        """
        information, between = belief.looking.information[0], belief.until[0] - belief.after[0]
        column = self._stacked.spots[:, self.walking]
        seen = np.sqrt(np.maximum(np.einsum("qm,qr,rm->m", column, information, column), 0.0))
        limit = math.sqrt(float(limit_of(self.stated.jump_false_alarm / self.looks(between), 1)))
        return untold_share(limit, seen)

    def _told(self, belief: Belief) -> Jump | None:
        """The likeliest jump, if chance does not explain it."""
        track = belief.looking
        # no candidate explains more than any outputs would; 1 in 100 more than rounding takes off
        information = track.information + _NEARLY * np.trace(track.information, 0, 1, 2)[:, None, None] * np.eye(
            track.score.shape[1]
        )
        most = np.sum(track.score * np.linalg.solve(information, track.score[:, :, None])[:, :, 0], axis=1)
        if 1.01 * most.max() < self._limit(belief):
            return None
        one = likeliest(
            [Steps(belief.after, belief.until, track.score, track.information)], self.candidates, self._stacked
        )
        if one is None:
            return None
        # `likeliest` counts its own looks at these readings
        alone = one.chance / (len(self.candidates) * len(belief.until))
        chance = min(1.0, alone * float(self.looks(one.until - one.after)))
        if chance > self.stated.jump_false_alarm:
            return None
        place, seen = int(np.argmin(np.abs(belief.until - one.until))), self.space.width
        rest = max(float(most[place]) - 2.0 * one.log_ratio, 0.0), max(seen - len(one.motions), 1)
        return replace(one, chance=chance, rest=rest)

    def _jumped(self, belief: Belief, jump: Jump) -> tuple[Belief, Jump]:
        """What is known once a jump is told, and the jump with its sizes."""
        looking, own = ((track.score, track.information) for track in (belief.looking, belief.state))
        gap = belief.until - belief.after
        bodies = Bodies.of(self.candidates, jump, belief.until, gap, looking, own)
        levels = [self.space.level_of(one.motions) @ one.root for one in bodies.own]
        state, search = belief.state, belief.search
        mean, covariance = bodies.known(state.mean, state.covariance, state.response, levels, bodies.amounts)
        state = replace(state.alone(), mean=mean, covariance=covariance)
        if search is not None:
            mean, covariance = bodies.known(search.mean, search.covariance, search.response, levels, bodies.judged)
            search = replace(search.alone(), mean=mean, covariance=covariance)
        # sizes are those of the motions that explain it best, had they jumped alone
        alone, weight = next(one for one in self.candidates if one.motions == jump.motions), bodies.weight.sum(axis=0)
        named = Amounts.of(*own, alone.spots, jump.times)
        size, size_spread = mixed([named], [self.stated.sigmas[list(alone.motions), None] * alone.root], weight[None])
        does = [self.space.outputs_of(one.motions) @ one.root for one in bodies.own]
        change, spread = mixed(bodies.amounts, does, bodies.weight)
        empty = np.zeros(0)
        told = replace(
            jump,
            sizes=tuple(size.tolist()),
            sigmas=tuple(np.sqrt(np.diag(size_spread)).tolist()),
            chances=knots(belief.after, belief.until, weight),
            parts=bodies.parts,
            change=tuple(change.tolist()),
            spread=tuple(tuple(row) for row in spread.tolist()),
            width=self.space.width,
        )
        return replace(belief, state=state, search=search, after=empty, until=empty), told

    @cached_property
    def _jumping(self) -> tuple[Jumper, ...]:
        """All bodies that may jump, those of which no rate is stated once in the life."""
        return jumpers(self.stated, self.candidates, self.life_s)

    @cached_property
    def jumpers(self) -> tuple[Jumper, ...]:
        """Bodies that jump at a stated rate."""
        return jumpers(self.stated, self.candidates) if self.unfound else ()

    def blended(self, belief: Belief) -> Belief:
        """What is known where jumps that are not told count by their chances, of the state now and of forecasts; later
        readings go on from the belief that is given.

        Parameters
        ----------
        belief : Belief
            So far.
        """
        if belief.aside is not None:
            share = chance_good(belief.aside.log_odds)
            bad, good = (self.blended(one) for one in (replace(belief, aside=None), belief.aside.taken))
            apart = good.mean - bad.mean
            covariance = (1.0 - share) * bad.covariance + share * good.covariance
            covariance = covariance + share * (1.0 - share) * np.outer(apart, apart)
            state = replace(bad.state.alone(), mean=bad.mean + share * apart, covariance=covariance)
            none = bad.until[:0]
            return replace(bad, after=none, until=none, state=state, search=None)
        if not self.jumpers or not len(belief.until):
            return belief
        track, looking, hints, moved = belief.state, belief.looking, [], []
        for one in self.jumpers:
            expected = (belief.until - belief.after) / one.every_s
            looked, own = ((t.score, t.information) for t in (looking, track))
            hints.append(Hint.of(looked, own, one.spots, expected))
            moved.append(self.space.level_of(one.motions) @ one.root - track.response @ one.spots)
        mean, covariance = blended(track.mean, track.covariance, hints, moved)
        none = belief.until[:0]
        return replace(
            belief, after=none, until=none, state=replace(track.alone(), mean=mean, covariance=covariance), search=None
        )

    def parameters(self, belief: Belief, time: float) -> tuple[Array, Array]:
        """Parameters (P,) and their covariance (P, P).

        Parameters
        ----------
        belief : Belief
            So far, as `blended` gives it where jumps count that are not told.
        time : float
            Not before its own, seconds.
        """
        state = self._moved(belief.state, belief.time, time, belief.left)
        return self.parameters_of(state.mean, state.covariance, time)

    def parameters_of(self, mean: Array, covariance: Array, time: float) -> tuple[Array, Array]:
        """Parameters (P,) and their covariance (P, P).

        Parameters
        ----------
        mean : Array
            (n,) of the states.
        covariance : Array
            (n, n) of them.
        time : float
            Of them, seconds.
        """
        width = self.space.width
        values, rows, left = self.space.outputs(mean, covariance, time)
        own = rows[width:]
        return values[width:], own @ covariance @ own.T + left[width:, width:]

    def motions_of(
        self, mean: Array, covariance: Array, time: float, since: float, acting: bool = False
    ) -> tuple[Array, Array]:
        """Motions (M,) and their covariance (M, M), in the standard deviations that are stated.

        Parameters
        ----------
        mean : Array
            (n,) of the states.
        covariance : Array
            (n, n) of them.
        time : float
            Of them, seconds.
        since : float
            From when on jumps have come that were not told, seconds.
        acting : bool
            Temperatures of bodies with sensors as they act on light: times the factor by which heat does more than
            computed, so that what is computed of the motions is what is estimated.
        """
        more = [(motions, variance * one.come(time)) for one in self.steps for motions, variance in one.parts]
        for motion in self.walking.tolist():
            every = float(self.stated.laws[motion].every_s or math.inf)
            more.append(((motion,), max(time - since, 0.0) / every))
        rows, left = self.space.motion_gain(time, more)
        if not acting:
            return rows @ mean, rows @ covariance @ rows.T + left
        values, rows, beside = self.space.acting(rows, mean, covariance)
        return values, rows @ covariance @ rows.T + left + beside


def _even(square: Array) -> Array:
    """A covariance, symmetric to the bit."""
    return np.asarray(0.5 * (square + square.T))


T = TypeVar("T")
_PIECE = 400
"""Readings whose covariances are held at once."""


def hinted(
    how: SeriesFilter, knowing: SeriesFilter, start: Belief, observed: Sequence[Observed], left: Sequence[Array]
) -> tuple[Belief, list[Array]]:
    """What is known before the first reading, and N times (m,) what share of the mean square of jumps could not be
    told, with jumps that all readings hint at.

    Parameters
    ----------
    how : SeriesFilter
        The filter that looked for jumps.
    knowing : SeriesFilter
        The same, which looks for none but knows of those that were told.
    start : Belief
        As for `smoothed`.
    observed : Sequence[Observed]
        N readings in the order of time.
    left : Sequence[Array]
        As for `smoothed`.
    """
    if not how.jumpers or not observed:
        return start, list(left)
    at = how.space.level
    levels = [how.space.level_of(one.motions)[at] @ one.root for one in how.jumpers]
    score = [np.empty((len(observed), level.shape[1])) for level in levels]
    information = [np.empty((*one.shape, one.shape[1])) for one in score]
    scores = np.empty((_PIECE, at.stop - at.start))
    known_of = np.empty((*scores.shape, scores.shape[1]))

    def note(number: int, carried: Array, known: Array) -> None:
        place = number % _PIECE
        scores[place], known_of[place] = carried[at], known[at, at]
        if place == 0:  # readings come from the last to the first
            there = slice(number, min(number + _PIECE, len(observed)))
            count = there.stop - number
            for level, one, more in zip(levels, score, information, strict=True):
                one[there], more[there] = scores[:count] @ level, level.T @ (known_of[:count] @ level)

    plain = replace(knowing, unfound=False)
    none = np.zeros(0)
    smoothed(plain, replace(start, left=none), observed, none, [none] * len(observed), knowing.parameters_of, note)
    first = how.before_s if math.isnan(start.last) else 0.0
    gap = np.diff([one.time for one in observed], prepend=observed[0].time - first)
    place = {k: i for i, k in enumerate(how.walking.tolist())}
    out = np.array(left)
    for one, more in zip(how.jumpers, added(score, information, gap, how.jumpers, how.window), strict=True):
        out[:, [place[k] for k in one.motions]] += more
    return how.with_walk(start, out[0] - left[0], first), list(out)


def smoothed(
    how: SeriesFilter,
    start: Belief,
    observed: Sequence[Observed],
    wanted: ArrayLike,
    left: Sequence[Array],
    each: Callable[[Array, Array, float], T],
    note: Callable[[int, Array, Array], None] = lambda number, score, information: None,
) -> list[T]:
    """What all readings say of times past: forward to where pieces begin, then backward piece by piece.

    Parameters
    ----------
    how : SeriesFilter
        a filter that looks for no jumps, since it knows of them.
    start : Belief
        What is known before the first reading.
    observed : Sequence[Observed]
        N readings in the order of time.
    wanted : ArrayLike
        (T,) times, seconds, in any order, none before ``start``.
    left : Sequence[Array]
        N times (m,) what share of the mean square of jumps could not be told, as the filter had it before each reading:
        the process is then the filter's, and a part of a series gives what the whole gives.
    each : Callable[[Array, Array, float], T]
        (n,) mean and (n, n) covariance of the states at a wanted time, and the time -> what is made of them.
    note : Callable[[int, Array, Array], None]
        Called with the number of each reading, and score (n,) and information (n, n) of a change of the states just
        before it by the readings from it on.
    """
    times = np.asarray(wanted, np.float64)
    order = np.argsort(times, kind="stable")
    beliefs, belief = [start], start
    for k, one in enumerate(observed):
        if k and k % _PIECE == 0:
            beliefs.append(belief)
        there = how.at(replace(belief, left=left[k]), one.time)
        belief = replace(there, state=how.taken(there.state, one)[0])
    out: dict[int, T] = {}
    size, moved = how.space.size, how.space.moved
    carried, known = np.zeros(size), np.zeros((size, size))
    # number of the first reading after each wanted time: it is worked out in the piece of that one
    behind = np.searchsorted(np.array([one.time for one in observed]), times[order], side="right")
    for k in order[behind == len(observed)]:  # after the last reading nothing comes to correct the filter
        there = how.at(belief, times[k])
        out[int(k)] = each(there.mean, there.covariance, float(times[k]))
    for piece in reversed(range(len(beliefs))):
        first, last = piece * _PIECE, min((piece + 1) * _PIECE, len(observed))
        steps = list(_again(how, beliefs[piece], observed[first:last], left[first:last]))
        for number in reversed(range(first, last)):
            before, whitened = steps[number - first]
            now = observed[number].time
            # across the reading: (1 - KH)' N (1 - KH) + H' S^-1 H, in the form that stays symmetric to the bit; others
            # of as little work lose N to rounding
            away = whitened.gain @ known
            half = away - 0.5 * (np.eye(len(away)) + away @ whitened.gain.T) @ whitened.rows
            change = whitened.rows.T @ half
            known = known - (change + change.T)
            carried = carried + whitened.rows.T @ (whitened.white - whitened.gain @ carried)
            note(number, carried, known)
            for k in order[behind == number]:
                there = how.at(before, times[k])
                back = moved(carried[:, None], times[k], now, back=True)[:, 0]
                both = how.space.moved_both(known, times[k], now, back=True)
                gained = there.covariance @ both @ there.covariance
                out[int(k)] = each(there.mean + there.covariance @ back, there.covariance - gained, float(times[k]))
            carried = moved(carried[:, None], before.time, now, back=True)[:, 0]
            known = how.space.moved_both(known, before.time, now, back=True)
    return [out[k] for k in range(len(times))]


def jointly(
    how: SeriesFilter, start: Belief, observed: Sequence[Observed], wanted: ArrayLike, left: Sequence[Array]
) -> tuple[Array, Array]:
    """What all readings say of times past together: values (T, P) of the parameters, and their covariance (T, P, T, P).

    The states at the wanted times go along with the filter, as copies that move no more, up to the last of them; what
    comes after that is what the smoother carries back to it.

    Parameters
    ----------
    how : SeriesFilter
        a filter that looks for no jumps, since it knows of them.
    start : Belief
        What is known before the first reading.
    observed : Sequence[Observed]
        N readings in the order of time.
    wanted : ArrayLike
        (T,) times, seconds, in order, none before ``start``.
    left : Sequence[Array]
        As of `smoothed`.
    """
    times, space = np.asarray(wanted, np.float64), how.space
    size, ahead = space.size, 0
    behind = np.searchsorted(np.array([one.time for one in observed]), times, side="right")
    last = int(behind[-1]) if len(times) else 0
    means, own = np.empty((0, size)), np.empty((0, size, 0, size))
    across, belief = np.empty((0, size, size)), start  # of each copy, the states now with it
    for k in range(last + 1):
        if k < len(observed):
            belief = replace(belief, left=left[k])
        while ahead < len(times) and behind[ahead] == k:
            across = space.moved(across, belief.time, times[ahead])
            belief = how.at(belief, times[ahead])
            own = np.concatenate([own, across.transpose(0, 2, 1)[:, :, None]], axis=2)
            row = np.concatenate([across.transpose(1, 0, 2), belief.covariance[:, None]], axis=1)
            own, across = np.concatenate([own, row[None]]), np.concatenate([across, belief.covariance[None]])
            means = np.concatenate([means, belief.mean[None]])
            ahead += 1
        if k == last:
            break
        across = space.moved(across, belief.time, observed[k].time)
        there = how.at(belief, observed[k].time)
        whitened = how.whitened(there.state, observed[k])
        gain = whitened.rows @ across
        means = means + np.einsum("kdn,d->kn", gain, whitened.white)
        own = own - np.einsum("kdn,ldm->knlm", gain, gain)
        across = across - whitened.gain.T @ gain
        belief = replace(there, state=how.taken(there.state, observed[k], whitened)[0])
    after: list[tuple[Array, Array]] = []

    def note(number: int, carried: Array, known: Array) -> None:
        if number == 0:
            after.append((carried, known))

    smoothed(how, belief, observed[last:], np.zeros(0), left[last:], how.parameters_of, note)
    for carried, known in after:
        until = observed[last].time
        back = space.moved(carried[:, None], belief.time, until, back=True)[:, 0]
        both = space.moved_both(known, belief.time, until, back=True)
        means = means + np.einsum("kmn,m->kn", across, back)
        own = own - np.einsum("kmn,mo,lop->knlp", across, both, across, optimize=True)
    values, covariance = space.outputs_jointly(means, own, times)
    width = space.width
    return values[:, width:], covariance[:, width:, :, width:]


def _again(
    how: SeriesFilter, belief: Belief, observed: Sequence[Observed], left: Sequence[Array]
) -> Iterator[tuple[Belief, Whitened]]:
    """What is known before each reading of one piece, before it was moved to it, and the reading."""
    for one, share in zip(observed, left, strict=True):
        before = replace(belief, left=share)
        there = how.at(before, one.time)
        whitened = how.whitened(there.state, one)
        yield before, whitened
        belief = replace(there, state=how.taken(there.state, one, whitened)[0])


READINGS, SHARES = (1, 3, 10), (0.5, 0.95)
"""Numbers of readings after a jump within which it is found, and in which share of cases."""
_SIZES = np.geomspace(0.03, 100.0, 71)
"""Sizes that are tried, over those stated: 12 percent apart."""
_DRAWS, _BEFORE = 400, 20
"""Jumps of each size, by which 95 percent are known to 1.1; and readings before, by which information is steady."""


@dataclass(frozen=True, eq=False)
class Power:
    """Smallest jumps of a body that are found.

    Attributes
    ----------
    body : str
        Whose they are.
    sizes : Array
        (readings, shares) the smallest of which so many are found within so many readings, root mean square of its
        motions over their stated standard deviations; NaN where the largest that is tried is not.
    """

    body: str
    sizes: Array

    @property
    def plain(self) -> dict[str, float | None]:
        """Share and number of readings -> size; None for none."""
        keys = [f"{round(100 * share)}_percent_within_{n}" for n in READINGS for share in SHARES]
        return {
            key: size if size == size else None for key, size in zip(keys, self.sizes.ravel().tolist(), strict=True)
        }


def detection_power(how: SeriesFilter, interval: float, noise: Array) -> tuple[Power, ...]:
    """Return the smallest jump of each body that is found in half and in 95 % of cases within 1, 3 and 10 readings.

    Parameters
    ----------
    how : SeriesFilter
        The filter that looks for jumps.
    interval : float
        Seconds from one reading of the spots to the next.
    noise : Array
        (D, D) px^2 of a reading.
    """
    informations, may = _informations(how, interval, noise), how.candidates
    if not may:
        return ()
    looks = float(how.looks(interval))
    tests = [[_test(one.spots, j, how.stated.jump_false_alarm / looks) for one in may] for j in informations]
    out: list[Power] = []
    for body in dict.fromkeys(one.body for one in may):
        own = max((one for one in may if one.body == body), key=lambda one: len(one.motions))
        found = _found(own.spots, informations, tests, np.random.default_rng([0, len(out)]))
        out.append(Power(body, np.array([[_smallest(found[n - 1], share) for share in SHARES] for n in READINGS])))
    return tuple(out)


def _informations(how: SeriesFilter, interval: float, noise: Array) -> Array:
    """(N, q, q) on a step, by 1 to N readings after it."""
    belief, nothing = how.start(0.0), np.zeros(len(noise))
    out: list[Array] = []
    for k in range(_BEFORE + READINGS[-1]):
        belief, _ = how.update(belief, Observed(k * interval, nothing, noise))
        if k >= _BEFORE and len(belief.until):
            out.append(belief.looking.information[-1 - (k - _BEFORE)])
    return np.array(out)


def _test(spots: Array, information: Array, chance: float) -> tuple[Array, float]:
    """(r, q) what makes independent numbers of a score, and the limit of the sum of their squares."""
    values, vectors = np.linalg.eigh(spots.T @ information @ spots)
    seen = values > UNSEEN * values.max()
    return (vectors[:, seen] / np.sqrt(values[seen])).T @ spots.T, float(limit_of(chance, int(np.sum(seen))))


def _found(
    spots: Array, informations: Array, tests: Sequence[Sequence[tuple[Array, float]]], rng: np.random.Generator
) -> Array:
    """(N, S) shares of jumps of each size that are found with 1 to N readings."""
    amounts = rng.standard_normal((_DRAWS, spots.shape[1]))
    amounts *= np.sqrt(spots.shape[1]) / np.linalg.norm(amounts, axis=1, keepdims=True)
    step, noise, before = amounts @ spots.T, np.zeros((_DRAWS, len(spots))), np.zeros_like(informations[0])
    told, out = np.zeros((len(_SIZES), _DRAWS), bool), []
    for information, those in zip(informations, tests, strict=True):
        drawn = rng.standard_normal(noise.shape) @ covariance_root(information - before).T
        noise, before = noise + drawn, information
        score = _SIZES[:, None, None] * (step @ information) + noise
        for away, limit in those:
            told |= np.sum((score @ away.T) ** 2, axis=2) > limit
        out.append(told.mean(axis=1))
    return np.array(out)


def _smallest(found: Array, share: float) -> float:
    """Size from which on a share of jumps is found; NaN for none."""
    less = np.flatnonzero(found < share)
    first = less[-1] + 1 if len(less) else 0
    if first == len(_SIZES):
        return float("nan")
    if first == 0:
        return float(_SIZES[0])
    part = (share - found[first - 1]) / (found[first] - found[first - 1])
    return float(_SIZES[first - 1] * (_SIZES[first] / _SIZES[first - 1]) ** part)
