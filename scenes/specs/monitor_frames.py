"""Measurement of a monitor: frames of its area CCDs before and after a change, and the files to which it refers."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from optics.numerics.number_tree import FrozenMap
from scenes.specs.course import Moment, ascending, moment
from scenes.specs.detector import DetectorSpec, PixelPitch
from scenes.specs.disturbances import JobDisturbances
from scenes.specs.instrument import SIDES, Exposure, FieldAngle, LookAngle
from scenes.specs.job import AnalysisSpec, JobSpec
from scenes.specs.load import load_detector
from scenes.specs.resolved import ExperimentSetup, ResolvedJob, resolve_job
from scenes.yaml.csv_table import rows_of
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, names_text, nearest, shown, unknown
from scenes.yaml.input_file import file_beside, is_file, unusable
from scenes.yaml.spec import Named, NothingIsEmpty, Paths, Ref, Reference, Spec, Whole, require_one, short_for
from scenes.yaml.unit_fields import PositiveLength
from scenes.yaml.units import MOMENT, parse_quantity
from scenes.yaml.yaml_file import LARGEST_BYTES

ALL = "all"
"""Key instead of a channel's name for files that hold for all channels."""
MOST_FILES, MOST_TIMES = 10_000, 1000


_Several = Field(min_length=1, max_length=MOST_FILES)
Files = Annotated[tuple[Reference, ...], short_for(None, str, schema=Reference | tuple[Reference, ...]), _Several]
"""Image files whose frames are averaged together, relative to the file that refers to them."""


PerChannel = Annotated[Paths[Files], short_for(ALL, str, list, schema=Files | dict[str, Files]), Field(min_length=1)]
"""Image files by channel, ``CAMERA/CHANNEL``, or for all channels."""
FirstPixel = tuple[Annotated[Whole, Field(ge=0, le=65535)], Annotated[Whole, Field(ge=0, le=65535)]]


class ChannelFramesSpec(Spec):
    """Frames of one channel.

    Attributes
    ----------
    before : str | list[str]
        Image file, or list of files, of the nominal state.
    after : tuple[str | list[str], ...]
        Image file, or list of files, of the state to be measured; for a series one entry for each time.
    offset : tuple[int, int]
        Row and column on the CCD of the frames' first pixel, for frames of a part of the CCD.
    offset_after : tuple[int, int] | None
        Row and column of the first pixel of the frames after the change, if it differs from `offset`; required if these
        frames have another size.
    """

    before: Files
    after: Annotated[tuple[Files, ...], short_for(None, str, schema=Reference | tuple[Files, ...]), _Several]
    offset: FirstPixel = (0, 0)
    offset_after: FirstPixel | None = None


class GeometrySpec(Spec):
    """Geometry of one camera's monitor that the formulas need, for an instrument without a model.

    Attributes
    ----------
    principal_distance : float
        Principal distance along the line, in metres.
    separation : float
        Distance of the two area CCDs, in metres.
    pitch : float
        Pixel pitch of the area CCDs, in metres.
    look : float
        Look angle: angle of the camera's line of sight about the base's Y, in radians.
    field : float
        Field angle of the area CCDs from the visual axis, in radians.
    principal_distance_across : float | None
        Plate scale across the line, in metres; by default the principal distance.
    """

    principal_distance: PositiveLength
    separation: PositiveLength
    pitch: PixelPitch
    look: LookAngle = 0.0
    field: FieldAngle = 0.0
    principal_distance_across: PositiveLength | None = None


