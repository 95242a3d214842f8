"""Checks of the method of paper 000 (Liu and Huang 2014): passes, equations, assumptions and applications.

A pass is a flight of the satellite over ground control points, from which the angles between its cameras are measured.
The passes are the tests of the library (scenes/orbit/angle*.yaml). The assumptions concern the light, the projection
centres of the cameras, and the camera itself, whose traced change has to be observable from the ground. The
applications are the height error due to one arc second (sections 0 and 3) and the off-axis angles of other cameras.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from analysis.arrays import ARCSEC, Array
from analysis.orbit.planes import (
    Method,
    NearVerticalWarning,
    PlaneFit,
    angles_between,
    fit_plane,
    height_error,
    intersection_angles,
    off_axis_angle,
)
from analysis.orbit.resection import Resection
from optics.geometry.pose import rotation_matrix
from optics.numerics.backend import Backend, one_blas_thread
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.angle import LINES
from scenes.specs.orbit.setup import AngleSetup
from twin.orbit.angle import angle_run
from twin.orbit.angle.angle_flight import AngleCamera, AnglePass, Measurement, angle_camera, fly
from twin.orbit.flight.line_camera import dihedral_angle
from twin.orbit.flight.sensor import NO_EFFECTS, SPEED_OF_LIGHT, standard_refractivity
from twin.validation.check import CheckResult, mean_of
from twin.validation.group import Context, group_of

TEST = "angle"
OFF_AXIS = "angle_off_axis"
TRACED = "angle_gf7"
PAIRS = (("forward", "nadir"), ("nadir", "backward"))
"""Pairs of camera lines that enclose the intersection angles alpha and beta."""


@dataclass(frozen=True, eq=False)
class Passes:
    """Simulated pass of the satellite over ground points, with repeated measurements of it.

    Attributes
    ----------
    flight : AnglePass
        True pass.
    measured : tuple of Measurement
        Measurements, each with new random errors; the effects of the light are in the points and are corrected.
    """

    flight: AnglePass
    measured: tuple[Measurement, ...]

    @cached_property
    def points(self) -> Mapping[str, np.ndarray]:
        """Line -> true positions of its n ground points on straight lines of sight, (n, 3), metres."""
        return self.flight.ground(NO_EFFECTS)

    @cached_property
    def sections(self) -> tuple[Resection, ...]:
        """Space resection of every measurement: attitude and look angles adjusted from the ground points."""
        return tuple(angle_run.resect_measurement(m) for m in self.measured)

    def normal(self, line: str) -> np.ndarray:
        """Return the true unit normal of the plane that a camera line spans, (3,), in the ITRS.

        Its z is negative like that of the paper's (a0, a1, -1). It follows from the exact directions of the camera's
        pixels at the points, not from the points.
        """
        looks = self.flight.cameras[line].look(self.flight.pixel[line])
        body = np.linalg.svd(looks)[2][2]
        axes = self.flight.trajectory.body_to_itrs(self.flight.spec.time)
        normal = axes @ body
        return np.asarray(-np.copysign(1.0, normal[2]) * normal)

    def ahead(self, line: str) -> np.ndarray:
        """Return the true line of sight of a camera line's centre, orthogonalised to the line's true normal, (3,).

        The normal moves along this direction when the plane is pitched.
        """
        camera = self.flight.cameras[line]
        look = camera.look(np.array([0.5 * (camera.pixels - 1)]))[0]
        look = self.flight.trajectory.body_to_itrs(self.flight.spec.time) @ look
        normal = self.normal(line)
        look = look - (look @ normal) * normal
        return np.asarray(look / np.linalg.norm(look))

    def pitch_error(self, normals: Mapping[str, np.ndarray]) -> dict[str, tuple[float, float]]:
        """Return, for each line, the mean error of plane normals toward the line of sight and its sigma, in arcsec.

        ``normals`` has for each line the unit normals of all measurements, (passes, 3).
        """
        out = {}
        for line, normal in normals.items():
            rotations = (normal - self.normal(line)) @ self.ahead(line) / ARCSEC
            out[line] = mean_of(rotations)
        return out


def planes_of(measured: Measurement, method: Method, lines: Iterable[str] = LINES) -> list[PlaneFit]:
    """Fit a plane for each camera line, through the measured projection centre and the line's ground points."""
    return [fit_plane(measured.station, measured.strips[line], method) for line in lines]


