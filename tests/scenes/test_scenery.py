"""The scene's surfaces: where they stand, that their triangles cover what the prescription says, what they do."""

from dataclasses import replace

import numpy as np
import pytest

from optics.geometry.aperture import Circle, Ellipse, Rectangle
from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.solid import solid_mesh
from optics.geometry.surface import Surface, plane
from optics.geometry.tree import Body, Motion, RigidTree
from optics.raytrace.assembly import Assembly, Element, Interaction
from scenes.models.meshes import sheet_mesh
from scenes.models.scenery import (
    Detector,
    Finishes,
    Scenery,
    SceneSurface,
    build_scenery,
    mirror_surface,
    plate_surfaces,
    solid_surfaces,
)
from scenes.specs.baffle import box, ring, tube

STATE = {
    "base/forward": Motion(scale=3e-5, rotate=(1e-4, 2e-4, -1e-4)),
    "base/forward/M2": Motion(shift=(1e-5, 2e-5, 3e-5), rotate=(1e-4, 0.0, 2e-4), pivot="centre"),
    "base/forward/monitor/left/prism_0": Motion(rotate=(1e-3, 2e-3, 0.0)),
}


@pytest.fixture(scope="module", params=["gf7_pair", "monitor_pair"])
def scene(request, instrument) -> tuple:
    chosen = instrument(request.param)
    return chosen, build_scenery(chosen, STATE)


def by_name(scenery: Scenery, name: str) -> SceneSurface:
    return next(s for s in scenery.surfaces if s.name == name)


def contained(points: np.ndarray, surface: SceneSurface) -> np.ndarray:
    """Which points (N, 2) of a surface's x, y lie over its triangles."""
    corners = surface.vertices[surface.triangles][..., :2]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    inside = np.zeros(len(points), bool)
    for k in range(len(corners)):
        area = np.linalg.det(np.stack([b[k] - a[k], c[k] - a[k]]))
        v = points - a[k]
        s = (v[:, 0] * (c[k] - a[k])[1] - v[:, 1] * (c[k] - a[k])[0]) / area
        t = (-v[:, 0] * (b[k] - a[k])[1] + v[:, 1] * (b[k] - a[k])[0]) / area
        inside |= (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1.0 + 1e-9)
    return inside


@pytest.mark.second
def test_the_window_of_the_180_degree_prism_has_two_apertures(scene) -> None:
    instrument, scenery = scene
    window = by_name(scenery, "base/forward/monitor/left/prism_180/window")
    assert window.elements == ("forward/left/prism_180/entry", "forward/left/prism_180/exit")
    centres = np.array([a.centre for a in window.apertures])
    placed = instrument.assembly.place([STATE])
    for name, centre in zip(window.elements, centres, strict=True):
        element = instrument.assembly.elements[name]
        assert isinstance(element.aperture, Ellipse)
        expected = placed.pose(element.body).apply(np.array([*element.aperture.centre, 0.0]))
        got = window.pose.apply(np.array([*centre, 0.0]))
        np.testing.assert_allclose(
            got, expected, atol=1e-4 * 3e-1
        )  # the state's growth, which the aperture does not follow


def test_mirrors_stand_and_grow_as_the_trace_has_them(scene) -> None:
    instrument, scenery = scene
    placed = instrument.assembly.place([STATE])
    for name in ("M1", "M2", "M3"):
        surface = by_name(scenery, f"forward/{name}")
        assert surface.pose == placed.pose(f"base/forward/{name}")
        model = instrument.cameras["forward"].surfaces[name]
        assert surface.surface.curvature == pytest.approx(model.curvature / (1.0 + 3e-5), rel=1e-15)
        assert surface.surface.even[1] == pytest.approx(model.even[1] / (1.0 + 3e-5) ** 5, rel=1e-14)
        x, y, z = surface.vertices.T
        np.testing.assert_allclose(surface.surface.sag(x, y), z, atol=1e-16)


@pytest.mark.second
def test_triangles_reach_beyond_every_clear_aperture(scene) -> None:
    _, scenery = scene
    checked = 0
    for surface in scenery.surfaces:
        if not surface.ends:
            continue
        (aperture,) = surface.apertures
        assert contained(aperture.outline(200), surface).all(), surface.name
        checked += 1
    assert checked > 10


@pytest.mark.parametrize(
    ("surface", "aperture"),
    [
        (Surface(-0.4, -1.8, (1e-3, 5e-3)), Circle(0.12)),
        (Surface(0.15, 0.5), Rectangle(0.7, 0.35, (0.0, -0.8))),
        (plane(), Circle(0.01)),
        (plane(), Rectangle(0.5, 1e-5)),
    ],
)
def test_distance_of_triangles_is_known(surface: Surface, aperture: Circle | Rectangle) -> None:
    vertices, triangles, apart = sheet_mesh(surface, aperture)
    weights = np.random.default_rng(1).dirichlet([1.0, 1.0, 1.0], len(triangles))
    points = np.einsum("tk,tkc->tc", weights, vertices[triangles])
    found = np.abs(surface.sag(points[:, 0], points[:, 1]) - points[:, 2]).max()
    assert found <= apart
    assert apart < 2e-3
    assert (apart == 0.0) == surface.is_plane


def test_light_meets_the_optical_side(scene) -> None:
    """M2's +z looks at the light, M1's and M3's away from it; the rear sides are black."""
    _, scenery = scene
    finishes = Finishes()
    for camera in ("forward", "backward"):
        for name, front, back in (
            ("M1", finishes.mirror_back, finishes.mirror),
            ("M2", finishes.mirror, finishes.mirror_back),
            ("M3", finishes.mirror_back, finishes.mirror),
        ):
            surface = by_name(scenery, f"{camera}/{name}")
            assert (surface.front, surface.back) == (front, back)


