"""Two versions of one file of a run: the same bytes, the same but for rounding, or different, and in what.

Files are read by what they are. Numbers of tables and texts are compared one by one, arrays and images as a whole.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
import struct
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile

from scenes.kinds.file_kinds import kind_of
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from twin.compare.run_differences import TOLD, Leaf, is_sigma, leaves, sigma_of
from twin.run.data_files import read_netcdf

SAME, ROUNDED, DIFFERENT, LEFT_OUT = "same", "rounding", "different", "left out"
REDRAWN = "drawn otherwise"
"""State of a picture of numbers that differ by rounding: its lines have other corners."""
GONE, NEW = "only in the run", "only made again"

RELATIVE = 1e-9
"""Part of the largest number of its sort, or of an array's peak, up to which a difference is rounding: sums in another
order, as those of stray light, move numbers by 1e-14, and readings of 1.5 arcsec by 1e-11 of what they are."""
RELATIVE_ELSEWHERE = 1e-6
"""The part that counts as rounding on another processor, whose linear algebra rounds otherwise: fits with a condition
of 1e8 and more move by 1e-8 of themselves (orthonormal Zernike terms by 4e-8). No number here is known to a millionth.
"""
OF_SIGMA = 1e-3
"""Part of the number's standard deviation up to which a difference is rounding: the least digit that a file states is
a millionth of it."""
OF_A_SIGMA = 1e-6
"""Relative, of a standard deviation itself: it is worked out from matrices with a condition of 1e4 and more."""
FEW, SMALL = 1e-4, 2
"""Share of the pixels of recorded frames, and grey levels, by which frames of another processor may differ: of those
whose expectation stands on the edge of two numbers of photons."""
OF_A_PICTURE = 4
"""Grey levels of 255 by which drawn pictures may differ: edges are drawn through a pixel's part."""
SHOWN = 20
"""Quantities of a file that are named; of more those that differ most."""

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


@dataclass(frozen=True)
class QuantityDifference:
    """One number, text or array of a file.

    Attributes:
        key: in the file.
        old, new: what the run's file holds, and what was made again; of arrays the element that differs most.
        relative: the difference over the largest number of its sort in the file, of arrays over the peak; None of what
            is no number.
        in_sigma: over the number's standard deviation, None where it has none.
        rounding: whether it is rounding.
    """

    key: str
    old: Leaf
    new: Leaf
    relative: float | None = None
    in_sigma: float | None = None
    rounding: bool = False


@dataclass(frozen=True)
class FileDifference:
    """One file of the run folder.

    Attributes:
        file: in the folder.
        state: one of the texts above.
        quantities: that differ, the largest first, SHOWN at most.
        count: how many do.
        why: why it was left out, or cannot be read.
    """

    file: str
    state: str
    quantities: tuple[QuantityDifference, ...] = ()
    count: int = 0
    why: str = ""

    @property
    def drawn(self) -> bool:
        """Whether it is a picture."""
        return self.file.rpartition(".")[2].lower() in DRAWN

    @property
    def largest(self) -> float:
        """Relative difference at most."""
        return max((one.relative for one in self.quantities if one.relative is not None), default=0.0)

    @property
    def largest_in_sigma(self) -> float | None:
        """Largest difference over sigma, None where no quantity has one."""
        return max((one.in_sigma for one in self.quantities if one.in_sigma is not None), default=None)


DRAWN = ("svg", "png", "glb")
"""Endings of pictures."""
LEFT_OUT_FILES: Mapping[str, str] = {
    "html": "a page, which says when and where it was made; its numbers are those of the other files",
    "md": "a page, which says how long it took; its numbers are those of the other files",
}
STUDY_STATE_SAYS = "says by which program the study was begun, which is told apart"


