"""The course of a loop: at every moment the mechanisms stand where they are, the spots are rendered and recovered, the
filter takes them, commands go out, mechanisms move, and images are taken.

The filter is told what moves and by which laws, the readings, and where mechanisms are known to stand; it never sees
the state. The truth comes from the exact trace of the state that the mechanisms have left.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from analysis.monitor.disturbances import FALSE_ALARM
from analysis.monitor.filter_state import Observed
from analysis.monitor.jump_detection import Jump
from analysis.monitor.recovery import MeasuredSpots, judged_spots
from analysis.monitor.series_filter import SeriesFilter
from analysis.monitor.spot_evidence import SpotEvidence
from analysis.spots.centroid import mean_frames
from analysis.spots.spot_positions import SpotError
from analysis.statistics import chance_beyond, limit_of
from optics.geometry.tree import Motion, State, compose
from optics.numerics.threads import cores, one_blas_thread
from scenes.models.disturbances import states_of
from scenes.models.drawn_motions import drawn_motions
from scenes.specs.course import moment
from scenes.specs.orbit.loop import OrbitLoopSpec
from scenes.specs.perturbation import perturbation_issues
from scenes.yaml.errors import InputError
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import LOST, Observing, observe
from twin.orbit.loop.loop_model import LoopModel
from twin.orbit.monitoring.monitor_series import TOO_FAR
from twin.run.procedure import BenchError
from twin.run.random_streams import stream

_DRAWN = 20
"""Random stream of the motions; detectors have the first ones."""


@dataclass(frozen=True, eq=False)
class LoopCourse:
    """One way through the moments: with the loop closed or open.

    Attributes:
        model: of the loop.
        times: (T,) seconds from the orbit's epoch.
        positions: (T, n) where the mechanisms are told to stand when images are taken, rad or m.
        held: (T, n) whether a command was held by the end of a range.
        expected: (T, P) what the posterior says of the quantities when images are taken.
        covariance: (T, P, P) of its error.
        chi_square: (T,) of the readings against what was expected of them before they came.
        jumps: that the filter told.
        states: of the moments, when images are taken.
        evidence: what the fits of the spots say of their sigmas; None where nobody judged them.
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
        """Of freedom of all chi-squares together."""
        return int(len(self.times) * self.model.stated.spots.shape[0])

    @property
    def limit(self) -> float:
        """Of the sum of all chi-squares, exceeded with a chance of `FALSE_ALARM` where all is as stated."""
        return float(limit_of(FALSE_ALARM, self.degrees))

    @property
    def agrees(self) -> bool:
        """Whether the readings, together and one by one, agree with what is stated."""
        return float(self.chi_square.sum()) <= self.limit and self.contradiction is None

    @property
    def contradiction(self) -> int | None:
        """The first reading that what is stated does not explain, at `FALSE_ALARM` over all readings; None for none."""
        chance = chance_beyond(self.chi_square, self.model.stated.spots.shape[0])
        beyond = np.flatnonzero(chance < FALSE_ALARM / len(self.times))
        return int(beyond[0]) if len(beyond) else None


def drifting_states(spec: OrbitLoopSpec, experiment: MonitorExperiment, seed: int) -> tuple[State, ...]:
    """States of the moments without any mechanism: amounts drawn by their laws, and the motions of the file.

    Raises:
        InputError: a node that does not exist or does not move so.
    """
    stated, nodes = experiment.stated, experiment.instrument.nodes
    assert stated is not None
    issues = [
        issue
        for path, motion in spec.motion.items()
        for issue in perturbation_issues(spec, nodes, path, motion.furthest, ("motion", path))
    ]
    if issues:
        raise InputError(*issues)
    times = np.array(spec.readings.times)
    amounts = drawn_motions(
        stated, times - times[0], lambda number: np.random.default_rng(stream(seed, _DRAWN, number))
    )
    bodies = {body.path: body for body in experiment.instrument.assembly.tree.bodies}
    out = []
    drawn = states_of(amounts, stated.components, experiment.thermal)
    for time, state in zip(times.tolist(), drawn, strict=True):
        for path, motion in spec.motion.items():
            share = motion.share(time)
            rotate, shift = ((share * v[0], share * v[1], share * v[2]) for v in (motion.rotate, motion.shift))
            state = compose(state, {path: Motion(rotate, shift, motion.pivot)}, bodies)
        out.append(state)
    return tuple(out)


@dataclass(frozen=True, eq=False)
class Reading:
    """What is read of one state.

    Attributes:
        observed: shifts of the spots, px, since the images of the nominal instrument.
        reference: (D, D) px^2 of the spots in those, from which all shifts are counted.
        evidence: what the fits of the spots say of their sigmas; None where nobody judged them.
    """

    observed: Observed
    reference: np.ndarray
    evidence: SpotEvidence | None = None


Read: TypeAlias = Callable[[State, int], Reading]


def reader(model: LoopModel, spec: OrbitLoopSpec, seed: int) -> Read:
    """Function of a state and the number of its moment -> what is read of it: rendered and recovered.

    It raises BenchError where light is lost or a spot cannot be measured.

    Args:
        model: of the loop.
        spec: the test.
        seed: of the detectors.
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

    def read(state: State, number: int) -> Reading:
        when = spec.readings.times[number]
        try:
            found = next(iter(observe(experiment, [state], how, [number]))).recovery
        except (*LOST, SpotError) as error:
            text = f"the spots cannot be read at {moment(when)}: {error}"
            raise BenchError(text, ("readings",), f"{TOO_FAR}; a smaller range of the mechanisms") from error
        before, after = (np.diag(sigma[0].ravel() ** 2) for sigma in (found.sigma_before, found.sigma_after))
        return Reading(Observed(when - spec.readings.times[0], found.shift[0], after), before, found.evidence)

    return read


def gone_through(
    model: LoopModel,
    spec: OrbitLoopSpec,
    states: Sequence[State],
    read: Read,
    open_loop: bool,
    advance: Callable[[int], None] = lambda done: None,
) -> LoopCourse:
    """Go through the moments.

    Args:
        model: of the loop.
        spec: the test.
        states: of its T moments without mechanisms.
        read: as of `reader`.
        open_loop: leave all mechanisms where they are.
        advance: told of the number of moments that are done.
    """
    commands = Commands.none(model, open_loop)
    rows: list[tuple[np.ndarray, ...]] = []
    chi_square, jumps, out = [], [], []
    evidence: tuple[SpotEvidence, ...] = ()
    for k, state in enumerate(states):
        standing = commands.standing
        found = read(model.moved(state, standing), k)
        reading = found.observed
        evidence += () if found.evidence is None else (found.evidence,)
        if not k:
            how = SeriesFilter(model.stated, found.reference)
            belief = how.start(reading.time)
        known = replace(reading, value=reading.value - model.spots @ standing)
        belief, innovation = how.update(belief, known)
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
    times = np.array(spec.readings.times)
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

    Attributes:
        model: of the loop.
        idle: whether none is given.
        given_before: (n,) rad or m, the newest first; empty before any reading.
        held: (n,) whether the newest was held by the end of a range.
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

        Args:
            mean: (P,) what the posterior says would be there without mechanisms.
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
