"""What the angle is for (paper 000, sections 0 and 3): one arc second in heights, and the off-axis angles of others."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from analysis.orbit.angles import height_error, off_axis_angle
from analysis.units import ARCSEC
from optics.numerics.threads import one_blas_thread
from twin.orbit.angle.angle_flight import AnglePass
from twin.orbit.angle.angle_run import sighted
from twin.validation.checks.check import CheckResult, mean_of
from twin.validation.checks.group import Context
from twin.validation.checks.printed import group_of
from twin.validation.paper_000.passes import OFF_AXIS, TEST, Passes, planes_of, repeated, setup_of


def make_passes(context: Context) -> Passes:
    """One pass of th1 for the heights."""
    return repeated(setup_of(TEST), np.random.SeedSequence([context.seed, 6]), 2)


def off_axis_passes(context: Context) -> Passes:
    """Measurements of all five lines."""
    seed = np.random.SeedSequence([context.seed, 7])
    return repeated(setup_of(OFF_AXIS), seed, context.count(full=800, fast=120))


@one_blas_thread()
def run(context: Context) -> Iterator[CheckResult]:
    """All checks of the group."""
    if context.wants("000.height"):
        context.progress(0.0, "intersect with a turned line")
        yield from _height(context, make_passes(context).flight)
    if context.wants("000.outlook"):
        context.progress(0.2, "measure five lines")
        yield from _outlook(context, off_axis_passes(context))


def _height(context: Context, flight: AnglePass) -> Iterator[CheckResult]:
    heights = flight.height_per_arcsec()
    above = float(flight.earth.geodetic(flight.station)[2]) - flight.spec.terrain.height
    alpha = flight.look["alpha"]
    flat = above * ARCSEC / (np.sin(alpha) * np.cos(alpha))
    for name, other in (("alpha", "forward"), ("beta", "aft")):
        if f"000.height.{name}" in context.selected:
            how = (
                f"The point in the middle of the nadir line is found in the {other} line's image by the rigorous "
                "sensor, that line is turned by 1 arcsec in pitch, and the two rays are intersected again. Over flat "
                f"ground H / (sin α cos α) makes {flat:.2f} m; the curved Earth lets the rays meet at a larger angle."
            )
            yield context.check(f"000.height.{name}").evaluate(float(heights[name] or 0.0), None, how)
    if "000.height.size" in context.selected:
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
    along = np.array([sighted(m, s, flight)[1].values for m, s in zip(passes.measured, passes.sections, strict=True)])
    many = f"{len(along)} measurements, 60 points of 1.5 m a line, station 0.5 m"
    names = list(flight.pairs)
    for name in ("high_resolution", "multispectral"):
        if f"000.outlook.{name}" in context.selected:
            true = flight.along_track[name]
            off = (along[:, names.index(name)] - true) / ARCSEC
            how = (
                f"{many}; true angle along the track {np.degrees(true):.5f}° from the nadir line, one measurement "
                f"scatters by {np.std(off, ddof=1):.3f}″. The lines of sight are found in the fitted planes."
            )
            yield context.check(f"000.outlook.{name}").evaluate(*mean_of(off), how, 0.0)
    if "000.outlook.unsigned" in context.selected:
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


GROUP = group_of("000.uses", run)
