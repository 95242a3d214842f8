"""Changes of every camera from the monitor's images: centroids, all estimators, the intersection angle.

**Goodness of fit.** The fits of all spots of a measurement are tested together: whether sigma is valid, by which factor
it was increased, and why. Three causes make spots differ from the fit, and are separated by where the difference is.
Noise that differs from the data sheet is in every pixel of every frame, a changed shape in the core of a spot alone,
and a wrongly calibrated shape in the spots before as in those after.

**Linearity.** Whether the motions of a reading are small enough for a linear estimator is tested with a retraced state.
An estimator assumes a set of motions of amounts x, which shift the spots by s = A x and change the parameters by p = B
x; x = G s estimates them. Traced again, the instrument in the state x has the spots s(x) and the parameters p(x). One
Gauss-Newton step about x,

    p(x) + B (x' - x),   x' = G (s - s(x) + A x),

differs from the linear reading B G s by its non-linearity. Here x' is the estimate of the motions after the step. Where
the difference is more than `NONLINEAR_SIGMAS` standard deviations of any quantity the steps are iterated to
convergence, and the reading is p of the result (Nocedal and Wright, Numerical Optimization, 2006, sec. 10.3). The
derivatives remain those of the nominal instrument: their relative change is of the size of the motions in radians.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array, StateArrays, shows
from analysis.monitor.disturbances import Consistency, Disturbances, consistency
from analysis.monitor.estimators import PARAMETERS_PER_CAMERA, Shifts, applicable
from analysis.monitor.limits import quantities
from analysis.monitor.monitor_formulas import (
    CameraParameters,
    GroundError,
    GroundGeometry,
    IntersectionAngleChange,
    exact,
)
from analysis.monitor.parameters import CameraCalibration, MonitorCalibration
from analysis.spots import CENTROIDS
from analysis.spots.centroid import mean_frames
from analysis.spots.likelihood import FALSE_ALARM, FitStates, fit_states, require_convergence, widened
from analysis.spots.spot_image import NoiseParts, SpotPositions, difference_covariance, noise_parts
from optics.numerics.extension_table import EntryPointError

EXPLAINED = 2.0
"""Largest ratio of a spot core's chi-square per degree of freedom to the variance of the frames' noise (in units of the
specified variance) at which that noise still explains the misfit.
"""
LOUD = 1.3
"""Ratio of the noise variance of the frames to the specified one above which the noise counts as too large.

A median over an image exceeds it by chance only with a deviation of 6 sigma.
"""
NOISE, BEFORE, AFTER = "noise", "before", "shape"
"""Names of the causes of a warning that the sigmas of spot positions are not valid.

