"""Whether frames are what the measurement's file takes them for: recorded one by one, before and after."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from datetime import datetime
from itertools import pairwise

import numpy as np

from scenes.specs.course import moment
from scenes.yaml.errors import Issue
from scenes.yaml.spec import Spec
from twin.recover.measured_frames import ChannelFrames, StateFrames

__all__ = ["order_warnings", "repeated_frames"]

_OTHER_FILES = "frames that were recorded one by one, each named once: the right files of before and after"
NOMINAL, PERTURBED = "nominal", "perturbed"
"""Notes that the main job leaves in its frames."""


def repeated_frames(test: Spec, channels: Sequence[ChannelFrames]) -> list[Issue]:
    """What is said of frames that stand twice in a measurement, to the last pixel; one issue for each two states.

    Noise is another one in every frame, so that two are never alike: one of them is a copy, and shift and sigma would
    be those of frames against themselves. Frames of one grey value alone hold no noise, and are not looked at.

    Args:
        test: the measurement.
        channels: as they were read.
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


def _files(state: StateFrames) -> str:
    return state.files[0] + (f" and {len(state.files) - 1} more" if len(state.files) > 1 else "")


def order_warnings(channels: Sequence[ChannelFrames], times: Sequence[float] | None) -> tuple[str, ...]:
    """Warnings where files say themselves that they were recorded in another order than the measurement takes them for.

    Told only of channels of which every file says when it was recorded, or what it is of.

    Args:
        channels: as they were read.
        times: of a series, seconds; None for a single state after.
    """
    out = []
    swapped = [channel.name for channel in channels if _swapped(channel)]
    if swapped:
        out.append(
            f"before and after seem to be exchanged ({', '.join(swapped)}): by what the files say themselves, the "
            "frames after were recorded before those before; all changes then have the wrong sign"
        )
    elif times is not None:
        mixed = {name: at for channel in channels for name, at in [(channel.name, _not_ascending(channel))] if at}
        if mixed:
            name, at = next(iter(mixed.items()))
            out.append(
                f"{', '.join(mixed)}: by what the files say themselves, the frames of the series were recorded in "
                f"another order than `times` says, first {name} at {moment(times[at])}"
            )
    return tuple(out)


def _recorded(state: StateFrames) -> tuple[datetime, ...]:
    """Of all files; empty where one does not say."""
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
