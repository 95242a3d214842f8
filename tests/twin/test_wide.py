"""Traces of many rays at once: on a GPU, and on the processor's vectors, by the same code.

A GPU's results are held against the processor's; where there is none, the processor runs the same tests against small
launches of its own.
"""

from __future__ import annotations

import numpy as np
import pytest

from optics.materials.fresnel_scatter import Finish
from optics.numerics.backend import Backend, BackendUnavailable, load_backend
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from tests.optics.bench import disk_points
from tests.twin.path_bench import glass_scene, scene_beam, slab
from twin.path_tracing.tracer import FAINT, PathTracer, RaySource

RAYS = 20_000


@pytest.fixture(params=["llvm", pytest.param("cuda", marks=pytest.mark.gpu)])
def wide(request: pytest.FixtureRequest) -> Backend:
    try:
        return load_backend(request.param)
    except BackendUnavailable as error:
        pytest.skip(str(error))


def test_a_wide_trace_is_that_of_few_rays(wide: Backend, backend: Backend, gf7_pair) -> None:
    middle, heading, across = scene_beam(gf7_pair, backend)
    position = middle + disk_points(RAYS, 0.3) @ across
    systems = assemble(gf7_pair.assembly, ["forward/imaging"])
    many = [a[0] for a in trace(wide, systems, make_rays(wide, position, heading)).numpy()]
    some = slice(1000, 1013)  # no whole vector
    few = [a[0] for a in trace(backend, systems, make_rays(backend, position[some], heading)).numpy()]
    np.testing.assert_array_equal(many[3][some], few[3])
    for one, other in zip(many[:3], few[:3], strict=True):
        np.testing.assert_allclose(one[some], other, rtol=0, atol=1e-12)


@pytest.mark.second
def test_wide_paths_are_those_of_small_launches(wide: Backend, backend: Backend) -> None:
    """The same paths draw the same numbers; on triangles one in a thousand may go otherwise at an edge."""
    scenery = glass_scene(slab(0.3, 0.02), 1.5, Finish(reflectance=0.05, transmission=0.9, diffuse=0.02))
    rng = np.random.default_rng(3)
    direction = np.column_stack([0.2 * rng.uniform(-1.0, 1.0, (RAYS, 2)), np.ones(RAYS)])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    source = RaySource.even(np.array([[0.0, 0.0, -0.2]]), direction)
    many = PathTracer(wide, scenery, sampling=FAINT).run(source, seed=2)
    few = PathTracer(backend, scenery, sampling=FAINT).run(source, seed=2, chunk=999)
    assert many.paths == few.paths == RAYS
    found, expected = ({(f.detector, f.text): f for f in run.families} for run in (many, few))
    rough = 1e-3 if wide.name == "cuda" else 1e-12
    for key, family in expected.items():
        if family.count > 100:
            assert found[key].energy == pytest.approx(family.energy, rel=rough)
            np.testing.assert_allclose(found[key].centroid, family.centroid, rtol=0, atol=rough)
