"""Directions that the path tracer draws at surfaces: against the BSDF, by chi-square with a false-alarm rate of 1e-3
each, and in glass against closed forms and the sequential trace, with 1e-4 for Z_LIMIT standard errors.
"""

from __future__ import annotations

from itertools import pairwise

import drjit as dr
import numpy as np
import pytest
from scipy.integrate import dblquad
from scipy.stats import chi2

from optics.geometry.aperture import Circle, Rectangle
from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.solid import Coating, Face, Solid
from optics.geometry.surface import plane
from optics.geometry.tree import Body, RigidTree
from optics.materials.fresnel_scatter import (
    ABSORBER,
    BARE,
    ABg,
    CoatingTable,
    Finish,
    HarveyShack,
    ScatterTable,
    lobe_area,
    reflectance,
    total_scatter,
)
from optics.raytrace.assembly import Assembly, Element, Interaction
from scenes.models.scenery import Finishes, Scenery, solid_surfaces
from tests.optics.bench import unit
from tests.optics.test_scatter_table import lambert, of_lobe
from tests.tiers import quick
from tests.twin.path_bench import facing, flat_mirror, frame, glass_scene, screen, slab
from twin.path_tracing.kernel import OutgoingPaths, TableSampling, sample_bsdf
from twin.path_tracing.path_families import Event, decode
from twin.path_tracing.path_result import Family, PathResult
from twin.path_tracing.tables import upload_finishes
from twin.path_tracing.tracer import DiskSource, PathTracer, RaySource, Sampling, random_streams

FALSE_ALARM = 1e-3
N = 1_000_000
ANGLES = np.linspace(-np.pi, np.pi, 9)


def left(backend, direction, index: float, event: Event, lobe, floor: float, near: float | None, drawn=None):
    """Return directions (N, 3), events and weights of N paths that leave z = 0 in a direction.

    ``lobe`` is the scattered share and the numbers of the lobe, ``drawn`` a table in place of it.
    """
    vector = backend.Vector3(*(dr.full(backend.Float, float(c), N) for c in direction))
    leaving = OutgoingPaths(
        vector,
        backend.Vector3(0.0, 0.0, 1.0),
        backend.Float(index),
        dr.full(backend.UInt, int(event), N),
        dr.full(backend.Float, 1.0, N),
        dr.full(backend.Float, -float(abs(direction[2])), N),
        dr.full(backend.Bool, event is Event.DIFFUSE, N),
    )
    rng = random_streams(backend, dr.arange(backend.UInt, N), 1)
    share, shape = backend.Float(lobe[0]), [backend.Float(v) for v in lobe[1]]
    met, some = dr.full(backend.Bool, True, N), None if near is None else backend.Float(near)
    more = () if drawn is None else (drawn,)
    out, event, weight, _ = sample_bsdf(
        backend, rng, met, share, lambda active: shape, backend.Float(floor), some, leaving, *more
    )
    return np.stack([c.numpy() for c in out], axis=-1), event.numpy(), weight.numpy()


def scattered(backend, lobe, direction, index: float = 1.0, floor: float = 0.0, near: float | None = None):
    """Return what leaves after reflection by a surface with a lobe."""
    return left(backend, direction, index, Event.REFLECT, (lobe[0], (*lobe[1:], lobe_area(*lobe[1:3]))), floor, near)


def check(counts: np.ndarray, expected: np.ndarray) -> None:
    assert expected.min() > 20.0
    statistic = np.sum((counts - expected) ** 2 / expected)
    assert statistic < chi2.ppf(1.0 - FALSE_ALARM, counts.size - 1)


