"""The trace against closed forms. Light travels toward +z unless a test says otherwise."""

import numpy as np
import pytest

from optics.geometry.surface import Surface, plane
from optics.raytrace.trace import BeamMissedError, require_some
from tests.optics.bench import PASS, REFRACT, Stage, at, beam, build, disk_points, run, unit

Z = np.array([0.0, 0.0, 1.0])


def test_paraboloid_focuses_the_axis_with_equal_paths(backend) -> None:
    f = 2.0
    bench = build(Stage(Surface(-1 / (2 * f), -1.0)), Stage(plane(), PASS, at(-f)))
    position, direction = beam(disk_points(500, 0.9), -5.0, Z)
    hit, leaving, path, valid = run(backend, bench, position, direction)
    assert valid.all()
    np.testing.assert_allclose(hit, np.broadcast_to([0, 0, -f], hit.shape), atol=2e-15)
    np.testing.assert_allclose(path, 5.0 + f, rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(leaving, axis=-1), 1.0, atol=1e-15)


@pytest.mark.parametrize("apart", [0.0, 1e-15, 1e-12, -1e-9, 1e-6, -1e-3])
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_rays_from_the_other_sheet_of_a_hyperboloid_meet_the_one_with_the_vertex(backend, apart, sense) -> None:
    """The secondary of a Cassegrain whose image is as far from it as the primary's focus is from the primary: the
    primary's vertex lies on its other sheet.
    """
    radius, conic = -0.857142857142857, -3.44897959183673
    other = 2.0 * radius / (1.0 + conic)
    start = np.array([[0.0, 0.0, other + apart]] * 3 + [[0.03, -0.02, other + apart]])
    heading = np.array([unit(0.0, 0.0, -1.0), unit(1.7e-3, 0.0, -1.0), unit(0.02, 0.01, -1.0), unit(0.0, 0.0, -1.0)])
    hit, _, path, valid = run(backend, build(Stage(Surface(1.0 / radius, conic), PASS)), start, sense * heading)
    assert valid.all()
    x, y, z = hit.T
    square = x * x + y * y
    sag = square / radius / (1.0 + np.sqrt(1.0 - (1.0 + conic) * square / radius**2))
    np.testing.assert_allclose(z, sag, rtol=0, atol=1e-15)
    np.testing.assert_allclose(start + path[:, None] * sense * heading, hit, rtol=0, atol=1e-15)


def test_total_internal_reflection_is_invalid_and_finite(backend) -> None:
    angle = np.radians([41.7, 41.9, 80.0])  # the critical angle of 1.5 is 41.81 deg
    incoming = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=-1)
    bench = build(Stage(plane(), PASS, index_after=1.5), Stage(plane(), REFRACT, at(1.0)))
    hit, leaving, path, valid = run(backend, bench, np.zeros((3, 3)), incoming)
    np.testing.assert_array_equal(valid, [True, False, False])
    assert np.isfinite(hit).all()
    assert np.isfinite(leaving).all()
    assert np.isfinite(path).all()


@pytest.mark.parametrize(
    ("surface", "interaction"),
    [
        (plane(), REFRACT),
        (Surface(0.5), REFRACT),
        (Surface(-0.5, -2.5), REFRACT),
        (Surface(0.5, 3.0), REFRACT),
        (Surface(-0.15, -1.5, (-5e-5, -5e-6)), REFRACT),
    ],
)
def test_whatever_comes_valid_rays_are_on_the_surface_and_the_rest_is_finite(backend, surface, interaction) -> None:
    rng = np.random.default_rng(7)
    position, direction = rng.normal(size=(2, 4000, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    direction[:5] = [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1]]
    hit, leaving, path, valid = run(backend, build(Stage(surface, interaction, index_after=1.5)), position, direction)
    for name, array in {"hit": hit, "leaving": leaving, "path": path}.items():
        assert np.isfinite(array).all(), name
    assert valid.sum() > 400
    np.testing.assert_allclose(hit[valid, 2], surface.sag(hit[valid, 0], hit[valid, 1]), rtol=1e-12, atol=2e-12)
    np.testing.assert_allclose(np.linalg.norm(leaving[valid], axis=-1), 1.0, atol=1e-12)


def test_a_ray_that_misses_is_invalid(backend) -> None:
    position, direction = beam(np.array([[0.0, 0.0], [1.9, 0.0], [2.1, 0.0], [5.0, 5.0]]), -5.0, Z)
    for surface in (Surface(-0.5), Surface(-0.5, 0.0, (1e-5,))):
        _, _, _, valid = run(backend, build(Stage(surface)), position, direction)
        np.testing.assert_array_equal(valid, [True, True, False, False])


def test_a_beam_that_misses_everything_is_an_explained_error() -> None:
    with pytest.raises(BeamMissedError, match="no ray gets through the test in 1 of 2 cases"):
        require_some(np.array([[True, False], [False, False]]), "the test")
    require_some(np.array([[True, False]]), "the test")
