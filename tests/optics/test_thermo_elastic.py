from functools import cache

import numpy as np
import pytest
from scipy.spatial import ConvexHull, cKDTree
from skfem import CellBasis, ElementHex2, MeshTet1

from optics.geometry.aperture import Circle, Rectangle
from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.surface import Surface, ZernikeFigure, plane
from optics.geometry.zernike import zernike
from optics.materials.material import material
from optics.thermal import thermo_elastic
from optics.thermal.elastic_mesh import mirror_mesh, polyhedron_mesh
from optics.thermal.thermo_elastic import Displacement, face_change, rigid_modes
from tests.tiers import quick

SILICA = material("fused silica")
A, NU = SILICA.expansion, SILICA.poisson_ratio

# a bar of 1.2 m with one end cut at 45 degrees and the other as a roof; a rhomboid; a block with four slanted facets
BAR = np.array(
    [(0.0, y, -0.03) for y in (-0.055, 0.055)]
    + [(0.06, y, 0.03) for y in (-0.055, 0.055)]
    + [(1.145, y, z) for y in (-0.055, 0.055) for z in (-0.03, 0.03)]
    + [(1.2, 0.0, z) for z in (-0.03, 0.03)]
)
RHOMBOID = np.array([(x + z, y, z) for x in (0.0, 0.1) for y in (0.0, 0.05) for z in (0.0, 0.05)])
BLOCK = np.array(
    [(x, y, 0.0) for x in (-0.06, 0.06) for y in (-0.05, 0.05)]
    + [(x, y, 0.07) for x in (-0.03, 0.03) for y in (-0.02, 0.02)]
)
BODIES = {"bar": (BAR, 0.06), "rhomboid": (RHOMBOID, 0.03), "block": (BLOCK, 0.04)}
TURN = rotation_matrix(np.array([0.3, -0.2, 0.5]))


def linear(change: float, gradient, about=(0.0, 0.0, 0.0)):
    return lambda points: change + (points - np.asarray(about)) @ np.asarray(gradient)


def one_kelvin(points: np.ndarray) -> np.ndarray:
    return np.ones(len(points))


def without_rigid(points: np.ndarray, moved: np.ndarray) -> np.ndarray:
    modes = rigid_modes(points).T
    return moved - (modes @ np.linalg.lstsq(modes, moved.ravel(), rcond=None)[0]).reshape(-1, 3)


@cache
def bar() -> tuple[thermo_elastic.ElasticBody, thermo_elastic.Kinematic]:
    return thermo_elastic.ElasticBody(polyhedron_mesh(BAR, 0.06), SILICA), thermo_elastic.Kinematic(
        np.array([[0.1, -0.03, -0.03], [1.0, 0.01, -0.03], [0.5, 0.04, 0.03]])
    )


def volume_of(mesh) -> float:
    return float(CellBasis(mesh, ElementHex2(), intorder=5).dx.sum())


@pytest.mark.parametrize("name", quick(1, ["block", "bar", "rhomboid"]))
def test_a_polyhedron_is_filled_exactly_with_upright_cells(name: str) -> None:
    corners, spacing = BODIES[name]
    turned = corners @ TURN.T  # no face along an axis
    mesh = polyhedron_mesh(turned, spacing)
    assert isinstance(mesh, MeshTet1)
    p = mesh.p[:, mesh.t]
    volume = np.abs(np.einsum("it,it->t", np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0], axis=0), p[:, 3] - p[:, 0]))
    hull = ConvexHull(turned)
    assert volume.sum() / 6 == pytest.approx(hull.volume, rel=1e-13)
    edges = np.linalg.norm(mesh.p[:, mesh.edges[0]] - mesh.p[:, mesh.edges[1]], axis=0)
    assert edges.max() <= spacing * (1 + 1e-6)
    # a regular tetrahedron has 1, a sliver 0
    longest = np.array([[np.linalg.norm(p[:, i] - p[:, j], axis=0) for i in range(4)] for j in range(4)])
    shape = np.sqrt(2.0) * volume / np.sqrt(np.sum(longest**2, axis=(0, 1)) / 12.0) ** 3
    assert shape.min() > 0.05
    assert np.median(shape) > 0.4
    # conforming: the triangles with one tetrahedron only are the hull's skin
    triangles = mesh.p[:, mesh.facets[:, mesh.boundary_facets()]]
    area = np.linalg.norm(
        np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0], axis=0), axis=0
    )
    assert area.sum() / 2 == pytest.approx(hull.area, rel=1e-12)
    # its cells do not depend on where the origin lies: 1e-16 of 10 m of rounding
    shift = np.array([3.0, -4.0, 8.0])
    there = polyhedron_mesh(turned + shift, spacing)
    assert there.t.shape == mesh.t.shape
    assert cKDTree(mesh.p.T + shift).query(there.p.T)[0].max() < 1e-12


