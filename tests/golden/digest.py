"""Trees of numbers and texts made small enough to keep: mappings of one form as columns, long arrays as moments.

A condensed tree is JSON. Besides plain values it has these mappings:

- ``{"#names": [...], "#each": {key: column}}`` for a mapping whose values are mappings with the same keys, and
  ``{"#count": n, "#each": {...}}`` for a list of such; a column is the list of the values of one key, condensed;
- ``{"#array": shape, "kind": ..., "mean", "rms", "min", "max", "at": [...]}`` for a list of more than SHORT numbers;
- ``{"#texts": count, "digest", "numbers"}`` for many texts or a long one: a checksum of them without the numbers that
  are printed with decimals, and these numbers;
- ``{"#free": {path: sort}}`` for what differs from run to run: no value, only what kind of values it has.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from typing import Any

import numpy as np

SHORT = 8
"""Numbers of a list that are kept one by one; so many are kept of a longer one."""
LONG = 80
"""Characters of a text that is kept as it is."""
DIGITS = 11
"""Significant digits of numbers that are kept: some thousand times finer than what is compared."""
PRINTED = re.compile(r"[-−+]?(?:\d+\.\d+(?:e[-−+]?\d+)?|\d+e[-−+]?\d+)")
"""A number with decimals or an exponent in a text; whole numbers are text, to be equal."""


def checksum(data: bytes | str) -> str:
    """Return 64 bits of a SHA-256 in hexadecimal digits."""
    return hashlib.sha256(data if isinstance(data, bytes) else data.encode()).hexdigest()[:16]


def is_number(value: Any) -> bool:
    """Return whether a value is a number of JSON; true and false are none."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def rounded(value: Any) -> Any:
    """Return a number with DIGITS significant digits; whole numbers and anything else as they are."""
    if not isinstance(value, float) or not math.isfinite(value):
        return value
    return float(f"{value:.{DIGITS - 1}e}")


def skeleton(text: str) -> tuple[str, list[str]]:
    """Return a text with a mark for every number that is printed with decimals, and these numbers."""
    return PRINTED.sub("#", text), PRINTED.findall(text)


def texts(several: list[str]) -> dict[str, Any]:
    """Return the digest of several texts."""
    parts = [skeleton(text) for text in several]
    numbers = " ".join(number for _, found in parts for number in found)
    return {
        "#texts": len(several),
        "digest": checksum("\n".join(form for form, _ in parts)),
        "first": several[0][:24],
        "numbers": numbers,
    }


def array(values: Any, shape: list[int] | None = None) -> dict[str, Any]:
    """Return moments and a few elements of numbers; of whole numbers of a result also a checksum, for they are equal.

    Args:
        values: a NumPy array, or a flat list of numbers and None.
        shape: of a flat list.
    """
    flat = np.asarray(values)
    out: dict[str, Any] = {"#array": shape or list(flat.shape), "kind": flat.dtype.str.lstrip("<>|=")}
    flat = flat.ravel()
    if flat.dtype.kind == "O":
        out["none"] = [k for k, one in enumerate(values) if one is None][: 4 * SHORT]
        flat = np.array([math.nan if one is None else float(one) for one in values])
        out["kind"] = "f8"
    if flat.dtype.kind in "bi":
        out["whole"] = checksum(flat.astype("<i8").tobytes())
    picked = np.linspace(0, flat.size - 1, min(SHORT, flat.size)).round().astype(int)
    flat = flat.astype(np.float64)
    finite = flat[np.isfinite(flat)]
    out["finite"] = int(finite.size)
    if finite.size:
        moments = {
            "mean": math.fsum(finite) / finite.size,
            "rms": math.sqrt(math.fsum(finite * finite) / finite.size),
            "min": float(finite.min()),
            "max": float(finite.max()),
        }
        out |= {key: rounded(value) for key, value in moments.items()}
        out["at"] = [rounded(float(flat[k])) if math.isfinite(flat[k]) else None for k in picked]
    return out


def sorts(tree: Any) -> dict[str, str]:
    """Return the sort of every value of a plain or condensed tree: path -> number, text, true or false, null.

    In a path ``{a|b}`` stands for things of one sort by name and ``[]`` for the items of a list.
    """
    found: dict[str, set[str]] = {}
    _collect(tree, "", found)
    return {path: " or ".join(sorted(kinds - {"null"}) + sorted(kinds & {"null"})) for path, kinds in found.items()}


NAMES = 8
"""Of things of one sort so many are named; of more the first ones and an ellipsis."""
_KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_SORTS = {bool: "true or false", int: "number", float: "number", str: "text", type(None): "null"}


