"""Every formula of paper 001, deliberately broken: at least one verdict must then be another one than expected.

Images are rendered and measured once; a mutation changes the analysis or the paper's arithmetic alone.

Mutations that nothing can see are not listed:

- any in the rows that are refuted (001.eq7.piston, 001.table1.d_gamma_by_d_beta, ...): a broken formula leaves them
  refuted, but for another number;
- the sign of (1): L is a length, and both sides of it are taken without sign;
- left and right swapped in (2), (3), (8), (12), their joint forms and (9): sums and products of both sides;
- signs in (12) and in Table 5: squares;
- the arctangent in (2), (3), (5): at 1.3 and 20 arcsec it differs from its argument by 1e-9 at most.

The first one of each group but the slowest belongs to the second tier, which .ci/run runs; all others, and that
unbroken formulas turn nothing (twin.validate shows it), to the third.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np
import pytest

from analysis.monitor import autocollimator, intersection_angle, monitoring, recovery
from analysis.units import ARCSEC
from scenes.specs.load import load_autocollimator_test
from tests.tiers import one_of_each
from twin.laboratory.autocollimator_bench import Reader, run_autocollimator_test
from twin.validation.checks.check import REPRODUCED, UNDECIDED
from twin.validation.checks.group import Context
from twin.validation.paper_001 import budget, budget_checks, formulas, formulas_images, joint, table2
from twin.validation.registry import Selection
from twin.validation.runner import run_checks

SEED = 2
D_ALPHA, D_BETA, D_GAMMA, D_F = range(4)
LIMITS = "001.table2.mean_error 001.table2.below_1"
"""What section 3.1.3 says of the largest of Table 2's mean differences."""


@dataclass(frozen=True)
class Mutation:
    """A broken formula.

    Attributes:
        formula: id of the equation or table row that it breaks.
        name: what is broken.
        group: whose verdicts must turn.
        turns: ids that must turn, and no id but these may.
        apply: patches it in.
    """

    formula: str
    name: str
    group: str
    turns: str
    apply: Callable[[pytest.MonkeyPatch], None]


@pytest.fixture(scope="module")
def groups(backend):
    """Name -> (group, module, what ``measured`` found): everything that is rendered, once."""
    experiments = {}
    out = {}
    for module in (formulas, joint, budget_checks):
        group = module.GROUP
        checks = {check.id: check for check in group.checks}
        chosen = set(checks)
        if module is budget_checks:
            # another instrument, and no formula is in it
            chosen -= {c for c in chosen if c.endswith("halved")}
        context = Context(backend, SEED, frozenset(chosen), checks, fast=True, experiments=experiments)
        if module is budget_checks:
            context.count = lambda full, fast: {60: 20, 80: 60}[fast]  # sigmas twice as large do for factors of two
        out[module.__name__.rpartition(".")[2]] = (module, module.measured(context), frozenset(chosen))
    setup = load_autocollimator_test()
    reader = Reader(setup, backend)
    ideal = run_autocollimator_test(setup, backend, seed=SEED, ideal=True, reader=reader)
    real = tuple(run_autocollimator_test(setup, backend, seed=SEED + n, reader=reader) for n in range(12))
    ids = frozenset(table2.GROUP.ids)
    out["table2"] = (table2, table2.Measured(setup, reader, ideal, real), ids)
    return out


@pytest.fixture
def turned(groups, backend, monkeypatch):
    """Function: run a group on its images and say which verdicts are not the expected ones."""

    def run(name):
        module, images, ids = groups[name]
        monkeypatch.setattr(module, "measured", lambda context: images)
        monkeypatch.setattr(table2, "_show", lambda context, found: None)  # draws with one more trace
        checks = run_checks([Selection(module.GROUP, ids)], backend, SEED, fast=True)
        assert not [r.how for r in checks.results if r.verdict == "failed"]
        return {result.id for result, _ in checks.unexpected}

    return run


# --- how things are broken --------------------------------------------------------------------------------------------


def factors(estimator: str, row: int, change: Callable[[np.ndarray], np.ndarray]):
    """Break one row of an estimator's factors, (4,) [left row, left column, right row, right column]."""

    def apply(patch: pytest.MonkeyPatch) -> None:
        sound = monitoring.coefficients

        def broken(name, geometry):
            matrix = sound(name, geometry).copy()
            if name == estimator:
                matrix[row] = change(matrix[row])
            return matrix

        patch.setattr(monitoring, "coefficients", broken)

    return apply


