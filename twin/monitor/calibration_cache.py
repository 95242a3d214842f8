"""Calibrations that are kept on disk, so that the next process need not compute them again.

What an instrument is calibrated to depends on the program, on the numerical packages, on the processor and on what the
instrument's files say. The SHA-256 of all of these is the name of an entry; whatever changes, the name changes with it.
What cannot be named so, such as a surface whose class is not of this program, is computed in every process.

An entry holds some forty kinds of objects of the program: bodies, surfaces, aimed rays, matrices. Only ``pickle``
writes them without a second description of each that could forget one. To read a pickle can run code, so an entry is
read only if the folder and the file belong to this user and nobody else can write to them, if its checksum is right,
and then only with classes of this program and arrays.
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
"""Environment variable with the cache folder, or ``off``."""
OFF = "off"
NAME = "space-camera-twin"
"""Folder below the user's cache folder."""
MOST_BYTES = 256 * 2**20
"""Size of the folder beyond which the entries that were not used for the longest time are removed."""
MOST_WRITTEN = 64
"""Entries that one process writes at most: a search over thousands of instruments shall not displace all others."""
ENDING = ".calibration"

Value = TypeVar("Value")

_written = 0


class _UnnamedError(TypeError):
    """An input that no digest can be made of."""


def cache_folder() -> Path | None:
    """Return the folder of the cache, whether it exists or not; None where the cache is turned off.

    It is the value of the environment variable ``TWIN_CALIBRATIONS``, else ``$XDG_CACHE_HOME/space-camera-twin``, else
    ``~/.cache/space-camera-twin``.
    """
    named = os.environ.get(VARIABLE)
    if named:
        return None if named == OFF else Path(named)
    shared = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not shared.is_absolute():  # so the XDG Base Directory Specification demands
        try:
            shared = Path.home() / ".cache"
        except RuntimeError:
            return None
    return shared / NAME


@contextmanager
def recomputed() -> Iterator[None]:
    """Leave the cache alone within a ``with`` block or a function so decorated, also in the processes that it starts.

    For checks of a result, and where a function or constant of the program is replaced while it runs: no name of an
    entry contains that.
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
    """One entry of the cache.

    Attributes
    ----------
    key : str | None
        Its name, 64 hexadecimal digits; None for what is not kept.
    backend : Backend
        Of the computation; the entry refers to it.
    specs : tuple[Spec, ...]
        Specifications that the content refers to. An entry holds none: their error messages name the file that they
        were read from, which is another for every reader.
    """

    key: str | None
    backend: Backend = field(repr=False)
    specs: tuple[Spec, ...] = field(repr=False)

    @classmethod
    def of(cls, backend: Backend, specs: Sequence[Spec], *inputs: Any) -> CacheEntry:
        """Return the entry of a computation.

        Parameters
        ----------
        backend : Backend
            Where it runs. Numbers of graphics cards are not kept, since no name of the card is known.
        specs : Sequence[Spec]
            Specifications that it begins with.
        inputs : Any
            All else that it depends on.
        """
        registered = SAG_TERMS.data, REFLECTORS.data, NOISE_TERMS.data, dict(GLASSES), dict(MATERIALS)
        key = None if backend.name != "llvm" else _digest(_machine(), backend.name, registered, tuple(specs), inputs)
        return cls(key, backend, tuple(specs))

    def part(self, *inputs: Any) -> CacheEntry:
        """Return the entry of a computation that has further inputs."""
        return replace(self, key=None if self.key is None else _digest(self.key, inputs))

    def get(self, compute: Callable[[], Value]) -> Value:
        """Return the content; compute and keep it where there is none."""
        found: Value | None = self.read()
        if found is None:
            found = compute()
            self.write(found)
        return found

    def read(self) -> Any:
        """Return the content, None where there is none that can be trusted."""
        folder = _private(cache_folder()) if self.key is not None else None
        if folder is None:
            return None
        file = folder / f"{self.key}{ENDING}"
        with suppress(OSError):
            content = _checked(file, self._head())
            os.utime(file)
            # whatever is wrong with a pickle, the content is computed
            with suppress(Exception):
                return _Reader(io.BytesIO(content), self).load()
        return None

    def write(self, content: Any) -> None:
        """Keep a content. Nothing is kept, and nothing said, where the folder cannot be written to."""
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
            # never a part of an entry under its name, whatever two processes write at once
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
        return f"calibration {self.key}\n".encode()


class _Writer(pickle.Pickler):
    """Writes references in place of the backend and the specifications."""

    def __init__(self, file: io.BytesIO, entry: CacheEntry) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._known = entry.backend, *entry.specs

    def persistent_id(self, thing: Any) -> int | None:
        if not isinstance(thing, Backend | Spec):
            return None
        for number, known in enumerate(self._known):
            # instruments that are equal share their parts in one process, those of the first job's specification
            if thing is known or (thing == known and repr(thing) == repr(known)):
                return number
        raise pickle.PicklingError(f"{type(thing).__name__} is none of the specifications that were given")

    def reducer_override(self, thing: Any) -> Any:
        """Name members of an enumeration by their value: Python before 3.11.4 would write a call of `getattr`."""
        return (type(thing), (thing.value,)) if isinstance(thing, Enum) else NotImplemented


class _Reader(pickle.Unpickler):
    """Reads what `_Writer` wrote, with no classes but this program's and arrays."""

    def __init__(self, file: io.BytesIO, entry: CacheEntry) -> None:
        super().__init__(file)
        self._known = entry.backend, *entry.specs

    def persistent_load(self, number: int) -> Any:
        return self._known[number]

    def find_class(self, module: str, name: str) -> Any:
        found = super().find_class(module, name) if _of_program(module) or (module, name) in _ARRAYS else None
        if found is None or (_of_program(module) and not isinstance(found, type)):
            raise pickle.UnpicklingError(f"{module}.{name} is no part of a calibration")
        return found


