"""Obscured telescopes against other people's software: MTF by an FFT of batoid's rays over the true pupil, poppy's
spider, annular Zernike terms of batoid.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import j1

from optics.numerics import quadrature
from optics.numerics.backend import Backend
from optics.waves.transfer import polychromatic_transfer
from scenes.lens.batoid_reader import read_batoid
from scenes.lens.batoid_writer import batoid_text
from scenes.lens.camera_reader import Width, camera_of
from scenes.lens.camera_writer import prescription_of
from scenes.models.camera_model import derive_camera, field_direction
from scenes.specs.load import load_camera
from tests.oracles.pupil_raster import PupilRaster, raster
from twin.camera.camera_optics import CameraOptics

batoid = pytest.importorskip("batoid", reason="batoid not installed (extra `oracles`)")
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


@cache
def own_telescope(backend: Backend, name: str, folder: Path) -> tuple[CameraOptics, Any]:
    """A camera's file here, and what batoid makes of the same prescription."""
    optics = CameraOptics.alone(load_camera(OWN[name]), backend)
    text, notes = batoid_text(prescription_of(optics.model))
    assert not notes
    path = folder / f"{name}.yaml"
    path.write_text(text, "utf-8")
    return optics, batoid.Optic.fromYaml(str(path))


@cache
def batoids_telescope(backend: Backend, name: str, wavelength: float, pupil: float, largest: float) -> CameraOptics:
    """A telescope of batoid's as a camera, over the square in its round field."""
    path = Path(batoid.__file__).parent / "data" / name
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
        peer = batoid.Optic.fromYaml(str(Path(batoid.__file__).parent / "data" / LSST[0]))
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
def test_a_spider_as_poppy_has_it(backend) -> None:
    """MTF and encircled energy of the perfect wavefront behind the Ritchey-Chretien telescope's disk and four vanes."""
    poppy = pytest.importorskip("poppy")
    import astropy.units as u

    optics = CameraOptics.alone(load_camera("ritchey_chretien"), backend)
    wavelength = optics.model.spec.wavelength
    cells, parts = 512, 4
    wave = poppy.Wavefront(wavelength=wavelength * u.m, npix=cells * parts, diam=0.5 * u.m)
    blocked = poppy.AsymmetricSecondaryObscuration(
        secondary_radius=0.0875 * u.m, support_angle=(45, 135, 225, 315), support_width=4e-3 * u.m
    )
    mask = poppy.CircularAperture(radius=0.25 * u.m).get_transmission(wave) * blocked.get_transmission(wave)
    share = mask.reshape(cells, parts, cells, parts).mean(axis=(1, 3))
    overlap = np.abs(np.fft.ifft2(np.abs(np.fft.fft2(share, (2 * cells, 2 * cells))) ** 2)) / np.sum(share)
    shifts = np.arange(0, cells, 16)[1:]
    aperture = float(np.max(np.abs(optics.pupils([(0.0, 0.0)])[0].axes)))
    frequency = shifts * (2.0 * aperture / cells) / wavelength
    mtf = optics.mtf((0.0, 0.0), frequency)
    np.testing.assert_allclose(mtf.limit, [overlap[0, shifts], overlap[shifts, 0]], rtol=0, atol=TOLD)
    # encircled energy 2 pi R integral of the mean over directions of the OTF times J1(2 pi R f)
    (pupil,) = optics.pupils([(0.0, 0.0)])
    perfect = replace(pupil, eikonal_terms=np.zeros_like(pupil.eikonal_terms))
    turns = np.pi * (np.arange(24) + 0.5) / 24
    node, weight = quadrature.gauss(72)
    end = 2.0 * aperture / wavelength
    every, weight = 0.5 * end * (node + 1.0), 0.5 * end * weight
    both = np.concatenate([every[:, None] * np.array([np.cos(t), np.sin(t)]) for t in turns])
    otf = polychromatic_transfer(perfect, both, np.array([wavelength]), np.ones(1), np.zeros(1))[0].real
    mean = otf.reshape(len(turns), -1).mean(axis=0)
    radii = np.array([1.0, 2.0, 4.0]) * wavelength / (2.0 * aperture)
    ours = [2 * np.pi * r * float(weight @ (mean * j1(2 * np.pi * r * every))) for r in radii]
    u_f, v_f = np.meshgrid(*2 * [np.fft.fftfreq(2 * cells, 1.0 / (2 * cells))])
    far = np.hypot(u_f, v_f) * (2.0 * aperture / cells) / wavelength
    area = (2.0 * aperture / cells / wavelength) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        kernel = [np.where(far > 0.0, r * j1(2 * np.pi * r * far) / far, np.pi * r**2) for r in radii]
    theirs = [float(np.sum(overlap * one) * area) for one in kernel]
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=TOLD)
    assert 0.5 < theirs[0] < theirs[1] < theirs[2] < 0.97


@pytest.mark.second
def test_annular_terms_of_lsst_as_batoids(backend) -> None:
    """Gram and Schmidt's over the light of a ring are Mahajan's; batoid fits 512 x 512 rays: to 1 %."""
    optics = batoids_telescope(backend, *LSST)
    peer = batoid.Optic.fromYaml(str(Path(batoid.__file__).parent / "data" / LSST[0]))
    wave = optics.wavefront((0.0, 0.0))
    assert wave.hole == pytest.approx(2.558 / 4.18, abs=1e-4)
    assert wave.polynomials.startswith("annular Zernike terms")
    assert wave.accuracy < 1e-3
    theirs = batoid.zernike(peer, 0.0, 0.0, LSST[1], jmax=37, eps=wave.hole, nx=512)
    for j in (4, 11, 22):
        assert wave.parts[j - 1] == pytest.approx(theirs[j], rel=0.01), j
    assert np.max(np.abs(np.delete(wave.parts - theirs[1:38], [0, 1, 2]))) < 3e-4
    # fitted circle terms are no parts of the whole: defocus alone would be six times the error
    assert abs(wave.coefficients[3]) > 6.0 * wave.rms
