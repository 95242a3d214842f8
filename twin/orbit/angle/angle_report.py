"""Report of a test of intersection angles, against the laboratory and, for a simulation, against the truth.

docs/orbit.md and docs/measured_orbit.md explain the methods and their differences.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import chi2

from analysis.arrays import ARCSEC
from scenes.specs.orbit.setup import MeasuredAngleSetup
from twin.framework import svg
from twin.framework.artefact import FAR, Cell, SvgFigure, Table, fixed
from twin.framework.report import Report, Section, answer, inputs
from twin.orbit.angle.angle_run import UNLIKELY, AngleRun, PassAngles, Scatter, SimulatedAngleRun, values_of
from twin.orbit.flight.sensor import SPEED_OF_LIGHT

METHOD_NAMES = {
    "printed": "planes, eq. 5 as printed",
    "corrected": "planes, eq. 5 with the right sign",
    "tls": "planes, total least squares",
}
"""Names in reports of the methods of fitting planes to station and ground points, by key."""
EFFECT_NAMES = {"light_time": "light time", "all": "all three", "datum": "shift of all points"}
"""Names in reports of the effects on the light (light time, aberration, refraction) whose key is not their name."""
_FALSE_ALARM = 1e-4
"""Probability of a false alarm: a plane whose points are correct raises a warning."""
_GREEK = {"alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ"}
COLOURS = (svg.BLUE, svg.GREEN, svg.VERMILION, svg.ORANGE, svg.PURPLE, svg.SKY)
"""Colours of the camera's lines in figures, in the order of the lines."""
_KINDS = ("dihedral", "look", "along_track")
"""Definitions of an angle between two lines, which are attributes of `LineAngles`."""
_LEAST_ARC = np.radians(5.0)
"""Smallest angle whose arc is drawn in the figure of the geometry, in radians."""


def greek_names(names: Iterable[str]) -> list[str]:
    """Return the names of angles as reports write them, with Greek letters."""
    return [_GREEK.get(name, name.replace("_", " ")) for name in names]


