"""The groups of paper 000."""

from __future__ import annotations

from twin.validation.checks.group import CheckGroup
from twin.validation.paper_000 import equations_000, figures, suppositions, table1, uses

GROUPS: tuple[CheckGroup, ...] = (
    equations_000.GROUP,
    suppositions.GROUP,
    table1.GROUP,
    figures.GROUP,
    uses.GROUP,
)
