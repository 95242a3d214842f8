"""Exported measurements of a small simulated campaign, and ways to write them differently."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.setup import CalibrationSetup, MeasuredCalibrationSetup
from scenes.specs.procedures import PROCEDURES
from scenes.yaml.yaml_file import dump_yaml, read_yaml
from twin.orbit.calibration.calibration_run import files_of, source_of
from twin.orbit.calibration.campaign import Campaign

REFUSALS: dict[str, Any] = read_yaml(Path(__file__).with_name("orbit_refusals.yaml")).data
"""Files and jobs that are refused, and results that warn: a thousand lines, which every test of them reads here."""
WHOLE = CalibrationSetup.read(SCENES / ORBIT / "calibrate.yaml")
FIELDS = ("Beijing", "Anhui")
Table = tuple[list[str], list[list[str]]]


def small(**changes) -> CalibrationSetup:
    """The example over two of its fields, with fewer points."""
    test = WHOLE.test
    update = {
        "fields": type(test.fields)({name: test.fields[name] for name in FIELDS}),
        "schemes": ((FIELDS[0],), FIELDS),
        "points": test.points.model_copy(update={"control": 24, "check": 20}),
        **changes,
    }
    return WHOLE.model_copy(update={"test": test.model_copy(update=update)})


def flown(setup: CalibrationSetup, seed: int = 1) -> Campaign:
    """The campaign of a simulation."""
    return source_of(setup, np.random.SeedSequence(seed))


def export(folder: Path, setup: CalibrationSetup, campaign: Campaign) -> Path:
    """Write the campaign's files; the path of the test file."""
    for name, text in files_of(setup, campaign).items():
        place = folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text)
    return folder / "calibrate.yaml"


def read_back(file: Path) -> tuple[MeasuredCalibrationSetup, Campaign]:
    """The campaign of the files that a test names."""
    setup = PROCEDURES["orbit calibrate"].resolve(file)
    assert isinstance(setup, MeasuredCalibrationSetup)
    return setup, source_of(setup, np.random.SeedSequence(0))


def edit(file: Path, change: Callable[[list[str], list[list[str]]], Table]) -> None:
    """Rewrite a table; change: heads and rows -> heads and rows."""
    with file.open(newline="") as stream:
        heads, *rows = list(csv.reader(stream))
    heads, rows = change([head.strip() for head in heads], rows)
    with file.open("w", newline="") as stream:
        csv.writer(stream).writerows([heads, *rows])


def scaled(name: str, head: str, factor: float) -> Callable[[list[str], list[list[str]]], Table]:
    """A column in another unit."""

    def change(heads: list[str], rows: list[list[str]]) -> Table:
        k = heads.index(name)
        return [*heads[:k], head, *heads[k + 1 :]], [
            [*row[:k], repr(float(row[k]) * factor), *row[k + 1 :]] for row in rows
        ]

    return change


def set_keys(file: Path, **changes) -> None:
    """Change keys at the top of a YAML file; None takes one away."""
    data = dict(read_yaml(file).data)
    for key, value in changes.items():
        data.pop(key, None)
        if value is not None:
            data[key] = value
    file.write_text(dump_yaml(data))
