"""Checks of the formulas of paper 001 (Wang et al. 2018) on rendered images.

Single changes of a camera test (1) to (7). The joint form tests superposition (8), symmetry (9), separation (10) and
(11), the last column of Table 1 for all four changes at once, and the angle of Fig. 4.

A displacement of a spot is before - after, in any unit of length; X is across the line CCD, Y along it, L is at its +Y
end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from statistics import fmean
from typing import Any, TypeVar

import numpy as np
from matplotlib.figure import Figure

from analysis.arrays import ARCSEC
from analysis.monitor import autocollimator, recovery
from analysis.monitor.monitor_formulas import MonitorGeometry
from analysis.statistics import rms
from optics.geometry.surface import plane
from optics.geometry.tree import Body, Motion, RigidTree, State
from optics.numerics.backend import Backend
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.specs.instrument import BASE
from twin.framework.artefact import Cell
from twin.framework.svg import BLUE, GREY, INK, LIGHT
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import ObservationOptions, observe, shared_detector
from twin.monitor.truth import Truth
from twin.validation.check import CheckResult
from twin.validation.group import Context, drawing, group_of

Value = TypeVar("Value", float, np.ndarray)
Measured = tuple[float, float]
"""Pair of a measured value and its standard deviation, in the same unit."""
MIRROR_ROTATIONS = tuple(math.radians(angle) for angle in (1 / 3600, 1 / 60, 0.5, 2.0, 10.0))
INSTRUMENT = "monitor_pair"
"""Name of the instrument with the camera that Table 5 implies: f = 7.7 m, area CCDs 0.73 m apart."""
FRAMES = 9
PARAMETERS = ("d_alpha", "d_beta", "d_gamma", "d_f")
SHIFT, ROTATION, SCALE, PISTON, FACE = 50e-6, 20 * ARCSEC, 20e-6, 50e-6, 4 * ARCSEC
"""Sizes of the motions that test the formulas, in metres, radians, and as a fraction.

They are shifts of the line CCD along X or Y, its rotation about Z, the expansion of the camera, the shift of the line
CCD along Z, and the rotation of a reflecting face.
"""
AMOUNTS = {"d_alpha": SHIFT, "d_beta": SHIFT, "d_gamma": ROTATION, "d_f": SCALE}
"""Parameter of a camera -> size of the motion that changes it in the simulated states.

The line CCD moves along X (d_alpha) and Y (d_beta), in metres, and rotates about Z (d_gamma), in radians; the camera is
scaled (d_f), relative.
"""
SMALLEST = 0.5
"""Smallest size of a random motion, as a fraction of its value in AMOUNTS."""
UNITS = np.array([ARCSEC, ARCSEC, ARCSEC, 1e-6])
"""Units of the four camera parameters in SI: arcsec for the three angles, micrometres for d_f."""
_FACTS: dict[str, Any] = {
    "frames": FRAMES,
    "instrument": INSTRUMENT,
    "amounts": AMOUNTS,
    "piston": PISTON,
    "face": FACE,
}


def roll_displacement(x_left: Value, x_right: Value) -> Value:
    """Return the displacement of a spot across the line due to a roll of the camera, from both spots' X, by eq. (4)."""
    return (x_left - x_right) / 2.0


def scale_displacement(y_left: Value, y_right: Value) -> Value:
    """Return the displacement of a spot along the line due to a change of the focal length, by eq. (6).

    The term (y11 - y01) of the paper is minus Y of the left spot.
    """
    return (y_right - y_left) / 2.0


def superposed(first: Value, second: Value) -> Value:
    """Return the displacement of a spot due to two changes at once from those due to each, by eq. (8)."""
    return first + second


def right_of_focal_length(left: Value) -> Value:
    """Return the displacement Y of the right spot from that of the left one for a focal length change, eq. (9).

    For a rotation of the line of sight about X both are equal.
    """
    return -left


def parts_along(left: Value, right: Value) -> tuple[Value, Value]:
    """Return the parts of the spots' displacement along the line due to focal length and rotation about X, eq. (10)."""
    return (left - right) / 2.0, (left + right) / 2.0


def parts_across(left: Value, right: Value) -> tuple[Value, Value]:
    """Return the parts of the spots' displacement across the line due to rotation about Y and to roll, eq. (11)."""
    return (left + right) / 2.0, (left - right) / 2.0


