"""What images of a patch of ground take of memory and time, from what the test's file says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from twin.run.cost import Cost, Lowered

if TYPE_CHECKING:
    from scenes.specs.orbit.scene import GroundSpec
    from scenes.specs.orbit.setup import SimulateSetup

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
    seconds = STARTED_SECONDS + images_seconds(pixels, spec.oversampling, spec.points is not None)
    longer = "lines" if patch.lines >= patch.pixels else "pixels"
    lines, step = len(spec.lines), sample_step(spec.line_time, spec.ground)

    def needed(number: int) -> float:
        return STARTED + images_bytes(min(patch.lines, number) * min(patch.pixels, number), lines, step)

    lowered = Lowered(spec, ("patch", longer), max(patch.lines, patch.pixels), "lines and pixels", needed, 100)
    return Cost(needed(max(patch.lines, patch.pixels)), seconds, lowered)


def sample_step(line_time: float, ground: GroundSpec) -> float:
    """Samples of the ground's texture on the side of a pixel."""
    return GROUND_SPEED * line_time / ground.texture.spacing


def images_seconds(pixels: float, oversampling: int, measured: bool) -> float:
    """Seconds of images of so many pixels.

    Args:
        pixels: of all images.
        oversampling: samples of the ground along each side of a pixel.
        measured: whether points are measured in them.
    """
    return pixels * (oversampling**2 * SAMPLE_SECONDS + measured * MEASURED_SECONDS)


def images_bytes(pixels: float, lines: int, step: float) -> float:
    """Memory of one patch of ground and its images, bytes.

    Args:
        pixels: of one line's image.
        lines: that see it.
        step: see `sample_step`.
    """
    return pixels * (lines * PIXEL + step**2 * SAMPLE)
