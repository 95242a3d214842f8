"""The path tracer on the reference instruments: exactness against the sequential trace, spots, balance, stray light.

Statistical tests use fixed seeds; each states its false-alarm rate.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from optics.geometry.pose import Pose
from optics.geometry.tree import Motion
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.models.scenery import FACING_THE_LIGHT, Scenery, build_scenery
from scenes.models.scenery_parts import Detector, detector_surface
from tests.optics.bench import disk_points
from tests.twin.path_bench import IDEAL, scene_beam
from twin.monitor.monitor_path import MonitorPath
from twin.path_tracing.families import nominal_codes
from twin.path_tracing.sinks import NOMINAL
from twin.path_tracing.source import DiskSource, RaySource
from twin.path_tracing.stray_light import monitor_families, trace_stray
from twin.path_tracing.tracer import (
    BALANCED,
    VARIANTS,
    PathTracer,
    Sampling,
    VariantUnavailable,
    load_mitsuba,
)

INSTRUMENTS = ["gf7_pair", "monitor_pair"]
STATE = {
    "base/forward": Motion(scale=3e-5, rotate=(1e-5, 2e-5, -1e-5)),
    "base/forward/M2": Motion(shift=(1e-6, 2e-6, 3e-6), rotate=(1e-6, 0.0, 2e-6), pivot="centre"),
    "base/forward/focal_plane": Motion(rotate=(1e-5, -7e-6, 5e-5), pivot="rear_node"),
    "base/forward/monitor/left/prism_0": Motion(rotate=(1e-4, 2e-4, 0.0)),
}
CCD = "forward/left/area_ccd"


def without_prisms(scenery: Scenery) -> Scenery:
    return Scenery(tuple(s for s in scenery.surfaces if s.solid is None), scenery.detectors)


@pytest.mark.second
@pytest.mark.parametrize("name", INSTRUMENTS)
@pytest.mark.parametrize("state", [{}, STATE], ids=["nominal", "perturbed"])
def test_three_mirrors_as_the_sequential_trace_has_them(backend, instrument, name: str, state: dict) -> None:
    chosen = instrument(name)
    scenery = without_prisms(build_scenery(chosen, state, IDEAL, whole_focal_planes=True))
    detector = "forward/focal_plane"
    tracer = PathTracer(backend, scenery, {detector: nominal_codes(scenery, chosen.assembly, "forward/imaging")})
    half = chosen.cameras["forward"].spec.field.x
    position, direction = [], []
    for x, y in ((0.0, 0.0), (0.95 * half, 0.0015), (-0.95 * half, -0.0015)):
        middle, heading, across = scene_beam(chosen, backend, x, y)
        position.append(middle + disk_points(5000, 0.36) @ across)  # wider than the pupil
        direction.append(np.broadcast_to(heading, position[-1].shape))
    position, direction = np.concatenate(position), np.concatenate(direction)
    systems = assemble(chosen.assembly, ["forward/imaging"], [state])
    place, _, length, valid = (a[0] for a in trace(backend, systems, make_rays(backend, position, direction)).numpy())
    found = tracer.run(RaySource.even(position, direction), keep=True).detections
    own = found.kind == NOMINAL
    # every ray that gets through the apertures there gets through here, and no other
    np.testing.assert_array_equal(np.sort(found.path[own]), np.nonzero(valid)[0])
    assert 0.5 < valid.mean() < 0.9
    path = found.path[own]
    flipped = found.place[own] * [-1.0, 1.0]  # the detector faces the light
    np.testing.assert_allclose(flipped, place[path, :2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.length[own], length[path], rtol=0, atol=1e-12)


@pytest.mark.second
@pytest.mark.parametrize("name", INSTRUMENTS)
@pytest.mark.parametrize("state", [{}, STATE], ids=["nominal", "perturbed"])
def test_out_and_back_through_all_prisms_as_the_sequential_trace_has_it(
    backend, instrument, name: str, state: dict
) -> None:
    chosen = instrument(name)
    scenery = build_scenery(chosen, state, IDEAL)
    tracer = PathTracer(backend, scenery, monitor_families(scenery, chosen))
    aimed = MonitorPath(chosen, backend).nominal
    checked = 0
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
        checked += len(path)
    assert checked > 2000


def spot_counts(backend, chosen, paths: int, chunk: int = 1 << 20) -> tuple[np.ndarray, DiskSource, Pose, dict]:
    """Counts on a grid of 80 um over the blurred spot of a focal plane 5 mm out of focus."""
    state = {"base/forward/focal_plane": Motion(shift=(0.0, 0.0, 0.005))}
    middle, heading, across = scene_beam(chosen, backend)
    source = DiskSource(middle, heading, across, 0.36)
    systems = assemble(chosen.assembly, ["forward/imaging"], [state])
    chief = trace(backend, systems, make_rays(backend, middle, heading)).numpy()[0][0, 0]
    placed = chosen.assembly.place([state])
    pose = placed.pose("base/forward/focal_plane") @ Pose(np.eye(3), chief) @ FACING_THE_LIGHT
    grid = Detector("forward/focal_plane", 9, 9, (8e-5, 8e-5))
    scenery = without_prisms(build_scenery(chosen, state, IDEAL, whole_focal_planes=True))
    kept = tuple(s for s in scenery.surfaces if s.detector is None)
    scenery = Scenery((*kept, detector_surface(grid, pose, IDEAL, (grid.name,))), (grid,))
    tracer = PathTracer(backend, scenery, {grid.name: nominal_codes(scenery, chosen.assembly, "forward/imaging")})
    image = tracer.run(source, paths, seed=11, chunk=chunk).images[grid.name][NOMINAL]
    return image * paths, source, Pose(np.eye(3), chief), state


def expected_shares(backend, chosen, source: DiskSource, centre: Pose, state: dict, fine: int) -> np.ndarray:
    """Share of the disk's area whose rays the sequential trace brings to each cell."""
    systems = assemble(chosen.assembly, ["forward/imaging"], [state]).upload(backend)
    edges = (np.arange(10) - 4.5) * 8e-5
    shares = np.zeros((9, 9))
    angle = 2.0 * np.pi * (np.arange(fine) + 0.5) / fine
    rings = source.radius * np.sqrt((np.arange(fine) + 0.5) / fine)
    block = max(1, 2_000_000 // fine)
    for first in range(0, fine, block):
        r = rings[first : first + block, None]
        points = np.stack([r * np.cos(angle + r * 1e3), r * np.sin(angle + r * 1e3)], axis=-1).reshape(-1, 2)
        place, _, _, valid = (
            a[0]
            for a in trace(
                backend, systems, make_rays(backend, source.centre + points @ source.across, source.axis)
            ).numpy()
        )
        at = (place[valid, :2] - centre.translation[:2]) * [-1.0, 1.0]
        shares += np.histogram2d(at[:, 1], at[:, 0], [edges, edges])[0]
    return shares / fine**2


def spot_statistic(counts: np.ndarray, shares: np.ndarray, paths: int) -> tuple[float, int]:
    use = shares * paths > 50.0
    assert use.sum() > 25
    found = np.append(counts[use], paths - counts[use].sum())
    expected = paths * np.append(shares[use], 1.0 - shares[use].sum())
    return float(np.sum((found - expected) ** 2 / expected)), len(found) - 1


@pytest.mark.second
def test_spot_has_the_shape_of_the_sequential_trace(backend, gf7_pair) -> None:
    """Chi-square over the cells of a defocused spot with a sharp pupil edge; false alarm 1e-3 at most: neighbouring
    paths start alike and fill the beam more evenly than independent ones.
    """
    chosen, paths, fine = gf7_pair, 400_000, 1000
    counts, source, centre, state = spot_counts(backend, chosen, paths)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
    shares = expected_shares(backend, chosen, source, centre, state, fine)
    statistic, freedom = spot_statistic(counts, shares, paths)
    assert statistic < chi2.ppf(0.999, freedom)
    # and the test can fail: the spot of a pupil 0.5 % larger is told apart
    wrong = expected_shares(backend, chosen, replace(source, radius=1.005 * source.radius), centre, state, fine)
    assert spot_statistic(counts, wrong, paths)[0] > chi2.ppf(0.999, freedom)


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


def test_impossible_sampling_and_sources() -> None:
    with pytest.raises(ValueError, match="impossible"):
        Sampling(floor=1.0)
    source = DiskSource.along(np.zeros(3), np.array([0.0, 0.0, 1.0]), 1e-3, 0.1)
    with pytest.raises(ValueError, match="does not lie in"):
        replace(source, narrow=(0.08, 0.0, 0.05))


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


def test_a_line_ccd_gets_its_star(backend, gf7_pair) -> None:
    """Light of a point on the line's field falls on the pixel where the sequential trace has it."""
    scenery = without_prisms(build_scenery(gf7_pair, {}, IDEAL))
    tracer = PathTracer(
        backend, scenery, {"forward/line": nominal_codes(scenery, gf7_pair.assembly, "forward/imaging")}
    )
    middle, heading, across = scene_beam(gf7_pair, backend, 0.0005, 0.0)
    systems = assemble(gf7_pair.assembly, ["forward/imaging"])
    chief = trace(backend, systems, make_rays(backend, middle, heading)).numpy()[0][0, 0]
    line = gf7_pair.cameras["forward"].spec.line
    assert abs(chief[0]) < 0.4 * line.pitch  # the smile of the field is small here
    result = tracer.run(DiskSource(middle, heading, across, 0.25), 20_000)
    image = result.images["forward/line"][NOMINAL][:, 0]
    assert result.balance.detected["forward/line"] > 0.9
    row = chief[1] / line.pitch + 0.5 * (line.pixels - 1)
    assert np.sum(image * np.arange(line.pixels)) / image.sum() == pytest.approx(row, abs=0.5)
