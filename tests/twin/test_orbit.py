"""Orbits: conservation laws, the known secular rates, other integrators, and the place that is asked for."""

import math

import numpy as np
import pytest

from scenes.specs.orbit.flight import OrbitSpec
from twin.orbit.flight.earth import DAY, EQUATORIAL_RADIUS, RATE, Earth, ut1_of
from twin.orbit.flight.orbit import FIELD_RADIUS, GM, J2, Orbit, acceleration, propagate, sun_synchronous_inclination

EARTH = Earth(-0.15, (4e-7, -2e-6))
EPOCH = "2011-03-05T03:05:00Z"
BEIJING = {"longitude": "116 deg", "latitude": "40 deg"}


def orbit(earth: Earth = EARTH, tolerance: float = 1e-12, **given: object) -> Orbit:
    if not {"passing", "elements", "state"} & set(given):
        given["passing"] = BEIJING
    return propagate(OrbitSpec.model_validate({"epoch": EPOCH, **given}), earth, tolerance)


def potential(r: np.ndarray) -> np.ndarray:
    """The field's potential with the Legendre polynomial P2, m^2/s^2."""
    distance = np.linalg.norm(r, axis=-1)
    p2 = np.polynomial.legendre.legval(r[..., 2] / distance, [0.0, 0.0, 1.0])
    return GM / distance * (1.0 - J2 * (FIELD_RADIUS / distance) ** 2 * p2)


def descending_local_time(of: Orbit) -> float:
    """Local mean solar time of the osculating orbit's descending node at the epoch, seconds of the day."""
    h = np.cross(*of.equatorial(0.0))
    days = sum(part % 1.0 for part in ut1_of(of.epoch, of.earth.dut1)) + 0.5  # a Julian day begins at noon
    east = math.atan2(h[0], -h[1]) + math.pi - of.rotation.angle
    return (days + east / (2.0 * math.pi)) * DAY % DAY


def test_acceleration_is_the_gradient_of_the_potential() -> None:
    generator = np.random.default_rng(4)
    r = generator.standard_normal((100, 3))
    r *= 6.9e6 / np.linalg.norm(r, axis=-1, keepdims=True)
    # central differences over 1 km: truncation (h/r)^2 = 2e-8 of g, rounding 6e7 * 1e-16 / 1e3
    step = 1e3
    steps = step * np.eye(3)
    gradient = np.stack([(potential(r + s) - potential(r - s)) / (2 * step) for s in steps], axis=-1)
    np.testing.assert_allclose(acceleration(r), gradient, rtol=0, atol=5e-7)
    # J2 itself is 1e-3 of g and would be missed
    assert np.min(np.linalg.norm(acceleration(r) + GM * r / 6.9e6**3, axis=-1)) > 5e-3


def test_published_sun_synchronous_inclinations() -> None:
    # TH-1: 500 km, 97.3 deg; Landsat 7 (705 km): 98.2 deg; SPOT (822 km): 98.7 deg
    for altitude, known in ((500e3, 97.4), (705e3, 98.2), (822e3, 98.7)):
        found = math.degrees(sun_synchronous_inclination(EQUATORIAL_RADIUS + altitude))
        assert found == pytest.approx(known, abs=0.1)
    with pytest.raises(ValueError, match="no sun-synchronous orbit"):
        sun_synchronous_inclination(20e6)


def test_without_flattening_it_is_an_ellipse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kepler's equation, solved here, with all elements at work."""
    monkeypatch.setattr("twin.orbit.flight.orbit.J2", 0.0)
    e, i, node, perigee, argument = 0.05, 1.1, 2.0, 0.7, 1.5
    degrees = {
        key: f"{math.degrees(value)!r} deg"
        for key, value in {"inclination": i, "node": node, "perigee": perigee, "argument": argument}.items()
    }
    found = orbit(before="1 h", after="2 h", elements={"altitude": "900 km", "eccentricity": e, **degrees})
    a = EQUATORIAL_RADIUS + 900e3
    t = np.linspace(-3600.0, 7200.0, 101)
    true = argument - perigee
    eccentric = 2 * math.atan(math.sqrt((1 - e) / (1 + e)) * math.tan(true / 2))
    mean = eccentric - e * math.sin(eccentric) + math.sqrt(GM / a**3) * t
    anomaly = mean.copy()
    for _ in range(50):
        anomaly = mean + e * np.sin(anomaly)
    plane = np.stack([a * (np.cos(anomaly) - e), a * math.sqrt(1 - e * e) * np.sin(anomaly), 0 * t], axis=-1)
    from scipy.spatial.transform import Rotation

    known = Rotation.from_euler("ZXZ", [node, i, perigee]).apply(plane)
    np.testing.assert_allclose(found.equatorial(t)[0], known, rtol=0, atol=1e-4)


