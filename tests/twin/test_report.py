"""The report says what the results say, by itself: no other file, no network, nothing missing."""

import base64
import csv
import html
import io
import math
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from analysis.monitor.estimators import ESTIMATORS
from analysis.monitor.parameters import CAMERA_PARAMETERS as PARAMETERS
from scenes.specs.resolved import resolve
from tests.twin.policed_page import breaches
from twin.main_job.crosstalk_sections import is_wrong
from twin.main_job.render_folder import render_report
from twin.main_job.render_job import STAGES, render_job
from twin.main_job.render_results import RenderRun
from twin.main_job.result_sections import residual_section
from twin.main_job.summary_plot import summary_png
from twin.main_job.systematics import systematics
from twin.main_job.verdict import judge
from twin.pictures.scene_file import write_scene
from twin.run import svg
from twin.run.artefact import FAR, Text, decimals_for, fixed, plain, residual_text, significant

VOID = {"meta", "br", "hr", "img", "input", "link", "col", "wbr"}
NAMESPACES = ("http://www.w3.org/1999/xlink", "http://www.w3.org/2000/svg")


@pytest.fixture(scope="module")
def told() -> list[tuple[str, int, int]]:
    """What the run said of its progress."""
    return []


@pytest.fixture(scope="module")
def run(backend, told) -> RenderRun:
    return render_job(
        resolve("scenes/examples/perturb.yaml"),
        backend,
        advance=lambda part, done, total: told.append((part, done, total)),
    )


@pytest.fixture(scope="module")
def page(run, tmp_path_factory) -> str:
    scene = tmp_path_factory.mktemp("scene") / "scene.glb"
    write_scene(run.experiment, run.state, scene)
    return render_report(run, scene=scene.read_bytes())


