"""A loop of mechanisms on its instrument, and its course: at every moment spots are rendered and recovered where the
mechanisms stand, the filter takes them, commands go out, mechanisms move, and images are taken.

The filter is told what moves and by which laws, the readings, and where mechanisms are known to stand; it never sees
the state. All of it rests on exact traces: stated motions with what they do to spots, cameras and foci, what every
mechanism does to the same, and the truth of the state that the mechanisms have left.

The quantities of a loop are P = 5 K numbers of the instrument's K cameras: d_alpha, d_beta, d_gamma, d_f of each, as
all estimators have them, and after these the defocus of each, best focus less line CCD, the mean over `FOCUS_FIELDS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor.disturbances import FALSE_ALARM, Disturbances
from analysis.monitor.filter_state import Observed
from analysis.monitor.jump_detection import Jump
from analysis.monitor.kalman_filter import SeriesFilter
from analysis.monitor.recovery import MeasuredSpots, Recovery, SpotEvidence, judged_spots
from analysis.spots.centroid import mean_frames
from analysis.spots.spot_positions import SpotError
from analysis.statistics import chance_beyond, limit_of
from optics.geometry.tree import State, compose
from optics.numerics.backend import cores, one_blas_thread
from optics.numerics.number_tree import FrozenMap
from scenes.models.disturbances import drawn_motions
from scenes.models.disturbances import states_of as amounts_as_states
from scenes.specs.course import moment
from scenes.specs.motion_text import AXES, node_named
from scenes.specs.orbit.monitor import PARAMETERS, CorrectionSpec, OrbitMonitorSpec
from scenes.specs.perturbation import not_allowed
from scenes.yaml.errors import InputError, Problem, unknown
from twin.framework.procedure import BenchError
from twin.framework.random_streams import stream
from twin.monitor.image_quality import ImageQuality, image_quality
from twin.monitor.monitor_derivative import single_states, spot_jacobian
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.motions import ElementaryMotion
from twin.monitor.observation import LOST, Observing, observe
from twin.monitor.truth import truth_jacobian
from twin.orbit.monitoring.monitor_series import states_of
from twin.orbit.monitoring.pair_flight import TOO_FAR, moves_at

if TYPE_CHECKING:
    from scenes.specs.orbit.setup import MonitorSetup

FOCUS_FIELDS = (0.7, 0.0, -0.7)
"""Shares of half the line at which the focus is looked at."""
_READ = 1e-3
"""Pixels to which one reading knows a spot, about."""
_SMALL = 1e-6
"""Effect of a mechanism on its quantity, for 1 rad or 1 m, below which it has none; rad or m."""
_DISTANCE: Mapping[str, float] = FrozenMap({"shift": 1e-5, "rotate": 5e-6})
"""Steps of mechanisms over which a focus is differentiated, m and rad: foci are known to 1e-8 m."""
_DRAWN = 20
"""Random stream of the motions; detectors have the first ones."""


@dataclass(frozen=True, eq=False)
class Corrector:
    """One correction on its instrument.

    Attributes
    ----------
    name : str
        Of it.
    spec : CorrectionSpec
        What the file says.
    motion : ElementaryMotion | None
        Of its mechanism; None for a correction on the ground.
    row : int
        Number of its quantity, of P.
    effect : np.ndarray
        (P,) what 1 rad or 1 m of it does to the quantities; spots: (D,) to the spots, px.
    """

    name: str
    spec: CorrectionSpec
    motion: ElementaryMotion | None
    row: int
    effect: np.ndarray
    spots: np.ndarray

    @property
    def own(self) -> float:
        """Return the effect of 1 rad or 1 m on its quantity."""
        return float(self.effect[self.row])

    @property
    def unit(self) -> tuple[str, float]:
        """Unit in which its position is told, and its size in SI."""
        key = "um" if self.spec.kind_of("step").si == "m" else "arcsec"
        return key, 1e-6 if key == "um" else ARCSEC


@dataclass(frozen=True, eq=False)
class LoopModel:
    """A loop on its instrument.

    Attributes
    ----------
    experiment : MonitorExperiment
        The instrument.
    stated : Disturbances
        What moves, with all P quantities in place of the parameters.
    correctors : tuple[Corrector, ...]
        By name, in the order of the names, so that their order in the file does not matter.
    """

    experiment: MonitorExperiment
    stated: Disturbances
    correctors: tuple[Corrector, ...]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of all K."""
        return tuple(self.experiment.instrument.cameras)

    def row(self, camera: str, quantity: str) -> int:
        """Number of a quantity."""
        return _row(self.cameras, camera, quantity)

    def unit(self, camera: str, quantity: str) -> np.ndarray:
        """(P,) of a quantity alone."""
        return np.eye(len(self.stated.parameters))[self.row(camera, quantity)]

    def moved(self, state: State, positions: np.ndarray) -> State:
        """A state with the mechanisms at positions, which do what they really do.

        Parameters
        ----------
        state : State
            Without them.
        positions : np.ndarray
            (n,) of the correctors, rad or m.
        """
        bodies = {body.path: body for body in self.experiment.instrument.assembly.tree.bodies}
        for one, position in zip(self.correctors, positions.tolist(), strict=True):
            if one.motion is not None and position != 0.0:
                state = compose(state, one.motion.state(one.spec.response * position), bodies)
        return state

    def on_ground(self, camera: str, positions: np.ndarray) -> np.ndarray:
        """(4,) change of a camera that the processing takes for true: what its corrections undo."""
        change = np.zeros(4)
        for one, position in zip(self.correctors, positions.tolist(), strict=True):
            if one.motion is None and one.spec.camera == camera:
                change[PARAMETERS.index(one.spec.quantity)] -= position
        return change

    @cached_property
    def effects(self) -> np.ndarray:
        """(P, n) on the quantities."""
        return np.stack([one.effect for one in self.correctors], axis=1)

    @cached_property
    def spots(self) -> np.ndarray:
        """(D, n) on the spots, px."""
        return np.stack([one.spots for one in self.correctors], axis=1)

    @cached_property
    def coupling(self) -> np.ndarray:
        """(n, n) what each mechanism, a column, does to the quantity of a row over what the row's own does."""
        rows = [one.row for one in self.correctors]
        return np.asarray(self.effects[rows] / np.array([one.own for one in self.correctors])[:, None])

    @cached_property
    def seen(self) -> np.ndarray:
        """(n,) which share of what a mechanism does beyond what is known of it one reading of the spots tells."""
        gain = self.stated.best_gain(_READ**2 * np.eye(len(self.spots)))
        told = gain @ self.spots
        return np.array([told[one.row, k] / one.own for k, one in enumerate(self.correctors)])


