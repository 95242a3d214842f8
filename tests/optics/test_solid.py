"""Glass bodies from faces and from half-spaces: closed, with volumes and outlines in closed form."""

from itertools import combinations

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from optics.geometry import solid as solids
from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.tree import Body, Motion, RigidTree
from tests.tiers import quick

ROUNDING = 1e-12
"""Relative: some hundred roundings of sizes near 1 m."""


def axes(normal) -> np.ndarray:
    z = np.asarray(normal, float) / np.linalg.norm(normal)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def solid_of(*planes, path: str = "glass") -> solids.Solid:
    """Faces (normal, point) on the solid's own body."""
    faces = (
        solids.Face(f"face{k}", path, solids.Coating.TRANSMITTING, Pose(axes(n), np.array(p, float)))
        for k, (n, p) in enumerate(planes)
    )
    return solids.Solid(path, "N-BK7", tuple(faces))


def alone(pose: Pose | None = None):
    return RigidTree((Body("glass", pose or Pose()),)).place()


BOX = [
    ((1, 0, 0), (0.2, 0, 0)),
    ((-1, 0, 0), (-0.1, 0, 0)),
    ((0, 1, 0), (0, 0.05, 0)),
    ((0, -1, 0), (0, -0.05, 0)),
    ((0, 0, 1), (0, 0, 0.04)),
    ((0, 0, -1), (0, 0, 0)),
]
CORNER = [((-1, 0, 0), (0, 0, 0)), ((0, -1, 0), (0, 0, 0)), ((0, 0, -1), (0, 0, 0)), ((1, 2, 3), (0.6, 0, 0))]


BODIES = {
    "box": (BOX, 0.3 * 0.1 * 0.04, 8, [4] * 6),
    "corner": (CORNER, 0.6 * 0.3 * 0.2 / 6.0, 4, [3] * 4),
    "chamfered": ([*BOX, ((1, 1, 0), (0.2, 0.01, 0))], (0.03 - 0.04**2 / 2.0) * 0.04, 10, [4, 4, 4, 4, 5, 5, 4]),
}


@pytest.mark.parametrize("name", BODIES)
def test_volume_and_outline(name: str) -> None:
    planes, volume, corners, edges = BODIES[name]
    pose = Pose(rotation_matrix(np.array([0.4, -1.1, 2.0])), np.array([1.0, -2.0, 3.0]))
    solid = solid_of(*planes)
    made = solids.solid_mesh(solid, alone(pose))
    assert made.mesh.is_watertight
    assert made.mesh.volume == pytest.approx(volume, rel=ROUNDING * 1e3)  # offsets of a body 4 m away lose three digits
    assert len(made.mesh.vertices) == corners
    assert made.mesh.euler_number == 2
    assert [len(polygon) for polygon in made.polygons] == edges
    for face, polygon in zip(solid.faces, made.polygons, strict=True):
        normal = face.pose.rotation[:, 2]
        assert np.abs((polygon - face.pose.translation) @ normal).max() < 1e-13
        turn = np.cross(polygon - polygon[0], np.roll(polygon, -1, axis=0) - polygon[0]).sum(axis=0)
        assert turn @ normal > 0.0  # counterclockwise from outside
    for triangle, normal in zip(made.face_of, made.mesh.face_normals, strict=True):
        assert normal @ solid.faces[triangle].pose.rotation[:, 2] == pytest.approx(1.0, abs=ROUNDING)


def test_a_turned_face_makes_a_wedge() -> None:
    """A face on a body of its own: its angle error changes the volume by area * mean displacement, here none to first
    order, and the corners as the turned plane says.
    """
    angle = 0.01
    base = solid_of(*BOX)
    faces = (*base.faces[:4], solids.Face("top", "glass/top", solids.Coating.TOTAL), base.faces[5])
    solid = solids.Solid("glass", "N-BK7", faces)
    tree = RigidTree((Body("glass"), Body("glass/top", Pose(np.eye(3), np.array([0.05, 0.0, 0.04])))))
    placed = tree.place([{"glass/top": Motion(rotate=(0.0, angle, 0.0))}])
    made = solids.solid_mesh(solid, placed)
    top = made.polygons[4]
    assert top[:, 2] == pytest.approx(0.04 - np.tan(angle) * (top[:, 0] - 0.05), abs=ROUNDING)
    assert made.mesh.volume == pytest.approx(0.3 * 0.1 * 0.04, rel=1e-9)  # it turns about the middle of the face
    point, normal = solids.face_plane(faces[4], placed)
    assert point == pytest.approx([0.05, 0.0, 0.04], abs=ROUNDING)
    assert normal == pytest.approx([np.sin(angle), 0.0, np.cos(angle)], abs=ROUNDING)


