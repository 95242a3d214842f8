"""All kinds of YAML files: recognition by their keys, and the command that reads each kind."""

import csv
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from optics.numerics.extension_table import EntryPointError
from scenes.specs.procedures import PROCEDURES
from scenes.yaml.errors import InputError, Issue
from scenes.yaml.named import FileKind
from scenes.yaml.yaml_file import read_yaml

Content = TypeVar("Content")

SLIPS = 1
"""Number of unknown keys that a file may have and still be of a kind: a typing error does not make it another kind."""

_MOST = 2
"""Largest number of kinds that a message lists for a file; if there are more, the keys are not conclusive."""


def file_kinds() -> tuple[FileKind, ...]:
    """Return all kinds in the order in which their schemas are listed.

    Those of the table beside this module come first, then those that are registered with a test.
    """
    with Path(__file__).with_suffix(".csv").open(encoding="utf-8", newline="") as rows:
        listed = [FileKind(**row) for row in csv.DictReader(rows)]
    tests = PROCEDURES.items()
    return (*listed, *(replace(kind, command=f"twin.{name}") for name, test in tests for kind in test.files))


_RESOLVED = {"job": "job", "study": "study"}
"""Key of a config.yaml -> kind of the file. The config.yaml of a test has ``test``, whose content is recognised as the
test's file would be.
"""


def content_of(data: Any) -> Any:
    """Return the plain data that a file's kind describes: for a run's config.yaml those below its key, else all."""
    if isinstance(data, Mapping):
        return next((data[key] for key in (*_RESOLVED, "test") if isinstance(data.get(key), Mapping)), data)
    return data


def kind_of(data: Any) -> FileKind | None:
    """Return the only kind of file that these plain data can be; None if that is not clear.

    The data are those of a file or of a run's config.yaml.
    """
    nearest = kinds_of(data)
    return nearest[0] if len(nearest) == 1 else None


def kinds_of(data: Any) -> tuple[FileKind, ...]:
    """Return the kinds that these plain data can be: several if no key distinguishes them."""
    if not isinstance(data, Mapping):
        return ()
    keys = {key for key in data if isinstance(key, str)}
    for key, name in _RESOLVED.items():
        if key in keys:
            return (next(kind for kind in file_kinds() if kind.name == name),)
    if "test" in keys:
        return kinds_of(data["test"])
    counts = [(extra, kind) for kind in file_kinds() if (extra := kind.count_unknown(keys)) is not None]
    least = min((extra for extra, _ in counts), default=SLIPS + 1)
    return tuple(kind for extra, kind in counts if extra == least <= SLIPS)


def read_for(command: str, file: Path, resolve: Callable[[Path], Content]) -> Content:
    """Return the result of ``resolve`` for the file of a command.

    Parameters
    ----------
    command : str
        Command as the user types it, ``twin.lab focus``.
    file : Path
        File that the user passed to the command.
    resolve : callable
        Function that reads the file and raises InputError.

    Raises
    ------
    InputError
        The error of ``resolve``; for a file of another kind it says which kind it is and which command reads it.
    """
    try:
        return resolve(file)
    except InputError as error:
        try:
            kinds = kinds_of(read_yaml(file).data)
        except (InputError, EntryPointError):
            raise error from None
        if not kinds or len(kinds) > _MOST or any(kind.command == command for kind in kinds):
            raise
        what, remedy = " or ".join(kind.what for kind in kinds), ", or ".join(_usage(kind, file) for kind in kinds)
        raise InputError(Issue(f"this is {what}, which {command} does not read; {remedy}", str(file))) from None


def _usage(kind: FileKind, file: Path) -> str:
    """Return the part of a message that says which command reads a file of a kind, or at which key its name belongs."""
    reads = f"python -m {kind.command} {file} does" if kind.command else ""
    named = f"its name belongs into {kind.place}" if kind.place else ""
    return ", or ".join(filter(None, (reads, named)))
