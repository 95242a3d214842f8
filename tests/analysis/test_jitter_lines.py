"""Oscillations in disparities: found with frequency and amplitude, blind where a whole number of periods lies between
two sights, and none where there is none.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from analysis.orbit.jitter import JitterError, Observations, fit_spline, periodogram, search
from tests.analysis.refusals import refuses

GAPS = (0.1216, 0.1024)
"""Seconds between the sights of ZY-3's blue and green, and of its green and red band."""
RATE = 1e-3
LIMIT = 1e-3
"""Chance with which a test of a rate fails though all is right."""


def of_disparities(first, second, disparity, sigma, pair, degree=2) -> Observations:
    """Observations of one axis: attitude at a second sight less that at a first; each pair has a trend of its own."""
    count, which = len(first), np.asarray(pair)
    weight = np.tile([-1.0 / sigma, 1.0 / sigma], (count, 1))[..., None]
    trend = np.polynomial.legendre.legvander((first - first.mean()) / max(np.ptp(first), 1e-9), degree) / sigma
    each = [trend * (which == k)[:, None] for k in np.unique(which)]
    time = np.stack([first, second], axis=-1)
    return Observations.of(disparity / sigma, np.arange(count), time, weight, np.concatenate(each, axis=1))


@dataclass(frozen=True)
class Pass:
    """Disparities of one axis in pixels."""

    lines: tuple[tuple[float, float, float], ...] = ()
    gaps: tuple[float, ...] = GAPS[:1]
    count: int = 300
    length: float = 10.0
    noise: float = 0.1
    wrong: float = 0.0
    rows: float | None = None
    scatter: float = 0.0

    def turn(self, t):
        return sum((a * np.sin(2.0 * np.pi * f * t + p) for f, a, p in self.lines), np.zeros_like(t))

    def observed(self, seed: int) -> Observations:
        random = np.random.default_rng(seed)
        pair = np.repeat(np.arange(len(self.gaps)), self.count)
        first = random.uniform(0.0, self.length, len(pair))
        if self.rows is not None:
            first = self.rows * np.rint(first / self.rows) + random.uniform(-self.scatter, self.scatter, len(pair))
        second = first + np.array(self.gaps)[pair]
        moved = self.turn(second) - self.turn(first) + 0.5 * pair + 0.03 * first + 0.004 * first**2
        moved = moved + self.noise * random.standard_normal(len(pair))
        bad = random.uniform(size=len(pair)) < self.wrong
        moved[bad] += random.uniform(-20.0, 20.0, len(pair))[bad]
        return of_disparities(first, second, moved, self.noise, pair)


@pytest.mark.second
def test_lines_are_recovered_within_their_sigmas() -> None:
    """0.65 Hz of 0.5 to 1.5 px as ZY-3 shows it, and a smaller line: over all passes the errors over sigma are those of
    a standard normal number, by their chi-square: sigmas wrong by a third are found.
    """
    off: list[float] = []
    passes = 20
    for seed in range(passes):
        truth = ((0.65, 0.5 + seed / (passes - 1.0), 0.1 * seed), (3.4, 0.12, 1.0))
        found = search(Pass(truth).observed(seed), 0.1, 6.0, RATE).lines
        order = np.argsort(found.frequency)
        assert len(order) == 2, seed
        for k, (frequency, amplitude, _) in zip(order, truth, strict=True):
            off.append((found.frequency[k] - frequency) / found.frequency_sigma[k])
            off.append((found.amplitude[k, 0] - amplitude) / found.amplitude_sigma[k, 0])
    chi = np.sum(np.square(off))
    low, high = stats.chi2.ppf([LIMIT / 2.0, 1.0 - LIMIT / 2.0], 4 * passes)
    assert low < chi < high


