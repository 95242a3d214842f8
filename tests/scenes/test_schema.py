"""JSON Schemas for editors."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from scenes.schema import MODELS, json_schema, main, write_schemas
from scenes.yaml.quantity import PATTERN

ROOT = Path(__file__).resolve().parents[2]


def test_command_writes_all(tmp_path: Path) -> None:
    command = [sys.executable, "-W", "error", "-m", "scenes.schema", "--out", str(tmp_path / "new" / "folder")]
    result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60, check=True)
    paths = [Path(line) for line in result.stdout.splitlines()]
    assert [path.name for path in paths] == [f"{name}.schema.json" for name in MODELS]
    for path in paths:
        assert json.loads(path.read_text("utf-8"))["type"] == "object"


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"):
        write_schemas(tmp_path / "file")
    command = [sys.executable, "-m", "scenes.schema", "--out", str(tmp_path / "file")]
    result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60, check=False)
    assert result.returncode == 2
    assert "cannot be written" in result.stderr
    assert "Traceback" not in result.stderr
    assert main.__doc__


def test_quantities_are_described() -> None:
    rotate = json_schema("job")["$defs"]["PerturbationSpec"]["properties"]["rotate"]
    assert rotate["minItems"] == rotate["maxItems"] == 3
    assert rotate["items"]["examples"] == ["2 arcsec"]
    assert "at most 5 deg" in rotate["items"]["description"]
    assert rotate["default"] == ["0 arcsec"] * 3
    camera = json_schema("camera")
    assert camera["properties"]["edge_margin"]["default"] == "5 mm"
    assert camera["additionalProperties"] is False
    assert "focal_length" in camera["required"]


@pytest.mark.parametrize("text", ["2 arcsec", "-1.5 arcsec", "20um", "1e-3 1/m^3", "1 %", "2 um/m"])
def test_the_pattern_admits_quantities(text: str) -> None:
    assert re.search(PATTERN, text)


@pytest.mark.parametrize("text", ["2", "", "m", "two m", "2 m m"])
def test_the_pattern_refuses_the_rest(text: str) -> None:
    assert not re.search(PATTERN, text)


def test_every_attribute_has_a_description() -> None:
    checked = 0
    for name in MODELS:
        schema = json_schema(name)
        for model in (schema, *schema.get("$defs", {}).values()):
            for key, item in model["properties"].items():
                assert (
                    item.get("description")
                    or "$ref" in item
                    or key in ("x", "y", "z", "pixels", "pitch", "position", "centroid")
                )
                checked += 1
    assert checked > 40
