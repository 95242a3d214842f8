"""What the report says about test targets: MTF at the Nyquist frequency, measured against true."""

from __future__ import annotations

from typing import Any

from twin.edge_images import DIRECTION_NAMES, DIRECTIONS
from twin.report.numbers import FAR, fixed, plain, residual, residual_text, significant
from twin.results import RenderRun
from twin.target_result import NYQUIST, BarReading, CameraTargets, EdgeReading, PlaceTargets

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
    rows = [_camera(name, camera, kinds) for name, camera in run.targets.cameras.items()] if kinds else []
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


def _camera(name: str, camera: CameraTargets, kinds: list[str]) -> dict[str, Any]:
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
    assert run.targets is not None
    found = [
        edge.nyquist_bias
        for camera in run.targets.cameras.values()
        for place in camera.places.values()
        for shots in place.shots.values()
        for edge in shots.edges.values()
    ]
    known = [bias for bias in found if bias is not None]
    return f"at most {significant(max(known), 2, floor=0.0)}" if known else "an unknown amount"
