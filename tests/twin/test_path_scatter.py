"""Scattered directions of the path tracer against the BSDF, by chi-square with a false-alarm rate of 1e-3 each."""

from __future__ import annotations

from itertools import pairwise

import drjit as dr
import numpy as np
import pytest
from scipy.integrate import dblquad
from scipy.stats import chi2

from optics.geometry.pose import Pose
from optics.materials.finish import Finish
from optics.materials.scatter import ABg, HarveyShack, lobe_area, total_scatter
from scenes.models.scenery import Scenery
from tests.optics.bench import unit
from tests.twin.path_bench import flat_mirror, screen
from twin.path_tracing.families import Event
from twin.path_tracing.source import DiskSource, random_streams
from twin.path_tracing.spreading import Leaving, spread
from twin.path_tracing.tracer import PathTracer, Sampling

FALSE_ALARM = 1e-3
N = 1_000_000
ANGLES = np.linspace(-np.pi, np.pi, 9)


def left(backend, direction, index: float, event: Event, lobe, floor: float, near: float | None, drawn=None):
    """Return directions (N, 3), events and weights of N paths that leave z = 0 in a direction.

    ``lobe`` is the scattered share and the numbers of the lobe, ``drawn`` a table in place of it.
    """
    vector = backend.Vector3(*(dr.full(backend.Float, float(c), N) for c in direction))
    leaving = Leaving(
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
    out, event, weight, _ = spread(
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
def test_a_scattering_mirror_in_a_scene(backend) -> None:
    """Share and pattern of the light that a mirror scatters onto a small screen, against the BSDF's integral."""
    scatter = ABg(2e-2, 3e-2, 2.0)
    finish = Finish(reflectance=0.5, diffuse=0.2, scatter=scatter)
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
