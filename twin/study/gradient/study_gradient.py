"""Jacobian of a study's responses with respect to its factors, at the values of the base job.

Spots and lines of sight are differentiated by automatic differentiation through the ray trace (spots in reverse mode in
``twin.monitor.monitor_derivative``, lines of sight in forward mode in this file). The estimators, which are formulas of
these numbers, are differentiated along the resulting directions. All other responses have finite differences only: of
ray traces for everything that needs no image and so has no noise, else of the whole job with the noise of the base
job's seed.

A chief ray starts at a point of the line CCD and is aimed through the centre of the stop. By the implicit function
theorem the change of its direction per motion is -(d hit / d direction)^-1 (d hit / d motion), where hit is the point
in the plane of the stop; with it the ray's derivative is propagated forward to object space.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from analysis.monitor.recovery import Recovery, estimates
from optics.geometry.tree import COMPLEX_STEP, FIGURE, Motion, State
from optics.numerics.array_math import inverse, matvec
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.aim import AimError
from optics.raytrace.first_order import aim_chief_rays
from optics.raytrace.system import SystemBatch, assemble
from optics.raytrace.trace import BeamMissedError, jvp
from scenes.models.instrument_model import Instrument
from scenes.specs.job import checked_nodes
from scenes.specs.resolved import ResolvedJob
from scenes.specs.study import FactorSpec, ResponseSpec
from scenes.yaml.errors import InputError, KeyPath, Problem, shown
from scenes.yaml.units import with_unit
from twin.framework.cli import InputErrorText
from twin.framework.procedure import Advance, silent
from twin.monitor.image_quality import quality_dicts
from twin.monitor.monitor_derivative import hit_slopes, spot_gradient
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.truth import ACROSS, LINE_POINTS, ElementaryMotion, line_in_world
from twin.study.runs.base_job import Failure, Run, leaf
from twin.study.runs.plan import number_at, number_of, ratios, scaled
from twin.study.runs.render_base import PERTURB, JobMaker, run_results
from twin.study.runs.setup import StudySetup

CAP = {"shift": 1e-3, "rotate": 3e-4, "scale": 1e-3, "figure": 1e-6}
"""Kind of motion -> largest step of its finite difference, in metres, radians or pure numbers.

Such a step moves the beam on the mirrors by a few millimetres at most.
"""
ROUNDING = 1e-9
"""Amplitude of a resulting motion, relative to the motions that it is the sum of, below which it is rounding error."""

Slopes = Mapping[ElementaryMotion, float]
"""Elementary motion (one body, kind and axis) -> derivative of its amount with respect to a factor of the study."""


def motion_slopes(about: State, state: Callable[[float], State], step: float) -> Slopes | None:
    """Return the derivatives of the amounts of a state's motions with respect to a factor of the study.

    The result is None if the factor changes more than rigid motions, figures and scales.

    Parameters
    ----------
    about : State
        State of the instrument in the base job.
    state : callable
        Function from a change of the factor to the state.
    step : float
        Step of the factor. Motions are linear in it, or nearly so where temperatures contribute.
    """
    at = [state(share * step) for share in SHARES]
    slopes: dict[ElementaryMotion, float] = {}
    for path in {path for moved in at for path in moved}:
        base = about.get(path, Motion())
        motions = [moved.get(path, base) for moved in at]
        if any(_rest(motion) != _rest(base) for motion in motions):
            return None
        terms = sorted({j for motion in motions for j in motion.figure})
        kinds = [(kind, axis) for kind in ("rotate", "shift") for axis in range(3)]
        for kind, axis in (*kinds, ("scale", 0), *(("figure", j) for j in terms)):
            a, b, c, d = (motion.component(kind, axis) for motion in motions)
            wide, narrow = (a - b) / (2.0 * step), (c - d) / step
            slope = narrow + (narrow - wide) / 3.0
            if abs(slope * step) > ROUNDING * max(abs(base.component(kind, axis)), CAP[kind] * ROUNDING):
                slopes[ElementaryMotion(path, kind, axis, base.pivot)] = slope
    return slopes


def _rest(motion: Motion) -> Motion:
    """Return the part of a motion that is not elementary: its pivot and its thermal deformation."""
    nothing = (0.0, 0.0, 0.0)
    return replace(motion, rotate=nothing, shift=nothing, scale=0.0, figure=FrozenMap({}))


SPOT_RANGE, SIGHT_RANGE = 1.0, 1e-4
"""Steps of the numerical derivatives of the formulas: of spot shifts in px, and of the line of sight in rad.

