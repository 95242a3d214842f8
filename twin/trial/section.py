"""A part of a laboratory report."""

from __future__ import annotations

from dataclasses import dataclass

from twin.artefact import Artefact


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
