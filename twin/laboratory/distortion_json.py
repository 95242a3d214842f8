"""Numbers of the distortion test, as distortion.json holds them."""

from __future__ import annotations

from typing import Any

import numpy as np

from analysis.turntable.chauvenet import rejection_rate
from analysis.units import ARCSEC
from twin.laboratory.distortion import DistortionRun, rms


def to_dict(run: DistortionRun) -> dict[str, Any]:
    """distortion.json: every number in the unit that its key ends in."""
    fit, smooth = run.compensated.fit, run.compensated.smooth
    names = ("principal_distance", "principal_point")
    f, p = (fit.terms.index(name) for name in names)
    return {
        "name": run.setup.test.name,
        "seed": run.seed,
        "principal_distance_mm": 1e3 * fit.value(names[0]),
        "principal_distance_mm_sigma": 1e3 * fit.sigma(names[0]),
        "principal_point_mm": 1e3 * fit.value(names[1]),
        "principal_point_mm_sigma": 1e3 * fit.sigma(names[1]),
        "correlation": float(fit.correlation[f, p]),
        "principal_point_observable": bool(fit.point.observable),
        "principal_point_statement": fit.point.statement,
        "rms_raw_um": 1e6 * rms(run.raw.smooth.residual),
        "rms_compensated_um": 1e6 * rms(smooth.residual),
        "zero_arcsec": run.compensated.zero / ARCSEC,
        "points": _points(run),
        "radial3_mm": 1e3 * smooth.value("radial3"),
        "radial3_mm_sigma": 1e3 * smooth.sigma("radial3"),
        "correlations": {"terms": list(smooth.terms), "matrix": smooth.correlation.tolist()},
        "estimates": {
            name: {
                "principal_distance_mm": 1e3 * e.f,
                "principal_distance_mm_sigma": None if e.f_sigma is None else 1e3 * e.f_sigma,
                "principal_point_mm": 1e3 * e.p,
                "principal_point_mm_sigma": None if e.p_sigma is None else 1e3 * e.p_sigma,
                "distortion_rms_um": 1e6 * e.rms,
            }
            for name, e in run.estimates.items()
        },
        "noise": {
            "centroid_um": 1e6 * rms(run.spots.temporal),
            "centroid_columns_um": 1e6 * rms(run.spots.fixed),
            "exposure_um": 1e6 * run.means.scatter,
            "white_raw_um": 1e6 * run.raw.white,
            "white_compensated_um": 1e6 * run.compensated.white,
            "rejected": int(np.sum(~run.means.keep)),
            "rejected_expected_of_good": rejection_rate(run.means.keep.shape[1]) * run.means.keep.size,
        },
        "compensation": {
            "fit": run.compensation.fit.name,
            "repeatability_arcsec": run.compensation.repeatability / ARCSEC,
            "common_arcsec": run.compensation.common / ARCSEC,
            "smooth_arcsec": run.compensation.smooth / ARCSEC,
            "white_arcsec": run.compensation.white / ARCSEC,
        },
        "truth": _truth(run),
    }


def _truth(run: DistortionRun) -> dict[str, Any]:
    exact = run.true_fit()
    raw, compensated = (rms(run.error(measured)) for measured in (run.raw, run.compensated))
    left = run.bench.true_offset - run.bench.design_offset
    return {
        "principal_distance_mm": 1e3 * exact.value("principal_distance"),
        "principal_point_mm": 1e3 * exact.value("principal_point"),
        "zero_arcsec": run.truth.zero / ARCSEC,
        "axis_tilt_arcsec": (run.truth.axis[1:] / run.truth.axis[0] / ARCSEC).tolist(),
        "distortion_um": (1e6 * run.true_distortion).tolist(),
        "error_rms_raw_um": 1e6 * raw,
        "error_rms_compensated_um": 1e6 * compensated,
        "reduction": 1.0 - compensated / raw,
        "principal_distance_error_sigma": (
            (run.compensated.fit.value("principal_distance") - exact.value("principal_distance"))
            / run.compensated.fit.sigma("principal_distance")
        ),
        "gross_errors": int(np.sum(run.truth.gross)),
        "gross_errors_kept": int(np.sum(run.truth.gross & run.means.keep)),
        "row_smile_um": 1e6 * float(np.ptp(run.truth.place[..., 1])),
        "estimates": {
            name: {
                "principal_distance_mm": 1e3 * e.f_true,
                "principal_point_mm": 1e3 * e.p_true,
                "distortion_error_rms_um": 1e6 * e.error,
            }
            for name, e in run.estimates.items()
        },
        "centroid_minus_chief_ray_left_um": (1e6 * left).tolist(),
    }


def _points(run: DistortionRun) -> list[dict[str, Any]]:
    raw, own = run.raw, run.compensated
    columns = {
        "reading_deg": np.degrees(run.means.mean(run.record.reading)),
        "field_deg": np.degrees(own.fit.angle),
        "position_mm": 1e3 * own.fit.position,
        "distortion_raw_um": 1e6 * raw.distortion,
        "distortion_compensated_um": 1e6 * own.distortion,
        "sigma_raw_um": 1e6 * raw.sigma,
        "sigma_um": 1e6 * own.sigma,
        "residual_raw_um": 1e6 * raw.smooth.residual,
        "residual_compensated_um": 1e6 * own.smooth.residual,
        "rms_over_sets_raw_um": 1e6 * raw.rms_over_sets,
        "rms_over_sets_compensated_um": 1e6 * own.rms_over_sets,
    }
    kept = run.means.keep.sum(axis=1)
    return [
        {"point": i + 1, **{name: float(values[i]) for name, values in columns.items()}, "sets_kept": int(kept[i])}
        for i in range(len(kept))
    ]
