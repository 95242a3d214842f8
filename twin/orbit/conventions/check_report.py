"""Report of a check of conventions: what stands, what does not, what the points cannot tell."""

from __future__ import annotations

import numpy as np

from twin.framework.artefact import Cell, Table
from twin.framework.report import Report, Section, answer
from twin.orbit.conventions.check_numbers import changes_text, places_of
from twin.orbit.conventions.check_run import DECIDED, Answer, Check, Tried
from twin.orbit.conventions.pass_readings import QUESTIONS

ANOTHER, NONE = 3, 4
"""Exit codes: another reading than the stated one stands; none explains the points."""
_LISTED = 12
_NAMED = 6
"""Gross errors of a line that are named in a warning; check.json has all."""


def check_report(run: Check) -> Report:
    """Report of a check."""
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
    return sum(one.possible for one in answers) > 1


def _metres(value: float) -> str:
    return f"{value / 1e3:.4g} km" if value >= 1e4 else f"{value:.3g} m"


def _lead(run: Check) -> tuple[str, ...]:
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
    if one.fit is None:
        return changes_text(one.changes), None, None, None, None, one.why
    excess = run.excess(one)
    told = "best" if one is run.best else "fits alike" if excess < DECIDED else "excluded"
    ratio = one.fit.chi_square / one.fit.freedom
    return changes_text(one.changes), one.fit.rms, one.fit.rms_pixels, ratio, max(excess, 0.0), told


def _ranking(run: Check) -> Table:
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
