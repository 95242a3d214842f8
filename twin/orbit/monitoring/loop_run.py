"""Closed and open loop along one orbit: remaining errors of pointing and focus, and heights of ground points.

Heights come from forward intersection of exact lines of sight with the specified errors of image points, orbit and
attitude. The lines are traced through the state that the mechanisms have corrected; the intersection uses the lines as
calibrated, with the corrections of the processing. The truth enters only where errors are computed.

At moments that the file names, pairs of line images can be rendered, matched and intersected. The lens of a line is
then round and evenly illuminated, with the camera's f-number and the moment's traced defocus as its wavefront; detector
and band are those of the camera. Points of the second camera's image are matched in the first one's and intersected
with the lines that the user knows, on the measured trajectory.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import norm

from analysis.monitor import control_loop
from analysis.monitor.control_loop import DECAYING, LimitCycle, Margins
from analysis.monitor.disturbances import FALSE_ALARM
from analysis.monitor.model_fit import UnobservableMode, error_floor, unobservable_modes
from analysis.orbit.forward_intersection import check_errors, intersect_pair
from analysis.statistics import rms
from optics.numerics.array_math import index_of_value
from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.monitor import PARAMETERS
from scenes.specs.orbit.scene import ControlSpec, LineImageSpec
from scenes.specs.resolved import target_band
from twin.framework.procedure import Advance, BenchError, stream
from twin.monitor.image_quality import image_quality
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.orbit.flight.line_camera import LineCamera, calibrated_line, corrected_line
from twin.orbit.flight.sensor import NO_EFFECTS, Sensor
from twin.orbit.flight.trajectory import Trajectory
from twin.orbit.images.image_points import POINTS_REMEDY, PointsError, tie_points
from twin.orbit.images.line_optics import LineOptics
from twin.orbit.images.patch import PatchError, fly_patch, imaged_lines
from twin.orbit.monitoring import closed_loop, pair_flight
from twin.orbit.monitoring.closed_loop import FOCUS_FIELDS, Corrector, LoopCourse, LoopModel, defocus

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.setup import MonitorSetup


@dataclass(frozen=True, eq=False)
class ImagedPair:
    """Ground points matched in one pair of rendered line images and intersected.

    Attributes
    ----------
    moment : int
        Index of the reading after which the images are taken.
    errors : (n, 3) ndarray for n points
        Intersected minus true coordinates of the matched points: east, north, up, in metres.
    misplaced : (n, 2) ndarray
        Matched minus true position in the first camera's image, in lines and pixels.
    sigma : (2,) ndarray
        Median standard deviation predicted by the matching, in lines and pixels.
    sought : int
        Number of points for which matches were searched.
    """

    moment: int
    errors: np.ndarray
    misplaced: np.ndarray
    sigma: np.ndarray
    sought: int

    @property
    def height(self) -> tuple[float, float]:
        """Mean error in height and its standard deviation from the scatter of the points, in metres."""
        up = self.errors[:, 2]
        return float(up.mean()), float(up.std(ddof=1) / np.sqrt(len(up)))

    @property
    def matching(self) -> np.ndarray:
        """RMS error of the matched positions in the first camera's image, in lines and pixels, (2,)."""
        return np.sqrt(np.mean(self.misplaced**2, axis=0))


