"""What papers print and the rows that compare it, read from YAML: as printed, and with an error that says where."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import parse_yaml
from tests.twin.study_bench import REFUSED
from twin.validation.check import Supposed, sentence
from twin.validation.group import Printed, load_printed
from twin.validation.registry import GROUPS
from twin.validation.row_names import FILE

FOLDERS = sorted((Path(__file__).parents[2] / "twin/validation").glob("paper_*"))

SMALL = Printed(
    parse_yaml(
        "table1:\n  size_um: 2.30\n  points: 55\n  rows: [1, 2.5]\n  bands: {P: 0.2, B: 1}\n"
        "  columns: {X: [0.04], Y: []}\n",
        "paper.yaml",
    )
)


def test_readers() -> None:
    assert SMALL.number("table1.size_um") == 2.3
    assert isinstance(SMALL.number("table1.points"), float)
    assert SMALL.whole("table1.points") == 55
    assert SMALL.column("table1.rows") == (1.0, 2.5)
    assert dict(SMALL.numbers("table1.bands")) == {"P": 0.2, "B": 1.0}
    assert list(SMALL.numbers("table1.bands")) == ["P", "B"]
    assert dict(SMALL.columns("table1.columns")) == {"X": (0.04,), "Y": ()}


@pytest.mark.parametrize(("reader", "key", "words"), REFUSED["printed_values"])
def test_errors_say_where(reader: str, key: str, words: str) -> None:
    with pytest.raises(InputError) as error:
        getattr(SMALL, reader)(key)
    assert re.search(words, str(error.value)), str(error.value)


def test_a_paper_without_a_file() -> None:
    with pytest.raises(InputError, match="paper_002"):
        load_printed("002")


def test_the_papers_files() -> None:
    """Their numbers are those of the checks; Table 2 of paper 004 has its 55 points, twice."""
    assert {path.name[-3:] for path in FOLDERS if (path / FILE).exists()} == {"000", "001", "003", "004", "017"}
    printed = {check.id: check.printed for group in GROUPS for check in group.checks}
    assert printed["001.table4.together"] == load_printed("001").number("table4.spot_arcsec") == 0.145
    assert printed["004.table1.B3"] == load_printed("004").numbers("table1.mtf_nyquist")["B3"] == 0.37
    assert printed["000.table1.beta_own"] == load_printed("000").numbers("table1.difference_arcsec")["beta"] == 1.53
    points = load_printed("004").whole("distortion.points")
    assert {len(load_printed("004").column(f"table2.{name}_um")) for name in ("raw", "compensated")} == {points} == {55}
    for rows in ("mirror_1_arcsec", "mirror_2_arcsec"):
        columns = load_printed("001").columns(f"table2.{rows}")
        assert list(columns) == ["X", "Y", "Z"]
        assert {len(column) for column in columns.values()} == {11}


ROWS = Path(__file__).with_name("rows.yaml").read_text("utf-8")


def test_rows() -> None:
    """The keys of a row are those of `Check`; the number is where the key says; what follows is left out."""
    group = Printed(parse_yaml(ROWS, "paper.yaml")).group("001.sizes", lambda context: ())
    size, figure = group.checks
    assert (group.title, group.seconds, group.fast_seconds, group.ids) == (
        "Sizes", 2.0, None, ("001.table1.size", "001.fig1"),
    )  # fmt: skip
    assert (size.printed, size.tolerance, size.comparison, size.expected) == (2.3, 0.1, "at most", "reproduced")
    assert (figure.printed, figure.unit, figure.expected) == (None, "1", "not checkable")
    facts = {"what": "twice", "tool": "a rule", "errors": np.array([2e-9, -3e-9])}
    found = size.evaluate(4.6, explained=[4.6], inputs=[Supposed("on Earth", "")], facts=facts)
    assert found.how.splitlines()[0] == "Measured with a rule: 4.6 ± 3 nm."
    assert "It is twice as large." in found.how


def test_texts_list_several_values_and_name_those_of_a_mapping() -> None:
    facts = {"shares": [0.25, 0.5], "turns": {"x": 1e-3, "y": -2e-3}}
    assert (
        sentence("{shares:.0%}; {turns:mm +.1f} mm; {turns:abs max .3f}", facts) == "25%, 50%; x +1.0, y -2.0 mm; 0.002"
    )
    with pytest.raises(KeyError):
        sentence("{shares:furlong .1f}", facts)


@pytest.mark.parametrize(
    ("old", "new", "words"), yaml.safe_load(Path(__file__).with_name("faulty_rows.yaml").read_text("utf-8"))
)
def test_faults_of_rows_are_said_with_file_and_key(old: str, new: str, words: str) -> None:
    assert old in ROWS
    with pytest.raises(InputError) as error:
        Printed(parse_yaml(ROWS.replace(old, new, 1), "paper.yaml")).group("001.sizes", lambda context: ())
    assert re.search(words, str(error.value)), str(error.value)
