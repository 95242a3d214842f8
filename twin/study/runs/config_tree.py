"""Places in the plain data of a resolved job: whether a key path leads to a value, and the data with values changed."""

from __future__ import annotations

import copy
import typing
from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from scenes.yaml.errors import KeyPath, Problem, names_text, nearest, shown
from scenes.yaml.spec import Spec, annotation_at

Tree = dict[str, Any]


def with_place(tree: Tree, model: type[Spec], key: KeyPath) -> Tree:
    """The tree in which ``key`` leads to a single value; what is missing but may be there is made with its defaults.

    Args:
        tree: plain data of a ``model``; not changed.
        model: what the tree describes.
        key: keys and list indices from the root.

    Raises:
        Problem: it leads nowhere; ``within`` is the part that does not fit.
    """
    out = copy.deepcopy(tree)
    node: Any = out
    for k, part in enumerate(key):
        last = k == len(key) - 1
        if isinstance(node, dict):
            node = _entry(node, model, key, k, last)
        elif isinstance(node, list):
            if not isinstance(part, int) or not 0 <= part < len(node):
                raise Problem("no such place in a list", shown(part), f"0 to {len(node) - 1}", within=(k,))
            node = node[part]
        else:
            raise Problem("a single value has nothing below it", shown(part), "a shorter key", within=(k,))
    if isinstance(node, dict | list):
        below = names_text(node) if isinstance(node, dict) else f"0 to {len(node) - 1}"
        raise Problem("not a single value", shown(node), f"one of {below} after it")
    return out


def _entry(node: Tree, model: type[Spec], key: KeyPath, k: int, last: bool) -> Any:
    """What stands below ``key[k]`` in a mapping, made if it may be there."""
    part = key[k]
    if part in node:
        return node[part]
    annotation = annotation_at(model, key[:k])
    fields = _fields(annotation)
    # a mapping with free keys may get another entry, one with fields only those that it may have
    known = tuple(dict.fromkeys((*node, *fields)))
    free = typing.get_origin(annotation) is not None and not fields
    made = _default(annotation_at(model, key[: k + 1])) if isinstance(part, str) and (free or part in fields) else None
    if made is None and not (last and isinstance(part, str) and (free or part in fields)):
        suggestion = nearest(str(part), [str(name) for name in known])
        raise Problem("no such key", shown(part), names_text(known), suggestion, within=(k,))
    node[str(part)] = made
    return made


def _fields(annotation: Any) -> tuple[str, ...]:
    return tuple(annotation.model_fields) if _is_model(annotation) else ()


def _default(annotation: Any) -> Any:
    """Plain data of what a value is when nothing is said of it; None if there is no such thing."""
    if not _is_model(annotation):
        return {} if typing.get_origin(annotation) is dict else None
    try:
        return annotation().model_dump(mode="json", exclude_none=True)
    except ValidationError:
        return None


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def with_values(tree: Tree, values: Iterable[tuple[KeyPath, Any]]) -> Tree:
    """The tree with other values at places that are there; what is not changed is shared with ``tree``."""
    out = dict(tree)
    own = {id(out)}
    for key, value in values:
        node: Any = out
        for part in key[:-1]:
            below = node[part]
            if id(below) not in own:
                below = below.copy()
                own.add(id(below))
                node[part] = below
            node = below
        node[key[-1]] = value
    return out


def leaf(tree: Any, key: KeyPath) -> Any:
    """What stands at ``key`` of results.

    Raises:
        Problem: nothing does; ``within`` is the part that does not fit.
    """
    node = tree
    for k, part in enumerate(key):
        if isinstance(node, Mapping):
            if part not in node:
                known = [str(name) for name in node]
                raise Problem("no such key", shown(part), names_text(known), nearest(str(part), known), within=(k,))
        elif not isinstance(node, list | tuple):
            raise Problem("a single value has nothing below it", shown(part), "a shorter key", within=(k,))
        elif not isinstance(part, int) or not 0 <= part < len(node):
            raise Problem("no such place in a list", shown(part), f"0 to {len(node) - 1}", within=(k,))
        node = node[part]
    return node
