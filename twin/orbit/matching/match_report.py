"""Report of points measured in a user's images: verdict, facts, counts and warnings."""

from __future__ import annotations

import numpy as np

from twin.framework.report import Report, Section, answer
from twin.orbit.images.simulate_report import found_table, how_measured, point_artefacts
from twin.orbit.matching.match_run import IMAGE, Match
from twin.orbit.matching.rational_match import RationalMatch, rational_report

_FAR = 0.5
"""Share of the search range above which a median displacement is reported as too near the limit of the search."""


def match_report(run: Match | RationalMatch) -> Report:
    """Return the report of points measured in a user's images: verdict, counts, accuracy and warnings."""
    if isinstance(run, RationalMatch):
        return rational_report(run)
    return Report(
        "Points measured in images",
        *_verdict(run),
        _facts(run),
        found_table(run.points),
        (_measured(run), _images(run)),
        warnings=_warnings(run),
    )


def _verdict(run: Match) -> tuple[str, tuple[str, ...]]:
    """Return the verdict of the measurement, and the sentences that follow it in the report."""
    role = run.measurements.ground.role
    counts = [f"{int(np.sum(role == name))} {name}" for name in ("control", "check", "tie") if np.any(role == name)]
    displacements = [
        (float(np.linalg.norm(line.median_shift)), name)
        for group in run.points.sorts.values()
        for name, line in group.lines.items()
        if group.kind == "map" and line.accepted.any()
    ]
    far = ""
    if displacements:
        displacement, name = max(displacements)
        far = f"the largest displacement from the prediction by camera and platform is {displacement:.1f} px, in {name}"
    shares = [
        (float(line.accepted.mean()), name) for group in run.points.sorts.values() for name, line in group.lines.items()
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
        ("Accuracy of the control", f"{plan:g} m in plan, {height:g} m in height"),
        ("Description", spec.description),
    )


def _measured(run: Match) -> Section:
    """Return the report section on the measured points: counts, displacements and figures."""
    text = how_measured(run.setup.test.points, "the laboratory's camera on the measured platform")
    return Section("Measured points", (text,), point_artefacts(run.ground, run.points))


def _images(run: Match) -> Section:
    """Return the report section on the images: size, ground sample distance and position."""
    rows = {name: IMAGE(image) for name, image in run.ground.images.items()}
    caption = "Lines count from the first in the table of times, pixels from the one that looks farthest to the right."
    return Section("Images", (), (IMAGE.table("windows", "Images", caption, rows, label="line", digits=4),))


def _warnings(run: Match) -> tuple[str, ...]:
    """Return warnings on displacements near the search range and on the accuracy of the maps' datum."""
    texts, reach = [], run.setup.test.points.reach
    for group in run.points.sorts.values():
        for name, line in group.lines.items():
            if group.kind == "map" and line.accepted.any() and np.max(np.abs(line.median_shift)) > _FAR * reach:
                texts.append(f"points of {name} lie near the search limit; a larger `points.reach` may find more")
    if run.accuracy is None or run.accuracy < 0.0:
        texts.append("the accuracy of the datum transformation of the maps to WGS 84 is not stated by its authority")
    elif run.accuracy > 0.1:
        texts.append(f"the datum transformation of the maps to WGS 84 is accurate to {run.accuracy:g} m only")
    return tuple(texts)
