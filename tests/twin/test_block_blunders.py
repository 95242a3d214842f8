"""Gross errors of any size, in ties and in control points: rejected by name, and no good point with them."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.block.block_adjustment import BlockAdjustment, adjust_block
from analysis.orbit.forward_intersection import level_axes
from scenes.specs.procedures import PROCEDURES
from tests.analysis.drawn_blocks import Plan, draw, without_errors_in_images
from tests.twin.rational_bench import bench

Named = set[tuple[str, str]]
SIZES = [10.0, 500.0, 1e5]
SHARES = [0.01, 0.05, 0.2]
POINTS, CONTROL = 100, 10


def judge(adjustment: BlockAdjustment, rejected: Iterable[tuple[str, str]], bad: Named, size: float) -> None:
    """All are named, and no point that has none; 10 sigma along the looks are not always seen."""
    assert {point for point, _ in rejected} <= {point for point, _ in bad}
    assert len(bad - set(rejected)) <= (0.2 * len(bad) if size < 20.0 else 0)
    assert adjustment.p_value > 1e-3


def rational(folder: Path, size: float, ties: float, control: float) -> tuple[BlockAdjustment, list, Named]:
    """A block of three images with these shares of wrong tie and control points; control errors are horizontal."""
    one, rng, bad = bench({"shift": 5.0}, POINTS), np.random.default_rng(8), set()
    wrong = rng.choice(np.arange(CONTROL, POINTS), round(ties * POINTS), replace=False).tolist()
    for point in wrong:
        image, angle = list(one.images)[rng.integers(3)], rng.uniform(0.0, 2.0 * np.pi)
        one.places[image][point, 1:] += size * one.sigma * np.array([np.cos(angle), np.sin(angle)])
        bad.add((f"p{point}", image))
    true = one.ground.copy()
    for point in rng.choice(CONTROL, round(control * CONTROL), replace=False).tolist():
        angle = rng.uniform(0.0, 2.0 * np.pi)
        east, north = level_axes(one.ground[point][None])[0][:2]
        one.ground[point] += size * 0.05 * (np.cos(angle) * east + np.sin(angle) * north)
        bad.add((f"p{point}", "control"))
    procedure = PROCEDURES["orbit adjust"]
    file = one.write(folder, {"shift": [5.0, 5.0]}, CONTROL if control else 0)
    run = procedure.run(procedure.resolve(file), None, 0, lambda *_: None)
    good = np.isfinite(run.adjustment.ground).all(axis=1)
    error = (run.adjustment.ground - true)[good]
    square = np.einsum(
        "ni,nij,nj->n", error, np.linalg.inv(run.adjustment.point_covariance(np.flatnonzero(good))), error
    )
    assert np.median(square) < 12.0  # points share the errors of the shifts, with or without control
    return run.adjustment, run.rejected, bad


def test_one_tie_point_of_500_sigma(tmp_path: Path) -> None:
    adjustment, rejected, bad = rational(tmp_path, 500.0, 0.01, 0.0)
    assert len(bad) == 1
    judge(adjustment, rejected, bad, 500.0)


@pytest.mark.second
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("share", SHARES)
def test_images_with_rational_polynomials(tmp_path: Path, size: float, share: float) -> None:
    adjustment, rejected, bad = rational(tmp_path, size, share, 0.0)
    judge(adjustment, rejected, bad, size)


@pytest.mark.second
@pytest.mark.parametrize("size", SIZES)
def test_control_points_of_images_with_rational_polynomials(tmp_path: Path, size: float) -> None:
    adjustment, rejected, bad = rational(tmp_path, size, 0.0, 0.2)
    judge(adjustment, rejected, bad, size)


@pytest.mark.second
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(("ties", "control"), [(0.01, 0.0), (0.2, 0.0), (0.05, 0.2)])
def test_passes_of_line_cameras(size: float, ties: float, control: float) -> None:
    plan = Plan(ties=POINTS, control=CONTROL)
    drawn, rng, bad = draw(plan, np.random.default_rng(4)), np.random.default_rng(9), set()
    points = drawn.block.points
    for point in rng.choice(np.arange(CONTROL, CONTROL + POINTS), round(ties * POINTS), replace=False).tolist():
        scene, angle = drawn.block.scenes[rng.integers(4)], rng.uniform(0.0, 2.0 * np.pi)
        shift = size * plan.image * np.array([np.cos(angle), np.sin(angle)])
        drawn = without_errors_in_images(drawn, scene.name, np.flatnonzero(scene.rays.point == point), shift)
        bad.add((str(points.ids[point]), scene.name))
    start = points.start.copy()
    for point in rng.choice(CONTROL, round(control * CONTROL), replace=False).tolist():
        start[point] += size * plan.control_sigma[1] * np.array([0.6, -0.64, 0.48])
        bad.add((str(points.ids[point]), "control"))
    block = replace(drawn.block, points=replace(points, start=start))
    adjustment = adjust_block(block, robust="reject")
    judge(adjustment, adjustment.rejected(), bad, size)
