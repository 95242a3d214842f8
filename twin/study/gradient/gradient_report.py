"""Command ``python -m twin.study --gradient``: the Jacobian of a study as data, figures, tables and a report.

The Jacobian holds the derivatives of the study's responses (result numbers) with respect to its factors (inputs). The
spread of a factor is the sigma of its normal distribution, otherwise half of the range of its values.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from rich.console import Console

from scenes.models.camera_sharpness import blur_warnings
from scenes.specs.file_kinds import read_for
from scenes.yaml.errors import key_text
from twin.framework import cli, command, page, procedure, provenance, record, run_folder, svg
from twin.framework.artefact import Cell, SvgFigure, Table, plain, significant
from twin.framework.record import Quantity, Record
from twin.framework.report import Report, Section, answer
from twin.framework.run_folder import RunFolder
from twin.sensors.area_detector import coarse_warnings
from twin.study.gradient.study_gradient import AD, Gradient, study_gradient
from twin.study.report.study_statistics import typeset
from twin.study.runs.setup import PROGRAM, StudySetup, base_of, resolve_study

DOUBTFUL_TEXT = (
    "Finite differences not accurate to 1% of the response's largest change (their step crosses a bend, or the job "
    "is noisy)"
)
"""Beginning of the warning that finite differences are inaccurate."""


def _write_report(setup: StudySetup, gradient: Gradient, folder: RunFolder, warnings: Sequence[str] = ()) -> None:
    """Write report.html, its figures and tables into an open run folder.

    Parameters
    ----------
    setup : StudySetup
        Study with its base job, factors and responses.
    gradient : Gradient
        Jacobian of the study.
    folder : RunFolder
        Folder of the study.
    warnings : sequence of str
        Warnings for the user.
    """
    with svg.look("gradient"):
        figure = SvgFigure(
            "heat-map",
            "Sensitivity of each response to each factor",
            "Change of each response per spread of each factor, as a share of the response's largest one; the scale is "
            "logarithmic above 0.001.",
            svg.to_svg(_heat_map(gradient)),
        )
    study = setup.study
    about = (
        f"Derivatives of {len(gradient.responses)} responses by {len(gradient.factors)} factors of "
        f"{study.base.command}, at "
        "the base's values; the design is not used.",
        f"{int((gradient.method == AD).sum())} of {gradient.method.size} entries are by automatic differentiation "
        "through "
        f"the trace.{_difference_text(gradient)} All other entries are differences. Spots are means of rays, which are "
        "the energy centroids; estimators are applied to them.",
    )
    head, more = verdict(gradient)
    report = Report(
        f"{study.name}: gradient",
        head,
        (*more, *([study.description] if study.description else ()), *about),
        (),
        _response_table(gradient),
        (Section("Sensitivity", (), (figure,)), Section("Factors", (), (_factor_rows(gradient),))),
        warnings=tuple(warnings),
    )
    page.write_artefacts(report.artefacts, folder)
    numbers = page.links(("gradient.csv", "gradient.json", "config.yaml"))
    folder.write_text(
        "report.html", page.report_page(report, (PROGRAM, "config.yaml", "--gradient"), [("Numbers", numbers)])
    )


def _difference_text(gradient: Gradient) -> str:
    if gradient.worst is None:
        return ""
    return (
        f" They and central differences through perturbed traces agree to {significant(gradient.worst, 3, floor=0.0)}: "
        "relative to the entry, but for entries below 0.001 of their response's largest one relative to that; and for "
        "a response that is a difference of two numbers, relative to these."
    )


def verdict(gradient: Gradient) -> tuple[str, tuple[str, ...]]:
    """Return the verdict, on which factors dominate and how accurate that statement is, and further sentences."""
    moved = [i for i in range(len(gradient.responses)) if np.any(gradient.change[i])]
    strongest = Counter(gradient.factors[int(np.argmax(np.abs(gradient.change[i])))].name for i in moved)
    total = len(gradient.responses)
    first = [f"the factor {name} dominates {count} of {total} responses" for name, count in strongest.most_common(2)]
    still = total - len(moved)
    sure = ""
    if gradient.worst is not None:
        sure = f"automatic differentiation and differences agree to {significant(gradient.worst, 2, floor=0.0)}"
    return answer(
        ", ".join(first) or "No factor moves any response",
        sure,
        f"no factor moves {still} of the responses" if moved and still else "",
        "see the sensitivity",
    )


def _response_table(gradient: Gradient) -> Table:
    """Return the table of each response's dominant factor, its derivative, and the error of finite differences."""
    rows: list[list[Cell]] = []
    change, relative = gradient.change, gradient.relative
    for i, response in enumerate(gradient.responses):
        k = int(np.argmax(np.abs(change[i])))
        factor = gradient.factors[k]
        known = ~np.isnan(relative[i])
        worst = float(np.max(relative[i, known])) if np.any(known) else None
        exact = int(np.sum(gradient.method[i] == AD))
        total = float(np.linalg.norm(change[i]))
        none = total == 0.0
        rows.append(
            [
                response,
                "none" if none else factor.name,
                "" if none else significant(float(gradient.best[i, k]), 6, floor=0.0),
                "" if none else _unit_text(typeset(gradient.units[i]), typeset(factor.unit)),
                "" if none else significant(float(change[i, k]), 3, floor=0.0),
                significant(total, 3, floor=0.0),
                typeset(gradient.units[i]),
                f"{exact} of {len(gradient.factors)}",
                significant(worst, 3, floor=0.0) if worst is not None else "\N{EM DASH}",
            ]
        )
    heads = ("response", "strongest factor", "derivative", "unit", "change per spread", "all factors together (rss)")
    more = ("unit of the change", "entries by AD", "worst AD against differences")
    caption = (
        "Change per spread: when the factor changes by its sigma, or by half of its range. Together: root of the sum "
        "of squares over all factors, which is the response's standard deviation where it is linear, the spreads are "
        "sigmas and the factors independent."
    )
    return Table("responses", "Responses", caption, (*heads, *more), rows)


