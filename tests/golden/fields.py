"""What stands in the files of a run folder, without the values: keys of JSON, columns of CSV, variables of netCDF, tags
of TIFF. The reference of the run folders is made from it (docs/site), since no large file is kept whole here.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import tifffile
import xarray as xr

from tests.golden.snapshot import SKIPPED

FOLDER = Path(__file__).parent / "fields"
NAMES = 8
"""Of things of one sort so many are named; of more the first ones and an ellipsis."""
_KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_SORTS = {bool: "true or false", int: "number", float: "number", str: "text", type(None): "null"}


def fields_file(job: str) -> Path:
    """Where the fields of a job's files are kept."""
    return FOLDER / f"{job}.json"


def fields_of(out: Path) -> dict[str, Any]:
    """File, relative to the run folder -> what stands in it.

    ``fields`` of JSON and YAML: path of a value -> its sort; in a path ``{a|b}`` stands for things of one sort by name
    and ``[]`` for the items of a list. ``columns`` of CSV. ``variables`` of netCDF: name -> dimensions, sort of number
    and attributes. ``pages``, ``dtype`` and ``tags`` of TIFF.
    """
    found: dict[str, Any] = {}
    for path in sorted(out.rglob("*")):
        name = path.relative_to(out).as_posix()
        if path.is_file() and not SKIPPED.search(name):
            read = _READERS.get(path.suffix, lambda path: {})
            found[name] = read(path)
    return found


def json_fields(tree: Any) -> dict[str, str]:
    """Path of every value -> its sort; of values at the same path all sorts."""
    sorts: dict[str, set[str]] = {}
    _collect(tree, "", sorts)
    return {path: " or ".join(sorted(kinds - {"null"}) + sorted(kinds & {"null"})) for path, kinds in sorts.items()}


def _collect(tree: Any, path: str, sorts: dict[str, set[str]]) -> None:
    if isinstance(tree, dict):
        if _alike(tree):
            for below in tree.values():
                _collect(below, f"{path}.{_braced(tree)}", sorts)
        else:
            for key, below in tree.items():
                _collect(below, f"{path}.{key}", sorts)
        if not tree:
            sorts.setdefault(path.lstrip("."), set()).add("mapping")
    elif isinstance(tree, list):
        for below in tree:
            _collect(below, f"{path}[]", sorts)
        if not tree:
            sorts.setdefault(f"{path.lstrip('.')}[]", set())
    else:
        sorts.setdefault(path.lstrip("."), set()).add(_SORTS[type(tree)])


def _alike(tree: dict[str, Any]) -> bool:
    """Whether a mapping holds things of one sort by name: mappings with the same keys, or what no key can be named."""
    below = list(tree.values())
    if len(below) > 1 and all(isinstance(one, dict) and one for one in below):
        return all(set(one) == set(below[0]) for one in below)
    return any(not _KEY.fullmatch(key) for key in tree)


def _braced(names: Iterable[str]) -> str:
    listed = [str(name) for name in names]
    return "{" + "|".join(listed[:NAMES]) + ("|..." if len(listed) > NAMES else "") + "}"


def _read_json(path: Path) -> Any:
    if path.name.endswith(".schema.json"):
        return {}  # what a JSON Schema holds says its own standard
    tree = json.loads(path.read_text("utf-8"))
    if path.name == "manifest.json" and tree.get("inputs"):
        tree["inputs"] = {"/PATH/FILE": "checksum"}
    return {"fields": json_fields(tree)}


def _read_csv(path: Path) -> Any:
    return {"columns": next(csv.reader(io.StringIO(path.read_text("utf-8"))), [])}


def _read_nc(path: Path) -> Any:
    found: dict[str, Any] = {}
    for group, data in xr.open_groups(path, engine="h5netcdf", decode_cf=False).items():
        with data:
            found[group] = {
                "attributes": sorted(map(str, data.attrs)),
                "variables": {
                    str(name): {
                        "dims": [str(dim) for dim in variable.dims],
                        "dtype": "text" if variable.dtype.kind in "OSU" else str(variable.dtype),
                        "attributes": {
                            key: str(variable.attrs[key]) for key in ("units", "long_name") if key in variable.attrs
                        },
                    }
                    for name, variable in sorted(data.variables.items())
                },
            }
    return {"groups": found}


def _read_tiff(path: Path) -> Any:
    with tifffile.TiffFile(path) as file:
        page = file.pages[0]
        return {"dtype": str(page.dtype), "tags": sorted(tag.name for tag in page.tags.values())}


_READERS = {".json": _read_json, ".csv": _read_csv, ".nc": _read_nc, ".tiff": _read_tiff}


def write_fields(job: str, fields: dict[str, Any]) -> None:
    """Keep what stands in the files of a job's run folder, if it has left any."""
    if not fields:
        return
    FOLDER.mkdir(exist_ok=True)
    lines = [f"{json.dumps(name)}: {json.dumps(told, ensure_ascii=False)}" for name, told in fields.items()]
    fields_file(job).write_text("{\n" + ",\n".join(lines) + "\n}\n", "utf-8")


def kept_fields(job: str) -> dict[str, Any]:
    """What was kept of a job, empty for one without files."""
    path = fields_file(job)
    return dict(json.loads(path.read_text("utf-8"))) if path.exists() else {}
