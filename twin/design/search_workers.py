"""What tries beams and layouts for a search, here or in other processes, and the journal of what came of them."""

from __future__ import annotations

import base64
import hashlib
import json
import multiprocessing
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from optics.numerics.backend import LIMIT, one_blas_thread
from optics.numerics.number_tree import FrozenMap
from scenes.models.monitor_layout import Beam
from twin.design.layout_bench import BeamFacts, LayoutBench, LayoutFacts, Seen, bench_of
from twin.design.layout_refinement import LayoutNumber, Slope, slope_of
from twin.run import durable, procedure, provenance, run_folder

_CLASSES: Mapping[str, type[Any]] = {
    cls.__name__: cls for cls in (Beam, BeamFacts, LayoutFacts, LayoutNumber, Seen, Slope)
}

Item = Beam | tuple[Beam, ...] | LayoutNumber
"""What can be tried."""


class Journal:
    """Context manager; inside it everything that is kept stands in the file at once. The file stays: whoever writes
    what came of the search removes it when that is safe.

    Args:
        file: of the journal; what it holds already is known. None keeps nothing.
        config: what the search is about; a file about anything else, or of another program, is refused.

    Raises:
        RunFolderError: on entering, the file is about another search; then and later, it cannot be written.
    """

    def __init__(self, file: Path | None, config: str) -> None:
        self.file = file
        self._head = hashlib.sha256(f"{provenance.source_digest()}\n{config}".encode()).hexdigest()
        self._known: dict[str, Any] = {}
        self._out: BinaryIO | None = None

    def __enter__(self) -> Journal:
        """Read what is there."""
        if self.file is not None:
            try:
                self._read(self.file)
            except BaseException:
                self._close()
                raise
        return self

    def _read(self, file: Path) -> None:
        try:
            durable.make_folders(file.parent)
            self._out = file.open("r+b" if file.exists() else "x+b")
            lines = self._out.read().splitlines(keepends=True)
            if lines and lines[0] != f"{self._head}\n".encode():
                raise run_folder.RunFolderError(
                    f"{file} is of another search, or of another version of this program; remove it to begin anew"
                )
            whole = len(lines[0]) if lines else 0
            for line in lines[1:]:
                if not line.endswith(b"\n"):  # the last line of a process that was killed
                    break
                whole += len(line)
                check, _, text = line[:-1].partition(b" ")
                if check != _check(text):  # damaged: what it held is tried again
                    continue
                entry = json.loads(text)
                self._known[entry["of"]] = _decoded(entry["is"])
            self._out.truncate(whole)
            self._out.seek(whole)
        except OSError as error:
            raise run_folder.RunFolderError(f"{file}: {error.strerror}") from error
        if not whole:
            self._write(self._head)

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self._close()

    def _close(self) -> None:
        if self._out is not None:
            with suppress(OSError):  # what could not be written has been told
                self._out.close()

    def known(self, item: Item) -> Any:
        """What came of a beam, a layout or a number of one, None if it was not tried."""
        return self._known.get(_name(item))

    def keep(self, item: Item, result: BeamFacts | LayoutFacts | Slope) -> None:
        """Keep what came of it."""
        if self._out is not None:
            self._write(_line(_name(item), result))

    def _write(self, line: str) -> None:
        assert self._out is not None
        try:
            self._out.write(f"{line}\n".encode())
            self._out.flush()
        except OSError as error:
            text = f"{self.file}: {error.strerror}; what it holds is kept, go on with --resume"
            raise run_folder.RunFolderError(text) from error


def _line(name: str, result: Any) -> str:
    """A line of the journal: a checksum, and what was tried with what came of it."""
    text = json.dumps({"of": name, "is": _encoded(result)})
    return f"{_check(text.encode()).decode()} {text}"


def _check(text: bytes) -> bytes:
    return hashlib.sha256(text).hexdigest()[:16].encode()


