"""The page of the library: what ``import twin`` offers, from the docstrings."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import pkgutil
import re
from collections.abc import Iterable
from functools import cache
from typing import Any

import twin

INTRODUCTION = """# The library: `import twin`

```python
import twin

pair = twin.load("gf7_pair")
bent = pair.perturbed({"base/forward/M2": {"shift": "0 0 3 um"}})
shot = bent.render(frames=9, seed=1)
pair.recover(shot.before, shot.after).compare(shot.truth)
```

Keys and unit strings are those of the [files](files/index.md), values are immutable, tables are pandas', arrays
xarray's with their units. What is wrong with a value raises `InputError` with key, what was found and what is
allowed. The commands do the same and write it down.
"""


def api_page() -> str:
    """Markdown of the page, whose directives read the docstrings."""
    things = {name: _meant(name) for name in twin.__all__}
    functions = [name for name, thing in things.items() if not inspect.isclass(thing)]
    classes = [name for name, thing in things.items() if inspect.isclass(thing)]
    parts = [INTRODUCTION]
    parts += [f"## `twin.{name}`\n\n{_directive(things[name])}" for name in (*sorted(functions), *sorted(classes))]
    further = given_back(things.values())
    if further:
        parts.append("## What these give\n")
        parts += [f"### `{thing.__name__}`\n\n{_directive(thing)}" for thing in further]
    return "\n".join(parts)


def _meant(name: str) -> Any:
    """What a name of ``twin`` stands for; of a package that can be called the function that a call comes to."""
    thing = getattr(twin, name)
    if not inspect.ismodule(thing):
        return thing
    return getattr(importlib.import_module(f"{thing.__name__}.scripted"), name)


def given_back(things: Iterable[Any]) -> list[type[Any]]:
    """Classes of the twin that functions, methods and properties of others give back, and are not among them."""
    todo, found = list(things), []
    known = {thing for thing in todo if inspect.isclass(thing)}
    while todo:
        for one in _returned(todo.pop(0)):
            if one not in known:
                known.add(one)
                found.append(one)
                todo.append(one)
    return found


OPEN = ("twin.scripting", "twin.camera", "twin.study.scripted")
"""Rooms whose classes scripts work with; what else comes to light, as an experiment, is the program's own."""


def _returned(thing: Any) -> list[type[Any]]:
    members = [thing] if not inspect.isclass(thing) else [m for n, m in vars(thing).items() if not n.startswith("_")]
    out = []
    for member in members:
        function = getattr(member, "fget", None) or getattr(member, "func", None) or member
        said = getattr(function, "__annotations__", {}).get("return", "")
        # by name, for what is imported only to check types
        out += [_classes()[name] for name in re.findall(r"\w+", str(said)) if name in _classes()]
    return out


@cache
def _classes() -> dict[str, type[Any]]:
    """Name -> class, of all that are defined in the rooms of `OPEN`."""
    out = {}
    for room in OPEN:
        if importlib.util.find_spec(room) is None:
            continue
        module = importlib.import_module(room)
        below = [f"{room}.{one.name}" for one in pkgutil.iter_modules(getattr(module, "__path__", ()))]
        for part in (module, *map(importlib.import_module, below)):
            out |= {
                name: one
                for name, one in vars(part).items()
                if inspect.isclass(one) and one.__module__ == part.__name__ and not name.startswith("_")
            }
    return out


def _directive(thing: Any) -> str:
    sort = "autoclass" if inspect.isclass(thing) else "autofunction"
    options = "\n   :members:" if inspect.isclass(thing) else ""
    return f"```{{eval-rst}}\n.. {sort}:: {thing.__module__}.{thing.__qualname__}{options}\n```\n"
