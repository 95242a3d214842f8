"""Tables of scattering: totals against closed forms, reciprocity, shares of cells, what is refused."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import dblquad

from optics.materials.finish import CoatingTable
from optics.materials.scatter import STEPS, ABg, ScatterTable, total_scatter
from scenes.models.scenery import MeasuredFinishes
from scenes.models.scenery_parts import Finishes

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


@pytest.mark.parametrize("angle", [0.0, 30.0, 70.0])
def test_the_total_of_a_lobe(angle) -> None:
    """400 radial angles in steps of 2.6 %: linear between them, f of d^-2 is too high by 2e-4."""
    lobe = ABg(2e-3, 1e-3, 2.0)
    found = of_lobe(lobe).total(np.radians(angle))
    assert found == pytest.approx(total_scatter(lobe, np.sin(np.radians(angle))), rel=3e-3)


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
    drawn = lambert(0.5).drawn
    assert drawn.share.shape == (STEPS + 1,)
    np.testing.assert_allclose(drawn.share, 0.5, rtol=2e-3)
    # at normal incidence a ring up to r has sin^2 r of the light
    sine2 = 1.0 - drawn.cosines**2
    above = drawn.cosines > 0.0
    np.testing.assert_allclose(drawn.rings[0][above], sine2[above], atol=2e-4)
    assert np.all(np.diff(drawn.rings, axis=1) >= 0.0)
    assert np.all(drawn.sectors[:, :, -1] == 1.0)


def test_coatings() -> None:
    coating = CoatingTable(np.radians([0.0, 40.0]), np.array([0.1, 0.3]), np.array([0.8, 0.5]))
    assert coating.at(np.radians(20.0), True) == pytest.approx((0.2, 0.65))
    assert coating.at(np.radians(80.0), True) == pytest.approx((0.3, 0.5))
    bare = CoatingTable(np.radians([0.0, 40.0]), np.array([0.1, 0.3]))
    assert bare.at(np.radians(20.0), True) == pytest.approx((0.2, 0.8))
    assert bare.at(np.radians(20.0), False) == pytest.approx((0.2, 0.0))
    np.testing.assert_allclose(bare.drawn(False)[80], [0.2, 0.0])