def formula(module, name: str, broken: Callable[[Callable], Callable]):
    """Break a function of a module: ``broken`` takes the sound one."""
    return lambda patch: patch.setattr(module, name, broken(getattr(module, name)))


def negated(row):
    return -row


def doubled(row):
    return 2 * row


def halved(row):
    return row / 2


def swapped(row):
    return row[[2, 3, 0, 1]]


def x_for_y(row):
    return row[[1, 0, 3, 2]]


def scaled(by: float):
    return lambda sound: lambda *args: by * np.asarray(sound(*args))


def pair(change: Callable):
    """Break a function that returns two parts."""
    return lambda sound: lambda left, right: change(sound, left, right)


def relation(change: Callable[[str, int, float, float], float]):
    """Break the relation of Table 2 wherever it is looked up."""

    def apply(patch: pytest.MonkeyPatch) -> None:
        sound = autocollimator.relation_factor

        def broken(axis, unit, between):
            return change(axis, unit, between, sound(axis, unit, between))

        for module in (autocollimator, table2):
            patch.setattr(module, "relation_factor", broken)

    return apply


def plain_sum(errors):
    return sum(budget.frame_mean(e) if name == "centroid" else e for name, e in errors.items())


def twice_the(angle):
    return intersection_angle.IntersectionAngleChange(2 * angle.change_rad, angle.sigma_rad)


SINGLE = {
    "001.eq2": (D_BETA, "001.eq2 001.eq2.cos2"),
    "001.eq3": (D_ALPHA, "001.eq3 001.eq3.cos2"),
    "001.eq5": (D_GAMMA, "001.eq5"),
    "001.eq7": (D_F, "001.eq7"),
}
JOINT = {
    "001.table1.d_beta": (D_BETA, "001.table1.d_beta"),
    "001.table1.d_alpha": (D_ALPHA, "001.table1.d_alpha 001.fig4.angle"),
    "001.table1.d_gamma": (D_GAMMA, "001.table1.d_gamma"),
    "001.table1.d_f": (D_F, "001.table1.d_f"),
}
ALSO_X_FOR_Y = {
    "001.table1.d_gamma": " 001.table1.d_gamma_by_d_beta",
    "001.table1.d_f": " 001.table1.d_f_by_d_alpha",
}
"""Refuted rows, which a formula that reads nothing of the change confirms."""
CHANGES = {"sign": negated, "twice": doubled, "half": halved, "x for y": x_for_y}
DIFFERENCES = ("001.eq5", "001.eq7", "001.table1.d_gamma", "001.table1.d_f")
"""Formulas in which left and right count with opposite signs."""


def by_factors() -> list[Mutation]:
    """(2), (3), (5), (7) and Table 1's joint forms, in analysis/monitor/monitoring.py; Table 5 through the same
    factors."""
    out = []
    for estimator, rows, group in (("paper_single", SINGLE, "formulas"), ("paper_joint", JOINT, "joint")):
        for identifier, (row, turns) in rows.items():
            for name, change in CHANGES.items():
                more = ALSO_X_FOR_Y.get(identifier, "") if name == "x for y" else ""
                out.append(Mutation(identifier, name, group, turns + more, factors(estimator, row, change)))
            if identifier in DIFFERENCES:
                name = "left and right swapped"
                out.append(Mutation(identifier, name, group, turns, factors(estimator, row, swapped)))
    for name, row in (("d_beta", D_BETA), ("d_alpha", D_ALPHA), ("d_gamma", D_GAMMA), ("d_f", D_F)):
        for what, change in (("twice", doubled), ("half", halved)):
            identifier = f"001.table5.{name}"
            turns = f"{identifier}.propagated"
            out.append(Mutation(identifier, what, "budget_checks", turns, factors("paper_single", row, change)))
    turns = "001.table5.d_f.by_table1"
    out.append(Mutation("001.table5.d_f", "(7)'s factor", "budget_checks", turns, factors("paper_joint", D_F, doubled)))
    return out