def test_a_grown_body_grows_its_own_faces() -> None:
    tree = RigidTree((Body("glass", Pose(np.eye(3), np.array([1.0, 0.0, 0.0]))),))
    states = [{"glass": motion} for motion in (Motion(), Motion(scale=0.01), Motion(expansion=0.01))]
    volumes = np.array([solids.solid_mesh(solid_of(*BOX), tree.place([state])).mesh.volume for state in states])
    np.testing.assert_allclose(volumes[1:] / volumes[0], 1.01**3, rtol=1e-9)


@pytest.mark.parametrize(
    ("planes", "words"),
    [
        (BOX[:5], "open"),
        (BOX[:2], "open"),
        (BOX[1:5], "open|do not enclose"),
        ([*BOX[:4], ((0, 0, 1), (0, 0, -0.01)), BOX[5]], "enclose no volume"),
        ([*BOX[:4], ((0, 0, 1), (0, 0, 1e-10)), BOX[5]], "enclose no volume"),
        ([*BOX, ((1, 0, 1), (0.5, 0, 0.5))], "'face6' is cut off"),
    ],
    ids=["no bottom", "two parallel faces", "a corner only", "inside out", "thinner than a nanometre", "face beyond"],
)
def test_what_is_no_body(planes, words) -> None:
    with pytest.raises(solids.SolidError, match=words) as caught:
        solids.solid_mesh(solid_of(*planes), alone())
    assert str(caught.value).startswith("glass: ")


HEIGHTS = 1e-15
"""Of heights over a plane: corners of bodies of a metre, in doubles."""

CUBE = (np.concatenate([np.eye(3), -np.eye(3)]), np.full(6, 0.5))


def unit(vectors) -> np.ndarray:
    vectors = np.asarray(vectors, float)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def mesh_of(body: solids.Polyhedron) -> trimesh.Trimesh:
    fans = [(ring[0], ring[i], ring[i + 1]) for ring in body.rings for i in range(1, len(ring) - 1)]
    return trimesh.Trimesh(body.vertices, fans, process=False)


def checked(normals: np.ndarray, offsets: np.ndarray) -> tuple[solids.Polyhedron, float]:
    """The body after a check of all that holds for every body, and its volume."""
    body = solids.half_space_intersection(normals, offsets)
    mesh = mesh_of(body)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.euler_number == 2
    heights = body.vertices @ normals.T - offsets
    assert heights.max() < 3.0 * HEIGHTS  # every corner that is left is one of the exact body
    for k, ring in enumerate(body.rings):
        assert len(set(ring)) == len(ring) != 1
        # where an edge went, one end has moved by its length; hardly ever several in a row
        assert np.all(heights[list(ring), k] > -3.0 * solids.MERGE_LENGTH)
    return body, float(mesh.volume)


def volume_by_triples(normals: np.ndarray, offsets: np.ndarray) -> float:
    """Hull of all points where three planes meet in front of no other one.

    Planes within a few 1e-12 of each other do not meet in a definite point; leaving those out changes the volume as
    little.
    """
    corners = []
    for three in combinations(range(len(offsets)), 3):
        matrix = normals[list(three)]
        if abs(np.linalg.det(matrix)) > 1e-12:
            corner = np.linalg.solve(matrix, offsets[list(three)])
            if np.all(normals @ corner - offsets < 1e-9):
                corners.append(corner)
    return float(ConvexHull(np.array(corners), qhull_options="QJ").volume)


