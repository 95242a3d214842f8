"""Test of intersection angles by planes and by resection, over many passes.

The simulated truth is used only to compare estimates with it. The method of planes assumes one common projection
centre, but the line cameras of a satellite are metres apart, and the image of a mirror camera's line is curved. The
resection uses both as the laboratory measured them; its attitude, accurate to an arcsecond, then moves the points to
where they would lie for one common centre (nanoradians of the angles) and, for the angles between lines of sight, onto
straight lines.

The records below define the keys of angle.json; keys within a result begin with the name of an angle, such as alpha_deg
and alpha_arcsec_sigma.
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
from twin.orbit.flight.line_camera import LineAngles
from twin.orbit.flight.sensor import NO_EFFECTS, LightEffects

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.setup import AngleSetup, AnyAngle

EFFECTS = ("light_time", "aberration", "refraction")
"""Names of the effects on the light, which are attributes of `LightEffects`."""
BEND = 0.01 * ARCSEC
"""Standard deviation of the angle by which a line's ends have bent since the laboratory, in radians. A micrometre's
shift of a mirror bends the line of `gf7` by 1e-5 arcsec, and a rotation of its focal plane by 2 arcsec about the
rear node by 1e-3 arcsec.
"""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Angles from one measurement, in the order of the test's file.

    Attributes
    ----------
    planes : Mapping[Method, tuple[PlaneFit, ...]]
        Method -> planes of the lines.
    angles : Mapping[Method, PlaneAngles]
        Method -> dihedral angles between these planes.
    look : (m,) ndarray for m angles
        Angles between the lines of sight of the lines' centres, in radians, from planes fitted by total least squares
        and the points' positions on the line.
    along : AlongTrackAngles
        Signed along-track components of these angles.
    resection : Resection
        Space resection, the second method.
    resection_angles : AlongTrackAngles
        Angles of the resection, with the signs of the along-track angles.
    """

    planes: Mapping[Method, tuple[PlaneFit, ...]]
    angles: Mapping[Method, PlaneAngles]
    look: np.ndarray
    along: AlongTrackAngles
    resection: Resection
    resection_angles: AlongTrackAngles


@dataclass(frozen=True, eq=False)
class EffectRow:
    """Error of the angles due to an effect on the light or a common shift of the points, in radians.

    Attributes
    ----------
    names : tuple of str
        Names of the angles.
    what : str
        Name of the effect on the light, or of the shift.
    bias : (m,) ndarray for m angles
        Estimated minus true angles without correction of the effect.
    remaining : (m,) ndarray
        Estimated minus true angles after correction; NaN where no correction exists.
    """

    names: tuple[str, ...]
    what: str
    bias: np.ndarray
    remaining: np.ndarray


