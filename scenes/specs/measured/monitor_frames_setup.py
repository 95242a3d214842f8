"""A measurement together with all it refers to: the instrument, the data sheet of its CCDs, and where every file is."""

import csv
import io
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optics.numerics.frozen_map import FrozenMap
from scenes.specs.channel import SIDES
from scenes.specs.course import moment
from scenes.specs.detector import DetectorSpec
from scenes.specs.job import JobSpec
from scenes.specs.load import find_detector, load_detector
from scenes.specs.measured.monitor_frames import (
    ALL,
    MOST_TIMES,
    ChannelFramesSpec,
    MeasurementSpec,
)
from scenes.specs.resolved import ExperimentSetup, ResolvedJob, read_setup, resolve_job
from scenes.yaml.csv_table import table_text
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, names_text, nearest, shown
from scenes.yaml.input_file import is_file, unusable
from scenes.yaml.spec import Spec
from scenes.yaml.translate import validate
from scenes.yaml.units import MOMENT, parse_quantity
from scenes.yaml.yaml_file import LARGEST_BYTES, read_yaml

ENDINGS = (".tiff", ".tif", ".fits", ".fit", ".fts", ".png")
"""Of frames in a folder, in the order in which they are looked for."""
BEFORE, AFTER = "before", "after"
HEADS = "channel, when (before or after) or 'time [min]' (before or a number), file, and perhaps row, column"
_TIME_HEAD = re.compile(r"time *\[(?P<unit>[^\[\]]+)\]")


class MeasurementSetup(ExperimentSetup[MeasurementSpec]):
    """A measurement with all it refers to; the paths of its files are absolute.

    Attributes:
        model: the instrument as a job to which nothing happens; None where only its geometry is given.
        detector: data sheet of the area CCDs.
    """

    model: ResolvedJob | None = None
    detector: DetectorSpec

    @property
    def channels(self) -> tuple[str, ...]:
        """``CAMERA/SIDE`` of every channel, in the order of the spots."""
        return _channels(self.test, self.model)


def resolve_measurement(path: str | Path) -> MeasurementSetup:
    """Read a measurement and all it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: any of the files cannot be read or is not valid, or frames are missing.
    """
    if (again := read_setup(MeasurementSetup, path)) is not None:
        return again
    spec = validate(MeasurementSpec, read_yaml(path))
    model = _model(spec)
    if spec.detector is not None:
        detector = load_detector(find_detector(spec.detector or "", spec, ("detector",)))
    else:
        assert model is not None
        detector = model.detector
    if model is not None:
        model = model.model_copy(update={"detector": detector})
    spec = _located(spec, _channels(spec, model), Path(spec.source.file).parent)
    return MeasurementSetup.model_construct(test=spec, model=model, detector=detector)


def _model(spec: MeasurementSpec) -> ResolvedJob | None:
    if spec.instrument is None:
        return None
    job = JobSpec.model_construct(instrument=spec.instrument, disturbances=spec.disturbances, analysis=spec.analysis)
    # its keys are called as the measurement's, so that faults are told at their lines
    told = job.with_source(spec.source)
    assert isinstance(told, JobSpec)
    model = resolve_job(told)
    if spec.exposure is None:
        return model
    monitor = model.instrument.monitor
    ccd = monitor.area_ccd.model_copy(update={"exposure": spec.exposure})
    instrument = model.instrument.model_copy(update={"monitor": monitor.model_copy(update={"area_ccd": ccd})})
    return model.model_copy(update={"instrument": instrument})


def _channels(spec: MeasurementSpec, model: ResolvedJob | None) -> tuple[str, ...]:
    if model is None:
        return tuple(f"{camera}/{side}" for camera in spec.geometry or {} for side in SIDES)
    instrument = model.instrument
    return tuple(f"{camera}/{side}" for camera in instrument.cameras for side in instrument.channels_of(camera))


