"""Corrupts files at random, by what they are: bytes of any file; words, numbers and lines of a text; the tree of YAML
and JSON and whatever looks like a path in it; cells, rows and columns of a table; what an image or data set contains.

changed = mutate("job.yaml", content, random.Random(7))
changed.content     # bytes of the corrupted file
changed.how         # what was done
"""

from __future__ import annotations

import copy
import io
import json
import random
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import h5py
import numpy as np
import tifffile
from astropy.io import fits

from scenes.yaml.yaml_file import dump_yaml, parse_yaml

Mutator = Callable[[bytes, random.Random], bytes]
OfText = Callable[[str, random.Random], str]
Pixels = np.ndarray[Any, np.dtype[Any]]
NASTY: Mapping[str, list[Any]] = json.loads(Path(__file__).with_name("nasty.json").read_text("utf-8"))
"""What stands in place of numbers, units, texts, values and paths."""
FACTORS = (-1.0, 0.0, 1e-300, 1e-12, 1e-6, 1e-3, 0.1, 0.999, 1.001, 3.0, 10.0, 1e3, 1e6, 1e12, 1e300)
NUMBER = r"(?<![\w.])[-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?(?![\w.])"


@dataclass(frozen=True)
class Mutant:
    """A corrupted file.

    Attributes:
        content: its bytes.
        how: which mutators made it.
    """

    content: bytes
    how: str


def form_of(name: str) -> str:
    """Return what a file is to the mutators: a key of KINDS, by its ending."""
    return _FORMS.get(PurePosixPath(name).suffix.lower(), "text")


_FORMS = {
    **dict.fromkeys((".yaml", ".yml"), "yaml"),
    **dict.fromkeys((".json", ".geojson"), "json"),
    ".csv": "table",
    **dict.fromkeys((".tif", ".tiff", ".fits", ".png", ".jpg"), "image"),
    ".nc": "data",
    **dict.fromkeys((".npz", ".gtx", ".parquet"), "binary"),
}


def mutate(name: str, content: bytes, chance: random.Random) -> Mutant:
    """Return a file corrupted in one way, or in two or three at once.

    Args:
        name: of the file, whose ending says what it is.
        content: of the file as it is.
        chance: what is done; the same state gives the same mutant.
    """
    kinds = KINDS[form_of(name)]
    kind = chance.choices(list(kinds), [weight for weight, _ in kinds.values()])[0]
    table, how = kinds[kind][1], []
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        mutator = chance.choice(sorted(table))
        try:
            content = table[mutator](content, chance)
        except Exception:  # nothing left to change, or no longer what it was, which libraries tell in many ways
            continue
        how.append(mutator)
    return Mutant(content, f"{kind}: " + ", ".join(how))


# --- bytes


def _span(content: bytes, chance: random.Random, longest: int = 60) -> tuple[int, int]:
    first = chance.randrange(len(content) + 1)
    return first, min(len(content), first + chance.randint(1, longest))


def flip(content: bytes, chance: random.Random) -> bytes:
    out = bytearray(content)
    for _ in range(chance.choice((1, 2, 5, 20))):
        out[chance.randrange(len(out))] ^= 1 << chance.randrange(8)
    return bytes(out)


def insert(content: bytes, chance: random.Random) -> bytes:
    at, _ = _span(content, chance)
    marks = chance.choices(b"{}[],:#&*!|>'\"%@`-?\n \\", k=chance.randint(1, 6))
    extras = (chance.randbytes(40), bytes(marks), chance.choice(NASTY["extras"]).encode())
    return content[:at] + chance.choice((*extras, chance.choice(NASTY["marks"]).encode("latin-1"))) + content[at:]


def copied(content: bytes, chance: random.Random) -> bytes:
    """A part is lost, or stands twice or often."""
    first, last = _span(content, chance, 200)
    return content[:first] + content[first:last] * chance.choice((0, 0, 2, 50)) + content[last:]


def truncate(content: bytes, chance: random.Random) -> bytes:
    return content[: chance.randrange(len(content) + 1)]


