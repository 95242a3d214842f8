"""Report and result records of a check of conventions: confirmed, wrong or undetermined conventions of a pass.

The records define the quantities of check.json.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from twin.framework.artefact import Cell, Table
from twin.framework.record import Quantity, Record
from twin.framework.report import Report, Section, answer
from twin.orbit.conventions.check_run import DECIDED, Answer, Check, Tried
from twin.orbit.conventions.pass_readings import QUESTIONS, Changes, Fit, changed
from twin.orbit.flight.earth import Earth, east_north_up

Ranked = tuple[Check, Tried]
"""A check with one of its readings."""
Placed = tuple[Check, Changes]
"""A check with the changes of one of its readings."""


def changes_text(changes: Changes) -> str:
    """Return the conventions in which a reading differs from the stated one, for readers."""
    if not changes:
        return "as stated"
    return "; ".join(f"{QUESTIONS[name].title} {QUESTIONS[name].text(value)}" for name, value in changes)


def _of_fit(get: Callable[[Fit], Any]) -> Callable[[Ranked], Any]:
    """Return a function that gets a quantity of a reading's fit; None for an impossible reading."""
    return lambda of: None if of[1].fit is None else get(of[1].fit)


READING: Record[Ranked] = Record(
    "A reading, and what it leaves of the points.",
    Quantity("changes", lambda of: dict(of[1].changes), "question -> value that is not the stated one"),
    Quantity("possible", lambda of: of[1].fit is not None, "whether the points can have been imaged so"),
    Quantity("why_impossible", lambda of: of[1].why or None, "why they cannot"),
    Quantity("rms_m", _of_fit(lambda fit: fit.rms), "root mean square residual in plan", "rms", 1),
    Quantity("rms_px", _of_fit(lambda fit: fit.rms_pixels), "the same along the lines' own axes", "rms", 1),
    Quantity("chi_square", _of_fit(lambda fit: fit.chi_square), "of the residuals by their covariance"),
    Quantity("degrees_of_freedom", _of_fit(lambda fit: fit.freedom), "number of residuals"),
    Quantity(
        "cost_above_best",
        lambda of: None if of[1].fit is None else of[0].excess(of[1]),
        "minus twice the log of the likelihood over that of the best reading",
    ),
)
ANSWER: Record[Answer] = Record(
    "What the points say of one value of a convention, the others as in the best reading.",
    Quantity("value", lambda one: one.value, "what the convention may be"),
    Quantity("stated", lambda one: one.stated, "whether it is the stated one"),
    Quantity("best", lambda one: one.best, "whether it is that of the best reading"),
    Quantity("open", lambda one: one.possible, "whether the points leave it open"),
    Quantity(
        "cost_above_best",
        lambda one: one.excess if np.isfinite(one.excess) else None,
        "minus twice the log of the likelihood over that of the best reading",
    ),
    Quantity("moves_points_by_m", lambda one: one.moved, "root mean square by which the points lie elsewhere"),
    Quantity("why_impossible", lambda one: one.why or None, "why the points cannot have been imaged so"),
)
QUESTION: Record[tuple[Answer, ...]] = Record(
    "A convention: as stated, as found, and whether the points tell it.",
    Quantity("stated", lambda answers: next(one.value for one in answers if one.stated), "value in the test's file"),
    Quantity("best", lambda answers: next(one.value for one in answers if one.best), "value in the best reading"),
    Quantity("told", lambda answers: sum(one.possible for one in answers) == 1, "whether one value alone is possible"),
    Quantity("values", lambda answers: answers, "what the points say of each value", record=ANSWER),
)


def places_of(run: Check, changes: Changes) -> list[dict[str, Any]]:
    """Return the first points of a reading on the ground, a row for each.

    A row has longitude, latitude and the distance from the ground point, east and north in metres.
    """
    found = run.places[changes]
    if isinstance(found, str):
        return []
    rows, known = [], run.readings.ground.points
    for camera, at in found.items():
        raw = run.first_points[camera]
        lon, lat, _ = Earth().geodetic(at)
        here = known.itrs[raw]
        a, b, _ = Earth().geodetic(here)
        level = np.einsum("nij,nj->ni", east_north_up(a, b), at - here)
        for k, point in enumerate(raw):
            place = {"longitude_deg": float(np.degrees(lon[k])), "latitude_deg": float(np.degrees(lat[k]))}
            off = {"east_m": float(level[k, 0]), "north_m": float(level[k, 1])}
            rows.append({"point": str(known.ids[point]), "camera": camera, **place, **off})
    return rows


PLACE: Record[Placed] = Record(
    "Where a reading puts the first points; east and north of the ground points that they show.",
    Quantity("changes", lambda of: dict(of[1]), "question -> value that is not the stated one"),
    Quantity(
        "why_impossible",
        lambda of: at if isinstance(at := of[0].places[of[1]], str) else None,
        "why the points lie nowhere",
    ),
    Quantity("points", lambda of: places_of(*of), "row by row"),
)


