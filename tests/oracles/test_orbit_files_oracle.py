"""Orbits, frames and ground points from files against other people's software on the same files: astropy, Skyfield,
Orekit and the line-sensor model Rugged (pyRugged). The table of Earth orientation is the IERS's own, which astropy
brings.
"""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scenes.specs.orbit.measurements import PlatformFilesSpec
from scenes.specs.orbit.setup import load_three_line_camera
from tests.tiers import quick
from tests.twin import orbit_file_bench as bench
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.line_camera import line_cameras
from twin.orbit.flight.platform_table import TabulatedTrajectory
from twin.orbit.flight.sensor import LightEffects, Sensor
from twin.orbit.measured.earth_orientation import EarthOrientation, angular_velocity, read_earth_orientation
from twin.orbit.measured.platform_files import platform_table, read_platform

pytestmark = pytest.mark.oracle
EPOCHS = ("2011-03-05T03:05:00Z", "2016-12-31T23:00:00Z", "2020-06-01T17:31:00Z")
"""The second has a leap second within the hour."""
SECONDS = np.array([0.0, 100.25, 3599.0, 3605.0])


def iers() -> Path:
    return Path(pytest.importorskip("astropy_iers_data").IERS_A_FILE)


def places() -> np.ndarray:
    generator = np.random.default_rng(5)
    direction = generator.standard_normal((len(SECONDS), 3))
    return 6.9e6 * direction / np.linalg.norm(direction, axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def orekit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Orekit with the same Earth orientation and nothing else."""
    pyrugged = pytest.importorskip("pyrugged")
    pytest.importorskip("orekit_jcc")
    from pyrugged.configuration.init_orekit import init_orekit

    folder = tmp_path_factory.mktemp("orekit")
    data = Path(pyrugged.__path__[0]) / "data/orekit-data-master"
    for name in ("UTC-TAI.history", "itrf-versions.conf"):
        shutil.copy(data / name, folder / name)
    # its readers of messages ask for the Earth's mass
    shutil.copytree(data / "DE-440-ephemerides", folder / "ephemerides")
    shutil.copy(iers(), folder / "finals2000A.all")
    init_orekit(use_internal_data=False, orekit_data_path=str(folder))
    return folder


def point(found: Any) -> tuple[float, float, float]:
    """Longitude, latitude and altitude of a ground point, a tuple or an object."""
    return found if isinstance(found, tuple) else (found.longitude, found.latitude, found.altitude)


def date(epoch: str, seconds: float) -> Any:
    from org.orekit.time import AbsoluteDate, TimeScalesFactory

    return AbsoluteDate(epoch.removesuffix("Z"), TimeScalesFactory.getUTC()).shiftedBy(float(seconds))


@pytest.mark.second
@pytest.mark.parametrize("epoch", EPOCHS)
@pytest.mark.parametrize("frame", ["GCRF", "EME2000"])
def test_inertial_frames_against_orekit(orekit: Path, epoch: str, frame: str) -> None:
    """With pole, UT1 and celestial pole offsets of the same table; 0.6 mm and 2 um/s: its nutation is interpolated."""
    from org.hipparchus.geometry.euclidean.threed import Vector3D
    from org.orekit.frames import FramesFactory
    from org.orekit.utils import IERSConventions, PVCoordinates

    from twin.orbit.measured.platform_files import to_itrs

    itrf = FramesFactory.getITRF(IERSConventions.IERS_2010, True)
    there = FramesFactory.getGCRF() if frame == "GCRF" else FramesFactory.getEME2000()
    rotation = read_earth_orientation(iers()).rotation(epoch, -10.0, 4000.0)
    turn = to_itrs("GCRS" if frame == "GCRF" else frame, rotation)
    velocity = 7500.0 * np.roll(places(), 1, axis=1) / 6.9e6
    position = np.einsum("nij,nj->ni", turn(SECONDS), places())
    speed = np.einsum("nij,nj->ni", turn(SECONDS), velocity) - np.cross(angular_velocity(turn, SECONDS), position)
    for t, r, v, ours, rate in zip(SECONDS, places(), velocity, position, speed, strict=True):
        state = PVCoordinates(Vector3D(*map(float, r)), Vector3D(*map(float, v)))
        found = there.getTransformTo(itrf, date(epoch, t)).transformPVCoordinates(state)
        np.testing.assert_allclose(ours, np.array(found.getPosition().toArray()), rtol=0, atol=6e-4)
        np.testing.assert_allclose(rate, np.array(found.getVelocity().toArray()), rtol=0, atol=2e-6)


@pytest.mark.parametrize("epoch", EPOCHS)
@pytest.mark.parametrize("frame", quick(0, ["GCRS", "TEME"]))
def test_inertial_frames_against_astropy(epoch: str, frame: str) -> None:
    """astropy leaves the celestial pole's offsets out, and joins days by straight lines; at midnight both tables are
    the same. 1 um is rounding; TEME's sidereal time takes 1e-5 m more.
    """
    pytest.importorskip("astropy")
    from astropy import coordinates, units
    from astropy.time import Time
    from astropy.utils import iers as tables

    ours = read_earth_orientation(iers())
    ours = EarthOrientation(ours.file, ours.mjd, ours.ut1_tai, ours.pole, 0.0 * ours.offsets)
    day = epoch[:11] + "00:00:00"
    rotation = ours.rotation(day + "Z", -10.0, 10.0)
    matrix = rotation.matrix(np.zeros(1))[0] if frame == "GCRS" else rotation.teme_to_itrs(np.zeros(1))[0]
    with tables.earth_orientation_table.set(tables.IERS_A.open(str(iers()))):
        time = Time(day, scale="utc")
        for place in places():
            there = getattr(coordinates, frame)(coordinates.CartesianRepresentation(*place * units.m), obstime=time)
            found = there.transform_to(coordinates.ITRS(obstime=time)).cartesian.xyz.to_value(units.m)
            np.testing.assert_allclose(matrix @ place, found, rtol=0, atol=1e-6 if frame == "GCRS" else 1e-5)


def test_teme_against_skyfield() -> None:
    """Its own code for TEME. It knows UT1 from its own table, so ours is set to that; polar motion is left out."""
    pytest.importorskip("skyfield")
    from skyfield.api import load
    from skyfield.sgp4lib import TEME_to_ITRF

    from twin.orbit.measured.earth_orientation import constant_orientation

    time = load.timescale(builtin=True).utc(2011, 3, 5, 3, 5, 0.0)
    table = constant_orientation(EPOCHS[0], float(time.dut1), (0.0, 0.0))
    ours = table.rotation(EPOCHS[0], -1.0, 1.0).teme_to_itrs(np.zeros(1))[0]
    for place in places():
        theirs, _ = TEME_to_ITRF(time.ut1, place, np.zeros(3))
        # its UT1 is a Julian date in one float64: 2e-5 s of the Earth's turn, 1 cm
        np.testing.assert_allclose(ours @ place, theirs, rtol=0, atol=2e-2)


def read(folder: Path, orbit: dict[str, Any], attitude: dict[str, Any]) -> Any:
    spec = PlatformFilesSpec.model_validate({"orbit": orbit, "attitude": attitude, "earth_orientation": str(iers())})
    return platform_table(*read_platform(spec, folder), bench.EPOCH)


@pytest.mark.second
def test_messages_against_orekit_s_own_readers(orekit: Path, tmp_path: Path) -> None:
    """OEM, AEM and SP3 are parsed by Orekit, brought to its ITRF, and compared with what we make of the same files."""
    from org.hipparchus.geometry.euclidean.threed import Vector3D
    from org.orekit.data import DataSource
    from org.orekit.files.ccsds.ndm import ParserBuilder
    from org.orekit.files.ccsds.ndm.adm.aem import Aem, AemSegment
    from org.orekit.files.ccsds.ndm.odm.oem import Oem, OemSegment
    from org.orekit.files.sp3 import SP3Coordinate, SP3Ephemeris, SP3Parser, SP3Segment
    from org.orekit.frames import FramesFactory, StaticTransform
    from org.orekit.utils import IERSConventions, TimeStampedAngularCoordinates, TimeStampedPVCoordinates

    itrf = FramesFactory.getITRF(IERSConventions.IERS_2010, True)
    bench.oem(tmp_path / "a.oem", "EME2000", "TAI", step=5.0)
    bench.aem(tmp_path / "a.aem", "GPS", "B2A", first=True, step=5.0)
    bench.sp3(tmp_path / "a.sp3", step=5.0)
    attitude = {"file": "a.aem", "body_axes": bench.AXES}
    ours = read(tmp_path, {"file": "a.oem"}, attitude)
    oem = Oem.cast_(ParserBuilder().buildOemParser().parseMessage(DataSource(str(tmp_path / "a.oem"))))
    segment = OemSegment.cast_(oem.getSegments().get(0))
    frame = segment.getFrame()
    for k, one in enumerate(list(segment.getCoordinates())[::6]):
        state = TimeStampedPVCoordinates.cast_(one)
        found = frame.getTransformTo(itrf, state.getDate()).transformPVCoordinates(state)
        np.testing.assert_allclose(ours.position[6 * k], found.getPosition().toArray(), rtol=0, atol=6e-4)
        np.testing.assert_allclose(ours.velocity[6 * k], found.getVelocity().toArray(), rtol=0, atol=2e-6)
        assert abs(state.getDate().durationFrom(date(bench.EPOCH, ours.orbit_time[6 * k]))) < 1e-9
    aem = Aem.cast_(ParserBuilder().buildAemParser().parseMessage(DataSource(str(tmp_path / "a.aem"))))
    provider = AemSegment.cast_(aem.getSegments().get(0))
    states = [TimeStampedAngularCoordinates.cast_(one) for one in provider.getAngularCoordinates()]
    path = TabulatedTrajectory(ours)
    for state in states[3:-3:6]:
        when = state.getDate()
        t = when.durationFrom(date(bench.EPOCH, 0.0))
        inertial = FramesFactory.getGCRF()
        turn = state.getRotation()  # from the frame outside to the body, as their reader turns every direction
        for axis in np.eye(3):
            body = Vector3D(*axis.tolist())
            to_itrf = StaticTransform.cast_(inertial.getTransformTo(itrf, when))
            seen = to_itrf.transformVector(turn.applyInverseTo(body))
            np.testing.assert_allclose(path.body_to_itrs(np.array([t]))[0] @ axis, seen.toArray(), rtol=0, atol=1e-9)
    theirs = SP3Parser().parse(DataSource(str(tmp_path / "a.sp3")))
    satellite = SP3Ephemeris.cast_(theirs.getSatellites().get("L51"))
    samples = list(SP3Segment.cast_(satellite.getSegments().get(0)).getCoordinates())
    mine = read(tmp_path, {"file": "a.sp3", "satellite": "L51"}, attitude)
    assert len(samples) == len(mine.orbit_time)
    for k, one in enumerate(samples):
        state = SP3Coordinate.cast_(one)
        np.testing.assert_allclose(mine.position[k], state.getPosition().toArray(), rtol=0, atol=1e-8)
        np.testing.assert_allclose(mine.velocity[k], state.getVelocity().toArray(), rtol=0, atol=1e-11)
        assert abs(state.getDate().durationFrom(date(bench.EPOCH, mine.orbit_time[k]))) < 1e-9


@pytest.mark.second
def test_rugged_sees_the_same_ground_points(orekit: Path, tmp_path: Path) -> None:
    """The camera's looks, orbit and attitude in the GCRF go to Rugged, the same files to us; with light time and
    aberration, at three heights, within 5 mm. Its table of frames has steps of 10 ms.
    """
    from org.hipparchus.geometry.euclidean.threed import Rotation, Vector3D
    from org.orekit import utils
    from pyrugged.bodies.body_rotating_frame_id import BodyRotatingFrameId
    from pyrugged.bodies.ellipsoid_id import EllipsoidId
    from pyrugged.intersection.constant_elevation_algorithm import ConstantElevationAlgorithm
    from pyrugged.line_sensor.line_sensor import LineSensor
    from pyrugged.line_sensor.linear_line_datation import LinearLineDatation
    from pyrugged.location.optical import CorrectionsParams, OpticalLocation
    from pyrugged.los.los_builder import LOSBuilder
    from pyrugged.model.inertial_frame_id import InertialFrameId
    from pyrugged.model.pyrugged_builder import PyRuggedBuilder

    bench.oem(tmp_path / "a.oem", "GCRF")
    bench.aem(tmp_path / "a.aem")
    ours = read(tmp_path, {"file": "a.oem"}, {"file": "a.aem", "body_axes": bench.AXES})
    path = TabulatedTrajectory(ours)
    s, zero = bench.sampled("GCRS"), Vector3D.ZERO
    states = [
        utils.TimeStampedPVCoordinates(date(bench.EPOCH, t), Vector3D(*map(float, r)), Vector3D(*map(float, v)), zero)
        for t, r, v in zip(s.seconds, s.position, s.velocity, strict=True)
    ]
    looks = np.arange(-60.0, 60.0 + 1e-9, 0.25)
    turns = [
        utils.TimeStampedAngularCoordinates(date(bench.EPOCH, t), Rotation(*map(float, q), True), zero, zero)
        for t, q in zip(looks, bench.quaternions(looks, "GCRS", "wxyz"), strict=True)
    ]
    worst = 0.0
    cameras = line_cameras(load_three_line_camera("th1"))
    for name, camera in ((name, cameras[name]) for name in ("forward", "nadir", "backward")):
        pixels = np.linspace(0.0, camera.pixels - 1.0, 7)
        los = LOSBuilder(list(camera.look(pixels))).build()
        datation = LinearLineDatation(date(bench.EPOCH, 0.0), 0.0, 1.0)
        sensor = LineSensor(name, datation, np.zeros(3), los)
        builder = PyRuggedBuilder()
        builder.set_ellipsoid(ellipsoid_id=EllipsoidId.WGS84, body_rotating_frame_id=BodyRotatingFrameId.ITRF)
        builder.set_time_span(date(bench.EPOCH, -20.0), date(bench.EPOCH, 20.0), 0.01, 0.1)
        by_pv, by_r = utils.CartesianDerivativesFilter.USE_PV, utils.AngularDerivativesFilter.USE_R
        builder.set_trajectory(states, 8, by_pv, turns, 8, by_r, inertial_frame_id=InertialFrameId.GCRF)
        builder.add_sensor(sensor)
        effects = LightEffects(refraction=False)
        mine = Sensor(camera, path, Earth(), 1.0, -20.0, 41, effects)
        for height in (0.0, 500.0, 4000.0):
            located = OpticalLocation(
                builder.build(), ConstantElevationAlgorithm(height), CorrectionsParams(True, True, None)
            )
            for t in (-17.3, 0.0, 11.9):
                found = located.direct_location_of_sensor_line(t, name)
                theirs = np.array([Earth().ecef(*point(one)) for one in found])
                here = mine.ground(np.full(7, t + 20.0), pixels, height)
                worst = max(worst, float(np.max(np.linalg.norm(here - theirs, axis=1))))
    assert 0.0 < worst < 5e-3