def binary(content: bytes, chance: random.Random) -> bytes:
    return chance.choice((chance.randbytes(500), *(text.encode("latin-1") for text in NASTY["starts"])))


def recode(content: bytes, chance: random.Random) -> bytes:
    coding = chance.choice(("utf-16", "utf-16-le", "utf-32", "utf-7", "cp037", "utf-8-sig"))
    return content.decode("utf-8", "replace").encode(coding, "replace")


def line_ends(content: bytes, chance: random.Random) -> bytes:
    return content.replace(b"\n", chance.choice(NASTY["line_ends"]).encode("latin-1"))


def huge(content: bytes, chance: random.Random) -> bytes:
    """Around the reader's limit of a megabyte."""
    room = b"x" * max(0, chance.choice((200_000, 999_999, 1_000_001)) - len(content))
    nested = chance.choice((b"[", b"{", b"{a: ", b"- ", b"? ", b"'", b"\n")) * 50_000
    return chance.choice((content + b"\n#" + room, content + b"\nlong: '" + room + b"'\n", room + b": 1\n", nested))


def number_of_head(content: bytes, chance: random.Random) -> bytes:
    """A number of the head, where sizes, offsets and counts stand, is another one."""
    out, size = bytearray(content), chance.choice((1, 2, 4, 8))
    last = max(1, min(len(out) - size, chance.choice((64, 400, len(out)))))
    at = chance.randrange(last) // size * size
    value = chance.choice((0, 1, 2**7, 2**15 - 1, 2**16, 2**31 - 1, 2**32 - 1, 2**63 - 1)) % 2 ** (8 * size)
    out[at : at + size] = value.to_bytes(size, chance.choice(("little", "big")))
    return bytes(out)


def _named(*mutators: Callable[..., Any]) -> dict[str, Any]:
    return {one.__name__: one for one in mutators}


BYTES = _named(flip, insert, copied, truncate, binary, recode, line_ends, huge)


# --- texts


def _replaced(pattern: str, new: Callable[[str, random.Random], str]) -> OfText:
    """Return a mutator that puts something in place of one match of a pattern."""

    def mutator(text: str, chance: random.Random) -> str:
        one = chance.choice(list(re.finditer(pattern, text)))
        return text[: one.start()] + new(one[0], chance) + text[one.end() :]

    return mutator


def _scaled(old: str, chance: random.Random) -> str:
    value = float(old) * chance.choice(FACTORS)
    return str(int(value)) if re.fullmatch(r"[-+]?\d+", old) and abs(value) < 1e15 else repr(value)


def _indented(old: str, chance: random.Random) -> str:
    return chance.choice((" ", "   ", "\t", "- ", "? ", "'", "> ", "| ")) + old.lstrip(chance.choice((" ", "")))


TOKENS: dict[str, OfText] = {
    "number": _replaced(NUMBER, lambda old, chance: chance.choice(NASTY["numbers"])),
    "scale": _replaced(NUMBER, _scaled),
    "scale again": _replaced(NUMBER, _scaled),
    "unit": _replaced(r"(?<=\d) [A-Za-z%]+(?:/[A-Za-z]+)?", lambda old, chance: " " + chance.choice(NASTY["units"])),
    "no unit": _replaced(r"(?<=\d) [A-Za-z%]+", lambda old, chance: ""),
    "word": _replaced(r"[A-Za-z_]\w+", lambda old, chance: chance.choice((*NASTY["texts"], old.upper(), old[:-1]))),
    "indent": _replaced(r"(?m)^.*$", _indented),
}
LINES: dict[str, OfText] = {
    "lost line": _replaced(r"(?m)^.*\n", lambda old, chance: ""),
    "line again": _replaced(r"(?m)^.*\n", lambda old, chance: old * chance.choice((2, 3, 300))),
    "another line": _replaced(r"(?m)^.*$", lambda old, chance: chance.choice(NASTY["words"])),
    "another word": _replaced(r"[^\s]+", lambda old, chance: chance.choice(NASTY["words"])),
}
YAMLS: dict[str, OfText] = {
    "before a value": _replaced(r": (?=\S)", lambda old, chance: old + chance.choice(NASTY["before"])),
    "around": lambda text, chance: chance.choice(NASTY["around"]).replace("{}", text),
    "line again": LINES["line again"],
}