@pytest.mark.second
def test_the_phase_counts_from_the_epoch_and_the_course_has_a_covariance_that_holds() -> None:
    at, square = np.linspace(0.5, 9.5, 40), []
    passes = 12
    for seed in range(passes):
        one = Pass(((0.65, 1.0, 2.0), (4.0, 0.3, 5.0)))
        lines = search(one.observed(seed), 0.1, 6.0, RATE).lines
        value, spread = lines.course(at)
        square.append((value[20, 0] - one.turn(at)[20]) ** 2 / spread[20, 0, 0])
        assert np.isclose(lines.phase[np.argmin(lines.frequency), 0], 2.0, atol=0.15)
    low, high = stats.chi2.ppf([LIMIT / 2.0, 1.0 - LIMIT / 2.0], passes)
    assert low < np.sum(square) < high


@pytest.mark.second
@pytest.mark.parametrize(("gap", "blind"), [(GAPS[0], 8.224), (GAPS[1], 9.766)])
def test_a_pair_is_blind_where_a_period_lies_between_its_sights(gap: float, blind: float) -> None:
    """A jitter of ten times the noise stays unseen at 1/dt, is named as unseeable, and is found a hertz beside it."""
    found = search(Pass(((blind, 1.0, 0.3),), (gap,)).observed(1), 0.5, 12.0, RATE)
    assert not len(found.lines.frequency)
    inside = [(a, b) for a, b in found.before.intervals() if a < blind < b]
    assert len(inside) == 1
    assert np.mean(inside[0]) == pytest.approx(1.0 / gap, abs=0.02)
    # |sin(pi f dt)| < 0.1: a thirtieth of the frequency to each side
    assert inside[0][1] - inside[0][0] == pytest.approx(2.0 * np.arcsin(0.1) / np.pi / gap, rel=0.1)
    beside = search(Pass(((blind - 1.0, 1.0, 0.3),), (gap,)).observed(1), 0.5, 12.0, RATE).lines
    assert beside.frequency[0] == pytest.approx(blind - 1.0, abs=0.01)


@pytest.mark.second
def test_two_gaps_together_see_what_each_is_blind_for() -> None:
    for frequency in (8.224, 9.766):
        found = search(Pass(((frequency, 0.5, 0.3),), GAPS).observed(2), 0.5, 12.0, RATE)
        assert found.lines.frequency[0] == pytest.approx(frequency, abs=0.01)
        assert found.lines.amplitude[0, 0] == pytest.approx(0.5, abs=5.0 * found.lines.amplitude_sigma[0, 0])
        assert not [span for span in found.before.intervals() if span[0] > 1.0]


@pytest.mark.second
def test_the_response_is_that_of_a_difference() -> None:
    found = periodogram(Pass(count=800).observed(3), 2.0, 12.0)
    assert_allclose(found.response[:, 0], 2.0 * np.abs(np.sin(np.pi * found.frequency * GAPS[0])), rtol=0, atol=0.06)


@pytest.mark.second
@pytest.mark.parametrize("gaps", [GAPS[:1], GAPS], ids=["one", "two"])
def test_the_false_alarm_rate_is_a_bound_and_close(gaps: tuple[float, ...]) -> None:
    """Passes of noise: the highest power of all frequencies exceeds each level at most as often as is said, and not
    much more rarely: in 150 passes 0.05 is told from 0.12.
    """
    chances = []
    passes = 150
    for seed in range(passes):
        found = periodogram(Pass(gaps=gaps, count=120).observed(seed), 0.5, 12.0)
        chances.append(float(found.p_value(found.power[found.best])))
    for rate in (0.01, 0.05, 0.2):
        alarms = int(np.sum(np.array(chances) < rate))
        assert alarms <= stats.binom.ppf(1.0 - LIMIT, passes, rate), rate
        assert alarms >= stats.binom.ppf(LIMIT, passes, 0.5 * rate), rate


def test_wrong_matches_hide_nothing_and_add_nothing() -> None:
    one = Pass(((0.65, 1.0, 0.5),), wrong=0.1)
    found = search(one.observed(4), 0.1, 6.0, RATE)
    assert found.lines.frequency == pytest.approx([0.65], abs=4.0 * found.lines.frequency_sigma[0])
    assert found.lines.amplitude[0, 0] == pytest.approx(1.0, abs=4.0 * found.lines.amplitude_sigma[0, 0])
    assert 0.85 < np.mean(found.used) < 0.95
    assert found.factors[0] == pytest.approx(1.0, abs=0.35)
    assert not len(search(Pass(wrong=0.1).observed(5), 0.1, 6.0, RATE).lines.frequency)


