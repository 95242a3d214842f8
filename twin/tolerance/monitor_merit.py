"""Merits of a camera out of tolerance: smooth parts, obstruction of beams, and variances of the monitor's estimates.

**Monitor.** Everything is linear about the instrument as it is built and adjusted: the disturbances of the prior move
spots and cameras by the derivatives of that state, and the images before and after have the noise of that state. So the
sigma is that of ``twin.uncertainty`` for that instrument. The gain of the posterior estimator, its linear map from spot
shifts to camera parameters, is that of the instrument as built; other estimators use the gain of the nominal
instrument. The area CCDs are assumed to have been centred on their spots when the instrument was built.

The derivatives change by about 1e-4 within tolerances. The change due to each tolerance and each adjustment is traced
once, and changes of several are added. The terms of a whole figure error are omitted: 10 nm of a term change the
derivatives by less than 1e-5. The noise of every camera is that of its own images.
``MonitorMerit.interpolation_errors`` gives the resulting error of the sigmas.

**Obstruction.** Prisms, housings, baffles and parts of other cameras block part of the beams of a camera, each where
the state puts it. The camera's own mirrors belong to its prescription, which models their obstruction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor.disturbances import Disturbances
from analysis.monitor.limits import split
from optics.geometry.tree import State
from optics.numerics import quadrature
from optics.numerics.array_math import PhysicalError
from optics.raytrace.system import assemble
from optics.waves.imaging import imaging_rays
from scenes.models.shadow import TracedBeams
from scenes.specs.tolerance import MERIT_UNITS, OF_MONITOR, POSTERIOR, MeritSpec, ToleranceSetup
from scenes.yaml.errors import names_text, unknown
from scenes.yaml.units import LENGTH
from twin.framework.artefact import unit_for_reports
from twin.monitor.crosstalk import estimator_gains
from twin.monitor.monitor_derivative import derivative_changes, noise_as_built, quantity_rows, spot_noise
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.monitor_path import SpotPath
from twin.targets.target_path import TargetPath
from twin.tolerance.variations import VariedParameter, states_of

ROTATIONS = ("d_alpha", "d_beta", "d_gamma")
"""Keys of the three rotations of a camera's line of sight."""
STEP = 0.1
"""Step of the numerical derivatives with respect to a compensator, as a fraction of its range."""