def _row(cameras: Sequence[str], camera: str, quantity: str) -> int:
    at = cameras.index(camera)
    return 4 * len(cameras) + at if quantity == "defocus" else 4 * at + PARAMETERS.index(quantity)


def loop_model(setup: MonitorSetup, experiment: MonitorExperiment) -> LoopModel:
    """Trace what moves and what the mechanisms do.

    Raises
    ------
    InputError
        a mechanism that the instrument does not have, or that does nothing to its quantity; a node that does not exist
        or does not move so.
    AimError, BeamMissedError
        Light is lost.
    """
    stated, motions = experiment.disturbances, experiment.stated
    assert stated is not None  # the set-up states them
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
    spots = spot_jacobian(experiment.path, bodies).reshape(stated.spots.shape[0], -1) if bodies else None
    traced = truth_jacobian(experiment.instrument, experiment.backend, bodies) if bodies else {}
    correctors, k = [], 0
    for name, motion in named.items():
        spec = corrections[name]
        row = _row(cameras, spec.camera, spec.quantity)
        effect, shift = np.zeros(5 * len(cameras)), np.zeros(stated.spots.shape[0])
        if motion is None:
            effect[row] = 1.0
        else:
            assert spots is not None
            effect = np.concatenate([*(traced[camera][:, k] for camera in cameras), moved[:, len(singles) + k]])
            shift = spots[:, k]
            k += 1
            if abs(effect[row]) < _SMALL:
                problem = f"{spec.mechanism} does nothing to {spec.quantity} of {spec.camera}"
                allowed = "a motion that corrects it"
                raise test.error(problem, ("mechanisms", "corrections", name, "mechanism"), allowed=allowed)
        correctors.append(Corrector(name, spec, motion, row, effect, shift))
    whole = replace(stated, parameters=np.concatenate([stated.parameters, per_sigma]))
    return LoopModel(experiment, whole, tuple(correctors))


def defocus(quality: ImageQuality) -> np.ndarray:
    """(K, S) best focus less line CCD of every camera and state, metres; NaN where it is not known."""
    return np.stack([one.defocus.mean(axis=1) for one in quality.cameras.values()])


