"""The trace against closed forms, and its laws whatever the numbers. Light travels toward +z unless a test says not.

The structure of the bench of the laws never changes, so that one kernel serves all examples.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.surface import Surface, plane
from optics.raytrace.trace import BeamMissedError, require_rays
from tests.optics.bench import PASS, REFLECT, REFRACT, Stage, at, beam, build, disk_points, run, unit
from tests.optics.test_tree import motions, poses, vectors

Z = np.array([0.0, 0.0, 1.0])


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
    with pytest.raises(BeamMissedError, match="no ray passes through the test in 1 of 2 cases"):
        require_rays(np.array([[True, False], [False, False]]), "the test")
    require_rays(np.array([[True, False]]), "the test")


POINTS = disk_points(30, 0.1)
WAY = np.array([0.02, -0.03, 1.0]) / np.linalg.norm([0.02, -0.03, 1.0])
START = np.column_stack([POINTS, np.full(30, -1.0)])
HEADING = np.broadcast_to(WAY, START.shape)


@dataclass(frozen=True)
class Lens:
    """A tilted lens of two aspheres and a tilted conic mirror behind it."""

    front: Surface
    back: Surface
    mirror: Surface
    index: float
    tilts: np.ndarray

    def stages(self) -> list[Stage]:
        def standing(k: int, z: float) -> Pose:
            return Pose(rotation_matrix(self.tilts[k]), np.array([0.0, 0.0, z]))

        return [
            Stage(self.front, REFRACT, standing(0, 0.0), index_after=self.index),
            Stage(self.back, REFRACT, standing(1, 0.05)),
            Stage(self.mirror, REFLECT, standing(2, 1.0)),
            Stage(plane(), PASS, at(0.5)),
        ]


@st.composite
def surfaces(draw) -> Surface:
    """Curved: a plane would be another kernel."""
    curvature = draw(st.sampled_from((-1.0, 1.0))) * draw(st.floats(0.01, 0.8))
    return Surface(curvature, draw(st.floats(-2.0, 1.0)), (draw(st.floats(-1e-2, 1e-2)),))


@st.composite
def lenses(draw) -> Lens:
    tilts = np.array([draw(vectors(0.05)) for _ in range(3)])
    return Lens(draw(surfaces()), draw(surfaces()), draw(surfaces()), draw(st.floats(1.3, 1.9)), tilts)


@pytest.mark.second
@given(lens=lenses())
def test_hits_and_the_laws_of_reflection_and_refraction(backend, lens) -> None:
    """n d before and n' d' after a surface differ along its normal only; the normal is from differences of the sag over
    10 um, whose error is 1e-5^2 of its third derivative and 1e-16 / 1e-5 of rounding.
    """
    stages = lens.stages()
    before, way, index = START, HEADING, 1.0
    for k in range(3):
        stage = stages[k]
        enter = Stage(plane(), PASS, at(-2.0), index_after=index)
        hit, leaving, _, valid = run(backend, build(enter, stage), before, way)
        assert valid.all()
        local = stage.pose.inverse().apply(hit)
        np.testing.assert_allclose(local[:, 2], stage.surface.sag(*local[:, :2].T), rtol=0, atol=2e-15)
        h = 1e-5
        x, y = local[:, :2].T
        slope = [
            (stage.surface.sag(x + a, y + b) - stage.surface.sag(x - a, y - b)) / (2 * h) for a, b in ((h, 0), (0, h))
        ]
        normal = np.stack([-slope[0], -slope[1], np.ones(len(x))], -1) @ stage.pose.rotation.T
        after = index if stage.interaction is REFLECT else stage.index_after
        turn = np.cross(normal, index * way - after * leaving)
        np.testing.assert_allclose(turn, 0.0, atol=3e-10)
        along = np.sum(normal * way, -1) * np.sum(normal * leaving, -1)
        assert np.all(along < 0.0 if stage.interaction is REFLECT else along > 0.0)
        before, way, index = hit, leaving, after


@pytest.mark.second
@given(lens=lenses(), motion=motions(), base=poses())
def test_moving_everything_is_moving_the_rays(backend, lens, motion, base) -> None:
    """Rigidly: paths stay. Grown by a factor: paths grow by it."""
    assembly = build(*lens.stages(), base=base)
    position, direction = base.apply(START), HEADING @ base.rotation.T
    hit, leaving, path, valid = run(backend, assembly, position, direction)
    assert valid.all()
    placed = assembly.place([{"base": motion}])
    moved, growth = placed.pose("base"), 1.0 + motion.scale
    start = moved.apply(growth * START)
    there, away, way, valid = run(backend, assembly, start, HEADING @ moved.rotation.T, {"base": motion})
    assert valid.all()
    local = base.inverse().apply(hit)
    np.testing.assert_allclose(there, moved.apply(growth * local), rtol=0, atol=4e-13)
    np.testing.assert_allclose(away, leaving @ base.rotation @ moved.rotation.T, rtol=0, atol=4e-13)
    np.testing.assert_allclose(way, growth * path, rtol=0, atol=4e-14)
