"""Measured figures in README and docs are those of docs/figures/figures.yaml."""

import pytest

from docs.figures.__main__ import filled, pages, places
from docs.figures.sources import RUNS, SUMMARY, Figure, of_validation, read_figures

FIGURES = read_figures()


def test_a_page_quotes_what_was_measured() -> None:
    """After a change of figures.yaml: python -m docs.figures --fill."""
    for page in pages():
        found = list(places(page.read_text("utf-8"), FIGURES))
        assert [(name, text) for name, text, right in found if text != right] == [], page.name


def test_every_figure_is_quoted_or_counts_rows_and_none_is_unknown() -> None:
    quoted = {name for page in pages() for name, _, _ in places(page.read_text("utf-8"), FIGURES)}
    assert {name for name in set(FIGURES) - quoted if not name.startswith("rows.")} == set()
    assert len(quoted) > 40
    assert {name for wanted in RUNS.values() for name in wanted} <= set(FIGURES)


def test_figures_of_checks_are_those_of_the_full_validation() -> None:
    found = of_validation(SUMMARY.read_text("utf-8"))
    assert {name: FIGURES[name] for name in found} == found


KNOWN = {"a.b": Figure(0.14884, 0.00096, "arcsec", 3, "", 1), "c": Figure(-110.9, None, "m", 0, "", None)}


@pytest.mark.parametrize(
    ("text", "right"),
    [
        ("0.2<!-- a.b -->″", "0.149<!-- a.b -->″"),
        ("0.1 ± 0.1<!-- a.b -->″", "0.149 ± 0.001<!-- a.b -->″"),
        ("7<!-- a.b:1 --> and 12 ± 3<!-- a.b:4 -->", "0.1<!-- a.b:1 --> and 0.1488 ± 0.0010<!-- a.b:4 -->"),
        ("by −100<!-- c:-1 --> m", "by −110<!-- c:-1 --> m"),
    ],
)
def test_what_stands_in_a_marked_place_is_replaced(text: str, right: str) -> None:
    assert filled(text, KNOWN) == right
    assert filled(right, KNOWN) == right


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("0.1<!-- a.d -->", "no such figure: a.d"),
        ("some<!-- c -->", "have no number before them"),
        ("1 ± 2<!-- c -->", "c has no sigma"),
    ],
)
def test_a_mark_that_means_nothing_is_refused(text: str, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        filled(text, KNOWN)
