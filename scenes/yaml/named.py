"""Functions and classes that are named by module and name, and imported when they are used."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

_BEFORE = __name__.removesuffix("scenes.yaml.named")
_OURS = ("analysis", "optics", "scenes", "twin")
"""The packages that a wheel holds within one, and what stands before their names there (docs/wheel)."""


@dataclass(frozen=True)
class Named:
    """A function or a class that is imported when it is used.

    Attributes:
        path: module and name, ``twin.laboratory.export:export_focus``.
    """

    path: str

    def get(self) -> Any:
        """The function or the class."""
        module, _, name = self.path.partition(":")
        before = _BEFORE if module.partition(".")[0] in _OURS else ""
        return getattr(import_module(before + module), name)

    def __call__(self, *values: Any, **named: Any) -> Any:
        """Import the function and call it."""
        return self.get()(*values, **named)