@pytest.mark.second
@pytest.mark.parametrize("index", [1.0, 1.5], ids=["air", "glass"])
@pytest.mark.parametrize(
    "scatter",
    [ABg(5e-3, 2e-3, 1.5), ABg(3e-4, 1e-5, 2.6), HarveyShack(5.0, 0.03, -2.2)],
    ids=["g1.5", "g2.6", "harvey"],
)
def test_scattered_directions_follow_the_bsdf(backend, scatter, index: float) -> None:
    specular = unit(0.4, -0.2, 0.8)
    direction, event, weight = scattered(backend, scatter.lobe.numbers, specular, index)
    assert np.all(weight == 1.0)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, atol=1e-12)
    assert np.all(direction[:, 2] > 0.0)
    stayed = event == Event.REFLECT
    np.testing.assert_array_equal(direction[stayed], np.broadcast_to(specular, direction[stayed].shape))
    away = index * (direction - specular)[~stayed, :2]
    reach = 0.5 * index
    edges = np.geomspace(0.6 * scatter.lobe.scale, reach, 11)
    r, phi = np.hypot(*away.T), np.arctan2(away[:, 1], away[:, 0])
    counts = np.histogram2d(r, phi, [edges, ANGLES])[0].ravel()
    fine = [np.geomspace(a, b, 201) for a, b in pairwise(edges)]
    ring = np.array([np.trapezoid(2.0 * np.pi * d * scatter.bsdf(d), d) for d in fine])
    expected = N * np.repeat(ring / 8.0, 8)
    counts, expected = np.append(counts, N - counts.sum()), np.append(expected, N - expected.sum())
    check(counts, expected)
    if index == 1.0:
        total = total_scatter(scatter, float(np.hypot(*specular[:2])))
        assert abs((~stayed).mean() - total) < 3.3 * np.sqrt(total / N)


@pytest.mark.second
@pytest.mark.parametrize("near", [None, 0.5])
def test_drawing_more_scatter_keeps_its_power(backend, near: float | None) -> None:
    """False alarms 1e-3 each; drawn near the specular direction, the innermost part of the lobe is found as well."""
    scatter = ABg(1e-5, 1e-4, 2.0)
    specular = unit(0.2, 0.1, 0.9)
    total = total_scatter(scatter, float(np.hypot(*specular[:2])))
    direction, event, weight = scattered(backend, scatter.lobe.numbers, specular, 1.0, 0.4, near)
    found = np.where(event == Event.SCATTER, weight, 0.0)
    assert (event == Event.SCATTER).mean() > 0.3
    assert abs(found.mean() - total) < 3.3 * found.std() / np.sqrt(N)
    assert found.std() / np.sqrt(N) < 0.004 * total
    assert abs(weight.mean() - 1.0) < 3.3 * weight.std() / np.sqrt(N)
    reach = 3e-4
    inner = np.where(np.hypot(*(direction - specular)[:, :2].T) < reach, found, 0.0)
    # of A / (B + d^2) in the disk; by the lobe alone a hundred of the paths would come so near
    expected = np.pi * scatter.a * np.log1p(reach**2 / scatter.b)
    assert abs(inner.mean() - expected) < 3.3 * inner.std() / np.sqrt(N)
    if near is not None:
        assert inner.std() / np.sqrt(N) < 0.01 * expected


def test_diffused_directions_follow_lambert(backend) -> None:
    direction, event, _ = left(
        backend, unit(0.6, 0.0, 0.8), 1.0, Event.DIFFUSE, (0.0, (1.0, 2.0, 0.0, lobe_area(1.0, 2.0))), 0.0, None
    )
    assert np.all(event == Event.DIFFUSE)
    assert np.all(direction[:, 2] > 0.0)
    r2, phi = np.sum(direction[:, :2] ** 2, axis=1), np.arctan2(direction[:, 1], direction[:, 0])
    counts = np.histogram2d(r2, phi, [np.linspace(0.0, 1.0, 11), ANGLES])[0].ravel()
    check(counts, np.full(counts.size, N / counts.size))


@pytest.mark.second
@pytest.mark.parametrize(
    "finish",
    [
        Finish(reflectance=0.5, diffuse=0.2, scatter=ABg(2e-2, 3e-2, 2.0)),
        Finish(reflectance=0.5, diffuse=0.2, table=of_lobe(ABg(1e-2, 3e-2, 2.0))),
    ],
    ids=["analytic", "table"],
)
def test_a_scattering_mirror_in_a_scene(backend, finish: Finish) -> None:
    """Share and pattern of the light that a mirror scatters onto a small screen, against the BSDF's integral. The
    analytic lobe is per power of the specular beam, a table per incident power.
    """
    scatter = ABg(2e-2, 3e-2, 2.0)
    half, distance = 0.05, 0.4
    aside = np.array([0.15, 0.0, distance])
    surface, grid = screen("screen", Pose(np.diag([-1.0, 1.0, -1.0]), aside), half, 4)
    tracer = PathTracer(
        backend, Scenery((*flat_mirror(finish), surface), (grid,)), sampling=Sampling(floor=0.3, scatter_floor=0.4)
    )
    direction = unit(-0.3, 0.1, -1.0)
    result = tracer.run(DiskSource.along(-0.3 * direction, direction, 0.0), N, 7)
    beta = direction[:2]

    def into(lobe: bool):
        def density(y: float, x: float) -> float:
            line = np.array([x, y, distance])
            length = np.linalg.norm(line)
            cosine = distance / length
            f = 0.5 * float(scatter.bsdf(np.hypot(*(line[:2] / length - beta)))) if lobe else 0.2 / np.pi
            return f * cosine * cosine / length**2

        return dblquad(density, 0.15 - half, 0.15 + half, -half, half, epsrel=1e-6)[0]

    for mark, expected in (("mirror*", into(True)), ("mirror~", into(False))):
        (family,) = (f for f in result.families if f.text == mark)
        assert family.kind == "stray"
        assert abs(family.energy - expected) < 3.89 * family.error, mark
        assert family.error < 0.03 * expected
    assert abs(result.balance.error) < 0.01


