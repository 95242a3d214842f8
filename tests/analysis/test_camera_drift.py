"""Cameras that drift from field to field, with and without a monitor's readings (the bridge from paper 001 to 003)."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from analysis.calibration.adjustment import adjust
from analysis.orbit.calibration_parameters import CalibrationError, Noise, Prior, Unknowns, monitor_priors
from analysis.orbit.forward_intersection import check_errors, intersect
from analysis.orbit.null_space import RankError
from analysis.orbit.three_line_model import DRIFT
from tests.analysis.test_adjustment import BIAS, HOLD_X, HOLD_XY, INNER, LABORATORY, SEVEN_NODES, TRUTH, measured
from tests.analysis.test_three_line_model import ARCSEC, PITCH, cameras, field_points, make_rays, observe

NOISE = Noise(0.3 * PITCH, 0.5 * ARCSEC)
DRIFTS = Unknowns(drift=True)
SIGMA = np.array([0.05 * ARCSEC, 0.05 * ARCSEC, 1.2 * ARCSEC, 0.02e-3])
"""Of the monitor: paper 001, Table 5, with its factor of two in d_gamma and d_f taken out."""
SIZE = np.array([3 * ARCSEC, 3 * ARCSEC, 5 * ARCSEC, 30e-6])
"""Of the drift of forward and backward between fields."""
LINES = ("forward", "nadir", "backward")


def drifts(rng, count, size=SIZE):
    return [{k: size * rng.standard_normal(4) * (k != "nadir") for k in LINES} for _ in range(count)]


def view(i, drift, count=40, seed=10):
    node = SEVEN_NODES[i]
    points = field_points(np.random.default_rng(seed + i), count, node)
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


def known(drift):
    found = dict(TRUTH)
    for i, one in enumerate(drift):
        found |= {f"F{i} {n}": v for n, v in zip(("roll", "pitch", "yaw"), BIAS, strict=True)}
        found |= {f"F{i} {k} {n}": v for k, d in one.items() for n, v in zip(DRIFT, d, strict=True)}
    return found


def square(found, truth):
    free = np.array([n not in HOLD_X.held for n in found.names])
    error = (found.values - np.array([truth[n] for n in found.names]))[free]
    scale = np.sqrt(np.diag(found.covariance))[free]
    unit = found.covariance[np.ix_(free, free)] / scale / scale[:, None]
    return np.array([error / scale @ np.linalg.solve(unit, error / scale), len(error)])


def test_exact_data_and_readings_return_everything():
    """1e-6 of each value; zeros of nadir to 1e-6 of a monitor's sigma (rounding of 1e-15 m over f is 3e-10 arcsec)."""
    drift = drifts(np.random.default_rng(1), 2)
    fields = [measured(view(i, d), name=f"F{i}") for i, d in enumerate(drift)]
    found = solve(fields, unknowns=DRIFTS, priors=told(drift))
    truth = known(drift)
    for name, value in zip(found.names, found.values, strict=True):
        small = 1e-6 * SIGMA[DRIFT.index(name.split()[-1])] if name.split()[-1] in DRIFT else 0.0
        assert value == pytest.approx(truth[name], rel=1e-6, abs=small), name
    assert found.chi_square < 1e-10
    for i, d in enumerate(drift):
        own = found.cameras_of(f"F{i}")
        assert own["backward"].drift == pytest.approx(d["backward"], rel=1e-6)
        assert own["backward"].interior == pytest.approx(found.cameras["backward"].interior, rel=1e-12)
        points = intersect(fields[i].rays, own, NOISE, bias=found.bias(f"F{i}")).ground
        assert np.abs(points - fields[i].ground).max() < 1e-3  # 1e-6 of 40 arcsec of bias is 1e-4 m
    assert np.all(found.cameras["backward"].drift == 0)


