"""Simultaneous in-orbit calibration of three-line cameras (paper 003, Mo et al. 2015); omitted terms are tested.

The unknowns are the interior orientation of each camera and the attitude bias of each field.

**Adjustment.** Gauss-Newton on all image points of all fields, control coordinates and pseudo-observations; robust
weights and variance components are iterated around it. No solution is returned from a singular system: combinations of
unknowns that the points leave undetermined are named, and must be fixed by a gauge or by priors.

**Checks before an adjustment.** `check_positions` tests that points lie where their image points look, and the noise of
a single image point must be smaller than what is to be estimated. Either fault would otherwise appear as undetermined
combinations: robust weights reject points that are kilometres off, and then too few are left; noise that exceeds the
changes at launch leaves everything undetermined.

**Test for omitted terms.** A term g that changes the misclosures by G g and is not estimated biases the estimates by C
N_xg g, with C their covariance and N the normal matrix that includes g. The residuals determine the gradient s at g =
0, of covariance S = N_gg - N_gx C N_xg: the estimate of g is -S^-1 s, and s' S^-1 s is a chi-square if there is no such
term and the sigmas are right (Lagrange multiplier test; Rao, Proc. Camb. Phil. Soc. 44 (1948) 50). S is the exact
covariance, so the test is valid for six points as for six hundred.

The omitted terms are rates of the attitude during each field; slow variations along each line, cosines of the exposure
time over the duration of the line, in x and in y, which correlate the residuals of neighbouring exposures; and steps
within a line.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from analysis import statistics
from analysis.arrays import Array
from analysis.block import reweighting
from analysis.calibration.normal_equations import Equations, SharedNoise, State, Weights, assemble
from analysis.orbit import calibration_parameters
from analysis.orbit.forward_intersection import ray_covariance
from analysis.orbit.three_line_model import BIAS, DRIFT, INTERIOR, LineModel, Partials, Rays, misclosure, partials

FALSE_ALARM = 5e-5
"""False-alarm rate of each of the two tests of a run, rates and slow variations, over all fields together: 1e-4 per
run.
"""
_WAVES = 4
"""Largest number of cosines that describe slow variations of x, and of y, along a line."""
_POINTS_PER_WAVE = 4
"""Smallest number of image points for each cosine that describes slow variations along a line."""
_RANK = 1e-9
"""Smallest eigenvalue of the gradient's covariance S, relative to the largest, of a combination of omitted terms that
residuals can show. A term that the estimated unknowns imitate exactly has the eigenvalue zero.
"""


@dataclass(frozen=True, eq=False)
class Rates:
    """Drift of the attitude during each field, in rad/s about the body's axes, zero at the field's mean time.

    Attributes
    ----------
    middles : mapping of str to float
        Mean time of the rays of each field, in seconds; fields without times are omitted.
    """

    middles: Mapping[str, float]

    @classmethod
    def of(cls, fields: Sequence[calibration_parameters.CalibrationField]) -> Rates:
        """Return the attitude drift rates, as terms to test, of all fields whose rays have times."""
        times = {f.name: [r.time for r in f.rays.values() if r.time is not None and r.point.size] for f in fields}
        return cls({name: float(np.mean(np.concatenate(rows))) for name, rows in times.items() if rows})

    @property
    def size(self) -> int:
        """Number of omitted terms: three rates for each field."""
        return 3 * len(self.middles)

    def columns(self, field: calibration_parameters.CalibrationField, line: str, rays: Rays, by: Partials) -> Array:
        """Return the derivatives of n image points' misclosures (x, y) with respect to the rates, (n, 2, size).

        Parameters
        ----------
        field : CalibrationField
            Pass over a test field.
        line : str
            Name of the line camera.
        rays : Rays
            Image points of the line, n of them.
        by : Partials
            Derivatives of the misclosures of these image points with respect to the model's parameters.
        """
        derivatives = np.zeros((len(rays.point), 2, self.size))
        if rays.time is not None and field.name in self.middles:
            first = 3 * list(self.middles).index(field.name)
            elapsed = (rays.time - self.middles[field.name])[:, None, None]
            derivatives[:, :, first : first + 3] = by.attitude * elapsed
        return derivatives


@dataclass(frozen=True, eq=False)
class SlowVariations:
    """Slow variations of the image coordinates x and y with time, for each line of each field, in metres.

    They are cosines of up to four half periods, without the constant.

    Attributes
    ----------
    waves : mapping of (str, str) to tuple
        For each (field, line): start time and duration in seconds, index of the first term, and number of terms for
        each of x and y.
    """

    waves: Mapping[tuple[str, str], tuple[float, float, int, int]]

    @classmethod
    def of(cls, fields: Sequence[calibration_parameters.CalibrationField]) -> SlowVariations:
        """Return the slow variations, as terms to test, of all lines whose rays have times and enough points."""
        waves: dict[tuple[str, str], tuple[float, float, int, int]] = {}
        first = 0
        for site in fields:
            for line, rays in site.rays.items():
                if rays.time is None or not rays.point.size or not np.ptp(rays.time):
                    continue
                count = min(_WAVES, len(rays.point) // _POINTS_PER_WAVE)
                if count:
                    waves[site.name, line] = (float(rays.time.min()), float(np.ptp(rays.time)), first, count)
                    first += 2 * count
        return cls(waves)

    @property
    def size(self) -> int:
        """Number of omitted terms: the cosines of all lines and fields."""
        return sum(2 * count for *_, count in self.waves.values())

    def columns(self, field: calibration_parameters.CalibrationField, line: str, rays: Rays, by: Partials) -> Array:
        """Return the derivatives of n image points' misclosures (x, y) with respect to the cosines, (n, 2, size)."""
        derivatives = np.zeros((len(rays.point), 2, self.size))
        if (field.name, line) in self.waves and rays.time is not None:
            begin, span, first, count = self.waves[field.name, line]
            wave = np.cos(np.pi * np.arange(1, count + 1) * (rays.time[:, None] - begin) / span)
            derivatives[:, 0, first : first + count] = wave
            derivatives[:, 1, first + count : first + 2 * count] = wave
        return derivatives


