"""Scattering: tables and lobes against closed forms and integrals over the hemisphere, draws against the BSDF; Fresnel.

Chi-square tests use fixed seeds and a false-alarm rate of 1e-3 each.
"""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from scipy.stats import chi2

from optics.materials import fresnel_scatter as finishes
from optics.materials.fresnel_scatter import (
    STEPS,
    ABg,
    HarveyShack,
    ScatterTable,
    acceptance,
    sample_distance,
    total_scatter,
)
from scenes.models.scenery import Finishes, MeasuredFinishes

INCIDENCE = np.radians([0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0])
HALF = np.radians(np.linspace(0.0, 180.0, 19))


def table_of(density, incidence=INCIDENCE, azimuth=HALF, radial=None) -> ScatterTable:
    """A table of a BSDF that is told by (cosine of incidence direction, directions as unit vectors)."""
    radial = np.radians(np.linspace(0.0, 180.0, 181)) if radial is None else radial
    values = np.empty((len(incidence), len(azimuth), len(radial)))
    for i, t in enumerate(incidence):
        p, r = np.meshgrid(azimuth, radial, indexing="ij")
        up = np.cos(r) * np.cos(t) + np.sin(r) * np.cos(p) * np.sin(t)
        # along the plane of incidence and across it, of the scattered direction
        x = np.cos(r) * np.sin(t) - np.sin(r) * np.cos(p) * np.cos(t)
        y = np.sin(r) * np.sin(p)
        values[i] = density(t, x, y, up)
    return ScatterTable(incidence, azimuth, radial, values)


def lambert(albedo: float) -> ScatterTable:
    return table_of(lambda t, x, y, up: np.full(up.shape, albedo / np.pi))


def of_lobe(lobe: ABg) -> ScatterTable:
    radial = np.concatenate([[0.0], np.geomspace(1e-4, np.pi, 400)])
    return table_of(lambda t, x, y, up: lobe.bsdf(np.hypot(x - np.sin(t), y)), radial=radial)


@pytest.mark.parametrize("angle", [0.0, 7.0, 33.0, 60.0, 79.0, 88.0])
def test_lamberts_total_is_its_albedo(angle) -> None:
    assert lambert(0.3).total(np.radians(angle)) == pytest.approx(0.3, rel=2e-3)


@pytest.mark.second
def test_the_total_is_the_integral_of_the_interpolated_table() -> None:
    rng = np.random.default_rng(1)
    table = ScatterTable(
        np.radians([10.0, 40.0]),
        np.radians([0.0, 60.0, 180.0]),
        np.radians([0.0, 20.0, 50.0]),
        0.05 * rng.uniform(0.2, 1.0, (2, 3, 3)),
    )
    for degrees in (10.0, 25.0, 40.0):
        t = np.radians(degrees)

        def density(r: float, p: float, t: float = t) -> float:
            up = np.cos(r) * np.cos(t) + np.sin(r) * np.cos(p) * np.sin(t)
            return float(table.bsdf(t, np.array([p]), np.array([r]))[0]) * max(up, 0.0) * np.sin(r)

        pieces = [
            dblquad(density, a, b, c, d, epsrel=1e-4)[0]
            for a, b in ((0.0, np.radians(60.0)), (np.radians(60.0), np.pi))
            for c, d in ((0.0, np.radians(20.0)), (np.radians(20.0), np.radians(50.0)))
        ]
        assert table.total(t) == pytest.approx(2.0 * sum(pieces), rel=1e-3)
    # beyond its first and last angle of incidence the table is that of these
    np.testing.assert_array_equal(
        table.bsdf(0.0, HALF, 0.1 + 0.0 * HALF), table.bsdf(np.radians(10.0), HALF, 0.1 + 0 * HALF)
    )
    assert table.bsdf(0.2, np.array([0.0]), np.array([np.radians(50.1)]))[0] == 0.0


