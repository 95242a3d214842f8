import numpy as np
import pytest

from optics.geometry.pose import Pose


def test_apply_turns_then_shifts() -> None:
    pose = Pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([10.0, 20, 30]))
    np.testing.assert_array_equal(pose.apply([[1.0, 0, 0], [0, 1, 0]]), [[10, 21, 30], [9, 20, 30]])


def test_what_is_no_rigid_pose_is_refused_and_arrays_are_copied() -> None:
    for rotation, translation in (
        (np.eye(3) * 1.001, np.zeros(3)),
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3)),
        (np.eye(2), np.zeros(3)),
        (np.eye(3), np.zeros(2)),
        (np.full((3, 3), np.nan), np.zeros(3)),
    ):
        with pytest.raises(ValueError, match="pose"):
            Pose(rotation, translation)
    translation = np.zeros(3)
    pose = Pose(np.eye(3), translation)
    translation[0] = 1.0
    assert pose.translation[0] == 0.0
