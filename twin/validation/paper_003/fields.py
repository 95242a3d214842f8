"""The group of paper 003's checks over test fields: schemes, repeatability, accuracy, with figures and tables."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from analysis.orbit.three_line_model import BIAS
from analysis.units import ARCSEC
from optics.numerics.threads import one_blas_thread
from twin.run.artefact import Cell, SvgFigure, Table
from twin.run.random_streams import stream
from twin.run.svg import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, SKY, VERMILION, look, new_figure, plain_axes, to_svg
from twin.validation.checks.check import CheckResult
from twin.validation.checks.group import Context
from twin.validation.checks.printed import group_of
from twin.validation.paper_003 import field_schemes, stability
from twin.validation.paper_003 import flights as flown_fields
from twin.validation.paper_003.exact import FIELDS, setup_of, without_light
from twin.validation.paper_003.flights import Flights

_COLOURS = (BLUE, ORANGE, GREEN, VERMILION, PURPLE, SKY, INK)
_MARKERS = "osD^vPX"
_CURVES = 40
FULL, FAST = 150, 24
"""Campaigns."""


def schemes_svg(found: Flights, plan: float, height: float) -> str:
    """RMS in plan and height, scheme 0 being before calibration, on logarithmic axes with the limits."""
    with look("paper-003-schemes"):
        figure = new_figure(4.6)
        panels = figure.subplots(1, 2)
        names = ["0\nlaboratory", "1\n1 field", "2\n2 fields", "3\n4 fields", "4\n6 fields", "5\nits own"]
        for axes, what, limit in zip(panels, ("plan", "height"), (plan, height), strict=True):
            before, table = getattr(found, f"{what}_before"), getattr(found, what)
            values = np.concatenate([before[:, None], table], axis=1)
            low, middle, high = np.percentile(values, [5.0, 50.0, 95.0], axis=0)
            for k, name in enumerate(found.fields):
                place = np.arange(values.shape[1]) + 0.11 * (k - 3)
                bars = np.stack([middle[:, k] - low[:, k], high[:, k] - middle[:, k]])
                style = {"color": _COLOURS[k % 7], "fmt": _MARKERS[k % 7], "ms": 4.5, "lw": 1.1}
                axes.errorbar(place, middle[:, k], bars, label=name, **style)
            axes.axhline(limit, color=GREY, lw=1.0, ls="--")
            axes.text(5.45, limit * 1.04, f"1:50 000, {limit:g} m", color=GREY, ha="right", va="bottom", fontsize=8.5)
            axes.set_yscale("log")
            ticks = (1, 2, 5, 10, 20, 50, 100)
            axes.set_yticks(ticks, [str(t) for t in ticks])
            axes.minorticks_off()
            axes.set_ylim(1.0, 160.0)
            axes.set_xticks(range(len(names)), names)
            axes.set(title=f"RMS in {what} [m]", xlabel="scheme")
            plain_axes(axes)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
        return to_svg(figure)


def latitude_svg(found: Flights) -> str:
    """Three angles: estimates, truth and fits."""
    with look("paper-003-latitude"):
        figure = new_figure(3.8)
        degrees = np.degrees(found.latitude)
        reach = np.linspace(found.latitude.min() - 0.03, found.latitude.max() + 0.03, 61)
        for k, (axes, axis) in enumerate(zip(figure.subplots(1, 3), BIAS, strict=True)):
            one = found.fits[0][k]
            for fits in found.fits[1 : 1 + _CURVES]:
                curve = fits[k].curve(reach) - fits[k].constant + one.constant
                axes.plot(np.degrees(reach), curve / ARCSEC, color=GREY, lw=0.5, alpha=0.35)
            axes.plot(np.degrees(reach), one.curve(reach) / ARCSEC, color=VERMILION, lw=1.5, label="fit")
            axes.plot(degrees, found.true_bias[0, :, k] / ARCSEC, "x", color=INK, ms=6, label="truth", zorder=4)
            axes.errorbar(
                degrees, found.bias[0, :, k] / ARCSEC, found.bias_sigma[0, :, k] / ARCSEC,
                fmt="o", color=BLUE, ms=4.5, lw=1.2, capsize=2, label="estimated, 1σ",
            )  # fmt: skip
            axes.set(title=f"{axis} [arcsec]", xlabel="latitude [deg]")
            plain_axes(axes)
            handles = axes.get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=3)
        return to_svg(figure)


@one_blas_thread()
def run(context: Context) -> Iterator[CheckResult]:
    """Fly, calibrate, test; drawn image points, whose noise 003.model.points justifies."""
    setup = without_light(setup_of(FIELDS))
    count = context.count(FULL, FAST)
    seed = np.random.SeedSequence(context.seed, spawn_key=(3, 2))

    def step(done: int) -> None:
        context.progress(0.6 * done / count, f"fly campaign {done + 1} of {count}")

    campaigns = flown_fields.flown(setup, [stream(seed, k) for k in range(count)], step)
    context.progress(0.6, "calibrate and test")
    found = flown_fields.flights_of(campaigns)
    yield from stability.results(context, campaigns, found, setup)
    yield from field_schemes.results(context, found, setup)
    limits = setup.test.limits
    if context.wants("003.before", "003.scale50000", *(f"003.scheme{k}" for k in field_schemes.NAMES)):
        context.add(
            SvgFigure(
                "schemes",
                "Accuracy without ground control by scheme and field",
                "RMS at check points: marks are medians over the campaigns, bars hold the middle 90 % of them. "
                "Scheme 0 is the laboratory's camera.",
                schemes_svg(found, limits.plan, limits.height),
            )
        )
        context.add(_table(found))
    if context.wants("003.table3", "003.fig4", "003.fig5", "003.fig6"):
        context.add(
            SvgFigure(
                "latitude",
                "Attitude biases over latitude",
                "Estimates of the first campaign, each field by itself, with 1 sigma; grey: slopes of other "
                "campaigns, drawn through the middle of the first one's fit.",
                latitude_svg(found),
            )
        )
        context.add(_bias_table(found))


def _table(found: Flights) -> Table:
    rows: list[list[Cell]] = []
    for k, scheme in field_schemes.NAMES.items():
        for what, values in (("plan", found.plan[:, k - 1]), ("height", found.height[:, k - 1])):
            fields = (float(v) for v in np.median(values, axis=0))
            rows.append([f"{k}, {scheme}", what, *fields, float(np.median(values.mean(axis=1)))])
    return Table(
        "accuracy",
        "In place of Tables 6 and 7: RMS at check points, medians over the campaigns, metres",
        "Without ground control.",
        ("scheme", "", *found.fields, "mean"),
        rows,
        (None, None, *[2] * (len(found.fields) + 1)),
    )


def _bias_table(found: Flights) -> Table:
    rows: list[list[Cell]] = []
    for k, name in enumerate(found.fields):
        values, true = found.bias[0, k] / ARCSEC, found.true_bias[0, k] / ARCSEC
        cells = (float(v) for pair in zip(values, true, strict=True) for v in pair)
        rows.append([name, float(np.degrees(found.latitude[k])), *cells])
    return Table(
        "biases",
        "In place of Table 3: biases of the first campaign, arcsec",
        "Each field calibrated by itself, and the truth.",
        ("field", "latitude [deg]", "roll", "true", "pitch", "true", "yaw", "true"),
        rows,
        (None, 1, *[2] * 6),
    )


GROUP = group_of("003.fields", run)
