"""A pass without anything fast: the readings of orbit and attitude brought to polynomials.

Readings that are joined by a spline carry their noise into the attitude between them, with the period of the readings.
Image points that are compared with such an attitude show that period, whatever the satellite did. Against polynomials
there is nothing that has a period.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from scipy.spatial.transform import Rotation

from optics.numerics.spans import in_span
from twin.orbit.flight.light_effects import carried_with_earth
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.flight.trajectory import Attitude

_ORBIT, _PER = 6, 60.0
"""Degree of a polynomial through an orbit, one more for each so many seconds: good to 0.1 mm."""
_ATTITUDE = 4
"""Degree of what a body does against the orbital frame: slow, and what this leaves of it each line's trend takes."""


@dataclass(frozen=True, eq=False)
class SteadyPlatform:
    """Position and attitude as polynomials of time, seconds; times have shape (...).

    Attributes:
        span: of the readings that they go through.
        place: Chebyshev coefficients of the position, ITRS, (K, 3), metres.
        turn: of rotation vectors from `middle`, (K, 3), radians.
        middle: rotation of the body against the orbital frame, (3, 3).
        law: orbital axes.
    """

    span: tuple[float, float]
    place: np.ndarray
    turn: np.ndarray
    middle: np.ndarray
    law: Attitude

    @classmethod
    def of(cls, path: TabulatedTrajectory, first: float, last: float) -> SteadyPlatform:
        """Through the readings between two times and, to each side, as long again where there are any.

        Raises:
            ValueError: the readings do not cover the times.
        """
        path.position(np.array([first, last]))
        reach = last - first
        begin, end = max(first - reach, path.first), min(last + reach, path.last)
        span = begin, end
        fixes, looks = (_inside(time, begin, end, path) for time in (path.table.orbit_time, path.table.attitude_time))
        degree = _ORBIT + int((end - begin) / _PER)
        place = _fitted(fixes, path.position(fixes), span, degree)
        draft = cls(span, place, np.zeros((1, 3)), np.eye(3), path.law)
        against = Rotation.from_matrix(np.einsum("nji,njk->nik", draft._orbital(looks), path.body_to_itrs(looks)))
        middle = against.mean().as_matrix()
        away = (Rotation.from_matrix(middle).inv() * against).as_rotvec()
        return cls(span, place, _fitted(looks, away, span, _ATTITUDE), middle, path.law)

    def position(self, seconds: Any) -> np.ndarray:
        """Position in the ITRS, metres; (...) -> (..., 3)."""
        return self._series(self.place, seconds)

    def velocity(self, seconds: Any) -> np.ndarray:
        """Velocity against the turning Earth in axes of the ITRS, m/s; (...) -> (..., 3)."""
        first, last = self.span
        return self._series(chebyshev.chebder(self.place) * (2.0 / (last - first)), seconds)

    def inertial_velocity(self, seconds: Any) -> np.ndarray:
        """Velocity against the stars in axes of the ITRS, m/s; (...) -> (..., 3)."""
        return np.asarray(self.velocity(seconds) + carried_with_earth(self.position(seconds)))

    def body_to_itrs(self, seconds: Any) -> np.ndarray:
        """Axes of the body as columns, (...) -> (..., 3, 3): x_itrs = matrix @ x_body."""
        t = np.asarray(seconds, np.float64)
        turn = Rotation.from_rotvec(self._series(self.turn, t).reshape(-1, 3)).as_matrix().reshape(*t.shape, 3, 3)
        return np.asarray(self._orbital(t) @ self.middle @ turn)

    def _orbital(self, seconds: Any) -> np.ndarray:
        return self.law.orbital_to_itrs(self.position(seconds), self.velocity(seconds), self.inertial_velocity(seconds))

    def _series(self, coefficients: np.ndarray, seconds: Any) -> np.ndarray:
        first, last = self.span
        x = (2.0 * np.asarray(seconds, np.float64) - first - last) / (last - first)
        return np.asarray(np.moveaxis(chebyshev.chebval(x, coefficients), 0, -1))


@dataclass(frozen=True, eq=False)
class TurnedPlatform:
    """A platform whose body is turned about its own axes by a constant.

    Attributes:
        base: the platform.
        turn: rotation matrix, (3, 3); x_itrs = base @ turn @ x_body.
    """

    base: SteadyPlatform
    turn: np.ndarray

    def position(self, seconds: Any) -> np.ndarray:
        """Position in the ITRS, metres; (...) -> (..., 3)."""
        return self.base.position(seconds)

    def inertial_velocity(self, seconds: Any) -> np.ndarray:
        """Velocity against the stars in axes of the ITRS, m/s; (...) -> (..., 3)."""
        return self.base.inertial_velocity(seconds)

    def body_to_itrs(self, seconds: Any) -> np.ndarray:
        """Axes of the body as columns, (...) -> (..., 3, 3)."""
        return np.asarray(self.base.body_to_itrs(seconds) @ self.turn)


def _inside(time: np.ndarray, first: float, last: float, path: TabulatedTrajectory) -> np.ndarray:
    """Readings between two times; where there are few, moments that are joined from them."""
    found = time[in_span(time, first, last)]
    if len(found) < 2 * _ORBIT:
        found = np.linspace(first, last, 4 * _ORBIT)
    return np.asarray(found[path.known(found)])


def _fitted(time: np.ndarray, values: np.ndarray, span: tuple[float, float], degree: int) -> np.ndarray:
    x = (2.0 * time - span[0] - span[1]) / (span[1] - span[0])
    return np.asarray(chebyshev.chebfit(x, values, min(degree, len(time) - 1)))