def test_what_the_monitor_does_not_tell_is_named():
    drift = drifts(np.random.default_rng(2), 2)
    fields = [measured(view(i, d), name=f"F{i}") for i, d in enumerate(drift)]
    with pytest.raises(RankError) as caught:
        adjust(fields, LABORATORY, NOISE, unknowns=DRIFTS, gauge=HOLD_XY)
    together = [set(c.names) for c in caught.value.open]
    named = set().union(*together)
    for line in LINES:  # drift of both fields against the interior
        assert {f"{line} f", f"F0 {line} d_f", f"F1 {line} d_f"} <= named
        assert any({f"F0 {line} d_f", f"{line} f"} <= c or {f"F1 {line} d_f", f"{line} f"} <= c for c in together)
    for field in ("F0", "F1"):  # drift of all lines against the bias
        assert {f"{field} {line} d_alpha" for line in LINES} | {f"{field} pitch"} <= named
        assert {f"{field} {line} d_beta" for line in LINES} | {f"{field} roll"} <= named
    text = str(caught.value)
    assert "d_alpha" in text
    assert "arcsec" in text
    assert "d_f +" in text or "d_f -" in text
    # a monitor on two lines only: the third one's drift stays open against bias and interior
    some = [p for p in told(drift) if not any("nadir" in n for n in p.weights)]
    with pytest.raises(RankError) as caught:
        solve(fields, unknowns=DRIFTS, priors=some)
    assert any("nadir d_f" in n for c in caught.value.open for n in c.names)


@pytest.mark.slow
def test_the_monitor_brings_heights_back():
    """Seven fields with drifts of 3 arcsec (1 sigma). One arcsec of the intersection angle is 3.2 m of height: the
    difference of two d_alpha of 3 arcsec each is 4.2 arcsec, 13.5 m RMS over passes; seven passes give it to 27%, and
    each field's bias takes none of it. With the monitor, 0.07 arcsec or 0.2 m are left, beside the noise of 3.4 m."""
    rng = np.random.default_rng(3)
    drift, none = drifts(rng, 7), drifts(rng, 7, np.zeros(4))
    heights, inner, chi = {}, {}, {}
    for case, true in (("still", none), ("blind", drift), ("told", drift)):
        noise = np.random.default_rng(4)
        fields = [measured(view(i, d, 60), noise, NOISE, name=f"F{i}") for i, d in enumerate(true)]
        options = {"unknowns": DRIFTS, "priors": told(true, noise)} if case == "told" else {}
        found = solve(fields, **options)
        wrong = []
        for i, d in enumerate(true):
            check = view(i, d, 100, seed=500)
            points = intersect(
                make_rays(check, noise, NOISE), found.cameras_of(f"F{i}"), NOISE, bias=found.bias(f"F{i}")
            )
            wrong.append(check_errors(points.ground, check.points).height_rms ** 2)
        heights[case] = np.sqrt(np.mean(wrong))
        inner[case] = max(abs(found.value(n) - TRUTH[n]) / found.sigma[n] for n in INNER if n not in HOLD_X.held)
        chi[case] = found.p_value
    assert heights["blind"] > 2.0 * heights["still"]
    assert heights["told"] == pytest.approx(heights["still"], rel=0.1)  # an RMS of 700 heights, 0.027 each: 2.6 sigmas
    assert chi["blind"] < 1e-10
    assert inner["blind"] > 5 > inner["told"]
    assert min(chi["still"], chi["told"]) > 1e-4


@pytest.mark.slow
def test_sigmas_with_a_monitor_are_right():
    """20 campaigns of three fields, false alarm 1e-3 to both sides together."""
    rng = np.random.default_rng(5)
    total, fit = np.zeros(2), np.zeros(2)
    drift = drifts(rng, 3)
    views = [view(i, d) for i, d in enumerate(drift)]
    for _ in range(20):
        fields = [measured(v, rng, NOISE, name=f"F{i}") for i, v in enumerate(views)]
        found = solve(fields, unknowns=DRIFTS, priors=told(drift, rng))
        total += square(found, known(drift))
        fit += (found.chi_square, found.degrees_of_freedom)
    assert 5e-4 < stats.chi2.sf(*total) < 1 - 5e-4
    assert 5e-4 < stats.chi2.sf(*fit) < 1 - 5e-4


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
        truth = dict(zip(names, rates, strict=True)).get(name, known([])[name] if name in TRUTH else None)
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
    with pytest.raises(CalibrationError, match=r"must be \(4,\)"):
        monitor_priors("F0", "backward", np.zeros(3), SIGMA)
    two = monitor_priors("F0", "backward", np.zeros(4), [1e-7, 1e-7, np.inf, np.inf])
    assert [next(iter(p.weights)) for p in two] == ["F0 backward d_alpha", "F0 backward d_beta"]
