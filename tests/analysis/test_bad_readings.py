"""Bad readings among good ones and true jumps: the state is that of the good readings, by a dense joint normal of the
whole series that knows which these are, and nothing jumps where nothing did.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import binom, multivariate_normal

from analysis.monitor.disturbances import Disturbances, TimeLaw
from analysis.monitor.filter_state import Observed, _with_errors
from analysis.monitor.kalman_filter import SeriesFilter, detection_power
from analysis.statistics import limit_of
from tests.analysis.followed_series import follow, of_shifts
from tests.analysis.stated_motions import SpotNoise, disturbances
from tests.analysis.test_series_smoother import conditioned

pytestmark = pytest.mark.second

NOISE, COUNT, EVERY, DAYS = 0.001, 6, 900.0, 30
DRIFT = 60.0
"""Days in which mounts forget where they were; a reading comes every day."""


@dataclass(frozen=True, eq=False)
class Series:
    """A drawn series.

    Attributes:
        times: (T,) days; shifts: (T, COUNT) px with noise and errors; truth: (T, 2) of the parameters.
        bad: numbers of bad readings. jumps: body -> number of the first reading after its jump.
    """

    times: np.ndarray
    shifts: np.ndarray
    truth: np.ndarray
    bad: tuple[int, ...]
    jumps: dict[str, int]


def toy(jumping: bool) -> Disturbances:
    """Two bodies that drift, shake and slip: each moves its three coordinates together by a pixel, and against each
    other by hundredths, as cameras move spots.
    """
    rng = np.random.default_rng(4)
    laws = [TimeLaw(drift_s=DRIFT), TimeLaw(white=True), *([TimeLaw(jump=True, every_s=EVERY)] if jumping else [])]
    spots, parameters, names = [], [], []
    for size in (0.4, 0.05, 2.0)[: len(laws)]:
        for body in range(2):
            for k in range(3):
                column = np.zeros(COUNT)
                column[3 * body : 3 * body + 3] = size * ((1.0 if k == 0 else 0.0) + 0.02 * rng.normal(size=3))
                spots.append(column)
                parameters.append(size * rng.normal(size=2))
                names.append(f"body{body} shift {len(names)}")
    every = tuple(law for law in laws for _ in range(6))
    return disturbances(every, np.array(spots).T, np.array(parameters).T, names)


def drawn(told: Disturbances, seed: int, bad: int, jumps: int) -> Series:
    """Motions by their laws, errors of 0.05 to 3 px at 1 to 6 coordinates of some readings, slips of some bodies."""
    rng = np.random.default_rng([seed, 3])
    times = np.arange(float(DAYS))
    motions = np.zeros((DAYS, len(told.labels)))
    for k, law in enumerate(told.laws):
        if law.white:
            motions[:, k] = rng.normal(size=DAYS)
        elif not law.jump:
            covariance = np.exp(-np.abs(times[:, None] - times) / DRIFT)
            motions[:, k] = np.linalg.cholesky(covariance + 1e-12 * np.eye(DAYS)) @ rng.normal(size=DAYS)
    slips = {}
    for body in rng.permutation(["body0", "body1"])[:jumps]:
        slips[str(body)] = int(rng.integers(8, 15)) + 9 * len(slips)  # not in one gap
        own = [k for k, law in enumerate(told.laws) if law.jump and told.bodies[k] == body]
        motions[slips[str(body)] :, own] += rng.normal(size=len(own)) + 1.0
    shifts = motions @ told.spots.T + NOISE * rng.normal(size=(DAYS, COUNT))
    free = [k for k in range(3, DAYS - 1) if k not in slips.values()]
    which = sorted(int(k) for k in rng.choice(free, bad, replace=False))
    for k in which:
        at = rng.choice(COUNT, rng.integers(1, COUNT + 1), replace=False)
        shifts[k, at] += np.exp(rng.uniform(np.log(0.05), np.log(3.0), len(at))) * rng.choice([-1.0, 1.0], len(at))
    return Series(times, shifts, motions @ told.parameters.T, tuple(which), slips)


def read_of(one: Series) -> tuple[Observed, ...]:
    return of_shifts(one.times, one.shifts, NOISE**2 * np.eye(COUNT))


def test_the_state_is_that_of_the_good_readings() -> None:
    """Nothing is stated to jump: errors above what motions explain are left out, and all is as if they had not come.
    The filter and the joint normal differ by rounding alone.
    """
    told, left = toy(False), 0
    how = SeriesFilter(told, life_s=10.0 * DAYS)
    for seed in range(12):
        one = drawn(told, seed, 3, 0)
        found = follow(how, read_of(one), [one.times[-1]])
        assert set(found.left_out) <= set(one.bad)
        left += len(found.left_out)
        good = np.delete(np.arange(DAYS), found.left_out)
        own = SpotNoise(NOISE**2 * np.eye(COUNT))
        known = conditioned(told, one.times[good], one.shifts[good], own, one.times[-1:], None)
        mean, covariance = known[0][0], known[1][0]
        for course in (found.filtered, found.smoothed):
            sigma = np.sqrt(np.diag(covariance))
            assert np.all(np.abs(course.values[0] - mean) < 1e-6 * sigma)
            assert np.allclose(course.total[0], covariance, rtol=1e-6, atol=1e-9 * sigma.min() ** 2)
    assert left >= 30  # of 36; an error of 0.05 px is within what both bodies' motions make of a coordinate


def test_errors_are_weighed_by_normal_densities() -> None:
    """With errors at the coordinate that explains most, and at all of them."""
    rng = np.random.default_rng(6)
    root, reading, errors = rng.normal(size=(3, 3)), 3.0 * rng.normal(size=3), np.array([0.5, 2.0, 9.0])
    good = root @ root.T + 0.1 * np.eye(3)
    precision = np.linalg.inv(good)
    found = _with_errors(precision, precision @ reading, errors)

    def log_ratio(size: np.ndarray) -> float:
        bad, without = (multivariate_normal(cov=good + np.diag(s)) for s in (size, 0.0 * size))
        return float(bad.logpdf(reading) - without.logpdf(reading))

    alone = [log_ratio(row) for row in np.diag(errors)]
    np.testing.assert_allclose(found[[0, 2]], [max(alone), log_ratio(errors)], rtol=1e-9)


def test_a_jump_that_looks_bad_counts_with_both_until_the_next_reading() -> None:
    """A slip in a direction in which a body hardly moves spots: set aside, and taken with the next reading; a bad
    reading of the same size is not.
    """
    told = toy(True)
    how = SeriesFilter(told, life_s=10.0 * DAYS)
    one = drawn(told, 1, 0, 0)
    column = told.spots[:, [k for k, law in enumerate(told.laws) if law.jump][1]]
    for stays in (True, False):
        shifts, belief = one.shifts.copy(), how.start(0.0)
        shifts[20 : None if stays else 21] += 4.0 * column
        for k, reading in enumerate(read_of(replace(one, shifts=shifts))):
            belief, found = how.update(belief, reading)
            if k == 20:
                assert found.bad is not None
                assert abs(found.bad.z) > 5.0
            if k == 21:
                assert found.settled
                assert (found.earlier is not None) == stays
                assert found.bad is None


def test_two_jumps_in_one_gap_leave_a_rest() -> None:
    """The body that is named explains its own jump and not the other: the rest tells, and is none of one jump alone."""
    told = toy(True)
    how = SeriesFilter(told, life_s=10.0 * DAYS)
    one = drawn(told, 1, 0, 0)
    slips = [told.spots[:, [k for k, law in enumerate(told.laws) if law.jump][at]] for at in (0, 3)]
    for step, alone in ((1.5 * slips[0], True), (1.5 * slips[0] + 0.5 * slips[1], False)):
        shifts, belief, jumps = one.shifts.copy(), how.start(0.0), []
        shifts[20:] += step
        for reading in read_of(replace(one, shifts=shifts)):
            belief, found = how.update(belief, reading)
            jumps += [] if found.jump is None else [found.jump]
        square, degrees = jumps[0].rest
        assert (square < limit_of(1e-3, degrees)) == alone


def test_the_power_is_that_of_the_filter() -> None:
    """Jumps of the size that half are found of within three readings, given to the filter itself: a binomial count."""
    told, count = toy(True), 60
    how = SeriesFilter(told, life_s=10.0 * DAYS)
    power = {one.body: one for one in detection_power(how, 1.0, NOISE**2 * np.eye(COUNT))}
    own = [k for k, law in enumerate(told.laws) if law.jump and told.bodies[k] == "body1"]
    size, rng, found = float(power["body1"].sizes[1, 0]), np.random.default_rng(5), 0
    start, one = how.start(0.0), drawn(told, 2, 0, 0)
    for reading in read_of(one)[:22]:
        start, _ = how.update(start, reading)
    for _ in range(count):
        amounts = rng.normal(size=3)
        step = told.spots[:, own] @ (amounts * size * np.sqrt(3.0) / np.linalg.norm(amounts))
        belief, jumps = start, 0
        for reading in read_of(one)[22:25]:
            belief, told_now = how.update(belief, replace(reading, value=reading.value + step))
            jumps += told_now.jump is not None
        found += jumps > 0
    assert binom.ppf(1e-3, count, 0.5) <= found <= binom.ppf(0.999, count, 0.5)
