"""Interior orientation and distortion: the printed equations against plain least squares, the general fit against its
own statistics under noise that is common to many points, and what a narrow field can say of the principal point.
"""

import numpy as np
import pytest
from scipy import stats

from analysis.orientation.interior import (
    OrientationError,
    distortion,
    fit_interior_orientation,
    principal_distance,
    principal_distance_and_point,
    principal_point,
)
from tests.analysis.refusals import refuses

FALSE_ALARM = 1e-6
ARCSEC = np.pi / 180 / 3600
F = 5.51
EDGE = np.deg2rad(1.25)
# 55 points of the test of paper 004, even in tan W as targets along a line CCD are
GF7 = np.arctan(np.linspace(-1, 1, 55) * np.tan(EDGE))
UM = 1e-6
TERMS = ("constant", "principal_distance", "principal_point", "radial3")


def line_image(angle, f=F, constant=0.0, point=0.0, radial3=0.0):
    """Spot positions of the model, typed once more."""
    t = np.tan(angle)
    return constant + f * t - point * t**2 + radial3 * t**3


def in_range(chi_square, freedom):
    """Two-sided chi-square test with the false-alarm rate of this file."""
    return FALSE_ALARM / 2 < stats.chi2.sf(chi_square, freedom) < 1 - FALSE_ALARM / 2


# ---- the printed equations


def test_printed_equations_are_least_squares():
    """Eqs. (2), (3), (4) on 7 sets of uneven angles against numpy's solution of the same problem.

    Rounding: p is L's rounding over tan^2 W, 2e-16 x 5.5 m / 0.044^2 = 6e-13 m, times some sums.
    """
    rng = np.random.default_rng(1)
    angle = np.deg2rad(rng.uniform(-1.5, 2.5, (7, 55)))
    position = line_image(angle, point=3e-3) + rng.standard_normal((7, 55)) * 5e-6
    f, p = principal_distance_and_point(position, angle)
    alone = principal_distance(position, angle)
    known = principal_point(position, angle, np.full(7, 5.5))
    assert f.shape == p.shape == alone.shape == known.shape == (7,)
    for k in range(7):
        t = np.tan(angle[k])
        both = np.linalg.lstsq(np.column_stack([t, -(t**2)]), position[k], rcond=None)[0]
        assert f[k] == pytest.approx(both[0], abs=1e-12)
        assert p[k] == pytest.approx(both[1], abs=2e-11)
        assert alone[k] == pytest.approx(np.linalg.lstsq(t[:, None], position[k], rcond=None)[0][0], abs=1e-13)
        third = np.linalg.lstsq(-(t[:, None] ** 2), position[k] - 5.5 * t, rcond=None)[0][0]
        assert known[k] == pytest.approx(third, abs=2e-11)
        # (1): the residual of that fit
        left = position[k] - np.column_stack([t, -(t**2)]) @ both
        assert distortion(position, angle, f, p)[k] == pytest.approx(left, abs=1e-14)


# ---- the general fit


def common_noise():
    """Covariance of the angles: zero, scale and a subdivision error of 0.2", and 0.04" from reading to reading."""
    turn = GF7 / EDGE
    shapes = np.stack([np.ones(55), turn, np.sin(2 * np.pi * 3.3 * turn), np.cos(2 * np.pi * 3.3 * turn)])
    sizes = np.array([0.1, 0.15, 0.2, 0.2]) * ARCSEC
    return (shapes.T * sizes**2) @ shapes + np.eye(55) * (0.04 * ARCSEC) ** 2


