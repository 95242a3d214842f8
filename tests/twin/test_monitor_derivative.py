"""Derivatives from a body's motion to the pixels, by AD through tree, trace and diffraction, against differences."""

import drjit as dr
import numpy as np
import pytest

from optics.raytrace import derivatives, trace
from scenes.specs.instrument import BASE
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


@pytest.mark.second
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


@pytest.mark.second
def test_a_trace_in_sections_is_the_same(path, monkeypatch):
    """Where one kernel ends and the next begins changes no ray, and derivatives by rounding only."""
    whole, some = {}, MOTIONS[:6]
    monkeypatch.setattr(trace, "FEW", 0)
    for section in (1000, 6, 1):
        for module in (trace, derivatives):
            monkeypatch.setattr(module, "SECTION", section)
        rays = path.coarse.rays([motion.state(STEP[motion.kind]) for motion in some])
        whole[section] = (rays.position, rays.direction, rays.path), spot_jacobian(path, some)
    for section in (6, 1):
        for one, other in zip(whole[section][0], whole[1000][0], strict=True):
            np.testing.assert_array_equal(one, other)
        one, other = whole[section][1], whole[1000][1]
        # 25 surfaces, each of which rounds
        assert np.abs(one - other).max() < 1e-13 * np.abs(other).max()


def kernels(path, motions):
    """Hashes of the kernels that the derivatives by these motions run."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()
        spot_jacobian(path, motions)
        return {kernel["hash"] for kernel in dr.kernel_history() if "hash" in kernel}


def test_derivatives_by_any_motions_take_the_same_kernels(path):
    """With figures or without: to compile another set of kernels takes seconds."""
    plain, figured = line_family("backward"), (ElementaryMotion(f"{BASE}/backward/M2", "figure", 8),)
    spot_jacobian(path, plain)  # works out what the path keeps
    assert kernels(path, plain) == kernels(path, (*figured, *plain)) != set()