@dataclass(frozen=True, eq=False)
class Steps:
    """Step of x and of y within a line, in metres: all image points beyond a position on the line are displaced.

    Attributes
    ----------
    positions : tuple of (str, float)
        Line, and y of the position in metres, for each step.
    """

    positions: tuple[tuple[str, float], ...]

    @property
    def size(self) -> int:
        """Number of omitted terms: a step in x and one in y for each position."""
        return 2 * len(self.positions)

    def columns(self, field: calibration_parameters.CalibrationField, line: str, rays: Rays, by: Partials) -> Array:
        """Return the derivatives of n image points' misclosures (x, y) with respect to the steps, (n, 2, size).

        The misclosure of an image point that is displaced by 1 m is 1 m larger.
        """
        derivatives = np.zeros((len(rays.point), 2, self.size))
        for k, (name, position) in enumerate(self.positions):
            if name == line:
                beyond = rays.image[:, 1] > position
                derivatives[beyond, 0, 2 * k] = derivatives[beyond, 1, 2 * k + 1] = -1.0
        return derivatives


OmittedTerms = Rates | SlowVariations | Steps


@dataclass(frozen=True, eq=False)
class OmittedTermsTest:
    """Lagrange multiplier test of omitted terms from the residuals of an adjustment.

    Attributes
    ----------
    terms : Rates, SlowVariations or Steps
        The G terms that the adjustment did not estimate.
    score : (G,) ndarray
        Gradient of half the sum of squares with respect to the terms, where they are zero.
    cofactor : (G, G) ndarray
        Covariance S of the gradient.
    bias : (P, G) ndarray
        Bias of the P estimates due to a term of one unit.
    """

    terms: OmittedTerms
    score: Array
    cofactor: Array
    bias: Array

    @classmethod
    def of(cls, terms: OmittedTerms, wide: Equations, covariance: Array) -> OmittedTermsTest:
        """Return the test from equations that contain the terms, at a solution.

        Parameters
        ----------
        terms : Rates, SlowVariations or Steps
            The omitted terms, G in number.
        wide : Equations
            Equations of P unknowns and the G terms, which are zero.
        covariance : (P, P) ndarray
            Covariance of the P unknowns, SI units.
        """
        count = len(covariance)
        bias = covariance @ wide.reduced[:count, count:]
        cofactor = wide.reduced[count:, count:] - wide.reduced[count:, :count] @ bias
        return cls(terms, wide.right[count:], 0.5 * (cofactor + cofactor.T), bias)

    @property
    def estimate(self) -> Array:
        """Estimates of the G omitted terms together; 0 for a term that the residuals do not determine."""
        return np.asarray(-self._inverse @ self.score)

    @property
    def sigma(self) -> Array:
        """Standard deviations of the G estimates; infinite for a term that the residuals do not determine."""
        spread = np.diag(self._inverse)
        return np.sqrt(np.where(np.diag(self.cofactor) > _RANK * self._largest, spread, np.inf))

    @property
    def sigma_alone(self) -> Array:
        """Standard deviation of each of the G omitted terms, if it is the only one that is not zero."""
        diagonal = np.diag(self.cofactor)
        determined = diagonal > _RANK * self._largest
        return np.asarray(np.where(determined, 1.0 / np.sqrt(np.where(determined, diagonal, 1.0)), np.inf))

    @property
    def degrees_of_freedom(self) -> int:
        """Number of linear combinations of the omitted terms that the residuals can show."""
        return int(np.linalg.matrix_rank(self._unit, tol=1e-6, hermitian=True)) if len(self.score) else 0

    @property
    def chi_square(self) -> float:
        """Chi-square of the test that all omitted terms are zero."""
        return float(self.score @ self._inverse @ self.score) if len(self.score) else 0.0

    @property
    def p_value(self) -> float:
        """p-value of the chi-square under the hypothesis of no omitted term; 1 if the residuals can show none."""
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)

    @property
    def _largest(self) -> float:
        """Largest variance of the gradient's components, the diagonal elements of the cofactor matrix."""
        return float(np.diag(self.cofactor).max(initial=0.0))

    @property
    def _size(self) -> Array:
        """Standard deviations of the G gradient components, the scale of the cofactor matrix."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.cofactor), 1e-300)))

    @property
    def _unit(self) -> Array:
        """Covariance of the gradient (the cofactor matrix) scaled to unit diagonal, (G, G) for G terms."""
        return np.asarray(self.cofactor / self._size / self._size[:, None])

    @property
    def _inverse(self) -> Array:
        """Pseudo-inverse of the cofactor matrix (covariance of the gradient), (G, G) for G terms."""
        inner = np.linalg.pinv(self._unit, rcond=1e-6, hermitian=True)
        return np.asarray(inner / self._size / self._size[:, None])


FARTHEST = 2e3
"""Largest plausible distance between points and the rays of their image points, in metres on the ground. No launch and
no datum moves half of the points farther: an arc minute is 150 m, one second of a clock 7 km.
"""
_EXPECTED = 20.0
"""Largest plausible distance between points and the rays of their image points, in sigmas due to the start values;
beyond it the points are not those in the image.
"""


class FarPointsError(calibration_parameters.CalibrationError):
    """Error raised for ground points that are kilometres off their image points' rays, or contradict each other."""


