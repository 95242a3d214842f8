"""Broken formulas of paper 004 turn verdicts: sign, factor two, swapped. Images are rendered once; only what is made of
them is broken.

Not listed, for nothing can be seen of them: the two edges' vertices swapped (best focus is their mean), the sign of an
MTF (it is a modulus), and in (4) the two sums swapped, which is its sign.

That unbroken formulas turn nothing, `python -m twin.validate` shows.
"""

import dataclasses
from functools import cache

import numpy as np
import pytest

from analysis.focal_plane.plane_fit import FocalPlaneFit
from analysis.turntable import dividing_error
from optics.numerics.backend import load_backend
from scenes.specs.resolved import resolve_distortion, resolve_focus
from twin.laboratory import distortion_run as laboratory
from twin.laboratory.distortion_bench import DistortionBench
from twin.laboratory.focus_bench import FocusBench
from twin.laboratory.focus_run import align
from twin.validation import registry
from twin.validation.checks.check import FAILED
from twin.validation.paper_004 import distortion_checks, equations_004, focus_checks
from twin.validation.registry import select
from twin.validation.runner import run_checks

GROUPS = tuple(group for group in registry.GROUPS if group.prefix.startswith("004."))
EXPECTED = {check.id: check.expected for group in GROUPS for check in group.checks}
TESTS = 4


# ---- rendered once ----


@cache
def spot_tests():
    """Bench, and per seed what was recorded, the spots, and the measured test."""
    bench = DistortionBench.build(resolve_distortion("distortion"), load_backend("llvm"))
    return bench, {int(s): laboratory.measure(bench, int(s)) for s in np.random.SeedSequence(1).generate_state(TESTS)}


@cache
def alignment():
    """One alignment with two fields instead of five, a frame instead of four."""
    setup = resolve_focus("focus")
    test = setup.test.model_copy(update={"fields": (-0.9, 0.9), "frames": 1})
    setup = setup.model_copy(update={"test": test})
    return align(FocusBench(setup, load_backend("llvm")), 1)


@cache
def _budget(right):
    """What makes the MTF, for the table beside it."""
    return right(alignment().bench)


@pytest.fixture
def turned(monkeypatch):
    """Function: ids -> those whose verdict is not the expected one, on the cached images."""
    monkeypatch.setattr(distortion_checks, "measured_tests", lambda context: list(spot_tests()[1].values()))
    right = FocusBench.budget
    monkeypatch.setattr(FocusBench, "budget", lambda self: _budget(right))
    monkeypatch.setattr(focus_checks, "FocusBench", lambda *_: alignment().bench)
    monkeypatch.setattr(focus_checks, "measured_alignments", lambda *_: [alignment()])

    def check(only):
        results = run_checks(select(GROUPS, only), load_backend("llvm"), 1, fast=True).results
        # what cannot be computed is not found wrong
        assert {result.id: result.how for result in results if result.verdict == FAILED} == {}
        return {result.id for result in results if result.verdict != EXPECTED[result.id]}

    return check


# ---- broken formulas ----


def eq1(change):
    """(1) with its terms L, f tan W and p tan^2 W changed."""

    def broken(where, turn, f, p=0.0):
        t = np.tan(turn)
        return np.asarray(change(np.asarray(where), f * t, p * t**2))

    def patch(monkeypatch):
        monkeypatch.setattr(equations_004, "distortion", broken)

    return patch


def eq2(change):
    """(2) from its sums: L tan W, L tan^2 W, and tan^2 to tan^4."""

    def broken(where, turn):
        t = np.tan(turn)
        return change(np.sum(where * t), np.sum(where * t**2), *(np.sum(t**k) for k in (2, 3, 4)))

    def patch(monkeypatch):
        monkeypatch.setattr(equations_004, "principal_distance_and_point", broken)

    return patch


def right2(lt, lt2, t2, t3, t4):
    determinant = t3**2 - t2 * t4
    return (lt2 * t3 - lt * t4) / determinant, (lt2 * t2 - lt * t3) / determinant


def eq3(change):
    """(3) from its two sums."""

    def broken(where, turn):
        t = np.tan(turn)
        return np.asarray(change(np.sum(where * t, axis=-1), np.sum(t**2, axis=-1)))

    def patch(monkeypatch):
        monkeypatch.setattr(equations_004, "principal_distance", broken)

    return patch


def eq4(change):
    """(4) from f sum tan^3, sum L tan^2 and sum tan^4."""

    def broken(where, turn, f):
        t = np.tan(turn)
        return np.asarray(change(f * np.sum(t**3), np.sum(where * t**2), np.sum(t**4)))

    def patch(monkeypatch):
        monkeypatch.setattr(equations_004, "principal_point", broken)

    return patch


def vertex(factor):
    def patch(monkeypatch):
        right = focus_checks.focus_vertex

        def broken(*given):
            found = right(*given)
            return dataclasses.replace(found, position=factor * found.position)

        monkeypatch.setattr(focus_checks, "focus_vertex", broken)

    return patch


