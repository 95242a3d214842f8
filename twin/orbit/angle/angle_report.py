"""Report of an intersection-angle test: against the laboratory, and of a simulated one also against the truth.

What the methods are, and why they differ, is in docs/orbit.md and docs/measured_orbit.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import chi2

from analysis.arrays import ARCSEC
from analysis.orbit.planes import AXES
from scenes.specs.orbit.setup import MeasuredAngleSetup
from scenes.specs.perturbation import in_words
from scenes.yaml.units import ANGLE, LENGTH, format_quantity
from twin.framework import svg
from twin.framework.artefact import FAR, Cell, SvgFigure, Table, fixed
from twin.framework.report import Report, Section, answer
from twin.orbit.angle.angle_run import UNLIKELY, AngleRun, PassAngles, Scatter, SimulatedAngleRun, values_of
from twin.orbit.flight.light_effects import SPEED_OF_LIGHT, LightEffects

METHOD_NAMES = {
    "printed": "planes, eq. 5 as printed",
    "corrected": "planes, eq. 5 with the right sign",
    "tls": "planes, total least squares",
}
"""Reports' name for each way to fit planes."""
EFFECT_NAMES = {"light_time": "light time", "all": "all three", "datum": "shift of all points"}
"""Reports' name for effects that are not called so."""
_FALSE_ALARM = 1e-4
"""Chance that a good set of points warns, for each plane."""
_GREEK = {"alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ"}
COLOURS = (svg.BLUE, svg.GREEN, svg.VERMILION, svg.ORANGE, svg.PURPLE, svg.SKY)
"""Lines in their order."""
_LEAST_ARC = np.radians(5.0)
"""Smallest angle whose arc is drawn in the geometry."""


def signs(names: Iterable[str]) -> list[str]:
    """Angles' names as a report writes them."""
    return [_GREEK.get(name, name.replace("_", " ")) for name in names]


