"""Report of an instrument as built: verdict, merits, observable combinations of motions, and the next move."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from optics.numerics.number_tree import FrozenMap
from twin.asbuilt.asbuilt_run import ALONG, AsBuiltRun, Standing, motions, moves_plain, responses
from twin.asbuilt.built_instrument import CORRELATION, POSTERIOR, instrument_text, posterior_files
from twin.framework.artefact import CameraFile, Cell, CsvFile, DecimalNumber, SvgFigure, Table, plain, significant
from twin.framework.report import Report, Section, answer
from twin.framework.svg import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    VERMILION,
    gridded,
    look,
    new_figure,
    plain_axes,
    shared_legend,
    to_svg,
)
from twin.tolerance.monitor_merit import merit_head, merit_unit, shown_merit

_MOST_COMBINATIONS = 12
"""Largest number of combinations of motions in the table."""
_FEW = 3
"""Largest number of candidate measurements that the verdict names."""
BANDS = FrozenMap({"prior": GREY, "as built": BLUE, "after the next move": GREEN})
"""Labels of the bands in a figure, and their colours."""


def asbuilt_report(run: AsBuiltRun) -> Report:
    """Return the report of an instrument as built."""
    with look("asbuilt"):
        along = to_svg(_along_figure(run))
        known = to_svg(_known_figure(run))
    told, more = answer(_verdict(run), _known_words(run), *_move_words(run))
    sections = (
        Section(
            "The camera",
            (
                "Wavefront error along the line, as drawn and as built. Bands hold the middle 68 and 95 % of what is "
                "possible: before the measurements, under the prior alone, with them, and after the next move.",
            ),
            (SvgFigure("along", "Wavefront error over the field", "", along), _range_table(run)),
            name="camera",
        ),
        Section(
            "What is known",
            (
                "Combinations of motions, the best known first, in standard deviations of the prior: 1 before the "
                "measurements. A combination that the measurements do not tell keeps its 1, and what it may do to the "
                "camera stands in the table of merits.",
            ),
            (SvgFigure("known", "What the measurements know", "", known), _known_table(run)),
            name="known",
        ),
        Section(
            "Measurements",
            ("Each measurement against what all others, the prior and the traced instrument predict of it.",),
            (_measured_table(run),),
            name="measurements",
        ),
        *_move_sections(run),
        Section(
            "Motions",
            ("Each motion by itself. Most are known in combinations alone.",),
            (_motion_table(run),),
            closed=True,
            name="motions",
        ),
        Section(
            "The instrument that results",
            (
                "`instrument.yaml` is the instrument as built, which every command takes as its instrument; "
                "`posterior.yaml` beside it is what is still unknown of it, as its disturbances.",
            ),
            (CameraFile("instrument", "Instrument", "", instrument_text(run)), *_posterior(run)),
            closed=True,
            name="instrument",
        ),
    )
    kinds = [f"{kind.name} ({len(kind.labels)} numbers)" for kind in run.bench.kinds]
    facts = (
        ("instrument", run.setup.test.instrument),
        ("camera", run.bench.camera),
        ("prior", f"{run.setup.test.prior}: {len(run.bench.parameters.components)} motions"),
        ("measurements", ", ".join(kinds)),
        ("moves made", ", ".join(run.bench.parameters.moves) or "none"),
        ("truth", "drawn by the program" if run.true is not None else "not known"),
    )
    title = f"{run.bench.camera} as built"
    return Report(title, told, more, facts, _summary(run), sections, warnings=run.warnings)


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _verdict(run: AsBuiltRun) -> str:
    parts = [f"{one.merit.name} with {_percent(one.meets)}" for one in run.standings]
    return f"Probability that {run.bench.camera}, as built, meets its requirements: {', '.join(parts)}"


def _known_words(run: AsBuiltRun) -> str:
    known = sum(one.known for one in run.known)
    agreement = run.found.whole
    fits = "fit" if agreement.passes() else "do not fit"
    return (
        f"The measurements tell {known} of {len(run.known)} combinations of motions and {fits} the prior and their "
        f"errors (chi-square {agreement.chi_square:.0f} of {agreement.degrees})"
    )


def _move_words(run: AsBuiltRun) -> list[str]:
    step = run.advice
    if step is None:
        return []
    moves = {name: amount for name, amount in moves_plain(run, step.move.amounts).items() if not _is_nothing(run, name)}
    if not moves:
        return ["No move of the actuators would improve the expected merit"]
    text = ", ".join(f"{name} by {_short(amount)}" for name, amount in moves.items())
    out = [
        f"Next move: {text}; the expected merit falls from {step.before:.3g} to {step.after:.3g}, of which "
        f"{step.ignorance:.3g} is what is not known and could be mended"
    ]
    worth = sorted(step.worth.items(), key=lambda item: -item[1])[:_FEW]
    if worth:
        text = ", ".join(f"{name} {value:.3g}" for name, value in worth)
        out.append(f"One more measurement before the move would lower it further, by {text}")
    return out


def _is_nothing(run: AsBuiltRun, name: str) -> bool:
    assert run.advice is not None
    return bool(run.advice.move.amounts[run.bench.parameters.names.index(name)] == 0.0)


def _short(amount: str | float) -> str:
    """Return an amount as text with four digits."""
    if isinstance(amount, str):
        number, _, unit = amount.partition(" ")
        return f"{plain(float(number), 4)} {unit}"
    return plain(amount, 4)


def _cell(value: float, one: Standing) -> Cell:
    found = shown_merit(value, one.merit)
    if found is None:
        return None
    spread = shown_merit(one.now[3], one.merit) or 0.0
    places = 3 if abs(spread) < 10.0 else 1
    return DecimalNumber(found, places)


def _between(values: Sequence[float], one: Standing) -> str:
    if not len(values):
        return ""
    low, middle, high = (shown_merit(values[k], one.merit) for k in (1, 2, 3))
    if low is None or middle is None or high is None:
        return "no light"
    return f"{significant(middle)} ({significant(low)} to {significant(high)})"


def _summary(run: AsBuiltRun) -> Table:
    rows: list[list[Cell]] = []
    moved, drawn = run.advice is not None, run.true is not None
    for one in run.standings:
        spec = one.merit.spec
        sign = "at least" if spec.more_is_better else "at most"
        row: list[Cell] = [
            merit_head(one.merit),
            f"{sign} {plain(spec.requirement / merit_unit(one.merit)[1])}",
            _cell(one.designed, one),
            _between(one.before, one),
            _between(one.now, one),
            _percent(one.meets),
        ]
        row += [_between(one.moved, one), _percent(one.meets_moved)] if moved else []
        rows.append(row + ([_cell(one.true, one)] if drawn else []))
    heads = ["merit", "asked", "designed", "prior", "as built", "meets"]
    heads += ["after the next move", "meets then"] if moved else []
    heads += ["true"] if drawn else []
    caption = (
        "Median and the middle 68 % of what is possible, by exact traces of states drawn from the prior and from the "
        "posterior distribution."
    )
    return Table("merits", "Merits", caption, heads, rows)


def _range_table(run: AsBuiltRun) -> Table:
    designed, bands = run.along
    rows: list[list[Cell]] = [
        [field[0], float(designed[f]), *(float(band[q, f]) for band in bands for q in (1, 2, 3))]
        for f, field in enumerate(ALONG)
    ]
    heads = ("field", "designed", *(text for _ in bands for text in ("16 %", "50 %", "84 %")))
    over = (("", 2), *((name, 3) for name, _ in zip(BANDS, bands, strict=False)))
    caption = "Rms wavefront error, waves. Field: share of half the line."
    return Table(
        "field", "Wavefront error along the line", caption, heads, rows, (1, *[4] * (len(heads) - 1)), over=over
    )


def _known_table(run: AsBuiltRun) -> Table:
    factor = np.sqrt(run.found.variance_factor)
    rows: list[list[Cell]] = [
        [one.name, one.value, min(1.0, one.sigma * factor), "known" if one.known else "not known"]
        for one in run.known[:_MOST_COMBINATIONS]
    ]
    heads = ("combination", "estimate", "sigma", "")
    caption = "Weights and values are in standard deviations of the prior."
    return Table("combinations", "Combinations", caption, heads, rows, (None, 3, 3, None))


def _measured_table(run: AsBuiltRun) -> Table:
    count = len(run.found.measurements)
    rows: list[list[Cell]] = []
    for kind, one in zip(run.bench.kinds, run.found.measurements, strict=True):
        left = [block for name, block, _ in run.found.excluded if name == one.name]
        rows.append(
            [
                one.name,
                kind.kind,
                len(kind.labels),
                one.chi_square,
                one.degrees,
                one.p_value,
                "agrees" if one.passes(count) else "contradicts",
                ", ".join(left),
            ]
        )
    heads = ("measurement", "kind", "numbers", "chi-square", "degrees", "p", "", "excluded")
    caption = "p: probability of so large a chi-square if prior and errors are as specified."
    decimals = (None, None, None, 1, None, 4, None, None)
    return Table("measurements", "Consistency of the measurements", caption, heads, rows, decimals)


def _move_sections(run: AsBuiltRun) -> tuple[Section, ...]:
    step = run.advice
    if step is None:
        return ()
    bench = run.bench
    moves = moves_plain(run, step.move.amounts)
    made = bench.parameters.moved(run.found.mean[None], bench.last)[0]
    done = moves_plain(run, made)
    rows: list[list[Cell]] = [
        [name, one.motion, _short(done[name]), _short(moves[name]), str(one.range), str(one.step or "")]
        for name, one in run.setup.test.actuators.items()
    ]
    heads = ("actuator", "motion", "stands at", "move by", "range", "step")
    caption = "Stands at: what all moves so far have come to, as estimated."
    tables: list[Table] = [Table("move", "Next move", caption, heads, rows)]
    if step.worth:
        worth: list[list[Cell]] = [
            [name, value] for name, value in sorted(step.worth.items(), key=lambda item: -item[1])
        ]
        caption = "By how much the expected merit after the move would be lower if this were measured before it."
        tables.append(Table("worth", "Worth of a measurement", caption, ("measurement", "worth"), worth, (None, 4)))
    told = responses(run)
    if told:
        lines: list[list[Cell]] = [[name, one["response"], one["sigma"]] for name, one in told.items()]
        caption = "Of what was traced, from the moves that were made and measured."
        told_by = ("actuator", "response", "sigma")
        tables.append(Table("responses", "Responses of the actuators", caption, told_by, lines, (None, 3, 3)))
    text: tuple[str, ...] = (
        f"The move makes the expected sum of squares of all merits least, each in units of its requirement: "
        f"{step.before:.3g} before and {step.after:.3g} after it, over states of the posterior and the errors of the "
        f"move, by exact traces. {step.ignorance:.3g} of it could be mended if the state were known.",
    )
    if not step.move.searched:
        text = (*text, "Not all whole steps were tried: a better move may exist.")
    return (Section("The next move", text, tuple(tables), name="move"),)


def _motion_table(run: AsBuiltRun) -> Table:
    every = motions(run)
    rows: list[list[Cell]] = [
        [
            one["motion"],
            one["unit"],
            one["prior_sigma"],
            one["value"],
            one["sigma"],
            *([one["true"]] if "true" in one else []),
        ]
        for one in every
    ]
    heads = ("motion", "unit", "prior sigma", "estimate", "sigma", *(["true"] if run.true is not None else []))
    return Table("motions", "Motions", "", heads, rows, (None, None, *[3] * (len(heads) - 2)))


def _posterior(run: AsBuiltRun) -> tuple[CameraFile, ...]:
    text, table = posterior_files(run)
    own = CameraFile(POSTERIOR, "Posterior", "", text)
    return (own,) if table is None else (own, CsvFile(CORRELATION, "Its correlations", "", table))


def _along_figure(run: AsBuiltRun) -> Figure:
    designed, bands = run.along
    x = np.array([field[0] for field in ALONG])
    figure = new_figure(2.9)
    ax = figure.subplots()
    for band, (label, colour) in zip(bands, BANDS.items(), strict=False):
        ax.fill_between(x, band[0], band[4], color=colour, alpha=0.15, lw=0)
        ax.fill_between(x, band[1], band[3], color=colour, alpha=0.25, lw=0)
        ax.plot(x, band[2], color=colour, lw=1.6, label=label)
    ax.plot(x, designed, color=INK, lw=1.0, ls="--", label="designed")
    limits = [one.merit.spec.requirement for one in run.standings if one.merit.spec.kind == "wavefront"]
    if limits:
        ax.axhline(limits[0], color=VERMILION, lw=1.0, label="asked")
    ax.set_yscale("log")
    ax.set_ylim(0.5 * float(np.min(designed)))
    ax.set_xlabel("field along the line")
    ax.set_ylabel("rms wavefront error [waves]")
    shared_legend(figure, ax)
    gridded(ax)
    return figure


def _known_figure(run: AsBuiltRun) -> Figure:
    sigma = np.array([one.sigma for one in run.known])
    figure = new_figure(2.2)
    ax = figure.subplots()
    number = np.arange(1, len(sigma) + 1)
    known = np.array([one.known for one in run.known])
    for which, colour, label in ((known, BLUE, "known"), (~known, ORANGE, "not known")):
        ax.bar(number[which], sigma[which], 0.8, color=colour, label=label)
    ax.set_xlabel("combination")
    ax.set_ylabel("sigma over prior")
    ax.set_ylim(0.0, 1.05)
    ax.legend(loc="upper left")
    plain_axes(ax)
    return figure