def skewed() -> ScatterTable:
    """A table of another lobe at every angle of incidence, different on both sides of the plane of incidence."""
    rng = np.random.default_rng(4)
    radial = np.radians([0.0, 5.0, 15.0, 40.0, 90.0, 180.0])
    azimuth = np.radians([0.0, 50.0, 140.0, 230.0, 300.0, 360.0])
    values = rng.uniform(0.2, 1.0, (3, 6, 6)) * np.array([3.0, 1.0, 0.3, 0.1, 0.05, 0.05])
    values[:, -1] = values[:, 0]
    values[:, :, 0] = values[:, :1, 0]
    return ScatterTable(np.radians([0.0, 35.0, 70.0]), azimuth, radial, 0.3 * values)


def scattered_by_table(backend, finish: Finish, specular: np.ndarray, floor: float = 0.0):
    """Return directions (N, 3), events and weights of N paths that leave z = 0."""
    tables = upload_finishes(backend, flat_mirror(finish))
    assert tables is not None
    every, cosine = dr.full(backend.Bool, True, N), dr.full(backend.Float, float(specular[2]), N)
    marks = tables.of(dr.zeros(backend.UInt, N), every)
    share, drawn = tables.total(marks, cosine, every), TableSampling(tables, marks, cosine)
    return left(backend, specular, 1.0, Event.REFLECT, (share, (1.0, 2.0, 0.0, 1.0)), floor, 0.5, drawn)


def relative(directions: np.ndarray, specular: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radial angle and azimuth of directions about the specular one, as Zemax counts them."""
    toward = np.array([0.0, 0.0, 1.0]) - specular[2] * specular
    toward = toward / np.linalg.norm(toward)
    side = np.cross(specular, toward)
    radial = np.arccos(np.clip(directions @ specular, -1.0, 1.0))
    return radial, np.mod(np.arctan2(directions @ side, directions @ toward), 2.0 * np.pi)


def expected_cells(table: ScatterTable, angle: float, radial: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Scattered share into cells, by an integral of the table itself; (radial, azimuth)."""
    out = np.zeros((len(radial) - 1, len(azimuth) - 1))
    fine = 60
    for i in range(len(radial) - 1):
        for j in range(len(azimuth) - 1):
            r = radial[i] + (radial[i + 1] - radial[i]) * (np.arange(fine) + 0.5)[:, None] / fine
            p = azimuth[j] + (azimuth[j + 1] - azimuth[j]) * (np.arange(fine) + 0.5)[None] / fine
            r, p = np.broadcast_arrays(r, p)
            up = np.cos(r) * np.cos(angle) + np.sin(r) * np.cos(p) * np.sin(angle)
            cell = (radial[i + 1] - radial[i]) * (azimuth[j + 1] - azimuth[j]) / fine**2
            out[i, j] = np.sum(table.bsdf(angle, p, r) * np.maximum(up, 0.0) * np.sin(r)) * cell
    return out


@pytest.mark.second
@pytest.mark.parametrize(("kind", "degrees"), quick(1, [("skewed", 52.0), ("skewed", 21.0), ("abg", 35.0)]))
def test_drawn_directions_follow_the_table(backend, kind: str, degrees: float) -> None:
    """At whole degrees, where no neighbour is taken for the angle of incidence."""
    table = skewed() if kind == "skewed" else of_lobe(ABg(2e-2, 1e-1, 1.8))
    angle = np.radians(degrees)
    specular = np.array([np.sin(angle) * 0.6, -np.sin(angle) * 0.8, np.cos(angle)])
    direction, event, weight = scattered_by_table(backend, Finish(reflectance=1.0, table=table), specular)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, atol=1e-12)
    assert np.all(direction[:, 2] > -1e-12)
    np.testing.assert_allclose(weight, 1.0, atol=1e-12)
    away = event == Event.SCATTER
    np.testing.assert_allclose(direction[~away], np.broadcast_to(specular, direction[~away].shape), atol=1e-15)
    total = table.total(angle)
    assert abs(away.mean() - total) < 3.3 * np.sqrt(total / N) + 1e-3 * total
    radial = np.radians([0.0, 5.0, 15.0, 27.0, 40.0, 60.0, 90.0, 130.0])
    azimuth = np.radians(np.linspace(0.0, 360.0, 9))
    r, p = relative(direction[away], specular)
    counts = np.histogram2d(r, p, [radial, azimuth])[0].ravel()
    expected = expected_cells(table, angle, radial, azimuth).ravel() * N
    counts, expected = np.append(counts, N - counts.sum()), np.append(expected, N - expected.sum())
    seen = expected > 25.0
    assert np.all(counts[expected < 0.01] == 0.0)
    # cells are filled evenly in solid angle: 1e-3 of each beside the noise
    statistic = np.sum((counts - expected)[seen] ** 2 / (expected + (1e-3 * expected) ** 2)[seen])
    assert statistic < chi2.ppf(1.0 - FALSE_ALARM, int(seen.sum()))