def setup_of(name: str, **changes: object) -> AngleSetup:
    """Return a test of the library with changed errors or a changed pass.

    Changes are fields of its `errors`, or the latitude, longitude and direction of its pass.
    """
    setup = AngleSetup.read(name)
    test = setup.test
    at: dict[str, Any] = {key: changes.pop(key) for key in ("latitude", "longitude", "direction") if key in changes}
    if at:
        assert test.orbit.passing is not None
        passing = test.orbit.passing.model_copy(update=at)
        test = test.model_copy(update={"orbit": test.orbit.model_copy(update={"passing": passing})})
    if changes:
        test = test.model_copy(update={"errors": test.errors.model_copy(update=changes)})
    return setup.model_copy(update={"test": test})


def repeated(
    setup: AngleSetup,
    seed: np.random.SeedSequence,
    count: int,
    backend: Backend | None = None,
    rotations: Mapping[str, tuple[float, float, float]] = FrozenMap(),
    corrected: bool = True,
) -> Passes:
    """Simulate a pass of the satellite over ground points and ``count`` measurements of it.

    Parameters
    ----------
    setup : AngleSetup
        Test to simulate.
    seed : np.random.SeedSequence
        Seed of terrain and errors.
    count : int
        Number of measurements.
    backend : Backend | None
        Backend that traces an instrument's lines; None for lines without an instrument.
    rotations : Mapping[str, tuple[float, float, float]]
        Line -> its rotation vector in body axes since the laboratory calibration, radians.
    corrected : bool
        True if the analysis removes aberration, light time and refraction from the points.
    """
    terrain, errors = seed.spawn(2)
    flight = fly(setup, _rotated(angle_camera(setup, backend), rotations), terrain)
    ground = flight.ground(flight.effects)
    removed = flight.effects if corrected else NO_EFFECTS
    return Passes(flight, tuple(flight.measure(ground, stream, removed) for stream in errors.spawn(count)))


def _rotated(camera: AngleCamera, rotations: Mapping[str, tuple[float, float, float]]) -> AngleCamera:
    lines = dict(camera.cameras)
    for name, rotation in rotations.items():
        lines[name] = replace(lines[name], directions=lines[name].directions @ rotation_matrix(np.array(rotation)).T)
    return replace(camera, cameras=FrozenMap(lines))


_STEP = 1e-3
TWIST = np.radians(10.0 / 60.0)
"""Rotation of the forward array about its line of sight, radians, for the check ``eq6.parallel``."""


def sum_of_squares(slopes: Array, points: Array, station: Array) -> float:
    """Return the sum of squares S of eq. (2), in square metres, for the slopes a0 and a1 of a plane, (2,).

    The third coefficient a2 follows from eq. (1). The n points, (n, 3), and the projection centre, (3,), are in metres.
    """
    x, y, z = points.T
    x0, y0, z0 = station
    a0, a1 = slopes
    return float(np.sum((a0 * x + a1 * y + (z0 - a0 * x0 - a1 * y0) - z) ** 2))


def derivatives(slopes: Array, points: Array, station: Array) -> Array:
    """Return the left sides of eq. (4), (2,), m^2: the derivatives of the sum of squares S as printed.

    They are with respect to the slopes a0 and a1 of the plane.
    """
    x, y, z = points.T
    x0, y0, z0 = station
    a0, a1 = slopes
    miss = a0 * x + a1 * y + z0 - a0 * x0 - a1 * y0 - z
    return np.array([np.sum(2.0 * miss * (x - x0)), np.sum(2.0 * miss * (y - y0))])


def numerical_derivatives(slopes: Array, points: Array, station: Array) -> Array:
    """Return the derivatives of the sum of squares S by central differences, (2,), m^2.

    They are with respect to the slopes a0 and a1 of the plane. For a quadratic form they are exact except for rounding.
    """
    out = []
    for step in _STEP * np.eye(2):
        above, below = (sum_of_squares(slopes + sign * step, points, station) for sign in (1.0, -1.0))
        out.append((above - below) / (2.0 * _STEP))
    return np.array(out)


