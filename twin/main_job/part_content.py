"""What the report says of a series over times, of image quality, of stray light and of targets."""

from __future__ import annotations

from typing import Any

import numpy as np

from analysis.monitor.monitoring import PER_SI
from analysis.units import ARCSEC
from scenes.specs.course import moment
from twin.main_job.assumptions import course_agrees
from twin.main_job.render_results import RenderRun
from twin.main_job.report_labels import PARAMETERS
from twin.main_job.verdict import sharpness_lost
from twin.monitor.image_quality import PLACES, CameraQuality, ImageQuality
from twin.monitor.time_series import TimeSeries
from twin.path_tracing.families import Touch, family_name
from twin.path_tracing.path_result import Family
from twin.run.artefact import FAR, MINUS, decimals_for, fixed, plain, residual, residual_text, significant
from twin.targets.edge_images import DIRECTION_NAMES, DIRECTIONS
from twin.targets.target_result import NYQUIST, BarReading, CameraTargets, EdgeReading, PlaceTargets

ANGLE_MEANING = "angle between the two lines of sight"


def series_content(run: RenderRun) -> dict[str, Any] | None:
    """Facts and the table of errors; None for a job without a course."""
    series = run.series
    if series is None:
        return None
    tables = []
    for name, estimators in series.parameters.items():
        rows = []
        for k, p in enumerate(PARAMETERS):
            values = {e: (v.vector[:, k] * PER_SI[k], v.sigma[:, k] * PER_SI[k]) for e, v in estimators.items()}
            key = f"course.{name}.{p.key}"
            rows.append(_row(key, f"{p.symbol} [{p.unit}]", p.meaning, series.truth[name][k] * PER_SI[k], values))
        tables.append({"title": f"Camera {name}", "rows": rows})
    if series.recovered_angle:
        values = {e: (a.change_rad / ARCSEC, a.sigma_rad / ARCSEC) for e, a in series.recovered_angle.items()}
        row = _row("course.angle", "Δθ [arcsec]", ANGLE_MEANING, series.angle_change / ARCSEC, values)
        tables.append({"title": "Angle between the cameras", "rows": [row]})
    return {
        "count": len(series.times),
        "first": moment(float(series.times[0])),
        "last": moment(float(series.times[-1])),
        "shown": moment(float(series.times[series.shown])),
        "tables": tables,
        "worst": _worst(series, run.judged),
        "smoothed": _smoothed(series),
        "files": [f"images/{c.camera}_{c.side}_course.tiff" for c in run.experiment.path.channels],
    }


def _row(
    key: str, name: str, meaning: str, true: np.ndarray, values: dict[str, tuple[np.ndarray, np.ndarray]]
) -> dict[str, Any]:
    cells = []
    finest = min(float(np.median(sigma)) for _, sigma in values.values())
    places = decimals_for(finest)
    for estimator, (value, sigma) in values.items():
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


def _smoothed(series: TimeSeries) -> dict[str, str] | None:
    """What the smoothed changes rest on, and whether the measurements agree with it; None where nothing is stated."""
    together = series.smoothed
    if together is None:
        return None
    return {"name": together.name, "text": course_agrees(together, series.times)}


def _worst(series: TimeSeries, estimator: str) -> dict[str, str]:
    """The camera that an estimator reads worst in Δα, by how much, when, and how much truly happened, in arcsec."""
    errors = {
        name: (estimators[estimator].vector[:, 0] - series.truth[name][0]) * PER_SI[0]
        for name, estimators in series.parameters.items()
    }
    name = max(errors, key=lambda n: float(np.max(np.abs(errors[n]))))
    k = int(np.argmax(np.abs(errors[name])))
    sigma = float(series.parameters[name][estimator].sigma[k, 0]) * PER_SI[0]
    true = float(series.truth[name][0, k]) * PER_SI[0]
    places = decimals_for(sigma)
    return {
        "error": fixed(float(errors[name][k]), places, sign=True),
        "camera": name,
        "time": moment(float(series.times[k])),
        "true": fixed(true, places, sign=True),
        "sigma": fixed(sigma, places),
    }


WHEN = ("before", "after")
WAVES, MICROMETRES, MTF, PERCENT = 4, 1, 4, 2
"""Decimals."""