def focal_lengths(geometry: MonitorGeometry) -> tuple[float, float]:
    """Return the focal lengths of a camera along and across the line, metres."""
    f = geometry.principal_distance_m
    return f, geometry.principal_distance_across_m or f


@dataclass(frozen=True)
class Ratio:
    """Measured value divided by the correct one, as a mean over the cameras.

    Attributes
    ----------
    value : float
        Mean over the cameras.
    sigma : float
        Standard deviation of ``value``.
    cameras : Mapping[str, Measured]
        Camera -> (ratio, its sigma).
    """

    value: float
    sigma: float
    cameras: Mapping[str, Measured]

    @property
    def text(self) -> str:
        """Text with the ratio of each camera."""
        return ", ".join(f"{name} {value:.5f} ± {sigma:.5f}" for name, (value, sigma) in self.cameras.items())


def quotient(above: Measured, below: Measured) -> Measured:
    """Return the quotient of two measured numbers, (value, sigma) each, with its sigma."""
    value = above[0] / below[0]
    return value, float(np.hypot(above[1], value * below[1]) / abs(below[0]))


class MonitorImages:
    """Spots measured in nine rendered frames before and after every change, with the estimates by the formulas.

    Parameters
    ----------
    context
        Context of the group, which gives the seed of the noise.
    experiment
        Monitoring experiment with the instrument.
    states
        Name -> state after the change; the bodies of both cameras may move in it.
    """

    def __init__(self, context: Context, experiment: MonitorExperiment, states: Mapping[str, State]) -> None:
        self.experiment = experiment
        self.cameras = tuple(experiment.calibration.cameras)
        self.motions = list(states)
        state_list = list(states.values())
        context.progress(0.2, "trace the truth")
        self.truth: Truth = experiment.sight.truth(state_list)
        context.progress(0.5, "render and measure the spots")
        how = ObservationOptions(shared_detector(experiment, FRAMES, context.seed), use_prior=False)
        pieces = [observation.recovery for observation in observe(experiment, state_list, how)]
        self.before = np.concatenate([p.before for p in pieces])
        self.after = np.concatenate([p.after for p in pieces])
        self.covariance = np.concatenate([p.shift_covariance for p in pieces])

    def geometry(self, camera: str) -> MonitorGeometry:
        """Return a camera's geometry for the formulas of paper 001 (Wang et al. 2018).

        It contains principal distance, field angles and distances.
        """
        return self.experiment.calibration.cameras[camera].geometry

    @property
    def first(self) -> MonitorGeometry:
        """Geometry of the first camera; both cameras have the same prescription."""
        return self.geometry(self.cameras[0])

    def local(self, camera: str) -> float:
        """Return a camera's focal length along the line at its centre, divided by the formulas' f.

        d_beta is defined at the centre; the formulas use one focal length f for the whole line.

        The formulas use one focal length f for the whole line.
        """
        model = self.experiment.instrument.cameras[camera]
        return model.line_principal_distance / self.geometry(camera).principal_distance_m

    @property
    def local_share(self) -> float:
        """Mean over the cameras of the focal length at the line's centre divided by the formulas' f."""
        return fmean(self.local(camera) for camera in self.cameras)

    def estimates(self) -> recovery.Estimates:
        """Estimates of all estimators from the spots of all states."""
        return recovery.estimates(self.before, self.after, self.covariance, self.experiment.calibration.cameras)

    def reading(self, camera: str, motion: str, parameter: str) -> Measured:
        """Return the estimate in one state by the paper's formula for a single change, and its sigma, SI units."""
        estimate = self.estimates().parameters[camera]["paper_single"]
        state, k = self.motions.index(motion), PARAMETERS.index(parameter)
        return float(estimate.vector[state, k]), float(estimate.sigma[state, k])

    def true(self, camera: str, motion: str, parameter: str) -> float:
        """Return the traced change of one of PARAMETERS, in SI units."""
        return float(getattr(self.truth.cameras[camera], parameter)[self.motions.index(motion)])

    def spots(self, camera: str, motion: str, axis: str) -> tuple[float, float, float]:
        """Return the displacements before - after of the left and the right spot along an axis, and their common sigma.

        The axis is X or Y; all numbers are in metres.
        """
        state, k, column = self.motions.index(motion), self.cameras.index(camera), "YX".index(axis)
        moved = (self.before - self.after)[state, 2 * k : 2 * k + 2, column]
        pitch = self.geometry(camera).pitch_m
        variance = np.diagonal(self.covariance[state])[4 * k : 4 * k + 4][column::2]
        return float(moved[0]) * pitch, float(moved[1]) * pitch, float(np.sqrt(variance.mean())) * pitch

    def ratio(self, of: Callable[[str], Measured]) -> Ratio:
        """Return the mean over the cameras of a measured ratio, with its sigma; the cameras' noise is independent."""
        cameras = {camera: of(camera) for camera in self.cameras}
        values, sigmas = np.array(list(cameras.values())).T
        return Ratio(float(values.mean()), float(np.sqrt(np.sum(sigmas**2)) / len(values)), cameras)

    def over(self, motion: str, parameter: str, amount: float | None = None) -> Ratio:
        """Return the estimate of a parameter divided by ``amount``, by default by the traced change."""
        return self.ratio(
            lambda camera: quotient(
                self.reading(camera, motion, parameter),
                (self.true(camera, motion, parameter) if amount is None else amount, 0.0),
            )
        )


