"""The files of a measurement, read: frames of every channel in every state, and whether they are what is said."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from analysis.images.image_file import ImageError, ImageFile, recording_origin
from analysis.spots.frame_screening import FramesError
from analysis.spots.noise import NoiseModel
from analysis.spots.photon_transfer import PhotonTransfer, PixelCorrection, photon_transfer, pixel_correction
from scenes.specs.course import moment
from scenes.specs.detector import DetectorSpec
from scenes.specs.monitor_frames import AFTER, BEFORE, MeasurementSetup, MeasurementSpec, per_channel
from scenes.yaml.errors import InputError, Issue, KeyPath
from scenes.yaml.spec import Spec
from twin.framework.frame_store import IN_MEMORY, PART, frame_room, let_go
from twin.framework.memory import Lowered, require_memory

_OTHER_FILES = "frames that were recorded one by one, each named once: the right files of before and after"
NOMINAL, PERTURBED = "nominal", "perturbed"
"""Notes that the main job leaves in its frames."""
_GREY, _MAPS = 2.0, 77.0
"""Bytes per pixel of a frame, and of the maps of a state: of the search, of the fits and of their covariance."""


def repeated_frames(test: Spec, channels: Sequence[ChannelFrames]) -> list[Issue]:
    """What is said of frames that stand twice in a measurement, to the last pixel; one issue for each two states.

    Noise is another one in every frame, so that two are never alike: one of them is a copy, and shift and sigma would
    be those of frames against themselves. Frames of one grey value alone hold no noise, and are not looked at.

    Parameters
    ----------
    test : Spec
        The measurement.
    channels : Sequence[ChannelFrames]
        As they were read.
    """
    seen: dict[bytes, tuple[StateFrames, int]] = {}
    told: set[tuple[int, int]] = set()
    out: list[Issue] = []
    for channel in channels:
        for state in channel.states:
            for number, digest in _digests(state):
                first, before = seen.setdefault(digest, (state, number))
                pair = (id(first), id(state))
                if (first is state and before == number) or pair in told:
                    continue
                told.add(pair)
                text = (
                    f"frame {number + 1} of {channel.name} in {_files(state)} is frame {before + 1} of {_files(first)},"
                    " to the last pixel: a copy tells nothing of what has moved, and has no noise of its own"
                )
                out.append(test.issue(text, state.key, allowed=_OTHER_FILES))
    return out


def _digests(state: StateFrames) -> Iterator[tuple[int, bytes]]:
    for number, frame in enumerate(state.frames):
        # files of several types may hold the same grey values
        values = np.ascontiguousarray(frame, dtype=np.float64)
        if values.min() < values.max():
            shape = f"{values.shape}".encode()
            yield number, hashlib.blake2b(values.tobytes() + shape, digest_size=16).digest()
    let_go(state.frames)


def _files(state: StateFrames) -> str:
    return state.files[0] + (f" and {len(state.files) - 1} more" if len(state.files) > 1 else "")


def order_warnings(channels: Sequence[ChannelFrames], times: Sequence[float] | None) -> tuple[str, ...]:
    """Warnings where files say themselves that they were recorded in another order than the measurement takes them for.

    Told only of channels of which every file says when it was recorded, or what it is of.

    Parameters
    ----------
    channels : Sequence[ChannelFrames]
        As they were read.
    times : Sequence[float] | None
        Of a series, seconds; None for a single state after.
    """
    out = []
    swapped = [channel.name for channel in channels if _swapped(channel)]
    if swapped:
        out.append(
            f"before and after seem to be exchanged ({', '.join(swapped)}): by their time stamps, the "
            "frames after were recorded before those before; all changes then have the wrong sign"
        )
    elif times is not None:
        mixed = {name: at for channel in channels for name, at in [(channel.name, _not_ascending(channel))] if at}
        if mixed:
            name, at = next(iter(mixed.items()))
            out.append(
                f"{', '.join(mixed)}: by their time stamps, the frames of the series were recorded in an "
                f"order that differs from `times`, first {name} at {moment(times[at])}"
            )
    return tuple(out)


def _recorded(state: StateFrames) -> tuple[datetime, ...]:
    """Recording times of all files; empty if one file gives none."""
    found = [time for time, _ in state.origin if time is not None]
    return tuple(found) if found and len(found) == len(state.origin) else ()


def _swapped(channel: ChannelFrames) -> bool:
    notes = [{note for state in states for _, note in state.origin} for states in ((channel.before,), channel.after)]
    if notes == [{PERTURBED}, {NOMINAL}]:
        return True
    every = [_recorded(state) for state in channel.states]
    return all(every) and min(every[0]) > max(max(times) for times in every[1:])


def _not_ascending(channel: ChannelFrames) -> int:
    """Number of the first time that was recorded before the one before it; 0 for none."""
    every = [_recorded(state) for state in channel.after]
    if not all(every):
        return 0
    return next((k for k, (one, two) in enumerate(pairwise(every), 1) if max(two) < min(one)), 0)


Shape = tuple[int, int]

_MOST_GREY = 2.0**32
"""Largest grey value, either sign: of a converter of 32 bits, beyond any that there is."""


@dataclass(frozen=True, eq=False)
class StateFrames:
    """Frames of one channel in one state.

    Attributes
    ----------
    files : tuple[str, ...]
        They are from, by their paths.
    frames : np.ndarray
        (N, H, W) grey values as recorded.
    offset : Shape
        Row and column of the CCD at which they begin.
    key : KeyPath
        Where they stand in the measurement's file.
    origin : tuple[tuple[datetime | None, str], ...]
        Of each file when it was recorded, and the note in it, as far as it says so.
    """

    files: tuple[str, ...]
    frames: np.ndarray
    offset: Shape
    key: KeyPath
    origin: tuple[tuple[datetime | None, str], ...] = ()

    @property
    def shape(self) -> Shape:
        """Rows and columns."""
        return self.frames.shape[1], self.frames.shape[2]

    def of_ccd(self, whole: np.ndarray) -> np.ndarray:
        """The part of a map of the whole CCD, (rows, columns), that the frames show."""
        (row, column), (height, width) = self.offset, self.shape
        return whole[row : row + height, column : column + width]

    def bad_part(self, bad: np.ndarray | None) -> np.ndarray | None:
        """The part of a map of bad pixels of the whole CCD that the frames show; None for no map."""
        return None if bad is None else self.of_ccd(bad)


@dataclass(frozen=True, eq=False)
class ChannelFrames:
    """All frames of one channel.

    Attributes
    ----------
    name : str
        ``CAMERA/CHANNEL``.
    ccd : Shape
        Rows and columns of its CCD.
    before : StateFrames
        Of the nominal state.
    after : tuple[StateFrames, ...]
        Of each state to be measured.
    bad : np.ndarray | None
        (rows, columns) of the CCD: pixels of the bad-pixel map; None for none.
    correction : PixelCorrection | None
        Of its pixels by dark and flat frames; None without.
    transfer : PhotonTransfer | None
        Measured photon transfer; None where the data sheet's is used.
    noise : NoiseModel
        Of the detector, as the corrected frames have it.
    raw_noise : NoiseModel
        As the frames as recorded have it.
    """

    name: str
    ccd: Shape
    before: StateFrames
    after: tuple[StateFrames, ...]
    bad: np.ndarray | None
    correction: PixelCorrection | None
    transfer: PhotonTransfer | None
    noise: NoiseModel
    raw_noise: NoiseModel

    @property
    def states(self) -> tuple[StateFrames, ...]:
        """Before, then all after."""
        return (self.before, *self.after)


def read_measurement(
    setup: MeasurementSetup, noise: NoiseModel, ccd: Shape | None, advance: Callable[[int], None]
) -> tuple[ChannelFrames, ...]:
    """Read all files of a measurement.

    Parameters
    ----------
    setup : MeasurementSetup
        The measurement.
    noise : NoiseModel
        Of the CCDs by their data sheet.
    ccd : Shape | None
        Rows and columns of the instrument's CCDs; None to take those of the frames before.
    advance : Callable[[int], None]
        Told how many channels are read.

    Raises
    ------
    InputError
        Files that cannot be read or do not fit; one issue for each channel.
    """
    _require_memory(setup.test)
    out: list[ChannelFrames] = []
    issues: list[Issue] = []
    for number, name in enumerate(setup.channels):
        try:
            out.append(_channel(setup.test, name, noise, ccd, setup.detector))
        except InputError as error:
            issues += error.issues
        advance(number + 1)
    if issues:
        raise InputError(*issues)
    return tuple(out)


def _require_memory(test: MeasurementSpec) -> None:
    """See whether the frames that are kept, and the maps of every state, fit into the memory, by the headers of one
    file of each channel and state. One that cannot be read is told in its place.
    """
    assert not isinstance(test.frames, str)
    if test.times is None:
        return
    each = 0.0
    for files in test.frames.values():
        after = test.states(files)[0]
        try:
            head = ImageFile.open(Path(after[0]), choose="").header
        except (ImageError, OSError):
            continue
        pixels = head.rows * head.columns
        frames = pixels * len(head.pages) * len(after) * _GREY
        each += pixels * _MAPS + (frames if frames <= IN_MEMORY else 0.0)
    require_memory(Lowered(test, ("times",), len(test.times), "times", lambda times: (1 + times) * each))


def _channel(
    test: MeasurementSpec, name: str, noise: NoiseModel, ccd: Shape | None, detector: DetectorSpec
) -> ChannelFrames:
    assert not isinstance(test.frames, str)
    files = test.frames[name]
    key: KeyPath = ("frames", name)
    before = _state(test, files.before, files.offset, (*key, BEFORE))
    offset = files.offset if files.offset_after is None else files.offset_after
    after = tuple(_state(test, one, offset, (*key, AFTER)) for one in test.states(files))
    if ccd is None:
        every = (before, *after)
        ccd = (
            max(state.offset[0] + state.shape[0] for state in every),
            max(state.offset[1] + state.shape[1] for state in every),
        )
    for state in (before, *after):
        _check_place(test, state, ccd)
        _check_values(test, state, detector)
    stated = "offset" in files.model_fields_set
    _check_part(test, before, before.shape == ccd or stated, f"the CCD of {ccd[0]} x {ccd[1]} pixels", "offset")
    same = before.shape if stated else ccd
    for state in after:
        known = state.shape == (same if files.offset_after is None else after[0].shape)
        _check_part(test, state, known, f"the frames before or those of the CCD, {same[0]} x {same[1]}", "offset_after")
    dark, flat = (_maps(test, what, name, ccd, before) for what in ("dark", "flat"))
    bad = _bad(test, name, ccd, before)
    transfer = correction = None
    raw = noise
    try:
        if test.photon_transfer == "measured":
            assert dark is not None
            assert flat is not None
            transfer = photon_transfer(dark, flat)
            raw = transfer.noise_model(noise)
        if dark is not None:
            correction = pixel_correction(raw, dark, flat)
    except FramesError as error:
        which = "flat" if "flat" in str(error) else "dark"
        raise _told(test, (which,), str(error), error.remedy) from error
    if correction is not None and correction.dark.shape != ccd:
        correction = _placed(correction, ccd, before)
    corrected = raw if correction is None else correction.noise
    return ChannelFrames(name, ccd, before, after, bad, correction, transfer, corrected, raw)


def _told(test: Spec, key: KeyPath, problem: str, remedy: str) -> InputError:
    return test.error(problem, key, allowed=remedy)


def _state(test: Spec, files: tuple[str, ...], offset: Shape, key: KeyPath) -> StateFrames:
    frames = _stacked(test, files, key)
    if min(frames.shape[1:]) < 24:
        text = f"{files[0]} has frames of {frames.shape[1]} x {frames.shape[2]} pixels"
        raise _told(test, key, text, "24 rows and columns or more, to measure a spot in")
    return StateFrames(files, frames, offset, key, tuple(recording_origin(Path(file)) for file in files))


def _stacked(test: Spec, files: tuple[str, ...], key: KeyPath) -> np.ndarray:
    """Frames of all files one after the other, (N, H, W), in a file of no name where they are many."""
    images = [_opened(test, file, key) for file in files]
    room: np.ndarray | None = None
    count = held = 0
    for file, image in zip(files, images, strict=True):
        for page in _pages(test, file, image, key):
            if room is None:
                shape, kind = page.shape, page.dtype
                room = frame_room((sum(len(one.header.pages) for one in images), *shape), kind)
            if page.shape != shape:
                sizes = (" x ".join(map(str, size)) for size in (shape, page.shape))
                text = f"{files[0]} and {file} have frames of different sizes, {' and '.join(sizes)}"
                raise _told(test, key, text, "frames of one size in one state")
            if np.result_type(kind, page.dtype) != kind:
                kind = np.result_type(kind, page.dtype)
                wider = frame_room(room.shape, kind)
                wider[:count] = room[:count]
                room = wider
            room[count] = page
            count, held = count + 1, held + page.nbytes
            if held > PART:
                let_go(room)
                held = 0
    assert room is not None  # a file without pages is none
    let_go(room)
    return room


def _opened(test: Spec, file: str, key: KeyPath) -> ImageFile:
    """The image of a file, whose header is read; raw frames alone."""
    with _readable(test, file, key):
        image = ImageFile.open(Path(file), choose="")
        if image.header.orientation:
            raise ImageError(f"{file} is stored turned or mirrored ({image.header.orientation}): save it as it was read out")
        if image.header.coded:
            raise ImageError(f"{file}: {image.header.coded}, which is not linear in light: give raw frames")
        return image


def _pages(test: Spec, file: str, image: ImageFile, key: KeyPath) -> Iterator[np.ndarray]:
    """Frames of a file, whose grey values a converter could give."""
    largest = 0.0
    with _readable(test, file, key):
        for page in image.pages():
            largest = max(largest, float(np.max(np.abs(page), where=np.isfinite(page), initial=0.0)))
            yield page
    if largest > _MOST_GREY:
        text = f"{file} has grey values up to {largest:.3g}"
        raise _told(test, key, text, f"grey values of a converter, at most {_MOST_GREY:g}")


@contextmanager
def _readable(test: Spec, file: str, key: KeyPath) -> Iterator[None]:
    """What is wrong with a file told at its place in the measurement."""
    try:
        yield
    except ImageError as error:
        raise _told(test, key, str(error), "raw frames of a CCD: TIFF, FITS, 16-bit PNG") from error
    except OSError as error:
        raise _told(test, key, f"{file}: {error.strerror or error}", "a file that can be read") from error


def _check_place(test: Spec, state: StateFrames, ccd: Shape) -> None:
    ends = [first + size for first, size in zip(state.offset, state.shape, strict=True)]
    if ends[0] > ccd[0] or ends[1] > ccd[1]:
        text = f"{state.files[0]}: frames of {state.shape[0]} x {state.shape[1]} pixels"
        where = f" from row {state.offset[0]} and column {state.offset[1]} on" if any(state.offset) else ""
        raise _told(
            test, state.key, f"{text}{where} do not lie on the CCD of {ccd[0]} x {ccd[1]} pixels",
            "frames of the instrument's area CCD or a part of it with its offset; or rows and columns of area_ccd in"
            " the instrument that are those of the frames",
        )  # fmt: skip


def _check_part(test: Spec, state: StateFrames, known: bool, others: str, key: str) -> None:
    """See whether it is stated which part of the CCD the frames of a state show. Raises InputError."""
    if not known:
        text = f"{state.files[0]}: frames of {state.shape[0]} x {state.shape[1]} pixels are not of the size of {others}"
        remedy = f"{key}: [ROW, COLUMN] of the CCD at which they begin, one size for all frames of a series"
        raise _told(test, state.key, f"{text}, and nothing says where they begin", remedy)


def _check_values(test: Spec, state: StateFrames, detector: DetectorSpec) -> None:
    """See whether the converter can give the grey values of frames that are whole numbers. Raises InputError."""
    largest, bits, different = 0, 0, False
    for frame in state.frames:
        values = frame[np.isfinite(frame)]
        whole = values.astype(np.int64)
        if not np.array_equal(values, whole):
            break
        different = different or (whole.size > 0 and int(whole.min()) < int(whole.max()))
        largest, bits = max(largest, int(whole.max(initial=0))), bits | int(np.bitwise_or.reduce(whole, initial=0))
    else:
        step, most = bits & -bits if different else 1, detector.max_dn
        if largest > most or step > 1:
            text = f"{state.files[0]} has grey values up to {largest}"
            text += f", all multiples of {step}" if step > 1 else ""
            text += f"; the converter of {detector.name} with {detector.bit_depth} bits gives 0 to {most} in steps of 1"
            remedy = f"frames divided by {step}: they are aligned to the left" if step > 1 else "the right `detector`"
            raise _told(test, state.key, text, remedy)
    let_go(state.frames)


def _maps(test: MeasurementSpec, what: str, name: str, ccd: Shape, before: StateFrames) -> np.ndarray | None:
    """Dark or flat frames of a channel, of the whole CCD or of the part that the frames before show."""
    given: Any = getattr(test, what)
    files = per_channel(given, name)
    if not files:
        return None
    key: KeyPath = (what, name if name in given else "all")
    stack = _stacked(test, files, key)
    if stack.shape[1:] not in (ccd, before.shape):
        text = f"{files[0]} has frames of {stack.shape[1]} x {stack.shape[2]} pixels"
        raise _told(test, key, text, f"frames of the CCD, {ccd[0]} x {ccd[1]}, or of the same part as the others")
    return stack


def _placed(correction: PixelCorrection, ccd: Shape, before: StateFrames) -> PixelCorrection:
    """On the whole CCD; pixels that were not calibrated are bad."""
    dark, response, bad = np.zeros(ccd), np.ones(ccd), np.ones(ccd, dtype=bool)
    before.of_ccd(dark)[...] = correction.dark
    before.of_ccd(response)[...] = correction.response
    before.of_ccd(bad)[...] = correction.bad
    return PixelCorrection(dark, response, bad, correction.noise)


def _bad(test: MeasurementSpec, name: str, ccd: Shape, before: StateFrames) -> np.ndarray | None:
    stack = _maps(test, "bad_pixels", name, ccd, before)
    if stack is None:
        return None
    marked = np.asarray((stack != 0).any(axis=0))
    if marked.shape == ccd:
        return marked
    whole = np.zeros(ccd, dtype=bool)
    before.of_ccd(whole)[...] = marked
    return whole


def cannot_measure(test: Spec, state: StateFrames, channel: str, reason: str, remedy: str) -> Issue:
    """What is said of frames in which no spot can be measured.

    Parameters
    ----------
    test : Spec
        The measurement.
    state : StateFrames
        The frames.
    channel : str
        whose.
    reason : str
        Why not.
    remedy : str
        What to do about it.
    """
    files = state.files[0] + (f" and {len(state.files) - 1} more" if len(state.files) > 1 else "")
    return test.issue(f"the spot of {channel} cannot be measured in {files}: {reason}", state.key, allowed=remedy)