def _collect(tree: Any, path: str, found: dict[str, set[str]], each: bool = False) -> None:
    """Add the sorts below a path; ``each``: the tree is a column, whose items stand at the path itself."""
    item = path if each else path + "[]"
    if isinstance(tree, dict) and "#free" in tree:
        for below, sort in tree["#free"].items():
            place = f"{path}.{below}" if below else path
            found.setdefault(place.strip("."), set()).update(sort.split(" or "))
    elif isinstance(tree, dict) and "#each" in tree:
        start = item if "#count" in tree else f"{path}.{_braced(tree['#names'])}"
        for key, column in tree["#each"].items():
            _collect(column, f"{start}.{key}", found, True)
    elif isinstance(tree, dict) and "#array" in tree:
        place = path + "[]" * (len(tree["#array"]) - each)
        found.setdefault(place.lstrip("."), set()).update(tree.get("sorts", ["number"]))
    elif isinstance(tree, dict) and "#texts" in tree:
        found.setdefault((path if tree["#texts"] == 1 else item).lstrip("."), set()).add("text")
    elif isinstance(tree, dict):
        for key, below in tree.items():
            _collect(below, f"{path}.{_braced(tree) if _named(tree) else key}", found)
        if not tree:
            found.setdefault(path.lstrip("."), set()).add("mapping")
    elif isinstance(tree, list):
        for below in tree:
            _collect(below, item, found)
        if not tree:
            found.setdefault(item.lstrip("."), set())
    else:
        found.setdefault(path.lstrip("."), set()).add(_SORTS[type(tree)])


def alike(several: list[Any]) -> bool:
    """Return whether several values are mappings with the same keys."""
    return len(several) > 1 and all(isinstance(one, dict) and one and set(one) == set(several[0]) for one in several)


def _named(tree: dict[str, Any]) -> bool:
    """Return whether a mapping holds things of one sort by name: by their form, or since no key can be a name."""
    return alike(list(tree.values())) or any(not _KEY.fullmatch(key) for key in tree)


def _braced(names: Any) -> str:
    listed = [str(name) for name in names]
    return "{" + "|".join(listed[:NAMES]) + ("|..." if len(listed) > NAMES else "") + "}"


def condensed(tree: Any) -> Any:
    """Return a tree of JSON condensed, as the module's docstring says."""
    if isinstance(tree, dict):
        if "#free" in tree:
            return tree
        if alike(list(tree.values())) and "#free" not in next(iter(tree.values())):
            return {"#names": list(tree), "#each": _columns(list(tree.values()))}
        return {key: condensed(below) for key, below in tree.items()}
    if isinstance(tree, list):
        return _list(tree)
    if isinstance(tree, str):
        return tree if len(tree) <= LONG else texts([tree])
    return rounded(tree)


def _columns(several: list[dict[str, Any]]) -> dict[str, Any]:
    return {key: _list([one[key] for one in several]) for key in several[0]}


def _list(tree: list[Any]) -> Any:
    if alike(tree) and not any("#free" in one for one in tree):
        return {"#count": len(tree), "#each": _columns(tree)}
    shape, flat = _flat(tree)
    if len(flat) > SHORT and shape:
        kinds = {_SORTS[type(one)] for one in flat}
        if kinds == {"text"}:
            return texts(flat)
        if "text" in kinds:  # a column of a table with a name or nothing in some rows
            numbers = [one if is_number(one) else None for one in flat]
            said = [one for one in flat if isinstance(one, str)]
            return array(np.array(numbers, object), shape) | {"sorts": sorted(kinds), "texts": texts(said)}
        values = np.array(flat, object) if None in flat else np.array(flat)
        return array(values, shape) | ({} if kinds == {"number"} else {"sorts": sorted(kinds)})
    return [condensed(one) for one in tree]


def _flat(tree: list[Any]) -> tuple[list[int], list[Any]]:
    """Return shape and items of nested lists of single values; -1 for lists of several lengths, no shape for others."""
    below = [_flat(one) if isinstance(one, list) else ([], [one]) for one in tree]
    lists = {isinstance(one, list) for one in tree}
    if len(lists) != 1 or any(isinstance(one, dict) for one in tree):
        return [], []
    shapes = [shape for shape, _ in below]
    if lists == {True} and (not all(shapes) or len({len(shape) for shape in shapes}) > 1):
        return [], []
    rest = [sizes[0] if len(set(sizes)) == 1 else -1 for sizes in zip(*shapes, strict=True)]
    return [len(tree), *rest], [item for _, items in below for item in items]


def expanded(tree: Any) -> Any:
    """Return a condensed tree with its columns as mappings again; of an array of truth values whether all are true."""
    if isinstance(tree, list):
        return [expanded(one) for one in tree]
    if not isinstance(tree, dict):
        return tree
    if "#each" not in tree:
        return bool(tree["min"]) if tree.get("kind") == "b1" else {key: expanded(one) for key, one in tree.items()}
    columns = {key: expanded(column) for key, column in tree["#each"].items()}
    count = tree.get("#count") or len(tree["#names"])
    rows = [
        {key: one[k] if isinstance(one, list) and len(one) == count else one for key, one in columns.items()}
        for k in range(count)
    ]
    return dict(zip(tree["#names"], rows, strict=True)) if "#names" in tree else rows


def flattened(tree: Any, place: str = "") -> dict[str, Any]:
    """Return place -> value of every leaf of a condensed tree, in its order."""
    if isinstance(tree, dict) and tree and "#free" not in tree:
        parts = [(f"{place} / {key}" if place else str(key), below) for key, below in tree.items()]
    elif isinstance(tree, list) and tree:
        parts = [(f"{place}[{k}]", below) for k, below in enumerate(tree)]
    else:
        return {place: json.dumps("free") if isinstance(tree, dict) and tree else tree}
    return {key: value for start, below in parts for key, value in flattened(below, start).items()}