def file_difference(name: str, old: Path, new: Path, elsewhere: bool) -> FileDifference:
    """Compare a file of the run with the one that was made again.

    Args:
        name: of the file in the run folder.
        old: the run's.
        new: made again.
        elsewhere: whether that was on another processor, which rounds otherwise; a few pixels may then differ.
    """
    if not new.is_file():
        return FileDifference(name, GONE)
    if not old.is_file():
        return FileDifference(name, NEW)
    one, two = old.read_bytes(), new.read_bytes()
    if one == two:
        return FileDifference(name, SAME)
    ending = name.rpartition(".")[2].lower()
    if ending in LEFT_OUT_FILES:
        return FileDifference(name, LEFT_OUT, why=LEFT_OUT_FILES[ending])
    if name == "study_state.json":
        return FileDifference(name, LEFT_OUT, why=STUDY_STATE_SAYS)
    read = READERS.get(ending, _text)
    try:
        first, second = read(one), read(two)
    # readers of spoilt files fail in ways that cannot be foreseen
    except Exception as error:
        return FileDifference(name, DIFFERENT, why=f"cannot be read: {error}")
    found = _content_differences(first, second, elsewhere)
    if not found:
        found = [
            QuantityDifference(key, _short(first.told.get(key)), _short(second.told.get(key)))
            for key in dict.fromkeys((*first.told, *second.told))
            if first.told.get(key) != second.told.get(key)
        ]
    # where nothing was found the numbers are the same to the bit: only how they are packed is not
    return judged(name, found)


def judged(name: str, found: Iterable[QuantityDifference | None]) -> FileDifference:
    """A file by what differs in it.

    Args:
        name: of the file.
        found: what differs, in any order; None for what does not.
    """
    every = [one for one in found if one is not None]
    every.sort(key=lambda one: (one.rounding, -(math.inf if one.relative is None else one.relative)))
    state = DIFFERENT if any(not one.rounding for one in every) else ROUNDED if every else SAME
    return FileDifference(name, state, tuple(every[:SHOWN]), len(every))


def data_differences(old: Any, new: Any) -> list[QuantityDifference]:
    """Numbers and texts by which nested plain data differ, but for what names a time or follows from others.

    Args:
        old: of the run.
        new: made again.
    """
    return _content_differences(_plain(old), _plain(new), False)


@dataclass(frozen=True, eq=False)
class _Content:
    """What a file holds.

    Attributes:
        numbers: key -> number or text.
        arrays: key -> array.
        told: sentences that follow from the numbers; they count where no number differs.
        drawn: whether it is a picture.
    """

    numbers: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]
    told: Mapping[str, Any]
    drawn: bool = False


def _plain(data: Any) -> _Content:
    told = {key: data[key] for key in TOLD if key in data} if isinstance(data, Mapping) else {}
    rest = {key: value for key, value in data.items() if key not in told} if isinstance(data, Mapping) else data
    found = dict(leaves(rest))
    arrays = {key: value for key, value in found.items() if isinstance(value, np.ndarray)}
    return _Content({key: value for key, value in found.items() if key not in arrays}, arrays, told)


def _json(content: bytes) -> _Content:
    return _plain(json.loads(content))


def _yaml(content: bytes) -> _Content:
    """What a YAML file says. Comments, layout and the choice of units are the user's, and not the run's."""
    file = parse_yaml(content.decode("utf-8"))
    kind = kind_of(file.data)
    if kind is not None:
        with suppress(InputError):  # a config.yaml holds such a file under a key
            return _plain(validate(kind.model, file).plain())
    return _plain(file.data)


def _csv(content: bytes) -> _Content:
    rows = list(csv.reader(io.StringIO(content.decode("utf-8"))))
    heads = rows[0] if rows else []
    cells = {
        f"row {k}, {heads[c] if c < len(heads) else c + 1}": _cell(cell)
        for k, row in enumerate(rows[1:], 2)
        for c, cell in enumerate(row)
    }
    return _Content({**{f"head {c + 1}": head for c, head in enumerate(heads)}, **cells}, {}, {})


def _cell(text: str) -> Leaf:
    try:
        return int(text)
    except ValueError:
        pass
    try:
        return float(text)
    except ValueError:
        return text


def _netcdf(content: bytes) -> _Content:
    data = read_netcdf(content)
    arrays = {str(name): np.asarray(data[name].values) for name in (*data.data_vars, *data.coords)}
    numbers = {f"attribute {name}": value for name, value in data.attrs.items() if isinstance(value, str | float)}
    numbers.pop("attribute fingerprint", None)
    return _Content(numbers, arrays, {})


def _tiff(content: bytes) -> _Content:
    return _Content({}, {"pixels": np.asarray(tifffile.imread(io.BytesIO(content)))}, {})


