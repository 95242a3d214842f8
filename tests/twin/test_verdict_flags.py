"""Verdicts on results: each truth value that judges one reaches the warnings, JSON and the exit code of --strict; and a
number has the unit that its key says.
"""

import importlib
import json
import pkgutil
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import twin
from docs.site.run_pages import kept_fields
from scenes.specs.resolved import resolve
from scenes.specs.study import UNITS, unit_of
from tests.golden.digest import expanded
from tests.twin.commands import invoke
from tests.twin.test_procedure import FILE, LEVEL, program
from twin.framework.provenance import VERDICT, negative_verdicts
from twin.framework.quantity import Quantity, Record
from twin.main_job.render_job import render_job
from twin.main_job.render_results import RenderRun
from twin.main_job.verdict import judge, recovered_numbers

GOLDEN = Path(__file__).resolve().parents[1] / "golden"
WARNED_ELSEWHERE = {
    # verdicts without a warning in their record -> where it is made, or why there is none
    ("Sensitivity to a factor", "rbd_fast_agrees"): "twin.study.report.study_analysis",
    ("block.json", "agrees"): "twin.orbit.block.block_report",
    ("The loop closed and open", "stable"): "that of margins_hold",
    ("course.json", "sigma_holds"): "twin.monitor.time_series, and twin.main_job.systematics for single times",
    ("What random states gave", "sigma_holds"): "twin.uncertainty.uncertainty_report",
    ("focus.json of a measured series", "curves_agree"): "twin.laboratory.focus_report",
    ("turntable.json", "heldout_agrees"): "twin.laboratory.turntable_report",
    ("The angles of one pass", "resection_agrees"): "twin.orbit.angle.angle_report",
    ("Heights by values smoothed from the measurements at one interval", "agrees"): "a candidate",
    ("Heights by values smoothed from the measurements at one interval", "shifts_agree"): "a candidate",
    ("One start of the search and what came of it", "converged"): "a candidate",
    ("asbuilt.json", "settled"): "a number",
}
PER_SI = {
    "mas": 206264806.24709636,
    "arcsec": 206264.80624709636,
    "arcmin": 3437.746770784939,
    "deg": 57.29577951308232,
}
PER_SI |= {"pm": 1e12, "nm": 1e9, "um": 1e6, "mm": 1e3, "km": 1e-3, "us": 1e6, "ms": 1e3, "mK": 1e3, "mW": 1e3}
PER_SI |= {"percent": 1e2, "ppm": 1e6, "urad": 1e6, "mrad": 1e3}
"""How many of a unit are one of SI, by the definition of the second of arc; 1 of all others."""
STRICT = [(True, ["--strict"], 0), (False, ["--strict"], 3), (False, [], 0)]
CONVERTED_BY_HAND = frozenset("ground_um phase_margin_deg shim_changes_um shim_um shims_um".split())
"""Keys whose sources are in the unit already."""


@cache
def records() -> tuple[Record, ...]:
    """Return every record that a module of the program declares."""
    found: dict[int, Record] = {}
    for module in pkgutil.walk_packages(twin.__path__, "twin."):
        if not module.name.endswith("__main__") and ".validation" not in module.name:
            for value in vars(importlib.import_module(module.name)).values():
                if isinstance(value, Record):
                    found[id(value)] = value
    return tuple(found.values())


@pytest.mark.second
def test_every_verdict_of_a_record_has_its_warning() -> None:
    silent = {
        (re.split(r"[.,:]( |$)", record.meaning)[0], one.key)
        for record in records()
        for one in record
        if VERDICT.search(one.key) and one.warning is None
    }
    assert silent == set(WARNED_ELSEWHERE)


@pytest.mark.second
@pytest.mark.parametrize("file", sorted(GOLDEN.glob("*.json")), ids=lambda file: file.stem)
def test_a_result_with_a_negative_verdict_warns(file: Path) -> None:
    """The results of all commands: their files and what --json prints."""
    run = json.loads(file.read_text("utf-8"))["run"]
    manifest = run.get("manifest.json", {}).get("warnings", [])
    results = [(name, content) for name, content in run.items() if name.endswith("json")]
    for name, condensed in [*results, *(("stdout", one) for one in run["stdout"])]:
        content = expanded(condensed)
        if name in ("manifest.json", "validation.json") or not isinstance(content, dict) or "validat" in file.stem:
            continue
        if name.startswith("served/"):  # what a page shows beside the record's own alarms
            continue
        negative = negative_verdicts(content)
        assert not negative or manifest, (name, negative)
        # warnings of course.json are in recovered.json beside it, those of study.json in statistics.json
        assert not negative or name in ("course.json", "study.json") or content["warnings"], (name, negative)


def test_warnings_of_records_within_records() -> None:
    below: Record[tuple] = Record("", Quantity("agrees", lambda s: s[1], warning=lambda s: f"{s[0]} does not agree"))
    source = {"one": ("a", True), "named": {"x": ("b", False), "y": {"z": ("c", False)}}, "row": [("d", False)]}
    record: Record[dict] = Record(
        "",
        Quantity("one", lambda s: {"only": s["one"]}, record=below),
        Quantity("named", lambda s: s["named"], record=below),
        Quantity("row", lambda s: s["row"], record=below),
        Quantity("rows", lambda s: tuple(s["row"]), record=below),
        Quantity("none", lambda s: None, record=below),
        Quantity("holds", lambda s: np.bool_(False), warning=lambda s: "it does not hold"),
        Quantity("settled", lambda s: None, warning=lambda s: "not judged"),
    )
    told = [f"{name} does not agree" for name in "bcdd"]
    assert list(record.warnings(source)) == [*told, "it does not hold"]
    paths = ["named.x.agrees", "named.y.z.agrees", "row[0].agrees", "rows[0].agrees", "holds"]
    assert negative_verdicts(record(source)) == paths


