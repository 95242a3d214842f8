"""What the report of an intersection-angle test says, section by section."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.units import ARCSEC
from twin.orbit.angle.angle_plots import figure_svg, panels, signs
from twin.orbit.angle.angle_run import Scatter, SimulatedAngleRun, values_of
from twin.orbit.flight.light_effects import SPEED_OF_LIGHT
from twin.run.artefact import Cell, SvgFigure, Table, fixed
from twin.run.report import Section


def sections(run: SimulatedAngleRun) -> tuple[Section, ...]:
    """Geometry, change, methods, frames, effects on the light, sensitivity."""
    return _geometry(run), _change(run), _sections_scatter(run), _frames(run), _effects(run), _sensitivity(run)


def listed(words: Sequence[str]) -> str:
    """`a, b and c`."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def _geometry(run: SimulatedAngleRun) -> Section:
    flight, names = run.flight, signs(run.names)
    apart = (values_of(flight.look) - values_of(flight.dihedral)) / ARCSEC
    between = [f"{n} between {a} and {b}" for n, (a, b) in zip(names, flight.pairs.values(), strict=True)]
    text = [
        "At one moment the station O and the ground points that one line sees lie in a plane. The angles between these "
        f"planes (Liu and Huang, 2014, eqs. 6 and 7): {listed(between)}.".replace("_", " "),
        "The planes give dihedral angles. The angles between the lines of sight of the lines' centres differ from them "
        f"by {listed([f'{fixed(v, 4)} arcsec' for v in apart])} for this camera, because its lines are not quite "
        "parallel and do not begin at one place across the track. Heights are made by their part along the track.",
    ]
    if any(np.any(v) for v in run.measurement.offset.values()):
        text.append(
            "The cameras' projection centres stand metres apart on the satellite and their lines are seen bent, by "
            f"{_bow(run):.1f} arcsec at the ends. The analysis takes both from the laboratory: the attitude that the "
            "resection finds moves the points to where they would lie for one centre. The plane of a bent line depends "
            "on where the points lie, by a thousandth of an arcsecond; the line of sight of its centre does not."
        )
    heights = [f"{v:.2f} m for {signs([n])[0]}" for n, v in run.height.items() if v is not None]
    if heights:
        text.append(
            f"An angle that is wrong by 1 arcsec moves intersected heights by {listed(heights)}: the true line turned "
            "by 1 arcsec and its ray intersected with the other line's on the ground."
        )
    figure = SvgFigure(
        "geometry", "Planes and strips", "In the orbital frame at the station.", figure_svg("geometry", run)
    )
    return Section("Geometry", tuple(text), (figure,))


def _bow(run: SimulatedAngleRun) -> float:
    return max(float(np.max(np.linalg.norm(bow, axis=1))) for bow in run.measurement.bow.values()) / ARCSEC


def _change(run: SimulatedAngleRun) -> Section:
    flight, measured = run.flight, run.change / ARCSEC
    true = (values_of(flight.look) - values_of(flight.laboratory_look)) / ARCSEC
    sigma = run.estimate.along.sigma / ARCSEC
    rows: list[tuple[Cell, ...]] = []
    for k, name in enumerate(run.names):
        traced = flight.trace.get(name)
        trace = float(traced / ARCSEC) if traced is not None else None
        rows.append((signs([name])[0], float(measured[k]), float(sigma[k]), float(true[k]), trace))
    table = Table(
        "change",
        "Change of the angles between the lines of sight",
        "Ground: found from the ground points, minus the laboratory's angle. True: of the lines that the points were "
        "made with. Trace: the same change by chief rays of the instrument's truth, which knows neither orbit nor "
        "ground; only for the two cameras of a pair.",
        ("angle", "ground [arcsec]", "σ [arcsec]", "true [arcsec]", "trace [arcsec]"),
        rows,
        (None, 3, 3, 4, 4),
    )
    text = "The laboratory measured every line before launch. What has changed since is what the ground is asked for."
    return Section("Since the laboratory", (text,), (table,))


def _sections_scatter(run: SimulatedAngleRun) -> Section:
    rows: list[tuple[Cell, ...]] = []
    names = signs(run.names)
    cases = (("planes, tls", run.planes), ("planes, along track", run.along), ("resection", run.resection))
    for name, scatter in cases:
        for k, sign in enumerate(names):
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
        "Dihedral angle of tls planes minus the size of the resection's angle; below 5° the signed angles along the "
        "track. The spread is that of the difference over the passes.",
        ("angle", "difference [arcsec]", "spread [arcsec]"),
        [(sign, float(difference[k]), float(spread[k])) for k, sign in enumerate(names)],
        (None, 3, 3),
    )
    text = (
        "Both methods use the same station and points. The resection also uses where on its line a point lies and one "
        "attitude for all lines, which the laboratory's interior orientation must then be right for; the planes "
        "use neither. Most of the error of an angle is common to both, so that their difference scatters less than "
        "either.",
    )
    figure = SvgFigure(
        "scatter-passes",
        "Angles of all passes",
        _shared(run),
        figure_svg("scatter", run),
    )
    return Section("Planes and resection", text, (both, table, figure))


