"""Sections of a calibration's report on the adjustment: parameters, fields, biases, datum and observability.

docs/orbit.md explains how averaging, drifting cameras and tie points change the result.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from analysis.arrays import ARCSEC
from analysis.calibration.adjustment import Adjustment
from analysis.orbit.calibration_parameters import OFFSET, RATE
from analysis.orbit.three_line_model import BIAS, misclosure
from twin.framework import svg
from twin.framework.artefact import Cell, SvgFigure, Table
from twin.framework.report import Section
from twin.orbit.calibration.calibration_numbers import BIAS_OF_FIELD, CHIP_STEP, LATITUDE, REPEATABILITY
from twin.orbit.calibration.calibration_run import STEPWISE_TOLERANCE, CalibrationRun
from twin.orbit.calibration.campaign import FieldPass
from twin.orbit.calibration.flown_campaign import true_bias

_SCALES = {"rad": (ARCSEC, "arcsec"), "rad/s": (1e-3 * ARCSEC, "mas/s"), "m": (1.0, "m")}
"""Unit of an unknown in result files -> unit of the tables of the report, as its size in SI units and its name."""
MOSTLY = 0.5
"""Share of an unknown's variance above which it counts as determined by the prior (change at launch), not the points.
"""
Rows = list[tuple[Cell, ...]]


def adjustment_sections(run: CalibrationRun, data: Mapping[str, Any]) -> tuple[Section, ...]:
    """Return the sections of a calibration's report on the adjustment of all fields.

    Parameters
    ----------
    run : CalibrationRun
        Results of the calibration.
    data : Mapping[str, Any]
        Content of calibration.json.
    """
    return (_parameters(run, data), _fields(run, data), _biases(run, data), _rank(run))


def figure_of(
    run: CalibrationRun, draw: Callable[[CalibrationRun], Figure], name: str, title: str, caption: str
) -> SvgFigure:
    """Return a figure of the report from the function that draws it, its name, title and caption."""
    return SvgFigure(name, title, caption, svg.drawn(f"calibration-{name}", draw, run))


def _latitude_figure(run: CalibrationRun) -> Figure:
    """Draw each field's attitude bias with its sigma, the truth where it is known, and the fit against latitude."""
    figure = svg.new_figure(3.9)
    campaign, passes = run.campaign, run.campaign.passes
    latitude = np.array([p.latitude for p in passes])
    span = np.linspace(latitude.min() - 0.03, latitude.max() + 0.03, 101)
    for k, (axes, axis) in enumerate(zip(figure.subplots(1, 3), BIAS, strict=True)):
        value = np.array([run.together.value(f"{p.name} {axis}") for p in passes]) / ARCSEC
        sigma = np.array([run.together.sigma[f"{p.name} {axis}"] for p in passes]) / ARCSEC
        if campaign.known_truth is not None:
            truth = true_bias(campaign.simulated, span)
            axes.plot(np.degrees(span), truth[:, k] / ARCSEC, color=svg.GREY, lw=1.0, ls="--", label="truth, no season")
        for fit in run.latitude[k : k + 1]:
            axes.plot(np.degrees(span), fit.curve(span) / ARCSEC, color=svg.VERMILION, lw=1.3, label="fit")
        if campaign.known_truth is not None:
            true = np.array([p.bias[k] for p in passes]) / ARCSEC
            axes.plot(np.degrees(latitude), true, "x", color=svg.INK, ms=6, label="truth of the field", zorder=4)
        axes.errorbar(
            np.degrees(latitude), value, sigma, fmt="o", color=svg.BLUE, ms=4, lw=1.2, capsize=2, label="estimated, 1σ"
        )
        axes.set(title=f"{axis} [arcsec]", xlabel="latitude [deg]")
        svg.gridded(axes)
        handles = axes.get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=4)
    return figure


