"""Disk cache of calibrations, so that later processes need not compute them again.

The calibration of an instrument depends on the program, the numerical packages, the processor and the instrument's
files. The name of an entry is the SHA-256 of all of these, so any change gives another name. Inputs that cannot be
digested, such as a surface class of another package, are not cached.

An entry holds about forty kinds of objects of the program: bodies, surfaces, aimed rays, matrices. ``pickle`` writes
them without a second description of each class that could become incomplete. Since reading a pickle can run code, an
entry is read only if its folder and file belong to this user, nobody else can write to them, and its checksum is right;
and then only classes of this program and arrays are accepted.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import pickle
import stat
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from threadpoolctl import threadpool_info

from optics.geometry.sag_terms import SAG_TERMS
from optics.materials.glass import GLASSES
from optics.materials.material import MATERIALS
from optics.numerics.backend import Backend
from optics.numerics.llvm import VARIABLE as LLVM_VARIABLE
from optics.raytrace.reflectors import REFLECTORS
from scenes.yaml.spec import Spec
from twin.framework import provenance
from twin.sensors.area_detector import NOISE_TERMS

VARIABLE = "TWIN_CALIBRATIONS"
"""Environment variable that holds the path of the cache folder, or ``off`` to switch the cache off."""
OFF = "off"
NAME = "space-camera-twin"
"""Name of the folder below the user's cache folder."""
MOST_BYTES = 256 * 2**20
"""Size of the cache, in bytes, above which the least recently used entries are removed."""
MOST_WRITTEN = 64
"""Largest number of entries that one process writes: a search over thousands of instruments must not displace all
others.
"""
ENDING = ".calibration"

Value = TypeVar("Value")

_written = 0


class _UnnamedError(TypeError):
    """Error raised for an input of a computation that has no checksum, so that the result cannot be cached."""


def cache_folder() -> Path | None:
    """Return the folder of the cache, whether it exists or not; None where the cache is turned off.

    It is the value of the environment variable ``TWIN_CALIBRATIONS``, else ``$XDG_CACHE_HOME/space-camera-twin``, else
    ``~/.cache/space-camera-twin``.
    """
    named = os.environ.get(VARIABLE)
    if named:
        return None if named == OFF else Path(named)
    shared = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not shared.is_absolute():  # required by the XDG Base Directory Specification
        try:
            shared = Path.home() / ".cache"
        except RuntimeError:
            return None
    return shared / NAME


@contextmanager
def recomputed() -> Iterator[None]:
    """Switch the cache off inside a ``with`` block or decorated function, also for processes that it starts.

    Use it for checks that must compute a result afresh, and for code that replaces a function or constant of the
    program at run time: the names of the entries do not depend on such a replacement.
    """
    before = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = OFF
    try:
        yield
    finally:
        if before is None:
            del os.environ[VARIABLE]
        else:
            os.environ[VARIABLE] = before


