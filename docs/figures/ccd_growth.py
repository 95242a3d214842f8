"""Principal distances of heated cameras whose line CCDs expand or keep their length.

They are the table "CCDs grow, too" of the page monitor.md.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import twin
from analysis.monitor.recovery import recover_monitor

ROOT = Path(__file__).resolve().parents[2]

EXPANDS, KEEPS = "forward", "backward"
"""The two cameras of a pair are alike: the line CCD of the one expands, the other's keeps its length."""
NO_HEAT = {"temperature": {"change": "1e-9 K"}}
"""Holds a line CCD at its length. A change of 0 K would count as no entry, and the line would inherit the heat."""
LINE = "base/{}/focal_plane/line"
SEED = 1
PRINTED = "paper_single"
"""Estimator that reads d_f by equation (7)."""


def measured() -> dict[str, tuple[float, int, str]]:
    """Return value, decimals and unit of each figure, by name."""
    camera, prism = "base/*", "base/*/monitor/left/prism_180"
    warmer: Mapping[str, Mapping[str, Any]] = {camera: {"temperature": "0.2 K"}}
    rows: Mapping[str, tuple[str, Mapping[str, Mapping[str, Any]], int]] = {
        "gf7_base": ("gf7_pair", {"base": {"temperature": "1 K"}}, 2),
        "monitor_base": ("monitor_pair", {"base": {"temperature": "1 K"}}, 2),
        "camera": ("monitor_pair", warmer, 2),
        "prism": ("monitor_pair", {**warmer, prism: {"temperature": {"gradient": "0 0.022 0 K/m"}}}, 1),
        "focal_plane": ("monitor_pair", {"base/*/focal_plane": {"temperature": "0.55 K"}}, 2),
    }
    out: dict[str, tuple[float, int, str]] = {}
    for name, (instrument, perturb, digits) in rows.items():
        kept, expanded, read = _heated(instrument, perturb)
        if name != "focal_plane":  # its mirrors are not heated, so that d_f is 0 by definition
            out[f"ccd.{name}.kept"] = (kept, 2, "um")
        out[f"ccd.{name}.expanded"] = (expanded, 2, "um")
        out[f"ccd.{name}.read"] = (read, digits, "um")
    return out | _orbit()


def _heated(instrument: str, perturb: Mapping[str, Mapping[str, Any]]) -> tuple[float, float, float]:
    """Return d_f of line CCDs that keep their length and that expand, and the reading of the latter, in micrometres.

    The first two are true values; the reading is by equation (7) from images without noise.

    Parameters
    ----------
    instrument : str
        Name of the pair.
    perturb : Mapping[str, Mapping[str, Any]]
        Perturbation as in a job; ``*`` stands for each camera.
    """
    pair = twin.load(instrument)
    nodes = {key.replace("*", camera): what for key, what in perturb.items() for camera in (EXPANDS, KEEPS)}
    shot = pair.perturbed({**nodes, LINE.format(KEEPS): NO_HEAT}).render(frames=1, seed=SEED)
    experiment = pair.experiment
    grey = experiment.expected_frames(shot.expected["photons"].values)
    recovery = recover_monitor(grey[0], grey[1:], experiment.calibration, frames=1)
    true = shot.truth["d_f_um"]
    read = float(recovery.parameters[EXPANDS][PRINTED].d_f_m[0])
    return float(true.sel(camera=KEEPS)), float(true.sel(camera=EXPANDS)), 1e6 * read


def _orbit() -> dict[str, tuple[float, int, str]]:
    """Return the RMS over an orbit of d_f, and of its reading by (7) minus the truth, for line CCDs of both kinds."""
    orbit = twin.load(ROOT / "scenes/examples/orbit.yaml")
    kept = orbit.perturbed({LINE.format(camera): NO_HEAT for camera in orbit.cameras})
    out: dict[str, tuple[float, int, str]] = {}
    for kind, job in (("expanded", orbit), ("kept", kept)):
        with tempfile.TemporaryDirectory(prefix="figures-") as place:
            course = json.loads((job.render(seed=SEED).save(Path(place, "run")) / "course.json").read_text("utf-8"))
        for camera, found in course["cameras"].items():
            true, read = (np.array(found[name]["d_f_um"]) for name in ("true", PRINTED))
            out[f"ccd.orbit.{camera}.{kind}"] = (_rms(true), 2, "um")
            out[f"ccd.orbit.{camera}.{kind}_error"] = (_rms(read - true), 1, "um")
    return out


def _rms(values: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
