"""Correlation of residuals within a window, relief in it, and what both do to the covariance of a fitted place."""

import numpy as np
import pytest
from scipy import linalg, stats

from analysis.matching.window_checks import LAG, WindowRelief, residual_correlation, window_relief

SIDE = 15
LAGS = [(r, c) for r in range(LAG + 1) for c in range(-LAG, LAG + 1) if r > 0 or c > 0]


def designs(rng, count):
    """Two derivatives of a smooth texture, gain and offset: (count, 4, SIDE^2)."""
    row, column = np.mgrid[:SIDE, :SIDE] / SIDE
    found = []
    for _ in range(count):
        waves = rng.uniform(1, 4, (3, 2)) * np.sign(rng.standard_normal((3, 2)))
        phase = rng.uniform(0, 2 * np.pi, 3)
        angle = 2 * np.pi * (waves[:, 0, None, None] * row + waves[:, 1, None, None] * column) + phase[:, None, None]
        by_row, by_column = (np.sum(waves[:, k, None, None] * np.cos(angle), axis=0) for k in (0, 1))
        found.append([by_row, by_column, np.sum(np.sin(angle), axis=0), np.ones((SIDE, SIDE))])
    return np.array(found).reshape(count, 4, -1)


def fitted(design, noise):
    """Places (n, 2) and residuals (n, p) of least squares fits to noise (n, p)."""
    normal = design @ np.swapaxes(design, 1, 2)
    value = np.linalg.solve(normal, design @ noise[..., None])[..., 0]
    return value[:, :2], noise - np.einsum("nq,nqp->np", value, design)


def noisy(rng, count, kernel):
    """White noise (n, p) smoothed by a kernel, of unit variance."""
    size = len(kernel)
    white = rng.standard_normal((count, SIDE + size - 1, SIDE + size - 1))
    found = sum(
        kernel[r, c] * white[:, r : r + SIDE, c : c + SIDE] for r in range(size) for c in range(size)
    ) / np.linalg.norm(kernel)
    return found.reshape(count, -1)


def dense(design):
    """Of one design (q, p): reply of the place to the pixels (2, p) and projection on what the fit takes (p, p)."""
    solved = np.linalg.solve(design @ design.T, design)
    return solved[:2], design.T @ solved


# pixels alike within 2 x 2, and alternating ones, which a place averages out
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_covariance_is_the_sum_over_all_pairs_of_pixels(sign):
    """B C B' with a dense C of the residuals' correlation at each lag; no direction below half of the white one."""
    rng = np.random.default_rng(6)
    design = designs(rng, 3)
    _, residual = fitted(design, noisy(rng, 3, np.array([[1.0, sign], [sign, 1.0]])))
    found = residual_correlation(design, residual, SIDE)
    row, column = np.divmod(np.arange(SIDE**2), SIDE)
    least = []
    for k in range(3):
        place, taken = dense(design[k])
        variance = residual[k] @ residual[k] / (SIDE**2 - 4)
        matrix = np.eye(SIDE**2)
        for number, (r, c) in enumerate(LAGS):
            pairs = (row - row[:, None] == r) & (column - column[:, None] == c)
            # what the fit leaves of white noise has the covariance 1 - taken
            value = np.mean((np.outer(residual[k], residual[k]) / variance + taken)[pairs])
            assert found.correlation[k, number] == pytest.approx(value, abs=1e-12)
            matrix[pairs | pairs.T] = value
        expected, white = place @ matrix @ place.T, place @ place.T
        assert found.plain[k] == pytest.approx(variance * white, rel=1e-9)
        share, axes = linalg.eigh(expected, white)
        back = np.linalg.inv(axes)
        expected = variance * back.T @ np.diag(np.maximum(share, 0.5)) @ back
        assert found.covariance(np.arange(3) == k)[k] == pytest.approx(expected, rel=1e-9)
        least.append(share.min())
    assert (min(least) > 0.5) == (sign > 0)


