"""Checks of paper 003 (Mo et al. 2015) over simulated campaigns with seven test fields, with figures and tables.

A campaign calibrates the camera in orbit from passes over the fields. The checks cover the quality of orbit and
attitude, the stability of the calibration, Tables 6 and 7, the schemes of parameters (which fields share parameters),
and the accuracy for maps of 1:50 000.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from analysis.arrays import ARCSEC
from analysis.orbit.forward_intersection import third_difference
from analysis.orbit.planes import height_error
from analysis.orbit.three_line_model import BIAS, INTERIOR
from analysis.statistics import rms
from optics.numerics.backend import one_blas_thread
from scenes.specs.orbit.angle import LINES
from scenes.specs.orbit.setup import CalibrationSetup
from twin.framework.artefact import Cell
from twin.framework.procedure import stream
from twin.framework.svg import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, SKY, VERMILION
from twin.orbit.calibration.calibration_run import source_of
from twin.orbit.calibration.campaign import Campaign, FieldPass
from twin.orbit.calibration.campaign_adjustment import LatitudeFit, calibrated_alone, fit_latitude
from twin.orbit.calibration.schemes import check_point_errors, laboratory_errors, scheme_errors, values_of
from twin.validation.check import SIGMAS, CheckResult, Chosen, Supposed, mean_of, median_of
from twin.validation.group import Context, drawing, group_of
from twin.validation.paper_003.model import FIELDS, all_errors, changed, setup_of, without_light

FULL, FAST = 150, 24
"""Numbers of simulated campaigns in a full and in a fast run of the checks."""
SCHEMES = {
    1: "Beijing",
    2: "Beijing and Anhui",
    3: "Beijing, Anhui, Xinjiang, Chongqing",
    4: "six fields, all but Jiangxi",
    5: "each field its own",
}
INNER = tuple(f"{line} {part}" for line in LINES for part in INTERIOR)
"""Names of the unknowns of the interior orientation, ordered by line."""
MEDIAN = float(np.sqrt(np.pi / 2.0))
"""Ratio of a median's standard deviation to that of a mean, for normal noise and many samples."""
SLOW = 1.5 * ARCSEC, 10.0
"""Slow attitude errors for a test of third differences: sigma of a value, radians, and time between values, seconds."""
_EDGE = 1e-9
_SIGNIFICANT = 3.0
_QUARTILE = 0.6745
"""Distance between the median and a quartile of a normal distribution, in sigmas."""
_COLOURS = (BLUE, ORANGE, GREEN, VERMILION, PURPLE, SKY, INK)
_MARKERS = "osD^vPX"
_CURVES = 40


@dataclass(frozen=True, eq=False)
class Flights:
    """Results of N campaigns over K fields with S schemes of calibration parameters.

    A scheme says from which fields a field's parameters come. The last scheme lets each field use its own parameters.

    Attributes
    ----------
    fields : tuple[str, ...]
        Names of the fields.
    latitude : np.ndarray
        (K,) latitudes of the fields, radians.
    bias, bias_sigma, true_bias : np.ndarray
        (N, K, 3) attitude bias of each field calibrated by itself, its sigma and true value, radians; roll, pitch, yaw.
    interior, interior_sigma : np.ndarray
        (N, K, 9) elements of the interior orientation in the order of INNER, metres; sigma 0 where held fixed.
    plan, height : np.ndarray
        (N, S, K) RMS at check points without ground control, metres.
    plan_before, height_before : np.ndarray
        (N, K) RMS at check points with the laboratory calibration of the camera, metres.
    plan_floor, height_floor : np.ndarray
        (N, K) RMS with the true camera and the true bias, metres: the check points' own noise.
    expected : np.ndarray
        (N, S, K) RMS in plan that follows from the true biases of the fields in each scheme, metres.
    fits : tuple[tuple[LatitudeFit, ...], ...]
        Campaign -> fits of roll, pitch, yaw against latitude, from the estimated biases.
    true_amplitude, true_significance : np.ndarray
        (N, 3) amplitude of these fits to the true biases, by unweighted least squares, radians, and its ratio to its
        standard deviation.
    """

    fields: tuple[str, ...]
    latitude: np.ndarray
    bias: np.ndarray
    bias_sigma: np.ndarray
    true_bias: np.ndarray
    interior: np.ndarray
    interior_sigma: np.ndarray
    plan: np.ndarray
    height: np.ndarray
    plan_before: np.ndarray
    height_before: np.ndarray
    plan_floor: np.ndarray
    height_floor: np.ndarray
    expected: np.ndarray
    fits: tuple[tuple[LatitudeFit, ...], ...]
    true_amplitude: np.ndarray
    true_significance: np.ndarray

    @property
    def count(self) -> int:
        """Number of campaigns."""
        return len(self.plan)