class NoiseError(calibration_parameters.CalibrationError):
    """Error raised if the noise of a single image point exceeds the changes that are to be estimated.

    Attributes
    ----------
    largest : str
        Dominant noise source: "image", "attitude", "slow attitude", "station" or "control".
    """

    def __init__(self, message: str, largest: str) -> None:
        super().__init__(message)
        self.largest = largest


def single_ray(
    fields: Sequence[calibration_parameters.CalibrationField],
    cameras: Mapping[str, LineModel],
    noise: calibration_parameters.Noise,
) -> dict[str, float]:
    """Return the median standard deviation of one image point in x or y due to each noise source alone, in metres.

    Parameters
    ----------
    fields : sequence of CalibrationField
        Fields with their rays.
    cameras : mapping of str to LineModel
        Cameras at the start values, by line.
    noise : Noise
        Standard deviations of image, attitude and station.
    """
    alone = {"image": replace(noise, attitude=0.0, station=0.0, slow_attitude=0.0)}
    tiny = 1e-6 * noise.image
    for term in noise.terms:
        key = term.group.replace(" ", "_")
        alone[term.group] = replace(alone["image"], image=tiny, **{key: term.sigma})
    variances: dict[str, list[Array]] = {group: [] for group in alone}
    variances["control"] = []
    for site in fields:
        for line, rays in site.rays.items():
            by = partials(cameras[line], rays, site.ground[rays.point], np.zeros(3), np.zeros(3))
            for group, single in alone.items():
                variances[group].append(_mean_square(ray_covariance(single, rays, by, shared=True)))
            control_covariance = np.where(site.control[:, None, None], site.covariance, 0.0)[rays.point]
            variances["control"].append(_mean_square(by.ground @ control_covariance @ np.swapaxes(by.ground, 1, 2)))
    return {group: float(np.sqrt(np.median(np.concatenate(rows)))) for group, rows in variances.items()}


