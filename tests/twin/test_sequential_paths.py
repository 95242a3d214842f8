"""Paths along nominal light, surface by surface, and how many are followed that turn away from it: the paths are those
of the loop with its search, one by one, and sums stay the same on average.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from optics.geometry.aperture import Circle
from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.surface import plane
from optics.geometry.tree import Body, Motion, RigidTree
from optics.materials.scatter import CoatingTable, Finish
from optics.raytrace.assembly import Assembly, Element, Interaction
from scenes.models.scenery import Finishes, Scenery, build_scenery, mirror_surface
from tests.tiers import quick
from tests.twin.path_bench import IDEAL, facing, scene_beam, screen, ways_and_search
from twin.path_tracing.clear_ways import ClearWays
from twin.path_tracing.families import Event, code, nominal_codes
from twin.path_tracing.importance_sampling import LEAST_KEPT, Followed, Thinning, learn
from twin.path_tracing.path_result import PathResult
from twin.path_tracing.source import DiskSource
from twin.path_tracing.stray_light import monitor_families, pinhole
from twin.path_tracing.tracer import BALANCED, FAINT, LEAST_ALONG, PathTracer, Sampling

PATHS, FEW = LEAST_ALONG, 20_000
ALL = replace(FAINT, first=0.0)
"""Every path that turns away is followed."""
STATE = {
    "base/forward/M2": Motion(shift=(1e-5, 2e-5, 3e-5), rotate=(1e-5, 0.0, 2e-5), pivot="centre", figure={5: 2e-7}),
    "base/forward/monitor/left/prism_0": Motion(rotate=(1e-4, 2e-4, 0.0)),
}


@pytest.mark.parametrize(
    ("paths", "sampling"), quick(1, [(FEW, BALANCED), (PATHS, ALL), (PATHS, BALANCED), (FEW, FAINT)])
)
@pytest.mark.parametrize(
    ("name", "state"),
    [("gf7_pair", {}), pytest.param("monitor_pair", STATE, marks=pytest.mark.second)],
    ids=["gf7_pair", "monitor_pair_perturbed"],
)
def test_paths_along_nominal_light_are_those_of_a_search(backend, instrument, name, state, paths, sampling) -> None:
    """Surface by surface, and of few paths, which are not, on clear ways between surfaces."""
    chosen = instrument(name)
    for channel in (0, 1):
        found = ways_and_search(backend, chosen, build_scenery(chosen, state), paths, sampling, state, channel)
        assert [len(one) for one in found.steps] == [26 if paths == PATHS else 0, 0]
        assert found.runs[0].nominal(found.toward).count > 0.03 * paths
        same(*found.runs)
        assert [f.touches for f in found.runs[0].families] == [f.touches for f in found.runs[1].families]


@pytest.mark.parametrize(
    "sampling", quick(1, [replace(ALL, roulette=0.2), Sampling(floor=0.999, second=0.5)]), ids=["weak", "unlikely"]
)
def test_what_is_not_as_usual_on_nominal_light_is_left_to_the_loop(backend, gf7_pair, sampling: Sampling) -> None:
    """Roulette among paths on their nominal way; nominal light that a floor makes likelier than it is."""
    found = ways_and_search(backend, gf7_pair, build_scenery(gf7_pair, {}), PATHS, sampling)
    nominal = found.runs[0].nominal(found.toward)
    assert nominal.count > 50
    if sampling.roulette:
        # without roulette these paths have a third of this weight
        assert nominal.energy / nominal.count > 0.7 * sampling.roulette / PATHS
    same(*found.runs)


@pytest.mark.second
def test_paths_whose_first_surface_is_searched_are_those_of_a_search(backend, gf7_pair) -> None:
    """Prisms stand in the beam of a far point; all of the light ends on the focal plane, which absorbs it."""
    scenery = build_scenery(gf7_pair, {}, IDEAL, whole_focal_planes=True)
    detector = "forward/focal_plane"
    families = {detector: nominal_codes(scenery, gf7_pair.assembly, "forward/imaging")}
    source = DiskSource(*scene_beam(gf7_pair, backend), 0.28)
    tracers = [PathTracer(backend, scenery, families, ways=ways) for ways in (True, False)]
    steps = tracers[0].nominal_steps(source, detector, PATHS)
    assert [step.way > 0 for step in steps] == [False, True, True, False]
    runs = [tracer.run(source, PATHS, 2, keep=True) for tracer in tracers]
    assert 0.8 * PATHS < runs[0].nominal(detector).count < PATHS
    same(*runs)


@pytest.mark.second
@pytest.mark.parametrize(
    ("metal", "steps"),
    [
        (Finish(reflectance=0.6, transmission=0.3), 26),  # what is not reflected totally there is left to the loop
        (Finish(reflectance=0.5, diffuse=0.4), 26),
        (Finish(transmission=0.9), 12),  # the central prism is met from outside
        (Finish(diffuse=0.9), 4),  # no light is reflected
        (Finish(reflectance=0.9, coating=CoatingTable(np.array([0.0, 1.0]), np.array([0.9, 0.8]))), 4),
    ],
    ids=["splitter", "matt", "glass", "white", "measured"],
)
def test_paths_at_other_finishes_of_glass_are_those_of_a_search(backend, gf7_pair, metal: Finish, steps: int) -> None:
    """The fifth surface of nominal light is the mirror of a prism."""
    scenery = build_scenery(gf7_pair, {}, replace(IDEAL, metallised=metal))
    found = ways_and_search(backend, gf7_pair, scenery, PATHS)
    assert len(found.steps[0]) == steps
    same(*found.runs)


@pytest.mark.second
def test_steps_say_what_nominal_light_does(backend, gf7_pair) -> None:
    scenery = build_scenery(gf7_pair, {})
    families, channel = monitor_families(scenery, gf7_pair), gf7_pair.channels[0]
    toward, source = f"{channel.key}/area_ccd", pinhole(gf7_pair, backend, {}, channel)
    tracer = PathTracer(backend, scenery, families)
    steps = tracer.nominal_steps(source, toward, PATHS)
    assert [step.code for step in steps[:-1]] == list(families[toward])
    assert [step.detects for step in steps] == [False] * 25 + [True]
    # glass is entered from its front and left from its back
    through = [step for step in steps if step.event == Event.TRANSMIT]
    assert [step.front for step in through] == [step.body == 0 for step in through]
    assert sum(step.body > 0 for step in steps) == 2 * (4 + 3)
    assert tracer.nominal_steps(source, toward, PATHS - 1) == ()


@pytest.fixture(scope="module")
def stray(backend, gf7_pair) -> Callable[..., PathResult]:
    """Runs with a sampling of the light of the first channel."""
    scenery, channel = build_scenery(gf7_pair, {}), gf7_pair.channels[0]
    families, source = monitor_families(scenery, gf7_pair), pinhole(gf7_pair, backend, {}, channel)
    tracers = {sampling: PathTracer(backend, scenery, families, sampling) for sampling in (ALL, FAINT)}

    def run(sampling: Sampling, paths: int, seed: int, **options: Any) -> PathResult:
        return tracers[sampling].run(source, paths, seed, toward=f"{channel.key}/area_ccd", **options)

    return run


def weights(run: PathResult) -> dict[tuple[int, int, int], float]:
    """By path, detector and family."""
    d = run.detections
    keys = zip(d.path.tolist(), d.detector.tolist(), d.signature.tolist(), strict=True)
    return dict(zip(keys, d.weight.tolist(), strict=True))


@pytest.mark.second
def test_thinning_keeps_the_light_and_takes_away_paths(gf7_pair, stray) -> None:
    """Families of the same seeds: what both runs follow is the same, and the rest agrees within its standard error."""
    paths, toward = 4 * PATHS, f"{gf7_pair.channels[0].key}/area_ccd"
    all_of_them, thinned = (stray(sampling, paths, 1, keep=True) for sampling in (ALL, FAINT))
    found = [weights(run) for run in (all_of_them, thinned)]
    both = found[0].keys() & found[1].keys()
    gain = np.array([found[1][key] / found[0][key] for key in both])
    assert len(both) > 0.99 * len(found[0])
    assert len(found[1]) - len(both) < 1e-3 * len(both)  # heavier paths live longer
    assert np.all(gain > 1.0 - 1e-9)
    assert np.all(gain < 1.0 / LEAST_KEPT + 1e-9)
    assert 20 < np.sum(gain > 1.0 + 1e-9) < 0.01 * len(both)
    # a direction from a mirror's lobe is now and then the specular one: a 1e-4 of the light at six mirrors, thinned
    assert thinned.nominal(toward).energy == pytest.approx(all_of_them.nominal(toward).energy, rel=1e-5)
    first = [run.detections.path < paths * FAINT.first for run in (all_of_them, thinned)]
    np.testing.assert_array_equal(all_of_them.detections.path[first[0]], thinned.detections.path[first[1]])

    def light(run: PathResult, kind: str) -> tuple[float, float]:
        some = [f for f in run.families if f.kind == kind]
        return sum(f.energy for f in some), float(np.sqrt(sum(f.error**2 for f in some)))

    for kind in ("ghost", "stray"):
        (one, sigma), (other, further) = light(all_of_them, kind), light(thinned, kind)
        assert 0.0 < sigma < one
        assert abs(one - other) < 4.0 * np.hypot(sigma, further)
    assert thinned.balance.error == pytest.approx(0.0, abs=0.01)


@pytest.mark.second
def test_thinned_paths_do_not_depend_on_the_chunk_and_are_found_again(stray) -> None:
    runs = [stray(FAINT, 2 * PATHS, 3, chunk=chunk) for chunk in (1 << 20, 5000)]
    named = [{(f.detector, f.kind, f.touches): (f.count, f.energy) for f in run.families} for run in runs]
    assert named[0].keys() == named[1].keys()
    assert all(touches for _, _, touches in named[0])
    for key, (count, energy) in named[0].items():
        assert named[1][key] == (count, pytest.approx(energy, rel=1e-9))


def test_classes_are_followed_as_often_as_they_are_worth_it() -> None:
    """Two classes of as many paths: chances go as the square root of squared weights per surface."""
    count = 1000
    passed, turned = np.repeat([3, 7], count), np.ones(2 * count, bool)
    steps = np.repeat([10.0, 40.0], count)
    found = np.arange(count)
    weights = np.where(found % 2 == 0, 2.0, 1.0)  # of every fifth path of a class each
    paths = np.concatenate([np.arange(0, count, 5), count + np.arange(0, count, 5)])
    done = Followed(passed, turned, steps)
    known = learn([(done, paths, np.concatenate([weights[:200], weights[:200]]))], 5)
    assert (known.first, known.seed) == (2 * count, 5)
    np.testing.assert_allclose(known.kept[[3, 7]], [1.0, np.sqrt(10.0 / 40.0)], rtol=1e-12)
    np.testing.assert_array_equal(np.delete(known.kept, [3, 7]), 1.0)  # nothing is known of these
    one = learn([(done, paths[:200], weights[:200])], 5)
    assert one.kept[3] == 1.0
    assert LEAST_KEPT <= one.kept[7] < 0.5
    nothing = learn([(done, np.empty(0), np.empty(0))], 5)
    np.testing.assert_array_equal(nothing.kept, 1.0)


def test_draws_of_thinning_have_their_chances_and_know_the_seed() -> None:
    numbers = np.arange(100_000)
    rule, other = (Thinning(np.array([1.0, 0.25]), 10, seed) for seed in (1, 2))
    passed = numbers % 3
    chances = rule.chances(numbers, passed)
    assert np.all(chances[:10] == 1.0)
    np.testing.assert_array_equal(chances[10:], np.array([1.0, 0.25, 1.0])[passed[10:]])
    drawn = [one.follows(numbers, np.full(len(numbers), 0.25)) for one in (rule, other)]
    for some in drawn:
        assert abs(some.mean() - 0.25) < 4.0 * np.sqrt(0.25 * 0.75 / len(numbers))
    both = (drawn[0] & drawn[1]).mean()
    assert abs(both - 0.0625) < 4.0 * np.sqrt(0.0625 / len(numbers))
    np.testing.assert_array_equal(rule.follows(numbers[::-1], np.full(len(numbers), 0.25)), drawn[0][::-1])


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


@pytest.mark.second
def test_light_out_and_back_has_clear_ways_everywhere(gf7_pair) -> None:
    """From the pinhole to the area CCD there are 25 surfaces: 25 ways between them and the detector, and the first."""
    scenery = build_scenery(gf7_pair, {}, IDEAL)
    families = monitor_families(scenery, gf7_pair)
    found = ClearWays(scenery, families)
    assert len(found.ways) == 25 * len(families)
    ends = [way.after for way in found.ways]
    assert ends.count(-1) == len(families)  # each is one chain
    assert all(after in (-1, number + 1) for number, after in enumerate(ends))
    for way in found.ways:
        surface = scenery.surfaces[way.end.surface]
        if not surface.surface.is_plane:  # the box about the curved surface of a camera's mirror holds all of it
            sides = ConvexHull(way.end.corners).equations
            assert np.max(surface.pose.apply(surface.vertices) @ sides[:, :3].T + sides[:, 3]) < 0.0


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
