"""Every formula of paper 000, broken on purpose: at least one verdict of its checks must turn.

Measurements are drawn once; a mutation is patched in where the checks look the formula up.
That unbroken formulas turn nothing, `python -m twin.validate` shows.

What no check can see, and why: the sign and a factor of (3), whose right side is zero; the modulus in (6) and (7), for
all normals have z = -1 in the frame used and their products are positive (tested); a common factor of the curves of
Figs. 3 to 5, for the text prints signs, orders and ratios only.
"""

from dataclasses import replace

import numpy as np
import pytest

from analysis.orbit.planes import PlaneFit
from optics.geometry.pose import about_axis
from optics.numerics.backend import load_backend
from scenes.specs.orbit.angle import LINES
from tests.validation.undrawn import undrawn
from twin.orbit.angle import angle_flight as flight_module
from twin.validation.checks.check import VERDICTS
from twin.validation.checks.group import Context
from twin.validation.paper_000 import equations_000, figures, suppositions
from twin.validation.paper_000.passes import planes_of
from twin.validation.registry import GROUPS as ALL
from twin.validation.registry import select
from twin.validation.runner import run_checks

GROUPS = tuple(group for group in ALL if group.prefix.startswith("000"))
EXPECTED = {check.id: check.expected for group in GROUPS for check in group.checks}


@pytest.fixture(scope="module")
def drawn():
    """Measurements of the groups, made once."""
    checks = {check.id: check for group in GROUPS for check in group.checks}
    context = Context(load_backend("llvm"), 1, frozenset(checks), checks, fast=True)
    made = equations_000.make_passes(context)
    return {
        "equations": replace(made, measured=made.measured[:120]),
        "figures": figures.make_passes(context, count=2),
        "uses": suppositions.height_passes(context),
        "off_axis": suppositions.off_axis_passes(context),
    }


@pytest.fixture
def quick(drawn, monkeypatch):
    """The groups on these measurements, without pictures."""
    monkeypatch.setattr(equations_000, "make_passes", lambda _: drawn["equations"])
    monkeypatch.setattr(figures, "make_passes", lambda *_, **__: drawn["figures"])
    monkeypatch.setattr(suppositions, "height_passes", lambda _: drawn["uses"])
    monkeypatch.setattr(suppositions, "off_axis_passes", lambda _: drawn["off_axis"])
    monkeypatch.setattr(figures, "_places", lambda _: {})
    monkeypatch.setattr(figures, "_show", lambda *_: None)
    return monkeypatch


def verdicts(identifiers):
    chosen = select(GROUPS, ",".join(identifiers))
    with undrawn():
        found = {r.id: r.verdict for r in run_checks(chosen, load_backend("llvm"), 1, fast=True).results}
    return {name: found[name] for name in identifiers}


def coefficients(change):
    """(1): a2 from slopes and station, otherwise than printed."""

    def patch(monkeypatch):
        def wrong(fit):
            a0, a1 = -fit.normal[:2] / fit.normal[2]
            return a0, a1, change(a0, a1, *fit.station.position)

        monkeypatch.setattr(PlaneFit, "coefficients", property(wrong))

    return patch


def squares(change):
    """(2): S of changed slopes, points and station."""

    def patch(monkeypatch):
        right = equations_000.sum_of_squares
        monkeypatch.setattr(equations_000, "sum_of_squares", lambda s, p, o: right(*change(np.array(s), p, o)))

    return patch


def sums(change):
    """(4): other sums."""

    def patch(monkeypatch):
        right = equations_000.derivatives
        monkeypatch.setattr(equations_000, "derivatives", lambda s, p, o: change(right(s, p, o), s, p, o))

    return patch


def solved(change, method="corrected"):
    """(3), (5): slopes otherwise found; change: (matrix, right side) -> slopes."""

    def patch(monkeypatch):
        def wrong(measured, which, lines=LINES):
            fits = planes_of(measured, which, lines)
            return [_with_slopes(fit, change) if which == method else fit for fit in fits]

        monkeypatch.setattr(equations_000, "planes_of", wrong)

    return patch


def _with_slopes(fit, change):
    arm = fit.strip.points - fit.station.position
    slopes = change(arm[:, :2].T @ arm[:, :2], arm[:, :2].T @ arm[:, 2])
    normal = np.array([*slopes, -1.0])
    return replace(fit, normal=normal / np.linalg.norm(normal))


