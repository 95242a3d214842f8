"""What images of a patch of ground take of memory and time, from what the test's file says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from twin.run.cost import Cost, Lowered

if TYPE_CHECKING:
    from scenes.specs.orbit.setup import SimulateSetup
    from scenes.specs.orbit.simulate import OrbitSimulateSpec

GROUND_SPEED = 7e3
"""Of the point below a satellite in a low orbit, metres per second; an image line of square pixels is as wide."""
STARTED, STARTED_SECONDS = 265e6, 4.2
"""Of a run with the smallest patch: what draws its report, most of all; bytes and seconds."""
PIXEL, SAMPLE = 150.0, 97.0
"""Bytes per pixel of all images, and per sample of the ground's texture."""
SAMPLE_SECONDS, MEASURED_SECONDS = 8.8e-7, 8e-6
"""Seconds per sample of the ground that a pixel of an image is made of (``oversampling`` squared of each), and per
pixel of an image in which points are measured.
"""


def simulation_cost(setup: SimulateSetup) -> Cost:
    """What `run_simulation` and its report take.

    Args:
        setup: the test.
    """
    spec, patch = setup.test, setup.test.patch
    pixels = patch.lines * patch.pixels * len(spec.lines)
    samples = pixels * spec.oversampling**2
    measured = 0 if spec.points is None else pixels
    seconds = STARTED_SECONDS + samples * SAMPLE_SECONDS + measured * MEASURED_SECONDS
    longer = "lines" if patch.lines >= patch.pixels else "pixels"

    def lower(number: int) -> float:
        return _bytes(spec, min(patch.lines, number), min(patch.pixels, number))

    lowered = Lowered(spec, ("patch", longer), max(patch.lines, patch.pixels), "lines and pixels", lower, 100)
    return Cost(_bytes(spec, patch.lines, patch.pixels), seconds, lowered)


def _bytes(spec: OrbitSimulateSpec, lines: int, pixels: int) -> float:
    return STARTED + lines * pixels * len(spec.lines) * PIXEL + _texture(spec, lines, pixels) * SAMPLE


def _texture(spec: OrbitSimulateSpec, lines: int, pixels: int) -> float:
    """Samples of the ground's texture below the patch."""
    step = GROUND_SPEED * spec.line_time / spec.ground.texture.spacing
    return lines * pixels * step**2
