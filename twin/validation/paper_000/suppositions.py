"""What stands around paper 000's method: what it leaves out, and what the angle is for.

Left out are what happens to the light, that cameras have centres of their own, and the camera itself, whose traced
change the ground has to show. Its uses are the heights that one arc second makes (sections 0 and 3) and the off-axis
angles of other cameras.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from analysis.arrays import ARCSEC
from analysis.orbit.planes import angles_between, fit_plane, height_error, off_axis_angle
from optics.numerics.backend import one_blas_thread
from twin.orbit.angle.angle_flight import AnglePass, Measurement
from twin.orbit.angle.angle_run import centred, effect_rows, sighted
from twin.orbit.flight.light_effects import SPEED_OF_LIGHT, standard_refractivity
from twin.orbit.flight.line_camera import dihedral_angle
from twin.validation.checks.check import CheckResult, mean_of
from twin.validation.checks.group import Context, group_of
from twin.validation.paper_000.passes import OFF_AXIS, TEST, TRACED, Passes, planes_of, repeated, setup_of

SCALE_HEIGHT = 8435.0
"""Scale height of the standard atmosphere's pressure at 15 °C, R T/(M g), metres."""


def light_passes(context: Context) -> Passes:
    """One pass of th1; only its true points are used."""
    return repeated(setup_of(TEST), np.random.SeedSequence([context.seed, 3]), 2)


def traced_passes(context: Context) -> Passes:
    """Measurements of a traced instrument that has changed since the laboratory."""
    seed = np.random.SeedSequence([context.seed, 4])
    return repeated(setup_of(TRACED), seed, context.count(full=400, fast=100), context.backend)


@one_blas_thread()
def run_suppositions(context: Context) -> Iterator[CheckResult]:
    """All checks of the group."""
    if context.wants("000.light"):
        context.progress(0.0, "true ground points with each effect on the light")
        yield from _light(context, light_passes(context))
    if context.wants("000.traced", "000.centres"):
        context.progress(0.2, "trace gf7_pair")
        yield from _traced(context, traced_passes(context))


def _light(context: Context, passes: Passes) -> Iterator[CheckResult]:
    flight = passes.flight
    rows = {row.what: row for row in effect_rows(flight)}
    looks = dict(flight.look)
    speed = float(np.linalg.norm(flight.velocity)) / SPEED_OF_LIGHT
    aberration = {"alpha": 1.0 - np.cos(looks["alpha"]), "beta": np.cos(looks["beta"]) - 1.0}
    predicted = {
        name: (speed * aberration[name] / ARCSEC, _refraction(passes, name, line) / ARCSEC)
        for name, line in (("alpha", "forward"), ("beta", "backward"))
    }

    def statement(what: str) -> str:
        bias, left = rows[what].bias / ARCSEC, rows[what].left / ARCSEC
        return (
            f"True ground points of the rigorous sensor, no errors: α {bias[0]:+.3f}″, β {bias[1]:+.3f}″. After the "
            f"analysis has taken the effect out of the points, {np.max(np.abs(left)):.0e}″."
        )

    cases = {
        "000.light.aberration": ("aberration", 0, predicted["alpha"][0]),
        "000.light.refraction": ("refraction", 0, predicted["alpha"][1]),
        "000.light.beta": ("all", 1, sum(predicted["beta"])),
    }
    for identifier, (what, which, value) in cases.items():
        measured = float(rows[what].bias[which] / ARCSEC)
        yield context.check(identifier).evaluate(
            measured, None, statement(what), 0.0, [value], facts={"tilt": speed / ARCSEC}
        )


def _refraction(passes: Passes, angle: str, line: str) -> float:
    """How much smaller an angle looks through a thin atmosphere under the station, first order, radians (negative)."""
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
    flight = passes.flight
    first, second = flight.pairs["alpha"]
    lab = dihedral_angle(
        flight.laboratory[first], flight.laboratory[second], (flight.pixel[first], flight.pixel[second])
    )
    trace = flight.trace["alpha"]

    def off(measured: list[Measurement]) -> tuple[float, float]:
        planes = [[fit_plane(m.station, m.strips[line], "corrected") for line in (first, second)] for m in measured]
        alpha = np.array([angles_between(fits, [(0, 1)]).printed[0] for fits in planes])
        return mean_of((alpha - lab - trace) / ARCSEC)

    common = [centred(m, section) for m, section in zip(passes.measured, passes.sections, strict=True)]
    value, sigma = off(common)
    many = f"{len(common)} measurements of a pass of gf7_pair"
    how = (
        f"{many}, whose focal plane has turned and moved and whose base has warmed: the trace changes the angle by "
        f"{trace / ARCSEC:.3f}″ and the planes by {trace / ARCSEC + value:.3f}″ ± {sigma:.3f}″. Points are moved "
        "to a common projection centre by what the laboratory knows."
    )
    yield context.check("000.traced").evaluate(value, sigma, how, 0.0)
    apart = _seen(passes, first) - _seen(passes, second)
    how = f"{many}; the planes go through one station, as the paper has it."
    yield context.check("000.centres").evaluate(*off(list(passes.measured)), how, 0.0, [apart / ARCSEC])


