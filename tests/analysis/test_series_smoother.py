"""Filter and smoother over a series: against a textbook Kalman filter with Rauch-Tung-Striebel smoother, against
plain conditioning of all times together, and what has to stay as it is whatever the series.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from analysis.monitor import series_smoother
from analysis.monitor.disturbances import Disturbances, TimeLaw
from analysis.monitor.series_smoother import smooth_series
from analysis.spots.spot_image import NoiseParts, SeriesNoise
from tests.analysis.refusals import refuses
from tests.analysis.stated_motions import correlation_of, disturbances

WHITE, CONSTANT = TimeLaw(white=True), TimeLaw()
DRIFT, SWING, BOTH = TimeLaw(drift_s=50.0), TimeLaw(period_s=90.0), TimeLaw(drift_s=200.0, period_s=70.0)
LAWS = (WHITE, CONSTANT, DRIFT, SWING, BOTH)
ROUNDING = 1e-7
"""Of the prior: float64 loses the ratio of prior to noise, 1e6 here, twice."""


@dataclass(frozen=True)
class Dense:
    """Noise of each measurement, of the reference image they share, and of whatever else."""

    every: np.ndarray

    def covariance(self, images: np.ndarray) -> np.ndarray:
        n = len(images)
        return self.every[np.ix_(images, range(self.every.shape[1]), images, range(self.every.shape[1]))].reshape(
            n * self.every.shape[1], -1
        )


def noise_of(own: np.ndarray, shared: np.ndarray) -> Dense:
    """Own noise (M, D, D) and that of the reference (D, D)."""
    count, width = own.shape[:2]
    every = np.tile(shared[None, :, None, :], (count, 1, count, 1))
    for k in range(count):
        every[k, :, k] += own[k]
    assert every.shape == (count, width, count, width)
    return Dense(every)


def some(rng: np.random.Generator, laws=LAWS, each: int = 3, spots: int = 4) -> Disturbances:
    """Random derivatives; motions of one law are correlated."""
    every = tuple(law for law in laws for _ in range(each))
    see, tell = rng.standard_normal((2, spots, len(every)))
    return disturbances(every, see, 1e-5 * tell, correlation=correlation_of(rng, every))


def random_noise(rng: np.random.Generator, count: int, spots: int = 4) -> tuple[np.ndarray, np.ndarray]:
    roots = 1e-3 * rng.standard_normal((count + 1, spots, spots + 2))
    every = roots @ roots.transpose(0, 2, 1)
    return every[:-1], every[-1]


def dense(stated: Disturbances, times: np.ndarray, reference: float | None) -> np.ndarray:
    """(T M, T M) covariance of all motions at all times."""
    out = np.zeros((len(times), len(stated.laws), len(times), len(stated.laws)))
    for i, law in enumerate(stated.laws):
        along = law.covariance(times[:, None], times)
        if reference is not None:
            back = law.covariance(times, reference)
            along = along - back[:, None] - back + law.covariance(reference, reference)
        out[:, i] = along[:, :, None] * stated.correlation[i]
    return out.reshape(len(times) * len(stated.laws), -1)


def joint_normal(stated, measured, noise, times, reference):
    """By one joint matrix of all motions: the gain of the parameters at times by shifts, the covariance of the
    parameters before and after, and that of the shifts."""
    every = np.concatenate([measured, times])
    motions = dense(stated, every, reference)
    m, t = len(measured), len(times)
    a = np.kron(np.eye(m), stated.spots)
    b = np.kron(np.eye(t), stated.parameters)
    cut = m * len(stated.laws)
    spread = a @ motions[:cut, :cut] @ a.T + noise.covariance(np.arange(m))
    across = b @ motions[cut:, :cut] @ a.T
    gain = np.linalg.solve(spread, across.T).T
    before = b @ motions[cut:, cut:] @ b.T
    return gain, before, before - gain @ across.T, spread


def conditioned(stated, measured, shifts, noise, times, reference):
    """Mean and covariance of the parameters at times, given shifts, that by noise alone, and chi-square."""
    gain, _, left, spread = joint_normal(stated, measured, noise, times, reference)
    m, t = len(measured), len(times)
    width = len(stated.parameters)
    blocks = left.reshape(t, width, t, width)[np.arange(t), :, np.arange(t)]
    own = gain @ noise.covariance(np.arange(m)) @ gain.T
    return (
        (gain @ shifts.ravel()).reshape(t, width),
        blocks,
        own.reshape(t, width, t, width)[np.arange(t), :, np.arange(t)],
        float(shifts.ravel() @ np.linalg.solve(spread, shifts.ravel())),
    )


def close(found, expected, prior) -> None:
    size = np.sqrt(np.diagonal(prior, 0, -2, -1)).max()
    power = 2 if np.ndim(expected) == 3 else 1
    assert np.abs(found - expected).max() < ROUNDING * size**power


@pytest.mark.parametrize("reference", [None, 10.0, 55.0])
def test_as_conditioning_all_times_together(reference) -> None:
    rng = np.random.default_rng(2)
    stated = some(rng)
    measured, times = np.array([0.0, 10.0, 30.0, 60.0]), np.array([0.0, 12.0, 55.0, 70.0])
    own, shared = random_noise(rng, len(measured))
    noise = noise_of(own, shared)
    shifts = rng.standard_normal((len(measured), 4))
    found = smooth_series(stated, measured, shifts, noise, times, reference)
    prior = stated.parameter_covariance
    values, spread, by_noise, square = conditioned(stated, measured, shifts, noise, times, reference)
    close(found.smoothed.values, values, prior)
    close(found.smoothed.total, spread, prior)
    close(found.smoothed.noise, by_noise, prior)
    assert found.consistency.chi_square == pytest.approx(square, rel=1e-6)
    assert found.innovations.sum() == pytest.approx(square, rel=1e-6)
    assert found.consistency.degrees == shifts.size
    for k, time in enumerate(times):
        part = measured <= time
        only = Dense(noise.every[np.ix_(part, range(4), part, range(4))])
        values, spread, by_noise, _ = conditioned(stated, measured[part], shifts[part], only, times[[k]], reference)
        close(found.filtered.values[k], values[0], prior)
        close(found.filtered.total[k], spread[0], prior)
        close(found.filtered.noise[k], by_noise[0], prior)


def test_long_series_in_pieces(monkeypatch) -> None:
    """Motions that are forgotten within a third of the window: pieces give what the whole gives; and where they are
    not, sigmas are larger, not smaller."""
    rng = np.random.default_rng(8)
    measured = 10.0 * np.arange(24)
    times = np.concatenate([measured + 3.0, [-20.0, 0.0, 230.0, 300.0]])
    own, shared = random_noise(rng, len(measured))
    for laws, exact in (((TimeLaw(drift_s=1.0),), True), (LAWS, False)):
        stated = some(rng, laws, 2)
        nothing = np.zeros_like(shared)
        shifts = rng.standard_normal((len(measured), 4))
        noise = noise_of(own, nothing if exact else shared)
        monkeypatch.setattr(series_smoother, "LARGEST", 2400)
        whole = smooth_series(stated, measured, shifts, noise, times)
        monkeypatch.setattr(series_smoother, "LARGEST", 36)
        pieces = smooth_series(stated, measured, shifts, noise, times)
        prior = stated.parameter_covariance
        if exact:
            # what is 30 s away counts exp(-30 s / 1 s)
            close(pieces.smoothed.values, whole.smoothed.values, prior)
            close(pieces.smoothed.total, whole.smoothed.total, prior)
            close(pieces.filtered.total, whole.filtered.total, prior)
            assert pieces.innovations == pytest.approx(whole.innovations, rel=1e-6)
        else:
            scale = np.sqrt(np.diag(prior))
            less = np.linalg.eigvalsh((pieces.smoothed.total - whole.smoothed.total) / scale / scale[:, None])
            assert less.min() > -ROUNDING
            assert less.max() > 10.0 * ROUNDING


def test_refusals() -> None:
    rng = np.random.default_rng(9)
    stated = some(rng, (DRIFT, BOTH), 2)
    mixed = stated.correlation.copy()
    mixed[0, 2] = mixed[2, 0] = 0.1
    own, shared = random_noise(rng, 2)
    shifts = np.ones((2, 4))
    with pytest.raises(ValueError, match="different laws"):
        smooth_series(replace(stated, correlation=mixed), [0.0, 1.0], shifts, noise_of(own, shared), [0.0])
    still = replace(stated, laws=(CONSTANT,) * 4)
    refuses(
        ValueError, "need noise", smooth_series, still, [0.0, 1.0], shifts, noise_of(0.0 * own, 0.0 * shared), [0.0]
    )


def test_noise_of_a_series_of_images() -> None:
    """Against all products of the maps, in any order of the images; images beyond the reach are refused."""
    rng = np.random.default_rng(10)
    spots, images, pixels = 3, 5, 7

    def parts(count: int) -> NoiseParts:
        root = rng.standard_normal((count, 2, 3))
        return NoiseParts(root @ root.transpose(0, 2, 1), rng.standard_normal((count, 2, pixels)).astype(np.float32))

    before, after = parts(spots), parts(spots * images)
    noise = SeriesNoise(before, 10)
    noise.add(NoiseParts(after.temporal[:6], after.pattern[:6]))
    noise.add(NoiseParts(after.temporal[6:], after.pattern[6:]))
    assert noise.images == images
    expected = np.zeros((images, spots, 2, images, spots, 2))
    maps = (after.pattern.reshape(images, spots, 2, pixels) - before.pattern).astype(np.float64)
    for s in range(spots):
        for i in range(images):
            for j in range(images):
                expected[i, s, :, j, s] = before.temporal[s] + maps[i, s] @ maps[j, s].T
            expected[i, s, :, i, s] += after.temporal[spots * i + s]
    order = np.array([3, 0, 4, 2])
    whole = expected[np.ix_(order, range(spots), range(2), order, range(spots), range(2))].reshape(24, 24)
    assert noise.covariance(order) == pytest.approx(whole, rel=1e-5, abs=1e-5)  # single precision
    short = SeriesNoise(before, 1)
    short.add(after)
    assert short.covariance(np.array([3, 4])) == pytest.approx(noise.covariance(np.array([3, 4])))
    refuses(ValueError, "apart", short.covariance, order)
    refuses(ValueError, "positions of 3 spots", noise.add, parts(4))
