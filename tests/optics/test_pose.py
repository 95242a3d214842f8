import numpy as np
import pytest

from optics.geometry.pose import Pose, rotation_matrix


def some_pose(seed: int) -> Pose:
    rng = np.random.default_rng(seed)
    return Pose(rotation_matrix(rng.normal(size=3)), rng.normal(size=3))


def test_apply_turns_then_shifts() -> None:
    pose = Pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([10.0, 20, 30]))
    np.testing.assert_array_equal(pose.apply([[1.0, 0, 0], [0, 1, 0]]), [[10, 21, 30], [9, 20, 30]])


def test_composition_and_inverse() -> None:
    a, b = some_pose(1), some_pose(2)
    points = np.random.default_rng(3).normal(size=(4, 5, 3))
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-14)
    np.testing.assert_allclose(a.inverse().apply(a.apply(points)), points, atol=1e-14)


@pytest.mark.parametrize(
    ("rotation", "translation"),
    [
        (np.eye(3) * 1.001, np.zeros(3)),
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3)),
        (np.eye(2), np.zeros(3)),
        (np.eye(3), np.zeros(2)),
        (np.full((3, 3), np.nan), np.zeros(3)),
    ],
)
def test_what_is_no_rigid_pose_is_refused(rotation: np.ndarray, translation: np.ndarray) -> None:
    with pytest.raises(ValueError, match="pose"):
        Pose(rotation, translation)


def test_it_keeps_its_own_copy() -> None:
    translation = np.zeros(3)
    pose = Pose(np.eye(3), translation)
    translation[0] = 1.0
    assert pose.translation[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        pose.translation[0] = 1.0
