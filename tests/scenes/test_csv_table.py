"""Tables of measured numbers: any order of columns, any unit, and errors with line and column."""

import time
from pathlib import Path

import numpy as np
import pytest

from scenes.yaml import csv_table
from scenes.yaml.csv_table import Column, Table, read_table
from scenes.yaml.errors import InputError
from scenes.yaml.units import ANGLE, LENGTH

COLUMNS = (
    Column("point", text=True),
    Column("x", LENGTH),
    Column("turn", ANGLE, needed=False),
    Column("count", needed=False, least=0.0, most=9.0, whole=True),
)


def _read(folder: Path, text: str | bytes, least_rows: int = 1) -> Table:
    path = folder / "table.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_table(path, COLUMNS, least_rows)


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_units_order_comments_and_delimiters_do_not_matter(tmp_path: Path, delimiter: str) -> None:
    one = _read(tmp_path, "point,x [mm],turn [arcsec],count\na,1.5,2,3\nb,-2,0,9\n")
    text = "# measured\n\n count, turn [deg] ,x [um],point\r\n3,0.000555555555555555555,1500,a\r\n\r\n9,0,-2000,b"
    two = _read(tmp_path, "\ufeff" + text.replace(",", delimiter))
    assert list(one["point"]) == list(two["point"]) == ["a", "b"]
    for name in ("x", "turn", "count"):
        np.testing.assert_allclose(one[name], two[name], rtol=1e-15)
    np.testing.assert_allclose(one.stacked("x", "count"), [[1.5e-3, 3.0], [-2e-3, 9.0]], rtol=1e-15)
    assert list(one.lines) == [2, 3]
    assert list(two.lines) == [4, 6]
    assert "turn" in one
    assert "turn" not in _read(tmp_path, "point,x [m]\na,1\n")


def test_rows_in_pieces_are_the_same_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory is bounded by making numbers of some rows after the other; lines count through."""
    rows = "".join(f"p{k},{k}.5\n" + "\n# more\n" * (k % 3 == 0) for k in range(10))
    whole = _read(tmp_path, f"point,x [mm]\n{rows}")
    for together in (1, 3, 11):
        monkeypatch.setattr(csv_table, "_TOGETHER", together)
        one = _read(tmp_path, f"point,x [mm]\n{rows}")
        assert list(one["point"]) == list(whole["point"])
        np.testing.assert_array_equal(one["x"], whole["x"])
        np.testing.assert_array_equal(one.lines, whole.lines)
    monkeypatch.setattr(csv_table, "_TOGETHER", 3)
    with pytest.raises(InputError, match=r"table\.csv:20: x \[mm\]: not a number"):
        _read(tmp_path, f"point,x [mm]\n{rows}q,much\n")


def test_missing_file_names_the_one_that_was_meant(tmp_path: Path) -> None:
    (tmp_path / "angles.csv").write_text("x")
    with pytest.raises(InputError, match=r"angles\.csv"):
        read_table(tmp_path / "angels.csv", COLUMNS)
    with pytest.raises(InputError, match="regular"):
        read_table(tmp_path, COLUMNS)


@pytest.mark.second
def test_a_long_table_takes_seconds(tmp_path: Path) -> None:
    path = tmp_path / "long.csv"
    path.write_text("point,x [mm],count\n" + "p1,12.25,4\n" * 200_000)
    start = time.process_time()
    table = read_table(path, COLUMNS)
    assert time.process_time() - start < 5.0  # 0.4 s on a quiet core
    assert len(table) == 200_000
    assert table["x"][-1] == 12.25e-3
