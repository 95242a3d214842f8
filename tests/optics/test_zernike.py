import numpy as np
import pytest

from optics.geometry import zernike
from optics.numerics import quadrature

# Noll, JOSA 66, 207 (1976), table I: index -> n, m (m < 0: sine)
NOLL = {1: (0, 0), 2: (1, 1), 3: (1, -1), 4: (2, 0), 5: (2, -2), 6: (2, 2), 7: (3, -1), 8: (3, 1), 9: (3, -3)}
NOLL |= {
    10: (3, 3),
    11: (4, 0),
    12: (4, 2),
    13: (4, -2),
    14: (4, 4),
    15: (4, -4),
    16: (5, 1),
    17: (5, -1),
    22: (6, 0),
    37: (8, 0),
}


def test_noll_order() -> None:
    for index, pair in NOLL.items():
        assert zernike.noll_to_nm(index) == pair


def test_closed_forms() -> None:
    x, y = np.array([0.3, -0.5]), np.array([0.2, 0.7])
    r, t = np.hypot(x, y), np.arctan2(y, x)
    forms = {
        1: np.ones(2),
        2: 2 * x,
        3: 2 * y,
        4: np.sqrt(3) * (2 * r**2 - 1),
        5: np.sqrt(6) * r**2 * np.sin(2 * t),
        6: np.sqrt(6) * r**2 * np.cos(2 * t),
        7: np.sqrt(8) * (3 * r**3 - 2 * r) * np.sin(t),
        8: np.sqrt(8) * (3 * r**3 - 2 * r) * np.cos(t),
        11: np.sqrt(5) * (6 * r**4 - 6 * r**2 + 1),
    }
    for index, want in forms.items():
        np.testing.assert_allclose(zernike.zernike(index, x, y), want, atol=1e-14)


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