@pytest.mark.second
def test_faces_of_a_body_enclose_it_and_look_outward(scene) -> None:
    instrument, scenery = scene
    for solid in instrument.solids:
        faces = [s for s in scenery.surfaces if s.solid == solid.path]
        assert len(faces) == len(solid.faces)
        corners = np.concatenate([s.pose.apply(s.vertices) for s in faces])
        for face in faces:
            height = (corners - face.pose.translation) @ face.pose.rotation[:, 2]
            assert height.max() < 1e-8
            assert height.min() < -1e-3
            assert np.abs(face.vertices[:, 2]).max() < 1e-8
            assert not face.ends
        index = {s.index for s in faces}
        assert len(index) == 1
        assert (index.pop() > 1.4) == solid.transparent
        # the triangles of all faces hold the whole body
        a, b, c = np.moveaxis(np.concatenate([s.pose.apply(s.vertices)[s.triangles] for s in faces]), 1, 0)
        whole = solid_mesh(solid, instrument.assembly.place([STATE])).mesh.volume
        assert abs(np.sum(a * np.cross(b, c))) / 6.0 == pytest.approx(whole, rel=1e-9)


def test_a_warm_body_has_another_index(instrument) -> None:
    chosen = instrument("gf7_pair")
    solid = chosen.solids[0]
    faces = solid_surfaces(
        solid, chosen.assembly, chosen.assembly.place(), {solid.path: Motion(index=1e-5)}, Finishes()
    )
    assert faces[0].index == pytest.approx(chosen.assembly.media[solid.path] + 1e-5, abs=1e-15)


def test_a_return_face_is_masked_outside_its_aperture(scene) -> None:
    _, scenery = scene
    finishes = Finishes()
    face = scenery.surfaces[scenery.of_element("forward/left/return_face")]
    assert (face.front, face.outside) == (finishes.mirror, finishes.ground)
    wall = by_name(scenery, "base/central_prism/wall_front")
    assert wall.front == wall.outside == finishes.ground


def test_detectors_have_the_grids_of_the_wave_path(scene) -> None:
    instrument, scenery = scene
    ccd = instrument.spec.monitor.area_ccd
    placed = instrument.assembly.place([STATE])
    for channel in instrument.channels:
        name = f"{channel.key}/area_ccd"
        detector = next(d for d in scenery.detectors if d.name == name)
        assert detector.shape == (ccd.rows, ccd.columns)
        assert by_name(scenery, name).pose == placed.pose(channel.ccd_body)
    for camera, model in instrument.cameras.items():
        detector = next(d for d in scenery.detectors if d.name == f"{camera}/line")
        assert detector.shape == (model.spec.line.pixels, 1)
    line = by_name(scenery, "forward/line")
    # it faces the light, which comes along the focal plane's +Z
    assert line.pose.rotation[:, 2] @ placed.pose("base/forward/focal_plane").rotation[:, 2] == pytest.approx(-1.0)
    board = by_name(scenery, "forward/board/0")
    depth = (board.pose.translation - line.pose.translation) @ line.pose.rotation[:, 2]
    assert -0.01 < depth < -1e-3


def test_a_whole_focal_plane_takes_the_place_of_its_detectors(instrument) -> None:
    scenery = build_scenery(instrument("gf7_pair"), {}, whole_focal_planes=True)
    assert [d.name for d in scenery.detectors] == ["forward/focal_plane", "backward/focal_plane"]
    assert not any("board" in s.name or "ccd" in s.name for s in scenery.surfaces)


def test_a_box_and_a_tube_are_closed_around_what_they_hold() -> None:
    tree = RigidTree((Body("b", Pose(rotation_matrix([0.3, 0.0, 0.1]), np.array([0.0, 1.0, 0.0]))),))
    placed = Assembly(tree, {}, {}).place()
    for part, height in (
        (box("box", "b", Pose(), (0.2, 0.3, 50.0)), 25.0),
        (tube("tube", "b", Pose(), 0.1, 50.0), 25.0),
    ):
        surfaces = plate_surfaces(part, placed)
        directions = np.random.default_rng(2).normal(size=(200, 3))
        start = placed.pose("b").apply(np.array([0.0, 0.0, height]))
        hit = np.zeros(200, bool)
        for s in surfaces:
            inverse = s.pose.inverse()
            o, d = inverse.apply(start), directions @ s.pose.rotation
            t = -o[2] / d[:, 2]
            at = o + t[:, None] * d
            hit |= (t > 0.0) & s.apertures[0].contains(at[:, 0], at[:, 1])
        hit |= np.abs(directions @ placed.pose("b").rotation[:, 2]) > 0.99 * np.linalg.norm(directions, axis=-1)
        assert hit.all(), part[0].name


def test_a_ring_has_a_hole() -> None:
    (plate,) = ring("stop", "b", Pose(), 0.02, 0.05)
    assert not plate.outline.contains(0.0, 0.01)
    assert plate.outline.contains(0.0, 0.03)


def test_names_are_unique_and_detectors_known() -> None:
    grid = Detector("d", 2, 2, (1e-3, 1e-3))
    element = Element("m", "m", plane(), Interaction.REFLECT, Circle(0.1))
    placed = Assembly(RigidTree((Body("m"),)), {"m": element}, {}).place()
    mirror = mirror_surface(element, placed, Finishes())
    with pytest.raises(ValueError, match="same name: m"):
        Scenery((mirror, mirror))
    with pytest.raises(ValueError, match="unknown detectors: e"):
        Scenery((replace(mirror, detector="e"),), (grid,))
    with pytest.raises(ValueError, match="needs a clear aperture"):
        mirror_surface(replace(element, aperture=None), placed, Finishes())
