"""Numbers with names: nested frozen dataclasses and tuples whose leaves are numbers or arrays of them.

A leaf is named by its path, the names of fields and the places in tuples that lead to it: ``("surface", "even", 0)``.
None stands for what is not there, and has no leaves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

Path = tuple[str | int, ...]
Tree = TypeVar("Tree")


def leaves(tree: Any) -> dict[Path, Any]:
    """Path -> leaf of every number in a tree, in the order of its fields."""
    if tree is None:
        return {}
    branches = _branches(tree)
    if branches is None:
        return {(): tree}
    return {(name, *path): leaf for name, branch in branches.items() for path, leaf in leaves(branch).items()}


def map_leaves(function: Callable[..., Any], tree: Tree, *others: Any) -> Tree:
    """A tree of the same form whose leaves are ``function(leaf, its counterparts in the others)``.

    The others are of the form of ``tree``, but may have None where it has leaves; the result may, too.
    """
    whole: Any = tree
    if whole is None:
        return tree
    branches = _branches(whole)
    if branches is None:
        result: Any = function(whole, *others)
        return result
    along = [{} if other is None else _branches(other) or {} for other in others]
    mapped = {
        name: map_leaves(function, branch, *(other.get(name) for other in along)) for name, branch in branches.items()
    }
    made: Any = tuple(mapped.values()) if isinstance(whole, tuple) else type(whole)(**mapped)
    return made


def with_leaf(tree: Tree, path: Path, value: Any) -> Tree:
    """A copy in which the number at ``path`` is another one.

    Raises:
        KeyError: there is no number at that path.
    """
    known = leaves(tree)
    if path not in known:
        raise KeyError(f"no number {path}; there are {', '.join(map(str, known))}")
    return _rebuilt(tree, path, value)


def _rebuilt(tree: Any, path: Path, value: Any) -> Any:
    if not path:
        return value
    branches = _branches(tree) or {}
    changed = {**branches, path[0]: _rebuilt(branches[path[0]], path[1:], value)}
    return tuple(changed.values()) if isinstance(tree, tuple) else type(tree)(**changed)


def _branches(tree: Any) -> dict[Any, Any] | None:
    """What a dataclass or a tuple holds, by name; None for a leaf."""
    if isinstance(tree, tuple):
        return dict(enumerate(tree))
    if is_dataclass(tree) and not isinstance(tree, type):
        return {field.name: getattr(tree, field.name) for field in fields(tree)}
    return None
