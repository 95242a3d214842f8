"""`python -m twin.validate`: which checks run, how a verdict comes about, what is written, and what happens when
something goes wrong. Tiny groups stand for the real ones, but for one run of paper 001's formulas.
"""

import json
import math
from functools import partial
from pathlib import Path

import pytest

import twin.validate as command
from tests.twin.commands import invoke
from tests.twin.study_bench import REFUSED
from twin.framework.artefact import Data, PngFigure, SvgFigure, Table
from twin.validation import registry
from twin.validation.check import (
    CONFIRMED,
    CONSISTENT,
    CORRECTED,
    FAILED,
    NOT_CHECKABLE,
    REFUTED,
    REPRODUCED,
    UNDECIDED,
    Check,
    CheckResult,
    Chosen,
    Explanation,
)
from twin.validation.group import CheckGroup, Context
from twin.validation.registry import UnknownCheck, select
from twin.validation.row_names import names_in_files
from twin.validation.runner import run_checks

run = partial(invoke, command.app)
"""The command inside this process."""

ROOT = Path(__file__).resolve().parents[2]
PNG = b"\x89PNG\r\n\x1a\n"
FAULT = Explanation(verdict=CORRECTED, text="A factor {factor} is missing.")
CAMERA = Explanation(verdict=REFUTED, text="The camera is another one.")


def check(identifier: str = "001.table3.a", printed: float | None = 1.0, tolerance: float = 0.1, **more) -> Check:
    told = {"tells": 0.5, "against": "half", "explanations": (FAULT, CAMERA)} | more
    return Check(
        id=identifier, equation="Table 3", statement=f"Statement of {identifier}", unit="arcsec", printed=printed,
        tolerance=tolerance, because="a reason", **told,
    )  # fmt: skip


def answers(context: Context):
    """A group that finds every check to hold, and adds one artefact of each kind."""
    for k, identifier in enumerate(sorted(context.selected)):
        context.progress(k / len(context.selected), f"do {identifier}")
        yield context.check(identifier).evaluate(1.02, 0.01, "Thought about it.")
    context.add(SvgFigure("drawing", "A drawing", "Of nothing.", "<svg viewBox='0 0 1 1'><g id='mark'/></svg>"))
    context.add(PngFigure("picture", "A picture", "Of less.", PNG))
    context.add(Table("numbers", "Some numbers", "Three.", ("name [arcsec]", "value"), [("a<b", 0.5), ("c", None)]))
    context.add(Data("data", "Data", "All of it.", {"x": [1, 2]}))
    if context.folder is not None:
        (context.folder / "own.txt").write_text("mine")


def breaks(context: Context):
    """A group that answers the first of its checks and then fails."""
    yield context.check(min(context.selected)).evaluate(1.0, None, "Easy.")
    raise ValueError("no light\non the detector")


def group(prefix: str, *names: str, run=answers, seconds: float = 2.0) -> CheckGroup:
    checks = tuple(check(f"{prefix}.{name}" if name else prefix) for name in names)
    return CheckGroup(prefix, f"Group {prefix}", seconds, checks, run)


GOOD = group("001.table3", "a", "b")
NEAR = group("001.table33", "x")
LEAF = group("001.table4", "")
OTHER = group("004.eq3", "f", "p")


@pytest.fixture
def fake(monkeypatch):
    """Function: these groups in place of the real ones."""
    return lambda *groups: monkeypatch.setattr(registry, "GROUPS", groups)


# --- which checks run -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("only", "expected"),
    [
        (None, {"001.table3.a", "001.table3.b", "001.table33.x", "001.table4", "004.eq3.f", "004.eq3.p"}),
        ("001.table3", {"001.table3.a", "001.table3.b"}),
        ("001.table3,001.table4", {"001.table3.a", "001.table3.b", "001.table4"}),
        ("001.table3.b, 004", {"001.table3.b", "004.eq3.f", "004.eq3.p"}),
        ("001.table3.b,001.table3", {"001.table3.a", "001.table3.b"}),
    ],
)
def test_selection(only, expected):
    chosen = select((GOOD, NEAR, LEAF, OTHER), only)
    assert set().union(*(selection.ids for selection in chosen)) == expected
    assert all(selection.ids <= set(selection.group.ids) and selection.ids for selection in chosen)


