"""What the report of an intersection-angle test says, section by section, with its figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.arrays import ARCSEC
from analysis.orbit.planes import AXES
from twin.orbit.angle.angle_run import Scatter, SimulatedAngleRun, values_of
from twin.orbit.flight.light_effects import SPEED_OF_LIGHT
from twin.run import svg
from twin.run.artefact import Cell, SvgFigure, Table, fixed
from twin.run.report import Section

_GREEK = {"alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ"}


def signs(names: Iterable[str]) -> list[str]:
    """Angles' names as a report writes them."""
    return [_GREEK.get(name, name.replace("_", " ")) for name in names]


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
    drawing = _drawn("geometry", _geometry_figure, run)
    figure = SvgFigure("geometry", "Planes and strips", "In the orbital frame at the station.", drawing)
    return Section("Geometry", tuple(text), (figure,))


def _bow(run: SimulatedAngleRun) -> float:
    return max(float(np.max(np.linalg.norm(bow, axis=1))) for bow in run.measurement.bow.values()) / ARCSEC


def _change(run: SimulatedAngleRun) -> Section:
    flight, measured = run.flight, run.change / ARCSEC
    true = (values_of(flight.look) - values_of(flight.before_launch.look)) / ARCSEC
    sigma = run.estimate.along.sigma / ARCSEC
    trace = [flight.trace[name] / ARCSEC if name in flight.trace else None for name in run.names]
    columns: list[list[Any]] = [signs(run.names), measured.tolist(), sigma.tolist(), true.tolist(), trace]
    table = Table(
        "change",
        "Change of the angles between the lines of sight",
        "Ground: found from the ground points, minus the laboratory's angle. True: of the lines that the points were "
        "made with. Trace: the same change by chief rays of the instrument's truth, which knows neither orbit nor "
        "ground; only for the two cameras of a pair.",
        ("angle", "ground [arcsec]", "σ [arcsec]", "true [arcsec]", "trace [arcsec]"),
        list(zip(*columns, strict=True)),
        (None, 3, 3, 4, 4),
    )
    text = "The laboratory measured every line before launch. What has changed since is what the ground is asked for."
    return Section("Since the laboratory", (text,), (table,))


def _sections_scatter(run: SimulatedAngleRun) -> Section:
    names = signs(run.names)
    cases = (("planes, tls", run.planes), ("planes, along track", run.along), ("resection", run.resection))
    rows: list[list[Cell]] = [
        [name, sign, *row] for name, scatter in cases for sign, row in zip(names, _rows(scatter), strict=True)
    ]
    difference, spread = (v.tolist() for v in (run.difference / ARCSEC, run.difference_sigma / ARCSEC))
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
        list(zip(names, difference, spread, strict=True)),
        (None, 3, 3),
    )
    text = (
        "Both methods use the same station and points. The resection also uses where on its line a point lies and one "
        "attitude for all lines, which the laboratory's interior orientation must then be right for; the planes "
        "use neither. Most of the error of an angle is common to both, so that their difference scatters less than "
        "either.",
    )
    figure = SvgFigure("scatter-passes", "Angles of all passes", _shared(run), _drawn("scatter", _scatter_figure, run))
    return Section("Planes and resection", text, (both, table, figure))


def _shared(run: SimulatedAngleRun) -> str:
    if len(run.names) == 1:
        return "Beside the normal distribution of the claimed sigma."
    first, second = signs(run.names)[:2]
    remark = "Angles share the station, and where they have a line in common its plane."
    return remark if len(run.names) == 2 else f"{first} and {second}; the table has the others. {remark}"


def _rows(scatter: Scatter) -> list[list[float]]:
    spread = scatter.spread / ARCSEC
    mean = spread / np.sqrt(len(scatter.values))
    columns = (scatter.bias / ARCSEC, mean, spread, scatter.sigma / ARCSEC, scatter.tail)
    return np.stack(columns, axis=-1).tolist()


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
    for name in _panels(run):
        moved = "The station" if name == "station" else f"Points, {signs([name.removesuffix('-points')])[0]}"
        caption = (
            "All planes move with the station." if name == "station" else "All points of one strip moved together."
        )
        drawing = _drawn(name, _sensitivity_figure, run, name)
        figures.append(SvgFigure(f"sensitivity-{name}", moved, caption, drawing))
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


COLOURS = (svg.BLUE, svg.GREEN, svg.VERMILION, svg.ORANGE, svg.PURPLE, svg.SKY)
AXIS_COLOURS = dict(zip(AXES, (svg.BLUE, svg.GREEN, svg.VERMILION), strict=True))


_LEAST_ARC = np.radians(5.0)
"""Smaller angles are not marked in the picture, where their lines are one."""


def _drawn(name: str, draw: Callable[..., Figure], *given: Any) -> str:
    """A figure as SVG."""
    with svg.look(f"angle-{name}"):
        return svg.to_svg(draw(*given))


def _panels(run: SimulatedAngleRun) -> dict[str, list[tuple[str, str]]]:
    """Figure of the sensitivity -> its panels: what is moved, and the angle."""
    pairs = run.flight.pairs
    out = {"station": [("station", name) for name in pairs]}
    out.update({f"{name}-points": [(line, name) for line in pair] for name, pair in pairs.items()})
    return out


