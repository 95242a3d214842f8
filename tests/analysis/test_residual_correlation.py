"""Correlation of residuals within a window, and what it does to the covariance of a fitted place."""

import numpy as np
import pytest

from analysis.matching.window_relief import LAG, residual_correlation

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


# neighbours along one diagonal alike, along the other not
DIAGONAL = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def test_white_noise_has_no_correlation_after_the_fit_took_its_part():
    """Residuals of four unknowns on 225 pixels are correlated by some per cent; freed of that the mean of 3000 windows
    is zero to five of its standard deviations, one in 30 000 of 24 lags."""
    rng = np.random.default_rng(1)
    design = designs(rng, 3000)
    _, residual = fitted(design, rng.standard_normal((3000, SIDE**2)))
    found = residual_correlation(design, residual, SIDE)
    mean, spread = found.correlation.mean(axis=0), found.correlation.std(axis=0) / np.sqrt(3000)
    assert np.abs(mean / spread).max() < 5
    # what is taken out is seen: without it, or with the other sign, the nearest lags would be off by more than that
    image = residual.reshape(-1, SIDE, SIDE)
    raw = np.mean(image[:, :, 1:] * image[:, :, :-1], axis=(1, 2)) / found.variance
    assert abs(raw.mean()) > 6 * spread[LAGS.index((0, 1))]


def test_correlation_is_found_at_its_own_lag():
    """Two common pixels of three along the main diagonal: 2/3 at (1, 1), 1/3 at (2, 2), none elsewhere."""
    rng = np.random.default_rng(2)
    design = designs(rng, 2000)
    noise = noisy(rng, 2000, DIAGONAL)
    _, residual = fitted(design, noise)
    found = residual_correlation(design, residual, SIDE).correlation.mean(axis=0)
    for lag, value in zip(LAGS, found, strict=True):
        # the fit takes more out of noise that resembles the texture than out of white noise: some per cent
        assert value == pytest.approx({(1, 1): 2 / 3, (2, 2): 1 / 3}.get(lag, 0.0), abs=0.04), lag


def test_covariance_of_places_is_that_of_fits_to_correlated_noise():
    """One design and 6000 draws of noise, correlated along either diagonal. The fit takes more out of noise that
    resembles the texture than out of white noise, which alone is given back: the variances come out 15% too small.
    White covariances are wrong by a third to a half."""
    rng = np.random.default_rng(3)
    one = designs(rng, 1)
    for kernel in (DIAGONAL, DIAGONAL[::-1]):
        design = np.repeat(one, 6000, axis=0)
        place, residual = fitted(design, noisy(rng, 6000, kernel))
        found = residual_correlation(design, residual, SIDE)
        covariance = found.covariance(np.ones(6000, bool))
        scatter = np.einsum("ni,nj->ij", place, place) / len(place)
        mean = np.mean(covariance, axis=0)
        assert mean == pytest.approx(scatter, abs=0.2 * np.sqrt(scatter[0, 0] * scatter[1, 1]))
        white = np.mean(found.variance[:, None, None] * found.white, axis=0)
        assert np.abs(np.diag(white) / np.diag(scatter) - 1.0).max() > 0.3