def _name(item: Item) -> str:
    return repr(item)


def _encoded(value: Any) -> Any:
    """Plain data that hold every bit of a result."""
    if isinstance(value, np.ndarray):
        data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode("ascii")
        return {"array": str(value.dtype), "shape": list(value.shape), "data": data}
    if is_dataclass(value) and not isinstance(value, type):
        return {
            "class": type(value).__name__,
            "with": {f.name: _encoded(getattr(value, f.name)) for f in fields(value)},
        }
    if isinstance(value, Mapping):
        return {"map": {key: _encoded(one) for key, one in value.items()}}
    if isinstance(value, tuple):
        return [_encoded(one) for one in value]
    return float(value) if isinstance(value, np.floating) else value


def _decoded(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_decoded(one) for one in value)
    if not isinstance(value, dict):
        return value
    if "array" in value:
        flat = np.frombuffer(base64.b64decode(value["data"]), dtype=value["array"])
        return flat.reshape(value["shape"]).copy()
    if "class" in value:
        return _CLASSES[value["class"]](**{key: _decoded(one) for key, one in value["with"].items()})
    return FrozenMap({key: _decoded(one) for key, one in value["map"].items()})


class Workers:
    """Context manager; inside it things can be asked for. Results do not depend on the number of processes.

    Args:
        bench: of the design.
        count: processes beside this one, 0 for none.
        journal: keeps what was tried; None for no file.
        advance: shows how far it is.

    Raises:
        RunFolderError: on entering, the journal is another search's, or cannot be written.
    """

    def __init__(self, bench: LayoutBench, count: int, journal: Journal, advance: procedure.Advance) -> None:
        self.bench, self.count, self.journal, self.advance = bench, count, journal, advance
        self._config = bench.setup.to_yaml()
        self._pool: ProcessPoolExecutor | None = None
        self._before: str | None = None

    def __enter__(self) -> Workers:
        """Open the journal and start the processes."""
        self.journal.__enter__()
        if self.count:
            self._before = os.environ.get(LIMIT)
            os.environ[LIMIT] = "1"  # read by the processes as they start
            self._pool = ProcessPoolExecutor(self.count, multiprocessing.get_context("spawn"))
        return self

    def __exit__(self, *_: object) -> None:
        """End the processes and close the journal."""
        try:
            if self._pool is not None:
                self._pool.shutdown(cancel_futures=True)
                if self._before is None:
                    os.environ.pop(LIMIT)
                else:
                    os.environ[LIMIT] = self._before
        finally:
            self.journal.__exit__()

    def ask(self, part: str, items: Sequence[Any]) -> list[Any]:
        """What comes of every item, in their order; what the journal has is not worked out again.

        Args:
            part: of the search, for the progress.
            items: beams to be tried alone, layouts to be built, numbers of layouts by which to differentiate.
        """
        out: dict[int, Any] = {}
        missing = []
        for k, item in enumerate(items):
            known = self.journal.known(item)
            if known is None:
                missing.append(k)
            else:
                out[k] = known
        self.advance(part, len(out), len(items))
        asked = [(self._config, self.bench.backend.name, items[m]) for m in missing]
        results = map(self._here, asked) if self._pool is None else self._pool.map(_there, asked)
        for k, result in zip(missing, results, strict=True):
            out[k] = result
            self.journal.keep(items[k], result)
            self.advance(part, len(out), len(items))
        return [out[k] for k in range(len(items))]

    def _here(self, item: tuple[str, str, Any]) -> Any:
        return _answer(self.bench, item[2])


def _there(item: tuple[str, str, Any]) -> Any:
    return _answer(bench_of(item[0], item[1]), item[2])


def _answer(bench: LayoutBench, item: Any) -> Any:
    with one_blas_thread():
        if isinstance(item, Beam):
            return bench.try_beam(item)
        return slope_of(bench, item) if isinstance(item, LayoutNumber) else bench.try_layout(item)
