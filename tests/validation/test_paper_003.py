"""The checks of paper 003: what is compared with what, that the exact ones find what they should, what the rows of lost
tables say, and, marked slow, all of them.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from analysis.arrays import ARCSEC
from analysis.orbit.forward_intersection import CheckErrors
from optics.numerics.backend import load_backend
from tests.validation.mutated import undrawn
from twin.validation import registry
from twin.validation.checks.check import CORRECTED, NOT_CHECKABLE, median_of
from twin.validation.checks.group import Context
from twin.validation.paper_003 import fields, flights, model, rendered
from twin.validation.registry import Selection
from twin.validation.runner import run_checks

GROUPS = tuple(group for group in registry.GROUPS if group.prefix.startswith("003."))
CHECKS = {check.id: check for group in GROUPS for check in group.checks}
LOST = {"003.table1", "003.table6", "003.table7", "003.fig1", "003.fig2", "003.fig3"}


def found(ids, seed=1):
    chosen = [Selection(group, frozenset(ids) & frozenset(group.ids)) for group in GROUPS]
    with undrawn():
        return run_checks([c for c in chosen if c.ids], load_backend("llvm"), seed, fast=True)


def test_lost_tables_need_no_work(monkeypatch):
    def build(*_):
        raise AssertionError("not asked for")

    monkeypatch.setattr(flights, "flown", build)
    monkeypatch.setattr(model, "exact_and_images", build)
    monkeypatch.setattr(model, "image_setup", build)
    results = found(LOST).results
    assert {r.id: r.verdict for r in results} == dict.fromkeys(LOST, NOT_CHECKABLE)
    assert all(len(r.how) > 60 and r.measured is None for r in results)


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
    assert rendered._centroid(image, 30, 30) == pytest.approx([30.0, 29.5])
    for row, column in ((30, 1), (58, 30), (1, 30), (30, 58)):
        with pytest.raises(ValueError, match="too near to the window's border"):
            rendered._centroid(image, row, column)
    at, ground = np.array([[1.0, 1.0], [9.0, 9.0]]), np.array([[4.0], [5.0]])
    near = (np.array([9.1, 1.2]), np.array([9.0, 1.0]))
    assert rendered._matched(near, at, ground).tolist() == [[5.0], [4.0]]
    with pytest.raises(ValueError, match="two marks in the image are nearest to one"):
        rendered._matched((np.array([1.0, 99.0]), np.array([1.0, 99.0])), at, ground)


def test_the_worst_field_counts_in_what_images_give(monkeypatch):
    """Of two fields, one worse in plan and one in height, after and not before they are calibrated."""
    names = [*model.FREE_INTERIOR, *model.ROLL_PITCH, "yaw"]

    def field(name, check, before, after, error):
        errors = (CheckErrors(np.zeros((check, 3)), *rms, check) for rms in (before, after))
        own = dict.fromkeys(names, error)
        way = SimpleNamespace(rounds=9)
        return rendered.FromImages(name, 20, check, way, None, own, 1e-12 * np.eye(len(names)), *errors)

    both = field("A", 8, (90.0, 70.0), (2.0, 5.0), 1e-6), field("B", 50, (80.0, 60.0), (3.0, 4.0), 3e-6)
    monkeypatch.setattr(rendered, "measured", lambda *_: None)
    monkeypatch.setattr(rendered, "calibrated", lambda _: both)
    ids = [f"003.model.{name}" for name in ("bias", "interior", "plan", "height")]
    context = Context(None, 1, frozenset(ids), CHECKS, fast=True)
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