def _best(run: Check) -> dict[str, Any]:
    """Return every convention of the best reading."""
    reading = changed(run.stated, run.best.changes)
    return {name: QUESTIONS[name].get(reading) for name in run.answers}


CHECK: Record[Check] = Record(
    "check.json. Which readings of a pass explain its ground points.",
    Quantity("result", lambda run: run.verdict, "stands, another or none: what became of the stated reading"),
    Quantity("best", lambda run: dict(run.best.changes), "what the best reading takes otherwise than stated"),
    Quantity("alike", lambda run: [dict(one) for one in run.alike], "other readings that are as likely"),
    Quantity("reading", _best, "every convention of the best reading"),
    Quantity("readings_tried", lambda run: run.count, "how many readings were tried"),
    Quantity("decided_by_cost", lambda run: DECIDED, "cost by which two readings are separated"),
    Quantity("factor_of_variance", lambda run: run.factor, "by how much the sigmas' squares are too small"),
    Quantity("ground_accuracy_m", lambda run: run.readings.ground.accuracy, "of the way to the ITRS, as stated"),
    Quantity(
        "image_points",
        lambda run: {name: len(raw.line) for name, raw in run.readings.images.items()},
        "line -> number of its points",
    ),
    Quantity("gross_errors", lambda run: run.wrong, "line -> points that were left out"),
    Quantity("questions", lambda run: run.answers, "every convention by itself", record=QUESTION),
    Quantity("ranking", lambda run: [(run, one) for one in run.tried], "readings, likeliest first", record=READING),
    Quantity("places", lambda run: [(run, one) for one in run.places], "where the first points fall", record=PLACE),
)


ANOTHER, NONE = 3, 4
"""Exit codes if another reading than the stated one explains the points, and if none does."""
_LISTED = 12
"""Number of readings in the table of the report."""
_NAMED = 6
"""Number of gross errors of a line that a warning names; check.json has all."""


def check_report(run: Check) -> Report:
    """Return the report of a check."""
    code = {"stands": 0, "another": ANOTHER, "none": NONE}[run.verdict]
    verdict, more = _verdict(run)
    return Report(
        "Conventions of a pass",
        verdict,
        (*more, *_lead(run)),
        _facts(run),
        _ranking(run),
        (_questions(run), _places(run)),
        warnings=_warnings(run),
        code=code,
    )


def _verdict(run: Check) -> tuple[str, tuple[str, ...]]:
    """Return the verdict and the sentences after it."""
    best, stated = run.best.fit, run.stated_fit
    if run.verdict == "none" or best is None:
        left = "no reading can have imaged the points" if best is None else (
            f"the best of {run.count} readings ({changes_text(run.best.changes)}) leaves {_metres(best.rms)}, "
            f"chi-square {best.chi_square / best.freedom:.3g} times its freedom"
        )  # fmt: skip
        return answer(
            "None of the readings explains the points",
            left,
            "three conventions may be wrong at once, or camera, ground points or uncertainty are",
        )
    size = f"{_metres(best.rms)} and {best.rms_pixels:.3g} px on the ground"
    open_ones = [QUESTIONS[name].title for name, answers in run.answers.items() if _open(answers)]
    cannot = "the points determine every convention"
    if open_ones:
        cannot = f"the points do not determine these conventions: {', '.join(open_ones)}"
    if run.verdict == "stands":
        return answer(f"The stated conventions explain the points, leaving {size}", cannot)
    was = f"under them {stated.why}" if stated.fit is None else f"which leave {_metres(stated.fit.rms)}"
    right = f"the points agree with {changes_text(run.best.changes)}, leaving {size}"
    return answer(f"The stated conventions are wrong, {was}", right, cannot)


def _open(answers: tuple[Answer, ...]) -> bool:
    """Return whether more than one value of a convention is possible."""
    return sum(one.possible for one in answers) > 1


def _metres(value: float) -> str:
    """Return a distance in metres or kilometres as text."""
    return f"{value / 1e3:.4g} km" if value >= 1e4 else f"{value:.3g} m"


def _lead(run: Check) -> tuple[str, ...]:
    """Return sentences on wrong and undetermined conventions."""
    lines = [f"Fits alike: {changes_text(one)}." for one in run.alike]
    for name, answers in run.answers.items():
        question = QUESTIONS[name]
        stated = next(one for one in answers if one.stated)
        best = next(one for one in answers if one.best)
        if run.verdict == "another" and not stated.possible:
            lines.append(f"{question.title}: {question.text(best.value)}, and not {question.text(stated.value)}.")
        elif _open(answers):
            others = [one for one in answers if one.possible and not one.best]
            moved = max(one.moved or 0.0 for one in others)
            texts = ", ".join(question.text(one.value) for one in (best, *others))
            lines.append(
                f"{question.title}: {texts} fit alike; they differ by {_metres(moved)}, which the uncertainty hides."
            )
    return tuple(lines)


