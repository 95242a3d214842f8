"""Readings of an autocollimator, the relations of the principle experiment, the arithmetic of the printed table."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from analysis.monitor.autocollimator import (
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