def quality_content(run: RenderRun) -> dict[str, Any] | None:
    """Table and what it is about; None when it was not asked for."""
    quality = run.quality
    if quality is None:
        return None
    where = {place: quality.fields.index(field) for place, field in PLACES.items()}
    return {
        "lost": _lost(quality),
        "wavelength": plain(1e9 * quality.wavelength),
        "fields": len(quality.fields),
        "places": list(where),
        "obstruction": quality.obstruction,
        "bodies": {name: ", ".join(camera.bodies) for name, camera in quality.cameras.items()},
        "rows": [_camera(name, camera, where) for name, camera in quality.cameras.items()],
    }


def _lost(quality: ImageQuality) -> str:
    share, where, change = sharpness_lost(quality)
    if share <= 0.0:
        return "The perturbation takes nothing of the MTF at Nyquist."
    return f"At most {significant(100.0 * share, 2, floor=0.0)} % of the MTF at Nyquist are lost, {where}: {change}."


def _camera(name: str, camera: CameraQuality, where: dict[str, int]) -> dict[str, Any]:
    lines: list[tuple[str, str, np.ndarray, float, int]] = [
        ("wfe_rms_waves", "wavefront error, rms [waves]", camera.wfe, 1.0, WAVES),
        ("wfe_rms_waves_focus_removed", "the same at best focus [waves]", camera.wfe_refocused, 1.0, WAVES),
        ("defocus_um", "best focus − line CCD [µm]", camera.defocus, 1e6, MICROMETRES),
        ("mtf_along_line", "MTF at Nyquist along the line", camera.mtf_along_line, 1.0, MTF),
        ("mtf_along_track", "MTF at Nyquist along the track", camera.mtf_along_track, 1.0, MTF),
        ("light_lost", "light taken by bodies in the beam [%]", camera.light_lost, 1e2, PERCENT),
    ]
    rows = []
    for key, label, values, unit, decimals in lines:
        sign = key == "defocus_um"
        cells = [
            {
                "key": f"quality.{name}.{key}.{place}.{when}",
                "value": fixed(unit * float(values[s, k]), decimals, sign=sign),
            }
            for place, k in where.items()
            for s, when in enumerate(WHEN)
        ]
        rows.append({"label": label, "cells": cells})
    first, last = (plain(1e9 * wavelength) for wavelength in camera.wavelengths)
    return {
        "name": name,
        "light": f"{first} nm" if first == last else f"{first} to {last} nm",
        "nyquist": plain(1e-3 * camera.nyquist, 4),
        "rows": rows,
    }


STRONGEST = 4
"""Families listed of each source."""


def stray_content(run: RenderRun) -> dict[str, Any] | None:
    """Shares and families of the perturbed state; None when no stray light was asked for."""
    if run.stray is None:
        return None
    after = run.stray.after
    channels = run.experiment.path.channels
    nominal = run.photons_after - after.photons
    shares = after.share(nominal)
    rows = []
    for i, channel in enumerate(channels):
        name = f"{channel.key}/area_ccd"
        families = [one for one in after.traced.relative(channel.key) if one[0].detector == name]
        families.sort(key=lambda one: -one[1])
        nominal = after.traced.runs[channel.key].nominal(name).touches
        by_kind = {kind: sum(share for f, share, _ in families if f.kind == kind) for kind in ("ghost", "stray")}
        rows.append(
            {
                "channel": channel.key,
                "share": significant(float(shares[i])),
                "ghosts": significant(by_kind["ghost"]),
                "scattered": significant(by_kind["stray"]),
                "peak": significant(float(after.photons[i].max())),
                "families": [_family(*family, name, nominal) for family in families[:STRONGEST]],
            }
        )
    taken = [
        {"body": o.body, "beam": o.beam, "share": fixed(100.0 * o.share, 1), "used": fixed(100.0 * o.used, 1)}
        for o in run.stray.obstructions
    ]
    return {"paths": f"{after.paths:,}".replace(",", "\N{THIN SPACE}"), "rows": rows, "taken": taken}


def _family(family: Family, share: float, sigma: float, detector: str, nominal: tuple[Touch, ...]) -> dict[str, str]:
    x, y = (fixed(1e6 * c, 1) for c in family.centroid)
    way = [str(touch) for touch in family.touches]
    common = _common(way)
    text = " \N{RIGHTWARDS ARROW} ".join(step.removeprefix(common) for step in way)
    return {
        "kind": family.kind,
        "name": family_name(family.touches, nominal),
        "share": f"{significant(share)} ± {significant(sigma, 1)}",
        "x": x,
        "y": y,
        "way": text,
        "detector": detector,
        "paths": str(family.count),
    }


