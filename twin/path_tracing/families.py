"""Families of paths: all that met the same parts with the same events, in the same order."""

from __future__ import annotations

from dataclasses import dataclass

from optics.assembly import Assembly
from optics.element import Interaction
from scenes.scenery import Scenery
from twin.path_tracing.events import OUTSIDE, Event, code, decode

MARKS = {
    Event.REFLECT: "",
    Event.TRANSMIT: ">",
    Event.DIFFUSE: "~",
    Event.SCATTER: "*",
    Event.SCATTER_THROUGH: ">*",
}
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

    Raises:
        KeyError: an element of the sequence is on no surface of the scene.
    """
    parts = scenery.parts
    out = []
    for element in assembly.sequence(sequence):
        if element.interaction is Interaction.PASS:
            continue
        surface = scenery.surfaces[scenery.of_element(element.name)]
        event = Event.TRANSMIT if element.interaction is Interaction.REFRACT else Event.REFLECT
        out.append(code(parts.index(surface.part), event))
    return tuple(out)


def touches(scenery: Scenery, codes: tuple[int, ...]) -> tuple[Touch, ...]:
    """Events in words."""
    parts = scenery.parts
    out = []
    for number in codes:
        part, event, outside = decode(number)
        out.append(Touch(parts[part], event, outside))
    return tuple(out)


__all__ = ["MARKS", "OUTSIDE", "Touch", "nominal_codes", "touches"]
