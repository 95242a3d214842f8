"""Truth of a line camera from directions alone: no trace, an ideal camera with some distortion."""

import numpy as np
import pytest

from optics.geometry.pose import rotation_matrix
from optics.raytrace.first_order import LineChange, line_change

FOCAL_LENGTH, HALF = 5.5, 0.115
POSITION = np.linspace(-HALF, HALF, 41)
DEGREE = np.pi / 180.0


def looks(focal_length: float = FOCAL_LENGTH, distortion: float = 0.0) -> np.ndarray:
    """Directions of the line's points in the camera frame, (41, 3): a point at +L looks toward -tan W."""
    tangent = POSITION / focal_length
    tangent = tangent * (1.0 + distortion * tangent**2)
    return unit(np.stack([np.zeros_like(tangent), -tangent, np.ones_like(tangent)], axis=-1))


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def changes(*states: np.ndarray, distortion: float = 0.0) -> LineChange:
    return line_change(np.stack([looks(distortion=distortion), *states]), POSITION, np.eye(3))


@pytest.mark.parametrize("roll", [-60.0, -5.0, 0.01, 1.0, 20.0, 80.0])
@pytest.mark.parametrize("aside", [(0.0, 0.0), (0.02, -0.01)])
def test_a_turn_of_the_camera_leaves_the_principal_distance(roll: float, aside: tuple[float, float]) -> None:
    """The line may lie anyhow in the field: what is along it counts, with the share of x that its roll gives."""
    turn = rotation_matrix(np.array([*aside, 0.0])) @ rotation_matrix(np.array([0.0, 0.0, roll * DEGREE]))
    for distortion in (0.0, 3.0):
        change = changes(looks(distortion=distortion) @ turn.T, distortion=distortion)
        assert abs(change.d_f[0]) < 1e-12  # 41 terms of rounding over the sum of tan^2, times f
    if aside == (0.0, 0.0):
        assert change.d_gamma[0] == pytest.approx(roll * DEGREE, abs=1e-14)
        assert change.d_alpha[0] == pytest.approx(0.0, abs=1e-15)


def test_a_longer_camera_is_longer_however_it_is_turned() -> None:
    turn = rotation_matrix(np.array([0.0, 0.0, 30.0 * DEGREE]))
    longer = FOCAL_LENGTH + 1e-3
    change = changes(looks(longer), looks(longer) @ turn.T)
    np.testing.assert_allclose(change.d_f, 1e-3, rtol=1e-9)
    assert change.nominal_distance == pytest.approx(FOCAL_LENGTH, rel=1e-14)


def test_a_line_that_lies_askew_in_the_field() -> None:
    """Both components make its length, x and y with the signs of its roll."""
    across, along = 0.6, 0.8
    tangent = POSITION / FOCAL_LENGTH
    askew = unit(np.stack([across * tangent, -along * tangent, np.ones_like(tangent)], axis=-1))
    change = changes(askew)
    assert change.d_gamma[0] == pytest.approx(np.arctan2(across, along), abs=1e-14)
    assert change.principal_distance[0] == pytest.approx(FOCAL_LENGTH, rel=1e-14)