# --- trees of YAML and JSON


def _places(data: Any) -> Iterator[tuple[Any, Any]]:
    """(mapping or list, its key or index) of every value, at any depth."""
    for name in list(data) if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ():
        yield data, name
        yield from _places(data[name])


Change = Callable[[Any, Any, Any, random.Random], None]
Only = Callable[[Any], bool]


def _put(new: Callable[[Any, Any, random.Random], Any]) -> Change:
    """Return a change of a value to another one: ``new(old value, whole tree, chance)``."""

    def change(holder: Any, name: Any, root: Any, chance: random.Random) -> None:
        holder[name] = copy.deepcopy(new(holder[name], root, chance))

    return change


def _lost(holder: Any, name: Any, root: Any, chance: random.Random) -> None:
    del holder[name]


def _renamed(holder: Any, name: Any, root: Any, chance: random.Random) -> None:
    holder[chance.choice((*NASTY["texts"], *NASTY["paths"], name + "x", name.upper()))] = holder.pop(name)


def _exchanged(holder: Any, name: Any, root: Any, chance: random.Random) -> None:
    other = chance.choice(list(holder) if isinstance(holder, dict) else list(range(len(holder))))
    holder[name], holder[other] = holder[other], holder[name]


def _grafted(old: Any, root: Any, chance: random.Random) -> Any:
    holder, name = chance.choice(list(_places(root)))
    return holder[name]


def _relisted(old: Any, root: Any, chance: random.Random) -> Any:
    return chance.choice((old[:-1], old[1:], [], old + old[-1:], old * 3, old[::-1], old[:1] * 300, [old]))


def _wrapped(old: Any, root: Any, chance: random.Random) -> Any:
    for _ in range(chance.choice((1, 1, 2, 20, 200))):
        old = [old] if chance.random() < 0.5 else {"x": old}
    return old


def _is_quantity(value: Any) -> bool:
    return isinstance(value, str) and re.match(r"[-+\d.]+(e[-+]?\d+)? \S+$", value) is not None


def _resized(old: Any, root: Any, chance: random.Random) -> Any:
    """The most likely mistake that the schema lets through."""
    return f"{chance.choice(NASTY['sizes'])} {old.partition(' ')[2]}"


TREES: dict[str, tuple[Change, Only]] = {
    "value": (_put(lambda old, root, chance: chance.choice((*NASTY["values"], *NASTY["texts"]))), lambda value: True),
    "lost": (_lost, lambda value: True),
    "renamed": (_renamed, lambda value: True),
    "grafted": (_put(_grafted), lambda value: True),
    "exchanged": (_exchanged, lambda value: True),
    "relisted": (_put(_relisted), lambda value: isinstance(value, list)),
    "wrapped": (_put(_wrapped), lambda value: True),
    "quantity": (_put(_resized), _is_quantity),
    "quantity again": (_put(_resized), _is_quantity),
    "count": (
        _put(lambda old, root, chance: chance.choice((*NASTY["counts"], True))),
        lambda value: isinstance(value, int | float),
    ),
}
PATHS: dict[str, tuple[Change, Only]] = {
    "path": (
        _put(lambda old, root, chance: chance.choice(NASTY["paths"])),
        lambda value: isinstance(value, dict | str) and not _is_quantity(value),
    )
}


def _trees(table: Mapping[str, tuple[Change, Only]], is_json: bool) -> dict[str, Mutator]:
    """Return changes of a tree as mutators of a file; JSON is read with NaN and infinities."""

    def of(change: Change, only: Only) -> Mutator:
        def mutator(content: bytes, chance: random.Random) -> bytes:
            data = json.loads(content) if is_json else parse_yaml(content.decode()).data
            holder, name = chance.choice([(holder, name) for holder, name in _places(data) if only(holder[name])])
            change(holder, name, data, chance)
            return (json.dumps(data, indent=2) if is_json else dump_yaml(data)).encode("utf-8", "surrogatepass")

        return mutator

    return {name: of(*one) for name, one in table.items()}


