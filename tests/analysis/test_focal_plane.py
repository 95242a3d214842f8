"""The plane through measured defocus, its correction as a finite motion, and its statistics. The geometry of the tests
is built from planes and rotation matrices of OpenCV, in the optics' frame, and never from the slopes that are fitted.
"""

import numpy as np
import pytest
from scipy import stats

from analysis.focal_plane.plane_fit import LineLevel, ObservabilityError, fit_focal_plane
from tests.analysis.refusals import refuses
from tests.analysis.test_planes import rotation

FALSE_ALARM = 1e-6
ARCMIN = np.pi / 10800
UM, MM = 1e-6, 1e-3
# pan line and four bands at five fields, as in the paper
FIELDS = np.linspace(-115 * MM, 115 * MM, 5)
PLACE = np.array([(x, y) for x in (0.0, -10 * MM, -5 * MM, 5 * MM, 10 * MM) for y in FIELDS])
SIGMA = np.where(PLACE[:, 0] == 0, 3 * UM, 8 * UM)


def on_plane(place):
    return np.column_stack([place, np.zeros(len(place))])


def measured_defocus(place, turn, shift):
    """Distance along Z' from places of an assembly at turn, shift to the optics' image plane Z = 0."""
    matrix = rotation(turn)
    point = on_plane(place) @ matrix.T + shift
    return -point[:, 2] / matrix[2, 2]


def bounds(statistic, freedom):
    return FALSE_ALARM / 2 < stats.chi2.sf(statistic, freedom) < 1 - FALSE_ALARM / 2


@pytest.mark.parametrize("seed", range(6))
def test_correction_brings_a_misset_assembly_into_focus(seed):
    """Arcminutes about all axes and 0.3 mm of piston, no noise: after the motion all places lie in the image plane."""
    rng = np.random.default_rng(seed)
    turn, shift = rng.uniform(-10, 10, 3) * ARCMIN, rng.uniform(-1, 1, 3) * [1 * MM, 1 * MM, 0.3 * MM]
    fit = fit_focal_plane(PLACE, measured_defocus(PLACE, turn, shift), SIGMA)
    matrix = rotation(turn)
    # the theodolite: where the ends of the line stand in the optics' frame
    ends = on_plane(np.array([[0, -115 * MM], [0, 115 * MM]])) @ matrix.T
    level = LineLevel(np.arctan2(ends[0, 0] - ends[1, 0], ends[1, 1] - ends[0, 1]), 5 * UM / 0.23)
    motion = fit.correction(level)
    moved = motion.moved(on_plane(PLACE)) @ matrix.T + shift
    assert np.abs(moved[:, 2]).max() < 1e-14  # metres: float64 of 0.1 m with some ten operations
    # level measured in the optics' frame and applied in the assembly's: they differ by tilt^2, (14')^2 = 0.06'
    line = matrix @ rotation(motion.rotation) @ [0.0, 1.0, 0.0]
    assert abs(np.arctan2(-line[0], line[1])) < 0.06 * ARCMIN
    assert abs(level.angle - turn[2]) < 0.06 * ARCMIN


def test_scatter_agrees_with_covariance():
    """Against dense weighted least squares by NumPy; the plane's own sigma at a place, p-values even over 200 draws."""
    rng = np.random.default_rng(4)
    exact = 0.3 * MM + PLACE @ [1e-3, -2e-3]
    design = np.column_stack([np.ones(len(PLACE)), PLACE])
    seen = exact + SIGMA * rng.standard_normal((200, len(PLACE)))
    fits = [fit_focal_plane(PLACE, one, SIGMA) for one in seen]
    expected, square, *_ = np.linalg.lstsq(design / SIGMA[:, None], seen.T / SIGMA[:, None], rcond=None)
    found = np.array([[f.piston, f.slope_x, f.slope_y] for f in fits])
    assert found == pytest.approx(expected.T, rel=1e-9)
    assert [f.chi_square for f in fits] == pytest.approx(square, rel=1e-9)
    assert stats.kstest([f.p_value for f in fits], "uniform").pvalue > FALSE_ALARM
    known = np.linalg.inv((design / SIGMA[:, None]).T @ (design / SIGMA[:, None]))
    assert fits[0].covariance == pytest.approx(known, rel=1e-9, abs=1e-20)
    assert fits[0].correction().covariance[0, 0] == pytest.approx(known[2, 2], rel=1e-12)
    height, sigma = fits[0].plane([[0.02, 0.1]])
    row = np.array([1, 0.02, 0.1])
    assert (height[0], sigma[0]) == pytest.approx((row @ expected[:, 0], np.sqrt(row @ known @ row)), rel=1e-9)


