"""Jumps that are not told, held against the mixture of all that may have been, one after the other."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.monitor.disturbances import Disturbances, TimeLaw
from analysis.monitor.kalman_filter import SeriesFilter, smoothed, with_indicated_jumps
from tests.analysis.followed_series import follow, of_shifts, whole_steps
from tests.analysis.stated_motions import disturbances
from tests.tiers import quick

NOISE, EVERY = 0.3, 400.0
DRIFT = TimeLaw(drift_s=30.0)
SCALES = (0.125, 0.25, 0.5, 1.0, 2.0)
"""Sizes of a jump over that stated, each as likely, as the module's text says."""


def toy(seed: int = 2, every: float | None = EVERY) -> Disturbances:
    """Two bodies that jump, of two motions that go together and of one, above a drift and a mounting: four spots, three
    parameters.
    """
    rng, jump, correlation = np.random.default_rng(seed), TimeLaw(jump=True, every_s=every), np.eye(6)
    names = ("drift", "mount x", "mount y", "mirror x", "mirror y", "prism x")
    correlation[3, 4] = correlation[4, 3] = 0.6
    see, tell = rng.normal(size=(4, 6)) * [0.2, 1.0, 1.0, 1.0, 1.0, 1.0], rng.normal(size=(3, 6))
    laws = (DRIFT, TimeLaw(), TimeLaw(), jump, jump, jump)
    return disturbances(laws, see, tell, names, correlation, jump_false_alarm=1e-9)


def series(
    told: Disturbances, amounts: tuple[float, ...], count: int = 14, at: int = 9
) -> tuple[np.ndarray, np.ndarray]:
    """Times that are not even, and shifts in which jumping motions step before a reading."""
    rng = np.random.default_rng(5)
    times = np.cumsum(rng.uniform(0.5, 2.0, count))
    moved = (np.arange(count) >= at)[:, None] * (told.spots[:, 3:] @ np.array(amounts))
    return times, moved + NOISE * rng.normal(size=(count, 4))


@pytest.mark.second
@pytest.mark.parametrize("amounts", quick(1, [((0.35, 0.1, 0.0),), ((0.0, 0.0, 0.0),), ((0.0, 0.0, 0.8),)]))
def test_what_is_known_now_is_the_mixture_of_all_jumps_there_may_be(amounts: tuple[float, ...]) -> None:
    """Every place, body and size by itself, known and weighed by the density of all readings: the same to rounding."""
    told = toy()
    times, shifts = series(told, amounts, count=9, at=6)
    read = of_shifts(times, shifts, NOISE**2 * np.eye(4))
    how = SeriesFilter(told)
    belief = how.start(times[0])
    for one in read:
        belief, found = how.update(belief, one)
        assert found.jump is None
    # the mixture is of the filter that knows of no walk
    now = how.mixture(replace(belief, state=belief.jump_track, search=None))
    value, spread = how.parameters(now, times[-1])

    still = toy(every=None)
    bodies = {(3, 4): "mirror", (5,): "prism"}
    cases = [(still, 1.0)]
    for k in range(1, len(times)):
        for motions in bodies:
            for times_of in SCALES:
                event = TimeLaw(event=((times[k], 1.0),))
                prior = (times[k] - times[k - 1]) / EVERY / len(SCALES)
                cases.append((still.with_copies(motions, times_of, event), prior))
    logs, means, squares = [], [], []
    for model, prior in cases:
        knowing, log = SeriesFilter(model, window=0), np.log(prior)
        belief = knowing.start(times[0])
        for one in read:
            belief, found = knowing.update(belief, one)
            log += found.log_score
        logs.append(log)
        mean, own = knowing.parameters(belief, times[-1])
        means.append(mean)
        squares.append(own + np.outer(mean, mean))
    weight = np.exp(np.array(logs) - max(logs))
    weight /= weight.sum()
    mean = weight @ np.array(means)
    whole = np.einsum("h,hij->ij", weight, squares) - np.outer(mean, mean)
    sigma = np.sqrt(np.diag(whole))
    assert np.all(np.abs(value - mean) < 1e-8 * sigma)
    assert np.all(np.abs(spread - whole) < 1e-8 * np.outer(sigma, sigma))
    if any(amounts):
        assert weight[0] < 0.99  # it hints at the jump


