"""The Jacobian of a study as data: contents of gradient.json and gradient.csv, and what is not to be trusted."""

from __future__ import annotations

from typing import Any

import numpy as np

from twin.run.artefact import Cell, Table
from twin.study.gradient.study_gradient import AD, Gradient

DOUBTFUL = 0.01
"""Differences that Richardson's extrapolation moved by more than this share of a response's largest change are told."""


def unit_text(response: str, factor: str) -> str:
    """Unit of a derivative."""
    if not factor:
        return response or "1"
    return f"{response or '1'}/{factor}" if "/" not in factor else f"{response or '1'}/({factor})"


def gradient_numbers(found: Gradient) -> dict[str, Any]:
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


def doubtful(found: Gradient) -> list[str]:
    """Responses some of whose differences are not to be trusted to 1%: noise, or a step over a kink or a bend."""
    spread = np.array([factor.spread for factor in found.factors])
    largest = np.max(np.abs(found.change), axis=1, initial=0.0, keepdims=True)
    bad = (found.method != AD) & (found.error * spread > DOUBTFUL * largest)
    return [
        f"{found.responses[i]}: by {', '.join(found.factors[k].name for k in np.flatnonzero(bad[i]))}"
        for i in np.flatnonzero(bad.any(axis=1))
    ]
