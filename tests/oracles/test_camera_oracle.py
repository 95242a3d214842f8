"""What ``twin.camera`` tells of a camera against other people's software: first order, wavefronts, names, MTF."""

import numpy as np
import pytest

from tests.oracles.peers import batoid_camera, batoid_rays, optiland_camera
from tests.tiers import quick
from twin.camera.camera_optics import CameraOptics
from twin.camera.first_order_data import FIRST_ORDER, first_order_data, ray_paths

pytestmark = pytest.mark.oracle
NAMES = quick(1, ["gf7", "monitor", "gf7_conic"])


@pytest.mark.second
@pytest.mark.parametrize("name", NAMES)
def test_paraxial_data_of_optiland(backend, camera, name: str) -> None:
    """About the axis, which the field stands beside; the rays that are traced there are those of the twin."""
    pytest.importorskip("optiland")
    model = camera(name)
    data = first_order_data(CameraOptics.alone(model, backend))
    told = FIRST_ORDER(data)
    optic = optiland_camera(model)
    optic.set_aperture("EPD", data.entrance_pupil)
    optic.fields.set_type("angle")
    optic.fields.add(y=0.0)
    paraxial = optic.paraxial
    assert told["focal_length_m"] == pytest.approx(abs(float(paraxial.f2())), rel=1e-9)
    assert told["f_number"] == pytest.approx(abs(float(paraxial.FNO())), rel=1e-9)
    # measured from the first surface, positive behind it
    assert told["entrance_pupil_before_first_mirror_m"] == pytest.approx(-float(paraxial.EPL()), rel=1e-9)
    # from the image, along the light, which travels toward -z
    away = float(np.ravel(paraxial.XPL())[0])
    assert told["exit_pupil_before_image_m"] == pytest.approx(away, rel=1e-9)
    assert told["exit_pupil_m"] == pytest.approx(abs(float(np.ravel(paraxial.XPD())[0])), rel=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_wavefronts_of_batoids_rays(backend, camera, name: str) -> None:
    """batoid traces; its paths to the reference sphere are found by the quadratic, and poppy's Zernike terms fitted."""
    pytest.importorskip("batoid")
    zernike1 = pytest.importorskip("poppy").zernike.zernike1
    model = camera(name)
    optics = CameraOptics.alone(model, backend)
    fields = [(0.0, 0.0), (1.0, 0.0), (0.4, -1.0)]
    rng = np.random.default_rng(1)
    r, angle = np.sqrt(rng.uniform(size=2000)), rng.uniform(0.0, 2.0 * np.pi, 2000)
    stop = np.concatenate([np.zeros((1, 2)), 0.999999 * np.stack([r * np.cos(angle), r * np.sin(angle)], axis=-1)])
    starts = ray_paths(model, backend, fields, stop).points[:2]
    basis = np.stack([zernike1(j, rho=r, theta=angle, outside=None, noll_normalize=True) for j in range(1, 38)], -1)
    peer = batoid_camera(model)
    radius = float(model.first_order.exit_pupil_distance[0])
    for k, wave in enumerate(optics.wavefronts(fields)):
        launch = starts[0, k]
        way = starts[1, k] - launch
        direction = way / np.linalg.norm(way, axis=-1, keepdims=True)
        rays = batoid_rays(launch, direction[0])
        peer.trace(rays)
        rays.toCoordSys(peer.items[-1].coordSys)
        # from the sphere about the chief ray's image back along each ray: |p + t v - c| = |radius|
        offset = rays.r - rays.r[0]
        along = np.sum(offset * rays.v, axis=-1)
        root = np.sqrt(along**2 - np.sum(offset**2, axis=-1) + radius**2)
        to_sphere = rays.t + (-along - np.sign(radius) * root)
        error = (to_sphere[0] - to_sphere)[1:] / model.spec.wavelength
        terms = np.linalg.lstsq(basis, error, rcond=None)[0]
        # 37 terms follow these wavefronts to 1e-6 waves
        np.testing.assert_allclose(wave.coefficients[3:], terms[3:], atol=3e-6)
        assert wave.rms == pytest.approx(np.sqrt(np.sum(terms[3:] ** 2)), abs=3e-6)
        left = error - basis[:, :3] @ terms[:3]
        assert np.ptp(left) <= wave.peak_to_valley * (1.0 + 1e-6) + 1e-5
        assert np.ptp(left) > 0.9 * wave.peak_to_valley
        # and where the chief ray falls
        place = peer.items[-1].coordSys.origin + rays.r[0] - model.focal_plane.translation
        np.testing.assert_allclose(wave.place, place[:2], atol=1e-12)