def test_ids_read_as_text_are_those_of_all_rows():
    """Also further ids of a row."""
    found = names_in_files()
    assert sorted(found) == sorted(name for one in registry.GROUPS for check in one.checks for name in check.names)
    assert {"001.eq3", "001.eq4", "017.bundle"} <= set(found)


@pytest.mark.parametrize("only", [None, "001,017.bundle", "001.eq4"])
def test_ids_that_are_there_are_known_before_any_group_is_imported(only, monkeypatch):
    monkeypatch.delattr(registry, "GROUPS", raising=False)
    registry.require_known(only)
    with pytest.raises(UnknownCheck, match=r"did you mean '001\.eq4'"):
        registry.require_known("001.eq44")
    assert "GROUPS" not in vars(registry)


@pytest.mark.parametrize(("only", "words"), REFUSED["unknown_checks"])
def test_unknown_ids(only, words, fake, tmp_path):
    fake(GOOD, NEAR, LEAF, OTHER)
    with pytest.raises(UnknownCheck):
        select((GOOD, NEAR, LEAF, OTHER), only)
    result = run("--only", only, "--out", tmp_path / "run")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("error: ")
    for word in words:
        assert word in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_ids_are_unique_and_belong_to_a_paper():
    with pytest.raises(ValueError, match=r"twice: 001\.table3"):
        select((GOOD, GOOD), None)
    for wrong in ("002.x", "001", "001.", "001..x", "001.a b", "001.a-b"):
        with pytest.raises(ValueError, match="not an id of a check"):
            check(wrong)
    with pytest.raises(ValueError, match="another paper"):
        CheckGroup("004.x", "", 1.0, (check("001.x"),), answers)
    for checks, seconds in (((), 1.0), ((check("001.x"),), 0.0)):
        with pytest.raises(ValueError, match=r"group '001\.x' needs checks and a rough time"):
            CheckGroup("001.x", "", seconds, checks, answers)
    with pytest.raises(ValueError, match="group prefix"):
        CheckGroup("001/../x", "", 1.0, (check("001.x"),), answers)


def test_only_selected_groups_run(backend):
    told = []

    def listen(context: Context):
        told.append(context.selected)
        yield from answers(context)

    groups = (group("001.table3", "a", "b", run=listen), group("001.table4", "", run=breaks))
    validation = run_checks(select(groups, "001.table3.b"), backend, 1)
    assert told == [{"001.table3.b"}]
    assert [result.id for result in validation.results] == ["001.table3.b"]


def test_list(fake):
    fake(GOOD, OTHER)
    result = run("--list")
    assert result.exit_code == 0
    for identifier in (*GOOD.ids, *OTHER.ids):
        assert f"{identifier}  Table 3: Statement of {identifier}" in result.stdout
    assert result.stdout.count("about 2 s") == 2
    some = json.loads(run("--list", "--only", "004", "--json").stdout)["checks"]
    assert [row["id"] for row in some] == list(OTHER.ids)


# --- verdicts ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("measured", "sigma", "verdict"),
    [
        (1.0999, None, CONFIRMED),
        (1.1001, None, REFUTED),
        (1.12, 0.01, CONFIRMED),
        (1.14, 0.01, REFUTED),
        (2.0999, None, CORRECTED),
        (3.05, 0.0, REFUTED),
    ],
)
def test_a_verdict_follows_from_the_numbers(measured, sigma, verdict):
    result = check().evaluate(measured, sigma, "Measured.", explained=[2.0, 3.0], facts={"factor": 2})
    assert result.verdict == verdict
    assert (result.measured, result.sigma, result.printed) == (measured, sigma, 1.0)
    assert ("factor 2 is missing" in result.how) == (verdict == CORRECTED)
    assert ("another one" in result.how) == (measured == 3.05)
    assert ("cause is not known" in result.how) == (verdict == REFUTED and measured != 3.05)
    assert "a reason" in result.how.splitlines()[-1]
    assert check(tolerance=0.0).evaluate(1.0, None, "A count.").verdict == CONFIRMED