They are noise of the frames that is too large, a shape of the spots before the change that differs from the calibrated
one, and a shape after the change that alone differs.
"""


@dataclass(frozen=True)
class SpotWarning:
    """Reason why the sigmas of the spot positions are not valid for a state.

    Attributes
    ----------
    cause : str
        Cause: ``noise`` of the frames, wrong shape of the spots ``before``, or changed ``shape`` after alone.
    spots : tuple of int
        Indices of the spots that do not fit.
    widening : float
        Largest factor by which the sigma of a spot was increased.
    text : str
        Reason as a sentence without a full stop.
    """

    cause: str
    spots: tuple[int, ...]
    widening: float
    text: str


@dataclass(frozen=True, eq=False)
class SpotEvidence:
    """Goodness of fit of C spots in S states.

    Attributes
    ----------
    before : FitStates
        Fits of the nominal state, (1, C) or (S, C).
    after : FitStates
        Fits of the states, (S, C).
    """

    before: FitStates
    after: FitStates

    def at(self, states: slice) -> SpotEvidence:
        """Return the goodness of fit of the spots in selected states.

        Parameters
        ----------
        states : slice
            Range of the states to keep.
        """
        before = self.before if len(self.before.whole) == 1 else self.before.at(states)
        return SpotEvidence(before, self.after.at(states))

    @classmethod
    def joined(cls, parts: Sequence[SpotEvidence]) -> SpotEvidence:
        """Return the goodness of fit of several series of states, which share one nominal state, joined.

        Parameters
        ----------
        parts : sequence of SpotEvidence
            Goodness of fit of each series; at least one.
        """
        return cls(parts[0].before, FitStates.joined([part.after for part in parts]))

    @property
    def consistent(self) -> NDArray[np.bool_]:
        """True for states in which all spots have the assumed shape and noise, before and after, (S,).

        Dimensions: S states.
        """
        return np.asarray(np.all(self.before.fits, axis=1) & np.all(self.after.fits, axis=1))

    @property
    def widening(self) -> Array:
        """Factor of the sigma of each spot's position, the larger of before and after, (S, C).

        Dimensions: S states, C spots.
        """
        return np.asarray(np.maximum(self.before.widening, self.after.widening))

    @property
    def worst(self) -> int:
        """Index of the state whose spots fit the calibrated shape worst."""
        return int(np.argmax(np.max(self.widening, axis=1)))

    def course_doubt(self, moments: Sequence[str], names: Sequence[str]) -> str | None:
        """Return the reason why sigma is not valid at the worst of many times; None if it is valid at all of them.

        Parameters
        ----------
        moments : sequence of str
            Descriptions of the states' times.
        names : sequence of str
            Names of the spots.
        """
        warning, bad = self.doubt(self.worst, names), int(np.count_nonzero(~self.consistent))
        return None if warning is None else f"at {moments[self.worst]}, the worst of {bad} times: {warning.text}"

    def doubt(self, state: int = 0, names: Sequence[str] = ()) -> SpotWarning | None:
        """Return the reason why the sigmas of the spot positions are not valid for a state; None if they are.

        Parameters
        ----------
        state : int
            Index of the state.
        names : sequence of str
            Names of the spots; their indices if not given.
        """
        if self.consistent[state]:
            return None
        first = self.before.at(slice(0, 1) if len(self.before.whole) == 1 else slice(state, state + 1))
        last = self.after.at(slice(state, state + 1))
        off = [~fit.fits[0] for fit in (first, last)]
        spots = tuple(np.flatnonzero(off[0] | off[1]).tolist())
        worst = max((float(fit.widening[0, k]), k) for fit in (first, last) for k in spots)
        fit_state = last if off[1][worst[1]] else first
        whole, core, noise = (float(v[0, worst[1]]) for v in (fit_state.whole, fit_state.core, fit_state.noise))
        if all(_noisy(fit, k) for fit, beyond in ((first, off[0]), (last, off[1])) for k in spots if beyond[k]):
            cause = NOISE
            why = (
                f"the noise of the frames is {np.sqrt(noise):.3g} times that of the data sheet, both beside the spots "
                "and in them: another gain, read-out noise or number of bits, or light that varies"
            )
        elif np.any(off[0]):
            cause = BEFORE
            why = (
                "the spots before do not have the calibrated shape either: a camera that is blurred or aberrated "
                "otherwise than calibrated, a reflection, or stray light"
            )
        else:
            cause = AFTER
            why = (
                "the shape of the spots differs from the calibration: a motion blurs or aberrates them, or they "
                "contain a reflection or stray light, and a position on a changed spot is not that on the calibrated "
                "one"
            )
        named = ", ".join(names[k] if names else str(k) for k in spots)
        limit = float(fit_state.core_limit[0, worst[1]]), float(fit_state.whole_limit[0, worst[1]])
        size = (
            f"reduced chi-square {_number(core)} of the core (limit {limit[0]:.2f}) and {_number(whole)} of the image "
            f"(limit {limit[1]:.2f}, false-alarm rate {FALSE_ALARM:g} a fit)"
        )
        text = (
            f"σ does not hold: the fit of the spots {named} is not good, {size}; {why}. The noise of their positions "
            f"was increased up to {_number(worst[0])}-fold"
        )
        text += ", which does not cover the effect of a changed shape" if cause != NOISE else ""
        return SpotWarning(cause, spots, worst[0], text)


def _noisy(fit: FitStates, k: int) -> bool:
    """Return True if the noise of the frames explains the misfit of spot k, which is then about equal everywhere."""
    noise, whole, core = (float(v[0, k]) for v in (fit.noise, fit.whole, fit.core))
    return noise > LOUD and whole < LOUD * noise and core < EXPLAINED * noise


def _number(value: float) -> str:
    return f"{value:.3g}" if value < 1e3 else f"{value:.0f}"


NONLINEAR_SIGMAS = 3.0
"""Error of a linear reading, in sigmas of a quantity, above which the reading is iterated."""
_REST = 1e-2
"""Largest change of a quantity by the last iteration step, in sigmas, for the iteration to count as converged."""
_MOST_STEPS = 20


@dataclass(frozen=True, eq=False)
class Retraced:
    """Exact spot shifts and camera changes in S states of the instrument, from a ray trace.

    Dimensions: D spot coordinates (row and column of every spot), K cameras.

    Attributes
    ----------
    spots : (S, D) ndarray
        Shifts, px; NaN in a state whose light is lost.
    parameters : (S, 4 K) ndarray
        Changes, rad and m; NaN in a state whose light is lost.
    """

    spots: Array
    parameters: Array


@dataclass(frozen=True, eq=False)
class MotionModel:
    """Motions assumed by an estimator, with their linear effects and a ray trace of their exact ones.

    Dimensions: D spot coordinates (row and column of every spot), P motions, K cameras.

    Attributes
    ----------
    spots : (D, P) ndarray
        Shifts A, px per unit of each motion.
    parameters : (4 K, P) ndarray
        Changes B, rad and m per unit of each motion.
    amounts : callable
        Function from the covariance of the shifts (S, D, D), px^2, to the gain G (S, P, D) by which the motions are
        estimated from the shifts, in units of the motions per px.
    states : callable
        Function from the amounts of the motions (S, P) to the states of the instrument, for `trace`.
    trace : callable
        Function from S states to their exact effects. Models that share one are traced together.
    near_px : float
        Shift of the spots up to which a state counts as linear and is not traced, px.
    """

    spots: Array
    parameters: Array
    amounts: Callable[[Array], Array]
    states: Callable[[Array], Sequence[Any]]
    trace: Callable[[Sequence[Any]], Retraced]
    near_px: float = 0.0


@dataclass(frozen=True, eq=False)
class Curvature(StateArrays):
    """Test whether the linear readings of an estimator are accurate, by a ray trace of the S estimated states.

    Dimensions: Q quantities.

    Attributes
    ----------
    off : (S, Q) ndarray
        Error of the linear reading of each quantity, sigmas; NaN where the state cannot be traced.
    beyond : (S,) ndarray of bool
        True where the error is too large, so that the result of the iteration replaces the linear reading.
    rests : (S,) ndarray of bool
        True where the iteration converged, or none was needed.
    """

    off: Array
    beyond: NDArray[np.bool_]
    rests: NDArray[np.bool_]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True where the readings are valid, because they are linear or because the iteration converged, (S,).

        Dimensions: S states.
        """
        return self.rests

    def worst(self, state: int = 0) -> tuple[int, float]:
        """Return the index of the quantity whose linear reading has the largest error, and this error in sigmas."""
        size = np.abs(self.off[state])
        if not np.any(np.isfinite(size)):
            return 0, np.inf
        worst = int(np.nanargmax(size))
        return worst, float(size[worst])