def least_slopes(points: Array, station: Array) -> Array:
    """Return the slopes a0, a1 of the plane that minimise the sum of squares S, (2,).

    They are the vertex of a parabola through values of S. It is computed twice, the second time from values nearer to
    the vertex, which keep more digits.
    """
    position, size = np.zeros(2), 1.0
    for _ in range(3):
        step = size * np.eye(2)

        def value(shift: Array, position: Array = position) -> float:
            return sum_of_squares(position + shift, points, station)

        middle = value(np.zeros(2))
        up, down = ([value(sign * e) for e in step] for sign in (1.0, -1.0))
        slope = (np.array(up) - np.array(down)) / (2.0 * size)
        curve = np.diag((np.array(up) + np.array(down) - 2.0 * middle) / size**2)
        curve[0, 1] = curve[1, 0] = (value(step[0] + step[1]) - up[0] - up[1] + middle) / size**2
        position, size = position - np.linalg.solve(curve, slope), _STEP
    return position


class Planes:
    """Planes of the three camera lines of every measurement, fitted when needed, for the checks of the equations."""

    def __init__(self, context: Context, passes: Passes) -> None:
        self.context = context
        self.passes = passes
        self.row = partial(context.row, passes=passes, spec=passes.flight.spec)

    @cached_property
    def corrected(self) -> list[list[PlaneFit]]:
        """Planes by eq. (5) with the correct sign: for each pass, one plane per line."""
        return [planes_of(m, "corrected") for m in self.passes.measured]

    @cached_property
    def printed(self) -> list[list[PlaneFit]]:
        """Planes by eq. (5) as printed: for each pass, one plane per line."""
        return [planes_of(m, "printed") for m in self.passes.measured]

    @cached_property
    def angles(self) -> Array:
        """Angles alpha and beta by eqs. (6) and (7) from the corrected planes, (passes, 2), radians."""
        return np.array([intersection_angles(*fits).printed for fits in self.corrected])


def make_passes(context: Context) -> Passes:
    """Simulate the measurements that all checks of the equations share."""
    return repeated(setup_of(TEST), np.random.SeedSequence([context.seed, 1]), context.count(full=1000, fast=250))


def twisted_passes(context: Context) -> tuple[Passes, Passes]:
    """Simulate measurements with the forward array rotated by ±`TWIST` about its line of sight."""
    look, setup, count = np.radians(25.0), setup_of(TEST), context.count(full=300, fast=80)
    streams = np.random.SeedSequence([context.seed, 2]).spawn(2)
    positive, negative = (
        repeated(setup, stream, count, rotations={"forward": (twist * np.sin(look), 0.0, twist * np.cos(look))})
        for twist, stream in zip((TWIST, -TWIST), streams, strict=True)
    )
    return positive, negative


@one_blas_thread()
def run(context: Context) -> Iterator[CheckResult]:
    """Yield the results of all checks of the equations of paper 000 (Liu and Huang 2014)."""
    context.progress(0.0, "measure ground points")
    planes = Planes(context, make_passes(context))
    checks: Mapping[str, Callable[[Planes], CheckResult]] = {
        "000.eq1": _through_station,
        "000.eq2": _least,
        "000.eq3": _vanishing,
        "000.eq4": _derivatives,
        "000.eq5": _printed_plane,
        "000.eq5.angles": _printed_angles,
        "000.eq5.vertical": _vertical,
        "000.eq6": lambda planes: _angle(planes, 0, "000.eq6"),
        "000.eq6.arccos": _arccos,
        "000.eq6.parallel": _parallel,
        "000.eq7": lambda planes: _angle(planes, 1, "000.eq7"),
    }
    for k, (identifier, check) in enumerate(checks.items()):
        if identifier in context.selected:
            context.progress(0.3 + 0.6 * k / len(checks), identifier)
            yield check(planes)


def _through_station(planes: Planes) -> CheckResult:
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
    return planes.row("000.eq1", *mean_of(np.array(square)), 0.0, station=station)


def _least(planes: Planes) -> CheckResult:
    passes = planes.passes
    normals = {}
    for line in LINES:
        slopes = [least_slopes(m.strips[line].points, m.station.position) for m in passes.measured]
        normals[line] = np.array([np.array([*s, -1.0]) / np.sqrt(s @ s + 1.0) for s in slopes])
    solved = {line: np.array([fits[k].normal for fits in planes.corrected]) for k, line in enumerate(LINES)}
    errors = [passes.pitch_error(candidate) for candidate in (normals, solved)]
    texts = [
        ", ".join(f"{line} {mean:+.3f}″ ± {sigma:.3f}″" for line, (mean, sigma) in error.items()) for error in errors
    ]
    check = planes.context.check("000.eq2")
    # the mean farthest from zero counts
    worst = (max(error.values(), key=lambda mean: abs(mean[0])) for error in errors)
    return check.worse(*(planes.row("000.eq2", *mean, 0.0, errors=texts) for mean in worst))


