"""All groups of checks, and how they are selected by the beginnings of their ids."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from optics.numerics.extension_table import ExtensionTable, entries
from scenes.yaml.errors import nearest
from scenes.yaml.named import Named
from twin.validation.row_names import matches, names_in_files

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
)
"""Where each group is. A new one is added here."""

GROUPS: tuple[CheckGroup, ...]
"""Every group, in the order in which they run; imported when it is asked for."""


def __getattr__(name: str) -> Any:
    if name != "GROUPS":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from twin.validation.group import CheckGroup

    others = ExtensionTable[CheckGroup]("check_groups", {}, CheckGroup)
    found = globals()[name] = (*(named.get() for named in _GROUPS), *others.values())
    return found


class UnknownCheck(Exception):
    """A prefix under which there is no check; the message names the nearest."""


@dataclass(frozen=True)
class Selection:
    """A group and those of its ids that are wanted."""

    group: CheckGroup
    ids: frozenset[str]


def require_unique(groups: Iterable[CheckGroup]) -> None:
    """Refuse groups or ids that come twice.

    Raises
    ------
    ValueError
        One does.
    """
    groups = tuple(groups)
    names = Counter(group.prefix for group in groups)
    ids = Counter(name for group in groups for check in group.checks for name in check.names)
    twice = [name for counter in (names, ids) for name, count in counter.items() if count > 1]
    if twice:
        raise ValueError(f"registered twice: {', '.join(twice)}")


def select(groups: Sequence[CheckGroup], only: str | None) -> tuple[Selection, ...]:
    """The groups, with the ids that lie under one of the prefixes; all where ``only`` is None.

    Parameters
    ----------
    groups : Sequence[CheckGroup]
        All there are.
    only : str | None
        Prefixes, separated by commas, that end where a part of an id ends; a row's further ids count as well.

    Raises
    ------
    UnknownCheck
        There is nothing under one of them.
    """
    require_unique(groups)
    if only is None:
        return tuple(Selection(group, frozenset(group.ids)) for group in groups)
    prefixes = _known(only, [name for group in groups for check in group.checks for name in check.names])
    out = []
    for group in groups:
        chosen = frozenset(c.id for c in group.checks if any(matches(n, p) for n in c.names for p in prefixes))
        if chosen:
            out.append(Selection(group, chosen))
    return tuple(out)


def require_known(only: str | None) -> None:
    """Refuse what `select` would refuse, without any group where none has been imported yet.

    Raises
    ------
    UnknownCheck
        There is nothing under one of the prefixes.
    """
    # other distributions' groups are in no file of ours
    if only is not None and not entries() and "GROUPS" not in globals():
        _known(only, names_in_files())


def _known(only: str, ids: Sequence[str]) -> list[str]:
    """The prefixes, all of which have ids under them.

    Raises
    ------
    UnknownCheck
        One has not.
    """
    prefixes = [part.strip() for part in only.split(",")]
    for prefix in prefixes:
        if not any(matches(identifier, prefix) for identifier in ids):
            raise UnknownCheck(_unknown(prefix, ids))
    return prefixes


def _unknown(prefix: str, ids: Sequence[str]) -> str:
    """What is wrong with a prefix, and what was meant."""
    if not prefix:
        return "an empty id; --only takes ids or their beginnings, separated by commas, and --list shows them"
    # everything that could have been given; whole parts only
    known = {".".join(parts[:n]): None for i in ids for parts in [i.split(".")] for n in range(1, len(parts) + 1)}
    bare = prefix.strip(".")
    meant = bare if bare in known else nearest(bare, known)
    return f"no check {prefix!r}; " + (f"did you mean {meant!r}? " if meant else "") + "--list shows all"
