"""An instrument as built is, at rest, its drawing in that state: lines of sight, spots, wavefronts, images, bodies."""

import numpy as np
import pytest

from optics.geometry.tree import Motion, compose
from scenes.models.instrument_builder import build_instrument, facet_alignment
from scenes.models.obstruction import convex_bodies
from scenes.specs.instrument import as_built_file
from scenes.specs.load import load_cameras, load_instrument
from scenes.specs.resolved import resolve, resolve_camera
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml
from tests.scenes.lens.colour_cameras import colour_camera
from tests.twin.study_bench import TEXTS
from twin.camera.camera_optics import CameraOptics
from twin.camera.camera_run import run_camera
from twin.main_job.render_job import render_job
from twin.monitor.monitor_path import MonitorPath
from twin.monitor.truth import LINE_POINTS, LineSight

THEN = {
    "base/forward/M2": Motion((1e-5, 2e-5, 0.0), (1e-6, 0.0, 3e-6), "centre", radius=1e-5, figure={5: 1e-8, 7: 2e-9}),
    "base/forward/focal_plane": Motion((1e-5, 0.0, 2e-5), (0.0, 1e-6, 0.0), "origin"),
    "base/backward": Motion(shift=(1e-6, 2e-6, 0.0)),
}
ROUNDING = 1e-14
"""Of unit vectors and of metres in a path of ten metres: some tens of the last digit."""


def read(folder, text: str, name: str = "own.yaml"):
    (folder / name).write_text(text)
    return load_instrument(folder / name)


@pytest.fixture(scope="module")
def pair(backend, tmp_path_factory):
    """The instrument as drawn and as built, and states of both that are the same: as built, and moved on top of it."""
    spec = read(tmp_path_factory.mktemp("pair"), TEXTS["as_built"])
    cameras = load_cameras(spec)
    drawn, built = (
        build_instrument(one, cameras, backend) for one in (spec.model_copy(update={"as_built": None}), spec)
    )
    bodies = {body.path: body for body in drawn.assembly.tree.bodies}
    assert len(built.as_built) == 5
    return drawn, built, [(built.as_built, {}), (compose(built.as_built, THEN, bodies), THEN)]


@pytest.mark.second
def test_lines_of_sight(backend, pair) -> None:
    drawn, built, states = pair
    of_drawing, own = LineSight(drawn, backend), LineSight(built, backend)
    for there, here in states:
        seen = own.trace([here])
        np.testing.assert_allclose(seen, of_drawing.trace([there]), rtol=0.0, atol=ROUNDING)
        # no state that would be nothing: arcseconds
        assert np.max(np.abs(seen - of_drawing.nominal)) > 1e-6


@pytest.mark.second
def test_spots_through_all_prisms(backend, pair) -> None:
    drawn, built, states = pair
    there, here = ([state[k] for state in states] for k in (0, 1))
    places = MonitorPath(built, backend).coarse_trace(here).centre
    # pixels of 12 um
    np.testing.assert_allclose(
        places, MonitorPath(drawn, backend).coarse_trace(there).centre, rtol=0.0, atol=ROUNDING / 12e-6
    )
    at_rest = MonitorPath(drawn, backend).coarse_trace([{}]).centre
    assert np.all(np.max(np.abs(places[:, :1] - at_rest), axis=-1) > 0.5)


@pytest.mark.second
def test_bodies_that_are_drawn_and_hit(pair) -> None:
    drawn, built, ((there, _), _) = pair
    found, expected = convex_bodies(built), convex_bodies(drawn, drawn.assembly.place([there]))
    moved = convex_bodies(drawn)
    for path, corners in found.items():
        np.testing.assert_allclose(corners, expected[path], rtol=0.0, atol=ROUNDING)
    assert (
        np.max(np.abs(found["base/forward/monitor/left/prism_180"] - moved["base/forward/monitor/left/prism_180"]))
        > 1e-5
    )


def test_changes_count_from_its_own_line_of_sight(backend, pair) -> None:
    """Axes are those of the line of sight as built, which arcseconds separate from the drawn ones."""
    _, built, _ = pair
    sight = LineSight(built, backend)
    for k, name in enumerate(built.cameras):
        axes, line = sight.axes[name], sight.nominal[k, 0, LINE_POINTS // 2]
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), rtol=0.0, atol=ROUNDING)
        np.testing.assert_allclose(axes[:, 2], line, rtol=0.0, atol=ROUNDING)
        assert np.linalg.det(axes) > 0.0
        assert np.linalg.norm(built.camera_axes(name)[:, 2] - line) < 1e-4
    change = sight.truth([{}, {"base/forward": Motion((0.0, 1e-6, 0.0))}]).cameras["forward"].vector
    np.testing.assert_allclose(change[0], 0.0, atol=ROUNDING)
    # a turn of the camera about its own Y, which is square to the line of sight but for arcseconds
    np.testing.assert_allclose(change[1, :3], [1e-6, 0.0, 0.0], rtol=0.0, atol=1e-10)


