"""Jumps in a series against least squares of the whole series, and the rate of false alarms where nothing jumps."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, chi2

from analysis.monitor import series_smoother
from analysis.monitor.disturbances import Disturbances, TimeLaw
from analysis.monitor.jump_detection import candidates
from analysis.monitor.series_smoother import smooth_series
from tests.analysis.stated_motions import SpotNoise, disturbances

NOISE = 0.2
"""Of the shifts below, px."""


def toy(seed: int = 3, count: int = 40, false_alarm: float = 0.01) -> tuple[Disturbances, np.ndarray, np.ndarray]:
    """Two bodies of two motions each, which may jump, above a drift; times; shifts without a jump."""
    rng = np.random.default_rng(seed)
    labels = ("drift x", *(f"{body} shift {axis}" for body in ("mirror", "prism") for axis in "xy"))
    laws = (TimeLaw(drift_s=30.0), *(TimeLaw(jump=True),) * 4)
    see, tell = rng.standard_normal((2, 4, 5))
    sigmas = np.array([1.0, 2.0, 2.0, 3.0, 3.0])
    told = disturbances(laws, see, tell, labels, sigmas=sigmas, jump_false_alarm=false_alarm)
    times = np.arange(float(count))
    walk = np.linalg.cholesky(laws[0].covariance(times[:, None], times)) @ rng.standard_normal(count)
    return told, times, walk[:, None] * see[:, 0] + NOISE * rng.standard_normal((count, 4))


FOUR = SpotNoise(NOISE**2 * np.eye(4))


@pytest.mark.second
def test_false_alarms_of_series_without_a_jump_are_within_the_stated_rate() -> None:
    """200 series at a stated chance of one half: no more alarms at one half and at 1 in 20 than chance makes once in a
    thousand times. Were each of the 234 looks allowed that chance, nearly all would have one."""
    chances = []
    for seed in range(200):
        told, times, shifts = toy(seed, false_alarm=0.5)
        chances.append(
            min((j.false_alarm for j in smooth_series(told, times, shifts, FOUR, [0.0]).jumps or ()), default=1.0)
        )
    for rate in (0.5, 0.05):
        assert np.sum(np.array(chances) <= rate) <= binom.isf(1e-3, 200, rate)
    assert min(chances) < 0.5  # some alarm there is, so that the count above can fail


def test_the_log_ratio_is_that_of_least_squares() -> None:
    """Against the difference of two chi-squares with the whole covariance, the step's amounts fitted to the shifts."""
    told, times, shifts = toy()
    amounts = np.array([0.3, -0.15])  # of the prism, standard deviations
    shifts = shifts + np.outer(times >= 17.0, told.spots[:, 3:] @ amounts)
    (one,) = smooth_series(told, times, shifts, FOUR, [0.0]).jumps or ()
    drift = told.spots[:, :1]
    spread = np.kron(told.laws[0].covariance(times[:, None], times), drift @ drift.T) + 0.04 * np.eye(160)
    rows = np.kron((times >= 17.0).astype(float)[:, None], told.spots[:, 3:])
    inverse = np.linalg.inv(spread)
    s = shifts.ravel()
    fit = np.linalg.solve(rows.T @ inverse @ rows, rows.T @ inverse @ s)
    left = s - rows @ fit
    assert (one.body, one.after, one.until) == ("prism", 16.0, 17.0)
    assert one.log_ratio == pytest.approx(0.5 * (s @ inverse @ s - left @ inverse @ left), rel=1e-6)
    looks = 39 * 6  # four motions, two bodies
    assert one.false_alarm == pytest.approx(min(1.0, looks * chi2.sf(2.0 * one.log_ratio, 2)), rel=1e-6, abs=0.0)
    assert np.abs(np.array(one.sizes) - 3.0 * amounts) == pytest.approx(0.0, abs=5.0 * max(one.sigmas))
    assert max(one.sigmas) < 1.0
    assert list(one.rivals) == ["mirror"]
    assert one.rivals["mirror"] < one.log_ratio - 3.0


def test_a_motion_alone_explains_what_it_moves_alone() -> None:
    """The direction: of a body's motions only the one that moved; and where two bodies move the spots alike, either is
    named as the other's rival."""
    told, times, shifts = toy()
    moved = shifts + np.outer(times >= 17.0, 1.5 * told.spots[:, 1])
    (one,) = smooth_series(told, times, moved, FOUR, [0.0]).jumps or ()
    assert one.labels == ("mirror shift x",)
    assert one.sizes[0] == pytest.approx(3.0, abs=5.0 * one.sigmas[0])
    alike = replace(told, spots=told.spots[:, [0, 1, 2, 1, 2]])
    (one,) = smooth_series(alike, times, moved, FOUR, [0.0]).jumps or ()
    # the other body explains as much alone, and with its second motion by half a chi-square of one number more
    (rival,) = one.rivals.items()
    assert rival[0] == ("prism" if one.body == "mirror" else "mirror")
    assert 0.0 <= rival[1] - one.log_ratio + 1e-6 < 0.5 * chi2.isf(1e-3, 1)


