"""Ids of the rows of the validation, as their files name them."""

from __future__ import annotations

import re
from pathlib import Path

FILE = "printed.yaml"
"""Name of the file in each paper's folder."""
FOLDER = Path(__file__).parent
"""The folder of the papers' folders."""
_ROW = re.compile(r"^      (\d{3}(?:\.\w+)+):$|^        also: \[(.*)\]$", re.M)
"""A row's key below ``groups``, or its further ids."""


def names_in_files() -> list[str]:
    """Ids of all rows of all papers and further ids of the same rows, paper by paper.

    They are read from the files as text: who asks for an unknown one is told so before anything that computes is
    imported, and before YAML is read, which takes a second.
    """
    found: list[str] = []
    for file in sorted(FOLDER.glob(f"paper_*/{FILE}")):
        for own, further in _ROW.findall(file.read_text("utf-8")):
            found += [own] if own else [name.strip() for name in further.split(",")]
    return found


def matches(identifier: str, prefix: str) -> bool:
    """Whether an id lies under a prefix: ``001.table3`` takes ``001.table3.x`` and itself, but not ``001.table33``."""
    return identifier == prefix or identifier.startswith(f"{prefix}.")
