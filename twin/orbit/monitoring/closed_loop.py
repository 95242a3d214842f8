"""Closed loop of a monitor and correcting mechanisms on their instrument, simulated over time.

At every moment, the monitor's spots are rendered and measured with the mechanisms at their present positions, the
filter processes them, commands are sent, mechanisms move, and images are taken. The filter uses the prior of the
motions, with their temporal correlation, the readings, and the commanded positions of the mechanisms; it never uses the
true state. All effects are exact ray traces: the effects of the prior's motions and of every mechanism on spots,
cameras and foci, and the truth for the state that the mechanisms have corrected.

The quantities of a loop are P = 5 K numbers for the instrument's K cameras: rotations d_alpha, d_beta, d_gamma (rad)
and change of principal distance d_f (m) of each camera, followed by the defocus of each camera: best focus minus
position of the line CCD, in metres, mean over `FOCUS_FIELDS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor.disturbances import FALSE_ALARM, Disturbances
from analysis.monitor.filter_state import Observed
from analysis.monitor.jump_detection import Jump
from analysis.monitor.kalman_filter import SeriesFilter
from analysis.monitor.recovery import MeasuredSpots, Recovery, SpotEvidence, judged_spots
from analysis.spots.centroid import mean_frames
from analysis.spots.spot_image import SpotError
from analysis.statistics import limit_of, p_value_of
from optics.geometry.tree import State, compose
from optics.numerics.backend import cores, one_blas_thread
from optics.numerics.number_tree import FrozenMap
from scenes.models.disturbances import drawn_motions
from scenes.models.disturbances import states_of as amounts_as_states
from scenes.specs.course import moment
from scenes.specs.orbit.monitor import PARAMETERS, CorrectionSpec, OrbitMonitorSpec
from scenes.specs.perturbation import AXES, find_node, not_allowed
from scenes.yaml.errors import InputError, Problem, unknown
from twin.framework.procedure import BenchError, stream
from twin.monitor.image_quality import ImageQuality, image_quality
from twin.monitor.monitor_derivative import single_states, spot_jacobian
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import LOST, ObservationOptions, observe
from twin.monitor.truth import ElementaryMotion, truth_jacobian
from twin.orbit.monitoring.monitor_series import states_of
from twin.orbit.monitoring.pair_flight import TOO_FAR, motions_at

if TYPE_CHECKING:
    from scenes.specs.orbit.setup import MonitorSetup

FOCUS_FIELDS = (0.7, 0.0, -0.7)
"""Field positions at which the focus is computed, as distances from the middle of the line CCD in units of half its
length.
"""
_READ = 1e-3
"""Standard deviation of a spot coordinate assumed for one reading of the monitor, in pixels (approximate)."""
_SMALL = 1e-6
"""Effect of a mechanism on the quantity that it corrects, for a motion of 1 rad or 1 m, below which it counts as zero,
in rad or m.
"""
_DISTANCE: Mapping[str, float] = FrozenMap({"shift": 1e-5, "rotate": 5e-6})
"""Steps of the difference quotients of a focus with respect to a mechanism's position, in m for shifts and rad for
rotations; foci are accurate to 1e-8 m.
"""
_DRAWN = 20
"""Number of the random stream of the motions; the detectors use the numbers below it."""


@dataclass(frozen=True, eq=False)
class Corrector:
    """Correction of one quantity of the loop, by a mechanism of the instrument or in the ground processing.

    Attributes
    ----------
    name : str
        Name of the correction.
    spec : CorrectionSpec
        Section of the test file that specifies the correction.
    motion : ElementaryMotion or None
        Motion of its mechanism; None for a correction in the ground processing.
    row : int
        Index of its quantity among the P quantities of the loop.
    effect : (P,) ndarray for P quantities
        Derivatives of the P quantities with respect to the correction, per rad or per m.
    spots : (D,) ndarray for D spot coordinates
        Derivatives of the spot coordinates with respect to the correction, in px per rad or per m.
    """

    name: str
    spec: CorrectionSpec
    motion: ElementaryMotion | None
    row: int
    effect: np.ndarray
    spots: np.ndarray

    @property
    def sensitivity(self) -> float:
        """Derivative of the corrected quantity with respect to the correction, in rad or m per rad or m."""
        return float(self.effect[self.row])

    @property
    def unit(self) -> tuple[str, float]:
        """Unit in which positions of the mechanism are reported: its name, and its size in SI units."""
        key = "um" if self.spec.kind_of("step").si == "m" else "arcsec"
        return key, 1e-6 if key == "um" else ARCSEC


@dataclass(frozen=True, eq=False)
class LoopModel:
    """Linear model of a loop of monitor and mechanisms on its instrument.

    Attributes
    ----------
    experiment : MonitorExperiment
        Instrument with its monitor.
    prior : Disturbances
        Prior of the motions, for all P quantities (cameras' parameters and defocus).
    correctors : tuple of Corrector
        Corrections sorted by name, so that their order in the file does not matter.
    """

    experiment: MonitorExperiment
    prior: Disturbances
    correctors: tuple[Corrector, ...]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of all K cameras."""
        return tuple(self.experiment.instrument.cameras)

    def row(self, camera: str, quantity: str) -> int:
        """Return the index of a camera's quantity, such as a rotation or the defocus, among the loop's P quantities."""
        return _row(self.cameras, camera, quantity)

    def unit(self, camera: str, quantity: str) -> np.ndarray:
        """Return the vector (P,) that is 1 for one quantity of a camera and 0 for all other P quantities."""
        return np.eye(len(self.prior.parameters))[self.row(camera, quantity)]

    def moved(self, state: State, positions: np.ndarray) -> State:
        """Return a state of the instrument with the mechanisms at given positions, with their true response.

        Parameters
        ----------
        state : State
            State without the mechanisms.
        positions : (n,) ndarray for n correctors
            Commanded positions of the correctors, in rad or m.
        """
        bodies = {body.path: body for body in self.experiment.instrument.assembly.tree.bodies}
        for corrector, position in zip(self.correctors, positions.tolist(), strict=True):
            if corrector.motion is not None and position != 0.0:
                state = compose(state, corrector.motion.state(corrector.spec.response * position), bodies)
        return state

    def on_ground(self, camera: str, positions: np.ndarray) -> np.ndarray:
        """Return the change (4,) of a camera that the ground processing corrects: three angles (rad) and d_f (m)."""
        change = np.zeros(4)
        for corrector, position in zip(self.correctors, positions.tolist(), strict=True):
            if corrector.motion is None and corrector.spec.camera == camera:
                change[PARAMETERS.index(corrector.spec.quantity)] -= position
        return change

    @cached_property
    def effects(self) -> np.ndarray:
        """Derivatives (P, n) of the P quantities with respect to n corrections, in rad or m per rad or m."""
        return np.stack([corrector.effect for corrector in self.correctors], axis=1)

    @cached_property
    def spots(self) -> np.ndarray:
        """Derivatives (D, n) of the D spot coordinates with respect to n corrections, in px per rad or m."""
        return np.stack([corrector.spots for corrector in self.correctors], axis=1)

    @cached_property
    def coupling(self) -> np.ndarray:
        """Effect of each mechanism (column) on each corrected quantity (row), relative to that of its own mechanism.

        It is an (n, n) array for n corrections, with a diagonal of ones.
        """
        rows = [corrector.row for corrector in self.correctors]
        return np.asarray(
            self.effects[rows] / np.array([corrector.sensitivity for corrector in self.correctors])[:, None]
        )

    @cached_property
    def observed_share(self) -> np.ndarray:
        """Share of an unmodelled motion of each of n mechanisms that one reading of the spots reveals, (n,), 0 to 1."""
        gain = self.prior.best_gain(_READ**2 * np.eye(len(self.spots)))
        estimate = gain @ self.spots
        return np.array(
            [estimate[corrector.row, k] / corrector.sensitivity for k, corrector in enumerate(self.correctors)]
        )


def _row(cameras: Sequence[str], camera: str, quantity: str) -> int:
    at = cameras.index(camera)
    return 4 * len(cameras) + at if quantity == "defocus" else 4 * at + PARAMETERS.index(quantity)


def loop_model(setup: MonitorSetup, experiment: MonitorExperiment) -> LoopModel:
    """Trace the effects of the prior's motions and of the mechanisms, and return the linear model of the loop.

    Raises
    ------
    InputError
        The instrument does not have a mechanism, a mechanism has no effect on its quantity, or a node does not exist or
        does not allow the motion.
    AimError, BeamMissedError
        Light is lost.
    """
    prior, motions = experiment.disturbances, experiment.prior
    assert prior is not None  # the set-up states them
    assert motions is not None
    test, cameras, corrections = setup.test, tuple(experiment.instrument.cameras), setup.test.loop.corrections
    named = {name: _mechanism(setup, experiment, name, corrections[name]) for name in sorted(corrections)}
    bodies = tuple(motion for motion in named.values() if motion is not None)
    singles = single_states(motions.components, motions.sigma, experiment.thermal)
    sizes = np.concatenate([motions.sigma, [_DISTANCE[m.kind] for m in bodies]])
    states = [{}, *singles, *(motion.state(_DISTANCE[motion.kind]) for motion in bodies)]
    foci = defocus(image_quality(experiment.instrument, experiment.backend, states, FOCUS_FIELDS, obstruction=False))
    moved = (foci[:, 1:] - foci[:, :1]) / sizes
    per_sigma = moved[:, : len(singles)] * motions.sigma
    spots = spot_jacobian(experiment.path, bodies).reshape(prior.spots.shape[0], -1) if bodies else None
    traced = truth_jacobian(experiment.instrument, experiment.backend, bodies) if bodies else {}
    correctors, k = [], 0
    for name, motion in named.items():
        spec = corrections[name]
        row = _row(cameras, spec.camera, spec.quantity)
        effect, shift = np.zeros(5 * len(cameras)), np.zeros(prior.spots.shape[0])
        if motion is None:
            effect[row] = 1.0
        else:
            assert spots is not None
            effect = np.concatenate([*(traced[camera][:, k] for camera in cameras), moved[:, len(singles) + k]])
            shift = spots[:, k]
            k += 1
            if abs(effect[row]) < _SMALL:
                problem = f"{spec.mechanism} has no effect on {spec.quantity} of {spec.camera}"
                key = ("mechanisms", "corrections", name, "mechanism")
                raise test.error(problem, key, allowed="a motion that changes it")
        correctors.append(Corrector(name, spec, motion, row, effect, shift))
    whole = replace(prior, parameters=np.concatenate([prior.parameters, per_sigma]))
    return LoopModel(experiment, whole, tuple(correctors))


def defocus(quality: ImageQuality) -> np.ndarray:
    """Return the defocus of K cameras in S states, (K, S), in metres; NaN where it is not known.

    Defocus is the best focus minus the position of the line CCD.
    """
    return np.stack([camera.defocus.mean(axis=1) for camera in quality.cameras.values()])


def _mechanism(
    setup: MonitorSetup, experiment: MonitorExperiment, name: str, spec: CorrectionSpec
) -> ElementaryMotion | None:
    """Return the motion of a correction's mechanism.

    Raises
    ------
    InputError
        The body does not exist, does not allow the motion, or does not have the pivot.
    """
    if spec.mechanism is None:
        return None
    test, key = setup.test, ("mechanisms", "corrections", name, "mechanism")
    node, kind, axis, pivot = spec.motion
    nodes = experiment.instrument.nodes
    try:
        path = find_node(node, nodes)
    except Problem as problem:
        raise test.error(problem, key) from None
    if kind not in nodes[path].allows:
        raise InputError(not_allowed(test, nodes[path], kind, key))
    pivot = pivot or ("centre" if "centre" in nodes[path].pivots else "origin")
    if pivot not in nodes[path].known_pivots:
        raise test.error(unknown("this node has no such pivot", pivot, nodes[path].known_pivots), key)
    return ElementaryMotion(path, kind, AXES[axis], pivot, f"{path} {kind} {axis}")


@dataclass(frozen=True, eq=False)
class LoopCourse:
    """Time series of states, estimates and commands over T moments, with the loop closed or open.

    Attributes
    ----------
    model : LoopModel
        Model of the loop.
    times : (T,) ndarray
        Seconds from the orbit's epoch.
    positions : (T, n) ndarray for n mechanisms
        Commanded positions of the mechanisms when images are taken, in rad or m.
    held : (T, n) ndarray of bool
        True where the command of a mechanism was limited by the end of its range.
    expected : (T, P) ndarray for P quantities
        Posterior mean of the quantities when images are taken.
    covariance : (T, P, P) ndarray
        Posterior covariance of the quantities.
    chi_square : (T,) ndarray
        Chi-square of the difference of each reading from the filter's prediction.
    jumps : tuple of Jump
        Jumps that the filter detected.
    states : tuple of State
        True states when images are taken.
    evidence : SpotEvidence or None
        Test of the spots' sigmas by their fits; None where they were not tested.
    """

    model: LoopModel
    times: np.ndarray
    positions: np.ndarray
    held: np.ndarray
    expected: np.ndarray
    covariance: np.ndarray
    chi_square: np.ndarray
    jumps: tuple[Jump, ...]
    states: tuple[State, ...]
    evidence: SpotEvidence | None = None

    @property
    def sigma(self) -> np.ndarray:
        """Posterior standard deviations of the P quantities at T moments, (T, P), in rad and m."""
        return np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 0.0))

    @property
    def degrees(self) -> int:
        """Number of degrees of freedom of the sum of all readings' chi-squares."""
        return int(len(self.times) * self.model.prior.spots.shape[0])

    @property
    def limit(self) -> float:
        """Critical value of the sum of all chi-squares, exceeded with probability `FALSE_ALARM` for a right prior."""
        return float(limit_of(FALSE_ALARM, self.degrees))

    @property
    def agrees(self) -> bool:
        """True if the readings, together and each alone, are consistent with the prior."""
        return float(self.chi_square.sum()) <= self.limit and self.contradiction is None

    @property
    def contradiction(self) -> int | None:
        """Index of the first reading that contradicts the prior; None if none does.

        The probability of a false alarm, over all readings, is `FALSE_ALARM`.
        """
        p_value = p_value_of(self.chi_square, self.model.prior.spots.shape[0])
        beyond = np.flatnonzero(p_value < FALSE_ALARM / len(self.times))
        return int(beyond[0]) if len(beyond) else None


