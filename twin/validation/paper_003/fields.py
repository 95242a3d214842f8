"""Paper 003's checks over test fields: quality of orbit and attitude, stability, with figures and tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from analysis.arrays import ARCSEC
from analysis.orbit.forward_intersection import third_difference
from analysis.orbit.three_line_model import BIAS
from optics.numerics.backend import one_blas_thread
from scenes.specs.orbit.setup import CalibrationSetup
from twin.orbit.calibration.calibration_run import source_of
from twin.orbit.calibration.campaign import Campaign, FieldPass
from twin.run.artefact import Cell, Table
from twin.run.random_streams import stream
from twin.run.svg import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, SKY, VERMILION, look, new_figure, plain_axes, to_svg
from twin.validation.checks.check import CheckResult, Chosen, mean_of, median_of
from twin.validation.checks.group import Context, group_of
from twin.validation.paper_003 import flights as flown_fields
from twin.validation.paper_003.exact import FIELDS, all_errors, changed, setup_of, without_light
from twin.validation.paper_003.flights import MEDIAN, Flights, lines_of

_EDGE = 1e-9
SLOW = 1.5 * ARCSEC, 10.0
"""Slow errors of the attitude that third differences are tried on: sigma of a value, seconds between values."""
_SIGNIFICANT = 3.0
_QUARTILE = 0.6745
"""Sigmas from the median of normal noise."""


@dataclass(frozen=True, eq=False)
class Quality:
    """Passes of all campaigns, (N, K, 3): metres for the orbit's x, y, z in the Earth-fixed frame, radians for roll,
    pitch, yaw of the attitude against the orbital frame.

    Attributes:
        orbit, attitude: RMS of the third differences of what is measured.
        orbit_sigma, attitude_sigma: standard deviation of a reading that they imply.
        orbit_error: RMS of measured minus true. attitude_error: of measured against true, less its mean over the pass.
        attitude_jump: standard deviation of a reading's own error, from measured less true of neighbouring readings.
    """

    orbit: np.ndarray
    attitude: np.ndarray
    orbit_sigma: np.ndarray
    attitude_sigma: np.ndarray
    orbit_error: np.ndarray
    attitude_error: np.ndarray
    attitude_jump: np.ndarray


def quality_of(setup: CalibrationSetup, campaigns: Sequence[Campaign]) -> Quality:
    """Third differences of every pass; truth from the true trajectories."""
    rows = [[_pass(setup, p) for p in one.passes] for one in campaigns]
    return Quality(*(np.array([[p[k] for p in row] for row in rows]) for k in range(7)))


def _pass(setup: CalibrationSetup, one: FieldPass) -> tuple[np.ndarray, ...]:
    errors, measured, true = setup.test.errors, one.measured, one.trajectory
    fixes, looks = (
        _readings(measured.first, measured.last, v) for v in (errors.gps.interval, errors.star_tracker.interval)
    )
    place, turn = measured.position(fixes), measured.body_to_itrs(looks)
    frame = np.swapaxes(true.orbital_to_itrs(looks), 1, 2)
    orbit = third_difference(fixes, place)
    attitude = third_difference(looks, Rotation.from_matrix(frame @ turn).as_rotvec())
    away = place - true.position(fixes)
    error = Rotation.from_matrix(np.swapaxes(true.body_to_itrs(looks), 1, 2) @ turn).as_rotvec()
    error = error - error.mean(axis=0)
    # two readings apart by one step: what is slow cancels, white noise counts twice
    jump = np.sqrt(0.5 * np.mean(np.diff(error, axis=0) ** 2, axis=0))
    rms = (np.sqrt(np.mean(v**2, axis=0)) for v in (away, error))
    return orbit.rms, attitude.rms, orbit.white_sigma, attitude.white_sigma, *rms, jump


def _readings(first: float, last: float, interval: float) -> np.ndarray:
    """Times of the readings inside the span, seconds."""
    return interval * np.arange(np.ceil(first / interval - _EDGE), np.floor(last / interval + _EDGE) + 1.0)


def _stability(
    context: Context, campaigns: Sequence[Campaign], flights: Flights, setup: CalibrationSetup
) -> Iterator[CheckResult]:
    """Selected checks."""
    if context.wants("003.table2"):
        yield from _quality(context, campaigns, setup)
    if context.wants("003.table3"):
        yield from _biases(context, flights)
    for number, k in ((4, 0), (5, 1), (6, 2)):
        yield _slope(context, flights, number, k)
    for number, parts, what in ((4, ("x", "y"), "principal points"), (5, ("f",), "principal distances")):
        yield _interior(context, flights, number, parts, what)


def _quality(context: Context, campaigns: Sequence[Campaign], setup: CalibrationSetup) -> Iterator[CheckResult]:
    found = quality_of(setup, campaigns)
    errors, passes = setup.test.errors, found.orbit.shape[0] * found.orbit.shape[1]
    ratios = np.array([v.max(axis=1) / v.min(axis=1) for v in (found.orbit, found.attitude)])
    worst, sigma = median_of(ratios.max(axis=(0, 2)))
    orbit, attitude = (float(np.sqrt(np.mean(v**2))) for v in (found.orbit, found.attitude))
    how = (
        f"{passes} passes of {len(campaigns)} campaigns, measured orbit once a second and attitude eight times; "
        f"third differences of {orbit:.3f} m and {attitude / ARCSEC:.2f}″, RMS. The numbers of Table 2 are lost. "
        "All fields are given the same noise here, so that this is what chance does to seven equal fields."
    )
    noise = Chosen.power("noise of the worst field over that of the best, times", 1.0, "1", worst)
    yield context.check("003.table2").evaluate(worst, sigma, how, 10.0, inputs=[noise])
    ratio = found.attitude_sigma / found.attitude_jump
    how = (
        f"{passes} passes, three axes. True error of a reading, without its mean over the pass and what it shares "
        f"with the next: {float(np.sqrt(np.mean(found.attitude_jump**2))) / ARCSEC:.3f}″. White noise has third "
        "differences of √20 of its sigma."
    )
    yield context.check("003.table2.white").evaluate(
        float(np.mean(ratio)), float(np.std(ratio) / np.sqrt(ratio.size)), how, 1.0
    )
    yield _orbit(context, found.orbit_sigma, found.orbit_error, setup)
    if "003.table2.equal" in context.selected:
        sigma_of, interval = SLOW
        slow = errors.star_tracker.slow.model_copy(update={"noise": (sigma_of,) * 3, "interval": interval})
        tracker = errors.star_tracker.model_copy(update={"slow": slow})
        worse = changed(setup, errors=errors.model_copy(update={"star_tracker": tracker}))
        seed = np.random.SeedSequence(context.seed, spawn_key=(3, 4))
        again = quality_of(worse, [source_of(worse, seed)])
        truth = float(np.sqrt(np.mean(again.attitude_error**2) / np.mean(found.attitude_error**2)))
        shown = again.attitude_sigma / np.sqrt(np.mean(found.attitude_sigma**2))
        how = (
            f"One more campaign whose attitude has slow errors, a spline through values of {sigma_of / ARCSEC:g}″ "
            f"every {interval:g} s. Its attitude is {truth:.2f} times as wrong within a pass. Measured is the ratio "
            "of the third differences."
        )
        yield context.check("003.table2.equal").evaluate(
            float(np.mean(shown)), float(np.std(shown) / np.sqrt(shown.size)), how, truth, [1.0]
        )


def _orbit(context: Context, significance: np.ndarray, error: np.ndarray, setup: CalibrationSetup) -> CheckResult:
    gps = setup.test.errors.gps
    noise, drift = (float(np.sqrt(np.mean(np.square(v)))) for v in (gps.noise, gps.drift))
    implied, true = (float(np.sqrt(np.mean(v**2))) for v in (significance, error))
    passes = error.shape[0] * error.shape[1] * error.shape[2]
    # the slow error hardly changes during a pass: one value each
    sigma = implied / true / float(np.sqrt(2.0 * passes))
    how = (
        f"Third differences say {implied:.3f} m for a position, and the true error is {true:.3f} m, RMS over "
        f"{passes // 3} passes and three axes."
    )
    expected = noise / float(np.hypot(noise, drift))
    return context.check("003.table2.orbit").evaluate(
        implied / true, sigma, how, 1.0, [expected], facts={"noise": noise, "drift": drift}
    )


def _biases(context: Context, flights: Flights) -> Iterator[CheckResult]:
    scatter = flights.bias.std(axis=1, ddof=1) / ARCSEC
    true = flights.true_bias.std(axis=1, ddof=1) / ARCSEC
    claimed = np.sqrt(np.mean(flights.bias_sigma**2, axis=(0, 1))) / ARCSEC
    error = (flights.bias - flights.true_bias) / ARCSEC
    for k, axis in enumerate(BIAS):
        value, sigma = median_of(scatter[:, k])
        rms = float(np.sqrt(np.mean(error[:, :, k] ** 2)))
        how = (
            f"{_campaigns(flights)}. Median of the scatter; that of the true biases is "
            f"{float(np.median(true[:, k])):.2f}″, each field is known to {claimed[k]:.2f}″, and the error is "
            f"{rms:.2f}″, RMS. Seasons of 1″ and thermal amplitudes of 3 to 4″ are assumed."
        )
        if axis == "yaw":
            how += " The scatter is mostly that of the estimate: yaw goes with y of the outer lines."
        yield context.check(f"003.table3.{axis}").evaluate(value, sigma, how, inputs=[all_errors(value)])
    values = np.sqrt(np.mean(error[:, :, :2] ** 2, axis=(1, 2)))
    ratio = float(np.sqrt(np.mean((error[:, :, :2] * ARCSEC / flights.bias_sigma[:, :, :2]) ** 2)))
    how = (
        f"{_campaigns(flights)}. Truth: the turn between measured and true attitude at the middle of each pass. "
        f"{ratio:.1f} times the adjustment's sigmas, for these count neither the orbit's slow error, 0.3 m or "
        "0.12″, nor that readings are shared."
    )
    value, sigma = median_of(values)
    yield context.check("003.table3.truth").evaluate(value, sigma, how, inputs=[all_errors(value)])
    significance = np.array([[abs(f.amplitude) / f.amplitude_sigma for f in row[:2]] for row in flights.fits])
    share = float(np.mean(significance >= _SIGNIFICANT))
    expected = float(np.median(flights.true_significance[:, :2]))
    how = (
        f"{_campaigns(flights)}. Median over campaigns, roll and pitch; a thermal amplitude of 4″ over the sine of "
        f"latitude is there, beside seasons of 1″. {100.0 * share:.0f} % of the slopes reach three sigmas."
    )
    # quartiles, for few fields make long tails; roll and pitch are drawn apart
    low, value, high = np.percentile(significance, [25.0, 50.0, 75.0])
    sigma = MEDIAN * (high - low) / (2.0 * _QUARTILE) / float(np.sqrt(significance.size))
    yield context.check("003.table3.latitude").evaluate(float(value), float(sigma), how, _SIGNIFICANT, [expected])


def _slope(context: Context, flights: Flights, number: int, k: int) -> CheckResult:
    amplitude = np.array([row[k].amplitude for row in flights.fits]) / ARCSEC
    true = flights.true_amplitude[:, k] / ARCSEC
    away = amplitude - true
    sigma = mean_of(away)[1]
    own = float(np.median([row[k].amplitude_sigma for row in flights.fits])) / ARCSEC
    how = (
        f"{_campaigns(flights)}. Mean of the campaigns' amplitudes, each fitted with a constant; implied: the same fit "
        f"of the true biases. A single campaign knows the amplitude to {own:.1f}″ with the season, and its estimates "
        f"scatter by {float(np.std(away, ddof=1)):.1f}″ about that of the true biases. Which figure shows which angle "
        "is not in the text."
    )
    return context.check(f"003.fig{number}").evaluate(float(amplitude.mean()), sigma, how, float(true.mean()))


def _interior(context: Context, flights: Flights, number: int, parts: tuple[str, ...], what: str) -> CheckResult:
    places = [i for part in parts for i in lines_of(part) if np.any(flights.interior_sigma[:, :, i])]
    scatter = flights.interior[:, :, places].std(axis=1, ddof=1) * 1e6
    claimed = flights.interior_sigma[:, :, places] * 1e6
    rms = np.sqrt(np.mean(scatter**2, axis=1))
    ratio = float(np.sqrt(np.mean(scatter**2) / np.mean(claimed**2)))
    each = f"{float(np.sqrt(np.mean(claimed**2))):.1f} µm"
    if len(parts) > 1:
        by = (np.sqrt(np.mean(flights.interior_sigma[:, :, lines_of(p)[0]] ** 2)) * 1e6 for p in parts)
        each = " and ".join(f"{v:.1f} µm in {p}" for v, p in zip(by, parts, strict=True))
    how = (
        f"{_campaigns(flights)}. RMS over {len(places)} unknowns of the scatter over the fields, median of the "
        f"campaigns. The adjustments claim {each}; the scatter is {ratio:.2f} of that, as it must be for an interior "
        f"that is the same in all fields. Which of Tables 4 and 5 holds the {what} is not in the text."
    )
    value, sigma = median_of(rms)
    return context.check(f"003.table{number}").evaluate(value, sigma, how, inputs=[all_errors(value)])


def _campaigns(flights: Flights) -> str:
    return f"{flights.count} campaigns over {len(flights.fields)} fields, 60 control points of 0.3 px in each"


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
    yield from _stability(context, campaigns, found, setup)
    yield from flown_fields.results(context, found, setup)
    limits = setup.test.limits
    if context.wants("003.before", "003.scale50000", *(f"003.scheme{k}" for k in flown_fields.NAMES)):
        context.figure(
            "schemes",
            "Accuracy without ground control by scheme and field",
            "RMS at check points: marks are medians over the campaigns, bars hold the middle 90 % of them. "
            "Scheme 0 is the laboratory's camera.",
            schemes_svg(found, limits.plan, limits.height),
        )
        context.add(_table(found))
    if context.wants("003.table3", "003.fig4", "003.fig5", "003.fig6"):
        context.figure(
            "latitude",
            "Attitude biases over latitude",
            "Estimates of the first campaign, each field by itself, with 1 sigma; grey: slopes of other "
            "campaigns, drawn through the middle of the first one's fit.",
            latitude_svg(found),
        )
        context.add(_bias_table(found))


def _table(found: Flights) -> Table:
    rows: list[list[Cell]] = []
    for k, scheme in flown_fields.NAMES.items():
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
