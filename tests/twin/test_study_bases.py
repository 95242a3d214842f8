"""Every command that a study can vary, with its own library file: two seeds, two sets of results."""

import math

import pytest

from scenes.specs.study import ResponseSpec
from twin.study.runs.base_job import BlockResult, leaf, with_values
from twin.study.runs.plan import Plan
from twin.study.runs.setup import resolve_study


def numbers(tree, path=()):
    """Key path -> number, of everything in results."""
    if isinstance(tree, dict | list | tuple):
        items = tree.items() if isinstance(tree, dict) else enumerate(tree)
        return {key: number for name, below in items for key, number in numbers(below, (*path, name)).items()}
    return {path: tree} if isinstance(tree, int | float) and not isinstance(tree, bool) else {}


SMALLER = {"distortion": [(("test", "points"), 11), (("test", "sets"), 2)], "angle": [(("test", "passes"), 3)]}
"""Changes of a base that make it quicker."""


@pytest.mark.second
@pytest.mark.parametrize(("command", "file"), [("lab distortion", "distortion"), ("orbit angle", "angle")])
def test_two_seeds(tmp_path, backend, command, file) -> None:
    """Both runs are good, have the same keys, and numbers that noise changes; what the base's seed gives comes back."""
    path = tmp_path / "study.yaml"
    text = f"""name: s
base: {{command: {command}, file: {file}}}
factors: {{draw: {{key: [test, seed], values: [1, 2]}}}}
noise: shared
responses: {{r: {{key: [x]}}}}
"""
    path.write_text(text, "utf-8")
    setup = resolve_study(path)
    plan = Plan.of(setup)
    assert plan.blocks == 2  # slow runs are kept, and shared out, one by one
    tree = with_values(setup.tree, SMALLER[file])
    outcomes = [setup.job.evaluate(tree, runs, backend)[0] for runs in plan.runs_of(range(2))]
    one, two = (numbers(outcome) for outcome in outcomes)
    assert set(one) == set(two)
    changed = [key for key in one if one[key] != two[key] and "seed" not in key]
    assert len(changed) >= 5, changed
    # the same by the engine's own way of reading results
    result = BlockResult.of(outcomes, {str(k): ResponseSpec(key=key) for k, key in enumerate(changed)})
    assert not result.failed.any()
    assert result.values.tolist() == [[float(leaf(o, key)) for key in changed] for o in outcomes]
    assert all(math.isfinite(value) for value in result.values.ravel().tolist())