def imaged_pair(
    setup: MonitorSetup,
    flight: pair_flight.PairFlight,
    moment: int,
    nominal: Mapping[str, LineCamera],
    changes: Mapping[str, np.ndarray],
    foci: Mapping[str, float],
    flown: tuple[Trajectory, Trajectory],
    seed: np.random.SeedSequence,
) -> ImagedPair:
    """Render a pair of line images, match points in them, and intersect the points to ground coordinates.

    Parameters
    ----------
    setup : MonitorSetup
        Resolved test file and instrument.
    flight : PairFlight
        True lines, and calibrated lines as the analysis models them.
    moment : int
        Index of the reading.
    nominal : Mapping[str, LineCamera]
        Camera -> its line as calibrated.
    changes : Mapping[str, ndarray]
        Camera -> (4,) change that the processing corrects.
    foci : Mapping[str, float]
        Camera -> its defocus, in metres.
    flown : tuple of Trajectory
        True and measured orbit and attitude.
    seed : np.random.SeedSequence
        Seed of ground and frames.

    Raises
    ------
    BenchError
        A line cannot image the patch, or too few points are matched.
    """
    spec, pair, images = setup.test, setup.pair, setup.test.loop.images
    assert images is not None
    time, lines, calibrated = spec.times[moment], flight.lines[moment], flight.calibrated
    earth = flown[0].orbit.earth
    begin, count = time - pair_flight.HALF_SPAN, int(2.0 * pair_flight.HALF_SPAN / spec.line_time)

    def sensor(line: LineCamera, measured: bool) -> Sensor:
        return Sensor(line, flown[measured], earth, spec.line_time, begin, count, NO_EFFECTS)

    true = {name: sensor(lines[name], False) for name in pair}
    users = {name: sensor(corrected_line(nominal[name], calibrated[name], changes[name]), True) for name in pair}
    optics = {name: _optics(setup, name, foci[name]) for name in pair}
    middle = 0.5 * (spec.ground.first + spec.ground.last)
    height = images.ground.terrain.height
    at = pair_flight.second_view([true[name] for name in pair], time, middle, height)
    point = true[pair[1]].ground(np.array([(at - begin) / spec.line_time]), np.array([middle]), height)
    longitude, latitude, _ = earth.geodetic(point[0])
    recording = imaged_lines(true, users, optics, stream(seed, 0))
    try:
        position, size = (float(longitude), float(latitude)), (images.side, images.side)
        patch = fly_patch(recording, position, size, images.ground, ControlSpec(), stream(seed, 1))
        ties = tie_points(patch, images.points, source=pair[1])
    except (PatchError, PointsError) as error:
        raise BenchError(f"line images: {error}", ("mechanisms", "images"), POINTS_REMEDY) from error
    good = ties.in_all
    if np.count_nonzero(good) < _FEWEST:
        problem = f"line images: only {np.count_nonzero(good)} of {len(good)} points were matched"
        raise BenchError(problem, ("mechanisms", "images"), POINTS_REMEDY)
    ground = patch.true_point(pair[1], *ties.lines[pair[1]].position[good].T)
    should = np.stack(true[pair[0]].image(ground), axis=1)
    points = [ties.lines[name].image[good] for name in pair]
    a, b = (calibrated[name].corrected(changes[name]) for name in pair)
    first, second = (
        pair_flight.sightings(users[n], users[n].trajectory, *p.T) for n, p in zip(pair, points, strict=True)
    )
    errors = check_errors(intersect_pair(a, b, first, second).ground, ground).error
    return ImagedPair(moment, errors, points[0] - should, ties.lines[pair[0]].median_sigma, len(good))


_FEWEST = 8
"""Smallest number of matched points from which a mean height error and its scatter are computed."""
_TRANSMISSION = 0.8
"""Transmission of the lens of a rendered line image, mean over the spectrum: the default of payloads."""


def _optics(setup: MonitorSetup, name: str, defocus: float) -> LineOptics:
    camera = setup.cameras[setup.instrument.cameras[name].camera]
    band = camera.bands[target_band(camera)]
    f_number = camera.focal_length / camera.entrance_pupil
    # rms wavefront of a defocus over a round pupil
    image = LineImageSpec.model_construct(
        f_number=f_number,
        transmission=_TRANSMISSION,
        wavefront={"Z4": defocus / (16.0 * np.sqrt(3.0) * f_number**2)},
        obstruction=(),
        spectrum=band.spectrum.ends,
        detector=band.detector,
        diffusion=band.diffusion,
        tdi=band.tdi,
    )
    assert setup.line_detectors is not None
    sheet = setup.line_detectors[setup.instrument.cameras[name].camera]
    return LineOptics.from_specs(image, band.pixels, band.pitch, setup.test.line_time, sheet)


_IMAGES = 100_000
"""Number of the random stream of line images; the streams of the check points have the indices of the readings."""
GAIN_MARGIN, PHASE_MARGIN_DEG = 1.5, 30.0
"""Gain margin (a factor) and phase margin (degrees) below which a loop is barely stable: it amplifies disturbances near
its crossover frequency by a factor of two or more. For an integrator with a delay, both margins are the same limit
(Astrom, Hagglund, PID Controllers, 1995, sec. 4.4).
"""
WORSE = 0.01
"""Relative increase of an error with the loop closed, for the same random errors, above which the loop is reported to
make it worse: half a unit in the last of the two digits that reports show.
"""
_NOTHING = 1e-9
"""Size, in rad, m or MTF, below which an error counts as zero: a fraction of a milliarcsecond, a nanometre."""
FOCUS_SCALE = 10e-6
"""Defocus, in metres, that has the same weight as a metre of height in the search for unobservable modes: a tenth of
the defocus that blurs an image.
"""


