"""What a calibration cannot tell: the same whatever the units, the order and the choice of unknowns, and no more than
the data leave open; what keeps its start values has their sigma."""

import numpy as np
import pytest
from scipy import stats
from scipy.linalg import subspace_angles

from analysis.orbit.adjustment import adjust
from analysis.orbit.calibration_parameters import CalibrationError, Noise, Parameters, Unknowns
from analysis.orbit.normal_equations import State, Weights, assemble
from analysis.orbit.null_space import WORST, Gauge, RankError, combinations, free_basis, null_vectors, weak_vectors
from analysis.orbit.shared_noise import SharedNoise
from tests.analysis.test_adjustment import BIAS, LABORATORY, NOISE, PITCH, measured, truth
from tests.analysis.test_three_line_model import ARCSEC, cameras, field_points, observe

FREE = Gauge(minimum_norm=True)
HOLD_SIX = Gauge(held=("nadir x", "forward f", "nadir f", "aft f", "nadir y", "Beijing yaw"))


def middle(count=3):
    """A pass over a few points that all lines see within 1 mm of their middle: f and yaw hardly move their images."""
    points = field_points(np.random.default_rng(4), 300, 2.4)
    seen = observe(points, 2.4, cameras(), BIAS)
    near = np.argsort(np.max([np.abs(y) for y in seen.y.values()], axis=0))[:count]
    return observe(points[near], 2.4, cameras(), BIAS)


MIDDLE = middle()


def equations(field, unknowns=None, noise=NOISE):
    parameters, shared = Parameters.of([field], LABORATORY, unknowns or Unknowns()), SharedNoise.of([field], noise)
    count = sum(len(r.point) for r in field.rays.values())
    state = State(parameters.start, (field.ground,), np.zeros(shared.size))
    weights = Weights(np.ones(count), {"image": 1.0})
    return parameters, assemble([field], LABORATORY, parameters, state, noise, (), weights, shared)


def random_system(rng, size=12, opened=4):
    """A normal matrix whose open and other combinations have sigmas that coincide in part, in mixed units."""
    turn = np.linalg.qr(rng.standard_normal((size, size)))[0]
    sigma = np.concatenate([np.full(opened - 1, 5.0 * WORST), [1e3 * WORST], np.geomspace(1e-7, 1e-6, size - opened)])
    scale = 10.0 ** rng.uniform(-3, 3, size)
    image = turn @ np.diag(sigma**-2.0) @ turn.T
    return image / scale[:, None] / scale, scale, turn[:, :opened]


def same_space(first, second):
    # the normal matrix holds 1e-16 of its largest eigenvalue: 1e14, against the gap of 1e12 to the open ones
    return first.shape == second.shape and np.max(subspace_angles(first, second)) < 1e-3


@pytest.mark.parametrize("seed", range(5))
def test_the_open_space_is_that_of_the_matrix_whatever_units_order_and_basis(seed):
    rng = np.random.default_rng(seed)
    reduced, scale, opened = random_system(rng)
    found = null_vectors(reduced, scale)
    assert same_space(found, opened)
    # another unit of each unknown: metres, millimetres, arcseconds
    unit = 10.0 ** rng.uniform(-6, 6, len(scale))
    assert same_space(null_vectors(reduced * unit[:, None] * unit, scale / unit), opened)
    # another order
    order = rng.permutation(len(scale))
    assert same_space(null_vectors(reduced[np.ix_(order, order)], scale[order]), opened[order])
    # combinations as unknowns, square to each other in image motion
    turn = np.linalg.qr(rng.standard_normal((len(scale), len(scale))))[0]
    image = turn.T @ (scale[:, None] * reduced * scale) @ turn
    assert same_space(turn @ null_vectors(image, np.ones(len(scale))), opened)


