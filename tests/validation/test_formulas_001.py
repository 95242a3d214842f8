"""Paper 001's formulas on rendered images, single and joint: their factors and verdicts."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from twin.validation.paper_001.formulas import GROUP, JOINT, JointMotions, mirror_turns
from twin.validation.registry import select
from twin.validation.runner import run_checks


@pytest.fixture(scope="module")
def formulas(backend):
    validation = run_checks(select([GROUP, JOINT], None), backend, 3, fast=True)
    return {result.id: result for result in validation.results}


def test_formulas_of_paper_001(formulas):
    assert set(formulas) == {*GROUP.ids, *JOINT.ids}
    table = yaml.safe_load(Path(__file__).with_name("paper_001.yaml").read_text("utf-8"))
    for identifier, (value, accuracy, verdict) in table.items():
        result = formulas[identifier]
        assert result.measured == pytest.approx(value, abs=accuracy), identifier
        assert result.verdict == verdict, identifier
        assert "cause is not known" not in result.how
        assert "weak" not in result.how


@pytest.mark.second
def test_the_same_seed_gives_the_same_numbers_and_another_other_noise(formulas, backend):
    chosen = select([GROUP], "001.eq5")
    again, other = (run_checks(chosen, backend, seed).results[0] for seed in (3, 4))
    assert again.measured == formulas["001.eq5"].measured
    difference = abs(other.measured - again.measured)
    assert 0 < difference < 6 * again.sigma


def test_a_mirror_turns_the_ray_by_twice_its_turn(backend):
    turns = np.array([1e-6, 0.01, 0.3])
    turned, moved = mirror_turns(backend, turns)
    assert turned == pytest.approx(2 * turns, rel=1e-9)
    assert moved == pytest.approx(np.tan(2 * turns), rel=1e-9)


def test_the_slope_of_angles_scatters_as_its_sigma_says() -> None:
    """Of 2000 campaigns the scatter is known to 1.6 %."""
    rng = np.random.default_rng(5)
    true, sigma = 1e-5 * rng.normal(size=12), np.full(12, 1e-6)

    def fitted() -> tuple[float, float]:
        angle = SimpleNamespace(change_rad=0.9 * true + sigma * rng.normal(size=12), sigma_rad=sigma)
        run = SimpleNamespace(mixtures=slice(None), truth=SimpleNamespace(angle_change=true))
        run.estimates = lambda: SimpleNamespace(angle={"model": angle})
        return JointMotions.angle(run, "model")[:2]

    slope, stated = np.array([fitted() for _ in range(2000)]).T
    assert np.std(slope) == pytest.approx(stated[0], rel=0.08)
    assert np.mean(slope) == pytest.approx(0.9, abs=4.0 * stated[0] / np.sqrt(2000))
