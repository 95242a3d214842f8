"""Markdown for the generated pages."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence


def code(text: str) -> str:
    """Return text as code, also valid in a cell of a table."""
    fence = "``" if "`" in text else "`"
    pad = " " if "`" in text else ""
    return f"{fence}{pad}{text}{pad}{fence}" if text else ""


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], name: str = "") -> str:
    """Return a table, with the name of a class for the style sheet if there is one."""
    lines = [f"| {' | '.join(heads)} |", f"|{'|'.join(' --- ' for _ in heads)}|"]
    for row in rows:
        cells = [" ".join(cell.split()).replace("|", "\\|") for cell in row]
        lines.append(f"| {' | '.join(cells)} |")
    # MyST's attribute syntax sets the class of the next block.
    return (f"{{.{name}}}\n" if name else "") + "\n".join(lines) + "\n"


def prose(text: str) -> str:
    """Return a docstring in Markdown: text between backquotes and options become code."""
    parts = re.split(r"(`[^`]*`)", re.sub(r"``([^`]+)``", r"`\1`", text))
    return "".join(part if part.startswith("`") else _plain(part) for part in parts)


def _plain(text: str) -> str:
    """Return text without code, escaped so that no character begins emphasis, a tag or a role."""
    escaped = re.sub(r"([*<>{}\[\]$]|(?<!\w)_|_(?!\w))", r"\\\1", text)
    return re.sub(r"(?<![\w-])(--[a-z][\w-]*)", r"`\1`", escaped)


def anchor(text: str) -> str:
    """Return an invisible anchor for links."""
    return f'<span id="{slug(text)}"></span>'


def slug(text: str) -> str:
    """Return a text as the name of an anchor."""
    return re.sub(r"[^\w.-]+", "-", text).strip("-").lower()


def sentence(text: str) -> str:
    """Return a text with a capital and a full stop."""
    text = text.strip()
    if not text:
        return ""
    # Identifiers keep their case.
    word = text.split()[0]
    first = text if re.search(r"[`_./=]\w|^[a-zA-Z]\b", word) else text[0].upper() + text[1:]
    return first if first.endswith((".", ":", "!", "?")) else f"{first}."
