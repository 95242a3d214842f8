"""A camera over all wavelengths of its light: colours, their MTF and point images, against other ways to them."""

from dataclasses import replace

import numpy as np
import pytest

from optics.geometry.tree import Motion
from optics.numerics.array_math import UnphysicalError
from optics.waves.transfer import polychromatic_transfer
from scenes.specs.spectrum import SpectrumSpec
from tests.scenes.lens.colour_cameras import colour_camera
from twin.camera.camera_optics import CameraOptics
from twin.camera.colour import axial_colour, lateral_colour, spectral_mtfs
from twin.targets import target_images

FIELDS = [(0.0, 0.0), (1.0, 1.0)]


@pytest.fixture(scope="module")
def achromat(backend) -> CameraOptics:
    return CameraOptics.alone(colour_camera("achromat"), backend)


@pytest.mark.second
def test_a_camera_of_one_colour_is_that_of_its_wavelength(achromat, backend) -> None:
    """The same file with another design wavelength, but for its stop and pupil."""
    blue = 486.1327e-9
    other = CameraOptics.alone(
        colour_camera("achromat").model_copy(update={"wavelength": blue, "spectrum": None}), backend
    )
    for ours, theirs in zip(achromat.at(blue).wavefronts(FIELDS), other.wavefronts(FIELDS), strict=True):
        assert ours.wavelength == blue
        # the reference sphere's radius is that of the design's exit pupil: second order in the error
        assert ours.rms == pytest.approx(theirs.rms, rel=1e-5)
        np.testing.assert_allclose(ours.place, theirs.place, atol=1e-12)
    assert achromat.at(achromat.wavelength).wavefront().rms == achromat.wavefront().rms
    with pytest.raises(ValueError, match="outside the range"):
        achromat.at(5e-6)


@pytest.mark.second
def test_lateral_colour_is_in_the_pupils(achromat) -> None:
    """The phase of a line's transfer function is that of where its light falls, seen from the design's chief ray."""
    lines, field, frequency = np.array([486.1327e-9, 656.2725e-9]), (1.0, 0.0), np.array([0.0, 100.0, 40e3])
    moved = lateral_colour(achromat, [field], lines, achromat.wavelength)[0, :, 0]
    (both,) = achromat.colour_pupils([field], lines)
    design, values = achromat.spot(field), []
    for k, (line, pupil) in enumerate(zip(lines, both, strict=True)):
        own = polychromatic_transfer(pupil, frequency[:, None] * [1.0, 0.0], np.array([line]), np.ones(1), np.zeros(1))
        values.append(own[0])
        spot = achromat.at(float(line)).spot(field)
        assert spot.place[0] - design.place[0] == pytest.approx(moved[k], abs=1e-13)
        middle = np.angle(own[0, 1]) / (-2.0 * np.pi * frequency[1])
        assert middle == pytest.approx(moved[k] + spot.centroid[0], abs=2e-9)
    assert abs(moved[0] - moved[1]) > 1e-7
    mtf = achromat.mtfs([field], frequency, lines, np.array([1.0, 3.0]))[0]
    assert mtf.values[0, 2] == pytest.approx(abs(values[0][2] + 3.0 * values[1][2]) / 4.0, rel=1e-12)
    assert mtf.weights.tolist() == [0.25, 0.75]


@pytest.mark.second
def test_rules_of_more_wavelengths_until_nothing_changes(achromat, monkeypatch) -> None:
    light, frequency = SpectrumSpec.evenly(500e-9, 640e-9), np.array([0.0, 30e3, 70e3])
    (mtf,) = spectral_mtfs(achromat, [(0.0, 0.0)], light, frequency)
    (fine,) = achromat.mtfs([(0.0, 0.0)], frequency, *light.rule(24))
    assert 0.0 < mtf.error <= target_images.WORST_CHANGE
    np.testing.assert_allclose(mtf.values, fine.values, atol=mtf.error)
    monkeypatch.setattr(target_images, "LARGEST_RULE", 9)
    monkeypatch.setattr(target_images, "WORST_CHANGE", 1e-9)
    with pytest.raises(UnphysicalError, match="still changes by"):
        spectral_mtfs(achromat, [(0.0, 0.0)], light, frequency)


def test_axial_colour_is_that_of_the_state(achromat, backend) -> None:
    """Of a moved focal plane, and of a lens whose last face has moved: as of a file that says so."""
    lines, middle, step = np.array([486.1327e-9, 656.2725e-9]), [(0.0, 0.0)], 20e-6
    spec = achromat.model.spec
    still = axial_colour(achromat, middle, lines)
    away = replace(achromat, state={"camera/focal_plane": Motion(shift=(0.0, 0.0, step))})
    moved = axial_colour(away, middle, lines) - still
    np.testing.assert_allclose(np.abs(moved), step, rtol=1e-6)
    last = list(spec.mirrors)[-1]
    mirrors = {**spec.mirrors, last: spec.mirrors[last].model_copy(update={"z": spec.mirrors[last].z + step})}
    written = CameraOptics.alone(spec.model_copy(update={"mirrors": mirrors}), backend)
    bent = replace(achromat, state={f"camera/{last}": Motion(shift=(0.0, 0.0, step))})
    found, wanted = axial_colour(bent, middle, lines) - still, axial_colour(written, middle, lines) - still
    assert np.min(np.abs(wanted)) > 0.1 * step
    np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-9)


def test_no_colours_without_named_glass(achromat, backend) -> None:
    lenses = {**achromat.model.spec.mirrors}
    lenses["L1"] = lenses["L1"].model_copy(update={"glass": None, "index": 1.5168})
    old = replace(achromat, path=CameraOptics.alone(
        achromat.model.spec.model_copy(update={"mirrors": lenses, "spectrum": None}), backend).path)  # fmt: skip
    with pytest.raises(ValueError, match="name its glass"):
        old.at(500e-9)
    with pytest.raises(ValueError, match="name its glass"):
        axial_colour(old, [(0.0, 0.0)], np.array([500e-9]))