@dataclass(frozen=True, eq=False)
class LinearReading:
    """Results of an estimator in S states by its linear gain, with the motions it assumes.

    Dimensions: K cameras.

    Attributes
    ----------
    values : (S, 4 K) ndarray
        Readings, rad and m.
    total : (S, 4 K, 4 K) ndarray
        Covariance of their errors.
    model : MotionModel
        Motions that the estimator assumes.
    """

    values: Array
    total: Array
    model: MotionModel


def read_again(
    readings: Mapping[str, LinearReading], shift: Array, noise: Array, rows: Array
) -> dict[str, tuple[Array, Curvature]]:
    """Return each estimator's readings (S, 4 K), iterated where they are not linear, and the tests of linearity.

    Dimensions: S states, K cameras, D spot coordinates (row and column of every spot), Q quantities.

    Parameters
    ----------
    readings : mapping of str to LinearReading
        Linear readings of each estimator.
    shift : (S, D) ndarray
        Measured spot shifts, px.
    noise : (S, D, D) ndarray
        Covariance of the spot shifts due to noise, px^2.
    rows : (Q, 4 K) ndarray
        Coefficients of the quantities that are tested.
    """
    steps = {title: _Steps.of(reading, shift, noise, rows) for title, reading in readings.items()}
    traced = _traced_together({title: (step.model, step.x[step.far]) for title, step in steps.items()})
    return {title: step.judged(readings[title].values, traced[title]) for title, step in steps.items()}


