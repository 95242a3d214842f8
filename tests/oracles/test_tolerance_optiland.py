"""Tolerances of a three-mirror telescope beside optiland's tolerancing: sensitivities, distributions, and time."""

import warnings

import numpy as np
import pytest

from optics.numerics.backend import Backend
from scenes.specs.tolerance import ToleranceSetup
from twin.tolerance.merit_models import sensitivities
from twin.tolerance.tolerance_bench import ToleranceBench

pytest.importorskip("batoid", reason="batoid not installed (extra `oracles`)")
pytest.importorskip("optiland", reason="optiland not installed (extra `oracles`)")

from tests.oracles.tolerance_optiland import BUDGET, LEAST, SETTLED, Peer, twin_budget

pytestmark = pytest.mark.oracle

CLOSE = 0.01
"""Share of a change to which the two are to agree."""


@pytest.fixture(scope="module")
def setup(tmp_path_factory) -> ToleranceSetup:
    return twin_budget(tmp_path_factory.mktemp("tolerance"))


@pytest.fixture(scope="module")
def bench(setup: ToleranceSetup, backend: Backend) -> ToleranceBench:
    return ToleranceBench(setup, backend)


@pytest.fixture(scope="module")
def peer(bench: ToleranceBench) -> Peer:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # remarks on optiland's own code
        out = Peer(bench.optics.model, bench.fields)
        out.register()
    return out


@pytest.mark.second
@pytest.mark.filterwarnings("ignore")
def test_sensitivities_are_those_of_optiland(bench: ToleranceBench, peer: Peer) -> None:
    """Both ends of every tolerance, refocused."""
    from optiland.tolerancing import RangeSampler, SensitivityAnalysis

    ours = sensitivities(bench)
    nominal = peer.tolerancing(precise=True)
    nominal.apply_compensators()
    designed = nominal.evaluate()[1]
    nominal.reset()
    assert ours.nominal[0] == pytest.approx(designed, abs=SETTLED)
    names, theirs = list(BUDGET), []
    for group in (names[k : k + 6] for k in range(0, len(names), 6)):  # optiland takes six at most
        tolerancing = peer.tolerancing(precise=True)
        for name in group:
            peer.add(tolerancing, name, RangeSampler(peer.end(name, -1.0), peer.end(name, 1.0), 2))
        run = SensitivityAnalysis(tolerancing)
        run.run()
        theirs.append(run.get_results()[run.operand_names[1]].to_numpy().reshape(-1, 2))
    change = np.concatenate(theirs) - designed
    assert list(bench.entries) == names
    assert len(names) == 20
    assert np.abs(change).max(axis=1).min() > LEAST
    np.testing.assert_allclose(ours.values[:, :, 0] - ours.nominal[0], change, rtol=CLOSE, atol=0)
