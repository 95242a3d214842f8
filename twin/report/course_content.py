"""What the report says about a course: temperatures, and errors of every estimator over all times."""

from __future__ import annotations

from typing import Any

import numpy as np

from analysis.monitoring import PER_SI
from analysis.recovery import ESTIMATORS
from analysis.units import ARCSEC
from scenes.course import moment
from twin.course import CourseRun
from twin.report.labels import PARAMETERS
from twin.report.numbers import FAR, MINUS, decimals_for, fixed
from twin.results import RenderRun

ANGLE_MEANING = "angle between the two lines of sight"


def course_content(run: RenderRun) -> dict[str, Any] | None:
    """Facts and the table of errors; None for a job without a course."""
    course = run.course
    if course is None:
        return None
    tables = []
    for name, estimators in course.parameters.items():
        rows = []
        for k, p in enumerate(PARAMETERS):
            values = {e: (v.vector[:, k] * PER_SI[k], v.sigma[:, k] * PER_SI[k]) for e, v in estimators.items()}
            key = f"course.{name}.{p.key}"
            rows.append(_row(key, f"{p.symbol} [{p.unit}]", p.meaning, course.truth[name][k] * PER_SI[k], values))
        tables.append({"title": f"Camera {name}", "rows": rows})
    if course.recovered_angle:
        values = {e: (a.change_rad / ARCSEC, a.sigma_rad / ARCSEC) for e, a in course.recovered_angle.items()}
        row = _row("course.angle", "Δθ [arcsec]", ANGLE_MEANING, course.angle_change / ARCSEC, values)
        tables.append({"title": "Angle between the cameras", "rows": [row]})
    return {
        "count": len(course.times),
        "first": moment(float(course.times[0])),
        "last": moment(float(course.times[-1])),
        "shown": moment(float(course.times[course.shown])),
        "tables": tables,
        "worst": _worst(course),
        "files": [f"images/{c.camera}_{c.side}_course.tiff" for c in run.experiment.path.channels],
    }


def _row(
    key: str, name: str, meaning: str, true: np.ndarray, values: dict[str, tuple[np.ndarray, np.ndarray]]
) -> dict[str, Any]:
    cells = []
    finest = min(float(np.median(sigma)) for _, sigma in values.values())
    places = decimals_for(finest)
    for estimator in ESTIMATORS:
        value, sigma = values[estimator]
        error = float(np.sqrt(np.mean((value - true) ** 2)))
        size = float(np.sqrt(np.mean(sigma**2)))
        cells.append(
            {
                "key": f"{key}.{estimator}",
                "value": fixed(error, decimals_for(size)),
                "sigma": fixed(size, decimals_for(size)),
                "far": size > 0 and error > FAR * size,
            }
        )
    low, high = fixed(float(true.min()), places), fixed(float(true.max()), places)
    return {"key": key, "name": name, "meaning": meaning, "true": _range(low, high), "cells": cells}


def _range(low: str, high: str) -> str:
    low, high = low.strip(MINUS) if not low.strip(f"{MINUS}0.") else low, high
    return low if low == high else f"{low} … {high}"


def _worst(course: CourseRun) -> str:
    """The camera that the model reads worst in Δα, by how much, when, and how much truly happened."""
    errors = {
        name: (estimators["model"].vector[:, 0] - course.truth[name][0]) * PER_SI[0]
        for name, estimators in course.parameters.items()
    }
    name = max(errors, key=lambda n: float(np.max(np.abs(errors[n]))))
    k = int(np.argmax(np.abs(errors[name])))
    sigma = float(course.parameters[name]["model"].sigma[k, 0]) * PER_SI[0]
    true = float(course.truth[name][0, k]) * PER_SI[0]
    places = decimals_for(sigma)
    return (
        f"The model's largest error of Δα is {fixed(float(errors[name][k]), places, sign=True)} arcsec, camera {name} "
        f"at {moment(float(course.times[k]))}, where it truly is {fixed(true, places, sign=True)} "
        f"arcsec; the noise is {fixed(sigma, places)} arcsec."
    )