def _shared(run: SimulatedAngleRun) -> str:
    if len(run.names) == 1:
        return "Beside the normal distribution of the claimed sigma."
    first, second = signs(run.names)[:2]
    remark = "Angles share the station, and where they have a line in common its plane."
    return remark if len(run.names) == 2 else f"{first} and {second}; the table has the others. {remark}"


def _scatter_row(scatter: Scatter, k: int) -> tuple[float, ...]:
    spread = float(scatter.spread[k] / ARCSEC)
    mean = spread / np.sqrt(len(scatter.values))
    values = (scatter.bias[k] / ARCSEC, mean, spread, scatter.sigma[k] / ARCSEC, scatter.tail[k])
    return tuple(float(v) for v in values)


def _frames(run: SimulatedAngleRun) -> Section:
    reference = run.estimate.angles["tls"].values
    rows: list[tuple[Cell, ...]] = []
    for row in run.frames:
        off = (row.values - reference) / ARCSEC
        cells = [float(v) if np.isfinite(v) else None for v in off]
        remark = "biased, and says so" if row.warned else ""
        rows.append((row.frame, row.method, *cells, row.steepest, remark if np.all(np.isfinite(off)) else "singular"))
    worst = max(
        (float(np.max(np.abs(r.values - reference))) for r in run.frames if r.warned and np.all(np.isfinite(r.values))),
        default=0.0,
    )
    spread = max(float(np.max(np.abs(r.values - reference))) for r in run.frames if r.method == "tls")
    text = [
        "z = a0 x + a1 y + a2 has no vertical planes. In a level or an orbital frame the plane of a line that looks "
        "down is nearly vertical: x and y of its points lie on one line, eq. 5 is nearly singular, and noise flattens "
        "the slopes the more, the smaller the normal's z. In the frame of such a line itself the plane is vertical and "
        "noise alone "
        f"decides: the printed form {_failure(worst)}. Total least squares does not depend on the frame: "
        f"its angles agree to {spread / ARCSEC:.1g} arcsec.",
        "Eq. 5 of Liu and Huang has the wrong sign on its right side. Both slopes of every plane then come out "
        "negated, which is one half turn of all planes about the frame's z axis: the angles are right, the planes are "
        "not.",
    ]
    table = Table(
        "frames",
        "The three forms in four frames",
        "Angles minus those of total least squares in the Earth-fixed frame; the smallest z component of the three "
        "unit normals, 0 for a vertical plane.",
        ("frame", "form", *_heads(run), "least |normal z|", "warning"),
        rows,
        (None, None, *[6] * len(run.names), 6, None),
    )
    return Section("Forms of the plane and frames", tuple(text), (table,))


def _heads(run: SimulatedAngleRun) -> list[str]:
    return [f"{name} [arcsec]" for name in signs(run.names)]


def _failure(worst: float) -> str:
    if worst == 0.0:
        return "finds no plane at all"
    size = f"{np.degrees(worst):.3g}°" if worst > np.radians(0.1) else f"{worst / ARCSEC:.3g} arcsec"
    return f"misses by up to {size}"


def _effects(run: SimulatedAngleRun) -> Section:
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
        ("effect", *_heads(run), *(f"{name} corrected" for name in signs(run.names))),
        rows,
        (None, *[4] * len(run.names), *[6] * len(run.names)),
    )
    speed = float(np.linalg.norm(run.flight.velocity) / SPEED_OF_LIGHT / ARCSEC)
    text = (
        "Aberration tilts every line of sight toward the "
        f"flight direction by v/c = {speed:.1f} arcsec times the sine of its angle from it, so that a plane near the "
        "nadir turns more than others; refraction lets the inclined looks arrive nearer to the nadir.",
        "The corrections use the measured station, the velocity and the standard atmosphere, which here is also the "
        "true one: what is left shows that the correction is the inverse, not how well the atmosphere is known.",
    )
    return Section("Effects on the light", text, (table,))


def _sensitivity(run: SimulatedAngleRun) -> Section:
    figures = []
    for name in panels(run):
        moved = "The station" if name == "station" else f"Points, {signs([name.removesuffix('-points')])[0]}"
        caption = (
            "All planes move with the station." if name == "station" else "All points of one strip moved together."
        )
        figures.append(SvgFigure(f"sensitivity-{name}", moved, caption, figure_svg(name, run)))
    rows: list[tuple[Cell, ...]] = []
    for entry in (row.to_dict() for row in run.table):
        what = "station" if entry["what"] == "station" else f"{entry['what']} points".replace("_", " ")
        rows.append((what, entry["axis"], *(entry[f"{angle}_arcsec_per_10m"] for angle in run.names)))
    table = Table(
        "sensitivity",
        "Change of the angles for 10 m",
        "Linear derivative of the dihedral angles, Earth-fixed axes.",
        ("moved", "axis", *_heads(run)),
        rows,
        (None, None, *[4] * len(run.names)),
    )
    moving = (
        "The station, or all points of one strip, is moved by 0 to 10 m along one axis of the Earth-fixed frame. The "
        "ordinate is resection, which stays, minus planes."
    )
    straight = "The answer to 10 m is a straight line: second-order terms are of the size 10 m over 500 km."
    return Section("Errors of the station and of the points", (moving, straight), (*figures, table))
