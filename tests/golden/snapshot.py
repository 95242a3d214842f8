"""What a run computed, as a tree of numbers and texts that fits into a small JSON file.

Left out, since they differ from run to run or from checkout to checkout:

- values of the keys in LEFT_OUT: times, durations, versions, checksums of the source, number of workers; of a table of
  checksums by file the names are kept;
- in texts: the paths of the run and of the project, the DURATIONS, and the versions' row of a report;
- lines by which a study tells its PACE;
- SKIPPED files: a study's chunks, whose size follows from the pace and whose numbers are in study.nc.

Few numbers are kept in full; of many a checksum of their bytes and statistics are (`summary`).
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import re
import struct
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
import xarray as xr
from ruamel.yaml import YAML

from tests.golden.jobs import ROOT, Done

IN_FULL = 2000
"""Numbers and texts of a JSON, YAML or CSV file that are kept one by one; of more, pieces of PIECE are summarised."""
PIECE = 400
LONG = 80
"""Characters of a text in such a file; of a longer one the beginning and a checksum are kept."""
SAMPLES = 8
LEFT_OUT = {
    "": {"versions", "started_unix_s", "wall_time_s", "seconds", "worker_seconds", "states_per_second"},
    "manifest.json": {"workers", "provenance", "digest"},
    "study_state.json": {"fingerprint", "content", "sources"},
    "study.nc": {"fingerprint"},
}
"""Keys by file, "" for every file. Words that mean something physical elsewhere, as the sources of stray light, stand
with the one file in which they do not.
"""
SKIPPED = re.compile(r"^chunks/")
TAGS = ("DateTime", "Software")
"""Of a TIFF, left out."""
DURATIONS = (
    re.compile(r"(?<=float64; )[\d.]+ (s|min)\b"),
    re.compile(r"(?<=--out again` in )\d+ (s|min)\b"),
    re.compile(r"(?<=\d checks, )\d+ (s|min)\b"),
)
"""In a report's last table, in the validation's summary and in the lead of its report."""
VERSION, FIRST = re.compile(r"(?<=space-camera-twin )\d+\.\d+\.\d+"), "0.1.0"
"""The program's own version, and the one with which most of the files were made: any counts as that one."""
PACE = re.compile(r"^(\d+ runs .*; about .* a run|progress: .*)$")
"""Lines on stderr that tell how fast and how far a command is."""


def digest(data: bytes) -> str:
    """64 bits of a SHA-256."""
    return hashlib.sha256(data).hexdigest()[:16]


def summary(values: Any) -> dict[str, Any]:
    """Checksum and statistics of many numbers.

    Sums are correctly rounded whatever the order. Numbers that are not finite are counted and left out of them.
    """
    array = np.ascontiguousarray(values)
    out: dict[str, Any] = {
        "dtype": str(array.dtype),
        "shape": list(array.shape),
        "bytes": digest(array.astype(array.dtype.newbyteorder("<")).tobytes()),
    }
    if array.dtype.kind not in "biuf" or not array.size:
        return out
    flat = array.astype(np.float64).ravel()
    finite = flat[np.isfinite(flat)]
    picked = np.linspace(0, flat.size - 1, min(SAMPLES, flat.size)).round().astype(int)
    out |= {
        "not_finite": int(flat.size - finite.size),
        "sum": math.fsum(finite),
        "squares": math.fsum(finite * finite),
        "min": float(finite.min()) if finite.size else None,
        "max": float(finite.max()) if finite.size else None,
        "samples": [float(flat[k]) for k in picked],
    }
    return out


def _numbers(tree: Any) -> list[float]:
    if isinstance(tree, dict):
        return [number for below in tree.values() for number in _numbers(below)]
    if isinstance(tree, list):
        return [number for below in tree for number in _numbers(below)]
    return [float(tree)] if isinstance(tree, int | float) and not isinstance(tree, bool) else []


def _form(tree: Any) -> Any:
    """Keys and texts without the numbers."""
    if isinstance(tree, dict):
        return {key: _form(below) for key, below in tree.items()}
    if isinstance(tree, list):
        return [_form(below) for below in tree]
    return 0 if isinstance(tree, int | float) and not isinstance(tree, bool) else tree


def _leaves(tree: Any) -> int:
    if isinstance(tree, dict | list):
        return sum(map(_leaves, tree.values() if isinstance(tree, dict) else tree))
    return 1


