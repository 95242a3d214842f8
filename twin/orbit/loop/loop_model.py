"""What the estimate and the mechanisms of a loop rest on, by exact traces: stated motions with what they do to spots,
cameras and foci, and what every mechanism does to the same.

The quantities of a loop are P = 5 K numbers of the instrument's K cameras: d_alpha, d_beta, d_gamma, d_f of each, as
all estimators have them, and after these the defocus of each, best focus less line CCD, the mean over `FOCUS_FIELDS`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from analysis.monitor.disturbances import Disturbances
from optics.geometry.tree import State, compose
from optics.numerics.frozen_map import FrozenMap
from scenes.specs.motion_text import AXES, node_named
from scenes.specs.orbit.loop import CorrectionSpec
from scenes.specs.orbit.monitor import PARAMETERS
from scenes.specs.orbit.setup import LoopSetup
from scenes.specs.perturbation import not_allowed
from scenes.yaml.errors import InputError, Problem, unknown
from twin.monitor.image_quality import ImageQuality, image_quality
from twin.monitor.monitor_derivative import single_states, spot_jacobian
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.motions import ElementaryMotion
from twin.monitor.truth import truth_jacobian

FOCUS_FIELDS = (0.7, 0.0, -0.7)
"""Shares of half the line at which the focus is looked at."""
_READ = 1e-3
"""Pixels to which one reading knows a spot, about."""
_SMALL = 1e-6
"""Of a mechanism's own effect on its quantity, over that of 1 rad or 1 m, below which it is none."""


@dataclass(frozen=True, eq=False)
class Corrector:
    """One correction on its instrument.

    Attributes:
        name: of it.
        spec: what the file says.
        motion: of its mechanism; None for a correction on the ground.
        row: number of its quantity, of P.
        effect: (P,) what 1 rad or 1 m of it does to the quantities; spots: (D,) to the spots, px.
    """

    name: str
    spec: CorrectionSpec
    motion: ElementaryMotion | None
    row: int
    effect: np.ndarray
    spots: np.ndarray

    @property
    def own(self) -> float:
        """What it does to its quantity."""
        return float(self.effect[self.row])

    @property
    def unit(self) -> tuple[str, float]:
        """Unit in which its position is told, and its size in SI."""
        key = "um" if self.spec.kind_of("step").si == "m" else "arcsec"
        return key, 1e-6 if key == "um" else float(np.deg2rad(1.0 / 3600.0))


@dataclass(frozen=True, eq=False)
class LoopModel:
    """A loop on its instrument.

    Attributes:
        experiment: the instrument.
        stated: what moves, with all P quantities in place of the parameters.
        correctors: by name, in the order of the names, so that their order in the file does not matter.
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

    def moved(self, state: State, positions: np.ndarray) -> State:
        """A state with the mechanisms at positions, which do what they really do.

        Args:
            state: without them.
            positions: (n,) of the correctors, rad or m.
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


def loop_model(setup: LoopSetup, experiment: MonitorExperiment) -> LoopModel:
    """Trace what moves and what the mechanisms do.

    Raises:
        InputError: a mechanism that the instrument does not have, or that does nothing to its quantity; a node that
            does not exist or does not move so.
        AimError, BeamMissedError: light is lost.
    """
    stated, motions = experiment.disturbances, experiment.stated
    assert stated is not None  # the set-up states them
    assert motions is not None
    test, cameras = setup.test, tuple(experiment.instrument.cameras)
    named = {name: _mechanism(setup, experiment, name, test.corrections[name]) for name in sorted(test.corrections)}
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
        spec = test.corrections[name]
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
                raise test.error(problem, ("corrections", name, "mechanism"), allowed=allowed)
        correctors.append(Corrector(name, spec, motion, row, effect, shift))
    whole = replace(stated, parameters=np.concatenate([stated.parameters, per_sigma]))
    return LoopModel(experiment, whole, tuple(correctors))


_DISTANCE: Mapping[str, float] = FrozenMap({"shift": 1e-5, "rotate": 5e-6})
"""Steps of mechanisms over which a focus is differentiated, m and rad: foci are known to 1e-8 m."""


def defocus(quality: ImageQuality) -> np.ndarray:
    """(K, S) best focus less line CCD of every camera and state, metres; NaN where it is not known."""
    return np.stack([one.defocus.mean(axis=1) for one in quality.cameras.values()])


def _mechanism(
    setup: LoopSetup, experiment: MonitorExperiment, name: str, spec: CorrectionSpec
) -> ElementaryMotion | None:
    """InputError unless the body exists, moves so and has the pivot."""
    if spec.mechanism is None:
        return None
    test, key = setup.test, ("corrections", name, "mechanism")
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
