"""Reports of studies of all kinds: they stand alone, say what was found, and hold out when there is nothing."""

import html
import json
import re

import numpy as np
import pytest

from tests.tiers import quick
from tests.twin.policed_page import breaches
from tests.twin.study_data import columns, dataset, study_of
from twin.study.report import study_plots, study_report
from twin.study.report.study_analysis import StudyAnalysis
from twin.study.report.study_plots import local_fit
from twin.study.report.study_report import report_files
from twin.study.report.study_statistics import StudyRuns

pytestmark = pytest.mark.drawn

TWO = "{y: {key: [t, y_um]}, z: {key: [t, z]}}"


def page(folder, study, values, failed=None) -> str:
    """The report's text, after checking what every report must fulfil."""
    for name, content in report_files(dataset(study, values, failed), study).contents.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    text = (folder / "report.html").read_text("utf-8")
    assert "<script" not in text
    assert breaches(text) == []  # nothing is fetched from elsewhere
    for name in re.findall(r'href="(artefacts/[^"]+|statistics.json)"', text):
        assert (folder / name).stat().st_size > 0, name
    verdict = json.loads((folder / "statistics.json").read_text("utf-8"))["verdict"]
    first = re.search(r"<p[^>]*>(.*?)</p>", text, re.DOTALL)
    assert first is not None
    assert html.unescape(first[1]) == verdict
    assert len(re.findall(r"\.\s+[A-Z]", verdict)) <= 1
    words = re.sub(r"<svg.*?</svg>|<style>.*?</style>", "", text, flags=re.DOTALL)
    words = re.sub(r"<[^>]+>", " ", words)
    for wrong in ("nan", "None", "inf", "np.float"):
        assert not re.search(rf"(?<![A-Za-z]){wrong}(?![A-Za-z])", words), wrong
    return words


CASES = {
    "all failed": ("{kind: monte_carlo, runs: 30, seed: 1}", lambda x: x, 30, "the value is NaN in all runs"),
    "all but one failed": ("{kind: monte_carlo, runs: 30, seed: 1}", lambda x: x, 29, "29 of 30 runs failed"),
    "constant": ("{kind: monte_carlo, runs: 30, seed: 1}", lambda x: 0.0 * x + 2.5, 0, "is the same in all 30 runs"),
    "few": ("{kind: monte_carlo, runs: 8, seed: 1}", lambda x: x**2, 0, "8 runs are few"),
    "one": ("{kind: monte_carlo, runs: 1, seed: 1}", lambda x: x, 0, "1 run"),
    "not finite": ("{kind: monte_carlo, runs: 40, seed: 1}", lambda x: np.where(x > 0.5, np.nan, x), 0, "no finite"),
    "infinite": ("{kind: monte_carlo, runs: 40, seed: 1}", lambda x: np.where(x > 0.5, np.inf, x), 0, "no finite"),
    "a long front": ("{kind: monte_carlo, runs: 60, seed: 1}", lambda x: -x, 0, "50 of 60, evenly through the front"),
    "tiny": ("{kind: monte_carlo, runs: 40, seed: 1}", lambda x: 1e-30 * x, 0, "e−3"),
    "large": ("{kind: monte_carlo, runs: 40, seed: 1}", lambda x: 1e9 + x, 0, "1.00e9"),
}


def test_a_study_of_one_factor_begins_with_its_curve(monkeypatch) -> None:
    monkeypatch.setattr(study_report, "_figure", lambda *drawn: drawn)
    first, second = (f"{name}: {{key: [job, {name}], uniform: [0 mm, 1 mm]}}" for name in "ab")
    for factors, place in ((first, 0), (f"{first}, {second}", 2)):
        study = study_of(f"{{{factors}}}", "{kind: monte_carlo, runs: 40, seed: 1}")
        analysis = StudyAnalysis.of(StudyRuns.of(dataset(study, {"y": columns(study)["a"] ** 2}), study))
        titles = [section.title for section in study_report.sections(analysis)]
        assert titles.index("Response curves") == place


def test_a_local_fit_has_no_ends() -> None:
    """A parabola is its own fit up to both ends; means of neighbours end before them."""
    x = np.sort(np.random.default_rng(1).uniform(-1.0, 2.0, 60))
    at = np.linspace(x[0], x[-1], 9)
    mean, spread = local_fit(x, 3.0 + x - 2.0 * x**2, at)
    np.testing.assert_allclose(mean, 3.0 + at - 2.0 * at**2, atol=1e-9)
    np.testing.assert_allclose(spread, 0.0, atol=1e-7)
    noise = 0.1 * np.random.default_rng(2).standard_normal(4000)
    x = np.random.default_rng(3).uniform(-1.0, 2.0, 4000)
    mean, spread = local_fit(x, noise, at)
    assert np.all(
        np.abs(mean) < 5.0 * 3.0 * 0.1 / np.sqrt(1200.0)
    )  # at an end a parabola has three times sigma / root n
    np.testing.assert_allclose(spread, 0.1, rtol=0.1)
    assert local_fit(np.zeros(9), np.arange(9.0), np.zeros(1))[0] == pytest.approx(4.0)