def drifting_states(spec: OrbitMonitorSpec, experiment: MonitorExperiment, seed: int) -> Sequence[State]:
    """Return the instrument's states at all moments, without the mechanisms, due to the motions in the file.

    The motions are those that the file tabulates over time, or random ones with the sigmas and temporal correlations of
    the file.

    Raises
    ------
    InputError
        A node does not exist or does not allow the motion.
    """
    spec.check_nodes(experiment.instrument.nodes)
    if spec.course is not None:
        return states_of(experiment, spec)
    prior, times = experiment.prior, np.array(spec.times)
    assert prior is not None
    amounts = drawn_motions(prior, times - times[0], lambda number: np.random.default_rng(stream(seed, _DRAWN, number)))
    bodies = {body.path: body for body in experiment.instrument.assembly.tree.bodies}
    drawn = amounts_as_states(amounts, prior.components, experiment.thermal)
    return [compose(s, motions_at(spec, time), bodies) for time, s in zip(spec.times, drawn, strict=True)]


Read: TypeAlias = Callable[[State, int], Recovery]
"""Function of a state and the index of its moment that returns the measured shifts of the spots since the nominal
images.
"""


def reader(model: LoopModel, spec: OrbitMonitorSpec, seed: int) -> Read:
    """Return a function that renders the monitor's images of a state at a moment and measures their spots.

    The function raises BenchError where light is lost or a spot cannot be measured.

    Parameters
    ----------
    model : LoopModel
        Model of the loop.
    spec : OrbitMonitorSpec
        Content of the test file.
    seed : int
        Seed of the detectors.
    """
    experiment, errors = model.experiment, spec.errors
    frames = spec.frames or experiment.instrument.spec.autocollimator.frames
    noisy = errors.switched_on and errors.monitor
    before = experiment.expected_frames(experiment.nominal_photons)
    if noisy:
        before = mean_frames(experiment.frames_before(frames, seed))
    centroid = spec.analysis.centroid
    with one_blas_thread():
        first = judged_spots(before, frames, experiment.calibration, centroid, cores())

    def record(photons: np.ndarray, numbers: np.ndarray) -> tuple[MeasuredSpots, np.ndarray]:
        if not noisy:
            return first, experiment.expected_frames(photons)
        return first, mean_frames(experiment.frames_after(photons, frames, seed, numbers))

    observing = ObservationOptions(record, centroid, use_prior=False, frames=frames)

    def read(state: State, number: int) -> Recovery:
        try:
            return next(iter(observe(experiment, [state], observing, [number]))).recovery
        except (*LOST, SpotError) as error:
            text = f"the spots cannot be read at {moment(spec.times[number])}: {error}"
            raise BenchError(text, spec.times_key, f"{TOO_FAR}; a smaller range of the mechanisms") from error

    return read


