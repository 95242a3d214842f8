"""Pairs of images with known disparity, noise in both, and other ways to match them."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from analysis.matching.correlation import MatchOptions, resampled
from analysis.matching.matches import Matches, match_windows
from tests.analysis.texture_image import Texture, lattice

HALF = 15
SHIFT = np.array([0.37, -0.21])


@dataclass(frozen=True, eq=False)
class Pair:
    """Images (k, k); the second shows at `true` (n, 2) what the first shows at `places` (n, 2)."""

    first: np.ndarray
    second: np.ndarray
    places: np.ndarray
    true: np.ndarray

    def templates(self):
        """(n, 31, 31) of the first image."""
        offset = np.arange(-HALF, HALF + 1.0)
        rows, columns = self.places[:, 0, None, None] + offset[:, None], self.places[:, 1, None, None] + offset
        return resampled(self.first, *np.broadcast_arrays(rows, columns))

    def predicted(self):
        """Up to 2 px off."""
        return self.true + np.random.default_rng(9).uniform(-2.0, 2.0, self.true.shape)

    def matched(self, options: MatchOptions | None = None) -> Matches:
        return match_windows(self.second, self.templates(), self.predicted(), search_radius=4, options=options)


def textured(side, *, slope=1.0, noise=0.1, relief=0.0, length=12.0, radiometry="same", seed=0) -> Pair:
    """side^2 points, windows apart, in a random texture of contrast 1.

    noise: of both images; relief: rms of a random disparity along columns, px, of white noise under a Gaussian of rms
    length px; radiometry: same, gain (0.6, with the second image's noise) or vignetted (to a half in the corners).
    """
    size = 47 * (side - 1) + 57
    grid = np.arange(-24.0, size + 24.0, 0.5)
    wave = Texture(seed + 1, slope=slope).grid(grid, grid)
    surface = ndimage.spline_filter((wave - 800.0) / 120.0, 5)
    return _pair(
        lambda row, column: _at(surface, 2.0 * (row + 24.0), 2.0 * (column + 24.0)),
        size,
        lattice(side, 47, 28, seed + 3),
        noise,
        _relief(size, relief, length, seed),
        radiometry,
        seed,
    )


def layered(side, *, step=2.0, noise=0.05, seed=0) -> tuple[Pair, np.ndarray]:
    """Textures in two layers, the near one with winding edges before the far one and hiding what is behind it.

    step: px along columns by which the near layer is displaced against the far one.

    Returns:
        The pair, and (n,) which windows of 25 px hold an edge; what is hidden in the second image is among them.
    """
    size = 47 * (side - 1) + 57
    grid = np.arange(-24.0, size + 24.0, 0.5)
    far, near = (ndimage.spline_filter((Texture(seed + k).grid(grid, grid) - 800.0) / 120.0, 5) for k in (1, 2))
    wave = ndimage.gaussian_filter(np.random.default_rng(seed + 5).standard_normal((size + 60,) * 2), 25.0, mode="wrap")
    # zero on the edge; about the distance from it, px
    slope = np.hypot(*np.gradient(wave))
    front = ndimage.spline_filter(wave / np.median(slope[np.abs(wave) < 0.3 * wave.std()]), 5)

    def shown(row, column, by):
        # the edge is as soft as a camera's: a pixel wide
        share = 1.0 / (1.0 + np.exp(-4.0 * _at(front, row + 30.0, column + by + 30.0)))
        front_grey = _at(near, 2.0 * (row + 24.0), 2.0 * (column + by + 24.0))
        return share * front_grey + (1.0 - share) * (1.0 + _at(far, 2.0 * (row + 24.0), 2.0 * (column + 24.0)))

    row, column = np.mgrid[:size, :size].astype(float)
    rng = np.random.default_rng(seed + 11)
    first = shown(row, column, 0.0) + noise * rng.standard_normal(row.shape)
    second = shown(row + SHIFT[0], column + SHIFT[1], step) + noise * rng.standard_normal(row.shape)
    places = lattice(side, 47, 28, seed + 3)
    is_near = _at(front, *(places.T + 30.0)) > 0
    inside = (_at(front, row + 30.0, column + 30.0) > 0).astype(float)
    edge = ndimage.maximum_filter(inside, 25) > ndimage.minimum_filter(inside, 25)
    true = places - SHIFT - step * is_near[:, None] * [0.0, 1.0]
    return Pair(first, second, places, true), edge[tuple(np.rint(places).astype(int).T)]


def _at(surface, row, column):
    return ndimage.map_coordinates(surface, [row, column], order=5, prefilter=False, mode="nearest")


def _relief(size, rms, length, seed):
    if not rms:
        return lambda row, column: np.zeros(np.broadcast(row, column).shape)
    wave = ndimage.gaussian_filter(
        np.random.default_rng(seed + 7).standard_normal((size + 60,) * 2), length, mode="wrap"
    )
    surface = ndimage.spline_filter(rms / wave.std() * wave, 5)
    return lambda row, column: _at(surface, row + 30.0, column + 30.0)


def _pair(shown, size, places, noise, disparity, radiometry, seed) -> Pair:
    row, column = np.mgrid[:size, :size].astype(float)
    first = shown(row, column)
    second = shown(row + SHIFT[0], column + SHIFT[1] + disparity(row, column))
    gain = 0.6 if radiometry == "gain" else 1.0
    if radiometry == "vignetted":
        second = (second + 4.0) * (1.0 - 0.25 * ((row - size / 2) ** 2 + (column - size / 2) ** 2) / (size / 2) ** 2)
    rng = np.random.default_rng(seed + 11)
    first = first + noise * rng.standard_normal(first.shape)
    second = gain * (second + noise * rng.standard_normal(second.shape)) + 3.0
    true = places - SHIFT
    # contracts where the disparity's slope is below 1
    for _ in range(100):
        there = np.stack([places[:, 0] - SHIFT[0], places[:, 1] - SHIFT[1] - disparity(*true.T)], axis=1)
        true = 0.5 * (true + there)
    return Pair(first, second, places, true)