def test_the_way_back_has_scores_of_steps_before_every_reading() -> None:
    """Against the Cholesky factor of the whole series."""
    told = toy()
    times, shifts = series(told, (0.7, -0.2, 0.0))
    how = SeriesFilter(told, window=0, include_undetected=False)
    score, information = np.empty((len(times), how.space.size)), np.empty((len(times), how.space.size, how.space.size))

    def note(number: int, carried: np.ndarray, known: np.ndarray) -> None:
        score[number], information[number] = carried, known

    none = [np.zeros(0)] * len(times)
    start = how.start(times[0])
    smoothed(how, start, of_shifts(times, shifts, NOISE**2 * np.eye(4)), [], none, how.parameters_of, note)

    whole = whole_steps(told, times, shifts, NOISE)
    level, spots = how.space.level_of([3, 4, 5]), told.spots[:, 3:]
    own = score[1:] @ level
    assert np.allclose(own, whole.score @ spots, rtol=1e-8, atol=1e-8 * np.abs(own).max())
    own = level.T @ information[1:] @ level
    assert np.allclose(own, spots.T @ whole.information @ spots, rtol=1e-8, atol=1e-8 * np.abs(own).max())


def test_a_hint_adds_to_the_walk_where_it_is() -> None:
    """Without a jump next to nothing; with one that is not told, most of it before the reading before which it came, of
    the size that it has, by the factor two that the module states.
    """
    told = toy()
    noise = NOISE**2 * np.eye(4)

    def more(amount: float) -> np.ndarray:
        times, shifts = series(told, (0.0, 0.0, amount), count=30, at=15)
        how = SeriesFilter(told)
        knowing = replace(how, window=0)
        nothing = [np.zeros(3)] * len(times)
        read = of_shifts(times, shifts, noise)
        found = np.array(with_indicated_jumps(how, knowing, knowing.start(times[0]), read, nothing)[1])[1:]
        return found * (np.diff(times) / EVERY)[:, None]

    quiet, hint = more(0.0), more(0.9)
    assert quiet.sum() < 0.05
    assert int(np.argmax(hint[:, 2])) == 14
    assert 0.9**2 < hint[12:17, 2].sum() < 4.0 * 0.9**2
    assert hint[:, :2].sum() < hint[:, 2].sum()


def test_what_else_the_body_did_is_not_lost_when_its_jump_is_told() -> None:
    """One motion makes the jump be told, the other one, that does not, counts as free."""
    jump, names = TimeLaw(jump=True), ("mount y", "mount z", "light y", "light z")
    see = np.tile(np.eye(2), 2) * [5.0, 5.0, 4.0, 4.0]
    told = disturbances((TimeLaw(), TimeLaw(), jump, jump), see, see.copy(), names, sigmas=[5.0, 5.0, 4.0, 4.0])
    truth = np.array([12.0, 2.0])
    times = np.arange(60.0)
    shifts = (times >= 40.0)[:, None] * truth + np.random.default_rng(1).normal(size=(60, 2))
    found = follow(SeriesFilter(told, life_s=60.0), of_shifts(times, shifts, np.eye(2)), [41.0, 44.0, 59.0])
    (one,) = found.jumps
    assert (one.labels, one.after) == (("light y",), 39.0)
    for state in (found.filtered, found.smoothed):
        sigma = np.sqrt(np.diagonal(state.total, 0, 1, 2))
        assert np.all(np.abs(state.values - truth) < 3.0 * sigma)
        assert np.all(sigma < [[1.2], [0.8], [0.4]])
