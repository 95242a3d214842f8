"""Result of a study as a data set with one dimension, ``run``, and the files of the study's folder."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from optics.numerics.extension_table import ExtensionTable
from scenes.specs.study import NOISE
from twin.framework import data_files, record
from twin.framework.run_folder import RunFolder
from twin.study.report.study_statistics import Estimate, describe
from twin.study.runs.base_job import BlockResult, one_line
from twin.study.runs.plan import Plan

RUN = "run"
FAILED, MESSAGE, SEED = "failed", "message", "seed"
DOUBT, MONITOR = "doubt", "render"
"""Name of the variable with the reason why a run's sigma is not valid, and the base command whose runs have it."""
ROLE = "role"
"""Name of the attribute of every variable of the data set that says: factor, response, sigma or bookkeeping."""


def make_dataset(plan: Plan, result: BlockResult) -> xr.Dataset:
    """Return factors, responses, their sigmas and the failed runs as an xarray data set with the dimension ``run``.

    The data set depends neither on the computing time nor on the workers. Every variable has the attributes ``units``
    (empty for pure numbers and texts), ``role`` and, for factors and responses, ``key``, its key path in the base job
    or in the results.

    Parameters
    ----------
    plan : Plan
        Plan of the study.
    result : BlockResult
        Results of all runs.
    """
    study = plan.setup.study
    data: dict[str, Any] = {}
    for column in plan.columns:
        factor = study.factors[column.name]
        scaled = [f"{_path(scale.key)} ~ power {scale.power:g}" for scale in factor.scales]
        key = "; ".join([" = ".join(_path(path) for path in factor.key_paths)] * bool(factor.key_paths) + scaled)
        values = column.values.astype(object) if column.values.dtype.kind == "U" else column.values
        values = values.astype(np.int8) if values.dtype.kind == "b" else values
        long_name = f"factor {column.name}, {key}"
        data[column.name] = (RUN, values, {"units": column.unit, ROLE: "factor", "key": key, "long_name": long_name})
    for r, (name, response) in enumerate(study.responses.items()):
        minus = f" - {_path(response.minus)}" if response.minus is not None else ""
        key = f"{_path(response.key)}{minus}"
        about = {"units": response.units, ROLE: "response", "key": key, "long_name": f"response {name}, {key}"}
        data[name] = (RUN, result.values[:, r], about)
        for ending, path in response.sigma_keys.items():
            about = {"units": response.units, ROLE: "sigma", "key": _path(path), "of": name}
            by = ", by noise alone" if ending == NOISE else ""
            about["long_name"] = f"standard deviation of {name}{by}"
            data[f"{name}{ending}"] = (RUN, (result.noises if by else result.sigmas)[:, r], about)
    flags: dict[str, Any] = {"flag_values": np.array([0, 1], np.int8), "flag_meanings": "completed failed"}
    common = {"units": "", ROLE: "bookkeeping"}
    data[FAILED] = (RUN, result.failed.astype(np.int8), {**common, "long_name": "1: failed", **flags})
    data[MESSAGE] = (RUN, np.array(result.messages, object), {**common, "long_name": "why it failed"})
    if study.base.command == MONITOR:
        why = "why sigma does not hold, empty where it does"
        data[DOUBT] = (RUN, np.array(result.doubts, object), {**common, "long_name": why})
    if plan.seeds is not None:
        data[SEED] = (RUN, plan.seeds, {"units": "", ROLE: "bookkeeping", "long_name": "seed of the run's noise"})
    attributes = {
        "title": study.name,
        "study": plan.config,
        "fingerprint": plan.setup.fingerprint,
        "design": study.design.kind,
        "seed": study.design.seed,
        "reference_frames": record.frames_text("study"),
    }
    numbered = (RUN, np.arange(plan.runs), {"units": "", "long_name": "number of the run"})
    return xr.Dataset(data, coords={RUN: numbered}, attrs=attributes)


def _path(key: tuple[str | int, ...]) -> str:
    return " ".join(str(part) for part in key)


def _as_table(ending: str, data: xr.Dataset) -> bytes | None:
    """Return the data set as a table file with a row for each run; None if a required package is missing.

    ``ending`` is the file's suffix, which determines its format.
    """
    columns = []
    for name in (RUN, *map(str, data.data_vars)):
        about = data[name].attrs
        columns.append(data_files.DataColumn(name, data[name].values, about.get("units", ""), about["long_name"]))
    facts = {"reference_frames": str(data.attrs["reference_frames"])}
    try:
        return data_files.TABLE_FORMATS[ending](
            data_files.DataTable("study", str(data.attrs["title"]), tuple(columns), facts)
        )
    except data_files.MissingPackage:
        return None


