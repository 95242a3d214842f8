"""Image of a far point by the matrix Fourier transform of gf7's traced exit pupil, beside poppy's.

The same complex pupil on the same square grid goes into both, and comes out on the same pixels. poppy takes the grid's
order for a product of three matrices; the twin takes nodes wherever they are. It never images such a grid itself but
the nodes of a quadrature over the stop, which need no fine grid for the edge; that image of the same pixels stands
beside it, each with its difference from the image of many more nodes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from optics.numerics import quadrature
from optics.waves.diffraction import Grid, image
from tests.benchmarks.workbench import Number, Speed, Work, Workbench, absent, in_turns, installed
from tests.oracles.pupil_grid import FarPoint, fitted, poppy_wave, pupil_grid

PUPIL, QUICK_PUPIL = 256, 64
PIXELS, QUICK_PIXELS = 128, 48
STEP = 1.5e-6
ROUNDS = 7
SAME = 1e-10
"""Difference of images of the same samples, of the peak: rounding of sums of 50 000 waves."""
MANY = quadrature.disk(40, 160)


def measure(bench: Workbench, quick: bool) -> Speed:
    """Seconds per image."""
    size, pixels = (QUICK_PUPIL, QUICK_PIXELS) if quick else (PUPIL, PIXELS)
    point = FarPoint(bench.backend, bench.camera("gf7"), np.radians(1.0), np.radians(0.05), {})
    grid = pupil_grid(fitted(point), size)
    axis = Grid(-0.5 * (pixels - 1) * STEP, STEP, pixels)
    rule = quadrature.disk_for(grid.largest_phase(axis))
    samples, nodes = grid.field(), point.field(rule)

    works = {
        "twin": Work(lambda _: image(samples, axis, axis)[0]),
        "quadrature": Work(lambda _: image(nodes, axis, axis)[0]),
    }
    notes = []
    if installed("poppy"):

        def poppy(_: Any) -> Any:
            return np.abs(poppy_wave(grid.wave, axis, grid.width)) ** 2

        works["poppy"] = Work(poppy)
    else:
        notes.append(absent("poppy"))
    spent = in_turns(works, 2 if quick else ROUNDS)

    many = image(point.field(MANY), axis, axis)[0]

    def difference(got: np.ndarray, want: np.ndarray) -> float:
        return float(np.max(np.abs(got - want)) / np.max(want))

    own = f"PSF of gf7, {size} x {size} pupil samples to {pixels} x {pixels} pixels"
    numbers = [
        Number("seconds", spent["twin"].wall_s, own, "s"),
        Number("cpu_ms", 1e3 * spent["twin"].cpu_s, "  processor time", "ms"),
        Number("difference", difference(spent["twin"].result, many), "  its error, of the peak"),
        Number("quadrature_seconds", spent["quadrature"].wall_s, f"PSF from {rule.count} quadrature nodes", "s"),
        Number("quadrature_cpu_ms", 1e3 * spent["quadrature"].cpu_s, "  processor time", "ms"),
        Number("quadrature_difference", difference(spent["quadrature"].result, many), "  its error, of the peak"),
    ]
    if "poppy" in spent:
        same = difference(spent["twin"].result, grid.poppy_irradiance(axis))
        assert same < SAME, same
        seconds = spent["poppy"].wall_s
        numbers[3:3] = [
            Number("poppy_seconds", seconds, "  poppy, same samples, same pixels", "s"),
            Number("ratio_poppy", seconds / spent["twin"].wall_s, "  times poppy, same samples"),
            Number("poppy_difference", same, "  difference from poppy's image, of the peak"),
        ]
        ratio = seconds / spent["quadrature"].wall_s
        numbers.append(Number("quadrature_ratio_poppy", ratio, "  times poppy with the samples above"))
    return Speed(tuple(numbers), tuple(notes))
