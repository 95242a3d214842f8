"""Files that users name: every reader refuses the same with the same words; YAML, tables of numbers, messages."""

import os
import pickle
import re
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from scenes.lens.batoid_reader import read_batoid
from scenes.lens.codev_reader import read_codev
from scenes.lens.statements import read_catalogue
from scenes.lens.zemax_reader import read_zemax
from scenes.specs.resolved import resolve
from scenes.yaml import csv_table, yaml_file
from scenes.yaml.csv_table import Column, Table, read_table, table_text
from scenes.yaml.errors import InputError, Issue, nearest, shown
from scenes.yaml.finish_files import read_bsdf
from scenes.yaml.input_file import parse_json, read_bytes, read_text
from scenes.yaml.units import ANGLE, LENGTH
from scenes.yaml.yaml_file import YamlFile, dump_yaml, parse_yaml, read_yaml

READERS: dict[str, tuple[str, str, Callable[[Path], object], str]] = {
    "zemax": ("a.zmx", "a prescription", read_zemax, "at most 16 MB"),
    "codev": ("a.seq", "a prescription", read_codev, "at most 16 MB"),
    "batoid": ("a.yaml", "a telescope in YAML", lambda path: read_batoid(path, 500e-9), "at most 100 kB"),
    "glasses": ("a.agf", "a glass catalogue", read_catalogue, "at most 16 MB"),
    "yaml": ("a.yaml", "a YAML file", read_yaml, "at most 1 MB"),
    "bsdf": ("a.bsdf", "a BSDF file", read_bsdf, "at most 67 MB"),
    "csv": ("a.csv", "a CSV file", table_text, "at most 1 GB"),
}
"""Name of a file, what it should be, what reads it, how long it may be."""


def refused(read: Callable[[Path], object], path: Path) -> InputError:
    with pytest.raises(InputError) as caught:
        read(path)
    return caught.value


@pytest.mark.parametrize("kind", READERS)
def test_what_is_no_file(kind: str, tmp_path: Path) -> None:
    name, what, read, _ = READERS[kind]
    (tmp_path / f"x{name}").touch()
    missing = refused(read, tmp_path / name)
    assert "no such file" in str(missing)
    assert missing.suggestion == str(tmp_path / f"x{name}")
    (tmp_path / name).mkdir()
    assert f"is a directory, not a regular file; allowed: {what}" in str(refused(read, tmp_path / name))
    assert f"is a device, not a regular file; allowed: {what}" in str(refused(read, Path("/dev/zero")))
    os.mkfifo(tmp_path / f"p{name}")  # to open it would block
    assert f"is a pipe, not a regular file; allowed: {what}" in str(refused(read, tmp_path / f"p{name}"))
    assert "Not a directory" in str(refused(read, tmp_path / f"x{name}" / name))
    assert "cannot be read" in str(refused(read, tmp_path / "\0"))


NAMED = {
    "instrument": "instrument: {}.yaml",
    "course.table": "instrument: gf7_pair\ncourse: {{table: {}}}",
    "perturb.base/forward/M2.deformation.table": "instrument: gf7_pair\n"
    "perturb: {{base/forward/M2: {{deformation: {{table: {}}}}}}}",
}
"""Key of a job -> a job that names a file there."""


@pytest.mark.parametrize("kind", ["a device", "a pipe", "a directory"])
def test_what_a_file_names_is_no_file(kind: str, tmp_path: Path) -> None:
    """It is said what stands there, at the key, and nothing of it is read."""
    place = tmp_path / "what.yaml"
    make = {"a device": lambda: place.symlink_to("/dev/zero"), "a pipe": lambda: os.mkfifo(place)}
    make.get(kind, place.mkdir)()
    for key, text in NAMED.items():
        job = tmp_path / "job.yaml"
        job.write_text(text.format(place.with_suffix("") if ".yaml" in text else place), "utf-8")
        error = refused(resolve, job)
        assert f"{place} is {kind}, not a regular file" in str(error)
        assert ".".join(map(str, error.key)) == key


