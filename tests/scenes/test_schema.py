"""JSON Schemas for editors."""

import json
import re
from pathlib import Path

import pytest
import typer

from scenes.schema import MODELS, json_schema, main, shipped_nodes, with_nodes, write_schemas
from scenes.specs.load import EXAMPLES, INSTRUMENTS, library_names
from scenes.yaml.units import ANGLE, KINDS, LENGTH, PER_LENGTH3, SCALE, TEMPERATURE, TEMPERATURE_DIFFERENCE, pattern
from scenes.yaml.yaml_file import read_yaml
from tests.twin.commands import invoke

QUANTITIES = {
    ANGLE: ("2 arcsec", "-1.5 arcsec", "1e-3 deg", "3 µrad"),
    LENGTH: ("20um", "20 µm", "+.5 m", "1 km"),
    SCALE: ("1 %", "2 um/m", "3 ppm"),
    PER_LENGTH3: ("1e-3 1/m^3",),
    TEMPERATURE: ("20 degC", "20 °C", "293 K"),
    TEMPERATURE_DIFFERENCE: ("0.1 K", "+250 K"),
}


JOB = {"instrument": "gf7_pair", "perturb": {"base/forward/M2": {"shift": "0 0 3 um", "pivot": "origin"}}}
FOCAL = "base/backward/focal_plane"
FAULTS = {
    "node": {"perturb": {"base/forward/M9": {"shift": "0 0 3 um"}}},
    "pivot": {"perturb": {FOCAL: {"rotate": "0 0 3 arcsec", "pivot": "front_node"}}},
    "unit": {"perturb": {"base/forward/M2": {"shift": "0 0 3 arcsec"}}},
    "typing error": {"perturb": {"base/forward/M2": {"shift": ["0 um", "0 um", "3 umm"]}}},
    "figure": {"perturb": {FOCAL: {"figure": {"Z5": "20 nm"}}}},
    "course": {"course": {"times": ["0 min", "1 min"], "temperature": {"base/M2": {"change": ["0 K", "1 K"]}}}},
}


def test_the_pattern_of_a_kind_admits_its_units_alone() -> None:
    for kind in QUANTITIES:
        for other, texts in QUANTITIES.items():
            for text in texts:
                both = kind == TEMPERATURE and other == TEMPERATURE_DIFFERENCE
                same = other == kind or both or (text == "293 K" and kind.si == "K")
                assert bool(re.search(pattern(kind), text)) == same, text
        for text in ("2", "", "m", "two m", "2 m m", "2 arcse"):
            assert not re.search(pattern(kind), text)
    for kind in KINDS:
        for unit in (*kind.units, *kind.writes):
            assert re.search(pattern(kind), f"-1.5e-3 {unit}"), unit
        assert re.search(pattern(kind), kind.example)


@pytest.mark.second
def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(main)
    done = invoke(app, "--out", tmp_path / "new")
    assert done.exit_code == 0, done.stderr
    for name in MODELS:
        assert json.loads((tmp_path / f"new/{name}.schema.json").read_text("utf-8"))["type"] == "object"
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"):
        write_schemas(tmp_path / "file", {})
    for words, problem in (((), "exists"), (("--force",), "cannot be written")):
        done = invoke(app, "--out", tmp_path / "file", *words)
        assert done.exit_code == 2
        assert problem in done.stderr


@pytest.fixture(scope="module")
def nodes():
    return shipped_nodes()


def problems(schema, job) -> int:
    jsonschema = pytest.importorskip("jsonschema")
    return len(list(jsonschema.Draft202012Validator(schema).iter_errors(job)))


@pytest.mark.second
def test_the_schema_of_jobs_knows_the_nodes_of_shipped_instruments(nodes) -> None:
    assert set(nodes) == set(library_names(INSTRUMENTS))
    schema = with_nodes(json_schema("job"), nodes)
    assert problems(schema, JOB) == 0
    assert problems(schema, {**JOB, "perturb": {FOCAL: {"rotate": "0 0 3 arcsec", "pivot": "rear_node"}}}) == 0
    for name, fault in FAULTS.items():
        assert problems(schema, {**JOB, **fault}) > 0, name
    # of an own instrument nobody knows the nodes
    assert problems(schema, {"instrument": "own.yaml", **FAULTS["node"]}) == 0
    stems = ("perturb", "orbit", "launch", "heat_soak", "targets", "steady")
    for path in (EXAMPLES / f"{stem}.yaml" for stem in stems):
        assert problems(schema, read_yaml(path).data) == 0, path
