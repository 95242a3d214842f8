"""Every sign, axis and order that docs/conventions.md states, traced: when the page no longer holds, a test fails."""

import numpy as np
import pytest

from analysis.monitor import monitor_formulas
from analysis.monitor.monitor_formulas import MonitorGeometry
from optics.geometry import zernike
from optics.geometry.tree import Motion
from optics.raytrace.assembly import points_to_world
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from optics.waves.imaging import path_to_sphere
from scenes.models.camera_model import collimated, field_direction
from twin.monitor.monitor_derivative import spot_jacobian
from twin.monitor.monitor_path import MonitorPath
from twin.monitor.truth import ElementaryMotion, line_family, trace_truth, truth_jacobian

CAMERA = "forward"
PLANE = f"base/{CAMERA}/focal_plane"
LEFT, RIGHT = 0, 1
ROW, COLUMN = 0, 1
ALPHA, BETA, GAMMA, F = range(4)
AXES = "XYZ"


@pytest.fixture(scope="module")
def path(gf7_pair, backend):
    return MonitorPath(gf7_pair, backend)


@pytest.fixture(scope="module")
def motions():
    """The motions of the page, by the names it gives them."""
    out = dict(zip(("line +X", "line +Y", "line turned +Z", "scale"), line_family(CAMERA), strict=True))
    for axis, letter in enumerate(AXES):
        out[f"camera about {letter}"] = ElementaryMotion(f"base/{CAMERA}", "rotate", axis)
        out[f"rear_node about {letter}"] = ElementaryMotion(PLANE, "rotate", axis, "rear_node")
    return out


@pytest.fixture(scope="module")
def truth(gf7_pair, backend, motions):
    """Motion -> true [d_alpha, d_beta, d_gamma (rad), d_f (m)] per radian, metre or unit of scale."""
    columns = truth_jacobian(gf7_pair, backend, list(motions.values()))[CAMERA]
    return dict(zip(motions, columns.T, strict=True))


@pytest.fixture(scope="module")
def spots(path, motions):
    """Motion -> (2 channels, 2 (row, column)) px per radian, metre or unit of scale, for the camera's own spots."""
    jacobian = spot_jacobian(path, list(motions.values()))[:2]
    return {name: jacobian[..., k] for k, name in enumerate(motions)}


@pytest.fixture(scope="module")
def scales(gf7_pair):
    """Local focal lengths across (f_x, along the camera's X) and along the line (f_y), metres."""
    matrix = gf7_pair.cameras[CAMERA].first_order.scale[0]
    # the launch axes of the scale are the prescription's x (camera Y) and the axis square to it (camera X)
    return abs(matrix[1, 1]), abs(matrix[0, 0])


# --- frames ---------------------------------------------------------------------------------------------------------


def test_camera_frame_in_the_prescription(gf7_pair):
    model = gf7_pair.cameras[CAMERA]
    x, y, z = model.camera_frame.rotation.T
    assert y == pytest.approx([1, 0, 0], abs=1e-15)
    assert z == pytest.approx(-field_direction(model.spec, 0.0, 0.0), abs=1e-15)
    assert x == pytest.approx(np.cross(y, z), abs=1e-15)
    assert x[1] > 0.99


def test_focal_plane_frame_in_the_prescription(gf7_pair):
    model = gf7_pair.cameras[CAMERA]
    assert model.focal_plane.rotation.T == pytest.approx(np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), abs=1e-15)
    # three mirrors: the light reaches the image running toward +Z, so its upstream side is -Z
    assert model.image_direction @ model.focal_plane.rotation[:, 2] > 0.99
    node = model.focal_plane.inverse().apply(model.rear_node)
    assert node[2] == pytest.approx(-model.line_principal_distance, rel=1e-3)


def test_mirror_bodies_have_the_prescription_axes(gf7_pair):
    model = gf7_pair.cameras[CAMERA]
    into_base = gf7_pair.assembly.nominal_pose(f"base/{CAMERA}") @ model.camera_frame.inverse()
    for name in model.mirrors:
        pose = gf7_pair.assembly.nominal_pose(f"base/{CAMERA}/{name}")
        assert pose.rotation == pytest.approx(into_base.rotation, abs=1e-14)
        assert pose.translation == pytest.approx(into_base.apply(model.vertex(name)), abs=1e-14)
        x, y, z = gf7_pair.assembly.tree[f"base/{CAMERA}/{name}"].pivots["centre"]
        assert (x, y) == model.apertures[name].centre
        assert z == pytest.approx(float(model.surfaces[name].sag(x, y)), abs=1e-15)


