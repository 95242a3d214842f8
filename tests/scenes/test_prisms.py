"""The monitor's prisms: what they do to a beam whatever their attitude, and what errors of their angles do.

The three mirrors of the 180-deg prism reflect space at its apex, M = R3 R2 R1 = -1; with errors of their angles M is
-(1 + [W]), see ``prism_errors``. A ray square to the window returns turned by -n W x d: refraction magnifies small
angles by n.
"""

from dataclasses import replace

import numpy as np
import pytest

from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.solid import solid_mesh
from optics.geometry.tree import Motion, RigidTree
from optics.raytrace.assembly import Assembly
from optics.raytrace.reflectors import EDGE, Mount, prism_0, prism_180, roof_offset
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from tests.scenes.prism_errors import seen_outside, turn_by_mirrors

N = 1.4565
WIDTH, LENGTH, SHIFT = 0.06, 0.8, 0.1
ARCSEC = np.pi / 648000.0
TURNS = [(10.0, 0.0, 0.0), (0.0, 10.0, 0.0), (0.0, 0.0, 10.0), (2000.0, -1500.0, 3000.0), (-900.0, 2500.0, -4000.0)]
"""Arcseconds, up to somewhat more than a degree."""
UP = np.array([0.0, 0.0, 1.0])


def parts_180(hand: float = 1.0, errors=None):
    return prism_180(Mount("glass", Pose(), "p", "fused silica", LENGTH, WIDTH, hand, errors or {}))


def parts_0(errors=None):
    return prism_0(Mount("glass", Pose(), "p", "fused silica", SHIFT, WIDTH, errors=errors or {}))


def assembled(parts) -> Assembly:
    elements = {e.name: replace(e, aperture=None) for e in parts.elements}
    return Assembly(RigidTree(parts.bodies), elements, {"all": tuple(elements)}, {"glass": N})


def send(backend, parts, position, direction, state=None):
    """World position, direction (N, 3), path, validity (N,) of rays after the last face."""
    systems = assemble(assembled(parts), ["all"], [state or {}])
    traced = trace(backend, systems, make_rays(backend, np.array(position), np.array(direction)), world=True)
    return tuple(a[0] for a in traced.numpy(traced.world))


def beam(middle, count: int = 12, radius: float = 0.5 * WIDTH) -> np.ndarray:
    """Starting points over a beam's cross-section, in the plane z = -0.2 of the prism."""
    angle = 2.0 * np.pi * np.arange(count) / count
    ring = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)
    return np.array([middle[0], middle[1], -0.2]) + np.concatenate([np.zeros((1, 3)), radius * ring])


def entry(hand: float = 1.0) -> tuple[float, float]:
    return -0.5 * LENGTH, hand * roof_offset(WIDTH)


def turned(vector, pivot: str = "apex") -> dict[str, Motion]:
    return {"glass": Motion(rotate=tuple(ARCSEC * np.array(vector)), pivot=pivot)}


@pytest.mark.parametrize("hand", [1.0, -1.0])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), *TURNS])
@pytest.mark.parametrize("slant", [(0.0, 0.0), (0.004, -0.007)])
def test_corner_cube(backend, hand, turn, slant) -> None:
    """Antiparallel; entry and exit lines are point reflections of each other; one optical path for the whole beam.

    With A the apex, z_A deep behind the window, i and j the angles outside and inside the glass to the window's normal
    w and e the direction across it in which the ray leans, both lines have the point

        A - z_A (w + tan(j) e)

    halfway between them, and from a plane square to the beam through a point P and back to it the optical path is

        2 (A - P) . d + 2 z_A (n cos j - cos i).
    """
    made = parts_180(hand)
    into = np.array([*slant, 1.0]) / np.linalg.norm([*slant, 1.0])
    start = beam(entry(hand), radius=0.4 * WIDTH)
    start = start - ((start - start[0]) @ into)[:, None] * into  # a plane wave
    position, direction, path, valid = send(backend, made, start, np.broadcast_to(into, start.shape), turned(turn))
    assert valid.all()
    assert np.abs(direction + into).max() < 1e-14
    apex = np.array(made.apex)
    w = rotation_matrix(ARCSEC * np.array(turn)) @ UP  # the window's inward normal
    across = into - (into @ w) * w
    cos_i, cos_j = into @ w, np.sqrt(1.0 - across @ across / N**2)
    null = apex - apex[2] * (w + across / (N * cos_j))
    # the line that leaves goes through 2 null - start
    miss = np.cross(position - (2.0 * null - start), into)
    assert np.abs(miss).max() < 3e-15  # lengths near 1 m
    back = path + (position - start[0]) @ into  # on to the plane of the start
    want = 2.0 * (apex - start[0]) @ into + 2.0 * apex[2] * (N * cos_j - cos_i)
    assert back == pytest.approx(want, rel=2e-15)
    assert made.path_length == pytest.approx(2.0 * apex[2], rel=1e-15)


