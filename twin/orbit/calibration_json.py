"""calibration.json: metres and radians, RMS in metres."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from analysis.orbit.forward_intersection import CheckErrors
from analysis.orbit.null_space import Combination
from analysis.orbit.three_line_model import BIAS
from twin.orbit.calibration_analysis import INNER, CalibrationRun, FieldResult
from twin.orbit.calibration_test import FieldPass


def to_dict(run: CalibrationRun, seed: int) -> dict[str, Any]:
    """The numbers of a calibration as plain data; what is not defined is None."""
    found, spec = run.together, run.campaign.spec
    sigma = found.sigma
    free = [k for k, name in enumerate(found.names) if sigma[name] > 0.0]
    limits = spec.limits
    return {
        "seed": seed,
        "parameters": {
            name: {"value": float(value), "sigma": sigma[name], "truth": float(true), "unit": unit(name)}
            for name, value, true in zip(found.names, found.values, run.truth, strict=True)
        },
        "correlations": {
            "names": [found.names[k] for k in free],
            "matrix": np.round(found.correlation[np.ix_(free, free)], 6).tolist(),
        },
        "null_vectors": [_combination(c) for c in found.open],
        "weak_vectors": [_combination(c) for c in found.weak],
        "gauge": str(found.gauge),
        "fit": {
            "chi_square": found.chi_square,
            "degrees_of_freedom": found.degrees_of_freedom,
            "p_value": found.p_value,
            "iterations": found.iterations,
        },
        "stepwise": {
            "field": spec.schemes[0][0],
            "rounds": run.paper_way.rounds,
            "rate": run.paper_way.rate,
            "converged": bool(run.paper_way.converged),
        },
        "fields": {p.name: _field(p, run.fields[p.name]) for p in run.campaign.passes},
        "schemes": {scheme: _errors(errors) for scheme, errors in run.schemes.items()},
        "scheme_fields": {
            scheme: list(spec.schemes[k]) if k < len(spec.schemes) else "each its own"
            for k, scheme in enumerate(run.schemes)
        },
        "before": _errors(run.before),
        "finding": {
            "plan_mean_m": run.finding.plan.tolist(),
            "plan_spread_m": run.finding.plan_spread.tolist(),
            "height_mean_m": run.finding.height.tolist(),
            "height_spread_m": run.finding.height_spread.tolist(),
            "plan_improves": run.finding.plan_improves,
            "plan_evens_out": run.finding.plan_evens_out,
            "height_stays": run.finding.height_stays,
            "holds": run.finding.holds,
        },
        "verdict": {
            "scale": "1:50000",
            "plan_limit_m": limits.plan,
            "height_limit_m": limits.height,
            "source": "of the file; the paper prints none",
            "before": meets(run.before, limits.plan, limits.height),
            "schemes": {k: meets(errors, limits.plan, limits.height) for k, errors in run.schemes.items()},
        },
    }


def unit(name: str) -> str:
    """SI unit of an unknown."""
    return "rad" if name.split()[-1] in BIAS else "m"


def meets(errors: Mapping[str, CheckErrors], plan: float, height: float) -> bool:
    """Whether every field's RMS errors lie within the limits, metres."""
    return all(e.plan_rms <= plan and e.height_rms <= height for e in errors.values())


def _field(one: FieldPass, result: FieldResult) -> dict[str, Any]:
    alone = result.adjustment
    bias, sigma = alone.bias(one.name), alone.sigma
    return {
        "latitude_rad": one.latitude,
        "bias": {
            name: {"value": float(v), "sigma": sigma[f"{one.name} {name}"], "truth": float(t), "unit": "rad"}
            for name, v, t in zip(BIAS, bias, one.bias, strict=True)
        },
        "interior": {name: {"value": alone.value(name), "sigma": sigma[name], "unit": "m"} for name in INNER},
        "p_value": alone.p_value,
        "orbit_third_difference_rms_m": result.orbit.rms.tolist(),
        "attitude_third_difference_rms_rad": result.attitude.rms.tolist(),
    }


def _errors(errors: Mapping[str, CheckErrors]) -> dict[str, dict[str, float]]:
    return {name: {"plan_rms_m": e.plan_rms, "height_rms_m": e.height_rms} for name, e in errors.items()}


def _combination(one: Combination) -> dict[str, Any]:
    return {
        "change": {name: float(v) for name, v in zip(one.names, one.change, strict=True)},
        "strength": one.strength,
        "sigma_m": one.sigma,
    }