@pytest.mark.parametrize("direction", ["descending", "ascending"])
@pytest.mark.parametrize(("longitude", "latitude"), [(116.0, 40.0), (-70.0, -33.0), (10.0, 0.0), (20.0, 80.0)])
def test_it_passes_where_it_is_asked_to(direction: str, longitude: float, latitude: float) -> None:
    place = {"longitude": f"{longitude} deg", "latitude": f"{latitude} deg", "altitude": "505 km"}
    found = orbit(passing={**place, "direction": direction})
    position, velocity, _ = found.itrs([-1.0, 0.0, 1.0])
    lon, lat, height = EARTH.geodetic(position)
    assert np.degrees([lon[1], lat[1]]) == pytest.approx([longitude, latitude], abs=1e-12)
    assert height[1] == pytest.approx(505e3, abs=1e-6)
    assert (lat[2] < lat[0]) == (direction == "descending")
    assert np.linalg.norm(velocity[1]) == pytest.approx(7600.0, abs=600.0)
    # retrograde: the track runs to the west
    assert lon[2] < lon[0]


def test_velocities_are_derivatives() -> None:
    found = orbit()
    t = np.linspace(-590.0, 590.0, 200)
    position, velocity, inertial = found.itrs(t)
    around = {k: found.itrs(t + k)[0] for k in (-2, -1, 1, 2)}
    # fourth order over 1 s: n^5 h^4 a / 30 = 4e-10 m/s, rounding 1e-9 m / 1 s
    derivative = ((around[1] - around[-1]) * 8.0 - (around[2] - around[-2])) / 12.0
    np.testing.assert_allclose(velocity, derivative, rtol=0, atol=3e-8)
    # the two velocities differ by the turning Earth; polar motion tilts the axis by 2e-6
    turning = RATE * np.cross([0.0, 0.0, 1.0], position)
    np.testing.assert_allclose(inertial - velocity, turning, rtol=0, atol=2e-3)
    # the stars' view: the GCRS velocity, turned
    matrix = EARTH.to_itrs(t, EPOCH)
    np.testing.assert_allclose(inertial, np.einsum("nij,nj->ni", matrix, found.gcrs(t)[1]), rtol=0, atol=1e-8)


def test_the_state_vector_goes_through() -> None:
    """An orbit begun anew from its own state is the same orbit."""
    first = orbit(before="0 s")
    r, v = first.gcrs(0.0)
    state = {"position": [f"{x!r} m" for x in r.tolist()], "velocity": [f"{x!r} m/s" for x in v.tolist()]}
    second = orbit(before="0 s", state=state)
    np.testing.assert_allclose(second.gcrs(600.0)[0], first.gcrs(600.0)[0], rtol=0, atol=1e-6)


@pytest.mark.second
def test_local_time_of_the_node() -> None:
    for hour in (10.5, 13.5, 22.0):
        elements = {"altitude": "500 km", "node_local_time": f"{hour} h", "argument": "150 deg"}
        found = orbit(before="3 h", after="3 h", elements=elements)
        assert descending_local_time(found) == pytest.approx(3600 * hour, abs=1e-6)
        # at the southward crossing of the equator: UT1 plus longitude over 15 deg/h
        t = np.linspace(-6000.0, 6000.0, 12_001)
        lon, lat, _ = EARTH.geodetic(found.itrs(t)[0])
        k = int(np.flatnonzero((lat[:-1] > 0) & (lat[1:] <= 0))[0])
        clock = 3 * 3600 + 5 * 60 - 0.15 + t[k] + lon[k] / (2 * np.pi) * DAY
        # the osculating node at the epoch against the crossing: J2's short periods, 2e-4 rad or 3 s; sampling 1 s
        assert (clock - 3600 * hour + DAY / 2) % DAY - DAY / 2 == pytest.approx(0.0, abs=5.0)


def test_bad_orbits() -> None:
    with pytest.raises(ValueError, match=r"never passes latitude 85\.000 deg"):
        orbit(passing={"longitude": "0 deg", "latitude": "85 deg"})
    with pytest.raises(ValueError, match=r"never passes latitude 40\.000 deg"):
        orbit(passing={**BEIJING, "inclination": "30 deg"})
    thrown = {"position": ["6878 km", "0 m", "0 m"], "velocity": ["1 km/s", "0 m/s", "0 m/s"]}
    # the rectilinear Kepler orbit from the apex r0 reaches r = r0 cos^2 x after sqrt(r0^3/(2 GM)) (x + sin x cos x);
    # J2 adds 1.4e-3 to gravity here and takes about half a second off
    apex = 1.0 / (1.0 / 6878e3 - 1e6 / (2 * GM))
    up, down = (math.acos(math.sqrt(r / apex)) for r in (6878e3, 6356752.3))
    fall = math.sqrt(apex**3 / (2 * GM)) * sum(x + math.sin(x) * math.cos(x) for x in (up, down))
    with pytest.raises(ValueError, match=f"runs into the Earth {fall - 0.5:.0f} s from its epoch"):
        orbit(before="0 s", state=thrown)
    with pytest.raises(ValueError, match="runs into the Earth"):
        orbit(before="0 s", state={**thrown, "position": ["6000 km", "0 m", "0 m"]})
    found = orbit()
    for outside in (600.1, -601.0, math.nan):
        with pytest.raises(ValueError, match="time outside the orbit, which covers -600 s to 600 s"):
            found.itrs([0.0, outside])