@dataclass(frozen=True, eq=False)
class MonitorMerit:
    """Monitor of the instrument of a budget, with the merits that are standard deviations of its estimates.

    Array dimensions: D spot coordinates, K varied parameters and compensators, M independent motions, J cameras with 4
    parameters each, Q estimated quantities.

    Attributes
    ----------
    experiment : MonitorExperiment
        Nominal instrument with the disturbances of its prior.
    path : SpotPath
        Light path of the monitor spots, with area CCDs centred on their spots.
    images : SpotPath
        Light path of only those cameras whose spots move.
    disturbances : Disturbances
        Disturbances of the nominal instrument as independent motions.
    noise : (D, D) ndarray
        Covariance of the nominal instrument's spot shifts due to image noise, px^2.
    changes : tuple of ndarray
        Changes, per SI unit of each varied parameter and compensator, of the derivatives of spots (K, D, M) and camera
        parameters (K, 4 J, M) with respect to the independent motions.
    asked : dict
        Name of a merit -> matrix (Q, 4 J) from camera parameters to its quantities, and the matrix of its estimator
        from spot shifts to camera parameters; None for the posterior estimator.
    """

    experiment: MonitorExperiment
    path: SpotPath
    images: SpotPath
    disturbances: Disturbances
    noise: np.ndarray
    changes: tuple[np.ndarray, np.ndarray]
    asked: Mapping[str, tuple[np.ndarray, np.ndarray | None]]

    @classmethod
    def of(
        cls,
        setup: ToleranceSetup,
        experiment: MonitorExperiment,
        camera: str,
        numbers: Sequence[VariedParameter],
        ranges: np.ndarray,
    ) -> MonitorMerit | None:
        """Return the monitor of a budget; None if no merit is about a monitor.

        Parameters
        ----------
        setup : ToleranceSetup
            Tolerance budget.
        experiment : MonitorExperiment
            Nominal instrument of the budget.
        camera : str
            Name of the camera that the budget evaluates.
        numbers : sequence of VariedParameter
            K varied parameters, the compensators last.
        ranges : (C,) ndarray
            Ranges of the C compensators, SI units.

        Raises
        ------
        InputError
            The instrument has no monitor or no disturbances, or there is no such quantity or estimator.
        """
        wanted = {name: merit for name, merit in setup.test.merits.items() if merit.kind in OF_MONITOR}
        if not wanted:
            return None
        _require_monitor(setup, experiment, next(iter(wanted)))
        known, motions = experiment.disturbances, experiment.prior
        assert known is not None
        assert motions is not None
        path = SpotPath(experiment.instrument, experiment.backend)
        noise, _ = spot_noise(path, experiment.detector)
        gains = estimator_gains(experiment.cameras, known, noise)
        rows = quantity_rows(experiment.instrument, None)
        asked = {}
        for name, merit in wanted.items():
            if merit.estimator not in gains:
                wrong = unknown("no such estimator", merit.estimator, tuple(gains))
                raise setup.test.error(wrong, ("merits", name, "estimator"))
            gain = None if merit.estimator == POSTERIOR else gains[merit.estimator]
            asked[name] = np.concatenate([rows[key] for key in _readings(setup, experiment, name, merit, camera)]), gain
        root = known.root
        disturbances = replace(
            known, spots=known.spots @ root, parameters=known.parameters @ root, correlation=np.eye(len(root))
        )
        limit_state = states_of(numbers, np.array([[number.size for number in numbers]]))[0]
        images = SpotPath(experiment.instrument, experiment.backend, cameras=path.moved_cameras(limit_state))
        # derivatives are differentiated by these amounts
        sizes = [
            0.0 if setup.test.tolerances[number.entry].spectrum else number.size
            for number in numbers[: -len(ranges) or None]
        ]
        steps = np.concatenate([sizes, STEP * ranges])
        moved = np.flatnonzero(steps)
        built = [states_of([numbers[k]], steps[k : k + 1, None])[0] for k in moved.tolist()]
        try:
            changes = derivative_changes(motions, path, experiment.sight, experiment.thermal, built)
        except PhysicalError as error:
            problem = f"the monitor has no derivatives at the limits: {error}"
            raise setup.test.error(problem, ("tolerances",), allowed="smaller limits") from error
        per_unit = tuple(np.zeros((len(numbers), *change.shape[1:])) for change in changes)
        for out, change in zip(per_unit, changes, strict=True):
            out[moved] = change @ root / steps[moved, None, None]
        return cls(experiment, path, images, disturbances, noise, (per_unit[0], per_unit[1]), asked)

    def variances(self, amounts: np.ndarray, states: Sequence[State]) -> dict[str, np.ndarray]:
        """Return the variances of the Q estimated quantities of each merit in S states, (S, Q), SI units squared.

        Parameters
        ----------
        amounts : (S, K) ndarray
            Amounts of the K varied parameters and compensators, SI units.
        states : sequence of State
            The S states that they add up to.

        Raises
        ------
        BeamMissedError, AimError
            The light of a state does not reach its area CCDs.
        """
        noise = self._noise(states)
        used = np.flatnonzero(np.any(self.changes[0], axis=(1, 2)) | np.any(self.changes[1], axis=(1, 2)))
        spots, parameters = (np.tensordot(amounts[:, used], change[used], 1) for change in self.changes)
        return self._read(spots, parameters, noise)

    def exact(self, states: Sequence[State]) -> dict[str, np.ndarray]:
        """Return the variances of every merit's estimates, with derivatives that are traced in every state."""
        motions = self.experiment.prior
        assert motions is not None
        known = self.experiment
        changes = derivative_changes(motions, self.path, known.sight, known.thermal, states)
        assert known.disturbances is not None
        root = known.disturbances.root
        return self._read(changes[0] @ root, changes[1] @ root, self._noise(states))

    def interpolation_errors(self, amounts: np.ndarray, states: Sequence[State]) -> dict[str, float]:
        """Return the largest relative error of each merit's sigma due to interpolated instead of traced derivatives.

        Parameters
        ----------
        amounts : (S, K) ndarray
            Amounts of K varied parameters and compensators in S states, SI units.
        states : sequence of State
            The S states that they add up to.
        """
        near, right = self.variances(amounts, states), self.exact(states)
        return {
            name: float(np.max(np.abs(np.sqrt(near[name].max(axis=1) / right[name].max(axis=1)) - 1.0)))
            for name in self.asked
        }

    def _noise(self, states: Sequence[State]) -> np.ndarray:
        """Return the covariance of the spot shifts due to image noise in every state, (S, D, D), px^2.

        Array dimensions: S states, D spot coordinates.
        """
        out = np.tile(self.noise, (len(states), 1, 1))
        keys = [channel.key for channel in self.images.channels]
        indices = [
            2 * k + axis for k, channel in enumerate(self.path.channels) if channel.key in keys for axis in (0, 1)
        ]
        if indices:
            rows = np.ix_(range(len(states)), indices, indices)
            out[rows] = noise_as_built(self.images, self.experiment.detector, states)
        return out

    def _read(self, spots: np.ndarray, parameters: np.ndarray, noise: np.ndarray) -> dict[str, np.ndarray]:
        """Return the variances of every merit's estimates from the derivatives and noise of given states.

        They are in SI units squared.

        Parameters
        ----------
        spots : (S, D, M) ndarray
            Changes of the derivatives of the spots in S states: D spot coordinates with respect to M independent
            motions.
        parameters : (S, 4 J, M) ndarray
            Changes of the derivatives of the parameters of J cameras.
        noise : (S, D, D) ndarray
            Covariance of the spot shifts due to image noise, px^2.
        """
        out = {name: np.empty((len(noise), len(rows))) for name, (rows, _) in self.asked.items()}
        for s, covariance in enumerate(noise):
            disturbances = replace(
                self.disturbances,
                spots=self.disturbances.spots + spots[s],
                parameters=self.disturbances.parameters + parameters[s],
            )
            best = disturbances.best_gain(covariance)
            for name, (rows, gain) in self.asked.items():
                out[name][s] = split(rows, disturbances, covariance, best if gain is None else gain).sigma ** 2
        return out