def _common(way: list[str]) -> str:
    """``base/<camera>/monitor/<side>/`` of the prisms' names, which every step repeats."""
    prisms = [step for step in way if "/monitor/" in step]
    return "/".join(prisms[0].split("/")[:4]) + "/" if prisms else ""


METHODS = {"edge": "ISO 12233 slanted edge", "bars": "fundamental of tilted bars"}
DECIMALS = 4
"""Of an MTF."""


def target_content(run: RenderRun) -> dict[str, Any] | None:
    """Table and settings; None when no targets were asked for."""
    if run.targets is None:
        return None
    images = run.resolved.job.render.target_images
    edges, bars = "knife_edge" in images, "bars" in images
    kinds = [name for name, is_there in (("edge", edges), ("bars", bars)) if is_there]
    rows = (
        [_target_content_camera(name, camera, kinds) for name, camera in run.targets.cameras.items()] if kinds else []
    )
    return {
        "frames": run.targets.frames,
        "white": plain(100.0 * run.resolved.targets.white),
        "obstruction": run.targets.obstruction,
        "edges": edges,
        "bars": bars,
        "kinds": kinds,
        "methods": ", ".join(METHODS[kind] for kind in kinds),
        "width": 2 + 4 * len(kinds),
        "rows": rows,
        "bias": _largest_bias(run) if edges else "",
    }


def _target_content_camera(name: str, camera: CameraTargets, kinds: list[str]) -> dict[str, Any]:
    rows = []
    for place, targets in camera.places.items():
        for direction in DIRECTIONS:
            cells = [
                _cell(f"mtf.{name}.{place}.{direction}.{when}.{kind}", reading)
                for kind in kinds
                for when, reading in _readings(targets, direction, kind)
            ]
            first = direction == DIRECTIONS[0]
            along, across = (fixed(1e6 * float(value), 2, sign=True) for value in targets.shift)
            rows.append(
                {
                    "place": place,
                    "direction": DIRECTION_NAMES[direction],
                    "cells": cells,
                    "shift": f"{along if first else across} {DIRECTION_NAMES[direction]}",
                }
            )
    return {
        "name": name,
        "band": camera.band,
        "pitch": plain(1e6 * camera.pitch),
        "nyquist": plain(1e-3 * NYQUIST / camera.pitch, 4),
        "rows": rows,
    }


def _readings(targets: PlaceTargets, direction: str, kind: str) -> list[tuple[str, EdgeReading | BarReading]]:
    """Before and after."""
    if kind not in ("edge", "bars"):
        raise ValueError(f"a target measures an edge or bars, not {kind!r}")
    return [
        (when, shots.edges[direction] if kind == "edge" else shots.bars[direction])
        for when, shots in targets.shots.items()
    ]


def _cell(key: str, reading: EdgeReading | BarReading) -> dict[str, str]:
    """One measured value and its truth."""
    found = reading.nyquist if isinstance(reading, EdgeReading) else reading.reading
    if found is None:
        nothing = dict.fromkeys(("sigma", "residual", "mark"), "")
        return {"key": key, "value": "not measurable", "true": fixed(reading.true_nyquist, DECIMALS), **nothing}
    value, sigma = found
    true = reading.true_nyquist
    ratio = residual(value - true, sigma)
    far = ratio is not None and abs(ratio) > FAR
    return {
        "key": key,
        "value": fixed(value, DECIMALS),
        "sigma": fixed(sigma, DECIMALS),
        "residual": f"{residual_text(ratio)} \N{GREEK SMALL LETTER SIGMA}",
        "mark": "far" if far else "near",
        "true": fixed(true, DECIMALS),
    }


def _largest_bias(run: RenderRun) -> str:
    """By how much noise lengthens the MTF at Nyquist at most, empty when nobody knows."""
    assert run.targets is not None
    found = [
        edge.nyquist_bias
        for camera in run.targets.cameras.values()
        for place in camera.places.values()
        for shots in place.shots.values()
        for edge in shots.edges.values()
    ]
    known = [bias for bias in found if bias is not None]
    return significant(max(known), 2, floor=0.0) if known else ""
