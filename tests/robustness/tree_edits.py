"""Edits of the library's cameras and instruments as plain data: which numbers there are, and how one is changed."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from scenes.specs.load import CAMERAS, INSTRUMENTS, LIBRARY
from scenes.yaml.yaml_file import dump_yaml, parse_yaml

Key = tuple[str | int, ...]

OF_CAMERA = re.compile(r"(mirrors|image|field|entrance_pupil|field_bias|focal_length)\b")
OF_INSTRUMENT = re.compile(
    r"cameras/\w+/(look|position|pupil_offset)\b|central_prism/|monitor/(field|prism_|return_face|area_ccd/offset)"
)
QUANTITY = re.compile(r"([-+]?[\d.]+(?:e[-+]?\d+)?)( .*)?")


def trees(name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Camera and instrument of the library as plain data; the camera's name is ./camera.yaml."""
    instrument = parse_yaml((LIBRARY / INSTRUMENTS / f"{name}.yaml").read_text("utf-8")).data
    (stem,) = {site["camera"] for site in instrument["cameras"].values()}
    for site in instrument["cameras"].values():
        site["camera"] = "./camera.yaml"
    return parse_yaml((LIBRARY / CAMERAS / f"{stem}.yaml").read_text("utf-8")).data, instrument


def _numbers(data: Any, key: Key = ()) -> Iterator[Key]:
    for name, value in data.items() if isinstance(data, dict) else enumerate(data):
        if isinstance(value, dict | list):
            yield from _numbers(value, (*key, name))
        elif isinstance(value, int | float) or QUANTITY.fullmatch(value):
            yield (*key, name)


def editable(camera: dict[str, Any], instrument: dict[str, Any]) -> list[tuple[str, Key]]:
    """The numbers of both files that are edited, as file and key."""
    wanted = (("camera", camera, OF_CAMERA), ("instrument", instrument, OF_INSTRUMENT))
    return [(file, key) for file, tree, kind in wanted for key in _numbers(tree) if kind.match("/".join(map(str, key)))]


def holder(data: Any, key: Key) -> Any:
    """Where the value of a key stands."""
    for part in key[:-1]:
        data = data[part]
    return data


def scaled(data: Any, key: Key, change: float) -> None:
    """Change a number, with its unit if it has one, by a part of itself; a zero by one of the largest beside it
    or of 1.
    """
    place = holder(data, key)

    def read(value: Any) -> tuple[float, str | None]:
        if not isinstance(value, str):
            return float(value), None
        match = QUANTITY.fullmatch(value)
        assert match is not None
        return float(match[1]), match[2] or ""

    value, unit = read(place[key[-1]])
    beside = [abs(read(other)[0]) for other in place] if isinstance(place, list) else [1.0]
    new = value + change * (value or max(beside))
    place[key[-1]] = new if unit is None else f"{new!r}{unit}"


def job_of(folder: Path, camera: dict[str, Any], instrument: dict[str, Any]) -> Path:
    """Write the files of a job."""
    (folder / "camera.yaml").write_text(dump_yaml(camera), "utf-8")
    (folder / "instrument.yaml").write_text(dump_yaml(instrument), "utf-8")
    job = folder / "job.yaml"
    job.write_text("instrument: ./instrument.yaml\n", "utf-8")
    return job
