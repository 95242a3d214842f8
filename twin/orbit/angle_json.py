"""angle.json: degrees, arcseconds and metres."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from analysis.orbit.sensitivity import STATEMENTS, judge
from twin.orbit.angle_analysis import ANGLES, ARCSEC, AngleRun, Scatter, resected, true_angles

PRINTED_DIFFERENCE_ARCSEC = {"alpha": 0.44, "beta": 1.53}
"""Resection and planes, paper 000, Table 1."""


def to_dict(run: AngleRun, seed: int) -> dict[str, Any]:
    """The numbers of a test as plain data; what could not be computed is None."""
    estimate, flight = run.estimate, run.flight
    section = estimate.resection
    sigma = [section.sigma[name] for name in ANGLES]
    return {
        "seed": seed,
        "time_s": flight.spec.time,
        "planes": {
            method: {**_degrees(angles.values), **_sigmas(angles.sigma)} for method, angles in estimate.angles.items()
        },
        "look": _degrees(estimate.look),
        "resection": {**_degrees(resected(section)), **_sigmas(sigma), "p_value": section.p_value},
        "truth": {
            "look": _degrees(true_angles(flight.look)),
            "dihedral": _degrees(true_angles(flight.dihedral)),
        },
        "difference_arcsec": _arcsec(run.difference),
        "difference_sigma_arcsec": _arcsec(run.difference_sigma),
        "difference_printed_arcsec": dict(PRINTED_DIFFERENCE_ARCSEC),
        "sensitivity": [row.to_dict() for row in run.table],
        "statements": [
            {
                "figure": j.statement.figure,
                "text": j.statement.text,
                "holds": bool(j.holds),
                "ratio": _number(j.ratio),
                "numbers": {axis: _number(v) for axis, v in j.numbers.items()},
            }
            for j in (judge(statement, run.table) for statement in STATEMENTS)
        ],
        "effects": [
            {"what": row.what, "bias_arcsec": _arcsec(row.bias), "corrected_arcsec": _arcsec(row.left)}
            for row in run.effects
        ],
        "frames": [
            {
                "frame": row.frame,
                "method": row.method,
                **_degrees(row.values),
                **_sigmas(row.sigma),
                "least_normal_z": row.steepest,
                "near_vertical": row.warned,
            }
            for row in run.frames
        ],
        "scatter": {
            "passes": len(run.planes.values),
            "planes": _scatter(run.planes),
            "resection": _scatter(run.resection),
        },
        "height_m_per_arcsec": dict(run.height),
    }


def _scatter(scatter: Scatter) -> dict[str, Any]:
    return {
        "bias_arcsec": _arcsec(scatter.bias),
        "spread_arcsec": _arcsec(scatter.spread),
        "sigma_arcsec": _arcsec(scatter.sigma),
        "p_value": {name: float(p) for name, p in zip(ANGLES, scatter.tail, strict=True)},
    }


def _degrees(values: Iterable[float]) -> dict[str, float | None]:
    return {f"{name}_deg": _number(np.degrees(v)) for name, v in zip(ANGLES, values, strict=True)}


def _sigmas(values: Iterable[float]) -> dict[str, float | None]:
    return {f"{name}_sigma_arcsec": _number(v / ARCSEC) for name, v in zip(ANGLES, values, strict=True)}


def _arcsec(values: Iterable[float]) -> dict[str, float | None]:
    return {name: _number(v / ARCSEC) for name, v in zip(ANGLES, values, strict=True)}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
