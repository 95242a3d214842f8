"""Points that are measured in the images of a patch, against an orthophoto and between the lines."""

from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from scenes.errors import Problem
from scenes.orbit_scene import GroundError
from scenes.spec import Number, Spec, Whole

LEAST_TEMPLATE = 13
"""Pixels: a margin of 3 on either side leaves least squares matching 7."""


def _is_odd(side: int) -> int:
    if side % 2 == 0:
        raise Problem("a template needs a middle pixel", str(side), "an odd number of pixels")
    return side


class ImagePointsSpec(Spec):
    """Points measured in images.

    Attributes:
        control: points of the orthophoto that are sought in every line.
        check: more of them, kept apart to test with.
        tie: points of the nadir line's image that are sought in the others.
        reach: how far the predicted place may be off, pixels and lines.
        template: its side, pixels.
        least_correlation: of image and template after the fit.
        largest_sigma: of a place along its worst direction, pixels.
        height_sigma: of the reference heights, as their producer states it, metres.
        roughness: rms by which noise of the attitude bends the displacement over a patch, pixels: neighbours within it
            do not contradict each other.
        false_alarm: share of right matches that consensus may take for wrong.
    """

    control: Annotated[Whole, Field(ge=0, le=2000)] = 60
    check: Annotated[Whole, Field(ge=0, le=2000)] = 0
    tie: Annotated[Whole, Field(ge=0, le=2000)] = 0
    reach: Annotated[Whole, Field(ge=2, le=200)] = 40
    template: Annotated[Whole, Field(ge=LEAST_TEMPLATE, le=101), AfterValidator(_is_odd)] = 31
    least_correlation: Annotated[Number, Field(gt=0.0, lt=1.0)] = 0.6
    largest_sigma: Annotated[Number, Field(gt=0.0, le=2.0)] = 0.2
    height_sigma: GroundError = 2.0
    roughness: Annotated[Number, Field(ge=0.0, le=10.0)] = 0.15
    false_alarm: Annotated[Number, Field(gt=0.0, lt=0.5)] = 1e-3

    @model_validator(mode="after")
    def _are_some(self) -> "ImagePointsSpec":
        if not self.control + self.check + self.tie:
            raise Problem("no points", "control, check and tie 0", "some points, or no section `points`")
        return self
