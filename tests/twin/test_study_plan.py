"""The table of runs: designs against their definitions, places in the base, seeds, files of tables."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import kstest, norm

from scenes.specs.load import EXAMPLES
from scenes.specs.study import ResponseSpec, unit_cube
from scenes.yaml.errors import InputError, Problem
from scenes.yaml.yaml_file import dump_yaml, parse_yaml
from tests.tiers import quick
from tests.twin.study_bench import REFUSED, STUDY, TEXTS, refusals, write_study
from twin.live.knobs import factor_knobs
from twin.study.gradient.study_gradient import GradientFactor
from twin.study.runs import setup
from twin.study.runs.base_job import BlockResult, check_response, leaf, with_values
from twin.study.runs.plan import Plan
from twin.study.runs.render_base import BLOCK, read_job
from twin.study.runs.setup import resolve_study, study_from_text

FACTORS = STUDY[STUDY.index("factors:") : STUDY.index("design:")]
NORMAL = "normal: {mean: 0 um, sigma: 1 um}"
RUNS = 2000
FALSE_ALARM = 1e-6
"""Of each statistical test; seeds are fixed, so that it passes always or never."""


def plan_of(folder: Path, *changes) -> Plan:
    return Plan.of(resolve_study(write_study(folder, *changes)))


def column(plan: Plan, name: str) -> np.ndarray:
    return next(c.values for c in plan.columns if c.name == name)


@pytest.mark.second
@pytest.mark.parametrize("kind", ["latin_hypercube", "sobol", "monte_carlo"])
def test_drawn_designs_follow_their_distributions(tmp_path, kind) -> None:
    changes = (("kind: monte_carlo, runs: 100", f"kind: {kind}, runs: {RUNS}"),)
    plan = plan_of(tmp_path, *changes)
    z, x = column(plan, "m2z"), column(plan, "m2x")
    # evenly spread designs are closer to the distribution than random draws, never farther
    assert kstest(z, norm(0.0, 1.0).cdf).pvalue > FALSE_ALARM
    assert kstest(x, lambda v: 0.5 * (v + 1.0)).pvalue > FALSE_ALARM
    # independent: the correlation of 2000 pairs is below 5/sqrt(2000) but once in two million
    assert abs(np.corrcoef(z, x)[0, 1]) < 5.0 / np.sqrt(RUNS)
    if kind == "latin_hypercube":
        for u in (norm.cdf(z), 0.5 * (x + 1.0)):
            assert np.array_equal(np.sort(np.floor(u * RUNS)), np.arange(RUNS))
    again = plan_of(tmp_path / "again", *changes)
    assert np.array_equal(column(again, "m2z"), z)
    other = plan_of(tmp_path / "other", *changes, ("seed: 3}", "seed: 4}"))
    assert not np.any(column(other, "m2z") == z)


@pytest.mark.second
def test_a_grid_is_every_combination(tmp_path) -> None:
    plan = plan_of(
        tmp_path,
        (NORMAL, "range: [0 um, 0.002 mm], count: 3"),
        ("uniform: [-1 um, 1 um]", "values: [5 nm, 1 um]"),
        ("kind: monte_carlo, runs: 100, seed: 3", "kind: grid, seed: 3"),
    )
    assert plan.runs == 6
    np.testing.assert_allclose(column(plan, "m2z"), [0, 0, 1, 1, 2, 2])
    np.testing.assert_allclose(column(plan, "m2x"), [5, 1000] * 3)
    assert plan.columns[1].unit == "nm"
    values = dict(plan.run(5).values)
    assert values["job", "perturb", "base/forward/M2", "shift", 2] == "+2.0 um"
    assert values["job", "perturb", "base/forward/M2", "shift", 0] == "+1000.0 nm"


def test_blocks_and_seeds(tmp_path) -> None:
    plan = plan_of(tmp_path, ("runs: 100", "runs: 110"))
    assert plan.blocks == 5
    assert [number for k in range(plan.blocks) for number in plan.block(k)] == list(range(110))
    assert len(plan.block(4)) == 110 - 4 * BLOCK
    assert len(set(plan.seeds.tolist())) == 110
    assert plan.seeds.min() >= 0
    word = np.random.SeedSequence(3, spawn_key=(7,)).generate_state(1, np.uint64)[0]
    assert plan.run(7).seed == int(word) >> 1
    shared = plan_of(tmp_path / "shared", ("responses:", "noise: shared\nresponses:"))
    assert shared.run(7).seed is None


@pytest.mark.second
def test_config_yaml_says_all(tmp_path) -> None:
    """A table's values travel with it; the numbers and the fingerprint are the same."""
    (tmp_path / "t.csv").write_text("z,name\n1 um,a\n2 um,b\n3 um,c\n", "utf-8")
    path = write_study(tmp_path, (NORMAL, "table: {file: t.csv, column: z}"))
    setup = resolve_study(path)
    again = study_from_text(setup.to_yaml())
    assert again.fingerprint == setup.fingerprint
    assert again.tree == setup.tree
    one, two = Plan.of(setup), Plan.of(again)
    assert [one.run(k) for k in range(one.runs)] == [two.run(k) for k in range(two.runs)]
    assert set(column(one, "m2z").tolist()) == {1.0, 2.0, 3.0}