def _facts(run: Check) -> tuple[tuple[str, str], ...]:
    """Return the input quantities listed in the report."""
    size, images = run.setup.test.uncertainty, run.readings.images
    return (
        ("Camera", run.setup.camera.name),
        ("Image points", ", ".join(f"{name} {len(raw.line)}" for name, raw in images.items())),
        ("Attitude may be wrong by", f"{np.degrees(size.attitude) * 3600.0:.4g} arcsec about each axis"),
        ("Orbit may be wrong by", f"{size.position:.4g} m"),
        ("Lines may be wrong by", f"{size.interior:.4g} px in place, {1e6 * size.scale:.4g} ppm in principal distance"),
        ("Line times may be wrong by", f"{1e3 * size.time:.4g} ms"),
    )


def _row(one: Tried, run: Check) -> tuple[Cell, ...]:
    """Return the table row of a reading."""
    if one.fit is None:
        return changes_text(one.changes), None, None, None, None, one.why
    excess = run.excess(one)
    told = "best" if one is run.best else "fits alike" if excess < DECIDED else "excluded"
    ratio = one.fit.chi_square / one.fit.freedom
    return changes_text(one.changes), one.fit.rms, one.fit.rms_pixels, ratio, max(excess, 0.0), told


def _ranking(run: Check) -> Table:
    """Return the table of the likeliest readings."""
    stated, single = run.stated_fit, [one for one in run.tried if len(one.changes) <= 1 and one is not run.best]
    first = [run.best, *(one for one in run.tried if one.changes in run.alike)]
    first += [stated] if stated not in first else []
    rest = [one for one in single if one not in first][: _LISTED - len(first)]
    return Table(
        "ranking",
        "Readings, the likeliest first",
        f"Those that change one convention; check.json has all of {run.count}. Residuals in plan, as they are; "
        "chi-square over its freedom with what camera and platform may be wrong by; cost: minus twice the log "
        "of the likelihood "
        "over the best one's.",
        ("reading", "rms [m]", "rms [px]", "chi-square", "cost", "verdict"),
        [_row(one, run) for one in (*first, *rest)],
        (None, 1, 1, 2, 1, None),
    )


def _questions(run: Check) -> Section:
    """Return the report section on each convention by itself."""
    rows: list[tuple[Cell, ...]] = []
    for name, answers in run.answers.items():
        question = QUESTIONS[name]
        for one in answers:
            told = "best" if one.best else "cannot be told from the best" if one.possible else one.why or "excluded"
            cost = max(one.excess, 0.0) if np.isfinite(one.excess) else None
            rows.append((question.title, question.text(one.value), "yes" if one.stated else "", one.moved, cost, told))
    text = (
        "Each convention by itself, the others as in the best reading. A value cannot be told from the best if the"
        " points would lie elsewhere by no more than camera and platform may be wrong by: give smaller uncertainties, "
        "after a calibration, or more points, if it matters.",
    )
    table = Table(
        "questions",
        "Conventions",
        "Moved: root mean square by which the points lie elsewhere than in the best reading.",
        ("convention", "value", "stated", "moved [m]", "cost", "what the points say"),
        rows,
        (None, None, None, 1, 1, None),
    )
    return Section("What the points say of each convention", text, (table,))


def _places(run: Check) -> Section:
    """Return the report section on the ground positions of the first points."""
    rows: list[tuple[Cell, ...]] = []
    for changes, found in run.places.items():
        if isinstance(found, str):
            rows.append((changes_text(changes), "", "", None, None, None, None, found))
        for k, place in enumerate(places_of(run, changes)):
            numbers = [place[key] for key in ("longitude_deg", "latitude_deg", "east_m", "north_m")]
            rows.append((changes_text(changes) if k == 0 else "", place["point"], place["camera"], *numbers, ""))
    table = Table(
        "places",
        "Where the first points fall",
        "At the heights of their ground points; east and north of them.",
        ("reading", "point", "line", "longitude [deg]", "latitude [deg]", "east [m]", "north [m]", "else"),
        rows,
        (None, None, None, 6, 6, 1, 1, None),
    )
    text = ("With one convention changed at a time, from the stated reading.",)
    return Section("Where the first points fall", text, (table,))


def _warnings(run: Check) -> tuple[str, ...]:
    """Return warnings on gross errors, underestimated sigmas, datum and Earth orientation."""
    found = []
    for name, points in run.wrong.items():
        if points:
            more = f" and {len(points) - _NAMED} more" if len(points) > _NAMED else ""
            found.append(f"left out as gross errors in {name}: {', '.join(points[:_NAMED])}{more}")
    if run.factor > 2.0:
        found.append(f"residuals are {np.sqrt(run.factor):.1f} times as large as the sigmas and uncertainties predict")
    accuracy = run.readings.ground.accuracy
    if accuracy is None:
        found.append("how good the way of the ground points' datum to WGS 84 is, is not stated by its authority")
    elif accuracy > 0.1:
        found.append(f"the way of the ground points' datum to WGS 84 is good to {accuracy:g} m only")
    if run.readings.platform.earth is None:
        found.append(
            "no Earth orientation was given, so that inertial frames were tried with UT1 - UTC and polar motion of 0"
        )
    return tuple(found)