def _vanishing(planes: Planes) -> CheckResult:
    largest = 0.0
    for m, fits in zip(planes.passes.measured, planes.corrected, strict=True):
        for line, fit in zip(LINES, fits, strict=True):
            points, station = m.strips[line].points, m.station.position
            slopes = np.array(fit.coefficients[:2])
            at = numerical_derivatives(slopes, points, station)
            beside = numerical_derivatives(slopes * (1.0 + ARCSEC), points, station)
            largest = max(largest, float(np.linalg.norm(at) / np.linalg.norm(beside)))
    return planes.row("000.eq3", largest, implied=0.0)


def _derivatives(planes: Planes) -> CheckResult:
    m, ratios = planes.passes.measured[0], []
    for line in LINES:
        points, station = m.strips[line].points, m.station.position
        for slopes in ((0.3, -0.2), (-1.0, 0.7), (2.0, 1.5)):
            s = np.array(slopes)
            ratios += list(derivatives(s, points, station) / numerical_derivatives(s, points, station))
    return planes.row("000.eq4", max(ratios, key=lambda r: abs(r - 1.0)), ratios=ratios)


def _printed_plane(planes: Planes) -> CheckResult:
    passes = planes.passes
    rotation, away = {}, {}
    for k, line in enumerate(LINES):
        true = passes.normal(line)
        plane_normals = np.array([fits[k].normal for fits in planes.printed])
        rotation[line] = np.degrees(np.arccos(np.clip(np.abs(plane_normals @ true), 0.0, 1.0)))
        arm = passes.points[line] - passes.flight.station
        away[line] = f"{np.sqrt(np.mean((arm @ plane_normals[0]) ** 2)) / 1e3:.0f} km"
    true = passes.normal("forward")
    half = float(np.degrees(np.arccos(abs(true @ (np.array([-1.0, -1.0, 1.0]) * true)))))
    return planes.row("000.eq5", *mean_of(rotation["forward"]), 0.0, [half], away=away)


def _printed_angles(planes: Planes) -> CheckResult:
    printed = np.array([intersection_angles(*fits).printed for fits in planes.printed])
    return planes.row("000.eq5.angles", np.max(np.abs(printed - planes.angles)) / ARCSEC, implied=0.0)


def _vertical(planes: Planes) -> CheckResult:
    passes, flight = planes.passes, planes.passes.flight
    across, along, look = flight.line_axes
    errors = flight.spec.errors
    noise = errors.points**2 + errors.station**2
    distance = float(np.mean(((passes.points["nadir"] - flight.station) @ look) ** 2))
    tilt = float(np.arctan(np.sqrt(noise / distance)))
    c, s = np.cos(tilt), np.sin(tilt)
    axes = np.stack([c * across + s * look, along, c * look - s * across])
    slopes = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NearVerticalWarning)
        for m in passes.measured:
            rotated = m.in_frame(axes, flight.station)
            slopes.append(fit_plane(rotated.station, rotated.strips["nadir"], "corrected").coefficients[0])
    measured = mean_of(np.array(slopes) * np.tan(tilt))
    expected = distance * np.tan(tilt) ** 2 / (distance * np.tan(tilt) ** 2 + noise)
    return planes.row("000.eq5.vertical", *measured, None, [expected], tilt=tilt)


def _angle(planes: Planes, which: int, identifier: str) -> CheckResult:
    flight = planes.passes.flight
    truth = angle_run.values_of(flight.dihedral)[which]
    off = planes.angles[:, which] - truth
    facts: dict[str, Any] = {"truth": truth, "off": off, "look": angle_run.values_of(flight.look)[which] - truth}
    return planes.row(identifier, *mean_of(off / ARCSEC), 0.0, **facts)


def _arccos(planes: Planes) -> CheckResult:
    exact = np.array([[_exact(fits[0], fits[1]), _exact(fits[1], fits[2])] for fits in planes.corrected])
    difference = float(np.max(np.abs(planes.angles - exact))) / ARCSEC
    return planes.row("000.eq6.arccos", difference, implied=0.0, least=np.sqrt(2.0 * np.finfo(np.float64).eps))


def _exact(a: PlaneFit, b: PlaneFit) -> float:
    """Return the acute angle between two planes, radians, computed with 18 significant digits."""
    first, second = (np.array([*fit.coefficients[:2], -1.0], np.longdouble) for fit in (a, b))
    cross = np.cross(first, second)
    return float(np.arctan2(np.sqrt(np.sum(cross * cross)), abs(np.sum(first * second))))