@pytest.mark.second
def test_scatter_agrees_with_sigmas():
    """Noise of the angles that many points share: its covariance and that of the residuals by dense
    matrices, the slope of the angles' noise by a complex step; chi-squares of 200 draws at 1e-6."""
    angles = common_noise()
    rng, total, fit = np.random.default_rng(20), 0.0, 0.0
    truth = np.array([1e-6, F, 1e-3, -0.8])
    for _ in range(200):
        read = GF7 + rng.multivariate_normal(np.zeros(55), angles)
        position = line_image(GF7, constant=1e-6, point=1e-3, radial3=-0.8) + rng.standard_normal(55) * 0.3 * UM
        found = fit_interior_orientation(position, read, 0.3 * UM, TERMS, angle_covariance=angles)
        error = found.values - truth
        total, fit = total + error @ np.linalg.solve(found.covariance, error), fit + found.chi_square
    assert in_range(total, 800)
    assert in_range(fit, 200 * 51)
    t, (constant, f, point, radial3) = np.tan(read), found.values
    rate = line_image(read + 1e-30j, f, constant, point, radial3).imag / 1e-30
    spread = rate[:, None] * angles * rate + np.eye(55) * (0.3 * UM) ** 2
    columns = np.column_stack([np.ones(55), t, -(t**2), t**3])
    # equal weights, as the points' own noise has them, and all noise in the covariance
    gain = np.linalg.pinv(columns)
    known = gain @ spread @ gain.T
    scale = np.sqrt(np.outer(*2 * [np.diag(known)]))
    assert found.covariance / scale == pytest.approx(known / scale, abs=1e-6)
    rest = (np.eye(55) - columns @ gain) @ spread @ (np.eye(55) - columns @ gain).T
    assert found.residual_covariance == pytest.approx(rest, abs=1e-6 * rest.max())


# ---- the principal point


def test_principal_point_over_a_narrow_field():
    """gf7: sigma of p against its closed form, 1 um / sqrt(sum (tan^2 - mean)^2) = 0.9 mm."""
    rng = np.random.default_rng(7)
    position = line_image(GF7) + rng.standard_normal(55) * UM
    found = fit_interior_orientation(position, GF7, UM, ("constant", "principal_distance", "principal_point"))
    t2 = np.tan(GF7) ** 2
    expected = UM / np.sqrt(np.sum((t2 - t2.mean()) ** 2))
    assert 0.8e-3 < expected < 1e-3
    assert found.sigma("principal_point") == pytest.approx(expected, rel=1e-9)
    point = found.point
    assert not point.observable
    for part in ("not observable over +-1.25 deg", "take p = 0", "eq. 3", "0.44 um, compared with 1 um", "decentring"):
        assert part in point.sentence
    # not fitted: the same, said of the p that could have been
    without = fit_interior_orientation(position, GF7, UM, ("constant", "principal_distance")).point
    assert f"p is fixed at zero; if fitted, its sigma would be {1e3 * expected:.2g} mm" in without.sentence
    assert "not observable" in without.sentence


def test_principal_point_over_a_wide_field():
    angle = np.deg2rad(np.linspace(-20, 20, 55))
    rng = np.random.default_rng(8)
    position = line_image(angle, f=0.2, point=50e-6) + rng.standard_normal(55) * UM
    found = fit_interior_orientation(position, angle, UM, ("constant", "principal_distance", "principal_point"))
    assert found.point.observable
    assert found.sigma("principal_point") < 4e-6
    assert abs(found.value("principal_point") - 50e-6) < stats.norm.isf(FALSE_ALARM / 2) * found.sigma(
        "principal_point"
    )
    assert ": observable over +-20 deg" in found.point.sentence
    assert "take p = 0" not in found.point.sentence


def test_a_large_tan_squared_term_over_a_narrow_field_is_not_called_zero():
    position = line_image(GF7, point=20e-3)
    point = fit_interior_orientation(position, GF7, UM, ("constant", "principal_distance", "principal_point")).point
    assert not point.observable
    assert "take p = 0" not in point.sentence
    assert "decentring" in point.sentence


# ---- bad input


def fit(position=None, angle=GF7, covariance=UM, terms=TERMS, **options):
    position = line_image(angle) if position is None else position
    return fit_interior_orientation(position, angle, covariance, terms, **options)


