"""What happens to a path at a surface, and the families of paths that met the same surfaces."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import assert_never

from optics.raytrace.assembly import Assembly, Interaction
from scenes.models.scenery import Scenery


class Event(IntEnum):
    """What a path did at a surface; from ``DIFFUSE`` on it is stray light."""

    REFLECT = 0
    TRANSMIT = 1
    DIFFUSE = 2
    SCATTER = 3
    """Into the lobe around the reflected direction."""
    SCATTER_THROUGH = 4
    """Into the lobe around the refracted direction."""


OUTSIDE = 8
"""Added to the event when it happens outside a face's clear apertures."""

BITS = 4
START = 0xCBF29CE484222325
FACTOR = 0x100000001B3
_WORD = (1 << 64) - 1


def code(part: int, event: Event, outside: bool = False) -> int:
    """One event as a number: the part's number and what happened."""
    return (part + 1) << BITS | (int(event) + (OUTSIDE if outside else 0))


def decode(number: int) -> tuple[int, Event, bool]:
    """Part, event and whether it was outside the clear apertures; the inverse of ``code``."""
    event = number & (1 << BITS) - 1
    return (number >> BITS) - 1, Event(event % OUTSIDE), event >= OUTSIDE


def signature(codes: Iterable[int]) -> int:
    """Signature of a list of events: the FNV-1a hash of their codes, as the kernel works it out.

    Two different families of a run of a thousand share a signature with a probability of 3e-14.
    """
    value = START
    for number in codes:
        value = ((value ^ number) * FACTOR) & _WORD
    return value


MARKS = {Event.REFLECT: "", Event.TRANSMIT: ">", Event.DIFFUSE: "~", Event.SCATTER: "*", Event.SCATTER_THROUGH: ">*"}
"""What follows a part's name in a family's text: nothing for a reflection."""


@dataclass(frozen=True)
class Touch:
    """One event of a family: the part, what happened, and whether outside the clear apertures of its elements."""

    part: str
    event: Event
    outside: bool = False

    def __str__(self) -> str:
        """The part's name and a mark: ``>`` through, ``~`` diffused, ``*`` scattered, ``!`` outside the aperture."""
        return f"{self.part}{MARKS[self.event]}{'!' if self.outside else ''}"


def nominal_codes(scenery: Scenery, assembly: Assembly, sequence: str) -> tuple[int, ...]:
    """Codes of the events along a sequence of the assembly, up to the detector at its end.

    Elements that only mark a place are left out.

    Raises
    ------
    KeyError
        An element of the sequence is on no surface of the scene.
    """
    parts = scenery.parts
    out = []
    for element in assembly.sequence(sequence):
        match element.interaction:
            case Interaction.PASS:
                continue
            case Interaction.REFRACT:
                event = Event.TRANSMIT
            case Interaction.REFLECT | Interaction.TOTAL:
                event = Event.REFLECT
            case _:
                assert_never(element.interaction)
        surface = scenery.surfaces[scenery.of_element(element.name)]
        out.append(code(parts.index(surface.part), event))
    return tuple(out)


def touches(scenery: Scenery, codes: tuple[int, ...]) -> tuple[Touch, ...]:
    """Events in words."""
    parts = scenery.parts
    return tuple(Touch(parts[part], event, outside) for part, event, outside in map(decode, codes))


_COUNTS = {1: "single", 2: "double", 3: "triple"}
_SAID = {
    Event.DIFFUSE: "diffused by",
    Event.SCATTER: "scattered by",
    Event.SCATTER_THROUGH: "scattered through",
    Event.REFLECT: "off",
    Event.TRANSMIT: "through",
}


def family_name(family: tuple[Touch, ...], nominal: tuple[Touch, ...]) -> str:
    """How a family differs from the nominal one, in a few words: ``prism_0 exit, entry: double, on the way back``.

    First come the reflections at faces that nominal light passes, and how many they are, then what is scattered and
    what else is met, then on which side of the nominal turning point it happens, or that this is not reached.

    Parameters
    ----------
    family : tuple[Touch, ...]
        Its events in order; empty when nobody looked them up.
    nominal : tuple[Touch, ...]
        Those of the nominal family of the same detector.
    """
    if not family:
        return "not looked up"
    usual = {(touch.part, touch.event) for touch in nominal}
    parts = {touch.part for touch in nominal}
    ghosts, others, places = [], [], []
    for place, touch in enumerate(family):
        name = _short(touch.part, nominal)
        known = (touch.part, touch.event) in usual
        if known and not touch.outside:
            continue
        places.append(place)
        if touch.event == Event.REFLECT and touch.part in parts and not known:
            ghosts.append(name + " outside its aperture" * touch.outside)
        else:
            others.append(f"{_SAID[touch.event]} {name}" + " outside its aperture" * touch.outside)
    said = []
    if ghosts:
        said.append(f"{_joined(ghosts)}: {_COUNTS.get(len(ghosts), f'{len(ghosts)}-fold')}")
    said += dict.fromkeys(others)
    if not said:
        return "the nominal surfaces in another order"
    # light comes back from the one surface that the nominal way meets in its middle
    turn = nominal[len(nominal) // 2].part
    turns = [place for place, touch in enumerate(family) if touch.part == turn]
    if not turns:
        said.append(f"without {_short(turn, nominal)}")
    elif places[-1] < turns[0]:
        said.append("on the way out")
    elif places[0] > turns[-1]:
        said.append("on the way back")
    return ", ".join(said)


def _short(part: str, nominal: tuple[Touch, ...]) -> str:
    """A part's name without what the nominal way's own parts have in common: ``prism_0 exit``, ``M1``."""
    own = {touch.part.rpartition("/")[0] for touch in nominal}
    camera = nominal[0].part.partition("/")[0] + "/"
    for holder in sorted(own, key=len, reverse=True):
        # a channel's bodies stand below base/<camera>/monitor/<channel>/, mirrors of a frame one level deeper
        steps = holder.split("/")
        channel = "/".join(steps[:4] if steps[2:3] == ["monitor"] else steps[:-1]) + "/"
        if "/" in holder and part.startswith(channel):
            part = part.removeprefix(channel)
            break
    return part.removeprefix(camera).replace("/", " ")


def _joined(names: list[str]) -> str:
    """``prism_0 exit, entry``: the body once, where the same one follows."""
    out: list[str] = []
    last = ""
    for name in names:
        body, _, face = name.partition(" ")
        out.append(face if face and body == last else name)
        last = body
    return ", ".join(out)
