"""Scatter lobes: totals against closed forms and against an integral over the hemisphere, draws against the BSDF.

Chi-square tests use fixed seeds and a false-alarm rate of 1e-3 each.
"""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import chi2

from optics.materials.finish import ABSORBER, BARE, BLACK, COATED, GROUND, MIRROR, SILICON, Finish
from optics.materials.scatter import ABg, HarveyShack, acceptance, sample_distance, total_scatter

FALSE_ALARM = 1e-3
LOBES = [
    ABg(1e-3, 1e-4, 1.5),
    ABg(2e-3, 1e-5, 2.0),
    ABg(1e-3, 1e-5, 2.5),
    ABg(1e-3, 1e-3, 3.5),
    HarveyShack(3.0, 0.01, -1.7),
    HarveyShack(0.5, 0.1, -2.0),
    HarveyShack(2.0, 0.05, -3.0),
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


@pytest.mark.parametrize("finish", [MIRROR, COATED, BARE, GROUND, BLACK, SILICON, ABSORBER], ids=repr)
def test_library_finishes_conserve_energy(finish: Finish) -> None:
    total = finish.reflectance + finish.transmission + finish.diffuse
    assert 0.0 <= total <= (0.0 if finish.bare else 1.0)
    assert len(finish.numbers) == 8
