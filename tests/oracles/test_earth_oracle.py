"""The Earth's rotation against astropy and Skyfield, with the same UT1 - UTC and polar motion."""

import numpy as np
import pytest

from twin.orbit.flight.earth import Earth

pytestmark = pytest.mark.oracle

ARCSEC = np.pi / 648000
EPOCHS = ["1994-09-01T00:00:00Z", "2011-03-05T03:05:00Z", "2020-11-03T03:30:12.25Z"]
SECONDS = np.array([-40000.0, -600.0, 0.0, 12.34567, 600.0, 86000.0])
POLAR_MOTION = (0.2 * ARCSEC, -0.45 * ARCSEC)
DUT1 = -0.4321


def places() -> np.ndarray:
    """Directions all round at the distance of a satellite, metres."""
    generator = np.random.default_rng(3)
    direction = generator.standard_normal((len(SECONDS), 200, 3))
    return 6.878e6 * direction / np.linalg.norm(direction, axis=-1, keepdims=True)


@pytest.mark.parametrize("epoch", EPOCHS)
@pytest.mark.parametrize("polar_motion", [(0.0, 0.0), POLAR_MOTION])
def test_astropy(epoch: str, polar_motion: tuple[float, float]) -> None:
    """It stands on the same library ERFA, so only our use of it is checked, to rounding of times and lengths."""
    pytest.importorskip("astropy")
    from astropy import units
    from astropy.coordinates import GCRS, ITRS, CartesianRepresentation
    from astropy.time import Time, TimeDelta
    from astropy.utils import iers

    class Given(iers.IERS):
        def pm_xy(self, jd1, jd2=0.0, return_status=False):
            given = tuple(np.full(np.shape(jd1), p) * units.rad for p in polar_motion)
            return (*given, np.zeros(np.shape(jd1), int)) if return_status else given

    # no leap second falls into these spans
    time = Time(epoch.removesuffix("Z"), scale="utc") + TimeDelta(SECONDS, format="sec")
    itrs = Earth(DUT1, polar_motion).to_itrs(SECONDS, epoch)
    checked = 0
    with iers.earth_orientation_table.set(Given()):
        for one, matrix, place in zip(time, itrs, places(), strict=True):
            one.delta_ut1_utc = DUT1
            x, y, z = place.T * units.m
            sky = GCRS(CartesianRepresentation(x, y, z), obstime=one)
            theirs = sky.transform_to(ITRS(obstime=one)).cartesian.xyz.to_value(units.m).T
            np.testing.assert_allclose(place @ matrix.T, theirs, rtol=0, atol=1e-6)
            checked += 1
    assert checked == len(SECONDS)


@pytest.mark.parametrize("epoch", EPOCHS)
def test_skyfield(epoch: str) -> None:
    """Independent code and another way (equinox, not celestial origin). 1 mm is 30 microarcsec: Skyfield lacks the
    small corrections that fit the nutation of 2000 to the precession of 2006 (some 15 microarcsec in these years).
    """
    pytest.importorskip("skyfield")
    from datetime import datetime, timedelta

    from skyfield.api import load
    from skyfield.framelib import itrs as frame

    scale = load.timescale(builtin=True)
    x, y = (p / ARCSEC for p in POLAR_MOTION)
    scale.polar_motion_table = np.array([0.0, 1e7]), np.array([x, x]), np.array([y, y])
    checked = 0
    start = datetime.fromisoformat(epoch)
    for second, place in zip(SECONDS[1:-1], places()[1:-1], strict=True):
        # its UT1 is interpolated from a table, so each instant is an epoch of its own
        instant = start + timedelta(seconds=float(second))
        time = scale.from_datetime(instant)
        text = instant.isoformat().replace("+00:00", "Z")
        ours = Earth(float(time.dut1), POLAR_MOTION).to_itrs(0.0, text)
        theirs = frame.rotation_at(time)
        np.testing.assert_allclose(place @ ours.T, place @ theirs.T, rtol=0, atol=1e-3)
        # and what is switched on can be seen: polar motion moves a satellite by metres
        assert np.max(np.abs(place @ (Earth(float(time.dut1)).to_itrs(0.0, text) - theirs).T)) > 5.0
        checked += 1
    assert checked == 4
