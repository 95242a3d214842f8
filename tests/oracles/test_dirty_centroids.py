"""Corrected centres of spots in dirty frames against photutils, which is told nothing but which pixels are left out."""

import numpy as np
import pytest

from analysis.spots.noise import NoiseModel
from analysis.spots.screened_fit import one_shape
from optics.numerics.threads import one_blas_thread
from tests.tiers import quick
from tests.twin.dirty_frames import draw, measurement

pytestmark = pytest.mark.oracle

HALF = 7
"""Of the window in which photutils fits its Gaussian, the radius of the first dark ring."""


@pytest.mark.parametrize("kind", quick(0, ["bad pixels", "cosmic rays", "missing frames", "other light"]))
def test_shifts_agree_with_those_of_photutils(experiment, kind):
    """A Gaussian with a constant, weighted, masked where ours leaves pixels out, of the mean that ours works with.

    Both see the same frames, so that their difference is no more than what the less efficient of both does: the spread
    over the sets, by which it is judged, is that of the Gaussian's own sigma and ours together.
    """
    centroids = pytest.importorskip("photutils.centroids")
    pair = experiment("gf7_pair")
    template = one_shape(pair.calibration.template, 0, pair.calibration.template.shape)
    noise: NoiseModel = pair.calibration.noise
    ratios = []
    with one_blas_thread():
        for seed in range(300, 308):
            drawn = draw(template, pair.detector, (kind,), seed)
            work = measurement(drawn, template, noise)
            assert work.search() == []
            assert work.measure() == []
            places, sigmas, holes = [], [], 0
            for positions, spot in zip(work.positions, (work.result().before, work.result().after[0]), strict=True):
                row, column = (round(float(v[0])) for v in (positions.row, positions.column))
                part = np.s_[row - HALF : row + HALF + 1, column - HALF : column + HALF + 1]
                image = spot.mean[part]
                holes = max(holes, int(np.count_nonzero(~spot.used[part])))
                variance = noise.temporal_variance_dn2(image, 9) + noise.fixed_variance_dn2(image)
                x, y = centroids.centroid_2dg(
                    image - positions.background[0], error=np.sqrt(variance), mask=~spot.used[part]
                )
                places.append((y + row - HALF, x + column - HALF))
                sigmas.append(np.sqrt(np.diag(positions.covariance[0])))
            # a spot is no Gaussian: with more holes on one side the Gaussian has a bias of its own
            if holes > 1:
                continue
            other = np.subtract(places[1], places[0])
            ours = (work.positions[1].position - work.positions[0].position)[0]
            # the Gaussian's sigma is some 1.2 of ours on clean spots (its own test); of both together
            joint = np.hypot(*sigmas) * np.hypot(1.0, 1.2)
            ratios.append((ours - other) / joint)
    found = np.array(ratios)
    assert len(found) > 2
    # 16 numbers: 4 sigma once in 1000
    assert np.all(np.abs(found) < 4.0)
    # and a difference there is: the comparison is not of a thing with itself
    assert np.std(found) > 0.01