@pytest.mark.parametrize("behind", [1.0, -1.0])
@pytest.mark.parametrize(
    "aperture", [Circle(0.3, (0.0, -0.4)), Circle(0.3, (0.0, 0.0), 0.1), Rectangle(0.3, 0.1, (0.05, -0.3))]
)
def test_a_mirror_has_its_face_on_the_surface_and_its_volume(aperture, behind: float) -> None:
    surface = Surface(1 / 3, -1.0, (2e-3,), ZernikeFigure(0.9, terms={5: 1e-4}))
    mesh = mirror_mesh(surface, aperture, 0.06, behind, 16)
    x, y, z = mesh.doflocs
    depth = behind * (z - surface.sag(x, y))
    assert np.sum(depth == 0.0) > 100  # nodes of the face, to the last bit
    back = np.max(behind * z)
    assert np.min(depth[np.isclose(behind * z, back)]) == pytest.approx(0.06, rel=1e-12)
    nodes = np.random.default_rng(1).uniform(-1, 1, (400000, 2))
    x0, x1, y0, y1 = aperture.bounds
    px, py = x0 + (x1 - x0) * (nodes[:, 0] + 1) / 2, y0 + (y1 - y0) * (nodes[:, 1] + 1) / 2
    inside = aperture.contains(px, py)
    want = np.mean(np.where(inside, back - behind * surface.sag(px, py), 0.0)) * (x1 - x0) * (y1 - y0)
    assert volume_of(mesh) == pytest.approx(want, rel=5e-3)  # the rest is the Monte Carlo estimate's own


def test_a_disks_volume_converges_with_the_fourth_power_of_the_cells() -> None:
    # a paraboloid of focal length f: volume under it pi R^4 / (8 f), R = 0.3, f = 1.5
    want = np.pi * 0.09 * (0.06 + 0.015) - np.pi * 0.3**4 / 12.0
    errors = [abs(volume_of(mirror_mesh(Surface(1 / 3, -1.0), Circle(0.3), 0.06, 1, n)) / want - 1) for n in (8, 16)]
    assert errors[0] < 1e-3
    assert errors[1] < errors[0] / 12.0


@pytest.mark.second
def test_uniform_expansion_is_exact() -> None:
    body = thermo_elastic.ElasticBody(mirror_mesh(Surface(1 / 3, -1.0), Circle(0.3, (0.0, -0.4)), 0.06, 1, 12), SILICA)
    support = thermo_elastic.Kinematic(np.array([[0.2, -0.4, 0.1], [-0.1, -0.2, 0.1], [-0.1, -0.6, 0.1]]))
    (found,) = body.solve_many([one_kelvin], support)
    left = without_rigid(body.nodes, found.values - A * body.nodes)
    assert np.max(np.abs(left)) < 1e-12 * A * np.max(np.abs(body.nodes))


@pytest.mark.parametrize("name", quick(1, ["block", "bar", "rhomboid"]))
def test_any_gradient_reproduces_the_exact_field(name: str) -> None:
    corners, spacing = BODIES[name]
    mesh = polyhedron_mesh(corners, spacing)
    about = corners.mean(axis=0)
    spread = 0.3 * (corners[[0, 3, 5]] - about) + about
    cases = [(1.0, (0, 0, 0)), (0.0, (0, 0, 3.0)), (0.0, (0, 2.0, 0)), (0.0, (5.0, 0, 0)), (0.3, (1.0, 2.0, -3.0))]
    found = thermo_elastic.ElasticBody(mesh, SILICA).solve_many(
        [linear(c, g, about) for c, g in cases], thermo_elastic.Kinematic(spread)
    )
    for (change, gradient), u in zip(cases, found, strict=True):
        exact = thermo_elastic.free_linear_field(A, change, gradient, about)(u.nodes)
        # quadratic elements hold it; what is left is rounding, in a bar 20 times as long as thick 5e-11
        assert np.max(np.abs(without_rigid(u.nodes, u.values - exact))) < 1e-9 * np.max(np.abs(exact))