def test_look_angle_is_positive_forward(gf7_pair):
    for name, sign in (("forward", 1), ("backward", -1)):
        sight = gf7_pair.camera_axes(name)[:, 2]
        assert np.sign(sight[0]) == sign
        assert sight[2] > 0.8
        assert np.arctan2(sight[0], sight[2]) == pytest.approx(gf7_pair.spec.cameras[name].look, abs=1e-15)
        assert gf7_pair.camera_axes(name)[:, 1] == pytest.approx([0, 1, 0], abs=1e-15)


def test_left_is_the_plus_y_end(gf7_pair):
    for channel in gf7_pair.channels:
        assert (channel.ccd[1] > 0) == (channel.name == "left")
        assert channel.pinhole[0] - channel.ccd[0] == pytest.approx(-0.003)
    assert [c.name for c in gf7_pair.channels] == ["left", "right"] * 2


def test_an_image_point_at_plus_y_looks_to_minus_y(gf7_pair, backend):
    model = gf7_pair.cameras[CAMERA]
    # light travels against the direction in which it is seen
    travel = field_direction(model.spec, 0.001, 0.0)
    sight_y = (-travel) @ model.camera_frame.rotation[:, 1]
    bare = model.bare_assembly()
    launch = collimated(backend, assemble(bare, [("M1", "M2")]), travel[None], np.zeros((1, 2)))[0]
    hit = trace(backend, assemble(bare, ["imaging"]), make_rays(backend, launch, travel)).numpy()[0][0, 0]
    assert sight_y < 0
    # the image plane of the bare camera has the prescription's axes: its x is camera Y
    assert hit[0] > 0


# --- motions --------------------------------------------------------------------------------------------------------


def test_a_motion_is_in_the_bodys_own_frame(gf7_pair):
    placed = gf7_pair.assembly.place([{}, {PLANE: Motion(shift=(1e-3, 0.0, 0.0))}])
    moved = placed.pose(PLANE, 1).translation - placed.pose(PLANE, 0).translation
    assert moved == pytest.approx(1e-3 * placed.pose(PLANE).rotation[:, 0], abs=1e-15)


def test_a_scale_grows_spacings_and_mirrors_but_no_detector(gf7_pair):
    growth = 1e-3
    placed = gf7_pair.assembly.place([{}, {f"base/{CAMERA}": Motion(scale=growth)}])
    root = placed.pose(f"base/{CAMERA}")
    for path in (f"base/{CAMERA}/M3", PLANE):
        before, after = (root.inverse().apply(placed.pose(path, s).translation) for s in (0, 1))
        assert after == pytest.approx((1 + growth) * before, rel=1e-12)
    ccd = f"{PLANE}/left/area_ccd"
    before, after = (placed.pose(PLANE, s).inverse().apply(placed.pose(ccd, s).translation) for s in (0, 1))
    assert after == pytest.approx(before, abs=1e-15)
    assert placed.scale[1, placed.index[f"base/{CAMERA}/M3"]] == pytest.approx(1 + growth)
    assert placed.scale[1, placed.index[PLANE]] == 1.0


# --- truth ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("letter", "which"), [("X", BETA), ("Y", ALPHA), ("Z", GAMMA)])
def test_a_turn_of_the_camera_is_its_own_truth(truth, letter, which):
    expected = np.zeros(4)
    expected[which] = 1.0
    assert truth[f"camera about {letter}"] == pytest.approx(expected, abs=1e-6)


def test_truth_of_the_line_motions(truth, scales):
    f_x, f_y = scales
    assert truth["line +X"][ALPHA] == pytest.approx(-1 / f_x, rel=1e-4)
    assert truth["line +Y"][BETA] == pytest.approx(+1 / f_y, rel=1e-4)
    assert truth["line turned +Z"][GAMMA] == pytest.approx(+f_y / f_x, rel=1e-4)
    assert 1.01 < f_x / f_y < 1.05  # the anamorphism is there, and it is small


