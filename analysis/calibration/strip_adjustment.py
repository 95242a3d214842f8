"""Strip adjustment of attitude and station within one pass without ground control; stepwise calibration.

**Strip adjustment** (check flow of paper 003, Mo et al. 2015). Points that several lines see (tie points,
including the check points) connect the attitudes of different exposures: rays that do not intersect reveal attitude
errors. The unknowns are the errors of the readings, with their a-priori sigmas as priors, and the points; cameras and
attitude bias come from a calibration.

Tie points do not determine the datum. With lines that look forward and backward by a, which see a point T seconds
before and after the nadir line, all rays still intersect when

- the whole pass rolls: the scene shifts with it;
- it rolls at a constant rate and is yawed by rate * T / tan a: the scene rotates with it;
- roll repeats itself with the period T: all three lines see a point with the same roll.

Pitch shifts nadir rays by tan^2 a (0.22 at 25 deg) less than outer ones, so it is weakly determined. What all rays of a
point have in common thus keeps its a-priori error: only the priors fix it, and `StripAdjustment.datum` reports how much
the ties added. This also bounds the gain. Forward intersection averages over three exposures anyway, and noise that is
independent from one reading to the next has its largest part in this mean: ties hardly reduce it. Errors that last for
many readings and vary within the pass are reduced considerably.

**Stepwise calibration** as in paper 003: attitude bias with the interior orientation fixed, then the interior
orientation with the bias fixed, iterated. It minimises the same sum of squares as the simultaneous adjustment, one
block of unknowns at a time, and each round leaves the fraction rho^2 of the error, with rho the largest correlation
between a combination of one block and a combination of the other (block Gauss-Seidel). It needs no gauge, because each
block alone is determined; a combination of both blocks that the points leave undetermined then depends on the start
values and the order of the steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.linalg import splu

from analysis import statistics
from analysis.arrays import Array
from analysis.block.error_processes import Corrections
from analysis.calibration.normal_equations import Equations, SharedNoise, State, Weights, assemble
from analysis.orbit.calibration_parameters import (
    CalibrationError,
    CalibrationField,
    Noise,
    Parameters,
    Prior,
    Unknowns,
    free_basis,
    solved,
)
from analysis.orbit.forward_intersection import intersect
from analysis.orbit.three_line_model import BIAS, LineModel, Rays, bias_rotation

_NAME = "strip"
_STEPS = 10
"""Largest number of Gauss-Newton steps of a strip adjustment."""
_CONVERGED = 1e-6
"""Largest step of the ground points, in metres, at which a strip adjustment counts as converged."""


@dataclass(frozen=True)
class Datum:
    """Sigma of a rotation that the whole pass has in common, before and after the adjustment.

    Attributes
    ----------
    name : str
        "roll", "pitch", "yaw" (radians, at the middle of the pass), or "roll rate" and so on (rad/s).
    before : float
        A-priori sigma.
    after : float
        Sigma after the adjustment.
    """

    name: str
    before: float
    after: float


@dataclass(frozen=True, eq=False)
class StripAdjustment:
    """Adjusted ground points and attitude errors of one pass.

    Attributes
    ----------
    ground : (m, 3) ndarray
        Coordinates of the m points, ITRS, in metres; NaN where fewer than two rays see one.
    covariance : (m, 3, 3) ndarray
        Covariance of the points, including the remaining errors of attitude and station, in m^2.
    datum : tuple of Datum
        Sigmas of the rotation that all rays of the pass have in common, and of its rate, about each axis.
    chi_square : float
        Chi-square of the rays of tie points and of the readings' corrections.
    degrees_of_freedom : int
        Degrees of freedom of the chi-square.
    """

    ground: Array
    covariance: Array
    datum: tuple[Datum, ...]
    chi_square: float
    degrees_of_freedom: int
    _shared: SharedNoise = field(repr=False)
    _values: Array = field(repr=False)
    _rotation: Array = field(repr=False)

    @property
    def p_value(self) -> float:
        """p-value of the chi-square, if the sigmas are right."""
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)

    def corrected(self, rays: Rays) -> Rays:
        """Return rays of the pass with attitude and station corrected by the adjustment; the rays need times.

        Raises
        ------
        CalibrationError
            The rays have no times.
        """
        if rays.time is None:
            raise CalibrationError("strip adjustment: these rays have no times")
        rotated = replace(rays, attitude=rays.attitude @ self._rotation)
        corrected_rays = self._shared.corrected_at(_NAME, rotated, self._values)
        return replace(corrected_rays, attitude=corrected_rays.attitude @ self._rotation.T)


def adjust_strip(
    rays: Mapping[str, Rays], cameras: Mapping[str, LineModel], noise: Noise, *, bias: ArrayLike = (0.0, 0.0, 0.0)
) -> StripAdjustment:
    """Estimate attitude and station errors within one pass from tie points, without ground control.

    Time is linear in the number of points, memory quadratic in the number of readings near rays: 800 attitude readings
    take 50 MB.

    Parameters
    ----------
    rays : mapping of str to Rays
        Image points of each line, with times.
    cameras : mapping of str to LineModel
        Calibrated cameras in their state during this pass, by line.
    noise : Noise
        Standard deviations of image, attitude and station, with at least one interval.
    bias : (3,) array_like
        Calibrated roll, pitch, yaw, in radians.

    Raises
    ------
    CalibrationError
        Rays have no times, the noise has no intervals, no point has two rays, or the iteration does not converge.
    """
    noise.check()
    if any(r.time is None for r in rays.values()) or all(t.interval is None for t in noise.terms):
        raise CalibrationError("strip adjustment: needs the times of all rays and the intervals of the readings")
    first = intersect(rays, cameras, noise, bias=bias)
    intersected = np.flatnonzero(first.rays >= 2)
    number = np.full(len(first.rays), -1)
    number[intersected] = np.arange(len(intersected))
    bias_matrix, tie_rays = bias_rotation(bias), {}
    for line, row in rays.items():
        selected = row.taken(number[row.point] >= 0)
        if selected.point.size:
            tie_rays[line] = replace(selected, point=number[selected.point], attitude=selected.attitude @ bias_matrix)
    size = len(intersected)
    site = CalibrationField(_NAME, tie_rays, first.ground[intersected], np.zeros((size, 3, 3)), np.zeros(size, bool))
    shared = SharedNoise.of([site], noise)
    state, equations = _solved(site, cameras, noise, shared)
    ground, covariance = np.full((len(number), 3), np.nan), np.full((len(number), 3, 3), np.nan)
    ground[intersected], covariance[intersected] = state.grounds[0], equations.point_covariance(np.zeros((0, 0)))
    residuals = equations.residuals
    return StripAdjustment(
        ground=ground,
        covariance=covariance,
        datum=_datum(tie_rays, shared, equations.shared_inverse[0]),
        chi_square=float(np.sum(residuals.image**2)) + sum(residuals.shared.values()),
        degrees_of_freedom=residuals.image.size - 3 * size,
        _shared=shared,
        _values=state.shared,
        _rotation=bias_matrix,
    )


def _solved(
    site: CalibrationField, cameras: Mapping[str, LineModel], noise: Noise, shared: SharedNoise
) -> tuple[State, Equations]:
    """Iterate a strip adjustment to convergence and return the state of readings and points, with the equations."""
    fixed = (np.array([-1]),) * 5
    parameters = Parameters((), np.zeros(0), np.zeros(0), {(_NAME, k): fixed for k in site.rays})
    state = State(np.zeros(0), (site.ground,), np.zeros(shared.size))
    factor = dict.fromkeys(("image", "control", *shared.groups), 1.0)
    weights = Weights(np.ones(sum(len(r.point) for r in site.rays.values())), factor)
    equations = assemble([site], cameras, parameters, state, noise, (), weights, shared)
    for _ in range(_STEPS):
        before, state = state, state.moved(equations, np.zeros(0))
        equations = assemble([site], cameras, parameters, state, noise, (), weights, shared)
        step = float(np.abs(state.grounds[0] - before.grounds[0]).max())
        if step < _CONVERGED:
            return state, equations
    raise CalibrationError(f"strip adjustment: no convergence, the last step is {step:.3g} m")


def _datum(rays: Mapping[str, Rays], shared: SharedNoise, inverse: Array) -> tuple[Datum, ...]:
    """Return the sigmas of the mean and of the slope in time of the attitude's errors over all rays of the pass."""
    if not any(part.rotates for part in shared.parts[_NAME]):
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


