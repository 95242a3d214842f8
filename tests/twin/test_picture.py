"""Pictures of the instrument: everything is where the prescription puts it, the same again, and nothing is lost."""

import json
import re
from functools import partial

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import twin.main_job.render_command
import twin.pictures.picture
import twin.pictures.picture as picture_light
import twin.render as command
from scenes.specs.load import EXAMPLES
from scenes.specs.resolved import resolve
from twin.main_job.render_job import render_job
from twin.pictures.light_paths import trace_light_paths
from twin.pictures.picture import (
    SHOTS,
    PictureError,
    Shot,
    Studio,
    colour_variant,
    staged,
    still_patches,
    without_grain,
    write_pictures,
)
from twin.pictures.picture_scene import framed, looking, points_in_world
from twin.pictures.scene_file import build_scene

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
        out[shot.shows] = (*which_body(gf7_pair, paths, backend, half), staged(gf7_pair, paths, half)[0])
    return out


def which_body(instrument, paths, backend, shot: Shot) -> tuple[np.ndarray, list[str]]:
    """What the middle of every pixel shows first: (height, width) number into the list of bodies, -1 for nothing."""
    view, parts = staged(instrument, paths, shot)
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


# --- how they look ----------------------------------------------------------------------------------------------------


def test_grain_is_taken_off_matt_patches_only():
    noise = np.random.default_rng(2).normal(0.5, 0.1, (60, 80, 3))
    noise[:, 40:] += 0.4
    part, normal = np.zeros((60, 80), int), np.zeros((60, 80, 3))
    part[:, 40:], part[:, 70:] = 1, 2
    patches = still_patches([(part, normal)], [True, True, False])
    smooth = without_grain(noise, patches)
    assert np.all(patches[:, 69:] == -1)  # no matt surface
    assert np.all(patches[:, 39:41] == -1)  # a border
    assert np.array_equal(smooth[patches == -1], noise[patches == -1].astype(np.float32))
    assert smooth[:, :39].std() < 0.03
    assert smooth[:, :39].mean() == pytest.approx(0.5, abs=0.01)  # nothing comes over the border
    assert smooth[:, 41:69].mean() == pytest.approx(0.9, abs=0.01)


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
    assert re.search(r"error: the pictures are not complete: .*llvm_ad_teal", result.stderr)
    kept = {path.name for path in (tmp_path / "none").iterdir()}
    assert {"manifest.json", "truth.json", "recovered.json", "scene.glb", "report.html"} <= kept
    assert not kept & {shot.name for shot in SMALL}