class MeasurementSpec(Spec):
    """Measurement of a monitor: changes of the cameras from frames recorded before and after.

    Attributes
    ----------
    instrument : str | None
        Name of an instrument in scenes/library/instruments, or path of your file. Its model predicts the spots' shape
        and their response to motions.
    geometry : Mapping[str, GeometrySpec] | None
        Camera -> geometry for the published formulas, instead of an instrument.
    frames : str | Mapping[str, ChannelFramesSpec]
        Folder with CAMERA_CHANNEL_before.tiff and CAMERA_CHANNEL_after.tiff (or .fits), a CSV table of files, or
        CAMERA/CHANNEL -> files.
    times : tuple[float, ...] | None
        Time of each entry of `after`, for a series; by default a single state is measured.
    disturbances : JobDisturbancesSpec | None
        Expected disturbances, on which the sigmas are based, as in a job; by default the instrument's.
    template : {'twin', 'measured'}
        Source of the spots' calibrated shape: `twin` for the model, or `measured` for the frames before the change.
    detector : str | None
        Data sheet of the area CCDs, a name in the library or a path; by default the instrument's.
    exposure : float | None
        Exposure of a frame, in seconds; by default the instrument's.
    photon_transfer : {'stated', 'measured'}
        Source of gain and noise of the CCDs: `stated` for the data sheet, or `measured` for the dark and flat frames.
    dark : str | list[str] | Mapping[str, str] | None
        Dark frames, for all channels or by channel; by default there are none.
    flat : str | list[str] | Mapping[str, str] | None
        Flat-field frames, for all channels or by channel; by default there are none.
    bad_pixels : str | list[str] | Mapping[str, str] | None
        Image in which bad pixels are not 0, for all channels or by channel; by default there is none.
    corrections : {'automatic', 'none'}
        Search of the frames for defects, which are then excluded or fitted: `automatic`, or `none`.
    vibration : {'none', 'fitted'}
        Smear by vibration during an exposure: `none`, or `fitted`.
    analysis : AnalysisSpec
        Analysis of the frames.
    """

    instrument: Ref | None = None
    geometry: Annotated[Named[GeometrySpec], Field(min_length=1)] | None = None
    frames: Reference | Paths[ChannelFramesSpec]
    times: (
        Annotated[tuple[Moment, ...], Field(min_length=1, max_length=MOST_TIMES), AfterValidator(ascending)] | None
    ) = None
    disturbances: JobDisturbances | None = None
    template: Literal["twin", "measured"] = "twin"
    detector: Ref | None = None
    exposure: Exposure | None = None
    photon_transfer: Literal["stated", "measured"] = "stated"
    dark: PerChannel | None = None
    flat: PerChannel | None = None
    bad_pixels: PerChannel | None = None
    corrections: Literal["automatic", "none"] = "automatic"
    vibration: Literal["none", "fitted"] = "none"
    analysis: Annotated[AnalysisSpec, NothingIsEmpty] = AnalysisSpec.model_construct()

    @model_validator(mode="after")
    def _model_or_geometry(self) -> MeasurementSpec:
        allowed = "instrument: NAME, or geometry: {CAMERA: {...}}"
        require_one(self, ("instrument", "geometry"), "an instrument or its geometry is needed", allowed)
        if self.geometry is None:
            return self
        if self.template == "twin":
            text = "without an instrument there is no model of the spots"
            raise Problem(text, "twin", "template: measured", within=("template",))
        if self.disturbances is not None:
            text = "disturbances need the model of an instrument"
            raise Problem(text, None, "no disturbances, or an instrument", within=("disturbances",))
        if self.detector is None:
            raise Problem("no data sheet of the area CCDs", None, "detector: NAME or FILE", within=("detector",))
        return self

    @model_validator(mode="after")
    def _has_what_it_needs(self) -> MeasurementSpec:
        if self.photon_transfer == "measured" and (self.dark is None or self.flat is None):
            missing = names_text(name for name in ("dark", "flat") if getattr(self, name) is None)
            text = "a measured photon transfer needs dark and flat frames"
            raise Problem(text, f"no {missing}", "dark: FILES and flat: FILES", within=("photon_transfer",))
        if self.flat is not None and self.dark is None:
            text = "flat frames need dark frames"
            raise Problem(text, None, "dark: FILES as well", within=("flat",))
        if self.vibration == "fitted" and self.analysis.centroid != "ml":
            text = "fitting of smear needs the centroid method ml"
            raise Problem(text, self.analysis.centroid, "centroid: ml", within=("analysis", "centroid"))
        return self

    @model_validator(mode="after")
    def _files_of_all_times(self) -> MeasurementSpec:
        if isinstance(self.frames, str):
            return self
        if not self.frames:
            raise Problem("no frames", None, "CAMERA/CHANNEL: {before: FILE, after: FILE}", within=("frames",))
        for name, files in self.frames.items():
            where = ("frames", name, "after")
            if self.times is not None and len(files.after) != len(self.times):
                value, allowed = f"{len(files.after)} of {len(self.times)} times", "one file or list of files a time"
                raise Problem("not as many entries as times", value, allowed, within=where)
            if self.times is None and any(len(entry) > 1 for entry in files.after):
                text = "lists of files need several times"
                raise Problem(text, None, "times: [...], or a plain list", within=where)
        return self

    def states(self, files: ChannelFramesSpec) -> tuple[tuple[str, ...], ...]:
        """Return the files of each state after the change.

        Parameters
        ----------
        files : ChannelFramesSpec
            Files of a channel.
        """
        if self.times is not None:
            return files.after
        return (tuple(name for entry in files.after for name in entry),)