@pytest.mark.parametrize(
    ("comparison", "low", "high"),
    [("at most", CONFIRMED, REFUTED), ("at least", REFUTED, CONFIRMED), ("two-sided", REFUTED, REFUTED)],
)
def test_claims_of_a_limit(comparison, low, high):
    claim = check(comparison=comparison)
    assert claim.evaluate(0.5, None, "").verdict == low
    assert claim.evaluate(1.5, None, "").verdict == high
    assert claim.evaluate(1.05, None, "").verdict == claim.evaluate(0.95, None, "").verdict == CONFIRMED


def test_a_number_that_is_not_printed_needs_one_that_is_implied():
    silent = check(printed=None)
    with pytest.raises(ValueError, match="implied"):
        silent.evaluate(1.0, None, "")
    result = silent.evaluate(1.0, None, "", implied=1.05)
    assert (result.printed, result.verdict) == (None, CONFIRMED)
    assert silent.evaluate(1.0, None, "", implied=1.2).verdict == REFUTED


def test_what_the_text_does_not_print_is_not_checked():
    result = check(not_checkable="The table is lost.").without_comparison()
    assert (result.verdict, result.measured, result.how) == (NOT_CHECKABLE, None, "The table is lost.")


@pytest.mark.parametrize(("verdict", "words"), [("fine", "Input should be"), (FAILED, "no verdict to expect")])
def test_only_a_verdict_can_be_expected(verdict, words):
    with pytest.raises(ValueError, match=words):
        check(expected=verdict)


def test_another_verdict_than_the_expected_one_fails_the_command(fake, tmp_path):
    """A finding of earlier work that is no longer found is as much of a surprise as a claim that no longer holds."""

    def run_both(context: Context):
        yield context.check("001.eq5").evaluate(1.0, None, "Right as printed.")
        yield context.check("001.eq7").evaluate(2.0, None, "Twice.", explained=[2.0], facts={"factor": 2})

    known = (check("001.eq5", expected=CORRECTED), check("001.eq7", expected=CORRECTED))
    fake(CheckGroup("001.formulas", "Formulas", 1.0, known, run_both))
    result = run("--json", "--out", tmp_path / "run")
    assert result.exit_code == 1
    told = json.loads(result.stdout)["unexpected"]
    assert told == [{"id": "001.eq5", "verdict": CONFIRMED, "expected": CORRECTED}]
    assert "001.eq5 is confirmed, expected confirmed with correction: Right as printed." in result.stderr
    assert "earlier work found" in (tmp_path / "run/validation.html").read_text("utf-8")
    assert run("--json", "--only", "001.eq7").exit_code == 0


def test_a_fast_run_makes_fewer_trials(fake):
    def trials(context: Context):
        yield context.check("001.table4").evaluate(context.count(full=100, fast=7), None, "Counted.")

    (one,) = group("001.table4", "").checks
    fake(CheckGroup("001.table4", "", 600.0, (one,), trials, fast_seconds=5.0))
    for options, expected, seconds in (([], 100, 600.0), (["--fast"], 7, 5.0)):
        found = json.loads(run("--json", *options).stdout)
        assert (found["checks"][0]["measured"], found["fast"]) == (expected, bool(options))
        assert json.loads(run("--list", "--json", *options).stdout)["checks"][0]["group_seconds"] == seconds


# --- what a row can tell ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sigma", "verdict", "corrected"), [(0.13, CONFIRMED, CORRECTED), (0.14, UNDECIDED, UNDECIDED)]
)
def test_nothing_is_confirmed_that_could_not_have_failed(sigma, verdict, corrected):
    """0.1 + 3 sigma against the 0.5 to half of it."""
    result = check().evaluate(1.0, sigma, "")
    assert result.verdict == verdict
    assert result.power == pytest.approx(0.1 + 3 * sigma)
    assert ("half is 0.5 away" in result.how) == (verdict == UNDECIDED)
    assert check().evaluate(2.0, sigma, "", explained=[2.0], facts={"factor": 2}).verdict == corrected
    # what does not agree is found, however weak the row
    assert check().evaluate(3.0, sigma, "", explained=[None, 3.0]).verdict == REFUTED


