"""Adjustment of the measured attitude and station within one pass, without ground control (paper 003's check flow).

Points that several lines see (tie points, with the check points among them) tie the attitudes of different exposures
together: rays that do not meet show errors of the attitude. Unknowns are the errors of the readings, with their given
sigmas as priors, and the points; cameras and attitude bias come from a calibration.

What no tie point can tell is the datum. With lines that look forward and backward by a, which see a place T seconds
before and after the nadir line, all rays still meet when

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
from numpy.typing import ArrayLike
from scipy.sparse.linalg import splu
from scipy.stats import chi2

from analysis.arrays import Array
from analysis.block.corrections import Corrections
from analysis.calibration.normal_equations import Equations, SharedNoise, State, Weights, assemble
from analysis.orbit.calibration_parameters import CalibrationError, CalibrationField, Noise, Parameters
from analysis.orbit.forward_intersection import intersect
from analysis.orbit.three_line_model import BIAS, LineModel, Rays, bias_rotation

_NAME = "strip"
_STEPS = 10
_CONVERGED = 1e-6  # metres, as in forward intersection


@dataclass(frozen=True)
class Datum:
    """Sigma of a turn that the whole pass has in common, before and after the adjustment.

    name: "roll", "pitch", "yaw" (radians, at the middle of the pass) or "roll rate" and so on (rad/s).
    """

    name: str
    before: float
    after: float


@dataclass(frozen=True, eq=False)
class StripAdjustment:
    """Solution of a pass.

    Attributes:
        ground: (m, 3) points, ITRS, metres; NaN where fewer than two rays see one.
        covariance: (m, 3, 3), with the errors of attitude and station that are left.
        datum: common turns and their rates, from all rays.
        chi_square, degrees_of_freedom: of the rays that meet others, and of the readings' corrections.
    """

    ground: Array
    covariance: Array
    datum: tuple[Datum, ...]
    chi_square: float
    degrees_of_freedom: int
    _shared: SharedNoise = field(repr=False)
    _values: Array = field(repr=False)
    _turn: Array = field(repr=False)

    @property
    def p_value(self) -> float:
        """Chance of such a chi-square or a larger one, if the sigmas are right."""
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
) -> StripAdjustment:
    """Adjust one pass on its tie points.

    Time goes with the number of points, memory with the square of that of readings near rays: 800 readings of the
    attitude take 50 MB.

    Args:
        rays: line -> its image points, with times.
        cameras: line -> calibrated camera, in its state during this pass.
        noise: of image, attitude and station, with at least one interval.
        bias: (3,) calibrated roll, pitch, yaw, radians.

    Raises:
        CalibrationError: rays without times or a noise without intervals, no point with two rays, no convergence.
    """
    noise.check()
    if any(r.time is None for r in rays.values()) or all(t.interval is None for t in noise.terms):
        raise CalibrationError("strip adjustment: needs the times of all rays and the intervals of the readings")
    first = intersect(rays, cameras, noise, bias=bias)
    good = np.flatnonzero(first.rays >= 2)
    place = np.full(len(first.rays), -1)
    place[good] = np.arange(len(good))
    turn, kept = bias_rotation(bias), {}
    for line, row in rays.items():
        some = row.taken(place[row.point] >= 0)
        if some.point.size:
            kept[line] = replace(some, point=place[some.point], attitude=some.attitude @ turn)
    size = len(good)
    one = CalibrationField(_NAME, kept, first.ground[good], np.zeros((size, 3, 3)), np.zeros(size, bool))
    shared = SharedNoise.of([one], noise)
    state, equations = _solved(one, cameras, noise, shared)
    ground, covariance = np.full((len(place), 3), np.nan), np.full((len(place), 3, 3), np.nan)
    ground[good], covariance[good] = state.grounds[0], equations.point_covariance(np.zeros((0, 0)))
    left = equations.residuals
    return StripAdjustment(
        ground=ground,
        covariance=covariance,
        datum=_datum(kept, shared, equations.shared_inverse[0]),
        chi_square=float(np.sum(left.image**2)) + sum(left.shared.values()),
        degrees_of_freedom=left.image.size - 3 * size,
        _shared=shared,
        _values=state.shared,
        _turn=turn,
    )


def _solved(
    one: CalibrationField, cameras: Mapping[str, LineModel], noise: Noise, shared: SharedNoise
) -> tuple[State, Equations]:
    """Readings and points."""
    held = (np.array([-1]),) * 5
    parameters = Parameters((), np.zeros(0), np.zeros(0), {(_NAME, k): held for k in one.rays})
    state = State(np.zeros(0), (one.ground,), np.zeros(shared.size))
    factor = dict.fromkeys(("image", "control", *shared.groups), 1.0)
    weights = Weights(np.ones(sum(len(r.point) for r in one.rays.values())), factor)
    equations = assemble([one], cameras, parameters, state, noise, (), weights, shared)
    for _ in range(_STEPS):
        before, state = state, state.moved(equations, np.zeros(0))
        equations = assemble([one], cameras, parameters, state, noise, (), weights, shared)
        step = float(np.abs(state.grounds[0] - before.grounds[0]).max())
        if step < _CONVERGED:
            return state, equations
    raise CalibrationError(f"strip adjustment: no convergence, the last step is {step:.3g} m")


def _datum(rays: Mapping[str, Rays], shared: SharedNoise, inverse: Array) -> tuple[Datum, ...]:
    """Constant and slope of the attitude's errors over all rays, by least squares."""
    if not any(part.turns for part in shared.parts[_NAME]):
        return ()
    time = np.concatenate([r.time for r in rays.values() if r.time is not None])
    fit = np.linalg.pinv(np.column_stack([np.ones_like(time), time - time.mean()]))
    columns, factors = Corrections(shared.parts[_NAME], np.eye(3), time).factors(True)
    form = np.zeros((6, shared.size))
    for k in range(6):  # roll, pitch, yaw, then their rates
        np.add.at(form[k], columns[:, :, k % 3], fit[k // 3][:, None] * factors[:, :, k % 3])
    before = np.einsum("ks,sk->k", form, splu(shared.precision.tocsc()).solve(form.T))
    after = np.einsum("ks,st,kt->k", form, inverse, form, optimize=True)
    names = (*BIAS, *(f"{n} rate" for n in BIAS))
    return tuple(Datum(n, float(b), float(a)) for n, b, a in zip(names, np.sqrt(before), np.sqrt(after), strict=True))
