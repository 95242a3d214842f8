"""Clear ways between apertures: paths that take them are those that a search finds, one by one, and what stands in the
way closes it.
"""

from __future__ import annotations

import numpy as np
import pytest

from optics.geometry.aperture import Circle, Rectangle
from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.surface import plane
from optics.geometry.tree import Body, Motion, RigidTree
from optics.materials.finish import BLACK, Finish
from optics.raytrace.assembly import Assembly, Element, Interaction
from scenes.models.scenery import Scenery, build_scenery
from scenes.models.scenery_parts import Finishes, mirror_surface
from scenes.specs.baffle import Plate
from tests.tiers import quick
from tests.twin.path_bench import IDEAL, facing, screen, ways_and_search
from twin.path_tracing.clear_ways import ClearWays
from twin.path_tracing.families import Event, code
from twin.path_tracing.path_result import PathResult
from twin.path_tracing.source import DiskSource
from twin.path_tracing.stray_light import monitor_families
from twin.path_tracing.tracer import BALANCED, FAINT, Sampling

PATHS = 20_000
STATE = {
    "base/forward/M2": Motion(shift=(1e-5, 2e-5, 3e-5), rotate=(1e-5, 0.0, 2e-5), pivot="centre"),
    "base/forward/monitor/left/prism_0": Motion(rotate=(1e-4, 2e-4, 0.0)),
}


def same(one: PathResult, other: PathResult) -> None:
    """All detections path by path, and where the light went; only the start of Newton's method differs."""
    a, b = (run.detections for run in (one, other))
    order = [np.lexsort((d.length, d.path)) for d in (a, b)]
    for name in ("path", "detector", "kind", "signature"):
        np.testing.assert_array_equal(getattr(a, name)[order[0]], getattr(b, name)[order[1]])
    for name in ("place", "length"):
        np.testing.assert_allclose(getattr(a, name)[order[0]], getattr(b, name)[order[1]], rtol=0, atol=1e-12)
    np.testing.assert_allclose(a.weight[order[0]], b.weight[order[1]], rtol=1e-9)
    assert one.balance.escaped == pytest.approx(other.balance.escaped, rel=1e-9)
    assert one.balance.absorbed == pytest.approx(other.balance.absorbed, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize("sampling", quick(1, [BALANCED, FAINT]), ids=["balanced", "faint"])
@pytest.mark.parametrize(
    ("name", "state"),
    [("gf7_pair", {}), pytest.param("monitor_pair", STATE, marks=pytest.mark.second)],
    ids=["gf7_pair", "monitor_pair_perturbed"],
)
def test_paths_on_clear_ways_are_those_of_a_search(backend, instrument, name: str, state: dict, sampling: Sampling):
    chosen = instrument(name)
    scenery = build_scenery(chosen, state)
    for channel in (0, 1):
        found = ways_and_search(backend, chosen, scenery, PATHS, sampling, state, channel)
        assert len(found.runs[0].detections.path) > 0.1 * PATHS
        same(*found.runs)


def test_light_out_and_back_has_clear_ways_everywhere(gf7_pair) -> None:
    """From the pinhole to the area CCD there are 25 surfaces: 25 ways between them and the detector, and the first."""
    scenery = build_scenery(gf7_pair, {}, IDEAL)
    families = monitor_families(scenery, gf7_pair)
    found = ClearWays(scenery, families)
    assert len(found.ways) == 25 * len(families)
    ends = [way.after for way in found.ways]
    assert ends.count(-1) == len(families)  # each is one chain
    assert all(after in (-1, number + 1) for number, after in enumerate(ends))


def test_a_baffle_in_the_way_closes_it(backend, gf7_pair) -> None:
    """A rod across the beam between M1 and M2 takes some of the light; with and without ways it takes the same."""
    bare = build_scenery(gf7_pair, {}, IDEAL)
    mirrors = [bare.surfaces[bare.of_element(f"forward/{name}")] for name in ("M1", "M2")]
    middles = [mirror.pose.apply(np.array([*mirror.apertures[0].centre, 0.0])) for mirror in mirrors]
    body = gf7_pair.assembly.nominal_pose("base/forward").inverse()
    place = body.apply(0.5 * (middles[0] + middles[1]))
    rod = Plate("rod", "base/forward", Pose(np.eye(3), place), Rectangle(0.3, 0.002), BLACK)
    scenery = build_scenery(gf7_pair, {}, IDEAL, [rod])
    families = monitor_families(scenery, gf7_pair)
    numbers = {scenery.of_element(f"forward/{name}") for name in ("M1", "M2")}
    pairs = [[{way.start, way.end.surface} for way in ClearWays(s, families).ways] for s in (bare, scenery)]
    assert [numbers in found for found in pairs] == [True, False]
    runs = ways_and_search(backend, gf7_pair, scenery, PATHS).runs
    assert runs[0].balance.absorbed["rod"] > 1e-3
    same(*runs)


def two_mirrors(*more: tuple[float, float]) -> Scenery:
    """A mirror at z = 0 of 10 mm radius, a screen of 20 mm at z = 0.2, and small mirrors of 1 mm at given x and z."""
    bodies, elements = (
        [Body("mirror")],
        {"mirror": Element("mirror", "mirror", plane(), Interaction.REFLECT, Circle(0.01))},
    )
    for number, (x, z) in enumerate(more):
        name = f"more{number}"
        bodies.append(Body(name, Pose(rotation_matrix(np.array([0.3, 0.0, 0.0])), np.array([x, 0.0, z]))))
        elements[name] = Element(name, name, plane(), Interaction.REFLECT, Circle(0.001))
    placed = Assembly(RigidTree(tuple(bodies)), elements, {}).place()
    finishes = Finishes(mirror=Finish(reflectance=1.0))
    surface, grid = screen("screen", facing(0.2), 0.02)
    return Scenery((*(mirror_surface(one, placed, finishes) for one in elements.values()), surface), (grid,))


def test_only_what_reaches_into_the_hull_is_in_the_way() -> None:
    """Half-way the hull of the squares around both apertures reaches to 15 mm, and the small mirror by 1 mm more."""
    for x, z, clear in ((0.0, 0.1, 0), (0.0158, 0.1, 0), (0.0165, 0.1, 1), (0.0, -0.01, 1), (0.0, 0.21, 1)):
        found = ClearWays(two_mirrors((x, z)), {"screen": (code(0, Event.REFLECT),)})
        assert len(found.ways) == clear, (x, z)


def test_apertures_that_do_not_face_each_other_have_no_way() -> None:
    """The source's light starts behind the mirror."""
    found = ClearWays(two_mirrors(), {"screen": (code(0, Event.REFLECT),)})
    source = DiskSource.along(np.array([0.0, 0.0, 0.1]), np.array([0.0, 0.0, -1.0]), 0.001)
    assert found.from_source(source.patch) is not None
    away = DiskSource.along(np.array([0.0, 0.0, 0.1]), np.array([0.0, 0.0, 1.0]), 0.001)
    assert found.from_source(away.patch) is None
