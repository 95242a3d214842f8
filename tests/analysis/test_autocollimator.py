"""Readings of an autocollimator, the relations of the principle experiment, the arithmetic of the printed table."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from analysis.monitor.autocollimator import (
    ReadingMap,
    column_component,
    exact_reading,
    mirror_rotation,
    reading_of_normal,
    relation_factor,
)
from tests.analysis.refusals import refuses

ARCSEC = math.pi / 648000


def test_equation_1() -> None:
    angle = np.array([-1e-3, 0.0, 3e-3])
    assert_allclose(mirror_rotation(0.5 * np.tan(2 * angle), 0.5), angle, rtol=1e-14, atol=1e-18)


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
def test_exact_turns_by_another_way(axis: str) -> None:
    # the normal turned by matrices in frame 1 and then seen from frame 2, against the closed form
    from scipy.spatial.transform import Rotation

    between, angle = math.radians(40), 0.02
    frame = Rotation.from_euler("x", between).as_matrix()
    turned = Rotation.from_euler(axis.lower(), angle).as_matrix() @ (-frame[:, 2])
    assert_allclose(exact_reading(axis, angle, 2, between), reading_of_normal(frame.T @ turned), rtol=1e-13, atol=1e-16)


@pytest.mark.parametrize(("axis", "unit"), [("x", 1), ("X", 3), ("", 2)])
def test_unknown_names(axis: str, unit: int) -> None:
    refuses(ValueError, "axis must be X, Y or Z and unit 1 or 2", relation_factor, axis, unit, 0.5)
    if axis != "X":
        refuses(ValueError, "axis must be X, Y or Z", column_component, axis)


def test_a_reading_map_recovers_a_distorting_lens() -> None:
    def spot(reading: np.ndarray) -> np.ndarray:
        place = 290_000 * np.tan(2 * reading)[..., ::-1]
        return 1600 + place * (1 + 3e-11 * np.sum(place**2, axis=-1, keepdims=True)) + [3.0, -40.0]

    rng = np.random.default_rng(5)
    turns = np.linspace(-5e-3, 5e-3, 9)
    known = np.stack(np.meshgrid(turns, turns), -1).reshape(-1, 2)
    reading_map = ReadingMap.fit(spot(known), known)
    fresh = rng.uniform(-5e-3, 5e-3, (50, 2))
    assert_allclose(reading_map(spot(fresh)), fresh, atol=1e-4 * ARCSEC)
    assert reading_map.residual < 1e-4 * ARCSEC
    # eq. (1) alone is off by the distortion, so the map is needed
    plain = mirror_rotation(spot(fresh)[..., ::-1] - [1560.0, 1603.0], 290_000)
    assert np.max(np.abs(plain - fresh)) > 0.1 * ARCSEC
    # covariance: a scatter of spots comes out as a scatter of readings
    where = spot(fresh[0])
    scatter = reading_map(where + 0.02 * rng.standard_normal((20_000, 2)))
    wanted = reading_map.covariance(where, 0.02**2 * np.eye(2))
    assert_allclose(np.cov(scatter.T), wanted, atol=0.05 * wanted.max())


def test_a_reading_map_needs_enough_spots() -> None:
    with pytest.raises(ValueError, match="do not settle a polynomial of degree 5"):
        ReadingMap.fit(np.random.default_rng(0).uniform(0, 9, (20, 2)), np.zeros((20, 2)))
    refuses(ValueError, r"must both be \(P, 2\)", ReadingMap.fit, np.zeros((30, 2)), np.zeros((30, 3)))