def _mechanism(
    setup: MonitorSetup, experiment: MonitorExperiment, name: str, spec: CorrectionSpec
) -> ElementaryMotion | None:
    """InputError unless the body exists, moves so and has the pivot."""
    if spec.mechanism is None:
        return None
    test, key = setup.test, ("mechanisms", "corrections", name, "mechanism")
    node, kind, axis, pivot = spec.motion
    nodes = experiment.instrument.nodes
    try:
        path = node_named(node, nodes)
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
    """One way through the moments: with the loop closed or open.

    Attributes
    ----------
    model : LoopModel
        Of the loop.
    times : np.ndarray
        (T,) seconds from the orbit's epoch.
    positions : np.ndarray
        (T, n) where the mechanisms are told to stand when images are taken, rad or m.
    held : np.ndarray
        (T, n) whether a command was held by the end of a range.
    expected : np.ndarray
        (T, P) what the posterior says of the quantities when images are taken.
    covariance : np.ndarray
        (T, P, P) of its error.
    chi_square : np.ndarray
        (T,) of the readings against what was expected of them before they came.
    jumps : tuple[Jump, ...]
        That the filter told.
    states : tuple[State, ...]
        Of the moments, when images are taken.
    evidence : SpotEvidence | None
        What the fits of the spots say of their sigmas; None where nobody judged them.
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
        """(T, P) standard deviations of ``expected``."""
        return np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 0.0))

    @property
    def degrees(self) -> int:
        """Degrees of freedom of all chi-squares together."""
        return int(len(self.times) * self.model.stated.spots.shape[0])

    @property
    def limit(self) -> float:
        """Limit of the sum of all chi-squares, exceeded with a chance of `FALSE_ALARM` where all is as stated."""
        return float(limit_of(FALSE_ALARM, self.degrees))

    @property
    def agrees(self) -> bool:
        """Return whether the readings, together and one by one, agree with what is stated."""
        return float(self.chi_square.sum()) <= self.limit and self.contradiction is None

    @property
    def contradiction(self) -> int | None:
        """The first reading that what is stated does not explain, at `FALSE_ALARM` over all readings; None for none."""
        chance = chance_beyond(self.chi_square, self.model.stated.spots.shape[0])
        beyond = np.flatnonzero(chance < FALSE_ALARM / len(self.times))
        return int(beyond[0]) if len(beyond) else None


def drifting_states(spec: OrbitMonitorSpec, experiment: MonitorExperiment, seed: int) -> Sequence[State]:
    """States of the moments without any mechanism: by the file's course, or by amounts that are drawn by their laws;
    with the motions of the file.

    Raises
    ------
    InputError
        a node that does not exist or does not move so.
    """
    spec.check_nodes(experiment.instrument.nodes)
    if spec.course is not None:
        return states_of(experiment, spec)
    stated, times = experiment.stated, np.array(spec.times)
    assert stated is not None
    amounts = drawn_motions(
        stated, times - times[0], lambda number: np.random.default_rng(stream(seed, _DRAWN, number))
    )
    bodies = {body.path: body for body in experiment.instrument.assembly.tree.bodies}
    drawn = amounts_as_states(amounts, stated.components, experiment.thermal)
    return [compose(s, moves_at(spec, time), bodies) for time, s in zip(spec.times, drawn, strict=True)]


Read: TypeAlias = Callable[[State, int], Recovery]
"""From a state and the number of its moment to what is read of it: shifts since images of the nominal instrument."""


def reader(model: LoopModel, spec: OrbitMonitorSpec, seed: int) -> Read:
    """Function of a state and the number of its moment -> what is read of it: rendered and recovered.

    It raises BenchError where light is lost or a spot cannot be measured.

    Parameters
    ----------
    model : LoopModel
        Of the loop.
    spec : OrbitMonitorSpec
        The test.
    seed : int
        Of the detectors.
    """
    experiment, errors = model.experiment, spec.errors
    frames = spec.frames or experiment.instrument.spec.autocollimator.frames
    noisy = errors.switched_on and errors.monitor
    if noisy:
        before = mean_frames(experiment.frames_before(frames, seed))
    else:
        before = experiment.expected_frames(experiment.nominal_photons)
    centroid = spec.analysis.centroid
    with one_blas_thread():
        first = judged_spots(before, frames, experiment.calibration, centroid, cores())

    def record(photons: np.ndarray, numbers: np.ndarray) -> tuple[MeasuredSpots, np.ndarray]:
        if not noisy:
            return first, experiment.expected_frames(photons)
        return first, mean_frames(experiment.frames_after(photons, frames, seed, numbers))

    how = Observing(record, centroid, stated=False, frames=frames)

    def read(state: State, number: int) -> Recovery:
        try:
            return next(iter(observe(experiment, [state], how, [number]))).recovery
        except (*LOST, SpotError) as error:
            text = f"the spots cannot be read at {moment(spec.times[number])}: {error}"
            raise BenchError(text, spec.times_key, f"{TOO_FAR}; a smaller range of the mechanisms") from error

    return read


def gone_through(
    model: LoopModel,
    spec: OrbitMonitorSpec,
    states: Sequence[State],
    read: Read,
    open_loop: bool,
    advance: Callable[[int], None] = lambda done: None,
) -> LoopCourse:
    """Go through the moments.

    Parameters
    ----------
    model : LoopModel
        Of the loop.
    spec : OrbitMonitorSpec
        The test.
    states : Sequence[State]
        Of its T moments without mechanisms.
    read : Read
        As of `reader`.
    open_loop : bool
        Leave all mechanisms where they are.
    advance : Callable[[int], None]
        Told of the number of moments that are done.
    """
    commands = Commands.none(model, open_loop)
    rows: list[tuple[np.ndarray, ...]] = []
    chi_square, jumps, out = [], [], []
    evidence: tuple[SpotEvidence, ...] = ()
    for k, state in enumerate(states):
        standing = commands.standing
        spots = read(model.moved(state, standing), k)
        evidence += () if spots.evidence is None else (spots.evidence,)
        before, after = (np.diag(sigma[0].ravel() ** 2) for sigma in (spots.sigma_before, spots.sigma_after))
        reading = Observed(spec.times[k] - spec.times[0], spots.shift[0] - model.spots @ standing, after)
        if not k:
            how = SeriesFilter(model.stated, before)
            belief = how.start(reading.time)
        belief, innovation = how.update(belief, reading)
        chi_square.append(innovation.chi_square)
        if innovation.jump is not None:
            jumps.append(innovation.jump)
        mean, covariance = how.parameters(how.blended(belief), reading.time)
        commands = commands.given(mean)
        position = commands.standing
        rows.append((position, commands.held, mean + model.effects @ position, covariance))
        out.append(model.moved(state, position))
        advance(k + 1)
    positions, held, expected, spread = (np.array(column) for column in zip(*rows, strict=True))
    times = np.array(spec.times)
    return LoopCourse(
        model,
        times,
        positions,
        held,
        expected,
        spread,
        np.array(chi_square),
        tuple(jumps),
        tuple(out),
        SpotEvidence.joined(evidence) if evidence else None,
    )


@dataclass(frozen=True, eq=False)
class Commands:
    """Commands to n mechanisms.

    Attributes
    ----------
    model : LoopModel
        Of the loop.
    idle : bool
        Whether none is given.
    given_before : tuple[np.ndarray, ...]
        (n,) rad or m, the newest first; empty before any reading.
    held : np.ndarray
        (n,) whether the newest was held by the end of a range.
    """

    model: LoopModel
    idle: bool
    given_before: tuple[np.ndarray, ...]
    held: np.ndarray

    @classmethod
    def none(cls, model: LoopModel, idle: bool) -> Commands:
        """Before any reading."""
        return cls(model, idle, (), np.zeros(len(model.correctors), bool))

    @property
    def standing(self) -> np.ndarray:
        """(n,) where the mechanisms are told to stand now."""
        out = np.zeros(len(self.model.correctors))
        for k, one in enumerate(self.model.correctors):
            if one.spec.delay < len(self.given_before):
                command, step = float(self.given_before[one.spec.delay][k]), one.spec.smallest
                out[k] = command if step is None else step * round(command / step)
        return out

    def given(self, mean: np.ndarray) -> Commands:
        """Commands after a reading.

        Parameters
        ----------
        mean : np.ndarray
            (P,) what the posterior says would be there without mechanisms.
        """
        left = mean + self.model.effects @ self.standing
        count = len(self.model.correctors)
        now = self.given_before[0].copy() if self.given_before else np.zeros(count)
        held = np.zeros(count, bool)
        for k, one in enumerate(self.model.correctors):
            own = float(left[one.row])
            if self.idle or one.spec.gain == 0.0 or abs(own) <= one.spec.band:
                continue
            now[k] -= one.spec.gain * own / one.own
            if one.spec.largest is not None and abs(now[k]) > one.spec.largest:
                now[k], held[k] = np.sign(now[k]) * one.spec.largest, True
        return Commands(self.model, self.idle, (now, *self.given_before), held)
