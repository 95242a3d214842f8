"""Mirrors on a frame in place of the monitor's prisms, against plain reflections of numpy: what they do to a beam in
any attitude, which room they leave it, and what heat makes of them.
"""

import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.solid import Coating, solid_mesh
from optics.geometry.tree import Motion, RigidTree
from optics.geometry.zernike import basis
from optics.materials.material import material
from optics.raytrace.assembly import Assembly
from optics.raytrace.reflectors import REFLECTORS, Mount, hollow_offset, hollow_transfer, periscope
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from optics.thermal.heat import Temperature
from optics.thermal.thermo_elastic import free_linear_field
from scenes.models.clearance import LEAST_GAP, find_overlaps, separation
from scenes.models.obstruction import find_obstructions, rays_taken
from scenes.models.thermal_model import TemperatureError, ThermalModel
from scenes.specs.load import load_instrument
from tests.scenes import monitor_layouts
from tests.scenes.prism_errors import reflection

LENGTH, WIDTH, SHIFT = 0.8, 0.06, 0.1
ARCSEC = np.pi / 648000.0
UP = np.array([0.0, 0.0, 1.0])
TURNS = [(0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (0.0, 10.0, 0.0), (0.0, 0.0, 10.0), (2000.0, -1500.0, 3000.0)]
ERRORS = ((20e-6, -30e-6), (-10e-6, 5e-6), (15e-6, 25e-6))


def hollow(length=LENGTH, width=WIDTH, hand=1.0, errors=None):
    return hollow_transfer(Mount("frame", Pose(), "p", "SiC", length, width, hand, errors or {}))


def small(shift=SHIFT, width=WIDTH, errors=None):
    return periscope(Mount("frame", Pose(), "p", "SiC", shift, width, errors=errors or {}))


def made(kind: str, hand: float = 1.0, errors=None):
    """Parts and where the middle of the beam enters."""
    if kind == "periscope":
        return small(errors=errors), np.array([-0.5 * SHIFT, 0.0, -0.2])
    return hollow(hand=hand, errors=errors), np.array([-0.5 * LENGTH, hand * hollow_offset(WIDTH), -0.2])


def beam(middle, radius: float = 0.5 * WIDTH, rings: int = 1) -> np.ndarray:
    angle = 2.0 * np.pi * np.arange(24) / 24
    ring = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)
    return middle + np.concatenate([np.zeros((1, 3)), *(radius * (k + 1) / rings * ring for k in range(rings))])


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


@pytest.mark.parametrize("kind", ["hollow_transfer", "periscope"])
@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("slant", [(0.0, 0.0), (0.004, -0.007)])
def test_light_goes_as_plain_mirrors_send_it(backend, kind, turn, slant) -> None:
    """In any attitude; the direction is the entering one, or its opposite, whatever the attitude."""
    for hand in (1.0, -1.0):
        parts, middle = made(kind, hand)
        into = np.array([*slant, 1.0]) / np.linalg.norm([*slant, 1.0])
        start = beam(middle)
        start = start - ((start - start[0]) @ into)[:, None] * into
        ways = np.broadcast_to(into, start.shape)
        state = {"frame": Motion(rotate=tuple(ARCSEC * np.array(turn)), pivot="apex")}
        elements = {e.name: replace(e, aperture=None) for e in parts.elements}
        systems = assemble(Assembly(RigidTree(parts.bodies), elements, {"all": tuple(elements)}, {}), ["all"], [state])
        traced = trace(backend, systems, make_rays(backend, start, ways), world=True)
        place, way, path, valid = (a[0] for a in traced.numpy(traced.world))
        places, direction, length = by_hand(parts, state, start, ways)
        assert valid.all()
        # lengths near 1 m, three reflections in doubles
        np.testing.assert_allclose(way, direction, rtol=0, atol=2e-15)
        np.testing.assert_allclose(place, places[-1], rtol=0, atol=2e-15)
        np.testing.assert_allclose(path, length, rtol=0, atol=2e-15)
        sign = -1.0 if REFLECTORS[kind].returns else 1.0
        assert np.abs(way - sign * into).max() < 1e-15
        if kind == "hollow_transfer":
            # the line that leaves is the one that enters, reflected at the point where the three mirrors meet
            miss = np.cross(place - (2.0 * np.array(parts.apex) - start), into)
            assert np.abs(miss).max() < 3e-15
            assert np.ptp(path + place @ into) < 3e-15


@pytest.mark.parametrize("kind", ["hollow_transfer", "periscope"])
def test_angle_errors_are_tilts_of_the_mirrors(kind) -> None:
    errors = dict(zip(REFLECTORS[kind].faces, ERRORS, strict=False))
    parts, middle = made(kind, errors=errors)
    perfect, _ = made(kind)
    for name, error in errors.items():
        own, nominal = (RigidTree(p.bodies).place().pose(f"frame/{name}") for p in (parts, perfect))
        turn = nominal.rotation @ rotation_matrix(np.array([*error, 0.0]))
        np.testing.assert_allclose(own.rotation, turn, rtol=0, atol=4e-16)
    start = beam(middle)
    _, way, _ = by_hand(parts, {}, start, np.broadcast_to(UP, start.shape))
    sign = -1.0 if REFLECTORS[kind].returns else 1.0
    assert 1e-5 < np.abs(way[0] - sign * UP).max() < 2e-4
    with pytest.raises(ValueError, match="no such face: window"):
        made(kind, errors={"window": (0.0, 0.0)})


@pytest.mark.parametrize("kind", ["hollow_transfer", "periscope"])
@pytest.mark.parametrize("width", [0.02, 0.06, 0.15])
@pytest.mark.parametrize("factor", [1.0, 1.3, 10.0])
def test_plates_and_frame_leave_room_to_the_beam_and_to_each_other(kind, width, factor) -> None:
    """At the least length that is allowed, and at longer ones."""
    make = hollow if kind == "hollow_transfer" else small
    with pytest.raises(ValueError, match="at least") as caught:
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
        y = hand * hollow_offset(width) if kind == "hollow_transfer" else 0.0
        start = beam(np.array([-0.5 * length, y, -1.0]), 0.5 * width, 4)
        places, way, _ = by_hand(parts, {}, start, np.broadcast_to(UP, start.shape))
        places = np.concatenate([places, places[-1:] + way])
        segments = np.stack([places[:-1], places[1:]], axis=1).transpose(2, 0, 1, 3)
        for path, corners in bodies.items():
            assert not rays_taken(segments, ConvexHull(corners).equations).any(), path
        # the whole beam meets every mirror within its clear aperture, which its plate surrounds
        for element, at in zip(parts.elements, places[1:-1], strict=True):
            local = placed.pose(element.body).inverse().apply(at)
            assert element.aperture.grown(1.0 + 1e-9).contains(local[:, 0], local[:, 1]).all()
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
