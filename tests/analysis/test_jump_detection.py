"""Jumps in a series, against a generator of its own: readings as the aspect camera of Chandra has of its lights
(temperature times a coefficient, a trend, jumps, slow recoveries, scatter, missing days), of which the filter knows the
laws in time and no more; and missions in which nothing jumps, for the chance of a false alarm.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import binom, chi2

from analysis.monitor import series_smoother
from analysis.monitor.disturbances import Disturbances, TimeLaw
from analysis.monitor.jump_detection import Jump, candidates
from analysis.monitor.series_smoother import smooth
from optics.numerics.threads import one_blas_thread

DAY, YEAR = 86_400.0, 365.25 * 86_400.0
SCATTER = np.array([0.9, 1.3])
"""Arcsec, of a reading in each axis."""


@dataclass(frozen=True, eq=False)
class Mission:
    """A life of two axes.

    Attributes:
        times: (n,) of the readings, seconds; readings: (n, 2) arcsec.
        wanted: (m,) times, seconds; truth: (m, 2) without scatter, arcsec.
        moments: of the jumps, seconds, in order; sizes: (J, 2) arcsec.
    """

    times: np.ndarray
    readings: np.ndarray
    wanted: np.ndarray
    truth: np.ndarray
    moments: np.ndarray
    sizes: np.ndarray


def mission(rng: np.random.Generator, years: float, jumps: int, every_days: float = 7.0) -> Mission:
    """Plain sums; nothing of the filter's laws is used.

    Args:
        rng: of all that chance decides.
        years: it lasts.
        jumps: number of them, of 0.7 to 12.5 arcsec, in any direction.
        every_days: a reading is planned.
    """
    days = np.arange(0.0, 365.25 * years, every_days) + rng.uniform(0.0, 0.5, math.ceil(365.25 * years / every_days))
    keep = rng.random(len(days)) > 0.08
    for start in rng.uniform(0.0, days[-1], max(1, round(years / 2.0))):
        keep &= (days < start) | (days > start + rng.uniform(10.0, 25.0))  # safe modes
    days = days[keep]
    slots = (np.arange(jumps) + rng.uniform(0.2, 0.8, jumps)) / max(jumps, 1)
    moments = 365.25 * years * (0.03 + 0.94 * slots)
    amount = np.exp(rng.uniform(math.log(0.7), math.log(12.5), jumps))
    angle = rng.uniform(0.0, 2.0 * math.pi, jumps)
    sizes = amount[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    wanted = np.sort(
        np.concatenate([np.linspace(days[0], days[-1], 150), *(moments + d for d in (-3.0, -1.0, 1.0, 3.0))])
    )

    at = np.sort(np.concatenate([days, wanted]))
    walk = np.zeros(len(at))  # a temperature that wanders, and the seasons
    for k in range(1, len(at)):
        kept = math.exp(-(at[k] - at[k - 1]) / 50.0)
        walk[k] = kept * walk[k - 1] + math.sqrt(1.0 - kept**2) * rng.standard_normal()
    warm = walk + 1.5 * np.cos(2.0 * math.pi * (at / 365.25 - rng.random()))
    state = warm[:, None] * np.array([0.5, -0.6])
    state += (at / 365.25)[:, None] * rng.normal(0.0, 0.5, 2)
    for moment, size in zip(moments, sizes, strict=True):
        since = np.maximum(at - moment, 0.0)
        state += np.where(at >= moment, 0.9 + 0.1 * np.exp(-since / 40.0), 0.0)[:, None] * size  # a tenth recovers
    shown = state[np.searchsorted(at, days)]
    readings = shown + SCATTER * rng.standard_normal(shown.shape)
    return Mission(days * DAY, readings, wanted * DAY, state[np.searchsorted(at, wanted)], moments * DAY, sizes)


LAWS = {
    "wandering": (TimeLaw(drift_s=50.0 * DAY), (0.7, 0.8)),
    "seasons": (TimeLaw(period_s=YEAR), (1.0, 1.0)),
    "trend": (TimeLaw(trend_s=YEAR), (0.5, 0.5)),
    "mounting": (TimeLaw(), (5.0, 5.0)),
    "jumps": (TimeLaw(jump=True, every_s=400.0 * DAY), (4.0, 4.0)),
}
"""Cause -> its law and its standard deviation in each axis, arcsec."""


def chandra(false_alarm: float = 0.01, without: tuple[str, ...] = ()) -> Disturbances:
    """What the filter is told; a pixel is an arcsec, and the parameters are the two axes."""
    laws = {name: one for name, one in LAWS.items() if name not in without}
    names = tuple(f"{'fid' if name == 'jumps' else name} shift {axis}" for name in laws for axis in "yz")
    sigma = np.array([size for _, sizes in laws.values() for size in sizes])
    see = np.tile(np.eye(2), len(laws)) * sigma
    return Disturbances(
        "chandra",
        names,
        tuple(name.split()[0] for name in names),
        names,
        sigma,
        ("arcsec",) * len(names),
        see,
        see.copy(),
        np.eye(len(names)),
        tuple(law for law, _ in laws.values() for _ in "yz"),
        false_alarm,
    )


class Scatter:
    """Noise of each reading alone."""

    def __init__(self, sigma: np.ndarray = SCATTER) -> None:
        self.sigma = sigma

    def covariance(self, images: np.ndarray) -> np.ndarray:
        return np.diag(np.tile(self.sigma**2, len(images)))


@dataclass
class Score:
    """Of some missions: jumps above 4 sigma, those of them found within two readings and with their size, jumps found
    where none was; how often the truth is inside one and two sigma within ten days of jumps that were found, of jumps
    that were not, and away from all.
    """

    large: int = 0
    found: int = 0
    sized: int = 0
    false: int = 0
    near: tuple[int, int, int] = (0, 0, 0)
    missed: tuple[int, int, int] = (0, 0, 0)
    away: tuple[int, int, int] = (0, 0, 0)

    def add(self, one: Mission, jumps: tuple[Jump, ...], values: np.ndarray, total: np.ndarray) -> None:
        times = one.times
        last = np.searchsorted(times, one.moments)  # the first reading after each
        reach = [(times[max(k - 3, 0)], times[min(k + 2, len(times) - 1)]) for k in last]
        known = np.zeros(len(reach), bool)
        for k, ((early, late), size) in enumerate(zip(reach, one.sizes, strict=True)):
            own = [j for j in jumps if early <= j.after and j.until <= late]
            known[k] = bool(own)
            if np.linalg.norm(size / SCATTER) <= 4.0:
                continue
            self.large += 1
            self.found += bool(own)
            got, sigma = np.zeros(2), np.zeros(2)
            for j in own:
                for label, z, s in zip(j.labels, j.sizes, j.sigmas, strict=True):
                    got["yz".index(label[-1])] += z
                    sigma["yz".index(label[-1])] = math.hypot(sigma["yz".index(label[-1])], s)
            seen = sigma > 0.0
            self.sized += bool(own) and bool(np.all(np.abs(got - size)[seen] < 3.0 * sigma[seen]))
        for j in jumps:  # false where none came when the filter says, nor within two readings of it
            stated = np.any((one.moments >= j.chances[0][0]) & (one.moments <= j.chances[-1][0]))
            self.false += not stated and not any(e <= j.after and j.until <= u for e, u in reach)
        ratio = np.abs(values - one.truth) / np.sqrt(np.diagonal(total, 0, 1, 2))
        close = np.abs(one.wanted[:, None] - one.moments) < 10.0 * DAY
        near, missed = np.any(close & known, axis=1), np.any(close & ~known, axis=1)
        for name, which in (("near", near & ~missed), ("missed", missed), ("away", ~near & ~missed)):
            part = ratio[which]
            new = (part.size, int((part < 1.0).sum()), int((part < 2.0).sum()))
            setattr(self, name, tuple(a + b for a, b in zip(getattr(self, name), new, strict=True)))


def live(rng: np.random.Generator, missions: int, years: float, jumps: int, false_alarm: float = 0.01) -> Score:
    """Score of some missions."""
    score, told = Score(), chandra(false_alarm)
    for _ in range(missions):
        one = mission(rng, years, jumps)
        found = smooth(told, one.times, one.readings, Scatter(), one.wanted)
        assert found.jumps is not None
        late = found.smoothed
        score.add(one, found.jumps, late.values[:, :2], late.total[:, :2, :2])
    return score


@pytest.fixture(autouse=True)
def _one_thread():
    """Small matrices are quicker so."""
    with one_blas_thread():
        yield


@pytest.mark.second
def test_jumps_of_some_years_are_found_with_their_sizes() -> None:
    score = live(np.random.default_rng(1), 12, 3.0, 3)
    assert score.large >= 12
    assert score.found == score.sized == score.large
    assert score.false <= binom.isf(1e-3, 12, 0.01)
    assert score.away[1] / score.away[0] > 0.68
    assert score.away[2] / score.away[0] > 0.95


@pytest.mark.second
def test_false_alarms_of_missions_without_a_jump_are_within_the_stated_rate() -> None:
    """200 missions, with a chance of one half each and of 1 in 20: not more alarms than by chance once in a thousand
    times. Were each look for itself allowed that chance, some 120 looks of a mission would make an alarm of nearly all.
    """
    rng, told = np.random.default_rng(2), chandra(0.5)
    chances = []
    for _ in range(200):
        one = mission(rng, 1.0, 0)
        found = smooth(told, one.times, one.readings, Scatter(), one.times[:1]).jumps or ()
        chances.append(min((j.chance for j in found), default=1.0))
    for rate in (0.5, 0.05):
        assert np.sum(np.array(chances) <= rate) <= binom.isf(1e-3, 200, rate)
    assert min(chances) < 0.5  # some alarm there is, so that the count above can fail


NOISE = 0.2
"""Of the shifts below, px."""


def toy(seed: int = 3, count: int = 40) -> tuple[Disturbances, np.ndarray, np.ndarray]:
    """Two bodies of two motions each, which may jump, above a drift; times; shifts without a jump."""
    rng = np.random.default_rng(seed)
    labels = ("drift x", *(f"{body} shift {axis}" for body in ("mirror", "prism") for axis in "xy"))
    laws = (TimeLaw(drift_s=30.0), *(TimeLaw(jump=True),) * 4)
    see = rng.standard_normal((4, 5))
    told = Disturbances(
        "toy",
        labels,
        tuple(label.split()[0] for label in labels),
        labels,
        np.array([1.0, 2.0, 2.0, 3.0, 3.0]),
        ("um",) * 5,
        see,
        rng.standard_normal((4, 5)),
        np.eye(5),
        laws,
    )
    times = np.arange(float(count))
    walk = np.linalg.cholesky(laws[0].covariance(times[:, None], times)) @ rng.standard_normal(count)
    return told, times, walk[:, None] * see[:, 0] + NOISE * rng.standard_normal((count, 4))


FOUR = Scatter(np.full(4, NOISE))


def test_the_log_ratio_is_that_of_least_squares() -> None:
    """Against the difference of two chi-squares with the whole covariance, the step's amounts fitted to the shifts."""
    told, times, shifts = toy()
    amounts = np.array([0.3, -0.15])  # of the prism, standard deviations
    shifts = shifts + np.outer(times >= 17.0, told.spots[:, 3:] @ amounts)
    (one,) = smooth(told, times, shifts, FOUR, [0.0]).jumps or ()
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
    assert one.chance == pytest.approx(min(1.0, looks * chi2.sf(2.0 * one.log_ratio, 2)), rel=1e-6, abs=0.0)
    assert np.abs(np.array(one.sizes) - 3.0 * amounts) == pytest.approx(0.0, abs=5.0 * max(one.sigmas))
    assert max(one.sigmas) < 1.0
    assert list(one.rivals) == ["mirror"]
    assert one.rivals["mirror"] < one.log_ratio - 3.0