def _traced_together(wanted: Mapping[str, tuple[MotionModel, Array]]) -> dict[str, Retraced]:
    """Return the exact effects of the amounts (S, P) of each model; models with the same trace are traced together.

    Dimensions: S states, P motions.
    """
    groups: dict[int, list[str]] = {}
    for title, (model, _) in wanted.items():
        groups.setdefault(id(model.trace), []).append(title)
    out: dict[str, Retraced] = {}
    for titles in groups.values():
        states = [state for title in titles for state in wanted[title][0].states(wanted[title][1])]
        model = wanted[titles[0]][0]
        nothing = Retraced(np.empty((0, len(model.spots))), np.empty((0, len(model.parameters))))
        traced, end = model.trace(states) if states else nothing, 0
        for title in titles:
            part = slice(end, end + len(wanted[title][1]))
            out[title], end = Retraced(traced.spots[part], traced.parameters[part]), part.stop
    return out


@dataclass(frozen=True, eq=False)
class _Steps:
    """Gauss-Newton iteration of an estimator's readings in S states.

    Dimensions: D spot coordinates (row and column of every spot), P motions, Q quantities, K cameras.

    Attributes
    ----------
    model : MotionModel
        Motions of the estimator.
    shift : (S, D) ndarray
        Measured spot shifts, px.
    gain : (S, P, D) ndarray
        Gain G of the motions, their units per px.
    x : (S, P) ndarray
        Motions of the readings.
    sigma : (S, Q) ndarray
        Standard deviations of the quantities.
    rows : (Q, 4 K) ndarray
        Coefficients of the quantities.
    far : ndarray of int
        Indices of the states that are traced.
    """

    model: MotionModel
    shift: Array
    gain: Array
    x: Array
    sigma: Array
    rows: Array
    far: NDArray[np.intp]

    @classmethod
    def of(cls, reading: LinearReading, shift: Array, noise: Array, rows: Array) -> _Steps:
        gain = reading.model.amounts(noise)
        sigma = np.sqrt(np.maximum(np.einsum("qi,sij,qj->sq", rows, reading.total, rows), 0.0))
        far = np.flatnonzero(np.any(np.abs(shift) > reading.model.near_px, axis=1))
        return cls(reading.model, shift, gain, np.einsum("spd,sd->sp", gain, shift), sigma, rows, far)

    def in_sigmas(self, change: Array, states: slice | NDArray[np.intp]) -> Array:
        moved = np.abs(change @ self.rows.T)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(moved == 0.0, 0.0, moved / self.sigma[states])

    def step(self, x: Array, retraced: Retraced, states: slice | NDArray[np.intp]) -> Array:
        rest = self.shift[states] - retraced.spots + x @ self.model.spots.T
        return np.asarray(np.einsum("spd,sd->sp", self.gain[states], rest))

    def judged(self, values: Array, traced: Retraced) -> tuple[Array, Curvature]:
        """Return the readings (S, 4 K), iterated where they are not linear, and the test of linearity.

        Dimensions: S states, K cameras.
        """
        model, x, everything = self.model, self.x, slice(None)
        exact = Retraced(x @ model.spots.T, x @ model.parameters.T)
        exact.spots[self.far], exact.parameters[self.far] = traced.spots, traced.parameters
        # the two are one number where everything is linear
        curved = exact.parameters + (self.step(x, exact, everything) - x) @ model.parameters.T - x @ model.parameters.T
        off = self.in_sigmas(curved, everything)
        beyond = ~np.all(off <= NONLINEAR_SIGMAS, axis=1)
        out, rests = values.copy(), ~beyond
        left = np.flatnonzero(beyond & np.all(np.isfinite(off), axis=1))
        x, last = x[left], Retraced(exact.spots[left], exact.parameters[left])
        for _ in range(_MOST_STEPS):
            if not len(left):
                break
            x = self.step(x, last, left)
            now = model.trace(model.states(x))
            change = self.in_sigmas(now.parameters - last.parameters, left)
            done = np.all(change <= _REST, axis=1)
            out[left[done]], rests[left[done]] = now.parameters[done], True
            on = ~done & np.all(np.isfinite(change), axis=1)
            left, x, last = left[on], x[on], Retraced(now.spots[on], now.parameters[on])
        return out, Curvature(off, beyond, rests)


MeasuredSpots: TypeAlias = tuple[SpotPositions, FitStates]
"""Measured spot positions together with the goodness of their fits."""