def random_planes(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A cube cut by random planes, some of them almost or exactly through one point, some in pairs that nearly or
    exactly coincide, from 1e-17 up to a millimetre.
    """
    normals, offsets = [*CUBE[0]], [*CUBE[1]]
    small = lambda: 10.0 ** rng.uniform(-17.0, -3.0) * (rng.random() < 0.8)  # noqa: E731
    meeting = rng.uniform(-0.2, 0.2, 3)
    for _ in range(rng.integers(1, 7)):
        normal = unit(rng.normal(size=3))
        offset = rng.uniform(0.05, 0.6)
        if rng.random() < 0.5:
            normal = normal if normal @ meeting > 0.0 else -normal
            offset = normal @ meeting + small()
        normals.append(normal)
        offsets.append(offset)
        for _ in range(rng.integers(0, 3)):
            normals.append(unit(normal + small() * rng.normal(size=3)))
            offsets.append(offset + small() * rng.normal())
    return np.array(normals), np.array(offsets)


def random_bodies(count: int, seed: int) -> int:
    """Check that many random bodies; how many of them were bodies."""
    rng, bodies = np.random.default_rng(seed), 0
    for _ in range(count):
        normals, offsets = random_planes(rng)
        try:
            body, volume = checked(normals, offsets)
        except solids.EmptyBodyError:
            with pytest.raises(solids.EmptyBodyError):
                solids.half_space_intersection(normals[::-1], offsets[::-1])
            continue
        bodies += 1
        # edges of that length were taken out, on a body of that much surface
        slack = solids.MERGE_LENGTH * mesh_of(body).area
        assert volume == pytest.approx(volume_by_triples(normals, offsets), abs=slack)
        order = rng.permutation(len(offsets))
        assert checked(normals[order], offsets[order])[1] == pytest.approx(volume, abs=slack)
        turn = rotation_matrix(rng.normal(size=3))
        assert checked(normals @ turn.T, offsets)[1] == pytest.approx(volume, abs=slack)
    return bodies


@pytest.mark.second
def test_random_bodies() -> None:
    assert random_bodies(60, 1) > 40


@pytest.mark.parametrize("size", quick(3, [0.0, 1e-12, 1.1e-7, 1e-17, 1e-15, 3e-10, 1e-9, 7e-9, 2e-8, 4e-6, 1e-3]))
def test_planes_that_nearly_meet_in_a_point(size) -> None:
    """A pyramid whose four sides miss their apex by that much: V = (2a)^2 h / 3 and at most that much of skin."""
    rng = np.random.default_rng(7)
    half, height = 0.12, 0.06
    sides = unit([(height, 0, half), (-height, 0, half), (0, height, half), (0, -height, half)])
    for _ in range(20):
        normals = np.concatenate([unit(sides + size * rng.normal(size=(4, 3))), [[0, 0, -1.0]]])
        offsets = np.array([*size * rng.uniform(-1.0, 1.0, 4), height])
        body, volume = checked(normals, offsets)
        area = (2 * half) ** 2 + 4 * half * np.hypot(half, height)
        assert volume == pytest.approx((2 * half) ** 2 * height / 3.0, abs=(3.0 * size + solids.MERGE_LENGTH) * area)
        assert all(body.rings)
        if size < 0.1 * solids.MERGE_LENGTH:
            assert len(body.vertices) == 5  # one apex


@pytest.mark.parametrize("width", [1e-12, 0.5e-7, 2e-7, 1e-5, 0.3])
def test_a_chamfer_that_shrinks_to_nothing(width) -> None:
    """V = 1 - t^2 / 2 for edges cut by t; narrower than what counts, the face is none and the cube is whole."""
    normals = np.concatenate([CUBE[0], unit([[1, 1, 0]])])
    body, volume = checked(normals, np.append(CUBE[1], (1.0 - width) / np.sqrt(2.0)))
    assert volume == pytest.approx(
        1.0 - 0.5 * width**2, abs=2.0 * solids.MERGE_LENGTH if width < solids.MERGE_LENGTH else 1e-14
    )
    assert len(body.rings[6]) == (0 if width * np.sqrt(2.0) < solids.MERGE_LENGTH else 4)
    assert len(body.vertices) == (8 if width * np.sqrt(2.0) < solids.MERGE_LENGTH else 10)


def test_planes_that_cut_nothing_leave_no_face() -> None:
    """One that is given twice, one that only touches a corner, one beyond."""
    normals = np.concatenate([CUBE[0], [[1.0, 0, 0]], unit([[1, 1, 1]]), unit([[1, 1, 1]])])
    body, volume = checked(normals, np.array([*CUBE[1], 0.5, 1.5 / np.sqrt(3.0) + 1e-15, 3.0]))
    assert [len(ring) for ring in body.rings] == [4] * 6 + [0] * 3
    assert volume == pytest.approx(1.0, abs=1e-15)


def test_corners_are_exact() -> None:
    """Not the rounding of a solver: 1/3 is the double nearest to it."""
    normals = np.array([[1.0, 0, 0], [-3, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    body = solids.half_space_intersection(normals, np.array([1.0, 1.0, 1, 0, 1, 0]))
    assert body.vertices[:, 0].min() == -1.0 / 3.0


@pytest.mark.parametrize(
    ("normals", "offsets", "error"),
    [
        (CUBE[0][:5], CUBE[1][:5], solids.OpenBodyError),
        (CUBE[0], np.full(6, 2.0 * solids.MAX_EXTENT), solids.OpenBodyError),
        (unit([[-1, 0, 0], [1e-3, 1, 0], [1e-3, -1, 0], [0, 0, 1], [0, 0, -1]]), np.full(5, 0.5), solids.OpenBodyError),
        (CUBE[0], np.array([0.5, 0.5, 0.5, 0.5, 0.5, -0.5]), solids.EmptyBodyError),
        (CUBE[0], np.array([0.5, 0.5, 0.5, 0.5, 0.5, -0.5 + 0.9 * solids.MERGE_LENGTH]), solids.EmptyBodyError),
        (CUBE[0], np.array([0.5, 0.5, 0.5, 0.5, 0.5, -0.6]), solids.EmptyBodyError),
    ],
    ids=["five", "too large", "a wedge far too long", "flat", "thin", "inside out"],
)
def test_half_spaces_that_hold_no_body(normals, offsets, error) -> None:
    with pytest.raises(error):
        solids.half_space_intersection(normals, offsets)