def listed(words: Sequence[str]) -> str:
    """`a, b and c`."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def angle_report(run: AngleRun) -> Report:
    """Report of a simulated or a measured test."""
    first = run.passes[0]
    lead: tuple[str, ...] = ()
    along = first.estimate.along
    change = first.change / ARCSEC
    changed = [
        f"{name} has changed by {fixed(change[k], 2)} ± {along.sigma[k] / ARCSEC:.2f} arcsec"
        for k, name in enumerate(signs(first.pairs))
    ]
    found = ["the sigmas are those of points, image points and readings"]
    sections: tuple[Section, ...] = (_planes(run),)
    if isinstance(run, SimulatedAngleRun):
        found, lead = _found(run)
        sections += (_geometry(run), _change(run), _scatter(run), _frames(run), _effects(run), _sensitivity(run))
    verdict, more = answer(
        f"Since the laboratory {listed(changed)} along the track, measured from the ground points of {first.name}",
        *found,
    )
    return Report(
        "Intersection angles from ground points",
        verdict,
        (*more, *lead),
        _facts(run),
        _methods(run),
        sections,
        warnings=_warnings(run),
    )


def _found(run: SimulatedAngleRun) -> tuple[list[str], tuple[str, ...]]:
    """Angles against their truth, and planes against resection."""
    names, flight, few = signs(run.names), run.flight, run.narrow
    tls, along = run.estimate.angles["tls"], run.estimate.along
    truth = np.where(few, values_of(flight.along_track), values_of(flight.dihedral))
    found, sigma = np.where(few, along.values, tls.values), np.where(few, along.sigma, tls.sigma) / ARCSEC
    off, difference = (found - truth) / ARCSEC, run.difference / ARCSEC
    said, lead = [], []
    for which, by in ((np.flatnonzero(~few), "by planes"), (np.flatnonzero(few), "along the track, by planes")):
        if not len(which):
            continue
        said.append(
            f"{listed([f'{names[k]} = {np.degrees(found[k]):.6f}°' for k in which])} with "
            f"{'a sigma' if len(which) == 1 else 'sigmas'} of {listed([f'{sigma[k]:.2f} arcsec' for k in which])} "
            f"{by}, {listed([f'{fixed(off[k], 2)} arcsec' for k in which])} from the truth"
        )
        lead.append(f"Planes minus resection: {listed([f'{fixed(difference[k], 3)} arcsec' for k in which])}.")
    if flight.trace:
        (name, true), change = next(iter(flight.trace.items())), run.change / ARCSEC
        at = run.names.index(name)
        lead.append(
            f"Since the laboratory {names[at]} has changed by {fixed(change[at], 2)} ± "
            f"{along.sigma[at] / ARCSEC:.2f} arcsec as seen from the ground; the trace of the instrument gives "
            f"{fixed(true / ARCSEC, 3)} arcsec."
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        worst = float(np.nanmax(np.abs(off) / sigma)) if np.any(sigma > 0.0) else None
    if worst is not None:
        held = "all angles are within" if worst <= FAR else "not all angles are within"
        said.insert(0, f"{held} {FAR:g} σ of the truth, with a largest error of {worst:.1f} σ: see the methods")
    return said, tuple(lead)


def _facts(run: AngleRun) -> tuple[tuple[str, str], ...]:
    setup, test = run.setup, run.setup.test
    on = ", ".join(LightEffects.of(test.effects).names)
    state = f"{'' if test.effects.corrected else 'not '}corrected in the analysis"
    between = [f"{sign} between {a} and {b}" for sign, (a, b) in _named_pairs(run.passes[0])]
    if isinstance(setup, MeasuredAngleSetup):
        camera, tracker, gps = setup.camera, setup.test.errors.star_tracker, setup.test.errors.gps
        name, described = camera.name, camera.description
        own: tuple[tuple[str, str], ...] = (
            ("Passes", ", ".join(one.name for one in run.passes)),
            ("Moment, from the epoch", ", ".join(f"{one.name} {one.time:.4g} s" for one in run.passes)),
            ("Noise of the attitude, 1σ", ", ".join(format_quantity(v, ANGLE) for v in tracker.noise)),
            ("Noise of the orbit, 1σ", ", ".join(format_quantity(v, LENGTH) for v in gps.noise)),
        )
    else:
        name, described = setup.camera_name, (setup.camera or setup.instrument).description  # type: ignore[union-attr]
        simulated = setup.test
        strips, errors, passing = simulated.strips, simulated.errors, simulated.orbit.passing
        station, points, height, relief, *datum = (
            format_quantity(v, LENGTH)
            for v in (
                *(errors.station, errors.points, simulated.terrain.height, simulated.terrain.relief),
                *errors.datum,
            )
        )
        orbit = f"epoch {simulated.orbit.epoch}"
        if passing is not None:
            orbit = (
                f"{passing.direction} pass {passing.altitude / 1e3:g} km above "
                f"{np.degrees(passing.latitude):.4g}° N {np.degrees(passing.longitude):.4g}° E, {orbit}"
            )
        own = (
            ("Changed since the laboratory", in_words(simulated.perturb) or "nothing"),
            ("Orbit", orbit),
            ("Exposure", f"{simulated.time:g} s from the epoch"),
            ("Points", f"{strips.points} on each strip, pixels {strips.first:g} to {strips.last:g}"),
            ("Terrain", f"{height} ± {relief}"),
            ("Errors, σ of a coordinate", f"station {station}, points {points}"),
            ("Common shift of the points", f"{', '.join(datum)} east, north, up" if any(errors.datum) else "none"),
        )
    return (
        ("Camera", f"{name}, {described}"),
        ("Angles", "; ".join(between)),
        *own,
        ("Effects on the light", f"{on} {state}" if on else "none"),
        ("Description", test.description),
    )


def _named_pairs(one: PassAngles) -> Iterable[tuple[str, tuple[str, str]]]:
    return zip(signs(one.pairs), one.pairs.values(), strict=True)


def _methods(run: AngleRun) -> Table:
    flight = run.flight if isinstance(run, SimulatedAngleRun) else None
    truth = () if flight is None else tuple(values_of(a) for a in (flight.dihedral, flight.look, flight.along_track))
    rows: list[tuple[Cell, ...]] = []
    for one in run.passes:
        estimate, along, resected, lab = one.estimate, one.estimate.along, one.estimate.resected, one.laboratory
        known = tuple(values_of(angles) for angles in (lab.dihedral, lab.look, lab.along_track))
        for k, name in enumerate(signs(one.pairs)):
            # across the track the sigma of the look is another one
            mostly = abs(known[2][k]) > 0.99 * known[1][k]
            sighted = "lines of sight in the tls planes"
            kinds: list[tuple[str, str, np.ndarray, np.ndarray | None, int]] = [
                *(
                    (METHOD_NAMES[method], "dihedral" + " (folded)" * bool(a.folded[k]), a.values, a.sigma, 0)
                    for method, a in estimate.angles.items()
                ),
                (sighted, "look", estimate.look, along.sigma if mostly else None, 1),
                (sighted, "along track", along.values, along.sigma, 2),
                ("resection", "along track", resected.values, resected.sigma, 2),
            ]
            for method, kind, value, sigma, which in kinds:
                off = (float((value[k] - side[which][k]) / ARCSEC) for side in (known, truth) if side)
                spread = None if sigma is None else float(sigma[k] / ARCSEC)
                rows.append((one.name, name, method, kind, float(np.degrees(value[k])), spread, *off))
    heads = ("pass", "", "method", "angle", "deg", "σ [arcsec]", "− laboratory [arcsec]", "− truth [arcsec]")
    width = len(heads) - (not truth)
    return Table(
        "methods",
        "Angles by each method",
        "Dihedral: between the planes of the lines, fitted in the Earth-fixed frame. Look: between the lines of sight "
        "of the lines' centres. Along track: the look's signed part along the track, positive where the first line "
        "looks ahead of the second. Folded: below three sigmas, where noise pushes an unsigned angle up.",
        heads[:width],
        rows,
        (None, None, None, None, 7, 3, 3, 3)[:width],
    )


def _planes(run: AngleRun) -> Section:
    rows: list[tuple[Cell, ...]] = []
    for one in run.passes:
        for line, fit in zip(one.measurement.strips, one.estimate.planes["tls"], strict=True):
            freedom, away = len(fit.residual) - 2, float(np.sqrt(np.mean(fit.residual**2)))
            chance = float(chi2.sf(fit.chi_square, freedom)) if freedom > 0 else None
            ratio = fit.chi_square / max(freedom, 1)
            rows.append((one.name, line, len(fit.residual), *one.span[line], away, ratio, chance))
    table = Table(
        "planes",
        "Planes of the lines",
        "Through the station and the points of each line; when its points were seen, from the moment; RMS distance of "
        "the points from the plane; chi-square over its degrees of freedom and its chance.",
        ("pass", "line", "points", "from [s]", "to [s]", "RMS [m]", "χ²/dof", "chance"),
        rows,
        (None, None, None, 2, 2, 3, 2, 3),
    )
    return Section("Planes", (), (table,))


def _geometry(run: SimulatedAngleRun) -> Section:
    flight, offsets = run.flight, run.measurement.offset.values()
    apart = (values_of(flight.look) - values_of(flight.dihedral)) / ARCSEC
    text = [
        "The angles between the lines of sight of the lines' centres differ from the dihedral ones by "
        f"{listed([f'{fixed(v, 4)} arcsec' for v in apart])} for this camera."
    ]
    if any(np.any(v) for v in offsets):
        bow = max(float(np.max(np.linalg.norm(bow, axis=1))) for bow in run.measurement.bow.values()) / ARCSEC
        text.append(
            "The cameras' projection centres stand metres apart on the satellite and their lines are seen bent, by "
            f"{bow:.1f} arcsec at the ends. The analysis takes both from the laboratory."
        )
    heights = [f"{v:.2f} m for {signs([n])[0]}" for n, v in run.height.items() if v is not None]
    if heights:
        text.append(f"An angle that is wrong by 1 arcsec moves intersected heights by {listed(heights)}.")
    drawing = svg.drawn("angle-geometry", _geometry_figure, run)
    figure = SvgFigure("geometry", "Planes and strips", "In the orbital frame at the station.", drawing)
    return Section("Geometry", tuple(text), (figure,))


def _change(run: SimulatedAngleRun) -> Section:
    flight, arcsec = run.flight, [run.change, run.estimate.along.sigma]
    arcsec.append(values_of(flight.look) - values_of(flight.before_launch.look))
    trace = [flight.trace[name] / ARCSEC if name in flight.trace else None for name in run.names]
    table = Table(
        "change",
        "Change of the angles between the lines of sight",
        "Ground: found from the ground points, minus the laboratory's angle. True: of the lines that the points were "
        "made with. Trace: by chief rays of the instrument, only for the two cameras of a pair.",
        ("angle", "ground [arcsec]", "σ [arcsec]", "true [arcsec]", "trace [arcsec]"),
        list(zip(signs(run.names), *((v / ARCSEC).tolist() for v in arcsec), trace, strict=True)),
        (None, 3, 3, 4, 4),
    )
    return Section("Since the laboratory", (), (table,))


def _scatter(run: SimulatedAngleRun) -> Section:
    names = signs(run.names)
    cases = (("planes, tls", run.planes), ("planes, along track", run.along), ("resection", run.resection))
    rows: list[list[Cell]] = []
    for method, one in cases:
        of_mean = one.spread / np.sqrt(len(one.values))
        numbers = np.stack([v / ARCSEC for v in (one.bias, of_mean, one.spread, one.sigma)] + [one.tail], axis=-1)
        rows += [[method, sign, *row] for sign, row in zip(names, numbers.tolist(), strict=True)]
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
        list(zip(names, *((v / ARCSEC).tolist() for v in (run.difference, run.difference_sigma)), strict=True)),
        (None, 3, 3),
    )
    caption = "Beside the normal distribution of the claimed sigma."
    if len(names) > 1:
        caption = f"{names[0]} and {names[1]}; the table has all. Angles share the station and common lines' planes."
    drawing = svg.drawn("angle-scatter", _scatter_figure, run)
    figure = SvgFigure("scatter-passes", "Angles of all passes", caption, drawing)
    return Section("Planes and resection", (), (both, table, figure))


def _frames(run: SimulatedAngleRun) -> Section:
    reference = run.estimate.angles["tls"].values
    rows: list[tuple[Cell, ...]] = []
    worst = spread = 0.0
    for row in run.frames:
        off = (row.values - reference) / ARCSEC
        seen = bool(np.all(np.isfinite(off)))
        largest = float(np.max(np.abs(off)))
        worst = max(worst, largest if row.warned and seen else 0.0)
        spread = max(spread, largest if row.method == "tls" else 0.0)
        remark = "biased, and says so" if row.warned else ""
        rows.append((row.frame, row.method, *_cells(off), row.steepest, remark if seen else "singular"))
    failure = f"misses by up to {f'{worst / 3600.0:.3g}°' if worst > 360.0 else f'{worst:.3g} arcsec'}"
    text = (
        "In the frame of a line that looks down its plane is vertical, and the printed form "
        f"{failure if worst else 'finds no plane at all'}. Total least squares does not depend on the frame: its "
        f"angles agree to {spread:.1g} arcsec.",
    )
    table = Table(
        "frames",
        "The three forms in four frames",
        "Angles minus those of total least squares in the Earth-fixed frame; the smallest z component of the three "
        "unit normals, 0 for a vertical plane.",
        ("frame", "form", *_heads(run), "least |normal z|", "warning"),
        rows,
        (None, None, *[6] * len(run.names), 6, None),
    )
    return Section("Forms of the plane and frames", text, (table,))


def _heads(run: SimulatedAngleRun) -> list[str]:
    return [f"{name} [arcsec]" for name in signs(run.names)]


def _cells(values: np.ndarray) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def _effects(run: SimulatedAngleRun) -> Section:
    count, rows = len(run.names), []
    for row in run.effects:
        rows.append((EFFECT_NAMES.get(row.what, row.what), *_cells(row.bias / ARCSEC), *_cells(row.left / ARCSEC)))
    table = Table(
        "effects",
        "Bias of the planes, without noise",
        "Total least squares minus the true dihedral angle: with the effect left in the points, and after the analysis "
        "has moved the points to where the lines of sight lead without it.",
        ("effect", *_heads(run), *(f"{name} corrected" for name in signs(run.names))),
        rows,
        (None, *[4] * count, *[6] * count),
    )
    speed = float(np.linalg.norm(run.flight.velocity) / SPEED_OF_LIGHT / ARCSEC)
    text = (f"Aberration tilts lines of sight toward the flight direction by up to v/c = {speed:.1f} arcsec.",)
    return Section("Effects on the light", text, (table,))


def _sensitivity(run: SimulatedAngleRun) -> Section:
    figures = []
    for name, shows in _panels(run).items():
        moved = "The station" if name == "station" else f"Points, {signs([name.removesuffix('-points')])[0]}"
        drawing = svg.drawn(f"angle-{name}", _sensitivity_figure, run, shows)
        caption = "Resection, which stays, minus planes."
        figures.append(SvgFigure(f"sensitivity-{name}", moved, caption, drawing))
    rows: list[tuple[Cell, ...]] = []
    for entry in (row.to_dict() for row in run.table):
        changes = (entry[f"{angle}_arcsec_per_10m"] for angle in run.names)
        rows.append((_moved(entry["what"]), entry["axis"], *changes))
    table = Table(
        "sensitivity",
        "Change of the angles for 10 m",
        "The station, or all points of one strip, moved by 10 m along an Earth-fixed axis: dihedral angles.",
        ("moved", "axis", *_heads(run)),
        rows,
        (None, None, *[4] * len(run.names)),
    )
    return Section("Errors of the station and of the points", (), (*figures, table))


def _moved(what: str) -> str:
    return "station" if what == "station" else f"{what.replace('_', ' ')} points"


def _panels(run: SimulatedAngleRun) -> dict[str, list[tuple[str, str]]]:
    """Figure -> panels, (what is moved, angle), in the paper's order: Fig. 3, Figs. 4 and 5."""
    pairs = run.flight.pairs
    out = {"station": [("station", name) for name in pairs]}
    return out | {f"{name}-points": [(line, name) for line in pair] for name, pair in pairs.items()}