@shows()
@dataclass(frozen=True, eq=False)
class Estimates:
    """Results of all estimators from spot positions, for S states.

    Attributes
    ----------
    parameters : mapping of str to mapping of str to CameraParameters
        Changes by camera and estimator, arrays (S,).
    angle : mapping of str to IntersectionAngleChange
        Change of the intersection angle by estimator, arrays (S,); empty unless there are two cameras.
    ground : mapping of str to GroundError
        Errors on the ground by estimator, arrays (S,); empty unless the altitude of a pair is known.
    curvature : mapping of str to Curvature
        Tests of linearity by estimator, of those that were traced again.
    """

    parameters: Mapping[str, Mapping[str, CameraParameters]]
    angle: Mapping[str, IntersectionAngleChange]
    ground: Mapping[str, GroundError]
    curvature: Mapping[str, Curvature] = field(default_factory=dict)


@shows("parameters", "before [px]", "after [px]", "sigma_after [px]")
@dataclass(frozen=True, eq=False)
class Recovery(StateArrays):
    """Results of the monitor's images of C spots for S states.

    Attributes
    ----------
    before, after : (S, C, 2) ndarray
        Spot positions (row, column), px.
    sigma_before, sigma_after : (S, C, 2) ndarray
        Standard deviations of the positions, px.
    shift_covariance : (S, 2 C, 2 C) ndarray
        Covariance of `shift`, px^2; spots are independent of each other.
    parameters : mapping of str to mapping of str to CameraParameters
        Changes by camera and estimator, arrays (S,).
    angle : mapping of str to IntersectionAngleChange
        Change of the intersection angle by estimator, arrays (S,); empty unless there are two cameras.
    ground : mapping of str to GroundError
        Errors on the ground by estimator, arrays (S,); empty unless the altitude of a pair is known.
    parts : tuple of NoiseParts or None
        Noise of the positions before (C spots) and after (S C), for series of measurements; None unless kept.
    evidence : SpotEvidence or None
        Goodness of the fits of the spots; None where they were not tested.
    curvature : mapping of str to Curvature
        Tests of linearity by estimator, of those that were traced again.
    """

    before: Array
    after: Array
    sigma_before: Array
    sigma_after: Array
    shift_covariance: Array
    parameters: Mapping[str, Mapping[str, CameraParameters]]
    angle: Mapping[str, IntersectionAngleChange]
    ground: Mapping[str, GroundError] = field(default_factory=dict)
    parts: tuple[NoiseParts, NoiseParts] | None = None
    evidence: SpotEvidence | None = None
    curvature: Mapping[str, Curvature] = field(default_factory=dict)

    def at(self, states: slice) -> Recovery:
        """Return the results of selected states, without ``parts``.

        Parameters
        ----------
        states : slice
            Range of the states to keep.
        """
        return StateArrays.at(replace(self, parts=None), states)

    @property
    def shift(self) -> Array:
        """Shifts after - before in the order of the spots, row and column, (S, 2 C) px.

        Dimensions: S states, C spots.
        """
        return (self.after - self.before).reshape(len(self.after), -1)

    def consistency(
        self, disturbances: Disturbances, state: int = 0, others: Mapping[str, Array] | None = None
    ) -> Consistency:
        """Test the shifts of one state against a prior.

        Parameters
        ----------
        disturbances : Disturbances
            Prior of the disturbances (motions of bodies), with their effects on spots and parameters.
        state : int
            Index of the state.
        others : mapping of str to ndarray, or None
            Further bodies that the prior does not contain, with the spot shifts of their motions, px; they are tested
            as causes of a contradiction.
        """
        return consistency(self.shift[state], self.shift_covariance[state], disturbances, others)


def measure_spots(
    mean: Array, frames: int, calibration: MonitorCalibration, centroid: str = "ml", threads: int = 1
) -> SpotPositions:
    """Measure the position of every spot in mean frames (B, H, W), in the order of the calibration.

    B is the number of images, a multiple of the number of spots; H and W are their rows and columns.

    Parameters
    ----------
    mean : (B, H, W) ndarray
        Mean frames, grey values.
    frames : int
        Number of frames averaged into each image.
    calibration : MonitorCalibration
        Calibration of the nominal instrument.
    centroid : str
        Name of a method of `analysis.spots.CENTROIDS`.
    threads : int
        Number of threads for the fits; results do not depend on it.

    Raises
    ------
    SpotError
        A spot cannot be measured, or its fit does not converge.
    EntryPointError
        The method of another distribution returns positions without `gain_maps` and `light_dn`.
    """
    if centroid not in CENTROIDS:
        raise ValueError(f"recovery: no centroid {centroid!r}; there are {', '.join(CENTROIDS)}")
    positions = CENTROIDS[centroid].measure(mean, frames, calibration.noise, calibration.template, threads)
    if positions.gain_maps is None or positions.light_dn is None:
        raise EntryPointError(
            f"the centroid {centroid!r} returns positions without gain_maps or light_dn, from which the covariances of "
            "all readings follow; its method has to return both"
        )
    return require_convergence(positions)


