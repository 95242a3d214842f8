"""Results of pieces of a batch, put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import numpy as np

__all__ = ["joined"]

Part = TypeVar("Part")


def joined(parts: Sequence[Part]) -> Part:
    """One after the other: dataclasses of arrays (n, ...) and of such dataclasses; at least one."""
    columns: dict[str, Any] = {}
    for field in fields(parts[0]):  # type: ignore[arg-type]
        column = [getattr(part, field.name) for part in parts]
        columns[field.name] = joined(column) if is_dataclass(column[0]) else np.concatenate(column)
    return type(parts[0])(**columns)
