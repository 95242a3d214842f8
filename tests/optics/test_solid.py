"""Glass bodies: volumes and outlines in closed form, and faces that do not make a body."""

import numpy as np
import pytest

from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.solid import Coating, Face, Solid, SolidError, face_plane, solid_mesh
from optics.geometry.tree import Body, Motion, RigidTree

ROUNDING = 1e-12
"""Relative: some hundred roundings of sizes near 1 m."""


def axes(normal) -> np.ndarray:
    z = np.asarray(normal, float) / np.linalg.norm(normal)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def solid_of(*planes, path: str = "glass") -> Solid:
    """Faces (normal, point) on the solid's own body."""
    faces = (
        Face(f"face{k}", path, Coating.TRANSMITTING, Pose(axes(n), np.array(p, float)))
        for k, (n, p) in enumerate(planes)
    )
    return Solid(path, "N-BK7", tuple(faces))


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


@pytest.mark.parametrize(
    ("planes", "volume", "corners", "edges"),
    [
        (BOX, 0.3 * 0.1 * 0.04, 8, [4] * 6),
        (CORNER, 0.6 * 0.3 * 0.2 / 6.0, 4, [3] * 4),
        ([*BOX, ((1, 1, 0), (0.2, 0.01, 0))], (0.3 * 0.1 - 0.04**2 / 2.0) * 0.04, 10, [4, 4, 4, 4, 5, 5, 4]),
    ],
    ids=["box", "corner", "chamfered box"],
)
def test_volume_and_outline(planes, volume, corners, edges) -> None:
    pose = Pose(rotation_matrix(np.array([0.4, -1.1, 2.0])), np.array([1.0, -2.0, 3.0]))
    solid = solid_of(*planes)
    made = solid_mesh(solid, alone(pose))
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
    faces = (*base.faces[:4], Face("top", "glass/top", Coating.TOTAL), base.faces[5])
    solid = Solid("glass", "N-BK7", faces)
    tree = RigidTree((Body("glass"), Body("glass/top", Pose(np.eye(3), np.array([0.05, 0.0, 0.04])))))
    placed = tree.place([{"glass/top": Motion(rotate=(0.0, angle, 0.0))}])
    made = solid_mesh(solid, placed)
    top = made.polygons[4]
    assert top[:, 2] == pytest.approx(0.04 - np.tan(angle) * (top[:, 0] - 0.05), abs=ROUNDING)
    assert made.mesh.volume == pytest.approx(0.3 * 0.1 * 0.04, rel=1e-9)  # it turns about the middle of the face
    point, normal = face_plane(faces[4], placed)
    assert point == pytest.approx([0.05, 0.0, 0.04], abs=ROUNDING)
    assert normal == pytest.approx([np.sin(angle), 0.0, np.cos(angle)], abs=ROUNDING)


def test_a_grown_body_grows_its_own_faces() -> None:
    tree = RigidTree((Body("glass", Pose(np.eye(3), np.array([1.0, 0.0, 0.0]))),))
    states = [{"glass": motion} for motion in (Motion(), Motion(scale=0.01), Motion(stretch=0.01))]
    volumes = np.array([solid_mesh(solid_of(*BOX), tree.place([state])).mesh.volume for state in states])
    np.testing.assert_allclose(volumes[1:] / volumes[0], 1.01**3, rtol=1e-9)


@pytest.mark.parametrize(
    ("planes", "words"),
    [
        (BOX[:5], "open"),
        (BOX[:2], "open"),
        (BOX[1:5], "open|do not enclose"),
        ([*BOX[:4], ((0, 0, 1), (0, 0, -0.01)), BOX[5]], "no room"),
        ([*BOX[:4], ((0, 0, 1), (0, 0, 1e-10)), BOX[5]], "no room"),
        ([*BOX, ((1, 0, 1), (0.5, 0, 0.5))], "'face6' is cut off"),
    ],
    ids=["no bottom", "two parallel faces", "a corner only", "inside out", "thinner than a nanometre", "face beyond"],
)
def test_what_is_no_body(planes, words) -> None:
    with pytest.raises(SolidError, match=words) as caught:
        solid_mesh(solid_of(*planes), alone())
    assert str(caught.value).startswith("glass: ")