def judged_spots(
    mean: Array, frames: int, calibration: MonitorCalibration, centroid: str = "ml", threads: int = 1
) -> tuple[SpotPositions, FitStates]:
    """Measure spots, and increase their sigmas where the fits are worse than the noise explains.

    The tests of the fits are returned as well, (B / C, C) for B images of C spots.

    Dimensions: H rows, W columns.

    Parameters
    ----------
    mean : (B, H, W) ndarray
        Mean frames, grey values.
    frames : int
        Number of frames averaged into each image.
    calibration : MonitorCalibration
        Calibration of the nominal instrument.
    centroid : str
        Method: `ml`, `gaussian` or `energy`.
    threads : int
        Number of threads for the fits.
    """
    positions = measure_spots(mean, frames, calibration, centroid, threads)
    states = fit_states(positions)
    return widened(positions, states.widening), states.reshaped(calibration.template.count)


def recover_monitor(
    before: NDArray[Any] | MeasuredSpots,
    after: NDArray[Any],
    calibration: MonitorCalibration,
    centroid: str = "ml",
    threads: int = 1,
    disturbances: Disturbances | None = None,
    keep_parts: bool = False,
    motions: Mapping[str, MotionModel] | None = None,
    frames: int | None = None,
) -> Recovery:
    """Recover the changes of all cameras from frames of the monitor's spots before and after, with their covariance.

    Dimensions: H rows, W columns.

    Parameters
    ----------
    before : ndarray or MeasuredSpots
        Grey values of the nominal state, (C, frames, H, W) or (S, C, frames, H, W) for C spots, or a result of
        `judged_spots` on them.
    after : (S, C, frames, H, W) ndarray
        Grey values of S states to be measured.
    calibration : MonitorCalibration
        Calibration of the nominal instrument, with C spots.
    centroid : str
        Method of the spot positions: "ml", "gaussian" or "energy".
    threads : int
        Number of threads for the fits; results do not depend on it.
    disturbances : Disturbances, optional
        Prior on the motions. Without it there is no estimator `posterior`, and all standard deviations are those of the
        noise alone.
    keep_parts : bool
        True to keep the noise of every spot, which is large, for series of measurements.
    motions : mapping of str to MotionModel, optional
        For each estimator, the motions that are traced again to test whether its reading is linear.
    frames : int, optional
        Number of frames averaged into each image, for images (C, H, W) and (S, C, H, W); None if these are frames.

    Returns
    -------
    Recovery
        Spot positions `before` and `after` (S, C, 2); `parameters` maps camera and estimator to the changes d_alpha,
        d_beta, d_gamma (radians) and d_f (metres), arrays (S,), with covariances; `angle` the change of the
        intersection angle of two cameras.

    Raises
    ------
    ValueError
        Numbers of spots that do not match, an unknown centroid, or spots that cannot be measured.

    Notes
    -----
    Wang et al., Acta Photonica Sinica 47(10) 1012001 (2018); `analysis.monitor.monitor_formulas` has the equations and
    their corrections.

    Examples
    --------
    Frames of the two spots of a camera before and after both spots have moved by 0.4 columns:

    >>> import numpy as np
    >>> import analysis
    >>> geometry = analysis.MonitorGeometry(principal_distance_m=2.0, separation_m=0.2, pitch_m=10e-6)
    >>> row, column = np.mgrid[:65, :65] - 32
    >>> spot = lambda shift: np.exp(-0.5 * (row**2 + (column - shift) ** 2) / 2.0**2)
    >>> shape = analysis.SpotTemplate.from_image(spot(0.0), row=32, column=32, shape=(33, 33))
    >>> calibration = analysis.MonitorCalibration(
    ...     {"nadir": analysis.CameraCalibration.from_geometry(geometry)},
    ...     analysis.SpotTemplate.stack([shape, shape]),
    ...     analysis.NoiseModel(gain_dn_per_e=0.1, dark_noise_e=20, offset_dn=200),
    ... )
    >>> rng = np.random.default_rng(11)
    >>> def frames(shift):
    ...     electrons = rng.poisson(20000 * spot(shift)[16:49, 16:49], (2, 9, 33, 33))
    ...     return np.rint(200 + 0.1 * (electrons + 20 * rng.standard_normal(electrons.shape))).astype(int)
    >>> found = analysis.recover_monitor(frames(0.0), frames(0.4)[None], calibration)
    >>> changes = found.parameters["nadir"]["derived"]
    >>> round(float(changes.d_alpha_rad[0]) * 1e6, 2), round(float(changes.sigma[0, 0]) * 1e6, 3)
    (-1.0, 0.003)

    A shift of 0.4 px means a rotation of -1.0 urad about Y, 2.5 urad for one pixel.
    """
    spots = after.shape[1]
    axis = -4 if frames is None else -3
    if spots != calibration.spots or (isinstance(before, np.ndarray) and before.shape[axis] != spots):
        raise ValueError(f"recovery: the calibration has {calibration.spots} spots, the images {spots}")

    def judged(images: NDArray[Any]) -> MeasuredSpots:
        mean, count = (mean_frames(images), images.shape[-3]) if frames is None else (np.asarray(images, float), frames)
        return judged_spots(_flat(mean), count, calibration, centroid, threads)

    first, fits = judged(before) if isinstance(before, np.ndarray) else before
    second, more = judged(after)
    spread = difference_covariance(first, second, calibration.noise)
    evidence = SpotEvidence(fits, more)
    return recovery_of(first, second, spread, calibration, disturbances, keep_parts, evidence, motions)