def simulate_course(
    model: LoopModel,
    spec: OrbitMonitorSpec,
    states: Sequence[State],
    read: Read,
    open_loop: bool,
    advance: Callable[[int], None] = lambda done: None,
) -> LoopCourse:
    """Simulate the loop over all moments.

    Parameters
    ----------
    model : LoopModel
        Model of the loop.
    spec : OrbitMonitorSpec
        Content of the test file.
    states : sequence of State
        States at the T moments, without the corrections of the mechanisms.
    read : Read
        Function that reads the spots, from `reader`.
    open_loop : bool
        True to leave all mechanisms at their initial positions.
    advance : Callable[[int], None]
        Callback that receives the number of moments finished.
    """
    commands = Commands.none(model, open_loop)
    rows: list[tuple[Any, ...]] = []
    jumps, moved_states = [], []
    evidence: tuple[SpotEvidence, ...] = ()
    for k, state in enumerate(states):
        positions_now = commands.positions_now
        spots = read(model.moved(state, positions_now), k)
        evidence += () if spots.evidence is None else (spots.evidence,)
        before, after = (np.diag(sigma[0].ravel() ** 2) for sigma in (spots.sigma_before, spots.sigma_after))
        reading = Observed(spec.times[k] - spec.times[0], spots.shift[0] - model.spots @ positions_now, after)
        if not k:
            series_filter = SeriesFilter(model.prior, before)
            filter_state = series_filter.start(reading.time)
        filter_state, innovation = series_filter.update(filter_state, reading)
        jumps += [] if innovation.jump is None else [innovation.jump]
        mean, covariance = series_filter.parameters(series_filter.mixture(filter_state), reading.time)
        commands = commands.after_reading(mean)
        position = commands.positions_now
        rows.append((position, commands.held, mean + model.effects @ position, covariance, innovation.chi_square))
        moved_states.append(model.moved(state, position))
        advance(k + 1)
    positions, held, expected, covariances, square = (np.array(column) for column in zip(*rows, strict=True))
    measured = np.array(spec.times), positions, held, expected, covariances, square
    joined = SpotEvidence.joined(evidence) if evidence else None
    return LoopCourse(model, *measured, tuple(jumps), tuple(moved_states), joined)


