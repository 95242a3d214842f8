"""What twin.show says of a file: kind, command, keys and defaults."""

import json

import pytest

from scenes.specs.file_kinds import file_kinds, kind_of
from scenes.yaml.yaml_file import read_yaml
from tests.twin.commands import invoke
from tests.twin.study_bench import ROOT
from twin.show import app

EXAMPLES = sorted((ROOT / "scenes").rglob("*.yaml"))


def test_a_job_is_shown_with_its_command_and_defaults() -> None:
    done = invoke(app, "scenes/examples/perturb.yaml", "--json")
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["kind"], found["command"]) == ("job", "python -m twin.render scenes/examples/perturb.yaml")
    keys = {row["key"]: row for row in found["keys"]}
    assert keys["instrument"]["value"] == "gf7_pair"
    assert keys["instrument"]["set"] is True
    assert keys["course"]["set"] is False
    assert all(row["meaning"] for row in found["keys"])
    shown = invoke(app, "scenes/examples/perturb.yaml").stdout
    assert "is a job of the monitor" in shown
    assert "defaults of the other keys" in shown


def test_defaults_have_their_units() -> None:
    """Not the metres of the program."""
    found = json.loads(invoke(app, "scenes/library/cameras/gf7.yaml", "--json").stdout)
    keys = {row["key"]: row for row in found["keys"]}
    assert not keys["medium"]["set"]
    assert all(not isinstance(row["value"], float) for row in found["keys"] if not row["set"])


def test_every_shipped_file_is_known() -> None:
    """Files that no command reads name the key where they belong."""
    kinds = {kind.name for kind in file_kinds()}
    for path in EXAMPLES:
        kind = kind_of(read_yaml(path).data)
        assert kind is not None, path
        assert kind.name in kinds
        assert kind.command or kind.place, path


@pytest.mark.parametrize("text", ["x: 1\n", "[1, 2]\n"])
def test_another_file_is_refused(text: str, tmp_path) -> None:
    path = tmp_path / "other.yaml"
    path.write_text(text, "utf-8")
    done = invoke(app, path)
    assert done.exit_code == 2
    assert "not clear what kind of file this is" in done.stderr or "error: " in done.stderr
    assert invoke(app, tmp_path / "missing.yaml").exit_code == 2
