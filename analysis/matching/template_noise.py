"""What noise of the template does to a fitted place: errors in variables, by the curvature that the fit really has.

The fit stops where F = D r = 0, with design D (unknowns by pixel) and residuals r of the model m. A place that noise
has moved by e answers to F with the curvature of the sum of squares,

    H = D D' - sum over pixels of r d2m,

and not with D D' alone. Without noise in the template residuals know nothing of d2m, and the two are the same. With it
they do: the noise's own slopes stand in D D' as if they were texture, and r, which holds the noise with the opposite
sign, takes them off. So the covariance is H^-1 (D C D') H^-1, with C of the residuals: the sandwich of M-estimators
(Huber, Proc. 5th Berkeley Symposium 1, 1967). It differs from the usual one where slopes are few: **along a straight
edge** there are none but the noise's. An isotropic low pass cannot take them away, since the edge is sharp across, and
a normal matrix that counts them claims a place that is not known. Where most of what the normal matrix knows of some
combination of unknowns is noise, the theory ends, which is of first order, and so does the covariance: it is NaN.

**Lean.** Noise of the template has least energy under strong smoothing, a small gain and half way between pixels, so
the fit leans there, and where unknowns are hard to tell apart the place leans with them:

    lean = H^-1 E F = -H^-1 s_t^2 / 2 d/d(unknowns) [noise energy of the low-passed, sharpened, interpolated template].

The template's noise against the residuals, s_t^2 / s^2 (both in the image), is one for all points. Each tells at least
how large it is: by how much the low pass that was chosen lowers the residuals against none, over what it takes of white
noise. Nine in ten are below what is taken. It is too low where all windows are so sharp that no low pass serves, but
there slopes are many and the lean is nothing. The place is not moved by it; its covariance gets lean lean'.

**Lock.** Where structure runs along one direction, the texture along it may be so weak that the noise's energy is most
of what holds the place: the fit then stands half way between pixels, where the lean is nothing. So the covariance also
gets what that energy's steepest slope does to the place against the curvature that is left without the energy's own,
2 pi^2 N s_t^2 times its mean and its wave. Template and image are taken to be as noisy as one another at least. It is
nothing beside texture of two directions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array
from analysis.matching.spline import SplineStack, low_passed

# Least curvature over the normal matrix, of any combination of unknowns: more than three fifths noise is not known.
_LEAST = 0.4
# Below it a combination of unknowns is open, relative to the best known.
_OPEN = 1e-11
# Of the points' shares.
_QUANTILE = 0.9
# Share of the curvature from which the noise's energy counts as what holds a place.
_HELD = 0.3
# Share of the best known direction's curvature below which structure runs along one direction: sharp across it, it
# keeps a low pass from being chosen, which otherwise leaves little of the noise's energy.
_ONE_WAY = 0.1
# Least share for that: template and image have the same noise, of which interpolation passes two thirds.
_EQUAL = 0.6
# Half width of the impulse's answer and phases of a pixel at which it is taken.
_REACH, _PHASES = 30, 64


@dataclass(frozen=True, eq=False)
class TemplateNoise:
    """Noise of the templates in n fits with q unknowns; NaN where there is no fit, or where it is mostly noise.

    Attributes:
        inverse: (n, q, q) H^-1.
        lean: (n, 2) px, row and column, for a share of 1.
        energy: (n,) curvature of the noise's energy along an axis where it is largest, for a share of 1.
        share: (n,) least s_t^2 / s^2 by the low pass.
    """

    inverse: Array
    lean: Array
    energy: Array
    share: Array

    def covariance(self, good: NDArray[np.bool_]) -> Array:
        """(n, 2, 2) px^2 of lean and lock, with the share that points good (n,) show."""
        shown = self.share[good & np.isfinite(self.share)]
        if not len(shown):
            return np.zeros_like(self.inverse[:, :2, :2])
        share = float(np.quantile(shown, _QUANTILE))
        lean, lock = share * self.lean, self._lock(max(share, _EQUAL))
        return np.asarray(lean[:, :, None] * lean[:, None] + lock @ np.swapaxes(lock, 1, 2))

    def _lock(self, share: float) -> Array:
        """(n, 2, 2) px, by which the noise's energy may displace row and column along each axis."""
        own = share * self.energy[:, None, None] * np.eye(2)
        known = np.isfinite(self.inverse[:, :2, :2]).all(axis=(1, 2)) & np.isfinite(self.energy)
        out = np.full_like(self.inverse[:, :2, :2], np.nan)
        # without the curvature of the noise's energy, which holds a place that is locked
        left = np.linalg.inv(self.inverse[known, :2, :2])
        least, most = np.linalg.eigvalsh(left).T
        left = left - own[known]
        left[least <= own[known, 0, 0]] = np.nan
        lock = np.linalg.inv(left) @ own[known] / (2.0 * np.pi)
        free = (own[known, 0, 0] < _HELD * least) | (least > _ONE_WAY * most)
        out[known] = np.where(free[:, None, None], 0.0, lock)
        return out