@pytest.mark.parametrize("seed", range(5))
def test_names_do_not_depend_on_the_vectors_that_span_the_space(seed):
    rng = np.random.default_rng(seed)
    reduced, scale, _ = random_system(rng)
    names, length = [f"u{k}" for k in range(len(scale))], np.ones(len(scale))
    vectors = null_vectors(reduced, scale)
    told = combinations(names, scale, vectors, reduced, length)
    mixed = vectors @ rng.standard_normal((4, 4))
    order = rng.permutation(len(scale))
    again = [
        combinations(names, scale, mixed, reduced, length),
        combinations([names[i] for i in order], scale[order], mixed[order], reduced[np.ix_(order, order)], length),
    ]
    for other in again:
        assert {frozenset(c.names) for c in other} == {frozenset(c.names) for c in told}
        for one in told:
            (twin,) = (c for c in other if _same(one, c))
            assert twin.sigma == pytest.approx(one.sigma, rel=1e-3)


def _same(one, other):
    """The same changes up to the sign."""
    first, second = (dict(zip(c.names, c.change, strict=True)) for c in (one, other))
    if set(first) != set(second):
        return False
    pairs = np.array([[first[n], second[n]] for n in first])
    sign = np.sign(pairs[0, 0] * pairs[0, 1])
    return np.allclose(pairs[:, 0], sign * pairs[:, 1], rtol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_weak_combinations_do_not_depend_on_units_and_order(seed):
    rng = np.random.default_rng(seed)
    design = rng.standard_normal((40, 8))
    design[:, 7] = design[:, 0] - design[:, 3] + 1e-2 * rng.standard_normal(40)
    length, scale = 1e6 * np.linalg.norm(design, axis=0), 10.0 ** rng.uniform(-3, 3, 8)
    reduced = 1e12 * design.T @ design
    weak = weak_vectors(reduced, length, np.ones(8), np.eye(8))
    assert weak.shape == (8, 1)
    order = rng.permutation(8)
    moved = weak_vectors(reduced[np.ix_(order, order)], length[order], np.ones(8), np.eye(8))
    ratio = moved[:, 0] / weak[order, 0]
    assert ratio == pytest.approx(ratio[0], rel=1e-6)
    other = weak_vectors(reduced / scale[:, None] / scale, length / scale, scale, np.eye(8))
    ratio = other[:, 0] / weak[:, 0]
    assert ratio == pytest.approx(ratio[0], rel=1e-6)


def test_a_gauge_closes_what_data_leave_open_and_nothing_else():
    """Three points near the middle of the lines: every combination that keeps its start values is known to `WORST` or
    worse by the data, whichever way the closed space is cut, and all that is square to it better."""
    parameters, at = equations(measured(MIDDLE))
    scale = parameters.scale
    freedom = free_basis(at.reduced, at.length, scale, parameters.names, FREE)
    image = scale[:, None] * at.reduced * scale
    assert freedom.closed.shape[1] == len(freedom.opened) == 6
    assert np.linalg.eigvalsh(freedom.closed.T @ image @ freedom.closed).max() < WORST**-2
    assert np.linalg.eigvalsh(freedom.basis.T @ image @ freedom.basis).min() > WORST**-2
    # not coupled: nothing of what is solved for moves with what is closed
    mixed = freedom.basis.T @ image @ freedom.closed
    assert np.abs(mixed).max() < 1e-6 * WORST**-2
    # differences of x are known to some micrometres, and the mean angle of three rays to the noise
    sigma = np.linalg.eigvalsh(freedom.basis.T @ image @ freedom.basis) ** -0.5
    assert np.sum(sigma < 3e-6) >= 4
    # no single unknown of these is in the closed space with more than what the data leave of it
    for line in ("forward", "aft"):
        vector = np.zeros(len(scale))
        vector[[parameters.names.index(f"{line} x"), parameters.names.index("nadir x")]] = 1.0, -1.0
        assert np.linalg.norm(freedom.closed.T @ vector) < 2e-3


def test_unknowns_of_another_order_are_adjusted_to_the_same_values():
    field = measured(MIDDLE, np.random.default_rng(3))
    lines = ("aft", "forward", "nadir")
    turned = {k: LABORATORY[k] for k in lines}
    first, second = (adjust([field], c, NOISE, gauge=FREE) for c in (LABORATORY, turned))
    assert first.names != second.names
    for name, sigma in first.sigma.items():
        assert second.value(name) == pytest.approx(first.value(name), abs=1e-6 * sigma)
        assert second.sigma[name] == pytest.approx(sigma, rel=1e-6)


def test_sigmas_contain_what_keeps_its_start_values():
    """40 passes over three points with start values off by 0.1 mm of image motion in every unknown. Two-sided false
    alarm 1e-4 for all unknowns together, open combinations within, and for what the data determine alone."""
    rng, squares, inner = np.random.default_rng(6), [], []
    names = adjust([measured(MIDDLE)], LABORATORY, NOISE, gauge=FREE).names
    true = truth(names)
    for _ in range(40):
        field = measured(MIDDLE, rng)
        scale = Parameters.of([field], LABORATORY, Unknowns()).scale
        start = dict(zip(names, true + WORST * scale * rng.standard_normal(len(names)), strict=True))
        found = adjust([field], LABORATORY, NOISE, gauge=FREE, start=start)
        error, spread = (found.values - true) / scale, found.covariance / scale[:, None] / scale
        squares.append(error @ np.linalg.solve(spread, error))
        _, at = equations(field)
        basis = free_basis(at.reduced, at.length, scale, names, FREE).basis
        known = basis.T @ error
        inner.append(known @ np.linalg.solve(basis.T @ spread @ basis, known))
    for total, size in ((squares, len(names)), (inner, basis.shape[1])):
        assert 5e-5 < stats.chi2.sf(np.sum(total), 40 * size) < 1 - 5e-5
    # f of each line is as uncertain as its start value, and says so
    assert found.sigma["nadir f"] == pytest.approx(WORST, rel=0.05)
    rough = adjust([field], LABORATORY, NOISE, gauge=Gauge(minimum_norm=True, start=3.0 * WORST))
    assert rough.sigma["nadir f"] == pytest.approx(3.0 * WORST, rel=0.05)


def test_held_unknowns_hide_what_follows_them():
    """nadir x off by 0.1 mm: pitch and the other x follow, and `sigma_with` says so."""
    field = measured(middle(60), np.random.default_rng(7))
    found = adjust([field], LABORATORY, NOISE, gauge=HOLD_SIX)
    nadir = LABORATORY["nadir"]
    shifted = {**LABORATORY, "nadir": nadir.with_interior(nadir.interior + np.array([0, 1e-4, 0]))}
    moved = adjust([field], shifted, NOISE, gauge=HOLD_SIX)
    change = found.follow @ [1e-4, 0, 0, 0, 0, 0]
    for k, name in enumerate(found.names):
        assert moved.values[k] - found.values[k] == pytest.approx(change[k], rel=1e-3, abs=1e-3 * found.sigma[name])
    told = found.sigma_with({"nadir x": 1e-4})
    assert told["nadir x"] == pytest.approx(1e-4, rel=1e-12)
    assert told["forward x"] == pytest.approx(1e-4, rel=0.01)
    assert told["Beijing pitch"] == pytest.approx(1e-4 / 0.65, rel=0.01)
    assert told["Beijing pitch"] > 10 * found.sigma["Beijing pitch"]
    with pytest.raises(CalibrationError, match="no unknown is called"):
        found.sigma_with({"forward x": 1e-4})


def test_nothing_determined_and_bad_gauges_are_told():
    lonely = measured(middle(2))
    vague = Noise(1e4 * PITCH, 1e3 * ARCSEC)
    with pytest.raises(RankError, match="determine none"):
        adjust([lonely], LABORATORY, vague, gauge=FREE)
    with pytest.raises(CalibrationError, match="start values must be positive"):
        adjust([lonely], LABORATORY, NOISE, gauge=Gauge(minimum_norm=True, start=0.0))
