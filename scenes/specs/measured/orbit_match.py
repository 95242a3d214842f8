"""Points measured in a user's line images with an orthophoto and an elevation model."""

from typing import Annotated

from pydantic import AfterValidator, Field

from scenes.specs.measured.orbit_check import LineTimesFileSpec
from scenes.specs.measured.pass_files import PlatformFilesSpec, PointSigma, RasterFileSpec
from scenes.specs.orbit.flight import PayloadTestSpec
from scenes.specs.orbit.scene import ImagePointsSpec, LightEffectsSpec
from scenes.yaml.errors import Problem
from scenes.yaml.spec import Named, Reference, Spec, Whole


class ImageWindowSpec(Spec):
    """A part of an image.

    Attributes:
        row, column: of the file, of its first pixel, counted from 0.
        rows, columns: its size.
    """

    row: Annotated[Whole, Field(ge=0)]
    column: Annotated[Whole, Field(ge=0)]
    rows: Annotated[Whole, Field(ge=32, le=50_000)]
    columns: Annotated[Whole, Field(ge=32, le=50_000)]


class LineImageFileSpec(Spec):
    """A line's image in a file.

    Attributes:
        file: path, TIFF; a georeference in it is not used.
        band: that is read, counted from 1.
        first_line: number, in the table of times, of the image's first row.
        first_pixel: pixel of the line, counted from 0, of the image's first column.
        first_pixel_sees: to which side of the track the first column looks.
        window: part that is matched; None for all.
    """

    file: Reference
    band: Annotated[Whole, Field(ge=1, le=1000)] = 1
    first_line: Annotated[Whole, Field(ge=0)] = 0
    first_pixel: Annotated[Whole, Field(ge=0)] = 0
    first_pixel_sees: Annotated[str, Field(pattern="^(right|left)$")]
    window: ImageWindowSpec | None = None


def _some_images(images: Named[LineImageFileSpec]) -> Named[LineImageFileSpec]:
    if not images:
        raise Problem("no images", "an empty mapping", "one line of the camera or more")
    return images


class OrbitMatchSpec(PayloadTestSpec):
    """Points of an orthophoto, and tie points, sought in line images.

    Attributes:
        name: as the file is called; also of the pass in what is exported.
        description: for people.
        camera: name in scenes/library/payloads or path of a file: the camera as the laboratory knows it.
        platform: orbit and attitude.
        lines: times of the lines.
        images: line -> its image.
        orthophoto: of the ground.
        dem: of the ground.
        control_sigma: of places of the orthophoto with their heights: in plan, each axis, and in height, metres.
        effects: what happens to the light between ground and camera.
        points: how many, and how they are matched.
    """

    platform: PlatformFilesSpec
    lines: LineTimesFileSpec
    images: Annotated[Named[LineImageFileSpec], AfterValidator(_some_images)]
    orthophoto: RasterFileSpec
    dem: RasterFileSpec
    control_sigma: tuple[PointSigma, PointSigma]
    effects: LightEffectsSpec = LightEffectsSpec()
    points: ImagePointsSpec

    @property
    def seed(self) -> int:
        """Nothing is drawn."""
        return 0
