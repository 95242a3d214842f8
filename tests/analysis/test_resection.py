"""Space resection of three lines against the synthetic pass of test_planes, whose rays are turned by OpenCV."""

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from analysis.orbit.angles import intersection_angles
from analysis.orbit.planes import Station, Strip
from analysis.orbit.resection import ObservedLine, ResectionError, resect
from tests.analysis.test_planes import ARCSEC, DEG, LOOK, SCENE, bounds, descending_pass, fits, noisy

FALSE_ALARM = 1e-6


def observed(scene, noise=1.5, sigma=0.0, lines=("forward", "nadir", "aft")):
    return {k: ObservedLine.of(Strip.of(scene.points[k], noise), scene.tangents[k], sigma) for k in lines}


def turn_error(result, body):
    """Rotation vector in the body's axes from the true to the found attitude."""
    return Rotation.from_matrix(body.T @ result.attitude).as_rotvec()


@pytest.mark.parametrize("sigma_station", [0.0, 0.5])
def test_exact_geometry_is_recovered(sigma_station):
    """Coordinates of 7e6 m are rounded to 1e-9 m, seen from 500 km 4e-10 arcsec per point."""
    result = resect(Station.of(SCENE.station, sigma_station), observed(SCENE))
    assert np.abs(np.array([result.alpha, result.beta]) - LOOK).max() < 1e-8 * ARCSEC
    # roll and pitch share their error with a free station coordinate
    assert np.abs(turn_error(result, SCENE.body)).max() < 1e-7 * ARCSEC
    assert result.station == pytest.approx(SCENE.station, abs=1e-6)
    assert result.chi_square < 1e-10
    assert result.degrees_of_freedom == 120 - 5
    assert result.iterations < 6


def test_unequal_look_angles_and_distortion():
    """Look angles of a two-line camera and 3 deg: each line's own. A curved line has tangents across, too."""
    scene = descending_pass(looks={"forward": 26 * DEG, "nadir": -5 * DEG, "aft": -8 * DEG})
    result = resect(Station.of(scene.station), observed(scene))
    assert result.alpha == pytest.approx(31 * DEG, abs=1e-13)
    assert result.beta == pytest.approx(3 * DEG, abs=1e-13)
    # a line turned by 1 deg about its line of sight: tx = -ty' sin(1 deg), ty = ty' cos(1 deg)
    turned = descending_pass(twist=1 * DEG)
    lines = observed(turned)
    w = turned.tangents["forward"]
    seen = np.column_stack([-np.sin(DEG) * w, np.cos(DEG) * w])
    lines["forward"] = ObservedLine.of(lines["forward"].strip, seen)
    result = resect(Station.of(turned.station), lines)
    assert result.alpha == pytest.approx(LOOK, abs=1e-13)
    assert result.chi_square < 1e-10


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
                change.append(np.concatenate([turn_error(result, scene.body), [result.alpha, result.beta]]))
            slope = (change[0] - change[1]) / (2 * step)
            total += 4.0 * np.outer(slope, slope)
    # the step's third order is (10 / 5e5)^2; weights that move with the points 10 / 5e5 of the off-diagonal terms
    scale = np.sqrt(np.outer(np.diag(total), np.diag(total)))
    assert np.abs((base.covariance - total) / scale).max() < 1e-5
    assert base.names == ("roll", "pitch", "yaw", "alpha", "beta")
    assert base.sigma["alpha"] == pytest.approx(np.sqrt(total[3, 3]), rel=1e-5)


@pytest.mark.parametrize(("sigma_station", "sigma_image"), [(0.0, 0.0), (1.0, 3e-6)])
def test_scatter_agrees_with_covariance(sigma_station, sigma_image):
    """Draws with points of 1.5 m and tangents of 0.3 pixel: chi-square of all unknowns and of the residuals."""
    rng = np.random.default_rng([12, int(sigma_station)])
    total, residual, draws, p_values = 0.0, 0.0, 400, []
    for _ in range(draws):
        scene = noisy(SCENE, rng, 1.5, sigma_station)
        lines = {}
        for name, points in scene.points.items():
            inside = np.column_stack([np.zeros(20), scene.tangents[name]]) + sigma_image * rng.standard_normal((20, 2))
            lines[name] = ObservedLine.of(Strip.of(points, 1.5), inside, sigma_image)
        result = resect(Station.of(scene.station, sigma_station), lines)
        error = np.concatenate([turn_error(result, SCENE.body), [result.alpha - LOOK, result.beta - LOOK]])
        if sigma_station:
            error = np.concatenate([error, result.station - SCENE.station])
        total += error @ np.linalg.solve(result.covariance, error)
        residual += result.chi_square
        p_values.append(result.p_value)
    assert bounds(total, draws * len(error))
    assert bounds(residual, draws * (120 - 5))
    assert stats.kstest(p_values, "uniform").pvalue > FALSE_ALARM


