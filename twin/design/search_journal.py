"""What a search for a layout has tried, kept in a file as it goes, for a search that is broken off and resumed."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import numpy as np

from optics.numerics.frozen_map import FrozenMap
from scenes.models.monitor_layout import Beam
from twin.design.layout_bench import BeamFacts, LayoutFacts, Seen
from twin.design.layout_gradient import LayoutNumber, Slope
from twin.run.run_folder import RunFolderError
from twin.run.versions import source_digest

_CLASSES: Mapping[str, type[Any]] = {
    cls.__name__: cls for cls in (Beam, BeamFacts, LayoutFacts, LayoutNumber, Seen, Slope)
}

Item = Beam | tuple[Beam, ...] | LayoutNumber
"""What can be tried."""


class Journal:
    """Context manager; inside it everything that is kept stands in the file at once.

    Args:
        file: of the journal; what it holds already is known. None keeps nothing.
        config: what the search is about; a file about anything else, or of another program, is refused.

    Raises:
        RunFolderError: on entering, the file is about another search, or cannot be written.
    """

    def __init__(self, file: Path | None, config: str) -> None:
        self.file = file
        self._head = hashlib.sha256(f"{source_digest()}\n{config}".encode()).hexdigest()
        self._known: dict[str, Any] = {}
        self._out: TextIO | None = None

    def __enter__(self) -> Journal:
        """Read what is there."""
        if self.file is None:
            return self
        try:
            lines = self.file.read_text("utf-8").splitlines() if self.file.exists() else []
            if lines and lines[0] != self._head:
                raise RunFolderError(
                    f"{self.file} is of another search, or of another version of this program; remove it to begin anew"
                )
            for line in lines[1:]:
                try:
                    entry = json.loads(line)
                except ValueError:  # the last line of a process that was killed
                    break
                self._known[entry["of"]] = _decoded(entry["is"])
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self._out = self.file.open("w", encoding="utf-8")
        except OSError as error:
            raise RunFolderError(f"{self.file}: {error.strerror}") from error
        self._write(self._head)
        for name, result in self._known.items():
            self._write(json.dumps({"of": name, "is": _encoded(result)}))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Close the file; one of a search that is complete goes."""
        if self._out is not None and self.file is not None:
            self._out.close()
            if kind is None:
                self.file.unlink(missing_ok=True)

    def known(self, item: Item) -> Any:
        """What came of a beam, a layout or a number of one, None if it was not tried."""
        return self._known.get(_name(item))

    def keep(self, item: Item, result: BeamFacts | LayoutFacts | Slope) -> None:
        """Keep what came of it."""
        if self._out is not None:
            self._write(json.dumps({"of": _name(item), "is": _encoded(result)}))

    def _write(self, line: str) -> None:
        assert self._out is not None
        self._out.write(line + "\n")
        self._out.flush()


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
