"""The intersection angle test's procedure: estimates by planes and by resection, in other frames, over many passes,
with each effect on the light. Truth enters only where an estimate is compared with it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import chi2

from analysis.orbit.angles import AngleError, PlaneAngles, central_ray, intersection_angles, look_angle
from analysis.orbit.planes import METHODS, Method, NearVerticalWarning, PlaneError, PlaneFit, fit_plane
from analysis.orbit.resection import ObservedLine, Resection, ResectionError, resect
from analysis.orbit.sensitivity import Sensitivity, sensitivity
from scenes.orbit_angle import LINES
from twin.orbit.angle_test import PAIRS, AnglePass, Measurement, fly
from twin.orbit.light_effects import NO_EFFECTS, LightEffects
from twin.trial.bench_error import BenchError

if TYPE_CHECKING:
    from scenes.orbit_setup import AngleSetup

ARCSEC = np.pi / 648000.0
"""Radians."""
ANGLES = tuple(PAIRS)
FRAMES = ("Earth-fixed", "local level", "orbital", "nadir line")
EFFECTS = ("light_time", "aberration", "refraction")


@dataclass(frozen=True, eq=False)
class Estimate:
    """Angles from one measurement; pairs of numbers are alpha, beta.

    Attributes:
        planes: method -> planes of the forward, nadir and aft line.
        angles: method -> their angles.
        look: angles between the lines of sight of the lines' centres, from tls planes and places on the line, radians.
        resection: the second method.
    """

    planes: Mapping[Method, tuple[PlaneFit, ...]]
    angles: Mapping[Method, PlaneAngles]
    look: np.ndarray
    resection: Resection


@dataclass(frozen=True, eq=False)
class FrameRow:
    """One method in one frame.

    Attributes:
        frame: of `FRAMES`.
        method: of the planes.
        values: alpha, beta, radians; NaN where the method found a plane singular.
        sigma: that it claims, radians.
        steepest: smallest size of the z component of the three unit normals; 0 for a vertical plane.
        warned: the fit itself says that it is biased.
    """

    frame: str
    method: Method
    values: np.ndarray
    sigma: np.ndarray
    steepest: float
    warned: bool


@dataclass(frozen=True, eq=False)
class EffectRow:
    """What an effect on the light, or a common shift of the points, does to the angles of tls planes, radians.

    Attributes:
        what: name.
        bias: alpha, beta minus the truth without correction.
        left: the same after the analysis has taken it out; NaN where it cannot.
    """

    what: str
    bias: np.ndarray
    left: np.ndarray


@dataclass(frozen=True, eq=False)
class Scatter:
    """Repeated passes with errors drawn anew, of one estimator; pairs are alpha, beta.

    Attributes:
        values: (passes, 2), radians.
        covariance: that the estimator claims, mean over the passes, (2, 2), rad^2.
        truth: what it estimates, (2,), radians.
    """

    values: np.ndarray
    covariance: np.ndarray
    truth: np.ndarray

    @property
    def sigma(self) -> np.ndarray:
        """Claimed, (2,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def spread(self) -> np.ndarray:
        """Standard deviation of the values, (2,)."""
        return np.asarray(np.std(self.values, axis=0, ddof=1))

    @property
    def bias(self) -> np.ndarray:
        """Mean minus truth, (2,)."""
        return np.asarray(np.mean(self.values, axis=0) - self.truth)

    @property
    def tail(self) -> np.ndarray:
        """Chance that a right sigma shows a spread as far off as this one, to either side, (2,)."""
        free = len(self.values) - 1
        below = chi2.cdf(free * (self.spread / self.sigma) ** 2, free)
        return np.asarray(2.0 * np.minimum(below, 1.0 - below))


@dataclass(frozen=True, eq=False)
class AngleRun:
    """A finished test.

    Attributes:
        flight: the truth.
        measurement: of the pass that is shown.
        estimate: from it.
        frames: all methods in all frames.
        effects: each alone and all together, without errors.
        planes, resection: scatter of both methods.
        difference_sigma: standard deviation of planes minus resection over the passes, (2,), radians.
        table: sensitivity of tls planes in the Earth-fixed frame.
        height: angle -> height error of one arcsecond, metres; None where the orbit is too short.
    """

    flight: AnglePass
    measurement: Measurement
    estimate: Estimate
    frames: tuple[FrameRow, ...]
    effects: tuple[EffectRow, ...]
    planes: Scatter
    resection: Scatter
    difference_sigma: np.ndarray
    table: tuple[Sensitivity, ...]
    height: Mapping[str, float | None]

    @property
    def difference(self) -> np.ndarray:
        """Planes (tls) minus resection, (2,), radians."""
        return np.asarray(self.estimate.angles["tls"].values - resected(self.estimate.resection))


def resected(resection: Resection) -> np.ndarray:
    """alpha, beta, radians."""
    return np.array([resection.alpha, resection.beta])


def true_angles(angles: Mapping[str, float]) -> np.ndarray:
    """alpha, beta of a mapping."""
    return np.array([angles[name] for name in ANGLES])


def run_passes(setup: AngleSetup, seed: int, advance: Callable[[str, int, int], None]) -> AngleRun:
    """Fly, measure and estimate.

    Args:
        setup: the test and its camera.
        seed: of all random numbers.
        advance: told of the progress.

    Raises:
        BenchError: the test cannot be carried out as its file says.
    """
    terrain, shown, repeats = np.random.SeedSequence(seed).spawn(3)
    flight = fly(setup, terrain)
    count = setup.test.passes
    try:
        ground = flight.ground(flight.effects)
        removed = flight.effects if setup.test.effects.corrected else NO_EFFECTS
        measurement = flight.measure(ground, shown, removed)
        estimate = estimated(measurement)
        strips = [measurement.strips[name] for name in LINES]
        planes, sections = [], []
        for k, stream in enumerate(repeats.spawn(count)):
            once = flight.measure(ground, stream, removed)
            planes.append(tls_angles(once))
            sections.append(_resection(once))
            advance("passes", k + 1, count)
        first = Scatter(
            np.array([p.values for p in planes]),
            np.mean([p.covariance for p in planes], axis=0),
            true_angles(flight.dihedral),
        )
        second = Scatter(
            np.array([resected(r) for r in sections]),
            np.mean([r.angle_covariance for r in sections], axis=0),
            true_angles(flight.look),
        )
        return AngleRun(
            flight,
            measurement,
            estimate,
            frame_rows(flight, measurement),
            effect_rows(flight),
            first,
            second,
            np.std(first.values - second.values, axis=0, ddof=1),
            sensitivity(measurement.station, strips[0], strips[1], strips[2]),
            flight.height_per_arcsec(),
        )
    except (PlaneError, AngleError, ResectionError) as error:
        raise BenchError(str(error), ("strips",), "a longer strip, more points, or smaller errors") from error


def tls_angles(measurement: Measurement) -> PlaneAngles:
    """Angles between the planes by total least squares."""
    return intersection_angles(*(fit_plane(measurement.station, measurement.strips[name]) for name in LINES))


def estimated(measurement: Measurement) -> Estimate:
    """All methods. Raises PlaneError, AngleError, ResectionError."""
    planes: dict[Method, tuple[PlaneFit, ...]] = {}
    with warnings.catch_warnings():
        # the report says it, for each frame
        warnings.simplefilter("ignore", NearVerticalWarning)
        for method in METHODS:
            planes[method] = tuple(fit_plane(measurement.station, measurement.strips[n], method) for n in LINES)
    rays = {n: central_ray(p, measurement.along[n]) for n, p in zip(LINES, planes["tls"], strict=True)}
    look = np.array([float(look_angle(rays[a], rays[b])) for a, b in PAIRS.values()])
    angles = {method: intersection_angles(*fits) for method, fits in planes.items()}
    return Estimate(planes, angles, look, _resection(measurement))


def frame_rows(flight: AnglePass, measurement: Measurement) -> tuple[FrameRow, ...]:
    """Every method in every frame."""
    places = {
        FRAMES[0]: (np.eye(3), np.zeros(3)),
        FRAMES[1]: (flight.local, flight.nadir_point),
        FRAMES[2]: (flight.orbital, flight.station),
        FRAMES[3]: (flight.nadir_line, flight.station),
    }
    rows = []
    for frame, (axes, origin) in places.items():
        moved = measurement.in_frame(axes, origin)
        for method in METHODS:
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always", NearVerticalWarning)
                try:
                    fits = [fit_plane(moved.station, moved.strips[name], method) for name in LINES]
                    angles = intersection_angles(*fits)
                    values, sigma = angles.values, angles.sigma
                    steepest = min(abs(float(fit.normal[2])) for fit in fits)
                except PlaneError:
                    values, sigma, steepest = np.full(2, np.nan), np.full(2, np.nan), 0.0
            warned = any(issubclass(w.category, NearVerticalWarning) for w in said)
            rows.append(FrameRow(frame, method, values, sigma, steepest, warned))
    return tuple(rows)


def effect_rows(flight: AnglePass) -> tuple[EffectRow, ...]:
    """Each effect alone and all three, on the true points; and the datum's shift, if there is one."""
    truth = true_angles(flight.dihedral)
    none = (0.0, 0.0, 0.0)

    def off(effects: LightEffects, removed: LightEffects) -> np.ndarray:
        measured = flight.measure(flight.ground(effects), None, removed, none)
        return np.asarray(tls_angles(measured).values - truth)

    wavelength = flight.spec.effects.wavelength
    cases = {name: replace(NO_EFFECTS, wavelength=wavelength, **{name: True}) for name in EFFECTS}
    cases["all"] = LightEffects(wavelength=wavelength)
    rows = [EffectRow(name, off(effects, NO_EFFECTS), off(effects, effects)) for name, effects in cases.items()]
    if any(flight.spec.errors.datum):
        shifted = tls_angles(flight.measure(flight.ground(NO_EFFECTS), None)).values - truth
        rows.append(EffectRow("datum", np.asarray(shifted), np.full(2, np.nan)))
    return tuple(rows)


def _resection(measurement: Measurement) -> Resection:
    lines = {name: ObservedLine.of(measurement.strips[name], measurement.tangent[name]) for name in LINES}
    return resect(measurement.station, lines)
