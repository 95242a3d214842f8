"""What a report may do: its Content-Security-Policy covers all that it is made of, and nothing that a file brings."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from markupsafe import escape

from tests.twin.policed_page import Policed, breaches
from tests.twin.study_bench import REFUSED
from twin.framework.artefact import Marked, SvgFigure, Table, Text
from twin.framework.page import FIGURES, RunFacts, checksum, inline, page_policy, render_report
from twin.framework.report import Report, Section
from twin.framework.svg import look, new_figure, to_svg
from twin.pictures.scene_file import viewer_programs, viewer_scripts

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
    return render_report("focus", replace(told, verdict=f"Verdict {evil.replace('.', '')}."), how)


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