_OPEN = 1.0 - 1e-6
"""Squared correlation between a combination of interior orientation and one of attitude bias above which both together
are undetermined: the stepwise iteration would need a million rounds.
"""
_RELINEARISED = 3
"""Number of rounds at the start of the stepwise iteration that are each linearised anew."""


@dataclass(frozen=True, eq=False)
class Stepwise:
    """Solution of the stepwise iteration.

    Attributes
    ----------
    names : tuple of str
        Names of the P unknowns.
    values : (P,) ndarray
        Final values.
    converged : bool
        True if the steps fell below the tolerance.
    steps : (rounds,) ndarray
        Largest change of any unknown in each round, in conditional sigmas (those for known other unknowns).
    rate : float
        Theoretical fraction of the most slowly decreasing error that remains after a round, without undetermined
        combinations.
    """

    names: tuple[str, ...]
    values: Array
    converged: bool
    steps: Array
    rate: float

    @property
    def rounds(self) -> int:
        """Number of rounds of the alternating iteration."""
        return len(self.steps)


def stepwise(
    fields: Sequence[CalibrationField],
    cameras: Mapping[str, LineModel],
    noise: Noise,
    *,
    unknowns: Unknowns | None = None,
    start: Mapping[str, float] | None = None,
    priors: Sequence[Prior] = (),
    held: Sequence[str] = (),
    tolerance: float = 1e-3,
    rounds: int = 100_000,
) -> Stepwise:
    """Estimate attitude bias and interior orientation alternately, as paper 003 does, until both converge.

    The remaining error is about the last step times rate / (1 - rate). The first rounds are linearised again, later
    ones only after all steps have become small.

    Parameters
    ----------
    fields : sequence of CalibrationField
        Passes over test fields.
    cameras : mapping of str to LineModel
        Cameras by line.
    noise : Noise
        Standard deviations of image, attitude and station.
    unknowns : Unknowns, optional
        Unknowns beside the interior orientation and one bias for each field.
    start : mapping of str to float, optional
        Start values by name.
    priors : sequence of Prior
        Pseudo-observations.
    held : sequence of str
        Unknowns that are fixed at their start values.
    tolerance : float
        Largest step at convergence, in conditional sigmas (those for known other unknowns).
    rounds : int
        Largest number of rounds.

    Raises
    ------
    RankError
        A block alone is undetermined.
    CalibrationError
        Only one block is to be estimated, or other input is invalid.
    """
    parameters = Parameters.of(fields, cameras, unknowns or Unknowns(), start)
    names, scale = parameters.names, parameters.scale
    inside = {n for f in fields for line in f.rays for n in np.array(names)[_used(parameters, f.name, line)]}
    free = np.array([n not in held for n in names])
    blocks = [
        np.flatnonzero(free & np.array([(n in inside) == is_interior for n in names])) for is_interior in (False, True)
    ]
    if not all(len(b) for b in blocks):
        raise CalibrationError("stepwise calibration: needs unknowns of both the attitude and the interior orientation")
    weights = Weights(np.ones(sum(len(r.point) for f in fields for r in f.rays.values())), {"image": 1.0})
    noise.check()
    common = SharedNoise.of(fields, noise)
    state = State(parameters.start, tuple(f.ground for f in fields), np.zeros(common.size))
    equations = assemble(fields, cameras, parameters, state, noise, priors, weights, common)
    sigma = np.zeros(len(names))
    for b in blocks:
        normal = equations.reduced[np.ix_(b, b)]
        free_basis(normal, equations.length[b], scale[b], [names[i] for i in b.tolist()], None)
        sigma[b] = np.sqrt(np.diag(solved(normal, np.eye(len(b)))))
    sizes: list[float] = []
    converged = False
    while not converged and len(sizes) < rounds:
        most = 1 if len(sizes) < _RELINEARISED else rounds - len(sizes)
        step, new_sizes = _alternate(equations.reduced, equations.right, blocks, sigma, tolerance, most)
        sizes += new_sizes
        state = state.moved(equations, step)
        equations = assemble(fields, cameras, parameters, state, noise, priors, weights, common)
        converged = len(new_sizes) == 1 and new_sizes[0] < tolerance
    shared = _canonical_squares(equations.reduced, *blocks)
    return Stepwise(
        names=names,
        values=state.values,
        converged=converged,
        steps=np.array(sizes),
        rate=float(np.max(shared[shared < _OPEN], initial=0.0)),
    )


