"""Safe parsing of XML and of tables of numbers from external files, with errors that name file and line.

XML is parsed to elements that have line numbers. Document types and entity declarations are rejected before anything is
expanded, no external files are loaded, and size, depth and number of elements are limited. The text is read as UTF-8,
even if its first line declares another encoding.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

import numpy as np

from optics.numerics.number_tree import FrozenMap
from scenes.yaml.csv_table import LARGEST_NUMBER, table_text
from scenes.yaml.errors import InputError, Issue, names_text, nearest, shown


def text_lines(path: str | Path, what: str) -> list[str]:
    """Return the lines of a text file without line ends; raise InputError if it cannot be read."""
    text = table_text(path, what)
    if "\0" in text:
        line = text[: text.index("\0")].count("\n") + 1
        raise InputError(Issue("not text: a zero byte", str(path), line, allowed=what))
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def first_lines(path: str | Path, what: str, count: int = 20) -> Iterator[str]:
    """Return the first lines that are not empty, from which a format is recognised."""
    filled = (line for line in text_lines(path, what) if line.strip())
    yield from (line for _, line in zip(range(count), filled, strict=False))


def numbers(file: str, cells: Sequence[Sequence[str]], lines: Sequence[int], heads: Sequence[str]) -> np.ndarray:
    """Parse N rows of K texts to floats (N, K).

    Parameters
    ----------
    file : str
        Path of the file, for messages.
    cells : sequence of sequence of str
        N rows of K texts.
    lines : sequence of int
        Line numbers of the N rows in the file.
    heads : sequence of str
        Names of the K columns, for messages.

    Raises
    ------
    InputError
        A row has another number of texts, or a text is not a number, not finite, or beyond LARGEST_NUMBER.
    """
    width = len(heads)
    uneven = next((k for k, row in enumerate(cells) if len(row) != width), None)
    if uneven is not None:
        value = f"{len(cells[uneven])} numbers"
        raise InputError(Issue("wrong number of columns", file, lines[uneven], value=value, allowed=", ".join(heads)))
    try:
        values = np.array([list(map(float, row)) for row in cells], dtype=np.float64).reshape(len(cells), width)
    except ValueError:
        k, j = next((k, j) for k, row in enumerate(cells) for j, text in enumerate(row) if not _is_number(text))
        raise InputError(Issue("not a number", file, lines[k], (heads[j],), shown(cells[k][j]), "a number")) from None
    wrong = {"not a finite number": ~np.isfinite(values), "implausibly large": np.abs(values) > LARGEST_NUMBER}
    for problem, bad in wrong.items():
        for k, j in np.argwhere(bad)[:1].tolist():
            raise InputError(Issue(problem, file, lines[k], (heads[j],), shown(cells[k][j]), "a number"))
    return values


def _is_number(text: str) -> bool:
    """Return whether a text is a number without underscores."""
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text


_MOST_BYTES = 1 << 26
"""Largest size of an XML file, in bytes."""
_MOST_DEPTH = 64
_MOST_ELEMENTS = 2_000_000
_NONE: Mapping[str, str] = FrozenMap()


@dataclass(eq=False)
class Element:
    """Element of an XML document.

    Attributes
    ----------
    tag : str
        Name of the element.
    file : str
        Path of the file.
    line : int
        Line of its start, counted from 1.
    attributes : mapping of str to str
        Attributes by name.
    path : tuple of str
        Tags from the document's root to the element.
    children : list of Element
        Child elements in order.
    text : str
        Text between its tags, without spaces at the ends and without that of its children.
    """

    tag: str
    file: str
    line: int
    attributes: Mapping[str, str]
    path: tuple[str, ...]
    children: list[Element] = field(default_factory=list)
    text: str = ""

    def iter(self, tag: str) -> Iterator[Element]:
        """Return the elements of this name among the element itself and all descendants, in the order of the file."""
        return (element for element in self.below() if element.tag == tag)

    def below(self) -> Iterator[Element]:
        """Return the element itself and all descendants, in the order of the file."""
        waiting = [self]
        while waiting:
            element = waiting.pop()
            yield element
            waiting += reversed(element.children)

    def all(self, *tags: str) -> list[Element]:
        """Return all elements at a path of tags below this element; an empty list if there are none."""
        elements = [self]
        for tag in tags:
            elements = [child for element in elements for child in element.children if child.tag == tag]
        return elements

    def maybe(self, *tags: str) -> Element | None:
        """Return the only element at a path of tags below this element; None if there is none.

        Raises
        ------
        InputError
            There are several.
        """
        elements = self.all(*tags)
        if len(elements) > 1:
            elements[1].wrong(f"{tags[-1]} occurs more than once", f"{len(elements)} of them", "one")
        return elements[0] if elements else None

    def single(self, *tags: str) -> Element:
        """Return the only element at a path of tags below this element.

        Raises
        ------
        InputError
            There is none, or there are several.
        """
        element = self.maybe(*tags)
        if element is not None:
            return element
        here, missing = self, 0
        while (deeper := here.all(tags[missing])) and missing < len(tags) - 1:
            here, missing = deeper[0], missing + 1
        names = [child.tag for child in here.children]
        issue = Issue(
            f"no element {tags[missing]}", self.file, here.line, here.path, None, None, nearest(tags[missing], names)
        )
        raise InputError(issue)

    def words(self, *tags: str) -> str:
        """Return the text of the element at a path of tags below this one; raise InputError if missing or empty."""
        element = self.single(*tags)
        if not element.text:
            element.wrong("the element is empty", None, "a value")
        return element.text

    def floats(self, count: int | None = None) -> np.ndarray:
        """Return the numbers in the element's text, separated by spaces or commas: `count` of them, or any if None.

        Raises
        ------
        InputError
            The count differs, or a text is not a finite number.
        """
        cells = self.text.replace(",", " ").split()
        if not cells or (count is not None and len(cells) != count):
            self.wrong("wrong number of values", shown(self.text), "one or more" if count is None else str(count))
        try:
            return numbers(self.file, [cells], [self.line], [self.tag] * len(cells))[0]
        except InputError as error:
            self.wrong(error.issues[0].problem, error.issues[0].value, error.issues[0].allowed)

    def number(
        self, *tags: str, least: float = -np.inf, most: float = np.inf, unit: Mapping[str, float] | None = None
    ) -> float:
        """Return the number in the element at a path of tags below this one.

        Parameters
        ----------
        tags : str
            Tags from this element to the one with the number.
        least : float
            Smallest allowed value.
        most : float
            Largest allowed value.
        unit : mapping of str to float or None
            Value of the attribute ``unit`` -> factor by which the number is multiplied; the first factor where the
            element has no such attribute.

        Raises
        ------
        InputError
            The element is missing, is not a number, is out of bounds or has an unknown unit.
        """
        element = self.single(*tags) if tags else self
        value = float(element.floats(1)[0])
        if unit is not None:
            name = element.attributes.get("unit", next(iter(unit)))
            if name not in unit:
                element.wrong("unknown unit", shown(name), names_text(unit))
            value *= unit[name]
        if not least <= value <= most:
            element.wrong("out of bounds", f"{value:.9g}", f"{least:.9g} to {most:.9g}")
        return value

    def whole(self, *tags: str, least: int = 1, most: int = 10_000_000) -> int:
        """Return the integer in the element at a path of tags below this one.

        Raises
        ------
        InputError
            The element is missing, is not a whole number or is out of bounds.
        """
        element = self.single(*tags)
        value = element.number(least=least, most=most)
        if value != round(value):
            element.wrong("not a whole number", shown(element.text), f"{least} to {most}")
        return int(value)

    def wrong(self, problem: str, value: str | None = None, allowed: str | None = None) -> NoReturn:
        """Raise an InputError about this element that names file, line and path."""
        raise InputError(Issue(problem, self.file, self.line, self.path, value, allowed))


class _Builder:
    """Builder of a tree of elements from the events of the XML parser (start, end, characters)."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.root: Element | None = None
        self.parser = expat.ParserCreate("utf-8")
        self.parser.buffer_text = True
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._characters
        self.parser.StartDoctypeDeclHandler = self._refused
        self.parser.EntityDeclHandler = self._refused
        self.parser.ExternalEntityRefHandler = self._refused
        self._open: list[Element] = []
        self._texts: list[list[str]] = []
        self._count = 0

    def _line(self) -> int:
        return int(self.parser.CurrentLineNumber)

    def _refused(self, *_: object) -> NoReturn:
        raise InputError(
            Issue("XML with a document type or entities", self.file, self._line(), (), None, "elements alone")
        )

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._count += 1
        if len(self._open) >= _MOST_DEPTH or self._count > _MOST_ELEMENTS:
            allowed = f"{_MOST_DEPTH} levels and {_MOST_ELEMENTS} elements at most"
            raise InputError(Issue("XML that is too deep or too long", self.file, self._line(), (), None, allowed))
        path = (*self._open[-1].path, tag) if self._open else (tag,)
        made = Element(tag, self.file, self._line(), FrozenMap(attributes) if attributes else _NONE, path)
        if self._open:
            self._open[-1].children.append(made)
        else:
            self.root = made
        self._open.append(made)
        self._texts.append([])

    def _end(self, _tag: str) -> None:
        self._open.pop().text = "".join(self._texts.pop()).strip()

    def _characters(self, text: str) -> None:
        self._texts[-1].append(text)


def read_xml(path: str | Path, what: str) -> Element:
    """Read the root element of an XML file.

    Parameters
    ----------
    path : str or Path
        Path of the file, UTF-8.
    what : str
        Description of the expected file, for messages.

    Raises
    ------
    InputError
        The file does not exist, is too large, not XML, or has a document type or entities.
    """
    return parsed_xml(table_text(path, what, _MOST_BYTES), str(path))


def parsed_xml(text: str, file: str) -> Element:
    """Parse the root element of a document's text; raise InputError if it is not XML or has entities.

    Parameters
    ----------
    text : str
        Text of the document.
    file : str
        Path of the file, for messages.
    """
    builder = _Builder(file)
    try:
        builder.parser.Parse(text.removeprefix("\ufeff").encode(), True)
    except expat.ExpatError as error:
        raise InputError(Issue(f"not XML: {expat.ErrorString(error.code)}", file, error.lineno)) from None
    assert builder.root is not None
    return builder.root
