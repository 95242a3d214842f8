"""Figs. 3-5 of paper 000 on the synthetic descending pass near 40 N 116 E, in ECEF."""

import numpy as np
import pytest

from analysis.orbit.angles import sensitivity
from analysis.orbit.planes import METHODS, Station
from tests.analysis.refusals import refuses
from tests.analysis.test_planes import LOOK, SCENE, noisy, rotation

AXES = "xyz"
PAIRS = {"alpha": ("forward", "nadir"), "beta": ("nadir", "backward")}


def table(scene=SCENE, method="tls", **options):
    strips = dict(zip(scene.points, scene.strips(1.5), strict=True))
    return sensitivity(Station.of(scene.station, 0.5), strips, PAIRS, method=method, **options)


ROWS = {(row.what, row.axis): row for row in table()}


def test_slopes_by_geometry():
    """Moving a strip by s turns its plane by s . n / range, opening or closing an angle; the station does the opposite
    of all strips together. Normals and ranges from the scene's own axes. Ranges vary by 1% with relief and along the
    line, and are averaged; hence 1%.
    """
    normal = {
        k: SCENE.body @ rotation([0, a, 0])[:, 0] for k, a in (("forward", LOOK), ("nadir", 0), ("backward", -LOOK))
    }
    turn = {k: n / np.mean(along(SCENE, k)) for k, n in normal.items()}
    expected = {
        ("forward", 0): turn["forward"],
        ("nadir", 0): -turn["nadir"],
        ("nadir", 1): turn["nadir"],
        ("backward", 1): -turn["backward"],
        ("forward", 1): np.zeros(3),
        ("backward", 0): np.zeros(3),
    }
    expected[("station", 0)] = -expected[("forward", 0)] - expected[("nadir", 0)]
    expected[("station", 1)] = -expected[("nadir", 1)] - expected[("backward", 1)]
    for (what, angle), vector in expected.items():
        found = np.array([ROWS[what, axis].slope[angle] for axis in AXES])
        assert found == pytest.approx(vector, abs=0.01 * 2e-6)


def along(scene, name):
    """Distance of a strip's points from the station, along the line of sight of the line's centre."""
    look = {"forward": LOOK, "nadir": 0.0, "backward": -LOOK}[name]
    return (scene.points[name] - scene.station) @ scene.body @ [np.sin(look), 0, np.cos(look)]


@pytest.mark.parametrize("method", METHODS)
def test_linear_derivative_agrees_with_recomputation(method):
    """Second order of 10 m over 500 km is 2e-5 of the slope, with factors up to 5. On noisy points, where the
    derivative leaves out terms of residual over spread (2 m / 17 km)."""
    scene = noisy(SCENE, np.random.default_rng(2), 1.5, 0.5)
    for row in table(scene, method):
        assert row.change[:, 0] == pytest.approx(0, abs=0)
        assert np.abs(row.change[:, -1] / 10.0 - row.slope).max() < 1e-3 * 2e-6
        assert np.abs(row.change[:, 1] - row.slope).max() < 1e-3 * 2e-6


@pytest.mark.parametrize("amounts", [[0, 1], [1, 2, 3], [0, 2, 1], [0, 1, np.nan], np.zeros((3, 3))])
def test_bad_amounts(amounts):
    refuses(ValueError, "rising numbers", table, amounts=amounts)