@dataclass(frozen=True, eq=False)
class LoopOutcome:
    """Results over time with the loop closed or open: states, estimates, and the true errors that remain.

    Attributes
    ----------
    course : LoopCourse
        Simulated states, commands and estimates over time.
    flight : PairFlight
        Lines and check points.
    truth : (T, P) ndarray for T moments and P quantities
        True quantities when images are taken, minus the corrections of the ground processing.
    heights : CaseErrors
        Errors at the check points.
    slopes : (T, P) ndarray
        Derivatives of the mean height error with respect to the P quantities, in m/rad and m/m.
    angle : (P,) ndarray
        Derivatives of the angle (rad) between the pair's lines of sight with respect to the P quantities (rad, m);
        positive where the angle increases.
    mtf : Mapping[str, (T, 2) ndarray]
        Camera -> MTF at Nyquist along the line and along the track, mean over the fields.
    images : tuple of ImagedPair
        Pairs of line images, at the moments that the file names.
    """

    course: LoopCourse
    flight: pair_flight.PairFlight
    truth: np.ndarray
    heights: pair_flight.CaseErrors
    slopes: np.ndarray
    angle: np.ndarray
    mtf: Mapping[str, np.ndarray]
    images: tuple[ImagedPair, ...] = ()

    def posterior(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return posterior mean and sigma of a linear combination of the P quantities at T moments, (T,) each.

        Parameters
        ----------
        rows : (P,) or (T, P) ndarray
            Coefficients of the combination, the same at all moments or one row for each.
        """
        each = np.broadcast_to(rows, self.truth.shape)
        value = np.einsum("tp,tp->t", each, self.course.expected)
        variance = np.einsum("tp,tpq,tq->t", each, self.course.covariance, each)
        return value, np.sqrt(np.maximum(variance, 0.0))

    def true(self, rows: np.ndarray) -> np.ndarray:
        """Return the true values of a linear combination of the P quantities at T moments, (T,).

        Parameters
        ----------
        rows : (P,) or (T, P) ndarray
            Coefficients of the combination, the same at all moments or one row for each.
        """
        return np.einsum("tp,tp->t", np.broadcast_to(rows, self.truth.shape), self.truth)

    def ratio(self, rows: np.ndarray) -> float:
        """Return the largest error of a linear combination's posterior mean, divided by its sigma.

        Parameters
        ----------
        rows : (P,) or (T, P) ndarray
            Coefficients of the combination of P quantities, the same at all T moments or one row for each.
        """
        value, sigma = self.posterior(rows)
        positive = sigma > 0.0
        return float(np.max(np.abs(value - self.true(rows))[positive] / sigma[positive], initial=0.0))


@dataclass(frozen=True, eq=False)
class LoopAnalysis:
    """Stability of the control loop of one correction.

    Attributes
    ----------
    corrector : Corrector
        Correction that the loop applies.
    loop_gain : float
        Gain specified in the file, times the share of the mechanism's response that acts in the loop.
    margins : Margins
        Gain and phase margin of a loop with this gain and the file's delay.
    cycle : LimitCycle or None
        Limit cycle of a mechanism with discrete steps; None for a mechanism without steps.
    ends : tuple of int
        Indices of the moments at which the end of the range limited the command.
    """

    corrector: Corrector
    loop_gain: float
    margins: Margins
    cycle: LimitCycle | None
    ends: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class LoopRun:
    """Results of a test with the loop of monitor and mechanisms closed, and open for comparison.

    Attributes
    ----------
    setup : MonitorSetup
        Resolved test file and instrument.
    seed : int
        Seed of all random numbers.
    model : LoopModel
        Model of the loop.
    closed, open : LoopOutcome
        Outcome with and without the corrections.
    loops : Mapping[str, LoopAnalysis]
        Stability of each correction, by name.
    radius : float
        Spectral radius of all loops together, below 1 for a stable system.
    margin : float
        Factor by which all gains together may be increased before the loop is unstable.
    modes : tuple of UnobservableMode
        Combinations of motions that the spots do not observe; their effects are given on the height (m) and on the
        defocus (m) of the two cameras.
    unobservable_sigma : (3, T) ndarray for T moments
        Lower limits of the standard deviations of height and of both defocuses (m) for any estimate from the spots.
    """

    setup: MonitorSetup
    seed: int
    model: LoopModel
    closed: LoopOutcome
    open: LoopOutcome
    loops: Mapping[str, LoopAnalysis]
    radius: float
    margin: float
    modes: tuple[UnobservableMode, ...]
    unobservable_sigma: np.ndarray

    @property
    def stable(self) -> bool:
        """True if all loops, acting together, are stable."""
        return self.radius < DECAYING

    @property
    def margins_hold(self) -> bool:
        """True if the loops are stable with margins of at least GAIN_MARGIN and PHASE_MARGIN_DEG."""
        return self.stable and self.margin >= GAIN_MARGIN and not self.phase_deg < PHASE_MARGIN_DEG

    @property
    def worse(self) -> dict[str, tuple[float, float]]:
        """Errors that are larger with the loop closed: name -> RMS over the moments with the loop open, and closed.

        Angle and quantities are in rad and m, height in m; for the MTF at the Nyquist frequency the largest difference
        from 1 is given.
        """
        before, after = self._errors(self.open), self._errors(self.closed)
        return {n: (before[n], v) for n, v in after.items() if v > max((1.0 + WORSE) * before[n], _NOTHING)}

    def _errors(self, outcome: LoopOutcome) -> dict[str, float]:
        names = [(name, key) for name in self.model.cameras for key in (*PARAMETERS, "defocus")]
        quantities = {f"{key} of {name}": rms(outcome.truth[:, self.model.row(name, key)]) for name, key in names}
        soft = {f"MTF of {name}": 1.0 - float(mtf.min()) for name, mtf in outcome.mtf.items()}
        return {"angle": rms(outcome.true(outcome.angle)), "height": height_rms(outcome), **quantities, **soft}

    @property
    def pair(self) -> tuple[str, str]:
        """Names of the two cameras of the stereo pair."""
        return self.setup.pair

    @property
    def ratios(self) -> dict[str, float]:
        """Largest error of each quantity's posterior mean divided by its sigma, with the loop closed and open."""
        rows = {"angle": (self.open.angle,) * 2, "height": (self.closed.slopes, self.open.slopes)}
        rows |= {f"defocus of {name}": (self.model.unit(name, "defocus"),) * 2 for name in self.pair}
        return {
            name: max(self.closed.ratio(closed), self.open.ratio(opened)) for name, (closed, opened) in rows.items()
        }

    @property
    def ratio_limit(self) -> float:
        """Critical value of `ratios`, exceeded with probability `FALSE_ALARM` at most for any correlation of errors."""
        return float(norm.isf(0.5 * FALSE_ALARM / (2 * len(self.closed.course.times) * len(self.ratios))))

    @property
    def phase_deg(self) -> float:
        """Smallest phase margin of the control loops, in degrees; NaN where no loop has a phase margin."""
        phases = (analysis.margins.phase_deg for analysis in self.loops.values())
        return min(filter(math.isfinite, phases), default=math.nan)


_SCALE = np.array([1.0, FOCUS_SCALE, FOCUS_SCALE])
"""Scales of height and of the two foci in the search for unobservable modes, in metres."""


def run_loop(setup: MonitorSetup, backend: Backend, seed: int, advance: Advance) -> LoopRun:
    """Simulate a test with mechanisms with the loop closed and open, and compute the remaining errors.

    Raises
    ------
    InputError
        The instrument does not have a mechanism or a node, or it does not allow the motion.
    BenchError
        The loop cannot be run as its file describes it.
    AimError, BeamMissedError
        Light is lost.
    IntersectionError
        Rays are parallel.
    """
    spec, pair = setup.test, setup.pair
    ground_seed, monitor_seed = np.random.SeedSequence(seed).spawn(2)
    number = int(np.random.default_rng(monitor_seed).integers(2**31))
    advance("trace", 0, 1)
    experiment = MonitorExperiment(setup.resolved, backend)
    model = closed_loop.loop_model(setup, experiment)
    states = closed_loop.drifting_states(spec, experiment, number)
    advance("trace", 1, 1)
    read = closed_loop.reader(model, spec, number)
    courses = []
    for part, still in (("readings, loop closed", False), ("readings, loop open", True)):

        def report(done: int, part: str = part) -> None:
            advance(part, done, len(states))

        courses.append(closed_loop.simulate_course(model, spec, states, read, still, report))
    nominal = pair_flight.traced_pair(experiment, {}, pair)
    closed, opened = (_outcome_of(setup, course, nominal, ground_seed, advance) for course in courses)
    # height and foci of the pair
    rows = np.stack([opened.slopes.mean(axis=0), *(model.unit(name, "defocus") for name in pair)])
    analyses = {c.name: _analyse_loop(model, k, closed.course) for k, c in enumerate(model.correctors)}
    loops = (
        [analysis.loop_gain for analysis in analyses.values()],
        [corrector.spec.delay for corrector in model.correctors],
        [corrector.row for corrector in model.correctors],
    )
    radius, margin = (f(model.coupling, *loops) for f in (control_loop.spectral_radius, control_loop.common_margin))
    modes = unobservable_modes(model.prior, rows, _SCALE)
    foci = (np.full(len(states), _floor(model, row[None])[0]) for row in rows[1:])
    floors = np.stack([_floor(model, opened.slopes), *foci])
    return LoopRun(setup, seed, model, closed, opened, FrozenMap(analyses), radius, margin, modes, floors)


def _analyse_loop(model: LoopModel, k: int, course: LoopCourse) -> LoopAnalysis:
    corrector = model.correctors[k]
    spec, step = corrector.spec, corrector.spec.smallest
    gain = spec.gain * (1.0 + float(model.observed_share[k]) * (spec.response - 1.0))
    cycle = None
    if step is not None and spec.gain:
        cycle = control_loop.limit_cycle(spec.gain, spec.delay, spec.band / abs(step * corrector.sensitivity))
    ends = tuple(np.flatnonzero(course.held[:, k]).tolist())
    return LoopAnalysis(corrector, gain, control_loop.margins(gain, spec.delay), cycle, ends)


def _floor(model: LoopModel, rows: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.diag(error_floor(model.prior, rows)), 0.0))


