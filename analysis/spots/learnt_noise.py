"""Noise of a shift that is measured with a shape learnt from the frames before.

The shape is T = L F, with the mean image before F and the linear operations L of learning it. To first order the places
before and after, of influence g1 and g2 on their images F and D, move with noise n of F and m of D by

    e1 = g1 (n - A1 n),     e2 = g2 (m - A2 n),     A = (fitted model of the state) by T, times L,

for the model that is held against an image has noise itself: A is the smeared, interpolated, brightened shape, wherever
the state has one. So the image before has the influence b = g1 - g1 A1 + g2 A2 on the shift, with the sign of a place
before, and the shift's covariance is that of two independent images with the maps b and g2. Where both states are alike
b = g1. Where after is brighter or the middle of its spot is left out the noise of the shape counts for more than that
of the image that it is held against.

The next order counts where a spot is narrow or faint, since learning leaves noise that is as fine as the spot is:

- **Curvature.** The noise's own slopes stand in the normal matrix I as if they were the spot's, with N = sum of
  w cov(n', n'), and the residuals take them off again: the fit has the curvature I - N, and answers by I / (I - N).
- **Lean.** The noise of the shape is least half way between pixels, and pattern of the pixels is in both images: the
  fit is drawn there, by (I - N)^-1 sum of w (cov(n', m) - cov(n', n)). The place is not moved by it; the covariance of
  the shift gets the square of it.

Pixel coordinates: (row, column), the centre of the first pixel is (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from analysis.spots.learnt_template import MARGIN_PX, LearntTemplate
from analysis.spots.noise import NoiseModel
from analysis.spots.spot_positions import NoiseParts, SpotError, SpotPositions, noise_parts
from analysis.spots.spot_template import SmearedShape, SpotTemplate

__all__ = ["FittedSpot", "LearntShift", "learnt_shift"]

Array = NDArray[np.float64]
_LEAST = 0.4
"""Least share of the normal matrix that is no noise, in any direction: below it the theory, which is of first order in
that, ends."""


@dataclass(frozen=True, eq=False)
class FittedSpot:
    """One spot in one state, to which the learnt shape was fitted.

    Attributes:
        positions: of the spot in its image, with their maps.
        counts: (H, W) frames that each pixel is the mean of.
        jitter: (2, 2) px^2, what movement between frames adds to the covariance of the place.
        others: (G, 3) row, column (px) and share of the light of what else was fitted with the same shape.
        smear: (2, 2) px^2 by which the shape was smeared.
        offset: row and column of the detector at which the image begins.
    """

    positions: SpotPositions
    counts: Array
    jitter: Array
    others: Array
    smear: Array
    offset: tuple[int, int] = (0, 0)

    @property
    def maps(self) -> Array:
        """(2, H, W) px/DN."""
        assert self.positions.gain_maps is not None
        return self.positions.gain_maps[0]

    @property
    def light(self) -> Array:
        """(H, W) DN."""
        assert self.positions.light_dn is not None
        return self.positions.light_dn[0]

    def temporal(self, noise: NoiseModel) -> Array:
        """(H, W) DN^2, variance of the mean by what is new in every frame."""
        return np.asarray(noise.temporal_variance_dn2(self.light + noise.dark_level_dn, 1) / self.counts)

    def fixed(self, noise: NoiseModel) -> Array:
        """(H, W) DN^2, variance by the detector's pattern."""
        return np.asarray(noise.fixed_variance_dn2(self.light + noise.dark_level_dn))


@dataclass(frozen=True, eq=False)
class LearntShift:
    """What noise does to after - before.

    Attributes:
        covariance: (2, 2) px^2.
        lean: (2,) px, by which the fit is drawn, and which stands in the covariance.
        parts: of images before and after, for the covariance of several shifts against the same image before. What this
            one does differs from shift to shift, and stands in those after.
    """

    covariance: Array
    lean: Array
    parts: tuple[NoiseParts, NoiseParts]


def learnt_shift(
    learnt: LearntTemplate, before: FittedSpot, after: FittedSpot, noise: NoiseModel, ccd: tuple[int, int]
) -> LearntShift:
    """Noise of one spot's shift.

    Args:
        learnt: the shape.
        before: the spot in the image that it was learnt from.
        after: the same spot in another one.
        noise: of the detector.
        ccd: (H, W) of the detector.

    Raises:
        SpotError: the shape is mostly noise.
    """
    more, lean = _second_order(learnt, before, after, noise)
    own = np.tensordot(more, after.maps, 1)
    maps = before.maps - _by_image(learnt, before, before.maps) + _by_image(learnt, after, own)
    temporal = before.temporal(noise)
    new = after.jitter + _spread(own, after.temporal(noise)) + before.jitter
    brought = maps * np.sqrt(temporal)
    first = _on_ccd(before, maps, ccd)
    second = _on_ccd(after, own, ccd)
    pattern = noise_parts(second, noise).pattern - noise_parts(first, noise).pattern
    whole = np.concatenate([pattern[0], brought.reshape(2, -1), lean[:, None]], axis=1)
    parts = (
        NoiseParts(before.jitter[None], np.zeros((1, *whole.shape), np.float32)),
        NoiseParts((new - before.jitter)[None], whole.astype(np.float32)[None]),
    )
    fixed = pattern[0].astype(np.float64)
    covariance = new + _spread(maps, temporal) + fixed @ fixed.T + np.outer(lean, lean)
    return LearntShift(covariance, lean, parts)


