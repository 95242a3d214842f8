"""Report and result quantities of a check of file conventions: each is confirmed, wrong or undetermined.

In names, a reading is one interpretation of the files' numbers, such as axes, time scale and pixel count. The
quantities are those of check.json.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from twin.framework.artefact import Cell, Table
from twin.framework.record import Quantity, Record
from twin.framework.report import Report, Section, answer, inputs
from twin.orbit.conventions.check_run import DECIDED, Check, TriedReading, ValueTest
from twin.orbit.conventions.pass_readings import TESTED_CONVENTIONS, Changes, Fit, changed

CheckedReading = tuple[Check, TriedReading]
"""A check with one of the interpretations of the files that it tried."""


def changes_text(changes: Changes) -> str:
    """Return, as text, the conventions in which an interpretation of the files differs from the specified one."""
    if not changes:
        return "as stated"
    named = ((TESTED_CONVENTIONS[name], value) for name, value in changes)
    return "; ".join(f"{convention.title} {convention.text(value)}" for convention, value in named)


def _of_fit(get: Callable[[Fit], Any]) -> Callable[[CheckedReading], Any]:
    """Return a function that gets a quantity of an interpretation's fit to the points; None for an impossible one."""
    return lambda of: None if of[1].fit is None else get(of[1].fit)


READING: Record[CheckedReading] = Record(
    "A reading (set of conventions) and its fit to the ground points.",
    Quantity(
        "changes", lambda of: dict(of[1].changes), "conventions that differ from the stated ones, with their values"
    ),
    Quantity("possible", lambda o: o[1].fit is not None, "true if the points can have been imaged under this reading"),
    Quantity("why_impossible", lambda of: of[1].why or None, "reason why they cannot"),
    Quantity("rms_m", _of_fit(lambda fit: fit.rms), "root mean square residual in plan", "rms", 1),
    Quantity("mean_east_m", _of_fit(lambda fit: fit.residual[:, 0].mean()), "mean residual to the east"),
    Quantity("mean_north_m", _of_fit(lambda fit: fit.residual[:, 1].mean()), "mean residual to the north"),
    Quantity("rms_px", _of_fit(lambda fit: fit.rms_pixels), "rms residual along the lines' own axes", "rms", 1),
    Quantity("chi_square", _of_fit(lambda fit: fit.chi_square), "of the residuals under their covariance"),
    Quantity("degrees_of_freedom", _of_fit(lambda fit: fit.freedom), "number of residuals"),
    Quantity(
        "cost_above_best",
        lambda of: None if of[1].fit is None else of[0].excess(of[1]),
        "minus twice the log of the likelihood over that of the best reading",
    ),
)
VALUE_TEST: Record[ValueTest] = Record(
    "Test of one value of a convention, with the other conventions as in the best reading.",
    Quantity("value", lambda test: test.value, "tested value of the convention"),
    Quantity("stated", lambda test: test.specified, "true for the stated value"),
    Quantity("best", lambda test: test.best, "true for the value of the best reading"),
    Quantity("possible", lambda test: test.possible, "true if the points do not exclude the value"),
    Quantity(
        "cost_above_best",
        lambda test: test.excess if np.isfinite(test.excess) else None,
        "minus twice the log of the likelihood over that of the best reading",
    ),
    Quantity("displacement_m", lambda test: test.moved, "root mean square displacement of the points on the ground"),
    Quantity("why_impossible", lambda test: test.why or None, "reason why the value is impossible"),
)
CONVENTION: Record[tuple[ValueTest, ...]] = Record(
    "A convention: its stated and its best value, and whether the points determine it.",
    Quantity("stated", lambda a: next(test.value for test in a if test.specified), "value in the test's file"),
    Quantity("best", lambda answers: next(test.value for test in answers if test.best), "value in the best reading"),
    Quantity("determined", lambda a: sum(test.possible for test in a) == 1, "true if one value is possible"),
    Quantity("values", lambda answers: answers, "test of each value", record=VALUE_TEST),
)


def _best(run: Check) -> dict[str, Any]:
    """Return the value of each convention in the best interpretation of the files."""
    reading = changed(run.specified, run.best.changes)
    return {name: TESTED_CONVENTIONS[name].get(reading) for name in run.answers}