def test_the_exact_field_turns_by_a_g_cross_r() -> None:
    field = thermo_elastic.free_linear_field(A, 0.0, (0.0, 0.0, 4.0), (0.1, 0.2, 0.3))
    at, h = np.array([0.4, 0.1, 0.2]), 1e-3
    slope = np.stack([(field(at + h * e) - field(at - h * e)) / (2 * h) for e in np.eye(3)], axis=1)  # d_j u_i
    spin = 0.5 * np.array([slope[2, 1] - slope[1, 2], slope[0, 2] - slope[2, 0], slope[1, 0] - slope[0, 1]])
    np.testing.assert_allclose(spin, A * np.cross([0, 0, 4.0], at - [0.1, 0.2, 0.3]), rtol=1e-9, atol=1e-18)
    strain = 0.5 * (slope + slope.T)
    np.testing.assert_allclose(strain, A * 4.0 * (0.2 - 0.3) * np.eye(3), rtol=1e-9, atol=1e-16)
    assert np.all(field(np.array([[0.1, 0.2, 0.3]])) == 0.0)


@pytest.mark.second
def test_the_kinematic_support_holds_its_six_components() -> None:
    body, support = bar()
    (u,) = body.solve_many([linear(0.3, (1.0, 2.0, -3.0))], support)
    moved = u.at(support.points)
    along = support.points[1] - support.points[0]
    normal = np.cross(along, support.points[2] - support.points[0])
    size = np.max(np.abs(u.values))
    assert np.max(np.abs(moved[0])) < 1e-12 * size
    assert np.linalg.norm(np.cross(moved[1], along / np.linalg.norm(along))) < 1e-12 * size
    assert abs(moved[2] @ normal) / np.linalg.norm(normal) < 1e-12 * size
    assert abs(moved[1] @ along) > 1e-3 * size  # along the line it is free


@pytest.mark.second
@pytest.mark.parametrize("cells", quick(1, [4, 9, 16]))
@pytest.mark.parametrize("aperture", [Circle(0.3, (0.0, -0.4)), Rectangle(0.3, 0.1)])
def test_every_point_of_a_curved_face_is_found_in_its_own_cell(aperture, cells: int) -> None:
    surface = Surface(1 / 3, -1.0)
    body = thermo_elastic.ElasticBody(mirror_mesh(surface, aperture, 0.06, 1, cells), SILICA)
    x0, x1, y0, y1 = aperture.bounds
    u = np.random.default_rng(5).uniform(-1, 1, (1500, 2))
    x, y = 0.5 * (x0 + x1 + (x1 - x0) * u[:, 0]), 0.5 * (y0 + y1 + (y1 - y0) * u[:, 1])
    inside = aperture.contains(x, y)
    points = np.stack([x, y, surface.sag(x, y)], axis=-1)[inside]
    # the field u = r, which curved cells hold as well
    np.testing.assert_allclose(Displacement(body.nodes, body.nodes, body._finder).at(points), points, atol=1e-9)


@pytest.mark.second
def test_load_cases_add_up_and_differ_not_from_single_ones() -> None:
    body, support = bar()
    fields = [lambda p: p[:, 0] ** 2, lambda p: np.sin(30 * p[:, 1])]
    both = lambda p: fields[0](p) + fields[1](p)  # noqa: E731
    first, second, total = body.solve_many([*fields, both], support)
    alone = thermo_elastic.ElasticBody(polyhedron_mesh(BAR, 0.06), SILICA).solve_many([fields[1]], support)[0]
    size = np.max(np.abs(total.values))
    np.testing.assert_allclose(first.values + second.values, total.values, atol=1e-10 * size)
    np.testing.assert_allclose(alone.values, second.values, atol=1e-10 * size)


