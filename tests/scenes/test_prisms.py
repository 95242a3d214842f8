"""The monitor's prisms: what they do to a beam whatever their attitude, and what errors of their angles do.

The three mirrors of the 180-deg prism reflect space at its apex, M = R3 R2 R1 = -1; with errors of their angles M is
-(1 + [W]), see ``prism_errors``. A ray square to the window returns turned by -n W x d: refraction magnifies small
angles by n.
"""

import re
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.solid import Coating, solid_mesh
from optics.geometry.tree import Motion, RigidTree
from optics.geometry.zernike import basis
from optics.materials.material import material
from optics.raytrace import reflectors
from optics.raytrace.assembly import Assembly
from optics.thermal.heat import Temperature
from optics.thermal.thermo_elastic import free_linear_field
from scenes.models.obstruction import LEAST_GAP, blocked_rays, find_obstructions, find_overlaps, separation
from scenes.models.thermal_model import TemperatureError, ThermalModel
from scenes.specs.load import load_instrument
from tests.optics.bench import run
from tests.scenes import monitor_layouts
from tests.scenes.prism_errors import reflection, seen_outside, turn_by_mirrors

N = 1.4565
WIDTH, LENGTH, SHIFT = 0.06, 0.8, 0.1
ARCSEC = np.pi / 648000.0
TURNS = [(10.0, 0.0, 0.0), (0.0, 10.0, 0.0), (0.0, 0.0, 10.0), (2000.0, -1500.0, 3000.0), (-900.0, 2500.0, -4000.0)]
"""Arcseconds, up to somewhat more than a degree."""
UP = np.array([0.0, 0.0, 1.0])


def parts_180(hand: float = 1.0, errors=None):
    return reflectors.prism_180(
        reflectors.Mount("glass", Pose(), "p", "fused silica", LENGTH, WIDTH, hand, errors or {})
    )


def parts_0(errors=None):
    return reflectors.prism_0(reflectors.Mount("glass", Pose(), "p", "fused silica", SHIFT, WIDTH, errors=errors or {}))


def send(backend, parts, position, direction, state=None):
    """World position, direction (N, 3), path, validity (N,) of rays after the last face."""
    elements = {e.name: replace(e, aperture=None) for e in parts.elements}
    media = {e.solid: N for e in parts.elements if e.solid}
    assembly = Assembly(RigidTree(parts.bodies), elements, {"all": tuple(elements)}, media)
    return run(backend, assembly, np.array(position), np.array(direction), state)


def beam(middle, count: int = 12, radius: float = 0.5 * WIDTH, rings: int = 1) -> np.ndarray:
    """Starting points over a beam's cross-section, its middle first."""
    angle = 2.0 * np.pi * np.arange(count) / count
    ring = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)
    return middle + np.concatenate([np.zeros((1, 3)), *(radius * (k + 1) / rings * ring for k in range(rings))])


