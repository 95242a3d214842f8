"""What a report says of the intersection angle test."""

from __future__ import annotations

import numpy as np

from analysis.orbit.sensitivity import STATEMENTS, Judgement, judge
from twin.artefact import Cell, SvgFigure, Table
from twin.orbit.angle_analysis import ARCSEC, FRAMES, AngleRun, Scatter
from twin.orbit.angle_figure import drawn
from twin.orbit.angle_json import PRINTED_DIFFERENCE_ARCSEC
from twin.report.numbers import fixed
from twin.trial.section import Section


def sections(run: AngleRun) -> tuple[Section, ...]:
    """Geometry, methods, frames, effects on the light, sensitivity."""
    return _geometry(run), _scatter(run), _frames(run), _effects(run), _sensitivity(run)


def _geometry(run: AngleRun) -> Section:
    look = np.array(list(run.flight.look.values()))
    dihedral = np.array(list(run.flight.dihedral.values()))
    apart = (dihedral - look) / ARCSEC
    text = [
        "At one moment the station O and the ground points that one line sees lie in a plane. α is the angle between "
        "the forward and the nadir plane, β between the nadir and the aft plane (paper 000, Fig. 2, eqs. 6 and 7).",
        "The planes give dihedral angles. The angles between the lines of sight of the lines' centres, which make "
        f"heights, differ from them by {fixed(-apart[0], 4)}″ and {fixed(-apart[1], 4)}″ for this camera, because its "
        "lines are not quite parallel and do not begin at one place across the track.",
    ]
    heights = [f"{v:.2f} m for {n}" for n, v in run.height.items() if v is not None]
    if heights:
        text.append(
            f"An angle that is wrong by 1″ moves intersected heights by {' and '.join(heights)}: the true line turned "
            "by 1″ and its ray intersected with the nadir line's on the ground. The paper says more than 5 m."
        )
    figure = SvgFigure("geometry", "Planes and strips", "In the orbital frame at the station.", drawn("geometry", run))
    return Section("Geometry", tuple(text), (figure,))


def _scatter(run: AngleRun) -> Section:
    rows: list[tuple[Cell, ...]] = []
    for name, scatter in (("planes, tls", run.planes), ("resection", run.resection)):
        for k, sign in enumerate("αβ"):
            rows.append((name, sign, *_scatter_row(scatter, k)))
    difference, spread = run.difference / ARCSEC, run.difference_sigma / ARCSEC
    table = Table(
        "scatter",
        f"{len(run.planes.values)} passes with errors drawn anew",
        "Mean minus truth with the sigma of a mean; spread of the passes beside the sigma that the estimator claims, "
        "and the chance of a spread as far off if that sigma is right.",
        ("method", "angle", "mean − truth", "σ of the mean", "spread", "claimed σ", "chance"),
        rows,
        (None, None, 4, 4, 4, 4, 3),
    )
    both = Table(
        "difference",
        "Planes minus resection",
        "The spread is that of the difference over the passes. The paper prints the size of its one difference.",
        ("angle", "here, arcsec", "spread, arcsec", "paper 000, arcsec"),
        [
            (sign, float(difference[k]), float(spread[k]), printed)
            for k, (sign, printed) in enumerate(zip("αβ", PRINTED_DIFFERENCE_ARCSEC.values(), strict=True))
        ],
        (None, 3, 3, 2),
    )
    text = (
        "Both methods use the same station and points. The resection also uses where on its line a point lies and one "
        "attitude for all lines, which the laboratory's interior orientation must then be right for; the planes "
        "use neither. Most of the error of an angle is common to both, so that their difference scatters less than "
        "either. Errors of the points and of the station as they are drawn here do not make a difference as large as "
        "the paper's; what the two methods assume can, and so can eq. 5 in an unfit frame (below).",
    )
    figure = SvgFigure(
        "scatter-passes",
        "Angles of all passes",
        "α and β share the nadir plane and the station.",
        drawn("scatter", run),
    )
    return Section("Planes and resection", text, (both, table, figure))


def _scatter_row(scatter: Scatter, k: int) -> tuple[float, ...]:
    spread = float(scatter.spread[k] / ARCSEC)
    mean = spread / np.sqrt(len(scatter.values))
    values = (scatter.bias[k] / ARCSEC, mean, spread, scatter.sigma[k] / ARCSEC, scatter.tail[k])
    return tuple(float(v) for v in values)