def test_a_motion_alone_explains_what_it_moves_alone() -> None:
    """The direction: of a body's motions only the one that moved; and where two bodies move the spots alike, either is
    named as the other's rival."""
    told, times, shifts = toy()
    moved = shifts + np.outer(times >= 17.0, 1.5 * told.spots[:, 1])
    (one,) = smooth(told, times, moved, FOUR, [0.0]).jumps or ()
    assert one.labels == ("mirror shift x",)
    assert one.sizes[0] == pytest.approx(3.0, abs=5.0 * one.sigmas[0])
    alike = replace(told, spots=told.spots[:, [0, 1, 2, 1, 2]])
    (one,) = smooth(alike, times, moved, FOUR, [0.0]).jumps or ()
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
    found = smooth(told, times, shifts, FOUR, wanted)
    event = replace(
        told,
        spots=told.spots[:, [0, 3]],
        parameters=told.parameters[:, [0, 3]],
        correlation=np.eye(2),
        laws=(told.laws[0], TimeLaw(event=((17.0, 1.0),))),
        **{name: getattr(told, name)[:2] for name in ("labels", "bodies", "causes", "units", "sigmas")},
    )
    known = smooth(event, times, shifts, FOUR, wanted)
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
    found = smooth(told, times, truth + 0.2 * rng.standard_normal(truth.shape), FOUR, [5.0, 30.0], reference)
    (one,) = found.jumps or ()
    assert (one.labels, one.until) == (("prism shift x",), 17.0)
    assert one.after == max(16.0, reference if reference < 17.0 else 16.0)
    assert one.sizes[0] == pytest.approx(6.0, abs=5.0 * one.sigmas[0])
    change = np.array([0.0, 2.0]) - 2.0 * (reference >= 17.0)
    np.testing.assert_allclose(found.smoothed.values, change[:, None] * told.parameters[:, 3], rtol=0, atol=0.5)


