"""The path tracer on the reference instruments: exactness against the sequential trace, spots, balance, stray light.

Statistical tests use fixed seeds; each states its false-alarm rate. Paths along nominal light are those of the loop
with its search, one by one; how many are followed that turn away from it leaves sums the same on average.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from optics.geometry.aperture import Aperture, Circle, Ellipse, Rectangle
from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.sag_terms import XYPolynomial, ZernikeSag
from optics.geometry.surface import Figure, GridFigure, Surface, ZernikeFigure, plane
from optics.geometry.tree import AT_REST, Body, Motion, RigidTree, State
from optics.materials.fresnel_scatter import CoatingTable, Finish
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.models.scenery import Detector, Finishes, Scenery, build_scenery, detector_surface, mirror_surface
from tests.tiers import quick
from tests.twin.path_bench import IDEAL, facing, flat_mirror, glass_scene, scene_beam, screen, slab, ways_and_search
from twin.monitor.monitor_path import MonitorPath
from twin.path_tracing.clear_ways import ClearSegments
from twin.path_tracing.kernel import LEAST_SURVIVAL, LearnedRoulette, PathHistory, learn_survival
from twin.path_tracing.path_families import Event, code, nominal_codes
from twin.path_tracing.path_result import NOMINAL, PathResult
from twin.path_tracing.stray_light import monitor_families, pinhole, trace_stray
from twin.path_tracing.tracer import (
    BALANCED,
    FAINT,
    LEAST_NOMINAL,
    VARIANTS,
    DiskSource,
    PathTracer,
    RaySource,
    Sampling,
    VariantUnavailable,
    load_mitsuba,
)

INSTRUMENTS = ["gf7_pair", "monitor_pair"]
STATE = {
    "base/forward": Motion(scale=3e-5, rotate=(1e-5, 2e-5, -1e-5)),
    "base/forward/M2": Motion(shift=(1e-6, 2e-6, 3e-6), rotate=(1e-6, 0.0, 2e-6), pivot="centre", figure={8: 2e-7}),
    "base/forward/focal_plane": Motion(rotate=(1e-5, -7e-6, 5e-5), pivot="rear_node"),
    "base/forward/monitor/left/prism_0": Motion(rotate=(1e-4, 2e-4, 0.0)),
}
CCD = "forward/left/area_ccd"


def out_and_back(backend, chosen, state: dict) -> None:
    """Places on the CCDs and path lengths of every channel's light are those of the sequential trace."""
    scenery = build_scenery(chosen, state, IDEAL)
    tracer = PathTracer(backend, scenery, monitor_families(scenery, chosen))
    aimed = MonitorPath(chosen, backend).nominal
    for number, channel in enumerate(chosen.channels):
        shift = chosen.assembly.place([state]).pose(channel.reticle_body).translation
        position = np.broadcast_to(shift, aimed.direction[number].shape)
        direction = aimed.direction[number]
        systems = assemble(chosen.assembly, [f"{channel.key}/monitor"], [state])
        traced = trace(backend, systems, make_rays(backend, position, direction))
        place, _, length, valid = (a[0] for a in traced.numpy())
        found = tracer.run(RaySource.even(position, direction), keep=True).detections
        own = (found.kind == NOMINAL) & (
            found.detector == [d.name for d in scenery.detectors].index(f"{channel.key}/area_ccd")
        )
        path = found.path[own]
        np.testing.assert_array_equal(np.sort(path), np.nonzero(valid)[0])
        np.testing.assert_allclose(found.place[own], place[path, :2], rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.length[own], length[path], rtol=0, atol=1e-12)
        assert len(path) > 50


@pytest.mark.second
@pytest.mark.parametrize("name", INSTRUMENTS)
@pytest.mark.parametrize("state", [{}, STATE], ids=["nominal", "perturbed"])
def test_out_and_back_through_all_prisms_as_the_sequential_trace_has_it(
    backend, instrument, name: str, state: dict
) -> None:
    out_and_back(backend, instrument(name), state)


