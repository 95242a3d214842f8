"""The report says what the results say, by itself: no other file, no network, and nothing that a file brings."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from markupsafe import escape

from analysis.monitor.parameters import CAMERA_PARAMETERS as PARAMETERS
from scenes.specs.resolved import resolve
from tests.twin.policed_page import Policed, breaches
from tests.twin.study_bench import REFUSED
from twin.framework import svg
from twin.framework.artefact import (
    FAR,
    Marked,
    SvgFigure,
    Table,
    Text,
    decimals_for,
    fixed,
    plain,
    residual_text,
    significant,
    typeset,
)
from twin.framework.page import FIGURES, RunFacts, checksum, inline, page_policy
from twin.framework.page import render_report as whole_page
from twin.framework.report import Report, Section
from twin.framework.svg import look, new_figure, to_svg
from twin.main_job.crosstalk_sections import is_wrong
from twin.main_job.render_folder import render_report
from twin.main_job.render_job import render_job
from twin.main_job.render_results import RenderRun
from twin.main_job.result_sections import residual_section
from twin.main_job.systematics import systematics
from twin.pictures.light_paths import trace_light_paths
from twin.pictures.scene_file import scene_bytes, viewer_programs, viewer_scripts

pytestmark = pytest.mark.drawn


@pytest.fixture(scope="module")
def run(backend) -> RenderRun:
    return render_job(resolve("scenes/examples/perturb.yaml"), backend)


@pytest.fixture(scope="module")
def page(run) -> str:
    instrument = run.experiment.instrument
    paths = trace_light_paths(instrument, run.experiment.backend, run.state)
    return render_report(run, scene=scene_bytes(instrument, run.state, paths))


def test_the_colour_of_a_verdict_follows_unmet_requirements_and_warnings() -> None:
    report = Report("Title", "It is so.", (), (), Table("t", "", "", ("a",), [[1.0]]), ())
    how = RunFacts("", "twin.lab", 0.0, 1.0, "cpu")
    cases = ((report, "answer"), (replace(report, warnings=("w",)), "answer warned"))
    for one, name in (*cases, (replace(report, warnings=("w",), unmet=True), "answer unmet")):
        assert f'<p class="{name}">It is so.</p>' in whole_page("focus", one, how)


def test_every_section_is_in_the_navigation_and_long_tables_are_folded() -> None:
    short, long = (Table(f"t{n}", f"Of {n}", "", ("a",), [[1.0]] * n) for n in (20, 21))
    sections = (Section("First", (), (short, long)), Section("Second", (), (), name="own"))
    report = Report("Title", "It is so.", (), (), Table("t", "", "", ("a",), [[1.0]]), sections)
    page = whole_page("focus", report, RunFacts("", "twin.lab", 0.0, 1.0, "cpu"))
    for anchor, title in (("section-1", "First"), ("own", "Second")):
        assert f'<a href="#{anchor}">{title}</a>' in page
        assert f'<section id="{anchor}">' in page
    assert "<summary>Of 21, 21 rows</summary>" in page
    assert "<h3>Of 20</h3>" in page


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("at (0.08, -0.01) deg", "at (0.08, −0.01) deg"),
        ("-2.53e-05 mm", "−2.53e−5 mm"),
        ("3e+08", "3e8"),
        ("2028-03-05, runs/a-1, 3-4 and --seed -1", "2028-03-05, runs/a-1, 3-4 and --seed −1"),
        ("`shift: -1` moves by -1", "`shift: -1` moves by −1"),
    ],
)
def test_one_minus_sign(text: str, shown: str) -> None:
    assert typeset(text) == shown
    report = Report("Title", "It is so.", (text,), (), Table("t", "", "", ("a",), [[1.0]]), (), warnings=(text,))
    assert (report.lead, report.warnings) == ((shown,), (shown,))


@pytest.mark.second
def test_a_page_needs_nothing_else_and_misses_nothing(page):
    """No script, link, font or picture from outside; tags are closed in order, and no number is missing."""
    text = re.sub(r'"http://www.w3.org/(1999/xlink|2000/svg)"', "", page)
    assert not re.search(r"https?:|//www|@import|file:/", text)
    assert breaches(page) == []
    assert not re.search(r"<(link|iframe|object)\b", page)
    sources = re.findall(r'<(?:img|image)\b[^>]*?(?:src|href)="([^"]*)"', page)
    assert len(sources) >= 16
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    ids = set(re.findall(r'\bid="([^"]+)"', page))
    assert set(re.findall(r'<a\b[^>]*href="#([^"]+)"', page)) <= ids
    for drawing in re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL):
        ET.fromstring(drawing.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1))
    words = re.sub(r"<(style|script).*?</\1>|<[^>]+>", " ", page, flags=re.DOTALL)
    assert not re.search(r"(?<![A-Za-z])(nan|NaN|None|inf|np\.float64)(?![A-Za-z])", words)


@pytest.mark.second
def test_the_first_screen_shows_the_spots_beside_one_estimator(page, run):
    """All spots before and after with their shifts, and one reading of each change; other estimators on a click."""
    first = page[page.index('<section id="result"') : page.index('<details id="setup">')]
    assert first.count("<image") == 2 * len(run.experiment.path.channels)
    assert "Recovered by the posterior" in first
    assert first.count("<tr>") - 1 == len(run.reading.table.of(run.judged))
    assert "paper" not in re.sub(r"<a .*?>", "", first)
    rest = page[page.index("<summary>All estimators</summary>") :]
    assert "paper joint" in rest[: rest.index("</details>")]


@pytest.mark.second
def test_drawings_follow_the_dark(page) -> None:
    """The style sheet of pages names the ink, the greys and the blue of drawings, which Matplotlib writes as styles."""
    for colour in (svg.INK, svg.GREY, svg.LIGHT, svg.SHADE, svg.BLUE.lower()):
        assert f'[style*="fill: {colour}"]' in page
        assert colour == svg.SHADE or f'[style*="stroke: {colour}"]' in page
    assert ".card { overflow-x: auto; border-radius: 3px; }" in page


@pytest.mark.second
def test_crosstalk_explains_the_systematic_residuals(run):
    """What the table predicts is what is left beside noise: 4.5 sigma in one of eight is a false alarm of 5e-5."""
    checked = 0
    largest = 0.0
    for name in run.crosstalk:
        for estimator in ("model", "posterior"):  # which takes the spots of both cameras together
            bias = systematics(run, name).bias[estimator]
            for k, p in enumerate(PARAMETERS.values()):
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
    assert forward.startswith("forward: motions outside the family: ")
    assert "M2 along Z, 3 µm" in forward
    assert "tilt" in backward
    assert "in no row of the table" not in forward


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


# --- the Content-Security-Policy covers all that a page is made of ----------------------------------------------------


EVIL = (
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "</style><script src=https://evil.example/x.js></script>",
    "</title><svg onload=alert(1)>",
    "javascript:alert(1)",
    "{{ 7 * 7 }}{% raw %}",
    "--> <b>]]>",
)


def page_of(evil: str = "", figure: str = "") -> str:
    """A test's page with a user's text wherever one can stand."""
    marked = Marked(f"cell {evil}", f"below {evil}", "far", f"key {evil}", f"hint {evil}")
    table = Table("table", f"Title {evil}", f"Caption {evil}", [f"head {evil}"], [[f"cell {evil}"], [marked]])
    above = {"over": [(f"over {evil}", 1)], "bands": {0: f"band {evil}"}}
    table = replace(table, **above, full=Table("full", "Full", "", [f"head {evil}"], [[f"cell {evil}"]]))
    words = Text("words", f"Title {evil}", f"Caption {evil}", [f"point {evil}"])
    svg = figure or '<svg viewBox="0 0 9 9"><path d="M0 0H9"/></svg>'
    sections = (Section(f"Section {evil}", (f"Text {evil}",), (SvgFigure("drawing", "Drawing", evil, svg), words)),)
    told = Report(
        f"Test {evil}", "One sentence.", (f"Lead {evil}",), ((f"Label {evil}", evil),), table, sections, {}, (evil,) * 3
    )
    how = RunFacts(evil, "twin.lab", 0.0, 1.0, evil, 1, f"focus {evil}")
    return whole_page("focus", replace(told, verdict=f"Verdict {evil.replace('.', '')}."), how)


@pytest.fixture(scope="module")
def figure() -> str:
    with look("policy"):
        drawn = new_figure(1.0)
        axes = drawn.add_subplot()
        axes.plot([0, 1], label=EVIL[0])
        axes.imshow([[0, 1]])
        axes.set_title(EVIL[-1])
        axes.legend()
        return to_svg(drawn)


def test_a_report_keeps_its_policy(figure):
    page = page_of("plain", figure)
    assert breaches(page) == []
    assert [tag for tag, _, _ in Policed(page).inline].count("style") == 2  # the page's and the figure's
    assert "script" not in Policed(page).tags


def test_what_matplotlib_writes_into_every_figure_is_what_the_policy_allows(figure):
    assert re.findall(r"<style[^>]*>(.*?)</style>", figure, re.S) == [FIGURES]


@pytest.mark.second
@pytest.mark.parametrize("evil", EVIL)
def test_a_text_of_a_users_file_brings_no_markup(evil):
    page = page_of(evil)
    assert breaches(page) == []
    assert Policed(page).tags == Policed(page_of("plain")).tags
    assert evil.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace('"', "&#34;") in page


@pytest.mark.second
@pytest.mark.parametrize("broken", REFUSED["breaches"])
def test_a_breach_would_be_found(broken):
    assert breaches(page_of("plain").replace("<body>", f"<body>{broken}"))


def test_the_view_in_three_dimensions_is_in_the_policy():
    text = '<meta http-equiv="Content-Security-Policy" content="{}"><style>x</style>{}'
    scripts = str(viewer_scripts(b"glTF"))
    assert breaches(text.format(page_policy("x", viewer_programs()), scripts)) == []
    assert breaches(text.format(page_policy("x"), scripts))
    # the library is put in by the program, as one more script
    assert checksum(viewer_programs()[1]) in page_policy("x", viewer_programs())


@pytest.mark.parametrize("evil", EVIL)
def test_code_between_backticks_brings_no_markup(evil):
    assert inline(f"a `{evil}` b") == f"a <code>{escape(evil)}</code> b"


def test_names_of_many_columns_stand_upright():
    """Four have room beside one another in half a page's width, five have not."""
    from matplotlib.colors import SymLogNorm
    from matplotlib.figure import Figure

    from twin.main_job import spot_plots

    for count, rotation in ((4, 0.0), (5, 90.0)):
        axes = Figure().subplots()
        spot_plots._motion_panel(axes, np.ones((2, count)), [str(k) for k in range(count)], SymLogNorm(1.0))
        assert {text.get_rotation() for text in axes.get_xticklabels()} == {rotation}
