"""The checks of paper 004: what is compared with what, that the cheap ones find what they should and can fail, and,
marked slow, all of them.
"""

from functools import cache

import numpy as np
import pytest

from analysis.turntable.angle_fits import FITS
from optics.backend import load_backend
from twin.validation import (
    laboratory_004,
    laboratory_004_distortion,
    laboratory_004_equations,
    laboratory_004_turntable,
    registry,
)
from twin.validation.check import AGREES, DIFFERS, DOUBTFUL, FAILED
from twin.validation.laboratory_004_turntable import FittedTable
from twin.validation.registry import select
from twin.validation.runner import run_checks

# id -> printed, tolerance, unit, comparison
STATED = {
    "004.table1.P": (0.20, 0.020, "1", "equal"),
    "004.table1.B1": (0.36, 0.036, "1", "equal"),
    "004.table1.B2": (0.36, 0.036, "1", "equal"),
    "004.table1.B3": (0.37, 0.037, "1", "equal"),
    "004.table1.B4": (0.36, 0.036, "1", "equal"),
    "004.confocal": (0.04, 0.0, "mm", "at most"),
    "004.level": (1.0, 0.0, "arcmin", "at most"),
    "004.eq2": (None, 1e-6, "µm", "equal"),
    "004.eq3": (None, 1e-6, "µm", "equal"),
    "004.eq4": (None, 1e-6, "µm", "equal"),
    "004.eq1.constant": (2.3, 0.05, "µm", "at most"),
    "004.p.ignored": (2.3, 0.05, "µm", "at most"),
    "004.repeat": (0.081, 0.0162, "arcsec", "equal"),
    "004.chauvenet": (0.037, 0.0074, "arcsec", "equal"),
    "004.chauvenet.mean": (0.037, 0.00512, "arcsec", "equal"),
    "004.fit": (0.2, 0.0, "arcsec", "at most"),
    "004.network": (None, 0.5, "1", "at most"),
    "004.p": (1.0, 9.0, "1", "at most"),
    "004.distortion": (2.3, 0.05, "µm", "at most"),
    "004.distance": (None, 0.5, "1", "equal"),
    "004.compensation": (35.0, 11.0, "%", "equal"),
    "004.table2.reduction": (35.0, 1.0, "%", "equal"),
}
CHEAP = "004.eq1,004.eq2,004.eq3,004.eq4,004.p.ignored,004.repeat,004.chauvenet,004.table2"


@cache
def results(only, seed=1):
    validation = run_checks(select(laboratory_004.GROUPS, only), load_backend("llvm"), seed)
    return {result.id: result for result in validation.results}


def test_what_is_compared():
    checks = {check.id: check for group in laboratory_004.GROUPS for check in group.checks}
    assert set(checks) == set(STATED)
    for identifier, (printed, tolerance, unit, comparison) in STATED.items():
        check = checks[identifier]
        assert (check.printed, check.unit, check.comparison) == (printed, unit, comparison)
        assert check.tolerance == pytest.approx(tolerance, rel=1e-3)
        assert len(check.because) > 10
    assert set(laboratory_004.GROUPS) <= set(registry.GROUPS)


@pytest.mark.parametrize(
    ("identifier", "value", "accuracy", "verdict"),
    [
        # 5.512 m times 0.2 arcsec is 5.34 um, two thirds of it 3.56
        ("004.eq1.constant", 3.56, 0.01, DOUBTFUL),
        # 7 um tan^2 of half a line of 0.2247 m over 5.512 m
        ("004.p.ignored", 0.0029, 1e-4, AGREES),
        # sums of squares of the columns, added up from the printed page
        ("004.table2.reduction", 100 * (1 - (53.16 / 92.04) ** 0.5), 0.01, DOUBTFUL),
        ("004.chauvenet.mean", 0.081 / 10**0.5, 0.002, DOUBTFUL),
    ],
)
def test_cheap_checks(identifier, value, accuracy, verdict):
    result = results(CHEAP)[identifier]
    assert result.measured == pytest.approx(value, abs=accuracy)
    assert result.verdict == verdict
    assert "cause is not known" not in result.how