def template_noise(
    stack: SplineStack,
    which: NDArray[np.intp],
    window: tuple[Array, Array],
    shift: Array,
    affine: Array,
    linear: Array,
    smoothing: Array,
    design: Array,
    residual: Array,
    lowered: tuple[Array, Array],
) -> TemplateNoise:
    """From converged fits.

    Args:
        stack: low-passed templates.
        which: (n,) of them.
        window: rows and columns (p,) of the pixels, px about the window's middle.
        shift: (n, 2) fitted place against the window's middle.
        affine: (n, 2, 2).
        linear: (n, 2 or 4) offset, gain and perhaps sharpness along rows and columns.
        smoothing: (n,) rms of the low pass, px.
        design: (n, q, p): by place, perhaps by the affine matrix, by the linear unknowns.
        residual: (n, p), DN; NaN where there is no fit.
        lowered: (n,) and (n,), by how much the low pass lowers the square sum of residuals and the energy of white
            noise of unit variance in a pixel, against none.
    """
    count, unknowns, pixels = design.shape
    inverse, lean = np.full((count, unknowns, unknowns), np.nan), np.full((count, 2), np.nan)
    curvature = np.full(count, np.nan)
    share = np.full(count, np.nan)
    used = np.flatnonzero(np.isfinite(residual).all(axis=1) & np.all((design**2).sum(axis=2) > 0, axis=1))
    if not used.size:
        return TemplateNoise(inverse, lean, curvature, share)
    apart = np.stack([window[0] - shift[used, :1], window[1] - shift[used, 1:]], axis=1)
    place = affine[used] @ apart + stack.size // 2
    # by the unknowns of the geometry: place and perhaps matrix
    moved = np.zeros((used.size, 2, unknowns - linear.shape[1], pixels))
    moved[:, :, :2] = -affine[used][..., None]
    if moved.shape[2] > 2:
        for axis in range(2):
            moved[:, axis, 2 + 2 * axis : 4 + 2 * axis] = apart
    bent = _bend(stack, which[used], place, linear[used], moved, residual[used])
    square = design[used] @ np.swapaxes(design[used], 1, 2)
    inverse[used] = _inverse(square, square - bent)
    variance = np.einsum("np,np->n", residual[used], residual[used]) / (pixels - unknowns)
    force = variance[:, None] * _force(place, linear[used], smoothing[used], moved)
    lean[used] = np.einsum("nij,nj->ni", inverse[used, :2], force)
    mean, wave = np.moveaxis(np.array([_noise_gain(float(one)) for one in smoothing[used]])[:, :, 0], 1, 0)
    curvature[used] = 2.0 * np.pi**2 * pixels * variance * mean * wave
    square_sum, energy = lowered[0][used], lowered[1][used]
    with np.errstate(divide="ignore", invalid="ignore"):
        share[used] = np.where(energy > 0, np.clip(square_sum / (pixels * energy * variance), 0.0, 1.0), 0.0)
    return TemplateNoise(inverse, lean, curvature, share)


def _bend(
    stack: SplineStack, which: NDArray[np.intp], place: Array, linear: Array, moved: Array, residual: Array
) -> Array:
    """(n, q, q) sum of residuals times second derivatives of the model.

    Second derivatives of the place in the template by the unknowns meet sums of residuals times slopes, which are 0.
    """
    geometry, unknowns = moved.shape[2], moved.shape[2] + linear.shape[1]
    sharp = linear.shape[1] > 2
    value = stack(place[:, 0], place[:, 1], which, order=4 if sharp else 2)
    second = linear[:, 1, None] * value[3:6]
    if sharp:
        second = second + linear[:, 2, None] * value[10:13] + linear[:, 3, None] * value[12:15]
    row, cross, column = residual * second
    out = np.zeros((len(which), unknowns, unknowns))
    one = row[:, None] * moved[:, 0] + cross[:, None] * moved[:, 1]
    other = cross[:, None] * moved[:, 0] + column[:, None] * moved[:, 1]
    out[:, :geometry, :geometry] = one @ np.swapaxes(moved[:, 0], 1, 2) + other @ np.swapaxes(moved[:, 1], 1, 2)
    # the gain's and the sharpnesses' columns move with the place
    for k, slopes in enumerate(((1, 2), (6, 7), (8, 9))[: linear.shape[1] - 1]):
        along = sum(np.einsum("nip,np->ni", moved[:, axis], residual * value[slopes[axis]]) for axis in range(2))
        out[:, :geometry, geometry + 1 + k] = out[:, geometry + 1 + k, :geometry] = along
    return out


