"""Paper 001's principle experiment, Table 2, from rendered spots."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from analysis.monitoring import ARCSEC
from scenes.load import load_principle_experiment
from twin.artefact import Cell, PngFigure, Table
from twin.principle_checks import principle_checks
from twin.principle_experiment import Reader, run_principle_experiment
from twin.principle_figure import write_principle_figure
from twin.principle_printed import ANGLES
from twin.principle_table import PrincipleTable
from twin.validation.check import DOUBTFUL, Check, CheckResult, Explanation
from twin.validation.group import CheckGroup, Context

_SPREAD = "half of the printed value; the scatter between benches, in sigma, is larger"

CHECKS = (
    Check("001.table2.x", "Table 2, X", "About X both mirrors turn by Δβ: mean difference", "arcsec", 0.460909, 0.230,
          _SPREAD),
    Check("001.table2.y", "Table 2, Y", "About Y mirror 2 reads Δα cos b: mean difference", "arcsec", 0.340353, 0.170,
          _SPREAD),
    Check("001.table2.z", "Table 2, Z", "About Z mirror 2 reads Δγ sin b: mean difference", "arcsec", 0.177646, 0.089,
          _SPREAD),
    Check("001.table2.z_columns", "Table 2, Z", "The Z columns of mirrors 1 and 2 are two mirrors' readings: largest "
          "difference of the scaled columns", "arcsec", 4.66e-7, 0.01, "the last printed digit"),
)  # fmt: skip


def run(context: Context) -> Iterator[CheckResult]:
    """Render the benches and set them beside the printed table."""
    setup = load_principle_experiment()
    told = 0

    def progress(text: str) -> None:
        nonlocal told
        told += 1
        context.progress(min(0.9, 0.08 * told), text)

    reader = Reader(setup, context.backend)
    checks = principle_checks(setup, context.backend, context.seed, progress=progress, reader=reader)
    found = {check.id: check for check in checks}
    for identifier, finding in found.items():
        if identifier not in context.selected:
            continue
        reasons = []
        if identifier == "001.table2.z_columns":
            text = (
                "The two printed columns are one reading, scaled: mirror 1 turns about its own normal, which its "
                "autocollimator cannot see."
            )
            reasons = [Explanation(float(ANGLES[-1]), DOUBTFUL, text)]
        how = finding.how + "."
        yield context.check(identifier).judge(finding.measured, finding.sigma, how, None, reasons)
    context.progress(0.95, "draw")
    table = run_principle_experiment(setup, context.backend, seed=context.seed, reader=reader)
    context.add(
        Table(
            "table2",
            "Table 2 from rendered spots",
            "One bench with the declared errors, arcsec. Mirror 2 is scaled as the paper scales it: by 1, 2/√3, 2/√3.",
            ("turntable", *(f"{axis}: mirror {n}" for axis in "XYZ" for n in (1, 2))),
            _rows(table),
        )
    )
    with TemporaryDirectory() as folder:
        place = Path(folder) / "bench.png"
        write_principle_figure(reader, [table], place)
        caption = "Left: the bench seen from above, with traced rays. Right: differences from row to row."
        context.add(PngFigure("bench", "The principle experiment", caption, place.read_bytes()))


def _rows(table: PrincipleTable) -> list[list[Cell]]:
    columns = [table["X"].series.angles, *(column for axis in "XYZ" for column in table[axis].columns)]
    return [[round(float(value) / ARCSEC, 4) for value in row] for row in zip(*columns, strict=True)]


GROUP = CheckGroup("001.table2", "Principle experiment (section 3.1)", 10.0, CHECKS, run)
