"""A spot in an image with defects, for centroids that know no shape and need every pixel: what is missing is put in by
the fitted shape, and what was fitted beside the spot is taken off.

The repaired image is c = u d + (1 - u) m(q) - e(q), with the image d, the mask u of the pixels that are used, the
fitted model m and what of it is not the spot and its level, e. The parameters q are fitted to d themselves, so that a
change n of the image moves a centroid of influence g to first order by

    g u n + g ((1 - u) dm/dq - de/dq) Q n,     Q = (D' W D)^-1 D' W

with the design D and the weights W of the fit: the covariance holds what the repair costs.

Pixel coordinates: (row, column), the centre of the first pixel is (0, 0).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.spots.frame_screening import ScreenedFrames
from analysis.spots.noise import NoiseModel
from analysis.spots.screened_fit import ScreenedFit, model_parts
from analysis.spots.spot_positions import SpotPositions
from analysis.spots.spot_template import SpotTemplate

__all__ = ["repaired_centroid"]

Array = NDArray[np.float64]


def repaired_centroid(
    screened: ScreenedFrames,
    fit: ScreenedFit,
    noise: NoiseModel,
    template: SpotTemplate,
    measure: Callable[[Array, NoiseModel], SpotPositions],
) -> tuple[SpotPositions, float]:
    """Measure the centre of a spot in the repaired image, and what the repair costs: sigma over what it would be if
    nothing had been repaired and all frames were used, minus 1. Less than 0 where what was put in has less noise than
    what was taken out, as at the edge of a window.

    Args:
        screened: frames of one state.
        fit: of the spot in these.
        noise: of the detector.
        template: the spot's one shape.
        measure: a centroid with its maps, of images (1, H, W) and their noise.

    Raises:
        SpotError: of ``measure``.
    """
    shape = screened.mean.shape
    design, extra, beside = model_parts(fit, template)
    level, used, counts = fit.level.ravel(), fit.used.ravel(), screened.counts.ravel()
    image = np.where(used, screened.mean.ravel(), level) - extra
    # what is saturated has been put in
    found = measure(image.reshape(1, *shape), replace(noise, saturation_dn=1e300))
    assert found.gain_maps is not None
    own = found.gain_maps.reshape(2, -1)
    temporal, fixed = noise.temporal_variance_dn2(level, 1), noise.fixed_variance_dn2(level)
    weighted = design * (used / (temporal / counts + fixed))
    influence = own * used + own @ (~used * design - beside).T @ fit.inverse @ weighted
    new = (influence * (temporal / counts)) @ influence.T + screened.jitter / float(np.median(counts))
    old = (influence * fixed) @ influence.T
    ideal = (own * (temporal / screened.recorded + fixed)) @ own.T
    positions = replace(
        found,
        temporal_covariance=new[None],
        fixed_covariance=old[None],
        gain_maps=influence.reshape(1, 2, *shape),
        light_dn=noise.light_signal_dn(level).reshape(1, *shape),
    )
    return positions, float(np.sqrt(np.trace(new + old) / np.trace(ideal)) - 1.0)
