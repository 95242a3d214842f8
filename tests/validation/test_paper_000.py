"""The checks of paper 000: what is compared with what, what comes out, and that only what is asked for runs.

Every formula of paper 000, broken on purpose: at least one verdict of its checks must turn.

Measurements are drawn once; a mutation is patched in where the checks look the formula up.
That unbroken formulas turn nothing, `python -m twin.validate` shows.

What no check can see, and why: the sign and a factor of (3), whose right side is zero; the modulus in (6) and (7), for
all normals have z = -1 in the frame used and their products are positive; a common factor of the curves of
Figs. 3 to 5, for the text prints signs, orders and ratios only.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from analysis.orbit.planes import PlaneFit, Station, sensitivity
from optics.numerics.backend import load_backend
from scenes.specs.orbit.angle import LINES, usual_angles
from tests.analysis.test_planes import DEG, SCENE, Pass, descending_pass
from tests.validation.mutated import break_it, with_fields
from twin.orbit.angle import angle_flight as flight_module
from twin.validation.check import CORRECTED, REFUTED, VERDICTS
from twin.validation.group import Context
from twin.validation.paper_000 import method, results
from twin.validation.paper_000.results import SENTENCES, Answers, Sentence
from twin.validation.registry import GROUPS as ALL
from twin.validation.registry import select
from twin.validation.runner import run_checks

GROUPS = tuple(group for group in ALL if group.prefix.startswith("000"))
EXPECTED = {check.id: check.expected for group in GROUPS for check in group.checks}
TRACED = ("000.traced", "000.centres")
"""Need an instrument traced, which takes longer than all others."""

FOUND = yaml.safe_load(Path(__file__).with_name("paper_000.yaml").read_text("utf-8"))


def checked(only, seed=3):
    return run_checks(select(GROUPS, only), load_backend("llvm"), seed, fast=True)


def test_every_check_is_listed():
    assert set(EXPECTED) == {*FOUND, *TRACED}
    assert {name: verdict for name, (_, _, verdict) in FOUND.items()} == {name: EXPECTED[name] for name in FOUND}


@pytest.mark.second
def test_what_is_found():
    results = {r.id: r for r in checked(",".join(FOUND)).results}
    for identifier, (value, accuracy, verdict) in FOUND.items():
        result = results[identifier]
        assert result.verdict == verdict, identifier
        assert "cause is not known" not in result.how, identifier
        assert result.measured is None if value is None else result.measured == pytest.approx(value, abs=accuracy)


def false_on(scene: Pass, lines: Sequence[str] = LINES) -> set[Sentence]:
    """Sentences that do not hold for a pass made by hand, without the orbit of the library's test."""
    strips = dict(zip(lines, scene.strips(1.5), strict=True))
    found = Answers.of(sensitivity(Station.of(scene.station, 0.5), strips, usual_angles(LINES)))
    return {sentence for sentence in SENTENCES if not sentence.agrees(found.rises, found.bend)}


@pytest.mark.second
@pytest.mark.parametrize("yaw", [True, False], ids=["yaw-steered", "inertial"])
def test_sentences_over_40_north_116_east(yaw):
    """Every sign and every ranking of the text, whatever the heading, but not what the checks expect to be wrong."""
    wrong = {s for s in SENTENCES if s.row.expected in (CORRECTED, REFUTED)}
    assert false_on(descending_pass(yaw=yaw)) == wrong
    assert len(wrong) == 3


@pytest.mark.second
@pytest.mark.parametrize(("lat", "lon"), [(45, 120), (40, 126), (48, 120)])
def test_farther_to_the_north_east_the_sentence_on_x_and_z_holds_too(lat, lon):
    """Which axes are alike depends on the place of the test field; the paper does not name it."""
    assert {s.kind for s in false_on(descending_pass(lat=lat * DEG, lon=lon * DEG))} == {"grows"}


def test_sentences_fail_elsewhere():
    """The southern hemisphere, and forward and backward points exchanged, contradict the paper."""
    assert "signs" in {s.kind for s in false_on(descending_pass(lat=-40 * DEG))}
    assert {s.kind for s in false_on(SCENE, LINES[::-1])} >= {"signs", "largest", "far"}


# --- mutations 000 ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drawn():
    """Measurements of the groups, made once."""
    checks = {check.id: check for group in GROUPS for check in group.checks}
    context = Context(load_backend("llvm"), 1, frozenset(checks), checks, fast=True)
    made = method.make_passes(context)
    return {
        "equations": replace(made, measured=made.measured[:120]),
        "figures": results.make_passes(context, count=2),
        "uses": method.height_passes(context),
        "off_axis": method.off_axis_passes(context),
    }


