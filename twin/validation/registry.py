"""Register of all groups of checks, and their selection by the beginnings of their ids."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from optics.numerics.extension_table import ExtensionTable, entries
from scenes.yaml.errors import nearest
from scenes.yaml.named import Named
from twin.validation.row_names import REAL, matches, names_in_files

if TYPE_CHECKING:  # all that the checks compute with
    from twin.validation.group import CheckGroup

_GROUPS = (
    Named("twin.validation.paper_000.method:GROUP"),
    Named("twin.validation.paper_000.method:SUPPOSITIONS"),
    Named("twin.validation.paper_000.results:TABLE_1"),
    Named("twin.validation.paper_000.results:FIGURES"),
    Named("twin.validation.paper_000.method:USES"),
    Named("twin.validation.paper_001.formulas:GROUP"),
    Named("twin.validation.paper_001.ranges_checks:GROUP"),
    Named("twin.validation.paper_001.formulas:JOINT"),
    Named("twin.validation.paper_001.table2:GROUP"),
    Named("twin.validation.paper_001.budget:GROUP"),
    Named("twin.validation.paper_003.model:GROUP"),
    Named("twin.validation.paper_003.fields:GROUP"),
    Named("twin.validation.paper_004.focus_checks:GROUP"),
    Named("twin.validation.paper_004.distortion:EQUATIONS"),
    Named("twin.validation.paper_004.turntable_checks:GROUP"),
    Named("twin.validation.paper_004.distortion:GROUP"),
    Named("twin.validation.paper_004.distortion:FIGURES"),
    Named("twin.validation.paper_017.bundle:GROUP"),
    Named("twin.validation.real.edges:GROUP"),
    Named("twin.validation.real.stars:GROUP"),
    Named("twin.validation.real.scenes:GROUP"),
    Named("twin.validation.real.spots:GROUP"),
)
"""Module and name of each group of checks; a new group is added here."""

GROUPS: tuple[CheckGroup, ...]
"""All groups of checks in the order in which they run; they are imported at the first access."""


def __getattr__(name: str) -> Any:
    if name != "GROUPS":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from twin.validation.group import CheckGroup

    others = ExtensionTable[CheckGroup]("check_groups", {}, CheckGroup)
    groups = globals()[name] = (*(named.get() for named in _GROUPS), *others.values())
    return groups


class UnknownCheck(Exception):
    """Error that no check's id begins with a given prefix; the message names the nearest one."""


@dataclass(frozen=True)
class Selection:
    """Group of checks, with the ids of those that are requested."""

    group: CheckGroup
    ids: frozenset[str]


def require_unique(groups: Iterable[CheckGroup]) -> None:
    """Raise an error if a group or an id is registered twice.

    Parameters
    ----------
    groups : iterable of CheckGroup
        Groups to be examined.

    Raises
    ------
    ValueError
        A name of a group or an id occurs more than once.
    """
    groups = tuple(groups)
    names = Counter(group.prefix for group in groups)
    ids = Counter(name for group in groups for check in group.checks for name in check.names)
    twice = [name for counter in (names, ids) for name, count in counter.items() if count > 1]
    if twice:
        raise ValueError(f"registered twice: {', '.join(twice)}")


def select(groups: Sequence[CheckGroup], only: str | None) -> tuple[Selection, ...]:
    """Return the groups that have ids under one of the prefixes, with these ids.

    Parameters
    ----------
    groups : sequence of CheckGroup
        All groups.
    only : str or None
        Prefixes separated by commas, each ending where a part of an id ends; further ids of a check count as well. None
        selects the checks of all papers, without those of measured data.

    Raises
    ------
    UnknownCheck
        No check has one of the prefixes.
    """
    require_unique(groups)
    if only is None:
        papers = (group for group in groups if not matches(group.prefix, REAL))
        return tuple(Selection(group, frozenset(group.ids)) for group in papers)
    prefixes = _known(only, [name for group in groups for check in group.checks for name in check.names])
    out = []
    for group in groups:
        chosen = frozenset(c.id for c in group.checks if any(matches(n, p) for n in c.names for p in prefixes))
        if chosen:
            out.append(Selection(group, chosen))
    return tuple(out)


def require_known(only: str | None) -> None:
    """Raise the error of `select` for an unknown prefix, without importing a group if none has been imported yet.

    Raises
    ------
    UnknownCheck
        No check has one of the prefixes.
    """
    # other distributions' groups are in no file of ours
    if only is not None and not entries() and "GROUPS" not in globals():
        _known(only, names_in_files())


def _known(only: str, ids: Sequence[str]) -> list[str]:
    """Return the prefixes in ``only`` after checking that each has ids under it.

    Raises
    ------
    UnknownCheck
        A prefix has no ids under it.
    """
    prefixes = [part.strip() for part in only.split(",")]
    for prefix in prefixes:
        if not any(matches(identifier, prefix) for identifier in ids):
            raise UnknownCheck(_unknown(prefix, ids))
    return prefixes


def _unknown(prefix: str, ids: Sequence[str]) -> str:
    """Return the message for an unknown prefix, with the nearest known one."""
    if not prefix:
        return "an empty id; --only takes ids or their beginnings, separated by commas, and --list shows them"
    # everything that could have been given; whole parts only
    known = {".".join(parts[:n]): None for i in ids for parts in [i.split(".")] for n in range(1, len(parts) + 1)}
    bare = prefix.strip(".")
    meant = bare if bare in known else nearest(bare, known)
    return f"no check {prefix!r}; " + (f"did you mean {meant!r}? " if meant else "") + "--list shows all"
