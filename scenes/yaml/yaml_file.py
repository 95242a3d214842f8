"""Reader and writer of YAML: plain data with line numbers from untrusted files.

Only the subset of YAML that the twin's files need is read: one document of mappings, lists and scalars. Anchors,
aliases and merge keys (a few lines of which can unfold to gigabytes), tags (which can name types to construct) and
duplicate keys (of which most readers silently keep the last) are refused with their line. The data are built from the
parser's events, so that a refusal comes before anything is unfolded.
"""

import io
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from scenes.yaml.errors import InputError, Issue, KeyPath, shown
from scenes.yaml.input_file import DEEPEST, read_text
from scenes.yaml.units import OTHER_MINUS, foreign_minus

LARGEST_BYTES = 1_000_000
MOST_VALUES = 100_000
"""Largest number of keys and values of a file, which take some seconds to read."""
CACHED, LONGEST_CACHED = 64, 50_000
"""Number of recently read texts in the cache, and largest number of characters of each: a command reads a camera once
for each of its uses, and a script or a study reads the same library files again and again.
"""
SPACES = "spaces, for each level two more"
_READ_APART = re.compile(
    r"[^\n -~\xa0-\u2027\u202a-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff]|^%|^[.]{3}"
    r"|^(--- )? *[|>]|[|>][-+0-9]* *(#|\n *$)|[?]([\s,\]}]|\Z)",
    re.M,
)
"""Constructs that the two parsers may read differently: tabs, line ends other than that of Unix, directives, the end of
a document, keys after a question mark, and a block text that is the whole document, begins with an empty line or has
a comment in its head.
"""