def check_positions(
    fields: Sequence[calibration_parameters.CalibrationField],
    cameras: Mapping[str, LineModel],
    start: Mapping[str, float] | None = None,
) -> None:
    """Raise FarPointsError if control points lie far from where their image points look at the start values.

    Parameters
    ----------
    fields : sequence of CalibrationField
        Fields with their control points.
    cameras : mapping of str to LineModel
        Cameras at the start values, by line.
    start : mapping of str to float, optional
        Sigmas of start values by name, in metres or radians; unspecified ones are not used.

    Raises
    ------
    FarPointsError
        Half of a field's control points lie farther than `FARTHEST` from their rays, and farther than 20 sigmas of the
        start values.
    """
    for site in fields:
        distances, expected = [], []
        for line, rays in site.rays.items():
            control_rays = rays.taken(site.control[rays.point])
            if not control_rays.point.size:
                continue
            camera, ground = cameras[line], site.ground[control_rays.point]
            distance = np.linalg.norm(ground - control_rays.station, axis=1) / float(camera.principal_distance)
            miss = misclosure(camera, control_rays, ground, np.zeros(3), np.zeros(3))
            distances.append(distance * np.linalg.norm(miss, axis=1))
            sigmas = [(start or {}).get(f"{site.name} {n}", 0.0) * float(camera.principal_distance) for n in BIAS[:2]]
            sigmas += [(start or {}).get(f"{line} {n}", 0.0) for n in INTERIOR[1:]]
            expected.append(distance * float(np.linalg.norm(sigmas)))
        if not distances:
            continue
        median, limit = float(np.median(np.concatenate(distances))), float(np.median(np.concatenate(expected)))
        if median > max(FARTHEST, _EXPECTED * limit):
            raise FarPointsError(
                f"calibration: half of the control points of {site.name} lie {median / 1e3:.3g} km or more from the"
                f" rays of their image points at the start values, where {limit / 1e3:.2g} km are expected (one sigma)"
            )


def _mean_square(covariance: Array) -> Array:
    """Return the mean variance over both axes of n covariances (n, 2, 2), as (n,)."""
    return np.asarray(0.5 * np.trace(covariance, axis1=1, axis2=2))


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Solution of a simultaneous calibration of line cameras on test fields.

    Attributes
    ----------
    names : tuple of str
        Names of the P unknowns.
    values : (P,) ndarray
        Estimates, in metres and radians.
    covariance : (P, P) ndarray
        Covariance from the a-priori sigmas times `factors`, and from the start values where these fix undetermined
        combinations. Fixed unknowns count as exact: their rows and columns are zero.
    gauge : Gauge
        Rule by which undetermined combinations of unknowns were fixed.
    open : tuple of Combination
        Undetermined linear combinations of unknowns, which the gauge fixed.
    weak : tuple of Combination
        Linear combinations that the measurements determine only weakly, but that were estimated.
    prior_share : (P,) ndarray
        Fraction, 0 to 1, of each variance that is due to the sigmas of the start values and not to the measurements.
    follow : (P, H) ndarray
        Derivatives of the P estimates with respect to the start values of the H fixed unknowns.
    cameras : mapping of str to LineModel
        Cameras with the adjusted interior orientation, in the reference state.
    ground : mapping of str to (m, 3) ndarray
        Adjusted coordinates of the m points of each field, ITRS, in metres; NaN for rejected points.
    ground_covariance : mapping of str to (m, 3, 3) ndarray
        Covariance of the points of each field, in m^2; NaN for rejected points.
    residual : mapping of str to mapping of str to (n, 2) ndarray
        Standardised residuals of the n image points of each field and line.
    weight : mapping of str to mapping of str to (n,) ndarray
        Robust weights of the image points of each field and line.
    chi_square : float
        Weighted chi-square; excluded points do not count.
    degrees_of_freedom : int
        Degrees of freedom of the chi-square.
    factors : mapping of str to float
        Estimated variance factor of each group (1 where not estimated). Noise that image points share has groups of its
        own.
    redundancy : mapping of str to float
        Redundancy of each group.
    iterations : int
        Total number of Gauss-Newton steps.
    fields : sequence of CalibrationField
        Fields that were adjusted.
    omitted_terms_test : callable
        Function that tests the residuals for omitted terms.
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array
    gauge: calibration_parameters.Gauge
    open: tuple[calibration_parameters.Combination, ...]
    weak: tuple[calibration_parameters.Combination, ...]
    prior_share: Array
    follow: Array
    cameras: Mapping[str, LineModel]
    ground: Mapping[str, Array]
    ground_covariance: Mapping[str, Array]
    residual: Mapping[str, Mapping[str, Array]]
    weight: Mapping[str, Mapping[str, Array]]
    chi_square: float
    degrees_of_freedom: int
    factors: Mapping[str, float]
    redundancy: Mapping[str, float]
    iterations: int
    fields: Sequence[calibration_parameters.CalibrationField] = field(repr=False)
    omitted_terms_test: Callable[[OmittedTerms], OmittedTermsTest] = field(repr=False)

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviation of each unknown by its name, in metres or radians; 0 for fixed unknowns."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @cached_property
    def rates(self) -> OmittedTermsTest | None:
        """Test for a drift of the attitude during each field; None if a rate is an unknown."""
        return None if any(n.endswith("rate") for n in self.names) else self.omitted_terms_test(Rates.of(self.fields))

    @cached_property
    def slow_variations(self) -> OmittedTermsTest:
        """Test of the residuals for image errors that vary slowly along the lines."""
        return self.omitted_terms_test(SlowVariations.of(self.fields))

    def sigma_with(self, start: Mapping[str, float]) -> dict[str, float]:
        """Return the standard deviations of the unknowns if the start values of fixed ones have errors.

        Parameters
        ----------
        start : mapping of str to float
            Sigmas of the start values of fixed unknowns, by name.

        Raises
        ------
        CalibrationError
            A name is not that of a fixed unknown.
        """
        sigmas = np.zeros(len(self.gauge.held))
        for name, sigma in start.items():
            sigmas[calibration_parameters.index(self.gauge.held, name)] = sigma
        from_fixed = np.sum((self.follow * sigmas) ** 2, axis=1)
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance) + from_fixed).tolist(), strict=True))

    @property
    def correlation(self) -> Array:
        """Correlation matrix of the P unknowns, (P, P); rows and columns of fixed unknowns are NaN."""
        sigma = np.sqrt(np.diag(self.covariance))
        with np.errstate(invalid="ignore"):
            return np.asarray(self.covariance / sigma / sigma[:, None])

    @property
    def p_value(self) -> float:
        """p-value of the chi-square, if the sigmas are right; valid without robust weights."""
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)

    def value(self, name: str) -> float:
        """Return the estimate of one unknown; raise CalibrationError if there is none of that name."""
        return float(self.values[calibration_parameters.index(self.names, name)])

    def bias(self, field: str) -> Array:
        """Return the attitude bias (3,) of a field in roll, pitch, yaw, in radians."""
        return np.array([self.value(f"{field} {n}") for n in BIAS])

    def cameras_of(self, field: str) -> dict[str, LineModel]:
        """Return the cameras in their state during one field, with adjusted interior and, if estimated, drift."""
        cameras = {}
        for line, camera in self.cameras.items():
            names = [f"{field} {line} {n}" for n in DRIFT]
            drift = names[0] in self.names
            cameras[line] = camera.drifted([self.value(n) for n in names]) if drift else camera
        return cameras