MUTATIONS = (
    *(
        Mutation("001.eq1", name, "formulas", "001.eq1.displacement",
                 formula(autocollimator, "mirror_rotation", scaled(by)))
        for name, by in (("twice", 2), ("half", 0.5))
    ),
    Mutation(
        "001.eq1",
        "tan θ for tan 2θ",
        "formulas",
        "001.eq1.displacement",
        formula(autocollimator, "mirror_rotation", lambda sound: lambda shift, f: np.arctan(shift / f)),
    ),
    *by_factors(),
    *(
        Mutation(f"001.eq{number}", name, "formulas", f"001.eq{number + 1}", formula(formulas_images, function, broken))
        for number, function in ((4, "roll_displacement"), (6, "scale_displacement"))
        for name, broken in (
            ("sign", scaled(-1)),
            ("twice", scaled(2)),
            ("half", scaled(0.5)),
            ("left and right swapped", lambda sound: lambda left, right: sound(right, left)),
        )
    ),
    Mutation("001.eq8", "sign", "joint", "001.eq8.y 001.eq8.x",
             formula(formulas_images, "superposed", lambda sound: lambda first, second: first - second)),
    Mutation("001.eq8", "twice", "joint", "001.eq8.y 001.eq8.x", formula(formulas_images, "superposed", scaled(2))),
    Mutation("001.eq8", "one twice", "joint", "001.eq8.y 001.eq8.x",
             formula(formulas_images, "superposed", lambda sound: lambda first, second: first + 2 * second)),
    *(
        Mutation("001.eq9", f"{name} of {parameter}", "joint", f"001.eq9.{parameter}",
                 formula(formulas_images, function, scaled(by)))
        for parameter, function in (("d_f", "right_of_focal_length"), ("d_beta", "right_of_rotation"))
        for name, by in (("sign", -1), ("twice", 2))
    ),
    *(
        Mutation(equation, name, "joint", turns, formula(formulas_images, function, pair(change)))
        for equation, function, sums, differences in (
            ("001.eq10", "parts_along", "001.eq10.d_beta", "001.eq10.d_f"),
            ("001.eq11", "parts_across", "001.eq11.d_alpha", "001.eq11.d_gamma"),
        )
        for name, turns, change in (
            ("no half", f"{sums} {differences}", lambda sound, left, right: tuple(2 * p for p in sound(left, right))),
            ("left and right swapped", differences, lambda sound, left, right: sound(right, left)),
            ("sum for difference", f"{sums} {differences}", lambda sound, left, right: sound(left, right)[::-1]),
            ("sign", f"{sums} {differences}", lambda sound, left, right: tuple(-p for p in sound(left, right))),
        )
    ),
    Mutation("001.fig4", "forward and backward swapped", "joint", "001.fig4.angle",
             formula(recovery.intersection_angle, "exact", lambda sound: lambda f, b, *given: sound(b, f, *given))),
    Mutation("001.fig4", "twice", "joint", "001.fig4.angle",
             formula(intersection_angle, "exact", lambda sound: lambda *given: twice_the(sound(*given)))),
    Mutation("001.eq12", "frames not averaged", "budget_checks", "001.eq12.frames 001.table4.printed_lines",
             formula(budget, "frame_mean", lambda sound: lambda error, frames=9: error)),
    Mutation("001.eq12", "divided by 9", "budget_checks", "001.eq12.frames 001.table4.printed_lines",
             formula(budget, "frame_mean", lambda sound: lambda error, frames=9: error / frames)),
    Mutation("001.eq12", "plain sum", "budget_checks",
             "001.eq12 001.table4.printed_lines 001.table4.root_sum",
             formula(budget, "root_sum", lambda sound: plain_sum)),
    Mutation("001.eq12", "twice", "budget_checks", "001.eq12 001.table4.printed_lines 001.table4.root_sum",
             formula(budget, "root_sum", scaled(2))),
    Mutation("001.table4", "a quarter", "budget_checks", "001.eq12 001.table4.printed_lines 001.table4.root_sum",
             formula(budget, "root_sum", scaled(0.25))),
    Mutation("001.table5.d_gamma", "spots taken as one", "budget_checks",
             "001.table5.d_beta.propagated 001.table5.d_alpha.propagated 001.table5.d_gamma.propagated "
             "001.table5.d_f.propagated 001.table5.d_f.by_table1",
             formula(budget_checks, "_TABLE_4", lambda sound: sound * np.sqrt(2))),
    Mutation("001.table2", "sine for cosine about Y", "table2", f"001.table2.y 001.table2.relation.y {LIMITS}",
             relation(lambda axis, unit, b, sound: np.sin(b) if (axis, unit) == ("Y", 2) else sound)),
    Mutation("001.table2", "cosine for sine about Z", "table2",
             f"001.table2.z 001.table2.relation.z {LIMITS}",
             relation(lambda axis, unit, b, sound: np.cos(b) if (axis, unit) == ("Z", 2) else sound)),
    Mutation("001.table2", "cosine about X", "table2", f"001.table2.x 001.table2.relation.x {LIMITS}",
             relation(lambda axis, unit, b, sound: np.cos(b) if (axis, unit) == ("X", 2) else sound)),
    *(
        Mutation("001.table2", f"{name} about {axis}", "table2",
                 f"001.table2.{axis.lower()} 001.table2.relation.{axis.lower()} {LIMITS}",
                 relation(lambda a, unit, b, sound, axis=axis, by=by: by * sound if (a, unit) == (axis, 2) else sound))
        for axis in "XYZ"
        for name, by in (("sign", -1.0), ("twice", 2.0))
    ),
)  # fmt: skip


