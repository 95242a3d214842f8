"""The checks of paper 003: what is compared with what, that the exact ones find what they should, what the rows of lost
tables say, and, marked slow, all of them.

Broken formulas of paper 003 turn verdicts: sign, factor two, swapped. Marks are rendered and campaigns flown once;
only what is made of them is broken. The paper's equations are lost: these are the rebuilt ones.

Not listed, for nothing can be seen of them: the sign of all third differences (their RMS is taken), steps of the
stepwise solution at half their length (they end at the same place, later), and the sign of pitch in the open
combination (the rank is the same).

That unbroken formulas turn nothing, `python -m twin.validate` shows.
"""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from analysis.arrays import ARCSEC
from analysis.calibration import normal_equations
from analysis.orbit import calibration_parameters, forward_intersection
from analysis.orbit.forward_intersection import CheckErrors
from optics.numerics.backend import load_backend
from tests.validation.mutated import break_it, with_fields
from twin.framework.procedure import stream
from twin.orbit.calibration import schemes as calibration_schemes
from twin.orbit.calibration.campaign_adjustment import calibrated_alone
from twin.validation import registry
from twin.validation.check import CORRECTED, NOT_CHECKABLE, median_of
from twin.validation.group import Context
from twin.validation.paper_003 import fields, model
from twin.validation.paper_003.model import FIELDS, changed, setup_of, without_light
from twin.validation.registry import Selection
from twin.validation.runner import run_checks

GROUPS = tuple(group for group in registry.GROUPS if group.prefix.startswith("003."))
CHECKS = {check.id: check for group in GROUPS for check in group.checks}
LOST = {"003.table1", "003.table6", "003.table7", "003.fig1", "003.fig2", "003.fig3"}


def found(ids, seed=1):
    chosen = [Selection(group, frozenset(ids) & frozenset(group.ids)) for group in GROUPS]
    return run_checks([c for c in chosen if c.ids], load_backend("llvm"), seed, fast=True)


def test_lost_tables_need_no_work(monkeypatch):
    def build(*_):
        raise AssertionError("not asked for")

    monkeypatch.setattr(fields, "flown", build)
    monkeypatch.setattr(model, "exact_and_images", build)
    monkeypatch.setattr(model, "image_setup", build)
    results = found(LOST).results
    assert {r.id: r.verdict for r in results} == dict.fromkeys(LOST, NOT_CHECKABLE)
    assert all(len(r.how) > 60 and r.measured is None for r in results)


@pytest.mark.parametrize("wanted", [True, False])
def test_table_2_is_computed_where_it_is_asked_for(monkeypatch, wanted):
    """Its images cost more than all else of these checks."""
    for name in ("flown", "flights_of", "_biases", "_schemes", "_findings"):
        monkeypatch.setattr(fields, name, lambda *_: [])
    for name in ("_slope", "_interior"):
        monkeypatch.setattr(fields, name, lambda *_: None)
    monkeypatch.setattr(fields, "_quality", lambda *_: ["quality"])
    context = SimpleNamespace(
        count=lambda *_: 1, seed=1, progress=lambda *_: None, wants=lambda *ids: wanted and ids == ("003.table2",)
    )
    assert ("quality" in list(fields.run(context))) is wanted


@pytest.mark.second
def test_exact_checks_and_the_open_combination():
    """Marks to 0.01 px; the coefficients to what steps of 15 um leave; x of three lines against pitch."""
    ids = ["003.model", "003.equations", "003.equations.exact", "003.model.rank"]
    results = {r.id: r for r in found(ids).results}
    assert results["003.model"].measured < 0.01
    assert results["003.equations"].measured < 1e-7
    assert results["003.equations.exact"].measured < 1e-6
    assert results["003.model.rank"].measured == 11
    assert results["003.model.rank"].verdict == CORRECTED
    assert "forward x +1 mm" in results["003.model.rank"].how
    again = found(ids[:1]).results[0]
    assert again.measured == results["003.model"].measured


@pytest.mark.second
def test_a_few_campaigns(monkeypatch):
    """Verdicts that three campaigns are enough for, and what the report shows of them."""
    monkeypatch.setattr(fields, "FAST", 3)
    ids = ["003.table2", "003.table2.orbit", "003.table3.truth", "003.scheme5.plan", "003.before.plan"]
    validation = found(ids)
    for result in validation.results:
        assert result.verdict == CHECKS[result.id].expected, result.how
        assert "cause is not known" not in result.how
    values = {r.id: r.measured for r in validation.results}
    # noise 0.05 m, slow error 0.3 m, 63 values of the slow one: 9 %, four sigmas
    assert values["003.table2.orbit"] == pytest.approx(0.05 / np.hypot(0.05, 0.3), rel=0.36)
    assert values["003.before.plan"] == pytest.approx(111.0, abs=3.0)
    (run,) = validation.runs
    assert {a.name for a in run.artefacts} == {"schemes", "accuracy", "latitude", "biases"}


