"""Statements of foreign prescription files, glasses that they name, and the chain of surfaces that a reader builds.

A file is decoded into numbered statements of words and numbers, and errors name their line. Glasses are those of AGF
catalogues, as manufacturers publish them, and those of the twin, by the names that prescriptions use. Indices are
relative to air of 20 C and 1013 hPa, as in prescriptions on the ground.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from optics.geometry.aperture import Aperture, Edge
from optics.geometry.pose import Pose
from optics.geometry.surface import Surface
from optics.materials.glass import ABBE_LINES, FORMULAS, GLASSES, CatalogueGlass, common_glasses
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.assembly import Interaction
from scenes.lens.prescription import LensSurface, Note, Prescription
from scenes.yaml.errors import InputError, Issue, shown
from scenes.yaml.input_file import read_bytes

LARGEST_FILE = 16 << 20
"""Largest file, in bytes; ordinary prescriptions have some ten thousand bytes."""
LONGEST_LINE = 100_000
LARGEST_NUMBER = 1e20
"""Largest number: objects at infinity are written as 1e10 to 1e18 millimetres."""
MOST_SURFACES = 2000

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?")
_MARKS = ((b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"), (b"\xef\xbb\xbf", "utf-8-sig"))


@dataclass(frozen=True)
class Statement:
    """Command of a file with its words.

    Attributes
    ----------
    line : int
        Line on which it begins, counted from 1.
    command : str
        Command in capitals.
    words : tuple[str, ...]
        Words after it.
    text : str
        Full text as in the file.
    """

    line: int
    command: str
    words: tuple[str, ...]
    text: str


@dataclass
class Source:
    """Prescription file while it is read: its path and the notes collected so far.

    Attributes
    ----------
    file : str
        Path as the user gave it.
    notes : list[Note]
        Notes on statements that were not understood.
    """

    file: str
    notes: list[Note] = field(default_factory=list)

    def error(
        self,
        problem: str,
        line: int | None = None,
        value: object = None,
        allowed: str | None = None,
        suggestion: str | None = None,
    ) -> InputError:
        """Return an input error that names the file and a line of it, for the caller to raise."""
        text = None if value is None else shown(value)
        return InputError(Issue(problem, self.file, line, (), text, allowed, suggestion))

    def note(self, statement: Statement, text: str) -> None:
        """Add a note on the treatment of a statement."""
        whole = statement.text if len(statement.text) <= 60 else statement.text[:57] + "..."
        self.notes.append(Note(statement.line, whole, text))

    def numbers(self, statement: Statement, what: str = "a number") -> tuple[float, ...]:
        """Return all words of a statement as finite numbers; raise InputError if a word is not one."""
        return tuple(self.finite(statement, k, what) for k in range(len(statement.words)))

    def number(self, statement: Statement, place: int, what: str, default: float | None = None) -> float:
        """Return one of the statement's words as a number.

        Raises
        ------
        InputError
            The word is missing without a default, is not a number, or is too large.
        """
        if place >= len(statement.words):
            if default is not None:
                return default
            raise self.error(f"{statement.command} lacks {what}", statement.line, statement.text, "a number")
        return self.value(statement, statement.words[place], what)

    def value(self, statement: Statement, word: str, what: str) -> float:
        """Return a word of a statement as a number; raise InputError if it is not one or is too large."""
        if word.upper() in ("INFINITY", "INF"):
            return math.inf
        if not _NUMBER.fullmatch(word):
            raise self.error(f"{what} of {statement.command} is not a number", statement.line, word, "a number")
        value = float(word.upper().replace("D", "E"))
        if not abs(value) <= LARGEST_NUMBER:
            raise self.error(f"{what} of {statement.command} is too large", statement.line, word)
        return value

    def finite(self, statement: Statement, place: int, what: str, default: float | None = None) -> float:
        """Return one of the statement's words as a finite number; raise InputError if it is not one."""
        value = self.number(statement, place, what, default)
        if not math.isfinite(value):
            raise self.error(f"{what} of {statement.command} is infinite", statement.line, statement.text)
        return value

    def whole(
        self, statement: Statement, place: int, what: str, least: int, most: int, default: int | None = None
    ) -> int:
        """Return one of the statement's words as an integer between two limits; raise InputError otherwise."""
        value = self.finite(statement, place, what, default)
        if value != int(value) or not least <= value <= most:
            allowed = f"whole numbers {least} to {most}"
            raise self.error(f"{what} of {statement.command}", statement.line, value, allowed)
        return int(value)


def is_number(word: str) -> bool:
    """Return True if a word is a number."""
    return _NUMBER.fullmatch(word) is not None