def _texts(table: Mapping[str, OfText]) -> dict[str, Mutator]:
    """Return mutators of text as mutators of a file, which keeps its encoding."""

    def of(one: OfText) -> Mutator:
        def mutator(content: bytes, chance: random.Random) -> bytes:
            wide = content.startswith((b"\xff\xfe", b"\xfe\xff"))
            coding = "utf-16" if wide else "utf-16-le" if b"\0" in content else "utf-8"
            return one(content.decode(coding), chance).encode(coding, "surrogatepass")

        return mutator

    return {name: of(one) for name, one in table.items()}


# --- tables

Rows = list[list[str]]


def _cells(new: Callable[[str, str, random.Random], str]) -> Callable[[Rows, random.Random], Rows]:
    """Return a change of one cell or of a whole column: ``new(cell, one of the column's cells, chance)``."""

    def change(rows: Rows, chance: random.Random) -> Rows:
        row = chance.randrange(1, len(rows))
        column = chance.randrange(len(rows[row]))
        # the same for all cells of a column
        state, one = chance.getstate(), rows[row][column]
        for k in range(1, len(rows)) if chance.random() < 0.5 else (row,):
            if column < len(rows[k]):
                chance.setstate(state)
                rows[k][column] = new(rows[k][column], one, chance)
        return rows

    return change


def _column(new: Callable[[list[str]], list[str]]) -> Callable[[Rows, random.Random], Rows]:
    """Return a change of all cells of a column, each as a list of one."""

    def change(rows: Rows, chance: random.Random) -> Rows:
        at = chance.randrange(len(rows[0]))
        return [[*row[:at], *new(row[at : at + 1]), *row[at + 1 :]] for row in rows]

    return change


def _again(rows: Rows, chance: random.Random) -> Rows:
    first = chance.randrange(1, len(rows))
    return rows[:first] + rows[first : first + chance.choice((1, 3, 30))] * chance.choice((2, 3, 50)) + rows[first:]


def _ragged(rows: Rows, chance: random.Random) -> Rows:
    row = rows[chance.randrange(len(rows))]
    row[:] = chance.choice(([*row, "1"], row[:-1]))
    return rows


TABLES: dict[str, Callable[[Rows, random.Random], Rows]] = {
    "cell": _cells(lambda old, one, chance: chance.choice((*NASTY["numbers"], *NASTY["texts"]))),
    "scaled": _cells(lambda old, one, chance: repr(float(old) * chance.choice(FACTORS))),
    "shifted": _cells(lambda old, one, chance: repr(float(old) + chance.choice((-1e9, -360.0, 1e-9, 1.0, 90.0, 1e9)))),
    "constant": _cells(lambda old, one, chance: one),
    "few rows": lambda rows, chance: rows[: 1 + chance.choice((0, 1, 2, 3, 4, 6, 10))],
    "lost rows": lambda rows, chance: [row for k, row in enumerate(rows) if k == 0 or chance.random() < 0.8],
    "rows again": _again,
    "other order": lambda rows, chance: [rows[0], *chance.sample(rows[1:], len(rows) - 1)],
    "ragged": _ragged,
    "lost column": _column(lambda cell: []),
    "column again": _column(lambda cell: cell * 2),
    "other heads": lambda rows, chance: [chance.sample(rows[0], len(rows[0])), *rows[1:]],
}
SEPARATED: dict[str, OfText] = {
    "another separator": lambda text, chance: text.replace(",", chance.choice(";\t|")),
    "decimal commas": lambda text, chance: text.replace(".", ","),
    "quoted": lambda text, chance: re.sub(r"[^,\n]+", r'"\g<0>"', text),
    "another unit": _replaced(r"\[.*?\]", lambda old, chance: f"[{chance.choice(NASTY['units'])}]"),
}


