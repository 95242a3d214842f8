"""Every warning of the reports in orbit and of the laboratory is told when, and only when, it holds.

A run is what its warnings look at, with values at the edge of what needs no warning; each case changes one of them.
"""

from collections.abc import Callable
from types import SimpleNamespace as Ns
from typing import Any

import numpy as np
import pytest

from tests.twin.orbit_files import REFUSALS
from twin.laboratory import distortion_report, focus_report, turntable_report
from twin.orbit.angle import angle_report
from twin.orbit.block import block_report
from twin.orbit.calibration import calibration_report, influences
from twin.orbit.calibration.calibration_numbers import FIT, STEPWISE
from twin.orbit.conventions import check_report
from twin.orbit.export import export_report
from twin.orbit.export.export_report import quality_answers
from twin.orbit.export.ground_accuracy import TOGETHER
from twin.orbit.export.rational_polynomial import residual_sigma
from twin.orbit.images import simulate_report
from twin.orbit.matching import match_report
from twin.orbit.monitoring import monitoring_numbers, monitoring_report
from twin.orbit.monitoring.monitoring_numbers import PROPAGATION, SMOOTHING

FIELDS = {"body": "base", "labels": ["x"], "sizes": [2.0], "sigmas": [0.1], "units": ["um"], "rivals": {}}
JUMP = Ns(**FIELDS, after=0, until=60, log_ratio=9)
LAW = type("Law", (), {"p_value": 0.9e-3, "__str__": lambda _: "readings are alike"})()
IDS = np.array(["a", "b"], object)
OBJECTS: dict[str, Any] = {
    **{"IDS": IDS, "A": IDS[:1], "B": IDS[1:], "LAWS": [LAW]},
    **{"JUMPED": (JUMP,), "DOUBT": Ns(course_doubt=lambda times, spots: f"a doubt at {times[1]}")},
    **{"NO_JUMPS": {60.0: Ns(jumps=())}, "JUMPS": {60.0: Ns(jumps=(JUMP,))}},
    "FIT": Ns(value=lambda name: 0.3e-5 if name == "constant" else 5.5, sigma=lambda _: 1e-5),
    "WIDE_FIT": Ns(value=lambda name: 0.31e-5 if name == "constant" else 5.5, sigma=lambda _: 1e-5),
}


class Run(dict):
    """A run, or a part of one, whose entries are attributes as well."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return self[name]


def made(value: Any) -> Any:
    """Return what a value of the table stands for: mappings are parts of a run, lists of numbers arrays."""
    match value:
        case dict():
            return Run({k: made(v) for k, v in value.items()})
        case str() if value.startswith("="):
            return OBJECTS[value[1:]]
        case list():
            numbers = np.array(value) if value and not isinstance(value[0], str | dict) else None
            return numbers if numbers is not None and numbers.dtype.kind in "bif" else [made(v) for v in value]
    return value


UNTOLD = {"spec": {"errors": {"star_tracker": {"drift": None}}}}
WARNINGS: dict[str, Callable[[Any], Any]] = {
    "block": block_report._warnings,
    "check": check_report._warnings,
    "match": match_report._warnings,
    "simulate": simulate_report._warnings,
    "export": export_report._warnings,
    "quality": export_report.quality_warnings,
    "control": lambda run: export_report.quality_warnings(run)[:-1],
    "calibration": calibration_report._warnings,
    "drift": lambda drift: influences.drift_warnings(made(UNTOLD), drift),
    "steps": lambda run: influences.step_warnings(run.all),
    "angle": angle_report._warnings,
    "monitor": monitoring_report._warnings,
    "loop": monitoring_report._loop_warnings,
    "distortion": lambda run: distortion_report._warnings(run, run.data),
    "focus": lambda run: focus_report._warnings(run, run.data),
    "turntable": lambda run: turntable_report._warnings(run, run.data),
}


def put(run: Any, path: str, value: Any) -> None:
    """Change the value at a path of entries and numbers."""
    *way, last = path.split(".")
    for name in way:
        run = run[int(name)] if name.isdigit() else run[name]
    run[last] = made(value)


@pytest.fixture(autouse=True)
def any_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kinds of runs are told by their classes, and some parts have tests of their own."""
    for module, name in (
        (export_report.export_run, "SceneSource"),
        (angle_report, "SimulatedAngleRun"),
        (distortion_report, "SimulatedDistortion"),
        (distortion_report, "MeasuredDistortionSpec"),
        (influences, "MeasuredCalibrationSpec"),
    ):
        monkeypatch.setattr(module, name, Run)
    for module, name in ((calibration_report, "CALIBRATION"), (monitoring_numbers, "MONITOR")):
        monkeypatch.setattr(module, name, Ns(warnings=lambda run: []))
    for name in ("drift_warnings", "step_warnings"):
        monkeypatch.setattr(calibration_report, name, lambda *_: [])
    monkeypatch.setattr(calibration_report, "intersection_fit", lambda campaign, *_: campaign.meeting)


def warned(name: str, path: str = "", value: Any = None) -> list[str]:
    """Return the warnings of a run that needs none, or of one in which a value has changed."""
    run = made(REFUSALS["quiet"][name])
    if path:
        put(run, path, value)
    if name == "calibration":
        run.campaign["meeting"] = run.meeting
    return list(WARNINGS[name](run))


