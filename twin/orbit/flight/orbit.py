"""Satellite orbits, integrated numerically under gravity with the Earth's flattening (J2) and any other `FORCES`.

The flattening's axis is the celestial pole of the epoch; within a day the pole moves by some 0.1 arcsec. Drag, other
terms of the field, Sun and Moon are omitted: over a pass they displace the orbit smoothly by metres, and change nothing
in the geometry of an image, because a precise orbit determination includes them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.integrate import solve_ivp

from optics.numerics.array_math import UnphysicalError, in_span
from optics.numerics.extension_table import ExtensionTable
from twin.orbit.flight.earth import DAY, EQUATORIAL_RADIUS, FLATTENING, GM, Earth, EarthRotation, ut1_of

if TYPE_CHECKING:
    from scenes.specs.orbit.flight import ElementsSpec, OrbitSpec, PassingSpec

J2 = 1.0826266835e-3
"""Second zonal coefficient of the gravity field (EGM96): -sqrt(5) times the normalised C20, -484.165371736e-6."""
FIELD_RADIUS = 6378136.3
"""Reference radius of the spherical harmonic expansion of the gravity field, metres (EGM96)."""
SUN_RATE = 2.0 * math.pi / (365.2421897 * DAY)
"""Mean motion of the mean Sun in right ascension, rad/s, from the tropical year."""
TOLERANCE = 1e-12
"""Relative error tolerance of one integration step."""

_ABSOLUTE = np.array([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3]) * 1e-5
"""Weights of positions (m) and velocities (m/s) in the absolute error tolerance."""
_LONGEST_STEP = 60.0
"""Longest integration step, in seconds."""
_MOST_KEPT = 1 << 14
"""Largest number of times whose positions and velocities an orbit stores in its cache."""
_POLAR_RADIUS = EQUATORIAL_RADIUS * (1.0 - FLATTENING)


def acceleration(position: np.ndarray) -> np.ndarray:
    """Return the acceleration of the two-body + J2 field, in m/s^2.

    Positions (..., 3) are in metres, in axes with z along the pole.
    """
    r2 = np.sum(position * position, axis=-1, keepdims=True)
    sine2 = position[..., 2:] ** 2 / r2
    flattening = 1.5 * J2 * FIELD_RADIUS**2 / r2
    factor = 1.0 + flattening * (np.array([1.0, 1.0, 3.0]) - 5.0 * sine2)
    return np.asarray(-GM / (r2 * np.sqrt(r2)) * factor * position)


Force = Callable[[float, np.ndarray, np.ndarray], np.ndarray]
"""Function from seconds since the epoch, position (3,), metres, and velocity (3,), m/s, to acceleration (3,), m/s^2.

All are in the frame of integration: z along the celestial pole of the epoch, x toward its intermediate origin, without
rotation (the air rotates with the Earth in it).
"""


def _gravity(_: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return the acceleration due to the Earth's gravity, as one of the `FORCES`."""
    return acceleration(position)


FORCES = ExtensionTable[Force]("forces", {"gravity": _gravity})
"""Forces on every satellite by name; the accelerations add.

New forces are added here. The inclination of orbits that are specified as sun-synchronous is computed from J2 alone.
"""


def node_rate(semi_major_axis: float, eccentricity: float, inclination: float) -> float:
    """Return the secular rate of the ascending node due to J2, in rad/s.

    Parameters
    ----------
    semi_major_axis : float
        Mean semi-major axis, metres.
    eccentricity : float
        Mean eccentricity.
    inclination : float
        Mean inclination i, radians.

    Notes
    -----
    The rate is -3/2 J2 (R/p)^2 n cos i (Kaula 1966, eq. 3.74), with the Earth's radius R, the orbit's semi-latus rectum
    p and mean motion n.
    """
    n = math.sqrt(GM / semi_major_axis**3)
    p = semi_major_axis * (1.0 - eccentricity**2)
    return -1.5 * J2 * (FIELD_RADIUS / p) ** 2 * n * math.cos(inclination)


def sun_synchronous_inclination(semi_major_axis: float, eccentricity: float = 0.0) -> float:
    """Return the mean inclination at which the node follows the mean Sun, in radians.

    Raises
    ------
    ValueError
        The orbit is too high to be sun-synchronous.
    """
    cosine = SUN_RATE / node_rate(semi_major_axis, eccentricity, 0.0)
    if abs(cosine) > 1.0:
        raise UnphysicalError(f"no sun-synchronous orbit has a semi-major axis of {semi_major_axis / 1e3:.0f} km")
    return math.acos(cosine)


