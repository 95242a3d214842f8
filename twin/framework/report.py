"""What the report of a test is made of: tables, sections with figures, images; sections added from elsewhere."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from optics.numerics.extension_table import ExtensionTable
from optics.numerics.number_tree import FrozenMap
from twin.framework.artefact import Artefact, Table
from twin.framework.data_files import FrameFacts
from twin.framework.provenance import SelfCheck


@dataclass(frozen=True, eq=False)
class Section:
    """A heading with what belongs under it.

    Attributes
    ----------
    title : str
        heading.
    text : tuple[str, ...]
        Paragraphs, plain text.
    artefacts : tuple[Artefact, ...]
        Figures, tables and data in the order in which they are shown; their names are unique in a report.
    folded : int
        Number of the last of them that a reader has to ask for.
    name : str
        By which the head of the page leads to it; empty for a section that is not listed there.
    closed : bool
        a reader has to ask for all of it.
    """

    title: str
    text: tuple[str, ...] = ()
    artefacts: tuple[Artefact, ...] = ()
    folded: int = 0
    name: str = ""
    closed: bool = False


MOST_SENTENCES = 2
"""Sentences of a verdict; whatever else was found follows it."""


def sentence(statement: str) -> str:
    """A statement, with or without its full stop, as a sentence. A first word of small letters gets a capital, so
    that a statement does not begin with a name; a path or a symbol stays as it is.
    """
    text = statement.strip().rstrip(".")
    return f"{text[:1].upper() + text[1:] if re.match(r'[a-z]+[ ,:;]', text) else text}."


def answer(*statements: str) -> tuple[str, tuple[str, ...]]:
    """The verdict of a report, and the sentences that follow it in its lead.

    Parameters
    ----------
    statements : str
        The most important first, each a sentence with or without its full stop; empty ones are left out.
    """
    said = [sentence(one) for one in statements if one.strip()]
    return " ".join(said[:MOST_SENTENCES]), tuple(said[MOST_SENTENCES:])


@dataclass(frozen=True, eq=False)
class Report:
    """What a finished test has to say.

    Attributes
    ----------
    title : str
        Of the report.
    verdict : str
        What was found and how well: at most two sentences, computed from the numbers.
    lead : tuple[str, ...]
        What limits it, where to look, what else was found: a few sentences.
    facts : tuple[tuple[str, str], ...]
        What was set up, (label, text).
    summary : Table
        The main table, also printed in the terminal.
    sections : tuple[Section, ...]
        The rest of the report.
    images : Mapping[str, np.ndarray]
        Name -> recorded frames, uint16 (frames, rows, columns).
    warnings : tuple[str, ...]
        What the user should know before using the numbers.
    image_facts : Mapping[str, FrameFacts]
        Name of images -> what is known of these frames; of some or all.
    code : int
        Exit code of the command, of a test whose answer it is.
    conclusions : tuple[str, ...]
        What follows from the numbers, sentence by sentence, before all tables.
    files : Mapping[str, bytes]
        Path in the run folder -> content, of files that no page shows.
    checks : tuple[SelfCheck, ...]
        What the run checked of itself; none for what its numbers say.
    """

    title: str
    verdict: str
    lead: tuple[str, ...]
    facts: tuple[tuple[str, str], ...]
    summary: Table
    sections: tuple[Section, ...]
    images: Mapping[str, np.ndarray] = field(default_factory=FrozenMap)
    warnings: tuple[str, ...] = ()
    image_facts: Mapping[str, FrameFacts] = field(default_factory=FrozenMap)
    code: int = 0
    conclusions: tuple[str, ...] = ()
    files: Mapping[str, bytes] = field(default_factory=FrozenMap)
    checks: tuple[SelfCheck, ...] = ()

    @property
    def artefacts(self) -> tuple[Artefact, ...]:
        """All that it shows, the main table first."""
        return (self.summary, *(artefact for section in self.sections for artefact in section.artefacts))

    def told(self, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """Return the numbers of the run with the verdict and the warnings beside them.

        Parameters
        ----------
        numbers : Mapping[str, Any]
            By their keys.

        Raises
        ------
        ValueError
            They have another verdict or other warnings, which would be lost.
        """
        added = {"verdict": self.verdict, "warnings": list(self.warnings)}
        for key, value in added.items():
            if numbers.get(key, value) != value:
                raise ValueError(f"the key {key!r} of a run's numbers is for what its report says")
        return {**numbers, **added}

    def __post_init__(self) -> None:
        """Refuse a verdict of more than two sentences, and two artefacts of one name: they would be one file."""
        if not self.verdict.endswith(".") or len(re.findall(r"[.!?]\s+[A-Z]", self.verdict)) >= MOST_SENTENCES:
            raise ValueError(f"not one or two sentences: {self.verdict!r}")
        names = [artefact.name for artefact in self.artefacts if artefact.within is None]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"more than one artefact is called {', '.join(twice)}")


def numbers_only(title: str, file: str, error: Exception) -> Report:
    """What stands in the place of a report that could not be made: the numbers are in their file all the same.

    Parameters
    ----------
    title : str
        Of the report.
    file : str
        With the numbers.
    error : Exception
        Why there is no more.
    """
    why = f"the report could not be made: {type(error).__name__}: {' '.join(str(error).split())}"
    caption = "What was computed, with all digits."
    summary = Table("files", "Numbers", caption, ("file",), [[file]])
    return Report(title, f"The report could not be made, the numbers stand in {file}.", (), (), summary, (), {}, (why,))


def with_warnings(report: Report, given: tuple[str, ...]) -> Report:
    """The report with further warnings before its own.

    Parameters
    ----------
    report : Report
        Of a run.
    given : tuple[str, ...]
        Warnings of what the run was given.
    """
    return replace(report, warnings=(*given, *report.warnings))


SECTIONS = ExtensionTable[Callable[[Any], Section | None]]("report_sections", {})
"""Kind of run and name of the section, ``focus skew`` -> the section, of what the run gave; None where it has nothing
to say. The kind is ``render`` for the main job, and for a test the name of its numbers' file: ``focus``, ``angle``. A
section stands before the one that says how to reproduce the run; its artefacts are in the run folder. A new one is
added here.
"""


def further_sections(kind: str, run: Any) -> tuple[Section, ...]:
    """The sections for a run of that kind, in the order of SECTIONS.

    Parameters
    ----------
    kind : str
        Of the run.
    run : Any
        What the run gave.
    """
    found = (SECTIONS[name](run) for name in SECTIONS if name.partition(" ")[0] == kind)
    return tuple(section for section in found if section is not None)
