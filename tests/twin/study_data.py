"""Data sets of studies whose runs are known functions, drawn as the engine draws them."""

from typing import Any

import numpy as np
import xarray as xr

from scenes.specs.study import StudySpec
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from twin.study.runs.plan import draw


def study_of(factors: str, design: str, responses: str = "{y: {key: [a, b_um]}}", report: str = "{}") -> StudySpec:
    """A study, by the texts of its parts."""
    text = (
        f"name: trade\ndescription: A known function\nbase: {{command: render, file: job.yaml}}\n"
        f"factors: {factors}\ndesign: {design}\nresponses: {responses}\nreport: {report}\n"
    )
    return validate(StudySpec, parse_yaml(text))


def columns(study: StudySpec) -> dict[str, np.ndarray]:
    """Values of every factor, texts as text."""
    out = {}
    for name, drawn in draw(study).items():
        factor = study.factors[name]
        if factor.kind in ("values", "table"):
            numbers = factor.numbers()
            listed = np.array(numbers.values if numbers.numeric else factor.scalars())
            drawn = listed[drawn]
        out[name] = drawn
    return out


def dataset(study: StudySpec, values: dict[str, Any], failed: np.ndarray | None = None) -> xr.Dataset:
    """The data set of a study with these responses and sigmas (NAME_sigma)."""
    data: dict[str, Any] = {}
    for name, column in columns(study).items():
        unit = study.factors[name].unit or ""
        data[name] = ("run", column.astype(object) if column.dtype.kind == "U" else column, {"units": unit})
    runs = len(next(iter(values.values())))
    failed = np.zeros(runs, bool) if failed is None else failed
    for name, column in values.items():
        unit = study.responses[name.removesuffix("_noise").removesuffix("_sigma")].units
        data[name] = ("run", np.where(failed, np.nan, column), {"units": unit})
    data["failed"] = ("run", failed.astype(np.int8))
    data["message"] = ("run", np.where(failed, "no ray arrives", "").astype(object))
    return xr.Dataset(data)
