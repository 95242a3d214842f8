"""What a run computed, as a tree of numbers and texts that fits into a small JSON file (tests/golden/digest.py).

Left out, since they differ from run to run or from checkout to checkout:

- values of the keys in LEFT_OUT: times, durations, versions, checksums of the source, number of workers; of a table of
  checksums by file the names are kept;
- in texts: the paths of the run and of the project, the DURATIONS, and the versions' row of a report;
- lines by which a study tells its PACE;
- SKIPPED files: the journal of a study, whose order follows from the pace and whose numbers are in study.nc, and the
  database of a record, which is written out as tables.
"""

from __future__ import annotations

import codecs
import csv
import hashlib
import io
import json
import re
import struct
from html import unescape
from itertools import zip_longest
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
import xarray as xr
from ruamel.yaml import YAML

from tests.golden.digest import array, checksum, condensed, sorts, texts
from tests.golden.jobs import ROOT, Done

LEFT_OUT = {
    "": set("versions started_unix_s wall_time_s seconds worker_seconds states_per_second raised_utc ms".split()),
    "manifest.json": {"workers", "provenance", "digest"},
    "study.nc": {"fingerprint"},
}
"""Keys by file, "" for every file. Words that mean something physical elsewhere, as the sources of stray light, stand
with the one file in which they do not.
"""
SKIPPED = re.compile(r"\.journal$|record\.sqlite")
TAGS = ("DateTime", "Software")
"""Of a TIFF, left out."""
DURATIONS = (
    re.compile(r"(?<=float64; )[\d.]+ (s|min)\b"),
    re.compile(r"(?<=--out again` in )\d+ (s|min)\b"),
    re.compile(r"(?<=\d checks, )\d+ (s|min)\b"),
)
"""In a report's last table, in the validation's summary and in the lead of its report."""
VERSION, FIRST = re.compile(r"(?<=space-camera-twin )\d+\.\d+\.\d+"), "0.1.0"
"""The program's own version, and the one that every version counts as."""
PACE = re.compile(r"^(\d+ runs .*; about .* a run|progress: .*)$")
"""Lines on stderr that tell how fast and how far a command is."""


def timeless(tree: Any, name: str = "") -> Any:
    """Return what a file holds without the values that differ from run to run."""
    if isinstance(tree, dict):
        left_out = LEFT_OUT[""] | LEFT_OUT.get(name, set())
        return {
            str(key): {"#free": sorts(below)}
            if key in left_out or _checksums(key, below, name)
            else timeless(below, name)
            for key, below in tree.items()
        }
    return [timeless(below, name) for below in tree] if isinstance(tree, list) else tree


def _checksums(key: str, below: Any, name: str) -> bool:
    """Return whether a value is a table of checksums by file."""
    return isinstance(below, dict) and (key == "sha256" or (key == "inputs" and name == "manifest.json"))