@dataclass(frozen=True, eq=False)
class Scatter:
    """Estimates of m angles by one method, over simulated passes with new random errors.

    Attributes
    ----------
    names : tuple of str
        Names of the angles.
    values : (passes, m) ndarray
        Estimated angles, in radians.
    covariance : (m, m) ndarray
        Mean over the passes of the covariance that the method predicts, in rad^2.
    truth : (m,) ndarray
        True angles, in radians.
    """

    names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray
    truth: np.ndarray

    @classmethod
    def of(cls, passes: Sequence[PlaneAngles] | Sequence[AlongTrackAngles], truth: Mapping[str, float]) -> Scatter:
        """Return the estimates of one method over the passes, with their predicted covariance and the true angles."""
        covariance = np.mean([estimate.covariance for estimate in passes], axis=0)
        return cls(tuple(truth), np.array([estimate.values for estimate in passes]), covariance, values_of(truth))

    @property
    def sigma(self) -> np.ndarray:
        """Predicted standard deviations of the m angles, (m,), in radians."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def spread(self) -> np.ndarray:
        """Standard deviations of the m angles over the passes, (m,), in radians."""
        return np.asarray(np.std(self.values, axis=0, ddof=1))

    @property
    def bias(self) -> np.ndarray:
        """Mean over the passes minus truth of the m angles, (m,), in radians."""
        return np.asarray(np.mean(self.values, axis=0) - self.truth)

    @property
    def p_value(self) -> np.ndarray:
        """Two-sided p-values of the spread of the m angles over the passes, given the predicted sigmas, (m,)."""
        free = len(self.values) - 1
        below = chi2.cdf(free * (self.spread / self.sigma) ** 2, free)
        return np.asarray(2.0 * np.minimum(below, 1.0 - below))


@dataclass(frozen=True, eq=False)
class PassAngles:
    """Angles of one pass, simulated or measured.

    Attributes
    ----------
    name : str
        Name of the pass.
    time : float
        Moment to which the angles refer, in seconds from the epoch.
    laboratory : LineAngles
        Angles between the lines as the laboratory measured them.
    ids : Mapping[str, (n,) ndarray for n points]
        Line -> names of its points.
    span : Mapping[str, tuple[float, float]]
        Line -> times at which it saw its first and its last point, relative to that moment, in seconds.
    measurement : Measurement
        Ground points as the lines would see them at that moment.
    estimate : Estimate
        Angles by all methods.
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
        """Estimated along-track angles minus the laboratory's, (m,) for m angles, in radians."""
        return np.asarray(self.estimate.along.values - values_of(self.laboratory.along_track))

    @property
    def pairs(self) -> Mapping[str, tuple[str, str]]:
        """Names of the two lines of each angle, by the angle's name."""
        return self.laboratory.pairs


