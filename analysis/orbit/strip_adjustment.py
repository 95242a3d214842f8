"""Adjustment of the measured attitude and station within one pass, without ground control (paper 003's check flow).

Points that several lines see (tie points, with the check points among them) tie the attitudes of different exposures
together: rays that do not meet show errors of the attitude. Unknowns are the errors of the readings, with their given
sigmas as priors, and the points; cameras and attitude bias come from a calibration.

What no tie point can tell is the datum. With lines that look forward and aft by a, which see a place T seconds before
and after the nadir line, all rays still meet when

- the whole pass rolls: the scene shifts with it;
- it rolls at a constant rate and is yawed by rate * T / tan a: the scene turns with it;
- roll repeats itself with the period T: all three lines see a place with one roll.

Pitch shifts nadir rays by tan^2 a (0.22 at 25 deg) less than outer ones, so it is told that weakly. What all rays of a
place have in common thus keeps its prior error: the priors alone close it, and `StripAdjustment.datum` says how much
the ties added. It also bounds the gain. Forward intersection takes the mean over three exposures anyway, and noise that
is independent from one reading to the next has its largest part in this mean: ties hardly reduce it. Errors that last
for many readings and change within the pass are reduced a lot.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.linalg import splu
from scipy.stats import chi2

from analysis.orbit.calibration_parameters import CalibrationError, CalibrationField, Noise, Parameters
from analysis.orbit.forward_intersection import intersect
from analysis.orbit.normal_equations import Equations, State, Weights, assemble
from analysis.orbit.residual_tests import Robust, robust_weights, standardised
from analysis.orbit.shared_noise import Series, SharedNoise
from analysis.orbit.three_line_model import BIAS, LineModel, Rays, bias_rotation

__all__ = ["Correction", "Datum", "StripAdjustment", "adjust_strip"]

Array = NDArray[np.float64]
_NAME = "strip"
_STEPS = 10
_CONVERGED = 1e-6  # metres, as in forward intersection
_ROUNDS = 30
_HUBER_ROUNDS = 6
# From then on weights only fall: two rays of a point that are doubted in turns would never come to rest.
_FREE_ROUNDS = 12
_SETTLED = 1e-3


@dataclass(frozen=True, eq=False)
class Correction:
    """Adjusted errors of the readings of one term of the noise.

    Attributes:
        group: "attitude", "slow attitude" or "station".
        time: (r,) of the readings near the rays, seconds.
        value: (r, 3) to be added to the measured one: rotation vector about the body axes, radians (true = measured *
            R(value)), or metres in ITRS.
        sigma: (r, 3) of what is left.
    """

    group: str
    time: Array
    value: Array
    sigma: Array


@dataclass(frozen=True)
class Datum:
    """How well a turn that the whole pass has in common is known: sigma before and after the adjustment.

    name: "roll", "pitch", "yaw" (radians, at the middle of the pass) or "roll rate" and so on (rad/s).
    """

    name: str
    before: float
    after: float


@dataclass(frozen=True, eq=False)
class StripAdjustment:
    """Solution of a pass.

    Attributes:
        ground: (m, 3) points, ITRS, metres; NaN where fewer than two good rays see one. covariance: (m, 3, 3), with the
            errors of attitude and station that are left.
        corrections: by group.
        datum: common turns and their rates, from all rays.
        residual: line -> (n, 2) standardised residuals. weight: line -> (n,) robust. NaN and 0 for rays of points that
            no other line sees.
        chi_square, degrees_of_freedom: weighted, rays left out do not count.
    """

    ground: Array
    covariance: Array
    corrections: Mapping[str, Correction]
    datum: tuple[Datum, ...]
    residual: Mapping[str, Array]
    weight: Mapping[str, Array]
    chi_square: float
    degrees_of_freedom: int
    _shared: SharedNoise = field(repr=False)
    _values: Array = field(repr=False)
    _turn: Array = field(repr=False)

    @property
    def p_value(self) -> float:
        """Chance of such a chi-square or a larger one, if the sigmas are right and no robust weights are on."""
        return float(chi2.sf(self.chi_square, self.degrees_of_freedom))

    def corrected(self, rays: Rays) -> Rays:
        """Any rays of the pass, with times, with corrected attitude and station.

        Raises:
            CalibrationError: no times.
        """
        if rays.time is None:
            raise CalibrationError("strip adjustment: these rays have no times")
        found = self._shared.corrected_at(_NAME, replace(rays, attitude=rays.attitude @ self._turn), self._values)
        return replace(found, attitude=found.attitude @ self._turn.T)


def adjust_strip(
    rays: Mapping[str, Rays],
    cameras: Mapping[str, LineModel],
    noise: Noise,
    *,
    bias: ArrayLike = (0.0, 0.0, 0.0),
    offset: ArrayLike = (0.0, 0.0, 0.0),
    count: int | None = None,
    robust: Robust | None = None,
) -> StripAdjustment:
    """Adjust one pass on its tie points.

    Time goes with the number of points, memory with the square of that of readings near rays: 800 readings of the
    attitude take 50 MB.

    Args:
        rays: line -> its image points, with times.
        cameras: line -> calibrated camera, in its state during this pass.
        noise: of image, attitude and station, with at least one interval.
        bias: (3,) calibrated roll, pitch, yaw, radians.
        offset: (3,) of the station, ITRS, metres.
        count: of points; from the rays where not given.
        robust: "huber" takes weight from image points with large residuals, "igg" leaves the worst out. Three
            rays often cannot tell which of them is wrong: then the point is given up.

    Raises:
        CalibrationError: rays without times or a noise without intervals, no point with two rays, no convergence.
    """
    noise.check()
    if robust not in (None, "huber", "igg"):
        raise CalibrationError(f"strip adjustment: robust must be huber or igg, found {robust!r}")
    if any(r.time is None for r in rays.values()) or all(t.interval is None for t in noise.terms):
        raise CalibrationError("strip adjustment: needs the times of all rays and the intervals of the readings")
    first = intersect(rays, cameras, noise, bias=bias, offset=offset, count=count)
    good = np.flatnonzero(first.rays >= 2)
    place = np.full(len(first.rays), -1)
    place[good] = np.arange(len(good))
    turn, shift = bias_rotation(bias), np.asarray(offset, np.float64)
    kept = {}
    for line, row in rays.items():
        some = row.taken(place[row.point] >= 0)
        if some.point.size:
            attitude, station = some.attitude @ turn, some.station + shift
            kept[line] = replace(some, point=place[some.point], attitude=attitude, station=station)
    size = len(good)
    one = CalibrationField(_NAME, kept, first.ground[good], np.zeros((size, 3, 3)), np.zeros(size, bool))
    shared = SharedNoise.of([one], noise)
    state, equations, weights, lost = _solved(one, cameras, noise, shared, robust)
    none = np.zeros((0, 0))
    ground, covariance = np.full((len(place), 3), np.nan), np.full((len(place), 3, 3), np.nan)
    sound = good[~lost]
    ground[sound], covariance[sound] = state.grounds[0][~lost], equations.point_covariance(none)[~lost]
    standard = standardised(equations, equations.image_cofactors(none), weights)
    residual = {k: np.full((len(r.point), 2), np.nan) for k, r in rays.items()}
    weight = {k: np.zeros(len(r.point)) for k, r in rays.items()}
    cuts = np.cumsum([len(r.point) for r in kept.values()])[:-1]
    for line, v, w in zip(kept, np.split(standard, cuts), np.split(weights.image, cuts), strict=True):
        where = place[rays[line].point] >= 0
        residual[line][where], weight[line][where] = v, w
    left = equations.residuals
    return StripAdjustment(
        ground=ground,
        covariance=covariance,
        corrections={
            s.term.group: _correction(s, state.shared, equations.shared_inverse[0], turn) for s in shared.series[_NAME]
        },
        datum=_datum(kept, shared, equations.shared_inverse[0]),
        residual=residual,
        weight=weight,
        chi_square=float(np.sum(weights.image * np.sum(left.image**2, axis=1)) + sum(left.shared.values())),
        degrees_of_freedom=2 * int(np.sum(weights.image > 0)) - 3 * len(sound),
        _shared=shared,
        _values=state.shared,
        _turn=turn,
    )


def _solved(
    one: CalibrationField, cameras: Mapping[str, LineModel], noise: Noise, shared: SharedNoise, robust: Robust | None
) -> tuple[State, Equations, Weights, NDArray[np.bool_]]:
    """Readings and points, with robust weights iterated around, and which points (m,) lost their rays by that."""
    place = np.concatenate([r.point for r in one.rays.values()])
    lost = np.zeros(len(one.ground), bool)
    nothing = np.array([-1])
    held = (nothing, nothing, nothing, nothing, nothing)
    parameters = Parameters((), np.zeros(0), np.zeros(0), {(_NAME, k): held for k in one.rays})
    state = State(np.zeros(0), (one.ground,), np.zeros(shared.size))
    factor = dict.fromkeys(("image", "control", *shared.groups), 1.0)
    weights = Weights(np.ones(sum(len(r.point) for r in one.rays.values())), factor)
    for turn in range(_ROUNDS):
        equations = assemble([one], cameras, parameters, state, noise, (), weights, shared)
        for _ in range(_STEPS):
            before, state = state, state.moved(equations, np.zeros(0))
            equations = assemble([one], cameras, parameters, state, noise, (), weights, shared)
            step = float(np.abs(state.grounds[0] - before.grounds[0]).max())
            if step < _CONVERGED:
                break
        else:
            raise CalibrationError(f"strip adjustment: no convergence, the last step is {step:.3g} m")
        if robust is None:
            return state, equations, weights, lost
        kind: Robust = "huber" if turn < _HUBER_ROUNDS else robust
        cofactors = equations.image_cofactors(np.zeros((0, 0)))
        image = np.where(lost[place], 0.0, robust_weights(standardised(equations, cofactors, weights), kind))
        if turn >= _FREE_ROUNDS:
            image = np.minimum(image, weights.image)
        if turn > _HUBER_ROUNDS and float(np.abs(image - weights.image).max()) < _SETTLED:
            return state, equations, weights, lost
        lost |= np.bincount(place, image > 0, len(lost)) < 2
        if np.any(lost):
            # kept loosely where they are, for their blocks must have an inverse; no image point sees them any more
            one = replace(one, control=lost, covariance=np.where(lost[:, None, None], np.eye(3), 0.0))
            state = State(state.values, (np.where(lost[:, None], one.ground, state.grounds[0]),), state.shared)
        weights = Weights(np.where(lost[place], 0.0, image), factor)
    raise CalibrationError(f"strip adjustment: weights do not settle in {_ROUNDS} rounds")


def _correction(series: Series, values: Array, inverse: Array, turn: Array) -> Correction:
    time, by_z = series.at_readings()
    span = slice(series.column, series.column + series.size)
    z, spread = values[span].reshape(-1, 3), inverse[span, span]
    sigma = np.stack(
        [np.sqrt(np.asarray(by_z.multiply(by_z @ spread[a::3, a::3]).sum(axis=1))).ravel() for a in range(3)], axis=-1
    )
    value = np.asarray(by_z @ z)
    # about the axes of the measured attitude, before the bias
    return Correction(series.term.group, time, value @ turn.T if series.term.kind == "attitude" else value, sigma)


def _datum(rays: Mapping[str, Rays], shared: SharedNoise, inverse: Array) -> tuple[Datum, ...]:
    """Constant and slope of the attitude's errors over all rays, by least squares."""
    series = [s for s in shared.series[_NAME] if s.term.kind == "attitude"]
    if not series:
        return ()
    time = np.concatenate([r.time for r in rays.values() if r.time is not None])
    fit = np.linalg.pinv(np.column_stack([np.ones_like(time), time - time.mean()]))
    parts = np.split(fit, np.cumsum([len(r.point) for r in rays.values()])[:-1], axis=1)
    form = np.zeros((6, shared.size))
    for line, part in zip(rays, parts, strict=True):
        for s in series:
            columns, blend = s.columns(line), s.term.sigma * s.blends[line]
            for k in range(6):  # roll, pitch, yaw, then their rates
                np.add.at(form[k], columns[:, :, k % 3], part[k // 3][:, None] * blend)
    before = np.einsum("ks,sk->k", form, splu(shared.precision.tocsc()).solve(form.T))
    after = np.einsum("ks,st,kt->k", form, inverse, form, optimize=True)
    names = (*BIAS, *(f"{n} rate" for n in BIAS))
    return tuple(Datum(n, float(b), float(a)) for n, b, a in zip(names, np.sqrt(before), np.sqrt(after), strict=True))
