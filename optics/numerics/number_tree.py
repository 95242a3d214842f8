"""Numbers with names: nested frozen dataclasses and tuples whose leaves are numbers or arrays of them.

A leaf is named by its path, the names of fields and the places in tuples that lead to it: ``("surface", "even", 0)``.
None stands for what is not there, and has no leaves.

A mapping that cannot be changed, so that values that hold one can be hashed, compared and pickled.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import fields, is_dataclass, replace
from functools import cache
from itertools import count
from typing import Any, NoReturn, TypeVar

Key = TypeVar("Key")
Value = TypeVar("Value")


class FrozenMap(dict[Key, Value]):
    """A dict that refuses changes; hashable when its values are."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))

    def __repr__(self) -> str:
        return f"FrozenMap({super().__repr__()})"

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (dict(self),)

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise TypeError(f"a {type(self).__name__} cannot be changed")

    __setitem__ = __delitem__ = clear = pop = popitem = setdefault = update = __ior__ = _refuse


Path = tuple[str | int, ...]
Tree = TypeVar("Tree")


def leaves(tree: Any) -> dict[Path, Any]:
    """Path -> leaf of every number in a tree, in the order of its fields."""
    found: dict[Path, Any] = {}
    _collect(tree, (), found)
    return found


def _collect(tree: Any, path: Path, found: dict[Path, Any]) -> None:
    if tree is None:
        return
    if isinstance(tree, tuple):
        for place, branch in enumerate(tree):
            _collect(branch, (*path, place), found)
        return
    names = _names(tree.__class__)
    if names is None:
        found[path] = tree
        return
    for name in names:
        _collect(getattr(tree, name), (*path, name), found)


def form_of(tree: Tree) -> Tree:
    """The form of a tree: in the place of each number its place in ``numbers_in``."""
    places = count()
    return map_leaves(lambda number: next(places), tree)


def numbers_in(tree: Any) -> list[Any]:
    """All numbers of a tree, in the order of its fields."""
    numbers: list[Any] = []
    _append_numbers(tree, numbers)
    return numbers


def _append_numbers(tree: Any, numbers: list[Any]) -> None:
    for branch in _branches(tree):
        if branch is None:
            continue
        if isinstance(branch, tuple) or _names(branch.__class__) is not None:
            _append_numbers(branch, numbers)
        else:
            numbers.append(branch)


def _branches(tree: Any) -> Iterable[Any]:
    """What a tuple or a dataclass holds, in the order of its fields."""
    return tree if isinstance(tree, tuple) else [getattr(tree, name) for name in _names(tree.__class__) or ()]


def map_leaves(function: Callable[..., Any], tree: Tree, *others: Any) -> Tree:
    """A tree of the same form whose leaves are ``function(leaf, its counterparts in the others)``.

    The others are of the form of ``tree``, but may have None where it has leaves; the result may, too.
    """
    mapped: Tree = _mapped(function, tree, others)
    return mapped


def _mapped(function: Callable[..., Any], tree: Any, others: tuple[Any, ...]) -> Any:
    if tree is None:
        return None
    if not others:
        return _mapped_alone(function, tree)
    if isinstance(tree, tuple):
        along = [_all(other, len(tree)) for other in others]
        return tuple([_mapped(function, branch, tuple(parts)) for branch, *parts in zip(tree, *along, strict=True)])
    names = _names(tree.__class__)
    if names is None:
        return function(tree, *others)
    branches = [
        _mapped(function, getattr(tree, name), tuple([getattr(other, name, None) for other in others]))
        for name in names
    ]
    return type(tree)(*branches)


def _mapped_alone(function: Callable[[Any], Any], tree: Any) -> Any:
    """Map the leaves of one tree. Every trace does this to hundreds of numbers, most of which stand side by side."""
    whole, names = isinstance(tree, tuple), _names(tree.__class__)
    if not whole and names is None:
        return function(tree)
    out: list[Any] = []
    for branch in _branches(tree):
        if branch is None:
            out.append(None)
        elif isinstance(branch, tuple) or _names(branch.__class__) is not None:
            out.append(_mapped_alone(function, branch))
        else:
            out.append(function(branch))
    return tuple(out) if whole else type(tree)(*out)


def _all(branches: tuple[Any, ...] | None, count: int) -> tuple[Any, ...]:
    return (None,) * count if branches is None else branches


def with_leaf(tree: Tree, path: Path, value: Any) -> Tree:
    """A copy in which the number at ``path`` is another one.

    Raises
    ------
    KeyError
        There is no number at that path.
    """
    known = leaves(tree)
    if path not in known:
        raise KeyError(f"no number {path}; there are {', '.join(map(str, known))}")
    return _rebuilt(tree, path, value)


def _rebuilt(tree: Any, path: Path, value: Any) -> Any:
    if not path:
        return value
    first, rest = path[0], path[1:]
    if isinstance(tree, tuple):
        return tuple(_rebuilt(branch, rest, value) if k == first else branch for k, branch in enumerate(tree))
    return replace(tree, **{str(first): _rebuilt(getattr(tree, str(first)), rest, value)})


@cache
def _names(kind: type) -> tuple[str, ...] | None:
    """Fields of a dataclass in the order of its arguments; None for the type of a leaf."""
    return tuple(field.name for field in fields(kind)) if is_dataclass(kind) else None