def plane(change):
    def patch(monkeypatch):
        right = focus_checks.fit_focal_plane

        def broken(*given, **options):
            found = right(*given, **options)
            return dataclasses.replace(found, **change(found))

        monkeypatch.setattr(focus_checks, "fit_focal_plane", broken)

    return patch


def level(factor):
    def patch(monkeypatch):
        right = FocalPlaneFit.correction

        def broken(self, level=None):
            return right(self, level and dataclasses.replace(level, angle=factor * level.angle))

        monkeypatch.setattr(FocalPlaneFit, "correction", broken)

    return patch


def shims(change):
    def patch(monkeypatch):
        right = focus_checks.shim_plan

        def broken(*given):
            found = right(*given)
            return dataclasses.replace(found, change=change(found.change))

        monkeypatch.setattr(focus_checks, "shim_plan", broken)

    return patch


def edge(factor):
    """The frequency of an edge's MTF taken times a factor."""

    class Broken:
        def __init__(self, right):
            self.right = right

        def at(self, frequency):
            return self.right.at(factor * frequency)

        def frequency_at(self, value):
            return tuple(v / factor for v in self.right.frequency_at(value))

    def patch(monkeypatch):
        right = focus_checks.measure_edge
        monkeypatch.setattr(focus_checks, "measure_edge", lambda *given, **options: Broken(right(*given, **options)))

    return patch


def chauvenet_swapped(monkeypatch):
    """What is to go stays, and the other way round."""
    right = dividing_error.chauvenet

    def broken(readings, present=None):
        keep = right(readings, present)
        # where nothing is to go everything would: two readings have to stay for a mean
        out = ~keep
        out[..., :2] = True
        return out

    monkeypatch.setattr(dividing_error, "chauvenet", broken)


def reduction(change):
    def patch(monkeypatch):
        monkeypatch.setattr(distortion_checks, "lower", lambda raw, own: float(change(raw, own)))

    return patch


# without 004.eq2.distance and 004.eq2.point, which come from the fit with a constant and not from a printed equation
SPOTS = "004.eq1,004.eq2.solution,004.eq2.f,004.eq2.p,004.eq2.uneven,004.eq3,004.eq4"
PLAN = "004.alignment.defocus,004.alignment.plane,004.alignment.constraint,004.alignment.shims"
TABLE1 = "004.table1"
REPEATS = "004.turntable.repeat,004.turntable.criterion,004.turntable.chauvenet,004.turntable.chauvenet_mean"
TABLE2 = "004.table2.reduction,004.table2.mean,004.table2.largest"
EDGES = {f"004.table1.{name}" for name in ("P", "B1", "B2", "B3", "B4", "frequency")}
F2 = {"004.eq2.solution", "004.eq2.f"}
F3 = {"004.eq3.solution", "004.eq2.f"}
MOVED = {"004.alignment.plane", "004.alignment.shims"}
COLUMNS = {"004.table2.largest"}
"""The two others are refuted, and stay so by another number."""

# formula, mutation -> how, ids to run, ids that turn at least
MUTATIONS = {
    ("(1)", "sign of p"): (eq1(lambda w, f, p: w - f - p), SPOTS, {"004.eq1.constant"}),
    ("(2)", "sign in the numerator of f"): (
        eq2(lambda a, b, c, d, e: ((b * d + a * e) / (d * d - c * e), right2(a, b, c, d, e)[1])), SPOTS, F2),
    ("(3)", "twice"): (eq3(lambda lt, t2: 2 * lt / t2), SPOTS, F3),
    ("(4)", "sign of the second sum"): (eq4(lambda f, w, t4: (f + w) / t4), SPOTS, {"004.eq4.solution",
                                                                                     "004.eq4.uneven"}),
    ("focus vertex", "half"): (vertex(0.5), PLAN, {"004.alignment.defocus", *MOVED}),
    ("plane", "X' and Y' swapped"): (plane(lambda f: {"slope_x": f.slope_y, "slope_y": f.slope_x}), PLAN, MOVED),
    ("line level", "sign"): (level(-1.0), PLAN, {"004.alignment.constraint"}),
    ("shims", "left and right swapped"): (shims(lambda c: c[[1, 0, 3, 2]]), PLAN, {"004.alignment.shims"}),
    ("edge MTF", "half the frequency"): (edge(0.5), TABLE1, EDGES),
    ("Chauvenet", "kept and rejected swapped"): (
        chauvenet_swapped, REPEATS, {"004.turntable.criterion", "004.turntable.chauvenet"}),
    ("Table 2", "columns swapped"): (reduction(lambda raw, own: 100 * (1 - raw / own)), TABLE2, COLUMNS),
}  # fmt: skip


@pytest.mark.second
@pytest.mark.parametrize(("formula", "mutation"), MUTATIONS)
def test_a_broken_formula_turns_verdicts(formula, mutation, turned, monkeypatch):
    patch, only, ids = MUTATIONS[formula, mutation]
    patch(monkeypatch)
    assert ids <= turned(only)