class SingleMotions(MonitorImages):
    """Images of states with one of the motions for which the formulas were derived, made by both cameras at once."""

    def __init__(self, context: Context, experiment: MonitorExperiment) -> None:
        cameras = [f"{BASE}/{name}" for name in experiment.instrument.cameras]
        planes = [f"{camera}/focal_plane" for camera in cameras]
        faces = [channel.face_body for channel in experiment.instrument.channels]
        moved = {
            "along X": (planes, Motion(shift=(SHIFT, 0.0, 0.0))),
            "along Y": (planes, Motion(shift=(0.0, SHIFT, 0.0))),
            "about Z": (planes, Motion(rotate=(0.0, 0.0, ROTATION))),
            "piston": (planes, Motion(shift=(0.0, 0.0, PISTON))),
            "scale": (cameras, Motion(scale=SCALE)),
            "face across": (faces, Motion(rotate=(FACE, 0.0, 0.0))),
            "face along": (faces, Motion(rotate=(0.0, FACE, 0.0))),
        }
        states = {name: dict.fromkeys(bodies, motion) for name, (bodies, motion) in moved.items()}
        super().__init__(context, experiment, states)

    def needed_factor(self, parameter: str) -> Ratio:
        """Return the correct factor to use instead of cos² in eq. (2) or (3).

        It is the true change times 2 f divided by the mean spot shift. Along the line f is the focal length at its
        centre, where d_beta is defined; across it, that of the formula.
        """
        motion = {"d_beta": "along Y", "d_alpha": "along X"}[parameter]

        def factor(camera: str) -> Measured:
            geometry = self.geometry(camera)
            local, field = 1.0, geometry.field_alpha_rad
            if parameter == "d_beta":
                local, field = self.local(camera), geometry.field_beta_rad
            value, sigma = self.reading(camera, motion, parameter)
            bare = math.tan(value) / math.cos(field) ** 2 / local
            shift = self.true(camera, motion, parameter) / bare
            return shift, abs(shift * sigma / value)

        return self.ratio(factor)

    def displacement(self, direction: str) -> Ratio:
        """Return the rotation of a return face by eq. (1) divided by the true rotation.

        ``direction`` is ``along`` or ``across`` the line. Eq. (1) uses the mean displacement of the spots, and the
        focal length in that direction.
        """

        def rotation(camera: str) -> Measured:
            f, f_x = focal_lengths(self.geometry(camera))
            left, right, sigma = self.spots(camera, f"face {direction}", "Y" if direction == "along" else "X")
            moved = 0.5 * (abs(left) + abs(right))
            made = float(autocollimator.mirror_rotation(moved, f if direction == "along" else f_x)) / FACE
            return made, made * sigma / math.sqrt(2.0) / moved

        return self.ratio(rotation)

    def roll(self) -> Ratio:
        """Return the spots' displacement across the line divided by that of the line CCD's ends, eq. (4).

        The camera has a roll.
        """

        def moved(camera: str) -> Measured:
            left, right, sigma = self.spots(camera, "about Z", "X")
            end = 0.5 * self.geometry(camera).separation_m * math.tan(ROTATION)
            return quotient((roll_displacement(left, right), sigma / math.sqrt(2.0)), (end, 0.0))

        return self.ratio(moved)

    def scale_of_spots(self) -> Ratio:
        """Return the mean spot displacement by eq. (6) divided by L Δf / f of eq. (7).

        Δf is the traced change of the focal length f, L the position of the spot along the line.
        """

        def moved(camera: str) -> Measured:
            left, right, sigma = self.spots(camera, "scale", "Y")
            g = self.geometry(camera)
            should = g.separation_m * self.true(camera, "scale", "d_f") / g.principal_distance_m
            return quotient((scale_displacement(left, right), sigma / math.sqrt(2.0)), (should, 0.0))

        return self.ratio(moved)

    def scale_by_side(self) -> float:
        """Return the largest relative difference of one side's spot displacement from the mean of eq. (6)."""
        worst = 0.0
        for camera in self.cameras:
            left, right, _ = self.spots(camera, "scale", "Y")
            mean = scale_displacement(left, right)
            worst = max(worst, float(np.max(np.abs(np.array([-left, right]) / mean - 1.0))))
        return worst


