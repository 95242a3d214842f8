import re

import numpy as np
import pytest

from optics.geometry.aperture import Circle
from optics.geometry.sag_terms import XYPolynomial, ZernikeSag
from optics.geometry.surface import GridFigure, Surface, ZernikeFigure, plane
from optics.geometry.tree import Motion
from optics.geometry.zernike import zernike
from tests.optics.bench import Stage, beam, build, disk_points, run, unit

Z = np.array([0.0, 0.0, 1.0])
SLANTED = unit(0.1, -0.2, 1.0)


def wavy_grid(amplitude: float) -> tuple[GridFigure, float]:
    """amplitude * cos(kx) cos(ky): flat at its edges, as the spline is, so that the spline is accurate there."""
    k = 2 * np.pi
    x = np.linspace(-0.5, 0.5, 81)
    y = np.linspace(-0.5, 0.5, 61)
    return GridFigure(amplitude * np.outer(np.cos(k * y), np.cos(k * x)), (-0.5, 0.5, -0.5, 0.5)), k


TERMS = XYPolynomial(x2=0.02, x2y=-0.03), ZernikeSag(radius=0.5, x0=0.1, Z5=2e-4)


def test_further_terms_of_a_sag_by_their_formulas() -> None:
    x, y = np.random.default_rng(1).uniform(-0.3, 0.3, (2, 20))
    want = 0.02 * x**2 - 0.03 * x**2 * y + 2e-4 * np.sqrt(6.0) * 2.0 * (x - 0.1) * y / 0.5**2
    np.testing.assert_allclose(Surface(terms=TERMS).sag(x, y), want, rtol=0, atol=1e-16)
    for name, power in XYPolynomial.POWERS.items():
        a, b = (name.count(v) and int((re.search(rf"{v}(\d?)", name) or [""])[1] or 1) for v in "xy")
        assert a + b == 1 - power
        np.testing.assert_allclose(XYPolynomial(**{name: 0.1}).sag(x, y), 0.1 * x**a * y**b, rtol=1e-14)