@pytest.mark.second
def test_nothing_built_changes_nothing(backend, tmp_path) -> None:
    spec = read(tmp_path, "name: own\ndesign: gf7_pair\nas_built: {}\n")
    cameras = load_cameras(spec)
    one, other = (build_instrument(s, cameras, backend) for s in (spec, load_instrument("gf7_pair")))
    here, there = one.assembly.place(), other.assembly.place()
    assert np.array_equal(here.rotation, there.rotation)
    assert np.array_equal(here.translation, there.translation)
    assert one.assembly.elements == other.assembly.elements
    assert one.assembly.media == other.assembly.media


def test_a_lens_has_the_index_that_it_was_made_with(backend, tmp_path) -> None:
    (tmp_path / "lens.yaml").write_text(dump_yaml(colour_camera("achromat").plain()))
    spec = read(tmp_path, "name: own\ndesign: lens.yaml\nas_built: [L1 index 1e-4, L3 radius 200 ppm]\n")
    cameras = load_cameras(spec)
    drawn, built = (
        build_instrument(one, cameras, backend) for one in (spec.model_copy(update={"as_built": None}), spec)
    )
    state = {"base/achromat/L1": Motion(index=1e-4), "base/achromat/L3": Motion(radius=200e-6)}
    assert built.as_built == state
    for colour in (486.1327e-9, 587.5618e-9):
        one = CameraOptics.within(built, "achromat", backend).at(colour).wavefront()
        other = CameraOptics.within(drawn, "achromat", backend, state).at(colour).wavefront()
        plain = CameraOptics.within(drawn, "achromat", backend).at(colour).wavefront()
        np.testing.assert_allclose(one.coefficients, other.coefficients, rtol=0.0, atol=ROUNDING / colour)
        assert abs(one.coefficients[3] - plain.coefficients[3]) > 0.05


@pytest.mark.second
def test_facets_are_squared_to_cameras_as_built(backend, pair, tmp_path) -> None:
    """A camera that is arcminutes off throws its spots off their CCDs, until its facets are mounted to it."""
    text = "name: own\ndesign: gf7_pair\nas_built: {backward: {rotate: 10 20 5 arcsec}}\n"
    job = tmp_path / "job.yaml"
    job.write_text("instrument: own.yaml\nrender: {frames: 1}\n")
    spec = read(tmp_path, text)
    with pytest.raises(
        InputError, match=r"own.yaml:3: as_built.backward: the monitor of the instrument as built does not work"
    ):
        render_job(resolve(job), backend)
    built = build_instrument(spec, load_cameras(spec), backend)
    turns = facet_alignment(built, backend)
    assert set(turns) == {channel.face_body for channel in built.channels}
    bodies = {body.path: body for body in built.assembly.tree.bodies}
    whole = read(tmp_path, as_built_file("own", "gf7_pair", compose(built.as_built, turns, bodies)))
    square = build_instrument(whole, load_cameras(whole), backend)
    middle = MonitorPath(square, backend).coarse_trace([{}]).centre
    drawn = MonitorPath(pair[0], backend).coarse_trace([{}]).centre
    # the chief ray meets the middle of the CCD; the mean of the beam is as far off it as in the drawing
    np.testing.assert_allclose(middle, drawn, rtol=0.0, atol=0.02)


@pytest.mark.second
def test_a_camera_as_built_is_refocused_as_it_is(backend, tmp_path, monkeypatch) -> None:
    """M2 built 30 um too far: the same move as for a camera that is perturbed by as much."""
    monkeypatch.setattr("twin.camera.camera_run.MAX_WAVES_FOR_MTF", 0.0)  # no MTF, which takes most of the time
    built = tmp_path / "built.yaml"
    built.write_text("name: own\ndesign: {camera: gf7}\nas_built: [M2 shift z 30 um]\n")
    found = run_camera(resolve_camera(built), backend, refocus=True)
    moved = run_camera(resolve_camera("gf7").perturbed(["M2 shift z 30 um"]), backend, refocus=True)
    assert found.refocus.motion.shift[2] == pytest.approx(moved.refocus.motion.shift[2], rel=1e-6)
    assert found.errors == pytest.approx(moved.errors, abs=1e-9)
