"""Checks of paper 000's Table 1, planes against resection, with their figure."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import ARCSEC, Array
from analysis.orbit.planes import Station, intersection_angles
from optics.numerics.backend import one_blas_thread
from scenes.specs.orbit.angle import LINES
from twin.orbit.angle.angle_flight import Measurement
from twin.orbit.angle.angle_run import effect_rows, values_of
from twin.run.svg import BLUE, INK, LIGHT, ORANGE, VERMILION, look, new_figure, plain_axes, to_svg
from twin.validation.checks.check import SIGMAS, CheckResult, Chosen
from twin.validation.checks.group import Context, group_of, load_printed
from twin.validation.paper_000.passes import PAIRS, TEST, Passes, planes_of, repeated, setup_of

PRINTED_ARCSEC = load_printed("000").numbers("table1.difference_arcsec")
ALPHA, BETA = PRINTED_ARCSEC["alpha"], PRINTED_ARCSEC["beta"]
POINT_SIGMA = float(np.hypot(2.0, 5.0 / 3.0))
"""Metres: control points of 2 m, matched to a third of a pixel of 5 m."""

POINTS = float(setup_of(TEST).test.strips.points)
"""On each line."""

LIMIT = 3.44
"""Distance in two dimensions that 99.7 % keep, as three standard deviations in one."""


def differences_svg(same: NDArray[np.float64], own: NDArray[np.float64], printed: tuple[float, float]) -> str:
    """Scatter of alpha and beta, both (passes, 2), arcsec, and the printed pair."""
    with look("table1-000"):
        figure = new_figure(4.2)
        axes = figure.subplots()
        axes.axhline(0.0, color=LIGHT, lw=0.8, zorder=0)
        axes.axvline(0.0, color=LIGHT, lw=0.8, zorder=0)
        axes.plot(
            *own.T, "o", color=ORANGE, ms=3.5, mew=0, alpha=0.7, label="points of their own, light left in planes"
        )
        axes.plot(*same.T, "s", color=BLUE, ms=3.0, mew=0, label="same points, light corrected in both")
        axes.plot(
            *printed, "D", color=VERMILION, ms=8, mec=INK, mew=0.8, label=f"printed: {printed[0]}″, {printed[1]}″"
        )
        axes.plot(*(-v for v in printed), "D", color="none", ms=8, mec=VERMILION, mew=1.4, label="printed, other sign")
        axes.set_aspect("equal")
        axes.set(xlabel="α: resection − planes, arcsec", ylabel="β: resection − planes, arcsec")
        axes.set(xlim=(-2.0, 2.0), ylim=(-2.0, 2.3))
        axes.legend(loc="center left", bbox_to_anchor=(1.02, 0.5))
        plain_axes(axes)
        return to_svg(figure)


@dataclass(frozen=True, eq=False)
class Differences:
    """Resection minus planes, (passes, 2) of alpha and beta, arcsec; and the sigma that both methods claim, (2,)."""

    values: Array
    planes_sigma: Array
    resection_sigma: Array

    @property
    def spread(self) -> Array:
        """Standard deviation, (2,)."""
        return np.asarray(np.std(self.values, axis=0, ddof=1))


def differences(planes: Passes, resection: Passes) -> Differences:
    """Both methods on measurements that may be the same."""
    by_planes = [intersection_angles(*planes_of(m, "tls")) for m in planes.measured]
    found = np.array([section.angles(PAIRS) for section in resection.sections])
    claimed = [section.angle_covariance(PAIRS) for section in resection.sections]
    return Differences(
        (found - np.array([a.values for a in by_planes])) / ARCSEC,
        np.sqrt(np.mean([np.diag(a.covariance) for a in by_planes], axis=0)) / ARCSEC,
        np.sqrt(np.mean([np.diag(c) for c in claimed], axis=0)) / ARCSEC,
    )


@dataclass(frozen=True, eq=False)
class Data:
    """Measurements for the table.

    Attributes:
        same: of points of 1.5 m, light taken out.
        own: of `POINT_SIGMA`, light taken out, with which the resection works.
        light: others with the same stations and the light left in, with which the planes work.
    """

    same: Passes
    own: Passes
    light: Passes


def make_data(context: Context) -> Data:
    """Draw all measurements."""
    count = context.count(full=800, fast=120)
    first, second, third = np.random.SeedSequence([context.seed, 5]).spawn(3)
    setup = setup_of(TEST, points=POINT_SIGMA)
    own = repeated(setup, second, count)
    repeats = repeated(setup, third, count, corrected=False)
    # one precise orbit for both methods
    moved = tuple(_at(m, o.station.position) for m, o in zip(repeats.measured, own.measured, strict=True))
    return Data(repeated(setup_of(TEST), first, count), own, Passes(repeats.flight, moved))


def _at(measured: Measurement, position: Array) -> Measurement:
    return replace(measured, station=replace(measured.station, position=position))


@one_blas_thread()
def run(context: Context) -> Iterator[CheckResult]:
    """All checks of the group."""
    context.progress(0.1, "measure ground points for both methods")
    data = make_data(context)
    same, own = differences(data.same, data.same), differences(data.light, data.own)
    yield from _same(context, data, same)
    yield from _own(context, data, own)
    yield _pair(context, data, own)
    yield from _accuracy(context, data)
    context.progress(0.9, "draw")
    context.figure(
        "table1",
        "Table 1: resection minus planes",
        f"Points of {POINT_SIGMA:.1f} m for points of their own, of 1.5 m for the same points. Table 1 does not "
        "say which angle is subtracted; the sign here is that of Figs. 3 to 5.",
        differences_svg(same.values, own.values, (ALPHA, BETA)),
    )


def _same(context: Context, data: Data, same: Differences) -> Iterator[CheckResult]:
    count = len(same.values)
    for k, (name, printed) in enumerate(PRINTED_ARCSEC.items()):
        identifier = f"000.table1.{name}"
        sigma = float(same.spread[k])
        variance = same.planes_sigma[k] ** 2 - same.resection_sigma[k] ** 2
        how = (
            f"{count} measurements of a pass of th1, 60 points a line, errors of 1.5 m in the points and 0.5 m in the "
            f"station; both methods on each. They scatter by {same.planes_sigma[k]:.3f}″ and "
            f"{same.resection_sigma[k]:.3f}″, but together: Table 1's {printed:g}″ would be {printed / sigma:.0f} "
            "standard deviations, so its two methods had data or models that differ, see the rows _own."
        )
        noise = sigma / np.sqrt(2.0 * (count - 1))
        yield context.check(identifier).evaluate(sigma, noise, how, float(np.sqrt(max(variance, 0.0))))


def _own(context: Context, data: Data, own: Differences) -> Iterator[CheckResult]:
    count = len(own.values)
    for k, name in enumerate(PRINTED_ARCSEC):
        identifier = f"000.table1.{name}_own"
        bias, spread = float(np.mean(own.values[:, k])), float(own.spread[k])
        noise = spread * np.sqrt(1.0 / count + SIGMAS**2 / (2.0 * (count - 1)))
        how = (
            f"{count} pairs of measurements, points of {POINT_SIGMA:.1f} m (2 m of triangulation, a third of a 5 m "
            f"pixel of matching), one orbit for both. Resection minus planes is {bias:+.2f}″ ± {spread:.2f}″, the bias "
            "from aberration and refraction, which only the resection takes out. How many points the paper has, and "
            "whether the two methods share them, is not printed."
        )
        reach = partial(_reach, abs(bias), SIGMAS * spread)
        yield context.check(identifier).evaluate(reach(1.0), noise, how, inputs=_points(reach))


def _reach(bias: float, spread: float, factor: float) -> float:
    return bias + factor * spread


def _rms(bias: float, spread: float, factor: float) -> float:
    return float(np.hypot(bias, factor * spread))


def _points(response: Callable[[float], float]) -> list[Chosen]:
    """The ground points, on which the scatter of an angle hangs; response: of what is measured to a factor on that."""
    return [
        Chosen("error of a point", POINT_SIGMA, "m", response),
        Chosen("points on a line", POINTS, "1", lambda factor: response(factor**-0.5)),
    ]


def _pair(context: Context, data: Data, own: Differences) -> CheckResult:
    """Both angles have the nadir plane: what makes one larger makes the other smaller."""
    measured, flight = data.light.measured[0], data.light.flight
    # the station is common and drops out, the points of the two methods are not
    exact = replace(measured, station=Station.of(measured.station.position))
    covariance = 2.0 * intersection_angles(*planes_of(exact, "tls")).covariance / ARCSEC**2
    bias = -next(row.bias for row in effect_rows(flight) if row.what == "all") / ARCSEC
    together = _distance(np.array([ALPHA, BETA]) - bias, covariance)
    apart = _distance(np.array([-ALPHA, BETA]) - bias, covariance)
    distance = _distance(np.array([ALPHA, BETA]) - np.mean(own.values, axis=0), np.cov(own.values.T))
    forward, nadir, backward = (_pitch_variance(data.light, line) for line in LINES)
    simple = np.array([[forward + nadir, -nadir], [-nadir, nadir + backward]])
    how = (
        "By propagation of the points' errors and the exact effects on the light, as for the rows _own; correlation "
        f"{covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]):+.2f}. By the spread of "
        f"{len(own.values)} pairs of measurements it is {distance:.1f}. With opposite signs, −{ALPHA}″ and {BETA}″, it "
        f"is {apart:.1f}; {LIMIT:.2f} is the limit."
    )
    expected = _distance(np.array([ALPHA, BETA]) - bias, 2.0 * simple)
    return context.check("000.table1.pair").evaluate(together, None, how, LIMIT, [expected])


def _pitch_variance(passes: Passes, line: str) -> float:
    """Variance of the pitch of a plane through n points at their range, arcsec^2."""
    points = passes.points[line]
    reach = float(np.mean(np.linalg.norm(points - passes.flight.station, axis=1)))
    return (passes.flight.spec.errors.points / reach / ARCSEC) ** 2 / len(points)


def _distance(off: Array, covariance: Array) -> float:
    """Mahalanobis distance of a pair."""
    return float(np.sqrt(off @ np.linalg.solve(covariance, off)))


def _accuracy(context: Context, data: Data) -> Iterator[CheckResult]:
    for identifier, passes, light in (
        ("000.accuracy", data.own, "taken out of the points"),
        ("000.accuracy.light", data.light, "left in"),
    ):
        found = np.array([intersection_angles(*planes_of(m, "tls")).values for m in passes.measured])
        off = (found - values_of(passes.flight.dihedral)) / ARCSEC
        rms = np.sqrt(np.mean(off**2, axis=0))
        worst = int(np.argmax(rms))
        mean = np.mean(off, axis=0)
        how = (
            f"{len(off)} measurements, 60 points a line with errors of {POINT_SIGMA:.1f} m, station 0.5 m, aberration "
            f"and refraction {light}: α {mean[0]:+.2f}″ ± {np.std(off[:, 0]):.2f}″, β {mean[1]:+.2f}″ ± "
            f"{np.std(off[:, 1]):.2f}″ from the camera's true angles."
        )
        bias, spread = float(mean[worst]), float(np.std(off[:, worst]))
        noise = spread / float(np.sqrt(len(off)))
        inputs = _points(partial(_rms, bias, spread))
        yield context.check(identifier).evaluate(float(rms[worst]), noise, how, inputs=inputs)


GROUP = group_of("000.table1", run)