def per_channel(files: Any, channel: str) -> tuple[str, ...]:
    """Return the files for one channel, or the files for all channels; empty if there are none.

    Parameters
    ----------
    files : Mapping[str, tuple[str, ...]] or None
        Channel -> files; None for no files.
    channel : str
        Name of the channel.
    """
    return () if files is None else tuple(files.get(channel, files.get(ALL, ())))


ENDINGS = (".tiff", ".tif", ".fits", ".fit", ".fts", ".png")
"""Suffixes of frames in a folder, in the order of the search."""
BEFORE, AFTER = "before", "after"
HEADS = "channel, when (before or after) or 'time [min]' (before or a number), file, and perhaps row, column"
_TIME_HEAD = re.compile(r"time *\[(?P<unit>[^\[\]]+)\]")


class MeasurementSetup(ExperimentSetup[MeasurementSpec]):
    """Measurement with the content of the files to which it refers; paths of frames are absolute.

    Attributes
    ----------
    model : ResolvedJob | None
        Nominal job of the instrument; None if only its geometry is given.
    detector : DetectorSpec
        Data sheet of the area CCDs.
    """

    model: ResolvedJob | None = None
    detector: DetectorSpec

    @classmethod
    def parts(cls, test: MeasurementSpec) -> dict[str, Any]:
        """Read instrument and data sheet, make paths of frames absolute; return field of the set-up -> content."""
        model = None if test.instrument is None else _model(test, test.instrument)
        if test.detector is not None:
            detector = load_detector(test.detector, test, ("detector",))
        else:
            assert model is not None
            detector = model.area_detector
        if model is not None:
            model = model.model_copy(update={"detector": detector})
        test = _located(test, _channels(test, model), Path(test.source.file).parent)
        return {"test": test, "model": model, "detector": detector}

    @property
    def channels(self) -> tuple[str, ...]:
        """Name ``CAMERA/CHANNEL`` of every channel, in the order of the spots."""
        return _channels(self.test, self.model)


def _model(spec: MeasurementSpec, instrument: str) -> ResolvedJob:
    job = JobSpec.model_construct(instrument=instrument, disturbances=spec.disturbances, analysis=spec.analysis)
    # the job's keys have the names of the measurement's, so that issues are reported at their lines
    model = resolve_job(job.with_source(spec.source))
    if spec.exposure is None:
        return model
    monitor = model.instrument.autocollimator
    ccd = monitor.area_ccd.model_copy(update={"exposure": spec.exposure})
    instrument_spec = model.instrument.model_copy(update={"monitor": monitor.model_copy(update={"area_ccd": ccd})})
    return model.model_copy(update={"instrument": instrument_spec})


def _channels(spec: MeasurementSpec, model: ResolvedJob | None) -> tuple[str, ...]:
    if model is None:
        return tuple(f"{camera}/{channel}" for camera in spec.geometry or {} for channel in SIDES)
    instrument = model.instrument
    return tuple(f"{camera}/{channel}" for camera in instrument.cameras for channel in instrument.channels_of(camera))


def _located(spec: MeasurementSpec, channels: tuple[str, ...], base: Path) -> MeasurementSpec:
    """Return the measurement with absolute paths of all files."""
    update: dict[str, Any] = {}
    if isinstance(spec.frames, str):
        frames, times = _frame_files(spec, base / spec.frames, channels)
        update |= {"times": times} if times else {}
    else:
        frames = dict(spec.frames)
        for name, files in frames.items():
            _known(spec, ("frames", name), name, channels)
            before = _paths(spec, ("frames", name, BEFORE), files.before, base)
            after = tuple(_paths(spec, ("frames", name, AFTER, k), entry, base) for k, entry in enumerate(files.after))
            frames[name] = files.model_copy(update={"before": before, "after": after})
    missing = [name for name in channels if name not in frames]
    if missing:
        text = f"no frames of {names_text(missing)}"
        raise spec.error(text, ("frames",), allowed="frames of every channel of the instrument, before and after")
    update["frames"] = FrozenMap({name: frames[name] for name in channels})
    for key in ("dark", "flat", "bad_pixels"):
        files_of: Mapping[str, tuple[str, ...]] | None = getattr(spec, key)
        if files_of is None:
            continue
        for name in files_of:
            _known(spec, (key, name), name, (*channels, ALL))
        update[key] = FrozenMap({name: _paths(spec, (key, name), files, base) for name, files in files_of.items()})
        uncovered = [name for name in channels if name not in files_of and ALL not in files_of]
        if uncovered:
            raise spec.error(
                f"missing for {names_text(uncovered)}", (key,), allowed=f"{ALL}: FILES, or files of every channel"
            )
    return spec.model_copy(update=update)


