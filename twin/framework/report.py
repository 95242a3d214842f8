"""Parts of a test's report (tables, sections with figures, images), and sections added by extensions."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from optics.numerics.extension_table import ExtensionTable
from optics.numerics.number_tree import FrozenMap
from twin.framework.artefact import Artefact, Table, typeset
from twin.framework.data_files import FrameFacts
from twin.framework.provenance import SelfCheck

if TYPE_CHECKING:
    from scenes.yaml.spec import Spec


@dataclass(frozen=True, eq=False)
class Section:
    """Section of a report.

    Attributes
    ----------
    title : str
        Heading.
    text : tuple of str
        Paragraphs, plain text.
    artefacts : tuple of Artefact
        Figures, tables and data in the order shown; their names are unique in a report.
    folded : int
        Number of artefacts at the end that are shown only on request.
    name : str
        Anchor for the links at the head of the page; empty if the section is not listed there.
    closed : bool
        True if the whole section is shown only on request.
    """

    title: str
    text: tuple[str, ...] = ()
    artefacts: tuple[Artefact, ...] = ()
    folded: int = 0
    name: str = ""
    closed: bool = False


MOST_SENTENCES = 2
"""Largest number of sentences in a verdict; further findings go into the lead."""


def sentence(clause: str) -> str:
    """Return a statement as a sentence with a full stop, typographic minus signs and, where suitable, a capital.

    Only a first word of lower-case letters gets a capital; a path or a symbol stays as it is.
    """
    text = typeset(clause.strip().rstrip("."))
    return f"{text[:1].upper() + text[1:] if re.match(r'[a-z]+[ ,:;]', text) else text}."


def answer(*statements: str) -> tuple[str, tuple[str, ...]]:
    """Return the verdict of a report, and the sentences that follow it in its lead.

    Parameters
    ----------
    statements : str
        Statements with or without full stop, the most important first; empty ones are omitted.
    """
    sentences = [sentence(clause) for clause in statements if clause.strip()]
    return " ".join(sentences[:MOST_SENTENCES]), tuple(sentences[MOST_SENTENCES:])


@dataclass(frozen=True, eq=False)
class Report:
    """Report of a finished test.

    Attributes
    ----------
    title : str
        Title of the report.
    verdict : str
        Result and its accuracy: at most two sentences, computed from the numbers.
    lead : tuple of str
        A few sentences on what limits the result, where to look, and further findings.
    facts : tuple of (str, str)
        Set-up of the test, (label, text).
    summary : Table
        Main table, also printed in the terminal.
    sections : tuple of Section
        Further sections.
    images : mapping of str to ndarray
        Recorded frames by name, uint16 (frames, rows, columns).
    warnings : tuple of str
        Warnings to read before using the numbers.
    image_facts : mapping of str to FrameFacts
        Descriptions of these frames by name; some may be missing.
    code : int
        Exit code of a command whose result is an exit code.
    files : mapping of str to bytes
        Contents of files that no page shows, by path in the run folder.
    checks : tuple of SelfCheck
        Self-checks of the run; empty to take those in its numbers.
    glance : Artefact | None
        Figure shown beside the main table; None for none.
    unmet : bool
        True if a requirement of the run is not met or an alarm is open; the verdict is then red, with warnings only
        yellow.
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
    files: Mapping[str, bytes] = field(default_factory=FrozenMap)
    checks: tuple[SelfCheck, ...] = ()
    glance: Artefact | None = None
    unmet: bool = False

    @property
    def artefacts(self) -> tuple[Artefact, ...]:
        """All artefacts, the main table first."""
        first = (self.summary,) if self.glance is None else (self.summary, self.glance)
        return (*first, *(artefact for section in self.sections for artefact in section.artefacts))

    def with_verdict(self, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """Return the numbers of the run with the verdict and the warnings.

        Parameters
        ----------
        numbers : mapping
            Numbers by their keys.

        Raises
        ------
        ValueError
            The numbers already contain another verdict or other warnings, which would be lost.
        """
        added = {"verdict": self.verdict, "warnings": list(self.warnings)}
        for key, value in added.items():
            if numbers.get(key, value) != value:
                raise ValueError(f"the key {key!r} of a run's numbers is reserved for the report's own")
        return {**numbers, **added}

    def __post_init__(self) -> None:
        """Typeset all sentences; raise ValueError for a verdict of over two sentences, or artefacts of equal names."""
        for name in ("lead", "warnings"):
            object.__setattr__(self, name, tuple(map(typeset, getattr(self, name))))
        object.__setattr__(self, "verdict", typeset(self.verdict))
        if not self.verdict.endswith(".") or len(re.findall(r"[.!?]\s+[A-Z]", self.verdict)) >= MOST_SENTENCES:
            raise ValueError(f"a verdict must be one or two sentences: {self.verdict!r}")
        names = [artefact.name for artefact in self.artefacts if artefact.within is None]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(f"more than one artefact has the name {', '.join(repeated)}")


def inputs(spec: "Spec", *keys: str) -> tuple[tuple[str, str], ...]:
    """Return sections of an input file as facts of a report: label and text, with the units of the file.

    Parameters
    ----------
    spec : Spec
        Content of the file, or of a part of it.
    keys : str
        Keys of the sections; those without a value are omitted.
    """
    plain = spec.plain()
    return tuple((key.replace("_", " ").capitalize(), _input_text(plain[key])) for key in keys if key in plain)


def _input_text(value: Any) -> str:
    if isinstance(value, Mapping):
        return "; ".join(f"{key.replace('_', ' ')} {_input_text(item)}" for key, item in value.items()) or "none"
    if isinstance(value, list):
        return ", ".join(map(_input_text, value))
    return ("yes" if value else "no") if isinstance(value, bool) else re.sub(r"(?<=\d )um\b", "µm", str(value))


def numbers_only(title: str, file: str, error: Exception) -> Report:
    """Return the report that replaces one that could not be made, and refers to the file of the numbers.

    Parameters
    ----------
    title : str
        Title of the report.
    file : str
        File with the numbers.
    error : Exception
        Error that occurred.
    """
    why = f"the report could not be made: {type(error).__name__}: {' '.join(str(error).split())}"
    caption = "All computed numbers, with all digits."
    summary = Table("files", "Numbers", caption, ("file",), [[file]])
    return Report(title, f"The report could not be made; the numbers are in {file}.", (), (), summary, (), {}, (why,))


def with_warnings(report: Report, warnings: tuple[str, ...]) -> Report:
    """Return the report with further warnings before its own.

    Parameters
    ----------
    report : Report
        Report of a run.
    warnings : tuple of str
        Warnings about the input of the run.
    """
    return replace(report, warnings=(*warnings, *report.warnings))


SECTIONS = ExtensionTable[Callable[[Any], Section | None]]("report_sections", {})
"""Functions that add a section to a report, by kind of run and name of the section, such as ``focus skew``. Each takes
the run's results and returns the section, or None. The kind is ``render`` for the main job, and for a test the name
of its file of numbers: ``focus``, ``angle``. A section comes before the one on how to reproduce the run; its
artefacts are in the run folder. New sections are added here.
"""


def further_sections(kind: str, run: Any) -> tuple[Section, ...]:
    """Return the sections that extensions add to the report of this kind of run, in the order of `SECTIONS`.

    Parameters
    ----------
    kind : str
        Kind of the run.
    run : Any
        Results of the run.
    """
    sections = (SECTIONS[name](run) for name in SECTIONS if name.partition(" ")[0] == kind)
    return tuple(section for section in sections if section is not None)
