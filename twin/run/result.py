"""What a test gives, whichever it was: numbers, tables, sections of its report, images; and how it fails."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from optics.numerics.frozen_map import FrozenMap
from scenes.yaml.errors import KeyPath
from twin.run.artefact import Artefact, Table
from twin.run.reference_frames import described


@dataclass(frozen=True, eq=False)
class Section:
    """A heading with what belongs under it.

    Attributes:
        title: heading.
        text: paragraphs, plain text.
        artefacts: figures, tables and data in the order in which they are shown; their names are unique in a report.
    """

    title: str
    text: tuple[str, ...] = ()
    artefacts: tuple[Artefact, ...] = ()


class BenchError(Exception):
    """The test failed on the bench: what happened, which key of its file is to be changed, and how.

    Attributes:
        key: key path in the test's file.
        remedy: what may be there instead.
    """

    def __init__(self, problem: str, key: KeyPath, remedy: str) -> None:
        super().__init__(problem)
        self.key = key
        self.remedy = remedy


Advance = Callable[[str, int, int], None]
"""Told what is being done, and how many of how many parts of it are."""


def silent(part: str, done: int, total: int) -> None:
    """An ``Advance`` that tells nobody."""


@dataclass(frozen=True, eq=False)
class LabResult:
    """A finished test.

    Attributes:
        kind: of `twin.run.reference_frames.FRAMES`, for example ``focus``; its numbers go to KIND.json.
        title: of the report.
        lead: what was found, a sentence or a few.
        facts: what was set up, (label, text).
        data: the numbers, plain data.
        summary: the main table, also printed in the terminal.
        sections: the rest of the report.
        images: name -> recorded frames, uint16 (frames, rows, columns).
        warnings: what the user should know before using the numbers.
    """

    kind: str
    title: str
    lead: tuple[str, ...]
    facts: tuple[tuple[str, str], ...]
    data: Mapping[str, Any]
    summary: Table
    sections: tuple[Section, ...]
    images: Mapping[str, np.ndarray] = field(default_factory=FrozenMap)
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse two artefacts of one name: they would be one file."""
        names = [artefact.name for section in self.sections for artefact in section.artefacts]
        names.append(self.summary.name)
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"more than one artefact is called {', '.join(twice)}")

    @property
    def document(self) -> dict[str, Any]:
        """Contents of KIND.json: the numbers with their frames."""
        return described(self.kind, self.data)