def _known(spec: Spec, key: KeyPath, name: str, channels: tuple[str, ...]) -> None:
    if name not in channels:
        raise spec.error(unknown("no such channel", name, channels), key)


_IMAGES = "an image file (TIFF, FITS, PNG)"


def _paths(spec: Spec, key: KeyPath, files: Iterable[str], base: Path) -> tuple[str, ...]:
    """Return absolute paths; raise `InputError` for a missing file."""
    return tuple(str(spec.file_at(key, file, base, _IMAGES)) for file in files)


def _frame_files(
    spec: MeasurementSpec, path: Path, channels: tuple[str, ...]
) -> tuple[dict[str, ChannelFramesSpec], tuple[float, ...]]:
    """Return channel -> frames listed in a folder or a table, and the times of a series, in seconds.

    There are no times for a single state.
    """
    if is_file(path) and path.suffix.lower() == ".csv":
        return read_frame_table(path, channels)
    if is_file(path):
        allowed = "a folder of frames, a .csv table of files, or CAMERA/CHANNEL: {before: FILE, after: FILE}"
        raise spec.error("neither a folder nor a table", ("frames",), value=spec.frames, allowed=allowed)
    try:
        names = sorted(entry.name for entry in path.iterdir())
    except (OSError, ValueError):
        allowed = "a folder of frames, relative to this file"
        raise spec.error(f"no such folder: {path}", ("frames",), allowed=allowed) from None
    frames = {}
    for channel in channels:
        files = {}
        for when in (BEFORE, AFTER):
            stem = f"{channel.replace('/', '_')}_{when}"
            present = [stem + ending for ending in ENDINGS if stem + ending in names]
            file = next((name for name in present if not _is_picture(path / name)), None)
            if file is None:
                near = None if present else nearest(f"{stem}.tiff", names)
                text, others = f"no frames of {channel} {when} in {path}", ", ".join(ENDINGS[1:])
                if present:
                    text += f": {present[0]} is an 8-bit preview, not a recorded frame"
                allowed = f"{stem}.tiff (or {others}), or CAMERA/CHANNEL: {{before: FILE, after: FILE}}"
                raise spec.error(text, ("frames",), allowed=allowed, suggestion=near)
            files[when] = (str((path / file).absolute()),)
        frames[channel] = ChannelFramesSpec.model_construct(before=files[BEFORE], after=(files[AFTER],))
    return frames, ()


def _is_picture(file: Path) -> bool:
    """Return whether a file is a PNG with 8 bits, as the twin writes one beside the frames of every channel.

    Raw frames of a camera with 8 bits must be listed one by one.
    """
    try:
        with file.open("rb") as stream:
            head = stream.read(25)
    except OSError:
        return False
    return head.startswith(b"\x89PNG\r\n\x1a\n") and len(head) == 25 and head[24] < 16


def read_frame_table(path: Path, channels: tuple[str, ...]) -> tuple[dict[str, ChannelFramesSpec], tuple[float, ...]]:
    """Return the frames of every channel by their absolute paths, and the times of a series.

    Parameters
    ----------
    path : Path
        Path of the CSV table.
    channels : tuple[str, ...]
        Channels that the table must list.

    Returns
    -------
    tuple
        Channel -> frames, and the times in seconds; no times for a single state.

    Raises
    ------
    InputError
        The table cannot be read; with its line.
    """
    return _FrameTable(path, channels).read()


