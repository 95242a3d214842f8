"""Figures of the report of an in-orbit calibration."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from analysis.arrays import ARCSEC
from analysis.orbit.calibration_parameters import OFFSET
from analysis.orbit.three_line_model import BIAS, misclosure
from twin.framework import svg
from twin.orbit.calibration.calibration_run import CalibrationRun
from twin.orbit.calibration.campaign import FieldPass
from twin.orbit.calibration.flown_campaign import true_bias
from twin.orbit.calibration.schemes import RMS, FieldErrors, Monitoring, values_of


def _expected_height(run: CalibrationRun, study: Monitoring, factor: np.ndarray) -> np.ndarray:
    """Return the expected RMS height error without a monitor, in metres, for n multiples of the file's drift.

    Parameters
    ----------
    run : CalibrationRun
        Results of the calibration.
    study : Monitoring
        Comparison of calibrations with and without the monitor.
    factor : (n,) ndarray
        Factors by which the file's drift is multiplied.

    Notes
    -----
    It is the expectation over many campaigns in which all fields are adjusted at once and the cameras' drift is
    constant within a field. The parameters absorb the mean over the fields of the outer lines' rotation d_alpha about
    the camera's Y, so that it is subtracted.
    """
    spec = run.campaign.simulated
    square = sum(drift.angles[0] ** 2 for name, drift in spec.drift.items() if name != "nadir")
    metres = study.metres * np.sqrt(square * (1.0 - 1.0 / len(spec.fields))) / ARCSEC
    return np.asarray(np.hypot(study.at(0.0).without.together.height_rms, factor * metres))


def _drift_figure(run: CalibrationRun) -> Figure:
    study = run.monitoring
    assert study is not None
    figure = svg.new_figure(4.3)
    left, right = figure.subplots(1, 2)
    angle = study.angle / ARCSEC or 1.0
    size = np.array([s.factor for s in study.sizes])
    fine = np.linspace(0.0, size[-1], 101)
    left.plot(
        fine * angle, _expected_height(run, study, fine), "--", color=svg.GREY, lw=1.0, label="mean of many campaigns"
    )
    cases = {"without monitor": (svg.VERMILION, "o"), "with monitor": (svg.BLUE, "s")}
    monitored = [s.monitored for s in study.sizes if s.monitored is not None]
    for (label, (colour, marker)), rows in zip(
        cases.items(), ([s.without for s in study.sizes], monitored), strict=True
    ):
        if rows:
            height = [row.together.height_rms for row in rows]
            left.plot(size * angle, height, f"{marker}-", color=colour, lw=1.4, ms=5, label=label)
    unit = "σ of Δα of an outer line [arcsec]" if study.angle else "size of the drift against the file's"
    left.set(title="All fields adjusted at once", xlabel=unit, ylabel="height RMS at check points [m]")
    names = list(study.sizes[0].without.schemes)
    nominal = study.at(1.0)
    bars: list[tuple[str, str, list[FieldErrors]]] = [
        ("no drift", svg.GREY, list(study.at(0.0).without.schemes.values())),
        ("without monitor", svg.VERMILION, list(nominal.without.schemes.values())),
    ]
    if nominal.monitored is not None:
        bars.append(("with monitor", svg.BLUE, list(nominal.monitored.schemes.values())))
    position, width = np.arange(len(names)), 0.8 / len(bars)
    for k, (label, colour, values) in enumerate(bars):
        at = position + (k - 0.5 * (len(bars) - 1)) * width
        right.bar(at, [v.height_rms for v in values], 0.92 * width, color=colour, label=label)
    title = "Without ground control, the file's drift"
    right.set(title=title, xticks=position, xlabel="scheme", ylabel="height RMS at check points [m]")
    right.set_xticklabels([*names[:-1], f"{names[-1]}\neach its own"])
    for axes in (left, right):
        axes.set_ylim(0.0, None)
        svg.gridded(axes)
        axes.tick_params(colors=svg.INK)
    handles, labels = left.get_legend_handles_labels()
    more, other = right.get_legend_handles_labels()
    figure.legend([*handles, more[0]], [*labels, other[0]], loc="outside lower center", ncols=4)
    return figure


COLOURS = (svg.BLUE, svg.ORANGE, svg.GREEN, svg.VERMILION, svg.PURPLE, svg.SKY, svg.GREY)
MARKERS = "osD^vP"


def figure_svg(name: str, run: CalibrationRun) -> str:
    """Draw one of the `FIGURES` and return it as SVG."""
    with svg.look(f"calibration-{name}"):
        return svg.to_svg(FIGURES[name](run))


def _schemes_figure(run: CalibrationRun) -> Figure:
    """Draw the RMS errors in plan and in height at every field's check points, by scheme."""
    figure = svg.new_figure(4.3)
    panels = figure.subplots(1, 2)
    names, spec = list(run.schemes), run.campaign.spec
    position = np.arange(len(names))
    labels = [
        f"{k}\n{len(s)} field{'s' * (len(s) > 1)}" for k, s in zip(names, run.campaign.spec.schemes, strict=False)
    ]
    labels.append(f"{names[-1]}\neach its own")
    for axes, what, title, limit in zip(
        panels, RMS, ("plan", "height"), (spec.limits.plan, spec.limits.height), strict=True
    ):
        table = np.array([values_of(errors, what) for errors in run.schemes.values()])
        for k, field in enumerate(run.before):
            style = MARKERS[k // len(COLOURS) % len(MARKERS)]
            colour = COLOURS[k % len(COLOURS)]
            axes.plot(position, table[:, k], f"{style}-", color=colour, lw=0.9, ms=4, label=field)
        axes.plot(position, table.mean(axis=1), "-", color=svg.INK, lw=2.2, label="mean of the fields")
        before = values_of(run.before, what)
        low, high = before.min(), before.max()
        axes.set_ylim(0.0, 1.35 * table.max())
        label = f"before calibration {low:.0f} to {high:.0f} m; limit for 1:50 000 {limit:g} m"
        axes.set(title=f"RMS in {title} [m]", xticks=position, xlabel="scheme")
        axes.text(0.5, 0.97, label, transform=axes.transAxes, ha="center", va="top", color=svg.GREY, fontsize=8.5)
        if limit < 1.35 * table.max():
            axes.axhline(limit, color=svg.GREY, lw=0.9, ls="--")
        axes.set_xticklabels(labels)
        svg.gridded(axes)
    svg.shared_legend(figure, panels[0], "lower center", 4)
    return figure


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


def _correlation_figure(run: CalibrationRun) -> Figure:
    """Draw the correlation matrix of the simultaneous adjustment, without the unknowns that the gauge fixes."""
    adjustment = run.together
    sigma = adjustment.sigma
    free = [k for k, name in enumerate(adjustment.names) if sigma[name] > 0.0]
    names = [adjustment.names[k] for k in free]
    figure = svg.new_figure(min(9.2, 2.6 + 0.14 * len(names)))
    axes = figure.subplots()
    shown = svg.signed_map(axes, adjustment.correlation[np.ix_(free, free)], 1.0)
    size = 6.5 if len(names) > 40 else 8.0
    axes.set_xticks(np.arange(len(names)), names, rotation=90, fontsize=size)
    axes.set_yticks(np.arange(len(names)), names, fontsize=size)
    # lines between the interior and the fields
    groups = ["interior" if name in run.campaign.inner else name.split()[0] for name in names]
    for k in range(1, len(groups)):
        if groups[k] != groups[k - 1]:
            axes.axhline(k - 0.5, color=svg.INK, lw=0.6)
            axes.axvline(k - 0.5, color=svg.INK, lw=0.6)
    figure.colorbar(shown, ax=axes, shrink=0.6, label="correlation")
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


def _residual_figure(run: CalibrationRun) -> Figure:
    """Draw the residuals of the first field's control points in the images of the lines, in pixels."""
    flight = run.campaign.passes[0]
    figure = svg.new_figure(3.9)
    shown = tuple(flight.control.rays)
    panels = figure.subplots(1, len(shown), sharex=True, squeeze=False)[0]
    for axes, line in zip(panels, shown, strict=True):
        residual = _residuals(run, flight, line)
        images = flight.control_images[line]
        arrows = axes.quiver(
            images.pixel,
            images.line / 1e3,
            residual[:, 1],
            residual[:, 0],
            color=svg.BLUE,
            width=0.004,
            scale=14.0,
            zorder=3,
        )
        axes.plot(images.pixel, images.line / 1e3, ".", color=svg.GREY, ms=2)
        axes.quiverkey(arrows, 0.86, 1.04, 1.0, "1 px", labelpos="E", coordinates="axes")
        rms = np.sqrt(np.mean(residual**2, axis=0))
        axes.set_title(f"{line}: x {rms[0]:.2f} px, y {rms[1]:.2f} px", loc="left")
        axes.set(xlabel="pixel")
        axes.margins(0.12)
        svg.gridded(axes)
    panels[0].set_ylabel("image line, thousands")
    return figure


def _check_figure(run: CalibrationRun) -> Figure:
    """Draw the errors at the first field's check points before calibration and with the field's own parameters.

    Arrows show the error in plan, colours the error in height.
    """
    flight = run.campaign.passes[0]
    _, lat, _ = (float(v) for v in flight.data.earth.geodetic(flight.check_ground.mean(axis=0)))
    lon, latitude, _ = flight.data.earth.geodetic(flight.check_ground)
    east = (lon - lon.mean()) * 6.378e3 * np.cos(lat)
    north = (latitude - latitude.mean()) * 6.357e3
    figure = svg.new_figure(5.2)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    cases = (
        ("laboratory's camera", run.before[flight.name]),
        ("its own parameters", list(run.schemes.values())[-1][flight.name]),
    )
    for axes, (title, errors) in zip(panels, cases, strict=True):
        size = float(f"{np.sqrt(np.nanmean(np.sum(errors.error[:, :2] ** 2, axis=1))):.1g}")
        tall = errors.error[:, 2]
        middle = float(np.median(tall))
        extent = float(np.abs(tall - middle).max())
        arrows = axes.quiver(
            east,
            north,
            errors.error[:, 0],
            errors.error[:, 1],
            tall,
            cmap="viridis",
            clim=(middle - extent, middle + extent),
            width=0.004,
            scale=16.0 * size,
        )
        axes.quiverkey(arrows, 0.8, 0.04, size, f"{size:g} m in plan", labelpos="E", coordinates="axes")
        axes.set_title(f"{title}: plan {errors.plan_rms:.2f} m, height {errors.height_rms:.2f} m")
        axes.set(xlabel="east [km]")
        axes.set_aspect("equal")
        axes.margins(0.14)
        figure.colorbar(arrows, ax=axes, shrink=0.75, label="height error [m]", location="bottom")
        svg.gridded(axes)
    panels[0].set_ylabel("north [km]")
    return figure


FIGURES = {
    "monitor-heights": _drift_figure,
    "schemes-of-fields": _schemes_figure,
    "bias-latitude": _latitude_figure,
    "correlation-matrix": _correlation_figure,
    "residuals": _residual_figure,
    "residuals-along": _along_figure,
    "check-points": _check_figure,
}