def flown(
    setup: CalibrationSetup, seeds: Sequence[np.random.SeedSequence], step: Callable[[int], None]
) -> list[Campaign]:
    """Simulate campaigns whose adjustment treats the noise of each exposure as independent.

    This simplification hardly changes the estimates.
    """
    out = []
    for k, seed in enumerate(seeds):
        step(k)
        out.append(source_of(setup, seed).independent)
    return out


def flights_of(campaigns: Sequence[Campaign]) -> Flights:
    """Calibrate the camera in all campaigns and test it at check points; return the results as arrays."""
    first = campaigns[0]
    names = tuple(p.name for p in first.passes)
    latitude = np.array([p.latitude for p in first.passes])
    rows: dict[str, list[np.ndarray]] = {}
    fits = []
    for campaign in campaigns:
        alone = {p.name: calibrated_alone(campaign, p) for p in campaign.passes}
        schemes, before = scheme_errors(campaign, alone), laboratory_errors(campaign)
        floor = {p.name: check_point_errors(campaign, p, campaign.truth, p.bias) for p in campaign.passes}
        true = np.array([p.bias for p in campaign.passes])
        bias = np.array([alone[n].bias(n) for n in names])
        sigma = np.array([[alone[n].sigma[f"{n} {axis}"] for axis in BIAS] for n in names])
        new = {
            "bias": bias,
            "bias_sigma": sigma,
            "true_bias": true,
            "interior": np.array([[alone[n].value(i) for i in INNER] for n in names]),
            "interior_sigma": np.array([[alone[n].sigma[i] for i in INNER] for n in names]),
            "plan": np.array([values_of(e, "plan_rms") for e in schemes.values()]),
            "height": np.array([values_of(e, "height_rms") for e in schemes.values()]),
            "plan_before": values_of(before, "plan_rms"),
            "height_before": values_of(before, "height_rms"),
            "plan_floor": values_of(floor, "plan_rms"),
            "height_floor": values_of(floor, "height_rms"),
        }
        new["expected"] = _expected(campaign, names, new["plan_floor"])
        new["true_amplitude"], new["true_significance"] = _slopes(latitude, true)
        for key, value in new.items():
            rows.setdefault(key, []).append(value)
        fits.append(tuple(fit_latitude(a, latitude, bias[:, k], np.diag(sigma[:, k] ** 2)) for k, a in enumerate(BIAS)))
    return Flights(
        fields=names, latitude=latitude, fits=tuple(fits), **{key: np.array(value) for key, value in rows.items()}
    )


def _expected(campaign: Campaign, names: tuple[str, ...], floor: np.ndarray) -> np.ndarray:
    """Return the RMS in plan that follows from the true biases, (S, K) for S schemes and K fields, metres.

    It is a field's roll and pitch minus the scheme's mean, times the height of flight, and the noise of the check
    points. Yaw moves the ends of the swath by 0.2 m for 1 arcsec.
    """
    true = {p.name: p.bias for p in campaign.passes}
    above = np.array([_above(p) for p in campaign.passes])
    rows = []
    for scheme in (*campaign.spec.schemes, None):
        mean = {n: np.mean([true[k] for k in (scheme or (n,))], axis=0) for n in names}
        rotation = np.array([np.hypot(*(mean[n] - true[n])[:2]) for n in names])
        rows.append(np.hypot(above * rotation, floor))
    return np.array(rows)