def layer(half: float, cells: int) -> float:
    """Displacement (m/K) of a layer's free face, in its middle; the layer of 2 cm is glued at its back."""
    thick = 0.02
    body = thermo_elastic.ElasticBody(mirror_mesh(plane(), Rectangle(half, half), thick, 1, cells), SILICA)
    (u,) = body.solve_many([one_kelvin], thermo_elastic.Bonded(lambda nodes: nodes[:, 2] > thick - 1e-9))
    return float(-u.at([[0.0, 0.0, 0.0]])[0, 2])


@pytest.mark.second
def test_a_layer_that_cannot_widen_grows_in_thickness_by_its_confined_expansion() -> None:
    want = A * 0.02 * (1 + NU) / (1 - NU)
    assert want / (A * 0.02) > 1.35  # far from a free layer's
    # the rim's disturbance decays like exp(-distance / thickness) and more: 16 times as wide as thick
    coarse, fine = layer(0.16, 12), layer(0.16, 18)
    assert fine == pytest.approx(want, rel=1e-4)
    assert abs(fine - want) < abs(coarse - want)
    assert fine == pytest.approx(coarse, rel=1e-4)
    # and a narrow one is disturbed more: the agreement is not by construction
    assert abs(layer(0.04, 8) / want - 1) > 1e-3


@pytest.mark.second
def test_two_layers_of_one_modulus_bend_as_timoshenko_says() -> None:
    # Timoshenko, J. Opt. Soc. Am. 11, 233 (1925), layers of equal thickness and modulus: curvature 3/2 a T / h.
    # One material of which the upper half is hotter is such a pair; in a plate both directions bend alike.
    h = 0.02
    mesh = mirror_mesh(plane(), Rectangle(0.2, 0.2), h, 1, 20)
    support = thermo_elastic.Kinematic(np.array([[0.1, 0.0, 0.01], [-0.1, 0.1, 0.01], [-0.1, -0.1, 0.01]]))
    u = thermo_elastic.ElasticBody(mesh, SILICA).solve_many([lambda p: 1.0 * (p[:, 2] > h / 2)], support)[0]
    r = 0.1  # well inside: at the rim the layers are relaxed
    line = u.at([[-r, 0, h / 2], [0, 0, h / 2], [r, 0, h / 2]])[:, 2]
    bend = (line[0] - 2 * line[1] + line[2]) / r**2
    assert bend == pytest.approx(-1.5 * A / h, rel=2e-3)


def test_a_foundation_that_expands_alike_leaves_no_stress() -> None:
    body = thermo_elastic.ElasticBody(polyhedron_mesh(BLOCK, 0.04), SILICA)
    glued = thermo_elastic.Bonded(lambda nodes: nodes[:, 2] < 1e-9, A, 2.0, (0.1, 0.2, 0.3))
    still = thermo_elastic.Bonded(glued.where)
    together, alone, none = body.solve_many(
        [lambda p: np.full(len(p), 2.0), lambda p: np.full(len(p), 2.0), lambda p: np.zeros(len(p))],
        [glued, still, thermo_elastic.Bonded(glued.where, A, 2.0, (0.1, 0.2, 0.3))],
    )
    exact = 2.0 * A * (body.nodes - [0.1, 0.2, 0.3])
    np.testing.assert_allclose(together.values, exact, atol=1e-13 * np.max(np.abs(exact)))
    np.testing.assert_allclose(alone.values + none.values, together.values, atol=1e-13 * np.max(np.abs(exact)))
    assert np.max(np.abs(alone.values[body.nodes[:, 2] < 1e-9])) == 0.0
    assert np.max(np.abs(alone.values)) > 1e-8


@pytest.mark.second
def test_a_gradient_through_a_plate_is_a_defocus_of_radius_one_over_a_g() -> None:
    g = 100.0
    aperture, radius = Rectangle(0.2, 0.15), 0.25
    mesh = mirror_mesh(plane(), aperture, 0.03, 1, 10)
    support = thermo_elastic.Kinematic(np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.0, 0.1, 0]]))
    u = thermo_elastic.ElasticBody(mesh, SILICA).solve_many([linear(0.0, (0.0, 0.0, g))], support)[0]
    found = face_change(u, plane(), aperture, Pose())
    # the hot side is at +z, where the plate gets longer: z = -a g r^2 / 2
    assert found.figure[4] == pytest.approx(-A * g * radius**2 / (4 * np.sqrt(3)), rel=1e-9)
    others = [found.figure[j] for j in range(5, 16)]
    assert np.max(np.abs(others)) + found.residual_rms < 1e-9 * abs(found.figure[4])
    assert set(found.figure) == set(range(4, 16))