def read_lines(source: Source, what: str = "a prescription", most: int = LARGEST_FILE) -> list[str]:
    """Return the lines of a source's file: UTF-16 of either order, with or without a mark, UTF-8, or ISO 8859-1.

    Parameters
    ----------
    source : Source
        The file.
    what : str
        Expected content, for messages.
    most : int
        Largest size, in bytes.

    Raises
    ------
    InputError
        The file cannot be read, is too large or empty, or holds bytes that are invalid in its encoding, with their
        line.
    """
    content = read_bytes(source.file, what, most, (Path(source.file).suffix,))
    if not content.strip(b"\0 \t\r\n"):
        raise source.error("an empty file", 1, allowed=what)
    encoding = next((name for mark, name in _MARKS if content.startswith(mark)), "")
    if not encoding:
        head = content[:400]
        even, odd = head[0::2].count(0), head[1::2].count(0)
        if max(even, odd) > len(head) // 4:
            encoding = "utf-16-be" if even > odd else "utf-16-le"
    try:
        text = content.decode(encoding or "utf-8")
    except UnicodeDecodeError as error:
        if not encoding:
            text = content.decode("iso-8859-1")
            source.notes.append(Note(0, "", "not UTF-8: read as ISO 8859-1"))
        else:
            # Decode before counting: a single byte may be half of a newline.
            before = content[: error.start].decode(encoding, "replace")
            problem = f"not {encoding.upper()} text: {error.reason}"
            raise source.error(problem, before.count("\n") + 1) from None
    lines = re.split(r"\r\n|\r|\n", text)
    for k, line in enumerate(lines, start=1):
        odd_one = next((c for c in line if (c < " " and c not in "\t\f\x1a") or c in "\x7f\ufffe\ufffd"), None)
        if odd_one is not None:
            raise source.error("an invalid character", k, odd_one, "text in UTF-16, UTF-8 or ISO 8859-1")
        if len(line) > LONGEST_LINE:
            raise source.error("the line is too long", k, allowed=f"at most {LONGEST_LINE} characters")
    return lines


def split_words(text: str) -> tuple[str, ...]:
    """Return the words of a statement; a quoted text is one word, with its quotes."""
    return tuple(re.findall(r"\"[^\"]*\"|'[^']*'|[^\s\"']+|[\"']", text))


def statement_of(line: int, text: str) -> Statement | None:
    """Return the statement of a line or of a part of one; None if it is empty."""
    words = split_words(text)
    return Statement(line, words[0].upper(), words[1:], text.strip()) if words else None


def joined(words: Sequence[str]) -> str:
    """Return words as a text, without quotes around it."""
    return " ".join(words).strip().strip("\"'").strip()


Glasses = Mapping[str, Callable[[float], float]]
"""Name of a glass as ``glass_key`` makes it -> refractive index as a function of wavelength, in metres."""
NO_GLASSES: Glasses = FrozenMap()
FARTHEST = 1e8
"""Distance beyond which an object is at infinity, in metres; programs write it as 1e10 or 1e13 millimetres."""
D_LINE, _D_WIDTH = ABBE_LINES[0], 0.1e-9
"""Wavelength of the helium d line, at which a glass without catalogue data has its index, and largest difference from
it at which that index is used, in metres.
"""


def glass_key(name: str) -> str:
    """Return the key of a glass's name: letters and digits alone, without the manufacturer's name after ``_``.

    CODE V writes NBK7_SCHOTT for what Zemax and the manufacturers call N-BK7.
    """
    head = name.strip("'\"").partition("_")[0] or name
    return "".join(c for c in head.upper() if c.isalnum())


MAKERS = ("SCHOTT", "OHARA", "HOYA", "CDGM")
"""Manufacturers of common glasses; several have glasses of the same name, such as F2."""


def of_makers(glasses: Glasses, makers: Sequence[str]) -> Glasses:
    """Return the glasses without those of manufacturers that the file does not list; all if it lists none."""
    others = set(MAKERS).difference(makers) if set(MAKERS).intersection(makers) else set()
    dropped = {k for k, g in glasses.items() if getattr(g, "source", "").partition("'")[0].upper() in others}
    return FrozenMap({k: g for k, g in glasses.items() if k not in dropped}) if dropped else glasses