def test_which_verdicts_are_negative() -> None:
    numbers = {
        "sigma_holds": [True, False],
        "shifts_agree": True,
        "smoothing": {"agrees": True, "intervals": [{"agrees": False}]},
        "starts": [{"converged": False}],
        "settled": 1e-9,
        "withholds": False,
        "fit": {"agrees": None, "curves_agree": False},
    }
    assert negative_verdicts(numbers) == ["sigma_holds", "fit.curves_agree"]


@pytest.mark.parametrize(("good", "options", "code"), STRICT)
def test_strict_ends_with_a_code_of_its_own(
    good: bool, options: list[str], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also with --quiet, where the warnings stand in JSON; the run folder is complete."""
    app = program(monkeypatch, numbers=lambda run: {**LEVEL.numbers(run), "fit": {"agrees": good}})
    (tmp_path / "level.yaml").write_text(FILE, "utf-8")
    done = invoke(app, "level", tmp_path / "level.yaml", "--out", tmp_path / "run", "--quiet", *options)
    assert done.exit_code == code, done.stderr
    assert ("fit.agrees" in done.stderr) == bool(code)
    assert json.loads((tmp_path / "run" / "level.json").read_text("utf-8"))["warnings"] == ["a toy"]


def course(folder: Path, size: float) -> Path:
    """A camera that turns to and fro from minute to minute, where the prior says that it drifts over hours."""
    turns = ", ".join(f"[0 arcsec, {(-1) ** k * size} arcsec, 0 arcsec]" for k in range(3))
    text = "instrument: gf7_pair\ncourse:\n  times: [0 min, 1 min, 2 min]\n  detail: 1 min\n  motion:\n"
    file = folder / f"course_{size}.yaml"
    file.write_text(text + f"    base/forward: {{rotate: [{turns}]}}\nrender: {{frames: 2, seed: 7}}\n", "utf-8")
    return file


def test_a_course_that_contradicts_its_prior_says_so(tmp_path: Path, backend) -> None:
    """The prior's camera mounts turn by 0.7", and 20 h of drift let them turn by 0.7" sqrt(2 / 1200) = 0.03" a minute:
    each time agrees, the turns of 1" between them do not.
    """
    run = render_job(resolve(course(tmp_path, 0.5)), backend)
    assert isinstance(run, RenderRun)
    assert run.series is not None
    assert run.series.agrees.all()
    numbers, told = recovered_numbers(run), judge(run)
    found = run.series.to_dict()
    assert not found["disturbances"]["agrees"]
    assert found["sigma_holds"] == [False] * 3
    assert not numbers["sigma_holds"]
    (doubt,) = numbers["doubts"]
    assert doubt.startswith("the series contradicts the prior orbit or its time laws: chi-square ")
    assert doubt in told.warnings
    assert numbers["warnings"] == list(told.warnings)
    assert told.verdict.startswith("The course contradicts the prior orbit or its time laws")


@pytest.mark.second
def test_a_course_that_keeps_to_its_prior_is_quiet(tmp_path: Path, backend) -> None:
    quiet = render_job(resolve(course(tmp_path, 0.0)), backend)
    assert isinstance(quiet, RenderRun)
    numbers = recovered_numbers(quiet)
    assert numbers["sigma_holds"]
    assert not numbers["doubts"]
    assert negative_verdicts({"recovered": numbers, "course": quiet.series.to_dict()}) == []
    # one time whose shifts are beyond the prior by themselves is no time at which sigma holds
    shaken = replace(quiet, series=replace(quiet.series, agrees=np.array([True, False, True])))
    assert shaken.series.to_dict()["sigma_holds"] == [True, False, True]


@pytest.mark.second
def test_every_number_has_the_unit_that_its_key_says() -> None:
    """One of SI as the source of every quantity of every record gives as many of the unit as there are in one of SI."""
    by_hand = set()
    for record in records():
        for one in record:
            words = [word for word in one.key.split("_")[1:] if word in UNITS or word.rstrip("2") in UNITS]
            if not words or words[-1] == "px2" or "per" in one.key.split("_") or one.below is not None:
                continue
            power = 2 if words[-1].endswith("2") else 1
            expected = PER_SI.get(words[-1].rstrip("2"), 1.0) ** power
            assert one.unit, one.key
            if one.converted:
                told = Quantity(one.key, lambda _: np.array([1.0])).value(None)
                assert told[0] == pytest.approx(expected, rel=1e-14), one.key
            elif expected != 1.0:
                by_hand.add(one.key)
    assert by_hand == CONVERTED_BY_HAND


@pytest.mark.second
def test_no_key_of_a_result_hides_its_unit() -> None:
    """In the results of all commands a key with the word of a unit is known to be in that unit."""
    for file in GOLDEN.glob("*.json"):
        for name, content in kept_fields(file.stem).items():
            for key in content.get("fields", {}):
                for part in re.split(r"[.\[\]{}|]+", key):
                    words = part.split("_")
                    if set(words[1:]) & set(UNITS) - {"s", "m", "K", "W"} and "per" not in words and " " not in part:
                        assert unit_of((part,)), f"{file.stem}: {name}: {key}"