@pytest.mark.second
@pytest.mark.parametrize("name", INSTRUMENTS)
def test_nominal_spot_stands_where_the_wave_path_has_it(backend, instrument, name: str) -> None:
    """Within three standard errors in x and y (false alarm 0.5 %)."""
    chosen, paths = instrument(name), 200_000
    stray = trace_stray(chosen, backend, {}, paths, 3, channels=chosen.channels[:1], finishes=IDEAL, sampling=BALANCED)
    nominal = stray.runs["forward/left"].nominal(CCD)
    path = MonitorPath(chosen, backend)
    expected = path.nodes.share @ path.rays([{}]).position[0, :, :2]
    error = np.array(nominal.rms) / np.sqrt(nominal.count)
    assert nominal.count > 0.3 * paths
    assert np.all(np.abs(nominal.centroid - expected) < 3.0 * error)
    # the pinhole's image, a disk of 10 um radius
    np.testing.assert_allclose(nominal.rms, 5e-6, rtol=0.02)


def test_another_variant_is_not_taken_silently(backend, monkeypatch) -> None:
    mi = load_mitsuba(backend)
    monkeypatch.setitem(VARIANTS, "llvm", "llvm_ad_double")
    with pytest.raises(VariantUnavailable, match="cannot run its variant llvm_ad_double"):
        load_mitsuba(backend)
    assert mi.variant() == "llvm_ad_mono"
    monkeypatch.setitem(VARIANTS, "llvm", "scalar_rgb")
    monkeypatch.setattr(mi, "set_variant", lambda *_: None)
    with pytest.raises(VariantUnavailable, match="runs its variant llvm_ad_mono where scalar_rgb is needed"):
        load_mitsuba(backend)


def test_impossible_sampling_sources_and_scenes_are_refused(backend) -> None:
    source = DiskSource.along(np.zeros(3), np.array([0.0, 0.0, 1.0]), 1e-3, 0.1)
    surface, grid = screen("far", facing(0.5), 1.0)
    alone = Scenery((surface,), (grid,))
    empty = PathTracer(backend, alone).run(replace(source, centre=np.array([0.0, 0.0, 1.0])), 10)
    glass, (mirror,) = glass_scene(slab(0.3, 0.02), 1.5).surfaces[:6], flat_mirror(IDEAL.mirror)
    wavy = replace(mirror, surface=Surface(0.1, 0.0, (1e-9,) * 4))
    rays = RaySource.even(np.zeros((2, 3)), np.tile([0.0, 0.0, 1.0], (2, 1)))
    many = tuple(screen(f"s{k}", facing(0.5 + k), 1.0) for k in range(256))
    for make, words in (
        (lambda: Sampling(floor=1.0), "invalid sampling"),
        (lambda: replace(source, narrow=(0.08, 0.0, 0.05)), "does not lie in"),
        (lambda: replace(source, radius=-1.0), "radius of 0 or more and a cone"),
        (lambda: PathTracer(backend, alone).run(source, 0), "the number of paths must be at least 1; found 0"),
        (lambda: PathTracer(backend, alone).run(rays, 3), "a list of rays is traced as a whole"),
        (lambda: PathTracer(backend, Scenery((*glass[:3], surface, *glass[3:]), (grid,))), "do not follow each other"),
        (lambda: PathTracer(backend, Scenery((wavy, surface), (grid,))), "takes 3 aspheric terms, found 4"),
        (lambda: Scenery((surface, surface), (grid,)), "several surfaces have the same name: "),
        (lambda: Scenery((surface,), ()), "unknown detectors: far"),
        (lambda: PathTracer(backend, alone, {"near": ()}), "unknown detectors: near; detectors of the scene: far"),
        (lambda: PathTracer(backend, Scenery(*zip(*many, strict=True))), "256 detectors: at most 255 of each"),
    ):
        with pytest.raises(ValueError, match=words):
            make()
    with pytest.raises(LookupError, match="no path reached far along its nominal surfaces"):
        empty.nominal("far")