def test_truth_of_the_scale_is_the_principal_distance(truth, gf7_pair, backend):
    distance = trace_truth(gf7_pair, backend, [{}]).principal_distance[CAMERA]
    assert truth["scale"][F] == pytest.approx(+distance, rel=2e-3)
    assert truth["scale"][:3] == pytest.approx(np.zeros(3), abs=1e-6)


def test_parity_of_the_image_space(truth, scales):
    """A turn of the focal plane about rear_node by +theta moves the line of sight by -theta about X and Y."""
    f_x, f_y = scales
    assert truth["rear_node about Y"][ALPHA] == pytest.approx(-f_y / f_x, rel=1e-3)
    assert truth["rear_node about X"][BETA] == pytest.approx(-1.0, rel=1e-3)
    assert truth["rear_node about Z"][GAMMA] == pytest.approx(+f_y / f_x, rel=1e-3)


def test_the_intersection_angle_grows_with_d_alpha_of_the_forward_camera(gf7_pair, backend):
    turn = 1e-5
    states = [{f"base/{name}": Motion(rotate=(0.0, turn, 0.0))} for name in ("forward", "backward")]
    change = trace_truth(gf7_pair, backend, states).angle_change
    assert change == pytest.approx([turn, -turn], abs=1e-12)


# --- detector and spots ---------------------------------------------------------------------------------------------


def test_first_pixel(gf7_pair, path):
    """Pixel (0, 0) is the corner at +X, -Y of the focal plane; its centre lies -(n - 1)/2 pitches from the CCD's."""
    rows, columns = path.shape
    x, y = path.axis(1), path.axis(0)
    assert x[0] == pytest.approx(-0.5 * (columns - 1) * path.pitch)
    assert y[0] == pytest.approx(-0.5 * (rows - 1) * path.pitch)
    assert x[1] - x[0] == pytest.approx(path.pitch)
    channel = gf7_pair.channels[LEFT]
    placed = gf7_pair.assembly.place()
    corner = points_to_world(placed, channel.ccd_body, np.array([[x[0], y[0], 0.0]]))[0, 0]
    on_plane = placed.pose(PLANE).inverse().apply(corner)
    assert on_plane == pytest.approx([channel.ccd[0] - x[0], channel.ccd[1] + y[0], 0.0], abs=1e-15)
    # the CCD faces the light, which runs along the focal plane's +Z
    assert placed.pose(channel.ccd_body).rotation[:, 2] == pytest.approx(-placed.pose(PLANE).rotation[:, 2], abs=1e-15)


def test_spot_signs(spots, path, gf7_pair):
    """A shift s of the focal plane moves the spot by -2 s in it: columns run along -X, rows along +Y."""
    double = 2 / path.pitch
    for side in (LEFT, RIGHT):
        assert spots["line +X"][side] == pytest.approx([0.0, +double], abs=0.002 * double)
        assert spots["line +Y"][side] == pytest.approx([-double, 0.0], abs=0.002 * double)
    half = 0.5 * gf7_pair.separation[CAMERA]
    assert spots["line turned +Z"][LEFT, COLUMN] == pytest.approx(-half * double, rel=0.01)
    assert spots["line turned +Z"][RIGHT, COLUMN] == pytest.approx(+half * double, rel=0.01)
    assert spots["scale"][LEFT, ROW] == pytest.approx(+half * double, rel=0.01)
    assert spots["scale"][RIGHT, ROW] == pytest.approx(-half * double, rel=0.01)


@pytest.fixture(scope="module")
def geometry(gf7_pair, backend, path):
    return MonitorGeometry(
        principal_distance_m=trace_truth(gf7_pair, backend, [{}]).principal_distance[CAMERA],
        separation_m=gf7_pair.separation[CAMERA],
        pitch_m=path.pitch,
    )


PRINTED = [
    ("paper_single", "line +X", ALPHA, 1.0),  # eq. (3)
    ("paper_single", "line +Y", BETA, 1.0),  # eq. (2)
    ("paper_single", "line turned +Z", GAMMA, 2.0),  # eq. (5)
    ("paper_single", "scale", F, 1.0),  # eq. (7)
    ("paper_joint", "line +X", ALPHA, 1.0),  # Table 1
    ("paper_joint", "line +Y", BETA, 1.0),
    ("paper_joint", "line turned +Z", GAMMA, 2.0),
    ("paper_joint", "scale", F, 0.5),
]