@dataclass(frozen=True, eq=False, kw_only=True)
class AngleRun:
    """Results of a test of intersection angles, simulated or on measurements.

    Attributes
    ----------
    setup : AnyAngle
        Resolved test file and camera.
    seed : int
        Seed of all random numbers.
    passes : tuple of PassAngles
        Measured passes; for a simulation, the single pass that is shown.
    """

    setup: AnyAngle
    seed: int
    passes: tuple[PassAngles, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedAngleRun(AngleRun):
    """Results of a simulated test, with the truth.

    Attributes
    ----------
    flight : AnglePass
        True geometry at the moment of the angles.
    effects : tuple of EffectRow
        Errors of the angles due to each effect on the light alone and to all together, for points without random
        errors.
    planes, resection, along : Scatter
        Scatter over the passes of the dihedral angles (total least squares), of the resection's angles, and of the
        planes' along-track angles.
    difference_sigma : (m,) ndarray for m angles
        Standard deviation of planes minus resection over the passes, in radians.
    table : tuple of Sensitivity
        Sensitivities of the angles between planes (total least squares, Earth-fixed frame) to errors of station and
        points.
    height : Mapping[str, float or None]
        Angle -> height error for an error of one arcsecond, in metres; None where the orbit is too short.
    """

    setup: AngleSetup
    flight: AnglePass
    effects: tuple[EffectRow, ...]
    planes: Scatter
    resection: Scatter
    along: Scatter
    difference_sigma: np.ndarray
    table: tuple[Sensitivity, ...]
    height: Mapping[str, float | None]

    @property
    def measurement(self) -> Measurement:
        """Measurement of the simulated pass that the report shows in full."""
        return self.passes[0].measurement

    @property
    def estimate(self) -> Estimate:
        """Estimate of the angles from the simulated pass that the report shows in full."""
        return self.passes[0].estimate

    @property
    def shown(self) -> np.random.SeedSequence:
        """Random stream of the errors of the simulated pass that the report shows in full."""
        return _streams(self.seed)[1]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the angles."""
        return tuple(self.flight.pairs)

    @property
    def narrow(self) -> np.ndarray:
        """Mask (m,), True for each of the m angles below 5 deg, which a rotation about the lines of sight changes."""
        return narrow(self.flight)

    @property
    def difference(self) -> np.ndarray:
        """Angles from planes (total least squares) minus those from the resection, (m,), in radians.

        For each of the m angles, dihedral angles are compared; where angles are `narrow`, the angles along the track
        are compared instead.
        """
        estimate = self.estimate
        dihedral = estimate.angles["tls"].values - np.abs(estimate.resection_angles.values)
        return np.where(self.narrow, estimate.along.values - estimate.resection_angles.values, dihedral)

    @property
    def change(self) -> np.ndarray:
        """Look angles from the planes minus the laboratory's, (m,) for m angles, in radians."""
        return self.estimate.look - values_of(self.flight.before_launch.look)


def narrow(flight: AnglePass) -> np.ndarray:
    """Return the mask (m,), True for each of the m angles that the laboratory measured below 5 deg."""
    return values_of(flight.before_launch.look) < np.radians(5.0)


def values_of(angles: Mapping[str, float]) -> np.ndarray:
    """Return the values of a mapping (name of an angle -> value) as an array, in the order of the mapping."""
    return np.array(list(angles.values()))


@one_blas_thread()  # of small matrices: threads would only wait for each other
def run_angle(setup: AngleSetup, backend: Backend | None, seed: int, advance: Advance = silent) -> SimulatedAngleRun:
    """Simulate a pass, measure, and estimate the angles: ``python -m twin.orbit angle``.

    Parameters
    ----------
    setup : AngleSetup
        Resolved test file and camera.
    backend : Backend or None
        Backend on which an instrument is traced; a payload needs none.
    seed : int
        Seed of all random numbers.
    advance : Advance
        Callback that reports the progress.

    Raises
    ------
    InputError
        The changes of an instrument are not possible.
    BenchError
        The test cannot be carried out as its file describes it.
    """
    terrain, shown, repeats = _streams(seed)
    flight = fly(setup, angle_camera(setup, backend), terrain)
    count = setup.test.passes
    try:
        ground = flight.ground(flight.effects)
        removed = flight.effects if setup.test.effects.corrected else NO_EFFECTS
        measurement = flight.measure(ground, shown, removed)
        estimate = estimate_angles(measurement)
        planes, alongs, resections = [], [], []
        for k, stream in enumerate(repeats.spawn(count)):
            repeat = flight.measure(ground, stream, removed)
            section = resect_measurement(repeat)
            planes.append(tls_angles(reduce_to_station(repeat, section)))
            alongs.append(line_of_sight_angles(repeat, section)[1])
            resections.append(_resected_angles(repeat, section))
            advance("passes", k + 1, count)
        first, third = Scatter.of(planes, flight.dihedral), Scatter.of(alongs, flight.along_track)
        second = Scatter.of(resections, flight.along_track)
        common = reduce_to_station(measurement, estimate.resection)
        ids = {name: np.array([f"point {k + 1}" for k in range(len(p))]) for name, p in flight.pixel.items()}
        points = flight.before_launch, ids, dict.fromkeys(flight.lines, (0.0, 0.0))
        result = PassAngles("pass 1", flight.spec.time, *points, measurement, estimate)
        difference = np.where(narrow(flight), third.values - second.values, first.values - np.abs(second.values))
        return SimulatedAngleRun(
            setup=setup,
            seed=seed,
            passes=(result,),
            flight=flight,
            effects=effect_rows(flight),
            planes=first,
            resection=second,
            along=third,
            difference_sigma=np.std(difference, 0, ddof=1),
            table=plane_angles.sensitivity(measurement.station, common.strips, flight.pairs),
            height=flight.height_per_arcsec(),
        )
    except (PlaneError, AngleError, ResectionError) as error:
        raise BenchError(str(error), ("strips",), "a longer strip, more points, or smaller errors") from error


def _streams(seed: int) -> tuple[np.random.SeedSequence, np.random.SeedSequence, np.random.SeedSequence]:
    """Return the random streams of the terrain, of the errors of the reported pass, and of the repeated passes."""
    terrain, shown, repeats = np.random.SeedSequence(seed).spawn(3)
    return terrain, shown, repeats


def resect_measurement(measurement: Measurement) -> Resection:
    """Compute the space resection in which the second line of the first angle has zero look angle.

    Raises
    ------
    ResectionError
        The points do not determine the resection.
    """
    m = measurement
    lines = {
        name: ObservedLine.of(strip, m.tangent[name], look=m.look[name], offset=m.offset[name])
        for name, strip in m.strips.items()
    }
    return resect(m.station, lines, reference=next(iter(m.pairs.values()))[1])


def _resected_angles(measurement: Measurement, section: Resection) -> AlongTrackAngles:
    """Return the angles of a resection, with the signs of the along-track angles."""
    pairs = tuple(measurement.pairs.values())
    return AlongTrackAngles(section.angles(pairs), section.angle_covariance(pairs))


def reduce_to_station(measurement: Measurement, section: Resection) -> Measurement:
    """Move the ground points to where they would lie if all lines had their projection centres at the station.

    Parameters
    ----------
    measurement : Measurement
        Measured station and points.
    section : Resection
        Space resection of the measurement, which gives the attitude.
    """
    strips = dict(measurement.strips)
    for name, offset in measurement.offset.items():
        if np.any(offset):
            strips[name] = Strip(strips[name].points - offset @ section.axes(name).T, strips[name].covariance)
    return replace(measurement, strips=strips, offset={n: np.zeros_like(v) for n, v in measurement.offset.items()})


def tls_angles(common: Measurement) -> PlaneAngles:
    """Return the angles between planes fitted by total least squares to a measurement from `reduce_to_station`."""
    return angles_between([fit_plane(common.station, strip) for strip in common.strips.values()], common.which)


def line_of_sight_angles(measurement: Measurement, section: Resection) -> tuple[np.ndarray, AlongTrackAngles]:
    """Return the m angles between the lines' central lines of sight, (m,), in radians, and along-track components."""
    common, frames = reduce_to_station(measurement, section), []
    for name, strip in common.strips.items():
        distance = np.linalg.norm(strip.points - common.station.position, axis=1)[:, None]
        straight = Strip(strip.points + distance * measurement.bow[name] @ section.axes(name).T, strip.covariance)
        plane = fit_plane(common.station, straight)
        frames.append(plane_angles.line_frame(plane, measurement.along[name], BEND))
    looks = [plane_angles.look_angle(frames[a].central, frames[b].central) for a, b in common.which]
    return np.array(looks, np.float64), plane_angles.along_track_angles(frames, common.which)


def estimate_angles(measurement: Measurement) -> Estimate:
    """Estimate the angles by all methods; may raise PlaneError, AngleError or ResectionError."""
    section = resect_measurement(measurement)
    common = reduce_to_station(measurement, section)
    planes: dict[Method, tuple[PlaneFit, ...]] = {}
    with warnings.catch_warnings():
        # printed forms are biased where a plane is nearly vertical; the differences of the methods show it
        warnings.simplefilter("ignore", NearVerticalWarning)
        for method in METHODS:
            planes[method] = tuple(fit_plane(common.station, strip, method) for strip in common.strips.values())
    angles = {method: angles_between(fits, measurement.which) for method, fits in planes.items()}
    return Estimate(
        planes, angles, *line_of_sight_angles(measurement, section), section, _resected_angles(measurement, section)
    )


def effect_rows(flight: AnglePass) -> tuple[EffectRow, ...]:
    """Compute the errors of the angles due to each effect on the light and to all three, for error-free points.

    Where the file specifies a shift of the datum, the error due to it is the last element.
    """
    truth, names = values_of(flight.dihedral), tuple(flight.pairs)
    none = (0.0, 0.0, 0.0)

    def errors_of(effects: LightEffects, removed: LightEffects) -> np.ndarray:
        return _error_of(flight, flight.measure(flight.ground(effects), None, removed, none), truth)

    wavelength = flight.spec.effects.wavelength
    cases = {name: replace(NO_EFFECTS, wavelength=wavelength, **{name: True}) for name in EFFECTS}
    cases["all"] = LightEffects(wavelength=wavelength)
    rows = [
        EffectRow(names, name, errors_of(effects, NO_EFFECTS), errors_of(effects, effects))
        for name, effects in cases.items()
    ]
    if any(flight.spec.errors.datum):
        shifted = _error_of(flight, flight.measure(flight.ground(NO_EFFECTS), None), truth)
        rows.append(EffectRow(names, "datum", shifted, np.full(len(truth), np.nan)))
    return tuple(rows)


def _error_of(flight: AnglePass, measured: Measurement, truth: np.ndarray) -> np.ndarray:
    return np.asarray(tls_angles(reduce_to_station(measured, resect_measurement(measured))).values - truth)


ByAngle = dict[str, float | None]
"""Number for each angle of the test's file; None where it could not be computed."""


def _by_angle(names: Iterable[str], values: Iterable[float]) -> ByAngle:
    return {name: float(v) if np.isfinite(v) else None for name, v in zip(names, values, strict=True)}


def _degrees(names: Iterable[str], values: Iterable[float]) -> ByAngle:
    """Convert radians to degrees; the keys name the unit because they appear beside sigmas in arcseconds."""
    return _by_angle([f"{name}_deg" for name in names], np.degrees(list(values)))


def _with_sigmas(names: Iterable[str], angles: PlaneAngles | AlongTrackAngles) -> ByAngle:
    """Return the angles in degrees and their sigmas in arcseconds, with keys that name angle and unit."""
    names = tuple(names)
    return _degrees(names, angles.values) | _by_angle([f"{n}_arcsec_sigma" for n in names], angles.sigma / ARCSEC)


def _plane_p_values(result: PassAngles) -> dict[str, float]:
    fits = zip(result.measurement.strips, result.estimate.planes["tls"], strict=True)
    return {line: float(chi2.sf(fit.chi_square, len(fit.residual) - 2)) for line, fit in fits}


PASS: Record[PassAngles] = Record(
    "Angles of one pass, and those of the laboratory's camera.",
    Quantity("time_s", lambda p: p.time, "moment to which the points are transferred, from the epoch"),
    Quantity("points", lambda p: {k: len(ids) for k, ids in p.ids.items()}, "line -> number of its points"),
    Quantity("dihedral", lambda p: _with_sigmas(p.pairs, p.estimate.angles["tls"]), "angles between the tls planes"),
    Quantity("along_track", lambda p: _with_sigmas(p.pairs, p.estimate.along), "between the centres' lines of sight"),
    Quantity("resection", lambda p: _with_sigmas(p.pairs, p.estimate.resection_angles), "by space resection, signed"),
    Quantity("laboratory_dihedral", lambda p: _degrees(p.pairs, p.laboratory.dihedral.values()), "before launch"),
    Quantity("laboratory_along_track", lambda p: _degrees(p.pairs, p.laboratory.along_track.values()), "before launch"),
    Quantity(
        "change_arcsec", lambda p: _by_angle(p.pairs, p.change), "change of the angles along the track since then"
    ),
    Quantity("plane_p_value", _plane_p_values, "line -> p-value of the chi-square of its plane"),
    Quantity("resection_p_value", lambda p: p.estimate.resection.p_value, "p-value of the resection's chi-square"),
    Quantity("resection_agrees", lambda p: p.estimate.resection.p_value >= UNLIKELY, "true if the resection fits"),
)
UNLIKELY = 1e-3
"""p-value of chi-square below which a resection is reported as inconsistent with its sigmas."""
TRUTH: Record[SimulatedAngleRun] = Record(
    "Angles of the true camera, by each definition.",
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
    "Estimates of one method over passes with errors drawn anew.",
    Quantity("bias_arcsec", lambda s: _by_angle(s.names, s.bias), "mean over the passes minus truth"),
    Quantity("spread_arcsec", lambda s: _by_angle(s.names, s.spread), "standard deviation over the passes"),
    Quantity("sigma_arcsec", lambda s: _by_angle(s.names, s.sigma), "standard deviation predicted by the method"),
    Quantity("p_value", lambda s: _by_angle(s.names, s.p_value), "two-sided p-value of the spread under this sigma"),
)
EFFECT: Record[EffectRow] = Record(
    "Error of the angles between tls planes by an effect on the light, or by a shift of all points.",
    Quantity("what", lambda row: row.what, "name of the effect"),
    Quantity("bias_arcsec", lambda row: _by_angle(row.names, row.bias), "angles minus truth without correction"),
    Quantity("corrected_arcsec", lambda row: _by_angle(row.names, row.remaining), "angles minus truth after it"),
)
PASSES: Record[SimulatedAngleRun] = Record(
    "Passes with errors drawn anew.",
    Quantity("passes", lambda run: len(run.planes.values), "number of passes"),
    Quantity("planes", lambda run: run.planes, "dihedral angles of tls planes", record=SCATTER),
    Quantity("along_track", lambda run: run.along, "angles along the track from these planes", record=SCATTER),
    Quantity("resection", lambda run: run.resection, "angles by resection", record=SCATTER),
)


def _by_planes(run: SimulatedAngleRun) -> dict[str, ByAngle]:
    return {name: _with_sigmas(run.names, angles) for name, angles in run.estimate.angles.items()}


def _folded(run: SimulatedAngleRun) -> dict[str, bool]:
    return dict(zip(run.names, run.estimate.angles["tls"].folded.tolist(), strict=True))


def _by_resection(run: SimulatedAngleRun) -> ByAngle:
    return _with_sigmas(run.names, run.estimate.resection_angles) | {"p_value": run.estimate.resection.p_value}


ANGLE: Record[Any] = Record(
    "Content of angle.json. A test on measurements has the key `measured` alone, since it has no truth.",
    Quantity("seed", lambda run: run.seed, "seed of all random numbers"),
    Quantity("time_s", lambda run: run.flight.spec.time, "moment of exposure, from the epoch"),
    Quantity("angles", lambda run: run.flight.pairs, "the two lines of each angle"),
    Quantity("planes", _by_planes, "dihedral angles by each form of the planes, in the Earth-fixed frame"),
    Quantity("folded", _folded, "true for an angle below three sigmas, where noise biases it upward"),
    Quantity("look", lambda run: _degrees(run.names, run.estimate.look), "between the lines of sight of the centres"),
    Quantity("along_track", lambda run: _with_sigmas(run.names, run.estimate.along), "their part along the track"),
    Quantity("resection", _by_resection, "angles by space resection, and the p-value of its chi-square"),
    Quantity("truth", lambda run: run, "angles of the true camera", record=TRUTH),
    Quantity("change_arcsec", _changes, "change of the look angles since launch: estimated, true, by ray trace"),
    Quantity("difference_arcsec", lambda run: _by_angle(run.names, run.difference), "planes minus resection"),
    Quantity(
        "difference_arcsec_sigma",
        lambda run: _by_angle(run.names, run.difference_sigma),
        "standard deviation over passes",
    ),
    Quantity("sensitivity", lambda run: [row.to_dict() for row in run.table], "changes of the angles by errors"),
    Quantity("effects", lambda run: run.effects, "each effect alone and all together", record=EFFECT),
    Quantity("scatter", lambda run: run, "passes with errors drawn anew", record=PASSES),
    Quantity("height_m_per_arcsec", lambda run: run.height, "height error by 1 arcsec", converted=False),
    Quantity("measured", lambda run: {p.name: p for p in run.passes}, "pass -> its angles", record=PASS),
)
_MEASURED: Record[AngleRun] = Record(ANGLE.meaning, ANGLE["measured"])


def angle_numbers(run: AngleRun) -> dict[str, Any]:
    """Return the numbers that angle.json contains, without its description of the reference frames."""
    return ANGLE(run) if isinstance(run, SimulatedAngleRun) else _MEASURED(run)
