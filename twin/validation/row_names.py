"""Ids of the validation's checks, read from the papers' files."""

from __future__ import annotations

import re
from pathlib import Path

FILE = "printed.yaml"
"""Name of the file with the checks in each paper's folder."""
REAL = "real"
"""First part of the ids of checks against measured data; they run if the data's folder or their ids are given."""
FOLDER = Path(__file__).parent
"""Folder that contains the papers' folders."""
_ROW = re.compile(r"^      ((?:\d{3}|real)(?:\.\w+)+):$|^        also: \[(.*)\]$", re.M)
"""Regular expression for a line with a check's key below ``groups``, or with its further ids."""


def names_in_files() -> list[str]:
    """Return the ids of all checks of all papers, paper by paper, including the additional ids of checks with several.

    The files are read as text. An unknown id is therefore reported before anything that computes is imported, and
    before the YAML is parsed, which takes a second.
    """
    ids: list[str] = []
    for file in sorted(FOLDER.glob(f"*/{FILE}")):
        for row_id, further in _ROW.findall(file.read_text("utf-8")):
            ids += [row_id] if row_id else [name.strip() for name in further.split(",")]
    return ids


def matches(identifier: str, prefix: str) -> bool:
    """Return True if an id equals a prefix or continues it after a dot.

    ``001.table3`` matches itself and ``001.table3.x``, but not ``001.table33``.
    """
    return identifier == prefix or identifier.startswith(f"{prefix}.")
