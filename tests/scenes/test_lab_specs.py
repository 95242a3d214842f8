"""Files of the laboratory's focus test: what they may say, and how they say what is wrong."""

from pathlib import Path

import numpy as np
import pytest

from scenes.specs.camera_tests import FocusTestSpec
from scenes.specs.load import LAB, SCENES, library_names
from scenes.specs.resolved import resolve_focus
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import dump_yaml, parse_yaml

FILE = SCENES / LAB / "focus.yaml"


def test_the_file_and_what_it_refers_to() -> None:
    assert "focus" in library_names(LAB)
    setup = resolve_focus(FILE)
    assert list(setup.camera.bands) == ["P", "B1", "B2", "B3", "B4"]
    assert set(setup.detectors) == {band.detector for band in setup.camera.bands.values()}
    collimator = setup.test.collimator.model
    assert (collimator.focal_length, collimator.radius) == (20.0, 0.4)
    # 10 nm rms, as the comment beside it says
    assert np.sqrt(sum(v**2 for v in collimator.wavefront.values())) == pytest.approx(10e-9, rel=0.02)


def test_it_reads_back(tmp_path: Path) -> None:
    setup = resolve_focus(FILE)
    again = validate(FocusTestSpec, parse_yaml(dump_yaml(setup.test.plain())))
    assert again == setup.test
    assert hash(again) == hash(setup.test)
    config = tmp_path / "config.yaml"
    config.write_text(setup.with_seed(17).to_yaml(), "utf-8")
    read = resolve_focus(config)
    assert read.test == setup.test.model_copy(update={"seed": 17})
    assert read.camera == setup.camera
    assert dict(read.detectors) == dict(setup.detectors)


def test_bands_at_one_place_cannot_tell_a_tilt(tmp_path: Path) -> None:
    setup = resolve_focus(FILE)
    alone = setup.camera.model_copy(update={"bands": type(setup.camera.bands)({"P": setup.camera.bands["P"]})})
    config = tmp_path / "config.yaml"
    config.write_text(setup.model_copy(update={"camera": alone}).to_yaml(), "utf-8")
    with pytest.raises(InputError, match="at one X', so the tilt about the line cannot be told"):
        resolve_focus(config)