They are so small that the error after Richardson's extrapolation is below rounding, and so large that rounding is below
1e-11.
"""
SIGHT_SHARE = 5e-3
"""Largest step by which the lines of sight are rotated for a derivative, as a fraction of half the field of a line CCD.

The principal distance is a fit over that field; the relative error of its derivative is the fourth power of this
fraction.
"""


@dataclass(frozen=True, eq=False)
class Chain:
    """Instrument of a job with the formulas by which the job converts spots and directions to results.

    Spots are means of traced rays, which are the energy centroids of the images. An instrument without a monitor has
    only lines of sight.

    Attributes
    ----------
    resolved : ResolvedJob
        Job with the contents of all files that it refers to.
    experiment : MonitorExperiment
        Instrument of the job.
    """

    resolved: ResolvedJob
    experiment: MonitorExperiment

    def spots(self, states: Sequence[State]) -> np.ndarray:
        """Return the spot positions in S states, (S, C, 2): row and column, px from the first pixel's centre.

        Array dimensions: S states, C spots.

        Raises
        ------
        AimError, BeamMissedError
            The light of a state is lost.
        """
        if not self.experiment.monitored:
            return np.zeros((len(states), 0, 2))
        return self.experiment.path.coarse.mean_spots(states)

    def sight(self, states: Sequence[State]) -> np.ndarray:
        """Return the viewing directions of the line CCDs' points in S states, (S, cameras, points, 3), unit vectors.

        Raises
        ------
        AimError, BeamMissedError
            The light of a state is lost.
        """
        return np.swapaxes(self.experiment.sight.trace(states), 0, 1)

    @cached_property
    def sight_range(self) -> float:
        """Step by which lines of sight are rotated for a derivative, in radians; smaller for a narrow field."""
        ends = self.experiment.sight.nominal[:, 0, [0, -1]]
        half = 0.5 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
        return float(min(SIGHT_RANGE, SIGHT_SHARE * np.min(half)))

    @cached_property
    def nominal(self) -> np.ndarray:
        """Spot positions of the unperturbed instrument, (1, C, 2): row and column of C spots, in pixels."""
        return self.spots([{}])

    def outcome(self, state: State, spots: np.ndarray, sight: np.ndarray) -> dict[str, Any]:
        """Return the results ``truth`` and ``recovered`` of one state from its spot positions and lines of sight.

        Without a monitor there is only ``truth``.

        Parameters
        ----------
        state : State
            State of the instrument.
        spots : (C, 2) ndarray
            Row and column of C spots, in pixels.
        sight : (cameras, points, 3) ndarray
            Unit vectors of the lines of sight.
        """
        truth = self.experiment.sight.truth_of(sight[:, None])
        if not self.experiment.monitored:
            return run_results(self.resolved, self.experiment, state, truth)
        start, end = self.nominal, spots[None]
        cameras = self.experiment.cameras
        joint = np.zeros((1, 2 * end.shape[1], 2 * end.shape[1]))
        estimated = estimates(start, end, joint, cameras, self.experiment.disturbances, self.experiment.ground)
        none = np.zeros_like(end)
        recovery = Recovery(start, end, none, none, joint, estimated.parameters, estimated.angle, estimated.ground)
        return run_results(self.resolved, self.experiment, state, truth, recovery)

    def moved(
        self, state: State, at: tuple[np.ndarray, np.ndarray], spots: np.ndarray, sight: np.ndarray
    ) -> tuple[list[dict[str, Any]], float]:
        """Return the results at four points near a state, along given derivatives of its spots and lines of sight.

        The four results belong to ``SHARES`` times a step; its length is returned too.

        Parameters
        ----------
        state : State
            State of the instrument.
        at : tuple of ndarray
            Spot positions and lines of sight of the state.
        spots : (C, 2) ndarray
            Derivative of the positions of C spots, in pixels per unit of the factor.
        sight : (cameras, points, 3) ndarray
            Derivative of the lines of sight, per unit of the factor.
        """
        largest = max(np.abs(spots).max(initial=0.0) / SPOT_RANGE, np.abs(sight).max() / self.sight_range)
        step = 1.0 / float(largest) if largest > 0.0 else 1.0
        positions, line = at
        return [
            self.outcome(state, positions + share * step * spots, line + share * step * sight) for share in SHARES
        ], step


SHARES = (1.0, -1.0, 0.5, -0.5)
"""Multiples of a step from the base value at which values are taken for Richardson's extrapolation."""