@dataclass(frozen=True)
class CacheEntry:
    """Entry of the calibration cache: one stored result of a computation.

    Attributes
    ----------
    key : str | None
        Name of the entry, 64 hexadecimal digits; None if it is not cached.
    backend : Backend
        Backend of the computation; the entry refers to it.
    specs : tuple of Spec
        Specifications that the content refers to. The entry does not hold them: their error messages name the file that
        they were read from, which differs between readers.
    """

    key: str | None
    backend: Backend = field(repr=False)
    specs: tuple[Spec, ...] = field(repr=False)

    @classmethod
    def of(cls, backend: Backend, specs: Sequence[Spec], *inputs: Any) -> CacheEntry:
        """Return the cache entry that belongs to a computation with the given inputs.

        Parameters
        ----------
        backend : Backend
            Backend of the computation. Results of graphics cards are not cached, since no name of the card is known.
        specs : sequence of Spec
            Specifications that the computation starts from.
        inputs : objects
            All other inputs that the result depends on: numbers, texts, arrays, classes, functions, or containers of
            these.
        """
        registered = SAG_TERMS.data, REFLECTORS.data, NOISE_TERMS.data, dict(GLASSES), dict(MATERIALS)
        key = None if backend.name != "llvm" else _digest(_machine(), backend.name, registered, tuple(specs), inputs)
        return cls(key, backend, tuple(specs))

    def part(self, *inputs: Any) -> CacheEntry:
        """Return the cache entry of a computation that has these inputs in addition to those of this entry."""
        return replace(self, key=None if self.key is None else _digest(self.key, inputs))

    def get(self, compute: Callable[[], Value]) -> Value:
        """Return the stored result; if there is none, call ``compute`` and store its result."""
        content: Value | None = self.read()
        if content is None:
            content = compute()
            self.write(content)
        return content

    def read(self) -> Any:
        """Return the stored result, or None if there is none that can be trusted."""
        folder = _private(cache_folder()) if self.key is not None else None
        if folder is None:
            return None
        file = folder / f"{self.key}{ENDING}"
        with suppress(OSError):
            content = _checked(file, self._head())
            os.utime(file)
            # a pickle that cannot be read is recomputed
            with suppress(Exception):
                return _Reader(io.BytesIO(content), self).load()
        return None

    def write(self, content: Any) -> None:
        """Store a result in the cache; if the folder cannot be written to, do nothing."""
        global _written
        folder = cache_folder() if self.key is not None and _written < MOST_WRITTEN else None
        if folder is None:
            return
        pickled = io.BytesIO()
        try:
            _Writer(pickled, self).dump(content)
        except (pickle.PicklingError, TypeError, AttributeError):
            return
        with suppress(OSError):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if _private(folder) is None:
                return
            _written += 1
            # renamed when complete, so that no partial entry has its name even if two processes write it
            number, partial = tempfile.mkstemp(ENDING, ".partial-", folder)
            try:
                with open(number, "wb") as file:
                    file.write(self._head() + hashlib.sha256(pickled.getvalue()).digest() + pickled.getvalue())
                os.replace(partial, folder / f"{self.key}{ENDING}")
            except OSError:
                os.unlink(partial)
                raise
            _remove_oldest(folder)

    def _head(self) -> bytes:
        """Return the first line of the entry's file, which identifies the format and the entry."""
        return f"calibration {self.key}\n".encode()


class _Writer(pickle.Pickler):
    """Pickler of cache entries that writes references instead of the backend and the specifications."""

    def __init__(self, file: io.BytesIO, entry: CacheEntry) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._known = entry.backend, *entry.specs

    def persistent_id(self, value: Any) -> int | None:
        if not isinstance(value, Backend | Spec):
            return None
        for number, reference in enumerate(self._known):
            # equal instruments share their parts in one process, those of the first job's specification
            if value is reference or (value == reference and repr(value) == repr(reference)):
                return number
        raise pickle.PicklingError(f"{type(value).__name__} is not one of the entry's specifications")

    def reducer_override(self, value: Any) -> Any:
        """Write members of an enumeration by value: Python before 3.11.4 would write a call of `getattr`."""
        return (type(value), (value.value,)) if isinstance(value, Enum) else NotImplemented


class _Reader(pickle.Unpickler):
    """Unpickler for the output of `_Writer` that accepts only classes of this program and arrays."""

    def __init__(self, file: io.BytesIO, entry: CacheEntry) -> None:
        super().__init__(file)
        self._known = entry.backend, *entry.specs

    def persistent_load(self, number: int) -> Any:
        return self._known[number]

    def find_class(self, module: str, name: str) -> Any:
        member = super().find_class(module, name) if _of_program(module) or (module, name) in _ARRAYS else None
        if member is None or (_of_program(module) and not isinstance(member, type)):
            raise pickle.UnpicklingError(f"{module}.{name} is no part of a calibration")
        return member


_ARRAYS = {
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
}


def _of_program(module: str) -> bool:
    """Return True if a module, given by its name, is part of this program."""
    return module.removeprefix(provenance.BEFORE).partition(".")[0] in provenance.SOURCES


def _private(folder: Path | None) -> Path | None:
    """Return the folder if it belongs to this user and nobody else can access it, otherwise None."""
    try:
        status = os.stat(folder) if folder is not None else None
    except OSError:
        return None
    private = status is not None and stat.S_ISDIR(status.st_mode) and _mine(status)
    return folder if private else None


def _mine(status: os.stat_result) -> bool:
    """Return True if a file or folder belongs to this user alone."""
    return hasattr(os, "geteuid") and status.st_uid == os.geteuid() and not status.st_mode & 0o077