def index_of(source: Source, glasses: Glasses, name: str, wavelength: float, line: int) -> float:
    """Return the refractive index of a catalogue glass that a file names.

    Parameters
    ----------
    source : Source
        The file.
    glasses : Mapping[str, callable]
        Known glasses.
    name : str
        Name of the glass in the file.
    wavelength : float
        Wavelength, in metres.
    line : int
        Line of the file.

    Raises
    ------
    InputError
        The glass is unknown, or its index is not known at the wavelength.
    """
    index_at = of_makers(glasses, [name.strip("'\"").upper().partition("_")[2]]).get(glass_key(name))
    if index_at is None:
        allowed = "common glasses of the named makers, and those of a catalogue given with --glasses FILE.agf"
        raise source.error("unknown glass", line, name, allowed)
    try:
        return index_at(wavelength)
    except ValueError as error:
        raise source.error(str(error), line) from None


def named_glasses(glasses: Glasses, surfaces: Iterable[LensSurface]) -> Glasses:
    """Return the glasses of surfaces whose dispersion is known, by the names that the surfaces use."""
    names = {surface.glass for surface in surfaces if surface.glass}
    return FrozenMap({name: glasses[glass_key(name)] for name in sorted(names) if glass_key(name) in glasses})


def paired(x: Sequence[float], y: Sequence[float], count: int = 0) -> tuple[tuple[float, float], ...]:
    """Return the pairs of x and y fields, as many as counted or as the longer row has; missing ones are zero."""
    count = count or max(len(x), len(y))
    x, y = ([*values, *[0.0] * count][:count] for values in (x, y))
    return tuple(zip(x, y, strict=True))


def require_d_line(source: Source, what: str, name: str, wavelength: float, line: int) -> None:
    """Raise InputError for a glass known only by its d-line index if the light has another wavelength.

    Parameters
    ----------
    source : Source
        The file.
    what : str
        Kind of glass, for the message.
    name : str
        Name of the glass in the file.
    wavelength : float
        Wavelength of the light, in metres.
    line : int
        Line of the file.
    """
    if abs(wavelength - D_LINE) > _D_WIDTH:
        problem = f"a {what} glass has an index at 587.56 nm only"
        raise source.error(problem, line, f"{name} at {wavelength * 1e9:.6g} nm", "a catalogue's glass")


@dataclass
class Chain:
    """Surfaces that a reader has met so far, with the frame of the next one.

    Attributes
    ----------
    source : Source
        The file.
    pose : Pose
        Frame of the next surface.
    surfaces : list[LensSurface]
        Surfaces so far.
    stop : int
        Index of the aperture stop among them, -1 as long as there is none.
    index : float
        Index behind the last surface.
    glass : str
        Glass behind the last surface.
    """

    source: Source
    pose: Pose = field(default_factory=Pose)
    surfaces: list[LensSurface] = field(default_factory=list)
    stop: int = -1
    index: float = 1.0
    glass: str = ""

    def move(self, shift: Sequence[float] = (0.0, 0.0, 0.0), rotation: np.ndarray | None = None) -> None:
        """Move the frame by a shift along its axes and then a rotation about them."""
        self.pose = self.pose @ Pose(np.eye(3) if rotation is None else rotation, np.array(shift, np.float64))

    def meet(
        self,
        name: str,
        shape: Surface,
        edges: tuple[Aperture | None, tuple[Edge, ...]],
        behind: tuple[float, str] | None,
        line: int,
        stop: bool,
        last: bool,
    ) -> None:
        """Append the next surface to the chain; a dummy plane is omitted, and a repeated name gets a number.

        Parameters
        ----------
        name : str
            Name of the surface.
        shape : Surface
            Its shape.
        edges : tuple[Aperture or None, tuple[Edge, ...]]
            Its clear aperture and its obscurations.
        behind : tuple[float, str] or None
            Index and glass behind it; None for a mirror.
        line : int
            Line of the file at which it begins.
        stop : bool
            Whether it is the aperture stop.
        last : bool
            Whether it is the image.

        Raises
        ------
        InputError
            It is a second stop.
        """
        interaction = Interaction.REFLECT
        if behind is not None:
            interaction = Interaction.PASS if behind[0] == self.index else Interaction.REFRACT
            self.index, self.glass = behind
        if stop:
            if self.stop >= 0:
                raise self.source.error("a second stop is not supported", line)
            self.stop = len(self.surfaces)
        surface = LensSurface(name, self.pose, shape, interaction, self.index, edges[0], line, self.glass, edges[1])
        if interaction is Interaction.PASS and not surface.every_edge and shape.is_plane and not (stop or last):
            return
        names, k = {s.name for s in self.surfaces}, 2
        while surface.name in names:
            surface, k = replace(surface, name=f"{name}_{k}"), k + 1
        self.surfaces.append(surface)

    def prescription(self, keyword: str, distance: float, name: str, **attributes: Any) -> Prescription:
        """Return the prescription made of the surfaces so far.

        Parameters
        ----------
        keyword : str
            Keyword of the stop in the file.
        distance : float
            Distance of the object, in metres.
        name : str
            Title of the file; empty if it has none.
        attributes : keyword arguments
            Further attributes of the prescription.

        Raises
        ------
        InputError
            The image is the stop.
        """
        source = self.source
        if self.stop < 0:
            self.stop = 0
            source.notes.append(Note(0, "", f"no {keyword}: {self.surfaces[0].name} is used"))
        if self.stop == len(self.surfaces) - 1:
            raise source.error("the image is the stop", self.surfaces[self.stop].line)
        return Prescription(
            name or Path(source.file).stem,
            source.file,
            tuple(self.surfaces),
            self.stop,
            object_distance=distance if abs(distance) < FARTHEST else math.inf,
            notes=tuple(source.notes),
            **attributes,
        )