def condensed(tree: Any) -> Any:
    """A small tree as it is; of one with more than IN_FULL leaves every piece that is small enough, summarised."""
    if _leaves(tree) <= IN_FULL:
        return tree

    def piece(below: Any) -> Any:
        leaves = _leaves(below)
        flat = isinstance(below, list) and all(not isinstance(one, dict | list) for one in below)
        if leaves < 12:
            return below
        if leaves <= PIECE or flat:
            return summary(np.array(_numbers(below))) | {"form": digest(json.dumps(_form(below)).encode())}
        if isinstance(below, dict):
            return {key: piece(one) for key, one in below.items()}
        if not all(isinstance(one, list) for one in below):
            return [piece(one) for one in below]
        rows = max(1, PIECE * len(below) // leaves)
        return {f"{k}:{k + rows}": piece(below[k : k + rows]) for k in range(0, len(below), rows)}

    if isinstance(tree, dict):
        return {key: piece(below) for key, below in tree.items()}
    return piece(tree)


def timeless(tree: Any, name: str = "") -> Any:
    """What a file holds without what differs from run to run."""
    if isinstance(tree, dict):
        left_out = LEFT_OUT[""] | LEFT_OUT.get(name, set())
        return {
            str(key): sorted(below) if _checksums(key, below, name) else timeless(below, name)
            for key, below in tree.items()
            if key not in left_out
        }
    return [timeless(below, name) for below in tree] if isinstance(tree, list) else tree


def _checksums(key: str, below: Any, name: str) -> bool:
    """Whether a value is a table of checksums by file."""
    return isinstance(below, dict) and (key == "sha256" or (key == "inputs" and name == "manifest.json"))


class Reader:
    """Reads the files of one run.

    Args:
        done: the run.
    """

    def __init__(self, done: Done) -> None:
        self.done = done

    def snapshot(self) -> dict[str, Any]:
        """Exit code, names of files, what was printed, contents of each file."""
        done = self.done
        every = sorted(path.relative_to(done.out).as_posix() for path in done.out.rglob("*") if path.is_file())
        names = [name for name in every if not SKIPPED.search(name)]
        tree: dict[str, Any] = {
            "exit": done.code,
            "files": names,
            "stdout": self._printed(done.stdout),
            "stderr": self._printed(done.stderr),
        }
        return tree | {name: self._file(name) for name in names}

    def text(self, text: str) -> str:
        """White space as single blanks, without paths of this run and durations."""
        for place, name in ((self.done.out, "OUT"), (self.done.here, "HERE"), (ROOT, "ROOT")):
            text = text.replace(str(place), name)
        text = " ".join(text.split())
        for pattern in DURATIONS:
            text = pattern.sub("TIME", text)
        return VERSION.sub(FIRST, text)

    def _texts(self, tree: Any) -> Any:
        if isinstance(tree, dict):
            return {self.text(key): self._texts(below) for key, below in tree.items()}
        if isinstance(tree, list):
            return [self._texts(below) for below in tree]
        if not isinstance(tree, str):
            return tree
        text = self.text(tree)
        return text if len(text) <= LONG else f"{text[:30]}... {digest(text.encode())}"

    def _json(self, text: str, name: str = "") -> Any:
        return condensed(self._texts(timeless(json.loads(text), name)))

    def _printed(self, text: str) -> Any:
        if text.lstrip().startswith(("{", "[")):
            return self._json(text)
        return [line for line in map(self.text, text.splitlines()) if line and not PACE.search(line)]

    def _file(self, name: str) -> Any:
        path = self.done.out / name
        kind = path.suffix.lstrip(".")
        read = getattr(self, f"_read_{kind}", None)
        if read is None:
            return {"sha256": digest(path.read_bytes())}
        return read(path)

    def _read_json(self, path: Path) -> Any:
        return self._json(path.read_text("utf-8"), path.name)

    def _read_md(self, path: Path) -> Any:
        return [self._texts(line) for line in path.read_text("utf-8").splitlines() if line.strip()]

    def _read_yaml(self, path: Path) -> Any:
        return condensed(self._texts(timeless(YAML(typ="safe").load(path.read_text("utf-8")))))

    def _read_csv(self, path: Path) -> Any:
        rows = [[_cell(cell) for cell in row] for row in csv.reader(io.StringIO(path.read_text("utf-8")))]
        return condensed(self._texts({"head": rows[0] if rows else [], "rows": rows[1:]}))

    def _read_nc(self, path: Path) -> Any:
        groups = xr.open_groups(path, engine="h5netcdf", decode_cf=False)
        return {group: timeless(self._group(data), path.name) for group, data in groups.items()}

    def _group(self, data: xr.Dataset) -> Any:
        with data:
            return {
                "dims": {str(name): int(size) for name, size in data.sizes.items()},
                "attrs": self._attributes(data.attrs),
                "variables": {
                    str(name): {
                        "dims": [str(dim) for dim in variable.dims],
                        "attrs": self._attributes(variable.attrs),
                        "values": self._values(variable.values),
                    }
                    for name, variable in sorted(data.variables.items())
                },
            }

    def _attributes(self, attributes: dict[Any, Any]) -> Any:
        plain = {
            str(key): value.tolist() if isinstance(value, np.ndarray | np.generic) else value
            for key, value in attributes.items()
        }
        texts = {
            key: value if isinstance(value, str | int | float | list) else str(value) for key, value in plain.items()
        }
        return self._texts(timeless(texts))

    def _values(self, values: np.ndarray) -> Any:
        if values.dtype.kind in "OSU":
            return {"dtype": "text", "texts": [self.text(str(one)) for one in values.ravel()][:IN_FULL]}
        if values.size <= 2 * SAMPLES:
            return {"dtype": str(values.dtype), "shape": list(values.shape), "list": values.ravel().tolist()}
        return summary(values)

    def _read_tiff(self, path: Path) -> Any:
        with tifffile.TiffFile(path) as file:
            tags = {
                tag.name: self.text(str(tag.value))
                for tag in file.pages[0].tags.values()
                if tag.name not in TAGS and not tag.name.endswith(("Offsets", "ByteCounts"))
            }
            return {"pages": len(file.pages), "tags": tags, "pixels": summary(file.asarray())}

    def _read_png(self, path: Path) -> Any:
        return summary(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))

    def _read_svg(self, path: Path) -> Any:
        return drawing(path.read_text("utf-8"))

    def _read_html(self, path: Path) -> Any:
        return page(path.read_text("utf-8"), self.text)

    def _read_glb(self, path: Path) -> Any:
        return scene(path.read_bytes())


