"""Numbers that a paper prints: a YAML file beside the paper's checks, and the one way to read it.

Keys end in the unit in which the paper prints the number, so that it is read as printed and converted where it is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from optics.numerics.frozen_map import FrozenMap
from scenes.yaml.errors import InputError, Issue, KeyPath, nearest
from scenes.yaml.yaml_file import YamlFile, read_yaml

FILE = "printed.yaml"
"""Name of the file in each paper's folder."""
_FOLDER = Path(__file__).parents[1]


@dataclass(frozen=True, eq=False)
class Printed:
    """What a paper prints. Keys are dotted, as in ``table1.mtf_nyquist``.

    Every reader raises InputError, with file, line and key, where there is nothing of that name or of that kind.
    """

    content: YamlFile

    def number(self, key: str) -> float:
        """One number."""
        return self._number(_path(key), self._at(key))

    def whole(self, key: str) -> int:
        """A count."""
        value = self._at(key)
        if not isinstance(value, int) or isinstance(value, bool):
            raise self._error(_path(key), "no whole number", value)
        return value

    def column(self, key: str) -> tuple[float, ...]:
        """A list of numbers."""
        return self._column(_path(key), self._at(key))

    def numbers(self, key: str) -> Mapping[str, float]:
        """A mapping of numbers, in the order of the file."""
        return FrozenMap({k: self._number((*_path(key), k), v) for k, v in self._mapping(key).items()})

    def columns(self, key: str) -> Mapping[str, tuple[float, ...]]:
        """A mapping of lists, in the order of the file."""
        return FrozenMap({k: self._column((*_path(key), k), v) for k, v in self._mapping(key).items()})

    def _at(self, key: str) -> Any:
        value, path = self.content.data, _path(key)
        for depth, part in enumerate(path):
            if not isinstance(value, dict) or part not in value:
                known = value if isinstance(value, dict) else {}
                place = path[:depth]
                raise InputError(
                    Issue(
                        f"nothing is printed as {part!r}",
                        self.content.file,
                        self.content.lines.get(place),
                        place,
                        suggestion=nearest(str(part), known),
                    )
                )
            value = value[part]
        return value

    def _mapping(self, key: str) -> dict[str, Any]:
        value = self._at(key)
        if not isinstance(value, dict):
            raise self._error(_path(key), "no mapping", value)
        return value

    def _column(self, path: KeyPath, value: Any) -> tuple[float, ...]:
        if not isinstance(value, list):
            raise self._error(path, "no list", value)
        return tuple(self._number((*path, k), item) for k, item in enumerate(value))

    def _number(self, path: KeyPath, value: Any) -> float:
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise self._error(path, "no number", value)
        return float(value)

    def _error(self, path: KeyPath, problem: str, found: Any) -> InputError:
        return InputError(Issue(problem, self.content.file, self.content.lines.get(path), path, found=repr(found)))


@cache
def load_printed(paper: str) -> Printed:
    """What a paper prints.

    Args:
        paper: its number, for instance "001".

    Raises:
        InputError: there is no file of that paper, or it cannot be read.
    """
    return Printed(read_yaml(_FOLDER / f"paper_{paper}" / FILE))


def _path(key: str) -> KeyPath:
    return tuple(key.split("."))
