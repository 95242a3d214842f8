"""Intersection angles from ground points, end to end: against hand calculations, statistics, and of other cameras."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from analysis.arrays import ARCSEC
from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.angle import LINES
from scenes.specs.orbit.setup import AngleSetup
from tests.tiers import quick
from twin.orbit.angle.angle_flight import AngleCamera, AnglePass, angle_camera, fly
from twin.orbit.angle.angle_run import estimate_angles, run_angle, tls_angles, values_of
from twin.orbit.flight.line_camera import look_angle
from twin.orbit.flight.sensor import NO_EFFECTS, LightEffects

EXAMPLE = SCENES / ORBIT / "angle.yaml"
SETUP = AngleSetup.read(EXAMPLE)
LOOK = np.radians(25.0)


def setup_with(**changes) -> AngleSetup:
    """The example with other values; nested ones as dictionaries."""
    test = SETUP.test
    update = {k: getattr(test, k).model_copy(update=v) if isinstance(v, dict) else v for k, v in changes.items()}
    return SETUP.model_copy(update={"test": test.model_copy(update=update)})


def flown(**changes) -> AnglePass:
    setup = setup_with(**changes)
    return fly(setup, angle_camera(setup, None), np.random.SeedSequence(5))


@pytest.fixture(scope="module")
def flight() -> AnglePass:
    return flown()


@pytest.fixture(scope="module")
def full():
    """The example as it is."""
    return run_angle(SETUP, None, 1)


def directions(name: str, pixel: np.ndarray) -> np.ndarray:
    """Looks of a line of th1 in orbit, by collinearity from the file's numbers, body frame, (N, 3)."""
    line, camera = SETUP.camera.lines[name], SETUP.camera
    y = (pixel - 0.5 * (camera.pixels - 1)) * camera.pitch - line.principal_point[1]
    x = np.full_like(y, -line.principal_point[0])
    grow = 1.0 + line.k1 * (x**2 + y**2)
    vectors = np.stack([-x * grow, -y * grow, np.full_like(y, line.principal_distance)], axis=-1)
    change = SETUP.test.perturb.get(name)
    turned = Rotation.from_rotvec(change.rotate if change else (0.0, 0.0, 0.0))
    vectors = (turned * Rotation.from_euler("Y", line.look) * Rotation.from_rotvec(line.rotate)).apply(vectors)
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def true_angles() -> tuple[np.ndarray, np.ndarray]:
    """Look and dihedral angles (alpha, beta) of the turned camera, from the file's numbers alone."""
    centre = {name: directions(name, np.array([5999.5]))[0] for name in LINES}
    normal = {name: np.linalg.svd(directions(name, np.linspace(100.0, 11899.0, 60)))[2][2] for name in LINES}
    pairs = (("forward", "nadir"), ("nadir", "backward"))
    dihedral = [angle(normal[a], normal[b]) for a, b in pairs]
    return (np.array([angle(centre[a], centre[b]) for a, b in pairs]), np.array([min(v, np.pi - v) for v in dihedral]))


@pytest.mark.parametrize("effects", [NO_EFFECTS, LightEffects()], ids=["no effects", "effects corrected"])
def test_without_errors_the_angles_come_back(effects: LightEffects) -> None:
    """To 1e-4 arcsec. The largest miss, 9e-5 arcsec of the forward line's look, is the file's camera: distortion moves
    the middle of a line whose principal point lies 8 um off it by 4e-10 rad out of the plane through the rest.
    """
    errors = {"station": 0.0, "points": 0.0}
    flight = flown(errors=errors)
    look, dihedral = true_angles()
    found = estimate_angles(flight.measure(flight.ground(effects), None, effects))
    for method in ("tls", "corrected", "printed"):
        assert np.abs(found.angles[method].values - dihedral).max() < 1e-4 * ARCSEC
    assert np.abs(found.look - look).max() < 1e-4 * ARCSEC
    # the lines have turned by 4 and 3 arcsec since the laboratory, from which the angles differ by as much
    nominal = np.array([look_angle(*(flight.laboratory[k] for k in pair)) for pair in flight.pairs.values()])
    assert found.look - nominal == pytest.approx([4.0 * ARCSEC, -3.0 * ARCSEC], rel=0.01)
    # The resection's angle is one of pitch. Lines of sight that begin e across the track, here up to 1e-4 rad (20
    # arcsec of roll), have look angles that differ from it by at most e^2 (1 + cos 25 deg)/sin 25 deg, 0.0093 arcsec.
    assert np.abs(found.resection.angles(tuple(flight.pairs.values())) - look).max() < 0.01 * ARCSEC