@pytest.mark.parametrize(("name", "motion", "which", "factor"), PRINTED)
def test_printed_formulas_have_the_right_sign(spots, truth, geometry, name, motion, which, factor):
    """Positive factors, of the expected size but for the camera's anamorphism (3%), with columns along -X."""
    reading = monitor_formulas.coefficients(name, geometry)[which] @ spots[motion].ravel()
    assert reading / truth[motion][which] == pytest.approx(factor, rel=0.035)


def test_table_1_needs_two_signs_of_its_y(spots, truth, geometry, path):
    """With Y = before - after, as in (2), the printed (Y_L - Y_R) has the sign opposite to (7)."""
    y_left, y_right = -spots["scale"][:, ROW]
    assert (y_left - y_right) * truth["scale"][F] < 0
    y_left, y_right = -spots["line +Y"][:, ROW]
    assert (y_left + y_right) * truth["line +Y"][BETA] > 0


# --- waves ----------------------------------------------------------------------------------------------------------


def test_a_figure_is_sag_along_the_surfaces_z_and_delays_by_twice_itself_on_m1(gf7_pair, backend):
    """M1's z points away from the scene, so a positive sag lies deeper: longer path, negative OPD."""
    model = gf7_pair.cameras[CAMERA]
    amplitude, term = 20e-9, 4
    bare = model.bare_assembly()
    travel = field_direction(model.spec, 0.0, 0.0)
    radius = model.apertures["M2"].bounds[1]
    t = np.linspace(0, 2 * np.pi, 25)[:-1]
    ring = np.concatenate([r * np.stack([np.cos(t), np.sin(t)], axis=-1) for r in (0.3, 0.6, 0.95)])
    pupil = np.concatenate([np.zeros((1, 2)), ring])
    launch = collimated(backend, assemble(bare, [("M1", "M2")]), travel[None], radius * pupil)[0]
    states = [{}, {"M1": Motion(figure={term: amplitude})}]
    out = trace(backend, assemble(bare, ["imaging"], states), make_rays(backend, launch, travel), keep=(0,))
    position, direction, path, _ = out.numpy()
    to_sphere = path_to_sphere(position, direction, path, position[..., :1, :])
    # positive where the wavefront is ahead of the sphere: less path is left to it than of the chief ray
    opd = to_sphere[..., :1] - to_sphere
    aperture = model.apertures["M1"]
    # the figure's disk is the circle around the rectangular aperture
    x, y = ((out.hit(0)[0, :, :2] - aperture.centre) / np.hypot(aperture.half_x, aperture.half_y)).T
    assert np.hypot(x, y).max() < 1
    sag = amplitude * zernike.basis(term, x, y)[:, term - 1]
    # piston and tilt only move the image
    plane = np.stack([np.ones_like(sag), *pupil.T], axis=-1)
    change, bump = (v - plane @ np.linalg.lstsq(plane, v, rcond=None)[0] for v in (opd[1] - opd[0], sag))
    assert (change @ bump) / (bump @ bump) == pytest.approx(-2.0, rel=0.03)


def test_an_index_gradient_bends_toward_the_higher_index(backend, instrument):
    """In the 180-deg prism of one channel; the beam runs along its x for most of the way."""
    model = instrument("gf7_pair")
    prism = model.channels[0].prism_body("prism_180")
    names = model.assembly.sequences[f"{model.channels[0].key}/outgoing"]
    inside = [n for n in names if n.endswith(("prism_180/entry", "prism_180/mirror", "prism_180/roof_a"))]
    entry = model.assembly.elements[inside[0]]
    frame = model.assembly.nominal_pose(entry.body)
    start = frame.apply(np.array([*entry.aperture.centre, 1e-3]))
    rays = make_rays(backend, start, -frame.rotation[:, 2])
    states = [{}, {prism: Motion(index_gradient=(0.0, 1e-6, 0.0))}]
    traced = trace(backend, assemble(model.assembly, [inside], states), rays, world=True)
    place = traced.numpy(traced.world)[0][:, 0]
    across = model.assembly.nominal_pose(prism).rotation[:, 1]
    assert (place[1] - place[0]) @ across > 0.0
