"""Tables of a record for other programs, one for each kind of reading."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from scenes.specs.operation import RUNS
from twin.framework.data_files import DataTable
from twin.framework.record import Quantity, Record, in_unit
from twin.operate.record.entries import MICRO
from twin.operate.record.history import History, content_of

Row = Mapping[str, Any]


def _key(key: str, meaning: str) -> Quantity[Row]:
    return Quantity(key, lambda row: row[key], meaning)


def _number(key: str, meaning: str) -> Quantity[Row]:
    return Quantity(key, lambda row: row["numbers"].get(key), meaning, converted=False)


_WHEN = (
    _key("time_utc", "time of the reading, UTC"),
    Quantity[Row]("time_s", lambda row: row["time_us"] / MICRO, "SI seconds since 2000-01-01T00:00:00 TAI"),
)
_FROM = (
    _key("file", "file of the reading"),
    _key("sha256", "SHA-256 that identifies the reading"),
    Quantity[Row]("entry", lambda row: row["id"], "number of the entry, for the command exclude"),
)


def _readings(meaning: str, *quantities: Quantity[Row]) -> Record[Row]:
    """Return the columns of readings: their time, their values, and their file."""
    return Record(meaning, *_WHEN, *quantities, *_FROM)


def _value(k: int) -> Any:
    return lambda row: row["content"]["values"][k] if k < len(row["content"]["values"]) else None


def _sigma(row: Row) -> float:
    return float(row["content"]["sigma"])


TABLES: Mapping[str, Record[Row]] = {
    "temperature": _readings(
        "Temperatures of bodies.",
        _key("subject", "body"),
        Quantity("temperature_K", _value(0), "absolute temperature of the body"),
        Quantity("temperature_K_sigma", _sigma, "standard deviation of the sensor's error"),
    ),
    "focus": _readings(
        "Focus measurements in orbit.",
        _key("subject", "camera"),
        Quantity("defocus_um", _value(0), "defocus of the detector, positive downstream"),
        Quantity("defocus_um_sigma", lambda row: 1e6 * _sigma(row), "standard deviation", converted=False),
    ),
    "input": _readings(
        "Temperatures that are inputs of a plan's terms.",
        _key("subject", "input"),
        Quantity("temperature_K", _value(0), "temperature"),
        Quantity("temperature_K_sigma", _sigma, "standard deviation of the sensor's error"),
    ),
    "move": _readings(
        "Commanded moves.",
        _key("subject", "motion"),
        Quantity("size", _value(0), "size of the move, in SI units"),
        Quantity("size_sigma", _sigma, "its standard deviation, in SI units"),
        Quantity("unit", lambda row: row["content"]["unit"], "m, rad, or none for a relative change"),
        Quantity("time_s_sigma", lambda row: row["content"]["time_sigma"], "standard deviation of the time"),
    ),
    "attitude": _readings(
        "Attitudes of star trackers.",
        _key("subject", "star tracker"),
        Quantity("form", lambda row: row["content"]["unit"], "quaternion, or rad for three angles"),
        *(
            Quantity(f"component_{k + 1}", _value(k), "component of the quaternion (scalar last), or angle")
            for k in range(4)
        ),
        Quantity(
            "angle_arcsec_sigma",
            lambda row: in_unit(_sigma(row), "arcsec"),
            "standard deviation about each axis",
            converted=False,
        ),
    ),
    "event": _readings(
        "Events of the instrument.",
        _key("subject", "event"),
        Quantity("detail", lambda row: row["content"].get("detail"), "remark of the table"),
    ),
    "decision": _readings(
        "Decisions to exclude entries from the estimate, or to include them.",
        Quantity("decided_entry", lambda row: row["content"]["entry"], "number of the entry"),
        Quantity("included", lambda row: row["content"]["included"], "whether it counts from then on"),
        Quantity("why", lambda row: row["content"]["why"], "the reason"),
    ),
    "run": _readings(
        "Calibrations and angles measured in orbit.",
        _key("kind", "calibration or angle"),
        Quantity("results_sha256", lambda row: row["content"]["sha256"], "SHA-256 of the file of results"),
        Quantity("verdict", lambda row: row["content"]["numbers"].get("verdict"), "verdict of the run"),
    ),
    "monitor": _readings(
        "Changes of the cameras measured by the monitor, by camera and estimator, with their sigmas.",
        _key("camera", "camera of the instrument"),
        _key("estimator", "estimator of the change"),
        *(
            _number(f"{name}{end}", description)
            for name in ("d_alpha_arcsec", "d_beta_arcsec", "d_gamma_arcsec", "d_f_um")
            for end, description in (
                ("", "change"),
                ("_sigma", "its total sigma"),
                ("_sigma_noise", "its sigma from image noise"),
            )
        ),
    ),
    "intersection_angle": _readings(
        "Changes of the angle between the cameras measured by the monitor.",
        _key("estimator", "estimator of the change"),
        *(
            _number(key, "change of the angle, or its sigma")
            for key in ("change_arcsec", "change_arcsec_sigma", "change_arcsec_sigma_noise")
        ),
    ),
    "refused": Record(
        "Refused rows and readings.",
        _key("refused_utc", "time of the refusal, UTC"),
        _key("file", "file that contains it"),
        _key("line", "line of the file"),
        _key("reason", "reason of the refusal"),
        _key("taken_since", "whether the reading has been ingested since"),
    ),
}
"""Columns of each output table, by name of the table."""


def tables(history: History) -> list[DataTable]:
    """Return all tables of a record that have rows, one for each kind of reading."""
    rows: dict[str, list[Row]] = {name: [] for name in TABLES}
    for entry in history.entries():
        row = {**entry, "content": content_of(entry)}
        for name, cells in _rows(row):
            rows[name].append(cells)
    rows["refused"] = list(history.refusals())
    made = {name: [record(row) for row in rows[name]] for name, record in TABLES.items()}
    return [TABLES[name].data_table(name, TABLES[name].meaning, of) for name, of in made.items() if of]


def _rows(row: Row) -> Iterator[tuple[str, Row]]:
    """Yield the rows of the output tables for one entry, each with the name of its table."""
    kind = row["kind"]
    if kind != "monitor":
        yield ("run" if kind in RUNS else kind), row
        return
    numbers = row["content"]["numbers"]
    for camera, by_estimator in numbers["cameras"].items():
        for estimator, estimate in by_estimator.items():
            yield "monitor", {**row, "camera": camera, "estimator": estimator, "numbers": estimate}
    for estimator, estimate in (numbers.get("intersection_angle") or {}).items():
        yield "intersection_angle", {**row, "estimator": estimator, "numbers": estimate}