def listed(words: Sequence[str]) -> str:
    """Return words as a list in prose: `a, b and c`."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def angle_report(run: AngleRun) -> Report:
    """Return the report of a simulated or measured test of intersection angles: verdict, tables and figures."""
    first = run.passes[0]
    lead: tuple[str, ...] = ()
    along = first.estimate.along
    change = first.change / ARCSEC
    changed = [
        f"{name} has changed by {fixed(change[k], 2)} ± {along.sigma[k] / ARCSEC:.2f} arcsec"
        for k, name in enumerate(greek_names(first.pairs))
    ]
    parts = ["the sigmas include the errors of ground points, image points and readings"]
    sections: tuple[Section, ...] = (_planes(run),)
    if isinstance(run, SimulatedAngleRun):
        parts, lead = _simulated_verdict(run)
        sections += (_geometry(run), _change(run), _scatter(run), _effects(run), _sensitivity(run))
    verdict, more = answer(
        f"Since the laboratory calibration {listed(changed)} along the track, from the ground points of {first.name}",
        *parts,
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


def _simulated_verdict(run: SimulatedAngleRun) -> tuple[list[str], tuple[str, ...]]:
    """Return the verdict of a simulated test: angles compared with the truth, and planes with the resection."""
    names, flight, narrow = greek_names(run.names), run.flight, run.narrow
    tls, along = run.estimate.angles["tls"], run.estimate.along
    error = np.where(narrow, along.values - values_of(flight.along_track), tls.values - values_of(flight.dihedral))
    sigma = np.where(narrow, along.sigma, tls.sigma)
    both = zip(run.difference / ARCSEC, run.difference_sigma / ARCSEC, strict=True)
    lead = [f"Planes minus resection: {listed([f'{fixed(v, 3)} ± {spread:.3f} arcsec' for v, spread in both])}."]
    for name, true in flight.trace.items():
        at = run.names.index(name)
        lead.append(
            f"By the ground points, {names[at]} has changed by {fixed(run.change[at] / ARCSEC, 2)} ± "
            f"{along.sigma[at] / ARCSEC:.2f} arcsec since the laboratory; the ray trace of the instrument gives "
            f"{fixed(true / ARCSEC, 3)} arcsec."
        )
    if not np.any(sigma > 0.0):
        return [], tuple(lead)
    with np.errstate(divide="ignore", invalid="ignore"):
        worst = float(np.nanmax(np.abs(error) / sigma))
    verdict = "all angles are within" if worst <= FAR else "not all angles are within"
    return [f"{verdict} {FAR:g} σ of the truth (largest error {worst:.1f} σ): see the methods"], tuple(lead)


def _facts(run: AngleRun) -> tuple[tuple[str, str], ...]:
    setup, test = run.setup, run.setup.test
    camera = setup.camera if isinstance(setup, MeasuredAngleSetup) else setup.camera or setup.instrument
    assert camera is not None
    return (
        ("Camera", f"{camera.name}, {camera.description}"),
        ("Angles", "; ".join(f"{sign} between {a} and {b}" for sign, (a, b) in _named_pairs(run.passes[0]))),
        ("Moments, from the epoch", ", ".join(f"{result.name} {result.time:.4g} s" for result in run.passes)),
        *inputs(test, "perturb", "orbit", "strips", "terrain", "errors", "effects"),
        ("Description", test.description),
    )


def _named_pairs(result: PassAngles) -> Iterable[tuple[str, tuple[str, str]]]:
    return zip(greek_names(result.pairs), result.pairs.values(), strict=True)


def _methods(run: AngleRun) -> Table:
    truth = (run.flight,) if isinstance(run, SimulatedAngleRun) else ()
    rows: list[tuple[Cell, ...]] = []
    for result in run.passes:
        estimate, along, resection = result.estimate, result.estimate.along, result.estimate.resection_angles
        sides = [{kind: values_of(getattr(of, kind)) for kind in _KINDS} for of in (result.laboratory, *truth)]
        sighted = "lines of sight in the tls planes"
        for k, name in enumerate(greek_names(result.pairs)):
            # the sigma along the track holds only for looks mostly along the track
            mostly = abs(sides[0]["along_track"][k]) > 0.99 * sides[0]["look"][k]
            kinds: list[tuple[str, str, np.ndarray, np.ndarray | None, bool]] = [
                *((METHOD_NAMES[m], "dihedral", a.values, a.sigma, a.folded[k]) for m, a in estimate.angles.items()),
                (sighted, "look", estimate.look, along.sigma if mostly else None, False),
                (sighted, "along_track", along.values, along.sigma, False),
                ("resection", "along_track", resection.values, resection.sigma, False),
            ]
            for method, kind, value, sigma, folded in kinds:
                differences = (float((value[k] - side[kind][k]) / ARCSEC) for side in sides)
                spread = None if sigma is None else float(sigma[k] / ARCSEC)
                words = kind.replace("_", " ") + " (folded)" * bool(folded)
                rows.append((result.name, name, method, words, float(np.degrees(value[k])), spread, *differences))
    heads = ("pass", "", "method", "angle", "deg", "σ [arcsec]", "− laboratory [arcsec]", "− truth [arcsec]")
    width = len(heads) - (not truth)
    return Table(
        "methods",
        "Angles by each method",
        "Dihedral: between the planes of the lines, fitted in the Earth-fixed frame. Look: between the lines of sight "
        "of the lines' centres. Along track: the look's signed part along the track, positive where the first line "
        "looks ahead of the second. Folded: below three sigmas, where noise biases an unsigned angle upward.",
        heads[:width],
        rows,
        (None, None, None, None, 7, 3, 3, 3)[:width],
    )


def _planes(run: AngleRun) -> Section:
    rows: list[tuple[Cell, ...]] = []
    for result in run.passes:
        for line, fit in zip(result.measurement.strips, result.estimate.planes["tls"], strict=True):
            freedom, rms = len(fit.residual) - 2, float(np.sqrt(np.mean(fit.residual**2)))
            p_value = float(chi2.sf(fit.chi_square, freedom)) if freedom > 0 else None
            ratio = fit.chi_square / max(freedom, 1)
            rows.append((result.name, line, len(fit.residual), *result.span[line], rms, ratio, p_value))
    table = Table(
        "planes",
        "Planes of the lines",
        "Planes through the station and the points of each line: times of the points from the moment; RMS distance of "
        "the points from the plane; chi-square over its degrees of freedom and its p-value.",
        ("pass", "line", "points", "from [s]", "to [s]", "RMS [m]", "χ²/dof", "p"),
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
            "The cameras' projection centres lie metres apart on the satellite, and their lines are imaged bent by "
            f"{bow:.1f} arcsec at the ends. The analysis uses both as the laboratory measured them."
        )
    heights = [f"{v:.2f} m for {greek_names([n])[0]}" for n, v in run.height.items() if v is not None]
    if heights:
        text.append(f"An error of 1 arcsec in an angle changes intersected heights by {listed(heights)}.")
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
        "Ground: from the ground points, minus the laboratory's angle. True: change of the simulated lines. Trace: by "
        "chief rays of the instrument, only for the two cameras of a pair.",
        ("angle", "ground [arcsec]", "σ [arcsec]", "true [arcsec]", "trace [arcsec]"),
        list(zip(greek_names(run.names), *((v / ARCSEC).tolist() for v in arcsec), trace, strict=True)),
        (None, 3, 3, 4, 4),
    )
    return Section("Since the laboratory", (), (table,))


def _scatter(run: SimulatedAngleRun) -> Section:
    names = greek_names(run.names)
    cases = (("planes, tls", run.planes), ("planes, along track", run.along), ("resection", run.resection))
    rows: list[list[Cell]] = []
    for method, scatter in cases:
        of_mean = scatter.spread / np.sqrt(len(scatter.values))
        numbers = np.stack(
            [v / ARCSEC for v in (scatter.bias, of_mean, scatter.spread, scatter.sigma)] + [scatter.p_value], axis=-1
        )
        rows += [[method, sign, *row] for sign, row in zip(names, numbers.tolist(), strict=True)]
    table = Table(
        "scatter",
        f"{len(run.planes.values)} passes with errors drawn anew",
        "Mean minus truth with the sigma of the mean, in arcseconds; spread over the passes, the sigma predicted by "
        "the estimator, and the two-sided p-value of the spread under that sigma.",
        ("method", "angle", "mean − truth", "σ of the mean", "spread", "predicted σ", "p"),
        rows,
        (None, None, 4, 4, 4, 4, 3),
    )
    caption = "Histogram, with the normal distribution of the predicted sigma."
    if len(names) > 1:
        caption = (
            f"{names[0]} and {names[1]}; the table has all. Angles share the station and the planes of common lines."
        )
    drawing = svg.drawn("angle-scatter", _scatter_figure, run)
    figure = SvgFigure("scatter-passes", "Angles of all passes", caption, drawing)
    return Section("Planes and resection", (), (table, figure))


def _heads(run: SimulatedAngleRun) -> list[str]:
    return [f"{name} [arcsec]" for name in greek_names(run.names)]


def _cells(values: np.ndarray) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def _effects(run: SimulatedAngleRun) -> Section:
    count, rows = len(run.names), []
    for row in run.effects:
        rows.append((EFFECT_NAMES.get(row.what, row.what), *_cells(row.bias / ARCSEC), *_cells(row.remaining / ARCSEC)))
    table = Table(
        "effects",
        "Bias of the planes, without noise",
        "Total least squares minus the true dihedral angle: with the effect left in the points, and after the analysis "
        "has corrected the points for it.",
        ("effect", *_heads(run), *(f"{name} corrected" for name in greek_names(run.names))),
        rows,
        (None, *[4] * count, *[6] * count),
    )
    speed = float(np.linalg.norm(run.flight.velocity) / SPEED_OF_LIGHT / ARCSEC)
    text = (f"Aberration tilts lines of sight toward the flight direction by up to v/c = {speed:.1f} arcsec.",)
    return Section("Effects on the light", text, (table,))


def _sensitivity(run: SimulatedAngleRun) -> Section:
    rows: list[tuple[Cell, ...]] = []
    for entry in (row.to_dict() for row in run.table):
        moved = "station" if entry["what"] == "station" else f"{entry['what'].replace('_', ' ')} points"
        rows.append((moved, entry["axis"], *(entry[f"{angle}_arcsec_per_10m"] for angle in run.names)))
    table = Table(
        "sensitivity",
        "Change of the angles for 10 m",
        "Change of the dihedral angles, to first order, when the station, or all points of a strip, move by 10 m along "
        "an Earth-fixed axis.",
        ("moved", "axis", *_heads(run)),
        rows,
        (None, None, *[4] * len(run.names)),
    )
    return Section("Errors of the station and of the points", (), (table,))


def _geometry_figure(run: SimulatedAngleRun) -> Figure:
    """Draw the planes from the side, where each is seen edge-on, and the strips from above."""
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
        angle = np.linspace(begin, end, 40)
        if abs(end - begin) < _LEAST_ARC:
            continue
        side.plot(150.0 * np.sin(angle), 150.0 * np.cos(angle), color=svg.GREY, lw=0.8)
        side.text(185.0 * np.sin(angle[20]), 185.0 * np.cos(angle[20]), sign, ha="center", va="center")
    side.invert_yaxis()
    side.set_aspect("equal")
    points = len(run.measurement.strips[flight.lines[0]].points)
    side.set(title="From the side: the planes on edge", ylabel="Z, down [km]")
    above.set(title=f"From above: strips of {points} points, Y stretched", ylabel="Y, right [km]")
    above.legend(loc="upper center", ncols=3, markerscale=2.0)
    above.margins(y=0.35)
    return figure


def _scatter_figure(run: SimulatedAngleRun) -> Figure:
    """Draw the angles of all passes: two with their predicted ellipse, or one with its predicted distribution."""
    names = greek_names(run.names)
    several = len(names) > 1
    figure = svg.new_figure(4.4 if several else 3.2)
    grid = figure.subplots(1, 2, sharex=True, sharey=True)
    cases = (("Planes, total least squares", run.planes), ("Resection", run.resection))
    for axes, (title, scatter) in zip(grid, cases, strict=True):
        axes.set(title=title, xlabel=f"{names[0]} − truth [arcsec]")
        (_ellipse_of_passes if several else _histogram_of_passes)(axes, scatter)
        axes.legend(loc="upper right")
        svg.gridded(axes)
    grid[0].set_ylabel(f"{names[1]} − truth [arcsec]" if several else "share of passes per arcsec")
    grid[0].margins(0.2 if several else 0.05)
    return figure


def _ellipse_of_passes(axes: Axes, scatter: Scatter) -> None:
    """Plot two angles estimated from each pass against each other, with the ellipse that contains 95 % of the passes.

    The ellipse is computed by error propagation, about the true angles.
    """
    error, phase = (scatter.values - scatter.truth) / ARCSEC, np.linspace(0.0, 2.0 * np.pi, 181)
    root = np.linalg.cholesky(scatter.covariance[:2, :2]) / ARCSEC
    ellipse = np.sqrt(5.991) * root @ np.stack([np.cos(phase), np.sin(phase)])
    axes.plot(error[:, 0], error[:, 1], ".", color=svg.BLUE, ms=4, label=f"{len(error)} passes")
    axes.plot(*ellipse, color=svg.VERMILION, lw=1.2, label="95% by propagation")
    axes.plot(0.0, 0.0, "+", color=svg.INK, ms=9)
    axes.set_aspect("equal")


def _histogram_of_passes(axes: Axes, scatter: Scatter) -> None:
    """Draw the histogram of one angle with its predicted normal distribution."""
    error, sigma = (scatter.values - scatter.truth)[:, 0] / ARCSEC, float(scatter.sigma[0] / ARCSEC)
    position = np.linspace(-4.0, 4.0, 161) * sigma
    bell = np.exp(-0.5 * (position / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
    bins: Any = np.linspace(-4.0, 4.0, 25) * sigma
    axes.hist(error, bins=bins, density=True, color=svg.SKY, label=f"{len(error)} passes")
    axes.plot(position, bell, color=svg.VERMILION, lw=1.2, label="by propagation")


def _far_points(result: PassAngles) -> list[tuple[str, int, float]]:
    """Return outliers, points improbably far from their fitted plane: line, index in the line, distance in sigmas."""
    points = []
    for line, fit in zip(result.measurement.strips, result.estimate.planes["tls"], strict=True):
        sigma = np.sqrt(np.einsum("i,nij,j->n", fit.normal, fit.strip.covariance, fit.normal))
        distance = np.abs(fit.residual) / sigma
        limit = np.sqrt(chi2.isf(_FALSE_ALARM / len(distance), 1))
        points += [(line, int(k), float(distance[k])) for k in np.flatnonzero(distance > limit)]
    return points


def _warnings(run: AngleRun) -> tuple[str, ...]:
    warnings = []
    if isinstance(run, SimulatedAngleRun):
        spec, effects = run.flight.spec, run.flight.effects.names
        if effects and not spec.effects.corrected:
            warnings.append(
                f"the analysis does not correct {', '.join(effects)} in the points; the table of effects gives the "
                "bias of the angles"
            )
        if any(spec.errors.datum):
            warnings.append(
                "the points share a shift that is neither in the sigmas nor visible in the residuals; see the table of "
                "effects"
            )
    for result in run.passes:
        folded = [n for n, f in zip(greek_names(result.pairs), result.estimate.angles["tls"].folded, strict=True) if f]
        if folded:
            warnings.append(
                f"{result.name}: the planes of {listed(folded)} are parallel within their noise, where the "
                "unsigned dihedral angle is biased; use the signed angle along the track"
            )
        far = _far_points(result)
        if far:
            line, number, distance = max(far, key=lambda point: point[2])
            warnings.append(
                f"{result.name}: {len(far)} points lie improbably far from their planes, the farthest "
                f"{result.ids[line][number]} of {line}, {distance:.0f} σ; `angle` rejects none: check them, or "
                "use the screening of `calibrate`"
            )
        if result.estimate.resection.p_value < UNLIKELY:
            warnings.append(
                f"{result.name}: the resection does not fit (p = {result.estimate.resection.p_value:.1g}); "
                "principal distances may have changed, or lines rotated about the flight direction or the vertical"
            )
    return tuple(warnings)
