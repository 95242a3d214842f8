"""The mutation tool itself, on a toy tree: what it puts in, what it finds, what it calls a survivor."""

import ast
from pathlib import Path

import pytest
from typer.testing import CliRunner

SOURCE = b'''"""A toy."""
import math
LENGTH: float = 2.0

def half(x: float, limit: float = 3.0) -> float:
    if x > limit:
        raise ValueError(f"{x + 1} is beyond {limit}")
    return x / LENGTH - 0.0 * x

def unused(x):
    return -x

def sigma(values):
    return math.sqrt(sum(values))
'''
TESTS = """
import pytest
from optics.toy import half, sigma

def test_half():
    assert half(3.0) == 1.5

def test_two():
    assert half(2.0) == 1.0

def test_limit():
    with pytest.raises(ValueError):
        half(3.5)

def test_sigma():
    assert sigma([4.0, 5.0]) == 3.0
"""
MEANT = {
    "root lost": ("np.sqrt(a)", "(a)"),
    "root added": ("f(sigma=g(a))", "((g(a)) ** 0.5)"),
    "sigma x 0.8": ("f(sigma=g(a))", "(0.8 * (g(a)))"),
    "sigma x 1.25": ("f(sigma_x=g(a))", "(1.25 * (g(a)))"),
    "variance for sigma": ("sigma**2", "(sigma)"),
    "freedom off by one": ("f(degrees_of_freedom=len(a))", "((len(a)) - 1)"),
    "radians for degrees": ("np.degrees(a)", "(a)"),
    "other unit": ("a / MICRO", "(1e-3)"),
    "axis swapped": ("a[..., 0]", "1"),
    "name swapped": ("a['forward']", "'backward'"),
    "transposed": ("rotation @ a", "((rotation).swapaxes(-1, -2) @ (a))"),
    "rotation reversed": ("about_axis(0, roll)", "(-(roll))"),
    "index off by one": ("a[1:n]", "(n) - 1"),
    "first for last": ("a[0]", "-1"),
    "boundary": ("len(a) < 3", "(len(a) <= 3)"),
    "seed reused": ("default_rng([seed, k])", "[seed]"),
}
STATEMENTS = {
    "warning dropped": ("def warnings(a):\n    if a:\n        yield 'late'\n", "False"),
    "refusal passed": ("if a:\n    raise ValueError\n", "False"),
    "check skipped": ("def f(a):\n    os.fsync(a)\n", "pass"),
    "key forgets": ("def digest(a, b):\n    return sha(a, b)\n", "sha(a)"),
    "limit x 10": ("MOST_BYTES = 100\n", "1000"),
}


def test_each_fault_changes_one_place_still_parses_and_is_of_its_kind() -> None:
    from tests.mutation.mutants import KINDS, SLIP, mutants_of

    found = mutants_of("toy.py", SOURCE)
    for one in found:
        assert ast.dump(ast.parse(one.applied(SOURCE))) != ast.dump(ast.parse(SOURCE))
    texts = {(one.before, one.after) for one in found}
    assert {("x > limit", "False"), ("x / LENGTH", "(x * LENGTH)"), ("x / LENGTH - 0.0 * x", "(x / LENGTH)")} <= texts
    assert not any("x + 1" in before for before, _ in texts)
    assert not mutants_of("toy.py", b"def pairs(a, b):\n    return zip(a.reshape(-1), b, strict=True)\n")
    assert {*MEANT, *STATEMENTS, SLIP} == set(KINDS)
    for kind, (text, after) in {**MEANT, **STATEMENTS}.items():
        source = (text if kind in STATEMENTS else f"b = {text}\n").encode()
        assert (kind, after) in {(one.kind, one.after) for one in mutants_of("toy.py", source)}, kind


def test_the_sample_goes_by_rooms_and_kinds_and_not_by_what_is_written_elsewhere() -> None:
    from tests.mutation.__main__ import drawn
    from tests.mutation.mutants import mutants_of

    every = [one for name in ("optics/a/x.py", "optics/b/x.py") for one in mutants_of(name, SOURCE)]
    chosen = drawn(every, 20, 1)
    assert chosen == drawn(every[::-1], 20, 1)
    assert chosen != drawn(every, 20, 2)
    assert {one.path for one in chosen} == {"optics/a/x.py", "optics/b/x.py"}
    assert len({one.kind for one in chosen}) > 4