@pytest.mark.second
@pytest.mark.parametrize("degrees", [30.0, 60.0, 80.0])
def test_oblique_hits_are_exact_as_well(backend, gf7_pair, degrees: float) -> None:
    """Stray light meets a mirror at any angle: place on M1 against the sequential trace."""
    scenery = build_scenery(gf7_pair, {}, IDEAL)
    mirror = next(s for s in scenery.surfaces if s.name == "forward/M1")
    grid = Detector("m1", 10, 10, (0.1, 0.1))
    alone = Scenery((replace(mirror, front=IDEAL.detector, back=IDEAL.mirror, detector="m1"),), (grid,))
    (aperture,) = mirror.apertures
    n, rng = 20_000, np.random.default_rng(6)
    x0, x1, y0, y1 = aperture.bounds
    x, y = rng.uniform(x0, x1, n), rng.uniform(y0, y1, n)
    turn, tilt = rng.uniform(0.0, 2.0 * np.pi, n), np.radians(degrees)
    local = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.full(n, -np.cos(tilt))], axis=-1)
    target = np.stack([x, y, mirror.surface.sag(x, y)], axis=-1)
    position, direction = mirror.pose.apply(target - 0.5 * local), local @ mirror.pose.rotation.T
    found = PathTracer(backend, alone).run(RaySource.even(position, direction), keep=True).detections
    # at grazing incidence some rays meet the bowl's edge from behind or twice
    assert len(found.path) > 0.8 * n
    systems = assemble(gf7_pair.assembly, [("forward/M1",)])
    place, _, length, valid = (a[0] for a in trace(backend, systems, make_rays(backend, position, direction)).numpy())
    same = valid[found.path]
    np.testing.assert_allclose(found.place[same], place[found.path[same], :2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.length[same], length[found.path[same]], rtol=0, atol=1e-12)
    assert same.mean() > 0.95


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
    "grid of a state": (BOWL, None, {"mirror": Motion(grid=WAVY, expansion=2e-5)}),
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
    mirror = mirror_surface(assembly.elements["mirror"], placed, IDEAL, optical_side=-1.0, motion=motion)
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


# --- paths along nominal light, surface by surface --------------------------------------------------------------------


PATHS, FEW = LEAST_NOMINAL, 20_000
ALL = replace(FAINT, first=0.0)
"""Every path that turns away is followed."""
MOVED = {
    "base/forward/M2": Motion(shift=(1e-5, 2e-5, 3e-5), rotate=(1e-5, 0.0, 2e-5), pivot="centre", figure={5: 2e-7}),
    "base/forward/monitor/left/prism_0": Motion(rotate=(1e-4, 2e-4, 0.0)),
}


@pytest.mark.parametrize(
    ("paths", "sampling"), quick(1, [(FEW, BALANCED), (PATHS, ALL), (PATHS, BALANCED), (FEW, FAINT)])
)
@pytest.mark.parametrize(
    ("name", "state"),
    [("gf7_pair", {}), pytest.param("monitor_pair", MOVED, marks=pytest.mark.second)],
    ids=["gf7_pair", "monitor_pair_perturbed"],
)
def test_paths_along_nominal_light_are_those_of_a_search(backend, instrument, name, state, paths, sampling) -> None:
    """Surface by surface, and of few paths, which are not, on clear segments between surfaces."""
    chosen = instrument(name)
    for channel in (0, 1):
        found = ways_and_search(backend, chosen, build_scenery(chosen, state), paths, sampling, state, channel)
        assert [len(one) for one in found.steps] == [26 if paths == PATHS else 0, 0]
        assert found.runs[0].nominal(found.toward).count > 0.03 * paths
        same(*found.runs)
        assert [f.surface_events for f in found.runs[0].families] == [f.surface_events for f in found.runs[1].families]


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
    tracers = [PathTracer(backend, scenery, families, segments=segments) for segments in (True, False)]
    steps = tracers[0].nominal_steps(source, detector, PATHS)
    assert [step.segment > 0 for step in steps] == [False, True, True, False]
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
def test_learned_roulette_keeps_the_light_and_removes_paths(gf7_pair, stray) -> None:
    """Families of the same seeds: what both runs follow is the same, and the rest agrees within its standard error."""
    paths, toward = 4 * PATHS, f"{gf7_pair.channels[0].key}/area_ccd"
    all_of_them, thinned = (stray(sampling, paths, 1, keep=True) for sampling in (ALL, FAINT))
    found = [weights(run) for run in (all_of_them, thinned)]
    both = found[0].keys() & found[1].keys()
    gain = np.array([found[1][key] / found[0][key] for key in both])
    assert len(both) > 0.99 * len(found[0])
    assert len(found[1]) - len(both) < 1e-3 * len(both)  # heavier paths live longer
    assert np.all(gain > 1.0 - 1e-9)
    assert np.all(gain < 1.0 / LEAST_SURVIVAL + 1e-9)
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
    named = [{(f.detector, f.kind, f.surface_events): (f.count, f.energy) for f in run.families} for run in runs]
    assert named[0].keys() == named[1].keys()
    assert all(surface_events for _, _, surface_events in named[0])
    for key, (count, energy) in named[0].items():
        assert named[1][key] == (count, pytest.approx(energy, rel=1e-9))


def test_classes_are_followed_as_often_as_they_are_worth_it() -> None:
    """Two classes of as many paths: probabilities go as the square root of squared weights per surface."""
    count = 1000
    passed, turned = np.repeat([3, 7], count), np.ones(2 * count, bool)
    steps = np.repeat([10.0, 40.0], count)
    found = np.arange(count)
    weights = np.where(found % 2 == 0, 2.0, 1.0)  # of every fifth path of a class each
    paths = np.concatenate([np.arange(0, count, 5), count + np.arange(0, count, 5)])
    done = PathHistory(passed, turned, steps)
    known = learn_survival([(done, paths, np.concatenate([weights[:200], weights[:200]]))], 5)
    assert (known.first, known.seed) == (2 * count, 5)
    np.testing.assert_allclose(known.survival[[3, 7]], [1.0, np.sqrt(10.0 / 40.0)], rtol=1e-12)
    np.testing.assert_array_equal(np.delete(known.survival, [3, 7]), 1.0)  # nothing is known of these
    one = learn_survival([(done, paths[:200], weights[:200])], 5)
    assert one.survival[3] == 1.0
    assert LEAST_SURVIVAL <= one.survival[7] < 0.5
    nothing = learn_survival([(done, np.empty(0), np.empty(0))], 5)
    np.testing.assert_array_equal(nothing.survival, 1.0)


def test_survival_draws_have_their_probabilities_and_know_the_seed() -> None:
    numbers = np.arange(100_000)
    rule, other = (LearnedRoulette(np.array([1.0, 0.25]), 10, seed) for seed in (1, 2))
    passed = numbers % 3
    probabilities = rule.survival_probability(numbers, passed)
    assert np.all(probabilities[:10] == 1.0)
    np.testing.assert_array_equal(probabilities[10:], np.array([1.0, 0.25, 1.0])[passed[10:]])
    drawn = [one.survives(numbers, np.full(len(numbers), 0.25)) for one in (rule, other)]
    for some in drawn:
        assert abs(some.mean() - 0.25) < 4.0 * np.sqrt(0.25 * 0.75 / len(numbers))
    both = (drawn[0] & drawn[1]).mean()
    assert abs(both - 0.0625) < 4.0 * np.sqrt(0.0625 / len(numbers))
    np.testing.assert_array_equal(rule.survives(numbers[::-1], np.full(len(numbers), 0.25)), drawn[0][::-1])


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
def test_light_out_and_back_has_clear_segments_everywhere(gf7_pair) -> None:
    """From the pinhole to the area CCD there are 25 surfaces: 25 segments to them and the detector, and the first."""
    scenery = build_scenery(gf7_pair, {}, IDEAL)
    families = monitor_families(scenery, gf7_pair)
    found = ClearSegments(scenery, families)
    assert len(found.segments) == 25 * len(families)
    ends = [segment.after for segment in found.segments]
    assert ends.count(-1) == len(families)  # each is one chain
    assert all(after in (-1, number + 1) for number, after in enumerate(ends))
    for segment in found.segments:
        surface = scenery.surfaces[segment.end.surface]
        if not surface.surface.is_plane:  # the box about the curved surface of a camera's mirror holds all of it
            sides = ConvexHull(segment.end.corners).equations
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
        found = ClearSegments(two_mirrors((x, z)), {"screen": (code(0, Event.REFLECT),)})
        assert len(found.segments) == clear, (x, z)


def test_apertures_that_do_not_face_each_other_have_no_way() -> None:
    """The source's light starts behind the mirror."""
    found = ClearSegments(two_mirrors(), {"screen": (code(0, Event.REFLECT),)})
    source = DiskSource.along(np.array([0.0, 0.0, 0.1]), np.array([0.0, 0.0, -1.0]), 0.001)
    assert found.from_source(source.patch) is not None
    away = DiskSource.along(np.array([0.0, 0.0, 0.1]), np.array([0.0, 0.0, 1.0]), 0.001)
    assert found.from_source(away.patch) is None