def _residuals(run: CalibrationRun, flight: FieldPass, line: str) -> np.ndarray:
    """Return the residuals of a field's control points in one line after the adjustment, (n, 2), px in x and y."""
    adjustment, rays = run.together, flight.control.rays[line]
    names = (f"{flight.name} offset {axis}" for axis in OFFSET)
    offset = np.array([adjustment.value(name) if name in adjustment.names else 0.0 for name in names])
    residual = misclosure(
        adjustment.cameras[line],
        rays,
        adjustment.ground[flight.name][rays.point],
        adjustment.bias(flight.name),
        flight.control.axes @ offset,
    )
    return np.asarray(residual / flight.data.pitch[line])


_BINS = 12
"""Number of parts of a line over which residuals are averaged."""


def _along_figure(run: CalibrationRun) -> Figure:
    """Draw the residuals of all fields' control points over the pixels of each line, with means of its parts."""
    lines = list(dict.fromkeys(line for flight in run.campaign.passes for line in flight.control.rays))
    figure = svg.new_figure(4.6)
    grid = figure.subplots(2, len(lines), sharex="col", sharey="row", squeeze=False)
    for column, line in zip(grid.T, lines, strict=True):
        flights = [flight for flight in run.campaign.passes if line in flight.control.rays]
        pixel = np.concatenate([flight.control_images[line].pixel for flight in flights])
        residual = np.concatenate([_residuals(run, flight, line) for flight in flights])
        edges = np.linspace(pixel.min(), pixel.max(), _BINS + 1)
        part = np.clip(np.digitize(pixel, edges) - 1, 0, _BINS - 1)
        filled = [k for k in range(_BINS) if np.sum(part == k) > 1]
        middle = 0.5 * (edges[1:] + edges[:-1])[filled]
        for axes, values in zip(column, residual.T, strict=True):
            axes.axhline(0.0, color=svg.GREY, lw=0.7)
            axes.plot(pixel, values, ".", color=svg.SKY, ms=3.0, alpha=0.7, label="control points of all fields")
            mean = np.array([values[part == k].mean() for k in filled])
            error = np.array([values[part == k].std(ddof=1) / np.sqrt(np.sum(part == k)) for k in filled])
            axes.errorbar(middle, mean, error, fmt="o", color=svg.BLUE, ms=4.0, lw=1.0, label="mean of a part, ±σ")
            svg.gridded(axes)
        column[0].set_title(line, loc="left")
        column[1].set_xlabel("pixel along the line")
    grid[0, 0].set_ylabel("x, along the track [px]")
    grid[1, 0].set_ylabel("y, along the line [px]")
    svg.shared_legend(figure, grid[0, 0])
    return figure


def _parameters(run: CalibrationRun, data: Mapping[str, Any]) -> Section:
    campaign, names = run.campaign, run.together.names
    interior = np.ravel([campaign.laboratory[line].interior for line in campaign.lines]).tolist()
    start = dict(zip(campaign.inner, interior, strict=True))
    drift = run.drift.sigmas_per_arcsec or {}
    rows: Rows = []
    for name, unknown in data["parameters"].items():
        scale, shown = (1e-6, "µm") if name in start else _SCALES[unknown["unit"]]
        first, sigma = start.get(name, 0.0), unknown["sigma"] or None  # none for held unknowns
        cells = [(unknown["value"] - first) / scale, sigma and sigma / scale, drift.get(name)]
        if run.truth is not None:
            error = unknown["value"] - unknown["truth"]
            cells += [(unknown["truth"] - first) / scale, sigma and error / sigma]
        rows.append((name, shown, *cells))
    apart = f"The lines see a field up to {campaign.passes[0].seconds_apart:.0f} s apart, and"
    if any(name in RATE for name in names):
        text = f"{apart} the fit of the biases against latitude predicts their drift in this time, with its sigma."
    elif any(name.endswith(RATE) for name in names):
        text = f"{apart} a rate of the attitude is estimated in each pass, with the stated or detected sigma as prior."
    else:
        text = f"{apart} a drift of the biases is not observable: the outer lines' principal points absorb it."
    table = Table(
        "parameters",
        "Unknowns of all fields at once",
        "Elements of the interior orientation: changes from the laboratory; biases and offsets: from measured to true. "
        "Without sigma: held (gauge). Drift: change of an unknown, in its sigmas, if the attitude drifts by 1 arcsec "
        f"in {run.drift.seconds:.0f} s and the adjustment does not model it; empty where rates are "
        "unknowns. z: error in sigmas.",
        ("unknown", "unit", "value", "σ", "σ per arcsec of drift", *(("truth", "z") if run.truth is not None else ())),
        rows,
        (None, None, 3, 3, 2, *((3, 2) if run.truth is not None else ())),
    )
    steps = CHIP_STEP.table(
        "chip-steps",
        "Steps between chips",
        "Steps are not unknowns of the adjustment: each is estimated from the residuals, at the joints of the camera's "
        "file or, for a line of one chip, at its middle. Detectable: size that is detected in half of all cases, with "
        "one false alarm in 10 000 runs.",
        data["chip_steps"],
        ("line", "axis", "place_m", "step_m", "sigma_m", "detectable_m"),
        digits=4,
    )
    along = figure_of(
        run,
        _along_figure,
        "residuals-along",
        "Residuals along the lines, all fields",
        "A mean that leaves zero over part of a line is an error that the parameters of the interior orientation do "
        "not describe.",
    )
    return Section("Parameters", (text,), (along, table, steps))