# --- the tests --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["formulas", "joint", "budget_checks", "table2"])
def test_unbroken_every_verdict_is_the_expected_one(name, turned):
    assert turned(name) == set()


@pytest.mark.parametrize(
    "mutation", one_of_each(attrgetter("group"), MUTATIONS, ["formulas"]), ids=lambda m: f"{m.formula}: {m.name}"
)
def test_a_broken_formula_turns_a_verdict(mutation, turned, monkeypatch):
    mutation.apply(monkeypatch)
    assert turned(mutation.group) == set(mutation.turns.split())


@pytest.mark.second
def test_worse_benches_do_not_keep_table_2(groups, backend, monkeypatch):
    """With 2.5 times the declared errors the mean difference is 0.9 arcsec, and six benches know it to 0.2 arcsec: no
    agreement with 0.5.
    """
    _, found, _ = groups["table2"]
    errors = found.setup.spec.errors
    worse = errors.model_copy(update={name: 2.5 * value for name, value in errors})
    setup = replace(found.setup, spec=found.setup.spec.model_copy(update={"errors": worse}))
    real = tuple(run_autocollimator_test(setup, backend, seed=SEED + n, reader=found.reader) for n in range(6))
    images = table2.Measured(setup, found.reader, found.ideal, real)
    monkeypatch.setattr(table2, "measured", lambda context: images)
    monkeypatch.setattr(table2, "_show", lambda context, found: None)
    ids = frozenset(LIMITS.split())
    results = {r.id: r for r in run_checks([Selection(table2.GROUP, ids)], backend, SEED, fast=True).results}
    within = results["001.table2.mean_error"]
    assert 0.5 < within.measured < within.printed + within.power  # agrees, but for its noise
    assert within.verdict == UNDECIDED
    assert results["001.table2.below_1"].verdict != REPRODUCED


@pytest.mark.second
def test_every_formula_is_broken():
    """All numbered equations, Table 1's four joint forms, and the tables that follow from formulas."""
    broken = {m.formula for m in MUTATIONS}
    numbered = {f"001.eq{n}" for n in range(1, 13)}
    tables = {f"001.table{n}.{p}" for n in (1, 5) for p in ("d_alpha", "d_beta", "d_gamma", "d_f")}
    assert broken == numbered | tables | {"001.table2", "001.table4", "001.fig4"}
    rows = {
        match.group()
        for module in (formulas, joint, budget_checks)
        for check in module.GROUP.checks
        for name in check.names
        if (match := re.match(r"001\.eq\d+", name))
    }
    assert rows == numbered


@pytest.mark.second
def test_what_is_not_listed_cannot_be_seen():
    """The mutations that the module's text leaves out, so that it stays true."""
    geometry = monitoring.MonitorGeometry(7.7, 0.73, 12e-6, 0.0, 0.047)
    for name in ("paper_single", "paper_joint"):
        matrix = monitoring.coefficients(name, geometry)
        np.testing.assert_array_equal(swapped(matrix[D_BETA]), matrix[D_BETA])
        np.testing.assert_array_equal(swapped(matrix[D_ALPHA]), matrix[D_ALPHA])
    assert abs(np.arctan(20 * ARCSEC) / (20 * ARCSEC) - 1) < 1e-8