def test_the_smoother_follows_a_jump_and_is_unsure_around_it() -> None:
    """Away from a jump sigma is as if its moment had been stated, and between the readings around it wide."""
    told, times, _ = toy()
    rng = np.random.default_rng(6)
    walk = np.linalg.cholesky(told.laws[0].covariance(times[:, None], times)) @ rng.standard_normal(len(times))
    motions = np.stack([walk, 2.0 * (times >= 17.0)], axis=1)
    shifts = motions @ told.spots[:, [0, 3]].T + NOISE * rng.standard_normal((len(times), 4))
    wanted = np.array([5.0, 16.5, 30.0])
    found = smooth_series(told, times, shifts, FOUR, wanted)
    event = replace(
        told,
        spots=told.spots[:, [0, 3]],
        parameters=told.parameters[:, [0, 3]],
        correlation=np.eye(2),
        laws=(told.laws[0], TimeLaw(event=((17.0, 1.0),))),
        **{name: getattr(told, name)[:2] for name in ("labels", "bodies", "causes", "units", "sigmas")},
    )
    known = smooth_series(event, times, shifts, FOUR, wanted)
    sigma, sure = (np.sqrt(np.diagonal(one.smoothed.total, 0, 1, 2)) for one in (found, known))
    assert sigma[[0, 2]] == pytest.approx(sure[[0, 2]], rel=0.05)
    step = 2.0 * np.abs(told.parameters[:, 3])
    assert np.all(sigma[1] > 0.45 * step)  # half of it, at least, as for a step that has come with a chance of 1/2
    truth = motions[[5, 30]] @ event.parameters.T
    assert np.all(np.abs(found.smoothed.values[[0, 2]] - truth) < 5.0 * sigma[[0, 2]])


@pytest.mark.parametrize("reference", [-10.0, 16.5, 25.0])
def test_changes_since_a_reference(reference: float) -> None:
    """A jump before the reference, after it, and in the gap in which it lies."""
    told, times, _ = toy()
    told = replace(told, laws=(TimeLaw(white=True), *told.laws[1:]), spots=told.spots * [1e-3, 1.0, 1.0, 1.0, 1.0])
    rng, step = np.random.default_rng(4), 2.0 * told.spots[:, 3]
    truth = np.outer(times >= 17.0, step) - (reference >= 17.0) * step
    found = smooth_series(told, times, truth + 0.2 * rng.standard_normal(truth.shape), FOUR, [5.0, 30.0], reference)
    (one,) = found.jumps or ()
    assert (one.labels, one.until) == (("prism shift x",), 17.0)
    assert one.after == max(16.0, reference if reference < 17.0 else 16.0)
    assert one.sizes[0] == pytest.approx(6.0, abs=5.0 * one.sigmas[0])
    change = np.array([0.0, 2.0]) - 2.0 * (reference >= 17.0)
    np.testing.assert_allclose(found.smoothed.values, change[:, None] * told.parameters[:, 3], rtol=0, atol=0.5)


def test_a_long_series_in_pieces_finds_the_same(monkeypatch) -> None:
    told, times, shifts = toy(count=60)
    shifts = shifts + np.outer(times >= 17.0, 2.0 * told.spots[:, 3]) - np.outer(times >= 44.0, 2.0 * told.spots[:, 1])
    whole = smooth_series(told, times, shifts, FOUR, times).jumps or ()
    monkeypatch.setattr(series_smoother, "LARGEST", 120)
    order = np.random.default_rng(5).permutation(60)
    pieces = smooth_series(told, times[order], shifts[order], FOUR, times).jumps or ()
    assert [(j.labels, j.until) for j in whole] == [(("prism shift x",), 17.0), (("mirror shift x",), 44.0)]
    assert [(j.labels, j.until) for j in pieces] == [(j.labels, j.until) for j in whole]
    for one, two in zip(whole, pieces, strict=True):
        assert one.sizes[0] == pytest.approx(two.sizes[0], abs=one.sigmas[0])


def test_what_moves_no_spot_is_not_looked_for() -> None:
    told, times, shifts = toy()
    blind = replace(told, spots=told.spots * [1.0, 1.0, 0.0, 0.0, 0.0])
    assert [one.motions for one in candidates(blind)] == [(1,)]
    assert smooth_series(replace(told, spots=told.spots * [1.0, 0, 0, 0, 0]), times, shifts, FOUR, [0.0]).jumps == ()


def test_how_often_it_jumps_counts_in_a_forecast() -> None:
    """Once in 50 s by one standard deviation: after the last reading the variance grows by the gap over 50 s. What the
    last reading says of the drift is forgotten by then to exp(-200 s / 30 s), a thousandth."""
    told, times, shifts = toy()
    often = replace(told, laws=(told.laws[0], *(TimeLaw(jump=True, every_s=50.0),) * 4))
    wanted = np.array([20.0, 139.0, 239.0])
    found, plain = (smooth_series(one, times, shifts, FOUR, wanted) for one in (often, told))
    assert found.jumps == plain.jumps == ()
    more = np.diagonal(found.smoothed.total - plain.smoothed.total, 0, 1, 2)
    assert more[2] - more[1] == pytest.approx(np.sum(told.parameters[:, 1:] ** 2, axis=1) * 100.0 / 50.0, rel=1e-3)
    assert np.all(more[0] > 0.0)
    assert np.all(more[0] < 0.2 * more[1])