def _fits(content: bytes) -> _Content:
    from astropy.io import fits

    with fits.open(io.BytesIO(content)) as units:
        data = {unit.name or f"unit {k}": unit.data for k, unit in enumerate(units) if unit.data is not None}
    arrays: dict[str, np.ndarray] = {}
    for name, values in data.items():
        columns = values.dtype.names or ()
        arrays |= {f"{name} {column}": np.asarray(values[column]) for column in columns}
        arrays |= {} if columns else {name: np.asarray(values)}
    return _Content({}, arrays, {})


def _npz(content: bytes) -> _Content:
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        return _Content({}, {name: file[name] for name in file.files}, {})


def _parquet(content: bytes) -> _Content:
    import pandas as pd

    table = pd.read_parquet(io.BytesIO(content))
    return _Content({}, {str(name): table[name].to_numpy() for name in table.columns}, {})


def _png(content: bytes) -> _Content:
    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("no PNG")
    return _Content({}, {"pixels": pixels}, {}, drawn=True)


def _words(text: str, drawn: bool = False) -> _Content:
    """Words and numbers of a text."""
    numbers = np.array([float(found) for found in _NUMBER.findall(text)])
    return _Content({"text": _NUMBER.sub("#", text)}, {"numbers": numbers}, {}, drawn)


def _text(content: bytes) -> _Content:
    """A text; of anything else its bytes."""
    try:
        return _words(content.decode("utf-8"))
    except UnicodeDecodeError:
        return _Content({}, {"bytes": np.frombuffer(content, np.uint8)}, {})


def _drawing(content: bytes) -> _Content:
    """An SVG: its words and its places, without identifiers, which are checksums of what they name."""
    return _words(_IDENTIFIER.sub(r"\1", content.decode("utf-8")), drawn=True)


_IDENTIFIER = re.compile(r"""(\bid="|url\(#|href="#)[^")]*""")


