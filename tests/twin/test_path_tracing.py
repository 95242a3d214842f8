"""The path tracer on the reference instruments: exactness against the sequential trace, spots, balance, stray light.

Statistical tests use fixed seeds; each states its false-alarm rate.
"""

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
from scenes.models.scenery import Detector, Scenery, build_scenery, detector_surface, mirror_surface
from tests.tiers import quick
from tests.twin.path_bench import IDEAL, facing, flat_mirror, glass_scene, screen, slab
from twin.monitor.monitor_path import MonitorPath
from twin.path_tracing.families import nominal_codes
from twin.path_tracing.path_result import NOMINAL
from twin.path_tracing.source import DiskSource, RaySource
from twin.path_tracing.stray_light import monitor_families, trace_stray
from twin.path_tracing.tracer import BALANCED, VARIANTS, PathTracer, Sampling, VariantUnavailable, load_mitsuba

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
        (lambda: Sampling(floor=1.0), "impossible"),
        (lambda: replace(source, narrow=(0.08, 0.0, 0.05)), "does not lie in"),
        (lambda: replace(source, radius=-1.0), "radius of 0 or more and a cone"),
        (lambda: PathTracer(backend, alone).run(source, 0), "how many paths to trace, at least 1; found 0"),
        (lambda: PathTracer(backend, alone).run(rays, 3), "a list of rays is traced as a whole"),
        (lambda: PathTracer(backend, Scenery((*glass[:3], surface, *glass[3:]), (grid,))), "do not follow each other"),
        (lambda: PathTracer(backend, Scenery((wavy, surface), (grid,))), "takes 3 aspheric terms, found 4"),
        (lambda: Scenery((surface, surface), (grid,)), "surfaces of the same name: "),
        (lambda: Scenery((surface,), ()), "unknown detectors: far"),
        (lambda: PathTracer(backend, alone, {"near": ()}), "unknown detectors: near; detectors of the scene: far"),
        (lambda: PathTracer(backend, Scenery(*zip(*many, strict=True))), "256 detectors: at most 255 of each"),
    ):
        with pytest.raises(ValueError, match=words):
            make()
    with pytest.raises(LookupError, match="no path reached far by its nominal way"):
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
