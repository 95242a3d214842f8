"""Numbers of an intersection-angle test, as angle.json has them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from analysis.orbit.sensitivity import STATEMENTS, judge
from analysis.units import ARCSEC
from scenes.specs.orbit_setup import AngleSetup, resolve_angle
from twin.orbit.angle.angle_run import AngleRun, Scatter, run_angle, values_of
from twin.run.procedure import Procedure

PRINTED_DIFFERENCE_ARCSEC = {"alpha": 0.44, "beta": 1.53}
"""Resection and planes, paper 000, Table 1."""


def angle_numbers(run: AngleRun) -> dict[str, Any]:
    """Contents of angle.json without its frames; what could not be computed is None. Angles' keys begin with their
    names.
    """
    estimate, flight, names = run.estimate, run.flight, run.names

    def degrees(values: Iterable[float]) -> dict[str, float | None]:
        return {f"{name}_deg": _number(np.degrees(v)) for name, v in zip(names, values, strict=True)}

    def sigmas(values: Iterable[float]) -> dict[str, float | None]:
        return {f"{name}_sigma_arcsec": _number(v / ARCSEC) for name, v in zip(names, values, strict=True)}

    def arcsec(values: Iterable[float]) -> dict[str, float | None]:
        return {name: _number(v / ARCSEC) for name, v in zip(names, values, strict=True)}

    return {
        "seed": run.seed,
        "time_s": flight.spec.time,
        "angles": {name: list(pair) for name, pair in flight.pairs.items()},
        "planes": {
            method: {**degrees(angles.values), **sigmas(angles.sigma)} for method, angles in estimate.angles.items()
        },
        "folded": {name: bool(f) for name, f in zip(names, estimate.angles["tls"].folded, strict=True)},
        "look": degrees(estimate.look),
        "along_track": {**degrees(estimate.along.values), **sigmas(estimate.along.sigma)},
        "resection": {
            **degrees(run.resected),
            **sigmas(run.resected_sigma),
            "p_value": estimate.resection.p_value,
        },
        "truth": {
            "look": degrees(flight.look.values()),
            "dihedral": degrees(flight.dihedral.values()),
            "along_track": degrees(flight.along_track.values()),
        },
        "change_arcsec": {
            "ground": arcsec(run.change),
            "truth": arcsec(values_of(flight.look) - values_of(flight.laboratory_look)),
            "trace": {name: _number(v / ARCSEC) for name, v in flight.trace.items()},
        },
        "difference_arcsec": arcsec(run.difference),
        "difference_sigma_arcsec": arcsec(run.difference_sigma),
        "difference_printed_arcsec": dict(PRINTED_DIFFERENCE_ARCSEC) if run.of_paper else {},
        "sensitivity": [row.to_dict() for row in run.table],
        "statements": [
            {
                "figure": j.statement.figure,
                "text": j.statement.text,
                "holds": bool(j.holds),
                "ratio": _number(j.ratio),
                "numbers": {axis: _number(v) for axis, v in j.numbers.items()},
            }
            for j in (judge(statement, run.table) for statement in STATEMENTS if run.of_paper)
        ],
        "effects": [
            {"what": row.what, "bias_arcsec": arcsec(row.bias), "corrected_arcsec": arcsec(row.left)}
            for row in run.effects
        ],
        "frames": [
            {
                "frame": row.frame,
                "method": row.method,
                **degrees(row.values),
                **sigmas(row.sigma),
                "least_normal_z": row.steepest,
                "near_vertical": row.warned,
            }
            for row in run.frames
        ],
        "scatter": {
            "passes": len(run.planes.values),
            "planes": _scatter(names, run.planes),
            "along_track": _scatter(names, run.along),
            "resection": _scatter(names, run.resection),
        },
        "height_m_per_arcsec": dict(run.height),
    }


def _scatter(names: Sequence[str], scatter: Scatter) -> dict[str, Any]:
    rows = {"bias": scatter.bias, "spread": scatter.spread, "sigma": scatter.sigma}
    return {
        **{f"{key}_arcsec": dict(zip(names, (row / ARCSEC).tolist(), strict=True)) for key, row in rows.items()},
        "p_value": dict(zip(names, scatter.tail.tolist(), strict=True)),
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


ANGLE = Procedure("angle", AngleSetup, resolve_angle, run_angle, angle_numbers)
