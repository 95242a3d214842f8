"""Numbers of a run as plain data: a dataclass says in its fields' names what the keys of a file are, units included."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from optics.numerics.frozen_map import FrozenMap

WHERE_KNOWN: Mapping[str, Any] = FrozenMap({"where known": True})
"""Metadata of a dataclass's field that a file has only where it is known: None leaves its key out. Measurements have no
truth, for example, and a simulation no files that were read.
"""


def plain_data(value: Any) -> Any:
    """What JSON can hold of a value.

    Args:
        value: None, a string, a truth value, a number, an array, a sequence, a mapping with strings as keys, or a
            dataclass, whose fields are written in their order, without those of `WHERE_KNOWN` that are None; all of
            them may be nested. Units are the business of whoever makes the dataclass: nothing is converted here.

    Returns:
        dict, list, str, int, float, bool or None.

    Raises:
        TypeError: anything else, a mapping with other keys, a complex number.
    """
    if value is None or isinstance(value, str | bool | np.bool_):
        return bool(value) if isinstance(value, np.bool_) else value
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value)
    if is_dataclass(value) and not isinstance(value, type):
        own = {one.name: getattr(value, one.name) for one in fields(value)}
        gone = {one.name for one in fields(value) if one.metadata == WHERE_KNOWN and own[one.name] is None}
        return {name: plain_data(item) for name, item in own.items() if name not in gone}
    if isinstance(value, Mapping):
        if other := [key for key in value if not isinstance(key, str)]:
            raise TypeError(f"a key that is no text: {other[0]!r}")
        return {str(key): plain_data(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain_data(value.tolist())
    if isinstance(value, list | tuple):
        return [plain_data(item) for item in value]
    raise TypeError(f"no plain data: {type(value).__name__}")