@drawing("formulas-001", lambda ratios: 0.8 + 0.27 * len(ratios))
def _ratios_svg(figure: Figure, ratios: Mapping[str, tuple[str, float]]) -> None:
    """Draw a row per check with its equation and the ratio of measured to correct value."""
    axes = figure.subplots()
    axes.axvline(1.0, color=INK, lw=1.0)
    for row, (_, value) in enumerate(ratios.values()):
        axes.plot([1.0, value], [row, row], color=LIGHT, lw=4.0, solid_capstyle="butt", zorder=0)
        axes.plot([value], [row], "o", color=BLUE, ms=7.0)
        text = f"{value:.4f}".replace("-", "\N{MINUS SIGN}")
        axes.text(1.06, row, text, transform=axes.get_yaxis_transform(), ha="right", va="center")
    axes.text(1.06, -0.75, "measured", transform=axes.get_yaxis_transform(), ha="right", va="center", color=GREY)
    axes.set_yticks(range(len(ratios)), [f"{name}   {where}" for name, (where, _) in ratios.items()])
    axes.set_ylim(len(ratios) - 0.5, -0.6)
    axes.set_xlabel("measured, where 1 is a correct formula")
    axes.tick_params(axis="y", length=0)


def _show_ratios(context: Context, name: str, ratios: Mapping[str, float]) -> None:
    """Draw the measured ratios of the selected checks, id -> value, which are 1 where a formula is correct."""
    checks = {i: context.check(i) for i in ratios if i in context.selected}
    exact = {i: (check.equation, ratios[i]) for i, check in checks.items() if check.printed == 1.0}
    if exact:
        context.figure(name, _ratios_svg(exact))


