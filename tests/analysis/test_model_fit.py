"""Weighted least squares against its own statistics, and the observability report on motions built to be confused."""

import numpy as np
import pytest

from analysis.monitor.model_fit import RankError, gain, observability
from analysis.monitor.monitor_formulas import CameraParameters
from tests.analysis.refusals import refuses

NAMES = ["shift x", "shift y", "turn z", "scale"]
# px per metre, metre, radian, unit scale: entries of very different size, as in life
SPOTS = np.array(
    [
        [1.0e3, -2.9e5, 4.0e3, 9.0e4],
        [-2.9e5, 2.0e3, -1.0e5, 5.0e3],
        [1.5e3, -2.9e5, 4.0e3, -9.0e4],
        [-2.9e5, -2.0e3, 1.0e5, 5.0e3],
    ]
)
PARAMETERS = np.array([[0.18, 0, 0, 0], [0, 0.18, 0.02, 0], [0, 0, 1.0, 0], [0, 0, 0, 5.52]])
_ROOT = np.random.default_rng(2).standard_normal((4, 4)) * 2e-3
COVARIANCE = _ROOT @ _ROOT.T + 1e-6 * np.eye(4)
SIZES = np.array([1e-5, 1e-5, 5e-5, 1e-5])


def fit(shift, covariance, spots, parameters, names=None):
    """Parameters that `gain` makes of shifts, with their covariance."""
    weights = gain(covariance, spots, parameters, names)
    values = np.einsum("...ij,...j->...i", weights, shift)
    return CameraParameters.from_vector(values, weights @ covariance @ np.swapaxes(weights, -1, -2))


def test_weighting_is_the_best_linear_one():
    """Two motions: generalised least squares typed from the textbook; equal weights are worse."""
    spots, parameters = SPOTS[:, :2], PARAMETERS[:, :2]
    inverse = np.linalg.inv(COVARIANCE)
    motion_covariance = np.linalg.inv(spots.T @ inverse @ spots)
    shift = np.array([0.3, -0.2, 0.1, 0.4])
    found = fit(shift, COVARIANCE, spots, parameters)
    assert found.vector == pytest.approx(parameters @ motion_covariance @ spots.T @ inverse @ shift, rel=1e-9)
    assert found.covariance == pytest.approx(parameters @ motion_covariance @ parameters.T, rel=1e-9, abs=1e-30)
    plain = parameters @ np.linalg.pinv(spots)
    assert np.all((plain @ COVARIANCE @ plain.T).diagonal()[:2] > found.covariance.diagonal()[:2])


def test_rank_deficiency_names_the_null_vector():
    spots = SPOTS.copy()
    spots[:, 3] = 2e-3 * spots[:, 0] - 1e-3 * spots[:, 1]
    with pytest.raises(RankError, match="moves no spot") as caught:
        fit(np.zeros(4), COVARIANCE, spots, PARAMETERS, NAMES)
    null = caught.value.null_vectors
    assert null.shape == (1, 4)
    assert null[0] / null[0, 3] == pytest.approx([-2e-3, 1e-3, 0, 1], rel=1e-6, abs=1e-9)
    assert "shift x" in str(caught.value)
    assert "scale" in str(caught.value)
    assert "turn z" not in str(caught.value)
    dead = SPOTS.copy()
    dead[:, 1] = 0
    refuses(RankError, "shift y", fit, np.zeros(4), COVARIANCE, dead, PARAMETERS, NAMES)


def test_bad_input():
    refuses(ValueError, "at most 4", fit, np.zeros(4), COVARIANCE, np.ones((4, 5)), np.ones((4, 5)))
    refuses(ValueError, "positive definite", fit, np.zeros(4), -COVARIANCE, SPOTS, PARAMETERS)
    refuses(ValueError, "finite", gain, np.nan * COVARIANCE, SPOTS, PARAMETERS)
    refuses(ValueError, r"\(4, P\)", fit, np.zeros(4), COVARIANCE, SPOTS[:3], PARAMETERS[:3])


