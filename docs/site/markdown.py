"""Markdown as the generated pages need it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence


def code(text: str) -> str:
    """Text as code, in a cell of a table, too."""
    fence = "``" if "`" in text else "`"
    pad = " " if "`" in text else ""
    return f"{fence}{pad}{text}{pad}{fence}" if text else ""


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], name: str = "") -> str:
    """A table; with the name of a class the style sheet can tell it from others."""
    lines = [f"| {' | '.join(heads)} |", f"|{'|'.join(' --- ' for _ in heads)}|"]
    for row in rows:
        cells = [" ".join(cell.split()).replace("|", "\\|") for cell in row]
        lines.append(f"| {' | '.join(cells)} |")
    # a class on the next block is an attribute of MyST
    return (f"{{.{name}}}\n" if name else "") + "\n".join(lines) + "\n"


def prose(text: str) -> str:
    """A docstring in Markdown: what stands between two backquotes is code there as well, and so is an option."""
    parts = re.split(r"(`[^`]*`)", re.sub(r"``([^`]+)``", r"`\1`", text))
    return "".join(part if part.startswith("`") else _plain(part) for part in parts)


def _plain(text: str) -> str:
    """Text without code, in which no character begins emphasis, a tag or a role."""
    escaped = re.sub(r"([*<>{}\[\]$]|(?<!\w)_|_(?!\w))", r"\\\1", text)
    return re.sub(r"(?<![\w-])(--[a-z][\w-]*)", r"`\1`", escaped)


def anchor(text: str) -> str:
    """A place that a link can lead to; not seen."""
    return f'<span id="{slug(text)}"></span>'


def slug(text: str) -> str:
    """A text as the name of a place in a page."""
    return re.sub(r"[^\w.-]+", "-", text).strip("-").lower()


def sentence(text: str) -> str:
    """With a capital and a full stop."""
    text = text.strip()
    if not text:
        return ""
    # names of things in the program keep their letters
    word = text.split()[0]
    first = text if re.search(r"[`_./=]\w|^[a-zA-Z]\b", word) else text[0].upper() + text[1:]
    return first if first.endswith((".", ":", "!", "?")) else f"{first}."
