"""Report of an instrument as built: verdict, merits, observable combinations of motions, and the next move."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from optics.numerics.number_tree import FrozenMap
from twin.asbuilt.asbuilt_run import ALONG, AsBuiltRun, MeritPrediction, motions, moves_plain, responses
from twin.asbuilt.built_instrument import CORRELATION, POSTERIOR, instrument_text, posterior_files
from twin.asbuilt.star_images import STAR, StarResidual
from twin.framework.artefact import (
    CameraFile,
    Cell,
    CsvFile,
    DecimalNumber,
    SvgFigure,
    Table,
    plain,
    significant,
    unit_for_reports,
)
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
"""Largest number of observable combinations of motions in the table."""
_FEW = 3
"""Largest number of further measurements that the verdict recommends by name."""
BANDS = FrozenMap({"prior": GREY, "as built": BLUE, "after the next move": GREEN})
"""Label of each band of quantiles in a figure (prior, as built, after the move) -> its colour."""


def asbuilt_report(run: AsBuiltRun) -> Report:
    """Return the report: verdict, predicted merits, observable combinations of motions, measurements, next move."""
    with look("asbuilt"):
        along = to_svg(_along_figure(run))
        known = to_svg(_known_figure(run))
    verdict, more = answer(_verdict(run), _known_words(run), *_move_words(run))
    sections = (
        Section(
            "The camera",
            (
                "Wavefront error along the line, nominal and as built. Bands hold the middle 68 and 95 % of the "
                "possible states: under the prior, with the measurements, and after the next move.",
            ),
            (SvgFigure("along", "Wavefront error over the field", "", along), _range_table(run)),
            name="camera",
        ),
        Section(
            "Observability",
            (
                "Combinations of motions, the best determined first. Sigmas are in units of the prior sigma, 1 before "
                "the measurements. An unobservable combination keeps sigma 1; its effect on the camera is in the table "
                "of merits.",
            ),
            (SvgFigure("known", "Sigma of each combination", "", known), _known_table(run)),
            name="known",
        ),
        Section(
            "Measurements",
            ("Each measurement compared with its prediction from all others and the prior.",),
            (_measured_table(run),),
            name="measurements",
        ),
        *_image_sections(run),
        *_move_sections(run),
        Section(
            "Motions",
            ("Each motion by itself. Most are observable only in combinations.",),
            (_motion_table(run),),
            closed=True,
            name="motions",
        ),
        Section(
            "The resulting instrument",
            (
                "`instrument.yaml` is the instrument as built, which every command accepts; `posterior.yaml` beside it "
                "is the posterior covariance as a disturbances file.",
                *(("Terms of the wavefront are in neither: no body has them.",) if run.setup.test.wavefront else ()),
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
        ("truth", "simulated" if run.true is not None else "not known"),
    )
    title = f"{run.bench.camera} as built"
    unmet = any(prediction.meets <= 1.0 - _CERTAIN for prediction in run.predictions)
    return Report(title, verdict, more, facts, _summary(run), sections, warnings=run.warnings, unmet=unmet)


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


_CERTAIN = 0.95
"""Probability from which the verdict says that a requirement is met; below its complement, that it is missed."""


def _verdict(run: AsBuiltRun) -> str:
    """Return the sentence on which requirements the instrument meets, with their probabilities."""
    groups: dict[str, list[str]] = {"meets": [], "fails": [], "may meet or fail": []}
    for prediction in run.predictions:
        outcome = "meets" if prediction.meets >= _CERTAIN else "fails"
        if 1.0 - _CERTAIN < prediction.meets < _CERTAIN:
            outcome = "may meet or fail"
        groups[outcome].append(f"{prediction.merit.name} ({_percent(prediction.meets)})")
    outcomes = [f"{outcome} {', '.join(names)}" for outcome, names in groups.items() if names]
    return f"As built, {run.bench.camera} {' and '.join(outcomes)}"


def _known_words(run: AsBuiltRun) -> str:
    known = sum(combination.known for combination in run.known)
    consistency = run.estimate.whole
    fits = "agree" if consistency.passes() else "do not agree"
    return (
        f"The measurements determine {known} of {len(run.known)} combinations of motions and {fits} with the prior and "
        f"their errors (chi-square {consistency.chi_square:.0f} for {consistency.degrees} degrees of freedom)"
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
        f"{step.uncertainty:.3g} could be removed if the state were known"
    ]
    reductions = sorted(step.merit_reductions.items(), key=lambda item: -item[1])[:_FEW]
    if reductions:
        text = ", ".join(f"{name} by {value:.3g}" for name, value in reductions)
        out.append(f"One more measurement before the move would reduce it further: {text}")
    return out


def _is_nothing(run: AsBuiltRun, name: str) -> bool:
    assert run.advice is not None
    return bool(run.advice.move.amounts[run.bench.parameters.names.index(name)] == 0.0)


def _short(amount: str | float) -> str:
    """Return the amount of an actuator move as text with four significant digits."""
    if isinstance(amount, str):
        number, _, unit = amount.partition(" ")
        return f"{plain(float(number), 4)} {unit_for_reports(unit)}"
    return plain(amount, 4)


def _cell(value: float, prediction: MeritPrediction) -> Cell:
    shown = shown_merit(value, prediction.merit)
    if shown is None:
        return None
    spread = shown_merit(prediction.now[3], prediction.merit) or 0.0
    decimals = 3 if abs(spread) < 10.0 else 1
    return DecimalNumber(shown, decimals)


def _between(values: Sequence[float], prediction: MeritPrediction) -> str:
    if not len(values):
        return ""
    low, middle, high = (shown_merit(values[k], prediction.merit) for k in (1, 2, 3))
    if low is None or middle is None or high is None:
        return "no light"
    return f"{significant(middle)} ({significant(low)} to {significant(high)})"


def _summary(run: AsBuiltRun) -> Table:
    rows: list[list[Cell]] = []
    moved, drawn = run.advice is not None, run.true is not None
    for prediction in run.predictions:
        spec = prediction.merit.spec
        sign = "at least" if spec.more_is_better else "at most"
        row: list[Cell] = [
            merit_head(prediction.merit),
            f"{sign} {plain(spec.requirement / merit_unit(prediction.merit)[1])}",
            _cell(prediction.designed, prediction),
            _between(prediction.before, prediction),
            _between(prediction.now, prediction),
            _percent(prediction.meets),
        ]
        row += [_between(prediction.moved, prediction), _percent(prediction.meets_moved)] if moved else []
        rows.append(row + ([_cell(prediction.true, prediction)] if drawn else []))
    heads = ["merit", "requirement", "designed", "prior", "as built", "probability"]
    heads += ["after the next move", "probability then"] if moved else []
    heads += ["true"] if drawn else []
    caption = (
        "Median and 16 to 84 % quantiles, by exact traces of states drawn from the prior and the posterior. "
        "Probability: that the requirement is met."
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
    factor = np.sqrt(run.estimate.variance_factor)
    rows: list[list[Cell]] = [
        [
            combination.name,
            combination.value,
            min(1.0, combination.sigma * factor),
            "observable" if combination.known else "unobservable",
        ]
        for combination in run.known[:_MOST_COMBINATIONS]
    ]
    heads = ("combination", "estimate", "sigma", "")
    caption = "Weights and values are in standard deviations of the prior."
    return Table("combinations", "Combinations", caption, heads, rows, (None, 3, 3, None))


def _measured_table(run: AsBuiltRun) -> Table:
    count = len(run.estimate.measurements)
    rows: list[list[Cell]] = []
    for kind, test in zip(run.bench.kinds, run.estimate.measurements, strict=True):
        excluded = [block for name, block, _ in run.estimate.excluded if name == test.name]
        rows.append(
            [
                test.name,
                kind.kind,
                len(kind.labels),
                test.chi_square,
                test.degrees,
                test.p_value,
                "agrees" if test.passes(count) else "contradicts",
                ", ".join(excluded),
            ]
        )
    heads = ("measurement", "kind", "numbers", "chi-square", "degrees", "p", "", "excluded")
    caption = "p: probability of so large a chi-square if prior and errors are as specified."
    decimals = (None, None, None, 1, None, 4, None, None)
    return Table("measurements", "Consistency of the measurements", caption, heads, rows, decimals)


_MOST_STARS, _FEW_STARS = 12, 4
"""Largest number of stars in the figure, and number up to which each has a row of its own."""


def _image_sections(run: AsBuiltRun) -> tuple[Section, ...]:
    if not run.images:
        return ()
    images = sorted(run.images, key=lambda image: image.test.p_value)[:_MOST_STARS]
    shown = [image for image in run.images if image in images]
    with look("asbuilt"):
        figure = to_svg(_image_figure(shown))
    stars = {image.name: STAR(image) for image in run.images}
    caption = "Outside: light beyond the cut-out; seeing: full width at half maximum; p: as for the measurements."
    table = STAR.table("star_images", "Stars", caption, stars, STAR.headed, "star")
    text = "Images of stars, the prediction in the estimated state, and their difference in standard deviations."
    if len(shown) < len(run.images):
        text += f" Shown are the {len(shown)} of {len(run.images)} stars that fit worst."
    return (
        Section(
            "Images of stars", (text,), (SvgFigure("stars", "Images and residuals", "", figure), table), name="stars"
        ),
    )


def _image_figure(images: Sequence[StarResidual]) -> Figure:
    few = len(images) <= _FEW_STARS
    figure = new_figure(2.1 * len(images) if few else 3.4)
    axes = figure.subplots(*((len(images), 3) if few else (3, len(images))), squeeze=False)
    for panels, image in zip(axes if few else axes.T, images, strict=True):
        counts = image.star.counts
        assert counts is not None
        low, high = float(np.min(image.fit.model)), float(np.max(image.fit.model))
        for ax, values, limits, colours in (
            (panels[0], counts, (low, high), "viridis"),
            (panels[1], image.fit.model, (low, high), "viridis"),
            (panels[2], image.pulls, (-4.0, 4.0), "RdBu_r"),
        ):
            ax.imshow(values, cmap=colours, vmin=limits[0], vmax=limits[1], origin="lower")
            ax.set(xticks=[], yticks=[])
        name = f"{image.measurement}\n({image.field[0]:g}, {image.field[1]:g})"
        (panels[0].set_ylabel if few else panels[0].set_title)(name, fontsize=8 if few else 6)
    for ax, name in zip(axes[0] if few else axes[:, 0], _PANELS, strict=True):
        (ax.set_title if few else ax.set_ylabel)(name, fontsize=8)
    return figure


_PANELS = ("measured", "predicted", "residual, \u00b14 \u03c3")


def _move_sections(run: AsBuiltRun) -> tuple[Section, ...]:
    step = run.advice
    if step is None:
        return ()
    bench = run.bench
    moves = moves_plain(run, step.move.amounts)
    travel = bench.parameters.moved(run.estimate.mean[None], bench.last)[0]
    done = moves_plain(run, travel)
    rows: list[list[Cell]] = [
        [name, entry.motion, _short(done[name]), _short(moves[name]), str(entry.range), str(entry.step or "")]
        for name, entry in run.setup.test.actuators.items()
    ]
    heads = ("actuator", "motion", "position", "move by", "range", "step")
    caption = "Position: estimated sum of all moves so far."
    tables: list[Table] = [Table("move", "Next move", caption, heads, rows)]
    if step.merit_reductions:
        reductions: list[list[Cell]] = [
            [name, value] for name, value in sorted(step.merit_reductions.items(), key=lambda item: -item[1])
        ]
        caption = "Expected reduction of the merit after the move if this is measured before it."
        tables.append(
            Table(
                "worth", "Benefit of further measurements", caption, ("measurement", "reduction"), reductions, (None, 4)
            )
        )
    estimates = responses(run)
    if estimates:
        lines: list[list[Cell]] = [[name, entry["response"], entry["sigma"]] for name, entry in estimates.items()]
        caption = "Ratio of the actual to the traced response, estimated from the measured moves."
        truth_of = ("actuator", "response", "sigma")
        tables.append(Table("responses", "Responses of the actuators", caption, truth_of, lines, (None, 3, 3)))
    text: tuple[str, ...] = (
        f"The move minimises the expected sum of squares of all merits, each in units of its requirement: "
        f"{step.before:.3g} before and {step.after:.3g} after it, averaged over the posterior and the errors of the "
        f"move by exact traces. {step.uncertainty:.3g} of it could be removed if the state were known.",
    )
    if not step.move.searched:
        text = (*text, "Not all combinations of whole steps were tried: a better move may exist.")
    return (Section("The next move", text, tuple(tables), name="move"),)


def _motion_table(run: AsBuiltRun) -> Table:
    estimates = motions(run)
    rows: list[list[Cell]] = [
        [
            motion["motion"],
            motion["unit"],
            motion["prior_sigma"],
            motion["value"],
            motion["sigma"],
            *([motion["true"]] if "true" in motion else []),
        ]
        for motion in estimates
    ]
    heads = ("motion", "unit", "prior sigma", "estimate", "sigma", *(["true"] if run.true is not None else []))
    return Table("motions", "Motions", "", heads, rows, (None, None, *[3] * (len(heads) - 2)))


def _posterior(run: AsBuiltRun) -> tuple[CameraFile, ...]:
    text, table = posterior_files(run)
    file = CameraFile(POSTERIOR, "Posterior", "", text)
    return (file,) if table is None else (file, CsvFile(CORRELATION, "Correlations of the posterior", "", table))


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
    limits = [
        prediction.merit.spec.requirement for prediction in run.predictions if prediction.merit.spec.kind == "wavefront"
    ]
    if limits:
        ax.axhline(limits[0], color=VERMILION, lw=1.0, label="requirement")
    ax.set_yscale("log")
    ax.set_ylim(0.5 * float(np.min(designed)))
    ax.set_xlabel("field along the line")
    ax.set_ylabel("rms wavefront error [waves]")
    shared_legend(figure, ax)
    gridded(ax)
    return figure


def _known_figure(run: AsBuiltRun) -> Figure:
    sigma = np.array([combination.sigma for combination in run.known])
    figure = new_figure(2.2)
    ax = figure.subplots()
    number = np.arange(1, len(sigma) + 1)
    known = np.array([combination.known for combination in run.known])
    for selected, colour, label in ((known, BLUE, "observable"), (~known, ORANGE, "unobservable")):
        ax.bar(number[selected], sigma[selected], 0.8, color=colour, label=label)
    ax.set_xlabel("combination")
    ax.set_ylabel("sigma over prior")
    ax.set_ylim(0.0, 1.05)
    ax.legend(loc="upper left")
    plain_axes(ax)
    return figure
