"""Shadows that images do not hold are told with their cause: parts that no edge states, bodies that have moved."""

import re

import pytest

from optics.geometry.tree import Motion
from scenes.models.camera_model import derive_camera
from scenes.models.obstruction import moved_into_beams
from scenes.specs.job import JobSpec
from scenes.specs.load import CAMERAS, LIBRARY, library_names, load_camera
from scenes.specs.resolved import resolve_job
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import YamlFile
from twin.camera.first_order_data import obscuration, unstated_shadows
from twin.main_job.render_job import render_job

RC = "ritchey_chretien"


def without_edges(folder) -> str:
    """The library's telescope in a file that says nothing of its secondary mirror's shadow."""
    text = (LIBRARY / CAMERAS / f"{RC}.yaml").read_text("utf-8")
    text = re.sub(r"  spider:\n(    .*\n)+", "", text).replace(", edges: [{blocks: circle, radius: 60 mm}]", "")
    assert "blocks" not in text
    (folder / "bare.yaml").write_text(text, "utf-8")
    return str(folder / "bare.yaml")


@pytest.mark.parametrize("name", library_names("cameras"))
def test_cameras_of_the_library_state_their_shadows(name: str, backend) -> None:
    model = derive_camera(load_camera(name), backend)
    found = obscuration(model, backend)
    assert not unstated_shadows(model, found)
    # a mirror about its axis is round, and within the round shadow that its file states but for its margin: of korsch,
    # whose field is beside the axis, (79.9^2 - 75^2) / (250^2 - 75^2) mm^2 = 1.33 %; the corners of a square would take
    # 3 %
    assert max(found.shares.values(), default=0.0) < (0.015 if name == "korsch" else 0.01)


@pytest.mark.second
def test_a_mirror_in_the_beam_that_no_edge_states_is_told(tmp_path, backend) -> None:
    data = {"instrument": without_edges(tmp_path), "perturb": ["M2 shift z 5 um"]}
    run = render_job(resolve_job(validate(JobSpec, YamlFile("", data, {}))), backend)
    (told,) = (text for text in run.warnings if "its own parts stand in its beam" in text)
    # the round mirror of 0.3 of the diameter, the field and the margin about it, by 4000 rays
    share = float(re.search(r"M2 ([\d.]+)%", told)[1])
    beam, field, margin = 0.3 * 0.5, 2.0 * 1.05 * 0.00264, 0.01
    assert share == pytest.approx(100.0 * (beam + field + margin) ** 2 / 0.5**2, abs=0.2)
    assert "a pupil without that shadow" in told
    run = render_job(resolve_job(validate(JobSpec, YamlFile("", {**data, "instrument": RC}, {}))), backend)
    assert not any("its own parts" in text for text in run.warnings)


def test_what_has_moved_into_a_monitors_beam_is_told(gf7_pair, backend) -> None:
    """A housing that its camera carries through the beams; the motions that jobs are about take nothing."""
    found = moved_into_beams(gf7_pair, backend, {"base/backward": Motion(shift=(0.05, 0.0, 0.0))})
    assert [text.partition(":")[0] for text in found] == ["backward/left", "backward/right"]
    assert all("backward_housing has moved into the beam" in text for text in found)
    small = {
        "base/forward/M2": Motion(shift=(5e-6, 5e-6, 40e-6), rotate=(1e-5, 0.0, 0.0)),
        "base/forward/focal_plane": Motion(rotate=(1e-5, 1e-5, 5e-5)),
        "base/forward": Motion(stretch=1e-4),
        "base/forward/monitor/left/prism_180/exit": Motion(figure={4: 1e-6}),
    }
    known = {body.path for body in gf7_pair.assembly.tree.bodies}
    assert moved_into_beams(gf7_pair, backend, {path: one for path, one in small.items() if path in known}) == ()
    assert moved_into_beams(gf7_pair, backend, {}) == ()
