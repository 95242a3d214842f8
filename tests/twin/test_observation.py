"""One observation for all: states in pieces, alone or with a lost one among them are the same frames and readings."""

from collections.abc import Callable

import numpy as np
import pytest

from optics.geometry.tree import Motion
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from scenes.specs.load import EXAMPLES
from scenes.specs.resolved import resolve
from tests.benchmarks.monitor_speed import random_states
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import LOST, ObservationOptions, StateReader, observe, shared_detector

FRAMES, SEED = 2, 7
BEYOND = {"base/forward/focal_plane": Motion(shift=(5e-3, 0.0, 0.0))}
"""Whose spots leave their CCDs."""


@pytest.fixture(scope="module")
def pair(experiment: Callable[[str], MonitorExperiment]) -> MonitorExperiment:
    return experiment("gf7_pair")


@pytest.mark.second
def test_states_that_are_lost_are_left_out_and_told(pair: MonitorExperiment) -> None:
    """Those that are not keep their numbers, and with them their noise."""
    told: dict[int, str] = {}
    states = random_states(3, 1)
    record = shared_detector(pair, FRAMES, SEED)
    how = ObservationOptions(record, omit=told.__setitem__, use_prior=False)
    (found,) = observe(pair, [states[0], BEYOND, *states[1:]], how, [10, 11, 12, 13])
    assert list(told) == [11]
    assert "forward/" in told[11]
    assert found.numbers.tolist() == [10, 12, 13]
    assert [len(found.truth.angle_change), len(found.light.photons), len(found.recovery.after)] == [3, 3, 3]
    for k, number in enumerate((10, 12, 13)):
        (alone,) = observe(pair, [states[k]], ObservationOptions(record, use_prior=False), [number])
        np.testing.assert_array_equal(alone.after[0], found.after[k])
        np.testing.assert_array_equal(alone.recovery.after[0], found.recovery.after[k])
        assert alone.truth.angle_change == pytest.approx(found.truth.angle_change[k : k + 1], rel=1e-9)
    with pytest.raises(LOST):
        next(observe(pair, [states[0], BEYOND], ObservationOptions(record, use_prior=False)))
    assert list(observe(pair, [BEYOND], how, [3])) == []
    assert list(told) == [11, 3]


@pytest.mark.second
def test_pieces_are_the_whole(pair: MonitorExperiment) -> None:
    states = random_states(5, 2)
    whole, parts = (
        list(
            observe(pair, states, ObservationOptions(shared_detector(pair, FRAMES, SEED), chunk=chunk, use_prior=False))
        )
        for chunk in (5, 2)
    )
    assert [found.numbers.tolist() for found in parts] == [[0, 1], [2, 3], [4]]
    np.testing.assert_array_equal(whole[0].after, np.concatenate([found.after for found in parts]))


def test_a_spot_that_cannot_be_measured_leaves_its_state_out(pair: MonitorExperiment) -> None:
    """Whatever is recorded: here one detector has seen no light."""
    told: dict[int, str] = {}
    exposed = shared_detector(pair, FRAMES, SEED)

    def record(photons: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        before, after = exposed(photons, numbers)
        assert isinstance(before, np.ndarray)
        after[numbers == 1, 2] = 0
        return before, after

    states = random_states(3, 1)
    (found,) = observe(pair, states, ObservationOptions(record, omit=told.__setitem__, use_prior=False))
    assert found.numbers.tolist() == [0, 2]
    assert found.measured.tolist() == [0, 2]
    assert list(told) == [1]
    assert told[1].startswith(f"a spot cannot be measured ({pair.path.channels[2].key}: ")


# --- states read one at a time ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reader(backend) -> StateReader:
    return StateReader(MonitorExperiment(resolve(EXAMPLES / "perturb.yaml"), backend), 2, 5)


@pytest.mark.second
def test_without_noise_the_model_reads_what_its_motions_do(reader) -> None:
    """A shift of a focal plane is a motion of the model's own; what is not linear in it, and the change of the spot's
    shape, are below 1e-3 of it. The same light is the same reading; at rest there is none.
    """
    still = reader.read({}, noise=False)
    assert still.after.shape == still.light.photons.shape
    assert np.abs(still.recovery.shift).max() < 1e-6
    state = {"base/forward/focal_plane": Motion(shift=(1e-5, 0.0, 0.0))}
    one, again = (reader.read(state, noise=False) for _ in range(2))
    assert np.array_equal(one.recovery.shift, again.recovery.shift)
    true = one.truth.cameras["forward"].d_alpha[0]
    read = one.recovery.parameters["forward"]["model"].d_alpha_rad[0]
    assert read == pytest.approx(true, rel=1e-3)


def test_an_impossible_state_is_told_and_the_next_is_read(reader) -> None:
    with pytest.raises((AimError, BeamMissedError)):
        reader.read({"base/forward/focal_plane": Motion(shift=(5e-3, 0.0, 0.0))})
    assert np.abs(reader.read({}, noise=False).recovery.shift).max() < 1e-6
