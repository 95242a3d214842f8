"""Readings of orbit and attitude joined against the orbit that they were taken from; line times."""

import numpy as np
import pytest

from scenes.specs.orbit.flight import OrbitSpec, PassingSpec
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.line_camera import LineTimes
from twin.orbit.flight.orbit import propagate
from twin.orbit.flight.platform_table import PlatformTable, TabulatedTrajectory
from twin.orbit.flight.trajectory import Attitude, Trajectory


@pytest.fixture(scope="module")
def true() -> Trajectory:
    """A sun-synchronous orbit at 500 km, ten minutes to either side, yaw-steered."""
    passing = PassingSpec.model_construct(
        longitude=2.0, latitude=0.7, altitude=500e3, direction="descending", inclination=None
    )
    orbit = OrbitSpec.model_construct(
        epoch="2013-05-12T03:05:00Z", before=600.0, after=600.0, passing=passing, elements=None, state=None
    )
    return Trajectory(propagate(orbit, Earth()), Attitude(True, True))


TIMES = np.linspace(-550.0, 550.0, 1237)


@pytest.mark.parametrize(
    ("interval", "way", "position", "velocity"),
    [
        (1.0, "spline", 1e-6, 1e-6),
        (10.0, "spline", 1e-3, 1e-3),
        (30.0, "lagrange", 1e-4, 1e-5),
        (60.0, "lagrange", 5e-2, 1e-3),
    ],
)
def test_positions_between_readings(true, interval, way, position, velocity) -> None:
    """The spline is as good as its bound, h^4 |f''''| / 384 of 0.3 mm at 10 s; ten readings a minute apart are good to
    centimetres even at the ends. Velocities by their own readings, and as the derivative of the positions."""
    table = PlatformTable.sampled(true, interval, 0.5)
    path = TabulatedTrajectory(table)
    assert path.interpolation == way
    assert np.abs(path.position(TIMES) - true.position(TIMES)).max() < position
    assert np.abs(path.inertial_velocity(TIMES) - true.inertial_velocity(TIMES)).max() < velocity + 2e-3
    bare = TabulatedTrajectory(
        PlatformTable.of(table.epoch, table.orbit_time, table.position, None, table.attitude_time, table.quaternion)
    )
    assert np.abs(bare.velocity(TIMES) - true.velocity(TIMES)).max() < 1e-2
    fixes = table.orbit_time[1:-1]
    np.testing.assert_allclose(path.position(fixes), true.position(fixes), rtol=0.0, atol=1e-8)


@pytest.mark.parametrize(("interval", "error"), [(0.125, 1e-12), (1.0, 1e-10), (4.0, 1e-8)])
def test_attitude_between_readings(true, interval, error) -> None:
    """Radians; a satellite that turns with its orbit, 0.06 deg/s. Axes stay square to each other."""
    path = TabulatedTrajectory(PlatformTable.sampled(true, 1.0, interval))
    found, known = path.body_to_itrs(TIMES), true.body_to_itrs(TIMES)
    assert np.abs(found - known).max() < error + 1e-14
    np.testing.assert_allclose(found @ np.swapaxes(found, 1, 2), np.broadcast_to(np.eye(3), found.shape), atol=1e-14)


def test_signs_of_quaternions_do_not_matter(true) -> None:
    table = PlatformTable.sampled(true, 1.0, 0.5)
    sign = np.random.default_rng(1).choice([-1.0, 1.0], len(table.quaternion))[:, None]
    other = PlatformTable.of(
        table.epoch, table.orbit_time, table.position, table.velocity, table.attitude_time, sign * table.quaternion
    )
    one, two = (TabulatedTrajectory(t).body_to_itrs(TIMES) for t in (table, other))
    np.testing.assert_allclose(one, two, rtol=0.0, atol=1e-14)


def test_what_is_not_known_is_refused(true) -> None:
    """Before, after, and in a gap of more than five intervals; its ends are known."""
    table = PlatformTable.sampled(true, 1.0, 1.0)
    keep = (table.attitude_time <= 10.0) | (table.attitude_time >= 20.0)
    path = TabulatedTrajectory(
        PlatformTable.of(
            table.epoch, table.orbit_time, table.position, None, table.attitude_time[keep], table.quaternion[keep]
        )
    )
    assert path.covers([-601.0, 10.1, 19.9, 601.0]).tolist() == [False] * 4
    assert path.covers([9.5, 10.0, 20.0]).all()
    with pytest.raises(ValueError, match="in a gap of"):
        path.position(15.0)
    with pytest.raises(ValueError, match="outside of"):
        path.body_to_itrs(np.array([0.0, 700.0]))
    assert path.orbit_interval == path.attitude_interval == 1.0


def test_tables_that_are_none(true) -> None:
    """Times that fall, quaternions that are no rotations, rows that do not match."""
    t = PlatformTable.sampled(true, 60.0, 60.0)
    good = [t.epoch, t.orbit_time, t.position, t.velocity, t.attitude_time, t.quaternion]
    for place, wrong, words in (
        (1, t.orbit_time[::-1], "do not increase"),
        (2, t.position[:-1], "must be"),
        (3, t.velocity * np.nan, "not finite"),
        (5, 1.1 * t.quaternion, "unit length"),
        (5, t.quaternion[:, :3], "must be"),
    ):
        given = list(good)
        given[place] = wrong
        with pytest.raises(ValueError, match=words):
            PlatformTable.of(*given)


def test_line_times() -> None:
    """Linear between rows and beyond the ends; even lines are those of first time and line time."""
    times = LineTimes.of([0.0, 10.0, 20.0], [5.0, 6.0, 8.0])
    assert times.at([-0.5, 0.0, 5.0, 10.0, 15.0, 20.5]).tolist() == pytest.approx([4.95, 5.0, 5.5, 6.0, 7.0, 8.1])
    assert times.line_time == pytest.approx(0.15)
    even = LineTimes.even(-60.0, 0.7e-3, 170_000)
    line = np.array([0.0, 1.0, 85_000.25, 169_999.0])
    np.testing.assert_allclose(even.at(line), -60.0 + 0.7e-3 * line, rtol=0.0, atol=1e-13)
    for line, time in (([0.0], [0.0]), ([0.0, 0.0], [0.0, 1.0]), ([0.0, 1.0], [1.0, 1.0]), ([0.0, 1.0], [0.0, np.inf])):
        with pytest.raises(ValueError, match="line times"):
            LineTimes.of(line, time)
