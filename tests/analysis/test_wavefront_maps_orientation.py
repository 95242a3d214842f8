"""Eight orientations and two signs: of maps, of coefficients, and found by measured ones or named as not tellable."""

import numpy as np
import pytest

from analysis.arrays import UndeterminedError
from analysis.wavefront_maps.map_files import MapError, WavefrontMap
from analysis.wavefront_maps.pupil_fit import ORIENTATIONS, READINGS, Orientation, tellable
from analysis.wavefront_maps.zernike_table import circle_terms
from tests.analysis.refusals import refuses

TERMS = tuple(range(1, 37))


def disk(coefficients: np.ndarray, rows: int = 41, columns: int = 41) -> WavefrontMap:
    y, x = np.meshgrid((np.arange(rows) - 20.0) / 20.0, (np.arange(columns) - 20.0) / 20.0, indexing="ij")
    lit = x**2 + y**2 <= 1.0
    values = np.full((rows, columns), np.nan)
    values[lit] = circle_terms(TERMS, x[lit], y[lit]) @ coefficients
    return WavefrontMap(values, 1e-3, 6e-7, "wavefront")


def test_there_are_eight_and_sixteen():
    assert len({one.matrix.tobytes() for one in ORIENTATIONS}) == len(ORIENTATIONS) == 8
    assert len(set(READINGS)) == len({str(one) for one in READINGS}) == 16
    assert [Orientation.named(one.name, one.sign) for one in READINGS] == list(READINGS)
    refuses(MapError, "turned 270", Orientation.named, "turned 45")
    refuses(ValueError, "quarter turns", Orientation, quarter_turns=4)


@pytest.mark.parametrize(
    ("name", "point"),
    [("turned 90", (-2, 1)), ("turned 180", (-1, -2)), ("turned 270", (2, -1)), ("mirrored x", (-1, 2)),
     ("mirrored y", (1, -2)), ("mirrored diagonal", (2, 1)), ("mirrored antidiagonal", (-2, -1))],
)  # fmt: skip
def test_what_the_names_mean(name, point):
    assert tuple(Orientation.named(name).matrix @ (1, 2)) == point


@pytest.mark.parametrize("reading", READINGS, ids=str)
def test_maps_and_coefficients_turn_alike(reading):
    coefficients = np.random.default_rng(0).normal(size=36)
    before = disk(coefficients)
    after = reading.apply(before)
    assert (after.spacing, after.what) == (before.spacing, before.what)
    row, column = 26, 33
    x, y = reading.matrix @ (column - 20, row - 20)
    assert after.values[y + 20, x + 20] == reading.sign * before.values[row, column]
    y, x = (np.argwhere(after.lit).T - 20.0) / 20.0
    found, *_ = np.linalg.lstsq(circle_terms(TERMS, x, y), after.values[after.lit], rcond=None)
    np.testing.assert_allclose(found, reading.coefficients(coefficients, TERMS), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(reading.inverse.apply(after).values, before.values)
    turning = reading.of_terms(TERMS)
    np.testing.assert_array_equal(turning @ turning.T, np.eye(36))


def test_a_map_that_is_no_square_turns_into_another():
    values = np.arange(12.0).reshape(3, 4)
    turned = Orientation.named("turned 90").values(values)
    assert turned.shape == (4, 3)
    # the lowest right corner comes to the highest right one
    assert turned[3, 2] == values[0, 3]


def test_terms_without_their_partners():
    assert Orientation.named("turned 180").of_terms([4, 7]).tolist() == [[1, 0], [0, -1]]
    refuses(MapError, "Z7 turns into a term that was not fitted", Orientation.named("turned 90").of_terms, [4, 7])


FIELDS, USED = 5, tuple(range(4, 12))


def camera(noise: float, coma: float, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Predicted coefficients of five fields, (F, Z), with coma in one direction, and their covariance."""
    rng = np.random.default_rng(seed)
    expected = rng.normal(size=(FIELDS, len(USED))) * 20e-9
    expected[:, USED.index(7)] += coma
    unknown = rng.normal(size=(FIELDS * len(USED), 6)) * 10e-9
    return expected, unknown @ unknown.T + noise**2 * np.eye(FIELDS * len(USED))


@pytest.mark.parametrize("truth", READINGS, ids=str)
def test_the_reading_of_half_a_micron_of_coma_is_found(truth):
    expected, covariance = camera(5e-9, 0.5e-6)
    rng = np.random.default_rng(READINGS.index(truth))
    right = expected + rng.multivariate_normal(np.zeros(expected.size), covariance).reshape(expected.shape)
    # what the file holds: the reading is what turns it back
    measured = right.reshape(FIELDS, -1) @ truth.of_terms(USED)
    found = tellable(measured, expected, covariance, USED)
    assert found.found == truth
    assert found.allowed[0] == truth
    assert found.readings[0] == truth
    assert found.degrees == FIELDS * len(USED)
    np.testing.assert_allclose(np.diff(found.log_evidence), -0.5 * np.diff(found.chi_square), rtol=1e-9)


def test_readings_that_look_alike_are_named_together():
    """Coma along x alone: what mirrors y changes nothing."""
    expected = np.zeros((1, len(USED)))
    expected[0, USED.index(8)] = 0.5e-6
    found = tellable(expected, expected, (5e-9) ** 2 * np.eye(len(USED)), USED)
    assert found.found is None
    # an inverted coma along x is one that is mirrored in x
    assert {str(one) for one in found.together} == {
        "as it is",
        "mirrored y",
        "turned 180, sign inverted",
        "mirrored x, sign inverted",
    }


@pytest.mark.second
def test_the_right_reading_is_rejected_as_often_as_stated():
    expected, covariance = camera(5e-9, 0.5e-6)
    rng = np.random.default_rng(8)
    draws = rng.multivariate_normal(expected.ravel(), covariance, 400).reshape(400, *expected.shape)
    rejected = sum(
        ORIENTATIONS[0] not in tellable(one, expected, covariance, USED, false_alarm=0.1).allowed for one in draws
    )
    # 400 draws of a chance of 0.1: three binomial sigmas
    assert 40 - 18 <= rejected <= 40 + 18


def test_no_reading_is_allowed_of_another_camera():
    expected, covariance = camera(5e-9, 0.5e-6)
    other, _ = camera(5e-9, -0.9e-6, seed=4)
    found = tellable(other * 3.0, expected, covariance, USED)
    assert found.allowed == ()
    assert found.found is None


def test_a_covariance_that_is_none():
    expected, covariance = camera(5e-9, 0.5e-6)
    refuses(UndeterminedError, "add the noise", tellable, expected, expected, 0.0 * covariance, USED)
    refuses(UndeterminedError, "not finite", tellable, expected * np.nan, expected, covariance, USED)