def first_order_180(hand: float, errors: dict[str, np.ndarray]) -> np.ndarray:
    """Change of the direction that leaves for a beam along +z, from turns of the faces in the prism's frame, (3,)."""
    s = np.sqrt(0.5)
    normals = [(-s, 0.0, s), (0.5, hand * s, 0.5), (0.5, -hand * s, 0.5)]
    whole = turn_by_mirrors(normals, [errors.get(face, np.zeros(3)) for face in FACES_180])
    return -N * np.cross(whole, UP)


FACES_180 = ("mirror", "roof_a", "roof_b")


def frames(parts) -> dict[str, np.ndarray]:
    return {body.path.rpartition("/")[2]: body.pose.rotation for body in parts.bodies}


@pytest.mark.parametrize("hand", [1.0, -1.0])
@pytest.mark.parametrize("face", FACES_180)
@pytest.mark.parametrize("axis", [0, 1])
def test_angle_errors_of_the_180_deg_prism(backend, hand, face, axis) -> None:
    """First order as derived above; what is left is of second order in the error, at most 10 of its squares, and the
    same for an error as made and for a motion of the face.
    """
    nominal = parts_180(hand)
    start, into = beam(entry(hand), 4), np.broadcast_to(UP, (5, 3))
    left = []
    for eps in (1e-3, 5e-4):
        tilt = eps * np.eye(3)[axis]
        made = send(backend, parts_180(hand, {face: tuple(tilt[:2])}), start, into)
        moved = send(backend, nominal, start, into, {f"glass/{face}": Motion(rotate=tuple(tilt))})
        assert made[3].all()
        assert np.abs(made[1] - moved[1]).max() < 1e-15
        first = first_order_180(hand, {face: frames(nominal)[face] @ tilt})
        left.append(made[1][0] + UP - first)
        assert np.abs(made[1] - made[1][0]).max() < 1e-14  # a plane wave stays one
    assert np.linalg.norm(left[0]) < 10.0 * 1e-3**2
    assert left[0] == pytest.approx(4.0 * left[1], abs=50.0 * 1e-3**3)  # and it is of second order
    turn = np.linalg.norm(first_order_180(hand, {face: frames(nominal)[face] @ np.eye(3)[axis]}))
    assert 0.3 * N < turn < 2.0 * N + 1e-12


@pytest.mark.parametrize("tilt", [(1e-3, 0.0), (0.0, 1e-3), (-0.01, 0.02)])
def test_a_tilted_window_does_nothing(backend, tilt) -> None:
    """Entering and leaving through one plane: the corner sends every direction back, and the window's part
    cancels exactly.
    """
    made = parts_180(errors={"window": tilt})
    _, direction, _, valid = send(backend, made, beam(entry()), np.broadcast_to(UP, (13, 3)))
    assert valid.all()
    assert np.abs(direction + UP).max() < 1e-14


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), *TURNS])
@pytest.mark.parametrize("slant", [(0.0, 0.0), (0.004, -0.007)])
def test_rhomboid(backend, turn, slant) -> None:
    """Direction kept; two parallel mirrors a distance h apart, and a plate of the glass's whole path.

    Unfolded, entry and exit are the faces of a plate as thick as the glass on the beam's way, t = width + 2 edges +
    shift; the mirrors then move everything by shift (x - w), with w the entry's inward normal.
    """
    made = parts_0()
    into = np.array([*slant, 1.0]) / np.linalg.norm([*slant, 1.0])
    start = beam((-0.5 * SHIFT, 0.0), radius=0.4 * WIDTH)
    start = start - ((start - start[0]) @ into)[:, None] * into
    rays = np.broadcast_to(into, start.shape)
    position, direction, path, valid = send(backend, made, start, rays, turned(turn, "origin"))
    assert valid.all()
    assert np.abs(direction - into).max() < 3e-15
    own = rotation_matrix(ARCSEC * np.array(turn))
    w, x = own @ UP, own @ np.array([1.0, 0.0, 0.0])
    across = into - (into @ w) * w
    cos_j = np.sqrt(1.0 - across @ across / N**2)
    thick = WIDTH + 2.0 * EDGE + SHIFT
    lean = across / (N * cos_j)
    aside = thick * (w + lean) + SHIFT * (x - w)
    straight = aside - (aside @ into) * into
    moved = position - start
    assert np.abs(moved - (moved @ into)[:, None] * into - straight).max() < 3e-15
    if not any(turn) and not any(slant):
        assert moved[:, :2] == pytest.approx(np.broadcast_to([SHIFT, 0.0], (13, 2)), abs=1e-16)
        assert made.path_length == pytest.approx(thick, rel=1e-15)
    glass = N * thick / cos_j
    gap = (position - start) @ into - aside @ into
    assert path - gap == pytest.approx(glass, rel=2e-15)


