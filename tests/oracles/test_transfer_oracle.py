"""The optical transfer function against the image that batoid's rays and phases make."""

import numpy as np
import pytest

from optics.geometry import zernike
from optics.geometry.pose import rotation_matrix
from optics.geometry.tree import Motion, State
from optics.numerics import quadrature
from optics.waves import transfer
from optics.waves.pupil_stack import fit_pupils
from scenes.models.camera_model import IMAGE
from tests.optics.test_imaging import PERTURBED, WAVELENGTH, Camera
from tests.oracles.peers import batoid_camera, batoid_rays
from tests.tiers import quick

batoid = pytest.importorskip("batoid")
pytestmark = pytest.mark.oracle

NODES = quadrature.disk(18, 68)
TERMS = 45


def slopes(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives by the stop's unit-disk coordinates of values (N, K) on the nodes."""
    terms = zernike.fit(TERMS, NODES.x, NODES.y, values.T, NODES.weight).T
    along_x, along_y = (zernike.gradient_basis(TERMS, NODES.x, NODES.y, axis) @ terms for axis in (0, 1))
    return along_x, along_y


@pytest.mark.parametrize("dz", quick(1, [-200e-6, 0.0]))
def test_transform_of_batoids_image(backend, gf7, dz: float) -> None:
    """batoid traces the rays and gives the phase of each plane wave at each pixel; only the rays' start is shared.

    The image is multiplied by a Gaussian window and the transfer function convolved with its transform, as in
    tests/optics/test_transfer.py; the window is narrower (fewer pixels), which leaves 1e-6 from the function's cusp
    at zero and from its end.
    """
    camera = Camera(backend, gf7, PERTURBED)
    (pupil,) = fit_pupils(camera.field(NODES), NODES)
    # downstream is -z of the prescription
    state: State = {**PERTURBED, IMAGE: Motion(shift=(0.0, 0.0, -dz))}
    peer = batoid_camera(gf7)
    for body, motion in state.items():
        # batoid turns about the vertex, in the optic's frame; shift first, while its axes are still the global ones
        peer = peer.withGloballyShiftedOptic(body, motion.shift)
        peer = peer.withLocallyRotatedOptic(body, rotation_matrix(motion.rotate))

    _, launch = camera.rays(camera.stop.radius * np.stack([NODES.x, NODES.y], axis=-1))
    rays = batoid_rays(launch, camera.direction)
    peer.trace(rays)
    assert not np.any(rays.failed)
    entrance = np.linalg.norm(np.cross(*slopes(launch)), axis=-1)
    (ux, vx), (uy, vy) = (part.T for part in slopes(rays.v[:, :2]))
    exit_area = np.abs(ux * vy - uy * vx)
    amplitude = np.sqrt(exit_area * entrance / np.sum(entrance * NODES.weight)) * NODES.weight

    width, step, n = 14e-6, 2.5e-6, 69
    axis = step * (np.arange(n) - 0.5 * (n - 1))
    light = np.empty((n, n))
    for row, column in np.ndindex(n, n):
        point = camera.centre + np.array([axis[column], axis[row], 0.0])
        light[row, column] = np.abs(np.sum(amplitude * np.exp(1j * rays.phase(point, rays.t[0])))) ** 2
    window = np.exp(-0.5 * (axis / width) ** 2)
    light *= window[:, None] * window * (step / WAVELENGTH) ** 2

    directions = np.array([[1.0, 0.0], [0.0, 1.0], [0.6, 0.8], [-0.8, 0.6]])
    cutoff = pupil.cutoff(directions, WAVELENGTH)
    f = (np.array([0.35, 0.45, 0.55])[:, None, None] * directions * cutoff[:, None]).reshape(-1, 2)
    x_wave, y_wave = (np.exp(-2j * np.pi * np.outer(f[:, i], axis)) for i in (0, 1))
    got = np.einsum("mr,rc,mc->m", y_wave, light, x_wave)

    node, weight = np.polynomial.hermite_e.hermegauss(20)
    weight = weight / np.sum(weight)
    near = np.stack(np.meshgrid(node, node, indexing="ij"), axis=-1).reshape(-1, 2) / (2.0 * np.pi * width)
    around = transfer.transfer(pupil, (f[:, None] + near).reshape(-1, 2), WAVELENGTH, np.array([dz]))[0]
    want = around.reshape(len(f), -1) @ np.outer(weight, weight).ravel()
    np.testing.assert_allclose(got, want, rtol=0, atol=2e-6)
    assert np.max(np.abs(want)) > 0.3
    assert np.max(np.abs(np.angle(want))) > 0.05
