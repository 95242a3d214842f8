"""What measurements do not tell, as against faults of the program."""

from __future__ import annotations


class MeasurementError(Exception):
    """What was measured does not say what is asked: no spot, too few readings, a fit that finds no end.

    The base of all errors that say so. Who evaluates many measurements counts such a one as failed; any other error is
    a fault of the program.
    """


class UndeterminedError(MeasurementError, ValueError):
    """Measurements that do not settle a number; the message says which and why."""