def _spread(maps: Array, variance: Array) -> Array:
    flat = maps.reshape(2, -1)
    return np.asarray((flat * variance.ravel()) @ flat.T)


def _shape_of(learnt: LearntTemplate, spot: FittedSpot) -> SpotTemplate:
    height, width = spot.light.shape
    return replace(learnt.shape, shape=(height, width))


def _by_image(learnt: LearntTemplate, spot: FittedSpot, maps: Array) -> Array:
    """(2, H, W) what the pixels of the image before do to the fitted model of a state, and that to numbers of which the
    derivatives by the state's image are ``maps``.
    """
    shape = SmearedShape(_shape_of(learnt, spot))
    place, flux = spot.positions.position[0], float(spot.positions.flux[0])
    lights = np.vstack([[*place, 1.0], spot.others])
    back = sum(share * shape.returned(maps, row, column, spot.smear) for row, column, share in lights)
    return learnt.returned(np.asarray(back) * (flux / learnt.light))


def _second_order(
    learnt: LearntTemplate, before: FittedSpot, after: FittedSpot, noise: NoiseModel
) -> tuple[Array, Array]:
    """What the answer of the fit is more than the normal matrix says, (2, 2), and lean (2,) px."""
    ratio = float(after.positions.flux[0]) / learnt.light
    # of a pixel at the spot
    at = np.rint(before.positions.position[0]).astype(np.intp)
    middle = int(at[0]), int(at[1])
    kernel = _kernel(learnt, before, after, middle)
    weight = _weight(after, noise)
    brought = before.temporal(noise) + before.fixed(noise)
    # sum over pixels of the model and of the image: of each difference of place how much there is
    size = weight.shape
    meets = signal.fftconvolve(weight, brought[::-1, ::-1], mode="full")
    rows, columns = (slice(n - 1 - m, n - 1 - m + k) for n, m, k in zip(brought.shape, middle, size, strict=True))
    meets = np.maximum(meets[rows, columns], 0.0)
    own = ratio**2 * np.einsum("ipq,pq,pq->i", kernel[1:], kernel[0], meets)
    slopes = ratio**2 * np.einsum("ipq,jpq,pq->ij", kernel[1:], kernel[1:], meets)
    shared = ratio * _shared(kernel[1:], weight, before, after, noise, middle)
    information = np.linalg.inv(after.positions.covariance[0] - after.jitter)
    left = information - slopes
    root = np.linalg.inv(np.linalg.cholesky(information))
    if np.linalg.eigvalsh(root @ left @ root.T).min() < _LEAST:
        raise SpotError({0: "the shape that the frames before show is mostly noise"})
    return np.linalg.solve(left, information), np.linalg.solve(left, shared - own)


def _weight(spot: FittedSpot, noise: NoiseModel) -> Array:
    """(H, W) 1/DN^2; 0 where a pixel was left out."""
    used = np.any(spot.maps != 0.0, axis=0)
    return np.asarray(np.where(used, 1.0 / (spot.temporal(noise) + spot.fixed(noise)), 0.0))


def _kernel(learnt: LearntTemplate, before: FittedSpot, after: FittedSpot, pixel: tuple[int, int]) -> Array:
    """(3, H, W) what a pixel of the image before does to the state's model for equal light, and the derivatives of that
    by the place.
    """
    wide = np.pad(learnt.impulse(pixel), MARGIN_PX)
    height, width = after.light.shape
    shape = SpotTemplate.from_image(wide, pixel[0] + MARGIN_PX, pixel[1] + MARGIN_PX, (height, width), tolerance=1e-6)
    smeared = SmearedShape(shape)
    row, column = pixel + after.positions.position[0] - before.positions.position[0]
    return np.asarray(smeared.evaluate(smeared.smeared(after.smear), row, column)[:3] * wide.sum())


def _shared(
    slopes: Array, weight: Array, before: FittedSpot, after: FittedSpot, noise: NoiseModel, middle: tuple[int, int]
) -> Array:
    """(2,) sum of weight and covariance of the model's slopes with the image, by the pattern of the pixels in both."""
    # a pixel of the detector stands here in both images
    rows, columns = (slice(max(a, b), None) for a, b in zip(before.offset, after.offset, strict=True))
    one = before.light[rows.start - before.offset[0] :, columns.start - before.offset[1] :]
    two = after.light[rows.start - after.offset[0] :, columns.start - after.offset[1] :]
    own = weight[rows.start - after.offset[0] :, columns.start - after.offset[1] :]
    height, width = (min(sizes) for sizes in zip(one.shape, two.shape, strict=True))
    pattern = noise.prnu**2 * one[:height, :width] * two[:height, :width] + noise.dsnu_variance_dn2
    at = tuple(m + b - a for m, b, a in zip(middle, before.offset, after.offset, strict=True))
    if not all(0 <= k < n for k, n in zip(at, weight.shape, strict=True)):
        return np.zeros(2)
    return np.asarray(slopes[:, at[0], at[1]] * float((own[:height, :width] * pattern).sum()))


def _on_ccd(spot: FittedSpot, maps: Array, ccd: tuple[int, int]) -> SpotPositions:
    """Positions of which maps and light are those of the whole detector."""
    gain, light = np.zeros((1, 2, *ccd)), np.zeros((1, *ccd))
    rows, columns = (slice(a, a + n) for a, n in zip(spot.offset, spot.light.shape, strict=True))
    gain[0, :, rows, columns], light[0, rows, columns] = maps, spot.light
    return replace(spot.positions, gain_maps=gain, light_dn=light)
