"""What physics forbids, as against faults of the program: light that is lost, parts that have no room."""

from __future__ import annotations


class PhysicalError(Exception):
    """What was asked for cannot be, in nature or with this instrument, though each of its numbers is allowed.

    The base of all errors that say so. Who runs many jobs counts such a one as failed; any other error is a fault of
    the program, whose numbers are not to be relied on.
    """


class UnphysicalError(PhysicalError, ValueError):
    """A value that cannot be, with the others; the message says which and why."""