@pytest.mark.parametrize("face", ["entry", "mirror_a", "mirror_b", "exit"])
@pytest.mark.parametrize("axis", [0, 1])
def test_angle_errors_of_the_rhomboid(backend, face, axis) -> None:
    """A window turned by w is a thin wedge that turns the beam by (n - 1) w, with opposite signs at both ends; mirrors
    as in ``prism_errors``.
    """
    eps = 1e-3
    nominal = parts_0()
    tilt = frames(nominal)[face] @ np.eye(3)[axis]
    normal = np.sqrt(0.5) * np.array([-1.0, 0.0, 1.0])
    none = np.zeros(3)
    turn = {
        "entry": (N - 1.0) * tilt,
        "exit": (1.0 - N) * tilt,
        "mirror_a": seen_outside(turn_by_mirrors([normal, normal], [tilt, none]), UP, N),
        "mirror_b": seen_outside(turn_by_mirrors([normal, normal], [none, tilt]), UP, N),
    }[face]
    first = np.cross(turn, UP)
    left = []
    for size in (eps, 0.5 * eps):
        errors = {face: tuple(size * np.eye(2)[axis])}
        _, direction, _, valid = send(
            backend, parts_0(errors), beam((-0.5 * SHIFT, 0.0), 4), np.broadcast_to(UP, (5, 3))
        )
        assert valid.all()
        left.append(direction[0] - UP - size * first)
    assert np.linalg.norm(left[0]) < 10.0 * eps**2
    assert left[0] == pytest.approx(4.0 * left[1], abs=50.0 * eps**3)
    assert np.linalg.norm(first) > 0.4


@pytest.mark.parametrize("hand", [1.0, -1.0])
@pytest.mark.parametrize("width", [0.02, 0.06, 0.1])
def test_bodies(hand, width) -> None:
    """Closed solids with glass around their clear apertures: EDGE of it, and EDGE / sqrt(3) toward the roof's slanted
    edges. The rhomboid's volume is that of its box.
    """
    long = prism_180(Mount("glass", Pose(), "p", "fused silica", LENGTH, width, hand))
    small = prism_0(Mount("glass", Pose(), "p", "fused silica", SHIFT + width, width))
    for parts in (long, small):
        placed = RigidTree(parts.bodies).place()
        made = solid_mesh(parts.solids[0], placed)
        by_body = {face.body: polygon for face, polygon in zip(parts.solids[0].faces, made.polygons, strict=True)}
        for element in parts.elements:
            face = next(body for body in (element.body, element.body.rpartition("/")[0]) if body in by_body)
            pose = placed.pose(element.body)
            corners = pose.inverse().apply(by_body[face])
            assert np.abs(corners[:, 2]).max() < 1e-12
            rim = element.aperture.outline()
            edge = np.roll(corners[:, :2], -1, axis=0) - corners[:, :2]
            inward = np.stack([-edge[:, 1], edge[:, 0]], axis=-1) / np.linalg.norm(edge, axis=-1, keepdims=True)
            room = np.einsum("rek,ek->re", rim[:, None] - corners[:, :2], inward)
            assert room.min() > EDGE / np.sqrt(3.0) - 1e-9
    box = (SHIFT + width) * (width + 2.0 * EDGE) * (width + 2.0 * EDGE)
    placed = RigidTree(small.bodies).place()
    assert solid_mesh(small.solids[0], placed).mesh.volume == pytest.approx(box, rel=1e-9)