def test_a_long_series_in_pieces_finds_the_same(monkeypatch) -> None:
    told, times, shifts = toy(count=60)
    shifts = shifts + np.outer(times >= 17.0, 2.0 * told.spots[:, 3]) - np.outer(times >= 44.0, 2.0 * told.spots[:, 1])
    whole = smooth(told, times, shifts, FOUR, times).jumps or ()
    monkeypatch.setattr(series_smoother, "LARGEST", 120)
    order = np.random.default_rng(5).permutation(60)
    pieces = smooth(told, times[order], shifts[order], FOUR, times).jumps or ()
    assert [(j.labels, j.until) for j in whole] == [(("prism shift x",), 17.0), (("mirror shift x",), 44.0)]
    assert [(j.labels, j.until) for j in pieces] == [(j.labels, j.until) for j in whole]
    for one, two in zip(whole, pieces, strict=True):
        assert one.sizes[0] == pytest.approx(two.sizes[0], abs=one.sigmas[0])


def test_what_moves_no_spot_is_not_looked_for() -> None:
    told, times, shifts = toy()
    blind = replace(told, spots=told.spots * [1.0, 1.0, 0.0, 0.0, 0.0])
    assert [one.motions for one in candidates(blind)] == [(1,)]
    assert smooth(replace(told, spots=told.spots * [1.0, 0, 0, 0, 0]), times, shifts, FOUR, [0.0]).jumps == ()


