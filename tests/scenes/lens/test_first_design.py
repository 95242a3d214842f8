"""First designs of telescopes: exact first order, third order that vanishes, and files that the commands read."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import optics
from optics.camera.telescopes import TELESCOPES, first_design
from scenes.lens.__main__ import app
from scenes.specs.load import load_camera
from tests.tiers import quick
from twin.camera.aberrations import distortion
from twin.camera.camera_optics import CameraOptics
from twin.camera.first_order_data import first_order_data

WAVE = 650e-9
SHARP = 0.0714
"""Wavefront error of a Strehl ratio of 0.8, waves rms (Marechal)."""
SIZES = [(kind, *size) for size in ((0.5, 10.0), (0.2, 15.0), (0.8, 12.0)) for kind in TELESCOPES]


@pytest.mark.parametrize(("kind", "aperture", "f_number"), quick(6, SIZES))
def test_a_design_has_its_focal_length_and_is_sharp(kind: str, aperture: float, f_number: float) -> None:
    camera = first_design(kind, aperture, f_number, WAVE)
    assert camera.focal_length == pytest.approx(f_number * aperture, rel=1e-9)
    assert camera.entrance_pupil_diameter == pytest.approx(aperture, rel=1e-9)
    field = (0.0, TELESCOPES[kind].bias / f_number)
    assert optics.wavefront(camera, field).rms < SHARP * WAVE
    if kind not in ("off-axis", "triplet"):  # whose higher orders are corrected as well
        free = sum(conic is None for conic in TELESCOPES[kind].conics)
        sums = optics.seidel(camera, 0.01)
        assert np.max(np.abs(sums.sums.sum(axis=0)[:free])) < 1e-12 * np.max(np.abs(sums.sums))


def test_conics_of_an_aplanat_are_those_of_the_textbook() -> None:
    """Schroeder, Astronomical Optics (2nd ed.), table 6.4, with magnification m and beta = behind / f1."""
    aperture, f_number, primary, behind = 0.5, 10.0, 3.0, 0.45
    m1, m2 = first_design("ritchey-chretien", aperture, f_number, WAVE, primary, behind).surfaces
    m, beta = f_number / primary, behind / (primary * aperture)
    assert m1.conic == pytest.approx(-1.0 - 2.0 * (1.0 + beta) / (m**2 * (m - beta)), rel=1e-9)
    second = -(((m + 1.0) / (m - 1.0)) ** 2) - 2.0 * m * (m + 1.0) / ((m - beta) * (m - 1.0) ** 3)
    assert m2.conic == pytest.approx(second, rel=1e-9)
    classical = first_design("cassegrain", aperture, f_number, WAVE, primary, behind).surfaces[1]
    assert classical.conic == pytest.approx(-(((m + 1.0) / (m - 1.0)) ** 2), rel=1e-9)


@pytest.mark.parametrize("kind", TELESCOPES)
def test_a_file_of_a_new_telescope_is_read_at_once(kind: str, tmp_path: Path, backend) -> None:
    out = tmp_path / "mine.yaml"
    words = ["new", kind, "--out", str(out), "--aperture", "0.4 m", "--f-number", "12"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    spec = load_camera(str(out))
    assert spec.name == "mine"
    found = CameraOptics.alone(spec, backend)
    assert found.model.paraxial.focal_length == pytest.approx(4.8, rel=1e-9)
    assert max(found.wavefront((x, 0.0), points=3).rms for x in (0.0, 1.0)) < SHARP
    # no mirror needs another hole than the file's, and radii are written without float noise
    assert not first_order_data(found).obscuration.holes
    assert not re.search(r"\.\d*(9{6}|0{6})", out.read_text())
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 2
    assert "the file exists" in again.output
    assert CliRunner().invoke(app, [*words, "--force"]).exit_code == 0


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["newton"], "there is no telescope 'newton'; there are prime-focus, cassegrain"),
        (["cassegrain", "--primary", "12"], "the F-number of the primary must lie between 0 and 10"),
        (["cassegrain", "--behind", "40 m"], "the focus can lie 0 to 3.5 m behind the primary"),
        (["cassegrain", "--aperture", "3"], "--aperture"),
        (["cassegrain", "--field", "0 deg"], "--field is not greater than zero"),
    ],
)
def test_a_telescope_that_cannot_be_is_refused(words: list[str], problem: str, tmp_path: Path) -> None:
    out = tmp_path / "mine.yaml"
    done = CliRunner().invoke(app, ["new", *words, "--out", str(out)], env={"COLUMNS": "200"})
    assert done.exit_code == 2
    assert problem in " ".join(done.output.split())
    assert not out.exists()


@pytest.mark.parametrize("name", ["korsch", "ritchey_chretien", "gf7"])
def test_an_upright_image_has_a_distortion_like_an_inverted_one(name: str, backend) -> None:
    """A Korsch telescope has an intermediate image, which turns its image over."""
    found = distortion(CameraOptics.alone(load_camera(name), backend))
    spec = load_camera(name)
    assert found.line_distance == pytest.approx(spec.focal_length, rel=0.03)
    assert found.distance == pytest.approx(spec.focal_length, rel=0.05)
    assert found.largest < 1e-2 * float(np.ptp(found.position))


def test_a_triplet_is_a_lens_that_can_be_made_and_brings_two_colours_together() -> None:
    """F/5 of 0.1 m over 10 degrees: sharp on the axis but for the last tenth, nearly so at the edge."""
    camera = first_design("triplet", 0.02, 5.0, WAVE, half_field=np.radians(5.0))
    assert camera.focal_length == pytest.approx(0.1, rel=1e-9)
    assert camera.f_number == pytest.approx(5.0, rel=1e-9)
    assert optics.wavefront(camera, (0.0, 0.0)).rms < 1.1 * SHARP * WAVE
    assert optics.wavefront(camera, (0.0, np.radians(5.0))).rms < 2.0 * SHARP * WAVE
    blue, red = (camera.at(WAVE * ratio).refocused().vertices[-1] for ratio in (1.0 / 1.12, 1.12))
    single = 0.1 / 60.0 * 0.4  # axial colour of one lens of crown over these wavelengths, from its Abbe number
    assert abs(blue - red) < 0.3 * single  # paraxial colour balances that of the rim at F/5
    for k, (surface, behind) in enumerate(zip(camera.surfaces, camera.surfaces[1:], strict=False)):
        sag = [0.5 * 0.0121**2 / one.radius for one in (surface, behind)]  # where the marginal beam and the field pass
        assert surface.thickness - sag[0] + sag[1] > 0.0, k


def test_a_triplet_of_one_wavelength_is_another_than_that_of_its_neighbour() -> None:
    """The index of each glass is that of the design wavelength, in vacuum."""
    short, long = (first_design("triplet", 0.05, 8.0, wave) for wave in (550e-9, 850e-9))
    assert short.surfaces[0].radius != pytest.approx(long.surfaces[0].radius, rel=1e-4)
    assert long.at(550e-9).focal_length != pytest.approx(0.4, rel=1e-6)
