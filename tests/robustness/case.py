"""A command with its files, of which one is spoilt, and how far the command may go."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import typer

from scenes.specs.load import SCENES

JOBS = Path(__file__).parents[1] / "golden/jobs"
"""Small jobs of every command, those of the golden runs."""

CUTS = Path(__file__).with_name("cuts.txt").read_text("utf-8").split()
"""Functions that begin the long computations."""
SOONER = (
    "twin.design.monitor_design.LayoutBench",
    "scenes.models.thermal_model.ThermalModel._bent",
    "optics.waves.optical_transfer._correlate",
)
"""Parts of building that take seconds, finite elements and transfer functions: most mutants stop before them."""


class Reached(BaseException):
    """A command has read and built everything and would now compute."""


def _reach(*_: object, **__: object) -> None:
    raise Reached


@contextmanager
def cut(soon: bool) -> Iterator[None]:
    """Let no command compute, and not even build what takes seconds if ``soon``."""
    with ExitStack() as stack:
        for name in (*CUTS, *SOONER) if soon else CUTS:
            stack.enter_context(patch(name, _reach))
        yield


@dataclass(frozen=True)
class Case:
    """A command and its files.

    Attributes:
        name: of the case.
        kind: what sort of file is spoilt, as it is counted.
        app: of the command.
        words: before the file, such as the subcommand; {here} is the case's folder, here and in the other words.
        files: name in the case's folder -> content.
        target: the file that is changed.
        options: after the file.
        given: what the command is given; empty for the first of the files.
        out: what its option --out is given, relative to the folder; empty for a command that has none.
        whole: every so many mutants the command is not cut, but runs to its end; 0 for never.
        weight: share of the mutants; slow commands get fewer.
        changes: beginnings of the files' names that the command may change beside its results.
        starts: whether it may start programs and listen on ports of this machine, when it is not cut.
    """

    name: str
    kind: str
    app: typer.Typer
    words: tuple[str, ...]
    files: Mapping[str, bytes]
    target: str
    options: tuple[str, ...] = ()
    given: str = ""
    out: str = "out/run"
    whole: int = 0
    weight: float = 1.0
    changes: tuple[str, ...] = ()
    starts: bool = False


def file_of(name: str, *changes: tuple[str, str]) -> bytes:
    """Return a file of scenes, whose name has a slash, or of the golden runs' small jobs; with words exchanged, all of
    which have to be there.
    """
    text = ((SCENES if "/" in name else JOBS) / name).read_bytes().decode()
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    return text.encode()
