"""Paper 001's joint form: superposition (8), symmetry (9), separation (10) and (11), Table 1's last column on all four
changes at once, and Fig. 4's change of the intersection angle.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product

import numpy as np

from analysis.arrays import ARCSEC
from optics.geometry.tree import Motion, State
from scenes.specs.instrument import BASE
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.run.artefact import Cell
from twin.validation.checks.check import CheckResult
from twin.validation.checks.group import Context, group_of
from twin.validation.paper_001 import formulas_images
from twin.validation.paper_001.formulas import INSTRUMENT, without_cos2
from twin.validation.paper_001.formulas_images import FRAMES, PARAMETERS, MonitorImages, Ratio, quotient, show_ratios

AMOUNTS = {"d_alpha": 50e-6, "d_beta": 50e-6, "d_gamma": 20 * ARCSEC, "d_f": 20e-6}
"""Motion behind each parameter: line CCD along X, along Y (m) and about Z (rad), growth of the camera."""
SMALLEST = 0.5
"""Smallest size of a random motion, as a share of its AMOUNTS."""
UNITS = np.array([ARCSEC, ARCSEC, ARCSEC, 1e-6])
"""Units of the response matrix: arcsec and micrometres."""
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


def run(context: Context) -> Iterator[CheckResult]:
    """All checks of the group; the images of all states are one batch."""
    images = measured(context)
    ratios: dict[str, Ratio] = {}
    for identifier, ratio, how in _spots(images):
        if identifier in context.selected:
            yield context.check(identifier).evaluate(ratio.value, ratio.sigma, f"{how} By camera: {ratio.text}.")
            ratios[identifier] = ratio
    shown = {identifier: ratio.value for identifier, ratio in ratios.items()}
    if context.wants("001.table1"):
        for result in _table_1(context, images):
            shown[result.id] = float(result.measured or 0.0)
            yield result
    if "001.fig4.angle" in context.selected:
        result = _angle(context, images)
        shown[result.id] = float(result.measured or 0.0)
        yield result
    show_ratios(context, "joint-ratios", "The joint form: what was found over what should be", shown)


def measured(context: Context) -> JointMotions:
    """The images of all states and their spots."""
    context.progress(0.1, f"build {INSTRUMENT}")
    rounds = context.count(full=6, fast=1)
    experiment = context.experiment(INSTRUMENT)
    return JointMotions(experiment, rounds, context.seed, lambda done, text: context.progress(0.2 + 0.7 * done, text))


def _spots(images: JointMotions) -> Iterator[tuple[str, Ratio, str]]:
    """Id, what was found and how, of (8) to (11)."""
    sizes = (
        f"line CCD along X and Y by {AMOUNTS['d_alpha'] * 1e6:g} µm, about Z by {AMOUNTS['d_gamma'] / ARCSEC:g} "
        f"arcsec, camera grown by {AMOUNTS['d_f'] * 1e6:g} ppm"
    )
    frames = f"{FRAMES} frames before and after each"
    how = f"Spots of rendered images of each change and of both ({sizes}), {frames}; the worse side of each camera."
    yield "001.eq8.y", images.superposition("d_f", "d_beta", "Y", formulas_images.superposed), how
    yield "001.eq8.x", images.superposition("d_alpha", "d_gamma", "X", formulas_images.superposed), how
    how = (
        f"Spots of rendered images of the one change ({sizes}), {frames}. Reticle and area CCD stand 3 mm apart across "
        "the line, so that the spots have a lever arm of half that; the ratio is it over L/2."
    )
    yield "001.eq8.d_gamma_alone", images.stray("d_gamma", "Y", "X"), how
    yield "001.eq8.d_f_alone", images.stray("d_f", "X", "Y"), how
    how = f"Camera grown by {AMOUNTS['d_f'] * 1e6:g} ppm, {frames}."
    yield "001.eq9.d_f", images.symmetry("d_f", "Y", formulas_images.right_of_focal_length), how
    how = f"Line CCD moved along Y by {AMOUNTS['d_beta'] * 1e6:g} µm, {frames}."
    yield "001.eq9.d_beta", images.symmetry("d_beta", "Y", formulas_images.right_of_rotation), how
    parts = ((10, "Y", "d_f", 0), (10, "Y", "d_beta", 1), (11, "X", "d_alpha", 0), (11, "X", "d_gamma", 1))
    how = (
        f"Spots of rendered images of all four changes at once and of the one alone ({sizes}), {frames}. What is left "
        "is the lever arm of 001.eq8.d_gamma_alone and 001.eq8.d_f_alone."
    )
    for number, axis, parameter, part in parts:
        form = formulas_images.parts_along if number == 10 else formulas_images.parts_across
        yield f"001.eq{number}.{parameter}", images.separated(parameter, axis, part, form), how


def _table_1(context: Context, images: JointMotions) -> Iterator[CheckResult]:
    matrix, sigma = images.response("paper_joint")
    right, _ = images.response("derived")
    g = images.first
    f, f_x = g.principal_distance_m, g.principal_distance_across_m or g.principal_distance_m
    count = len(images.mixtures)
    how = (
        f"{count} random mixtures of all four changes in each camera (line CCD along X, Y, about Z; camera grown), "
        f"rendered, {FRAMES} frames each; readings fitted to the traced changes of line of sight, roll and principal "
        "distance, mean of both cameras."
    )
    facts = {"f": f, "f_x": f_x, "local": images.local_share}
    explained = {
        "d_alpha": f_x / f, "d_beta": without_cos2(g, images.local_share), "d_gamma": 2.0 * f_x / f, "d_f": 0.5,
    }  # fmt: skip
    for k, parameter in enumerate(PARAMETERS):
        identifier = f"001.table1.{parameter}"
        if identifier in context.selected:
            text = f"{how} With the corrected factors: {right[k, k]:.4f}."
            if parameter == "d_f":
                text += (
                    f" Table 1 does not say what Y_L is. (2) has y01 − y11 on the left side, by which this is "
                    f"{-matrix[k, k]:.4f}, and (7) y11 − y01; for X, (3) and (5) agree."
                )
            value, noise = matrix[k, k], sigma[k, k]
            yield context.check(identifier).evaluate(value, noise, text, None, [explained[parameter]], facts=facts)
    yield from _couplings(context, images, how, matrix, sigma, right)
    rows: list[list[Cell]] = [
        [
            name,
            *(f"{matrix[k, n]:.4f} ± {sigma[k, n]:.4f}" for n in range(4)),
            *(f"{right[k, n]:.4f}" for n in range(4)),
        ]
        for k, name in enumerate(PARAMETERS)
    ]
    context.table(
        "table1-response",
        "What Table 1's joint form reads per true change, all four changing",
        "Angles in arcsec, Δf in µm. Left: Table 1 as printed; right: corrected factors and the camera's own "
        "gradients. Perfect is 1 on the diagonal and 0 off it.",
        ("reading", *(f"per {p}" for p in PARAMETERS), *(f"corrected, per {p}" for p in PARAMETERS)),
        rows,
    )


def _couplings(
    context: Context, images: JointMotions, how: str, matrix: np.ndarray, sigma: np.ndarray, right: np.ndarray
) -> Iterator[CheckResult]:
    g = images.first
    f, f_x = g.principal_distance_m, g.principal_distance_across_m or g.principal_distance_m
    cases = (
        ("d_gamma_by_d_beta", 2, 1, -2.0 * f_x / f * g.d_gamma_per_beta),
        ("d_f_by_d_alpha", 3, 0, -0.5 * g.d_f_per_alpha_m * ARCSEC / 1e-6),
    )
    for name, k, n, predicted in cases:
        if f"001.table1.{name}" in context.selected:
            text = f"{how} With that gradient added (corrected form): {right[k, n]:.4f}."
            check = context.check(f"001.table1.{name}")
            yield check.evaluate(matrix[k, n], sigma[k, n], text, None, [predicted])


def _angle(context: Context, images: JointMotions) -> CheckResult:
    slope, sigma, rest = images.angle("paper_joint")
    better = images.angle("derived")
    g = images.first
    f_x = g.principal_distance_across_m or g.principal_distance_m
    how = (
        f"{len(images.mixtures)} random mixtures of all four changes in each of both cameras, rendered; centres, Table "
        "1, and the angle between the two turned lines of sight, the forward camera's Δα counting plus; slope on the "
        f"traced change, which is {np.std(images.truth.angle_change[images.mixtures]) / ARCSEC:.2f} arcsec rms. Left "
        f"over: {rest / ARCSEC:.4f} arcsec rms; corrected factors: slope {better[0]:.4f}, left over "
        f"{better[2] / ARCSEC:.4f} arcsec rms."
    )
    return context.check("001.fig4.angle").evaluate(slope, sigma, how, None, [f_x / g.principal_distance_m])


GROUP = group_of("001.joint", run)
