"""Parts that cannot stand as an instrument's file says: found deep in the building of it, told with file and line."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, TypeVar, cast

from scenes.channel import CENTRAL_PRISM
from scenes.errors import KeyPath

if TYPE_CHECKING:
    from scenes.instrument import InstrumentSpec
    from scenes.instrument_model import Instrument

Build = TypeVar("Build", bound="Callable[..., Instrument]")


class MisplacedError(ValueError):
    """A part of the monitor cannot stand as the instrument's file says.

    Attributes:
        key: of the file, what to change.
    """

    def __init__(self, problem: str, key: KeyPath) -> None:
        super().__init__(problem)
        self.key = key


def told_by_file(build: Build) -> Build:
    """For a function that builds an instrument from a specification: ``MisplacedError`` becomes an ``InputError``."""

    @wraps(build)
    def told(spec: InstrumentSpec, *arguments: Any, **named: Any) -> Instrument:
        try:
            return build(spec, *arguments, **named)
        except MisplacedError as error:
            raise spec.error(str(error), error.key) from error

    return cast("Build", told)


def key_of(path: str) -> KeyPath:
    """Key of the instrument's file that a body comes from."""
    if path.startswith(CENTRAL_PRISM):
        return ("central_prism",)
    kinds = [part for part in path.split("/") if part in ("prism_180", "prism_0")]
    return ("monitor", kinds[0]) if kinds else ("cameras", path.split("/")[1], "pupil_offset")
