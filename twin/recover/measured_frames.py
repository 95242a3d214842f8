"""Files of a measurement: reading and checking the frames of every monitor channel in every state."""

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
from twin.framework.frame_store import IN_MEMORY, PART, allocate_frames, release_memory
from twin.framework.memory import Lowered, require_memory

_OTHER_FILES = "different frames, each named once: the correct files of before and after"
NOMINAL, PERTURBED = "nominal", "perturbed"
"""Notes in the metadata of the main job's frames, which tell whether they show the nominal or the perturbed state."""
_GREY, _MAPS = 2.0, 77.0
"""Memory per pixel, in bytes: of a frame; and of all maps of a state (artefact search, fits and their covariance)."""


def repeated_frames(test: Spec, channels: Sequence[ChannelFrames]) -> list[Issue]:
    """Return issues of frames that occur twice, identical to the last pixel, one for each pair of states.

    Noise differs in every frame, so that one of two identical frames is a copy, and shift and sigma would be those of
    frames against themselves. Frames of a single grey value have no noise and are not compared.

    Parameters
    ----------
    test : Spec
        Measurement.
    channels : Sequence[ChannelFrames]
        Frames as they were read.
    """
    frames_by_digest: dict[bytes, tuple[StateFrames, int]] = {}
    reported: set[tuple[int, int]] = set()
    out: list[Issue] = []
    for channel in channels:
        for state in channel.states:
            for number, digest in _digests(state):
                first, before = frames_by_digest.setdefault(digest, (state, number))
                pair = (id(first), id(state))
                if (first is state and before == number) or pair in reported:
                    continue
                reported.add(pair)
                text = (
                    f"frame {number + 1} of {channel.name} in {_files(state)} is frame {before + 1} of {_files(first)},"
                    " to the last pixel: a copy has no information on motions, and no independent noise"
                )
                out.append(test.issue(text, state.key, allowed=_OTHER_FILES))
    return out


def _digests(state: StateFrames) -> Iterator[tuple[int, bytes]]:
    for number, frame in enumerate(state.frames):
        # files of different types may have the same grey values
        values = np.ascontiguousarray(frame, dtype=np.float64)
        if values.min() < values.max():
            shape = f"{values.shape}".encode()
            yield number, hashlib.blake2b(values.tobytes() + shape, digest_size=16).digest()
    release_memory(state.frames)


def _files(state: StateFrames) -> str:
    return state.files[0] + (f" and {len(state.files) - 1} more" if len(state.files) > 1 else "")


def order_warnings(channels: Sequence[ChannelFrames], times: Sequence[float] | None) -> tuple[str, ...]:
    """Return warnings where the files' metadata contradict the order of states in which the measurement uses them.

    A channel is checked only if all its files have a recording time, or all have a note of their state.

    Parameters
    ----------
    channels : Sequence[ChannelFrames]
        Frames as they were read.
    times : Sequence[float] or None
        Times of a series, in seconds; None for a single state after.
    """
    warnings = []
    swapped = [channel.name for channel in channels if _swapped(channel)]
    if swapped:
        warnings.append(
            f"before and after seem to be exchanged ({', '.join(swapped)}): by their time stamps or notes, the "
            "frames after were recorded first; all changes then have the wrong sign"
        )
    elif times is not None:
        mixed = {name: at for channel in channels for name, at in [(channel.name, _not_ascending(channel))] if at}
        if mixed:
            name, at = next(iter(mixed.items()))
            warnings.append(
                f"{', '.join(mixed)}: by their time stamps, the frames of the series were recorded in an "
                f"order that differs from `times`, first {name} at {moment(times[at])}"
            )
    return tuple(warnings)


def _recorded(state: StateFrames) -> tuple[datetime, ...]:
    """Return the recording times of all files; empty if one file has none."""
    times = [time for time, _ in state.origin if time is not None]
    return tuple(times) if times and len(times) == len(state.origin) else ()