@pytest.mark.parametrize("name", WARNINGS)
def test_a_run_that_needs_no_warning_has_none(name: str) -> None:
    assert warned(name) == []


@pytest.mark.parametrize("name", WARNINGS)
def test_every_warning_is_told_when_it_holds(name: str) -> None:
    for path, value, words in REFUSALS["warnings"][name]:
        (found,) = warned(name, path, value)
        assert words in found, path


def test_tables_of_accuracy_and_control_have_their_units() -> None:
    """Places in degrees, sigmas as roots of variances, the correction with its sigma, and residuals with theirs."""
    seen = np.array([True, True, False])
    places = {"longitude": np.radians([116.0, 117.0, 0.0]), "latitude": np.radians([40.0, 41.0, 0.0]), "height": 300.0}
    covariance = np.array([np.diag([4.0, 9.0, 16.0])] * 3)
    errors = {"ce90": np.array([5.0, 7.0, 99.0]), "le90": np.array([2.0, 3.0, 99.0]), "covariance": covariance}
    numbers = {"line": np.array([1.0, 2.0, 0.0]), "pixel": np.array([3.0, 4.0, 0.0]), "horizontal": lambda: (1.5, 0.5)}
    maps = {"nadir": Ns(valid=seen, **places, **errors, **numbers)}
    table, _, grid = export_report._map_section(maps).artefacts
    assert table.rows == [["nadir", 6.0, 7.0, 2.5, 3.0, 1.5, 0.5]]
    assert grid.rows[0] == pytest.approx(("nadir", 1.0, 3.0, 116.0, 40.0, 300.0, 5.0, 2.0, 2.0, 3.0, 4.0))
    assert [row[3] for row in grid.rows] == pytest.approx([116.0, 117.0])
    at, spread = np.array([[3.0, -4.0]]), np.array([np.diag([0.04, 0.25])])
    correction = Ns(at=lambda *_: at, covariance_at=lambda *_: spread, middle=(0.0, 0.0), chi_square=5.0, freedom=2)
    correction = Ns(**vars(correction), residual=np.array([[0.1, 0.2]]), used=np.array([False]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export_report, "residual_sigma", lambda _: np.array([[0.3, 0.4]]))
        control = {"nadir": Ns(correction=correction, names=IDS[:1])}
        table, full = export_report.control_section(control).artefacts
    assert table.rows == [("nadir", 3.0, pytest.approx(0.2), -4.0, pytest.approx(0.5), 5.0, 2)]
    assert full.rows == [("nadir", "a", 0.1, 0.3, 0.2, 0.4, "rejected")]


def test_sentences_of_accuracy_and_residuals_name_their_own_numbers() -> None:
    """Points that are used, the bias after the correction, the largest CE90 and the LE90 of intersected points."""
    correction = Ns(used=np.array([True, False]), kind="shift")
    corrected_polynomial = Ns(correction=correction, after=Ns(bias_m=0.25), names=IDS)
    maps = {
        TOGETHER: Ns(ce90=np.array([1.0, 2.0]), le90=np.array([3.0, np.nan])),
        "nadir": Ns(ce90=np.array([4.0, np.nan])),
    }
    first, second, third = quality_answers(Ns(control={"nadir": corrected_polynomial}, maps=maps))
    assert first.startswith("1 of 2 control points correct the polynomials of nadir by a shift, to 0.25 m")
    assert second == "CE90 is at most 4.00 m, of points of nadir"
    assert third == "LE90 of intersected points is at most 3.00 m"
    assert residual_sigma(Ns(variance=np.array([[[4.0, 1.0], [1.0, 9.0]]]))) == pytest.approx(np.array([[2.0, 3.0]]))


def test_verdicts_among_the_numbers_warn_when_they_are_false() -> None:
    """Fit and stepwise solution of a calibration, the monitor's scatter, its shifts and its smoothed heights."""
    spec = Ns(errors=Ns(switched_on=True), setup=None)
    run = Ns(together=Ns(p_value=1e-3), campaign=Ns(spec=spec, simulated=Ns(drift=())), truth=None)
    assert FIT["agrees"].of(run) is True
    run.together.p_value = 0.9e-3
    assert FIT["agrees"].of(run) is False
    assert "larger than their sigmas predict (p = 0.0009): biases" in FIT["agrees"].warning(run)
    spec.errors.switched_on = False
    assert FIT["agrees"].of(run) is None
    right = Ns(agrees=True, spread=3.0, sigma=2.0, limits=(0.8, 1.2), chi_square=9.5, limit=8.25, largest_ratio=5.0)
    wrong = Ns(**vars(right) | {"agrees": False})
    for verdict, whole, part, words in (
        (STEPWISE["converged"], "stepwise", None, "has not converged after 7 rounds"),
        (PROPAGATION["agrees"], "scatter", None, "ratio 1.5, limits 0.80 to 1.20"),
        (SMOOTHING["shifts_agree"], "smoothed", "consistency", "contradict the prior: chi-square 9.5, limit 8.25"),
        (SMOOTHING["agrees"], "smoothed", None, "reach 5 times their sigma, limit 8.25"),
    ):
        for one, value in ((right, True), (wrong, False)):
            found = Ns(**vars(one), converged=value, rounds=7)
            run = Ns(**{whole: found if part is None else Ns(**{part: found})})
            assert verdict.of(run) is value
            assert words in verdict.warning(run)
