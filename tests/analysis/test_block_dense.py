"""A block adjusted by the program and by one dense matrix in another parametrisation: the same to 1e-3 sigma.

Drawn blocks: sigmas, chi-squares and check points are right for every subset of sensors and for each law of the
attitude; what is wrong with a block is told, by name.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from analysis.block.block import Term
from analysis.block.block_adjustment import adjust_block, law_tests
from analysis.block.error_processes import BlockError, Law, Support
from analysis.block.network import datum_test, network_of, open_combinations
from tests.analysis.dense_block import DenseBlock
from tests.analysis.drawn_blocks import ARCSEC, EAST, PITCH, Plan, draw, without_errors_in_images
from tests.analysis.refusals import refuses
from tests.tiers import quick

TRACKER = Term(Law("tracker bias", "constant", (3 * ARCSEC,) * 3), "tracker")
LAWS = {
    "white": Law("attitude", "white", (0.5 * ARCSEC, 0.4 * ARCSEC, 0.8 * ARCSEC), 0.5),
    "walk": Law("walk", "walk", (0.5 * ARCSEC, 0.4 * ARCSEC, 0.8 * ARCSEC), 0.5),
    "slow": Law("slow", "slow", (0.5 * ARCSEC, 0.4 * ARCSEC, 0.8 * ARCSEC), 0.5, 20.0),
    "orbital": Law("thermal", "orbital", (1.5 * ARCSEC,) * 3, time=5900.0),
    "jitter": Law("jitter", "jitter", (0.5 * ARCSEC, 0.4 * ARCSEC, 0.8 * ARCSEC), 1.0, 20.0, 0.65),
    "rate": Law("rate", "rate", (0.05 * ARCSEC,) * 3),
}
STATION = (Term(Law("orbit", "constant", (0.5, 0.4, 0.6))), Term(Law("gps", "white", (0.05,) * 3, 1.0)))


def compared(block):
    """Largest differences in sigmas, and relative ones of covariances."""
    found, dense = adjust_block(block), DenseBlock(block)
    spread = found.point_covariance(dense.points)
    assert found.point_covariance(dense.points[:0]).shape == (0, 3, 3)
    sigma = np.sqrt(np.diagonal(dense.ground_covariance, axis1=1, axis2=2))
    apart = np.abs(found.ground[dense.points] - dense.ground) / sigma
    wrong = np.abs(spread - dense.ground_covariance) / (sigma[:, :, None] * sigma[:, None, :])
    results = {"ground": apart.max(), "ground covariance": wrong.max()}
    for scene in block.scenes:
        where = dense.change[scene.of, scene.camera]
        value, covariance = found.change(scene.name)
        others = dense.covariance[np.ix_(where, where)]
        root = np.sqrt(np.diag(others))
        results[f"{scene.name} camera"] = np.max(np.abs(value - dense.u[where]) / root)
        results[f"{scene.name} camera covariance"] = np.max(np.abs(covariance - others) / (root[:, None] * root))
    results["chi-square"] = abs(found.chi_square - dense.chi_square)
    return results


@pytest.mark.second
@pytest.mark.parametrize("law", quick(1, LAWS))
def test_every_law_as_one_dense_matrix_has_it(law):
    attitude = (TRACKER, Term(LAWS[law], "block" if law == "orbital" else "pass"))
    plan = Plan(ties=20, control=3, check=3, attitude=attitude, station=STATION)
    results = compared(draw(plan, np.random.default_rng(3)).block)
    assert max(results.values()) < 1e-3, results


# --- block statistics -------------------------------------------------------------------------------------------------

WHITE = Law("attitude", "white", (0.7 * ARCSEC,) * 3, 0.5)
WALK = Law("attitude", "walk", (1.0 * ARCSEC,) * 3, 0.5)
SENSORS = ("control", "monitor", "laser", "terrain")


def plan(law, **changes):
    bias = Term(Law("tracker bias", "constant", (3 * ARCSEC,) * 3), "tracker")
    small = Plan(ties=14, control=3, check=5, half=2e3, attitude=(bias, Term(law)))
    return replace(small, **changes)


def judged(law, missing, blocks, seed):
    """P-values of the sum of chi-squares and of that of check points, over drawn blocks without some sensors."""
    square = freedom = check = count = 0
    for number in range(blocks):
        drawn = draw(plan(law), np.random.default_rng([seed, number]))
        block = drawn.block
        for sensor in missing:
            block = block.without(sensor)
        found = adjust_block(block)
        square, freedom = square + found.chi_square, freedom + found.degrees_of_freedom
        # one check point of a block: those of one block err alike
        where = np.flatnonzero(block.points.role == "check")[:1]
        error = found.ground[where] - drawn.ground[where]
        check += float(np.einsum("ni,nij,nj->", error, np.linalg.inv(found.point_covariance(where)), error))
        count += 3
    return _two_sided(square, freedom), _two_sided(check, count)


def _two_sided(square, freedom):
    high = chi2.sf(square, freedom)
    return 2 * min(high, 1 - high)


# 64 p-values in all of the slow tier: 1e-4 each is a false alarm in 160 changes of the seeds
_ALARM = 1e-4


@pytest.mark.second
@pytest.mark.parametrize("law", quick(1, [WHITE, WALK]), ids=["white", "walk"])
def test_chi_square_and_check_points_with_and_without_all_sensors(law):
    for missing in ((), SENSORS):
        assert min(judged(law, missing, 12, 4)) > _ALARM


@pytest.mark.parametrize(("stated", "true"), quick(2, [(WHITE, WALK), (WALK, WHITE), (WHITE, WHITE), (WALK, WALK)]))
def test_a_wrong_law_is_told_and_a_right_one_is_not(stated, true):
    for seed in range(3):
        made = plan(stated, ties=60, half=5e3, image=0.1 * PITCH)
        found = adjust_block(draw(made, np.random.default_rng(seed), replace(made, attitude=plan(true).attitude)).block)
        test = next(t for t in law_tests(found) if t.group == "attitude")
        if stated is true:
            assert found.p_value > 1e-3
            assert test.p_value > 1e-3
        else:
            assert found.p_value < 1e-6
            assert np.sign(test.excess) == (1 if stated is WHITE else -1)
        if stated is WHITE and true is WALK:
            assert test.p_value < 1e-6
            assert "does not fit the readings" in str(test)


@pytest.mark.second
def test_one_tenth_of_gross_errors_is_found_by_name():
    drawn = draw(plan(WHITE, ties=60, half=4e3), np.random.default_rng(2))
    random = np.random.default_rng(3)
    rows = random.permutation(np.arange(3, 63))[:12]  # of 120 image points of ties in one pass
    moved = 30 * PITCH * random.choice([-1.0, 1.0], (12, 2))
    wrong = without_errors_in_images(drawn, "P0/fore", rows, moved)
    assert adjust_block(wrong.block).p_value < 1e-9
    found = adjust_block(wrong.block, robust="reject")
    told = {point for point, of in found.rejected() if of == "P0/fore"}
    bad = {str(drawn.block.points.ids[k]) for k in rows}
    assert bad <= told
    assert len(told - bad) <= 2
    right = adjust_block(drawn.block)
    where = np.flatnonzero(drawn.block.points.role == "check")
    sigma = np.sqrt(np.diagonal(found.point_covariance(where), axis1=1, axis2=2))
    assert np.max(np.abs(found.ground[where] - right.ground[where]) / sigma) < 1.5


def test_control_in_another_datum_is_told_with_its_shift():
    drawn = draw(plan(WHITE, control=6), np.random.default_rng(5))
    points = drawn.block.points
    control = points.role == "control"
    start = np.where(control[:, None], points.start + 120.0 * EAST, points.start)
    test = datum_test(adjust_block(replace(drawn.block, points=replace(points, start=start)), datum=True))
    assert test.chi_square > 100.0
    # the orbit is known to 0.5 m and the attitude to 7 m on the ground
    assert abs(test.east - 120.0) < 4 * test.sigma[0] < 40.0
    right = datum_test(adjust_block(drawn.block, datum=True))
    assert right.chi_square < chi2.isf(1e-3, 3)


def test_swapped_coordinates_are_refused_by_name():
    drawn = draw(plan(WHITE), np.random.default_rng(5))
    points = drawn.block.points
    start = points.start.copy()
    start[1] = start[1][[1, 0, 2]]
    with pytest.raises(BlockError, match=r"c1 in P0/fore.*order x, y, z"):
        adjust_block(replace(drawn.block, points=replace(points, start=start)))


def test_a_network_in_two_parts_and_scenes_that_share_nothing_are_named():
    drawn = draw(plan(WHITE, passes=3, footprints=0), np.random.default_rng(5))
    block = drawn.block
    half = np.arange(len(block.points.ids)) % 2 == 0
    scenes = []
    for scene in block.scenes:
        kept = half if scene.of == "P0" else ~half
        rays = scene.rays.taken(kept[scene.rays.point])
        if scene.name == "P2/back":
            rays = rays.taken(np.zeros(len(rays.point), bool))
        scenes.append(replace(scene, rays=rays))
    block = replace(block, scenes=tuple(scenes))
    network = network_of(block)
    assert set(network.parts[0]) == {"P1/fore", "P1/back", "P2/fore"}
    assert set(network.parts[1]) == {"P0/fore", "P0/back"}
    assert network.empty == ("P2/back",)
    # the scenes are still adjusted, held together by what is known of the readings
    assert np.isfinite(adjust_block(block).p_value)
    alone = [s if s.name == "P0/fore" else replace(s, rays=s.rays.taken(~half[s.rays.point])) for s in block.scenes]
    assert "P0/fore" in network_of(replace(block, scenes=tuple(alone))).alone


def test_open_combinations_without_any_control_are_shifts_and_turns_of_all_passes():
    drawn = draw(plan(WHITE, control=0, monitor=None, terrain=None, footprints=0), np.random.default_rng(5))
    found = open_combinations(adjust_block(drawn.block))
    # three shifts of all passes together, and pitch against d_alpha of all cameras, are told by nothing
    assert found[0].sigma_ratio < 1e-3
    named = [set(one.names) for one in found if one.sigma_ratio < 1e-3]
    for axis in ("along", "across", "down"):
        assert any({f"P0 offset {axis}", f"P1 offset {axis}"} <= names for names in named), axis
    assert any({"P0 pitch", "P0 fore d_alpha", "P0 back d_alpha"} <= names for names in named)


def test_variance_components_find_a_wrong_image_sigma():
    stated = plan(WHITE, ties=60, half=4e3)
    block = replace(draw(stated, np.random.default_rng(8)).block, image=0.5 * stated.image)
    found = adjust_block(block, variance_components=("image",))
    # 300 redundant observations give a variance to 8%
    assert found.factors["image"] == pytest.approx(4.0, rel=0.35)
    assert found.p_value > 1e-3


def test_spread_of_laws_and_laws_that_make_no_sense():
    """A walk is a sum of independent steps: its variance grows with time, a rate's deviation does, others stay."""
    for seconds in (-9.0, 0.25, 4.0):
        for kind, grown in (("walk", abs(seconds) ** 0.5), ("rate", abs(seconds)), ("white", 1.0), ("constant", 1.0)):
            assert Law("a", kind, (1.0, 2.0, 3.0)).spread(seconds) == pytest.approx(grown * np.array([1.0, 2.0, 3.0]))
    for law, said in (
        (Law("a", "brown", (1.0,) * 3), "the error model must be one of"),
        (Law("a", "white", (1.0, -1.0, 1.0)), "three sigmas that are finite and not negative"),
        (Law("a", "walk", (1.0,) * 3, 0.0), "the interval must be positive"),
        (Law("a", "jitter", (1.0,) * 3, 1.0, 5.0), "the frequency must be positive"),
        (Law("a", "slow", (1.0,) * 3, 1.0), "correlation time or period must be positive"),
    ):
        refuses(BlockError, said, law.check)
    refuses(BlockError, "no observation depends on it", Support.of, WHITE, np.zeros(0))
    refuses(BlockError, "the interval is too short", Support.of, WHITE, np.array([0.0, 1e9]))


@pytest.mark.second
def test_serial_correlation_has_unit_variance_under_the_right_law():
    every = []
    for seed in range(30):
        found = adjust_block(draw(plan(WHITE, ties=20, half=4e3), np.random.default_rng([9, seed])).block)
        every += [t.excess for t in law_tests(found) if t.group == "attitude"]
    # sums of products are not quite normal; 30 draws give the spread to 13%
    assert abs(np.mean(every)) < 0.65
    assert 0.6 < np.std(every) < 1.5
