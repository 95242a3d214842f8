"""Figure errors in the path tracer: a mirror's and a camera's, against the sequential trace."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from optics.geometry.aperture import Aperture, Circle, Ellipse, Rectangle
from optics.geometry.pose import Pose
from optics.geometry.sag_terms import XYPolynomial, ZernikeSag
from optics.geometry.surface import Figure, GridFigure, Surface, ZernikeFigure, plane
from optics.geometry.tree import AT_REST, Body, Motion, RigidTree, State
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.models.scenery import Scenery, build_scenery
from scenes.models.scenery_parts import Detector, detector_surface, mirror_surface
from tests.tiers import quick
from tests.twin.path_bench import IDEAL, scene_beam
from twin.path_tracing.families import nominal_codes
from twin.path_tracing.sinks import NOMINAL
from twin.path_tracing.source import RaySource
from twin.path_tracing.tracer import PathTracer

AGREEMENT = 1e-13
"""Metres: some hundred roundings of a float64 at 1 m on either way."""

ASTIGMATIC = ZernikeFigure(0.25, (0.01, -0.02), {5: 2e-6, 7: -1e-6, 11: 5e-7})
y, x = np.mgrid[-1:1:21j, -1:1:31j]
WAVY = GridFigure(2e-6 * np.cos(4.0 * x) * np.cos(3.0 * y), (-0.3, 0.3, -0.28, 0.28))
BOWL = Surface(-0.4, -0.9, (2e-4,))
FREEFORM = Surface(
    -0.4, -0.9, (2e-4,), None, (XYPolynomial(x2=2e-3, x2y=-5e-3), ZernikeSag(radius=0.3, x0=0.01, Z7=1e-5))
)
HEAT = {"mirror": Motion(figure={4: 3e-7, 8: 2e-7}, scale=2e-5)}
CASES: dict[str, tuple[Surface, Figure | None, State]] = {
    "own": (BOWL, ASTIGMATIC, {}),
    "of a state": (BOWL, None, HEAT),
    "both": (BOWL, ASTIGMATIC, HEAT),
    "grid": (BOWL, WAVY, {}),
    "flat": (plane(), ASTIGMATIC, HEAT),
    "flat grid": (plane(), WAVY, {}),
    "grid of a state": (BOWL, None, {"mirror": Motion(grid=WAVY, stretch=2e-5)}),
    "all of a state": (BOWL, ASTIGMATIC, {"mirror": replace(HEAT["mirror"], grid=WAVY)}),
    "two grids": (BOWL, WAVY, {"mirror": Motion(figure={4: 3e-7}, grid=WAVY)}),
    "terms": (FREEFORM, ASTIGMATIC, HEAT),
    "flat grid of a state": (plane(), None, {"mirror": Motion(grid=WAVY)}),
}


def bench(surface: Surface, aperture: Aperture) -> Assembly:
    """A mirror in z = 0.8 m that light of +z meets, and a screen in z = 0."""
    tree = RigidTree((Body("mirror", Pose(np.eye(3), np.array([0.0, 0.0, 0.8]))), Body("screen", Pose())))
    mirror = Element("mirror", "mirror", surface, Interaction.REFLECT, aperture)
    screen = Element("screen", "screen", plane(), Interaction.PASS, Rectangle(0.5, 0.5))
    return Assembly(tree, {"mirror": mirror, "screen": screen}, {"all": ("mirror", "screen")})


def rays(count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    position = np.concatenate([rng.uniform(-0.24, 0.24, (count, 2)), np.full((count, 1), 0.1)], axis=1)
    direction = np.concatenate([rng.normal(0.0, 0.05, (count, 2)), np.ones((count, 1))], axis=1)
    return position, direction / np.linalg.norm(direction, axis=1)[:, None]


def scene(assembly: Assembly, state: State) -> Scenery:
    placed = assembly.place([state])
    motion = state.get("mirror", AT_REST)
    mirror = mirror_surface(assembly.elements["mirror"], placed, IDEAL, lit_side=-1.0, motion=motion)
    grid = Detector("screen", 10, 10, (0.1, 0.1))
    return Scenery((mirror, detector_surface(grid, placed.pose("screen"), IDEAL, ("screen",))), (grid,))


APERTURES = {
    "disk": Circle(0.2, (0.02, -0.03)),
    "ring": Circle(0.2, (0.01, -0.02), 0.05),
    "rectangle": Rectangle(0.2, 0.1, (0.02, -0.03)),
    "ellipse": Ellipse(0.2, 0.1, (0.02, -0.03)),
}
PAIRS = [*((case, "disk") for case in CASES), *(("own", aperture) for aperture in APERTURES if aperture != "disk")]
"""Each figure in one aperture and each aperture with one figure."""


@pytest.mark.parametrize(("case", "aperture"), quick(1, PAIRS))
def test_a_figured_mirror_as_the_sequential_trace_has_it(backend, case: str, aperture: str) -> None:
    (surface, figure, state), edge = CASES[case], APERTURES[aperture]
    assembly = bench(surface.with_figure(figure), edge)
    position, direction = rays()
    traced = trace(backend, assemble(assembly, ["all"], [state]), make_rays(backend, position, direction))
    place, _, length, valid = (a[0] for a in traced.numpy())
    scenery = scene(assembly, state)
    tracer = PathTracer(backend, scenery, {"screen": nominal_codes(scenery, assembly, "all")})
    found = tracer.run(RaySource.even(position, direction), keep=True).detections
    own = found.kind == NOMINAL
    path = found.path[own]
    np.testing.assert_array_equal(np.sort(path), np.nonzero(valid)[0])
    assert 0.1 < valid.mean() < 0.9
    np.testing.assert_allclose(found.place[own], place[path, :2], rtol=0, atol=AGREEMENT)
    np.testing.assert_allclose(found.length[own], length[path], rtol=0, atol=AGREEMENT)
    # and the figure is worth a million times as much
    ideal = trace(backend, assemble(bench(surface, edge), ["all"]), make_rays(backend, position, direction))
    assert np.max(np.abs(ideal.numpy()[0][0, path] - place[path])) > 1e6 * AGREEMENT


def test_mirrors_with_and_without_figures_stand_in_one_scene(backend, gf7_pair) -> None:
    state = {"base/forward/M1": Motion(figure={5: 1e-6}), "base/forward/M3": Motion(figure={8: 2e-7, 22: 1e-7})}
    built = build_scenery(gf7_pair, state, IDEAL, whole_focal_planes=True)
    scenery = Scenery(tuple(s for s in built.surfaces if s.solid is None), built.detectors)
    detector = "forward/focal_plane"
    codes = nominal_codes(scenery, gf7_pair.assembly, "forward/imaging")
    middle, heading, across = scene_beam(gf7_pair, backend, 0.003, 0.001)
    position = middle + np.random.default_rng(2).uniform(-0.25, 0.25, (4000, 2)) @ across
    direction = np.broadcast_to(heading, position.shape)
    found = PathTracer(backend, scenery, {detector: codes}).run(RaySource.even(position, direction), keep=True)
    own = found.detections.kind == NOMINAL
    path = found.detections.path[own]
    assert len(path) > 2000
    flipped = found.detections.place[own] * [-1.0, 1.0]  # the detector faces the light
    given = make_rays(backend, position, direction)
    place = trace(backend, assemble(gf7_pair.assembly, ["forward/imaging"], [state]), given).place()[0]
    np.testing.assert_allclose(flipped, place[path], rtol=0, atol=1e-12)  # three mirrors, ways of 4 m
    ideal = trace(backend, assemble(gf7_pair.assembly, ["forward/imaging"]), given).place()[0]
    assert np.max(np.abs(ideal - place)[path]) > 1e-6


def test_a_second_grid_on_other_samples_is_refused() -> None:
    assembly = bench(BOWL.with_figure(WAVY), Circle(0.2))
    other = {"mirror": Motion(grid=GridFigure(np.zeros((5, 5)), WAVY.bounds))}
    with pytest.raises(ValueError, match="different samples"):
        scene(assembly, other)
    with pytest.raises(ValueError, match=r"'mirror'.*different samples"):
        assemble(assembly, ["all"], [other])
    unlimited = Element("mirror", "mirror", BOWL, Interaction.REFLECT)
    with pytest.raises(ValueError, match="needs an aperture"):
        unlimited.figured(HEAT["mirror"])