def _scene(content: bytes) -> _Content:
    """A GLB: its JSON, and the numbers of its geometry."""
    length = struct.unpack_from("<I", content, 12)[0]
    told = _plain(json.loads(content[20 : 20 + length]))
    binary = content[20 + length + 8 :]
    geometry = np.frombuffer(binary, "<f4", len(binary) // 4)
    return _Content(told.numbers, {**told.arrays, "geometry": geometry}, {}, drawn=True)


READERS: dict[str, Callable[[bytes], _Content]] = {
    "json": _json,
    "yaml": _yaml,
    "csv": _csv,
    "nc": _netcdf,
    "tiff": _tiff,
    "tif": _tiff,
    "fits": _fits,
    "npz": _npz,
    "parquet": _parquet,
    "png": _png,
    "svg": _drawing,
    "glb": _scene,
}
"""Ending of a file -> what reads it; others are texts."""


def _numbers(old: Mapping[str, Leaf], new: Mapping[str, Leaf], elsewhere: bool) -> list[QuantityDifference]:
    """Numbers and texts that are not the same to the bit."""
    out = []
    first, second = ({("", key): value for key, value in some.items()} for some in (old, new))
    peers = _peers(old, new)
    for key in dict.fromkeys((*old, *new)):
        here, there = old.get(key), new.get(key)
        if key in old and key in new and _same(here, there):
            continue
        if not (_is_number(here) and _is_number(there)):
            out.append(QuantityDifference(key, _short(here), _short(there)))
            continue
        one, two = float(here), float(there)  # type: ignore[arg-type]
        off, size = abs(two - one), max(abs(one), abs(two))
        if not math.isfinite(off):
            out.append(QuantityDifference(key, here, there))
            continue
        sigma, _ = sigma_of(first, second, ("", key))
        in_sigma = off / (sigma / math.sqrt(2.0)) if sigma else None  # sigma is that of a difference of two
        size = max(size, peers.get(_peer(key), 0.0))
        relative = off / size if size else 0.0
        rounding = relative <= (OF_A_SIGMA if is_sigma(key) else _relative(elsewhere))
        rounding |= in_sigma is not None and in_sigma <= OF_SIGMA
        out.append(QuantityDifference(key, here, there, relative, in_sigma, rounding))
    return out


def _relative(elsewhere: bool) -> float:
    return RELATIVE_ELSEWHERE if elsewhere else RELATIVE


def _peer(key: str) -> str:
    """What numbers of one sort have in common: a table's column; the key's last name that is one, as of Zernike terms
    by their titles ``zernike_waves``.
    """
    if key.startswith("row "):
        return key.partition(", ")[2]
    names = _PLACE.sub("", key).split(".")
    return next((name for name in reversed(names) if name.isidentifier()), key)


_PLACE = re.compile(r"\[(?:\[[^\]]*\]|[^\[\]])*\]")
"""What follows a list's name in a key: the number of an entry, or what tells it from the others."""


def _peers(*every: Mapping[str, Leaf]) -> dict[str, float]:
    """Largest number of each sort, beside which others may be zero but for rounding."""
    out: dict[str, float] = {}
    for numbers in every:
        for key, value in numbers.items():
            if isinstance(value, float) and math.isfinite(value):
                name = _peer(key)
                out[name] = max(out.get(name, 0.0), abs(value))
    return out


def _same(here: Any, there: Any) -> bool:
    both_nan = isinstance(here, float) and isinstance(there, float) and math.isnan(here) and math.isnan(there)
    return both_nan or (here == there and type(here) is type(there))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _short(value: Any) -> Leaf:
    if isinstance(value, str) and len(value) > 200:
        return f"{value[:197]}..."
    return value if value is None or isinstance(value, int | float | str | bool) else str(value)[:200]


def _content_differences(first: _Content, second: _Content, elsewhere: bool) -> list[QuantityDifference]:
    """What differs between two files, but for what is told of their numbers.

    Args:
        first: the run's.
        second: made again.
        elsewhere: as of `file_difference`.
    """
    return [*_numbers(first.numbers, second.numbers, elsewhere), *_arrays(first, second, elsewhere)]


def _arrays(first: _Content, second: _Content, elsewhere: bool) -> list[QuantityDifference]:
    out = []
    for key in dict.fromkeys((*first.arrays, *second.arrays)):
        one, two = first.arrays.get(key), second.arrays.get(key)
        if one is None or two is None:
            told = ["none" if array is None else "an array" for array in (one, two)]
            out.append(QuantityDifference(key, told[0], told[1]))
        elif (found := array_difference(key, one, two, first.drawn, elsewhere)) is not None:
            out.append(found)
    return out


def array_difference(
    key: str, one: np.ndarray, two: np.ndarray, drawn: bool = False, elsewhere: bool = False
) -> QuantityDifference | None:
    """The element by which two arrays differ most; None where they are the same to the bit.

    Args:
        key: of the array.
        one: the run's, any shape.
        two: made again.
        drawn: whether it is a picture, or its geometry.
        elsewhere: as of `file_difference`.
    """
    if one.shape != two.shape:
        shapes = [" x ".join(map(str, array.shape)) for array in (one, two)]
        return QuantityDifference(key, f"shape {shapes[0]}", f"shape {shapes[1]}")
    if not all(np.issubdtype(array.dtype, np.number) for array in (one, two)):
        unequal = np.argwhere(one.astype(str) != two.astype(str))
        if not len(unequal):
            return None
        where = tuple(unequal[0])
        return QuantityDifference(_at(key, where), _short(str(one[where])), _short(str(two[where])))
    here, there = one.astype(np.float64), two.astype(np.float64)
    same = (here == there) | (np.isnan(here) & np.isnan(there))
    if np.all(same):
        return None
    with np.errstate(invalid="ignore"):
        off = np.where(same, 0.0, np.abs(there - here))
    off = np.where(np.isfinite(off), off, np.inf)
    where = tuple(int(k) for k in np.unravel_index(int(np.argmax(off)), off.shape))
    peak = float(np.max(np.abs(here), where=np.isfinite(here), initial=0.0))
    worst = float(off[where])
    rounding = worst <= _relative(elsewhere) * peak
    if drawn and one.dtype.kind == "u":
        rounding = worst <= OF_A_PICTURE * (257 if one.dtype.itemsize == 2 else 1)
    elif elsewhere and one.dtype.kind == "u":
        rounding = worst <= SMALL and float(np.mean(~same)) <= FEW
    elif drawn:
        rounding = worst <= 1e-6 * peak  # kept in single precision
    relative = worst / peak if peak and math.isfinite(worst) else None
    return QuantityDifference(_at(key, where), here[where].item(), there[where].item(), relative, None, rounding)


def _at(key: str, where: tuple[Any, ...]) -> str:
    return f"{key}[{', '.join(str(int(k)) for k in where)}]" if where else key