@dataclass(frozen=True)
class _FrameTable:
    """CSV table with a row for each file: its channel, its time or state, and the first pixel of its frames."""

    path: Path
    channels: tuple[str, ...]

    def read(self) -> tuple[dict[str, ChannelFramesSpec], tuple[float, ...]]:
        seen: dict[str, dict[float | str, list[str]]] = {}
        corners: dict[tuple[str, bool], tuple[int, int]] = {}
        heads: list[str] = []
        for line, row in rows_of(self.path, LARGEST_BYTES):
            cells = [cell.strip() for cell in row]
            if not heads:
                heads = self._heads(cells, line)
                continue
            if len(cells) != len(heads):
                text = f"{len(cells)} cells under {len(heads)} heads"
                raise InputError(Issue(text, str(self.path), line, allowed="as many cells as heads"))
            self._take(dict(zip(heads, cells, strict=True)), line, seen, corners)
        return self._frames(seen, corners)

    def _heads(self, cells: list[str], line: int) -> list[str]:
        when = [cell for cell in cells if cell == "when" or _TIME_HEAD.fullmatch(cell)]
        known = {"channel", "file", "row", "column", *when}
        for cell in cells:
            if cell not in known or cells.count(cell) > 1:
                raise InputError(Issue("not the head of a column", str(self.path), line, (), shown(cell), HEADS))
        if len(when) != 1 or not {"channel", "file"} <= set(cells) or ("row" in cells) != ("column" in cells):
            raise InputError(Issue("a column is missing", str(self.path), line, (), names_text(cells), HEADS))
        return cells

    def _take(
        self,
        row: dict[str, str],
        line: int,
        states: dict[str, dict[float | str, list[str]]],
        corners: dict[tuple[str, bool], tuple[int, int]],
    ) -> None:
        file = str(self.path)
        channel = row["channel"]
        if channel not in self.channels:
            raise InputError(unknown("no such channel", channel, self.channels).at(file, line, ("channel",)))
        head = next(name for name in row if name not in ("channel", "file", "row", "column"))
        when: float | str = row[head]
        if row[head] != BEFORE and head != "when":
            unit = _TIME_HEAD.fullmatch(head)
            assert unit is not None
            try:
                when = parse_quantity(f"{row[head]} {unit['unit'].strip()}", MOMENT)
            except Problem as problem:
                allowed = f"{BEFORE}, or a number of {unit['unit'].strip()}"
                raise InputError(Issue(problem.problem, file, line, (head,), shown(row[head]), allowed)) from None
        elif row[head] not in (BEFORE, AFTER):
            raise InputError(Issue("no such state", file, line, (head,), shown(row[head]), f"{BEFORE}, {AFTER}"))
        image = self.path.parent / row["file"]
        if not is_file(image):
            allowed, near = f"{_IMAGES}, relative to the table", file_beside(image)
            raise InputError(Issue(unusable(image), file, line, ("file",), None, allowed, near))
        states.setdefault(channel, {}).setdefault(when, []).append(str(image.absolute()))
        if "row" in row:
            corner = []
            for name in ("row", "column"):
                if not re.fullmatch(r"[0-9]{1,5}", row[name]):
                    raise InputError(Issue("not a pixel", file, line, (name,), shown(row[name]), "a whole number"))
                corner.append(int(row[name]))
            key = (channel, when == BEFORE)
            if corners.setdefault(key, (corner[0], corner[1])) != (corner[0], corner[1]):
                text = "the first pixel differs from that in earlier rows"
                raise InputError(Issue(text, file, line, ("row",), shown(corner), "the same in all rows of this state"))

    def _frames(
        self, states_of: dict[str, dict[float | str, list[str]]], corners: dict[tuple[str, bool], tuple[int, int]]
    ) -> tuple[dict[str, ChannelFramesSpec], tuple[float, ...]]:
        file = str(self.path)
        states = {when for files in states_of.values() for when in files if when != BEFORE}
        order = sorted(states, key=lambda when: when if isinstance(when, float) else 0.0)
        if not order or len(order) > MOST_TIMES:
            raise InputError(Issue(f"{len(order)} states after", file, None, allowed=f"1 to {MOST_TIMES}"))
        frames = {}
        for channel in self.channels:
            files = states_of.get(channel, {})
            for when in (BEFORE, *order):
                if when not in files:
                    state = when if isinstance(when, str) else f"at {moment(when)}"
                    raise InputError(Issue(f"no file of {channel} {state}", file, None, allowed="a row for each state"))
            corner: dict[str, Any] = {"offset": corners.get((channel, True))}
            corner["offset_after"] = corners.get((channel, False))
            frames[channel] = ChannelFramesSpec.model_construct(
                before=tuple(files[BEFORE]),
                after=tuple(tuple(files[when]) for when in order),
                **{key: pixel for key, pixel in corner.items() if pixel is not None},
            )
        times = tuple(when for when in order if isinstance(when, float))
        return frames, times
