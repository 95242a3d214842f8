"""Pupils found by their light; terms fitted over any of it.

Eight orientations and two signs: of maps, of coefficients, and found by measured ones or named as not tellable.
"""

import math

import numpy as np
import pytest

from analysis.arrays import UndeterminedError
from analysis.wavefront_maps.map_files import MapError, WavefrontMap
from analysis.wavefront_maps.pupil_fit import (
    ORIENTATIONS,
    SIGNED_ORIENTATIONS,
    Orientation,
    Pupil,
    find_pupil,
    fit_wavefront_map,
    orientation_evidence,
)
from analysis.wavefront_maps.zernike_table import circle_terms
from tests.analysis.refusals import refuses
from tests.tiers import quick


def map_of(values: np.ndarray) -> WavefrontMap:
    return WavefrontMap(values, math.nan, None, None)


def disk(size: int, x: float, y: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    return (columns - x) / radius, (rows - y) / radius


LIGHT = {
    "disk": lambda x, y: np.hypot(x, y) <= 1.0,
    "ring": lambda x, y: np.abs(np.hypot(x, y) - 0.675) <= 0.325,
    "spiders": lambda x, y: (np.abs(np.hypot(x, y) - 0.675) <= 0.325) & (np.abs(x) > 0.04) & (np.abs(y) > 0.04),
    "cut": lambda x, y: (np.hypot(x, y) <= 1.0) & (y < 0.5) & (x > -0.8),
    "dropouts": lambda x, y: (np.hypot(x, y) <= 1.0) & (np.random.default_rng(2).random(x.shape) > 0.05),
    "specks": lambda x, y: (np.hypot(x, y) <= 1.0) | (np.hypot(x - 1.08, y - 1.05) < 0.04),
    "beyond the camera": lambda x, y: np.hypot(x, y) <= 1.0,
}


@pytest.mark.second
@pytest.mark.parametrize("light", quick(3, LIGHT))
def test_the_pupil_is_found_by_its_light(light):
    """To a tenth of a pixel where a radius has a hundred: half a pixel in the edge's steps, of which there are many."""
    rng = np.random.default_rng(5)
    for _ in range(3):
        at_x, at_y, radius = rng.uniform(115, 130), rng.uniform(115, 130), rng.uniform(85, 105)
        x, y = disk(250, at_x, at_y, radius)
        lit = LIGHT[light](x, y)
        # where the map ends in the light there is no edge
        first = int(at_x - 0.8 * radius) if light == "beyond the camera" else 0
        last = int(at_x + 0.9 * radius) if light == "beyond the camera" else 250
        found = find_pupil(np.where(lit, 0.0, np.nan)[:, first:last])
        np.testing.assert_allclose([found.x + first, found.y, found.radius], [at_x, at_y, radius], rtol=0, atol=0.12)


def test_light_without_a_round_edge_needs_a_stated_pupil():
    values = np.full((60, 60), np.nan)
    refuses(UndeterminedError, "no measured pixel", find_pupil, values)
    values[10:50, 10:30] = 0.0
    refuses(UndeterminedError, "specify them in pixels", find_pupil, values)
    with pytest.raises(UndeterminedError, match="specify them in pixels"):
        find_pupil(np.zeros((20, 20)))  # steps at the end of a map are no edge
    refuses(MapError, "radii are positive", Pupil, 1.0, 2.0, 0.0)


@pytest.mark.second
@pytest.mark.parametrize("light", ["disk", "ring", "spiders", "cut"])
def test_coefficients_come_back_exactly(light):
    x, y = disk(90, 44.3, 45.1, 40.0)
    lit = LIGHT[light](x, y)
    terms = tuple(range(1, 29))
    truth = np.random.default_rng(1).normal(size=28) * 1e-7
    values = np.full(x.shape, np.nan)
    values[lit] = circle_terms(terms, x[lit], y[lit]) @ truth
    found = fit_wavefront_map(values, terms, Pupil(44.3, 45.1, 40.0))
    np.testing.assert_allclose(found.coefficients, truth, rtol=0, atol=1e-19)
    # parts are shares of the rms over the light
    assert np.sum(found.parts[1:] ** 2) == pytest.approx(np.var(values[lit]), rel=1e-12)


def test_terms_that_the_light_does_not_tell_apart():
    x, y = disk(100, 50.0, 50.0, 45.0)
    values = np.where((np.abs(y) < 1e-9) & (np.abs(x) <= 1.0), 0.0, np.nan)
    with pytest.raises(UndeterminedError, match="Z3 cannot be separated from the terms before it"):
        fit_wavefront_map(values, range(1, 5), Pupil(50.0, 50.0, 45.0))
    with pytest.raises(UndeterminedError, match="0 measured pixels lie within the pupil"):
        fit_wavefront_map(values, range(1, 5), Pupil(500.0, 50.0, 45.0))
    refuses(MapError, "ascending order", fit_wavefront_map, values, [1, 4, 2], Pupil(50.0, 50.0, 45.0))


# --- wavefront maps orientation ---------------------------------------------------------------------------------------

TERMS = tuple(range(1, 37))


def map_by(coefficients: np.ndarray, rows: int = 41, columns: int = 41) -> WavefrontMap:
    y, x = np.meshgrid((np.arange(rows) - 20.0) / 20.0, (np.arange(columns) - 20.0) / 20.0, indexing="ij")
    lit = x**2 + y**2 <= 1.0
    values = np.full((rows, columns), np.nan)
    values[lit] = circle_terms(TERMS, x[lit], y[lit]) @ coefficients
    return WavefrontMap(values, 1e-3, 6e-7, "wavefront")


def test_there_are_eight_and_sixteen():
    assert len({one.matrix.tobytes() for one in ORIENTATIONS}) == len(ORIENTATIONS) == 8
    assert len(set(SIGNED_ORIENTATIONS)) == len({str(one) for one in SIGNED_ORIENTATIONS}) == 16
    assert [Orientation.named(one.name, one.sign) for one in SIGNED_ORIENTATIONS] == list(SIGNED_ORIENTATIONS)
    refuses(MapError, "turned 270", Orientation.named, "turned 45")
    refuses(ValueError, "quarter_turns must be 0 to 3", Orientation, quarter_turns=4)


@pytest.mark.parametrize(
    ("name", "point"),
    [("turned 90", (-2, 1)), ("turned 180", (-1, -2)), ("turned 270", (2, -1)), ("mirrored x", (-1, 2)),
     ("mirrored y", (1, -2)), ("mirrored diagonal", (2, 1)), ("mirrored antidiagonal", (-2, -1))],
)  # fmt: skip
def test_what_the_names_mean(name, point):
    assert tuple(Orientation.named(name).matrix @ (1, 2)) == point


@pytest.mark.parametrize("reading", SIGNED_ORIENTATIONS, ids=str)
def test_maps_and_coefficients_turn_alike(reading):
    coefficients = np.random.default_rng(0).normal(size=36)
    before = map_by(coefficients)
    after = reading.apply(before)
    assert (after.spacing, after.what) == (before.spacing, before.what)
    row, column = 26, 33
    x, y = reading.matrix @ (column - 20, row - 20)
    assert after.values[y + 20, x + 20] == reading.sign * before.values[row, column]
    y, x = (np.argwhere(after.illuminated).T - 20.0) / 20.0
    found, *_ = np.linalg.lstsq(circle_terms(TERMS, x, y), after.values[after.illuminated], rcond=None)
    np.testing.assert_allclose(found, reading.coefficients(coefficients, TERMS), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(reading.inverse.apply(after).values, before.values)
    turning = reading.term_matrix(TERMS)
    np.testing.assert_array_equal(turning @ turning.T, np.eye(36))


def test_a_map_that_is_no_square_turns_into_another():
    values = np.arange(12.0).reshape(3, 4)
    turned = Orientation.named("turned 90").values(values)
    assert turned.shape == (4, 3)
    # the lowest right corner comes to the highest right one
    assert turned[3, 2] == values[0, 3]


def test_terms_without_their_partners():
    assert Orientation.named("turned 180").term_matrix([4, 7]).tolist() == [[1, 0], [0, -1]]
    refuses(MapError, "Z7 rotates into a term that was not fitted", Orientation.named("turned 90").term_matrix, [4, 7])


FIELDS, USED = 5, tuple(range(4, 12))


def camera(noise: float, coma: float, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Predicted coefficients of five fields, (F, Z), with coma in one direction, and their covariance."""
    rng = np.random.default_rng(seed)
    expected = rng.normal(size=(FIELDS, len(USED))) * 20e-9
    expected[:, USED.index(7)] += coma
    unknown = rng.normal(size=(FIELDS * len(USED), 6)) * 10e-9
    return expected, unknown @ unknown.T + noise**2 * np.eye(FIELDS * len(USED))


@pytest.mark.parametrize("truth", SIGNED_ORIENTATIONS, ids=str)
def test_the_reading_of_half_a_micron_of_coma_is_found(truth):
    expected, covariance = camera(5e-9, 0.5e-6)
    rng = np.random.default_rng(SIGNED_ORIENTATIONS.index(truth))
    right = expected + rng.multivariate_normal(np.zeros(expected.size), covariance).reshape(expected.shape)
    # what the file holds: the reading is what turns it back
    measured = right.reshape(FIELDS, -1) @ truth.term_matrix(USED)
    found = orientation_evidence(measured, expected, covariance, USED)
    assert found.determined == truth
    assert found.allowed[0] == truth
    assert found.readings[0] == truth
    assert found.degrees == FIELDS * len(USED)
    np.testing.assert_allclose(np.diff(found.log_evidence), -0.5 * np.diff(found.chi_square), rtol=1e-9)


def test_readings_that_look_alike_are_named_together():
    """Coma along x alone: what mirrors y changes nothing."""
    expected = np.zeros((1, len(USED)))
    expected[0, USED.index(8)] = 0.5e-6
    found = orientation_evidence(expected, expected, (5e-9) ** 2 * np.eye(len(USED)), USED)
    assert found.determined is None
    # an inverted coma along x is one that is mirrored in x
    assert {str(one) for one in found.indistinguishable} == {
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
        ORIENTATIONS[0] not in orientation_evidence(one, expected, covariance, USED, false_alarm=0.1).allowed
        for one in draws
    )
    # 400 draws of a chance of 0.1: three binomial sigmas
    assert 40 - 18 <= rejected <= 40 + 18


def test_no_reading_is_allowed_of_another_camera():
    expected, covariance = camera(5e-9, 0.5e-6)
    other, _ = camera(5e-9, -0.9e-6, seed=4)
    found = orientation_evidence(other * 3.0, expected, covariance, USED)
    assert found.allowed == ()
    assert found.determined is None


def test_a_covariance_that_is_none():
    expected, covariance = camera(5e-9, 0.5e-6)
    refuses(UndeterminedError, "add the noise", orientation_evidence, expected, expected, 0.0 * covariance, USED)
    refuses(UndeterminedError, "not finite", orientation_evidence, expected * np.nan, expected, covariance, USED)