def test_observability_report():
    """A tilt that looks exactly like a shift plus a turn, a motion without effect on spots, and the family itself."""
    names = [*NAMES, "tilt", "piston", "nothing"]
    mix = np.array([0.7e-3, 0.0, 2e-3, 0.0])  # tilt in terms of the family, per radian
    spots = np.column_stack([SPOTS, SPOTS @ mix, np.zeros(4), np.zeros(4)])
    truth = np.array([3e-3, 0, 0, 0])
    parameters = np.column_stack([PARAMETERS, truth, [0, 0, 0, 1.0], np.zeros(4)])
    sizes = np.array([1e-6, 1e-6, 5e-6, 1e-6, 5e-6, 1e-6, 1e-6])
    report = observability(names, spots, parameters, sizes, COVARIANCE, [0, 1, 2, 3])
    assert report.rank == 4
    tilt = report.motions[4]
    assert tilt.explained == pytest.approx(1, abs=1e-12)
    assert tilt.imitation * sizes[:4] / sizes[4] == pytest.approx(mix, abs=1e-12)
    assert tilt.reported == pytest.approx(PARAMETERS @ mix * 5e-6, rel=1e-9, abs=1e-20)
    assert tilt.true == pytest.approx(truth * 5e-6, rel=1e-9, abs=1e-20)
    for motion in report.motions[:4]:  # the family is reported as what it is
        assert motion.reported - motion.true == pytest.approx(np.zeros(4), abs=1e-18)
    said = next(line for line in report.sentences if line.startswith("tilt: is not separable from the family"))
    for k, name in enumerate(NAMES):  # only what takes part in the imitation is named, with its amount
        assert (f"{abs(tilt.imitation[k]):.3g} x {name}" in said) == (mix[k] != 0)
    assert f'd_alpha {truth[0] * 5e-6 * 180 * 3600 / np.pi:+.3g}"' in said.split("the true change is")[1]
    text = "\n".join(report.sentences)
    assert "piston: moves no spot and is invisible; its true change is d_f +1 um." in text
    assert "nothing: moves no spot and changes no parameter." in text


def test_observability_outside_a_small_family():
    """With two motions fitted, a third is explained in part; the cosine is in the metric of the noise."""
    report = observability(NAMES, SPOTS, PARAMETERS, SIZES, COVARIANCE, [0, 1])
    root = np.linalg.cholesky(COVARIANCE)
    white = np.linalg.solve(root, SPOTS)
    turn = report.motions[2]
    residual = white[:, 2] - white[:, :2] @ np.linalg.lstsq(white[:, :2], white[:, 2], rcond=None)[0]
    assert turn.explained == pytest.approx(1 - (residual @ residual) / (white[:, 2] @ white[:, 2]), rel=1e-6, abs=1e-9)
    cosines = [white[:, 2] @ white[:, j] / np.linalg.norm(white[:, 2]) / np.linalg.norm(white[:, j]) for j in (0, 1)]
    assert turn.cosine == pytest.approx(cosines[int(np.argmax(np.abs(cosines)))], rel=1e-9)
    assert turn.nearest == NAMES[int(np.argmax(np.abs(cosines)))]
    # two of a family are each other's nearest, at the same angle; one alone has none
    one, two = report.motions[:2]
    assert (one.nearest, two.nearest) == ("shift y", "shift x")
    assert one.cosine == two.cosine
    (alone, *_) = observability(NAMES, SPOTS, PARAMETERS, SIZES, COVARIANCE, [0]).motions
    assert (alone.nearest, alone.cosine) == (None, 0.0)
    assert any("leaves a residual" in line for line in report.sentences)
    refuses(ValueError, "positive scales", observability, NAMES, SPOTS, PARAMETERS, SIZES[:2], COVARIANCE, [0])
