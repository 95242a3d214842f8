"""A block adjusted by the program and by one dense matrix in another parametrisation: the same to 1e-3 sigma."""

import numpy as np
import pytest

from analysis.block.block import Term
from analysis.block.block_adjustment import adjust_block
from analysis.block.processes import Law
from tests.analysis.dense_block import DenseBlock
from tests.analysis.drawn_blocks import ARCSEC, Plan, draw
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
