"""Every equation, table and figure of the papers has a row, and the summary in docs/ is of these rows."""

from pathlib import Path

from twin.validation import registry
from twin.validation.check import PAPERS, REFUTED
from twin.validation.row_names import matches
from twin.validation.runner import run_checks

DOCS = Path(__file__).resolve().parents[2] / "docs"
SUMMARIES = DOCS / "validation" / "README.md", DOCS / "real_data.md"
IDS = {
    "000": "eq1 eq2 eq3 eq4 eq5 eq6 eq7 table1 fig3 fig4 fig5 height",
    "001": "eq1 eq2 eq3 eq4 eq5 eq6 eq7 eq8 eq9 eq10 eq11 eq12 table1 table2 table3 table4 table5",
    "003": "equations model table1 table2 table3 table4 table5 table6 table7 fig4 fig5 fig6 "
    "scheme1 scheme2 scheme3 scheme4 scheme5 scale50000",
    "004": "eq1 eq2 eq3 eq4 table1 table2 turntable alignment",
    "017": "bundle",
    "real": "edges.colour edges.mono rpcm pleiades spot6 oem spots",
}
"""What the papers number, and what they claim without a number."""
CHECKS = {check.id: check for group in registry.GROUPS for check in group.checks}


def test_everything_that_is_printed_has_a_row():
    assert set(IDS) == set(PAPERS)
    for prefix in (f"{paper}.{name}" for paper, names in IDS.items() for name in names.split()):
        assert [name for check in CHECKS.values() for name in check.names if matches(name, prefix)], prefix


def test_the_summary_in_the_docs_is_of_these_checks():
    """Made by full runs; their verdicts are the expected ones."""
    rows = {}
    for line in (line for file in SUMMARIES for line in file.read_text("utf-8").splitlines()):
        cells = line.strip("| ").split(" | ")
        if line.startswith("| `") and cells[0].split("`")[1] in CHECKS:
            identifier = cells[0].split("`")[1]
            rows[identifier] = cells[-2 if identifier.startswith("real.") else -1]
    assert rows == {check.id: check.expected for check in CHECKS.values()}


def test_contradictions_within_a_paper_have_one_verdict(backend):
    """Where text and table of one paper give different numbers the text is refuted, in 001 as in 004."""
    rows = run_checks(registry.select(registry.GROUPS, "001.table2.claimed,004.table2.reduction"), backend, 1).results
    assert [row.verdict for row in rows] == 4 * [REFUTED]
    assert all("contradict each other" in row.how for row in rows)