def _slopes(latitude: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the amplitudes of sin(latitude - middle) in the true biases, and their ratios to sigma, (3,) each.

    The biases ``true`` of K fields are (K, 3): roll, pitch, yaw, radians; the amplitudes are in radians.
    """
    reference = 0.5 * (latitude.min() + latitude.max())
    design = np.column_stack([np.sin(latitude - reference), np.ones_like(latitude)])
    best, square, _, _ = np.linalg.lstsq(design, true, rcond=None)
    sigma = np.sqrt(square / (len(latitude) - 2) * np.linalg.inv(design.T @ design)[0, 0])
    return best[0], np.abs(best[0]) / sigma


def _above(field_pass: FieldPass) -> float:
    """Return the height of the flight above the check points, metres."""
    earth = field_pass.data.earth
    flight = float(earth.geodetic(field_pass.trajectory.position(0.0))[2])
    return flight - float(np.mean(earth.geodetic(field_pass.check_ground)[2]))


def lines_of(part: str) -> list[int]:
    """Return the indices in INNER of one element of interior orientation, ``f``, ``x`` or ``y``, for all lines."""
    return [INNER.index(f"{line} {part}") for line in LINES]


@dataclass(frozen=True, eq=False)
class Quality:
    """Quality of orbit and attitude data of the passes of all campaigns.

    All arrays are (N, K, 3) for N campaigns and K fields: metres for the orbit's x, y, z in the Earth-fixed frame,
    radians for roll, pitch, yaw of the attitude relative to the orbital frame.

    Attributes
    ----------
    orbit, attitude : (N, K, 3) ndarray
        RMS of the third differences of the measurements.
    orbit_sigma, attitude_sigma : (N, K, 3) ndarray
        Standard deviation of one measured value that follows from it.
    orbit_error, attitude_error : (N, K, 3) ndarray
        RMS of measured minus true values; for the attitude without its mean over the pass.
    attitude_jump : (N, K, 3) ndarray
        Standard deviation of the independent error of a measured value, from measured minus true values of neighbouring
        times.
    """

    orbit: np.ndarray
    attitude: np.ndarray
    orbit_sigma: np.ndarray
    attitude_sigma: np.ndarray
    orbit_error: np.ndarray
    attitude_error: np.ndarray
    attitude_jump: np.ndarray


def quality_of(setup: CalibrationSetup, campaigns: Sequence[Campaign]) -> Quality:
    """Return the third differences of orbit and attitude of every pass, and the true errors for comparison."""
    rows = [[_pass(setup, p) for p in campaign.passes] for campaign in campaigns]
    return Quality(*(np.array([[p[k] for p in row] for row in rows]) for k in range(7)))


def _pass(setup: CalibrationSetup, field_pass: FieldPass) -> tuple[np.ndarray, ...]:
    errors, measured, true = setup.test.errors, field_pass.measured, field_pass.trajectory
    fixes, looks = (
        _readings(measured.first, measured.last, v) for v in (errors.gps.interval, errors.star_tracker.interval)
    )
    position, rotation = measured.position(fixes), measured.body_to_itrs(looks)
    frame = np.swapaxes(true.orbital_to_itrs(looks), 1, 2)
    orbit = third_difference(fixes, position)
    attitude = third_difference(looks, Rotation.from_matrix(frame @ rotation).as_rotvec())
    away = position - true.position(fixes)
    error = Rotation.from_matrix(np.swapaxes(true.body_to_itrs(looks), 1, 2) @ rotation).as_rotvec()
    error = error - error.mean(axis=0)
    # two readings apart by one step: what is slow cancels, white noise counts twice
    jump = np.sqrt(0.5 * np.mean(np.diff(error, axis=0) ** 2, axis=0))
    rms = (np.sqrt(np.mean(v**2, axis=0)) for v in (away, error))
    return orbit.rms, attitude.rms, orbit.white_sigma, attitude.white_sigma, *rms, jump


def _readings(first: float, last: float, interval: float) -> np.ndarray:
    """Return the times, in seconds, of orbit or attitude measurements inside a time span."""
    return interval * np.arange(np.ceil(first / interval - _EDGE), np.floor(last / interval + _EDGE) + 1.0)


def _quality(context: Context, campaigns: Sequence[Campaign], setup: CalibrationSetup) -> Iterator[CheckResult]:
    quality = quality_of(setup, campaigns)
    errors, passes = setup.test.errors, quality.orbit.shape[0] * quality.orbit.shape[1]
    facts: dict[str, Any] = {"simulated": quality, "passes": passes, "campaigns": campaigns}
    worst, sigma = median_of(
        np.max([v.max(axis=1) / v.min(axis=1) for v in (quality.orbit, quality.attitude)], axis=(0, 2))
    )
    inputs = [Chosen.power("noise of the worst field over that of the best, times", 1.0, "1", worst)]
    yield context.row("003.table2", worst, sigma, 10.0, inputs=inputs, **facts)
    ratio = quality.attitude_sigma / quality.attitude_jump
    yield context.row("003.table2.white", np.mean(ratio), np.std(ratio) / np.sqrt(ratio.size), 1.0, **facts)
    noise, drift = rms(errors.gps.noise), rms(errors.gps.drift)
    implied, true = rms(quality.orbit_sigma), rms(quality.orbit_error)
    # the slow error hardly changes during a pass: one value each
    sigma = implied / true / float(np.sqrt(2.0 * quality.orbit_error.size))
    facts |= {"implied_m": implied, "true": true, "noise": noise, "drift": drift}
    explained = [noise / float(np.hypot(noise, drift))]
    yield context.row("003.table2.orbit", implied / true, sigma, 1.0, explained, **facts)
    if "003.table2.equal" in context.selected:
        sigma_of, interval = SLOW
        slow = errors.star_tracker.slow.model_copy(update={"noise": (sigma_of,) * 3, "interval": interval})
        tracker = errors.star_tracker.model_copy(update={"slow": slow})
        worse = changed(setup, errors=errors.model_copy(update={"star_tracker": tracker}))
        seed = np.random.SeedSequence(context.seed, spawn_key=(3, 4))
        again = quality_of(worse, [source_of(worse, seed)])
        truth = rms(again.attitude_error) / rms(quality.attitude_error)
        shown = again.attitude_sigma / rms(quality.attitude_sigma)
        sigma = np.std(shown) / np.sqrt(shown.size)
        yield context.row("003.table2.equal", float(np.mean(shown)), sigma, truth, [1.0], slow=SLOW, truth=truth)


def _biases(context: Context, flights: Flights) -> Iterator[CheckResult]:
    scatter = flights.bias.std(axis=1, ddof=1) / ARCSEC
    true = flights.true_bias.std(axis=1, ddof=1)
    error = flights.bias - flights.true_bias
    for k, axis in enumerate(BIAS):
        value, sigma = median_of(scatter[:, k])
        facts: dict[str, Any] = {"true": true[:, k], "claimed": flights.bias_sigma[:, :, k], "error": error[:, :, k]}
        row = f"003.table3.{axis}"
        yield context.row(row, value, sigma, inputs=[all_errors(value)], flights=flights, **facts)
    value, sigma = median_of(np.sqrt(np.mean(error[:, :, :2] ** 2, axis=(1, 2))) / ARCSEC)
    ratio = rms(error[:, :, :2] / flights.bias_sigma[:, :, :2])
    yield context.row("003.table3.truth", value, sigma, inputs=[all_errors(value)], flights=flights, ratio=ratio)
    significance = np.array([[abs(f.amplitude) / f.amplitude_sigma for f in row[:2]] for row in flights.fits])
    expected = float(np.median(flights.true_significance[:, :2]))
    # quartiles, for few fields make long tails; roll and pitch are drawn apart
    low, value, high = np.percentile(significance, [25.0, 50.0, 75.0])
    sigma = MEDIAN * (high - low) / (2.0 * _QUARTILE) / float(np.sqrt(significance.size))
    facts = {"flights": flights, "percent": 100.0 * np.mean(significance >= _SIGNIFICANT)}
    yield context.row("003.table3.latitude", value, sigma, _SIGNIFICANT, [expected], **facts)


def _slope(context: Context, flights: Flights, number: int, k: int) -> CheckResult:
    amplitude = np.array([row[k].amplitude for row in flights.fits]) / ARCSEC
    true = flights.true_amplitude[:, k] / ARCSEC
    sigmas = [row[k].amplitude_sigma for row in flights.fits]
    facts: dict[str, Any] = {"flights": flights, "predicted": sigmas, "away": amplitude - true}
    return context.row(f"003.fig{number}", amplitude.mean(), mean_of(amplitude - true)[1], true.mean(), **facts)


def _interior(context: Context, flights: Flights, number: int, parts: tuple[str, ...], what: str) -> CheckResult:
    nodes = [i for part in parts for i in lines_of(part) if np.any(flights.interior_sigma[:, :, i])]
    scatter = flights.interior[:, :, nodes].std(axis=1, ddof=1) * 1e6
    claimed = rms(flights.interior_sigma[:, :, nodes] * 1e6)
    each = f"{claimed:.1f} µm"
    if len(parts) > 1:
        by = (rms(flights.interior_sigma[:, :, lines_of(p)[0]]) * 1e6 for p in parts)
        each = " and ".join(f"{v:.1f} µm in {p}" for v, p in zip(by, parts, strict=True))
    value, sigma = median_of(np.sqrt(np.mean(scatter**2, axis=1)))
    facts: dict[str, Any] = {
        "flights": flights,
        "unknowns": nodes,
        "each": each,
        "ratio": rms(scatter) / claimed,
        "what": what,
    }
    return context.row(f"003.table{number}", value, sigma, inputs=[all_errors(value)], **facts)


@drawing("paper-003-schemes", 4.6)
def schemes_svg(figure: Figure, flights: Flights, plan: float, height: float) -> None:
    """Draw the RMS in plan and height for each scheme of parameters on logarithmic axes.

    The limits of the map scale are drawn too. Scheme 0 is before calibration.
    """
    panels = figure.subplots(1, 2)
    names = ["0\nlaboratory", "1\n1 field", "2\n2 fields", "3\n4 fields", "4\n6 fields", "5\nits own"]
    for axes, what, limit in zip(panels, ("plan", "height"), (plan, height), strict=True):
        before, table = getattr(flights, f"{what}_before"), getattr(flights, what)
        values = np.concatenate([before[:, None], table], axis=1)
        low, middle, high = np.percentile(values, [5.0, 50.0, 95.0], axis=0)
        for k, name in enumerate(flights.fields):
            position = np.arange(values.shape[1]) + 0.11 * (k - 3)
            bars = np.stack([middle[:, k] - low[:, k], high[:, k] - middle[:, k]])
            style: dict[str, Any] = {"color": _COLOURS[k % 7], "fmt": _MARKERS[k % 7], "ms": 4.5, "lw": 1.1}
            axes.errorbar(position, middle[:, k], bars, label=name, **style)
        axes.axhline(limit, color=GREY, lw=1.0, ls="--")
        axes.text(5.45, limit * 1.04, f"1:50 000, {limit:g} m", color=GREY, ha="right", va="bottom", fontsize=8.5)
        axes.set_yscale("log")
        ticks = (1, 2, 5, 10, 20, 50, 100)
        axes.set_yticks(ticks, [str(t) for t in ticks])
        axes.minorticks_off()
        axes.set_ylim(1.0, 160.0)
        axes.set_xticks(range(len(names)), names)
        axes.set(title=f"RMS in {what} [m]", xlabel="scheme")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)


@drawing("paper-003-latitude", 3.8)
def latitude_svg(figure: Figure, flights: Flights) -> None:
    """Draw roll, pitch and yaw biases over latitude: estimates, truth and fits."""
    degrees = np.degrees(flights.latitude)
    span = np.linspace(flights.latitude.min() - 0.03, flights.latitude.max() + 0.03, 61)
    for k, (axes, axis) in enumerate(zip(figure.subplots(1, 3), BIAS, strict=True)):
        fit = flights.fits[0][k]
        for fits in flights.fits[1 : 1 + _CURVES]:
            curve = fits[k].curve(span) - fits[k].constant + fit.constant
            axes.plot(np.degrees(span), curve / ARCSEC, color=GREY, lw=0.5, alpha=0.35)
        axes.plot(np.degrees(span), fit.curve(span) / ARCSEC, color=VERMILION, lw=1.5, label="fit")
        axes.plot(degrees, flights.true_bias[0, :, k] / ARCSEC, "x", color=INK, ms=6, label="truth", zorder=4)
        axes.errorbar(
            degrees, flights.bias[0, :, k] / ARCSEC, flights.bias_sigma[0, :, k] / ARCSEC,
            fmt="o", color=BLUE, ms=4.5, lw=1.2, capsize=2, label="estimated, 1σ",
        )  # fmt: skip
        axes.set(title=f"{axis} [arcsec]", xlabel="latitude [deg]")
        handles = axes.get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=3)


@one_blas_thread()
def run(context: Context) -> Iterator[CheckResult]:
    """Yield the results of the checks over campaigns: simulate, calibrate and test.

    Image points get random errors, whose size the check 003.model.points justifies.
    """
    setup = without_light(setup_of(FIELDS))
    count = context.count(FULL, FAST)
    seed = np.random.SeedSequence(context.seed, spawn_key=(3, 2))

    def step(done: int) -> None:
        context.progress(0.6 * done / count, f"fly campaign {done + 1} of {count}")

    campaigns = flown(setup, [stream(seed, k) for k in range(count)], step)
    context.progress(0.6, "calibrate and test")
    flights = flights_of(campaigns)
    if context.wants("003.table2"):
        yield from _quality(context, campaigns, setup)
    yield from _biases(context, flights)
    for number, k in ((4, 0), (5, 1), (6, 2)):
        yield _slope(context, flights, number, k)
    yield _interior(context, flights, 4, ("x", "y"), "principal points")
    yield _interior(context, flights, 5, ("f",), "principal distances")
    yield from _schemes(context, flights, setup)
    yield from _findings(context, flights)
    limits = setup.test.limits
    if context.wants("003.before", "003.scale50000", *(f"003.scheme{k}" for k in SCHEMES)):
        context.figure("schemes", schemes_svg(flights, limits.plan, limits.height))
        _show_accuracy(context, flights)
    if context.wants("003.table3", "003.fig4", "003.fig5", "003.fig6"):
        context.figure("latitude", latitude_svg(flights))
        _show_biases(context, flights)


def _schemes(context: Context, flights: Flights, setup: CalibrationSetup) -> Iterator[CheckResult]:
    """Check the accuracy in plan and height of each scheme against the limits of 1:50 000, and before calibration."""
    for k in SCHEMES:
        fields, expected = flights.plan[:, k - 1], flights.expected[:, k - 1]
        value = float(np.median(fields.mean(axis=1)))
        # the same draws are in both: only their difference counts
        sigma = median_of((fields - expected).mean(axis=1))[1]
        medians = dict(zip(flights.fields, np.median(fields, axis=0), strict=True))
        facts: dict[str, Any] = {"flights": flights, "medians": medians, "means": fields.mean(axis=1)}
        facts["spread"] = np.std(facts["means"])
        yield context.row(f"003.scheme{k}.plan", value, sigma, float(np.median(expected.mean(axis=1))), **facts)
    height = flights.height.mean(axis=2)
    value, sigma = median_of(height[:, 0] / flights.height_floor.mean(axis=1))
    yield context.row("003.scheme1.height", value, sigma, 1.0, flights=flights, height=height[:, 0])
    for k in (2, 3, 4, 5):
        value, sigma = median_of(height[:, k - 1] / height[:, 0])
        row = f"003.scheme{k}.height"
        # what an interior of its own in every field would add to the heights in square
        largest = 1.0 + context.check(row).tolerance + SIGMAS * sigma
        more = 1e6 * np.sqrt(largest**2 - 1.0) * float(np.median(height[:, 0])) / _per_shift(setup)
        limit = f"holds while x of the forward line wanders by up to {more:.2g} µm"
        inputs = [Supposed("one interior for all fields", limit)]
        yield context.row(row, value, sigma, 1.0, inputs=inputs, flights=flights, height=height[:, k - 1])
    for what in ("plan", "height"):
        limit, table = getattr(setup.test.limits, what), getattr(flights, what)
        met = 100.0 * np.all(table <= limit, axis=2).mean(axis=0)
        value, sigma = median_of(table[:, 3].max(axis=1))
        facts = {"flights": flights, "limit": limit, "met": [f"{share:.0f} %" for share in met]}
        row = f"003.scale50000.{what}"
        yield context.row(row, value, sigma, limit, inputs=[all_errors(value)], **facts)
        value, sigma = median_of(getattr(flights, f"{what}_before").mean(axis=1))
        launch = [Chosen.power("what the launch changes, times", 1.0, "1", value)]
        yield context.row(f"003.before.{what}", value, sigma, inputs=launch, flights=flights)


def _per_shift(setup: CalibrationSetup) -> float:
    """Return the error of a height per shift of the forward line's image along the track, metres per metre.

    Points on flat ground are intersected from the forward and the backward line.
    """
    line = setup.camera.lines["forward"]
    rotation = np.cos(line.look) ** 2 / line.principal_distance
    return float(height_error(rotation, setup.test.altitude / np.cos(line.look), 2.0 * line.look, line.look))


def _varied(measured: float, flights: Flights, statistic: Callable[[np.ndarray], np.ndarray]) -> Chosen:
    """Return the variation of the biases between the fields as an input that the paper does not print.

    A factor on it scales the RMS in plan that follows from the true biases, (N, S, K) for N campaigns, S schemes and K
    fields; the response is the median of a statistic, (N,).
    """
    floor = flights.plan_floor[:, None, :]
    rotation_part = np.sqrt(np.maximum(flights.expected**2 - floor**2, 0.0))

    def implied(factor: float) -> float:
        return float(np.median(statistic(np.hypot(factor * rotation_part, floor))))

    name = "variation of the biases between the fields, times"
    return Chosen(name, 1.0, "1", lambda factor: measured * implied(factor) / implied(1.0))


def _span(values: np.ndarray) -> np.ndarray:
    """Return the ratio of the largest to the smallest of K values in each of N campaigns, (N,)."""
    return np.asarray(values.max(axis=1) / values.min(axis=1))


def _findings(context: Context, flights: Flights) -> Iterator[CheckResult]:
    """Check the paper's statements about the schemes of parameters by statistics of the RMS in plan."""
    plan = flights.plan
    # of RMS (N, S, K): scatter over the fields by one scheme over that by six fields; largest over smallest and mean by
    # six fields over those by one; the same of the field that is in no mean
    statistics: dict[str, tuple[Callable[[np.ndarray], np.ndarray], float]] = {
        "scheme1.uneven": (lambda plan: plan[:, 0].std(axis=1) / plan[:, 3].std(axis=1), 1.0),
        "scheme2.uneven": (lambda plan: plan[:, 1].std(axis=1) / plan[:, 3].std(axis=1), 1.0),
        "scheme4.even": (lambda plan: _span(plan[:, 3]) / _span(plan[:, 0]), 1.0),
        "scheme4.improves": (lambda plan: plan[:, 3].mean(axis=1) / plan[:, 0].mean(axis=1), 0.9),
        "scheme4.unseen": (lambda plan: plan[:, 3, -1] / plan[:, 0, -1], 1.0),
    }
    facts: dict[str, Any] = {
        "flights": flights,
        "spread": np.median(plan.std(axis=2), axis=0),
        "ratio": np.median(plan.max(axis=2) / plan.min(axis=2), axis=0),
        "steps": np.median(plan.mean(axis=2), axis=0),
        "unobserved": np.median(plan[:, :, -1], axis=0),
    }
    for name, (statistic, implied) in statistics.items():
        values = statistic(plan)
        value, sigma = median_of(values)
        more = values > 1.0 if name.endswith("uneven") else values < 1.0
        share = f"{int(np.sum(more))} of {len(values)}"
        inputs = [_varied(value, flights, statistic)]
        yield context.row(f"003.{name}", value, sigma, implied, (), inputs, values=values, share=share, **facts)


def _show_accuracy(context: Context, flights: Flights) -> None:
    rows: list[list[Cell]] = []
    for k, scheme in SCHEMES.items():
        for what, values in (("plan", flights.plan[:, k - 1]), ("height", flights.height[:, k - 1])):
            fields = (float(v) for v in np.median(values, axis=0))
            rows.append([f"{k}, {scheme}", what, *fields, float(np.median(values.mean(axis=1)))])
    context.table("accuracy", rows)


def _show_biases(context: Context, flights: Flights) -> None:
    rows: list[list[Cell]] = []
    for k, name in enumerate(flights.fields):
        pairs = np.stack([flights.bias[0, k], flights.true_bias[0, k]], axis=1) / ARCSEC
        rows.append([name, float(np.degrees(flights.latitude[k])), *pairs.ravel().tolist()])
    context.table("biases", rows)


GROUP = group_of("003.fields", run)
