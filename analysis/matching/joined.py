"""Results of pieces of a batch, put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import TypeVar

import numpy as np

__all__ = ["joined"]

Part = TypeVar("Part")


def joined(parts: Sequence[Part]) -> Part:
    """One after the other: dataclasses of arrays (n, ...) and of such dataclasses; at least one."""
    first = parts[0]
    if not is_dataclass(first) or isinstance(first, type):
        return np.concatenate(parts)  # type: ignore[call-overload, no-any-return]
    return type(first)(**{f.name: joined([getattr(part, f.name) for part in parts]) for f in fields(first)})
