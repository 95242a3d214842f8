"""Rotations, poses, and bodies that carry each other, and the laws that they keep, whatever the numbers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from optics.geometry.pose import Pose, about_axis, rotation_matrix, rotation_vector
from optics.geometry.tree import Body, Motion, RigidTree, compose

PIVOT = (0.0, 0.2, -0.1)


@pytest.fixture
def tree() -> RigidTree:
    return RigidTree(
        (
            Body("a", Pose(about_axis(1, 0.4), np.array([1.0, 2.0, 3.0])), {"corner": PIVOT}),
            Body("a/b", Pose(about_axis(0, -0.3), np.array([0.5, 0.0, 0.1]))),
            Body("a/plate", Pose(np.eye(3), np.array([0.0, 0.0, 0.7])), scales=False),
            Body("a/plate/chip", Pose(np.eye(3), np.array([0.01, 0.02, 0.0]))),
            Body("c"),
        )
    )


def test_the_pivot_stays_in_place(tree: RigidTree) -> None:
    placed = tree.place([{}, {"a": Motion(rotate=(0.1, -0.2, 0.3), scale=0.01, pivot="corner")}])
    before, after = (placed.pose("a", s) for s in (0, 1))
    scaled = placed.scale[1, placed.index["a"]]
    assert scaled == 1.01
    np.testing.assert_allclose(after.apply(scaled * np.array(PIVOT)), before.apply(PIVOT), atol=1e-15)


def test_motion_is_in_the_bodys_own_frame_rotation_then_shift(tree: RigidTree) -> None:
    motion = Motion(rotate=(0.0, 0.0, np.pi / 2), shift=(1e-3, 0.0, 0.0))
    pose = tree.place([{"a": motion}]).pose("a")
    nominal = tree["a"].pose
    np.testing.assert_allclose(pose.apply([1.0, 0, 0]), nominal.apply([1e-3, 1.0, 0.0]), atol=1e-15)


def test_children_ride_along(tree: RigidTree) -> None:
    motion = Motion(rotate=(0.01, 0.02, 0.03), shift=(0.1, 0.2, 0.3), pivot="corner")
    placed = tree.place([{"a": motion}])
    carried = placed.pose("a") @ tree["a/b"].pose
    np.testing.assert_allclose(placed.pose("a/b").translation, carried.translation, atol=1e-15)
    assert placed.pose("c") == Pose()


def test_scale_grows_distances_but_not_a_rigid_inside(tree: RigidTree) -> None:
    placed = tree.place([{}, {"a": Motion(scale=0.1)}])
    root = placed.translation[1, placed.index["a"]]

    def distance(path: str, state: int) -> float:
        return float(np.linalg.norm(placed.translation[state, placed.index[path]] - root))

    assert distance("a/b", 1) == pytest.approx(1.1 * distance("a/b", 0), rel=1e-15)
    assert distance("a/plate", 1) == pytest.approx(0.77, rel=1e-15)
    chip = placed.translation[:, placed.index["a/plate/chip"]] - placed.translation[:, placed.index["a/plate"]]
    np.testing.assert_allclose(chip[1], chip[0], atol=1e-15)
    assert placed.scale[1, placed.index["a/b"]] == 1.1
    assert placed.scale[1, placed.index["a/plate/chip"]] == 1.0


def test_bad_trees_and_states_are_refused(tree: RigidTree) -> None:
    with pytest.raises(KeyError, match="nobody"):
        tree.place([{"nobody": Motion()}])
    with pytest.raises(KeyError, match="a: pivot 'nowhere'"):
        tree.place([{"a": Motion(pivot="nowhere")}])
    with pytest.raises(ValueError, match="bend"):
        tree.place([{}], [("a", "bend", 0)])


def test_numbers_of_a_motion_by_name() -> None:
    motion = Motion(rotate=(1.0, 2.0, 3.0), shift=(4.0, 5.0, 6.0), scale=7.0, figure={8: 9.0})
    found = [motion.component(*which) for which in (("rotate", 1), ("shift", 2), ("scale", 0), ("figure", 8))]
    assert found == [2.0, 6.0, 7.0, 9.0]
    assert motion.component("figure", 5) == 0.0
    with pytest.raises(ValueError, match="not a 'expansion'"):
        motion.component("expansion", 0)


def test_a_tree_stands_by_itself_as_another_does_in_a_state() -> None:
    """Also under states on top of it; what cannot be a place of a body is refused."""
    bodies = (
        Body("a", Pose(about_axis(1, 0.3), np.array([0.1, 0.2, 0.3]))),
        Body("a/b", Pose(about_axis(0, -0.2), np.array([0.0, 0.5, 0.1])), pivots={"far": (0.2, -0.1, 0.4)}),
        Body("a/b/c", Pose(about_axis(2, 0.1), np.array([0.3, 0.0, 0.0]))),
    )
    tree = RigidTree(bodies)
    first = {
        "a": Motion((0.01, -0.02, 0.03), (0.001, 0.002, -0.003)),
        "a/b": Motion((0.02, 0.01, 0.0), (0.0, 0.004, 0.0), "far"),
    }
    then = {
        "a/b": Motion((0.0, 0.03, -0.01), (0.002, 0.0, 0.001), "far", scale=0.01),
        "a/b/c": Motion(shift=(0.1, 0.0, 0.0)),
    }
    standing, paths = tree.with_nominal(first), {body.path: body for body in bodies}
    for there, here in ((first, {}), (compose(first, then, paths), then)):
        expected, found = tree.place([there]), standing.place([here])
        np.testing.assert_allclose(found.rotation, expected.rotation, rtol=0.0, atol=1e-15)
        np.testing.assert_allclose(found.translation, expected.translation, rtol=0.0, atol=1e-15)
        np.testing.assert_allclose(found.scale, expected.scale, rtol=1e-15)
    for state, error in (
        ({"a/d": Motion()}, KeyError),
        ({"a": Motion(pivot="far")}, KeyError),
        ({"a": Motion(scale=1e-6)}, ValueError),
        ({"a": Motion(expansion=1e-6)}, ValueError),
    ):
        with pytest.raises(error):
            tree.with_nominal(state)


def test_a_pose_turns_then_shifts() -> None:
    pose = Pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([10.0, 20, 30]))
    np.testing.assert_array_equal(pose.apply([[1.0, 0, 0], [0, 1, 0]]), [[10, 21, 30], [9, 20, 30]])


def test_arrays_of_a_pose_are_copied() -> None:
    translation = np.zeros(3)
    pose = Pose(np.eye(3), translation)
    translation[0] = 1.0
    assert pose.translation[0] == 0.0


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


@pytest.mark.second
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


@pytest.mark.second
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
