"""Numbers of an in-orbit calibration, as calibration.json has them: metres and radians."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.orbit.calibration_parameters import RATE
from analysis.orbit.forward_intersection import CheckErrors
from analysis.orbit.null_space import Combination
from analysis.orbit.three_line_model import BIAS
from scenes.specs.orbit_setup import CalibrationSetup, resolve_calibration
from twin.orbit.calibration.calibration_run import CalibrationRun, FieldResult, run_calibration
from twin.orbit.calibration.camera_drift import Monitoring, PooledErrors, Treatment
from twin.orbit.calibration.campaign import FieldPass
from twin.orbit.calibration.field_images import FieldImages, PatchRecord
from twin.orbit.calibration.influences import INNER, OFFSET, DatumRow, LightRow
from twin.orbit.calibration.latitude import LatitudeFit
from twin.orbit.calibration.repeatability import Repeatability, repeatability
from twin.orbit.calibration.schemes import STATEMENTS, Finding, Repeats
from twin.orbit.calibration.strip import Strips
from twin.orbit.images.point_judgement import LineJudgement
from twin.run.plain_data import plain_data
from twin.run.procedure import Procedure


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


def calibration_numbers(run: CalibrationRun) -> dict[str, Any]:
    """Contents of calibration.json without its frames; what is not defined is None."""
    found, spec = run.together, run.campaign.spec
    sigma = found.sigma
    whole = found.sigma_with(dict.fromkeys(found.gauge.held, spec.launch.interior))
    rates = [n for n in found.names if n in RATE]
    free = [k for k, name in enumerate(found.names) if sigma[name] > 0.0]
    limits = spec.limits
    return {
        "seed": run.seed,
        "parameters": {
            name: {
                "value": float(value),
                "sigma": sigma[name],
                "sigma_with_gauge": whole[name],
                "held": name in found.gauge.held,
                "truth": float(true),
                "unit": unit(name),
            }
            for name, value, true in zip(found.names, found.values, run.truth, strict=True)
        },
        "sigmas": {
            "sigma": "with the gauge's held unknowns exact"
            + (", and with the drift of the biases during the passes as the latitude fit tells it" if rates else ""),
            "sigma_with_gauge": "with what launch leaves to expect of the held unknowns, and all that follows them",
            "held_start_sigma_m": spec.launch.interior,
            "fields": "of each field by itself: without the drift of the biases during the pass",
        },
        "correlations": {
            "names": [found.names[k] for k in free],
            "matrix": np.round(found.correlation[np.ix_(free, free)], 6).tolist(),
        },
        "null_vectors": [_combination(c) for c in found.open],
        "weak_vectors": [_combination(c) for c in found.weak],
        "gauge": str(found.gauge),
        "images": None if run.campaign.images is None else plain_data(ImageNumbers.of(run.campaign.images)),
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
        "finding": None if run.finding is None else _finding(run.finding),
        "bias_latitude": {f.axis: _latitude(f) for f in run.latitude},
        "repeatability": [_repeatability(r) for r in repeatability(run)],
        "light": [_light(row) for row in run.light],
        "light_corrected": bool(spec.effects.corrected),
        "datum": [_datum(row) for row in run.datum],
        "surprises": [
            {"name": s.name, "change": s.change, "expected_sigma": s.expected, "ratio": s.ratio, "unit": unit(s.name)}
            for s in run.surprises
        ],
        "campaigns": None if run.repeats is None else _campaigns(run.repeats, limits.plan, limits.height),
        "monitoring": None if run.monitoring is None else monitoring_dict(run.monitoring),
        "strips": None if run.strips is None else strips_dict(run.strips, run.schemes),
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
    if name in RATE:
        return "rad/s"
    return "rad" if name.split()[-1] in BIAS else "m"


def _finding(finding: Finding) -> dict[str, Any]:
    return {
        "plan_mean_m": finding.plan.tolist(),
        "plan_spread_m": finding.plan_spread.tolist(),
        "height_mean_m": finding.height.tolist(),
        "height_spread_m": finding.height_spread.tolist(),
        "plan_improves": finding.plan_improves,
        "plan_evens_out": finding.plan_evens_out,
        "height_stays": finding.height_stays,
        "holds": finding.holds,
    }


def _latitude(fit: LatitudeFit) -> dict[str, Any]:
    return {
        "amplitude_rad": fit.amplitude,
        "amplitude_sigma_rad": fit.amplitude_sigma,
        "constant_rad": fit.constant,
        "constant_sigma_rad": fit.constant_sigma,
        "reference_rad": fit.reference,
        "remainder_rad": fit.remainder,
        "chi_square": fit.chi_square,
        "degrees_of_freedom": fit.degrees_of_freedom,
        "p_value": fit.p_value,
    }


def _repeatability(one: Repeatability) -> dict[str, Any]:
    return {
        "name": one.name,
        "unit": unit(one.name),
        "scatter": one.scatter,
        "sigma": one.sigma,
        "p_value": one.p_value,
        "paper": one.paper,
        "within_paper": one.holds,
    }


def _light(row: LightRow) -> dict[str, Any]:
    return {
        "left_in": list(row.left),
        "moved_rms_m": {line: v.tolist() for line, v in row.moved.items()},
        "before": {"plan_rms_m": row.before[0], "height_rms_m": row.before[1]},
        "after": {"plan_rms_m": row.after[0], "height_rms_m": row.after[1]},
        "parameter_change": {name: {"value": v, "unit": unit(name)} for name, v in row.shift.items()},
        "parameter_change_sigmas": {n: v / row.sigma[n] for n, v in row.shift.items() if row.sigma[n] > 0.0},
        "p_value": row.p_value,
    }


def _datum(row: DatumRow) -> dict[str, Any]:
    return {
        "shift_east_north_up_m": list(row.shift),
        "bias_change_rad": dict(zip(BIAS, row.bias.tolist(), strict=True)),
        "interior_change_m": dict(row.interior),
        "offset_change_m": dict(zip(OFFSET, row.offset.tolist(), strict=True)),
        "chi_square_change": row.fit,
        "p_value": row.p_value,
        "after": {"plan_rms_m": row.after[0], "height_rms_m": row.after[1]},
    }


def _campaigns(repeats: Repeats, plan: float, height: float) -> dict[str, Any]:
    return {
        "count": len(repeats.plan),
        "share": {key: repeats.share(key) for key in (*STATEMENTS, "holds")} if repeats.findings else None,
        "schemes": {
            scheme: {
                "plan_rms_m": repeats.plan[:, k].mean(axis=1).tolist(),
                "plan_spread_m": repeats.plan[:, k].std(axis=1).tolist(),
                "height_rms_m": repeats.height[:, k].mean(axis=1).tolist(),
                "height_spread_m": repeats.height[:, k].std(axis=1).tolist(),
                "share_within_limits": float(met),
            }
            for k, (scheme, met) in enumerate(zip(repeats.schemes, repeats.met(plan, height), strict=True))
        },
    }


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


@dataclass(frozen=True)
class ImageTotals:
    """Points in images, over all fields and lines; wrong by truth."""

    found: int
    matched: int
    accepted: int
    wrong_found: int
    wrong_matched: int
    wrong_accepted: int
    right_rejected_by_consensus: int
    entered: int
    left: int
    wrong_entered: int
    wrong_left: int
    check_entered: int
    check_left: int
    wrong_check_left: int
    right_rejected_by_adjustment: int

    @classmethod
    def of(cls, images: Sequence[FieldImages]) -> ImageTotals:
        """Of all fields."""
        every = [j for one in images for patch in one.patches for j in judgements(patch).values()]
        screenings = [one.screening for one in images if one.screening is not None]
        matched = {name: sum(getattr(j, name) for j in every) for name in _COUNTS}
        screened = {name: sum(getattr(s, name) for s in screenings) for name in _SCREENED}
        return cls(
            **matched,
            right_rejected_by_consensus=sum(j.good_lost for j in every),
            **screened,
            right_rejected_by_adjustment=sum(s.right_lost for s in screenings),
        )


_COUNTS = ("found", "matched", "accepted", "wrong_found", "wrong_matched", "wrong_accepted")
_SCREENED = ("entered", "left", "wrong_entered", "wrong_left", "check_entered", "check_left", "wrong_check_left")


@dataclass(frozen=True)
class MatchingNumbers:
    """Points of one sort in the images of one line, over a field's patches; RMS of those that are not wrong."""

    found: int
    matched: int
    accepted: int
    wrong_found: int
    wrong_matched: int
    wrong_accepted: int
    right_rejected_by_consensus: int
    rms_lines_px: float
    rms_pixels_px: float
    chi_square_ratio: float

    @classmethod
    def of(cls, parts: Sequence[LineJudgement]) -> MatchingNumbers:
        """Of some patches."""
        degrees = np.array([j.degrees_of_freedom for j in parts])
        square = np.sum([np.nan_to_num(j.rms) ** 2 * n for j, n in zip(parts, degrees, strict=True)], axis=0)
        rms = np.sqrt(square / max(degrees.sum(), 1))
        return cls(
            **{name: sum(getattr(j, name) for j in parts) for name in _COUNTS},
            right_rejected_by_consensus=sum(j.good_lost for j in parts),
            rms_lines_px=float(rms[0]),
            rms_pixels_px=float(rms[1]),
            chi_square_ratio=float(sum(j.chi_square for j in parts) / max(degrees.sum(), 1)),
        )

    @classmethod
    def by_line(cls, one: FieldImages) -> dict[str, dict[str, MatchingNumbers]]:
        """Sort of points -> line -> numbers of a field."""
        parts: dict[str, dict[str, list[LineJudgement]]] = {}
        for patch in one.patches:
            for (sort, line), j in judgements(patch).items():
                parts.setdefault(sort, {}).setdefault(line, []).append(j)
        return {sort: {line: cls.of(some) for line, some in lines.items()} for sort, lines in parts.items()}


def judgements(patch: PatchRecord) -> dict[tuple[str, str], LineJudgement]:
    """(sort of points, line) -> judgement."""
    return {(sort, line): j for sort, lines in patch.judgements.items() for line, j in lines.items()}


@dataclass(frozen=True)
class ImageNumbers:
    """Points in images; fields: field -> sort of points -> line."""

    total: ImageTotals
    fields: Mapping[str, Mapping[str, Mapping[str, MatchingNumbers]]]

    @classmethod
    def of(cls, images: Sequence[FieldImages]) -> ImageNumbers:
        """Of all fields."""
        return cls(ImageTotals.of(images), {one.name: MatchingNumbers.by_line(one) for one in images})


CALIBRATION = Procedure("calibration", CalibrationSetup, resolve_calibration, run_calibration, calibration_numbers)
