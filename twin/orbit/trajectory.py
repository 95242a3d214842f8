"""Where the satellite is and how it is turned, as functions of time: as it truly was, or as it was measured."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from optics.rotation import rotation_matrix
from twin.orbit.attitude import Attitude
from twin.orbit.measurement_errors import TERMS, MeasurementErrors, draw_errors
from twin.orbit.orbit import Orbit

if TYPE_CHECKING:
    from scenes.orbit_spec import ErrorsSpec


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Position and attitude over the span of an orbit, seconds from its epoch; times have shape (...).

    Every method raises ValueError for a time outside the orbit.

    Attributes:
        orbit: true orbit.
        attitude: law that the true attitude follows.
        errors: of the measured orbit and attitude; None for the truth.
    """

    orbit: Orbit
    attitude: Attitude = field(default_factory=Attitude)
    errors: MeasurementErrors | None = None

    @property
    def first(self) -> float:
        """Begin of the span, seconds."""
        return self.orbit.first

    @property
    def last(self) -> float:
        """End of the span, seconds."""
        return self.orbit.last

    def position(self, seconds: Any) -> np.ndarray:
        """Position in the ITRS, metres; (...) -> (..., 3)."""
        return self._motion(seconds)[0]

    def velocity(self, seconds: Any) -> np.ndarray:
        """Velocity against the turning Earth in axes of the ITRS, m/s; (...) -> (..., 3)."""
        return self._motion(seconds)[1]

    def inertial_velocity(self, seconds: Any) -> np.ndarray:
        """Velocity against the stars in axes of the ITRS, m/s; (...) -> (..., 3)."""
        return self._motion(seconds)[2]

    def orbital_to_itrs(self, seconds: Any) -> np.ndarray:
        """True axes of the orbital frame as columns, (...) -> (..., 3, 3)."""
        return self.attitude.orbital_to_itrs(*self.orbit.itrs(seconds))

    def body_to_itrs(self, seconds: Any) -> np.ndarray:
        """Axes of the body as columns, (...) -> (..., 3, 3): x_itrs = matrix @ x_body."""
        true = self.orbit.itrs(seconds)
        body = self.attitude.body_to_itrs(*true)
        if self.errors is None:
            return body
        latitude = self.orbit.earth.geodetic(true[0])[1]
        return body @ rotation_matrix(self.errors.attitude(seconds, latitude))

    def with_errors(self, spec: ErrorsSpec, seed: int, terms: Collection[str] = TERMS) -> Trajectory:
        """The trajectory as the satellite measures it: this one with errors, in place of those it may have.

        Args:
            spec: how large the errors are.
            seed: of all random numbers.
            terms: which errors are on, of `twin.orbit.measurement_errors.TERMS`.

        Raises:
            ValueError: an unknown term.
        """
        return replace(self, errors=draw_errors(spec, self.first, self.last, seed, terms))

    def without_errors(self) -> Trajectory:
        """The truth."""
        return replace(self, errors=None)

    def _motion(self, seconds: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        position, velocity, inertial = self.orbit.itrs(seconds)
        if self.errors is None:
            return position, velocity, inertial
        axes = self.attitude.orbital_to_itrs(position, velocity, inertial)
        place, speed = (
            np.einsum("...ij,...j->...i", axes, error(seconds))
            for error in (self.errors.position, self.errors.velocity)
        )
        return position + place, velocity + speed, inertial + speed