def _seen(passes: Passes, line: str) -> float:
    """How far a line's projection centres turn its plane ahead, seen from the ground, radians."""
    flight = passes.flight
    camera = flight.laboratory[line]
    origin, look = camera.origin(flight.pixel[line]), camera.look(flight.pixel[line])
    middle = look[len(look) // 2]
    ahead = np.cross(look[0] - look[-1], middle)
    ahead = ahead / np.linalg.norm(ahead)
    ahead = ahead * np.copysign(1.0, ahead[0])
    reach = np.linalg.norm(passes.points[line] - flight.station, axis=1)
    return float(np.mean(origin @ ahead) / np.mean(reach))


def height_passes(context: Context) -> Passes:
    """One pass of th1 for the heights."""
    return repeated(setup_of(TEST), np.random.SeedSequence([context.seed, 6]), 2)


def off_axis_passes(context: Context) -> Passes:
    """Measurements of all five lines."""
    seed = np.random.SeedSequence([context.seed, 7])
    return repeated(setup_of(OFF_AXIS), seed, context.count(full=800, fast=120))


@one_blas_thread()
def run_uses(context: Context) -> Iterator[CheckResult]:
    """All checks of the group."""
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
        how = (
            f"The point in the middle of the nadir line is found in the {other} line's image by the rigorous "
            "sensor, that line is turned by 1 arcsec in pitch, and the two rays are intersected again. Over flat "
            f"ground H / (sin α cos α) makes {flat:.2f} m; the curved Earth lets the rays meet at a larger angle."
        )
        yield context.check(f"000.height.{name}").evaluate(float(heights[name] or 0.0), None, how)
    # on a sphere the nadir ray stands upright and the other one at alpha plus the angle at the Earth's centre
    radius = float(np.linalg.norm(flight.middle_point))
    zenith = float(np.arcsin((radius + above) / radius * np.sin(alpha)))
    slant = radius * np.sin(zenith - alpha) / np.sin(alpha)
    ratio = float(heights["alpha"] or 0.0) / float(height_error(ARCSEC, slant, zenith))
    how = (
        f"Triangle of station, point and centre of a spherical Earth: slant range {slant / 1e3:.1f} km, angle of "
        f"the rays {np.degrees(zenith):.2f}°. By the intersection: {heights['alpha']:.3f} m."
    )
    yield context.check("000.height.size").evaluate(ratio, None, how, 1.0)


def _outlook(context: Context, passes: Passes) -> Iterator[CheckResult]:
    flight = passes.flight
    along = np.array([sighted(m, s)[1].values for m, s in zip(passes.measured, passes.sections, strict=True)])
    many = f"{len(along)} measurements, 60 points of 1.5 m a line, station 0.5 m"
    names = list(flight.pairs)
    for name in ("high_resolution", "multispectral"):
        true = flight.along_track[name]
        off = (along[:, names.index(name)] - true) / ARCSEC
        how = (
            f"{many}; true angle along the track {np.degrees(true):.5f}° from the nadir line, one measurement "
            f"scatters by {np.std(off, ddof=1):.3f}″. The lines of sight are found in the fitted planes."
        )
        yield context.check(f"000.outlook.{name}").evaluate(*mean_of(off), how, 0.0)
    found = []
    for m in passes.measured:
        line, nadir = planes_of(m, "corrected", ("multispectral", "nadir"))
        found.append(off_axis_angle(line, nadir).printed[0])
    look = flight.look["multispectral"]
    off = (np.array(found) - look) / ARCSEC
    how = (
        f"{many}; the looks of the lines' centres are {look / ARCSEC:.1f}″ apart, one measurement of the planes' "
        f"angle scatters by {np.std(off, ddof=1):.1f}″, fourteen times that of α."
    )
    expected = (flight.dihedral["multispectral"] - look) / ARCSEC
    yield context.check("000.outlook.unsigned").evaluate(*mean_of(off), how, 0.0, [expected])


SUPPOSITIONS = group_of("000.suppositions", run_suppositions)
USES = group_of("000.uses", run_uses)
