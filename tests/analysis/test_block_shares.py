"""A block whose points are reduced in shares is the block whose points are reduced at once."""

import pickle

import numpy as np
import pytest

from analysis.block.block import Term
from analysis.block.block_adjustment import adjust_block
from analysis.block.processes import Law
from tests.analysis.drawn_blocks import ARCSEC, PITCH, Plan, draw, without_errors_in_images
from tests.analysis.refusals import refuses
from twin.framework.cluster import ClusterError
from twin.orbit.block.block_run import point_workers

LAWS = (
    Term(Law("tracker bias", "constant", (3 * ARCSEC,) * 3), "tracker"),
    Term(Law("attitude", "white", (0.5 * ARCSEC,) * 3, 0.5)),
)


class Posted:
    """Shares as other processes have them: everything goes through bytes."""

    def __init__(self, count):
        self.count, self.held = count, []

    def hold(self, things):
        self.held += [pickle.dumps(one) for one in things]
        return range(len(self.held) - len(things), len(self.held))

    def results(self, work, arguments):
        posted = [pickle.dumps(one) for one in arguments]
        every = [pickle.loads(one) for one in posted]
        return [pickle.loads(pickle.dumps(work((pickle.loads(self.held[first]), *rest)))) for first, *rest in every]


def spoilt():
    """A block with all kinds of observations and some gross errors."""
    drawn = draw(Plan(ties=60, attitude=LAWS, half=4e3), np.random.default_rng(7))
    moved = np.tile([30 * PITCH, 0.0], (3, 1))
    return without_errors_in_images(drawn, "P0/fore", np.array([9, 20, 31]), moved).block


def same(found, other):
    """Whether two adjustments are the same to 1e-9 sigma, with the same tests and covariances."""
    sigma = np.sqrt(np.diag(other.covariance))
    assert np.max(np.abs(found.x - other.x) / sigma) < 1e-9
    every = np.flatnonzero(np.isfinite(other.ground[:, 0]))
    spread = np.sqrt(np.diagonal(other.point_covariance(every), axis1=1, axis2=2))
    # a coordinate is a number of 9e-10 m, some 5e-9 sigma: the last digit may differ
    digit = np.spacing(np.abs(other.ground[every]))
    assert np.max((np.abs(found.ground - other.ground)[every] - digit) / spread) < 1e-9
    scale = sigma[:, None] * sigma
    assert np.max(np.abs(found.covariance - other.covariance) / scale) < 1e-9
    assert found.rejected() == other.rejected()
    assert found.chi_square == pytest.approx(other.chi_square, rel=1e-9)
    for name, group in other.groups.items():
        assert found.groups[name].redundancy == pytest.approx(group.redundancy, rel=1e-9, abs=1e-9)


@pytest.mark.second
def test_shares_that_went_through_bytes_give_the_same_adjustment():
    block = spoilt()
    whole = adjust_block(block, robust="reject")
    assert len(whole.rejected()) >= 3
    same(adjust_block(block, robust="reject", pool=Posted(3)), whole)
    # fewer points than processes: none has an empty share
    few = draw(Plan(ties=3, control=2, check=1, footprints=0, attitude=LAWS), np.random.default_rng(7)).block
    same(adjust_block(few, pool=Posted(9)), adjust_block(few))


@pytest.mark.second
def test_workers_of_the_engine_of_studies_give_the_same_adjustment():
    block = spoilt()
    with point_workers(2, None, lambda text: None) as pool:
        assert pool.count == 2
        same(adjust_block(block, robust="reject", pool=pool), adjust_block(block, robust="reject"))
        # what fails on a worker is told, and that a worker is gone, too
        refuses(ClusterError, "division", pool.results, _divided, [(0,)])


def _divided(given):
    return 1 / given[0]
