"""Simultaneous adjustment of a three-line in-orbit calibration (paper 003): interior orientation and attitude biases.

Gauss-Newton on all image points of all fields, control coordinates and pseudo-observations; robust weights and variance
components are iterated around it. No solution is returned from a singular system: combinations that the points leave
open are named, and must be closed by a gauge or by priors.

Before an adjustment: do points lie where their image points look, and does a single image point tell anything?

Both faults else come out as combinations that the points cannot tell: robust weights give up points that are kilometres
off, and then too few are left; noise that is larger than what a launch changes leaves everything open.

What the residuals of an adjustment say of terms that the model leaves out.

A term g that moves the misclosures by G g and is not solved for leaves the estimates wrong by C N_xg g, with C their
covariance and N the normal matrix with g among the unknowns. What the residuals say of it is the gradient s at g = 0,
of covariance S = N_gg - N_gx C N_xg: the estimate is -S^-1 s, and s' S^-1 s is chi-square where there is no such term
and the sigmas are right (Lagrange multiplier test; Rao, Proc. Camb. Phil. Soc. 44 (1948) 50). S is the exact
covariance, so the test holds for six points as for six hundred.

Terms here: rates of the attitude during each field; slow courses along each line, cosines of the exposure time over the
time of the line, in x and in y, by which residuals of neighbouring exposures are alike; steps within a line.
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
"""False-alarm rate of each of the two tests of a run, rates and courses, over all fields together: 1e-4 a run."""
_WAVES = 4
_POINTS_PER_WAVE = 4
_RANK = 1e-9
"""Smallest eigenvalue of S that counts, relative to the largest. No residual shows a term that the unknowns imitate."""


@dataclass(frozen=True, eq=False)
class Rates:
    """A drift of the attitude during each field, radians per second about the body's axes, zero at its mean time.

    middles: field -> mean time of its rays, seconds; fields without times are left out.
    """

    middles: Mapping[str, float]

    @classmethod
    def of(cls, fields: Sequence[calibration_parameters.CalibrationField]) -> Rates:
        """Rates of all fields whose rays have times."""
        times = {f.name: [r.time for r in f.rays.values() if r.time is not None and r.point.size] for f in fields}
        return cls({name: float(np.mean(np.concatenate(rows))) for name, rows in times.items() if rows})

    @property
    def size(self) -> int:
        """Number of terms."""
        return 3 * len(self.middles)

    def columns(self, field: calibration_parameters.CalibrationField, line: str, rays: Rays, by: Partials) -> Array:
        """(n, 2, size) derivatives of the misclosures.

        Parameters
        ----------
        field : calibration_parameters.CalibrationField
            The pass.
        line : str
            Of the camera.
        rays : Rays
            n image points of it.
        by : Partials
            Derivatives of their misclosures.
        """
        found = np.zeros((len(rays.point), 2, self.size))
        if rays.time is not None and field.name in self.middles:
            first = 3 * list(self.middles).index(field.name)
            since = (rays.time - self.middles[field.name])[:, None, None]
            found[:, :, first : first + 3] = by.attitude * since
        return found


@dataclass(frozen=True, eq=False)
class Courses:
    """Slow courses of x and y along the time of each line of each field, metres in the image: cosines of up to four
    half periods, the constant apart.

    waves: (field, line) -> (begin, duration, number of the first term, how many of each of x and y).
    """

    waves: Mapping[tuple[str, str], tuple[float, float, int, int]]

    @classmethod
    def of(cls, fields: Sequence[calibration_parameters.CalibrationField]) -> Courses:
        """Courses of all lines with times and enough points."""
        found: dict[tuple[str, str], tuple[float, float, int, int]] = {}
        first = 0
        for one in fields:
            for line, rays in one.rays.items():
                if rays.time is None or not rays.point.size or not np.ptp(rays.time):
                    continue
                count = min(_WAVES, len(rays.point) // _POINTS_PER_WAVE)
                if count:
                    found[one.name, line] = (float(rays.time.min()), float(np.ptp(rays.time)), first, count)
                    first += 2 * count
        return cls(found)

    @property
    def size(self) -> int:
        """Number of terms."""
        return sum(2 * count for *_, count in self.waves.values())

    def columns(self, field: calibration_parameters.CalibrationField, line: str, rays: Rays, by: Partials) -> Array:
        """(n, 2, size) derivatives of the misclosures.

        Parameters
        ----------
        field : calibration_parameters.CalibrationField
            The pass.
        line : str
            Of the camera.
        rays : Rays
            n image points of it.
        by : Partials
            Derivatives of their misclosures.
        """
        found = np.zeros((len(rays.point), 2, self.size))
        if (field.name, line) in self.waves and rays.time is not None:
            begin, span, first, count = self.waves[field.name, line]
            wave = np.cos(np.pi * np.arange(1, count + 1) * (rays.time[:, None] - begin) / span)
            found[:, 0, first : first + count] = wave
            found[:, 1, first + count : first + 2 * count] = wave
        return found


@dataclass(frozen=True, eq=False)
class Steps:
    """A step of x and of y within a line, metres: all image points beyond a place of the line are displaced.

    places: (line, y of the place in metres).
    """

    places: tuple[tuple[str, float], ...]

    @property
    def size(self) -> int:
        """Number of terms."""
        return 2 * len(self.places)

    def columns(self, field: calibration_parameters.CalibrationField, line: str, rays: Rays, by: Partials) -> Array:
        """(n, 2, size) derivatives of the misclosures: an image point displaced by 1 m has one that is 1 m larger.

        Parameters
        ----------
        field : calibration_parameters.CalibrationField
            The pass.
        line : str
            Of the camera.
        rays : Rays
            n image points of it.
        by : Partials
            Derivatives of their misclosures.
        """
        found = np.zeros((len(rays.point), 2, self.size))
        for k, (name, place) in enumerate(self.places):
            if name == line:
                beyond = rays.image[:, 1] > place
                found[beyond, 0, 2 * k] = found[beyond, 1, 2 * k + 1] = -1.0
        return found


HiddenTerms = Rates | Courses | Steps


@dataclass(frozen=True, eq=False)
class Unseen:
    """What the residuals say of terms that are left out.

    Attributes
    ----------
    terms : HiddenTerms
        Which, G of them.
    score : Array
        (G,) gradient. cofactor: (G, G) its covariance, S.
    moved : Array
        (P, G) by how much the estimates are wrong for a term of one unit.
    """

    terms: HiddenTerms
    score: Array
    cofactor: Array
    moved: Array

    @classmethod
    def of(cls, terms: HiddenTerms, wide: Equations, covariance: Array) -> Unseen:
        """Read equations that contain the terms, at a solution.

        Parameters
        ----------
        terms : HiddenTerms
            G of them.
        wide : Equations
            Equations of P unknowns and the G terms, which are zero.
        covariance : Array
            Of the P unknowns, (P, P), SI.
        """
        count = len(covariance)
        moved = covariance @ wide.reduced[:count, count:]
        cofactor = wide.reduced[count:, count:] - wide.reduced[count:, :count] @ moved
        return cls(terms, wide.right[count:], 0.5 * (cofactor + cofactor.T), moved)

    @property
    def estimate(self) -> Array:
        """(G,) all terms together; a term that nothing tells is zero."""
        return np.asarray(-self._inverse @ self.score)

    @property
    def sigma(self) -> Array:
        """(G,) of `estimate`; infinite where nothing tells a term."""
        spread = np.diag(self._inverse)
        return np.sqrt(np.where(np.diag(self.cofactor) > _RANK * self._largest, spread, np.inf))

    @property
    def sigma_alone(self) -> Array:
        """(G,) of each term where there is no other."""
        own = np.diag(self.cofactor)
        seen = own > _RANK * self._largest
        return np.asarray(np.where(seen, 1.0 / np.sqrt(np.where(seen, own, 1.0)), np.inf))

    @property
    def degrees_of_freedom(self) -> int:
        """Number of combinations of the terms that the residuals can show."""
        return int(np.linalg.matrix_rank(self._unit, tol=1e-6, hermitian=True)) if len(self.score) else 0

    @property
    def chi_square(self) -> float:
        """Chi-square of all terms together."""
        return float(self.score @ self._inverse @ self.score) if len(self.score) else 0.0

    @property
    def p_value(self) -> float:
        """Chance of such a chi-square where none of these terms is there; 1 where residuals show none."""
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)

    @property
    def _largest(self) -> float:
        return float(np.diag(self.cofactor).max(initial=0.0))

    @property
    def _size(self) -> Array:
        return np.asarray(np.sqrt(np.maximum(np.diag(self.cofactor), 1e-300)))

    @property
    def _unit(self) -> Array:
        return np.asarray(self.cofactor / self._size / self._size[:, None])

    @property
    def _inverse(self) -> Array:
        inner = np.linalg.pinv(self._unit, rcond=1e-6, hermitian=True)
        return np.asarray(inner / self._size / self._size[:, None])


FARTHEST = 2e3
"""Metres on the ground. No launch, no datum moves half of the points farther: an arc minute is 150 m, a second of a
clock 7 km."""
_EXPECTED = 20.0
"""Sigmas of the start values; points that are farther off than these say are not what was photographed."""


class FarPointsError(calibration_parameters.CalibrationError):
    """Points lie kilometres from where their image points look, or contradict each other beyond repair."""


class NoiseError(calibration_parameters.CalibrationError):
    """A single image point is as uncertain as what is to be found. largest: the source that is most of it, "image",
    "attitude", "slow attitude", "station" or "control".
    """

    def __init__(self, message: str, largest: str) -> None:
        super().__init__(message)
        self.largest = largest


def single_ray(
    fields: Sequence[calibration_parameters.CalibrationField],
    cameras: Mapping[str, LineModel],
    noise: calibration_parameters.Noise,
) -> dict[str, float]:
    """Source -> standard deviation of one image point in x or y, metres, median of all: each source of noise alone.

    Parameters
    ----------
    fields : Sequence[calibration_parameters.CalibrationField]
        Their rays.
    cameras : Mapping[str, LineModel]
        Line -> camera at the start values.
    noise : calibration_parameters.Noise
        Of image, attitude and station.
    """
    alone = {"image": replace(noise, attitude=0.0, station=0.0, slow_attitude=0.0)}
    tiny = 1e-6 * noise.image
    for term in noise.terms:
        key = term.group.replace(" ", "_")
        alone[term.group] = replace(alone["image"], image=tiny, **{key: term.sigma})
    found: dict[str, list[Array]] = {group: [] for group in alone}
    found["control"] = []
    for one in fields:
        for line, rays in one.rays.items():
            by = partials(cameras[line], rays, one.ground[rays.point], np.zeros(3), np.zeros(3))
            for group, part in alone.items():
                found[group].append(_mean_square(ray_covariance(part, rays, by, shared=True)))
            given = np.where(one.control[:, None, None], one.covariance, 0.0)[rays.point]
            found["control"].append(_mean_square(by.ground @ given @ np.swapaxes(by.ground, 1, 2)))
    return {group: float(np.sqrt(np.median(np.concatenate(rows)))) for group, rows in found.items()}


def check_places(
    fields: Sequence[calibration_parameters.CalibrationField],
    cameras: Mapping[str, LineModel],
    start: Mapping[str, float] | None = None,
) -> None:
    """Do control points lie where their image points look, by the start values?

    Parameters
    ----------
    fields : Sequence[calibration_parameters.CalibrationField]
        With their control points.
    cameras : Mapping[str, LineModel]
        Line -> camera at the start values.
    start : Mapping[str, float] | None
        Name -> sigma of a start value, metres or radians; None where nothing is said.

    Raises
    ------
    FarPointsError
        Half of a field's control points lie farther off than `FARTHEST`, and than 20 sigmas of the start values.
    """
    for one in fields:
        far, expected = [], []
        for line, rays in one.rays.items():
            some = rays.taken(one.control[rays.point])
            if not some.point.size:
                continue
            camera, ground = cameras[line], one.ground[some.point]
            distance = np.linalg.norm(ground - some.station, axis=1) / float(camera.principal_distance)
            miss = misclosure(camera, some, ground, np.zeros(3), np.zeros(3))
            far.append(distance * np.linalg.norm(miss, axis=1))
            told = [(start or {}).get(f"{one.name} {n}", 0.0) * float(camera.principal_distance) for n in BIAS[:2]]
            told += [(start or {}).get(f"{line} {n}", 0.0) for n in INTERIOR[1:]]
            expected.append(distance * float(np.linalg.norm(told)))
        if not far:
            continue
        median, limit = float(np.median(np.concatenate(far))), float(np.median(np.concatenate(expected)))
        if median > max(FARTHEST, _EXPECTED * limit):
            raise FarPointsError(
                f"calibration: half of the control points of {one.name} lie {median / 1e3:.3g} km or more from where"
                f" their image points look by the start values, where {limit / 1e3:.2g} km are expected (one sigma)"
            )


def _mean_square(covariance: Array) -> Array:
    """(n,) of the two axes of (n, 2, 2)."""
    return np.asarray(0.5 * np.trace(covariance, axis1=1, axis2=2))


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Solution of a calibration.

    Attributes
    ----------
    names : tuple[str, ...]
        Of the unknowns. values: (P,) metres and radians. covariance: (P, P) from the sigmas as given times `factors`,
        and of the start values where these close what is open. Held unknowns count as exact: zero rows.
    gauge : calibration_parameters.Gauge
        What was fixed. open: combinations that the gauge closed. weak: combinations of low strength that were solved
        for all the same.
    from_start : Array
        (P,) share of each variance that comes from the start values and not from the points, 0 to 1.
    follow : Array
        (P, H) change of the values with the start values of the H held unknowns.
    cameras : Mapping[str, LineModel]
        With the adjusted interior, in the reference state.
    ground : Mapping[str, Array]
        Field -> (m, 3) adjusted points; NaN for those that robust weights gave up. ground_covariance: field -> (m, 3,
        3), likewise.
    residual : Mapping[str, Mapping[str, Array]]
        Field -> line -> (n, 2) standardised residuals of image points. weight: field -> line -> (n,) robust.
    chi_square, degrees_of_freedom : float
        Weighted, points left out do not count.
    factors : Mapping[str, float]
        Variance group -> estimated factor (1 where not estimated). redundancy: of each group. Noise that image points
        share is a group of its own.
    iterations : int
        Gauss-Newton steps in all.
    fields : Sequence[calibration_parameters.CalibrationField]
        That were adjusted.
    unseen : Callable[[HiddenTerms], Unseen]
        What the residuals say of terms that are left out.
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
    unseen: Callable[[HiddenTerms], Unseen] = field(repr=False)

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviation of each unknown; 0 where held."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @cached_property
    def rates(self) -> Unseen | None:
        """What the residuals say of a drift of the attitude during each field; None where a rate is an unknown."""
        return None if any(n.endswith("rate") for n in self.names) else self.unseen(Rates.of(self.fields))

    @cached_property
    def courses(self) -> Unseen:
        """What they say of errors that change slowly along the lines."""
        return self.unseen(Courses.of(self.fields))

    def sigma_with(self, start: Mapping[str, float]) -> dict[str, float]:
        """Standard deviation of each unknown where held unknowns are not exact: name -> sigma of its start value.

        Raises CalibrationError for a name that is not held.
        """
        given = np.zeros(len(self.gauge.held))
        for name, sigma in start.items():
            given[calibration_parameters.index(self.gauge.held, name)] = sigma
        hidden = np.sum((self.follow * given) ** 2, axis=1)
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance) + hidden).tolist(), strict=True))

    @property
    def correlation(self) -> Array:
        """(P, P); rows of held unknowns are NaN."""
        sigma = np.sqrt(np.diag(self.covariance))
        with np.errstate(invalid="ignore"):
            return np.asarray(self.covariance / sigma / sigma[:, None])

    @property
    def p_value(self) -> float:
        """Chance of such a chi-square or a larger one, if the sigmas are right and no robust weights are on."""
        return statistics.p_value(self.chi_square, self.degrees_of_freedom)

    def value(self, name: str) -> float:
        """One unknown. Raises CalibrationError when there is none of that name."""
        return float(self.values[calibration_parameters.index(self.names, name)])

    def bias(self, field: str) -> Array:
        """(3,) roll, pitch, yaw of a field, radians."""
        return np.array([self.value(f"{field} {n}") for n in BIAS])

    def cameras_of(self, field: str) -> dict[str, LineModel]:
        """Cameras in their state during one field: adjusted interior and, where solved for, drift."""
        found = {}
        for line, camera in self.cameras.items():
            names = [f"{field} {line} {n}" for n in DRIFT]
            drift = names[0] in self.names
            found[line] = camera.drifted([self.value(n) for n in names]) if drift else camera
        return found


# A step of this many sigmas ends the iteration, and so does one that rounding keeps from falling further.
_CONVERGED = 1e-6
_HUBER_ROUNDS = 6


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
    """Adjust everything at once.

    Parameters
    ----------
    fields : Sequence[calibration_parameters.CalibrationField]
        Passes over fields of points.
    cameras : Mapping[str, LineModel]
        Line -> mounting, distortion and start values of the interior.
    noise : calibration_parameters.Noise
        Of image, attitude and station.
    unknowns : calibration_parameters.Unknowns | None
        What is solved for beside the interior and one bias for each field.
    start : Mapping[str, float] | None
        Values by name where not the cameras' interior and zero.
    priors : Sequence[calibration_parameters.Prior]
        Pseudo-observations, for example of an on-board monitor of the cameras.
    gauge : calibration_parameters.Gauge | None
        How open combinations are closed.
    robust : reweighting.Robust | None
        "huber" takes weight from image points with large residuals, "igg" leaves the worst out, and with them points
        without coordinates that fewer than two rays are left of.
    variance_components : bool | Collection[str]
        Estimate a factor on the variances of "image", "control", each group of priors and, where image points share
        them, "attitude", "slow attitude" and "station", within a hundredth and a hundred. With robust weights they come
        from image points within the limit of "igg", all of full weight, which are found with the noise of the image by
        the median of its residuals; the robust weights then use these factors. Names of groups: of these alone.
    iterations : int
        Most Gauss-Newton steps of one round.

    Raises
    ------
    RankError
        Open combinations that nothing closes.
    NoiseError
        a single image point is more uncertain than all that start values leave open.
    FarPointsError
        Points that are not what was photographed, or that contradict each other.
    CalibrationError
        Other input that cannot be used, fewer observations than unknowns, no convergence.
    """
    noise.check()
    if robust not in (None, "huber", "igg"):
        raise calibration_parameters.CalibrationError(f"calibration: robust must be huber or igg, found {robust!r}")
    parameters = calibration_parameters.Parameters.of(
        fields, cameras, unknowns or calibration_parameters.Unknowns(), start
    )
    gauge = gauge or calibration_parameters.Gauge()
    shared = SharedNoise.of(fields, noise)
    none = np.zeros(sum(len(f.ground) for f in fields), bool)
    estimated = None if isinstance(variance_components, bool) else frozenset(variance_components)
    problem = _Problem(fields, cameras, parameters, noise, shared, tuple(priors), gauge, iterations, estimated)
    groups = ("image", "control", *shared.groups, *dict.fromkeys(p.group for p in priors))
    count = sum(len(r.point) for f in fields for r in f.rays.values())
    if 2 * count < len(parameters.names) - len(gauge.held) - len(priors):
        raise calibration_parameters.CalibrationError(
            f"calibration: {count} image points are too few for {len(parameters.names) - len(gauge.held)} unknowns"
        )
    check_places(fields, cameras, gauge.start if isinstance(gauge.start, Mapping) else None)
    start_state = State(parameters.start, tuple(f.ground for f in fields), np.zeros(shared.size))
    state = _Iteration(start_state, Weights(np.ones(count), dict.fromkeys(groups, 1.0)), 0, none)
    try:
        return _adjusted(problem, state, robust, bool(variance_components))
    except calibration_parameters.RankError as error:
        raise problem.cause(error) from error
    except reweighting.UnsettledError as error:
        raise calibration_parameters.CalibrationError(f"calibration: {error}") from error


def _adjusted(
    problem: _Problem, at: _Iteration, robust: reweighting.Robust | None, variance_components: bool
) -> Adjustment:
    """Solve with weights and factors that have come to rest."""
    if robust and variance_components:
        # Gross errors are found against the scatter of the others first. Variance components then need good points of
        # full weight: weights that fall with the residual would pass for smaller noise.
        found, _ = reweighting.settled(problem, at, reweighting.Rule("huber", "median", tolerance=0.05))
        found, _ = reweighting.settled(problem, found, reweighting.Rule("accept", "components", problem.estimated))
        at = replace(at, weights=replace(at.weights, factor=found.factor), steps=found.steps)
    elif variance_components:
        return problem.result(
            *reweighting.settled(problem, at, reweighting.Rule(None, "components", problem.estimated)), None
        )
    screening = _HUBER_ROUNDS if robust == "igg" else 0
    return problem.result(*reweighting.settled(problem, at, reweighting.Rule(robust, screening=screening)), robust)


@dataclass(frozen=True, eq=False)
class _Iteration:
    """Where the iteration stands, its weights, Gauss-Newton steps so far, which points were given up, for good."""

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
    """Equations at a solution, and the covariance (P, P) of the unknowns."""

    equations: Equations
    covariance: Array

    @cached_property
    def cofactors(self) -> Array:
        """(M, 2, 2) of the adjusted image points."""
        return self.equations.image_cofactors(self.covariance)


@dataclass(frozen=True, eq=False)
class _Problem:
    """What does not change while the iteration goes on."""

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
    def place(self) -> NDArray[np.intp]:
        """(M,) point, of those of all fields, that each image point shows."""
        first = np.concatenate([[0], np.cumsum([len(f.ground) for f in self.fields])])
        return np.concatenate([a + r.point for a, f in zip(first, self.fields, strict=False) for r in f.rays.values()])

    def judged(self, at: _Iteration, found: _Solved) -> tuple[Array, ...]:
        """(M, 2) standardised residuals of the image points."""
        image = found.equations.residuals.image
        return (reweighting.standardised_packets(image, found.cofactors, at.weights.image, at.factor["image"]),)

    def tests(self, at: _Iteration, found: _Solved) -> dict[str, reweighting.GroupTest]:
        """Variance groups."""
        return found.equations.tests(found.covariance, found.cofactors, at.weights, self.priors)

    def weighed(self, at: _Iteration, weight: tuple[Array, ...], factor: Mapping[str, float]) -> _Iteration:
        """Points without coordinates and with fewer than two rays of any weight are given up, for good."""
        control = np.concatenate([f.control for f in self.fields])
        rays = np.bincount(self.place[weight[0] > reweighting.SETTLED], minlength=len(control))
        lost = at.lost | (~control & (rays < 2))
        return replace(at, weights=Weights(np.where(lost[self.place], 0.0, weight[0]), factor), lost=lost)

    def equations(self, at: _Iteration, hidden: HiddenTerms | None = None) -> Equations:
        return assemble(
            self.fields,
            self.cameras,
            self.parameters,
            at.state,
            self.noise,
            self.priors,
            at.weights,
            self.shared,
            hidden,
        )

    @cached_property
    def ray(self) -> dict[str, float]:
        """Source of noise -> of a single image point, metres."""
        return single_ray(self.fields, self.cameras, self.noise)

    def solve(self, state: _Iteration, screening: bool = False) -> tuple[_Iteration, _Solved]:
        """Gauss-Newton with the weights of the state, to the end in any case."""
        equations = self.equations(state)
        try:
            freedom = self.freedom(state, equations)
        except calibration_parameters.RankError as error:
            lost = int(np.sum(state.weights.image <= reweighting.SETTLED))
            if not lost:
                raise
            raise FarPointsError(
                f"calibration: robust weights give up {lost} of {len(state.weights.image)} image points, and what is"
                " left does not determine the unknowns: points and images contradict each other"
            ) from error
        kept, rows = freedom.kept, freedom.rows
        pull = rows.T @ rows
        last = np.inf
        for _ in range(self.iterations):
            total = equations.reduced + pull
            right = equations.right + pull @ (state.state.values - self.parameters.start)
            step = np.zeros(len(right))
            step[kept] = calibration_parameters.solved(total[np.ix_(kept, kept)], -right[kept])
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
        total = (equations.reduced + pull)[np.ix_(kept, kept)]
        spread = np.zeros(pull.shape)
        spread[np.ix_(kept, kept)] = calibration_parameters.solved(total, np.eye(len(kept)))
        return state, _Solved(equations, 0.5 * (spread + spread.T))

    def freedom(self, state: _Iteration, equations: Equations) -> calibration_parameters.Freedom:
        """What may be solved for: by the robust weights, but the sigmas as they were given.

        Misfit of the measurements would else open what they determine, and then cannot shrink any more.
        """
        if any(v != 1.0 for v in state.weights.factor.values()):
            given = replace(state.weights, factor=dict.fromkeys(state.weights.factor, 1.0))
            equations = self.equations(replace(state, weights=given))
        names, scale = self.parameters.names, self.parameters.scale
        # start values that are known by name are knowledge of a launch; one number for all only chooses a solution
        stated = isinstance(self.gauge.start, Mapping)
        ray = float(np.linalg.norm(list(self.ray.values()))) if stated else np.inf
        told = {next(iter(p.weights)): p.sigma for p in self.priors if len(p.weights) == 1}
        return calibration_parameters.free_basis(
            equations.reduced, equations.length, scale, names, self.gauge, ray, told
        )

    def cause(self, error: calibration_parameters.RankError) -> calibration_parameters.CalibrationError:
        """The error of open combinations, or that of the noise where this leaves them open."""
        ray = float(np.linalg.norm(list(self.ray.values())))
        if ray < calibration_parameters.WORST:
            return error
        largest = max(self.ray, key=lambda group: self.ray[group])
        parts = ", ".join(f"{group} {1e6 * v:.3g}" for group, v in self.ray.items() if v)
        return NoiseError(
            f"calibration: noise too large: a single image point is uncertain by {1e6 * ray:.3g} um in the image"
            f" (one sigma; {parts}), more than what is to be found, {1e6 * calibration_parameters.WORST:g} um",
            largest,
        )

    def followed(self, equations: Equations, covariance: Array, held: Array) -> Array:
        """(P, k) change of the values with start values of held unknowns, `held` (P, k) columns of ones."""
        return np.asarray(held - covariance @ (equations.reduced @ held))

    def result(self, state: _Iteration, found: _Solved, robust: reweighting.Robust | None) -> Adjustment:
        equations, covariance = found.equations, found.covariance
        names, scale = self.parameters.names, self.parameters.scale
        freedom = self.freedom(state, equations)
        rows = freedom.rows
        vectors = calibration_parameters.weak_vectors(
            equations.reduced + rows.T @ rows, equations.length, scale, np.eye(len(names))[:, freedom.kept]
        )
        (standard,) = self.judged(state, found)
        tests = self.tests(state, found)
        held = np.eye(len(names))[:, [calibration_parameters.index(names, n) for n in self.gauge.held]]
        follow = self.followed(equations, covariance, held)
        pulled = rows @ covariance
        spread_all = np.diag(covariance).copy()
        prior_share = np.sum(pulled**2, axis=0) / np.where(spread_all > 0, spread_all, 1.0)
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
        pulled_square = float(np.sum((rows @ (state.state.values - self.parameters.start)) ** 2))
        parts = self.parameters.parts

        def unseen(terms: HiddenTerms) -> Unseen:
            return Unseen.of(terms, self.equations(state, terms), covariance_of_points)

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
                f.name: np.where(gone[:, None], np.nan, g)
                for f, g, gone in zip(self.fields, state.state.grounds, lost, strict=True)
            },
            ground_covariance={f.name: s for f, s in zip(self.fields, spreads, strict=True)},
            residual=self._by_line(standard),
            weight=self._by_line(state.weights.image),
            chi_square=sum(one.square for one in tests.values()) + pulled_square,
            degrees_of_freedom=known - 3 * int(np.sum(equations.movable & ~state.lost)) - len(freedom.kept),
            factors=state.weights.factor,
            redundancy={g: one.redundancy for g, one in tests.items()},
            iterations=state.steps,
            fields=self.fields,
            unseen=unseen,
        )

    def _by_line(self, rows: Array) -> dict[str, dict[str, Array]]:
        sizes = [len(r.point) for f in self.fields for r in f.rays.values()]
        pieces = iter(np.split(rows, np.cumsum(sizes)[:-1]))
        return {f.name: {line: next(pieces) for line in f.rays} for f in self.fields}


def _scores(equations: Equations, standard: Array, weights: Weights) -> Array:
    """(P, P) what the normal matrix lacks of the variance of the right side with Huber's weights.

    An image point of weight w counts with the variance w in the normal matrix, as if it were as uncertain as that. What
    a gross error really does is the square of the limit, whatever its size (Huber 1981, asymptotic covariance).
    """
    size = np.linalg.norm(standard, axis=1)
    pull = 0.5 * np.minimum(size, reweighting.HUBER) ** 2 - weights.image
    rows = equations.through_points()
    return np.asarray(rows.T @ (np.repeat(pull / weights.factor["image"], 2)[:, None] * rows))