def _require_monitor(setup: ToleranceSetup, experiment: MonitorExperiment, name: str) -> None:
    """Raise InputError if the instrument has no monitor, or its monitor no prior on disturbances."""
    test, kind = setup.test, setup.test.merits[name].kind
    if not experiment.monitored:
        allowed = "an instrument with a monitor, such as gf7_pair; or other merits"
        problem = f"{kind} needs a monitor, and {setup.base.instrument.name} has none"
        raise test.error(problem, ("merits", name, "kind"), allowed=allowed)
    if experiment.prior is None:
        allowed = "`disturbances: NAME` at the top of this file, or in the instrument's"
        problem = f"{kind} needs a prior on disturbances, and there is none"
        raise test.error(problem, ("merits", name, "kind"), allowed=allowed)


def readings_of(merit: MeritSpec, cameras: Sequence[str]) -> tuple[str, ...]:
    """Return the estimated quantities of which a merit takes the worst.

    The quantity is ``angle`` (between two cameras), or such as ``d_alpha`` of one camera.
    """
    if merit.kind == "monitor_focus":
        return ("d_f",)
    if merit.reading is None:
        return ("angle",) if len(cameras) == 2 else ROTATIONS
    return (merit.reading,)


def _readings(
    setup: ToleranceSetup, experiment: MonitorExperiment, name: str, merit: MeritSpec, camera: str
) -> list[str]:
    """Return the names of a merit's quantities in ``quantity_rows``; raise InputError if there is no angle."""
    cameras = tuple(experiment.instrument.cameras)
    if merit.reading == "angle" and len(cameras) != 2:
        wrong = f"an angle is between the lines of sight of two cameras, and there are {len(cameras)}"
        raise setup.test.error(wrong, ("merits", name, "reading"), allowed=names_text(ROTATIONS))
    return [key if key == "angle" else f"{camera}/{key}" for key in readings_of(merit, cameras)]


