"""What the on-board monitor says of a series of states against a reference measurement in orbit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from analysis.model_fit import fit
from analysis.monitoring import CameraParameters, shift_covariance
from analysis.recovery import measure_spots, recover
from analysis.spot_positions import SpotError, SpotPositions, difference_covariance
from optics.heat import Temperature
from optics.threads import cores, one_blas_thread
from optics.tree import Motion, State, compose
from scenes.channel import CENTRAL_PRISM
from scenes.course import moment
from scenes.thermal_model import TemperatureError
from twin.experiment import MonitorExperiment, motions_of
from twin.trial.bench_error import BenchError

if TYPE_CHECKING:
    from scenes.orbit_monitor import OrbitMonitorSpec

CHUNK = 25
"""States rendered at once, to bound memory."""
TOO_FAR = "temperatures and motions that keep the beams on the mirrors and the spots on their CCDs"
Series = dict[str, CameraParameters]


def states_of(
    experiment: MonitorExperiment,
    spec: OrbitMonitorSpec,
    numbers: Sequence[int] | None = None,
    only: tuple[str, str] | None = None,
) -> list[State]:
    """States at times of the course.

    Args:
        experiment: the instrument.
        spec: the test.
        numbers: of the times, all by default.
        only: "temperature" or "motion", and the node of the course that alone has one; the others of the course have
            temperatures of 0 K, so that nothing is inherited. What `perturb` says stays.

    Raises:
        InputError: a temperature at or below 0 K at some time, or one at which a glass's index is not known.
    """
    job, bodies = spec.job, {body.path: body for body in experiment.instrument.assembly.tree.bodies}
    out: list[State] = []
    for k in range(len(spec.course.times)) if numbers is None else numbers:
        time, fields = spec.course.times[k], job.fields(k)
        if only is not None:
            fields = {path: field if only == ("temperature", path) else Temperature() for path, field in fields.items()}
        try:
            experiment.thermal.check(fields)
            state = experiment.thermal.state(fields, motions_of(job))
        except TemperatureError as error:
            own = error.origin in spec.course.temperature
            key = ("course", *spec.course.key(error.origin, k)) if own else ("perturb", error.origin, "temperature")
            raise spec.error(f"{error} at {moment(time)}", key, allowed=error.allowed) from error
        moves = {}
        for path, motion in spec.motion.items():
            if only is None or only == ("motion", path):
                share = motion.share(time)
                rotate, shift = ((share * v[0], share * v[1], share * v[2]) for v in (motion.rotate, motion.shift))
                moves[path] = Motion(rotate, shift, motion.pivot)
        out.append(compose(state, moves, bodies))
    return out


class MonitorSeries:
    """A monitor with its reference images.

    Args:
        experiment: the instrument with its calibration on the ground.
        spec: the test.
        reference: state at the reference time.
    """

    def __init__(self, experiment: MonitorExperiment, spec: OrbitMonitorSpec, reference: State) -> None:
        self.experiment, self.spec = experiment, spec
        self.frames: int = spec.frames or experiment.instrument.spec.monitor.frames
        self.reference = experiment.path.expected_photons([reference])
        self._clean_reference = self._spots(experiment.expected_frames(self.reference), None)

    def measured(self, states: Sequence[State], seed: int) -> tuple[Series, Series]:
        """Camera -> changes (S,) since the reference, from exposed frames and from expected images without noise.

        Raises:
            BenchError: a spot cannot be measured.
            AimError, BeamMissedError: light is lost.
        """
        experiment = self.experiment
        # a stream of its own: states are numbered from 0
        before = experiment.frames_after(self.reference, self.frames, seed, len(states))[0]
        noisy: list[Series] = []
        clean: list[Series] = []
        for piece, photons in experiment.path.iterate_photons(states, chunk=CHUNK):
            after = experiment.frames_after(photons, self.frames, seed, piece.start)
            noisy.append(self._recovered(before, after, piece.start))
            clean.append(self._without_noise(photons, piece.start))
        return _joined(noisy), _joined(clean)

    def clean(self, states: Sequence[State]) -> Series:
        """Camera -> changes (S,) since the reference, from expected images without noise. Raises as `measured`."""
        pieces = self.experiment.path.iterate_photons(states, chunk=CHUNK)
        return _joined([self._without_noise(photons, piece.start) for piece, photons in pieces])

    def of_prisms(self) -> Series:
        """Without noise, what temperatures say that the file gives to the monitor's prisms themselves, at all times."""
        job = self.spec.job
        states = []
        for k in range(len(self.spec.course.times)):
            own = {p: f for p, f in job.fields(k).items() if "/monitor/" in p or p.startswith(CENTRAL_PRISM)}
            states.append(self.experiment.thermal.state(own, {}))
        at, every = self.spec.referred, self.clean(states)
        return {n: CameraParameters.from_vector(p.vector - p.vector[at], p.covariance) for n, p in every.items()}

    def repeated(self, state: State, count: int, seed: int, number: int) -> Series:
        """Camera -> changes (count,): reference and state measured anew each time, with another detector's pattern.

        ``number`` is that of the state's time, for messages.
        """
        experiment = self.experiment
        photons = experiment.path.expected_photons([state])
        pieces = []
        for k in range(count):
            before = experiment.frames_after(self.reference, self.frames, seed + k, 1)[0]
            after = experiment.frames_after(photons, self.frames, seed + k)
            pieces.append(self._recovered(before, after, number))
        return _joined(pieces)

    def _recovered(self, before: np.ndarray, after: np.ndarray, first: int) -> Series:
        experiment = self.experiment
        try:
            with one_blas_thread():
                found = recover(before, after, experiment.calibration, self.spec.analysis.centroid, cores())
        except SpotError as error:
            raise self._lost(error, first) from error
        return {name: estimators["model"] for name, estimators in found.parameters.items()}

    def _without_noise(self, photons: np.ndarray, first: int) -> Series:
        calibration, noise = self.experiment.calibration, self.experiment.calibration.noise
        after = self._spots(self.experiment.expected_frames(photons), first)
        before, spots = self._clean_reference, calibration.spots
        spread = difference_covariance(before, after, noise).reshape(len(photons), -1, 2, 2, 2)
        joint = shift_covariance(spread[:, :, 0], spread[:, :, 1])
        shift = after.position.reshape(len(photons), spots, 2) - before.position.reshape(1, spots, 2)
        out = {}
        for k, (name, camera) in enumerate(calibration.cameras.items()):
            moved = shift[:, 2 * k : 2 * k + 2].reshape(-1, 4)
            jacobians = (camera.spot_jacobian, camera.parameter_jacobian, camera.motions)
            out[name] = fit(moved, joint[:, k], *jacobians)
        return out

    def _spots(self, frames: np.ndarray, first: int | None) -> SpotPositions:
        calibration = self.experiment.calibration
        flat = frames.reshape(-1, *frames.shape[-2:])
        try:
            with one_blas_thread():
                return measure_spots(flat, self.frames, calibration, self.spec.analysis.centroid, cores())
        except SpotError as error:
            raise self._lost(error, self.spec.referred if first is None else first) from error

    def _lost(self, error: SpotError, first: int) -> BenchError:
        state, spot = divmod(error.indices[0], self.experiment.calibration.spots)
        number = min(first + state, len(self.spec.course.times) - 1)
        channel = self.experiment.path.channels[spot].key
        reason = error.reasons[error.indices[0]]
        time = moment(self.spec.course.times[number])
        return BenchError(f"the spot {channel} cannot be measured at {time} ({reason})", ("course",), TOO_FAR)


def _joined(parts: Sequence[Series]) -> Series:
    return {
        name: CameraParameters.from_vector(
            np.concatenate([np.atleast_2d(p[name].vector) for p in parts]),
            np.concatenate([p[name].covariance.reshape(-1, 4, 4) for p in parts]),
        )
        for name in parts[0]
    }