def test_azimuths_of_half_a_turn_are_mirrored_and_whole_ones_are_not() -> None:
    values = np.array([[[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]]) * 1e-3
    half = ScatterTable(np.zeros(1), np.radians([0.0, 90.0, 180.0]), np.radians([0.0, 30.0]), values)
    p, r = np.radians([45.0, -45.0, 135.0, 225.0, 405.0]), np.full(5, 0.1)
    np.testing.assert_allclose(half.bsdf(0.0, p, r), np.array([1.5, 1.5, 2.5, 2.5, 1.5]) * 1e-3)
    whole = ScatterTable(np.zeros(1), np.radians([0.0, 180.0, 360.0]), np.radians([0.0, 30.0]), values[:, [0, 2, 0]])
    np.testing.assert_allclose(whole.bsdf(0.0, p, r), np.array([1.5, 1.5, 2.5, 2.5, 1.5]) * 1e-3)
    assert half.mirrored
    assert not whole.mirrored
    assert half.total(0.0) == pytest.approx(whole.total(0.0), rel=1e-6)


def test_reciprocity() -> None:
    """Lambert and ABg are reciprocal; what depends on the angle of incidence alone is not."""
    assert lambert(0.3).reciprocity() == pytest.approx(0.0, abs=1e-12)
    # 10 deg of incidence, 10 deg of azimuth: linear between them
    assert of_lobe(ABg(1e-2, 0.2, 2.0)).reciprocity() < 0.1
    one_way = table_of(lambda t, x, y, up: np.full(up.shape, 0.1 * np.cos(t) ** 2))
    assert one_way.reciprocity() > 0.3
    for table, words in ((lambert(0.3), []), (one_way, ["the BSDF of black surfaces is not reciprocal"])):
        told = MeasuredFinishes(Finishes(), {"black": SimpleNamespace(table=table)}, {}).warnings()
        assert [text.partition(":")[0] for text in told] == words


def test_shares_of_drawn_cells_are_those_of_the_table() -> None:
    drawn = lambert(0.5).sampling
    assert drawn.share.shape == (STEPS + 1,)
    np.testing.assert_allclose(drawn.share, 0.5, rtol=2e-3)
    # at normal incidence a ring up to r has sin^2 r of the light
    sine2 = 1.0 - drawn.cosines**2
    above = drawn.cosines > 0.0
    np.testing.assert_allclose(drawn.rings[0][above], sine2[above], atol=2e-4)
    assert np.all(np.diff(drawn.rings, axis=1) >= 0.0)
    assert np.all(drawn.sectors[:, :, -1] == 1.0)


def test_coatings() -> None:
    coating = finishes.CoatingTable(np.radians([0.0, 40.0]), np.array([0.1, 0.3]), np.array([0.8, 0.5]))
    assert coating.at(np.radians(20.0), True) == pytest.approx((0.2, 0.65))
    assert coating.at(np.radians(80.0), True) == pytest.approx((0.3, 0.5))
    bare = finishes.CoatingTable(np.radians([0.0, 40.0]), np.array([0.1, 0.3]))
    assert bare.at(np.radians(20.0), True) == pytest.approx((0.2, 0.8))
    assert bare.at(np.radians(20.0), False) == pytest.approx((0.2, 0.0))
    np.testing.assert_allclose(bare.sampled(False)[80], [0.2, 0.0])


FALSE_ALARM = 1e-3
LOBES = [
    *(ABg(*numbers) for numbers in ((1e-3, 1e-4, 1.5), (2e-3, 1e-5, 2.0), (1e-3, 1e-5, 2.5), (1e-3, 1e-3, 3.5))),
    *(HarveyShack(*numbers) for numbers in ((3.0, 0.01, -1.7), (0.5, 0.1, -2.0), (2.0, 0.05, -3.0))),
]


@pytest.mark.parametrize(("a", "b"), [(2e-6, 1e-6), (1e-3, 1e-2), (1e-9, 1e-14)])
def test_total_of_abg_with_g_2(a: float, b: float) -> None:
    assert total_scatter(ABg(a, b, 2.0)) == pytest.approx(np.pi * a * np.log1p(1.0 / b), rel=1e-9)


@pytest.mark.parametrize("s", [-1.0, -1.7, -2.5, -4.0])
def test_total_of_harvey_shack(s: float) -> None:
    b0, scale = 1.5, 0.02
    exact = 2.0 * np.pi * b0 * scale**2 / (s + 2.0) * ((1.0 + scale**-2) ** (0.5 * (s + 2.0)) - 1.0)
    assert total_scatter(HarveyShack(b0, scale, s)) == pytest.approx(exact, rel=1e-9)


def test_total_of_a_flat_lobe_is_lamberts() -> None:
    assert total_scatter(HarveyShack(0.3, 1.0, 0.0)) == pytest.approx(0.3 * np.pi, rel=1e-9)


@pytest.mark.parametrize("sine", [0.3, 0.7, 0.95])
def test_total_at_oblique_incidence(sine: float) -> None:
    lobe = ABg(5e-3, 0.05, 2.0)
    theta, dt = np.linspace(0.0, 0.5 * np.pi, 2001, retstep=True)
    phi = (np.arange(2000) + 0.5) * np.pi / 2000
    beta = np.sin(theta)[:, None]
    distance = np.sqrt(np.maximum(beta**2 + sine**2 - 2.0 * beta * sine * np.cos(phi), 0.0))
    ring = np.mean(lobe.bsdf(distance), axis=1) * 2.0 * np.pi * np.cos(theta) * np.sin(theta)
    assert total_scatter(lobe, sine) == pytest.approx(np.sum(0.5 * (ring[1:] + ring[:-1])) * dt, rel=1e-5)


def test_more_than_all_cannot_be_scattered() -> None:
    with pytest.raises(ValueError, match="too strong"):
        _ = HarveyShack(0.3, 1.0, 0.0).lobe


@pytest.mark.parametrize("scatter", LOBES, ids=str)
def test_draws_follow_the_bsdf(scatter: ABg | HarveyShack) -> None:
    lobe, rng, n = scatter.lobe, np.random.default_rng(5), 400_000
    distance = sample_distance(rng.uniform(size=n), lobe.scale, lobe.exponent)
    kept = rng.uniform(size=n) < acceptance(distance, lobe.scale, lobe.exponent, float(lobe.abg))
    edges = np.concatenate([[0.0], np.geomspace(0.02 * lobe.scale, 2.0, 40)])
    counts = np.histogram(distance[kept], edges)[0]
    # share into each ring, from the BSDF itself: the lobe's share is what is drawn
    ring = [quad(lambda d: 2.0 * np.pi * d * float(scatter.bsdf(d)), a, b)[0] for a, b in pairwise(edges)]
    expected = n * np.array(ring) / lobe.share
    assert distance.max() <= 2.0
    use = expected > 20.0
    assert use.sum() > 15
    rest = np.append(expected[use], n - expected[use].sum())
    found = np.append(counts[use], n - counts[use].sum())
    if rest[-1] < 20.0:  # all is kept
        rest, found = rest[:-1], found[:-1]
    statistic = np.sum((found - rest) ** 2 / rest)
    assert statistic < chi2.ppf(1.0 - FALSE_ALARM, len(rest) - 1)


@pytest.mark.parametrize("finish", [f for f in vars(finishes).values() if isinstance(f, finishes.Finish)], ids=repr)
def test_library_finishes_conserve_energy(finish: finishes.Finish) -> None:
    total = finish.reflectance + finish.transmission + finish.diffuse
    assert 0.0 <= total <= (0.0 if finish.bare else 1.0)
    assert len(finish.numbers) == 8


INDICES = [(1.0, 1.5), (1.5, 1.0), (1.0, 4.0), (1.33, 1.52)]


@pytest.mark.parametrize(("before", "after"), INDICES)
def test_against_the_sine_and_tangent_form(before: float, after: float) -> None:
    critical = np.arcsin(min(1.0, after / before))
    a = np.linspace(0.01, 0.999 * min(critical, 0.5 * np.pi), 200)
    b = np.arcsin(before / after * np.sin(a))
    s, p = np.sin(a - b) / np.sin(a + b), np.tan(a - b) / np.tan(a + b)
    np.testing.assert_allclose(finishes.reflectance(np.cos(a), before, after), 0.5 * (s**2 + p**2), rtol=1e-9)
    np.testing.assert_allclose(finishes.cosine_after(np.cos(a), before, after), np.cos(b), rtol=1e-12)


@pytest.mark.parametrize(("before", "after"), INDICES)
def test_normal_and_grazing_incidence(before: float, after: float) -> None:
    assert finishes.reflectance(1.0, before, after) == pytest.approx(
        ((before - after) / (before + after)) ** 2, rel=1e-14
    )
    assert finishes.reflectance(0.0, before, after) == pytest.approx(1.0, abs=1e-10)


def test_beyond_the_critical_angle_all_is_reflected() -> None:
    cosine = np.cos(np.arcsin(1.0 / 1.5) + np.linspace(1e-9, 0.5, 50))
    assert np.all(finishes.reflectance(cosine, 1.5, 1.0) == 1.0)
    assert np.all(finishes.cosine_after(cosine, 1.5, 1.0) == 0.0)
    assert finishes.reflectance(np.cos(np.arcsin(1.0 / 1.5) - 1e-6), 1.5, 1.0) < 1.0


def test_the_same_on_drjit(backend) -> None:
    cosine = np.linspace(0.0, 1.0, 101)
    for before, after in INDICES:
        got = finishes.reflectance(backend.opaque(cosine), before, after).numpy()
        np.testing.assert_allclose(got, finishes.reflectance(cosine, before, after), rtol=0, atol=1e-15)
