"""Every formula of paper 001, deliberately broken: at least one verdict must then be another one than expected.

Images are rendered and measured once; a mutation changes the analysis or the paper's arithmetic alone.

Mutations that nothing can see are not listed:

- any in the rows that are refuted (001.eq7.piston, 001.table1.d_gamma_by_d_beta, ...): a broken formula leaves them
  refuted, but for another number;
- the sign of (1): L is a length, and both sides of it are taken without sign;
- left and right swapped in (2), (3), (8), (12), their joint forms and (9): sums and products of both sides;
- signs in (12) and in Table 5: squares;
- the arctangent in (2), (3), (5): at 1.3 and 20 arcsec it differs from its argument by 1e-9 at most.

That unbroken formulas turn nothing, `python -m twin.validate` shows.

Paper 001's formulas on rendered images, single and joint: their factors and verdicts.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from analysis.monitor import autocollimator, monitor_formulas, recovery
from scenes.specs.load import load_autocollimator_test
from tests.validation.mutated import break_it, times
from twin.laboratory.autocollimator_bench import Reader, run_autocollimator_test
from twin.validation.check import REPRODUCED, UNDECIDED
from twin.validation.group import Context
from twin.validation.paper_001 import budget, formulas, table2
from twin.validation.paper_001.formulas import GROUP, JOINT, JointMotions, mirror_rotations
from twin.validation.registry import Selection, select
from twin.validation.runner import run_checks

SEED = 2
D_ALPHA, D_BETA, D_GAMMA, D_F = range(4)
LIMITS = "001.table2.mean_error 001.table2.below_1"
"""What section 3.1.3 says of the largest of Table 2's mean differences."""


@pytest.fixture(scope="module")
def groups(backend):
    """Name -> (group, module, its function that renders, what that found, ids): everything that is rendered, once."""
    experiments = {}
    out = {}
    for name, module, group, render in (
        ("formulas", formulas, formulas.GROUP, "single_images"),
        ("joint", formulas, formulas.JOINT, "joint_images"),
        ("budget", budget, budget.GROUP, "measured"),
    ):
        checks = {check.id: check for check in group.checks}
        chosen = set(checks)
        if module is budget:
            # another instrument, and no formula is in it
            chosen -= {c for c in chosen if c.endswith("halved")}
        context = Context(backend, SEED, frozenset(chosen), checks, fast=True, experiments=experiments)
        if module is budget:
            context.count = lambda full, fast: {60: 20, 80: 60}[fast]  # sigmas twice as large do for factors of two
        out[name] = (group, module, render, getattr(module, render)(context), frozenset(chosen))
    setup = load_autocollimator_test()
    reader = Reader(setup, backend)
    ideal = run_autocollimator_test(setup, backend, seed=SEED, ideal=True, reader=reader)
    real = tuple(run_autocollimator_test(setup, backend, seed=SEED + n, reader=reader) for n in range(12))
    ids = frozenset(table2.GROUP.ids)
    out["table2"] = (table2.GROUP, table2, "measured", table2.Measured(setup, reader, ideal, real), ids)
    return out


@pytest.fixture
def turned(groups, backend, monkeypatch):
    """Function: run a group on its images and say which verdicts are not the expected ones."""

    def run(name):
        group, module, render, images, ids = groups[name]
        monkeypatch.setattr(module, render, lambda context: images)
        monkeypatch.setattr(table2, "_show", lambda context, found: None)  # draws with one more trace
        checks = run_checks([Selection(group, ids)], backend, SEED, fast=True)
        assert not [r.how for r in checks.results if r.verdict == "failed"]
        return {result.id for result, _ in checks.unexpected}

    return run


# --- how things are broken -------------------------------------------------------------------------------------------


def factors(estimator: str, row: int, change: Callable[[np.ndarray], np.ndarray]):
    """Break one row of an estimator's factors, (4,) [left row, left column, right row, right column]."""

    def broken(right):
        def wrong(name, geometry):
            matrix = right(name, geometry).copy()
            if name == estimator:
                matrix[row] = change(matrix[row])
            return matrix

        return wrong

    return monitor_formulas, "coefficients", broken


def relation(axis: str, unit: int, change: Callable[[float, float], float]):
    """Break the relation of Table 2 for turns about an axis: ``change(angle between the mirrors, right value)``."""

    def broken(right):
        return lambda a, u, between: (
            change(between, right(a, u, between)) if (a, u) == (axis, unit) else right(a, u, between)
        )

    return (autocollimator, table2), "relation_factor", broken