@pytest.mark.parametrize("kind", [kind for kind in READERS if kind != "csv"])
def test_what_is_too_large(kind: str, tmp_path: Path) -> None:
    """The file is sparse, and read no farther than it may be long."""
    name, _, read, most = READERS[kind]
    with (tmp_path / name).open("wb") as file:
        file.truncate(1 << 40)
    assert f"{tmp_path / name}: too large; allowed: {most}" in str(refused(read, tmp_path / name))


@pytest.mark.parametrize(("most", "size"), [(999, "999 bytes"), (1000, "1 kB"), (25_000, "25 kB")])
def test_as_much_as_is_allowed_is_read(most: int, size: str, tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_bytes(b"x" * most)
    assert read_bytes(path, "text", most, ()) == b"x" * most
    assert read_text(path, "text", most, ()) == "x" * most
    path.write_bytes(b"x" * (most + 1))
    assert f"at most {size}" in str(refused(lambda place: read_bytes(place, "text", most, ()), path))


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


def test_text_with_tabs_and_minus_signs_is_text() -> None:
    text = "name: '3\tum'\nsaid: \u22123 K and more\nquoted: '\u22123'\n# a\tcomment\n"
    assert parse_yaml(text).data == {"name": "3\tum", "said": "\u22123 K and more", "quoted": "\u22123"}


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_no_permission(tmp_path: Path) -> None:
    path = tmp_path / "input.yaml"
    path.write_text("x: 1")
    path.chmod(0)
    with pytest.raises(InputError, match="Permission denied"):
        read_yaml(path)


def test_not_utf8_gives_the_line(tmp_path: Path) -> None:
    path = tmp_path / "input.yaml"
    path.write_bytes(b"x: 1\ny: \xff\n")
    with pytest.raises(InputError, match=r"input\.yaml:2: not UTF-8 text: byte 0xff"):
        read_yaml(path)


def test_plain_data_with_lines() -> None:
    yaml = parse_yaml("a: 1\nb:\n  - 2 um\n  - {c: .nan, d: -.inf}\n'on': true\nn: ~\ntext: '1'\nno: 1e3\n")
    assert yaml.data["a"] == 1
    assert yaml.data["b"][0] == "2 um"
    assert str(yaml.data["b"][1]["c"]) == "nan"
    assert yaml.data["b"][1]["d"] == float("-inf")
    assert [yaml.data[key] for key in ("on", "n", "text", "no")] == [True, None, "1", 1000.0]
    assert yaml.lines["b", 1, "d"] == 4
    assert yaml.lines["on",] == 5


def test_what_was_read_before_is_the_readers_own() -> None:
    """A text that is read again is not parsed again; what the first reader did to its data does not stand in them."""
    text = "a: {b: [1, {c: 2}]}\n"
    first = parse_yaml(text, "first.yaml")
    first.data["a"]["b"][1]["c"] = 3
    first.data["a"]["b"].append(4)
    first.lines.clear()
    for file in ("first.yaml", "second.yaml"):
        again = parse_yaml(text, file)
        assert again == YamlFile(file, {"a": {"b": [1, {"c": 2}]}}, again.lines)
        assert again.lines[("a", "b", 1, "c")] == 1
    for file in ("first.yaml", "second.yaml", "first.yaml"):
        with pytest.raises(InputError, match=rf"^{file}:2: "):
            parse_yaml("a: 1\na: 2\n", file)


def test_a_byte_order_mark_is_fine(tmp_path: Path) -> None:
    path = tmp_path / "input.yaml"
    path.write_bytes(b"\xef\xbb\xbfx: 1\n")
    assert read_yaml(path).data == {"x": 1}


def test_both_parsers_read_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """libyaml, which reads YAML 1.1, and the parser in Python: data, order, lines."""
    places = sorted((Path(yaml_file.__file__).parents[1]).rglob("*.yaml"))[::8]
    texts = ["|\n# c", "- a\n...\n...", "- [yes, 0o7, 1:30, a:b, 'c' ]", "[\n  ? ]]", "a: {b, c: }", "%YAML 1.1\n--- a"]
    texts += ["a: >#", "a: |\n \n  b", "a: >-\n  b\n\n   c", "a: |+\n\n  b\n\nc: d # e\n", "--- >\n#", "a: [b\u2028c]"]
    texts += ["a\tb: c\r\n", 'a: "b\\\n  c\\/\\u2028"', *(place.read_text("utf-8") for place in places)]

    def outcomes() -> list[str]:
        out = []
        for text in texts:
            try:
                out.append(repr(yaml_file._read(text, "a.yaml")))
            except InputError as error:
                out.append(str(error))
        return out

    fast = outcomes()
    monkeypatch.setattr(yaml_file, "_READ_APART", re.compile(""))
    assert outcomes() == fast


AWKWARD = ("", "a\nb", *"null|1|1e3|.5|-.inf|.nan|true|a: b|# no| x |*a|&a|!t|ü µm|[|<<|-".split("|"))
NUMBERS = (0.1, 1e-300, 1.7976931348623157e308, -0.0, 3, 10**20, 1e16, True, None, 5e-324)


def test_awkward_text_and_numbers_survive_a_round_trip() -> None:
    for value in AWKWARD:
        data = {"key": value, "list": [value, 1], value or "k": {"x": [[value]]}}
        assert parse_yaml(dump_yaml(data)).data == data
    for value in NUMBERS:
        assert repr(parse_yaml(dump_yaml({"x": value})).data["x"]) == repr(value)


def test_too_many_values_are_refused_where_they_begin(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not by the bytes: short values take as long as long ones."""
    monkeypatch.setattr(yaml_file, "MOST_VALUES", 12)
    assert parse_yaml("a: 1\nb: [1, 2, 3, 4, 5, 6, 7]\n").data["b"][-1] == 7  # a mapping, 2 keys, 1, a list, 7 values
    with pytest.raises(InputError, match=r":2: b\[7\]: too many keys and values; allowed: at most 12") as caught:
        parse_yaml("a: 1\nb: [1, 2, 3, 4, 5, 6, 7, 8]\n", "x.yaml")
    assert caught.value.key == ("b", 7)


@pytest.mark.second
def test_tabs_and_signs_of_units_are_texts() -> None:
    assert parse_yaml('note: "a\\tb\\nc µ ″"').data == {"note": "a\tb\nc µ ″"}
    for parse in (parse_yaml, parse_json):
        with pytest.raises(InputError, match="nested too deeply"):
            parse("[" * 500_000, "x")


def test_error_gives_the_first_issue_and_all_of_them() -> None:
    error = InputError(Issue("one", "a.yaml", 1, ("x",), "f", "g", "h"), Issue("two", "a.yaml", 2))
    first = (error.file, error.line, error.key, error.value, error.allowed, error.suggestion)
    assert first == ("a.yaml", 1, ("x",), "f", "g", "h")
    assert str(error).splitlines() == ["a.yaml:1: x: one; did you mean 'h'? Found f, allowed: g", "a.yaml:2: two"]
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    with pytest.raises(ValueError, match="at least one issue"):
        InputError()


def test_of_a_path_the_last_parts_are_enough() -> None:
    nodes = ["base", "base/forward/M1", "base/forward/M2", "base/backward/M2", "base/forward/focal_plane"]
    assert nearest("M2", nodes) == "base/forward/M2"
    assert nearest("backward/m2", nodes) == "base/backward/M2"
    assert nearest("focalplane", nodes) == "base/forward/focal_plane"
    assert nearest("nothing/like/it", nodes) is None


def test_shown_is_one_short_line() -> None:
    for value in ("a\nb" * 100, {"k": 1}, {}, [1] * 99, None, True, 1.5, float("nan")):
        assert len(shown(value)) <= 60
        assert "\n" not in shown(value)