def _geometry_figure(run: SimulatedAngleRun) -> Figure:
    """Station, planes and strips, seen from the side (along the lines) and from above; orbital axes."""
    flight = run.flight
    figure = svg.new_figure(4.6)
    side, above = figure.subplots(1, 2)
    for k, name in enumerate(flight.lines):
        arm = (run.measurement.strips[name].points - flight.station) @ flight.orbital.T / 1e3
        colour = COLOURS[k % len(COLOURS)]
        middle = arm[len(arm) // 2]
        side.plot([0.0, middle[0]], [0.0, middle[2]], color=colour, lw=1.3)
        side.plot(arm[:, 0], arm[:, 2], ".", color=colour, ms=4)
        above.fill([0.0, arm[0, 0], arm[-1, 0]], [0.0, arm[0, 1], arm[-1, 1]], color=colour, alpha=0.12, lw=0)
        above.plot(arm[:, 0], arm[:, 1], ".", color=colour, ms=3, label=f"{name.replace('_', ' ')}")
    for axes in (side, above):
        axes.plot(0.0, 0.0, "o", color=svg.INK, ms=5)
        axes.set_xlabel("X, forward [km]")
    side.annotate("O", (0.0, 0.0), (8, 2), textcoords="offset points")
    pitch = {
        name: float(np.arctan2(*(c.look(np.array([0.5 * (c.pixels - 1)]))[0, [0, 2]])))
        for name, c in flight.cameras.items()
    }
    for sign, (a, b) in zip(signs(flight.pairs), flight.pairs.values(), strict=True):
        turn = np.linspace(pitch[b], pitch[a], 40)
        if abs(turn[-1] - turn[0]) < _LEAST_ARC:
            continue
        side.plot(150.0 * np.sin(turn), 150.0 * np.cos(turn), color=svg.GREY, lw=0.8)
        half = turn[20]
        side.text(185.0 * np.sin(half), 185.0 * np.cos(half), sign, ha="center", va="center")
    side.invert_yaxis()
    side.set_aspect("equal")
    points = len(run.measurement.strips[flight.lines[0]].points)
    side.set(title="From the side: the planes on edge", ylabel="Z, down [km]")
    above.set(title=f"From above: strips of {points} points, Y stretched", ylabel="Y, right [km]")
    above.legend(loc="upper center", ncols=3, markerscale=2.0)
    above.margins(y=0.35)
    _finish(side, above)
    return figure


def _sensitivity_figure(run: SimulatedAngleRun, name: str) -> Figure:
    """Difference of the angles, resection minus planes, over a move of 0 to 10 m, per axis."""
    rows = {(row.what, row.axis): row for row in run.table}
    shows = _panels(run)[name]
    wide = min(len(shows), 2)
    high = (len(shows) + 1) // 2
    figure = svg.new_figure(3.2 * high)
    grid = figure.subplots(high, wide, sharey=True, squeeze=False)
    for axes in grid.ravel()[len(shows) :]:
        axes.set_axis_off()
    for axes, (what, angle) in zip(grid.ravel(), shows, strict=False):
        k = run.names.index(angle)
        for axis in AXES:
            row = rows[what, axis]
            shown = (-run.difference[k] - row.change[k]) / ARCSEC
            axes.plot(row.amount, shown, "o-", color=AXIS_COLOURS[axis], ms=3, lw=1.2, label=axis)
        thing = "station" if what == "station" else f"{what.replace('_', ' ')} points"
        axes.set(title=f"{signs([angle])[0]} over the error of the {thing}", xlabel="m")
        axes.legend(loc="best", ncols=3)
        _finish(axes)
    for axes in grid[:, 0]:
        axes.set_ylabel("resection − planes [arcsec]")
    return figure


def _scatter_figure(run: SimulatedAngleRun) -> Figure:
    """Angles of all passes about the truth, with what the claimed covariance says: of the first two angles the 95%
    ellipse, of a single one the normal distribution.
    """
    figure = svg.new_figure(4.4 if len(run.names) > 1 else 3.2)
    grid = figure.subplots(1, 2, sharex=True, sharey=True)
    cases = (("Planes, total least squares", run.planes), ("Resection", run.resection))
    names = signs(run.names)
    for axes, (title, scatter) in zip(grid, cases, strict=True):
        off = (scatter.values - scatter.truth) / ARCSEC
        axes.set(title=title, xlabel=f"{names[0]} − truth [arcsec]")
        if len(names) > 1:
            axes.plot(off[:, 0], off[:, 1], ".", color=svg.BLUE, ms=4, label=f"{len(off)} passes")
            axes.plot(*_ellipse(scatter).T, color=svg.VERMILION, lw=1.2, label="95% by propagation")
            axes.plot(0.0, 0.0, "+", color=svg.INK, ms=9)
            axes.set_aspect("equal")
        else:
            sigma = float(scatter.sigma[0] / ARCSEC)
            place = np.linspace(-4.0, 4.0, 161) * sigma
            bins = np.linspace(-4.0, 4.0, 25) * sigma
            axes.hist(off[:, 0], bins=bins, density=True, color=svg.SKY, label=f"{len(off)} passes")
            bell = np.exp(-0.5 * (place / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
            axes.plot(place, bell, color=svg.VERMILION, lw=1.2, label="by propagation")
        axes.legend(loc="upper right")
    grid[0].set_ylabel(f"{names[1]} − truth [arcsec]" if len(names) > 1 else "share of passes per arcsec")
    grid[0].margins(0.2 if len(names) > 1 else 0.05)
    _finish(*grid)
    return figure


def _ellipse(scatter: Scatter) -> np.ndarray:
    """(m, 2) of the first two angles, arcsec; chi-square of two degrees of freedom is 5.991 at 95%."""
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    root = np.linalg.cholesky(scatter.covariance[:2, :2]) / ARCSEC
    return np.asarray(np.sqrt(5.991) * np.stack([np.cos(turn), np.sin(turn)], axis=-1) @ root.T)


def _finish(*every: Axes) -> None:
    for axes in every:
        axes.grid(color=svg.LIGHT, lw=0.5)
        svg.plain_axes(axes)