_ARRAYS = {
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
}


def _of_program(module: str) -> bool:
    return module.removeprefix(provenance.BEFORE).partition(".")[0] in provenance.SOURCES


def _private(folder: Path | None) -> Path | None:
    """The folder, if it is this user's and nobody else can do anything in it."""
    try:
        found = os.stat(folder) if folder is not None else None
    except OSError:
        return None
    mine = found is not None and stat.S_ISDIR(found.st_mode) and _mine(found)
    return folder if mine else None


def _mine(found: os.stat_result) -> bool:
    return hasattr(os, "geteuid") and found.st_uid == os.geteuid() and not found.st_mode & 0o077


def _checked(file: Path, head: bytes) -> bytes:
    """What stands in an entry behind its head. OSError if there is none, or it is damaged or somebody else's."""
    number = os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    with open(number, "rb") as opened:
        found = os.fstat(number)
        if not stat.S_ISREG(found.st_mode) or not _mine(found):
            raise OSError(f"{file} is not this user's own")
        text = opened.read()
    content = text[len(head) + 32 :]
    if text[: len(head) + 32] != head + hashlib.sha256(content).digest():
        raise OSError(f"{file} is damaged")
    return content


def _remove_oldest(folder: Path) -> None:
    with os.scandir(folder) as listed:
        found = [(one.stat(follow_symlinks=False), one.path) for one in listed if one.name.endswith(ENDING)]
    left = sum(one.st_size for one, _ in found)
    for one, path in sorted(found, key=lambda pair: pair[0].st_mtime_ns):
        if left <= MOST_BYTES:
            break
        with suppress(FileNotFoundError):
            os.unlink(path)
        left -= one.st_size


@cache
def _machine() -> str:
    """The program, the packages and the processor, on which the last bits of every number depend."""
    here = provenance.Provenance.here().model_dump(mode="json", exclude={"blas", "system"})
    # of the libraries that happen to be loaded, the one that calibrations are computed with
    loaded = [one for one in threadpool_info() if "numpy" in one["filepath"]]
    blas = [(one["internal_api"], one["version"], one.get("architecture")) for one in loaded]
    library = os.environ.get(LLVM_VARIABLE, "")
    with suppress(OSError):
        library += f" {os.stat(library).st_size} {os.stat(library).st_mtime_ns}"
    return json.dumps([__name__, provenance.versions(), here, blas, library], sort_keys=True)


def _digest(*inputs: Any) -> str | None:
    """SHA-256 of inputs, and of the files that texts in them name; None where one has a part that it cannot name."""
    try:
        words = list(_words(inputs))
    except _UnnamedError:
        return None
    found = provenance.inputs_in([word[2:-1] for word in words if word.startswith("s'")])
    return hashlib.sha256(json.dumps([words, sorted(found.items())]).encode()).hexdigest()


def _words(value: Any) -> Iterator[str]:
    """Name a value exactly: no two different ones have the same words."""
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
        for one in value.items() if isinstance(value, Mapping) else value:
            yield from _words(one)
    elif isinstance(value, Enum):
        yield f"{_name(type(value))} {value.name}"
    else:
        if isinstance(value, Spec):
            names = [*type(value).model_fields, "model_fields_set"]
        elif is_dataclass(value):
            names = [one.name for one in fields(value)]
        elif hasattr(value, "__dict__"):
            names = sorted(vars(value))
        else:
            raise _UnnamedError(f"a {type(value).__name__} has no name")
        yield f"{_name(type(value))} {len(names)}"
        for name in names:
            own = getattr(value, name)
            yield f"s'{name}'"
            yield from _words(sorted(own) if isinstance(own, set | frozenset) else own)


def _name(thing: Any) -> str:
    """Module and name of a class or function of the program."""
    if (not _of_program(thing.__module__) and thing.__module__ != "builtins") or "<" in thing.__qualname__:
        raise _UnnamedError(f"{thing!r} is no part of the program")
    return f"{thing.__module__}.{thing.__qualname__}"
