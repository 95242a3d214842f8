"""Files that nobody has vetted: everything but plain data is refused, with file and line."""

import os
from pathlib import Path

import pytest

from scenes.yaml import yaml_file
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import YamlFile, dump_yaml, parse_yaml, read_yaml


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


def test_tabs_and_signs_of_units_are_texts() -> None:
    assert parse_yaml('note: "a\\tb\\nc µ ″"').data == {"note": "a\tb\nc µ ″"}
    with pytest.raises(InputError, match="nested too deeply"):
        parse_yaml("[" * 500_000)
