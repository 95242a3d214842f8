"""Zernike terms, and wavefronts that are fitted with them."""

import numpy as np
import pytest

from optics.geometry import zernike
from optics.geometry.aperture import Circle
from optics.geometry.surface import Surface
from optics.geometry.tree import Motion
from optics.numerics import quadrature
from optics.waves.imaging import eikonal, fit_part, path_to_sphere
from tests.optics.bench import PASS, Stage, at, build, run

# Noll, JOSA 66, 207 (1976), table I: index -> n, m (m < 0: sine)
NOLL = {1: (0, 0), 2: (1, 1), 3: (1, -1), 4: (2, 0), 5: (2, -2), 6: (2, 2), 7: (3, -1), 8: (3, 1), 9: (3, -3)}
NOLL |= {10: (3, 3), 11: (4, 0), 12: (4, 2), 13: (4, -2), 14: (4, 4), 15: (4, -4), 16: (5, 1), 17: (5, -1)}
NOLL |= {22: (6, 0), 37: (8, 0)}


def test_noll_order() -> None:
    for index, pair in NOLL.items():
        assert zernike.noll_to_nm(index) == pair


def test_orthonormal_over_the_disk() -> None:
    nodes = quadrature.disk(12)
    basis = zernike.basis(zernike.MAX_NOLL, nodes.x, nodes.y)
    gram = basis.T @ (basis * nodes.weight[:, None]) / np.pi
    np.testing.assert_allclose(gram, np.eye(zernike.MAX_NOLL), atol=1e-11)


@pytest.mark.parametrize("axis", [0, 1])
def test_gradient_against_differences(axis: int) -> None:
    x, y = np.random.default_rng(1).uniform(-0.7, 0.7, (2, 30))
    h = 1e-6
    dx, dy = (h, 0.0) if axis == 0 else (0.0, h)
    difference = (zernike.basis(28, x + dx, y + dy) - zernike.basis(28, x - dx, y - dy)) / (2 * h)
    np.testing.assert_allclose(zernike.gradient_basis(28, x, y, axis), difference, atol=1e-7)


def test_fit_finds_its_coefficients() -> None:
    nodes = quadrature.disk(8)
    wanted = np.random.default_rng(2).normal(size=(3, 15))
    values = wanted @ zernike.basis(15, nodes.x, nodes.y).T
    np.testing.assert_allclose(zernike.fit(15, nodes.x, nodes.y, values, nodes.weight), wanted, atol=1e-12)


def test_monomials_are_the_same_polynomial() -> None:
    terms, radius = {4: 1e-6, 7: -2e-6, 12: 3e-7}, 0.25
    x, y = np.random.default_rng(3).uniform(-0.2, 0.2, (2, 20))
    order = zernike.order_of(terms)
    table = zernike.monomials(terms, order, radius)
    got = sum(
        table[zernike.triangle_index(a, d - a)] * x**a * y ** (d - a) for d in range(order + 1) for a in range(d + 1)
    )
    want = sum(a * zernike.zernike(j, x / radius, y / radius) for j, a in terms.items())
    np.testing.assert_allclose(got, want, atol=1e-19)


def test_names_say_where_a_term_is_largest() -> None:
    angle = np.deg2rad(np.arange(0.0, 180.0, 0.5))
    for index in range(2, zernike.MAX_NOLL + 1):
        _, m = zernike.noll_to_nm(index)
        name = zernike.name(index)
        edge = zernike.zernike(index, np.cos(angle), np.sin(angle))
        if m:
            where = {"x": 0.0, "y": 90.0}.get(name.split()[-1])
            where = float(name.split()[-2]) if where is None else where
            there = zernike.zernike(index, np.cos(np.deg2rad(where)), np.sin(np.deg2rad(where)))
            assert np.isclose(there, np.max(edge), rtol=1e-3), name  # steps of half a degree miss the largest by that
            assert not np.any(edge[angle < 0.9 * np.deg2rad(where)] > 0.999 * there), name  # and it is the first
    names = [zernike.name(index) for index in range(1, zernike.MAX_NOLL + 1)]
    assert len(set(names)) == len(names)
    noll = {4: "defocus", 5: "astigmatism 45 deg", 17: "secondary coma y", 37: "tertiary spherical aberration"}
    assert {index: zernike.name(index) for index in noll} == noll


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