def angles(change, module=equations_000, name="intersection_angles"):
    """(6), (7): change: (unit normals, printed angles) -> angles."""

    def patch(monkeypatch):
        right = getattr(module, name)

        def wrong(*planes):
            found = right(*planes)
            return replace(found, printed=change([plane.normal for plane in planes], found.printed))

        monkeypatch.setattr(module, name, wrong)

    return patch


def curves(change):
    """Figs. 3-5: change: key -> (key to read, factor)."""

    def patch(monkeypatch):
        right = figures.answers

        def wrong(*given, **named):
            found = right(*given, **named)
            read = {key: change(*key) for key in found.change}
            return replace(found, change={key: k * found.change[other] for key, (other, k) in read.items()})

        monkeypatch.setattr(figures, "answers", wrong)

    return patch


def turn(change):
    """Section 0: the line turned otherwise than by 1 arcsec in pitch."""
    return lambda monkeypatch: monkeypatch.setattr(
        flight_module, "about_axis", lambda axis, angle: about_axis(*change(axis, angle))
    )


def angle(a, b):
    return np.arccos(abs(a @ b))


def _swapped_xy(what, name, axis):
    return (what, name, {"x": "y", "y": "x", "z": "z"}[axis]), 1.0


def _swapped_ends(what, name, axis):
    return (
        {"forward": "backward", "backward": "forward"}.get(what, what),
        {"alpha": "beta", "beta": "alpha"}[name],
        axis,
    ), 1.0


solve = np.linalg.solve
MUTATIONS = {
    ("000.eq1", "sign"): (coefficients(lambda a0, a1, x, y, z: z + a0 * x + a1 * y), ["000.eq1"]),
    ("000.eq2", "factor 2"): (squares(lambda s, p, o: (s * [2.0, 1.0], p, o)), ["000.eq2", "000.eq4"]),
    ("000.eq3", "not at zero"): (solved(lambda m, r: solve(m, 1.0001 * r)), ["000.eq3"]),
    ("000.eq4", "x and y swapped"): (sums(lambda d, *_: d[::-1]), ["000.eq4"]),
    ("000.eq5", "printed with the right sign"): (solved(lambda m, r: solve(m, r), "printed"), ["000.eq5"]),
    ("000.eq5", "factor 2"): (solved(lambda m, r: solve(m, 2 * r)), ["000.eq2", "000.eq5.angles", "000.eq6"]),
    ("000.eq6", "factor 2"): (angles(lambda n, a: np.array([2 * a[0], a[1]])), ["000.eq6"]),
    ("000.eq7", "ends swapped"): (angles(lambda n, a: np.array([a[0], angle(n[0], n[1])])), ["000.eq7"]),
    ("000.fig3", "sign"): (
        curves(lambda *key: (key, -1.0)), ["000.fig3.alpha_signs", "000.fig3.beta_signs", "000.fig3.ordinate"],
    ),
    ("000.fig4", "ends swapped"): (curves(_swapped_ends), ["000.fig4.forward_signs", "000.fig4.nadir_signs"]),
    ("000.fig5", "x and y swapped"): (curves(_swapped_xy), ["000.fig5.nadir_signs", "000.fig5.aft_x"]),
    ("000.height", "half"): (turn(lambda axis, a: (axis, a / 2)), ["000.height.alpha", "000.height.beta"]),
}  # fmt: skip
"""(formula, mutation) -> how it is patched in, and the checks whose verdicts must turn."""


@pytest.mark.second
@pytest.mark.parametrize(("formula", "mutation"), MUTATIONS)
def test_a_broken_formula_turns_a_verdict(formula, mutation, quick):
    patch, turned = MUTATIONS[formula, mutation]
    patch(quick)
    found = verdicts(turned)
    assert all(verdict in VERDICTS and verdict != EXPECTED[name] for name, verdict in found.items()), found


@pytest.mark.second
def test_the_modulus_of_the_scalar_product_has_nothing_to_do(drawn):
    """In Earth-fixed axes the normals (a0, a1, -1) of the three lines have positive products."""
    for m in drawn["equations"].measured[:5]:
        forward, nadir, backward = (fit.normal for fit in planes_of(m, "corrected"))
        assert min(forward @ nadir, nadir @ backward) > 0.8
