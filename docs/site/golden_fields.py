"""What stands in the files of a run folder, without the values: keys of JSON, columns of CSV, variables of netCDF, tags
of TIFF, read off the golden files. The reference of the run folders is made from it (docs/site).
"""

from __future__ import annotations

import json
from typing import Any

from tests.golden.digest import sorts
from tests.golden.golden import golden_file

PRINTED = ("exit", "stdout", "stderr", "exact")
"""Keys of a golden run that are no files."""


def fields(name: str, tree: dict[str, Any]) -> dict[str, Any]:
    """Return what stands in a file, from its condensed tree.

    ``fields`` of JSON: path of a value -> its sort. ``columns`` of CSV. ``groups`` of netCDF, with ``variables``: name
    -> dimensions, sort of number and attributes. ``dtype`` and ``tags`` of TIFF.
    """
    if name.endswith(".json") and "definitions" not in tree:
        return {"fields": sorts(tree)}
    if name.endswith(".csv"):
        return {"columns": tree["head"]}
    if name.endswith(".nc"):
        return {"groups": {group: _group(data) for group, data in tree.items()}}
    if name.endswith(".tiff"):
        return {"dtype": tree["pixels"]["kind"], "tags": sorted(tree["tags"])}
    return {}


def _group(data: dict[str, Any]) -> dict[str, Any]:
    return {
        "attributes": sorted(data["attrs"]),
        "variables": {
            name: {
                "dims": one["dims"],
                "dtype": one["values"].get("kind", "text"),
                "attributes": {key: str(one["attrs"][key]) for key in ("units", "long_name") if key in one["attrs"]},
            }
            for name, one in data["variables"].items()
        },
    }


def kept_fields(job: str) -> dict[str, Any]:
    """Return file -> what stands in it, of a golden run; empty for one without files."""
    run = json.loads(golden_file(job).read_text("utf-8"))["run"]
    return {name: fields(name, tree) for name, tree in run.items() if name not in PRINTED}
