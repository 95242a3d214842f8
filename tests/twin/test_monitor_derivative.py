"""Derivatives from a body's motion to the pixels, by AD through tree, trace and diffraction, against differences."""

import numpy as np
import pytest

from scenes.specs.channel import BASE
from twin.monitor.monitor_derivative import photon_derivative, spot_jacobian
from twin.monitor.monitor_path import MonitorPath
from twin.monitor.motions import ElementaryMotion, line_family

MOTIONS = (
    *line_family("forward"),
    ElementaryMotion(f"{BASE}/forward/focal_plane", "shift", 2),
    ElementaryMotion(f"{BASE}/forward/M1", "rotate", 0, "centre"),
    ElementaryMotion(f"{BASE}/forward/M2", "shift", 2),
    ElementaryMotion(f"{BASE}/central_prism", "rotate", 1),
    ElementaryMotion(f"{BASE}/forward/M1", "figure", 5),
    ElementaryMotion(f"{BASE}/forward/M3", "figure", 7),
)
# The spot lies in its middle and hardly moves; its image shrinks, counted in pixels.
GROWN_CHIP = ElementaryMotion(f"{BASE}/forward/focal_plane/left/area_ccd", "scale")
# moves a spot by 1e-7 to 1e-1 px: differences stay linear
STEP = {"shift": 1e-6, "rotate": 1e-7, "scale": 1e-6, "figure": 1e-8}


@pytest.fixture(scope="module")
def path(gf7_pair, backend):
    return MonitorPath(gf7_pair, backend)


def test_image_derivative_is_what_images_do(path):
    motions = (*MOTIONS, GROWN_CHIP)
    exact = photon_derivative(path, motions)[:, :2]  # the forward camera's two spots
    states = [m.state(s * STEP[m.kind]) for s in (1, -1) for m in motions]
    photons = path.expected_photons(states)[:, :2]
    steps = np.array([STEP[m.kind] for m in motions])[:, None, None, None]
    difference = (photons[: len(motions)] - photons[len(motions) :]) / (2 * steps)
    # single-precision waves: 1e-7 of the peak in each of two images; second order: 1e-3 of the change
    noise = 4e-7 * photons.max() / steps
    error = np.abs(exact - difference)
    assert np.all(error < 2e-3 * np.abs(exact).max(axis=(1, 2, 3), keepdims=True) + noise)
    strong = np.abs(exact).max(axis=(1, 2, 3)) > 20 * noise.ravel()
    assert np.count_nonzero(strong) >= 9  # the check sees most motions well above its noise


def test_centroid_of_the_image_moves_as_the_rays_do(path):
    """Theorem: the energy centroid of a diffraction image is the mean of the rays. The window cuts some far tail."""
    exact = photon_derivative(path, MOTIONS)
    nominal = path.expected_photons([{}])[0]
    index = [np.arange(n) - 0.5 * (n - 1) for n in path.shape]
    total = nominal.sum(axis=(1, 2))
    moved = np.stack([exact.sum(axis=3) @ index[0], exact.sum(axis=2) @ index[1]], axis=-1) / total[None, :, None]
    rays = spot_jacobian(path, MOTIONS).transpose(2, 0, 1)
    for m in range(len(MOTIONS)):
        scale = np.abs(rays[m]).max()
        assert np.abs(moved[m] - rays[m]).max() < 0.03 * scale + 1e-9