_CONSTANTS = 6
"""Number of constants of Schott's formula of dn/dT on a TD line; the seventh number is the reference temperature, 20 C.
"""


def own_glasses() -> Glasses:
    """Return the built-in glasses, name -> index; some also by other names that prescriptions use."""
    glasses: dict[str, Callable[[float], float]] = {glass_key(name): glass for name, glass in common_glasses().items()}
    glasses |= {glass_key(name): glass.index for name, glass in GLASSES.items()}
    glasses |= dict.fromkeys(("SILICA", "FSILICA"), glasses[glass_key("fused silica")])
    # BK7 is N-BK7 before arsenic was removed from it; the catalogue has one formula for both.
    glasses["BK7"] = glasses[glass_key("N-BK7")]
    return FrozenMap(glasses)


def read_catalogues(paths: Sequence[str | Path]) -> Glasses:
    """Return the built-in glasses and those of AGF catalogue files.

    A glass of the files replaces the built-in one of the same name, and a glass of an earlier file that of a later one.

    Parameters
    ----------
    paths : sequence of str or Path
        Paths of the files.

    Raises
    ------
    InputError
        A file cannot be read or is damaged.
    """
    out = dict(own_glasses())
    for path in reversed(paths):
        out.update({glass_key(glass.name): glass for glass in read_catalogue(path)})
    return FrozenMap(out)


def read_catalogue(path: str | Path) -> tuple[CatalogueGlass, ...]:
    """Return the glasses of an AGF file.

    Raises
    ------
    InputError
        The file cannot be read, or has invalid data of a glass; the message names the line.
    """
    source = Source(str(path))
    glasses: list[CatalogueGlass] = []
    name, formula, begun = "", 0, 0
    coefficients: tuple[float, ...] = ()
    expansion: float | None = None
    thermal: tuple[float, ...] | None = None
    for number, text in enumerate(read_lines(source, "a glass catalogue"), start=1):
        if (s := statement_of(number, text)) is None:
            continue
        match s.command:
            case "NM":
                if name:
                    raise source.error(f"{name} has no wavelengths (LD)", begun)
                name, begun, coefficients = (s.words[0] if s.words else ""), number, ()
                expansion = thermal = None
                formula = source.whole(s, 1, "the dispersion formula", 0, 1000)
                if formula not in FORMULAS:
                    known = ", ".join(f"{k} {title}" for k, (title, _) in FORMULAS.items())
                    raise source.error("unknown dispersion formula", number, formula, known)
            case "CD" if name:
                listed = source.numbers(s, "a coefficient")
                coefficients = tuple([*listed, *[0.0] * 12][: max(12, len(listed))])
            case "ED" if name and s.words and is_number(s.words[0]):
                # A zero stands for missing data.
                expansion = 1e-6 * source.finite(s, 0, "the expansion") or None
            case "TD" if name and len(s.words) >= _CONSTANTS and all(is_number(word) for word in s.words):
                constants = source.numbers(s, "a constant of dn/dT")[:_CONSTANTS]
                thermal = constants if any(constants) else None
            case "LD" if name:
                if not coefficients:
                    raise source.error(f"{name} has no coefficients (CD)", begun)
                first, last = (source.finite(s, k, "the range") * 1e-6 for k in (0, 1))
                if first > last:
                    raise source.error("the range of wavelengths is reversed", number, s.text, "the shortest first")
                glasses.append(CatalogueGlass(name, formula, coefficients, first, last, expansion, thermal))
                name = ""
            case _:
                pass
    if name:
        raise source.error(f"{name} has no wavelengths (LD): the file is truncated", begun)
    if not glasses:
        raise source.error("no glass in this file", 1, allowed="an AGF catalogue: NM, CD and LD lines")
    return tuple(glasses)
