"""Spot centroids from mean frames: energy centroid, Gaussian fit and fit of the calibrated shape.

All functions take `mean`, B images of H rows and W columns, (B, H, W), each the mean grey values of `frames` frames,
and the detector's NoiseModel, and return SpotPositions with the covariance split into temporal and fixed-pattern parts.
They work on all spots of a batch at once. The energy centroid is the one of paper 001 (Wang et al. 2018, Fig. 4; its
equation is not printed: the first moment over the energy). Weights always come from the model and never from the noisy
data, which would bias the flux (Humphrey, Liu, Buote, Astrophys. J. 693, 822 (2009)). Pixel coordinates: (row, column),
the centre of the first pixel is (0, 0).

All three raise SpotError, naming the spots, when a spot is saturated, absent or too near the image's edge, and
ValueError for input of the wrong shape.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array
from analysis.spots import spot_image
from analysis.spots.noise import NoiseModel
from analysis.spots.spot_image import SpotPositions

# Greatest distance of the fitted centre from the first guess, px.
_GAUSS_MOVE_PX = 4


def mean_frames(frames: NDArray[np.integer[Any]]) -> Array:
    """Return the mean over the frame axis as float64: grey values (..., N, H, W) become (..., H, W).

    The sum is exact, in integers.

    Dimensions: N frames, H rows, W columns.
    """
    if frames.ndim < 3 or frames.shape[-3] < 1 or not np.issubdtype(frames.dtype, np.integer):
        raise ValueError(f"mean frames: need integers (..., frames, H, W), found {frames.dtype} {frames.shape}")
    small = np.iinfo(frames.dtype).max <= 0xFFFF and frames.shape[-3] <= 0x10000
    total = np.add.reduce(frames, axis=-3, dtype=np.uint32 if small else np.int64)
    return np.asarray(total / frames.shape[-3], dtype=np.float64)


def energy_centroid(
    mean: ArrayLike,
    frames: int,
    noise: NoiseModel,
    radius_px: float | None = None,
    border_px: int | None = None,
    keep_maps: bool = True,
) -> SpotPositions:
    """Return the centroids of spots: the first moment of their light in a circular window that follows the centre.

    The window is re-centred until convergence. The method is that of paper 001 (Wang et al. 2018), Fig. 4. The window
    must stay inside the image.

    Dimensions: B spots, H rows, W columns.

    Parameters
    ----------
    mean : (B, H, W) array_like
        Mean frames, DN (grey values).
    frames : int
        Number of frames averaged into each image.
    noise : NoiseModel
        Noise of the detector.
    radius_px : float or None
        Radius of the window in pixels; default a quarter of the image's smaller side. The window's edge is one pixel
        soft, so that the result is a smooth function of the image.
    border_px : int or None
        Width in pixels of the border of the image whose mean is the background; default 4, in images of less than 24 px
        a quarter of a side.
    keep_maps : bool
        True to keep the derivatives of the position with respect to every pixel, for covariances of differences.
    """
    image = spot_image.as_images(mean)
    count, height, width = image.shape
    radius = min(height, width) / 4.0 if radius_px is None else float(radius_px)
    if border_px is None:
        border_px = 4 if min(height, width) >= spot_image.SMALL else min(height, width) // 4
    if not 1 <= radius < min(height, width) / 2 or not 1 <= border_px < min(height, width) // 2:
        raise ValueError(
            f"energy centroid: radius_px {radius} or border_px {border_px} does not fit {height} x {width} px"
        )

    def measure(part: slice) -> SpotPositions:
        return _energy(image[part], frames, noise, radius, border_px, keep_maps)

    return spot_image.in_pieces(measure, count)


def _energy(
    image: Array, frames: int, noise: NoiseModel, radius: float, border_px: int, keep_maps: bool
) -> SpotPositions:
    """Return the energy centroids (first moments of the light) of the images of one section of a batch."""
    count, height, width = image.shape
    row, column, _, _, _ = spot_image.coarse(image, frames, noise)
    border = np.ones((height, width), dtype=bool)
    border[border_px:-border_px, border_px:-border_px] = False
    background = image[:, border].mean(axis=1)
    signal = image - background[:, None, None]
    position = np.stack([row, column], axis=1)
    converged = np.zeros(count, dtype=bool)
    iteration = 0
    while iteration < 100 and not np.all(converged):
        iteration += 1
        mask, _ = spot_image.soft_window(position, height, width, radius)
        energy = mask * signal
        flux = energy.sum(axis=(1, 2))
        moments = [energy.sum(axis=2) @ np.arange(height), energy.sum(axis=1) @ np.arange(width)]
        with np.errstate(invalid="ignore", divide="ignore"):
            new = np.stack(moments, axis=1) / flux[:, None]
        spot_image.reject(
            ~np.all(np.isfinite(new), axis=1) | (flux <= 0), "no energy above the background in the window"
        )
        converged = np.max(np.abs(new - position), axis=1) < 1e-7
        position = new
        spot_image.check_edge(position, height, width, radius)
    mask, slope = spot_image.soft_window(position, height, width, radius)
    arm = spot_image.arms(position, height, width)
    flux = (mask * signal).sum(axis=(1, 2))[:, None, None]
    # The window moves with the centre: c = C(image, c), so dc = (1 - dC/dc)^-1 dC/d(image).
    follow = np.einsum("bihw,bjhw->bij", arm * signal[:, None], slope) / flux
    direct = mask[:, None] * arm
    direct -= border * (direct.sum(axis=(2, 3), keepdims=True) / border.sum())
    direct /= flux[:, :, :, None]
    maps = np.linalg.solve(np.eye(2) - follow, direct.reshape(count, 2, -1)).reshape(direct.shape)
    fit = {"flux": flux[:, 0, 0], "background": background, "converged": converged, "iterations": iteration}
    chi = np.full(count, np.nan)
    return spot_image.positions(position, maps, image, frames, noise, keep_maps, **fit, reduced_chi_square=chi)


def gaussian_fit(
    mean: ArrayLike, frames: int, noise: NoiseModel, radius_px: float | None = None, elliptical: bool = False
) -> SpotPositions:
    """Fit a Gaussian on a background to each spot by weighted least squares in a window that follows the centre.

    The model is background + amplitude exp(-q/2). With the distances dr and dc from the centre along rows and columns,
    px, q is a (dr^2 + dc^2), or a dr^2 + 2 b dr dc + c dc^2 when elliptical. A diffraction spot is not a Gaussian, so
    the covariance is the sandwich of the estimating equation with its full derivative (White, Econometrica 50, 1
    (1982)), not the inverse of the normal matrix.

    Dimensions: B spots, H rows, W columns.

    Parameters
    ----------
    mean : (B, H, W) array_like
        Mean frames, DN (grey values).
    frames : int
        Number of frames averaged into each image.
    noise : NoiseModel
        Noise of the detector.
    radius_px : float or None
        Radius of the window in pixels; default an eighth of the image's smaller side, at least 2. About the radius of
        the first dark ring is best.
    elliptical : bool
        Fit a, b and c instead of a alone.
    """
    image = spot_image.as_images(mean)
    count, height, width = image.shape
    radius = max(min(height, width) / 8.0, 2.0) if radius_px is None else float(radius_px)
    if not 2 <= radius < min(height, width) / 2:
        raise ValueError(f"gaussian fit: radius_px {radius} does not fit {height} x {width} px")

    def measure(part: slice) -> SpotPositions:
        return _gauss(image[part], frames, noise, radius, elliptical)

    return spot_image.in_pieces(measure, count)


def _wandered(theta: Array, row: Array, column: Array) -> NDArray[np.bool_]:
    return np.maximum(np.abs(theta[:, 0] - row), np.abs(theta[:, 1] - column)) > _GAUSS_MOVE_PX


def _gauss(image: Array, frames: int, noise: NoiseModel, radius: float, elliptical: bool) -> SpotPositions:
    """Fit a Gaussian to each image of one section of a batch, on the part of the image that its window can cover."""
    count, full_height, full_width = image.shape
    row, column, background, peak, area = spot_image.coarse(image, frames, noise)
    spot_image.check_edge(np.stack([row, column], axis=1), full_height, full_width, radius)
    half_width = int(np.ceil(radius)) + _GAUSS_MOVE_PX + 2
    full = np.array([full_height, full_width])
    height, width = np.minimum(2 * half_width + 1, full).tolist()
    corner = np.stack([row, column], axis=1).round().astype(np.intp) - half_width
    corner = np.clip(corner, 0, full - [height, width])
    rows = (corner[:, :1] + np.arange(height))[:, :, None]
    columns = (corner[:, 1:] + np.arange(width))[:, None, :]
    full_image, spot = image, np.arange(count)[:, None, None]
    image = full_image[spot, rows, columns]
    row, column = row - corner[:, 0], column - corner[:, 1]
    width_term = 2 * np.log(2) * np.pi / area  # from the area above half maximum
    shape_terms = [width_term, np.zeros(count), width_term] if elliptical else [width_term]
    theta = np.stack([row, column, peak, background, *shape_terms], axis=1)
    flat = image.reshape(count, -1)
    converged = np.zeros(count, dtype=bool)
    iteration = 0
    while iteration < 200 and not np.all(converged):
        iteration += 1
        spot_image.reject(
            ~spot_image.sane(theta), "Gaussian fit diverged; the spot does not look like a Gaussian in the window"
        )
        spot_image.reject(_wandered(theta, row, column), "the Gaussian fit wandered away from the brightest spot")
        design, weighted, model = spot_image.gaussian(theta, height, width, radius, noise, frames)
        step = np.linalg.solve(weighted @ design.transpose(0, 2, 1), weighted @ (flat - model)[:, :, None])[:, :, 0]
        limit = np.full_like(theta, np.inf)
        limit[:, :2], limit[:, 2], limit[:, 4:] = 1.0, 0.5 * theta[:, 2], 0.3 * theta[:, 4:5]
        step *= np.minimum(1.0, np.min(limit / np.maximum(np.abs(step), 1e-300), axis=1))[:, None]
        theta = theta + step
        converged = np.max(np.abs(step[:, :2]), axis=1) < 1e-7
    spot_image.reject(
        ~spot_image.sane(theta), "Gaussian fit diverged; the spot does not look like a Gaussian in the window"
    )
    design, weighted, model = spot_image.gaussian(theta, height, width, radius, noise, frames)
    size = theta.shape[1]
    slope = np.empty((count, size, size))
    scale = np.maximum(np.abs(theta), [1.0, 1.0, 1.0, 1.0, *[width_term.mean()] * (size - 4)]) * 1e-5
    scale[:, :2] = 1e-4
    for k in range(size):
        ends = []
        for sign in (1, -1):
            moved = theta.copy()
            moved[:, k] += sign * scale[:, k]
            _, w, m = spot_image.gaussian(moved, height, width, radius, noise, frames)
            ends.append((w @ (flat - m)[:, :, None])[:, :, 0])
        slope[:, :, k] = (ends[1] - ends[0]) / (2 * scale[:, k, None])
    maps = np.linalg.solve(slope, weighted)[:, :2].reshape(count, 2, height, width)
    weight = weighted[:, 3]  # the background's derivative is 1, so its weighted row is the weight
    # A pixel in the window's soft edge counts as the part of it that is inside; so do the parameters fitted to it.
    inside = spot_image.soft_window(theta[:, :2], height, width, radius)[0].reshape(count, 1, -1)
    across = design.transpose(0, 2, 1)
    fitted = np.linalg.solve(weighted @ across, (weighted * inside) @ across)
    freedom = inside.sum(axis=(1, 2)) - np.trace(fitted, axis1=1, axis2=2)
    chi = ((flat - model) ** 2 * weight).sum(axis=1) / freedom
    determinant = theta[:, 4] * theta[:, 6] - theta[:, 5] ** 2 if elliptical else theta[:, 4] ** 2
    flux = 2 * np.pi * theta[:, 2] / np.sqrt(determinant)
    full_maps = np.zeros((count, 2, full_height, full_width))
    full_maps[spot[..., None], np.arange(2), rows[..., None], columns[..., None]] = maps.transpose(0, 2, 3, 1)
    position = np.asarray(theta[:, :2] + corner, dtype=np.float64)
    spot_image.check_edge(position, full_height, full_width, radius)
    fit = {"flux": flux, "background": theta[:, 3], "converged": converged, "iterations": iteration}
    return spot_image.positions(position, full_maps, full_image, frames, noise, True, **fit, reduced_chi_square=chi)
