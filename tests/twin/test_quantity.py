"""Declared results: keys say units, and files, tables and columns follow one list."""

import json
from dataclasses import dataclass

import numpy as np
import pytest

from twin.framework.record import Quantity, Record, in_unit


@dataclass
class Line:
    places: np.ndarray
    turn: float
    focal_length: float | None = None


POINT: Record[Line] = Record(
    "One point.",
    Quantity("place_um", lambda line: line.places, "along the line", "L", 2),
    Quantity("number", lambda line: np.arange(len(line.places))),
)
LINE: Record[Line] = Record(
    "A line.",
    Quantity("turn_arcsec", lambda line: line.turn, "about Z"),
    Quantity("covariance_mm2", lambda line: np.eye(1) * 4e-6),
    Quantity("focal_length_mm", lambda line: line.focal_length, where_known=True),
    Quantity("width_px", lambda line: 3.0),
    Quantity("points", POINT.rows),
    Quantity(
        "own", lambda line: {"left": line, "right": line}, record=Record("", Quantity("turn_deg", lambda o: o.turn))
    ),
)


def test_files_have_numbers_in_the_units_of_their_keys() -> None:
    line = Line(np.array([1e-6, -2.5e-6]), np.pi / 180)
    data = LINE(line)
    assert data["turn_arcsec"] == pytest.approx(3600.0, rel=1e-15)
    assert in_unit(line.turn, "arcmin") == pytest.approx(60.0, rel=1e-15)
    assert data["covariance_mm2"] == [[pytest.approx(4.0)]]
    assert "focal_length_mm" not in data
    assert LINE(Line(line.places, 0.0, 5.5))["focal_length_mm"] == pytest.approx(5500.0)
    assert data["width_px"] == 3.0
    assert data["points"] == [{"place_um": 1.0, "number": 0}, {"place_um": -2.5, "number": 1}]
    assert data["own"]["right"] == {"turn_deg": 1.0}
    json.dumps(data, allow_nan=False)


def test_tables_and_columns_follow() -> None:
    rows = POINT.rows(Line(np.array([1e-6, -2.5e-6]), 0.0))
    table = POINT.table("points", "Points", "All.", rows, ("number", "place_um"))
    assert list(table.heads) == ["number", "L [µm]"]
    assert table.shown()[1] == [1, "\N{MINUS SIGN}2.50"]
    column = POINT.data_table("points", "Points", rows).column("place_um")
    assert (column.unit, column.description, column.plain) == ("um", "along the line", [1.0, -2.5])


def test_reports_may_have_another_unit() -> None:
    lost: Record[float] = Record("", Quantity("light_lost", lambda share: share, "share", "light", 1, shown="percent"))
    table = lost.table("light", "Light", "", [lost(0.0625)])
    assert lost(0.0625) == {"light_lost": 0.0625}
    assert (list(table.heads), table.rows) == (["light [%]"], [[6.25]])


def test_units() -> None:
    assert in_unit(None, "mm") is None
    assert in_unit({"a": [1.0, 2.0]}, "mm") == {"a": [1e3, 2e3]}
    assert in_unit(1e-9, "nm") == 1.0
    assert in_unit(71e3, "1/mm") == pytest.approx(71.0, rel=1e-15)
    with pytest.raises(ValueError, match="place"):
        Record("", Quantity("place", lambda _: 1), Quantity("place", lambda _: 2))
