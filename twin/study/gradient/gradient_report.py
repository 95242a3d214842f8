"""The Jacobian of a study as data, tables and figures."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from rich import box
from rich.table import Table as RichTable

from scenes.yaml.errors import key_text
from twin.run.artefact import Cell, Table, plain, significant
from twin.run.svg import BLUE, INK, LIGHT, VERMILION, new_figure
from twin.study.gradient.study_gradient import AD, Gradient
from twin.study.report.study_figures import finish
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


MOST_BARS = 8
LINEAR = 1e-3
"""Share of a response's largest change below which the colours are linear."""
NEGLIGIBLE = 1e-3
"""Share of a response's largest change below which no bar is drawn."""


def normalised(found: Gradient) -> np.ndarray:
    """(R, F) changes per spread as shares of each response's largest; zeros for responses that nothing moves."""
    change = found.change
    largest = np.max(np.abs(change), axis=1, initial=0.0, keepdims=True)
    return np.asarray(np.where(largest > 0.0, change / np.where(largest > 0.0, largest, 1.0), 0.0))


def heat_map(found: Gradient) -> Figure:
    """Responses along x, factors down, coloured by the normalised change."""
    shares = normalised(found).T
    rows, columns = shares.shape
    figure = new_figure(2.1 + 0.21 * max(rows, 4))
    axes = figure.subplots()
    norm = SymLogNorm(LINEAR, vmin=-1.0, vmax=1.0)
    picture = axes.imshow(shares, cmap="RdBu", norm=norm, aspect="auto", interpolation="nearest")
    axes.set_xticks(np.arange(columns), list(found.responses), rotation=45, ha="right", rotation_mode="anchor")
    axes.set_yticks(np.arange(rows), [factor.name for factor in found.factors])
    axes.set_xticks(np.arange(columns + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(rows + 1) - 0.5, minor=True)
    axes.grid(which="minor", color=LIGHT, lw=0.5)
    axes.tick_params(which="minor", length=0)
    axes.tick_params(which="major", length=0)
    axes.spines[:].set_visible(False)
    bar = figure.colorbar(picture, ax=axes, ticks=[-1, -0.1, -0.01, 0, 0.01, 0.1, 1], fraction=0.03, pad=0.01)
    bar.ax.set_yticklabels([f"{t:+g}".replace("-", "\N{MINUS SIGN}") if t else "0" for t in bar.get_ticks()])
    bar.set_label("change per spread / largest of the response")
    bar.outline.set_visible(False)
    bar.minorticks_off()
    return figure


def tornado(found: Gradient) -> Figure:
    """Per response the largest changes per spread."""
    change = found.change
    moved = [i for i in range(len(found.responses)) if np.any(change[i])]
    largest = [_largest(change[i]) for i in moved]
    wide = 2
    heights = [0.85 + 0.2 * max(len(one) for one in largest[k : k + wide]) for k in range(0, len(moved), wide)]
    figure = new_figure(max(sum(heights), 1.5))
    grid = figure.subplots(max(len(heights), 1), wide, squeeze=False, height_ratios=heights or None).ravel()
    for axes in grid[len(moved) :]:
        axes.set_axis_off()
    for axes, i, order in zip(grid, moved, largest, strict=False):
        _bars(axes, found, i, order)
    return figure


def _largest(change: np.ndarray) -> np.ndarray:
    order = np.argsort(-np.abs(change), kind="stable")[:MOST_BARS]
    return np.asarray(order[np.abs(change[order]) > NEGLIGIBLE * np.abs(change).max()])


def _bars(axes: Axes, found: Gradient, i: int, order: np.ndarray) -> None:
    values = found.change[i, order][::-1]
    y = np.arange(len(order))
    axes.barh(y, values, 0.66, color=[BLUE if value >= 0 else VERMILION for value in values])
    axes.axvline(0.0, color=INK, lw=0.8)
    axes.set_yticks(y, [found.factors[k].name for k in order[::-1]])
    unit = f", {typeset(found.units[i])}" if found.units[i] else ""
    rss = significant(float(np.linalg.norm(found.change[i])), 3, floor=0.0)
    axes.set_xlabel(f"{found.responses[i]}{unit} (all: {rss})")
    axes.set_ylim(-0.7, max(len(order), 2) - 0.3)
    finish(axes, 5, None)
    axes.grid(False, axis="y")
