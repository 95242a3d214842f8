"""What can happen to a path at a surface, and the signature that its events leave."""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum


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
