"""Courses drawn from stated disturbances with their laws in time, traced, measured and smoothed: chi-square of the
series, and sigmas that hold.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from analysis.monitor.disturbances import Disturbances
from analysis.monitor.series_smoother import SmoothedSeries, smooth_series
from optics.geometry.tree import State
from scenes.models.disturbances import state_of
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.truth import trace_truth

FALSE_ALARM = 1e-6
"""Of each check."""
NOISE = 8e-4
"""Px, of a spot in nine frames."""
MINUTES = 60.0


def drawn(stated: Disturbances, times: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(T, M) motions in standard deviations, one course."""
    out = np.empty((len(times), len(stated.labels)))
    for law in dict.fromkeys(stated.laws):
        own = np.array([one == law for one in stated.laws])
        values, vectors = np.linalg.eigh(law.covariance(times[:, None], times))
        along = vectors * np.sqrt(np.clip(values, 0.0, None))
        together = np.linalg.cholesky(stated.correlation[np.ix_(own, own)] + 1e-12 * np.eye(own.sum()))
        out[:, own] = along @ rng.standard_normal((len(times), own.sum())) @ together.T
    return out


@dataclass(frozen=True, eq=False)
class White:
    """Noise of each measurement and of the reference image, alike for all spots."""

    width: int

    def covariance(self, images: np.ndarray) -> np.ndarray:
        time = NOISE**2 * (np.eye(len(images)) + 1.0)
        return np.kron(time, np.eye(self.width))


@dataclass(frozen=True, eq=False)
class Courses:
    """N courses of T times, measured at some of them.

    Attributes:
        experiment: the instrument.
        times: (T,) seconds; at: numbers of those that are measured.
        truth: (N, T, 8) true parameters; height: (N, T) true errors of heights without correction, metres.
        shifts: (N, M, 8) px.
        noise: of each course.
    """

    experiment: MonitorExperiment
    times: np.ndarray
    at: np.ndarray
    truth: np.ndarray
    height: np.ndarray
    shifts: np.ndarray
    noise: Sequence[White]

    @property
    def stated(self) -> Disturbances:
        found = self.experiment.disturbances
        assert found is not None
        return found

    @cached_property
    def smoothed(self) -> list[SmoothedSeries]:
        return [
            smooth_series(self.stated, self.times[self.at], shifts, noise, self.times)
            for shifts, noise in zip(self.shifts, self.noise, strict=True)
        ]

    @cached_property
    def row(self) -> np.ndarray:
        """(8,) height at the middle of the line by changes."""
        geometry = self.experiment.ground
        assert geometry is not None
        first, second = (camera.geometry.principal_distance_m for camera in self.experiment.cameras.values())
        rows = geometry.rows((first, second))
        return np.asarray(rows[len(rows) // 2, 2])

    def left(self, values: np.ndarray) -> np.ndarray:
        """(N, T) error of heights that are corrected by values (N, T, 8), metres."""
        return np.asarray(values @ self.row - self.height)

    def values(self, name: str) -> np.ndarray:
        return np.array([getattr(one, name).values for one in self.smoothed])

    def sigma(self, name: str) -> np.ndarray:
        return np.sqrt(np.array([np.diagonal(getattr(one, name).total, 0, 1, 2) for one in self.smoothed]))

    def height_sigma(self, name: str) -> np.ndarray:
        total = np.array([getattr(one, name).total for one in self.smoothed])
        return np.sqrt(np.einsum("i,ntij,j->nt", self.row, total, self.row))


def states_of(experiment: MonitorExperiment, times: np.ndarray, count: int, seed: int) -> list[State]:
    stated, motions = experiment.disturbances, experiment.prior
    assert stated is not None
    assert motions is not None
    rng = np.random.default_rng(seed)
    amounts = np.concatenate([drawn(stated, times, rng) for _ in range(count)]) * motions.sigma
    return [state_of(row, motions.components, experiment.thermal) for row in amounts]


def truths(experiment: MonitorExperiment, states: list[State], count: int) -> tuple[np.ndarray, np.ndarray]:
    geometry = experiment.ground
    assert geometry is not None
    truth = trace_truth(experiment.instrument, experiment.backend, states)
    values = [np.stack([c.d_alpha, c.d_beta, c.d_gamma, c.d_f], axis=-1) for c in truth.cameras.values()]
    height = truth.ground_error(geometry)[:, 2]
    return np.concatenate(values, axis=1).reshape(count, -1, 8), height.reshape(count, -1)


def traced(experiment: MonitorExperiment, times: np.ndarray, at: np.ndarray, count: int, seed: int) -> Courses:
    """Spots by the trace of the light, with noise drawn."""
    states = states_of(experiment, times, count, seed)
    truth, height = truths(experiment, states, count)
    seen = [states[n * len(times) + k] for n in range(count) for k in at]
    place = np.moveaxis(experiment.path.coarse_trace([{}, *seen]).centre, 1, 0)
    shifts = (place[1:] - place[0]).reshape(count, len(at), -1)
    rng = np.random.default_rng(seed + 1)
    shifts = shifts + NOISE * (rng.standard_normal(shifts.shape) + rng.standard_normal((count, 1, shifts.shape[2])))
    return Courses(experiment, times, at, truth, height, shifts, [White(shifts.shape[2])] * count)


def check_chi_square(courses: Courses) -> None:
    """Of all courses together, and its distribution over them."""
    found = [one.consistency for one in courses.smoothed]
    total, degrees = sum(one.chi_square for one in found), sum(one.degrees for one in found)
    low, high = chi2.ppf(0.5 * FALSE_ALARM, degrees), chi2.isf(0.5 * FALSE_ALARM, degrees)
    assert low < total < high, (total, degrees)
    chances = [one.p_value for one in found]
    assert kstest(chances, "uniform").pvalue > FALSE_ALARM


def check_sigmas(courses: Courses) -> None:
    """Errors over their sigma, of every parameter and of the height at every time: courses are independent."""
    count = len(courses.truth)
    for name in ("filtered", "smoothed"):
        errors = (courses.values(name) - courses.truth) / courses.sigma(name)
        heights = courses.left(courses.values(name)) / courses.height_sigma(name)
        every = np.concatenate([errors, heights[..., None]], axis=2)
        squares = np.sum(every**2, axis=0)
        one = 0.5 * FALSE_ALARM / squares.size
        assert squares.min() > chi2.ppf(one, count), name
        assert squares.max() < chi2.isf(one, count), name


TIMES = MINUTES * np.arange(0.0, 101.0, 10.0)


@pytest.mark.second
def test_a_few_courses(experiment) -> None:
    """Twelve courses over half an orbit."""
    courses = traced(experiment("gf7_pair"), TIMES[:5], np.array([0, 2, 4]), 12, 1)
    check_chi_square(courses)
    check_sigmas(courses)
