"""Every file with numbers says in which frames they are, and says it right."""

import ast
import json
from pathlib import Path

import pytest

import twin
from scenes.specs.procedures import PROCEDURES
from twin.run.reference_frames import FRAMES, described, frames_text, schema
from twin.run.run_folder import MANIFEST

SOURCES = sorted(Path(twin.__file__).parent.rglob("*.py"))
# what it was run with and which checks passed: no positions, directions or times of an experiment
WITHOUT = {MANIFEST, "validation.json"}


def calls(name):
    """All calls of a function or method of that name in the package, with their file."""
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            called = getattr(node, "func", None)
            if isinstance(node, ast.Call) and name == getattr(called, "attr", getattr(called, "id", None)):
                yield path, node


def source(node):
    return ast.unparse(node)


@pytest.mark.second
def test_every_writer_of_json_states_frames():
    """A file's content is `described(...)`, or a name that is assigned from it."""
    count = 0
    for path, call in calls("write_json"):
        name, data = (source(a) for a in call.args)
        if name == "MANIFEST" or name.strip("'\"") in WITHOUT:
            continue
        count += 1
        tree = ast.parse(path.read_text("utf-8"))
        assigned = [
            source(n.value) for n in ast.walk(tree) if isinstance(n, ast.Assign) and source(n.targets[0]) == data
        ]
        said = [data, *assigned]
        assert any(s.removeprefix("reference_frames.").startswith("described(") for s in said), f"{path.name}: {name}"
    assert count >= 4


def test_every_kind_of_result_has_frames():
    assert len(PROCEDURES) >= 8
    assert {procedure.kind for procedure in PROCEDURES.values() if not procedure.frames} <= set(FRAMES)
    with pytest.raises(KeyError):
        described("unheard-of", {})


@pytest.mark.second
def test_every_data_file_beside_the_report_has_frames():
    found = 0
    for path, call in calls("Data"):
        if "validation" in path.parts or path.name == "artefact.py":
            continue
        data = source(call.args[3])
        tree = ast.parse(path.read_text("utf-8"))
        assigned = [
            source(n.value) for n in ast.walk(tree) if isinstance(n, ast.Assign) and source(n.targets[0]) == data
        ]
        said = (one.removeprefix("reference_frames.") for one in (data, *assigned))
        assert any(one.startswith("described(") for one in said), f"{path.name}: {data}"
        found += 1
    assert found >= 4


@pytest.mark.second
def test_every_netcdf_file_has_frames():
    """Data sets are made in few places, and each of them names the frames among its attributes."""
    writer = "data_files.py"  # turns one sort of data set into the other
    makers = {path for kind in ("Dataset", "GridData") for path, _ in calls(kind)}
    makers = {path for path in makers if "validation" not in path.parts and path.name != writer}
    assert {"render_files.py", "results.py"} <= {path.name for path in makers}
    for path in makers:
        text = path.read_text("utf-8").replace("reference_frames.frames_text(", "frames_text(")
        assert '"reference_frames": frames_text(' in text, path


LATER = {"angle": 4, "calibration": 4, "recovered": 4, "course": 3, "monitor": 4} | dict.fromkeys(
    (
        "camera",
        "crosstalk",
        "design",
        "distortion",
        "layouts",
        "match",
        "mtf",
        "optics",
        "simulate",
        "truth",
        "turntable",
    ),
    3,
)
"""Kinds whose keys went, changed their meaning or got other names since there is a second version."""


def test_statements_are_whole():
    for kind, statement in FRAMES.items():
        found = described(kind, {"seed": 1})
        assert list(found) == ["schema", "reference_frames", "seed"]
        assert found["schema"] == schema(kind) == f"{kind} {LATER.get(kind, 2)}"
        assert statement
        for quantity, frame in statement.items():
            assert len(frame) > 10, (kind, quantity)
            assert frame in frames_text(kind)
        json.dumps(found, allow_nan=False)