def test_marks_that_cannot_be_told_apart_are_refused():
    image = np.zeros((60, 60))
    image[30, 29:31] = 1.0
    assert model._centroid(image, 30, 30) == pytest.approx([30.0, 29.5])
    for row, column in ((30, 1), (58, 30), (1, 30), (30, 58)):
        with pytest.raises(ValueError, match="too near to the window's border"):
            model._centroid(image, row, column)
    at, ground = np.array([[1.0, 1.0], [9.0, 9.0]]), np.array([[4.0], [5.0]])
    near = (np.array([9.1, 1.2]), np.array([9.0, 1.0]))
    assert model._matched(near, at, ground).tolist() == [[5.0], [4.0]]
    with pytest.raises(ValueError, match="two marks in the image are nearest to one"):
        model._matched((np.array([1.0, 99.0]), np.array([1.0, 99.0])), at, ground)


def test_the_worst_field_counts_in_what_images_give(monkeypatch):
    """Of two fields, one worse in plan and one in height, after and not before they are calibrated."""
    names = [*model.FREE_INTERIOR, *model.ROLL_PITCH, "yaw"]

    def field(name, check, before, after, error):
        errors = (CheckErrors(np.zeros((check, 3)), *rms, check) for rms in (before, after))
        own = dict.fromkeys(names, error)
        way = SimpleNamespace(rounds=9)
        return model.FromImages(name, 20, check, way, None, own, 1e-12 * np.eye(len(names)), *errors)

    both = field("A", 8, (90.0, 70.0), (2.0, 5.0), 1e-6), field("B", 50, (80.0, 60.0), (3.0, 4.0), 3e-6)
    monkeypatch.setattr(model, "source_of", lambda *_: None)
    monkeypatch.setattr(model, "calibrated", lambda _: both)
    ids = [f"003.model.{name}" for name in ("bias", "interior", "plan", "height")]
    context = Context(None, 1, frozenset(ids), CHECKS, fast=True, texts=model.GROUP.artefacts)
    results = {r.id: r for r in model._rendered(context, np.random.SeedSequence(1))}
    assert [results[name].measured for name in ids] == pytest.approx([3e-6 / ARCSEC, 3.0, 3.0, 5.0])
    # of n errors in one direction the rms is known to a share of sqrt(1 / 2n), of 3n independent unknowns likewise
    sigmas = 1e-6 / ARCSEC / np.sqrt(4.0), 1.0 / np.sqrt(2.0 * len(model.FREE_INTERIOR)), 3.0 / 10.0, 5.0 / 4.0
    assert [results[name].sigma for name in ids] == pytest.approx(sigmas)
    assert "50 check points of B" in results[ids[2]].how
    assert "80 m before" in results[ids[2]].how
    assert "8 check points of A" in results[ids[3]].how
    assert "70 m before" in results[ids[3]].how
    (table,) = context.artefacts
    assert [row[3:] for row in table.rows[len(names) - 2 : len(names)]] == [(1e-6 / ARCSEC, 1e-6 / ARCSEC)] * 2
    assert table.rows[len(names)][3:] == pytest.approx((3.0, 1.0))


def test_median_knows_its_scatter():
    """Medians of 400 rows of 25 normal values; the scatter of 400 is known to 3.5 %, five of these."""
    rows = np.random.default_rng(5).normal(3.0, 2.0, (400, 25))
    each = np.array([median_of(row) for row in rows])
    assert each[:, 1].mean() == pytest.approx(each[:, 0].std(), rel=0.175)


# --- mutations 003 ----------------------------------------------------------------------------------------------------

CAMPAIGNS = 6
SEED = np.random.SeedSequence(11)


# ---- flown and rendered once ----


@cache
def exact_passes():
    """Set-up, exact campaign of few points, marks in its images."""
    setup = model.exact_and_images()
    points = setup.test.points.model_copy(update={"control": 30, "check": 20})
    setup = changed(setup, points=points)
    campaign = model.exact_campaign(setup, stream(SEED, 0))
    return setup, campaign, model.rendered_marks(setup, campaign, stream(SEED, 1))


@cache
def campaigns():
    setup = without_light(setup_of(FIELDS))
    points = setup.test.points.model_copy(update={"control": 40, "check": 30})
    return fields.flown(changed(setup, points=points), SEED.spawn(CAMPAIGNS), lambda _: None)


@cache
def alone(campaign, one):
    return calibrated_alone(campaign, one)


SEEN = {}
IMAGE_POSITIONS = model.image_positions


def image_positions(setup, one, line, interior, bias):
    key = line, *interior, *bias
    if key not in SEEN:
        SEEN[key] = IMAGE_POSITIONS(setup, one, line, interior, bias)
    return SEEN[key]


