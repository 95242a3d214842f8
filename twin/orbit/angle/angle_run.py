"""The intersection angle test's procedure: estimates by planes and by resection, in other frames, over many passes,
with each effect on the light. Truth enters only where an estimate is compared with it.

Planes go through one station. The lines of a satellite have projection centres of their own, metres apart, and a mirror
camera's line is bent. The resection takes both as the laboratory knows them; its attitude, good to an arcsecond, then
moves the points to where they would lie for one common centre (nanoradians of the angles), and for the angles between
lines of sight onto straight lines.

The quantities of an intersection-angle test, as angle.json has them.

Keys below those that name a result begin with the name of an angle, such as alpha_deg and alpha_arcsec_sigma.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import chi2

from analysis.arrays import ARCSEC
from analysis.orbit import planes as plane_angles
from analysis.orbit.planes import (
    METHODS,
    AlongTrackAngles,
    AngleError,
    Method,
    NearVerticalWarning,
    PlaneAngles,
    PlaneError,
    PlaneFit,
    Sensitivity,
    Strip,
    angles_between,
    fit_plane,
)
from analysis.orbit.resection import ObservedLine, Resection, ResectionError, resect
from optics.numerics.backend import one_blas_thread
from twin.framework.procedure import Advance, BenchError, silent
from twin.framework.record import Quantity, Record
from twin.orbit.angle.angle_flight import AnglePass, Measurement, angle_camera, fly
from twin.orbit.flight.light_effects import NO_EFFECTS, LightEffects
from twin.orbit.flight.line_camera import LineAngles

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.setup import AngleSetup, AnyAngle

EFFECTS = ("light_time", "aberration", "refraction")
BEND = 0.01 * ARCSEC
"""How far the ends of a line may have bent since the laboratory, one sigma. A micrometre's shift of a mirror bends the
line of `gf7` by 1e-5 arcsec, and a turn of its focal plane by 2 arcsec about the rear node by 1e-3 arcsec."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Angles from one measurement, in the order of the test's file.

    Attributes
    ----------
    planes : Mapping[Method, tuple[PlaneFit, ...]]
        Method -> planes of the lines.
    angles : Mapping[Method, PlaneAngles]
        Method -> their dihedral angles.
    look : np.ndarray
        Angles between the lines of sight of the lines' centres, from tls planes and places on the line, radians.
    along : AlongTrackAngles
        Their signed part along the track.
    resection : Resection
        The second method.
    resected : AlongTrackAngles
        Its angles, signed like those along the track.
    """

    planes: Mapping[Method, tuple[PlaneFit, ...]]
    angles: Mapping[Method, PlaneAngles]
    look: np.ndarray
    along: AlongTrackAngles
    resection: Resection
    resected: AlongTrackAngles


@dataclass(frozen=True, eq=False)
class FrameRow:
    """One method in one frame.

    Attributes
    ----------
    frame : str
        Its name.
    method : Method
        Of the planes.
    values : np.ndarray
        The angles, radians; NaN where the method found a plane singular.
    sigma : np.ndarray
        That it claims, radians.
    steepest : float
        Smallest size of the z component of the three unit normals; 0 for a vertical plane.
    warned : bool
        The fit itself says that it is biased.
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

    Attributes
    ----------
    names : tuple[str, ...]
        Of the angles.
    what : str
        Name of the effect.
    bias : np.ndarray
        Angles minus the truth without correction.
    left : np.ndarray
        The same after the analysis has taken it out; NaN where it cannot.
    """

    names: tuple[str, ...]
    what: str
    bias: np.ndarray
    left: np.ndarray


@dataclass(frozen=True, eq=False)
class Scatter:
    """Repeated passes with errors drawn anew, of one estimator of m angles.

    Attributes
    ----------
    names : tuple[str, ...]
        Of the angles.
    values : np.ndarray
        (passes, m), radians.
    covariance : np.ndarray
        That the estimator claims, mean over the passes, (m, m), rad^2.
    truth : np.ndarray
        What it estimates, (m,), radians.
    """

    names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray
    truth: np.ndarray

    @classmethod
    def of(cls, passes: Sequence[PlaneAngles] | Sequence[AlongTrackAngles], truth: Mapping[str, float]) -> Scatter:
        """The scatter of what one estimator found in each of the passes about the truth, radians."""
        covariance = np.mean([one.covariance for one in passes], axis=0)
        return cls(tuple(truth), np.array([one.values for one in passes]), covariance, values_of(truth))

    @property
    def sigma(self) -> np.ndarray:
        """Claimed, (m,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def spread(self) -> np.ndarray:
        """Standard deviation of the values, (m,)."""
        return np.asarray(np.std(self.values, axis=0, ddof=1))

    @property
    def bias(self) -> np.ndarray:
        """Mean minus truth, (m,)."""
        return np.asarray(np.mean(self.values, axis=0) - self.truth)

    @property
    def tail(self) -> np.ndarray:
        """Chance that a right sigma shows a spread as far off as this one, to either side, (m,)."""
        free = len(self.values) - 1
        below = chi2.cdf(free * (self.spread / self.sigma) ** 2, free)
        return np.asarray(2.0 * np.minimum(below, 1.0 - below))


@dataclass(frozen=True, eq=False)
class PassAngles:
    """Angles of one pass, simulated or measured.

    Attributes
    ----------
    name : str
        Of the pass.
    time : float
        Of the moment, seconds from the epoch.
    laboratory : LineAngles
        Angles between the lines as the laboratory knows them.
    ids : Mapping[str, np.ndarray]
        Line -> names of its points, (n,).
    span : Mapping[str, tuple[float, float]]
        Line -> first and last time of its points from the moment, seconds.
    measurement : Measurement
        Points as the lines would see them at the moment.
    estimate : Estimate
        From it.
    """

    name: str
    time: float
    laboratory: LineAngles
    ids: Mapping[str, np.ndarray]
    span: Mapping[str, tuple[float, float]]
    measurement: Measurement
    estimate: Estimate

    @property
    def change(self) -> np.ndarray:
        """Changes of the angles along the track since the laboratory, radians."""
        return np.asarray(self.estimate.along.values - values_of(self.laboratory.along_track))

    @property
    def pairs(self) -> Mapping[str, tuple[str, str]]:
        """Angle -> the two lines that it lies between."""
        return self.laboratory.pairs


@dataclass(frozen=True, eq=False, kw_only=True)
class AngleRun:
    """A finished test, simulated or on measurements.

    Attributes
    ----------
    setup : AnyAngle
        What its file says.
    seed : int
        Of all random numbers.
    passes : tuple[PassAngles, ...]
        Measured, one by one; of a simulation the one that is shown.
    """

    setup: AnyAngle
    seed: int
    passes: tuple[PassAngles, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedAngleRun(AngleRun):
    """A simulated test, which also knows the truth.

    Attributes
    ----------
    flight : AnglePass
        The truth.
    frames : tuple[FrameRow, ...]
        All methods in all frames.
    effects : tuple[EffectRow, ...]
        Each alone and all together, without errors.
    planes, resection, along : Scatter
        Scatter of the dihedral angles (tls), of the resection's, and of the planes' angles along the track.
    difference_sigma : np.ndarray
        Standard deviation of planes minus resection over the passes, (m,), radians.
    table : tuple[Sensitivity, ...]
        Sensitivity of tls planes in the Earth-fixed frame.
    height : Mapping[str, float | None]
        Angle -> height error of one arcsecond, metres; None where the orbit is too short.
    """

    setup: AngleSetup
    flight: AnglePass
    frames: tuple[FrameRow, ...]
    effects: tuple[EffectRow, ...]
    planes: Scatter
    resection: Scatter
    along: Scatter
    difference_sigma: np.ndarray
    table: tuple[Sensitivity, ...]
    height: Mapping[str, float | None]

    @property
    def measurement(self) -> Measurement:
        """Measurement of the pass that is shown."""
        return self.passes[0].measurement

    @property
    def estimate(self) -> Estimate:
        """Estimate from the pass that is shown."""
        return self.passes[0].estimate

    @property
    def shown(self) -> np.random.SeedSequence:
        """Random stream of the errors of the pass that is shown."""
        return _streams(self.seed)[1]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the angles."""
        return tuple(self.flight.pairs)

    @property
    def narrow(self) -> np.ndarray:
        """Where lines are so nearly parallel that a turn about their looks counts in the dihedral angle, (m,)."""
        return narrow(self.flight)

    @property
    def difference(self) -> np.ndarray:
        """Planes (tls) minus resection, (m,), radians: dihedral angles, but along the track where they are `narrow`."""
        estimate = self.estimate
        dihedral = estimate.angles["tls"].values - np.abs(estimate.resected.values)
        return np.where(self.narrow, estimate.along.values - estimate.resected.values, dihedral)

    @property
    def change(self) -> np.ndarray:
        """Look angles from the planes minus the laboratory's, (m,), radians."""
        return self.estimate.look - values_of(self.flight.before_launch.look)


def narrow(flight: AnglePass) -> np.ndarray:
    """Angles below 5 deg in the laboratory, (m,)."""
    return values_of(flight.before_launch.look) < np.radians(5.0)


def values_of(angles: Mapping[str, float]) -> np.ndarray:
    """The numbers of a mapping by angle, (m,)."""
    return np.array(list(angles.values()))


@one_blas_thread()  # of small matrices: threads would only wait for each other
def run_angle(setup: AngleSetup, backend: Backend | None, seed: int, advance: Advance = silent) -> SimulatedAngleRun:
    """Fly, measure and estimate: ``python -m twin.orbit angle``.

    Parameters
    ----------
    setup : AngleSetup
        The test and its camera.
    backend : Backend | None
        Where to trace an instrument; a payload needs none.
    seed : int
        Of all random numbers.
    advance : Advance
        Told of the progress.

    Raises
    ------
    InputError
        An instrument's changes are not possible.
    BenchError
        The test cannot be carried out as its file says.
    """
    terrain, shown, repeats = _streams(seed)
    flight = fly(setup, angle_camera(setup, backend), terrain)
    count = setup.test.passes
    try:
        ground = flight.ground(flight.effects)
        removed = flight.effects if setup.test.effects.corrected else NO_EFFECTS
        measurement = flight.measure(ground, shown, removed)
        estimate = estimated(measurement)
        planes, alongs, resections = [], [], []
        for k, stream in enumerate(repeats.spawn(count)):
            once = flight.measure(ground, stream, removed)
            section = resected(once)
            planes.append(tls_angles(centred(once, section)))
            alongs.append(sighted(once, section)[1])
            resections.append(_resected_angles(once, section))
            advance("passes", k + 1, count)
        first, third = Scatter.of(planes, flight.dihedral), Scatter.of(alongs, flight.along_track)
        second = Scatter.of(resections, flight.along_track)
        common = centred(measurement, estimate.resection)
        one = PassAngles(
            "pass 1",
            flight.spec.time,
            flight.before_launch,
            {name: np.array([f"point {k + 1}" for k in range(len(p))]) for name, p in flight.pixel.items()},
            dict.fromkeys(flight.lines, (0.0, 0.0)),
            measurement,
            estimate,
        )
        off = np.where(narrow(flight), third.values - second.values, first.values - np.abs(second.values))
        return SimulatedAngleRun(
            setup=setup,
            seed=seed,
            passes=(one,),
            flight=flight,
            frames=frame_rows(flight, common),
            effects=effect_rows(flight),
            planes=first,
            resection=second,
            along=third,
            difference_sigma=np.std(off, 0, ddof=1),
            table=plane_angles.sensitivity(measurement.station, common.strips, flight.pairs),
            height=flight.height_per_arcsec(),
        )
    except (PlaneError, AngleError, ResectionError) as error:
        raise BenchError(str(error), ("strips",), "a longer strip, more points, or smaller errors") from error


def _streams(seed: int) -> tuple[np.random.SeedSequence, np.random.SeedSequence, np.random.SeedSequence]:
    """Random streams of the terrain, of the errors of the pass that is shown, and of those of its repeats."""
    terrain, shown, repeats = np.random.SeedSequence(seed).spawn(3)
    return terrain, shown, repeats


def resected(measurement: Measurement) -> Resection:
    """Space resection, in which the look of the second line of the first angle is zero. Raises ResectionError."""
    m = measurement
    lines = {
        name: ObservedLine.of(strip, m.tangent[name], look=m.look[name], offset=m.offset[name])
        for name, strip in m.strips.items()
    }
    return resect(m.station, lines, reference=next(iter(m.pairs.values()))[1])


def _resected_angles(measurement: Measurement, section: Resection) -> AlongTrackAngles:
    """The angles of a resection, signed like those along the track."""
    pairs = tuple(measurement.pairs.values())
    return AlongTrackAngles(section.angles(pairs), section.angle_covariance(pairs))


def centred(measurement: Measurement, section: Resection) -> Measurement:
    """The measurement as it would be with all projection centres at the station."""
    strips = dict(measurement.strips)
    for name, offset in measurement.offset.items():
        if np.any(offset):
            strips[name] = Strip(strips[name].points - offset @ section.axes(name).T, strips[name].covariance)
    return replace(
        measurement, strips=strips, offset={name: np.zeros_like(v) for name, v in measurement.offset.items()}
    )


def tls_angles(common: Measurement) -> PlaneAngles:
    """Angles between the planes by total least squares, from a measurement that is `centred`."""
    return angles_between([fit_plane(common.station, strip) for strip in common.strips.values()], common.which)


def sighted(measurement: Measurement, section: Resection) -> tuple[np.ndarray, AlongTrackAngles]:
    """Angles between the lines of sight of the lines' centres, (m,), radians, and their part along the track."""
    common, frames = centred(measurement, section), []
    for name, strip in common.strips.items():
        distance = np.linalg.norm(strip.points - common.station.position, axis=1)[:, None]
        straight = Strip(strip.points + distance * measurement.bow[name] @ section.axes(name).T, strip.covariance)
        plane = fit_plane(common.station, straight)
        frames.append(plane_angles.line_frame(plane, measurement.along[name], BEND))
    looks = [plane_angles.look_angle(frames[a].central, frames[b].central) for a, b in common.which]
    return np.array(looks, np.float64), plane_angles.along_track_angles(frames, common.which)


def estimated(measurement: Measurement) -> Estimate:
    """The angles by all methods. Raises PlaneError, AngleError, ResectionError."""
    section = resected(measurement)
    common = centred(measurement, section)
    planes: dict[Method, tuple[PlaneFit, ...]] = {}
    with warnings.catch_warnings():
        # the report says it, for each frame
        warnings.simplefilter("ignore", NearVerticalWarning)
        for method in METHODS:
            planes[method] = tuple(fit_plane(common.station, strip, method) for strip in common.strips.values())
    angles = {method: angles_between(fits, measurement.which) for method, fits in planes.items()}
    return Estimate(planes, angles, *sighted(measurement, section), section, _resected_angles(measurement, section))


def frame_rows(flight: AnglePass, common: Measurement) -> tuple[FrameRow, ...]:
    """Every method in every frame; of a measurement that is `centred`."""
    places = {
        "Earth-fixed": (np.eye(3), np.zeros(3)),
        "local level": (flight.local, flight.middle_point),
        "orbital": (flight.orbital, flight.station),
        f"{flight.reference} line": (flight.line_axes, flight.station),
    }
    count = len(flight.pairs)
    rows = []
    for frame, (axes, origin) in places.items():
        moved = common.in_frame(axes, origin)
        for method in METHODS:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", NearVerticalWarning)
                try:
                    fits = [fit_plane(moved.station, strip, method) for strip in moved.strips.values()]
                    angles = angles_between(fits, moved.which)
                    values, sigma = angles.values, angles.sigma
                    steepest = min(abs(float(fit.normal[2])) for fit in fits)
                except PlaneError:
                    values, sigma, steepest = np.full(count, np.nan), np.full(count, np.nan), 0.0
            warned = any(issubclass(w.category, NearVerticalWarning) for w in caught)
            rows.append(FrameRow(frame, method, values, sigma, steepest, warned))
    return tuple(rows)


def effect_rows(flight: AnglePass) -> tuple[EffectRow, ...]:
    """Each effect alone and all three, on the true points; and the datum's shift, if there is one."""
    truth, names = values_of(flight.dihedral), tuple(flight.pairs)
    none = (0.0, 0.0, 0.0)

    def off(effects: LightEffects, removed: LightEffects) -> np.ndarray:
        return _off_truth(flight, flight.measure(flight.ground(effects), None, removed, none), truth)

    wavelength = flight.spec.effects.wavelength
    cases = {name: replace(NO_EFFECTS, wavelength=wavelength, **{name: True}) for name in EFFECTS}
    cases["all"] = LightEffects(wavelength=wavelength)
    rows = [EffectRow(names, name, off(effects, NO_EFFECTS), off(effects, effects)) for name, effects in cases.items()]
    if any(flight.spec.errors.datum):
        shifted = _off_truth(flight, flight.measure(flight.ground(NO_EFFECTS), None), truth)
        rows.append(EffectRow(names, "datum", shifted, np.full(len(truth), np.nan)))
    return tuple(rows)


def _off_truth(flight: AnglePass, measured: Measurement, truth: np.ndarray) -> np.ndarray:
    return np.asarray(tls_angles(centred(measured, resected(measured))).values - truth)


ByAngle = dict[str, float | None]
"""A number for each angle of the test's file; None for what could not be computed."""


def _by_angle(names: Iterable[str], values: Iterable[float]) -> ByAngle:
    return {name: float(v) if np.isfinite(v) else None for name, v in zip(names, values, strict=True)}


def _degrees(names: Iterable[str], values: Iterable[float]) -> ByAngle:
    """Radians as degrees; the keys say so, since they stand beside those of sigmas."""
    return _by_angle([f"{name}_deg" for name in names], np.degrees(list(values)))


def _with_sigmas(names: Iterable[str], angles: PlaneAngles | AlongTrackAngles | FrameRow) -> ByAngle:
    """Angles in degrees, then their sigmas in arcseconds."""
    names = tuple(names)
    return _degrees(names, angles.values) | _by_angle([f"{n}_arcsec_sigma" for n in names], angles.sigma / ARCSEC)


def _plane_chances(one: PassAngles) -> dict[str, float]:
    fits = zip(one.measurement.strips, one.estimate.planes["tls"], strict=True)
    return {line: float(chi2.sf(fit.chi_square, len(fit.residual) - 2)) for line, fit in fits}


PASS: Record[PassAngles] = Record(
    "The angles of one pass, and those of the laboratory's camera.",
    Quantity("time_s", lambda one: one.time, "moment to which the points are brought, from the epoch"),
    Quantity("points", lambda one: {k: len(ids) for k, ids in one.ids.items()}, "line -> number of its points"),
    Quantity("dihedral", lambda one: _with_sigmas(one.pairs, one.estimate.angles["tls"]), "between the tls planes"),
    Quantity("along_track", lambda one: _with_sigmas(one.pairs, one.estimate.along), "of the centres' lines of sight"),
    Quantity("resection", lambda one: _with_sigmas(one.pairs, one.estimate.resected), "by space resection, signed"),
    Quantity("laboratory_dihedral", lambda one: _degrees(one.pairs, one.laboratory.dihedral.values()), "before launch"),
    Quantity("laboratory_along_track", lambda one: _degrees(one.pairs, one.laboratory.along_track.values()), "too"),
    Quantity("change_arcsec", lambda one: _by_angle(one.pairs, one.change), "of the angles along the track since then"),
    Quantity("plane_p_value", _plane_chances, "line -> chance of a chi-square of its plane as large or larger"),
    Quantity("resection_p_value", lambda one: one.estimate.resection.p_value, "the same for the resection"),
    Quantity("resection_agrees", lambda one: one.estimate.resection.p_value >= UNLIKELY, "whether that is likely"),
)
UNLIKELY = 1e-3
"""Chance of a chi-square as large below which a resection does not fit."""
TRUTH: Record[SimulatedAngleRun] = Record(
    "The angles of the true camera, by each definition.",
    Quantity("look", lambda run: _degrees(run.names, run.flight.look.values()), "between the lines of sight"),
    Quantity("dihedral", lambda run: _degrees(run.names, run.flight.dihedral.values()), "between the planes"),
    Quantity("along_track", lambda run: _degrees(run.names, run.flight.along_track.values()), "along the track"),
)


def _changes(run: SimulatedAngleRun) -> dict[str, ByAngle]:
    flight = run.flight
    return {
        "ground": _by_angle(run.names, run.change),
        "truth": _by_angle(run.names, values_of(flight.look) - values_of(flight.before_launch.look)),
        "trace": _by_angle(flight.trace, flight.trace.values()),
    }


SCATTER: Record[Scatter] = Record(
    "One estimator over passes with errors drawn anew.",
    Quantity("bias_arcsec", lambda one: _by_angle(one.names, one.bias), "mean over the passes minus truth"),
    Quantity("spread_arcsec", lambda one: _by_angle(one.names, one.spread), "standard deviation over the passes"),
    Quantity("sigma_arcsec", lambda one: _by_angle(one.names, one.sigma), "standard deviation that it claims"),
    Quantity("p_value", lambda one: _by_angle(one.names, one.tail), "chance of such a spread if the sigma is right"),
)
EFFECT: Record[EffectRow] = Record(
    "What an effect on the light, or a shift of all points, does to the angles between tls planes.",
    Quantity("what", lambda row: row.what, "name of the effect"),
    Quantity("bias_arcsec", lambda row: _by_angle(row.names, row.bias), "angles minus truth without correction"),
    Quantity("corrected_arcsec", lambda row: _by_angle(row.names, row.left), "what the correction leaves of it"),
)
PASSES: Record[SimulatedAngleRun] = Record(
    "Passes with errors drawn anew.",
    Quantity("passes", lambda run: len(run.planes.values), "how many"),
    Quantity("planes", lambda run: run.planes, "dihedral angles of tls planes", record=SCATTER),
    Quantity("along_track", lambda run: run.along, "angles along the track from these planes", record=SCATTER),
    Quantity("resection", lambda run: run.resection, "angles by resection", record=SCATTER),
)


def _frame(names: Iterable[str], row: FrameRow) -> dict[str, Any]:
    normal = {"least_normal_z": row.steepest, "near_vertical": row.warned}
    return {"frame": row.frame, "method": row.method, **_with_sigmas(names, row), **normal}


def _by_planes(run: SimulatedAngleRun) -> dict[str, ByAngle]:
    return {name: _with_sigmas(run.names, one) for name, one in run.estimate.angles.items()}


def _folded(run: SimulatedAngleRun) -> dict[str, bool]:
    return dict(zip(run.names, run.estimate.angles["tls"].folded.tolist(), strict=True))


def _by_resection(run: SimulatedAngleRun) -> ByAngle:
    return _with_sigmas(run.names, run.estimate.resected) | {"p_value": run.estimate.resection.p_value}


ANGLE: Record[Any] = Record(
    "angle.json. Measurements have no truth: of them there is the key `measured` alone.",
    Quantity("seed", lambda run: run.seed, "of all random numbers"),
    Quantity("time_s", lambda run: run.flight.spec.time, "moment of exposure, from the epoch"),
    Quantity("angles", lambda run: run.flight.pairs, "the two lines that each angle lies between"),
    Quantity("planes", _by_planes, "dihedral angles by each form of the planes, in the Earth-fixed frame"),
    Quantity("folded", _folded, "whether an angle is below three sigmas, where its noise pushes it up"),
    Quantity("look", lambda run: _degrees(run.names, run.estimate.look), "between the lines of sight of the centres"),
    Quantity("along_track", lambda run: _with_sigmas(run.names, run.estimate.along), "their part along the track"),
    Quantity("resection", _by_resection, "angles by space resection, and the chance of its chi-square"),
    Quantity("truth", lambda run: run, "the angles of the true camera", record=TRUTH),
    Quantity("change_arcsec", _changes, "change of the look angles since launch: found, true, and by the trace"),
    Quantity("difference_arcsec", lambda run: _by_angle(run.names, run.difference), "planes minus resection"),
    Quantity("difference_arcsec_sigma", lambda run: _by_angle(run.names, run.difference_sigma), "over the passes"),
    Quantity("sensitivity", lambda run: [row.to_dict() for row in run.table], "answers of the angles to errors"),
    Quantity("effects", lambda run: run.effects, "each effect alone and all together", record=EFFECT),
    Quantity("frames", lambda run: [_frame(run.names, row) for row in run.frames], "every form in every frame"),
    Quantity("scatter", lambda run: run, "passes with errors drawn anew", record=PASSES),
    Quantity("height_m_per_arcsec", lambda run: run.height, "error of intersected heights", converted=False),
    Quantity("measured", lambda run: {one.name: one for one in run.passes}, "pass -> its angles", record=PASS),
)
_MEASURED: Record[AngleRun] = Record(ANGLE.meaning, ANGLE["measured"])


def angle_numbers(run: AngleRun) -> dict[str, Any]:
    """Contents of angle.json without its frames."""
    return ANGLE(run) if isinstance(run, SimulatedAngleRun) else _MEASURED(run)
