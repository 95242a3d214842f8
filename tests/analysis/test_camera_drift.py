"""Cameras that drift from field to field, with and without a monitor's readings (the bridge from paper 001 to 003)."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from analysis.calibration.adjustment import adjust
from analysis.orbit.calibration_parameters import CalibrationError, Noise, Prior, RankError, Unknowns, monitor_priors
from tests.analysis.refusals import refuses
from tests.analysis.test_adjustment import BIAS, HOLD_X, HOLD_XY, LABORATORY, SEVEN_NODES, TRUTH, measured
from tests.analysis.test_three_line_model import ARCSEC, PITCH, cameras, field_points, observe

NOISE = Noise(0.3 * PITCH, 0.5 * ARCSEC)
DRIFTS = Unknowns(drift=True)
SIGMA = np.array([0.05 * ARCSEC, 0.05 * ARCSEC, 1.2 * ARCSEC, 0.02e-3])
"""Of the monitor: paper 001, Table 5, with its factor of two in d_gamma and d_f taken out."""
SIZE = np.array([3 * ARCSEC, 3 * ARCSEC, 5 * ARCSEC, 30e-6])
"""Of the drift of forward and backward between fields."""
LINES = ("forward", "nadir", "backward")


def drifts(rng, count):
    return [{k: SIZE * rng.standard_normal(4) * (k != "nadir") for k in LINES} for _ in range(count)]


def view(i, drift):
    node = SEVEN_NODES[i]
    points = field_points(np.random.default_rng(10 + i), 40, node)
    return observe(points, node, cameras(), BIAS, drift=drift)


def told(drift, rng=None, sigma=SIGMA):
    """Priors of all fields, with the monitor's noise where there is a generator."""
    found = []
    for i, one in enumerate(drift):
        for line, d in one.items():
            noise = 0.0 if rng is None else sigma * rng.standard_normal(4)
            found += monitor_priors(f"F{i}", line, d + noise, sigma)
    return found


def solve(fields, **options):
    return adjust(fields, LABORATORY, NOISE, gauge=HOLD_X, **options)


def test_what_the_monitor_does_not_tell_is_named():
    drift = drifts(np.random.default_rng(2), 2)
    fields = [measured(view(i, d), name=f"F{i}") for i, d in enumerate(drift)]
    with pytest.raises(RankError, match=r"(?s)d_f [+-].*arcsec|arcsec.*d_f [+-]") as caught:
        adjust(fields, LABORATORY, NOISE, unknowns=DRIFTS, gauge=HOLD_XY)
    named = set().union(*(c.names for c in caught.value.open))
    for line in LINES:  # drift of both fields against the interior
        assert {f"{line} f", f"F0 {line} d_f", f"F1 {line} d_f"} <= named
    for field in ("F0", "F1"):  # drift of all lines against the bias
        assert {f"{field} {line} {n}" for line in LINES for n in ("d_alpha", "d_beta")} <= named
        assert {f"{field} pitch", f"{field} roll"} <= named
    # a monitor on two lines only: the third one's drift stays open against bias and interior
    some = [p for p in told(drift) if not any("nadir" in n for n in p.weights)]
    with pytest.raises(RankError, match="nadir d_f"):
        solve(fields, unknowns=DRIFTS, priors=some)


def test_a_drift_of_the_bias_goes_into_the_outer_lines_unless_it_is_told():
    """Rates of some mas/s over the 67 s between the outer lines: 0.65 m times 33 s times 3 mas/s are 0.3 um of x."""
    rates = np.array([-4.0, 3.0, 6.0]) * 1e-3 * ARCSEC
    still = measured(observe(field_points(np.random.default_rng(8), 60, 2.4), 2.4, cameras(), BIAS))
    every = np.concatenate([r.time for r in still.rays.values()])
    rays = {}
    for line, r in still.rays.items():
        # measured is true without the turn of the bias since the middle
        turn = Rotation.from_rotvec((r.time - every.mean())[:, None] * rates).inv().as_matrix()
        rays[line] = replace(r, attitude=r.attitude @ turn)
    field = replace(still, rays=rays)
    unaware = adjust([field], LABORATORY, NOISE, gauge=HOLD_X)
    moved = [unaware.value(f"{line} x") - TRUTH[f"{line} x"] for line in ("forward", "backward")]
    # the forward line comes first: the attitude that is taken as true lacks the turn by -rate * 33 s
    expected = 0.65 / np.cos(np.radians(25)) ** 2 * 33.3 * rates[1] * np.cos(np.radians(25)) ** 2
    assert moved[1] - moved[0] == pytest.approx(2 * expected, rel=0.1)
    names = ("roll rate", "pitch rate", "yaw rate")
    told = [Prior({n: 1.0}, v, 0.02e-3 * ARCSEC, "bias rate") for n, v in zip(names, rates, strict=True)]
    found = adjust([field], LABORATORY, NOISE, gauge=HOLD_X, unknowns=Unknowns(rate="common"), priors=told)
    for name, value in zip(found.names, found.values, strict=True):
        truth = (TRUTH | dict(zip(names, rates, strict=True))).get(name)
        if truth is not None:
            assert value == pytest.approx(truth, rel=1e-6), name
    # nothing else tells the rate of pitch: what is not known of it is not known of x
    vague = [replace(p, sigma=10e-3 * ARCSEC) for p in told]
    loose = adjust([field], LABORATORY, NOISE, gauge=HOLD_X, unknowns=Unknowns(rate="common"), priors=vague)
    assert loose.sigma["backward x"] ** 2 - found.sigma["backward x"] ** 2 == pytest.approx(
        (0.65 * 33.3 * 10e-3 * ARCSEC) ** 2, rel=0.1
    )
    # within a line the field passes in seconds, and the noise of its points is all that tells
    blind = adjust([field], LABORATORY, NOISE, gauge=HOLD_X, unknowns=Unknowns(rate="common"))
    assert blind.sigma["backward x"] > 5 * found.sigma["backward x"]
    timeless = replace(field, rays={k: replace(r, time=None) for k, r in field.rays.items()})
    with pytest.raises(CalibrationError, match="times of all rays"):
        adjust([timeless], LABORATORY, NOISE, gauge=HOLD_X, unknowns=Unknowns(rate="common"), priors=told)


def test_bad_readings_are_told():
    refuses(CalibrationError, r"must be \(4,\)", monitor_priors, "F0", "backward", np.zeros(3), SIGMA)
    two = monitor_priors("F0", "backward", np.zeros(4), [1e-7, 1e-7, np.inf, np.inf])
    assert [next(iter(p.weights)) for p in two] == ["F0 backward d_alpha", "F0 backward d_beta"]
