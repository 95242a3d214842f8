"""Instrument under estimation with its prior, measurements and requirements: predictions by exact traces.

A reading is one measured number. A merit is an image quality or other quantity with a requirement.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import numpy as np

from analysis.arrays import MeasurementError
from analysis.instrument_state.linearity import effective_share
from analysis.instrument_state.state_estimate import Actuators, StateEstimate, estimate_state
from optics.geometry.tree import State
from optics.numerics.array_math import PhysicalError
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from scenes.models.disturbances import DisturbancePrior, prior_of_spec
from scenes.specs.asbuilt import AsBuiltSetup, MeasurementsSpec
from scenes.specs.tolerance import OF_MONITOR, MeritSpec, ToleranceBudgetSpec, ToleranceSetup
from scenes.yaml.errors import InputError, names_text
from twin.asbuilt.measured_kinds import (
    DistortionReadings,
    FocusReadings,
    MeasuredKind,
    PositionReadings,
    SightReadings,
    Site,
    SpotReadings,
    TemperatureReadings,
    View,
    WavefrontReadings,
)
from twin.asbuilt.mtf_readings import MtfReadings
from twin.asbuilt.parameters import Parameters, with_wavefront
from twin.asbuilt.star_images import ImageReadings, StarResidual
from twin.camera.camera_optics import CameraOptics
from twin.camera.varied_beams import VariedBeams
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.truth import line_points
from twin.tolerance.tolerance_bench import ToleranceBench, judged_camera

KINDS: Mapping[str, type[MeasuredKind]] = FrozenMap(
    {
        kind.kind: kind
        for kind in (
            WavefrontReadings,
            FocusReadings,
            MtfReadings,
            DistortionReadings,
            SpotReadings,
            SightReadings,
            TemperatureReadings,
            PositionReadings,
            ImageReadings,
        )
    }
)
"""Key under ``measurements`` in the file -> class of that kind of measurement."""

STEP = 0.05
"""Step of the central differences with respect to a parameter, in standard deviations of its prior.

The relative error of a derivative is the square of this step times the derivative's relative second derivative, with
the parameter in standard deviations.
"""

_CLOSE = 10e-9
"""Accuracy to which the coefficients of mirrored wavefronts are to be reached, metres."""
_MOST, _STARTS = 3.0, 25
"""Largest amount of the wavefront's largest uncertainty, in prior standard deviations, and number of states tried."""
_REACHED = 0.5
"""Largest part of a mirrored wavefront that a state may miss for an estimate to start there."""
_ANOTHER = 3.0
"""Distance of two estimates in posterior standard deviations from which they are different states."""

_TRIED, _FOLLOWED, _KNOWN = 500, 12, 4
"""Number of states of the prior that are compared with values of MTF, of the best ones, where estimates start, and of
starts that find nothing new one after the other, which end the search.
"""

_SHARE = 1e-2
"""Step of the numerical derivatives with respect to an actuator, as a fraction of the actuator's range."""