def _fields(run: CalibrationRun, data: Mapping[str, Any]) -> Section:
    table = BIAS_OF_FIELD.table(
        "fields",
        "Each field by itself",
        "Biases of the attitude. Offsets of the orbit are not among these unknowns; roll and pitch absorb them: 0.3 m "
        "are 0.1 arcsec.",
        {f"{name} {axis}": bias for name, field in data["fields"].items() for axis, bias in field["bias"].items()},
        ("value", "sigma", "truth") if run.truth is not None else ("value", "sigma"),
        "field and axis",
    )
    if not run.repeatability:
        return Section("Fields", ("Repeatability needs two fields or more.",), (table,))
    inner = [r for r in run.repeatability if r.name not in BIAS and r.sigma > 0.0]
    worst, largest = (
        max(rows_of_sort, key=lambda r: r.scatter)
        for rows_of_sort in (inner, [r for r in run.repeatability if r.name in BIAS])
    )
    text = (
        f"From field to field the interior orientation repeats to {1e3 * worst.scatter:.4f} mm or better (largest "
        f"standard deviation, {worst.name}). The biases scatter by up to {largest.scatter / ARCSEC:.2f} arcsec "
        f"({largest.name}).",
    )
    repeats = REPEATABILITY.table(
        "repeatability",
        "Repeatability over the fields",
        "Standard deviation over the fields, sigma predicted by a field's adjustment, and p-value of the scatter under "
        "this sigma. A small p-value for a bias means that it really differs from field to field. Held (gauge): no p.",
        [_in_shown_unit(row, "scatter", "sigma") for row in data["repeatability"]],
        ("name", "unit", "scatter", "sigma", "p_value"),
        digits=4,
    )
    return Section("Fields", text, (repeats, table))


def _in_shown_unit(row: Mapping[str, Any], *keys: str) -> dict[str, Any]:
    """Return a row of an unknown of the interior or a bias with the numbers of these keys in its unit in reports."""
    scale, shown = (1e-6, "µm") if row["unit"] == "m" else _SCALES[row["unit"]]
    return {**row, "unit": shown, **{key: row[key] / scale for key in keys}}