def _located(spec: MeasurementSpec, channels: tuple[str, ...], base: Path) -> MeasurementSpec:
    """The measurement with all its files by their absolute paths."""
    update: dict[str, Any] = {}
    if isinstance(spec.frames, str):
        frames, times = _found(spec, base / spec.frames, channels)
        update |= {"times": times} if times else {}
    else:
        frames = dict(spec.frames)
        for name, files in frames.items():
            _known(spec, ("frames", name), name, channels)
            frames[name] = files.model_copy(
                update={
                    "before": _paths(spec, ("frames", name, BEFORE), files.before, base),
                    "after": tuple(
                        _paths(spec, ("frames", name, AFTER, k), entry, base) for k, entry in enumerate(files.after)
                    ),
                }
            )
    missing = [name for name in channels if name not in frames]
    if missing:
        text = f"no frames of {names_text(missing)}"
        raise spec.error(text, ("frames",), allowed="frames of every channel of the instrument, before and after")
    update["frames"] = FrozenMap({name: frames[name] for name in channels})
    for key in ("dark", "flat", "bad_pixels"):
        given: Mapping[str, tuple[str, ...]] | None = getattr(spec, key)
        if given is None:
            continue
        for name in given:
            _known(spec, (key, name), name, (*channels, ALL))
        update[key] = FrozenMap({name: _paths(spec, (key, name), files, base) for name, files in given.items()})
        left = [name for name in channels if name not in given and ALL not in given]
        if left:
            raise spec.error(f"none for {names_text(left)}", (key,), allowed=f"{ALL}: FILES, or files of every channel")
    return spec.model_copy(update=update)


def _known(spec: Spec, key: KeyPath, name: str, channels: Iterable[str]) -> None:
    known = tuple(channels)
    if name not in known:
        meant = nearest(name, known)
        raise spec.error("no such channel", key, found=name, allowed=names_text(known), suggestion=meant)


def _paths(spec: Spec, key: KeyPath, files: Iterable[str], base: Path) -> tuple[str, ...]:
    """Absolute paths. Raises InputError for a file that is not there."""
    out = []
    for file in files:
        place = base / file
        if not is_file(place):
            raise spec.error(unusable(place), key, allowed=_allowed(place), suggestion=_beside(place))
        out.append(str(place.absolute()))
    return tuple(out)


def _allowed(place: Path) -> str:
    return "an image file (TIFF, FITS, PNG), relative to the file that names it"


def _beside(place: Path) -> str | None:
    """The name in the same folder that was probably meant."""
    try:
        return nearest(place.name, sorted(one.name for one in place.parent.iterdir()))
    except (OSError, ValueError):
        return None


def _found(
    spec: MeasurementSpec, place: Path, channels: tuple[str, ...]
) -> tuple[dict[str, ChannelFramesSpec], tuple[float, ...]]:
    """Frames in a folder, or listed in a table; and the times of a series, none for a single state."""
    if is_file(place) and place.suffix.lower() == ".csv":
        return read_frame_table(place, channels)
    if is_file(place):
        raise spec.error(
            "neither a folder nor a table", ("frames",), found=spec.frames,
            allowed="a folder of frames, a .csv table of files, or CAMERA/SIDE: {before: FILE, after: FILE}",
        )  # fmt: skip
    try:
        names = sorted(one.name for one in place.iterdir())
    except (OSError, ValueError):
        raise spec.error(
            f"no such folder: {place}", ("frames",), allowed="a folder of frames, relative to this file"
        ) from None
    frames = {}
    for channel in channels:
        files = {}
        for when in (BEFORE, AFTER):
            stem = f"{channel.replace('/', '_')}_{when}"
            file = next((stem + ending for ending in ENDINGS if stem + ending in names), None)
            if file is None:
                raise spec.error(
                    f"no frames of {channel} {when} in {place}", ("frames",),
                    allowed=f"{stem}.tiff (or {', '.join(ENDINGS[1:])}), or CAMERA/SIDE: {{before: FILE, after: FILE}}",
                    suggestion=nearest(f"{stem}.tiff", names),
                )  # fmt: skip
            files[when] = (str((place / file).absolute()),)
        frames[channel] = ChannelFramesSpec.model_construct(before=files[BEFORE], after=(files[AFTER],))
    return frames, ()


