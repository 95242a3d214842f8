"""A turntable with a dividing error, and its comparison with a reference, simulated.

Dividing error = reading - true angle: the table that reads R stands at phi = R - e(R). e is a sum of harmonics of the
turn; the subdivision error is a few harmonics of the grating's signal. All coefficients are drawn from the seed, so
that the turntable test and the distortion test of one seed use the same table.

Radians.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.arrays import Array
from analysis.turntable.dividing_error import CalibrationSeries
from optics.numerics.number_tree import FrozenMap
from scenes.specs.turntable import DividingErrorSpec, TurntableTestSpec
from twin.framework.random_streams import stream

_TABLE, _CALIBRATION, _HELD_OUT, _SPREAD = range(4)
"""Numbers of the seed's random streams."""
_FIXED_POINT_STEPS = 8


@dataclass(frozen=True, eq=False)
class Harmonics:
    """sum_k cosine_k cos(k R) + sine_k sin(k R).

    Attributes:
        order: k, periods in a full turn, (K,).
        cosine, sine: (K,), radians.
    """

    order: NDArray[np.int64]
    cosine: Array
    sine: Array

    @classmethod
    def draw(cls, order: ArrayLike, rms: Array, rng: np.random.Generator) -> Harmonics:
        """Normal coefficients, such that each harmonic's mean square over the circle is expected to be rms^2, (K,)."""
        k = np.asarray(order, np.int64)
        cosine, sine = rng.standard_normal((2, len(k))) * rms
        return cls(k, cosine, sine)

    def __call__(self, reading: ArrayLike) -> Array:
        """The sum at readings, in their shape."""
        at = np.asarray(reading, np.float64)
        phase = at.ravel()[:, None] * self.order
        return (np.cos(phase) @ self.cosine + np.sin(phase) @ self.sine).reshape(at.shape)

    @property
    def rms(self) -> float:
        """Over the full circle, radians."""
        return float(np.sqrt(0.5 * np.sum(self.cosine**2 + self.sine**2)))


@dataclass(frozen=True, eq=False)
class DividingError:
    """The true dividing error of one table, reading - true angle, as a function of the reading.

    Attributes:
        parts: axis, eccentricity, graduation, subdivision.
    """

    parts: Mapping[str, Harmonics]

    @classmethod
    def draw(cls, spec: DividingErrorSpec, seed: int) -> DividingError:
        """A table; spec and seed determine it."""
        rng = np.random.default_rng(stream(seed, _TABLE))
        g, sub = spec.graduation, spec.subdivision
        lines = np.arange(g.first, g.last + 1)
        fall = lines ** -float(g.slope)
        waves = sub.lines * np.array(sub.harmonics)
        return cls(
            FrozenMap(
                {
                    "axis": Harmonics.draw([1, 2], np.full(2, spec.axis / np.sqrt(2.0)), rng),
                    "eccentricity": Harmonics.draw([1], np.full(1, spec.eccentricity), rng),
                    "graduation": Harmonics.draw(lines, spec.graduation.rms * fall / np.linalg.norm(fall), rng),
                    "subdivision": Harmonics.draw(waves, np.full(len(waves), sub.rms / np.sqrt(len(waves))), rng),
                }
            )
        )

    def __call__(self, reading: ArrayLike) -> Array:
        """Exact dividing error at readings, in their shape, radians."""
        return np.asarray(sum(part(reading) for part in self.parts.values()), np.float64)


@dataclass(frozen=True, eq=False)
class TurntableModel:
    """A table and the reference it is compared with.

    Attributes:
        spec: of the test.
        seed: of everything that is random.
    """

    spec: TurntableTestSpec
    seed: int

    @cached_property
    def error(self) -> DividingError:
        """True dividing error of this table; the analysis does not get it."""
        return DividingError.draw(self.spec.dividing_error, self.seed)

    def stand(self, reading: ArrayLike, rng: np.random.Generator | None = None) -> Array:
        """True angles at which the table stands when it reads this, in the shape of the readings, radians.

        Args:
            reading: radians.
            rng: of the repeatability; None for a table that repeats perfectly.
        """
        at = np.asarray(reading, np.float64)
        return at - self.error(at) - self._scatter(at.shape, rng)

    def read(self, true_angle: ArrayLike, rng: np.random.Generator | None = None) -> Array:
        """Readings of a table that stands at these true angles; the inverse of `stand`.

        R = phi + e(R) by fixed-point steps: |de/dR| is a few times 1e-2 (subdivision), so that eight of them leave less
        than rounding.
        """
        phi = np.asarray(true_angle, np.float64)
        scatter = self._scatter(phi.shape, rng)
        reading = phi + scatter
        for _ in range(_FIXED_POINT_STEPS):
            reading = phi + scatter + self.error(reading)
        return reading

    def _scatter(self, shape: tuple[int, ...], rng: np.random.Generator | None) -> Array:
        if rng is None:
            return np.zeros(shape)
        return rng.normal(0.0, self.spec.dividing_error.repeatability, shape)

    def calibrate(self) -> CalibrationSeries:
        """The regional comparison."""
        plan = self.spec.calibration
        return self._compare(self._steps(0.0, plan.count), plan.repeats, _CALIBRATION)

    def held_out(self) -> CalibrationSeries:
        """The separate series at angles in the middle of the steps, set off by the spread."""
        plan = self.spec.calibration
        rng = np.random.default_rng(stream(self.seed, _SPREAD))
        off = rng.uniform(-plan.held_out.spread, plan.held_out.spread, plan.count - 1)
        return self._compare(self._steps(0.5, plan.count - 1) + off, plan.held_out.repeats, _HELD_OUT)

    def _steps(self, start: float, count: int) -> Array:
        """So many readings a step apart, from this many steps after the first, radians."""
        plan = self.spec.calibration
        return np.asarray(plan.first + plan.step * (np.arange(count) + start), np.float64)

    def _compare(self, angle: Array, repeats: int, number: int) -> CalibrationSeries:
        rng = np.random.default_rng(stream(self.seed, number))
        reference = self.spec.reference
        shape = len(angle), repeats
        known = rng.normal(0.0, reference.calibration, len(angle))
        readings = np.broadcast_to(angle[:, None], shape)
        seen = self.stand(readings, rng) + known[:, None] + rng.normal(0.0, reference.noise, shape)
        gross = rng.random(shape) < reference.gross_probability
        seen = seen + gross * rng.choice([-1.0, 1.0], shape) * reference.gross_error
        return CalibrationSeries(angle, readings - seen, reference.calibration)
