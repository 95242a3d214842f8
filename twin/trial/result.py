"""What a laboratory test gives, whichever it was: numbers, a table, the parts of its report, images."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from optics.frozen_map import FrozenMap
from twin.artefact import Table
from twin.reference_frames import described
from twin.trial.section import Section

Advance = Callable[[str, int, int], None]
"""Told what is being done, and how many of how many parts of it are."""


def silent(part: str, done: int, total: int) -> None:
    """An ``Advance`` that tells nobody."""


@dataclass(frozen=True, eq=False)
class LabResult:
    """A finished test.

    Attributes:
        kind: of `twin.reference_frames.FRAMES`, for example ``focus``; its numbers go to KIND.json.
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
