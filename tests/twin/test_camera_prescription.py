"""A camera's file as a camera of the library `optics`: the same light, and refusals of what that cannot describe."""

from pathlib import Path

import numpy as np
import pytest

import optics
import twin
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml, read_yaml

LENS = """
name: doublet
focal_length: 0.1 m
entrance_pupil: 10 mm
field: {x: 1 deg, y: 0.5 deg}
wavelength: 588 nm
stop: front
medium: air
mirrors:
  front: {z: 0 m, radius: 0.1 m, light: refracts, glass: N-BK7}
  cut: {z: 2 mm, radius: flat, light: passes, edges: [{clear: circle, radius: 20 mm}]}
  back: {z: 4 mm, radius: -0.1068 m, light: refracts, index: 1}
image: {z: 0.1 m}
line: {pixels: 500, pitch: 7 um}
"""


@pytest.mark.second
@pytest.mark.parametrize("name", ["ritchey_chretien", "gf7"])
def test_light_is_that_of_the_twin(name: str) -> None:
    """One on its axis with a spider, the other off its axis; first-order data and light of three fields."""
    camera = twin.load_camera(name)
    same = camera.prescription
    assert same.focal_length == pytest.approx(camera.first_order["focal_length_m"], rel=1e-9)
    assert same.entrance_pupil_diameter == pytest.approx(camera.first_order["entrance_pupil_m"], rel=1e-3)
    for field in ((0.0, 0.0), (1.0, 0.0), (0.5, -1.0)):
        expected, angles = camera.wavefront(field, points=3), camera.field_angles(field)
        error = optics.wavefront(same, angles)
        assert error.rms / same.wavelength == pytest.approx(expected.rms, abs=1e-9)  # waves
        assert error.light == pytest.approx(1.0 - expected.vignetted, abs=1e-9)
    # x is along the line and y along the track, as in the twin
    along, across = (optics.mtf(same, 30e3, angles, azimuth)[0] for azimuth in (0.0, 0.5 * np.pi))
    assert (along, across) == pytest.approx(tuple(camera.mtf(field, 30e3).values[:, 0]), abs=1e-7)


def test_lenses_keep_their_glass_and_the_colour_of_the_camera(tmp_path: Path) -> None:
    file = tmp_path / "lens.yaml"
    file.write_text(LENS)
    camera = twin.load_camera(file).refocused()
    same = camera.at("486 nm").prescription
    assert [surface.material for surface in same.surfaces] == ["N-BK7", "N-BK7", 1.0]
    assert same.surfaces[1].diameter == pytest.approx(0.04)
    error = optics.wavefront(same, camera.field_angles("0.5 0.2 deg"))
    # the twin's reference sphere has the radius of the exit pupil at the design wavelength
    expected = camera.at("486 nm").wavefront("0.5 0.2 deg", points=3).rms
    assert error.rms / 486e-9 == pytest.approx(expected, rel=1e-6)
    assert 0.0 < optics.ensquared_energy(optics.psf(camera.prescription, 1e-6, count=65), 1e-6, 7e-6)[0] < 1.0
    assert optics.seidel(camera.prescription, field=0.01).wavefront.shape == (3, 5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sag": {"polynomial": {"xy": "1e-6 1/m"}}}, "M1 has further terms of its sag"),
        ({"edges": [{"clear": "rectangle", "half": ["0.2 m", "0.3 m"]}]}, "cannot describe the edges of M1"),
        ({"edges": [{"blocks": "circle", "radius": "60 mm", "centre": ["10 mm", "0 mm"]}]}, "the edges of M1"),
    ],
)
def test_what_optics_cannot_describe_is_refused(tmp_path: Path, change: dict, message: str) -> None:
    plain = dict(read_yaml(Path("scenes/library/cameras/ritchey_chretien.yaml")).data)
    plain["mirrors"]["M1"] |= change
    file = tmp_path / "rc.yaml"
    file.write_text(dump_yaml(plain))
    with pytest.raises(InputError, match=message):
        twin.load_camera(file).prescription  # noqa: B018


def test_a_perturbed_camera_is_refused() -> None:
    bent = twin.load_camera("ritchey_chretien").perturbed("M2 shift z 20 um")
    with pytest.raises(ValueError, match="describes the nominal camera"):
        bent.prescription  # noqa: B018


@pytest.mark.second
def test_prisms_in_the_beam_are_refused() -> None:
    pair = twin.load("gf7_pair")
    with pytest.raises(ValueError, match="prisms of the instrument"):
        pair.camera("forward").prescription  # noqa: B018
    assert pair.camera("forward", obstruction=False).prescription.focal_length == pytest.approx(5.52, rel=0.02)
