"""What the report says about the cameras' image quality: wavefront error, defocus and MTF, before and after."""

from __future__ import annotations

from typing import Any

import numpy as np

from twin.image_quality import PLACES, CameraQuality
from twin.report.numbers import fixed, plain
from twin.results import RenderRun

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
        "wavelength": plain(1e9 * quality.wavelength),
        "fields": len(quality.fields),
        "places": list(where),
        "obstruction": quality.obstruction,
        "bodies": {name: ", ".join(camera.bodies) or "nothing" for name, camera in quality.cameras.items()},
        "rows": [_camera(name, camera, where) for name, camera in quality.cameras.items()],
    }


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
