"""In-orbit calibration of the synthetic pass of test_three_line_model: recovery, statistics, gauge, wrong matches."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from analysis.block.reweighting import LARGEST_FACTOR, REJECT, robust_weights, standardised_packets
from analysis.calibration.adjustment import adjust
from analysis.calibration.strip_adjustment import stepwise
from analysis.orbit.calibration_parameters import (
    CalibrationError,
    CalibrationField,
    Gauge,
    Noise,
    Prior,
    RankError,
    Unknowns,
)
from tests.analysis.refusals import refuses
from tests.analysis.test_three_line_model import ARCSEC, INTERIOR, PITCH, cameras, field_points, make_rays, observe
from tests.tiers import quick

NOISE = Noise(0.3 * PITCH, 0.5 * ARCSEC)
CONTROL, ORBIT = 1.0, 0.3
BIAS = np.array([40.0, -60.0, 90.0]) * ARCSEC
CHANGED = {"forward": (90e-6, -40e-6, 60e-6), "nadir": (-70e-6, 0.0, 0.0), "backward": (50e-6, 30e-6, -50e-6)}
LABORATORY = cameras(CHANGED)
HOLD_X = Gauge(held=("nadir x",))
HOLD_XY = Gauge(held=("nadir x", "nadir y"))
OFFSETS = Unknowns(offset=True)
INNER = [f"{line} {n}" for line in INTERIOR for n in ("f", "x", "y")]
TRUTH = dict(zip(INNER, np.ravel(list(INTERIOR.values())), strict=True))


def seen(seed, count=60, node=2.4, bias=BIAS, **terrain):
    return observe(field_points(np.random.default_rng(seed), count, node, **terrain), node, cameras(), bias)


def measured(view, rng=None, noise=NOISE, offset=(0.0, 0.0, 0.0), name="Beijing", sigma=CONTROL, control=None):
    """A field; rng for measurements with noise. offset: true minus measured station, ITRS."""
    rays = {k: replace(r, station=r.station - offset) for k, r in make_rays(view, rng, noise).items()}
    ground = view.points if rng is None else view.points + sigma * rng.standard_normal(view.points.shape)
    return CalibrationField.of(name, rays, ground, sigma, control)


def priors(*names, sigma=ORBIT):
    return [Prior({f"{n} offset {a}": 1.0}, 0.0, sigma, "orbit") for n in names for a in ("along", "across", "down")]


def truth(names, bias=BIAS):
    known = TRUTH | {f"Beijing {n}": v for n, v in zip(("roll", "pitch", "yaw"), bias, strict=True)}
    return np.array([known.get(n, 0.0) for n in names])


VIEW = seen(1)
SEVEN_NODES = 2.2 + 0.1 * np.arange(7)


def test_exact_data_return_everything_that_is_observable():
    """nadir x starts at its true value: the gauge then is the truth's own. Left is rounding of 1e-15 m over a strength
    of 7e-3 and, for the principal points, distances of 1e-5 m: 1e-9."""
    found = adjust([measured(VIEW)], LABORATORY, NOISE, gauge=HOLD_X)
    assert found.values == pytest.approx(truth(found.names), rel=1e-6)
    assert found.chi_square < 1e-12
    assert found.iterations <= 4
    assert found.cameras["backward"].interior == pytest.approx(INTERIOR["backward"], rel=1e-6)
    assert found.bias("Beijing") == pytest.approx(BIAS, rel=1e-6)
    assert str(found.gauge) == "held at the start values: nadir x"
    # tie points: a quarter is control, the rest must come from the images alone
    field = measured(VIEW, control=np.arange(60) % 4 == 0)
    moved = replace(field, ground=field.ground + np.where(field.control[:, None], 0.0, 200.0))
    tied = adjust([moved], LABORATORY, NOISE, gauge=HOLD_X)
    assert tied.values == pytest.approx(truth(tied.names), rel=1e-6)
    assert np.abs(tied.ground["Beijing"] - VIEW.points).max() < 1e-6


def test_open_combinations_are_named():
    """x of all lines by 1 mm is 1 mm / 0.65 m = 317.3 arcsec of pitch: null vector of paper 003's twelve unknowns."""
    with pytest.raises(RankError, match="Hold or weight") as caught:
        adjust([measured(VIEW)], LABORATORY, NOISE)
    (only,) = caught.value.open
    change = dict(zip(only.names, only.change, strict=True))
    assert set(change) == {"forward x", "nadir x", "backward x", "Beijing pitch"}
    assert change["nadir x"] / change["forward x"] == pytest.approx(1, rel=1e-3)
    assert change["nadir x"] / change["backward x"] == pytest.approx(1, rel=1e-3)
    assert change["Beijing pitch"] / change["nadir x"] == pytest.approx(-1 / 0.65, rel=1e-3)
    # roll against y is weak, yaw against y of the outer lines a correlation
    found = adjust([measured(VIEW)], LABORATORY, NOISE, gauge=HOLD_X)
    (weak,) = found.weak
    assert set(weak.names) == {"forward y", "nadir y", "backward y", "Beijing roll"}
    assert 1e-3 < weak.strength < 1e-2
    held = adjust([measured(VIEW)], LABORATORY, NOISE, gauge=HOLD_XY)
    yaw, forward, backward = (held.names.index(n) for n in ("Beijing yaw", "forward y", "backward y"))
    assert held.correlation[yaw, forward] < -0.9
    assert held.correlation[yaw, backward] > 0.9
    assert np.isnan(held.correlation[held.names.index("nadir x"), yaw])
    # several fields share one interior: one gauge closes them all
    two = [measured(seen(3 + i, 20 + 4 * i, node=2.2 + 0.4 * i), name=f"F{i}") for i in range(2)]
    refuses(RankError, r"F0 pitch .* F1 pitch", adjust, two, LABORATORY, NOISE)
    assert adjust(two, LABORATORY, NOISE, gauge=HOLD_X).chi_square < 1e-10