def _osculating_inclination(semi_major_axis: float, eccentricity: float, argument: float | None, z: float) -> float:
    """Return the osculating inclination of a sun-synchronous orbit at one argument of latitude.

    The input elements are osculating. The short-period terms of first order for a small eccentricity (Kozai 1959) lead
    to the mean elements: a = a' + 3/2 J2 R^2/a sin^2 i cos 2u and i = i' + 3/8 J2 (R/p)^2 sin 2i cos 2u. Here a, i and
    p are semi-major axis, inclination and semi-latus rectum, a prime marks mean elements, and u is the argument of
    latitude. Where `argument` is None, sin u follows from z = sin i sin u, the sine of the declination.
    """
    ratio = J2 * (FIELD_RADIUS / semi_major_axis) ** 2
    inclination = sun_synchronous_inclination(semi_major_axis, eccentricity)
    for _ in range(10):
        sine2 = math.sin(argument) ** 2 if argument is not None else (z / math.sin(inclination)) ** 2
        double = 1.0 - 2.0 * sine2
        mean_axis = semi_major_axis * (1.0 - 1.5 * ratio * math.sin(inclination) ** 2 * double)
        mean = sun_synchronous_inclination(mean_axis, eccentricity)
        inclination = mean + 0.375 * ratio * math.sin(2.0 * mean) * double
    return inclination


