"""Mutators of a file's tree, of its names and paths, and of what YAML has beyond plain data."""

from __future__ import annotations

import copy
import random
import re
from collections.abc import Callable, Iterator
from typing import Any

from scenes.yaml.yaml_file import dump_yaml, parse_yaml
from tests.robustness.nasty import BLOCKS, DIRECTIVES, DOCUMENTS, KEYS, MERGES, NOTHING, PATHS, TAGS, TEXTS, VALUES

Mutator = Callable[[str, random.Random], str]
Edit = Callable[[Any, Any, Any, random.Random], None]
QUANTITY = re.compile(r"[-+\d.]+(e[-+]?\d+)? \S+$")
SIZES = (0, -1, 1, 10, 100, "1e3", "1e6", "1e12", "1e-3", "1e-9", "1e-15", -5, 45, 90, 359, "1e150")
COUNTS = (0, 1, -1, 2, 3, 7, 1000, 100_000, 10**7, 10**12, 2**31, 2**64, 0.5, -0.5, 1e-9, 1e9)


def _places(data: Any, key: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for name, value in items:
        yield (*key, name)
        yield from _places(value, (*key, name))


def _at(data: Any, key: tuple[Any, ...]) -> Any:
    for part in key:
        data = data[part]
    return data


def _edits(only: Callable[[Any], bool] = lambda value: True) -> Callable[[Edit], Mutator]:
    """Make ``edit(holder, name, root, chance)`` a mutator at a random place whose value passes ``only``."""

    def mutator_of(edit: Edit) -> Mutator:
        def mutator(text: str, chance: random.Random) -> str:
            data = parse_yaml(text).data
            place = chance.choice([place for place in _places(data) if only(_at(data, place))])
            edit(_at(data, place[:-1]), place[-1], data, chance)
            return dump_yaml(data)

        mutator.__name__ = edit.__name__
        return mutator

    return mutator_of


def _full_list(value: Any) -> bool:
    return isinstance(value, list) and bool(value)


@_edits()
def value(holder: Any, name: Any, root: Any, chance: random.Random) -> None:
    """Another value."""
    holder[name] = copy.deepcopy(chance.choice((*VALUES, *TEXTS)))


@_edits()
def drop(holder: Any, name: Any, root: Any, chance: random.Random) -> None:
    """Nothing."""
    del holder[name]


@_edits(lambda value: True)
def rename(holder: Any, name: Any, root: Any, chance: random.Random) -> None:
    """Another key."""
    if isinstance(holder, dict):
        holder[chance.choice((*TEXTS, *PATHS, name + "x", name[:-1], name.upper()))] = holder.pop(name)


@_edits()
def graft(holder: Any, name: Any, root: Any, chance: random.Random) -> None:
    """What stands at one place also stands at another."""
    new = copy.deepcopy(_at(root, chance.choice(list(_places(root)))))
    holder[f"{name}2" if isinstance(holder, dict) and chance.random() < 0.4 else name] = new


@_edits()
def exchange(holder: Any, name: Any, root: Any, chance: random.Random) -> None:
    """Two keys of a mapping, or two items of a list, exchange their values."""
    other = chance.choice(list(holder) if isinstance(holder, dict) else list(range(len(holder))))
    holder[name], holder[other] = holder[other], holder[name]


@_edits(_full_list)
def items(holder: Any, name: Any, root: Any, chance: random.Random) -> None:
    """A list is made longer, shorter, empty, or turned around."""
    old = holder[name]
    holder[name] = chance.choice(
        (old[:-1], old[1:], [], old + old[-1:], old * 3, old[::-1], old[:1] * 300, [old], sorted(old, key=str))
    )


@_edits()
def wrap(holder: Any, name: Any, root: Any, chance: random.Random) -> None:
    """A value stands in a list or mapping, deep or not."""
    for _ in range(chance.choice((1, 1, 2, 20, 40, 200))):
        holder[name] = [holder[name]] if chance.random() < 0.5 else {str(name): holder[name]}


@_edits(lambda value: isinstance(value, dict | list) and bool(value))
def unwrap(holder: Any, name: Any, root: Any, chance: random.Random) -> None:
    """A mapping or list is replaced by one of its values."""
    inside = holder[name]
    holder[name] = chance.choice(list(inside.values() if isinstance(inside, dict) else inside))


@_edits(lambda value: isinstance(value, str) and QUANTITY.match(value) is not None)
def quantity(holder: Any, name: Any, root: Any, chance: random.Random) -> None:
    """Another number of the right unit: the most likely mistake that the schema lets through."""
    holder[name] = f"{chance.choice(SIZES)} {holder[name].partition(' ')[2]}"


@_edits(lambda value: isinstance(value, int | float) and not isinstance(value, bool))
def count(holder: Any, name: Any, root: Any, chance: random.Random) -> None:
    """Another whole or plain number."""
    holder[name] = chance.choice(COUNTS)


@_edits(lambda value: isinstance(value, bool))
def flag(holder: Any, name: Any, root: Any, chance: random.Random) -> None:
    """The opposite."""
    holder[name] = not holder[name]


@_edits(lambda value: isinstance(value, dict) or (isinstance(value, str) and re.match(r"[-+]?\d", value) is None))
def paths(holder: Any, name: Any, root: Any, chance: random.Random) -> None:
    """A name, a key or a text becomes a path that leads astray."""
    new = chance.choice(PATHS)
    if isinstance(holder, dict) and chance.random() < 0.4:
        holder[new] = holder.pop(name)
    else:
        holder[name] = new


TREES: tuple[Mutator, ...] = (
    *(value, value, drop, drop, rename, graft, graft, exchange, items, items, wrap, unwrap),
    *(quantity, quantity, quantity, quantity, count, count, flag),
)


# --- what YAML has beyond plain data


def _before_value(name: str, new: tuple[str, ...]) -> Mutator:
    """Something before a value."""

    def mutator(text: str, chance: random.Random) -> str:
        at = chance.choice(list(re.finditer(r": (?=\S)", text))).end()
        return text[:at] + chance.choice(new) + text[at:]

    mutator.__name__ = name
    return mutator


def _around(name: str, new: tuple[str, ...]) -> Mutator:
    """Something before the text, behind it or in its place: texts in which {} stands for it."""

    def mutator(text: str, chance: random.Random) -> str:
        return chance.choice(new).replace("{}", text)

    mutator.__name__ = name
    return mutator


def bomb(text: str, chance: random.Random) -> str:
    """Billion laughs."""
    lines = ["a0: &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 10)]
    return chance.choice(("\n".join(lines) + "\n" + text, text + "\n" + "\n".join(lines) + "\n"))


def duplicate(text: str, chance: random.Random) -> str:
    """A line stands twice."""
    lines = text.split("\n")
    k = chance.randrange(len(lines))
    return "\n".join([*lines[: k + 1], lines[k], *lines[k + 1 :]])


tag = _before_value("tag", TAGS)
YAMLS: tuple[Mutator, ...] = (
    *(bomb, duplicate, tag, tag, _before_value("anchor", ("&x ", "*x ", "&x &y ", "* ", "& ", "&x\n*x "))),
    *(_before_value("block", BLOCKS), _around("merge", MERGES), _around("documents", DOCUMENTS)),
    *(_around("directive", DIRECTIVES), _around("only_comment", NOTHING)),
    _around("complex_key", (*(f"{key}{{}}" for key in KEYS), *(f"{{}}\n{key}" for key in KEYS))),
)