def _cell(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text


def drawing(text: str) -> Any:
    """Of an SVG: the texts in it, and the numbers of its paths and places, which do not depend on ids."""
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    said = re.findall(r"<text[^>]*>(.*?)</text>", text, flags=re.S)
    places = " ".join(re.findall(r'\b(?:d|x|y|cx|cy|r|width|height|points|transform)="([^"]*)"', text))
    found = np.array([float(number) for number in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", places)])
    return {"texts": len(said), "said": digest("\n".join(said).encode()), "ink": summary(found)}


def scene(data: bytes) -> Any:
    """Of a GLB: names of its nodes in order, its meshes, and the numbers of its geometry."""
    magic, _, _ = struct.unpack_from("<4sII", data)
    if magic != b"glTF":
        return {"sha256": digest(data)}
    length = struct.unpack_from("<I", data, 12)[0]
    told = json.loads(data[20 : 20 + length])
    binary = data[20 + length + 8 :]
    kinds = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
    widths = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
    numbers: dict[str, list[np.ndarray]] = {}
    for accessor in told.get("accessors", []):
        view = told["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        kind, count = kinds[accessor["componentType"]], accessor["count"] * widths[accessor["type"]]
        numbers.setdefault(kind, []).append(np.frombuffer(binary, kind, count, start))
    nodes = told.get("nodes", [])
    return {
        "nodes": [node.get("name") for node in nodes],
        "placed": summary(np.array(_numbers([node.get("matrix", []) for node in nodes]))),
        "meshes": len(told.get("meshes", [])),
        "materials": [material.get("name") for material in told.get("materials", [])],
        "geometry": {kind.lstrip("<"): summary(np.concatenate(parts)) for kind, parts in sorted(numbers.items())},
    }


class _Page(HTMLParser):
    """Splits a report into sections, headings, tables and prose; drawings are only counted."""

    HEADINGS = ("h1", "h2", "h3", "h4")
    HIDDEN = ("style", "script", "svg")

    def __init__(self) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.headings: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.figures = {"svg": 0, "img": 0}
        self.prose: dict[str, str] = {}
        self._hidden = 0
        self._cell: list[str] | None = None
        self._heading: list[str] | None = None

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in self.figures and not self._hidden:
            self.figures[tag] += 1
        if tag in self.HIDDEN:
            self._hidden += 1
        if self._hidden:
            return
        named = dict(attrs).get("id")
        if named:
            self.ids.append(named)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr" and self.tables:
            self.tables[-1].append([])
        elif tag in ("td", "th") and self.tables:
            self._cell = []
        elif tag in self.HEADINGS:
            self._heading = []

    def handle_endtag(self, tag: str) -> None:
        if tag in self.HIDDEN:
            self._hidden -= 1
        elif tag in ("td", "th") and self._cell is not None:
            self.tables[-1][-1].append(" ".join(self._cell))
            self._cell = None
        elif tag in self.HEADINGS and self._heading is not None:
            self.headings.append("".join(self._heading))
            self._heading = None

    def handle_data(self, data: str) -> None:
        if self._hidden or not data.strip():
            return
        if self._heading is not None:
            self._heading.append(data)
        elif self._cell is not None:
            self._cell.append(data.strip())
        else:
            last = self.headings[-1] if self.headings else ""
            self.prose[last] = self.prose.get(last, "") + data


def page(text: str, clean: Any) -> Any:
    """Of a report: ids, headings, cells of all tables, number of figures, and below each heading a checksum of the
    prose, which has numbers in it. A row of versions is left out.
    """
    parser = _Page()
    parser.feed(text)
    tables = [
        [[clean(cell) for cell in row] for row in table if row and row[0] != "Versions"] for table in parser.tables
    ]
    return {
        "ids": parser.ids,
        "headings": [clean(one) for one in parser.headings],
        "figures": parser.figures,
        "tables": [_table(rows) for rows in tables],
        "prose": {clean(under): digest(clean(said).encode()) for under, said in parser.prose.items()},
    }


CELLS = 60


def _table(rows: list[list[str]]) -> Any:
    """A small table's cells in full, of a larger one its heads and a checksum for each row."""
    if sum(map(len, rows)) <= CELLS:
        return rows
    return {"head": rows[0], "rows": [digest("\t".join(row).encode())[:8] for row in rows[1:]]}
