"""The Jacobian of a study as plain data and as tables."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich import box
from rich.table import Table as RichTable

from scenes.errors import key_text
from twin.artefact import Cell, Table
from twin.report.numbers import plain, significant
from twin.study.gradient import AD, Gradient
from twin.study.report.study_runs import typeset

DOUBTFUL = 0.01
"""Differences that Richardson's extrapolation moved by more than this share of a response's largest change are told."""


def unit_text(response: str, factor: str) -> str:
    """Unit of a derivative."""
    if not factor:
        return response or "1"
    return f"{response or '1'}/{factor}" if "/" not in factor else f"{response or '1'}/({factor})"


def plain_data(found: Gradient) -> dict[str, Any]:
    """Contents of gradient.json; rows are responses, columns factors."""
    units = [[unit_text(unit, factor.unit) for factor in found.factors] for unit in found.units]
    return {
        "responses": list(found.responses),
        "factors": [factor.name for factor in found.factors],
        "response_units": list(found.units),
        "factor_units": [factor.unit for factor in found.factors],
        "base": [factor.value for factor in found.factors],
        "spread": [factor.spread for factor in found.factors],
        "spread_of": [factor.spread_of for factor in found.factors],
        "units": units,
        "ad": _rows(found.ad),
        "differences": _rows(found.differences),
        "difference_error": _rows(found.error),
        "step": _rows(found.step),
        "relative": _rows(found.relative),
        "worst_relative": found.worst,
        "change": _rows(found.change),
        "method": found.method.tolist(),
    }


def _rows(table: np.ndarray) -> list[list[float | None]]:
    return [[None if np.isnan(value) else float(value) + 0.0 for value in row] for row in table]


HEADS = (
    "response",
    "factor",
    "unit",
    "method",
    "AD",
    "differences",
    "relative deviation",
    "extrapolated by",
    "step",
    "change per spread",
)


def whole_table(found: Gradient) -> Table:
    """Every entry of the Jacobian, a row each."""
    rows: list[list[Cell]] = []
    numbers = (found.ad, found.differences, found.relative, found.error, found.step, found.change)
    for i, response in enumerate(found.responses):
        for k, factor in enumerate(found.factors):
            cells = [None if np.isnan(table[i, k]) else float(table[i, k]) + 0.0 for table in numbers]
            unit = unit_text(found.units[i], factor.unit)
            rows.append([response, factor.name, unit, str(found.method[i, k]), *cells])
    return Table("gradient", "Jacobian", "All entries.", HEADS, rows)


def response_table(found: Gradient) -> Table:
    """Per response: the factor that moves it most, its derivative, and how well AD and differences agree."""
    rows: list[list[Cell]] = []
    change, relative = found.change, found.relative
    for i, response in enumerate(found.responses):
        k = int(np.argmax(np.abs(change[i])))
        factor = found.factors[k]
        known = ~np.isnan(relative[i])
        worst = float(np.max(relative[i, known])) if np.any(known) else None
        exact = int(np.sum(found.method[i] == AD))
        total = float(np.linalg.norm(change[i]))
        none = total == 0.0
        rows.append(
            [
                response,
                "none" if none else factor.name,
                "" if none else significant(float(found.best[i, k]), 6, floor=0.0),
                "" if none else unit_text(typeset(found.units[i]), typeset(factor.unit)),
                "" if none else significant(float(change[i, k]), 3, floor=0.0),
                significant(total, 3, floor=0.0),
                typeset(found.units[i]),
                f"{exact} of {len(found.factors)}",
                significant(worst, 3, floor=0.0) if worst is not None else "\N{EM DASH}",
            ]
        )
    heads = (
        "response",
        "strongest factor",
        "derivative",
        "unit",
        "change per spread",
        "all factors together (rss)",
        "unit of the change",
        "entries by AD",
        "worst AD against differences",
    )
    caption = (
        "Change per spread: when the factor changes by its sigma, or by half of its range. Together: root of the sum "
        "of squares over all factors, which is the response's standard deviation where it is linear, the spreads are "
        "sigmas and the factors independent."
    )
    return Table("responses", "Responses", caption, heads, rows)


def factor_rows(found: Gradient) -> Table:
    """What was differentiated by."""
    rows: list[list[Cell]] = []
    for k, factor in enumerate(found.factors):
        keys = [*factor.spec.places, *(scale.key for scale in factor.spec.scales)]
        where = key_text(keys[0]) + (f" and {len(keys) - 1} more" if len(keys) > 1 else "")
        exact = bool(np.any(found.method[:, k] == AD))
        steps = sorted({significant(float(step), 3, floor=0.0) for step in found.step[:, k]})
        kind = "AD and differences" if exact else "differences"
        spread = f"{plain(factor.spread)} ({factor.spread_of})"
        value = plain(factor.value, 6)
        rows.append([factor.name, where, typeset(factor.unit), value, spread, ", ".join(steps), kind])
    heads = ("factor", "in the base", "unit", "value in the base", "spread", "steps", "method")
    caption = "Differences are central, at the step and half of it, extrapolated after Richardson."
    return Table("factors", "Factors", caption, heads, rows)


def doubtful(found: Gradient) -> list[str]:
    """Responses some of whose differences are not to be trusted to 1%: noise, or a step over a kink or a bend."""
    spread = np.array([factor.spread for factor in found.factors])
    largest = np.max(np.abs(found.change), axis=1, initial=0.0, keepdims=True)
    bad = (found.method != AD) & (found.error * spread > DOUBTFUL * largest)
    return [
        f"{found.responses[i]}: by {', '.join(found.factors[k].name for k in np.flatnonzero(bad[i]))}"
        for i in np.flatnonzero(bad.any(axis=1))
    ]


def terminal_tables(found: Gradient) -> list[RichTable]:
    """What the command prints."""
    worst = f"; AD and differences agree to {significant(found.worst, 3, floor=0.0)}" if found.worst is not None else ""
    title = f"{len(found.responses)} responses by {len(found.factors)} factors{worst}"
    table = RichTable(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    shown = response_table(found)
    picked = [0, 1, 2, 3, 4, 5, 8]
    heads = ("response", "strongest factor", "derivative", "unit", "per spread", "all, rss", "AD-diff.")
    for head, k in zip(heads, picked, strict=True):
        table.add_column(head, justify="left" if k in (0, 1, 3) else "right", no_wrap=True)
    for row in shown.rows:
        table.add_row(*(str(row[k]) for k in picked))
    return [table]