def _outcome_of(
    setup: MonitorSetup,
    course: LoopCourse,
    nominal: Mapping[str, LineCamera],
    seed: np.random.SeedSequence,
    advance: Advance,
) -> LoopOutcome:
    """Compute the true errors of cameras, foci and heights that result from a simulated time series of states."""
    model, pair, experiment, test = course.model, setup.pair, course.model.experiment, setup.test
    axes, distance = experiment.sight.axes, experiment.nominal_truth.principal_distance
    lines = tuple(pair_flight.traced_pair(experiment, state, pair) for state in course.states)
    views = pair_flight.view_check_points(test, pair, lines, seed, advance)
    calibrated = FrozenMap({name: calibrated_line(nominal[name], axes[name], distance[name]) for name in pair})
    flight = pair_flight.PairFlight(pair, course.times, lines, calibrated, views)
    changes = {name: np.array([model.on_ground(name, row) for row in course.positions]) for name in model.cameras}
    truth = experiment.sight.truth(list(course.states))
    advance("image quality", 0, 1)
    quality = image_quality(
        experiment.instrument, experiment.backend, list(course.states), FOCUS_FIELDS, obstruction=False
    )
    # changes that the processing corrects are no errors of a camera
    errors = [truth.vector(name) - changes[name] for name in model.cameras]
    quantities = np.concatenate([*errors, defocus(quality).T], axis=1)
    slopes = np.zeros(quantities.shape)
    for name in pair:
        first = model.row(name, PARAMETERS[0])
        # an uncorrected change has the opposite effect of a wrong correction
        slopes[:, first : first + len(PARAMETERS)] = -flight.slopes[name]
    looks = [experiment.instrument.spec.cameras[name].look for name in pair]
    angle = np.zeros(quantities.shape[1])
    angle[[model.row(name, "d_alpha") for name in pair]] = [1.0, -1.0] if looks[0] > looks[1] else [-1.0, 1.0]
    mtf = {
        name: np.stack([of.mtf_along_line.mean(axis=1), of.mtf_along_track.mean(axis=1)], axis=1)
        for name, of in quality.cameras.items()
    }
    images = []
    times = test.loop.images.times if test.loop.images is not None else ()
    for done, time in enumerate(times):
        advance("line images", done, len(times))
        k = index_of_value(time, test.times)
        assert k is not None  # the file was checked
        now = {name: values[k] for name, values in changes.items()}
        foci = {name: float(quantities[k, model.row(name, "defocus")]) for name in pair}
        images.append(
            imaged_pair(setup, flight, k, nominal, now, foci, pair_flight.fly(test, seed), stream(seed, _IMAGES, k))
        )
    return LoopOutcome(course, flight, quantities, flight.case(changes), slopes, angle, FrozenMap(mtf), tuple(images))


def height_rms(outcome: LoopOutcome) -> float:
    """Return the RMS over the moments of the mean height error due to the cameras alone, in metres."""
    return rms(outcome.heights.camera)
