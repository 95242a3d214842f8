"""Numbers of a check of conventions, as check.json has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from twin.orbit.conventions.check_run import DECIDED, Answer, Check, Tried
from twin.orbit.conventions.pass_readings import QUESTIONS, Changes, changed
from twin.orbit.flight.earth import Earth, east_north_up
from twin.run.plain_data import plain_data


def value_of(name: str, value: Any) -> Any:
    """A value of a question as plain data."""
    return list(value) if isinstance(value, tuple) else value


def changes_data(changes: Changes) -> dict[str, Any]:
    """Question -> value."""
    return {name: value_of(name, value) for name, value in changes}


def changes_text(changes: Changes) -> str:
    """What a reading takes otherwise than stated, for readers."""
    if not changes:
        return "as stated"
    return "; ".join(f"{QUESTIONS[name].title} {QUESTIONS[name].text(value)}" for name, value in changes)


@dataclass(frozen=True)
class ReadingNumbers:
    """A reading and what it leaves of the points."""

    changes: Mapping[str, Any]
    possible: bool
    why_impossible: str | None
    rms_m: float | None
    rms_px: float | None
    chi_square: float | None
    degrees_of_freedom: int | None
    cost_above_best: float | None

    @classmethod
    def of(cls, one: Tried, run: Check) -> Self:
        """Of one reading."""
        fit = one.fit
        if fit is None:
            return cls(changes_data(one.changes), False, one.why, None, None, None, None, None)
        excess = (fit.cost - run.best.cost) / run.factor
        numbers = (fit.rms, fit.rms_pixels, fit.chi_square, fit.freedom, excess)
        return cls(changes_data(one.changes), True, None, *numbers)


@dataclass(frozen=True)
class AnswerNumbers:
    """A value of a question."""

    value: Any
    stated: bool
    best: bool
    open: bool
    cost_above_best: float | None
    moves_points_by_m: float | None
    why_impossible: str | None

    @classmethod
    def of(cls, name: str, one: Answer) -> Self:
        """Of one value."""
        excess = one.excess if np.isfinite(one.excess) else None
        return cls(value_of(name, one.value), one.stated, one.best, one.possible, excess, one.moved, one.why or None)


@dataclass(frozen=True)
class QuestionNumbers:
    """A convention: as stated, as found, and whether the points tell it."""

    stated: Any
    best: Any
    told: bool
    values: Sequence[AnswerNumbers]

    @classmethod
    def of(cls, name: str, answers: Sequence[Answer]) -> Self:
        """Of one question."""
        stated = next(one.value for one in answers if one.stated)
        best = next(one.value for one in answers if one.best)
        told = sum(one.possible for one in answers) == 1
        return cls(value_of(name, stated), value_of(name, best), told, [AnswerNumbers.of(name, a) for a in answers])


@dataclass(frozen=True)
class PlaceNumbers:
    """Where a reading puts the first points; north and east of the ground points that they show."""

    changes: Mapping[str, Any]
    why_impossible: str | None
    points: Sequence[Mapping[str, Any]]


def places_of(run: Check, changes: Changes) -> list[dict[str, Any]]:
    """Of one reading, a row for each point: names, longitude and latitude, and how far from the ground point."""
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


@dataclass(frozen=True)
class CheckNumbers:
    """check.json."""

    result: str
    best: Mapping[str, Any]
    alike: Sequence[Mapping[str, Any]]
    reading: Mapping[str, Any]
    readings_tried: int
    decided_by_cost: float
    factor_of_variance: float
    ground_accuracy_m: float | None
    image_points: Mapping[str, int]
    gross_errors: Mapping[str, Sequence[str]]
    questions: Mapping[str, QuestionNumbers]
    ranking: Sequence[ReadingNumbers]
    places: Sequence[PlaceNumbers]

    @classmethod
    def of(cls, run: Check) -> Self:
        """Of a check."""
        reading = changed(run.stated, run.best.changes)
        places = [
            PlaceNumbers(changes_data(one), at if isinstance(at, str) else None, places_of(run, one))
            for one, at in run.places.items()
        ]
        return cls(
            result=run.verdict,
            best=changes_data(run.best.changes),
            alike=[changes_data(one) for one in run.alike],
            reading={name: value_of(name, QUESTIONS[name].get(reading)) for name in run.answers},
            readings_tried=run.count,
            decided_by_cost=DECIDED,
            factor_of_variance=run.factor,
            ground_accuracy_m=run.readings.ground.accuracy,
            image_points={name: len(raw.line) for name, raw in run.readings.images.items()},
            gross_errors={name: list(points) for name, points in run.wrong.items()},
            questions={name: QuestionNumbers.of(name, answers) for name, answers in run.answers.items()},
            ranking=[ReadingNumbers.of(one, run) for one in run.tried],
            places=places,
        )


def check_numbers(run: Check) -> dict[str, Any]:
    """Contents of check.json without its frames."""
    return dict(plain_data(CheckNumbers.of(run)))