def test_stepwise_ends_where_the_simultaneous_one_does_and_as_slowly_as_predicted():
    rng = np.random.default_rng(8)
    field = measured(VIEW, rng)
    together = adjust([field], LABORATORY, NOISE, gauge=HOLD_XY)
    steps = stepwise([field], LABORATORY, NOISE, held=HOLD_XY.held, tolerance=1e-6)
    assert steps.converged
    sigma = np.sqrt(np.diag(together.covariance))
    free = sigma > 0
    assert np.abs((steps.values - together.values)[free] / sigma[free]).max() < 1e-3
    # the decay of the last rounds against the canonical correlation of the two blocks
    assert steps.steps[-200] / steps.steps[-400] == pytest.approx(steps.rate**200, rel=0.01)
    assert steps.rounds > 100


@pytest.mark.second
@pytest.mark.parametrize("robust", quick(1, ["huber", "igg"]))
def test_wrong_matches_lose_their_weight(robust):
    """3 per cent of the image points are off by 10 to 60 px."""
    rng = np.random.default_rng(11)
    fields = [measured(seen(20 + i, node=n), rng, name=f"F{i}") for i, n in enumerate((2.2, 2.4, 2.6))]
    wrong = {}
    for field in fields:
        for line, rays in field.rays.items():
            bad = rng.permutation(60)[: 2 if line != "nadir" else 1]
            angle, size = rng.uniform(0, 2 * np.pi, len(bad)), PITCH * rng.uniform(10, 60, len(bad))
            rays.image[bad] += size[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
            wrong[field.name, line] = bad
    plain = adjust(fields, LABORATORY, NOISE, gauge=HOLD_XY)
    found = adjust(fields, LABORATORY, NOISE, gauge=HOLD_XY, robust=robust)
    free = np.flatnonzero(np.diag(found.covariance)[:9] > 0)
    true = np.array([TRUTH[n] for n in INNER])

    def distance(result):
        error = (result.values[:9] - true)[free]
        return error @ np.linalg.solve(result.covariance[np.ix_(free, free)], error)

    assert distance(plain) > 100
    assert plain.p_value < 1e-10
    weights = np.concatenate([found.weight[f.name][k][wrong[f.name, k]] for f in fields for k in f.rays])
    assert len(weights) == 15
    total = sum(float(np.sum(found.weight[f.name][k] < 0.01)) for f in fields for k in f.rays)
    if robust == "igg":
        assert np.all(weights == 0)
        # 525 good points, 1 in 10 000 beyond the limit: more than three is a false alarm of 3e-7
        assert total - 15 <= 3
        assert distance(found) < stats.chi2.isf(1e-5, len(free))
        assert np.sum(np.linalg.norm(found.residual["F0"]["backward"], axis=1) > REJECT) == 2
    else:
        assert np.all(weights < 0.25)
        assert distance(found) < 0.1 * distance(plain)


def test_variance_components_find_wrong_sigmas():
    """Image noise twice and control half of what is claimed; each to 4.5 sigmas of its estimate, sqrt(2 / r)."""
    rng = np.random.default_rng(12)
    claimed = Noise(0.3 * PITCH)
    fields = []
    for i in range(3):
        view = seen(20 + i, node=2.2 + 0.2 * i)
        rough = measured(view, rng, Noise(0.6 * PITCH), name=f"F{i}", sigma=1.0)
        fields.append(CalibrationField.of(f"F{i}", rough.rays, rough.ground, 2.0))
    found = adjust(fields, LABORATORY, claimed, gauge=HOLD_XY, variance_components=True)
    assert sum(found.redundancy.values()) == pytest.approx(found.degrees_of_freedom, abs=1e-6)
    for group, factor in (("image", 4.0), ("control", 0.25)):
        # the other group is estimated, too: its share adds to the scatter, at most as much again
        assert found.factors[group] == pytest.approx(factor, rel=4.5 * np.sqrt(2 * 2 / found.redundancy[group]))
    plain = adjust(fields, LABORATORY, claimed, gauge=HOLD_XY)
    assert plain.factors == {"image": 1.0, "control": 1.0}
    true = [CalibrationField.of(f.name, f.rays, f.ground, 1.0) for f in fields]
    right = adjust(true, LABORATORY, Noise(0.6 * PITCH), gauge=HOLD_XY)
    assert right.sigma["nadir f"] > 1.2 * plain.sigma["nadir f"]
    for name in INNER:
        assert found.sigma[name] == pytest.approx(right.sigma[name], rel=0.15)


@pytest.mark.second
def test_variance_factors_are_bounded():
    """Exact data: no noise at all is found, and the factors end where they must."""
    found = adjust([measured(VIEW)], LABORATORY, NOISE, gauge=HOLD_XY, variance_components=True)
    assert found.factors == {"image": 1 / LARGEST_FACTOR, "control": 1 / LARGEST_FACTOR}
    assert found.values == pytest.approx(truth(found.names), rel=1e-6)


@pytest.mark.second
def test_priors_pull_as_their_weight_says():
    """A monitor that knows the difference of two principal points to a nanometre fixes it, and its sigma."""
    prior = Prior({"forward y": 1.0, "nadir y": -1.0}, -23e-6, 1e-9, "monitor")
    field = measured(VIEW, np.random.default_rng(13))
    found = adjust([field], LABORATORY, NOISE, gauge=HOLD_X, priors=[prior])
    assert found.value("forward y") - found.value("nadir y") == pytest.approx(-23e-6, abs=5e-9)
    without = adjust([field], LABORATORY, NOISE, gauge=HOLD_X)
    assert found.sigma["Beijing yaw"] < 0.8 * without.sigma["Beijing yaw"]
    # one that contradicts the images by five sigmas of both adds their square to chi-square
    combination = np.zeros(len(without.names))
    combination[[without.names.index("forward y"), without.names.index("nadir y")]] = 1.0, -1.0
    variance = (2e-6) ** 2 + combination @ without.covariance @ combination
    wrong = replace(prior, value=float(combination @ without.values + 5.0 * np.sqrt(variance)), sigma=2e-6)
    against = adjust([field], LABORATORY, NOISE, gauge=HOLD_X, priors=[wrong])
    # linear but for the second order of some 1e-6
    assert against.chi_square - without.chi_square == pytest.approx(25.0, rel=1e-5)
    assert against.degrees_of_freedom == without.degrees_of_freedom + 1


def test_bad_input_is_told():
    field, few = measured(VIEW), measured(seen(1, 2))
    bare = replace(field, name="bare", rays={k: r.taken(np.zeros(60, bool)) for k, r in field.rays.items()})
    bias = tuple(f"{field.name} {n}" for n in ("roll", "pitch", "yaw"))
    two = {k: v for k, v in LABORATORY.items() if k != "backward"}
    zero, hold = [Prior({"nadir f": 1.0}, 0.65, 0.0)], {"gauge": HOLD_X}
    for error, said, fields, lines, noise, options in (
        (CalibrationError, "3 image points are too few for 11", [measured(seen(1, 1))], LABORATORY, NOISE, hold),
        (CalibrationError, "no convergence in 1 steps", [field], LABORATORY, NOISE, hold | {"iterations": 1}),
        (CalibrationError, "field 'bare': no image points", [field, bare], LABORATORY, NOISE, hold),
        (RankError, "Hold or weight", [few], LABORATORY, NOISE, {}),
        (CalibrationError, "no fields", [], LABORATORY, NOISE, {}),
        (CalibrationError, "two fields have the same name", [field, field], LABORATORY, NOISE, {}),
        (CalibrationError, "called 'nadir z'", [field], LABORATORY, NOISE, {"gauge": Gauge(held=("nadir z",))}),
        (CalibrationError, "no camera is called 'backward'", [field], two, NOISE, {}),
        (CalibrationError, "sigmas must be finite", [field], LABORATORY, Noise(np.nan), {}),
        (CalibrationError, "positive sigma", [field], LABORATORY, NOISE, {"priors": zero}),
        (CalibrationError, "robust must be", [field], LABORATORY, NOISE, hold | {"robust": "tukey"}),
    ):
        refuses(error, said, adjust, fields, lines, noise, **options)
    refuses(CalibrationError, "attitude and the interior", stepwise, [field], LABORATORY, NOISE, held=bias)
    assert not stepwise([field], LABORATORY, NOISE, rounds=3).converged
    refuses(CalibrationError, "rate must be", Unknowns, rate="fields")
    refuses(ValueError, "huber, igg or accept", robust_weights, np.zeros((2, 2)), "tukey")


def test_standardised_residuals_do_not_depend_on_the_own_weight():
    """Of a dense model one packet of two rows gets any weight, the others keep theirs."""
    rng, found = np.random.default_rng(31), []
    design, seen_values = rng.standard_normal((12, 4)), rng.standard_normal(12)
    for own in (1.0, 0.5, 0.03, 0.0):
        weight = np.where(np.arange(12) < 2, own, 1.0)
        spread = np.linalg.inv(design.T * weight @ design)
        left = (seen_values - design @ spread @ design.T @ (weight * seen_values))[:2]
        cofactor = design[:2] @ spread @ design[:2].T
        found.append(standardised_packets(left[None], cofactor[None], np.array([own]), 1.0)[0])
    assert np.array(found) == pytest.approx(np.tile(found[-1], (4, 1)), rel=1e-9)
