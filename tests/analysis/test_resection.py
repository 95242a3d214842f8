"""Space resection of three lines against the synthetic pass of test_planes, whose rays are turned by OpenCV."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from analysis.orbit.planes import Station, Strip
from analysis.orbit.resection import ObservedLine, ResectionError, resect
from tests.analysis.refusals import refuses
from tests.analysis.test_planes import ARCSEC, DEG, LINES, LOOK, SCENE, descending_pass, noisy, rotation

PAIRS = (("forward", "nadir"), ("nadir", "backward"))
NAMES = ("roll", "pitch", "yaw", "forward look", "backward look")


def observed(scene, noise=1.5, sigma=0.0, lines=("forward", "nadir", "backward")):
    return {
        k: ObservedLine.of(Strip.of(scene.points[k], noise), scene.tangents[k], sigma, look=LINES[k]) for k in lines
    }


def turn_error(result, body):
    """Rotation vector in the body's axes from the true to the found attitude."""
    return Rotation.from_matrix(body.T @ result.attitude).as_rotvec()


@pytest.mark.parametrize("sigma_station", [0.0, 0.5])
def test_exact_geometry_is_recovered(sigma_station):
    """Coordinates of 7e6 m are rounded to 1e-9 m, seen from 500 km 4e-10 arcsec per point."""
    result = resect(Station.of(SCENE.station, sigma_station), observed(SCENE))
    assert np.abs(result.angles(PAIRS) - LOOK).max() < 1e-8 * ARCSEC
    # roll and pitch share their error with a free station coordinate
    assert np.abs(turn_error(result, SCENE.body)).max() < 1e-7 * ARCSEC
    assert result.station == pytest.approx(SCENE.station, abs=1e-6)
    assert result.chi_square < 1e-10
    assert result.degrees_of_freedom == 120 - 5
    assert result.iterations < 6


def test_unequal_look_angles_and_distortion():
    """Look angles of a two-line camera and 3 deg: each line's own. A curved line has tangents across, too."""
    scene = descending_pass(looks={"forward": 26 * DEG, "nadir": -5 * DEG, "backward": -8 * DEG})
    lines = {k: ObservedLine.of(Strip.of(p, 1.5), scene.tangents[k]) for k, p in scene.points.items()}
    result = resect(Station.of(scene.station), lines)
    assert result.angles(PAIRS) == pytest.approx([31 * DEG, 3 * DEG], abs=1e-13)
    # a line turned by 1 deg about its line of sight: tx = -ty' sin(1 deg), ty = ty' cos(1 deg)
    turned = descending_pass(twist=1 * DEG)
    lines = observed(turned)
    w = turned.tangents["forward"]
    seen = np.column_stack([-np.sin(DEG) * w, np.cos(DEG) * w])
    lines["forward"] = ObservedLine.of(lines["forward"].strip, seen)
    result = resect(Station.of(turned.station), lines)
    assert result.looks["forward"] == pytest.approx(LOOK, abs=1e-13)
    assert result.chi_square < 1e-10


@pytest.mark.second
def test_covariance_is_that_of_a_numerical_jacobian():
    """Points moved one by one in the input: the sum of squares of what the answer does, times the variance."""
    scene = descending_pass(n=4)
    station = Station.of(scene.station)
    base = resect(station, observed(scene, 2.0))
    step, total = 10.0, np.zeros((5, 5))
    for name, points in scene.points.items():
        for index in np.ndindex(points.shape):
            change = []
            for sign in (1, -1):
                lines = observed(scene, 2.0)
                moved = points.copy()
                moved[index] += sign * step
                lines[name] = ObservedLine.of(Strip.of(moved, 2.0), scene.tangents[name])
                result = resect(station, lines)
                looks = [result.looks["forward"], result.looks["backward"]]
                change.append(np.concatenate([turn_error(result, scene.body), looks]))
            slope = (change[0] - change[1]) / (2 * step)
            total += 4.0 * np.outer(slope, slope)
    # the step's third order is (10 / 5e5)^2; weights that move with the points 10 / 5e5 of the off-diagonal terms
    scale = np.sqrt(np.outer(np.diag(total), np.diag(total)))
    assert np.abs((base.covariance - total) / scale).max() < 1e-5
    assert base.names == NAMES
    assert base.sigma["forward look"] == pytest.approx(np.sqrt(total[3, 3]), rel=1e-5)
    # alpha is the forward look, beta minus the backward one, and their difference from forward to backward
    part, signs = total[3:, 3:], np.array([[1.0, 0.0], [0.0, -1.0], [1.0, -1.0]])
    found = base.angle_covariance((*PAIRS, ("forward", "backward")))
    assert found == pytest.approx(signs @ part @ signs.T, rel=1e-4)


