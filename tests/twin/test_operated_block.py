"""The cameras of a block by the record of their monitor: as by hand from the same laws and readings, in the block's
units, and of the instrument that took the images alone."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from analysis.block.block import JointCameraPrior
from analysis.block.block_adjustment import adjust_block
from optics.numerics.backend import one_blas_thread
from scenes.specs.operation import read_operation
from scenes.specs.orbit.setup import AdjustSetup
from scenes.yaml.errors import InputError
from tests.twin.operation_records import (
    DAY,
    DISTURBANCES,
    NOISE,
    PLAN,
    given,
    life_of,
    monitor_entry,
    plan_of,
    record_of,
)
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.operate.operated_block import run_operated_block
from twin.orbit.block.drawn_block import draw_block

pytestmark = pytest.mark.second
LINES = ("forward", "backward")
READINGS, EVERY = 30, 2.0
"""Of the monitor, days apart."""
PASSES = (31.3, 31.37)
"""Days of the passes: an orbit apart, between two readings of the monitor."""
PAYLOAD = """name: own
description: lines of monitor_pair
pixels: 32768
pitch: 7 um
lines:
  forward: {look: 26 deg, position: [1.8 m, 0 m, 0 m], principal_distance: 7680 mm}
  backward: {look: -5 deg, position: [-1.8 m, 0 m, 0 m], principal_distance: 7680 mm}