@dataclass(frozen=True, eq=False)
class Merit:
    """Merit of a tolerance budget: a quantity of the camera for which the budget has a requirement.

    The **parts** of a merit change smoothly with small motions; its value, as the worst of several fields, does not.
    Parts are mean square wavefront errors by field, MTF by field and direction, components of a rotation, residual
    positions along the line, obstructed fractions of a beam by field, or variances of the monitor's estimates.

    Attributes
    ----------
    name : str
        Name in the file.
    spec : MeritSpec
        Kind, fields and requirement.
    fields : (F,) ndarray of int
        Indices of its F fields among all fields of the budget.
    parts : slice
        Columns of this merit in the array of the parts of all merits.
    """

    name: str
    spec: MeritSpec
    fields: np.ndarray
    parts: slice

    def values(self, parts: np.ndarray) -> np.ndarray:
        """Return the value of this merit, SI units, from the parts of all merits, the last axis of ``parts``.

        For a change its absolute value counts; of several parts the worst counts.
        """
        selected = parts[..., self.parts]
        match self.spec.kind:
            case "wavefront" | "monitor_angle" | "monitor_focus":
                return np.sqrt(np.maximum(np.max(selected, axis=-1), 0.0))
            case "mtf":
                return np.asarray(np.min(selected, axis=-1))
            case "chief_ray":
                return np.asarray(np.max(np.hypot(selected[..., ::2], selected[..., 1::2]), axis=-1))
            case "boresight":
                return np.asarray(np.hypot(selected[..., 0], selected[..., 1]))
            case _:
                return np.asarray(np.max(np.abs(selected), axis=-1))

    def passes(self, values: np.ndarray) -> np.ndarray:
        """Return True where values of the merit, SI units, meet the requirement; NaN does not."""
        if self.spec.more_is_better:
            return np.asarray(values >= self.spec.requirement)
        return np.asarray(values <= self.spec.requirement)

    def margin(self, values: np.ndarray) -> np.ndarray:
        """Return the excess of values of the merit over the requirement, relative to it.

        It is negative where they meet the requirement.
        """
        ratio = values / self.spec.requirement
        return np.asarray(1.0 - ratio if self.spec.more_is_better else ratio - 1.0)

    def worse(self, values: np.ndarray, than: float | np.ndarray) -> np.ndarray:
        """Return by how much values of the merit are worse than the reference value ``than``, SI units."""
        return np.asarray(than - values if self.spec.more_is_better else values - than)


PART_COUNTS = {"boresight": 2, "roll": 1, "principal_distance": 1}
"""Kind of merit -> number of its parts (smooth quantities), for kinds whose number does not depend on fields."""
AT_FIELDS = ("wavefront", "mtf", "chief_ray", "obstruction")
"""Kinds of merits that are evaluated at several fields of a camera."""


def part_count(spec: MeritSpec, line_points: int, cameras: Sequence[str] = ()) -> int:
    """Return the number of parts of a merit; parts are smooth quantities such as the MTF at one field."""
    match spec.kind:
        case "monitor_angle" | "monitor_focus":
            return len(readings_of(spec, cameras))
        case "wavefront" | "obstruction":
            return len(spec.fields)
        case "mtf":
            return len(spec.fields) * (2 if spec.direction == "worse" else 1)
        case "chief_ray":
            return 2 * len(spec.fields)
        case "distortion":
            return line_points
        case kind:
            return PART_COUNTS[kind]