def test_planes_and_resection_differ_within_their_sigmas():
    """Same points, same station: the methods differ by much less than the angles' own errors, for the pitch of each
    line is what both see, and far below the paper's 0.44 and 1.53 arcsec (those contain more than geometry).
    """
    rng = np.random.default_rng(13)
    differences, sigmas = [], []
    for _ in range(60):
        scene = noisy(SCENE, rng, 1.5, 0.5)
        planes = intersection_angles(*fits(scene, noise=1.5, sigma_station=0.5))
        result = resect(Station.of(scene.station, 0.5), observed(scene))
        differences.append(planes.values - [result.alpha, result.beta])
        sigmas.append(planes.sigma)
        # the stiffer model cannot be less certain
        assert np.all(np.diag(result.angle_covariance) < np.diag(planes.covariance) * (1 + 1e-9))
    assert np.std(differences) < 0.5 * np.mean(sigmas)
    assert np.std(differences) < 0.2 * ARCSEC


def test_what_the_points_cannot_tell_is_named():
    station = Station.of(SCENE.station)
    with pytest.raises(ResectionError, match=r"cannot tell: .*pitch.*alpha.*beta") as caught:
        resect(station, observed(SCENE, lines=("forward", "aft")))
    # pitch forward, alpha smaller and beta larger by the same: no point moves
    vector = caught.value.null_vectors[0]
    assert vector / vector[1] == pytest.approx([0, 1, 0, -1, 1], abs=1e-6)
    # one point per line
    few = {k: ObservedLine.of(Strip.of(p[:1], 1.0), SCENE.tangents[k][:1]) for k, p in SCENE.points.items()}
    with pytest.raises(ResectionError, match="no line has two points at different places"):
        resect(station, few)
    nadir = observed(SCENE, lines=("nadir",))
    alone = resect(station, nadir)
    assert alone.names == ("roll", "pitch", "yaw")
    assert np.isnan(alone.alpha)
    with pytest.raises(ResectionError, match="not both"):
        _ = alone.angle_covariance
    pair = resect(station, observed(SCENE, lines=("forward", "nadir")))
    assert pair.alpha == pytest.approx(LOOK, abs=1e-13)
    assert np.isnan(pair.beta)


def test_bad_input():
    station = Station.of(SCENE.station)
    lines = observed(SCENE)
    swapped = {"forward": lines["aft"], "nadir": lines["nadir"], "aft": lines["forward"]}
    with pytest.raises(ResectionError, match="lines exchanged"):
        resect(station, swapped)
    mirrored = {k: ObservedLine.of(v.strip, -v.tangent[:, 1]) for k, v in lines.items()}
    with pytest.raises(ResectionError, match="counted from the other end"):
        resect(station, mirrored)
    with pytest.raises(ResectionError, match="must be named"):
        resect(station, {"left": lines["nadir"]})
    with pytest.raises(ResectionError, match="must be named"):
        resect(station, {})
    with pytest.raises(ResectionError, match="positive definite"):
        resect(Station.of(SCENE.station, np.diag([1.0, 1.0, 0.0])), lines)
    with pytest.raises(ResectionError, match="no convergence"):
        resect(Station.of(noisy(SCENE, np.random.default_rng(1), 0, 9).station, 1.0), lines, iterations=1)
    for tangent in (np.full(20, np.nan), np.zeros(3), np.zeros((20, 3))):
        with pytest.raises(ResectionError, match="tangents"):
            ObservedLine.of(lines["nadir"].strip, tangent)
    with pytest.raises(ResectionError, match="sigma"):
        ObservedLine.of(lines["nadir"].strip, SCENE.tangents["nadir"], -1.0)
