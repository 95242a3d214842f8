"""JSON files that nobody has vetted: read, or refused with file and line."""

import json

from scenes.yaml.json_file import parse_json, read_json


def test_what_is_written_is_read(tmp_path) -> None:
    data = {"a": [1, -2.5, None, True, "x"], "b": {"c": []}, "d": 10**200}
    (tmp_path / "a.json").write_text(json.dumps(data), "utf-8")
    assert read_json(tmp_path / "a.json") == data
    assert parse_json("3", "a.json") == 3