def bias(flight: AnglePass, effects: LightEffects) -> np.ndarray:
    measured = tls_angles(flight.measure(flight.ground(effects), None))
    return (measured.values - true_angles()[1]) / ARCSEC


def test_aberration_by_hand(flight: AnglePass) -> None:
    """The look tilts by v/c times the sine of its angle from the velocity: 1 at nadir, cos 25 deg at the others. A
    forward point thus lies farther from the nadir point than it seems, a backward one nearer. 3%: at 40 N the normal of
    the ellipsoid leaves the radius by d = 0.19 deg, and the velocity leaves X by as much; d sin 25 deg over
    1 - cos 25 deg is 1.5%.
    """
    expected = np.linalg.norm(flight.velocity) / 299_792_458.0 * (1.0 - np.cos(LOOK)) / ARCSEC
    found = bias(flight, replace(NO_EFFECTS, aberration=True))
    assert found == pytest.approx([expected, -expected], rel=0.03)
    assert 0.45 < expected < 0.52


@pytest.mark.second
def test_scatter_of_200_passes_matches_sigma(full) -> None:
    """Chi-square of the spread, of both angles together with their covariance, and of the mean; each at 0.1% to either
    side: 15 statements, false alarm 1.5% over seeds. A sigma wrong by a
    factor of 0.7 or 1.4 is found: the spread of 200 passes is good to 5%.
    """
    for scatter in (full.planes, full.along, full.resection):
        count = len(scatter.values)
        assert count == 200
        assert np.all(scatter.p_value > 1e-3)
        for wrong in (0.7, 1.4):
            assert np.all(replace(scatter, covariance=scatter.covariance * wrong**2).p_value < 1e-3)
        off = scatter.values - scatter.values.mean(axis=0)
        square = np.einsum("ni,ij,nj->", off, np.linalg.inv(scatter.covariance), off)
        assert chi2.ppf(5e-4, 2 * count - 2) < square < chi2.ppf(1 - 5e-4, 2 * count - 2)
        assert np.abs(scatter.bias).max() < 3.3 * scatter.sigma.max() / np.sqrt(count)


def test_a_short_orbit_has_no_intersection() -> None:
    short = flown(orbit={"before": 5.0, "after": 60.0})
    heights = short.height_per_arcsec()
    assert heights["alpha"] is None
    assert heights["beta"] > 5.0


@pytest.mark.second
def test_a_datum_shift_is_the_stations_shift_reversed() -> None:
    """Moving all points by s is moving the station by -s, with the linear slopes; second order is 1e-5 of it."""
    shift = (10.0, -4.0, 7.0)
    run_ = run_angle(setup_with(errors={"datum": shift}, passes=2), None, 3)
    (datum,) = (row for row in run_.effects if row.what == "datum")
    slopes = np.array([row.slope for row in run_.table if row.what == "station"])
    expected = -(np.array(shift) @ run_.flight.local) @ slopes
    assert datum.bias == pytest.approx(expected, rel=2e-3, abs=1e-4 * ARCSEC)
    assert np.abs(datum.bias).max() > ARCSEC


# The command


# --- other cameras: a traced stereo pair that has changed, off-axis lines ---------------------------------------------


PAIR, OFF_AXIS = (AngleSetup.read(SCENES / ORBIT / f"{name}.yaml") for name in ("angle_gf7", "angle_off_axis"))


def without_errors(setup: AngleSetup) -> AngleSetup:
    errors = setup.test.errors.model_copy(update={"station": 0.0, "points": 0.0})
    return setup.model_copy(update={"test": setup.test.model_copy(update={"errors": errors})})


def found(flight: AnglePass, effects: LightEffects):
    return estimate_angles(flight.measure(flight.ground(effects), None, effects))


# The stereo pair


@pytest.fixture(scope="module")
def changed(backend) -> AngleCamera:
    """The example's lines: nominal, and with the focal plane turned and the base warmed."""
    return angle_camera(PAIR, backend)


