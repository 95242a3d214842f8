"""All kinds of YAML files, how one is told from its keys, and which command reads it."""

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

Given = TypeVar("Given")

SLIPS = 1
"""Keys that a file of a kind may have and the kind does not know: a typing error does not make it another kind."""

_MOST = 2
"""Kinds that a file may be and be told as such; of more its keys say nothing."""


def file_kinds() -> tuple[FileKind, ...]:
    """Return every kind, in the order in which their schemas are listed: those in the table beside this module, then
    those that are registered with a test.
    """
    with Path(__file__).with_suffix(".csv").open(encoding="utf-8", newline="") as rows:
        listed = [FileKind(**row) for row in csv.DictReader(rows)]
    tests = PROCEDURES.items()
    return (*listed, *(replace(kind, command=f"twin.{name}") for name, test in tests for kind in test.files))


_RESOLVED = {"job": "job", "study": "study"}
"""Key of a config.yaml that names its kind; those of tests have ``test``, which is told as its own file would be."""


def kind_of(data: Any) -> FileKind | None:
    """The kind of file, or of a run's config.yaml, that these plain data can only be; None where that is not clear."""
    nearest = kinds_of(data)
    return nearest[0] if len(nearest) == 1 else None


def kinds_of(data: Any) -> tuple[FileKind, ...]:
    """The kinds that these plain data can be: more than one where no key tells them apart."""
    if not isinstance(data, Mapping):
        return ()
    keys = {key for key in data if isinstance(key, str)}
    for key, name in _RESOLVED.items():
        if key in keys:
            return (next(kind for kind in file_kinds() if kind.name == name),)
    if "test" in keys:
        return kinds_of(data["test"])
    found = [(strange, kind) for kind in file_kinds() if (strange := kind.strangers(keys)) is not None]
    least = min((strange for strange, _ in found), default=SLIPS + 1)
    return tuple(kind for strange, kind in found if strange == least <= SLIPS)


def read_for(command: str, file: Path, resolve: Callable[[Path], Given]) -> Given:
    """What ``resolve`` makes of the file that was given to a command.

    Parameters
    ----------
    command : str
        As the user calls it, ``twin.lab focus``.
    file : Path
        Given to it.
    resolve : Callable[[Path], Given]
        Raises InputError.

    Raises
    ------
    InputError
        As ``resolve``; for a file of another kind it says what the file is and which command reads it.
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
        what, there = " or ".join(kind.what for kind in kinds), ", or ".join(_place(kind, file) for kind in kinds)
        raise InputError(Issue(f"this is {what}, which {command} does not read; {there}", str(file))) from None


def _place(kind: FileKind, file: Path) -> str:
    """Which command reads a file of a kind, and where its name belongs."""
    reads = f"python -m {kind.command} {file} does" if kind.command else ""
    named = f"its name belongs into {kind.place}" if kind.place else ""
    return ", or ".join(filter(None, (reads, named)))
