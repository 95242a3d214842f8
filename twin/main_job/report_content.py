"""What the main report says: set-up, results, goodness of fit, systematic errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from analysis.units import ARCSEC
from optics.geometry.tree import Motion
from optics.thermal.heat import Temperature
from scenes.models.job_state import motions_of
from scenes.specs.instrument import BASE
from twin.main_job.render_results import RenderRun
from twin.main_job.report_labels import ANGLE, GROUND, PARAMETERS, Parameter
from twin.main_job.systematics import joined, systematics
from twin.run.artefact import FAR, decimals_for, fixed, plain, residual, residual_text, shown_unit

ZERO_CELSIUS = 273.15
GROUND_TITLE = "Points on the ground, located as if the cameras had not changed: error"


def setup(run: RenderRun) -> dict[str, Any]:
    """Instrument, exposure and perturbations."""
    spec, instrument = run.resolved.instrument, run.experiment.instrument
    cameras = []
    for name, model in instrument.cameras.items():
        focal = run.experiment.nominal_truth.principal_distance[name]
        site, line = spec.cameras[name], model.spec.line
        cameras.append(
            {
                "name": name,
                "model": model.spec.name,
                "look": fixed(float(np.degrees(site.look)), 2, sign=True),
                "focal": fixed(focal, 4),
                "f_number": fixed(focal / model.spec.entrance_pupil, 1),
                "pixels": line.pixels,
                "pitch_um": plain(1e6 * line.pitch),
                "length_mm": fixed(1e3 * line.pixels * line.pitch, 1),
                "separation": fixed(1e3 * instrument.separation[name], 2),
            }
        )
    monitor = spec.monitor
    ccd = monitor.area_ccd
    parts = [one for name in spec.cameras for one in spec.channels_of(name).values()]
    return {
        "cameras": cameras,
        "monitor": {
            "wavelength_nm": plain(1e9 * monitor.wavelength),
            "pinhole_um": plain(1e6 * monitor.reticle.pinhole),
            "return_face_mm": _all([1e3 * c.aperture for c in instrument.channels]),
            "fields_deg": _fields([float(np.degrees(one.field)) for one in parts]),
            "photons_1e6": _all([1e-6 * c.photons for c in instrument.channels]),
        },
        "ccd": {
            "rows": ccd.rows,
            "columns": ccd.columns,
            "pitch_um": plain(1e6 * ccd.pitch),
            "bits": run.resolved.detector.bit_depth,
            "exposure_ms": plain(1e3 * ccd.exposure),
        },
        "centroid": run.resolved.job.analysis.centroid,
        "perturbations": _perturbations(run),
        "reference": fixed(spec.temperature - ZERO_CELSIUS, 2),
        "heated": _heated(run),
    }


def _all(values: list[float]) -> str:
    """Different values among those of all channels: ``50``, or ``34, 24``."""
    return ", ".join(dict.fromkeys(plain(value) for value in values))


def _fields(degrees: list[float]) -> str:
    """Different field places: ``±1.22``, or ``±1.22, 1.25`` where one end of the line has more than the other."""
    ends: dict[str, set[bool]] = {}
    for field in degrees:
        ends.setdefault(plain(abs(field)), set()).add(field > 0.0)
    signs = {frozenset((True, False)): "±", frozenset((True,)): "", frozenset((False,)): "\N{MINUS SIGN}"}
    return ", ".join(signs[frozenset(own)] + size for size, own in ends.items())


def _perturbations(run: RenderRun) -> list[dict[str, str]]:
    """What the job does to each node, at the time that is shown; not what follows from it for other bodies."""
    job = run.resolved.job
    shown = None if run.series is None else run.series.shown
    motions, fields = motions_of(job, shown), job.fields(shown)
    out = []
    for path in dict.fromkeys((*motions, *fields)):
        motion = motions.get(path, Motion())
        parts = [_motion_text(motion)] if _motion_text(motion) or path not in fields else []
        warm = path in job.perturb and job.perturb[path].temperature.table is not None
        parts += [_heat_text(fields[path])] if path in fields and not (warm and fields[path] == Temperature()) else []
        deformed = job.perturb[path].deformation if path in job.perturb else None
        parts = [*filter(None, parts), "deformed by a table of nodes"] if deformed is not None else parts
        parts = [*filter(None, parts), "warmed by a table of nodes"] if warm else parts
        out.append({"node": path, "motion": "; ".join(parts), "pivot": motion.pivot})
    return out


def _heated(run: RenderRun) -> int:
    """How many bodies have another temperature than nominal, faces of prisms not counted."""
    job = run.resolved.job
    time = None if run.series is None else run.series.shown
    fields = run.experiment.thermal.fields(run.experiment.fields(job, time))
    return sum(path in run.experiment.thermal.materials and field != Temperature() for path, field in fields.items())


def _motion_text(motion: Motion) -> str:
    parts = []
    for name, vector, unit, size in (("rotate", motion.rotate, "arcsec", ARCSEC), ("shift", motion.shift, "µm", 1e-6)):
        if any(vector):
            parts.append(f"{name} ({', '.join(plain(v / size) for v in vector)}) {unit}")
    if motion.scale:
        parts.append(f"scale {plain(1e6 * motion.scale)} ppm")
    terms = [f"Z{j} {plain(1e9 * a)} nm" for j, a in motion.figure.items() if a]
    if terms:
        parts.append(f"figure {', '.join(terms)}")
    return "; ".join(parts)


def _heat_text(field: Temperature) -> str:
    text = f"temperature {plain(field.change)} K"
    if any(field.gradient):
        text += f", gradient ({', '.join(plain(1e3 * g) for g in field.gradient)}) mK/m"
    return text


def stated(run: RenderRun) -> list[dict[str, Any]]:
    """What is stated to move, cause by cause; nothing where nothing is."""
    motions, spec = run.experiment.stated, run.resolved.disturbances
    if motions is None or spec is None:
        return []
    out = []
    for name, cause in spec.causes.items():
        own = [c for c in motions.components if c.cause == name]
        bodies = list(dict.fromkeys(c.body for c in own))
        sizes: dict[tuple[str, str], list[str]] = {}
        for c in own:
            if c.body == bodies[0]:
                size = f"{plain(c.sigma / c.unit_size)} {shown_unit(c.unit)}"
                sizes.setdefault((c.kind, size), []).append(c.what.removeprefix(c.kind).strip())
        what = []
        for (kind, size), axes in sizes.items():
            which = "" if axes in (["x", "y", "z"], [""]) else f" {', '.join(axes)}"
            what.append(f"{kind.replace('_', ' ')}{which} {size}")
        together = "" if cause.together is None else f"; bodies together {plain(cause.together)}"
        together += f"; {len(cause.correlations)} correlations" * bool(cause.correlations)
        out.append(
            {
                "name": name.replace("_", " "),
                "bodies": ", ".join(cause.bodies),
                "count": len(bodies),
                "what": "; ".join(what) + together,
                "time": cause.time.text,
                "reason": cause.reason,
            }
        )
    return out


def results(run: RenderRun) -> list[dict[str, Any]]:
    """Tables of recovered against true: one per camera, one for the angle, one for the ground."""
    recovered, truth = run.recovered_dict(), run.truth_dict()
    tables = []
    for name, estimators in recovered["cameras"].items():
        rows = []
        for p in PARAMETERS:
            rows.append(_row(run, f"{name}.{p.key}", p, truth["cameras"][name], estimators))
        tables.append({"title": f"Camera {name}", "rows": rows})
    if "intersection_angle" in truth:
        true = truth["intersection_angle"]
        nominal = fixed(true["nominal_deg"], 4)
        row = _row(run, "intersection_angle", ANGLE, true, recovered["intersection_angle"])
        tables.append({"title": f"Angle between the cameras, nominally {nominal}°", "rows": [row]})
    if "ground" in truth:
        rows = [_row(run, f"ground.{p.key}", p, truth["ground"], recovered["ground"]) for p in GROUND]
        tables.append({"title": GROUND_TITLE, "rows": rows})
    return tables


def _row(
    run: RenderRun, key: str, p: Parameter, truth: Mapping[str, float], found: Mapping[str, Mapping[str, float]]
) -> dict[str, Any]:
    true = truth[p.key]
    sigmas = {estimator: values[f"{p.key}_sigma"] for estimator, values in found.items()}
    noise = found[run.judged][f"{p.key}_sigma_noise"]
    finest = min((s for s in sigmas.values() if s > 0), default=0.0)
    cells = []
    for estimator, values in found.items():
        value, sigma, own = values[p.key], sigmas[estimator], values[f"{p.key}_sigma_noise"]
        places = decimals_for(sigma)
        ratio = residual(value - true, sigma)
        cells.append(
            {
                "key": f"{key}.{estimator}",
                "estimator": estimator,
                "value": fixed(value, places),
                "sigma": fixed(sigma, places),
                "noise": fixed(own, decimals_for(own)),
                "residual": residual_text(ratio),
                "far": ratio is not None and abs(ratio) > FAR,
                "ratio": ratio,
            }
        )
    return {
        "key": key,
        "symbol": p.symbol,
        "unit": p.unit,
        "meaning": p.meaning,
        "true": fixed(true, decimals_for(finest)),
        "noise": fixed(noise, decimals_for(noise)),
        "cells": cells,
    }


def residual_panels(tables: list[dict[str, Any]]) -> dict[str, dict[str, dict[str, float | None]]]:
    """The residuals of ``results`` for the figure."""

    def ratios(row: dict[str, Any]) -> dict[str, float | None]:
        return {cell["estimator"]: cell["ratio"] for cell in row["cells"]}

    return {table["title"]: {row["symbol"]: ratios(row) for row in table["rows"]} for table in tables}


def spots(run: RenderRun) -> list[dict[str, Any]]:
    """Measured spot positions and shifts."""
    rows = []
    pitch = 1e6 * run.experiment.path.pitch
    measured = run.recovered_dict()["spots"]
    for i, channel in enumerate(run.experiment.path.channels):
        one = measured[channel.camera][channel.side]
        covariance = run.recovery.shift_covariance[0]
        for j, axis in enumerate(("row", "column")):
            start, end = one["before"], one["after"]
            shift = end[axis] - start[axis]
            k = 2 * i + j
            sigma = float(np.sqrt(covariance[k, k]))
            rows.append(
                {
                    "key": f"{channel.key}.{axis}",
                    "channel": f"{channel.camera} {channel.side}",
                    "first": axis == "row",
                    "axis": axis,
                    "before": _with_sigma(start[axis], start[f"sigma_{axis}"]),
                    "after": _with_sigma(end[axis], end[f"sigma_{axis}"]),
                    "shift_px": _with_sigma(shift, sigma, sign=True),
                    "shift_um": _with_sigma(shift * pitch, sigma * pitch, sign=True),
                }
            )
    return rows


def _with_sigma(value: float, sigma: float, sign: bool = False) -> str:
    places = decimals_for(sigma)
    return f"{fixed(value, places, sign)} ± {fixed(sigma, places)}"


def goodness(run: RenderRun) -> list[dict[str, Any]]:
    """Residuals of the judged estimator against what the crosstalk table says they must be; what is left over is noise,
    and judged by it alone.
    """
    out = []
    recovered, truth = run.recovered_dict()["cameras"], run.truth_dict()["cameras"]
    for name in run.experiment.instrument.cameras:
        found = systematics(run, name)
        rows = []
        for k, p in enumerate(PARAMETERS):
            own = recovered[name][run.judged]
            sigma, noise = own[f"{p.key}_sigma"], own[f"{p.key}_sigma_noise"]
            error = own[p.key] - truth[name][p.key]
            bias = float(found.bias[run.judged][k])
            places = decimals_for(noise)
            left = residual(error - bias, noise)
            rows.append(
                {
                    "symbol": p.symbol,
                    "unit": p.unit,
                    "error": fixed(error, places, sign=True),
                    "in_sigma": residual_text(residual(error, sigma)),
                    "bias": fixed(bias, places, sign=True),
                    "left": fixed(error - bias, places, sign=True),
                    "left_in_sigma": residual_text(left),
                    "far": left is not None and abs(left) > FAR,
                }
            )
        out.append({"name": name, "rows": rows, "outside": joined(found.outside), "uncovered": joined(found.uncovered)})
    return out


def summary(tables: list[dict[str, Any]]) -> dict[str, Any]:
    """How many of each estimator's readings agree with the truth."""
    counts: dict[str, list[int]] = {}
    for table in tables:
        for row in table["rows"]:
            for cell in row["cells"]:
                count = counts.setdefault(cell["estimator"], [0, 0])
                count[1] += 1
                count[0] += not cell["far"]
    return {e: {"good": good, "all": every} for e, (good, every) in counts.items()}


def body_name(path: str) -> str:
    """A body's path without the base."""
    return path.removeprefix(f"{BASE}/")
