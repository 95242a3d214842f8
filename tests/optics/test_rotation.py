import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from optics.geometry.pose import about_axis, rotation_matrix, rotation_vector


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_positive_by_the_right_hand_rule(axis: int) -> None:
    first, second = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
    np.testing.assert_allclose(about_axis(axis, np.pi / 2) @ first, second, atol=1e-15)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-6, 0.49, 0.51, 2.0, 3.1])
def test_matches_scipy(size: float) -> None:
    vectors = np.random.default_rng(1).normal(size=(20, 3))
    vectors *= size / np.linalg.norm(vectors, axis=-1, keepdims=True)
    matrix = rotation_matrix(vectors)
    np.testing.assert_allclose(matrix, Rotation.from_rotvec(vectors).as_matrix(), atol=5e-16, rtol=0)
    np.testing.assert_allclose(
        matrix @ np.swapaxes(matrix, -1, -2), np.broadcast_to(np.eye(3), matrix.shape), atol=1e-15
    )
    np.testing.assert_allclose(rotation_vector(matrix), vectors, atol=3e-15 / max(np.pi - size, 1e-3))


def test_complex_step_is_the_derivative() -> None:
    vector, direction = np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.7, -0.4])
    exact = rotation_matrix(vector + 1e-40j * direction).imag / 1e-40
    h = 1e-6
    difference = (rotation_matrix(vector + h * direction) - rotation_matrix(vector - h * direction)) / (2 * h)
    np.testing.assert_allclose(exact, difference, atol=1e-10)