@pytest.mark.second
def test_predicted_defocus_after_the_correction():
    """True defocus that remains when the fitted motion is made: 400 assemblies, each measured with noise. The
    prediction's error has the covariance stated.
    """
    rng = np.random.default_rng(8)
    total, rank = 0.0, 0
    for _ in range(400):
        turn, shift = rng.uniform(-5, 5, 3) * ARCMIN * [1, 1, 0], [0, 0, rng.uniform(-0.3, 0.3) * MM]
        true = measured_defocus(PLACE, turn, shift)
        fit = fit_focal_plane(PLACE, true + SIGMA * rng.standard_normal(len(PLACE)), SIGMA)
        moved = fit.correction().moved(on_plane(PLACE))[:, 2]
        predicted, covariance = fit.predicted_defocus()
        error = true - moved - predicted
        values, vectors = np.linalg.eigh(covariance)
        good = values > 1e-9 * values[-1]
        total += np.sum((vectors[:, good].T @ error) ** 2 / values[good])
        rank += np.count_nonzero(good)
    # three parameters that can be misjudged; moved is the finite motion: 5' squared of 0.1 m is 0.2 um of X'Y', a few
    # 1e-10 m of height
    assert rank == 3 * 400
    assert bounds(total, rank)


def test_extra_sigma_is_reported_and_only_on_request():
    rng = np.random.default_rng(9)
    bowl = 40 * UM * (PLACE[:, 1] / 0.115) ** 2  # curvature of field
    defocus = 0.1 * MM + bowl + SIGMA * rng.standard_normal(len(PLACE))
    plain = fit_focal_plane(PLACE, defocus, SIGMA)
    assert plain.extra_sigma == 0
    assert plain.p_value < 1e-6
    wide = fit_focal_plane(PLACE, defocus, SIGMA, estimate_extra=True)
    assert wide.chi_square == pytest.approx(plain.chi_square, rel=1e-12)  # still with the sigmas as given
    weighted = wide.residual**2 / (SIGMA**2 + wide.extra_sigma**2)
    assert weighted.sum() == pytest.approx(wide.degrees_of_freedom, rel=1e-4)
    # rms of the bowl about its mean over five fields, 40 um x 0.374
    assert wide.extra_sigma == pytest.approx(15 * UM, rel=0.35)
    assert np.all(np.diag(wide.covariance) > np.diag(plain.covariance))
    quiet = fit_focal_plane(PLACE, np.full(len(PLACE), 0.1 * MM), SIGMA, estimate_extra=True)
    assert quiet.extra_sigma == 0


def test_places_that_cannot_tell():
    line = np.column_stack([np.full(5, 3 * MM), FIELDS])
    with pytest.raises(ObservabilityError, match=r"X' = constant.*do not determine slope_x.*another band"):
        fit_focal_plane(line, np.zeros(5), UM)
    refuses(ObservabilityError, r"Y' = constant.*slope_y", fit_focal_plane, line[:, ::-1], np.zeros(5), UM)
    for angle in np.radians(np.arange(15, 375, 30)):
        with pytest.raises(ObservabilityError, match=r"one straight line along.*move some of them off that line"):
            fit_focal_plane(FIELDS[:, None] * [np.cos(angle), np.sin(angle)], np.zeros(5), UM)
    refuses(ObservabilityError, "all positions coincide", fit_focal_plane, np.full((4, 2), 0.1), np.zeros(4), UM)
    with pytest.raises(ObservabilityError, match="2 positions do not determine piston, slope_x, slope_y"):
        fit_focal_plane(PLACE[:2], np.zeros(2), UM)
    three = fit_focal_plane([[0.0, 0.0], [0.01, 0.0], [0.0, 0.1]], [1e-4, 1e-4, 1e-4], UM)
    assert three.piston == pytest.approx(1e-4)
    assert three.p_value == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"defocus": np.zeros(3)}, r"\(N, 2\)"),
        ({"sigma": 0.0}, "positive"),
        ({"defocus": np.full(25, np.nan)}, "finite"),
    ],
)
def test_bad_input(change, message):
    given = {"position": PLACE, "defocus": np.zeros(25), "sigma": UM} | change
    refuses(ValueError, message, fit_focal_plane, **given)
