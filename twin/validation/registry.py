"""All groups of checks, and how they are selected by the beginnings of their ids."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from scenes.yaml.errors import nearest
from twin.validation.checks.group import CheckGroup, group_of, matches
from twin.validation.paper_000 import equations_000, figures, suppositions, table1
from twin.validation.paper_001 import budget_checks, formulas, joint, table2
from twin.validation.paper_001.ranges import ranges_group
from twin.validation.paper_003 import fields, model
from twin.validation.paper_004 import distortion_checks, equations_004, focus_checks, turntable_checks
from twin.validation.paper_017 import bundle

GROUPS: tuple[CheckGroup, ...] = (
    equations_000.GROUP,
    suppositions.SUPPOSITIONS,
    table1.GROUP,
    figures.GROUP,
    suppositions.USES,
    formulas.GROUP,
    ranges_group.GROUP,
    joint.GROUP,
    table2.GROUP,
    budget_checks.GROUP,
    model.GROUP,
    fields.GROUP,
    focus_checks.GROUP,
    equations_004.GROUP,
    turntable_checks.GROUP,
    distortion_checks.GROUP,
    group_of("004.figures"),
    bundle.GROUP,
)
"""Every group, in the order in which they run. A new one is added here."""


class UnknownCheck(Exception):
    """A prefix under which there is no check; the message names the nearest."""


@dataclass(frozen=True)
class Selection:
    """A group and those of its ids that are wanted."""

    group: CheckGroup
    ids: frozenset[str]


def require_unique(groups: Iterable[CheckGroup]) -> None:
    """Refuse groups or ids that come twice.

    Raises:
        ValueError: one does.
    """
    groups = tuple(groups)
    names = Counter(group.prefix for group in groups)
    ids = Counter(name for group in groups for check in group.checks for name in check.names)
    twice = [name for counter in (names, ids) for name, count in counter.items() if count > 1]
    if twice:
        raise ValueError(f"registered twice: {', '.join(twice)}")


def select(groups: Sequence[CheckGroup], only: str | None) -> tuple[Selection, ...]:
    """The groups, with the ids that lie under one of the prefixes; all where ``only`` is None.

    Args:
        groups: all there are.
        only: prefixes, separated by commas, that end where a part of an id ends; a row's further ids count as well.

    Raises:
        UnknownCheck: there is nothing under one of them.
    """
    require_unique(groups)
    ids = [name for group in groups for check in group.checks for name in check.names]
    if only is None:
        return tuple(Selection(group, frozenset(group.ids)) for group in groups)
    prefixes = [part.strip() for part in only.split(",")]
    for prefix in prefixes:
        if not any(matches(identifier, prefix) for identifier in ids):
            raise UnknownCheck(_unknown(prefix, ids))
    out = []
    for group in groups:
        chosen = frozenset(c.id for c in group.checks if any(matches(n, p) for n in c.names for p in prefixes))
        if chosen:
            out.append(Selection(group, chosen))
    return tuple(out)


def _unknown(prefix: str, ids: Sequence[str]) -> str:
    """What is wrong with a prefix, and what was meant."""
    if not prefix:
        return "an empty id; --only takes ids or their beginnings, separated by commas, and --list shows them"
    # everything that could have been given; whole parts only
    known = {".".join(parts[:n]): None for i in ids for parts in [i.split(".")] for n in range(1, len(parts) + 1)}
    bare = prefix.strip(".")
    meant = bare if bare in known else nearest(bare, known)
    return f"no check {prefix!r}; " + (f"did you mean {meant!r}? " if meant else "") + "--list shows all"
