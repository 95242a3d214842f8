"""Events of a path at surfaces, and families of paths that met the same surfaces in the same order."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import assert_never

from optics.raytrace.assembly import Assembly, Interaction
from scenes.models.scenery import Scenery


class Event(IntEnum):
    """Kind of event of a path at a surface, such as reflected or scattered.

    Values from ``DIFFUSE`` on are stray light.
    """

    REFLECT = 0
    TRANSMIT = 1
    DIFFUSE = 2
    SCATTER = 3
    """Path scattered into the lobe around the reflected direction."""
    SCATTER_THROUGH = 4
    """Path scattered into the lobe around the refracted direction."""


OUTSIDE = 8
"""Number added to the number of an event (``Event``) that happens outside the clear apertures of a surface."""

BITS = 4
START = 0xCBF29CE484222325
FACTOR = 0x100000001B3
_WORD = (1 << 64) - 1


def code(part: int, event: Event, outside: bool = False) -> int:
    """Return the number of an event: index of the surface it happens on, kind of event, and whether outside apertures.

    ``outside`` is True where the path meets the surface outside its clear apertures.
    """
    return (part + 1) << BITS | (int(event) + (OUTSIDE if outside else 0))


def decode(number: int) -> tuple[int, Event, bool]:
    """Return surface index, kind of event, and True if outside the clear apertures: the inverse of ``code``."""
    event = number & (1 << BITS) - 1
    return (number >> BITS) - 1, Event(event % OUTSIDE), event >= OUTSIDE


def signature(codes: Iterable[int]) -> int:
    """Return the signature of a list of events: the FNV-1a hash of their codes, as the kernel computes it.

    Among a thousand families of a run, the probability that two share a signature is 3e-14.
    """
    value = START
    for number in codes:
        value = ((value ^ number) * FACTOR) & _WORD
    return value


MARKS = {Event.REFLECT: "", Event.TRANSMIT: ">", Event.DIFFUSE: "~", Event.SCATTER: "*", Event.SCATTER_THROUGH: ">*"}
"""Kind of event -> character that follows a surface's name in the text of a path; a reflection has none."""


@dataclass(frozen=True)
class SurfaceEvent:
    """Event of a path: name of the surface, kind of event, and True if outside the surface's clear apertures."""

    part: str
    event: Event
    outside: bool = False

    def __str__(self) -> str:
        """Return the surface's name and the event: ``>`` through, ``~`` diffused, ``*`` scattered, ``!`` outside."""
        return f"{self.part}{MARKS[self.event]}{'!' if self.outside else ''}"


def nominal_codes(scenery: Scenery, assembly: Assembly, sequence: str) -> tuple[int, ...]:
    """Return the events of light along a sequence of elements, up to the detector at its end, as numbers of ``code``.

    Elements that only mark a position are omitted.

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


def surface_events(scenery: Scenery, codes: tuple[int, ...]) -> tuple[SurfaceEvent, ...]:
    """Return the events of a path, with the names of their surfaces, from their numbers (``code``)."""
    parts = scenery.parts
    return tuple(SurfaceEvent(parts[part], event, outside) for part, event, outside in map(decode, codes))


_COUNTS = {1: "single", 2: "double", 3: "triple"}
_VERBS = {
    Event.DIFFUSE: "diffused by",
    Event.SCATTER: "scattered by",
    Event.SCATTER_THROUGH: "scattered through",
    Event.REFLECT: "off",
    Event.TRANSMIT: "through",
}


def family_name(family: tuple[SurfaceEvent, ...], nominal: tuple[SurfaceEvent, ...]) -> str:
    """Return how a family differs from the nominal one: ``prism_0 exit, entry: double, on the way back``.

    The text has the reflections at faces that nominal light passes and their number, then scattering and other events,
    then the side of the nominal turning point on which they happen, or that the turning point is not reached.

    Parameters
    ----------
    family : tuple of SurfaceEvent
        Events of the family in order; empty if they are not known.
    nominal : tuple of SurfaceEvent
        Events of the nominal family of the same detector.
    """
    if not family:
        return "not identified"
    usual = {(hit.part, hit.event) for hit in nominal}
    parts = {hit.part for hit in nominal}
    ghosts, others, positions = [], [], []
    for position, hit in enumerate(family):
        name = _short(hit.part, nominal)
        is_nominal = (hit.part, hit.event) in usual
        if is_nominal and not hit.outside:
            continue
        positions.append(position)
        if hit.event == Event.REFLECT and hit.part in parts and not is_nominal:
            ghosts.append(name + " outside its aperture" * hit.outside)
        else:
            others.append(f"{_VERBS[hit.event]} {name}" + " outside its aperture" * hit.outside)
    words = []
    if ghosts:
        words.append(f"{_joined(ghosts)}: {_COUNTS.get(len(ghosts), f'{len(ghosts)}-fold')}")
    words += dict.fromkeys(others)
    if not words:
        return "the nominal surfaces in another order"
    # light returns at the surface in the middle of the nominal path
    turning_part = nominal[len(nominal) // 2].part
    turning_positions = [position for position, hit in enumerate(family) if hit.part == turning_part]
    if not turning_positions:
        words.append(f"without {_short(turning_part, nominal)}")
    elif positions[-1] < turning_positions[0]:
        words.append("on the way out")
    elif positions[0] > turning_positions[-1]:
        words.append("on the way back")
    return ", ".join(words)


def _short(part: str, nominal: tuple[SurfaceEvent, ...]) -> str:
    """Return a part's name without the path that the nominal parts share: ``prism_0 exit``, ``M1``."""
    holders = {hit.part.rpartition("/")[0] for hit in nominal}
    camera = nominal[0].part.partition("/")[0] + "/"
    for holder in sorted(holders, key=len, reverse=True):
        # a channel's bodies are below base/<camera>/monitor/<channel>/, mirrors of a frame one level deeper
        steps = holder.split("/")
        channel = "/".join(steps[:4] if steps[2:3] == ["monitor"] else steps[:-1]) + "/"
        if "/" in holder and part.startswith(channel):
            part = part.removeprefix(channel)
            break
    return part.removeprefix(camera).replace("/", " ")


def _joined(names: list[str]) -> str:
    """Return names as a list that names a repeated body once: ``prism_0 exit, entry``."""
    out: list[str] = []
    last = ""
    for name in names:
        body, _, face = name.partition(" ")
        out.append(face if face and body == last else name)
        last = body
    return ", ".join(out)