_INTEGER = re.compile(r"[-+]?[0-9]{1,30}")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]{1,6})?")
_SPECIAL = re.compile(r"([-+]?)\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_WORDS: dict[str, bool | None] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}


@dataclass(frozen=True)
class YamlFile:
    """Contents of a YAML file.

    Attributes
    ----------
    file : str
        Path as the user wrote it.
    data : dict, list, str, int, float, bool or None
        Contents as dictionaries, lists and scalars. Keys are always text.
    lines : Mapping[KeyPath, int]
        Key path -> line, counted from 1; for a mapping's entry the line of its key.
    prefix : KeyPath
        Key path of the data, if they are a part of the file.
    """

    file: str
    data: Any
    lines: Mapping[KeyPath, int] = field(repr=False)
    prefix: KeyPath = ()

    def part(self, *key: str | int) -> "YamlFile":
        """Return the part of the file below an existing key; its faults are reported with lines of the whole file."""
        data = self.data
        for name in key:
            data = data[name]
        return YamlFile(self.file, data, self.lines, (*self.prefix, *key))


def read_yaml(path: str | Path) -> YamlFile:
    """Read a YAML file.

    Raises
    ------
    InputError
        The file is missing, not a regular file, unreadable, larger than 1 MB, not UTF-8, empty, not YAML, has several
        documents, is nested deeper than 32 levels, has more than 100 000 keys and values, or has duplicate keys,
        anchors, aliases, merge keys or tags.
    """
    return parse_yaml(read_text(path, "a YAML file", LARGEST_BYTES, (".yaml", ".yml")), str(path))


def parse_yaml(text: str, file: str = "") -> YamlFile:
    """Return the data and lines of YAML text; `file` is its name in error messages.

    Raises
    ------
    InputError
        The text is not YAML of the supported subset, or is too large or too deeply nested.
    """
    data, lines = (_read_cached if len(text) <= LONGEST_CACHED else _read)(text, file)
    return YamlFile(file, _copied(data), dict(lines))


def _read(text: str, file: str) -> tuple[Any, dict[KeyPath, int]]:
    """Return the data of a YAML text, and key path -> line of each value.

    libyaml takes a tenth of the time. A text that it or the builder refuses is read again by the parser in Python,
    which knows YAML 1.2 and gives the texts and lines of the messages.
    """
    if not _READ_APART.search(text):
        with suppress(yaml.YAMLError, InputError):
            return _built(yaml.parse(text, yaml.CSafeLoader), file)
    from ruamel.yaml import YAML  # slow to import and seldom needed
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    try:
        return _built(YAML(typ="safe", pure=True).parse(text), file)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        if mark and (line := _line_with_tab(text, mark.line, mark.column)) is not None:
            raise InputError(
                Issue("a TAB character, which YAML does not take here", file, line, allowed=SPACES)
            ) from None
        problem = error.problem or error.context or "cannot be read"
        raise InputError(Issue(f"not valid YAML: {problem}", file, mark.line + 1 if mark else None)) from None
    except YAMLError as error:
        raise InputError(Issue(f"not valid YAML: {str(error).splitlines()[0]}", file)) from None


def _built(parsed: Iterable[Any], file: str) -> tuple[Any, dict[KeyPath, int]]:
    """Return the data, and key path -> line of each value, from the events of either parser."""
    builder = _Builder(file)
    for event in parsed:
        builder.take(event)
    if builder.root is None:
        raise InputError(Issue("the file is empty", file, 1))
    return builder.root, builder.lines


_read_cached = lru_cache(maxsize=CACHED)(_read)


def _copied(value: Any) -> Any:
    """Return a copy of cached plain data, which the caller may change."""
    if isinstance(value, dict):
        return {key: _copied(item) for key, item in value.items()}
    return [_copied(item) for item in value] if isinstance(value, list) else value


def _line_with_tab(text: str, last: int, column: int) -> int | None:
    """Return the line, counted from 1, of the TAB at which the parser stopped; line and column count from 0."""
    lines = text.splitlines()[: last + 1]
    if len(lines) > last and "\t" in lines[-1][: column + 1]:
        return len(lines)
    indented = (number for number, line in enumerate(lines, 1) if "\t" in line[: len(line) - len(line.lstrip())])
    return next(indented, None)


def dump_yaml(data: Any) -> str:
    """Return plain data (dict, list, text, numbers, None) as YAML text that `read_yaml` reads back, in the same order.

    Lists of scalars are written on one line, everything else in blocks.
    """
    from ruamel.yaml import YAML  # slow to import

    writer = YAML(typ="rt", pure=True)
    writer.allow_unicode = True
    writer.width = 120
    writer.indent(mapping=2, sequence=4, offset=2)
    stream = io.StringIO()
    writer.dump(_styled(data), stream)
    return stream.getvalue()


def _styled(value: Any) -> Any:
    from ruamel.yaml.comments import CommentedSeq
    from ruamel.yaml.scalarstring import DoubleQuotedScalarString

    if isinstance(value, dict):
        return {_styled(key): _styled(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        items = CommentedSeq(_styled(item) for item in value)
        if not any(isinstance(item, dict | list) for item in items):
            items.fa.set_flow_style()
        return items
    # Text that would be read as a number or a word such as null needs quotes; so does `[M?]`, for readers of YAML 1.1,
    # where ? marks a key.
    if isinstance(value, str) and (value in _WORDS or "?" in value or not isinstance(_number_or_text(value), str)):
        return DoubleQuotedScalarString(value)
    return value


UNWRITABLE = re.compile(r"[\x00-\x08\x0b-\x1f\x7f\ud800-\udfff\ufffe\uffff]")
"""Characters that a quoted text can contain by their codes, but that no table, page or data file can store."""
NO_TEXT, WRITABLE = "a control character, or half a character, in a text", "characters that can be printed"


class _Builder:
    """Builder of plain data from parser events, which refuses what the twin's files do not need."""

    def __init__(self, file: str) -> None:
        self.root: Any = None
        self.lines: dict[KeyPath, int] = {}
        self._file = file
        self._documents = 0
        self._values = 0
        # Open collections from the root down, each with its key path; for a mapping also the key of the next value.
        self._open: list[tuple[dict[str, Any] | list[Any], KeyPath]] = []
        self._key: list[str | None] = []

    def take(self, event: Any) -> None:
        """Process the next event of a parser; both parsers use the same class names for events."""
        line = event.start_mark.line + 1
        kind = type(event).__name__
        if kind == "DocumentStartEvent":
            self._documents += 1
            if self._documents > 1:
                self._refuse("a second document starts here", line, "one document in a file")
            if event.tags:
                self._refuse("%TAG directives are not allowed", line)
        elif kind == "AliasEvent":
            self._refuse(f"aliases are not allowed, found *{event.anchor}", line, "writing the value again")
        elif kind in ("ScalarEvent", "MappingStartEvent", "SequenceStartEvent"):
            if event.anchor:
                self._refuse(
                    f"anchors are not allowed, found &{event.anchor}", line, "writing the value where it is used"
                )
            if event.tag is not None:
                self._refuse(f"tags are not allowed, found {event.tag}", line, "plain values")
            self._values += 1
            if self._values > MOST_VALUES:
                allowed = f"at most {MOST_VALUES} in a file; long lists belong into a CSV table where one can be named"
                self._refuse("too many keys and values", line, allowed, self._here())
            self._value(event, kind, line)
        elif kind in ("MappingEndEvent", "SequenceEndEvent"):
            self._open.pop()
            self._key.pop()

    def _value(self, event: Any, kind: str, line: int) -> None:
        awaits_key = bool(self._open) and isinstance(self._open[-1][0], dict) and self._key[-1] is None
        if awaits_key:
            if kind != "ScalarEvent":
                self._refuse("a key must be a plain name", line)
            self._take_key(event, line)
            return
        value: Any
        if kind == "ScalarEvent":
            value = self._plain(event, line)
        else:
            value = {} if kind == "MappingStartEvent" else []
        path = self._key_path(value, line)
        if kind != "ScalarEvent":
            if len(self._open) == DEEPEST:
                self._refuse("nested too deeply", line, f"at most {DEEPEST} levels")
            self._open.append((value, path))
            self._key.append(None)

    def _plain(self, event: Any, line: int) -> Any:
        text = event.value
        if (wrong_character := UNWRITABLE.search(text)) is not None:
            issue = Issue(NO_TEXT, self._file, line, self._here(), shown(wrong_character[0]), WRITABLE)
            raise InputError(issue)
        if event.implicit[0] and text[:1] in OTHER_MINUS and not isinstance(_number_or_text("-" + text[1:]), str):
            wrong = foreign_minus(text)
            raise InputError(Issue(wrong.problem, self._file, line, self._here(), wrong.value, wrong.allowed))
        # by the core schema of YAML 1.2; quoted scalars are always text
        return plain_scalar(text) if event.implicit[0] else text

    def _here(self) -> KeyPath:
        """Return the key path of the next value."""
        if not self._open:
            return ()
        container, path = self._open[-1]
        return (*path, self._key[-1] or "") if isinstance(container, dict) else (*path, len(container))

    def _take_key(self, event: Any, line: int) -> None:
        mapping, path = self._open[-1]
        key = event.value
        if UNWRITABLE.search(key):
            self._refuse(NO_TEXT, line, WRITABLE, path)
        if key == "<<" and event.implicit[0]:
            self._refuse("merge keys are not allowed, found <<", line, "writing the entries out", path)
        if key in mapping:
            first = self.lines[(*path, key)]
            self._refuse(f"duplicate key {shown(key)}, first on line {first}", line, "each key once", (*path, key))
        self.lines[(*path, key)] = line
        self._key[-1] = key

    def _key_path(self, value: Any, line: int) -> KeyPath:
        if not self._open:
            self.root = value
            self.lines[()] = line
            return ()
        container, path = self._open[-1]
        if isinstance(container, dict):
            key = self._key[-1]
            assert key is not None
            container[key] = value
            self._key[-1] = None
            return (*path, key)
        container.append(value)
        item_path = (*path, len(container) - 1)
        self.lines[item_path] = line
        return item_path

    def _refuse(self, problem: str, line: int, allowed: str | None = None, key: KeyPath = ()) -> None:
        raise InputError(Issue(problem, self._file, line, key, allowed=allowed))


def plain_scalar(text: str) -> Any:
    """Return the value of an unquoted scalar by the core schema of YAML 1.2.

    Parameters
    ----------
    text : str
        Text without surrounding spaces.
    """
    return _WORDS[text] if text in _WORDS else _number_or_text(text)


def _number_or_text(text: str) -> int | float | str:
    if _INTEGER.fullmatch(text):
        return int(text)
    if _FLOAT.fullmatch(text):
        return float(text)
    special = _SPECIAL.fullmatch(text)
    if special:
        return float("nan") if special[3] else float(special[1] + "inf")
    return text