class Reader:
    """Reads the files of one run.

    Args:
        done: the run.
    """

    def __init__(self, done: Done) -> None:
        self.done = done
        self._all = hashlib.sha256()

    def snapshot(self) -> dict[str, Any]:
        """Return exit code, what was printed, contents of each file by its name, and a checksum of it all."""
        done = self.done
        every = sorted(path.relative_to(done.out).as_posix() for path in done.out.rglob("*") if path.is_file())
        names = [name for name in every if not SKIPPED.search(name)]
        tree: dict[str, Any] = {
            "exit": [one.code for one in done.printed],
            "stdout": [self._printed(one.stdout, names) for one in done.printed],
            "stderr": [self._printed(one.stderr, names) for one in done.printed],
        }
        tree |= {name: self._file(name) for name in names}
        return tree | {"exact": self._all.hexdigest()[:16]}

    def _exact(self, content: bytes | str | np.ndarray) -> None:
        if isinstance(content, np.ndarray):
            content = repr(content.tolist()) if content.dtype.kind in "OSU" else np.ascontiguousarray(content).tobytes()
        self._all.update(content if isinstance(content, bytes) else content.encode())

    def text(self, text: str) -> str:
        """Return a text with single blanks, without paths of this run, of the project and durations."""
        for place, name in (
            (self.done.out, "OUT"),
            (self.done.here, "HERE"),
            (self.done.here.parent, "JOBS"),
            (ROOT, "ROOT"),
        ):
            text = text.replace(str(place), name)
        text = re.sub("─+", "─", " ".join(text.split()))
        for pattern in DURATIONS:
            text = pattern.sub("TIME", text)
        return VERSION.sub(FIRST, text)

    def _texts(self, tree: Any) -> Any:
        if isinstance(tree, dict):
            return {self.text(key): self._texts(below) for key, below in tree.items()}
        if isinstance(tree, list):
            return [self._texts(below) for below in tree]
        return self.text(tree) if isinstance(tree, str) else tree

    def _tree(self, tree: Any, name: str = "") -> Any:
        plain = self._texts(timeless(tree, name))
        self._exact(json.dumps(plain))
        return condensed(plain)

    def _printed(self, text: str, names: list[str]) -> Any:
        if text.lstrip().startswith(("{", "[")):
            tree = json.loads(text)
            for name in names:
                if name.endswith(".json") and json.loads((self.done.out / name).read_text("utf-8")) == tree:
                    return f"the same as {name}"
            return self._tree(tree)
        lines = [line for line in map(self.text, text.splitlines()) if line and not PACE.search(line)]
        self._exact("\n".join(lines))
        return lines

    def _file(self, name: str) -> Any:
        path = self.done.out / name
        read = getattr(self, f"_read_{path.suffix.lstrip('.').lower()}", None)
        return {"sha256": checksum(path.read_bytes())} if read is None else read(path)

    def _read_json(self, path: Path) -> Any:
        tree = json.loads(path.read_text("utf-8"))
        if path.name.endswith(".schema.json"):
            # what a definition allows, as one checksum each
            parts = {**tree.pop("$defs", {}), "": tree}
            return {"definitions": {key: checksum(json.dumps(part)) for key, part in parts.items()}}
        return self._tree(tree, path.name)

    def _read_jsonl(self, path: Path) -> Any:
        return self._tree([json.loads(line) for line in path.read_text("utf-8").splitlines()], path.name)

    def _read_md(self, path: Path) -> Any:
        data = path.read_bytes()
        text = data.decode("utf-16" if data[:2] == codecs.BOM_UTF16_LE else "utf-8")
        return self._tree([line for line in text.splitlines() if line.strip()])

    _read_txt = _read_zmx = _read_md

    def _read_yaml(self, path: Path) -> Any:
        tree = YAML(typ="safe").load(path.read_text("utf-8"))
        if path.name != "config.yaml":
            return self._tree(tree)
        # what the job was given, written out: one checksum for each part
        return {
            f"{key} / {name}" if name else key: checksum(json.dumps(self._texts(below), default=str))
            for key, part in tree.items()
            for name, below in (part if isinstance(part, dict) else {"": part}).items()
        }

    def _read_csv(self, path: Path) -> Any:
        rows = list(csv.reader(io.StringIO(path.read_text("utf-8"))))
        columns = list(zip_longest(*rows, fillvalue=""))
        names = [self.text(column[0]) for column in columns]
        named = {
            name if names.count(name) == 1 else f"{name} {k}": [self.text(cell) for cell in column[1:]]
            for k, (name, column) in enumerate(zip(names, columns, strict=True))
        }
        self._exact(json.dumps(named))
        return {"head": names, "columns": {key: condensed([_cell(cell) for cell in one]) for key, one in named.items()}}

    def _read_nc(self, path: Path) -> Any:
        groups = xr.open_groups(path, engine="h5netcdf", decode_cf=False)
        return {group: self._group(data, path.name) for group, data in groups.items()}

    def _group(self, data: xr.Dataset, name: str) -> Any:
        with data:
            return {
                "dims": {str(dim): int(size) for dim, size in data.sizes.items()},
                "attrs": self._attributes(data.attrs, name),
                "variables": {
                    str(key): {
                        "dims": [str(dim) for dim in variable.dims],
                        "attrs": self._attributes(variable.attrs, name),
                        "values": self._values(variable.values),
                    }
                    for key, variable in sorted(data.variables.items())
                },
            }

    def _attributes(self, attributes: dict[Any, Any], name: str) -> Any:
        plain = {
            str(key): value.tolist() if isinstance(value, np.ndarray | np.generic) else value
            for key, value in attributes.items()
        }
        return self._tree(
            {key: value if isinstance(value, str | int | float | list) else str(value) for key, value in plain.items()},
            name,
        )

    def _values(self, values: np.ndarray) -> Any:
        self._exact(values)
        if values.dtype.kind in "OSU":
            return texts([self.text(str(one)) for one in values.ravel()] or [""])
        return array(values)

    def _read_tiff(self, path: Path) -> Any:
        with tifffile.TiffFile(path) as file:
            tags = {
                tag.name: self.text(str(tag.value))
                for tag in file.pages[0].tags.values()
                if not tag.name.endswith(("Offsets", "ByteCounts"))
            }
            free = {key: {"#free": {"": "text"}} for key in TAGS if key in tags}
            values = file.asarray()
            return {"pages": len(file.pages), "tags": condensed(tags) | free, "pixels": self._values(values)}

    _read_tif = _read_tiff

    def _read_png(self, path: Path) -> Any:
        return self._values(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))

    def _read_svg(self, path: Path) -> Any:
        return self._kept(drawing(path.read_text("utf-8")))

    def _read_html(self, path: Path) -> Any:
        return self._kept(page(path.read_text("utf-8"), self.text))

    def _read_glb(self, path: Path) -> Any:
        return self._kept(scene(path.read_bytes()))

    def _kept(self, tree: Any) -> Any:
        self._exact(json.dumps(tree))
        return tree


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
    return {"said": texts(said or [""]), "ink": array(found)}