def test_a_table_of_other_than_text_is_told_with_its_line(tmp_path) -> None:
    (tmp_path / "t.csv").write_bytes(b"z\n1 um\n\xff\n")
    with pytest.raises(InputError, match=r"t\.csv:3: not UTF-8 text"):
        resolve_study(write_study(tmp_path, (NORMAL, "table: {file: t.csv, column: z}")))


M2 = "base/forward/M2"


@pytest.mark.second
@pytest.mark.parametrize("key", TEXTS["neutral"])
@pytest.mark.parametrize("order", quick(1, [-1, 1]))
def test_a_place_without_a_value_starts_where_nothing_happens(tmp_path, key, order) -> None:
    """The base of a derivative and of a knob is the job's own, whichever values the factor lists and in which order."""
    values = f"values: {str(TEXTS['neutral'][key][::order]).replace(chr(39), '')}"
    path = write_study(tmp_path, ("base/forward/M2, shift, 2]", f"{M2}, {key}]"), (NORMAL, values))
    made = resolve_study(path)
    assert GradientFactor.of(made, "m2z").value == 0.0
    assert factor_knobs(made)[0].value == 0.0
    job = read_job(made.base).job.perturb[M2]
    assert job.uses() == (("temperature",) if "temperature" in key else ())
    assert not job.heat.warms
    again = study_from_text(made.to_yaml())
    assert (again.tree, again.base, again.content) == (made.tree, made.base, made.content)


def test_a_temperature_that_is_inherited_is_no_zero(tmp_path) -> None:
    """M2 of the warmed camera is at 4 K in the base, where the place of the factor is none; runs are as ever."""
    path = write_study(
        tmp_path, ("base/forward/M2, shift, 2]", f"{M2}, temperature, change]"), (NORMAL, "uniform: [1 K, 2 K]")
    )
    with (tmp_path / "job.yaml").open("a", encoding="utf-8") as file:
        file.write("perturb: {base/forward: {temperature: 4 K}}\n")
    made = resolve_study(path)
    assert read_job(made.base).job.perturb[M2].temperature is None
    assert study_from_text(made.to_yaml()).base == made.base
    run = dict(Plan.of(made).run(0).values)
    place = ("job", "perturb", M2, "temperature", "change")
    assert 1.0 <= read_job(with_values(made.tree, run.items())).job.perturb[M2].heat.change <= 2.0
    assert place in run
    for start in (lambda: GradientFactor.of(made, "m2z"), lambda: factor_knobs(made)):
        with pytest.raises(InputError, match=r"factors\.m2z\.key: the base has no number here to start from"):
            start()


@pytest.mark.parametrize(("old", "new", "key", "words"), refusals("study"))
def test_what_is_refused(tmp_path, old, new, key, words) -> None:
    path = write_study(tmp_path, (old, new))
    with pytest.raises(InputError) as refused:
        Plan.of(resolve_study(path))
    for part in (f"{path}:", key, words):
        assert part in str(refused.value)


def test_scaled_values(tmp_path) -> None:
    """Light grows with the squares of aperture and pinhole; a ratio multiplies what another factor sets."""
    plan = plan_of(
        tmp_path, (FACTORS, TEXTS["scaled"]), ("kind: monte_carlo, runs: 100, seed: 3", "kind: grid, seed: 3")
    )
    assert plan.runs == 16
    monitor = ("instrument", "monitor")
    light, width = (*monitor, "reticle", "photons_per_frame"), (*monitor, "prism_180", "width")
    base = {place: leaf(plan.setup.tree, place) for place in (light, width)}
    assert base == {light: 4e6, width: "60 mm"}
    m2z = ("job", "perturb", "base/forward/M2", "shift", 2)
    found = [dict(plan.run(k).values) for k in range(16)]
    # the base has 50 mm, 20 um and 4e6 photons; the last factor changes fastest
    expected = [4e6 * a**2 * p**2 for a in (0.5, 1.0) for p in (0.5, 2.0) for _ in range(4)]
    assert [run[light] for run in found] == pytest.approx(expected, rel=1e-12)
    assert {run[width] for run in found} == {"+30.0 mm", "+60.0 mm"}
    assert [run[m2z] for run in found[:4]] == ["+0.0 um", "+6.0 um", "+0.0 um", "+8.0 um"]
    assert len({place for run in found for place in run}) == len(found[0])


