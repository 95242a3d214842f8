"""What a report says of points that a calibration has measured in images."""

from __future__ import annotations

from typing import Any

import numpy as np

from twin.artefact import Cell, PngFigure, Table
from twin.orbit.calibration.campaign import Campaign
from twin.orbit.calibration.images import BEYOND, FieldImages
from twin.orbit.images.point_judgement import WRONG_FLOOR, WRONG_PIXELS, WRONG_SIGMAS, LineJudgement
from twin.orbit.images.point_sections import drawn_points
from twin.trial.section import Section

_SORTS = {"control": "orthophoto", "tie": "tie"}


def images_section(campaign: Campaign) -> Section:
    """How many points were matched, lost and wrong, by field, sort and line."""
    assert campaign.images is not None
    assert campaign.spec.images is not None
    spec = campaign.spec.images
    total = image_totals(campaign)
    matching = _matching(campaign.images)
    rows: list[tuple[Cell, ...]] = []
    for one in campaign.images:
        s = one.screening
        assert s is not None
        rows.append(
            (
                one.name,
                s.entered,
                s.wrong_entered,
                s.entered - s.left,
                s.right_lost,
                s.wrong_left,
                s.check_entered,
                s.check_left,
                s.wrong_check_left,
            )
        )
    screened = Table(
        "image-points",
        "Image points in the adjustment",
        "Of points that every line has. Rejected: robust weight zero (IGG), for check points rays that do not meet.",
        (
            "field",
            "entered",
            "wrong",
            "rejected",
            "right rejected",
            "wrong left",
            "check points",
            "check left",
            "wrong left",
        ),
        rows,
    )
    counts = [len(p.control_ground[p.control.control]) for p in campaign.passes]
    text = (
        f"In each field {len(spec.patches)} patches of {spec.lines} x {spec.pixels} pixels are rendered by every line. "
        f"Of {total['found']} places that matching found, {total['wrong_found']} are wrong "
        f"({100.0 * total['wrong_found'] / total['found']:.1f}%), mostly on fields that look different in the "
        f"orthophoto; thresholds of the matching leave {total['wrong_matched']} of {total['matched']}, the "
        f"neighbours' agreement {total['wrong_accepted']} of {total['accepted']}, the adjustment "
        f"{total['wrong_left']} of {total['left']} image points ({total['check_left']} check points: "
        f"{total['wrong_check_left']}). The neighbours' test costs {total['right_rejected_by_consensus']} right ones, "
        f"the adjustment {total['right_rejected_by_adjustment']}.",
        f"{' and '.join(str(c) for c in counts)} control points are left. Their image points weigh by the covariances "
        f"of the matching and {BEYOND:g} px beyond them, for what no fit shows. Matches of the three "
        "lines with one piece of the orthophoto err alike, by its noise and its "
        "other light; that moves the adjusted point and hardly shows in residuals, so that the fit looks better than "
        "its sigmas. The orthophoto's error in plan is nearly one for all points of a patch: each of n points has been "
        "given n times its variance, so that the patch counts once. A shift that the whole orthophoto shares is a "
        "wrong datum and goes into the biases; no sigma contains it.",
    )
    first = campaign.images[0]
    figures = [
        PngFigure(
            f"points-{sort}",
            f"From predicted to found, {_SORTS[sort]} points, first patch of {first.name}",
            "Arrows: what is left after the median displacement, enlarged as the title says; crosses: rejected by the "
            "neighbours; points: not matched.",
            drawn_points(first.shown, points),
        )
        for sort, points in first.patches[0].points.sorts.items()
    ]
    return Section("Points in images", text, (matching, screened, *figures))


def image_totals(campaign: Campaign) -> dict[str, int]:
    """Counts over all fields and lines; wrong by truth."""
    assert campaign.images is not None
    every = [j for one in campaign.images for _, j in _judgements(one)]
    names = ("found", "matched", "accepted", "wrong_found", "wrong_matched", "wrong_accepted")
    out = {name: sum(getattr(j, name) for j in every) for name in names}
    out["right_rejected_by_consensus"] = sum(j.good_lost for j in every)
    screenings = [one.screening for one in campaign.images if one.screening is not None]
    more = ("entered", "left", "wrong_entered", "wrong_left", "check_entered", "check_left", "wrong_check_left")
    out |= {name: sum(getattr(s, name) for s in screenings) for name in more}
    out["right_rejected_by_adjustment"] = sum(s.right_lost for s in screenings)
    return out


def images_data(campaign: Campaign) -> dict[str, Any] | None:
    """The numbers as plain data; None for drawn points."""
    if campaign.images is None:
        return None
    fields: dict[str, Any] = {}
    for one in campaign.images:
        fields[one.name] = {
            sort: {line: _numbers(parts) for line, parts in lines.items()} for sort, lines in _by_line(one).items()
        }
    return {"total": image_totals(campaign), "fields": fields}


def _matching(images: tuple[FieldImages, ...]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for one in images:
        for sort, lines in _by_line(one).items():
            for line, parts in lines.items():
                n = _numbers(parts)
                wrong = (f"{n[f'wrong_{stage}']} of {n[stage]}" for stage in ("found", "matched", "accepted"))
                cells = (n["right_rejected_by_consensus"], n["rms_lines_px"], n["rms_pixels_px"], n["chi_square_ratio"])
                rows.append((one.name, _SORTS[sort], line, *wrong, *cells))
    return Table(
        "image-matching",
        "Matching",
        f"Wrong: more than {WRONG_PIXELS:g} px off, or more than {WRONG_SIGMAS:g} sigmas and {WRONG_FLOOR:g} px; "
        "before any test, after the thresholds of matching, after consensus. RMS along the track and the line, px, and "
        "chi-square of the errors over degrees of freedom, of right places.",
        (
            "field",
            "points",
            "line",
            "wrong before",
            "after matching",
            "after consensus",
            "right lost",
            "RMS track",
            "RMS line",
            "χ²/dof",
        ),
        rows,
        (None, None, None, None, None, None, None, 3, 3, 2),
    )


def _judgements(one: FieldImages) -> list[tuple[tuple[str, str], LineJudgement]]:
    return [
        ((sort, line), j)
        for patch in one.patches
        for sort, lines in patch.judgements.items()
        for line, j in lines.items()
    ]


def _by_line(one: FieldImages) -> dict[str, dict[str, list[LineJudgement]]]:
    out: dict[str, dict[str, list[LineJudgement]]] = {}
    for (sort, line), j in _judgements(one):
        out.setdefault(sort, {}).setdefault(line, []).append(j)
    return out


def _numbers(parts: list[LineJudgement]) -> dict[str, Any]:
    names = ("found", "matched", "accepted", "wrong_found", "wrong_matched", "wrong_accepted")
    out: dict[str, Any] = {name: sum(getattr(j, name) for j in parts) for name in names}
    out["right_rejected_by_consensus"] = sum(j.good_lost for j in parts)
    degrees = np.array([j.degrees_of_freedom for j in parts])
    square = np.sum([np.nan_to_num(j.rms) ** 2 * n for j, n in zip(parts, degrees, strict=True)], axis=0)
    rms = np.sqrt(square / max(degrees.sum(), 1))
    out |= {"rms_lines_px": float(rms[0]), "rms_pixels_px": float(rms[1])}
    out["chi_square_ratio"] = float(sum(j.chi_square for j in parts) / max(degrees.sum(), 1))
    return out