"""
FILE = Path(__file__).with_name("operated_block.yaml").read_text("utf-8")


def utc(days):
    moment = datetime(2026, 3, 1, tzinfo=UTC) + timedelta(days=days)
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")


@pytest.fixture(scope="module")
def operated(tmp_path_factory, backend):
    """Folder with the record of a life, its plan, a payload and a block; what is stated to move; what was read."""
    folder = tmp_path_factory.mktemp("operated")
    plan_of(folder)
    # without slips that no event told, with which an estimate reckons and the dense normal does not
    (folder / "own.yaml").write_text(DISTURBANCES[: DISTURBANCES.index("  settling:")])
    lines = PLAN.format(instrument="monitor_pair", disturbances="own.yaml").splitlines(keepends=True)
    (folder / "plan.yaml").write_text("".join(one for one in lines if not one.startswith("events")))
    plan = read_operation(folder / "plan.yaml")
    experiment = MonitorExperiment(plan.model, backend)
    stated = experiment.disturbances
    life = life_of(stated, READINGS * EVERY, EVERY, 3, {})
    entries = [monitor_entry(experiment, stated, life, k, 3) for k in range(READINGS)]
    with record_of(folder / "record", plan) as history:
        history.ingest(given("all", entries))
    (folder / "own_lines.yaml").write_text(PAYLOAD)
    (folder / "turned.yaml").write_text(PAYLOAD.replace("26 deg", "20 deg"))
    (folder / "renamed.yaml").write_text(PAYLOAD.replace("backward", "rear"))
    text = FILE.replace("EPOCH_ONE", utc(PASSES[0])).replace("EPOCH_TWO", utc(PASSES[1]))
    (folder / "block.yaml").write_text(text)
    shifts = [[one["after"][k] - 30.0 for one in places(entry) for k in ("row", "column")] for entry in entries]
    return folder, stated, np.array(shifts)


def places(entry):
    return [one for camera in entry.content["numbers"]["spots"].values() for one in camera.values()]


def by_hand(stated, shifts):
    """One dense normal of all motions at all readings and passes, by the stated laws, and what readings leave of it."""
    seconds = np.concatenate([np.arange(READINGS) * EVERY, PASSES]) * DAY
    laws = [law.covariance(seconds[:, None], seconds) for law in stated.laws]
    moved = np.zeros((len(seconds), len(laws), len(seconds), len(laws)))
    for k, law in enumerate(laws):
        moved[:, k, :, k] = law
    spots = np.einsum("sm,tmun,rn->tsur", stated.spots, moved[:READINGS, :, :READINGS], stated.spots, optimize=True)
    size = shifts.size
    seen = spots.reshape(size, size) + NOISE**2 * np.eye(size)
    rows = stated.parameters
    own = np.einsum("pm,tmun,qn->tpuq", rows, moved[READINGS:, :, READINGS:], rows, optimize=True)
    with_spots = np.einsum("pm,tmun,sn->tpus", rows, moved[READINGS:, :, :READINGS], stated.spots, optimize=True)
    count = len(PASSES) * len(rows)
    gain = np.linalg.solve(seen, with_spots.reshape(count, size).T).T
    mean = (gain @ shifts.ravel()).reshape(len(PASSES), len(LINES), 4).swapaxes(0, 1)
    left = own.reshape(count, count) - gain @ with_spots.reshape(count, size).T
    shape = (len(PASSES), len(LINES), 4)
    return JointCameraPrior(LINES, mean, left.reshape(*shape, *shape).transpose(1, 0, 2, 4, 3, 5).reshape(count, count))


@one_blas_thread()
def test_check_points_by_a_record_are_those_of_the_same_laws_and_readings_by_hand(operated):
    folder, stated, shifts = operated
    run = run_operated_block(AdjustSetup.read(folder / "block.yaml"), None, 5)
    found = run.adjustment
    said = found.assembly.block.monitored
    hand = by_hand(stated, shifts)
    sigma = np.sqrt(np.diag(hand.covariance))
    assert np.max(np.abs(said.mean - hand.mean).ravel() / sigma) < 0.05
    assert np.max(np.abs(said.covariance - hand.covariance) / (sigma[:, None] * sigma)) < 0.02
    # errors of one pass go together with those of the other
    assert np.max(np.abs(hand.covariance[0:4, 4:8]) / (sigma[0:4, None] * sigma[4:8])) > 0.3
    other = adjust_block(replace(found.assembly.block, monitored=hand))
    where = run.check[0]
    own = np.sqrt(np.diagonal(other.point_covariance(where), axis1=1, axis2=2))
    assert np.max(np.abs(found.ground[where] - other.ground[where]) / own) < 0.05
    assert np.sqrt(np.diagonal(found.point_covariance(where), axis1=1, axis2=2)) == pytest.approx(own, rel=0.02)
    assert found.p_value > 1e-3
    assert "monitor" in run.used
    # cameras that nobody watched leave the ground as uncertain as their stated changes
    assert run.contributions["without monitor"].predicted.le90 > 2 * run.contributions["all"].predicted.le90


def test_true_cameras_are_drawn_from_what_the_record_says(operated):
    folder, stated, shifts = operated
    hand = by_hand(stated, shifts)
    setup = AdjustSetup.read(folder / "block.yaml")
    value, every = hand.mean.ravel(), []
    for seed in range(8):
        drawn = draw_block(setup, np.random.SeedSequence(seed), lambda epochs, lines: hand)
        change = np.array([[drawn.change[f"{name}/{line}"] for name in ("one", "two")] for line in LINES])
        every.append(np.linalg.solve(np.linalg.cholesky(hand.covariance + 1e-24 * np.eye(16)), change.ravel() - value))
        if seed == 0:
            assert drawn.block.monitored is hand
    # 128 standard normals have their variance to 12.5%
    assert np.mean(np.square(every)) == pytest.approx(1.0, abs=0.5)


TWO = "\nmonitor: {angles: [0.2 arcsec, 0.2 arcsec, 2 arcsec], principal_distance: 4 um}\n"


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("own_lines.yaml", "gf7_lines", "has another principal distance.*5512 mm|7680 mm, not 5512 mm"),
        ("own_lines.yaml", "turned.yaml", "camera has another look angle than this block's; found 26 deg, not 20 deg"),
        ("backward", "rear", ": monitor_record.record: .* no camera of this name; found 'rear', allowed: forward, b"),
        ("record: record,", "record: nowhere,", ": monitor_record.record: "),
        ("record: record, plan: plan.yaml", "record: record", "the record has no plan of operation"),
        (utc(PASSES[0]), "2025-01-01T03:05:00Z", "monitor_record"),
        ("plan.yaml", "other/plan.yaml", "a plan of another instrument than the record's"),
        ("plan: plan.yaml}", f"plan: plan.yaml}}{TWO}", "are both given"),
    ],
)
def test_a_record_that_does_not_fit_is_refused(operated, old, new, told):
    folder = operated[0]
    (folder / "other").mkdir(exist_ok=True)
    plan_of(folder / "other", "gf7_pair")
    text = (folder / "block.yaml").read_text()
    assert old in text
    text = text.replace("own_lines.yaml", "renamed.yaml") if new == "rear" else text
    (folder / "wrong.yaml").write_text(text.replace(old, new))
    with pytest.raises(InputError, match=told):
        run_operated_block(AdjustSetup.read(folder / "wrong.yaml"), None, 5)
