"""Readings that run folders hold: what a monitor's frames gave, calibrations and angles found in orbit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scenes.specs.operation import RUNS
from scenes.yaml.errors import InputError, Problem, names_text
from scenes.yaml.input_file import digest_of, is_file, parse_json, read_json
from scenes.yaml.yaml_file import read_yaml
from twin.operate.record.entries import (
    MICRO,
    Entry,
    Given,
    Refused,
    canonical,
    digest_of_data,
    instrument_digest,
    one_line,
)
from twin.operate.record.history import History
from twin.run.run_folder import Manifest, read_manifest

RESULTS = {"monitor": "recovered.json", "calibration": "calibration.json", "angle": "angle.json"}
"""Sort of reading -> file of the run folder that holds it."""
_OF_A_STATE = (
    "cameras",
    "intersection_angle",
    "spots",
    "disturbances",
    "retraced",
    "sigma_holds",
    "centroid",
    "frames",
)
"""Keys of a monitor's result that tell of one state."""
_IMAGES = (".tiff", ".tif", ".fits", ".fit", ".fts", ".png")
CONFIG = "config.yaml"
LARGEST = 4_000_000
"""Characters of what is kept of one reading."""


def kind_of_run(folder: Path) -> str:
    """Sort of reading that a run folder holds; empty for none."""
    return next((kind for kind in RUNS if is_file(folder / RESULTS[kind])), "")


def run_entries(place: Path, kind: str, moment: int, history: History, stated: bool) -> Given:
    """The readings of a run folder; what is wrong with it stands in their place.

    Args:
        place: the folder, or the file of results in it.
        kind: of reading; empty for the one that it holds.
        moment: of it, or of the beginning of a series, microseconds of TAI since 2000.
        history: the record.
        stated: whether somebody says that the run is of the record's instrument, of a run that does not say it itself.
    """
    folder = place.parent if place.name in RESULTS.values() else place
    kind = kind or kind_of_run(folder)
    file = folder / RESULTS.get(kind, RESULTS["monitor"])
    manifest = read_manifest(folder)
    digest, frames = "", {}
    items: list[Entry | Refused]
    try:
        if not kind or manifest is None or not is_file(file):
            allowed = f"a finished run folder with {names_text(RESULTS.values())}"
            raise Problem(f"no reading in {folder}", None, allowed)
        digest, frames = digest_of(file), _frames(manifest)
        _is_as_written(folder, file, digest, manifest)
        _is_of(folder, history, stated and kind != "monitor")
        items = list(_found(kind, read_json(file), moment, digest, frames))
    except (Problem, InputError) as error:
        items = [Refused(one_line(error))]
    return Given(str(file), digest or digest_of_data(str(file)), digest_of_data([kind, moment, stated]), items, frames)


def _frames(manifest: Manifest) -> dict[str, str]:
    """Images from which a run found what it found, with their SHA-256: those that it read, else those that it wrote."""
    read = {name: digest for name, digest in manifest.inputs.items() if name.lower().endswith(_IMAGES)}
    own = {name: digest for name, digest in manifest.sha256.items() if name.startswith("images/")}
    return read or {name: digest for name, digest in own.items() if name.endswith((".tiff", ".fits"))}


def _is_as_written(folder: Path, file: Path, digest: str, manifest: Manifest) -> None:
    """Refuse results that are not those that the run wrote. Raises Problem."""
    known = {file.name: digest}
    known |= {CONFIG: digest_of(folder / CONFIG)} if is_file(folder / CONFIG) else {}
    changed = [name for name, own in known.items() if manifest.sha256.get(name) != own]
    if changed:
        problem = f"{folder}: changed since its run: {names_text(changed)}"
        raise Problem(problem, None, "the folder as the run left it; python -m twin.verify tells more")


def _is_of(folder: Path, history: History, stated: bool) -> None:
    """Refuse a run of another instrument, or one that does not say of which. Raises Problem, InputError."""
    data = read_yaml(folder / CONFIG).data if is_file(folder / CONFIG) else None
    model = data.get("model", data) if isinstance(data, Mapping) else None
    instrument = model.get("instrument") if isinstance(model, Mapping) else None
    cameras = model.get("cameras") if isinstance(model, Mapping) else None
    if not isinstance(instrument, Mapping) or not isinstance(cameras, Mapping):
        if stated:
            return
        problem = f"{folder} does not say of which instrument it is"
        raise Problem(
            problem, None, "a run whose config.yaml holds the instrument, or --instrument NAME, which says it"
        )
    found = instrument_digest(instrument, {k: v for k, v in cameras.items() if isinstance(v, Mapping)})
    if found != history.sha256:
        name = instrument.get("name", "without a name")
        problem = f"{folder} is of another instrument, {name} ({found[:12]})"
        raise Problem(problem, None, f"runs of {history.name} ({history.sha256[:12]})")


def _found(kind: str, data: Any, moment: int, digest: str, frames: Mapping[str, str]) -> list[Entry]:
    """One reading, or those of a series at its times. Raises Problem."""
    if not isinstance(data, Mapping):
        raise Problem("no results", None, RESULTS[kind])
    origin = digest_of_data(sorted(frames.values())) if frames else digest
    if kind != "monitor":
        content = {key: value for key, value in data.items() if key != "reference_frames"}
        return [_entry(kind, moment, {"sha256": digest, "numbers": content}, origin)]
    states, times = data.get("series") or [data], data.get("times_s") or [0.0]
    if not isinstance(states, list) or not isinstance(times, list) or len(states) != len(times):
        raise Problem("times and states that do not belong together", None, RESULTS[kind])
    out = []
    for k, (state, time) in enumerate(zip(states, times, strict=True)):
        if not isinstance(state, Mapping) or "cameras" not in state or not isinstance(time, int | float):
            raise Problem("a state without cameras or without a time", None, RESULTS[kind])
        numbers = {key: state[key] for key in _OF_A_STATE if key in state}
        content = {"sha256": digest, "state": k, "numbers": numbers}
        out.append(_entry(kind, moment + round(time * MICRO), content, digest_of_data([origin, k])))
    return out


def _entry(kind: str, moment: int, content: Mapping[str, Any], origin: str) -> Entry:
    """A reading of a size and with numbers that a record can hold. Raises Problem."""
    try:
        text = canonical(content)
    except ValueError:
        raise Problem("a number that is not finite", None, "finite numbers") from None
    if len(text) > LARGEST:
        raise Problem("too large", f"{len(text)} characters", f"at most {LARGEST}")
    return Entry(kind, kind, moment, parse_json(text, "results"), None, origin)
