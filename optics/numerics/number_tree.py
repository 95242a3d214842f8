"""Trees of named numbers, and an immutable mapping.

A tree consists of nested frozen dataclasses and tuples whose leaves are numbers or arrays of them. A leaf is named by
its path, the field names and tuple indices that lead to it: ``("surface", "even", 0)``. None stands for an absent
branch, and has no leaves.

``FrozenMap`` is a dict that cannot be changed, so that values that contain one can be hashed, compared and pickled.
"""

from collections.abc import Callable, Iterable
from dataclasses import fields, is_dataclass, replace
from functools import cache
from itertools import count
from typing import Any, NoReturn, TypeVar

Key = TypeVar("Key")
Value = TypeVar("Value")


class FrozenMap(dict[Key, Value]):
    """Immutable dict: every change raises an error. It is hashable when its values are."""

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
    """Return a mapping from path to number for every number in a tree, in the order of its fields."""
    out: dict[Path, Any] = {}
    _collect(tree, (), out)
    return out


def _collect(tree: Any, path: Path, out: dict[Path, Any]) -> None:
    """Add the numbers of a tree to ``out`` (path -> number); their paths begin with ``path``."""
    if tree is None:
        return
    if isinstance(tree, tuple):
        for index, branch in enumerate(tree):
            _collect(branch, (*path, index), out)
        return
    names = _names(tree.__class__)
    if names is None:
        out[path] = tree
        return
    for name in names:
        _collect(getattr(tree, name), (*path, name), out)


def form_of(tree: Tree) -> Tree:
    """Return the tree with each number replaced by its index in the list of all its numbers (``numbers_in``).

    Trees of equal form differ in their numbers only.
    """
    indices = count()
    return map_leaves(lambda number: next(indices), tree)


def numbers_in(tree: Any) -> list[Any]:
    """Return all numbers of a tree, in the order of its fields."""
    numbers: list[Any] = []
    _append_numbers(tree, numbers)
    return numbers


def _append_numbers(tree: Any, numbers: list[Any]) -> None:
    """Append all numbers of a tree to a list."""
    for branch in _branches(tree):
        if branch is None:
            continue
        if isinstance(branch, tuple) or _names(branch.__class__) is not None:
            _append_numbers(branch, numbers)
        else:
            numbers.append(branch)


def _branches(tree: Any) -> Iterable[Any]:
    """Return the elements of a tuple or the field values of a dataclass, in order."""
    return tree if isinstance(tree, tuple) else [getattr(tree, name) for name in _names(tree.__class__) or ()]


def map_leaves(function: Callable[..., Any], tree: Tree, *others: Any) -> Tree:
    """Return a tree of the same form whose leaves are ``function(leaf, corresponding leaves of the others)``.

    The others have the form of ``tree``, but may have None where it has leaves; the result may, too.
    """
    mapped: Tree = _mapped(function, tree, others)
    return mapped


def _mapped(function: Callable[..., Any], tree: Any, others: tuple[Any, ...]) -> Any:
    """Return a branch with the function applied to each leaf and to the corresponding leaves of the others."""
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
    """Return a tree with the function applied to each leaf.

    Every trace does this for hundreds of numbers, most of which are siblings; hence this fast path.
    """
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
    """Return the elements of a branch, or a tuple of ``count`` times None for an absent branch."""
    return (None,) * count if branches is None else branches


def with_leaf(tree: Tree, path: Path, value: Any) -> Tree:
    """Return a copy of the tree in which the number at ``path`` is replaced by ``value``.

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
    """Return a copy of a branch in which the number at ``path`` is replaced by ``value``."""
    if not path:
        return value
    first, rest = path[0], path[1:]
    if isinstance(tree, tuple):
        return tuple(_rebuilt(branch, rest, value) if k == first else branch for k, branch in enumerate(tree))
    return replace(tree, **{str(first): _rebuilt(getattr(tree, str(first)), rest, value)})


@cache
def _names(kind: type) -> tuple[str, ...] | None:
    """Return the fields of a dataclass in the order of its arguments; None for the type of a leaf."""
    return tuple(field.name for field in fields(kind)) if is_dataclass(kind) else None