_CONVERGED = 1e-6
"""Largest Gauss-Newton step of a converged iteration, in sigmas; a step that no longer decreases because of rounding
ends it, too.
"""
_HUBER_ROUNDS = 6
"""Number of first rounds of reweighting with Huber's weights, before the weights of IGG III are used."""


def adjust(
    fields: Sequence[calibration_parameters.CalibrationField],
    cameras: Mapping[str, LineModel],
    noise: calibration_parameters.Noise,
    *,
    unknowns: calibration_parameters.Unknowns | None = None,
    start: Mapping[str, float] | None = None,
    priors: Sequence[calibration_parameters.Prior] = (),
    gauge: calibration_parameters.Gauge | None = None,
    robust: reweighting.Robust | None = None,
    variance_components: bool | Collection[str] = False,
    iterations: int = 20,
) -> Adjustment:
    """Calibrate line cameras by one simultaneous least-squares adjustment of all passes over test fields.

    Parameters
    ----------
    fields : sequence of CalibrationField
        Passes over test fields.
    cameras : mapping of str to LineModel
        Mounting, distortion and start values of the interior orientation, by line.
    noise : Noise
        Standard deviations of image, attitude and station.
    unknowns : Unknowns, optional
        Unknowns beside the interior orientation and one bias for each field.
    start : mapping of str to float, optional
        Start values by name; otherwise the cameras' interior orientation, and zero for the rest.
    priors : sequence of Prior
        Pseudo-observations, for example of an on-board monitor of the cameras.
    gauge : Gauge, optional
        Rule that fixes undetermined combinations.
    robust : {'huber', 'igg'}, optional
        "huber" reduces the weights of image points with large residuals, "igg" also excludes the worst, and with them
        tie points with fewer than two remaining rays.
    variance_components : bool or collection of str
        True to estimate a variance factor of "image", "control", each group of priors and, where image points share
        them, "attitude", "slow attitude" and "station", within a hundredth and a hundred; or the names of the groups to
        estimate. With robust weights the factors come from image points within the limit of "igg", all with full
        weight, which are selected by the image noise from the median of its residuals; the robust weights then use
        these factors.
    iterations : int
        Largest number of Gauss-Newton steps of one round.

    Raises
    ------
    RankError
        Neither gauge nor priors fix all undetermined combinations.
    NoiseError
        A single image point is more uncertain than what is to be estimated.
    FarPointsError
        Points do not match their images, or contradict each other.
    CalibrationError
        Other input is invalid, there are fewer observations than unknowns, or the iteration does not converge.
    """
    noise.check()
    if robust not in (None, "huber", "igg"):
        raise calibration_parameters.CalibrationError(f"calibration: robust must be huber or igg, found {robust!r}")
    parameters = calibration_parameters.Parameters.of(
        fields, cameras, unknowns or calibration_parameters.Unknowns(), start
    )
    gauge = gauge or calibration_parameters.Gauge()
    shared = SharedNoise.of(fields, noise)
    rejected = np.zeros(sum(len(f.ground) for f in fields), bool)
    estimated_groups = None if isinstance(variance_components, bool) else frozenset(variance_components)
    problem = _Problem(fields, cameras, parameters, noise, shared, tuple(priors), gauge, iterations, estimated_groups)
    groups = ("image", "control", *shared.groups, *dict.fromkeys(p.group for p in priors))
    count = sum(len(r.point) for f in fields for r in f.rays.values())
    if 2 * count < len(parameters.names) - len(gauge.held) - len(priors):
        raise calibration_parameters.CalibrationError(
            f"calibration: {count} image points are too few for {len(parameters.names) - len(gauge.held)} unknowns"
        )
    check_positions(fields, cameras, gauge.start if isinstance(gauge.start, Mapping) else None)
    start_state = State(parameters.start, tuple(f.ground for f in fields), np.zeros(shared.size))
    state = _Iteration(start_state, Weights(np.ones(count), dict.fromkeys(groups, 1.0)), 0, rejected)
    try:
        return _adjusted(problem, state, robust, bool(variance_components))
    except calibration_parameters.RankError as error:
        raise problem.cause(error) from error
    except reweighting.UnsettledError as error:
        raise calibration_parameters.CalibrationError(f"calibration: {error}") from error