@dataclass(frozen=True, eq=False)
class Orbit:
    """Satellite orbit over a span of time, from `propagate`.

    Attributes
    ----------
    epoch : str
        UTC, ISO 8601 text; times are seconds from it.
    earth : Earth
        Earth whose rotation gives the Earth-fixed positions.
    first, last : float
        Span of time, seconds.
    to_gcrs : ndarray
        Rotation from the frame of integration (equator of the epoch) to the GCRS, shape (3, 3).
    rotation : EarthRotation
        Rotation of the Earth over the span.
    backward, forward : callable or None
        Dense solutions before and after the epoch, in the frame of integration; None if there is no such part.
    """

    epoch: str
    earth: Earth
    first: float
    last: float
    to_gcrs: np.ndarray
    rotation: EarthRotation
    backward: Any
    forward: Any
    _last: dict[str, tuple[np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]] = field(
        default_factory=dict, init=False, repr=False
    )

    def equatorial(self, seconds: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return position, metres, and velocity, m/s, both (..., 3), in the frame of integration.

        The frame has z along the celestial pole and x toward the celestial intermediate origin of the epoch, and does
        not rotate.

        Raises
        ------
        ValueError
            A time is not a number or lies outside the orbit.
        """
        t = np.asarray(seconds, dtype=np.float64)
        if not np.all(in_span(t, self.first, self.last)):
            raise UnphysicalError(
                f"time outside the orbit, which covers {self.first:g} s to {self.last:g} s; requested "
                f"{np.min(t):g} s to {np.max(t):g} s"
            )
        flat = t.ravel()
        state = np.empty((6, flat.size))
        for solution, part in ((self.backward, flat < 0.0), (self.forward, flat >= 0.0)):
            if np.any(part):
                state[:, part] = (solution or self.backward or self.forward)(flat[part])
        state = state.T.reshape(*t.shape, 6)
        return state[..., :3], state[..., 3:]

    def gcrs(self, seconds: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return position, metres, and velocity, m/s, both (..., 3), in the GCRS; times must lie within the orbit."""
        r, v = self.equatorial(seconds)
        return r @ self.to_gcrs.T, v @ self.to_gcrs.T

    def itrs(self, seconds: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return position (m), Earth-fixed velocity and inertial velocity (m/s), all (..., 3), in axes of the ITRS.

        The first velocity is relative to the rotating Earth, the second relative to the stars. The arrays are
        read-only. Raises ValueError for a time outside the orbit.
        """
        t = np.asarray(seconds, dtype=np.float64)
        # Callers request position, velocity and attitude one after the other at the same times.
        if (cached := self._last.get("itrs")) is not None and np.array_equal(cached[0], t):
            return cached[1]
        r, v = self.gcrs(t)
        matrix = self.rotation.matrix(t)
        position, inertial = (np.einsum("...ij,...j->...i", matrix, a) for a in (r, v))
        motion = position, inertial - np.cross(self.rotation.rate(t), position), inertial
        for array in motion:
            array.flags.writeable = False
        if t.size <= _MOST_KEPT:
            self._last["itrs"] = t.copy(), motion
        return motion


def propagate(spec: OrbitSpec, earth: Earth, tolerance: float = TOLERANCE) -> Orbit:
    """Integrate an orbit over its span (Dormand-Prince 8(5,3) with dense output).

    Parameters
    ----------
    spec : OrbitSpec
        Orbit of the input file.
    earth : Earth
        Earth whose rotation gives the Earth-fixed positions.
    tolerance : float
        Relative error of one step.

    Raises
    ------
    ValueError
        The orbit is impossible: the point passed lies beyond the latitudes that the inclination reaches, the orbit is
        too high to be sun-synchronous, or it runs into the Earth.
    """
    rotation = earth.rotation(spec.epoch, -spec.before, spec.after)
    to_gcrs = rotation.celestial(0.0).T
    if spec.passing is not None:
        state = _passing_state(spec.passing, earth, to_gcrs.T @ rotation.matrix(0.0).T)
    elif spec.elements is not None:
        state = _element_state(spec.elements, rotation, ut1_of(spec.epoch, earth.dut1))
    else:
        assert spec.state is not None
        state = np.concatenate([to_gcrs.T @ spec.state.position, to_gcrs.T @ spec.state.velocity])
    parts = [_solve(state, end, tolerance) if end else None for end in (-spec.before, spec.after)]
    return Orbit(spec.epoch, earth, -spec.before, spec.after, to_gcrs, rotation, *parts)


def _local_time(right_ascension: float, angle: float, ut1: tuple[float, float]) -> float:
    """Return the local time of a meridian, UT1 plus its longitude, in seconds of the day."""
    # A Julian day begins at noon.
    noon = (ut1[0] % 1.0 + ut1[1] % 1.0 + 0.5) * DAY
    return (noon + (right_ascension - angle) / (2.0 * math.pi) * DAY) % DAY


def _solve(state: np.ndarray, end: float, tolerance: float) -> Any:
    """Integrate a state (position, velocity) at the epoch to the time `end`, s; return the dense solution."""
    forces = tuple(FORCES.values())

    def derivative(t: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[3:], np.sum([force(t, y[:3], y[3:]) for force in forces], axis=0)])

    def above_ground(_: float, y: np.ndarray) -> float:
        return float(np.linalg.norm(y[:3])) - _POLAR_RADIUS

    above_ground.terminal = True  # type: ignore[attr-defined]
    solution = solve_ivp(
        derivative,
        (0.0, end),
        state,
        method="DOP853",
        dense_output=True,
        rtol=tolerance,
        atol=tolerance * 1e7 * _ABSOLUTE,
        max_step=_LONGEST_STEP,
        events=above_ground,
    )
    if solution.status == 1 or above_ground(0.0, state) < 0.0:
        raise UnphysicalError(f"the orbit runs into the Earth {solution.t[-1]:.0f} s from its epoch")
    assert solution.success, solution.message
    return solution.sol


def _radial_and_along(inclination: float, node: float, argument: float) -> np.ndarray:
    """Return unit vectors away from the Earth and along the circular orbit, (2, 3), in the frame of integration."""
    cu, su, cn, sn = math.cos(argument), math.sin(argument), math.cos(node), math.sin(node)
    ci, si = math.cos(inclination), math.sin(inclination)
    radial = [cn * cu - sn * su * ci, sn * cu + cn * su * ci, su * si]
    along = [-cn * su - sn * cu * ci, -sn * su + cn * cu * ci, cu * si]
    return np.array([radial, along])


def _element_state(spec: ElementsSpec, rotation: EarthRotation, ut1: tuple[float, float]) -> np.ndarray:
    """Return position and velocity, (6,), at the epoch from osculating elements."""
    a, e = EQUATORIAL_RADIUS + spec.altitude, spec.eccentricity
    inclination = spec.inclination
    if inclination is None:
        inclination = _osculating_inclination(a, e, spec.argument, 0.0)
    node = spec.node
    if node is None:
        assert spec.node_local_time is not None
        at_zero = _local_time(0.0, rotation.angle, ut1)
        node = 2.0 * math.pi * (spec.node_local_time - at_zero) / DAY - math.pi
    anomaly = spec.argument - spec.perigee
    p = a * (1.0 - e * e)
    speed = math.sqrt(GM / p)
    radial, along = _radial_and_along(inclination, node, spec.argument)
    position = p / (1.0 + e * math.cos(anomaly)) * radial
    velocity = speed * (e * math.sin(anomaly) * radial + (1.0 + e * math.cos(anomaly)) * along)
    return np.concatenate([position, velocity])


def _passing_state(spec: PassingSpec, earth: Earth, from_itrs: np.ndarray) -> np.ndarray:
    """Return position and velocity, (6,), at the epoch on the osculating circular orbit over a ground point.

    The point's declination gives the argument of latitude and, with its right ascension, the node.
    """
    position = from_itrs @ earth.ecef(spec.longitude, spec.latitude, spec.altitude)
    a = float(np.linalg.norm(position))
    z = position[2] / a
    inclination = spec.inclination
    if inclination is None:
        # Near the turning points no such orbit may exist; the mean inclination then leads to the error below.
        reachable = abs(z) < abs(math.sin(sun_synchronous_inclination(a)))
        inclination = _osculating_inclination(a, 0.0, None, z) if reachable else sun_synchronous_inclination(a)
    if abs(z) > math.sin(inclination):
        raise UnphysicalError(
            f"an orbit of inclination {math.degrees(inclination):.3f} deg never passes latitude "
            f"{math.degrees(spec.latitude):.3f} deg"
        )
    argument = math.asin(z / math.sin(inclination))
    if spec.direction == "descending":
        argument = math.pi - argument
    longitude_from_node = math.atan2(math.cos(inclination) * math.sin(argument), math.cos(argument))
    node = math.atan2(position[1], position[0]) - longitude_from_node
    along = _radial_and_along(inclination, node, argument)[1]
    return np.concatenate([position, math.sqrt(GM / a) * along])
