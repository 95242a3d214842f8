"""Accuracy of heights from a bundle of coarse three-line images and from intersection in fine ones.

The attitude errors are equal in both. A strip of twice the base is flown by TH-1's three lines with 5 m pixels. In the
bundle adjustment, tie points connect the attitudes of all times. An image with 0.5 m pixels and the same look angles is
intersected line by line with the attitudes as measured. Orbit and cameras are known in both, so that only the errors of
attitudes and image points matter.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from analysis.block.block_adjustment import adjust_block
from analysis.orbit.calibration_parameters import Noise, vertical
from analysis.orbit.forward_intersection import intersect
from optics.numerics.backend import one_blas_thread
from optics.numerics.number_tree import FrozenMap
from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.adjust import BlockPointsSpec, CameraChangeSpec, ReadingLawsSpec
from scenes.specs.orbit.setup import AdjustSetup
from twin.framework.procedure import stream
from twin.orbit.block.drawn_block import DrawnBlock, draw_block
from twin.validation.check import CheckResult, Chosen, Supposed, mean_of
from twin.validation.group import Context, group_of

FINER = 10.0
"""Ratio of the pixel sizes of the coarse (5 m) and the fine (0.5 m) images."""
IMAGE, FINE = 0.3, 0.1
"""Standard deviations of an image point, pixels, in the main simulation and in a second one.

The second gives the exponent with which the result depends on this error.
"""
ERRORS = (0.35, 0.7, 1.4)
"""Standard deviations of the attitude, arcsec, for which both methods are simulated to find the limit."""
PRINTED = 0.5
STRIPS, FAST_STRIPS = 5, 3
TIES, CHECKS = 800, 150
_FIXED = CameraChangeSpec.model_validate({"lasting": {"angles": 3 * ["0.002 arcsec"], "principal_distance": "0.1 um"}})


def strip(image: float, attitude: float) -> AdjustSetup:
    """Return the setup of one pass of three lines without ground control.

    Parameters
    ----------
    image : float
        Standard deviation of an image point, in pixels of 5 m.
    attitude : float
        Standard deviation of an attitude measurement, twice a second, in arcseconds.
    """
    setup = AdjustSetup.read(SCENES / ORBIT / "adjust.yaml")
    test, lines = setup.test, ("forward", "nadir", "backward")
    readings = {"law": "white", "sigma": 3 * [f"{attitude} arcsec"], "interval": "0.5 s"}
    orbit = {"law": "constant", "sigma": 3 * ["10 mm"]}
    changed = {
        "lines": lines,
        "span": 100.0,
        "area": test.area.model_copy(update={"east": 40e3, "north": 500e3}),
        "passes": FrozenMap({"May": test.passes["May"]}),
        "points": BlockPointsSpec.model_validate({"control": 0, "tie": TIES, "check": CHECKS, "image": image}),
        "errors": ReadingLawsSpec.model_validate({"attitude": {"readings": readings}, "orbit": {"orbit": orbit}}),
        "changes": FrozenMap(dict.fromkeys(lines, _FIXED)),
        "angles": (),
        "monitor": None,
        "laser": None,
        "terrain": None,
    }
    return setup.model_copy(update={"test": test.model_copy(update=changed)})


def height_error(drawn: DrawnBlock, bundle: bool) -> float:
    """Return the root mean square error of the check points' heights, metres, by a bundle or by intersection."""
    block = drawn.block
    if bundle:
        ground = adjust_block(block).ground
    else:
        rays = {scene.name: scene.rays for scene in block.line_scenes}
        cameras = {scene.name: block.cameras[scene.camera] for scene in block.line_scenes}
        ground = intersect(rays, cameras, Noise(1e-6), count=len(drawn.ground)).ground
    where = np.flatnonzero(block.points.role == "check")
    error = np.sum((ground - drawn.ground)[where] * vertical(drawn.ground[where]), axis=1)
    return float(np.sqrt(np.nanmean(error**2)))


@one_blas_thread()
def ratios(image: float, seed: np.random.SeedSequence) -> np.ndarray:
    """Return the height errors of a bundle at 5 m divided by those of intersection at 0.5 m, (3,).

    They are given for the attitude errors `ERRORS`.
    """
    return np.array(
        [
            height_error(draw_block(strip(image, error), seed), True)
            / height_error(draw_block(strip(image / FINER, error), seed), False)
            for error in ERRORS
        ]
    )


def limit(height_ratios: np.ndarray) -> float:
    """Return the attitude error, in arcseconds, above which the bundle has the smaller errors.

    ``height_ratios`` (3,) are the ratios of bundle to intersection at `ERRORS`; their logarithms are nearly a parabola
    in the logarithm of the error.
    """
    logarithm, value = np.log(ERRORS), np.log(height_ratios)
    fine = np.linspace(np.log(0.05), np.log(5.0), 2001)
    curve = np.polyval(np.polyfit(logarithm, value, 2), fine)
    return float(np.exp(fine[np.argmin(np.abs(curve))]))


def run(context: Context) -> Iterator[CheckResult]:
    """Yield the result of the only check: the attitude error above which the bundle is more accurate."""
    count = context.count(STRIPS, FAST_STRIPS)
    root = np.random.SeedSequence(context.seed)
    ratio_list = []
    for k in range(count):
        context.progress(k / (count + 1), "strips")
        ratio_list.append(ratios(IMAGE, stream(root, k)))
    context.progress(count / (count + 1), "a strip with better image points")
    fine = limit(ratios(FINE, stream(root, 0)))
    limits = np.array([limit(ratio_row) for ratio_row in ratio_list])
    measured, sigma = mean_of(limits)
    at = np.log(PRINTED)
    factor = float(np.exp(np.mean([np.interp(at, np.log(ERRORS), np.log(ratio_row)) for ratio_row in ratio_list])))
    drawn = draw_block(strip(IMAGE, 0.01), stream(root, count))
    # between the two the limit goes with a power of the image points' error
    power = np.log(measured / fine) / np.log(IMAGE / FINE)
    facts: dict[str, Any] = {
        "floor": height_error(drawn, True),
        "factor": factor,
        "finer": fine,
        "needed": IMAGE * (PRINTED / measured) ** (1.0 / power),
        "strips": count,
        "ties": TIES,
        "errors": [f"{error:g}″" for error in ERRORS],
        "ratios": np.mean(ratio_list, axis=0),
    }
    inputs: list[Chosen | Supposed] = [
        Chosen.power("error of an image point", IMAGE, "px", measured, float(power)),
        Supposed("errors of the attitude are independent twice a second", "every 4 s likewise"),
        Supposed("orbit and cameras are without errors", "they are the same in both"),
    ]
    yield context.row("017.bundle", measured, sigma, explained=[measured], inputs=inputs, **facts)


GROUP = group_of("017.bundle", run)