LEFT_RIGHT, X_Y = [2, 3, 0, 1], [1, 0, 3, 2]
MUTATIONS = {
    "001.eq1: twice": (autocollimator, "mirror_rotation", times(2.0), "formulas", "001.eq1.displacement"),
    "001.eq2: half": (*factors("paper_single", D_BETA, lambda row: row / 2), "formulas", "001.eq2 001.eq2.cos2"),
    "001.eq3: x for y": (*factors("paper_single", D_ALPHA, lambda row: row[X_Y]), "formulas", "001.eq3 001.eq3.cos2"),
    "001.eq5: sign": (*factors("paper_single", D_GAMMA, lambda row: -row), "formulas", "001.eq5"),
    "001.eq7: left and right swapped": (
        *factors("paper_single", D_F, lambda row: row[LEFT_RIGHT]), "formulas", "001.eq7"),
    "001.table1.d_beta: half": (*factors("paper_joint", D_BETA, lambda row: row / 2), "joint", "001.table1.d_beta"),
    "001.table1.d_alpha: sign": (
        *factors("paper_joint", D_ALPHA, lambda row: -row), "joint", "001.table1.d_alpha 001.fig4.angle"),
    # a refuted row, too, which a formula that reads nothing of the change confirms
    "001.table1.d_gamma: x for y": (
        *factors("paper_joint", D_GAMMA, lambda row: row[X_Y]), "joint",
        "001.table1.d_gamma 001.table1.d_gamma_by_d_beta"),
    "001.table1.d_f: left and right swapped": (
        *factors("paper_joint", D_F, lambda row: row[LEFT_RIGHT]), "joint", "001.table1.d_f"),
    "001.table5.d_f: (7)'s factor": (
        *factors("paper_joint", D_F, lambda row: 2 * row), "budget", "001.table5.d_f.by_table1"),
    "001.eq4: sign": (formulas, "roll_displacement", times(-1.0), "formulas", "001.eq5"),
    "001.eq6: half": (formulas, "scale_displacement", times(0.5), "formulas", "001.eq7"),
    "001.eq8: sign": (
        formulas, "superposed", lambda right: lambda first, second: first - second, "joint",
        "001.eq8.y 001.eq8.x"),
    "001.eq9: twice": (formulas, "right_of_focal_length", times(2.0), "joint", "001.eq9.d_f"),
    "001.eq10: left and right swapped": (
        formulas, "parts_along", lambda right: lambda one, other: right(other, one), "joint", "001.eq10.d_f"),
    "001.eq11: sum for difference": (
        formulas, "parts_across", lambda right: lambda one, other: right(one, other)[::-1], "joint",
        "001.eq11.d_alpha 001.eq11.d_gamma"),
    "001.fig4: forward and backward swapped": (
        recovery, "exact", lambda right: lambda f, b, *given: right(b, f, *given), "joint",
        "001.fig4.angle"),
    "001.eq12: frames not averaged": (
        budget, "frame_mean", lambda right: lambda error, frames=9: error, "budget",
        "001.eq12.frames 001.table4.printed_lines"),
    "001.table4: a quarter": (
        budget, "root_sum", times(0.25), "budget", "001.eq12 001.table4.printed_lines 001.table4.root_sum"),
    "001.table2: cosine for sine about Z": (
        *relation("Z", 2, lambda between, right: np.cos(between)), "table2",
        f"001.table2.z 001.table2.relation.z {LIMITS}"),
    "001.table2: twice about X": (
        *relation("X", 2, lambda between, right: 2 * right), "table2",
        f"001.table2.x 001.table2.relation.x {LIMITS}"),
}  # fmt: skip
"""What is broken -> where, what and how; the group to run; its ids that must turn, and no others may."""


# --- the tests -------------------------------------------------------------------------------------------------------


@pytest.mark.second
@pytest.mark.parametrize("mutation", MUTATIONS)
def test_a_broken_formula_turns_a_verdict(mutation, turned, monkeypatch):
    *where, group, turns = MUTATIONS[mutation]
    break_it(monkeypatch, *where)
    assert turned(group) == set(turns.split())


@pytest.mark.second
def test_worse_benches_do_not_keep_table_2(groups, backend, monkeypatch):
    """With 2.5 times the declared errors the mean difference is 0.9 arcsec, and six benches know it to 0.2 arcsec: no
    agreement with 0.5.
    """
    *_, found, _ = groups["table2"]
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


# --- formulas 001 -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def single_and_joint(backend):
    validation = run_checks(select([GROUP, JOINT], None), backend, 3, fast=True)
    return {result.id: result for result in validation.results}


def test_formulas_of_paper_001(single_and_joint):
    assert set(single_and_joint) == {*GROUP.ids, *JOINT.ids}
    table = yaml.safe_load(Path(__file__).with_name("paper_001.yaml").read_text("utf-8"))
    for identifier, (value, accuracy, verdict) in table.items():
        result = single_and_joint[identifier]
        assert result.measured == pytest.approx(value, abs=accuracy), identifier
        assert result.verdict == verdict, identifier
        assert "cause is not known" not in result.how
        assert "weak" not in result.how


@pytest.mark.second
def test_the_same_seed_gives_the_same_numbers_and_another_other_noise(single_and_joint, backend):
    chosen = select([GROUP], "001.eq5")
    again, other = (run_checks(chosen, backend, seed).results[0] for seed in (3, 4))
    assert again.measured == single_and_joint["001.eq5"].measured
    difference = abs(other.measured - again.measured)
    assert 0 < difference < 6 * again.sigma


def test_a_mirror_turns_the_ray_by_twice_its_turn(backend):
    turns = np.array([1e-6, 0.01, 0.3])
    turned, moved = mirror_rotations(backend, turns)
    assert turned == pytest.approx(2 * turns, rel=1e-9)
    assert moved == pytest.approx(np.tan(2 * turns), rel=1e-9)


def test_the_slope_of_angles_scatters_as_its_sigma_says() -> None:
    """Of 2000 campaigns the scatter is known to 1.6 %."""
    rng = np.random.default_rng(5)
    true, sigma = 1e-5 * rng.normal(size=12), np.full(12, 1e-6)

    def fitted() -> tuple[float, float]:
        angle = SimpleNamespace(change_rad=0.9 * true + sigma * rng.normal(size=12), sigma_rad=sigma)
        run = SimpleNamespace(mixtures=slice(None), truth=SimpleNamespace(angle_change=true))
        run.estimates = lambda: SimpleNamespace(angle={"model": angle})
        return JointMotions.angle(run, "model")[:2]

    slope, stated = np.array([fitted() for _ in range(2000)]).T
    assert np.std(slope) == pytest.approx(stated[0], rel=0.08)
    assert np.mean(slope) == pytest.approx(0.9, abs=4.0 * stated[0] / np.sqrt(2000))