def _parallel(planes: Planes) -> CheckResult:
    off = []
    for passes in twisted_passes(planes.context):
        alpha = np.array([intersection_angles(*planes_of(m, "corrected")).printed[0] for m in passes.measured])
        off.append((alpha - passes.flight.look["alpha"]) / ARCSEC)
    flight = planes.passes.flight
    look = flight.look["alpha"]
    law = float(TWIST**2 / (2.0 * np.tan(look)) / ARCSEC)
    facts: dict[str, Any] = {"both": np.concatenate(off), "aligned": flight.dihedral["alpha"] - look}
    # turned both ways, so that the arrays' own 35 arcsec of laboratory and launch count in square only
    return planes.row("000.eq6.parallel", *mean_of(0.5 * (off[0] + off[1])), 0.0, [law], **facts)


SCALE_HEIGHT = 8435.0
"""Scale height of the standard atmosphere's pressure at 15 °C, R T/(M g), metres."""


@one_blas_thread()
def run_suppositions(context: Context) -> Iterator[CheckResult]:
    """Yield the results of all checks of what the method neglects: effects of the light and changes of the camera."""
    if context.wants("000.light"):
        context.progress(0.0, "true ground points with each effect on the light")
        # only the true points are used
        yield from _light(context, repeated(setup_of(TEST), np.random.SeedSequence([context.seed, 3]), 2))
    if context.wants("000.traced", "000.centres"):
        context.progress(0.2, "trace gf7_pair")
        seed, count = np.random.SeedSequence([context.seed, 4]), context.count(full=400, fast=100)
        yield from _traced(context, repeated(setup_of(TRACED), seed, count, context.backend))


def _light(context: Context, passes: Passes) -> Iterator[CheckResult]:
    flight = passes.flight
    rows = {row.what: row for row in angle_run.effect_rows(flight)}
    looks = dict(flight.look)
    speed = float(np.linalg.norm(flight.velocity)) / SPEED_OF_LIGHT
    aberration = {"alpha": 1.0 - np.cos(looks["alpha"]), "beta": np.cos(looks["beta"]) - 1.0}
    predicted = {
        name: (speed * aberration[name] / ARCSEC, _refraction(passes, line) / ARCSEC)
        for name, line in (("alpha", "forward"), ("beta", "backward"))
    }
    cases = {
        "aberration": ("aberration", 0, predicted["alpha"][0]),
        "refraction": ("refraction", 0, predicted["alpha"][1]),
        "beta": ("all", 1, sum(predicted["beta"])),
    }
    for name, (what, which, value) in cases.items():
        effect = rows[what]
        measured = float(effect.bias[which] / ARCSEC)
        facts: dict[str, Any] = {"effect": effect, "tilt": speed / ARCSEC}
        yield context.row(f"000.light.{name}", measured, None, 0.0, [value], **facts)