@pytest.mark.parametrize(("more", "words"), REFUSED["validation_rows"])
def test_a_row_says_beforehand_what_it_tells(more, words):
    with pytest.raises(ValueError, match=words):
        check(**more)
    assert check(not_checkable="It is lost.", tells=None, against="").expected == NOT_CHECKABLE


def test_the_verdict_of_agreement_is_that_of_the_rows_basis():
    reproduced, theory = check(basis="chosen"), check(printed=None, theory="optics")
    light = Chosen.power("light", 8.0, "mW", 1.0, -1.0)
    result = reproduced.evaluate(1.0, None, "", inputs=[light])
    assert (check().expected, reproduced.expected, theory.expected) == (CONFIRMED, REPRODUCED, CONSISTENT)
    assert result.verdict == REPRODUCED
    assert theory.evaluate(1.0, None, "", 1.0).verdict == CONSISTENT
    assert reproduced.evaluate(2.0, None, "", inputs=[light]).verdict == REFUTED
    with pytest.raises(ValueError, match="inputs"):
        reproduced.evaluate(1.0, None, "")
    with pytest.raises(ValueError, match="inputs"):
        check().evaluate(1.0, None, "", inputs=[light])


@pytest.mark.parametrize(
    ("comparison", "power", "low", "high"),
    [
        ("two-sided", 1.0, 0.8, 1.2),
        ("two-sided", 2.0, 0.8**0.5, 1.2**0.5),
        ("two-sided", -1.0, 1 / 1.2, 1 / 0.8),
        ("at most", 1.0, None, 1.2),
        ("at least", 1.0, 0.8, None),
        ("two-sided", 0.0, None, None),
    ],
)
def test_how_far_a_chosen_input_can_move_before_the_row_fails(comparison, power, low, high):
    """Tolerance 0.1 and 3 sigma of 0.1 / 3 about a printed 1, all of it measured at an input of 5 mK."""
    row = check(basis="chosen", comparison=comparison)
    chosen = Chosen.power("heat", 5.0, "mK", 1.0, power)
    (found,) = row.evaluate(1.0, 0.1 / 3, "", inputs=[chosen]).inputs
    for end, expected in ((found.low, low), (found.high, high)):
        assert end == (None if expected is None else pytest.approx(5.0 * expected, rel=1e-5))
    # there it does fail
    for end, step in ((found.low, 0.99), (found.high, 1.01)):
        if end is not None:
            assert row.evaluate(chosen.response(step * end / 5.0), 0.1 / 3, "", inputs=[chosen]).verdict == REFUTED
    (lost,) = row.evaluate(1.0 - 9.0 * (comparison == "at least") + 9.0 * (comparison != "at least"), None, "",
                        inputs=[chosen]).inputs  # fmt: skip
    assert (lost.low, lost.high, lost.agrees) == (None, None, False)


def test_a_row_of_two_equations_fails_with_either():
    row = check(also=("001.eq6",), expected=CORRECTED)
    right, wrong = (row.evaluate(v, None, "", explained=[2.0], facts={"factor": 2}) for v in (2.0, 1.0))
    assert row.worse(right, right) is right
    assert row.worse(right, wrong) is row.worse(wrong, right) is wrong


def test_a_row_is_found_by_all_its_ids(fake, tmp_path):
    both = check("001.eq5", also=("001.eq4",))
    fake(CheckGroup("001.formulas", "Formulas", 1.0, (both,), answers))
    found = json.loads(run("--json", "--only", "001.eq4").stdout)["checks"]
    assert [(r["id"], r["also"]) for r in found] == [("001.eq5", ["001.eq4"])]
    assert run("--out", tmp_path / "run").exit_code == 0
    assert "| `001.eq5` = `001.eq4` |" in (tmp_path / "run/summary/README.md").read_text("utf-8")
    with pytest.raises(ValueError, match=r"twice: 001\.eq4"):
        select((CheckGroup("001.a", "", 1.0, (both,), answers), group("001.eq4", "")), None)


