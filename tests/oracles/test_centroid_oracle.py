"""Spot centres of rendered monitor frames against photutils' centroids."""

import numpy as np
import pytest

from analysis.spots.centroid import energy_centroid, gaussian_fit, mean_frames
from analysis.spots.noise import NoiseModel
from analysis.spots.screened_fit import single_template
from optics.geometry.tree import Motion, State
from optics.numerics.backend import one_blas_thread
from scenes.specs.instrument import BASE
from tests.tiers import quick
from tests.twin.dirty_frames import draw, measurement

pytestmark = pytest.mark.oracle

FRAMES = 9
BORDER = 4
RADIUS = 20.0
STATES: list[State] = [
    {f"{BASE}/{c}/focal_plane": Motion(shift=(s * 7e-6, -s * 4e-6, 0.0)) for c in ("forward", "backward")}
    for s in (-2.3, -1.0, 0.0, 0.4, 1.7)
]


@pytest.fixture(scope="module")
def setup(experiment):
    return experiment("gf7_pair")


@pytest.fixture(scope="module")
def spots(setup) -> np.ndarray:
    """Mean frames (20, H, W) of four spots in five states, with all the noise of the CCDs."""
    after = setup.frames_after(setup.path.expected_photons(STATES), FRAMES, 4)
    return mean_frames(after).reshape(-1, *after.shape[-2:])


def distance(shape: tuple[int, ...], place: tuple[float, float]) -> np.ndarray:
    rows, columns = np.indices(shape)
    return np.hypot(rows - place[0], columns - place[1])


@pytest.mark.second
def test_energy_centroid(setup, spots) -> None:
    """Ours is the first moment in a window about itself: photutils' moment of the same pixels has to be there.

    What is left is the iteration's last step, 1e-7 px, and the moments' rounding.
    """
    centroids = pytest.importorskip("photutils.centroids")
    found = energy_centroid(spots, FRAMES, setup.calibration.noise, RADIUS, border_px=BORDER)
    assert found.converged.all()
    for spot, row, column in zip(spots, found.row, found.column, strict=True):
        inner = np.zeros(spot.shape, bool)
        inner[BORDER:-BORDER, BORDER:-BORDER] = True
        light = (spot - spot[~inner].mean()) * np.clip(RADIUS + 0.5 - distance(spot.shape, (row, column)), 0.0, 1.0)
        x, y = centroids.centroid_com(light)
        assert (y, x) == pytest.approx((row, column), abs=1e-6)
    assert len(spots) == len(STATES) * 4 == 20
    assert np.ptp(found.column.reshape(len(STATES), 4), axis=0).min() > 1.0  # the spots did move


@pytest.mark.second
def test_gaussian_fit(setup, spots) -> None:
    """photutils fits Gaussian and constant too, but with equal weights and in a window with a hard edge that stays.

    A spot is no Gaussian, so each has a bias of its own. Spots of a diffraction image are so nearly symmetric that it
    stays below what the noise of nine frames does to our centre; these images have no noise.
    """
    centroids = pytest.importorskip("photutils.centroids")
    images = setup.expected_frames(setup.path.expected_photons(STATES)).reshape(spots.shape)
    found = gaussian_fit(images, FRAMES, setup.calibration.noise, RADIUS, elliptical=True)
    variance = np.diagonal(found.temporal_covariance + found.fixed_covariance, axis1=1, axis2=2)
    difference = []
    for spot, row, column in zip(images, found.row, found.column, strict=True):
        x, y = centroids.centroid_2dg(spot, mask=distance(spot.shape, (row, column)) > RADIUS)
        difference.append((y - row, x - column))
    assert np.shape(difference) == (20, 2)
    assert np.all(np.abs(difference) < np.sqrt(variance)), np.abs(difference).max()
    assert 1e-4 < np.sqrt(variance).max() < 2e-3  # so that the comparison means something


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
    template = single_template(pair.calibration.template, 0, pair.calibration.template.shape)
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