def test_a_fault_goes_into_functions_that_are_loaded_and_others_are_known() -> None:
    from tests.mutation.fork_server import functions_changed

    base = "A = 1\ndef f(x):\n    return [x + y for y in range(3)]\nclass C:\n    B = 2\n"
    base += "    def g(self):\n        return 1\n"

    def changed(after: str):
        both = (compile(text, "toy", "exec") for text in (base, after))
        return [one and one[0].co_qualname for one in functions_changed(*both)]

    assert changed(base) == []
    assert changed(base.replace("x + y", "x - y")) == ["f"]
    assert changed(base.replace("return 1", "return 2")) == ["C.g"]
    assert changed(base.replace("B = 2", "B = 3")) == [None]
    assert changed(base.replace("A = 1", "A = 2")) == [None]


def test_utterances_are_found_and_those_without_a_test_told() -> None:
    from tests.mutation.coverage_map import CoverageMap
    from tests.mutation.utterances import _of

    (one,) = _of(ast.parse(SOURCE), "toy.py", "", (0, 0))
    assert (one.line, one.scope, one.body) == (7, "half", (6, 8))
    lines = {6: ["a", "b"], 7: ["a"], 8: ["b"]}
    assert one.tests(CoverageMap({"toy.py": lines}, {})) == ({"a"}, {"b"})
    assert one.tests(CoverageMap({"toy.py": {6: ["b"], 8: ["b"]}}, {})) == (set(), {"b"})
    assert not one.always
    (refusing,) = _of(ast.parse("def refuse(x):\n    x = str(x)\n    raise ValueError(x)"), "toy.py", "", (0, 0))
    assert refusing.always


def test_what_runs_at_import_is_met_by_all_tests_of_the_file() -> None:
    """Test b is the first of its file to import the module: it runs the constant's line and not the function's."""
    from tests.mutation.coverage_map import CoverageMap

    known = CoverageMap({"toy.py": {2: ["", "b"], 7: ["a", "c"]}}, {"a": 2.0, "b": 1.0, "c": 0.5})
    assert known.covering("toy.py", (2, 2)) == ["c", "b", "a"]
    assert known.covering("toy.py", (7, 7)) == ["c", "a"]


@pytest.mark.second
def test_every_equivalent_mutant_gives_a_reason_and_every_planted_fault_is_in_the_source() -> None:
    from tests.mutation.__main__ import equivalents, planted

    assert all(len(reason) > 20 for reason in equivalents().values())
    root = Path(__file__).resolve().parents[2]
    for one in planted(root):
        ast.parse(one.applied((root / one.path).read_bytes()))


@pytest.mark.second
def test_a_campaign_finds_what_tests_find(tmp_path, monkeypatch) -> None:
    """From the command line on a toy tree: measured, tried, told; of a function without a test as uncovered."""
    from tests.mutation import __main__ as command

    for name in ("optics", "scenes", "analysis", "twin"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").touch()
    (tmp_path / "optics/toy.py").write_bytes(SOURCE)
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests/test_toy.py").write_text(TESTS)
    (tmp_path / "pyproject.toml").write_text("[tool.pytest.ini_options]\npythonpath = ['.']\n")
    plugin = tmp_path / "tests/mutation"
    plugin.mkdir()
    for name in ("coverage_plugin.py", "__init__.py"):
        source = Path(__file__).with_name(name)
        (plugin / name).write_bytes(source.read_bytes() if source.exists() else b"")
    (tmp_path / "tests/__init__.py").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "planted", lambda root: [])
    run = CliRunner().invoke
    assert run(command.app, ["measure", "--map", "map"]).exit_code == 0
    assert "holds a map" in run(command.app, ["measure", "--map", "map"]).output
    told = run(command.app, ["run", "--map", "map", "--out", "out", "--count", "24", "--workers", "1"])
    survivors = [line for line in told.stdout.splitlines() if "->" in line]
    assert any("unused" in line and "(uncovered)" in line for line in survivors), told.stdout
    assert all("unused" in line or "0.0 *" in line or "(x)" in line or "3.0" in line for line in survivors), survivors
    assert told.exit_code == 1
    listed = run(command.app, ["utterances", "--map", "map"])
    assert listed.exit_code == 0, listed.stdout