@pytest.fixture
def turned(monkeypatch):
    """Function: ids -> those whose verdict is not the expected one, on what is cached."""
    exact_passes(), campaigns()  # before anything is patched
    monkeypatch.setattr(model, "exact_and_images", lambda: exact_passes()[0])
    monkeypatch.setattr(model, "exact_campaign", lambda *_: exact_passes()[1])
    monkeypatch.setattr(model, "image_positions", image_positions)
    monkeypatch.setattr(model, "rendered_marks", lambda *_: exact_passes()[2])
    monkeypatch.setattr(fields, "flown", lambda *_: campaigns())
    monkeypatch.setattr(fields, "calibrated_alone", alone)

    def check(ids):
        results = found(ids).results
        assert {r.id for r in results} == set(ids)
        return {r.id for r in results if r.verdict != CHECKS[r.id].expected}

    return check


@pytest.mark.second
def test_sigmas_of_biases_and_interior_are_those_of_the_fields_alone():
    one = campaigns()[0]
    found = fields.flights_of([one])
    for k, field in enumerate(one.passes):
        sigma = alone(one, field).sigma
        assert found.bias_sigma[0, k].tolist() == [sigma[f"{field.name} {axis}"] for axis in ("roll", "pitch", "yaw")]
        assert found.interior_sigma[0, k].tolist() == [sigma[name] for name in fields.INNER]


# ---- broken formulas ----


EQUATIONS_OF = (model, normal_equations, forward_intersection)


def of_model(change):
    """The rigorous model of a changed camera, everywhere."""
    return EQUATIONS_OF, "misclosure", lambda right: lambda camera, *given: right(change(camera), *given)


def pitch_sign(right):
    """Coefficients of roll, pitch and yaw, (n, 2, 3), with pitch turned round."""
    return lambda *given: replace(right(*given), bias=right(*given).bias * np.array([1.0, -1.0, 1.0]))


def one_sign(right):
    """RMS of the differences with all signs alike, and the sigma that follows."""

    def broken(time, series):
        rows = sum(w * series[k : len(series) - 3 + k] for k, w in enumerate((1, 3, 3, 1)))
        rms = np.sqrt(np.mean(rows**2, axis=0))
        return replace(right(time, series), rms=rms, white_sigma=rms / np.sqrt(20.0))

    return broken


def of_mean(change):
    """Mean parameters of a scheme: its cameras and bias, changed."""

    def broken(right):
        return lambda campaign, *given: change(campaign.laboratory, *right(campaign, *given))

    return calibration_schemes, "mean_parameters", broken


def interior_twice(start, cameras, bias):
    """Corrections to the laboratory's interior times two."""
    made = {k: c.with_interior(2.0 * c.interior - start[k].interior) for k, c in cameras.items()}
    return made, bias


MODEL, EQUATIONS = ("003.model",), ("003.equations",)
RANK = ("003.model.rank",)
PLAN = tuple(f"003.scheme{k}.plan" for k in range(1, 6))
LIMITS = ("003.before.plan", "003.before.height")

# formula -> mutation -> where, what and how it is broken, and which verdicts must turn
MUTATIONS = {
    ("003.model", "y0 twice"): (*of_model(lambda c: c.with_interior(c.interior * np.array([1, 1, 2]))), MODEL),
    ("003.model", "forward and backward swapped"): (*of_model(lambda c: replace(c, to_body=c.to_body.T)), MODEL),
    ("003.equations", "pitch sign"): (EQUATIONS_OF, "partials", pitch_sign, EQUATIONS),
    ("003.model.rank", "open combination overlooked"): (calibration_parameters, "WORST", lambda right: np.inf, RANK),
    ("003.table2", "one sign"): (fields, "third_difference", one_sign, ("003.table2.white",)),
    ("003.scheme", "bias sign"): (*of_mean(lambda start, cameras, bias: (cameras, -bias)), PLAN),
    ("003.scheme", "interior twice"): (*of_mean(interior_twice), ("003.scheme1.height",)),
    ("003.accuracy", "twice"): (
        calibration_schemes, "check_errors",
        with_fields(plan_rms=lambda f: 2 * f.plan_rms, height_rms=lambda f: 2 * f.height_rms), LIMITS),
}  # fmt: skip


@pytest.mark.second
@pytest.mark.parametrize(("formula", "name"), MUTATIONS)
def test_a_broken_formula_turns_a_verdict(formula, name, turned, monkeypatch):
    *where, ids = MUTATIONS[formula, name]
    if formula in ("003.scheme", "003.accuracy"):
        for campaign in campaigns():
            for one in campaign.passes:
                alone(campaign, one)  # before anything is broken
    break_it(monkeypatch, *where)
    assert turned(ids) == set(ids)
