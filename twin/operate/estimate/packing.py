"""Serialisation of an estimate and of its model: the same bytes for the same numbers, and back to the bit."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from analysis.monitor.disturbances import Disturbances, TimeLaw
from analysis.monitor.filter_state import Aside, BadReading, Belief, Innovation, Observed, Track
from analysis.monitor.jump_detection import Jump
from analysis.monitor.limits import Quantity
from analysis.monitor.parameters import ANGLE, CAMERA_PARAMETERS, GROUND, Parameter
from analysis.monitor.series_filter import SeriesFilter
from analysis.monitor.state_space import HeatInputs

_FILTER = (Aside, BadReading, Belief, Disturbances, HeatInputs, Innovation, Jump, Observed, Quantity)
_CLASSES = (*_FILTER, SeriesFilter, TimeLaw, Track)
_PARAMETERS = {one.key: one for one in (*CAMERA_PARAMETERS, ANGLE, *GROUND)}


def packed(value: Any) -> bytes:
    """Return a value of frozen data classes, sequences, mappings, arrays, numbers and texts as bytes."""
    arrays: dict[str, np.ndarray] = {}

    def plain(one: Any) -> Any:
        if isinstance(one, np.ndarray):
            arrays[name := f"array_{len(arrays)}"] = one
            return {"array": name}
        if isinstance(one, Parameter):
            return {"parameter": one.key}
        if is_dataclass(one) and not isinstance(one, type):
            own = {each.name: plain(getattr(one, each.name)) for each in fields(one) if each.init}
            return {"class": type(one).__name__, "of": own}
        if isinstance(one, Mapping):
            return {"mapping": [[plain(key), plain(each)] for key, each in one.items()]}
        return [plain(each) for each in one] if isinstance(one, tuple | list) else one

    text, file = json.dumps(plain(value)).encode(), io.BytesIO()
    np.savez(file, allow_pickle=False, plain=np.frombuffer(text, np.uint8), **arrays)
    return file.getvalue()


def unpacked(content: bytes, *classes: type) -> Any:
    """Return the value that `packed` was given, sequences as tuples.

    Args:
        content: the bytes.
        classes: data classes that are in it, beside those of the filter.
    """
    known: dict[str, Any] = {one.__name__: one for one in (*_CLASSES, *classes)}

    def value(one: Any) -> Any:
        if isinstance(one, list):
            return tuple(value(each) for each in one)
        if not isinstance(one, dict):
            return one
        if "class" in one:
            return known[one["class"]](**{name: value(each) for name, each in one["of"].items()})
        if "mapping" in one:
            return {value(key): value(each) for key, each in one["mapping"]}
        return arrays[one["array"]] if "array" in one else _PARAMETERS[one["parameter"]]

    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    return value(json.loads(arrays.pop("plain").tobytes()))
