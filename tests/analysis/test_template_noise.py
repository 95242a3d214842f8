"""Noise of the template in the curvature of a fit, and in the covariance of places on edges."""

import numpy as np
import pytest
from scipy import ndimage, stats

from analysis.matching.correlation import SplineStack, low_passed
from analysis.matching.least_squares import FitState, noise_energy, template_noise
from tests.analysis.stereo_pairs import Pair

pytestmark = pytest.mark.second

HALF, REACH = 15, 12
SHIFT = np.array([0.37, -0.21])
ROW, COLUMN = (grid.ravel().astype(float) for grid in np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1])


def modelled(stack, unknowns):
    """Model (p,) of one window by (row, column, affine matrix, offset, gain, sharpnesses)."""
    place, matrix, linear = unknowns[:2], unknowns[2:6].reshape(2, 2), unknowns[6:]
    u = matrix @ np.stack([ROW - place[0], COLUMN - place[1]]) + HALF
    value = stack(u[:1], u[1:], np.array([0]), order=2)[:, 0]
    return linear[0] + linear[1] * value[0] + linear[2] * value[3] + linear[3] * value[5]


def differences(function, at, step):
    """Central differences of a function (k,) -> (m,), (k, m)."""
    moves = np.diag(step)
    return np.array([(function(at + move) - function(at - move)) / (2.0 * move.max()) for move in moves])


def test_the_curvature_is_that_of_the_square_sum():
    """At a least squares solution in noise, against second differences of half the square sum."""
    rng = np.random.default_rng(1)
    template = ndimage.gaussian_filter(rng.standard_normal((2 * HALF + 1,) * 2), 1.5)[None]
    stack = SplineStack(low_passed(template, 0.7))
    at = np.array([0.2, -0.3, 1.02, -0.01, 0.015, 0.99, 4.0, 1.1, 0.1, -0.2])
    design = differences(lambda x: modelled(stack, x), at, np.full(10, 1e-5))
    noise = 0.1 * rng.standard_normal(ROW.size)
    residual = noise - design.T @ np.linalg.solve(design @ design.T, design @ noise)
    grey = modelled(stack, at) + residual

    def slopes(x):
        return -differences(lambda y: modelled(stack, y), x, np.full(10, 1e-5)) @ (grey - modelled(stack, x))

    # the spline's fourth derivative is piecewise linear, so that a step of the place of 1e-4 sees it to 1e-3
    curvature = differences(slopes, at, np.array([1e-4] * 2 + [1e-5] * 4 + [1e-4] * 4))
    affine, linear = at[None, 2:6].reshape(1, 2, 2), at[None, 6:]
    state = FitState(stack, (ROW, COLUMN), grey[None], at[None, :2], affine, linear, design[None], residual[None])
    found = template_noise(state, np.array([0]), np.array([0.7]), (np.zeros(1), np.zeros(1)))
    scale = np.sqrt(np.diag(design @ design.T))
    wanted = np.linalg.inv(0.5 * (curvature + curvature.T)) * np.outer(scale, scale)
    plain = np.linalg.inv(design @ design.T) * np.outer(scale, scale)
    assert found.inverse[0] * np.outer(scale, scale) == pytest.approx(wanted, abs=2e-3 * np.abs(wanted).max())
    assert np.abs(wanted - plain).max() > 0.02 * np.abs(plain).max()
    assert found.share[0] == 0.0
    assert not found.covariance(np.ones(1, bool)).any()


@pytest.mark.parametrize(("smoothing", "factors"), [(0.0, [1.0]), (0.7, [1.0, -0.3, -0.2]), (1.1, [0.8, 0.5, -0.9])])
def test_energy_of_white_noise(smoothing, factors):
    """Against noise that is smoothed and interpolated: 400 templates of 19^2 places, all phases; five sigmas."""
    rng = np.random.default_rng(2)
    count = 400
    stack = SplineStack(low_passed(rng.standard_normal((count, 31, 31)), smoothing))
    place = 6.0 + 18.0 * rng.random((2, count, 361))
    value = stack(*place, np.arange(count), order=2)[[0, 3, 5]][: len(factors)]
    # as the image has it: over the gain
    seen = np.mean(np.tensordot(factors, value, 1) ** 2, axis=1) / factors[0] ** 2
    sigma = seen.std() / np.sqrt(count)
    assert noise_energy(np.array([factors]), smoothing)[0] == pytest.approx(seen.mean(), abs=5.0 * sigma)


def edges(count, *, noise, faint, seed):
    """Windows of a straight edge each, in any direction, with a texture of rms faint; the edge is 200 high."""
    rng = np.random.default_rng(seed)
    side, places, images = 61, [], [[], []]
    row, column = np.mgrid[:side, :side] - 30.0
    for _ in range(count):
        angle = rng.uniform(0.0, np.pi)
        wave = ndimage.gaussian_filter(rng.standard_normal((2 * side,) * 2), 4.0)
        wave *= faint * 4.0 * np.sqrt(4.0 * np.pi)
        surface = ndimage.spline_filter(wave, 5)
        for image, shift in zip(images, (np.zeros(2), SHIFT), strict=True):
            r, c = row - shift[0], column - shift[1]
            texture = ndimage.map_coordinates(surface, [2 * (r + 30.25), 2 * (c + 30.25)], order=5, prefilter=False)
            edge = 100.0 * np.tanh((r * np.cos(angle) + c * np.sin(angle)) / 1.5)
            image.append(edge + texture + noise * rng.standard_normal(r.shape))
        places.append([30.0, side * len(places) + 30.0])
    places = np.array(places)
    return Pair(np.hstack(images[0]), np.hstack(images[1]), places, places + SHIFT)


def test_places_on_edges_keep_in_their_covariances():
    """Edges whose faint texture tells the place along them: half of chi-square is 1 within the limits of so many
    windows (one false alarm in 1000), and the long axis lies along the edge. Without texture, however strong the edge,
    the noise's own slopes do not count: what passes stands by chance where both noises are alike, 11 of 800."""
    pair = edges(150, noise=2.0, faint=6.0, seed=4)
    found = pair.matched()
    used = found.accepted
    error = (found.position - pair.true)[used]
    assert used.sum() > 5
    square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance[used]), error)
    assert square.sum() < stats.chi2.isf(1e-3, 2 * int(used.sum()))
    # standard deviations along and across the edge
    assert np.sqrt(np.linalg.cond(found.covariance[used])).min() > 3.0
    bare = edges(150, noise=2.0, faint=0.0, seed=4).matched()
    assert bare.accepted.sum() <= stats.binom.isf(1e-3, 150, 11 / 800)