def plane_wave(start: np.ndarray, slant: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A beam's starting points moved into one wavefront that comes at a slant, and its direction."""
    into = np.array([*slant, 1.0]) / np.linalg.norm([*slant, 1.0])
    return start - ((start - start[0]) @ into)[:, None] * into, into


def entry(hand: float = 1.0) -> tuple[float, float, float]:
    """Where the beam of the 180-deg prism begins."""
    return -0.5 * LENGTH, hand * reflectors.roof_offset(WIDTH), -0.2


def turned(vector, pivot: str = "apex") -> dict[str, Motion]:
    return {"glass": Motion(rotate=tuple(ARCSEC * np.array(vector)), pivot=pivot)}


@pytest.mark.second
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
    start, into = plane_wave(beam(entry(hand), radius=0.4 * WIDTH), slant)
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


FACES = {
    "180": ("mirror", "roof_a", "roof_b"),
    "180 of the other hand": ("mirror", "roof_a", "roof_b"),
    "0": ("entry", "mirror_a", "mirror_b", "exit"),
}


def frames(parts) -> dict[str, np.ndarray]:
    return {body.path.rpartition("/")[2]: body.pose.rotation for body in parts.bodies}


@pytest.mark.second
@pytest.mark.parametrize(("prism", "face"), [(prism, face) for prism, faces in FACES.items() for face in faces])
@pytest.mark.parametrize("axis", [0, 1])
def test_angle_errors(backend, prism, face, axis) -> None:
    """First order: mirrors as in ``prism_errors``, and a window turned by w as a thin wedge that turns the beam by
    (n - 1) w, with opposite signs at both ends. What is left is of second order in the error, at most 10 of its
    squares, and the same for an error as made and for a motion of the face.
    """
    hand, s = (-1.0 if "other" in prism else 1.0), np.sqrt(0.5)
    if prism == "0":
        make, middle, into = parts_0, (-0.5 * SHIFT, 0.0, -0.2), UP
        normals = [s * np.array([-1.0, 0.0, 1.0])] * 2
    else:
        make, middle, into = partial(parts_180, hand), entry(hand), -UP
        normals = [(-s, 0.0, s), (0.5, hand * s, 0.5), (0.5, -hand * s, 0.5)]
    nominal = make()
    turn = frames(nominal)[face] @ np.eye(3)[axis]
    if face in ("entry", "exit"):
        whole = (N - 1.0) * turn * (1.0 if face == "entry" else -1.0)
    else:
        mirrors = [name for name in FACES[prism] if name not in ("entry", "exit")]
        whole = turn_by_mirrors(normals, [turn if name == face else np.zeros(3) for name in mirrors])
        whole = seen_outside(whole, UP, N) if prism == "0" else -N * whole
    first = np.cross(whole, UP)
    start, along, left = beam(middle, 4), np.broadcast_to(UP, (5, 3)), []
    for eps in (1e-3, 5e-4):
        tilt = eps * np.eye(3)[axis]
        made = send(backend, make(errors={face: tuple(tilt[:2])}), start, along)
        moved = send(backend, nominal, start, along, {f"glass/{face}": Motion(rotate=tuple(tilt))})
        assert made[3].all()
        assert np.abs(made[1] - moved[1]).max() < 1e-15
        assert np.abs(made[1] - made[1][0]).max() < 1e-14  # a plane wave stays one
        left.append(made[1][0] - into - eps * first)
    assert np.linalg.norm(left[0]) < 10.0 * 1e-3**2
    assert left[0] == pytest.approx(4.0 * left[1], abs=50.0 * 1e-3**3)  # and it is of second order
    assert 0.3 * N < np.linalg.norm(first) < 2.0 * N + 1e-12


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
    start, into = plane_wave(beam((-0.5 * SHIFT, 0.0, -0.2), radius=0.4 * WIDTH), slant)
    rays = np.broadcast_to(into, start.shape)
    position, direction, path, valid = send(backend, made, start, rays, turned(turn, "origin"))
    assert valid.all()
    assert np.abs(direction - into).max() < 3e-15
    own = rotation_matrix(ARCSEC * np.array(turn))
    w, x = own @ UP, own @ np.array([1.0, 0.0, 0.0])
    across = into - (into @ w) * w
    cos_j = np.sqrt(1.0 - across @ across / N**2)
    thick = WIDTH + 2.0 * reflectors.EDGE_MARGIN + SHIFT
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


@pytest.mark.parametrize("hand", [1.0, -1.0])
@pytest.mark.parametrize("width", [0.02, 0.06, 0.1])
def test_bodies(hand, width) -> None:
    """Closed solids with glass around their clear apertures: EDGE of it, and EDGE / sqrt(3) toward the roof's slanted
    edges. The rhomboid's volume is that of its box.
    """
    long = reflectors.prism_180(reflectors.Mount("glass", Pose(), "p", "fused silica", LENGTH, width, hand))
    small = reflectors.prism_0(reflectors.Mount("glass", Pose(), "p", "fused silica", SHIFT + width, width))
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
            assert room.min() > reflectors.EDGE_MARGIN / np.sqrt(3.0) - 1e-9
    box = (SHIFT + width) * (width + 2.0 * reflectors.EDGE_MARGIN) * (width + 2.0 * reflectors.EDGE_MARGIN)
    placed = RigidTree(small.bodies).place()
    assert solid_mesh(small.solids[0], placed).mesh.volume == pytest.approx(box, rel=1e-9)


ATTITUDES = [(0.0, 0.0, 0.0), *TURNS[:4]]
ERRORS = ((20e-6, -30e-6), (-10e-6, 5e-6), (15e-6, 25e-6))


def hollow(length=LENGTH, width=WIDTH, hand=1.0, errors=None):
    return reflectors.hollow_transfer(reflectors.Mount("frame", Pose(), "p", "SiC", length, width, hand, errors or {}))


def small(shift=SHIFT, width=WIDTH, errors=None):
    return reflectors.periscope(reflectors.Mount("frame", Pose(), "p", "SiC", shift, width, errors=errors or {}))


def made(kind: str, hand: float = 1.0, errors=None):
    """Parts and where the middle of the beam enters."""
    if kind == "periscope":
        return small(errors=errors), np.array([-0.5 * SHIFT, 0.0, -0.2])
    return hollow(hand=hand, errors=errors), np.array([-0.5 * LENGTH, hand * reflectors.hollow_offset(WIDTH), -0.2])


def by_hand(parts, state, position, direction):
    """Reflections in turn: places (K + 1, N, 3), last direction (N, 3), path (N,)."""
    placed = RigidTree(parts.bodies).place([state])
    way, places, length = np.array(direction), [np.array(position)], np.zeros(len(position))
    for element in parts.elements:
        pose = placed.pose(element.body)
        normal = pose.rotation[:, 2]
        ahead = (pose.translation - places[-1]) @ normal / (way @ normal)
        places.append(places[-1] + ahead[:, None] * way)
        length += ahead
        way = way @ reflection(normal)
    return np.array(places), way, length


@pytest.mark.second
@pytest.mark.parametrize("kind", ["hollow_transfer", "periscope"])
@pytest.mark.parametrize("turn", ATTITUDES)
@pytest.mark.parametrize("slant", [(0.0, 0.0), (0.004, -0.007)])
def test_light_goes_as_plain_mirrors_send_it(backend, kind, turn, slant) -> None:
    """In any attitude; the direction is the entering one, or its opposite, whatever the attitude."""
    for hand in (1.0, -1.0):
        parts, middle = made(kind, hand)
        start, into = plane_wave(beam(middle, 24), slant)
        ways = np.broadcast_to(into, start.shape)
        state = {"frame": Motion(rotate=tuple(ARCSEC * np.array(turn)), pivot="apex")}
        place, way, path, valid = send(backend, parts, start, ways, state)
        places, direction, length = by_hand(parts, state, start, ways)
        assert valid.all()
        # lengths near 1 m, three reflections in doubles
        np.testing.assert_allclose(way, direction, rtol=0, atol=2e-15)
        np.testing.assert_allclose(place, places[-1], rtol=0, atol=2e-15)
        np.testing.assert_allclose(path, length, rtol=0, atol=2e-15)
        sign = -1.0 if reflectors.REFLECTORS[kind].returns else 1.0
        assert np.abs(way - sign * into).max() < 1e-15
        if kind == "hollow_transfer":
            # the line that leaves is the one that enters, reflected at the point where the three mirrors meet
            miss = np.cross(place - (2.0 * np.array(parts.apex) - start), into)
            assert np.abs(miss).max() < 3e-15
            assert np.ptp(path + place @ into) < 3e-15


@pytest.mark.parametrize("kind", ["hollow_transfer", "periscope"])
def test_angle_errors_are_tilts_of_the_mirrors(kind) -> None:
    errors = dict(zip(reflectors.REFLECTORS[kind].faces, ERRORS, strict=False))
    (parts, _), (perfect, _) = made(kind, errors=errors), made(kind)
    for name, error in errors.items():
        own, nominal = (RigidTree(p.bodies).place().pose(f"frame/{name}") for p in (parts, perfect))
        turn = nominal.rotation @ rotation_matrix(np.array([*error, 0.0]))
        np.testing.assert_allclose(own.rotation, turn, rtol=0, atol=4e-16)
    with pytest.raises(ValueError, match="no such face: window"):
        made(kind, errors={"window": (0.0, 0.0)})


@pytest.mark.second
@pytest.mark.parametrize("kind", ["hollow_transfer", "periscope"])
@pytest.mark.parametrize("width", [0.02, 0.06, 0.15])
@pytest.mark.parametrize("factor", [1.0, 1.3, 10.0])
def test_plates_and_frame_leave_room_to_the_beam_and_to_each_other(kind, width, factor) -> None:
    """At the least length that is allowed, and at longer ones."""
    make = hollow if kind == "hollow_transfer" else small
    words = f"of width {1e3 * width:g} mm cannot .* the beam by only {500.0 * width:g} mm; at least"
    with pytest.raises(ValueError, match=words) as caught:
        make(0.5 * width, width)
    least = 1e-3 * float(re.search(r"at least ([\d.]+) mm", str(caught.value))[1])
    length = (1.0 + 1e-3) * factor * least
    for hand in (1.0, -1.0) if kind == "hollow_transfer" else (1.0,):
        parts = make(length, width, hand) if kind == "hollow_transfer" else make(length, width)
        placed = RigidTree(parts.bodies).place()
        bodies = {s.path: placed.pose(s.path).apply(solid_mesh(s, placed).vertices) for s in parts.solids}
        assert set(bodies) == {b.path for b in parts.bodies}
        for a, b in combinations(bodies, 2):
            assert separation(bodies[a], bodies[b]) > LEAST_GAP, (a, b)
        y = hand * reflectors.hollow_offset(width) if kind == "hollow_transfer" else 0.0
        start = beam(np.array([-0.5 * length, y, -1.0]), 24, 0.5 * width, 4)
        places, way, _ = by_hand(parts, {}, start, np.broadcast_to(UP, start.shape))
        places = np.concatenate([places, places[-1:] + way])
        segments = np.stack([places[:-1], places[1:]], axis=1).transpose(2, 0, 1, 3)
        for path, corners in bodies.items():
            assert not blocked_rays(segments, ConvexHull(corners).equations).any(), path
        # the whole beam meets every mirror within its clear aperture, which its plate surrounds
        for element, at in zip(parts.elements, places[1:-1], strict=True):
            local = placed.pose(element.body).inverse().apply(at)
            assert element.aperture.scaled(1.0 + 1e-9).contains(local[:, 0], local[:, 1]).all()
            rim = placed.pose(element.body).apply(
                np.column_stack([element.aperture.outline(), np.zeros(len(element.aperture.outline()))])
            )
            solid = next(s for s in parts.solids if s.path == element.body)
            front = solid_mesh(solid, placed).polygons[0]
            assert solid.faces[0].coating is Coating.MIRROR
            inside = ConvexHull(front[:, :2]).equations
            local = placed.pose(element.body).inverse().apply(rim)[:, :2]
            assert np.max(local @ inside[:, :2].T + inside[:, 2]) < -1e-3


# --- in an instrument -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model(backend, tmp_path_factory):
    return monitor_layouts.built(monitor_layouts.hollow_pair(), tmp_path_factory.mktemp("hollow"), backend)


@pytest.mark.second
def test_what_stands_in_which_beam(model, gf7_pair, backend) -> None:
    """No glass, bodies clear of each other, and nothing in a monitor beam; plates and frames of the 180-deg kind take
    less of the pupil than the glass that they stand for.
    """
    assert not model.assembly.media
    assert find_overlaps(model) == ()
    found = find_obstructions(model, backend)
    assert {o.beam for o in found} == {"forward/imaging", "backward/imaging"}
    assert all("/prism_180" in o.body for o in found)
    glass = {o.body: o.share for o in find_obstructions(gf7_pair, backend)}
    for path, share in glass.items():
        assert sum(o.share for o in found if o.body == path or o.body.startswith(f"{path}/")) < share


def test_the_material_is_spelt_as_in_the_catalogue(tmp_path) -> None:
    data = monitor_layouts.hollow_pair()
    data["monitor"]["prism_180"] = {**data["monitor"]["prism_180"], "material": "zerodur"}
    assert load_instrument(monitor_layouts.write(data, tmp_path / "own.yaml")).monitor.prism_180.material == "Zerodur"


# --- heat -------------------------------------------------------------------------------------------------------------

FRAMES = ("base/forward/monitor/left/prism_180", "base/backward/monitor/right/prism_0")


@pytest.fixture(scope="module")
def heat(model) -> ThermalModel:
    return ThermalModel(model)


def mirrors(model, frame: str):
    return [e for e in model.assembly.elements.values() if e.body.startswith(f"{frame}/")]


@pytest.mark.parametrize("frame", FRAMES)
def test_a_uniform_change_stretches_it_and_keeps_all_angles(model, heat, frame) -> None:
    change = 20.0
    grown = 1.0 + heat.materials[frame].expansion * change
    assert heat.materials[frame] == material("CFRP" if frame.endswith("180") else "SiC")
    placed = model.assembly.place([{}, heat.state({frame: Temperature(change)})])
    np.testing.assert_array_equal(placed.rotation[0], placed.rotation[1])
    held = placed.pose(frame).apply(np.array(model.assembly.tree[frame].pivots["centre"]))
    for path in (frame, *(e.body for e in mirrors(model, frame))):
        before, after = placed.pose(path), placed.pose(path, 1)
        np.testing.assert_allclose(after.translation - held, grown * (before.translation - held), rtol=0, atol=2e-15)
        assert placed.scale[1, placed.index[path]] == pytest.approx(grown, abs=1e-15)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_gradient_deforms_frame_and_mirrors_as_one_free_body(model, heat, frame, axis) -> None:
    """Every point of every mirror is where the exact displacement of the free body takes it, bending included."""
    gradient = 3.0 * np.eye(3)[axis]
    stuff = heat.materials[frame]
    about = np.array(model.assembly.tree[frame].pivots["centre"])
    # zero at the mount, so that nothing grows there
    state = heat.state({frame: Temperature(float(-gradient @ about), tuple(gradient))})
    free = free_linear_field(stuff.expansion, 0.0, gradient, about)
    placed = model.assembly.place([{}, state])
    own = placed.pose(frame)
    for element in mirrors(model, frame):
        x, y = 0.9 * element.aperture.outline(40).T
        nominal = placed.pose(element.body).apply(np.column_stack([x, y, 0.0 * x]))
        moved = nominal + free(own.inverse().apply(nominal)) @ own.rotation.T
        local = placed.pose(element.body, 1).inverse().apply(moved)
        radius = element.surface.figure_disk(element.aperture).radius
        terms = basis(15, local[:, 0] / radius, local[:, 1] / radius)
        figure = np.array([state[element.body].figure.get(j, 0.0) for j in range(1, 16)])
        size = stuff.expansion * np.linalg.norm(gradient)
        at = own.inverse().apply(placed.pose(element.body).translation) - about
        reach = np.linalg.norm(at) + 0.06
        # of second order in turns and shifts; doubles resolve 4e-16 of 3 m
        np.testing.assert_allclose(local[:, 2], terms @ figure, rtol=0, atol=4.0 * (size * reach) ** 2 * reach + 2e-15)
        along = placed.pose(element.body).rotation.T @ own.rotation @ gradient
        # a plane becomes a sphere of curvature alpha g_n
        bent = -stuff.expansion * along[2] * radius**2 / (4.0 * np.sqrt(3.0))
        assert state[element.body].figure.get(4, 0.0) == pytest.approx(bent, rel=1e-6, abs=1e-4 * size * radius**2)
        turn = own.rotation @ (stuff.expansion * np.cross(gradient, at))
        found = placed.pose(element.body, 1).rotation @ placed.pose(element.body).rotation.T
        np.testing.assert_allclose(found, rotation_matrix(turn), rtol=0, atol=4.0 * (size * reach) ** 2 + 2e-15)


def test_mirrors_have_the_temperature_of_their_frame(model, heat) -> None:
    frame = FRAMES[0]
    assert "temperature" in model.nodes[frame].allows
    for element in mirrors(model, frame):
        assert model.nodes[element.body].allows == {"rotate", "shift", "figure"}
    # mirrors reach farther to the side than the bar
    with pytest.raises(TemperatureError, match=f"{frame} would be at") as caught:
        heat.check({frame: Temperature(0.0, (0.0, 4500.0, 0.0))})
    assert caught.value.origin == frame