def scene(data: bytes) -> Any:
    """Of a GLB: names of its nodes in order, its meshes, and the numbers of its geometry."""
    magic, _, _ = struct.unpack_from("<4sII", data)
    if magic != b"glTF":
        return {"sha256": checksum(data)}
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
        "nodes": condensed([node.get("name") or "" for node in nodes]),
        "placed": array(np.array([number for node in nodes for number in node.get("matrix", [])])),
        "meshes": len(told.get("meshes", [])),
        "materials": [material.get("name") for material in told.get("materials", [])],
        "geometry": {kind.lstrip("<"): array(np.concatenate(parts)) for kind, parts in sorted(numbers.items())},
    }


TAG = r"(?s)<{0}\b[^>]*>.*?</{0}>"
HEADING = re.compile(r"(?s)<h[1-4]\b[^>]*>(.*?)</h[1-4]>")


def _pieces(text: str) -> list[str]:
    """Return the texts between tags, without those that are blank."""
    return [unescape(part) for part in re.split(r"<[^>]*>", text) if part.strip()]


def page(text: str, clean: Any) -> Any:
    """Return ids, headings, number of figures of a report, and of each table and of the prose below each heading the
    digest of its texts with the numbers that are printed in it. A row of versions is left out.
    """
    for hidden in ("style", "script"):
        text = re.sub(TAG.format(hidden), "", text)
    text, drawn = re.subn(TAG.format("svg"), "", text)
    tables = []
    for table in re.findall(TAG.format("table"), text):
        cells = [re.findall(r"(?s)<t[dh]\b[^>]*>(.*?)</t[dh]>", row) for row in re.split(r"<tr\b[^>]*>", table)[1:]]
        rows = [[clean(" ".join(part.strip() for part in _pieces(cell))) for cell in row] for row in cells]
        tables.append(texts(["\t".join(row) for row in rows if row and row[0] != "Versions"] or [""]))
    rest = re.sub(r"(?s)<t[dh]\b[^>]*>.*?</t[dh]>", "", text)
    parts = HEADING.split(rest)
    headings = [clean("".join(_pieces(one))) for one in parts[1::2]]
    prose: dict[str, str] = {}
    for under, said in zip(["", *headings], parts[::2], strict=True):
        if pieces := _pieces(said):
            prose[under] = prose.get(under, "") + "".join(pieces)
    return {
        "ids": condensed(re.findall(r'<\w+\b[^>]*?\bid="([^"]*)"', text)),
        "headings": condensed(headings),
        "figures": {"svg": drawn, "img": len(re.findall(r"<img\b", text))},
        "tables": tables,
        "prose": {under: texts([clean(said)]) for under, said in prose.items()},
    }