def _adjusted(
    problem: _Problem, state: _Iteration, robust: reweighting.Robust | None, variance_components: bool
) -> Adjustment:
    """Iterate weights and variance factors to convergence and return the solution."""
    if robust and variance_components:
        # Detect gross errors against the scatter of the others first. Variance components then need good points with
        # full weight, because weights that fall with the residual would look like smaller noise.
        solution, _ = reweighting.settled(problem, state, reweighting.Rule("huber", "median", tolerance=0.05))
        solution, _ = reweighting.settled(
            problem, solution, reweighting.Rule("accept", "components", problem.estimated)
        )
        state = replace(state, weights=replace(state.weights, factor=solution.factor), steps=solution.steps)
    elif variance_components:
        return problem.result(
            *reweighting.settled(problem, state, reweighting.Rule(None, "components", problem.estimated)), None
        )
    screening = _HUBER_ROUNDS if robust == "igg" else 0
    return problem.result(*reweighting.settled(problem, state, reweighting.Rule(robust, screening=screening)), robust)


@dataclass(frozen=True, eq=False)
class _Iteration:
    """State of the adjustment: current solution, weights, number of steps, and permanently rejected points."""

    state: State
    weights: Weights
    steps: int
    lost: NDArray[np.bool_]

    @property
    def weight(self) -> tuple[Array, ...]:
        return (self.weights.image,)

    @property
    def factor(self) -> Mapping[str, float]:
        return self.weights.factor


