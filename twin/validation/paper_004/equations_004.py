"""Paper 004, section 3.1: equations (1) to (4) on exact chief rays of the camera, without noise."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from analysis.orientation.distortion_model import (
    distortion,
    principal_distance,
    principal_distance_and_point,
    principal_point,
)
from analysis.units import MM_PER_M as MM
from analysis.units import UM_PER_M as UM
from optics.geometry.pose import rotation_matrix
from optics.numerics.backend import Backend
from scenes.models.camera_model import ROOT, build_camera_under_test
from scenes.specs.resolved import DistortionSetup, resolve_distortion
from twin.targets.target_path import TargetPath
from twin.validation.checks.check import Check, CheckResult
from twin.validation.checks.group import CheckGroup, Context
from twin.validation.paper_004.orientation import ACCURACY_UM, POINTS

Array = NDArray[np.float64]
TEST = "distortion"

_ROUNDING = "rounding of float64, 2e-16 f, over tan W of the edge, 0.02, and ten for the sums"

CHECKS = (
    Check("004.eq2.solution", "eq. (2)", "f and p of (2) make the sum of D² least: largest difference from a "
          "least-squares solution", "µm", None, 1e-6, _ROUNDING,
          separation=1.0, alternative="half of the accuracy that the paper claims"),
    Check("004.eq3.solution", "eq. (3)", "With p = 0, f of (3) makes the sum of D² least: difference from a "
          "least-squares solution", "µm", None, 1e-6, _ROUNDING,
          separation=1.0, alternative="half of the accuracy that the paper claims"),
    Check("004.eq4.solution", "eq. (4)", "With f known, p of (4) makes the sum of D² least: difference from a "
          "least-squares solution", "µm", None, 1e-6, _ROUNDING,
          separation=1.0, alternative="half of the accuracy that the paper claims"),
    Check("004.eq3.ignored", "section 3.1, eq. (3)", "A principal point one pixel from the middle of the line can be "
          "ignored: largest change of D by (3)", "µm", ACCURACY_UM, 0.05,
          "half of the last printed digit", "at most",
          separation=2.3, alternative="twice the accuracy that the paper claims"),
    Check("004.turntable.range", "section 3.2", "The test turns the camera by no more than 5°: angle between the "
          "directions that are imaged to the ends of the line", "deg", 5.0, 0.0, "the bound itself", "at most",
          separation=5.0, alternative="twice the bound"),
)  # fmt: skip


def chief_rays(setup: DistortionSetup, backend: Backend) -> Callable[[Array], Array]:
    """Exact mapping of the camera as designed: turns W (N,), radians, of a table that turns about the camera's X, to
    places L (N,), metres, of chief rays along the line, counted from where W = 0 is imaged.
    """
    test = setup.test
    camera = build_camera_under_test(test, setup.camera, backend)
    path = TargetPath(camera.assembly, ROOT, ROOT, camera.model, backend)
    middle = path.directions(np.array([[0.0, setup.camera.bands[test.band].offset]]))[0]
    axis = np.array([1.0, 0.0, 0.0])

    def places(turn: Array) -> Array:
        light = rotation_matrix(np.append(turn, 0.0)[:, None] * axis) @ middle
        along = path.places({}, light)[:, 0]
        return np.asarray(along[:-1] - along[-1])

    return places


def run(context: Context) -> Iterator[CheckResult]:
    """The printed equations on traced chief rays, without noise."""
    context.progress(0.0, "trace chief rays")
    setup = resolve_distortion(TEST)
    places = chief_rays(setup, context.backend)
    band, test = setup.camera.bands[setup.test.band], setup.test
    half = 0.5 * test.reach * band.pixels * band.pitch
    rough = float(places(np.array([1e-3]))[0]) / 1e-3
    edge = float(np.arctan(half / rough))
    yield from _solutions(context, places, edge)
    if "004.eq3.ignored" in context.selected:
        yield _ignored(context, places, edge * np.linspace(-1.0, 1.0, test.points), band.pitch)
    if "004.turntable.range" in context.selected:
        end, most = 0.5 * band.pixels * band.pitch, 1.02 * edge / test.reach
        whole = _turn_to(places, end, most) - _turn_to(places, -end, most)
        how = (
            f"Traced chief rays of gf7 to both ends of the {band.pixels} pixels. Paper 004 does not print the field; "
            "the camera file has it from other publications."
        )
        yield context.check("004.turntable.range").evaluate(float(np.degrees(whole)), None, how)


def _turn_to(places: Callable[[Array], Array], wanted: float, most: float) -> float:
    """W within +-``most`` that is imaged to a place on the line, radians."""
    return float(brentq(lambda w: float(places(np.array([w]))[0]) - wanted, -most, most, xtol=1e-14))


def _ignored(context: Context, places: Callable[[Array], Array], turn: Array, pitch: float) -> CheckResult:
    """Count L and W from a point one pixel beside the middle, and apply (3) to the same chief rays."""
    where, beside = places(turn), _turn_to(places, pitch, float(turn[-1]))
    shift = float(places(np.array([beside]))[0])
    first = distortion(where, turn, principal_distance(where, turn))
    moved = where - shift, turn - beside
    second = distortion(*moved, principal_distance(*moved))
    change = float(np.max(np.abs(second - first)))
    edge = np.tan(turn[-1])
    most = MM * pitch * 1e-6 * ACCURACY_UM / change
    how = (
        f"{len(turn)} exact chief rays of gf7, L and W counted from a point {UM * shift:g} µm beside the middle of the "
        f"line: D changes by {1e3 * UM * change:.1f} nm at most. Without distortion it would be p tan² W, "
        f"{1e3 * UM * pitch * edge**2:.1f} nm; a radial distortion whose centre is off adds the rest. To make "
        f"{ACCURACY_UM:g} µm p would have to be {most:.1f} mm."
    )
    return context.check("004.eq3.ignored").evaluate(UM * change, None, how)


def _solutions(context: Context, places: Callable[[Array], Array], edge: float) -> Iterator[CheckResult]:
    """(2), (3), (4) against a singular value decomposition of (1)."""
    # not even about the middle, so that no sum vanishes and an error in any of them shows
    turn = edge * np.linspace(-1.0, 0.6, POINTS)
    where, t = places(turn), np.tan(turn)
    f, p = (float(v) for v in principal_distance_and_point(where, turn))
    alone = float(principal_distance(where, turn))
    known = float(principal_point(where, turn, alone))
    columns = np.column_stack([t, -(t**2)])
    both = np.linalg.lstsq(columns, where)[0]
    first = np.linalg.lstsq(columns[:, :1], where)[0]
    second = np.linalg.lstsq(columns[:, 1:], where - alone * t)[0]
    rays = f"{len(turn)} exact chief rays of gf7 from {np.degrees(turn[0]):.2f}° to {np.degrees(turn[-1]):+.2f}°"
    found = {
        "004.eq2.solution": (np.array([f, p]) - both, f"f = {MM * f:.4f} mm, p = {MM * p:.4f} mm"),
        "004.eq3.solution": (alone - first, f"f = {MM * alone:.4f} mm"),
        "004.eq4.solution": (known - second, f"p = {MM * known:.4f} mm with f of (3)"),
    }
    for identifier, (difference, values) in found.items():
        if identifier in context.selected:
            how = f"{rays}; {values}, against a singular value decomposition of (1)."
            if identifier != "004.eq3.solution":
                how += " Over points that are not even about the middle, p takes up radial distortion."
            yield context.check(identifier).evaluate(UM * float(np.max(np.abs(difference))), None, how, 0.0)


GROUP = CheckGroup("004.equations", "Interior orientation and distortion: equations (section 3.1)", 1.0, CHECKS, run)