_FORMATS: dict[str, Callable[[xr.Dataset], bytes | None]] = {
    "nc": data_files.netcdf,
    **{ending: partial(_as_table, ending) for ending in ("csv", "parquet")},
}
FORMATS = ExtensionTable("study_formats", _FORMATS)
"""Suffix of a data file of a study -> function that makes its contents, or None if a package is missing.

A new format is added here.
"""


def summary(data: xr.Dataset, plan: Plan) -> dict[str, Any]:
    """Return the contents of study.json without the times: statistics of each response over the successful runs.

    They are mean, standard deviation and quantiles; null where there are no values.

    Parameters
    ----------
    data : Dataset
        Data set of ``make_dataset``.
    plan : Plan
        Plan of the study.
    """
    study = plan.setup.study
    failed = data[FAILED].values.astype(bool)
    return {
        "name": study.name,
        "runs": plan.runs,
        "failed": int(failed.sum()),
        **({"doubted": (doubted := sum(map(bool, data[DOUBT].values.tolist())))} if DOUBT in data else {}),
        **({"sigma_holds": not doubted} if DOUBT in data else {}),
        "seed": study.design.seed,
        "design": study.design.kind,
        "factors": {
            column.name: {
                "unit": column.unit,
                "keys": [list(key) for key in study.factors[column.name].key_paths],
                "scaled_keys": [list(scale.key) for scale in study.factors[column.name].scales],
                **_span(column.values),
            }
            for column in plan.columns
        },
        "responses": {
            name: {**_statistics(data[name].values), "unit": response.units}
            for name, response in study.responses.items()
        },
    }


def _span(values: np.ndarray) -> dict[str, Any]:
    if values.dtype.kind in "UO":
        return {"values": sorted(set(values.tolist()))}
    return {"min": values.min().item(), "max": values.max().item()}


def _statistics(values: np.ndarray) -> dict[str, Any]:
    """Return count, mean, standard deviation (n - 1) and the 95 % and 99.7 % quantiles of the n finite values."""
    description = describe(values, False)
    return {
        "count": description.count,
        **{key: _value(getattr(description, key)) for key in ("mean", "std", "p95", "p997")},
    }


def _value(estimate: Estimate | None) -> float | None:
    return None if estimate is None else estimate.value


@dataclass(frozen=True, eq=False)
class Numbers:
    """Results of a study as they are written to its folder.

    Attributes
    ----------
    data : Dataset
        Data set of ``make_dataset``.
    summary : dict
        Contents of study.json.
    files : tuple of str
        Names of the files that hold the data.
    unwritten : tuple of str
        One sentence for each format that could not be written; the other files hold the same data.
    """

    data: xr.Dataset
    summary: dict[str, Any]
    files: tuple[str, ...]
    unwritten: tuple[str, ...] = ()


def write_data(plan: Plan, result: BlockResult, seconds: float, computed: int, folder: RunFolder) -> Numbers:
    """Write the data set in all formats of ``FORMATS``, and study.json.

    Parameters
    ----------
    plan : Plan
        Plan of the study.
    result : BlockResult
        Results of all runs.
    seconds : float
        Time that this command took for the runs it computed.
    computed : int
        Number of runs that this command computed.
    folder : RunFolder
        Folder of the study.
    """
    data = make_dataset(plan, result)
    numbers = record.described(
        "study",
        {
            **summary(data, plan),
            "seconds": seconds,
            "runs_computed": computed,
            "states_per_second": computed / seconds if computed else None,
            "worker_seconds": result.seconds,
        },
    )
    folder.write_text("config.yaml", plan.config)
    files, unwritten = [], []
    for ending, contents in FORMATS.items():
        try:
            content = contents(data)
        except Exception as error:  # a format that does not take these numbers must not cost the others
            unwritten.append(f"study.{ending} could not be made: {one_line(error)}")
            continue
        if content is not None:
            files.append(f"study.{ending}")
            folder.write_bytes(files[-1], content)
    folder.write_json("study.json", numbers)
    return Numbers(data, numbers, tuple(files), tuple(unwritten))