def test_what_neither_agrees_nor_is_explained_can_be_told():
    result = check(otherwise="Text and table contradict each other.").evaluate(3.0, None, "")
    assert (result.verdict, result.how.splitlines()[0]) == (REFUTED, "Text and table contradict each other.")


@pytest.mark.parametrize(
    "change",
    [
        {"verdict": "fine"},
        {"measured": math.nan},
        {"sigma": -1.0},
        {"measured": None},
        {"verdict": FAILED},
        {"seconds": -1.0},
    ],
)
def test_results_that_say_nothing_are_refused(change):
    good = check().evaluate(1.0, 0.01, "").to_dict()
    with pytest.raises(ValueError, match=r"001\.table3\.a"):
        CheckResult(**{**good, **change})


@pytest.mark.parametrize("measured", [math.nan, math.inf])
def test_no_verdict_on_what_is_no_number(measured):
    with pytest.raises(ValueError, match="must be finite numbers"):
        check().evaluate(measured, None, "")


# --- what goes wrong --------------------------------------------------------------------------------------------------


def test_a_failing_group_does_not_stop_the_others(fake, tmp_path):
    fake(group("001.table3", "a", "b", "c", run=breaks), OTHER)
    result = run("--out", tmp_path / "run", "--json")
    assert result.exit_code == 1
    found = {r["id"]: r for r in json.loads(result.stdout)["checks"]}
    assert list(found) == ["001.table3.a", "001.table3.b", "001.table3.c", *OTHER.ids]
    assert [r["verdict"] for r in found.values()] == [CONFIRMED, FAILED, FAILED, CONFIRMED, CONFIRMED]
    broken = found["001.table3.b"]
    assert (broken["printed"], broken["measured"], broken["sigma"]) == (1.0, None, None)
    assert "ValueError: no light on the detector" in broken["how"]
    assert "test_command.py" in broken["how"]
    assert "001.table3.b failed: Could not be computed: ValueError" in result.stderr
    assert "Traceback" not in result.stderr
    assert "no light on the detector" in (tmp_path / "run/validation.html").read_text("utf-8")


@pytest.mark.parametrize(
    ("results", "why"),
    [
        ([], "no result"),
        ([check("001.eq9").evaluate(1.0, None, "")], "does not hold"),
        ([check("001.table3.a").evaluate(1.0, None, "")] * 2, "twice"),
        ([check(f"001.table3.{name}").evaluate(1.0, None, "") for name in "abb"], "twice"),
    ],
)
def test_a_group_that_answers_wrongly_has_failed(results, why, backend):
    validation = run_checks(select([group("001.table3", "a", "b", run=lambda context: results)], None), backend, 1)
    assert [(r.id, expected) for r, expected in validation.unexpected][-1] == ("001.table3.b", CONFIRMED)
    assert why in validation.results[-1].how


def test_artefacts_of_one_name_in_a_group_are_refused(backend):
    def twice(context: Context):
        yield from ()
        for _ in range(2):
            context.add(Data("data", "Data", "All of it.", {}))

    (result,) = run_checks(select([group("001.table3", "a", run=twice)], None), backend, 1).results
    assert (result.verdict, "two artefacts data.json in one group" in result.how) == (FAILED, True)


def test_progress_runs_from_nothing_to_all(backend):
    seen = []
    groups = (group("001.table3", "a", "b", seconds=6.0), group("001.table4", "", run=breaks, seconds=4.0))
    run_checks(select(groups, None), backend, 1, progress=lambda done, text: seen.append((done, text)))
    times = [done for done, _ in seen]
    assert times == sorted(times)
    assert (times[0], times[-1]) == (0.0, 10.0)
    assert (3.0, "001.table3: do 001.table3.b") in seen
