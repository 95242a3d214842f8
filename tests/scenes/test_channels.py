"""Channels of a camera's monitor as a file gives them: where they may not stand, and where the file is told so."""

import pytest

from scenes.models.obstruction import check_beams, find_obstructions
from tests.scenes import monitor_layouts

NAMES = ("left", "right", "left_2", "right_2")


@pytest.fixture(scope="module")
def model(backend, tmp_path_factory):
    return monitor_layouts.built(monitor_layouts.two_beams(), tmp_path_factory.mktemp("two"), backend)


@pytest.mark.second
def test_two_beams_stand_clear(model, backend) -> None:
    assert [c.key for c in model.channels] == [f"{c}/{name}" for c in ("forward", "backward") for name in NAMES]
    check_beams(model, backend)
    found = find_obstructions(model, backend)
    assert {o.beam for o in found} == {"forward/imaging", "backward/imaging"}
    # what is not in the monitor's own part of the pupil is only just touched
    prisms = {c.prism_body("prism_180") for c in model.channels}
    assert prisms <= {o.body for o in found}
    assert all(o.body in prisms or o.share < 0.01 for o in found)
    # each 180-deg prism stands where its own channel says
    for channel in model.channels:
        given = model.spec.channels_of(channel.camera)[channel.name]
        window = model.assembly.nominal_pose(f"{channel.prism_body('prism_180')}/window/entry").translation
        home = model.assembly.nominal_pose(f"base/{channel.camera}")
        assert home.inverse().apply(window)[2] == pytest.approx(given.prism_180.distance, abs=0.01)
        assert model.assembly.elements[f"{channel.key}/return_face"].aperture.radius == 0.5 * channel.aperture
