"""Check of the kinds of arguments of public functions, from their annotations: one sentence for every wrong kind.

`public` prepares a function that a library offers, `checked` decorates a method, and `check_fields` is called by a
dataclass that users make. The checks are of kinds alone: a number, text, a camera. Ranges are those of the function.
"""

import functools
import inspect
import numbers
import reprlib
import sys
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin

import numpy as np

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


class WrongKindError(TypeError, ValueError):
    """Argument of a wrong kind, such as text for a number; a ``ValueError`` as all errors of the libraries."""


class _Numbers:
    """Stand-in for ``ArrayLike`` in annotations: an array of numbers, or what NumPy makes one of."""


def public(value: Any, package: str, name: str) -> Any:
    """Return a function under its public name, with a check of its arguments' kinds; a class as it is.

    Parameters
    ----------
    value : callable or class
        Function or class as its module defines it.
    package : str
        Package that offers it.
    name : str
        Its name there.
    """
    if isinstance(value, type):
        return value
    wrapped: Any = checked(value, name)
    wrapped.__module__, wrapped.__name__, wrapped.__qualname__ = package, name, name  # for help and pickle
    return wrapped


def checked(function: Callable[Parameters, Result], name: str = "") -> Callable[Parameters, Result]:
    """Return a function that raises `WrongKindError` where an argument has another kind than its annotation.

    Parameters
    ----------
    function : callable
        Function or method with annotations.
    name : str
        Name in messages; by default its own.
    """

    @functools.cache
    def hints() -> dict[str, Any]:
        varied = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
        parameters = inspect.signature(function).parameters.values()
        names = vars(sys.modules[function.__module__])
        return {p.name: _evaluated(p.annotation, names) for p in parameters if p.kind not in varied}

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        for key, value in (*zip(hints(), args, strict=False), *kwargs.items()):
            _check(name or function.__qualname__, key, value, hints().get(key, Any))
        return function(*args, **kwargs)

    return call


def check_fields(made: Any) -> None:
    """Raise `WrongKindError` where a field of a dataclass has another kind than its annotation."""
    kind: Any = type(made)
    for key, hint in _field_hints(kind).items():
        _check(kind.__name__, key, getattr(made, key), hint)


def finite(name: str, values: Any, unit: str) -> np.ndarray:
    """Return values as an array of floats; raise ``ValueError`` if one is NaN or infinite.

    Parameters
    ----------
    name : str
        Name of the argument, for the message.
    values : array_like
        Values of any shape.
    unit : str
        Their unit in words, such as ``in metres``.
    """
    array = np.asarray(values, float)
    if not np.all(np.isfinite(array)):
        wrong = array[~np.isfinite(array)]
        raise ValueError(f"{name} must be finite, {unit}, got {wrong[0]} ({len(wrong)} of {array.size} values)")
    return array


@functools.cache
def _field_hints(kind: type) -> dict[str, Any]:
    names = vars(sys.modules[kind.__module__])
    return {key: _evaluated(hint, names) for key, hint in kind.__annotations__.items()}


def _evaluated(annotation: Any, names: dict[str, Any]) -> Any:
    """Return an annotation as an object; `Any` for one that only type checkers know."""
    if annotation is inspect.Parameter.empty:
        return Any
    try:
        return eval(annotation, names, {"ArrayLike": _Numbers}) if isinstance(annotation, str) else annotation
    except (NameError, TypeError):
        return Any


def _check(owner: str, key: str, value: Any, hint: Any) -> None:
    if not _fits(value, hint):
        raise WrongKindError(f"{owner}: {key} must be {_words(hint)}, got {reprlib.repr(value)}")


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value is of the kind of an annotation; True for an annotation that is not known here."""
    origin, parts = get_origin(hint) or hint, get_args(hint)
    if origin in (Union, types.UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is Literal:
        return value in parts
    if origin in (_Numbers, np.ndarray):
        return _is_numbers(value)
    if origin is tuple and parts[-1:] != (...,):
        return _is_sequence(value) and len(value) == len(parts) and all(map(_fits, value, parts))
    if origin in (tuple, list, Sequence):
        return _is_sequence(value) and all(_fits(element, parts[0]) for element in value if parts)
    if origin is Mapping:
        pairs = value.items() if isinstance(value, Mapping) else None
        return pairs is not None and all(_fits(k, parts[0]) and _fits(v, parts[1]) for k, v in pairs if parts)
    if origin in (int, float):
        scalar = value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value
        kind = numbers.Integral if origin is int else numbers.Real
        return isinstance(scalar, kind) and not isinstance(scalar, bool | np.bool_)
    if origin is bool:
        return isinstance(value, bool | np.bool_)
    if origin is None:
        return value is None
    if getattr(origin, "_is_protocol", False):
        names = {*vars(origin), *vars(origin).get("__annotations__", {})}
        return all(hasattr(value, name) for name in names if not name.startswith("_"))
    return not isinstance(origin, type) or origin is Any or isinstance(value, origin)


def _is_sequence(value: Any) -> bool:
    return (isinstance(value, Sequence) and not isinstance(value, str)) or (
        isinstance(value, np.ndarray) and value.ndim > 0
    )


def _is_numbers(value: Any) -> bool:
    try:
        return np.asarray(value).dtype.kind in "biufc"
    except ValueError:  # rows of different lengths
        return False


def _words(hint: Any) -> str:
    """Return a kind in words, with its article."""
    origin, parts = get_origin(hint) or hint, get_args(hint)
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(_words(part) for part in parts))
    if origin is Literal:
        return " or ".join(map(repr, parts))
    if origin is tuple and parts[-1:] != (...,):
        if set(parts) == {float}:
            return f"{len(parts)} numbers"
        return f"{len(parts)} elements ({', '.join(map(_words, parts))})"
    if origin in (tuple, list, Sequence):
        if parts and parts[0] is float:
            return "a sequence of numbers"
        return f"a sequence whose elements are each {_words(parts[0])}" if parts else "a sequence"
    plain = {
        int: "a whole number",
        float: "a number",
        str: "text",
        bool: "True or False",
        _Numbers: "an array of numbers",
        np.ndarray: "an array of numbers",
        None: "None",
        type(None): "None",
    }
    if origin is Mapping:
        return f"a mapping from {_words(parts[0])} to {_words(parts[1])}" if parts else "a mapping"
    if origin in plain:
        return plain[origin]
    return f"{'an' if origin.__name__[0] in 'AEIOUaeiou' else 'a'} {origin.__name__}"
