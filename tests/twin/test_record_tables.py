"""Readings of telemetry tables in SI units, and the record's tables with each number under its unit."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from scenes.specs.operation import ReadingTableSpec
from twin.operate.record.entries import Refusal
from twin.operate.record.record_tables import TABLES
from twin.operate.record.telemetry import read_table_file

HISTORY: Any = SimpleNamespace(temperature=293.15, bodies={"warm": ["base"], "cameras": ["forward"]})
MONITOR = ("d_alpha_arcsec", "d_beta_arcsec", "d_gamma_arcsec", "d_f_um", "change_arcsec")


def items(folder: Path, text: str, kind: str, **columns: Any) -> list[Any]:
    """Return the entries and refusals of a table of one kind."""
    (folder / "t.csv").write_text(text)
    table = ReadingTableSpec.model_validate({"kind": kind, "files": "t.csv", "columns": columns})
    return list(read_table_file(table, folder / "t.csv", HISTORY).items)


def test_quaternions_are_normalised_or_refused(tmp_path: Path) -> None:
    """A length within 1e-3 of 1 is divided out, any other is refused; the sigma is an angle in radians."""
    rows = [f"0,0,{0.6 * size:.6f},{0.8 * size:.6f}" for size in (1.0009, 0.9991, 1.0, 1.0011, 0.9989)]
    rows += ["0,0,0.6,none", "0,0,inf,1"]
    text = "\n".join(["time,a,b,c,d", *(f"2026-03-05T00:00:0{k}Z,{row}" for k, row in enumerate(rows))])
    column = {"column": ["a", "b", "c", "d"], "unit": "quaternion", "sigma": "2 arcsec"}
    found = items(tmp_path, text, "attitude", tracker=column)
    assert [isinstance(one, Refusal) for one in found] == 3 * [False] + 4 * [True]
    for one in found[:3]:
        assert sum(v * v for v in one.content["values"]) == pytest.approx(1.0, abs=1e-14)
        assert one.content["sigma"] == pytest.approx(2.0 * 4.84813681e-6, rel=1e-8)
    assert found[0].content["values"] == pytest.approx([0.0, 0.0, 0.6, 0.8], abs=1e-12)
    assert [one.line for one in found] == [2, 3, 4, 5, 6, 7, 8]
    for one, reason in ((3, "not a unit quaternion"), (5, "not a number"), (6, "not a finite number")):
        assert reason in found[one].reason


def test_readings_are_kept_in_si_units(tmp_path: Path) -> None:
    """Foci of micrometres and millimetres are metres, temperatures are kelvin; sigmas have their own units."""
    text = "time,f,g,t\n2026-03-05T00:00:00Z,12.5,0.0125,21.5\n"
    for head, unit, sigma in (("f", "um", "4 um"), ("g", "mm", "0.004 mm")):
        (one,) = items(tmp_path, text, "focus", forward={"column": head, "unit": unit, "sigma": sigma})
        assert one.content["values"] == pytest.approx([12.5e-6], rel=1e-12)
        assert one.content["sigma"] == pytest.approx(4e-6, rel=1e-12)
    (one,) = items(tmp_path, text, "temperature", base={"column": "t", "unit": "degC", "sigma": "50 mK"})
    assert one.content["values"] == pytest.approx([294.65], abs=1e-9)
    assert one.content["sigma"] == pytest.approx(0.05, rel=1e-12)
    (one,) = items(
        tmp_path, text.replace("21.5", "294.65"), "temperature", base={"column": "t", "unit": "degC", "sigma": "50 mK"}
    )
    assert isinstance(one, Refusal)
    assert "the column is in K, it seems" in one.reason


def row(values: list[float], sigma: float, unit: str) -> dict[str, Any]:
    """Return an entry of the record as its tables take it."""
    content = {
        "values": values,
        "sigma": sigma,
        "unit": unit,
        "sha256": "c",
        "numbers": {"verdict": "good"},
        "detail": "d",
    }
    content |= {"entry": 5, "included": False, "why": "spike"}
    names = {
        "time_utc": "2026-03-05T00:00:00Z",
        "time_us": 8.25e14,
        "subject": "forward",
        "file": "f",
        "sha256": "s",
        "id": 7,
    }
    numbers = {f"{key}{end}": 0.1 * k for k, key in enumerate(MONITOR) for end in ("", "_sigma", "_sigma_noise")}
    return {**names, "kind": "angle", "content": content, "camera": "forward", "estimator": "model", "numbers": numbers}


def test_tables_have_each_number_in_the_unit_of_its_column() -> None:
    """Times in seconds, foci and their sigmas in micrometres, temperatures in kelvin, angles' sigmas in arcseconds."""
    focus = TABLES["focus"](row([-3e-6], 4e-6, "m"))
    assert focus["time_s"] == pytest.approx(8.25e8)
    assert (focus["defocus_um"], focus["defocus_um_sigma"]) == pytest.approx((-3.0, 4.0), rel=1e-12)
    warm = TABLES["temperature"](row([294.65], 0.05, "K"))
    assert (warm["temperature_K"], warm["temperature_K_sigma"]) == (294.65, 0.05)
    turned = TABLES["attitude"](row([0.1, 0.2, 0.3], 2.0 * 4.84813681109536e-6, "rad"))
    assert [turned[f"component_{k}"] for k in (1, 2, 3, 4)] == [0.1, 0.2, 0.3, None]
    assert turned["angle_arcsec_sigma"] == pytest.approx(2.0, rel=1e-12)
    assert (turned["form"], turned["entry"], turned["subject"]) == ("rad", 7, "forward")
    given = row([], 0.0, "")
    for name, keys in (("monitor", MONITOR[:4]), ("intersection_angle", MONITOR[4:])):
        table = TABLES[name](given)
        for key in keys:
            for end in ("", "_sigma", "_sigma_noise"):
                assert table[f"{key}{end}"] == given["numbers"][f"{key}{end}"], key
    decision = TABLES["decision"](given)
    assert (decision["decided_entry"], decision["included"], decision["why"]) == (5, False, "spike")
    assert TABLES["run"](given)["verdict"] == "good"
    assert TABLES["event"](given)["detail"] == "d"