@pytest.mark.parametrize("case", quick(2, CASES))
def test_when_there_is_little_to_say(tmp_path, case) -> None:
    design, function, failed, expected = CASES[case]
    report = "{sobol: true, scatter: [[a, y]], pareto: [{x: a, y: y}], thresholds: {t: {response: y, at_most: 1}}}"
    study = study_of("{a: {key: [job, a], uniform: [0 mm, 1 mm]}}", design, report=report)
    y = function(columns(study)["a"])
    assert expected in page(tmp_path, study, {"y": y}, np.arange(len(y)) < failed)


@pytest.mark.second
def test_a_grid_with_holes_has_no_indices(tmp_path) -> None:
    study = study_of("{a: {key: [job, a], values: [1, 2, 3]}, b: {key: [job, b], values: [1, 2, 3]}}", "{kind: grid}",
                     report="{sobol: true}")  # fmt: skip
    x = columns(study)
    assert "runs of the grid are missing" in page(tmp_path, study, {"y": x["a"] + x["b"]}, np.arange(9) == 4)


@pytest.mark.second
def test_columns_of_one_table_are_one_axis(tmp_path) -> None:
    table = "table: {{file: t.csv, column: {0}, values: [{1}]}}"
    study = study_of(
        f"{{a: {{key: [job, a], {table.format('a', '0, 1, 2, 3, 5')}}}, "
        f"b: {{key: [job, b], {table.format('b', '0, 2, 4, 6, 10')}}}, c: {{key: [job, c], uniform: [0, 1]}}}}",
        "{kind: monte_carlo, runs: 100, seed: 1}",
        report="{sobol: true}",
    )
    x = columns(study)
    data = dataset(study, {"y": x["a"] + x["c"]})
    assert [len(axis) for axis in StudyRuns.of(data, study).axes] == [2, 1]
    words = page(tmp_path, study, {"y": x["a"] + x["c"]})
    # b = 2a: a straight line cannot tell them apart, and says so
    assert "excluded from the model: b" in words
    found = json.loads((tmp_path / "statistics.json").read_text("utf-8"))["responses"]["y"]["sobol"]["factors"]
    spread = np.var([0.0, 1.0, 2.0, 3.0, 5.0])
    assert found["a + b"]["first"]["value"] == pytest.approx(spread / (spread + 1.0 / 12.0), abs=1e-9)


@pytest.mark.second
def test_a_figure_that_cannot_be_drawn_costs_nothing_else(monkeypatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("no such font")

    study = study_of(
        "{a: {key: [job, a], values: [1, 2, 3]}, c: {key: [job, c], values: [x, y, z]}}", "{kind: grid}", TWO
    )
    x = columns(study)
    data = dataset(study, {"y": x["a"] + 0.1 * np.arange(9), "z": np.arange(9) ** 2.0})
    whole = report_files(data, study)
    monkeypatch.setattr(study_plots, "histogram_figure", fail)
    made = report_files(data, study)
    told = "the figure 'Histograms' could not be drawn: no such font"
    assert made.undrawn == (told,)
    assert made.contents["artefacts/histograms.txt"].decode() == f"{told}\n"
    others = {name for name in whole.contents if name not in ("report.html", "artefacts/histograms.svg")}
    assert "statistics.json" in others
    others.remove("statistics.json")  # it has the warning
    assert all(made.contents[name] == whole.contents[name] for name in others)
    before, after = (json.loads(one.contents["statistics.json"]) for one in (whole, made))
    assert after.pop("warnings") == [*before.pop("warnings"), told]
    assert after == before
    page_text = html.unescape(made.contents["report.html"].decode())
    assert told in page_text  # among the warnings
    assert f"T{told[1:]}." in page_text  # where it would stand


def test_few_points_are_large() -> None:
    """Points of 30 runs are seen, and those of 5000 do not become one blot."""
    assert study_plots.dot_size(30) == 7.0
    assert study_plots.dot_size(5000) == 2.5
    assert study_plots.dot_size(150) == pytest.approx(60.0 / np.sqrt(150.0))