def test_between_two_angles_of_incidence_both_have_their_part(backend) -> None:
    """A table that scatters into one ring at 30 degrees and into another at 31."""
    radial = np.radians([0.0, 1.0, 5.0, 6.0, 12.0, 13.0, 17.0, 18.0])
    values = np.zeros((2, 1, 8))
    values[0, 0, [1, 2]], values[1, 0, [5, 6]] = 2.0, 1.0
    table = ScatterTable(np.radians([30.0, 31.0]), np.zeros(1), radial, values)
    angle = np.radians(30.3)
    specular = np.array([0.0, np.sin(angle), np.cos(angle)])
    direction, event, _ = scattered_by_table(backend, Finish(reflectance=1.0, table=table), specular)
    r, _ = relative(direction[event == Event.SCATTER], specular)
    inner, outer = 0.7 * table.total(np.radians(30.0)), 0.3 * table.total(np.radians(31.0))
    found = np.mean(r < np.radians(9.0))
    share = inner / (inner + outer)
    assert abs(found - share) < 3.9 * np.sqrt(share * (1.0 - share) / len(r))


@pytest.mark.second
def test_energy_is_kept_path_by_path(backend) -> None:
    """Drawn as the power goes, the balance is exact in every run."""
    surface, grid = screen("screen", Pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, 0.4])), 0.3)
    direction = unit(-0.2, 0.1, -1.0)
    for finish in (Finish(reflectance=0.7, table=skewed()), Finish(table=lambert(0.8), scattered_only=True)):
        tracer = PathTracer(backend, Scenery((*flat_mirror(finish), surface), (grid,)))
        result = tracer.run(DiskSource.along(-0.3 * direction, direction, 0.02), 100_000, 3)
        assert abs(result.balance.error) < 1e-12


@pytest.mark.second
def test_a_coating_by_its_table_is_the_surface_itself(backend) -> None:
    """Fresnel's reflectance as a table, met from outside and from inside, is bare glass."""
    degrees = np.linspace(0.0, 90.0, 361)
    fresnel = reflectance(np.cos(np.radians(np.minimum(degrees, 89.9999))), 1.0, 1.5)
    table = CoatingTable(np.radians(degrees), np.minimum(np.asarray(fresnel), 1.0))
    found = []
    for finish in (Finish(bare=True), Finish(transmission=1.0, coating=table)):
        scene = glass_scene(slab(0.3, 0.05, Coating.GROUND), 1.5, finish, (0.5, 0.0, 0.0))
        result = PathTracer(backend, scene).run(
            DiskSource.along(np.array([0.0, 0.0, -0.2]), np.array([0.0, 0.0, 1.0]), 0.0), 400_000, 5
        )
        found.append({f.text: f.energy for f in result.families if f.energy > 1e-3})
    assert found[0].keys() == found[1].keys()
    for text, energy in found[0].items():
        sigma = np.sqrt(2.0 * energy * (1.0 - energy) / 400_000)
        assert abs(found[1][text] - energy) < 3.9 * sigma + 1e-6, text