def path_difference(hit, leaving, path, radius):
    """By how much the wavefront is ahead of the sphere about the chief ray's image, the first of the rays."""
    to_sphere = path_to_sphere(hit, leaving, path, hit[:1], radius)
    return to_sphere[0] - to_sphere


@pytest.mark.parametrize("radius", [np.inf, F, -3 * F])
def test_a_perfect_wavefront_has_no_path_difference(backend, radius: float) -> None:
    np.testing.assert_allclose(path_difference(*focused(backend), radius=radius), 0.0, atol=1e-14)


@pytest.mark.parametrize("sag", [-20e-9, 20e-9])
def test_sign_a_bump_toward_the_light_puts_the_wavefront_ahead(backend, sag: float) -> None:
    """The light comes along +z, so a bump toward it is a negative sag; it saves twice its height of path."""
    index = 6
    hit, leaving, path = focused(backend, {"e0": Motion(figure={index: sag})})
    difference = path_difference(hit, leaving, path, radius=F)[1:]
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
    difference = path_difference(hit, leaving, path, radius=np.inf)
    cosine = np.abs(leaving[:, 2])
    np.testing.assert_allclose(np.abs(difference), dz * (1.0 - cosine), rtol=1e-3, atol=1e-13)
    fit = fit_part(NODES.x, NODES.y, NODES.weight, difference[1:])
    assert fit.rms == pytest.approx(dz * (RADIUS / F) ** 2 / 2 / np.sqrt(12), rel=0.01)
    assert abs(fit.coefficients[3]) == pytest.approx(fit.rms, rel=1e-3)


def test_fit_separates_what_it_is_given() -> None:
    wanted = np.zeros(28)
    wanted[[0, 1, 2, 3, 6, 10, 21]] = [5e-6, 3e-6, -2e-6, 10e-9, -20e-9, 30e-9, 5e-9]
    fit = fit_part(NODES.x, NODES.y, NODES.weight, wanted @ zernike.basis(28, NODES.x, NODES.y).T)
    np.testing.assert_allclose([*fit.level, *fit.coefficients[3:]], wanted, atol=1e-19)
    assert fit.rms == pytest.approx(np.linalg.norm(wanted[3:]), rel=1e-10)
    assert fit.residual_rms < 1e-19


def test_a_ring_of_positive_weights_is_the_disk_minus_its_hole() -> None:
    """Both kinds of quadrature, Gauss' over the ring and the disk's less the hole's, have the same contributions."""
    hole = 0.4
    point, share = np.polynomial.legendre.leggauss(12)
    radius = np.sqrt(0.5 * (1.0 + hole**2) + 0.5 * (1.0 - hole**2) * point)
    angle = 2.0 * np.pi * np.arange(24) / 24
    x, y = (np.outer(radius, part(angle)).ravel() for part in (np.cos, np.sin))
    ring = x, y, np.repeat(share, 24)
    minus = (
        *(np.append(part, hole * part) for part in (NODES.x, NODES.y)),
        np.append(NODES.weight, -(hole**2) * NODES.weight),
    )
    fits = [fit_part(x, y, weight, 3e-8 * x**3 + 2e-8 * x * y + 1e-8 * y, 15) for x, y, weight in (ring, minus)]
    for name in ("level", "coefficients", "parts", "rms"):
        np.testing.assert_allclose(getattr(fits[0], name), getattr(fits[1], name), atol=1e-21, err_msg=name)
    assert np.linalg.norm(fits[0].parts) == pytest.approx(fits[0].rms, rel=1e-9)
