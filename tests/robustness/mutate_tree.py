"""Mutators of a file's tree, of its names and paths, and of what YAML has beyond plain data."""

from __future__ import annotations

import copy
import random
import re
from collections.abc import Callable, Iterator
from typing import Any

from scenes.yaml.yaml_file import dump_yaml, parse_yaml
from tests.robustness.nasty import PATHS, TEXTS, VALUES


def _places(data: Any, key: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for name, value in items:
        yield (*key, name)
        yield from _places(value, (*key, name))


def _at(data: Any, key: tuple[Any, ...]) -> Any:
    for part in key:
        data = data[part]
    return data


def _edited(
    text: str, chance: random.Random, edit: Callable[[Any, Any, Any], None], only: Callable = lambda v: True
) -> str:
    """``edit(holder, name, root)`` at a random place whose value passes ``only``."""
    data = parse_yaml(text).data
    places = [place for place in _places(data) if only(_at(data, place))]
    place = places[chance.randrange(len(places))]
    edit(_at(data, place[:-1]), place[-1], data)
    return dump_yaml(data)


def value(text: str, chance: random.Random) -> str:
    def edit(holder: Any, name: Any, root: Any) -> None:
        holder[name] = copy.deepcopy(chance.choice((*VALUES, *TEXTS)))

    return _edited(text, chance, edit)


def drop(text: str, chance: random.Random) -> str:
    def edit(holder: Any, name: Any, root: Any) -> None:
        del holder[name]

    return _edited(text, chance, edit)


def rename(text: str, chance: random.Random) -> str:
    def edit(holder: Any, name: Any, root: Any) -> None:
        if isinstance(holder, dict):
            holder[chance.choice((*TEXTS, *PATHS, name + "x", name[:-1], name.upper()))] = holder.pop(name)

    return _edited(text, chance, edit)


def graft(text: str, chance: random.Random) -> str:
    """What stands at one place also stands at another."""

    def edit(holder: Any, name: Any, root: Any) -> None:
        places = list(_places(root))
        new = copy.deepcopy(_at(root, places[chance.randrange(len(places))]))
        if isinstance(holder, dict) and chance.random() < 0.4:
            holder[f"{name}2"] = new
        else:
            holder[name] = new

    return _edited(text, chance, edit)


def exchange(text: str, chance: random.Random) -> str:
    """Two keys of a mapping, or two items of a list, change their values."""

    def edit(holder: Any, name: Any, root: Any) -> None:
        names = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
        other = chance.choice(names)
        holder[name], holder[other] = holder[other], holder[name]

    return _edited(text, chance, edit)


def items(text: str, chance: random.Random) -> str:
    """A list is made longer, shorter, empty, or turned around."""

    def edit(holder: Any, name: Any, root: Any) -> None:
        old = holder[name]
        holder[name] = chance.choice(
            (old[:-1], old[1:], [], old + old[-1:], old * 3, old[::-1], old[:1] * 300, [old], sorted(old, key=str))
        )

    return _edited(text, chance, edit, lambda v: isinstance(v, list) and bool(v))


def wrap(text: str, chance: random.Random) -> str:
    """A value stands in a list or mapping, deep or not."""
    depth = chance.choice((1, 1, 2, 20, 40, 200))

    def edit(holder: Any, name: Any, root: Any) -> None:
        inner = holder[name]
        for _ in range(depth):
            inner = [inner] if chance.random() < 0.5 else {str(name): inner}
        holder[name] = inner

    return _edited(text, chance, edit)


def unwrap(text: str, chance: random.Random) -> str:
    """A mapping or list is replaced by one of its values."""

    def edit(holder: Any, name: Any, root: Any) -> None:
        inside = holder[name]
        holder[name] = chance.choice(list(inside.values() if isinstance(inside, dict) else inside))

    return _edited(text, chance, edit, lambda v: isinstance(v, dict | list) and bool(v))


def quantity(text: str, chance: random.Random) -> str:
    """A quantity with another number of the right unit: the most likely mistake that the schema lets through."""

    def edit(holder: Any, name: Any, root: Any) -> None:
        _, _, own = holder[name].partition(" ")
        new = chance.choice(
            (
                "0",
                "-1",
                "1",
                "10",
                "100",
                "1e3",
                "1e6",
                "1e12",
                "1e-3",
                "1e-9",
                "1e-15",
                "-5",
                "45",
                "90",
                "359",
                "1e150",
            )
        )
        holder[name] = f"{new} {own}"

    return _edited(
        text, chance, edit, lambda v: isinstance(v, str) and re.match(r"[-+\d.]+(e[-+]?\d+)? \S+$", v) is not None
    )


def count(text: str, chance: random.Random) -> str:
    """Another whole or plain number."""

    def edit(holder: Any, name: Any, root: Any) -> None:
        new = (0, 1, -1, 2, 3, 7, 1000, 100_000, 10**7, 10**12, 2**31, 2**64, 0.5, -0.5, 1e-9, 1e9)
        holder[name] = chance.choice(new)

    return _edited(text, chance, edit, lambda v: isinstance(v, int | float) and not isinstance(v, bool))


def flag(text: str, chance: random.Random) -> str:
    def edit(holder: Any, name: Any, root: Any) -> None:
        holder[name] = not holder[name]

    return _edited(text, chance, edit, lambda v: isinstance(v, bool))


TREES: tuple[Callable[[str, random.Random], str], ...] = (
    *(value, value, drop, drop, rename, graft, graft, exchange, items, items, wrap, unwrap),
    *(quantity, quantity, quantity, quantity, count, count, flag),
)


def paths(text: str, chance: random.Random) -> str:
    """A name, a key or a text becomes a path that leads astray."""

    def edit(holder: Any, name: Any, root: Any) -> None:
        new = chance.choice(PATHS)
        if isinstance(holder, dict) and chance.random() < 0.4:
            holder[new] = holder.pop(name)
        else:
            holder[name] = new

    def names(v: Any) -> bool:
        return isinstance(v, dict) or (isinstance(v, str) and re.match(r"[-+]?\d", v) is None)

    return _edited(text, chance, edit, names)


# --- what YAML has beyond plain data


def _value_end(text: str, chance: random.Random) -> int:
    found = list(re.finditer(r": (?=\S)", text))
    return found[chance.randrange(len(found))].end()


def bomb(text: str, chance: random.Random) -> str:
    """Billion laughs."""
    lines = ["a0: &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 10)]
    return chance.choice(("\n".join(lines) + "\n" + text, text + "\n" + "\n".join(lines) + "\n"))


def anchor(text: str, chance: random.Random) -> str:
    at = _value_end(text, chance)
    return text[:at] + chance.choice(("&x ", "*x ", "&x &y ", "* ", "& ", "&x\n*x ")) + text[at:]


def merge(text: str, chance: random.Random) -> str:
    return text + chance.choice(("\n<<: {a: 1}\n", "\n<<: *x\n", "\n'<<': {a: 1}\n", "\nx:\n  <<: [{a: 1}]\n"))


def tag(text: str, chance: random.Random) -> str:
    at = _value_end(text, chance)
    new = (
        *(
            "!!python/object/apply:os.system ",
            "!!python/name:os.system ",
            "!!python/object:scenes.specs.job.JobSpec ",
            "!x ",
            "! ",
        ),
        *(
            "!!float ",
            "!!set ",
            "!!omap ",
            "!!binary ",
            "!!timestamp ",
            "!<tag:yaml.org,2002:str> ",
            "!<> ",
            "!%zz ",
            "!!",
        ),
    )
    return text[:at] + chance.choice(new) + text[at:]


def documents(text: str, chance: random.Random) -> str:
    return chance.choice(
        (text + "\n---\n" + text, "---\n" + text, text + "\n...\n", text + "\n...\nx: 1\n", "--- \n---\n", "...", "")
    )


def directive(text: str, chance: random.Random) -> str:
    new = (
        "%YAML 1.1\n---\n",
        "%YAML 9.9\n---\n",
        "%TAG ! x:\n---\n",
        "%FOO bar\n---\n",
        "%YAML 1.2\n",
        "%",
        "%YAML 1.1\n%YAML 1.1\n---\n",
    )
    return chance.choice(new) + text


def only_comment(text: str, chance: random.Random) -> str:
    return chance.choice(
        (
            "# nothing\n",
            "\n\n",
            "~\n",
            "''\n",
            "3\n",
            "text\n",
            "[]\n",
            "{}\n",
            "- 1\n",
            "? \n",
            "null: null\n",
            ".nan\n",
        )
    )


def complex_key(text: str, chance: random.Random) -> str:
    new = (
        "? [1, 2]\n: 3\n",
        "? {a: b}\n: 3\n",
        "? |\n  a\n  b\n: 3\n",
        "1: 2\n",
        "true: 2\n",
        "~: 2\n",
        "'': 2\n",
        "? x\n",
        "[a]: 1\n",
        ": 1\n",
    )
    return chance.choice((chance.choice(new) + text, text + "\n" + chance.choice(new)))


def block(text: str, chance: random.Random) -> str:
    """A value becomes a block scalar."""
    at = _value_end(text, chance)
    end = text.find("\n", at)
    style = chance.choice(("|", ">", "|-", ">+", "|2", "|9", ">0", "|x"))
    return text[:at] + f"{style}\n" + " " * chance.choice((2, 8, 30)) + text[at:end] + text[end:]


def duplicate(text: str, chance: random.Random) -> str:
    lines = text.split("\n")
    k = chance.randrange(len(lines))
    return "\n".join([*lines[: k + 1], lines[k], *lines[k + 1 :]])


YAMLS: tuple[Callable[[str, random.Random], str], ...] = (
    *(bomb, anchor, merge, tag, tag, documents, directive, only_comment, complex_key, block, duplicate),
)
