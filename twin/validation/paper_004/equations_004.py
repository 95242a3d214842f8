"""Paper 004, section 3.1: equations (1) to (4), fed with rendered collimator spots and with exact chief rays.

Measured: places of spots in rendered images, angles by the readings of a compensated turntable. True: chief rays of the
as-built camera traced at the true angles, and the camera without distortion that is nearest to them. Without noise the
equations are solved on chief rays of the camera as designed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, least_squares

from analysis.arrays import ARCSEC, Array
from analysis.arrays import MM_PER_M as MM
from analysis.arrays import UM_PER_M as UM
from analysis.orientation.interior import distortion, principal_distance, principal_distance_and_point, principal_point
from optics.geometry.pose import rotation_matrix
from optics.numerics.backend import Backend
from scenes.models.camera_model import ROOT, build_camera_under_test
from scenes.specs.resolved import DistortionSetup, resolve_distortion
from twin.laboratory.distortion_run import SimulatedDistortion
from twin.laboratory.turntable_run import rms
from twin.targets.target_path import TargetPath
from twin.validation.checks.check import Check, CheckResult
from twin.validation.checks.group import Context, group_of, load_printed
from twin.validation.paper_004.turntable_checks import dividing

ACCURACY_UM = load_printed("004").number("distortion.accuracy_um")
POINTS = load_printed("004").whole("distortion.points")
UNEVEN = slice(0, 44)
"""Points from one end of the line to six tenths of the other half: there f and p of (2) hang on each other, and the
camera's radial distortion makes a p of 54 mm, which no noise hides.
"""


@dataclass(frozen=True, eq=False)
class Perspective:
    """The camera without distortion, L = f tan(W - w) + f tan w, that is nearest to chief rays.

    Attributes:
        f: principal distance, metres.
        p: principal point f tan w, metres.
        rest: distortion of the rays, (N,), metres.
    """

    f: float
    p: float
    rest: Array

    @property
    def slope(self) -> float:
        """Slope dL / d tan W at the middle, f / cos² w, metres: what stands for f in (1), which expands to the first
        order of w. It differs from f by p² / f.
        """
        return self.f + self.p**2 / self.f

    @classmethod
    def nearest(cls, where: Array, turn: Array, tilted: bool = True) -> Perspective:
        """By nonlinear least squares, nothing expanded; with p = 0 unless ``tilted``.

        Args:
            where: of chief rays along the line, (N,), metres.
            turn: W of their directions, (N,), radians.
            tilted: whether p is sought.
        """
        start = (where[-1] - where[0]) / (np.tan(turn[-1]) - np.tan(turn[0]))

        def rest(guess: Array) -> Array:
            f, w = start * (1.0 + guess[0]), guess[1] if tilted else 0.0
            return np.asarray(where - f * (np.tan(turn - w) + np.tan(w)))

        found = least_squares(rest, np.zeros(1 + tilted), x_scale=1e-3, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        f = start * (1.0 + float(found.x[0]))
        return cls(f, f * float(np.tan(found.x[1])) if tilted else 0.0, rest(found.x))


@dataclass(frozen=True, eq=False)
class SpotTest:
    """What one rendered test gives for the equations, and the truth.

    Attributes:
        run: the test.
    """

    run: SimulatedDistortion

    @cached_property
    def place(self) -> Array:
        """L by the images, (N,), metres."""
        return self.run.compensated.fit.position

    @cached_property
    def turn(self) -> Array:
        """W by compensated readings, from the zero that the operator set, (N,), radians."""
        return self.run.compensated.fit.angle

    @cached_property
    def zeroed(self) -> Array:
        """W from the zero that the constant of a fit finds, (N,), radians."""
        return np.asarray(self.turn - self.run.compensated.zero)

    @cached_property
    def true_place(self) -> Array:
        """L of the chief rays, (N,), metres."""
        return self.run.means.mean(self.run.truth.place[..., 0])

    @cached_property
    def true_turn(self) -> Array:
        """W, (N,), radians."""
        return self.run.means.mean(self.run.truth.turn)

    @cached_property
    def camera(self) -> Perspective:
        """The traced camera's principal distance, principal point and distortion."""
        return Perspective.nearest(self.true_place, self.true_turn)

    @cached_property
    def part(self) -> Perspective:
        """The traced camera's parameters, fitted over the uneven points alone."""
        return Perspective.nearest(self.true_place[UNEVEN], self.true_turn[UNEVEN])

    @property
    def zero(self) -> float:
        """By how much the zero of W is wrong, mean over the points, radians."""
        return float(np.mean(self.turn - self.true_turn))

    def shifted(self, *powers: int) -> tuple[Array, Array]:
        """What the wrong zero alone does to a least-squares fit of these powers of tan W to the chief rays:
        coefficients (P,) and what stays in the residual (N,), metres.
        """
        columns = np.tan(self.true_turn)[:, None] ** np.array(powers)
        # what the camera images to W stands beside W + zero
        moved = -self.camera.f * self.zero * (1.0 + np.tan(self.true_turn) ** 2)
        found = np.linalg.lstsq(columns, moved)[0]
        return found, np.asarray(moved - columns @ found)

    def errors(self, turn: Array, points: slice | NDArray[np.intp]) -> tuple[float, float]:
        """Error of f and RMS error of D, metres, of constant, f and p fitted to these points with these angles."""
        found = [_fitted(self.place[points], turn[points]), _fitted(self.true_place[points], self.true_turn[points])]
        (f, rest), (f_true, rest_true) = found
        return f - f_true, rms(rest - rest_true)


