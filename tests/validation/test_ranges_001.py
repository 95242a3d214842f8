"""Range studies of paper 001's formulas: limits, kinds of return, and rows that turn with a broken formula."""

import numpy as np
import pytest

from analysis.monitor import monitoring
from analysis.spots.spot_positions import SpotError
from scenes.specs.job import JobSpec
from scenes.specs.resolved import resolve_job
from tests.validation.mutated import undrawn
from twin.validation.checks.check import CORRECTED, REFUTED
from twin.validation.checks.group import Context
from twin.validation.paper_001.ranges import ranges_group
from twin.validation.paper_001.ranges.curves import Bench, sampled
from twin.validation.paper_001.ranges.defocus import variant, with_return
from twin.validation.paper_001.ranges.ranges_group import GROUP
from twin.validation.paper_001.ranges.turns import EDGE_PX, WIDE_PX, motion_of, single_range
from twin.validation.registry import select
from twin.validation.runner import run_checks

EXPECTED = {check.id: check.expected for check in GROUP.checks}


@pytest.fixture(scope="module")
def resolved():
    return resolve_job(JobSpec(instrument=ranges_group.INSTRUMENT))


@pytest.fixture(scope="module")
def bench(resolved, backend):
    return Bench(variant(resolved, backend, "forward"))


@pytest.fixture(scope="module")
def wide(resolved, backend, bench):
    return Bench(variant(resolved, backend, "forward", pixels=WIDE_PX), bench, shapes=True)


def test_a_limit_is_found_between_the_points():
    calls = []

    def share(size):
        calls.extend(size)
        return {
            "power": (size / 3.7) ** 2,
            "bent": size / 50 + (size / 9.0) ** 3,
            "never": 0.0 * size,
            "at once": 2 + size,
        }

    curves = sampled(share, [0.1, 1.0, 10.0, 100.0])
    # interpolated on logarithmic axes, in which a power law is straight
    assert curves.crossing("power") == pytest.approx(3.7, rel=1e-9)
    exact = np.roots([1 / 9.0**3, 0.0, 1 / 50, -1.0])
    assert curves.crossing("bent") == pytest.approx(float(exact[np.isreal(exact)][0].real), rel=2e-3)
    assert curves.crossing("never") is None
    assert curves.crossing("at once") == 0.0
    assert len(calls) > 4


def test_larger_ccds_read_the_same_positions(bench, wide):
    # the same light on the same pixels; single precision of the images is 1e-7 of the peak
    assert wide.positions([{}]) == pytest.approx(bench.positions([{}]), abs=1e-4)
    # where beams are traced from the middles of the CCDs, pixels: coma of the edge against the middle
    assert np.abs(bench.traced([{}])).max() < 0.1


def test_an_unknown_kind_of_return_is_refused(bench):
    with pytest.raises(ValueError, match="no return 'mirror'; there are plane, "):
        with_return(bench.experiment, "mirror")
    assert with_return(bench.experiment, "plane") is bench.experiment


@pytest.mark.second
def test_the_edge_of_the_window_is_where_the_centroid_refuses(bench, wide):
    found = single_range(bench, wide, "d_beta", 1, 3)
    motion, unit = motion_of("forward", "d_beta", bench.geometry("forward"))
    scale = found.window / 1.0016  # the traced change is 1.0016 times the nominal one
    inside, outside = (motion.state(unit * scale * share) for share in (0.995, 1.035))
    place = bench.positions([inside])
    assert np.min(place[..., 0]) == pytest.approx(EDGE_PX, abs=0.5)
    with pytest.raises(SpotError, match=r"edge|template"):
        bench.positions([outside])


@pytest.mark.second
def test_the_range_of_a_formula_turns_with_a_wrong_factor(bench, wide, backend, monkeypatch):
    parameter, row, verdict = "d_alpha", "001.eq3.range", CORRECTED
    context = Context(backend, 1, frozenset({row}), {check.id: check for check in GROUP.checks}, fast=True)

    def judged():
        both = [single_range(bench, wide, parameter, 1, 3)]
        return ranges_group._range(context, row, both, bench.geometry("forward")).verdict

    assert judged() == verdict
    right = monitoring.coefficients
    monkeypatch.setattr(monitoring, "coefficients", lambda name, geometry: 0.5 * right(name, geometry))
    assert judged() == REFUTED


@pytest.mark.second
def test_only_a_plane_face_returns_what_the_formulas_take(backend):
    with undrawn():
        results = run_checks(select([GROUP], "001.returns"), backend, 1, fast=True).results
    found = {r.id.rpartition(".")[2]: r for r in results}
    assert {r.id: r.verdict for r in results} == {i: v for i, v in EXPECTED.items() if "returns" in i}
    # pinhole images on a mirror's far side of its normal, and on itself by a retroreflector
    assert found["plane"].measured == pytest.approx(-2.0, abs=1e-3)
    for kind in ("roof", "roof_along", "corner"):
        assert found[kind].measured == pytest.approx(0.0, abs=1e-3)