def extrapolated(values: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return central differences extrapolated by Richardson's method, and the size of the correction.

    Parameters
    ----------
    values : (4, ...) ndarray
        Function values at the base value plus ``SHARES`` times the step.
    step : float
        Full step.
    """
    wide, narrow = (values[0] - values[1]) / (2.0 * step), (values[2] - values[3]) / step
    return narrow + (narrow - wide) / 3.0, np.abs(narrow - wide) / 3.0


def sight_gradient(
    instrument: Instrument, backend: Backend, motions: Sequence[ElementaryMotion], about: State
) -> np.ndarray:
    """Return the derivatives of the lines of sight of the line CCDs' points with respect to motions of bodies.

    Parameters
    ----------
    instrument : Instrument
        Instrument that is evaluated.
    backend : Backend
        Array backend of the ray trace.
    motions : sequence of ElementaryMotion
        M elementary motions, with the pivots that the bodies have in ``about``.
    about : State
        State at which to differentiate.

    Returns
    -------
    (cameras, M, LINE_POINTS, 3) ndarray
        Derivatives of the unit direction vectors in the world frame, per radian, metre or unit of the motion.

    Raises
    ------
    AimError, BeamMissedError
        The state moves the image off the mirrors.
    """
    assembly, names, m = instrument.assembly, list(instrument.cameras), len(motions)
    states = [_named(motion, about) for motion in motions]
    steps = [motion.step for motion in motions]
    placed, stepped = assembly.place([about]), assembly.place(states, steps)
    stop = assemble(assembly, [f"{name}/image_to_stop" for name in names], [about], placed=placed)
    points = np.concatenate([line_in_world(instrument, name, placed) for name in names])
    guess = np.concatenate([instrument.toward_optics(placed, name) for name in names])[:, None]
    fan, q, _ = aim_chief_rays(backend, stop, points, guess, ACROSS)
    position, direction = fan.at(q)
    axes, slope = hit_slopes(backend, stop, position, direction)

    moved = np.concatenate([line_in_world(instrument, name, stepped).imag for name in names]) / COMPLEX_STEP
    positions, heading = np.repeat(position, m, axis=0), np.repeat(direction, m, axis=0)

    def systems(sequence: str) -> SystemBatch:
        return assemble(assembly, [f"{name}/{sequence}" for name in names], states, steps, stepped)

    drift = jvp(backend, systems("image_to_stop"), positions, heading, moved, 0.0).position[..., :2]
    rotation = -matvec(np.repeat(inverse(slope), m, axis=0), drift)
    to_object = systems("image_to_object")
    heading_step = np.einsum("bnk,bnkx->bnx", rotation, np.repeat(axes, m, axis=0))
    pushed = jvp(backend, to_object, positions, heading, moved, heading_step)
    local = pushed.traced.numpy()[1]
    # transformed from the moving frame of the last element to the world
    assert to_object.world_tangents is not None
    pose, pose_step = (poses.rotation[:, -1] for poses in (to_object.world, to_object.world_tangents))
    world = np.einsum("bij,bnj->bni", pose, pushed.direction) + np.einsum("bij,bnj->bni", pose_step, local)
    return np.asarray(world).reshape(len(names), m, LINE_POINTS, 3)


def _named(motion: ElementaryMotion, about: State) -> State:
    """Return the state ``about`` in which the motion's body has its pivot and, with zero amplitude, its figure term."""
    start = about.get(motion.body, Motion(pivot=motion.pivot))
    figure = {motion.axis: 0.0, **start.figure} if motion.kind == FIGURE else start.figure
    return {**about, motion.body: replace(start, figure=figure)}


@dataclass(frozen=True, eq=False)
class GradientFactor:
    """Factor with respect to which responses are differentiated.

    Attributes
    ----------
    setup : StudySetup
        Study with its base job, factors and responses.
    name : str
        Name of the factor.
    unit : str
        Unit of its numbers, empty for pure ones.
    value : float
        Value in the base job.
    spread : float
        Sigma of a normal distribution, otherwise half of the range of its values; in the factor's unit.
    spread_of : str
        Description of the spread in words.
    """

    setup: StudySetup
    name: str
    unit: str
    value: float
    spread: float
    spread_of: str

    @classmethod
    def of(cls, setup: StudySetup, name: str) -> GradientFactor:
        """Return the factor of the study that has the given name, with its value in the base job and its spread.

        Raises
        ------
        InputError
            The factor has no numerical values, or the base job has no number at its key.
        """
        factor = setup.study.factors[name]
        numbers = factor.numbers()
        if not numbers.numeric:
            listed = shown(list(factor.scalars()))
            problem = Problem("a factor that is not a number has no derivative", listed, "numbers or quantities")
            raise setup.error(problem, ("factors", name, factor.kind))
        unit = numbers.unit or ""
        values = numbers.values
        if factor.kind in ("normal", "truncated"):
            spread, spread_of = values[1], "sigma"
        elif factor.kind in ("values", "table", "range", "uniform"):
            spread, spread_of = 0.5 * (max(values) - min(values)), "half of its range"
        else:
            raise KeyError(f"a factor of kind {factor.kind!r} has no spread")
        if spread == 0.0:
            spread, spread_of = 1.0, "one unit"
        return cls(setup, name, unit, _in_base(setup, name, factor, unit), spread, spread_of)

    @property
    def spec(self) -> FactorSpec:
        """Specification of the factor in the study's file."""
        return self.setup.study.factors[self.name]

    def values(self, value: float) -> tuple[tuple[KeyPath, Any], ...]:
        """Return (key, value) of each entry of the base job that the factor sets when it has the given value.

        Raises
        ------
        InputError
            A value that scales with the factor cannot be computed.
        """
        cell = with_unit(value, self.unit) if self.unit else value
        out: dict[KeyPath, Any] = dict.fromkeys(self.spec.key_paths, cell)
        if self.spec.scales:
            tree = self.setup.base
            try:
                multipliers = ratios(self.spec, tree, np.array([value]), self.unit)
                out.update({key: scaled(number_of(leaf(tree, key)), float(r[0])) for key, r in multipliers.items()})
            except Problem as problem:
                raise self.setup.error(problem, ("factors", self.name)) from None
        return tuple(out.items())


def _in_base(setup: StudySetup, name: str, factor: FactorSpec, unit: str) -> float:
    """Return the factor's value in the base job, in its own unit; 1 for a factor that only scales other values."""
    numbers: list[float] = []
    for k, key in enumerate(factor.key_paths):
        try:
            numbers.append(number_at(setup.base, key, unit))
            # values that are written in several units agree to rounding
            if abs(numbers[k] - numbers[0]) > 1e-12 * abs(numbers[0]):
                text = "the places of the factor have different values in the base"
                raise Problem(text, shown(leaf(setup.base, key)), shown(leaf(setup.base, factor.key_paths[0])))
        except Problem as problem:
            raise setup.error(problem, ("factors", name, *factor.key_of(k))) from None
    return numbers[0] if numbers else 1.0


MOVE = 2.0
"""Displacement of a spot, in pixels, for which the finite-difference step of a motion is chosen.

The CCDs have room for about ten pixels.
"""
ROTATION = 1e-4
"""Rotation of a line of sight, in radians, for which the finite-difference step is chosen where there are no spots.

It corresponds to about ten pixels.
"""
PART = 0.5
"""Step of the finite differences for factors that are not motions, in units of the factor's spread."""
QUALITY_PART = 0.1
"""Step of the finite differences for image quality responses, in units of the factor's spread.

It is small because image quality is far from linear (a wavefront error is a root of squares); it is traced without
noise.
"""
TOGETHER = 8
"""Number of factors whose finite differences are traced at once."""
SMALL = 1e-3
"""Smallest reference for relative errors of derivatives, as a fraction of the response's largest change.

Changes are those due to the spread of a factor. Derivatives that are zero by symmetry have no significant digits, so
that their errors are related to this fraction of the largest change. For a response that is a difference, the larger of
its two terms counts, since their common digits cancel.
"""
AD, TRACED, WHOLE = "ad", "traced differences", "differences of the whole job"
AD_PART = "automatic differentiation"
"""Name of the automatic differentiation in the progress display; other stages have the name of their method."""


@dataclass(frozen=True, eq=False)
class Gradient:
    """Jacobian of a study: derivatives of R responses with respect to F factors, in response units per factor unit.

    Attributes
    ----------
    factors : tuple of GradientFactor
        Factors.
    responses : tuple of str
        Names of the responses.
    units : tuple of str
        Units of the responses, empty for pure numbers.
    ad : (R, F) ndarray
        Derivatives by automatic differentiation; NaN where there is none.
    differences : (R, F) ndarray
        Derivatives by central differences.
    error : (R, F) ndarray
        Correction of the differences by Richardson's extrapolation, as an estimate of their error.
    scale : (R, F) ndarray
        Absolute value of the derivative; where a response is the difference of two numbers, that of the larger
        derivative of the two.
    step : (R, F) ndarray
        Steps of the differences, in the factor's unit.
    method : (R, F) ndarray of str
        Method of the best available derivative.
    """

    factors: tuple[GradientFactor, ...]
    responses: tuple[str, ...]
    units: tuple[str, ...]
    ad: np.ndarray
    differences: np.ndarray
    error: np.ndarray
    scale: np.ndarray
    step: np.ndarray
    method: np.ndarray

    @classmethod
    def unknown(cls, factors: tuple[GradientFactor, ...], asked: Sequence[_GradientResponse]) -> Gradient:
        """Return a Jacobian for the given factors and responses whose entries are still NaN."""
        shape = (len(asked), len(factors))
        names, units = tuple(response.name for response in asked), tuple(response.spec.units for response in asked)
        ad, differences, error, scale, step = (np.full(shape, np.nan) for _ in range(5))
        return cls(factors, names, units, ad, differences, error, scale, step, np.full(shape, WHOLE, object))

    def put(self, rows: Sequence[int], k: int, values: np.ndarray, step: float, method: str) -> None:
        """Store the finite differences of some responses with respect to factor number ``k``.

        Parameters
        ----------
        rows : sequence of int
            Indices of the R responses.
        k : int
            Index of the factor.
        values : (4, R) ndarray
            Values of the responses at the base value plus ``SHARES`` times the step.
        step : float
            Step, in the factor's unit.
        method : str
            Name of the method.
        """
        self.differences[rows, k], self.error[rows, k] = extrapolated(values, step)
        self.step[rows, k] = step
        self.method[rows, k] = method

    @property
    def best(self) -> np.ndarray:
        """Derivatives of R responses with respect to F factors, (R, F), in response units per factor unit.

        They are by automatic differentiation where available, else by finite differences.
        """
        return np.where(np.isnan(self.ad), self.differences, self.ad)

    @property
    def change(self) -> np.ndarray:
        """Change of each response when each factor changes by its spread, (R, F), in the response's unit.

        Array dimensions: R responses, F factors.
        """
        return np.asarray(self.best * np.array([factor.spread for factor in self.factors]))

    @property
    def relative(self) -> np.ndarray:
        """Relative deviation of the finite differences from automatic differentiation, (R, F); NaN without the latter.

        Deviations of small derivatives are relative to ``SMALL`` times the response's largest one. Array dimensions: R
        responses, F factors.
        """
        spread = np.array([factor.spread for factor in self.factors])
        size = self.scale * spread
        largest = np.max(np.nan_to_num(size), axis=1, initial=0.0, keepdims=True)
        against = np.maximum(size, SMALL * largest)
        deviation = np.abs(self.differences - self.ad) * spread
        return np.where(against > 0.0, deviation / np.where(against > 0.0, against, 1.0), deviation * 0.0)

    @property
    def worst(self) -> float | None:
        """Largest relative deviation of finite differences from automatic differentiation; None without the latter."""
        return float(np.nanmax(self.relative)) if np.any(~np.isnan(self.ad)) else None


@dataclass(frozen=True)
class _GradientResponse:
    """Response of a study, with the key of its number and, if it is a difference, of the subtracted number.

    Attributes
    ----------
    name : str
        Name of the response.
    spec : ResponseSpec
        Keys of its number, and of the number that is subtracted, in the results.
    """

    name: str
    spec: ResponseSpec

    def value(self, outcome: Any, setup: StudySetup) -> float:
        """Return the response; raise InputError if the results have no such number."""
        first, second = self.terms(outcome, setup)
        return first - second

    def terms(self, outcome: Any, setup: StudySetup) -> tuple[float, float]:
        """Return the response's number and the number that is subtracted from it, 0 if there is none.

        InputError is raised if the results lack one of them.
        """
        out = []
        for key, where in ((self.spec.key, "key"), (self.spec.minus, "minus")):
            if key is None:
                out.append(0.0)
                continue
            try:
                value = leaf(outcome, key)
            except Problem as problem:
                raise setup.error(problem, ("responses", self.name, where)) from None
            if isinstance(value, bool) or not isinstance(value, int | float):
                text = "the response is not a number in the base, so that it has no derivative"
                raise setup.error(text, ("responses", self.name, where), allowed="a key that leads to a number")
            out.append(float(value))
        return out[0], out[1]

    @property
    def roots(self) -> set[str]:
        """Names of the result files, without suffix, that the response needs; ``image`` for numbers that need images.

        Sigmas, and the test of the shifts against the prior, depend on the noise and so need images.
        """
        keys: list[KeyPath] = [key for key in (self.spec.key, self.spec.minus) if key is not None]
        noisy = [key[:2] == ("recovered", "disturbances") or "sigma" in str(key[-1]) for key in keys]
        return {"image" if of_noise else str(key[0]) for key, of_noise in zip(keys, noisy, strict=True)}


def study_gradient(setup: StudySetup, backend: Backend, advance: Advance = silent) -> Gradient:
    """Compute the derivatives of a study's responses with respect to its factors, at the base job's values.

    Parameters
    ----------
    setup : StudySetup
        Study with base job, factors and responses; its design is not used.
    backend : Backend
        Array backend of the ray trace.
    advance : Advance
        Callback that receives, for each method, the numbers of finished and of all factors.

    Raises
    ------
    InputError
        A factor or response has no number, a value one step away from the base job's is not allowed, or the light is
        lost one step away.
    InputErrorText
        The base job itself cannot be run.
    """
    factors = tuple(GradientFactor.of(setup, name) for name in setup.study.factors)
    asked = [_GradientResponse(name, spec) for name, spec in setup.study.responses.items()]
    maker = JobMaker(setup.tree) if setup.study.base.command == "render" else None
    if maker is not None and maker.base.job.course is not None:
        maker = None
    if maker is not None:
        asked = [*_spot_responses(maker.base), *asked]
    table = Gradient.unknown(factors, asked)
    known = {"truth", "recovered", "quality"} if maker is not None else set()
    traced = [i for i, response in enumerate(asked) if response.roots <= known]
    if maker is not None and traced:
        _Traced(setup, maker, backend, factors, asked, traced, advance).fill(table)
    rest = [i for i in range(len(asked)) if i not in traced]
    if rest:
        _whole(setup, backend, factors, [asked[i] for i in rest], rest, table, advance)
    return replace(table, method=table.method.astype(str))


def _spot_responses(resolved: ResolvedJob) -> list[_GradientResponse]:
    out = []
    for camera in resolved.instrument.cameras:
        for channel in resolved.instrument.channels_of(camera):
            for axis in ("row", "column"):
                key = ("recovered", "spots", camera, channel, "after", axis)
                out.append(_GradientResponse(f"spots.{camera}.{channel}.{axis}", ResponseSpec(key=key, unit="px")))
    return out


@dataclass(eq=False)
class _Traced:
    """Part of the Jacobian that needs no image, only ray traces.

    ``slopes`` holds, for the factors that do nothing but move bodies, the derivatives of the elementary motions.
    """

    setup: StudySetup
    maker: JobMaker
    backend: Backend
    factors: Sequence[GradientFactor]
    asked: Sequence[_GradientResponse]
    rows: Sequence[int]
    advance: Advance
    slopes: dict[int, Slopes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.exact = [i for i in self.rows if "quality" not in self.asked[i].roots]
        self.quality = [i for i in self.rows if i not in self.exact]

    def fill(self, table: Gradient) -> None:
        """Store the derivatives with respect to all factors, by automatic differentiation and by finite differences."""
        chain = Chain(self.maker.base, MonitorExperiment(self.maker.base, self.backend))
        try:
            about = _state(chain, self.maker.base)
            (chain.spots if chain.experiment.monitored else chain.sight)([about])
        except (AimError, BeamMissedError) as error:
            raise InputErrorText(f"the base cannot be differentiated, it loses its light: {error}") from error
        except InputError as error:
            raise self.setup.blamed(error) from None
        for k, factor in enumerate(self.factors):
            if all(key[:2] == PERTURB for key, _ in factor.values(factor.value)):
                slopes = motion_slopes(about, partial(self._state, chain, factor), PART * factor.spread)
                if slopes is not None:
                    self.slopes[k] = slopes
        sizes = self._exact(chain, about, table) if self.slopes else {}
        steps = {k: sizes.get(k, PART * factor.spread) for k, factor in enumerate(self.factors)}
        self._differences(chain, table, self.exact, steps)
        steps = {k: QUALITY_PART * factor.spread for k, factor in enumerate(self.factors)}
        self._differences(chain, table, self.quality, steps)
        for k in self.slopes:
            table.method[self.exact, k] = AD

    def _differences(self, chain: Chain, table: Gradient, rows: Sequence[int], steps: Mapping[int, float]) -> None:
        """Store the finite differences of selected responses with respect to all factors."""
        if not rows:
            return
        moving = list(self.slopes)
        done: dict[int, np.ndarray] = {}
        for start in range(0, len(moving), TOGETHER):
            batch = moving[start : start + TOGETHER]
            self.advance(TRACED, start, len(moving))
            jobs = [self._job(self.factors[k], share * steps[k]) for k in batch for share in SHARES]
            try:
                outcomes = self._outcomes(chain, jobs, rows)
            except (AimError, BeamMissedError, ValueError):
                continue  # they are tried one by one, to name the one
            for i, k in enumerate(batch):
                done[k] = self._numbers(outcomes[i * len(SHARES) : (i + 1) * len(SHARES)], rows)
        for k, factor in enumerate(self.factors):
            if k not in done:
                self.advance(TRACED, k, len(self.factors))
                done[k] = self._values(chain, factor, steps[k], rows)
            table.put(rows, k, done[k], steps[k], TRACED)
        self.advance(TRACED, len(self.factors), len(self.factors))

    def _numbers(self, outcomes: Sequence[Any], rows: Sequence[int]) -> np.ndarray:
        return np.array([[self.asked[i].value(outcome, self.setup) for i in rows] for outcome in outcomes])

    def _state(self, chain: Chain, factor: GradientFactor, change: float) -> State:
        job = self._job(factor, change)
        try:
            return _state(chain, job)
        except InputError as error:
            raise _refused(self.setup, factor, change, error) from None

    def _job(self, factor: GradientFactor, change: float) -> ResolvedJob:
        try:
            return self.maker.job(factor.values(factor.value + change))
        except InputError as error:
            raise _refused(self.setup, factor, change, error) from None

    def _exact(self, chain: Chain, about: State, table: Gradient) -> dict[int, float]:
        """Store derivatives by automatic differentiation; return factor index -> step for the finite differences."""
        self.advance(AD_PART, 0, 1)
        motions = list(dict.fromkeys(motion for slopes in self.slopes.values() for motion in slopes))
        spots: np.ndarray = np.zeros((*chain.nominal.shape[1:], 0))
        sight: np.ndarray = np.zeros((*chain.experiment.sight.nominal[:, 0].shape, 0))
        if motions:
            experiment = chain.experiment
            if experiment.monitored:
                spots = spot_gradient(experiment.path.coarse, motions, about)
            else:
                spots = np.zeros((*chain.nominal.shape[1:], len(motions)))
            sight = np.moveaxis(sight_gradient(experiment.instrument, self.backend, motions, about), 1, -1)
        at = chain.spots([about])[0], chain.sight([about])[0]
        sizes = {}
        for k, slopes in self.slopes.items():
            weight = np.array([slopes.get(motion, 0.0) for motion in motions])
            moved, rotated = spots @ weight, sight @ weight
            outcomes, step = chain.moved(about, at, moved, rotated)
            numbers = [[self.asked[i].terms(outcome, self.setup) for i in self.exact] for outcome in outcomes]
            terms = extrapolated(np.array(numbers).reshape(len(SHARES), -1, 2), step)[0]
            table.ad[self.exact, k] = terms[:, 0] - terms[:, 1]
            table.scale[self.exact, k] = np.abs(terms).max(axis=1)
            limits = [CAP[motion.kind] / abs(slope) for motion, slope in slopes.items()]
            if slopes:
                size = np.abs(moved).max() / MOVE if chain.experiment.monitored else np.abs(rotated).max() / ROTATION
                sizes[k] = float(min([1.0 / max(size, 1e-300), *limits]))
        self.advance(AD_PART, 1, 1)
        return sizes

    def _values(self, chain: Chain, factor: GradientFactor, step: float, rows: Sequence[int]) -> np.ndarray:
        """Return the selected responses of four jobs near the base job in which one factor is changed, (4, responses).

        The factor differs from its value in the base job by ``SHARES`` times the step.
        """
        jobs = [self._job(factor, share * step) for share in SHARES]
        same = all(key[:2] == PERTURB for key, _ in factor.values(factor.value))
        try:
            if same:
                outcomes = self._outcomes(chain, jobs, rows)
            else:
                outcomes = []
                for job in jobs:
                    outcomes += self._outcomes(Chain(job, MonitorExperiment(job, self.backend)), [job], rows)
        except (AimError, BeamMissedError, ValueError) as error:
            text = f"{step:g} {factor.unit}".strip()
            problem = f"the factor cannot be varied by {text} about the base: {error}"
            raise self.setup.error(problem, ("factors", factor.name)) from error
        except InputError as error:
            raise _refused(self.setup, factor, step, error) from None
        return self._numbers(outcomes, rows)

    def _outcomes(self, chain: Chain, jobs: Sequence[ResolvedJob], rows: Sequence[int]) -> list[dict[str, Any]]:
        states = [_state(chain, job) for job in jobs]
        spots, sight = chain.spots(states), chain.sight(states)
        out = [chain.outcome(state, spots[s], sight[s]) for s, state in enumerate(states)]
        if rows is self.quality:
            qualities = quality_dicts(chain.experiment.instrument, self.backend, states, jobs[0].job.render.obstructed)
            out = [{**outcome, "quality": quality} for outcome, quality in zip(out, qualities, strict=True)]
        return out


def _state(chain: Chain, resolved: ResolvedJob) -> State:
    """Return the state of the instrument that a job describes; raise InputError if the job cannot be applied.

    The job may name bodies by their short names.
    """
    return chain.experiment.state(checked_nodes(resolved.job, chain.experiment.instrument.nodes))


def _whole(
    setup: StudySetup,
    backend: Backend,
    factors: Sequence[GradientFactor],
    asked: Sequence[_GradientResponse],
    rows: Sequence[int],
    table: Gradient,
    advance: Advance,
) -> None:
    """Store derivatives of responses by finite differences of complete runs of the base command.

    All runs use the base job's noise seed.
    """
    for k, factor in enumerate(factors):
        advance(WHOLE, k, len(factors))
        step = PART * factor.spread
        runs = [Run(s, factor.values(factor.value + share * step), None) for s, share in enumerate(SHARES)]
        outcomes = setup.job.evaluate(setup.tree, runs, backend)
        for outcome in outcomes:
            if isinstance(outcome, Failure):
                text = f"the factor cannot be varied by {step:g} {factor.unit} about the base: {outcome.message}"
                raise setup.error(text, ("factors", factor.name))
        values = np.array([[response.value(outcome, setup) for response in asked] for outcome in outcomes])
        table.put(list(rows), k, values, step, WHOLE)
    advance(WHOLE, len(factors), len(factors))


def _refused(setup: StudySetup, factor: GradientFactor, step: float, error: InputError) -> InputError:
    issue = error.issues[0]
    at = f"{factor.value:g} ± {abs(step):g} {factor.unit}".strip()
    text = f"the base does not allow values beside its own, {at}, which finite differences need: {issue.problem}"
    problem = Problem(text, issue.value, issue.allowed, issue.suggestion)
    return setup.error(problem, ("factors", factor.name, factor.spec.kind))