def mirror_rotations(backend: Backend, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation and displacement of a reflected ray for small rotations of a mirror, in radians.

    The displacement is on a screen at unit distance. ``rotations`` holds the rotations.
    """
    mirror = Element("mirror", "mirror", plane(), Interaction.REFLECT)
    assembly = Assembly(RigidTree((Body("mirror"),)), {"mirror": mirror}, {"path": ("mirror",)})
    states = [{"mirror": Motion(rotate=(float(rotation), 0.0, 0.0))} for rotation in (0.0, *rotations)]
    rays = make_rays(backend, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]))
    traced = trace(backend, assemble(assembly, ["path"], states), rays, world=True)
    _, direction, _, _ = traced.numpy(traced.world)
    start, after = direction[0, 0], direction[1:, 0]
    reflected = np.arctan2(np.linalg.norm(np.cross(start, after), axis=-1), after @ start)
    return reflected, np.linalg.norm(after / (after @ start)[:, None] - start, axis=-1)


def run(context: Context) -> Iterator[CheckResult]:
    """Yield the results of all checks of single changes; the images of all motions are rendered in one batch."""
    if "001.eq1.turn" in context.selected:
        context.progress(0.0, "trace a plane mirror")
        rotations = np.array(MIRROR_ROTATIONS)
        reflected, moved = mirror_rotations(context.backend, rotations)
        ratio, screen = reflected / rotations, np.abs(moved / np.tan(2 * rotations) - 1.0)
        worst = ratio[np.argmax(np.abs(ratio - 2.0))]
        yield context.row("001.eq1.turn", worst, rotations=MIRROR_ROTATIONS, screen=screen)
        if len(context.selected) == 1:
            return
    context.progress(0.1, f"build {INSTRUMENT}")
    ratios: dict[str, Ratio] = {}
    yield from _singles(context, single_images(context), ratios)
    context.progress(0.9, "draw")
    shown = {i: ratio for i, ratio in ratios.items() if i in context.selected}
    if shown:
        _show_ratios(context, "ratios", {i: ratio.value for i, ratio in shown.items()})
        numbers = {i: [float(value) for pair in ratio.cameras.values() for value in pair] for i, ratio in shown.items()}
        rows: list[list[Cell]] = [[i, *values] for i, values in numbers.items()]
        context.table("cameras", rows)


def single_images(context: Context) -> SingleMotions:
    """Render all single motions and measure their spots."""
    return SingleMotions(context, context.experiment(INSTRUMENT))


def without_cos2(geometry: MonitorGeometry, local: float) -> float:
    """Return the rotation about X by eq. (2) or Table 1 without the factor cos²β, over the true rotation.

    ``local`` is the focal length at the line's centre divided by f.
    """
    return math.cos(geometry.field_beta_rad) ** 2 * local


def _singles(context: Context, images: SingleMotions, shown: dict[str, Ratio]) -> Iterator[CheckResult]:
    """Check eqs. (1) to (7) for single changes; equations with the same content share a check."""

    def row(identifier: str, ratio: Ratio, *explained: float | None, **facts: object) -> CheckResult:
        shown.setdefault(identifier, ratio)
        more: dict[str, Any] = {
            "ratio": ratio,
            "images": images,
            "f": f,
            "f_x": f_x,
            "local": local,
            "cos2": cos2,
            **_FACTS,
            **facts,
        }
        implied = {"001.eq2.cos2": cos2, "001.eq3.cos2": 1.0}.get(identifier)
        return context.row(identifier, ratio.value, ratio.sigma, implied, explained, **more)

    (f, f_x), local = focal_lengths(images.first), images.local_share
    cos2 = math.cos(images.first.field_beta_rad) ** 2
    both = {direction: images.displacement(direction) for direction in ("along", "across")}
    far = max(both.values(), key=lambda ratio: abs(ratio.value - 1.0))
    yield row("001.eq1.displacement", far, both=both, tangent=1.0 / cos2)
    yield row("001.eq2", images.over("along Y", "d_beta"), without_cos2(images.first, local))
    yield row("001.eq2.cos2", images.needed_factor("d_beta"), 1.0)
    yield row("001.eq3", images.over("along X", "d_alpha"), f_x / f)
    # how far off the axis of the mirrors the line stands
    bias = float(images.experiment.instrument.cameras[images.cameras[0]].spec.field_bias)
    yield row("001.eq3.cos2", images.needed_factor("d_alpha"), f / f_x, bias=bias, cos2_bias=math.cos(bias) ** 2)
    read, rolled = images.over("about Z", "d_gamma", ROTATION), images.roll()
    rows = row("001.eq5", read, 2.0, rolled=rolled), row("001.eq5", rolled, None, 2.0, rolled=rolled)
    yield context.check("001.eq5").worse(*rows)
    read, grown, sides = images.over("scale", "d_f"), images.scale_of_spots(), images.scale_by_side()
    yield context.check("001.eq7").worse(*(row("001.eq7", ratio, grown=grown, sides=sides) for ratio in (read, grown)))
    true = fmean(images.true(camera, "piston", "d_f") for camera in images.cameras) / PISTON
    yield row("001.eq7.piston", images.over("piston", "d_f", PISTON), true, true=true)


def state_of(cameras: tuple[str, ...], shares: Mapping[str, np.ndarray]) -> State:
    """Return the state in which each camera makes given fractions of the four AMOUNTS, in the order of PARAMETERS."""
    state: dict[str, Motion] = {}
    for camera in cameras:
        along_x, along_y, rotation, scale = (
            float(s) * AMOUNTS[p] for s, p in zip(shares[camera], PARAMETERS, strict=True)
        )
        state[f"{BASE}/{camera}/focal_plane"] = Motion(shift=(along_x, along_y, 0.0), rotate=(0.0, 0.0, rotation))
        state[f"{BASE}/{camera}"] = Motion(scale=scale)
    return state


def states_of(cameras: tuple[str, ...], rounds: int, seed: int) -> dict[str, State]:
    """Return states with single changes, pairs on one axis, all four changes, and random mixtures of all four.

    A round of mixtures has every combination of signs once, each camera in its own order, with random sizes.
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
    """Images of single and combined changes, and of random mixtures of all four changes.

    There are ``rounds`` sets of 16 mixtures, one mixture for each combination of signs.
    """

    def __init__(self, context: Context, experiment: MonitorExperiment, rounds: int) -> None:
        super().__init__(context, experiment, states_of(tuple(experiment.instrument.cameras), rounds, context.seed))
        self.mixtures = [k for k, name in enumerate(self.motions) if name.startswith("mixture")]

    def superposition(self, first: str, second: str, axis: str) -> Ratio:
        """Return a spot's displacement due to two changes divided by the prediction of eq. (8).

        The prediction is from the displacements due to each change. Of a camera's two spots, the one farther from a
        ratio of 1 counts.
        """

        def worse(camera: str) -> Measured:
            both = self.spots(camera, f"{first}+{second}", axis)
            single = [self.spots(camera, motion, axis) for motion in (first, second)]
            noise = float(np.hypot(single[0][2], single[1][2]))
            sides = [quotient((both[k], both[2]), (superposed(single[0][k], single[1][k]), noise)) for k in (0, 1)]
            return max(sides, key=lambda side: abs(side[0] - 1.0))

        return self.ratio(worse)

    def symmetry(self, motion: str, right_from_left: Callable[[float], float]) -> Ratio:
        """Return the right spot's displacement along Y divided by its prediction from the left spot's displacement.

        ``right_from_left`` computes the prediction.
        """

        def sides(camera: str) -> Measured:
            left, right, sigma = self.spots(camera, motion, "Y")
            return quotient((right, sigma), (right_from_left(left), sigma))

        return self.ratio(sides)

    def stray(self, motion: str, wrong: str, right: str) -> Ratio:
        """Return the spots' common displacement along axis ``wrong`` divided by the size of that along axis ``right``.

        The motion should move the spots along ``right`` only.
        """

        def share(camera: str) -> Measured:
            left, other, sigma = self.spots(camera, motion, wrong)
            size = [abs(v) for v in self.spots(camera, motion, right)[:2]]
            return quotient(((left + other) / 2.0, sigma / np.sqrt(2.0)), (sum(size) / 2.0, 0.0))

        return self.ratio(share)

    def separated(
        self, single: str, axis: str, part: int, parts: Callable[[float, float], tuple[float, float]]
    ) -> Ratio:
        """Return the part of the displacement that a formula separates, divided by that due to the single change.

        The part is separated from a displacement due to all four changes. The displacement is the mean size over the
        spots, with the sign of the left spot.
        """

        def share(camera: str) -> Measured:
            left, right, sigma = self.spots(camera, "+".join(PARAMETERS), axis)
            separated_part = parts(left, right)[part], sigma / np.sqrt(2.0)
            left, right, sigma = self.spots(camera, single, axis)
            alone = 0.5 * (abs(left) + abs(right)) * np.sign(left), sigma / np.sqrt(2.0)
            return quotient(separated_part, alone)

        return self.ratio(share)

    def response(self, estimator: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the response of an estimator to true changes when all four change at once, and its sigma.

        It is a least-squares fit of the estimates in the mixtures to the traced changes and a constant, as a mean of
        the cameras.

        Returns
        -------
        tuple of (4, 4) ndarray
            Response, estimates by changes, in the order of PARAMETERS, in arcsec and micrometres; and its sigma.
        """
        parameters = self.estimates().parameters
        matrices, variances = [], []
        for camera in self.cameras:
            change = self.truth.cameras[camera]
            true = np.stack([getattr(change, p)[self.mixtures] for p in PARAMETERS], axis=-1) / UNITS
            design = np.column_stack([true, np.ones(len(true))])
            estimates = parameters[camera][estimator]
            solution, *_ = np.linalg.lstsq(design, estimates.vector[self.mixtures] / UNITS, rcond=None)
            noise = np.mean((estimates.sigma[self.mixtures] / UNITS) ** 2, axis=0)
            matrices.append(solution[:4].T)
            variances.append(np.outer(noise, np.diagonal(np.linalg.inv(design.T @ design))[:4]))
        sigma = np.sqrt(np.sum(variances, axis=0)) / len(self.cameras)
        return np.mean(matrices, axis=0), sigma

    def angle(self, estimator: str) -> tuple[float, float, float]:
        """Return the slope of the measured against the traced change of the intersection angle, with two accuracies.

        They are the slope's sigma and the rms residual, in radians. The slope is over all mixtures.
        """
        estimate = self.estimates().angle[estimator]
        true, read = self.truth.angle_change[self.mixtures], estimate.change_rad[self.mixtures]
        offset = true - true.mean()
        slope = float(offset @ read / (offset @ offset))
        sigma = float(np.sqrt(np.mean(estimate.sigma_rad[self.mixtures] ** 2) / (offset @ offset)))
        return slope, sigma, rms(read - read.mean() - slope * offset)


def joint_images(context: Context) -> JointMotions:
    """Render all states of the joint form and measure their spots."""
    context.progress(0.1, f"build {INSTRUMENT}")
    return JointMotions(context, context.experiment(INSTRUMENT), context.count(full=6, fast=1))


def run_joint(context: Context) -> Iterator[CheckResult]:
    """Yield the results of all checks of the joint form; the images of all states are rendered in one batch."""
    images = joint_images(context)
    ratios: dict[str, Any] = {
        "001.eq8.y": images.superposition("d_f", "d_beta", "Y"),
        "001.eq8.x": images.superposition("d_alpha", "d_gamma", "X"),
        "001.eq8.d_gamma_alone": images.stray("d_gamma", "Y", "X"),
        "001.eq8.d_f_alone": images.stray("d_f", "X", "Y"),
        "001.eq9.d_f": images.symmetry("d_f", right_of_focal_length),
        "001.eq9.d_beta": images.symmetry("d_beta", lambda left: left),
        "001.eq10.d_f": images.separated("d_f", "Y", 0, parts_along),
        "001.eq10.d_beta": images.separated("d_beta", "Y", 1, parts_along),
        "001.eq11.d_alpha": images.separated("d_alpha", "X", 0, parts_across),
        "001.eq11.d_gamma": images.separated("d_gamma", "X", 1, parts_across),
    }
    for identifier, ratio in ratios.items():
        yield context.row(identifier, ratio.value, ratio.sigma, ratio=ratio, **_FACTS)
    further = [*(_table_1(context, images) if context.wants("001.table1") else ()), _angle(context, images)]
    yield from further
    shown = {i: ratio.value for i, ratio in ratios.items()} | {r.id: float(r.measured or 0.0) for r in further}
    _show_ratios(context, "joint-ratios", shown)


def _table_1(context: Context, images: JointMotions) -> Iterator[CheckResult]:
    """Check the diagonal elements of Table 1 and its two off-diagonal ones that are not zero."""
    matrix, sigma = images.response("paper_joint")
    right, _ = images.response("derived")
    g, (f, f_x) = images.first, focal_lengths(images.first)
    rows = {
        "d_alpha": (0, 0, f_x / f),
        "d_beta": (1, 1, without_cos2(g, images.local_share)),
        "d_gamma": (2, 2, 2.0 * f_x / f),
        "d_f": (3, 3, 0.5),
        "d_gamma_by_d_beta": (2, 1, -2.0 * f_x / f * g.d_gamma_per_beta),
        "d_f_by_d_alpha": (3, 0, -0.5 * g.d_f_per_alpha_m * ARCSEC / 1e-6),
    }
    facts: dict[str, Any] = {"images": images, "f": f, "f_x": f_x, "local": images.local_share, **_FACTS}
    for name, (k, n, predicted) in rows.items():
        identifier = f"001.table1.{name}"
        yield context.row(identifier, matrix[k, n], sigma[k, n], None, [predicted], right=right[k, n], **facts)
    cells: list[list[Cell]] = [
        [
            name,
            *(f"{matrix[k, n]:.4f} ± {sigma[k, n]:.4f}" for n in range(4)),
            *(f"{right[k, n]:.4f}" for n in range(4)),
        ]
        for k, name in enumerate(PARAMETERS)
    ]
    context.table("table1-response", cells)


def _angle(context: Context, images: JointMotions) -> CheckResult:
    slope, sigma, rest = images.angle("paper_joint")
    better = images.angle("derived")
    f, f_x = focal_lengths(images.first)
    change = np.std(images.truth.angle_change[images.mixtures])
    facts: dict[str, Any] = {"images": images, "change": change, "rest": rest, "better": better}
    return context.row("001.fig4.angle", slope, sigma, None, [f_x / f], **facts)


GROUP = group_of("001.formulas", run)
JOINT = group_of("001.joint", run_joint)