def _fitted(where: Array, turn: Array) -> tuple[float, Array]:
    columns = np.tan(turn)[:, None] ** np.arange(3)
    found = np.linalg.lstsq(columns, where)[0]
    return float(found[1]), np.asarray(where - columns @ found)


def evaluate_equations(context: Context, runs: Sequence[SimulatedDistortion]) -> Iterator[CheckResult]:
    """The rows of (1) to (4)."""
    tests = [SpotTest(run) for run in runs]
    for equation in (_eq1, _eq2, _eq4):
        yield from equation(context, tests)


def _eq1(context: Context, tests: Sequence[SpotTest]) -> Iterator[CheckResult]:
    if not context.wants("004.eq1"):
        return
    printed = np.array([_by_eq1(t, t.turn) for t in tests])
    freed = np.array([_by_eq1(t, t.zeroed) for t in tests])
    left = rms(np.array([t.shifted(1, 2)[1] for t in tests]))
    alone = [t.place - principal_distance(t.place, t.turn) * np.tan(t.turn) - t.camera.rest for t in tests]
    zeros = np.array([t.zero for t in tests]) / ARCSEC
    need = ACCURACY_UM / (UM * left) * rms(zeros)
    how = (
        f"{rendered(tests)}. The zero of W is wrong by {rms(zeros):.2f}″ RMS, as an operator leaves it. (3) instead "
        f"of (2) leaves {UM * rms(np.array(alone)):.1f} µm. To keep {ACCURACY_UM:g} µm by (1) and (2) the "
        f"zero has to be right to {need:.2f}″; the paper does not say how it is set."
    )
    noise = rms(freed) / np.sqrt(len(tests))
    yield context.check("004.eq1.constant").evaluate(UM * rms(printed), UM * noise, how, None, [UM * left])
    how = (
        f"The same tests, W moved to the zero that a least-squares fit with a constant finds: median RMS error "
        f"{UM * np.median(freed):.2f} µm."
    )
    value = UM * float(np.max(freed))
    yield context.check("004.eq1.zero").evaluate(value, None, how, inputs=[dividing(value)])


def _by_eq1(test: SpotTest, turn: Array) -> float:
    """RMS error of D by (1) with f and p of (2), metres."""
    f, p = principal_distance_and_point(test.place, turn)
    return rms(distortion(test.place, turn, f, p) - test.camera.rest)


def _eq2(context: Context, tests: Sequence[SpotTest]) -> Iterator[CheckResult]:
    if not context.wants("004.eq2"):
        return
    both = np.array([principal_distance_and_point(t.place, t.turn) for t in tests])
    alone = np.array([principal_distance(t.place, t.turn) for t in tests])
    check = context.check("004.eq2.f")
    yield check.worse(_distance(check, tests, both[:, 0], "(2)"), _distance(check, tests, alone, "(3)"))
    yield _chi(context.check("004.eq2.distance"), tests)
    known = np.array([principal_point(t.place, t.turn, t.camera.f) for t in tests])
    predicted = [np.array([-t.shifted(*powers)[0][-1] for t in tests]) for powers in ((1, 2), (2,))]
    check = context.check("004.eq2.p")
    yield check.worse(
        _zero(check, tests, both[:, 1], predicted[0], "(2)"), _zero(check, tests, known, predicted[1], "(4)")
    )
    part = [principal_distance_and_point(t.place[UNEVEN], t.zeroed[UNEVEN])[1] for t in tests]
    yield _uneven(context.check("004.eq2.uneven"), tests, np.array(part))
    yield _point(context.check("004.eq2.point"), tests)


def _eq4(context: Context, tests: Sequence[SpotTest]) -> Iterator[CheckResult]:
    if context.wants("004.eq4"):
        part = [principal_point(t.place[UNEVEN], t.zeroed[UNEVEN], t.part.slope) for t in tests]
        yield _uneven(context.check("004.eq4.uneven"), tests, np.array(part))


def _distance(check: Check, tests: Sequence[SpotTest], found: Array, equation: str) -> CheckResult:
    true = np.array([t.camera.f for t in tests])
    scatter = float(np.std(found - true, ddof=1))
    how = (
        f"{rendered(tests)}, by {equation}. Truth: the camera without distortion that is nearest to the traced chief "
        f"rays. One test scatters by {MM * scatter:.3f} mm; the zero of W hardly matters to f, for the points are even "
        "about it."
    )
    # truth differs by a micrometre between tests
    measured = np.mean(true) + np.mean(found - true)
    return check.evaluate(MM * measured, MM * scatter / np.sqrt(len(tests)), how, MM * float(np.mean(true)))