WITH_NAN = np.where(np.arange(55) == 7, np.nan, GF7)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"angle": GF7[:3]}, "3 different angles for 4 unknowns .* measure at more angles or fit fewer"),
        ({"angle": np.tile(GF7[:3], 9)}, "3 different angles for 4 unknowns"),
        ({"angle": np.full(55, 0.01)}, "all angles are the same; turn the turntable"),
        ({"position": np.zeros(54)}, "one angle per spot"),
        ({"position": WITH_NAN}, r"spot position \[7\] is not finite"),
        ({"angle": WITH_NAN, "position": GF7}, r"angle \[7\] is not finite"),
        ({"angle": np.rad2deg(GF7), "position": GF7}, "give radians"),
        ({"position": -line_image(GF7)}, "opposite senses, change the sign"),
        ({"position": np.tile(GF7, (2, 1))}, "fit set by set"),
        ({"terms": ("constant",)}, "principal_distance must be among"),
        ({"terms": ("principal_distance", "radial7")}, "terms must be distinct and out of"),
        ({"terms": ("principal_distance", "principal_distance")}, "terms must be distinct and out of"),
        ({"covariance": np.zeros(55)}, "not positive definite.*add the sigmas"),
        ({"covariance": np.ones((55, 55))}, "not positive definite"),
        ({"covariance": np.ones(54)}, r"need \(55, 55\), or 55 sigmas"),
        ({"covariance": np.tri(55)}, "not symmetric"),
        ({"covariance": -UM}, "negative"),
        ({"covariance": np.nan}, "covariance is not finite"),
        ({"angle_covariance": np.ones((3, 3))}, "angle_covariance is"),
        # nearly constant: a field of 0.02 arcsec in which no spot moves by more than its noise
        ({"angle": GF7 * 1e-6, "terms": ("constant", "principal_distance")}, "span only .* over the whole field"),
    ],
)
def test_errors_say_what_to_change(arguments, message):
    refuses(OrientationError, message, fit, **arguments)


def test_terms_that_cannot_be_told_apart_are_named():
    one_side = np.deg2rad(np.linspace(1.2, 1.25, 55))
    with pytest.raises(OrientationError, match=rf"one side of zero, cannot separate {', '.join(TERMS)} .*both halves"):
        fit(angle=one_side)
    # two angles on each side, the same size: tan and tan^3 are one function of the sign
    pair = np.array([-0.02, -0.02, 0.02, 0.02, 0.0])
    with pytest.raises(OrientationError, match="cannot separate principal_distance, radial3 "):
        fit(angle=pair, terms=("principal_distance", "radial3"))
    assert fit(angle=pair, terms=("constant", "principal_distance")).degrees_of_freedom == 3
    # two points tell two terms, and nothing of a third
    assert not fit(angle=GF7[[0, -1]], terms=("constant", "principal_distance")).point.observable
    # half a field is poor but enough, and the correlation says so
    half = fit(angle=np.deg2rad(np.linspace(0, 1.25, 55)), terms=("constant", "principal_distance"))
    assert half.correlation[0, 1] < -0.8


def test_errors_of_the_printed_equations():
    position = line_image(GF7)
    refuses(OrientationError, "1 angle for the 2 unknowns", principal_distance_and_point, position[:1], GF7[:1])
    refuses(OrientationError, "cannot be separated", principal_distance_and_point, np.full(5, 0.1), np.full(5, 0.02))
    refuses(OrientationError, "all angles are zero", principal_distance, np.zeros(3), np.zeros(3))
    refuses(OrientationError, "all angles are zero", principal_point, np.zeros(3), np.zeros(3), F)
    refuses(OrientationError, "opposite senses", principal_distance, -position, GF7)
    refuses(OrientationError, "opposite senses", principal_distance_and_point, -position, GF7)
    refuses(OrientationError, "no points", principal_distance, [], [])
    refuses(OrientationError, "do not match", principal_distance, np.zeros((2, 5)), np.zeros((3, 5)))
    refuses(OrientationError, "one angle per spot", distortion, position[:5], GF7, F)
