"""Figures and picture of the loop in orbit.md: one orbit with the loop closed, and the same with the loop open."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from docs.figures.simulated_years import short

ROOT = Path(__file__).resolve().parents[2]
SEED = 1
PICTURE = ROOT / "docs/loop.svg"
_TOP = {
    "height.closed": ("height_closed_rms_m", 2, "m"),
    "height.open": ("height_open_rms_m", 2, "m"),
    "height.sigma": ("height_sigma_rms_m", 2, "m"),
    "height.unseen": ("height_unseen_rms_m", 2, "m"),
    "angle.closed": ("angle_closed_rms_arcsec", 3, "arcsec"),
    "angle.open": ("angle_open_rms_arcsec", 2, "arcsec"),
    "gain_margin": ("gain_margin", 1, ""),
    "phase_margin": ("phase_margin_deg", 0, "deg"),
}


def measured() -> dict[str, tuple[float, int, str]]:
    """Run the example and draw the page's picture; figure -> value, decimals, unit."""
    with tempfile.TemporaryDirectory(prefix="figures-") as place:
        run = Path(place, "run")
        words = ("twin.orbit", "monitor", "scenes/orbit/loop.yaml", "--seed", str(SEED), "--quiet", "--out", str(run))
        subprocess.run([sys.executable, "-m", *words], cwd=ROOT, check=True)
        found = json.loads((run / "monitor.json").read_text("utf-8"))["loop"]
        PICTURE.write_text(short((run / "artefacts/course.svg").read_text("utf-8")), "utf-8")
    out = {f"loop.{name}": (float(found[key]), digits, unit) for name, (key, digits, unit) in _TOP.items()}
    for course in ("open", "closed"):
        out[f"loop.points.{course}"] = (float(found[course]["height_rms_m"]), 2, "m")
        for camera in ("forward", "backward"):
            focus = found[course]["focus"][camera]["defocus_rms_um"]
            out[f"loop.focus.{camera}.{course}"] = (float(focus), 0, "um")
    for camera, unseen in zip(("forward", "backward"), found["unseen_defocus_um"], strict=True):
        out[f"loop.focus.{camera}.unseen"] = (float(unseen), 0, "um")
    return out
