"""Checks of paper 000's equations."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property

import numpy as np

from analysis.arrays import ARCSEC, Array
from analysis.orbit.planes import NearVerticalWarning, PlaneFit, fit_plane, intersection_angles
from optics.numerics.backend import one_blas_thread
from scenes.specs.orbit.angle import LINES
from twin.orbit.angle.angle_run import values_of
from twin.validation.checks.check import CheckResult, mean_of
from twin.validation.checks.group import Context, group_of
from twin.validation.paper_000.passes import TEST, Passes, planes_of, repeated, setup_of, worst

_STEP = 1e-3
TWIST = np.radians(10.0 / 60.0)
"""How far the forward array is turned about its line of sight for eq6.parallel, radians."""


def sum_of_squares(slopes: Array, points: Array, station: Array) -> float:
    """S of (2) for slopes a0, a1 (2,), with a2 by (1); points (n, 3) and station (3,), metres. Square metres."""
    x, y, z = points.T
    x0, y0, z0 = station
    a0, a1 = slopes
    return float(np.sum((a0 * x + a1 * y + (z0 - a0 * x0 - a1 * y0) - z) ** 2))


def derivatives(slopes: Array, points: Array, station: Array) -> Array:
    """The left sides of (4), (2,), square metres."""
    x, y, z = points.T
    x0, y0, z0 = station
    a0, a1 = slopes
    miss = a0 * x + a1 * y + z0 - a0 * x0 - a1 * y0 - z
    return np.array([np.sum(2.0 * miss * (x - x0)), np.sum(2.0 * miss * (y - y0))])


def numerical_derivatives(slopes: Array, points: Array, station: Array) -> Array:
    """Derivatives of S by central differences, (2,); of a square form they are exact but for rounding."""
    out = []
    for step in _STEP * np.eye(2):
        above, below = (sum_of_squares(slopes + sign * step, points, station) for sign in (1.0, -1.0))
        out.append((above - below) / (2.0 * _STEP))
    return np.array(out)


def least_slopes(points: Array, station: Array) -> Array:
    """The slopes that make S least, (2,): the vertex of a parabola through its values, found twice, as the second time
    it is near and keeps more digits.
    """
    place, size = np.zeros(2), 1.0
    for _ in range(3):
        step = size * np.eye(2)

        def value(shift: Array, place: Array = place) -> float:
            return sum_of_squares(place + shift, points, station)

        middle = value(np.zeros(2))
        up, down = ([value(sign * e) for e in step] for sign in (1.0, -1.0))
        slope = (np.array(up) - np.array(down)) / (2.0 * size)
        curve = np.diag((np.array(up) + np.array(down) - 2.0 * middle) / size**2)
        curve[0, 1] = curve[1, 0] = (value(step[0] + step[1]) - up[0] - up[1] + middle) / size**2
        place, size = place - np.linalg.solve(curve, slope), _STEP
    return place


class Planes:
    """Planes of the three lines of every measurement, fitted when asked for."""

    def __init__(self, passes: Passes) -> None:
        """Over passes."""
        self.passes = passes

    @cached_property
    def corrected(self) -> list[list[PlaneFit]]:
        """By (5) with the right sign, [pass][line]."""
        return [planes_of(m, "corrected") for m in self.passes.measured]

    @cached_property
    def printed(self) -> list[list[PlaneFit]]:
        """By (5) as printed."""
        return [planes_of(m, "printed") for m in self.passes.measured]

    @cached_property
    def angles(self) -> Array:
        """By (6) and (7) from the corrected planes, (passes, 2), radians."""
        return np.array([intersection_angles(*fits).printed for fits in self.corrected])

    @cached_property
    def said(self) -> str:
        """How many there are, for a report."""
        spec = self.passes.flight.spec
        return (
            f"{len(self.passes.measured)} measurements of a pass of th1 on {spec.strips.points} points a line, errors "
            f"of {spec.errors.points:g} m in the points and {spec.errors.station:g} m in the station"
        )


def make_passes(context: Context) -> Passes:
    """Measurements that all checks share."""
    return repeated(setup_of(TEST), np.random.SeedSequence([context.seed, 1]), context.count(full=1000, fast=250))


def twisted_passes(context: Context) -> tuple[Passes, Passes]:
    """Measurements with the forward array turned by ±`TWIST` about its line of sight."""
    look = np.radians(25.0)
    seed = np.random.SeedSequence([context.seed, 2])
    one, other = (
        repeated(
            setup_of(TEST),
            stream,
            context.count(full=300, fast=80),
            turns={"forward": (sign * TWIST * np.sin(look), 0.0, sign * TWIST * np.cos(look))},
        )
        for sign, stream in zip((1.0, -1.0), seed.spawn(2), strict=True)
    )
    return one, other


@one_blas_thread()
def run(context: Context) -> Iterator[CheckResult]:
    """All checks of the group."""
    context.progress(0.0, "measure ground points")
    planes = Planes(make_passes(context))
    checks: Mapping[str, Callable[[Context, Planes], CheckResult]] = {
        "000.eq1": _through_station,
        "000.eq2": _least,
        "000.eq3": _vanishing,
        "000.eq4": _derivatives,
        "000.eq5": _printed_plane,
        "000.eq5.angles": _printed_angles,
        "000.eq5.vertical": _vertical,
        "000.eq6": _alpha,
        "000.eq6.arccos": _arccos,
        "000.eq6.parallel": _parallel,
        "000.eq7": _beta,
    }
    for k, (identifier, check) in enumerate(checks.items()):
        if identifier in context.selected:
            context.progress(0.3 + 0.6 * k / len(checks), identifier)
            yield check(context, planes)


def _through_station(context: Context, planes: Planes) -> CheckResult:
    passes, square, station = planes.passes, [], []
    for m, fits in zip(passes.measured, planes.corrected, strict=True):
        off = []
        for line, fit in zip(LINES, fits, strict=True):
            a = np.array(fit.coefficients)
            length = np.sqrt(1.0 + a[0] ** 2 + a[1] ** 2)
            x, y, z = np.vstack([passes.points[line], m.station.position]).T
            distance = (a[0] * x + a[1] * y + a[2] - z) / length
            off.append(distance[:-1])
            station.append(abs(distance[-1]))
        square.append(float(np.sqrt(np.mean(np.square(off)))))
    value, sigma = mean_of(np.array(square))
    how = (
        f"{planes.said}. Planes by (5) with the right sign and (1); mean of the RMS over points and lines. The "
        f"measured station itself lies in the planes to {max(station):.0e} m; the true ground points lie beside them "
        "by what station and slopes are wrong."
    )
    return context.check("000.eq1").evaluate(value, sigma, how, 0.0)


def _least(context: Context, planes: Planes) -> CheckResult:
    passes = planes.passes
    normals = {}
    for line in LINES:
        slopes = [least_slopes(m.strips[line].points, m.station.position) for m in passes.measured]
        normals[line] = np.array([_normal(s) for s in slopes])
    solved = {line: np.array([fits[k].normal for fits in planes.corrected]) for k, line in enumerate(LINES)}
    check, errors = context.check("000.eq2"), [passes.pitch_error(found) for found in (normals, solved)]
    how = (
        f"{planes.said}; S as printed is minimised by its values alone, as the vertex of a parabola through six of "
        f"them. Mean errors: {_by_line(errors[0])}; by (5) with the right sign {_by_line(errors[1])}. Coordinates are "
        "Earth-fixed."
    )
    return check.worse(*(check.evaluate(*worst(e), how, 0.0) for e in errors))


def _vanishing(context: Context, planes: Planes) -> CheckResult:
    found = 0.0
    for m, fits in zip(planes.passes.measured, planes.corrected, strict=True):
        for line, fit in zip(LINES, fits, strict=True):
            points, station = m.strips[line].points, m.station.position
            slopes = np.array(fit.coefficients[:2])
            at = numerical_derivatives(slopes, points, station)
            beside = numerical_derivatives(slopes * (1.0 + ARCSEC), points, station)
            found = max(found, float(np.linalg.norm(at) / np.linalg.norm(beside)))
    how = (
        f"{planes.said}; derivatives of S by central differences, which are exact for a square form, at (5)'s solution "
        "with the right sign and at slopes that are greater by 1 arcsec of their size. The largest ratio counts."
    )
    return context.check("000.eq3").evaluate(found, None, how, 0.0)


def _derivatives(context: Context, planes: Planes) -> CheckResult:
    m, ratios = planes.passes.measured[0], []
    for line in LINES:
        points, station = m.strips[line].points, m.station.position
        for slopes in ((0.3, -0.2), (-1.0, 0.7), (2.0, 1.5)):
            s = np.array(slopes)
            ratios += list(derivatives(s, points, station) / numerical_derivatives(s, points, station))
    value = max(ratios, key=lambda r: abs(r - 1.0))
    how = f"At three pairs of slopes far from the least S, on one measurement of each line: {len(ratios)} ratios."
    return context.check("000.eq4").evaluate(value, None, how)


def _printed_plane(context: Context, planes: Planes) -> CheckResult:
    passes = planes.passes
    turn, away = {}, {}
    for k, line in enumerate(LINES):
        true = passes.normal(line)
        found = np.array([fits[k].normal for fits in planes.printed])
        turn[line] = np.degrees(np.arccos(np.clip(np.abs(found @ true), 0.0, 1.0)))
        arm = passes.points[line] - passes.flight.station
        away[line] = float(np.sqrt(np.mean((arm @ found[0]) ** 2)))
    value, sigma = mean_of(turn["forward"])
    true = passes.normal("forward")
    half = float(np.degrees(np.arccos(abs(true @ (np.array([-1.0, -1.0, 1.0]) * true)))))
    places = ", ".join(f"{line} {v / 1e3:.0f} km" for line, v in away.items())
    how = f"{planes.said}. The planes as printed miss their ground points by {places} RMS."
    return context.check("000.eq5").evaluate(value, sigma, how, 0.0, [half])


def _printed_angles(context: Context, planes: Planes) -> CheckResult:
    printed = np.array([intersection_angles(*fits).printed for fits in planes.printed])
    difference = float(np.max(np.abs(printed - planes.angles))) / ARCSEC
    how = (
        f"{planes.said}. The half turn about z that the wrong sign makes is the same for all planes, so that the "
        "angles between them stay: the error of print could not show in the paper's Table 1."
    )
    return context.check("000.eq5.angles").evaluate(difference, None, how, 0.0)


def _vertical(context: Context, planes: Planes) -> CheckResult:
    passes, flight = planes.passes, planes.passes.flight
    across, along, look = flight.line_axes
    errors = flight.spec.errors
    noise = errors.points**2 + errors.station**2
    reach = float(np.mean(((passes.points["nadir"] - flight.station) @ look) ** 2))
    tilt = float(np.arctan(np.sqrt(noise / reach)))
    c, s = np.cos(tilt), np.sin(tilt)
    axes = np.stack([c * across + s * look, along, c * look - s * across])
    slopes = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NearVerticalWarning)
        for m in passes.measured:
            turned = m.in_frame(axes, flight.station)
            slopes.append(fit_plane(turned.station, turned.strips["nadir"], "corrected").coefficients[0])
    value, sigma = mean_of(np.array(slopes) * np.tan(tilt))
    how = (
        f"{planes.said}; (5) with the right sign in a frame whose z axis lies {tilt / ARCSEC:.2f}″ from the nadir "
        "line's plane. In Earth-fixed axes the slopes are true (000.eq2); in the orbital frame the plane of a "
        "camera that looks straight down is vertical. Total least squares does not depend on the frame."
    )
    expected = reach * np.tan(tilt) ** 2 / (reach * np.tan(tilt) ** 2 + noise)
    return context.check("000.eq5.vertical").evaluate(value, sigma, how, None, [expected])


def _alpha(context: Context, planes: Planes) -> CheckResult:
    return _angle(context, planes, 0, "000.eq6")


def _beta(context: Context, planes: Planes) -> CheckResult:
    return _angle(context, planes, 1, "000.eq7")


def _angle(context: Context, planes: Planes, which: int, identifier: str) -> CheckResult:
    truth = values_of(planes.passes.flight.dihedral)[which]
    off = (planes.angles[:, which] - truth) / ARCSEC
    look = values_of(planes.passes.flight.look)[which]
    how = (
        f"{planes.said}; true angle {np.degrees(truth):.6f}°, one measurement scatters by {np.std(off, ddof=1):.3f}″. "
        f"The looks of the lines' centres make that angle {(look - truth) / ARCSEC:+.4f}″. Light time, "
        "aberration and refraction are taken out of the points; left in, see 000.light."
    )
    return context.check(identifier).evaluate(*mean_of(off), how, 0.0)


def _arccos(context: Context, planes: Planes) -> CheckResult:
    exact = np.array([[_exact(fits[0], fits[1]), _exact(fits[1], fits[2])] for fits in planes.corrected])
    found = float(np.max(np.abs(planes.angles - exact))) / ARCSEC
    least = np.sqrt(2.0 * np.finfo(np.float64).eps)
    how = (
        f"{planes.said}; against atan2 of cross and scalar product in extended precision. The error grows as 1/sin of "
        f"the angle: of the nearly parallel planes of the outlook, arccos tells no angle below {least / ARCSEC:.4f}″."
    )
    return context.check("000.eq6.arccos").evaluate(found, None, how, 0.0)


def _exact(a: PlaneFit, b: PlaneFit) -> float:
    """Acute angle between two planes, radians; 18 digits."""
    first, second = (np.array([*fit.coefficients[:2], -1.0], np.longdouble) for fit in (a, b))
    cross = np.cross(first, second)
    return float(np.arctan2(np.sqrt(np.sum(cross * cross)), abs(np.sum(first * second))))


def _parallel(context: Context, planes: Planes) -> CheckResult:
    off = []
    for passes in twisted_passes(context):
        alpha = np.array([intersection_angles(*planes_of(m, "corrected")).printed[0] for m in passes.measured])
        off.append((alpha - passes.flight.look["alpha"]) / ARCSEC)
    # turned both ways, so that the arrays' own 35 arcsec of laboratory and launch count in square only
    value, sigma = mean_of(0.5 * (off[0] + off[1]))
    look = planes.passes.flight.look["alpha"]
    law = float(TWIST**2 / (2.0 * np.tan(look)) / ARCSEC)
    aligned = (planes.passes.flight.dihedral["alpha"] - look) / ARCSEC
    how = (
        f"{2 * len(off[0])} measurements with the forward array turned by ±10′ about its line of sight; mean of both "
        f"senses. With the arrays as they are, 35″ off parallel, the difference is {aligned:.4f}″."
    )
    return context.check("000.eq6.parallel").evaluate(value, sigma, how, 0.0, [law])


def _normal(slopes: Array) -> Array:
    normal = np.array([slopes[0], slopes[1], -1.0])
    return np.asarray(normal / np.linalg.norm(normal))


def _by_line(errors: Mapping[str, tuple[float, float]]) -> str:
    return ", ".join(f"{line} {mean:+.3f}″ ± {sigma:.3f}″" for line, (mean, sigma) in errors.items())


GROUP = group_of("000.equations", run)
