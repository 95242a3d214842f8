"""Laws of the ray trace, whatever the numbers: hits, laws of reflection and refraction, reversibility, rigid motions.

The structure of the bench never changes, so that one kernel serves all examples.
"""

from dataclasses import dataclass

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.surface import Surface, plane
from optics.geometry.tree import Body, RigidTree
from optics.raytrace.assembly import Assembly, Element
from tests.optics.bench import PASS, REFLECT, REFRACT, Stage, at, build, disk_points, run
from tests.optics.test_motion_properties import motions, poses, vectors

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


def on_a_base(stages: list[Stage], base: Pose) -> Assembly:
    """The stages on one body that carries all of them."""
    names = [f"base/e{i}" for i in range(len(stages))]
    elements = {
        n: Element(n, n, s.surface, s.interaction, s.aperture, s.index_after)
        for n, s in zip(names, stages, strict=True)
    }
    bodies = (
        Body("base", base, {"corner": (0.4, -0.2, 0.3)}),
        *(Body(n, s.pose, {"corner": (0.0, 0.1, 0.0)}) for n, s in zip(names, stages, strict=True)),
    )
    return Assembly(RigidTree(bodies), elements, {"all": tuple(names)})


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


@given(lens=lenses(), motion=motions(), base=poses())
def test_moving_everything_is_moving_the_rays(backend, lens, motion, base) -> None:
    """Rigidly: paths stay. Grown by a factor: paths grow by it."""
    assembly = on_a_base(lens.stages(), base)
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
