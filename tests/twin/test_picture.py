"""Pictures and scene.glb: everything is where the perturbed instrument has it, the same again, and nothing is lost."""

import json
import re
from functools import partial
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import twin.main_job.render_command
import twin.pictures.picture
import twin.pictures.picture as picture_light
import twin.render as command
from optics.geometry.tree import Motion
from scenes.specs.instrument import BASE
from scenes.specs.load import EXAMPLES
from scenes.specs.resolved import resolve
from twin.main_job.render_job import render_job
from twin.pictures.light_paths import trace_light_paths
from twin.pictures.picture import SHOTS, PictureError, Shot, Studio, colour_variant, picture_setup, write_pictures
from twin.pictures.picture_scene import framed, looking, points_in_world
from twin.pictures.scene_file import build_scene, motions

SMALL = tuple(Shot(s.name, s.width // 10, s.height // 10, 2, 2, s.shows) for s in SHOTS)
LINE = 3.0
"""How far lines of light reach beyond the rays, pixels."""


@pytest.fixture(scope="module")
def paths(backend, gf7_pair):
    return trace_light_paths(gf7_pair, backend, {})


@pytest.fixture(scope="module")
def seen(backend, gf7_pair, paths):
    """What the pictures show -> number of the part in every pixel, their bodies, and the view; half the real size."""
    out = {}
    for shot in SHOTS:
        half = Shot(shot.name, shot.width // 2, shot.height // 2, 2, 2, shot.shows)
        out[shot.shows] = (*which_body(gf7_pair, paths, backend, half), picture_setup(gf7_pair, paths, half)[0])
    return out


def which_body(instrument, paths, backend, shot: Shot) -> tuple[np.ndarray, list[str]]:
    """What the middle of every pixel shows first: (height, width) number into the list of bodies, -1 for nothing."""
    view, parts = picture_setup(instrument, paths, shot)
    with colour_variant(backend) as mi:
        index, _ = Studio(mi, parts, view).first_hits(0.0, 0.0)
    return index, [part.body for part in parts]


def pixels_of(index: np.ndarray, bodies: list[str], wanted: str) -> np.ndarray:
    """Columns and rows of the pixels that show a body, (N, 2)."""
    numbers = [i for i, body in enumerate(bodies) if body == wanted]
    row, column = np.nonzero(np.isin(index, numbers))
    return np.stack([column, row], axis=-1) + 0.5


# --- where things are -------------------------------------------------------------------------------------------------


def test_the_camera_of_a_direction_holds_all_points():
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (200, 3)) * [3.0, 0.5, 1.0]
    view = framed(points, azimuth=-66.0, elevation=24.0, field=28.0, size=(1600, 1000), margin=0.04)
    place = view.project(points)
    free = 0.04 * 1600
    assert place.min() >= free - 1e-6
    assert np.all(place.max(axis=0) <= [1600 - free + 1e-6, 1000 - free + 1e-6])
    # and it cannot come nearer: one pair of opposite edges is touched on both sides
    gaps = [place.min(axis=0) - free, [1600 - free, 1000 - free] - place.max(axis=0)]
    assert np.any(np.abs(gaps).max(axis=0) < 1e-6)
    forward, right, up = looking(-66.0, 24.0)
    assert forward[2] == pytest.approx(-np.sin(np.radians(24.0)))
    assert right @ np.cross(forward, up) == pytest.approx(1.0)
    assert view.pixel_at(points) == pytest.approx(
        1.0 / np.hypot(*(view.project([right]) - view.project([[0.0, 0.0, 0.0]]))[0]), rel=0.01
    )


@pytest.mark.second
def test_every_body_is_where_its_mesh_is_projected_to(gf7_pair, paths, seen):
    """First hits of rays through Mitsuba's camera against vertices through ours."""
    points = points_in_world(build_scene(gf7_pair, paths))
    checked = 0
    for index, bodies, view in seen.values():
        for body, corners in points.items():
            found = pixels_of(index, bodies, body)
            depth = (corners - view.eye) @ view.forward
            if len(found) == 0 or depth.min() < 0.01:
                continue
            where = view.project(corners)
            assert np.all(found >= where.min(axis=0) - LINE), body
            assert np.all(found <= where.max(axis=0) + LINE), body
            checked += 1
    assert checked > 50
    with pytest.raises(ValueError, match="the prisms or the focal plane, not 'moon'"):
        picture_setup(gf7_pair, paths, Shot("moon.png", 10, 10, 2, 2, "moon"))


# --- how they look ----------------------------------------------------------------------------------------------------


class Seeded(Exception):
    """The number that a sampler is started with."""


def test_no_two_groups_of_pixels_share_their_samples():
    """Nor do two seeds, nor the samples of matt surfaces and of all else; a group has the same ones again."""

    def start(first: int, samples: int, seed: int) -> tuple[int, int]:
        def stop(number: int, count: int) -> None:
            raise Seeded(number, count)

        studio = object.__new__(Studio)
        studio._mi = SimpleNamespace(load_dict=lambda _: SimpleNamespace(seed=stop))
        with pytest.raises(Seeded) as caught:
            studio.light(np.arange(first, first + 6), samples, seed)
        return caught.value.args

    groups = [(0, 2, 1), (0, 2, 2), (0, 4, 1), (6, 2, 1)]
    numbers = [start(*group) for group in groups]
    assert len({number for number, _ in numbers}) == len(groups)
    assert [count for _, count in numbers] == [12, 12, 24, 12]
    assert [start(*group) for group in groups] == numbers


# --- Mitsuba's variants -----------------------------------------------------------------------------------------------


@pytest.mark.second
def test_the_former_variant_is_set_again(backend):
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono")
    with colour_variant(backend):
        assert mi.variant() == "llvm_ad_rgb"
    assert mi.variant() == "llvm_ad_mono"
    with pytest.raises(PictureError, match="out of memory"), colour_variant(backend):
        raise RuntimeError("out of memory")
    assert mi.variant() == "llvm_ad_mono"


def test_a_variant_that_is_not_there_is_an_error(backend, monkeypatch):
    import mitsuba as mi

    before = mi.variant()
    monkeypatch.setitem(picture_light.VARIANTS, "llvm", "llvm_ad_teal")
    with pytest.raises(PictureError, match="llvm_ad_teal"), colour_variant(backend):
        pytest.fail("no other variant may be taken")
    assert mi.variant() == before
    monkeypatch.setitem(picture_light.VARIANTS, "llvm", "scalar_rgb")
    monkeypatch.setattr(mi, "set_variant", lambda *_: None)
    with pytest.raises(PictureError, match="where scalar_rgb is needed"), colour_variant(backend):
        pytest.fail("no other variant may be taken")


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.mark.second
def test_the_command_writes_them_or_says_why_not(backend, tmp_path, monkeypatch):
    """Pictures that cannot be made cost the exit code and nothing else."""
    example = EXAMPLES / "perturb.yaml"
    done = render_job(resolve(example), backend, frames=1)
    monkeypatch.setattr(twin.main_job.render_command, "render_job", lambda *arguments, **options: done)
    # imported where they are asked for
    monkeypatch.setattr(picture_light, "write_pictures", partial(write_pictures, shots=SMALL))
    words = ["--frames", "1", "--picture", "--quiet"]
    result = CliRunner().invoke(command.app, [str(example), "--out", str(tmp_path / "run"), *words])
    assert result.exit_code == 0, result.output
    listed = json.loads((tmp_path / "run" / "manifest.json").read_text())["sha256"]
    for shot in SMALL:
        read = cv2.imread(str(tmp_path / "run" / shot.name))
        assert read.shape == (shot.height, shot.width, 3)
        assert read.std() > 5.0
        assert shot.name in listed
    monkeypatch.setitem(picture_light.VARIANTS, "llvm", "llvm_ad_teal")
    result = CliRunner().invoke(command.app, [str(example), "--out", str(tmp_path / "none"), *words])
    assert result.exit_code == 1
    assert re.search(r"error: the pictures are incomplete: .*llvm_ad_teal", result.stderr)
    kept = {path.name for path in (tmp_path / "none").iterdir()}
    assert {"manifest.json", "truth.json", "recovered.json", "scene.glb", "report.html"} <= kept
    assert not kept & {shot.name for shot in SMALL}


STATE = {
    "base/forward/M2": Motion(shift=(0.0, 0.0, 2e-3)),  # enough to be seen in a millimetre's tolerance
    "base/backward/focal_plane": Motion(rotate=(0.0, 0.0, 0.02)),
    "base/backward/monitor": Motion(shift=(0.0, 2e-3, 0.0)),
}


@pytest.fixture(scope="module")
def beams(backend, gf7_pair):
    small = {path: Motion(motion.rotate, (0.0, 0.0, 1e-5)) for path, motion in STATE.items() if "M2" in path}
    return trace_light_paths(gf7_pair, backend, small)


@pytest.fixture(scope="module")
def loaded(gf7_pair, beams, tmp_path_factory):
    """The scene of a state with large motions, written and read back."""
    placed = gf7_pair.assembly.place([STATE])
    scene = build_scene(gf7_pair, type(beams)(beams.beams, placed))
    scene.metadata["motions"] = motions(gf7_pair, STATE, placed)
    place = tmp_path_factory.mktemp("scene") / "scene.glb"
    place.write_bytes(scene.export(file_type="glb"))
    return trimesh.load_scene(place), placed


def test_every_body_is_a_node_where_it_stands(gf7_pair, loaded):
    scene, placed = loaded
    for body in gf7_pair.assembly.tree.bodies:
        assert body.path in scene.graph.nodes
        matrix, _ = scene.graph.get(body.path)
        pose = placed.pose(body.path)
        assert np.abs(matrix[:3, 3] - pose.translation).max() < 1e-6
        assert np.abs(matrix[:3, :3] - pose.rotation).max() < 1e-6
    assert scene.graph.transforms.parents["base/forward/M1"] == "base/forward"
    # only the glass of prisms is seen through
    modes = {name: part.visual.material.alphaMode for name, part in scene.geometry.items()}
    assert {name for name, mode in modes.items() if mode == "BLEND"} == {
        n for n in modes if "monitor/" in n and "base/" in n
    }


def drawn(told: dict, factor: float) -> np.ndarray:
    """A body's matrix in its parent when its motion is drawn ``factor`` times as large, as a viewer works it out."""
    nominal = np.array(told["nominal"]).reshape(4, 4).T
    turn = Rotation.from_rotvec(factor * np.array(told["rotate"])).as_matrix()
    pivot = np.array(told["pivot"])
    change = np.eye(4)
    change[:3, :3], change[:3, 3] = turn, pivot + factor * np.array(told["shift"]) - turn @ pivot
    return nominal @ change


def test_motions_can_be_drawn_larger(gf7_pair, loaded):
    """As they are they give the bodies' places, not at all the nominal ones; k times they are k times the job's."""
    scene, placed = loaded
    told = scene.metadata["motions"]
    assert set(told) == set(STATE)
    nominal = gf7_pair.assembly.place()
    for path, motion in STATE.items():
        parent = path.rpartition("/")[0]
        for factor, where in ((0.0, nominal), (1.0, placed)):
            pose = where.pose(parent).inverse() @ where.pose(path)
            matrix = drawn(told[path], factor)
            np.testing.assert_allclose(matrix[:3, :3], pose.rotation, atol=1e-12)
            np.testing.assert_allclose(matrix[:3, 3], pose.translation, atol=1e-12)
        np.testing.assert_allclose(told[path]["rotate"], motion.rotate, atol=1e-12)
        np.testing.assert_allclose(told[path]["shift"], motion.shift, atol=1e-12)
    larger = {
        path: Motion(tuple(7.0 * np.array(m.rotate)), tuple(7.0 * np.array(m.shift))) for path, m in STATE.items()
    }
    seven = gf7_pair.assembly.place([larger])
    for path in STATE:
        parent = path.rpartition("/")[0]
        pose = seven.pose(parent).inverse() @ seven.pose(path)
        np.testing.assert_allclose(drawn(told[path], 7.0)[:3, 3], pose.translation, atol=1e-12)


def test_beams_go_where_they_must(gf7_pair, beams):
    """Imaging beams fill the stop and end on the line CCD, monitor beams on their area CCD; none leaves an aperture."""
    for beam in beams.beams:
        model = gf7_pair.cameras[beam.camera]
        for (mirror, _), points in beam.footprints.items():
            x0, x1, y0, y1 = model.apertures[mirror].bounds
            assert np.all(points >= np.array([x0, y0]) - 1e-5)
            assert np.all(points <= np.array([x1, y1]) + 1e-5)
        if beam.is_monitor:
            assert len(beam.footprints) == 2 * len(model.mirrors)
            mine = (c for c in gf7_pair.channels if f"{c.camera}/monitor/{c.name}" == f"{beam.camera}/{beam.name}")
            channel = next(mine)
            ccd = beams.placed.pose(channel.ccd_body).inverse().apply(beam.vertices[:, -1])
            assert np.abs(ccd).max() < 1e-3
        else:
            plane = beams.placed.pose(f"{BASE}/{beam.camera}/focal_plane").inverse().apply(beam.vertices[:, -1])
            assert np.abs(plane[:, [0, 2]]).max() < 1e-9
            half = 0.5 * model.spec.line.pixels * model.spec.line.pitch
            share = {"left edge": 1.0, "centre": 0.0, "right edge": -1.0}[beam.name.rpartition("/")[2]]
            assert plane[:, 1] == pytest.approx(share * half, abs=1e-9)
            stop = beam.footprints[model.spec.stop, 0]
            radius = model.apertures[model.spec.stop].bounds[1]
            assert np.linalg.norm(stop[1:], axis=1) == pytest.approx(radius, abs=2e-6)
            rays = np.diff(beam.vertices[:, :2], axis=1)[:, 0]
            angle = rays @ rays[0] / np.linalg.norm(rays, axis=1) / np.linalg.norm(rays[0])
            assert np.all(angle > 1 - 1e-9)  # collimated toward the scene
