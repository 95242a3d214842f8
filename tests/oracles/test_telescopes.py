"""Obscured telescopes against other people's software: MTF by an FFT of batoid's rays over the true pupil, poppy's
spider, annular Zernike terms of batoid.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from optics.numerics.backend import Backend
from scenes.lens.batoid_reader import read_batoid
from scenes.lens.camera_reader import Width, camera_of
from scenes.lens.camera_writer import batoid_text, prescription_of
from scenes.models.camera_model import derive_camera, field_direction
from scenes.specs.load import load_camera
from tests.oracles.pupil_raster import PupilRaster, raster
from twin.camera.camera_optics import CameraOptics

pytestmark = pytest.mark.oracle

HERE = Path(__file__).parent / "telescopes"
OWN: dict[str, str | Path] = {
    "cassegrain": "cassegrain",
    "ritchey_chretien": "ritchey_chretien",
    "korsch": "korsch",
    "maksutov": HERE / "maksutov.yaml",
    "schmidt_cassegrain": HERE / "schmidt_cassegrain.yaml",
}
TOLD = 1e-3
"""What the MTF is to be right to. The raster's own error, of 384 cells with their shares at edges, is some 1e-4, and
6e-4 for a vane along its rows."""
LSST = "LSST/LSST_r.yaml", 622e-9, 8.36, 1.75
OVER = np.array([1.0, -1.0, -1.0])


def data(name: str) -> Path:
    """Return the path of a file of batoid's."""
    return Path(pytest.importorskip("batoid").__file__).parent / "data" / name


@cache
def own_telescope(backend: Backend, name: str, folder: Path) -> tuple[CameraOptics, Any]:
    """A camera's file here, and what batoid makes of the same prescription."""
    optics = CameraOptics.alone(load_camera(OWN[name]), backend)
    text, notes = batoid_text(prescription_of(optics.model))
    assert not notes
    path = folder / f"{name}.yaml"
    path.write_text(text, "utf-8")
    return optics, pytest.importorskip("batoid").Optic.fromYaml(str(path))


@cache
def batoids_telescope(backend: Backend, name: str, wavelength: float, pupil: float, largest: float) -> CameraOptics:
    """A telescope of batoid's as a camera, over the square in its round field."""
    path = data(name)
    end = np.radians(largest)
    lens = replace(read_batoid(path, wavelength), fields=((0.0, 0.0), (0.0, end), (0.0, -end), (end, 0.0)))
    return CameraOptics.alone(
        derive_camera(camera_of(lens, "telescope", backend, Width(pupil)).camera, backend), backend
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("telescopes")


def its_raster(optics: CameraOptics, peer: Any, field: tuple[float, float], room: float = 1.05) -> PupilRaster:
    spec = optics.model.spec
    heading = OVER * field_direction(spec, field[0] * spec.field.x, field[1] * spec.field.y)
    return raster(peer, spec.wavelength, heading, 0.5 * room * spec.entrance_pupil)


@pytest.mark.second
@pytest.mark.parametrize(("name", "field"), [*((name, (-1.0, -1.0)) for name in OWN), ("lsst", (1.0, 0.0))])
def test_mtf_as_by_an_fft_of_batoids_pupil(backend, folder, name, field) -> None:
    """Of LSST at F/1.2, whose field of 2.5 deg surfaces vignette, by batoid's own file."""
    if name == "lsst":
        optics = batoids_telescope(backend, *LSST)
        peer = pytest.importorskip("batoid").Optic.fromYaml(str(data(LSST[0])))
    else:
        optics, peer = own_telescope(backend, name, folder)
    grid = its_raster(optics, peer, field)
    shifts = grid.shifts(30)
    mtf = optics.mtf(field, shifts * grid.step / grid.wavelength)
    np.testing.assert_allclose(mtf.values, grid.mtf(shifts), rtol=0, atol=TOLD)
    np.testing.assert_allclose(mtf.limit, grid.mtf(shifts, perfect=True), rtol=0, atol=TOLD)
    # frequencies up to the cut-off and beyond, and a contrast that says something
    assert np.all(mtf.values[:, -1] < 1e-9)
    assert np.min(mtf.values[:, 1]) > 0.2
    assert 0.0 < mtf.accuracy < TOLD


@pytest.mark.second
@pytest.mark.parametrize("name", ["ritchey_chretien", "maksutov"])
def test_mtf_at_uneven_frequencies_as_by_an_fft_of_batoids_pupil(backend, folder, name) -> None:
    """By pieces of shadows, as images have it; at even steps it is by lines."""
    optics, peer = own_telescope(backend, name, folder)
    grid = its_raster(optics, peer, (1.0, 1.0))
    even = grid.shifts(30)
    shifts = np.delete(even, 3)
    frequency = even * grid.step / grid.wavelength
    uneven, by_lines = optics.mtf((1.0, 1.0), np.delete(frequency, 3)), optics.mtf((1.0, 1.0), frequency)
    np.testing.assert_allclose(uneven.values, grid.mtf(shifts), rtol=0, atol=TOLD)
    np.testing.assert_allclose(uneven.values, np.delete(by_lines.values, 3, axis=1), rtol=0, atol=3e-5)
    assert uneven.accuracy == 0.0
    (pupil,) = optics.pupils([(1.0, 1.0)])
    assert pupil.transfer_error < TOLD


@pytest.mark.second
def test_annular_terms_of_lsst_as_batoids(backend) -> None:
    """Gram and Schmidt's over the light of a ring are Mahajan's; batoid fits 512 x 512 rays: to 1 %."""
    optics = batoids_telescope(backend, *LSST)
    peer = pytest.importorskip("batoid").Optic.fromYaml(str(data(LSST[0])))
    wave = optics.wavefront((0.0, 0.0))
    assert wave.hole == pytest.approx(2.558 / 4.18, abs=1e-4)
    assert wave.polynomials.startswith("annular Zernike terms")
    assert wave.accuracy < 1e-3
    theirs = pytest.importorskip("batoid").zernike(peer, 0.0, 0.0, LSST[1], jmax=37, eps=wave.hole, nx=512)
    for j in (4, 11, 22):
        assert wave.parts[j - 1] == pytest.approx(theirs[j], rel=0.01), j
    assert np.max(np.abs(np.delete(wave.parts - theirs[1:38], [0, 1, 2]))) < 3e-4
    # fitted circle terms are no parts of the whole: defocus alone would be six times the error
    assert abs(wave.coefficients[3]) > 6.0 * wave.rms