@pytest.mark.second
def test_the_variance_of_the_noise_need_not_be_known() -> None:
    """Covariances that are ten times too small give no line, and sigmas of lines follow the noise that there is."""
    quiet, none = Pass(((2.0, 0.4, 0.0),)).observed(6), Pass().observed(7)
    loud = Observations.of(10.0 * quiet.value, quiet.group, quiet.time, 10.0 * quiet.weight, quiet.nuisance)
    a, b = (search(one, 0.1, 6.0, RATE) for one in (quiet, loud))
    assert_allclose(a.lines.amplitude_sigma, b.lines.amplitude_sigma, rtol=1e-6)
    assert b.factors[0] == pytest.approx(100.0 * a.factors[0])
    none = Observations.of(10.0 * none.value, none.group, none.time, none.weight, none.nuisance)
    assert not len(search(none, 0.1, 6.0, RATE).lines.frequency)


def test_a_spline_follows_what_is_no_line() -> None:
    """A band of noise from 1 to 3 Hz, over 30 passes, in the middle of the strip: errors within the covariance."""
    at, square, plain = np.linspace(3.0, 7.0, 9), [], []
    for seed in range(30):
        random = np.random.default_rng(100 + seed)
        frequency = 1.0 + 2.0 * (np.arange(40) + random.uniform(size=40)) / 40
        lines = tuple(
            (float(f), float(a), float(p))
            for f, a, p in zip(frequency, 0.1 * random.rayleigh(size=40), random.uniform(0.0, 6.28, 40), strict=True)
        )
        one = Pass(lines, count=600)
        value, spread = fit_spline(one.observed(seed), 0.1, 1.0).at(at)
        # what is slow is known to a trend only: it is taken off all that is compared
        slow = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, len(at)), 2)
        away = np.eye(len(at)) - slow @ np.linalg.pinv(slow)
        plain.append(np.std(away @ one.turn(at)))
        square.append(np.std(away @ (value[:, 0] - one.turn(at))))
        assert np.all(spread[:, 0, 0] > 0.0)
    assert np.sqrt(np.mean(np.square(square))) < 0.35 * np.sqrt(np.mean(np.square(plain)))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda v: {"first": v[:5], "second": v[:5] + 0.1, "disparity": v[:5]}, "too few"),
        (lambda v: {"first": v, "second": v + 0.1, "disparity": np.where(v > 5.0, np.nan, 0.0)}, "not finite"),
    ],
)
def test_what_says_nothing_is_told(change, told: str) -> None:
    values = change(np.linspace(0.0, 10.0, 200))
    refuses(JitterError, told, of_disparities, **values, sigma=0.1, pair=np.zeros(len(values["first"])))


def test_frequencies_that_cannot_be_looked_at_are_told() -> None:
    given = Pass().observed(1)
    refuses(JitterError, "no frequencies", periodogram, given, 3.0, 3.001)
    both = np.concatenate([given.weight, 0.0 * given.weight], axis=2)
    unseen = Observations.of(given.value, given.group, given.time, both, given.nuisance)
    refuses(JitterError, "has no effect on the observations", periodogram, unseen, 1.0, 2.0)


SLOW = 2.7
FAST = 8.0 * 3.0 + SLOW
"""Hertz, of an oscillation on rows of 8 a second, and as which it shows there."""


@pytest.mark.second
def test_an_alias_of_a_faster_oscillation_is_recognised() -> None:
    """On rows of 8 Hz, uneven by 4 ms, 26.7 Hz shows at 2.7 Hz with certainty, and explains it better."""
    given = Pass(((FAST, 0.5, 0.3),), GAPS, rows=0.125, scatter=4e-3).observed(8)
    blind = search(given, 0.5, 5.0, RATE).lines
    assert SLOW == pytest.approx(blind.frequency[0], abs=0.02)
    assert blind.p_value[0] < 1e-30
    found = search(given, 0.5, 5.0, RATE, beyond=60.0)
    assert found.beyond == 60.0
    assert found.lines.frequency == pytest.approx([FAST], abs=4.0 * found.lines.frequency_sigma[0])
    assert found.lines.amplitude[0, 0] == pytest.approx(0.5, abs=4.0 * found.lines.amplitude_sigma[0, 0])
    assert found.lines.aliases == ((),)