def _factor_rows(gradient: Gradient) -> Table:
    """Return the table of the factors: value in the base job, spread, and step of the finite differences."""
    rows: list[list[Cell]] = []
    for k, factor in enumerate(gradient.factors):
        keys = [*factor.spec.key_paths, *(scale.key for scale in factor.spec.scales)]
        where = key_text(keys[0]) + (f" and {len(keys) - 1} more" if len(keys) > 1 else "")
        exact = bool(np.any(gradient.method[:, k] == AD))
        steps = sorted({significant(float(step), 3, floor=0.0) for step in gradient.step[:, k]})
        kind = "AD and differences" if exact else "differences"
        spread = f"{plain(factor.spread)} ({factor.spread_of})"
        value = plain(factor.value, 6)
        rows.append([factor.name, where, typeset(factor.unit), value, spread, ", ".join(steps), kind])
    heads = ("factor", "in the base", "unit", "value in the base", "spread", "steps", "method")
    caption = "Differences are central, at the step and half of it, extrapolated after Richardson."
    return Table("factors", "", caption, heads, rows)


LINEAR = 1e-3
"""Threshold between the linear and the logarithmic part of the heat map's colour scale.

It is relative to the response's largest change due to the spread of any factor.
"""


def _heat_map(gradient: Gradient) -> Figure:
    """Plot each response's change due to each factor's spread, relative to its largest, as colours; factors along y."""
    largest = np.max(np.abs(gradient.change), axis=1, initial=0.0, keepdims=True)
    shares = np.where(largest > 0.0, gradient.change / np.where(largest > 0.0, largest, 1.0), 0.0).T
    rows, columns = shares.shape
    figure = svg.new_figure(2.1 + 0.21 * max(rows, 4))
    axes = figure.subplots()
    norm = SymLogNorm(LINEAR, vmin=-1.0, vmax=1.0)
    picture = axes.imshow(shares, cmap="RdBu", norm=norm, aspect="auto", interpolation="nearest")
    axes.set_xticks(np.arange(columns), list(gradient.responses), rotation=45, ha="right", rotation_mode="anchor")
    axes.set_yticks(np.arange(rows), [factor.name for factor in gradient.factors])
    axes.set_xticks(np.arange(columns + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(rows + 1) - 0.5, minor=True)
    axes.grid(which="minor", color=svg.LIGHT, lw=0.5)
    axes.tick_params(which="minor", length=0)
    axes.tick_params(which="major", length=0)
    axes.spines[:].set_visible(False)
    bar = figure.colorbar(picture, ax=axes, ticks=[-1, -0.1, -0.01, 0, 0.01, 0.1, 1], fraction=0.03, pad=0.01)
    bar.ax.set_yticklabels([f"{t:+g}".replace("-", "\N{MINUS SIGN}") if t else "0" for t in bar.get_ticks()])
    bar.set_label("change per spread / largest of the response")
    bar.outline.set_visible(False)
    bar.minorticks_off()
    return figure


DOUBTFUL = 0.01
"""Error estimate of a finite difference above which it is reported as inaccurate.

The estimate is the correction by Richardson's extrapolation, relative to the response's largest change due to the
spread of any factor.
"""


def _unit_text(response: str, factor: str) -> str:
    """Return the unit of a derivative of a response with respect to a factor as text."""
    if not factor:
        return response or "1"
    return f"{response or '1'}/{factor}" if "/" not in factor else f"{response or '1'}/({factor})"


def _entries(of: Callable[[Gradient], np.ndarray]) -> Callable[[Gradient], list[list[float | None]]]:
    """Return a function that writes an (R, F) array of a Jacobian as nested lists, with None for NaN.

    R responses, F factors; ``of`` selects the array of the Jacobian, such as its derivatives or their errors.
    """

    def rows(gradient: Gradient) -> list[list[float | None]]:
        return [[None if np.isnan(value) else float(value) + 0.0 for value in row] for row in of(gradient)]

    return rows


GRADIENT: Record[Gradient] = Record(
    "gradient.json: the Jacobian of a study at the base's values; rows are responses, columns factors.",
    Quantity("responses", lambda g: g.responses, "names of the rows"),
    Quantity("factors", lambda g: [factor.name for factor in g.factors], "names of the columns"),
    Quantity("response_units", lambda g: g.units, "unit of every response, empty for a pure number"),
    Quantity("factor_units", lambda g: [factor.unit for factor in g.factors], "unit of every factor"),
    Quantity("base", lambda g: [factor.value for factor in g.factors], "value of every factor in the base"),
    Quantity("spread", lambda g: [factor.spread for factor in g.factors], "sigma of every factor, or half its range"),
    Quantity("spread_of", lambda g: [factor.spread_of for factor in g.factors], "which of the two a spread is"),
    Quantity(
        "units", lambda g: [[_unit_text(u, factor.unit) for factor in g.factors] for u in g.units], "of entries", "unit"
    ),
    Quantity("ad", _entries(lambda g: g.ad), "derivative by automatic differentiation", "AD"),
    Quantity("differences", _entries(lambda g: g.differences), "derivative by central differences", "differences"),
    Quantity("difference_error", _entries(lambda g: g.error), "what the extrapolation changed", "extrapolated by"),
    Quantity("step", _entries(lambda g: g.step), "step of the differences, in the factor's unit", "step"),
    Quantity("relative", _entries(lambda g: g.relative), "differences against AD, relative", "relative deviation"),
    Quantity("worst_relative", lambda g: g.worst, "largest relative deviation, None without AD"),
    Quantity("change", _entries(lambda g: g.change), "change per spread of the factor", "change per spread"),
    Quantity("method", lambda g: g.method.tolist(), "method of the best value of an entry", "method"),
)


def _whole_table(gradient: Gradient) -> Table:
    """Return the table of every derivative of the Jacobian, one row for each response and factor."""
    values = GRADIENT(gradient)
    keys = ("units", "method", "ad", "differences", "relative", "difference_error", "step", "change")
    rows = [
        [response, factor, *(values[key][i][k] for key in keys)]
        for i, response in enumerate(values["responses"])
        for k, factor in enumerate(values["factors"])
    ]
    heads = ("response", "factor", *(GRADIENT[key].head for key in keys))
    return Table("gradient", "Jacobian", "All entries.", heads, rows)


def _doubtful(gradient: Gradient) -> list[str]:
    """Return the responses whose finite differences are not accurate to 1 % of the largest change.

    Possible causes are noise, or a discontinuity of the response or of its slope within the step.
    """
    spread = np.array([factor.spread for factor in gradient.factors])
    largest = np.max(np.abs(gradient.change), axis=1, initial=0.0, keepdims=True)
    bad = (gradient.method != AD) & (gradient.error * spread > DOUBTFUL * largest)
    return [
        f"{gradient.responses[i]}: by {', '.join(gradient.factors[k].name for k in np.flatnonzero(bad[i]))}"
        for i in np.flatnonzero(bad.any(axis=1))
    ]


def run_gradient(file: Path, options: cli.Options) -> None:
    """Read a study, differentiate it at its base job's values, write the Jacobian and a report, and print it.

    Parameters
    ----------
    file : Path
        Study, or a config.yaml.
    options : cli.Options
        Options of the command.

    Raises
    ------
    typer.Exit
        The command failed; the error has been printed, and the exit code is set.
    """
    command.run_command(f"{file.stem}-gradient", options, lambda: read_for(PROGRAM, file, resolve_study), _work)


def _work(setup: StudySetup, session: procedure.Session) -> command.Result:
    gradient = study_gradient(setup, session.backend, session.advance)
    session.advance(procedure.WRITE, 0, 1)
    folder = session.folder
    base = base_of(setup)
    bad = _doubtful(gradient)
    notes = [f"{DOUBTFUL_TEXT}: {'; '.join(bad)}"] if bad else []
    warnings = (*blur_warnings(base, session.backend), *coarse_warnings(base), *notes)
    summary = {"verdict": verdict(gradient)[0], "warnings": list(warnings)}
    numbers = record.described("gradient", {**GRADIENT(gradient), **summary})
    folder.write_text("config.yaml", setup.to_yaml())
    folder.write_json("gradient.json", numbers)
    folder.write_bytes("gradient.csv", _whole_table(gradient).content())
    _write_report(setup, gradient, folder, warnings)
    entries: dict[str, Any] = {"gradient": True, "backend": session.backend.name, "worst_relative": gradient.worst}
    entries["again"] = [PROGRAM, "config.yaml", "--gradient", "--backend", session.backend.name]
    entries["inputs"] = provenance.inputs_in(setup.tree)
    run_folder.write_manifest(folder, PROGRAM, session.started, session.seconds, warnings=list(warnings), **entries)
    return command.Result(numbers, lambda console: _print_result(gradient, warnings, console))


def _print_result(gradient: Gradient, warnings: Sequence[str], console: Console) -> None:
    cli.print_verdict(console, verdict(gradient)[0], warned=bool(warnings))
    table = cli.result_table(f"{len(gradient.responses)} responses by {len(gradient.factors)} factors")
    picked = [0, 1, 2, 3, 4, 5, 8]
    heads = ("response", "strongest factor", "derivative", "unit", "per spread", "all, rss", "AD-diff.")
    for head, k in zip(heads, picked, strict=True):
        table.add_column(head, justify="left" if k in (0, 1, 3) else "right", no_wrap=True)
    for row in _response_table(gradient).rows:
        table.add_row(*(str(row[k]) for k in picked))
    cli.print_whole(console, table)
    command.print_warnings(console, warnings)