def _swapped(channel: ChannelFrames) -> bool:
    notes = [{note for state in states for _, note in state.origin} for states in ((channel.before,), channel.after)]
    if notes == [{PERTURBED}, {NOMINAL}]:
        return True
    times_by_state = [_recorded(state) for state in channel.states]
    return all(times_by_state) and min(times_by_state[0]) > max(max(times) for times in times_by_state[1:])


def _not_ascending(channel: ChannelFrames) -> int:
    """Return the index of the first state that was recorded before its predecessor; 0 if there is none."""
    times_by_state = [_recorded(state) for state in channel.after]
    if not all(times_by_state):
        return 0
    return next((k for k, (earlier, later) in enumerate(pairwise(times_by_state), 1) if max(later) < min(earlier)), 0)


Shape = tuple[int, int]

_MOST_GREY = 2.0**32
"""Largest magnitude of a grey value, in DN: that of a 32-bit converter, more than any camera has."""


@dataclass(frozen=True, eq=False)
class StateFrames:
    """Frames of one channel in one state.

    Attributes
    ----------
    files : tuple of str
        Paths of the files.
    frames : (N, H, W) ndarray
        Grey values of N frames of H rows and W columns as recorded, DN.
    offset : (int, int)
        Row and column of the CCD at which the frames begin.
    key : KeyPath
        Key of the frames in the measurement's file.
    origin : tuple of (datetime or None, str)
        Recording time and note of each file, as far as it has them.
    """

    files: tuple[str, ...]
    frames: np.ndarray
    offset: Shape
    key: KeyPath
    origin: tuple[tuple[datetime | None, str], ...] = ()

    @property
    def shape(self) -> Shape:
        """Rows and columns of a frame."""
        return self.frames.shape[1], self.frames.shape[2]

    def of_ccd(self, whole: np.ndarray) -> np.ndarray:
        """Return the part that the frames show of a map ``whole`` (rows, columns) of the whole CCD."""
        (row, column), (height, width) = self.offset, self.shape
        return whole[row : row + height, column : column + width]

    def bad_part(self, bad: np.ndarray | None) -> np.ndarray | None:
        """Return the part that the frames show of the whole CCD's map of bad pixels; None without a map."""
        return None if bad is None else self.of_ccd(bad)


