"""Spot images of two and of four changes at once, and what Table 1's joint form makes of them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np

from analysis.units import ARCSEC
from optics.geometry.tree import Motion, State
from scenes.specs.instrument import BASE
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.validation.paper_001.formulas_images import PARAMETERS, MonitorImages, Ratio, quotient

AMOUNTS = {"d_alpha": 50e-6, "d_beta": 50e-6, "d_gamma": 20 * ARCSEC, "d_f": 20e-6}
"""Motion behind each parameter: line CCD along X, along Y (m) and about Z (rad), growth of the camera."""
SMALLEST = 0.5
"""Smallest size of a random motion, as a share of its AMOUNTS."""
UNITS = np.array([ARCSEC, ARCSEC, ARCSEC, 1e-6])
"""Of the response matrix: arcsec and micrometres."""
Parts = Callable[[float, float], tuple[float, float]]


def state_of(cameras: tuple[str, ...], shares: dict[str, np.ndarray]) -> State:
    """Camera -> shares of the four AMOUNTS, in the order of PARAMETERS, as a state."""
    state: dict[str, Motion] = {}
    for camera in cameras:
        along_x, along_y, turn, growth = (
            float(s) * AMOUNTS[p] for s, p in zip(shares[camera], PARAMETERS, strict=True)
        )
        state[f"{BASE}/{camera}/focal_plane"] = Motion(shift=(along_x, along_y, 0.0), rotate=(0.0, 0.0, turn))
        state[f"{BASE}/{camera}"] = Motion(scale=growth)
    return state


def states_of(cameras: tuple[str, ...], rounds: int, seed: int) -> dict[str, State]:
    """Every change by itself, the two that share an axis, all four, and random mixtures of all four.

    A round of mixtures has every combination of signs once, each camera in an order of its own, sizes at random.
    """
    groups = [(p,) for p in PARAMETERS] + [("d_f", "d_beta"), ("d_alpha", "d_gamma"), PARAMETERS]
    states = {}
    for group in groups:
        shares = np.array([float(p in group) for p in PARAMETERS])
        states["+".join(group)] = state_of(cameras, dict.fromkeys(cameras, shares))
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(11,)))
    signs = np.array(list(product((-1.0, 1.0), repeat=4)))
    for r in range(rounds):
        mixed = {c: rng.permutation(signs) * rng.uniform(SMALLEST, 1.0, signs.shape) for c in cameras}
        for k in range(len(signs)):
            states[f"mixture {r}.{k}"] = state_of(cameras, {c: mixed[c][k] for c in cameras})
    return states


class JointMotions(MonitorImages):
    """Images of changes by themselves and together.

    Args:
        experiment: the instrument.
        rounds: of 16 random mixtures.
        seed: of mixtures and noise.
        progress: takes a fraction and what is done next.
    """

    def __init__(
        self, experiment: MonitorExperiment, rounds: int, seed: int, progress: Callable[[float, str], None]
    ) -> None:
        super().__init__(experiment, states_of(tuple(experiment.instrument.cameras), rounds, seed), seed, progress)
        self.mixtures = [k for k, name in enumerate(self.motions) if name.startswith("mixture")]

    def superposition(self, one: str, other: str, axis: str, add: Callable[[float, float], float]) -> Ratio:
        """Displacement of a spot by both changes over what ``add`` makes of the displacements by each; per camera the
        side that is farther from 1.
        """
        out = {}
        for camera in self.cameras:
            both = self.spots(camera, f"{one}+{other}", axis)
            first, second = self.spots(camera, one, axis), self.spots(camera, other, axis)
            sides = [
                quotient((both[k], both[2]), (add(first[k], second[k]), float(np.hypot(first[2], second[2]))))
                for k in (0, 1)
            ]
            out[camera] = max(sides, key=lambda side: abs(side[0] - 1.0))
        return Ratio.mean(out)

    def symmetry(self, motion: str, axis: str, right_from_left: Callable[[float], float]) -> Ratio:
        """Displacement of the right spot over what ``right_from_left`` makes of the left one's."""
        out = {}
        for camera in self.cameras:
            left, right, sigma = self.spots(camera, motion, axis)
            out[camera] = quotient((right, sigma), (right_from_left(left), sigma))
        return Ratio.mean(out)

    def stray(self, motion: str, wrong: str, right: str) -> Ratio:
        """Common displacement along the axis that a change should not move, over the size along the one it should."""
        out = {}
        for camera in self.cameras:
            left, other, sigma = self.spots(camera, motion, wrong)
            size = [abs(v) for v in self.spots(camera, motion, right)[:2]]
            out[camera] = quotient(((left + other) / 2.0, sigma / np.sqrt(2.0)), (sum(size) / 2.0, 0.0))
        return Ratio.mean(out)

    def separated(self, single: str, axis: str, part: int, parts: Parts) -> Ratio:
        """A share that ``parts`` takes out of all four changes at once, over the mean size of the spots' displacement
        by its own change alone, with the sign of the left spot.
        """
        out = {}
        for camera in self.cameras:
            left, right, sigma = self.spots(camera, "+".join(PARAMETERS), axis)
            found = parts(left, right)[part], sigma / np.sqrt(2.0)
            left, right, sigma = self.spots(camera, single, axis)
            alone = 0.5 * (abs(left) + abs(right)) * np.sign(left), sigma / np.sqrt(2.0)
            out[camera] = quotient(found, alone)
        return Ratio.mean(out)

    def response(self, estimator: str) -> tuple[np.ndarray, np.ndarray]:
        """What an estimator reads per true change when all four change at once, and its sigma.

        Least squares of the readings of the mixtures on the traced changes and a constant, mean of the cameras.

        Returns:
            (4, 4) readings by changes, in the order of PARAMETERS, arcsec and micrometres, twice.
        """
        parameters = self.parameters()
        matrices, variances = [], []
        for camera in self.cameras:
            change = self.truth.cameras[camera]
            true = np.stack([getattr(change, p)[self.mixtures] for p in PARAMETERS], axis=-1) / UNITS
            design = np.column_stack([true, np.ones(len(true))])
            found = parameters[camera][estimator]
            solution, *_ = np.linalg.lstsq(design, found.vector[self.mixtures] / UNITS, rcond=None)
            noise = np.mean((found.sigma[self.mixtures] / UNITS) ** 2, axis=0)
            matrices.append(solution[:4].T)
            variances.append(np.outer(noise, np.diagonal(np.linalg.inv(design.T @ design))[:4]))
        sigma = np.sqrt(np.sum(variances, axis=0)) / len(self.cameras)
        return np.mean(matrices, axis=0), sigma

    def angle(self, estimator: str) -> tuple[float, float, float]:
        """Slope of the read on the traced change of the intersection angle over the mixtures, its sigma, and the rms
        of what is left, radians.
        """
        found = self.angles()[estimator]
        true, read = self.truth.angle_change[self.mixtures], found.change_rad[self.mixtures]
        offset = true - true.mean()
        slope = float(offset @ read / (offset @ offset))
        rest = read - read.mean() - slope * offset
        sigma = float(np.sqrt(np.mean(found.sigma_rad[self.mixtures] ** 2) / (offset @ offset)))
        return slope, sigma, float(np.sqrt(np.mean(rest**2)))