def test_a_coated_mirror(backend) -> None:
    table = CoatingTable(np.radians([0.0, 60.0]), np.array([0.9, 0.6]), np.array([0.05, 0.05]))
    surface, grid = screen("screen", Pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, 0.4])), 0.3)
    tracer = PathTracer(backend, Scenery((*flat_mirror(Finish(reflectance=0.98, coating=table)), surface), (grid,)))
    direction = unit(-np.tan(np.radians(30.0)), 0.0, -1.0)
    result = tracer.run(DiskSource.along(-0.1 * direction, direction, 0.0), 10_000, 3)
    # on a mirror what goes through its coating is lost in the substrate
    assert sum(f.energy for f in result.families) == pytest.approx(0.75, rel=1e-9)


# --- paths in glass, against closed forms and the sequential trace ----------------------------------------------------


Z_LIMIT = 3.89
INDEX = 1.5
THICKNESS = 0.02
PATHS = 200_000
FLOOR = Sampling(floor=0.3, steps=32)


def path_text(*names: str) -> str:
    return " ".join(f"glass/{n}" for n in names)


def find(result: PathResult, detector: str, text: str) -> Family:
    return next(f for f in result.families if f.detector == detector and f.text == text)


@pytest.mark.second
@pytest.mark.parametrize("angle", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("coated", [BARE, Finish(reflectance=0.02, transmission=0.97)], ids=["bare", "coated"])
def test_ghosts_of_a_plane_parallel_plate(backend, angle: float, coated: Finish) -> None:
    direction = unit(np.sin(angle), 0.0, np.cos(angle))
    source = DiskSource.along(-0.2 * direction / direction[2], direction, 1e-3)
    result = PathTracer(backend, glass_scene(slab(0.3, THICKNESS), INDEX, coated), sampling=FLOOR).run(source, PATHS, 3)
    if coated.bare:
        r = float(reflectance(np.cos(angle), 1.0, INDEX))
        t = 1.0 - r
    else:
        r, t = coated.reflectance, coated.transmission
    shift = 2.0 * THICKNESS * np.tan(np.arcsin(np.sin(angle) / INDEX))
    bounce = ("exit", "entry")
    expected = [("front", path_text("entry"), r, 0.0)]
    for k in range(3):
        expected.append(("behind", path_text("entry>", *bounce * k, "exit>"), t * t * r ** (2 * k), k * shift))
        expected.append(
            ("front", path_text("entry>", *bounce * k, "exit", "entry>"), t * t * r ** (2 * k + 1), (k + 1) * shift)
        )
    start = {name: find(result, name, text) for name, text, _, _ in expected[:2]}
    for detector, text, energy, aside in expected:
        family = find(result, detector, text)
        assert family.count > 30, text
        assert abs(family.energy - energy) < Z_LIMIT * family.error + 1e-15, (text, family.energy, energy)
        assert family.error < 0.2 * energy
        # the screen's x runs along -x behind the plate
        moved = (family.centroid[0] - start[detector].centroid[0]) * (-1.0 if detector == "behind" else 1.0)
        assert abs(moved - aside) < 2.0 * Z_LIMIT * 0.5e-3 / np.sqrt(family.count)
        assert family.kind == "ghost"
    series = r + t * t * r / (1.0 - r * r), t * t / (1.0 - r * r)
    for detector, total in zip(("front", "behind"), series, strict=True):
        found = sum(f.energy for f in result.families if f.detector == detector)
        error = np.sqrt(sum(f.error**2 for f in result.families if f.detector == detector))
        assert abs(found - total) < Z_LIMIT * error


def near_edges(rng: np.random.Generator, half: float, n: int) -> RaySource:
    """Rays from all around to points within some nanometres of a cube's edges."""
    corner = np.sign(rng.uniform(-1, 1, (n, 3))) * half
    along = rng.integers(0, 3, n)
    target = corner.copy()
    target[np.arange(n), along] = rng.uniform(-half, half, n)
    target += rng.normal(0.0, 1.0, (n, 3)) * 10.0 ** rng.uniform(-12, -5, (n, 1))
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return RaySource.even(target - 0.3 * direction, direction)


@pytest.mark.second
def test_no_light_leaks_through_edges(backend) -> None:
    """Paths aimed at the edges of a bare cube enter and leave it only by refraction at its faces."""
    half = 0.02
    faces = [Face(f"f{k}", "glass", Coating.TOTAL, cube_face(k, half)) for k in range(6)]
    scenery = glass_scene(Solid("glass", "N-BK7", tuple(faces)), INDEX, turn=(0.3, 0.5, 0.7), far=3.0)
    turn = rotation_matrix(np.array([0.3, 0.5, 0.7]))
    rays = near_edges(np.random.default_rng(8), half, 100_000)
    source = RaySource.even(rays.position @ turn.T, rays.direction @ turn.T)
    tracer = PathTracer(backend, scenery, sampling=Sampling(steps=64))
    result = tracer.run(source, seed=2)
    assert abs(result.balance.error) < 1e-12
    assert not result.balance.absorbed
    assert result.balance.under_way < 1e-3  # trapped by total reflection; a cube holds some of it for ever
    entered = 0
    for codes in tracer.events(source, np.arange(20_000), 100_000, 2):
        inside = False
        for number in codes:
            part, event, _ = decode(number)
            on_glass = scenery.parts[part].startswith("glass/")
            assert on_glass or not inside
            if event is Event.TRANSMIT:
                inside = not inside
                entered += inside
        assert not inside or len(codes) > 30
    assert entered > 5000


def cube_face(k: int, half: float) -> Pose:
    normal = np.zeros(3)
    normal[k // 2] = 1.0 if k % 2 else -1.0
    return frame(tuple(normal), tuple(half * normal))


def test_what_the_step_limit_cuts_off_is_under_way(backend) -> None:
    source = DiskSource.along(np.array([0.0, 0.0, -0.2]), unit(0.3, 0.0, 1.0), 1e-3)
    for steps, expected in ((1, 1.0), (32, 0.0)):
        tracer = PathTracer(backend, glass_scene(slab(0.3, THICKNESS), INDEX), sampling=Sampling(steps=steps))
        balance = tracer.run(source, 1000).balance
        assert balance.under_way == pytest.approx(expected, abs=1e-12)
        assert abs(balance.error) < 1e-12


def test_more_detections_than_expected_are_all_kept(backend) -> None:
    """The room for records grows: a launch that overflows it is done again."""
    surface, grid = screen("behind", facing(0.5), 1.0)
    tracer = PathTracer(backend, Scenery((surface,), (grid,)))
    source = DiskSource.along(np.zeros(3), np.array([0.0, 0.0, 1.0]), 1e-3)
    result = tracer.run(source, 70_000, chunk=60_000)
    (family,) = result.families
    assert family.count == 70_000
    assert family.energy == pytest.approx(1.0, rel=1e-12)
    assert result.detections.path.size == 0
    kept = tracer.run(source, 70_000, chunk=60_000, keep=True).detections
    np.testing.assert_array_equal(kept.path, np.arange(70_000))


def test_too_many_and_turned_apertures_of_a_face_are_refused() -> None:
    """A face carries two clear apertures at most, and none that is turned against it unless it is round."""
    entry = frame((0, 0, -1), (0, 0, 0))
    turned = Pose(entry.rotation @ rotation_matrix(np.array([0.0, 0.0, 0.3])), entry.translation)
    for pose, apertures, words in (
        (entry, [Circle(0.01), Circle(0.02), Circle(0.03)], "face 'entry' has 3 clear apertures, not at most 2"),
        (turned, [Rectangle(0.01, 0.02)], "its clear aperture is rotated relative to the face 'entry'"),
    ):
        common = ("glass/e", plane(), Interaction.REFRACT)
        made = [Element(f"e{k}", *common, one, solid="glass") for k, one in enumerate(apertures)]
        tree = RigidTree((Body("glass"), Body("glass/e", pose)))
        assembly = Assembly(tree, {one.name: one for one in made}, {}, {"glass": INDEX})
        with pytest.raises(ValueError, match=words):
            solid_surfaces(slab(0.3, THICKNESS), assembly, assembly.place(), {}, Finishes(ground=ABSORBER))