def test_what_the_points_cannot_tell_is_named():
    station = Station.of(SCENE.station)
    # two points of a line at one place but for 1e-12: yaw moves them as pitch does
    tangent, arm = np.array([0.05, 0.05 + 1e-12]), SCENE.points["nadir"][0] - SCENE.station
    twice = np.array([arm, arm * (1.0 + 1e-9)]) + SCENE.station
    with pytest.raises(ResectionError, match=r"do not determine: .*yaw") as caught:
        resect(station, {"nadir": ObservedLine.of(Strip.of(twice, 1.0), tangent)})
    vector = dict(zip(NAMES[:3], caught.value.null_vectors[0], strict=True))
    # a turn about the line of sight itself, 0.05 to the right of the vertical
    assert abs(vector["roll"]) < 0.2
    assert vector["yaw"] == pytest.approx(1.0)
    # one point per line
    few = {k: ObservedLine.of(Strip.of(p[:1], 1.0), SCENE.tangents[k][:1]) for k, p in SCENE.points.items()}
    refuses(ResectionError, "no line has two points at different places", resect, station, few)
    nadir = observed(SCENE, lines=("nadir",))
    alone = resect(station, nadir)
    assert alone.names == ("roll", "pitch", "yaw")
    for method in (alone.angles, alone.angle_covariance):
        refuses(ResectionError, "no backward and no forward line among nadir", method, (("forward", "backward"),))


@pytest.mark.parametrize("pair", [("forward", "nadir"), ("forward", "backward"), ("backward", "nadir")])
def test_two_lines_tell_their_angle(pair):
    """One angle, four unknowns; which of the lines is the reference changes neither the angle nor its sigma."""
    station, lines = Station.of(SCENE.station, 0.5), observed(SCENE, lines=pair)
    first, second = (resect(station, lines, reference=name) for name in pair)
    expected = LINES[pair[0]] - LINES[pair[1]]
    for result, reference in ((first, pair[0]), (second, pair[1])):
        assert result.looks[reference] == 0.0
        assert len(result.names) == 7
        assert result.angles((pair,))[0] == pytest.approx(expected, abs=1e-8 * ARCSEC)
        assert result.angles((pair[::-1],))[0] == pytest.approx(-expected, abs=1e-8 * ARCSEC)
    assert first.angle_covariance((pair,)) == pytest.approx(second.angle_covariance((pair,)), rel=1e-6)
    assert second.attitude == pytest.approx(
        first.attitude @ rotation([0, LINES[pair[1]] - LINES[pair[0]], 0]), abs=1e-9
    )


def test_projection_centres_beside_the_station():
    """Cameras 1.4 m before and behind the station, each pixel with its own: 0.6 arcsec each if they are left out."""
    scene = descending_pass(looks={"forward": 26 * DEG, "backward": -5 * DEG})
    rng, lines, bare = np.random.default_rng(3), {}, {}
    for name, look in (("forward", 26 * DEG), ("backward", -5 * DEG)):
        axes = scene.body @ rotation([0, look, 0])
        middle = np.array([np.copysign(1.4, look), 0.0, 0.2])
        offset = middle + rng.uniform(-0.1, 0.1, (20, 3))
        strip = Strip.of(scene.points[name] + offset @ axes.T, 1.5)
        lines[name] = ObservedLine.of(strip, scene.tangents[name], look=look, offset=offset)
        bare[name] = ObservedLine.of(strip, scene.tangents[name])
    pair = (("forward", "backward"),)
    found, wrong = (resect(Station.of(scene.station), given, reference="backward") for given in (lines, bare))
    assert found.angles(pair)[0] == pytest.approx(31 * DEG, abs=1e-8 * ARCSEC)
    assert found.chi_square < 1e-10
    assert found.axes("forward") == pytest.approx(scene.body @ rotation([0, 26 * DEG, 0]), abs=1e-12)
    assert abs(wrong.angles(pair)[0] - 31 * DEG) > 0.5 * ARCSEC


def test_bad_input():
    station = Station.of(SCENE.station)
    lines = observed(SCENE)
    swapped = {
        k: replace(lines[other], look=LINES[k])
        for k, other in (("forward", "backward"), ("nadir", "nadir"), ("backward", "forward"))
    }
    refuses(ResectionError, "lines exchanged", resect, station, swapped)
    mirrored = {k: replace(v, tangent=-v.tangent) for k, v in lines.items()}
    refuses(ResectionError, "counted from the other end", resect, station, mirrored)
    with pytest.raises(ResectionError, match="reference 'left' is none of the lines forward, nadir, backward"):
        resect(station, lines, reference="left")
    refuses(ResectionError, "no lines", resect, station, {})
    points = lines["nadir"].strip.points.copy()
    points[0] = 2.0 * SCENE.station - points[0]
    above = replace(lines["nadir"], strip=replace(lines["nadir"].strip, points=points))
    refuses(ResectionError, "nadir line lie behind the camera", resect, station, lines | {"nadir": above})
    bare = replace(lines["nadir"], strip=replace(lines["nadir"].strip, points=np.zeros((0, 3))))
    refuses(ResectionError, "the nadir line has no points", resect, station, lines | {"nadir": bare})
    refuses(ResectionError, "positive definite", resect, Station.of(SCENE.station, np.diag([1.0, 1.0, 0.0])), lines)
    with pytest.raises(ResectionError, match="no convergence"):
        resect(Station.of(noisy(SCENE, np.random.default_rng(1), 0, 9).station, 1.0), lines, iterations=1)
    for tangent in (np.full(20, np.nan), np.zeros(3), np.zeros((20, 3))):
        refuses(ResectionError, "tangents", ObservedLine.of, lines["nadir"].strip, tangent)
    for offset in (np.zeros(2), np.zeros((3, 3)), [np.nan, 0.0, 0.0]):
        refuses(ResectionError, "offset", ObservedLine.of, lines["nadir"].strip, SCENE.tangents["nadir"], offset=offset)
    refuses(ResectionError, "sigma", ObservedLine.of, lines["nadir"].strip, SCENE.tangents["nadir"], -1.0)