def _geometry_figure(run: SimulatedAngleRun) -> Figure:
    """The planes from the side, where each is seen on edge, and the strips from above."""
    flight = run.flight
    figure = svg.new_figure(4.6)
    side, above = figure.subplots(1, 2)
    for k, name in enumerate(flight.lines):
        arm = (run.measurement.strips[name].points - flight.station) @ flight.orbital.T / 1e3
        colour, middle = COLOURS[k % len(COLOURS)], arm[len(arm) // 2]
        side.plot([0.0, middle[0]], [0.0, middle[2]], color=colour, lw=1.3)
        side.plot(arm[:, 0], arm[:, 2], ".", color=colour, ms=4)
        above.fill([0.0, arm[0, 0], arm[-1, 0]], [0.0, arm[0, 1], arm[-1, 1]], color=colour, alpha=0.12, lw=0)
        above.plot(arm[:, 0], arm[:, 1], ".", color=colour, ms=3, label=f"{name.replace('_', ' ')}")
    for axes in (side, above):
        axes.plot(0.0, 0.0, "o", color=svg.INK, ms=5)
        axes.set_xlabel("X, forward [km]")
        svg.gridded(axes)
    side.annotate("O", (0.0, 0.0), (8, 2), textcoords="offset points")
    for sign, pair in _named_pairs(run.passes[0]):
        cameras = [flight.cameras[name] for name in reversed(pair)]
        looks = [camera.look(np.array([0.5 * (camera.pixels - 1)]))[0] for camera in cameras]
        begin, end = (float(np.arctan2(look[0], look[2])) for look in looks)
        turn = np.linspace(begin, end, 40)
        if abs(end - begin) < _LEAST_ARC:
            continue
        side.plot(150.0 * np.sin(turn), 150.0 * np.cos(turn), color=svg.GREY, lw=0.8)
        side.text(185.0 * np.sin(turn[20]), 185.0 * np.cos(turn[20]), sign, ha="center", va="center")
    side.invert_yaxis()
    side.set_aspect("equal")
    points = len(run.measurement.strips[flight.lines[0]].points)
    side.set(title="From the side: the planes on edge", ylabel="Z, down [km]")
    above.set(title=f"From above: strips of {points} points, Y stretched", ylabel="Y, right [km]")
    above.legend(loc="upper center", ncols=3, markerscale=2.0)
    above.margins(y=0.35)
    return figure


def _sensitivity_figure(run: SimulatedAngleRun, shows: list[tuple[str, str]]) -> Figure:
    """Changes of the differences between resection and planes with errors of 0 to 10 m."""
    rows = {(row.what, row.axis): row for row in run.table}
    figure = svg.new_figure(3.2 * ((len(shows) + 1) // 2))
    grid = figure.subplots((len(shows) + 1) // 2, min(len(shows), 2), sharey=True, squeeze=False)
    for axes in grid.ravel()[len(shows) :]:
        axes.set_axis_off()
    for axes, (what, angle) in zip(grid.ravel(), shows, strict=False):
        k = run.names.index(angle)
        for axis, colour in zip(AXES, COLOURS, strict=False):
            row = rows[what, axis]
            shown = (-run.difference[k] - row.change[k]) / ARCSEC
            axes.plot(row.amount, shown, "o-", color=colour, ms=3, lw=1.2, label=axis)
        axes.set(title=f"{signs([angle])[0]} over the error of the {_moved(what)}", xlabel="m")
        axes.legend(loc="best", ncols=3)
        svg.gridded(axes)
    for axes in grid[:, 0]:
        axes.set_ylabel("resection − planes [arcsec]")
    return figure


def _scatter_figure(run: SimulatedAngleRun) -> Figure:
    """Angles of all passes: two beside the ellipse of the claimed covariance, one beside its normal distribution."""
    names = signs(run.names)
    several = len(names) > 1
    figure = svg.new_figure(4.4 if several else 3.2)
    grid = figure.subplots(1, 2, sharex=True, sharey=True)
    cases = (("Planes, total least squares", run.planes), ("Resection", run.resection))
    for axes, (title, scatter) in zip(grid, cases, strict=True):
        axes.set(title=title, xlabel=f"{names[0]} − truth [arcsec]")
        (_ellipse_of_passes if several else _bell_of_passes)(axes, scatter)
        axes.legend(loc="upper right")
        svg.gridded(axes)
    grid[0].set_ylabel(f"{names[1]} − truth [arcsec]" if several else "share of passes per arcsec")
    grid[0].margins(0.2 if several else 0.05)
    return figure


def _ellipse_of_passes(axes: Axes, scatter: Scatter) -> None:
    """Two angles, and where 95% of the passes should lie."""
    off, turn = (scatter.values - scatter.truth) / ARCSEC, np.linspace(0.0, 2.0 * np.pi, 181)
    root = np.linalg.cholesky(scatter.covariance[:2, :2]) / ARCSEC
    ellipse = np.sqrt(5.991) * root @ np.stack([np.cos(turn), np.sin(turn)])
    axes.plot(off[:, 0], off[:, 1], ".", color=svg.BLUE, ms=4, label=f"{len(off)} passes")
    axes.plot(*ellipse, color=svg.VERMILION, lw=1.2, label="95% by propagation")
    axes.plot(0.0, 0.0, "+", color=svg.INK, ms=9)
    axes.set_aspect("equal")


def _bell_of_passes(axes: Axes, scatter: Scatter) -> None:
    """One angle's histogram."""
    off, sigma = (scatter.values - scatter.truth)[:, 0] / ARCSEC, float(scatter.sigma[0] / ARCSEC)
    place = np.linspace(-4.0, 4.0, 161) * sigma
    bell = np.exp(-0.5 * (place / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
    bins: Any = np.linspace(-4.0, 4.0, 25) * sigma
    axes.hist(off, bins=bins, density=True, color=svg.SKY, label=f"{len(off)} passes")
    axes.plot(place, bell, color=svg.VERMILION, lw=1.2, label="by propagation")


def _far_points(one: PassAngles) -> list[tuple[str, int, float]]:
    """Points that lie farther from their plane than chance allows: line, number in it, sigmas."""
    found = []
    for line, fit in zip(one.measurement.strips, one.estimate.planes["tls"], strict=True):
        sigma = np.sqrt(np.einsum("i,nij,j->n", fit.normal, fit.strip.covariance, fit.normal))
        away = np.abs(fit.residual) / sigma
        limit = np.sqrt(chi2.isf(_FALSE_ALARM / len(away), 1))
        found += [(line, int(k), float(away[k])) for k in np.flatnonzero(away > limit)]
    return found


def _warnings(run: AngleRun) -> tuple[str, ...]:
    found = []
    if isinstance(run, SimulatedAngleRun):
        spec, left = run.flight.spec, run.flight.effects.names
        if left and not spec.effects.corrected:
            found.append(
                f"the analysis leaves {', '.join(left)} in the points; the angles are biased as the table of effects "
                "says"
            )
        if any(spec.errors.datum):
            found.append(
                "the points share a shift that no sigma contains and no residual shows; see the table of effects"
            )
    for one in run.passes:
        folded = [n for n, f in zip(signs(one.pairs), one.estimate.angles["tls"].folded, strict=True) if f]
        if folded:
            found.append(
                f"{one.name}: the planes of {listed(folded)} are parallel within their noise: the unsigned dihedral "
                "angle folds at zero; use the angle along the track, which has a sign"
            )
        far = _far_points(one)
        if far:
            line, number, away = max(far, key=lambda point: point[2])
            found.append(
                f"{one.name}: {len(far)} points lie farther from their planes than chance allows, the farthest "
                f"{one.ids[line][number]} of {line}, {away:.0f} σ; `angle` leaves none out: look at them, or let "
                "`calibrate` find them"
            )
        if one.estimate.resection.p_value < UNLIKELY:
            found.append(
                f"{one.name}: the resection does not fit (chance {one.estimate.resection.p_value:.1g}); principal "
                "distances may have changed, or lines turned about the flight direction or the vertical"
            )
    return tuple(found)
