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
from analysis.orbit import forward_intersection, null_space, three_line_model
from analysis.orbit.third_difference import third_difference
from optics.numerics.backend import load_backend
from tests.validation.undrawn import undrawn
from twin.orbit.calibration import schemes as calibration_schemes
from twin.orbit.calibration.campaign_adjustment import calibrated_alone
from twin.run.random_streams import stream
from twin.validation import registry
from twin.validation.paper_003 import exact, fields, flights, model, rendered
from twin.validation.paper_003.exact import FIELDS, changed, setup_of, without_light
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
    campaign = exact.exact_campaign(setup, stream(SEED, 0))
    return setup, campaign, rendered.rendered_marks(setup, campaign, stream(SEED, 1))


@cache
def campaigns():
    setup = without_light(setup_of(FIELDS))
    points = setup.test.points.model_copy(update={"control": 40, "check": 30})
    return flights.flown(changed(setup, points=points), SEED.spawn(CAMPAIGNS), lambda _: None)


@cache
def alone(campaign, one):
    return calibrated_alone(campaign, one)


SEEN = {}
PLACES_SEEN = exact.places_seen


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
    monkeypatch.setattr(exact, "exact_campaign", lambda *_: exact_passes()[1])
    monkeypatch.setattr(exact, "places_seen", places_seen)
    monkeypatch.setattr(rendered, "rendered_marks", lambda *_: exact_passes()[2])
    monkeypatch.setattr(flights, "flown", lambda *_: campaigns())
    monkeypatch.setattr(flights, "calibrated_alone", alone)

    def check(ids):
        chosen = [Selection(group, frozenset(ids) & frozenset(group.ids)) for group in GROUPS]
        with undrawn():
            results = run_checks([c for c in chosen if c.ids], load_backend("llvm"), 1, fast=True).results
        assert {r.id for r in results} == set(ids)
        return {r.id for r in results if r.verdict != EXPECTED[r.id]}

    return check


# ---- broken formulas ----


def of_model(change):
    """The rigorous model with changed (camera, rays, bias), everywhere."""

    def broken(camera, rays, ground, bias, offset):
        camera, rays, bias = change(camera, rays, bias)
        return three_line_model.misclosure(camera, rays, ground, bias, offset)

    def patch(monkeypatch):
        for module in (exact, rendered, normal_equations, forward_intersection):
            monkeypatch.setattr(module, "misclosure", broken)

    return patch


def inner(*factors):
    """f, x, y times factors."""
    return lambda c, r, b: (c.with_interior(c.interior * np.array(factors)), r, b)


def of_equations(change):
    """Coefficients (n, 2, 6) by f, x, y, roll, pitch, yaw, changed."""

    def broken(*given):
        by = three_line_model.partials(*given)
        both = change(np.concatenate([by.interior, by.bias], axis=2).copy())
        return replace(by, interior=both[:, :, :3], bias=both[:, :, 3:])

    def patch(monkeypatch):
        for module in (exact, normal_equations, forward_intersection):
            monkeypatch.setattr(module, "partials", broken)

    return patch


def times(k, factor):
    def change(both):
        both[:, :, k] *= factor
        return both

    return of_equations(change)


def swapped(a, b):
    def change(both):
        both[:, :, [a, b]] = both[:, :, [b, a]]
        return both

    return of_equations(change)


def overlooked(monkeypatch):
    monkeypatch.setattr(null_space, "WORST", np.inf)


def of_differences(change):
    """RMS of the differences and the sigma that follows."""

    def broken(time, series):
        found = third_difference(time, series)
        rms = change(np.asarray(series), found.rms)
        return replace(found, rms=rms, white_sigma=rms / np.sqrt(20.0))

    def patch(monkeypatch):
        monkeypatch.setattr(fields, "third_difference", broken)

    return patch


def rms_of(weights):
    def change(series, _):
        rows = sum(w * series[k : len(series) - 3 + k] for k, w in enumerate(weights))
        return np.sqrt(np.mean(rows**2, axis=0))

    return change


def of_mean(change):
    """Mean parameters of a scheme: its cameras and bias, changed."""
    right = calibration_schemes.averaged

    def broken(campaign, results, names):
        return change(campaign, results, names, *right(campaign, results, names))

    def patch(monkeypatch):
        monkeypatch.setattr(calibration_schemes, "averaged", broken)

    return patch


def scaled_interior(factor):
    """Corrections to the laboratory's interior times a factor."""

    def change(campaign, results, names, cameras, bias):
        start = campaign.laboratory
        made = {
            k: c.with_interior(start[k].interior + factor * (c.interior - start[k].interior))
            for k, c in cameras.items()
        }
        return made, bias

    return change


def of_errors(change):
    """RMS in plan and height at check points, changed."""
    right = forward_intersection.check_errors

    def broken(*given):
        found = right(*given)
        plan, height = change(found.plan_rms, found.height_rms)
        return replace(found, plan_rms=plan, height_rms=height)

    def patch(monkeypatch):
        monkeypatch.setattr(calibration_schemes, "check_errors", broken)

    return patch


MODEL, EQUATIONS = ("003.model",), ("003.equations",)
RANK, STEPWISE = ("003.model.rank",), ("003.model.stepwise",)
PLAN = tuple(f"003.scheme{k}.plan" for k in range(1, 6))
LIMITS = ("003.scale50000.plan", "003.scale50000.height", "003.before.plan", "003.before.height")

# formula -> mutation -> how it is broken, and which verdicts must turn
MUTATIONS = {
    '003.model': {
        'y0 twice': (of_model(inner(1, 1, 2)), MODEL),
        'forward and backward swapped': (of_model(lambda c, r, b: (replace(c, to_body=c.to_body.T), r, b)), MODEL),
    },
    '003.equations': {
        "pitch sign": (times(4, -1.0), EQUATIONS),
    },
    '003.model.rank': {
        'open combination overlooked': (overlooked, RANK),
    },
    '003.table2': {
        'one sign': (of_differences(rms_of((1, 3, 3, 1))), ("003.table2.white",)),
    },
    '003.scheme': {
        'bias sign': (of_mean(lambda *g: (g[3], -g[4])), PLAN),
        'interior twice': (of_mean(scaled_interior(2.0)), ("003.scheme1.height",)),
    },
    '003.accuracy': {
        'twice': (of_errors(lambda p, h: (2 * p, 2 * h)), LIMITS[2:]),
    },
}  # fmt: skip
CASES = [(formula, name) for formula, row in MUTATIONS.items() for name in row]


@pytest.mark.second
@pytest.mark.parametrize(("formula", "name"), CASES)
def test_a_broken_formula_turns_a_verdict(formula, name, turned, monkeypatch):
    broken, ids = MUTATIONS[formula][name]
    if formula in ("003.scheme", "003.accuracy"):
        for campaign in campaigns():
            for one in campaign.passes:
                alone(campaign, one)  # before anything is broken
    broken(monkeypatch)
    assert turned(ids) == set(ids)
