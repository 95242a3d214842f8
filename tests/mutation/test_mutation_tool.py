"""The mutation tool itself, on a toy tree: what it puts in, what it finds, what it calls a survivor."""

import ast
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.mutation.__main__ import app, drawn, equivalents, summary, without
from tests.mutation.campaign import read_verdicts, run_campaign
from tests.mutation.coverage_map import CoverageMap, measure, read_map
from tests.mutation.mutants import mutants_below, mutants_of

SOURCE = b'''"""A toy."""
LENGTH: float = 2.0

def half(x: float, limit: float = 3.0) -> float:
    if x > limit:
        raise ValueError(f"{x + 1} is beyond {limit}")
    return x / LENGTH - 0.0 * x

def unused(x):
    return -x
'''
TESTS = """
import pytest
from typer.testing import CliRunner
from toy import half

def test_half():
    assert half(3.0) == 1.5

def test_two():
    assert half(2.0) == 1.0

def test_limit():
    with pytest.raises(ValueError):
        half(3.5)
"""


def test_each_mutant_changes_one_expression_and_still_parses():
    found = mutants_of("toy.py", SOURCE)
    for one in found:
        assert ast.dump(ast.parse(one.applied(SOURCE))) != ast.dump(ast.parse(SOURCE))
    texts = {(one.before, one.after) for one in found}
    assert ("x > limit", "False") in texts
    assert ("x / LENGTH", "(x * LENGTH)") in texts
    assert ("x / LENGTH - 0.0 * x", "(x / LENGTH)") in texts
    assert not any("x + 1" in before for before, _ in texts)
    assert not mutants_of("toy.py", b"def pairs(a, b):\n    return zip(a.reshape(-1), b, strict=True)\n")
    assert [one.after for one in mutants_of("toy.py", b"def half(a):\n    return a.reshape(2, -1)\n")] == ["3"]


def test_what_runs_at_import_is_met_by_all_tests_of_the_file():
    """Test b is the first of its file to import the module: it runs the constant's line and not the function's."""
    known = CoverageMap({"toy.py": {2: ["", "b"], 7: ["a", "c"]}}, {"a": 2.0, "b": 1.0, "c": 0.5})
    assert known.covering("toy.py", (2, 2)) == ["c", "b", "a"]
    assert known.covering("toy.py", (7, 7)) == ["c", "a"]
    rest, late = known.parts(["c"])
    assert rest.covering("toy.py", (2, 2)) == ["b", "a"]
    assert late.covering("toy.py", (2, 2)) == ["c"]


def test_keys_differ_and_do_not_move_with_other_code():
    before = mutants_of("toy.py", SOURCE)
    after = mutants_of("toy.py", b'"""Longer."""\n\nOTHER = 1\n' + SOURCE)
    assert len({one.key for one in before}) == len(before)
    assert {one.key for one in before} < {one.key for one in after}


def test_a_sample_keeps_its_mutants_when_others_come():
    few = mutants_of("toy.py", SOURCE)
    more = mutants_of("toy.py", SOURCE + b"\n\ndef other(x):\n    return 2 * x + 1\n")
    picked = {one.key for one in drawn(few, 5, seed=1)}
    assert picked != {one.key for one in drawn(few, 5, seed=2)}
    again = {one.key for one in drawn(more, 5, seed=1)}
    assert again - picked <= {one.key for one in more} - {one.key for one in few}


def test_a_place_that_is_not_there_is_told(tmp_path):
    result = CliRunner().invoke(app, ["--out", str(tmp_path), "--only", "optics/lens.py"])
    assert result.exit_code == 2
    assert "optics/lens.py" in result.stderr
    result = CliRunner().invoke(app, ["--out", str(tmp_path), "--without", f"@{tmp_path}/moved"])
    assert result.exit_code == 2
    assert f"{tmp_path}/moved" in result.stderr


@pytest.mark.slow
def test_a_campaign_tells_the_found_from_the_survivors(tmp_path: Path):
    root = tmp_path / "tree"
    shutil.copytree(
        Path(__file__).parent, root / "tests/mutation", ignore=shutil.ignore_patterns("test_*", "__pycache__")
    )
    (root / "toy.py").write_bytes(SOURCE)
    (root / "tests/test_toy.py").write_text(TESTS)
    assert measure(root, [root / "tests/test_toy.py"], ("toy.py",), tmp_path / "coverage", 1) == []
    known = read_map(tmp_path / "coverage", root)
    wanted = {
        ("x / LENGTH", "(x * LENGTH)"): "killed",
        ("0.0 * x", "(0.0 / x)"): "survived",
        ("-x", "(x)"): "uncovered",
    }
    chosen = [one for one in mutants_below(root, ("toy.py",)) if (one.before, one.after) in wanted]
    # At the first failure, and the quickest of the two that fail after the other.
    quickest = min(("half", "two"), key=lambda name: known.seconds[f"tests/test_toy.py::test_{name}"])
    last = [f"tests/test_toy.py::test_{quickest}"]
    run_campaign(root, chosen, known, tmp_path / "first.jsonl", 2, mode="first", last=last, say=False)
    one_each = read_verdicts(tmp_path / "first.jsonl").values()
    assert [len(one.killers) for one in one_each if one.fate == "killed"] == [1]
    assert all(without(one, last) == one for one in one_each)
    run_campaign(root, chosen, known, tmp_path / "results.jsonl", 2, say=False)
    found = read_verdicts(tmp_path / "results.jsonl")
    assert {(one.mutant.before, one.mutant.after): one.fate for one in found.values()} == wanted
    assert (root / "toy.py").read_bytes() == SOURCE
    nothing_known = summary(list(found.values()), {})
    assert nothing_known["score"] == pytest.approx(1 / 3)
    killed, survivor = (next(one for one in found.values() if one.fate == fate) for fate in ("killed", "survived"))
    names = ["tests/test_toy.py::test_half", "tests/test_toy.py::test_two"]
    assert sorted(killed.killers) == names
    assert without(killed, names[:1]).killers == (names[1],)
    assert without(killed, names[:1]).fate == "killed"
    assert without(killed, ["tests/test_toy.py"]).fate == "survived"
    assert without(survivor, names) == survivor
    assert summary(list(found.values()), {survivor.mutant.key: "times nothing"})["score"] == pytest.approx(1 / 2)


@pytest.mark.slow
def test_every_equivalent_mutant_still_exists_and_has_a_reason():
    root = Path(__file__).parents[2]
    keys = {one.key for one in mutants_below(root, ("optics", "analysis", "twin"))}
    known = equivalents()
    assert known.keys() <= keys
    assert all(len(reason) > 20 for reason in known.values())
