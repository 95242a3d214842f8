"""Cameras that change from pass to pass, an on-board monitor that reads the changes, and tie points of a strip, as the
file of an in-orbit calibration gives them.
"""

from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from scenes.errors import Problem, names_text, nearest
from scenes.orbit_angle import LINES
from scenes.orbit_spec import AngleSigmas
from scenes.quantity import Quantity, Vector
from scenes.spec import Named, Spec, Whole
from scenes.units import ANGLE, DISTANCE, LENGTH

LEAST_TIES = 20
"""Tie points of a strip. Fewer leave most readings of the attitude without a point near them."""

FocalSigma = Annotated[float, Quantity(LENGTH, smallest="0 um", largest="5 mm")]
ReadingFocal = Annotated[float, Quantity(LENGTH, above_zero=True, largest="5 mm")]
ReadingAngles = Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, above_zero=True, largest="1 deg"))]
StripLength = Annotated[float, Quantity(DISTANCE, smallest="1 km", largest="1000 km")]


class CameraDriftSpec(Spec):
    """How much a line camera changes from field to field, one standard deviation.

    Attributes:
        angles: d_alpha (about the camera's Y), d_beta (about X) and d_gamma (about the line of sight), radians.
        focal_length: d_f of the principal distance, metres.
    """

    angles: AngleSigmas = (0.0, 0.0, 0.0)
    focal_length: FocalSigma = 0.0


class MonitorReadingSpec(Spec):
    """Standard deviation of what the on-board monitor reads of each line camera in each pass.

    Attributes:
        angles: of d_alpha, d_beta and d_gamma, radians.
        focal_length: of d_f, metres.
    """

    angles: ReadingAngles
    focal_length: ReadingFocal


class StripSpec(Spec):
    """Every pass is adjusted on its tie points before check points are intersected.

    Attributes:
        ties: how many tie points are drawn; measured points of images are used as they come.
        length: of the strip along the track on which they lie, around the field, metres.
    """

    ties: Annotated[Whole, Field(le=5000)] = 500
    length: StripLength = 300e3

    @model_validator(mode="after")
    def _are_enough(self) -> "StripSpec":
        if self.ties < LEAST_TIES:
            raise Problem("too few tie points", f"{self.ties}", f"{LEAST_TIES} or more", within=("ties",))
        return self


def _of_lines(drift: Named[CameraDriftSpec]) -> Named[CameraDriftSpec]:
    for name in drift:
        if name not in LINES:
            raise Problem("no such line", name, names_text(LINES), nearest(name, LINES), within=(name,))
    return drift


CameraDrifts = Annotated[Named[CameraDriftSpec], AfterValidator(_of_lines)]
