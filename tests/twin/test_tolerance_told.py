"""What a tolerance run tells beside its numbers: warnings, moves of compensators, whether an allocation is reached."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scenes.specs.load import LIBRARY
from scenes.specs.tolerance import ToleranceSetup, resolve_tolerance
from scenes.yaml.yaml_file import dump_yaml, read_yaml
from twin.study.runs.plan import Plan
from twin.tolerance import allocation, given_warnings, samples, tolerance_run
from twin.tolerance.merit_models import sensitivities
from twin.tolerance.samples import Workforce, draw_samples, study_of
from twin.tolerance.tolerance_bench import ToleranceBench
from twin.tolerance.tolerance_report import tolerance_report
from twin.tolerance.tolerance_run import TOLERANCE, run_tolerance

BUDGET: dict[str, Any] = {
    "instrument": "gf7",
    "tolerances": {
        "despace": {"motion": "M2 shift z", "limit": "20 um"},
        "tilt": {"motion": "M2 rotate x about centre", "limit": "10 arcsec"},
        "figure": {"motion": "M3 figure", "limit": "5 nm", "terms": ["Z5", "Z7"]},
    },
    "compensators": {
        "focus": {"motion": "focal_plane shift z", "range": "1 mm"},
        "turn": {"motion": "focal_plane rotate x", "range": "5 arcmin"},
    },
    "merits": {
        "wavefront": {"kind": "wavefront", "at_most": 0.06, "fields": [[0.0, 0.0], [1.0, 0.0]]},
        "f": {"kind": "principal_distance", "at_most": "0.5 mm"},
    },
    "samples": 20,
    "seed": 3,
}


def budget(folder: Path, **changes: Any) -> ToleranceSetup:
    """The budget with other keys at its top, read from a file."""
    file = folder / "budget.yaml"
    file.write_text(dump_yaml({**BUDGET, **changes}), "utf-8")
    return resolve_tolerance(file)


def test_warnings_of_instrument_and_engine_reach_the_report(backend, tmp_path, monkeypatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(given_warnings, "blur_warnings", lambda setup, backend: ("the camera is blurred",))
    monkeypatch.setattr(given_warnings, "unstated_shadows", lambda model, way: "M2 stands in its beam")
    monkeypatch.setattr(
        given_warnings, "moved_into_beams", lambda *state: ("left: M2 has moved and would take 3 rays",)
    )

    def drawn(*given: Any) -> Any:
        force: Workforce = given[5]
        force.warn("a chunk is corrupt")
        return draw_samples(*given[:5], replace(force, journal=None), *given[6:])

    monkeypatch.setattr(tolerance_run, "draw_samples", drawn)
    run = run_tolerance(budget(tmp_path), backend, force=Workforce(warn=told.append))
    assert run.warnings[:4] == (
        "the camera is blurred",
        "camera gf7: M2 stands in its beam",
        "a chunk is corrupt",
        "in 10 of the 10 worst cameras, left: M2 has moved and would take 3 rays",
    )
    assert told == ["a chunk is corrupt"]
    assert tolerance_report(run).warnings == run.warnings


def test_a_camera_whose_own_parts_stand_in_its_beam_is_told(backend, tmp_path) -> None:
    """As the commands for cameras tell it; the file states no shadow at all."""
    data: dict[str, Any] = dict(read_yaml(LIBRARY / "cameras" / "cassegrain.yaml").data)
    first, second = (data["mirrors"][name] for name in ("M1", "M2"))
    data["mirrors"] = {"M1": {key: value for key, value in first.items() if key != "edges"}, "M2": second}
    file = tmp_path / "bare.yaml"
    file.write_text(dump_yaml(data), "utf-8")
    wavefront = {"kind": "wavefront", "at_most": 0.1, "fields": [[0.0, 0.0]]}
    tolerances = {"tilt": {"motion": "M2 rotate x", "limit": "5 arcsec"}}
    setup = budget(tmp_path, instrument=str(file), tolerances=tolerances, compensators={}, merits={"w": wavefront})
    found = given_warnings.given_warnings(setup, ToleranceBench(setup, backend))
    assert any("its own parts stand in its beam" in text for text in found)


def test_what_the_engine_of_studies_warns_of_is_passed_on(backend, tmp_path, monkeypatch) -> None:
    told: list[str] = []
    setup = budget(tmp_path, limits={"memory": "1 GB"})
    bench = ToleranceBench(setup, backend)
    plan = Plan.of(study_of(setup, bench, 20, 3))
    assert samples._workers(plan, Workforce(workers=8, warn=told.append)) == 2
    assert told == ["2 workers instead of 8: no more fit into the budget's 1 GB"]
    seen = []

    class Halted(Exception):
        pass

    def engine(plan: Any, store: Any, name: str, progress: Any) -> Any:
        progress.warn("the processes need more")
        seen.append(name)
        raise Halted

    monkeypatch.setattr(samples, "Engine", engine)
    force = Workforce(1, journal=tmp_path / "journal", warn=told.append)
    with pytest.raises(Halted):
        draw_samples(setup, bench, backend, 20, 3, force)
    assert seen
    assert told[-1] == "the processes need more"


@pytest.mark.second
def test_moves_of_compensators_stand_beside_each_sensitivity(backend, tmp_path) -> None:
    setup = budget(tmp_path)
    run = run_tolerance(setup, backend)
    bench = run.bench
    ends = np.zeros((2, len(bench.numbers)))
    ends[:, 0] = (-1.0, 1.0)
    moved = bench.try_out(ends * bench.sizes).moves
    np.testing.assert_allclose(sensitivities(bench).moves[0], moved, rtol=1e-6)
    numbers = TOLERANCE(run)["tolerances"]
    assert numbers["despace"]["moves_at_plus"]["focus"].endswith(" um")
    assert float(numbers["despace"]["moves_at_plus"]["focus"].split()[0]) == pytest.approx(1e6 * moved[1, 0], rel=1e-6)
    assert numbers["figure"]["moves_at_plus"] == {"focus": None, "turn": None}


@pytest.mark.parametrize("loose", [30.0, pytest.param(1.0, marks=pytest.mark.second)])
def test_an_allocation_is_reached_by_the_limits_of_its_table(loose: float, backend, tmp_path, monkeypatch) -> None:
    """Graded limits that come out too loose are not reported as if they were those before rounding."""
    setup = budget(tmp_path, allocation={"target": 0.8})
    bench = ToleranceBench(setup, backend)
    found = sensitivities(bench)
    drawn = draw_samples(setup, bench, backend, 60, 3, Workforce())
    graded = allocation._graded

    def too_loose(*given: Any) -> Any:
        limits, rounded = graded(*given)
        return limits, rounded * loose

    monkeypatch.setattr(allocation, "_graded", too_loose)
    monkeypatch.setattr(allocation, "ROUNDS", 2)
    spec = setup.test.allocation
    assert spec is not None
    told = allocation.allocate(setup, bench, found.model, drawn, spec)
    assert told.unrounded
    assert told.reached == (loose == 1.0)
    assert (told.predicted[1] >= spec.target) == told.reached
