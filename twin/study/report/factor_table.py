"""What was varied, as a table."""

from __future__ import annotations

import numpy as np

from scenes.errors import key_text
from scenes.study_factor import FactorSpec
from twin.artefact import Cell, Table
from twin.report.numbers import plain
from twin.study.report.study_runs import Factor, StudyRuns, typeset
from twin.study.report.wording import plural

MOST_NAMED = 6


def factor_table(runs: StudyRuns) -> Table:
    """Name, where it acts, distribution and the values that were run."""
    rows: list[list[Cell]] = []
    for factor in runs.factors:
        places = [key_text(place) for place in factor.spec.places]
        places += [f"{key_text(scale.key)} (power {scale.power:g})" for scale in factor.spec.scales]
        rows.append([factor.name, typeset(factor.unit), "; ".join(places), _source(factor.spec), _values(factor)])
    heads = ("factor", "unit", "in the base", "distribution", "values run")
    return Table("factors", "Factors", "What was varied.", heads, rows)


def _source(spec: FactorSpec) -> str:
    if spec.kind == "table":
        assert spec.table is not None
        return f"table {spec.table.file}, column {spec.table.column}"
    if spec.kind == "values":
        return f"list of {plural(len(spec.scalars()), 'value')}"
    values = [plain(value, 6) for value in spec.numbers().values]
    if spec.kind == "normal":
        return f"normal, mean {values[0]}, σ {values[1]}"
    if spec.kind == "truncated":
        return f"normal, mean {values[0]}, σ {values[1]}, cut to {values[2]} … {values[3]}"
    return f"{spec.kind}, {values[0]} … {values[1]}"


def _values(factor: Factor) -> str:
    levels = factor.levels
    if not factor.numeric:
        named = [str(level) for level in levels[:MOST_NAMED]]
        return ", ".join(named) + (f" and {len(levels) - MOST_NAMED} more" if len(levels) > MOST_NAMED else "")
    if len(levels) <= MOST_NAMED:
        return ", ".join(plain(float(level), 6) for level in levels)
    return f"{plain(float(np.min(levels)), 5)} … {plain(float(np.max(levels)), 5)}"