def _frames(run: AngleRun) -> Section:
    reference = run.estimate.angles["tls"].values
    rows: list[tuple[Cell, ...]] = []
    for row in run.frames:
        off = (row.values - reference) / ARCSEC
        cells = [float(v) if np.isfinite(v) else None for v in off]
        said = "biased, and says so" if row.warned else ""
        rows.append((row.frame, row.method, *cells, row.steepest, said if np.all(np.isfinite(off)) else "singular"))
    worst = max(
        (float(np.max(np.abs(r.values - reference))) for r in run.frames if r.warned and np.all(np.isfinite(r.values))),
        default=0.0,
    )
    spread = max(float(np.max(np.abs(r.values - reference))) for r in run.frames if r.method == "tls")
    text = [
        "z = a0 x + a1 y + a2 has no vertical planes. In a level or an orbital frame the nadir plane is nearly "
        "vertical: x and y of its points lie on one line, eq. 5 is nearly singular, and noise flattens the slopes the "
        "more, the smaller the normal's z. In the frame of the nadir line itself the plane is vertical and noise alone "
        f"decides: the printed form {_failure(worst)}. Total least squares does not depend on the frame: "
        f"its angles agree to {spread / ARCSEC:.1g}″.",
        "Eq. 5 is printed with the wrong sign on its right side. Both slopes of every plane then come out negated, "
        "which is one half turn of all planes about the frame's z axis: the angles are right, the planes are not.",
    ]
    table = Table(
        "frames",
        f"The three forms in the frames: {', '.join(FRAMES)}",
        "α and β minus those of total least squares in the Earth-fixed frame; the smallest z component of the three "
        "unit normals, 0 for a vertical plane.",
        ("frame", "form", "α, arcsec", "β, arcsec", "least |normal z|", "warning"),
        rows,
        (None, None, 6, 6, 6, None),
    )
    return Section("Forms of the plane and frames", tuple(text), (table,))


def _failure(worst: float) -> str:
    if worst == 0.0:
        return "finds no plane at all"
    size = f"{np.degrees(worst):.3g}°" if worst > np.radians(0.1) else f"{worst / ARCSEC:.3g}″"
    return f"misses by up to {size}"


def _effects(run: AngleRun) -> Section:
    names = {
        "light_time": "light time",
        "aberration": "aberration",
        "refraction": "refraction",
        "all": "all three",
        "datum": "shift of all points",
    }
    rows: list[tuple[Cell, ...]] = []
    for row in run.effects:
        left = [float(v / ARCSEC) if np.isfinite(v) else None for v in row.left]
        rows.append((names[row.what], *(float(v / ARCSEC) for v in row.bias), *left))
    table = Table(
        "effects",
        "Bias of the planes, without noise",
        "Total least squares minus the true dihedral angle: with the effect left in the points, and after the analysis "
        "has moved the points to where the lines of sight lead without it.",
        ("effect", "α, arcsec", "β, arcsec", "α corrected", "β corrected"),
        rows,
        (None, 4, 4, 6, 6),
    )
    text = (
        "The paper does not speak of what happens to the light. Aberration tilts every line of sight toward the "
        "flight direction by v/c = 5.2″ times the sine of its angle from it, so that the nadir plane turns more than "
        "the others; refraction lets the inclined looks arrive nearer to the nadir. α and β change oppositely by the "
        "first and alike by the second, half an arcsecond each.",
        "The corrections use the measured station, the velocity and the standard atmosphere, which here is also the "
        "true one: what is left shows that the correction is the inverse, not how well the atmosphere is known.",
    )
    return Section("Effects on the light", text, (table,))


def _sensitivity(run: AngleRun) -> Section:
    figures = tuple(
        SvgFigure(f"sensitivity-{name}", f"As Fig. {number} of the paper", caption, drawn(name, run))
        for name, number, caption in (
            ("station", 3, "All three planes move with the station."),
            ("alpha-points", 4, "All points of one strip moved together."),
            ("beta-points", 5, "All points of one strip moved together."),
        )
    )
    rows: list[tuple[Cell, ...]] = []
    for entry in (row.to_dict() for row in run.table):
        what = "station" if entry["what"] == "station" else f"{entry['what']} points"
        rows.append((what, entry["axis"], entry["alpha_arcsec_per_10m"], entry["beta_arcsec_per_10m"]))
    table = Table(
        "sensitivity",
        "Change of the angles for 10 m",
        "Linear derivative, Earth-fixed axes.",
        ("moved", "axis", "α, arcsec", "β, arcsec"),
        rows,
        (None, None, 4, 4),
    )
    found = [judge(statement, run.table) for statement in STATEMENTS]
    held = sum(j.holds for j in found)
    sentences = Table(
        "statements",
        "The paper's sentences on its figures",
        "Numbers: arcsec per 10 m along each axis, or the relative growth of the slope from 0 to 10 m. Far more: at "
        "least twice. Alike: within a quarter. Little: at most a quarter of the largest.",
        ("figure", "sentence", "holds", "x", "y", "z"),
        [_statement(j) for j in found],
        (None, None, None, 4, 4, 4),
    )
    text = (
        "The station, or all points of one strip, is moved by 0 to 10 m along one axis of the Earth-fixed frame. The "
        "ordinate is the paper's: resection, which stays, minus planes.",
        f"{held} of {len(found)} sentences hold on this pass. The answer to 10 m is a straight line: second-order "
        "terms are of the size 10 m over 500 km.",
    )
    return Section("Errors of the station and of the points", text, (*figures, table, sentences))


def _statement(judgement: Judgement) -> tuple[Cell, ...]:
    numbers = (judgement.numbers.get(axis) for axis in "xyz")
    cells = [float(v) if v is not None and np.isfinite(v) else None for v in numbers]
    return judgement.statement.figure, judgement.statement.text, "yes" if judgement.holds else "no", *cells
