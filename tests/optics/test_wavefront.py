import numpy as np
import pytest

from optics.geometry import zernike
from optics.geometry.aperture import Circle
from optics.geometry.surface import Surface
from optics.geometry.tree import Motion
from optics.numerics import quadrature
from optics.waves.wavefront import eikonal, fit_wavefront, path_difference
from tests.optics.bench import PASS, Stage, at, build, run

F, RADIUS = 5.0, 0.2
NODES = quadrature.disk(10)


def focused(backend, state=None) -> tuple[np.ndarray, ...]:
    """A paraboloid, light of +z, at its focal plane; entry 0 is the chief ray."""
    bench = build(Stage(Surface(-1 / (2 * F), -1.0), aperture=Circle(2 * RADIUS)), Stage(Surface(), PASS, at(-F)))
    x, y = RADIUS * np.append(0.0, NODES.x), RADIUS * np.append(0.0, NODES.y)
    position = np.stack([x, y, np.full_like(x, -2 * F)], axis=-1)
    direction = np.broadcast_to([0.0, 0.0, 1.0], position.shape)
    hit, leaving, path, valid = run(backend, bench, position, direction, state)
    assert valid.all()
    return hit, leaving, path


@pytest.mark.parametrize("radius", [np.inf, F, -3 * F])
def test_a_perfect_wavefront_has_no_path_difference(backend, radius: float) -> None:
    np.testing.assert_allclose(path_difference(*focused(backend), chief=0, radius=radius), 0.0, atol=1e-14)


@pytest.mark.parametrize("sag", [-20e-9, 20e-9])
def test_sign_a_bump_toward_the_light_puts_the_wavefront_ahead(backend, sag: float) -> None:
    """The light comes along +z, so a bump toward it is a negative sag; it saves twice its height of path."""
    index = 6
    hit, leaving, path = focused(backend, {"e0": Motion(figure={index: sag})})
    difference = path_difference(hit, leaving, path, chief=0, radius=F)[1:]
    # the figure's disk is the mirror's aperture, twice as wide as the beam
    shape = zernike.zernike(index, NODES.x / 2, NODES.y / 2) - zernike.zernike(index, 0.0, 0.0)
    assert np.max(np.abs(shape)) > 0.5
    np.testing.assert_allclose(difference, -2.0 * sag * shape, atol=3e-3 * abs(sag))
    bump = np.argmax(-sag * shape)
    assert difference[bump] > 0.0


def test_sign_of_the_eikonal_is_that_of_the_path(backend) -> None:
    hit, leaving, path = focused(backend)
    origin = np.array([0.0, 0.0, -F])
    np.testing.assert_allclose(eikonal(hit, leaving, path, origin), 2 * F + F, atol=1e-13)
    # a plane wave that must go on to reach the origin has a longer path there
    ahead = origin + 0.1 * leaving[0]
    assert eikonal(hit[:1], leaving[:1], path[:1], ahead)[0] == pytest.approx(3 * F + 0.1)


def test_defocus_of_a_moved_image(backend) -> None:
    """The image plane dz behind the focus: the wavefront's defect is dz (1 - cos) ~ dz sin^2 / 2 at the edge."""
    dz = 100e-6
    hit, leaving, path = focused(backend, {"e1": Motion(shift=(0.0, 0.0, -dz))})
    difference = path_difference(hit, leaving, path, chief=0, radius=np.inf)
    cosine = np.abs(leaving[:, 2])
    np.testing.assert_allclose(np.abs(difference), dz * (1.0 - cosine), rtol=1e-3, atol=1e-13)
    fit = fit_wavefront(NODES.x, NODES.y, NODES.weight, difference[1:])
    assert fit.rms == pytest.approx(dz * (RADIUS / F) ** 2 / 2 / np.sqrt(12), rel=0.01)
    assert abs(fit.coefficients[3]) == pytest.approx(fit.rms, rel=1e-3)


def test_fit_separates_what_it_is_given() -> None:
    wanted = np.zeros(28)
    wanted[[0, 1, 2, 3, 6, 10, 21]] = [5e-6, 3e-6, -2e-6, 10e-9, -20e-9, 30e-9, 5e-9]
    fit = fit_wavefront(NODES.x, NODES.y, NODES.weight, wanted @ zernike.basis(28, NODES.x, NODES.y).T)
    np.testing.assert_allclose(fit.coefficients, wanted, atol=1e-19)
    assert fit.rms == pytest.approx(np.linalg.norm(wanted[3:]), rel=1e-10)
    assert fit.residual_rms < 1e-19