@pytest.fixture
def quick(drawn, monkeypatch):
    """The groups on these measurements, without pictures."""
    monkeypatch.setattr(method, "make_passes", lambda _: drawn["equations"])
    monkeypatch.setattr(results, "make_passes", lambda *_, **__: drawn["figures"])
    monkeypatch.setattr(method, "height_passes", lambda _: drawn["uses"])
    monkeypatch.setattr(method, "off_axis_passes", lambda _: drawn["off_axis"])
    monkeypatch.setattr(results, "_sites", lambda _: {})
    monkeypatch.setattr(results, "_show", lambda *_: None)
    return monkeypatch


def verdicts(identifiers):
    found = {r.id: r.verdict for r in checked(",".join(identifiers), seed=1).results}
    return {name: found[name] for name in identifiers}


def solved(change, form="corrected"):
    """(3), (5): slopes otherwise found; change: (matrix, right side) -> slopes."""

    def broken(right):
        def wrong(measured, which, lines=LINES):
            fits = right(measured, which, lines)
            return [_with_slopes(fit, change) if which == form else fit for fit in fits]

        return wrong

    return method, "planes_of", broken


def _with_slopes(fit, change):
    arm = fit.strip.points - fit.station.position
    slopes = change(arm[:, :2].T @ arm[:, :2], arm[:, :2].T @ arm[:, 2])
    normal = np.array([*slopes, -1.0])
    return replace(fit, normal=normal / np.linalg.norm(normal))


def ends_swapped(right):
    """(7): the angle of the first two lines, again."""

    def wrong(*planes):
        found = right(*planes)
        angle = np.arccos(abs(planes[0].normal @ planes[1].normal))
        return replace(found, printed=np.array([found.printed[0], angle]))

    return wrong


def curves(read, factor=1.0):
    """Figs. 3-5: each curve by another one's key, times a factor."""
    return results, "answers", with_fields(change=lambda f: {key: factor * f.change[read(*key)] for key in f.change})


ENDS = {"forward": "backward", "backward": "forward", "alpha": "beta", "beta": "alpha"}
AXES = {"x": "y", "y": "x", "z": "z"}
solve = np.linalg.solve
MUTATIONS = {
    ("000.eq1", "sign"): (
        PlaneFit, "coefficients",
        lambda right: property(lambda fit: (*right.fget(fit)[:2], 2 * fit.station.position[2] - right.fget(fit)[2])),
        ["000.eq1"]),
    ("000.eq2", "factor 2"): (
        method, "sum_of_squares", lambda right: lambda s, p, o: right(np.array(s) * [2.0, 1.0], p, o),
        ["000.eq2", "000.eq4"]),
    ("000.eq3", "not at zero"): (*solved(lambda m, r: solve(m, 1.0001 * r)), ["000.eq3"]),
    ("000.eq4", "x and y swapped"): (
        method, "derivatives", lambda right: lambda *given: right(*given)[::-1], ["000.eq4"]),
    ("000.eq5", "printed with the right sign"): (*solved(lambda m, r: solve(m, r), "printed"), ["000.eq5"]),
    ("000.eq5", "factor 2"): (*solved(lambda m, r: solve(m, 2 * r)), ["000.eq2", "000.eq5.angles", "000.eq6"]),
    ("000.eq6", "factor 2"): (
        method, "intersection_angles", with_fields(printed=lambda f: f.printed * [2.0, 1.0]), ["000.eq6"]),
    ("000.eq7", "ends swapped"): (method, "intersection_angles", ends_swapped, ["000.eq7"]),
    ("000.fig3", "sign"): (
        *curves(lambda *key: key, -1.0), ["000.fig3.alpha_signs", "000.fig3.beta_signs", "000.fig3.ordinate"]),
    ("000.fig4", "ends swapped"): (
        *curves(lambda what, name, axis: (ENDS.get(what, what), ENDS[name], axis)),
        ["000.fig4.forward_signs", "000.fig4.nadir_signs"]),
    ("000.fig5", "x and y swapped"): (
        *curves(lambda what, name, axis: (what, name, AXES[axis])), ["000.fig5.nadir_signs", "000.fig5.aft_x"]),
    ("000.height", "half"): (
        flight_module, "about_axis", lambda right: lambda axis, angle: right(axis, angle / 2),
        ["000.height.alpha", "000.height.beta"]),
}  # fmt: skip
"""(formula, mutation) -> where, what and how it is broken, and the checks whose verdicts must turn."""


@pytest.mark.second
@pytest.mark.parametrize(("formula", "mutation"), MUTATIONS)
def test_a_broken_formula_turns_a_verdict(formula, mutation, quick):
    *where, turned = MUTATIONS[formula, mutation]
    break_it(quick, *where)
    found = verdicts(turned)
    assert all(verdict in VERDICTS and verdict != EXPECTED[name] for name, verdict in found.items()), found
