"""Figs. 3-5 of paper 000 on the synthetic descending pass near 40 N 116 E, in ECEF."""

import numpy as np
import pytest

from analysis.orbit.planes import METHODS, Station, sensitivity
from tests.analysis.refusals import refuses
from tests.analysis.test_planes import SCENE, noisy

PAIRS = {"alpha": ("forward", "nadir"), "beta": ("nadir", "backward")}


def table(scene=SCENE, method="tls", **options):
    strips = dict(zip(scene.points, scene.strips(1.5), strict=True))
    return sensitivity(Station.of(scene.station, 0.5), strips, PAIRS, method=method, **options)


@pytest.mark.second
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
