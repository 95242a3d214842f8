import numpy as np

from optics.geometry.pose import Pose


def test_apply_turns_then_shifts() -> None:
    pose = Pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([10.0, 20, 30]))
    np.testing.assert_array_equal(pose.apply([[1.0, 0, 0], [0, 1, 0]]), [[10, 21, 30], [9, 20, 30]])


def test_arrays_are_copied() -> None:
    translation = np.zeros(3)
    pose = Pose(np.eye(3), translation)
    translation[0] = 1.0
    assert pose.translation[0] == 0.0
