"""Sections that reports have beside their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twin.run.report import Section

__all__ = ["SECTIONS", "further_sections"]

SECTIONS: dict[tuple[str, str], Callable[[Any], Section | None]] = {}
"""(Kind of run, name of the section) -> the section, of what the run gave; None where it has nothing to say. The kind
is ``render`` for the main job, and for a test the name of its numbers' file: ``focus``, ``angle``. A section
stands before the one that says how to reproduce the run; its artefacts are in the run folder. A new one is added here.
"""


def further_sections(kind: str, run: Any) -> tuple[Section, ...]:
    """The sections for a run of that kind, in the order of SECTIONS."""
    found = (section(run) for (of, _), section in SECTIONS.items() if of == kind)
    return tuple(section for section in found if section is not None)