class Cells(HTMLParser):
    """Checks that tags are closed in order and collects the text of every cell with a data-key, and all text."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.key: str | None = None
        self.cells: dict[str, str] = {}
        self.words: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.tags.append((tag, found))
        if tag not in VOID:
            self.open.append(tag)
        if "data-key" in found:
            self.key = found["data-key"]
            assert self.key not in self.cells
            self.cells[self.key] = ""

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag
        if tag == "td":
            self.key = None

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.words.append(data)
        if self.key is not None:
            self.cells[self.key] += data


@pytest.fixture(scope="module")
def parsed(page) -> Cells:
    parser = Cells()
    parser.feed(page)
    parser.close()
    assert parser.open == []
    return parser


def number(text: str) -> tuple[float, float]:
    """Value of a shown number and half a unit of its last digit."""
    plain_text = text.strip().replace("\N{MINUS SIGN}", "-").replace("+", "")
    places = len(plain_text.partition(".")[2])
    return float(plain_text), 0.5 * 10.0**-places * (1 + 1e-6)


def test_every_stage_is_told_when_it_begins_and_when_it_ends(run, told):
    assert told == [(stage, done, 1) for stage in STAGES for done in (0, 1)]


def test_well_formed_and_complete(page, parsed):
    assert page.startswith("<!DOCTYPE html>")
    ids = {attrs["id"] for _, attrs in parsed.tags if attrs.get("id")}
    links = {attrs["href"] for tag, attrs in parsed.tags if tag == "a" and str(attrs["href"]).startswith("#")}
    assert links
    assert {link[1:] for link in links if link} <= ids
    drawings = re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL)
    assert len(drawings) == 6  # two cameras' spots, residuals, motions, side view, footprints
    for drawing in drawings:
        named = drawing.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1)
        assert "xmlns:xlink" in drawing
        ET.fromstring(named)


def test_needs_nothing_else(page, parsed):
    """No script, link, font or picture from outside; pictures and tables are data in the page."""
    text = page
    for namespace in NAMESPACES:
        text = text.replace(f'"{namespace}"', "")
    assert not re.search(r"https?:|//www|@import|file:/", text)
    assert breaches(page) == []
    assert not {"link", "iframe", "object"} & {tag for tag, _ in parsed.tags}
    images = [attrs for tag, attrs in parsed.tags if tag in ("img", "image")]
    assert len(images) >= 16
    for attrs in images:
        source = attrs.get("src") or attrs.get("xlink:href") or attrs.get("href")
        assert source is not None
        assert source.startswith("data:image/png;base64,")
    for tag, attrs in parsed.tags:
        for name in ("href", "xlink:href", "src"):
            value = attrs.get(name)
            assert value is None or value.startswith(("#", "data:")), (tag, value)
    assert len(page) < 4_000_000


def test_nothing_is_missing(parsed):
    words = " ".join(parsed.words)
    for bad in ("nan", "NaN", "None", "inf", "np.float64"):
        assert not re.search(rf"(?<![A-Za-z]){bad}(?![A-Za-z])", words), bad


def test_recovered_and_true_are_the_results(run, parsed):
    recovered, truth = run.recovered_dict(), run.truth_dict()
    checked = 0
    for name, estimators in recovered["cameras"].items():
        for p in PARAMETERS:
            shown, step = number(parsed.cells[f"{name}.{p.key}.true"])
            assert shown == pytest.approx(truth["cameras"][name][p.key], abs=step)
            for estimator in ESTIMATORS:
                value, sigma = estimators[estimator][p.key], estimators[estimator][f"{p.key}_sigma"]
                text = parsed.cells[f"{name}.{p.key}.{estimator}"]
                match = re.fullmatch(r"(\S+) ± (\d+(?:\.\d+)?)([●▲]) (\S+) σ", text.strip())
                assert match is not None, text
                for part, expected in zip(match.groups()[:2], (value, sigma), strict=True):
                    shown, step = number(part)
                    assert shown == pytest.approx(expected, abs=step)
                    assert step <= 0.06 * sigma  # digits enough to judge by
                ratio = (value - truth["cameras"][name][p.key]) / sigma
                assert match[4] == residual_text(ratio)
                assert (match[3] == "▲") == (abs(ratio) > FAR)
                checked += 1
    assert checked == 40
    for axis in ("along", "across", "height"):
        shown, step = number(parsed.cells[f"ground.{axis}_m.true"])
        assert shown == pytest.approx(truth["ground"][f"{axis}_m"], abs=step)
        for estimator, ground in recovered["ground"].items():
            shown, step = number(parsed.cells[f"ground.{axis}_m.{estimator}"].partition(" ±")[0])
            assert shown == pytest.approx(ground[f"{axis}_m"], abs=step)
    for estimator, angle in recovered["intersection_angle"].items():
        shown, step = number(parsed.cells[f"intersection_angle.{estimator}"].partition(" ±")[0])
        assert shown == pytest.approx(angle["change_arcsec"], abs=step)


def test_spot_positions_are_the_results(run, parsed):
    pitch = 1e6 * run.experiment.path.pitch
    checked = 0
    for camera, sides in run.recovered_dict()["spots"].items():
        for side, one in sides.items():
            for axis in ("row", "column"):
                key = f"{camera}/{side}.{axis}"
                shift = one["after"][axis] - one["before"][axis]
                expected = {
                    "before": one["before"][axis],
                    "after": one["after"][axis],
                    "shift_px": shift,
                    "shift_um": shift * pitch,
                }
                for column, value in expected.items():
                    shown, step = number(parsed.cells[f"{key}.{column}"].partition(" ±")[0])
                    assert shown == pytest.approx(value, abs=step)
                    checked += 1
    assert checked == 32


def test_factors_are_the_results(run, parsed):
    for name, table in run.crosstalk.items():
        for f in table.factors:
            for which in ("by_model", "by_truth"):
                shown, step = number(parsed.cells[f"factor.{name}.{f.estimator}.{f.parameter}.{which}"])
                assert shown == pytest.approx(getattr(f, which), abs=step)


def test_every_motion_and_perturbation_is_named(run, parsed):
    words = " ".join(parsed.words)
    for path in run.state:
        assert path in words
    assert "rotate (2, \N{MINUS SIGN}1.5, 10) arcsec" in words
    assert "shift (0, 0, 3) µm" in words
    for table in run.crosstalk.values():
        for motion in table.motions:
            assert motion.body.removeprefix("base/") in words


def tables_of(page: str) -> dict[str, list[list[str]]]:
    """The tables that a page hands out, by their names."""
    found = re.findall(r'download="([a-z_-]+)\.csv" href="data:text/csv;charset=utf-8;base64,([^"]+)"', page)
    return {name: list(csv.reader(io.StringIO(base64.b64decode(data).decode()))) for name, data in found}


def test_every_table_can_be_taken_away_with_all_digits(run, page, parsed):
    """Each data table is followed by its CSV; those of facts hold no numbers of the run. A number to a cell."""
    text = re.sub(r"<style>.*?</style>|<svg.*?</svg>", "", page, flags=re.DOTALL)
    tables = re.split(r"<table", text)[1:]
    data = [after for after in tables if not after.startswith(' class="facts"')]
    assert len(data) >= 8
    for after in data:
        # the two tables of crosstalk share the one of motions
        assert 'class="csv"' in after or "#motions" in after
    handed = tables_of(page)
    assert set(handed) >= {"results", "spots", "residuals", "factors", "motions", "disturbances"}
    heads, *rows = handed["results"]
    recovered = run.recovered_dict()["cameras"]
    for row in rows[:8]:
        at = dict(zip(heads, row, strict=True))
        key = next(p.key for p in PARAMETERS if p.symbol == at["parameter"])
        assert float(at["model"]) == recovered[at["camera"]]["model"][key]
        assert float(at["model sigma"]) == recovered[at["camera"]]["model"][f"{key}_sigma"]
        assert float(at["model sigma noise"]) == recovered[at["camera"]]["model"][f"{key}_sigma_noise"]
    heads, *rows = handed["motions"]
    assert len(rows) == sum(len(table.motions) for table in run.crosstalk.values())
    pitch = 1e6 * run.experiment.path.pitch
    table = run.crosstalk["forward"]
    for k, row in enumerate(rows[: len(table.motions)]):
        at = dict(zip(heads, row, strict=True))
        assert (at["camera"], at["motion"]) == ("forward", table.motions[k].label)
        shown = [float(at[f"{name} [µm]"]) for name in ("left y", "left x", "right y", "right x")]
        np.testing.assert_allclose(shown, pitch * table.spot_shift[:, k], rtol=1e-14)


def test_the_answer_comes_first_and_the_rest_is_folded(run, page, parsed):
    """One sentence, the same as elsewhere, before anything else; unfolded at most 2 500 words."""
    told = judge(run)
    body = page[page.index("<body>") :]
    first = re.search(r"<p[^>]*>(.*?)</p>", body, re.DOTALL)
    assert first is not None
    assert html.unescape(first[1]) == told.verdict
    unfolded = re.sub(r"(<summary>.*?</summary>)", r"\1", body, flags=re.DOTALL)
    while "<details" in unfolded:  # innermost first
        unfolded = re.sub(r"<details[^>]*>((?!<details).)*?</details>", "", unfolded, flags=re.DOTALL)
    words = re.sub(r"<(script|svg|style).*?</\1>|<[^>]+>", " ", unfolded, flags=re.DOTALL).split()
    assert 200 < len(words) <= 2500


def test_one_notation(page, run):
    """Micro sign, not the Greek letter, and no inch or second marks for arcsec."""
    text = re.sub(r"<(script|svg|style|pre).*?</\1>", "", page, flags=re.DOTALL)
    text = re.sub(r"<[^>]+>", " ", text)
    assert "\N{GREEK SMALL LETTER MU}" not in text
    assert "\N{DOUBLE PRIME}" not in text
    assert not re.search(r"\bum\b|d_alpha|d_beta|d_gamma|d_f\b", text)
    assert "Δα [arcsec]" in text
    assert "Δf [µm]" in text


def test_crosstalk_explains_the_systematic_residuals(run):
    """What the table predicts is what is left beside noise: 4.5 sigma in one of eight is a false alarm of 5e-5."""
    checked = 0
    largest = 0.0
    for name in run.crosstalk:
        for estimator in ("model", "posterior"):  # which takes the spots of both cameras together
            bias = systematics(run, name).bias[estimator]
            for k, p in enumerate(PARAMETERS):
                own = run.recovered_dict()["cameras"][name][estimator]
                error = own[p.key] - run.truth_dict()["cameras"][name][p.key]
                largest = max(largest, abs(error) / own[f"{p.key}_sigma_noise"])
                assert abs(error - bias[k]) < 4.5 * own[f"{p.key}_sigma_noise"]
                checked += 1
    assert checked == 16
    assert largest > 50  # there was something to explain
    *_, moved = residual_section(run, {"residuals": "<svg></svg>"}).artefacts
    assert isinstance(moved, Text)
    forward, backward = moved.points
    assert forward.startswith("forward: moved outside the family: ")
    assert "M2 along Z, 3 µm" in forward
    assert "tilt" in backward
    assert "in no row of the table" not in forward


@pytest.mark.second
def test_nothing_perturbed(backend, tmp_path):
    job = tmp_path / "nothing.yaml"
    job.write_text("instrument: gf7_pair\nrender: {images: [spots], frames: 2, seed: 3}\n")
    run = render_job(resolve(job), backend)
    page = render_report(run)
    parser = Cells()
    parser.feed(page)
    assert parser.open == []
    assert "Nothing was perturbed" in page
    assert "nothing moved outside the family" in page
    assert number(parser.cells["forward.d_f_um.true"])[0] == 0


def test_summary_picture(run, tmp_path):
    place = tmp_path / "summary.png"
    place.write_bytes(summary_png(run))
    image = cv2.imread(str(place))
    assert image.shape[1] == 1400
    assert 600 < image.shape[0] < 1600
    assert image.std() > 20
    # no note below the table runs over the edge
    assert np.all(image[-int(0.06 * image.shape[0]) :, -12:] == 255)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (3e-7, "0"),
        (0.03637, "0.0364"),
        (-4.0337, "\N{MINUS SIGN}4.03"),
        (0.99999, "1.00"),
        (-2.72e-4, "\N{MINUS SIGN}2.7e\N{MINUS SIGN}4"),
        (54.58, "54.6"),
        (math.nan, "\N{EM DASH}"),
    ],
)
def test_significant_digits(value, text):
    assert significant(value) == text


def test_decimals_follow_sigma():
    assert [decimals_for(s) for s in (0.013, 0.99, 12.0, 3.4e-4, 0.0)] == [3, 2, 0, 5, 4]
    assert fixed(-0.00001, 3, sign=True) == "0.000"
    assert fixed(1.23456, 3, sign=True) == "+1.235"
    assert plain(650.0) == "650"
    assert residual_text(-1234.4) == "\N{MINUS SIGN}1\N{NARROW NO-BREAK SPACE}234"
    assert residual_text(None) == "\N{EM DASH}"


def test_what_is_marked_wrong():
    assert is_wrong(1.2, 1.0)
    assert not is_wrong(1.05, 1.0)
    assert is_wrong(1e-3, 0.0)
    assert not is_wrong(1e-7, 0.0)
    assert not is_wrong(1e-3, 0.0, floor=2e-3)
    assert not np.isnan(FAR)


# --- how figures are drawn --------------------------------------------------------------------------------------------


def _all_kinds_of_axes():
    """Shared and inverted axes, a fixed aspect, a logarithm, offsets, minor ticks, a colour bar and labels on top."""
    figure = svg.new_figure(6.0)
    grid = figure.subplots(2, 3, width_ratios=(1.0, 2.0, 1.0))
    x = np.linspace(0.0, 1.0, 40)
    grid[0, 0].plot(1e6 + x, 1e-9 * x)
    shown = svg.signed_map(grid[0, 1], np.outer(x - 0.5, x))
    figure.colorbar(shown, ax=list(grid[0, :2]), orientation="horizontal", label="bar")
    grid[0, 2].semilogy(x, 1e3**x)
    grid[0, 2].yaxis.set_label_position("right")
    grid[1, 0].sharey(grid[0, 0])
    grid[1, 0].set(xlabel="below", ylabel="beside", title="of the first")
    grid[1, 1].xaxis.set_ticks_position("top")
    grid[1, 1].plot(x, x)
    grid[1, 1].set(title="above ticks", ylim=(1.0, 0.0))
    grid[1, 1].minorticks_on()
    grid[1, 2].plot(x, 3.0 * x)
    grid[1, 2].set_aspect("equal", adjustable="datalim")
    svg.gridded(grid[1, 2])
    return figure


@pytest.mark.second
@pytest.mark.parametrize("write", [svg.to_svg, lambda figure: svg.to_png(figure, 50)], ids=["svg", "png"])
def test_ticks_that_are_kept_are_those_that_matplotlib_works_out_anew(write, monkeypatch):
    with svg.look("kept"):
        kept = write(_all_kinds_of_axes())
        asked = []
        plain = svg._kept_of

        def counted(axis):
            update, boxes = axis._update_ticks, axis._get_ticklabel_bboxes
            return lambda: asked.append(axis) or update(), boxes

        monkeypatch.setattr(svg, "_kept_of", counted)
        assert write(_all_kinds_of_axes()) == kept
        anew = len(asked)
        asked.clear()

        def counted_below(axis):
            update = axis._update_ticks
            axis._update_ticks = lambda: asked.append(axis) or update()
            return plain(axis)

        monkeypatch.setattr(svg, "_kept_of", counted_below)
        figure = _all_kinds_of_axes()
        assert write(figure) == kept
    assert len(asked) < 0.6 * anew
    assert not any("_update_ticks" in vars(axis) for axes in figure.axes for axis in (axes.xaxis, axes.yaxis))