def _refraction(passes: Passes, line: str) -> float:
    """Return the first-order change of a look angle due to refraction in a thin atmosphere, radians (negative)."""
    flight = passes.flight
    point = passes.points[line]
    arm = flight.station - point[len(point) // 2]
    length = float(np.linalg.norm(arm))
    up = point[len(point) // 2] / np.linalg.norm(point[len(point) // 2])
    zenith = np.arccos(arm @ up / length)
    column = standard_refractivity(flight.spec.effects.wavelength) * SCALE_HEIGHT
    column = column * np.exp(-flight.spec.terrain.height / SCALE_HEIGHT)
    # a shift along the ground of column tan z / cos² z is seen foreshortened by cos z
    return float(-column * np.tan(zenith) / np.cos(zenith) / length)


def _traced(context: Context, passes: Passes) -> Iterator[CheckResult]:
    """Check measurements of a ray-traced instrument that has changed since its laboratory calibration."""
    flight = passes.flight
    first, second = flight.pairs["alpha"]
    lab = dihedral_angle(
        flight.laboratory[first], flight.laboratory[second], (flight.pixel[first], flight.pixel[second])
    )
    trace = flight.trace["alpha"]

    def off(measured: Iterable[Measurement]) -> tuple[float, float]:
        planes = [[fit_plane(m.station, m.strips[line], "corrected") for line in (first, second)] for m in measured]
        alpha = np.array([angles_between(fits, [(0, 1)]).printed[0] for fits in planes])
        return mean_of((alpha - lab - trace) / ARCSEC)

    common = [
        angle_run.reduce_to_station(m, section) for m, section in zip(passes.measured, passes.sections, strict=True)
    ]
    value, sigma = off(common)
    facts: dict[str, Any] = {"passes": passes, "trace": trace, "by_planes": trace / ARCSEC + value}
    yield context.row("000.traced", value, sigma, 0.0, **facts)
    apart = (_seen(passes, first) - _seen(passes, second)) / ARCSEC
    yield context.row("000.centres", *off(passes.measured), 0.0, [apart], **facts)


def _seen(passes: Passes, line: str) -> float:
    """Return the apparent rotation of a line's plane due to shifts of the projection centre, radians.

    It is the rotation that the ground points show.
    """
    flight = passes.flight
    camera = flight.laboratory[line]
    origin, look = camera.origin(flight.pixel[line]), camera.look(flight.pixel[line])
    middle = look[len(look) // 2]
    ahead = np.cross(look[0] - look[-1], middle)
    ahead = ahead / np.linalg.norm(ahead)
    ahead = ahead * np.copysign(1.0, ahead[0])
    distance = np.linalg.norm(passes.points[line] - flight.station, axis=1)
    return float(np.mean(origin @ ahead) / np.mean(distance))


def height_passes(context: Context) -> Passes:
    """Simulate one pass of the example camera ``th1`` for the checks of height errors."""
    return repeated(setup_of(TEST), np.random.SeedSequence([context.seed, 6]), 2)


def off_axis_passes(context: Context) -> Passes:
    """Simulate measurements with all five camera lines, the off-axis ones included."""
    seed = np.random.SeedSequence([context.seed, 7])
    return repeated(setup_of(OFF_AXIS), seed, context.count(full=800, fast=120))


@one_blas_thread()
def run_uses(context: Context) -> Iterator[CheckResult]:
    """Yield the results of all checks of the method's applications: height errors and off-axis angles."""
    if context.wants("000.height"):
        context.progress(0.0, "intersect with a turned line")
        yield from _height(context, height_passes(context).flight)
    if context.wants("000.outlook"):
        context.progress(0.2, "measure five lines")
        yield from _outlook(context, off_axis_passes(context))


def _height(context: Context, flight: AnglePass) -> Iterator[CheckResult]:
    heights = flight.height_per_arcsec()
    above = float(flight.earth.geodetic(flight.station)[2]) - flight.spec.terrain.height
    alpha = flight.look["alpha"]
    flat = above * ARCSEC / (np.sin(alpha) * np.cos(alpha))
    for name, other in (("alpha", "forward"), ("beta", "backward")):
        yield context.row(f"000.height.{name}", float(heights[name] or 0.0), other=other, flat=flat)
    # on a sphere the nadir ray stands upright and the other one at alpha plus the angle at the Earth's centre
    radius = float(np.linalg.norm(flight.middle_point))
    zenith = float(np.arcsin((radius + above) / radius * np.sin(alpha)))
    slant = radius * np.sin(zenith - alpha) / np.sin(alpha)
    ratio = float(heights["alpha"] or 0.0) / float(height_error(ARCSEC, slant, zenith))
    yield context.row("000.height.size", ratio, implied=1.0, slant=slant, zenith=zenith, heights=heights)


def _outlook(context: Context, passes: Passes) -> Iterator[CheckResult]:
    flight = passes.flight
    along = np.array(
        [angle_run.line_of_sight_angles(m, s)[1].values for m, s in zip(passes.measured, passes.sections, strict=True)]
    )
    names = list(flight.pairs)
    for name in ("high_resolution", "multispectral"):
        true = flight.along_track[name]
        off = along[:, names.index(name)] - true
        row = f"000.outlook.{name}"
        yield context.row(row, *mean_of(off / ARCSEC), 0.0, passes=passes, true=true, off=off)
    values = []
    for m in passes.measured:
        line, nadir = planes_of(m, "corrected", ("multispectral", "nadir"))
        values.append(off_axis_angle(line, nadir).printed[0])
    look = flight.look["multispectral"]
    off = np.array(values) - look
    expected = (flight.dihedral["multispectral"] - look) / ARCSEC
    row = "000.outlook.unsigned"
    yield context.row(row, *mean_of(off / ARCSEC), 0.0, [expected], passes=passes, look=look, off=off)


GROUP = group_of("000.equations", run)
SUPPOSITIONS = group_of("000.suppositions", run_suppositions)
USES = group_of("000.uses", run_uses)
