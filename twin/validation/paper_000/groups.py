"""The groups of paper 000."""

from __future__ import annotations

from twin.validation.group import CheckGroup
from twin.validation.paper_000 import equations, figures, suppositions, table1, uses

GROUPS: tuple[CheckGroup, ...] = (
    equations.GROUP,
    suppositions.GROUP,
    table1.GROUP,
    figures.GROUP,
    uses.GROUP,
)