def _tables(table: Mapping[str, Callable[[Rows, random.Random], Rows]]) -> dict[str, Mutator]:
    """Return changes of cells as mutators of a file. Comments and quotes are cells like others."""

    def of(change: Callable[[Rows, random.Random], Rows]) -> Mutator:
        def mutator(content: bytes, chance: random.Random) -> bytes:
            rows = change([line.split(",") for line in content.decode().split("\n")], chance)
            return "\n".join(",".join(row) for row in rows).encode("utf-8", "surrogatepass")

        return mutator

    return {name: of(one) for name, one in table.items()}


# --- images


def _pixels(content: bytes) -> Pixels:
    """Return the pixels of a TIFF, FITS, PNG or JPEG file."""
    if content[:2] in (b"II", b"MM"):
        return np.asarray(tifffile.imread(io.BytesIO(content)))
    if content.startswith(b"SIMPLE"):
        with fits.open(io.BytesIO(content)) as units:
            return np.array(units[0].data)
    return np.asarray(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED))


def _file_of(pixels: Pixels, content: bytes, **how: Any) -> bytes:
    """Return pixels as a file of the same format; tags of a GeoTIFF and notes go."""
    out = io.BytesIO()
    if content.startswith(b"SIMPLE"):
        fits.PrimaryHDU(pixels).writeto(out)
    elif content[:2] in (b"II", b"MM"):
        tifffile.imwrite(out, pixels, **how)
    else:
        return bytes(cv2.imencode(".png" if content.startswith(b"\x89PNG") else ".jpg", pixels)[1])
    return out.getvalue()


def _top(pixels: Pixels) -> float:
    return float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind in "ui" else 1e38


def level(pixels: Pixels, chance: random.Random) -> Pixels:
    """All dark, all saturated, or darker and brighter than any image."""
    light = chance.choice(
        (0.0 * pixels, 0.0 * pixels + _top(pixels), *(f * pixels.astype(float) for f in (0.01, 30.0)))
    )
    return np.clip(light, 0, _top(pixels)).astype(pixels.dtype)


def patched(pixels: Pixels, chance: random.Random) -> Pixels:
    """A patch, row or column of one value."""
    out, (rows, columns) = pixels.copy(), pixels.shape[-2:]
    first, beside = chance.randrange(rows), chance.randrange(columns)
    out[..., first : first + chance.choice((1, rows)), beside : beside + chance.choice((1, columns))] = _top(out)
    return out


def noise(pixels: Pixels, chance: random.Random) -> Pixels:
    return (
        np.random.default_rng(chance.randrange(2**32))
        .uniform(0.0, 1e-2 * _top(pixels), pixels.shape)
        .astype(pixels.dtype)
    )