def recovery_of(
    first: SpotPositions,
    second: SpotPositions,
    covariance: Array,
    calibration: MonitorCalibration,
    disturbances: Disturbances | None = None,
    keep_parts: bool = False,
    evidence: SpotEvidence | None = None,
    motions: Mapping[str, MotionModel] | None = None,
) -> Recovery:
    """Return the changes of all cameras from spots that have been measured already.

    Parameters
    ----------
    first : SpotPositions
        Positions of C spots in the nominal state, or of C spots in S nominal states, with their derivatives with
        respect to every pixel.
    second : SpotPositions
        Positions of C spots in each of S states to be measured, state by state, with their derivatives with respect to
        every pixel.
    covariance : (S C, 2, 2) ndarray
        Covariance of their differences, px^2.
    calibration : MonitorCalibration
        Calibration of the nominal instrument with C spots.
    disturbances : Disturbances or None
        Prior of the disturbances; without it there is no estimator `posterior`.
    keep_parts : bool
        True to keep the noise of every spot, which is large.
    evidence : SpotEvidence or None
        Goodness of the fits; the positions are those of `judged_spots`.
    motions : mapping of str to MotionModel, or None
        For each estimator, the motions that are traced again to test whether its reading is linear.
    """
    spots = calibration.spots
    states = second.row.size // spots
    spread = joint(covariance.reshape(states, spots, 2, 2))
    start = np.broadcast_to(first.position.reshape(-1, spots, 2), (states, spots, 2))
    end = second.position.reshape(states, spots, 2)
    results = estimates(start, end, spread, calibration.cameras, disturbances, calibration.ground, motions)
    return Recovery(
        before=start,
        after=end,
        sigma_before=np.broadcast_to(_sigma(first).reshape(-1, spots, 2), (states, spots, 2)),
        sigma_after=_sigma(second).reshape(states, spots, 2),
        shift_covariance=spread,
        parameters=results.parameters,
        angle=results.angle,
        ground=results.ground,
        parts=(noise_parts(first, calibration.noise), noise_parts(second, calibration.noise)) if keep_parts else None,
        evidence=evidence,
        curvature=results.curvature,
    )


