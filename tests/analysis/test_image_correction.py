"""Corrections of an image's model by control points: known ones come back, within covariances that are true."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from analysis.orbit.image_correction import ImageCorrection, image_correction
from tests.analysis.refusals import refuses

SIZE = np.array([12_000.0, 20_000.0])
TRUE = {
    "shift": lambda place: np.tile([2.5, -7.25], (len(place), 1)),
    "affine": lambda place: np.array([2.5, -7.25]) + place @ np.array([[1e-4, -3e-5], [2e-5, 4e-4]]),
}
DRAWS = 200


def points(count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Places, and covariances of all shapes."""
    random = np.random.default_rng(seed)
    root = random.normal(0.0, 0.4, (count, 2, 2)) + 0.3 * np.eye(2)
    return random.uniform(0.0, SIZE, (count, 2)), root @ np.swapaxes(root, 1, 2)


def drawn(kind: str, place: np.ndarray, spread: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal((len(place), 2, 1))
    return place + TRUE[kind](place) + (np.linalg.cholesky(spread) @ noise)[..., 0]


@pytest.mark.parametrize("kind", ["shift", "affine"])
def test_two_hundred_draws_keep_to_their_covariances(kind: str) -> None:
    """Errors of the estimate at four corners, and what is left, have the chi-square of their freedoms.

    Bounds have a false alarm of 1e-4 in all. Nothing is screened: screening cuts the tails by what it should.
    """
    place, spread = points(14)
    corner = np.array([[0.0, 0.0], [SIZE[0], 0.0], [0.0, SIZE[1]], SIZE])
    error, left, freedom, each = 0.0, 0.0, 0, []
    own = {"shift": 2, "affine": 6}[kind]
    for seed in range(DRAWS):
        found = image_correction(place, drawn(kind, place, spread, seed), spread, kind, screened=False)
        away = found.at(*place.T) - TRUE[kind](place)
        # the errors at three places that are no line determine those of the coefficients
        rows = away[: own // 2].ravel()
        known = _joint(found, place[: own // 2])
        error += float(rows @ np.linalg.solve(known, rows))
        left += found.chi_square
        freedom += found.freedom
        each.append(np.einsum("ni,nij,nj->n", found.residual, np.linalg.inv(found.variance), found.residual))
        single = found.covariance_at(*corner.T)
        off = found.at(*corner.T) - TRUE[kind](corner)
        assert np.einsum("ni,nij,nj->n", off, np.linalg.inv(single), off).max() < chi2.isf(1e-8, 2)
    # residuals of one point over all draws are independent, each with the covariance that is told
    assert chi2.ppf(1e-5, 2 * DRAWS) < np.sum(each, axis=0).min()
    assert np.sum(each, axis=0).max() < chi2.isf(1e-5, 2 * DRAWS)
    assert freedom == DRAWS * (2 * len(place) - own)
    for value, count in ((error, DRAWS * own), (left, freedom)):
        assert chi2.ppf(2.5e-5, count) < value < chi2.isf(2.5e-5, count)


def _joint(found: ImageCorrection, place: np.ndarray) -> np.ndarray:
    """Covariance of the corrections at several places together, by finite differences of the coefficients."""
    start = found.at(*place.T).ravel()
    columns = []
    for k in range(found.coefficients.size):
        moved = found.coefficients.copy().ravel()
        moved[k] += 1.0
        columns.append(replace(found, coefficients=moved.reshape(2, -1)).at(*place.T).ravel() - start)
    slope = np.stack(columns, axis=1)
    return slope @ found.covariance @ slope.T


def test_wrong_covariances_are_told() -> None:
    """Sigmas three times too small: chi-square is nine times its freedom, and its probability nothing."""
    place, spread = points(30)
    found = image_correction(place, drawn("affine", place, spread, 3), spread / 9.0, "affine", screened=False)
    assert found.factor == pytest.approx(9.0, rel=0.6)  # 54 degrees of freedom: 3 sigma of chi-square
    assert found.probability < 1e-6


@pytest.mark.parametrize("kind", ["shift", "affine"])
def test_gross_errors_are_left_out_and_named(kind: str) -> None:
    place, spread = points(40, 4)
    spread = np.tile(0.09 * np.eye(2), (40, 1, 1))
    seen = drawn(kind, place, spread, 5)
    wrong = [3, 11, 27, 39]
    seen[wrong] += [[6.0, 0.0], [-9.0, 4.0], [0.0, 30.0], [5.0, -5.0]]
    found = image_correction(place, seen, spread, kind)
    assert np.flatnonzero(~found.used).tolist() == wrong
    clean = np.delete(np.arange(40), wrong)
    alone = image_correction(place[clean], seen[clean], spread[clean], kind)
    np.testing.assert_allclose(found.at(*place.T), alone.at(*place.T), rtol=0, atol=1e-9)
    assert found.freedom == alone.freedom


def test_points_without_gross_errors_stay() -> None:
    """In 200 files a false alarm of 1e-3 leaves out a point of one in the mean; of more than six once in 10 000."""
    place, spread = points(20, 6)
    out = sum(
        bool(np.any(~image_correction(place, drawn("affine", place, spread, seed), spread, "affine").used))
        for seed in range(DRAWS)
    )
    assert out <= 6


def test_one_point_and_three() -> None:
    place, spread = points(3, 8)
    one = image_correction(place[:1], place[:1] + np.array([1.5, -2.0]), spread[:1], "shift")
    np.testing.assert_allclose(one.at(0.0, 0.0), [[1.5, -2.0]], rtol=0, atol=1e-12)
    np.testing.assert_allclose(one.covariance, spread[0], rtol=1e-12)
    assert (one.freedom, one.factor, one.probability) == (0, 1.0, 1.0)
    three = image_correction(place, place + TRUE["affine"](place), spread, "affine")
    np.testing.assert_allclose(three.residual, 0.0, atol=1e-9)


def test_what_points_do_not_determine() -> None:
    place, spread = points(8)
    for count, kind, message in ((0, "shift", "do not determine"), (2, "affine", "3 or more")):
        refuses(ValueError, message, image_correction, place[:count], place[:count], spread[:count], kind)
    line = np.stack([np.linspace(0.0, 1e4, 8), np.linspace(5.0, 2e4, 8)], axis=-1)
    refuses(ValueError, "one line", image_correction, line, line, spread, "affine")
    refuses(ValueError, "not finite", image_correction, place, np.where(place > 1e4, np.nan, place), spread, "shift")
    refuses(ValueError, "not above zero", image_correction, place, place, np.zeros((8, 2, 2)), "shift")