def _biases(run: CalibrationRun, data: Mapping[str, Any]) -> Section:
    figure = figure_of(
        run,
        _latitude_figure,
        "bias-latitude",
        "Bias of the attitude against latitude",
        "From the adjustment of all fields, which includes the orbit's offsets. The errors of yaw are mostly common to "
        "all fields (y of the outer lines); differences between fields are determined far better.",
    )
    if not run.latitude:
        few = "There are too few fields, or all at one latitude, to separate a drift with latitude from the season."
        return Section("Biases against latitude", (few,), (figure,))
    keys = ("amplitude_rad", "amplitude_rad_sigma", "constant_rad", "constant_rad_sigma", "chi_square")
    table = LATITUDE.table(
        "bias-fits",
        "Amplitude × sin(latitude − reference) + constant",
        f"The reference is the middle of the fields, {np.degrees(run.latitude[0].reference):.1f}°. Chi-square: with "
        "the biases' own covariance. The remainder is the season; the sigmas include it.",
        data["bias_latitude"],
        (*keys, "degrees_of_freedom", "p_value", "remainder_rad"),
        "axis",
        digits=4,
    )
    values = np.array([[run.together.value(f"{p.name} {axis}") for p in run.campaign.passes] for axis in BIAS[:2]])
    spread = float(np.hypot(*values.std(axis=1, ddof=1)))
    metres, largest = spread * run.campaign.passes[0].altitude, max(len(s) for s in run.campaign.spec.schemes)
    weak = [f.axis for f in run.latitude if abs(f.amplitude) < 2.0 * f.amplitude_sigma]
    seen = f"the drift is not significant in {', '.join(weak)}" if weak else "the drift is significant in all axes"
    change = np.ptp(np.sin(run.latitude[0].latitude - run.latitude[0].reference))
    remainders = ", ".join(f"{f.remainder / ARCSEC:.2f} arcsec in {f.axis}" for f in run.latitude)
    text = (
        f"The fields lie within {np.degrees(np.ptp(run.latitude[0].latitude)):.0f}° of latitude, where the sine "
        f"changes by {change:.2f}. Beside the drift, the season of each field remains, {remainders}: {seen} at two "
        "sigmas.",
        f"Roll and pitch of the fields scatter by {spread / ARCSEC:.2f} arcsec together, {metres:.1f} m on the ground. "
        f"The bias of one field therefore causes errors of {np.sqrt(2.0) * metres:.1f} m RMS in plan in another field, "
        f"and the mean bias of {largest} fields {np.sqrt(1.0 + 1.0 / largest) * metres:.1f} m, beside noise.",
    )
    return Section("Biases against latitude", text, (figure, table))


def prior_dominated(adjustment: Adjustment) -> dict[str, float]:
    """Return the unknowns that the prior determines more than the points, with the prior's share of their variance."""
    shares = zip(adjustment.names, adjustment.prior_share.tolist(), strict=True)
    return {name: share for name, share in shares if share > MOSTLY}


def _rank(run: CalibrationRun) -> Section:
    adjustment, stepwise = run.together, run.stepwise
    size = np.nan_to_num(np.abs(np.triu(adjustment.correlation, 1)), posinf=0.0)
    pairs = zip(*np.unravel_index(np.argsort(size, axis=None)[::-1][:10], size.shape), strict=True)
    text = [f"Gauge: {adjustment.gauge}."]
    text += [f"Not observable: {c}." for c in adjustment.open]
    text += [f"Weak, but solved for: {c}." for c in adjustment.weak]
    if resting := prior_dominated(adjustment):
        shares = ", ".join(f"{name} ({100.0 * share:.0f}% of its variance)" for name, share in resting.items())
        text.append(f"Determined mainly by the launch prior, not by the points: {shares}.")
    text.append(
        "The stepwise solution, bias and interior in turn, "
        f"{'converges' if stepwise.converged else 'does not converge'} for {run.campaign.spec.schemes[0][0]} in "
        f"{stepwise.rounds} rounds to steps of {STEPWISE_TOLERANCE:g} sigma; its convergence rate is "
        f"{stepwise.rate:.4f} per round. The simultaneous adjustment of all fields takes {adjustment.iterations} "
        "iterations."
    )
    table = Table(
        "correlations",
        "Largest correlations",
        "Largest correlations of the simultaneous adjustment; calibration.json has all of them.",
        ("unknown", "unknown", "correlation"),
        [(adjustment.names[int(i)], adjustment.names[int(j)], float(adjustment.correlation[i, j])) for i, j in pairs],
        (None, None, 4),
    )
    return Section("Observability", tuple(text), (table,))