def test_how_often_it_jumps_counts_in_a_forecast() -> None:
    """Once in 50 s by one standard deviation: after the last reading the variance grows by the gap over 50 s. What the
    last reading says of the drift is forgotten by then to exp(-200 s / 30 s), a thousandth."""
    told, times, shifts = toy()
    often = replace(told, laws=(told.laws[0], *(TimeLaw(jump=True, every_s=50.0),) * 4))
    wanted = np.array([20.0, 139.0, 239.0])
    found, plain = (smooth(one, times, shifts, FOUR, wanted) for one in (often, told))
    assert found.jumps == plain.jumps == ()
    more = np.diagonal(found.smoothed.total - plain.smoothed.total, 0, 1, 2)
    assert more[2] - more[1] == pytest.approx(np.sum(told.parameters[:, 1:] ** 2, axis=1) * 100.0 / 50.0, rel=1e-3)
    assert np.all(more[0] > 0.0)
    assert np.all(more[0] < 0.2 * more[1])


@pytest.mark.slow
def test_a_hundred_missions_of_ten_years() -> None:
    """Nine jumps each, from 0.7 to 12.5 arcsec. Near jumps that were too small to be found sigma does not hold, and no
    number of it is asked for."""
    score = live(np.random.default_rng(1), 100, 10.0, 9)
    assert score.large > 300
    assert score.found >= 0.98 * score.large
    assert score.sized >= 0.98 * score.large
    assert score.false <= binom.isf(1e-3, 100, 0.01)
    for count, one, two in (score.near, score.away):
        assert one / count > 0.68
        assert two / count > 0.95
