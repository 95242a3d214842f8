"""A measurement of a monitor: frames that its area CCDs recorded before and after, and what is known of them."""

from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from scenes.specs.course import Moment, moment
from scenes.specs.detector import PixelPitch
from scenes.specs.disturbances import JobDisturbances
from scenes.specs.instrument import Exposure, FieldPlace, LookAngle
from scenes.specs.job import AnalysisSpec
from scenes.yaml.errors import Problem, names_text
from scenes.yaml.quantity import PositiveLength
from scenes.yaml.spec import Named, NothingIsEmpty, Paths, Reference, Spec, Whole

ALL = "all"
"""In place of a channel: every channel."""
MOST_FILES, MOST_TIMES = 10_000, 1000


def _listed(value: Any) -> Any:
    """One file needs no brackets."""
    return [value] if isinstance(value, str) else value


Files = Annotated[
    tuple[Reference, ...], BeforeValidator(_listed, json_schema_input_type=Reference | tuple[Reference, ...]),
    Field(min_length=1, max_length=MOST_FILES),
]  # fmt: skip
"""Image files whose frames are taken together, relative to the file that names them."""


def _for_all(value: Any) -> Any:
    """A file for every channel."""
    return {ALL: value} if isinstance(value, str | list) else value


PerChannel = Annotated[
    Paths[Files], BeforeValidator(_for_all, json_schema_input_type=Files | dict[str, Files]), Field(min_length=1)
]
"""Image files by channel, ``CAMERA/SIDE``, or for all."""
FirstPixel = tuple[Annotated[Whole, Field(ge=0, le=65535)], Annotated[Whole, Field(ge=0, le=65535)]]


def _ascending(times: tuple[float, ...]) -> tuple[float, ...]:
    for k, (before, after) in enumerate(pairwise(times), 1):
        if after <= before:
            raise Problem("the times do not ascend", moment(after), f"a time after {moment(before)}", within=(k,))
    return times


class ChannelFramesSpec(Spec):
    """The frames of one channel.

    Attributes:
        before: files of the nominal state.
        after: files of the state to be measured; of a series one entry for each time, a file or a list of files.
        offset: row and column of the CCD at which the frames' first pixel stands.
        offset_after: the same of the frames after, where it is another one.
    """

    before: Files
    after: Annotated[
        tuple[Files, ...], BeforeValidator(_listed, json_schema_input_type=Reference | tuple[Files, ...]),
        Field(min_length=1, max_length=MOST_FILES),
    ]  # fmt: skip
    offset: FirstPixel = (0, 0)
    offset_after: FirstPixel | None = None


class GeometrySpec(Spec):
    """What the formulas need of one camera's monitor, where the instrument is not modelled.

    Attributes:
        focal_length: principal distance, metres.
        separation: distance of the two area CCDs, metres.
        pixel: pitch of their pixels, metres.
        look: angle of the camera's line of sight about the base's Y, radians.
        field: angle from the visual axis at which the area CCDs stand, radians.
        focal_length_across: plate scale across the line, metres; the focal length by default.
    """

    focal_length: PositiveLength
    separation: PositiveLength
    pixel: PixelPitch
    look: LookAngle = 0.0
    field: FieldPlace = 0.0
    focal_length_across: PositiveLength | None = None