@pytest.mark.parametrize("base", [plane(), Surface(-0.2, -1.2, (-5e-5, 1e-6)), Surface(-0.2, -1.2, terms=TERMS)])
def test_figured_surfaces_meet_their_own_sag(backend, base: Surface) -> None:
    x, y = np.linspace(-0.55, 0.5, 61), np.linspace(-0.6, 0.45, 71)
    grid = GridFigure(2e-6 * np.outer(np.cos(3.0 * y), np.sin(4.0 * x)), (-0.55, 0.5, -0.6, 0.45))
    for figure in (ZernikeFigure(0.7, (0.1, -0.05), {4: 1e-6, 7: 2e-6, 11: -1e-6, 24: 5e-7}), grid):
        surface = base.with_figure(figure)
        position, direction = beam(disk_points(200, 0.4), -1.0, SLANTED)
        hit, leaving, _, valid = run(backend, build(Stage(surface)), position, direction)
        assert valid.all()
        np.testing.assert_allclose(hit[:, 2], surface.sag(hit[:, 0], hit[:, 1]), rtol=0, atol=2e-16)
        h = 1e-5
        steps = ((h, 0.0), (0.0, h))
        slope = [
            (surface.sag(hit[:, 0] + dx, hit[:, 1] + dy) - surface.sag(hit[:, 0] - dx, hit[:, 1] - dy)) / (2 * h)
            for dx, dy in steps
        ]
        normal = np.stack([-slope[0], -slope[1], np.ones(len(hit))], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        want = direction - 2 * np.sum(direction * normal, axis=-1, keepdims=True) * normal
        np.testing.assert_allclose(leaving, want, atol=1e-9)


def test_grid_figure_follows_the_function_it_samples(backend) -> None:
    amplitude = 1e-6
    grid, k = wavy_grid(amplitude)
    position, direction = beam(disk_points(300, 0.45), -1.0, Z)
    hit, leaving, _, valid = run(backend, build(Stage(Surface(figure=grid))), position, direction)
    assert valid.all()
    x, y = position[:, 0], position[:, 1]
    np.testing.assert_allclose(hit[:, 2], amplitude * np.cos(k * x) * np.cos(k * y), atol=2e-6 * amplitude)
    # light of +z leaves at twice the slope; (-2 sx, -2 sy) with z reversed
    slope_x = -amplitude * k * np.sin(k * x) * np.cos(k * y)
    np.testing.assert_allclose(leaving[:, 0], 2 * slope_x, atol=3e-4 * amplitude * k)
    np.testing.assert_allclose(grid.sag(x, y), hit[:, 2], atol=2e-16)
    # beyond its samples the figure is that of its edge
    points = np.array([[0.6, 0.1], [-0.7, 0.2], [0.1, 0.58], [-0.2, -0.9], [0.6, 0.6]])
    hit, *_ = run(backend, build(Stage(Surface(figure=grid))), *beam(points, -1.0, Z))
    np.testing.assert_allclose(hit[:, 2], grid.sag(*np.clip(points, -0.5, 0.5).T), atol=2e-16)


def test_a_state_adds_its_figure_on_the_aperture(backend) -> None:
    aperture = Circle(0.5, (0.1, 0.0))
    position, direction = beam(disk_points(50, 0.3), -1.0, Z)
    bench = build(Stage(plane(), aperture=aperture))
    hit, _, _, _ = run(backend, bench, position, direction, {"e0": Motion(figure={6: 3e-7})})
    want = 3e-7 * zernike(6, (position[:, 0] - 0.1) / 0.5, position[:, 1] / 0.5)
    np.testing.assert_allclose(hit[:, 2], want, atol=1e-19)


def test_bad_figures_are_refused(backend) -> None:
    with pytest.raises(ValueError, match="has no disk for a figure"):
        plane().figure_disk(None)
    with pytest.raises(ValueError, match="needs an aperture"):
        run(backend, build(Stage(plane())), np.zeros((1, 3)), Z[None], {"e0": Motion(figure={4: 1e-9})})
    with pytest.raises(ValueError, match="supports no figure of type str"):  # it would be left out without a word
        run(backend, build(Stage(plane().with_figure("bump"))), np.zeros((1, 3)), Z[None])  # type: ignore[arg-type]


def test_a_grid_on_the_samples_of_another() -> None:
    """On finer samples the spline is itself to fourth order of them, and it stays what it was on its own."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 31), np.linspace(-0.4, 0.4, 25))
    grid = GridFigure(1e-8 * np.cos(6.0 * x) * np.cos(5.0 * y), (-0.5, 0.5, -0.4, 0.4))
    np.testing.assert_allclose(grid.sampled_as(grid).values, grid.values, rtol=0, atol=1e-22)
    finer = grid.sampled_as(GridFigure(np.zeros((97, 121)), (-0.5, 0.5, -0.4, 0.4)))
    u, v = np.random.default_rng(1).uniform(-0.35, 0.35, (2, 200))
    np.testing.assert_allclose(finer.sag(u, v), grid.sag(u, v), rtol=0, atol=1e-12)


def test_a_radius_and_a_conic_that_change_are_another_surface(backend) -> None:
    """Of a state as of a prescription, with the terms of the asphere and a figure as they were."""
    change = Motion(radius=2e-3, conic=-0.03, figure={5: 1e-7})
    own = Surface(-0.2, -1.2, (-5e-5, 1e-6))
    other = Surface(-0.2 / (1.0 + 2e-3), -1.23, (-5e-5, 1e-6))
    position, direction = beam(disk_points(100, 0.4), -1.0, SLANTED)
    aperture = Circle(0.5)
    changed = run(backend, build(Stage(own, aperture=aperture)), position, direction, state={"e0": change})
    made = run(
        backend, build(Stage(other, aperture=aperture)), position, direction, state={"e0": Motion(figure={5: 1e-7})}
    )
    for one, two in zip(changed, made, strict=True):
        np.testing.assert_array_equal(one, two)
    seen = build(Stage(own, aperture=aperture)).elements["e0"].figured(change)
    assert (seen.curvature, seen.conic) == (other.curvature, other.conic)
