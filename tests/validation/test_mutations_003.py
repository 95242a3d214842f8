"""Broken formulas of paper 003 turn verdicts: sign, factor two, swapped. Marks are rendered and campaigns flown once;
only what is made of them is broken. The paper's equations are lost: these are the rebuilt ones.

Not listed, for nothing can be seen of them: the sign of all third differences (their RMS is taken), steps of the
stepwise solution at half their length (they end at the same place, later), and the sign of pitch in the open
combination (the rank is the same).

That unbroken formulas turn nothing, `python -m twin.validate` shows.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from analysis.calibration import normal_equations
from analysis.orbit import calibration_parameters, forward_intersection
from optics.numerics.backend import load_backend
from tests.validation.mutated import break_it, undrawn, with_fields
from twin.framework.random_streams import stream
from twin.orbit.calibration import schemes as calibration_schemes
from twin.orbit.calibration.campaign_adjustment import calibrated_alone
from twin.validation import registry
from twin.validation.paper_003 import fields, model
from twin.validation.paper_003.model import FIELDS, changed, setup_of, without_light
from twin.validation.registry import Selection
from twin.validation.runner import run_checks

GROUPS = tuple(group for group in registry.GROUPS if group.prefix in ("003.model", "003.fields"))
EXPECTED = {check.id: check.expected for group in GROUPS for check in group.checks}
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
PLACES_SEEN = model.places_seen


def places_seen(setup, one, line, interior, bias):
    key = line, *interior, *bias
    if key not in SEEN:
        SEEN[key] = PLACES_SEEN(setup, one, line, interior, bias)
    return SEEN[key]


@pytest.fixture
def turned(monkeypatch):
    """Function: ids -> those whose verdict is not the expected one, on what is cached."""
    exact_passes(), campaigns()  # before anything is patched
    monkeypatch.setattr(model, "exact_and_images", lambda: exact_passes()[0])
    monkeypatch.setattr(model, "exact_campaign", lambda *_: exact_passes()[1])
    monkeypatch.setattr(model, "places_seen", places_seen)
    monkeypatch.setattr(model, "rendered_marks", lambda *_: exact_passes()[2])
    monkeypatch.setattr(fields, "flown", lambda *_: campaigns())
    monkeypatch.setattr(fields, "calibrated_alone", alone)

    def check(ids):
        chosen = [Selection(group, frozenset(ids) & frozenset(group.ids)) for group in GROUPS]
        with undrawn():
            results = run_checks([c for c in chosen if c.ids], load_backend("llvm"), 1, fast=True).results
        assert {r.id for r in results} == set(ids)
        return {r.id for r in results if r.verdict != EXPECTED[r.id]}

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

    return calibration_schemes, "averaged", broken


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