@pytest.mark.parametrize("state", quick(0, ["nominal", "perturbed"]))
@pytest.mark.parametrize("effects", [NO_EFFECTS, LightEffects()], ids=["no effects", "effects corrected"])
def test_the_ground_tells_the_traced_angle(changed, state: str, effects: LightEffects) -> None:
    """To 1e-4 arcsec, and its change to 1e-3, also by the trace that knows neither orbit nor ground. What is left is
    the effects' correction, which is taken for the station and not for a camera 1.4 m away, and the bend's prior."""
    camera = changed if state == "perturbed" else replace(changed, cameras=changed.laboratory)
    flight = fly(without_errors(PAIR), camera, np.random.SeedSequence(5))
    estimate = found(flight, effects)
    traced = flight.look["alpha"]
    assert abs(estimate.look[0] - traced) < 1e-4 * ARCSEC
    assert abs(estimate.along.values[0] - flight.along_track["alpha"]) < 1e-4 * ARCSEC
    change = estimate.look[0] - flight.before_launch.look["alpha"]
    expected = changed.trace["alpha"] if state == "perturbed" else 0.0
    assert abs(change - expected) < 1e-3 * ARCSEC
    # a rigid line's resection and a bent line's plane are good to less, but far below the noise of 0.1 arcsec
    assert abs(estimate.resection.angles((("forward", "backward"),))[0] - traced) < 1e-3 * ARCSEC
    assert np.abs(estimate.angles["tls"].values - flight.dihedral["alpha"]).max() < 2e-3 * ARCSEC


# Off-axis lines


@pytest.mark.second
@pytest.mark.parametrize("effects", [NO_EFFECTS, LightEffects()], ids=["no effects", "effects corrected"])
def test_off_axis_angles_come_back(effects: LightEffects) -> None:
    """Dihedral, look and along-track angles to 1e-4 arcsec, of near and far lines."""
    setup = without_errors(OFF_AXIS)
    flight = fly(setup, angle_camera(setup, None), np.random.SeedSequence(5))
    estimate = found(flight, effects)
    assert np.abs(estimate.angles["tls"].values - values_of(flight.dihedral)).max() < 1e-4 * ARCSEC
    assert np.abs(estimate.look - values_of(flight.look)).max() < 1e-4 * ARCSEC
    assert np.abs(estimate.along.values - values_of(flight.along_track)).max() < 1e-4 * ARCSEC
    # by hand: 2 deg and the misalignments about Y of both lines with the changes about Y since
    by_hand = {"high_resolution": 7200.0 - 12.0 - 3.0 - 15.0, "multispectral": 48.0 + 2.0 - 15.0}
    # principal points in x turn the look by x0/f, in arc seconds; the rest is second order
    shift = {"high_resolution": (-6e-6 / 1.625 + 5e-6 / 0.65), "multispectral": (7e-6 / 0.65 + 5e-6 / 0.65)}
    for k, name in enumerate(flight.pairs):
        if name in by_hand:
            expected = by_hand[name] * ARCSEC + shift[name]
            assert estimate.along.values[k] == pytest.approx(expected, abs=0.01 * ARCSEC)


@pytest.mark.second
def test_parallel_lines_are_folded_and_the_report_says_so() -> None:
    """A line turned so that its plane is the nadir line's: unsigned planes are told as folded, the signed angle not."""
    camera = OFF_AXIS.camera
    lines = dict(camera.lines)
    lines["multispectral"] = lines["nadir"].model_copy(update={"pixels": 6000, "pitch": 13e-6})
    changes = {k: v for k, v in OFF_AXIS.test.perturb.items() if k != "multispectral"}
    test = OFF_AXIS.test.model_copy(update={"passes": 2, "perturb": changes})
    setup = OFF_AXIS.model_copy(update={"test": test, "camera": camera.model_copy(update={"lines": lines})})
    full = run_angle(setup, None, 4)
    few = full.names.index("multispectral")
    assert full.estimate.angles["tls"].folded[few]
    assert abs(full.estimate.along.values[few]) < 4.0 * full.estimate.along.sigma[few]
    assert full.estimate.along.sigma[few] < 0.2 * ARCSEC


# The command
