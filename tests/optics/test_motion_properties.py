"""Laws that rotations, poses, motions of the tree and glass bodies keep, whatever the numbers."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from optics.geometry.pose import Pose, rotation_matrix, rotation_vector
from optics.geometry.tree import Body, Motion, RigidTree, compose

ROUNDING = 1e-14
"""Some ten roundings of numbers near 1."""


def vectors(most: float) -> st.SearchStrategy[np.ndarray]:
    return st.tuples(*[st.floats(-most, most)] * 3).map(np.array)


@st.composite
def poses(draw, far: float = 2.0) -> Pose:
    return Pose(rotation_matrix(draw(vectors(1.8))), draw(vectors(far)))


@st.composite
def motions(draw, pivot: str = "corner") -> Motion:
    rotate, shift = draw(vectors(0.5)), draw(vectors(0.3))
    return Motion(tuple(rotate.tolist()), tuple(shift.tolist()), pivot, draw(st.floats(-0.05, 0.05)))


def undone(motion: Motion) -> Motion:
    """The motion about the same pivot that takes it back: y -> p + R' (y - p - s) / g."""
    growth = 1.0 + motion.scale
    shift = -rotation_matrix(np.array(motion.rotate)).T @ np.array(motion.shift) / growth
    back = tuple((-np.array(motion.rotate)).tolist())
    return Motion(back, tuple(shift.tolist()), motion.pivot, 1.0 / growth - 1.0)


TREE = RigidTree(
    (
        Body("a", Pose(rotation_matrix([0.1, 0.4, -0.2]), np.array([1.0, 2.0, 3.0])), {"corner": (0.0, 0.2, -0.1)}),
        Body("a/b", Pose(rotation_matrix([-0.3, 0.0, 0.5]), np.array([0.5, 0.0, 0.1])), {"corner": (0.3, 0.1, 0.2)}),
    )
)


@given(vectors(1.0), st.floats(-1.5, 1.5), st.floats(-1.5, 1.5))
def test_turns_about_one_axis_add(axis, first, second) -> None:
    together = rotation_matrix(first * axis) @ rotation_matrix(second * axis)
    np.testing.assert_allclose(together, rotation_matrix((first + second) * axis), atol=ROUNDING)
    np.testing.assert_allclose(rotation_matrix(axis) @ rotation_matrix(-axis), np.eye(3), atol=ROUNDING)
    # |vector| < 1.8, so that the angle's sine tells it to some roundings
    np.testing.assert_allclose(rotation_vector(rotation_matrix(axis)), axis, atol=ROUNDING)


@given(poses(), poses(), poses())
def test_poses_are_a_group_and_keep_distances(a, b, c) -> None:
    points = np.array([[0.3, -0.7, 1.1], [2.0, 0.1, -0.4]])
    left, right = (a @ b) @ c, a @ (b @ c)
    np.testing.assert_allclose(left.apply(points), right.apply(points), atol=4 * ROUNDING)
    np.testing.assert_allclose((a @ a.inverse()).apply(points), points, atol=ROUNDING)
    np.testing.assert_allclose(
        (a @ b).inverse().apply(points), (b.inverse() @ a.inverse()).apply(points), atol=4 * ROUNDING
    )
    moved = a.apply(points)
    assert abs(np.linalg.norm(moved[1] - moved[0]) - np.linalg.norm(points[1] - points[0])) < ROUNDING


@given(motions(), motions())
def test_a_motion_and_its_inverse_leave_everything_where_it_was(first, second) -> None:
    """In either order, of a body and of what it carries."""
    nominal = TREE.place()
    bodies = {body.path: body for body in TREE.bodies}
    for one, other in ((first, undone(first)), (undone(first), first)):
        state = compose({"a": one, "a/b": second}, {"a": other, "a/b": undone(second)}, bodies)
        placed = TREE.place([state])
        np.testing.assert_allclose(placed.rotation, nominal.rotation, atol=ROUNDING)
        np.testing.assert_allclose(placed.translation, nominal.translation, atol=4 * ROUNDING)
        np.testing.assert_allclose(placed.scale, nominal.scale, atol=ROUNDING)