@dataclass(frozen=True, eq=False)
class Commands:
    """Commands sent to n mechanisms up to a moment.

    Attributes
    ----------
    model : LoopModel
        Model of the loop.
    idle : bool
        True if the loop is open, so that no commands are sent.
    history : tuple of (n,) ndarray
        Commands in rad or m, the newest first; empty before any reading.
    held : (n,) ndarray of bool
        True where the newest command was limited by the end of the mechanism's range.
    """

    model: LoopModel
    idle: bool
    history: tuple[np.ndarray, ...]
    held: np.ndarray

    @classmethod
    def none(cls, model: LoopModel, idle: bool) -> Commands:
        """Return the initial state of the commands, before any reading of the monitor."""
        return cls(model, idle, (), np.zeros(len(model.correctors), bool))

    @property
    def positions_now(self) -> np.ndarray:
        """Present positions (n,) of the n mechanisms, in rad or m, from the commands, their delay and their steps."""
        positions = np.zeros(len(self.model.correctors))
        for k, corrector in enumerate(self.model.correctors):
            if corrector.spec.delay < len(self.history):
                command, step = float(self.history[corrector.spec.delay][k]), corrector.spec.smallest
                positions[k] = command if step is None else step * round(command / step)
        return positions

    def after_reading(self, mean: np.ndarray) -> Commands:
        """Return the commands that follow a reading of the monitor.

        Parameters
        ----------
        mean : (P,) ndarray for P quantities
            Posterior mean of the quantities without mechanisms.
        """
        remaining = mean + self.model.effects @ self.positions_now
        count = len(self.model.correctors)
        now = self.history[0].copy() if self.history else np.zeros(count)
        held = np.zeros(count, bool)
        for k, corrector in enumerate(self.model.correctors):
            error = float(remaining[corrector.row])
            if self.idle or corrector.spec.gain == 0.0 or abs(error) <= corrector.spec.band:
                continue
            now[k] -= corrector.spec.gain * error / corrector.sensitivity
            if corrector.spec.largest is not None and abs(now[k]) > corrector.spec.largest:
                now[k], held[k] = np.sign(now[k]) * corrector.spec.largest, True
        return Commands(self.model, self.idle, (now, *self.history), held)