def _used(parameters: Parameters, name: str, line: str) -> Array:
    """Return the indices, among all unknowns, of those elements of a line's interior orientation that are estimated."""
    columns = parameters.columns[name, line][0]
    return columns[columns >= 0]


def _alternate(
    normal: Array, right: Array, blocks: Sequence[NDArray[np.intp]], sigma: Array, tolerance: float, most: int
) -> tuple[Array, list[float]]:
    """Solve linear normal equations for two blocks of unknowns alternately, until the steps are below a tolerance.

    Returns
    -------
    tuple of ((P,) ndarray, list of float)
        Total step of the P unknowns, and largest step of each round.
    """
    inverses = [solved(normal[np.ix_(b, b)], np.eye(len(b))) for b in blocks]
    total, gradient = np.zeros(len(normal)), right.copy()
    sizes: list[float] = []
    while len(sizes) < most:
        size = 0.0
        for block, inverse in zip(blocks, inverses, strict=True):
            step = -inverse @ gradient[block]
            gradient += normal[:, block] @ step
            total[block] += step
            size = max(size, float(np.max(np.abs(step) / sigma[block])))
        sizes.append(size)
        if size < tolerance:
            break
    return total, sizes


def _canonical_squares(normal: Array, first: NDArray[np.intp], second: NDArray[np.intp]) -> Array:
    """Return the squared canonical correlations between two groups of unknowns of a normal matrix."""
    roots = [np.linalg.cholesky(normal[np.ix_(b, b)]) for b in (first, second)]
    mixed = np.linalg.solve(roots[0], np.linalg.solve(roots[1], normal[np.ix_(second, first)]).T)
    return np.asarray(np.linalg.svd(mixed, compute_uv=False) ** 2)
