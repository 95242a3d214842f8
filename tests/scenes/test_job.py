"""Jobs: what is read, and that every mistake is told with file, line, key and what was meant."""

from pathlib import Path

import pytest

from scenes.specs.course import noll
from scenes.specs.job import checked_nodes
from scenes.specs.load import load_job
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml
from tests.scenes.refusals.readers import NODES

HEAD = "instrument: gf7_pair\nperturb:\n"


def write(folder: Path, text: str) -> Path:
    path = folder / "perturb.yaml"
    path.write_text(text, "utf-8")
    return path


def test_changes_of_temperature(tmp_path: Path) -> None:
    changes = {"100 K": 100.0, "+250 K": 250.0, " +250 K": 250.0, "-250 K": -250.0, "250 mK": 0.25, "+1000 K": 1000.0}
    for text, kelvin in changes.items():
        path = write(tmp_path, f"{HEAD}  base: {{temperature: '{text}'}}\n")
        job = load_job(path)
        assert job.perturb["base"].temperature.change == kelvin
        # what is written is read again
        again = write(tmp_path, dump_yaml(job.plain()))
        assert load_job(again).perturb["base"].temperature.change == kelvin


def test_everything_that_a_node_may_have(tmp_path: Path) -> None:
    node = (
        "  base/forward/M1: {figure: {Z5: 20 nm, Z11: -3 nm}, scale: 10 ppm, rotate: [1 arcsec, 0 arcsec, 0 arcsec]}\n"
    )
    what = load_job(write(tmp_path, HEAD + node)).perturb["base/forward/M1"]
    assert dict(what.figure) == {"Z5": 20e-9, "Z11": -3e-9}
    assert what.scale == 10e-6
    assert what.uses() == ("rotate", "figure", "scale")
    assert [noll(term) for term in what.figure] == [5, 11]


def test_all_mistakes_are_told_at_once(tmp_path: Path) -> None:
    path = write(tmp_path, HEAD + "  base/forward/M2: " + "{rotate: [1, 2 m, 0 deg]}\nrender:\n  seed: x\n  frame: 2\n")
    with pytest.raises(InputError) as caught:
        load_job(path)
    assert [issue.line for issue in caught.value.issues] == [3, 3, 5, 6]
    assert len(str(caught.value).splitlines()) == 4


def test_all_nodes_are_told_at_once(tmp_path: Path) -> None:
    job = load_job(write(tmp_path, HEAD + "  a: {}\n  base/forward/M1: {pivot: b}\n  c: {}\n"))
    with pytest.raises(InputError) as caught:
        checked_nodes(job, NODES)
    assert [issue.line for issue in caught.value.issues] == [3, 4, 5]