def read_frame_table(path: Path, channels: tuple[str, ...]) -> tuple[dict[str, ChannelFramesSpec], tuple[float, ...]]:
    """Frames of every channel, by their absolute paths, and the times of a series; none for a single state.

    Args:
        path: of the CSV table.
        channels: that it has to list.

    Raises:
        InputError: the table cannot be read, with its line.
    """
    return _FrameTable(path, channels).read()


@dataclass(frozen=True)
class _FrameTable:
    """A CSV table with a row for each file: its channel, its time or state, the first pixel of its frames."""

    path: Path
    channels: tuple[str, ...]

    def read(self) -> tuple[dict[str, ChannelFramesSpec], tuple[float, ...]]:
        file, text = str(self.path), table_text(self.path, most=LARGEST_BYTES)
        reader = csv.reader(io.StringIO(text, newline=""))
        heads: list[str] = []
        seen: dict[str, dict[float | str, list[str]]] = {}
        corners: dict[tuple[str, bool], tuple[int, int]] = {}
        try:
            for row in reader:
                cells = [cell.strip() for cell in row]
                if not any(cells) or cells[0].startswith("#"):
                    continue
                if not heads:
                    heads = self._heads(cells, reader.line_num)
                    continue
                if len(cells) != len(heads):
                    text = f"{len(cells)} cells under {len(heads)} heads"
                    raise InputError(Issue(text, file, reader.line_num, allowed="as many cells as heads"))
                self._take(dict(zip(heads, cells, strict=True)), reader.line_num, seen, corners)
        except csv.Error as error:
            raise InputError(Issue(f"not a CSV file: {error}", file, reader.line_num)) from None
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
        seen: dict[str, dict[float | str, list[str]]],
        corners: dict[tuple[str, bool], tuple[int, int]],
    ) -> None:
        file = str(self.path)
        channel = row["channel"]
        if channel not in self.channels:
            meant = nearest(channel, self.channels)
            issue = Issue("no such channel", file, line, ("channel",), shown(channel), names_text(self.channels), meant)
            raise InputError(issue)
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
        place = self.path.parent / row["file"]
        if not is_file(place):
            raise InputError(Issue(unusable(place), file, line, ("file",), None, _allowed(place), _beside(place)))
        seen.setdefault(channel, {}).setdefault(when, []).append(str(place.absolute()))
        if "row" in row:
            corner = []
            for name in ("row", "column"):
                if not re.fullmatch(r"[0-9]{1,5}", row[name]):
                    raise InputError(Issue("not a pixel", file, line, (name,), shown(row[name]), "a whole number"))
                corner.append(int(row[name]))
            key = (channel, when == BEFORE)
            if corners.setdefault(key, (corner[0], corner[1])) != (corner[0], corner[1]):
                text = "another first pixel than in the rows before"
                raise InputError(Issue(text, file, line, ("row",), shown(corner), "the same for all after a state"))

    def _frames(
        self, seen: dict[str, dict[float | str, list[str]]], corners: dict[tuple[str, bool], tuple[int, int]]
    ) -> tuple[dict[str, ChannelFramesSpec], tuple[float, ...]]:
        file = str(self.path)
        states = {when for one in seen.values() for when in one if when != BEFORE}
        order = sorted(states, key=lambda when: when if isinstance(when, float) else 0.0)
        if not order or len(order) > MOST_TIMES:
            raise InputError(Issue(f"{len(order)} states after", file, None, allowed=f"1 to {MOST_TIMES}"))
        frames = {}
        for channel in self.channels:
            one = seen.get(channel, {})
            for when in (BEFORE, *order):
                if when not in one:
                    told = when if isinstance(when, str) else f"at {moment(when)}"
                    raise InputError(Issue(f"no file of {channel} {told}", file, None, allowed="a row for each state"))
            after = corners.get((channel, False), (0, 0))
            frames[channel] = ChannelFramesSpec.model_construct(
                before=tuple(one[BEFORE]),
                after=tuple(tuple(one[when]) for when in order),
                offset=corners.get((channel, True), (0, 0)),
                offset_after=after,
            )
        times = tuple(when for when in order if isinstance(when, float))
        return frames, times