def _checked(file: Path, head: bytes) -> bytes:
    """Return the content of an entry's file after its head.

    Raises OSError if the file is missing, damaged or of another user.
    """
    number = os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    with open(number, "rb") as opened:
        status = os.fstat(number)
        if not stat.S_ISREG(status.st_mode) or not _mine(status):
            raise OSError(f"{file} does not belong to this user alone")
        text = opened.read()
    content = text[len(head) + 32 :]
    if text[: len(head) + 32] != head + hashlib.sha256(content).digest():
        raise OSError(f"{file} is damaged")
    return content


def _remove_oldest(folder: Path) -> None:
    """Remove the least recently used entries beyond MOST_BYTES."""
    with os.scandir(folder) as listed:
        entries = [
            (status.stat(follow_symlinks=False), status.path) for status in listed if status.name.endswith(ENDING)
        ]
    total = sum(status.st_size for status, _ in entries)
    for status, path in sorted(entries, key=lambda pair: pair[0].st_mtime_ns):
        if total <= MOST_BYTES:
            break
        with suppress(FileNotFoundError):
            os.unlink(path)
        total -= status.st_size


@cache
def _machine() -> str:
    """Return program, packages and processor as one text, since the last bits of computed numbers depend on them."""
    here = provenance.Provenance.here().model_dump(mode="json", exclude={"blas", "system"})
    # the library that computes calibrations, of those that happen to be loaded
    loaded = [loaded_library for loaded_library in threadpool_info() if "numpy" in loaded_library["filepath"]]
    blas = [
        (loaded_library["internal_api"], loaded_library["version"], loaded_library.get("architecture"))
        for loaded_library in loaded
    ]
    library = os.environ.get(LLVM_VARIABLE, "")
    with suppress(OSError):
        library += f" {os.stat(library).st_size} {os.stat(library).st_mtime_ns}"
    return json.dumps([__name__, provenance.versions(), here, blas, library], sort_keys=True)


def _digest(*inputs: Any) -> str | None:
    """Return the SHA-256 of inputs and of the files that texts in them name; None if an input cannot be digested."""
    try:
        words = list(_words(inputs))
    except _UnnamedError:
        return None
    checksums = provenance.inputs_in([word[2:-1] for word in words if word.startswith("s'")])
    return hashlib.sha256(json.dumps([words, sorted(checksums.items())]).encode()).hexdigest()


def _words(value: Any) -> Iterator[str]:
    """Yield texts that identify a value exactly: two different values never give the same sequence of texts."""
    if value is None or isinstance(value, bool | int | float | complex | bytes):
        yield f"{type(value).__name__} {value!r}"
    elif isinstance(value, str) and not isinstance(value, Enum):
        yield f"s'{value}'"
    elif isinstance(value, np.ndarray) and value.dtype != object:
        yield f"array {value.dtype.str} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    elif hasattr(value, "__qualname__"):
        yield f"class or function {_name(value)}"
    elif isinstance(value, Mapping | Sequence):
        yield f"{type(value).__name__} {len(value)}"
        for item in value.items() if isinstance(value, Mapping) else value:
            yield from _words(item)
    elif isinstance(value, Enum):
        yield f"{_name(type(value))} {value.name}"
    else:
        if isinstance(value, Spec):
            names = [*type(value).model_fields, "model_fields_set"]
        elif is_dataclass(value):
            names = [item.name for item in fields(value)]
        elif hasattr(value, "__dict__"):
            names = sorted(vars(value))
        else:
            raise _UnnamedError(f"a {type(value).__name__} has no name")
        yield f"{_name(type(value))} {len(names)}"
        for name in names:
            attribute = getattr(value, name)
            yield f"s'{name}'"
            yield from _words(sorted(attribute) if isinstance(attribute, set | frozenset) else attribute)


def _name(value: Any) -> str:
    """Return the module and qualified name of a class or function of the program, as one text."""
    if (not _of_program(value.__module__) and value.__module__ != "builtins") or "<" in value.__qualname__:
        raise _UnnamedError(f"{value!r} is no part of the program")
    return f"{value.__module__}.{value.__qualname__}"
