"""Report of points measured in a user's images."""

from __future__ import annotations

import numpy as np

from twin.framework.report import Report, Section, answer
from twin.orbit.images.point_report import found_table, how_measured, point_artefacts
from twin.orbit.matching.match_run import IMAGE, Match

_FAR = 0.5
"""Share of the search range beyond which a displacement leaves the search little room."""


def match_report(run: Match) -> Report:
    """Return the report of a run."""
    return Report(
        "Points measured in images",
        *_verdict(run),
        _facts(run),
        found_table(run.points),
        (_measured(run), _images(run)),
        warnings=_warnings(run),
    )


def _verdict(run: Match) -> tuple[str, tuple[str, ...]]:
    """Return the verdict and the sentences after it."""
    role = run.measurements.ground.role
    counts = [f"{int(np.sum(role == name))} {name}" for name in ("control", "check", "tie") if np.any(role == name)]
    ways = [
        (float(np.linalg.norm(line.moved)), name)
        for one in run.points.sorts.values()
        for name, line in one.lines.items()
        if one.kind == "map" and line.accepted.any()
    ]
    far = ""
    if ways:
        way, name = max(ways)
        far = f"the largest difference from camera and platform is {way:.1f} px, in {name}"
    shares = [
        (float(line.accepted.mean()), name) for one in run.points.sorts.values() for name, line in one.lines.items()
    ]
    share, name = min(shares)
    return answer(
        f"{', '.join(counts)} points were measured in {len(run.ground.images)} images",
        f"the share of accepted points is lowest in {name}, {share:.0%}: see Why points were not accepted",
        far,
    )


def _facts(run: Match) -> tuple[tuple[str, str], ...]:
    """Return the input quantities listed in the report."""
    maps, spec = run.ground.control, run.setup.test
    plan, height = spec.control_sigma
    return (
        ("Camera", run.setup.camera.name),
        ("Orthophoto", f"{maps.orthophoto.raster.crs.name}, {maps.orthophoto.spacing:.3g} m"),
        ("Elevation model", f"{maps.dem.raster.crs.name}, {maps.dem.spacing:.3g} m"),
        ("Control is good to", f"{plan:g} m in plan, {height:g} m in height"),
        ("Description", spec.description),
    )


def _measured(run: Match) -> Section:
    """Return the report section on the measured points."""
    text = how_measured(run.setup.test.points, "camera and platform as they are known")
    return Section("Measured points", (text,), point_artefacts(run.ground, run.points))


def _images(run: Match) -> Section:
    """Return the report section on the images."""
    rows = {name: IMAGE(image) for name, image in run.ground.images.items()}
    caption = "Lines count from the first of the table of times, pixels from the one that sees farthest to the right."
    return Section("Images", (), (IMAGE.table("windows", "Images", caption, rows, label="line", digits=4),))


def _warnings(run: Match) -> tuple[str, ...]:
    """Return warnings on the search range and the accuracy of the datum."""
    found, reach = [], run.setup.test.points.reach
    for one in run.points.sorts.values():
        for name, line in one.lines.items():
            if one.kind == "map" and line.accepted.any() and np.max(np.abs(line.moved)) > _FAR * reach:
                found.append(f"points of {name} lie near the end of the reach; a larger `points.reach` may find more")
    if run.accuracy is None or run.accuracy < 0.0:
        found.append("how good the way of the maps' system to WGS 84 is, is not stated by its authority")
    elif run.accuracy > 0.1:
        found.append(f"the way of the maps' system to WGS 84 is good to {run.accuracy:g} m only")
    return tuple(found)