def merits_of(
    specs: dict[str, MeritSpec], line_points: int, cameras: Sequence[str] = ()
) -> tuple[tuple[Merit, ...], np.ndarray]:
    """Return the merits of a budget and all F fields that they use, (F, 2).

    Parameters
    ----------
    specs : dict
        Specifications by name.
    line_points : int
        Number of points of the line at which distortion is evaluated.
    cameras : sequence of str
        Names of the instrument's cameras.
    """
    fields: dict[tuple[float, float], int] = {}
    out, start = [], 0
    for name, spec in specs.items():
        used = spec.fields if spec.kind in AT_FIELDS else ()
        numbers = np.array([fields.setdefault(field, len(fields)) for field in used], dtype=int)
        count = part_count(spec, line_points, cameras)
        out.append(Merit(name, spec, numbers, slice(start, start + count)))
        start += count
    return tuple(out), np.array(list(fields)).reshape(-1, 2)


def shown_merit(value: float, merit: Merit) -> float | None:
    """Return a merit's value, given in SI units, in the unit in which it is reported; None if it is not finite."""
    return float(value / merit_unit(merit)[1]) if np.isfinite(value) else None


def merit_head(merit: Merit) -> str:
    """Return the name of a merit with its unit, for the head of a column."""
    unit = merit_unit(merit)[0]
    if merit.spec.kind == "mtf":
        return f"{merit.name}, of the optics"
    return f"{merit.name} [{unit_for_reports(unit)}]" if unit else merit.name


def merit_unit(merit: Merit) -> tuple[str, float]:
    """Return the unit in which a merit is reported, and the size of that unit in SI."""
    unit = MERIT_UNITS[merit.spec.kind]
    if unit is None:
        return ("waves", 1.0) if merit.spec.kind == "wavefront" else ("", 1.0)
    return ("um", 1e-6) if unit is LENGTH else ("arcsec", ARCSEC)


KIND = "obstruction"
"""Kind of the merit that is the obstructed fraction of a beam."""
RINGS = 7
"""Number of rings of rays over the stop with which an obstructed fraction is computed, as for image quality."""
AT_ONCE = 40
"""Number of states traced in one launch, to limit memory."""


def require_bodies(setup: ToleranceSetup, path: TargetPath) -> None:
    """Raise InputError if a budget has a merit about obstruction although no body can block the camera's beams."""
    for name, merit in setup.test.merits.items():
        if merit.kind == KIND and (path.shadows is None or not path.shadows.casters):
            problem = f"no body of {setup.base.instrument.name} can block the beams of {path.name}"
            allowed = "an instrument with a monitor, baffles or another camera; or other merits"
            raise setup.test.error(problem, ("merits", name, "kind"), allowed=allowed)


def obstructed_shares(
    path: TargetPath, states: Sequence[State], directions: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """Return the fraction of the stop's area that all bodies together block in every beam, (S, F).

    Parameters
    ----------
    path : TargetPath
        Light path of the camera, with its shadows.
    states : sequence of State
        S states.
    directions : (F, 3) ndarray
        Directions of the light of F fields in the world frame.
    start : (F, 3) ndarray
        A point of each beam before the first mirror, world frame, metres.

    Raises
    ------
    AimError, BeamMissedError
        The light of a state is lost.
    UnphysicalError
        The shadows are geometrically impossible.
    """
    assert path.shadows is not None
    nodes, fields = quadrature.disk(RINGS), len(directions)
    axis = path.assembly.nominal_pose(path.root).rotation[:, 1]
    out = np.empty((len(states), fields))
    for first in range(0, len(states), AT_ONCE):
        batch = states[first : first + AT_ONCE]
        placed, owner = path.assembly.place(batch), np.repeat(np.arange(len(batch)), fields)
        imaging, to_stop = (
            assemble(path.assembly, [f"{path.name}/{sequence}"], batch, placed=placed).take(owner)
            for sequence in ("imaging", "to_stop")
        )
        heading, launch = (np.tile(array, (len(batch), 1)) for array in (directions, start))
        rays = imaging_rays(path.backend, imaging, to_stop, heading, launch, path.stop, nodes, first=axis)
        shadows = path.shadows.cast(TracedBeams(path.assembly, placed, owner, imaging, rays, heading, nodes))
        out[first : first + len(batch)] = np.sum(shadows.areas, axis=1).reshape(-1, fields) / np.pi
    return out