CHECK: Record[Check] = Record(
    "check.json. Conventions under which a pass explains its ground points.",
    Quantity("result", lambda run: run.verdict, "confirmed (as stated), another (others fit) or none"),
    Quantity("best", lambda run: dict(run.best.changes), "changed conventions of the best reading"),
    Quantity("equally_likely", lambda r: [dict(reading) for reading in r.equally_likely], "equally likely readings"),
    Quantity("reading", _best, "every convention of the best reading"),
    Quantity("readings_tried", lambda run: run.count, "number of readings that were tried"),
    Quantity("decided_by_cost", lambda run: DECIDED, "difference of cost from which two readings are separated"),
    Quantity("factor_of_variance", lambda run: run.factor, "factor by which the variances are too small"),
    Quantity("ground_accuracy_m", lambda r: r.readings.ground.accuracy, "accuracy of the transformation to the ITRS"),
    Quantity(
        "image_points",
        lambda run: {name: len(raw.line) for name, raw in run.readings.images.items()},
        "number of image points of each line",
    ),
    Quantity("gross_errors", lambda run: run.wrong, "rejected points of each line"),
    Quantity("conventions", lambda run: run.answers, "tests of each convention", record=CONVENTION),
    Quantity(
        "ranking",
        lambda run: [(run, reading) for reading in run.tried],
        "readings, the likeliest first",
        record=READING,
    ),
)


OTHER_READING, NO_READING = 3, 4
"""Exit codes if another interpretation of the files than the specified one explains the points, and if none does."""
_LISTED = 12
"""Number of interpretations in the table of the report."""
_NAMED = 6
"""Number of gross errors of a line that a warning names; check.json has all."""


def check_report(run: Check) -> Report:
    """Return the report of a check of conventions: verdict, likeliest interpretations, tests and warnings."""
    code = {"confirmed": 0, "another": OTHER_READING, "none": NO_READING}[run.verdict]
    verdict, more = _verdict(run)
    return Report(
        "Conventions of a pass",
        verdict,
        (*more, *(f"Equally likely: {changes_text(changes)}." for changes in run.equally_likely)),
        _facts(run),
        _ranking(run),
        (_conventions(run),),
        warnings=_warnings(run),
        code=code,
    )


def _verdict(run: Check) -> tuple[str, tuple[str, ...]]:
    """Return the verdict of the check, and the sentences that follow it in the report."""
    best, specified = run.best.fit, run.specified_fit
    if run.verdict == "none" or best is None:
        left = "the points cannot have been imaged under any of them"
        if best is not None:
            left = (
                f"the best of {run.count} readings ({changes_text(run.best.changes)}) leaves {_metres(best.rms)} rms, "
                f"chi-square {best.chi_square / best.freedom:.3g} per degree of freedom"
            )
        return answer(
            "No combination of conventions explains the ground points",
            left,
            "more than two conventions may be wrong at once, or the camera, the ground points or the uncertainty",
        )
    size = f"{_metres(best.rms)} rms on the ground ({best.rms_pixels:.3g} px)"
    undetermined = [TESTED_CONVENTIONS[name].title for name, answers in run.answers.items() if _undetermined(answers)]
    cannot = "the points determine every convention"
    if undetermined:
        cannot = f"the points do not determine these conventions: {', '.join(undetermined)}"
    if run.verdict == "confirmed":
        return answer(f"The stated conventions are confirmed: they fit the ground points to {size}", cannot)
    fit = specified.fit
    was = f"under them {specified.why}" if fit is None else f"with residuals of {_metres(fit.rms)} rms"
    right = f"the points agree with {changes_text(run.best.changes)}, to {size}"
    return answer(f"The stated conventions are wrong, {was}", right, cannot)


def _undetermined(answers: tuple[ValueTest, ...]) -> bool:
    """Return whether more than one value of a convention is consistent with the points."""
    return sum(test.possible for test in answers) > 1


def _metres(value: float) -> str:
    """Return a distance in metres or kilometres as text."""
    return f"{value / 1e3:.4g} km" if value >= 1e4 else f"{value:.3g} m"