def cut(pixels: Pixels, chance: random.Random) -> Pixels:
    """Fewer rows and columns, or mirrored."""
    rows, columns = (chance.choice((1, 2, 5, n // 2, n - 1, n)) for n in pixels.shape[-2:])
    return chance.choice((pixels[..., :rows, :columns], pixels[..., ::-1].copy(), np.swapaxes(pixels, -1, -2).copy()))


def kind(pixels: Pixels, chance: random.Random) -> Pixels:
    """Other numbers of the same values, some of which are none."""
    out = pixels.astype(chance.choice(("f4", "f8", "i2", "i4", "u1", "u4")))
    if out.dtype.kind == "f":
        out.flat[chance.randrange(out.size)] = chance.choice((np.nan, np.inf, 1e30, 0.5))
    return out


def depth(pixels: Pixels, chance: random.Random) -> Pixels:
    """More or fewer dimensions: pages, colours."""
    return chance.choice((pixels[None], np.stack([pixels] * 3, axis=-1), np.concatenate([pixels] * 2), pixels[:1]))


def _images(change: Callable[[Pixels, random.Random], Pixels]) -> Mutator:
    return lambda content, chance: _file_of(change(_pixels(content), chance), content)


PACKED: tuple[dict[str, Any], ...] = (
    *({"compression": "zlib"}, {"bigtiff": True}, {"byteorder": ">"}, {"tile": (16, 16)}),
    *({"photometric": "miniswhite"}, {"description": "x" * 5000}, {"description": '{"note": {}, "frames": "x"}'}),
)


def packed(content: bytes, chance: random.Random) -> bytes:
    """The same pixels, written in another way."""
    return _file_of(_pixels(content), content, **chance.choice(PACKED))


def card(content: bytes, chance: random.Random) -> bytes:
    """A card of a FITS file's head is another one."""
    out, at = bytearray(content), 80 * chance.randrange(content.index(b"END" + b" " * 77) // 80)
    value = chance.choice(("0", "-1", "1", "99999999", "T", "'x'", "1e400", "NaN", "", "-64", "17", "2147483647"))
    key = chance.choice((bytes(out[at : at + 8]), b"NAXIS3  ", b"BSCALE  ", b"BZERO   ", b"BLANK   ", b"DATE-OBS"))
    out[at : at + 80] = (key + b"= " + f"{value:>20}".encode()).ljust(80)
    return bytes(out)


IMAGES = {name: _images(one) for name, one in _named(level, patched, noise, cut, kind, depth).items()}
IMAGES |= _named(packed, card, number_of_head)


# --- data sets (netCDF-4, which is HDF5)


def lost_variable(data: h5py.File, name: str, chance: random.Random) -> None:
    del data[name]


def other_values(data: h5py.File, name: str, chance: random.Random) -> None:
    """Values that are none, infinite or extreme, in all of a variable."""
    data[name][...] = chance.choice((0, 1, -1, np.nan, np.inf, 1e300) if data[name].dtype.kind == "f" else (0, 1, 100))


def other_array(data: h5py.File, name: str, chance: random.Random) -> None:
    """A variable of another shape or kind, beside dimensions that are as they were."""
    values = np.asarray(data[name][()])
    new = (values.reshape(-1)[:1], values.reshape(-1), values[None], values.astype("S8"), np.nan_to_num(values) > 0)
    del data[name]
    data.create_dataset(name, data=chance.choice(new))


def other_note(data: h5py.File, name: str, chance: random.Random) -> None:
    """An attribute of a variable, or of the file, is another one or missing."""
    notes = (data[name] if chance.random() < 0.6 else data).attrs
    key = chance.choice(sorted(set(notes) - {"DIMENSION_LIST", "REFERENCE_LIST", "CLASS", "NAME"}))
    if chance.random() < 0.3:
        del notes[key]
    else:
        notes[key] = chance.choice(("", "x", "days since 1970-01-01", "m" * 2000, 5, -1.5, [1, 2, 3], "\u202e"))


def _data_sets(change: Callable[[h5py.File, str, random.Random], None]) -> Mutator:
    def mutator(content: bytes, chance: random.Random) -> bytes:
        out = io.BytesIO(content)
        with h5py.File(out, "r+") as data:
            names: list[str] = []
            data.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
            change(data, chance.choice(sorted(names)), chance)
        return out.getvalue()

    return mutator


DATA_SETS = {
    name: _data_sets(one) for name, one in _named(lost_variable, other_values, other_array, other_note).items()
}
DATA_SETS |= _named(number_of_head)


_TOKENS, _LINES = _texts(TOKENS), _texts(LINES)
KINDS: Mapping[str, Mapping[str, tuple[int, dict[str, Mutator]]]] = {
    "yaml": {
        "byte": (14, BYTES),
        "token": (26, _TOKENS),
        "tree": (40, _trees(TREES, False)),
        "path": (10, _trees(PATHS, False)),
        "yaml": (10, _texts(YAMLS)),
    },
    "json": {"byte": (20, BYTES), "token": (20, _TOKENS), "tree": (60, _trees(TREES | PATHS, True))},
    "table": {"byte": (20, BYTES), "token": (25, _TOKENS | _LINES), "table": (55, _tables(TABLES) | _texts(SEPARATED))},
    "text": {"byte": (25, BYTES), "token": (40, _TOKENS), "line": (35, _LINES)},
    "image": {"byte": (40, BYTES), "image": (60, IMAGES)},
    "data": {"byte": (40, BYTES), "data": (60, DATA_SETS)},
    "binary": {"byte": (1, BYTES)},
}
"""Form of a file -> kind of change -> its weight and mutators by name."""