def test_printed_solutions_are_least_squares_to_rounding():
    found = results(CHEAP)
    assert set(found) == {i for i in STATED if any(i == p or i.startswith(f"{p}.") for p in CHEAP.split(","))}
    for name in ("004.eq2", "004.eq3", "004.eq4"):
        assert found[name].verdict == AGREES
        assert 0.0 <= found[name].measured < 1e-6


@pytest.mark.parametrize(
    ("name", "function", "change"),
    [
        ("004.eq2", "principal_distance_and_point", lambda both: (both[0], -both[1])),
        ("004.eq3", "principal_distance", lambda f: f * (1 + 1e-10)),
        ("004.eq4", "principal_point", lambda p: -p),
    ],
)
def test_a_wrong_formula_is_found(name, function, change, monkeypatch):
    right = getattr(laboratory_004_equations, function)
    monkeypatch.setattr(laboratory_004_equations, function, lambda *given: change(right(*given)))
    (result,) = run_checks(select(laboratory_004.GROUPS, name), load_backend("llvm"), 1).results
    assert result.verdict == DIFFERS


def test_only_what_is_needed_runs(monkeypatch):
    def build(*_):
        raise AssertionError("not asked for")

    monkeypatch.setattr(laboratory_004_distortion.DistortionBench, "build", build)
    monkeypatch.setattr(laboratory_004_turntable, "fit_table", build)
    monkeypatch.setattr(laboratory_004, "FocusBench", build)
    found = run_checks(select(laboratory_004.GROUPS, "004.table2,004.repeat"), load_backend("llvm"), 2).results
    assert {r.id: r.verdict for r in found} == {"004.repeat": AGREES, "004.table2.reduction": DOUBTFUL}


@pytest.mark.parametrize(
    ("network", "value", "verdict"), [(0.9, 1.0, AGREES), (1.05, 2.0, DIFFERS), (1.25, 4.0, DIFFERS)]
)
def test_rank_of_the_network(network, value, verdict, monkeypatch):
    made = {**{name: 1.0 + 0.1 * k for k, name in enumerate(FITS)}, "network": network}
    monkeypatch.setattr(laboratory_004_turntable, "fit_table", lambda *_: FittedTable("cubic_spline", made))
    group = laboratory_004_turntable.GROUP
    (run,) = run_checks(select([group], "004.network"), load_backend("llvm"), 1).runs
    (result,) = run.results
    assert (result.measured, result.verdict) == (value, verdict)
    rows = {row[0]: row for row in run.artefacts[0].rows}
    assert float(rows["network"][1]) == value


def test_reading_of_one_table_can_be_repeated():
    assert results("004.repeat", 3)["004.repeat"].measured == results(CHEAP, 3)["004.repeat"].measured
    assert results("004.repeat", 3)["004.repeat"].measured != results(CHEAP)["004.repeat"].measured


@pytest.mark.slow
def test_everything():
    """Every check gives a number; verdicts that no seed should change, and artefacts."""
    validation = run_checks(select(laboratory_004.GROUPS, None), load_backend("llvm"), 1)
    found = {r.id: r for r in validation.results}
    assert set(found) == set(STATED)
    assert not any(r.verdict == FAILED for r in found.values())
    for name in STATED:
        if name.startswith("004.table1"):
            assert found[name].sigma < 0.002
    for name in ("004.confocal", "004.level", "004.fit", "004.distortion", "004.distance"):
        assert found[name].verdict == AGREES
    assert found["004.network"].verdict == DIFFERS
    assert found["004.p"].verdict == DOUBTFUL
    assert found["004.p"].measured > 50
    artefacts = {a.name: a for run in validation.runs for a in run.artefacts}
    assert set(artefacts) == {"table1", "fits", "table2", "reduction"}
    paper, *simulated = artefacts["table2"].rows
    assert [float(cell) for cell in paper[1:]] == [1.294, 0.983, 24.0, 0.898, 0.662, 26.3, 3.5, 2.2, 37.1]
    assert np.all(np.isfinite([[float(cell) for cell in row[1:]] for row in simulated]))
