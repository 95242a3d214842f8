"""The conventions that are mistaken for one another, and every reading of a pass that differs in one or two of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from optics.numerics.frozen_map import FrozenMap
from twin.orbit.conventions.pass_readings import PassConventions

_SCALES = ("UTC", "GPS", "TAI", "TT")
_FRAMES = ("ITRS", "GCRS", "EME2000", "TEME")
_TURNED = {
    "forward": "back",
    "back": "forward",
    "right": "left",
    "left": "right",
    "down": "up",
    "up": "down",
}


@dataclass(frozen=True)
class Question:
    """A convention and what it may be.

    Attributes:
        title: for readers.
        get: of a reading.
        put: a reading with another value of it.
        values: that it may have, for a stated reading.
        text: of a value, for readers.
    """

    title: str
    get: Callable[[PassConventions], Any]
    put: Callable[[PassConventions, Any], PassConventions]
    values: Callable[[PassConventions], tuple[Any, ...]]
    text: Callable[[Any], str] = str


def _of_platform(title: str, key: str, values: tuple[Any, ...], text: Callable[[Any], str] = str) -> Question:
    return Question(
        title,
        lambda c: getattr(c.platform, key),
        lambda c, v: replace(c, platform=replace(c.platform, **{key: v})),
        lambda c: values,
        text,
    )


def _of_pass(title: str, key: str, values: tuple[Any, ...], text: Callable[[Any], str] = str) -> Question:
    return Question(title, lambda c: getattr(c, key), lambda c, v: replace(c, **{key: v}), lambda c: values, text)


def _turned(c: PassConventions) -> tuple[tuple[str, str, str], ...]:
    """The body's axes as stated, and turned by half a turn about each of them."""
    a = c.platform.body_axes
    x, y, z = (_TURNED[v] for v in a)
    return a, (a[0], y, z), (x, a[1], z), (x, y, a[2])


def _seconds(value: float) -> str:
    return f"{value:+g} s" if value else "none"


QUESTIONS: Mapping[str, Question] = FrozenMap(
    {
        "quaternion_scalar": _of_platform("scalar of the quaternion", "scalar", ("last", "first")),
        "quaternion_turns": _of_platform("quaternion turns", "turns", ("body_to_frame", "frame_to_body")),
        "body_axes": Question(
            "body x, y, z point",
            lambda c: c.platform.body_axes,
            lambda c, v: replace(c, platform=replace(c.platform, body_axes=v)),
            _turned,
            ", ".join,
        ),
        "angle_sequence": _of_platform(
            "sequence of the angles", "sequence", ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx")
        ),
        "attitude_frame": _of_platform("frame of the attitude", "attitude_frame", _FRAMES),
        "orbit_frame": _of_platform("frame of the orbit", "orbit_frame", _FRAMES),
        "orbit_time_scale": _of_platform("time scale of the orbit", "orbit_scale", _SCALES),
        "attitude_time_scale": _of_platform("time scale of the attitude", "attitude_scale", _SCALES),
        "line_time_scale": _of_pass("time scale of the lines", "line_scale", _SCALES),
        "line_time_offset": _of_pass("offset of the line times", "line_offset", (0.0, -1.0, 1.0), _seconds),
        "line_moment": _of_pass("moment of a line's time", "moment", ("start", "middle", "end")),
        "line_origin": _of_pass(
            "coordinate of the middle of line 0", "line_origin", (0.0, 0.5, 1.0), lambda v: f"{v:g}"
        ),
        "pixel_origin": _of_pass(
            "coordinate of the middle of the first pixel", "pixel_origin", (0.0, 0.5, 1.0, 1.5), lambda v: f"{v:g}"
        ),
        "first_pixel_sees": _of_pass("first pixel sees", "sees", ("right", "left")),
        "line_axis": _of_pass(
            "lines are counted", "backward", (False, True), lambda v: "from the last" if v else "from the first"
        ),
    }
)
"""Name -> what is asked of a reading."""


def asked(stated: PassConventions, quaternions: bool) -> dict[str, tuple[Any, ...]]:
    """Question -> values that it may have beside the stated one; those that do not arise are left out.

    Args:
        stated: the reading that the file states.
        quaternions: whether the attitude is one of quaternions, and not of angles.
    """
    without = {"angle_sequence"} if quaternions else {"quaternion_scalar", "quaternion_turns"}
    found = {}
    for name, question in QUESTIONS.items():
        here = question.get(stated)
        if name in without or (name == "attitude_frame" and here == "orbital"):
            continue
        found[name] = tuple(v for v in question.values(stated) if v != here)
    return found


Changes = tuple[tuple[str, Any], ...]
"""Questions with another value than the stated one."""


def singles_and_pairs(others: Mapping[str, tuple[Any, ...]], start: Changes = ()) -> Iterator[Changes]:
    """Changes of one or two questions, beside those of `start`, which comes first.

    Args:
        others: question -> values beside the stated one.
        start: changes that all of them have.
    """
    yield start
    taken = {name for name, _ in start}
    one = [(name, value) for name, values in others.items() if name not in taken for value in values]
    for change in one:
        yield (*start, change)
    for k, first in enumerate(one):
        for second in one[k + 1 :]:
            if first[0] != second[0]:
                yield (*start, first, second)


def changed(stated: PassConventions, changes: Changes) -> PassConventions:
    """The reading with these changes."""
    for name, value in changes:
        stated = QUESTIONS[name].put(stated, value)
    return stated