def test_the_score_of_relief_is_that_of_a_dense_covariance():
    """Moments of q = r'Z K Z'r and what the fit makes of the field, with pixels, slopes and blocks written out."""
    rng = np.random.default_rng(7)
    design = designs(rng, 2)
    _, residual = fitted(design, rng.standard_normal((2, SIDE**2)))
    found = window_relief(design, residual, SIDE)
    blocks = [(r, c) for r in range(5) for c in range(5)]
    # of 3 x 3 px each, from the window's middle, along each axis; the last one is the window's middle itself
    centre = 3.0 * np.array([*blocks, (2, 2)]) - 6.0
    a = np.sqrt(3.0) * np.linalg.norm(centre[:, None] - centre, axis=2) / SIDE
    matern = (1.0 + a) * np.exp(-a)
    row, column = np.divmod(np.arange(SIDE**2), SIDE)
    inside = np.array([(row // 3 == r) & (column // 3 == c) for r, c in blocks])
    for k in range(2):
        place, taken = dense(design[k])
        z = np.hstack([design[k, axis][:, None] * inside.T for axis in range(2)])
        field = linalg.block_diag(matern[:-1, :-1], matern[:-1, :-1])
        g = z.T @ (np.eye(SIDE**2) - taken) @ z
        assert found.score[k] == pytest.approx(residual[k] @ z @ field @ z.T @ residual[k], rel=1e-9)
        assert found.first[k] == pytest.approx(np.trace(field @ g), rel=1e-9)
        assert found.second[k] == pytest.approx(np.trace(field @ g @ field @ g), rel=1e-9)
        assert found.redundancy[k] == SIDE**2 - 4
        # displacement of the middle less what the fit makes of that of all blocks; every column: an axis, then a block
        form = np.zeros((2, 2, len(centre)))
        form[:, :, :-1] = -(place @ z).reshape(2, 2, -1)
        form[[0, 1], [0, 1], -1] = 1.0
        assert found.effect[k] == pytest.approx(np.einsum("iab,bc,jac->ij", form, matern, form), abs=1e-9)


def expected_score(square, noise=1.0, coloured=1.0, second=50.0):
    """Windows (n,) whose scores and residual variances are what relief of tau^2 = square (n,) and noise make of them on
    the average, and the standard deviation of tau^2 where there is no relief.
    """
    square, second = np.broadcast_arrays(np.asarray(square, float), second)
    first, redundancy = 40.0 + 0.0 * square, 200.0
    score = noise * coloured * first + square * second
    variance = noise + square * first / redundancy  # relief is in the residuals, too
    relief = WindowRelief(score, first, second, redundancy + 0.0 * square, np.zeros((len(square), 2, 2)))
    # of a quadratic form in white noise: twice the trace of the squared matrix
    error = variance * coloured * np.sqrt(2.0 * second) / (second - coloured * first**2 / redundancy)
    return relief, variance, coloured + 0.0 * square, error


def shared(seen, error, good=True):
    """Mean of what relief may be, by windows that say little: normal by precision, cut off at zero; and its sigma."""
    weight = np.where(good, error**-2.0, 0.0)
    mean, sigma = weight @ seen / weight.sum(), weight.sum() ** -0.5
    return stats.truncnorm.mean(-mean / sigma, np.inf, loc=mean, scale=sigma), sigma


def test_relief_of_each_window_comes_back_where_noise_is_low():
    square = np.array([0.1, 0.4, 0.9, 1.6])
    for coloured in (1.0, 1.5):
        relief, variance, colour, _ = expected_score(square, 1e-6, coloured, second=1e5)
        tau, usual = relief.square(variance, colour, np.ones(4, bool))
        assert tau == pytest.approx(square, rel=1e-9)
        assert usual == pytest.approx(0.65, rel=1e-9)  # the median


@pytest.mark.parametrize("coloured", [1.0, 1.1])
def test_windows_that_say_little_share_the_mean_of_what_relief_may_be(coloured):
    """The mean of a half-normal distribution where nothing is seen."""
    none, some = np.zeros(9), np.array([0.3, -0.2, 0.8, 0.0, 0.1, 0.5, 0.0, -0.1, 0.4])
    second = np.linspace(20.0, 60.0, 9)
    for square in (none, some):
        relief, variance, colour, error = expected_score(square, 2.0, coloured, second)
        for good in (np.ones(9, bool), np.arange(9) < 6):
            # no relief within the accuracy is seen where noise takes it all
            assert np.all(square < 2.5 * error)
            expected, sigma = shared(square, error, good)
            tau, usual = relief.square(variance, colour, good)
            assert [*tau, usual] == pytest.approx([expected] * 10, rel=1e-9)
            if square is none:
                assert usual == pytest.approx(sigma * np.sqrt(2.0 / np.pi), rel=1e-9)


def test_a_window_that_stands_out_has_its_own_relief_and_counts_a_little():
    """Four standard deviations from none, it keeps its own; in the common mean it counts 2.5 of them."""
    for size, alone in ((3.5, False), (5.0, True)):
        square = np.zeros(9)
        plain = expected_score(square)[3][4]
        # its relief is in its own residuals' variance and so in the standard deviation: solved by a few turns
        for _ in range(60):
            square[4] = size * expected_score(square)[3][4]
        relief, variance, colour, error = expected_score(square)
        assert plain < error[4]
        assert square[4] == pytest.approx(size * error[4], rel=1e-9)
        expected, _ = shared(np.where(np.arange(9) == 4, 2.5 * error, 0.0), error)
        tau, usual = relief.square(variance, colour, np.ones(9, bool))
        assert tau == pytest.approx(np.where((np.arange(9) == 4) & alone, square[4], expected), rel=1e-9)
        assert usual == pytest.approx(expected, rel=1e-9)


def test_windows_without_a_score_take_what_the_others_share():
    relief, variance, colour, _ = expected_score(np.full(5, 0.2))
    all_of, usual = relief.square(variance, colour, np.ones(5, bool))
    # no fit, and a window whose residuals are zero
    for array, value in ((relief.score, np.nan), (variance, np.nan), (variance, 0.0)):
        whole = array[2]
        array[2] = value
        tau, _ = relief.square(variance, colour, np.ones(5, bool))
        array[2] = whole
        # four share what five did: the mean of a normal cut off at zero rises with its standard deviation
        assert tau[2] == tau[0] > all_of[0]
    # colour so strong that the residuals' variance says more than the score, or no good window: nothing is known
    for strong, good in ((100.0, np.ones(5, bool)), (1.0, np.zeros(5, bool))):
        tau, nothing = relief.square(variance, strong * colour, good)
        assert not np.any([*tau, nothing])
    assert usual >= 0.2
