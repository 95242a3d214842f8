"""Images of targets through lenses, whose colours have places and foci of their own, in a band's light."""

from dataclasses import replace

import numpy as np
import pytest

from scenes.models.camera_model import ROOT, camera_alone
from scenes.specs.camera import BandSpec
from scenes.specs.load import load_detector
from tests.scenes.lens.colour_cameras import colour_camera
from twin.camera.camera_optics import CameraOptics
from twin.camera.colour import spectral_mtfs
from twin.sensors.line_ccd import LineCcd
from twin.targets.band_light import WORST_CHANGE
from twin.targets.target_images import ALONG, TargetCamera
from twin.targets.target_measurement import CURVE, read_edge
from twin.targets.target_path import TargetPath

REGION = 112


def target_camera(backend, spectrum: list[str]) -> tuple[TargetCamera, CameraOptics]:
    band = BandSpec.model_validate({"pixels": 2000, "pitch": "7 um", "spectrum": spectrum, "detector": "gf7_pan"})
    optics = CameraOptics.alone(colour_camera("achromat"), backend)
    path = TargetPath(camera_alone(optics.model), ROOT, ROOT, optics.model, backend)
    return TargetCamera(path, LineCcd.from_specs(band, load_detector("gf7_pan")), REGION), optics


@pytest.fixture(scope="module")
def seen(backend):
    return target_camera(backend, ["440 nm", "680 nm"])


@pytest.mark.second
def test_a_view_has_the_mtf_over_its_light(seen) -> None:
    """Two ways to it: of the camera at its fields, and of the place on the line that images the target."""
    camera, optics = seen
    place = camera.views({})["centre"]
    frequency = np.linspace(0.0, 1.0, 6)[1:] * place.band.nyquist
    (told,) = spectral_mtfs(optics, [(0.0, 0.0)], place.band.spectrum, frequency)
    for axis in range(2):
        asked = frequency[:, None] * np.eye(2)[axis]
        found = np.abs(place.light.transfer(asked, np.zeros(1))[0])
        # both stop at a rule of wavelengths by which no MTF changes by more than this
        np.testing.assert_allclose(found, told.values[axis], atol=2.0 * WORST_CHANGE)
    # that of the design wavelength alone is another one
    alone = optics.mtf((0.0, 0.0), frequency).values[0]
    assert np.max(np.abs(alone - told.values[0])) > 0.05


@pytest.mark.second
def test_images_take_it_from_tables(seen) -> None:
    """Of every wavelength one, right to 1e-5; two are enough to see their shares."""
    light = seen[0].views({})["centre"].light
    few = replace(light, pupils=light.pupils[::8], wavelengths=light.wavelengths[::8], weights=light.weights[::8])
    tilted = np.array([[0.3, 0.4], [-0.2, 0.5], [0.7, 0.1]]) * seen[0].ccd.band.nyquist
    np.testing.assert_allclose(few.table()(*tilted.T), few.transfer(tilted, np.zeros(1))[0], atol=2e-5)


@pytest.mark.second
def test_a_knife_edge_measures_it(seen) -> None:
    """The MTF that a noise-free image of the edge gives is that of the view."""
    place = seen[0].views({})["left"]
    imager = place.edge(ALONG, np.radians(5.0))
    mean = place.edge_image(imager) * 1000.0
    reading = read_edge(place, ALONG, imager.optics.normal, mean, 1)
    assert reading.measured is not None
    # what is asked of a knife edge against the traced pupil, see test_target_images
    below = CURVE <= 0.5
    np.testing.assert_allclose(reading.measured.mtf[below], reading.true[below], atol=0.01)


def test_light_of_one_wavelength_has_its_own_rays(backend) -> None:
    """Also where it is not the design's."""
    camera, optics = target_camera(backend, ["486.1327 nm", "486.1327 nm"])
    place = camera.views({})["centre"]
    frequency = np.array([0.5, 1.0]) * place.band.nyquist
    told = optics.at(486.1327e-9).mtf((0.0, 0.0), frequency).values[0]
    found = np.abs(place.light.transfer(frequency[:, None] * np.eye(2)[0], np.zeros(1))[0])
    np.testing.assert_allclose(found, told, atol=1e-6)
