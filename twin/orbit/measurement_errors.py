"""Errors of the measured orbit and attitude as functions of time.

Readings come at a fixed interval. What depends on chance is drawn for every reading of the span beforehand and joined
by a cubic spline, as a user of the data would interpolate them: at a reading the error has the stated deviation,
halfway between two it is somewhat smaller. Each term draws from a random stream of its own, so that leaving one out
does not change the others.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

if TYPE_CHECKING:
    from scenes.orbit_spec import ErrorsSpec

TERMS = (
    "gps_noise",
    "gps_drift",
    "gps_velocity",
    "attitude_noise",
    "attitude_bias",
    "attitude_thermal",
    "attitude_slow",
)
"""All that can be switched."""

_SPARE_READINGS = 8
"""Beyond either end of the span, so that the spline's ends do not matter."""

Series = Callable[[np.ndarray], np.ndarray]


def readings(first: float, last: float, interval: float) -> np.ndarray:
    """Times (K,) of readings, seconds: whole multiples of the interval that cover the span, with some to spare."""
    begin, end = np.floor(first / interval) - _SPARE_READINGS, np.ceil(last / interval) + _SPARE_READINGS
    return np.asarray(interval * np.arange(begin, end + 1.0))


def _noise(time: np.ndarray, sigma: np.ndarray, seed: np.random.SeedSequence) -> Series:
    return CubicSpline(time, sigma * np.random.default_rng(seed).standard_normal((time.size, 3)))


def _drift(time: np.ndarray, sigma: np.ndarray, correlation_time: float, seed: np.random.SeedSequence) -> Series:
    """A stationary first-order Gauss-Markov process: correlation exp(-|dt| / correlation_time), exact at readings."""
    draws = np.random.default_rng(seed).standard_normal((time.size, 3))
    kept = np.exp(-(time[1] - time[0]) / correlation_time)
    draws[1:] *= np.sqrt(1.0 - kept * kept)
    return CubicSpline(time, sigma * lfilter([1.0], [1.0, -kept], draws, axis=0))


@dataclass(frozen=True, eq=False)
class MeasurementErrors:
    """Errors, measured minus true; made by `draw_errors`.

    Attributes:
        position_terms: series of position errors in the orbital frame, metres.
        velocity_terms: series of velocity errors in the orbital frame, m/s.
        attitude_terms: series of rotation vectors in body axes, radians.
        bias: constant rotation vector in body axes, radians, shape (3,).
        thermal: amplitude of what changes with latitude, radians, shape (3,).
        reference: latitude at which that vanishes, radians.
    """

    position_terms: tuple[Series, ...]
    velocity_terms: tuple[Series, ...]
    attitude_terms: tuple[Series, ...]
    bias: np.ndarray
    thermal: np.ndarray
    reference: float

    def position(self, seconds: np.ndarray) -> np.ndarray:
        """Position errors along the orbital frame's axes, metres; (...) -> (..., 3)."""
        return _sum(self.position_terms, seconds)

    def velocity(self, seconds: np.ndarray) -> np.ndarray:
        """Velocity errors along the orbital frame's axes, m/s; (...) -> (..., 3)."""
        return _sum(self.velocity_terms, seconds)

    def attitude(self, seconds: np.ndarray, latitude: np.ndarray) -> np.ndarray:
        """Rotation vectors in body axes, radians: measured = true @ rotation_matrix(vector).

        Args:
            seconds: shape (...).
            latitude: geodetic, of the point below, radians, shape (...).

        Returns:
            Shape (..., 3).
        """
        shape = np.sin(np.asarray(latitude) - self.reference)
        return _sum(self.attitude_terms, seconds) + self.bias + shape[..., None] * self.thermal


def draw_errors(
    spec: ErrorsSpec, first: float, last: float, seed: int, terms: Collection[str] = TERMS
) -> MeasurementErrors:
    """Errors over a span of time.

    Args:
        spec: how large they are.
        first: begin of the span, seconds.
        last: its end, seconds.
        seed: of all random numbers.
        terms: which of `TERMS` are on; the others are zero.

    Raises:
        ValueError: an unknown term.
    """
    unknown = sorted(set(terms) - set(TERMS))
    if unknown:
        raise ValueError(f"no such error: {', '.join(unknown)}; there are {', '.join(TERMS)}")
    streams = dict(zip(TERMS, np.random.SeedSequence(seed).spawn(len(TERMS)), strict=True))
    gps, star = spec.gps, spec.star_tracker
    fixes = readings(first, last, gps.interval)
    position: list[Series] = []
    velocity: list[Series] = []
    attitude: list[Series] = []
    if "gps_noise" in terms and any(gps.noise):
        position.append(_noise(fixes, np.array(gps.noise), streams["gps_noise"]))
    if "gps_drift" in terms and any(gps.drift):
        position.append(_drift(fixes, np.array(gps.drift), gps.correlation_time, streams["gps_drift"]))
    if "gps_velocity" in terms and any(gps.velocity):
        velocity.append(_noise(fixes, np.array(gps.velocity), streams["gps_velocity"]))
    if "attitude_noise" in terms and any(star.noise):
        looks = readings(first, last, star.interval)
        attitude.append(_noise(looks, np.array(star.noise), streams["attitude_noise"]))
    if "attitude_slow" in terms and any(star.slow.noise):
        values = readings(first, last, star.slow.interval)
        attitude.append(_noise(values, np.array(star.slow.noise), streams["attitude_slow"]))
    return MeasurementErrors(
        tuple(position),
        tuple(velocity),
        tuple(attitude),
        np.array(star.bias) * ("attitude_bias" in terms),
        np.array(star.thermal.amplitude) * ("attitude_thermal" in terms),
        star.thermal.reference,
    )


def _sum(series: tuple[Series, ...], seconds: np.ndarray) -> np.ndarray:
    t = np.asarray(seconds, dtype=np.float64)
    return sum((one(t) for one in series), np.zeros((*t.shape, 3)))