def _inverse(square: Array, curvature: Array) -> Array:
    """(n, q, q) of the curvature on what the normal matrix knows; NaN where too little of that is left."""
    scale = 1.0 / np.sqrt(np.einsum("nqq->nq", square))
    both = scale[:, :, None] * scale[:, None]
    value, vector = np.linalg.eigh(square * both)
    with np.errstate(divide="ignore", invalid="ignore"):
        known = np.where(value > _OPEN * value[:, -1:], 1.0 / np.sqrt(value), 0.0)
    root = vector * known[:, None, :]
    left = np.swapaxes(root, 1, 2) @ (curvature * both) @ root
    # what is open stays 0 in the root, whatever its share
    left = left + np.where(known == 0.0, 1.0, 0.0)[:, :, None] * np.eye(left.shape[1])
    share, turn = np.linalg.eigh(0.5 * (left + np.swapaxes(left, 1, 2)))
    share = np.where(share.min(axis=1, keepdims=True) > _LEAST, share, np.nan)
    turned = root @ turn
    return np.asarray((turned / share[:, None, :]) @ np.swapaxes(turned, 1, 2) * both)


def _force(place: Array, linear: Array, smoothing: Array, moved: Array) -> Array:
    """(n, q) expectation of F by white noise in the template that has unit variance after the gain."""
    mean, wave = np.moveaxis(np.array([_noise_gain(float(one)) for one in smoothing]), 1, 0)
    phase = 2.0 * np.pi * place
    # (3, n, 2, p): energy of the value, of value by second derivative, of the second derivative, along rows and columns
    energy = mean.T[:, :, None, None] + wave.T[:, :, None, None] * np.cos(phase)
    slope = -2.0 * np.pi * wave.T[:, :, None, None] * np.sin(phase)
    factors = linear[:, 1:]
    matrix = _products(energy[:, :, 0], energy[:, :, 1])[:, : factors.shape[1], : factors.shape[1]]
    of_place = np.zeros((len(linear), moved.shape[2]))
    for axis, pair in enumerate(((slope[:, :, 0], energy[:, :, 1]), (energy[:, :, 0], slope[:, :, 1]))):
        change = _products(*pair)[:, : factors.shape[1], : factors.shape[1]]
        along = np.einsum("ni,nijp,nj->np", factors, change, factors)
        of_place -= 0.5 * np.einsum("nip,np->ni", moved[:, axis], along)
    of_linear = -np.einsum("nijp,nj->ni", matrix, factors)
    force = np.concatenate([of_place, np.zeros((len(linear), 1)), of_linear], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(force / linear[:, 1, None] ** 2)


def _products(row: Array, column: Array) -> Array:
    """(n, 3, 3, p) expected products of noise in value, second derivative along rows and along columns, from those
    along either axis (3, n, p).
    """
    value, across, bend = (row[k] * column[0] for k in range(3))
    other, both, last = row[0] * column[1], row[1] * column[1], row[0] * column[2]
    lines = [[value, across, other], [across, bend, both], [other, both, last]]
    return np.stack([np.stack(line, axis=1) for line in lines], axis=1)


def noise_energy(factors: Array, smoothing: float) -> Array:
    """(n,) variance of a pixel of the model for white noise in the template, over all phases; it is 1 after the gain.

    Args:
        factors: (n, 1 or 3) gain and perhaps sharpness along rows and columns.
        smoothing: rms of the low pass, px.
    """
    mean = _noise_gain(smoothing)[0][:, None, None]
    size = factors.shape[1]
    energy = np.einsum("ni,ij,nj->n", factors, _products(mean, mean)[0, :size, :size, 0], factors)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(energy / factors[:, 0] ** 2)


@lru_cache(maxsize=32)
def _noise_gain(smoothing: float) -> Array:
    """(2, 3) energy that white noise of unit variance keeps along one axis, after low pass and interpolation.

    Of the value, of value by second derivative (px^-2) and of the second derivative (px^-4); first the mean over the
    phase of a pixel, then the amplitude of its cosine, which is largest on whole pixels.
    """
    size = 2 * _REACH + 1
    impulse = np.zeros((1, size, size))
    impulse[0, _REACH] = 1.0
    stack = SplineStack(low_passed(impulse, smoothing))
    rows = np.arange(10, size - 11) + np.arange(_PHASES)[:, None] / _PHASES
    value = stack(rows, np.full(rows.shape, float(_REACH)), np.zeros(_PHASES, np.intp), order=2)
    energy = np.stack([(value[0] ** 2).sum(axis=1), (value[0] * value[3]).sum(axis=1), (value[3] ** 2).sum(axis=1)])
    series = np.fft.rfft(energy, axis=1) / _PHASES
    out = np.stack([series[:, 0].real, 2.0 * series[:, 1].real])
    out.setflags(write=False)
    return out