@pytest.mark.second
def test_a_turned_and_shifted_face_with_a_figure_is_read_back() -> None:
    body, _ = bar()
    pose = Pose(rotation_matrix(np.array([0.0, np.pi / 2, 0.0])), np.array([0.3, 0.0, 0.0]))
    aperture = Circle(0.02, (0.002, 0.003))
    rotate, shift = np.array([2e-6, -3e-6, 1e-6]), np.array([1e-7, 2e-7, -3e-7])
    inside = pose.inverse().apply(body.nodes)
    # a field that the elements hold exactly: rigid and quadratic, in the face's own frame
    u, v = (inside[:, 0] - 0.002) / 0.02, (inside[:, 1] - 0.003) / 0.02
    local = shift + np.cross(rotate, inside)
    local[:, 2] += 5e-9 * zernike(4, u, v) - 2e-9 * zernike(5, u, v) + 3e-9 * zernike(6, u, v)
    field = Displacement(body.nodes, local @ pose.rotation.T, body._finder)
    found = face_change(field, plane(), aperture, pose)
    # quadratics in-plane give no rigid part; piston and tilts are orthogonal to Z4..Z6 on the disk
    np.testing.assert_allclose(found.rotate, rotate, rtol=1e-8)
    np.testing.assert_allclose(found.shift, shift, rtol=1e-8)
    assert found.figure[4] == pytest.approx(5e-9, rel=1e-6)
    assert found.figure[5] == pytest.approx(-2e-9, rel=1e-6)
    assert found.figure[6] == pytest.approx(3e-9, rel=1e-6)
    assert found.residual_rms < 1e-15


def test_the_disk_is_that_of_the_figure_when_there_is_one() -> None:
    body, support = bar()
    (u,) = body.solve_many([linear(0.0, (0.0, 0.0, 2.0))], support)
    pose, aperture = Pose(np.eye(3), np.array([0.5, 0.0, 0.03])), Circle(0.04)
    small = face_change(u, plane(), aperture, pose, terms=6)
    large = face_change(u, plane().with_figure(ZernikeFigure(0.08)), aperture, pose, terms=6)
    assert large.figure[4] == pytest.approx(4.0 * small.figure[4], rel=1e-6)
    assert set(face_change(u, plane(), aperture, pose, terms=3).figure) == set()


def test_supports_bonds_temperatures_and_points_that_cannot_be_are_refused() -> None:
    body, support = bar()
    (u,) = body.solve_many([one_kelvin], support)
    outside = thermo_elastic.Kinematic(np.array([[0.1, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.02]]))
    edge = thermo_elastic.Bonded(lambda nodes: (np.abs(nodes[:, 1]) < 1e-9) & (nodes[:, 0] > 1.2 - 1e-9))
    pose = Pose(np.eye(3), np.array([0.5, 0.0, 0.03]))
    for call, words in (
        (lambda: body.solve_many([one_kelvin], outside), r"\[0.5, 0.5, 0.0\] m lies outside"),
        (
            lambda: body.solve_many([one_kelvin], thermo_elastic.Bonded(lambda nodes: nodes[:, 2] > 1.0)),
            "three nodes that are not on",
        ),
        (lambda: body.solve_many([one_kelvin], edge), "three nodes that are not on a line"),
        (lambda: body.solve_many([lambda p: np.where(p[:, 0] > 0.5, np.nan, 0.0)], support), "not finite at"),
        (lambda: body.solve_many([lambda p: p], support), "one value for each"),
        (lambda: u.at([[0.5, 0.0, 0.031]]), "lies outside of the body"),
        (lambda: u.at([0.5, 0.0, 0.0]), "shape"),
        (lambda: face_change(u, plane(), Circle(0.2), pose), "lies outside of the body"),
        (lambda: face_change(u, plane(), Circle(0.02), Pose(), terms=2), "between Z3 and"),
    ):
        with pytest.raises(ValueError, match=words):
            call()
