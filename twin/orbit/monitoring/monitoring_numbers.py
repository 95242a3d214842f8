"""Numbers of a monitored orbit, as monitor.json has them: times in seconds, changes in arcseconds and micrometres,
errors in metres.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from analysis.monitor.monitoring import PARAMETERS, PER_SI
from analysis.units import ARCSEC
from scenes.specs.orbit_monitor import PARAMETERS as APPLICABLE
from scenes.specs.orbit_setup import MonitorSetup, resolve_monitor
from twin.orbit.monitoring.monitoring_flight import Cause
from twin.orbit.monitoring.monitoring_run import CaseErrors, MonitorRun, rms, run_monitor
from twin.run.procedure import Procedure


def monitor_numbers(run: MonitorRun) -> dict[str, Any]:
    """Contents of monitor.json without its frames. Errors at the top level are those with the file's interval."""
    flight, spec = run.flight, run.flight.spec
    chosen, scatter, low_high = run.cases["interval"], run.scatter, run.scatter.limits
    change = run.angle_change / ARCSEC
    return {
        "seed": run.seed,
        "interval_s": spec.interval,
        "height_rms_m": chosen.height_rms,
        "height_worst_m": chosen.worst,
        "height_camera_rms_m": chosen.camera_height_rms,
        "plan_rms_m": chosen.plan_rms,
        "metres_per_arcsec": run.conversion.of_angle,
        "times_s": flight.times.tolist(),
        "reference_time_s": spec.reference,
        "monitored_times_s": flight.times[spec.measured(spec.interval)].tolist(),
        "cameras": {name: _camera(run, name) for name in flight.pair},
        "intersection_angle": {
            "reference_deg": float(np.degrees(flight.angle[spec.referred])),
            "true_change_arcsec": plain(change),
            "monitored_change_arcsec": plain(run.angle / ARCSEC),
            "monitored_change_sigma_arcsec": plain(run.angle_sigma / ARCSEC),
            "true_change_span_arcsec": float(np.ptp(change)),
        },
        "cases": {name: {**_summary(case), **_series(case)} for name, case in run.cases.items()},
        "intervals": [{"interval_s": interval, **_summary(case)} for interval, case in run.intervals.items()],
        "conversion": {
            "by_angle_m_per_arcsec": run.conversion.of_angle,
            "by_common_turn_m_per_arcsec": run.conversion.of_common,
            "by_camera_m_per_arcsec": dict(run.conversion.traced),
            "theory_by_camera_m_per_arcsec": dict(run.conversion.theory),
            "base_to_height": run.conversion.base_to_height,
        },
        "sensitivity": {name: _slopes(run, name) for name in flight.pair},
        "propagation": {
            "height_sigma_m": plain(run.sigma),
            "time_s": float(flight.times[flight.worst]),
            "repeats": len(scatter.heights),
            "sigma_m": scatter.sigma,
            "spread_m": scatter.spread,
            "ratio": scatter.spread / scatter.sigma,
            "lower_limit": low_high[0],
            "upper_limit": low_high[1],
            "agrees": scatter.agrees,
        },
        "parts": {name: {"height_rms_m": rms(part), "height_m": plain(part)} for name, part in run.parts.items()},
        "causes": [_cause(run, cause) for cause in flight.causes],
        "correction_residual_arcsec": run.residual / ARCSEC,
    }


def plain(values: np.ndarray) -> list[float]:
    """A list; adding 0.0 turns a negative zero into a plain one."""
    return [float(v) for v in np.asarray(values) + 0.0]


def cause_heights(run: MonitorRun, cause: Cause) -> tuple[float, float]:
    """Metres of height that a cause alone makes at its time: without monitoring, and what the monitor is wrong by."""
    flight = run.flight
    slopes = {n: run.slopes[n][flight.worst] for n in flight.pair}
    without = sum(float(-slopes[n] @ cause.truth[n]) for n in flight.pair)
    applied = np.array([float(name in flight.spec.apply) for name in APPLICABLE])
    left = sum(float(slopes[n] @ (applied * cause.error[n])) for n in flight.pair)
    return without, left


def _camera(run: MonitorRun, name: str) -> dict[str, Any]:
    flight = run.flight
    return {
        "true": _table(flight.truth[name]),
        "monitored": flight.monitored[name].to_dict(),
        "without_noise": _table(flight.clean[name]),
        "prisms_alone": _table(flight.prisms[name]),
    }


def _table(values: np.ndarray) -> dict[str, list[float]]:
    return {key: plain(column) for key, column in zip(PARAMETERS, (values * PER_SI).T, strict=True)}


def _summary(case: CaseErrors) -> dict[str, float]:
    return {
        "height_rms_m": case.height_rms,
        "height_worst_m": case.worst,
        "height_bias_rms_m": rms(case.bias),
        "height_camera_rms_m": case.camera_height_rms,
        "plan_rms_m": case.plan_rms,
        "plan_camera_rms_m": rms(case.camera_plan),
    }


def _series(case: CaseErrors) -> dict[str, dict[str, list[float]]]:
    return {
        "series": {
            "height_rms_m": plain(case.height),
            "height_bias_m": plain(case.bias),
            "height_camera_m": plain(case.camera),
            "plan_rms_m": plain(case.plan),
        }
    }


def _slopes(run: MonitorRun, name: str) -> dict[str, float]:
    at = run.slopes[name][run.flight.spec.referred] / PER_SI
    keys = ("d_alpha_m_per_arcsec", "d_beta_m_per_arcsec", "d_gamma_m_per_arcsec", "d_f_m_per_um")
    return {key: float(value) for key, value in zip(keys, at, strict=True)}


def _cause(run: MonitorRun, cause: Cause) -> dict[str, Any]:
    without, left = cause_heights(run, cause)
    keys = dict(zip(PARAMETERS, PER_SI, strict=True))
    return {
        "what": cause.what,
        "node": cause.path,
        "true": {
            n: {k: float(v * s) for (k, s), v in zip(keys.items(), t, strict=True)} for n, t in cause.truth.items()
        },
        "monitor_error": {
            n: {k: float(v * s) for (k, s), v in zip(keys.items(), t, strict=True)} for n, t in cause.error.items()
        },
        "height_without_monitoring_m": without,
        "height_left_by_monitor_m": left,
    }


MONITOR = Procedure("monitor", MonitorSetup, resolve_monitor, run_monitor, monitor_numbers)