def test_changed_values_leave_the_tree_alone() -> None:
    tree = {"a": {"b": [1, 2, 3]}, "c": {"d": 4}}
    new = with_values(tree, [(("a", "b", 1), 9), (("a", "b", 2), 8)])
    assert new == {"a": {"b": [1, 9, 8]}, "c": {"d": 4}}
    assert tree == {"a": {"b": [1, 2, 3]}, "c": {"d": 4}}
    assert new["c"] is tree["c"]


def test_a_design_that_does_not_exist_draws_no_points() -> None:
    """It was drawn as monte_carlo."""
    with pytest.raises(KeyError, match="halton"):
        unit_cube("halton", 4, 2, 0)


CELLS = (
    *("1", " 2.5 ", "-3e-4", "+.5", "1_000", "true", "null", "", "2 um", "-1.5 arcsec", "1 um/m", "- 1", "-", "--- a"),
    *("a: b", "# c", "'quoted'", '"1"', "[1, 2]", "{a: 1}", "*a", "&a", "!t", "? x", "x, y", ".inf", "nan", "0x10"),
    *("N-BK7", "a\tb", "a  b", "1e400"),
)


def test_a_cell_is_what_yaml_reads(monkeypatch) -> None:
    """The short way, which most cells take, and the parser give the same."""
    short = [setup._cell(text) for text in CELLS]
    monkeypatch.setattr(setup, "_PLAIN", re.compile(r"(?!)"))
    assert [(type(one), repr(one)) for one in short] == [(type(w), repr(w)) for w in map(setup._cell, CELLS)]


@pytest.mark.parametrize(
    ("table", "words"),
    [
        *refusals("tables"),
        ("a,b\n" + "1 um,2\n" * 50, "at most 40 with 1 of its columns"),
        ('a,b\n"' + "x" * 200_000 + '",2\n', "cannot be read: field larger than"),
    ],
)
def test_tables_that_are_none_for_a_study(table: str, words: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(setup, "MOST_CELLS", 40)
    (tmp_path / "t.csv").write_text(table)
    with pytest.raises(InputError, match=words) as caught:
        resolve_study(write_study(tmp_path, (NORMAL, "table: {file: t.csv, column: a}")))
    assert caught.value.key[:3] == ("factors", "m2z", "table")
    assert caught.value.allowed is not None


def test_a_config_yaml_that_is_damaged_is_refused(tmp_path, monkeypatch) -> None:
    (tmp_path / "t.csv").write_text("z\n1 um\n2 um\n", "utf-8")
    path = write_study(tmp_path, (NORMAL, "table: {file: t.csv, column: z}"))
    whole = parse_yaml(resolve_study(path).to_yaml()).data
    bare = {**whole["study"], "factors": {**whole["study"]["factors"]}}
    bare["factors"]["m2z"] = {**bare["factors"]["m2z"], "table": {"file": "t.csv", "column": "z"}}
    for data, told in (
        ({**whole, "more": 1}, "unknown key"),
        ({"study": whole["study"]}, "the resolved base is missing"),
        ({**whole, "study": bare}, "the table's values are missing"),
    ):
        with pytest.raises(InputError, match=told):
            study_from_text(dump_yaml(data))
    focus = f"lab focus, file: {EXAMPLES.parent / 'lab/measured/focus.yaml'}"
    with pytest.raises(InputError, match="measurements cannot be varied"):
        resolve_study(write_study(tmp_path / "lab", ("render, file: job.yaml", focus)))
    with pytest.raises(InputError, match="cannot run 'orbit nothing' in a study"):
        setup._job("orbit nothing")
    monkeypatch.setattr(setup.yaml_file, "LARGEST_BYTES", 3000)
    with pytest.raises(InputError, match="larger than 1 MB"):
        resolve_study(path)


def test_places_of_results_that_are_no_numbers_are_refused() -> None:
    sample = {"a": {"list": [1, 2], "text": "x", "number": 1.0}}
    check_response(sample, ("a", "number"))
    check_response(sample, ("a", "list", 1))
    for key, told in REFUSED["places"]:
        with pytest.raises(Problem, match=told):
            check_response(sample, tuple(key))
    result = BlockResult.of([sample], {"r": ResponseSpec(key=("a", "text"))})
    assert result.messages[0].endswith("the response 'r' is not a number but str")