def _chi(check: Check, tests: Sequence[SpotTest]) -> CheckResult:
    name = "principal_distance"
    fits = [t.run.compensated.fit for t in tests]
    score = np.array([(fit.value(name) - t.camera.f) / fit.sigma(name) for fit, t in zip(fits, tests, strict=True)])
    sigma = MM * float(np.median([fit.sigma(name) for fit in fits]))
    how = (
        f"{rendered(tests)}, fitted with a constant: {np.sum(np.abs(score) < 2.0)} within two sigma of the traced "
        f"camera; sigma of f {sigma:.3f} mm."
    )
    return check.evaluate(rms(score), 1.0 / np.sqrt(2 * len(tests)), how, 1.0)


def _zero(check: Check, tests: Sequence[SpotTest], found: Array, predicted: Array, equation: str) -> CheckResult:
    """The principal point by a printed equation: the error of the zero comes out as p."""
    error = found - np.array([t.camera.p for t in tests])
    stated = rms(np.array([t.run.compensated.fit.sigma("principal_point") for t in tests]))
    zero = rms(np.array([t.zero for t in tests]))
    true = MM * float(np.mean([t.camera.p for t in tests]))
    how = (
        f"{rendered(tests)}, by {equation}. The traced camera has p = {true:.2f} mm. The zero of W is wrong by "
        f"{zero / ARCSEC:.2f}″ RMS; 1″ makes {MM * rms(predicted) / (zero / ARCSEC):.0f} mm of p. What the zero "
        f"does not explain: {MM * rms(error - predicted):.2f} mm RMS."
    )
    return check.evaluate(MM * rms(error), MM * stated / np.sqrt(len(tests)), how, None, [MM * rms(predicted)])


def _uneven(check: Check, tests: Sequence[SpotTest], found: Array) -> CheckResult:
    true = np.array([t.part.p for t in tests])
    low, high = np.degrees(tests[0].true_turn[UNEVEN][[0, -1]])
    error = found - true
    scatter = float(np.std(error, ddof=1))
    how = (
        f"{rendered(tests)}, of them the {len(tests[0].true_turn[UNEVEN])} points from {low:.2f}° to {high:+.2f}°, W "
        "from the zero that a constant finds. There p takes up part of the radial distortion of gf7, so that it is no "
        f"longer small: the equation with all its sums is seen at work. One test scatters by {MM * scatter:.1f} mm."
    )
    value = float(np.mean(true) + np.mean(error))
    return check.evaluate(MM * value, MM * scatter / np.sqrt(len(tests)), how, MM * float(np.mean(true)))


def _point(check: Check, tests: Sequence[SpotTest]) -> CheckResult:
    name = "principal_point"
    fits = [t.run.compensated.fit for t in tests]
    pitch = tests[0].run.bench.ccd.band.pitch
    error = rms(np.array([fit.value(name) - t.camera.p for fit, t in zip(fits, tests, strict=True)])) / pitch
    stated = rms(np.array([fit.sigma(name) for fit in fits])) / pitch
    edge = float(np.tan(tests[0].true_turn[-1]) ** 2)
    with_constant, with_f = np.median([[abs(fit.correlation[2, k]) for k in (0, 1)] for fit in fits], axis=0)
    how = (
        f"{rendered(tests)}, p by least squares with a constant: RMS error {MM * pitch * error:.2f} mm, stated sigma "
        f"{MM * pitch * stated:.2f} mm. Correlation of p with the constant {with_constant:.2f}, with f {with_f:.3f} "
        "(medians of their sizes; of equal independent errors it would be 0.75 and 0)."
    )
    return check.evaluate(error, error / np.sqrt(2 * len(tests)), how, None, [stated], facts={"edge": edge})


def principal_points(tests: Sequence[SpotTest]) -> tuple[Array, Array]:
    """For a figure: error of the zero (arcsec), p of (2) and p that the zero explains (mm), (T, 3); p with a constant
    and its sigma, (T, 2), mm.
    """
    by_eq2 = [
        (t.zero / ARCSEC, MM * principal_distance_and_point(t.place, t.turn)[1], -MM * t.shifted(1, 2)[0][1])
        for t in tests
    ]
    fits = [t.run.compensated.fit for t in tests]
    free = [(MM * fit.value("principal_point"), MM * fit.sigma("principal_point")) for fit in fits]
    return np.array(by_eq2, np.float64), np.array(free)


def rendered(tests: Sequence[SpotTest]) -> str:
    """How many tests and spots."""
    places, sets = tests[0].run.record.reading.shape
    return f"{len(tests)} tests of {places} points and {sets} sets, {len(tests) * places * sets} spots rendered"


TEST = "distortion"


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
    yield _ignored(context, places, edge * np.linspace(-1.0, 1.0, test.points), band.pitch)
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
        how = f"{rays}; {values}, against a singular value decomposition of (1)."
        if identifier != "004.eq3.solution":
            how += " Over points that are not even about the middle, p takes up radial distortion."
        yield context.check(identifier).evaluate(UM * float(np.max(np.abs(difference))), None, how, 0.0)


GROUP = group_of("004.equations", run)
FIGURES = group_of("004.figures")
"""What is printed in figures without numbers: rows that nothing can be compared with."""
