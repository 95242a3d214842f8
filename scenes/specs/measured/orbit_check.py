"""A pass in files, and a check of the conventions by which they are read."""

from typing import Annotated, Literal

from pydantic import Field

from scenes.specs.measured.pass_files import (
    AngleSigma,
    ClockReading,
    GroundFileSpec,
    PlatformFilesSpec,
    PointSigma,
    TimeScale,
)
from scenes.specs.orbit.flight import PayloadTestSpec
from scenes.specs.orbit.scene import LightEffectsSpec
from scenes.yaml.quantity import Quantity
from scenes.yaml.spec import Number, Reference, Spec, Whole
from scenes.yaml.units import TIME

TimeSigma = Annotated[float, Quantity(TIME, smallest="0 s", largest="100 s")]
PixelSigma = Annotated[Number, Field(ge=0.0, le=10_000.0)]


class LineTimesFileSpec(Spec):
    """When lines were exposed: a table of camera, line and time.

    Attributes:
        file: path, CSV with columns `camera`, `line` and `time [s]` or `date_time`.
        time_scale: of the clock.
        epoch: reading of that clock at 0 s, for tables with `time [s]`.
        moment: which moment of its exposure a line's time is.
    """

    file: Reference
    time_scale: TimeScale
    epoch: ClockReading | None = None
    moment: Literal["start", "middle", "end"]


class ImagePointsFileSpec(Spec):
    """Where lines see ground points: a table of point, camera, line, pixel and their sigmas.

    Attributes:
        file: path, CSV with columns `point`, `camera`, `line`, `pixel`, `sigma_line`, `sigma_pixel` and perhaps
            `correlation`.
        centre: image coordinates of the middle of pixel (or line) n: n, or n + 0.5.
        first_pixel: number of the first pixel of a line.
        first_pixel_sees: to which side of the track the first pixel looks.
    """

    file: Reference
    centre: Literal["integer", "half"]
    first_pixel: Annotated[Whole, Field(ge=0, le=1)]
    first_pixel_sees: Literal["right", "left"]


class UncertaintySpec(Spec):
    """How wrong camera and platform may be, standard deviations: what hides a convention, if it is large enough.

    Attributes:
        attitude: of the measured attitude with the camera's mounting, about each axis.
        position: of the orbit, along each axis.
        interior: of each line's place in the focal plane, pixels along and across it.
        scale: of each line's focal length, relative.
        time: of the line times against those of orbit and attitude.
    """

    attitude: AngleSigma = 3e-4
    position: PointSigma = 10.0
    interior: PixelSigma = 20.0
    scale: Annotated[Number, Field(ge=0.0, le=0.1)] = 1e-4
    time: TimeSigma = 1e-3


class OrbitCheckSpec(PayloadTestSpec):
    """A check of the conventions of a pass in files.

    Attributes:
        name: as the file is called.
        description: for people.
        camera: name in scenes/library/payloads or path of a file: the camera as the laboratory knows it.
        platform: orbit and attitude.
        lines: times of the lines.
        ground: points on the ground.
        image_points: where the lines see them.
        effects: what happens to the light between ground and camera.
        uncertainty: how wrong camera and platform may be.
        points: most of each line that are used.
        shown: places of points that are printed for each reading.
    """

    platform: PlatformFilesSpec
    lines: LineTimesFileSpec
    ground: GroundFileSpec
    image_points: ImagePointsFileSpec
    effects: LightEffectsSpec = LightEffectsSpec()
    uncertainty: UncertaintySpec = UncertaintySpec()
    points: Annotated[Whole, Field(ge=4, le=1000)] = 60
    shown: Annotated[Whole, Field(ge=1, le=20)] = 3

    @property
    def seed(self) -> int:
        """Nothing is drawn."""
        return 0