@dataclass(frozen=True, eq=False)
class _Solved:
    """Linearised equations at a solution, and the covariance (P, P) of the P unknowns."""

    equations: Equations
    covariance: Array

    @cached_property
    def cofactors(self) -> Array:
        """Covariances (M, 2, 2) of the M adjusted image points, whitened by the a-priori covariances."""
        return self.equations.image_cofactors(self.covariance)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Input of the adjustment that stays constant during the iteration, with the methods that `reweighting` calls."""

    fields: Sequence[calibration_parameters.CalibrationField]
    cameras: Mapping[str, LineModel]
    parameters: calibration_parameters.Parameters
    noise: calibration_parameters.Noise
    shared: SharedNoise
    priors: tuple[calibration_parameters.Prior, ...]
    gauge: calibration_parameters.Gauge
    iterations: int
    estimated: frozenset[str] | None = None

    @cached_property
    def point_row(self) -> NDArray[np.intp]:
        """Index, among the ground points of all fields, of the point that each of M image points shows."""
        first = np.concatenate([[0], np.cumsum([len(f.ground) for f in self.fields])])
        return np.concatenate([a + r.point for a, f in zip(first, self.fields, strict=False) for r in f.rays.values()])

    def judged(self, state: _Iteration, solution: _Solved) -> tuple[Array, ...]:
        """Return the standardised residuals of the M image points of all fields, as a tuple of one array (M, 2)."""
        image = solution.equations.residuals.image
        return (
            reweighting.standardised_packets(image, solution.cofactors, state.weights.image, state.factor["image"]),
        )

    def tests(self, state: _Iteration, solution: _Solved) -> dict[str, reweighting.GroupTest]:
        """Return the chi-square test of the residuals of each variance group, by the name of the group."""
        return solution.equations.tests(solution.covariance, solution.cofactors, state.weights, self.priors)

    def weighed(self, state: _Iteration, weight: tuple[Array, ...], factor: Mapping[str, float]) -> _Iteration:
        """Return the state with new weights, rejecting tie points with fewer than two rays permanently."""
        control = np.concatenate([f.control for f in self.fields])
        rays = np.bincount(self.point_row[weight[0] > reweighting.SETTLED], minlength=len(control))
        lost = state.lost | (~control & (rays < 2))
        return replace(state, weights=Weights(np.where(lost[self.point_row], 0.0, weight[0]), factor), lost=lost)

    def equations(self, state: _Iteration, omitted: OmittedTerms | None = None) -> Equations:
        """Return the equations linearised at a state, optionally with omitted terms as further unknowns."""
        return assemble(
            self.fields,
            self.cameras,
            self.parameters,
            state.state,
            self.noise,
            self.priors,
            state.weights,
            self.shared,
            omitted,
        )

    @cached_property
    def ray(self) -> dict[str, float]:
        """Median standard deviation of a single image point due to each source of noise, in metres."""
        return single_ray(self.fields, self.cameras, self.noise)

    def solve(self, state: _Iteration, screening: bool = False) -> tuple[_Iteration, _Solved]:
        """Iterate Gauss-Newton steps with the weights of the state until convergence."""
        equations = self.equations(state)
        try:
            freedom = self.freedom(state, equations)
        except calibration_parameters.RankError as error:
            lost = int(np.sum(state.weights.image <= reweighting.SETTLED))
            if not lost:
                raise
            raise FarPointsError(
                f"calibration: robust weights reject {lost} of {len(state.weights.image)} image points, and the"
                " rest does not determine the unknowns: points and images contradict each other"
            ) from error
        estimated, rows = freedom.kept, freedom.rows
        start_precision = rows.T @ rows
        last = np.inf
        for _ in range(self.iterations):
            total = equations.reduced + start_precision
            right = equations.right + start_precision @ (state.state.values - self.parameters.start)
            step = np.zeros(len(right))
            step[estimated] = calibration_parameters.solved(total[np.ix_(estimated, estimated)], -right[estimated])
            size = float(np.sqrt(max(float(step @ total @ step), 0.0)))
            state = replace(state, state=state.state.moved(equations, step), steps=state.steps + 1)
            equations = self.equations(state)
            if size < _CONVERGED or (size < 1e3 * _CONVERGED and size > 0.5 * last):
                break
            last = size
        else:
            raise calibration_parameters.CalibrationError(
                f"calibration: no convergence in {self.iterations} steps, the last of {size:.3g} sigmas"
            )
        total = (equations.reduced + start_precision)[np.ix_(estimated, estimated)]
        spread = np.zeros(start_precision.shape)
        spread[np.ix_(estimated, estimated)] = calibration_parameters.solved(total, np.eye(len(estimated)))
        return state, _Solved(equations, 0.5 * (spread + spread.T))

    def freedom(self, state: _Iteration, equations: Equations) -> calibration_parameters.Freedom:
        """Return the estimable part of the unknowns, from the robust weights and the a-priori sigmas.

        With estimated variance factors, poorly fitting measurements would make combinations undetermined that they
        determine, and the factors could not decrease again.
        """
        if any(v != 1.0 for v in state.weights.factor.values()):
            weights = replace(state.weights, factor=dict.fromkeys(state.weights.factor, 1.0))
            equations = self.equations(replace(state, weights=weights))
        names, scale = self.parameters.names, self.parameters.scale
        # start values with sigmas by name are prior knowledge; one number for all only selects a solution
        specified = isinstance(self.gauge.start, Mapping)
        ray = float(np.linalg.norm(list(self.ray.values()))) if specified else np.inf
        prior_sigmas = {next(iter(p.weights)): p.sigma for p in self.priors if len(p.weights) == 1}
        return calibration_parameters.free_basis(
            equations.reduced, equations.length, scale, names, self.gauge, ray, prior_sigmas
        )

    def cause(self, error: calibration_parameters.RankError) -> calibration_parameters.CalibrationError:
        """Return the error of undetermined combinations, or that of the noise if the noise leaves them undetermined."""
        ray = float(np.linalg.norm(list(self.ray.values())))
        if ray < calibration_parameters.WORST:
            return error
        largest = max(self.ray, key=lambda group: self.ray[group])
        parts = ", ".join(f"{group} {1e6 * v:.3g}" for group, v in self.ray.items() if v)
        return NoiseError(
            f"calibration: noise too large: a single image point is uncertain by {1e6 * ray:.3g} um in the image"
            f" (one sigma; {parts}), more than what is to be estimated, {1e6 * calibration_parameters.WORST:g} um",
            largest,
        )

    def followed(self, equations: Equations, covariance: Array, held: Array) -> Array:
        """Return the derivatives of the P estimates with respect to start values of k fixed unknowns, (P, k).

        `held` holds a unit column for each fixed unknown, (P, k).
        """
        return np.asarray(held - covariance @ (equations.reduced @ held))

    def result(self, state: _Iteration, solution: _Solved, robust: reweighting.Robust | None) -> Adjustment:
        """Return the result of an adjustment from its final state and solution."""
        equations, covariance = solution.equations, solution.covariance
        names, scale = self.parameters.names, self.parameters.scale
        freedom = self.freedom(state, equations)
        rows = freedom.rows
        vectors = calibration_parameters.weak_vectors(
            equations.reduced + rows.T @ rows, equations.length, scale, np.eye(len(names))[:, freedom.kept]
        )
        (standard,) = self.judged(state, solution)
        tests = self.tests(state, solution)
        held = np.eye(len(names))[:, [calibration_parameters.index(names, n) for n in self.gauge.held]]
        follow = self.followed(equations, covariance, held)
        start_influence = rows @ covariance
        spread_all = np.diag(covariance).copy()
        prior_share = np.sum(start_influence**2, axis=0) / np.where(spread_all > 0, spread_all, 1.0)
        covariance_of_points = covariance
        if robust == "huber":
            covariance = covariance + covariance @ _scores(equations, standard, state.weights) @ covariance
        cuts = np.cumsum([len(f.ground) for f in self.fields])[:-1]
        spread = equations.point_covariance(covariance)
        spread[state.lost] = np.nan
        spreads, lost = np.split(spread, cuts), np.split(state.lost, cuts)
        used = int(np.sum(state.weights.image > 0))
        controls = sum(int(np.sum(f.control & np.any(f.covariance, axis=(1, 2)))) for f in self.fields)
        known = 2 * used + 3 * controls + len(self.priors) + len(rows)
        start_square = float(np.sum((rows @ (state.state.values - self.parameters.start)) ** 2))
        parts = self.parameters.parts

        def omitted_terms_test(terms: OmittedTerms) -> OmittedTermsTest:
            return OmittedTermsTest.of(terms, self.equations(state, terms), covariance_of_points)

        return Adjustment(
            names=names,
            values=state.state.values,
            covariance=covariance,
            gauge=self.gauge,
            open=freedom.opened,
            weak=calibration_parameters.combinations(names, scale, vectors, equations.reduced, equations.length),
            prior_share=prior_share,
            follow=follow,
            cameras={
                k: c.with_interior(parts(state.state.values, f.name, k, c)[0].interior)
                for f in self.fields
                for k, c in self.cameras.items()
                if k in f.rays
            },
            ground={
                f.name: np.where(rejected[:, None], np.nan, g)
                for f, g, rejected in zip(self.fields, state.state.grounds, lost, strict=True)
            },
            ground_covariance={f.name: s for f, s in zip(self.fields, spreads, strict=True)},
            residual=self._by_line(standard),
            weight=self._by_line(state.weights.image),
            chi_square=sum(test.square for test in tests.values()) + start_square,
            degrees_of_freedom=known - 3 * int(np.sum(equations.movable & ~state.lost)) - len(freedom.kept),
            factors=state.weights.factor,
            redundancy={g: test.redundancy for g, test in tests.items()},
            iterations=state.steps,
            fields=self.fields,
            omitted_terms_test=omitted_terms_test,
        )

    def _by_line(self, rows: Array) -> dict[str, dict[str, Array]]:
        """Return an array of all image points as a mapping by field and line camera."""
        sizes = [len(r.point) for f in self.fields for r in f.rays.values()]
        pieces = iter(np.split(rows, np.cumsum(sizes)[:-1]))
        return {f.name: {line: next(pieces) for line in f.rays} for f in self.fields}


def _scores(equations: Equations, standard: Array, weights: Weights) -> Array:
    """Return the covariance of the right side of the normal equations minus the normal matrix, (P, P).

    The two are equal for weights of 1 and differ with Huber's weights; P is the number of unknowns.

    An image point of weight w counts with the variance w in the normal matrix, as if it had that uncertainty. The
    actual variance of a gross error is the square of the limit, whatever its size (Huber 1981, asymptotic covariance).
    """
    size = np.linalg.norm(standard, axis=1)
    pull = 0.5 * np.minimum(size, reweighting.HUBER) ** 2 - weights.image
    rows = equations.through_points()
    return np.asarray(rows.T @ (np.repeat(pull / weights.factor["image"], 2)[:, None] * rows))