@pytest.mark.parametrize("true", [SLOW, FAST])
def test_what_even_rows_cannot_tell_apart_is_named(true: float) -> None:
    """On even rows and with one gap all frequencies that differ by whole rates, or mirror each other, are alike."""
    lines = search(Pass(((true, 0.5, 0.3),), rows=0.125).observed(9), 0.5, 6.0, RATE, beyond=30.0).lines
    assert len(lines.frequency) == 1
    named = np.array([lines.frequency[0], *lines.aliases[0]])
    assert np.min(np.abs(named - true)) < 0.02
    assert np.all(
        np.min(np.abs(named[:, None] - np.array([-SLOW, SLOW]) - 8.0 * np.arange(5)[:, None, None]), (0, 2)) < 0.05
    )


@pytest.mark.second
def test_slow_oscillations_at_random_moments_have_no_alias() -> None:
    lines = search(Pass(((0.65, 1.0, 0.5), (3.4, 0.15, 1.0))).observed(4), 0.1, 6.0, RATE, beyond=300.0).lines
    assert np.sort(lines.frequency) == pytest.approx([0.65, 3.4], abs=0.02)
    assert lines.aliases == ((), ())


def three_lines(seed: int, noise: tuple[float, float, float], count: int = 100) -> Observations:
    """What three lines see of one axis less their mean, (2 count,), stated to be of noise 1 in each."""
    random = np.random.default_rng(seed)
    free = np.array([[1.0, -1.0, 0.0], [1.0, 1.0, -2.0]]) / np.sqrt([[2.0], [6.0]])
    first = np.sort(random.uniform(0.0, 10.0, count))
    value = (np.array(noise) * random.standard_normal((count, 3))) @ free.T
    weight = np.broadcast_to(free[:, :, None], (count, 2, 3, 1)).reshape(-1, 3, 1)
    mix = np.broadcast_to(free[:, :, None], (count, 2, 3, 1)).reshape(-1, 3, 1)
    time = first[:, None] + [0.0, *np.cumsum(GAPS)]
    trend = np.kron(np.polynomial.legendre.legvander(first / 5.0 - 1.0, 2), np.eye(2))
    return Observations.of(value.ravel(), np.repeat(np.arange(count), 2), time, weight, trend, mix=mix)


def test_the_noise_of_each_line_is_estimated() -> None:
    """Variances by 1500 points: sums of two lines' variances scatter by sqrt(2 / 1500), those of one by 0.1 to 0.15;
    five times that is allowed.
    """
    given = three_lines(1, (2.0, 1.0, 1.0), 1500)
    assert_allclose(given.factors() - [4.0, 1.0, 1.0], 0.0, atol=0.6)
    even = given.rewhitened(given.factors())
    assert_allclose(even.factors(), 1.0, atol=0.05)
    assert np.var(even.rest(even.value)) == pytest.approx(1.0, abs=0.15)
    # two lines that are only seen against each other are one noise
    alone = Pass(count=200).observed(2)
    both = Observations.of(
        alone.value, alone.group, alone.time, alone.weight, alone.nuisance, mix=np.full((200, 2, 1), 0.5**0.5)
    )
    assert_allclose(both.factors(), alone.factors()[0], rtol=1e-9)


@pytest.mark.second
def test_a_noisy_line_gives_no_false_alarms() -> None:
    """One of three lines with twice the noise that is stated: alarms keep to a rate of 0.1, at the limit of 1e-3."""
    alarms = sum(
        len(search(three_lines(seed, (2.0, 1.0, 1.0)), 0.5, 9.0, 0.1).lines.frequency) > 0 for seed in range(40)
    )
    assert alarms <= stats.binom.ppf(1.0 - LIMIT, 40, 0.1)
