"""The quantities of a check of conventions, as check.json has them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from twin.framework.quantity import Quantity, Record
from twin.orbit.conventions.check_run import DECIDED, Answer, Check, Tried
from twin.orbit.conventions.pass_readings import QUESTIONS, Changes, changed
from twin.orbit.conventions.reading_fit import Fit
from twin.orbit.flight.earth import Earth, east_north_up

Ranked = tuple[Check, Tried]
Placed = tuple[Check, Changes]


def changes_text(changes: Changes) -> str:
    """What a reading takes otherwise than stated, for readers."""
    if not changes:
        return "as stated"
    return "; ".join(f"{QUESTIONS[name].title} {QUESTIONS[name].text(value)}" for name, value in changes)


def _of_fit(get: Callable[[Fit], Any]) -> Callable[[Ranked], Any]:
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
    """Where one reading puts the first points, a row for each: longitude, latitude, distance from the ground point."""
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
