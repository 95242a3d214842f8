"""Nodes of finite-element programs: what was put into their displacements comes back, whatever the mesh."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from optics.geometry import zernike
from optics.geometry.aperture import Aperture, Circle, Ellipse, Rectangle
from optics.geometry.surface import Surface, plane
from optics.thermal.nodal_deformation import NodesError, nodal_deformation
from tests.tiers import quick

BOWL = Surface(-0.25, -1.0, (1e-3,))
DISK = Circle(0.3, (0.02, -0.45))  # off the axis, as mirrors of a TMA
TURN, SHIFT = np.array([2e-3, -1e-3, 4e-3]), np.array([1e-4, -2e-4, 3e-4])
APERTURES = [DISK, Circle(0.3, (0.0, 0.0), 0.1), Rectangle(0.4, 0.2, (0.0, -0.5)), Ellipse(0.3, 0.2)]


def mesh(aperture: Aperture, along: int, seed: int = 1, surface: Surface = BOWL, uneven: bool = False) -> np.ndarray:
    """An irregular mesh of a surface that reaches some nodes beyond the aperture, (N, 3); uneven: twice as fine at
    +x.
    """
    rng = np.random.default_rng(seed)
    x0, x1, y0, y1 = aperture.bounds
    count = (along, max(8, round(along * (y1 - y0) / (x1 - x0))))
    u, v = np.meshgrid(np.linspace(-1.06, 1.06, count[0]), np.linspace(-1.06, 1.06, count[1]))
    u, v = (w + rng.uniform(-0.4, 0.4, w.shape) * 2.0 / n for w, n in ((u, count[0]), (v, count[1])))
    u = np.where(uneven, 1.06 - (1.06 - u) * (1.06 + 0.5 * (1.06 - u)) / 2.12, u)
    x, y = 0.5 * (x0 + x1) + 0.5 * (x1 - x0) * u.ravel(), 0.5 * (y0 + y1) + 0.5 * (y1 - y0) * v.ravel()
    return np.stack([x, y, surface.sag(x, y)], axis=-1)


def moved(points: np.ndarray, turn: np.ndarray = TURN, shift: np.ndarray = SHIFT, size: float = 1.0) -> np.ndarray:
    """Displacements of a rigid motion and growth."""
    return size * Rotation.from_rotvec(turn).apply(points) + shift - points


@pytest.mark.second
@pytest.mark.parametrize("aperture", quick(1, APERTURES), ids=["disk", "ring", "rectangle", "ellipse"])
@pytest.mark.parametrize("uneven", [False, True], ids=["even", "uneven"])
@pytest.mark.parametrize(("times", "growth"), [(1.0, 0.0), (100.0, 3e-4)], ids=["small", "large and grown"])
def test_a_rigid_motion_and_a_growth_are_exact(aperture: Aperture, uneven: bool, times: float, growth: float) -> None:
    points = mesh(aperture, 50, uneven=uneven)
    face = nodal_deformation(points, moved(points, times * TURN, times * SHIFT, 1.0 + growth), BOWL, aperture)
    # rounding of coordinates of 1 m is 1e-16; the least lever arm is a tenth of that
    np.testing.assert_allclose(face.rotate, times * TURN, rtol=0, atol=1e-12)
    np.testing.assert_allclose(face.shift, times * SHIFT, rtol=0, atol=1e-12)
    assert face.expansion == pytest.approx(growth, abs=1e-12)
    assert face.rms(face.change) < 1e-14
    assert face.grid is None
    assert not face.printed_through


@pytest.mark.second
def test_figure_and_ripple_come_back_with_their_sizes() -> None:
    """Amplitudes of terms are rms, half of a ripple's amplitude is its rms; the mesh says how well it knows them. Nodes
    slide along the surface by 1 um: where they end up counts.
    """
    points = mesh(DISK, 90)
    x, y = (points[:, :2] - DISK.centre).T
    y = y + 1e-6 * zernike.zernike(9, x / 0.3, y / 0.3)
    bump = 100e-9 * zernike.zernike(5, x / 0.3, y / 0.3) - 40e-9 * zernike.zernike(9, x / 0.3, y / 0.3)
    bump = bump + 20e-9 * np.cos(2.0 * np.pi * x / 0.1) * np.cos(2.0 * np.pi * y / 0.12)
    turn = Rotation.from_rotvec(TURN).as_matrix()
    slid = y + DISK.centre[1]
    lifted = np.stack([points[:, 0], slid, BOWL.sag(points[:, 0], slid) + bump], axis=-1)
    face = nodal_deformation(points, lifted @ turn.T + SHIFT - points, BOWL, DISK)
    np.testing.assert_allclose(face.rotate, TURN, rtol=0, atol=2e-8)
    assert face.figure[5] == pytest.approx(100e-9, rel=0.02)
    assert face.figure[9] == pytest.approx(-40e-9, rel=0.04)
    assert face.rms(face.residual) == pytest.approx(10e-9, rel=0.06)
    assert face.rms(face.change) == pytest.approx(np.sqrt(100.0**2 + 40.0**2 + 10.0**2) * 1e-9, rel=0.03)
    assert face.rms(face.lost) < 1e-11
    assert 0.0 < face.between < 2e-9
    assert not face.printed_through


def lifted_by(points: np.ndarray, height: float) -> np.ndarray:
    """Points elsewhere along z."""
    return np.asarray(points + np.array([0.0, 0.0, height]))


@pytest.mark.second
def test_order_of_the_nodes_and_nodes_elsewhere_do_not_matter() -> None:
    points = mesh(DISK, 40)
    moves = moved(points) + 1e-7 * np.sin(20.0 * points[:, :1]) * [0.0, 0.0, 1.0]
    face = nodal_deformation(points, moves, BOWL, DISK)
    order = np.random.default_rng(3).permutation(len(points))
    back = lifted_by(points[order], 0.05)  # the back of the mirror, which does something else
    other = nodal_deformation(
        np.concatenate([back, points[order]]), np.concatenate([0.0 * back, moves[order]]), BOWL, DISK
    )
    assert other.others == len(back)
    assert (other.rotate, other.shift, other.expansion) == (face.rotate, face.shift, face.expansion)
    assert other.figure == face.figure
    assert face.grid is not None
    assert other.grid is not None
    np.testing.assert_array_equal(other.grid.values, face.grid.values)


@pytest.mark.second
def test_a_finer_half_of_a_mesh_does_not_weigh_more() -> None:
    def bent(points: np.ndarray) -> np.ndarray:
        return 1e-6 * (points[:, :1] / 0.3) ** 3 * np.array([0.0, 0.0, 1.0])

    even, uneven = (
        nodal_deformation(p, bent(p), plane(), Circle(0.3))
        for p in (mesh(Circle(0.3), 80, surface=plane()), mesh(Circle(0.3), 80, 2, plane(), uneven=True))
    )
    # of u = x^3 the turn about y is -(mean x^4) / (mean x^2), exactly -r^2/2 in these units
    assert even.rotate[1] == pytest.approx(-0.5e-6 / 0.3, rel=3e-3)
    assert uneven.rotate[1] == pytest.approx(-0.5e-6 / 0.3, rel=3e-3)
    points = mesh(Circle(0.3), 80, 2, plane(), uneven=True)
    p = points[np.hypot(*points[:, :2].T) < 0.3]
    plain = -np.sum(p[:, 0] * bent(p)[:, 2]) / np.sum(p[:, 0] ** 2)
    assert abs(plain / (0.5e-6 / 0.3) + 1.0) > 0.02  # every node alike would be off by this


@pytest.mark.second
def test_a_mesh_that_prints_through_is_told() -> None:
    points = mesh(DISK, 50)
    rng = np.random.default_rng(4)
    rough = np.concatenate([np.zeros((len(points), 2)), rng.normal(0.0, 5e-9, (len(points), 1))], axis=1)
    face = nodal_deformation(points, moved(points) + rough, BOWL, DISK)
    assert face.printed_through
    assert face.between > 4e-9  # what is independent from node to node cannot be foretold
    fine = nodal_deformation(points, moved(points) + 1e-3 * rough, BOWL, DISK)
    assert not fine.printed_through  # 5 pm does not show


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda p: lifted_by(p, 0.01), "lie on the clear aperture"),
        (lambda p: 1e3 * p, "lie on the clear aperture"),
        (lambda p: p * [1.0, 1.0, -1.0], "lie on the clear aperture"),
        (lambda p: p[:10], "lie on the clear aperture"),
        (lambda p: p[np.hypot(p[:, 0] - 0.1, p[:, 1] + 0.4) > 0.08], "no node within"),
        (lambda p: p[p[:, 0] < 0.15], "no node within"),
        (lambda p: p[::30], "Zernike terms|no node within"),
    ],
    ids=["beside", "unit", "sign", "few", "hole", "edge", "coarse"],
)
def test_nodes_that_do_not_describe_the_face(change, problem: str) -> None:
    points = change(mesh(DISK, 40))
    with pytest.raises(NodesError, match=problem) as caught:
        nodal_deformation(points, 0.0 * points, BOWL, DISK)
    assert caught.value.allowed


def test_displacements_of_another_unit() -> None:
    points = mesh(DISK, 40)
    with pytest.raises(NodesError, match=r"scale the face by .* %, more than 2 %: check their unit"):
        nodal_deformation(points, 0.1 * points, BOWL, DISK)
    bend = np.stack([0 * points[:, 0], 0 * points[:, 0], 0.3 * points[:, 0] ** 2], axis=-1)
    with pytest.raises(NodesError, match="more than 1 mm"):
        nodal_deformation(points, bend, BOWL, DISK)
    for moves, terms, words in (
        (np.where(np.arange(len(points))[:, None] == 7, np.nan, points), 15, "finite"),
        (points[:-1], 15, r"must be \(N, 3\), found"),
        (0.0 * points, 2, "between Z3 and Z"),
    ):
        with pytest.raises(ValueError, match=words):
            nodal_deformation(points, moves, BOWL, DISK, terms=terms)