class AsBuiltBench(Site):
    """Instrument whose state is estimated, with its measurements and merits.

    Parameters
    ----------
    setup : AsBuiltSetup
        Test with the measurements and the nominal instrument.
    backend : Backend
        Array backend of the ray trace.

    Attributes
    ----------
    test : AsBuiltSpec
        Contents of the file.
    camera : str
        Name of the camera that is evaluated.
    parameters : Parameters
        Estimated parameters.
    kinds : tuple of MeasuredKind
        Measurements in the order of the file.
    afters : tuple of str or None
        Name of the last actuator move made before each measurement; None before the first move.
    merits : ToleranceBench
        Evaluator of the merits (image quality and its requirements).

    Raises
    ------
    InputError
        A name does not exist, the prior has no motion, or the camera has no light.
    """

    def __init__(self, setup: AsBuiltSetup, backend: Backend) -> None:
        self.setup, self.backend, self.test = setup, backend, setup.test
        if setup.base.instrument.as_built:
            problem = "this instrument is already as built: list its earlier measurements here with the others"
            allowed = "the nominal instrument"
            raise self.test.error(problem, ("instrument",), value=self.test.instrument, allowed=allowed)
        self.experiment = MonitorExperiment(setup.base, backend)
        self.camera = judged_camera(self.test, self.experiment.instrument)
        self.line = line_points(self.experiment.instrument, self.camera)
        assert self.experiment.prior is not None
        prior = with_wavefront(self.experiment.prior, self.test.wavefront)
        if not prior.components:
            allowed = "a disturbances file with standard deviations greater than zero, such as `assembled`"
            raise self.test.error("the prior has no motions", ("prior",), value=self.test.prior, allowed=allowed)
        self.prior: DisturbancePrior = prior
        self.parameters = Parameters.of(self.test, prior, self.experiment.instrument, self.experiment.thermal)
        self._beams: dict[tuple[tuple[tuple[float, float], ...], bool], VariedBeams] = {}
        self.kinds = self._kinds(self.test.measurements, "measurements")
        self.afters = tuple(measurement.after for _, _, measurement in self.test.measurements.named())
        for name, merit in self.test.merits.items():
            if merit.kind in OF_MONITOR:
                problem = (
                    "monitor merits depend on the disturbances in operation, not on the assembly errors of this prior"
                )
                allowed = "`twin.uncertainty` on the resulting instrument"
                raise self.test.error(problem, ("merits", name, "kind"), value=merit.kind, allowed=allowed)
        self.merits = self.bench(dict(self.test.merits))

    def _kinds(self, measured: MeasurementsSpec, where: str) -> tuple[MeasuredKind, ...]:
        return tuple(KINDS[kind](self, name, spec, (where, kind, name)) for kind, name, spec in measured.named())

    @cached_property
    def candidates(self) -> tuple[MeasuredKind, ...]:
        """Further measurements that could be made, as the file lists them."""
        return self._kinds(self.test.candidates, "candidates")

    def beams(self, fields: tuple[tuple[float, float], ...], planes: bool = False) -> VariedBeams:
        """Return the beams at some field points, traced once for all measurements at these field points.

        With ``planes``, their light has optical paths to plane waves.
        """
        if (fields, planes) not in self._beams:
            self._beams[fields, planes] = VariedBeams(self.optics, np.array(fields), planes=planes)
        return self._beams[fields, planes]

    @cached_property
    def optics(self) -> CameraOptics:
        """Optics of the nominal camera, with which rays are traced."""
        return CameraOptics.within(self.experiment.instrument, self.camera, self.backend)

    def bench(self, merits: Mapping[str, MeritSpec]) -> ToleranceBench:
        """Return the evaluator that computes the given merits for the camera."""
        budget = ToleranceBudgetSpec.model_construct(
            instrument=self.test.instrument,
            camera=self.camera,
            tolerances=FrozenMap(),
            compensators=FrozenMap(),
            merits=FrozenMap(merits),
            allocation=None,
        ).with_source(self.test.source)
        setup = ToleranceSetup.model_construct(test=budget, base=self.setup.base)
        return ToleranceBench(setup, self.backend, self.experiment)

    # predictions

    def view(self, values: np.ndarray, after: str | None, further: np.ndarray | None = None) -> View:
        """Return the instrument's states for parameters of S states, (S, K), after the actuator move named ``after``.

        ``further`` holds the amounts of one more move, SI units; K is the number of parameters.
        """
        states: Sequence[State] = self.parameters.states(values, after, further)
        return View(values, states, lambda bodies: self.parameters.temperatures(values, bodies))

    def predict(self, values: np.ndarray) -> np.ndarray:
        """Return the error-free readings of all measurements, (S, D); NaN where the light of a state is lost.

        Array dimensions: S states, D readings, K parameters in ``values`` (S, K).
        """
        return self._predicted(values, self.kinds, self.afters)

    def _predicted(
        self, values: np.ndarray, kinds: Sequence[MeasuredKind], afters: Sequence[str | None], traced: bool = False
    ) -> np.ndarray:
        """Return the readings of some kinds in S states, or only what a trace determines of them, side by side."""

        def read(rows: slice) -> np.ndarray:
            views = {after: self.view(values[rows], after) for after in afters}
            pairs = [(kind, views[after]) for kind, after in zip(kinds, afters, strict=True)]
            return np.concatenate([kind.traced(view) if traced else kind.predict(view) for kind, view in pairs], axis=1)

        count = sum(kind.traced_count if traced else len(kind.labels) for kind in kinds)
        return nan_where_lost(read, len(values), (count,))

    def slope(
        self, values: np.ndarray, kinds: Sequence[MeasuredKind] | None = None, afters: Sequence[str | None] = ()
    ) -> np.ndarray:
        """Return the derivatives of D predicted readings with respect to K parameters at ``values``, (D, K).

        Those of traced quantities are central differences, in the SI units of reading and parameter.
        """
        kinds, afters = (self.kinds, self.afters) if kinds is None else (kinds, afters)
        sigma = self.parameters.prior.sigma
        slope = self._traced_slope(values, kinds, afters) * sigma
        if not np.all(np.isfinite(slope)):
            return np.full((sum(len(kind.labels) for kind in kinds), len(sigma)), np.nan)
        out, ends = [], np.cumsum([0, *(kind.traced_count for kind in kinds)])
        for kind, after, first, last in zip(kinds, afters, ends[:-1], ends[1:], strict=True):
            # a kind whose readings are traced themselves needs no trace of the state
            plain = type(kind).reading_slope is MeasuredKind.reading_slope
            traced = np.zeros(0) if plain else kind.traced(self.view(values[None], after))[0]
            out.append(kind.reading_slope(traced, slope[first:last]))
        return np.asarray(np.concatenate(out) / sigma)

    def _traced_slope(
        self, values: np.ndarray, kinds: Sequence[MeasuredKind], afters: Sequence[str | None]
    ) -> np.ndarray:
        return self._by_parameters(values, lambda moved: self._predicted(moved, kinds, afters, traced=True))

    def _by_parameters(self, values: np.ndarray, work: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Return the derivatives (D, K) of a function of the parameters at ``values``, by central differences.

        The function maps S sets of K parameters (S, K) to D readings (S, D).
        """
        steps = STEP * self.parameters.prior.sigma
        outputs = work(np.concatenate([values + np.diag(steps), values - np.diag(steps)]))
        ahead, behind = outputs[: len(steps)], outputs[len(steps) :]
        return np.asarray(((ahead - behind) / (2.0 * steps[:, None])).T)

    # the estimate

    def data(self) -> tuple[np.ndarray, ...]:
        """Return the readings in the data files of all measurements, SI units.

        Raises
        ------
        InputError
            A file is unreadable or does not contain these readings.
        """
        return tuple(kind.read() for kind in self.kinds)

    def estimate(self, data: Sequence[np.ndarray], start: np.ndarray | None = None) -> StateEstimate:
        """Estimate the as-built parameters of the instrument from the readings of all measurements.

        Parameters
        ----------
        data : sequence of ndarray
            Readings of each measurement, SI units.
        start : ndarray, optional
            Parameters at which the iteration starts.

        Raises
        ------
        InputError
            The errors of a measurement are impossible, or its light is lost.
        """
        return self.estimates(data, start)[0]

    def estimates(self, data: Sequence[np.ndarray], start: np.ndarray | None = None) -> tuple[StateEstimate, ...]:
        """Estimate the parameters as ``estimate`` does, and other states that explain the readings, the best first.

        Images of stars in one focus hardly depend on the sign of even aberrations. A second estimate therefore starts
        at the state whose even aberrations are reversed; it is returned where it converges to another state. Values of
        MTF are the same at several foci, so that estimates start from many states.
        """
        kinds = tuple(kind.about(values) for kind, values in zip(self.kinds, data, strict=True))
        if start is None and any(isinstance(kind, ImageReadings) for kind in kinds):
            start = self._nearby(kinds, data)
        state = self._estimate(kinds, data, start)
        expecting = [kind.expecting(self.view(state.mean[None], after)) for kind, after in self._pairs(kinds)]
        if not any(expecting):
            search = start is None and any(isinstance(kind, MtfReadings) for kind in kinds)
            return self._modes(kinds, data, state) if search else (state,)
        # the noise of light that is expected, in place of that of the light that was recorded
        kinds = tuple(other or kind for kind, other in zip(kinds, expecting, strict=True))
        state = self._estimate(kinds, data, state.mean)
        mirrored = self._mirrored(kinds, state)
        if mirrored is None:
            return (state,)
        try:
            other = self._estimate(kinds, data, mirrored)
        except InputError:
            return (state,)
        if not other.converged or not _apart(other, state):
            return (state,)
        return tuple(sorted((state, other), key=lambda mode: -mode.log_evidence))

    def _modes(
        self, kinds: Sequence[MeasuredKind], data: Sequence[np.ndarray], state: StateEstimate
    ) -> tuple[StateEstimate, ...]:
        """Return an estimate and others from starts all over the prior, each state once, the most probable first.

        An MTF is the same at several foci, so that an estimate from one start may end in a wrong one.
        """
        prior = self.parameters.prior
        unit = np.random.default_rng(0).standard_normal((_TRIED, prior.root.shape[1]))
        states = prior.mean + unit @ prior.root.T
        costs = self._chi_squares(kinds, data, states)
        modes, known = [state] if state.converged else [], 0
        for start in states[np.argsort(costs)[:_FOLLOWED]]:
            other = self._estimate(kinds, data, start)
            new = other.converged and all(_apart(other, mode) for mode in modes)
            modes, known = ([*modes, other], 0) if new else (modes, known + 1)
            if known == _KNOWN:
                break
        # a state that excludes more readings has a smaller chi-square for this alone
        fewest = min((len(mode.excluded) for mode in modes), default=0)
        modes = [mode for mode in modes if len(mode.excluded) == fewest]
        return tuple(sorted(modes, key=lambda mode: -mode.log_evidence)) or (state,)

    def _chi_squares(self, kinds: Sequence[MeasuredKind], data: Sequence[np.ndarray], states: np.ndarray) -> np.ndarray:
        """Return the chi-square of all readings in each of S states (S, K), (S,); NaN where light is lost."""
        predicted, out, first = self._predicted(states, kinds, self.afters), np.zeros(len(states)), 0
        for kind, values in zip(kinds, data, strict=True):
            rest = values - predicted[:, first : (first := first + len(values))]
            out += np.sum((kind.group(values).whitener() @ rest.T) ** 2, axis=0)
        return out

    def linear_share(self, data: Sequence[np.ndarray], state: StateEstimate) -> float:
        """Return how well the linear posterior of an estimate represents the exact one, from 0 to 1.

        Only values of MTF are checked, which bend most; all other readings count as linear.
        """
        if not any(isinstance(kind, MtfReadings) for kind in self.kinds):
            return 1.0
        kinds = tuple(kind.about(values) for kind, values in zip(self.kinds, data, strict=True))
        return effective_share(state, lambda values: self._predicted(values, kinds, self.afters))

    def star_images(self, data: Sequence[np.ndarray], state: StateEstimate) -> tuple[StarResidual, ...]:
        """Return measured and predicted images of all stars in an estimated state."""
        out: list[StarResidual] = []
        for kind, after, values in zip(self.kinds, self.afters, data, strict=True):
            if isinstance(kind, ImageReadings):
                view = self.view(state.mean[None], after)
                out += kind.about(values).expecting(view).residuals(view)
        return tuple(out)

    def _nearby(self, kinds: Sequence[MeasuredKind], data: Sequence[np.ndarray]) -> np.ndarray:
        """Return a state near which an estimate from images converges, (K,).

        Images depend on defocus, the wavefront's largest uncertainty, far beyond the range of a linear model. States
        along this direction of the prior are predicted, and the one nearest to the readings is returned.
        """
        prior = self.parameters.prior
        images = np.concatenate([np.full(kind.traced_count, isinstance(kind, ImageReadings)) for kind in kinds])
        slope = self._traced_slope(prior.mean, kinds, self.afters)[images] @ prior.root
        direction = prior.root @ np.linalg.svd(slope, full_matrices=False)[2][0]
        amounts = np.linspace(-_MOST, _MOST, _STARTS)
        states = prior.mean + amounts[:, None] * direction
        costs = amounts**2 + self._chi_squares(kinds, data, states)
        return np.asarray(states[np.nanargmin(costs)]) if np.any(np.isfinite(costs)) else prior.mean

    def _mirrored(self, kinds: Sequence[MeasuredKind], state: StateEstimate) -> np.ndarray | None:
        """Return the state nearest to the mirror image of an estimate, (K,): even aberrations of stars are reversed.

        It is None if no state of the instrument has most of these aberrations, as with two foci on both sides.
        """
        wanted = []
        for kind, after in self._pairs(kinds):
            traced = kind.traced(self.view(state.mean[None], after))[0]
            mirrored = kind.mirrored(traced)
            wanted.append(np.zeros(len(traced)) if mirrored is None else (mirrored - traced) / _CLOSE)
        slope = self._traced_slope(state.mean, kinds, self.afters) @ state.prior.root
        images = np.concatenate([np.full(kind.traced_count, isinstance(kind, ImageReadings)) for kind in kinds])
        rows, change = slope[images] / _CLOSE, np.concatenate(wanted)[images]
        step = np.linalg.solve(np.eye(rows.shape[1]) + rows.T @ rows, rows.T @ change - state.unit)
        if not np.linalg.norm(rows @ step - change) < _REACHED * np.linalg.norm(change):
            return None
        return np.asarray(state.mean + state.prior.root @ step)

    def _pairs(self, kinds: Sequence[MeasuredKind]) -> zip[tuple[MeasuredKind, str | None]]:
        """Return an iterator over kinds and the names of the last moves before them."""
        return zip(kinds, self.afters, strict=True)

    def _estimate(
        self, kinds: Sequence[MeasuredKind], data: Sequence[np.ndarray], start: np.ndarray | None
    ) -> StateEstimate:
        groups = [kind.group(values) for kind, values in zip(kinds, data, strict=True)]
        try:
            return estimate_state(
                self.parameters.prior,
                groups,
                lambda values: self._predicted(values, kinds, self.afters),
                lambda values: self.slope(values, kinds, self.afters),
                start,
            )
        except MeasurementError as error:
            raise self.test.error(str(error), ("measurements",)) from error

    # a drawn instrument

    def draw(self, rng: np.random.Generator, law: str) -> np.ndarray:
        """Return the random parameters of an instrument, (K,) for K parameters.

        They are drawn from the prior, or from the distribution under ``simulate`` in the file.

        Parameters
        ----------
        rng : Generator
            Random generator.
        law : str
            Distribution: ``normal``, or ``uniform`` with the same covariance.
        """
        prior = self.parameters.prior
        covariance = prior.covariance.copy()
        if self.setup.drawn is not None:
            drawn = prior_of_spec(self.setup.drawn, self.experiment.instrument)
            drawn_index = {component.name: k for k, component in enumerate(drawn.components)}
            names = [component.name for component in self.prior.components]
            strange = sorted(set(drawn_index) - set(names))
            if strange:
                raise self.test.error(
                    "motions that the prior does not have", ("simulate", "prior"), value=names_text(strange[:3])
                )
            rows = [k for k, name in enumerate(names) if name in drawn_index]
            drawn_rows = [drawn_index[names[k]] for k in rows]
            count = len(names)
            covariance[:count, :count] = 0.0
            covariance[np.ix_(rows, rows)] = drawn.covariance[np.ix_(drawn_rows, drawn_rows)]
        root = type(prior).of(prior.labels, covariance).root
        half = np.sqrt(3.0)
        shape = root.shape[1]
        unit = rng.standard_normal(shape) if law == "normal" else rng.uniform(-half, half, shape)
        return np.asarray(root @ unit)

    def measured(self, true: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        """Return simulated readings, with random errors, of an instrument with K given parameters, (K,).

        Raises
        ------
        PhysicalError
            The light is lost.
        """
        return tuple(
            kind.measured(self.view(true[None], after), rng)
            for kind, after in zip(self.kinds, self.afters, strict=True)
        )

    # merits and moves

    @property
    def last(self) -> str | None:
        """Name of the last actuator move that was made; None if there was none."""
        return self.parameters.moves[-1] if self.parameters.moves else None

    def merit_parts(self, values: np.ndarray, after: str | None, further: np.ndarray | None = None) -> np.ndarray:
        """Return the parts of the merits in S states, (S, P); NaN where the light is lost.

        Parts are smooth quantities, such as the MTF at one field; their number is P.

        Parameters
        ----------
        values : (S, K) ndarray
            K parameters of each state.
        after : str, optional
            Name of the last move that was made; None before the first.
        further : ndarray, optional
            Amounts of a further move, SI units.
        """
        return nan_where_lost(
            lambda rows: self.merits.parts_of(
                self.parameters.states(values[rows], after, selected_moves(further, rows))
            ),
            len(values),
            (self.merits.parts,),
        )

    def merit_residuals(self, values: np.ndarray, after: str | None, further: np.ndarray | None = None) -> np.ndarray:
        """Return residuals of the merits in S states, (S, R), whose sum of squares the optimum actuator move minimises.

        The sum of squares of the R residuals is the sum over the merits of the mean square over fields or points, in
        units of the requirement.

        Raises
        ------
        PhysicalError
            The light of a state is lost.
        """
        return self.merits.residuals_of(self.parameters.states(values, after, further))

    @cached_property
    def actuators(self) -> Actuators:
        """Limits, steps and errors of the next move.

        A limit is what earlier moves have left of the actuator's range.
        """
        specs = tuple(self.test.actuators.values())
        moved = np.sum(self.parameters.wanted, axis=0) if self.parameters.moves else np.zeros(len(specs))
        ranges = np.array([spec.range_si for spec in specs])
        return Actuators(
            tuple(self.test.actuators),
            np.minimum(0.0, -ranges - moved),
            np.maximum(0.0, ranges - moved),
            np.array([spec.step_si for spec in specs]),
            np.array([spec.move_error for spec in specs]),
            np.array([spec.accuracy_si for spec in specs]),
        )

    def merit_slope(self, values: np.ndarray, after: str | None) -> np.ndarray:
        """Return the derivatives of the merits' residuals with respect to the parameters at ``values`` (K,), (R, K).

        Array dimensions: R residuals, K parameters.
        """
        return self._by_parameters(values, lambda moved: self.merit_residuals(moved, after))

    @cached_property
    def actuator_steps(self) -> np.ndarray:
        """Steps of the numerical derivatives with respect to C actuators, (C,), SI units."""
        return _SHARE * np.array([spec.range_si or 1.0 for spec in self.test.actuators.values()])


def _apart(first: StateEstimate, second: StateEstimate) -> bool:
    return bool(np.linalg.norm(np.linalg.solve(second.root, first.unit - second.unit)) > _ANOTHER)


def nan_where_lost(
    work: Callable[[slice], np.ndarray], count: int, shape: tuple[int, ...], first: int = 0
) -> np.ndarray:
    """Evaluate a function for S states of the instrument, with NaN for each state whose light is lost.

    Parameters
    ----------
    work : callable
        Function of a slice of the states; raises PhysicalError if the light of any of them is lost.
    count : int
        Number S of states.
    shape : tuple of int
        Shape of the result for one state.
    first : int
        Index of the first state.
    """
    try:
        return work(slice(first, first + count))
    except PhysicalError:
        if count == 1:
            return np.full((1, *shape), np.nan)
    half = count // 2
    halves = ((half, first), (count - half, first + half))
    return np.concatenate([nan_where_lost(work, size, shape, start) for size, start in halves])


def selected_moves(further: np.ndarray | None, rows: slice) -> np.ndarray | None:
    """Return the moves of C actuators in selected states; a move (C,) common to all states is returned unchanged.

    ``further`` is (S, C) for S states, (C,) or None.
    """
    return further if further is None or further.ndim == 1 else further[rows]