def _facts(run: Check) -> tuple[tuple[str, str], ...]:
    """Return the input quantities listed in the report."""
    return (
        ("Camera", run.setup.camera.name),
        ("Image points", ", ".join(f"{name} {len(raw.line)}" for name, raw in run.readings.images.items())),
        *inputs(run.setup.test, "uncertainty"),
    )


def _row(tried: TriedReading, run: Check) -> tuple[Cell, ...]:
    """Return the table row of one interpretation of the files."""
    if tried.fit is None:
        return changes_text(tried.changes), *[None] * 6, tried.why
    excess = run.excess(tried)
    verdict = "best" if tried is run.best else "equally likely" if excess < DECIDED else "excluded"
    mean = tried.fit.residual.mean(axis=0).tolist()
    sizes = tried.fit.rms, *mean, tried.fit.rms_pixels, tried.fit.chi_square / tried.fit.freedom, max(excess, 0.0)
    return changes_text(tried.changes), *sizes, verdict


def _ranking(run: Check) -> Table:
    """Return the table of the likeliest interpretations of the files."""
    specified = run.specified_fit
    single = [tried for tried in run.tried if len(tried.changes) <= 1 and tried is not run.best]
    first = [run.best, *(tried for tried in run.tried if tried.changes in run.equally_likely)]
    first += [specified] if specified not in first else []
    rest = [tried for tried in single if tried not in first][: _LISTED - len(first)]
    return Table(
        "ranking",
        "Readings, the likeliest first",
        f"Readings with one changed convention; check.json has those fitted of {run.count} tried. Residuals in plan; "
        "chi-square per degree of freedom, including the uncertainty of camera and platform; cost: minus twice the "
        "log likelihood ratio to the best reading.",
        ("reading", "rms [m]", "mean east [m]", "mean north [m]", "rms [px]", "chi-square", "cost", "verdict"),
        [_row(tried, run) for tried in (*first, *rest)],
        (None, 1, 1, 1, 1, 2, 1, None),
    )


def _conventions(run: Check) -> Section:
    """Return the report section that tests each convention with the others held at their best values."""
    rows: list[tuple[Cell, ...]] = []
    for name, answers in run.answers.items():
        convention = TESTED_CONVENTIONS[name]
        for test in answers:
            verdict = "best" if test.best else "not excluded" if test.possible else test.why or "excluded"
            cost = max(test.excess, 0.0) if np.isfinite(test.excess) else None
            specified = "yes" if test.specified else ""
            rows.append((convention.title, convention.text(test.value), specified, test.moved, cost, verdict))
    text = (
        "Each convention by itself, the others as in the best reading. A value is not excluded if it moves the points "
        "by no more than the uncertainty of camera and platform. If it matters, give smaller uncertainties after a "
        "calibration, or more points.",
    )
    table = Table(
        "conventions",
        "Conventions",
        "Moved: root mean square displacement of the points from the best reading.",
        ("convention", "value", "stated", "moved [m]", "cost", "verdict"),
        rows,
        (None, None, None, 1, 1, None),
    )
    return Section("Test of each convention", text, (table,))


def _warnings(run: Check) -> tuple[str, ...]:
    """Return warnings on gross errors, underestimated sigmas, datum and Earth orientation."""
    texts = []
    for name, points in run.wrong.items():
        if points:
            more = f" and {len(points) - _NAMED} more" if len(points) > _NAMED else ""
            texts.append(f"rejected as gross errors in {name}: {', '.join(points[:_NAMED])}{more}")
    if run.factor > 2.0:
        texts.append(
            f"residuals are {np.sqrt(run.factor):.1f} times as large as predicted by the sigmas and uncertainties"
        )
    accuracy = run.readings.ground.accuracy
    if accuracy is None:
        texts.append(
            "the accuracy of the datum transformation of the ground points to WGS 84 is not stated by its authority"
        )
    elif accuracy > 0.1:
        texts.append(f"the datum transformation of the ground points to WGS 84 is accurate to {accuracy:g} m only")
    if run.readings.platform.earth is None:
        texts.append(
            "no Earth orientation was given, so that inertial frames were tried with UT1 - UTC and polar motion of 0"
        )
    return tuple(texts)