def estimates(
    start: Array,
    end: Array,
    covariance: Array,
    cameras: Mapping[str, CameraCalibration],
    disturbances: Disturbances | None = None,
    ground: GroundGeometry | None = None,
    motions: Mapping[str, MotionModel] | None = None,
) -> Estimates:
    """Apply all estimators to spot positions.

    Dimensions: S states, C spots.

    Parameters
    ----------
    start : (S, C, 2) ndarray
        Spot positions (row, column) before, px, one camera's after the other's.
    end : (S, C, 2) ndarray
        Spot positions after, px.
    covariance : (S, 2 C, 2 C) ndarray
        Covariance of after - before, px^2; all zero for positions without noise.
    cameras : mapping of str to CameraCalibration
        Calibration of each camera.
    disturbances : Disturbances or None
        Prior of the disturbances; None if there is none.
    ground : GroundGeometry or None
        Ground geometry of a pair whose altitude is known.
    motions : mapping of str to MotionModel, or None
        For each estimator, the motions that are traced again to test whether its reading is linear.
    """
    shifts = Shifts(start, end, covariance, cameras, disturbances)
    by_title: dict[str, tuple[Array, Array, Array | None]] = {}
    curvature: dict[str, Curvature] = {}
    readings: dict[str, LinearReading] = {}
    for title, estimator in applicable(cameras, disturbances).items():
        gain, values = estimator.gain(shifts), estimator.read(shifts)
        noise = gain @ shifts.covariance @ np.swapaxes(gain, -1, -2)
        total = None if disturbances is None else noise + disturbances.misfit(gain)
        if motions is not None and title in motions:
            readings[title] = LinearReading(values, noise if total is None else total, motions[title])
        by_title[title] = values, noise, total
    if readings:
        rows = np.stack([quantity.row for quantity in quantities(cameras, ground)])
        for title, (values, by_curvature) in read_again(readings, shifts.vector, shifts.covariance, rows).items():
            by_title[title], curvature[title] = (values, *by_title[title][1:]), by_curvature
    return replace(estimates_of(by_title, cameras, ground), curvature=curvature)


def estimates_of(
    by_title: Mapping[str, tuple[Array, Array, Array | None]],
    cameras: Mapping[str, CameraCalibration],
    ground: GroundGeometry | None = None,
) -> Estimates:
    """Return the results that follow from changes of all cameras: of each camera, of their angle, on the ground.

    Dimensions: S states, K cameras.

    Parameters
    ----------
    by_title : mapping of str to tuple of ndarrays
        For each estimator, changes (S, 4 K) and their covariances (S, 4 K, 4 K) due to noise and of the total error;
        None instead of the total one without a prior.
    cameras : mapping of str to CameraCalibration
        Calibration of each camera.
    ground : GroundGeometry or None
        Ground geometry of a pair whose altitude is known.
    """
    parameters: dict[str, dict[str, CameraParameters]] = {name: {} for name in cameras}
    angle: dict[str, IntersectionAngleChange] = {}
    errors: dict[str, GroundError] = {}
    slices = [slice(PARAMETERS_PER_CAMERA * k, PARAMETERS_PER_CAMERA * (k + 1)) for k in range(len(cameras))]
    for title, (values, noise, total) in by_title.items():
        for name, part in zip(cameras, slices, strict=True):
            whole = None if total is None else total[..., part, part]
            parameters[name][title] = CameraParameters.from_vector(values[..., part], noise[..., part, part], whole)
        if len(cameras) == 2:
            # the camera that looks farther forward comes first
            first_camera, second_camera = sorted(cameras, key=lambda name: -cameras[name].look_rad)
            first, second = (slices[list(cameras).index(name)] for name in (first_camera, second_camera))
            across = noise[..., first, second], None if total is None else total[..., first, second]
            looks = cameras[first_camera].look_rad, cameras[second_camera].look_rad
            both = parameters[first_camera][title], parameters[second_camera][title]
            angle[title] = exact(*both, *looks, *across)
            if ground is not None:
                distances = [camera.geometry.principal_distance_m for camera in cameras.values()]
                f = (distances[0], distances[1])
                errors[title] = ground.error(values, noise, noise if total is None else total, f)
    return Estimates(parameters, angle, errors)


def joint(covariance: Array) -> Array:
    """Return the joint covariance (S, 2 C, 2 C) of C independent spots from their covariances (S, C, 2, 2).

    Dimensions: S states.

    Parameters
    ----------
    covariance : (S, C, 2, 2) ndarray
        Covariance of row and column of each spot, px^2.
    """
    states, spots = covariance.shape[:2]
    out = np.zeros((states, spots, 2, spots, 2))
    for i in range(spots):
        out[:, i, :, i] = covariance[:, i]
    return out.reshape(states, 2 * spots, 2 * spots)


def _flat(mean: Array) -> Array:
    return mean.reshape(-1, *mean.shape[-2:])


def _sigma(positions: SpotPositions) -> Array:
    return np.stack([positions.sigma_row, positions.sigma_column], axis=-1)
