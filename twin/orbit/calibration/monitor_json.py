"""Monitor and strips in calibration.json: metres and radians, RMS in metres."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from analysis.orbit.forward_intersection import CheckErrors
from twin.orbit.calibration.monitor import Monitoring, PooledErrors, Treatment
from twin.orbit.calibration.strip import Strips


def monitoring_dict(found: Monitoring) -> dict[str, Any]:
    """Errors by size of the drift, with and without the monitor."""
    return {
        "d_alpha_sigma_rad": found.angle,
        "height_for_1_arcsec_m": found.metres,
        "noise_counts_as": "independent",
        "sizes": [
            {
                "factor": size.factor,
                "d_alpha_sigma_rad": size.factor * found.angle,
                "without_monitor": _treatment(size.without),
                "with_monitor": None if size.told is None else _treatment(size.told),
            }
            for size in found.sizes
        ],
    }


def strips_dict(found: Strips, before: Mapping[str, Mapping[str, CheckErrors]]) -> dict[str, Any]:
    """Errors of every scheme and field without tie points and with them."""
    return {
        "ties": dict(found.ties),
        "p_value": dict(found.p_values),
        "schemes": {
            scheme: {
                "without_ties": _pooled(PooledErrors.of(before[scheme].values())),
                "with_ties": _pooled(PooledErrors.of(fields.values())),
            }
            for scheme, fields in found.schemes.items()
        },
        "datum": {
            d.name: {"sigma_before": d.before, "sigma_after": d.after, "unit": "rad/s" if "rate" in d.name else "rad"}
            for d in found.datum
        },
    }


def _treatment(one: Treatment) -> dict[str, Any]:
    return {
        "all_fields": _pooled(one.together),
        "p_value": one.p_value,
        "schemes": {scheme: _pooled(errors) for scheme, errors in one.schemes.items()},
    }


def _pooled(errors: PooledErrors) -> dict[str, float]:
    return {"plan_rms_m": errors.plan, "height_rms_m": errors.height}
