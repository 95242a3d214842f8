"""Measured finishes in the path tracer: drawn directions against their tables by chi-square with a false-alarm rate of
1e-3 each, tables of analytic finishes against these, coatings against their tables.
"""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest
from scipy.stats import chi2

from optics.geometry.pose import Pose
from optics.geometry.solid import Coating
from optics.materials.finish import CoatingTable, Finish, reflectance
from optics.materials.scatter import ABg, ScatterTable
from scenes.models.scenery import Scenery
from tests.optics.bench import unit
from tests.optics.test_scatter_table import lambert, of_lobe
from tests.tiers import quick
from tests.twin.path_bench import flat_mirror, glass_scene, screen, slab
from tests.twin.test_path_scatter import left
from twin.path_tracing.families import Event
from twin.path_tracing.source import DiskSource
from twin.path_tracing.spreading import TableDraw
from twin.path_tracing.tables import upload_finishes
from twin.path_tracing.tracer import PathTracer, Sampling

FALSE_ALARM = 1e-3
N = 1_000_000


def skewed() -> ScatterTable:
    """A table of another lobe at every angle of incidence, different on both sides of the plane of incidence."""
    rng = np.random.default_rng(4)
    radial = np.radians([0.0, 5.0, 15.0, 40.0, 90.0, 180.0])
    azimuth = np.radians([0.0, 50.0, 140.0, 230.0, 300.0, 360.0])
    values = rng.uniform(0.2, 1.0, (3, 6, 6)) * np.array([3.0, 1.0, 0.3, 0.1, 0.05, 0.05])
    values[:, -1] = values[:, 0]
    values[:, :, 0] = values[:, :1, 0]
    return ScatterTable(np.radians([0.0, 35.0, 70.0]), azimuth, radial, 0.3 * values)


def scattered(backend, finish: Finish, specular: np.ndarray, floor: float = 0.0):
    """Return directions (N, 3), events and weights of N paths that leave z = 0."""
    tables = upload_finishes(backend, flat_mirror(finish))
    assert tables is not None
    every, cosine = dr.full(backend.Bool, True, N), dr.full(backend.Float, float(specular[2]), N)
    marks = tables.of(dr.zeros(backend.UInt, N), every)
    share, drawn = tables.total(marks, cosine, every), TableDraw(tables, marks, cosine)
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


@pytest.mark.parametrize(("kind", "degrees"), quick(1, [("skewed", 52.0), ("skewed", 21.0), ("abg", 35.0)]))
def test_drawn_directions_follow_the_table(backend, kind: str, degrees: float) -> None:
    """At whole degrees, where no neighbour is taken for the angle of incidence."""
    table = skewed() if kind == "skewed" else of_lobe(ABg(2e-2, 1e-1, 1.8))
    angle = np.radians(degrees)
    specular = np.array([np.sin(angle) * 0.6, -np.sin(angle) * 0.8, np.cos(angle)])
    direction, event, weight = scattered(backend, Finish(reflectance=1.0, table=table), specular)
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
    direction, event, _ = scattered(backend, Finish(reflectance=1.0, table=table), specular)
    r, _ = relative(direction[event == Event.SCATTER], specular)
    inner, outer = 0.7 * table.total(np.radians(30.0)), 0.3 * table.total(np.radians(31.0))
    found = np.mean(r < np.radians(9.0))
    share = inner / (inner + outer)
    assert abs(found - share) < 3.9 * np.sqrt(share * (1.0 - share) / len(r))


@pytest.mark.second
def test_an_analytic_finish_as_a_table_gives_the_same_stray_light(backend) -> None:
    """Onto a small screen: within Monte Carlo noise, and 2e-3 for what is linear between 400 radial angles.

    The analytic lobe is per power of the specular beam, a table per incident power.
    """
    analytic = Finish(reflectance=0.5, scatter=ABg(2e-2, 3e-2, 2.0))
    tabled = Finish(reflectance=0.5, table=of_lobe(ABg(1e-2, 3e-2, 2.0)))
    pose, direction = Pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.15, 0.0, 0.4])), unit(-0.3, 0.1, -1.0)
    found = []
    for finish in (analytic, tabled):
        surface, grid = screen("screen", pose, 0.05, 4)
        sampling = Sampling(floor=0.3, scatter_floor=0.4)
        tracer = PathTracer(backend, Scenery((*flat_mirror(finish), surface), (grid,)), sampling=sampling)
        result = tracer.run(DiskSource.along(-0.3 * direction, direction, 0.0), N, 7)
        (family,) = (f for f in result.families if f.kind == "stray")
        found.append((family.energy, family.error))
        # weights of what is drawn more often than it is are right on average
        assert abs(result.balance.error) < 0.01
    (one, noise), (two, other) = found
    assert abs(one - two) < 3.89 * np.hypot(noise, other) + 2e-3 * one
    assert other < 0.03 * two


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
