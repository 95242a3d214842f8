"""What paper 000 leaves out: what happens to the light, that cameras have centres of their own, and the camera itself,
whose traced change the ground has to show.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from analysis.orbit.angles import angles_between
from analysis.orbit.planes import fit_plane
from analysis.units import ARCSEC
from optics.numerics.threads import one_blas_thread
from twin.orbit.angle.angle_flight import Measurement
from twin.orbit.angle.angle_run import centred, effect_rows
from twin.orbit.flight.light_effects import SPEED_OF_LIGHT, standard_refractivity
from twin.orbit.flight.line_camera import dihedral_angle
from twin.validation.checks.check import CheckResult, mean_of
from twin.validation.checks.group import Context
from twin.validation.checks.printed import group_of
from twin.validation.paper_000.passes import TEST, TRACED, Passes, repeated, setup_of

SCALE_HEIGHT = 8435.0
"""Of the standard atmosphere's pressure at 15 °C, R T/(M g), metres."""


def make_passes(context: Context) -> Passes:
    """One pass of th1; only its true points are used."""
    return repeated(setup_of(TEST), np.random.SeedSequence([context.seed, 3]), 2)


def traced_passes(context: Context) -> Passes:
    """Measurements of a traced instrument that has changed since the laboratory."""
    seed = np.random.SeedSequence([context.seed, 4])
    return repeated(setup_of(TRACED), seed, context.count(full=400, fast=100), context.backend)


@one_blas_thread()
def run(context: Context) -> Iterator[CheckResult]:
    """All checks of the group."""
    if context.wants("000.light"):
        context.progress(0.0, "true ground points with each effect on the light")
        yield from _light(context, make_passes(context))
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
        for name, line in (("alpha", "forward"), ("beta", "aft"))
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
        yield context.check(identifier).evaluate(measured, None, statement(what), 0.0, [value], tilt=speed / ARCSEC)


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


GROUP = group_of("000.suppositions", run)
