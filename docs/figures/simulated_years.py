"""Figures and pictures of simulated orbits.

They are the years on the page operation.md, three simulated missions, each estimated and compared with its truth; and
the loop in orbit.md, one orbit with the loop closed, and the same with the loop open.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
SEED = 1
PICTURE, LOOP_PICTURE = ROOT / "docs/operation.svg", ROOT / "docs/loop.svg"
_LONG = 2000
"""Number of characters above which a line of the SVG is a curve of data."""
_YEARS = ("--from", "2027-01-01T00:00:00Z", "--days", "1096", "--every", "6d", "--coefficient-error", "30%")
SENSORS = (
    "base",
    "base/forward",
    "base/backward",
    "base/central_prism",
    "base/forward/focal_plane",
    "base/backward/focal_plane",
)
"""Bodies with a sensor in the mission in which some fail."""
STUCK = "base/forward"
DEAD = ("base/backward", "base/central_prism")
_FAILING = (
    *(word for body in SENSORS for word in ("--sensor", body)),
    *(word for body in DEAD for word in ("--dead", f"{body}@2028-01-01T00:00:00Z")),
    *("--stuck", f"{STUCK}@2028-07-01T00:00:00Z"),
)
LIVES: Mapping[str, tuple[str, ...]] = {
    "pair": ("scenes/examples/operation.yaml",),
    "two": ("scenes/examples/operation_two.yaml",),
    "failing": ("scenes/examples/operation.yaml", *_FAILING),
}
"""Name of a mission -> its plan and further arguments of the command that simulates it."""
_QUANTITIES = {
    "angle": ("intersection_angle", "change_arcsec", "arcsec"),
    "height": ("ground", "height_m", "m"),
    "forward": ("forward", "d_f_um", "um"),
    "backward": ("backward", "d_f_um", "um"),
}
_WAYS = ("ground", "single", "filtered", "smoothed")
_DIGITS = {
    "pair": {"angle": 3, "height": 2, "forward": 1, "backward": 1},
    "two": {"angle": 4, "height": 4, "forward": 2, "backward": 2},
}
"""Missions whose errors the page quotes -> decimals of each."""


def short(drawn: str) -> str:
    """Return a drawing with long curves rounded to a hundredth of a pixel, which halves its size.

    Parameters
    ----------
    drawn : str
        An SVG; letters and scales keep their digits.
    """

    def rounded(line: re.Match[str]) -> str:
        return re.sub(r"(\d+\.\d\d)\d+", r"\1", line[0])

    return re.sub(rf'd="[^"]{{{_LONG},}}"', rounded, drawn)


def judged(words: tuple[str, ...], place: Path, picture: bool) -> dict[str, Any]:
    """Simulate a mission and compare its estimate with the truth.

    Parameters
    ----------
    words : tuple[str, ...]
        Plan and further arguments.
    place : Path
        Folder for all results.
    picture : bool
        Whether the page shows this mission.
    """
    record, out = place / "life", place / "judged"
    plan, *more = words
    for command in (
        ("simulate", plan, str(record), *_YEARS, "--seed", str(SEED), *more),
        ("judge", str(record), "--out", str(out)),
    ):
        subprocess.run([sys.executable, "-m", "twin.operate", *command, "--quiet"], cwd=ROOT, check=True)
    if picture:
        PICTURE.write_text(short((out / "artefacts/with_and_without.svg").read_text("utf-8")), "utf-8")
    found: dict[str, Any] = json.loads((out / "judged.json").read_text("utf-8"))
    return found


def measured() -> Mapping[str, tuple[float, int, str]]:
    """Return value, decimals and unit of each figure, by name, and draw the picture of the page."""
    out: dict[str, tuple[float, int, str]] = {}
    for life, words in LIVES.items():
        with tempfile.TemporaryDirectory(prefix="operation-") as place:
            errors = judged(words, Path(place), life == "pair")
        for name, (group, key, unit) in _QUANTITIES.items():
            own = errors["quantities"][group][key]
            for way in _WAYS if life in _DIGITS else ():
                digits = 1 if way == "ground" else _DIGITS[life][name]
                out[f"operation.{life}.{name}.{way}"] = (own[way]["rms"], digits, unit)
            if name in ("forward", "backward") and life != "two":
                share = errors["explained_by_temperatures"][f"{group} {key}"]
                out[f"operation.{life}.{name}.explained"] = (100.0 * share, 0, "%")
        for share in ("within_one", "within_two"):
            out[f"operation.{life}.{share}"] = (100.0 * errors["predictions"][share], 0, "%")
    return out


_LOOP = {
    "height.closed": ("height_closed_rms_m", 2, "m"),
    "height.open": ("height_open_rms_m", 2, "m"),
    "height.sigma": ("height_sigma_rms_m", 2, "m"),
    "height.unseen": ("height_unobservable_rms_m", 2, "m"),
    "angle.closed": ("angle_closed_rms_arcsec", 3, "arcsec"),
    "angle.open": ("angle_open_rms_arcsec", 2, "arcsec"),
    "gain_margin": ("gain_margin", 1, ""),
    "phase_margin": ("phase_margin_deg", 0, "deg"),
}


def loop_measured() -> dict[str, tuple[float, int, str]]:
    """Run the example, draw the page's picture, and return value, decimals and unit of each figure."""
    with tempfile.TemporaryDirectory(prefix="figures-") as place:
        run = Path(place, "run")
        words = ("twin.orbit", "monitor", "scenes/orbit/loop.yaml", "--seed", str(SEED), "--quiet", "--out", str(run))
        subprocess.run([sys.executable, "-m", *words], cwd=ROOT, check=True)
        loop = json.loads((run / "monitor.json").read_text("utf-8"))["loop"]
        LOOP_PICTURE.write_text(short((run / "artefacts/course.svg").read_text("utf-8")), "utf-8")
    out = {f"loop.{name}": (float(loop[key]), digits, unit) for name, (key, digits, unit) in _LOOP.items()}
    for course in ("open", "closed"):
        out[f"loop.points.{course}"] = (float(loop[course]["height_rms_m"]), 2, "m")
        for camera in ("forward", "backward"):
            focus = loop[course]["focus"][camera]["defocus_rms_um"]
            out[f"loop.focus.{camera}.{course}"] = (float(focus), 0, "um")
    for camera, unseen in zip(("forward", "backward"), loop["unobservable_defocus_um"], strict=True):
        out[f"loop.focus.{camera}.unseen"] = (float(unseen), 0, "um")
    return out