class MeasurementSpec(Spec):
    """A measurement.

    Attributes:
        instrument: name of an instrument in scenes/library/instruments, or path of an own file: its model gives the
            spots' shape and what moves them.
        geometry: camera -> the few numbers of the formulas, in place of an instrument.
        frames: folder with CAMERA_SIDE_before.tiff and CAMERA_SIDE_after.tiff (or .fits), a CSV table of files, or
            CAMERA/SIDE -> files.
        times: of a series, of each entry of `after`.
        disturbances: what is expected to move, on which the sigmas rest, as in a job.
        template: where the calibrated shape of the spots is from: `twin`, or `measured` from the frames before.
        detector: data sheet of the area CCDs in place of the instrument's; name in the library or path.
        exposure: of a frame, in place of the instrument's, seconds.
        photon_transfer: where gain and noise of the CCDs are from: `stated` in the data sheet, or `measured` in the
            dark and flat frames.
        dark: frames without light, for all channels or by channel.
        flat: frames of even light, likewise.
        bad_pixels: image in which every pixel that is not 0 is bad, likewise.
        corrections: whether the frames are searched for defects, which are then left out or fitted: `automatic`, or
            `none`.
        vibration: whether the smear by vibration during an exposure is fitted: `none`, or `fitted`.
        analysis: how the centres of the spots are found.
    """

    instrument: Reference | None = None
    geometry: Annotated[Named[GeometrySpec], Field(min_length=1)] | None = None
    frames: Reference | Paths[ChannelFramesSpec]
    times: (
        Annotated[tuple[Moment, ...], Field(min_length=1, max_length=MOST_TIMES), AfterValidator(_ascending)] | None
    ) = None
    disturbances: JobDisturbances | None = None
    template: Literal["twin", "measured"] = "twin"
    detector: Reference | None = None
    exposure: Exposure | None = None
    photon_transfer: Literal["stated", "measured"] = "stated"
    dark: PerChannel | None = None
    flat: PerChannel | None = None
    bad_pixels: PerChannel | None = None
    corrections: Literal["automatic", "none"] = "automatic"
    vibration: Literal["none", "fitted"] = "none"
    analysis: Annotated[AnalysisSpec, NothingIsEmpty] = AnalysisSpec()

    @model_validator(mode="after")
    def _model_or_geometry(self) -> "MeasurementSpec":
        if (self.instrument is None) == (self.geometry is None):
            found = "neither" if self.instrument is None else "both"
            raise Problem(
                "an instrument or its geometry is needed", found, "instrument: NAME, or geometry: {CAMERA: {...}}"
            )
        if self.geometry is None:
            return self
        if self.template == "twin":
            raise Problem(
                "without an instrument there is no model of the spots",
                "twin",
                "template: measured",
                within=("template",),
            )
        if self.disturbances is not None:
            text = "what disturbances do to the spots is known of an instrument's model only"
            raise Problem(text, None, "no disturbances, or an instrument", within=("disturbances",))
        if self.detector is None:
            raise Problem("no data sheet of the area CCDs", None, "detector: NAME or FILE", within=("detector",))
        return self

    @model_validator(mode="after")
    def _has_what_it_needs(self) -> "MeasurementSpec":
        if self.photon_transfer == "measured" and (self.dark is None or self.flat is None):
            missing = names_text(name for name in ("dark", "flat") if getattr(self, name) is None)
            text = "photon transfer is measured in dark and in flat frames"
            raise Problem(text, f"no {missing}", "dark: FILES and flat: FILES", within=("photon_transfer",))
        if self.flat is not None and self.dark is None:
            raise Problem(
                "flat frames are of no use without dark frames", None, "dark: FILES as well", within=("flat",)
            )
        if self.vibration == "fitted" and self.analysis.centroid != "ml":
            text = "smear is fitted with the calibrated shape of the spots"
            raise Problem(text, self.analysis.centroid, "centroid: ml", within=("analysis", "centroid"))
        return self

    @model_validator(mode="after")
    def _every_time(self) -> "MeasurementSpec":
        if isinstance(self.frames, str):
            return self
        if not self.frames:
            raise Problem("no frames", None, "CAMERA/SIDE: {before: FILE, after: FILE}", within=("frames",))
        for name, files in self.frames.items():
            where = ("frames", name, "after")
            if self.times is not None and len(files.after) != len(self.times):
                found, allowed = f"{len(files.after)} of {len(self.times)} times", "one file or list of files a time"
                raise Problem("not as many entries as times", found, allowed, within=where)
            if self.times is None and any(len(one) > 1 for one in files.after):
                raise Problem(
                    "lists of files are for several times", None, "times: [...], or a plain list", within=where
                )
        return self

    def states(self, files: ChannelFramesSpec) -> tuple[tuple[str, ...], ...]:
        """Files of each state after.

        Args:
            files: of a channel.
        """
        if self.times is not None:
            return files.after
        return (tuple(name for one in files.after for name in one),)


def per_channel(files: Any, channel: str) -> tuple[str, ...]:
    """Files for one channel, or those for all; none where there are none.

    Args:
        files: by channel, None for none at all.
        channel: its name.
    """
    return () if files is None else tuple(files.get(channel, files.get(ALL, ())))