@dataclass(frozen=True, eq=False)
class ChannelFrames:
    """Frames of one channel in all states, with its CCD.

    Attributes
    ----------
    name : str
        Name as ``CAMERA/CHANNEL``.
    ccd : (int, int)
        Rows and columns of its CCD.
    before : StateFrames
        Frames of the nominal state.
    after : tuple of StateFrames
        Frames of each state to be measured.
    bad : (rows, columns) ndarray of bool, or None
        Pixels of the bad-pixel map; None without a map.
    correction : PixelCorrection or None
        Correction of its pixels by dark and flat frames; None without them.
    transfer : PhotonTransfer or None
        Gain and read noise measured from frames by the photon-transfer method; None where those of the data sheet are
        used.
    noise : NoiseModel
        Noise model of the corrected frames.
    raw_noise : NoiseModel
        Noise model of the frames as recorded.
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
        """Frames of the state before, then of all states after."""
        return (self.before, *self.after)


def read_measurement(
    setup: MeasurementSetup, noise: NoiseModel, ccd: Shape | None, advance: Callable[[int], None]
) -> tuple[ChannelFrames, ...]:
    """Read all files of a measurement.

    Parameters
    ----------
    setup : MeasurementSetup
        Measurement.
    noise : NoiseModel
        Noise model of the CCDs by their data sheet.
    ccd : (int, int) or None
        Rows and columns of the instrument's CCDs; None takes them from the frames before.
    advance : callable
        Called with the number of channels read.

    Raises
    ------
    InputError
        Files cannot be read or do not fit; one issue for each channel.
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
    """Check that the frames kept in memory and the maps of every state fit into memory.

    Sizes are taken from the header of one file per state. Files that cannot be read are skipped here and reported when
    they are read.

    Raises
    ------
    InputError
        Memory does not suffice.
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
    after = tuple(_state(test, reference, offset, (*key, AFTER)) for reference in test.states(files))
    if ccd is None:
        times_by_state = (before, *after)
        ccd = (
            max(state.offset[0] + state.shape[0] for state in times_by_state),
            max(state.offset[1] + state.shape[1] for state in times_by_state),
        )
    for state in (before, *after):
        _check_within_ccd(test, state, ccd)
        _check_values(test, state, detector)
    has_offset = "offset" in files.model_fields_set
    _check_part(test, before, before.shape == ccd or has_offset, f"the CCD of {ccd[0]} x {ccd[1]} pixels", "offset")
    same = before.shape if has_offset else ccd
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
        raise _input_error(test, (which,), str(error), error.remedy) from error
    if correction is not None and correction.dark.shape != ccd:
        correction = _placed(correction, ccd, before)
    corrected = raw if correction is None else correction.noise
    return ChannelFrames(name, ccd, before, after, bad, correction, transfer, corrected, raw)


def _input_error(test: Spec, key: KeyPath, problem: str, remedy: str) -> InputError:
    return test.error(problem, key, allowed=remedy)


def _state(test: Spec, files: tuple[str, ...], offset: Shape, key: KeyPath) -> StateFrames:
    frames = _stacked(test, files, key)
    if min(frames.shape[1:]) < 24:
        text = f"{files[0]} has frames of {frames.shape[1]} x {frames.shape[2]} pixels"
        raise _input_error(test, key, text, "at least 24 rows and columns, which a spot measurement needs")
    return StateFrames(files, frames, offset, key, tuple(recording_origin(Path(file)) for file in files))


def _stacked(test: Spec, files: tuple[str, ...], key: KeyPath) -> np.ndarray:
    """Return the N frames of all files in order, each H rows by W columns, (N, H, W).

    Many frames are kept in an unnamed temporary file.
    """
    images = [_opened(test, file, key) for file in files]
    stack: np.ndarray | None = None
    count = unreleased = 0
    for file, image in zip(files, images, strict=True):
        for page in _pages(test, file, image, key):
            if stack is None:
                shape, kind = page.shape, page.dtype
                stack = allocate_frames((sum(len(frame_file.header.pages) for frame_file in images), *shape), kind)
            if page.shape != shape:
                sizes = (" x ".join(map(str, size)) for size in (shape, page.shape))
                text = f"{files[0]} and {file} have frames of different sizes, {' and '.join(sizes)}"
                raise _input_error(test, key, text, "frames of one size in one state")
            if np.result_type(kind, page.dtype) != kind:
                kind = np.result_type(kind, page.dtype)
                wider_stack = allocate_frames(stack.shape, kind)
                wider_stack[:count] = stack[:count]
                stack = wider_stack
            stack[count] = page
            count, unreleased = count + 1, unreleased + page.nbytes
            if unreleased > PART:
                release_memory(stack)
                unreleased = 0
    assert stack is not None  # a file without pages is none
    release_memory(stack)
    return stack


def _opened(test: Spec, file: str, key: KeyPath) -> ImageFile:
    """Open an image file and read its header; raise InputError unless it has raw grey values."""
    with _readable(test, file, key):
        image = ImageFile.open(Path(file), choose="")
        if image.header.orientation:
            raise ImageError(f"{file} is stored rotated or mirrored ({image.header.orientation}): save it as read out")
        if image.header.coded:
            raise ImageError(f"{file}: {image.header.coded}, which is not linear in light: give raw frames")
        return image


def _pages(test: Spec, file: str, image: ImageFile, key: KeyPath) -> Iterator[np.ndarray]:
    """Yield the frames of an image file; raise InputError if grey values are beyond the range of any converter."""
    largest = 0.0
    with _readable(test, file, key):
        for page in image.pages():
            largest = max(largest, float(np.max(np.abs(page), where=np.isfinite(page), initial=0.0)))
            yield page
    if largest > _MOST_GREY:
        text = f"{file} has grey values up to {largest:.3g}"
        raise _input_error(test, key, text, f"grey values of an analogue-to-digital converter, at most {_MOST_GREY:g}")


@contextmanager
def _readable(test: Spec, file: str, key: KeyPath) -> Iterator[None]:
    """Raise errors of reading a file as InputError at its key in the measurement (a context manager)."""
    try:
        yield
    except ImageError as error:
        raise _input_error(test, key, str(error), "raw frames of a CCD: TIFF, FITS, 16-bit PNG") from error
    except OSError as error:
        raise _input_error(test, key, f"{file}: {error.strerror or error}", "a readable file") from error


def _check_within_ccd(test: Spec, state: StateFrames, ccd: Shape) -> None:
    ends = [first + size for first, size in zip(state.offset, state.shape, strict=True)]
    if ends[0] > ccd[0] or ends[1] > ccd[1]:
        text = f"{state.files[0]}: frames of {state.shape[0]} x {state.shape[1]} pixels"
        where = f" from row {state.offset[0]} and column {state.offset[1]}" if any(state.offset) else ""
        raise _input_error(
            test, state.key, f"{text}{where} do not lie on the CCD of {ccd[0]} x {ccd[1]} pixels",
            "frames of the instrument's area CCD or of a part of it with its offset; or the rows and columns of the"
            " frames as area_ccd of the instrument",
        )  # fmt: skip


def _check_part(test: Spec, state: StateFrames, known: bool, others: str, key: str) -> None:
    """Check that the measurement's file gives the part of the CCD that a state's frames show, where it is not known.

    Raises
    ------
    InputError
        The part is not specified.
    """
    if not known:
        text = f"{state.files[0]}: frames of {state.shape[0]} x {state.shape[1]} pixels are not of the size of {others}"
        remedy = f"{key}: [ROW, COLUMN] of the CCD at which they begin, and one size for all frames of a series"
        raise _input_error(test, state.key, f"{text}, and their offset is not specified", remedy)


def _check_values(test: Spec, state: StateFrames, detector: DetectorSpec) -> None:
    """Check that the grey values of integer frames are in the range of the detector's converter.

    Raises
    ------
    InputError
        A grey value is out of range.
    """
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
            remedy = f"frames divided by {step}: they are left-aligned" if step > 1 else "the correct `detector`"
            raise _input_error(test, state.key, text, remedy)
    release_memory(state.frames)


def _maps(test: MeasurementSpec, what: str, name: str, ccd: Shape, before: StateFrames) -> np.ndarray | None:
    """Return the dark or flat frames of a channel, for the whole CCD or the part that the frames before show.

    ``what`` tells which of the two; the result is None if the measurement has none.
    """
    maps: Any = getattr(test, what)
    files = per_channel(maps, name)
    if not files:
        return None
    key: KeyPath = (what, name if name in maps else "all")
    stack = _stacked(test, files, key)
    if stack.shape[1:] not in (ccd, before.shape):
        text = f"{files[0]} has frames of {stack.shape[1]} x {stack.shape[2]} pixels"
        raise _input_error(
            test, key, text, f"frames of the CCD, {ccd[0]} x {ccd[1]}, or of the same part as the others"
        )
    return stack


def _placed(correction: PixelCorrection, ccd: Shape, before: StateFrames) -> PixelCorrection:
    """Return a pixel correction of the whole CCD from that of a part; pixels that were not calibrated count as bad."""
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
    """Return the issue of frames in which no spot can be measured.

    Parameters
    ----------
    test : Spec
        Measurement.
    state : StateFrames
        Frames of the state.
    channel : str
        Name of the channel.
    reason : str
        Reason why the spot cannot be measured.
    remedy : str
        What to do about it.
    """
    files = state.files[0] + (f" and {len(state.files) - 1} more" if len(state.files) > 1 else "")
    return test.issue(f"the spot of {channel} cannot be measured in {files}: {reason}", state.key, allowed=remedy)
